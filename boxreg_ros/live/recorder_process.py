"""The node's end of the recorder: a bounded queue, and the process that it is emptied into."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import replace
import json
import pickle
import subprocess
import sys
from threading import Condition, Event, Thread
import time
from typing import Any, IO, NamedTuple

from boxreg_ros.errors import ConfigError, UnsupportedMessage
from boxreg_ros.io import label_feed
from boxreg_ros.live.diagnostics import Health
from boxreg_ros.reasons import Reason, REASONS
from boxreg_ros.structures import Floats, Sweep
from msg_adapters import clouds, pointcloud
import numpy as np

CAPACITY = {'clouds': 50, 'boxes': 1000}
"""Items that may wait for the recorder. Clouds: five seconds at 10 Hz, 100 MB of a LiDAR with
130,000 points. Boxes need a thousandth of that, and are the labels themselves: 100 s."""
TICK_PERIOD = 1.0
"""Longest time between two items sent, so that the status stays up to date [s]."""
RESTARTS = 3
"""Times that a recorder that died is started again within `RESTART_PERIOD`; chosen."""
RESTART_PERIOD = 60.0
"""A recorder that dies more often has a lasting reason [s]; chosen."""
TOTALS = (
    'segments',
    'frames',
    'boxes',
    'clouds',
    'size',
    'recovered',
    'without_cloud',
    'left_out',
)
"""Counters of `RecorderStatus` since the start."""


CHECK_TIME = 10.0
"""Longest wait for the check of parameters [s]; chosen: one takes a second."""


def check_recording(camera: str, formats: Sequence[str]) -> None:
    """Let a recorder check parameters, as the node imports no label format; raise ConfigError."""
    command = [sys.executable, '-m', label_feed.PROGRAM, camera, *formats]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=CHECK_TIME)
    except subprocess.TimeoutExpired:
        return  # a busy machine; the recorder checks again when it starts
    if done.returncode:
        raise ConfigError(done.stdout.strip() or done.stderr.strip())


class RawCloud(NamedTuple):
    """A cloud whose intensities are decoded by the thread that sends it, see `LabelCloud`."""

    sweep: Sweep
    T_fixed_sweep: Floats
    needed_from_ns: int
    messages: Sequence[Any]  # of the clouds that it was merged from, in order


class RecorderProcess:
    """
    Start the recorder and send it the items put. Thread-safe; `put` never waits.

    A recorder that dies, for want of memory for example, is started again: it then completes the
    segment that was open, and goes on with the items that wait. It is started when its
    predecessor has ended, which may write to the same folder.

    `on_begin` and `on_end` are called once, from another thread: when the recorder is ready to
    write or has failed, and when it has ended, with the error that ended it early or ''.
    `status` is the newest from the recorder; items that are dropped because the queue is full
    are counted.

    """

    def __init__(
        self,
        settings: label_feed.RecorderSettings,
        health: Health,
        on_begin: Callable[[], None],
        on_end: Callable[[str], None],
        predecessor: RecorderProcess | None = None,
    ) -> None:
        self.settings = settings
        self.status = label_feed.RecorderStatus()
        self.has_ended = Event()
        self._health = health
        self._on_begin: Callable[[], None] | None = on_begin
        self._on_end = on_end
        self._is_finishing = False
        self._has_begun = False  # the present recorder has sent its first status
        self._has_stopped = False  # it sends no more
        self._changed = Condition()
        self._waiting: deque[Any] = deque()
        self._before = label_feed.RecorderStatus()  # the totals of recorders that died
        self._arrays_sent = 0  # to the present one
        self._died_at = deque[float](maxlen=RESTARTS)
        self._sizes: Counter[str] = Counter()  # of `_waiting`, by kind
        Thread(target=self._run, args=(predecessor,), daemon=True).start()

    def put(self, item: RawCloud | label_feed.FinalBoxes | label_feed.Split) -> None:
        """Queue an item; where the queue is full, it is dropped and counted."""
        kind = _kind(item)
        with self._changed:
            if self._is_finishing or self.has_ended.is_set():
                return
            is_full = kind in CAPACITY and self._sizes[kind] >= CAPACITY[kind]
            if not is_full:
                self._waiting.append(item)
                self._sizes[kind] += 1
                self._changed.notify()
        if is_full:
            self._health.report(
                REASONS[f'{kind}_unrecorded'], 'the recorder, or its disk, is slower than the data'
            )

    def finish(self) -> None:
        """Let the recorder write the items that wait, and end."""
        with self._changed:
            self._is_finishing = True
            self._changed.notify()

    @property
    def is_recording(self) -> bool:
        """Return whether items that are put will be written."""
        return not (self._is_finishing or self.has_ended.is_set())

    def sizes(self) -> dict[str, int]:
        """Return the number of waiting items."""
        return {f'{kind} waiting': self._sizes[kind] for kind in CAPACITY}

    def _run(self, predecessor: RecorderProcess | None) -> None:
        """Run the recorder, and again where it dies, until it has ended."""
        if predecessor is not None:
            predecessor.has_ended.wait()
        exit_status = self._run_once()
        while self._is_to_start_again(exit_status):
            lost = self._arrays_sent - (self.status.frames - self._before.frames)
            self._health.report(
                Reason.RECORDER_RESTARTED,
                f'the recorder ended with exit status {exit_status} and is started again, which '
                f'completes its segment; up to {lost} box arrays under way to it may be lost',
            )
            self._before = self.status
            exit_status = self._run_once()
        error = self.status.error
        if not error and (exit_status or not self._is_finishing):
            error = (
                f'record_to {self.settings.folder!r}: expected the recorder to run until the '
                f'recording is stopped, got exit status {exit_status}; see the lines above, and '
                f'call ~/start_recording'
            )
        with self._changed:
            self.has_ended.set()
            self._waiting.clear()
        self._on_end(error)
        self._announce()

    def _run_once(self) -> int:
        """Start the recorder, send it the items put, and return its exit status."""
        self._arrays_sent = 0
        self._has_begun = False
        self._has_stopped = False
        process = subprocess.Popen(
            [sys.executable, '-m', label_feed.PROGRAM],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            process_group=0,  # the SIGINT of a terminal would end it before it ignores signals
        )  # fmt: skip
        assert process.stdin is not None and process.stdout is not None
        reader = Thread(target=self._read_all, args=(process.stdout,), daemon=True)
        reader.start()
        self._send_all(process.stdin)
        reader.join()
        return process.wait()

    def _is_to_start_again(self, exit_status: int) -> bool:
        """Return whether the recorder died without a reason of its own, and not too often."""
        if not exit_status or self.status.error or not self._has_begun:
            return False
        now = time.monotonic()
        if len(self._died_at) == RESTARTS and now < self._died_at[0] + RESTART_PERIOD:
            return False
        self._died_at.append(now)
        return True

    def _send_all(self, target: IO[bytes]) -> None:
        """Send the settings and the items put, until `finish` or the end of the recorder."""
        item: Any = None
        try:
            with target:
                _send(self.settings, target)
                while True:
                    item = self._next()
                    if item is None:
                        return
                    _send(_decoded(item), target)
                    self._arrays_sent += isinstance(item, label_feed.FinalBoxes)
        except BrokenPipeError:  # the recorder has ended; its last status may state why
            if item is not None:
                with self._changed:
                    self._waiting.appendleft(item)
                    self._sizes[_kind(item)] += 1

    def _next(self) -> Any:
        """Return the next item, a `Tick` where there is none for a while, or None at the end."""
        with self._changed:
            if not (self._waiting or self._is_finishing or self._has_stopped):
                self._changed.wait(TICK_PERIOD)
            if self._has_stopped:
                return None
            if not self._waiting:
                return None if self._is_finishing else label_feed.Tick()
            item = self._waiting.popleft()
            self._sizes[_kind(item)] -= 1
            return item

    def _read_all(self, source: IO[bytes]) -> None:
        """Read the status of the recorder until it ends."""
        for line in source:
            status = label_feed.RecorderStatus(**json.loads(line))
            totals: dict[str, Any] = {
                name: getattr(status, name) + getattr(self._before, name) for name in TOTALS
            }
            self.status = replace(status, **totals)
            self._has_begun = True
            if not self.status.error:
                self._announce()
        with self._changed:
            self._has_stopped = True
            self._changed.notify()

    def _announce(self) -> None:
        """Call `on_begin`, once."""
        on_begin, self._on_begin = self._on_begin, None
        if on_begin is not None:
            on_begin()


def _send(item: Any, target: IO[bytes]) -> None:
    pickle.dump(item, target, protocol=pickle.HIGHEST_PROTOCOL)
    target.flush()


def _kind(item: Any) -> str:
    if isinstance(item, RawCloud):
        return 'clouds'
    return 'boxes' if isinstance(item, label_feed.FinalBoxes) else 'others'


def _decoded(item: Any) -> Any:
    """Return an item as the recorder takes it: a cloud with its intensities."""
    if not isinstance(item, RawCloud):
        return item
    sweep = Sweep(item.sweep.stamp_ns, item.sweep.frame_id, item.sweep.points)  # all it needs
    return label_feed.LabelCloud(
        sweep, item.T_fixed_sweep, _intensities(item.messages), item.needed_from_ns
    )


def _intensities(messages: Sequence[Any]) -> Floats | None:
    """Return the intensities of all clouds; None if one has none."""
    try:
        found = [pointcloud.intensities(clouds.plain(message)) for message in messages]
    except UnsupportedMessage:
        return None
    known = [values for values in found if values is not None]
    return np.concatenate(known) if len(known) == len(messages) else None
