"""
`boxreg simulate`: make a recording of a simulated scene, with noisy boxes and the truth.

Everything follows from the scenario and one seed. The fixed frame is ``odom``, that of the sensor
``lidar``. Points are compensated for the sensor's own motion. Moving objects are measured where
they are when each ray leaves; the times of the points hold that moment.

"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from boxreg_ros.errors import ConfigError
from boxreg_ros.io.transforms import boxes_to_frame, inverse
from boxreg_ros.simulation.breaks import break_tracks
from boxreg_ros.simulation.raycast import ROAD
from boxreg_ros.simulation.scenarios import SCENARIOS
from boxreg_ros.simulation.scene import FIXED_FRAME, SENSOR_FRAME, SimulatedScene
from boxreg_ros.simulation.writer import write_recording
from boxreg_ros.structures import Ints
import numpy as np

BREAK_STREAM = 1
"""Random stream of the breaks, so that they do not depend on the number of draws before."""


def simulate(scenario: str = 'street', seed: int = 0, sweeps: int | None = None) -> SimulatedScene:
    """
    Return a scene that depends on its arguments only: one sweep every 0.1 s.

    Parameters
    ----------
    scenario : str
        A name of `SCENARIOS`.
    seed : int
        Of the random numbers, 0 or more.
    sweeps : int, optional
        Number of sweeps; by default that of the scenario.

    Returns
    -------
    scene : SimulatedScene
        Sweeps, noisy boxes and the truth.

    Raises
    ------
    ConfigError
        If there is no such scenario, `sweeps` is below 1, or `seed` below 0.

    """
    if scenario not in SCENARIOS:
        raise ConfigError(f'scenario: expected one of {", ".join(SCENARIOS)}, got {scenario!r}')
    if sweeps is not None and sweeps < 1:
        raise ConfigError(f'sweeps: expected 1 or more, got {sweeps}')
    if seed < 0:
        raise ConfigError(f'seed: expected 0 or more, got {seed}')
    return SCENARIOS[scenario](np.random.default_rng(seed), sweeps)


def broken(scene: SimulatedScene, seed: int, ghosts: float = 0.0) -> SimulatedScene:
    """
    Return a scene with the detections of a tracker that loses objects; see `break_tracks`.

    Parameters
    ----------
    scene : SimulatedScene
        Of `simulate`.
    seed : int
        Of the random numbers, 0 or more.
    ghosts : float
        Mean number of boxes per sweep that belong to no object.

    Returns
    -------
    scene : SimulatedScene
        With other detections; the truth is the same.

    Raises
    ------
    ConfigError
        If `ghosts` is negative.

    """
    rng = np.random.default_rng([seed, BREAK_STREAM])
    origins = scene.T_fixed_sensor[:, :3, 3]
    arrays = break_tracks(scene.fixed_detections(), rng, ghosts, origins)
    pairs = zip(arrays, scene.T_fixed_sensor, strict=True)
    detections = tuple(boxes_to_frame(boxes, inverse(T), SENSOR_FRAME) for boxes, T in pairs)
    return replace(scene, detections=detections)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `boxreg simulate`."""
    parser.add_argument(
        '-o', '--output', type=Path, required=True, metavar='RECORDING.mcap',
        help='recording to write',
    )  # fmt: skip
    parser.add_argument(
        '--truth', type=Path, metavar='TRUTH.csv',
        help='file for the true boxes (default: beside the recording, as NAME_truth.csv)',
    )  # fmt: skip
    parser.add_argument(
        '--scenario', choices=list(SCENARIOS), default='street', help='default: street'
    )
    parser.add_argument(
        '--seed', type=int, default=0, metavar='N', help='seed of every random choice (default: 0)'
    )
    parser.add_argument(
        '--sweeps', type=int, metavar='N', help='number of sweeps (default: that of the scenario)'
    )
    parser.add_argument(
        '--break', action='store_true', dest='breaks',
        help='break the tracks: 8 %% of the boxes missing, gaps of 3 to 8 sweeps, new ids after '
        'half of them; the truth stays',
    )  # fmt: skip
    parser.add_argument(
        '--ghosts', type=float, default=0.0, metavar='N',
        help='with --break: mean number of boxes per sweep that belong to no object (default: 0)',
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Write a recording and its truth, and print a summary."""
    truth = args.truth or args.output.with_name(f'{args.output.stem}_truth.csv')
    if truth.resolve() == args.output.resolve():
        raise ConfigError(
            f'--truth {str(truth)!r}: expected a file beside the recording, got the recording '
            f'itself; choose another'
        )
    if args.ghosts and not args.breaks:
        raise ConfigError(f'--ghosts {args.ghosts:g}: expected with --break only; add --break')
    scene = simulate(args.scenario, args.seed, args.sweeps)
    if args.breaks:
        scene = broken(scene, args.seed, args.ghosts)
    write_recording(
        args.output,
        scene.sweeps,
        [_intensities(owner) for owner in scene.owners],
        scene.detections,
        scene.T_fixed_sensor,
        FIXED_FRAME,
        is_compressed=True,
    )
    scene.truth.write(truth)
    print(
        f'{args.output}: {len(scene.sweeps)} sweeps, '
        f'{sum(len(sweep.points) for sweep in scene.sweeps)} points, '
        f'{sum(len(boxes.track_ids) for boxes in scene.detections)} boxes of '
        f'{len(scene.actors)} objects; {len(scene.truth.boxes)} true boxes in {truth}'
    )
    return 0


def _intensities(owner: Ints) -> Ints:
    """Return an intensity per point: 10 for the road, another one for each object."""
    intensities: Ints = np.where(owner == ROAD, 10, 40 + 13 * owner % 60)
    return intensities
