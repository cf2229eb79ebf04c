"""The command line: arguments, exit status, one line per failure, signals."""

import errno
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
from boxreg_ros.errors import unreadable
from boxreg_ros.reasons import Reason
from paths import ROOT
import pytest
from ros_messages import Drive

QUICK = ['--set', 'solver.rounds=1']
SLOW = [
    '--set', 'objective=paper', '--set', 'paper.iterations=10000', '--set', 'estimate=early',
]  # fmt: skip


def boxreg(capsys, *arguments):
    """Run the command in this process; return exit status, stdout and stderr."""
    try:
        status = cli.main([str(argument) for argument in arguments])
    except SystemExit as end:  # how argparse ends
        status = end.code
    out, err = capsys.readouterr()
    assert 'Traceback' not in err
    return status, out, err


def start(*arguments, python=sys.executable, **options):
    """Start the command in another process."""
    command = [python, '-m', 'boxreg_ros.cli', *map(str, arguments)]
    return subprocess.Popen(command, cwd=ROOT, text=True, **options)


def ended(*command, **environment):
    """Run a command in another process, and return the process with its output."""
    return subprocess.run(
        [*map(str, command)], cwd=ROOT, capture_output=True, text=True, timeout=60,
        env=os.environ | environment,
    )  # fmt: skip


def test_relabel_prints_one_closing_line_and_what_comes_next(tmp_path, capsys):
    recording = Drive(sweeps=5).write(tmp_path / 'drive')
    out = tmp_path / 'out'
    status, text, err = boxreg(capsys, 'relabel', recording, '-o', out, *QUICK)
    assert (status, err) == (0, '')
    line, following = text.splitlines()
    assert following.startswith(f'next: boxreg review {out}')
    assert line.startswith(f'{out}: 10 boxes in, ')
    assert 'refined' in line
    assert 'kept' in line
    assert 'from 5 sweeps in' in line
    assert 'fixed frame odom' in line
    assert (out / 'boxes.csv').exists()


def test_options_are_used_by_the_run(tmp_path, capsys):
    drive = Drive(sweeps=8, motion='odometry')
    recording = drive.write(tmp_path / 'drive')
    config = tmp_path / 'config.yaml'
    config.write_text('window: 4\nlag: 2\nsolver: {rounds: 1, threads: 2}\n')
    options = [
        '--points', '/points', '--boxes', '/boxes', '--odometry', '/odom', '--fixed-frame', 'odom',
        '--config', config, '--set', 'solver.threads=1', '--set', 'estimate=final',
        '--set', 'faces.sides=0.07', '--formats', 'csv', '--start', '0.1', '--end', '0.6',
        '--workers', '1',
    ]  # fmt: skip
    out = tmp_path / 'out'
    status, text, _ = boxreg(capsys, 'relabel', recording, '-o', out, *options)
    assert status == 0
    assert ': 10 boxes in' in text
    used = Config.from_yaml(out / 'config.yaml')
    assert (used.window, used.lag, used.estimate) == (4, 2, 'final')
    assert (used.solver.rounds, used.solver.threads) == (1, 1)
    assert used.faces.sides == 0.07
    assert not (out / 'openlabel').exists()


@pytest.mark.parametrize(
    ('options', 'status', 'expected'),
    [
        (['--points', '/lidar'], 1, "no topic '/lidar'; topics with point clouds: /points"),
        (['--boxes', '/points'], 1, 'Detection3DArray'),
        (['--fixed-frame', 'world'], 1, "fixed frame 'world'"),
        (['--fixed-frame', 'world'], 1, 'leave --fixed-frame out to have one chosen'),
        (['--start', '9'], 1, 'got 9 to the end; choose a smaller --start'),
        (['--start', 'nan'], 2, 'start: expected seconds from the beginning of the recording'),
        (['--start', '-0.5'], 2, '0 or more, got -0.5; leave --start out'),
        (['--end', 'inf'], 2, '0 or more, got inf; leave --end out'),
        (['--start', '1.5', '--end', '0.5'], 2, 'end: expected more than start (1.5 s), got 0.5;'),
        (['--end', '0'], 2, 'end: expected more than start (0 s), got 0; choose a larger --end'),
        (['--set', 'windw=5'], 2, 'windw: no such setting'),
        (['--set', 'window=five'], 2, 'window: expected int'),
        (['--set', 'window=2'], 2, 'window: expected 3 to 1000'),
        (['--set', 'window'], 2, 'expected KEY=VALUE'),
        (['--set', 'names=[a'], 2, 'names: expected a YAML value'),
        (['--config', 'no_such.yaml'], 2, 'no_such.yaml'),
        (['--formats', 'csv,kiti'], 2, "format 'kiti'"),
        (['--workers', '-1'], 2, 'solver.threads'),
        (['--frobnicate'], 2, 'unrecognized arguments: --frobnicate; boxreg relabel --help'),
        (['--time-unit', 'sec'], 2, "--time-unit: expected one of auto, s, ms, us, ns, got 'sec'"),
        (['--reprot'], 2, 'unrecognized arguments: --reprot; did you mean --report?'),
        (['--fixedframe=map'], 2, '--fixedframe=map; did you mean --fixed-frame?'),
        (['--estimate', 'final'], 2, '--estimate final; did you mean --set estimate=VALUE?'),
        (['--set', 'solver.round=2'], 2, '; did you mean solver.rounds?\n'),
        (['--set=window=8', '--set=lag=8'], 2, 'lag: expected less than window (8), got 8'),
        (['{0.parent}/../{0.parent.name}/{0.name}'], 2, 'each recording once'),
    ],
)
def test_errors_are_printed_in_one_line(tmp_path, capsys, options, status, expected):
    recording = Drive(sweeps=2).write(tmp_path / 'drive')
    words = [word.format(recording) for word in options]
    got, out, err = boxreg(capsys, 'relabel', recording, *words, '-o', tmp_path / 'out')
    assert (got, out) == (status, '')
    assert expected in err
    assert len(err.splitlines()) == 1
    assert err.startswith(('boxreg: ', 'boxreg relabel: '))
    assert not (tmp_path / 'out').exists()


def test_no_argument_prints_the_help(capsys):
    status, out, err = boxreg(capsys)
    assert (status, err) == (0, '')
    assert out == boxreg(capsys, '--help')[1]


def test_unknown_command_proposes_a_similar_one(capsys):
    status, _, err = boxreg(capsys, 'relable', 'drive.mcap')
    assert status == 2
    assert "got 'relable'; did you mean relabel?; boxreg --help lists" in err
    status, _, err = boxreg(capsys, 'simulate', '-o', 'x.mcap', '--scenario', 'steet')
    assert status == 2
    assert 'argument --scenario: expected one of street, ' in err
    assert "got 'steet'; did you mean street?" in err
    assert boxreg(capsys, 'relabel', 'drive.mcap')[0] == 2  # without -o
    status, _, err = boxreg(capsys, 'frobnicate')
    assert status == 2
    assert 'COMMAND: expected one of relabel, ' in err
    assert 'did you mean' not in err


def test_fail_under_fails_and_keeps_the_result(tmp_path, capsys):
    recording = Drive(sweeps=5).write(tmp_path / 'drive')
    command = ['relabel', recording, '-o', tmp_path / 'out', *QUICK, '--fail-under']
    status, _, err = boxreg(capsys, *command, '1.0', '--set', 'min_observations=6')
    assert status == 1
    expected = '--fail-under: expected at least 100.0% of the boxes refined, got 0 of 10; '
    assert expected in err
    assert (tmp_path / 'out' / 'review.csv').exists()
    assert boxreg(capsys, *command, '0.0')[0] == 0
    status, _, err = boxreg(capsys, *command, '90')
    assert status == 2
    assert "expected a part from 0 to 1, got '90'" in err


def test_truth_without_a_report_is_said(tmp_path, capsys):
    recording, truth = Drive(sweeps=5).write(tmp_path / 'drive'), tmp_path / 'truth.csv'
    status, _, err = boxreg(
        capsys, 'relabel', recording, '-o', tmp_path / 'out', *QUICK, '--truth', truth
    )
    assert status == 0
    assert err == f'boxreg: --truth {truth}: not used without --report\n'


def test_recordings_of_two_drives_are_said(tmp_path, capsys):
    first, second = (
        Drive(sweeps=5, start=(begin + 1_700_000_000) * 10**9).write(tmp_path / str(begin))
        for begin in (0, 3600)
    )
    status, _, err = boxreg(capsys, 'relabel', first, second, '-o', tmp_path / 'out', *QUICK)
    assert status == 0
    (line,) = err.splitlines()
    assert line == (
        'boxreg: recordings: expected those of one drive, without pauses between them, got clouds '
        'received at 1700000000.000 to 1700000000.400 s and 1700003600.000 to 1700003600.400 s; '
        'tracks of the same id are one track: relabel drives one by one'
    )
    status, out, _ = boxreg(capsys, 'inspect', first, second)
    assert 'warning: recordings: expected those of one drive' in out


def test_run_that_refines_no_box_fails_and_keeps_the_result(tmp_path, capsys):
    drive = Drive(sweeps=5)
    drive.items = [item for item in drive.items if item[0] != '/points' or item[1] < 0]
    first = Drive(sweeps=5).items[1:]
    drive.items += [item for item in first if item[0] == '/points'][:1]
    recording = drive.write(tmp_path / 'drive')
    command = ['relabel', recording, '-o', tmp_path / 'out', *QUICK]
    status, out, err = boxreg(capsys, *command)
    assert status == 1
    assert ': 10 boxes in, 0 refined, 10 kept (no_sweep 8, short_track 2)' in out
    (line,) = err.splitlines()
    reason = Reason.NO_SWEEP
    expected = (
        f'boxreg: none of 10 boxes was refined; most frequent reason: no_sweep (8 boxes): '
        f'{reason.meaning}; remedy: {reason.remedy}; time ranges: boxes '
    )
    assert line.startswith(expected)
    assert ', clouds ' in line
    assert (tmp_path / 'out' / 'boxes.csv').exists()


def test_run_that_refines_less_than_half_says_why(tmp_path, capsys):
    drive = Drive(sweeps=12)
    clouds = [item for item in drive.items if item[0] == '/points']
    drive.items = [item for item in drive.items if item not in clouds[5:]]
    status, out, err = boxreg(
        capsys, 'relabel', drive.write(tmp_path / 'drive'), '-o', tmp_path / 'out', *QUICK
    )
    assert (status, out.count(' refined')) == (0, 1)
    (line,) = err.splitlines()
    reason = Reason.NO_SWEEP
    assert 'of 24 boxes were refined; most frequent reason: no_sweep (14 boxes): ' in line
    assert f'{reason.meaning}; remedy: {reason.remedy}; time ranges: boxes ' in line


def test_recordings_without_overlap_in_time_name_both_ranges(tmp_path, capsys):
    # The labels are of 2011, the clouds of 2019; each recording is whole by itself.
    years = {2011: 1_300_000_000, 2019: 1_560_000_000}
    paths = []
    for (year, start), left_out in zip(years.items(), ('/points', '/boxes'), strict=True):
        drive = Drive(sweeps=5, start=start * 10**9)
        drive.items = [item for item in drive.items if item[0] != left_out]
        paths.append(drive.write(tmp_path / str(year)))
    status, _, err = boxreg(capsys, 'relabel', *paths, '-o', tmp_path / 'out', *QUICK)
    assert status == 1
    (line,) = [line for line in err.splitlines() if 'time ranges' in line]
    assert 'none of 10 boxes was refined' in line
    boxes, clouds = line.partition('time ranges: boxes ')[2].split(', clouds ')
    assert boxes.endswith('s (2011-03-13)')
    assert clouds.endswith('s (2019-06-08)')
    assert (tmp_path / 'out' / 'boxes.csv').exists()


def test_unknown_class_names_are_named_with_their_kind(tmp_path, capsys):
    drive = Drive(sweeps=5)
    for index, name in enumerate(('', *['hovercraft'] * 4)):
        drive.replace('/boxes', index, lambda boxes, name=name: _name_first(boxes, name))
    recording = drive.write(tmp_path / 'drive')
    status, _, err = boxreg(capsys, 'relabel', recording, '-o', tmp_path / 'out', *QUICK)
    assert status == 0
    (line,) = err.splitlines()
    assert "unknown class names are treated as vehicles: 'hovercraft', '' (5 boxes)" in line
    assert 'vehicle.names' in line and line.endswith('; give those without a name one')


def _name_first(boxes, name):
    for result in boxes.detections[0].results:
        result.hypothesis.class_id = name


@pytest.mark.skipif(os.geteuid() == 0, reason='root may read every file')
def test_a_file_without_permission_names_the_remedy(tmp_path, capsys):
    recording = Drive(sweeps=2).write(tmp_path / 'drive')
    file = next(recording.glob('*.mcap')) if recording.is_dir() else recording
    file.chmod(0)
    status, _, err = boxreg(capsys, 'relabel', recording, '-o', tmp_path / 'out')
    assert status == 1
    assert str(file) in err
    assert 'change its permissions' in err
    assert 'recover' not in err


def test_the_remedy_of_a_file_is_that_of_the_cause():
    causes = (errno.EACCES, 'permissions'), (errno.EIO, 'disk'), (errno.EROFS, 'be written')
    for number, words in causes:
        text = unreadable('a.mcap', OSError(number, os.strerror(number)))
        assert text.startswith(f'a.mcap: cannot be read: {os.strerror(number)}; ')
        assert words in text


@pytest.mark.parametrize(
    ('words', 'remedy'),
    [
        (['relabel', '{}/none.mcap', '-o', '{}/out'], 'correct its path'),
        (['evaluate', '{}/none.csv', '{}/none.csv'], 'correct its path'),
        (['evaluate', '{}', '{}'], 'name a file in this folder'),
        (['check', 'csv:{}/none.csv'], 'correct the path'),
        (['relabel', '{}/drive', '-o', '{}/out', '--config', '{}/none'], 'correct its path'),
        (['relabel', '{}/drive', '-o', '{}/out', '--decisions', '{}/none'], 'correct its path'),
    ],
)
def test_errors_of_files_have_the_remedy_of_their_cause(tmp_path, capsys, words, remedy):
    Drive(sweeps=2).write(tmp_path / 'drive')
    status, _, err = boxreg(capsys, *[word.format(tmp_path) for word in words])
    assert status in (1, 2)
    (line,) = err.splitlines()
    assert str(tmp_path) in line
    assert remedy in line


@pytest.mark.parametrize('command', [['--help'], [], ['relabel', '--help'], ['relable']])
def test_parsing_imports_no_large_library(command):
    code = (
        'import sys\n'
        'from boxreg_ros.cli import main\n'
        'try:\n'
        '    main(sys.argv[1:])\n'
        'except SystemExit:\n'
        '    pass\n'
        "large = {'numba', 'rosbags', 'scipy', 'torch'}\n"
        'print(*sorted(large & set(sys.modules)), file=sys.stderr)\n'
    )
    done = ended(sys.executable, '-c', code, *command)
    assert 'usage: boxreg' in done.stdout or 'did you mean relabel?' in done.stderr
    assert done.stderr.splitlines()[-1] == ''


def test_an_internal_exception_is_one_line_and_is_raised_with_debug(tmp_path, capsys, monkeypatch):
    def broken(args):
        raise ZeroDivisionError('impossible')

    from boxreg_ros.offline import relabel_command

    monkeypatch.setattr(relabel_command, 'run', broken)
    status, _, err = boxreg(capsys, 'relabel', 'a', '-o', 'b')
    assert status == 1
    assert err == (
        'boxreg: unexpected ZeroDivisionError: impossible; this is a fault of boxreg: please '
        'report it with the traceback, which --debug prints\n'
    )
    with pytest.raises(ZeroDivisionError):
        cli.main(['relabel', 'a', '-o', 'b', '--debug'])
    with pytest.raises(ZeroDivisionError):
        cli.main(['--debug', 'relabel', 'a', '-o', 'b'])


def test_an_interruption_has_a_status_of_its_own_from_python_too(capsys, monkeypatch):
    from boxreg_ros.offline import relabel_command

    def interrupted(args):
        try:
            raise KeyboardInterrupt
        finally:
            if args.out.name == 'c':  # as a compiled function does
                raise SystemError('returned a result with an exception set')

    monkeypatch.setattr(relabel_command, 'run', interrupted)
    for out in 'bc':
        status, _, err = boxreg(capsys, 'relabel', 'a', '-o', out)
        assert (status, err) == (130, 'boxreg: interrupted; nothing was written\n')


def test_a_package_that_is_missing_is_no_fault_of_boxreg(capsys, monkeypatch):
    from boxreg_ros.offline import relabel_command

    def without(module):
        def run(args):
            raise ModuleNotFoundError(f'No module named {module!r}', name=module)

        monkeypatch.setattr(relabel_command, 'run', run)
        return boxreg(capsys, 'relabel', 'a', '-o', 'b')

    status, _, err = without('numba.core')
    assert status == 1
    assert err.startswith("boxreg: No module named 'numba.core': a package that")
    assert 'this is a fault of boxreg' in without('boxreg_ros.nothing')[2]


def test_help_and_version(capsys):
    status, out, _ = boxreg(capsys, '--help')
    assert status == 0
    assert all(name in out for name in ('relabel', 'evaluate', 'simulate', 'batch', 'node'))
    status, out, _ = boxreg(capsys, '--version')
    assert (status, out.split()[0]) == (0, 'boxreg')
    status, out, _ = boxreg(capsys, 'relabel', '--help')
    assert status == 0
    for option in (
        '--points', '--boxes', '--fixed-frame', '--odometry', '--config', '--set', '--formats',
        '--start', '--end', '--workers',
    ):  # fmt: skip
        assert option in out


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupted_run_leaves_no_files(tmp_path, preloaded_python, number):
    recording = Drive(sweeps=60).write(tmp_path / 'drive')
    process = start(
        'relabel', recording, '-o', tmp_path / 'results' / 'out', *SLOW,
        python=sys.executable if number == signal.SIGINT else preloaded_python,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    while not any((tmp_path / 'results').glob('.out.*')):
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    cause = 'interrupted' if number == signal.SIGINT else f'ended by {number.name}'
    assert (out, err) == ('', f'boxreg: {cause}; nothing was written\n')
    assert list((tmp_path / 'results').iterdir()) == []


@pytest.mark.parametrize(
    'step, place',
    [
        ('boxreg_ros.offline.reader:reader', 'code'),
        ('boxreg_ros.offline.reader:reader', 'destructor'),
        ('boxreg_ros.review.risk:assess', 'code'),
        ('boxreg_ros.review.payload:compressed', 'code'),
        ('boxreg_ros.review.report:_page', 'code'),
    ],
)
def test_a_run_that_is_interrupted_in_a_step_leaves_no_files(
    tmp_path, preloaded_python, step, place
):
    # SIGINT is sent as the step begins: reading, ranking, drawing of a track and of the page.
    # What a destructor raises is lost, as in callbacks from C, of which loading a kernel has many.
    pytest.importorskip('plotly')
    recording = Drive(sweeps=8).write(tmp_path / 'drive')
    module, name = step.split(':')
    program = (
        'import importlib, os, signal, sys\n'
        f'module = importlib.import_module({module!r})\n'
        f'begun = module.{name}\n'
        'class Interrupting:\n'
        '    def __del__(self):\n'
        '        os.kill(os.getpid(), signal.SIGINT)\n'
        '        [None for _ in range(1000)]\n'
        'def interrupted(*args, **options):\n'
        + '    Interrupting()\n' * (place == 'destructor')
        + '    os.kill(os.getpid(), signal.SIGINT)\n' * (place == 'code')
        + '    return begun(*args, **options)\n'
        'for one in list(sys.modules.values()):\n'
        f'    if getattr(one, {name!r}, None) is begun:\n'
        f'        setattr(one, {name!r}, interrupted)\n'
        'import boxreg_ros.cli as c\n'
        'c.command()\n'
    )
    out = tmp_path / 'r' / 'out'
    command = ['relabel', recording, '-o', out, '--report', *QUICK]
    done = ended(preloaded_python, '-c', program, *command)
    assert done.stderr == 'boxreg: interrupted; nothing was written\n'
    assert done.returncode == 130
    assert list((tmp_path / 'r').glob('*')) == []


WRITER_THAT_FAILS = """
import errno, os, signal, sys, threading, time
from boxreg_ros.cli import command
from boxreg_ros.labels import openlabel
from boxreg_ros.offline.output import Sink
when, ending = os.environ['WHEN'], os.environ['ENDING']
leave, write = Sink.__exit__, openlabel.Writer.write
is_at_the_end = threading.Event()
def leave_noted(self, *failure):
    assert len(self._background._waiting) > 1 or when == 'at once'
    is_at_the_end.set()
    leave(self, *failure)
def fail(self, frame):
    if when == 'at the end':
        assert is_at_the_end.wait(30)
        time.sleep(0.2)  # until the results are waited for
    if ending == 'signal':
        os.kill(os.getpid(), signal.SIGINT)
        write(self, frame)
    else:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), 'labels.json')
Sink.__exit__, openlabel.Writer.write = leave_noted, fail
command()
"""


@pytest.mark.parametrize('when, earlier', [('at once', False), ('at the end', True)])
@pytest.mark.parametrize(
    'ending, status, line',
    [
        ('error', 1, "[Errno 28] No space left on device: 'labels.json'; free some space on"),
        ('signal', 130, 'interrupted; nothing was written'),
    ],
)
def test_a_run_that_ends_while_results_wait_to_be_written(
    tmp_path, preloaded_python, ending, status, line, when, earlier
):
    # All results come at once, at the end of the recording; a thread writes them one by one.
    recording = Drive(sweeps=40).write(tmp_path / 'drive')
    out = tmp_path / 'r' / 'out'
    if earlier:
        assert cli.main(['relabel', str(recording), '-o', str(out), *QUICK]) == 0
    before = {path.name: path.read_bytes() for path in out.glob('*.*')}
    command = ['relabel', recording, '-o', out, *QUICK]
    done = ended(preloaded_python, '-c', WRITER_THAT_FAILS, *command, WHEN=when, ENDING=ending)
    assert (done.returncode, done.stdout) == (status, '')
    assert done.stderr.startswith(f'boxreg: {line}') and done.stderr.count('\n') == 1
    assert [path.name for path in (tmp_path / 'r').iterdir()] == ['out'] * earlier
    assert {path.name: path.read_bytes() for path in out.glob('*.*')} == before


def test_a_run_under_nohup_ignores_sighup_and_a_closed_stdout(tmp_path):
    recording = Drive(sweeps=20).write(tmp_path / 'drive')
    command = ['nohup', sys.executable, '-m', 'boxreg_ros.cli', 'relabel', recording]
    process = subprocess.Popen(
        [*command, '-o', tmp_path / 'out', *QUICK], cwd=ROOT, text=True,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    process.stdout.close()
    while not any(tmp_path.glob('.out.*')):
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGHUP)
    err = process.stderr.read()
    process.stderr.close()
    assert (process.wait(timeout=60), err) == (0, '')
    assert (tmp_path / 'out' / 'boxes.csv').exists()


def test_a_terminal_shows_a_progress_bar_and_stdout_names_that_it_can_encode(tmp_path):
    recording = Drive(sweeps=4).write(tmp_path / 'drive')
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack('HHHH', 24, 100, 0, 0))
    process = start(
        'relabel', recording, '-o', tmp_path / 'ü', *QUICK,
        stdout=subprocess.PIPE, stderr=follower, env=os.environ | {'PYTHONIOENCODING': 'ascii'},
    )  # fmt: skip
    os.close(follower)
    shown = io.BytesIO()
    try:
        while chunk := os.read(leader, 4096):
            shown.write(chunk)
    except OSError:  # the process has closed its end
        pass
    os.close(leader)
    out = process.communicate(timeout=60)[0]
    assert process.returncode == 0
    assert len(out.splitlines()) == 2
    assert '\\xfc: 8 boxes in' in out
    assert b's of the recording' in shown.getvalue()
