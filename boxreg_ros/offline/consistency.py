"""Are the covariances as large as the errors? Coverage and normalised squared errors (NEES)."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
import math
from typing import NamedTuple, TYPE_CHECKING

from boxreg_ros.io.covariance_table import BoxCovariance
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import Floats, ROLL
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from boxreg_ros.io.box_table import BoxTable
    from boxreg_ros.offline.box_scores import Matches

CONSISTENCY_VARIABLES = ('along', 'across', 'up', 'yaw', 'length', 'width', 'height')
RANGE_BINS = (0.0, 20.0, 40.0, math.inf)
"""Limits of the groups by distance from the sensor [m]."""
MIN_VARIANCE = 1e-12
"""Variances are at least this; derived: an error of a micrometre is none."""


class Consistency(NamedTuple):
    """
    Covariances against errors over a group of boxes, without heading flips.

    Attributes
    ----------
    boxes : int
        Boxes with a true box and a covariance.
    coverage : dict
        By variable: part of the errors within two standard deviations; 0.954 is consistent.
    nees : dict
        By variable: mean squared error over variance; 1 is consistent.

    """

    boxes: int
    coverage: dict[str, float]
    nees: dict[str, float]


def consistency(
    matches: Matches,
    predicted: BoxTable,
    truth: BoxTable,
    covariances: Mapping[tuple[int, str], BoxCovariance],
) -> dict[str, Consistency]:
    """
    Return the consistency of all boxes, by class and by range, by the name of the group.

    Parameters
    ----------
    matches : Matches
        True boxes with the errors of their predictions.
    predicted, truth : BoxTable
        The tables of the predictions and of the true boxes.
    covariances : mapping
        Of the predictions, by stamp and track id.

    """
    known = []
    for i in np.flatnonzero(matches.is_matched & ~matches.is_flipped).tolist():
        row = matches.predicted_rows[i]
        covariance = covariances.get((int(predicted.stamps_ns[row]), predicted.track_ids[row]))
        if covariance is not None:
            known.append((i, covariance))
    if not known:
        return {}
    rows = np.array([i for i, _ in known])
    squared = _normalised(matches, truth, rows, [covariance for _, covariance in known])
    classes = np.array([matches.class_names[i] for i in rows], object)
    ranges = np.array([covariance.distance for _, covariance in known])
    found = {'all': _over(squared, np.ones(len(rows), bool))}
    for name in sorted(set(classes)):
        found[str(name)] = _over(squared, np.equal(classes, name))
    for low, high in pairwise(RANGE_BINS):
        is_in = (ranges >= low) & (ranges < high)
        if is_in.any():
            label = f'{low:g}-{high:g} m' if high < math.inf else f'{low:g}+ m'
            found[label] = _over(squared, is_in)
    return found


def table(groups: Mapping[str, Consistency]) -> str:
    """Return the groups as a text table: coverage, then NEES, of each variable."""
    width = max(len(name) for name in groups)
    titles = ''.join(f'{name:>13}' for name in CONSISTENCY_VARIABLES)
    lines = [' ' * width + f'{"boxes":>8}{titles}']
    for name, group in groups.items():
        cells = [f'{group.coverage[v]:7.2f}{group.nees[v]:6.2f}' for v in CONSISTENCY_VARIABLES]
        lines.append(f'{name:{width}}{group.boxes:8d}{"".join(cells)}')
    lines.append(
        'part of the errors within 2 sigma (0.95 is consistent), mean of squared error over '
        'variance (1 is consistent)'
    )
    return '\n'.join(lines)


def _normalised(
    matches: Matches, truth: BoxTable, rows: NDArray[np.int64], known: list[BoxCovariance]
) -> Floats:
    """Return squared errors over variances along the axes of the true boxes, (n, 7)."""
    axes = matrix_from_rpy(truth.boxes[matches.rows[rows], ROLL:])
    pose = np.array([covariance.pose for covariance in known])
    extent = np.array([covariance.extent for covariance in known])
    position = np.einsum('nki,nkl,nli->ni', axes, pose[:, :3, :3], axes)
    variances = np.column_stack(
        [position, pose[:, 5, 5], np.diagonal(extent, axis1=1, axis2=2)]
    ).clip(MIN_VARIANCE)
    errors = np.column_stack(
        [matches.translation[rows], matches.rotation[rows, 2], matches.extent[rows]]
    )
    return np.asarray(errors**2 / variances)


def _over(squared: Floats, chosen: NDArray[np.bool_]) -> Consistency:
    """Return the consistency of the `chosen` boxes."""
    part = squared[chosen]
    coverage = (part <= 4).mean(axis=0).tolist()
    nees = part.mean(axis=0).tolist()
    by_name = (
        dict(zip(CONSISTENCY_VARIABLES, values, strict=True)) for values in (coverage, nees)
    )
    return Consistency(len(part), *by_name)
