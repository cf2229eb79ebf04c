"""
Extents of boxes against their points: half as large as the objects, or twice.

The figures are those of five drives with extents at 0.5 to 2 times their size, and with poses at
other places of the box.

"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from typing import NamedTuple

from boxreg_ros.structures import Floats
import numpy as np
from numpy.typing import NDArray

HALF_BOXES = 12
"""Boxes by which half extents are seen, which no noise makes; chosen."""
SIZED_BOXES = 24
"""Boxes by which others are seen; chosen: those of one moment are all alike."""
MIN_SIZED_OBJECTS = 2
"""Objects by which they are seen: a single one may be of another class, or stand in bushes."""
MIN_SIZE_POINTS = 10
"""Points of a box, or around it, that it is counted from; chosen."""
ROAD_HEIGHT = 0.2
"""Points up to this far above the bottom or centre of a box may be of the road [m]; chosen."""
POINT_MARGIN = 0.1
"""Points up to this far outside of a box are of its object [m]; chosen, for noise and labels."""
ENLARGED = 1.4
"""Factor of the extents of a larger box; chosen, between those of fitting and of half boxes."""
MIN_OF_ENLARGED = 1.15
"""
Least ratio of the points in such a box to those at the best place of the given box.

Chosen: 1.25 where extents are 0.7 of the right ones, 1.13 where boxes are at another place.

"""
MIN_OF_DOUBLED = 1.5
"""
Least ratio of the points in a box of twice the extents to the most in an `ENLARGED`
one or at another place.

Chosen: 1.6 where extents are half of the right ones, 1.3 where they are 0.7 of them.

"""
MIN_DOUBLED_COVERAGE = 0.5
"""Least part of the points around it in a box of twice the extents; chosen: 0.6 of half ones."""
MIN_RATIO_OF_COVERAGES = 3.0
"""Least ratio of it to that of the given box; chosen: 3.2 of half boxes, 1.5 of right ones."""
MAX_FILLED = 0.6
"""Part of the extents up to which the points of twice too large boxes reach; derived: 0.5."""
MIN_SHARE_WITHIN = 0.8
"""
Share of the points in the upper half of boxes within this part of them, if these are too large.

Chosen: in the median of the objects of a class with extents twice as large 0.8 to 1, with 1.4
times 0.75 at most, but for people in loose boxes.

"""
MAX_SHARE_WITHIN = 0.65
"""The same of boxes that fit: 0 to 0.62; thin objects in loose boxes have most."""


class SizeCounts(NamedTuple):
    """How the points around a box lie in it."""

    shares: Floats
    """
    Shares of the points above its centre in some boxes: first in itself, then at other places, in
    the end with extents `ENLARGED` and 2 times as large. Then the parts of the points around them
    that itself and the doubled box contain.

    """
    within: float | None
    """Share of the points in its upper half that are in its inner part; None of few points."""


def counts_of(is_inside: NDArray[np.bool_], local: Floats, extent: Floats) -> SizeCounts | None:
    """
    Return how points lie in a box; None if they are few.

    Parameters
    ----------
    is_inside : array, shape (n, M)
        Which points are in each of the boxes of `SizeCounts.shares`.
    local : array, shape (M, 3)
        The points by the axes of the box, from its centre [m].
    extent : array, shape (3,)
        Of the box [m].

    """
    upper = is_inside[:, local[:, 2] > ROAD_HEIGHT].sum(axis=1)
    if upper.max() < MIN_SIZE_POINTS:
        return None
    coverages = [coverage(local, extent * scale) or 0.0 for scale in (0.5, 1.0)]
    reach = np.abs(local[local[:, 2] > 0] / (extent / 2)).max(axis=1, initial=0)
    reach = reach[reach <= 1]
    within = float(np.mean(reach <= MAX_FILLED)) if len(reach) >= MIN_SIZE_POINTS else None
    return SizeCounts(np.array([*(upper / upper.max()), *coverages]), within)


def coverage(local: Floats, limit: Floats) -> float | None:
    """
    Return the part of the points around a box that it contains; None if they are few.

    Parameters
    ----------
    local : array, shape (M, 3)
        The points by the axes of the box, from its centre [m].
    limit : array, shape (3,)
        Half of its extents [m].

    """
    away = np.abs(local[local[:, 2] > ROAD_HEIGHT - limit[2]])
    around = int((away <= 2 * limit).all(axis=1).sum())
    inside = int((away <= limit + POINT_MARGIN).all(axis=1).sum())
    return min(1.0, inside / around) if around >= MIN_SIZE_POINTS else None


@dataclass(slots=True)
class SizeEvidence:
    """`SizeCounts` of the first boxes, by object."""

    shares: defaultdict[str, list[Floats]] = field(default_factory=lambda: defaultdict(list))
    within: defaultdict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    count: int = 0

    def add(self, counts: SizeCounts, name: str) -> None:
        """Add a box of an object."""
        self.count += 1
        self.shares[name].append(counts.shares)
        if counts.within is not None:
            self.within[name].append(counts.within)

    @property
    def is_enough(self) -> bool:
        """Return whether there are as many boxes as are needed."""
        return self.count >= SIZED_BOXES

    @property
    def differ(self) -> bool:
        """Return whether extents are not those of the objects."""
        return self.is_half or self.is_smaller or self.is_twice

    @property
    def is_half(self) -> bool:
        """Return whether extents are half of those of the objects."""
        if self.count < HALF_BOXES or len(self.shares) < MIN_SIZED_OBJECTS:
            return False
        _, elsewhere, enlarged, doubled, own_coverage, coverage = self._means
        return doubled >= MIN_OF_DOUBLED * max(enlarged, elsewhere) and coverage >= max(
            MIN_DOUBLED_COVERAGE, MIN_RATIO_OF_COVERAGES * own_coverage
        )

    @property
    def is_smaller(self) -> bool:
        """Return whether boxes `ENLARGED` times as large contain more than at any other place."""
        if not self.count:
            return False
        own, elsewhere, enlarged, *_ = self._means
        return enlarged >= MIN_OF_ENLARGED * max(own, elsewhere)

    @property
    def is_twice(self) -> bool:
        """Return whether extents are twice those of the objects."""
        return self._within >= MIN_SHARE_WITHIN

    @property
    def fits(self) -> bool:
        """Return whether extents are those of the objects, more or less."""
        return 0 <= self._within <= MAX_SHARE_WITHIN and not self.is_smaller

    @property
    def _within(self) -> float:
        """Return the share of the points in the inner parts, in the median; -1 if unknown."""
        if not self.is_enough or len(self.within) < MIN_SIZED_OBJECTS:
            return -1.0
        return float(np.median([np.median(one) for one in self.within.values()]))

    @property
    def _means(self) -> tuple[float, ...]:
        """Return the means of the shares: of the boxes, the best other place, and the others."""
        means = np.mean([np.mean(one, axis=0) for one in self.shares.values()], axis=0).tolist()
        return means[0], max(means[:-4]), *means[-4:]
