"""Files installed with the code; ``python test/live/test_share.py`` writes those of parameters."""

import json
import re
from xml.etree import ElementTree

from boxreg_ros.config import Config, settings
from boxreg_ros.io.markers import NAMESPACES
from boxreg_ros.live.params import (
    declare,
    NODE_SETTINGS,
    NodeOptions,
    parameters_yaml,
)
from measure.node import PROFILE
from paths import ROOT, SHARE
import pytest
import rclpy
import yaml

PAGE = ROOT / 'docs' / 'tasks' / 'run-on-a-robot.md'
PARAMETERS = SHARE / 'params.yaml'
SCHEMA = SHARE / 'params.schema.json'
NODE = (SHARE.parent / 'live' / 'node.py').read_text(encoding='utf-8')


@pytest.mark.parametrize('name', ['boxreg_node', '/front/lidar/refiner'])
def test_parameter_file_holds_the_defaults_for_any_node(name):
    assert PARAMETERS.read_text(encoding='utf-8') == parameters_yaml(Config()), (
        'run: PYTHONPATH=test python test/live/test_share.py'
    )
    assert Config.from_yaml(PARAMETERS) == Config()
    context = rclpy.Context()
    rclpy.init(context=context, args=['--ros-args', '--params-file', str(PARAMETERS)])
    try:
        namespace, _, base = name.rpartition('/')
        node = rclpy.create_node(
            base, namespace=namespace, context=context,
            automatically_declare_parameters_from_overrides=True,
        )  # fmt: skip
        given = set(node.get_parameters_by_prefix(''))
        assert {item.name for item in NODE_SETTINGS} < given
        config, options = declare(node)
        assert config == Config(estimate='final')
        assert options == NodeOptions()
        node.destroy_node()
    finally:
        rclpy.shutdown(context=context)


def parameters_schema():
    """Return the JSON schema of a ROS parameter file of the node, such as `params.yaml`."""
    values = {'use_sim_time': {'type': 'boolean'}, 'qos_overrides': {}}
    for item in (*NODE_SETTINGS, *settings()):
        group, _, name = item.name.rpartition('.')
        target = values
        if group:
            target = values.setdefault(group, object_schema({}))['properties']
        target[name] = schema_of(item)
    parameters = object_schema({'ros__parameters': object_schema(values)})
    return {
        '$schema': 'http://json-schema.org/draft-07/schema#',
        'title': 'Parameters of boxreg_node',
        'type': 'object',
        'additionalProperties': parameters,  # by the name of the node, or /** for any
    }


def object_schema(properties):
    return {'type': 'object', 'properties': properties, 'additionalProperties': False}


def schema_of(item):
    """Return the JSON schema of one setting: type, default, meaning and bounds."""
    names = {bool: 'boolean', int: 'integer', float: 'number', str: 'string', tuple: 'array'}
    unit = f' [{item.unit}]' if item.unit else ''
    plain = (list(item.default) or ['']) if isinstance(item.default, tuple) else item.default
    schema = {
        'type': names[type(item.default)],
        'default': plain,
        'description': f'{item.meaning}{unit}',
    }
    if isinstance(item.default, tuple):
        schema['items'] = {'type': 'string'}
    if item.choices:
        schema['enum'] = list(item.choices)
    if item.low is not None:
        schema |= {'minimum': item.low, 'maximum': item.high}
    if item.choices and item.low is not None:  # a number, or a text with one
        schema['type'] = ['string', 'number']
        schema['anyOf'] = [
            {'enum': schema.pop('enum')},
            {'type': 'number'},
            {'pattern': '^[-0-9]'},
        ]
    return schema


def schema_text():
    return json.dumps(parameters_schema(), indent=2) + '\n'


def test_schema_is_that_of_the_settings():
    assert SCHEMA.read_text(encoding='utf-8') == schema_text(), (
        'run: PYTHONPATH=test python test/live/test_share.py'
    )


@pytest.mark.parametrize(
    ('name', 'value', 'words'),
    [
        ('window', 2, 'less than the minimum'),
        ('window', 5.5, "not of type 'integer'"),
        ('mode', '4d', 'is not one of'),
        ('windows', 5, "'windows' was unexpected"),
    ],
)
def test_schema_takes_the_installed_file_and_refuses_wrong_values(name, value, words):
    jsonschema = pytest.importorskip('jsonschema', reason='jsonschema is not installed')
    file = yaml.safe_load(PARAMETERS.read_text(encoding='utf-8'))
    jsonschema.validate(file, parameters_schema())
    file['/**']['ros__parameters'][name] = value
    with pytest.raises(jsonschema.ValidationError, match=words):
        jsonschema.validate(file, parameters_schema())


def test_launch_file_starts_the_node_with_its_arguments():
    launch = ElementTree.parse(SHARE / 'boxreg.launch.xml').getroot()
    arguments = {item.get('name'): item for item in launch.iter('arg')}
    assert all(item.get('description') for item in arguments.values())
    node = next(item for item in launch.iter('node') if item.get('pkg') == 'boxreg_ros')
    programs = [(i.get('value'), i.get('if')) for i in launch.iter('let')][:2]
    assert node.get('exec') == '$(var boxreg_program)'
    assert programs == [('boxreg_node', None), ('boxreg_lifecycle_node', '$(var lifecycle)')]
    assert arguments['name'].get('default') == 'boxreg_node'
    for argument in ('name', 'namespace', 'respawn'):
        assert node.get(argument) == f'$(var {argument})'
    # As a parameter of launch, a file that does not exist would be a mere warning.
    words = ' '.join(node.get('ros_args').split())
    assert words.startswith('--log-level $(var log_level) --params-file $(var params) $(if ')
    assert {item.get('from') for item in node.iter('remap')} == {
        'points', 'boxes', 'odom', '/tf', '/tf_static',
        'refined_boxes', 'refined_boxes_final', 'refined_markers',
    }  # fmt: skip
    for name in ('boxes_type', 'use_sim_time'):  # after the file: they win where they are given
        assert arguments[name].get('default') == ''
        assert f'{name}:=$(var {name})' in words
    assert not list(node.iter('param'))
    for name in ('use_sim_time', 'lifecycle', 'respawn', 'rviz'):
        choices = [item.get('value') for item in arguments[name].iter('choice')]
        assert choices[-2:] == ['true', 'false']
    text = (SHARE / 'boxreg.launch.xml').read_text(encoding='utf-8')
    variables = {item.get('name') for item in launch.iter('let')}
    assert set(re.findall(r'\$\(var (\w+)\)', text)) == {*arguments, *variables}
    for file in re.findall(r'find-pkg-share boxreg_ros\)/([\w.]+)', text):
        assert (SHARE / file).is_file()


def test_page_names_every_launch_argument():
    launch = ElementTree.parse(SHARE / 'boxreg.launch.xml').getroot()
    table = PAGE.read_text(encoding='utf-8').split('## Launch arguments')[1].split('\n## ')[0]
    named = set(re.findall(r'`(\w+)`', '\n'.join(re.findall(r'^\|([^|]+)\|', table, re.M))))
    assert named == {item.get('name') for item in launch.iter('arg')}


@pytest.mark.parametrize('file', ['boxreg.rviz', 'foxglove.json'])
def test_views_show_the_topics_and_namespaces_of_the_node(file):
    text = (SHARE / file).read_text(encoding='utf-8')
    view = json.loads(text) if file.endswith('json') else yaml.safe_load(text)
    if file.endswith('json'):
        panels = set(view['configById'])
        assert set(re.findall(r'"(\w+!\w+)"', json.dumps(view['layout']))) == panels
        topics = view['configById']['3D!boxes']['topics']
        assert set(topics['/refined_markers']['namespaces']) == set(NAMESPACES)
        names = {name.lstrip('/') for name in topics}
    else:
        displays = {item['Name']: item for item in view['Visualization Manager']['Displays']}
        assert set(displays['Boxes']['Namespaces']) == set(NAMESPACES)
        assert displays['Points']['Topic']['Reliability Policy'] == 'Best Effort'
        names = {item['Topic']['Value'] for item in displays.values() if 'Topic' in item}
    assert names == {'points', 'refined_markers'}
    assert all(f"'{name}'" in NODE for name in names)


def test_shared_memory_segment_holds_three_large_clouds():
    space = '{http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles}'
    profile = ElementTree.parse(PROFILE).getroot()
    (segment,) = (int(item.text) for item in profile.iter(f'{space}segment_size'))
    assert segment >= 3 * 130_000 * 22  # bytes a point: x, y, z, intensity, ring, time
    used = {item.text for item in profile.find(f'.//{space}userTransports')}
    assert used == {item.text for item in profile.iter(f'{space}transport_id')}


if __name__ == '__main__':
    PARAMETERS.write_text(parameters_yaml(Config()), encoding='utf-8')
    SCHEMA.write_text(schema_text(), encoding='utf-8')
