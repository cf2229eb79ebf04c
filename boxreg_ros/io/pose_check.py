"""Whether poses and sizes of a box topic mean what they are taken for: the points know."""

from __future__ import annotations

from dataclasses import replace

from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import (
    BoxArray,
    Floats,
    HEIGHT,
    is_valid_box,
    LENGTH,
    ROLL,
    Sweep,
    X,
    Z,
)
from msg_adapters.convention import Convention, REFERENCES, SIZE_ORDERS
import numpy as np
from numpy.typing import NDArray

ENOUGH = 12
"""So many boxes with points decide."""
PATIENCE = 300
"""After so many boxes the check is over, decided or not."""
MIN_POINTS = 10
MARGIN = 0.1
"""Points this far outside a box are still its own [m]."""
NEARLY = 0.85
"""A convention that holds this part of the most is as good."""
GAIN = 1.3
"""Another convention has to hold this many times the points ..."""
AGREEMENT = 0.7
"""... and more points in this part of the boxes, to be believed."""
WAYS = (
    ('length', 'behind', 'before'),
    ('width', 'right of', 'left of'),
    ('height', 'below', 'above'),
)


class PoseCheck:
    """
    Compare the first boxes with their points under every convention there is.

    All conventions give boxes of one volume about the same pose, so the one that is meant holds
    most points. Sweeps and boxes come in any order, in one frame and under the convention they
    are taken for.

    Parameters
    ----------
    convention : Convention
        The one they are taken for.
    tolerance : float
        Stamps further apart do not belong together [s].

    Attributes
    ----------
    finding : str
        What is wrong and which setting mends it; empty while nothing is known to be.

    """

    def __init__(self, convention: Convention, tolerance: float) -> None:
        self._convention = convention
        self._tolerance_ns = round(tolerance * 1e9)
        self._others = [
            *(replace(convention, pose_reference=name) for name in REFERENCES),
            *(replace(convention, size_order=order) for order in SIZE_ORDERS),
        ]
        self._counts: list[list[int]] = []
        self._sweep: Sweep | None = None
        self._boxes: BoxArray | None = None
        self._seen = 0
        self.finding = ''

    def add(self, item: Sweep | BoxArray) -> None:
        """Take a sweep or boxes, as they come."""
        if self._is_over:
            return
        if isinstance(item, Sweep):
            self._sweep = item
        else:
            self._boxes = item
        if self._sweep is None or self._boxes is None:
            return
        if abs(self._sweep.stamp_ns - self._boxes.stamp_ns) <= self._tolerance_ns:
            self._count(self._sweep.points, self._boxes)
            self._sweep = self._boxes = None
            if len(self._counts) >= ENOUGH:
                self.finding = self._verdict()

    @property
    def _is_over(self) -> bool:
        return len(self._counts) >= ENOUGH or self._seen >= PATIENCE

    def _count(self, points: NDArray[np.floating], boxes: BoxArray) -> None:
        """Count the points in each box under each convention."""
        valid = is_valid_box(boxes.boxes)
        n = int(valid.sum())
        kept = BoxArray(0, '', ('',) * n, ('',) * n, np.ones(n), boxes.boxes[valid])
        raw = self._convention.from_centers(kept)
        candidates = [kept.boxes, *(other.to_centers(raw).boxes for other in self._others)]
        for rows in zip(*candidates, strict=True):
            if self._is_over:
                break
            self._seen += 1
            reach = 1.5 * np.linalg.norm(rows[0][LENGTH : HEIGHT + 1])
            near = points[(np.abs(points - rows[0][X : Z + 1]) < reach).all(axis=1)]
            counts = [_inside(near, box) for box in rows]
            if max(counts) >= MIN_POINTS:
                self._counts.append(counts)

    def _verdict(self) -> str:
        """Return what is wrong, from the counts (boxes, conventions); the first is the own."""
        counts = np.array(self._counts, dtype=float)
        shares = counts / counts.max(axis=1, keepdims=True)
        own, others = shares[:, 0], shares[:, 1:]
        totals = others.sum(axis=0)
        # Of those that hold about as many, the first, which are the common ones.
        best = int((totals >= NEARLY * totals.max()).argmax())
        is_better = others[:, best] > own
        if others[:, best].sum() < GAIN * own.sum() or is_better.mean() < AGREEMENT:
            return ''
        return self._text(self._others[best], float(own.mean()))

    def _text(self, other: Convention, share: float) -> str:
        """Return what is wrong, and the setting that makes it the `other` convention."""
        name, how = 'size_order', 'do not fit'
        if other.pose_reference != self._convention.pose_reference:
            name = 'pose_reference'
            off = other.reference - self._convention.reference  # the boxes from where they are
            how = ' and '.join(
                f'{"hover" if axis == "height" and part > 0 else "stand"} {abs(part):g} {axis}s '
                f'{ways[int(part > 0)]}'
                for part, (axis, *ways) in zip(off, WAYS, strict=True)
                if part
            )
        wanted = getattr(other, name)
        instead = ''
        if name == 'size_order' and wanted[:2] in ('wl', 'lw'):
            # The points of a box tell its length from its width, but not what is forward.
            sideways = 'x+ or x-' if self._convention.forward_axis[0] == 'y' else 'y+ or y-'
            instead = f', or forward_axis:={sideways} if it is that axis which points forward'
        return (
            f'boxes {how} their points, of which they hold {share:.0%}: expected {name} '
            f'{wanted!r}, got {getattr(self._convention, name)!r}; set {name}:={wanted}{instead} '
            f'(boxreg relabel: --{name.replace("_", "-")} {wanted})'
        )


def _inside(points: NDArray[np.floating], box: Floats) -> int:
    """Count the points in a box, a margin around it included."""
    R = matrix_from_rpy(box[ROLL:])
    local = (points - box[X : Z + 1]) @ R
    return int((np.abs(local) <= box[LENGTH : HEIGHT + 1] / 2 + MARGIN).all(axis=1).sum())
