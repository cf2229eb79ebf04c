"""
`measure sensitivity`: loss of accuracy when a setting or a constant is halved or doubled.

Settings are the numbers of `Config`, constants those of `boxreg_ros.core.method.constants`. Both
are discovered, so a new one is measured without an entry here.

A number without effect on any data set should be removed, one that must be exact should be
estimated from the data.

"""

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from fnmatch import fnmatch
from functools import partial
from multiprocessing import get_context
from typing import NamedTuple

from boxreg_ros.config import Config, KINDS
from boxreg_ros.core.method import constants
from boxreg_ros.errors import ConfigError
from boxreg_ros.offline.box_scores import match, summarise
from measure import RECORDINGS
from measure.common import class_words, SCOPE
from measure.drives import Drive
import numpy as np
import torch

FACTORS = (0.5, 2.0)
PAPER = 'paper'
"""The objective of the paper, and the group of settings that it alone reads."""

UNLIKE = Config().updated(
    {'faces.ends': 1.0, 'faces.sides': 1.0}
    | {f'ingredients.{name}': False for name in ('strips', 'robust_motion')}
)
"""A configuration that differs from the default one in all that `with_settings` fills."""


class Variation(NamedTuple):
    """One number with another value, within its bounds."""

    name: str  # dotted, of a setting; or that of a constant
    factor: float  # that was asked for: one of `FACTORS`
    default: float
    value: float
    place: tuple | None = None  # field of a constant, and its place in a tuple


class Measurement(NamedTuple):
    """Settings that are varied, and the scope of the boxes that count, as in `match`."""

    config: Config
    estimate: str
    min_points: int
    classes: Sequence[str]


class Outcome(NamedTuple):
    """Mean IoU of a run; NaN and the reason where the run failed."""

    iou_bev: float
    iou_3d: float
    failure: str = ''


class Loss(NamedTuple):
    """Loss of the mean IoU of all data sets by one variation; negative for a gain."""

    name: str
    factor: float
    default: float
    value: float
    bev: float
    volume: float
    failure: str = ''

    @property
    def size(self):
        """Return the larger of the two losses; infinite where a run failed."""
        return float('inf') if self.failure else max(self.bev, self.volume)


# ------------------------------------------------------------------------------- discovery


def variations_of_settings(config, kinds=KINDS):
    """
    Return every numeric setting halved and doubled.

    Left out are settings of the paper's objective where it is not in use, of kinds of objects
    that are not in `kinds`, and values that the bounds or rounding leave as they are.

    """
    unread = set(KINDS) - set(kinds)
    if config.objective != PAPER:
        unread.add(PAPER)
    found = []
    for item, default in config.items():
        group = item.name.partition('.')[0]
        if type(default) not in (int, float) or group in unread:
            continue
        for factor in FACTORS:
            value = _within_bounds(item, _scaled(default, factor))
            if value != default and _is_allowed(config, item.name, value):
                found.append(Variation(item.name, factor, default, value))
    return found


def _is_allowed(config, name, value):
    """Return whether a setting may have a value together with the others."""
    try:
        config.updated({name: value})
    except ConfigError:
        return False
    return True


def _within_bounds(item, value):
    low = value if item.low is None else max(value, type(value)(item.low))
    return low if item.high is None else min(low, type(value)(item.high))


def _scaled(value, factor):
    """Return a number times a factor; a whole number stays whole and above zero."""
    if isinstance(value, int):
        return max(1, round(value * factor)) if value > 0 else round(value * factor)
    return value * factor


def variations_of_constants():
    """Return every number of `Constants` that is no setting, halved and doubled."""
    known = constants.CONSTANTS
    of_settings = known.with_settings(UNLIKE)
    found = []
    for name, default in known._asdict().items():
        numbers, filled = np.atleast_1d(default), np.atleast_1d(getattr(of_settings, name))
        for place, number in enumerate(numbers.tolist()):
            if isinstance(number, bool) or filled[place] != number:
                continue
            label = f'{name}[{place}]' if isinstance(default, tuple) else name
            for factor in FACTORS:
                value = _scaled(number, factor)
                if value != number:
                    found.append(Variation(label, factor, number, value, (name, place)))
    return found


@contextmanager
def changed_constant(place, value):
    """Replace one number of `Constants`, or one number of a tuple among them, for a context."""
    before = constants.CONSTANTS
    name, i = place
    default = getattr(before, name)
    changed = (*default[:i], value, *default[i + 1 :]) if isinstance(default, tuple) else value
    constants.CONSTANTS = before._replace(**{name: changed})
    try:
        yield
    finally:
        constants.CONSTANTS = before


# ----------------------------------------------------------------------------------- runs


def measure(drive, measurement, variation):
    """Return the mean IoU of one run."""
    config = measurement.config
    estimate = measurement.estimate
    try:
        if variation is None:
            predicted = drive.registered(config)[estimate]
        elif variation.place is None:
            config = config.updated({variation.name: variation.value})
            predicted = drive.registered(config)[estimate]
        else:
            with changed_constant(variation.place, variation.value):
                predicted = drive.registered(config)[estimate]
        scope = (measurement.min_points, measurement.classes)
        scores = summarise(match(predicted, drive.truth, *scope))
    except Exception as error:  # a number out of its range may fail anywhere in the core
        return Outcome(np.nan, np.nan, f'{type(error).__name__}: {error}'.splitlines()[0])
    return Outcome(scores.iou_bev, scores.iou_3d)


def run_all(drives, measurement, variations, args):
    """Return the outcome of each drive without variation, and per variation those of all."""
    wanted = [None, *variations]
    jobs = [(name, variation) for variation in wanted for name in drives]
    initial = (dict(drives), measurement)
    # Fresh processes: each has the memory of one run, and no threads are copied into it.
    context = get_context('spawn')
    with ProcessPoolExecutor(args.workers, context, _start_worker, initial) as pool:
        outcomes = list(pool.map(_work, jobs))
    rows = [outcomes[i : i + len(drives)] for i in range(0, len(jobs), len(drives))]
    return dict(zip(drives, rows[0], strict=True)), rows[1:]


_worker = {}


def _start_worker(drives, measurement):
    torch.set_num_threads(1)
    _worker['run'] = {name: partial(measure, drive, measurement) for name, drive in drives.items()}


def _work(job):
    name, variation = job
    outcome = _worker['run'][name](variation)
    return outcome


def losses(variations, baseline, outcomes):
    """Return the loss of each variation on the mean of the drives, the largest one first."""
    bev = np.mean([outcome.iou_bev for outcome in baseline.values()])
    volume = np.mean([outcome.iou_3d for outcome in baseline.values()])
    found = []
    for variation, row in zip(variations, outcomes, strict=True):
        failures = [outcome.failure for outcome in row if outcome.failure]
        means = np.mean([outcome[:2] for outcome in row], axis=0)
        lost = bev - means[0], volume - means[1]
        found.append(Loss(*variation[:4], *map(float, lost), failures[0] if failures else ''))
    return sorted(found, key=lambda loss: -loss.size)


def add_estimate_argument(parser):
    """Declare which estimate of a box is measured."""
    parser.add_argument(
        '--estimate', choices=('early', 'final', 'track'), default='track',
        help='early: newest box of its window; final: `lag` observations later; '
        'track: from the whole track (default: track)',
    )  # fmt: skip


# --------------------------------------------------------------------------------- command
ARGUMENTS = {
    'data': RECORDINGS,
    **SCOPE,
    '--estimate': add_estimate_argument,
    '--objective': ('robust', 'that whose numbers are varied', {'choices': ('robust', PAPER)}),
    '--only': (['*'], "names, as in 'faces.*' or 'parked_*'", {'nargs': '+'}),
    '--workers': (2, 'runs at a time'),
}


def run(args):
    """Return the loss of mean IoU by each variation."""
    if args.workers < 1:
        raise ConfigError(f'--workers: expected 1 or more, got {args.workers}')
    drives = {str(folder): Drive.read(folder) for folder in args.data}
    arrays = [array for drive in drives.values() for array in drive.boxes]
    # The run for the final estimate has the early one too.
    run_estimate = 'track' if args.estimate == 'track' else 'final'
    config = Config(objective=args.objective, estimate=run_estimate)
    measurement = Measurement(config, args.estimate, args.min_points, class_words(args))
    everything = [
        *variations_of_settings(config, kinds_of(arrays, config)),
        *variations_of_constants(),
    ]
    chosen = [
        variation
        for variation in everything
        if any(fnmatch(variation.name, pattern) for pattern in args.only)
    ]
    if not chosen:
        names = ', '.join(dict.fromkeys(variation.name for variation in everything))
        raise ConfigError(f'--only {" ".join(args.only)}: matches none of {names}')
    baseline, outcomes = run_all(drives, measurement, chosen, args)
    found = losses(chosen, baseline, outcomes)
    return {
        'objective': args.objective,
        'estimate': args.estimate,
        'baseline': {name: outcome._asdict() for name, outcome in baseline.items()},
        'losses': [loss._asdict() for loss in found],
    }


def kinds_of(arrays, config):
    """Return the kinds of objects that are among the boxes, the most frequent first."""
    counts = Counter()
    for array in arrays:
        for class_name in array.class_names:
            counts[config.kind(class_name)] += 1
    return [kind for kind, _ in counts.most_common()]
