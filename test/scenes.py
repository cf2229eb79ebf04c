"""Scenes with known truth: a car and the points of a stationary sensor; batches by hand."""

from boxreg_ros.core import batch, terms
from boxreg_ros.core.arrowhead import LINK
from boxreg_ros.core.batch import (
    CLASS_NUMBERS,
    PADDING_POSITION,
    PRIOR_SIZE,
    Problem,
    Returns,
    SHARED,
    State,
)
from boxreg_ros.core.geometry import rotation_from_rpy
from boxreg_ros.core.observation import Observation, Observations, observe
from boxreg_ros.core.refine import Track
from boxreg_ros.core.track_window import Window
from boxreg_ros.structures import BoxArray, Sweep
import numpy as np
from scipy.spatial.transform import Rotation
import torch

EXTENT = np.array([4.4, 1.8, 1.5])
PERIOD_NS = 10**8
START_NS = 1_700_000_000 * 10**9
# Labelling margin of front, back, left, right and top [m]: distance from the box face to the
# outermost surface points, the defaults of `ClassConfig`.
GAPS = np.array([0.05, 0.05, 0.03, 0.03, 0.05])


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


def observation(**changes):
    """Return an observation of a box at the origin without points, with some columns changed."""
    blank = Observations(
        stamps_ns=0, boxes=np.array([0.0, 0, 0, 4, 2, 1.5, 0, 0, 0]), points=np.zeros((0, 3)),
        delays=np.zeros(0), counts=0, origins=np.full((1, 3), np.nan), ground=np.nan,
        num_points=0, sights=0.0, is_pinned=False,
    )  # fmt: skip
    row = blank._replace(**changes)
    columns = {name: np.array([value]) for name, value in row._asdict().items()}
    columns['points'] = row.points.astype(np.float32)
    columns['delays'] = row.delays.astype(np.float32)
    columns['counts'] = np.array([len(row.points)])
    return Observation(Observations(**columns), 0)


def changed(seen, **changes):
    """Return an observation with some columns changed."""
    table = seen.table.take(np.array([seen.row]))
    columns = {name: np.array([value]) for name, value in changes.items()}
    return Observation(table._replace(**columns), 0)


def window_of(track, config):
    """Return the window of all observations of `track`; all are new."""
    observations = [
        Observation(observe(sweep, boxes.boxes, boxes.stamp_ns, config), 0)
        for sweep, boxes in stream_of([track])
    ]
    name, n = track.track_id, len(observations)
    return Window(name, track.class_name, observations, n, np.zeros((0, 9)))


def problem_of(boxes, **changes):
    """
    Return the problem of `boxes` (B, N, 9) with some fields changed.

    At 10 Hz, without points or prior. `class_numbers` are given by name; the others are NaN.

    """
    boxes = torch.as_tensor(boxes, dtype=torch.float64)
    B, N = boxes.shape[:2]
    points = torch.as_tensor(
        changes.pop('points', np.full((B, N, 1, 3), PADDING_POSITION))
    ).clone()
    given = {
        'boxes': boxes,
        'start': boxes,
        'valid': torch.ones(B, N, dtype=torch.bool),
        'times': 0.1 * torch.arange(N, dtype=torch.float64).expand(B, N),
        'origins': torch.full((B, N, 1, 3), torch.nan, dtype=torch.float64),
        'ground': torch.full((B, N), torch.nan, dtype=torch.float64),
        'prior_mean': torch.zeros(B, PRIOR_SIZE, dtype=torch.float64),
        'prior_information': torch.zeros(B, PRIOR_SIZE, PRIOR_SIZE, dtype=torch.float64),
        'marginalised_extents': torch.zeros(B, 4, dtype=torch.float64),
        'class_numbers': torch.full((B, len(CLASS_NUMBERS)), torch.nan, dtype=torch.float64),
        'pinned': torch.zeros(B, N, dtype=torch.bool),
        'kind': torch.zeros(B, dtype=torch.int64),
    }
    for name, values in changes.pop('class_numbers', {}).items():
        given['class_numbers'][:, CLASS_NUMBERS.index(name)] = torch.as_tensor(values)
    mask = torch.as_tensor(changes.pop('mask', points[..., 0] != PADDING_POSITION))
    delays = torch.as_tensor(changes.pop('delays', torch.zeros(mask.shape, dtype=torch.float64)))
    if 'origins' in changes:  # (B, N, 3): of one sensor
        changes['origins'] = np.expand_dims(changes['origins'], -2)
    more = {name: torch.as_tensor(np.asarray(value)) for name, value in changes.items()}
    return Problem(**{**given, **more, **returns_of(points, mask, delays)})


def returns_of(points, mask, delays=None):
    """Return the fields of a `Problem` for padded points (B, N, M, 3) with a mask (B, N, M)."""
    delays = torch.zeros(mask.shape, dtype=torch.float64) if delays is None else delays
    counts = mask.sum(-1)
    delays = delays[mask]
    returns = Returns(points[mask], delays, bool(delays.any()), max(1, int(counts.max())))
    return {
        'returns': returns,
        'first': counts.flatten().cumsum(0).view(counts.shape) - counts,
        'counts': counts,
    }


def shared_of(extent=(4.0, 2.0, 2.0), B=1, **parts):
    """Return shared parameters (B, 23): `extent`, and parts by the names of their slices."""
    shared = torch.zeros(B, SHARED, dtype=torch.float64)
    shared[:, :3] = torch.tensor(extent)
    for name, value in parts.items():
        shared[:, getattr(batch, name)] = torch.as_tensor(value, dtype=torch.float64)
    return shared


def boxes_at(*poses, extent=(4.0, 2.0, 2.0)):
    """Return boxes (1, N, 9) at poses (x, y, z, roll, pitch, yaw); missing values are 0."""
    full = [(*pose, *[0.0] * (6 - len(pose))) for pose in poses]
    rows = [[*pose[:3], *extent, *pose[3:]] for pose in full]
    return torch.tensor([rows], dtype=torch.float64)


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
    root = torch.from_numpy(rng.normal(size=(*shape, shape[-1])))
    return root @ root.mT


def terms_of(problem, seed=1):
    """Return every term of a problem by name, with random weights and data."""
    rng = np.random.default_rng(seed)
    B, N = problem.valid.shape
    inset = torch.from_numpy(rng.random((B, N, 6)))
    expected = torch.from_numpy(rng.normal(size=(B, SHARED)))
    axes = rotation_from_rpy(problem.pose[..., 3:] + 0.1)
    wanted = torch.from_numpy(rng.normal(size=(B, N, 6)))
    mean = torch.from_numpy(rng.normal(size=(B, 1, PRIOR_SIZE)))
    shapes = {  # of the weights, and the data
        terms.faces: ((N, 6, 4), (problem.pose, inset)),
        terms.input_pose: ((N, 1, 6), (problem.pose, axes)),
        terms.rigid_shape: ((N, 1, 6), (0.9 * problem.pose, wanted)),
        terms.acceleration: ((N - 2, 1, 6), (problem.times,)),
        terms.zero_motion: ((N - 1, 1, 6), ()),
        terms.slip: ((N - 1, 1, 2), (problem.times,)),
        terms.shared_prior: ((1, 1, SHARED), (expected,)),
        terms.marginalisation_prior: ((1, 1, PRIOR_SIZE), (mean,)),
    }
    return {
        function.__name__: terms.Term(function, random_weights(rng, B, *shape), data)
        for function, (shape, data) in shapes.items()
    }


def random_variables(problem, seed=2):
    """Return variables (B, 6 N + 22) about the input poses of a problem."""
    rng = np.random.default_rng(seed)
    B, N = problem.valid.shape
    pose = problem.pose + 0.1 * torch.from_numpy(rng.normal(size=(B, N, 6)))
    shared = 3 + torch.from_numpy(rng.normal(size=(B, SHARED)))
    return State(pose, shared).pack()


def dense(chain, N):
    """Return the dense matrices (B, D, D) of a `Chain` of N links."""
    B, D = len(chain.links), LINK * N + chain.corner.shape[1]
    whole = chain.links.new_zeros(B, D, D)
    whole[:, LINK * N :, LINK * N :] = chain.corner
    for i in range(N):
        own, rows = slice(LINK * i, LINK * (i + 1)), chain.links[:, i]
        whole[:, own, LINK * N :] = rows[..., 5 * LINK :]
        whole[:, LINK * N :, own] = rows[..., 5 * LINK :].mT
        for k in range(max(0, 2 - i), min(5, 2 + N - i)):
            first = LINK * (i + k - 2)
            whole[:, own, first : first + LINK] = rows[..., LINK * k : LINK * (k + 1)]
    return whole
