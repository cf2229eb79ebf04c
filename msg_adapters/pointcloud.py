"""``sensor_msgs/PointCloud2`` of any layout to a `Sweep`, without copying the raw bytes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.structures import Floats, Ints, Sweep
from msg_adapters import point_layout
from msg_adapters.point_layout import AUTO
from msg_adapters.poses import stamp_ns
import numpy as np
from numpy.typing import NDArray

DTYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
"""``PointField.datatype`` -> dtype of numpy."""
NUMBERS = {kind: number for number, kind in DTYPES.items()}
MIN_POINTS_OF_ORDER, MAX_POINTS_OF_ORDER = 20, 60
"""Points of a cloud that its byte order is checked by; chosen."""
LIKELY_POINTS = 0.9
"""Part of them with possible coordinates that shows the byte order; chosen."""
MAX_COORDINATE = 1e7
"""Larger coordinates are of no LiDAR [m]; derived: those of UTM end there."""
NEXT_TO_NOTHING = 1e-9
"""Smaller coordinates but 0 are of none [m]; chosen."""
INTENSITY_FIELDS = ('intensity', 'i', 'reflectivity')
NOT_USED = 'are not used'
"""Words of `described` about times of no unit."""


def from_msg(msg: Any, time_unit: str = AUTO) -> Sweep:
    """
    Return the finite points of a PointCloud2, in its frame, with their times.

    Parameters
    ----------
    msg : sensor_msgs/PointCloud2
        As rclpy, rosbags or mcap decode it, or `clouds.plain` returns it.
    time_unit : str
        Unit of the times of the points, one of `TIME_UNIT_CHOICES`; default: derived.

    Returns
    -------
    sweep : Sweep
        `points` (M, 3) [m] in the frame of the message, `times` (M,) relative to the stamp [s];
        None without times, or where all are that of the stamp. Points are float32; float64 if the
        coordinates are float64 or 32-bit integers, to keep them exact.

    Raises
    ------
    UnsupportedMessage
        If there are no fields x, y, z, a field has an unknown datatype, the sizes in the message
        contradict each other, or the times of a known layout are in a wrong unit.

    Notes
    -----
    The layouts of `point_layout.LAYOUTS` state field and unit of the times. In other layouts times
    are read from the first of the fields ``t``, ``time``, ``timestamp``, ``offset_time``,
    ``time_offset``, ``time_stamp``; unit and origin are derived from type and magnitude. A float64
    field within 1 s of the stamp in s, ms, us or ns is absolute. Other fields are relative to the
    stamp, in the coarsest of these units in which all points are within 1 s of it; seconds only
    for floats. If none fits, ``times`` is None. A point whose time is not finite, or far from
    those of the others, gets the time of the stamp. Where `is_bigendian` contradicts the
    coordinates, these decide.

    """
    stamp = stamp_ns(msg.header)
    if not msg.width * msg.height:
        _check_empty(msg)
        return Sweep(stamp, msg.header.frame_id, np.zeros((0, 3), np.float32))
    kinds = _kinds(_fields(msg))
    time_field = point_layout.time_field_of(kinds)
    table = _table(msg, [*'xyz', time_field] if time_field else 'xyz')

    dtype = np.result_type(np.float32, *(table.dtype[name] for name in 'xyz'))
    columns = np.empty((3, table.size), dtype.newbyteorder('='))  # contiguous per coordinate
    for column, name in zip(columns, 'xyz', strict=True):
        column[:] = table[name].reshape(-1)
    is_finite = np.isfinite(columns).all(0)
    are_finite = bool(is_finite.all())
    times = None
    if time_field:
        raw_times = table[time_field].ravel()  # contiguous: it is read several times
        known_times = raw_times if are_finite else raw_times[is_finite]
        times = _seconds(known_times, stamp, point_layout.layout_of(kinds), time_unit)
    if not are_finite:
        columns = columns[:, is_finite]
    return Sweep(stamp, msg.header.frame_id, columns.T, times)


def described(msg: Any, time_unit: str = AUTO) -> str:
    """
    Return the layout of a cloud and how its times are read, in one line.

    Parameters
    ----------
    msg : sensor_msgs/PointCloud2
        As of `from_msg`.
    time_unit : str
        As of `from_msg`.

    Returns
    -------
    text : str
        'empty' for a cloud without points; it contains `NOT_USED` if its times are of no unit.

    Raises
    ------
    UnsupportedMessage
        As `from_msg`.

    """
    if not msg.width * msg.height:
        return 'empty'
    fields = _fields(msg)
    kinds = _kinds(fields)
    layout = point_layout.layout_of(kinds)
    name = f'unknown layout ({", ".join(fields)})' if layout is None else layout.name
    if byte_order(msg) != ('>' if msg.is_bigendian else '<'):
        name += f' in the other byte order than is_bigendian = {bool(msg.is_bigendian)} states'
    time_field = point_layout.time_field_of(kinds)
    if not time_field:
        return f'{name}: no times of the points'
    raw = _table(msg, [time_field])[time_field].ravel()
    raw = raw[np.isfinite(raw)]
    reading = (
        point_layout.reading_of(raw, stamp_ns(msg.header), layout, time_unit) if raw.size else None
    )
    if reading is None:
        return (
            f'{name}: times in {time_field} {NOT_USED}: in no unit are they those of a sweep '
            f'within {point_layout.MAX_TIME_OFFSET:g} s of the stamp'
        )
    times = point_layout.seconds_of(raw, stamp_ns(msg.header), reading)
    origin = 'absolute' if reading.is_absolute else 'relative to the stamp'
    text = f'{name}: times in {time_field}, {reading.unit}, {origin}, over {np.ptp(times):.3f} s'
    wild = point_layout.wild_count(raw, stamp_ns(msg.header), reading)
    if wild:
        text += f'; {wild} points have times of no sweep, and get that of the stamp'
    return text


def finite_rows(msg: Any) -> Ints | None:
    """
    Return which points of a message are those of `from_msg`.

    Parameters
    ----------
    msg : sensor_msgs/PointCloud2
        As of `from_msg`.

    Returns
    -------
    rows : array, shape (M,), or None
        Their places in the message, counted row by row, ascending; None if these are all.

    Raises
    ------
    UnsupportedMessage
        If x, y and z cannot be read, as in `from_msg`.

    """
    if not msg.width * msg.height:
        return None
    is_finite = _is_finite(_table(msg, 'xyz'))
    return None if is_finite.all() else np.flatnonzero(is_finite)


def positions(msg: Any) -> Floats:
    """
    Return the positions of all points of a cloud, not finite ones too.

    Parameters
    ----------
    msg : sensor_msgs/PointCloud2
        As of `from_msg`.

    Returns
    -------
    positions : array, shape (height * width, 3)
        x, y and z in the frame of the message, row by row [m].

    Raises
    ------
    UnsupportedMessage
        If x, y and z cannot be read, as in `from_msg`.

    """
    table = _table(msg, 'xyz')
    return np.column_stack([table[key].reshape(-1).astype(np.float64) for key in 'xyz'])


def intensities(msg: Any) -> Floats | None:
    """
    Return one intensity per point of `from_msg`.

    Parameters
    ----------
    msg : sensor_msgs/PointCloud2
        As of `from_msg`.

    Returns
    -------
    intensities : array, shape (M,), or None
        In the unit of the sensor, 0 where not finite; None if the message has none of the fields
        ``intensity``, ``i``, ``reflectivity``.

    Raises
    ------
    UnsupportedMessage
        As `from_msg`.

    """
    if not msg.width * msg.height:
        return None
    fields = _fields(msg)
    name = next((name for name in INTENSITY_FIELDS if name in fields), None)
    if name is None:
        return None
    table = _table(msg, [*'xyz', name])
    values = table[name].reshape(-1)[_is_finite(table)].astype(np.float64)
    return np.nan_to_num(values, posinf=0, neginf=0)


def bytes_of(data: Any) -> Any:
    """
    Return what numpy can read of a field of bytes.

    A message of ROS 2 Lyrical may hold them in the memory of a device, as an object with
    ``to_bytes`` and without the buffer protocol.

    """
    return data.to_bytes() if hasattr(data, 'to_bytes') else data


def byte_order(msg: Any) -> Literal['<', '>']:
    """
    Return the byte order of the numbers of a cloud, as ``dtype.newbyteorder`` takes it.

    Parameters
    ----------
    msg : sensor_msgs/PointCloud2
        Any layout with fields x, y and z.

    Returns
    -------
    str
        ``'<'`` or ``'>'``, as `is_bigendian` states unless the coordinates contradict it.

    Raises
    ------
    UnsupportedMessage
        As `from_msg`.

    """
    table = _rows(msg, 'xyz')
    stated: Literal['<', '>'] = '>' if msg.is_bigendian else '<'
    other: Literal['<', '>'] = '<' if msg.is_bigendian else '>'
    if _likely_share(table.view(table.dtype.newbyteorder(stated))) >= 0.5:
        return stated
    share = _likely_share(table.view(table.dtype.newbyteorder(other)))
    return other if share >= LIKELY_POINTS else stated


def _fields(msg: Any) -> dict[str, Any]:
    """Return the fields of a message by name; x, y and z are among them."""
    fields = {field.name: field for field in msg.fields}
    if not fields.keys() >= {'x', 'y', 'z'}:
        raise UnsupportedMessage(
            f'PointCloud2: expected fields x, y, z, got {", ".join(fields) or "none"}; '
            f'publish Cartesian coordinates'
        )
    return fields


def _kinds(fields: Mapping[str, Any]) -> dict[str, str]:
    """Return the kind of the numbers of each field, as in ``u4``; empty if unknown."""
    return {name: DTYPES.get(field.datatype, '') for name, field in fields.items()}


def _is_finite(table: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which points of a table have finite coordinates, row by row."""
    columns = [np.isfinite(table[key].reshape(-1)) for key in 'xyz']
    return np.asarray(np.logical_and.reduce(columns))


def _table(msg: Any, names: Sequence[str]) -> NDArray[Any]:
    """Return a structured view (height, width) of the raw bytes, with these fields only."""
    rows = _rows(msg, names)
    return rows.view(rows.dtype.newbyteorder(byte_order(msg)))


def _rows(msg: Any, names: Sequence[str]) -> NDArray[Any]:
    """Return the same as if the byte order were that of this machine."""
    known = _fields(msg)
    fields = [known[name] for name in names]
    data = np.frombuffer(bytes_of(msg.data), np.uint8)
    row_step = _checked_row_step(msg, len(data))
    for field in fields:
        _check_field(field, msg.point_step)
    layout = np.dtype(
        {
            'names': list(names),
            'formats': [DTYPES[field.datatype] for field in fields],
            'offsets': [field.offset for field in fields],
            'itemsize': msg.point_step,
        }
    )
    rows: NDArray[Any] = np.ndarray(
        (msg.height, msg.width), layout, data.data, strides=(row_step, msg.point_step)
    )
    return rows


def _likely_share(table: NDArray[Any]) -> float:
    """
    Return the part of the points with x, y, z that may be those of a LiDAR; 1 if unknown.

    Floats of the other byte order are mostly huge or next to nothing.

    """
    if table.dtype['x'].kind != 'f' or table.size < MIN_POINTS_OF_ORDER:
        return 1.0
    some = table.reshape(-1)[:: -(-table.size // MAX_POINTS_OF_ORDER)]
    with np.errstate(invalid='ignore'):  # of NaNs that signal
        values = np.abs(np.array([some[key] for key in 'xyz'], dtype=np.float64))
    is_likely = (values == 0) | ((values > NEXT_TO_NOTHING) & (values < MAX_COORDINATE))
    is_known = np.isfinite(values).all(axis=0)
    return float(is_likely.all(axis=0)[is_known].mean()) if is_known.any() else 0.0


def _check_empty(msg: Any) -> None:
    """Raise `UnsupportedMessage` if a cloud of no rows has the bytes of a row of points."""
    num_bytes = len(bytes_of(msg.data))
    if msg.width > 0 and num_bytes >= msg.width * msg.point_step > 0:
        raise UnsupportedMessage(
            f'PointCloud2: expected a height of 1 for a row of {msg.width} points, got 0 with '
            f'{num_bytes} bytes of data; the publisher fills in height wrongly'
        )


def _checked_row_step(msg: Any, num_bytes: int) -> int:
    """Return the bytes from row to row; UnsupportedMessage if the sizes contradict each other."""
    sizes = (msg.width, msg.height, msg.point_step, msg.row_step)
    if min(sizes) < 0:
        raise UnsupportedMessage(
            f'PointCloud2: expected width, height, point_step and row_step of at least 0, got '
            f'{", ".join(map(str, sizes))}'
        )
    row_size = msg.width * msg.point_step
    row_step = msg.row_step if msg.height > 1 else row_size
    needed = (msg.height - 1) * row_step + row_size
    if row_step < row_size or num_bytes < needed:
        raise UnsupportedMessage(
            f'PointCloud2: {msg.height} x {msg.width} points of {msg.point_step} bytes in rows of '
            f'{row_step}: expected at least {max(needed, msg.height * row_size)} bytes, got '
            f'{num_bytes}; the publisher fills in width, height, point_step or row_step wrongly'
        )
    return int(row_step)


def _check_field(field: Any, point_step: int) -> None:
    """Raise UnsupportedMessage for a field that is no single number within a point."""
    dtype = DTYPES.get(field.datatype)
    if dtype is None or field.count > 1:
        raise UnsupportedMessage(
            f'PointCloud2: field {field.name!r}: expected one number of datatype 1 to 8, got '
            f'{field.count} of datatype {field.datatype}'
        )
    end = field.offset + np.dtype(dtype).itemsize
    if field.offset < 0 or end > point_step:
        raise UnsupportedMessage(
            f'PointCloud2: field {field.name!r} ends at byte {end}: expected at most '
            f'point_step, got {point_step}'
        )


def _seconds(
    raw: NDArray[Any], stamp: int, layout: point_layout.PointLayout | None, unit: str
) -> Floats | None:
    """Return point times (M,) relative to the stamp [s], or None; see `from_msg`."""
    if not raw.size:
        return np.zeros(0)
    is_known = np.isfinite(raw)
    known = raw if is_known.all() else raw[is_known]
    reading = point_layout.reading_of(known, stamp, layout, unit) if known.size else None
    if reading is None or not (reading.is_absolute or known.any()):
        return None
    if known is raw:
        return point_layout.seconds_of(raw, stamp, reading)
    times = np.zeros(raw.shape)
    times[is_known] = point_layout.seconds_of(known, stamp, reading)
    return times
