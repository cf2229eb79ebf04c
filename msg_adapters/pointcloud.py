"""``sensor_msgs/PointCloud2`` of any layout to a `Sweep`, without copying the raw bytes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.structures import Floats, Ints, Sweep
from msg_adapters.poses import stamp_ns
import numpy as np
from numpy.typing import NDArray

DTYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
"""``PointField.datatype`` -> dtype of numpy."""
POINT_TIME_FIELDS = ('t', 'time', 'timestamp', 'offset_time', 'time_stamp')
TIME_UNITS = (1.0, 1e-3, 1e-6, 1e-9)
"""Possible units of point times [s], coarsest first."""
INTENSITY_FIELDS = ('intensity', 'i', 'reflectivity')
MAX_TIME_OFFSET = 1.0
"""Largest difference between the time of a point and the stamp [s]; one revolution is shorter."""


class TimeLayout(NamedTuple):
    """Field of the times of points, its unit [s] (None if none fits), relative or absolute."""

    field: str
    unit: float | None
    is_absolute: bool


def from_msg(msg: Any) -> Sweep:
    """
    Return the finite points of a PointCloud2, in its frame, with their times.

    Points are float32; float64 if the coordinates are float64 or 32-bit integers, to keep them
    exact.

    Raises
    ------
    UnsupportedMessage
        If there are no fields x, y, z, a field has an unknown datatype, or the sizes in the
        message contradict each other.

    Notes
    -----
    Times are read from the first of the fields ``t``, ``time``, ``timestamp``, ``offset_time``,
    ``time_stamp``. Unit and origin differ between drivers, so both are derived from type and
    magnitude. A float64 field within 1 s of the stamp in s, ms, us or ns is absolute (Hesai,
    RoboSense, Livox). Other fields are relative to the stamp, in the coarsest of these units in
    which all points are within 1 s of it; seconds only for floats (Velodyne: s, Ouster: ns). If
    none fits, ``times`` is None. A point whose time is not finite gets the time of the stamp.

    """
    stamp = stamp_ns(msg.header)
    if not msg.width * msg.height:
        return Sweep(stamp, msg.header.frame_id, np.zeros((0, 3), np.float32))
    fields = _fields(msg)
    time_field = _first(POINT_TIME_FIELDS, fields)
    names = ['x', 'y', 'z']
    if time_field is not None:
        names.append(time_field)
    table = _table(msg, [fields[name] for name in names])

    dtype = np.result_type(np.float32, *(table.dtype[name] for name in 'xyz'))
    columns = np.empty((3, table.size), dtype.newbyteorder('='))  # contiguous per coordinate
    for column, name in zip(columns, 'xyz', strict=True):
        column[:] = table[name].reshape(-1)
    is_finite = np.isfinite(columns).all(0)
    times = None
    if time_field is not None:
        raw_times = table[time_field].ravel()  # contiguous: it is read several times
        times = _seconds(raw_times if is_finite.all() else raw_times[is_finite], stamp)
    if not is_finite.all():
        columns = columns[:, is_finite]
    return Sweep(stamp, msg.header.frame_id, columns.T, times)


def finite_rows(msg: Any) -> Ints | None:
    """Return the rows (M,) of the points of `from_msg` in the message; None if these are all."""
    if not msg.width * msg.height:
        return None
    fields = _fields(msg)
    table = _table(msg, [fields[key] for key in 'xyz'])
    is_finite = np.logical_and.reduce([np.isfinite(table[key].reshape(-1)) for key in 'xyz'])
    return None if is_finite.all() else np.flatnonzero(is_finite)


def time_layout(msg: Any) -> TimeLayout | None:
    """
    Return where a PointCloud2 has the times of its points; None if it has none.

    Raises
    ------
    UnsupportedMessage
        As `from_msg`.

    """
    if not msg.width * msg.height:
        return None
    fields = _fields(msg)
    name = _first(POINT_TIME_FIELDS, fields)
    if name is None:
        return None
    raw = _table(msg, [fields[name]])[name].ravel()
    raw = raw[np.isfinite(raw)]
    found = _time_unit(raw, stamp_ns(msg.header)) if raw.size else None
    if found is None:
        return TimeLayout(name, None, False)
    unit, origin = found
    return TimeLayout(name, unit, bool(origin))


def intensities(msg: Any) -> Floats | None:
    """
    Return the intensities of the points, in the unit of the sensor.

    Returns
    -------
    intensities : array, shape (M,), or None
        One per point of `from_msg`; None if the message has none of the fields ``intensity``,
        ``i``, ``reflectivity``. Values that are not finite are 0.

    Raises
    ------
    UnsupportedMessage
        As `from_msg`.

    """
    if not msg.width * msg.height:
        return None
    fields = _fields(msg)
    name = _first(INTENSITY_FIELDS, fields)
    if name is None:
        return None
    table = _table(msg, [fields[key] for key in (*'xyz', name)])
    is_finite = np.logical_and.reduce([np.isfinite(table[key].reshape(-1)) for key in 'xyz'])
    values = table[name].reshape(-1)[is_finite].astype(np.float64)
    return np.nan_to_num(values, posinf=0, neginf=0)


def _fields(msg: Any) -> dict[str, Any]:
    """Return the fields of a message by name; x, y and z are among them."""
    fields = {field.name: field for field in msg.fields}
    if not fields.keys() >= {'x', 'y', 'z'}:
        raise UnsupportedMessage(
            f'PointCloud2: expected fields x, y, z, got {", ".join(fields) or "none"}; '
            f'publish Cartesian coordinates'
        )
    return fields


def _first(names: Sequence[str], fields: Mapping[str, Any]) -> str | None:
    return next((name for name in names if name in fields), None)


def _table(msg: Any, fields: list[Any]) -> NDArray[Any]:
    """Return a structured view (height, width) of the raw bytes, with these fields only."""
    sizes = (msg.width, msg.height, msg.point_step, msg.row_step)
    if min(sizes) < 0:
        raise UnsupportedMessage(
            f'PointCloud2: expected width, height, point_step and row_step of at least 0, got '
            f'{", ".join(map(str, sizes))}'
        )
    data = np.frombuffer(msg.data, np.uint8)
    row_size = msg.width * msg.point_step
    row_step = msg.row_step if msg.height > 1 else row_size
    needed = (msg.height - 1) * row_step + row_size
    if row_step < row_size or len(data) < needed:
        raise UnsupportedMessage(
            f'PointCloud2: {msg.height} x {msg.width} points of {msg.point_step} bytes in rows of '
            f'{row_step}: expected at least {max(needed, msg.height * row_size)} bytes, got '
            f'{len(data)}; the publisher fills in width, height, point_step or row_step wrongly'
        )
    order = '>' if msg.is_bigendian else '<'
    for field in fields:
        dtype = DTYPES.get(field.datatype)
        if dtype is None or field.count > 1:
            raise UnsupportedMessage(
                f'PointCloud2: field {field.name!r}: expected one number of datatype 1 to 8, got '
                f'{field.count} of datatype {field.datatype}'
            )
        end = field.offset + np.dtype(dtype).itemsize
        if field.offset < 0 or end > msg.point_step:
            raise UnsupportedMessage(
                f'PointCloud2: field {field.name!r} ends at byte {end}: expected at most '
                f'point_step, got {msg.point_step}'
            )
    layout = np.dtype(
        {
            'names': [field.name for field in fields],
            'formats': [order + DTYPES[field.datatype] for field in fields],
            'offsets': [field.offset for field in fields],
            'itemsize': msg.point_step,
        }
    )
    return np.ndarray(
        (msg.height, msg.width), layout, data.data, strides=(row_step, msg.point_step)
    )


def _seconds(raw: NDArray[Any], stamp: int) -> Floats | None:
    """Return point times (M,) relative to the stamp [s]; see the notes of `from_msg`."""
    if not raw.size:
        return np.zeros(0)
    is_known = np.isfinite(raw)
    if is_known.all():
        return _known_seconds(raw, stamp)
    if not is_known.any():
        return None
    known = _known_seconds(raw[is_known], stamp)
    if known is None:
        return None
    times = np.zeros(raw.shape)
    times[is_known] = known
    return times


def _known_seconds(raw: NDArray[Any], stamp: int) -> Floats | None:
    """Return finite point times (M,), M > 0, relative to the stamp [s]."""
    found = _time_unit(raw, stamp)
    if found is None:
        return None
    unit, origin = found
    if origin:
        return np.asarray((raw.astype(np.float64) - origin) * unit)
    return np.asarray(np.multiply(raw, unit, dtype=np.float64))


def _time_unit(raw: NDArray[Any], stamp: int) -> tuple[float, float] | None:
    """Return the unit [s] of finite times, and what the stamp is in it, 0 for relative times."""
    low = float(raw.min())
    high = float(raw.max())
    is_float = raw.dtype.kind == 'f'
    if is_float and raw.dtype.itemsize == 8:
        for unit in TIME_UNITS:
            origin = stamp * 1e-9 / unit
            offset = max(abs(low - origin), abs(high - origin)) * unit
            # A stamp near 0 does not separate absolute from relative times.
            if origin * unit > MAX_TIME_OFFSET and offset <= MAX_TIME_OFFSET:
                return unit, origin
    for unit in TIME_UNITS if is_float else TIME_UNITS[1:]:
        if max(abs(low), abs(high)) * unit <= MAX_TIME_OFFSET:
            return unit, 0.0
    return None
