"""
`measure kinds`: gain of each class of objects, with standard errors over its tracks.

On recordings with known truth, or on simulated streets, whose tracks are pooled: a recording has
few pedestrians and cyclists, and the boxes of each share its errors.

"""

from dataclasses import asdict
from pathlib import Path

from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.box_scores import match
from boxreg_ros.simulation.simulate import simulate
from measure.drives import Drive
from measure.methods import run_methods
from measure.real import (
    Difference,
    MIN_CLASS_BOXES,
    paired,
    PairedBoxes,
    REFERENCE_METHODS,
)
import numpy as np

COMPARED = ('smoothing', 'ours')
SCENARIOS = {
    'street': 'streets',
    'articulated': 'drives, tractor and trailer in one box',
    'articulated-parts': 'drives, tractor and trailer in a box each',
    'parked': 'streets, cars parked bumper to bumper',
}
"""What the simulated drives of each scenario are called."""
FIRST_SEED = 1
"""Of the simulated streets; the sample recording, with which the method was made, has seed 0."""

Comparison = tuple[str, str, str]
"""Class of the true boxes, method, and the method that it is compared with."""
Differences = dict[str, dict[str, dict[str, Difference]]]
"""By the same."""
ARGUMENTS = {
    'data': (Path, 'recording and truth.csv (default: simulated streets)', {'nargs': '*'}),
    '--seeds': (16, 'number of simulated drives'),
    '--scenario': ('street', 'of these', {'choices': SCENARIOS}),
}


def run(args):
    """Return the differences of each class: of each recording, or of all streets."""
    measured = {}  # by table; pairs by drive
    for table, name, drive in _drives(args):
        comparisons = measured.setdefault(table, {})
        for comparison, pairs in compared(drive):
            comparisons.setdefault(comparison, {})[name] = pairs
    tables = {table: _differences(comparisons) for table, comparisons in measured.items()}
    return _plain(tables)


def _drives(args):
    """Yield the title of a table, and name and drive of each of its drives."""
    for folder in args.data:
        yield str(folder), folder.name, Drive.read(folder)
    if not args.data:
        for seed in range(FIRST_SEED, FIRST_SEED + args.seeds):
            drive = Drive.from_scene(simulate(args.scenario, seed))
            yield f'{args.seeds} simulated {SCENARIOS[args.scenario]}', str(seed), drive


def compared(drive):
    """Yield the true boxes with points of each class, by our estimates and by their references."""
    truth = drive.truth
    methods = run_methods(drive, wanted=COMPARED)
    found = {
        name: match(boxes, truth, min_points=1)
        for name, boxes in methods.items()
        if isinstance(boxes, BoxTable)
    }
    class_names = np.array(found['input'].class_names, str)
    for class_name in np.unique(class_names).tolist():
        scope = class_names == class_name
        for method, others in REFERENCE_METHODS.items():
            for other in others:
                if other in found:
                    pairs = paired(found[method], found[other], truth, scope)
                    yield (class_name, method, other), pairs


def _differences(comparisons):
    """Return the pooled difference of each comparison with enough boxes."""
    found = {}
    for (class_name, method, other), parts in sorted(comparisons.items()):
        difference = PairedBoxes.pooled(parts).difference()
        if difference.boxes >= MIN_CLASS_BOXES:
            by_method = found.setdefault(class_name, {})
            by_method.setdefault(method, {})[other] = difference
    return found


def _plain(found):
    """Return nested differences as nested dictionaries of numbers."""
    if isinstance(found, Difference):
        return asdict(found)
    return {key: _plain(inner) for key, inner in found.items()}
