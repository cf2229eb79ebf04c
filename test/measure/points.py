"""
`measure points`: labels of points against those of a simulation, whose points know their object.

Boxes of the input, smoothed ones, and those that the method has refined label the same sweeps.
Points of the accumulated map that were measured on a moving object are its shadows.

"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
import time

from boxreg_ros.bench.common import add_json_argument, line
from boxreg_ros.bench.methods import run_methods
from boxreg_ros.config import Config, KINDS
from boxreg_ros.core.point_labels import MOVING, ObjectTrack, PointLabeller
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.drive import Drive
from boxreg_ros.simulation.scene import SimulatedScene
from boxreg_ros.simulation.simulate import simulate
from boxreg_ros.structures import Floats
from measure import print_json
import numpy as np
from numpy.typing import NDArray

SCENARIOS = ('street', 'highway')
METHODS = ('input', 'smoothing only', 'ours, track')
RANGES = (0.0, 20.0, 40.0, 80.0)
"""Ends of the classes of distance [m]."""
MIN_POINTS = 100
"""Least returns of a vehicle whose instance counts among the well seen ones."""
MOVING_STEP = 0.03
"""Least motion of a moving object in 0.1 s [m]."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `measure points`."""
    parser.add_argument('--scenario', choices=SCENARIOS, default='street', help='default: street')
    parser.add_argument(
        '--seeds', type=int, default=2, metavar='N', help='number of drives (default: 2)'
    )
    parser.add_argument('--sweeps', type=int, metavar='N', help='sweeps of a drive')
    add_json_argument(parser)


def run(args: argparse.Namespace) -> int:
    """Print the IoU of labels by method: of instances, of "moving" and by distance."""
    counts: dict[str, Counter[str]] = {name: Counter() for name in METHODS}
    for seed in range(args.seeds):
        scene = simulate(args.scenario, seed, args.sweeps)
        for name, found in measured(scene).items():
            counts[name] += found
    results = {name: scores(found) for name, found in counts.items()}
    if args.json:
        print_json(results)
        return 0
    print(line('', list(results)))
    for score in dict.fromkeys(score for found in results.values() for score in found):
        print(line(score, [found.get(score, np.nan) for found in results.values()]))
    return 0


def measured(scene: SimulatedScene) -> dict[str, Counter[str]]:
    """Return the counts of each of `METHODS` on a scene."""
    drive = Drive.from_scene(scene)
    methods = run_methods(drive, wanted=('smoothing', 'ours'))
    margins = learnt_margins(drive)
    found = {}
    for name in METHODS:
        table = methods[name]
        assert isinstance(table, BoxTable)
        found[name] = labelled(scene, drive, tracks_of(table), margins)
    return found


def learnt_margins(drive: Drive) -> Floats:
    """Return the labelling margins that the registrar learns from a drive, (K, 6) [m]."""
    registrar = BoxRegistrar(Config())
    for sweep, boxes in zip(drive.sweeps, drive.boxes, strict=True):
        registrar.add_sweep(sweep)
        registrar.add_boxes(boxes)
    registrar.flush()
    return registrar.margins()


def tracks_of(table: BoxTable) -> list[ObjectTrack]:
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


def labelled(
    scene: SimulatedScene, drive: Drive, tracks: Sequence[ObjectTrack], margins: Floats
) -> Counter[str]:
    """Return counts of points, named by what they are of; see `scores`."""
    config = Config()
    sampling = replace(config.sampling, box_time='stamp')
    kinds = [KINDS.index(config.kind(track.class_name)) for track in tracks]
    stamps_ns = np.array([sweep.stamp_ns for sweep in scene.sweeps])
    config = replace(config, sampling=sampling)
    labeller = PointLabeller(tracks, stamps_ns, config, margins[kinds])
    ids = [actor.track_id for actor in scene.actors]
    actor_of = np.array([*(ids.index(track.track_id) for track in tracks), -2, -1])
    classes = np.array([*(actor.class_name for actor in scene.actors), 'unknown', 'background'])
    is_vehicle = np.array([config.kind(name) == 'vehicle' for name in classes])
    counts: Counter[str] = Counter()
    for index, (sweep, owners) in enumerate(zip(drive.sweeps, scene.owners, strict=True)):
        begun = time.process_time()
        labels = labeller.label(sweep)
        counts['nanoseconds'] += round(1e9 * (time.process_time() - begun))
        counts['sweeps'] += 1
        found = actor_of[labels.track]
        moves = moving_actors(scene, index)[owners]
        is_moving = (labels.motion == MOVING) & (labels.track >= 0)
        add_iou(counts, 'moving', is_moving, moves)
        counts['unknown'] += int((found == -2).sum())
        counts['points'] += len(owners)
        counts['shadow'] += int((moves & ~labels.is_dynamic).sum())
        counts['map'] += int((~labels.is_dynamic).sum())
        counts['measured on moving'] += int(moves.sum())
        distance = np.linalg.norm(scene.sweeps[index].points, axis=1)
        for low, high in pairwise(RANGES):
            near = (distance >= low) & (distance < high)
            add_iou(counts, f'moving, {low:g} to {high:g} m', is_moving[near], moves[near])
        for name in dict.fromkeys(classes[:-2]):
            add_iou(counts, name, classes[found] == name, classes[owners] == name)
        returns = np.bincount(owners + 1, minlength=len(ids) + 1)[1:]
        for actor in np.flatnonzero((returns >= MIN_POINTS) & is_vehicle[:-2]):
            add_iou(counts, 'well seen vehicles', found == actor, owners == actor)
    return counts


def moving_actors(scene: SimulatedScene, index: int) -> NDArray[np.bool_]:
    """Return which actors move at a sweep; the last entry is that of the road."""
    seconds = (scene.sweeps[index].stamp_ns - scene.sweeps[0].stamp_ns) * 1e-9
    ends = np.array([seconds - 0.05, seconds + 0.05])
    steps = [np.diff(actor.motion.at(ends)[:, :2], axis=0) for actor in scene.actors]
    return np.array([*(np.linalg.norm(step) > MOVING_STEP for step in steps), False])


def add_iou(
    counts: Counter[str], name: str, found: NDArray[np.bool_], true: NDArray[np.bool_]
) -> None:
    """Count the points of the intersection and of the union of two sets."""
    counts[f'{name}: both'] += int((found & true).sum())
    counts[f'{name}: either'] += int((found | true).sum())


def scores(counts: Counter[str]) -> dict[str, float]:
    """Return the IoU of each set, shares of points, and the CPU time of a sweep [ms]."""
    names = [key.removesuffix(': either') for key in counts if key.endswith(': either')]
    found = {
        f'IoU {name}': counts[f'{name}: both'] / counts[f'{name}: either']
        for name in names
        if counts[f'{name}: either']
    }
    found['unknown'] = counts['unknown'] / counts['points']
    found['shadows in the map'] = counts['shadow'] / counts['map']
    found['moving points left'] = counts['shadow'] / max(counts['measured on moving'], 1)
    found['CPU of a sweep [ms]'] = counts['nanoseconds'] * 1e-6 / counts['sweeps']
    return found
