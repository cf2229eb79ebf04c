"""
`boxreg bench ablation`: accuracy with each ingredient of the method switched off.

An ingredient is switched off by settings, or by one of `config.Ingredients`.

"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
import sys
from typing import Any

from boxreg_ros.bench.common import add_scope_arguments, in_scope, line, print_json
from boxreg_ros.config import Config, KINDS
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.box_scores import Scores, summarise
from boxreg_ros.offline.drive import Drive
import numpy as np
from tqdm import tqdm

WHOLE = 'nothing'
SCORES = ('BEV', '3D', 'R@0.8', 'flips')
UNLIMITED = 1e3
"""Highest bound of the deviations of motion: the residual has no weight."""


@dataclass(frozen=True, slots=True)
class Ingredient:
    """
    A part of the method that can be switched off.

    Attributes
    ----------
    meaning : str
        Description of the method without it.
    settings : mapping
        Values of `Config` that switch it off, by dotted name.

    """

    meaning: str
    settings: Mapping[str, Any]


def _every_kind(**values: float) -> dict[str, float]:
    """Return settings of `ClassConfig`, the same for all kinds of objects."""
    return {f'{kind}.{name}': value for kind in KINDS for name, value in values.items()}


def _off(*names: str) -> dict[str, bool]:
    """Return the settings that switch `Ingredients` off."""
    return {f'ingredients.{name}': False for name in names}


INGREDIENTS = {
    WHOLE: Ingredient('every ingredient is on', {}),
    'points': Ingredient(
        'faces and rigid shape have no weight: motion and input alone',
        {f'faces.{name}': 10.0 for name in ('ends', 'sides', 'top', 'bottom')}
        | _every_kind(shape=1.0),
    ),
    'rigid shape': Ingredient(
        'points of a track are not tied to one rigid shape', _every_kind(shape=1.0)
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
    'smoothness': Ingredient(
        'accelerations have no weight',
        _every_kind(
            acceleration=UNLIMITED,
            cornering=UNLIMITED,
            vertical=UNLIMITED,
            turning=UNLIMITED,
            tilting=UNLIMITED,
        ),
    ),
    'robust motion': Ingredient('motion residuals are not robust', _off('robust_motion')),
    'slip and pivot': Ingredient(
        'sideways and vertical velocities have no weight',
        _every_kind(slip=UNLIMITED, climb=UNLIMITED),
    ),
    'zero motion': Ingredient('parked objects have no zero-motion prior', _every_kind(drift=1.0)),
    'heading sign': Ingredient('180° flips stay', _off('heading_sign')),
    'robust weights': Ingredient(
        'outliers have full weight', {'faces.outlier': 10.0} | _off('robust_weights')
    ),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `boxreg bench ablation`."""
    add_scope_arguments(parser)
    parser.add_argument(
        '--without', nargs='+', choices=list(INGREDIENTS)[1:], default=list(INGREDIENTS)[1:],
        metavar='INGREDIENT', help=f'only some of {", ".join(list(INGREDIENTS)[1:])}',
    )  # fmt: skip
    parser.add_argument(
        '--estimate', choices=('early', 'final', 'track'), default='track',
        help='early (newest box), final (fixed lag) or track (full sequence); default: track',
    )  # fmt: skip
    parser.add_argument('--json', action='store_true', help='print one JSON object')


def run(args: argparse.Namespace) -> int:
    """Print accuracy without each ingredient, for every recording and on average."""
    report: dict[str, dict[str, Scores]] = {}
    wanted = [WHOLE, *args.without]
    quiet = args.json or not sys.stderr.isatty()
    with tqdm(total=len(args.data) * len(wanted), leave=False, disable=quiet) as bar:
        for folder in args.data:
            drive = Drive.read(folder)
            report[str(folder)] = {}
            for name in wanted:
                found = without(INGREDIENTS[name], drive, args.estimate)
                scores = summarise(in_scope(found, drive.truth, args))
                report[str(folder)][name] = scores
                bar.update()
    if args.json:
        plain = {
            folder: {name: asdict(scores) for name, scores in rows.items()}
            for folder, rows in report.items()
        }
        print_json(plain)
        return 0
    for folder, rows in report.items():
        print(f'{folder}: {rows[WHOLE].boxes} true boxes')
        print('\n'.join(table({name: figures(scores) for name, scores in rows.items()})) + '\n')
    if len(report) > 1:
        means = {
            name: np.mean([figures(rows[name]) for rows in report.values()], axis=0).tolist()
            for name in wanted
        }
        print(f'mean of {len(report)} recordings')
        print('\n'.join(table(means)) + '\n')
    print(f'Estimate {args.estimate}; in brackets the loss. Without')
    for name in args.without:
        print(f'  {name}: {INGREDIENTS[name].meaning}')
    return 0


def without(ingredient: Ingredient, drive: Drive, estimate: str = 'track') -> BoxTable:
    """Return the boxes of an estimate with an ingredient switched off."""
    run = 'track' if estimate == 'track' else 'final'  # one run gives final and early boxes
    config = Config(estimate=run).updated(ingredient.settings)
    return drive.registered(config)[estimate]


def figures(scores: Scores) -> list[float]:
    """Return the scores of `SCORES`."""
    return [scores.iou_bev, scores.iou_3d, scores.recall_3d[-1], scores.flips]


def table(rows: Mapping[str, Sequence[float]]) -> list[str]:
    """Return lines of scores, each followed by its loss against that of `WHOLE`."""
    lines = [line('without', [cell for name in SCORES for cell in (name, '')])]
    for name, row in rows.items():
        worse = np.subtract(rows[WHOLE], row) * [1, 1, 1, -1]  # more flips are worse
        costs = ['' if name == WHOLE else f'({cost:+.3f})' for cost in worse.round(3) + 0.0]
        pairs = zip(row, costs, strict=True)
        lines.append(line(name, [cell for pair in pairs for cell in pair]))
    return lines
