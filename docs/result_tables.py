"""All tables of the stored measurements, one function for each kind of `results.KINDS`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import json
import math
from pathlib import Path
import re
from statistics import NormalDist
from typing import Any

from boxreg_ros import __version__
from boxreg_ros.config import KINDS
from boxreg_ros.offline.consistency import (
    CONSISTENCY_VARIABLES,
    CONSISTENT_NEES,
    SIGNIFICANT,
)
from measure.ablation import INGREDIENTS, WHOLE

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
PART_OF_RUN = re.compile(' (?:at the start|in the middle|at the end)')
SURE = 2.0
"""Standard errors of a gap that is divided by; of a smaller one no part can be said."""
SHOWN_LOSS = 0.001
"""Smaller changes of mean IoU are within the scatter of noise seeds."""


def measurements(store: Path, kind: str) -> list[tuple[str, Any]]:
    """Return data name and document of each measurement of a kind, in the order of `DATA`."""
    found = {
        path.stem.removeprefix(kind).removeprefix('_'): path
        for path in sorted(store.glob(f'{kind}*.json'))
    }
    names = [name for data in DATA for name in found if name.startswith(data)]
    names += [name for name in found if name not in names]
    return [(name, json.loads(found[name].read_text(encoding='utf-8'))) for name in names]


def title_of(data: str) -> str:
    """Return the title of the measurements of some data, '' if they have none."""
    for name, (title, _) in DATA.items():
        if data.startswith(name):
            with_suffix = data.removeprefix(name).replace('_', ', with ')
            return f'{title}{with_suffix}'
    return ''


def origin(document: Any) -> str:
    """Return the command of a measurement, with its version if that is an older one."""
    suffix = '' if document['version'] == __version__ else f'    # version {document["version"]}'
    return f'    $ {document["command"]}{suffix}\n'


def plain(value: float) -> str:
    """Return a number with four digits, large ones as integers."""
    return f'{value:,.0f}' if value >= 1e4 else f'{value:.4g}'


def table(header: Sequence[str], rows: Iterable[Sequence[str]], alignment: str = '---:') -> str:
    """Return a table whose columns but the first have an alignment, by default to the right."""
    lines = [header, ['---', *[alignment] * (len(header) - 1)], *rows]
    return '\n'.join(f'| {" | ".join(cells)} |' for cells in lines)


def number(value: float | None, digits: int = 3) -> str:
    """Return a number with some digits, whole ones as they are; '-' without one."""
    if isinstance(value, int):
        return str(value)
    return '-' if value is None else f'{value:.{digits}f}'


def grid(corner: str, columns: Any, rows: Any) -> str:
    """
    Return a table of numbers, a row for each mapping in `rows` by its name.

    `columns` are the keys of its numbers; as a mapping, keys by title.

    """
    keys = columns.values() if isinstance(columns, dict) else columns
    cells = [[name, *(number(row.get(key)) for key in keys)] for name, row in rows.items()]
    return table([corner, *columns], cells)


def signed(value: float, digits: int) -> str:
    """Return a number with its sign, and zero without a minus."""
    return f'{round(value, digits) + 0.0:+.{digits}f}'


def accuracy(results: Any) -> Iterable[str]:
    """Yield the table of scores of each recording, and 3D IoU by range and number of points."""
    for methods in results.values():
        measured = {name: row for name, row in methods.items() if not isinstance(row, str)}
        skipped = {name: row for name, row in methods.items() if isinstance(row, str)}
        header = f'BEV 3D {" ".join(f"R@{x}" for x in (0.5, 0.7, 0.8))} ATE ASE AOE flips jitter'
        keys = ('ate', 'ase', 'aoe', 'flips', 'jitter')
        rows = []
        for name, row in measured.items():
            values = [row['iou_bev'], row['iou_3d'], *row['recall_3d'], *(row[k] for k in keys)]
            rows.append([name, *map(number, values)])
        yield f'{measured["input"]["boxes"]} true boxes.'
        yield table(['', *header.split()], rows)
        yield table(*_parts(measured))
        if 'as_people' in measured['input']:
            yield _as_people(measured)
        if 'by_class' in measured['input']:
            yield _classes(measured)
        yield from _compared(measured)
        for name, reason in skipped.items():
            yield f'{name}: {reason}.'


def _parts(measured: Any) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of the IoU by range, by number of points and of moving objects."""
    header = ['3D IoU']
    rows = {name: [name] for name, row in measured.items() if 'by_range' in row}
    for key, unit in (('by_range', 'm'), ('by_points', 'points')):
        labels = list(dict.fromkeys(part for name in rows for part in measured[name][key]))
        if len(labels) < 2:  # the same as the mean of all boxes
            continue
        header += [f'{label} {unit}' for label in labels]
        for name, row in rows.items():
            row += [number(measured[name][key].get(label)) for label in labels]
    moving = {name: measured[name]['moving'] for name in rows if 'moving' in measured[name]}
    if moving:
        header += [f'moving ({moving["input"]["boxes"]}): BEV', '3D', 'yaw [degrees]']
    for name, found in moving.items():
        rows[name] += [number(found['iou_bev']), number(found['iou_3d'])]
        rows[name].append(number(found['yaw_degrees'], 2))
    return header, list(rows.values())


def _as_people(measured: Any) -> str:
    """Return BEV and 3D IoU by range as labels of people are compared with each other."""
    ranges = list(measured['input']['as_people'])
    rows = []
    for name, row in measured.items():
        found = [row['as_people'].get(label, {}) for label in ranges]
        pairs = [f'{number(x.get("iou_bev"))}/{number(x.get("iou_3d"))}' for x in found]
        rows.append([name, *pairs])
    return table(['BEV / 3D IoU as of labels of people', *(f'{x} m' for x in ranges)], rows)


def _compared(measured: Any) -> Iterable[str]:
    """Yield the table of the differences between methods."""
    rows = [
        [
            f'{name} - {other}',
            scope,
            *_gain(found),
            str(found['tracks']),
            str(found['tracks_ahead']),
        ]
        for name, row in measured.items()
        for scope, others in row.get('differences', {}).items()
        for other, found in others.items()
    ]
    if rows:
        yield table(['difference', 'objects', 'BEV', '3D', 'tracks', 'ahead'], rows)


def _gain(found: Any) -> Iterable[str]:
    """Yield both differences with their standard errors."""
    for key in ('iou_bev', 'iou_3d'):
        yield with_error(found, key)


def with_error(found: Any, key: str) -> str:
    """Return a difference with its standard error, where there are tracks enough for one."""
    error = found[f'{key}_error']
    return signed(found[key], 4) + ('' if error is None else f'±{number(error, 4)}')


def _classes(measured: Any) -> str:
    """Return the table of BEV and 3D IoU of each class, of all its boxes with points."""
    names = measured['input']['by_class']
    header = [f'{name} ({row["boxes"]})' for name, row in names.items()]
    rows = []
    for method, scores in measured.items():
        found = [scores['by_class'][name] for name in names]
        pairs = [f'{number(row["iou_bev"])}/{number(row["iou_3d"])}' for row in found]
        rows.append([method, *pairs])
    return table(['BEV / 3D IoU by class (boxes)', *header], rows)


def kinds_of_objects(results: Any) -> Iterable[str]:
    """Yield what each class gains over the input and over smoothing, one table per recording."""
    for drives, found in results.items():
        rows = []
        for name, methods in found.items():
            for method, others in methods.items():
                start = [f'{name} ({others["input"]["boxes"]})', method.removeprefix('ours, ')]
                smoother = next(key for key in others if key.startswith('smoothing'))
                rows.append([*start, *_gain(others['input']), *_gain(others[smoother])])
        columns = ('BEV - input', '3D - input', 'BEV - smoothing', '3D - smoothing')
        yield table([f'{drives}: class (boxes)', 'estimate', *columns], rows)


def paper(results: Any) -> Iterable[str]:
    """Yield Table I of each mode."""
    for mode, methods in results.items():
        measured = {name: row for name, row in methods.items() if not isinstance(row, str)}
        pose = ['x', 'y', 'z', 'roll', 'pitch', 'yaw'] if mode == '3d' else ['x', 'y', 'yaw']
        iou = '3D IoU' if mode == '3d' else 'BEV IoU'
        columns = {name: name for name in pose} | {iou: 'iou'}
        columns |= {f'{iou}, {part}': f'iou_{part}' for part in ('first', 'last')}
        yield grid(f'mode: {mode}', columns | {f'{iou}, full windows': 'iou_full'}, measured)


def ingredients() -> str:
    """Return the table of the ingredients that are switched off."""
    rows = [[name, item.meaning] for name, item in INGREDIENTS.items() if name != WHOLE]
    return table(['without', 'the change'], rows, '---')


def ablation(results: Any) -> Iterable[str]:
    """Yield for each recording the losses without an ingredient, the largest first."""
    for found in results.values():
        titles = [f'{estimate}: {part}' for estimate in found for part in ('3D', 'loss')]
        names = sorted(
            next(iter(found.values())),
            key=lambda name: -max(rows[name]['loss'] for rows in found.values()),
        )
        rows = []
        for name in [WHOLE, *(name for name in names if name != WHOLE)]:
            cells = []
            for of in found.values():
                own = of[name]
                cells += [number(own['iou_3d']), with_error(own, 'loss')]
            rows.append([name, *cells])
        yield table(['without', *titles], rows)


def sensitivity(results: Any) -> Iterable[str]:
    """Yield the loss of every setting and constant, largest first; those without one as a list."""
    baseline = results['baseline']
    yield grid(f'estimate: {results["estimate"]}', {'BEV': 'iou_bev', '3D': 'iou_3d'}, baseline)
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
            rows.append([*start, signed(loss['bev'], 4), signed(loss['volume'], 4)])
    yield table(['setting or constant', 'factor', 'value', 'BEV loss', '3D loss'], rows)
    without = sorted(name for name, size in largest.items() if size < SHOWN_LOSS)
    yield f'Less than {SHOWN_LOSS} either way: {", ".join(without)}.'
    if failures:
        yield f'Not possible, since the value is an index or a quantile: {", ".join(failures)}.'


def tracks(results: Any) -> Iterable[str]:
    """Yield the scores after each completing step, one table per recording."""
    found = {'recall': 'recall', 'precision': 'precision', 'ids per object': 'ids_per_object'}
    added = {'added': 'added', '3D IoU of added': 'added_iou'}
    columns = found | {'HOTA': 'hota', 'IDF1': 'idf1'} | added
    columns |= {'ghosts rejected': 'ghosts_rejected', 'others rejected': 'lost'}
    for rows in results.values():
        yield grid('', columns, rows)
        first, *_, last = rows  # before the tracks were broken, and at last
        by_kind = {
            f'{name}: {kind}': scores
            for name in (first, last)
            for kind, scores in rows[name]['by_kind'].items()
        }
        yield grid('by kind', found | added | {'3D IoU of others': 'given_iou'}, by_kind)


def figures(results: Any) -> Iterable[str]:
    """Yield a plain table of names and values."""
    yield table(['', ''], flat(results))


def lidars(results: Any) -> Iterable[str]:
    """Yield the accuracy of each way to record several LiDARs."""
    yield grid('recorded', {'BEV': 'bev', '3D': '3d'}, results)


def highway(results: Any) -> Iterable[str]:
    """Yield the accuracy of each method by speed, one table per time of the boxes."""
    for convention, found in results.items():
        speeds = tuple(next(iter(found.values())))
        yield grid(f'boxes of the time of {convention}', speeds, found)


def points(results: Any) -> Iterable[str]:
    """Yield the scores of labels of points, one column for each kind of boxes."""
    scores = dict.fromkeys(score for found in results.values() for score in found)
    by_score = {score: {name: of.get(score) for name, of in results.items()} for score in scores}
    yield grid('', tuple(results), by_score)


def review(results: Any) -> Iterable[str]:
    """Yield the share of bad tracks at the top of each list, per recording and input, and pins."""
    pinned = []
    for recording, inputs in results.items():
        for name, found in inputs.items():
            rows = [[order, *map(number, shares)] for order, shares in found['shares'].items()]
            head = f'{recording}, {name}: worst {found["bad"]} of {found["tracks"]}'
            yield table([head, '1 %', '5 %', '10 %', '20 %'], rows)
            pins = found['pins']
            pinned.append(
                [
                    f'{recording}, {name}',
                    *(number(pins[key]) for key in ('before', 'after')),
                    *(f'{pins[key]:.0%}' for key in ('gained', 'constant')),
                    *(number(pins['left'][key], 2) for key in ('along', 'across', 'up')),
                    number(pins['left']['yaw']),
                ]
            )
    header = (
        'one box of each pinned', '3D IoU before', 'after', 'of 1 - IoU removed',
        'constant along a track', 'left: along [m]', 'across', 'up', 'yaw [rad]',
    )  # fmt: skip
    yield table(header, pinned)


def labeller(results: Any) -> Iterable[str]:
    """Yield the errors before and after the review of a planted drive, and what it takes."""
    stages = (('planted', 'planted'), ('relabelled', 'after `boxreg relabel`'),
              ('reviewed', 'after the review'))  # fmt: skip
    kinds = list(results['planted'])
    rows = [[title, *(str(results[stage][kind]) for kind in kinds)] for stage, title in stages]
    yield table(['errors', *kinds], rows)
    kinds_of_actions = ', '.join(f'{count} {name}s' for name, count in results['kinds'].items())
    yield (
        f'{results["actions"]} actions ({kinds_of_actions}) and {results["seconds"]:.0f} s, of '
        f'these {results["thinking"]:.0f} s of thought; {results["actions_before"]} actions '
        f'where files are edited by hand. Of {results["broken_decisions"]["boxes"]} boxes that '
        f'decisions are about, {results["broken_decisions"]["broken"]} are not as decided in the '
        f'labels.'
    )
    nothing = results['from_nothing']
    yield (
        f'Without boxes: {nothing["tracks"]} tracks, {nothing["whole"]} of them whole, in '
        f'{nothing["actions"]} actions; 3D IoU {number(nothing["iou"])}, of the worst track '
        f'{number(nothing["least_iou"])}; {nothing["broken_decisions"]["broken"]} boxes are not '
        f'as drawn.'
    )


def covariance(results: Any) -> Iterable[str]:
    """Yield coverage and NEES of each variable, by estimate and class, one table per recording."""
    for recording, estimates in results.items():
        rows = [
            [f'{estimate}, {name}', f'{group["boxes"]} of {group["tracks"]}', *consistent(group)]
            for estimate, groups in estimates.items()
            for name, group in _different(groups).items()
        ]
        variables = next(iter(next(iter(estimates.values())).values()))['nees']
        yield table([recording, 'boxes of tracks', *variables], rows)
    low, high = CONSISTENT_NEES
    header = (
        'cells of kinds: along, across, up, yaw', 'cells', 'covered 90 to 98 %', 'more', 'less',
        f'NEES {low:g} to {high:g}', 'less', 'more', f'more by {SIGNIFICANT:g} standard errors',
    )  # fmt: skip
    yield table(header, [[name, *_consistent_cells(of)] for name, of in results.items()])
    yield cells_and_chance(results)


def _different(groups: Any) -> dict[str, Any]:
    """Return the groups of objects without those that have the same boxes as an earlier one."""
    found: dict[str, Any] = {}
    for name, group in groups.items():
        if group not in found.values():
            found[name] = group
    return found


def consistent(group: Any) -> Iterable[str]:
    """Yield coverage and NEES of each variable, with the standard error over the tracks."""
    for name, nees in group['nees'].items():
        error = group['nees_error'][name]
        spread = '' if error is None else f'±{error:.1f}'
        yield f'{group["coverage"][name]:.2f}, {nees:.1f}{spread}'


def cells_of_kinds(estimates: Any) -> list[tuple[str, Any, str]]:
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
    cells = cells_of_kinds(estimates)
    _, high = CONSISTENT_NEES
    coverage = [group['coverage'][variable] for _, group, variable in cells]
    nees = [group['nees'][variable] for _, group, variable in cells]
    overconfident = [
        f'{name} {value:.1f}±{group["nees_error"][variable]:.1f}'
        for (name, group, variable), value in zip(cells, nees, strict=True)
        if value - high > SIGNIFICANT * (group['nees_error'][variable] or math.inf)
    ]
    within, less, more = within_band(coverage, (0.9, 0.98))
    yield from (str(len(cells)), within, more, less, *within_band(nees, CONSISTENT_NEES))
    yield ', '.join(overconfident) or 'none'


def within_band(values: Sequence[float], band: tuple[float, float]) -> tuple[str, str, str]:
    """Return how many values are within a band, less, and more."""
    low, high = band
    less, more = sum(value < low for value in values), sum(value > high for value in values)
    return str(len(values) - less - more), str(less), str(more)


def cells_and_chance(results: Any) -> str:
    """Return how many cells of all recordings are consistent, and what chance leaves of that."""
    every = [cell for estimates in results.values() for cell in cells_of_kinds(estimates)]
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


def scale(results: Any) -> Iterable[str]:
    """Yield the main figures with their meaning, and all figures."""
    job, large, workers, fleet = (results[name] for name in ('job', 'large', 'workers', 'fleet'))
    used = [workers[name]['cores_used'] for name in ('one', 'two')]
    rows = [
        (
            'job.hours_per_core_hour',
            f'{job["hours_per_core_hour"]:.2f}',
            f'hours of recording; {recording_size(job)}',
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
            f'hours of recording; {recording_size(large)}',
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
    yield table(['figure', 'value', 'of'], named, '---')
    shown = {name for name, *_ in rows}
    others = [row for row in flat(results) if row[0].replace(': ', '.') not in shown]
    yield table(['', ''], others)


def recording_size(measured: Any) -> str:
    """Return the size of a recording."""
    return (
        f'{measured["recording_s"]:,.0f} s, {measured["sweeps"]:,} sweeps of '
        f'{measured["points_per_sweep"]:,} points, {measured["boxes"]:,} boxes'
    )


def load(results: Any) -> Iterable[str]:
    """Yield latency and accuracy by number of tracks, one table per way to treat overload."""
    for policy, rows in results.items():
        yield grid(f'{policy}: tracks', tuple(next(iter(rows.values()))), rows)


def robot(results: Any) -> Iterable[str]:
    """Yield latency and what was refined in time, by what the robot sends."""
    digits = {
        'p50 [ms]': 0, 'p99 [ms]': 0, 'early refined [%]': 0, 'clouds dropped [%]': 1, 'cores': 2,
    }  # fmt: skip
    rows = [
        [name, *(number(row[key], places) for key, places in digits.items())]
        for name, row in results.items()
    ]
    yield table(['10 Hz', *digits], rows)


def flat(results: Any) -> Iterable[list[str]]:
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
            yield f'{prefix}{name}', plain(value)
        else:
            yield f'{prefix}{name}', str(value)


MAIN_PRECISIONS = (
    ('car', 'BEV 0.7'), ('car', '3D 0.7'), ('truck', 'BEV 0.7'), ('truck', '3D 0.7'),
    ('pedestrian', '3D 0.5'), ('cyclist', '3D 0.5'),
)  # fmt: skip
"""Class and metric of the main tables; literature: KITTI has .7 for cars and .5 for people."""


def detector(results: Any) -> Iterable[str]:
    """Yield precision by the labels of the training, and the errors of these labels."""
    metrics = ('BEV 0.5', 'BEV 0.7', '3D 0.5', '3D 0.7')
    for drives, by_detector in results['precision'].items():
        for kind in by_detector['own']['true']:
            columns = [(kind, metric) for metric in metrics]
            yield precision_by_labels(results, drives, columns)
            yield gains_of_precision(results, drives, columns)
    yield quality_of_labels(results)
    yield true_parts_of_labels(results)
    yield errors_of_detectors(results)


def precision_by_labels(results: Any, drives: str, columns: Sequence[tuple[str, str]]) -> str:
    """Return the table of average precision on some drives, by detector and source of labels."""
    by_detector = results['precision'][drives]
    known = [column for column in columns if column[0] in by_detector['own']['true']]
    rows = []
    for name, sources in by_detector.items():
        for source, kinds in sources.items():
            cells = [kinds[kind][metric] for kind, metric in known]
            found = [_part(cell, 'ap', 3) for cell in cells]
            rows.append([f'{name}: {source} ({cells[0]["seeds"]})', *found])
    header = [f'{kind}, {metric}' for kind, metric in known]
    return table([f'AP on {drives}: boxes of, labels (trainings)', *header], rows)


def gains_of_precision(results: Any, drives: str, columns: Sequence[tuple[str, str]]) -> str:
    """Return the table of gains over raw labels of the same boxes, and of the second round."""
    by_detector = results['precision'][drives]
    known = [column for column in columns if column[0] in by_detector['own']['true']]
    rows = []
    for name, sources in by_detector.items():
        if 'raw' in sources:
            for source, kinds in sources.items():
                cells = [_part(kinds[kind][metric], 'gain', 3) for kind, metric in known]
                if source != 'raw':
                    rows.append([f'{name}: {source} - {name}: raw', *cells])
    for name, sources in by_detector.items():
        for source, kinds in sources.items():
            cells = [kinds[kind][metric] for kind, metric in known]
            if 'round' in cells[0]:
                differences = [_part(cell, 'round', 3) for cell in cells]
                rows.append([f'{name}: {source} - own: {source}', *differences])
    header = [f'{kind}, {metric}' for kind, metric in known]
    return table([f'difference of AP on {drives}', *header], rows)


def gaps_closed(results: Any, drives: str) -> Iterable[str]:
    """Yield the table of the parts of gaps from raw to true labels that are closed, if any is."""
    by_detector = results['precision'][drives]
    columns = [column for column in MAIN_PRECISIONS if column[0] in by_detector['own']['true']]
    rows = []
    for name, sources in by_detector.items():
        for source, kinds in sources.items():
            cells = [kinds[kind][metric] for kind, metric in columns]
            if source in ('raw', 'true') or 'gap' not in cells[0]:
                continue
            parts = [
                _part(cell, 'closed', 2)
                if cell['gap'] > SURE * (cell['gap_error'] or math.inf)
                else '-'
                for cell in cells
            ]
            if set(parts) != {'-'}:
                rows.append([f'{name}: {source}', *parts])
    header = [f'{kind}, {metric}' for kind, metric in columns]
    if rows:
        yield table([f'part of the gap closed on {drives}', *header], rows)


def _part(found: Any, key: str, digits: int) -> str:
    """Return a part of 1 with its standard error, where that is known."""
    error = found[f'{key}_error']
    return number(found[key], digits) + ('' if error is None else f'±{number(error, digits)}')


def quality_of_labels(results: Any) -> str:
    """Return the table of scores of the labels by detector and source, and the gain of cars."""
    columns = ('recall', 'false', 'iou_bev', 'iou_3d', 'over_0.7', 'flips', 'ids_per_object')
    rows = []
    for name, sources in results['labels'].items():
        for source, kinds in sources.items():
            cells = [number(kinds[''][key]) for key in columns]
            gains = [with_error(kinds[kind], 'gain') for kind in kinds if kind]
            rows.append([f'{name}: {source}', *cells, *gains])
    header = ['recall', 'false per true', 'BEV', '3D', 'R@0.7', 'flips', 'ids per object']
    header += [f'{kind}, 3D - raw' for kind in kinds if kind]
    return table(['labels', *header], rows)


def true_parts_of_labels(results: Any) -> str:
    """Return the table of recall, and of 3D IoU with the true value of each part of a box."""
    keys = ('recall', 'over_0.7', 'iou_3d', 'true centre', 'true yaw', 'true extents')
    rows = []
    for name, sources in results['labels'].items():
        for source in ('raw', 'track'):
            for kind, found in sources[source].items():
                if kind:
                    rows.append([f'{name}: {source}, {kind}', *(number(found[k]) for k in keys)])
    header = ('recall', 'R@0.7', '3D', 'true centre', 'true yaw', 'true extents')
    return table(['labels', *header], rows)


def errors_of_detectors(results: Any) -> str:
    """Return the table of errors of cars by detector: raw boxes, and those refined as tracks."""
    names = ('along', 'across', 'up', 'yaw', 'length', 'width', 'height')
    parts = ('robust', 'between', 'within', 'correlation')
    rows = []
    for name, sources in results['labels'].items():
        for source in ('raw', 'track'):
            errors = sources[source]['car']
            cells = (
                ' / '.join(number(errors.get(f'{key} {part}'), 2) for part in parts)
                for key in names
            )
            rows.append([f'{name}: {source}', *cells])
    return table([f'errors of cars: {" / ".join(parts)}', *names], rows)
