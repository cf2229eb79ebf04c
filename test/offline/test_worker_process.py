"""Worker processes: same results, errors raised in the parent, no process left over."""

import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from boxreg_ros.config import Config
from boxreg_ros.core.estimation import estimate_windows
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.errors import BoxregError
from boxreg_ros.io.compilation import announced_compilation, COMPILING
from boxreg_ros.offline.estimation_worker import estimation_worker
from boxreg_ros.offline.progress import Stopwatch
from boxreg_ros.offline.relabel import relabel, Request
from boxreg_ros.offline.relabel_command import ProgressBar
from boxreg_ros.offline.workers import run_in_worker
import numpy as np
from paths import ROOT
from processes import children_of
import pytest
from ros_messages import Drive
from scenes import cut, drive, fed, stream_of, track_of

SHORT = Config().updated(
    {'sampling.points': 64, 'track_window': 24, 'max_gap': 0.3, 'sampling.box_time': 'stamp'}
)
"""Short windows; the time of the boxes is known, so that no sweep waits for its estimate."""


def assert_equal(results, expected):
    """Check that two lists of results are the same."""
    assert len(results) == len(expected)
    for a, b in zip(results, expected, strict=True):
        assert (a.boxes.stamp_ns, a.boxes.track_ids) == (b.boxes.stamp_ns, b.boxes.track_ids)
        np.testing.assert_array_equal(a.boxes.boxes, b.boxes.boxes)
        assert (a.status, a.reasons, a.is_final) == (b.status, b.reasons, b.is_final)


@pytest.fixture(scope='module')
def stream():
    """Return four tracks: one ends early, one begins late, and two swap their ids."""
    rng = np.random.default_rng(0)
    long, other = (drive(60, start=(5.0, y, 0.2)) for y in (6.0, -6.0))
    tracks = [track_of(long, rng, 'a'), track_of(other, rng, 'b')]
    tracks += [cut(track_of(drive(60, start=(25.0, 0.0, 0.2)), rng, 'late'), slice(9, 60))]
    tracks += [cut(track_of(drive(60, start=(-9.0, 0.0, 0.2)), rng, 'short'), slice(5))]
    stream = stream_of(tracks)
    # At tick 24 the windows are full; by then the id switch of tick 23 has not been detected.
    names = [('b', 'a') if i >= 23 else ('a', 'b') for i in range(60)]
    return [
        (s, type(b)(b.stamp_ns, b.frame_id, (*pair, *b.track_ids[2:]), b.class_names, b.scores,
                    b.boxes))
        for (s, b), pair in zip(stream, names, strict=True)
    ]  # fmt: skip


@pytest.fixture(autouse=True)
def no_process_left():
    before = children_of(os.getpid())
    yield
    assert children_of(os.getpid()) == before


# --- any function -------------------------------------------------------------------------------


def echo(receive, send):
    while True:
        send(receive())


def test_items_survive_the_round_trip():
    rng = np.random.default_rng(0)
    size = 2**14
    with run_in_worker(echo, 'echoes') as process:
        for item in (
            None,
            {'a': (1, 'b')},
            np.zeros(0),
            rng.normal(size=(size, 3)),
            rng.normal(size=(3, size)).T.astype(np.float32),  # in Fortran order, which is kept
            rng.normal(size=(size, 6))[:, ::2],
            [rng.integers(9, size=size), np.arange(size)],
        ):
            process.send(item)
            found = process.receive()
            np.testing.assert_equal(found, item)
            if isinstance(item, np.ndarray) and item.size:
                assert (found.dtype, found.flags.writeable) == (item.dtype, True)
                if item.flags.f_contiguous:
                    assert found.flags.f_contiguous


def test_exception_is_raised_in_the_parent_with_its_traceback():
    def fail(receive, send):
        raise ValueError(f'not a {receive()}')

    with run_in_worker(fail, 'fails') as process:
        process.send('window')
        with pytest.raises(ValueError, match='not a window') as caught:
            process.receive()
        assert 'in fail' in caught.value.__notes__[0]
        with pytest.raises(BoxregError, match=r'the process that fails: .* has ended'):
            process.receive()


def test_exception_is_raised_whatever_led_to_it():
    """Where tblib is installed, which comes with Dask, pickle takes what led to an error too."""
    tblib = pytest.importorskip('tblib.pickling_support')

    def fail(receive, send):
        tblib.install()  # in the worker alone
        try:
            raise KeyError(lambda: None)  # which cannot be pickled
        except KeyError:
            raise ValueError('no answer') from None

    with run_in_worker(fail, 'fails') as process, pytest.raises(ValueError, match='no answer'):
        process.receive()


def test_leaving_the_block_does_not_wait_for_the_worker():
    begun = time.monotonic()
    with (
        pytest.raises(KeyError),
        run_in_worker(lambda receive, send: time.sleep(60), 'sleeps'),
        run_in_worker(echo, 'waits'),
        run_in_worker(
            lambda receive, send: [send(np.zeros(2**16)) for _ in range(99)], 'pushes'
        ) as process,
    ):
        process.receive()
        raise KeyError
    assert time.monotonic() - begun < 10


def test_worker_where_sigchld_is_ignored():
    ours = signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # some parents leave it so
    try:
        with run_in_worker(lambda receive, send: send(1), 'ends') as process:
            assert process.receive() == 1
            with pytest.raises(BoxregError):
                process.receive()
        with run_in_worker(echo, 'echoes') as process:
            process.send(2)
            assert process.receive() == 2
    finally:
        signal.signal(signal.SIGCHLD, ours)


# --- windows ------------------------------------------------------------------------------------


@pytest.mark.parametrize('offset_ns', [0, 30_000_000])
def test_estimation_worker_returns_the_same_boxes(stream, offset_ns):
    stream = [(type(s)(s.stamp_ns + offset_ns, s.frame_id, s.points), b) for s, b in stream]
    direct = BoxRegistrar(SHORT)
    expected = fed(direct, stream) + direct.flush()
    clock = Stopwatch()
    with estimation_worker(SHORT, clock, print) as begin:
        registrar = BoxRegistrar(SHORT, begin)
        early = fed(registrar, stream)
        assert 0 < len(early) < len(stream)  # some boxes are returned before the end
        assert_equal(early + registrar.flush(), expected)
        assert registrar.counts == direct.counts
        # The worker updates the input model; `reset` must clear it for the next stream.
        registrar.reset()
        assert_equal(fed(registrar, stream) + registrar.flush(), expected)
    assert clock.seconds()['solve'] > 0


def test_registrar_takes_input_while_windows_are_estimated(stream):
    """Estimates are awaited when the next windows are full, or at the end."""
    events = []

    def begin(windows, config, model):
        events.append('begin')
        estimates = estimate_windows(windows, config, model)
        return lambda: events.append('wait') or estimates

    registrar = BoxRegistrar(SHORT, begin)
    for tick, pair in enumerate(stream):
        events.append(tick)
        fed(registrar, [pair])
    registrar.flush()
    # Windows of 24 observations keep 6: the first are full at tick 24, the next every 18 ticks,
    # and then the estimates of the earlier ones are awaited. At the end all are awaited.
    expected = [*range(24), 'begin']
    for tick in (24, 42):
        expected += [*range(tick, tick + 18), 'wait', 'begin']
    assert events == [*expected, 'wait', 'begin', 'wait']


@pytest.mark.parametrize('changes', [{'estimate': 'final'}, {'solver.threads': 1}])
def test_no_worker_for_sliding_windows_or_one_core(changes):
    with estimation_worker(SHORT.updated(changes), Stopwatch(), print) as begin:
        assert begin is None


def compile_something(_):
    numba = pytest.importorskip('numba')
    numba.njit(lambda x: x + 1)(1)


def test_the_first_compilation_is_announced():
    texts = []
    with announced_compilation(texts.append):
        assert texts == []
        compile_something(None)
        compile_something(None)
    assert texts == [COMPILING]
    compile_something(None)
    assert texts == [COMPILING]


def test_a_run_without_a_terminal_says_once_that_it_compiles(capsys):
    with ProgressBar() as bar:
        for _ in range(2):
            bar.announce(COMPILING)
            bar.announce('compiling the solver: 9 functions in 10 s')
    assert capsys.readouterr().err == f'boxreg: {COMPILING}\n'


def test_compilation_in_the_worker_is_announced_while_its_estimates_are_awaited(
    stream, monkeypatch
):
    texts = []
    monkeypatch.setattr('boxreg_ros.offline.estimation_worker.warm_up', compile_something)
    with estimation_worker(SHORT, Stopwatch(), texts.append) as begin:
        registrar = BoxRegistrar(SHORT, begin)
        assert len(fed(registrar, stream) + registrar.flush()) == len(stream)
    assert texts == [COMPILING]


def test_the_reader_imports_no_solver():
    # Its start and its memory: torch takes a second and 200 MB.
    code = (
        'import sys; import boxreg_ros.offline.relabel; from boxreg_ros.labels import FORMATS, '
        "module_of; [module_of(name) for name in ('csv', 'openlabel')]; "
        "print(*sorted({'numba', 'torch'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ('\n', '')


def test_relabel_writes_the_same_files_in_one_process(tmp_path, monkeypatch):
    request = Request((Drive(sweeps=30).write(tmp_path / 'drive'),), config=SHORT)
    summary = relabel(request, tmp_path / 'worker')
    assert 0 < summary.seconds['solve'] < summary.seconds['total']
    monkeypatch.setattr(os, 'fork', None)
    one_core = SHORT.updated({'solver.threads': 1})
    relabel(Request(request.recordings, config=one_core), tmp_path / 'direct')
    direct, worker = (tmp_path / name / 'boxes.csv' for name in ('direct', 'worker'))
    assert worker.read_bytes() == direct.read_bytes()


def test_exception_in_the_worker_ends_relabel(tmp_path, monkeypatch):
    def fail(windows, config, model):
        raise ValueError('no such window')

    recording = Drive(sweeps=30).write(tmp_path / 'drive')
    monkeypatch.setattr('boxreg_ros.core.estimation.estimate_windows', fail)  # the fork copies it
    with pytest.raises(ValueError, match='no such window'):
        relabel(Request((recording,), config=SHORT), tmp_path / 'out')
    assert sorted(item.name for item in tmp_path.iterdir()) == ['drive']


@pytest.mark.parametrize('which', ['estimates windows', 'reads the recording'])
def test_killed_worker_is_an_error_with_a_remedy(tmp_path, monkeypatch, which):
    recording = Drive(sweeps=120).write(tmp_path / 'drive')
    added = []
    parent = os.getpid()
    others = set(children_of(parent))  # of earlier tests

    def killing(self, boxes):
        # Boxes of the warm-up are added before there are two workers.
        pids = sorted({*children_of(parent)} - others)
        if not added and len(pids) == 2:
            os.kill(pids[which == 'estimates windows'], signal.SIGKILL)  # as without memory
            added.append(boxes)
        return add(self, boxes)

    add = BoxRegistrar.add_boxes
    monkeypatch.setattr(BoxRegistrar, 'add_boxes', killing)
    with pytest.raises(
        BoxregError, match=f'{which}: .* has ended.*: choose a smaller track_window'
    ):
        relabel(Request((recording,), config=SHORT), tmp_path / 'out')
    assert sorted(item.name for item in tmp_path.iterdir()) == ['drive']


def test_workers_end_when_the_parent_is_killed(tmp_path):
    recording = Drive(sweeps=200).write(tmp_path / 'drive')
    command = [sys.executable, '-m', 'boxreg_ros.cli', 'relabel', str(recording)]
    process = subprocess.Popen([*command, '-o', str(tmp_path / 'out')], cwd=ROOT)
    while len(children := children_of(process.pid)) < 2:
        assert process.poll() is None
        time.sleep(0.01)
    process.kill()
    process.wait()
    left = [Path(f'/proc/{child}/exe') for child in children]  # none after the end of a process
    assert len(left) == 2
    while any(path.exists() for path in left):
        time.sleep(0.05)


FORKS = """
import os, sys
fork = os.fork
def counted():
    print('threads', len(os.listdir('/proc/self/task')))
    return fork()
os.fork = counted
from boxreg_ros.cli import main
status = main(sys.argv[1:])
print(status, *{'torch', 'scipy.interpolate'} & set(sys.modules))
"""


def test_relabel_forks_before_it_has_threads_and_leaves_torch_to_the_worker(tmp_path):
    """Python 3.14 warns of the contrary, and locks of other threads are never released."""
    path = Drive(sweeps=30).write(tmp_path / 'drive')
    command = [sys.executable, '-c', FORKS, 'relabel', path, '-o', tmp_path / 'out']
    environment = {key: text for key, text in os.environ.items() if 'THREADS' not in key}
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120, check=True
    )
    *lines, status_and_modules = done.stdout.splitlines()
    assert (status_and_modules, done.stderr) == ('0', '')
    forks = [line for line in lines if line.startswith('threads')]
    assert forks and set(forks) == {'threads 1'}
