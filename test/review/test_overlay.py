"""overlay.mcap: the whole recording and the refined boxes."""

from collections import Counter

from boxreg_ros.config import Config
from boxreg_ros.errors import ConfigError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.labels import Provenance, writer_for
from boxreg_ros.offline.relabel import relabel, Request
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from mcap_files import add_messages
from msg_adapters import adapter_for
import numpy as np
import pytest
from ros_messages import Drive, START, typestore, write_recording
from rosbags.highlevel import AnyReader
from rosbags.typesys import get_typestore, Stores

MARKERS = 'visualization_msgs/msg/MarkerArray'
ADDED = ('/boxes_refined', '/boxes_refined_markers')
QUICK = Config().updated({'solver.rounds': 1, 'sampling.points': 64})


def run(recordings, out, formats=('mcap',), config=QUICK, **options):
    recordings = recordings if isinstance(recordings, tuple) else (recordings,)
    request = Request(recordings, formats=formats, config=config, **options)
    return relabel(request, out)


def messages_of(path):
    """Return messages (topic, log time, publish time, sequence, data) and channels of a file."""
    with path.open('rb') as file:
        reader = make_reader(file)
        items = [(s, c, m) for s, c, m in reader.iter_messages()]
    rows = [(c.topic, m.log_time, m.publish_time, m.sequence, m.data) for _, c, m in items]
    facts = {
        c.topic: (s.name, s.encoding, s.data, c.message_encoding, c.metadata) for s, c, _ in items
    }
    return rows, facts


def expected_boxes(out, drive, stamp_ns, sensor_z=2.0):
    """Return the boxes of boxes.csv at a stamp, transformed to the sensor frame."""
    table = BoxTable.read(out / 'boxes.csv')
    rows = table.boxes[table.stamps_ns == stamp_ns]
    # The sensor moves 0.5 m along x per sweep, 2 m above ground, and does not rotate.
    rows[:, 0] -= 0.5 * drive.stamps.index(stamp_ns)
    rows[:, 2] -= sensor_z
    return rows


@pytest.mark.parametrize('storage', ['mcap', 'mcap-folder', 'sqlite3'])
@pytest.mark.parametrize('boxes', ['vision', 'markers'])
def test_all_messages_are_copied_and_refined_boxes_added(tmp_path, storage, boxes):
    drive = Drive(sweeps=6, boxes=boxes)
    path = drive.write(tmp_path / 'drive', storage)
    summary = run(path, tmp_path / 'out')
    with AnyReader([path]) as reader:
        before = [(c.topic, t, bytes(data)) for c, t, data in reader.messages()]
        kinds = {c.topic: (c.msgtype, c.ext) for c in reader.connections}
    with AnyReader([tmp_path / 'out' / 'overlay.mcap']) as reader:
        after = [(c.topic, t, bytes(data)) for c, t, data in reader.messages()]
        copied = {c.topic: (c.msgtype, c.ext) for c in reader.connections}
        given = {t: data for topic, t, data in after if topic == '/boxes'}
        adapter = adapter_for(kinds['/boxes'][0])
        refined = [
            (
                t,
                reader.deserialize(data, kinds['/boxes'][0]),
                reader.deserialize(given[t], kinds['/boxes'][0]),
            )
            for topic, t, data in after
            if topic == '/boxes_refined'
        ]
    assert sorted(item for item in after if item[0] not in ADDED) == sorted(before)
    assert [t for _, t, _ in after] == sorted(t for _, t, _ in after)
    assert copied.pop('/boxes_refined') == kinds['/boxes']
    assert copied.pop('/boxes_refined_markers')[0] == MARKERS
    assert copied == kinds
    assert [t for t, *_ in refined] == drive.stamps
    assert summary.status['refined'] > 0
    moved = 0.0
    for stamp_ns, message, original in refined:
        found = adapter.from_msg(message)
        boxes_in = adapter.from_msg(original)
        assert (found.stamp_ns, found.frame_id) == (stamp_ns, 'lidar')
        assert (found.track_ids, found.class_names) == (boxes_in.track_ids, boxes_in.class_names)
        np.testing.assert_array_equal(found.scores, boxes_in.scores)
        expected = expected_boxes(tmp_path / 'out', drive, stamp_ns)
        np.testing.assert_allclose(found.boxes, expected, atol=1e-6)
        moved = max(moved, np.abs(found.boxes - boxes_in.boxes).max())
    assert moved > 0.01


@pytest.mark.parametrize('storage', ['mcap', 'rosbag1'])
def test_markers_of_input_and_refined_boxes(tmp_path, storage):
    drive = Drive(sweeps=4, ros1=storage == 'rosbag1')
    run(drive.write(tmp_path / 'drive', storage), tmp_path / 'out')
    rows, facts = messages_of(tmp_path / 'out' / 'overlay.mcap')
    store = get_typestore(Stores.ROS1_NOETIC if drive.messages.ros1 else Stores.ROS2_JAZZY)
    decode = store.deserialize_ros1 if drive.messages.ros1 else store.deserialize_cdr
    found = {t: decode(data, MARKERS) for topic, t, *_, data in rows if topic == ADDED[1]}
    assert list(found) == drive.stamps
    assert facts[ADDED[1]][0] == MARKERS.replace('/msg/', '/' if drive.messages.ros1 else '/msg/')
    for stamp_ns, message in found.items():
        cubes = [m for m in message.markers if m.ns == 'refined' and m.type == 1]
        boxes = expected_boxes(tmp_path / 'out', drive, stamp_ns)
        places = [(m.pose.position.x, m.pose.position.y, m.pose.position.z) for m in cubes]
        np.testing.assert_allclose(places, boxes[:, :3], atol=1e-6)
        assert {m.header.frame_id for m in cubes} == {'lidar'}
        texts = [m.text for m in message.markers if m.ns == 'id' and m.action == 0]
        assert texts == ['1', '2']


def test_boxes_recorded_at_another_time_get_the_time_of_their_clouds(tmp_path):
    drive = Drive(sweeps=8)
    day_ns = 86_400 * 10**9
    parts = (
        [item for item in drive.items if item[0] != '/boxes'],
        [(topic, t + day_ns, m) for topic, t, m in drive.items if topic == '/boxes'],
    )
    names = zip('ab', parts, strict=True)
    paths = tuple(write_recording(tmp_path / name, part) for name, part in names)
    for part, stamps in (({}, drive.stamps), ({'start': 0.25, 'end': 0.55}, drive.stamps[3:6])):
        summary = run(paths, tmp_path / 'out', **part)
        rows, _ = messages_of(tmp_path / 'out' / 'overlay.mcap')
        for topic in ('/points', '/boxes', *ADDED):
            times = [row[1:3] for row in rows if row[0] == topic]
            assert times == [(t, t) for t in stamps]
        assert summary.left_out_of_labels == {}


def test_ros1_recording_gives_a_ros1_overlay(tmp_path):
    drive = Drive(sweeps=4, ros1=True)
    path = drive.write(tmp_path / 'drive', 'rosbag1')
    run(path, tmp_path / 'out')
    with AnyReader([path]) as reader:
        before = [(c.topic, t, bytes(data)) for c, t, data in reader.messages()]
        store = reader.typestore
    rows, facts = messages_of(tmp_path / 'out' / 'overlay.mcap')
    after = [(topic, t, data) for topic, t, _, _, data in rows]
    assert sorted(item for item in after if item[0] not in ADDED) == sorted(before)
    name, encoding, definition, message_encoding, metadata = facts['/boxes_refined']
    assert (name, encoding, message_encoding) == (
        'vision_msgs/Detection3DArray', 'ros1msg', 'ros1',
    )  # fmt: skip
    assert b'vision_msgs/Detection3D[] detections' in definition
    assert set(metadata) == {'callerid', 'latching', 'md5sum'}
    kind = 'vision_msgs/msg/Detection3DArray'
    for topic, stamp_ns, data in after:
        if topic == '/boxes_refined':
            found = adapter_for(kind).from_msg(store.deserialize_ros1(data, kind))
            expected = expected_boxes(tmp_path / 'out', drive, stamp_ns)
            np.testing.assert_allclose(found.boxes, expected, atol=1e-6)


def test_attachments_metadata_and_sequence_numbers_are_copied(tmp_path):
    drive = Drive(sweeps=3)
    plain = drive.write(tmp_path / 'plain')
    path = tmp_path / 'rich.mcap'
    writer = McapWriter(str(path))
    writer.start('ros2')
    add_messages(writer, plain, early_ns=5, sequence=42)
    writer.add_attachment(1, 2, 'calibration.json', 'application/json', b'{}')
    writer.add_metadata('weather', {'rain': 'no'})
    writer.finish()
    run(path, tmp_path / 'out')
    rows, facts = messages_of(tmp_path / 'out' / 'overlay.mcap')
    assert sorted(row for row in rows if row[0] not in ADDED) == messages_sorted(path)
    assert facts['/boxes_refined'] == facts['/boxes']
    assert {(topic, log - publish, n) for topic, log, publish, n, _ in rows} >= {
        ('/boxes_refined', 5, 42)
    }
    with (tmp_path / 'out' / 'overlay.mcap').open('rb') as file:
        reader = make_reader(file)
        assert reader.get_header().profile == 'ros2'
        (attachment,) = reader.iter_attachments()
        notes = {note.name: note.metadata for note in reader.iter_metadata()}
    assert (attachment.name, attachment.data) == ('calibration.json', b'{}')
    assert notes['weather'] == {'rain': 'no'}
    assert notes['boxreg_ros']['recordings'] == 'rich.mcap'
    assert len(notes['boxreg_ros']['config_hash']) == 16


def messages_sorted(path):
    return sorted(messages_of(path)[0])


def test_boxes_stay_in_their_own_frame(tmp_path):
    drive = Drive(sweeps=5)
    for _, _, message in drive.items:
        if hasattr(message, 'detections'):
            message.header.frame_id = 'base'
            for detection in message.detections:
                detection.header.frame_id = 'base'
                detection.bbox.center.position.z += 2.0
    run(drive.write(tmp_path / 'drive'), tmp_path / 'out')
    kind = 'vision_msgs/msg/Detection3DArray'
    rows, _ = messages_of(tmp_path / 'out' / 'overlay.mcap')
    found = [row for row in rows if row[0] == '/boxes_refined']
    assert len(found) == 5
    for _, stamp_ns, _, _, data in found:
        boxes = adapter_for(kind).from_msg(typestore().deserialize_cdr(data, kind))
        assert boxes.frame_id == 'base'
        expected = expected_boxes(tmp_path / 'out', drive, stamp_ns, sensor_z=0.0)
        np.testing.assert_allclose(boxes.boxes, expected, atol=1e-6)


def test_overlay_of_a_part_has_all_static_transforms(tmp_path):
    drive = Drive(sweeps=10)
    run(drive.write(tmp_path / 'drive'), tmp_path / 'out', start=0.25, end=0.75)
    rows, _ = messages_of(tmp_path / 'out' / 'overlay.mcap')
    times = {topic: [t for name, t, *_ in rows if name == topic] for topic, *_ in rows}
    assert times['/boxes_refined'] == times['/boxes'] == drive.stamps[3:8]
    assert times['/tf_static'] == [START]
    assert len(times['/points']) == 5


@pytest.mark.parametrize('late_ns', [0, 10**6, 4 * 10**8])
def test_messages_of_files_that_overlap_are_read_once(tmp_path, late_ns):
    """As of two recorders, or of one that keeps the time before each event."""
    drive = Drive(sweeps=9)
    whole = run(drive.write(tmp_path / 'whole'), tmp_path / 'once', ('csv', 'mcap'))
    again = [(topic, at + late_ns, message) for topic, at, message in drive.items[7:]]
    parts = drive.items[:-6], again
    paths = tuple(write_recording(tmp_path / f'part{i}', part) for i, part in enumerate(parts))
    summary = run(paths, tmp_path / 'out', ('csv', 'mcap'))
    assert (summary.boxes_in, summary.sweeps) == (whole.boxes_in, whole.sweeps) == (18, 9)
    assert 'are read once: /points 5, /boxes 5' in summary.warning
    written = [(tmp_path / out / 'boxes.csv').read_text() for out in ('once', 'out')]
    assert written[0] == written[1]
    rows, _ = messages_of(tmp_path / 'out' / 'overlay.mcap')
    counts = Counter(topic for topic, *_ in rows)
    assert (counts['/boxes'], *(counts[topic] for topic in ADDED)) == (14, 9, 9)


def test_several_recordings_give_one_overlay(tmp_path):
    drive = Drive(sweeps=6)
    half = len(drive.items) // 2
    parts = tuple(
        write_recording(tmp_path / f'part{i}', part)
        for i, part in enumerate([drive.items[half:], drive.items[:half]])
    )
    run(parts, tmp_path / 'out')
    rows, _ = messages_of(tmp_path / 'out' / 'overlay.mcap')
    assert len([row for row in rows if row[0] not in ADDED]) == len(drive.items)
    assert [t for topic, t, *_ in rows if topic == '/boxes_refined'] == drive.stamps
    assert [t for _, t, *_ in rows] == sorted(t for _, t, *_ in rows)


def test_empty_messages_and_messages_out_of_order(tmp_path):
    drive = Drive(sweeps=6)
    drive.replace('/boxes', 1, lambda message: setattr(message, 'detections', []))
    at = [i for i, item in enumerate(drive.items) if item[0] == '/boxes']
    # The boxes of sweep 3 are received after those of sweep 4.
    late = drive.items.pop(at[3])
    drive.items.insert(at[4], ('/boxes', drive.stamps[4] + 1, late[2]))
    summary = run(drive.write(tmp_path / 'drive'), tmp_path / 'out')
    rows, _ = messages_of(tmp_path / 'out' / 'overlay.mcap')
    times = [t for topic, t, *_ in rows if topic == '/boxes_refined']
    assert times == [t for topic, t, *_ in rows if topic == '/boxes']
    assert len(times) == 6
    assert summary.left_out_of_labels == {}


def test_boxes_without_transform_are_unchanged(tmp_path):
    drive = Drive(sweeps=6)
    gone = drive.stamps[:4]
    drive.items = [item for item in drive.items if item[0] != '/tf' or item[1] not in gone]
    path = drive.write(tmp_path / 'drive')
    summary = run(path, tmp_path / 'out')
    assert summary.reasons['no_transform'] > 0
    rows, _ = messages_of(tmp_path / 'out' / 'overlay.mcap')
    assert len([row for row in rows if row[0] == '/boxes_refined']) == 6
    kind = 'vision_msgs/msg/Detection3DArray'
    first = {
        row[0]: adapter_for(kind).from_msg(typestore().deserialize_cdr(row[4], kind))
        for row in rows
        if row[1] == drive.stamps[0] and row[0] in ('/boxes', '/boxes_refined')
    }
    np.testing.assert_allclose(first['/boxes_refined'].boxes, first['/boxes'].boxes, atol=1e-9)


def test_an_overlay_can_be_relabelled_again(tmp_path):
    drive = Drive(sweeps=4)
    run(drive.write(tmp_path / 'drive'), tmp_path / 'one')
    run(tmp_path / 'one' / 'overlay.mcap', tmp_path / 'two', boxes='/boxes')
    rows, _ = messages_of(tmp_path / 'two' / 'overlay.mcap')
    count = {topic: sum(row[0] == topic for row in rows) for topic, *_ in rows}
    assert count['/boxes'] == count['/boxes_refined'] == count['/boxes_refined_refined'] == 4


def test_overlay_without_a_recording_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"'mcap' copies a recording.*another format"):
        writer_for('mcap', tmp_path, Provenance())
    assert not list(tmp_path.iterdir())


def test_overlay_with_points_writes_clouds(tmp_path):
    """--with-points writes points and intensities of the recording as PCD files."""
    drive = Drive(sweeps=3)
    m = drive.messages
    for i, (topic, stamp_ns, message) in enumerate(drive.items):
        if topic == '/points':
            xyz = np.frombuffer(message.data.tobytes(), '<f4').reshape(-1, 3)
            bright = np.arange(len(xyz)) + 0.5
            columns = [(name, 'f4', xyz[:, k]) for k, name in enumerate('xyz')]
            cloud = m.cloud(stamp_ns, 'lidar', [*columns, ('intensity', 'f4', bright)])
            drive.items[i] = (topic, stamp_ns, cloud)
    from boxreg_ros.labels import Options

    options = Options(with_points=True)
    run(drive.write(tmp_path / 'drive'), tmp_path / 'out', ('sustechpoints',), options=options)
    clouds = sorted((tmp_path / 'out' / 'sustechpoints' / 'lidar').iterdir())
    assert [path.stem for path in clouds] == [str(stamp) for stamp in drive.stamps]
    header, data = clouds[0].read_bytes().split(b'DATA binary\n')
    assert b'FIELDS x y z intensity\n' in header
    table = np.frombuffer(data, '<f4').reshape(-1, 4)
    np.testing.assert_array_equal(table[:, :3], xyz_of(drive, 0))
    np.testing.assert_array_equal(table[:, 3], np.arange(len(table)) + 0.5)
    assert not list((tmp_path / 'out').glob('.clouds'))


def xyz_of(drive, index):
    message = [item[2] for item in drive.items if item[0] == '/points'][index]
    return np.frombuffer(message.data.tobytes(), '<f4').reshape(-1, 4)[:, :3]
