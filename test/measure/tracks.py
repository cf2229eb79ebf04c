"""
`measure tracks`: broken tracks before and after each step of ``relabel --complete``.

The tracks of each recording are broken by the same rules as in ``boxreg simulate --break``. All
rows of a table have the same sweeps and the same broken boxes; each row has one step more. The
first row is a reference: the tracks before they were broken, registered.

"""

from dataclasses import asdict, replace
import math
from pathlib import Path
from typing import NamedTuple

from boxreg_ros.config import COMPLETE_STEPS, Config, KINDS
from boxreg_ros.core.latency import Latency
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.session import hand_to_registrar
from boxreg_ros.offline.box_scores import overlaps
from boxreg_ros.offline.completion import Completion, first_pass
from boxreg_ros.offline.track_scores import track_scores, TrackScores
from boxreg_ros.review.rules import DUPLICATE_IOU
from boxreg_ros.simulation.breaks import (
    BREAK_MISS_PROBABILITY,
    break_tracks,
    GHOST_PREFIX,
    independent_misses,
)
from boxreg_ros.structures import BoxArray, REJECTED
from measure.drives import Drive
import numpy as np

ONE_LABEL = 'with one label'
"""Objects of the truth without a second label at their place."""
UNBROKEN = 'unbroken, refined'
"""Row of the tracks before they were broken: the boxes that completion has to restore."""


class Row(NamedTuple):
    """Scores after one step."""

    scores: TrackScores  # of the boxes that are not rejected
    ghosts: float  # rejected part of the ghosts; NaN without any
    lost: float  # rejected part of the other boxes of the input
    by_kind: dict  # scores of each kind of object, and of objects with `ONE_LABEL`


MISS_SWEEPS = 3.0
"""Mean length of a run of misses that depend on the distance; chosen: such misses repeat."""
MAX_MISS_PROBABILITY = 0.5
"""Greatest part of missing boxes at any distance; chosen: a detector that misses more has none."""
ARGUMENTS = {
    'data': (Path, 'folder with one recording and truth.csv, as boxes.csv', {'nargs': '+'}),
    '--ghosts': (0.0, 'mean number of boxes per sweep that belong to no object'),
    '--far-misses': (False, 'misses in runs and far away, as of detectors, not independent ones'),
    '--coast': (0.0, 'rows of the live estimates without and with it, not of the steps [s]'),
    '--seed': (0, 'seed of the breaks'),
}


def run(args):
    """Return the scores after each step, by recording."""
    report = {}
    for folder in args.data:
        whole = Drive.read(folder)
        drive = broken(whole, args.seed, args.ghosts, args.far_misses)
        report[str(folder)] = {
            name: asdict(row.scores)
            | {
                'ghosts_rejected': row.ghosts,
                'lost': row.lost,
                'by_kind': {kind: asdict(scores) for kind, scores in row.by_kind.items()},
            }
            for name, row in _rows(whole, drive, args.coast)
        }
    return report


def broken(drive, seed, ghosts, far_misses=False):
    """Return a drive with broken tracks."""
    stamps = np.array([array.stamp_ns for array in drive.boxes])
    origins = np.array([sweep.origin for sweep in drive.sweeps_at(stamps)])
    rng = np.random.default_rng(seed)
    misses = FarMisses(drive.boxes, origins) if far_misses else independent_misses
    arrays = break_tracks(drive.boxes, rng, ghosts, origins, misses)
    return replace(drive, boxes=tuple(arrays))


class FarMisses:
    """
    Misses that come in runs, as likely as the square of the distance to the sensor.

    They are like those of a detector that has too few points. The arrays are one per sweep, in
    one frame with the positions of the sensor (n, 3).

    """

    def __init__(self, arrays, origins):
        squares = [
            np.square(array.boxes[:, :2] - origin[:2]).sum(1)
            for array, origin in zip(arrays, origins, strict=True)
        ]
        part = BREAK_MISS_PROBABILITY / np.concatenate(squares).mean()
        probabilities = [(part * square).clip(max=MAX_MISS_PROBABILITY) for square in squares]
        self._probabilities = [
            dict(zip(array.track_ids, likely, strict=True))
            for array, likely in zip(arrays, probabilities, strict=True)
        ]

    def __call__(self, track_id, arrays, rng):
        """Return in which of its arrays a track is missed, as `breaks.Misses`."""
        numbers = rng.random(len(arrays))
        is_new = rng.random(len(arrays)) < 1 / MISS_SWEEPS
        is_new[:1] = True
        repeated = numbers[is_new][np.cumsum(is_new) - 1]
        return repeated < [self._probabilities[row][track_id] for row in arrays]


def _rows(whole, drive, coast):
    """Yield the scores of the registered tracks of the `whole` drive, then of the broken one."""
    config = Config(estimate='final' if coast else 'track')
    yield UNBROKEN, _row(whole.refined(config)[config.estimate], whole)
    yield from with_coast(drive, coast) if coast else after_each_step(drive)


def after_each_step(drive):
    """Yield the scores of the input, of registration alone, and with one more step each."""
    items = drive.items()
    yield 'input', _input_row(drive)
    config = Config()
    first = first_pass(((item, False) for item in items), config)
    yield 'refined', _row(first.results[0], drive)
    for step in COMPLETE_STEPS:
        config = config.updated({f'complete.{step}': True})
        results, _ = completed(items, drive.truth.frame_id, config, first)
        yield f'+ {step}', _row(results, drive)


def with_coast(drive, seconds):
    """Yield the scores of the input, and of final boxes without and with `coast` [s]."""
    yield 'input', _input_row(drive)
    for name, coast in (('final', 0.0), (f'coast {seconds:g} s', seconds)):
        config = Config(estimate='final', coast=coast)
        yield name, _row(drive.refined(config)[config.estimate], drive)


def _input_row(drive):
    table = BoxTable.from_arrays(drive.boxes)
    scores = track_scores(table, drive.truth)
    return Row(scores, math.nan, math.nan, scores_by_kind(table, drive.truth))


def _row(results, drive):
    """Return the scores of results, and which part of the input is rejected."""
    is_rejected = {True: [], False: []}  # of ghosts, and of other boxes
    for given, result in zip(drive.boxes, results, strict=True):
        for track_id, status in zip(given.track_ids, result.status, strict=False):
            is_rejected[track_id.startswith(GHOST_PREFIX)].append(status == REJECTED)
    ghosts, lost = (float(np.mean(rows)) if rows else math.nan for rows in is_rejected.values())
    table = table_of(results)
    scores = track_scores(table, drive.truth)
    return Row(scores, ghosts, lost, scores_by_kind(table, drive.truth))


def scores_by_kind(predicted, truth):
    """Return the scores of each kind of object that the truth has, and of objects `ONE_LABEL`."""
    scores = {}
    for kind in KINDS:
        true, found = (
            table.rows(np.array([Config().kind(name) == kind for name in table.class_names], bool))
            for table in (truth, predicted)
        )
        if len(true.boxes):
            scores[kind] = track_scores(found, true)
    rows = rows_with_one_label(truth)
    if len(rows) < len(truth.boxes):
        scores[ONE_LABEL] = track_scores(predicted, truth, rows)
    return scores


def rows_with_one_label(truth):
    """Return the rows of objects that never share `DUPLICATE_IOU` with another one."""
    doubles = set()
    for stamp in overlaps(truth, truth):
        is_double = (stamp.iou >= DUPLICATE_IOU).sum(axis=1) > 1  # one is the box itself
        doubles.update(truth.track_ids[row] for row in stamp.true[is_double])
    return np.flatnonzero([track_id not in doubles for track_id in truth.track_ids])


def table_of(results):
    """Return the boxes of results that are not rejected, with their status."""
    table = BoxTable.from_arrays([result.boxes for result in results])
    table = replace(table, status=tuple(word for r in results for word in r.status))
    return table.rows(np.array([status != REJECTED for status in table.status], bool))


def completed(items, fixed_frame, config, first=None):
    """Return the completed tracks of a drive in memory, and the effects of the steps on each."""
    if first is None:
        first = first_pass(((item, False) for item in items), config)
    plan = first.plan(fixed_frame, config)
    completion = Completion(plan, config)
    registrar = BoxRegistrar(
        config,
        latency=Latency(),
        prepare=lambda pair: completion.to_register(pair.boxes, pair.sweep),
    )
    arrays = iter(first.in_time)
    for ticket, item in enumerate(items):
        moved = item
        if isinstance(item, BoxArray):
            moved = replace(next(arrays), ticket=ticket)
            completion.expect(ticket)
        completion.add(hand_to_registrar(registrar, moved, False))
    completion.add(registrar.flush())
    return completion.finished(), plan.tracks
