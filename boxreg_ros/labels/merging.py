"""Boxes of label files between the clouds of a recording."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.items import Item
from boxreg_ros.io.times import time_range
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.labels.protocol import LabelFrame
from boxreg_ros.structures import HUMAN, is_valid_box

LARGEST_LAG_NS = 10**9
"""Labels that begin or end so close to the clouds are of their drive [ns]; chosen: ten periods."""
LONGEST_DRIVE_NS = 24 * 3600 * 10**9
"""The same where only a part of the recording is read [ns]; chosen: a day."""


@dataclass(eq=False, repr=False)
class LabelMerger:
    """
    Yield the boxes of a stamp after the sweep of that stamp, or the next one.

    Boxes whose labels have poses in the sensor frame are taken in the frame of the clouds and move
    with the recording; the others are taken in the frame that the labels name. Boxes of the status
    ``human`` are pinned. The stamps of `frames` ascend; with `keyframes` boxes that no person made
    are left out; rejected ones are, unless `with_rejected`. Where only a part of the recording,
    from `start_ns` on, is read, boxes before and after it are left out, and `outside` counts them;
    `left_out` counts those that the frames lack, by reason; `notes` has what their reader assumed.

    Raises RecordingError if all labels are earlier than the clouds, or all later.

    """

    frames: Iterator[LabelFrame]
    tree: TransformTree
    sensor_frame: str
    start_ns: int
    is_part: bool
    keyframes: bool
    with_rejected: bool = False

    def __post_init__(self) -> None:
        """Read the first frame."""
        self.outside = 0
        self.left_out: Counter[str] = Counter()
        self.notes: list[str] = []
        labels = self.frames if self.with_rejected else (one.labels() for one in self.frames)
        self._frames = keyframes_of(labels) if self.keyframes else labels
        self._next = next(self._frames, None)
        self._received_ns = self.start_ns
        self._first_ns: int | None = None
        self._newest_ns = 0
        self._labelled_ns: tuple[int, int] | None = None  # of the first and the newest label
        self._longest_ns = LONGEST_DRIVE_NS if self.is_part else LARGEST_LAG_NS

    def after(self, received_ns: int, stamp_ns: int) -> Iterator[Item]:
        """
        Yield the boxes up to the stamp of a sweep, which is the next of the recording.

        Parameters
        ----------
        received_ns : int
            Time at which the sweep was received [ns]; that of the boxes, too.
        stamp_ns : int
            Of the sweep [ns].

        Yields
        ------
        item : Item
            An array of boxes per label frame, in the order of the frames.

        Raises
        ------
        RecordingError
            If the labels are of another time than the recording, or do not follow their format.

        """
        self._received_ns = received_ns
        self._newest_ns = max(self._newest_ns, stamp_ns)
        if self._first_ns is None:
            self._first_ns = self._newest_ns
        while self._next is not None and _stamp(self._next) <= self._newest_ns:
            yield from self._take(self.is_part and _stamp(self._next) < self._first_ns)
        if self._next is None and self._labelled_ns is not None:
            self._check(self._first_ns - self._labelled_ns[1])

    def rest(self) -> Iterator[Item]:
        """Yield the boxes later than the last sweep."""
        if self._next is not None and self._labelled_ns is None and self._first_ns is not None:
            self._labelled_ns = _stamp(self._next), _stamp(self._next)
            self._check(self._labelled_ns[0] - self._newest_ns)
        while self._next is not None:
            yield from self._take(self.is_part)

    def _take(self, is_outside: bool) -> Iterator[Item]:
        """Yield the next boxes, or count them as outside, and go on to those after them."""
        frame = self._next
        assert frame is not None
        stamp_ns = _stamp(frame)
        self.left_out.update(frame.left_out)
        if frame.note:
            self.notes.append(frame.note)
        first_ns = stamp_ns if self._labelled_ns is None else self._labelled_ns[0]
        self._labelled_ns = first_ns, stamp_ns
        if is_outside:
            self.outside += len(frame.refined.status)
        else:
            yield _item(frame, self._received_ns, self.tree, self.sensor_frame)
        self._next = next(self._frames, None)

    def _check(self, apart_ns: int) -> None:
        """Refuse labels that lie further apart from the clouds [ns] than those of one drive."""
        if apart_ns <= self._longest_ns or self._labelled_ns is None or self._first_ns is None:
            return
        cause = 'another drive? give the labels of this recording'
        for unit, in_ns in (('s', 10**9), ('ms', 10**6), ('us', 10**3)):
            if abs(self._labelled_ns[0] * in_ns - self._first_ns) < LONGEST_DRIVE_NS:
                cause = f'stamps in {unit}? write them in ns'
        raise RecordingError(
            f'labels: expected those of the time of the clouds, got labels of '
            f'{time_range(*self._labelled_ns)}, clouds of '
            f'{time_range(self._first_ns, self._newest_ns)}: {cause}'
        )


def keyframes_of(frames: Iterator[LabelFrame]) -> Iterator[LabelFrame]:
    """
    Yield frames with the boxes of a person alone; see `LabelFrame.keyframes`.

    Raises RecordingError, at the end, if there were boxes and none was of a person.

    """
    status: Counter[str] = Counter()
    num_kept = 0
    for frame in frames:
        status.update(frame.refined.status)
        keyframes = frame.keyframes()
        num_kept += len(keyframes.refined.status)
        yield keyframes
    if status and not num_kept:
        words = ', '.join(f'{count:,} {word}' for word, count in status.items())
        raise RecordingError(
            f'keyframes: expected boxes that a person placed, got {words}; leave --keyframes '
            f'out: the boxes are then refined as those of a tracker'
        )


def _item(frame: LabelFrame, received_ns: int, tree: TransformTree, sensor_frame: str) -> Item:
    """Return the boxes of a label frame, in a frame that the transforms know if possible."""
    placed = frame.moved('sensor')
    boxes = placed.refined.boxes
    is_sensor = frame.sensor_frame != '' and boxes.frame_id == frame.sensor_frame
    if is_sensor and not tree.connects(boxes.frame_id, sensor_frame):
        boxes = replace(boxes, frame_id=sensor_frame)
    if HUMAN in placed.refined.status:
        is_human = [status == HUMAN for status in placed.refined.status]
        boxes = replace(boxes, pinned=is_human & is_valid_box(boxes.boxes))
    return Item(received_ns, boxes, refined=replace(placed.refined, boxes=boxes))


def _stamp(frame: LabelFrame) -> int:
    return frame.refined.boxes.stamp_ns
