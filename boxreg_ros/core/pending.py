"""
Box arrays and observations of tracks that a registrar holds until they are settled.

They refer to each other: an estimate of a track is written to the box arrays of its observations.

"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import chain
from math import hypot, inf, prod

from boxreg_ros.config import Config
from boxreg_ros.core.id_switches import is_other_size, switch_distance
from boxreg_ros.core.method.margins import MIN_HITS
from boxreg_ros.core.motion import motion_at
from boxreg_ros.core.observation import Observation
from boxreg_ros.core.support import points_to_confirm
from boxreg_ros.core.tables import rows_of
from boxreg_ros.core.visible_boxes import HELD_EXTENTS, lengthened, whole_extents
from boxreg_ros.core.window import Estimate, Estimates, MarginalisationPrior, PRIOR_POSES
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import (
    BOX_CENTER,
    BOX_EXTENT,
    BoxArray,
    COASTED,
    Floats,
    HEIGHT,
    is_valid_box,
    KEPT,
    KINEMATICS,
    REFINED,
    RefinedBoxes,
)
import numpy as np

ID_SWITCH_OBSERVATIONS = 6
"""
Observations that an id switch is detected from, at least one less; chosen.

The last two are tested against the velocity of those before.

"""


class PendingArray:
    """
    A box array that is not yet returned, with the present estimate of each box.

    Attributes
    ----------
    input : BoxArray
        As they are registered, followed by the predicted boxes of tracks that have none here.
    num_given : int
        Boxes to register.
    reasons : list of str
        Why each box is kept as long as it has no estimate.
    num_points : array, shape (n,)
        As in `RefinedBoxes`.
    observed : list of n PendingBox or None
        The boxes that have observations.
    num_unsettled : int
        Boxes whose estimate may still change; the array is settled at 0 or less.
    is_observed : bool
        True where a sweep was found and the array is in order.
    followed : list of int
        Rows of added boxes that are returned whether or not they are refined.

    """

    def __init__(self, boxes: BoxArray) -> None:
        self.num_unsettled = 0
        self.is_observed = False
        self.followed: list[int] = []
        self.set_input(boxes)

    def set_input(self, boxes: BoxArray) -> None:
        """Set the boxes to register."""
        n = len(boxes.track_ids)
        self.input = boxes
        self.reasons = [''] * n
        self.num_points = np.zeros(n, int)
        self.observed: list[PendingBox | None] = [None] * n
        self.num_given = n

    def keep_all(self, reason: str) -> None:
        """Return the boxes as they are, all for one reason."""
        self.set_input(self.input.take(range(self.num_given)))
        self.reasons = [str(reason)] * self.num_given

    def set_reasons(self, reason: str) -> None:
        """Set the reason of each box that cannot be refined; `reason`, if any, holds for all."""
        known = set[str]()
        is_valid = is_valid_box(self.input.boxes).tolist()
        for row, track_id in enumerate(self.input.track_ids):
            if not is_valid[row]:
                self.reasons[row] = Reason.INVALID_BOX
            elif not track_id:
                self.reasons[row] = Reason.NO_TRACK_ID
            elif track_id in known:
                self.reasons[row] = Reason.DUPLICATE_TRACK_ID
            else:
                self.reasons[row] = reason
            if is_valid[row]:
                known.add(track_id)

    def observe(self, boxes: Sequence[PendingBox], seen: Sequence[Observation]) -> None:
        """Give boxes of the array their observations; they then wait for their estimates."""
        self.num_unsettled += len(boxes)
        if not boxes:
            return
        table = seen[0].table
        self.num_points[[one.row for one in boxes]] = table.num_points
        places = table.boxes[:, : HEIGHT + 1].tolist()
        for one, place in zip(boxes, places, strict=True):
            self.reasons[one.row] = Reason.SHORT_TRACK  # until there is an estimate
            self.observed[one.row] = one
            one.array = self
            one.place = place

    def add_predicted(self, track: ObservedTrack, one: PendingBox) -> None:
        """Add the predicted box of a track as a row."""
        given = self.input
        self.input = replace(
            given,
            track_ids=(*given.track_ids, track.track_id),
            class_names=(*given.class_names, track.class_name),
            scores=np.append(given.scores, 0.0),
            boxes=np.vstack([given.boxes, one.box]),
            pinned=None if given.pinned is None else np.append(given.pinned, False),
            attributes=(*given.attributes, {}) if given.attributes else (),
        )
        self.reasons.append('')
        self.num_points = np.append(self.num_points, 0)
        self.observed.append(None)
        one.row = len(self.observed) - 1
        if one.is_followed:
            self.followed.append(one.row)

    def kept(self) -> Estimates:
        """Return the boxes to register as estimates that keep them."""
        n = len(self.observed)
        boxes = self.input.boxes.copy()
        for row, one in enumerate(self.observed):
            if one is not None:
                boxes[row] = one.box
        return Estimates(
            boxes=boxes,
            status=np.full(n, KEPT),
            reasons=np.array(self.reasons, np.str_),
            covariances=np.repeat(np.eye(6)[None], n, axis=0),
            extent_covariances=np.repeat(np.eye(3)[None], n, axis=0),
            face_distances=np.zeros((n, 6)),
            near_points=np.zeros((n, 2), np.int64),
            kinematics=np.zeros(n, KINEMATICS),
        )

    def estimates(self) -> list[tuple[Estimates, int]]:
        """Return the present estimate of each box; without one, the input box."""
        found = [one.estimate for one in self.observed if one is not None and one.estimate]
        if len(found) == len(self.observed):
            return found
        kept = self.kept()
        return [(one and one.estimate) or (kept, row) for row, one in enumerate(self.observed)]

    def result(self, columns: Estimates, is_final: bool) -> RefinedBoxes:
        """
        Return the result with `columns`, which are copies of the present estimates.

        Of the predicted boxes, those that are refined, and those of followed objects.

        """
        n = len(self.observed)
        added = (COASTED,) * (n - self.num_given)
        whole = RefinedBoxes(
            replace(self.input, boxes=columns.boxes, kinematics=columns.kinematics),
            (*columns.status[: self.num_given].tolist(), *added),
            tuple(columns.reasons.tolist()),
            self.num_points.copy(),
            columns.covariances,
            is_final,
            columns.extent_covariances,
            columns.face_distances,
            columns.near_points,
        )
        if is_final:  # boxes, which tracks still have, know their array: no cycle is left
            self.observed.clear()
        if n == self.num_given:
            return whole
        is_returned = columns.status == REFINED
        is_returned[: self.num_given] = True
        is_returned[self.followed] = True
        return whole.take(np.flatnonzero(is_returned).tolist())


def results(arrays: Sequence[PendingArray], is_final: bool) -> Iterator[RefinedBoxes]:
    """Yield the present result of each array; to copy the estimates of all at once is faster."""
    if not arrays:
        return
    found = [array.estimates() for array in arrays]
    items = [*chain.from_iterable(found)]
    columns = rows_of(items) if items else arrays[0].kept()
    end = 0
    for array, of_array in zip(arrays, found, strict=True):
        begin, end = end, end + len(of_array)
        yield array.result(Estimates._make(column[begin:end] for column in columns), is_final)


@dataclass(slots=True, eq=False)
class PendingBox:
    """A box of a track: to be observed, then waiting for its estimate."""

    stamp_ns: int
    box: Floats
    """(9,), of the input, lengthened where it holds what is seen of its object, or predicted."""
    row: int = -1
    """In its array, which the estimate is written to; -1 while a predicted box has none."""
    is_predicted: bool = False
    is_followed: bool = False
    array: PendingArray = field(init=False)
    place: list[float] = field(init=False)
    """x y z length width height of the box as plain numbers, for id switches [m]."""
    estimate: tuple[Estimates, int] | None = None
    """Estimates of the windows that it was last in, and its row there."""
    is_settled: bool = False
    given: Floats | None = None
    """(9,), of the input, where `box` may be longer; else None."""

    def settle(self) -> None:
        """Let the estimate in the box array change no more."""
        if not self.is_settled:
            self.array.num_unsettled -= 1
        self.is_settled = True


@dataclass(eq=False, slots=True)
class ObservedTrack:
    """The observations of a track that windows still need, oldest first."""

    track_id: str
    class_name: str
    entries: list[PendingBox] = field(default_factory=list)
    seen: list[Observation] = field(default_factory=list)
    """Observation of each of the entries."""
    starts: Floats | list[Floats] = field(default_factory=list)
    """Boxes (9,) that the next window starts from, of the first entries."""
    prior: tuple[MarginalisationPrior, int] | None = None
    num_carried: int = 0
    """Newest observations that were in no window yet, because the budget was used up."""
    detected_ns: int = 0
    """Stamp of the last detection [ns]."""
    least_points: float = inf
    """Points inside a predicted box that confirm it, known after the first missed detection."""
    extents: deque[Floats] = field(default_factory=lambda: deque(maxlen=HELD_EXTENTS))
    """(3,) of each box, where boxes hold what is seen of their objects [m]."""
    whole: Floats | None = None
    """(3,), what these show of the object [m]."""

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest observation [ns]."""
        return self.entries[-1].stamp_ns

    @property
    def is_estimated(self) -> bool:
        """Whether all observations have been in a window."""
        return not self.num_carried and len(self.starts) == len(self.seen)

    def settle(self) -> None:
        """Let no estimate in the box arrays change any more."""
        for entry in self.entries:
            entry.settle()

    def add(self, one: PendingBox, observation: Observation) -> None:
        """Add the newest observation."""
        self.entries.append(one)
        self.seen.append(observation)

    def lengthen(self) -> None:
        """
        Give boxes that hold what is seen of the object the extents that it has shown so far.

        The newest ones; all that are held where these extents have changed. Boxes of a person, and
        predicted ones, stay.

        """
        new = []
        for row, (entry, one) in enumerate(zip(self.entries, self.seen, strict=True)):
            if entry.given is None and not (entry.is_predicted or one.table.is_pinned[one.row]):
                entry.given = entry.box
                self.extents.append(entry.box[BOX_EXTENT])
                new.append(row)
        if not self.extents:
            return
        whole = whole_extents(self.extents, self.whole)
        if whole is not self.whole:
            self.whole, self.prior = whole, None
            self.starts = [*self.starts]
            new = [row for row, entry in enumerate(self.entries) if entry.given is not None]
        for row in new:
            self._lengthen(row, whole)

    def _lengthen(self, row: int, whole: Floats) -> None:
        """Give a box whose observation is held some extents (3,) [m]."""
        entry, old = self.entries[row], self.seen[row]
        assert entry.given is not None
        sensor = old.box[BOX_CENTER] + old.table.origins[old.row, 0]
        box = lengthened(entry.given, whole, sensor)
        alone = old.table.take(np.array([old.row]))
        shift = old.box[BOX_CENTER] - box[BOX_CENTER]
        self.seen[row] = Observation(alone.relative_to(box[None], shift[None]), 0)
        entry.box, entry.place = box, box[: HEIGHT + 1].tolist()
        if row < len(self.starts):
            self.starts[row] = lengthened(self.starts[row], whole, sensor)

    def is_in(self, array: PendingArray) -> bool:
        """Return whether the newest observation is of `array`."""
        return self.entries[-1].array is array

    def carry(self, length: int) -> None:
        """
        Leave the newest observation to a later window, which then starts from its input box.

        At most `length` observations are held. Those in excess are removed behind the two oldest,
        which the marginalisation prior refers to.

        """
        self.num_carried += 1
        newest = self.entries[-1]
        newest.array.reasons[newest.row] = Reason.BUDGET
        self.starts = [*self.starts]
        if len(self.starts) == len(self.entries) - 1:  # else its first window is to come
            self.starts.append(self.seen[-1].box)
        if len(self.entries) > length:
            excess = slice(PRIOR_POSES, PRIOR_POSES + len(self.entries) - length)
            del self.entries[excess], self.seen[excess], self.starts[excess]

    def forget(self, length: int) -> None:
        """Leave only the last `length` observations to the next window."""
        excess = max(0, len(self.entries) - length)
        self.entries, self.seen = self.entries[excess:], self.seen[excess:]
        self.starts = self.starts[excess:]

    def coasts(self, stamp_ns: int, config: Config) -> bool:
        """Return whether a box may be predicted at a stamp without a detection."""
        if stamp_ns > self.detected_ns + round(config.coast * 1e9):
            return False
        pairs = zip(self.entries, self.seen, strict=True)
        detected = [observation for entry, observation in pairs if not entry.is_predicted]
        if not self.entries[-1].is_predicted and len(detected) >= MIN_HITS:
            self.least_points = points_to_confirm(detected)
        return self.least_points < inf

    def predicted(self, stamp_ns: int, config: Config) -> Floats:
        """Return the box (9,) at a stamp by the motion of the newest estimates."""
        stamps_ns = np.array([one.stamp_ns for one in self.seen])
        boxes = np.array([*self.starts, *(one.box for one in self.seen[len(self.starts) :])])
        motion = motion_at(stamps_ns, boxes, -1, config.class_config(self.class_name))
        return motion.predict(stamp_ns)

    def split_at_id_switch(self) -> ObservedTrack | None:
        """
        Move the last two observations to a new track if they are of another object.

        They are if both are farther from the constant velocity prediction than half the length
        of the object and `switch_distance`, or of another size after a pause. A single one may be
        an outlier.

        """
        recent = self.entries[-ID_SWITCH_OBSERVATIONS:]
        if len(recent) < ID_SWITCH_OBSERVATIONS - 1:
            return None
        first, latest = recent[0], recent[-3]
        duration_ns = latest.stamp_ns - first.stamp_ns
        first_x, first_y, *_ = first.place
        latest_x, latest_y, _, *extents = latest.place
        for entry in (recent[-1], recent[-2]):
            elapsed_ns = entry.stamp_ns - latest.stamp_ns
            seconds, part = elapsed_ns * 1e-9, elapsed_ns / duration_ns
            off_x = entry.place[0] - latest_x - part * (latest_x - first_x)
            off_y = entry.place[1] - latest_y - part * (latest_y - first_y)
            is_near = hypot(off_x, off_y) < extents[0] / 2 + switch_distance(seconds)
            if is_near and not is_other_size(prod(extents), prod(entry.place[3:]), seconds):
                return None
        moved, seen = [copy(entry) for entry in self.entries[-2:]], self.seen[-2:]
        for entry in moved:
            entry.array.observed[entry.row] = entry
        del self.entries[-2:], self.seen[-2:]
        self.starts = self.starts[: len(self.entries)]
        newest = moved[-1]
        class_name = newest.array.input.class_names[newest.row]
        return ObservedTrack(self.track_id, class_name, moved, seen, detected_ns=self.detected_ns)

    def write(self, estimate: Estimate, entries: list[PendingBox], length: int) -> None:
        """
        Pass the estimate of the window of `entries` to those that are not settled.

        The next window begins with the last `length` of them.

        """
        self.num_carried = 0
        table, begin, end, self.prior = estimate
        first = max(begin, end - length)
        self.starts = table.boxes[first : min(first + len(self.entries), end)]
        for row, entry in enumerate(entries, begin):
            if not entry.is_settled:
                entry.estimate = table, row
