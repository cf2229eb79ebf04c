"""ROS parameters: every setting of `Config` under its dotted name, and the options of the node."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, Field, fields, replace
import json
from typing import Any, cast

from boxreg_ros.config import cast_value, Config, Setting, setting, settings
from boxreg_ros.errors import ConfigError
from boxreg_ros.io.lidars import Lidars
from msg_adapters import CLOUD_TYPES, POINTS_TYPE
from msg_adapters.convention import Convention, STANDARD
from msg_adapters.point_layout import AUTO, TIME_UNIT_CHOICES
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

DYNAMIC = (
    *('sampling.', 'solver.', 'paper.', 'vehicle.', 'cyclist.', 'pedestrian.'),
    *('max_gap', 'coast', 'min_observations', 'output_frame', 'transform_timeout', 'deadline'),
    *('backlog', 'config_file'),
)
"""Prefixes of the parameters that may change while the node runs."""
READ_ONLY = 'read-only: windows, threads or subscriptions are built from it at start-up'
ROS_OWN = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')
"""Prefixes of the parameters that rclpy declares itself."""


@dataclass(frozen=True, slots=True)
class NodeOptions:
    """Options of the node beside `Config`; `config.NODE_OPTIONS` holds their names."""

    boxes_type: str = setting(
        '',
        'message type of the boxes, as package/msg/Type; empty: the first supported type '
        'published on the topic',
    )
    points: tuple[str, ...] = setting(
        (), 'topics of the clouds of several LiDARs, which are merged; empty: the topic points'
    )
    points_type: str = setting(
        POINTS_TYPE, 'message type of the clouds, as package/msg/Type', choices=CLOUD_TYPES
    )
    time_unit: str = setting(
        AUTO,
        'unit of the times of the points; auto: that of the layout, else by magnitude',
        choices=TIME_UNIT_CHOICES,
    )
    sensor_frames: tuple[str, ...] = setting(
        (),
        'frames of the LiDARs where clouds are in another one: one for each of points, or all '
        'LiDARs of a single concatenated cloud',
    )
    points_info: str = setting(
        '',
        'topic of ConcatenatedPointCloudInfo, which divides a concatenated cloud among its '
        'LiDARs; empty: none',
    )
    convention: Convention = STANDARD
    keep_ids: bool = setting(
        False,
        'take the track ids of the input as they are, even where they do not identify objects; '
        'by default boxes are then associated, as with associate',
    )
    clock_offset: float = setting(
        0.0,
        'added to the stamps of TF and odometry, where their clock is behind that of the clouds',
        's',
        -1e10,
        1e10,
    )
    fixed_frame: str = setting(
        '', 'frame to refine in; empty: the root of the tree that the frame of the clouds moves in'
    )
    output_frame: str = setting('', 'frame of the refined boxes; empty: that of the input boxes')
    transform_timeout: float = setting(
        0.3, 'maximum wait of a cloud or box array for its transform', 's', 0.0, 60.0
    )
    deadline: float = setting(
        -1.0,
        'maximum time from complete data to refined boxes: tracks that the solver has no time for '
        'are kept, and solved first at the next stamp; negative: most of the measured period of '
        'the boxes',
        's',
        -1.0,
        3600.0,
    )
    backlog: float = setting(
        0.5,
        'maximum wait of a cloud for those before it, after which it is dropped; of a box array '
        'ten times that, before it passes through unrefined. While waits grow beyond deadline, '
        'older clouds give way to the newest',
        's',
        0.0,
        3600.0,
    )
    static_points: bool = setting(
        False,
        'also publish static_points: each cloud without the points of moving objects, by the '
        'early boxes',
    )
    static_points_wait: float = setting(
        0.2,
        'maximum wait of a cloud of static_points for its boxes, after which it passes unchanged',
        's',
        0.0,
        60.0,
    )
    config_file: str = setting(
        'boxreg_node.yaml', 'file that ~/save_config writes all parameters to'
    )
    input_model: str = setting(
        '',
        'file of what drives have shown of the errors of this detector: read at the start where '
        'it exists, and written at the end; empty: none',
    )

    @property
    def lidars(self) -> Lidars:
        """Return the topics of the clouds and the frames of the LiDARs."""
        return Lidars(self.points, self.sensor_frames, self.points_info, self.time_unit)

    def items(self) -> Iterator[tuple[Setting, Any]]:
        """Yield each of `NODE_SETTINGS` with its value."""
        for item in NODE_SETTINGS:
            owner = self.convention if item in CONVENTION_SETTINGS else self
            yield item, getattr(owner, item.name)


def _setting_of(one: Field[Any]) -> Setting:
    """Return the parameter that a field states, as one or as an option of the command line."""
    if 'of' in one.metadata:
        known: Setting = one.metadata['of']
        return known._replace(name=one.name)
    facts, default = one.metadata['option'], cast('Any', one.default)
    bounds = facts.unit, facts.low, facts.high, facts.choices
    return Setting(one.name, default, facts.meaning, *bounds)


CONVENTION_SETTINGS = tuple(map(_setting_of, fields(Convention)))
NODE_SETTINGS = tuple(
    item
    for one in fields(NodeOptions)
    for item in (CONVENTION_SETTINGS if one.name == 'convention' else [_setting_of(one)])
)


def declare(node: Node) -> tuple[Config, NodeOptions]:
    """
    Declare all parameters of a node; return the settings of the core and the options.

    The node is made with ``automatically_declare_parameters_from_overrides``: this way integers
    are accepted for real parameters, and unknown names can be reported. `estimate` and the steps
    of `complete` are ignored with a warning: the node publishes both early and final estimates,
    before a track is whole. Raises ConfigError for a value of the wrong type or out of its bounds,
    by name.

    """
    parameters: dict[str, Any] = node.get_parameters_by_prefix('')  # wrong annotation in rclpy
    given = _values_of(parameters.values())
    if given.get('estimate', 'final') != 'final':
        node.get_logger().warning(
            f'estimate: {given["estimate"]!r} is ignored: the node publishes the early and the '
            f'final estimate'
        )
    config, options = _updated(Config(), NodeOptions(), given)
    if config.complete.steps:
        names = ', '.join(f'complete.{step}' for step in config.complete.steps)
        node.get_logger().warning(
            f'{names}: ignored, since the node does not wait for whole tracks; for missed '
            f'detections set coast'
        )
    if options.config_file != NodeOptions().config_file:
        node.get_logger().info(
            f'config_file: ~/save_config writes {options.config_file!r}, which is not read: to '
            f'read a saved file, start with --params-file'
        )
    config = replace(config, estimate='final', complete=Config().complete)
    values = [*config.items(), *options.items()]
    for item, value in values:
        if item.name in given:
            node.undeclare_parameter(item.name)
        node.declare_parameter(item.name, _plain(value), describe(item), ignore_override=True)
    known = {item.name for item, _ in values}
    unknown = sorted(n for n in given if n not in known and not n.startswith(ROS_OWN))
    if unknown:
        node.get_logger().warning(
            f'unknown parameters are ignored: {", ".join(unknown)}; see the list of parameters'
        )
    return config, options


def numbers_as_declared(node: Node, parameters: list[Parameter]) -> list[Parameter]:
    """Return parameters as declared: ``ros2 param set NODE vehicle.shape 1`` sends an integer."""
    converted = []
    for parameter in parameters:
        is_number = parameter.type_ in (Parameter.Type.INTEGER, Parameter.Type.DOUBLE)
        if is_number and node.has_parameter(parameter.name):
            kind = node.get_parameter(parameter.name).type_
            if kind == Parameter.Type.DOUBLE:
                parameter = Parameter(parameter.name, kind, float(parameter.value))
            elif kind == Parameter.Type.STRING:
                parameter = Parameter(parameter.name, kind, str(parameter.value))
        converted.append(parameter)
    return converted


def changed(
    config: Config, options: NodeOptions, parameters: Iterable[Parameter]
) -> tuple[Config, NodeOptions]:
    """
    Return the settings with some parameters changed.

    Parameters
    ----------
    config : Config
        The settings before.
    options : NodeOptions
        Those of the node before.
    parameters : iterable of Parameter
        Those to change, by their names as declared; others are not used.

    Returns
    -------
    config : Config
        New settings.
    options : NodeOptions
        New settings of the node.

    Raises
    ------
    ConfigError
        For a value of the wrong type or out of its bounds, by name.

    """
    return _updated(config, options, _values_of(parameters))


def parameters_yaml(config: Config, options: NodeOptions | None = None) -> str:
    """
    Return all settings as a ROS parameter file with a comment per setting.

    Parameters
    ----------
    config : Config
        `estimate` is left out: the node ignores it.
    options : NodeOptions, optional
        Those of the node; default: as they are by default.

    Returns
    -------
    text : str
        YAML for nodes of any name in any namespace. ``boxreg relabel --config`` reads it too and
        ignores the options of the node.

    """
    options = options or NodeOptions()
    lines = ['/**:', '  ros__parameters:']
    for item, value in options.items():
        lines.append(_yaml_line(item, '    ', item.name, value))
    current_group = ''
    for item, value in config.items():
        group, _, name = item.name.rpartition('.')
        if group and group != current_group:
            current_group = group
            lines.append(f'    {group}:')
        if item.name != 'estimate':
            lines.append(_yaml_line(item, '      ' if group else '    ', name, value))
    return '\n'.join(lines) + '\n'


def describe(item: Setting) -> ParameterDescriptor:
    """Return the descriptor of a parameter: meaning, unit, bounds and whether it may change."""
    unit = f' [{item.unit}]' if item.unit else ''
    is_fixed = not item.name.startswith(DYNAMIC)
    constraints = [f'one of {item.bounds}'] if item.choices else []
    if is_fixed:
        constraints.append(READ_ONLY)
    descriptor = ParameterDescriptor(
        description=f'{item.meaning}{unit}',
        additional_constraints='; '.join(constraints),
        read_only=is_fixed,
    )
    if item.low is not None and item.high is not None:
        if isinstance(item.default, float):
            reals = FloatingPointRange(from_value=float(item.low), to_value=float(item.high))
            descriptor.floating_point_range = [reals]
        elif isinstance(item.default, int):
            integers = IntegerRange(from_value=int(item.low), to_value=int(item.high), step=1)
            descriptor.integer_range = [integers]
    return descriptor


def _updated(
    config: Config, options: NodeOptions, given: dict[str, Any]
) -> tuple[Config, NodeOptions]:
    """Return the settings with the given values, by name, set; other names are ignored."""
    config = config.updated({s.name: given[s.name] for s in settings() if s.name in given})
    own = {s.name: _checked(s, given[s.name]) for s in NODE_SETTINGS if s.name in given}
    convention = {s.name: own.pop(s.name) for s in CONVENTION_SETTINGS if s.name in own}
    return config, replace(options, convention=replace(options.convention, **convention), **own)


def _yaml_line(item: Setting, indent: str, name: str, value: Any) -> str:
    """Return the line of one setting; its comment gives meaning and bounds."""
    comment = f'{item.meaning} ({item.bounds})' if item.bounds else item.meaning
    return f'{indent}{name}: {json.dumps(_plain(value))}  # {comment}'


def _plain(value: Any) -> Any:
    """Return a value as ROS takes it: ``['']`` for no text, as an empty list has no type."""
    return (list(value) or ['']) if isinstance(value, tuple) else value


def _values_of(parameters: Iterable[Parameter]) -> dict[str, Any]:
    """Return values by name; empty strings in lists are removed, they stand for an empty list."""
    values = {parameter.name: parameter.value for parameter in parameters}
    return {
        name: [v for v in value if v != ''] if isinstance(value, list) else value
        for name, value in values.items()
    }


def _checked(item: Setting, value: Any) -> Any:
    """Return the value of an option of the node in its type, or raise ConfigError."""
    value = cast_value(item.name, value, item.default)
    item.check(value)
    if item.name == 'deadline' and value == 0:
        raise ConfigError(
            'deadline: expected more than 0 s, or a negative number for most of the measured '
            'period, got 0.0: no box could be refined; raise it or leave it out'
        )
    return value
