"""
`boxreg bench ablation`: accuracy with each ingredient of the method switched off.

An ingredient is switched off by settings, or by one of `config.Ingredients`: each of the
residuals of `core.method.residuals` by its name. Both estimates are measured, since some
ingredients are part of one only.

"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from boxreg_ros.bench.common import add_scope_arguments, in_scope, line, print_json, progress_bar
from boxreg_ros.config import Config
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.box_scores import Scores, summarise
from boxreg_ros.offline.drive import Drive
import numpy as np

WHOLE = 'nothing'
SCORES = ('BEV', '3D', 'R@0.8', 'flips')
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
    'points': Ingredient(
        'faces and rigid shape have no weight: motion and input alone',
        {'faces.ends': 10.0, 'faces.sides': 10.0} | _off('road') | _without('rigid shape'),
    ),
    'rigid shape': Ingredient(
        'points of a track are not tied to one rigid shape', _without('rigid shape')
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
    'smoothness': Ingredient('accelerations have no weight', _without('acceleration')),
    'robust motion': Ingredient('motion residuals are not robust', _off('robust_motion')),
    'slip and pivot': Ingredient(
        'sideways and vertical velocities have no weight', _without('slip')
    ),
    'zero motion': Ingredient('parked objects have no zero-motion prior', _without('zero motion')),
    'heading sign': Ingredient('180° flips stay', _off('heading_sign')),
    'robust weights': Ingredient('outliers have full weight', _off('robust_weights')),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `boxreg bench ablation`."""
    add_scope_arguments(parser)
    parser.add_argument(
        '--without', nargs='+', choices=list(INGREDIENTS)[1:], default=list(INGREDIENTS)[1:],
        metavar='INGREDIENT', help=f'only some of {", ".join(list(INGREDIENTS)[1:])}',
    )  # fmt: skip
    parser.add_argument(
        '--estimate', nargs='+', choices=('early', *ABLATED_ESTIMATES), default=ABLATED_ESTIMATES,
        help='early (newest box), final (fixed lag), track (full sequence); default: final track',
    )  # fmt: skip
    parser.add_argument(
        '--greedy', type=float, metavar='LOSS',
        help='also leave out the ingredient that costs least on average, then the next one beside '
        'it, as long as the mean 3D IoU of an estimate falls by less than this',
    )  # fmt: skip
    parser.add_argument('--json', action='store_true', help='print one JSON object')


def run(args: argparse.Namespace) -> int:
    """Print accuracy without each ingredient, for every recording and on average."""
    drives = {str(folder): Drive.read(folder) for folder in args.data}
    wanted = [WHOLE, *args.without]
    report: dict[str, dict[str, dict[str, Scores]]] = {folder: {} for folder in drives}
    total = len(drives) * len(args.estimate) * len(wanted)
    with progress_bar(total, args) as bar:
        for folder, drive in drives.items():
            for estimate in args.estimate:
                report[folder][estimate] = {}
                for name in wanted:
                    found = without(INGREDIENTS[name].settings, drive, estimate)
                    scores = summarise(in_scope(found, drive.truth, args))
                    report[folder][estimate][name] = scores
                    bar.update()
    order = greedy(drives, report, args) if args.greedy is not None else []
    if args.json:
        plain: dict[str, Any] = {
            folder: {
                estimate: {name: asdict(scores) for name, scores in rows.items()}
                for estimate, rows in found.items()
            }
            for folder, found in report.items()
        }
        print_json(plain | {'greedy': order} if order else plain)
        return 0
    for estimate in args.estimate:
        _print_estimate(estimate, {folder: found[estimate] for folder, found in report.items()})
    for names, loss in order:
        print(f'{loss:+.4f} without {names}')
    print('In brackets the loss. Without')
    for name in args.without:
        print(f'  {name}: {INGREDIENTS[name].meaning}')
    return 0


def _print_estimate(estimate: str, report: Mapping[str, Mapping[str, Scores]]) -> None:
    """Print the tables of one estimate: of each recording, and of their mean."""
    for folder, rows in report.items():
        print(f'{folder}, {estimate}: {rows[WHOLE].boxes} true boxes')
        print('\n'.join(table({name: figures(scores) for name, scores in rows.items()})) + '\n')
    if len(report) > 1:
        means = {
            name: np.mean([figures(rows[name]) for rows in report.values()], axis=0).tolist()
            for name in next(iter(report.values()))
        }
        print(f'mean of {len(report)} recordings, {estimate}')
        print('\n'.join(table(means)) + '\n')


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
            scores = [
                summarise(in_scope(without(settings, drive, estimate), drive.truth, args)).iou_3d
                for drive in drives.values()
            ]
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
