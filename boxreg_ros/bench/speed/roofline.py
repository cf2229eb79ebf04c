"""Share of the limit of the machine that the stages of a round reach: a roofline."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from boxreg_ros.bench.speed.streams import make_windows, shortest
from boxreg_ros.config import Config
from boxreg_ros.core.arrowhead import LINK
from boxreg_ros.core.batch import free_variables, SHARED, State
from boxreg_ros.core.expectation import expect, InputEstimates
from boxreg_ros.core.face_support import observe_faces
from boxreg_ros.core.geometry import FACE_AXIS
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.core.rounds import Round, run_round, SolverPlan
from boxreg_ros.core.solver import start
from boxreg_ros.core.window import stack_windows
import numpy as np
import torch

FLOPS_PER_POINT = 27
"""Derived: 15 to turn a point into box axes, 12 to compare it with the outermost of six faces."""
REST = 2 * LINK + SHARED
"""Variables that a pose is coupled to: the two poses after it and the shared variables."""
FLOPS_PER_POSE = 2 * LINK * (2 * LINK * REST + SHARED**2 + REST**2)
"""Derived: to eliminate a pose from the next two, from the block of the shared variables, and to
multiply its coupling with the known part of the inverse."""
COPY_BYTES = 256 << 20
"""Size of the array whose copy measures the memory bandwidth. Chosen: larger than all caches."""
MATRIX_SIZE = 1024
"""Rows of the matrices whose product measures the peak of arithmetic. Chosen."""


def roofline(config: Config, count: int) -> dict[str, Any]:
    """
    Return bandwidth [GB/s] and peak [Gflop/s] of one core, and the share of each stage of them.

    The stages are the search for face observations and a whole round, which includes it, as they
    run: by the kernels where there are some, without the terms of single residuals.
    The least bytes that a stage touches and the least operations that it does are computed by
    formula. The limit is the larger of the times of both, ``share`` is the limit over the time.

    """
    source = np.ones(COPY_BYTES // 8)
    target = np.empty_like(source)
    copying = shortest(lambda: np.copyto(target, source), config)
    matrix = torch.ones(MATRIX_SIZE, MATRIX_SIZE, dtype=torch.float64)
    multiplying = shortest(lambda: matrix @ matrix, config)
    bandwidth = 2 * COPY_BYTES / copying
    peak = 2 * MATRIX_SIZE**3 / multiplying
    stages = {}
    for name, (run, size, flops) in _stages(config, count).items():
        seconds = shortest(run, config)
        limit = max(size / bandwidth, flops / peak)
        stages[name] = {
            'ms': 1e3 * seconds,
            'MB': 1e-6 * size,
            'Mflop': 1e-6 * flops,
            'share': limit / seconds,
        }
    return {'bandwidth': 1e-9 * bandwidth, 'peak': 1e-9 * peak, 'stages': stages}


def _stages(config: Config, count: int) -> dict[str, tuple[Callable[[], object], float, float]]:
    """Return function, bytes and operations of each stage of one round of `count` windows."""
    windows, _ = make_windows(count, config.window, 128, config)
    problem, _ = stack_windows(windows, config)
    inputs = InputEstimates(InputModel(config.faces).offsets())
    state = State(problem.pose, expect(problem, inputs).shared)
    free = free_variables(problem, config)
    plan = SolverPlan.choose(config, is_warm=True)
    solution = start(problem, free, inputs.offsets, plan)
    batch = Round(problem, solution, inputs, free)
    rows = torch.arange(count, device=free.device)
    points = problem.returns.points
    size_of_points = float(points.numel() * points.element_size())
    flops_of_points = float(len(points) * FLOPS_PER_POINT)
    poses = float(count * config.window)
    # Written: the covariance of each pose and the residuals of its six faces, in float64.
    size_of_posterior = 8.0 * poses * (LINK * LINK + len(FACE_AXIS))
    return {
        'face observations': (
            lambda: observe_faces(problem, state, inputs.offsets, config),
            size_of_points,
            flops_of_points,
        ),
        'round': (
            lambda: run_round(batch, plan, 0, config, rows),
            size_of_points + size_of_posterior,
            flops_of_points + poses * FLOPS_PER_POSE,
        ),
    }


def draw(found: dict[str, Any], path: Path) -> Path:
    """Draw the roofline with its stages and return the path of the picture."""
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot

    figure, panel = pyplot.subplots(figsize=(6, 4), layout='constrained')
    intensity = np.logspace(-2, 2, 100)  # [flop/byte]
    panel.loglog(intensity, np.minimum(found['peak'], found['bandwidth'] * intensity), 'k-')
    for name, stage in found['stages'].items():
        x = stage['Mflop'] / stage['MB']
        panel.plot(x, stage['Mflop'] / stage['ms'], 'o', label=f'{name}: {stage["share"]:.0%}')
    panel.set_xlabel('flop per byte')
    panel.set_ylabel('Gflop/s of one core')
    panel.grid(which='both', alpha=0.3)
    panel.legend()
    figure.savefig(path, dpi=120)
    return path
