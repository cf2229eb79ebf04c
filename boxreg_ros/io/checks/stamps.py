"""Check of the stamps of clouds: those of a LiDAR are regular, but for clouds that are lost."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from boxreg_ros.structures import Floats, Sweep
import numpy as np
from numpy.typing import ArrayLike

COMPARED_CLOUDS = 100
"""Newest clouds that are compared; chosen: 10 s at 10 Hz."""
LOOK_CLOUDS = 50
"""Clouds between two looks; chosen: a look takes 10 ms."""
MIN_STAMP_JITTER = 0.008
"""
Standard deviation of stamps that is reported [s].

Chosen: boxes lose .005 of 3D IoU by it, and .02 by 0.02; stamps of recordings have 0 to 0.0035.

"""
FREQUENCIES = 0.7, 6.0
"""Least and largest frequency, by that of most clouds; chosen: 20 Hz, throttled to 4 Hz."""
FREQUENCY_STEP = 0.2
"""Step between frequencies, by one period of all clouds; derived: phases err by 0.05 periods."""
MIN_RESULTANT = 0.35
"""Of a period; derived (Rayleigh): 100 random stamps have it at one in 2e5 frequencies."""
INDEPENDENT = 0.6
"""Von Neumann's ratio less 2 of independent errors, at most; derived: 3 deviations of 100."""
MAX_SPREAD_OF_CLOUDS = 3.0
"""Periods of all clouds by their number, at most; chosen: two of three are lost."""
LIDAR_PERIOD = 0.25
"""Rarer clouds may be chosen ones, such as key frames [s]; slow LiDARs have 5 Hz."""


class Regularity(NamedTuple):
    """How far stamps are off from multiples of a period."""

    period: float  # [s]
    deviation: float  # standard deviation of independent errors [s]; 0 if they are not such


def regularity(stamps_ns: ArrayLike) -> Regularity:
    """
    Return the period of stamps, and their deviation from it.

    Parameters
    ----------
    stamps_ns : array_like
        In any order [ns]; some may be missing.

    Returns
    -------
    Regularity
        Of the period by which the phases of the stamps agree most: the circular standard
        deviation of these (Mardia & Jupp, *Directional Statistics*). It is 0 where no period is
        clear, or errors follow from those before, as of a sensor that is triggered.

    """
    stamps = np.unique(stamps_ns)
    if len(stamps) < LOOK_CLOUDS:
        return Regularity(0.0, 0.0)
    seconds = (stamps - stamps[0]) * 1e-9
    usual = float(np.median(np.diff(seconds)))
    if usual > LIDAR_PERIOD or seconds[-1] > MAX_SPREAD_OF_CLOUDS * len(stamps) * usual:
        return Regularity(usual, 0.0)
    low, high = FREQUENCIES
    frequencies = np.arange(low / usual, high / usual, FREQUENCY_STEP / seconds[-1])
    turns = np.exp(2j * np.pi * np.outer(frequencies, seconds))
    resultants = np.abs(turns.mean(axis=1))
    best = int(resultants.argmax())
    period = 1 / float(frequencies[best])
    phases = np.angle(turns[best] / turns[best].mean())
    ratio = np.mean(np.diff(phases) ** 2) / max(float(np.var(phases)), 1e-12)  # von Neumann's
    resultant = min(float(resultants[best]), 1.0)
    if resultant < MIN_RESULTANT or abs(ratio - 2) > INDEPENDENT:
        return Regularity(period, 0.0)
    return Regularity(period, period * float(np.sqrt(-2 * np.log(resultant))) / (2 * np.pi))


class StampCheck:
    """
    Find out whether a driver stamps the clouds of a topic when it receives them.

    Their stamps are then off from a regular period, each by itself, at most looks. `finding` says
    so; it is empty otherwise.

    """

    def __init__(self) -> None:
        # Stamp [ns] of each of the newest clouds, and position (3,) of the sensor [m].
        self._clouds = deque[tuple[int, Floats]](maxlen=COMPARED_CLOUDS)
        self._count = 0
        self._looks = 0
        self._found = 0  # of them, at which stamps were off
        self._text = ''

    @property
    def finding(self) -> str:
        """Return what was found so far."""
        return self._text if 2 * self._found > self._looks else ''

    def add(self, cloud: Sweep, position: Floats) -> None:
        """Add a cloud, and where its frame was at its stamp (3,) [m]."""
        self._clouds.append((cloud.stamp_ns, position))
        self._count += 1
        if self._count < COMPARED_CLOUDS or self._count % LOOK_CLOUDS:
            return
        stamps_ns, positions = zip(*self._clouds, strict=True)
        period, deviation = regularity(stamps_ns)
        self._looks += 1
        if deviation < MIN_STAMP_JITTER:
            return
        self._found += 1
        if not self._text:
            way = float(np.linalg.norm(positions[-1] - positions[0]))
            self._text = _text(cloud.topic, period, deviation, way / (np.ptp(stamps_ns) * 1e-9))


def _text(topic: str, period: float, deviation: float, speed: float) -> str:
    """Return that stamps of clouds are off from their period [s], at a speed of the sensor."""
    return (
        f'stamps of clouds{f" of {topic}" if topic else ""}: expected one every {period:.3f} s, '
        f'got ones that are off by {deviation:.3f} s, back and forth, as of a driver that stamps '
        f'clouds when it receives them: each is placed by the pose of another moment, '
        f'{speed * deviation:.2f} m off at {speed:.0f} m/s, and objects that move are off by '
        f'their way; let the driver stamp clouds by the time of the sensor (PTP, GPS or its clock)'
    )
