"""MCAP files of Foxglove's schemas: protobuf, JSON, and both mixed with ROS messages."""

from collections import deque
from dataclasses import replace
import json
import sys

from boxreg_ros.cli import main
from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.foxglove import encoded
from boxreg_ros.io.items import Wanted
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.structures import BoxArray, Sweep
from foxglove_recordings import KINDS, PointCloud, scene, SceneUpdate, write_foxglove_mcap
from mcap.reader import make_reader
from msg_adapters import adapter_for
import numpy as np
import pytest
from relabel_results import rows_in
from ros_messages import Drive, SCENE

FRAME = '{"timestamp": {"sec": %d, "nsec": %d}, "parent_frame_id": "odom", '
FRAME += '"child_frame_id": "base", "translation": {"x": %g, "y": 0, "z": 0}, '
FRAME += '"rotation": {"x": 0, "y": 0, "z": 0, "w": 1}}'


def of_foxglove(path, drive, motion):
    """
    Write a drive by the SDK of Foxglove: clouds as protobuf, and an update per object in JSON.

    The motion of the base is that of `motion`: FrameTransform in JSON, or Odometry; the place of
    the LiDAR on it are FrameTransforms in protobuf.

    """
    foxglove = pytest.importorskip('foxglove')
    from foxglove import messages as m

    with foxglove.open_mcap(str(path)):
        points, mount = (
            foxglove.Channel(
                '/points', schema=m.PointCloud.get_schema(), message_encoding='protobuf'
            ),
            foxglove.Channel(
                '/tf_static', schema=m.FrameTransforms.get_schema(), message_encoding='protobuf'
            ),
        )
        schemas = {
            name: foxglove.Schema(name=name, encoding='jsonschema', data=b'{"type": "object"}')
            for name in ('foxglove.FrameTransform', 'foxglove.SceneUpdate')
        }
        odometry = m.Odometry.get_schema()
        kinds = {'/boxes': (schemas['foxglove.SceneUpdate'], 'json')}
        kinds['/motion'] = (
            (odometry, 'protobuf') if motion == 'odometry'
            else (schemas['foxglove.FrameTransform'], 'json')
        )  # fmt: skip
        channels = {
            topic: foxglove.Channel(topic, schema=schema, message_encoding=encoding)
            for topic, (schema, encoding) in kinds.items()
        }
        for topic, received_ns, message in drive.items:
            write = {'/points': points, '/tf_static': mount}.get(topic)
            if topic == '/tf':
                (t,) = message.transforms
                x, stamp = t.transform.translation.x, t.header.stamp
                data = (' \n' + FRAME % (stamp.sec, stamp.nanosec, x)).encode()
                if motion == 'odometry':
                    data = m.Odometry(
                        timestamp=m.Timestamp(stamp.sec, stamp.nanosec), frame_id='odom',
                        body_frame_id='base',
                        pose=m.Pose(
                            position=m.Vector3(x=x, y=0, z=0),
                            orientation=m.Quaternion(x=0, y=0, z=0, w=1),
                        ),
                    ).encode()  # fmt: skip
                channels['/motion'].log(data, log_time=received_ns)
            elif topic == '/boxes':
                for n, entity in enumerate(scene(message, 'json')['entities']):
                    update = {'deletions': [], 'entities': [entity]}
                    data = (n * ' ' + json.dumps(update)).encode()
                    channels[topic].log(data, log_time=received_ns + n * 10**6)
            else:
                kind, convert = KINDS[message.__msgtype__]
                data = kind(**convert(message, 'protobuf')).SerializeToString()
                write.log(data, log_time=received_ns)
    return path


@pytest.mark.parametrize('motion', ['transforms', 'odometry'])
def test_one_file_may_mix_schemas_and_encodings_of_one_content(tmp_path, motion):
    drive = Drive(sweeps=3, boxes=SCENE)
    path = of_foxglove(tmp_path / 'drive.mcap', drive, motion)
    tree = TransformTree()
    with Recording([path]) as recording:
        assert recording.choose_fixed_frame(tree) == 'odom'
        found = [item.content for item in recording.items(tree)]
        assert not recording.unreadable
        T = tree.lookup('odom', 'lidar', drive.stamps[2])
        assert '3 messages have the stamp of the one before them' in recording.finding
    np.testing.assert_allclose(T[:3, 3], [1.0, 0.0, 2.0])  # 0.5 m per sweep, 2 m above the base
    boxes = [content for content in found if isinstance(content, BoxArray)]
    assert [array.track_ids for array in boxes] == [('1', '2')] * 3
    assert sum(isinstance(content, Sweep) for content in found) == 3


def test_an_update_per_object_gets_the_refined_boxes_of_its_object(tmp_path):
    drive = Drive(sweeps=4, boxes=SCENE)
    path = of_foxglove(tmp_path / 'drive.mcap', drive, 'transforms')
    expected = rows_of(drive.write(tmp_path / 'ros'), tmp_path / 'expected')
    out = tmp_path / 'out'
    assert main(['relabel', str(path), '-o', str(out), '--formats=mcap']) == 0
    assert rows_in(out / 'boxes.csv') == expected
    with (out / 'overlay.mcap').open('rb') as file:
        updates = [
            json.loads(m.data) for _, _, m in make_reader(file).iter_messages('/boxes_refined')
        ]
    ids = [[entity['id'] for entity in update['entities']] for update in updates]
    assert ids == [['1'], ['2']] * 4


def rows_of(path, out):
    """Relabel a recording; return the rows of boxes.csv."""
    assert main(['relabel', str(path), '-o', str(out), '--formats=csv']) == 0
    return rows_in(out / 'boxes.csv')


def test_a_foxglove_file_and_a_ros_recording_are_merged(tmp_path):
    drive = Drive(sweeps=5, boxes=SCENE)
    expected = rows_of(drive.write(tmp_path / 'ros'), tmp_path / 'expected')
    items = drive.items
    drive.items = [item for item in items if item[0] == '/boxes']
    foreign = write_foxglove_mcap(
        tmp_path / 'foreign.mcap', drive, {'/boxes': 'protobuf'} | {'/tf': 'cdr'}
    )
    drive.items = [item for item in items if item[0] != '/boxes']
    rest = drive.write(tmp_path / 'rest')
    command = ['relabel', str(foreign), str(rest), '-o', str(tmp_path / 'out'), '--formats=csv']
    assert main(command) == 0
    assert rows_in(tmp_path / 'out' / 'boxes.csv') == expected


@pytest.mark.parametrize('encoding', ['protobuf', 'json'])
def test_other_fields_are_copied_in_the_encoding_of_the_input(tmp_path, encoding):
    drive = Drive(sweeps=1, boxes=SCENE)
    path = write_foxglove_mcap(
        tmp_path / 'a.mcap', drive, {'/boxes': encoding, '/points': 'cdr', '/tf': 'cdr'}
    )
    with path.open('rb') as file:
        ((_, _, raw),) = make_reader(file).iter_messages('/boxes')
    with Recording([path]) as recording:
        (record,) = recording._records(TransformTree(), {'/boxes'}, deque())
        message = recording.decoder.message(record)
        adapter = adapter_for(SCENE)
        boxes = adapter.from_msg(message)
        longer = replace(boxes, boxes=boxes.boxes + np.array([0, 0, 0, 1, 0, 0, 0, 0, 0]))
        written = adapter.to_msg(message, longer)
        np.testing.assert_allclose(adapter.from_msg(written).boxes, longer.boxes, atol=1e-12)
        np.testing.assert_array_equal(adapter.from_msg(message).boxes, boxes.boxes)
        restored = encoded(adapter.to_msg(written, boxes))
        decoded = recording.decoder.decoded(record.connection, restored)
    np.testing.assert_allclose(adapter.from_msg(decoded).boxes, boxes.boxes, atol=1e-12)
    if encoding == 'json':
        old, new = json.loads(raw.data), json.loads(restored)
    else:
        old, new = SceneUpdate.FromString(raw.data), SceneUpdate.FromString(restored)
        assert [e.metadata[2].value for e in new.entities] == ['kept', 'kept']
        for item in (old, new):
            for entity in item.entities:
                entity.ClearField('cubes')
        assert old == new
        return
    for item in (old, new):
        for entity in item['entities']:
            assert entity.pop('cubes')[0]['color'] == {'r': 0, 'g': 1.0, 'b': 0, 'a': 0.5}
    assert old == new


def test_the_error_names_a_missing_package(tmp_path, monkeypatch, capsys):
    drive = Drive(sweeps=2, boxes=SCENE)
    path = write_foxglove_mcap(
        tmp_path / 'a.mcap', drive, {'/boxes': 'protobuf', '/points': 'cdr', '/tf': 'cdr'}
    )
    monkeypatch.setitem(sys.modules, 'mcap_protobuf.decoder', None)
    assert main(['relabel', str(path), '-o', str(tmp_path / 'out')]) == 1
    error = capsys.readouterr().err
    assert 'pip install mcap-protobuf-support' in error and "'/boxes'" in error


def test_clouds_with_a_pose_other_than_identity_are_refused(tmp_path):
    drive = Drive(sweeps=1, boxes=SCENE)
    path = write_foxglove_mcap(
        tmp_path / 'a.mcap', drive, {'/boxes': 'cdr', '/points': 'protobuf', '/tf': 'cdr'}
    )
    with Recording([path]) as recording:
        (connection,) = recording._topics.connections({'/points'})
        message = PointCloud(pose={'position': {'x': 1.0}, 'orientation': {'w': 1.0}})
        with pytest.raises(UnsupportedMessage, match='pose'):
            recording.decoder.decoded(connection, message.SerializeToString())


def test_the_error_of_invalid_json_names_the_topic(tmp_path):
    drive = Drive(sweeps=1, boxes=SCENE)
    path = write_foxglove_mcap(
        tmp_path / 'a.mcap', drive, {'/boxes': 'json', '/points': 'cdr', '/tf': 'cdr'}
    )
    match = r"'/boxes'.*not JSON"
    with Recording([path]) as recording:
        (connection,) = recording._topics.connections({'/boxes'})
        with pytest.raises(UnsupportedMessage, match=match):
            recording.box_message(connection, b'{"entities": [')


@pytest.mark.parametrize('encoding', ['protobuf', 'json'])
def test_overlay_has_refined_boxes_in_the_same_encoding(tmp_path, encoding):
    drive = Drive(sweeps=4, boxes=SCENE)
    encodings = {'/boxes': encoding, '/points': 'cdr', '/tf': 'cdr'}
    path = write_foxglove_mcap(tmp_path / 'drive.mcap', drive, encodings)
    assert main(['relabel', str(path), '-o', str(tmp_path / 'out'), '--formats=mcap']) == 0
    overlay = tmp_path / 'out' / 'overlay.mcap'
    table = BoxTable.read(tmp_path / 'out' / 'boxes.csv')
    with Recording([overlay], boxes='/boxes_refined') as recording:
        found = [item.content for item in recording.items(TransformTree(), Wanted(clouds=False))]
    assert [boxes.stamp_ns for boxes in found] == drive.stamps
    for k, boxes in enumerate(found):  # the LiDAR moves 0.5 m along x per sweep, at z = 2 m
        expected = table.boxes[table.stamps_ns == boxes.stamp_ns] - [0.5 * k, 0, 2, *[0] * 6]
        np.testing.assert_allclose(boxes.boxes, expected, atol=1e-6)
