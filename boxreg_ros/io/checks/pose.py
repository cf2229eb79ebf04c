"""Check of the convention of box poses and sizes against the points."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from boxreg_ros.core.matching import AT_ONCE
from boxreg_ros.io.checks.finding import advice, advice_for_some, listed
from boxreg_ros.io.checks.size import (
    counts_of,
    ENLARGED,
    POINT_MARGIN,
    SizeCounts,
    SizeEvidence,
)
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
MANY_BOXES = 100
"""
Boxes that decide once more, by `MIN_AGREEMENT_OF_MANY`; chosen.

Of 12 boxes at the rears of their objects, 0.56 to 0.8 have more points before them.

"""
MAX_BOXES = 300
"""After this number of boxes, with points or without, the check ends."""
MIN_POINTS_OF_POSE = 10
"""Points that the best convention must have in a box for the box to be counted."""
EQUIVALENT_SHARE = 0.85
"""A convention with this share of the points of the best one counts as equal to it."""
MIN_GAIN = 1.3
"""Factor by which another convention must exceed the points of the present one."""
MIN_AGREEMENT = 0.7
"""Share of the boxes, equal for each object, in which the other one must have more points."""
MIN_AGREEMENT_OF_MANY = 0.6
"""The same of `MANY_BOXES`; chosen: 0.65 to 0.83 of boxes at the rears, 0.4 of right ones."""
MAX_CLASSES = 100
"""Classes that are looked at one by one; chosen: above all data sets, below one for each box."""
MIN_OBJECTS = 4
"""
Objects that a finding about a reference before, behind or beside the present one needs.

Chosen: of one to three objects one in ten has more points before or behind its boxes, such as
those of a neighbour.

"""
MOVING = 1.0
"""Way of an object that moves [m]; chosen: beyond the errors of a detector."""
DIRECTIONS = (
    ('length', 'behind', 'before'),
    ('width', 'right of', 'left of'),
    ('height', 'below', 'above'),
)


class PairedCheck:
    """A check of the first boxes and the sweeps of their stamps, which arrive in any order."""

    def __init__(self) -> None:
        self._sweep: Sweep | None = None
        self._boxes: BoxArray | None = None

    def _paired(self, item: Sweep | BoxArray) -> tuple[NDArray[np.floating], BoxArray] | None:
        """Take the next sweep or boxes; return points by x, and boxes, if they are of one time."""
        if isinstance(item, Sweep):
            self._sweep = item
        else:
            self._boxes = item
        sweep, boxes = self._sweep, self._boxes
        if sweep is None or boxes is None:
            return None
        if abs(sweep.stamp_ns - boxes.stamp_ns) > AT_ONCE * 1e9:
            return None
        self._sweep = self._boxes = None
        columns = sweep.in_frame().points.T
        return columns.take(np.argsort(columns[0]), axis=1).T, boxes


@dataclass(slots=True)
class _Evidence:
    """Points in the first boxes of all classes, or of one, under each convention."""

    is_above: NDArray[np.bool_]  # which conventions move boxes up or down, at most
    moving: set[str]  # objects, of all classes
    counts: list[Ints] = field(default_factory=list)  # of each box; the present convention first
    objects: list[str] = field(default_factory=list)  # of each of them
    seen: int = 0
    sizes: SizeEvidence = field(default_factory=SizeEvidence)

    @property
    def is_enough(self) -> bool:
        """Return whether there are as many boxes as the result needs."""
        return len(self.counts) >= DECISIVE_BOXES

    @property
    def has_many(self) -> bool:
        """Return whether there are as many as decide once more."""
        return len(self.counts) >= MANY_BOXES

    @property
    def is_over(self) -> bool:
        """Return whether no more boxes are needed, or looked at."""
        return (self.has_many and self.sizes.is_enough) or self.seen >= MAX_BOXES

    def add(self, counts: Ints, sizes: SizeCounts | None, track_id: str) -> None:
        """Add the points in a box under each convention, and by its size."""
        self.seen += 1
        name = track_id or f'box {self.seen}'  # without ids of one each
        if counts.max() >= MIN_POINTS_OF_POSE and not self.has_many:
            self.counts.append(counts)
            self.objects.append(name)
        if sizes is not None:
            self.sizes.add(sizes, name)

    @property
    def is_shown(self) -> NDArray[np.bool_]:
        """Return which conventions the points of so many objects can show."""
        return self.is_above | (len(set(self.objects)) >= MIN_OBJECTS)

    @property
    def shares(self) -> Floats:
        """Return the points in each box under each convention, as shares of the most."""
        counts = np.array(self.counts, dtype=float)  # (boxes, conventions)
        return np.asarray(counts / counts.max(axis=1, keepdims=True))

    @property
    def weights(self) -> Floats:
        """Return the weights of the boxes: each object counts the same."""
        _, objects, boxes = np.unique(self.objects, return_inverse=True, return_counts=True)
        return np.asarray(1 / (len(boxes) * boxes[objects]))

    def best(self) -> int:
        """Return the index of the convention that fits better than the present one; 0 for none."""
        if not self.is_enough or self.sizes.differ:
            return 0  # boxes of another size contain more elsewhere, too
        totals = (self.weights @ self.shares)[1:]
        fits = self.is_shown[1:] & (totals >= EQUIVALENT_SHARE * totals.max())
        # Of equal conventions the first: they are ordered by how common they are.
        best = 1 + int(fits.argmax())
        if not (fits.any() and self.prefers(best, 0)):
            return 0
        still = self.still
        if self.is_above[best] or not still.is_shown[best] or still._exceeds(best, 0):
            return best
        return 0  # the boxes of those that move are late

    @property
    def still(self) -> _Evidence:
        """Return the evidence of the objects that do not move: late boxes of these are right."""
        rows = [row for row, name in enumerate(self.objects) if name not in self.moving]
        counts, objects = [self.counts[row] for row in rows], [self.objects[row] for row in rows]
        return replace(self, counts=counts, objects=objects)

    @property
    def scale(self) -> float:
        """Return the factor that mends the extents: 2 or 0.5, 1 if they fit; 0 if unknown."""
        if self.sizes.is_half:
            return 2.0
        if self.sizes.is_twice:
            return 0.5
        return float(self.is_enough and self.sizes.fits and not self.best())

    def prefers(self, one: int, other: int) -> bool:
        """Return whether boxes have clearly more points under one convention than another."""
        return self.is_enough and self._exceeds(one, other)

    def _exceeds(self, one: int, other: int) -> bool:
        """Return the same of any number of boxes."""
        if not self.is_shown[[one, other]].all():
            return False
        shares, weights = self.shares, self.weights
        totals = weights @ shares
        agreement = weights @ (shares[:, one] > shares[:, other])
        least = MIN_AGREEMENT_OF_MANY if self.has_many else MIN_AGREEMENT
        return bool(totals[one] >= MIN_GAIN * totals[other] and agreement >= least)


class PoseCheck(PairedCheck):
    """
    Compare the first boxes, of all classes and of each, with their points under every convention.

    All conventions give boxes of the same volume about the same pose, so the right one contains
    most points. Extents that are half or twice those of the objects are found apart. Sweeps and
    boxes arrive in any order, in one frame, at most `AT_ONCE` [s] apart.
    `finding` says which setting of the `convention` they were read with is wrong and its right
    value; `class_finding` which classes are wrong where others are right. They are empty if none
    is known to be wrong.

    """

    def __init__(self, convention: Convention) -> None:
        super().__init__()
        self._convention = convention
        self._conventions = [
            convention,
            *(replace(convention, pose_reference=name) for name in REFERENCES),
            *(replace(convention, size_order=order) for order in SIZE_ORDERS),
        ]
        scales = [convention.size_scale * factor for factor in (ENLARGED, 2.0)]
        self._larger = [replace(convention, size_scale=scale) for scale in scales]
        own = convention.reference[:2]
        self._is_above = np.array([(c.reference[:2] == own).all() for c in self._conventions])
        self._moving = set[str]()
        self._first: dict[str, Floats] = {}  # position of each object that is looked at, (3,)
        self._all = _Evidence(self._is_above, self._moving)
        self._decided = 0
        self._classes: dict[str, _Evidence] = {}
        self.finding = ''
        self.class_finding = ''

    def add(self, item: Sweep | BoxArray) -> None:
        """Add the next sweep or boxes."""
        if isinstance(item, BoxArray):
            self._follow(item)
            closed = {name for name in set(item.class_names) if self._is_over(name)}
            if closed.issuperset(item.class_names):
                return
            if closed:
                is_open = [name not in closed for name in item.class_names]
                item = item.take(np.flatnonzero(is_open))
        pair = self._paired(item)
        if pair is not None:
            self._count(*pair)
            evidence = self._all, *self._classes.values()
            decided = sum(
                one.is_enough + one.has_many + one.sizes.is_half + one.sizes.is_enough
                for one in evidence
            )
            if decided > self._decided:
                self._decided = decided
                self._judge()

    def _follow(self, boxes: BoxArray) -> None:
        """Find out which of the objects move; update the findings where another one does."""
        count = len(self._moving)
        for name, box in zip(boxes.track_ids, boxes.boxes, strict=True):
            first = self._first.get(name)
            if first is not None and np.linalg.norm(box[BOX_CENTER] - first) > MOVING:
                del self._first[name]
                self._moving.add(name)
        if len(self._moving) > count and (self.finding or self.class_finding):
            self._judge()

    def _is_over(self, class_name: str) -> bool:
        """Return whether boxes of a class are not looked at any more."""
        if not self._all.is_over:
            return False
        known = self._classes.get(class_name)
        return len(self._classes) >= MAX_CLASSES if known is None else known.is_over

    def _count(self, points: NDArray[np.floating], boxes: BoxArray) -> None:
        """Count the points in each box under each convention."""
        kept = boxes.take(np.flatnonzero(is_valid_box(boxes.boxes)))
        candidates: Floats | None = None
        for row, class_name in enumerate(kept.class_names):
            if self._is_over(class_name):
                continue
            center, extent = kept.boxes[row, BOX_CENTER], kept.boxes[row, BOX_EXTENT]
            away = points_around(points, center, 2.2 * float(np.linalg.norm(extent)))
            counts, sizes = np.zeros(len(self._conventions), dtype=int), None
            if len(away) >= MIN_POINTS_OF_POSE:
                candidates = self._candidates(kept) if candidates is None else candidates
                is_inside = _is_inside(away + center, candidates[row])
                counts = is_inside[: len(counts)].sum(axis=1)
                local = away @ matrix_from_rpy(kept.boxes[row, ROLL:])
                sizes = counts_of(is_inside, local, extent)
            if kept.track_ids[row] not in self._moving:
                self._first.setdefault(kept.track_ids[row], center)
            own = self._classes.setdefault(class_name, _Evidence(self._is_above, self._moving))
            for evidence in (self._all, own):
                if not evidence.is_over:
                    evidence.add(counts, sizes, kept.track_ids[row])

    def _candidates(self, boxes: BoxArray) -> Floats:
        """Return boxes read by each convention, and larger ones, (boxes, conventions + 2, 9)."""
        raw = self._convention.from_centers(boxes)
        candidates = *self._conventions, *self._larger
        return np.stack([c.to_centers(raw).boxes for c in candidates], axis=1)

    def _judge(self) -> None:
        """Update the findings."""
        best = self._all.best()
        of_classes: dict[int, list[str]] = {}
        for class_name, evidence in self._classes.items():
            of_classes.setdefault(evidence.best(), []).append(class_name)
        of_classes.pop(0, None)
        if best and not (best in of_classes and self._right(best)):
            of_classes = {best: []}
        of_all: list[str] = []
        of_some: list[str] = []
        for index, names in of_classes.items():
            right = self._right(index) if names else []
            texts = of_some if right else of_all
            texts.append(self._text(index, names, right))
        for scale in (2.0, 0.5):
            names = [name for name, one in self._classes.items() if one.scale == scale]
            right = [name for name, one in self._classes.items() if one.scale == 1]
            if names and not best:
                (of_some if right else of_all).append(self._size_text(scale, names, right))
        self.finding = ''.join(of_all[:1])
        self.class_finding = '; '.join(of_some)

    def _right(self, index: int) -> list[str]:
        """Return the classes that the present convention fits, and another one does not."""
        return [name for name, one in self._classes.items() if one.prefers(0, index)]

    def _text(self, index: int, names: list[str], right: list[str]) -> str:
        """Return that another convention fits: all classes, or `names` beside `right` ones."""
        own, other = self._convention, self._conventions[index]
        off = zip(other.reference - own.reference, DIRECTIONS, strict=True)
        steps = [(part, axis, ways) for part, (axis, *ways) in off if part]
        instead = ''
        if steps:
            name = 'pose_reference'
            how = ' and '.join(
                f'{"hover" if axis == "height" and part > 0 else "stand"} {abs(part):g} {axis}s '
                f'{ways[int(part > 0)]}'
                for part, axis, ways in steps
            )
            correction = f'move them by {" and ".join(f"{-p:g} {axis}s" for p, axis, _ in steps)}'
            if [axis for _, axis, _ in steps] == ['height']:
                instead = (
                    '; if all are off by the same metres, they are of another frame, as that of '
                    'the vehicle: name it by boxes_frame, its transform is needed'
                )
        else:
            name, how = 'size_order', 'do not fit'
            correction = f'put their sizes in the order {own.size_order}'
            if other.size_order[:2] in ('wl', 'lw'):
                # Points distinguish length from width, but not which axis points forward.
                sideways = 'x+ or x-' if own.forward_axis[0] == 'y' else 'y+ or y-'
                instead = f', or forward_axis:={sideways} if it is that axis which points forward'
                correction += ' (or turn them by 90 degrees, if yaw is wrong)'
        evidence = [self._classes[one] for one in names] or [self._all]
        share = float(np.concatenate([one.shares[:, 0] for one in evidence]).mean())
        whose = f'boxes of {listed(names)}' if names else 'boxes'
        seen = f'{whose} {how} their points, of which they contain {share:.0%}'
        expected, got = getattr(other, name), getattr(own, name)
        if right:
            return (
                f'{seen}, those of {listed(right)} fit theirs: expected {name} {got!r} of all '
                f'classes, got {expected!r} of these; {advice_for_some(correction)}'
            )
        advised = advice(name, expected)
        if not (self._is_above[index] or all(one.still.is_shown[index] for one in evidence)):
            advised = (
                'most of these objects move: their boxes may be late or early instead, which '
                f'boxreg relabel without options says; if it does not, {advised}'
            )
        return f'{seen}: expected {name} {expected!r}, got {got!r}; {advised}{instead}'

    def _size_text(self, scale: float, names: list[str], right: list[str]) -> str:
        """Return that boxes of classes are too small, or too large, beside `right` ones."""
        own = self._convention.size_scale
        expected = f'{own * scale:g}'
        how = 'half' if scale > 1 else 'twice'
        seen = f'boxes of {listed(names)} are about {how} as large as their objects'
        if right:
            return (
                f'{seen}, those of {listed(right)} fit theirs: expected size_scale {own:g} of '
                f'all classes, got {expected} of these; '
                f'{advice_for_some(f"multiply their extents by {scale:g}")}'
            )
        advised = advice('size_scale', expected)
        return f'{seen}: expected size_scale {expected}, got {own:g}; {advised}'


def points_around(points: NDArray[np.floating], center: Floats, reach: float) -> Floats:
    """Return those of points (N, 3) by x nearer than `reach` along each axis, from `center`."""
    x, y, z = center.tolist()  # Python floats: those of NumPy would make float64 of all float32
    begin, end = np.searchsorted(points[:, 0], np.array([x - reach, x + reach], points.dtype))
    near = points[begin:end]
    is_near = (np.abs(near[:, 1] - y) < reach) & (np.abs(near[:, 2] - z) < reach)
    found: Floats = near[is_near] - center
    return found


def _is_inside(points: NDArray[np.floating], boxes: Floats) -> NDArray[np.bool_]:
    """Return which points are in each of n boxes, a margin around it included, (n, points)."""
    axes = matrix_from_rpy(boxes[:, ROLL:]).transpose(2, 0, 1)  # (3, n, 3)
    offsets = (axes * boxes[:, BOX_CENTER]).sum(axis=2)
    limits = boxes[:, BOX_EXTENT].T / 2 + POINT_MARGIN  # (3, n)
    local = axes @ points.T - offsets[..., None]  # (3, n, points)
    return np.asarray((np.abs(local) <= limits[..., None]).all(axis=0))
