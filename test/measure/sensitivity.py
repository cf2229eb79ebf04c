"""
`measure sensitivity`: loss of accuracy when a setting or a constant is halved or doubled.

Settings are the numbers of `Config`. Constants are the numbers that the modules of the core assign
as ``NAME = number`` or ``NAME = number, number``. Both are discovered, so a new one is measured
without an entry here. To change a constant the packages are imported again from a source in which
this one number is replaced; everything derived from it follows.

A number without effect on any data set should be removed, one that must be exact should be
estimated from the data.

"""

from __future__ import annotations

import argparse
import ast
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from fnmatch import fnmatch
from functools import partial
from importlib import import_module
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
import re
import sys
from typing import Any

from boxreg_ros.bench.common import (
    add_estimate_argument,
    add_json_argument,
    add_scope_arguments,
    class_words,
    line,
    progress_bar,
)
from boxreg_ros.config import Config, KINDS, Setting
from boxreg_ros.errors import ConfigError
from boxreg_ros.offline.box_scores import match, summarise
from boxreg_ros.offline.drive import Drive
from boxreg_ros.structures import BoxArray
from measure import print_json
import numpy as np
import torch

FACTORS = (0.5, 2.0)
CORE = 'boxreg_ros.core'
PACKAGE = 'boxreg_ros'
CONSTANT_NAME = re.compile(r'_?[A-Z][A-Z0-9_]*')
PAPER = 'paper'
"""The objective of the paper, and the group of settings that it alone reads."""

SourcePlace = tuple[str, int, int]
"""Place of a number in a source: module, line and column."""


@dataclass(frozen=True, slots=True)
class Variation:
    """
    One number with another value.

    Attributes
    ----------
    name : str
        Dotted name of a setting, or ``module.CONSTANT`` of a constant of the core.
    factor : float
        Factor that was asked for: one of `FACTORS`.
    default, value : int or float
        The number as it is and as it is for this run, within its bounds.
    place : SourcePlace, optional
        Place of a constant; None for settings.

    """

    name: str
    factor: float
    default: float
    value: float
    place: SourcePlace | None = None


@dataclass(frozen=True, slots=True)
class Measurement:
    """
    Settings and scope of a measurement.

    Attributes
    ----------
    config : Config
        The settings that are varied.
    estimate : str
        ``early``, ``final`` or ``track``.
    min_points : int
        Fewest points of true boxes that count.
    classes : sequence of str
        Words of the classes that count, as in `match`.

    """

    config: Config
    estimate: str
    min_points: int
    classes: Sequence[str]


@dataclass(frozen=True, slots=True)
class Outcome:
    """Mean IoU of a run; NaN and the reason where the run failed."""

    iou_bev: float
    iou_3d: float
    failure: str = ''


@dataclass(frozen=True, slots=True)
class Loss:
    """
    Loss of the mean IoU of all data sets by one variation; negative for a gain.

    Attributes
    ----------
    name : str
        As in `Variation`.
    factor, default, value : float
        As in `Variation`.
    bev, volume : float
        Loss of mean BEV and 3D IoU; NaN where a run failed.
    failure : str
        Why a run failed; '' if all succeeded.

    """

    name: str
    factor: float
    default: float
    value: float
    bev: float
    volume: float
    failure: str = ''

    @property
    def size(self) -> float:
        """Return the larger of the two losses; infinite where a run failed."""
        return float('inf') if self.failure else max(self.bev, self.volume)


# ------------------------------------------------------------------------------- discovery


def variations_of_settings(config: Config, kinds: Sequence[str] = KINDS) -> list[Variation]:
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


def _is_allowed(config: Config, name: str, value: float) -> bool:
    """Return whether a setting may have a value together with the others."""
    try:
        config.updated({name: value})
    except ConfigError:
        return False
    return True


def _within_bounds(item: Setting, value: float) -> float:
    low = value if item.low is None else max(value, type(value)(item.low))
    return low if item.high is None else min(low, type(value)(item.high))


def _scaled(value: float, factor: float) -> float:
    """Return a number times a factor; a whole number stays whole and above zero."""
    if isinstance(value, int):
        return max(1, round(value * factor)) if value > 0 else round(value * factor)
    return value * factor


def variations_of_constants(package: str = CORE) -> list[Variation]:
    """
    Return every numeric constant of a package halved and doubled.

    A constant is a number, or one number of a tuple, that a module assigns to an upper-case name.
    A constant that is computed from others follows them and is not varied itself. A whole number
    inside an index expression, or from which another constant is computed, describes the layout
    of arrays and is left out.

    """
    trees = {name: ast.parse(path.read_text(encoding='utf-8')) for name, path in _sources(package)}
    layout = set[str]()
    for tree in trees.values():
        layout |= _layout_names(tree)
    found = []
    for module, tree in trees.items():
        for names, label, number in _constants(tree):
            is_layout = isinstance(number.value, int) and not layout.isdisjoint(names)
            if is_layout:
                continue
            name = f'{module.rpartition(".")[2]}.{label}'
            place = (module, number.lineno, number.col_offset)
            default = number.value
            assert isinstance(default, (int, float))
            for factor in FACTORS:
                value = _scaled(default, factor)
                if value != default:
                    found.append(Variation(name, factor, default, value, place))
    return found


def _sources(package: str) -> Iterator[tuple[str, Path]]:
    """Yield name and path of every module that lies directly in a package."""
    spec = find_spec(package)
    for folder in spec.submodule_search_locations or () if spec else ():
        for path in sorted(Path(folder).glob('*.py')):
            if path.stem != '__init__':
                yield f'{package}.{path.stem}', path


def _constants(tree: ast.Module) -> Iterator[tuple[list[str], str, ast.Constant]]:
    """Yield names, label and number of each constant: ``A = 1``, ``A = 1, 2``, ``A, B = 1, 2``."""
    for node in tree.body:
        if isinstance(node, ast.Assign):
            targets, value = node.targets, node.value
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            targets, value = [node.target], node.value
        else:
            continue
        first = targets[0]
        if isinstance(first, ast.Tuple) and isinstance(value, ast.Tuple):
            pairs = [([a], b) for a, b in zip(first.elts, value.elts, strict=False)]
        else:
            pairs = [(targets, value)]
        for aliases, expression in pairs:
            names = [target.id for target in aliases if isinstance(target, ast.Name)]
            if not names or not all(CONSTANT_NAME.fullmatch(name) for name in names):
                continue
            yield from _numbers(names, expression)


def _numbers(names: list[str], value: ast.expr) -> Iterator[tuple[list[str], str, ast.Constant]]:
    """Yield the number that a value is, or those of a tuple of numbers with their positions."""
    label = ' = '.join(names)
    if isinstance(value, ast.Tuple):
        numbers = [_number(element) for element in value.elts]
        if all(numbers):
            for i, number in enumerate(numbers):
                assert number is not None
                yield names, f'{label}[{i}]', number
        return
    number = _number(value)
    if number is not None:
        yield names, label, number


def _number(node: ast.expr) -> ast.Constant | None:
    """Return the literal of a number, which may have a sign; None for anything else."""
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.UAdd)):
        node = node.operand
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        return node
    return None


def _layout_names(tree: ast.Module) -> set[str]:
    """Return upper-case names inside index expressions, or from which constants are computed."""
    names = set[str]()
    for node in ast.walk(tree):
        if isinstance(node, ast.Subscript):
            names |= _upper_names(node.slice)
    for node in tree.body:
        if isinstance(node, ast.Assign) and not isinstance(node.value, ast.Call):
            names |= _upper_names(node.value)
    return names


def _upper_names(node: ast.expr) -> set[str]:
    """Return upper-case names in an expression, calls in it left out."""
    if isinstance(node, ast.Call):
        return set()
    if isinstance(node, ast.Name):
        return {node.id} if CONSTANT_NAME.fullmatch(node.id) else set()
    found = set[str]()
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.expr):
            found |= _upper_names(child)
    return found


# ------------------------------------------------------------------------ changed constants


class _ReplaceNumber(ast.NodeTransformer):
    """Puts a value in the place of the number at a line and a column."""

    def __init__(self, place: SourcePlace, value: float) -> None:
        self.place = place
        self.value = value

    def visit_Constant(self, node: ast.Constant) -> ast.Constant:
        if (node.lineno, node.col_offset) == self.place[1:]:
            return ast.copy_location(ast.Constant(self.value), node)
        return node


class _Loader(SourceFileLoader):
    """Loads one module from its source with one number replaced."""

    def __init__(self, name: str, path: str, place: SourcePlace, value: float) -> None:
        super().__init__(name, path)
        self.change = _ReplaceNumber(place, value)

    def get_code(self, fullname: str) -> Any:
        """Return the code of the changed source; stored byte code is not used."""
        tree = ast.parse(Path(self.path).read_text(encoding='utf-8'))
        changed = ast.fix_missing_locations(self.change.visit(tree))
        return compile(changed, self.path, 'exec')


class _Finder:
    """Finds the one module of which a number is to be replaced."""

    def __init__(self, place: SourcePlace, value: float) -> None:
        self.place = place
        self.value = value

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Return how to load the module, None for all others."""
        if name != self.place[0]:
            return None
        sys.meta_path.remove(self)
        spec = find_spec(name)
        sys.meta_path.insert(0, self)
        if spec is not None and spec.origin is not None:
            spec.loader = _Loader(name, spec.origin, self.place, self.value)
        return spec


@contextmanager
def changed_constant(place: SourcePlace, value: float) -> Iterator[None]:
    """
    Import the packages of `boxreg_ros` again, with one number replaced, while a context lasts.

    Modules imported before keep what they have and are back in `sys.modules` afterwards. The
    modules in `boxreg_ros` itself (`structures`, `config`, ...) stay, so that their types do.
    Nothing else may import modules of the package in other threads meanwhile.

    """
    package = import_module(PACKAGE)
    before = {name: module for name, module in sys.modules.items() if _is_renewed(name)}
    attributes = {name: value for name, value in vars(package).items() if name[:2] != '__'}
    finder = _Finder(place, value)
    for name in before:
        del sys.modules[name]
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
        for name in [name for name in sys.modules if _is_renewed(name)]:
            del sys.modules[name]
        sys.modules.update(before)
        vars(package).update(attributes)


def _is_renewed(name: str) -> bool:
    """Return whether a module is in a package of `boxreg_ros`, other than this one."""
    top, *inner = name.split('.')
    if top != PACKAGE or not inner or inner[0] == 'bench':
        return False
    module = sys.modules[name]
    return len(inner) > 1 or hasattr(module, '__path__')


# ----------------------------------------------------------------------------------- runs


def measure(drive: Drive, measurement: Measurement, variation: Variation | None) -> Outcome:
    """
    Return the mean IoU of one run.

    Parameters
    ----------
    drive : Drive
        Sweeps, boxes and truth.
    measurement : Measurement
        Settings, estimate and scope.
    variation : Variation or None
        None for the settings as they are.

    """
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
                # The class that the changed core is imported by, with the same content.
                changed: Any = import_module(Drive.__module__).Drive
                content = {item.name: getattr(drive, item.name) for item in fields(drive)}
                predicted = changed(**content).registered(config)[estimate]
        scope = (measurement.min_points, measurement.classes)
        scores = summarise(match(predicted, drive.truth, *scope))
    except Exception as error:  # a number out of its range may fail anywhere in the core
        return Outcome(np.nan, np.nan, f'{type(error).__name__}: {error}'.splitlines()[0])
    return Outcome(scores.iou_bev, scores.iou_3d)


def run_all(
    drives: Mapping[str, Drive],
    measurement: Measurement,
    variations: Sequence[Variation],
    args: argparse.Namespace,
) -> tuple[dict[str, Outcome], list[list[Outcome]]]:
    """Return the outcome of each drive without variation, and per variation those of all."""
    wanted: list[Variation | None] = [None, *variations]
    jobs = [(name, variation) for variation in wanted for name in drives]
    initial = (dict(drives), measurement)
    # Fresh processes: each has the memory of one run, and no threads are copied into it.
    with (
        ProcessPoolExecutor(args.workers, get_context('spawn'), _start_worker, initial) as pool,
        progress_bar(len(jobs), args) as bar,
    ):
        outcomes = []
        for outcome in pool.map(_work, jobs):
            outcomes.append(outcome)
            bar.update()
    rows = [outcomes[i : i + len(drives)] for i in range(0, len(jobs), len(drives))]
    return dict(zip(drives, rows[0], strict=True)), rows[1:]


_worker: dict[str, Any] = {}


def _start_worker(drives: dict[str, Drive], measurement: Measurement) -> None:
    torch.set_num_threads(1)
    _worker['run'] = {name: partial(measure, drive, measurement) for name, drive in drives.items()}


def _work(job: tuple[str, Variation | None]) -> Outcome:
    name, variation = job
    outcome: Outcome = _worker['run'][name](variation)
    return outcome


def losses(
    variations: Sequence[Variation],
    baseline: Mapping[str, Outcome],
    outcomes: Sequence[Sequence[Outcome]],
) -> list[Loss]:
    """Return the loss of each variation on the mean of the drives, the largest one first."""
    bev = np.mean([outcome.iou_bev for outcome in baseline.values()])
    volume = np.mean([outcome.iou_3d for outcome in baseline.values()])
    found = []
    for variation, row in zip(variations, outcomes, strict=True):
        failures = [outcome.failure for outcome in row if outcome.failure]
        found.append(
            Loss(
                variation.name,
                variation.factor,
                variation.default,
                variation.value,
                float(bev - np.mean([outcome.iou_bev for outcome in row])),
                float(volume - np.mean([outcome.iou_3d for outcome in row])),
                failures[0] if failures else '',
            )
        )
    return sorted(found, key=lambda loss: -loss.size)


# --------------------------------------------------------------------------------- command


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `measure sensitivity`."""
    add_scope_arguments(parser)
    add_estimate_argument(parser)
    parser.add_argument(
        '--objective',
        choices=('robust', PAPER),
        default='robust',
        help='objective whose numbers are varied (default: robust)',
    )
    parser.add_argument(
        '--only', nargs='+', default=['*'], metavar='PATTERN',
        help="only settings and constants of these names, as in 'faces.*' or 'lbfgs.*'",
    )  # fmt: skip
    parser.add_argument(
        '--workers', type=int, default=2, metavar='N', help='runs at a time (default: 2)'
    )
    add_json_argument(parser)


def run(args: argparse.Namespace) -> int:
    """
    Print the loss of mean IoU by each variation.

    Raises
    ------
    ConfigError
        If ``--only`` names nothing, or ``--workers`` is below 1.
    RecordingError
        If a recording or its truth cannot be read.

    """
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
    if args.json:
        print_json(
            {
                'objective': args.objective,
                'estimate': args.estimate,
                'baseline': {name: asdict(outcome) for name, outcome in baseline.items()},
                'losses': [asdict(loss) for loss in found],
            }
        )
    else:
        print('\n'.join(table(baseline, found, args.estimate)))
    return 0


def kinds_of(arrays: Sequence[BoxArray], config: Config) -> list[str]:
    """Return the kinds of objects that are among the boxes, the most frequent first."""
    counts: Counter[str] = Counter()
    for array in arrays:
        for class_name in array.class_names:
            counts[config.kind(class_name)] += 1
    return [kind for kind, _ in counts.most_common()]


def table(baseline: Mapping[str, Outcome], found: Sequence[Loss], estimate: str) -> list[str]:
    """Return the lines of the printed table."""
    lines = [line(f'estimate {estimate}', ('BEV', '3D'))]
    lines += [line(name, (outcome.iou_bev, outcome.iou_3d)) for name, outcome in baseline.items()]
    width = max(len('loss of mean IoU by'), *(len(loss.name) for loss in found))
    lines += ['', f'{"loss of mean IoU by":{width}} {"factor":>7} {"value":>9}{"BEV":>9}{"3D":>9}']
    for loss in found:
        start = f'{loss.name:{width}} {loss.factor:>7g} {loss.value:>9.3g}'
        if loss.failure:
            lines.append(f'{start}  failed: {loss.failure}')
        else:
            lines.append(f'{start}{_signed(loss.bev):>9}{_signed(loss.volume):>9}')
    return lines


def _signed(loss: float) -> str:
    """Return a loss with four digits after the point, without a negative zero."""
    return f'{round(loss, 4) + 0.0:+.4f}'
