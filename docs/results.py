"""
Write the tables of `docs/results.md` and `docs/results/` from the stored measurements.

    python docs/results.py            write the pages
    python docs/results.py --check    exit with status 1 if a page is not what would be written

A measurement is the output of ``boxreg bench`` or of ``test/measure``, stored as
``KIND_DATA.json``, for example ``real_pandaset_002_a.json`` of ``boxreg bench real pandaset_002_a
--json``. The tables of a kind are in ``KIND.md`` beside it, or on the page that `PAGES` has for
it, between two marks; the text around the marks is written by hand. `docs/results.md` has the main
figures of each kind.

"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
import json
import math
from pathlib import Path
import re
from statistics import NormalDist
import sys
from typing import Any

from boxreg_ros import __version__
from boxreg_ros.bench.ablation import INGREDIENTS, WHOLE
from boxreg_ros.bench.speed.report import WANTED, WANTED_TICKS, WANTED_TIMES, WANTED_TRACKS
from boxreg_ros.config import KINDS
from boxreg_ros.offline.consistency import (
    CONSISTENCY_VARIABLES,
    CONSISTENT_NEES,
    SIGNIFICANT,
)
from generate import between_marks

DOCS = Path(__file__).resolve().parent
STORE = DOCS / 'results'
OVERVIEW = DOCS / 'results.md'
MIN_TRACKS = 3
"""Fewest tracks of a cell whose standard error is trusted."""

DATA = {
    'resim_3bffdcff': ('Real drive', 'real surfaces, exact truth, detector noise'),
    'resim_7fab2350': ('Busier street', 'real surfaces, exact truth, detector noise'),
    'pandaset_002_a': ('PandaSet 002', 'human labels, detector noise'),
    'kitti_raw_0001': ('KITTI raw 0001', 'human labels, detector noise'),
    'street': ('Sample', 'simulated'),
}
"""Title and content of each recording, in the order of the tables."""
PAGES = {
    **dict.fromkeys(('kinds', 'points', 'highway', 'lidars', 'paper'), 'scenes'),
    **dict.fromkeys(('covariance', 'review', 'labeller'), 'certainty'),
    **dict.fromkeys(('ablation', 'sensitivity'), 'ablation'),
    **dict.fromkeys(('speed', 'scale', 'report'), 'speed'),
    **dict.fromkeys(('node', 'load', 'kills'), 'node'),
}
"""Page of the kinds of measurements that share one; the others have a page of their name."""
PART_OF_RUN = re.compile(' (?:at the start|in the middle|at the end)')
SHOWN_LOSS = 0.001
"""Smaller changes of mean IoU are within the scatter of noise seeds."""
MAIN_METHODS = (
    'input', 'smoothing only', 'ICP on box points', 'paper, track',
    'ours, early', 'ours, final', 'ours, track',
)  # fmt: skip
"""Methods of the overview: those that all recordings have."""


def main(words: Sequence[str] | None = None) -> int:
    """Write the pages or check them, and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1] if __doc__ else None)
    parser.add_argument('--check', action='store_true', help='write nothing; 1 if out of date')
    args = parser.parse_args(words)
    stale = [
        (path, text)
        for path, text in pages(STORE).items()
        if path.read_text(encoding='utf-8') != text
    ]
    for path, text in stale:
        if args.check:
            print(f'{path}: stale; run python docs/results.py', file=sys.stderr)
        else:
            path.write_text(text, encoding='utf-8')
    return 1 if args.check and stale else 0


def pages(store: Path) -> dict[Path, str]:
    """Return the text of each page for the measurements in a folder."""
    parts = [(OVERVIEW, '', _overview(store))]
    for kind in TABLES:
        page = STORE / f'{PAGES.get(kind, kind)}.md'
        parts.append((page, kind if kind in PAGES else '', _tables(store, kind)))
    written: dict[Path, str] = {}
    for page, section, lines in parts:
        text = written.get(page) or page.read_text(encoding='utf-8')
        written[page] = between_marks(page.name, text, '\n'.join(lines), section)
    return written


def _tables(store: Path, kind: str) -> Iterable[str]:
    """Yield for each measurement of a kind its title, its command and its tables."""
    if kind == 'ablation':
        yield f'{_ingredients()}\n'
    for data, document in _measurements(store, kind):
        title = _title(data)
        if title:
            yield f'{"###" if kind in PAGES else "##"} {title}\n'
        yield _origin(document)
        yield from (f'{part}\n' for part in TABLES[kind](document['results']))


def _measurements(store: Path, kind: str) -> list[tuple[str, Any]]:
    """Return data name and document of each measurement of a kind, in the order of `DATA`."""
    found = {
        path.stem.removeprefix(kind).removeprefix('_'): path
        for path in sorted(store.glob(f'{kind}*.json'))
    }
    names = [name for data in DATA for name in found if name.startswith(data)]
    names += [name for name in found if name not in names]
    return [(name, json.loads(found[name].read_text(encoding='utf-8'))) for name in names]


def _title(data: str) -> str:
    """Return the title of the measurements of some data, '' if they have none."""
    for name, (title, _) in DATA.items():
        if data.startswith(name):
            with_suffix = data.removeprefix(name).replace('_', ', with ')
            return f'{title}{with_suffix}'
    return ''


def _origin(document: Any) -> str:
    suffix = '' if document['version'] == __version__ else f'    # version {document["version"]}'
    return f'    $ {document["command"]}{suffix}\n'


def _table(header: Sequence[str], rows: Iterable[Sequence[str]], alignment: str = '---:') -> str:
    """Return a table whose columns but the first have an alignment, by default to the right."""
    lines = [header, ['---', *[alignment] * (len(header) - 1)], *rows]
    return '\n'.join(f'| {" | ".join(cells)} |' for cells in lines)


def _number(value: float | None, digits: int = 3) -> str:
    return '-' if value is None else f'{value:.{digits}f}'


def _signed(value: float, digits: int) -> str:
    """Return a number with its sign, and zero without a minus."""
    return f'{round(value, digits) + 0.0:+.{digits}f}'


def _overview(store: Path) -> Iterable[str]:
    """Yield the main tables of `docs/results.md`."""
    recordings = [[f'`{name}`', *texts] for name, texts in DATA.items()]
    yield _table(['recording', 'title', 'content'], recordings, '---')
    yield f'\nMeasured by version {__version__}, where no other one is named.'
    yield ''
    for section in (_mean_ious, _gains, _completion, _coverage, _ranking, _times):
        yield from (f'{part}\n' for part in section(store))


def _mean_ious(store: Path) -> Iterable[str]:
    """Yield the mean 3D and BEV IoU of the main methods on each recording."""
    yield '## Accuracy'
    yield (
        'Mean IoU on each recording (number of true boxes). '
        '[Accuracy](results/real.md) has all scores and methods, '
        '[Ablation](results/ablation.md) the loss without each ingredient.'
    )
    scored = [
        (f'`{data}` ({methods["input"]["boxes"]})', methods)
        for data, document in _measurements(store, 'real')
        for methods in document['results'].values()
    ]
    for key, title in (('iou_3d', '3D IoU'), ('iou_bev', 'BEV IoU')):
        rows = [
            [name, *(_number(methods[method][key]) for method in MAIN_METHODS)]
            for name, methods in scored
        ]
        yield _table([title, *MAIN_METHODS], rows)


def _gains(store: Path) -> Iterable[str]:
    """Yield the gain of 3D IoU of each class on the simulated streets."""
    yield '## Classes'
    yield (
        'Mean 3D IoU minus that of the input and of smoothing, with standard errors over tracks. '
        '[Gain of each class](results/scenes.md) has BEV IoU and the other recordings.'
    )
    document = dict(_measurements(store, 'kinds'))['']
    for drives, classes in document['results'].items():
        rows = []
        for name, methods in classes.items():
            final, track = methods['ours, final'], methods['ours, track']
            gains = (
                final['input'], final['smoothing, final'], track['input'], track['smoothing only'],
            )  # fmt: skip
            boxes = track['input']['boxes']
            rows.append([f'{name} ({boxes})', *(_with_error(gain, 'iou_3d') for gain in gains)])
        columns = ('final - input', 'final - smoothing', 'track - input', 'track - smoothing')
        yield _table([f'{drives}: class (boxes)', *columns], rows)


def _completion(store: Path) -> Iterable[str]:
    """Yield the scores of broken tracks, of completed ones, and of tracks never broken."""
    yield '## Completed tracks'
    yield (
        'Scores of broken tracks as they are given, with `--complete`, and of the same tracks '
        'refined before they were broken, which is the best that completion can restore. '
        '[Completed tracks](results/tracks.md) has each step, ghosts, distant misses and the node.'
    )
    keys = ('recall', 'precision', 'ids_per_object', 'hota', 'idf1', 'added_iou')
    rows = []
    for data, document in _measurements(store, 'tracks'):
        if data not in DATA:
            continue  # with other breaks
        for steps in document['results'].values():
            unbroken, *_, completed = steps.values()
            rows += [
                [f'`{data}`: {name}', *(_number(scores[key]) for key in keys)]
                for name, scores in (
                    ('input', steps['input']), ('completed', completed), ('unbroken', unbroken),
                )
            ]  # fmt: skip
    titles = ('recall', 'precision', 'ids per object', 'HOTA', 'IDF1', '3D IoU of added')
    yield _table(['', *titles], rows)


def _coverage(store: Path) -> Iterable[str]:
    """Yield the part of the errors within two standard deviations, for each recording."""
    yield '## Covariances'
    yield (
        'Part of the errors of whole tracks within two standard deviations; 0.95 is consistent. '
        '[Covariances](results/certainty.md) has squared errors, the other estimates and classes.'
    )
    rows = []
    for _, document in _measurements(store, 'covariance'):
        for recording, estimates in document['results'].items():
            coverage = estimates['track']['all']['coverage']
            rows.append(
                [f'`{recording}`', *(_number(coverage[key], 2) for key in CONSISTENCY_VARIABLES)]
            )
    yield _table(['', *CONSISTENCY_VARIABLES], rows)


def _ranking(store: Path) -> Iterable[str]:
    """Yield the share of bad tracks in the first fifth of each list, for each recording."""
    yield '## Review list'
    yield (
        'Share of the worst tracks that are in the first fifth of the list: by risk, and by the '
        'orders it is compared with. [Review list](results/certainty.md#review-list) has shorter '
        'parts of the lists, and the gain of one corrected box.'
    )
    rows = []
    for _, document in _measurements(store, 'review'):
        for recording, inputs in document['results'].items():
            for name, found in inputs.items():
                shares = found['shares']
                start = f'`{recording}`, {name} ({found["bad"]} of {found["tracks"]})'
                rows.append([start, *(_number(share[-1], 2) for share in shares.values())])
    yield _table(['', *shares], rows)


def _times(store: Path) -> Iterable[str]:
    """Yield the main figures of speed, memory and latency beside their aims."""
    yield '## Speed'
    yield (
        'On two cores of a CPU. [Speed](results/speed.md) has all figures, '
        '[The live node under load](results/node.md#under-load) latencies, '
        '[Scale](results/speed.md#scale) core-hours of a fleet.'
    )
    ((_, speed),) = _measurements(store, 'speed')
    ((_, load),) = _measurements(store, 'load')
    found = speed['results']
    relabel, solver, ticks = found['relabel'], found['solver'], found['ticks']
    crop, latency = found['crop'], load['results']['deadline']
    times = solver['reference'] / solver['refine, track']
    rows = [
        [
            '`boxreg relabel`: recorded time over run time',
            f'{relabel["faster, long"]:.1f}',
            f'at least {WANTED["faster, long"]:g}',
        ],
        [
            '`boxreg relabel`: memory [MB]',
            f'{relabel["memory, shared once"]:.0f}',
            f'at most {WANTED["memory, shared once"]:g}',
        ],
        *(
            [f'one sweep of {tracks} tracks [ms]', f'{ticks[tracks]:.1f}', f'at most {aim:g}']
            for tracks, aim in WANTED_TICKS.items()
        ),
        ['tracks held at 10 Hz', str(found['held tracks']), f'at least {WANTED_TRACKS}'],
        [
            f'`refine`, per window [ms] (`torch.optim.LBFGS`: {solver["reference"]:.0f})',
            f'{solver["refine, track"]:.2f}, {times:.0f} times faster',
            f'at least {WANTED_TIMES:g} times',
        ],
        [
            f'crop of a sweep [ms] (numpy, box by box: {crop["numpy, box by box"]:.0f})',
            f'{crop["ours"]:.1f}',
            '',
        ],
        *(
            [f'node: latency of {tracks} tracks, p99 [ms]', f'{row["latency p99 [ms]"]:.0f}', '']
            for tracks, row in latency.items()
        ),
    ]
    yield _table(['', 'measured', 'aim'], rows)


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
        yield _table(*_parts(measured, '3D IoU'))
        if 'by_class' in measured['input']:
            yield _classes(measured)
        yield from _compared(measured)
        for name, reason in skipped.items():
            yield f'{name}: {reason}.'


def _parts(measured: Any, iou: str) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of the IoU by range, by number of points and of moving objects."""
    header = [iou]
    rows = {name: [name] for name, row in measured.items() if 'by_range' in row}
    for key, unit in (('by_range', 'm'), ('by_points', 'points')):
        labels = list(dict.fromkeys(part for name in rows for part in measured[name][key]))
        if len(labels) < 2:  # the same as the mean of all boxes
            continue
        header += [f'{label} {unit}' for label in labels]
        for name, row in rows.items():
            row += [_number(measured[name][key].get(label)) for label in labels]
    moving = {name: measured[name]['moving'] for name in rows if 'moving' in measured[name]}
    if moving:
        header += [f'moving ({moving["input"]["boxes"]}): BEV', '3D', 'yaw [degrees]']
    for name, found in moving.items():
        rows[name] += [_number(found['iou_bev']), _number(found['iou_3d'])]
        rows[name].append(_number(found['yaw_degrees'], 2))
    return header, list(rows.values())


def _compared(measured: Any) -> Iterable[str]:
    """Yield the table of the differences between methods."""
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
        yield _with_error(found, key)


def _with_error(found: Any, key: str) -> str:
    """Return a difference with its standard error."""
    return f'{_signed(found[key], 4)}±{_number(found[f"{key}_error"], 4)}'


def _classes(measured: Any) -> str:
    """Return the table of BEV and 3D IoU of each class, of all its boxes with points."""
    names = measured['input']['by_class']
    header = [f'{name} ({row["boxes"]})' for name, row in names.items()]
    rows = []
    for method, scores in measured.items():
        found = [scores['by_class'][name] for name in names]
        pairs = [f'{_number(row["iou_bev"])}/{_number(row["iou_3d"])}' for row in found]
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
        yield _table(*_parts(measured, iou))


def _ingredients() -> str:
    """Return the table of the ingredients that are switched off."""
    rows = [[name, item.meaning] for name, item in INGREDIENTS.items() if name != WHOLE]
    return _table(['without', 'the change'], rows, '---')


def _ablation(results: Any) -> Iterable[str]:
    """Yield for each recording the losses without an ingredient, the largest first."""
    order = results.pop('greedy', [])
    for found in results.values():
        parts = ('3D', 'loss', 'R@0.8 loss')
        titles = [f'{estimate}: {part}' for estimate in found for part in parts]
        best = {estimate: rows['nothing'] for estimate, rows in found.items()}
        names = sorted(
            next(iter(found.values())),
            key=lambda name: min(
                rows[name]['iou_3d'] - best[e]['iou_3d'] for e, rows in found.items()
            ),
        )
        rows = []
        for name in ['nothing', *(name for name in names if name != 'nothing')]:
            cells = []
            for estimate, of in found.items():
                own, whole = of[name], best[estimate]
                cells += [
                    _number(own['iou_3d']),
                    _signed(whole['iou_3d'] - own['iou_3d'], 4),
                    _signed(whole['recall_3d'][-1] - own['recall_3d'][-1], 3),
                ]
            rows.append([name, *cells])
        yield _table(['without', *titles], rows)
    if order:
        yield _table(['without all of', 'largest loss'], [[a, _signed(b, 4)] for a, b in order])


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


def _node(results: Any) -> Iterable[str]:
    """Yield the figures of one run, or of several runs side by side."""
    runs: dict[str, dict[str, str]] = {}
    for name, value in _flat(results):
        run, _, figure = name.partition(': ')
        if not run.endswith(('recording 1', 'recording 2')):
            run, figure = '', name
        runs.setdefault(run, {})[figure] = value
    alone = runs.pop('', {})
    if runs:
        figures = list(dict.fromkeys(figure for run in runs.values() for figure in run))
        rows = [[figure, *(run.get(figure, '-') for run in runs.values())] for figure in figures]
        yield _table(['', *runs], rows)
    yield _table(['', ''], alone.items())


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


def _points(results: Any) -> Iterable[str]:
    """Yield the scores of labels of points, one column for each kind of boxes."""
    scores = dict.fromkeys(score for found in results.values() for score in found)
    rows = [
        [score, *(_number(found.get(score)) for found in results.values())] for score in scores
    ]
    yield _table(['', *results], rows)


def _review(results: Any) -> Iterable[str]:
    """Yield the share of bad tracks at the top of each list, per recording and input, and pins."""
    pinned = []
    for recording, inputs in results.items():
        for name, found in inputs.items():
            rows = [[order, *map(_number, shares)] for order, shares in found['shares'].items()]
            head = f'{recording}, {name}: worst {found["bad"]} of {found["tracks"]}'
            yield _table([head, '1 %', '5 %', '10 %', '20 %'], rows)
            pins = found['pins']
            pinned.append(
                [
                    f'{recording}, {name}',
                    *(_number(pins[key]) for key in ('before', 'after')),
                    *(f'{pins[key]:.0%}' for key in ('gained', 'constant')),
                    *(_number(pins['left'][key], 2) for key in ('along', 'across', 'up')),
                    _number(pins['left']['yaw']),
                ]
            )
    header = (
        'one box of each pinned', '3D IoU before', 'after', 'of 1 - IoU removed',
        'constant along a track', 'left: along [m]', 'across', 'up', 'yaw [rad]',
    )  # fmt: skip
    yield _table(header, pinned)


def _labeller(results: Any) -> Iterable[str]:
    """Yield the errors before and after the review of a planted drive, and what it takes."""
    stages = (('planted', 'planted'), ('relabelled', 'after `boxreg relabel`'),
              ('reviewed', 'after the review'))  # fmt: skip
    kinds = list(results['planted'])
    rows = [[title, *(str(results[stage][kind]) for kind in kinds)] for stage, title in stages]
    yield _table(['errors', *kinds], rows)
    kinds_of_actions = ', '.join(f'{count} {name}s' for name, count in results['kinds'].items())
    yield (
        f'{results["actions"]} actions ({kinds_of_actions}) and {results["seconds"]:.0f} s, of '
        f'these {results["thinking"]:.0f} s of thought; {results["actions_before"]} actions '
        f'where files are edited by hand.'
    )


def _covariance(results: Any) -> Iterable[str]:
    """Yield coverage and NEES of each variable, by estimate and class, one table per recording."""
    for recording, estimates in results.items():
        rows = [
            [f'{estimate}, {name}', f'{group["boxes"]} of {group["tracks"]}', *_consistent(group)]
            for estimate, groups in estimates.items()
            for name, group in _different(groups).items()
        ]
        variables = next(iter(next(iter(estimates.values())).values()))['nees']
        yield _table([recording, 'boxes of tracks', *variables], rows)
    low, high = CONSISTENT_NEES
    header = (
        'cells of kinds: along, across, up, yaw', 'cells', 'covered 90 to 98 %', 'more', 'less',
        f'NEES {low:g} to {high:g}', 'less', 'more', f'more by {SIGNIFICANT:g} standard errors',
    )  # fmt: skip
    yield _table(header, [[name, *_consistent_cells(of)] for name, of in results.items()])
    yield _cells_and_chance(results)


def _different(groups: Any) -> dict[str, Any]:
    """Return the groups of objects without those that have the same boxes as an earlier one."""
    found: dict[str, Any] = {}
    for name, group in groups.items():
        if group not in found.values():
            found[name] = group
    return found


def _consistent(group: Any) -> Iterable[str]:
    for name, nees in group['nees'].items():
        error = group['nees_error'][name]
        spread = '' if error is None else f'±{error:.1f}'
        yield f'{group["coverage"][name]:.2f}, {nees:.1f}{spread}'


def _cells_of_kinds(estimates: Any) -> list[tuple[str, Any, str]]:
    """Return the cells of the kinds along, across, up and in yaw: name, group and variable."""
    return [
        (f'{estimate} {kind} {variable}', group, variable)
        for estimate, groups in estimates.items()
        for kind, group in groups.items()
        if kind in {f'{kind}s' for kind in KINDS}
        for variable in CONSISTENCY_VARIABLES[:4]
    ]


def _consistent_cells(estimates: Any) -> Iterable[str]:
    """Yield how many cells of the kinds are consistent, and which are not."""
    cells = _cells_of_kinds(estimates)
    low, high = CONSISTENT_NEES
    coverage = [group['coverage'][variable] for _, group, variable in cells]
    nees = [group['nees'][variable] for _, group, variable in cells]
    overconfident = [
        f'{name} {value:.1f}±{group["nees_error"][variable]:.1f}'
        for (name, group, variable), value in zip(cells, nees, strict=True)
        if value - high > SIGNIFICANT * (group['nees_error'][variable] or math.inf)
    ]
    for count in (
        len(cells),
        sum(0.9 <= part <= 0.98 for part in coverage),
        sum(part > 0.98 for part in coverage),
        sum(part < 0.9 for part in coverage),
        sum(low <= value <= high for value in nees),
        sum(value < low for value in nees),
        sum(value > high for value in nees),
    ):
        yield str(count)
    yield ', '.join(overconfident) or 'none'


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


def _scale(results: Any) -> Iterable[str]:
    """Yield the main figures with their meaning, and all figures."""
    job, large, workers, fleet = (results[name] for name in ('job', 'large', 'workers', 'fleet'))
    used = [workers[name]['cores_used'] for name in ('one', 'two')]
    rows = [
        (
            'job.hours_per_core_hour',
            f'{job["hours_per_core_hour"]:.2f}',
            f'hours of recording; {_recording_size(job)}',
        ),
        ('job.peak_mb', f'{job["peak_mb"]:,.0f} MB', 'memory of the job'),
        (
            'workers.speedup',
            f'{workers["speedup"]:.2f}',
            f'two workers by one; they used {used[1]:.2f} cores and {used[0]:.2f}',
        ),
        (
            'large.hours_per_core_hour',
            f'{large["hours_per_core_hour"]:.2f}',
            f'hours of recording; {_recording_size(large)}',
        ),
        ('large.peak_mb', f'{large["peak_mb"]:,.0f} MB', f'memory for {large["gb"]:.1f} GB'),
        ('large.inspect_s', f'{large["inspect_s"]:.1f} s', '`boxreg inspect` of it'),
        (
            'fleet.core_hours',
            f'{fleet["core_hours"]:,.0f}',
            f'10,000 hours of recording as `{fleet["basis"]}`',
        ),
        (
            'fleet.usd',
            f'{fleet["usd"]:,.0f} USD',
            f'the same, at {fleet["usd_per_core_hour"]:.2f} USD a core-hour',
        ),
        (
            'fleet.hours',
            f'{fleet["hours"]:.2f} h',
            f'10,000 jobs on 500 cores; {fleet["least_hours"]:.2f} h without losses or idle cores',
        ),
        ('fleet.used', f'{fleet["used"]:.0%}', 'part of the time that the cores have jobs'),
        ('fleet.lost', f'{fleet["lost"]:.2%}', 'part of the work that is done twice'),
    ]
    named = [[f'`{name}`', *cells] for name, *cells in rows]
    yield _table(['figure', 'value', 'of'], named, '---')
    shown = {name for name, *_ in rows}
    others = [row for row in _flat(results) if row[0].replace(': ', '.') not in shown]
    yield _table(['', ''], others)


def _recording_size(measured: Any) -> str:
    """Return the size of a recording."""
    return (
        f'{measured["recording_s"]:,.0f} s, {measured["sweeps"]:,} sweeps of '
        f'{measured["points_per_sweep"]:,} points, {measured["boxes"]:,} boxes'
    )


def _load(results: Any) -> Iterable[str]:
    """Yield latency and accuracy by number of tracks, one table per way to treat overload."""
    for policy, rows in results.items():
        names = list(next(iter(rows.values())))
        lines = [[tracks, *(_number(row[name]) for name in names)] for tracks, row in rows.items()]
        yield _table([f'{policy}: tracks', *names], lines)


def _flat(results: Any) -> Iterable[list[str]]:
    """Yield names and values; those of the start, the middle and the end of a run in one row."""
    rows: dict[str, list[str]] = {}
    for name, value in _named(results):
        rows.setdefault(PART_OF_RUN.sub(': start, middle, end', name), []).append(value)
    for name, values in rows.items():
        yield [name, ', '.join(values)]


def _named(results: Any, prefix: str = '') -> Iterable[tuple[str, str]]:
    for name, value in results.items():
        if isinstance(value, dict):
            yield from _named(value, f'{prefix}{name}: ')
        elif isinstance(value, float):
            yield f'{prefix}{name}', f'{value:,.0f}' if value >= 1e4 else f'{value:.4g}'
        else:
            yield f'{prefix}{name}', str(value)


TABLES: dict[str, Callable[[Any], Iterable[str]]] = {
    'real': _accuracy,
    'kinds': _kinds_of_objects,
    'tracks': _tracks,
    'paper': _paper,
    'ablation': _ablation,
    'sensitivity': _sensitivity,
    'highway': _highway,
    'points': _points,
    'lidars': _lidars,
    'covariance': _covariance,
    'review': _review,
    'labeller': _labeller,
    'report': _figures,
    'speed': _figures,
    'load': _load,
    'scale': _scale,
    'kills': _figures,
    'node': _node,
}
"""The tables of one measurement, for each kind of measurements."""


if __name__ == '__main__':
    sys.exit(main())
