"""Check of the convention of box poses and sizes against the points."""

from __future__ import annotations

from dataclasses import replace

from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import (
    BOX_CENTER,
    BOX_EXTENT,
    BoxArray,
    Floats,
    Ints,
    is_valid_box,
    ROLL,
    Sweep,
)
from msg_adapters.convention import Convention, REFERENCES, SIZE_ORDERS
import numpy as np
from numpy.typing import NDArray

DECISIVE_BOXES = 12
"""Number of boxes with points that the result needs."""
MAX_BOXES = 300
"""After this number of boxes, with points or without, the check ends."""
MIN_POINTS_OF_POSE = 10
"""Points that the best convention must have in a box for the box to be counted."""
POINT_MARGIN = 0.1
"""Points up to this distance outside of a box are of its object [m]: range noise and labels."""
EQUIVALENT_SHARE = 0.85
"""A convention with this share of the points of the best one counts as equal to it."""
MIN_GAIN = 1.3
"""Factor by which another convention must exceed the points of the present one."""
MIN_AGREEMENT = 0.7
"""Share of the boxes in which the other convention must have more points."""
DIRECTIONS = (
    ('length', 'behind', 'before'),
    ('width', 'right of', 'left of'),
    ('height', 'below', 'above'),
)


class SortedPoints:
    """Points (N, 3) in the order of x: those around a place are found without the others."""

    def __init__(self, points: NDArray[np.floating]) -> None:
        self._points = points[np.argsort(points[:, 0])]

    def around(self, center: Floats, reach: float) -> Floats:
        """Return the points (n, 3) nearer than `reach` along each axis, relative to `center`."""
        ends = np.searchsorted(self._points[:, 0], (center[0] - reach, center[0] + reach))
        away = self._points[slice(*ends)] - center
        found: Floats = away[(np.abs(away) < reach).all(axis=1)]
        return found


class PairedCheck:
    """A check of the first boxes and the sweeps of their stamps, which arrive in any order."""

    def __init__(self, tolerance: float) -> None:
        self._tolerance_ns = round(tolerance * 1e9)
        self._sweep: Sweep | None = None
        self._boxes: BoxArray | None = None

    def _paired(self, item: Sweep | BoxArray) -> tuple[SortedPoints, BoxArray] | None:
        """Take the next sweep or boxes; return points and boxes if they are of one time."""
        if isinstance(item, Sweep):
            self._sweep = item
        else:
            self._boxes = item
        sweep, boxes = self._sweep, self._boxes
        if sweep is None or boxes is None:
            return None
        if abs(sweep.stamp_ns - boxes.stamp_ns) > self._tolerance_ns:
            return None
        self._sweep = self._boxes = None
        return SortedPoints(sweep.in_frame().points), boxes


class PoseCheck(PairedCheck):
    """
    Compare the first boxes with their points under every convention.

    All conventions give boxes of the same volume about the same pose, so the right one contains
    most points. Sweeps and boxes arrive in any order, in one frame, at most `tolerance` [s] apart.
    `finding` says which setting of the `convention` they were read with is wrong and its right
    value; it is empty if none is known to be wrong.

    """

    def __init__(self, convention: Convention, tolerance: float) -> None:
        super().__init__(tolerance)
        self._convention = convention
        self._others = [
            *(replace(convention, pose_reference=name) for name in REFERENCES),
            *(replace(convention, size_order=order) for order in SIZE_ORDERS),
        ]
        self._counts: list[Ints] = []
        self._seen = 0
        self.finding = ''

    def add(self, item: Sweep | BoxArray) -> None:
        """Add the next sweep or boxes."""
        pair = None if self._is_over else self._paired(item)
        if pair is not None:
            self._count(*pair)
            if len(self._counts) >= DECISIVE_BOXES:
                self.finding = self._result()

    @property
    def _is_over(self) -> bool:
        return len(self._counts) >= DECISIVE_BOXES or self._seen >= MAX_BOXES

    def _count(self, points: SortedPoints, boxes: BoxArray) -> None:
        """Count the points in each box under each convention."""
        valid = is_valid_box(boxes.boxes)
        n = int(valid.sum())
        kept = BoxArray(0, '', ('',) * n, ('',) * n, np.ones(n), boxes.boxes[valid])
        raw = self._convention.from_centers(kept)
        candidates = [kept.boxes, *(other.to_centers(raw).boxes for other in self._others)]
        for rows in np.stack(candidates, axis=1):  # (boxes, conventions, 9)
            if self._is_over:
                break
            self._seen += 1
            center = rows[0, BOX_CENTER]
            reach = 1.5 * float(np.linalg.norm(rows[0, BOX_EXTENT]))
            counts = _inside(points.around(center, reach) + center, rows)
            if counts.max() >= MIN_POINTS_OF_POSE:
                self._counts.append(counts)

    def _result(self) -> str:
        """Return the finding from the counts; the first convention is the present one."""
        counts = np.array(self._counts, dtype=float)  # (boxes, conventions)
        shares = counts / counts.max(axis=1, keepdims=True)
        own, others = shares[:, 0], shares[:, 1:]
        totals = others.sum(axis=0)
        # Of equal conventions the first: they are ordered by how common they are.
        best = int((totals >= EQUIVALENT_SHARE * totals.max()).argmax())
        is_better = others[:, best] > own
        if others[:, best].sum() < MIN_GAIN * own.sum() or is_better.mean() < MIN_AGREEMENT:
            return ''
        return self._text(self._others[best], float(own.mean()))

    def _text(self, other: Convention, share: float) -> str:
        """Return the finding that the `other` convention is the right one."""
        name, how = 'size_order', 'do not fit'
        if other.pose_reference != self._convention.pose_reference:
            name = 'pose_reference'
            # Offset of the present boxes from their points, in parts of the extents.
            off = other.reference - self._convention.reference
            how = ' and '.join(
                f'{"hover" if axis == "height" and part > 0 else "stand"} {abs(part):g} {axis}s '
                f'{ways[int(part > 0)]}'
                for part, (axis, *ways) in zip(off, DIRECTIONS, strict=True)
                if part
            )
        wanted = getattr(other, name)
        instead = ''
        if name == 'size_order' and wanted[:2] in ('wl', 'lw'):
            # Points distinguish length from width, but not which axis points forward.
            sideways = 'x+ or x-' if self._convention.forward_axis[0] == 'y' else 'y+ or y-'
            instead = f', or forward_axis:={sideways} if it is that axis which points forward'
        return (
            f'boxes {how} their points, of which they contain {share:.0%}: expected {name} '
            f'{wanted!r}, got {getattr(self._convention, name)!r}; set {name}:={wanted}{instead} '
            f'(boxreg relabel: --{name.replace("_", "-")} {wanted})'
        )


def _inside(points: NDArray[np.floating], boxes: Floats) -> Ints:
    """Count the points in each of n boxes, a margin around it included, (n,)."""
    R = matrix_from_rpy(boxes[:, ROLL:])
    local = (points - boxes[:, None, BOX_CENTER]) @ R  # (n, points, 3)
    limit = boxes[:, None, BOX_EXTENT] / 2 + POINT_MARGIN
    counts: Ints = (np.abs(local) <= limit).all(axis=2).sum(axis=1)
    return counts
