"""Scores of velocities against true ones: of differences of boxes, of a smoother, of estimates."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import math
from typing import NamedTuple

from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.box_scores import Matches
from boxreg_ros.structures import Floats, Ints, X, Y, YAW
import numpy as np
from numpy.typing import NDArray

DIFFERENCE_SECONDS = 0.3
"""Time that boxes are differenced over, up to the newest [s]; chosen: four boxes at 10 Hz."""
SMOOTHER_SECONDS = 0.5
"""The smoother uses the boxes up to this time before and after one [s]; chosen."""
LONGEST_TRUE_STEP = 0.6
"""True boxes farther from the next one have no true velocity [s]; chosen: keyframes at 2 Hz do."""
ROUNDING = 0.02
"""Tolerance of times, since clouds do not come at exact periods [s]; chosen."""

Rate = Callable[[Floats, Floats, int], Floats | None]
"""Returns rates (3,) of x y yaw of the box in a row, by times (n,) and places (n, 3)."""
Known = Mapping[tuple[int, str], NDArray[np.void]]
"""Records `KINEMATICS` by stamp and track id."""


class VelocityScores(NamedTuple):
    """Errors of the horizontal velocities of some boxes, and of their rates of yaw."""

    boxes: int
    mean: float  # norm of the error [m/s]
    median: float
    percentile_95: float
    yaw_rate: float  # mean absolute error [rad/s]


def velocity_scores(
    matches: Matches, predicted: BoxTable, truth: BoxTable, known: Known | None = None
) -> dict[str, VelocityScores]:
    """
    Return the scores by the way a velocity is found, over boxes that have one in each way.

    Boxes with a heading flip are left out of the rates of yaw. A true velocity is the central
    difference of true boxes.

    Parameters
    ----------
    matches : Matches
        Of `predicted` and `truth`.
    predicted, truth : BoxTable
        The boxes that were matched.
    known : mapping of (int, str) to record, optional
        `KINEMATICS` of predictions by stamp [ns] and track id.

    Returns
    -------
    scores : dict of str to VelocityScores
        ``difference``: of the boxes of a track over `DIFFERENCE_SECONDS`, up to the newest;
        ``smoother``: by a parabola through the boxes of a track around each, later ones included;
        ``estimate``: the velocity in `known`, if that is given.

    """
    rows = np.flatnonzero(matches.is_matched)
    true_rows, found_rows = matches.rows[rows], matches.predicted_rows[rows]
    true = _rates(truth, true_rows, _central)
    ways = {
        'difference': _rates(predicted, found_rows, _difference),
        'smoother': _rates(predicted, found_rows, _parabola),
    }
    if known is not None:
        ways['estimate'] = _known_rates(predicted, found_rows, known)
    is_compared = np.isfinite([true, *ways.values()]).all(axis=(0, 2))
    is_flipped = matches.is_flipped[rows][is_compared]
    return {
        name: _summary(rates[is_compared] - true[is_compared], is_flipped)
        for name, rates in ways.items()
    }


def table(groups: Mapping[str, VelocityScores]) -> str:
    """Return scores as a text table, one line per group and way."""
    width = max(map(len, groups))
    titles = ('boxes', 'mean', 'median', '95 %', 'yaw rate')
    lines = [' ' * width + ''.join(f'{title:>10}' for title in titles)]
    for name, scores in groups.items():
        numbers = ''.join(f'{value:10.3f}' for value in scores[1:])
        lines.append(f'{name:<{width}}{scores.boxes:10d}{numbers}')
    lines.append(
        f'errors of horizontal velocities [m/s] and rates of yaw [rad/s]: difference of boxes '
        f'over {DIFFERENCE_SECONDS} s, smoother of boxes within {SMOOTHER_SECONDS} s, estimate of '
        f'velocities.csv; true ones are central differences'
    )
    return '\n'.join(lines)


def _rates(boxes: BoxTable, wanted: Ints, rate: Rate) -> Floats:
    """Return the rates (n, 3) of x y yaw of some rows, NaN where they cannot be found."""
    found = np.full((len(wanted), 3), np.nan)
    places_of_row = {row: place for place, row in enumerate(wanted.tolist())}
    _, codes = np.unique(np.array(boxes.track_ids, str), return_inverse=True)
    order = np.lexsort((boxes.stamps_ns, codes))
    for rows in np.split(order, np.flatnonzero(np.diff(codes[order])) + 1):
        since = boxes.stamps_ns[rows] - boxes.stamps_ns[rows[:1]]
        times = since.astype(np.float64) * 1e-9
        places = boxes.boxes[rows][:, [X, Y, YAW]]
        # Half turns between boxes are flips, not motion.
        places[:, 2] = np.unwrap(places[:, 2], period=np.pi)
        for i, row in enumerate(rows.tolist()):
            rates = rate(times, places, i) if row in places_of_row else None
            if rates is not None:
                found[places_of_row[row]] = rates
    return found


def _central(times: Floats, places: Floats, i: int) -> Floats | None:
    if i == 0 or i + 1 == len(times) or np.diff(times[i - 1 : i + 2]).max() > LONGEST_TRUE_STEP:
        return None
    rates: Floats = (places[i + 1] - places[i - 1]) / (times[i + 1] - times[i - 1])
    return rates


def _difference(times: Floats, places: Floats, i: int) -> Floats | None:
    first = int(np.searchsorted(times, times[i] - DIFFERENCE_SECONDS - ROUNDING))
    if times[i] - times[first] < DIFFERENCE_SECONDS - ROUNDING:
        return None
    rates: Floats = (places[i] - places[first]) / (times[i] - times[first])
    return rates


def _parabola(times: Floats, places: Floats, i: int) -> Floats | None:
    is_near = np.abs(times - times[i]) <= SMOOTHER_SECONDS + ROUNDING
    if is_near.sum() < 3:
        return None
    seconds = times[is_near] - times[i]
    slope: Floats = np.linalg.lstsq(np.vander(seconds, 3), places[is_near], rcond=None)[0][1]
    return slope


def _known_rates(boxes: BoxTable, wanted: Ints, known: Known) -> Floats:
    found = np.full((len(wanted), 3), np.nan)
    for place, row in enumerate(wanted.tolist()):
        record = known.get((int(boxes.stamps_ns[row]), boxes.track_ids[row]))
        if record is not None:
            found[place] = record['velocity'][[0, 1, 3]]
    return found


def _summary(errors: Floats, is_flipped: NDArray[np.bool_]) -> VelocityScores:
    if not len(errors):
        return VelocityScores(0, *[math.nan] * 4)
    norms = np.linalg.norm(errors[:, :2], axis=1)
    of_yaw = np.abs(errors[~is_flipped, 2])
    return VelocityScores(
        len(errors),
        float(norms.mean()),
        float(np.median(norms)),
        float(np.percentile(norms, 95)),
        float(of_yaw.mean()) if len(of_yaw) else math.nan,
    )


def beside(first: Sequence[tuple[str, Mapping[str, VelocityScores]]]) -> dict[str, VelocityScores]:
    """Return the scores of several sources of boxes as one table, named by both."""
    return {f'{source}, {way}': scores for source, of in first for way, scores in of.items()}
