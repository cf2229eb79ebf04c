"""The two passes over a recording that complete its tracks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.input_statistics import Drives
from boxreg_ros.core.matching import Pair, StampMatcher
from boxreg_ros.core.observation import crop
from boxreg_ros.core.registrar import BoxRegistrar, Submit
from boxreg_ros.io.session import hand_to_registrar
from boxreg_ros.io.stamp_order import kept
from boxreg_ros.offline.every_sweep import Arrivals
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import (
    BoxArray,
    Floats,
    Ints,
    is_valid_box,
    RefinedBoxes,
    ROLL,
    Sweep,
)
from boxreg_ros.tracks.complete import complete, CompletionPlan, TrackSteps
from boxreg_ros.tracks.followed import with_evidence
import numpy as np

ROAD_CLEARANCE = 0.3
"""Points are above the road if they are so high above the bottom of a box [m]; chosen: the height
of a box errs by 0.1 m, and the road within it by as much."""
SIDE_MARGIN = 0.2
"""Points up to so far outside of the sides of a box count [m]; chosen: the error of the input."""

Moved = Sweep | BoxArray | None
"""An item in the fixed frame; None where no transform is known."""


class PointCounter:
    """Count the points above the road in boxes, (n,) by the ticket of each array with a sweep."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self.counts: dict[object, Ints] = {}
        self.restart()

    def restart(self) -> None:
        """Discard sweeps and boxes that wait for each other."""
        self._matcher = StampMatcher(self._config, Counter())

    def add(self, item: Moved) -> None:
        """Add a sweep or boxes."""
        if isinstance(item, BoxArray):
            self._count(self._matcher.add_boxes(item))
        elif item is not None:
            self._count(self._matcher.add_sweep(item))

    def finish(self) -> None:
        """Count the boxes that still wait."""
        self._count(self._matcher.flush())

    def of(self, array: BoxArray) -> Ints:
        """Return the counts of an array; zeros where it has no sweep."""
        return self.counts.get(array.ticket, np.zeros(len(array.track_ids), np.int64))

    def _count(self, pairs: Iterable[Pair]) -> None:
        for boxes, sweep in pairs:
            if sweep is not None:
                self.counts[boxes.ticket] = points_above_road(sweep, boxes.boxes)


def points_above_road(sweep: Sweep, boxes: Floats) -> Ints:
    """Return the number of points (n,) in boxes (n, 9), without the lowest part; 0 if invalid."""
    counts = np.zeros(len(boxes), np.int64)
    valid = np.flatnonzero(is_valid_box(boxes))
    if not len(valid):
        return counts
    near = crop(sweep, boxes[valid], SIDE_MARGIN)
    up = matrix_from_rpy(boxes[valid, ROLL:])[:, :, 2]
    half_height = boxes[valid, 5] / 2
    height = (near.offset * up.T.take(near.owner, 1)).sum(0) + half_height.take(near.owner)
    is_inside = (near.outside.max(0) <= SIDE_MARGIN) & (height > ROAD_CLEARANCE)
    counts[valid] = np.bincount(near.owner[is_inside], minlength=len(valid))
    return counts


class FirstPass(NamedTuple):
    """A registered recording, before its tracks are completed: by part between time jumps."""

    given: list[list[BoxArray]]
    results: list[list[RefinedBoxes]]
    num_points: list[list[Ints]]
    parts: list[Arrivals]

    def plan(self, fixed_frame: str, config: Config) -> CompletionPlan:
        """Return what completes the tracks in the fixed frame; each part on its own."""
        whole = CompletionPlan([], [])
        for part in zip(*self[:3], strict=True):
            whole.append(complete(*part, fixed_frame, config))
        return whole


def first_pass(
    items: Iterable[tuple[Moved, bool]],
    config: Config,
    submit: Submit | None = None,
    fixed_frame: str | None = None,
    drives: Drives | None = None,
) -> FirstPass:
    """
    Register a recording, and count the points in its boxes.

    `items` are in the fixed frame, each with whether time went back before it. With `fixed_frame`
    sweeps without boxes get an empty array, see `Arrivals`. The rest is as of `BoxRegistrar`.

    """
    registrar = BoxRegistrar(config, submit, drives=drives)
    counter = PointCounter(config)
    parts = [Arrivals()]
    count = 0
    results: dict[object, RefinedBoxes] = {}
    is_early = config.estimate == 'early'

    def keep(ready: Iterable[RefinedBoxes]) -> None:
        for result in ready:
            if result.is_final or is_early:
                results.setdefault(result.boxes.ticket, result)

    for item, restarts in items:
        if restarts:
            counter.finish()
            counter.restart()
            parts.append(Arrivals())
        moved = item
        if isinstance(moved, BoxArray):
            moved = replace(moved, ticket=count)
            count += 1
        if moved is not None:
            parts[-1].add(moved)
        counter.add(moved)
        keep(hand_to_registrar(registrar, moved, restarts))
    keep(registrar.flush())
    counter.finish()
    arrays = [
        part.arrays if fixed_frame is None else part.completed(fixed_frame) for part in parts
    ]
    return FirstPass(
        arrays,
        [
            [results[a.ticket] if a.ticket is not None else kept(a, '') for a in given]
            for given in arrays
        ],
        [[counter.of(array) for array in given] for given in arrays],
        parts,
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
        self._counter = PointCounter(config)
        self._given: list[BoxArray] = []
        self._to_register: list[BoxArray] = []
        self._index_of: dict[object, int] = {}
        self._results: dict[int, RefinedBoxes] = {}

    def to_register(self, item: Moved, restarts: bool) -> Moved:
        """Return an item as it is to be registered: boxes with those that the plan adds."""
        if restarts:
            self._counter.finish()
            self._counter.restart()
        if isinstance(item, BoxArray):
            index = len(self._given)
            self._given.append(item)
            self._index_of[item.ticket] = index
            item = self._plan.arrays[index].to_register(item)
            self._to_register.append(item)
        self._counter.add(item)
        return item

    def added_boxes(self, given: BoxArray) -> BoxArray:
        """Return the boxes that the plan adds to an array, after `to_register` of it."""
        return self._plan.arrays[self._index_of[given.ticket]].added_boxes(given)

    def add(self, ready: Iterable[RefinedBoxes]) -> None:
        """Hold results of the registrar."""
        for result in ready:
            if result.is_final or self._is_early:
                self._results.setdefault(self._index_of[result.boxes.ticket], result)

    def finished(self) -> list[RefinedBoxes]:
        """Return the results of all arrays, in their order."""
        self._counter.finish()
        points = [self._counter.of(array) for array in self._to_register]
        registered = [self._results[index] for index in range(len(self._given))]
        results = self._plan.finished(self._given, registered, points)
        if self._deviations is None:
            return results
        pairs = zip(self._given, self._to_register, strict=True)
        keyframes = [
            replace(given, boxes=registered.boxes[: len(given.track_ids)])
            for given, registered in pairs
        ]  # none of them is rejected
        return with_evidence(keyframes, results, self._deviations)


def completed(
    items: Sequence[Sweep | BoxArray],
    fixed_frame: str,
    config: Config,
    first: FirstPass | None = None,
) -> tuple[list[RefinedBoxes], list[TrackSteps]]:
    """
    Return the completed tracks of a drive in memory, and the effects of the steps on each.

    `items` are in the order of stamps, in the fixed frame; `first` is a first pass over the same
    items, with any of the steps.

    """
    if first is None:
        first = first_pass(((item, False) for item in items), config)
    plan = first.plan(fixed_frame, config)
    completion = Completion(plan, config)
    registrar = BoxRegistrar(config)
    for ticket, item in enumerate(items):
        moved = replace(item, ticket=ticket) if isinstance(item, BoxArray) else item
        completion.add(hand_to_registrar(registrar, completion.to_register(moved, False), False))
    completion.add(registrar.flush())
    return completion.finished(), plan.tracks
