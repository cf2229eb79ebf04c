"""Consistency of covariances with errors: coverage and normalised squared errors (NEES)."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
import math
from typing import NamedTuple, TYPE_CHECKING

from boxreg_ros.config import Config, KINDS
from boxreg_ros.io.covariance_table import BoxCovariance
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import Floats, ROLL
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from boxreg_ros.io.box_table import BoxTable
    from boxreg_ros.offline.box_scores import Matches

DEFAULTS = Config()
"""Settings that assign class names to kinds of objects."""
CONSISTENCY_VARIABLES = ('along', 'across', 'up', 'yaw', 'length', 'width', 'height')
RANGE_BINS = (0.0, 20.0, 40.0, math.inf)
"""Limits of the groups by distance from the sensor [m]."""
MIN_VARIANCE = 1e-12
"""Variances are at least this; derived: an error of a micrometre is none."""
CONSISTENT_NEES = (0.7, 1.5)
"""Bounds of a mean normalised squared error that is called consistent. Chosen: deviations that are
off by less than a fifth."""
SIGNIFICANT = 2.0
"""Standard errors beyond those bounds that are no chance: 95 % of a normal variable."""


class Consistency(NamedTuple):
    """Covariances against errors over a group of boxes, without heading flips; by variable."""

    boxes: int  # with a true box and a covariance
    tracks: int  # true ones of these boxes
    # part of the errors within two standard deviations; 0.954 is consistent
    coverage: dict[str, float]
    nees: dict[str, float]  # mean squared error over variance; 1 is consistent
    nees_error: dict[str, float]  # standard error of it over the tracks; NaN for one track

    def is_off(self, variable: str) -> bool:
        """Return whether the NEES of a variable is out of `CONSISTENT_NEES`, and not by chance."""
        low, high = CONSISTENT_NEES
        beyond = max(low - self.nees[variable], self.nees[variable] - high)
        return beyond > SIGNIFICANT * self.nees_error[variable]


def consistency(
    matches: Matches,
    predicted: BoxTable,
    truth: BoxTable,
    covariances: Mapping[tuple[int, str], BoxCovariance],
) -> dict[str, Consistency]:
    """
    Compare the covariances of predictions with their errors.

    Parameters
    ----------
    matches : Matches
        Of `predicted` and `truth`; heading flips are left out.
    predicted, truth : BoxTable
        The boxes that were matched.
    covariances : mapping of (int, str) to BoxCovariance
        By stamp [ns] and track id of a prediction; predictions without one are left out.

    Returns
    -------
    found : dict of str to Consistency
        By group: ``all``, kinds of objects, classes, and ranges from the sensor; empty without
        covariances.

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
    tracks = np.array([truth.track_ids[row] for row in matches.rows[rows]], object)
    ranges = np.array([covariance.distance for _, covariance in known])
    kinds = np.array([DEFAULTS.kind(name) for name in classes], object)
    found = {'all': _over(squared, tracks, np.ones(len(rows), bool))}
    for kind in KINDS:
        if kind in kinds:
            found[f'{kind}s'] = _over(squared, tracks, np.equal(kinds, kind))
    for name in sorted(set(classes)):
        found[str(name)] = _over(squared, tracks, np.equal(classes, name))
    for low, high in pairwise(RANGE_BINS):
        is_in = (ranges >= low) & (ranges < high)
        if is_in.any():
            label = f'{low:g}-{high:g} m' if high < math.inf else f'{low:g}+ m'
            found[label] = _over(squared, tracks, is_in)
    return found


def table(groups: Mapping[str, Consistency]) -> str:
    """Return the groups as a text table: coverage, then NEES, of each variable."""
    width = max(len(name) for name in groups)
    titles = ''.join(f'{name:>14}' for name in CONSISTENCY_VARIABLES)
    columns = f'{"cover":>7}{"NEES":>6} ' * len(CONSISTENCY_VARIABLES)
    lines = [
        ' ' * width + f'{"boxes":>8}{"tracks":>8}{titles}',
        ' ' * (width + 16) + columns.rstrip(),
    ]
    for name, group in groups.items():
        cells = ''.join(
            f'{group.coverage[v]:7.2f} {group.nees[v]:5.2f}{"*" if group.is_off(v) else " "}'
            for v in CONSISTENCY_VARIABLES
        )
        lines.append(f'{name:{width}}{group.boxes:8d}{group.tracks:8d}{cells}')
    low, high = CONSISTENT_NEES
    lines.append(
        'cover: part of the errors within 2 sigma (0.95 is consistent); NEES: mean of squared '
        f'error over variance (1 is consistent;\n* out of {low:g} to {high:g} by more than '
        f'{SIGNIFICANT:g} standard errors over the tracks)'
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


def _over(squared: Floats, tracks: NDArray[np.object_], chosen: NDArray[np.bool_]) -> Consistency:
    """Return the consistency of the `chosen` boxes."""
    part = squared[chosen]
    names, owners = np.unique(tracks[chosen].astype(str), return_inverse=True)
    nees = part.mean(axis=0)
    deviations = np.zeros((len(names), len(CONSISTENCY_VARIABLES)))
    np.add.at(deviations, owners, part - nees)
    count = len(names)
    error = np.full(len(CONSISTENCY_VARIABLES), np.nan)
    if count > 1:  # the standard error of a mean over clusters
        error = np.sqrt((deviations**2).sum(axis=0) * count / (count - 1)) / len(part)
    by_name = (
        dict(zip(CONSISTENCY_VARIABLES, values.tolist(), strict=True))
        for values in ((part <= 4).mean(axis=0), nees, error)
    )
    return Consistency(len(part), count, *by_name)
