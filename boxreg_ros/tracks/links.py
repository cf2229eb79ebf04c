"""Which tracklets continue each other, by their costs; ambiguous ones are left alone."""

from __future__ import annotations

from typing import NamedTuple

from boxreg_ros.structures import Floats
from boxreg_ros.tracks.tracklet import joined_tracklets, Tracklet
import numpy as np
from scipy.optimize import linear_sum_assignment

AMBIGUITY = 6.0
"""
Least difference of cost to the next best choice.

Derived: costs are -2 ln of a likelihood, so 6 is a likelihood ratio of 20.

"""


class Links(NamedTuple):
    """
    Pairs of tracklets that continue each other.

    Attributes
    ----------
    pairs : list of (int, int)
        Earlier and later tracklet.
    ambiguous : list of (int, int)
        Pairs that were left alone, because another choice is nearly as good.

    """

    pairs: list[tuple[int, int]]
    ambiguous: list[tuple[int, int]]


def best_links(costs: Floats) -> Links:
    """
    Return the pairs of least total cost, each tracklet with one successor at most.

    Parameters
    ----------
    costs : array, shape (n, n)
        Cost of each tracklet as the predecessor of each other; inf where it is none.

    """
    is_possible = np.isfinite(costs)
    found = Links([], [])
    if not is_possible.any():
        return found
    # Any possible pair is better than none.
    worst = costs[is_possible].max() + 1.0
    gains = np.where(is_possible, worst - costs + AMBIGUITY, 0.0)
    for before, after in zip(*linear_sum_assignment(gains, maximize=True), strict=True):
        if not is_possible[before, after]:
            continue
        # A later part of the same chain is no alternative: it continues the pair.
        later = np.where(is_possible[after], np.inf, costs[before])
        earlier = np.where(is_possible[:, before], np.inf, costs[:, after])
        others = np.append(np.delete(later, after), np.delete(earlier, before))
        is_clear = others.min(initial=np.inf) >= costs[before, after] + AMBIGUITY
        (found.pairs if is_clear else found.ambiguous).append((int(before), int(after)))
    return found


def join_links(tracklets: list[Tracklet], pairs: list[tuple[int, int]]) -> list[Tracklet]:
    """Return tracklets with those of each chain of pairs joined, in the order of their start."""
    successor = dict(pairs)
    followers = set(successor.values())
    whole = []
    for index in range(len(tracklets)):
        if index in followers:
            continue
        chain = [index]
        while chain[-1] in successor:
            chain.append(successor[chain[-1]])
        parts = [tracklets[part] for part in chain]
        whole.append(joined_tracklets(parts) if len(parts) > 1 else parts[0])
    return whole
