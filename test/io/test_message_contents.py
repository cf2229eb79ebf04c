"""Boxes of recorded messages: read as arrays, and the same as by the adapters of objects."""

from boxreg_ros.io.recording import Recording
from boxreg_ros.io.transform_tree import TransformTree
from msg_adapters.convention import Convention
from msg_adapters.serialized import BOX_FIELDS, BoxReader
import numpy as np
import pytest
from ros_messages import DETECTIONS, Drive, JSK, Messages, START, write_recording
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

M = Messages()
FOUND = [
    (k + 1, ((20.0 + 9 * k, -3.0, 1.0), (0, 0, np.sin(0.1 * k), np.cos(0.1 * k))), (4, 2, 1.5))
    for k in range(5)
]
SCALED = Convention(pose_reference='bottom', size_order='wlh', forward_axis='y+', associate=True)


def equal(first, second):
    """Return whether two arrays of boxes are the same."""
    texts = [(b.stamp_ns, b.frame_id, b.track_ids, b.class_names) for b in (first, second)]
    arrays = [np.column_stack([b.scores, b.boxes]) for b in (first, second)]
    return texts[0] == texts[1] and np.array_equal(*arrays, equal_nan=True)


@pytest.mark.parametrize('convention', [Convention(associate=True), SCALED])
@pytest.mark.parametrize('kind', BOX_FIELDS)
def test_boxes_are_read_without_objects_and_are_the_same(tmp_path, monkeypatch, kind, convention):
    message = M.boxes(kind, START, 'lidar', FOUND)
    items = [
        ('/points', START, M.points(START, 'lidar', np.ones((9, 3)))),
        ('/boxes', START, message),
    ]
    path = write_recording(tmp_path / 'drive', items)
    with Recording([path], convention=convention) as recording:
        record = next(recording._read({'/boxes'}))
        contents, decoder = recording._contents, recording.decoder
        by_objects = contents.of('/boxes', decoder.message(record))
        monkeypatch.setattr(decoder, 'decoded', None)
        boxes = contents.boxes(record.connection, record.data)
    assert len(boxes.boxes) == 5
    assert equal(boxes, by_objects)


@pytest.mark.parametrize('kind', [DETECTIONS, JSK])
def test_sizes_of_another_type_in_a_definition_are_read_by_objects(tmp_path, kind):
    own = Messages()
    own.store = get_typestore(Stores.EMPTY)
    single = get_types_from_msg('float32 x\nfloat32 y\nfloat32 z', 'geometry_msgs/msg/Vector3')
    own.store.register({**M.store.fielddefs, **single})
    items = [
        ('/points', START, own.points(START, 'lidar', np.ones((9, 3)))),
        ('/boxes', START, own.boxes(kind, START, 'lidar', FOUND)),
    ]
    path = write_recording(tmp_path / 'drive', items, messages=own)
    with Recording([path], convention=Convention(associate=True)) as recording:
        record = next(recording._read({'/boxes'}))
        boxes = recording._contents.boxes(record.connection, record.data)
    np.testing.assert_array_equal(boxes.boxes[:, 3:6], [FOUND[0][2]] * 5)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3', 'rosbag1'])
def test_boxes_of_a_drive_are_those_of_the_objects(tmp_path, monkeypatch, storage):
    """Those of ROS 1 are objects, since nothing in its messages shows that they are not CDR."""
    drive = Drive(sweeps=4, boxes='markers', ros1=storage == 'rosbag1')
    read = []
    boxes_of = BoxReader.boxes_of
    monkeypatch.setattr(
        BoxReader, 'boxes_of', lambda *args: read.append(boxes_of(*args)) or read[-1]
    )
    path = drive.write(tmp_path / 'drive', storage)
    with Recording([path]) as recording:
        items = list(recording.items(TransformTree()))
        arrays = [item.content for item in items if hasattr(item.content, 'boxes')]
        records = list(recording._read({recording.boxes_topic}))
        contents, decoder = recording._contents, recording.decoder
        expected = [contents.of(recording.boxes_topic, decoder.message(r)) for r in records]
    assert bool(read) == (storage != 'rosbag1')
    assert len(arrays) == 4 and all(map(equal, arrays, expected))


def test_bytes_behind_a_message_are_another_definition(tmp_path):
    """As for rosbags, which refuses them: only padding to whole numbers of 4 bytes may follow."""
    path = Drive(sweeps=1).write(tmp_path / 'drive')
    with Recording([path]) as recording:
        record = next(recording._read({'/boxes'}))
        read = recording._contents._reader_of(record.connection).ordinary
        assert read(record.data) is not None
        assert read(record.data + b'\0\0\0') is not None
        assert read(record.data + bytes(8)) is None
