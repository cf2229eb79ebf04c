"""
The spread of labelling margins between tracks, by a random-effects model of their gaps (M18a).

docs/method.md, section Input model, has the formula.

"""

from functools import cache
from typing import NamedTuple

from boxreg_ros.config import KINDS
from boxreg_ros.core.batch import Problem
from boxreg_ros.structures import Floats
import numpy as np
import torch
from torch import Tensor

MAX_SPREAD = 5.0
"""Largest spread over that of the settings. Derived: P(|z| > 5) is below 10^-6."""
SPREAD_NODES = 24
"""Nodes of the quadrature over the spread. Derived: it is exact to 1 mm for 200 tracks."""


class GapScatter(NamedTuple):
    """
    How the gaps between faces of the input and their outermost points scatter between tracks.

    One row for each of `KINDS`; without that axis, the same for all kinds.

    Attributes
    ----------
    variance : Tensor, shape (K, 6) or (6,)
        Variance of the means of the tracks, without tails [m^2].
    tracks : Tensor, shape (K, 6) or (6,)
        Number of these means.
    noise : Tensor, shape (K, 6) or (6,)
        Mean of one over the observations of a track: its share of their variance.

    """

    variance: Tensor = torch.zeros(6, dtype=torch.float64)
    tracks: Tensor = torch.zeros(6, dtype=torch.float64)
    noise: Tensor = torch.zeros(6, dtype=torch.float64)

    def of(self, problem: Problem) -> 'GapScatter':
        """Return the scatter for each window of `problem`, shapes (B, 6)."""
        rows = (part.to(problem.boxes).expand(len(KINDS), 6) for part in self)
        return GapScatter(*(part[problem.kind] for part in rows))


UNKNOWN_SCATTER = GapScatter()


@cache
def spread_quadrature() -> tuple[Floats, Floats]:
    """Return squares of a half-normal variable of unit deviation, and their weights, (Q,) each."""
    squares = ((np.arange(SPREAD_NODES) + 0.5) * MAX_SPREAD / SPREAD_NODES) ** 2
    return squares, np.exp(-squares / 2)


def margin_spread(
    scatter: GapScatter, errors: Tensor, usual: Tensor, similarity: Tensor
) -> Tensor:
    """
    Return the posterior spread of the labelling margins between tracks (M18a) [m].

    Parameters
    ----------
    scatter : GapScatter
        Of the tracks of the kind of each window, shapes (B, 6).
    errors : Tensor, shape (B, 6)
        Variance of the gap of a track by errors of the input [m^2].
    usual : Tensor, shape (B, 6)
        Spread by the settings [m].
    similarity : Tensor, shape (B, 1)
        How like the other tracks each object is, 0 to 1: gaps of cars are no evidence for a tram.

    Returns
    -------
    spread : Tensor, shape (B, 6)
        The root of the posterior mean of its square, as far as objects are similar.

    """
    squares, weights = (torch.from_numpy(part).to(usual) for part in spread_quadrature())
    prior = usual**2
    squares = prior[..., None] * squares  # (B, 6, Q)
    total = errors[..., None] + squares
    degrees = (scatter.tracks[..., None] - 1).clamp(min=0)
    information = -0.5 * degrees * (total.log() + scatter.variance[..., None] / total)
    part = weights * (information - information.amax(-1, keepdim=True)).exp()
    posterior = (part * squares).sum(-1) / part.sum(-1)
    return torch.lerp(prior, posterior, similarity).sqrt()
