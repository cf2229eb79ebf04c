"""
The risk of a box or a track: the error to expect, from evidence other than how far it moved.

Risks are metres along the heading of a car: the shift of a box `REFERENCE_LENGTH` long that costs
as much 3D IoU as the errors to expect. So boxes of all sizes and errors of all kinds compare.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import erf
from typing import Any, NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.id_switches import SWITCH_SPEED
from boxreg_ros.core.observation import MARGIN
from boxreg_ros.core.tables import rows_by_key
from boxreg_ros.review.changes import TrackChanges
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import (
    ADDED,
    BOX_EXTENT,
    Floats,
    KEPT,
    LENGTH,
    ROLL,
    WIDTH,
    X,
    Y,
    YAW,
    Z,
)
import numpy as np

REFERENCE_LENGTH = 4.5
"""Length of the car whose shift a risk is [m]. Chosen: a mid-size car."""
MEAN_OF_NORMAL = np.sqrt(2 / np.pi)
"""Mean magnitude of a normal variable over its deviation. Derived."""
ONE_OF_PAIR = np.sqrt(0.5)
"""Expected error of two opposite faces if only one of them errs, over that of two that err alike.
Derived: of the same sum of variances, one has twice the variance, so sqrt(2) / 2 the magnitude."""
MAX_LOSS = 1.0
"""Largest loss of 3D IoU."""
KEPT_LOSS = 0.25
"""Loss to expect of an input box that is kept: 1 - 3D IoU of the inputs of docs/results.md."""
USUAL_OUTSIDE = 0.1
"""Part of the points in and near a box that are of other things, where too few tracks are known
to measure it. Chosen."""
USUAL_FILL = 0.34
"""Part of its volume with that margin that a car fills; smaller objects fill less. Derived."""
SWITCH_LOSS = 0.5
"""Loss to expect where the id of a track has switched: half its boxes are of another object."""
MIN_COMPARED = 8
"""Fewest tracks of a class, and fewest of a recording, that show what is usual. Chosen: quartiles
of fewer are the values of single tracks."""
MAX_DEVIATIONS = 2.0
"""Extents within this many deviations of their class are usual: 95 % of a normal variable."""
SIZE_SPREAD = (0.11, 0.06, 0.09)
"""
Least relative deviation of length, width and height among the objects of a class.

Literature: cars of KITTI are 3.88 +- 0.43, 1.63 +- 0.10 and 1.53 +- 0.14 m. The quartiles of a few
tracks may be closer by chance.

"""
QUARTILES_TO_DEVIATION = 0.74
"""Standard deviation over interquartile range of a normal variable. Derived: 1 / 1.349."""
FACE_PAIRS = ('ends', 'sides', 'top and bottom')
"""Names of the faces across each axis of a box."""
MIN_SHOWN = 0.01
"""Smaller parts of a risk are no reason [m]; chosen: two decimals are shown."""
FEW_POINTS = 10
"""Boxes with fewer points are reported as such, and weigh less than others. Chosen."""
OUTER_PART = 0.1
"""Part of the points near a face that are its outermost points; chosen."""
NEAR_FACE = 0.5
"""Points so far inside of a face count as near it [m]; chosen."""
FLOOR_CLEARANCE = 0.3
"""Points up to so far above the lower face may be of the road [m]; chosen: `GROUND_CLEARANCE`, and
0.1 m that a box may be too high."""
MIN_FACE_POINTS = 5
"""Fewer points do not show where a face is; chosen."""

DEFAULTS = Config()
"""Settings of the classes. One object: to check its values takes 0.3 ms."""


class Risk(NamedTuple):
    """The risk of the boxes of one track."""

    boxes: Floats
    """(n,), of each box [m]."""
    means: Mapping[str, float]
    """Of `parts_of` its boxes, by their reason in words [m]."""

    @property
    def track(self) -> float:
        """Return the risk of the track: the mean over its boxes [m]."""
        return float(self.boxes.mean()) if len(self.boxes) else 0.0


class Usual(NamedTuple):
    """What is usual among the tracks of a recording."""

    outside: float = USUAL_OUTSIDE
    """Part of the points in and near a box that are outside of it."""
    sizes: Mapping[str, Floats] = {}
    """(2, 3) by class: median and deviation of the logarithms of length, width and height."""

    @classmethod
    def of(cls, tracks: Sequence[TrackChanges]) -> Usual:
        """Return what is usual; classes of fewer than `MIN_COMPARED` tracks have no sizes."""
        counts = np.array([track.near_points.sum(axis=0) for track in tracks]).reshape(-1, 2)
        counts = counts[counts.sum(axis=1) > 0]
        outside = counts[:, 1] / counts.sum(axis=1)
        usual = float(np.median(outside)) if len(outside) >= MIN_COMPARED else USUAL_OUTSIDE
        logs = np.array([np.log(_extents(track)).mean(axis=0) for track in tracks]).reshape(-1, 3)
        by_class = rows_by_key([track.class_name for track in tracks])
        sizes = {
            name: _median_and_deviation(logs[rows])
            for name, rows in by_class.items()
            if len(rows) >= MIN_COMPARED
        }
        return cls(usual, sizes)


UNKNOWN_USUAL = Usual()


def assess(track: TrackChanges, usual: Usual = UNKNOWN_USUAL) -> Risk:
    """Return the risk of each box of a track among tracks of which `usual` is known."""
    parts = parts_of(track, usual)
    total = np.sum([*parts.values()], axis=0)
    means = {reason: float(part.mean()) for reason, part in parts.items()}
    return Risk(total.clip(max=MAX_LOSS * REFERENCE_LENGTH / 2), means)


def parts_of(track: TrackChanges, usual: Usual = UNKNOWN_USUAL) -> dict[str, Floats]:
    """
    Return the parts of the risk of each box of a track, (n,) by their reason in words [m].

    A face that is off by d costs d / L of 3D IoU, L the extent across it; a turn by a costs
    a l / (2 w). The error of a face is normal. Its deviation is that of the centre and half the
    extent, nearly all of it at the unseen face of a pair. Its mean is how far the face is off its
    points, beyond what surfaces of its kind are off a rigid box; they are expected by the
    labelling margins of other tracks. Its mean magnitude is that of a folded normal variable. What
    its mean adds to its deviation is a reason of its own. So are points left outside, and a
    disagreement between two estimates, beyond the loss that these explain. There is no input to
    judge an added box by: it has the mean risk of the other boxes of its track.

    """
    extents = _extents(track)
    length, width, _ = extents.T
    deviations = np.nan_to_num(track.deviations)
    face = np.hypot(deviations[:, :3], np.nan_to_num(track.extent_deviations) / 2)
    face_pairs = np.repeat(face, 2, axis=1)
    across = np.repeat(extents, 2, axis=1)
    uncertain = MEAN_OF_NORMAL * face_pairs / across
    shape = DEFAULTS.class_config(track.class_name).shape
    off = (np.abs(track.face_distances) - shape).clip(0)
    misfit = _folded_mean(off, face_pairs) / across
    turn = deviations[:, 3] * length / (2 * width)
    is_refined = track.is_refined
    losses = {'uncertain heading': MEAN_OF_NORMAL * turn}
    for axis, faces in enumerate(FACE_PAIRS):
        pair = slice(2 * axis, 2 * axis + 2)
        losses[f'uncertain {faces}'] = ONE_OF_PAIR * uncertain[:, pair].sum(axis=1)
        losses[f'{faces} off their points'] = (misfit - uncertain)[:, pair].sum(axis=1)
    expected = np.sum([losses[reason] for reason in losses if 'uncertain' in reason], axis=0)
    explained = np.sum(list(losses.values()), axis=0)
    left_outside = _left_outside(track, extents, usual.outside)
    losses['points left outside'] = (left_outside - explained).clip(0)
    losses['estimates disagree'] = (track.disagreement - expected).clip(0)
    losses = {reason: np.where(is_refined, loss, 0.0) for reason, loss in losses.items()}
    is_kept = track.status == KEPT
    losses['kept as in the input'] = np.where(is_kept, KEPT_LOSS, 0.0)
    losses['size unlike its class'] = _unlike(track, extents, usual)
    losses['id switch'] = np.full(len(is_kept), SWITCH_LOSS * _has_id_switch(track))
    parts = np.nan_to_num(_with_added(np.array([*losses.values()]), track)) * REFERENCE_LENGTH / 2
    return dict(zip(losses, parts, strict=True))


def typical_parts(risks: Sequence[Risk]) -> dict[str, float]:
    """Return the median of each part over the tracks [m]; none for fewer than `MIN_COMPARED`."""
    if len(risks) < MIN_COMPARED:
        return {}
    return {
        reason: float(np.median([risk.means[reason] for risk in risks]))
        for reason in risks[0].means
    }


def reasons_of(track: TrackChanges, risk: Risk, typical: Mapping[str, float]) -> str:
    """
    Return why a track has its risk, in words.

    First the part that exceeds the `typical` one of the recording most: what all tracks have in
    common is no reason to open this one.

    """
    values = {reason: value for reason, value in risk.means.items() if value >= MIN_SHOWN}
    largest = sorted(values, key=lambda reason: typical.get(reason, 0.0) - values[reason])
    words = [f'{name} ({values[name]:.2f} m)' for name in largest[:3]]
    points = float(np.median(track.num_points))
    if points < FEW_POINTS:
        words.append(f'few points ({points:.0f} per box)')
    kept = Counter(filter(None, track.reasons.tolist()))
    words += [f'{count} kept: {name}' for name, count in kept.most_common(2)]
    return '; '.join(words)


def risks_of_box(
    part: Mapping[str, Any], row: int, box: Floats, class_name: str, points: Floats
) -> tuple[float, float]:
    """
    Return the risk of a box of a report as it is and as another box would have it.

    What follows from the points changes by what the points of the report show: where the outermost
    ones are from each face, and how many of them are outside. The deviations stay.

    Parameters
    ----------
    part : mapping
        The track, as of `TrackPart.part`.
    row : int
        Of the box in the track.
    box : array, shape (9,)
        The other box, relative to the origin of the part [m, rad].
    class_name : str
        Of the track.
    points : array, shape (M, 3)
        Near the box, relative to the same origin [m].

    Returns
    -------
    before, after : float
        Risks of the box of the report and of `box` [m].

    """
    outside, sizes = part['usual']
    usual = Usual(outside, {} if sizes is None else {class_name: np.array(sizes)})
    before = _changes_of(part, class_name)
    old, new = (evidence(points, one) for one in (before.boxes[row], box))
    boxes, faces = before.boxes.copy(), before.face_distances.copy()
    near = before.near_points.copy()
    boxes[row] = box
    faces[row] += np.nan_to_num(new[0] - old[0])
    total = near[row].sum()
    share = near[row, 1] / max(1, total) + new[1] - old[1]
    near[row, 1] = round(total * float(np.clip(share, 0, 1)))
    near[row, 0] = total - near[row, 1]
    after = replace(before, boxes=boxes, face_distances=faces, near_points=near)
    first, second = (float(assess(track, usual).boxes[row]) for track in (before, after))
    return first, second


def evidence(points: Floats, box: Floats) -> tuple[Floats, float]:
    """
    Return what points show about the faces of a box; those near the road are left out.

    Parameters
    ----------
    points : array, shape (M, 3)
        Near the box [m].
    box : array, shape (9,)
        In the same frame [m, rad].

    Returns
    -------
    distances : array, shape (6,)
        Mean distance of the outermost points from the faces at front, rear, left, right, top and
        bottom [m], positive outside; NaN with too few points near a face.
    outside : float
        Part of the points in and near the box that are outside of it; 0 without points.

    """
    local = (points - box[: Z + 1]) @ matrix_from_rpy(box[None, ROLL:])[0]
    half = box[BOX_EXTENT] / 2
    is_above_road = local[:, 2] > FLOOR_CLEARANCE - half[2]
    is_near = (np.abs(local) < half + MARGIN).all(1) & is_above_road
    is_inside = (np.abs(local) < half).all(1)
    distances = np.full(6, np.nan)
    for face in range(6):
        axis, sign = face // 2, 1 - 2 * (face % 2)
        ahead = sign * local[is_near, axis] - half[axis]
        ahead = np.sort(ahead[ahead > -NEAR_FACE])
        if len(ahead) >= MIN_FACE_POINTS:
            distances[face] = ahead[-int(np.ceil(OUTER_PART * len(ahead))) :].mean()
    count = int(is_near.sum())
    return distances, float((is_near & ~is_inside).sum() / count) if count else 0.0


def _changes_of(part: Mapping[str, Any], class_name: str) -> TrackChanges:
    """Return the track of a part, as far as its risk depends on it."""
    n = len(part['stamps'])

    def column(name: str, *shape: int) -> Floats:
        return np.array(part[name], np.float64).reshape(n, *shape)

    return TrackChanges(
        track_id='',
        class_name=class_name,
        input_ids=('',) * n,
        stamps_ns=np.array(part['stamps'], np.int64),
        given=column('given', 9),
        boxes=column('boxes', 9),
        change=column('change', 4),
        deviations=column('deviations', 4),
        extent_deviations=column('extent_deviations', 3),
        face_distances=column('faces', 6),
        near_points=column('near', 2),
        disagreement=column('disagreement'),
        is_flipped=np.array(part['flipped'], bool),
        status=np.array(part['status']),
        reasons=np.array(part['reasons']),
        num_points=np.array(part['num_points'], np.int64),
    )


def _with_added(losses: Floats, track: TrackChanges) -> Floats:
    """Return `losses` (k, n) with the means of the others for boxes that the input lacks."""
    is_added = np.isin(track.status, ADDED)
    if is_added.all() or not is_added.any():
        return losses
    known = np.compress(~is_added, losses, axis=1)
    return np.where(is_added, known.mean(axis=1, keepdims=True), losses)


def _extents(track: TrackChanges) -> Floats:
    """Return length, width and height of each box, 1 m where unknown, shape (n, 3)."""
    return np.nan_to_num(track.boxes[:, BOX_EXTENT], nan=1.0)


def _median_and_deviation(logs: Floats) -> Floats:
    """Return median and robust deviation of the columns of `logs` (n, 3), shape (2, 3)."""
    low, median, high = np.quantile(logs, (0.25, 0.5, 0.75), axis=0)
    deviation = (QUARTILES_TO_DEVIATION * (high - low)).clip(min=SIZE_SPREAD)
    return np.array([median, deviation])


_erf = np.vectorize(erf, otypes=[float])
"""Of few values: that of SciPy takes a third of a second to import."""


def _folded_mean(mean: Floats, deviation: Floats) -> Floats:
    """Return the mean magnitude of normal variables."""
    deviation = deviation.clip(min=1e-9)
    ratio = mean / deviation
    of_noise = MEAN_OF_NORMAL * deviation * np.exp(-(ratio**2) / 2)
    of_mean = np.zeros(mean.shape)
    is_off = mean > 0
    of_mean[is_off] = mean[is_off] * _erf(ratio[is_off] / np.sqrt(2))
    return np.asarray(of_noise + of_mean)


def _left_outside(track: TrackChanges, extents: Floats, usual: float) -> Floats:
    """
    Return the loss of 3D IoU that points outside of each box are evidence for, shape (n,).

    Of a box off its object, the part of the points that is outside is about the loss. The space
    around a small object has more room for points of others: they count less. Few points near a
    box are little evidence: their part is shrunk toward that of the track, which is shrunk toward
    the `usual` one. So a box that is off an object with few points is found by all its boxes.

    """
    outside, total = track.near_points[:, 1], track.near_points.sum(axis=1)
    of_track = (outside.sum() + FEW_POINTS * usual) / (total.sum() + FEW_POINTS)
    part = (outside + FEW_POINTS * of_track) / (total + FEW_POINTS)
    excess = (part - usual).clip(0)
    fill = (extents / (extents + 2 * MARGIN)).prod(axis=1) / USUAL_FILL
    shift = excess * fill.clip(max=1.0)
    return np.asarray(2 * shift / (1 + shift))


def _unlike(track: TrackChanges, extents: Floats, usual: Usual) -> Floats:
    """
    Return the loss of 3D IoU if extents unlike those of their class are wrong, shape (n,).

    What they are beyond `MAX_DEVIATIONS` of the class. An extent that is e too large or too small
    costs e / L.

    """
    if track.class_name not in usual.sizes:
        return np.zeros(len(extents))
    median, deviation = usual.sizes[track.class_name]
    excess = np.abs(np.log(extents) - median) - MAX_DEVIATIONS * deviation
    return np.asarray(1 - np.exp(-excess.clip(0).sum(axis=1)))


def _has_id_switch(track: TrackChanges) -> bool:
    """Return whether boxes jump by over half their length or width off constant velocity."""
    is_known = np.isfinite(track.boxes[:, X])
    boxes = track.boxes[is_known]
    seconds = np.diff(track.stamps_ns[is_known]) * 1e-9
    if len(seconds) < 2 or (seconds <= 0).any():
        return False
    velocity = np.diff(boxes[:, [X, Y]], axis=0) / seconds[:, None]
    jump = np.diff(velocity, axis=0) * seconds[1:, None]
    yaw = boxes[1:-1, YAW]
    along = jump[:, 0] * np.cos(yaw) + jump[:, 1] * np.sin(yaw)
    across = jump[:, 1] * np.cos(yaw) - jump[:, 0] * np.sin(yaw)
    gate = boxes[1:-1, [LENGTH, WIDTH]] / 2 + SWITCH_SPEED * seconds[1:, None]
    return bool((np.abs(np.column_stack([along, across])) > gate).any())
