"""Scenes with known truth: a car and the points of a stationary sensor; batches by hand."""

from dataclasses import replace
from functools import lru_cache

from boxreg_ros.config import KINDS
from boxreg_ros.core.estimation import estimate_windows
from boxreg_ros.core.method.arrays import (
    ANCHOR,
    BIAS,
    COMMON,
    GAP,
    INPUTS,
    PIVOT,
    POSE,
    PRIOR,
    SHARED,
    SIDESLIP,
)
from boxreg_ros.core.method.arrays import EXTENT as LENGTH
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.method.residuals import RESIDUALS, TERMS
from boxreg_ros.core.observation import Observation, Observations, observe
from boxreg_ros.core.problem import CLASS_SETTINGS, Problem, SETTINGS_OF
from boxreg_ros.core.refine import Track
from boxreg_ros.core.window import Window
from boxreg_ros.simulation.scene import FIXED_FRAME
from boxreg_ros.simulation.simulate import simulate
from boxreg_ros.simulation.writer import write_recording
from boxreg_ros.structures import BoxArray, Sweep
import numpy as np
from scipy.spatial.transform import Rotation

EXTENT = np.array([4.4, 1.8, 1.5])
PERIOD_NS = 10**8
START_NS = 1_700_000_000 * 10**9
# Labelling margin of front, back, left, right and top [m]: distance from the box face to the
# outermost surface points, the defaults of `ClassConfig`.
GAPS = np.array([0.05, 0.05, 0.03, 0.03, 0.05])
simulated = lru_cache(8)(simulate)
"""`simulate`, once for all tests of a process: seconds each; they do not change the scene."""


def drive(n, speed=5.0, turn=0.3, start=(5.0, 6.0, 0.2), z=0.75):
    """Return true boxes (n, 9) at 10 Hz of a car whose rear axle does not slip."""
    t = np.arange(n) * PERIOD_NS * 1e-9
    yaw = start[2] + turn * t
    path = speed * t
    if turn:
        axle = speed / turn * np.c_[np.sin(yaw) - np.sin(start[2]), np.cos(start[2]) - np.cos(yaw)]
    else:
        axle = path[:, None] * [[np.cos(start[2]), np.sin(start[2])]]
    center = axle + EXTENT[0] / 4 * np.c_[np.cos(yaw), np.sin(yaw)] + start[:2]
    boxes = np.zeros((n, 9))
    boxes[:, :2], boxes[:, 2], boxes[:, 3:6], boxes[:, 8] = center, z, EXTENT, yaw
    return boxes


def returns(box, rng, count=300, origin=(0.0, 0.0, 1.5), noise=0.01):
    """Return points (M, 3) on the faces of `box` visible from `origin`, `GAPS` behind them."""
    R = Rotation.from_euler('ZYX', box[[8, 7, 6]]).as_matrix()
    toward = (np.asarray(origin) - box[:3]) @ R
    half = box[3:6] / 2
    points = []
    for face, gap in enumerate(GAPS):
        axis, sign = face // 2, 1 - 2 * (face % 2)
        if sign * toward[axis] > half[axis]:
            local = rng.uniform(-0.95, 0.95, (count // 3, 3)) * half
            local[:, axis] = sign * (half[axis] - gap)
            points.append(local)
    local = np.concatenate(points) if points else np.empty((0, 3))
    return (local + noise * rng.normal(size=local.shape)) @ R.T + box[:3]


def jittered(boxes, rng, position=0.15, heading=0.05, extent=0.0):
    """Return `boxes` (n, 9) with the noise of a detector."""
    n = len(boxes)
    noisy = boxes.copy()
    noisy[:, :2] += position * rng.normal(size=(n, 2))
    noisy[:, 2] += position / 3 * rng.normal(size=n)
    noisy[:, 8] += heading * rng.normal(size=n)
    noisy[:, 3:6] *= 1 + extent * rng.normal(size=(n, 3))
    return noisy


def stamps(n):
    """Return `n` stamps at 10 Hz [ns]."""
    return START_NS + PERIOD_NS * np.arange(n)


def track_of(truth, rng, name='1', **noise):
    """Return a track with noisy boxes along the true boxes `truth` (n, 9)."""
    n = len(truth)
    points = [returns(box, rng) for box in truth]
    boxes = jittered(truth, rng, **noise)
    return Track(name, 'car', stamps(n), boxes, points, np.tile([0.0, 0.0, 1.5], (n, 1)))


def stream_of(tracks):
    """Return one (Sweep, BoxArray) per stamp of `tracks`, with the points of all of them."""
    pairs = []
    for stamp_ns in sorted({int(s) for track in tracks for s in track.stamps_ns}):
        here = [(t, i) for t in tracks for i in np.flatnonzero(t.stamps_ns == stamp_ns)]
        points = np.concatenate([t.points[i] for t, i in here])
        origin = here[0][0].sensor_origins[here[0][1]]
        sweep = Sweep(stamp_ns, 'odom', points, None, origin)
        boxes = BoxArray(
            stamp_ns, 'odom', tuple(t.track_id for t, _ in here),
            tuple(t.class_name for t, _ in here), np.ones(len(here)),
            np.array([t.boxes[i] for t, i in here]),
        )  # fmt: skip
        pairs.append((sweep, boxes))
    return pairs


def cut(track, part):
    """Return the observations `part` of a track."""
    return replace(
        track, stamps_ns=track.stamps_ns[part], boxes=track.boxes[part], points=track.points[part],
        sensor_origins=track.sensor_origins[part],
        scores=None if track.scores is None else track.scores[part],
    )  # fmt: skip


def fed(registrar, stream):
    """Add sweeps and boxes to a registrar, and return the results."""
    results = []
    for sweep, boxes in stream:
        results += registrar.add_sweep(sweep)
        results += registrar.add_boxes(boxes)
    return results


class Seen(Observation):
    """An observation that has all columns of its table."""

    def __getattr__(self, name):
        """Return its row of a column."""
        return getattr(self.table, name)[self.row]


class Solved:
    """The columns of the estimate of one window."""

    def __init__(self, estimate):
        self.prior = estimate.prior
        self._table = estimate.table
        self._rows = slice(estimate.begin, estimate.end)

    def __getattr__(self, name):
        """Return its rows of a column, words as a tuple."""
        rows = getattr(self._table, name)[self._rows]
        return tuple(rows.tolist()) if name in ('status', 'reasons') else rows


def solved(windows, config, model):
    """Return what `estimate_windows` returns, with the columns of each estimate."""
    found = estimate_windows(windows, config, model)
    return [None if estimate is None else Solved(estimate) for estimate in found]


def row_of(item):
    """Return a row of a table, given as a pair of both, as one named tuple."""
    table, row = item
    return table._make(column[row] for column in table)


def observation(**changes):
    """Return an observation of a box at the origin without points, with some columns changed."""
    blank = Observations(
        stamps_ns=0, boxes=np.array([0.0, 0, 0, 4, 2, 1.5, 0, 0, 0]), points=np.zeros((0, 3)),
        delays=np.zeros(0), counts=0, origins=np.full((1, 3), np.nan), ground=np.nan,
        ring_heights=0.0, num_points=0, sights=0.0, is_pinned=False,
    )  # fmt: skip
    row = blank._replace(**changes)
    columns = {name: np.array([value]) for name, value in row._asdict().items()}
    columns['points'] = row.points.astype(np.float32)
    columns['delays'] = row.delays.astype(np.float32)
    columns['counts'] = np.array([len(row.points)])
    return Seen(Observations(**columns), 0)


def changed(seen, **changes):
    """Return an observation with some columns changed."""
    table = seen.table.take(np.array([seen.row]))
    columns = {name: np.array([value]) for name, value in changes.items()}
    return Seen(table._replace(**columns), 0)


def window_of(track, config):
    """Return the window of all observations of `track`; all are new."""
    observations = [
        Seen(observe(sweep, boxes.boxes, boxes.stamp_ns, config), 0)
        for sweep, boxes in stream_of([track])
    ]
    name, n = track.track_id, len(observations)
    return Window(name, track.class_name, observations, n, np.zeros((0, 9)))


def write_scene(path, scene, **changes):
    """Write a simulated scene, with some parts changed, as a recording; return its path."""
    scene = replace(scene, **changes)
    intensities = [np.zeros(len(sweep.points)) for sweep in scene.sweeps]
    poses = scene.T_fixed_sensor
    write_recording(path, scene.sweeps, intensities, scene.detections, poses, FIXED_FRAME)
    return path


PARTS = {
    'EXTENT': slice(LENGTH, BIAS),
    'BIAS': slice(BIAS, GAP),
    'GAP': slice(GAP, PIVOT),
    'PIVOT': PIVOT,
    'ANCHOR': slice(ANCHOR, SHARED),
    'SIDESLIP': SIDESLIP,
}


def problem_of(boxes, **changes):
    """
    Return the problem of `boxes` (B, N, 9) with some fields changed.

    At 10 Hz, without points or prior. Points are padded (B, N, M, 3), with a `mask` of those that
    count. Fields of `CLASS_SETTINGS` are given by name in `of_class`; the others are NaN.

    """
    boxes = np.asarray(boxes, float).copy()
    B, N = boxes.shape[:2]
    points = np.asarray(changes.pop('points', np.zeros((B, N, 0, 3))))
    mask = np.asarray(changes.pop('mask', np.ones(points.shape[:-1], bool)))
    delays = np.asarray(changes.pop('delays', np.zeros(mask.shape)))
    if 'origins' in changes:  # (B, N, 3): of one sensor
        changes['origins'] = np.expand_dims(changes['origins'], -2)
    if 'valid' in changes:
        changes['lengths'] = np.asarray(changes.pop('valid')).sum(1)
    of_class = np.full(B, np.nan, CLASS_SETTINGS)
    for name, value in changes.pop('of_class', {}).items():
        of_class[name] = value
    given = {
        'boxes': boxes,
        'start': boxes.copy(),
        'lengths': np.full(B, N),
        'times': np.tile(0.1 * np.arange(N), (B, 1)),
        'origins': np.full((B, N, 1, 3), np.nan),
        'ground': np.full((B, N), np.nan),
        'ring_heights': np.zeros((B, N)),
        'stride': 1,
        'pinned': np.zeros((B, N), bool),
        'prior_mean': np.zeros((B, PRIOR)),
        'prior_information': np.zeros((B, PRIOR, PRIOR)),
        'marginalised_extents': np.zeros((B, 4)),
        'kind': np.zeros(B, np.int64),
        'of_class': of_class,
    }
    more = {name: np.array(value) for name, value in changes.items()}
    return Problem(**{**given, **more, **returns_of(points, mask, delays)})


def returns_of(points, mask, delays=None):
    """Return the fields of a `Problem` for padded points (B, N, M, 3) with a mask (B, N, M)."""
    delays = np.zeros(mask.shape) if delays is None else delays
    counts = mask.sum(-1)
    delays = delays[mask].astype(np.float32)
    return {
        'points': points[mask].astype(np.float32),
        'delays': delays,
        'is_moving': bool(delays.any()),
        'first': counts.ravel().cumsum().reshape(counts.shape) - counts,
        'counts': counts,
    }


def settings_of(kind):
    """Return the fields of `CLASS_SETTINGS` of one window with the settings of a kind."""
    return {
        field: [getattr(kind, name) for name in names] if len(names) > 1 else getattr(kind, *names)
        for field, names in SETTINGS_OF.items()
    }


def no_inputs(**parts):
    """Return records `INPUTS` (K,) without any evidence, with some fields changed."""
    inputs = np.zeros(len(KINDS), INPUTS)
    inputs['deviation'] = inputs['extent_error'] = inputs['spread'] = 1.0
    inputs['low_noise'] = 1.0
    inputs['correlation'] = CONSTANTS.typical_correlation
    for name, value in parts.items():
        inputs[name] = value
    return inputs


def shared_of(extent=(4.0, 2.0, 2.0), B=1, **parts):
    """Return shared parameters (B, 23): `extent`, and parts by the names of `PARTS`."""
    shared = np.zeros((B, SHARED))
    shared[:, :3] = extent
    for name, value in parts.items():
        shared[:, PARTS[name]] = value
    return shared


def boxes_at(*poses, extent=(4.0, 2.0, 2.0)):
    """Return boxes (1, N, 9) at poses (x, y, z, roll, pitch, yaw); missing values are 0."""
    full = [(*pose, *[0.0] * (6 - len(pose))) for pose in poses]
    return np.array([[[*pose[:3], *extent, *pose[3:]] for pose in full]])


def random_problem(B=3, N=6, M=20, seed=0):
    """Return a problem of random boxes of about 4 x 2 x 1.5 m and points, padded by up to two."""
    rng = np.random.default_rng(seed)
    boxes = rng.normal(size=(B, N, 9))
    boxes[..., 3:6] = [4, 2, 1.5] + 0.1 * rng.random((B, N, 3))
    boxes[..., 6:8] *= 0.1
    valid = np.arange(N) < np.array([N, N - 1, N - 2])[:B, None]
    return problem_of(
        boxes,
        valid=valid,
        times=np.cumsum(rng.random((B, N)) + 0.05, 1),
        points=rng.normal(size=(B, N, M, 3)),
        mask=(rng.random((B, N, M)) < 0.8) & valid[..., None],
    )


def random_weights(rng, *shape):
    """Return random symmetric positive definite weights (*shape, shape[-1])."""
    root = rng.normal(size=(*shape, shape[-1]))
    return root @ root.swapaxes(-1, -2)


def random_terms(N=6, seed=1):
    """Return `TERMS` (N,), `COMMON` and prior of one window, with random weights and data."""
    rng = np.random.default_rng(seed)
    terms, common = np.zeros(N, TERMS), np.zeros((), COMMON)[()]
    terms['time'] = np.cumsum(rng.random(N) + 0.05)
    for name in ('given', 'start', 'inset', 'wanted'):
        terms[name] = rng.normal(size=(N, 6))
    angles = rng.normal(size=(N, 3)) * [0.1, 0.1, 1.0]
    terms['axes'] = Rotation.from_euler('ZYX', angles[:, ::-1]).as_matrix()
    terms['W_faces'] = random_weights(rng, N, 6, 4)
    terms['root'] = np.tril(rng.normal(size=(N, 6, 6)))
    terms['W'] = rng.random((N, len(RESIDUALS), 6)) + 0.1
    common['shared'], common['W_shared'] = rng.normal(size=SHARED), rng.random(SHARED) + 0.1
    return terms, common, (rng.normal(size=PRIOR), random_weights(rng, PRIOR))


def random_variables(N=6, seed=2):
    """Return variables (6 N + 23,) of one window."""
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.normal(size=6 * N), 3 + rng.normal(size=SHARED)])


def dense(A, N):
    """Return the dense matrix (D, D) of an `Arrowhead` with a chain of N poses."""
    D = POSE * N + len(A.corner)
    whole = np.zeros((D, D))
    for n in range(N):
        rows, end = slice(POSE * n, POSE * (n + 1)), min(POSE * (n + 3), POSE * N)
        whole[rows, POSE * n : end] = A.poses['links'][n][:, : end - POSE * n]
        whole[rows, POSE * N :] = A.poses['border'][n][:, : len(A.corner)]
    whole[POSE * N :, POSE * N :] = A.corner
    upper = np.triu(whole)
    return upper + np.triu(upper, 1).T
