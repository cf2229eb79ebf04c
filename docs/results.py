"""
Make `docs/results.md` from the measurements stored in `docs/results/`.

    python docs/results.py            write the page
    python docs/results.py --check    exit with status 1 if the page is not what would be written

A measurement is the output of ``boxreg bench ... --json``, stored as ``KIND_DATA.json``, for
example ``real_pandaset_002_a.json`` of ``boxreg bench real pandaset_002_a --json``. A text of the
name ``KIND.md`` follows the tables of its kind.

"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
import json
import math
from pathlib import Path
from statistics import NormalDist
import sys
from typing import Any

from boxreg_ros.bench.ablation import INGREDIENTS, WHOLE
from boxreg_ros.config import KINDS
from boxreg_ros.offline.consistency import (
    CONSISTENCY_VARIABLES,
    CONSISTENT_NEES,
    SIGNIFICANT,
)

DOCS = Path(__file__).resolve().parent
STORE = DOCS / 'results'
PAGE = DOCS / 'results.md'
MIN_TRACKS = 3
"""Fewest tracks of a cell whose standard error is trusted."""

DATA = {
    'resim_3bffdcff': 'Real surfaces on a real drive, exact truth, detector noise',
    'resim_7fab2350': 'Real surfaces on a busier street, exact truth, detector noise',
    'pandaset_002_a': 'PandaSet 002, human labels, detector noise',
    'kitti_raw_0001': 'KITTI raw 0001, human labels, detector noise',
    'street': 'The sample recording, simulated',
}
INTRODUCTION = """\
# Results

`docs/results.py` makes this page from the files in `docs/results/`. Each file is the output of the
command above its table. No figure in a table is written by hand.

Accuracy is measured against true boxes of vehicles with at least 100 points:

- **BEV**, **3D**: mean intersection over union (IoU), from above and in space.
- **R@0.5**, **R@0.7**, **R@0.8**: part of the true boxes with at least this 3D IoU.
- **ATE**: mean error of the centre [m]. **ASE**: 1 - IoU after centre and heading are aligned.
  **AOE**: mean error of yaw [rad].
- **flips**: part of the boxes whose heading is off by more than a right angle.
- **jitter**: mean second difference of the centre over time [m/s^2].

Tables by class are of all true boxes with points, for classes with at least 20 of them.

Tables of differences are of the mean IoU of two methods. The standard error is that of the tracks,
whose boxes share their errors (cluster-robust). *ahead* is the number of tracks whose BEV IoU is
not lower.

The rows are methods. *early* is the estimate of the newest box of a sliding window, *final* that
of the box `lag` observations before it, *track* that from the whole track:

- **input**: the noisy boxes that every method starts from.
- **smoothing**: a robust constant-velocity smoother that does not use the points; *smoothing only*
  is that of whole tracks.
- **L-shape per sweep**: a rectangle fitted to the points of each box, in each sweep alone.
- **ICP on box points**: the points of each box aligned to points sampled on its visible faces.
- **paper**: the objective of the paper (Eq. 4 to 8).
- **ours**: the default objective.

*Detector noise* has the error sizes measured for a published detector: a part that is constant
over a track, a part that changes slowly, wrong extents, and 2.4 % flipped headings.
"""


SUMMARY = ('input', 'smoothing only', 'ours, early', 'ours, final', 'ours, track')
"""Methods of the first table: those that all recordings have."""


def main(words: Sequence[str] | None = None) -> int:
    """Write the page or check it, and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1] if __doc__ else None)
    parser.add_argument('--check', action='store_true', help='write nothing; 1 if out of date')
    args = parser.parse_args(words)
    text = page(STORE)
    if not args.check:
        PAGE.write_text(text, encoding='utf-8')
        return 0
    is_current = PAGE.is_file() and PAGE.read_text(encoding='utf-8') == text
    if not is_current:
        print(f'{PAGE}: is not made from {STORE}; run python docs/results.py', file=sys.stderr)
    return 0 if is_current else 1


def page(store: Path) -> str:
    """Return the page for the measurements in a folder."""
    parts = [INTRODUCTION, *_summary(store)]
    for kind, (title, meaning, render) in SECTIONS.items():
        stored = _measurements(store, kind)
        if stored:
            parts += [f'## {title}\n', f'{meaning}\n']
        for data, document in stored:
            title = _title(data)
            if title:
                parts.append(f'### {title}\n')
            parts.append(_origin(document))
            parts += [f'{part}\n' for part in render(document['results'])]
        verdict = store / f'{kind}.md'
        if verdict.is_file():
            parts.append(verdict.read_text(encoding='utf-8'))
    parts.append((store / 'dead_ends.md').read_text(encoding='utf-8'))
    return '\n'.join(parts)


def _summary(store: Path) -> Iterable[str]:
    """Yield the mean 3D IoU of the main methods on each recording, as a first table."""
    rows = []
    for data, document in _measurements(store, 'real'):
        for methods in document['results'].values():
            scores = [_number(methods[name]['iou_3d']) for name in SUMMARY]
            rows.append([f'{_title(data)} ({methods["input"]["boxes"]})', *scores])
    if rows:
        yield '## In short\n'
        yield 'Mean 3D IoU of each recording (number of true boxes); other scores are below.\n'
        yield _table(['', *SUMMARY], rows) + '\n'


def _measurements(store: Path, kind: str) -> list[tuple[str, Any]]:
    """Return data name and document of each measurement of a kind, in the order of `DATA`."""
    found = {
        path.stem.removeprefix(kind).removeprefix('_'): path
        for path in sorted(store.glob(f'{kind}*.json'))
    }
    names = [name for name in DATA if name in found]
    names += [name for name in found if name not in DATA]
    return [(name, json.loads(found[name].read_text(encoding='utf-8'))) for name in names]


def _title(data: str) -> str:
    """Return the title of the measurements of some data, '' if they have none."""
    for name, title in DATA.items():
        if data.startswith(name):
            with_suffix = data.removeprefix(name).replace('_', ', with ')
            return f'{title}{with_suffix}'
    return ''


def _origin(document: Any) -> str:
    return f'    $ {document["command"]}    # version {document["version"]}\n'


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [header, ['---', *['---:'] * (len(header) - 1)], *rows]
    return '\n'.join(f'| {" | ".join(cells)} |' for cells in lines)


def _number(value: float | None, digits: int = 3) -> str:
    return '-' if value is None else f'{value:.{digits}f}'


def _signed(value: float, digits: int) -> str:
    """Return a number with its sign, and zero without a minus."""
    return f'{round(value, digits) + 0.0:+.{digits}f}'


def _accuracy(results: Any) -> Iterable[str]:
    """Yield the table of scores of each recording, and 3D IoU by range and number of points."""
    for methods in results.values():
        measured = {name: row for name, row in methods.items() if not isinstance(row, str)}
        skipped = {name: row for name, row in methods.items() if isinstance(row, str)}
        header = f'BEV 3D {" ".join(f"R@{x}" for x in (0.5, 0.7, 0.8))} ATE ASE AOE flips jitter'
        keys = ('ate', 'ase', 'aoe', 'flips', 'jitter')
        rows = []
        for name, row in measured.items():
            values = [row['iou_bev'], row['iou_3d'], *row['recall_3d'], *(row[k] for k in keys)]
            rows.append([name, *map(_number, values)])
        yield f'{measured["input"]["boxes"]} true boxes.'
        yield _table(['', *header.split()], rows)
        yield from _groups(measured, '3D IoU')
        if 'by_class' in measured['input']:
            yield _classes(measured)
        yield from _compared(measured)
        for name, reason in skipped.items():
            yield f'{name}: {reason}.'


def _groups(measured: Any, iou: str) -> Iterable[str]:
    for key, title in (('by_range', 'by range [m]'), ('by_points', 'by number of points')):
        grouped = {name: row[key] for name, row in measured.items() if key in row}
        labels = list(dict.fromkeys(label for row in grouped.values() for label in row))
        if len(labels) < 2:  # the same as the mean of all boxes
            continue
        rows = [
            [name, *(_number(row.get(label)) for label in labels)] for name, row in grouped.items()
        ]
        yield _table([f'{iou} {title}', *labels], rows)


def _compared(measured: Any) -> Iterable[str]:
    """Yield the table of moving objects, and that of the differences between methods."""
    moving = {name: row['moving'] for name, row in measured.items() if 'moving' in row}
    if moving:
        rows = [
            [name, *(_number(row[key]) for key in ('iou_bev', 'iou_3d')),
             _number(row['yaw_degrees'], 2)]
            for name, row in moving.items()
        ]  # fmt: skip
        head = f'moving objects ({moving["input"]["boxes"]} boxes)'
        yield _table([head, 'BEV', '3D', 'median error of yaw [degrees]'], rows)
    rows = [
        [f'{name} - {other}', scope, *_difference(found)]
        for name, row in measured.items()
        for scope, others in row.get('differences', {}).items()
        for other, found in others.items()
    ]
    if rows:
        yield _table(['difference', 'objects', 'BEV', '3D', 'tracks', 'ahead'], rows)


def _difference(found: Any) -> Iterable[str]:
    """Yield both differences with their standard errors, and the numbers of tracks."""
    yield from _gain(found)
    yield str(found['tracks'])
    yield str(found['tracks_ahead'])


def _gain(found: Any) -> Iterable[str]:
    """Yield both differences with their standard errors."""
    for key in ('iou_bev', 'iou_3d'):
        yield f'{_signed(found[key], 4)} ± {_number(found[f"{key}_error"], 4)}'


def _classes(measured: Any) -> str:
    """Return the table of BEV and 3D IoU of each class, of all its boxes with points."""
    names = measured['input']['by_class']
    header = [f'{name} ({row["boxes"]})' for name, row in names.items()]
    rows = []
    for method, scores in measured.items():
        found = [scores['by_class'][name] for name in names]
        pairs = [f'{_number(row["iou_bev"])} / {_number(row["iou_3d"])}' for row in found]
        rows.append([method, *pairs])
    return _table(['BEV / 3D IoU by class (boxes)', *header], rows)


def _kinds_of_objects(results: Any) -> Iterable[str]:
    """Yield what each class gains over the input and over smoothing, one table per recording."""
    for drives, found in results.items():
        rows = []
        for name, methods in found.items():
            for method, others in methods.items():
                start = [f'{name} ({others["input"]["boxes"]})', method.removeprefix('ours, ')]
                smoother = next(key for key in others if key.startswith('smoothing'))
                rows.append([*start, *_gain(others['input']), *_gain(others[smoother])])
        columns = ('BEV - input', '3D - input', 'BEV - smoothing', '3D - smoothing')
        yield _table([f'{drives}: class (boxes)', 'estimate', *columns], rows)


def _paper(results: Any) -> Iterable[str]:
    """Yield Table I of each mode."""
    for mode, methods in results.items():
        measured = {name: row for name, row in methods.items() if not isinstance(row, str)}
        pose = ['x', 'y', 'z', 'roll', 'pitch', 'yaw'] if mode == '3d' else ['x', 'y', 'yaw']
        columns = (*pose, 'iou', 'iou_first', 'iou_last', 'iou_full')
        rows = [
            [name, *(_number(row.get(column)) for column in columns)]
            for name, row in measured.items()
        ]
        iou = '3D IoU' if mode == '3d' else 'BEV IoU'
        titles = (iou, *(f'{iou}, {part}' for part in ('first', 'last', 'full windows')))
        yield _table([f'mode: {mode}', *pose, *titles], rows)
        yield from _groups(measured, iou)


def _ablation(results: Any) -> Iterable[str]:
    """Yield for each recording what the figures lose without an ingredient, largest first."""
    for ingredients in results.values():
        whole, *others = ingredients.items()
        best = whole[1]
        header = ['without', 'BEV', '3D', 'R@0.8', 'BEV loss', '3D loss', 'R@0.8 loss']
        rows = []
        ranked = sorted(others, key=lambda item: item[1]['iou_3d'])
        for name, row in [whole, *ranked]:
            values = [row['iou_bev'], row['iou_3d'], row['recall_3d'][-1]]
            wholes = [best['iou_bev'], best['iou_3d'], best['recall_3d'][-1]]
            losses = [_signed(a - b, 3) for a, b in zip(wholes, values, strict=True)]
            rows.append([name, *map(_number, values), *losses])
        yield _table(header, rows)


def _sensitivity(results: Any) -> Iterable[str]:
    """Yield the loss of every setting and constant, largest first; those without one as a list."""
    baseline = results['baseline']
    rows = [[name, _number(o['iou_bev']), _number(o['iou_3d'])] for name, o in baseline.items()]
    yield _table([f'estimate: {results["estimate"]}', 'BEV', '3D'], rows)
    largest: dict[str, float] = {}
    rows = []
    failures = []
    for loss in results['losses']:
        name = f'`{loss["name"]}`'
        start = [name, f'{loss["factor"]:g}', f'{loss["value"]:.3g}']
        if loss['failure']:
            largest[name] = float('inf')
            failures.append(f'{name} = {loss["value"]:.3g}')
            continue
        size = max(abs(loss['bev']), abs(loss['volume']))
        largest[name] = max(largest.get(name, 0.0), size)
        if size >= SHOWN_LOSS:
            rows.append([*start, _signed(loss['bev'], 4), _signed(loss['volume'], 4)])
    yield _table(['setting or constant', 'factor', 'value', 'BEV loss', '3D loss'], rows)
    without = sorted(name for name, size in largest.items() if size < SHOWN_LOSS)
    yield f'Less than {SHOWN_LOSS} either way: {", ".join(without)}.'
    if failures:
        yield f'Not possible, since the value is an index or a quantile: {", ".join(failures)}.'


def _tracks(results: Any) -> Iterable[str]:
    """Yield the scores after each completing step, one table per recording."""
    keys = (
        ('recall', 'recall'),
        ('precision', 'precision'),
        ('ids per object', 'ids_per_object'),
        ('HOTA', 'hota'),
        ('IDF1', 'idf1'),
        ('added', 'added'),
        ('3D IoU of added', 'added_iou'),
        ('ghosts rejected', 'ghosts_rejected'),
        ('others rejected', 'lost'),
    )
    for rows in results.values():
        lines = [
            [name, *(_number(row[key], 0 if key == 'added' else 3) for _, key in keys)]
            for name, row in rows.items()
        ]
        yield _table(['', *(title for title, _ in keys)], lines)
        yield from _kinds(rows)


def _kinds(rows: Any) -> Iterable[str]:
    """Yield the scores by kind of object: of the tracks before they were broken, and at last."""
    first, *_, last = rows
    keys = ('recall', 'precision', 'ids_per_object', 'added', 'added_iou', 'given_iou')
    lines = [
        [f'{name}: {kind}', *(_number(scores[key], 0 if key == 'added' else 3) for key in keys)]
        for name in (first, last)
        for kind, scores in rows[name]['by_kind'].items()
    ]
    found = ('recall', 'precision', 'ids per object')
    titles = (*found, 'added', '3D IoU of added', '3D IoU of others')
    yield _table(['by kind', *titles], lines)


def _figures(results: Any) -> Iterable[str]:
    """Yield a plain table of names and values."""
    yield _table(['', ''], _flat(results))


def _lidars(results: Any) -> Iterable[str]:
    """Yield the accuracy of each way to record several LiDARs."""
    rows = [[name, _number(found['bev']), _number(found['3d'])] for name, found in results.items()]
    yield _table(['recorded', 'BEV', '3D'], rows)


def _highway(results: Any) -> Iterable[str]:
    """Yield the accuracy of each method by speed, one table per time of the boxes."""
    for convention, found in results.items():
        speeds = next(iter(found.values()))
        rows = [[name, *map(_number, values.values())] for name, values in found.items()]
        yield _table([f'boxes of the time of {convention}', *speeds], rows)


def _review(results: Any) -> Iterable[str]:
    """Yield the share of bad tracks at the top of each list, per recording and input."""
    for recording, inputs in results.items():
        for name, found in inputs.items():
            rows = [[order, *map(_number, shares)] for order, shares in found['shares'].items()]
            head = f'{recording}, {name}: worst {found["bad"]} of {found["tracks"]}'
            yield _table([head, '1 %', '5 %', '10 %', '20 %'], rows)
            pins = found['pins']
            yield (
                f'With one box of each of these tracks pinned, the mean 3D IoU of their other '
                f'boxes rises from {pins["before"]:.3f} to {pins["after"]:.3f}: '
                f'{pins["gained"]:.0%} of 1 - IoU are removed; the errors that are constant along '
                f'a track are {pins["constant"]:.0%} of it.'
            )
            if 'left' in pins:  # measurements of earlier builds do not have them
                yield f'Of these are left: {_left(pins["left"])}.'


def _left(errors: Any) -> str:
    """Return the constant errors of poses as text; extents are those of the pin."""
    lengths = ', '.join(f'{name} {errors[name]:.2f} m' for name in ('along', 'across', 'up'))
    return f'{lengths}, yaw {errors["yaw"]:.3f} rad'


def _covariance(results: Any) -> Iterable[str]:
    """Yield coverage and NEES of each variable, by estimate and class, one table per recording."""
    for recording, estimates in results.items():
        rows = [
            [f'{estimate}, {name}', f'{group["boxes"]} of {group["tracks"]}', *_consistent(group)]
            for estimate, groups in estimates.items()
            for name, group in groups.items()
            if name == 'all' or group['boxes'] < groups['all']['boxes']
        ]
        variables = next(iter(next(iter(estimates.values())).values()))['nees']
        yield _table([recording, 'boxes of tracks', *variables], rows)
        yield _consistent_cells(estimates)
    yield _cells_and_chance(results)


def _consistent(group: Any) -> Iterable[str]:
    for name, nees in group['nees'].items():
        error = group['nees_error'][name]
        spread = '' if error is None else f' ± {error:.1f}'
        yield f'{group["coverage"][name]:.2f} / {nees:.1f}{spread}'


def _cells_of_kinds(estimates: Any) -> list[tuple[str, Any, str]]:
    """Return the cells of the kinds along, across, up and in yaw: name, group and variable."""
    return [
        (f'{estimate} {kind} {variable}', group, variable)
        for estimate, groups in estimates.items()
        for kind, group in groups.items()
        if kind in {f'{kind}s' for kind in KINDS}
        for variable in CONSISTENCY_VARIABLES[:4]
    ]


def _consistent_cells(estimates: Any) -> str:
    """Return how many cells of the kinds are consistent, and which are not."""
    cells = _cells_of_kinds(estimates)
    low, high = CONSISTENT_NEES
    coverage = [group['coverage'][variable] for _, group, variable in cells]
    nees = [group['nees'][variable] for _, group, variable in cells]
    overconfident = [
        f'{name} {value:.1f} ± {group["nees_error"][variable]:.1f}'
        for (name, group, variable), value in zip(cells, nees, strict=True)
        if value - high > SIGNIFICANT * (group['nees_error'][variable] or math.inf)
    ]
    return (
        f'By kind, along, across, up and in yaw: 90 to 98 % of the errors are within two '
        f'standard deviations in {sum(0.9 <= part <= 0.98 for part in coverage)} of {len(cells)} '
        f'cells, more in {sum(part > 0.98 for part in coverage)}, less in '
        f'{sum(part < 0.9 for part in coverage)}. The mean of squared error over variance is '
        f'{low:g} to {high:g} in {sum(low <= value <= high for value in nees)}, less in '
        f'{sum(value < low for value in nees)}, more in {sum(value > high for value in nees)}; '
        f'more by over {SIGNIFICANT:g} standard errors: {", ".join(overconfident) or "none"}.'
    )


def _cells_and_chance(results: Any) -> str:
    """Return how many cells of all recordings are consistent, and what chance leaves of that."""
    every = [cell for estimates in results.values() for cell in _cells_of_kinds(estimates)]
    of_many = [
        (group['nees'][variable], group['nees_error'][variable])
        for _, group, variable in every
        if group['tracks'] >= MIN_TRACKS
    ]
    low, high = CONSISTENT_NEES
    exact = sum(
        NormalDist(1.0, error / value).cdf(high) - NormalDist(1.0, error / value).cdf(low)
        for value, error in of_many
    )
    return (
        f'All recordings: {sum(low <= g["nees"][v] <= high for _, g, v in every)} of {len(every)} '
        f'cells are {low:g} to {high:g}, of those with {MIN_TRACKS} tracks or more '
        f'{sum(low <= value <= high for value, _ in of_many)} of {len(of_many)}. If all '
        f'covariances were exact, and tracks differed as much, {exact:.0f} of these would be. '
        f'Less by over {SIGNIFICANT:g} standard errors are '
        f'{sum(low - value > SIGNIFICANT * error for value, error in of_many)}, more '
        f'{sum(value - high > SIGNIFICANT * error for value, error in of_many)}.'
    )


def _load(results: Any) -> Iterable[str]:
    """Yield latency and accuracy by number of tracks, one table per way to treat overload."""
    for policy, rows in results.items():
        names = list(next(iter(rows.values())))
        lines = [[tracks, *(_number(row[name]) for name in names)] for tracks, row in rows.items()]
        yield _table([f'{policy}: tracks', *names], lines)


def _flat(results: Any, prefix: str = '') -> Iterable[list[str]]:
    for name, value in results.items():
        if isinstance(value, dict):
            yield from _flat(value, f'{prefix}{name}: ')
        elif isinstance(value, float):
            yield [f'{prefix}{name}', f'{value:,.0f}' if value >= 1e4 else f'{value:.4g}']
        else:
            yield [f'{prefix}{name}', str(value)]


SHOWN_LOSS = 0.001  # smaller changes of mean IoU are within the scatter of noise seeds

SECTIONS: dict[str, tuple[str, str, Callable[[Any], Iterable[str]]]] = {
    'real': (
        'Recordings with known truth',
        'Every method gets the same sweeps and the same boxes.',
        _accuracy,
    ),
    'kinds': (
        'Gain of each class',
        'Mean IoU minus that of the input, and minus that of smoothing, of all true boxes with\n'
        'points; standard errors over tracks, which is why the streets are pooled. Seed 0, the\n'
        'sample, is none of them.',
        _kinds_of_objects,
    ),
    'tracks': (
        'Broken tracks made whole',
        'All classes and all true boxes, whatever their number of points. 8 % of the boxes are\n'
        'removed, and gaps of 3 to 8 sweeps; after half of the gaps the id is another one. The\n'
        'first row is the registration of the tracks before they were broken, which completion\n'
        'has to restore. Each other row has one step more. Recall and precision at a 3D IoU of\n'
        '0.5, matched by overlap; HOTA and IDF1 by TrackEval. *added* is the number of added\n'
        'boxes. With `--ghosts` there are boxes without an object; *ghosts rejected* is the part\n'
        'of them that is rejected, *others rejected* the part of the boxes of objects. With\n'
        '`--far-misses` the boxes are removed in runs, as often as the square of the distance,\n'
        'like those of a detector that has too few points. `--coast` is the node: final boxes\n'
        'without and with `coast`.',
        _tracks,
    ),
    'paper': (
        "The paper's experiment",
        'Simulated after Eq. 10 with the noise of Table I. Mean absolute errors [m, rad], x\n'
        'along and y across the vehicle; mean IoU: of all boxes, the first, the last, and\n'
        'those from the first full window on. *held extents* is ours with the extents of the\n'
        'input, which have no errors here: the paper does not estimate them either.',
        _paper,
    ),
    'ablation': (
        'Ablation',
        'The method with one ingredient off. A positive loss means that the ingredient helps.\n\n'
        + _table(
            ['without', 'the change'],
            [[name, item.meaning] for name, item in INGREDIENTS.items() if name != WHOLE],
        ),
        _ablation,
    ),
    'sensitivity': (
        'Sensitivity',
        'One setting or constant halved or doubled. A positive loss means that the default is '
        'better.\nBoth runs are of earlier builds: some names have changed since.',
        _sensitivity,
    ),
    'highway': (
        'Fast objects',
        'Mean 3D IoU on the same simulated highway (rolling shutter, trucks with trailers) at 5\n'
        'and at 30 m/s. The boxes are where a vehicle was at the stamp of the sweep, or where it\n'
        'was when the sensor saw it; which one is not given to the method.',
        _highway,
    ),
    'lidars': (
        'Several LiDARs',
        'A simulated truck with four LiDARs at its corners, which turn a quarter of a period\n'
        'apart: a topic per LiDAR (*corners*), a cloud concatenated in the\n'
        'frame of the truck with its info message (*concatenated*), without it\n'
        '(*concatenated-alone*), without it but with the names of its LiDARs\n'
        '(*concatenated-named*), and a single LiDAR on the roof. Input boxes and truth are the\n'
        'same.',
        _lidars,
    ),
    'covariance': (
        'Covariances',
        'Two numbers per cell: the part of the errors within two standard deviations (0.95 is\n'
        'consistent) and the mean squared error over variance (1 is consistent) with its\n'
        'standard error over the tracks: all boxes of a track share its constant errors. Errors\n'
        'are along the axes of the true boxes, without heading flips.',
        _covariance,
    ),
    'review': (
        'Review list',
        'Share of the tracks with the worst 3D IoU that are in the first 1 %, 5 %, 10 % and 20 %\n'
        'of a list, at least one track: the list by risk, by number of points, by standard\n'
        'deviation, and a random one. Inputs: noisy boxes (*own boxes*), and true boxes with\n'
        'errors planted in a fifth of the tracks. Then, in each of the worst tracks, the box\n'
        'that the list names is pinned at the truth.',
        _review,
    ),
    'report': (
        'The report in a browser',
        'Chromium without a window and without a GPU, on two cores. It draws by the processor,\n'
        'as it does by itself where it finds no GPU, or by an emulated GPU (SwiftShader). *first\n'
        'paint* is from the start of the page. The time slider is stepped once per frame, 120\n'
        'times: *script* is the time that the page takes of a frame, the rest is the drawing of\n'
        'the browser; the 3D view follows when the stepping pauses, where its drawing takes\n'
        'longer than a frame. *late* frames were lost at 60 Hz.',
        _figures,
    ),
    'speed': (
        'Speed',
        'Times in ms unless the name says otherwise. CUDA has not been run: the torch twins of\n'
        'the kernels are tested on the CPU only. *solver: reference* is one fit of a window by\n'
        'torch.optim.LBFGS; *IoU, error* is the standard error of the difference between its IoU\n'
        'and ours.',
        _figures,
    ),
    'load': (
        'The live node under load',
        'Latency from the later of cloud and boxes to the refined boxes, and mean 3D IoU of all\n'
        'published boxes, kept ones included. With the default deadline (80 ms), tracks that the\n'
        'solver has no time for are kept. *one window* solves one track per stamp: the latency\n'
        'that no deadline can avoid. With a deadline of an hour, clouds are dropped.',
        _load,
    ),
    'scale': (
        'A fleet of drives',
        '[Scale](scale.md) explains the figures. Where two workers used far less than two cores,\n'
        'other programs had the rest, and their speedup is no measurement.',
        _figures,
    ),
    'kills': (
        'Labels while driving, killed',
        'Box arrays that were published, and are in no segment after `boxreg recover`. Early\n'
        'boxes become final 0.9 s later.',
        _figures,
    ),
    'node': (
        'The live node',
        'Publisher, node and observer each a process, over DDS. *load* is the load average of a\n'
        'machine with two cores: beyond 2, the processes wait for others. At 100 Hz an hour of a\n'
        'sensor of 10 Hz takes six minutes; memory and handles show whether the node leaks.',
        _figures,
    ),
}


if __name__ == '__main__':
    sys.exit(main())
