"""`boxreg batch`: each drive once, failures isolated, a second run skips done drives."""

from functools import partial
import json
import os
from pathlib import Path
import re
import subprocess
import sys
import time

from boxreg_ros.cli import main
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.offline.batch_results import INDEX_COLUMNS
from boxreg_ros.offline.job import jobs_of
from boxreg_ros.offline.job_process import JobRunner, memory_bytes, Watch, watched
from boxreg_ros.offline.result_folder import whole_folder
from paths import ROOT
from preloaded import BOXREG, PreloadedProcess
from processes import children_of
import pytest
from relabel_results import rows_in
from ros_messages import Drive

QUICK = ['--set=min_observations=3', '--set=window=5', '--set=lag=2']
DECISIONS = 'track_id,stamp_ns,decision,comment,frame_id,x,y,z,qx,qy,qz,qw,length,width,height\n'
"""Header of decisions."""


def index_of(out):
    return {row['drive']: row for row in rows_in(out / 'index.csv')}


@pytest.mark.usefixtures('quick_python')
def test_failures_are_isolated_and_a_second_run_skips_done_drives(tmp_path, capsys):
    names = ('one', 'two', 'three')
    paths = [Drive(sweeps=6).write(tmp_path / name) for name in names]
    junk = tmp_path / 'junk.mcap'
    junk.write_text('no recording')
    for name in (*names, 'junk'):
        (tmp_path / f'{name}.csv').write_text(f'{DECISIONS}1,,accept,{name}{"," * 11}\n')
    options = [f'--decisions={tmp_path}/{{drive}}.csv', *QUICK]
    out = tmp_path / 'out'
    command = ['batch', *map(str, paths), str(junk), '-o', str(out), *options]
    assert main([*command, '--workers=2']) == 1
    streams = capsys.readouterr()
    assert f'{out}: 3 of 4 drives done, 0 of them earlier' in streams.out
    (line,) = streams.err.splitlines()
    assert line.startswith('boxreg: junk: ')
    assert 'no message can be read' in line
    rows = index_of(out)
    assert [rows[name]['status'] for name in names] == ['done'] * 3
    assert rows['junk']['status'] == 'failed'
    assert ',two,' in (out / 'two' / 'decisions.csv').read_text()
    merged = json.loads((out / 'summary.json').read_text())
    assert merged['boxes_in'] == 3 * 12
    assert list(merged['failed']) == ['junk']

    # A drive stays done when its file is touched, but not when its content changes, or that of
    # a file of its options.
    before = {name: (out / name / 'boxes.csv').stat().st_mtime_ns for name in ('one', 'two')}
    paths[0].touch()
    Drive(sweeps=7).write(tmp_path / 'other').replace(paths[1])
    (out / 'one' / 'review.csv').write_text('rank,track_id,risk_m\n1,7,0.25\n1,8,0.75\n')
    (out / 'two' / 'boxes.csv').touch()  # as a copy without times
    (tmp_path / 'three.csv').write_text(f'{DECISIONS}1,,unsure,{"," * 11}\n')
    assert main([*command, '--workers=1']) == 1
    rows = index_of(out)
    # `--workers` is no setting: it changes no result.
    assert rows['one']['status'] == 'up to date'
    assert rows['two']['status'] == rows['three']['status'] == 'done'
    assert (out / 'one' / 'boxes.csv').stat().st_mtime_ns == before['one']
    assert rows['two']['boxes_in'] == '14'
    page = (out / 'report.html').read_text()
    assert page.index('0.75') < page.index('0.25')


@pytest.mark.usefixtures('quick_python')
def test_each_drive_begins_with_what_the_others_have_shown(tmp_path, capsys):
    paths = [Drive(sweeps=sweeps).write(tmp_path / name) for name, sweeps in (('a', 6), ('b', 8))]
    out = tmp_path / 'out'
    command = ['batch', *map(str, paths), '-o', str(out), '--learn', *QUICK]
    assert main(command) == 0
    together = json.loads((out / 'input_model.json').read_text())
    own = [json.loads((out / name / 'input_model.json').read_text()) for name in ('a', 'b')]
    assert set(together['drives']) == {name for one in own for name in one['drives']}
    assert len(together['drives']) == 2
    for name in ('a', 'b'):  # its own drive does not count twice
        summary = json.loads((out / name / 'summary.json').read_text())
        assert summary['input_model']['drives'] == 1
    capsys.readouterr()
    assert main(command) == 0
    assert '2 of 2 drives done, 2 of them earlier' in capsys.readouterr().out


def test_a_call_without_progress_is_left(tmp_path):
    """As the read from a network mount that no longer answers: here from an empty pipe."""
    ends = os.pipe()
    with pytest.raises(TimeoutError):
        watched(Watch(0.2), partial(os.read, ends[0], 1))
    watch = Watch(1.0)

    def slow():
        for _ in range(6):
            time.sleep(0.2)
            watch.advanced()
        return 'done'

    assert watched(watch, slow) == 'done'
    for end in ends:
        os.close(end)


def test_manifests_patterns_and_their_errors(tmp_path):
    for name in ('a.mcap', 'b.mcap', 'c.mcap'):
        (tmp_path / name).touch()
    (tmp_path / 'x').mkdir()
    (tmp_path / 'x' / 'a.mcap').touch()
    manifest = tmp_path / 'drives.txt'
    text = '# two files of one drive\na.mcap b.mcap\n\nx/a.mcap  # another\n'
    manifest.write_text(text, encoding='utf-8-sig')  # as editors of Windows store it
    jobs = jobs_of([manifest, tmp_path / '[c]*.mcap'])
    assert [job.name for job in jobs] == [f'{tmp_path.name}_a', 'x_a', 'c']
    assert jobs[0].recordings == (tmp_path / 'a.mcap', tmp_path / 'b.mcap')
    manifest.write_text('a.mcap\nmissing.mcap\n../' + tmp_path.name + '/a.mcap\n')
    first, missing, again = jobs_of([manifest])
    assert (first.name, first.problem) == ('a', '')
    assert 'got no such file; correct its path' in missing.problem
    assert 'got it a second time; leave one out' in again.problem


NAMES = [
    ('rec/one.mcap', 'one.mcap'),  # the suffix distinguishes them
    ('rec/one.db3', 'one.db3'),
    ('rec/x.mcap', 'rec_x'),
    ('a_b/c.mcap', 'a_b_c'),
    ('a/b_c.mcap', 'b_c'),
    ('x/c.mcap', 'x_c'),
    ('y/x.mcap.zstd', 'y_x'),
    ('dated/2024-01-01-10.30.00', '2024-01-01-10.30.00'),
    ('dated/2024-01-01-10.30.05', '2024-01-01-10.30.05'),
    ('drive.001', 'drive.001'),
    ('drive.002', 'drive.002'),
    ('z/jobs', 'z_jobs'),  # that of the logs
]


def test_each_drive_has_a_name_of_its_own_in_any_order(tmp_path):
    for path, _ in NAMES:
        (tmp_path / path).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / path).touch()
    expected = {(tmp_path / path,): name for path, name in NAMES}
    for order in (NAMES, NAMES[::-1]):
        jobs = jobs_of([tmp_path / path for path, _ in order])
        assert {job.recordings: job.name for job in jobs} == expected
    # A part of the drives keeps the names that they have; another drive does not take one.
    known = {name: [str(tmp_path / path)] for path, name in NAMES}
    (tmp_path / 'v').mkdir()
    (tmp_path / 'v' / 'b_c.mcap').touch()
    (c, x, other) = jobs_of(
        [tmp_path / p for p in ('x/c.mcap', 'y/x.mcap.zstd', 'v/b_c.mcap')], known
    )
    assert (c.name, x.name, other.name) == ('x_c', 'y_x', 'v_b_c')
    # Nor does the time of a shard matter: one of two drives may be done.
    some = NAMES[:6]
    known = {name: [str(tmp_path / path)] for path, name in some[::2]}
    jobs = jobs_of([tmp_path / path for path, _ in some], known)
    assert [job.name for job in jobs] == [name for _, name in some]
    # Where the names are the same with all folders, nothing is begun.
    paths = [tmp_path / path for path in ('a_b/c.mcap', 'a/b_c.mcap', 'x/c.mcap', 'v/b_c.mcap')]
    with pytest.raises(ConfigError, match='expected each to have a name of its own'):
        jobs_of(paths)


@pytest.mark.usefixtures('quick_python')
def test_the_result_of_another_drive_is_not_replaced(tmp_path, capsys):
    out = tmp_path / 'out'
    first = Drive(sweeps=6).write(tmp_path / 'a' / 'drive')
    assert main(['batch', str(first), '-o', str(out), *QUICK]) == 0
    boxes = (out / 'drive' / 'boxes.csv').read_bytes()
    copy = tmp_path / 'b' / 'drive'
    copy.parent.mkdir()
    first.rename(copy)  # moved: it is the same drive
    assert main(['batch', str(copy), '-o', str(out), *QUICK]) == 0
    assert '1 of them earlier' in capsys.readouterr().out
    single = out / 'drive'
    assert main(['batch', str(copy), '-o', str(single), *QUICK]) == 1
    assert 'expected a folder for all drives, got the result of one' in capsys.readouterr().err
    copy.unlink()
    other = Drive(sweeps=7).write(tmp_path / 'c' / 'drive')
    assert main(['batch', str(other), '-o', str(out), *QUICK]) == 1
    assert f'got that of {copy}, whose result is in {out / "drive"}' in capsys.readouterr().err
    assert (out / 'drive' / 'boxes.csv').read_bytes() == boxes


def test_a_second_run_leaves_the_first_and_its_files_alone(tmp_path, capsys):
    paths = [Drive(sweeps=n).write(tmp_path / str(n)) for n in (6, 60)]
    out = tmp_path / 'out'
    command = ['batch', *map(str, paths), '-o', str(out), *QUICK]
    first = PreloadedProcess(BOXREG, command, {}, tmp_path / 'log')
    while not list(out.glob('.60.partial')):
        assert first.poll() is None
        time.sleep(0.02)
    assert main(['batch', str(paths[0]), '-o', str(out), *QUICK]) == 1
    assert main(['relabel', str(paths[1]), '-o', str(out / '60'), *QUICK]) == 1
    batch, relabel = capsys.readouterr().err.splitlines()
    assert f"output '{out}': expected an output that no other process writes to" in batch
    assert f'in use by process {first.pid} on ' in batch
    assert f"output '{out / '60'}': expected an output that no other process" in relabel
    assert first.wait() == 0
    assert {row['status'] for row in index_of(out).values()} == {'done'}
    assert sorted(path.name for path in out.iterdir()) == [
        '6', '60', 'index.csv', 'jobs', 'report.html', 'summary.json',
    ]  # fmt: skip


def test_a_drive_without_progress_or_with_too_much_memory_is_ended(tmp_path, capsys):
    path = Drive(sweeps=6).write(tmp_path / 'one')
    out = tmp_path / 'out'
    assert main(['batch', str(path), '-o', str(out), '--timeout=0.2', *QUICK]) == 1
    assert 'no progress for 0.2 s: raise --timeout' in capsys.readouterr().err
    assert main(['batch', str(path), '-o', str(out), '--memory=0.01', *QUICK]) == 1
    assert 'it took more than 0.01 GB of memory: raise --memory' in capsys.readouterr().err
    journal = {'.one.journal', '.one.journal-wal'}  # to go on with
    shown = {item.name for item in out.iterdir()} - journal
    assert shown == {'jobs', 'index.csv', 'summary.json', 'report.html'}


@pytest.mark.usefixtures('quick_python')
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


@pytest.mark.usefixtures('quick_python')
def test_shards_of_the_recipe_for_slurm_are_merged_to_the_results_of_one_run(tmp_path, capsys):
    paths = [str(Drive(sweeps=n).write(tmp_path / name)) for n, name in ((5, '=5'), (6, '6'))]
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
    rows = index_of(out)
    assert [rows[name]['boxes_in'] for name in ("'=5", '6')] == ['10', '12']  # no formula
    assert 'href="%3D5/"' in (out / 'report.html').read_text()
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
    assert main(['batch', 'x.mcap', '-o', str(tmp_path), '--address=x:1']) == 2
    assert 'add --engine ray' in capsys.readouterr().err
    assert main(['batch', 'x.mcap', '-o', str(tmp_path), '--memory=inf']) == 2
    assert 'expected more than 0' in capsys.readouterr().err
    assert main(['batch', '-o', str(tmp_path)]) == 2
    assert 'at least one drive' in capsys.readouterr().err


def test_files_of_a_fleet_that_are_damaged_end_in_one_line(tmp_path, capsys, monkeypatch):
    out = tmp_path / 'out'
    manifest = tmp_path / 'drives.txt'
    for content, words in (
        ('a.mcap\n'.encode('utf-16'), 'expected a text in UTF-8'),
        (b"it's.mcap\n", 'No closing quotation'),
        (b'a\0b.mcap\n', 'a NUL character'),
        (b'# none\n', 'expected at least one drive'),
    ):
        manifest.write_bytes(content)
        assert main(['batch', str(manifest), '-o', str(out)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert words in line
    index = tmp_path / 'index.1-of-1.csv'
    for text in ('drive\none\n', ','.join(INDEX_COLUMNS) + '\n' + 'many,' * 13, '\xff'):
        index.write_text(text, encoding='latin-1')
        assert main(['batch', '--merge', '-o', str(tmp_path)]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert f'{index}: expected the index of a shard, got an error in' in line
    # A name that is no text, and a state that is none; the process of the drive fails.
    script = tmp_path / 'python'
    script.write_text('#!/bin/sh\nexit 1\n')
    script.chmod(0o755)
    monkeypatch.setattr('sys.executable', str(script))
    drive = tmp_path / os.fsdecode(b'a\xff.mcap')
    drive.write_bytes(b'')
    (out / 'jobs').mkdir(parents=True)
    (out / 'jobs' / 'a.json').write_text('{"key": 1, "recordings": 5, "files": 0, "peak_mb": 0}')
    assert main(['batch', str(drive), '-o', str(out)]) == 1
    assert 'ended with status 1' in capsys.readouterr().err
    assert [*index_of(out)] == ['a\\udcff']
    assert 'href="a%FF/"' in (out / 'report.html').read_text()


def test_a_killed_process_is_tried_again_and_named(tmp_path, monkeypatch):
    path = Drive(sweeps=6).write(tmp_path / 'one')
    script = tmp_path / 'python'
    script.write_text('#!/bin/sh\nkill -9 $$\n')  # as the system does where memory is short
    script.chmod(0o755)
    monkeypatch.setattr('sys.executable', str(script))
    (job,) = jobs_of([path])
    result = JobRunner(tmp_path / 'out', (), '', retries=2)(job)
    assert (result.status, result.exit_status, result.attempts) == ('failed', -9, 3)
    assert 'killed by signal 9; the most frequent cause is too little memory' in result.last_line


def test_a_drive_that_goes_on_has_no_limit_of_time(tmp_path, monkeypatch):
    path = Drive(sweeps=6).write(tmp_path / 'one')
    reader, writer = os.pipe()
    monkeypatch.setenv('BOXREG_PROGRESS', str(writer))
    assert main(['relabel', str(path), '-o', str(tmp_path / 'alone'), *QUICK]) == 0
    assert len(os.read(reader, 100)) >= 5  # for each sweep behind the first
    script = tmp_path / 'python'
    steps = 'os.write(int(os.environ["BOXREG_PROGRESS"]), b"."), time.sleep(0.1)'
    script.write_text(f'#!{sys.executable}\nimport os, time\nfor _ in range(30): {steps}\n')
    script.chmod(0o755)
    monkeypatch.setattr('sys.executable', str(script))
    (job,) = jobs_of([path])
    result = JobRunner(tmp_path / 'out', (), '', timeout=2.5)(job)
    assert (result.exit_status, result.status) == (0, 'done')
    assert result.seconds > 2.5
    for end in (reader, writer):
        os.close(end)


def test_a_batch_that_is_killed_takes_its_processes_with_it(tmp_path):
    path = Drive(sweeps=60).write(tmp_path / 'one')
    out = tmp_path / 'out'
    batch = subprocess.Popen(
        [sys.executable, '-m', 'boxreg_ros.cli', 'batch', str(path), '-o', str(out)],
        stdout=subprocess.DEVNULL,
    )
    found = []
    while not found:
        assert batch.poll() is None
        time.sleep(0.05)
        found = children_of(batch.pid)
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
