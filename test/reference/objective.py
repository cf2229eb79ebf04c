"""
The sum of all residuals of one window (M1) by torch: the oracle of the compiled one.

Residuals are stated for all observations at once; automatic differentiation gives their
derivatives. Every function returns whitened residuals, whose squares are summed.

"""

from boxreg_ros.core.geometry import rotation_from_rpy
from boxreg_ros.core.method.arrays import ANCHOR, BIAS, EXTENT, GAP, PIVOT, SHARED, SIDESLIP
from boxreg_ros.core.method.constants import RESIDUAL_NAMES
import numpy as np
import torch

AXIS = torch.tensor([0, 0, 1, 1, 2, 2])
SIGN = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0], dtype=torch.float64)


def tensors(record):
    """Return the fields of an array of records as tensors."""
    return {name: torch.from_numpy(np.array(record[name])) for name in record.dtype.names}


def root(W):
    """Return L (..., n, n) of W = L L'."""
    values, vectors = torch.linalg.eigh(W)
    return vectors * values.clamp(min=0).sqrt()[..., None, :]


def faces(p, s, t):
    """(M2): v'(q, 1) is the signed distance of q from the plane of a face."""
    R = rotation_from_rpy(p[:, 3:])
    n = R.mT[:, AXIS] * SIGN[:, None]  # (N, 6, 3)
    shift = (p - t['given'])[:, None, :3]
    level = t['inset'] + s[GAP:PIVOT] - s[EXTENT:BIAS][AXIS] / 2 - (n * shift).sum(-1)
    v = torch.cat([n, level[..., None]], -1)
    return (root(t['W_faces']).mT @ v[..., None]).flatten()


def along(t, step):
    """Return steps (N, 6) with their positions along the axes at the start of the round."""
    return torch.cat([(t['axes'].mT @ step[:, :3, None])[..., 0], step[:, 3:]], 1)


def weighted(name, r, t):
    """Return a residual of the table, by its name, times the root of its weights."""
    W = t['W'][: len(r), RESIDUAL_NAMES.index(name), : r.shape[1]]
    return (W.sqrt() * r).flatten()


def input_pose(p, s, t):
    """(M3)."""
    return weighted('input', along(t, p - t['given']) - s[BIAS:GAP], t)


def rigid_shape(p, s, t):
    """(M4)."""
    off = along(t, p - t['start']) - s[ANCHOR:] - t['wanted']
    return weighted('rigid shape', (t['root'].mT @ off[..., None])[..., 0], t)


def acceleration(p, s, t):
    """(M5)."""
    dt = t['time'].diff()[:, None]
    change = (p.diff(dim=0) / dt).diff(dim=0) / ((dt[1:] + dt[:-1]) / 2)
    return weighted('acceleration', along({'axes': t['axes'][1:-1]}, change), t)


def zero_motion(p, s, t):
    """(M6)."""
    return weighted('zero motion', p.diff(dim=0), t)


def slip(p, s, t):
    """(M7)."""
    x = rotation_from_rpy(p[:, 3:])[:, :, 0]
    mean = rotation_from_rpy((p[1:, 3:] + p[:-1, 3:]) / 2)
    velocity = (p[:, :3] - s[PIVOT] * x).diff(dim=0) / t['time'].diff()[:, None]
    across = mean[:, :, 1] - s[SIDESLIP] * mean[:, :, 0]
    r = torch.stack([(across * velocity).sum(1), (mean[:, :, 2] * velocity).sum(1)], 1)
    return weighted('slip', r, t)


OF_OBSERVATIONS = {
    'input': input_pose,
    'rigid shape': rigid_shape,
    'acceleration': acceleration,
    'zero motion': zero_motion,
    'slip': slip,
}
"""The residuals of the table `RESIDUALS`, by their names."""


def shared_prior(p, s, c):
    """(M8)."""
    return c['W_shared'].sqrt() * (s - c['shared'])


def marginalisation_prior(p, s, mean, information):
    """(M9)."""
    return root(information).mT @ (torch.cat([p[:2].flatten(), s[:ANCHOR]]) - mean)


def whitened(x, terms, common, prior):
    """Return all whitened residuals (R,) at variables x (6 N + S,); without an anchor it is 0."""
    end = 6 * len(terms['time'])
    p, s = x[:end].view(-1, 6), x[end:]
    s = torch.cat([s, s.new_zeros(SHARED - len(s))])
    parts = [OF_OBSERVATIONS[name](p, s, terms) for name in RESIDUAL_NAMES]
    parts += [faces(p, s, terms)]
    return torch.cat([*parts, shared_prior(p, s, common), marginalisation_prior(p, s, *prior)])


def linearise(x, terms, common, prior):
    """Return value, gradient (D,) and Gauss-Newton curvature (D, D) of the sum."""
    x, *given = torch.from_numpy(x), tensors(terms), tensors(common), [*map(torch.tensor, prior)]
    r = whitened(x, *given)
    J = torch.autograd.functional.jacobian(lambda x: whitened(x, *given), x)
    return float(r @ r / 2), (J.T @ r).numpy(), (J.T @ J).numpy()
