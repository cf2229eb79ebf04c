"""Clouds without moving objects, by the early boxes, for a SLAM beside the node."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from time import thread_time
from typing import Any, NamedTuple

from boxreg_ros.core.point_labels import ObjectTrack
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.io.items import Item
from boxreg_ros.structures import Floats, is_valid_box, REFINED, RefinedBoxes, Sweep
from msg_adapters.cloud_edits import with_points
from msg_adapters.pointcloud import finite_rows
import numpy as np

HISTORY_SECONDS = 2.0
"""Boxes that the motion of an object is estimated from [s]; longer than the longest gap."""
MOST_WAITING = 50
"""Clouds that wait for boxes; derived: 5 s at 10 Hz, no more memory than that."""


class StaticCloud(NamedTuple):
    """A cloud to publish."""

    message: Any  # the input without the points of moving objects
    received: float  # when the input arrived (monotonic) [s]
    is_late: bool  # True for the input itself, because its boxes are late
    cpu: float  # time spent on it [s]


class _Waiting(NamedTuple):
    """A cloud that waits for its boxes, with its parts and when it arrived [s]."""

    sweep: Sweep
    parts: Sequence[Item]
    received: float


class _Box(NamedTuple):
    """An early box of a track."""

    stamp_ns: int
    class_name: str
    box: Floats
    is_certain: bool


class StaticPoints:
    """
    Hold each cloud until the early boxes of its stamp are known, and leave out what moves.

    A cloud whose boxes do not come within `patience` [s] passes unchanged. The labelling margins
    and the time of the boxes are those of the registrar. Not thread-safe.

    """

    def __init__(self, patience: float, registrar: BoxRegistrar) -> None:
        self._patience = patience
        self._registrar = registrar
        self._waiting: deque[_Waiting] = deque()
        self._boxes: dict[str, deque[_Box]] = {}
        self._array_stamps: deque[int] = deque(maxlen=100)
        self._ready: list[StaticCloud] = []

    def add_cloud(self, sweep: Sweep, parts: Sequence[Item]) -> None:
        """Add a cloud in the fixed frame, merged from the parts."""
        if not parts:  # lost
            return
        self._waiting.append(_Waiting(sweep, parts, max(part.received for part in parts)))
        if len(self._waiting) > MOST_WAITING:
            self._pass(self._waiting.popleft())

    def add_boxes(self, refined: RefinedBoxes) -> None:
        """Add early boxes in the fixed frame; clouds up to their stamp become ready."""
        boxes = refined.boxes
        self._array_stamps.append(boxes.stamp_ns)
        for row in np.flatnonzero(is_valid_box(boxes.boxes)).tolist():
            track_id = boxes.track_ids[row]
            history = self._boxes.setdefault(track_id, deque())
            if track_id and not (history and history[-1].stamp_ns >= boxes.stamp_ns):
                is_certain = refined.status[row] == REFINED
                name = boxes.class_names[row]
                history.append(_Box(boxes.stamp_ns, name, boxes.boxes[row], is_certain))
        self._forget(boxes.stamp_ns - round(HISTORY_SECONDS * 1e9))
        config = self._registrar.config
        reach_ns = round(config.reach * 1e9)
        while self._waiting and self._waiting[0].sweep.stamp_ns <= boxes.stamp_ns + reach_ns:
            self._label(self._waiting.popleft())

    def take(self, now: float) -> list[StaticCloud]:
        """Return the clouds that are ready, and those whose boxes are late."""
        while self._waiting and now >= self._waiting[0].received + self._patience:
            self._pass(self._waiting.popleft())
        ready = self._ready
        self._ready = []
        return ready

    def due(self, now: float) -> float:
        """Return the time until the next cloud is late [s]; infinite without one."""
        if not self._waiting:
            return np.inf
        return max(0.0, self._waiting[0].received + self._patience - now)

    def reset(self) -> None:
        """Forget all boxes; clouds that wait pass unchanged."""
        self._boxes.clear()
        self._array_stamps.clear()
        while self._waiting:
            self._pass(self._waiting.popleft())

    def _forget(self, oldest_ns: int) -> None:
        """Forget boxes that are older."""
        for track_id, history in list(self._boxes.items()):
            while history and history[0].stamp_ns < oldest_ns:
                history.popleft()
            if not history:
                del self._boxes[track_id]

    def _pass(self, cloud: _Waiting) -> None:
        """Make the messages of a cloud ready unchanged."""
        for part in cloud.parts:
            self._ready.append(StaticCloud(part.message, cloud.received, True, 0.0))

    def _label(self, cloud: _Waiting) -> None:
        """Make the messages of a cloud ready without the points of moving objects."""
        begin = thread_time()
        labeller = self._registrar.labeller(self._objects(), self._array_stamps)
        if not labeller.knows(cloud.sweep.stamp_ns):
            self._pass(cloud)
            return
        is_static = ~labeller.label(cloud.sweep).is_dynamic
        first = 0
        for part in cloud.parts:
            assert isinstance(part.content, Sweep)
            count = len(part.content.points)
            own = is_static[first : first + count]
            first += count
            message = part.message
            rows = finite_rows(message)
            is_kept = own
            if rows is not None:  # points that are not finite stay
                is_kept = np.ones(message.width * message.height, bool)
                is_kept[rows] = own
            edited = with_points(message, is_kept) if len(is_kept) else message
            cpu = thread_time() - begin
            begin = thread_time()
            self._ready.append(StaticCloud(edited, cloud.received, False, cpu))

    def _objects(self) -> list[ObjectTrack]:
        """Return the objects by their boxes of the last seconds."""
        found = []
        for track_id, history in self._boxes.items():
            stamps_ns, names, boxes, are_certain = zip(*history, strict=True)
            columns = np.array(stamps_ns, np.int64), np.array(boxes), np.array(are_certain)
            found.append(ObjectTrack(track_id, names[-1], *columns))
        return found
