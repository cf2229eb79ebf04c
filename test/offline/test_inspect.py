"""`boxreg inspect`: contents of a recording, and the relabel command to run."""

from itertools import pairwise
import json
import shlex

from boxreg_ros.cli import main
from paths import ROOT
import pytest
from ros_messages import Drive, SECOND, START, write_recording


def facts_of(capsys, *arguments):
    status = main(['inspect', *map(str, arguments), '--json'])
    return status, json.loads(capsys.readouterr().out)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_contents_and_the_command_to_run(tmp_path, capsys, storage):
    path = Drive(sweeps=12).write(tmp_path / 'drive', storage)
    status, facts = facts_of(capsys, path)
    assert status == 0
    pytest.importorskip('plotly')
    words = ['boxreg', 'relabel', str(path), '-o', 'out/drive', '--complete', '--report']
    assert facts['command'] == shlex.join(words)
    assert facts['seconds'] == pytest.approx(1.1, abs=1e-6)
    topics = {entry['topic']: entry for entry in facts['topics']}
    assert topics['/points']['messages'] == 12
    assert topics['/points']['rate'] == pytest.approx(10)
    assert facts['fixed_frame'] == 'odom'
    pairs = {(link['parent'], link['child']): link['is_static'] for link in facts['transforms']}
    assert pairs == {('base', 'lidar'): True, ('odom', 'base'): False}
    assert facts['connected_frames'] == [['base', 'lidar', 'odom']]
    assert topics['/points']['gaps_s'] == []
    sample = facts['sample']
    assert (sample['tracks'], sample['boxes_per_track']) == (2, 12)
    assert sample['classes'] == {'car': 'vehicle'}
    assert sample['sweep_period_s'] == pytest.approx(0.1)
    assert sample['stamp_offset_s'] == 0
    assert facts['damage'] == facts['warnings'] == facts['problems'] == []


def test_the_command_is_that_of_the_readme(capsys, monkeypatch):
    pytest.importorskip('plotly')
    monkeypatch.chdir(ROOT)
    _, facts = facts_of(capsys, 'bags/street.mcap')
    assert f'    {facts["command"]}\n' in (ROOT / 'README.md').read_text(encoding='utf-8')


def test_the_command_has_the_options_that_warnings_advise(tmp_path, capsys):
    drive = Drive(sweeps=30)
    clouds = [item for item in drive.items if item[0] == '/points']
    drive.items = [item for item in drive.items if item not in clouds[1::2]]  # at 5 Hz
    for index in range(30):
        drive.replace('/boxes', index, half_extents)
    _, facts = facts_of(capsys, drive.write(tmp_path / 'drive'))
    assert '(boxreg relabel: --set reach=0.11)' in ' '.join(facts['warnings'])
    assert ' -o out/drive --size-scale 2 --set reach=0.11 --complete' in facts['command']
    given = ['--points', '/points', '--size-scale', '4']  # what is advised takes its place
    _, facts = facts_of(capsys, tmp_path / 'drive', *given)
    expected = ' -o out/drive --points=/points --size-scale 2 --set reach=0.11 --complete'
    assert expected in facts['command']


def test_the_command_has_the_offset_that_is_advised_once(tmp_path, capsys):
    drive = Drive(sweeps=30)
    for index in range(30):
        drive.replace('/boxes', index, two_seconds_ahead)
    path = drive.write(tmp_path / 'drive')
    _, facts = facts_of(capsys, path, '--boxes-offset', '0.5')
    assert shlex.split(facts['command'])[5:-2] == ['--boxes-offset=-2']


def test_why_no_command_can_be_run(tmp_path, capsys):
    drive = Drive(motion='none')
    status, facts = facts_of(capsys, drive.write(tmp_path / 'drive'))
    assert status == 1
    assert facts['command'] == ''
    assert 'neither /tf nor odometry' in facts['problems'][0]
    drive.items = [item for item in drive.items if item[0] != '/boxes']
    assert main(['inspect', str(drive.write(tmp_path / 'other'))]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1].startswith('cannot be relabelled: ')
    assert 'no boxes' in lines[-1]


def test_arrays_without_a_box_are_named(tmp_path, capsys):
    drive = Drive(boxes='markers')
    for _, _, array in (item for item in drive.items if item[0] == '/boxes'):
        for marker in array.markers:
            marker.type = marker.LINE_LIST
    assert main(['inspect', str(drive.write(tmp_path / 'drive'))]) == 0
    assert f'warning: {len(drive.stamps)} box arrays without a box' in capsys.readouterr().out


def test_warnings_gaps_and_damage(tmp_path, capsys):
    drive = Drive(sweeps=30)
    drive.items = [
        item
        for item in drive.items
        if not (item[0] == '/points' and 5 <= (item[1] - START) * 10 // SECOND < 12)
    ]
    for index in range(30):
        drive.replace('/boxes', index, clear_ids)
    drive.replace('/boxes', 3, lambda message: setattr(message.detections[0].bbox.size, 'x', 0.0))
    path = drive.write(tmp_path / 'drive')
    data = path.read_bytes()
    path.write_bytes(data[: data.index(b'serialized_metadata')])  # behind the only chunk
    assert main(['inspect', str(path)]) == 0
    out = capsys.readouterr().out
    assert '1 gaps' in out
    assert 'damage: ' in out and 'interrupted' in out
    assert 'warning: 60 boxes have no track id' in out
    assert 'warning: 1 of 60 boxes are invalid' in out and 'an extent that is not positive' in out
    assert '  0 tracks' in out
    assert 'away from the nearest cloud' in out
    assert ' --associate --complete' in out.splitlines()[-1]


@pytest.mark.parametrize('storage', ['rosbag1', 'sqlite3'])
def test_presence_and_gaps_of_each_topic(tmp_path, capsys, storage):
    drive = Drive(sweeps=60, boxes='markers', ros1=storage == 'rosbag1')
    drive.items = [
        item
        for item in drive.items
        if not (item[0] == '/points' and 20 <= (item[1] - START) * 10 // SECOND < 40)
    ]
    path = write_recording(
        tmp_path / 'drive', drive.items, storage, drive.messages, chunk_bytes=2000
    )
    status, facts = facts_of(capsys, path)
    assert status == 0
    topics = {entry['topic']: entry for entry in facts['topics']}
    ((begin, end),) = topics['/points']['gaps_s']
    assert (begin, end) == pytest.approx((1.9, 4.0), abs=0.3)
    assert topics['/boxes']['gaps_s'] == []
    parts = pairwise(topics['/points']['presence_s'])
    assert (begin, end) in [(before[1], after[0]) for before, after in parts]


def test_transforms_with_gaps_and_frames_without_connection(tmp_path, capsys):
    drive = Drive(sweeps=30)
    kept = [item for item in drive.items if item[0] == '/tf']
    drive.items = [item for item in drive.items if item not in kept[8:14]]
    status, facts = facts_of(capsys, drive.write(tmp_path / 'drive'))
    assert status == 0
    moving = next(link for link in facts['transforms'] if not link['is_static'])
    assert len(moving['gaps_s']) == 1


def test_stamps_that_repeat_or_go_back_are_warnings(tmp_path, capsys):
    drive = Drive(sweeps=12)

    def repeat(message):
        message.header.stamp.sec = START // SECOND
        message.header.stamp.nanosec = 0

    drive.replace('/points', 5, repeat)
    _, facts = facts_of(capsys, drive.write(tmp_path / 'drive'))
    assert '1 clouds repeat the stamp of another one' in facts['warnings']
    assert any('before that of the one received' in line for line in facts['warnings'])
    assert facts['sample']['received_after_stamp_s'] == pytest.approx(0, abs=0.2)


def half_extents(message):
    for detection in message.detections:
        size = detection.bbox.size
        size.x, size.y, size.z = size.x / 2, size.y / 2, size.z / 2


def two_seconds_ahead(message):
    for one in (message, *message.detections):
        one.header.stamp.sec += 2


def clear_ids(message):
    for detection in message.detections:
        detection.id = ''
