"""Tracklets: the boxes of one object under one id, without doubt about the identity."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import count
from math import inf
from typing import ClassVar, NamedTuple

from boxreg_ros.config import ClassConfig, Config
from boxreg_ros.core.id_switches import is_other_size, switch_distance
from boxreg_ros.core.motion import EndMotion, motion_at, UNKNOWN_SPEED_DEVIATION
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import (
    BOX_CENTER,
    BOX_EXTENT,
    Columns,
    concatenated,
    Floats,
    Ints,
    is_valid_box,
    KEPT,
    LENGTH,
    PITCH,
    RefinedBoxes,
    ROLL,
    X,
    Y,
    YAW,
)
import numpy as np

UNKNOWN_SPEED = 40.0
"""Greatest speed of an object of which only one box is known [m/s]; chosen: a motorway."""


class Place(NamedTuple):
    """Where a box of the input stands: index of its array, and row in the array."""

    array: int
    row: int


@dataclass(frozen=True, slots=True)
class Tracklet(Columns):
    """Boxes of one object in the order of stamps; at most one per stamp."""

    COLUMNS: ClassVar[tuple[str, ...]] = (
        *('places', 'stamps_ns', 'boxes', 'covariances', 'scores', 'num_points'),
    )

    track_id: str
    class_name: str  # the most frequent one of the boxes
    places: tuple[Place, ...]  # n, of the input boxes
    stamps_ns: Ints  # (n,) strictly increasing
    boxes: Floats  # (n, 9) registered, or the input where they were kept, in the fixed frame
    covariances: Floats  # (n, 6, 6) of x y z roll pitch yaw
    scores: Floats  # (n,) detector confidence
    num_points: Ints  # (n,) points above the road in each input box
    fragments: int = 1  # tracklets of the input that it consists of

    @property
    def first_ns(self) -> int:
        """Return the stamp of the first box [ns]."""
        return int(self.stamps_ns[0])

    @property
    def last_ns(self) -> int:
        """Return the stamp of the last box [ns]."""
        return int(self.stamps_ns[-1])

    def model(self, config: Config) -> ClassConfig:
        """Return the settings of its kind of object."""
        return config.class_config(self.class_name)


def joined_tracklets(tracklets: Sequence[Tracklet], names: Collection[str] = ()) -> Tracklet:
    """
    Return tracklets of one object as one.

    Parameters
    ----------
    tracklets : sequence of Tracklet
        At least one, without a stamp in common.
    names : collection of str
        Ids that a person gave.

    Returns
    -------
    tracklet : Tracklet
        In the order of stamps, under an id of `names` if one has it, else that of the longest; the
        class is the most frequent one, by boxes.

    """
    longest = max(tracklets, key=lambda one: (one.track_id in names, len(one.stamps_ns)))
    votes: Counter[str] = Counter()
    for tracklet in tracklets:
        votes[tracklet.class_name] += len(tracklet.stamps_ns)
    whole = replace(
        concatenated(tracklets),
        track_id=longest.track_id,
        class_name=votes.most_common(1)[0][0],
        fragments=sum(tracklet.fragments for tracklet in tracklets),
    )
    return whole.take(np.argsort(whole.stamps_ns, kind='stable'))


def tracklets_of(
    results: Sequence[RefinedBoxes],
    num_points: Sequence[Ints],
    fixed_frame: str,
    config: Config,
    names: Collection[str] = (),
    pause: Callable[[str], float] = lambda _: 0.0,
) -> list[Tracklet]:
    """
    Return the boxes of a recording, as its results have them, as tracklets in one frame.

    An id is split where it names two objects: at one stamp, after `max_gap` without a box, or
    where the next box is out of reach. The longest part keeps the id.

    Parameters
    ----------
    results : sequence of RefinedBoxes
        One per array.
    num_points : sequence of array, shape (n,)
        Points above the road in each of the n boxes of an array.
    fixed_frame : str
        Boxes in another frame are in no tracklet, nor are invalid ones and those without an id.
    config : Config
        `max_gap` [s], and the settings of the kinds of objects.
    names : collection of str
        Ids that are of one object each, and never split: of two boxes at one stamp only the first
        is in the tracklet.
    pause : callable
        Returns by how much `max_gap` is longer for an id [s].

    Returns
    -------
    tracklets : list of Tracklet
        In the order of their start. Kept boxes have the covariance of an input box of their class.

    """
    own = [(i, one) for i, one in enumerate(results) if one.boxes.frame_id == fixed_frame]
    if not own:
        return []
    table = BoxTable.from_arrays([one.boxes for _, one in own])
    every = Tracklet(
        '',
        '',
        tuple(Place(index, row) for index, one in own for row in range(len(one.status))),
        table.stamps_ns,
        table.boxes,
        np.concatenate([one.covariances for _, one in own]),
        table.scores,
        np.concatenate([num_points[index] for index, _ in own]),
    )
    track_ids, class_names = table.track_ids, table.class_names
    is_kept = np.array([word == KEPT for _, one in own for word in one.status], bool)
    rows_of: dict[str, list[int]] = {}
    for row in np.flatnonzero(is_valid_box(every.boxes)).tolist():
        if track_ids[row]:
            rows_of.setdefault(track_ids[row], []).append(row)
    tracklets = []
    taken = set(rows_of)
    for track_id, rows in rows_of.items():
        max_gap = inf if track_id in names else config.max_gap + pause(track_id)
        parts = _split(every, rows, max_gap)
        parts.sort(key=len, reverse=True)  # stable: of equal ones the first keeps the id
        for part in parts[:1] if track_id in names else parts:
            name = track_id if part is parts[0] else unused_id(track_id, taken)
            class_name = Counter(class_names[row] for row in part).most_common(1)[0][0]
            tracklet = replace(every.take(part), track_id=name, class_name=class_name)
            tracklet.covariances[is_kept[part]] = _input_covariance(tracklet.model(config))
            tracklets.append(tracklet)
    return sorted(tracklets, key=lambda tracklet: tracklet.first_ns)


def unused_id(track_id: str, taken: set[str]) -> str:
    """Return an id like `track_id` that is not among those `taken`, and take it."""
    names = (f'{track_id}_{number}' for number in count(2))
    name = next(name for name in names if name not in taken)
    taken.add(name)
    return name


class _Part:
    """An open part of an id, with its last two boxes."""

    def __init__(self, row: int, stamp_ns: int, box: Floats) -> None:
        self.rows = [row]
        self._stamp_ns = stamp_ns
        self._box = box
        self._velocity: Floats | None = None  # [m/s]

    def excess(self, stamp_ns: int, box: Floats, max_gap: float) -> float:
        """Return how far a box is from the prediction, in parts of its gate; inf if too late."""
        seconds = (stamp_ns - self._stamp_ns) * 1e-9
        if not 0 < seconds <= max_gap:
            return np.inf
        if max_gap == inf:
            return 0.0
        volumes = self._box[BOX_EXTENT].prod(), box[BOX_EXTENT].prod()
        if is_other_size(*volumes, seconds):
            return np.inf
        velocity, reach = self._velocity, switch_distance(seconds)
        if velocity is None:
            velocity, reach = np.zeros(3), UNKNOWN_SPEED * seconds
        predicted = self._box[BOX_CENTER] + seconds * velocity
        gate = self._box[LENGTH] / 2 + reach
        return float(np.linalg.norm((box[BOX_CENTER] - predicted)[:2]) / gate)

    def add(self, row: int, stamp_ns: int, box: Floats) -> None:
        """Add a box."""
        seconds = (stamp_ns - self._stamp_ns) * 1e-9
        self._velocity = (box - self._box)[BOX_CENTER] / seconds
        self.rows.append(row)
        self._stamp_ns = stamp_ns
        self._box = box


def _split(every: Tracklet, rows: Iterable[int], max_gap: float) -> list[list[int]]:
    """Return the boxes of one id as parts that are one object each; `inf` joins all in reach."""
    parts: list[_Part] = []
    for row in sorted(rows, key=every.stamps_ns.__getitem__):
        stamp_ns, box = int(every.stamps_ns[row]), every.boxes[row]
        excess = [part.excess(stamp_ns, box, max_gap) for part in parts]
        best = int(np.argmin(excess)) if excess else -1
        if excess and excess[best] <= 1:
            parts[best].add(row, stamp_ns, box)
        else:
            parts.append(_Part(row, stamp_ns, box))
    return [part.rows for part in parts]


def _input_covariance(model: ClassConfig) -> Floats:
    """Return the covariance (6, 6) of an input box; that of a kept box is not known."""
    horizontal = max(model.position, model.lateral)
    deviations = [horizontal, horizontal, model.height, model.tilt, model.tilt, model.heading]
    return np.diag(np.square(deviations))


PARKED_RADIUS = 0.5
"""A parked object stays within this distance of its median position [m]; chosen: 5 deviations."""


def end_motion(tracklet: Tracklet, is_last: bool, config: Config) -> EndMotion:
    """Return the motion at the last or the first box of a tracklet, from a fit of lines."""
    row = -1 if is_last else 0
    return motion_at(tracklet.stamps_ns, tracklet.boxes, row, tracklet.model(config))


def is_parked(boxes: Floats) -> bool:
    """Return whether boxes (n, 9) of one object stand at one place."""
    offsets = boxes[:, X : Y + 1] - np.median(boxes[:, X : Y + 1], axis=0)
    return bool((np.linalg.norm(offsets, axis=1) < PARKED_RADIUS).all())


def between(before: EndMotion, after: EndMotion, stamps_ns: Ints) -> Floats:
    """
    Return the boxes of an object at stamps between two of its boxes.

    The centre follows the cubic Hermite curve of positions and velocities at both ends. Heading
    and extents are interpolated linearly; a half turn is no rotation of the object.

    Parameters
    ----------
    before, after : EndMotion
        Box and velocity at both ends, in one frame. Where the velocity is not known, that of the
        straight line between them is used.
    stamps_ns : array, shape (n,)
        Between theirs [ns].

    Returns
    -------
    boxes : array, shape (n, 9)
        In the same frame [m, rad]; roll and pitch are those of `before`.

    """
    duration_ns = after.stamp_ns - before.stamp_ns
    s = ((stamps_ns - before.stamp_ns) / duration_ns)[:, None]
    seconds = duration_ns * 1e-9
    chord = (after.box - before.box)[BOX_CENTER] / seconds
    ends = [
        (chord if one.speed_variance >= UNKNOWN_SPEED_DEVIATION**2 else one.velocity) * seconds
        for one in (before, after)
    ]  # that of the chord where only one box is known
    boxes = (1 - s) * before.box + s * after.box
    boxes[:, BOX_CENTER] = (
        (1 + 2 * s) * (1 - s) ** 2 * before.box[BOX_CENTER]
        + s * (1 - s) ** 2 * ends[0]
        + s**2 * (3 - 2 * s) * after.box[BOX_CENTER]
        - s**2 * (1 - s) * ends[1]
    )
    turn = wrap_angle(2 * (after.box[YAW] - before.box[YAW])) / 2
    boxes[:, YAW] = wrap_angle(before.box[YAW] + s[:, 0] * turn)
    for angle in (ROLL, PITCH):
        boxes[:, angle] = before.box[angle]
    return np.asarray(boxes)


@dataclass(frozen=True, slots=True)
class AddedBoxes(Columns):
    """Successive boxes that a step adds to one track, in the fixed frame."""

    COLUMNS: ClassVar[tuple[str, ...]] = ('stamps_ns', 'boxes', 'covariances', 'scores')

    status: str  # ``interpolated`` or ``extended``
    stamps_ns: Ints  # (n,) [ns]; of an extension from the track outwards
    boxes: Floats  # (n, 9) on the motion model
    covariances: Floats  # (n, 6, 6) of x y z roll pitch yaw on the motion model
    scores: Floats  # (n,) detector confidence, from the neighbours
