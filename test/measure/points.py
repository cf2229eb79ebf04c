"""
`measure points`: labels of points against those of drives whose points have a known object.

Boxes of the input, smoothed ones, and those that the method has refined label the same sweeps.
Points of the accumulated map that were measured on a moving object are its shadows.

In a recording with exact truth a point is on the object whose true box it is in.

"""

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
import time
from typing import NamedTuple

from boxreg_ros.config import Config, KINDS
from boxreg_ros.core.point_labels import MOVING, ObjectTrack, PointLabeller
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.point_products import MAP_VOXEL
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.simulation.simulate import simulate
from boxreg_ros.structures import LENGTH, ROLL
from measure.drives import Drive
from measure.methods import run_methods
import numpy as np

SCENARIOS = ('street', 'highway')
METHODS = ('input', 'smoothing only', 'ours, track')
RANGES = (0.0, 20.0, 40.0, 80.0)
"""Ends of the classes of distance [m]."""
MIN_POINTS = {'vehicle': 100, 'cyclist': 30, 'pedestrian': 30}
"""Least returns of an object whose instance counts among the well seen ones."""
MOVING_SPEED = 0.3
"""Least speed of a moving object [m/s]."""
TRUTH_SECONDS = 1.0
"""True boxes of so long state the speed [s]: those of parked vehicles wander by centimetres."""
NOISE = 0.08
"""Points so far outside of a true box are on its object [m]: four deviations of the range."""


class Truth(NamedTuple):
    """What the points of a drive are on: arrays by sweep, of its M points or of n objects."""

    ids: Sequence[str]
    classes: Sequence[str]
    owners: Sequence[np.ndarray]  # row of the object of each point; -1 for none
    moves: Sequence[np.ndarray]  # whether each object moves; last False, of points on none

    @classmethod
    def of_scene(cls, scene):
        """Return that of a simulation."""
        moves = []
        for sweep in scene.sweeps:
            seconds = (sweep.stamp_ns - scene.sweeps[0].stamp_ns) * 1e-9
            ends = np.array([seconds - 0.05, seconds + 0.05])
            ways = [np.diff(actor.motion.at(ends)[:, :2], axis=0) for actor in scene.actors]
            speeds = [np.linalg.norm(way) / 0.1 for way in ways]
            moves.append(np.array([*speeds, 0.0]) > MOVING_SPEED)
        ids = [actor.track_id for actor in scene.actors]
        return cls(ids, [actor.class_name for actor in scene.actors], scene.owners, moves)

    @classmethod
    def of_boxes(cls, drive):
        """Return that of a recording, by its true boxes, which are at the stamps of the sweeps."""
        tracks = tracks_of(drive.truth)
        owners, moves = [], []
        for sweep in drive.sweeps:
            points = sweep.in_frame().points.astype(np.float64)
            owner = np.full(len(points), -1)
            is_moving = np.zeros(len(tracks) + 1, bool)
            for i, track in enumerate(tracks):
                row = int(np.searchsorted(track.stamps_ns, sweep.stamp_ns))
                if row == len(track.stamps_ns) or track.stamps_ns[row] != sweep.stamp_ns:
                    continue
                box = track.boxes[row]
                near = np.flatnonzero(np.abs(points[:, :2] - box[:2]).max(1) < box[LENGTH])
                local = (points[near] - box[:3]) @ matrix_from_rpy(box[ROLL:])
                owner[near[(np.abs(local) <= box[LENGTH:ROLL] / 2 + NOISE).all(1)]] = i
                half_ns = round(TRUTH_SECONDS / 2 * 1e9)
                ends = [
                    np.searchsorted(track.stamps_ns, sweep.stamp_ns - half_ns),
                    np.searchsorted(track.stamps_ns, sweep.stamp_ns + half_ns, 'right') - 1,
                ]
                way = np.linalg.norm(np.diff(track.boxes[ends, :2], axis=0))
                seconds = np.ptp(track.stamps_ns[ends]) * 1e-9
                is_moving[i] = way > MOVING_SPEED * seconds
            owners.append(owner)
            moves.append(is_moving)
        ids = [track.track_id for track in tracks]
        return cls(ids, [track.class_name for track in tracks], owners, moves)


ARGUMENTS = {
    '--scenario': ('street', '', {'choices': SCENARIOS}),
    '--seeds': (2, 'number of drives'),
    '--sweeps': (int, 'sweeps of a drive'),
    'data': (Path, 'recording and its exact truth.csv, not simulated drives', {'nargs': '*'}),
}


def run(args):
    """Return the IoU of labels by method: of instances, of "moving" and by distance."""
    counts = {name: Counter() for name in METHODS}
    for drive, truth in drives(args):
        for name, found in measured(drive, truth).items():
            counts[name] += found
    return {name: scores(found) for name, found in counts.items()}


def drives(args):
    """Yield the drives that the options ask for."""
    for folder in args.data:
        drive = Drive.read(folder)
        yield drive, Truth.of_boxes(drive)
    for seed in range(0 if args.data else args.seeds):
        scene = simulate(args.scenario, seed, args.sweeps)
        yield Drive.from_scene(scene), Truth.of_scene(scene)


def measured(drive, truth):
    """Return the counts of each of `METHODS` on a drive."""
    registrar = BoxRegistrar(Config())
    for sweep, boxes in zip(drive.sweeps, drive.boxes, strict=True):
        registrar.add_sweep(sweep)
        registrar.add_boxes(boxes)
    registrar.flush()
    methods = run_methods(drive, wanted=('smoothing', 'ours'))
    at_stamp = Config().updated({'sampling.box_time': 'stamp'})  # as detections are simulated
    refined = registrar.box_time.resolved(Config())  # as the run takes them
    found = {}
    for name in METHODS:
        table = methods[name]
        assert isinstance(table, BoxTable)
        config = refined if name.startswith('ours') else at_stamp
        found[name] = labelled(drive, truth, tracks_of(table), config, registrar.margins())
    return found


def tracks_of(table):
    """Return the tracks of a table as the labeller takes them."""
    names = np.array(table.track_ids)
    tracks = []
    for name in dict.fromkeys(table.track_ids):
        rows = np.flatnonzero(names == name)
        stamps_ns, first = np.unique(table.stamps_ns[rows], return_index=True)
        rows = rows[first]
        is_certain = np.array([table.status[row] != 'kept' for row in rows])
        class_name = table.class_names[rows[0]]
        tracks.append(ObjectTrack(name, class_name, stamps_ns, table.boxes[rows], is_certain))
    return tracks


def labelled(drive, truth, tracks, config, margins):
    """Return counts of points, named by what they are of; see `scores`."""
    kinds = [KINDS.index(config.kind(track.class_name)) for track in tracks]
    stamps_ns = np.array([boxes.stamp_ns for boxes in drive.boxes])
    labeller = PointLabeller(tracks, stamps_ns, config, margins[kinds])
    object_of = np.array([*(truth.ids.index(track.track_id) for track in tracks), -2, -1])
    classes = np.array([*truth.classes, 'unknown', 'background'])
    kind_of = np.array([*(config.kind(name) for name in truth.classes), '', ''])
    counts = Counter()
    kept, is_shadow = [], []
    for sweep, owners, moving in zip(drive.sweeps, truth.owners, truth.moves, strict=True):
        begun = time.process_time()
        labels = labeller.label(sweep)
        counts['nanoseconds'] += round(1e9 * (time.process_time() - begun))
        counts['sweeps'] += 1
        found = object_of[labels.track]
        moves = moving[owners]
        is_moving = (labels.motion == MOVING) & (labels.track >= 0)
        points = sweep.in_frame().points
        kept.append(points[~labels.is_dynamic])
        is_shadow.append(moves[~labels.is_dynamic])
        counts['unknown'] += int((found == -2).sum())
        counts['background unknown'] += int((found[owners < 0] == -2).sum())
        counts['background'] += int((owners < 0).sum())
        counts['points'] += len(owners)
        counts['measured on moving'] += int(moves.sum())
        counts['moving left'] += int(is_shadow[-1].sum())
        add_iou(counts, 'moving', is_moving, moves)
        distance = np.linalg.norm(points - sweep.origin, axis=1)
        for low, high in pairwise(RANGES):
            near = (distance >= low) & (distance < high)
            add_iou(counts, f'moving, {low:g} to {high:g} m', is_moving[near], moves[near])
        for name in dict.fromkeys(truth.classes):
            is_class, of_class = classes[found] == name, classes[owners] == name
            add_iou(counts, name, is_class, of_class)
            add_iou(counts, f'moving {name}', is_moving & is_class, moves & of_class)
        returns = np.bincount(owners + 1, minlength=len(truth.ids) + 1)[1:]
        for row, kind in enumerate(kind_of[:-2]):
            if returns[row] >= MIN_POINTS[kind]:
                add_iou(counts, f'{kind} instances', found == row, owners == row)
    cells = np.floor(np.concatenate(kept) / MAP_VOXEL).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    counts['map'] = len(first)
    counts['shadow'] = int(np.concatenate(is_shadow)[first].sum())
    return counts


def add_iou(counts, name, found, true):
    """Count the points of the intersection and of the union of two sets."""
    counts[f'{name}: both'] += int((found & true).sum())
    counts[f'{name}: either'] += int((found | true).sum())


def scores(counts):
    """Return the IoU of each set, shares of points, and the CPU time of a sweep [ms]."""
    names = [key.removesuffix(': either') for key in counts if key.endswith(': either')]
    found = {
        f'IoU {name}': counts[f'{name}: both'] / counts[f'{name}: either']
        for name in names
        if counts[f'{name}: either']
    }
    found['background unknown'] = counts['background unknown'] / counts['background']
    found['unknown'] = counts['unknown'] / counts['points']
    found['shadows in the map'] = counts['shadow'] / counts['map']
    found['moving points left'] = counts['moving left'] / max(counts['measured on moving'], 1)
    found['CPU of a sweep [ms]'] = counts['nanoseconds'] * 1e-6 / counts['sweeps']
    return found
