"""Labels for SUSTechPOINTS, Datumaro and CVAT, Supervisely and Xtreme1, and their clouds."""

import json
import shutil

from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.labels import frames_of, LabelFrame, Options, Provenance, writer_for
from boxreg_ros.labels.clouds import write_cloud
from boxreg_ros.structures import BoxArray, RefinedBoxes, Sweep
from consumers import consumer
import numpy as np
import pytest

TOOLS = ('sustechpoints', 'datumaro', 'supervisely', 'sly_pointcloud', 'xtreme1')
STAMP = 1_700_000_000_100_000_000
NAME = '1700000000100000000'

# A tilted box in the fixed frame. The sensor is at (10, 20, 1.5) with a yaw of 90 degrees.
TILTED = [1.5, -2.25, 0.1, 4.5, 1.8, 1.6, 0.1, -0.2, 2.5]
T_ODOM_LIDAR = np.array([[0.0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 1.5], [0, 0, 0, 1]])
# The centre minus (10, 20, 1.5) is (-8.5, -22.25, -1.4);
# rotated by -90 degrees, (x, y) to (y, -x):
CENTER = [-22.25, 8.5, -1.4]
# The rotation about z keeps roll and pitch, and subtracts pi/2 from yaw: R = Rz(0.929204) Ry(-0.2)
# Rx(0.1), with the elements
#   R[0, 0] = cos y cos p                       = 0.598472 * 0.980067    =  0.586543
#   R[0, 1] = cos y sin p sin r - sin y cos r   = -0.011870 - 0.797141   = -0.809012
#   R[0, 2] = cos y sin p cos r + sin y sin r   = -0.118304 + 0.079981   = -0.038323
#   R[1, 2] = sin y sin p cos r - cos y sin r   = -0.158367 - 0.059748   = -0.218115
#   R[2, 2] = cos p cos r                       = 0.980067 * 0.995004    =  0.975170
# and for R = Rx(a) Ry(b) Rz(c): sin b = R[0, 2], tan a = -R[1, 2] / R[2, 2],
# tan c = -R[0, 1] / R[0, 0].
ANGLES = [np.arctan2(0.218115, 0.975170), np.arcsin(-0.038323), np.arctan2(0.809012, 0.586543)]
EXTENT = [4.5, 1.8, 1.6]


def refined(stamp_ns, tracks, boxes=None, status=None, classes=None, frame_id='odom'):
    n = len(tracks)
    values = np.array([TILTED] * n if boxes is None else boxes, dtype=float).reshape(n, 9)
    # A full symmetric matrix whose numbers are all different.
    covariance = np.diag(np.arange(1.0, 7.0))
    covariance[np.triu_indices(6, 1)] = np.arange(15) * 0.01
    covariance = np.maximum(covariance, covariance.T)
    status = status or ('refined',) * n
    classes = classes or ('car',) * n
    return RefinedBoxes(
        BoxArray(stamp_ns, frame_id, tuple(tracks), classes, np.full(n, 0.75), values),
        status,
        tuple('no_points' if s == 'kept' else '' for s in status),
        np.arange(n) + 7,
        np.broadcast_to(covariance, (n, 6, 6)),
    )


def frame(*arguments, T=T_ODOM_LIDAR, sweep=None, intensities=None, **options):
    boxes = refined(*arguments, **options)
    return LabelFrame(boxes, 'odom', 'lidar', T, sweep, intensities)


def write(name, folder, frames, **options):
    provenance = Provenance(('drive.mcap',), 'cafe')
    writer = writer_for(name, folder, provenance, Options(**options))
    for item in frames:
        writer.write(item)
    writer.close()
    return writer


def content(path):
    return json.loads(path.read_text())


def vector(values):
    return pytest.approx(dict(zip('xyz', values, strict=True)), abs=2e-6)


CLOUD = Sweep(STAMP, 'lidar', np.array([[1.5, -2.0, 0.25], [3.0, 4.0, -1.0]], np.float32))
BRIGHT = np.array([0.5, 200.0])


# Golden values -----------------------------------------------------------------------------------


def test_sustechpoints_golden_values(tmp_path):
    write('sustechpoints', tmp_path, [frame(STAMP, ['x7'], status=('kept',))])
    (item,) = content(tmp_path / 'sustechpoints' / 'label' / f'{NAME}.json')
    assert item['psr']['position'] == vector(CENTER)
    assert item['psr']['rotation'] == vector(ANGLES)
    assert item['psr']['scale'] == vector(EXTENT)
    assert (item['obj_type'], item['obj_id'], item['annotator']) == ('car', 'x7', 'boxreg')
    evidence = item['boxreg']
    assert (evidence['status'], evidence['reason']) == ('kept', 'no_points')
    assert (evidence['num_points'], evidence['score']) == (7, 0.75)
    # The upper triangle, row by row: 1, then the five numbers right of it, then 2 ...
    assert evidence['covariance'][:7] == [1.0, 0.0, 0.01, 0.02, 0.03, 0.04, 2.0]
    about = content(tmp_path / 'sustechpoints' / 'desc.json')
    assert (about['tool'], about['config_hash']) == ('boxreg_ros', 'cafe')


def test_xtreme1_golden_values(tmp_path):
    write('xtreme1', tmp_path, [frame(STAMP, ['x7'])])
    (item,) = content(tmp_path / 'xtreme1' / 'scene_1' / 'result' / f'{NAME}.json')['objects']
    contour = item['contour']
    assert contour['center3D'] == vector(CENTER)
    assert contour['rotation3D'] == vector(ANGLES)
    assert contour['size3D'] == vector(EXTENT)
    assert (item['type'], item['trackId'], item['trackName']) == ('3D_BOX', 'x7', 'x7')
    assert (item['className'], item['modelConfidence'], contour['pointN']) == ('car', 0.75, 7)


@pytest.mark.parametrize('swapped', [False, True])
def test_datumaro_golden_values_in_datumaro(tmp_path, swapped):
    frames = [frame(STAMP, ['x7'], sweep=CLOUD)]
    write('datumaro', tmp_path, frames, with_points=True, swap_axes=swapped)
    project = consumer('datumaro', tmp_path / 'datumaro')
    (item,) = project['cuboids']
    # Datumaro rounds to two digits.
    assert item['position'] == pytest.approx(CENTER, abs=0.0051)
    assert item['rotation'] == pytest.approx(ANGLES, abs=0.0051)
    assert item['scale'] == (EXTENT[::-1] if swapped else EXTENT)
    assert (item['item'], item['frame'], item['label']) == (NAME, 0, 'car')
    assert item['bytes'] > 24  # a header and two points of three float32
    attributes = item['attributes']
    assert (attributes['track'], attributes['status']) == ('x7', 'refined')
    assert attributes['track_id'] == 10**6
    assert project['infos']['config_hash'] == 'cafe'
    (tracklet,) = project['tracklets']
    length, width, height = EXTENT
    if swapped:  # the purpose of the option: h, w and l as KITTI defines them
        assert tracklet == {'h': height, 'w': width, 'l': length}
    else:
        assert tracklet == {'h': length, 'w': width, 'l': height}


def test_datumaro_has_a_track_once_in_a_frame(tmp_path):
    frames = [frame(STAMP, ['7', '7', 'x']), frame(STAMP + 1, ['7', 'x'])]
    write('datumaro', tmp_path, frames)
    items = content(tmp_path / 'datumaro' / 'annotations' / 'default.json')['items']
    numbers = [[box['attributes']['track_id'] for box in item['annotations']] for item in items]
    assert numbers == [[7, 1_000_000, 1_000_001], [7, 1_000_001]]


def test_supervisely_golden_values_in_supervisely(tmp_path):
    frames = [
        frame(STAMP + k * 10**8, ['x7', 'y'][:n], status=(status, 'kept')[:n], sweep=CLOUD)
        for k, (n, status) in enumerate([(2, 'refined'), (1, 'refined'), (2, 'kept')])
    ]
    write('supervisely', tmp_path, frames, with_points=True)
    path = tmp_path / 'supervisely' / 'episode' / 'annotation.json'
    annotation = content(path)
    annotation['frames'][0]['figures'][0] |= {'nnCreated': True, 'nnUpdated': True}
    path.write_text(json.dumps(annotation))
    project = consumer('supervisely', tmp_path / 'supervisely')
    assert project['figures'][0]['status'] == 'manual'  # its library forgets that of a model
    assert (project['type'], project['frames']) == ('point_cloud_episodes', 3)
    assert len(project['items']) == 3
    assert json.loads(project['description'])['config_hash'] == 'cafe'
    assert [figure['frame'] for figure in project['figures']] == [0, 0, 1, 2, 2]
    figure = project['figures'][0]
    assert (figure['cloud'], figure['class']) == (f'{NAME}.pcd', 'car')
    assert figure['geometry']['position'] == vector(CENTER)
    assert figure['geometry']['rotation'] == vector(ANGLES)
    assert figure['geometry']['dimensions'] == vector(EXTENT)
    assert figure['tags'] == [
        ['track_id', 'x7', None], ['status', 'refined', [0, 1]], ['status', 'kept', [2, 2]],
    ]  # fmt: skip
    assert project['figures'][1]['tags'] == [
        ['track_id', 'y', None], ['status', 'kept', [0, 0]], ['status', 'kept', [2, 2]],
    ]  # fmt: skip


# Requirements of tools without a library ---------------------------------------------------------


def test_sustechpoints_scene_is_complete(tmp_path):
    frames = [frame(STAMP, ['a']), frame(STAMP + 1, []), frame(STAMP + 1, ['a'])]
    write('sustechpoints', tmp_path, frames, with_points=True)
    scene = tmp_path / 'sustechpoints'
    # The server lists the frames from lidar/, sorted, and finds labels by name.
    names = sorted(path.stem for path in (scene / 'lidar').iterdir())
    assert names == [NAME, '1700000000100000001', '1700000000100000001_1']
    assert sorted(path.stem for path in (scene / 'label').iterdir()) == names
    assert content(scene / 'label' / f'{names[1]}.json') == []


def test_xtreme1_upload_is_complete(tmp_path):
    frames = [frame(STAMP, ['a', '', '']), frame(STAMP + 1, [])]
    write('xtreme1', tmp_path, frames, with_points=True)
    scene = tmp_path / 'xtreme1' / 'scene_1'
    # Data are the files in folders lidar_point_cloud_<digit>. A result has the name of a file and
    # at least one object, each with a type and a contour. The name of a scene begins with 'scene'.
    clouds = {path.stem for path in (scene / 'lidar_point_cloud_0').iterdir()}
    results = {path.stem for path in (scene / 'result').iterdir()}
    assert len(clouds) == 2
    assert results == {NAME}
    objects = content(scene / 'result' / f'{NAME}.json')['objects']
    assert all(item['type'] == '3D_BOX' and item['contour'] for item in objects)
    assert len({item['trackId'] for item in objects}) == 3  # boxes without track id are not merged


# Round trips -------------------------------------------------------------------------------------


@pytest.mark.parametrize('name', TOOLS)
@pytest.mark.parametrize('with_points', [False, True])
def test_round_trip(tmp_path, name, with_points):
    boxes = [TILTED, [100.0, 50, 2, 12, 2.5, 3.5, 0, 0, -3], [0, 0, 0, 1, 1, 1, -0.3, 0.4, 1]]
    frames = [
        frame(STAMP, ['7', 'b', ''], boxes=boxes, status=('refined', 'kept', 'interpolated')),
        frame(STAMP + 10**8, []),
        frame(STAMP + 2 * 10**8, ['b'], classes=('truck',)),
    ]
    write(name, tmp_path, frames, with_points=with_points)
    read = list(frames_of(name, tmp_path / name))
    assert len(read) == 3
    for before, after in zip(frames, read, strict=True):
        one = before.refined
        two = after.refined
        assert two.boxes.stamp_ns == one.boxes.stamp_ns
        assert (after.fixed_frame, after.sensor_frame) == ('odom', 'lidar')
        assert two.boxes.frame_id == 'odom'
        np.testing.assert_array_equal(after.T_fixed_sensor, T_ODOM_LIDAR)
        np.testing.assert_allclose(two.boxes.boxes, one.boxes.boxes, atol=1e-9)
        assert two.boxes.track_ids == one.boxes.track_ids
        assert two.boxes.class_names == one.boxes.class_names
        assert (two.status, two.reasons) == (one.status, one.reasons)
        np.testing.assert_array_equal(two.num_points, one.num_points)
        np.testing.assert_array_equal(two.boxes.scores, one.boxes.scores)
        np.testing.assert_array_equal(two.covariances, one.covariances)


def test_swapped_axes_round_trip(tmp_path):
    write('datumaro', tmp_path, [frame(STAMP, ['a'])], swap_axes=True)
    (back,) = frames_of('datumaro', tmp_path / 'datumaro')
    np.testing.assert_allclose(back.refined.boxes.boxes, [TILTED], atol=1e-9)


@pytest.mark.parametrize('name', TOOLS)
def test_nan_score_round_trips(tmp_path, name):
    given = frame(STAMP, ['a'])
    given.refined.boxes.scores[0] = np.nan
    write(name, tmp_path, [given])
    (back,) = frames_of(name, tmp_path / name)
    assert np.isnan(back.refined.boxes.scores[0])


def test_scene_written_by_sustechpoints(tmp_path):
    (tmp_path / 'label').mkdir()
    psr = {'position': {'x': 1, 'y': 2, 'z': 3}, 'scale': {'x': 4, 'y': 2, 'z': 1.5}}
    psr['rotation'] = {'x': 0, 'y': 0, 'z': 0.5}
    items = [{'psr': psr, 'obj_type': 'Car', 'obj_id': '3', 'obj_attr': ''}]
    for number in (950, 965):
        (tmp_path / 'label' / f'{number:06d}.json').write_text(json.dumps(items))
    with pytest.raises(RecordingError, match=r'timestamps.txt.*one stamp per frame'):
        list(frames_of('sustechpoints', tmp_path))
    (tmp_path / 'timestamps.txt').write_text('100\n200\n')
    first, second = frames_of('sustechpoints', tmp_path)
    assert (first.refined.boxes.stamp_ns, second.refined.boxes.stamp_ns) == (100, 200)
    np.testing.assert_allclose(first.refined.boxes.boxes, [[1, 2, 3, 4, 2, 1.5, 0, 0, 0.5]])
    assert first.refined.status == ('input',)
    (tmp_path / 'timestamps.txt').write_text('100\n200\n300\n')
    with pytest.raises(RecordingError, match=r'one stamp for each of 2 frames, got 3'):
        list(frames_of('sustechpoints', tmp_path))
    (tmp_path / 'timestamps.txt').write_text('100\n')
    with pytest.raises(RecordingError, match=r'expected a stamp for 2 frames, got 1'):
        list(frames_of('sustechpoints', tmp_path))


@pytest.mark.parametrize('name', ['supervisely', 'datumaro'])
def test_frames_with_other_names_keep_their_order(tmp_path, name):
    # By name, frame_10 and frame_11 would come before frame_2.
    boxes = [[float(k), 0, 0, 4, 2, 1.5, 0, 0, 0] for k in range(12)]
    given = [frame(STAMP + k, ['a'], boxes=[boxes[k]], frame_id='lidar') for k in range(12)]
    write(name, tmp_path, given)
    project = tmp_path / name
    for file in [*project.glob('*/*.json'), *project.glob('*.json')]:
        text = file.read_text()
        for k in range(12):
            text = text.replace(f'{STAMP + k}.pcd', f'frame_{k}.pcd')
            text = text.replace(f'"{STAMP + k}"', f'"frame_{k}"')
        file.write_text(text)
    found = [f.moved('sensor').refined.boxes for f in frames_of(name, project)]
    assert [boxes.stamp_ns for boxes in found] == [STAMP + k for k in range(12)]
    assert [float(boxes.boxes[0, 0]) for boxes in found] == pytest.approx(range(12))


@pytest.mark.parametrize(
    ('name', 'file'),
    [
        ('sustechpoints', f'label/{NAME}.json'),
        ('datumaro', 'annotations/default.json'),
        ('supervisely', 'episode/annotation.json'),
        ('xtreme1', f'scene_1/result/{NAME}.json'),
    ],
)
def test_json_of_another_layout_is_refused(tmp_path, name, file):
    write(name, tmp_path, [frame(STAMP, ['a'])])
    (tmp_path / name / file).write_text('[{"a": 1}]')
    with pytest.raises(RecordingError, match='expected'):
        list(frames_of(name, tmp_path / name))


@pytest.mark.parametrize(
    ('name', 'part', 'word'),
    [('supervisely', 'episode', 'episode'), ('xtreme1', 'scene_1', 'scene')],
)
def test_several_scenes_or_episodes_are_refused(tmp_path, name, part, word):
    write(name, tmp_path, [frame(STAMP, ['a'])])
    project = tmp_path / name
    shutil.copytree(project / part, project / 'second')
    with pytest.raises(RecordingError, match=rf'expected one {word}.*got {part}, second; name'):
        list(frames_of(name, project))
    (found,) = frames_of(name, project / 'second')
    assert found.refined.boxes.track_ids == ('a',)
    # A part with sidecar files of its own uses these.
    (project / 'second' / 'timestamps.txt').write_text(f'{STAMP + 7}\n')
    stamps = [next(frames_of(name, project / p)).refined.boxes.stamp_ns for p in (part, 'second')]
    assert stamps == [STAMP, STAMP + 7]
    shutil.rmtree(project / part)
    shutil.rmtree(project / 'second')
    with pytest.raises(RecordingError, match=rf'expected one {word}.*got none'):
        list(frames_of(name, project))


# Clouds ------------------------------------------------------------------------------------------


@pytest.mark.parametrize('ending', ['.pcd', '.ply'])
@pytest.mark.parametrize('intensities', [None, BRIGHT])
def test_third_party_readers_read_the_clouds(tmp_path, ending, intensities):
    path = tmp_path / f'cloud{ending}'
    write_cloud(path, CLOUD.points, intensities)
    cloud = consumer('cloud', path)
    rows = CLOUD.points.tolist()
    if intensities is not None:
        rows = [[*row, value] for row, value in zip(rows, intensities, strict=True)]
    assert cloud == {'fields': ['x', 'y', 'z', 'intensity'][: len(rows[0])], 'rows': rows}


def test_bin_files_of_kitti_and_nuscenes(tmp_path):
    write_cloud(tmp_path / 'kitti.bin', CLOUD.points, BRIGHT)
    write_cloud(tmp_path / 'nuscenes.pcd.bin', CLOUD.points)
    kitti = np.fromfile(tmp_path / 'kitti.bin', '<f4').reshape(-1, 4)
    np.testing.assert_array_equal(kitti, np.column_stack([CLOUD.points, BRIGHT]))
    nuscenes = np.fromfile(tmp_path / 'nuscenes.pcd.bin', '<f4').reshape(-1, 5)
    np.testing.assert_array_equal(nuscenes, np.pad(CLOUD.points, ((0, 0), (0, 2))))


def test_empty_cloud_is_written(tmp_path):
    write_cloud(tmp_path / 'cloud.pcd', np.zeros((0, 3)))
    assert consumer('cloud', tmp_path / 'cloud.pcd')['rows'] == []


def test_unknown_cloud_suffix_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"'cloud.las': expected a name in .pcd, .ply"):
        write_cloud(tmp_path / 'cloud.las', CLOUD.points)


def test_intensities_are_written_in_other_formats(tmp_path):
    feather = pytest.importorskip('pyarrow.feather')
    item = frame(STAMP, ['a'], sweep=CLOUD, intensities=np.array([0.5, 900.0]))
    write('tracklets', tmp_path, [item], with_points=True)
    (file,) = (tmp_path / 'tracklets').rglob('*.bin')
    np.testing.assert_array_equal(np.fromfile(file, '<f4')[3::4], [0.5, 900.0])
    write('argoverse2', tmp_path, [item], with_points=True)
    (file,) = (tmp_path / 'argoverse2').rglob(f'lidar/{STAMP}.feather')
    assert feather.read_table(file)['intensity'].to_pylist() == [0, 255]  # bytes
