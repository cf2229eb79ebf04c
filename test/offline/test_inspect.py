"""`boxreg inspect`: contents of a recording, and the relabel command to run."""

import json
import shlex

from boxreg_ros.cli import main
import pytest
from ros_messages import Drive, SECOND, START


def facts_of(capsys, *arguments):
    status = main(['inspect', *map(str, arguments), '--json'])
    return status, json.loads(capsys.readouterr().out)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_contents_and_the_command_to_run(tmp_path, capsys, storage):
    path = Drive(sweeps=12).write(tmp_path / 'drive', storage)
    status, facts = facts_of(capsys, path)
    assert status == 0
    assert facts['command'] == shlex.join(['boxreg', 'relabel', str(path), '-o', 'out/drive'])
    assert facts['seconds'] == pytest.approx(1.1, abs=1e-6)
    topics = {entry['topic']: entry for entry in facts['topics']}
    assert topics['/points']['messages'] == 12
    assert topics['/points']['rate'] == pytest.approx(10)
    assert facts['fixed_frame'] == 'odom'
    assert set(facts['transforms']) == {'base -> lidar', 'odom -> base'}
    sample = facts['sample']
    assert (sample['tracks'], sample['boxes_per_track']) == (2, 12)
    assert sample['classes'] == {'car': 'vehicle'}
    assert sample['sweep_period_s'] == pytest.approx(0.1)
    assert sample['stamp_offset_s'] == 0
    assert facts['damage'] == facts['warnings'] == facts['problems'] == []


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


def test_warnings_gaps_and_damage(tmp_path, capsys):
    drive = Drive(sweeps=30)
    drive.items = [
        item
        for item in drive.items
        if not (item[0] == '/points' and 5 <= (item[1] - START) * 10 // SECOND < 12)
    ]
    for index in range(30):
        drive.replace('/boxes', index, clear_ids)
    path = drive.write(tmp_path / 'drive')
    data = path.read_bytes()
    path.write_bytes(data[: data.index(b'serialized_metadata')])  # behind the only chunk
    assert main(['inspect', str(path)]) == 0
    out = capsys.readouterr().out
    assert '1 gaps' in out
    assert 'damage: ' in out and 'interrupted' in out
    assert 'warning: 60 boxes have no track id' in out
    assert 'away from the nearest cloud' in out
    assert out.splitlines()[-1].endswith('--associate')


def clear_ids(message):
    for detection in message.detections:
        detection.id = ''
