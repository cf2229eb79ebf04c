"""
Check of the motion of the sensor by the objects: most of those that are parked move alike.

With transforms that stand still they move as the sensor does, the other way. With inverse ones,
those of the world in the frame of the LiDAR, they move with the sensor, about twice as fast.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence

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
MAX_RELATIVE_DIFFERENCE = 0.1
"""The same as a part of the velocity that inverse transforms give."""
COMMON_SHARE = 0.5
"""Part of all objects that move alike: of the traffic past a sensor at the roadside it is less."""

STILL = (
    'while {} stands still, as parked objects do where the vehicle drives: if it drives, boxes '
    'are as wrong as this motion: name another source of it, --odometry TOPIC or --fixed-frame '
    'FRAME (node: fixed_frame:=FRAME), or mend its publisher'
)
INVERSE = (
    'as parked objects do by inverse poses, and none stands still: if they are parked, {} has the '
    'poses of the world in the frame of the LiDAR, and boxes are as wrong as this motion: invert '
    'each pose where they are written, or name another source of the motion, --odometry TOPIC or '
    '--fixed-frame FRAME (node: fixed_frame:=FRAME)'
)


class CommonMotionCheck:
    """
    Find that most objects move alike, as parked ones do where the transforms are wrong.

    `finding` says so; it is empty before.

    """

    def __init__(self) -> None:
        self.finding = ''
        self.forget()

    def forget(self) -> None:
        """Forget the looks so far: time has gone back, or objects are new."""
        self._looks = 0
        self._was_still = False
        self._looked_ns: int | None = None

    def add(
        self,
        stamp_ns: int,
        tracker: Tracker,
        route: Sequence[Edge],
        pose_of: Callable[[int], Floats | None],
    ) -> None:
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
        pose_of : callable
            Returns the pose (4, 4) of the one in the other at a stamp; None where it is not known.

        """
        if self.finding or (
            self._looked_ns is not None and stamp_ns < self._looked_ns + LOOK_PERIOD_NS
        ):
            return
        self._looked_ns = stamp_ns
        moving = [edge for edge in route if not edge.is_static]
        is_still = all(edge.way(stamp_ns - STILL_NS) <= STILL_WAY for edge in moving)
        velocities = tracker.known_velocities(MIN_SPEED / 2)
        alike, common = _alike(velocities)
        stand = bool((np.linalg.norm(velocities, axis=1) < MIN_SPEED / 2).any())
        is_inverse = alike and not stand and _is_inverse(common, stamp_ns, pose_of)
        if not moving or not ((is_still and alike) or is_inverse):
            self._looks = 0
            return
        self._looks = self._looks + 1 if is_still == self._was_still else 1
        self._was_still = is_still
        if self._looks == MIN_LOOKS:
            names = ', '.join(f'{edge.parent} -> {edge.child}' for edge in moving)
            self.finding = (
                f'{alike} of {len(velocities)} objects move alike, at '
                f'{np.linalg.norm(common):.1f} m/s, '
                f'{(STILL if is_still else INVERSE).format(names)}'
            )


def _is_inverse(common: Floats, stamp_ns: int, pose_of: Callable[[int], Floats | None]) -> bool:
    """
    Return whether parked objects would have a velocity (3,) [m/s] by the inverse of the poses.

    Of a sensor with the velocity v and the rotation R as they are stated, that is v + R v. In a
    queue with the sensor it is v, which differs by more than errors do unless the sensor is slow.

    """
    before, now = pose_of(stamp_ns - LOOK_PERIOD_NS), pose_of(stamp_ns)
    if before is None or now is None:
        return False
    velocity = (now[:3, 3] - before[:3, 3]) / (LOOK_PERIOD_NS * 1e-9)
    expected = velocity + now[:3, :3] @ velocity
    allowed = MAX_DIFFERENCE + MAX_RELATIVE_DIFFERENCE * np.linalg.norm(expected)
    return bool(np.linalg.norm(common - expected) < allowed < np.linalg.norm(velocity) / 2)


def _alike(velocities: Floats) -> tuple[int, Floats]:
    """Return how many of the velocities (K, 3) are alike, 0 if few are, and that of these."""
    if len(velocities) < FEWEST_ALIKE:
        return 0, np.zeros(3)
    middle = np.median(velocities, axis=0)
    count = int((np.linalg.norm(velocities - middle, axis=1) < MAX_DIFFERENCE).sum())
    is_fast = np.linalg.norm(middle) > MIN_SPEED
    is_common = is_fast and count >= max(FEWEST_ALIKE, COMMON_SHARE * len(velocities))
    return (count if is_common else 0), middle
