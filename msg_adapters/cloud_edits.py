"""Edited copies of a PointCloud2: some of its points, more fields, other places."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from typing import Any

from boxreg_ros.structures import Floats
from msg_adapters.pointcloud import byte_order, bytes_of, DTYPES, NUMBERS
from msg_adapters.poses import replaced
import numpy as np
from numpy.typing import NDArray


def with_points(msg: Any, is_kept: NDArray[np.bool_]) -> Any:
    """
    Return a cloud with some of its points in the same layout.

    Parameters
    ----------
    msg : sensor_msgs/PointCloud2
        One that `pointcloud.from_msg` reads. It is not modified.
    is_kept : array of bool, shape (height * width,)
        Which points remain, row by row.

    Returns
    -------
    sensor_msgs/PointCloud2
        `msg` itself if all remain; else a copy of its class, of one row, with all fields of the
        points that remain.

    """
    if is_kept.all():
        return msg
    kept = np.compress(is_kept, _bytes_of(msg), axis=0)  # a quarter of the time of an index
    return _with_data(msg, kept)


def with_fields(msg: Any, columns: Mapping[str, NDArray[Any]]) -> Any:
    """
    Return a cloud with more fields behind those it has.

    Parameters
    ----------
    msg : sensor_msgs/PointCloud2
        One that `pointcloud.from_msg` reads. It is not modified.
    columns : mapping of str to array, shape (height * width,)
        Values of each new field, row by row, by its name: integers of up to 32 bits, float32 or
        float64.

    Returns
    -------
    sensor_msgs/PointCloud2
        A copy of its class, with as many rows. The values are in the byte order of the others.

    Raises
    ------
    KeyError
        If a column has a type without a ``PointField.datatype``, as int64 or bool.

    """
    points = _bytes_of(msg)
    make = type(msg.fields[0])
    order = byte_order(msg)
    fields = list(msg.fields)
    parts = [points]
    step = msg.point_step
    for name, values in columns.items():
        kind = values.dtype.str[1:]
        fields.append(make(name=name, offset=step, datatype=NUMBERS[kind], count=1))
        column = np.ascontiguousarray(values.astype(order + kind))
        parts.append(column.view(np.uint8).reshape(len(points), -1))
        step += values.dtype.itemsize
    return _with_data(replaced(msg, fields=fields, point_step=step), np.hstack(parts))


def with_positions(msg: Any, positions: Floats) -> Any:
    """
    Return a cloud whose points are elsewhere.

    Parameters
    ----------
    msg : sensor_msgs/PointCloud2
        One that `pointcloud.from_msg` reads. It is not modified.
    positions : array, shape (height * width, 3)
        New x, y and z of all its points, row by row, NaN for points that are not finite [m].

    Returns
    -------
    sensor_msgs/PointCloud2
        A copy of its class, in the same layout: x, y and z have the types that they have in `msg`,
        and the same byte order.

    """
    data = _bytes_of(msg).copy()
    order = byte_order(msg)
    fields = {field.name: field for field in msg.fields}
    for name, column in zip('xyz', positions.T, strict=True):
        first = fields[name].offset
        values = column.astype(order + DTYPES[fields[name].datatype])
        data[:, first : first + values.itemsize] = values.view(np.uint8).reshape(len(data), -1)
    return _with_data(msg, data)


def _bytes_of(msg: Any) -> NDArray[np.uint8]:
    """Return the bytes of each point, (height * width, point_step)."""
    step = msg.point_step
    data = np.frombuffer(bytes_of(msg.data), np.uint8)
    row_step = msg.row_step if msg.height > 1 else msg.width * step
    rows = np.lib.stride_tricks.as_strided(
        data, (msg.height, msg.width, step), (row_step, step, 1), writeable=False
    )
    return rows.reshape(-1, step)


def _with_data(msg: Any, points: NDArray[np.uint8]) -> Any:
    """Return a cloud of these points (n, point_step), organised as before if they are as many."""
    n, step = points.shape
    is_whole = n == msg.height * msg.width
    height, width = (msg.height, msg.width) if is_whole else (1, n)
    data: Any = np.ascontiguousarray(points).reshape(-1)
    if isinstance(msg.data, array):  # of rclpy
        data = array('B', data.tobytes())
    return replaced(msg, height=height, width=width, row_step=width * step, data=data)
