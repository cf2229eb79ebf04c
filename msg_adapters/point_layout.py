"""
Layouts of point clouds by LiDAR drivers, recognised by their fields, and the times of points.

A layout states field and unit of the times. Without a known layout both are derived from type and
magnitude.

"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import partial
from typing import Any, NamedTuple

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.structures import Floats
import numpy as np
from numpy.typing import NDArray

TIME_UNITS = {'s': 1.0, 'ms': 1e-3, 'us': 1e-6, 'ns': 1e-9}
"""Possible units of point times [s], coarsest first."""
AUTO = 'auto'
TIME_UNIT_CHOICES = (AUTO, *TIME_UNITS)
POINT_TIME_FIELDS = ('t', 'time', 'timestamp', 'offset_time', 'time_offset', 'time_stamp')
MAX_TIME_OFFSET = 1.0
"""Largest difference between the time of a point and the stamp [s]; one revolution is shorter."""
MIN_DURATION = 1e-3
"""A whole cloud takes longer [s]; chosen: a hundredth of a revolution at 10 Hz."""
MAX_DISTANCE = 0.05
"""
Largest distance of relative times of a whole cloud from the stamp, beside their duration [s].

Chosen: half a revolution at 10 Hz. Seconds of the day, or microseconds of the hour, lie elsewhere.

"""
WILD_SHARE = 0.02
"""Part of the points at each end of their times that may have wild ones; chosen."""
MIN_TIMES = 100
"""Clouds with fewer points have no wild times: derived, `WILD_SHARE` would be two of them."""
MAX_TIMES = 2000
"""Points whose times are sorted; chosen: it takes 0.1 ms."""
WHOLE_CLOUD = 5000
"""A cloud of as many points is not a small part of a revolution; chosen: 3 ms of 128 channels."""


class PointLayout(NamedTuple):
    """The layout of the clouds of a driver."""

    name: str
    """Of the sensor or the point type."""
    kinds: Mapping[str, str]
    """Fields that identify the layout, with the kind of their numbers; any if empty."""
    time_field: str = ''
    """Of the times; empty if there are none."""
    unit: str = ''


LAYOUTS = (
    PointLayout(
        'Autoware PointXYZIRCAEDT',
        {'return_type': 'u1', 'channel': 'u2', 'azimuth': 'f4', 'time_stamp': 'u4'},
        'time_stamp', 'ns',
    ),
    PointLayout(
        'Autoware PointXYZIRADT', {'return_type': 'u1', 'azimuth': 'f4', 'time_stamp': 'f8'},
        'time_stamp', 's',
    ),
    PointLayout('Autoware PointXYZIRC', {'return_type': 'u1', 'channel': 'u2'}),
    PointLayout('Ouster', {'t': 'u4', 'ring': '', 'reflectivity': ''}, 't', 'ns'),
    PointLayout('Livox PointCloud2', {'line': 'u1', 'timestamp': 'f8'}, 'timestamp', 'ns'),
    PointLayout(
        'Livox CustomMsg', {'reflectivity': 'u1', 'offset_time': 'u4'}, 'offset_time', 'ns'
    ),
    PointLayout('Hesai or RoboSense', {'ring': 'u2', 'timestamp': 'f8'}, 'timestamp', 's'),
    PointLayout('Velodyne', {'ring': 'u2', 'time': 'f4'}, 'time', 's'),
)  # fmt: skip
"""The first one that fits counts."""


class TimeReading(NamedTuple):
    """Unit of the times of points, and whether they are absolute or relative to the stamp."""

    unit: str
    is_absolute: bool


def layout_of(kinds: Mapping[str, str]) -> PointLayout | None:
    """Return the layout of a cloud with fields of these kinds (as in ``u4``); None if unknown."""
    return next((layout for layout in LAYOUTS if _fits(kinds, layout)), None)


def _fits(kinds: Mapping[str, str], layout: PointLayout) -> bool:
    return all(name in kinds and kind in ('', kinds[name]) for name, kind in layout.kinds.items())


def time_field_of(kinds: Mapping[str, str]) -> str:
    """Return the field with the times of the points; empty if there is none."""
    layout = layout_of(kinds)
    if layout is not None:
        return layout.time_field
    return next((name for name in POINT_TIME_FIELDS if name in kinds), '')


def reading_of(
    raw: NDArray[Any], stamp_ns: int, layout: PointLayout | None, unit: str
) -> TimeReading | None:
    """
    Return how the times of points are read.

    Parameters
    ----------
    raw : array, shape (M,)
        Times as the message has them, finite; M > 0.
    stamp_ns : int
        Stamp of the message [ns].
    layout : PointLayout or None
        That of the cloud; None if it is unknown.
    unit : str
        One of `TIME_UNIT_CHOICES`.

    Returns
    -------
    reading : TimeReading or None
        None if they are of no unit: in none of them do they lie within `MAX_TIME_OFFSET` of the
        stamp, or, in an unknown layout, they are not of a sweep about the stamp.

    Raises
    ------
    UnsupportedMessage
        If `unit` is `AUTO`, and the times of a known layout are in another unit than that of its
        driver.

    """
    ends = _usual_ends(raw)
    may_be_absolute = raw.dtype.kind == 'f' and raw.dtype.itemsize == 8
    fitting = partial(_fitting, ends, stamp_ns, may_be_absolute)
    if unit != AUTO:
        return fitting((unit,))
    # Integers are no seconds: a second has too few of them.
    possible = [name for name in TIME_UNITS if name != 's' or raw.dtype.kind == 'f']
    likely = fitting(possible)
    if layout is None and likely is not None and _is_elsewhere(len(raw), ends, likely):
        return None
    if layout is None or likely is None:
        return likely
    stated = fitting((layout.unit,))
    if stated is None or (stated.unit != likely.unit and _is_too_short(len(raw), ends, stated)):
        raise UnsupportedMessage(
            f'PointCloud2: field {layout.time_field!r} of {layout.name}: expected times in '
            f'{layout.unit}, got values from {ends[0]:g} to {ends[1]:g}, which are times of a '
            f'sweep in {likely.unit} only; correct the driver, or set the time unit: '
            f'--time-unit {likely.unit}, time_unit of the node'
        )
    return stated


def seconds_of(raw: NDArray[Any], stamp_ns: int, reading: TimeReading) -> Floats:
    """
    Return times relative to the stamp.

    Parameters
    ----------
    raw : array, shape (M,)
        Times as the message has them, finite; M > 0.
    stamp_ns : int
        Stamp of the message [ns].
    reading : TimeReading
        That of `reading_of`.

    Returns
    -------
    times : array, shape (M,)
        [s]; those of `wild_times` are 0.

    """
    times = _relative(raw, stamp_ns, reading)
    first, last = _bounds(times)
    low, high = _relative(np.array([raw.min(), raw.max()]), stamp_ns, reading)  # the ends of times
    if low < first or high > last:  # of few clouds
        times[wild_times(times)] = 0.0
    return times


def wild_count(raw: NDArray[Any], stamp_ns: int, reading: TimeReading) -> int:
    """Return how many times (M,) of a message are wild, see `wild_times`."""
    return int(wild_times(_relative(raw, stamp_ns, reading)).sum())


def _relative(raw: NDArray[Any], stamp_ns: int, reading: TimeReading) -> Floats:
    """Return times (M,) relative to the stamp [s], wild ones too."""
    scale = TIME_UNITS[reading.unit]
    if reading.is_absolute:
        return np.asarray((raw.astype(np.float64) - stamp_ns * 1e-9 / scale) * scale)
    return np.asarray(np.multiply(raw, scale, dtype=np.float64))


def wild_times(times: Floats) -> NDArray[np.bool_]:
    """
    Return which times (M,) [s] of points are none of their sweep, (M,).

    They lie further from the usual ones than these from each other: drivers leave some points
    without a time, or with one of another sweep.

    """
    first, last = _bounds(times)
    return np.asarray((times < first) | (times > last))


def _bounds(times: Floats) -> tuple[float, float]:
    """Return the first and the last time that are none of `wild_times` [s]."""
    low, high = _usual_ends(times)
    margin = max(high - low, MIN_DURATION)
    return low - margin, high + margin


def _usual_ends(values: NDArray[Any]) -> tuple[float, float]:
    """Return the ends of values (M,), M > 0, without up to `WILD_SHARE` of them at each end."""
    if len(values) < MIN_TIMES:
        return float(values.min()), float(values.max())
    some = np.sort(values[:: -(-len(values) // MAX_TIMES)])
    rank = int(WILD_SHARE * len(some))
    return float(some[rank]), float(some[-1 - rank])


def _fitting(
    ends: tuple[float, float], stamp_ns: int, may_be_absolute: bool, units: Collection[str]
) -> TimeReading | None:
    """Return the first of the units, coarsest first, in which all times are near the stamp."""
    low, high = ends
    for unit in units if may_be_absolute else ():
        scale = TIME_UNITS[unit]
        stamp = stamp_ns * 1e-9 / scale
        offset = max(abs(low - stamp), abs(high - stamp)) * scale
        # A stamp near 0 does not separate absolute from relative times.
        if stamp * scale > MAX_TIME_OFFSET and offset <= MAX_TIME_OFFSET:
            return TimeReading(unit, True)
    for unit in units:
        if max(abs(low), abs(high)) * TIME_UNITS[unit] <= MAX_TIME_OFFSET:
            return TimeReading(unit, False)
    return None


def _is_elsewhere(count: int, ends: tuple[float, float], reading: TimeReading) -> bool:
    """Return whether relative times of many points are not of a sweep about the stamp."""
    low, high = (end * TIME_UNITS[reading.unit] for end in ends)
    nearest = max(low, -high, 0.0)
    return count >= MIN_TIMES and not reading.is_absolute and nearest > high - low + MAX_DISTANCE


def _is_too_short(count: int, ends: tuple[float, float], reading: TimeReading) -> bool:
    """Return whether a whole cloud would take less than `MIN_DURATION`."""
    duration = (ends[1] - ends[0]) * TIME_UNITS[reading.unit]
    return count >= WHOLE_CLOUD and duration < MIN_DURATION
