"""Results on their way to files: in the order of stamps, each box array once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from boxreg_ros.io.recording import Recording
from boxreg_ros.io.stamp_order import kept, Slot, StampOrder
from boxreg_ros.labels import LabelFrame, LabelOutput, Provenance
from boxreg_ros.labels.cloud_spool import Spool
from boxreg_ros.offline.progress import Stopwatch
from boxreg_ros.offline.reader import ReadItem, Source, uses_one_core
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.workers import Background
from boxreg_ros.reasons import Reason
from boxreg_ros.review.corrections import Corrections
from boxreg_ros.structures import BoxArray, REFINED, RefinedBoxes, Sweep, YAW
import numpy as np

ARRAYS_AHEAD = 256
"""Most results that wait to be written, some 40 kB each with 64 boxes. A full window of all tracks
returns the results of as many stamps at once."""


class Sink:
    """
    Collect results, bring them into the order of stamps and write each box array once.

    Every box array gets a ticket on its way to the registrar; its result is found by that
    ticket, because several arrays may have the same stamp. Files are written in a thread, while
    the registrar goes on; attributes are those of all results after the end of the block only.
    The time spent on files is added to the stage ``write`` of the clock.

    """

    def __init__(
        self,
        folder: Path,
        request: Request,
        source: Source,
        clock: Stopwatch,
        corrections: Corrections,
    ) -> None:
        self._fixed_frame = source.fixed_frame
        self._sensor_frame = source.sensor_frame
        self._writes_early = request.config.estimate == 'early'
        self._has_keyframes = request.keyframes
        self._clock = clock
        self._config = request.config
        self.time_ranges: dict[str, tuple[int, int]] = {}
        self.unknown_classes: Counter[str] = Counter()
        self._spool: Spool | None = None
        if request.options.with_points:
            self._spool = Spool(folder, request.config)
        provenance = Provenance.of(request.recordings, request.config)
        recording = request.recording()
        bags = recording if isinstance(recording, Recording) else None
        options = replace(request.options, recording=bags)
        self.output = LabelOutput(folder, request.box_formats, provenance, options)
        self.corrections = corrections
        # These import numba, after the fork of the reader.
        from boxreg_ros.review.changes import Changes
        from boxreg_ros.review.track_points import PointCollector

        self.changes = Changes(self._fixed_frame)
        self.points = PointCollector(request.config) if request.report else None
        # Clouds would fill the memory while they wait.
        waits = uses_one_core(request.config) or self._spool is not None
        self._background = Background(0 if waits else ARRAYS_AHEAD)
        self._order = StampOrder()
        self._early: dict[object, RefinedBoxes] = {}  # by ticket, until the final estimate is
        self._last_ticket = 0
        self.array_stamps_ns: list[int] = []
        self.boxes_in = 0
        self.boxes_out = 0
        self._boxes_added = 0
        self.arrays_in = 0
        self.arrays_out = 0
        self.status: Counter[str] = Counter()
        self.reasons: Counter[str] = Counter()
        self.heading_flips = 0
        self.without_cloud = 0

    def expect(self, item: ReadItem) -> ReadItem:
        """Store a cloud that files need, or reserve the place of boxes, which get a ticket."""
        if self.points is not None and item.moved is not None:
            with self._clock('report'):
                self.points.add(item.moved)
        self._note_time(item.given or item.moved)
        if isinstance(item.given, BoxArray):
            return self._reserve(item, item.given)
        if self._spool and item.given is not None and item.T_fixed_given is not None:
            with self._clock('write'):
                self._spool.add(item.given, item.T_fixed_given, item.intensities)
        return item

    def take(self, ready: Sequence[RefinedBoxes]) -> None:
        """Take results of the registrar; write arrays up to the first one without a result."""
        for refined in ready:
            ticket = refined.boxes.ticket
            slot = self._order.waiting_for(ticket)
            if slot is None:  # its early result has been taken
                continue
            result = self.corrections.apply(slot.boxes, refined)
            if refined.is_final or self._writes_early:
                self._order.take(ticket, result)
            else:
                self._early[ticket] = result
        for slot, result in self._order.ready():
            early = self._early.pop(result.boxes.ticket, None)
            self._background(self._put, result, slot, early)

    def __enter__(self) -> Sink:
        """Return the sink."""
        return self

    def __exit__(self, failure: object, *_: object) -> None:
        """Complete the files; after a failure the caller deletes them."""
        if failure is not None:
            self._background.abandon()
            return
        self._background.complete()
        if self.points is not None:
            self.points.flush()
        with self._clock('write'):
            self.output.close()
            if self._spool is not None:
                self._spool.remove()

    def missing(self) -> int:
        """Return the number of input boxes that have not been written."""
        return self.boxes_in - (self.boxes_out - self._boxes_added)

    def _note_time(self, content: Sweep | BoxArray | None) -> None:
        """Widen the time range of clouds or boxes by a message; empty box arrays count."""
        if content is None:
            return
        name = 'boxes' if isinstance(content, BoxArray) else 'clouds'
        stamp_ns = content.stamp_ns
        first, last = self.time_ranges.get(name, (stamp_ns, stamp_ns))
        self.time_ranges[name] = min(first, stamp_ns), max(last, stamp_ns)

    def _reserve(self, item: ReadItem, given: BoxArray) -> ReadItem:
        """Reserve a place; boxes that could not be transformed have their result at once."""
        count = len(given.track_ids)
        self.boxes_in += count
        self.arrays_in += count > 0
        self.array_stamps_ns.append(given.stamp_ns)
        for name, boxes in Counter(given.class_names).items():
            if not self._config.knows_class(name):
                self.unknown_classes[name] += boxes
        moved = item.moved
        if isinstance(moved, BoxArray):
            if self._has_keyframes:  # soft: evidence may move those that files call pinned
                moved = replace(moved, pinned=None)
            self._last_ticket += 1
            slot = Slot(moved, item.T_fixed_sensor, item.T_fixed_given)
            self._order.expect(slot, self._last_ticket)
            moved = replace(self.corrections.to_register(moved), ticket=self._last_ticket)
            if self._has_keyframes:
                moved = replace(moved, pinned=np.ones(len(moved.track_ids), bool))
            item = item._replace(moved=moved)
        elif count:
            left = kept(self.corrections.to_register(given, with_pins=False), Reason.NO_TRANSFORM)
            result = self.corrections.apply(given, left)
            self._order.expect(Slot(given, item.T_fixed_sensor, item.T_fixed_given, result))
        return item

    def _put(self, refined: RefinedBoxes, slot: Slot, early: RefinedBoxes | None) -> None:
        """Count the boxes of one array and write them in all formats; in the thread."""
        count = len(slot.boxes.track_ids)
        self.boxes_out += len(refined.status)
        self._boxes_added += len(refined.status) - count
        self.arrays_out += len(refined.status) > 0
        self.status.update(refined.status)
        self.reasons.update(filter(None, refined.reasons))
        self.heading_flips += _heading_flips(slot.boxes, refined)
        stamp_ns, added = refined.boxes.stamp_ns, refined.boxes.track_ids[count:]
        added_ids = [self.corrections.origin_of(stamp_ns, track_id) for track_id in added]
        self.changes.add(slot.boxes, refined, early, added_ids)
        with self._clock('write'):
            self.output.write(self._frame(refined, slot))

    def _frame(self, refined: RefinedBoxes, slot: Slot) -> LabelFrame:
        """Return all that label writers need about one array, its cloud included."""
        frame = LabelFrame(
            refined, self._fixed_frame, self._sensor_frame, slot.T_fixed_sensor,
            T_fixed_given=slot.T_fixed_boxes,
        )  # fmt: skip
        if self._spool is not None:
            frame = self._spool.with_cloud(frame)
            self.without_cloud += frame.sweep is None
        return frame


def _heading_flips(boxes: BoxArray, refined: RefinedBoxes) -> int:
    """Return how many refined headings differ from the input by more than 90 degrees."""
    n = len(boxes.track_ids)  # added boxes stand behind those of the input
    turn = refined.boxes.boxes[:n, YAW] - boxes.boxes[:, YAW]
    is_refined = np.array([status == REFINED for status in refined.status[:n]], bool)
    return int((is_refined & (np.cos(turn) < 0)).sum())
