"""Smoothed angles, at which labelling margins are estimated."""

from boxreg_ros.core.batch import Problem
from boxreg_ros.core.input_noise import MAD_TO_DEVIATION, MIN_POWER
from boxreg_ros.structures import ROLL
import torch
from torch import Tensor


def smoothed_angles(problem: Problem) -> Tensor:
    """
    Return roll, pitch and yaw of the start of the search, smoothed over time, (B, N, 3) [rad].

    They are smoothed by the motion model alone: noise, estimated from second differences, against
    the angular accelerations of the class. Labelling margins are estimated at these angles: the
    outermost points of a box with a wrong yaw are its corners, further outside than its faces.

    """
    angles = problem.start[..., ROLL:]
    B, N = problem.valid.shape
    if N < 3:  # no second difference
        return angles
    step = problem.times.diff(dim=1)
    mean_step = (step[:, 1:] + step[:, :-1]) / 2
    # Rows of the second derivative by time, (B, N - 2, N), without padding.
    before = 1 / (step[:, :-1] * mean_step)
    after = 1 / (step[:, 1:] * mean_step)
    rows = torch.stack([before, -before - after, after], 2) * problem.valid[:, 2:, None]
    derivative = angles.new_zeros((B, N - 2, N))
    for k in range(3):
        derivative.diagonal(k, 1, 2).copy_(rows[..., k])
    acceleration = derivative @ angles  # (B, N - 2, 3)
    noise_gain = derivative.square().sum(2, keepdim=True).sqrt().clamp(min=MIN_POWER)
    white = torch.where(problem.valid[:, 2:, None], acceleration.abs() / noise_gain, torch.nan)
    noise = MAD_TO_DEVIATION * white.nanmedian(1).values.nan_to_num()  # (B, 3)
    stiffness = (noise / problem.of_class('tilting', 'tilting', 'turning')) ** 2
    roughness = (derivative.mT @ derivative)[:, None] * stiffness[..., None, None]
    system = torch.eye(N).to(angles) + roughness  # (B, 3, N, N)
    smoothed, _ = torch.linalg.solve_ex(system, angles.mT[..., None])
    smoothed = smoothed[..., 0].mT
    # Noise of many radians makes the system singular to working precision.
    return torch.where(smoothed.isfinite(), smoothed, angles)
