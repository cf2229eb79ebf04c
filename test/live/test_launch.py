"""The launch file, started as `ros2 launch` starts it."""

from contextlib import contextmanager, suppress
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from lifecycle_msgs.msg import Transition
from paths import ROOT, SHARE, TEST
import pytest
from ros_domain import next_domain
from ros_graph import graph_in, numbers_changed, PATIENCE, play, publishers_for, records_of
from ros_messages import DETECTIONS, Drive, MARKERS
from test_lifecycle import Manager
import yaml

pytest.importorskip('launch_ros', reason='launch_ros is not installed')
pytest.importorskip('launch_xml', reason='launch_xml is not installed')

LAUNCH_FILE = SHARE / 'boxreg.launch.xml'
LAUNCH_TEST = TEST / 'live' / 'launch_sample.py'
ROS2_LAUNCH = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import AnyLaunchDescriptionSource
file, *arguments = sys.argv[1:]
pairs = [argument.split(':=', 1) for argument in arguments]
source = AnyLaunchDescriptionSource(file)
service = LaunchService(argv=arguments)
service.include_launch_description(
    LaunchDescription([IncludeLaunchDescription(source, launch_arguments=pairs)])
)
sys.exit(service.run())
"""
"""What `ros2 launch` does; ros2cli is in no registry."""


@pytest.fixture
def environment(tmp_path):
    """Return the environment of a workspace that has these sources as an installed package."""
    prefix = tmp_path / 'install'
    index = prefix / 'share' / 'ament_index' / 'resource_index' / 'packages'
    index.mkdir(parents=True)
    (index / 'boxreg_ros').touch()
    (prefix / 'share' / 'boxreg_ros').symlink_to(SHARE)
    programs = prefix / 'lib' / 'boxreg_ros'
    programs.mkdir(parents=True)
    for name, function in (('boxreg_node', 'main'), ('boxreg_lifecycle_node', 'lifecycle')):
        (programs / name).write_text(
            f'#!{sys.executable}\nfrom boxreg_ros.live.main import {function}\n'
            f'raise SystemExit({function}())\n'
        )
        (programs / name).chmod(0o755)
    paths = [str(prefix), os.environ['AMENT_PREFIX_PATH']]
    return {
        **os.environ, 'AMENT_PREFIX_PATH': os.pathsep.join(paths),
        'PYTHONPATH': os.pathsep.join([str(ROOT), os.environ.get('PYTHONPATH', '')]),
        'ROS_DOMAIN_ID': str(next_domain()), 'ROS_LOG_DIR': str(tmp_path),
    }  # fmt: skip


@contextmanager
def started(environment, log, *command):
    """Start Python with arguments; yield the process, and end it and its children afterwards."""
    with log.open('w') as file:
        process = subprocess.Popen(
            [sys.executable, *command], env=environment, cwd=log.parent, stdout=file,
            stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):  # all have ended
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def launched(environment, log, *arguments):
    """Start the launch file with arguments, see `started`."""
    return started(environment, log, '-c', ROS2_LAUNCH, str(LAUNCH_FILE), *arguments)


def write_params(path, **settings):
    """Write the installed parameters with short windows; no message is lost on a busy machine."""
    params = yaml.safe_load((SHARE / 'params.yaml').read_text(encoding='utf-8'))
    params['/**']['ros__parameters'] |= {
        'window': 4, 'lag': 2, 'backlog': 60.0,
        'deadline': 3600.0,  # all windows are solved on a busy machine
        **settings,
    }  # fmt: skip
    path.write_text(yaml.safe_dump(params))


def environment_of_child(pid):
    """Return the environment of the only child of a process."""
    (child,) = Path(f'/proc/{pid}/task/{pid}/children').read_text().split()
    return Path(f'/proc/{child}/environ').read_bytes()


def test_boxes_are_refined_and_sigint_ends_everything(environment, tmp_path):
    names = {'/points': '/lidar/points', '/tf': '/robot/tf', '/tf_static': '/robot/tf_static'}
    records = [
        record._replace(topic=names.get(record.topic, record.topic))
        for record in records_of(Drive(sweeps=6).write(tmp_path / 'drive'))
    ]
    write_params(
        tmp_path / 'robot.yaml',
        **{'qos_overrides./lidar/points.subscription.reliability': 'reliable'},
    )
    log = tmp_path / 'launch.log'
    with graph_in(tmp_path) as graph:
        publishers_for(graph, records)
        early = graph.collect(DETECTIONS, '/front/better')
        environment['ROS_DOMAIN_ID'] = str(graph.domain)
        launching = launched(
            environment, log, 'points:=/lidar/points', 'boxes:=/boxes', 'namespace:=front',
            'name:=refiner', 'params:=robot.yaml', f'boxes_type:={DETECTIONS}',
            'tf:=/robot/tf', 'tf_static:=/robot/tf_static', 'refined_boxes:=better',
            'prefix:=env BOXREG_PREFIX=1',
        )  # fmt: skip
        with launching as process:
            graph.wait_until_connected()
            play(graph, records, early)
            assert numbers_changed(early, records) == [0, 0, *[2] * 4]
            assert b'BOXREG_PREFIX=1' in environment_of_child(process.pid)
            os.killpg(process.pid, signal.SIGINT)  # as a terminal does
            assert process.wait(10.0) == 0
    output = log.read_text()
    assert 'finished cleanly' in output, output
    assert 'front.refiner' in output
    assert 'ERROR' not in output


def test_launch_testing_sees_refined_boxes_and_exit_codes(environment, tmp_path):
    pytest.importorskip('launch_testing', reason='launch_testing is not installed')
    reliable = {'qos_overrides./points.subscription.reliability': 'reliable'}
    write_params(tmp_path / 'robot.yaml', **reliable)
    environment['PYTHONPATH'] = os.pathsep.join([str(TEST), environment['PYTHONPATH']])
    log = tmp_path / 'launch_test.log'
    command = ('-m', 'launch_testing.launch_test', str(LAUNCH_TEST), 'params:=robot.yaml')
    with started(environment, log, *command) as process:
        assert process.wait(120.0) == 0, log.read_text()
    assert log.read_text().count('Ran ') == 2  # while the node runs, and after its end


def wait_for(text, log):
    """Wait until a log has a text."""
    deadline = time.monotonic() + PATIENCE
    while not (log.exists() and text in log.read_text()):
        assert time.monotonic() < deadline, log.read_text()
        time.sleep(0.1)


@pytest.mark.parametrize(
    ('arguments', 'kind'), [((), MARKERS), ((f'boxes_type:={DETECTIONS}',), DETECTIONS)]
)
def test_the_parameter_file_wins_over_defaults_and_not_over_arguments(
    environment, tmp_path, arguments, kind
):
    write_params(tmp_path / 'robot.yaml', boxes_type=MARKERS)
    log = tmp_path / 'launch.log'
    with launched(environment, log, 'params:=robot.yaml', *arguments):
        wait_for(f'boxes are {kind}', log)


def test_the_lifecycle_node_waits_for_its_manager(environment, tmp_path):
    write_params(tmp_path / 'robot.yaml', boxes_type=DETECTIONS, use_sim_time=True)
    log = tmp_path / 'launch.log'
    with graph_in(tmp_path) as graph:
        environment['ROS_DOMAIN_ID'] = str(graph.domain)
        with launched(environment, log, 'params:=robot.yaml', 'lifecycle:=true'):
            manager = Manager(graph)
            assert manager.change(Transition.TRANSITION_CONFIGURE) == (True, 'inactive')
            assert manager.change(Transition.TRANSITION_ACTIVATE) == (True, 'active')
            wait_for(f'boxes are {DETECTIONS}', log)
            graph.wait(lambda: graph.node.count_subscribers('/clock') == 1, 'use_sim_time')


@pytest.mark.parametrize(
    ('argument', 'words'),
    [
        ('use_sim_time:=maybe', ('use_sim_time', 'maybe', 'true', 'false')),
        ('log_level:=loud', ('log_level', 'loud', 'debug', 'fatal')),
        ('lifecycle:=on', ('lifecycle', 'on', 'true')),
        ('respawn:=yes', ('respawn', 'yes', 'true')),
        ('rviz:=1', ('rviz', "'true', 'false'")),
        ('params:=missing.yaml', ('params file', 'missing.yaml', 'Error opening')),
        ('boxes_type:=vision_msgs/Foo', ('vision_msgs/msg/Foo', 'Detection3DArray')),
    ],
)
def test_wrong_arguments_are_named(environment, tmp_path, argument, words):
    log = Path(tmp_path, 'launch.log')
    with launched(environment, log, argument) as process:
        process.wait(60.0)
    lines = [line for line in log.read_text().splitlines() if all(w in line for w in words)]
    assert lines, log.read_text()
    assert 'Traceback' not in log.read_text()
