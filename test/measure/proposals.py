"""
Objects that no box covers: how many of those left out are proposed, and how many that are none.

Each track is left out once, with a third of all; the true boxes of the others are given. Counted
are tracks with `MIN_SEEN` boxes of `MIN_POINTS` points that overlap no other track: some data sets
label an object twice. A proposal that is near no true box is a false alarm.

"""

import time

from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.offline.completion import points_above_road
from boxreg_ros.tracks.proposals import Proposer
from measure import RECORDINGS
from measure.drives import Drive
import numpy as np

PARTS = 3
MIN_SEEN, MIN_POINTS = 10, 20
OVERLAP = 0.1
"""3D IoU from which a box is of the same object."""
NEAR = 1.0
"""And distance of the centres, up to which it is [m]."""
ARGUMENTS = {'data': RECORDINGS}


def run(args):
    """Return one row per recording."""
    return {str(folder): _row(Drive.read(folder)) for folder in args.data}


def _row(drive):
    truth = drive.truth
    ids = np.array(truth.track_ids)
    counted = _counted(drive, ids)
    names = np.random.default_rng(0).permutation(list(dict.fromkeys(truth.track_ids)))
    iou, false, seconds, cpu, sweeps = {}, 0, 0.0, 0.0, 0
    for part in range(PARTS):
        left_out = set(names[part::PARTS].tolist())
        proposer = Proposer()
        known = ~np.isin(ids, list(left_out))
        stamps = []
        for sweep in drive.sweeps:
            boxes = truth.boxes[known & (truth.stamps_ns == sweep.stamp_ns)]
            begun = time.process_time()
            proposer.add(sweep.stamp_ns, sweep.in_frame().points, sweep.origin, boxes)
            cpu += time.process_time() - begun
            stamps.append(sweep.stamp_ns)
        seconds += (stamps[-1] - stamps[0]) * 1e-9
        sweeps += len(stamps)
        for one in proposer.proposals():
            name, value = _object_at(truth, ids, one)
            if name is None:
                false += 1
            elif name in left_out:
                iou[name] = max(value, iou.get(name, 0.0))
    found = [iou[name] for name in counted if name in iou]
    return {
        'tracks': len(counted),
        'proposed': len(found),
        'iou': float(np.mean(found)) if found else np.nan,
        'false': false,
        'false_per_minute': false / seconds * 60,
        'ms_per_sweep': 1e3 * cpu / sweeps,
    }


def _counted(drive, ids):
    """Return the names of the tracks that count."""
    truth = drive.truth
    num_points = np.zeros(len(ids), int)
    is_double = np.zeros(len(ids), bool)
    for sweep in drive.sweeps:
        rows = np.flatnonzero(truth.stamps_ns == sweep.stamp_ns)
        if not len(rows):
            continue
        boxes = truth.boxes[rows]
        num_points[rows] = points_above_road(sweep, boxes)
        for i, row in enumerate(rows):
            others = np.delete(boxes, i, axis=0)
            overlap = iou_3d(np.tile(boxes[i], (len(others), 1)), others)
            is_double[row] = overlap.max(initial=0.0) > OVERLAP
    seen = num_points >= MIN_POINTS
    return [
        name
        for name in dict.fromkeys(truth.track_ids)
        if seen[ids == name].sum() >= MIN_SEEN and not is_double[ids == name].any()
    ]


def _object_at(truth, ids, one):
    """Return the track that a proposal is of and their IoU; None and 0 for none."""
    rows = np.flatnonzero(truth.stamps_ns == one.stamp_ns)
    if not len(rows):
        return None, 0.0
    iou = iou_3d(np.tile(one.box, (len(rows), 1)), truth.boxes[rows])
    away = np.linalg.norm(truth.boxes[rows, :2] - one.box[:2], axis=1)
    best = int(iou.argmax() if iou.max() > OVERLAP else away.argmin())
    if iou[best] <= OVERLAP and away[best] > NEAR:
        return None, 0.0
    return str(ids[rows[best]]), float(iou[best])
