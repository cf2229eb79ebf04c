"""
`measure detector`: does a detector get better by refined labels? One round of auto-labelling.

A small detector is trained on the true boxes of a tenth of the drives. Its boxes on the other
drives are tracked and refined by `boxreg relabel --associate`; the training goes on with the
labels of each source, and its detector is tested on drives that nobody has trained on. OUT keeps
drives, labels and scores: a run that has ended goes on where it was.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
import math
from pathlib import Path
import sys
from typing import NamedTuple

from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.structures import Floats, REJECTED
from measure.detector.drives import recorded, stored, StoredDrive, street
from measure.detector.labels import (
    detected,
    errors_of,
    in_reach,
    labels_of,
    MIN_TRUE_POINTS,
    OPTIONS,
    refined,
    smoothed_table,
    UNREFINED,
    with_ids,
)
from measure.detector.network import CLASSES, detections, Detector, trained
from measure.detector.precision import average_precision, Hits, hits_of, joined, METRICS
import numpy as np
import torch

STREETS = {'tenth': (0, 4, 50), 'others': (100, 24, 50), 'test': (1000, 40, 5)}
"""First seed, number and sweeps of the random streets of each part."""
TRAINING_STEP, TEST_STEP = 2, 4
"""Every such sweep of a drive is used in the training, and in the test."""
MISSED = (0, 1, 2, 5)
"""Missing boxes in ten of the published detector."""
COMPLETED = 'track, complete'
SAMPLES = 200
"""Bootstrap samples of drives and of seeds."""
DEVIATION = (0.16, 0.84)
"""Quantiles of a normal variable at one deviation below and above its mean."""
MANY = {'nargs': '*', 'default': []}
ARGUMENTS = {
    'out': (Path, 'folder for drives, labels and scores; goes on with those in it'),
    '--others': (Path, 'recordings with truth.csv, labelled as well', MANY),
    '--test': (Path, 'recordings with truth.csv, to test on as well', MANY),
    '--seeds': (3, 'trainings on the labels of each source'),
    '--steps': (1200, 'of the optimiser in each training'),
    '--stored': (False, 'train nothing: the scores of the trainings that are stored'),
}

Scores = dict[str, dict[str, dict[str, Hits]]]
"""Detections by drive, class and one of the `METRICS`."""


class Training(NamedTuple):
    """One training: whose boxes the labels are made of, their source, and the seed."""

    detector: str
    source: str
    seed: int

    @property
    def name(self) -> str:
        """Return the stem of its file."""
        return f'{self.detector}_{self.source}_{self.seed}'.replace(', ', '+').replace(' ', '-')


def run(args):
    """Return errors of the labels of each source, and the precision of detectors by them."""
    torch.set_num_threads(1)
    experiment = Experiment(args)
    if not args.stored:
        for training in wanted(args.seeds):
            print(training.name, file=sys.stderr, flush=True)
            experiment.scores(training)
    return {
        'parameters': sum(weights.numel() for weights in Detector().parameters()),
        'labels': experiment.label_errors(),
        'precision': precision(experiment.all_scores()),
    }


TEACHER = Training('tenth', 'true', 0)
SCRATCH = 'own, scratch'
"""Own boxes, for a detector that does not begin as the one of the tenth."""
SECOND = 'second'
"""Boxes of a detector that was trained on own ones, refined as whole tracks."""


def wanted(seeds: int) -> Iterator[Training]:
    """Yield the trainings in the order of what they say."""
    yield TEACHER
    for source in ('raw', 'true', 'track'):
        yield Training('own', source, 0)
    for source in ('raw', 'track'):
        yield Training(SECOND, source, 0)
    for missed in MISSED:
        for source in ('raw', 'track', *[COMPLETED] * (missed > 0)):
            yield Training(f'published, {missed} in ten missing', source, 0)
    for source in (COMPLETED, 'smoothed', 'early'):
        yield Training('own', source, 0)
    for seed in range(1, seeds):
        for source in ('raw', 'true', 'track'):
            yield Training('own', source, seed)
    for seed in range(1, seeds):
        for source in (COMPLETED, 'smoothed', 'early'):
            yield Training('own', source, seed)
    for source in ('raw', 'true'):
        yield Training(SCRATCH, source, 0)


class Experiment:
    """Drives, labels and trainings, each made when it is needed, and stored."""

    def __init__(self, args) -> None:
        self._out = args.out
        self._steps = args.steps
        parts = {
            part: [street(args.out / part, first + number, sweeps) for number in range(count)]
            for part, (first, count, sweeps) in STREETS.items()
        }
        parts['others'] += [recorded(args.out / 'others', data) for data in args.others]
        parts['test'] += [recorded(args.out / 'test', data) for data in args.test]
        self._parts: dict[str, list[StoredDrive]] = parts

    def scores(self, training: Training) -> Scores:
        """Return the detections of a trained detector on the drives of the test."""
        path = self._out / 'scores' / f'{training.name}.pickle'
        return stored(path, lambda: self._tested(self._model(training)))

    def all_scores(self) -> dict[Training, Scores]:
        """Return the detections of the trainings that are stored."""
        seeds = range(len(list((self._out / 'scores').glob('*.pickle'))))
        return {
            training: self.scores(training)
            for training in wanted(len(seeds))
            if (self._out / 'scores' / f'{training.name}.pickle').is_file()
        }

    def label_errors(self) -> dict[str, dict[str, dict[str, dict[str, float]]]]:
        """Return the errors of stored labels by detector, source and class; '' for all classes."""
        found = {}
        drives = self._parts['others']
        truths = [
            replace(
                drive.truth,
                num_points=drive.truth.num_points * in_reach(drive.truth, drive.frames),
            )
            for drive in drives
        ]
        for folder in sorted((self._out / 'labels').iterdir()):
            known = [source for source in OPTIONS if all(
                (folder / source / f'{drive.name}.pickle').is_file() for drive in drives
            )]  # fmt: skip
            if 'track' not in known:
                continue  # the others have its ids
            labels: dict[str, list[BoxTable]] = {}
            for source in (*UNREFINED, *known):
                tables = [self._labels(folder.name, source, drive) for drive in drives]
                labels[source] = [
                    table.rows(in_reach(table, drive.frames))
                    for table, drive in zip(tables, drives, strict=True)
                ]
            found[folder.name] = errors_of(labels, truths)
        return found

    def _model(self, training: Training) -> Detector:
        """Return the detector of a training."""
        path = self._out / 'models' / f'{training.name}.pickle'
        model = Detector()
        model.load_state_dict(stored(path, lambda: self._trained(training).state_dict()))
        return model.to(memory_format=torch.channels_last).eval()

    def _trained(self, training: Training) -> Detector:
        frames, labels = [], []
        for drive in self._parts['tenth' if training.detector == 'tenth' else 'others']:
            table = drive.truth
            if training.source != 'true':
                detector = 'own' if training.detector == SCRATCH else training.detector
                table = self._labels(detector, training.source, drive)
            chosen = drive.frames[::TRAINING_STEP]
            frames += chosen
            labels += [labels_of(table, frame) for frame in chosen]
        is_first = training == TEACHER or training.detector == SCRATCH
        start = None if is_first else self._model(TEACHER)
        return trained(frames, labels, self._steps, training.seed, start)

    def _labels(self, detector: str, source: str, drive: StoredDrive) -> BoxTable:
        """Return the labels of a drive by one of their sources, of the boxes of a detector."""
        if source in UNREFINED:
            boxes = self._boxes(detector, drive)
            raw = with_ids(boxes, self._refined(detector, 'track', drive))
            return smoothed_table(raw) if source == 'smoothed' else raw
        table = self._refined(detector, source, drive)
        return table.rows(np.array([word != REJECTED for word in table.status], bool))

    def _refined(self, detector: str, source: str, drive: StoredDrive) -> BoxTable:
        """Return all boxes that `boxreg relabel` returns for those of a detector."""
        folder = self._out / 'labels' / detector / source

        def make() -> BoxTable:
            boxes = self._boxes(detector, drive)
            return refined(drive.recording, boxes, folder / drive.name, OPTIONS[source])

        return stored(folder / f'{drive.name}.pickle', make)

    def _boxes(self, detector: str, drive: StoredDrive) -> BoxTable:
        """Return the boxes without ids that a drive has by a detector."""
        if detector.startswith('published'):
            missed = int(detector.split()[1]) / 10
            rng = np.random.default_rng(0)
            boxes = drive.published.rows(rng.random(len(drive.published.boxes)) >= missed)
            # By its score each box is found again in the labels.
            return replace(boxes, scores=rng.permutation(len(boxes.boxes)) / len(boxes.boxes))
        teacher = Training('own', 'track', 0) if detector == SECOND else TEACHER
        return stored(
            self._out / 'boxes' / detector / f'{drive.name}.pickle',
            lambda: detected(self._model(teacher), drive.frames, drive.truth.frame_id),
        )

    def _tested(self, model: Detector) -> Scores:
        return {drive.name: _hits(model, drive) for drive in self._parts['test']}


def _hits(model: Detector, drive: StoredDrive) -> dict[str, dict[str, Hits]]:
    """Return the detections of a drive by class and metric."""
    parts: dict[str, list[dict[str, Hits]]] = {kind: [] for kind in CLASSES}
    names = np.array([name.lower() for name in drive.truth.class_names], str)
    for frame in drive.frames[::TEST_STEP]:
        found, scores = detections(model, frame)
        boxes = frame.fixed(found.boxes)
        at_stamp = drive.truth.stamps_ns == frame.stamp_ns
        for row, kind in enumerate(CLASSES):
            own = found.classes == row
            rows = at_stamp & (names == kind)
            in_scope = drive.truth.num_points[rows] >= MIN_TRUE_POINTS
            hits = hits_of(boxes[own], scores[own], drive.truth.boxes[rows], in_scope)
            parts[kind].append(hits)
    return {
        kind: {metric: joined([hits[metric] for hits in found]) for metric in METRICS}
        for kind, found in parts.items()
    }


def precision(scores: dict[Training, Scores]) -> dict[str, dict[str, dict[str, dict[str, dict]]]]:
    """
    Return the average precision by kind of drives, detector, source, class and metric.

    Each is the mean over the seeds, with its standard error by a bootstrap of drives and of
    seeds; the gain over raw labels of the same boxes, their gap to true labels, and the part of
    it that is closed; and of the second round, the difference to the first one.

    """
    drives = next(iter(scores.values()))
    kinds: dict[str, list[str]] = {}
    for name in drives:
        kinds.setdefault('streets' if name.startswith('street_') else name, []).append(name)
    return {kind: _precision(scores, names) for kind, names in kinds.items()}


def _precision(scores: dict[Training, Scores], drives: Sequence[str]) -> dict:
    rng = np.random.default_rng(0)
    by_labels: dict[tuple[str, str], list[Scores]] = {}
    for training, found in scores.items():
        by_labels.setdefault(training[:2], []).append(found)
    whole = np.arange(len(drives))
    draws = [whole, *(rng.integers(0, len(drives), len(drives)) for _ in range(SAMPLES))]
    found: dict[tuple[str, str], dict[tuple[str, str], Floats]] = {}
    for labels, runs in by_labels.items():
        of_kinds = {(kind, metric): _drawn(runs, drives, kind, metric, draws, rng)
                    for kind in CLASSES for metric in METRICS}  # fmt: skip
        for metric in METRICS:
            with_truth = [of_kinds[kind, metric] for kind in CLASSES]
            with_truth = [values for values in with_truth if np.isfinite(values[0])]
            of_kinds['mean', metric] = np.mean(with_truth, axis=0)
        found[labels] = of_kinds
    best = found.get(('own', 'true'))
    report: dict = {}
    for (detector, source), of_kinds in found.items():
        base = found.get((detector, 'raw'))
        first = found.get(('own', source)) if detector == SECOND else None
        for (kind, metric), values in of_kinds.items():
            if np.isfinite(values[0]):
                cell = _with_error('ap', values, len(drives)) | {
                    'seeds': len(by_labels[detector, source])
                }
                if base and best:
                    gain = values - base[kind, metric]
                    gap = best[kind, metric] - base[kind, metric]
                    cell |= _with_error('gain', gain, len(drives))
                    cell |= _with_error('gap', gap, len(drives))
                    cell |= _with_error('closed', gain / gap, len(drives))
                if first:
                    cell |= _with_error('round', values - first[kind, metric], len(drives))
                of_source = report.setdefault(detector, {}).setdefault(source, {})
                of_source.setdefault(kind, {})[metric] = cell
    return report


def _drawn(
    runs: Sequence[Scores],
    drives: Sequence[str],
    kind: str,
    metric: str,
    draws: Sequence[np.ndarray],
    rng: np.random.Generator,
) -> Floats:
    """Return the mean over seeds of the average precision on drawn drives, of all draws."""
    values = []
    for number, draw in enumerate(draws):
        count = len(runs)
        chosen = range(count) if number == 0 else rng.integers(0, count, count)
        hits = [[runs[seed][drives[row]][kind][metric] for row in draw] for seed in chosen]
        values.append(np.mean([average_precision(joined(parts)) for parts in hits]))
    return np.array(values)


def _with_error(name: str, values: Floats, num_drives: int) -> dict[str, float]:
    """Return a value and half of the middle 68 % of its bootstrap samples, those after it."""
    error = math.nan
    if num_drives > 1:  # parts of small gaps have samples far out
        low, high = np.nanquantile(values[1:], DEVIATION)
        error = float(high - low) / 2
    return {name: float(values[0]), f'{name}_error': error}
