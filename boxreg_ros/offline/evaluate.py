"""`boxreg evaluate`: boxes against true boxes, matched by stamp and track."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
import json
import math
from pathlib import Path
import sys
from typing import Any

from boxreg_ros.config import words_of
from boxreg_ros.core.metrics import EXTENT, iou_3d, iou_bev, pose_errors
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.arguments import add_topic_arguments, convention_from
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import Floats, Ints, is_valid_box, YAW
import numpy as np
from numpy.typing import NDArray

RECALLS = (0.5, 0.7, 0.8)
POINT_BINS = (0, 10, 30, 100, 300, 1000)
LONGEST_STEP = 1.0  # [s], jitter is not read across longer silences

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Matches:
    """
    Every true box in scope with the prediction of the same stamp and track, if there is one.

    Attributes
    ----------
    rows : array, shape (n,)
        Where the true boxes are in their table.
    class_names : tuple of n str
        Of the true boxes.
    num_points : array, shape (n,)
        Of the true boxes.
    is_matched : array, shape (n,)
        True where a finite prediction exists; the rows of the others hold 0 below.
    iou_bev, iou_3d : array, shape (n,)
        Overlap with the prediction.
    translation, extent, rotation : array, shape (n, 3)
        Errors as in `PoseErrors`.
    scale_iou : array, shape (n,)
        3D IoU after centres and headings are aligned.
    is_flipped : array, shape (n,)
        True where the heading is off by more than a right angle.
    jitter, turn_jitter : array, shape (n,)
        Size of the second difference over time of the predicted centre [m/s^2] and yaw
        [rad/s^2]; NaN where no neighbour before or after is within `LONGEST_STEP`.
    true_jitter : array, shape (n,)
        The same of the true centre, to read `jitter` against.
    unmatched : int
        Predictions whose stamp and track are not in the truth at all.
    invalid : int
        True boxes left out of scope: NaN, or an extent that is not positive.

    """

    rows: Ints
    class_names: tuple[str, ...]
    num_points: Ints
    is_matched: Mask
    iou_bev: Floats
    iou_3d: Floats
    translation: Floats
    extent: Floats
    rotation: Floats
    scale_iou: Floats
    is_flipped: Mask
    jitter: Floats
    turn_jitter: Floats
    true_jitter: Floats
    unmatched: int
    invalid: int


@dataclass(frozen=True, slots=True)
class Scores:
    """
    Means over true boxes; errors over those with a prediction, recalls over all.

    Attributes
    ----------
    boxes, missing, unmatched : int
        True boxes in scope, those without a prediction, and predictions without a true box.
    iou_bev, iou_3d, iou_bev_median, iou_3d_median : float
        Over matched boxes.
    recall_bev, recall_3d : tuple of float
        Part of the true boxes overlapped by at least each of `RECALLS`; a missing one counts
        as not recalled.
    ate, ase, aoe, aoe_median : float
        Centre error [m], 1 - IoU of aligned extents, absolute yaw error [rad].
    flips : float
        Part of the matched boxes whose heading is off by more than a right angle.
    jitter, turn_jitter, true_jitter : float
        Means of those of `Matches` [m/s^2, rad/s^2].

    """

    boxes: int
    missing: int
    unmatched: int
    iou_bev: float
    iou_3d: float
    iou_bev_median: float
    iou_3d_median: float
    recall_bev: tuple[float, ...]
    recall_3d: tuple[float, ...]
    ate: float
    ase: float
    aoe: float
    aoe_median: float
    flips: float
    jitter: float
    turn_jitter: float
    true_jitter: float


def match(
    predicted: BoxTable, truth: BoxTable, min_points: int = 0, classes: Sequence[str] = ()
) -> Matches:
    """
    Compare predictions with the truth of the same stamp and track.

    Parameters
    ----------
    predicted, truth : BoxTable
        In one frame. Predictions of true boxes that are out of scope are left out silently.
    min_points : int
        True boxes with fewer points are out of scope.
    classes : sequence of str
        True boxes whose class name holds none of these words are out of scope, any case; empty
        for all.

    Raises
    ------
    RecordingError
        If the frames differ, or a track comes twice at a stamp of the truth.

    """
    if len(predicted.boxes) and len(truth.boxes) and predicted.frame_id != truth.frame_id:
        raise RecordingError(
            f'frames differ: predicted boxes are in {predicted.frame_id!r}, true ones in '
            f'{truth.frame_id!r}; relabel with --fixed-frame {truth.frame_id}'
        )
    row_of: dict[tuple[int, str], int] = {}
    for row, key in enumerate(_keys(predicted)):
        row_of.setdefault(key, row)  # of boxes with one identity the first counts
    true_keys = _keys(truth)
    if len(set(true_keys)) < len(true_keys):
        stamp, track_id = Counter(true_keys).most_common(1)[0][0]
        raise RecordingError(f'true boxes: track {track_id!r} comes twice at stamp {stamp}')
    in_class = np.array([has_word(name, classes) for name in truth.class_names], bool)
    is_valid = is_valid_box(truth.boxes)
    kept = np.flatnonzero(is_valid & in_class & (truth.num_points >= min_points))
    finite = np.isfinite(predicted.boxes).all(axis=1)
    rows = np.array([row_of.get(key, -1) for key in true_keys], np.int64)[kept]
    matched = (rows >= 0) & np.append(finite, False)[rows]
    a, b = predicted.boxes[rows[matched]], truth.boxes[kept][matched]
    errors = pose_errors(a, b)
    aligned = b.copy()
    aligned[:, EXTENT] = a[:, EXTENT]
    stamps, tracks = truth.stamps_ns[kept][matched], [truth.track_ids[i] for i in kept[matched]]

    def spread(values: NDArray[Any], absent: float = 0) -> NDArray[Any]:
        full = np.full((len(kept), *values.shape[1:]), absent, dtype=values.dtype)
        full[matched] = values
        return full

    return Matches(
        rows=kept,
        class_names=tuple(truth.class_names[i] for i in kept),
        num_points=truth.num_points[kept],
        is_matched=matched,
        iou_bev=spread(iou_bev(a, b)),
        iou_3d=spread(iou_3d(a, b)),
        translation=spread(errors.translation),
        extent=spread(errors.extent),
        rotation=spread(errors.rotation),
        scale_iou=spread(iou_3d(aligned, b)),
        is_flipped=spread(errors.is_flipped),
        jitter=spread(_second_difference(stamps, tracks, a[:, :3]), np.nan),
        turn_jitter=spread(_second_difference(stamps, tracks, a[:, [YAW]], is_angle=True), np.nan),
        true_jitter=spread(_second_difference(stamps, tracks, b[:, :3]), np.nan),
        unmatched=len(row_of.keys() - set(true_keys)),
        invalid=int((~is_valid).sum()),
    )


def summarise(matches: Matches, mask: Mask | None = None) -> Scores:
    """Return the scores over the true boxes where `mask` is True, or over all."""
    chosen = np.ones(len(matches.is_matched), bool) if mask is None else mask
    rows = chosen & matches.is_matched
    bev, volume, yaw = matches.iou_bev, matches.iou_3d, np.abs(matches.rotation[rows, 2])
    return Scores(
        boxes=int(chosen.sum()),
        missing=int(chosen.sum() - rows.sum()),
        unmatched=matches.unmatched if mask is None else 0,
        iou_bev=_mean(bev[rows]),
        iou_3d=_mean(volume[rows]),
        iou_bev_median=_median(bev[rows]),
        iou_3d_median=_median(volume[rows]),
        recall_bev=tuple(_mean(bev[chosen] >= level) for level in RECALLS),
        recall_3d=tuple(_mean(volume[chosen] >= level) for level in RECALLS),
        ate=_mean(np.linalg.norm(matches.translation[rows], axis=1)),
        ase=_mean(1 - matches.scale_iou[rows]),
        aoe=_mean(yaw),
        aoe_median=_median(yaw),
        flips=_mean(matches.is_flipped[rows]),
        jitter=_mean(matches.jitter[rows]),
        turn_jitter=_mean(matches.turn_jitter[rows]),
        true_jitter=_mean(matches.true_jitter[rows]),
    )


def evaluate(
    predicted: BoxTable, truth: BoxTable, min_points: int = 0, classes: Sequence[str] = ()
) -> Scores:
    """Return the scores of `predicted` over all true boxes in scope; see `match`."""
    return summarise(match(predicted, truth, min_points, classes))


def has_word(class_name: str, words: Sequence[str]) -> bool:
    """Return whether `class_name` holds one of `words`, any case; True for no words."""
    return not words or not {w.lower() for w in words}.isdisjoint(words_of(class_name))


def groups(matches: Matches) -> dict[str, dict[str, Scores]]:
    """Return scores by class and by number of points of the true box, without empty groups."""
    names = np.array(matches.class_names, object)
    by_class = {name: summarise(matches, np.equal(names, name)) for name in sorted(set(names))}
    by_points = {}
    for low, high in zip(POINT_BINS, (*POINT_BINS[1:], math.inf), strict=True):
        mask = (matches.num_points >= low) & (matches.num_points < high)
        if mask.any():
            by_points[f'{low}+' if high == math.inf else f'{low}-{high - 1}'] = summarise(
                matches, mask
            )
    return {'by_class': by_class, 'by_points': by_points}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what `run` reads."""
    parser.add_argument(
        'predicted', type=Path, metavar='PREDICTED',
        help='folder or boxes.csv of a run, or a recording: its input boxes as they are',
    )  # fmt: skip
    parser.add_argument('truth', type=Path, metavar='TRUTH.csv', help='true boxes, same columns')
    parser.add_argument(
        '--min-points', type=int, default=0, metavar='N',
        help='leave out true boxes with fewer points (default: 0)',
    )  # fmt: skip
    parser.add_argument(
        '--classes', nargs='+', default=[], metavar='WORD',
        help='only true boxes whose class name holds one of these words, as in car,van,truck',
    )  # fmt: skip
    add_topic_arguments(parser)
    parser.add_argument('--fixed-frame', metavar='FRAME', help='as of `boxreg relabel`')
    parser.add_argument('--json', action='store_true', help='print one JSON object')


def run(args: argparse.Namespace) -> int:
    """Print the scores of one table of boxes, or of a recording's own boxes."""
    truth = BoxTable.read(args.truth)
    source = args.predicted
    topics = {name: getattr(args, name) for name in ('points', 'boxes', 'odometry')}
    convention = convention_from(args)
    if (table_of_run := source / 'boxes.csv').is_file():
        source = table_of_run
    if source.suffix == '.csv':
        if any((*topics.values(), args.fixed_frame)) or not convention.is_standard:
            raise ConfigError(
                f'--points, --boxes, --odometry, --fixed-frame, {convention}: expected a '
                f'recording that they are about, got the table {str(source)!r}; leave them out'
            )
        predicted = _in_frame(BoxTable.read_frames(source), truth.frame_id)
    else:
        from boxreg_ros.io.recording import input_boxes  # reads bags: not needed for tables

        arrays, left_out = input_boxes(source, args.fixed_frame, convention=convention, **topics)
        if left_out:
            print(f'boxreg: {left_out}', file=sys.stderr)
        predicted = BoxTable.from_arrays(arrays)
    classes = [word for part in args.classes for word in part.split(',') if word]
    matches = match(predicted, truth, args.min_points, classes)
    if matches.invalid:
        print(
            f'boxreg: {matches.invalid} of {len(truth.boxes)} true boxes are left out: NaN, or an '
            f'extent that is not positive',
            file=sys.stderr,
        )
    if not len(matches.is_matched):
        raise RecordingError(
            f'{args.truth}: none of {len(truth.boxes)} true boxes is in scope; lower --min-points '
            f'or name other --classes; there are {", ".join(sorted(set(truth.class_names)))}'
        )
    if len(predicted.boxes) and not matches.is_matched.any():
        print(f'boxreg: {_why_none_matches(predicted, truth, matches)}', file=sys.stderr)
    overall, grouped = summarise(matches), groups(matches)
    if args.json:
        report = asdict(overall) | {
            name: {key: asdict(scores) for key, scores in group.items()}
            for name, group in grouped.items()
        }
        print(json.dumps(finite(report)))
    else:
        rows = {'all': overall} | grouped['by_class']
        rows |= {f'{name} points': scores for name, scores in grouped['by_points'].items()}
        print(table(rows))
        print(
            f'{overall.boxes} true boxes, {overall.missing} missing, {overall.unmatched} '
            'predictions without one; recalls are 3D, errors in m and rad, jitter in m/s^2'
        )
    return 0


def _in_frame(tables: dict[str, BoxTable], frame_id: str) -> BoxTable:
    """Return the boxes in a frame, those without a transform to it left out; else the most."""
    found = max(
        tables.values(),
        key=lambda table: (table.frame_id == frame_id, len(table.boxes)),
        default=BoxTable.from_arrays([]),
    )
    for name, other in tables.items():
        if other is not found:
            print(
                f'boxreg: {len(other.boxes)} predicted boxes in {name!r} are left out, those in '
                f'{found.frame_id!r} compared',
                file=sys.stderr,
            )
    return found


def _why_none_matches(predicted: BoxTable, truth: BoxTable, matches: Matches) -> str:
    """Return what stamps and tracks of two tables have in common."""
    true_keys, keys = _keys(truth), set(_keys(predicted))
    if invalid := sum(true_keys[row] in keys for row in matches.rows):
        return (
            f'all {invalid} predicted boxes of the stamp and the track of a true one are invalid: '
            f'expected finite numbers and a quaternion other than 0 0 0 0'
        )
    mine, true = predicted.stamps_ns, truth.stamps_ns
    stamps, tracks = np.intersect1d(mine, true), set(predicted.track_ids) & set(truth.track_ids)
    own, other = ([f'{x * 1e-9:.3f}' for x in (side.min(), side.max())] for side in (mine, true))
    return (
        f'no predicted box has the stamp and the track of a true one: {len(stamps)} stamps and '
        f'{len(tracks)} track ids are in both; predicted boxes are of {" to ".join(own)} s, '
        f'true ones of {" to ".join(other)} s; are they of one recording, with ids of one tracker?'
    )


def table(rows: dict[str, Scores]) -> str:
    """Return scores as text, one line each."""
    head = ['boxes', 'BEV', '3D'] + [f'R@{level}' for level in RECALLS]
    head += ['ATE', 'ASE', 'AOE', 'flips', 'jitter', '(true)']
    width = max(len('boxes of'), *(len(name) for name in rows))
    lines = [' ' * width + ''.join(f'{name:>8}' for name in head)]
    for name, s in rows.items():
        numbers = (
            s.iou_bev, s.iou_3d, *s.recall_3d, s.ate, s.ase, s.aoe, s.flips, s.jitter,
            s.true_jitter,
        )  # fmt: skip
        lines.append(f'{name:{width}}{s.boxes:8d}' + ''.join(f'{n:8.3f}' for n in numbers))
    return '\n'.join(lines)


def finite(value: Any) -> Any:
    """Return nested plain values with NaN as None, which is all that JSON knows."""
    if isinstance(value, dict):
        return {key: finite(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _second_difference(
    stamps_ns: Ints, track_ids: Sequence[str], values: Floats, is_angle: bool = False
) -> Floats:
    """Return its size per row, shape (n,); NaN without a neighbour on both sides in time."""
    size = np.full(len(stamps_ns), np.nan)
    _, codes = np.unique(np.array(track_ids, str), return_inverse=True)
    order = np.lexsort((stamps_ns, codes))
    before, here, after = order[:-2], order[1:-1], order[2:]
    first = (stamps_ns[here] - stamps_ns[before]) / 1e9
    second = (stamps_ns[after] - stamps_ns[here]) / 1e9
    near = (codes[before] == codes[after]) & (np.maximum(first, second) <= LONGEST_STEP)
    before, here, after = before[near], here[near], after[near]
    steps = [values[here] - values[before], values[after] - values[here]]
    if is_angle:
        steps = [wrap_angle(step) for step in steps]
    first, second = first[near, None], second[near, None]
    rate = steps[1] / second - steps[0] / first
    size[here] = np.linalg.norm(2 * rate / (first + second), axis=1)
    return size


def _keys(boxes: BoxTable) -> list[tuple[int, str]]:
    return list(zip(boxes.stamps_ns.tolist(), boxes.track_ids, strict=True))


def _mean(values: NDArray[Any]) -> float:
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else math.nan


def _median(values: NDArray[Any]) -> float:
    return float(np.median(values)) if len(values) else math.nan
