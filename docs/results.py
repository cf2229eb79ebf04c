"""
Write the tables of `docs/results.md` and `docs/results/` from the stored measurements.

    python docs/results.py               write the pages
    python docs/results.py --check       exit with status 1 if a page is not what would be written
    python docs/results.py --all KIND    print all tables of a kind of measurements

A measurement is the output of ``python test/measure``, stored as ``KIND_DATA.json``, for example
``real_pandaset_002_a.json`` of ``python test/measure real pandaset_002_a --json``. A page has the
rows that a reader decides by, between two marks; the text around them is written by hand. `KINDS`
has the page of each kind and its tables; `docs/results.md` has the main figures of each.

"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from itertools import chain
from pathlib import Path
import sys
from typing import Any, NamedTuple

sys.path.append(str(Path(__file__).resolve().parents[1] / 'test'))  # the room of `measure`
from boxreg_ros import __version__
from boxreg_ros.offline.consistency import (
    CONSISTENCY_VARIABLES,
    CONSISTENT_NEES,
)
from generate import between_marks
from measure.ablation import INGREDIENTS, WHOLE
from measure.speed import WANTED
import result_tables
from result_tables import (
    cells_and_chance,
    DATA,
    grid,
    measurements,
    number,
    signed,
    table,
    with_error,
    within_band,
)

Documents = Iterable[tuple[str, Any]]
"""Data name and content of measurements."""
DOCS = Path(__file__).resolve().parent
STORE = DOCS / 'results'
OVERVIEW = DOCS / 'results.md'
FOLDED = 'All tables: `python docs/results.py --all {}`'
"""The site folds all tables of a kind in place of this line."""

MAIN_METHODS = (
    'input', 'smoothing only', 'ICP on box points', 'paper, track',
    'ours, early', 'ours, final', 'ours, track',
)  # fmt: skip
"""Methods of the overview: those that all recordings have."""
SHOWN_NUMBERS = 8
"""Numbers of the method that the page of the sensitivity shows."""


def main(words: Sequence[str] | None = None) -> int:
    """Write the pages or check them, and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1] if __doc__ else None)
    parser.add_argument('--check', action='store_true', help='write nothing; 1 if out of date')
    parser.add_argument('--all', metavar='KIND', choices=KINDS, help='print all tables of a kind')
    args = parser.parse_args(words)
    if args.all:
        print('\n'.join(all_tables(STORE, args.all)))
        return 0
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
    parts = [
        (OVERVIEW, name, [f'{part}\n' for part in section(store)])
        for name, section in OVERVIEW_SECTIONS.items()
    ]
    for name, kind in KINDS.items():
        section = name if kind.page in SHARED else ''
        parts.append((STORE / f'{kind.page}.md', section, _deciding(store, name)))
    written: dict[Path, str] = {}
    for page, section, lines in parts:
        text = written.get(page) or page.read_text(encoding='utf-8')
        written[page] = between_marks(page.name, text, '\n'.join(lines), section)
    return written


def _deciding(store: Path, kind: str) -> Iterable[str]:
    """Yield the rows of a kind to decide by, and the place of all tables; these where few."""
    deciding = KINDS[kind].deciding
    if deciding is None:
        yield from all_tables(store, kind)
    else:
        yield from (f'{part}\n' for part in deciding(measurements(store, kind)))
        yield FOLDED.format(kind)


def all_tables(store: Path, kind: str) -> Iterable[str]:
    """Yield for each measurement of a kind its title, its command and its tables."""
    if kind == 'ablation':
        yield f'{result_tables.ingredients()}\n'
    for data, document in measurements(store, kind):
        title = result_tables.title_of(data)
        if title:
            yield f'**{title}**\n'
        yield result_tables.origin(document)
        yield from (f'{part}\n' for part in KINDS[kind].tables(document['results']))


def _recordings(store: Path) -> Iterable[str]:
    """Yield the recordings, and the version that has measured them."""
    recordings = [[f'`{name}`', *texts] for name, texts in DATA.items()]
    yield table(['recording', 'title', 'content'], recordings, '---')
    yield f'Measured by version {__version__}, where no other one is named.'


def _mean_ious(store: Path) -> Iterable[str]:
    """Yield the mean 3D IoU of the main methods on each recording."""
    rows = []
    for data, document in measurements(store, 'real'):
        for methods in document['results'].values():
            ious = (number(methods[method]['iou_3d']) for method in MAIN_METHODS)
            rows.append([f'`{data}` ({methods["input"]["boxes"]})', *ious])
    yield table(['3D IoU', *MAIN_METHODS], rows)


def _gains(store: Path) -> Iterable[str]:
    """Yield the gain of 3D IoU of each class on the simulated streets."""
    document = dict(measurements(store, 'kinds'))['']
    for drives, classes in document['results'].items():
        rows = []
        for name, methods in classes.items():
            final, track = methods['ours, final'], methods['ours, track']
            gains = (
                final['input'], final['smoothing, final'], track['input'], track['smoothing only'],
            )  # fmt: skip
            boxes = track['input']['boxes']
            rows.append([f'{name} ({boxes})', *(with_error(gain, 'iou_3d') for gain in gains)])
        columns = ('final - input', 'final - smoothing', 'track - input', 'track - smoothing')
        yield table([f'{drives}: class (boxes)', *columns], rows)


def _completion(store: Path) -> Iterable[str]:
    """Yield the scores of broken tracks, of completed ones, and of tracks never broken."""
    rows = []
    for data, document in measurements(store, 'tracks'):
        if data in DATA:  # without other breaks
            for steps in document['results'].values():
                unbroken, *_, completed = steps.values()
                scores = [
                    f'{_change(steps["input"], completed, key)} ({number(unbroken[key])})'
                    for key in ('recall', 'ids_per_object', 'hota')
                ]
                rows.append([f'`{data}`', *scores, number(completed['added_iou'])])
    yield table(['', 'recall', 'ids per object', 'HOTA', '3D IoU of added'], rows)


def _change(before: Any, after: Any, key: str, digits: int = 3) -> str:
    """Return two values of a score."""
    return f'{number(before[key], digits)} -> {number(after[key], digits)}'


def _coverage(store: Path) -> Iterable[str]:
    """Yield the part of the errors within two standard deviations, for each recording."""
    rows = []
    for _, document in measurements(store, 'covariance'):
        for recording, estimates in document['results'].items():
            coverage = estimates['track']['all']['coverage']
            rows.append(
                [f'`{recording}`', *(number(coverage[key], 2) for key in CONSISTENCY_VARIABLES)]
            )
    yield table(['', *CONSISTENCY_VARIABLES], rows)


def _ranking(store: Path) -> Iterable[str]:
    """Yield the share of bad tracks in the first fifth of each list, for each recording."""
    rows = []
    for _, document in measurements(store, 'review'):
        for recording, inputs in document['results'].items():
            orders = next(iter(inputs.values()))['shares']
            cells = (
                ' / '.join(number(found['shares'][order][-1], 2) for found in inputs.values())
                for order in orders
            )
            rows.append([f'`{recording}`', *cells])
    yield table([' / '.join(inputs), *orders], rows)


def _times(store: Path) -> Iterable[str]:
    """Yield the main figures of speed, memory and latency beside their aims."""
    ((_, speed),) = measurements(store, 'speed')
    ((_, load),) = measurements(store, 'load')
    found = speed['results']
    relabel, solver, ticks = found['relabel'], found['solver'], found['ticks']
    crop, latency = found['crop'], load['results']['deadline']
    times = solver['reference'] / solver['refine, track']
    rows = [
        [
            '`boxreg relabel`: recorded time over run time',
            f'{relabel["faster, long"]:.1f}',
            f'at least {WANTED["relabel: faster, long"]:g}',
        ],
        [
            '`boxreg relabel`: memory [MB]',
            f'{relabel["memory, shared once"]:.0f}',
            f'at most {WANTED["relabel: memory, shared once"]:g}',
        ],
        *([f'one sweep of {n} tracks [ms]', f'{ticks[n]:.1f}', ''] for n in ('8', '64', '512')),
        ['tracks held at 10 Hz', str(found['held tracks']), f'at least {WANTED["held tracks"]:g}'],
        [
            f'`refine`, per window [ms] (`torch.optim.LBFGS`: {solver["reference"]:.0f})',
            f'{solver["refine, track"]:.2f}, {times:.0f} times faster',
            '',
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
    yield table(['', 'measured', 'aim'], rows)


def _accuracy(documents: Documents) -> Iterable[str]:
    """Yield the scores on each recording, and the gains over tracks."""
    header = 'BEV 3D R@0.7 R@0.8 ATE ASE AOE flips jitter'
    gains = []
    for data, document in documents:
        for methods in document['results'].values():
            rows = []
            for name in ('input', 'smoothing only', 'ours, final', 'ours, track'):
                row = methods[name]
                ious = (row['iou_bev'], row['iou_3d'], *row['recall_3d'][1:])
                others = (row[key] for key in ('ate', 'ase', 'aoe', 'flips', 'jitter'))
                rows.append([name, *map(number, (*ious, *others))])
            yield table([result_tables.title_of(data), *header.split()], rows)
            of = {name: methods[name]['differences']['all'] for name in MAIN_METHODS[-2:]}
            pairs = (
                ('ours, final', 'input'), ('ours, final', 'smoothing, final'),
                ('ours, track', 'input'), ('ours, track', 'smoothing only'),
            )  # fmt: skip
            cells = [
                f'{with_error(of[a][b], "iou_3d")}, {of[a][b]["tracks_ahead"]}' for a, b in pairs
            ]
            start = f'`{data}` ({of["ours, track"]["input"]["tracks"]})'
            gains.append([start, *cells])
    columns = ('final - input', 'final - smoothing', 'track - input', 'track - smoothing')
    yield table(['3D IoU (tracks), tracks ahead', *columns], gains)


def _kinds_of_objects(documents: Documents) -> Iterable[str]:
    """Yield the gain of each class over input and smoothing: that has some tracks, or a loss."""
    rows = []
    for data, document in documents:
        if not data:
            continue  # the streets, on the overview
        for classes in document['results'].values():
            for name, methods in classes.items():
                final, track = methods['ours, final'], methods['ours, track']
                found = (
                    final['input'], final['smoothing, final'],
                    track['input'], track['smoothing only'],
                )  # fmt: skip
                if final['input']['tracks'] < result_tables.MIN_TRACKS and all(
                    g['iou_3d'] > 0 for g in found
                ):
                    continue
                start = f'{data.replace("_", " ")}: {name} ({final["input"]["boxes"]})'
                rows.append([start, *(with_error(gain, 'iou_3d') for gain in found)])
    columns = ('final - input', 'final - smoothing', 'track - input', 'track - smoothing')
    yield table(['3D IoU: class (boxes)', *columns], rows)


def _tracks(documents: Documents) -> Iterable[str]:
    """Yield the scores before and after completion for each kind of breaks, in one table."""
    rows = []
    for data, document in documents:
        for steps in document['results'].values():
            before, (*_, after) = steps['input'], steps.values()
            scores = [
                _change(before, after, key)
                for key in ('recall', 'precision', 'ids_per_object', 'hota')
            ]
            others = (number(after[key]) for key in ('added_iou', 'ghosts_rejected', 'lost'))
            rows.append([result_tables.title_of(data), *scores, f'{after["added"]}', *others])
    scores = ['recall', 'precision', 'ids per object', 'HOTA']
    yield table(
        ['', *scores, 'added', '3D IoU of added', 'ghosts rejected', 'others rejected'], rows
    )


def _paper(documents: Documents) -> Iterable[str]:
    """Yield the main rows of Table I of each mode."""
    ((_, document),) = documents
    for mode, methods in document['results'].items():
        pose = ['x', 'y', 'z', 'roll', 'pitch', 'yaw'] if mode == '3d' else ['x', 'y', 'yaw']
        columns = {name: name for name in pose}
        columns['3D IoU' if mode == '3d' else 'BEV IoU'] = 'iou'
        names = (
            'initial, published', 'refined, published', 'input', 'smoothing only',
            'paper, track', 'ours, final', 'ours, track', 'held extents, final',
            'held extents, short tracks',
        )  # fmt: skip
        yield grid(f'mode: {mode}', columns, {name: methods[name] for name in names})


def _ablation(documents: Documents) -> Iterable[str]:
    """
    Yield the losses of 3D IoU without each ingredient on all recordings, the largest first.

    Those within two standard errors of zero on all of them are named only.

    """
    losses: dict[str, list[list[dict[str, float]]]] = {}
    titles = []
    for data, document in documents:
        estimates = document['results'][data].values()
        titles.append(result_tables.title_of(data))
        for name in INGREDIENTS:
            found = [rows[name] for rows in estimates if name in rows]
            if found and name != WHOLE:
                losses.setdefault(name, []).append(found)
    shown = {name: pairs for name, pairs in losses.items() if any(map(_differs, chain(*pairs)))}
    rows = [
        [
            f'{name}: {INGREDIENTS[name].meaning}',
            *(' / '.join(map(_loss_with_error, pair)) for pair in pairs),
        ]
        for name, pairs in sorted(shown.items(), key=lambda item: -_largest(item[1]))
    ]
    yield table(['without', *titles], rows)
    others = ', '.join(name for name in losses if name not in shown)
    if others:
        yield f'Within two standard errors of zero everywhere: {others}.'


def _differs(row: dict[str, float]) -> bool:
    """Return whether a loss is more than two standard errors from zero."""
    return abs(row['loss']) > 2 * row['loss_error']


def _largest(pairs: list[list[dict[str, float]]]) -> float:
    return max(row['loss'] for row in chain(*pairs))


def _loss_with_error(row: dict[str, float]) -> str:
    """Return a loss of IoU in thousandths, with its standard error."""
    return f'{_loss(row["loss"])}±{1000 * row["loss_error"]:.0f}'


def _loss(value: float) -> str:
    """Return a loss of IoU in thousandths."""
    return signed(1000 * value, 0)


def _sensitivity(documents: Documents) -> Iterable[str]:
    """Yield the numbers with the largest losses on all recordings."""
    names: list[str] = []
    found: dict[tuple[str, str], dict[str, float]] = {}
    for data, document in documents:
        names.append(result_tables.title_of(data))
        for loss in document['results']['losses']:
            if not loss['failure']:
                key = (f'`{loss["name"]}`', f'{loss["factor"]:g}')
                found.setdefault(key, {})[names[-1]] = loss['volume']
    largest = sorted(found.items(), key=lambda item: -max(map(abs, item[1].values())))
    rows = [
        [*key, *(_loss(losses[name]) if name in losses else '-' for name in names)]
        for key, losses in largest[:SHOWN_NUMBERS]
    ]
    yield table(['setting or constant', 'factor', *names], rows)


def _highway(documents: Documents) -> Iterable[str]:
    """Yield the accuracy of each method by the time of the boxes and the speed."""
    ((_, document),) = documents
    results = document['results']
    columns = [f'{time}, {speed}' for time, rows in results.items() for speed in rows['input']]
    rows = [
        [name, *(number(value) for of in results.values() for value in of[name].values())]
        for name in next(iter(results.values()))
        if not name.startswith('smoothing, ')
    ]
    yield table(['3D IoU', *columns], rows)


def _points(documents: Documents) -> Iterable[str]:
    """Yield the main scores of labels of points, with boxes of the input and refined ones."""
    scores = ('IoU moving', 'IoU vehicle instances', 'unknown', 'shadows in the map')
    rows = []
    for data, document in documents:
        found = document['results']
        cells = [_change(found['input'], found['ours, track'], score) for score in scores]
        rows.append([result_tables.title_of(data) or data.replace('_', ' '), *cells])
    yield table(['', *scores], rows)


def _covariance(documents: Documents) -> Iterable[str]:
    """Yield the NEES of all objects, and the count of cells within the band."""
    ((_, document),) = documents
    results = document['results']
    rows, counts = [], []
    low, high = CONSISTENT_NEES
    for recording, estimates in results.items():
        for estimate, groups in estimates.items():
            found = (cell.partition(', ')[2] for cell in result_tables.consistent(groups['all']))
            rows.append([f'{recording}, {estimate}', *found])
        cells = result_tables.cells_of_kinds(estimates)
        nees = [group['nees'][variable] for _, group, variable in cells]
        counts.append([recording, str(len(nees)), *within_band(nees, CONSISTENT_NEES)])
    yield table(['NEES', *CONSISTENCY_VARIABLES], rows)
    yield table(['cells of kinds', 'cells', f'NEES {low:g} to {high:g}', 'less', 'more'], counts)
    yield cells_and_chance(results)


def _review(documents: Documents) -> Iterable[str]:
    """Yield what one pinned box of each of the worst tracks changes."""
    ((_, document),) = documents
    rows = []
    for recording, inputs in document['results'].items():
        for name, found in inputs.items():
            pins = found['pins']
            cells = (_change(pins | {'3d': pins['before']}, {'3d': pins['after']}, '3d'),
                     f'{pins["gained"]:.0%}')  # fmt: skip
            rows.append([f'{recording}, {name}', *cells])
    yield table(['one box of each pinned', '3D IoU', 'of 1 - IoU removed'], rows)


def _report(documents: Documents) -> Iterable[str]:
    """Yield how smoothly a report of 1,000 tracks moves, by both ways to draw."""
    ((_, document),) = documents
    (page,) = (of for name, of in document['results'].items() if name.startswith('1,000 tracks'))
    ways = {name: of for name, of in page.items() if isinstance(of, dict)}
    rows = [
        [figure, *(f'{of[figure]:.3g}' for of in ways.values())]
        for figure in next(iter(ways.values()))
    ]
    yield table(['1,000 tracks of 80 boxes', *ways], rows)


def _speed(documents: Documents) -> Iterable[str]:
    """Yield the parts of a tick and of a run."""
    ((_, document),) = documents
    found = document['results']
    tick = found['tick']
    stages = ('decode', 'transform', 'crop and sample', 'solve', 'encode', 'total', 'longest')
    yield table(['a sweep of 64 tracks', *stages],
                [['[ms]', *(number(tick[name], 2) for name in stages)]])  # fmt: skip
    solver = found['solver']
    ways = ('refine', 'refine, track', 'cold', 'warm', 'reference')
    yield table(['a window', *ways], [['[ms]', *(number(solver[name], 2) for name in ways)]])


def _scale(documents: Documents) -> Iterable[str]:
    """Yield the main figures with their meaning."""
    ((_, document),) = documents
    yield next(iter(result_tables.scale(document['results'])))


def _node(documents: Documents) -> Iterable[str]:
    """Yield the main figures of the node in each run, side by side."""
    figures = (
        'early published [%]', 'final published [%]', 'latency p50 [ms]', 'latency p99 [ms]',
        'latency max [ms]', 'memory at the start [MB]', 'memory at the end [MB]',
        'handles at the start', 'handles at the end', 'cores used',
    )  # fmt: skip
    runs = {data.replace('_', ' '): document['results'] for data, document in documents}
    rows = [
        [
            figure,
            *(result_tables.plain(run[figure]) if figure in run else '-' for run in runs.values()),
        ]
        for figure in figures
    ]
    yield table(['', *runs], rows)


def _load(documents: Documents) -> Iterable[str]:
    """Yield latency and accuracy by number of tracks with the default deadline."""
    ((_, document),) = documents
    yield from result_tables.load({'deadline': document['results']['deadline']})


def _detector(documents: Documents) -> Iterable[str]:
    """Yield the main precisions by the labels, the gaps closed, and the errors of the labels."""
    ((_, document),) = documents
    results = document['results']
    for drives in results['precision']:
        columns = result_tables.MAIN_PRECISIONS
        yield result_tables.precision_by_labels(results, drives, columns)
        yield result_tables.gains_of_precision(results, drives, columns)
        yield from result_tables.gaps_closed(results, drives)
    yield result_tables.quality_of_labels(results)
    yield result_tables.true_parts_of_labels(results)
    yield result_tables.errors_of_detectors(results)


OVERVIEW_SECTIONS = {
    'recordings': _recordings,
    'accuracy': _mean_ious,
    'classes': _gains,
    'completion': _completion,
    'coverage': _coverage,
    'ranking': _ranking,
    'times': _times,
}
"""The parts of `OVERVIEW`, by the names of their marks."""


class Kind(NamedTuple):
    """A kind of measurements."""

    page: str
    """Several kinds share one, each under its name."""
    tables: Callable[[Any], Iterable[str]]
    """All tables of one measurement."""
    deciding: Callable[[Documents], Iterable[str]] | None
    """The rows to decide by of all measurements; None where these are few."""


KINDS = {
    'real': Kind('real', result_tables.accuracy, _accuracy),
    'kinds': Kind('scenes', result_tables.kinds_of_objects, _kinds_of_objects),
    'detector': Kind('detector', result_tables.detector, _detector),
    'tracks': Kind('tracks', result_tables.tracks, _tracks),
    'paper': Kind('scenes', result_tables.paper, _paper),
    'ablation': Kind('ablation', result_tables.ablation, _ablation),
    'sensitivity': Kind('ablation', result_tables.sensitivity, _sensitivity),
    'highway': Kind('scenes', result_tables.highway, _highway),
    'points': Kind('scenes', result_tables.points, _points),
    'lidars': Kind('scenes', result_tables.lidars, None),
    'covariance': Kind('certainty', result_tables.covariance, _covariance),
    'review': Kind('certainty', result_tables.review, _review),
    'labeller': Kind('certainty', result_tables.labeller, None),
    'report': Kind('speed', result_tables.figures, _report),
    'speed': Kind('speed', result_tables.figures, _speed),
    'load': Kind('node', result_tables.load, _load),
    'scale': Kind('speed', result_tables.scale, _scale),
    'node': Kind('node', result_tables.figures, _node),
    'robot': Kind('node', result_tables.robot, None),
}
SHARED = {
    name for name, count in Counter(kind.page for kind in KINDS.values()).items() if count > 1
}
"""Pages that several kinds share."""


if __name__ == '__main__':
    sys.exit(main())
