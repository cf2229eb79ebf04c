"""MCAP files of foxglove's schemas: protobuf, JSON, and ROS beside them."""

from base64 import b64encode
import csv
from dataclasses import replace
import json
import sys

from boxreg_ros.cli import main
from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.foxglove_mcap import encoded
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.transforms import TransformTree
from mcap.reader import make_reader
from mcap.writer import Writer
from msg_adapters import adapter_for
import numpy as np
import pytest
from ros_messages import Drive, SCENE

SCHEMAS = 'foxglove_schemas_protobuf'
FrameTransforms = pytest.importorskip(f'{SCHEMAS}.FrameTransforms_pb2').FrameTransforms
PointCloud = pytest.importorskip(f'{SCHEMAS}.PointCloud_pb2').PointCloud
SceneUpdate = pytest.importorskip(f'{SCHEMAS}.SceneUpdate_pb2').SceneUpdate
describe = pytest.importorskip('mcap_protobuf.schema').build_file_descriptor_set

FLOAT32 = 7


def time_of(stamp, encoding):
    if encoding == 'json':
        return {'sec': stamp.sec, 'nsec': stamp.nanosec}
    return {'seconds': stamp.sec, 'nanos': stamp.nanosec}


def plain(message):
    """Return nested dicts of the geometry in a message."""
    if hasattr(message, '__dict__'):
        return {k: plain(v) for k, v in vars(message).items() if not k.startswith('__')}
    return message


def scene(message, encoding):
    return {
        'deletions': [],
        'entities': [
            {
                'timestamp': time_of(e.timestamp, encoding), 'frame_id': e.frame_id, 'id': e.id,
                'metadata': [{'key': m.key, 'value': m.value} for m in e.metadata],
                'cubes': [plain(cube) for cube in e.cubes],
            }
            for e in message.entities
        ],
    }  # fmt: skip


def cloud(message, encoding):
    data = bytes(message.data)
    return {
        'timestamp': time_of(message.header.stamp, encoding),
        'frame_id': message.header.frame_id,
        'point_stride': message.point_step,
        'fields': [{'name': f.name, 'offset': f.offset, 'type': FLOAT32} for f in message.fields],
        'data': b64encode(data).decode() if encoding == 'json' else data,
    }


def transforms(message, encoding):
    return {
        'transforms': [
            {
                'timestamp': time_of(t.header.stamp, encoding),
                'parent_frame_id': t.header.frame_id, 'child_frame_id': t.child_frame_id,
                'translation': plain(t.transform.translation),
                'rotation': plain(t.transform.rotation),
            }
            for t in message.transforms
        ]
    }  # fmt: skip


KINDS = {'/boxes': (SceneUpdate, scene), '/points': (PointCloud, cloud)}


def write(path, drive, encodings):
    """Write a drive with these encodings: of boxes, of clouds, of transforms."""
    store = drive.messages.store
    with path.open('wb') as file:
        writer = Writer(file)
        writer.start()
        channels = {}
        for topic, received_ns, message in drive.items:
            kind, convert = KINDS.get(topic, (FrameTransforms, transforms))
            encoding = encodings.get(topic, encodings['/tf'])
            if topic not in channels:
                name, form, text = kind.DESCRIPTOR.full_name, encoding, b'{}'
                if encoding == 'protobuf':
                    text = describe(kind).SerializeToString()
                elif encoding == 'json':
                    form = 'jsonschema'
                else:
                    name, form = message.__msgtype__, 'ros2msg'
                    text = store.generate_msgdef(name, ros_version=2)[0].encode()
                schema = writer.register_schema(name, form, text)
                channels[topic] = writer.register_channel(topic, encoding, schema)
            if encoding == 'cdr':
                data = bytes(store.serialize_cdr(message, message.__msgtype__))
            elif encoding == 'json':
                data = json.dumps(convert(message, encoding)).encode()
            else:
                data = kind(**convert(message, encoding)).SerializeToString()
            writer.add_message(channels[topic], received_ns, data, received_ns)
        writer.finish()
    return path


def rows_of(path, out):
    assert main(['relabel', str(path), '-o', str(out), '--formats=csv']) == 0
    with (out / 'boxes.csv').open() as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize(
    'encodings',
    [
        {'/boxes': 'protobuf', '/points': 'cdr', '/tf': 'cdr'},
        {'/boxes': 'json', '/points': 'cdr', '/tf': 'cdr'},
        {'/boxes': 'protobuf', '/points': 'protobuf', '/tf': 'protobuf'},
        {'/boxes': 'json', '/points': 'json', '/tf': 'json'},
    ],
    ids=lambda encodings: '-'.join(encodings.values()),
)
def test_the_same_boxes_come_from_any_encoding(tmp_path, encodings):
    drive = Drive(sweeps=5, boxes=SCENE)
    expected = rows_of(drive.write(tmp_path / 'ros'), tmp_path / 'expected')
    assert {row['status'] for row in expected} == {'refined'}
    path = write(tmp_path / 'foreign.mcap', drive, encodings)
    assert rows_of(path, tmp_path / 'out') == expected


def test_a_foreign_file_and_a_ros_recording_are_read_as_one(tmp_path):
    drive = Drive(sweeps=5, boxes=SCENE)
    expected = rows_of(drive.write(tmp_path / 'ros'), tmp_path / 'expected')
    items = drive.items
    drive.items = [item for item in items if item[0] == '/boxes']
    foreign = write(tmp_path / 'foreign.mcap', drive, {'/boxes': 'protobuf'} | {'/tf': 'cdr'})
    drive.items = [item for item in items if item[0] != '/boxes']
    rest = drive.write(tmp_path / 'rest')
    command = ['relabel', str(foreign), str(rest), '-o', str(tmp_path / 'out'), '--formats=csv']
    assert main(command) == 0
    with (tmp_path / 'out' / 'boxes.csv').open() as file:
        assert list(csv.DictReader(file)) == expected


@pytest.mark.parametrize('encoding', ['protobuf', 'json'])
def test_what_is_not_refined_survives_in_its_own_encoding(tmp_path, encoding):
    drive = Drive(sweeps=1, boxes=SCENE)
    path = write(tmp_path / 'a.mcap', drive, {'/boxes': encoding, '/points': 'cdr', '/tf': 'cdr'})
    with path.open('rb') as file:
        ((_, _, raw),) = make_reader(file).iter_messages('/boxes')
    with Recording([path]) as recording:
        (record,) = recording._records(TransformTree(), {'/boxes'})
        message = recording._message(record)
        adapter = adapter_for(SCENE)
        boxes = adapter.from_msg(message)
        longer = replace(boxes, boxes=boxes.boxes + np.array([0, 0, 0, 1, 0, 0, 0, 0, 0]))
        there = adapter.to_msg(message, longer)
        np.testing.assert_allclose(adapter.from_msg(there).boxes, longer.boxes, atol=1e-12)
        np.testing.assert_array_equal(adapter.from_msg(message).boxes, boxes.boxes)
        back = encoded(adapter.to_msg(there, boxes))
        again = recording._reader.deserialize(back, SCENE)
    np.testing.assert_allclose(adapter.from_msg(again).boxes, boxes.boxes, atol=1e-12)
    if encoding == 'json':
        old, new = json.loads(raw.data), json.loads(back)
    else:
        old, new = SceneUpdate.FromString(raw.data), SceneUpdate.FromString(back)
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


def test_a_package_that_is_missing_is_named(tmp_path, monkeypatch, capsys):
    drive = Drive(sweeps=2, boxes=SCENE)
    path = write(
        tmp_path / 'a.mcap', drive, {'/boxes': 'protobuf', '/points': 'cdr', '/tf': 'cdr'}
    )
    monkeypatch.setitem(sys.modules, 'mcap_protobuf.decoder', None)
    assert main(['relabel', str(path), '-o', str(tmp_path / 'out')]) == 1
    error = capsys.readouterr().err
    assert 'pip install mcap-protobuf-support' in error and "'/boxes'" in error


def test_clouds_with_a_pose_of_their_own_are_refused(tmp_path):
    drive = Drive(sweeps=1, boxes=SCENE)
    path = write(
        tmp_path / 'a.mcap', drive, {'/boxes': 'cdr', '/points': 'protobuf', '/tf': 'cdr'}
    )
    with Recording([path]) as recording:
        message = PointCloud(pose={'position': {'x': 1.0}, 'orientation': {'w': 1.0}})
        with pytest.raises(UnsupportedMessage, match='pose'):
            recording._reader.deserialize(
                message.SerializeToString() or b'', 'sensor_msgs/msg/PointCloud2'
            )


def test_bytes_that_are_no_message_are_told(tmp_path):
    drive = Drive(sweeps=1, boxes=SCENE)
    path = write(tmp_path / 'a.mcap', drive, {'/boxes': 'json', '/points': 'cdr', '/tf': 'cdr'})
    match = r"'/boxes'.*not JSON"
    with Recording([path]) as recording, pytest.raises(UnsupportedMessage, match=match):
        recording.box_message(b'{"entities": [')


@pytest.mark.parametrize('encoding', ['protobuf', 'json'])
def test_overlay_has_refined_boxes_in_the_same_encoding(tmp_path, encoding):
    drive = Drive(sweeps=4, boxes=SCENE)
    encodings = {'/boxes': encoding, '/points': 'cdr', '/tf': 'cdr'}
    path = write(tmp_path / 'drive.mcap', drive, encodings)
    assert main(['relabel', str(path), '-o', str(tmp_path / 'out'), '--formats=mcap']) == 0
    overlay = tmp_path / 'out' / 'overlay.mcap'
    table = BoxTable.read(tmp_path / 'out' / 'boxes.csv')
    with Recording([overlay], boxes='/boxes_refined') as recording:
        found = [item.content for item in recording.items(TransformTree(), with_clouds=False)]
    assert [boxes.stamp_ns for boxes in found] == drive.stamps
    for k, boxes in enumerate(found):  # the drive goes along x, 0.5 m per sweep, 2 m above
        expected = table.boxes[table.stamps_ns == boxes.stamp_ns] - [0.5 * k, 0, 2, *[0] * 6]
        np.testing.assert_allclose(boxes.boxes, expected, atol=1e-6)
