"""
The population of tracks: how the input errs in extents that differ from the usual ones (M16).

docs/method.md, section Input model, has the formulas.

"""

from typing import NamedTuple

from boxreg_ros.config import KINDS
from boxreg_ros.core.batch import Problem
from boxreg_ros.structures import Floats
import numpy as np
import torch
from torch import Tensor

# Constants whose origin is not stated are chosen; `boxreg bench sensitivity` halves and doubles
# each of them.
POPULATION_RADIUS = 0.5
"""Distance in logarithms of extents at which objects have weight 1/2 for each other."""
SLOPE_DEVIATION = 240.0
"""Prior deviation of the slope of extent corrections, per squared error. Derived: 0.6 for input
whose extents err by 5 %, 0.6 / 0.05^2."""
CROSS_SLOPE_INFORMATION = 4.0
"""Prior information of slopes over the other two extents: half the deviation of the own one."""


class Population(NamedTuple):
    """
    Evidence of the points of n tracks about their extents.

    Attributes
    ----------
    evidence : Tensor, shape (n, 3, 3)
        Rows of length, width and height: logarithms of the input's; corrections to these, over
        the square of their expected error; the weights of these, 0 without enough evidence.
    kind : Tensor, shape (n,)
        Indices among `KINDS`.

    """

    evidence: Tensor = torch.zeros(0, 3, 3, dtype=torch.float64)
    kind: Tensor = torch.zeros(0, dtype=torch.int64)

    def joined(self, evidence: Tensor, kind: Tensor) -> 'Population':
        """Return this population with more tracks."""
        evidence = torch.cat([self.evidence, evidence.to(self.evidence)])
        return Population(evidence, torch.cat([self.kind, kind.to(self.kind)]))

    def factors(self, problem: Problem, given: Tensor, error: Tensor) -> Tensor:
        """Return the `population_factor` of each window, by tracks of its kind, (B, 3)."""
        median, slopes = (torch.from_numpy(part).to(given)[problem.kind] for part in self.slopes())
        return _factor(median, slopes, given, error)

    def similarity(self, problem: Problem, given: Tensor) -> Tensor:
        """Return how like the tracks of its kind each window of `given` extents is, (B, 1)."""
        median = torch.from_numpy(self.slopes()[0]).to(given)[problem.kind]
        return _similarity(given.log() - median)

    def slopes(self) -> tuple[Floats, Floats]:
        """Return `population_slopes` by kind, shapes (K, 3) and (K, 3, 3); 0 without tracks."""
        evidence, kind = self.evidence.cpu().numpy(), self.kind.cpu().numpy()
        median, slopes = np.zeros((len(KINDS), 3)), np.zeros((len(KINDS), 3, 3))
        for k in set(kind.tolist()):
            median[k], slopes[k] = population_slopes(evidence[kind == k])
        return median, slopes


UNKNOWN_POPULATION = Population()


def population_factor(evidence: Tensor, given: Tensor, error: Tensor) -> Tensor:
    """
    Return expected over given extents, by the population of tracks (M16), shape (B, 3).

    Parameters
    ----------
    evidence : Tensor, shape (n, 3, 3)
        Evidence of the points of n tracks about their extents, see `Population`.
    given : Tensor, shape (B, 3)
        Mean extents of the input [m].
    error : Tensor, shape (B, 3)
        Their expected error, as part of each.

    Notes
    -----
    Trained detectors shrink extents toward those of the majority, noise spreads them. Tracks with
    evidence about their extents show which, and by how much: a ridge regression of their
    corrections on the distance of all three extents from the medians, in logarithms and in
    proportion to the square of the error, so that low-noise input is left as it is. Objects
    unlike the majority, trucks among cars, are corrected little, and the medians not at all: the
    labelling margin accounts for a common error.

    """
    median, slopes = map(torch.from_numpy, population_slopes(evidence.cpu().numpy()))
    return _factor(median.to(given), slopes.to(given), given, error)


def population_slopes(evidence: Floats) -> tuple[Floats, Floats]:
    """
    Return the regression of `population_factor` on the `evidence` (n, 3, 3) of tracks.

    The median (3,) of the logarithms of extents, and the slopes (3, 3) of the corrections, one row
    for each corrected extent.

    """
    log, correction, weight = evidence.swapaxes(0, 1)  # (n, 3) each
    median = np.sort(log, axis=0)[(len(log) - 1) // 2]
    off = log - median
    similarity = 1 / (1 + np.square(off / POPULATION_RADIUS).sum(1, keepdims=True))
    A = similarity * off
    weighted = weight.T[..., None] * A  # (3, n, 3)
    ridge = np.full((3, 3), CROSS_SLOPE_INFORMATION) - (CROSS_SLOPE_INFORMATION - 1) * np.eye(3)
    curvature = weighted.swapaxes(1, 2) @ A + ridge[:, None] * np.eye(3) / SLOPE_DEVIATION**2
    pull = (similarity * correction).T[:, None] @ weighted  # (3, 1, 3)
    return median, np.linalg.solve(curvature, pull.swapaxes(1, 2))[..., 0]


def _factor(median: Tensor, slopes: Tensor, given: Tensor, error: Tensor) -> Tensor:
    """Return the factors (B, 3) of extents that are `given`, by `population_slopes`."""
    own = given.log() - median
    return torch.exp(error**2 * (slopes @ (_similarity(own) * own)[..., None])[..., 0])


def _similarity(own: Tensor) -> Tensor:
    """Return the weight (B, 1) of the population for extents whose logarithms are `own` off it."""
    return 1 / (1 + (own / POPULATION_RADIUS).square().sum(1, keepdim=True))
