"""
`measure ablation`: accuracy with each ingredient of the method switched off.

An ingredient is switched off by settings, or by one of `config.Ingredients`: each of the
residuals of `core.method.residuals` by its name. Both estimates are measured, since some
ingredients are part of one only.

"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.core.method.constants import RESIDUAL_NAMES
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.box_scores import Scores, summarise
from measure import RECORDINGS
from measure.common import in_scope, SCOPE
from measure.drives import Drive
import numpy as np

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
    '--greedy': (
        float,
        'also leave out the ingredient that costs least on average, then the next one beside it, '
        'as long as the mean 3D IoU of an estimate falls by less than this',
        {'metavar': 'LOSS'},
    ),
}


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Return the scores without each ingredient, of each estimate on each recording."""
    drives = {str(folder): Drive.read(folder) for folder in args.data}
    report = {
        folder: {
            estimate: {
                name: _scores(INGREDIENTS[name].settings, drive, estimate, args)
                for name in (WHOLE, *args.without)
            }
            for estimate in args.estimate
        }
        for folder, drive in drives.items()
    }
    plain: dict[str, Any] = {
        folder: {
            estimate: {name: asdict(scores) for name, scores in rows.items()}
            for estimate, rows in found.items()
        }
        for folder, found in report.items()
    }
    if args.greedy is not None:
        plain['greedy'] = greedy(drives, report, args)
    return plain


def _scores(
    settings: Mapping[str, Any], drive: Drive, estimate: str, args: argparse.Namespace
) -> Scores:
    """Return the scores of an estimate with settings that switch ingredients off."""
    return summarise(in_scope(without(settings, drive, estimate), drive.truth, args))


def greedy(
    drives: Mapping[str, Drive],
    report: Mapping[str, Mapping[str, Mapping[str, Scores]]],
    args: argparse.Namespace,
) -> list[tuple[str, float]]:
    """Leave the cheapest ingredient out, again and again; return names so far and their loss."""
    whole = {
        estimate: np.mean([found[estimate][WHOLE].iou_3d for found in report.values()])
        for estimate in args.estimate
    }

    def loss(names: Sequence[str]) -> float:
        settings = merged([INGREDIENTS[name].settings for name in names])
        losses = []
        for estimate in args.estimate:
            scores = [_scores(settings, drive, estimate, args).iou_3d for drive in drives.values()]
            losses.append(whole[estimate] - np.mean(scores))
        return float(max(losses))

    left, out = [*args.without], list[str]()
    order = []
    while left:
        costs = {name: loss([*out, name]) for name in left}
        cheapest = min(costs, key=lambda name: costs[name])
        if costs[cheapest] > args.greedy:
            break
        left.remove(cheapest)
        out.append(cheapest)
        order.append((', '.join(out), costs[cheapest]))
    return order


def merged(settings: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the settings that switch several ingredients off; residuals add up."""
    found: dict[str, Any] = {}
    for one in settings:
        for name, value in one.items():
            found[name] = (*found.get(name, ()), *value) if isinstance(value, tuple) else value
    return found


def without(settings: Mapping[str, Any], drive: Drive, estimate: str = 'track') -> BoxTable:
    """Return the boxes of an estimate with the settings that switch an ingredient off."""
    run = 'track' if estimate == 'track' else 'final'  # one run gives final and early boxes
    return drive.registered(Config(estimate=run).updated(settings))[estimate]
