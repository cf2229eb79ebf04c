"""The node's end of the recorder: a bounded queue, and the process that it is emptied into."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
import json
import pickle
import subprocess
import sys
from threading import Condition, Event, Thread
from typing import Any, IO, NamedTuple

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.io.label_feed import (
    FinalBoxes,
    LabelCloud,
    PROGRAM,
    RecorderSettings,
    RecorderStatus,
    Split,
    Tick,
)
from boxreg_ros.live.diagnostics import Health
from boxreg_ros.reasons import REASONS
from boxreg_ros.structures import Floats, Sweep
from msg_adapters import clouds, pointcloud
import numpy as np

CAPACITY = {'clouds': 50, 'boxes': 1000}
"""
Items that may wait for the recorder.

Clouds: five seconds at 10 Hz, 100 MB of a LiDAR with 130,000 points. Boxes need a thousandth of
that, and are the labels themselves: 100 s.

"""
TICK_PERIOD = 1.0
"""Longest time between two items sent, so that the status stays up to date [s]."""


class RawCloud(NamedTuple):
    """
    A cloud whose intensities are decoded by the thread that sends it, not by the worker.

    Attributes
    ----------
    sweep, T_fixed_sweep, needed_from_ns
        As of `LabelCloud`.
    messages : sequence of message
        The messages of the clouds that it was merged from, in the order of its points.

    """

    sweep: Sweep
    T_fixed_sweep: Floats
    needed_from_ns: int
    messages: Sequence[Any]


class RecorderProcess:
    """
    Start the recorder and send it the items put. Thread-safe; `put` never waits.

    Parameters
    ----------
    settings : RecorderSettings
        Settings of the recording.
    health : Health
        Counts the items that are dropped because the queue is full.
    on_begin : callable
        Called once, from another thread, when the recorder is ready to write or has failed.
    on_end : callable
        Called once, from another thread, when the recorder has ended, with the error that ended
        it early; '' for none.
    predecessor : RecorderProcess, optional
        The recorder is started when this one has ended, which may write to the same folder.

    Attributes
    ----------
    settings : RecorderSettings
        As given.
    status : RecorderStatus
        The newest from the recorder.
    has_ended : threading.Event
        Set when the recorder has ended.

    """

    def __init__(
        self,
        settings: RecorderSettings,
        health: Health,
        on_begin: Callable[[], None],
        on_end: Callable[[str], None],
        predecessor: RecorderProcess | None = None,
    ) -> None:
        self.settings = settings
        self.status = RecorderStatus()
        self.has_ended = Event()
        self._health = health
        self._on_begin = on_begin
        self._on_end = on_end
        self._is_finishing = False
        self._changed = Condition()
        self._waiting: deque[Any] = deque([settings])
        self._sizes = dict.fromkeys(CAPACITY, 0)
        Thread(target=self._run, args=(predecessor,), daemon=True).start()

    def put(self, item: RawCloud | FinalBoxes | Split) -> None:
        """Queue an item; where the queue is full, it is dropped and counted."""
        kind = _kind(item)
        with self._changed:
            if self._is_finishing or self.has_ended.is_set():
                return
            is_full = kind in CAPACITY and self._sizes[kind] >= CAPACITY[kind]
            if not is_full:
                self._waiting.append(item)
                self._sizes[kind] = self._sizes.get(kind, 0) + 1
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
        """Start the recorder and send it the items put."""
        if predecessor is not None:
            predecessor.has_ended.wait()
        process = subprocess.Popen(
            [sys.executable, '-m', PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            process_group=0,  # the SIGINT of a terminal would end it before it ignores signals
        )  # fmt: skip
        assert process.stdin is not None
        Thread(target=self._read_all, args=(process,), daemon=True).start()
        self._send_all(process.stdin)

    def _send_all(self, target: IO[bytes]) -> None:
        """Send the items put, until `finish` or the end of the recorder."""
        try:
            with target:
                while True:
                    item = self._next()
                    if item is None:
                        return
                    pickle.dump(_decoded(item), target, protocol=pickle.HIGHEST_PROTOCOL)
                    target.flush()
        except BrokenPipeError:
            return  # the recorder has ended; its last status states why

    def _next(self) -> Any:
        """Return the next item, a `Tick` where there is none for a while, or None at the end."""
        with self._changed:
            if not self._waiting and not self._is_finishing:
                self._changed.wait(TICK_PERIOD)
            if not self._waiting:
                return None if self._is_finishing else Tick()
            item = self._waiting.popleft()
            kind = _kind(item)
            if kind in self._sizes:
                self._sizes[kind] -= 1
            return item

    def _read_all(self, process: subprocess.Popen[bytes]) -> None:
        """Read the status of the recorder until it ends."""
        assert process.stdout is not None
        lines = iter(process.stdout)
        self._take_status(next(lines, b''))
        self._on_begin()
        for line in lines:
            self._take_status(line)
        exit_status = process.wait()
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

    def _take_status(self, line: bytes) -> None:
        if line:
            self.status = RecorderStatus(**json.loads(line))


def _kind(item: Any) -> str:
    if isinstance(item, RawCloud):
        return 'clouds'
    return 'boxes' if isinstance(item, FinalBoxes) else 'others'


def _decoded(item: Any) -> Any:
    """Return an item as the recorder takes it: a cloud with its intensities."""
    if not isinstance(item, RawCloud):
        return item
    sweep = Sweep(item.sweep.stamp_ns, item.sweep.frame_id, item.sweep.points)  # all it needs
    return LabelCloud(sweep, item.T_fixed_sweep, _intensities(item.messages), item.needed_from_ns)


def _intensities(messages: Sequence[Any]) -> Floats | None:
    """Return the intensities of all clouds; None if one has none."""
    try:
        found = [pointcloud.intensities(clouds.plain(message)) for message in messages]
    except UnsupportedMessage:
        return None
    known = [values for values in found if values is not None]
    return np.concatenate(known) if len(known) == len(messages) else None
