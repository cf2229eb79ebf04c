"""
Write the tables of `docs/results.md` and `docs/results/` from the stored measurements.

    python docs/results.py               write the pages
    python docs/results.py --check       exit with status 1 if a page is not what would be written
    python docs/results.py --all KIND    print all tables of a kind of measurements

A measurement is the output of ``boxreg bench`` or of ``test/measure``, stored as
``KIND_DATA.json``, for example ``real_pandaset_002_a.json`` of ``boxreg bench real pandaset_002_a
--json``. A page has the rows that a reader decides by, between two marks; the text around them is
written by hand. The page of a kind is ``KIND.md``, or the one that `PAGES` has for it.
`docs/results.md` has the main figures of each kind. `result_tables` has all tables.

"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
import sys
from typing import Any

from boxreg_ros import __version__
from boxreg_ros.bench.ablation import INGREDIENTS, WHOLE
from boxreg_ros.bench.speed.report import WANTED, WANTED_TICKS, WANTED_TIMES, WANTED_TRACKS
from boxreg_ros.offline.consistency import (
    CONSISTENCY_VARIABLES,
    CONSISTENT_NEES,
)
from generate import between_marks
from result_tables import (
    all_tables,
    cells_and_chance,
    cells_of_kinds,
    consistent,
    DATA,
    measurements,
    MIN_TRACKS,
    number,
    plain,
    signed,
    table,
    TABLES,
    title_of,
    with_error,
)

DOCS = Path(__file__).resolve().parent
STORE = DOCS / 'results'
OVERVIEW = DOCS / 'results.md'
FOLDED = 'All tables: `python docs/results.py --all {}`'
"""The site folds all tables of a kind in place of this line."""

PAGES = {
    **dict.fromkeys(('kinds', 'points', 'highway', 'lidars', 'paper'), 'scenes'),
    **dict.fromkeys(('covariance', 'review', 'labeller'), 'certainty'),
    **dict.fromkeys(('ablation', 'sensitivity'), 'ablation'),
    **dict.fromkeys(('speed', 'scale', 'report'), 'speed'),
    **dict.fromkeys(('node', 'load', 'kills'), 'node'),
}
"""Page of the kinds of measurements that share one; the others have a page of their name."""
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
    parser.add_argument('--all', metavar='KIND', choices=TABLES, help='print all tables of a kind')
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
    parts = [(OVERVIEW, '', _overview(store))]
    for kind in TABLES:
        page = STORE / f'{PAGES.get(kind, kind)}.md'
        parts.append((page, kind if kind in PAGES else '', _deciding(store, kind)))
    written: dict[Path, str] = {}
    for page, section, lines in parts:
        text = written.get(page) or page.read_text(encoding='utf-8')
        written[page] = between_marks(page.name, text, '\n'.join(lines), section)
    return written


def _deciding(store: Path, kind: str) -> Iterable[str]:
    """Yield the rows of a kind to decide by, and the place of all tables; these where few."""
    if kind in DECIDING:
        yield from (f'{part}\n' for part in DECIDING[kind](measurements(store, kind)))
        yield FOLDED.format(kind)
    else:
        yield from all_tables(store, kind)


def _overview(store: Path) -> Iterable[str]:
    """Yield the main tables of `docs/results.md`."""
    recordings = [[f'`{name}`', *texts] for name, texts in DATA.items()]
    yield table(['recording', 'title', 'content'], recordings, '---')
    yield f'\nMeasured by version {__version__}, where no other one is named.'
    yield ''
    for section in (_mean_ious, _gains, _completion, _coverage, _ranking, _times):
        yield from (f'{part}\n' for part in section(store))


def _mean_ious(store: Path) -> Iterable[str]:
    """Yield the mean 3D IoU of the main methods on each recording."""
    yield '## Accuracy'
    yield (
        'Mean 3D IoU (number of true boxes). [Accuracy](results/real.md) has the other scores, '
        '[Ablation](results/ablation.md) the loss without each ingredient.'
    )
    rows = []
    for data, document in measurements(store, 'real'):
        for methods in document['results'].values():
            ious = (number(methods[method]['iou_3d']) for method in MAIN_METHODS)
            rows.append([f'`{data}` ({methods["input"]["boxes"]})', *ious])
    yield table(['3D IoU', *MAIN_METHODS], rows)


def _gains(store: Path) -> Iterable[str]:
    """Yield the gain of 3D IoU of each class on the simulated streets."""
    yield '## Classes'
    yield (
        'Mean 3D IoU minus that of the input and of smoothing, with standard errors over tracks. '
        '[Gain of each class](results/scenes.md) has the other recordings.'
    )
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
    yield '## Completed tracks'
    yield (
        'Broken tracks as they are given -> with `--complete`; in brackets those of the same '
        'tracks before they were broken, the best that completion can restore. '
        '[Completed tracks](results/tracks.md) has ghosts, distant misses and the node.'
    )
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
    yield '## Covariances'
    yield (
        'Part of the errors of whole tracks within two standard deviations; 0.95 is consistent. '
        '[Covariances](results/certainty.md) has squared errors and the other estimates.'
    )
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
    yield '## Review list'
    yield (
        'Share of the worst tracks that are in the first fifth of the list: by risk, and by the '
        'orders it is compared with. [Review list](results/certainty.md#review-list) has shorter '
        'parts of the lists, and the gain of one corrected box.'
    )
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
    yield '## Speed'
    yield (
        'On two cores of a CPU. [Speed](results/speed.md) has all figures, '
        '[The live node under load](results/node.md#under-load) latencies, '
        '[Scale](results/speed.md#scale) core-hours of a fleet.'
    )
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
    yield table(['', 'measured', 'aim'], rows)


def _accuracy(documents: Iterable[tuple[str, Any]]) -> Iterable[str]:
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
            yield table([title_of(data), *header.split()], rows)
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


def _kinds_of_objects(documents: Iterable[tuple[str, Any]]) -> Iterable[str]:
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
                if final['input']['tracks'] < MIN_TRACKS and all(g['iou_3d'] > 0 for g in found):
                    continue
                start = f'{data.replace("_", " ")}: {name} ({final["input"]["boxes"]})'
                rows.append([start, *(with_error(gain, 'iou_3d') for gain in found)])
    columns = ('final - input', 'final - smoothing', 'track - input', 'track - smoothing')
    yield table(['3D IoU: class (boxes)', *columns], rows)


def _tracks(documents: Iterable[tuple[str, Any]]) -> Iterable[str]:
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
            rows.append([title_of(data), *scores, f'{after["added"]}', *others])
    scores = ['recall', 'precision', 'ids per object', 'HOTA']
    yield table(
        ['', *scores, 'added', '3D IoU of added', 'ghosts rejected', 'others rejected'], rows
    )


def _paper(documents: Iterable[tuple[str, Any]]) -> Iterable[str]:
    """Yield the main rows of Table I of each mode."""
    ((_, document),) = documents
    for mode, methods in document['results'].items():
        pose = ['x', 'y', 'z', 'roll', 'pitch', 'yaw'] if mode == '3d' else ['x', 'y', 'yaw']
        names = (
            'initial, published', 'refined, published', 'input', 'smoothing only',
            'paper, track', 'ours, final', 'ours, track', 'held extents, final',
        )  # fmt: skip
        rows = [[name, *(number(methods[name].get(c)) for c in (*pose, 'iou'))] for name in names]
        yield table([f'mode: {mode}', *pose, '3D IoU' if mode == '3d' else 'BEV IoU'], rows)


def _ablation(documents: Iterable[tuple[str, Any]]) -> Iterable[str]:
    """Yield the losses of 3D IoU without each ingredient on all recordings, the largest first."""
    losses: dict[str, list[list[float]]] = {name: [] for name in INGREDIENTS if name != WHOLE}
    titles = []
    for data, document in documents:
        estimates = document['results'][data].values()
        titles.append(title_of(data))
        for name, found in losses.items():
            found.append([rows[WHOLE]['iou_3d'] - rows[name]['iou_3d'] for rows in estimates])
    rows = [
        [f'{name}: {INGREDIENTS[name].meaning}', *(' / '.join(map(_loss, pair)) for pair in found)]
        for name, found in sorted(losses.items(), key=lambda item: -max(map(max, item[1])))
    ]
    yield table(['without', *titles], rows)


def _loss(value: float) -> str:
    """Return a loss of IoU in thousandths."""
    return signed(1000 * value, 0)


def _sensitivity(documents: Iterable[tuple[str, Any]]) -> Iterable[str]:
    """Yield the numbers with the largest losses on all recordings."""
    names: list[str] = []
    found: dict[tuple[str, str], dict[str, float]] = {}
    for data, document in documents:
        names.append(title_of(data))
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


def _highway(documents: Iterable[tuple[str, Any]]) -> Iterable[str]:
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


def _points(documents: Iterable[tuple[str, Any]]) -> Iterable[str]:
    """Yield the main scores of labels of points, with boxes of the input and refined ones."""
    scores = ('IoU moving', 'IoU vehicle instances', 'unknown', 'shadows in the map')
    rows = []
    for data, document in documents:
        found = document['results']
        cells = [_change(found['input'], found['ours, track'], score) for score in scores]
        rows.append([title_of(data) or data.replace('_', ' '), *cells])
    yield table(['', *scores], rows)


def _covariance(documents: Iterable[tuple[str, Any]]) -> Iterable[str]:
    """Yield the NEES of all objects, and the count of cells within the band."""
    ((_, document),) = documents
    results = document['results']
    rows, counts = [], []
    low, high = CONSISTENT_NEES
    for recording, estimates in results.items():
        for estimate, groups in estimates.items():
            found = (cell.partition(', ')[2] for cell in consistent(groups['all']))
            rows.append([f'{recording}, {estimate}', *found])
        cells = cells_of_kinds(estimates)
        nees = [group['nees'][variable] for _, group, variable in cells]
        band = (
            sum(low <= value <= high for value in nees),
            sum(value < low for value in nees), sum(value > high for value in nees),
        )  # fmt: skip
        counts.append([recording, str(len(cells)), *map(str, band)])
    yield table(['NEES', *CONSISTENCY_VARIABLES], rows)
    yield table(['cells of kinds', 'cells', f'NEES {low:g} to {high:g}', 'less', 'more'], counts)
    yield cells_and_chance(results)


def _review(documents: Iterable[tuple[str, Any]]) -> Iterable[str]:
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


def _report(documents: Iterable[tuple[str, Any]]) -> Iterable[str]:
    """Yield how smoothly a report of 1,000 tracks moves, by both ways to draw."""
    ((_, document),) = documents
    (page,) = (of for name, of in document['results'].items() if name.startswith('1,000 tracks'))
    ways = {name: of for name, of in page.items() if isinstance(of, dict)}
    rows = [
        [figure, *(f'{of[figure]:.3g}' for of in ways.values())]
        for figure in next(iter(ways.values()))
    ]
    yield table(['1,000 tracks of 80 boxes', *ways], rows)


def _speed(documents: Iterable[tuple[str, Any]]) -> Iterable[str]:
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


def _scale(documents: Iterable[tuple[str, Any]]) -> Iterable[str]:
    """Yield the main figures with their meaning."""
    ((_, document),) = documents
    yield next(iter(TABLES['scale'](document['results'])))


def _node(documents: Iterable[tuple[str, Any]]) -> Iterable[str]:
    """Yield the main figures of the node in each run, side by side."""
    figures = (
        'early published [%]', 'final published [%]', 'latency p50 [ms]', 'latency p99 [ms]',
        'latency max [ms]', 'memory at the start [MB]', 'memory at the end [MB]',
        'handles at the start', 'handles at the end', 'cores used', 'recorded [MB]',
        'box arrays not recorded',
    )  # fmt: skip
    runs: dict[str, Any] = {}
    for data, document in documents:
        for name, value in document['results'].items():
            run, _, figure = name.rpartition(': ')
            if figure in figures and 'recorder' not in run and not run.endswith('2'):
                runs.setdefault(run or data.replace('_', ' '), {})[figure] = value
    rows = [
        [figure, *(plain(run[figure]) if figure in run else '-' for run in runs.values())]
        for figure in figures
    ]
    yield table(['', *runs], rows)


def _load(documents: Iterable[tuple[str, Any]]) -> Iterable[str]:
    """Yield latency and accuracy by number of tracks with the default deadline."""
    ((_, document),) = documents
    yield next(iter(TABLES['load']({'deadline': document['results']['deadline']})))


def _kills(documents: Iterable[tuple[str, Any]]) -> Iterable[str]:
    """Yield the time of the boxes that are lost with each process."""
    ((_, document),) = documents
    killed: dict[str, dict[str, str]] = {}
    for name, value in document['results'].items():
        process, of_process, figure = name.partition(': ')
        if of_process:
            killed.setdefault(process, {})[figure] = f'{value:.2g}'
    rows = [[process, *found.values()] for process, found in killed.items()]
    figures = list(next(iter(killed.values())))
    yield table(['', *figures], rows)


DECIDING: dict[str, Callable[[Iterable[tuple[str, Any]]], Iterable[str]]] = {
    'real': _accuracy,
    'kinds': _kinds_of_objects,
    'tracks': _tracks,
    'paper': _paper,
    'ablation': _ablation,
    'sensitivity': _sensitivity,
    'highway': _highway,
    'points': _points,
    'covariance': _covariance,
    'review': _review,
    'report': _report,
    'speed': _speed,
    'scale': _scale,
    'node': _node,
    'load': _load,
    'kills': _kills,
}
"""The rows to decide by of all measurements of a kind; the other kinds have few rows."""


if __name__ == '__main__':
    sys.exit(main())
