"""`boxreg evaluate`: compare boxes with true boxes, matched by stamp and overlap."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
import json
import math
from pathlib import Path
import sys
from typing import Any

from boxreg_ros.core.metrics import iou_3d, pose_errors
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.checks.pose import DECISIVE_BOXES, MIN_GAIN
from boxreg_ros.io.covariance_table import COVARIANCES, read_covariances
from boxreg_ros.io.stamp_join import joined_stamps, LARGEST_OFFSET_NS, unknown_stamps
from boxreg_ros.io.times import time_range
from boxreg_ros.io.velocity_table import read_velocities, VELOCITIES
from boxreg_ros.offline.arguments import add_options, request_from, TOPICS, words_of
from boxreg_ros.offline.box_scores import (
    by_overlap,
    groups,
    has_word,
    match,
    Matches,
    RECALLS,
    Scores,
    summarise,
)
from boxreg_ros.offline.consistency import consistency
from boxreg_ros.offline.consistency import table as consistency_table
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.result_folder import earlier_summary
from boxreg_ros.offline.sources import in_labelled_view, source_of, true_boxes
from boxreg_ros.offline.track_scores import has_trackeval, LEAST_IOU, track_scores, TrackScores
from boxreg_ros.offline.velocity_scores import beside, velocity_scores, VelocityScores
from boxreg_ros.offline.velocity_scores import table as velocity_table
from boxreg_ros.structures import BoxArray, is_valid_box
from msg_adapters.convention import Convention, FORWARD, ORIENTATIONS, REFERENCES, SIZE_ORDERS
import numpy as np
from numpy.typing import NDArray

CONVENTIONS = {
    'pose_reference': tuple(REFERENCES),
    'size_order': SIZE_ORDERS,
    'forward_axis': tuple(FORWARD),
    'orientation': ORIENTATIONS,
    'size_scale': (2, 0.5),
}
"""Options of a `Convention`, and the values that true boxes may have where they fit badly."""
MIN_FIT = 0.5
"""Mean 3D IoU that another convention must reach; chosen: by none, another place has it."""
MAX_TURN = math.pi / 4
"""Angle between two headings from which they are others [rad]; derived: half a quarter turn."""
COMPARED_PAIRS = 1000
"""Pairs that are looked at: 25 conventions of so many take about 0.1 s."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `boxreg evaluate`."""
    parser.add_argument(
        'predicted', type=Path, metavar='PREDICTED',
        help='result folder or boxes.csv, or a recording, whose input boxes are compared',
    )  # fmt: skip
    parser.add_argument(
        'truth',
        type=Path,
        metavar='TRUTH',
        help='true boxes: CSV with the columns of boxes.csv, or a scene of a data set',
    )
    parser.add_argument(
        '--min-points', type=int, default=0, metavar='N',
        help='ignore true boxes with fewer points (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--classes', nargs='+', default=[], metavar='WORD',
        help='compare only true boxes whose class name contains one of these words, as in '
        'car,van,truck; boxes of other classes without a true one are ignored',
    )  # fmt: skip
    parser.add_argument(
        '--input', type=Path, metavar='RECORDING',
        help='recording of the result: the velocities of its boxes are compared as well',
    )  # fmt: skip
    add_options(parser, Request, *TOPICS, 'fixed_frame')
    parser.add_argument('--json', action='store_true', help='print one JSON object')


def run(args: argparse.Namespace) -> int:
    """Print the scores of a table of boxes or of the input boxes of a recording."""
    truth = true_boxes(args.truth)
    predicted = _predicted(args, truth.frame_id)
    _check_same_drive(args, predicted, truth)
    truth = _of_part(args, _joined(args, predicted, truth))
    classes = [word for part in args.classes for word in part.split(',') if word]
    matches = match(predicted, truth, args.min_points, classes, by_overlap)
    is_unknown = _at_other_times(predicted, truth) | _out_of_view(args, predicted, matches)
    is_unknown |= _of_other_classes(predicted, matches, classes)
    matches = replace(matches, unmatched=matches.unmatched[~is_unknown[matches.unmatched]])
    if matches.invalid:
        _warn(
            f'{matches.invalid} of {len(truth.boxes)} true boxes are left out: NaN, or an extent '
            f'that is not positive'
        )
    if not len(matches.is_matched):
        names = ', '.join(sorted(set(truth.class_names))) or 'no boxes'
        raise RecordingError(
            f'{args.truth}: expected true boxes in scope, got none of {len(truth.boxes)}; lower '
            f'--min-points or choose other --classes; the table has {names}'
        )
    _warn_of_predictions(predicted, truth, matches)
    if matches.is_matched.any() and not classes:
        _warn_of_other_classes(predicted, truth, matches, is_unknown)
    _warn_of_convention(args, predicted, truth, matches)
    overall = summarise(matches)
    tracks = track_scores(predicted.rows(~is_unknown), truth, matches.rows)
    if not has_trackeval():
        _warn('HOTA and IDF1 need the package trackeval: pip install trackeval')
    folder = _result_folder(args.predicted)
    certainty = {}
    if folder is not None and (folder / COVARIANCES).is_file():
        covariances = read_covariances(folder / COVARIANCES)
        certainty = consistency(matches, predicted, truth, covariances)
    velocities = _velocities(args, matches, predicted, truth, classes)
    if args.json:
        report = asdict(overall)
        for name, group in groups(matches).items():
            report[name] = {key: asdict(scores) for key, scores in group.items()}
        report['tracks'] = asdict(tracks)
        report['velocities'] = {name: scores._asdict() for name, scores in velocities.items()}
        if certainty:
            report['consistency'] = {name: group._asdict() for name, group in certainty.items()}
        print(json.dumps(finite(report)))
    else:
        _print_tables(overall, groups(matches))
        print(_track_lines(tracks))
        if any(scores.boxes for scores in velocities.values()):
            print('\n' + velocity_table(velocities))
        if certainty and folder is not None:
            summary = earlier_summary(folder) or {}
            estimate = summary.get('estimate', 'written')
            print(f'\ncovariances of the {estimate} estimate')
            print(consistency_table(certainty))
    return 0 if matches.is_matched.any() else 1


def _velocities(
    args: argparse.Namespace,
    matches: Matches,
    predicted: BoxTable,
    truth: BoxTable,
    classes: list[str],
) -> dict[str, VelocityScores]:
    """Return the scores of velocities of the boxes, and of the input if it is given."""
    folder = _result_folder(args.predicted)
    has_file = folder is not None and (folder / VELOCITIES).is_file()
    known = read_velocities(folder / VELOCITIES) if folder and has_file else None
    found = [('boxes', velocity_scores(matches, predicted, truth, known))]
    if args.input is not None:
        boxes = _of_recording(args, args.input)
        of_input = match(boxes, _joined(args, boxes, truth), args.min_points, classes, by_overlap)
        found.insert(0, ('input', velocity_scores(of_input, boxes, truth)))
    return beside(found)


def _result_folder(source: Path) -> Path | None:
    """Return the folder of the boxes of a result; None for a recording or another file."""
    if (source / 'boxes.csv').is_file():
        return source
    return source.parent if source.name == 'boxes.csv' else None


def _track_lines(scores: TrackScores) -> str:
    """Return the scores of tracks as text."""
    lines = [
        f'tracks, at a 3D IoU of {LEAST_IOU}: recall {scores.recall:.3f} ({scores.misses} '
        f'misses), precision {scores.precision:.3f} ({scores.ghosts} ghosts), '
        f'{scores.ids_per_object:.2f} ids per object, IDF1 {scores.idf1:.3f}; HOTA '
        f'{scores.hota:.3f} (detection {scores.det_a:.3f}, association {scores.ass_a:.3f})'
    ]
    if scores.added:
        without = f' ({scores.added_ghosts} without a true box)' if scores.added_ghosts else ''
        lines.append(
            f'{scores.added} added boxes{without} with a mean 3D IoU of {scores.added_iou:.3f}, '
            f'the others have {scores.given_iou:.3f}'
        )
    return '\n'.join(lines)


def _predicted(args: argparse.Namespace, frame_id: str) -> BoxTable:
    """Read the boxes to compare: a table, or the input boxes of a recording."""
    source: Path = args.predicted
    if (source / 'boxes.csv').is_file():
        source = source / 'boxes.csv'
    if source.suffix == '.csv':
        unused = words_of(args, Request, *TOPICS, 'fixed_frame')
        if unused and args.input is None:
            raise ConfigError(
                f'{" ".join(unused)}: expected with a recording only, got the table '
                f'{str(source)!r}; leave them out'
            )
        return _table_in_frame(BoxTable.read_frames(source), frame_id).without_rejected()
    return _of_recording(args, source)


def _of_recording(args: argparse.Namespace, source: Path) -> BoxTable:
    """Return the input boxes of a recording."""
    from boxreg_ros.io.fixed_frame import input_boxes  # slow to import: it reads bags

    recording = source_of(request_from(args, source))
    arrays, others = input_boxes(recording, args.fixed_frame)
    if others:
        _warn(others)
    return BoxTable.from_arrays(arrays)


def _table_in_frame(tables: dict[str, BoxTable], frame_id: str) -> BoxTable:
    """Return the boxes in a frame, or if there are none the largest table; warn of the others."""
    found = max(
        tables.values(),
        key=lambda table: (table.frame_id == frame_id, len(table.boxes)),
        default=BoxTable.from_arrays([]),
    )
    for name, other in tables.items():
        if other is not found:
            _warn(
                f'{len(other.boxes)} predicted boxes in frame {name!r} are left out; those in '
                f'{found.frame_id!r} are compared'
            )
    return found


def _print_tables(overall: Scores, grouped: dict[str, dict[str, Scores]]) -> None:
    """Print all scores as one table and a line with their units."""
    rows = {'all': overall} | grouped['by_class']
    for name, scores in grouped['by_points'].items():
        rows[f'{name} points'] = scores
    print(table(rows))
    print(
        f'{overall.boxes} true boxes, {overall.missing} missing, {overall.unmatched} predictions '
        f'without a true box, matched by overlap; recalls of 3D IoU, ATE in m, ASE is 1 - IoU, '
        f'AOE in rad, jitter in m/s^2'
    )


def _why_none_matches(predicted: BoxTable, truth: BoxTable) -> str:
    """Return why no predicted box has a true one."""
    if not len(predicted.boxes):
        return 'there are no predicted boxes'
    if not is_valid_box(predicted.boxes).any():
        return (
            f'all {len(predicted.boxes)} predicted boxes are invalid: expected finite numbers and '
            f'a quaternion other than 0 0 0 0'
        )
    stamps = np.intersect1d(predicted.stamps_ns, truth.stamps_ns)
    return (
        f'no predicted box overlaps a true one: {len(stamps)} stamps are in both; compare boxes '
        f'of one recording in one frame'
    )


def _warn_of_predictions(predicted: BoxTable, truth: BoxTable, matches: Matches) -> None:
    """Say how many predicted boxes are invalid or have the id of another; or why none matches."""
    if not matches.is_matched.any():
        _warn(_why_none_matches(predicted, truth))
        return
    invalid = int((~is_valid_box(predicted.boxes)).sum())
    if invalid:
        _warn(
            f'{invalid} of {len(predicted.boxes)} predicted boxes find no true box: NaN, an '
            f'extent that is not positive, or a quaternion of 0 0 0 0'
        )
    keys = set(zip(predicted.stamps_ns.tolist(), predicted.track_ids, strict=True))
    repeated = len(predicted.boxes) - len(keys)
    if repeated:
        _warn(
            f'{repeated} of {len(predicted.boxes)} predicted boxes have the id of another one at '
            f'their stamp: they count as other tracks'
        )


def _warn_of_other_classes(
    predicted: BoxTable, truth: BoxTable, matches: Matches, is_unknown: NDArray[np.bool_]
) -> None:
    """Say which predicted classes the truth may lack: it has neither their name nor a box."""
    rows = matches.predicted_rows[matches.is_matched].tolist()
    known = {*truth.class_names, *(predicted.class_names[row] for row in rows)}
    counted = predicted.rows(~is_unknown).class_names
    others = Counter(name for name in counted if name not in known)
    if others:
        names = ', '.join(f'{name} {count}' for name, count in sorted(others.items()))
        _warn(
            f'no predicted box of these classes has a true one: {names}; they count as ghosts: '
            f'if the truth has no such objects because nobody labelled them, name the others by '
            f'--classes'
        )


def _warn_of_convention(
    args: argparse.Namespace, predicted: BoxTable, truth: BoxTable, matches: Matches
) -> None:
    """Say under which other convention the true boxes fit the predicted ones, if there is one."""
    pairs = np.flatnonzero(matches.is_matched)
    pairs = pairs[:: max(1, len(pairs) // COMPARED_PAIRS)]
    found = predicted.boxes[matches.predicted_rows[pairs]]
    rows = matches.rows[pairs]
    names = ('',) * len(rows)
    true = BoxArray(0, truth.frame_id, names, names, np.ones(len(rows)), truth.boxes[rows])

    def fit(convention: Convention) -> float:
        """Return the mean 3D IoU under a convention; a box of another heading has 0."""
        boxes = convention.to_centers(true).boxes
        is_near = np.abs(pose_errors(found, boxes).rotation[:, 2]) < MAX_TURN
        return float(np.mean(np.where(is_near, iou_3d(found, boxes), 0)))

    own = fit(Convention()) if len(pairs) >= DECISIVE_BOXES else 1.0
    if MIN_GAIN * own > 1:
        return
    options = [(name, value) for name, values in CONVENTIONS.items() for value in values]
    fits = [fit(Convention(**{name: value})) for name, value in options]  # type: ignore[arg-type]
    best = int(np.argmax(fits))
    if fits[best] >= max(MIN_FIT, MIN_GAIN * own):
        name, value = options[best]
        _warn(
            f'conventions: expected one for both tables, got true boxes that fit the predicted '
            f'ones with {name} {value}: their mean 3D IoU is then {fits[best]:.3f} in place of '
            f'{own:.3f}, with 0 for those of another heading; correct them by boxreg convert '
            f'{args.truth} -o OUT --from csv --to csv --{name.replace("_", "-")} {value}, or, if '
            f'the predicted ones are wrong, see boxreg inspect of their recording'
        )


def _of_other_classes(
    predicted: BoxTable, matches: Matches, classes: Sequence[str]
) -> NDArray[np.bool_]:
    """Return which predicted boxes (n,) without a true one are of none of the `classes`."""
    is_other = np.zeros(len(predicted.boxes), bool)
    names = [predicted.class_names[row] for row in matches.unmatched.tolist()]
    is_other[matches.unmatched] = [not has_word(name, classes) for name in names]
    return is_other


def _joined(args: argparse.Namespace, predicted: BoxTable, truth: BoxTable) -> BoxTable:
    """Return the true boxes at the stamps of the predicted ones; say what was not equal."""
    joined = joined_stamps(truth.stamps_ns, predicted.stamps_ns)
    finding = joined.finding('the true boxes', 'the predicted ones')
    if finding and not joined.num_common:
        raise RecordingError(
            f'{args.truth}: {finding}; give both the stamps of the same clouds, in nanoseconds'
        )
    if finding:
        _warn(finding)
    without = joined.num_stamps - joined.num_common
    lonely = len(np.setdiff1d(predicted.stamps_ns, joined.stamps_ns))
    if without and lonely:
        _warn(
            f'{without} of {joined.num_stamps} stamps of the true boxes have no predicted boxes, '
            f'and {lonely} stamps of these no true ones: are both of the same clouds?'
        )
    return replace(truth, stamps_ns=joined.stamps_ns)


def _of_part(args: argparse.Namespace, truth: BoxTable) -> BoxTable:
    """Return the true boxes of the time that a result is of, as by --start and --end; say so."""
    folder = _result_folder(args.predicted)
    summary = (earlier_summary(folder) if folder is not None else None) or {}
    ends = [stamp for stamps in summary.get('time_ranges', {}).values() for stamp in stamps]
    if not ends:
        return truth
    is_early = truth.stamps_ns < min(ends) - LARGEST_OFFSET_NS
    is_outside = is_early | (truth.stamps_ns > max(ends) + LARGEST_OFFSET_NS)
    if is_outside.any():
        _warn(
            f'{is_outside.sum()} of {len(truth.boxes)} true boxes are not of the time of '
            f'{args.predicted}, {time_range(min(ends), max(ends))}: they are not counted'
        )
    return truth.rows(~is_outside)


def _at_other_times(predicted: BoxTable, truth: BoxTable) -> NDArray[np.bool_]:
    """Return which predicted boxes (n,) are at stamps that no true ones are known of; say so."""
    is_unknown = unknown_stamps(predicted.stamps_ns, truth.stamps_ns)
    if is_unknown.any():
        _warn(
            f'{is_unknown.sum()} predicted boxes lie between the stamps of the true boxes, which '
            f'are further apart, or before or after all of them: nothing is known there, and they '
            f'are not counted'
        )
    return is_unknown


def _out_of_view(
    args: argparse.Namespace, predicted: BoxTable, matches: Matches
) -> NDArray[np.bool_]:
    """Return which predicted boxes (n,) without a true one the labelled image lacks; say so."""
    is_outside = np.zeros(len(predicted.boxes), bool)
    is_outside[matches.unmatched] = ~in_labelled_view(args.truth, predicted)[matches.unmatched]
    if is_outside.any():
        _warn(
            f'{is_outside.sum()} predicted boxes lie outside of the image of the camera that the '
            f'true boxes were labelled in: nothing is known there, and they are not counted'
        )
    return is_outside


def _check_same_drive(args: argparse.Namespace, predicted: BoxTable, truth: BoxTable) -> None:
    """Refuse boxes of another time than the true ones."""
    if not (len(predicted.boxes) and len(truth.boxes)):
        return
    found, true = (
        (int(table.stamps_ns.min()), int(table.stamps_ns.max())) for table in (predicted, truth)
    )
    if found[0] > true[1] or true[0] > found[1]:
        raise RecordingError(
            f'{args.truth}: expected true boxes of the time of {args.predicted}, got boxes of '
            f'{time_range(*found)}, true boxes of {time_range(*true)}: another drive? give the '
            f'true boxes of this one'
        )


def _warn(message: str) -> None:
    print(f'boxreg: {message}', file=sys.stderr)


def table(rows: dict[str, Scores]) -> str:
    """Return scores as a text table, one line per row."""
    titles = ['boxes', 'BEV', '3D', *(f'R@{threshold}' for threshold in RECALLS)]
    titles += ['ATE', 'ASE', 'AOE', 'flips', 'jitter', '(true)']
    width = max(len('boxes of'), *(len(name) for name in rows))
    lines = [' ' * width + ''.join(f'{title:>8}' for title in titles)]
    for name, s in rows.items():
        numbers = [s.iou_bev, s.iou_3d, *s.recall_3d, s.ate, s.ase, s.aoe]
        numbers += [s.flips, s.jitter, s.true_jitter]
        cells = ''.join(f'{number:8.3f}' for number in numbers)
        lines.append(f'{name:{width}}{s.boxes:8d}{cells}')
    return '\n'.join(lines)


def finite(value: Any) -> Any:
    """Return nested plain values with None for NaN and infinity, which JSON does not have."""
    if isinstance(value, dict):
        return {key: finite(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
