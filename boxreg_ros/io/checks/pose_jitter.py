"""Independent errors of the pose of a sensor, from cloud to cloud."""

from collections import deque
from statistics import fmean, median

from boxreg_ros.io.transform_edge import MAX_LINEAR_GAP
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import Floats
import numpy as np

YAW_JITTER_SCALE = 2.33
"""Standard deviation of yaw over the mean of `PoseJitter`; derived by simulation."""
MIDDLE_STEPS = 0.9
"""Part of the steps of yaw, the smallest ones, in this mean; chosen: the others may be jumps."""
JITTER_CLOUDS = 50
"""Newest clouds by which it is measured, and the most that are needed; chosen: 5 s."""
MIN_JITTER_CLOUDS = 30
"""Clouds by which it is reported; chosen."""


class PoseJitter:
    """
    Standard deviation of independent errors of the horizontal position of a sensor, per axis [m].

    Or of its yaw [rad]. With independent errors a position is off the line through those before
    and after it, and the next one is off to the other side. The smaller one of both distances has
    the standard deviation as its median; motions of vehicles go on to one side. That of a yaw,
    which goes on to the same side more often, is taken by its mean, whose variance is smaller.

    """

    def __init__(self, of_yaw: bool = False) -> None:
        self._of_yaw = of_yaw
        self._poses = deque[tuple[int, Floats]](maxlen=3)
        self._away: Floats | None = None
        self._steps = deque[float](maxlen=JITTER_CLOUDS)

    @property
    def deviation(self) -> float:
        """Return the standard deviation; 0 while it is not known."""
        count = len(self._steps)
        if count < MIN_JITTER_CLOUDS:
            return 0.0
        if not self._of_yaw:
            return median(self._steps)
        return YAW_JITTER_SCALE * fmean(sorted(self._steps)[: round(MIDDLE_STEPS * count)])

    def add(self, stamp_ns: int, position: Floats) -> None:
        """Add the next position (2,), or yaw (1,), at a stamp."""
        if self._poses and not 0 < stamp_ns - self._poses[-1][0] <= MAX_LINEAR_GAP * 1e9:
            self._poses.clear()
            self._away = None
        if self._of_yaw and self._poses:
            last = self._poses[-1][1]
            position = last + wrap_angle(position - last)
        self._poses.append((stamp_ns, position))
        if len(self._poses) < 3:
            return
        (first_ns, first), (middle_ns, middle), (last_ns, last) = self._poses
        part = (middle_ns - first_ns) / (last_ns - first_ns)
        before, self._away = self._away, middle - first - part * (last - first)
        if before is not None:
            goes_back = self._away @ before < 0
            smaller = min(np.linalg.norm(before), np.linalg.norm(self._away))
            self._steps.append(float(goes_back * smaller))
