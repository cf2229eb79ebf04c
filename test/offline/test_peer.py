"""Work in processes beside this one: the same boxes, errors told here, no process left over."""

import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.errors import BoxregError
from boxreg_ros.offline import workers as solving
from boxreg_ros.offline.peer import beside, LARGE
from boxreg_ros.offline.relabel import relabel, Request
from boxreg_ros.offline.stopwatch import Stopwatch
from boxreg_ros.offline.workers import solver
import numpy as np
from paths import ROOT
import pytest
from ros_messages import Drive
from scenes import drive, stream_of, track_of
from test_registrar import assert_equal, config_with, cut, fed

SHORT = config_with('track', track_window=24, max_gap=0.3)


@pytest.fixture(scope='module')
def stream():
    """Return three cars of which one ends early, one comes late, and two swap their ids."""
    rng = np.random.default_rng(0)
    long, other = (drive(60, start=(5.0, y, 0.2)) for y in (6.0, -6.0))
    tracks = [track_of(long, rng, 'a'), track_of(other, rng, 'b')]
    tracks += [cut(track_of(drive(60, start=(25.0, 0.0, 0.2)), rng, 'late'), slice(9, 60))]
    tracks += [cut(track_of(drive(60, start=(-9.0, 0.0, 0.2)), rng, 'short'), slice(5))]
    stream = stream_of(tracks)
    # Tick 24 fills the windows with the first boxes of the other object, before that is told.
    names = [('b', 'a') if i >= 23 else ('a', 'b') for i in range(60)]
    return [
        (s, type(b)(b.stamp_ns, b.frame_id, (*pair, *b.track_ids[2:]), b.class_names, b.scores,
                    b.boxes))
        for (s, b), pair in zip(stream, names, strict=True)
    ]  # fmt: skip


def children_of(pid):
    """Return the processes whose parent is `pid`."""
    found = []
    for path in Path('/proc').glob('[0-9]*/stat'):
        try:
            number, _, rest = path.read_text().partition(' (')
        except OSError:
            continue
        if int(rest.rpartition(') ')[2].split()[1]) == pid:
            found.append(int(number))
    return found


@pytest.fixture(autouse=True)
def none_left():
    before = children_of(os.getpid())
    yield
    assert children_of(os.getpid()) == before


# --- any work -----------------------------------------------------------------------------------


def echo(receive, send):
    while True:
        send(receive())


def test_what_is_sent_comes_back():
    rng = np.random.default_rng(0)
    size = LARGE // 4
    with beside(echo, 'echoes') as peer:
        for item in (
            None,
            {'a': (1, 'b')},
            np.zeros(0),
            rng.normal(size=(size, 3)),
            rng.normal(size=(3, size)).T.astype(np.float32),  # by columns, and so it stays
            rng.normal(size=(size, 6))[:, ::2],
            [rng.integers(9, size=size), np.arange(size)],
        ):
            peer.send(item)
            found = peer.receive()
            np.testing.assert_equal(found, item)
            if isinstance(item, np.ndarray) and item.size:
                assert (found.dtype, found.flags.writeable) == (item.dtype, True)
                if item.flags.f_contiguous:
                    assert found.flags.f_contiguous


def test_an_error_is_raised_here_with_where_it_came_from():
    def fail(receive, send):
        raise ValueError(f'not a {receive()}')

    with beside(fail, 'fails') as peer:
        peer.send('window')
        with pytest.raises(ValueError, match='not a window') as caught:
            peer.receive()
        assert 'in fail' in caught.value.__notes__[0]
        with pytest.raises(BoxregError, match='the process that fails has ended'):
            peer.receive()


def test_the_block_is_left_at_once_whatever_goes_on_there():
    begun = time.monotonic()
    with (
        pytest.raises(KeyError),
        beside(lambda receive, send: time.sleep(60), 'sleeps'),
        beside(echo, 'waits'),
        beside(lambda receive, send: [send(np.zeros(LARGE)) for _ in range(99)], 'pushes') as peer,
    ):
        peer.receive()
        raise KeyError
    assert time.monotonic() - begun < 10


def test_where_children_are_not_waited_for():
    ours = signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # as some that start others leave it
    try:
        with beside(lambda receive, send: send(1), 'ends') as peer:
            assert peer.receive() == 1
            with pytest.raises(BoxregError):
                peer.receive()
        with beside(echo, 'echoes') as peer:
            peer.send(2)
            assert peer.receive() == 2
    finally:
        signal.signal(signal.SIGCHLD, ours)


# --- windows ------------------------------------------------------------------------------------


@pytest.mark.parametrize('offset_ns', [0, 30_000_000])
def test_the_same_boxes_as_without(stream, offset_ns):
    stream = [(type(s)(s.stamp_ns + offset_ns, s.frame_id, s.points), b) for s, b in stream]
    known = BoxRegistrar(SHORT)
    expected = fed(known, stream) + known.flush()
    clock = Stopwatch()
    with solver(SHORT, clock) as begin:
        registrar = BoxRegistrar(SHORT, begin)
        early = fed(registrar, stream)
        assert 0 < len(early) < len(stream)  # a part comes back before the end
        assert_equal(early + registrar.flush(), expected)
        assert registrar.counts == known.counts
        # What the model learnt there is here: another stream begins anew all the same.
        registrar.reset()
        assert_equal(fed(registrar, stream) + registrar.flush(), expected)
    assert clock.seconds()['solve'] > 0


def test_more_is_taken_while_windows_are_registered(stream):
    """What is begun is not waited for before the next windows are full, or the end has come."""
    events = []

    def begin(windows, config, model):
        events.append('begin')
        estimates = solving.register(windows, config, model)
        return lambda: events.append('wait') or estimates

    registrar = BoxRegistrar(SHORT, begin)
    for tick, pair in enumerate(stream):
        events.append(tick)
        fed(registrar, [pair])
    registrar.flush()
    # Windows of 24, which keep 6: the first are full at tick 24, the next every 18 ticks, where
    # those before are waited for. What is left at the end has nothing to go on beside it.
    expected = [*range(24), 'begin']
    for tick in (24, 42):
        expected += [*range(tick, tick + 18), 'wait', 'begin']
    assert events == [*expected, 'wait', 'begin', 'wait']


@pytest.mark.parametrize('changes', [{'estimate': 'final'}, {'device': 'meta'}])
def test_where_it_does_not_pay_there_is_none(changes):
    with solver(SHORT.updated(changes), Stopwatch()) as begin:
        assert begin is None


def test_relabel_gives_the_same_files(tmp_path):
    request = Request((Drive(sweeps=30).write(tmp_path / 'drive'),), config=SHORT)
    summary = relabel(request, tmp_path / 'beside')
    assert 0 < summary['seconds']['solve'] < summary['seconds']['total']
    whole = SHORT.updated({'device': 'cpu:0'})
    relabel(Request(request.recordings, config=whole), tmp_path / 'within')
    within, next_to_it = (tmp_path / name / 'boxes.csv' for name in ('within', 'beside'))
    assert next_to_it.read_bytes() == within.read_bytes()


def test_an_error_there_ends_what_is_done_here(tmp_path, monkeypatch):
    def fail(windows, config, model):
        raise ValueError('no such window')

    recording = Drive(sweeps=30).write(tmp_path / 'drive')
    monkeypatch.setattr(solving, 'register', fail)  # the fork has it too
    with pytest.raises(ValueError, match='no such window'):
        relabel(Request((recording,), config=SHORT), tmp_path / 'out')
    assert sorted(item.name for item in tmp_path.iterdir()) == ['drive']


@pytest.mark.parametrize('which', ['registers windows', 'reads the recording'])
def test_a_process_that_is_killed_is_an_error_with_a_remedy(tmp_path, monkeypatch, which):
    recording = Drive(sweeps=30).write(tmp_path / 'drive')
    added = []

    def killing(self, boxes):
        if not added:  # as the kernel does when memory runs out
            pids = sorted(children_of(os.getpid()))
            os.kill(pids[which == 'reads the recording'], signal.SIGKILL)
        added.append(boxes)
        return add(self, boxes)

    add = BoxRegistrar.add_boxes
    monkeypatch.setattr(BoxRegistrar, 'add_boxes', killing)
    with pytest.raises(BoxregError, match=f'{which} has ended .*: choose a smaller track_window'):
        relabel(Request((recording,), config=SHORT), tmp_path / 'out')
    assert sorted(item.name for item in tmp_path.iterdir()) == ['drive']


def test_none_is_left_when_this_one_is_killed(tmp_path):
    recording = Drive(sweeps=200).write(tmp_path / 'drive')
    command = [sys.executable, '-m', 'boxreg_ros.cli', 'relabel', str(recording)]
    process = subprocess.Popen([*command, '-o', str(tmp_path / 'out')], cwd=ROOT)
    deadline = time.monotonic() + 60
    while len(children := children_of(process.pid)) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    process.kill()
    process.wait()
    left = [Path(f'/proc/{child}') for child in children]
    while any(path.exists() for path in left) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert len(left) == 2
    assert not any(path.exists() for path in left)
