"""`boxreg batch`: each drive once, failures apart, a second run skips drives that are done."""

from contextlib import contextmanager, suppress
from importlib.util import find_spec
import json
import os
from threading import Event, Thread

from boxreg_ros.cli import main
from boxreg_ros.errors import ConfigError
from boxreg_ros.offline.job import jobs_of
from boxreg_ros.offline.result_folder import claimed
import pytest
from relabel_results import rows_in
from ros_messages import Drive

psutil = pytest.importorskip('psutil')  # comes with Dask

# Not imported: each process that shares the tests would, also where others run these.
pytestmark = pytest.mark.skipif(find_spec('distributed') is None, reason='no Dask')
QUICK = ['--set=min_observations=3', '--set=window=5', '--set=lag=2']
DECISIONS = 'track_id,stamp_ns,decision,comment,frame_id,x,y,z,qx,qy,qz,qw,length,width,height\n'
"""Header of decisions."""


def index_of(out):
    return {row['drive']: row for row in rows_in(out / 'index.csv')}


def boxes_alone(path, out):
    """Return the boxes of a drive by `boxreg relabel`."""
    assert main(['relabel', str(path), '-o', str(out), '--formats=csv', *QUICK]) == 0
    return (out / 'boxes.csv').read_bytes()


def test_failures_are_apart_and_the_same_command_does_what_is_missing(tmp_path, capsys):
    names = ('one', 'two', 'three')
    paths = [Drive(sweeps=6).write(tmp_path / name) for name in names]
    junk = tmp_path / 'junk.mcap'
    junk.write_text('no recording')
    for name in (*names, 'junk'):
        (tmp_path / f'{name}.csv').write_text(f'{DECISIONS}1,,accept,{name}{"," * 11}\n')
    options = [f'--decisions={tmp_path}/{{drive}}.csv', '--workers=1', *QUICK]
    out = tmp_path / 'out'
    command = ['batch', *map(str, paths), str(junk), '-o', str(out), *options]
    assert main(command) == 1
    streams = capsys.readouterr()
    assert f'{out}: 3 of 4 drives done, 0 of them earlier' in streams.out
    (line,) = streams.err.splitlines()
    assert line.startswith('boxreg: junk: ')
    assert 'no message can be read' in line
    rows = index_of(out)
    assert [rows[name]['status'] for name in names] == ['done'] * 3
    assert rows['one']['last_line'].startswith(f'{out / "one"}: 12 boxes in, ')
    assert rows['junk']['status'] == 'failed'
    assert ',two,' in (out / 'two' / 'decisions.csv').read_text()
    merged = json.loads((out / 'summary.json').read_text())
    assert merged['boxes_in'] == 3 * 12
    assert list(merged['failed']) == ['junk']
    assert (out / 'one' / 'boxes.csv').read_bytes() == boxes_alone(paths[0], tmp_path / 'alone')

    # A drive is done again if its file has changed, one of its options or of its result.
    before = (out / 'one' / 'boxes.csv').stat().st_mtime_ns
    Drive(sweeps=7).write(tmp_path / 'other').replace(paths[1])
    (out / 'one' / 'review.csv').write_text('rank,track_id,risk_m\n1,7,0.25\n1,8,0.75\n')
    (tmp_path / 'three.csv').write_text(f'{DECISIONS}1,,unsure,{"," * 11}\n')
    assert main(command) == 1
    rows = index_of(out)
    assert rows['one']['status'] == 'up to date'
    assert rows['two']['status'] == rows['three']['status'] == 'done'
    assert (out / 'one' / 'boxes.csv').stat().st_mtime_ns == before
    assert rows['two']['boxes_in'] == '14'
    page = (out / 'report.html').read_text()
    assert page.index('0.75') < page.index('0.25')
    os.truncate(out / 'two' / 'boxes.csv', 0)  # as a power cut leaves it
    capsys.readouterr()
    assert main(command) == 1
    assert '3 of 4 drives done, 2 of them earlier' in capsys.readouterr().out
    assert (out / 'two' / 'boxes.csv').stat().st_size


def test_results_of_other_calls_are_said(tmp_path, capsys):
    a, b = (str(Drive(sweeps=6).write(tmp_path / name)) for name in 'ab')
    out = tmp_path / 'out'
    command = ['-o', str(out), '--workers=1', *QUICK]
    assert main(['batch', a, *command]) == 0
    (out / 'a').rename(tmp_path / 'a.corrected')  # as `boxreg review` writes it
    assert main(['batch', a, *command]) == 0
    (tmp_path / 'a.corrected').rename(out / 'a.corrected')
    assert main(['batch', a, *command]) == 0
    assert 'other results' not in capsys.readouterr().out
    (out / 'a.corrected').rename(tmp_path / 'a.corrected')
    assert main(['batch', b, *command]) == 0
    assert '1 other results in this folder are not in index.csv' in capsys.readouterr().out
    assert list(index_of(out)) == ['b']
    assert main(['batch', a, b, *command]) == 0
    assert capsys.readouterr().out == f'{out}: 2 of 2 drives done, 2 of them earlier\n'
    decisions = out / 'a' / 'decisions.csv'
    decisions.write_text(f'{DECISIONS}1,,delete,{"," * 11}\n')
    assert main(['batch', a, b, *command]) == 0
    assert f'a: its labels do not have the decisions of its review: boxreg review {out / "a"}' in (
        capsys.readouterr().err
    )
    assert main(['batch', a, b, *command, f'--decisions={decisions}']) == 2
    assert '--decisions: expected {drive} in the path' in capsys.readouterr().err


def test_results_that_miss_a_demand_are_kept_and_not_done(tmp_path, capsys):
    path = Drive(sweeps=6).write(tmp_path / 'one')
    out = tmp_path / 'out'
    command = ['batch', str(path), '-o', str(out), '--set=min_observations=9', *QUICK[1:]]
    for _ in range(2):
        assert main(command) == 1
        streams = capsys.readouterr()
        assert 'one: none of 12 boxes was refined; see "reasons" in summary.json' in streams.err
        assert '0 of 1 drives done' in streams.out
    assert len(rows_in(out / 'one' / 'boxes.csv')) == 12


@contextmanager
def killed_once(lock):
    """Kill the child process that holds a lock, once, beside the block; yield who was killed."""
    killed = []
    is_over = Event()

    def kill():
        while not (killed or is_over.wait(0.02)):
            for child in psutil.Process().children():
                with suppress(psutil.Error):
                    if any(file.path == str(lock) for file in child.open_files()):
                        child.kill()
                        killed.append(child)

    killer = Thread(target=kill)
    killer.start()
    try:
        yield killed
    finally:
        is_over.set()
        killer.join()


def test_a_drive_whose_worker_is_killed_is_done_by_another(tmp_path, capsys):
    paths = [Drive(sweeps=6).write(tmp_path / name) for name in 'ab']
    junk = tmp_path / 'junk.mcap'
    junk.write_text('no recording')
    out = tmp_path / 'out'
    command = ['batch', *map(str, paths), str(junk), '-o', str(out), '--workers=2', *QUICK]
    with killed_once(out / '.a.lock') as killed:
        assert main(command) == 1
    assert killed
    streams = capsys.readouterr()
    assert f'{out}: 2 of 3 drives done' in streams.out
    assert 'boxreg: junk: ' in streams.err
    assert 'boxreg: progress in the browser: http://127.0.0.1:' in streams.err
    for path in paths:
        alone = boxes_alone(path, tmp_path / 'alone' / path.stem)
        assert (out / path.stem / 'boxes.csv').read_bytes() == alone
    assert not [path for path in out.iterdir() if path.name.startswith('.')]


def test_the_workers_of_a_cluster_have_one_thread_each(tmp_path, capsys):
    import distributed

    path = Drive(sweeps=6).write(tmp_path / 'one')
    command = ['batch', str(path), '-o', str(tmp_path / 'out'), *QUICK]
    for threads, status in ((1, 0), (2, 1)):
        with distributed.LocalCluster(
            processes=False, n_workers=1, threads_per_worker=threads, dashboard_address=None
        ) as cluster:
            address = f'--address={cluster.scheduler_address}'
            assert main([*command, f'--set=max_gap={threads}', address]) == status
    streams = capsys.readouterr()
    assert '1 of 1 drives done' in streams.out
    words = 'boxreg: one: expected workers of Dask with one thread each, got one with 2'
    assert words in streams.err


def test_a_drive_whose_workers_are_all_killed_has_failed(tmp_path, capsys):
    import dask
    import distributed

    path = Drive(sweeps=6).write(tmp_path / 'one')
    out = tmp_path / 'out'
    options = {'n_workers': 1, 'threads_per_worker': 1, 'dashboard_address': None}
    with (
        dask.config.set({'distributed.scheduler.allowed-failures': 0}),
        distributed.LocalCluster(silence_logs='CRITICAL', **options) as cluster,
        killed_once(out / '.one.lock') as killed,
    ):
        address = f'--address={cluster.scheduler_address}'
        assert main(['batch', str(path), '-o', str(out), address, *QUICK]) == 1
    assert killed
    assert 'boxreg: one: its worker was killed 1 time' in capsys.readouterr().err
    assert not (out / 'one').exists()


def test_a_scheduler_that_does_not_answer_is_named(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr('boxreg_ros.offline.fleet.CONNECTION_SECONDS', 1)
    path = Drive(sweeps=3).write(tmp_path / 'one')
    command = ['batch', str(path), '-o', str(tmp_path / 'out'), '--address=tcp://127.0.0.1:1']
    assert main(command) == 1
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith('boxreg')]
    assert '--address tcp://127.0.0.1:1: expected a Dask scheduler that answers' in line


def test_without_dask_one_drive_is_done_after_another(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr('boxreg_ros.offline.fleet.find_spec', lambda name: None)
    paths = [str(Drive(sweeps=6).write(tmp_path / name)) for name in 'ab']
    assert main(['batch', *paths, '-o', str(tmp_path / 'out'), *QUICK]) == 0
    streams = capsys.readouterr()
    assert '2 of 2 drives done' in streams.out
    assert "pip install 'boxreg_ros[batch]'" in streams.err


def test_each_drive_begins_with_what_the_others_have_shown(tmp_path, capsys):
    paths = [Drive(sweeps=sweeps).write(tmp_path / name) for name, sweeps in (('a', 6), ('b', 8))]
    out = tmp_path / 'out'
    command = ['batch', *map(str, paths), '-o', str(out), '--learn', '--workers=1', *QUICK]
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
    (tmp_path / 'c #1.mcap').touch()
    manifest.write_text('"c #1.mcap"  # it\'s quoted\nc\\ #1.mcap\n')
    first, again = jobs_of([manifest])
    assert (first.name, first.problem) == ('c #1', '')
    assert 'got it a second time' in again.problem
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
    ('z/learning', 'z_learning'),  # that of --learn
]


def test_each_drive_has_a_name_of_its_own_in_any_order(tmp_path):
    for path, _ in NAMES:
        (tmp_path / path).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / path).touch()
    expected = {(tmp_path / path,): name for path, name in NAMES}
    for order in (NAMES, NAMES[::-1]):
        jobs = jobs_of([tmp_path / path for path, _ in order])
        assert {job.recordings: job.name for job in jobs} == expected
    # Where the names are the same with all folders, nothing is begun.
    (tmp_path / 'v').mkdir()
    (tmp_path / 'v' / 'b_c.mcap').touch()
    paths = [tmp_path / path for path in ('a_b/c.mcap', 'a/b_c.mcap', 'x/c.mcap', 'v/b_c.mcap')]
    with pytest.raises(ConfigError, match='expected each to have a name of its own'):
        jobs_of(paths)


def test_the_result_of_another_drive_is_not_replaced(tmp_path, capsys):
    out = tmp_path / 'out'
    first = Drive(sweeps=6).write(tmp_path / 'a' / 'drive')
    assert main(['batch', str(first), '-o', str(out), *QUICK]) == 0
    boxes = (out / 'drive' / 'boxes.csv').read_bytes()
    assert main(['batch', str(first), '-o', str(out / 'drive'), *QUICK]) == 1
    assert 'expected a folder for all drives, got the result of one' in capsys.readouterr().err
    other = Drive(sweeps=7).write(tmp_path / 'b' / 'drive')
    assert main(['batch', str(other), '-o', str(out), *QUICK]) == 1
    assert f'got that of {first}, whose result is in {out / "drive"}' in capsys.readouterr().err
    assert (out / 'drive' / 'boxes.csv').read_bytes() == boxes


def test_an_output_in_use_is_left_alone(tmp_path, capsys):
    path = Drive(sweeps=6).write(tmp_path / 'one')
    out = tmp_path / 'out'
    with claimed(out / 'one'):
        assert main(['batch', str(path), '-o', str(out), *QUICK]) == 1
        assert main(['relabel', str(path), '-o', str(out / 'one'), *QUICK]) == 1
    words = f"output '{out / 'one'}': expected one that no other process writes to, got one in use"
    batch, relabel = capsys.readouterr().err.splitlines()
    assert words in batch
    assert words in relabel
    assert main(['batch', str(path), '-o', str(out), *QUICK]) == 0


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


def test_wrong_options_and_no_drives_are_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(['batch', 'x.mcap', '-o', str(tmp_path), '--workers=2', '--address=tcp://x:1'])
    assert 'not allowed with argument' in capsys.readouterr().err
    assert main(['batch', 'x.mcap', '-o', str(tmp_path), '--workers=0']) == 2
    assert '--workers: expected 1 or more, got 0' in capsys.readouterr().err
    assert main(['batch', '-o', str(tmp_path)]) == 2
    assert 'at least one drive' in capsys.readouterr().err


def test_manifests_that_are_damaged_end_in_one_line(tmp_path, capsys):
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


def test_a_name_that_is_no_text_is_written_as_escapes(tmp_path):
    drive = tmp_path / os.fsdecode(b'a\xff.mcap')
    drive.write_bytes(b'')
    out = tmp_path / 'out'
    assert main(['batch', str(drive), '-o', str(out)]) == 1
    assert [*index_of(out)] == ['a\\udcff']
    assert 'href="a%FF/"' in (out / 'report.html').read_text()
