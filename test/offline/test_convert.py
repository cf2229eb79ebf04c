"""`boxreg convert`, `boxreg formats` and `boxreg relabel --labels`."""

from dataclasses import replace
from importlib import import_module
import json
from pathlib import Path

from boxreg_ros import cli
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.covariance_table import COVARIANCES, read_covariances
from boxreg_ros.io.fixed_frame import FixedFrameItems, input_boxes
from boxreg_ros.labels import FORMATS, frames_of, Options
from boxreg_ros.labels.registry import labels_points
from boxreg_ros.offline.convert import convert
from boxreg_ros.offline.formats import FORMAT_COLUMNS, rows
from boxreg_ros.offline.relabel import relabel, Request
from boxreg_ros.offline.sources import source_of
from boxreg_ros.structures import ROLL
import numpy as np
import pytest
from relabel_results import QUICK, rows_of
from ros_messages import Drive, SECOND

# A camera whose z axis is x of the LiDAR.
CALIBRATION = """P2: 700 0 621 0 0 700 187 0 0 0 1 0
R_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0
"""

NO_STATUS = {'mcap', 'recording'}
WITH_STATUS = tuple(
    sorted(name for name in FORMATS if not labels_points(name) and name not in NO_STATUS)
)
"""Formats that can say that a person has placed a box."""


@pytest.fixture
def camera(tmp_path):
    path = tmp_path / 'camera.txt'
    path.write_text(CALIBRATION)
    return path


@pytest.fixture
def drive(tmp_path):
    """Return a recording, and a table of its boxes in the fixed frame."""
    recording = Drive(sweeps=7).write(tmp_path / 'drive')
    table = tmp_path / 'input.csv'
    BoxTable.from_arrays(input_boxes(source_of(Request((recording,))))[0]).write(table)
    return recording, table


def conversion(table, formats, options, recordings=()):
    return Request(recordings, labels=('csv', table), formats=formats, options=options)


def assert_same_boxes(found, expected, atol):
    assert [row['stamp_ns'] for row in found] == [row['stamp_ns'] for row in expected]
    assert [row['track_id'] for row in found] == [row['track_id'] for row in expected]
    assert {row['frame_id'] for row in found} == {'odom'}
    for name in ('x', 'y', 'z', 'qz', 'qw', 'length', 'width', 'height'):
        a, b = ([float(row[name]) for row in part] for part in (found, expected))
        np.testing.assert_allclose(a, b, atol=atol, err_msg=name)


def by_track(found):
    return sorted(found, key=lambda row: (row['stamp_ns'], row['track_id']))


# Boxes from label files ------------------------------------------------------------------------


def test_labels_are_refined_like_boxes_of_a_topic(tmp_path, drive):
    recording, table = drive
    relabel(Request((recording,), config=QUICK), tmp_path / 'topic')
    request = Request((recording,), config=QUICK, labels=('csv', table))
    summary = relabel(request, tmp_path / 'labels')
    expected = {'format': 'csv', 'path': str(table), 'boxes_outside_part': 0, 'left_out': {}}
    assert summary.labels == expected
    assert summary.topics['boxes'] is None
    assert (summary.boxes_in, summary.status['refined']) == (14, 14)
    assert_same_boxes(rows_of(tmp_path / 'labels'), rows_of(tmp_path / 'topic'), 1e-5)


@pytest.mark.parametrize('name', ['kitti', 'tracklets', 'nuscenes', 'argoverse2', 'openlabel'])
def test_labels_with_other_frame_names_are_refined_alike(tmp_path, drive, camera, name):
    """The frame names in label files need not be those of the recording."""
    for package in module_packages(name):
        pytest.importorskip(package)
    recording, table = drive
    options = Options(camera=camera if name == 'kitti' else None)
    asked = conversion(table, (name,), options, (recording,))
    convert(asked, tmp_path / 'made')
    folder = tmp_path / 'made' / name
    if (folder / 'boxreg.json').exists():
        (folder / 'boxreg.json').write_text('{"fixed_frame": "world", "sensor_frame": "top"}')
    relabel(Request((recording,), config=QUICK, labels=('csv', table)), tmp_path / 'a')
    relabel(Request((recording,), config=QUICK, labels=(name, folder)), tmp_path / 'b')
    # Tracklets have one extent per track and KITTI six decimals: refined boxes move a little.
    atol = {'kitti': 1e-3, 'tracklets': 1e-6}.get(name, 1e-6)
    found, expected = (by_track(rows_of(tmp_path / out)) for out in 'ba')
    assert_same_boxes(found, expected, atol)


def test_boxes_of_a_person_stay_as_they_are(tmp_path, drive, camera):
    recording, table = drive
    corrected = BoxTable.read(table)
    rows = [6, 7]
    corrected.boxes[rows] += np.array([0.05, 0.05, 0.05, 0, 0, 0, 0, 0, 0.01])
    status = list(corrected.status)
    status[6] = status[7] = 'human'
    replace(corrected, status=tuple(status)).write(table)
    options = Options(with_points=True, camera=camera)
    convert(conversion(table, WITH_STATUS, options, (recording,)), tmp_path / 'made')
    for name in WITH_STATUS:
        labels = (name, tmp_path / 'made' / ('boxes.csv' if name == 'csv' else name))
        with source_of(Request((recording,), labels=labels)) as source:
            items = list(FixedFrameItems(source, QUICK).read(with_clouds=False))
        pins = [item.moved.pinned for item in items]
        assert [pin is not None and pin.all() for pin in pins] == [i == 3 for i in range(7)], name
    config = QUICK.updated({'complete.static': True})
    for steps in (config, QUICK):
        relabel(Request((recording,), config=steps, labels=labels), tmp_path / 'out')
        found = BoxTable.read(tmp_path / 'out' / 'boxes.csv')
        assert [found.status[row] for row in rows] == ['human', 'human']
        np.testing.assert_allclose(found.boxes[rows], corrected.boxes[rows], atol=2e-5)
        assert 'refined' in found.status


def test_labels_of_a_recording_without_boxes(tmp_path, drive):
    _, table = drive
    bare = Drive(sweeps=7)
    bare.items = [item for item in bare.items if item[0] != '/boxes']
    request = Request((bare.write(tmp_path / 'bare'),), config=QUICK, labels=('csv', table))
    assert relabel(request, tmp_path / 'out').boxes_out == 14


def test_labels_outside_of_the_requested_part_are_counted(tmp_path, drive):
    recording, table = drive
    part = {'start': 0.15, 'end': 0.45}
    request = Request((recording,), config=QUICK, labels=('csv', table), **part)
    summary = relabel(request, tmp_path / 'out')
    stamps = {int(row['stamp_ns']) for row in rows_of(tmp_path / 'out')}
    first = min(int(row['stamp_ns']) for row in rows_of_table(table))
    assert {round((stamp - first) / SECOND, 1) for stamp in stamps} == {0.2, 0.3, 0.4}
    assert summary.labels['boxes_outside_part'] == 8


@pytest.mark.parametrize('apart', [-(10**18), 10**18, -(10**10), 10**10])
def test_labels_of_another_drive_are_refused(tmp_path, drive, apart):
    recording, table = drive
    labels = BoxTable.read(table)
    replace(labels, stamps_ns=labels.stamps_ns + apart).write(table)
    request = Request((recording,), config=QUICK, labels=('csv', table))
    with pytest.raises(RecordingError, match=r'clouds of .* \(2023-11-14\): another drive\?'):
        relabel(request, tmp_path / 'out')
    assert not (tmp_path / 'out').exists()
    replace(labels, stamps_ns=labels.stamps_ns // 10**6).write(table)
    with pytest.raises(RecordingError, match=r'stamps in ms\? write them in ns'):
        relabel(request, tmp_path / 'out')
    replace(labels, stamps_ns=labels.stamps_ns + apart).write(table)
    part = Request((recording,), config=QUICK, labels=('csv', table), end=0.3)
    if abs(apart) < 10**12:
        assert relabel(part, tmp_path / 'out').labels['boxes_outside_part'] == 14


def module_packages(name):
    return import_module(FORMATS[name]).FORMAT.packages


def rows_of_table(path):
    table = BoxTable.read(path)
    return [{'stamp_ns': stamp} for stamp in table.stamps_ns]


def test_labels_without_transform_are_kept_with_the_reason(tmp_path, drive):
    recording, table = drive
    text = table.read_text().replace(',odom,', ',mars,')
    table.write_text(text)
    request = Request((recording,), config=QUICK, labels=('csv', table))
    assert relabel(request, tmp_path / 'out').reasons == {'no_transform': 14}


def test_label_frame_other_than_the_sensor(tmp_path, drive):
    pytest.importorskip('pyarrow')
    recording, _ = drive
    options = {'config': QUICK, 'formats': ('argoverse2',), 'options': Options(with_points=True)}
    for out, more in (('lidar', {}), ('base', {'label_frame': 'base'})):
        relabel(Request((recording,), **options, **more), tmp_path / out)
    a, b = (
        list(frames_of('argoverse2', tmp_path / out / 'argoverse2')) for out in ('lidar', 'base')
    )
    for lidar, base in zip(a, b, strict=True):
        assert (lidar.sensor_frame, base.sensor_frame) == ('lidar', 'base')
        # The LiDAR is 2 m above the base.
        moved = base.refined.boxes.boxes - lidar.refined.boxes.boxes
        np.testing.assert_allclose(moved[:, :3], [[0, 0, 2]] * len(moved), atol=1e-6)
        np.testing.assert_allclose(base.T_fixed_sensor[2, 3], 0.0, atol=1e-9)
        clouds = [
            read_cloud(tmp_path / out, lidar.refined.boxes.stamp_ns) for out in ('lidar', 'base')
        ]
        np.testing.assert_allclose(clouds[1] - clouds[0], [[0, 0, 2]] * len(clouds[0]), atol=1e-5)
    with pytest.raises(RecordingError, match="label frame 'moon'"):
        relabel(Request((recording,), config=QUICK, label_frame='moon'), tmp_path / 'moon')


def read_cloud(out, stamp_ns):
    from pyarrow import feather

    path = out / 'argoverse2' / 'sensors' / 'lidar' / f'{stamp_ns}.feather'
    table = feather.read_table(path)
    return np.array([table[axis].to_numpy() for axis in 'xyz']).T


def test_written_clouds_belong_to_the_boxes_of_their_frame(tmp_path, drive, camera):
    recording, _ = drive
    options = Options(with_points=True, camera=camera)
    request = Request((recording,), config=QUICK, formats=('kitti', 'tracklets'), options=options)
    relabel(request, tmp_path / 'out')
    out = tmp_path / 'out'
    assert not list(out.glob('.*'))
    clouds = sorted((out / 'kitti' / 'velodyne' / '0000').glob('*.bin'))
    assert [path.name for path in clouds] == [f'{i:06d}.bin' for i in range(7)]
    assert len(list((out / 'tracklets' / 'velodyne_points' / 'data').glob('*.bin'))) == 7
    for path, frame in zip(clouds, frames_of('kitti', out / 'kitti'), strict=True):
        points = np.fromfile(path, '<f4').reshape(-1, 4)[:, :3]
        for box in frame.refined.boxes.boxes:  # upright
            cos, sin = np.cos(box[8]), np.sin(box[8])
            local = (points - box[:3]) @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
            # Half of the points of the cloud are on the surface of each of the two boxes.
            assert (np.abs(local) < box[3:6] / 2 + 0.3).all(axis=1).sum() > 100


def test_clouds_are_the_same_for_early_and_track_estimates(tmp_path, drive, camera):
    """With estimate=track all boxes of a track are written at its end, with their own clouds."""
    recording, _ = drive
    options = Options(with_points=True, camera=camera)
    for estimate in ('early', 'track'):
        config = QUICK.updated({'estimate': estimate, 'window': 4, 'lag': 2})
        request = Request((recording,), config=config, formats=('kitti',), options=options)
        relabel(request, tmp_path / estimate)
    a, b = (tmp_path / name / 'kitti' / 'velodyne' / '0000' for name in ('early', 'track'))
    for path in a.iterdir():
        assert path.read_bytes() == (b / path.name).read_bytes()


# Conversion ------------------------------------------------------------------------------------


def test_convert_with_poses_and_clouds_of_a_recording(tmp_path, drive, camera):
    pytest.importorskip('pyarrow')
    recording, table = drive
    options = Options(with_points=True, camera=camera)
    wanted = ('kitti', 'nuscenes', 'argoverse2', 'csv')
    asked = conversion(table, wanted, options, (recording,))
    summary = convert(asked, tmp_path / 'out')
    out = tmp_path / 'out'
    assert sorted(item.name for item in out.iterdir()) == [
        'argoverse2', 'boxes.csv', 'covariances.csv', 'kitti', 'nuscenes', 'summary.json',
        'velocities.csv',
    ]  # fmt: skip
    assert json.loads((out / 'summary.json').read_text()) == summary
    assert (summary['frames'], summary['boxes'], summary['left_out_of_labels']) == (7, 14, {})
    truth = BoxTable.read(table)
    assert BoxTable.read(out / 'boxes.csv').boxes == pytest.approx(truth.boxes, abs=1e-6)
    # Labels of a frame of the sensor that state no covariance.
    again = Request((recording,), labels=('kitti', out / 'kitti'), formats=('csv',))
    convert(again, tmp_path / 'again')
    for folder in (out, tmp_path / 'again'):
        assert read_covariances(folder / COVARIANCES) == {}
    assert len(list((out / 'nuscenes' / 'samples' / 'LIDAR_TOP').iterdir())) == 7


def test_convert_without_poses_is_refused(tmp_path, drive, camera):
    _, table = drive
    with pytest.raises(RecordingError, match=r"'kitti' can represent none of .* give --recording"):
        convert(conversion(table, ('kitti',), Options(camera=camera)), tmp_path / 'out')
    assert not (tmp_path / 'out').exists()
    with pytest.raises(ConfigError, match='give it with --recording'):
        convert(conversion(table, ('sustechpoints',), Options(with_points=True)), tmp_path / 'out')


def test_rejected_boxes_are_no_labels_of_other_formats(tmp_path, drive, capsys):
    recording, path = drive
    table = BoxTable.read(path)
    status = ('rejected', *table.status[1:])
    replace(table, status=status).write(path)
    words = [
        'convert',
        str(path),
        '--from',
        'csv',
        '--to',
        'csv,parquet',
        '-o',
        str(tmp_path / 'c'),
    ]
    assert cli.main(words) == 0
    assert '1 boxes are rejected' in capsys.readouterr().out
    assert BoxTable.read(tmp_path / 'c' / 'boxes.csv').status == status
    frames = frames_of('parquet', tmp_path / 'c' / 'parquet')
    found = [word for frame in frames for word in frame.refined.status]
    assert found == list(status[1:])
    words[-1] = str(tmp_path / 'placed')
    assert cli.main([*words, '--recording', str(recording)]) == 0
    assert '1 boxes are rejected' in capsys.readouterr().out
    assert BoxTable.read(tmp_path / 'placed' / 'boxes.csv').status == status


def test_convert_skips_unreadable_clouds(tmp_path, drive, capsys):
    _, table = drive
    broken = Drive(sweeps=7)
    broken.replace('/points', 3, lambda message: setattr(message, 'point_step', 2))
    words = ['convert', table, '-o', tmp_path / 'out', '--from', 'csv', '--to', 'csv']
    words += ['--recording', broken.write(tmp_path / 'broken')]
    assert cli.main([str(word) for word in words]) == 0
    printed = capsys.readouterr().out
    assert '14 boxes of 7 frames from csv to csv; 1 messages could not be read' in printed


def test_convert_on_the_command_line(tmp_path, drive, capsys):
    pytest.importorskip('pyarrow')
    recording, table = drive
    made, again = tmp_path / 'made', tmp_path / 'again'
    options = ['--from', 'csv', '--to', 'nuscenes,parquet', '--recording', recording]
    assert cli.main(['convert', str(table), '-o', str(made), *map(str, options)]) == 0
    options = ['--from', 'nuscenes', '--to', 'csv']
    assert cli.main(['convert', str(made / 'nuscenes'), '-o', str(again), *options]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[1] == f'{again}: 14 boxes of 7 frames from nuscenes to csv'
    found = by_track(rows_of(again))
    expected = BoxTable.read(table)
    assert [row['track_id'] for row in found] == list(expected.track_ids)
    assert [float(row['x']) for row in found] == pytest.approx(list(expected.boxes[:, 0]))
    boxes = expected.boxes.copy()
    boxes[::2, ROLL] = np.pi
    doubtful = replace(expected, track_ids=('', '1', '1') + ('1',) * 11, boxes=boxes)
    doubtful.write(tmp_path / 'doubtful.csv')
    options = ['--from=csv', '--to=openlabel', '-o', str(tmp_path / 'last')]
    assert cli.main(['convert', str(tmp_path / 'doubtful.csv'), *options]) == 0
    out = capsys.readouterr().out
    assert '; 1 boxes have no track id' in out and '; 6 boxes have the track id of another' in out
    assert out.endswith(
        '; 7 boxes lie on their sides or backs: if w of their quaternions comes '
        'first, set --orientation wxyz\n'
    )


@pytest.mark.parametrize(
    ('arguments', 'status', 'message'),
    [
        (['convert', '{csv}', '-o', '{out}', '--from', 'kiti', '--to', 'csv'], 2, 'one of csv'),
        (['convert', '{csv}', '-o', '{out}', '--from', 'csv', '--to', 'kitti'], 1,
         'no_transform 14; if the sensor poses are missing, give --recording'),
        (['convert', '{csv}', '-o', '{out}', '--from=csv', '--to=csv', '--camera', '{csv}'], 2,
         '--camera: expected a format that uses it (kitti, kitti_object), got csv; add one'),
        (['relabel', '{bag}', '-o', '{out}', '--formats', 'kitti', '--camera', '{csv}',
          '--swap-axes'], 2, 'uses it (tracklets, datumaro), got kitti'),
        (['relabel', '{bag}', '-o', '{out}', '--with-points'], 2, 'got csv, openlabel'),
        (['convert', '{out}', '-o', '{out}x', '--from', 'csv', '--to', 'csv'], 1, 'no such file'),
        (['relabel', '{bag}', '-o', '{out}', '--labels', 'csv'], 2, 'expected FORMAT:PATH'),
        (['relabel', '{bag}', '-o', '{out}', '--labels', 'kiti:{csv}'], 2, 'expected one of csv'),
        (['relabel', '{bag}', '-o', '{out}', '--labels', 'csv:{bag}'], 1, 'cannot be read as CSV'),
        (['relabel', '{bag}', '-o', '{out}', '--labels', 'csv:{csv}', '--boxes', '/boxes'], 2,
         'got both'),
    ],
)  # fmt: skip
def test_errors_are_printed_in_one_line(tmp_path, drive, capsys, arguments, status, message):
    recording, table = drive
    names = {'csv': table, 'out': tmp_path / 'out', 'bag': recording}
    try:
        found = cli.main([word.format(**names) for word in arguments])
    except SystemExit as end:
        found = end.code
    assert found == status
    assert message in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


def test_a_missing_camera_is_refused_before_a_recording_is_read(tmp_path):
    options = Options(camera=Path('missing.yaml'))
    with pytest.raises(ConfigError, match=r'missing\.yaml: cannot be read'):
        Request((tmp_path / 'missing.mcap',), formats=('kitti',), options=options)


def test_frames_that_have_no_row_in_a_table_are_counted(tmp_path, capsys):
    times = '{"1": {"frame_properties": {"timestamp": 1.0}, "objects": {}}}'
    (tmp_path / 'a.json').write_text(
        '{"openlabel": {"metadata": {"schema_version": "1.0.0"}, "frames": ' + times + '}}'
    )
    command = ['convert', str(tmp_path / 'a.json'), '-o', str(tmp_path / 'out')]
    assert cli.main([*command, '--from=openlabel', '--to=csv,waymo']) == 0
    assert '1 frames without boxes are not in csv' in capsys.readouterr().out


def test_formats_command_lists_all_formats(capsys):
    assert cli.main(['formats']) == 0
    text = capsys.readouterr().out
    for name in FORMATS:
        assert f'\n{name}: ' in f'\n{text}'
    assert 'pip install pyarrow' in text
    assert {len(row) for row in rows()} == {len(FORMAT_COLUMNS)}


def test_attributes_of_another_shape_are_refused(tmp_path, capsys):
    """A covariance of 20 numbers in place of 21, found by mutated files."""
    recording = Drive(sweeps=6).write(tmp_path / 'drive')
    out = tmp_path / 'out'
    quick = ['--set=min_observations=3', '--formats=datumaro']
    assert cli.main(['relabel', str(recording), '-o', str(out), *quick]) == 0
    (file,) = (out / 'datumaro' / 'annotations').glob('*.json')
    content = json.loads(file.read_text())
    for item in content['items']:
        for annotation in item['annotations']:
            covariance = annotation['attributes'].get('covariance')
            if covariance:
                covariance.pop()
    file.write_text(json.dumps(content))
    capsys.readouterr()
    command = ['convert', str(out / 'datumaro'), '-o', str(tmp_path / 'csv'), '--from', 'datumaro']
    assert cli.main([*command, '--to', 'csv']) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert 'expected attributes as boxreg writes them' in line
