"""
`measure review`: how early the review list shows the bad tracks.

Bad tracks are those with the worst mean 3D IoU against the truth. Two inputs of each recording
are refined: its own boxes, and its true boxes with errors planted in some tracks. Then one box of
each bad track, the one that the list names, is pinned at the true box, as by a person.

"""

from dataclasses import replace
import math

from boxreg_ros.config import Config
from boxreg_ros.core.metrics import iou_3d, pose_errors
from boxreg_ros.offline.consistency import CONSISTENCY_VARIABLES
from boxreg_ros.review.changes import Changes, median
from boxreg_ros.review.corrections import Corrections
from boxreg_ros.review.decisions import Decision
from boxreg_ros.review.risk import assess, Usual
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import BOX_EXTENT, BoxArray, ROLL, X, YAW, Z
from measure import RECORDINGS
from measure.drives import Drive
import numpy as np

CUTS = (0.01, 0.05, 0.1, 0.2)
"""Parts of the list that a person looks at."""
BAD_PART = 0.1
"""Part of the tracks that is bad."""
PLANTED_PART = 0.2
"""Part of the tracks that get an error; chosen: enough of each kind of error."""
PLANTED_ERRORS = ('size', 'yaw', 'shift', 'swap', 'drift')
SEED = 0
ARGUMENTS = {'data': RECORDINGS}


def run(args):
    """Return the share of bad tracks at the top of each list, per recording and input."""
    report = {}
    for folder in args.data:
        drive = Drive.read(folder)
        inputs = {'own boxes': drive, 'planted errors': planted(drive)}
        report[str(folder)] = {name: measure(given) for name, given in inputs.items()}
    return report


def measure(drive):
    """
    Refine the boxes of a drive, and sort its tracks by several orders.

    Returns
    -------
    found : dict
        Number of ``tracks`` and of ``bad`` ones; by order the ``shares`` of bad tracks within each
        of `CUTS`; mean 3D IoU of bad tracks ``before`` and ``after`` one box is pinned, and the
        part ``gained`` of what is missing. Pinned boxes do not count. ``constant`` is the part
        that would be gained without the errors that are constant along a track, ``left`` the
        root mean square of these errors after pinning [m, rad].

    """
    tracks = [track for track in refined_tracks(drive) if track.track_id]
    overlap = _mean_overlap(drive, tracks)
    known = np.flatnonzero(np.isfinite(overlap))
    tracks = [tracks[i] for i in known]
    count = max(1, math.ceil(BAD_PART * len(tracks)))
    is_bad = np.zeros(len(tracks), bool)
    is_bad[np.argsort(overlap[known], kind='stable')[:count]] = True
    usual = Usual.of(tracks)
    risks = [assess(track, usual) for track in tracks]
    orders = {
        'risk': [-risk.track for risk in risks],
        'fewest points': [median(track.num_points) for track in tracks],
        'largest deviation': [-np.nan_to_num(track.deviation, nan=np.inf) for track in tracks],
    }
    shares = {name: _shares(is_bad, values) for name, values in orders.items()}
    shares['random'] = [_first(cut, len(tracks)) / max(1, len(tracks)) for cut in CUTS]
    pins = {
        tracks[i].track_id: int(tracks[i].stamps_ns[np.argmax(risks[i].boxes)])
        for i in np.flatnonzero(is_bad)
    }
    bad = [tracks[i] for i in np.flatnonzero(is_bad)]
    return {'tracks': len(tracks), 'bad': count, 'shares': shares, 'pins': _gain(drive, bad, pins)}


def refined_tracks(drive):
    """Return the tracks of a drive before and after registration of whole tracks."""
    changes = Changes(drive.truth.frame_id)
    given = [replace(array, ticket=row) for row, array in enumerate(drive.boxes)]
    (results,) = replace(drive, boxes=tuple(given)).refined(Config()).values()
    for refined in results:
        changes.add(given[refined.boxes.ticket], refined)
    return changes.tracks()


def _gain(drive, bad, pins):
    """Return the 3D IoU of `bad` tracks before and after `pins`, and the parts gained."""
    corrected = refined_tracks(with_pins(drive, pins))
    pinned = [track for track in corrected if track.track_id in pins]
    best = [_without_constant_error(drive, track) for track in bad]
    before, after, bound = (
        float(np.nanmean(_mean_overlap(drive, tracks, pins))) for tracks in (bad, pinned, best)
    )
    missing = max(1 - before, np.finfo(float).eps)
    return {
        'before': before,
        'after': after,
        'gained': (after - before) / missing,
        'constant': (bound - before) / missing,
        'left': _constant_errors(drive, pinned),
    }


def _constant_errors(drive, tracks):
    """Return the root mean square over tracks of their mean errors [m, rad]."""
    means = []
    for track in tracks:
        _, errors = _errors(drive, track)
        yaw = errors.rotation[:, 2:]
        means.append(np.hstack([errors.translation, yaw, errors.extent]).mean(axis=0))
    values = np.sqrt(np.mean(np.square(means), axis=0))
    return dict(zip(CONSISTENCY_VARIABLES, values.tolist(), strict=True))


def _without_constant_error(drive, track):
    """
    Return a track without the mean errors of its poses in box axes and of its extents.

    A pinned box shows the error at its stamp: for the other stamps it shows what is constant.

    """
    rows, errors = _errors(drive, track)
    boxes = track.boxes.copy()
    axes = matrix_from_rpy(boxes[rows, ROLL:] - errors.rotation)
    boxes[rows, X : Z + 1] -= axes @ errors.translation.mean(axis=0)
    boxes[rows, ROLL:] -= errors.rotation.mean(axis=0)
    boxes[rows, BOX_EXTENT] -= errors.extent.mean(axis=0)
    return replace(track, boxes=boxes)


def _errors(drive, track):
    """Return the rows of a track that have a true box, and their errors."""
    row_of = _rows_of_truth(drive.truth)
    keys = [(stamp_ns, track.track_id) for stamp_ns in track.stamps_ns.tolist()]
    rows = [i for i, key in enumerate(keys) if key in row_of]
    true = drive.truth.boxes[[row_of[keys[i]] for i in rows]]
    return rows, pose_errors(track.boxes[rows], true)


def _rows_of_truth(truth):
    """Return the row of each true box by stamp and track id."""
    keys = zip(truth.stamps_ns.tolist(), truth.track_ids, strict=True)
    return {key: row for row, key in enumerate(keys)}


def with_pins(drive, pins):
    """Return a drive with one pinned box of some tracks, at the true box: stamps by track id."""
    truth = drive.truth
    keys = zip(truth.track_ids, truth.stamps_ns.tolist(), strict=True)
    true_boxes = dict(zip(keys, truth.boxes, strict=True))
    corrections = Corrections(
        Decision(*key, 'pin', '', truth.frame_id, true_boxes[key])
        for key in pins.items()
        if key in true_boxes
    )
    return replace(drive, boxes=tuple(map(corrections.to_register, drive.boxes)))


def planted(drive):
    """Return a drive with its true boxes as input, with errors planted in some tracks."""
    rng = np.random.default_rng(SEED)
    truth = drive.truth
    boxes = truth.boxes.copy()
    names = np.array(truth.track_ids, object)
    tracks = sorted(set(truth.track_ids))
    chosen = rng.permutation(tracks)[: max(1, round(PLANTED_PART * len(tracks)))]
    for number, track_id in enumerate(chosen):
        rows = np.flatnonzero(names == track_id)
        error = PLANTED_ERRORS[number % len(PLANTED_ERRORS)]
        if error == 'swap':
            _swap(names, rows, truth.stamps_ns)
        else:
            boxes[rows] = _with_error(boxes[rows], error, rng)
    arrays = []
    for stamp_ns in np.unique(truth.stamps_ns).tolist():
        rows = np.flatnonzero(truth.stamps_ns == stamp_ns)
        arrays.append(
            BoxArray(
                stamp_ns,
                truth.frame_id,
                tuple(str(names[row]) for row in rows),
                tuple(truth.class_names[row] for row in rows),
                np.ones(len(rows)),
                boxes[rows],
            )
        )
    return replace(drive, boxes=tuple(arrays))


def _with_error(boxes, error, rng):
    """Return the boxes (n, 9) of a track with an error: of size, yaw, a shift or a drift."""
    changed = boxes.copy()
    sign = rng.choice([-1.0, 1.0])
    if error == 'size':
        changed[:, BOX_EXTENT] *= 1 + sign * np.array([0.3, 0.2, 0.15])
    elif error == 'yaw':
        changed[:, YAW] += sign * 0.2
    else:
        offset = sign * np.array([0.2, 0.3, 0.0]) * boxes[0, BOX_EXTENT]
        axes = matrix_from_rpy(boxes[:, ROLL:])
        growth = np.linspace(0.0, 2.0, len(boxes)) if error == 'drift' else np.ones(len(boxes))
        changed[:, X : Z + 1] += growth[:, None] * (axes @ offset)
    return changed


def _swap(names, rows, stamps_ns):
    """Swap the id of a track with that of another one in the middle of both, if there is one."""
    middle_ns = np.median(stamps_ns[rows])
    first = names[rows[0]]
    before = set(names[stamps_ns < middle_ns])
    for second in sorted(set(names[stamps_ns > middle_ns]) & before - {first}):
        is_later = stamps_ns > middle_ns
        mine = is_later & np.equal(names, first)
        others = is_later & np.equal(names, second)
        names[mine] = second
        names[others] = first
        return


def _mean_overlap(drive, tracks, left_out=None):
    """
    Return the mean 3D IoU of each track with the truth of its id, NaN without any.

    Boxes of the stamps `left_out`, by track id, do not count.

    """
    without = left_out or {}
    truth = drive.truth
    row_of = _rows_of_truth(truth)
    means = np.full(len(tracks), np.nan)
    for index, track in enumerate(tracks):
        rows = [row_of.get((stamp_ns, track.track_id)) for stamp_ns in track.stamps_ns.tolist()]
        pairs = [
            (i, row)
            for i, row in enumerate(rows)
            if row is not None and track.stamps_ns[i] != without.get(track.track_id)
        ]
        if pairs:
            found, known = np.array(pairs).T
            means[index] = iou_3d(track.boxes[found], truth.boxes[known]).mean()
    return means


def _shares(is_bad, values):
    """Return the share of bad tracks within each of `CUTS` of the list sorted by `values`."""
    ordered = is_bad[np.argsort(np.array(values), kind='stable')]
    return [float(ordered[: _first(cut, len(ordered))].sum() / is_bad.sum()) for cut in CUTS]


def _first(cut, count):
    """Return the number of tracks in the first part of a list, at least one."""
    return max(1, math.ceil(cut * count))
