"""The boxes of the node equal those of `boxreg relabel`."""

import csv
import json

from boxreg_ros.cli import main
from boxreg_ros.core.latency import NOTABLE
from boxreg_ros.io.velocity_table import read_velocities
from boxreg_ros.rotations import matrix_from_rpy
from lidar_drives import LidarDrive
from msg_adapters import adapter_for, ADAPTERS, WITHOUT_IDS
from msg_adapters.clouds import COMPRESSED_TYPE
from msg_adapters.poses import quaternions_of
import numpy as np
from preloaded import NODE, PATIENT_NODE
import pytest
from ros_graph import ended_cleanly, graph_in, play, records_of, RELIABLE, ROOT, stamp_of
from ros_messages import (
    DETECTIONS,
    Drive,
    JSK,
    MARKERS,
    OBJECTS,
    OBJECTS_WITH_COVARIANCE,
    PREDICTED,
    SECOND,
    TRACKED,
)

NUMBERS = ['x', 'y', 'z', 'qx', 'qy', 'qz', 'qw', 'length', 'width', 'height']
SETTINGS = {'window': 5, 'lag': 3}
UNHURRIED = ['transform_timeout:=20.0', 'backlog:=60.0', 'deadline:=60.0']
"""So that on a busy machine no transform is extrapolated, and no box left out for its deadline."""


MOVING_TYPES = (TRACKED, PREDICTED, OBJECTS, OBJECTS_WITH_COVARIANCE)
"""Types with ids that have a twist."""


def relabelled(path, out, *more, settings=SETTINGS):
    """Return (stamp, track) -> x y z qx qy qz qw length width height of `boxreg relabel`."""
    options = [f'--set={key}={value}' for key, value in settings.items()]
    command = ['relabel', str(path), '-o', str(out), '--set=estimate=final', '--formats=csv']
    assert main([*command, *options, *more]) == 0
    with (out / 'boxes.csv').open() as file:
        rows = list(csv.DictReader(file))
    assert sum(row['status'] == 'refined' for row in rows) > len(rows) / 2
    return {
        (int(row['stamp_ns']), row['track_id']): [float(row[column]) for column in NUMBERS]
        for row in rows
    }


def as_published(messages, type_name, frames=None):
    """
    Return (stamp, track) -> x y z qx qy qz qw length width height of messages.

    `frames` has the frame of each stamp; all are in odom without.

    """
    found = {}
    for message in messages:
        array = adapter_for(type_name).from_msg(message)
        frame = 'odom' if frames is None else frames[array.stamp_ns]
        rows = as_rows([message], type_name, frame)
        for track_id, row in zip(array.track_ids, rows, strict=True):
            assert (array.stamp_ns, track_id) not in found
            found[array.stamp_ns, track_id] = row
    return found


def as_rows(messages, type_name, frame='odom'):
    """Return x y z qx qy qz qw length width height of all boxes in messages, in a frame."""
    arrays = [adapter_for(type_name).from_msg(message) for message in messages]
    assert {array.frame_id for array in arrays} == {frame}
    boxes = np.concatenate([array.boxes for array in arrays])
    return np.hstack([boxes[:, :3], quaternions_of(boxes), boxes[:, 3:6]])


@pytest.mark.parametrize(
    'recording', ['vision-tf', 'vision-visible', 'markers-odometry', 'street']
)
def test_final_boxes_equal_those_of_relabel(tmp_path, recording):
    if recording == 'street':
        path, boxes_topic = ROOT / 'bags' / 'street.mcap', '/detections'
        changes = {}
    else:
        boxes, motion = recording.split('-')
        changes = {'sampling.box_time': 0.15} if boxes == 'markers' else {}
        if motion == 'visible':
            motion, changes = 'tf', {'sampling.box_extents': 'visible'}
        path = Drive(sweeps=10, boxes=boxes, motion=motion).write(tmp_path / 'drive')
        boxes_topic = '/boxes'
    expected = relabelled(path, tmp_path / 'out', *(f'--set={k}={v}' for k, v in changes.items()))
    records = records_of(path, boxes_topic)
    (type_name,) = {record.type_name for record in records if record.topic == boxes_topic}
    parameters = [f'{key}:={value}' for key, value in changes.items()]
    final = final_of_node(tmp_path, records, *parameters, boxes=(type_name, boxes_topic))
    # Boxes that the node held when it received the signal are included.
    assert_equal_boxes(as_published(final, type_name), expected)
    assert [stamp_of(message) for message in final] == sorted({stamp for stamp, _ in expected})


def final_of_node(tmp_path, records, *parameters, boxes=(DETECTIONS, '/boxes')):
    """Return the final boxes of the node for records, with boxes of a type on a topic."""
    options = [f'{key}:={value}' for key, value in SETTINGS.items()]
    return boxes_of_node(tmp_path, records, *parameters, *options, boxes=boxes)[1]


def boxes_of_node(
    tmp_path, records, *parameters, boxes=(DETECTIONS, '/boxes'), ahead=0, program=PATIENT_NODE
):
    """
    Return early and final boxes of the node for records, with boxes of a type on a topic.

    At most `ahead` messages of boxes are published whose early boxes have not been received.

    """
    type_name, boxes_topic = boxes
    options = [*UNHURRIED, 'output_frame:=odom', *parameters]
    topics = {record.topic for record in records if record.topic not in ('/tf', '/tf_static')}
    options += [
        f'qos_overrides.{topic}.subscription.reliability:=reliable' for topic in sorted(topics)
    ]
    every = [part for option in options for part in ('-p', option)]
    with graph_in(tmp_path) as graph:
        every += ['-r', f'boxes:={boxes_topic}']
        node = graph.run(records, *every, kind=type_name, command=[program])
        played = 0
        for record in records:
            play(graph, [record])
            played += record.boxes_stamp_ns is not None
            graph.wait(lambda n=played: len(node.early) >= n - ahead, 'early boxes')
        graph.wait(lambda: len(node.early) >= played, 'all early boxes')
        assert ended_cleanly(node)
        return node.early, node.final


def assert_same_numbers(messages, out):
    """
    Demand the boxes of published detections to be those of boxes.csv, with the same frames.

    The published numbers are the same to the last digit. Messages without a refined box that are
    in their own frame are published unchanged: there the boxes are the same to the last digit as
    the adapter reads them, but the file has the quaternions of their angles.

    """
    with (out / 'boxes.csv').open() as file:
        rows = list(csv.DictReader(file))
    refined = {int(row['stamp_ns']) for row in rows if row['status'] == 'refined'}
    expected = {
        (int(row['stamp_ns']), row['track_id']): [float(row[name]) for name in NUMBERS]
        for row in rows
    }
    frames = {int(row['stamp_ns']): row['frame_id'] for row in rows}
    assert [stamp_of(message) for message in messages] == sorted(frames)
    found = as_published(messages, DETECTIONS, frames)
    assert found.keys() == expected.keys()
    for message in messages:
        for detection in message.detections:
            key = stamp_of(message), detection.id
            numbers = numbers_of(detection.bbox)
            if key[0] not in refined and numbers != expected[key]:
                numbers = found[key]
            np.testing.assert_array_equal(numbers, expected[key])


def numbers_of(bbox):
    """Return x y z qx qy qz qw length width height of a vision_msgs/BoundingBox3D."""
    place, turn, size = bbox.center.position, bbox.center.orientation, bbox.size
    return [
        *(getattr(place, axis) for axis in 'xyz'),
        *(getattr(turn, axis) for axis in 'xyzw'),
        *(getattr(size, axis) for axis in 'xyz'),
    ]


def assert_equal_boxes(found, expected):
    assert found.keys() == expected.keys()
    keys = sorted(expected)
    difference = np.abs(np.array([found[k] for k in keys]) - [expected[k] for k in keys])
    assert difference.max() < 1e-6


def late(
    drive, seconds, jitter=0.0, frame='lidar', lost=(), behind=0.0, swapped=False, gap=(0, 0)
):
    """
    Return a drive whose boxes are stamped and received later, up to the last transform.

    They go on for so long `behind` it [s].

    `jitter` [s] is the largest deviation from `seconds`; boxes in the frame odom are where their
    objects were. The clouds of the sweeps in `lost` are left out. Where `swapped`, every second
    cloud is received after the next one and its boxes. The first such cloud has no boxes: whether
    these wait for it depends on which of both the node receives first. With a `gap` the vehicle
    drives curves that tighten, without transforms from its first sweep on until the last one.

    """
    rng = np.random.default_rng(0)
    lost_ns = {drive.stamps[k] for k in lost}
    last_ns = max(received for topic, received, _ in drive.items if topic == '/tf')
    first_ns, end_ns = (drive.stamps[k] for k in gap)
    items = []
    for topic, received, message in drive.items:
        if topic == '/tf' and end_ns > first_ns:
            (transform,) = message.transforms
            after = (stamp_of(transform) - first_ns) / SECOND
            transform.transform.translation.y += after**3 / 3
            if 0 <= after < (end_ns - first_ns) / SECOND:
                continue
        if topic != '/boxes':
            is_lost = topic in ('/points', '/front', '/rear') and stamp_of(message) in lost_ns
            if swapped and topic == '/points' and drive.stamps.index(stamp_of(message)) % 2:
                received += round(0.15 * SECOND)
            items += [] if is_lost else [(topic, received, message)]
            continue
        measured_ns = stamp_of(message)
        if swapped and measured_ns == drive.stamps[1]:
            continue
        delay_ns = round((seconds + rng.uniform(-jitter, jitter)) * SECOND)
        header = drive.messages.header(measured_ns + delay_ns, frame)
        for detection in message.detections:
            detection.header = header
            if frame == 'odom':
                position = detection.bbox.center.position
                position.x += 5.0 * (measured_ns - drive.stamps[0]) / SECOND
                position.z += 2.0
        message.header = header
        if measured_ns + delay_ns <= last_ns + round(behind * SECOND):
            items.append((topic, max(received, measured_ns + delay_ns), message))
    drive.items = sorted(items, key=lambda item: item[1])
    return drive


LATE = {
    'in time, clouds lost': (0.0, {'lost': (0, 1, 9)}),
    'late': (0.2, {}),
    'late, fixed frame, cloud lost': (0.2, {'frame': 'odom', 'lost': (14,)}),
    'jitter, two LiDARs': (0.2, {'jitter': 0.03}),
    'in time, clouds swapped': (0.0, {'swapped': True}),
    '30 ms behind clouds': (0.03, {}),
    '50 ms before clouds': (-0.05, {}),
    'in time, no transforms for 0.4 s': (0.0, {'gap': (12, 15)}),
    'late, behind the last transform': (0.5, {'behind': 1.0}),
}


@pytest.mark.parametrize('case', LATE)
def test_early_and_final_boxes_are_those_of_relabel_by_default(tmp_path, case):
    """With the settings of both: each estimates the latency of the boxes from what it knows."""
    seconds, more = LATE[case]
    has_two = 'two' in case
    drive = LidarDrive(34) if has_two else Drive(sweeps=34)
    path = late(drive, seconds, **more).write(tmp_path / 'drive')
    options = ['--points', '/front', '--points', '/rear'] if has_two else []
    parameters = ['points:=[/front, /rear]'] if has_two else []
    program = PATIENT_NODE
    if 'behind the last' in case:  # their transforms and clouds never come
        parameters.append('transform_timeout:=1.0')
        program = NODE
    records = records_of(path)
    early, final = boxes_of_node(tmp_path, records, *parameters, ahead=4, program=program)
    for estimate, messages in (('early', early), ('final', final)):
        out = tmp_path / estimate
        relabelled(path, out, *options, f'--set=estimate={estimate}', settings={})
        assert_same_numbers(messages, out)
    summary = json.loads((out / 'summary.json').read_text())
    latency = summary['box_time']['latency']['seconds']
    assert latency == pytest.approx(seconds if abs(seconds) > NOTABLE else 0.0, abs=0.03)


def test_missed_detections_are_added_live_and_offline(tmp_path):
    drive = Drive(sweeps=12)
    missed = [message for topic, _, message in drive.items if topic == '/boxes'][6:8]
    for message in missed:
        del message.detections[0]
    path = drive.write(tmp_path / 'drive')
    expected = relabelled(path, tmp_path / 'out', '--set=coast=0.5')
    assert len(expected) == 24
    summary = json.loads((tmp_path / 'out' / 'summary.json').read_text())
    assert (summary['boxes_in'], summary['status']['coasted']) == (22, 2)
    final = final_of_node(tmp_path, records_of(path), 'coast:=0.5')
    assert_equal_boxes(as_published(final, DETECTIONS), expected)


@pytest.mark.parametrize('clouds', ['topics', 'compressed', 'info'])
def test_two_lidars_give_the_same_boxes_live_and_offline(tmp_path, clouds):
    path = LidarDrive(8, clouds).write(tmp_path / 'drive')
    options = [] if clouds == 'info' else ['--points', '/front', '--points', '/rear']
    expected = relabelled(path, tmp_path / 'out', *options)
    summary = json.loads((tmp_path / 'out' / 'summary.json').read_text())
    assert summary['sweeps'] == 8
    parameters = ['points_info:=/points_info']
    if clouds != 'info':
        assert summary['lidars'] == {'/front': {'merged': 8}, '/rear': {'merged': 8}}
        parameters = ['points:=[/front, /rear]']
    if clouds == 'compressed':
        parameters.append(f'points_type:={COMPRESSED_TYPE}')
    final = final_of_node(tmp_path, records_of(path), *parameters)
    assert_equal_boxes(as_published(final, DETECTIONS), expected)


@pytest.mark.parametrize('type_name', [t for t in ADAPTERS if t not in (DETECTIONS, MARKERS)])
def test_publisher_node_and_subscriber_of_every_family(tmp_path, type_name):
    """Publisher and node are processes. Associated ids are the same in node and `relabel`."""
    drive = Drive(sweeps=8, boxes=type_name)
    path = drive.write(tmp_path / 'drive')
    associate = type_name in WITHOUT_IDS
    options = ['--associate'] if associate else []
    expected = relabelled(path, tmp_path / 'out', *options)
    if associate:
        summary = json.loads((tmp_path / 'out' / 'summary.json').read_text())
        assert (summary['ids'], summary['associated_tracks']) == ('by association', 2)
    with graph_in(tmp_path) as graph:
        final = graph.collect(type_name, '/refined_boxes_final')
        diagnostics = graph.collect('diagnostic_msgs/msg/DiagnosticArray', '/diagnostics')
        settings = [*UNHURRIED, 'output_frame:=odom']
        settings += [f'{key}:={value}' for key, value in SETTINGS.items()]
        settings += [f'boxes_type:={type_name}'] + ['associate:=true'] * associate
        node = graph.start(*RELIABLE, *[part for item in settings for part in ('-p', item)])
        graph.wait_until_connected()
        graph.start_player(path)
        graph.wait(lambda: len(final) >= 8 - SETTINGS['lag'], 'final boxes')
        if associate:
            graph.wait(lambda: 'by association' in str(diagnostics), 'diagnostics')
        node.stop()
        assert node.popen.returncode == 0, node.output()
    assert [stamp_of(message) for message in final] == drive.stamps
    rows = as_rows(final, type_name)
    assert np.abs(rows - list(expected.values())).max() < 1e-6
    ids = [track_id for _, track_id in expected]
    assert ids == ids[:2] * 8  # stable
    if type_name in MOVING_TYPES:
        assert_same_velocities(final, type_name, tmp_path / 'out' / 'velocities.csv')


def assert_same_velocities(messages, type_name, path):
    """Compare the published twists, in the axes of the boxes or of the frame, with the table."""
    known = read_velocities(path)
    assert len(known) > len(messages)
    compared = 0
    for message in messages:
        boxes = adapter_for(type_name).from_msg(message)
        for track_id, box, item in zip(boxes.track_ids, boxes.boxes, message.objects, strict=True):
            record = known.get((boxes.stamp_ns, track_id))
            if record is None:
                continue
            kinematics = getattr(item, 'kinematics', None)
            if kinematics is None:
                twist, R = getattr(item.twist, 'twist', item.twist), np.eye(3)
            else:
                prefix = 'initial_' if hasattr(kinematics, 'predicted_paths') else ''
                twist = getattr(kinematics, f'{prefix}twist_with_covariance').twist
                R = matrix_from_rpy(box[6:])
            found = R @ [twist.linear.x, twist.linear.y, twist.linear.z]
            expected = record['velocity']
            np.testing.assert_allclose([*found, twist.angular.z], expected, rtol=1e-6, atol=1e-6)
            compared += 1
    assert compared == len(known)


def test_missing_ids_are_assigned_by_node_and_relabel(tmp_path):
    drive = Drive(sweeps=8)
    for message in [message for topic, _, message in drive.items if topic == '/boxes']:
        for detection in message.detections:
            detection.id = ''
    path = drive.write(tmp_path / 'drive')
    expected = relabelled(path, tmp_path / 'out')
    assert {track_id for _, track_id in expected} == {'1', '2'}
    final = final_of_node(tmp_path, records_of(path))
    assert_equal_boxes(as_published(final, DETECTIONS), expected)


def test_boxes_without_ids_are_refused_by_node_and_relabel(tmp_path, capsys):
    path = Drive(sweeps=2, boxes=JSK).write(tmp_path / 'drive')
    assert main(['relabel', str(path), '-o', str(tmp_path / 'out')]) == 1
    assert '--associate' in capsys.readouterr().err
    with graph_in(tmp_path) as graph:
        node = graph.start('-p', f'boxes_type:={JSK}')
        node.is_ending = True
        graph.wait(lambda: node.popen.poll() is not None, 'the node to give up')
        assert node.popen.returncode == 1
        assert 'associate:=true' in node.output()
