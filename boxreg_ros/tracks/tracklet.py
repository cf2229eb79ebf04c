"""Tracklets: the boxes of one object under one id, without doubt about the identity."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import NamedTuple

from boxreg_ros.config import ClassConfig, Config
from boxreg_ros.structures import (
    BOX_CENTER,
    Floats,
    Ints,
    is_valid_box,
    KEPT,
    LENGTH,
    RefinedBoxes,
)
import numpy as np

SWITCH_SPEED = 10.0
"""
Deviation from constant velocity beyond half a length that is another object [m/s].

Derived: as in the registrar, no road user changes its velocity by 10 m/s within two boxes.

"""
UNKNOWN_SPEED = 40.0
"""Greatest speed of an object of which only one box is known [m/s]; chosen: a motorway."""


class Place(NamedTuple):
    """Where a box of the input stands: index of its array, and row in the array."""

    array: int
    row: int


@dataclass(frozen=True, slots=True)
class Tracklet:
    """
    Boxes of one object in the order of stamps; at most one per stamp.

    Attributes
    ----------
    track_id, class_name : str
        Identity, and the most frequent class of the boxes.
    places : tuple of n Place
        Of the input boxes.
    stamps_ns : array, shape (n,)
        Strictly increasing [ns].
    boxes : array, shape (n, 9)
        Registered boxes, or the input where they were kept, in the fixed frame.
    covariances : array, shape (n, 6, 6)
        Of x y z roll pitch yaw.
    scores : array, shape (n,)
        Detector confidence.
    num_points : array, shape (n,)
        Points above the road in each input box.
    fragments : int
        Tracklets of the input that it consists of.

    """

    track_id: str
    class_name: str
    places: tuple[Place, ...]
    stamps_ns: Ints
    boxes: Floats
    covariances: Floats
    scores: Floats
    num_points: Ints
    fragments: int = 1

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


def joined_tracklets(tracklets: Sequence[Tracklet]) -> Tracklet:
    """Return tracklets of one object as one, under the id of the longest."""
    longest = max(tracklets, key=lambda tracklet: len(tracklet.stamps_ns))
    stamps_ns = np.concatenate([tracklet.stamps_ns for tracklet in tracklets])
    order = np.argsort(stamps_ns, kind='stable')
    places = [place for tracklet in tracklets for place in tracklet.places]
    votes: Counter[str] = Counter()
    for tracklet in tracklets:
        votes[tracklet.class_name] += len(tracklet.stamps_ns)
    return Tracklet(
        longest.track_id,
        votes.most_common(1)[0][0],
        tuple(places[row] for row in order),
        stamps_ns[order],
        np.concatenate([tracklet.boxes for tracklet in tracklets])[order],
        np.concatenate([tracklet.covariances for tracklet in tracklets])[order],
        np.concatenate([tracklet.scores for tracklet in tracklets])[order],
        np.concatenate([tracklet.num_points for tracklet in tracklets])[order],
        sum(tracklet.fragments for tracklet in tracklets),
    )


def tracklets_of(
    results: Sequence[RefinedBoxes],
    num_points: Sequence[Ints],
    fixed_frame: str,
    config: Config,
) -> list[Tracklet]:
    """
    Return the boxes of a recording as tracklets.

    An id is split where it names two objects: at one stamp, after `max_gap` without a box, or
    where the next box is out of reach. The longest part keeps the id. Invalid boxes, those
    without an id and those in another frame are in no tracklet.

    Parameters
    ----------
    results : sequence of RefinedBoxes
        One per box array.
    num_points : sequence of arrays, shape (n,)
        Points above the road in each box of each array.
    fixed_frame : str
        Frame of the tracklets.
    config : Config
        `max_gap`, and the settings of the classes.

    """
    places_of: dict[str, list[Place]] = {}
    for index, result in enumerate(results):
        if result.boxes.frame_id != fixed_frame:
            continue
        is_valid = is_valid_box(result.boxes.boxes)
        for row, track_id in enumerate(result.boxes.track_ids):
            if track_id and is_valid[row]:
                places_of.setdefault(track_id, []).append(Place(index, row))
    tracklets = []
    taken = set(places_of)
    for track_id, places in places_of.items():
        parts = _split(places, results, config)
        parts.sort(key=len, reverse=True)  # stable: of equal ones the first keeps the id
        for part in parts:
            name = track_id if part is parts[0] else unused_id(track_id, taken)
            tracklets.append(_tracklet(name, part, results, num_points, config))
    return sorted(tracklets, key=lambda tracklet: tracklet.first_ns)


def unused_id(track_id: str, taken: set[str]) -> str:
    """Return an id like `track_id` that is not among those `taken`, and take it."""
    names = (f'{track_id}_{number}' for number in count(2))
    name = next(name for name in names if name not in taken)
    taken.add(name)
    return name


class _Part:
    """An open part of an id, with its last two boxes."""

    def __init__(self, place: Place, stamp_ns: int, box: Floats) -> None:
        self.places = [place]
        self._stamp_ns = stamp_ns
        self._box = box
        self._velocity: Floats | None = None  # [m/s]

    def excess(self, stamp_ns: int, box: Floats, max_gap: float) -> float:
        """Return how far a box is from the prediction, in parts of its gate; inf if too late."""
        seconds = (stamp_ns - self._stamp_ns) * 1e-9
        if not 0 < seconds <= max_gap:
            return np.inf
        speed = UNKNOWN_SPEED if self._velocity is None else SWITCH_SPEED
        velocity = np.zeros(3) if self._velocity is None else self._velocity
        predicted = self._box[BOX_CENTER] + seconds * velocity
        gate = self._box[LENGTH] / 2 + speed * seconds
        return float(np.linalg.norm((box[BOX_CENTER] - predicted)[:2]) / gate)

    def add(self, place: Place, stamp_ns: int, box: Floats) -> None:
        seconds = (stamp_ns - self._stamp_ns) * 1e-9
        self._velocity = (box - self._box)[BOX_CENTER] / seconds
        self.places.append(place)
        self._stamp_ns = stamp_ns
        self._box = box


def _split(
    places: Iterable[Place], results: Sequence[RefinedBoxes], config: Config
) -> list[list[Place]]:
    """Return the boxes of one id as parts that are one object each."""

    def stamp_of(place: Place) -> int:
        return results[place.array].boxes.stamp_ns

    parts: list[_Part] = []
    for place in sorted(places, key=stamp_of):
        stamp_ns = stamp_of(place)
        box = results[place.array].boxes.boxes[place.row]
        excess = [part.excess(stamp_ns, box, config.max_gap) for part in parts]
        best = int(np.argmin(excess)) if excess else -1
        if excess and excess[best] <= 1:
            parts[best].add(place, stamp_ns, box)
        else:
            parts.append(_Part(place, stamp_ns, box))
    return [part.places for part in parts]


def _tracklet(
    track_id: str,
    places: Sequence[Place],
    results: Sequence[RefinedBoxes],
    num_points: Sequence[Ints],
    config: Config,
) -> Tracklet:
    """Return the boxes at some places as a tracklet."""
    classes = Counter(results[place.array].boxes.class_names[place.row] for place in places)
    tracklet = Tracklet(
        track_id,
        classes.most_common(1)[0][0],
        tuple(places),
        np.array([results[place.array].boxes.stamp_ns for place in places]),
        np.array([results[place.array].boxes.boxes[place.row] for place in places]),
        np.array([results[place.array].covariances[place.row] for place in places]),
        np.array([results[place.array].boxes.scores[place.row] for place in places]),
        np.array([num_points[place.array][place.row] for place in places]),
    )
    is_kept = [results[place.array].status[place.row] == KEPT for place in places]
    covariances = tracklet.covariances.copy()
    covariances[is_kept] = _input_covariance(tracklet.model(config))
    return replace(tracklet, covariances=covariances)


def _input_covariance(model: ClassConfig) -> Floats:
    """Return the covariance (6, 6) of an input box; that of a kept box is not known."""
    horizontal = max(model.position, model.lateral)
    deviations = [horizontal, horizontal, model.height, model.tilt, model.tilt, model.heading]
    return np.diag(np.square(deviations))
