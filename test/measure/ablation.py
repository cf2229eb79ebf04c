"""
`measure ablation`: accuracy with each ingredient of the method switched off.

An ingredient is switched off by settings, or by one of `config.Ingredients`: each of the
residuals of `core.method.residuals` by its name. Both estimates are measured, since some
ingredients are part of one only. Losses have standard errors over tracks and draws.

"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.core.method.constants import RESIDUAL_NAMES
from boxreg_ros.errors import ConfigError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.structures import Floats
from measure import RECORDINGS
from measure.common import in_scope, SCOPE
from measure.drives import Drive
import numpy as np
from numpy.typing import NDArray

WHOLE = 'nothing'
ABLATED_ESTIMATES = ('final', 'track')


@dataclass(frozen=True, slots=True)
class Ingredient:
    """A part of the method that can be switched off."""

    meaning: str  # description of the method without it
    settings: Mapping[str, Any]  # values of `Config` that switch it off, by dotted name


def _without(*names: str) -> dict[str, tuple[str, ...]]:
    """Return the setting that leaves residuals out."""
    return {'ingredients.without': names}


def _off(*names: str) -> dict[str, bool]:
    """Return the settings that switch `Ingredients` off."""
    return {f'ingredients.{name}': False for name in names}


INGREDIENTS = {
    WHOLE: Ingredient('every ingredient is on', {}),
    **{
        name: Ingredient(f'the residual {name} has no weight', _without(name))
        for name in RESIDUAL_NAMES
    },
    'points': Ingredient(
        'faces and rigid shape have no weight: motion and input alone',
        {'faces.ends': 10.0, 'faces.sides': 10.0} | _off('road') | _without('rigid shape'),
    ),
    'learnt margins': Ingredient(
        'labelling margins are those of the settings', {'faces.learn': False}
    ),
    'strips': Ingredient(
        'outermost points are taken from a whole face, not from each of its strips', _off('strips')
    ),
    'occluded faces': Ingredient('occluded faces have no weight', _off('occluded_faces')),
    'occlusion inset': Ingredient(
        'points of occluded faces have no inset',
        {'faces.inset_ends': 0.0, 'faces.inset_sides': 0.0},
    ),
    'ring inset': Ingredient('the highest points are at the top', _off('ring_inset')),
    'range inset': Ingredient('points of distant faces have no inset', _off('range_inset')),
    'noise estimation': Ingredient(
        'the input has the errors of the settings', _off('noise_estimation')
    ),
    'input bias': Ingredient('errors of the input have no constant part', _off('input_bias')),
    'marginalisation': Ingredient(
        'observations that leave a sliding window are dropped', _off('marginalisation')
    ),
    'population extents': Ingredient(
        'extents are expected as in the input', _off('population_extents')
    ),
    'one extent': Ingredient('each box keeps the extent of its input', {'extent': 'fixed'}),
    'point ownership': Ingredient(
        'boxes also use the points of their neighbours', _off('point_ownership')
    ),
    'road': Ingredient('the bottom face is never observed', _off('road')),
    'robust motion': Ingredient('motion residuals are not robust', _off('robust_motion')),
    'heading sign': Ingredient('180° flips stay', _off('heading_sign')),
    'robust weights': Ingredient('outliers have full weight', _off('robust_weights')),
}


ARGUMENTS = {
    'data': RECORDINGS,
    **SCOPE,
    '--without': (
        [*INGREDIENTS][1:],
        'only some of the ingredients',
        {'nargs': '+', 'choices': [*INGREDIENTS][1:], 'metavar': 'INGREDIENT'},
    ),
    '--estimate': (
        [*ABLATED_ESTIMATES],
        'early (newest box), final (fixed lag), track (full sequence)',
        {'nargs': '+', 'choices': ('early', *ABLATED_ESTIMATES)},
    ),
    '--draws': (1, 'draws of the errors of the input: those of the recording, and simulated ones'),
}


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Return the losses without each ingredient, of each estimate on each recording."""
    if args.draws < 1:
        raise ConfigError(f'--draws: expected 1 or more, got {args.draws}')
    report: dict[str, Any] = {}
    for folder in args.data:
        drive = Drive.read(folder)
        drives = [drive, *(drive.redrawn(seed) for seed in range(1, args.draws))]
        report[str(folder)] = {
            estimate: _losses(drives, estimate, args) for estimate in args.estimate
        }
    return report


def _losses(
    drives: Sequence[Drive], estimate: str, args: argparse.Namespace
) -> dict[str, dict[str, float]]:
    """Return 3D IoU, its loss and the error of that without each ingredient, over some draws."""

    def ious(settings: Mapping[str, Any]) -> Floats:
        return np.array([
            in_scope(without(settings, drive, estimate), drive.truth, args).iou_3d
            for drive in drives
        ])  # fmt: skip

    truth = drives[0].truth
    tracks = np.array(truth.track_ids)[in_scope(truth, truth, args).rows]
    whole = ious({})
    rows = {}
    for name in (WHOLE, *args.without):
        found = whole if name == WHOLE else ious(INGREDIENTS[name].settings)
        rows[name] = {
            'iou_3d': float(found.mean()),
            'loss': float((whole - found).mean()),
            'loss_error': standard_error(whole - found, tracks),
        }
    return rows


def standard_error(values: Floats, tracks: NDArray[np.str_]) -> float:
    """
    Return the standard error of the mean of `values` (D, n) of D draws and n boxes of `tracks`.

    The boxes of a track are no independent evidence, nor are those of a draw, which share what is
    estimated of the input: clusters cross (Cameron, Gelbach & Miller, Journal of Business &
    Economic Statistics 29, 2011). With one draw tracks alone count.

    """
    off = values - values.mean()
    names, track = np.unique(tracks, return_inverse=True)
    cells = np.array([np.bincount(track, row, len(names)) for row in off])  # (D, tracks)
    by_track, by_draw, by_both = map(_sum_of_squares, (cells.sum(0), cells.sum(1), cells.ravel()))
    return float(np.sqrt(max(by_track, by_track + by_draw - by_both)) / values.size)


def _sum_of_squares(sums: Floats) -> float:
    """Return the sum of squares of the sums of n clusters, as of a variance."""
    return float(np.square(sums).sum() * len(sums) / max(len(sums) - 1, 1))


def without(settings: Mapping[str, Any], drive: Drive, estimate: str = 'track') -> BoxTable:
    """Return the boxes of an estimate with the settings that switch an ingredient off."""
    run = 'track' if estimate == 'track' else 'final'  # one run gives final and early boxes
    return drive.registered(Config(estimate=run).updated(settings))[estimate]
