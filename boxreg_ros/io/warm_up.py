"""The first registration of a process, ahead of time: imports, and kernels loaded or compiled."""

from __future__ import annotations

from boxreg_ros.config import Config, PaperConfig, SolverConfig
from boxreg_ros.core.follow import follow
from boxreg_ros.core.observation import observe
from boxreg_ros.core.registrar import BoxRegistrar, Submit
from boxreg_ros.structures import BoxArray, Sweep
import numpy as np


def warm_up(config: Config, submit: Submit | None = None) -> None:
    """
    Register a synthetic stream, so that the first real one does not wait.

    Libraries are imported and kernels loaded, or compiled at the very first start. Six stamps of
    a window of four cover cold, warm and full windows, or two rounds of a whole track; a few
    iterations of the solver are enough.

    Parameters
    ----------
    config : Config
        Objective, estimate and mode are those of the stream to come.
    submit : callable, optional
        As for `BoxRegistrar`, which it is given to.

    """
    rng = np.random.default_rng(0)
    quick = Config(
        objective=config.objective, mode=config.mode, estimate=config.estimate,
        window=4, lag=3, solver=SolverConfig(rounds=2, iterations=2),
        paper=PaperConfig(multiplier_rounds=1, iterations=2),
    )  # fmt: skip
    registrar = BoxRegistrar(quick, submit)
    for k in range(6):
        stamp_ns = k * 10**8
        box = np.array([[10.0 + 0.5 * k, 0, 0, 4, 2, 1.5, 0, 0, 0]])
        points = rng.uniform(-1, 1, (64, 3)) * [2, 1, 0.7] + box[0, :3]
        registrar.add_sweep(Sweep(stamp_ns, 'map', points.astype(np.float32)))
        registrar.add_boxes(BoxArray(stamp_ns, 'map', ('1',), ('car',), np.ones(1), box))
    registrar.flush()


def warm_up_follower(config: Config) -> None:
    """Follow a synthetic box through six sweeps, there and back: its kernels are loaded."""
    rng = np.random.default_rng(0)
    centres = 10.0 + 0.5 * np.arange(6)
    sweeps = [rng.uniform(-1, 1, (64, 3)) * [2, 1, 0.7] + [x, 0, 0] for x in centres]
    stamps_ns = np.arange(6) * 10**8
    seeds = [
        BoxArray(
            int(stamps_ns[row]), 'map', ('1',), ('car',), np.ones(1),
            np.array([[centres[row], 0, 0, 4, 2, 1.5, 0, 0, 0]]),
        )
        for row in (1, 4)
    ]  # fmt: skip
    follow(stamps_ns, sweeps, seeds, config)


def warm_up_crop(config: Config) -> None:
    """Crop a synthetic sweep: what numba sets up for its first kernel takes half a second."""
    box = np.array([[0.0, 0, 0, 4, 2, 1.5, 0, 0, 0]])
    observe(Sweep(0, 'map', np.zeros((1, 3), np.float32)), box, 0, config)
