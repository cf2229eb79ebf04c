"""`boxreg relabel --label-points`, `--clouds`, `--undistort`: files, read by consumers."""

from contextlib import closing
import json

from boxreg_ros import cli
from boxreg_ros.config import Config
from boxreg_ros.errors import ConfigError
from boxreg_ros.io.fixed_frame import FixedFrameItems
from boxreg_ros.io.lidars import Lidars
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.storage.mcap import McapFile
from boxreg_ros.labels import check_options, LabelOutput, Options, Provenance
from boxreg_ros.labels.recording_copy import compression_of, COMPRESSION_TYPES
from boxreg_ros.labels.semantickitti import class_of
from boxreg_ros.offline.point_products import object_name, object_tracks
from boxreg_ros.offline.relabel import relabel
from boxreg_ros.offline.request import Request
from boxreg_ros.review.changes import Changes
from boxreg_ros.simulation.raycast import ROAD
from boxreg_ros.simulation.simulate import simulate
from boxreg_ros.structures import BoxArray, RefinedBoxes, Sweep
from consumers import consumer
from mcap.reader import make_reader
from mcap.writer import Writer
from measure.truck import truck_scene, write_truck
import numpy as np
import pytest
from relabel_results import QUICK
from ros_messages import Drive
from rosbags.highlevel import AnyReader
from rosbags.typesys import get_typestore, Stores
from scenes import write_scene

SWEEPS = 12
ALL_CLOUDS = ('static', 'background', 'object')


@pytest.fixture(scope='module')
def scene():
    return simulate('street', 0, SWEEPS)


@pytest.fixture(scope='module')
def recording(scene, tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp('drive') / 'street.mcap', scene)


@pytest.fixture(scope='module')
def results(recording, tmp_path_factory):
    out = tmp_path_factory.mktemp('results') / 'out'
    options = [f'--clouds={name}' for name in ALL_CLOUDS]
    command = ['relabel', str(recording), '-o', str(out), '--formats=csv,mcap', '--label-points']
    assert cli.main([*command, *options, '--undistort']) == 0
    return out


def true_motion(scene, sweep):
    """Return which actors move at the stamp of a sweep."""
    seconds = (sweep.stamp_ns - scene.sweeps[0].stamp_ns) * 1e-9
    ends = np.array([seconds - 0.05, seconds + 0.05])
    return [np.linalg.norm(np.diff(a.motion.at(ends)[:, :2], axis=0)) > 0.03 for a in scene.actors]


def clouds_of(path, topic='/points'):
    """Return a structured array per cloud of a recording, as rosbags reads it."""
    found = []
    with closing(AnyReader([path])) as reader:
        reader.open()
        for connection, _, data in reader.messages():
            if connection.topic == topic:
                message = reader.deserialize(data, connection.msgtype)
                kinds = {2: 'u1', 4: '<u2', 7: '<f4'}
                layout = np.dtype({
                    'names': [field.name for field in message.fields],
                    'formats': [kinds[field.datatype] for field in message.fields],
                    'offsets': [field.offset for field in message.fields],
                    'itemsize': message.point_step,
                })  # fmt: skip
                assert len(message.data) == message.row_step * message.height
                found.append(np.frombuffer(message.data, layout))
    return found


def iou(found, true):
    return (found & true).sum() / (found | true).sum()


def test_semantickitti_has_the_true_classes_instances_and_poses(scene, results, tmp_path):
    """The files are read, and the classes evaluated, by semantic-kitti-api."""
    folder = results / 'semantickitti' / 'sequences' / '00'
    names = json.loads((results / 'semantickitti' / 'boxreg.json').read_text())['tracks']
    poses = np.loadtxt(folder / 'poses.txt').reshape(-1, 3, 4)
    assert len(poses) == len(np.loadtxt(folder / 'times.txt')) == SWEEPS
    first = np.linalg.inv(scene.T_fixed_sensor[0])
    np.testing.assert_allclose(poses, (first @ scene.T_fixed_sensor)[:, :3], atol=1e-6)
    assert 'Tr: 1.0 0.0 0.0 0.0' in (folder / 'calib.txt').read_text()
    moves = [np.ptp(one.motion.poses[:, :2], axis=0).max() > 0.5 for one in scene.actors]
    pairs = zip(scene.actors, moves, strict=True)
    classes = np.array([*(class_of(actor.class_name, moving) for actor, moving in pairs), 99])
    for number, (sweep, owners) in enumerate(zip(scene.sweeps, scene.owners, strict=True)):
        points = np.fromfile(folder / 'velodyne' / f'{number:06d}.bin', '<f4').reshape(-1, 4)
        np.testing.assert_array_equal(points[:, :3], sweep.points)
        classes[owners].astype('<u4').tofile(tmp_path / f'{number:06d}.label')
    found = consumer('semantickitti', folder, tmp_path)
    if found is None:
        pytest.skip('semantic-kitti-api is not installed: make environments')
    assert set(found['iou']) <= set(map(str, classes))
    for number in (10, 252, 258):
        assert found['iou'][str(number)] > 0.9, number
    for counts, owners in zip(found['instances'], scene.owners, strict=True):
        returns = np.bincount(owners + 1, minlength=len(scene.actors) + 1)[1:]
        largest = int(returns.argmax())
        number = next(key for key, name in names.items() if name == scene.actors[largest].track_id)
        assert counts[int(number)] == pytest.approx(returns[largest], rel=0.05)


def test_the_devkit_of_nuscenes_reads_lidarseg_and_panoptic(scene, results):
    samples = consumer('lidarseg', results / 'lidarseg', 'v1.0-boxreg')
    assert len(samples) == SWEEPS
    for sample, sweep, owners in zip(samples, scene.sweeps, scene.owners, strict=True):
        assert sample['timestamp'] == round(sweep.stamp_ns / 1000)
        assert sample['size'] == 20 * len(owners)  # five float32 a point
        assert sum(sample['categories'].values()) == len(owners)
        names = np.array([*(actor.class_name for actor in scene.actors), ''])
        cars = np.isin(names[owners], ['car', 'van']).sum()
        assert sample['categories']['vehicle.car'] == pytest.approx(cars, rel=0.1)
        assert sample['categories']['static.other'] >= np.sum(owners == ROAD) * 0.95
        most = max(n for code, n in sample['instances'].items() if int(code) % 1000)
        largest = np.bincount(owners[owners >= 0]).max()
        assert most == pytest.approx(largest, rel=0.1)


def test_clouds_of_the_overlay_have_fields_of_labels(scene, results):
    clouds = clouds_of(results / 'overlay.mcap')
    assert len(clouds) == SWEEPS
    folder = results / 'semantickitti' / 'sequences' / '00' / 'labels'
    for number, cloud in enumerate(clouds):
        assert cloud.dtype.names[-4:] == ('t', 'label', 'instance', 'moving')
        labels = np.fromfile(folder / f'{number:06d}.label', '<u4')
        np.testing.assert_array_equal(cloud['label'], labels & 0xFFFF)
        np.testing.assert_array_equal(cloud['instance'], labels >> 16)
        true = np.append(true_motion(scene, scene.sweeps[number]), False)[scene.owners[number]]
        assert iou(cloud['moving'] == 1, true) > 0.85
    with closing(AnyReader([results / 'overlay.mcap'])) as reader:
        reader.open()
        assert {'/detections_refined', '/tf', '/odom'} <= set(reader.topics)
        assert reader.topics['/detections_refined'].msgcount == SWEEPS


def test_clouds_without_what_moves(scene, results, tmp_path):
    clouds = results / 'clouds'
    kept, moving_left, moving, parked_left, parked = 0, 0, 0, 0, 0
    for index, cloud in enumerate(clouds_of(clouds / 'static.mcap')):
        sweep, owners = scene.sweeps[index], scene.owners[index]
        rows = {tuple(point): row for row, point in enumerate(sweep.points.tolist())}
        kept_points = np.column_stack([cloud[axis] for axis in 'xyz']).tolist()
        own = owners[[rows[tuple(point)] for point in kept_points]]
        moves = np.append(true_motion(scene, sweep), False)
        moving_left += moves[own].sum()
        moving += moves[owners].sum()
        parked_left += (~moves[own] & (own >= 0)).sum()
        parked += (~moves[owners] & (owners >= 0)).sum()
        kept += len(cloud)
    assert moving_left < 0.1 * moving
    assert parked_left > 0.9 * parked
    empty = sum(map(len, clouds_of(clouds / 'background.mcap')))
    assert empty < kept - 0.9 * parked_left
    for name in ('static', 'background'):
        points = consumer('cloud', clouds / f'{name}.ply')['rows']
        cells = np.floor(np.array(points) / 0.1)
        assert len(np.unique(cells, axis=0)) > 0.9 * len(points) > 100


def test_objects_are_accumulated_in_their_boxes(scene, results):
    returns = np.bincount(np.concatenate(scene.owners) + 1)[1:]
    largest = scene.actors[int(returns.argmax())]
    path = results / 'clouds' / 'objects' / f'{largest.track_id}.ply'
    points = np.array(consumer('cloud', path)['rows'])
    assert len(points) > 200
    half = largest.extent / 2
    assert (np.abs(points) < half + 0.35).all()
    assert np.ptp(points[:, 0]) > 0.8 * largest.extent[0]


def test_objects_have_a_file_of_their_id_each():
    ids = ('7', '21.2', 'track_3', 'car/7', 'car 7', '.x', 'ü', '\ud800', 'x' * 300, 'x' * 301)
    names = [object_name(track_id, row) for row, track_id in enumerate(ids)]
    assert names[:6] == ['7', '21.2', 'track_3', 'car%2F7', 'car 7', '%2Ex']
    assert len(set(names)) == len(ids)
    assert max(map(len, names)) < 250 and ''.join(names).isascii()


def test_points_of_moving_objects_are_moved_to_the_stamp(tmp_path):
    """On a highway: the points of a rigid body are moved by its own motion."""
    scene = simulate('highway', 0, SWEEPS)
    write_scene(tmp_path / 'way.mcap', scene)
    options = ['--undistort', '--formats=csv', '--set=sampling.box_time=stamp']
    out = tmp_path / 'out'
    assert cli.main(['relabel', str(tmp_path / 'way.mcap'), '-o', str(out), *options]) == 0
    errors, distances = [], []
    for index, cloud in enumerate(clouds_of(out / 'clouds' / 'undistorted.mcap')):
        sweep, owners = scene.sweeps[index], scene.owners[index]
        seconds = (sweep.stamp_ns - scene.sweeps[0].stamp_ns) * 1e-9
        after = np.column_stack([cloud[axis] for axis in 'xyz'])
        for i, actor in enumerate(scene.actors):
            rows = np.flatnonzero(owners == i)
            there = actor.motion.at(seconds + sweep.times[rows])[:, :2]
            stamp = actor.motion.at(np.full(len(rows), seconds))[:, :2]
            true = (stamp - there) @ scene.T_fixed_sensor[index, :2, :2]
            shift = (after[rows] - sweep.points[rows])[:, :2]
            errors.append(np.linalg.norm(shift - true, axis=1))
            distances.append(np.linalg.norm(true, axis=1))
    assert np.concatenate(distances).mean() > 0.5
    assert np.concatenate(errors).mean() < 0.1 * np.concatenate(distances).mean()


def test_summary_counts_points_and_sweeps(results, scene):
    summary = json.loads((results / 'summary.json').read_text())
    found = summary['points']
    assert found['sweeps'] == SWEEPS
    assert found['points'] == sum(map(len, scene.owners))
    assert found['points_on_moving'] > 0
    assert summary['seconds']['points'] > 0
    assert not (results / '.points').exists()


def test_sweeps_without_boxes_are_unknown_and_copied_unchanged(scene, recording, tmp_path):
    """The labels end after half of the sweeps; the clouds go on."""
    half = SWEEPS // 2
    labels = tmp_path / 'boxes.csv'
    rows = scene.truth.stamps_ns < scene.sweeps[half].stamp_ns
    scene.truth.rows(rows).write(labels)
    request = Request(
        (recording,), labels=('csv', labels), config=QUICK, formats=('semantickitti',),
        clouds=('static',),
    )  # fmt: skip
    assert request.box_formats == ()
    summary = relabel(request, tmp_path / 'out')
    unknown = summary.points['sweeps_without_boxes']
    assert unknown == half
    folder = tmp_path / 'out' / 'semantickitti' / 'sequences' / '00' / 'labels'
    last = np.fromfile(folder / f'{SWEEPS - 1:06d}.label', '<u4')
    assert not last.any()
    clouds = clouds_of(tmp_path / 'out' / 'clouds' / 'static.mcap')
    assert [len(cloud) for cloud in clouds[half:]] == [
        len(owners) for owners in scene.owners[half:]
    ]


def test_points_of_a_drive_without_boxes_are_unknown(recording, tmp_path):
    request = Request((recording,), boxes='none', config=QUICK, formats=('semantickitti',))
    summary = relabel(request, tmp_path / 'out')
    assert summary.points['sweeps_without_boxes'] == SWEEPS
    assert summary.points['points_unknown'] == summary.points['points'] > 0


def test_boxes_that_no_point_confirms_are_uncertain_and_rejected_ones_no_objects():
    box = np.array([[10.0, 0, 1, 4, 2, 1.5, 0, 0, 0]])
    found = [
        ('refined', 9),
        ('kept', 9),
        ('interpolated', 9),
        ('interpolated', 0),
        ('rejected', 9),
    ]
    changes = Changes('odom')
    for stamp, (status, points) in enumerate(found):
        boxes = BoxArray(stamp, 'odom', ('1',), ('car',), np.array([np.nan]), box)
        refined = RefinedBoxes(boxes, (status,), ('',), np.array([points]), np.eye(6)[None])
        changes.add(boxes, refined, None, [])
    (track,) = object_tracks(changes.tracks())
    assert track.stamps_ns.tolist() == [0, 1, 2, 3]
    assert track.is_certain.tolist() == [True, False, True, False]


def test_clouds_of_several_lidars_are_copied_each_on_its_topic(tmp_path):
    path, out = tmp_path / 'truck.mcap', tmp_path / 'out'
    write_truck(path, truck_scene(0, 5), 'corners')
    with closing(AnyReader([path])) as reader:
        reader.open()
        kind = 'sensor_msgs/msg/PointCloud2'
        topics = [name for name, topic in reader.topics.items() if topic.msgtype == kind]
    assert len(topics) > 1
    options = [f'--points={topic}' for topic in topics]
    command = ['relabel', str(path), '-o', str(out), *options, '--clouds=static', '--formats=csv']
    assert cli.main([*command, '--set=min_observations=3']) == 0
    dropped = 0
    for topic in topics:
        before, after = clouds_of(path, topic), clouds_of(out / 'clouds' / 'static.mcap', topic)
        assert [cloud.dtype for cloud in after] == [cloud.dtype for cloud in before]
        dropped += sum(map(len, before)) - sum(map(len, after))
    counts = json.loads((out / 'summary.json').read_text())['points']
    assert dropped == counts['points_dynamic'] > 0
    # Each cloud has the labels of its own points: what is left are the points of the map.
    with Recording((out / 'clouds' / 'static.mcap',), Lidars(tuple(topics))) as copy:
        items = [item.moved for item in FixedFrameItems(copy, Config()).read()]
    left = [item.in_frame().points for item in items if isinstance(item, Sweep)]
    there = consumer('cloud', out / 'clouds' / 'static.ply')['rows']
    cells = [set(map(tuple, np.floor(np.float64(one) / 0.1))) for one in (np.vstack(left), there)]
    assert cells[0] == cells[1]


def test_formats_of_points_are_of_relabel_alone(tmp_path):
    with pytest.raises(ConfigError, match="format 'semantickitti' labels the points"):
        check_options(['semantickitti'], Options())
    with pytest.raises(ConfigError, match="format 'lidarseg' labels the points"):
        LabelOutput(tmp_path, ['lidarseg'], Provenance(), Options())
    request = Request((tmp_path,), formats=('csv', 'lidarseg'))
    assert (request.box_formats, request.point_formats) == (('csv',), ('lidarseg',))
    assert not Request((tmp_path,)).needs_point_labels


@pytest.mark.parametrize('compression', list(COMPRESSION_TYPES))
def test_copies_have_the_compression_of_their_source(tmp_path, compression):
    source = tmp_path / 'source.mcap'
    with source.open('wb') as file:
        writer = Writer(file, compression=COMPRESSION_TYPES[compression])
        writer.start('ros2')
        schema = writer.register_schema('sensor_msgs/msg/PointCloud2', 'ros2msg', b'')
        channel = writer.register_channel('/points', 'cdr', schema)
        writer.add_message(channel, 1, bytes(100), 1)
        writer.finish()
    with closing(McapFile(source)) as file:
        assert file.compression == compression
    assert compression_of(source) is COMPRESSION_TYPES[compression]


@pytest.mark.parametrize('storage', ['sqlite3', 'rosbag1'])
def test_copies_keep_what_they_do_not_edit(tmp_path, storage):
    """ROS 1 and rosbag2; points without a place or a transform stay, as unknown ones."""
    drive = Drive(sweeps=6, ros1=storage == 'rosbag1')
    with_nan, unplaced = 3, 4

    def spoil(message):
        step = message.point_step
        message.data = message.data.copy()
        message.data[:step].view('<f4')[0] = np.nan

    drive.replace('/points', with_nan, spoil)
    drive.replace('/points', unplaced, lambda msg: setattr(msg.header, 'frame_id', 'elsewhere'))
    path = drive.write(tmp_path / 'drive', storage)
    request = Request(
        (path,), config=QUICK, formats=('csv', 'mcap'), clouds=('static',), label_points=True,
    )  # fmt: skip
    relabel(request, tmp_path / 'out')
    before, first = all_of(path)
    static, kept = copied(tmp_path / 'out' / 'clouds' / 'static.mcap', storage)
    overlay, shown = copied(tmp_path / 'out' / 'overlay.mcap', storage)
    assert [item for item in static if item[0] != '/points'] == [
        item for item in before if item[0] != '/points'
    ]
    assert set(before) - set(overlay) <= {item for item in before if item[0] == '/points'}
    assert len(first) == len(kept) == len(shown) == 6
    for number, (given, fewer, more) in enumerate(zip(first, kept, shown, strict=True)):
        assert str(given.header) == str(fewer.header) == str(more.header)
        assert [f.name for f in fewer.fields] == [f.name for f in given.fields]
        assert [f.name for f in more.fields[-3:]] == ['label', 'instance', 'moving']
        assert more.width == given.width and more.point_step == given.point_step + 5
        table = more.data.reshape(more.width, more.point_step)
        np.testing.assert_array_equal(
            table[:, : given.point_step], given.data.reshape(given.width, -1)
        )
        rows = fewer.data.reshape(fewer.width, -1)
        assert 0 < fewer.width <= given.width
        assert np.isnan(rows[:, :4].copy().view('<f4')).sum() == (number == with_nan)
        unknown = (table[:, -5:] == [0, 0, 0, 0, 255]).all(axis=1)
        assert unknown[0] == (number in (with_nan, unplaced))
        assert unknown.all() == (number == unplaced)


def all_of(path):
    """Return topic, time and bytes of all messages of a recording, and its clouds."""
    with closing(AnyReader([path])) as reader:
        reader.open()
        messages = list(reader.messages())
        clouds = [
            reader.deserialize(data, connection.msgtype)
            for connection, _, data in messages
            if connection.topic == '/points'
        ]
    return [(connection.topic, t, bytes(data)) for connection, t, data in messages], clouds


def copied(path, storage):
    """Return the same of a copy; rosbags reads no MCAP file with messages of ROS 1."""
    if storage != 'rosbag1':
        return all_of(path)
    store = get_typestore(Stores.ROS1_NOETIC)
    with path.open('rb') as file:
        found = [(c.topic, m.log_time, m.data) for _, c, m in make_reader(file).iter_messages()]
    kind = 'sensor_msgs/msg/PointCloud2'
    clouds = [store.deserialize_ros1(data, kind) for topic, _, data in found if topic == '/points']
    return found, clouds
