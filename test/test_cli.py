import fcntl
import io
import os
import pty
import signal
import struct
import subprocess
import sys
import termios
import time

from boxreg_ros import cli
from boxreg_ros.config import Config
from paths import ROOT
import pytest
from ros_messages import Drive

QUICK = ['--set', 'solver.rounds=1', '--set', 'solver.iterations=3']


def boxreg(capsys, *arguments):
    """Run the command in this process; return exit status, stdout and stderr."""
    try:
        status = cli.main([str(argument) for argument in arguments])
    except SystemExit as end:  # how argparse ends
        status = end.code
    out, err = capsys.readouterr()
    assert 'Traceback' not in err
    return status, out, err


def started(*arguments, **options):
    """Start the command in a process of its own."""
    command = [sys.executable, '-m', 'boxreg_ros.cli', *map(str, arguments)]
    return subprocess.Popen(command, cwd=ROOT, text=True, **options)


def test_relabel_says_in_one_line_what_was_done(tmp_path, capsys):
    recording = Drive(sweeps=5).write(tmp_path / 'drive')
    out = tmp_path / 'out'
    status, text, err = boxreg(capsys, 'relabel', recording, '-o', out, *QUICK)
    assert (status, err) == (0, '')
    (line,) = text.splitlines()
    assert line.startswith(f'{out}: 10 boxes in, ')
    assert 'refined' in line
    assert 'kept' in line
    assert 'from 5 sweeps in' in line
    assert 'fixed frame odom' in line
    assert (out / 'boxes.csv').exists()


def test_all_options_reach_the_run(tmp_path, capsys):
    drive = Drive(sweeps=8, motion='odometry')
    recording = drive.write(tmp_path / 'drive')
    config = tmp_path / 'config.yaml'
    config.write_text('window: 4\nlag: 2\nsolver: {rounds: 1, iterations: 7}\n')
    options = [
        '--points', '/points', '--boxes', '/boxes', '--odometry', '/odom', '--fixed-frame', 'odom',
        '--config', config, '--set', 'solver.iterations=3', '--set', 'estimate=final',
        '--set', 'sampling.margin=0.5', '--formats', 'csv', '--start', '0.1', '--end', '0.6',
        '--workers', '1',
    ]  # fmt: skip
    out = tmp_path / 'out'
    status, text, _ = boxreg(capsys, 'relabel', recording, '-o', out, *options)
    assert status == 0
    assert ': 10 boxes in' in text
    used = Config.from_yaml(out / 'config.yaml')
    assert (used.window, used.lag, used.estimate) == (4, 2, 'final')
    assert (used.solver.rounds, used.solver.iterations) == (1, 3)
    assert used.sampling.margin == 0.5
    assert not (out / 'openlabel').exists()


def test_resume_does_what_is_left_to_do(tmp_path, capsys):
    recording = Drive(sweeps=3).write(tmp_path / 'drive')
    command = ['relabel', recording, '-o', tmp_path / 'out', *QUICK, '--resume']
    assert ' boxes in' in boxreg(capsys, *command)[1]
    before = (tmp_path / 'out' / 'boxes.csv').stat().st_mtime_ns
    assert 'already there' in boxreg(capsys, *command)[1]
    assert (tmp_path / 'out' / 'boxes.csv').stat().st_mtime_ns == before
    assert ' boxes in' in boxreg(capsys, *command, '--set', 'max_gap=0.9')[1]


def test_resume_where_results_lie_in_the_recording_or_are_gone(tmp_path, capsys):
    folder = Drive(sweeps=3).write(tmp_path / 'drive', 'sqlite3')
    out = folder / 'out'
    formats = 'openlabel,mcap'
    command = ['relabel', folder, '-o', out, *QUICK, '--formats', formats, '--report', '--resume']
    assert ' boxes in' in boxreg(capsys, *command)[1]
    assert 'already there' in boxreg(capsys, *command)[1]
    for name in ('boxes.csv', 'overlay.mcap', 'report.html', 'openlabel/labels.json'):
        (out / name).unlink()
        assert ' boxes in' in boxreg(capsys, *command)[1], f'without {name}'


@pytest.mark.parametrize(
    ('options', 'status', 'expected'),
    [
        (['--points', '/lidar'], 1, "no topic '/lidar'; topics with point clouds: /points"),
        (['--boxes', '/points'], 1, 'Detection3DArray'),
        (['--fixed-frame', 'world'], 1, "fixed frame 'world'"),
        (['--fixed-frame', 'world'], 1, 'leave --fixed-frame out to have one chosen'),
        (['--start', '9'], 1, 'start and end'),
        (['--start', 'nan'], 2, 'start: expected seconds from the beginning, got nan'),
        (['--end', 'inf'], 2, 'end: expected seconds from the beginning, got inf'),
        (['--set', 'windw=5'], 2, 'windw: no such setting'),
        (['--set', 'window=five'], 2, 'window: expected int'),
        (['--set', 'window=2'], 2, 'window: expected 3 to 1000'),
        (['--set', 'window'], 2, 'expected KEY=VALUE'),
        (['--set', 'names=[a'], 2, 'not a YAML value'),
        (['--config', 'no_such.yaml'], 2, 'no_such.yaml'),
        (['--formats', 'csv,kiti'], 2, "format 'kiti'"),
        (['--workers', '-1'], 2, 'solver.threads'),
        (['--frobnicate'], 2, '--frobnicate'),
    ],
)
def test_failures_take_one_line(tmp_path, capsys, options, status, expected):
    recording = Drive(sweeps=2).write(tmp_path / 'drive')
    got, out, err = boxreg(capsys, 'relabel', recording, '-o', tmp_path / 'out', *options)
    assert (got, out) == (status, '')
    assert expected in err
    if 'usage:' not in err:
        assert len(err.splitlines()) == 1
        assert err.startswith('boxreg: ')
    assert not (tmp_path / 'out').exists()


def test_missing_file_and_missing_arguments(tmp_path, capsys):
    status, _, err = boxreg(capsys, 'relabel', tmp_path / 'none.mcap', '-o', tmp_path / 'out')
    assert status == 1
    assert 'no such recording' in err
    assert boxreg(capsys, 'relabel', tmp_path)[0] == 2
    assert boxreg(capsys)[0] == 2
    assert boxreg(capsys, 'relable')[0] == 2


def test_folder_that_cannot_be_written(tmp_path, capsys):
    recording = Drive(sweeps=2).write(tmp_path / 'drive')
    (tmp_path / 'file').touch()
    status, _, err = boxreg(capsys, 'relabel', recording, '-o', tmp_path / 'file' / 'out')
    assert status == 1
    assert len(err.splitlines()) == 1


def test_unexpected_errors_point_to_debug(tmp_path, capsys, monkeypatch):
    def broken(args):
        raise ZeroDivisionError('impossible')

    from boxreg_ros.offline import relabel

    monkeypatch.setattr(relabel, 'run', broken)
    status, _, err = boxreg(capsys, 'relabel', 'a', '-o', 'b')
    assert status == 1
    assert err == 'boxreg: unexpected ZeroDivisionError: impossible (--debug shows where)\n'
    with pytest.raises(ZeroDivisionError):
        cli.main(['relabel', 'a', '-o', 'b', '--debug'])
    with pytest.raises(ZeroDivisionError):
        cli.main(['--debug', 'relabel', 'a', '-o', 'b'])


def test_help_and_version(capsys):
    status, out, _ = boxreg(capsys, '--help')
    assert status == 0
    assert all(name in out for name in ('relabel', 'evaluate', 'simulate', 'bench', 'node'))
    status, out, _ = boxreg(capsys, '--version')
    assert (status, out.split()[0]) == (0, 'boxreg')
    status, out, _ = boxreg(capsys, 'relabel', '--help')
    assert status == 0
    for option in (
        '--points', '--boxes', '--fixed-frame', '--odometry', '--config', '--set', '--formats',
        '--start', '--end', '--resume', '--workers',
    ):  # fmt: skip
        assert option in out


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interrupt_leaves_nothing(tmp_path, number):
    recording = Drive(sweeps=60).write(tmp_path / 'drive')
    ours = signal.signal(number, signal.SIG_DFL)  # the suite itself may be run by nohup
    process = started(
        'relabel', recording, '-o', tmp_path / 'results' / 'out',
        '--set', 'solver.rounds=100', '--set', 'solver.iterations=10000',
        '--set', 'solver.tolerance=0', '--set', 'estimate=early',
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    signal.signal(number, ours)
    deadline = time.monotonic() + 60
    while not any((tmp_path / 'results').glob('.out.*')) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    # Started by -m, Python ends by the signal itself where that came amid an exec() of text, as
    # of rosbags' generated readers; a shell shows 130 for both.
    assert process.returncode in ((130, -number) if number == signal.SIGINT else (128 + number,))
    how = 'interrupted' if number == signal.SIGINT else f'ended by {number.name}'
    assert (out, err) == ('', f'boxreg: {how}; nothing was written\n')
    assert list((tmp_path / 'results').iterdir()) == []


def test_a_hangup_does_not_end_what_is_run_by_nohup(tmp_path):
    recording = Drive(sweeps=20).write(tmp_path / 'drive')
    command = ['nohup', sys.executable, '-m', 'boxreg_ros.cli', 'relabel', recording]
    silent = {'stdout': subprocess.DEVNULL, 'stderr': subprocess.DEVNULL}
    process = subprocess.Popen([*command, '-o', tmp_path / 'out', *QUICK], cwd=ROOT, **silent)
    deadline = time.monotonic() + 60
    while not any(tmp_path.glob('.out.*')) and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGHUP)
    assert process.wait(timeout=60) == 0
    assert (tmp_path / 'out' / 'boxes.csv').exists()


def test_names_that_a_terminal_cannot_show(tmp_path):
    recording = Drive(sweeps=2).write(tmp_path / 'drive')
    process = started(
        'relabel', recording, '-o', tmp_path / 'ü', *QUICK, stdout=subprocess.PIPE,
        env=os.environ | {'PYTHONIOENCODING': 'ascii'},
    )  # fmt: skip
    out = process.communicate(timeout=60)[0]
    assert process.returncode == 0
    assert '\\xfc: 4 boxes in' in out


def test_reader_that_goes_away_is_no_error(tmp_path):
    recording = Drive(sweeps=2).write(tmp_path / 'drive')
    process = started(
        'relabel', recording, '-o', tmp_path / 'out', *QUICK,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    process.stdout.close()
    err = process.stderr.read()
    process.stderr.close()
    assert (process.wait(timeout=60), err) == (0, '')
    assert (tmp_path / 'out' / 'boxes.csv').exists()


def test_progress_bar_only_for_people(tmp_path):
    recording = Drive(sweeps=4).write(tmp_path / 'drive')
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack('HHHH', 24, 100, 0, 0))
    process = started(
        'relabel', recording, '-o', tmp_path / 'out', *QUICK,
        stdout=subprocess.PIPE, stderr=follower,
    )  # fmt: skip
    os.close(follower)
    seen = io.BytesIO()
    try:
        while chunk := os.read(leader, 4096):
            seen.write(chunk)
    except OSError:  # the other end is closed
        pass
    os.close(leader)
    out = process.communicate(timeout=60)[0]
    assert process.returncode == 0
    assert len(out.splitlines()) == 1
    assert b's of the recording' in seen.getvalue()
