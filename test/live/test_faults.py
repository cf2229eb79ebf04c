"""Faults and changes while the node runs: restarts, loops, malformed messages, parameters."""

import os
from pathlib import Path
import signal
import subprocess

from boxreg_ros.config import Config
from boxreg_ros.live.topics import import_message
from measure import MEASURE
from measure.node import vitals
from msg_adapters import vision
import numpy as np
import pytest
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_domain import next_domain
from ros_graph import (
    DIAGNOSTICS,
    ended_cleanly,
    first_sweeps,
    numbers_changed,
    play,
    play_in_time,
    QUICK,
    records_of,
    RELIABLE,
    ROOT,
    stamp_of,
    values_of,
)
from ros_messages import DETECTIONS, Drive, POINTS, SECOND, START
from std_srvs.srv import Trigger

MARKERS = 'visualization_msgs/msg/MarkerArray'


def shifted(drive, seconds):
    """Return a drive with its stamps moved into the future."""
    for _, _, message in drive.items:
        for item in [
            *getattr(message, 'transforms', [message]),
            *getattr(message, 'detections', []),
        ]:
            item.header.stamp.sec += seconds
    return drive


def test_parameters_and_services_at_run_time(graph, tmp_path):
    file = tmp_path / 'saved.yaml'
    graph.publisher(POINTS, '/points', is_reliable=False)
    graph.publisher(DETECTIONS, '/boxes')
    diagnostics = graph.collect(DIAGNOSTICS, '/diagnostics')
    node = graph.start(*RELIABLE, '-p', f'config_file:={file}', '-p', 'window:=8', '-p', 'lag:=7')
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    graph.node.create_subscription(
        import_message(DETECTIONS), '/refined_boxes_final', print, latched
    )
    graph.wait(lambda: values_of(diagnostics).get('qos_incompatible') == '2', 'both QoS reports')
    output = node.output()
    assert '/points: the publisher of /neighbour offers reliability best_effort' in output
    assert 'requests durability transient_local, the publisher of this node' in output
    assert 'qos_overrides' in output
    assert f'{str(file)!r}, which is not read: to read' in output

    def set_to(**values):
        changes = [Parameter(n.replace('__', '.'), value=v) for n, v in values.items()]
        request = SetParameters.Request(parameters=[c.to_parameter_msg() for c in changes])
        return graph.call(SetParameters, '/boxreg_node/set_parameters', request).results

    changes = {'solver__rounds': 2, 'transform_timeout': 1, 'vehicle__names': ['ute']}
    assert all(result.successful for result in set_to(**changes))
    for invalid, words in [
        ({'solver__rounds': 0}, ('solver.rounds', '1')),
        ({'solver__rounds': 'many'}, ('INTEGER', 'STRING')),
        ({'window': 5}, ('window', 'read-only')),
        ({'vehicle__names': [1]}, ('STRING_ARRAY', 'INTEGER_ARRAY')),
    ]:
        (result,) = set_to(**invalid)
        assert not result.successful
        assert all(word in result.reason for word in words), result.reason
    answer = graph.call(Trigger, '/boxreg_node/save_config', Trigger.Request())
    assert (answer.success, answer.message) == (True, str(file))
    expected = {'solver.rounds': 2, 'vehicle.names': ['ute'], 'window': 8, 'lag': 7}
    assert Config.from_yaml(file) == Config().updated(expected)
    assert 'transform_timeout: 1.0' in file.read_text()  # an integer is accepted for a real
    assert graph.call(Trigger, '/boxreg_node/reset', Trigger.Request()).success
    folder = tmp_path / 'folder'
    folder.mkdir()
    for invalid_file in (tmp_path / 'missing' / 'saved.yaml', folder, Path('/')):
        set_to(config_file=str(invalid_file))
        answer = graph.call(Trigger, '/boxreg_node/save_config', Trigger.Request())
        assert not answer.success
        assert 'config_file' in answer.message
    assert not list(tmp_path.glob('.*.partial'))
    assert ended_cleanly(node)
    # The saved file starts a node of another name in another namespace.
    renamed = ('-r', '__ns:=/front', '-r', '__node:=refiner')
    again = graph.start('--params-file', str(file), *renamed)
    request = GetParameters.Request(names=['transform_timeout'])
    (timeout,) = graph.call(GetParameters, '/front/refiner/get_parameters', request).values
    assert timeout.double_value == 1.0
    assert ended_cleanly(again)
    assert 'unknown parameters' not in again.output()


def test_coast_may_be_set_while_the_node_runs(graph, tmp_path):
    drive = Drive(sweeps=9)
    for index in (5, 6):
        drive.replace('/boxes', index, lambda message: message.detections.pop(0))
    records = records_of(drive.write(tmp_path / 'drive'))
    node = graph.run(records, *QUICK)
    begun = first_sweeps(records, 6)
    node.play(begun)
    request = SetParameters.Request(parameters=[Parameter('coast', value=0.5).to_parameter_msg()])
    (result,) = graph.call(SetParameters, '/boxreg_node/set_parameters', request).results
    assert result.successful
    node.play(records[len(begun) :])
    assert ended_cleanly(node)
    assert 'failed' not in node.output()
    assert [len(message.detections) for message in node.early] == [2] * 5 + [1] + [2] * 3


def test_time_jump_with_sim_time_and_silence_after_it(graph, tmp_path):
    first, second = (
        records_of(shifted(Drive(sweeps=8), seconds).write(tmp_path / f'drive{seconds}'))
        for seconds in (30, 0)
    )
    clock = graph.publisher('rosgraph_msgs/msg/Clock', '/clock')
    node = graph.run(first, *QUICK, '-p', 'use_sim_time:=true', '-p', 'backlog:=60.0')
    begun = next(i for i, record in enumerate(first) if record.topic == '/points') + 1
    for record in first[:begun]:
        graph.publishers[record.topic].publish(record.data)
    text = '/clock: use_sim_time is set'
    graph.wait(lambda: node.diagnostics and text in node.diagnostics[-1].status[1].message, text)
    assert node.values()['newest transform, age [s]'] == 'none'
    assert text in node.output()
    rest = first[begun:]
    for records, sec in ((rest, START // SECOND + 31), (second, START // SECOND + 1)):
        message = import_message('rosgraph_msgs/msg/Clock')()
        message.clock.sec = sec
        clock.publish(message)
        node.play(records)
    # The last boxes are published after 3 s without boxes, and every message exactly once.
    graph.wait(lambda: len(node.final) == 16, 'final boxes after a silence')
    graph.wait(lambda: node.values().get('final_published') == '16', 'counters')
    values = node.values()
    assert values['time_jump'] == '1'
    assert 'late' not in values
    assert 'no_transform' not in values  # the transform before the first array is kept
    assert 0.0 < float(values['newest transform, age [s]']) < 1.0
    stamps = [START + 30 * SECOND + k * SECOND // 10 for k in range(8)]
    stamps += [stamp_ns - 30 * SECOND for stamp_ns in stamps]
    assert sorted(stamp_of(message) for message in node.final) == sorted(stamps)
    assert ended_cleanly(node)


def test_second_node_continues_after_the_first_was_killed(graph, tmp_path):
    records = records_of(Drive(sweeps=12).write(tmp_path / 'drive'))
    half = [i for i, record in enumerate(records) if record.topic == '/boxes'][5] + 1
    shown = graph.collect(MARKERS, '/refined_markers')
    node = graph.run(records, *QUICK)
    node.play(records[:half])
    for _ in range(10):  # markers are published after their boxes
        graph.executor.spin_once(timeout_sec=0.05)
    node.kill()
    count = len(shown)
    left = graph.endpoints()
    # The static transform is sent again, and may come behind the first clouds.
    second = graph.start(*RELIABLE, *QUICK, '-p', 'transform_timeout:=20.0')
    graph.wait_until_connected(left)
    node.play(records[half:])
    graph.wait(lambda: len(shown) > count, 'markers')
    assert shown[count].markers[0].action == 3  # deletes those of the first node
    assert ended_cleanly(second)
    assert [stamp_of(message) for message in node.early] == Drive(sweeps=12).stamps


def test_boxes_wait_half_a_second_for_clouds_after_the_lidar_stops(graph, tmp_path):
    records = records_of(Drive(sweeps=12).write(tmp_path / 'drive'))
    node = graph.run(records, *QUICK)
    half = [i for i, record in enumerate(records) if record.topic == '/boxes'][5] + 1
    node.play(records[:half])
    play(graph, [record for record in records[half:] if record.topic != '/points'])
    graph.wait(lambda: len(node.early) == 12, 'boxes without their clouds')
    graph.wait(lambda: int(node.values().get('no_sweep', 0)) >= 12, 'counters')
    slowest = [values_of([d]).get('latency most [ms]', 0) for d in node.diagnostics]
    assert 500.0 <= max(map(float, slowest)) < 2900.0  # silence gives up boxes after 3 s
    assert ended_cleanly(node)


def test_a_recording_is_refined_at_every_rate_and_in_each_loop(graph, tmp_path):
    records = records_of(Drive(sweeps=14).write(tmp_path / 'drive'))  # stamps go back by > 1 s
    graph.publisher('rosgraph_msgs/msg/Clock', '/clock')
    node = graph.run(records, *QUICK, '-p', 'use_sim_time:=true')
    for loop, rate in enumerate((0.5, 1, 2, 2)):
        play_in_time(graph, records, rate)
        graph.wait(lambda n=loop: len(node.early) == 14 * (n + 1), 'early boxes')
    graph.wait(lambda: node.values().get('time_jump') == '3', 'counters')
    assert ended_cleanly(node)
    for loop in range(4):
        part = slice(14 * loop, 14 * loop + 14)
        assert numbers_changed(node.early[part], records) == [0, 0, *[2] * 12]
        assert numbers_changed(node.final[part], records) == [2] * 14


def stepped(seconds):
    """Return a drive of 16 sweeps whose clock is stepped before the ninth."""
    drive = Drive(sweeps=16)
    whole = drive.items
    drive.items = [item for item in whole if item[1] >= drive.stamps[8]]
    shifted(drive, seconds)
    drive.items = whole
    return drive


def without(topic, first, last, sweeps):
    """Return a drive without the messages of a topic from one sweep to another, both included."""
    drive = Drive(sweeps=sweeps)
    gap = drive.stamps[first], drive.stamps[last]
    drive.items = [i for i in drive.items if i[0] != topic or not gap[0] <= i[1] <= gap[1]]
    return drive


@pytest.mark.parametrize(
    ('drive', 'refined'),
    [
        pytest.param(stepped(2), [0, 0, *[2] * 6] * 2, id='clock steps forward by 2 s'),
        pytest.param(stepped(-2), [0, 0, *[2] * 6] * 2, id='clock steps back by 2 s'),
        pytest.param(
            without('/points', 6, 9, 16), [0, 0, *[2] * 4, *[0] * 4, *[2] * 6], id='LiDAR restarts'
        ),
    ],
)
def test_boxes_are_refined_again_after_a_disturbance(graph, tmp_path, drive, refined):
    """With two tracks: the number of early boxes refined at each sweep."""
    records = records_of(drive.write(tmp_path / 'drive'))
    node = graph.run(records, *QUICK, '-p', 'transform_timeout:=20.0')
    node.play(records)
    assert ended_cleanly(node)
    assert numbers_changed(node.early, records) == refined


def test_boxes_are_refined_again_after_tf_stopped_for_a_second(graph, tmp_path):
    """The last transform is extrapolated by up to 0.2 s."""
    records = records_of(without('/tf', 4, 13, 20).write(tmp_path / 'drive'))
    node = graph.run(records, *QUICK, '-p', 'transform_timeout:=1.0')
    ends = [i + 1 for i, record in enumerate(records) if record.topic == '/boxes']
    node.play(records[: ends[3]])
    play(graph, records[ends[3] : ends[13]])  # all wait for transforms at the same time
    graph.wait(lambda: len(node.early) == 14, 'boxes without transforms')
    node.play(records[ends[13] :])
    assert ended_cleanly(node)
    refined = [0, 0, *[2] * 4, *[0] * 8, *[2] * 6]
    assert numbers_changed(node.early, records) == refined


def malformed_messages():
    """Yield (topic, message) with contradictory layouts, invalid numbers and missing frames."""
    drive = Drive(sweeps=1)
    cloud_kind, boxes_kind = import_message(POINTS), import_message(DETECTIONS)
    good = next(message for topic, _, message in drive.items if topic == '/points')
    for name, value in [
        ('width', 10**6), ('width', 2**32 - 1), ('height', 2**31), ('point_step', 0),
        ('point_step', 3), ('row_step', 2**32 - 1), ('data', []), ('fields', []), ('fields', 'x'),
        ('datatype', 0), ('datatype', 99), ('count', 4096), ('offset', 2**31), ('frame', ''),
        ('values', np.nan), ('values', np.inf), ('values', 1e38),
    ]:  # fmt: skip
        cloud = cloud_kind(
            height=good.height, width=good.width, point_step=good.point_step,
            row_step=good.row_step,
        )  # fmt: skip
        cloud.header.frame_id = '' if name == 'frame' else 'lidar'
        cloud.header.stamp.sec = START // SECOND
        for field in good.fields:
            item = import_message('sensor_msgs/msg/PointField')(
                name=field.name, offset=field.offset, datatype=field.datatype, count=1
            )
            if name in ('datatype', 'count', 'offset'):
                setattr(item, name, value)
            cloud.fields.append(item)
        data = good.data.tobytes()
        if name == 'values':
            data = np.full(len(data) // 4, value, np.float32).tobytes()
        cloud.data.frombytes(data)
        if name in ('width', 'height', 'point_step', 'row_step'):
            setattr(cloud, name, value)
        elif name == 'data':
            cloud.data = value
        elif name == 'fields':
            cloud.fields = cloud.fields[: len(value)]
        yield '/points', cloud
    for number, value in enumerate([np.nan, np.inf, -1.0, 0.0, 1e300]):
        boxes = boxes_kind()
        boxes.header.frame_id = 'lidar' if number else 'nowhere'
        boxes.header.stamp.sec, boxes.header.stamp.nanosec = START // SECOND, number
        for row in range(3):
            box = import_message('vision_msgs/msg/Detection3D')(id='' if row == 2 else 'same')
            box.bbox.size.x = box.bbox.center.position.x = value
            box.bbox.center.orientation.w = 1.0 if row else value
            boxes.detections.append(box)
        yield '/boxes', boxes
    yield '/boxes', boxes_kind()


def test_malformed_messages_are_counted_and_others_are_refined(graph, tmp_path):
    drive = Drive(sweeps=6)
    records = records_of(shifted(drive, 5).write(tmp_path / 'drive'))
    parameters = ('-p', 'transform_timeout:=0.05', '-p', 'queue:=100')
    node = graph.run(records, *QUICK, *parameters)
    play(graph, [record for record in records if record.topic.startswith('/tf')])
    for topic, message in malformed_messages():
        graph.publishers[topic].publish(message)
        for _ in range(4):
            graph.executor.spin_once(timeout_sec=0.02)
    # A thousand tracks in one message.
    crowd = import_message(DETECTIONS)()
    crowd.header.frame_id = 'lidar'
    crowd.header.stamp.sec = START // SECOND + 4
    for number in range(1000):
        box = import_message('vision_msgs/msg/Detection3D')(id=str(number))
        box.bbox.center.position.x = 2.0 * number
        box.bbox.size.x = box.bbox.size.y = box.bbox.size.z = 1.0
        crowd.detections.append(box)
    cloud = import_message(POINTS)()
    cloud.header = crowd.header
    graph.publishers['/points'].publish(cloud)
    graph.publishers['/boxes'].publish(crowd)
    node.play([r for r in records if not r.topic.startswith('/tf')])
    graph.wait(lambda: int(node.values().get('final_published', 0)) >= 12, 'counters')
    values = {k: int(v) for k, v in node.values().items() if v.isdigit()}
    assert values['unreadable'] > 8
    assert 'failed' not in values, node.output()
    assert values['refined'] > 0
    assert ended_cleanly(node)
    # Every box message is published once, malformed ones included.
    assert len(node.early) == len(node.final) == 6 + 6 + 1
    of_drive = [m for m in node.final if stamp_of(m) >= START + 5 * SECOND]
    for message in of_drive[2:]:
        array = vision.from_msg(message)
        k = drive.stamps.index(array.stamp_ns - 5 * SECOND)
        error = array.boxes[:, :3] + [0.5 * k, 0, 2.0] - drive.truth[drive.stamps[k]][:, :3]
        assert np.abs(error).max() < 0.4


@pytest.fixture
def domain():
    """Return the environment with another ROS domain."""
    return {**os.environ, 'ROS_DOMAIN_ID': str(next_domain())}


LOAD = [*MEASURE, 'node', '--tracks=3', '--points=3000']


def test_boxes_are_refined_after_the_publisher_was_killed_and_restarted(domain, graph, tmp_path):
    domain['ROS_DOMAIN_ID'] = str(graph.domain)
    diagnostics = graph.collect(DIAGNOSTICS, '/diagnostics')
    node = graph.start('-p', 'window:=5', '-p', 'lag:=2')
    command = [*LOAD, '--role=publish', f'--log={tmp_path / "sent"}', '--seconds=60']

    def refined():
        return int(values_of(diagnostics).get('refined', 0))

    for _ in range(2):
        before = refined()
        publisher = subprocess.Popen(command, cwd=ROOT, env=domain)
        try:
            graph.wait(lambda n=before: refined() > n + 30, 'refined boxes')
        finally:
            publisher.send_signal(signal.SIGKILL)
            publisher.wait()
    graph.wait(lambda: 'nothing received' in diagnostics[-1].status[0].message, 'a warning')
    _, handles, _, _ = vitals(node.popen.pid)
    assert handles < 100
    assert ended_cleanly(node)
    assert Path(f'/proc/{node.popen.pid}').exists() is False
