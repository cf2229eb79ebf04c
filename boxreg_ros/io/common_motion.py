"""Check of a transform that stands still: objects that all move alike move with the sensor."""

from __future__ import annotations

from collections.abc import Sequence

from boxreg_ros.io.id_assignment import Tracker
from boxreg_ros.io.transforms import Edge
from boxreg_ros.structures import Floats
import numpy as np

# All of these are chosen.
LOOK_PERIOD_NS = 5 * 10**8
"""Time between two looks at the velocities of the objects [ns]."""
MIN_LOOKS = 4
"""Looks in a row that a finding needs, 2 s: cars that start at a light differ by more."""
STILL_NS = 10**9
"""Time in which a frame that moves has moved [ns]."""
STILL_WAY = 0.01
"""Way of a frame that moves [m]: odometry of a wheel that stands still has none."""
MIN_SPEED = 2.0
"""Slower objects may be parked [m/s]: the velocity of a track errs by half of it."""
MAX_DIFFERENCE = 1.0
"""Largest difference of velocities that are alike [m/s]: their errors."""
FEWEST_ALIKE = 4
"""Objects that move alike."""
COMMON_SHARE = 0.5
"""Part of all objects that move alike: of the traffic past a sensor at the roadside it is less."""


class CommonMotionCheck:
    """
    Find that most objects move alike while the frame of the clouds stands still.

    What stands still then moves as the sensor does, the other way: the transforms lack its motion.
    `finding` says so; it is empty before.

    """

    def __init__(self) -> None:
        self.finding = ''
        self.forget()

    def forget(self) -> None:
        """Forget the looks so far: time has gone back, or objects are new."""
        self._looks = 0
        self._looked_ns: int | None = None

    def add(self, stamp_ns: int, tracker: Tracker, route: Sequence[Edge]) -> None:
        """
        Look at the objects of a stamp.

        Parameters
        ----------
        stamp_ns : int
            Of the newest boxes [ns].
        tracker : Tracker
            The objects up to then.
        route : sequence of Edge
            The transforms from the frame of the clouds to the fixed one.

        """
        if self.finding or (
            self._looked_ns is not None and stamp_ns < self._looked_ns + LOOK_PERIOD_NS
        ):
            return
        self._looked_ns = stamp_ns
        moving = [edge for edge in route if not edge.is_static]
        if not moving or any(_way(edge, stamp_ns - STILL_NS) > STILL_WAY for edge in moving):
            self._looks = 0
            return
        velocities = tracker.known_velocities(MIN_SPEED / 2)
        alike, speed = _alike(velocities)
        self._looks = self._looks + 1 if alike else 0
        if self._looks == MIN_LOOKS:
            names = ', '.join(f'{edge.parent} -> {edge.child}' for edge in moving)
            self.finding = (
                f'{alike} of {len(velocities)} objects move alike, at {speed:.1f} m/s, while '
                f'{names} stands still: expected the motion of the LiDAR in it, got that of '
                f'objects that are parked; boxes are as wrong as this motion: name another source '
                f'of it, --odometry TOPIC or --fixed-frame FRAME (node: fixed_frame:=FRAME), or '
                f'mend its publisher'
            )


def _way(edge: Edge, since_ns: int) -> float:
    """Return the way that the child of a pair has moved in its parent since a stamp [m]."""
    recent = [
        pose[:3] for stamp, pose in zip(edge.stamps, edge.poses, strict=True) if stamp >= since_ns
    ]
    recent = recent or [pose[:3] for pose in edge.poses[-1:]]
    return float(np.linalg.norm(np.ptp(recent, axis=0)))


def _alike(velocities: Floats) -> tuple[int, float]:
    """Return how many of the velocities (K, 3) are alike and their speed [m/s]; 0 if few are."""
    if len(velocities) < FEWEST_ALIKE:
        return 0, 0.0
    middle = np.median(velocities, axis=0)
    count = int((np.linalg.norm(velocities - middle, axis=1) < MAX_DIFFERENCE).sum())
    speed = float(np.linalg.norm(middle))
    is_common = speed > MIN_SPEED and count >= max(FEWEST_ALIKE, COMMON_SHARE * len(velocities))
    return (count, speed) if is_common else (0, speed)
