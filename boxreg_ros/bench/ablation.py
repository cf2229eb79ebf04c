"""
`boxreg bench ablation`: the registration with each of its ingredients off, and what that costs.

An ingredient is switched off by settings, where there are any for it. The others have no switch
in the core, and get none: here a function or a constant of it is replaced while a run lasts.

"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, ExitStack
from dataclasses import asdict, dataclass, field
from math import inf
import sys
from types import ModuleType
from typing import Any

from boxreg_ros.bench.common import add_scope_arguments, in_scope, line, print_json
from boxreg_ros.config import Config
from boxreg_ros.core import face_support as correspondence
from boxreg_ros.core import input_model as calibration
from boxreg_ros.core import observation as sampling
from boxreg_ros.core import registrar, registration, window
from boxreg_ros.core.objective import BIAS, Problem, SHARED
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.drive import Drive
from boxreg_ros.offline.evaluate import Scores, summarise
from boxreg_ros.structures import Floats, Ints, Sweep, YAW
import numpy as np
from numpy.typing import NDArray
import torch
from torch import Tensor
from tqdm import tqdm

KINDS = ('vehicle', 'cyclist', 'pedestrian')
WHOLE = 'nothing'
COLUMNS = ('BEV', '3D', 'R@0.8', 'flips')


@dataclass(frozen=True, slots=True)
class Ingredient:
    """
    What can be switched off.

    Attributes
    ----------
    meaning : str
        What is done instead.
    settings : mapping
        Settings that do it, by dotted name.
    replaced : tuple of (module or class, str, value)
        What is replaced in the core, where no setting does it.

    """

    meaning: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    replaced: tuple[tuple[ModuleType | type, str, Any], ...] = ()


def _every_kind(**values: float) -> dict[str, float]:
    """Return settings of how objects move, the same for all kinds of them."""
    return {f'{kind}.{name}': value for kind in KINDS for name, value in values.items()}


def _without_bias(problem: Problem, config: Config) -> Tensor:
    """Stand in for `free_variables`: the bias stays at the 0 that is expected of it."""
    free = _free_variables(problem, config)
    free[:, BIAS.start - SHARED : BIAS.stop - SHARED] = 0.0
    return free


def _each_alone(
    sweep: Sweep, boxes: Floats, stamp_ns: int, config: Config
) -> list[sampling.Observation]:
    """Stand in for `observe`: a box knows of no other that could own its points."""
    return [seen for box in boxes for seen in sampling.observe(sweep, box[None], stamp_ns, config)]


def _no_road(heights: Floats, owner: Ints, n: int) -> Floats:
    """Stand in for `_flat_heights`: none is seen."""
    return np.full(n, np.nan)


def _as_given(boxes: Floats, *_: NDArray[Any]) -> Floats:
    """Stand in for `resolve_headings`: headings keep their signs."""
    return np.unwrap(boxes[..., YAW])


def _sharp(problem: Problem, openness: Tensor) -> Tensor:
    """Stand in for `retreat`: hidden faces are like open ones."""
    return _retreat(problem, openness) * torch.tensor([0.0, 1.0])[:, None, None, None]


_free_variables, _retreat = registration.free_variables, correspondence.retreat
LOOSE = 1e3  # highest bound of the deviations of motion
INGREDIENTS = {
    WHOLE: Ingredient('all is on'),
    'points': Ingredient(
        'faces and shape tell nothing: motion and input alone',
        {f'faces.{name}': 10.0 for name in ('ends', 'sides', 'top', 'bottom')}
        | _every_kind(shape=1.0),
    ),
    'rigid shape': Ingredient('the points of a track need not agree', _every_kind(shape=1.0)),
    'learnt gaps': Ingredient('the expected annotation rule holds', {'faces.learn': False}),
    'strips': Ingredient(
        'the outermost points of a face may all be at one end of it',
        replaced=((correspondence, 'STRIPS', 1),),
    ),
    'hidden faces': Ingredient(
        'a face behind its edge tells nothing', replaced=((correspondence, 'VEILED', 0.0),)
    ),
    'round edges': Ingredient(
        'points stand no further in on faces seen from the side or behind',
        {'faces.depth_ends': 0.0, 'faces.depth_sides': 0.0},
        replaced=((correspondence, 'retreat', _sharp),),
    ),
    'distance': Ingredient(
        'points stand no further in on faces far away',
        replaced=((correspondence, 'DISTANCE', (inf, 1.0)),),
    ),
    'measured noise': Ingredient(
        'the input errs as the settings say',
        replaced=((calibration.InputNoise, 'measure', classmethod(lambda cls, scatter: cls())),),
    ),
    'bias': Ingredient(
        'errors of the input have no constant part',
        replaced=((registration, 'free_variables', _without_bias),),
    ),
    'memory': Ingredient(
        'live, what has left the window is forgotten', replaced=((window, 'PRIOR_DECAY', 0.0),)
    ),
    'extents of others': Ingredient(
        'extents are expected as the input has them', replaced=((calibration, 'SLOPES', 1e-9),)
    ),
    'one extent': Ingredient('each box keeps the extent of its input', {'extent': 'fixed'}),
    'ownership': Ingredient(
        "a neighbour's points count too", replaced=((registrar, 'observe', _each_alone),)
    ),
    'road': Ingredient(
        'the bottom is seen nowhere', replaced=((sampling, '_flat_heights', _no_road),)
    ),
    'smoothness': Ingredient(
        'any acceleration is as likely',
        _every_kind(
            acceleration=LOOSE, cornering=LOOSE, vertical=LOOSE, turning=LOOSE, tilting=LOOSE
        ),
    ),
    'yielding': Ingredient(
        'motion has its full say, whatever boxes and points say',
        replaced=((registration, 'SWERVE', inf),),
    ),
    'slip and pivot': Ingredient(
        'heading and motion have nothing to do with each other',
        _every_kind(slip=LOOSE, climb=LOOSE),
    ),
    'parked': Ingredient('what is parked moves like the rest', _every_kind(drift=1.0)),
    'heading sign': Ingredient(
        'turned headings stay', replaced=((window, 'resolve_headings', _as_given),)
    ),
    'robust weights': Ingredient(
        'outliers have their full say',
        {'faces.outlier': 10.0},
        replaced=(
            (registration, 'PRIOR_OUTLIER', inf),
            (registration, 'GAP_OUTLIER', inf),
        ),
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
        help='which boxes: newest, `lag` later, or of whole tracks (default: track)',
    )  # fmt: skip
    parser.add_argument('--json', action='store_true', help='print one JSON object')


def run(args: argparse.Namespace) -> int:
    """Print, for every recording and on average, what each ingredient is worth."""
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
    print(f'Estimate {args.estimate}; in brackets what it costs. Without')
    for name in args.without:
        print(f'  {name}: {INGREDIENTS[name].meaning}')
    return 0


def without(ingredient: Ingredient, drive: Drive, estimate: str = 'track') -> BoxTable:
    """Return the boxes of an estimate with an ingredient off."""
    run = 'track' if estimate == 'track' else 'final'  # which has the early ones too
    config = Config(estimate=run).updated(ingredient.settings)
    with ExitStack() as stack:
        for place, name, value in ingredient.replaced:
            stack.enter_context(_replaced(place, name, value))
        return drive.registered(config)[estimate]


def figures(scores: Scores) -> list[float]:
    """Return those of `COLUMNS`."""
    return [scores.iou_bev, scores.iou_3d, scores.recall_3d[-1], scores.flips]


def table(rows: Mapping[str, Sequence[float]]) -> list[str]:
    """Return lines of figures, each followed by how much worse it is than that of `WHOLE`."""
    lines = [line('without', [cell for name in COLUMNS for cell in (name, '')])]
    for name, row in rows.items():
        worse = np.subtract(rows[WHOLE], row) * [1, 1, 1, -1]  # of flips, more are worse
        costs = ['' if name == WHOLE else f'({cost:+.3f})' for cost in worse.round(3) + 0.0]
        pairs = zip(row, costs, strict=True)
        lines.append(line(name, [cell for pair in pairs for cell in pair]))
    return lines


@contextmanager
def _replaced(place: ModuleType | type, name: str, value: Any) -> Iterator[None]:
    """Put `value` in the place of a function or constant, until the end of the context."""
    was = vars(place)[name]
    setattr(place, name, value)
    try:
        yield
    finally:
        setattr(place, name, was)
