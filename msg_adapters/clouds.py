"""
Messages of point clouds that are not a ``sensor_msgs/PointCloud2``, converted to one.

Compressed clouds are decompressed; Livox's own message gets the layout of a cloud. The result has
the attributes of a PointCloud2.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import prod
import re
from types import SimpleNamespace
from typing import Any
import zlib

from boxreg_ros.errors import UnsupportedMessage
from msg_adapters.point_layout import POINT_TIME_FIELDS
from msg_adapters.pointcloud import bytes_of, DTYPES, NUMBERS
import numpy as np
from numpy.typing import NDArray

POINTS_TYPE = 'sensor_msgs/msg/PointCloud2'
LIVOX_PACKAGES = ('livox_ros_driver2', 'livox_ros_driver', 'livox_interfaces')
LIVOX_TYPES = tuple(f'{package}/msg/CustomMsg' for package in LIVOX_PACKAGES)
COMPRESSED_TYPE = 'point_cloud_interfaces/msg/CompressedPointCloud2'
FOXGLOVE_TYPE = 'foxglove_msgs/msg/CompressedPointCloud'
CLOUD_TYPES = (POINTS_TYPE, COMPRESSED_TYPE, FOXGLOVE_TYPE, *LIVOX_TYPES)
"""Types of messages that `plain` reads."""

MAX_CLOUD_BYTES = 2**30
"""Compressed clouds that claim to be larger are refused [bytes]: 30 million points."""
GZIP_OR_ZLIB = 32 + zlib.MAX_WBITS
"""``wbits`` of zlib that accept either header."""
DRACO_POSITION = 0
"""``attribute_type`` of coordinates in Draco."""
DRACO_METHOD, DRACO_KD_TREE = 8, 1
"""Byte of a Draco point cloud with its encoding method, and the method that sorts points."""
DRACO_ROUNDED = {5: '<i4', 7: '<i8', 8: '<u8', 10: '<f8'}
"""``data_type`` of Draco whose values DracoPy (2.2) gives as float32, and their dtype."""
EXACT_INTEGERS = 2**24
"""Integers below this are the same as float32."""
COLOR_FIELDS = ('rgb', 'rgba')
"""Fields that the publisher of draco_point_cloud_transport splits into four numbers."""
CLOUDINI = 'cloudini'
CLOUDINI_BEGIN = b'CLOUDINI_V'
"""Begin of a stream of Cloudini, whose live publisher leaves the format empty."""
CLOUDINI_SIZES = re.compile(rb'\nwidth: (\d+)\nheight: (\d+)\npoint_step: (\d+)\n')
"""Size of the cloud, in the header of a stream of version 3 and later."""
PACKETS = {
    'velodyne_msgs/msg/VelodyneScan': 'velodyne_transform_node of velodyne_pointcloud',
    'ouster_ros/msg/PacketMsg': 'replay.launch.xml of ouster_ros',
    'ouster_sensor_msgs/msg/PacketMsg': 'replay.launch.xml of ouster_ros',
    'hesai_ros_driver/msg/UdpFrame': 'hesai_ros_driver with source_type 3',
    'hesai_lidar/msg/PandarScan': 'hesai_lidar with data_type rosbag',
    'pandar_msgs/msg/PandarScan': 'nebula_ros with launch_hw false',
    'nebula_msgs/msg/NebulaPackets': 'nebula_ros with launch_hw false',
    'robosense_msgs/msg/RobosenseScan': 'nebula_ros with launch_hw false',
    'rslidar_msg/msg/RslidarPacket': 'rslidar_sdk with msg_source 2',
    'rslidar_msg/msg/RslidarScan': 'rslidar_sdk 1.3 with msg_source 2',
    'rslidar_msgs/msg/rslidarScan': (
        'rslidar_sdk 1.3 with msg_source 2 (later: built with ENABLE_SOURCE_PACKET_LEGACY=ON)'
    ),
    'seyond/msg/SeyondScan': 'start.py of seyond with replay_rosbag:=true',
}
"""Types of the packets of a LiDAR -> what converts them to points."""
LONG = ('i8', 'u8')
"""Kinds of numbers that a cloud cannot have."""
LIVOX_FIELDS = {'x': 'f4', 'y': 'f4', 'z': 'f4', 'reflectivity': 'u1', 'offset_time': 'u4'}
"""Fields of Livox's ``CustomPoint`` that are read; ``offset_time`` is in ns."""


def plain(msg: Any) -> Any:
    """
    Return the cloud of a message of `CLOUD_TYPES` with the attributes of a PointCloud2.

    Parameters
    ----------
    msg : message
        Of one of these types; a PointCloud2 is returned as it is.

    Returns
    -------
    cloud : object
        With the fields of a ``sensor_msgs/PointCloud2``, decompressed, in the frame of `msg`.

    Raises
    ------
    UnsupportedMessage
        If the compressed data are damaged or of an unknown format, or a package that decompresses
        them is not installed.

    """
    if hasattr(msg, 'compressed_data'):
        return _decompressed(msg)
    if hasattr(msg, 'format') and hasattr(msg, 'timestamp'):
        header = SimpleNamespace(stamp=msg.timestamp, frame_id=msg.frame_id)
        if _is_cloudini(bytes_of(msg.data)):
            return _cloudini_cloud(header, bytes(bytes_of(msg.data)))
        if msg.format != 'draco':
            raise _unknown_format('CompressedPointCloud', msg.format, ('draco', CLOUDINI))
        return cloud_of_columns(header, _draco_columns(bytes(bytes_of(msg.data))))
    if hasattr(msg, 'point_num'):
        columns = [
            (name, np.array([getattr(point, name) for point in msg.points], kind))
            for name, kind in LIVOX_FIELDS.items()
        ]
        return cloud_of_columns(msg.header, columns)
    return msg


def header_of(msg: Any) -> Any:
    """Return stamp and frame of a message of `CLOUD_TYPES`, without decompressing it."""
    if hasattr(msg, 'header'):
        return msg.header
    return SimpleNamespace(stamp=msg.timestamp, frame_id=msg.frame_id)


def _decompressed(msg: Any) -> Any:
    """Return a CompressedPointCloud2 as a cloud."""
    if msg.format == 'draco':
        return _draco_cloud(msg)
    data = bytes(bytes_of(msg.compressed_data))
    if _is_cloudini(data):
        return _cloudini_cloud(msg.header, data)
    if msg.format not in DECOMPRESSORS:
        known = ('draco', *DECOMPRESSORS, CLOUDINI)
        raise _unknown_format('CompressedPointCloud2', msg.format, known)
    size = msg.height * max(msg.row_step, msg.width * msg.point_step)
    if not 0 <= size <= MAX_CLOUD_BYTES:
        raise _damaged(msg.format, len(data), f'a cloud of {size} bytes')
    raw = DECOMPRESSORS[msg.format](data, size)
    if len(raw) < size:
        raise _damaged(msg.format, len(data), f'{len(raw)} of {size} bytes of the cloud')
    names = ('header', 'height', 'width', 'fields', 'is_bigendian', 'point_step', 'row_step')
    own = {name: getattr(msg, name) for name in (*names, 'is_dense')}
    return SimpleNamespace(**own, data=raw)


def _inflated(data: bytes, size: int) -> bytes:
    try:
        return zlib.decompressobj(GZIP_OR_ZLIB).decompress(data, size + 1)[:size]
    except zlib.error as error:
        raise _damaged('zlib', len(data), str(error)) from None


def _unzstd(data: bytes, size: int) -> bytes:
    import zstandard

    try:
        return zstandard.ZstdDecompressor().stream_reader(data).read(size)
    except zstandard.ZstdError as error:
        raise _damaged('zstd', len(data), str(error)) from None


DECOMPRESSORS: dict[str, Callable[[bytes, int], bytes]] = {'zlib': _inflated, 'zstd': _unzstd}
"""``format`` -> function that unpacks compressed data to at most a number of bytes."""


def _is_cloudini(data: Any) -> bool:
    return bytes(data[: len(CLOUDINI_BEGIN)]) == CLOUDINI_BEGIN


def _cloudini_cloud(header: Any, data: bytes) -> Any:
    """Return the cloud of a stream of Cloudini, which has its own layout."""
    try:
        import pureini
    except ImportError:
        raise UnsupportedMessage(
            'a point cloud is compressed by Cloudini, and the package that reads it is not '
            'installed: pip install pureini, or convert the recording by cloudini_rosbag_converter'
        ) from None
    sizes = CLOUDINI_SIZES.search(data)
    claimed = prod(map(int, sizes.groups())) if sizes else 0
    if claimed > MAX_CLOUD_BYTES:
        raise _damaged(CLOUDINI, len(data), f'a cloud of {claimed} bytes')
    try:
        raw, info = pureini.PointcloudDecoder().decode(data)
    except (RuntimeError, MemoryError) as error:
        raise _damaged(CLOUDINI, len(data), str(error)) from None
    fields = [
        SimpleNamespace(name=field.name, offset=field.offset, datatype=int(field.type), count=1)
        for field in info.fields
    ]
    return SimpleNamespace(
        header=header, height=info.height, width=info.width, fields=fields, is_bigendian=False,
        point_step=info.point_step, row_step=info.width * info.point_step, data=raw,
        is_dense=False,
    )  # fmt: skip


def is_reordered(msg: Any) -> bool:
    """Return whether the compression of a cloud has changed the order of its points."""
    data = bytes_of(getattr(msg, 'compressed_data', b''))
    has_method = getattr(msg, 'format', '') == 'draco' and len(data) > DRACO_METHOD
    return has_method and int(data[DRACO_METHOD]) == DRACO_KD_TREE


def _draco_cloud(msg: Any) -> Any:
    """
    Return a CompressedPointCloud2 of Draco as a cloud.

    Its publisher writes one attribute per field, in their order, without names. The four bytes of
    a colour are four components. Some encoders put several fields into one attribute.

    """
    attributes = _draco_attributes(bytes(bytes_of(msg.compressed_data)))
    columns = [column for attribute in attributes for column in _columns(attribute)]
    rounded = [a['is_rounded'] for a in attributes for _ in _columns(a)]
    names = [field.name for field in msg.fields]
    lengths = [max(1, field.count) for field in msg.fields]
    if sum(lengths) != len(columns):
        lengths = [
            4 if field.name in COLOR_FIELDS else max(1, field.count) for field in msg.fields
        ]
    if sum(lengths) != len(columns):
        raise UnsupportedMessage(
            f'point cloud compressed by Draco: expected a component for each of the fields '
            f'{", ".join(names)}, got {len(columns)}; publisher and recording have different '
            f'fields'
        )
    table = np.zeros(len(columns[0]) if columns else 0, _layout(msg, names, lengths))
    ends = np.cumsum(lengths).tolist()
    for name, length, end in zip(names, lengths, ends, strict=True):
        _check_exact(name, any(rounded[end - length : end]))
        values = np.stack(columns[end - length : end], axis=1)
        table[name] = values.reshape(table[name].shape)
    return _cloud_of(msg.header, msg.fields, table, msg.is_dense)


def _layout(msg: Any, names: Sequence[str], lengths: Sequence[int]) -> np.dtype[Any]:
    """Return the layout of a point; UnsupportedMessage if its fields contradict each other."""
    try:
        return np.dtype(
            {
                'names': names,
                'formats': [_format(*pair) for pair in zip(msg.fields, lengths, strict=True)],
                'offsets': [field.offset for field in msg.fields],
                'itemsize': msg.point_step,
            }
        )
    except (KeyError, ValueError) as error:
        raise UnsupportedMessage(
            f'point cloud compressed by Draco: expected different fields within a point_step of '
            f'{msg.point_step} bytes, got {", ".join(names)} ({error}); correct its publisher'
        ) from None


def _format(field: Any, length: int) -> tuple[str, tuple[int, ...]]:
    """Return dtype and shape of a field that a stream has as `length` components."""
    kind = DTYPES[field.datatype]
    count = max(1, field.count)
    if length != count:  # the bytes of a colour
        return f'<u{np.dtype(kind).itemsize * count // length}', (length,)
    return f'<{kind}', (length,) if length > 1 else ()


def _columns(attribute: Any) -> list[NDArray[Any]]:
    """Return the components (M,) of an attribute of Draco."""
    return list(np.atleast_2d(np.asarray(attribute['data'])).T)


def _draco_columns(data: bytes) -> list[tuple[str, NDArray[Any]]]:
    """Return name and values (M,) of all components of a Draco cloud; coordinates are x, y, z."""
    found = []
    for attribute in _draco_attributes(data):
        columns = _columns(attribute)
        prefix = attribute['name'] or f'attribute_{attribute["unique_id"]}'
        own = [f'{prefix}_{k}' if k else prefix for k in range(len(columns))]
        if attribute['attribute_type'] == DRACO_POSITION and len(columns) == 3:
            own = ['x', 'y', 'z']
        for name, column in zip(own, columns, strict=True):
            _check_exact(name, attribute['is_rounded'])
            found.append((name, column))
    return found


def _draco_attributes(data: bytes) -> list[Any]:
    """
    Return the attributes of a Draco point cloud: mappings with ``data`` (M, components).

    ``is_rounded`` is whether the values are not those of the stream. DracoPy gives some types as
    float32; those of 64 bits, which Draco stores as they are, are looked up in the stream.

    """
    try:
        import DracoPy
    except ImportError:
        raise UnsupportedMessage(
            'a point cloud is compressed by Draco, and the package that reads it is not '
            'installed: pip install DracoPy'
        ) from None
    try:
        attributes: list[Any] = DracoPy.decode(data).attributes
    except (DracoPy.FileTypeException, ValueError) as error:
        raise _damaged('draco', len(data), str(error)) from None
    begin = 0
    for attribute in attributes:
        attribute['is_rounded'] = False
        shown = np.asarray(attribute['data'])
        kind = DRACO_ROUNDED.get(attribute['data_type'])
        is_integer = kind is not None and kind[1] != 'f'
        if kind is None or (is_integer and np.all(np.abs(shown) < EXACT_INTEGERS)):
            continue
        stored, begin = _stored(data, begin, shown, kind)
        attribute['is_rounded'] = stored is None
        if stored is not None:
            attribute['data'] = stored
    return attributes


def _stored(
    data: bytes, begin: int, shown: NDArray[Any], kind: str
) -> tuple[NDArray[Any] | None, int]:
    """
    Return numbers that are stored as they are behind a place in a stream, and where they end.

    `shown` are the same as float32. None, and `begin`, if they are not stored so.

    """
    dtype = np.dtype(kind)
    wanted = shown.astype(np.float32).ravel()
    known = np.flatnonzero(np.isfinite(wanted))[:1]
    for first in range(begin, begin + dtype.itemsize if len(known) else begin):
        count = max(0, len(data) - first) // dtype.itemsize
        numbers = np.frombuffer(data, dtype, count, first)
        with np.errstate(over='ignore', invalid='ignore'):  # the other bytes are of any value
            rounded = numbers.astype(np.float32)
        starts = np.flatnonzero(rounded == wanted[known]) - known
        for start in starts[starts >= 0].tolist():
            end = start + len(wanted)
            if np.array_equal(rounded[start:end], wanted, equal_nan=True):
                return numbers[start:end].reshape(shown.shape), first + end * dtype.itemsize
    return None, begin


def _check_exact(name: str, is_rounded: bool) -> None:
    """Raise UnsupportedMessage if coordinates or times are not those of the stream."""
    if is_rounded and name in (*'xyz', *POINT_TIME_FIELDS):
        raise UnsupportedMessage(
            f'point cloud compressed by Draco: expected {name} as float32, float64, or integers '
            f'below 2^24, which DracoPy decodes, got larger ones of 32 or 64 bits; decompress the '
            f'topic with the plugin that wrote it: ros2 run point_cloud_transport republish'
        )


def cloud_of_columns(header: Any, columns: Sequence[tuple[str, NDArray[Any]]]) -> Any:
    """
    Return columns (M,) by name as a cloud of one row; its type has no integers of 64 bits.

    They become doubles, to which a time of today is exact to 256 ns.

    """
    kinds = [
        (name, np.dtype('<f8' if values.dtype.str[1:] in LONG else values.dtype.newbyteorder('<')))
        for name, values in columns
    ]
    table = np.zeros(len(columns[0][1]) if columns else 0, np.dtype(kinds))
    fields = []
    offset = 0
    for (name, values), (_, kind) in zip(columns, kinds, strict=True):
        table[name] = values
        number = NUMBERS[kind.str[1:]]
        fields.append(SimpleNamespace(name=name, offset=offset, datatype=number, count=1))
        offset += kind.itemsize
    return _cloud_of(header, fields, table)


def _cloud_of(
    header: Any, fields: Sequence[Any], table: NDArray[Any], is_dense: bool = False
) -> Any:
    """Return the points of a table, whose columns are the fields, as a cloud of one row."""
    return SimpleNamespace(
        header=header, height=1, width=len(table), fields=fields, is_bigendian=False,
        point_step=table.itemsize, row_step=table.nbytes, data=table.view(np.uint8),
        is_dense=is_dense,
    )  # fmt: skip


def _unknown_format(kind: str, given: str, known: Sequence[str]) -> UnsupportedMessage:
    return UnsupportedMessage(
        f'{kind}: format {given!r}: expected {" or ".join(known)}; publish it in one of these'
    )


def _damaged(kind: str, size: int, cause: str) -> UnsupportedMessage:
    return UnsupportedMessage(
        f'point cloud compressed by {kind}: expected a whole stream, got {size} bytes that do not '
        f'decode ({cause}); it was cut short or damaged on its way'
    )
