"""
Check of the motion of the sensor by the objects: most of those that are parked move alike.

With transforms that stand still they move as the sensor does, the other way; with those of a
motion at another scale by the part of it that is missing, or too much; with those whose axes are
not the LiDAR's, across. With inverse ones, those of the world in the frame of the LiDAR, they
move with the sensor, about twice as fast.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from boxreg_ros.io.id_assignment import Tracker
from boxreg_ros.io.transform_edge import Edge
from boxreg_ros.structures import Floats
import numpy as np
from numpy.typing import NDArray

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
MOST_STANDING = 0.2
"""Objects that stand still as a part of those that move alike: one may drive as the error is."""
FEWEST_BESIDE = 2
"""Objects that move alike on each side of the sensor: traffic that it passes is on one."""
SCALES = (0.2, 0.8), (1.5, 4.0)
"""Ranges of a scale that is named: slower traffic on both sides would have a larger one."""
MIN_YAW_ERROR = 20.0
"""Smallest error of a yaw that is named [deg]."""

OTHER_MOTION = '--odometry TOPIC or --fixed-frame FRAME (node: fixed_frame:=FRAME)'
STILL = (
    'while {names} stands still, as parked objects do where the vehicle drives: if it drives, '
    f'boxes are as wrong as this motion: name another source of it, {OTHER_MOTION}, or mend its '
    'publisher'
)
INVERSE = (
    'as parked objects do by inverse poses, and hardly any stands still: if they are parked, '
    '{names} has the poses of the world in the frame of the LiDAR, and boxes are as wrong as this '
    'motion: invert each pose where they are written, or name another source of the motion, '
    f'{OTHER_MOTION}'
)
SCALED = (
    'on both sides, as parked objects do by a motion at {value:.2g} times its size, and hardly '
    'any stands still: if they are parked, {names} is not in metres, or of another scale, and '
    'boxes are as wrong as this motion: mend its publisher, or name another source of it, '
    f'{OTHER_MOTION}'
)
TURNED = (
    'on both sides, as parked objects do by poses with a yaw that is off by {value:.0f} degrees, '
    'and hardly any stands still: if they are parked, {names} has poses of other axes than those '
    'of the LiDAR, and boxes are as wrong as this motion: see whether the static transform from '
    'the vehicle to the LiDAR is missing or wrong, or name another source of the motion, '
    f'{OTHER_MOTION}'
)
NO_FAULT = '', 0.0


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
        self._fault = ''
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
        centers, velocities = tracker.known_motion(MIN_SPEED / 2)
        is_alike = _are_alike(velocities)
        fault, value = NO_FAULT
        if moving and is_alike.any():
            if all(edge.way(stamp_ns - STILL_NS) <= STILL_WAY for edge in moving):
                fault = STILL
            elif _standing(velocities) <= MOST_STANDING * is_alike.sum():
                poses = pose_of(stamp_ns - LOOK_PERIOD_NS), pose_of(stamp_ns)
                fault, value = _fault(centers[is_alike], velocities[is_alike], *poses)
        self._looks = self._looks + 1 if fault == self._fault else 1
        self._fault = fault
        if fault and self._looks == MIN_LOOKS:
            names = ', '.join(f'{edge.parent} -> {edge.child}' for edge in moving)
            speed = np.linalg.norm(np.median(velocities, axis=0))
            self.finding = (
                f'{is_alike.sum()} of {len(velocities)} objects move alike, at {speed:.1f} m/s, '
                f'{fault.format(names=names, value=value)}'
            )


def _standing(velocities: Floats) -> int:
    """Return how many of the velocities (K, 3) are those of objects that stand still."""
    return int((np.linalg.norm(velocities, axis=1) < MIN_SPEED / 2).sum())


def _are_alike(velocities: Floats) -> NDArray[np.bool_]:
    """Return which of the velocities (K, 3) are alike; none, if those are few or slow."""
    if len(velocities) < FEWEST_ALIKE:
        return np.zeros(len(velocities), bool)
    middle = np.median(velocities, axis=0)
    is_alike = np.linalg.norm(velocities - middle, axis=1) < MAX_DIFFERENCE
    is_fast = np.linalg.norm(middle) > MIN_SPEED
    is_common = is_fast and is_alike.sum() >= max(FEWEST_ALIKE, COMMON_SHARE * len(velocities))
    return np.asarray(is_alike & is_common)


def _fault(
    centers: Floats, velocities: Floats, before: Floats | None, now: Floats | None
) -> tuple[str, float]:
    """
    Return by which fault of the poses parked objects would have these velocities.

    Parameters
    ----------
    centers, velocities : array, shape (K, 3)
        Of the objects that move alike [m], [m/s].
    before, now : array, shape (4, 4), or None
        Poses of the sensor as they are stated, `LOOK_PERIOD_NS` apart; None where not known.

    Returns
    -------
    fault : str
        Its text; empty for none.
    value : float
        Of `SCALED` the stated motion over that by the objects, of `TURNED` the angle between both
        [deg]; else 0.

    Notes
    -----
    Let the sensor have the velocity v and the rotation R, as they are stated, and the objects the
    velocity c. If they are parked, the velocity of the sensor is v - c. By inverse poses it is
    -R v, at another scale it is along v, by other axes it is as fast as v. In a queue with the
    sensor it is 0, which differs from all of these by more than errors do, unless the sensor is
    slow.

    """
    if before is None or now is None:
        return NO_FAULT
    stated = (now[:3, 3] - before[:3, 3]) / (LOOK_PERIOD_NS * 1e-9)
    speed = np.linalg.norm(stated)
    common = np.median(velocities, axis=0)
    expected = stated + now[:3, :3] @ stated
    allowed = MAX_DIFFERENCE + MAX_RELATIVE_DIFFERENCE * np.linalg.norm(expected)
    if np.linalg.norm(common - expected) < allowed < speed / 2:
        return INVERSE, 0.0
    shown = stated - common
    (sx, sy), (tx, ty) = stated[:2], shown[:2]
    left = (centers - now[:3, 3]) @ (-ty, tx, 0.0)
    is_beside = min((left > 0).sum(), (left < 0).sum()) >= FEWEST_BESIDE
    shown_speed = np.hypot(tx, ty)
    if not is_beside or min(speed, shown_speed) < MIN_SPEED / 2:
        return NO_FAULT
    across = abs(sx * ty - sy * tx)
    along = sx * tx + sy * ty
    scale = float(speed / shown_speed)
    turn = float(np.degrees(np.arctan2(across, along)))
    is_along = across < MAX_DIFFERENCE * speed and along > 0
    if is_along and any(low <= scale <= high for low, high in SCALES):
        return SCALED, scale
    if turn >= MIN_YAW_ERROR and abs(speed - shown_speed) < MAX_DIFFERENCE:
        return TURNED, turn
    return NO_FAULT
