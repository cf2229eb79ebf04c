"""``sensor_msgs/PointCloud2`` of any layout to a `Sweep`, without a copy of the raw bytes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.structures import Floats, Sweep
from msg_adapters.poses import stamp_ns
import numpy as np
from numpy.typing import NDArray

NUMBERS = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
"""``PointField.datatype`` as numpy spells it."""
TIME_FIELDS = ('t', 'time', 'timestamp', 'offset_time')
UNITS = (1.0, 1e-3, 1e-6, 1e-9)
INTENSITY_FIELDS = ('intensity', 'i', 'reflectivity')
LONGEST_SWEEP = 1.0
"""No point is measured farther than this from its stamp [s]."""


def from_msg(msg: Any) -> Sweep:
    """
    Return the finite points of a PointCloud2, in its frame, with their times.

    Points are float32, or float64 where the message needs it to be exact (float64 and 32-bit
    integer coordinates).

    Raises
    ------
    UnsupportedMessage
        If there are no fields x, y, z, or the sizes in the message contradict each other.

    Notes
    -----
    Times are read from the first of the fields ``t``, ``time``, ``timestamp``, ``offset_time``.
    Makers agree neither on unit nor on origin, so both are told by type and magnitude: absolute
    where a float64 field lies within a second of the stamp in s, ms, us or ns (Hesai,
    RoboSense, Livox); else relative to the stamp, in the coarsest of these units that keeps
    all points within a second of it, seconds being for floats only (Velodyne: s, Ouster: ns).
    Times that fit nothing are left out: ``times`` is None. A point whose own time is not finite
    is taken for measured at the stamp.

    """
    stamp = stamp_ns(msg.header)
    if not msg.width * msg.height:
        return Sweep(stamp, msg.header.frame_id, np.zeros((0, 3), np.float32))
    fields = {field.name: field for field in msg.fields}
    missing = [name for name in 'xyz' if name not in fields]
    if missing:
        raise UnsupportedMessage(
            f'PointCloud2: expected fields x, y, z, got {", ".join(fields) or "none"}; '
            f'publish Cartesian coordinates'
        )
    time_field = _first(TIME_FIELDS, fields)
    table = _table(msg, [fields[name] for name in (*'xyz', time_field) if name])

    wanted = np.result_type(np.float32, *(table.dtype[name] for name in 'xyz'))
    columns = np.empty((3, table.size), wanted.newbyteorder('='))  # what follows goes by columns
    for column, name in zip(columns, 'xyz', strict=True):
        column[:] = table[name].reshape(-1)
    good = np.isfinite(columns).all(0)
    times = None
    if time_field is not None:
        raw = table[time_field].ravel()  # a copy without gaps: it is gone through several times
        times = _seconds(raw if good.all() else raw[good], stamp)
    if not good.all():
        columns = columns[:, good]
    return Sweep(stamp, msg.header.frame_id, columns.T, times)


def intensities(msg: Any) -> Floats | None:
    """
    Return what a message says of how bright its points are, in the units of its maker.

    Returns
    -------
    intensities : array, shape (M,), or None
        One for each point of `from_msg`; None if there is none of the fields ``intensity``,
        ``i``, ``reflectivity``. What is not finite is 0.

    """
    fields = {field.name: field for field in msg.fields}
    name = _first(INTENSITY_FIELDS, fields)
    if name is None or not msg.width * msg.height:
        return None
    table = _table(msg, [fields[n] for n in (*'xyz', name)])
    good = np.logical_and.reduce([np.isfinite(table[n].reshape(-1)) for n in 'xyz'])
    return np.nan_to_num(table[name].reshape(-1)[good].astype(np.float64), posinf=0, neginf=0)


def _first(names: Sequence[str], fields: Mapping[str, Any]) -> str | None:
    return next((name for name in names if name in fields), None)


def _table(msg: Any, fields: list[Any]) -> NDArray[Any]:
    """Return a structured view (height, width) of the message's bytes with these fields only."""
    data = np.frombuffer(msg.data, np.uint8)
    used = msg.width * msg.point_step
    row_step = msg.row_step if msg.height > 1 else used
    needed = (msg.height - 1) * row_step + used
    if row_step < used or len(data) < needed:
        raise UnsupportedMessage(
            f'PointCloud2: {msg.height} x {msg.width} points of {msg.point_step} bytes in rows of '
            f'{row_step}: expected at least {max(needed, msg.height * used)} bytes, got '
            f'{len(data)}; the publisher fills in width, height, point_step or row_step wrongly'
        )
    order = '>' if msg.is_bigendian else '<'
    for field in fields:
        kind = NUMBERS.get(field.datatype)
        if kind is None or field.count > 1:
            raise UnsupportedMessage(
                f'PointCloud2: field {field.name!r}: expected one number of datatype 1 to 8, got '
                f'{field.count} of datatype {field.datatype}'
            )
        end = field.offset + np.dtype(kind).itemsize
        if end > msg.point_step:
            raise UnsupportedMessage(
                f'PointCloud2: field {field.name!r} ends at byte {end}: expected at most '
                f'point_step, got {msg.point_step}'
            )
    layout = np.dtype(
        {
            'names': [field.name for field in fields],
            'formats': [order + NUMBERS[field.datatype] for field in fields],
            'offsets': [field.offset for field in fields],
            'itemsize': msg.point_step,
        }
    )
    return np.ndarray(
        (msg.height, msg.width), layout, data.data, strides=(row_step, msg.point_step)
    )


def _seconds(raw: NDArray[Any], stamp: int) -> Floats | None:
    """Return times relative to the stamp [s]; see the notes of `from_msg`."""
    if not raw.size:
        return np.zeros(0)
    known = np.isfinite(raw)
    if not known.all():
        seconds = _seconds(raw[known], stamp) if known.any() else None
        if seconds is None:
            return None
        times = np.zeros(raw.shape)
        times[known] = seconds
        return times
    low, high = float(raw.min()), float(raw.max())
    floating = raw.dtype.kind == 'f'
    if floating and raw.dtype.itemsize == 8:
        for unit in UNITS:
            origin = stamp * 1e-9 / unit
            if origin * unit > LONGEST_SWEEP and (
                max(abs(low - origin), abs(high - origin)) * unit <= LONGEST_SWEEP
            ):
                return np.asarray((raw.astype(np.float64) - origin) * unit)
    for unit in UNITS if floating else UNITS[1:]:
        if max(abs(low), abs(high)) * unit <= LONGEST_SWEEP:
            return np.asarray(np.multiply(raw, unit, dtype=np.float64))
    return None
