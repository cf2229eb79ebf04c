"""`boxreg relabel` with several LiDARs."""

import json
from pathlib import Path

from boxreg_ros.cli import main
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.fixed_frame import input_boxes
from boxreg_ros.io.lidars import Lidars
from boxreg_ros.io.recording import Recording
from lidar_drives import LidarDrive, LIDARS, SPEED
from measure.drives import Drive
import numpy as np
import pytest
from ros_messages import SECOND

TOPICS = ['--points', '/front', '--points', '/rear']
MERGED = Lidars(('/front', '/rear'))


def relabelled(path, out, *more):
    """Return boxes and summary of `boxreg relabel`."""
    command = ['relabel', str(path), '-o', str(out), '--formats=csv', '--set=window=5', *more]
    assert main(command) == 0
    return BoxTable.read(out / 'boxes.csv'), json.loads((out / 'summary.json').read_text())


def errors_of(drive, table):
    """Return the mean distance of the centres of boxes from the true ones [m]."""
    truth = {
        (stamp, str(track)): box[:3]
        for stamp, boxes in drive.truth.items()
        for track, box in enumerate(boxes, start=1)
    }
    keys = zip(table.stamps_ns.tolist(), table.track_ids, strict=True)
    true = np.array([truth[key] for key in keys])
    return np.linalg.norm((table.boxes[:, :3] - true)[:, :2], axis=1).mean()


def test_topics_and_info_give_the_same_boxes_and_both_are_better_than_neither(tmp_path):
    found = {}
    for clouds in ('topics', 'info', 'alone'):
        drive = LidarDrive(8, clouds)
        path = drive.write(tmp_path / clouds)
        more = ['--set=sampling.box_time=stamp', *(TOPICS if clouds == 'topics' else [])]
        found[clouds], summary = relabelled(path, tmp_path / f'out-{clouds}', *more)
        assert summary['sweeps'] == 8
        assert summary['dropped'] == {}
    difference = found['topics'].boxes - found['info'].boxes
    assert np.abs(difference).max() < 1e-3  # coordinates of clouds are float32
    errors = {name: errors_of(drive, table) for name, table in found.items()}
    assert errors['info'] < errors['alone'] < 0.05


@pytest.mark.parametrize('unknown', ['front', 'rear'])
def test_a_lidar_that_tf_does_not_know_is_counted_and_the_other_goes_on(tmp_path, capsys, unknown):
    drive = LidarDrive(6)
    mounts = drive.items[0][2].transforms
    mounts[:] = [mount for mount in mounts if mount.child_frame_id != unknown]
    path = drive.write(tmp_path / 'drive')
    table, summary = relabelled(path, tmp_path / 'out', *TOPICS)
    assert set(table.status) == {'refined'}
    assert summary['fixed_frame'] == 'odom'
    assert summary['dropped'] == {'cloud_missing': 6, 'sweep_without_transform': 6}
    (line,) = [text for text in capsys.readouterr().err.splitlines() if 'no transform' in text]
    assert f"'{unknown}'" in line
    assert '6 clouds' in line


def test_a_lidar_that_is_a_second_late_is_counted_and_the_other_goes_on(tmp_path, capsys):
    drive = LidarDrive(30)
    late = [
        (topic, received + SECOND * (topic == '/rear'), message)
        for topic, received, message in drive.items
    ]
    drive.items = sorted(late, key=lambda item: item[1])
    table, summary = relabelled(drive.write(tmp_path / 'drive'), tmp_path / 'out', *TOPICS)
    assert len(table.status) == 60
    assert set(table.status) == {'refined'}
    assert summary['lidars']['/front']['merged'] == 30
    assert summary['lidars']['/rear']['cloud_late'] == 30  # as one of another clock
    assert 'LiDAR /rear: 0 clouds merged, 30 late' in capsys.readouterr().err


def test_a_draco_stream_that_is_cut_short_is_counted_and_the_others_go_on(tmp_path, capsys):
    pytest.importorskip('DracoPy')
    drive = LidarDrive(6, 'compressed')
    clouds = [message for topic, _, message in drive.items if topic in ('/front', '/rear')]
    clouds[4].compressed_data = clouds[4].compressed_data[:20]  # of the front LiDAR
    clouds[7].compressed_data = clouds[7].compressed_data[:20]
    table, summary = relabelled(drive.write(tmp_path / 'drive'), tmp_path / 'out', *TOPICS)
    assert set(table.status) == {'refined'}
    assert summary['dropped']['unreadable'] == 2
    assert summary['lidars'] == {
        '/front': {'merged': 5, 'cloud_missing': 1}, '/rear': {'merged': 5, 'cloud_missing': 1}
    }  # fmt: skip
    error = capsys.readouterr().err
    assert 'by draco: expected a whole stream, got 20 bytes' in error
    assert 'by zstd: expected a whole stream, got 20 bytes' in error


def test_label_files_get_the_points_of_all_lidars_in_one_frame(tmp_path):
    drive = LidarDrive(4)
    path = drive.write(tmp_path / 'drive')
    out = tmp_path / 'out'
    relabelled(path, out, *TOPICS, '--formats=nuscenes', '--with-points')
    clouds = sorted(out.glob('nuscenes/**/*.bin'))
    assert len(clouds) == 4
    rows = np.fromfile(clouds[0], np.float32).reshape(-1, 5)
    assert len(rows) == 240  # of both
    center = rows[:, :3].mean(axis=0) + np.array([2, 0, 1])  # from the front LiDAR to odom
    np.testing.assert_allclose(center[:2], [12.5, 0.5], atol=1.5)


def test_every_command_reads_the_same_merged_clouds(tmp_path, capsys):
    path = LidarDrive(6).write(tmp_path / 'drive')
    relabelled(path, tmp_path / 'out', *TOPICS, '--formats=csv,nuscenes', '--with-points')
    labels = str(tmp_path / 'out' / 'boxes.csv')

    made = tmp_path / 'converted'
    command = ['convert', labels, '--from=csv', '--to=nuscenes', '--with-points', '-o', str(made)]
    assert main([*command, '--recording', str(path), *TOPICS]) == 0
    clouds = sorted((tmp_path / 'out').glob('nuscenes/**/*.bin'))
    others = sorted(made.glob('nuscenes/**/*.bin'))
    assert [file.read_bytes() for file in clouds] == [file.read_bytes() for file in others]
    assert len(clouds) == 6

    truth = BoxTable.read(Path(labels))
    drive = Drive.of(Recording([path], MERGED), truth)
    assert [len(sweep.points) for sweep in drive.sweeps] == [240] * 6
    assert [len(sweep.origins) for sweep in drive.sweeps] == [2] * 6
    assert drive.left_out == ''
    capsys.readouterr()
    assert main(['calibrate', str(path), '--truth', labels, *TOPICS]) == 0
    assert 'labelled tracks' in capsys.readouterr().out
    assert main(['evaluate', str(path), labels, *TOPICS]) == 0


def test_a_drive_names_the_sensor_of_each_track_and_counts_missing_clouds(tmp_path):
    drive = LidarDrive(4)
    rear = [item for item in drive.items if item[0] == '/rear']
    drive.items = [item for item in drive.items if item[0] != '/rear' or item is rear[0]]
    truth = BoxTable.from_arrays(input_boxes(Recording([drive.write(tmp_path / 'a')], MERGED))[0])
    found = Drive.of(Recording([tmp_path / 'a'], MERGED), truth)
    front = np.add(LIDARS['front'], [[SPEED * 0.1 * k, 0, 0] for k in range(4)])
    for track in found.tracks():
        np.testing.assert_allclose(track.sensor_origins[1:], front[1:], atol=1e-9)
    nearest = np.linalg.norm((truth.boxes[2:, :2] - front.repeat(2, axis=0)[2:, :2]), axis=1)
    np.testing.assert_allclose(found.ranges(np.arange(2, 8)), nearest)
    assert 'LiDAR /rear: 0 clouds late, 3 missing' in found.left_out


def test_topics_that_are_merged_are_suggested(tmp_path, capsys):
    path = LidarDrive(2).write(tmp_path / 'drive')
    assert main(['relabel', str(path), '-o', str(tmp_path / 'out')]) == 1
    assert '/front, /rear; choose one with --points, or merge' in capsys.readouterr().err
    command = ['relabel', str(path), '-o', str(tmp_path / 'out'), *TOPICS, '--sensor-frame=front']
    assert main(command) == 2
    assert 'sensor_frames: expected one frame for each of the 2 topics' in capsys.readouterr().err


def test_inspect_names_the_topics_in_its_command(tmp_path, capsys):
    path = LidarDrive(3).write(tmp_path / 'drive')
    assert main(['inspect', str(path), *TOPICS]) == 0
    out = capsys.readouterr().out
    assert '--points=/front --points=/rear' in out
    assert 'layout /front: unknown layout (x, y, z): no times of the points' in out
