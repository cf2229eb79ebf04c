"""Boxes of a recording, read as arrays by a compiled loop: the same as by objects."""

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.io.items import Wanted
from boxreg_ros.io.message_decoder import RecordedType
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.storage.record import Record
from boxreg_ros.io.transforms import TransformTree
from boxreg_ros.offline import reader
from boxreg_ros.offline.relabel import relabel, Request
from boxreg_ros.structures import BoxArray
from msg_adapters.convention import Convention
from msg_adapters.serialized import BOX_FIELDS
import numpy as np
import pytest
from relabel_results import QUICK
from ros_messages import Drive, JSK

ASSOCIATE = Convention(associate=True)
FLAWS = {
    'surplus bytes': lambda data: data + bytes(8),
    'missing bytes': lambda data: data[:-8],
    'no UTF-8': lambda data: data.replace(b'lidar\0', b'\xffidar\0', 1),
    'no end of a string': lambda data: data.replace(b'lidar\0', b'lidar1', 1),
}


def arrays_of(recording):
    """Return all box arrays of an open recording."""
    items = recording.items(TransformTree(), Wanted(clouds=False))
    return [item.content for item in items if isinstance(item.content, BoxArray)]


def assert_same(found, expected):
    assert len(found) == len(expected) > 0
    for one, other in zip(found, expected, strict=True):
        assert (one.stamp_ns, one.frame_id) == (other.stamp_ns, other.frame_id)
        assert (one.track_ids, one.class_names) == (other.track_ids, other.class_names)
        np.testing.assert_array_equal(one.scores, other.scores)
        # numpy 1.26 may round a function of one angle and of many apart, by 2^-52 of it.
        np.testing.assert_allclose(one.boxes, other.boxes, rtol=2**-52, atol=0)


@pytest.mark.parametrize('convention', [ASSOCIATE, Convention('bottom', associate=True)])
@pytest.mark.parametrize('type_name', BOX_FIELDS)
def test_boxes_are_the_same(tmp_path, monkeypatch, type_name, convention):
    path = Drive(sweeps=3, boxes=type_name).write(tmp_path / 'drive')
    with Recording([path], boxes='/boxes', convention=convention) as recording:
        expected = arrays_of(recording)
        recording.read_boxes_as_arrays()
        monkeypatch.setattr(recording, '_content', None)  # no objects of boxes
        assert_same(arrays_of(recording), expected)


@pytest.mark.parametrize('flaw', FLAWS)
def test_messages_that_rosbags_refuses_are_left_to_it(tmp_path, flaw):
    path = Drive(sweeps=1).write(tmp_path / 'drive')
    with Recording([path]) as recording:
        recording.read_boxes_as_arrays()
        (record,) = recording._read({recording.boxes_topic})
        assert recording._boxes_as_arrays(record) is not None
        bad = FLAWS[flaw](bytes(record.data))
        bad_record = Record(record.connection, record.received_ns, bad)
        assert recording._boxes_as_arrays(bad_record) is None
        with pytest.raises(UnsupportedMessage):
            recording._decoder.message(bad_record)


def test_other_recordings_are_read_by_objects(tmp_path, monkeypatch):
    for drive in (Drive(sweeps=2, ros1=True), Drive(sweeps=2, boxes=JSK)):
        storage = 'rosbag1' if drive.messages.ros1 else 'mcap'
        path = drive.write(tmp_path / storage, storage)
        with Recording([path], convention=ASSOCIATE) as recording:
            expected = arrays_of(recording)
            monkeypatch.delitem(recording.typestore.fielddefs, 'std_msgs/msg/Header')
            recording.read_boxes_as_arrays()
            assert recording._array_adapter is None
            assert_same(arrays_of(recording), expected)


def test_a_long_recording_is_read_as_arrays(tmp_path, monkeypatch):
    path = Drive(sweeps=12).write(tmp_path / 'drive')
    request = Request((path,), config=QUICK)
    relabel(request, tmp_path / 'short')
    monkeypatch.setattr(reader, 'LONG', 1.0)
    calls = []
    monkeypatch.setattr(Recording, 'read_boxes_as_arrays', lambda self: calls.append(self))
    relabel(Request((path,), config=QUICK.updated({'solver.threads': 1})), tmp_path / 'called')
    assert len(calls) == 1
    monkeypatch.undo()
    monkeypatch.setattr(reader, 'LONG', 1.0)
    relabel(request, tmp_path / 'long')
    for name in ('boxes.csv', 'covariances.csv', 'openlabel/labels.json'):
        assert (tmp_path / 'long' / name).read_bytes() == (tmp_path / 'short' / name).read_bytes()


def test_field_types_are_those_of_rclpy(tmp_path):
    with Recording([Drive(sweeps=1).write(tmp_path / 'drive')]) as recording:
        kind = RecordedType(recording.typestore, 'geometry_msgs/PoseWithCovariance')
        assert kind.get_fields_and_field_types() == {
            'pose': 'geometry_msgs/Pose',
            'covariance': 'double[36]',
        }
        kind = RecordedType(recording.typestore, 'vision_msgs/msg/Detection3DArray')
        assert kind.get_fields_and_field_types() == {
            'header': 'std_msgs/Header',
            'detections': 'sequence<vision_msgs/Detection3D>',
        }
