"""Results on their way to files: in the order of stamps, each box array once."""

from __future__ import annotations

from bisect import insort
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from boxreg_ros.labels import LabelFrame, Provenance, writer_for
from boxreg_ros.offline.cloud_spool import Spool
from boxreg_ros.offline.reader import ReadItem, Source
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.stopwatch import Stopwatch
from boxreg_ros.review.changes import Changes
from boxreg_ros.structures import BoxArray, Floats, INTERPOLATED, KEPT, REFINED, RefinedBoxes, YAW
from boxreg_ros.tracks.bridge import Bridge
import numpy as np


@dataclass(eq=False, slots=True)
class Slot:
    """The place of one box array in the order of the output."""

    boxes: BoxArray
    T_fixed_sensor: Floats | None
    T_fixed_given: Floats | None
    result: RefinedBoxes | None = None

    @property
    def stamp_ns(self) -> int:
        """Return the stamp of the boxes [ns]."""
        return self.boxes.stamp_ns

    def flips(self, refined: RefinedBoxes) -> int:
        """Return how many headings are off the given ones by more than a right angle."""
        n = len(self.boxes.track_ids)  # what is put in comes behind
        turn = refined.boxes.boxes[:n, YAW] - self.boxes.boxes[:, YAW]
        is_refined = np.array([status == REFINED for status in refined.status[:n]], bool)
        return int((is_refined & (np.cos(turn) < 0)).sum())


class Sink:
    """
    Brings results into the order of stamps, each box array once, and has them written.

    Parameters
    ----------
    folder : Path
        Of results.
    request : Request
        The formats, and what else is to be kept of the results.
    source : Source
        What the results are of.
    clock : Stopwatch
        Counts the writing.

    Attributes
    ----------
    boxes_in, boxes_out : int
        What was to come, and what has come, that which is put in included.
    status, reasons : Counter
        Of the boxes that have come.
    heading_flips : int
        Refined headings that are off the given ones by more than a right angle.
    without_cloud : int
        Box arrays that came without one, where clouds are to be written.
    changes : Changes or None
        What a report is to show.

    """

    def __init__(
        self,
        folder: Path,
        request: Request,
        source: Source,
        clock: Stopwatch,
    ) -> None:
        config, with_points = request.config, request.options.with_points
        self._fixed_frame, self._sensor_frame = source.fixed_frame, source.sensor_frame
        self._is_early = config.estimate == 'early'
        self._clock = clock
        self._spool = Spool(folder, config) if with_points else None
        provenance = Provenance.of(request.recordings, config)
        options = replace(request.options, recording=request.recording())
        self._writers = {
            name: writer_for(name, folder, provenance, options) for name in request.all_formats
        }
        self._bridge: Bridge[Slot] = Bridge(request.bridge, self._fixed_frame, config)
        self.changes = Changes(self._fixed_frame) if request.report else None
        self._slots: list[Slot] = []
        self._unsettled: dict[int, deque[Slot]] = {}
        self.boxes_in = 0
        self.boxes_out = 0
        self.status: Counter[str] = Counter()
        self.reasons: Counter[str] = Counter()
        self.heading_flips = 0
        self.without_cloud = 0

    def expect(self, arrival: ReadItem) -> None:
        """Keep a cloud that files need, or a place for boxes: those not moved stay as they are."""
        given = arrival.given
        if not isinstance(given, BoxArray):
            if self._spool and given is not None and arrival.T_fixed_given is not None:
                with self._clock('write'):
                    self._spool.add(given, arrival.T_fixed_given, arrival.intensities)
            return
        boxes = arrival.moved if isinstance(arrival.moved, BoxArray) else given
        n = len(boxes.track_ids)
        slot = Slot(boxes, arrival.T_fixed_sensor, arrival.T_fixed_given)
        self.boxes_in += n
        if arrival.moved is not None:
            self._unsettled.setdefault(boxes.stamp_ns, deque()).append(slot)
        elif not n:
            return
        else:
            reasons, unknown = ('no_transform',) * n, np.broadcast_to(np.eye(6), (n, 6, 6))
            slot.result = RefinedBoxes(boxes, (KEPT,) * n, reasons, np.zeros(n, np.int64), unknown)
        insort(self._slots, slot, key=lambda slot: slot.stamp_ns)

    def take(self, ready: Sequence[RefinedBoxes]) -> None:
        """Take what the registrar returns: per box array one final result, or an early one."""
        for refined in ready:
            slots = self._unsettled[refined.boxes.stamp_ns]
            if refined.is_final:
                slot = slots.popleft()
                if not slots:
                    del self._unsettled[refined.boxes.stamp_ns]
            elif self._is_early:
                slot = next(slot for slot in slots if slot.result is None)
            else:
                continue
            slot.result = slot.result or refined
        self._write()

    def __enter__(self) -> Sink:
        """Return the sink."""
        return self

    def __exit__(self, failure: object, *_: object) -> None:
        """Complete the files, but not after a failure: then nothing of them will be kept."""
        if failure is None:
            for refined, slot in self._bridge.flush():
                self._put(refined, slot)
            with self._clock('write'):
                for writer in self._writers.values():
                    writer.close()
                if self._spool is not None:
                    self._spool.remove()

    def left_out(self) -> dict[str, dict[str, int]]:
        """Return the boxes that a format has no place for, by format and reason."""
        return {
            name: dict(+writer.dropped)
            for name, writer in self._writers.items()
            if +writer.dropped
        }

    def missing(self) -> int:
        """Return how many boxes have gone in and not come out."""
        return self.boxes_in - sum(
            self.status[name] for name in self.status if name != INTERPOLATED
        )

    def _write(self) -> None:
        """Write what nothing earlier is missing for."""
        while self._slots and (result := self._slots[0].result) is not None:
            for refined, slot in self._bridge.add(result, self._slots.pop(0)):
                self._put(refined, slot)

    def _put(self, refined: RefinedBoxes, slot: Slot) -> None:
        """Count the boxes of a slot, and have them written."""
        self.boxes_out += len(refined.status)
        self.status.update(refined.status)
        self.reasons.update(filter(None, refined.reasons))
        self.heading_flips += slot.flips(refined)
        if self.changes is not None:
            self.changes.add(slot.boxes, refined)
        with self._clock('write'):
            sweep = intensities = None
            if self._spool and slot.T_fixed_sensor is not None:
                sweep, intensities = self._spool.take(
                    slot.stamp_ns, self._sensor_frame, slot.T_fixed_sensor
                )
            self.without_cloud += bool(self._spool) and sweep is None
            frame = LabelFrame(
                refined, self._fixed_frame, self._sensor_frame, slot.T_fixed_sensor, sweep,
                intensities, slot.T_fixed_given,
            )  # fmt: skip
            for writer in self._writers.values():
                writer.write(frame)
