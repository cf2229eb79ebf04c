"""What the input tells about itself: its annotation rule, and how it errs."""

from collections import OrderedDict
from typing import NamedTuple

from boxreg_ros.config import FaceConfig
from boxreg_ros.geometry import rotation_from_rpy
from boxreg_ros.objective import EXTENT, Problem, State, Support
import numpy as np
import torch
from torch import Tensor

KINDS = ([0, 1], [2, 3], [4], [5])  # ends, sides, top, bottom
PRIOR = (0.05, 0.05, 0.05, 0.15)  # how far a rule may be from the expected one [m]
TRACKS = 500  # remembered


class AnnotationRule:
    """
    The gap between a label's faces and the outermost points on them, learnt from the input.

    Each track gives one sight per kind of face, the mean over its observations, and the median
    over tracks is weighed against the expected gap: boxes that err by more than the gap still
    tell it if their error has no preferred direction.

    """

    def __init__(self, config: FaceConfig) -> None:
        self._config = config
        self._sights: OrderedDict[str, np.ndarray] = OrderedDict()

    def learn(self, names: list[str], support: Support, fresh: Tensor, gaps: Tensor) -> None:
        """
        Take the observations `fresh` (B, N) of tracks `names`, sighted at their input boxes.

        `gaps` (B, 6) are those that `support` was made with.

        """
        sights = (gaps[:, None] - support.outwardness).numpy()
        enough = support.seen & fresh[..., None] & (support.count >= 30)[..., None]
        weight = enough.numpy() & (np.abs(sights) < 0.5)
        for b, name in enumerate(names):
            known = self._sights.setdefault(name, np.zeros((2, 6)))
            known += np.stack([(sights[b] * weight[b]).sum(0), weight[b].sum(0)])
            self._sights.move_to_end(name)
        while len(self._sights) > TRACKS:
            self._sights.popitem(last=False)

    def gaps(self) -> Tensor:
        """Return the gap to expect of each face, shape (6,) [m]."""
        c = self._config
        expected = (c.gap_ends, c.gap_sides, c.gap_top, c.gap_bottom)
        gaps = torch.zeros(6, dtype=torch.float64)
        known = np.array(list(self._sights.values())).reshape(-1, 2, 6)
        for faces, gap, deviation in zip(KINDS, expected, PRIOR, strict=True):
            total, count = known[:, 0, faces].ravel(), known[:, 1, faces].ravel()
            sights = total[count >= 3] / count[count >= 3]
            if c.learn and len(sights) >= 3:
                middle = np.median(sights)
                error = 1.25 * (1.48 * np.median(np.abs(sights - middle)) + 0.02)
                trust = deviation**2 / (deviation**2 + error**2 / len(sights))
                gap = gap + trust * (middle - gap)
            gaps[faces] = float(gap)
        return gaps


class InputNoise(NamedTuple):
    """
    How input poses and extents scatter about a fit, over all tracks long enough to tell.

    Attributes
    ----------
    deviation, correlation : Tensor, shape (9,)
        Robust standard deviation along the box axes (lon lat z roll pitch yaw [m, rad], extents
        as part of each), and correlation from one observation to the next, 0 to 0.9.

    """

    deviation: Tensor
    correlation: Tensor

    @classmethod
    def measure(cls, problem: Problem, state: State) -> 'InputNoise | None':
        """Return the scatter of the windows with at least 20 observations; None without any."""
        valid = problem.valid & (problem.valid.sum(1, keepdim=True) >= 20)
        if not bool(valid.any()):
            return None
        difference = problem.pose - state.pose
        R = rotation_from_rpy(problem.pose[..., 3:])
        along = (R.mT @ difference[..., :3, None])[..., 0]
        extent = problem.boxes[..., 3:6] / state.shared[:, None, EXTENT] - 1
        scatter = torch.cat([along, difference[..., 3:], extent], -1)
        count = valid.sum(1)[:, None, None].clamp(min=1)
        scatter = scatter - (scatter * valid[..., None]).sum(1, keepdim=True) / count
        deviation = 1.48 * scatter[valid].abs().median(0).values
        bounded = scatter.clamp(-3 * deviation, 3 * deviation)
        first, second = bounded[:, :-1][valid[:, 1:]], bounded[:, 1:][valid[:, 1:]]
        power = (first.square() + second.square()).sum(0) / 2
        correlation = (first * second).sum(0) / power.clamp(min=1e-12)
        return cls(deviation, correlation.clamp(0.0, 0.9))
