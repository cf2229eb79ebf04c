"""Small drives with known truth: cars on given paths, their points and the boxes of a detector."""

from boxreg_ros.config import COMPLETE_STEPS
from boxreg_ros.structures import BoxArray, Sweep
from boxreg_ros.tracks.tracklet import Place, Tracklet
from measure.tracks import completed
import numpy as np
from relabel_results import QUICK
from scenes import EXTENT, returns

STEP_NS = 100_000_000
ALL_STEPS = QUICK.updated({f'complete.{step}': True for step in COMPLETE_STEPS})


def only(*steps):
    """Return quick settings with some of the steps."""
    return QUICK.updated({f'complete.{step}': True for step in steps})


def path(start, velocity, count, extent=EXTENT):
    """Return the boxes (count, 9) of a car at constant velocity, at 10 Hz."""
    seconds = np.arange(count)[:, None] * STEP_NS * 1e-9
    boxes = np.zeros((count, 9))
    boxes[:, :2] = np.asarray(start) + seconds * velocity
    boxes[:, 2] = extent[2] / 2
    boxes[:, 3:6] = extent
    boxes[:, 8] = np.arctan2(velocity[1], velocity[0])
    return boxes


def detections(step, boxes, stamp_ns=None):
    """Return the array of a step; `boxes` are (id, box) or (id, box, class)."""
    names = [item[2] if len(item) > 2 else 'car' for item in boxes]
    table = np.array([item[1] for item in boxes]).reshape(-1, 9)
    stamp_ns = step * STEP_NS if stamp_ns is None else stamp_ns
    ids = tuple(item[0] for item in boxes)
    return BoxArray(stamp_ns, 'odom', ids, tuple(names), np.full(len(ids), 0.9), table)


def drive(truth, given, seed=0):
    """
    Return sweeps and arrays in the order of stamps.

    Parameters
    ----------
    truth : list of n lists of boxes (9,)
        Objects that return points, per step.
    given : list of n lists
        Detections per step, as of `detections`; None for a step without a message.
    seed : int
        Of the points.

    """
    rng = np.random.default_rng(seed)
    items = []
    for step, (objects, boxes) in enumerate(zip(truth, given, strict=True)):
        points = [returns(box, rng) for box in objects]
        cloud = np.concatenate([np.zeros((0, 3)), *points])
        items.append(Sweep(step * STEP_NS, 'odom', cloud, None, np.array([0.0, 0.0, 1.5])))
        if boxes is not None:
            items.append(detections(step, boxes))
    return items


def complete(items, config=ALL_STEPS):
    """Return rows (step, id, class, status, box) of the result, and the steps by track."""
    results, tracks = completed(items, 'odom', config)
    rows = []
    for result in results:
        boxes = result.boxes
        columns = zip(boxes.track_ids, boxes.class_names, result.status, boxes.boxes, strict=True)
        rows += [(boxes.stamp_ns // STEP_NS, *row) for row in columns]
    return rows, {track.track_id: track for track in tracks}


def steps_of(rows, track_id, status=None):
    """Return the steps at which a track has a box, of one status if given."""
    return [r[0] for r in rows if r[1] == track_id and status in (None, r[3])]


def tracklet(track_id, boxes, first=0, steps=None, points=50, class_name='car'):
    """Return boxes (n, 9) as a tracklet from step `first` on."""
    n = len(boxes)
    numbers = np.arange(first, first + n) if steps is None else np.asarray(steps)
    return Tracklet(
        track_id,
        class_name,
        tuple(Place(int(number), 0) for number in numbers),
        numbers * STEP_NS,
        np.asarray(boxes, float),
        np.tile(0.01 * np.eye(6), (n, 1, 1)),
        np.full(n, 0.9),
        np.full(n, points) if np.isscalar(points) else np.asarray(points),
    )
