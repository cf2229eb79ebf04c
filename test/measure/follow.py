"""
`measure follow`: whole tracks from a few boxes of each object, against interpolation.

The boxes given are true ones with the error of a person. One box: the first with
`MIN_SEED_RETURNS`, and every later box counts; of another size, such as that of its class, the
corner nearest to the sensor stays. Two: the first and the last with so many, and keyframes: all
boxes from the first to the last that are given count, and these too. Turning objects are those of
the row above that turn by `TURN`. In `all boxes` the boxes of a person at every stamp are
registered.

"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.core.follow import follow
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.core.refine import refine
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.completion import points_above_road
from boxreg_ros.rotations import matrix_from_rpy, wrap_angle
from boxreg_ros.structures import BOX_EXTENT, BoxArray, Floats, Ints, ROLL, YAW
from measure import RECORDINGS
from measure.drives import Drive
import numpy as np
from scipy.interpolate import CubicSpline

MIN_SEED_RETURNS = 20
"""Points in the boxes that are given; as published for single-object tracking."""
MIN_COUNTED_RETURNS = 10
"""`found` is the part of the true boxes with so many points that got a box."""
HUMAN_POSITION, HUMAN_YAW, HUMAN_EXTENT = 0.03, np.radians(1.0), 0.03
"""Deviations of a box of a person: centre [m], yaw [rad] and extents [m]; measured on labels."""
KEYFRAMES = {'2 Hz': 0.5, '1 Hz': 1.0, 'every 3 s': 3.0}
"""Periods of keyframes [s]."""
ONE, ONE_OF_CLASS, TWO = 'one box', 'one of class size', 'two boxes'
OFF_SIZE = {'one 15 % larger': 1.15, 'one 15 % smaller': 0.85}
"""One box whose extents are those of the object by a factor."""
CASES = (ONE, ONE_OF_CLASS, *OFF_SIZE, TWO, *KEYFRAMES)
CLASS_SIZES = {
    'truck': np.array([8.0, 2.5, 3.2]),
    'bus': np.array([12.0, 2.9, 3.4]),
    'van': np.array([5.2, 2.0, 2.2]),
    'vehicle': np.array([4.5, 1.9, 1.6]),
    'cyclist': np.array([1.8, 0.7, 1.7]),
    'pedestrian': np.array([0.7, 0.7, 1.75]),
}
"""Sizes that tools give a new box, by class or kind: length, width, height [m]."""
TURN, DISTANCE_OF_TURN = np.radians(20.0), 5.0
"""Objects whose heading changes so much [rad] while they drive so far [m] turn."""
ARGUMENTS = {
    'data': RECORDINGS,
    '--seed': (0, 'of the errors'),
    '--exact': (False, 'give the true boxes, without the error of a person'),
}


@dataclass(frozen=True, slots=True)
class Given:
    """A track of N true boxes and the n of them that are given."""

    track_id: str
    class_name: str
    stamps_ns: Ints
    truth: Floats  # (N, 9) true boxes
    num_points: Ints  # (N,) points in them
    rows: Ints  # (n,) of those given
    boxes: Floats  # (n, 9) those given, with the error of a person
    counted: Ints  # (m,) rows that are scored

    @property
    def times(self) -> Floats:
        """Seconds from the first true box, (N,)."""
        return np.asarray((self.stamps_ns - self.stamps_ns[0]) * 1e-9, np.float64)


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Return the scores of each case on each recording."""
    report: dict[str, Any] = {}
    for folder in args.data:
        drive = Drive.read(folder)
        report[str(folder)] = rows = {}
        for case in CASES:
            given = list(_given(drive, case, args.seed, args.exact))
            rows.update(_scores(drive, case, given, args.seed))
    return report


def _given(drive: Drive, case: str, seed: int, is_exact: bool) -> Iterator[Given]:
    """Yield the tracks of a drive with what is given of each; those with nothing are left out."""
    truth = drive.truth
    rng = np.random.default_rng(seed)
    ids = np.array(truth.track_ids)
    counts = _num_points(drive, truth)
    for name in dict.fromkeys(truth.track_ids):
        rows = np.flatnonzero(ids == name)
        rows = rows[np.argsort(truth.stamps_ns[rows], kind='stable')]
        seen = np.flatnonzero(counts[rows] >= MIN_SEED_RETURNS)
        if case in KEYFRAMES:
            seconds = (truth.stamps_ns[rows] - truth.stamps_ns[rows[0]]) * 1e-9
            periods = np.floor(seconds / KEYFRAMES[case] + 0.01)
            chosen = np.unique(periods, return_index=True)[1]
        else:
            chosen = np.unique(seen[[0, -1]] if case == TWO and len(seen) else seen[:1])
        if not len(chosen):
            continue
        counted = np.arange(chosen[0], chosen[-1] + 1)
        if case in (ONE, ONE_OF_CLASS, *OFF_SIZE):
            counted = np.arange(chosen[0] + 1, len(rows))
        boxes = truth.boxes[rows[chosen]]
        if not is_exact:
            boxes = _of_a_person(boxes, rng)
        if case == ONE_OF_CLASS or case in OFF_SIZE:
            [sweep] = drive.sweeps_at(truth.stamps_ns[rows[chosen]])
            class_name = truth.class_names[rows[0]]
            size = CLASS_SIZES.get(class_name.lower(), CLASS_SIZES[Config().kind(class_name)])
            if case in OFF_SIZE:
                size = OFF_SIZE[case] * truth.boxes[rows[0], BOX_EXTENT]
            boxes = _of_size(boxes, size, sweep.origin)
        yield Given(
            name, truth.class_names[rows[0]], truth.stamps_ns[rows], truth.boxes[rows],
            counts[rows], chosen, boxes, counted,
        )  # fmt: skip


def _num_points(drive: Drive, truth: BoxTable) -> Ints:
    """Return the points in each true box, above the road."""
    counts = np.zeros(len(truth.boxes), np.int64)
    for stamp_ns in np.unique(truth.stamps_ns):
        rows = np.flatnonzero(truth.stamps_ns == stamp_ns)
        [sweep] = drive.sweeps_at(np.array([stamp_ns]))
        counts[rows] = points_above_road(sweep, truth.boxes[rows])
    return counts


def _of_a_person(boxes: Floats, rng: np.random.Generator) -> Floats:
    """Return boxes (n, 9) with the error of a person."""
    noisy = boxes.copy()
    shifts = rng.normal(0.0, HUMAN_POSITION, (len(boxes), 3, 1))
    noisy[:, :3] += (matrix_from_rpy(boxes[:, ROLL:]) @ shifts)[..., 0]
    noisy[:, YAW] += rng.normal(0.0, HUMAN_YAW, len(boxes))
    noisy[:, BOX_EXTENT] += rng.normal(0.0, HUMAN_EXTENT, (len(boxes), 3))
    return noisy


def _of_size(boxes: Floats, size: Floats, origin: Floats) -> Floats:
    """Return boxes (n, 9) of another size; the lower corner nearest to the sensor stays."""
    found = boxes.copy()
    for box in found:
        R = matrix_from_rpy(box[ROLL:])
        corner = np.sign((origin - box[:3]) @ R) * [1, 1, 0] - [0, 0, 1]
        box[:3] += R @ (corner * (box[BOX_EXTENT] - size) / 2)
        box[BOX_EXTENT] = size
    return found


Scores = dict[str, dict[str, float]]


def _scores(drive: Drive, case: str, given: list[Given], seed: int) -> dict[str, Scores]:
    """Return the scores of each method, by the name of the objects that count."""
    methods = {'constant velocity': _constant_velocity}
    if case in (TWO, *KEYFRAMES):
        methods = {'linear': _linear, 'spline': _spline}
    found = {
        name: {one.track_id: method(one) for one in given} for name, method in methods.items()
    }
    if case in KEYFRAMES:
        found['all boxes'] = _registered(drive, given, seed)
    found['follow'] = _followed(drive, given)
    groups = {case: given}
    if case in KEYFRAMES:
        groups[f'{case}, turning'] = [one for one in given if _turns(one)]
    return {
        title: {name: _score(group, boxes) for name, boxes in found.items()}
        for title, group in groups.items()
        if group
    }


def _turns(one: Given) -> bool:
    """Return whether an object turns while it drives."""
    yaw = np.unwrap(one.truth[:, YAW])
    travel = np.linalg.norm(np.ptp(one.truth[:, :2], axis=0))
    return bool(np.ptp(yaw) > TURN and travel > DISTANCE_OF_TURN)


def _registered(drive: Drive, given: list[Given], seed: int) -> dict[str, Floats]:
    """Return the boxes (N, 9) of a person at every stamp, registered as those of a detector."""
    rng = np.random.default_rng(seed)
    boxes: list[BoxArray] = []
    for one in given:
        boxes += _arrays(one, one.stamps_ns, _of_a_person(one.truth, rng))
    tracks = replace(drive, boxes=tuple(boxes)).tracks()
    return {track.track_id: track.boxes for track in refine(tracks)}


def _score(given: list[Given], found: Mapping[str, Floats]) -> dict[str, float]:
    """Return the scores of boxes (N, 9) of each track, NaN where there is none."""
    boxes = np.concatenate([found[one.track_id][one.counted] for one in given])
    truth = np.concatenate([one.truth[one.counted] for one in given])
    counts = np.concatenate([one.num_points[one.counted] for one in given])
    iou = iou_3d(boxes, truth)
    is_found = np.isfinite(boxes).all(1)
    is_counted = counts >= MIN_COUNTED_RETURNS
    return {
        'true': len(truth),
        'found': float(is_found[is_counted].mean()) if is_counted.any() else np.nan,
        'above_half': float((iou[is_found] > 0.5).mean()) if is_found.any() else np.nan,
        'iou_found': float(iou[is_found].mean()) if is_found.any() else np.nan,
        'iou_all': float(iou.mean()) if len(iou) else np.nan,
    }


def _constant_velocity(one: Given) -> Floats:
    """Return the given box moved on by the velocity of the next true box."""
    row = int(one.rows[0])
    after = min(row + 1, len(one.truth) - 1)
    seconds = one.times[after] - one.times[row]
    velocity = (one.truth[after, :3] - one.truth[row, :3]) / (seconds or 1.0)
    boxes = np.repeat(one.boxes[:1], len(one.truth), axis=0)
    boxes[:, :3] += (one.times - one.times[row])[:, None] * velocity
    return boxes


def _linear(one: Given) -> Floats:
    at = one.times[one.rows]
    return np.stack([np.interp(one.times, at, column) for column in _unwrapped(one).T], axis=1)


def _spline(one: Given) -> Floats:
    if len(one.rows) < 3:
        return _linear(one)
    boxes: Floats = CubicSpline(one.times[one.rows], _unwrapped(one))(one.times)
    boxes[:, BOX_EXTENT] = _linear(one)[:, BOX_EXTENT]
    boxes[:, ROLL:] = wrap_angle(boxes[:, ROLL:])
    return boxes


def _unwrapped(one: Given) -> Floats:
    boxes = one.boxes.copy()
    boxes[:, ROLL:] = np.unwrap(boxes[:, ROLL:], axis=0)
    return boxes


def _arrays(one: Given, stamps_ns: Ints, boxes: Floats) -> Iterator[BoxArray]:
    """Yield boxes (n, 9) of a track, one array each."""
    for stamp_ns, box in zip(stamps_ns.tolist(), boxes, strict=True):
        yield BoxArray(stamp_ns, '', (one.track_id,), (one.class_name,), np.ones(1), box[None])


def _followed(drive: Drive, given: list[Given]) -> dict[str, Floats]:
    """Return the boxes (N, 9) of `follow` at the stamps of each track, NaN where it ended."""
    seeds = [array for one in given for array in _arrays(one, one.stamps_ns[one.rows], one.boxes)]
    stamps = np.array([sweep.stamp_ns for sweep in drive.sweeps], np.int64)
    points = [sweep.in_frame().points for sweep in drive.sweeps]
    origins = np.array([sweep.origin for sweep in drive.sweeps])
    tracks = {t.track_id: t for t in follow(stamps, points, seeds, Config(), origins)}
    found = {}
    for one in given:
        track = tracks[one.track_id]
        boxes = np.full(one.truth.shape, np.nan)
        _, here, there = np.intersect1d(one.stamps_ns, track.stamps_ns, return_indices=True)
        boxes[here] = track.boxes[there]
        found[one.track_id] = boxes
    return found
