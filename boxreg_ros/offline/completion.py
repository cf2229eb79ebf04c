"""The two passes over a recording that complete its tracks, the second with every sweep."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from math import inf
from typing import NamedTuple, Self

from boxreg_ros.config import Config
from boxreg_ros.core.input_statistics import Drives
from boxreg_ros.core.latency import Latency
from boxreg_ros.core.matching import Pair
from boxreg_ros.core.observation import crop
from boxreg_ros.core.registrar import BoxRegistrar, Submit
from boxreg_ros.io.items import Item
from boxreg_ros.io.session import hand_to_registrar
from boxreg_ros.io.stamp_join import nearest_rows
from boxreg_ros.io.sweep_store import SweepStore
from boxreg_ros.offline.reader import ArrayPlace
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import (
    BoxArray,
    Floats,
    Ints,
    is_valid_box,
    kept,
    RefinedBoxes,
    ROLL,
    Sweep,
)
from boxreg_ros.tracks.complete import complete, CompletionPlan, PlannedArray
from boxreg_ros.tracks.decided import Decided, NOTHING
from boxreg_ros.tracks.followed import with_evidence
import numpy as np


@dataclass(slots=True)
class Arrivals:
    """Sweeps and box arrays of a part of a recording between two time jumps, as they arrived."""

    # the stamp of each sweep, and box arrays, in the fixed frame
    items: list[int | BoxArray] = field(default_factory=list)
    # largest distance of an array that is of a sweep [ns]; None for half a period
    reach_ns: int | None = None
    # with the points of the sweeps, where objects are followed through them
    sweeps: SweepStore | None = None

    @classmethod
    def empty(cls, with_sweeps: bool, reach_ns: int | None = None) -> Self:
        """Return a part before its first item."""
        return cls([], reach_ns, SweepStore() if with_sweeps else None)

    def add(self, item: Sweep | BoxArray) -> None:
        """Add an item that has a transform."""
        if self.sweeps is not None and isinstance(item, Sweep):
            self.sweeps.add(item)
        self.items.append(item.stamp_ns if isinstance(item, Sweep) else item)

    @property
    def arrays(self) -> list[BoxArray]:
        """Box arrays."""
        return [item for item in self.items if isinstance(item, BoxArray)]

    def missing_ns(self) -> list[int]:
        """Return the stamps of sweeps without a box array within `reach_ns`."""
        stamps_ns = [item for item in self.items if not isinstance(item, BoxArray)]
        sweeps = np.unique(np.array(stamps_ns, np.int64))
        arrays = np.sort(np.array([array.stamp_ns for array in self.arrays], np.int64))
        if len(sweeps) < 2 or not len(arrays):
            return []
        away = np.abs(arrays[nearest_rows(sweeps, arrays)] - sweeps)
        reach_ns = np.median(np.diff(sweeps)) / 2 if self.reach_ns is None else self.reach_ns
        missing: list[int] = sweeps[away > reach_ns].tolist()
        return missing

    def insertions(self) -> list[list[int]]:
        """Return for each item the stamps of the empty arrays that are inserted after it."""
        missing = set(self.missing_ns())
        oldest_to_come = _oldest_to_come(self.arrays)
        arrived = 0
        waiting: list[int] = []
        found = []
        for item in self.items:
            if isinstance(item, BoxArray):
                arrived += 1
            elif item in missing:
                missing.discard(item)
                waiting.append(item)
            # After their sweep, and after all older arrays.
            found.append(sorted(one for one in waiting if one < oldest_to_come[arrived]))
            waiting = [one for one in waiting if one >= oldest_to_come[arrived]]
        return found

    def completed(self, frame_id: str) -> list[BoxArray]:
        """Return the arrays in the order of `with_empty_arrays`, empty ones included."""
        found: list[BoxArray] = []
        for item, stamps_ns in zip(self.items, self.insertions(), strict=True):
            if isinstance(item, BoxArray):
                found.append(item)
            found += [BoxArray.empty(stamp_ns, frame_id) for stamp_ns in stamps_ns]
        return found


def _oldest_to_come(arrays: Sequence[BoxArray]) -> list[float]:
    """Return the oldest stamp among the arrays from each on; inf behind the last."""
    oldest: list[float] = [inf]
    for array in reversed(arrays):
        oldest.append(min(oldest[-1], array.stamp_ns))
    return oldest[::-1]


def with_boxes_in_time(items: Iterable[Item], in_time: Sequence[BoxArray]) -> Iterator[Item]:
    """Yield the items of a recording with the boxes that a `FirstPass` has brought in time."""
    arrays = iter(in_time)
    for item in items:
        if isinstance(item.moved, BoxArray):  # the first pass does without attributes
            given = item.moved
            boxes = replace(next(arrays), ticket=given.ticket, attributes=given.attributes)
            item = item._replace(moved=boxes)
        yield item


def with_empty_arrays(
    items: Iterable[Item], parts: Sequence[Arrivals], frame_id: str
) -> Iterator[Item]:
    """Yield the items of a recording, and an empty array for each sweep without one."""
    insertions = chain.from_iterable(part.insertions() for part in parts)
    poses: dict[int, Floats | None] = {}
    for item in items:
        yield item
        if item.moved is None:
            continue
        if isinstance(item.moved, Sweep):
            poses[item.moved.stamp_ns] = item.T_fixed_sensor
        for stamp_ns in next(insertions):
            empty = BoxArray.empty(stamp_ns, frame_id)
            moved = replace(empty, ticket=ArrayPlace())
            pose = poses.pop(stamp_ns)
            yield Item(
                item.received_ns, empty, moved=moved, T_fixed_item=np.eye(4), T_fixed_sensor=pose
            )


ROAD_CLEARANCE = 0.3
"""Points are above the road if they are so high above the bottom of a box [m]; chosen: the height
of a box errs by 0.1 m, and the road within it by as much."""
SIDE_MARGIN = 0.2
"""Points up to so far outside of the sides of a box count [m]; chosen: the error of the input."""

Moved = Sweep | BoxArray | None
"""An item in the fixed frame; None where no transform is known."""
NO_COUNTS = np.zeros(0, np.int64)
"""Counts of an array without boxes."""


def points_above_road(sweep: Sweep | None, boxes: Floats) -> Ints:
    """
    Return the number of points in boxes, without the lowest part of each.

    Parameters
    ----------
    sweep : Sweep or None
        In the frame of the boxes; None for no points.
    boxes : array, shape (n, 9)
        In this frame [m, rad].

    Returns
    -------
    num_points : array, shape (n,)
        0 for invalid boxes.

    """
    counts = np.zeros(len(boxes), np.int64)
    valid = np.flatnonzero(is_valid_box(boxes))
    if sweep is None or not len(valid):
        return counts
    near = crop(sweep, boxes[valid], SIDE_MARGIN)
    up = matrix_from_rpy(boxes[valid, ROLL:])[:, :, 2]
    half_height = boxes[valid, 5] / 2
    height = (near.offset * up.T.take(near.owner, 1)).sum(0) + half_height.take(near.owner)
    is_inside = (near.outside.max(0) <= SIDE_MARGIN) & (height > ROAD_CLEARANCE)
    counts[valid] = np.bincount(near.owner[is_inside], minlength=len(valid))
    return counts


class _Registered(NamedTuple):
    """A box array as it was given, in time, and as it was registered."""

    given: BoxArray
    boxes: BoxArray
    num_points: Ints
    """Above the road, in `boxes`."""

    @classmethod
    def of(cls, given: BoxArray, boxes: BoxArray, sweep: Sweep | None) -> Self:
        """Return it with the points of its sweep."""
        return cls(given, boxes, points_above_road(sweep, boxes.boxes))


class FirstPass(NamedTuple):
    """A registered recording, before its tracks are completed: by part between time jumps."""

    given: list[list[BoxArray]]
    """As they were registered."""
    results: list[list[RefinedBoxes]]
    num_points: list[list[Ints]]
    parts: list[Arrivals]
    in_time: list[BoxArray]
    """Of all parts, as they arrived, but where their objects are at their stamp."""
    latency: Latency

    def plan(self, fixed_frame: str, config: Config, decided: Decided = NOTHING) -> CompletionPlan:
        """Return what completes the tracks in the fixed frame; each part on its own."""
        whole = CompletionPlan([], [])
        for part in zip(self.given, self.results, self.num_points, strict=True):
            whole.append(complete(*part, fixed_frame, config, decided))
        return whole


def _unchanged(boxes: BoxArray) -> BoxArray:
    return boxes


def first_pass(
    items: Iterable[tuple[Moved, bool]],
    config: Config,
    submit: Submit | None = None,
    fixed_frame: str | None = None,
    drives: Drives | None = None,
    corrected: Callable[[BoxArray], BoxArray] = _unchanged,
    with_sweeps: bool = False,
) -> FirstPass:
    """
    Register a recording, and count the points in its boxes.

    Parameters
    ----------
    items : iterable of pairs
        In the fixed frame, each with whether time went back before it.
    config, submit, drives
        As of `BoxRegistrar`.
    fixed_frame : str, optional
        With it, sweeps without boxes get an empty array, see `Arrivals`.
    corrected : callable
        Returns boxes in time as a person has decided.
    with_sweeps : bool
        Whether the parts have the points of their sweeps.

    """
    parts = [Arrivals.empty(with_sweeps)]
    arrived = 0
    results: dict[object, RefinedBoxes] = {}
    registered: dict[object, _Registered] = {}
    is_early = config.estimate == 'early'

    def prepared(pair: Pair) -> BoxArray:
        own = _Registered.of(pair.boxes, corrected(pair.boxes), pair.sweep)
        registered[pair.boxes.ticket] = own
        return own.boxes

    def keep(ready: Iterable[RefinedBoxes]) -> None:
        for result in ready:
            if result.is_final or is_early:
                results.setdefault(result.boxes.ticket, result)

    registrar = BoxRegistrar(config, submit, drives=drives, prepare=prepared)
    for moved, restarts in items:
        if restarts:
            parts.append(Arrivals.empty(with_sweeps))
        if isinstance(moved, BoxArray):
            moved = replace(moved, ticket=arrived)
            arrived += 1
        if moved is not None:
            parts[-1].add(moved)
        keep(hand_to_registrar(registrar, moved, restarts))
    keep(registrar.flush())
    for part in parts:
        part.items = [
            one if isinstance(one, int) else registered[one.ticket].boxes for one in part.items
        ]
    arrays = [
        part.arrays if fixed_frame is None else part.completed(fixed_frame) for part in parts
    ]
    return FirstPass(
        arrays,
        [
            [results[a.ticket] if a.ticket is not None else kept(a, '') for a in part]
            for part in arrays
        ],
        [
            [NO_COUNTS if a.ticket is None else registered[a.ticket].num_points for a in part]
            for part in arrays
        ],
        parts,
        [registered[ticket].given for ticket in range(arrived)],
        registrar.latency,
    )


class Completion:
    """
    Register completed tracks: the second pass over the items that the plan was made of.

    `deviations` (9,) are those of the boxes of a person, see `person.numbers`.

    """

    def __init__(
        self, plan: CompletionPlan, config: Config, deviations: Floats | None = None
    ) -> None:
        self._plan = plan
        self._deviations = deviations
        self._is_early = config.estimate == 'early'
        # By ticket: the first in the order of the plan.
        self._planned: dict[object, PlannedArray] = {}
        self._registered: dict[object, _Registered] = {}
        self._results: dict[object, RefinedBoxes] = {}
        self._kept: list[RefinedBoxes] = []

    def expect(self, ticket: object) -> None:
        """Note the ticket of the next box array, in the order of the plan."""
        self._planned[ticket] = self._plan.arrays[len(self._planned)]

    def to_register(self, boxes: BoxArray, sweep: Sweep | None) -> BoxArray:
        """Return boxes as they are to be registered: with those that the plan adds."""
        own = _Registered.of(boxes, self._planned[boxes.ticket].to_register(boxes), sweep)
        self._registered[boxes.ticket] = own
        return own.boxes

    def added_boxes(self, given: BoxArray) -> BoxArray:
        """Return the boxes that the plan adds to an array."""
        return self._planned[given.ticket].added_boxes(given)

    def add(self, ready: Iterable[RefinedBoxes]) -> None:
        """Hold results of the registrar."""
        for result in ready:
            if not (result.is_final or self._is_early):
                continue
            if result.boxes.ticket in self._planned:
                self._results.setdefault(result.boxes.ticket, result)
            else:  # one of `add_kept`: the plan has no place for it
                self._kept.append(result)

    def finished(self) -> list[RefinedBoxes]:
        """Return the results of all arrays, in the order of their stamps."""
        results = self._kept + self._completed()
        return sorted(results, key=lambda result: result.boxes.stamp_ns)

    def _completed(self) -> list[RefinedBoxes]:
        """Return the results of the arrays of the plan, in their order."""
        arrays = [self._registered[ticket] for ticket in self._planned]
        results = self._plan.finished(
            [one.given for one in arrays],
            [self._results[ticket] for ticket in self._planned],
            [one.num_points for one in arrays],
        )
        if self._deviations is None:
            return results
        keyframes = [
            replace(one.given, boxes=one.boxes.boxes[: len(one.given.track_ids)]) for one in arrays
        ]  # none of them is rejected
        return with_evidence(keyframes, results, self._deviations)
