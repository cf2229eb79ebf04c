"""Recordings of every storage: items, definitions, motion, parts and errors."""

from contextlib import closing
import sqlite3

from boxreg_ros.errors import RecordingError, TransformUnavailable, UnsupportedMessage
from boxreg_ros.io.lidars import Lidars
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.resync import MessageOrder
from boxreg_ros.io.storage.files import opened, part_of
from boxreg_ros.io.storage.reader import Reader
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.structures import BoxArray, Sweep
from mcap_files import rewritten
import numpy as np
import pytest
from ros_messages import Drive, Messages, SECOND, START, typestore, write_recording
from rosbags.typesys import get_types_from_msg

M = Messages()


def read(paths, tree=None, fixed_frame=None, **options):
    """Return all sweeps and box arrays of recordings, and the fixed frame."""
    tree = tree or TransformTree()
    with Recording(paths if isinstance(paths, list) else [paths], **options) as recording:
        fixed_frame = recording.choose_fixed_frame(tree, fixed_frame)
        items = [item.content for item in recording.items(tree)]
        for error in recording.first_errors.values():
            raise error
    sweeps = [item for item in items if isinstance(item, Sweep)]
    return sweeps, [item for item in items if isinstance(item, BoxArray)], fixed_frame


def error_of(paths, **options):
    """Return the one-line message of the error that reading recordings raises."""
    with pytest.raises((RecordingError, UnsupportedMessage)) as caught:
        read(paths, **options)
    text = str(caught.value)
    assert '\n' not in text
    return text


def test_single_db3_and_folder_without_metadata(tmp_path):
    folder = Drive().write(tmp_path / 'drive', 'sqlite3')
    (file,) = folder.glob('*.db3')
    assert len(read(file)[0]) == 8
    (folder / 'metadata.yaml').unlink()
    assert len(read(folder)[0]) == 8


def test_split_recordings_are_merged_by_time(tmp_path):
    drive = Drive(sweeps=9)
    parts = [drive.items[0::2], drive.items[1::2]]
    paths = [
        write_recording(tmp_path / f'part{i}', part, 'mcap', drive.messages)
        for i, part in enumerate(parts)
    ]
    sweeps, arrays, _ = read(paths[::-1])
    assert [sweep.stamp_ns for sweep in sweeps] == drive.stamps
    assert [array.stamp_ns for array in arrays] == drive.stamps


def test_a_later_part_without_static_transforms_names_the_first(tmp_path):
    drive = Drive(ros1=True, boxes='markers')
    half = len(drive.items) // 2
    parts = [
        write_recording(tmp_path / f'drive_{i}.bag', part, 'rosbag1', drive.messages)
        for i, part in enumerate([drive.items[:half], drive.items[half:]])
    ]
    text = error_of(parts[1])
    assert 'give the first file of the drive too, which may alone have its static' in text
    sweeps, _, fixed_frame = read(parts)
    assert (len(sweeps), fixed_frame) == (8, 'odom')
    drive.items = [item for item in drive.items if 'tf' not in item[0]]
    text = error_of(drive.write(tmp_path / 'without', 'rosbag1'))
    assert 'first file' not in text


def test_parts_are_in_the_order_of_their_numbers(tmp_path):
    """As rosbag2 names them without padding: 10 behind 9."""
    folder = tmp_path / 'drive'
    folder.mkdir()
    names = [f'2026_11_26-drive_{number}.mcap' for number in range(12)]
    for name in reversed(names):
        (folder / name).touch()
    assert [file.name for file in part_of(folder).files] == names


# Definitions -----------------------------------------------------------------------------------


@pytest.mark.parametrize('pattern', ["'%Detection%'", "'%'"])
def test_missing_definitions_are_replaced_by_known_ones(tmp_path, pattern):
    folder = Drive().write(tmp_path / 'drive', 'sqlite3')
    (file,) = folder.glob('*.db3')
    with sqlite3.connect(file) as database:
        count = database.execute('SELECT count(*) FROM message_definitions').fetchone()[0]
        database.execute(f'DELETE FROM message_definitions WHERE topic_type LIKE {pattern}')
        assert database.execute('SELECT count(*) FROM message_definitions').fetchone()[0] < count
    database.close()
    _, arrays, _ = read(folder)
    assert [array.track_ids for array in arrays] == [('1', '2')] * 8


# Motion ----------------------------------------------------------------------------------------


def test_transforms_are_read_ahead(tmp_path):
    items = Drive(sweeps=8).items
    late = [(t, stamp + SECOND // 2 * (t == '/tf'), message) for t, stamp, message in items]
    path = write_recording(tmp_path / 'late', sorted(late, key=lambda item: item[1]))
    tree = TransformTree()
    with Recording([path]) as recording:
        recording.choose_fixed_frame(tree)
        found = {}
        for item in recording.items(tree):
            stamp = item.content.stamp_ns
            found[stamp] = tree.lookup('odom', 'lidar', stamp)[0, 3]
    assert found == {START + k * SECOND // 10: 0.5 * k for k in range(8)}


def test_transforms_are_buffered_for_a_bounded_time(tmp_path):
    items = []
    for k in range(200):
        stamp = START + k * SECOND // 2
        items.append(('/tf', stamp, M.tf(M.transform(stamp, 'odom', 'lidar', (k, 0, 0)))))
        items.append(('/points', stamp, M.points(stamp, 'lidar', np.zeros((1, 3)))))
        items.append(('/boxes', stamp, M.detections(stamp, 'lidar', [])))
    path = write_recording(tmp_path / 'long', items)
    tree = TransformTree()
    with Recording([path]) as recording:
        recording.choose_fixed_frame(tree)
        for item in recording.items(tree):
            assert tree.covers('odom', 'lidar', item.received_ns)
            assert not tree.covers('odom', 'lidar', item.received_ns + 3 * SECOND)
            assert not tree.covers('odom', 'lidar', item.received_ns - 40 * SECOND)


def test_items_before_a_long_pause_have_transforms(tmp_path):
    pause = 3600 * SECOND
    drives = [Drive(), Drive(start=START + pause)]
    del drives[1].items[0]  # static transform: /tf is the first message after the pause
    paths = [drive.write(tmp_path / f'drive{k}') for k, drive in enumerate(drives)]
    tree = TransformTree()
    found = []
    with Recording(paths) as recording:
        recording.choose_fixed_frame(tree)
        for item in recording.items(tree):
            found.append(item.content.stamp_ns)
            tree.lookup('odom', 'lidar', found[-1])
    assert sorted(set(found)) == drives[0].stamps + drives[1].stamps


def test_static_transforms_apply_before_they_are_received(tmp_path):
    drive = Drive()
    topic, _, message = drive.items.pop(0)
    drive.items.append((topic, drive.stamps[-1], message))
    assert read(drive.write(tmp_path / 'drive'))[2] == 'odom'


def test_odometry_replaces_missing_tf(tmp_path):
    tree = TransformTree()
    drive = Drive(motion='odometry')
    assert read(drive.write(tmp_path / 'drive'), tree)[2] == 'odom'
    T = tree.lookup('odom', 'lidar', drive.stamps[3])
    np.testing.assert_allclose(T[:3, 3], [1.5, 0, 2])


def test_odometry_of_the_sensor_frame_needs_no_tf(tmp_path):
    drive = Drive(motion='none')
    drive.items = [item for item in drive.items if item[0] != '/tf_static']
    drive.items += [
        ('/odom', stamp, M.odometry(stamp, 'world', 'lidar', (1, 2, 3))) for stamp in drive.stamps
    ]
    path = drive.write(tmp_path / 'drive')
    tree = TransformTree()
    assert read(path, tree)[2] == 'world'
    np.testing.assert_array_equal(tree.lookup('world', 'lidar', START)[:3, 3], [1, 2, 3])


def test_odometry_of_an_unconnected_frame_is_named_in_the_error(tmp_path):
    drive = Drive(motion='none')
    drive.items.append(('/odom', START, M.odometry(START, 'world', 'trailer')))
    text = error_of(drive.write(tmp_path / 'drive'))
    assert 'odometry: /odom (world -> trailer)' in text
    assert 'base -> lidar' in text


def test_odometry_after_the_requested_part_is_ignored_if_tf_is_complete(tmp_path):
    drive = Drive(sweeps=10, motion='tf')
    stamp = drive.stamps[-1]
    drive.items.append(('/odom', stamp, M.odometry(stamp, 'world', 'base')))
    assert read(drive.write(tmp_path / 'drive'), end=0.5)[2] == 'odom'


def test_tf_is_preferred_to_odometry(tmp_path):
    drive = Drive(motion='tf')
    for stamp in drive.stamps:
        drive.items.append(('/odom', stamp, M.odometry(stamp, 'wheels', 'base', (99, 0, 0))))
        drive.items.append(('/odom2', stamp, M.odometry(stamp, 'wheels2', 'base', (99, 0, 0))))
    path = drive.write(tmp_path / 'drive')
    assert read(path)[2] == 'odom'
    assert read(path, odometry='/odom', fixed_frame='wheels')[2] == 'wheels'


def test_several_odometry_topics_are_listed_in_the_error(tmp_path):
    drive = Drive(motion='odometry')
    for stamp in drive.stamps:
        drive.items.append(('/fused', stamp, M.odometry(stamp, 'map', 'base', (0, 0, 0))))
        drive.items.append(('/other', stamp, M.odometry(stamp, 'map', 'wheel', (0, 0, 0))))
    path = drive.write(tmp_path / 'drive')
    text = error_of(path)
    assert '/fused, /odom;' in text
    assert '--odometry' in text
    assert read(path, odometry='/fused')[2] == 'map'
    assert read(path, odometry='/odom')[2] == 'odom'


def test_odometry_of_the_root_frame_of_tf(tmp_path):
    drive = Drive(motion='none')
    for stamp in drive.stamps:
        drive.items.append(('/tf', stamp, M.tf(M.transform(stamp, 'footprint', 'base'))))
        drive.items.append(('/odom', stamp, M.odometry(stamp, 'odom', 'footprint')))
    path = drive.write(tmp_path / 'drive')
    assert read(path)[2] == 'odom'


def test_a_stationary_sensor_needs_the_fixed_frame_as_an_option(tmp_path):
    path = Drive(motion='none').write(tmp_path / 'drive')
    text = error_of(path)
    assert "'lidar'" in text
    assert text.endswith('--fixed-frame base'), 'upright, as a tilted LiDAR is not'
    assert read(path, fixed_frame='lidar')[2] == 'lidar'
    assert read(path, fixed_frame='base')[2] == 'base', 'connected by static transforms'


def test_an_unknown_fixed_frame_is_refused(tmp_path):
    text = error_of(Drive().write(tmp_path / 'drive'), fixed_frame='world')
    assert "'world'" in text
    assert 'odom -> base' in text
    assert 'base -> lidar' in text


# Parts -----------------------------------------------------------------------------------------


def test_start_and_end_select_a_part(tmp_path):
    drive = Drive(sweeps=20)
    path = drive.write(tmp_path / 'drive')
    sweeps, arrays, _ = read(path, start=0.45, end=1.2)
    assert [sweep.stamp_ns for sweep in sweeps] == drive.stamps[5:12]
    assert [array.stamp_ns for array in arrays] == drive.stamps[5:12]
    text = error_of(path, start=5.0)
    assert '1.9 s' in text
    assert 'got 5 to the end' in text


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3', 'rosbag1'])
def test_a_part_of_a_file_has_its_first_time_but_not_its_last(tmp_path, storage):
    drive = Drive(sweeps=12, ros1=storage == 'rosbag1')
    items = sorted(drive.items, key=lambda item: item[0])  # one topic after the other
    path = write_recording(tmp_path / 'drive', items, storage, drive.messages, chunk_bytes=2_000)
    if storage == 'mcap':  # one message per chunk
        path = rewritten(path, tmp_path / 'chunks.mcap', chunk_size=1)
    received = sorted(time_ns for _, time_ns, _ in drive.items)
    start, stop = received[8], received[-8]
    with closing(opened(path if path.is_file() else next(path.glob('*.db3')))) as file:
        records = list(file.messages(file.connections, start, stop))
    times = [record.received_ns for record in records]
    assert times == [time_ns for time_ns in received if start <= time_ns < stop]
    assert start in times and stop in received and stop not in times


@pytest.mark.parametrize('late', [-3600, 3600])
def test_a_part_of_a_topic_recorded_apart_is_that_of_its_stamps(tmp_path, late):
    drive = Drive(sweeps=12)
    moved = [(t, at + late * SECOND, m) for t, at, m in drive.items if t == '/boxes']
    others = [item for item in drive.items if item[0] != '/boxes']
    paths = [
        write_recording(tmp_path / name, items) for name, items in (('a', others), ('b', moved))
    ]
    with closing(Reader([part_of(path) for path in paths])) as reader:

        def stamp_of(connection, data):
            stamp = drive.messages.store.deserialize_cdr(data, connection.msgtype).header.stamp
            return stamp.sec * SECOND + stamp.nanosec

        order = MessageOrder(reader, '/points', stamp_of)
        boxes = [c for c in reader.connections if c.topic == '/boxes']
        for start, stop in ((4, 8), (0, 12), (3, None), (None, 5)):
            limits = [None if i is None else [*drive.stamps, 2**62][i] for i in (start, stop)]
            found = [record.received_ns for record in order.messages(boxes, *limits)]
            assert found == drive.stamps[start:stop]


# Errors ----------------------------------------------------------------------------------------


def test_packets_of_a_lidar_name_what_converts_them(tmp_path):
    drive = Drive(sweeps=2)
    messages = drive.messages
    messages.store = typestore.__wrapped__()
    kind = 'velodyne_msgs/msg/VelodyneScan'
    text = 'std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets'
    packet = 'builtin_interfaces/Time stamp\nuint8[1206] data'
    messages.store.register(
        get_types_from_msg(text, kind)
        | get_types_from_msg(packet, 'velodyne_msgs/msg/VelodynePacket')
    )
    items = [item for item in drive.items if item[0] != '/points']
    items.append(('/velodyne_packets', START, messages.build(kind)))
    path = write_recording(tmp_path / 'packets', items, messages=messages)
    text = error_of(path)
    assert '/velodyne_packets (velodyne_msgs/msg/VelodyneScan)' in text
    assert 'convert them to points first' in text
    assert 'velodyne_transform_node of velodyne_pointcloud' in text


def test_unknown_topics_are_refused(tmp_path):
    path = Drive().write(tmp_path / 'drive')
    text = error_of(path, lidars=Lidars(('/lidar',)))
    assert "no topic '/lidar'" in text
    assert 'topics with point clouds: /points' in text
    assert 'topics with boxes: /boxes' in error_of(path, boxes='/objects')
    assert 'topics with odometry: none' in error_of(path, odometry='/odom')


def test_a_topic_of_another_type_is_refused(tmp_path):
    path = Drive().write(tmp_path / 'drive')
    text = error_of(path, boxes='/points')
    assert "topic '/points'" in text
    assert 'vision_msgs/msg/Detection3DArray' in text
    assert 'got sensor_msgs/msg/PointCloud2' in text
    assert 'got vision_msgs/msg/Detection3DArray' in error_of(path, lidars=Lidars(('/boxes',)))


@pytest.mark.parametrize(('topic', 'kind'), [('/points', 'point clouds'), ('/boxes', 'boxes')])
def test_a_recording_without_clouds_or_boxes_is_refused(tmp_path, topic, kind):
    drive = Drive()
    drive.items = [item for item in drive.items if item[0] != topic]
    text = error_of(drive.write(tmp_path / 'drive'))
    assert f'no {kind}' in text
    assert '/tf (tf2_msgs/msg/TFMessage)' in text
    assert ('--boxes none' in text) == (kind == 'boxes')


def test_topics_without_messages_are_named(tmp_path):
    drive = Drive()
    empty = drive.messages.detections(START, 'lidar', [])
    path = write_recording(
        tmp_path / 'drive',
        [*(item for item in drive.items if item[0] != '/boxes'), ('/late', START + SECOND, empty)],
    )
    cut = rewritten(path, tmp_path / 'cut.mcap', without=['/late'])
    assert 'no messages on /late' in error_of(cut)


def test_several_topics_of_one_kind_are_listed_in_the_error(tmp_path):
    drive = Drive()
    drive.items += [
        ('/rear', stamp, message) for t, stamp, message in drive.items if t == '/points'
    ]
    path = drive.write(tmp_path / 'drive')
    text = error_of(path)
    assert '/points, /rear' in text
    assert '--points' in text
    assert len(read(path, lidars=Lidars(('/rear',)))[0]) == 8


def test_files_that_are_no_recordings_are_refused(tmp_path):
    assert 'no such recording' in error_of(tmp_path / 'nothing.mcap')
    for name in ('empty.mcap', 'empty.db3', 'empty.bag'):
        (tmp_path / name).touch()
        assert name in error_of(tmp_path / name)
    for name in ('text.mcap', 'text.db3', 'text.bag', 'text.csv'):
        (tmp_path / name).write_text('this is no recording\n' * 100)
        assert name in error_of(tmp_path / name)
    (tmp_path / 'folder').mkdir()
    assert 'metadata.yaml' in error_of(tmp_path / 'folder')
    (tmp_path / 'folder' / 'metadata.yaml').write_text('rosbag2_bagfile_information: [')
    assert 'folder' in error_of(tmp_path / 'folder')


def test_a_recording_without_messages_is_refused(tmp_path):
    path = tmp_path / 'drive'
    write_recording(path, [], 'sqlite3')
    assert 'no point clouds' in error_of(path)


def test_ros1_and_ros2_recordings_cannot_be_merged(tmp_path):
    paths = [
        Drive().write(tmp_path / 'two'),
        Drive(ros1=True).write(tmp_path / 'one', 'rosbag1'),
    ]
    assert 'cannot be merged' in error_of(paths)


def test_a_message_that_contradicts_its_definition_is_refused(tmp_path):
    folder = Drive().write(tmp_path / 'drive', 'sqlite3')
    (file,) = folder.glob('*.db3')
    with sqlite3.connect(file) as database:
        database.execute(
            'UPDATE messages SET data = substr(data, 1, 40) WHERE topic_id = '
            "(SELECT id FROM topics WHERE name = '/boxes')"
        )
    database.close()
    assert "a message on '/boxes' is not a vision_msgs" in error_of(folder)


def test_the_error_of_an_unusable_message_names_the_topic(tmp_path):
    drive = Drive()
    drive.replace('/points', 2, lambda message: setattr(message, 'width', 10_000))
    text = error_of(drive.write(tmp_path / 'drive'))
    assert text.startswith("topic '/points': PointCloud2:")
    assert 'expected at least' in text


def test_a_failed_lookup_lists_the_known_transforms(tmp_path):
    tree = TransformTree()
    read(Drive().write(tmp_path / 'drive'), tree)
    with pytest.raises(TransformUnavailable, match='base -> lidar, odom -> base'):
        tree.lookup('map', 'lidar', START)
