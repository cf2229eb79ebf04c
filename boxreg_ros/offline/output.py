"""Results on their way to files: in the order of stamps, each box array once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from boxreg_ros.io.items import Item
from boxreg_ros.labels import LabelFrame, LabelOutput, Provenance
from boxreg_ros.labels.cloud_spool import Spool
from boxreg_ros.offline.progress import Stopwatch
from boxreg_ros.offline.reader import ArrayPlace, Source, uses_one_core
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.sources import writer_options
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
    Write the result of each box array once, in the order of the registrar.

    The ticket of every box array is an `ArrayPlace`. Files are
    written in a thread, while the registrar goes on; attributes are those of all results after
    the end of the block only. The time spent on files is added to the stage ``write`` of the
    clock.

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
        options = writer_options(request)
        formats = dict.fromkeys(('csv', *request.box_formats))
        self.output = LabelOutput(folder, tuple(formats), provenance, options)
        self.corrections = corrections
        # These import numba, after the fork of the reader.
        from boxreg_ros.review.changes import Changes
        from boxreg_ros.review.track_points import PointCollector

        self.changes = Changes(self._fixed_frame)
        self.points = PointCollector(request.config) if request.report else None
        # Clouds would fill the memory while they wait.
        waits = uses_one_core(request.config) or self._spool is not None
        self._background = Background(0 if waits else ARRAYS_AHEAD)
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

    def expect(self, item: Item) -> tuple[Sweep | BoxArray | None, str]:
        """
        Return what the registrar is given for an item, and why boxes are kept; empty if not.

        A cloud is stored if files need it; the `ArrayPlace` of boxes is completed.

        """
        if self.points is not None and item.moved is not None:
            with self._clock('report'):
                self.points.note(item.moved)
        if isinstance(item.content, BoxArray):
            self._note_time(item.content)
            return self._with_place(item, item.content)
        if item.moved is not None or self._spool:
            self._note_time(item.content)
        if self._spool and item.T_fixed_item is not None:
            with self._clock('write'):
                self._spool.add(item.content, item.T_fixed_item, item.intensities)
        return item.moved, ''

    def to_register(self, boxes: BoxArray, sweep: Sweep | None) -> BoxArray:
        """Take note of boxes in time; return them as a person has decided."""
        place = boxes.ticket
        assert isinstance(place, ArrayPlace)
        place.boxes = boxes
        if self.points is not None:
            with self._clock('report'):
                self.points.gather(boxes, sweep)
        boxes = self.corrections.to_register(boxes)
        if self._has_keyframes:
            boxes = replace(boxes, pinned=np.ones(len(boxes.track_ids), bool))
        return boxes

    def take(self, ready: Sequence[RefinedBoxes]) -> None:
        """Write results in their order: of each box array the final one, or the early one."""
        for refined in ready:
            place = refined.boxes.ticket
            assert isinstance(place, ArrayPlace)
            if place.is_written:
                continue
            assert place.boxes is not None
            result = self.corrections.apply(place.boxes, refined)
            if refined.is_final or self._writes_early:
                place.is_written = True
                self._background(self._put, result, place)
            else:
                place.early = result

    def __enter__(self) -> Sink:
        """Return the sink."""
        return self

    def __exit__(self, failure: object, *_: object) -> None:
        """Complete the files; after a failure the caller deletes them."""
        if failure is not None:
            self._background.abandon()
            return
        self._background.complete()
        with self._clock('write'):
            self.output.close()
            if self._spool is not None:
                self._spool.remove()

    def missing(self) -> int:
        """Return the number of input boxes that have not been written."""
        return self.boxes_in - (self.boxes_out - self._boxes_added)

    def _note_time(self, content: Sweep | BoxArray) -> None:
        """Widen the time range of clouds or boxes by a message; empty box arrays count."""
        name = 'boxes' if isinstance(content, BoxArray) else 'clouds'
        stamp_ns = content.stamp_ns
        first, last = self.time_ranges.get(name, (stamp_ns, stamp_ns))
        self.time_ranges[name] = min(first, stamp_ns), max(last, stamp_ns)

    def _with_place(self, item: Item, given: BoxArray) -> tuple[BoxArray | None, str]:
        """Return boxes with their place, and why they are kept, if they are."""
        count = len(given.track_ids)
        self.boxes_in += count
        self.arrays_in += count > 0
        self.array_stamps_ns.append(given.stamp_ns)
        moved = item.moved
        if isinstance(moved, BoxArray):
            place = moved.ticket
            assert isinstance(place, ArrayPlace)
            place.boxes = moved
            place.T_fixed_sensor, place.T_fixed_boxes = item.T_fixed_sensor, item.T_fixed_item
            return moved, ''
        if not count:
            return None, ''
        as_kept = self.corrections.to_register(given, with_pins=False)
        place = ArrayPlace(given, item.T_fixed_sensor, item.T_fixed_item)
        return replace(as_kept, ticket=place), item.reason or Reason.NO_TRANSFORM

    def _put(self, refined: RefinedBoxes, place: ArrayPlace) -> None:
        """Count the boxes of one array and write them in all formats; in the thread."""
        assert place.boxes is not None
        refined = self.corrections.with_attributes(place.boxes, refined)
        count = len(place.boxes.track_ids)
        # As decided.
        for name, boxes in Counter(refined.boxes.class_names[:count]).items():
            if not self._config.knows_class(name):
                self.unknown_classes[name] += boxes
        self.boxes_out += len(refined.status)
        self._boxes_added += len(refined.status) - count
        self.arrays_out += len(refined.status) > 0
        self.status.update(refined.status)
        self.reasons.update(filter(None, refined.reasons))
        self.heading_flips += _heading_flips(place.boxes, refined)
        stamp_ns, added = refined.boxes.stamp_ns, refined.boxes.track_ids[count:]
        added_ids = [self.corrections.origin_of(stamp_ns, track_id) for track_id in added]
        self.changes.add(place.boxes, refined, place.early, added_ids)
        with self._clock('write'):
            self.output.write(self._frame(refined, place))

    def _frame(self, refined: RefinedBoxes, place: ArrayPlace) -> LabelFrame:
        """Return all that label writers need about one array, its cloud included."""
        frame = LabelFrame(
            refined, self._fixed_frame, self._sensor_frame, place.T_fixed_sensor,
            T_fixed_given=place.T_fixed_boxes,
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
