"""Labels of drives: from boxes of a detector, through the product, to boxes to train on."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
import sys

from boxreg_ros import cli
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.core.refine import Track
from boxreg_ros.errors import RecordingError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.box_scores import by_overlap, match, Matches
from boxreg_ros.offline.track_scores import track_scores
from boxreg_ros.structures import BOX_CENTER, BOX_EXTENT, BoxArray, YAW
from measure.detector.frames import Frame, num_points, REACH
from measure.detector.network import CLASSES, detections, Detector, Labels
from measure.methods import smoothed
from measure.real import paired, PairedBoxes
import numpy as np

SCORE = 0.3
"""Least score of a detection that becomes a label; chosen."""
MIN_LABEL_POINTS = 3
"""Labels with fewer points above the ground are left out of the training, as of any source."""
EDGE = 2.0
"""Labels and true boxes so close to the end of the reach have no score as labels [m]."""
MIN_TRUE_POINTS = 5
"""True boxes with fewer points are not in scope of any score."""
PARTS = {'centre': BOX_CENTER, 'yaw': YAW, 'extents': BOX_EXTENT}
"""Columns of boxes whose errors are taken out one by one."""
ERRORS = ('along', 'across', 'up', 'yaw', 'length', 'width', 'height')
"""Of boxes in the axes of the true ones [m], of yaw in degrees."""
MIN_TRACK_BOXES = 10
"""Fewest boxes of a track whose mean and deviations count."""
MAD_TO_DEVIATION = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation."""
OPTIONS = {
    'early': ('--set', 'estimate=early'),
    'track': (),
    'track, complete': ('--complete',),
}
"""Options of `boxreg relabel` of the labels that it makes."""
UNREFINED = ('raw', 'smoothed')
"""Sources of labels that it does not make; they have the ids of 'track'."""


def detected(model: Detector, frames: list[Frame], frame_id: str) -> BoxTable:
    """Return the boxes of a detector with at least `SCORE`, in the fixed frame, without ids."""
    arrays = []
    for frame in frames:
        labels, scores = detections(model, frame)
        count = int((scores >= SCORE).sum())  # the best are first
        names = tuple(CLASSES[kind] for kind in labels.classes[:count])
        boxes = frame.fixed(labels.boxes[:count])
        ids = ('',) * count
        arrays.append(BoxArray(frame.stamp_ns, frame_id, ids, names, scores[:count], boxes))
    return BoxTable.from_arrays(arrays)


def refined(recording: Path, boxes: BoxTable, folder: Path, options: Iterable[str]) -> BoxTable:
    """
    Return the boxes of `boxreg relabel --associate`, with options, for boxes without ids.

    It runs in this process. Raises RecordingError if it fails.

    """
    folder.mkdir(parents=True, exist_ok=True)
    boxes.write(folder / 'boxes.csv')
    words = [
        'relabel', str(recording), '-o', str(folder / 'out'), '--associate', '--formats', 'csv',
        '--labels', f'csv:{folder / "boxes.csv"}', '--workers', '1', *options,
    ]  # fmt: skip
    with redirect_stdout(sys.stderr):
        if cli.main(words):
            raise RecordingError(f'{recording}: boxreg {" ".join(words)} failed')
    return BoxTable.read(folder / 'out' / 'boxes.csv')


def with_ids(boxes: BoxTable, tracked: BoxTable) -> BoxTable:
    """Return boxes with the ids of those of the same stamp and score, as in a file of boxes."""
    id_of: dict[tuple[int, float], str] = {}
    for track_id, key in zip(tracked.track_ids, _keys(tracked), strict=True):
        id_of[key] = '' if key in id_of else track_id
    return replace(boxes, track_ids=tuple(id_of.get(key, '') for key in _keys(boxes)))


def _keys(table: BoxTable) -> list[tuple[int, float]]:
    return list(zip(table.stamps_ns.tolist(), table.scores.round(9).tolist(), strict=True))


def smoothed_table(table: BoxTable) -> BoxTable:
    """Return the boxes of tracks by the smoother of `measure real`; those without id unchanged."""
    boxes = table.boxes.copy()
    ids = np.array(table.track_ids, str)
    for track_id in np.unique(ids[ids != '']):
        rows = np.flatnonzero(ids == track_id)
        rows = rows[np.argsort(table.stamps_ns[rows], kind='stable')]
        points = [np.zeros((0, 3))] * len(rows)
        stamps = table.stamps_ns[rows]
        track = Track(track_id, table.class_names[rows[0]], stamps, boxes[rows], points, None)
        boxes[rows] = smoothed(track)
    return replace(table, boxes=boxes)


def labels_of(table: BoxTable, frame: Frame) -> Labels:
    """Return the labels of a frame with enough points, within reach."""
    rows = np.flatnonzero(table.stamps_ns == frame.stamp_ns)
    boxes = frame.local(table.boxes[rows])
    kinds = np.array([CLASSES.index(table.class_names[row].lower()) for row in rows], np.int64)
    within = np.abs(boxes[:, :2]).max(axis=1, initial=0) < REACH
    kept = within & (num_points(frame.points, boxes) >= MIN_LABEL_POINTS)
    return Labels(boxes[kept], kinds[kept])


def with_points(truth: BoxTable, frames: list[Frame]) -> BoxTable:
    """Return the true boxes of frames within reach, with their points above the ground."""
    counts = np.full(len(truth.boxes), -1)
    for frame in frames:
        rows = np.flatnonzero(truth.stamps_ns == frame.stamp_ns)
        boxes = frame.local(truth.boxes[rows])
        within = np.abs(boxes[:, :2]).max(axis=1, initial=0) < REACH
        counts[rows[within]] = num_points(frame.points, boxes[within])
    return replace(truth, num_points=counts).rows(counts >= 0)


def in_reach(table: BoxTable, frames: list[Frame]) -> np.ndarray:
    """Return which boxes (n,) of a table are clearly within reach of the sensor."""
    found = np.zeros(len(table.boxes), bool)
    for frame in frames:
        rows = np.flatnonzero(table.stamps_ns == frame.stamp_ns)
        found[rows] = np.abs(frame.local(table.boxes[rows])[:, :2]).max(axis=1) < REACH - EDGE
    return found


def errors_of(
    labels: dict[str, list[BoxTable]], truths: list[BoxTable], first: str = 'raw'
) -> dict[str, dict[str, dict[str, float]]]:
    """
    Return how labels of several drives differ from the true boxes, by source and class.

    Of all classes (''), false labels for each true box and the scores of tracks; and of each
    class recall, IoU and flips of matched boxes, the gain of IoU over those of the `first` source
    with its standard error over tracks, IoU with the true value of each of the `PARTS` in its
    place, and of the errors along, across, up, of yaw and of
    extents the mean, the robust standard deviation, the deviation of the means of tracks, that
    within a track, and the autocorrelation of the latter after one sweep.

    """
    matches = {
        source: [
            match(table, truth, MIN_TRUE_POINTS, (), by_overlap)
            for table, truth in zip(tables, truths, strict=True)
        ]
        for source, tables in labels.items()
    }
    result: dict[str, dict[str, dict[str, float]]] = {}
    for source, found in matches.items():
        of_source = result.setdefault(source, {})
        for kind in ('', *CLASSES):
            masks = [
                np.array([not kind or name.lower() == kind for name in one.class_names], bool)
                for one in found
            ]
            if any(mask.any() for mask in masks):
                of_source[kind] = _errors(found, matches[first], truths, masks)
                of_source[kind] |= _with_true_parts(found, labels[source], truths, masks)
        of_source[''] |= _of_tracks(labels[source], truths)
        unmatched = sum(len(one.unmatched) for one in found)
        of_source['']['false'] = unmatched / of_source['']['boxes']
    return result


def _errors(
    matches: list[Matches], firsts: list[Matches], truths: list[BoxTable], masks: list[np.ndarray]
) -> dict[str, float]:
    """Return the errors of the true boxes of each drive where its mask (n,) is True."""
    drives = list(zip(matches, truths, masks, strict=True))
    is_found = np.concatenate([one.is_matched[mask] for one, _, mask in drives])
    bev, whole, flips = (
        np.concatenate([getattr(one, name)[mask] for one, _, mask in drives])[is_found]
        for name in ('iou_bev', 'iou_3d', 'is_flipped')
    )
    parts = {
        str(drive): paired(one, firsts[drive], truth, mask)
        for drive, (one, truth, mask) in enumerate(drives)
    }
    gain = PairedBoxes.pooled(parts).difference()
    errors, tracks = [], []
    for drive, (one, truth, mask) in enumerate(drives):
        rows = np.flatnonzero(one.is_matched & mask)
        yaw = one.rotation[rows, 2]
        yaw = np.degrees((yaw + np.pi / 2) % np.pi - np.pi / 2)  # without flips
        errors.append(np.column_stack([one.translation[rows], yaw, one.extent[rows]]))
        tracks += [f'{drive}/{truth.track_ids[one.rows[row]]}' for row in rows]
    return {
        'boxes': len(is_found),
        'recall': float(is_found.mean()),
        'iou_bev': float(bev.mean()),
        'iou_3d': float(whole.mean()),
        'over_0.7': float((whole >= 0.7).sum() / len(is_found)),
        'flips': float(flips.mean()),
        'gain': gain.iou_3d,
        'gain_error': gain.iou_3d_error,
    } | _spreads(np.concatenate(errors), np.array(tracks, str))


def _with_true_parts(
    matches: list[Matches],
    tables: list[BoxTable],
    truths: list[BoxTable],
    masks: list[np.ndarray],
) -> dict[str, float]:
    """Return the mean 3D IoU of matched boxes with the true value of each of the `PARTS`."""
    boxes, true = [], []
    for one, table, truth, mask in zip(matches, tables, truths, masks, strict=True):
        rows = np.flatnonzero(one.is_matched & mask)
        boxes.append(table.boxes[one.predicted_rows[rows]])
        true.append(truth.boxes[one.rows[rows]])
    given, wanted = np.concatenate(boxes), np.concatenate(true)
    found = {}
    for name, columns in PARTS.items():
        changed = given.copy()
        changed[:, columns] = wanted[:, columns]
        found[f'true {name}'] = float(iou_3d(changed, wanted).mean())
    return found


def _of_tracks(tables: list[BoxTable], truths: list[BoxTable]) -> dict[str, float]:
    """Return ids per object and HOTA, means over the drives."""
    found = [
        track_scores(table, truth, np.flatnonzero(truth.num_points >= MIN_TRUE_POINTS))
        for table, truth in zip(tables, truths, strict=True)
    ]
    return {
        'ids_per_object': float(np.mean([scores.ids_per_object for scores in found])),
        'hota': float(np.mean([scores.hota for scores in found])),
    }


def _spreads(errors: np.ndarray, tracks: np.ndarray) -> dict[str, float]:
    """Return the deviations of errors (n, 7) of tracks (n,), in time order within a track."""
    _, codes, counts = np.unique(tracks, return_inverse=True, return_counts=True)
    is_long = counts >= MIN_TRACK_BOXES
    long = is_long[codes]
    order = np.argsort(codes, kind='stable')
    order = order[long[order]]
    is_next = np.diff(codes[order]) == 0
    found = {}
    for name, values in zip(ERRORS, errors.T, strict=True):
        median = np.median(values)
        found |= {
            f'{name} mean': float(values.mean()),
            f'{name} robust': float(MAD_TO_DEVIATION * np.median(np.abs(values - median))),
        }
        if is_next.any():
            means = np.bincount(codes, values) / counts
            rest = values - means[codes]
            before, after = rest[order][:-1][is_next], rest[order][1:][is_next]
            variance = np.square(rest[long]).mean()
            found |= {
                f'{name} between': float(means[is_long].std()),
                f'{name} within': float(np.sqrt(variance)),
                f'{name} correlation': float((before * after).mean() / variance),
            }
    return found
