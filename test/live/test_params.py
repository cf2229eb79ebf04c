"""Parameters of the node: declaration, types, bounds, changes at run time and files."""

from dataclasses import replace

from boxreg_ros.config import Config, NODE_OPTIONS, settings
from boxreg_ros.errors import ConfigError
from boxreg_ros.live.params import (
    changed,
    declare,
    DYNAMIC,
    NODE_SETTINGS,
    numbers_as_declared,
    parameters_yaml,
    READ_ONLY,
)
import pytest
import rclpy
from rclpy.parameter import Parameter
import yaml


@pytest.fixture(scope='module')
def context():
    context = rclpy.Context()
    rclpy.init(context=context)
    yield context
    rclpy.shutdown(context=context)


@pytest.fixture
def make_node(context):
    nodes = []

    def make(cli_args=None, name='params', **given):
        namespace, _, base = name.rpartition('/')
        node = rclpy.create_node(
            base, namespace=namespace, context=context,
            automatically_declare_parameters_from_overrides=True,
            parameter_overrides=[Parameter(name, value=value) for name, value in given.items()],
            cli_args=cli_args,
        )  # fmt: skip
        nodes.append(node)
        return node

    yield make
    for node in nodes:
        node.destroy_node()


def test_every_setting_is_a_described_parameter(make_node):
    node = make_node()
    config, options = declare(node)
    assert config == Config(estimate='final')
    assert options.boxes_type == options.fixed_frame == options.output_frame == ''
    for item in [*settings(), *NODE_SETTINGS]:
        descriptor = node.describe_parameter(item.name)
        assert descriptor.description.startswith(item.meaning)
        assert not item.unit or f'[{item.unit}]' in descriptor.description
        assert descriptor.read_only == (not item.name.startswith(DYNAMIC))
        assert (READ_ONLY in descriptor.additional_constraints) == descriptor.read_only
        ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
        assert [(r.from_value, r.to_value) for r in ranges] == (
            [] if item.low is None or item.choices else [(item.low, item.high)]
        )
        for choice in item.choices:
            assert choice in descriptor.additional_constraints
        value = node.get_parameter(item.name).value
        default = 'final' if item.name == 'estimate' else item.default
        if isinstance(default, tuple):
            value = tuple(name for name in value if name)  # ROS has no empty list: ['']
        assert value == default


def test_integers_are_accepted_for_reals_at_start_up(make_node):
    node = make_node(
        **{
            'vehicle.shape': 1,
            'window': 7,
            'lag': 6,
            'vehicle.names': ['ute'],
            'transform_timeout': 2,
        }
    )
    config, options = declare(node)
    assert config == Config(estimate='final').updated(
        {'vehicle.shape': 1.0, 'window': 7, 'lag': 6, 'vehicle.names': ['ute']}
    )
    assert type(node.get_parameter('vehicle.shape').value) is float
    assert type(options.transform_timeout) is float
    assert options.transform_timeout == 2.0


def test_node_and_relabel_read_the_same_file(make_node, tmp_path):
    path = tmp_path / 'params.yaml'
    values = {'window': 6, 'lag': 2, 'solver': {'rounds': 2}, 'faces': {'learn': False}}
    path.write_text(yaml.safe_dump({'/**': {'ros__parameters': {**values, 'estimate': 'final'}}}))
    config, _ = declare(make_node(cli_args=['--ros-args', '--params-file', str(path)]))
    assert config == Config.from_yaml(path)
    assert config.solver.rounds == 2 and not config.faces.learn


def test_steps_for_whole_tracks_do_not_turn_coasting_off(make_node):
    config, _ = declare(make_node(**{'coast': 0.5, 'complete.fill': True}))
    assert config.coasts


@pytest.mark.parametrize(
    'name, value, words',
    [
        ('window', 2, ('window', '3', '2')),
        ('window', 'abc', ('window', 'int', 'abc')),
        ('lag', 1000, ('lag', '999', '1000')),
        ('lag', 10, ('lag', 'window (10)', 'got 10')),
        ('mode', '4d', ('mode', 'bev', '4d')),
        ('transform_timeout', -1.0, ('transform_timeout', '0', '-1')),
        ('backlog', 'x', ('backlog', 'float', 'x')),
        ('boxes_type', True, ('boxes_type', 'str', 'True')),
        ('faces.learn', 1, ('faces.learn', 'bool', '1')),
    ],
)
def test_bad_values_are_refused_by_name(make_node, name, value, words):
    with pytest.raises(ConfigError) as caught:
        declare(make_node(**{name: value}))
    for word in words:
        assert word in str(caught.value)


def test_fixed_parameters_are_read_only(make_node):
    node = make_node()
    declare(node)
    (result,) = node.set_parameters([Parameter('window', value=5)])
    assert not result.successful
    assert 'read-only' in result.reason
    assert node.get_parameter('window').value == Config().window


def test_dynamic_parameters_change_within_their_bounds(make_node):
    node = make_node()
    settings_before = declare(node)
    changes = [Parameter('solver.rounds', value=2), Parameter('transform_timeout', value=1.5)]
    assert all(result.successful for result in node.set_parameters(changes))
    config, options = changed(*settings_before, [*changes, Parameter('use_sim_time', value=True)])
    assert config == settings_before[0].updated({'solver.rounds': 2})
    assert options == replace(settings_before[1], transform_timeout=1.5)
    (result,) = node.set_parameters([Parameter('solver.rounds', value=0)])
    assert not result.successful
    for bad in (Parameter('solver.rounds', value=0), Parameter('transform_timeout', value='a')):
        with pytest.raises(ConfigError, match=bad.name):
            changed(*settings_before, [bad])


def test_written_file_is_read_by_nodes_of_any_name_and_by_relabel(make_node, tmp_path):
    path = tmp_path / 'params.yaml'
    config = Config(estimate='final').updated(
        {
            'window': 7,
            'lag': 5,
            'vehicle.names': ['ute', 'car'],
            'paper.closeness': 1e-5,
            'mode': 'bev',
        }
    )
    config = config.updated({'cyclist.names': []})
    _, options = declare(make_node())
    options = replace(options, fixed_frame='map', backlog=9.0)
    path.write_text(parameters_yaml(config, options))
    for name in ('params', '/front/other'):
        arguments = ['--ros-args', '--params-file', str(path)]
        assert declare(make_node(cli_args=arguments, name=name)) == (config, options)
    read = Config.from_yaml(path)
    assert read.cyclist.names == ('',)  # matches no class
    assert read.updated({'cyclist.names': []}) == config.updated({'estimate': 'track'})
    for item in settings():
        assert item.name == 'estimate' or item.meaning in path.read_text()


def test_relabel_ignores_parameters_of_the_node_only(tmp_path):
    path = tmp_path / 'params.yaml'
    own = [item.name for item in NODE_SETTINGS]
    assert NODE_OPTIONS[: len(own)] == tuple(own)
    values = dict.fromkeys(NODE_OPTIONS, 'x') | {'window': 12}
    values['qos_overrides./points.subscription.depth'] = 3
    path.write_text(yaml.safe_dump({'/**': {'ros__parameters': values}}))
    assert Config.from_yaml(path) == Config().updated({'window': 12})
    path.write_text(yaml.safe_dump({'/**': {'ros__parameters': values | {'windw': 3}}}))
    with pytest.raises(ConfigError, match='windw: no such setting'):
        Config.from_yaml(path)


def test_integers_are_accepted_for_reals_at_run_time(make_node):
    node = make_node()
    declare(node)
    node.add_pre_set_parameters_callback(lambda given: numbers_as_declared(node, given))
    result = node.set_parameters_atomically([Parameter('vehicle.shape', value=1)])
    assert result.successful, result.reason
    assert node.get_parameter('vehicle.shape').value == 1.0
    result = node.set_parameters_atomically([Parameter('sampling.box_time', value=0.3)])
    assert result.successful, result.reason
    assert node.get_parameter('sampling.box_time').value == '0.3'
    result = node.set_parameters_atomically([Parameter('solver.rounds', value=2.5)])
    assert not result.successful
