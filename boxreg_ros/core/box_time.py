"""
The time that input boxes are of: the stamp, or when the sweep saw the object.

While a sweep takes place, a vehicle at 30 m/s moves by 3 m. Boxes of one convention are at its
points, those of the other are ahead of or behind them. docs/method-tracks.md.

"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.observation import crop, FACE_TOLERANCE, NEARBY, Observation
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import Floats, LENGTH, ROLL, Sweep, X, Z
import numpy as np
from numpy.typing import NDArray

# All of these are chosen.
MIN_DIFFERENCE = 0.02
"""Least difference of the mean distance of the points from a face that is evidence [m]."""
MIN_VOTES = 10
"""Fewest points of a box that votes, and fewest votes; without, boxes are at the time of sight."""
MIN_MAJORITY = 0.6
"""Least part of these boxes that decides."""


def motion_to_sight(sweep: Sweep, boxes: Floats, velocities: Floats) -> Floats:
    """
    Return how far each object moves from the stamp until the sweep sees it.

    Parameters
    ----------
    sweep : Sweep
        In the fixed frame.
    boxes : array, shape (n, 9)
        Valid boxes in the fixed frame, at its stamp [m, rad].
    velocities : array, shape (n, 3)
        Of their centres [m/s].

    Returns
    -------
    motion : array, shape (n, 3)
        By the median time of the points near each box [m]. Zero without times of the points,
        without points near it, and for an object that moves by `FACE_TOLERANCE` or less within the
        sweep.

    """
    motion = np.zeros((len(boxes), 3))
    if sweep.times is None or not len(sweep.times):
        return motion
    latest = max(sweep.times.max(), -sweep.times.min())  # not abs: no copy of a million bytes
    most = latest * np.linalg.norm(velocities, axis=1)
    moving = np.flatnonzero(most > FACE_TOLERANCE)
    if not len(moving):
        return motion
    near = crop(sweep, boxes[moving], NEARBY)
    is_near = near.outside.max(0) < NEARBY
    rows, owner = near.row[is_near], near.owner[is_near]
    for i, box in enumerate(moving):
        times = sweep.times[rows[owner == i]]
        if len(times):
            motion[box] = velocities[box] * np.median(times)
    return motion


def swept(boxes: Floats, motion: Floats) -> Floats:
    """Return boxes (n, 9) that hold each object both at the stamp and after its `motion`."""
    whole = boxes.copy()
    whole[:, X : Z + 1] += motion / 2
    whole[:, LENGTH] += np.linalg.norm(motion, axis=1)
    return whole


class BoxTimeEvidence:
    """Votes of fast objects for the time that the input boxes are of."""

    def __init__(self) -> None:
        self.votes = Counter[str]()

    def add(self, seen: Sequence[Observation], velocities: Floats) -> None:
        """
        Compare boxes with their points, moved to the time of sight and to the stamp.

        The points are on the surface of the object: near the faces of a box of their own time.
        Each is moved by its own delay, since two LiDARs may see an object at different times.

        Parameters
        ----------
        seen : sequence of n Observation
            All of one table.
        velocities : array, shape (n, 3)
            Of their objects, in the fixed frame [m/s]. Slow ones give no vote.

        """
        if not (seen and velocities.any()):
            return
        rows = [observation.row for observation in seen]
        motions = velocities * seen[0].table.sights[rows, None]  # from the stamp [m]
        for i in np.flatnonzero(np.linalg.norm(motions, axis=1) >= FACE_TOLERANCE).tolist():
            self._vote(seen[i], velocities[i], motions[i])

    def _vote(self, seen: Observation, velocity: Floats, motion: Floats) -> None:
        if len(seen.points) < MIN_VOTES:
            return
        points = seen.points - np.outer(seen.delays, velocity)  # at the stamp
        at_stamp = _distance_from_faces(seen.box, points)
        at_sight = _distance_from_faces(seen.box, points + motion)
        if abs(at_sight - at_stamp) > MIN_DIFFERENCE:
            self.votes['sight' if at_sight < at_stamp else 'stamp'] += 1

    def decided(self) -> str:
        """Return ``stamp`` or ``sight``; ``unknown`` without enough evidence."""
        total = self.votes.total()
        if total < MIN_VOTES:
            return 'unknown'
        name, count = self.votes.most_common(1)[0]
        return name if count >= MIN_MAJORITY * total else 'unknown'

    def summary(self, config: Config) -> dict[str, Any]:
        """Return the setting, what the votes decide, and the number of votes for each time."""
        setting = config.sampling.box_time
        votes = {name: self.votes[name] for name in ('stamp', 'sight')}
        return {'setting': setting, 'estimated': self.decided(), 'votes': votes}

    def resolved(self, config: Config) -> Config:
        """Return `config` with `sampling.box_time` as the votes decide, if it is ``auto``."""
        if config.sampling.box_time != 'auto':
            return config
        return _with_box_time(config, 'stamp' if self.decided() == 'stamp' else 'sight')


@lru_cache(maxsize=2)
def _with_box_time(config: Config, box_time: str) -> Config:
    """Return `config` with a box time; kept, since checking all settings takes 1 ms."""
    return replace(config, sampling=replace(config.sampling, box_time=box_time))


def _distance_from_faces(box: Floats, points: NDArray[np.floating]) -> float:
    """Return the mean distance of points (M, 3) from the nearest face of a box [m]."""
    local = np.abs(points @ matrix_from_rpy(box[ROLL:]))
    outside = (local - box[LENGTH:ROLL] / 2).max(1)
    return float(np.abs(outside).clip(max=CONSTANTS.outside_margin).mean())
