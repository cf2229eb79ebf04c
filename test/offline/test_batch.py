"""`boxreg batch`: each drive once, failures isolated, a second run skips done drives."""

import csv
import json
import os
from pathlib import Path
import re
import subprocess
import sys
import time

from boxreg_ros.cli import main
from boxreg_ros.errors import RecordingError
from boxreg_ros.offline.job import jobs_of
from boxreg_ros.offline.job_process import JobRunner, memory_bytes
from boxreg_ros.offline.result_folder import whole_folder
from paths import ROOT
import pytest
from ros_messages import Drive

QUICK = ['--set=min_observations=3', '--set=window=5', '--set=lag=2']


def index_of(out):
    with (out / 'index.csv').open(newline='') as file:
        return {row['drive']: row for row in csv.DictReader(file)}


def test_failures_are_isolated_and_a_second_run_skips_done_drives(tmp_path, capsys):
    paths = [Drive(sweeps=6).write(tmp_path / name) for name in ('one', 'two')]
    junk = tmp_path / 'junk.mcap'
    junk.write_text('no recording')
    out = tmp_path / 'out'
    command = ['batch', *map(str, paths), str(junk), '-o', str(out), '--workers=2', *QUICK]
    assert main(command) == 1
    streams = capsys.readouterr()
    assert f'{out}: 2 of 3 drives done, 0 of them earlier' in streams.out
    (line,) = streams.err.splitlines()
    assert line.startswith('boxreg: junk: ')
    assert 'no message can be read' in line
    rows = index_of(out)
    assert [rows[name]['status'] for name in ('one', 'two', 'junk')] == ['done', 'done', 'failed']
    merged = json.loads((out / 'summary.json').read_text())
    assert merged['boxes_in'] == 2 * 12
    assert list(merged['failed']) == ['junk']

    # A drive stays done when its file is touched, but not when its content changes.
    before = {name: (out / name / 'boxes.csv').stat().st_mtime_ns for name in ('one', 'two')}
    paths[0].touch()
    Drive(sweeps=7).write(tmp_path / 'other').replace(paths[1])
    (out / 'one' / 'review.csv').write_text('rank,track_id,risk_m\n1,7,0.25\n1,8,0.75\n')
    assert main([*command[:-3], '--workers=1', *QUICK]) == 1
    rows = index_of(out)
    # `--workers` is no setting: it changes no result.
    assert rows['one']['status'] == 'up to date'
    assert rows['two']['status'] == 'done'
    assert (out / 'one' / 'boxes.csv').stat().st_mtime_ns == before['one']
    assert rows['two']['boxes_in'] == '14'
    page = (out / 'report.html').read_text()
    assert page.index('0.75') < page.index('0.25')


def test_a_drive_that_takes_too_long_is_ended_and_leaves_nothing(tmp_path, capsys):
    path = Drive(sweeps=6).write(tmp_path / 'one')
    out = tmp_path / 'out'
    assert main(['batch', str(path), '-o', str(out), '--timeout=0.2', *QUICK]) == 1
    assert 'not done after 0.2 s' in capsys.readouterr().err
    assert {item.name for item in out.iterdir()} == {
        'jobs', 'index.csv', 'summary.json', 'report.html',
    }  # fmt: skip


def test_a_drive_whose_files_take_too_long_to_read_fails(tmp_path):
    endless = tmp_path / 'endless.mcap'
    endless.touch()
    os.truncate(endless, 10**12)  # without blocks on the disk; to hash it takes half an hour
    command = ['batch', str(endless), '-o', str(tmp_path / 'out'), '--timeout=0.2']
    # The thread that reads ends with the process.
    batch = [sys.executable, '-m', 'boxreg_ros.cli', *command]
    done = subprocess.run(batch, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr == (
        'boxreg: endless: its files were not read after 0.2 s: check their disk or network mount, '
        'or raise --timeout\n'
    )


def test_manifests_patterns_and_their_errors(tmp_path):
    for name in ('a.mcap', 'b.mcap', 'c.mcap'):
        (tmp_path / name).touch()
    (tmp_path / 'x').mkdir()
    (tmp_path / 'x' / 'a.mcap').touch()
    manifest = tmp_path / 'drives.txt'
    manifest.write_text('# two files of one drive\na.mcap b.mcap\n\nx/a.mcap  # another\n')
    jobs = jobs_of([manifest, tmp_path / '[c]*.mcap'])
    assert [job.name for job in jobs] == ['a', 'x_a', 'c']
    assert jobs[0].recordings == (tmp_path / 'a.mcap', tmp_path / 'b.mcap')
    manifest.write_text('a.mcap\nmissing.mcap\n../' + tmp_path.name + '/a.mcap\n')
    first, missing, again = jobs_of([manifest])
    assert (first.name, first.status) == ('a', 'waiting')
    assert missing.status == again.status == 'failed'
    assert 'got no such file; correct its path' in missing.last_line
    assert 'got it a second time; leave one out' in again.last_line


def test_missing_and_repeated_drives_fail_and_the_others_go_on(tmp_path, capsys):
    path = Drive(sweeps=6).write(tmp_path / 'one')
    out = tmp_path / 'out'
    missing = tmp_path / 'missing.mcap'
    command = ['batch', str(path), str(missing), str(path), '-o', str(out), *QUICK]
    assert main(command) == 1
    streams = capsys.readouterr()
    assert f'{out}: 1 of 3 drives done' in streams.out
    assert sorted(streams.err.splitlines()) == sorted(
        [
            f'boxreg: {missing}: expected a recording, got no such file; correct its path, or '
            f'leave it out',
            f'boxreg: {path}: expected each recording once, got it a second time; leave one out',
        ]
    )


def test_shards_of_the_recipe_for_slurm_are_merged_to_the_results_of_one_run(tmp_path, capsys):
    paths = [str(Drive(sweeps=n).write(tmp_path / str(n))) for n in (5, 6)]
    (tmp_path / 'drives.txt').write_text('\n'.join(paths))
    out = tmp_path / 'out'
    page = (ROOT / 'docs' / 'tasks' / 'many-recordings.md').read_text()
    (recipe,) = re.findall("--wrap '(.+)'", page)
    recipe = recipe.replace('/shared/out', str(out)).replace('/8', '/2')
    program = tmp_path / 'bin' / 'boxreg'  # colcon installs it where only `ros2 run` looks
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m boxreg_ros.cli "$@"\n')
    program.chmod(0o755)

    def run_shard(number):
        environment = {
            **os.environ,
            'SLURM_ARRAY_TASK_ID': str(number),
            'PATH': f'{program.parent}:{os.environ["PATH"]}',
        }
        command = ['sh', '-c', f'{recipe} {" ".join(QUICK)}']
        subprocess.run(command, env=environment, cwd=tmp_path, check=True)

    run_shard(1)
    assert main(['batch', '-o', str(out), '--merge']) == 1
    assert 'got all but 2; run these first' in capsys.readouterr().err
    run_shard(2)
    assert main(['batch', '-o', str(out), '--merge']) == 0
    assert f'{out}: 2 of 2 drives done' in capsys.readouterr().out
    assert [row['boxes_in'] for row in index_of(out).values()] == ['10', '12']
    merged = json.loads((out / 'summary.json').read_text())
    # One run over all drives finds them done, and writes the same.
    assert main(['batch', *paths, '-o', str(out), *QUICK]) == 0
    assert '2 of them earlier' in capsys.readouterr().out
    again = json.loads((out / 'summary.json').read_text())
    times = dict.fromkeys(('seconds', 'peak_mb'))
    assert {**merged, **times} == {**again, **times}
    assert merged['boxes_in'] == 2 * (5 + 6)


def test_wrong_shards_and_no_drives_are_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(['batch', 'x.mcap', '-o', str(tmp_path), '--shard=3/2'])
    assert 'expected I/N' in capsys.readouterr().err
    assert main(['batch', '-o', str(tmp_path)]) == 2
    assert main(['batch', 'x.mcap', '-o', str(tmp_path), '--address=x:1']) == 2
    assert 'add --engine ray' in capsys.readouterr().err


def test_a_killed_process_is_tried_again_and_named(tmp_path, monkeypatch):
    path = Drive(sweeps=6).write(tmp_path / 'one')
    script = tmp_path / 'python'
    script.write_text('#!/bin/sh\nkill -9 $$\n')  # as the system does where memory is short
    script.chmod(0o755)
    monkeypatch.setattr('sys.executable', str(script))
    (job,) = jobs_of([path])
    JobRunner(tmp_path / 'out', (), '', retries=2)(job)
    assert (job.status, job.exit_status, job.attempts) == ('failed', -9, 3)
    assert 'killed by signal 9; the most frequent cause is too little memory' in job.last_line


def test_a_batch_that_is_killed_takes_its_processes_with_it(tmp_path):
    path = Drive(sweeps=60).write(tmp_path / 'one')
    out = tmp_path / 'out'
    batch = subprocess.Popen(
        [sys.executable, '-m', 'boxreg_ros.cli', 'batch', str(path), '-o', str(out)],
        stdout=subprocess.DEVNULL,
    )
    children = Path(f'/proc/{batch.pid}/task')
    found = []
    while not found:
        assert batch.poll() is None
        time.sleep(0.05)
        lists = [task / 'children' for task in children.iterdir()]
        found = [child for text in lists for child in text.read_text().split()]
    assert memory_bytes(batch.pid) > 0
    batch.kill()
    batch.wait()
    deadline = time.monotonic() + 20
    while Path(f'/proc/{found[0]}/exe').exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not Path(f'/proc/{found[0]}/exe').exists()


def test_a_full_disk_is_named_and_nothing_is_written(tmp_path):
    out = tmp_path / 'out'
    with pytest.raises(RecordingError, match=r"output '.*/out'.*No space left"):  # noqa: SIM117
        with whole_folder(out) as folder:
            (folder / 'boxes.csv').symlink_to('/dev/full')
            (folder / 'boxes.csv').write_text('x')
    assert list(tmp_path.iterdir()) == []
