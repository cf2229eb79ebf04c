"""ROS parameters: every setting of `Config` under its dotted name, and those of the node."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
import json
from typing import Any, NamedTuple

from boxreg_ros.config import Config, Setting, settings
from boxreg_ros.errors import ConfigError
from msg_adapters.convention import Convention, FORWARD, REFERENCES, SIZE_ORDERS
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

NODE_SETTINGS = (
    Setting(
        'boxes_type', '',
        'message type of the boxes, as package/msg/Type; empty: the first that can be read',
        '', None, None, (),
    ),
    Setting(
        'pose_reference', 'center',
        f'point of a box that its pose is at: {", ".join(REFERENCES)}, or x,y,z in parts of '
        f'length, width and height',
        '', None, None, (),
    ),
    Setting(
        'size_order', 'lwh', 'what x, y and z of a size are: length, width, height',
        '', None, None, SIZE_ORDERS,
    ),
    Setting(
        'forward_axis', 'x+', 'axis of a pose that points forward', '', None, None, tuple(FORWARD)
    ),
    Setting(
        'associate', False, 'give boxes ids by association, whatever ids they have',
        '', None, None, (),
    ),
    Setting(
        'fixed_frame', '',
        'frame to refine in; empty: the topmost frame that the frame of the clouds moves in',
        '', None, None, (),
    ),
    Setting(
        'output_frame', '', 'frame of the refined boxes; empty: that of the input boxes',
        '', None, None, (),
    ),
    Setting(
        'transform_timeout', 0.3, 'how long a cloud or boxes wait for their transform',
        's', 0.0, 60.0, (),
    ),
    Setting(
        'backlog', 0.1, 'clouds that wait longer are dropped, boxes pass after ten times that',
        's', 0.0, 3600.0, (),
    ),
    Setting(
        'config_file', 'boxreg_node.yaml', 'where ~/save_config writes all parameters',
        '', None, None, (),
    ),
)  # fmt: skip

AT_ONCE = (
    *('sampling.', 'solver.', 'paper.', 'vehicle.', 'cyclist.', 'pedestrian.'),
    *('max_gap', 'min_observations', 'output_frame', 'transform_timeout', 'config_file'),
)
"""Beginnings of the names of what may change while the node runs."""
READ_ONLY = 'set before the start: windows, threads or subscriptions are built from it'
ROS_OWN = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')


class NodeOptions(NamedTuple):
    """What the node is told beside `Config`; see `NODE_SETTINGS`."""

    boxes_type: str
    pose_reference: str
    size_order: str
    forward_axis: str
    associate: bool
    fixed_frame: str
    output_frame: str
    transform_timeout: float
    backlog: float
    config_file: str

    @property
    def convention(self) -> Convention:
        """Return how boxes are to be read."""
        return Convention(self.pose_reference, self.size_order, self.forward_axis, self.associate)


def declare(node: Node) -> tuple[Config, NodeOptions]:
    """
    Declare all parameters of a node and return what they are set to.

    The node must have been made with ``automatically_declare_parameters_from_overrides``: so
    whole numbers can be given for real ones, and names that do not exist be told.

    Raises
    ------
    ConfigError
        For a value of the wrong type or out of its bounds, by name.

    Notes
    -----
    `estimate` has no say here: the node publishes the early and the final estimate.

    """
    parameters: dict[str, Any] = node.get_parameters_by_prefix('')  # typed wrongly in rclpy
    given = _values_of(parameters.values())
    changes = {item.name: given[item.name] for item in settings() if item.name in given}
    config = Config().updated(changes)
    if changes.get('estimate', 'final') != 'final':
        node.get_logger().warning(
            f'estimate {config.estimate!r} is for recordings: this node publishes early and final'
        )
    config = replace(config, estimate='final')
    options = NodeOptions(
        *(_checked(item, given.get(item.name, item.default)) for item in NODE_SETTINGS)
    )
    values = [*config.items(), *zip(NODE_SETTINGS, options, strict=True)]
    for item, value in values:
        if item.name in given:
            node.undeclare_parameter(item.name)
        node.declare_parameter(item.name, _plain(value), describe(item), ignore_override=True)
    known = {item.name for item, _ in values}
    if unknown := sorted(n for n in given if n not in known and not n.startswith(ROS_OWN)):
        node.get_logger().warning(
            f'no such parameters here: {", ".join(unknown)}; see the table in the README'
        )
    return config, options


def changed(
    config: Config, options: NodeOptions, parameters: Iterable[Parameter]
) -> tuple[Config, NodeOptions]:
    """
    Return the settings with some parameters changed.

    Raises
    ------
    ConfigError
        For a value of the wrong type or out of its bounds, by name.

    """
    given = _values_of(parameters)
    config = config.updated({s.name: given[s.name] for s in settings() if s.name in given})
    own = {s.name: _checked(s, given[s.name]) for s in NODE_SETTINGS if s.name in given}
    return config, options._replace(**own)


def parameters_yaml(
    config: Config, options: NodeOptions | None = None, node_name: str = '/**/boxreg_node'
) -> str:
    """
    Return all settings as a parameter file of ROS, with what they mean.

    Those of `Config` come first, for every node: this is the part that ``boxreg relabel
    --config`` reads. `estimate` is left out, the node having no use for it.

    """
    lines, group = ['/**:', '  ros__parameters:'], ''
    for item, value in config.items():
        *groups, name = item.name.split('.')
        if groups and groups[0] != group:
            group = groups[0]
            lines.append(f'    {group}:')
        if item.name != 'estimate':
            lines.append(_yaml_line(item, '      ' if groups else '    ', name, value))
    lines += [f'{node_name}:', '  ros__parameters:']
    own = options or [item.default for item in NODE_SETTINGS]
    for item, value in zip(NODE_SETTINGS, own, strict=True):
        lines.append(_yaml_line(item, '    ', item.name, value))
    return '\n'.join(lines) + '\n'


def _yaml_line(item: Setting, indent: str, name: str, value: Any) -> str:
    bounds = ', '.join(item.choices)
    if item.low is not None and item.high is not None:
        bounds = f'{item.low:g} to {item.high:g} {item.unit}'.rstrip()
    note = f'{item.meaning} ({bounds})' if bounds else item.meaning
    return f'{indent}{name}: {json.dumps(_plain(value))}  # {note}'


def _plain(value: Any) -> Any:
    """Return a value as a parameter takes it: of an empty list ROS cannot tell the type."""
    return (list(value) or ['']) if isinstance(value, tuple) else value


def _values_of(parameters: Iterable[Parameter]) -> dict[str, Any]:
    """Return values by name, lists without the empty texts that stand for no text at all."""
    values = {parameter.name: parameter.value for parameter in parameters}
    return {
        name: [v for v in value if v != ''] if isinstance(value, list) else value
        for name, value in values.items()
    }


def _checked(item: Setting, value: Any) -> Any:
    """Return the value of a setting of the node in its type, or raise ConfigError."""
    kind: Any = type(item.default)
    if kind is float and type(value) is int:
        value = float(value)
    if type(value) is not kind:
        raise ConfigError(f'{item.name}: expected {kind.__name__}, got {value!r}')
    if item.low is not None and item.high is not None and not item.low <= value <= item.high:
        bounds = f'{item.low:g} to {item.high:g} {item.unit}'.rstrip()
        raise ConfigError(f'{item.name}: expected {bounds}, got {value!r}')
    return value


def describe(item: Setting) -> ParameterDescriptor:
    """Return what a setting means, its unit and its bounds, as ROS tools show it."""
    unit = f' [{item.unit}]' if item.unit else ''
    is_fixed = not item.name.startswith(AT_ONCE)
    constraints = [f'one of {", ".join(item.choices)}'] if item.choices else []
    descriptor = ParameterDescriptor(
        description=f'{item.meaning}{unit}',
        additional_constraints='; '.join([*constraints, READ_ONLY] if is_fixed else constraints),
        read_only=is_fixed,
    )
    if item.low is not None and item.high is not None:
        if isinstance(item.default, float):
            bounds = FloatingPointRange(from_value=float(item.low), to_value=float(item.high))
            descriptor.floating_point_range = [bounds]
        elif isinstance(item.default, int):
            whole = IntegerRange(from_value=int(item.low), to_value=int(item.high), step=1)
            descriptor.integer_range = [whole]
    return descriptor
