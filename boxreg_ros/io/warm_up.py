"""The first registration of a process, ahead of time: imports, and kernels loaded or compiled."""

from __future__ import annotations

from dataclasses import replace

from boxreg_ros.config import Config, PaperConfig, SolverConfig
from boxreg_ros.core.observation import observe
from boxreg_ros.core.point_labels import ObjectTrack, PointLabeller
from boxreg_ros.core.registrar import BoxRegistrar, Submit
from boxreg_ros.structures import BoxArray, Sweep
import numpy as np


def warm_up(config: Config, submit: Submit | None = None) -> None:
    """
    Register a synthetic stream, so that the first real one does not wait.

    Libraries are imported and kernels loaded, or compiled at the very first start, for the
    objective, estimate and mode of the stream to come. Six stamps of a window of four cover cold,
    warm and full windows, or two rounds of a whole track; a few iterations of the solver are
    enough. The points of the last sweep have times.

    """
    quick = Config(
        objective=config.objective, mode=config.mode, estimate=config.estimate,
        window=4, lag=3, solver=SolverConfig(rounds=2),
        paper=PaperConfig(iterations=2),
    )  # fmt: skip
    registrar = BoxRegistrar(quick, submit)
    sweeps, arrays = _passing_car()
    sweeps[-1] = replace(sweeps[-1], times=np.full(len(sweeps[-1].points), 0.1))
    for sweep, boxes in zip(sweeps, arrays, strict=True):
        registrar.add_sweep(sweep)
        registrar.add_boxes(boxes)
    registrar.flush()


def warm_up_follower(config: Config) -> None:
    """Follow a synthetic box through sweeps, there and back: its kernels are loaded."""
    from boxreg_ros.core.follow import follow  # splines of SciPy: few runs need them

    sweeps, seeds = _passing_car()
    stamps_ns = np.array([sweep.stamp_ns for sweep in sweeps])
    follow(stamps_ns, [sweep.points for sweep in sweeps], [seeds[1], seeds[4]], config)


def warm_up_followed(config: Config) -> None:
    """Follow a synthetic box as the node does: its kernels are loaded."""
    from boxreg_ros.core.following.stream import FollowedObjects

    sweeps, seeds = _passing_car()
    followed = FollowedObjects(config)
    followed.add(seeds[1])
    for sweep in sweeps:
        followed.add_sweep(sweep)
        followed.boxes_at(sweep.stamp_ns, sweep.stamp_ns, np.zeros((0, 9)))


def warm_up_labels(config: Config) -> None:
    """Label the points of a synthetic sweep: its kernels are loaded."""
    sweeps, arrays = _passing_car()
    stamps_ns = np.array([sweep.stamp_ns for sweep in sweeps])
    boxes = np.concatenate([array.boxes for array in arrays])
    track = ObjectTrack('1', 'car', stamps_ns, boxes, np.ones(len(boxes), bool))
    sweep = replace(sweeps[0], times=np.zeros(len(sweeps[0].points)))
    PointLabeller([track], stamps_ns, config, np.zeros((1, 6))).label(sweep)


def _passing_car() -> tuple[list[Sweep], list[BoxArray]]:
    """Return six sweeps of a car, with points as recordings have them, and its boxes."""
    rng = np.random.default_rng(0)
    sweeps, boxes = [], []
    for k in range(6):
        box = np.array([[10.0 + 0.5 * k, 0, 0, 4, 2, 1.5, 0, 0, 0]])
        points = rng.uniform(-1, 1, (64, 3)) * [2, 1, 0.7] + box[0, :3]
        sweeps.append(Sweep(k * 10**8, 'map', points.astype(np.float32)))
        boxes.append(BoxArray(k * 10**8, 'map', ('1',), ('car',), np.ones(1), box))
    return sweeps, boxes


def warm_up_crop(config: Config) -> None:
    """Crop a synthetic sweep: what numba sets up for its first kernel takes half a second."""
    box = np.array([[0.0, 0, 0, 4, 2, 1.5, 0, 0, 0]])
    observe(Sweep(0, 'map', np.zeros((1, 3), np.float32)), box, 0, config)
