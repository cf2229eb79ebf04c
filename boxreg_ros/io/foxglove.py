"""
Messages of Foxglove's schemas, as protobuf and as JSON.

Clouds, transforms, odometry and images are converted to the corresponding ROS messages. A
SceneUpdate stays as it is, because adapters read by attribute.

"""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Callable
import json
from types import SimpleNamespace
from typing import Any

from boxreg_ros.errors import RecordingError, UnsupportedMessage
from mcap.records import Schema
from rosbags.interfaces import Connection, MessageDefinition, MessageDefinitionFormat

FOXGLOVE_ENCODINGS = ('protobuf', 'json')
"""Encodings of messages with a schema of Foxglove."""
DATATYPES = (0, 2, 1, 4, 3, 6, 5, 7, 8)
"""``PointField.datatype`` of ROS by Foxglove's number of the same type."""

MAX_INTEGER = 2**63 - 1

_NUMBER = (int, float)
_TIME = {'sec': int, 'nsec': int}
_VECTOR = {'x': _NUMBER, 'y': _NUMBER, 'z': _NUMBER}
_QUATERNION = _VECTOR | {'w': _NUMBER}
_POSE = {'position': _VECTOR, 'orientation': _QUATERNION}
_TRANSFORM = {
    'timestamp': _TIME, 'parent_frame_id': str, 'child_frame_id': str,
    'translation': _VECTOR, 'rotation': _QUATERNION,
}  # fmt: skip
_CUBE = {'pose': _POSE, 'size': _VECTOR}
_ENTITY = {
    'timestamp': _TIME, 'frame_id': str, 'id': str, 'cubes': [_CUBE],
    'metadata': [{'key': str}],
}  # fmt: skip
_FIELD = {'name': str, 'offset': int, 'type': int}
_IMAGE = {'timestamp': _TIME, 'frame_id': str, 'data': str}
_SIZE = {'width': int, 'height': int}
JSON_FIELDS: dict[str, Any] = {
    'foxglove.SceneUpdate': {'entities': [_ENTITY]},
    'foxglove.FrameTransform': _TRANSFORM,
    'foxglove.FrameTransforms': {'transforms': [_TRANSFORM]},
    'foxglove.Odometry': {
        'timestamp': _TIME, 'frame_id': str, 'body_frame_id': str, 'pose': _POSE,
    },
    'foxglove.PointCloud': {
        'timestamp': _TIME, 'frame_id': str, 'pose?': _POSE, 'point_stride': int,
        'fields': [_FIELD], 'data': str,
    },
    'foxglove.CompressedPointCloud': {
        'timestamp': _TIME, 'frame_id': str, 'pose?': _POSE, 'data': str, 'format': str,
    },
    'foxglove.CompressedImage': _IMAGE | {'format': str},
    'foxglove.RawImage': _IMAGE | _SIZE | {'step': int, 'encoding': str},
    'foxglove.CameraCalibration': {
        'timestamp': _TIME, 'frame_id': str, 'distortion_model': str, **_SIZE,
        **{key: [_NUMBER] for key in 'DKRP'},
    },
}  # fmt: skip
"""
Fields that are read, with their types in JSON; a list holds the type of its items.

A field whose name ends with ``?`` may be null.

"""


def ros_type(schema_name: str) -> str:
    """Return the ROS type that messages of a schema are read as; else the name of the schema."""
    kind, _ = SCHEMAS.get(schema_name, (schema_name, None))
    return kind


def schema_as_definition(schema: Schema) -> MessageDefinition:
    """Return a schema as the definition of a connection, which `ChannelDecoder` reads."""
    text = f'{schema.name}\n{schema.data.decode("latin1")}'
    return MessageDefinition(MessageDefinitionFormat.NONE, text)


class ChannelDecoder:
    """
    Decodes the messages of a connection of JSON or protobuf, as `schema_as_definition` left it.

    Errors name `origin` and topic.

    """

    def __init__(self, origin: str, connection: Connection) -> None:
        self._origin = f'{origin}: messages on {connection.topic!r}'
        self._name, _, data = connection.msgdef.data.partition('\n')
        self._schema = Schema(1, data.encode('latin1'), 'protobuf', self._name)
        ext: Any = connection.ext
        self._is_json = ext.serialization_format == 'json'
        self._decode: Callable[[bytes], Any] | None = None

    def __call__(self, data: bytes) -> Any:
        """Return a message as ROS has it where it is converted."""
        data = bytes(data)  # of a part of a chunk
        if self._is_json:
            message = _from_json(data, self._name)
        else:
            if self._decode is None:
                self._decode = self._protobuf()
            message = self._decode(data)
        _, convert = SCHEMAS.get(self._name, ('', None))
        return convert(message) if convert else message

    def _protobuf(self) -> Callable[[bytes], Any]:
        try:
            from google.protobuf.message import DecodeError
            from mcap_protobuf.decoder import DecoderFactory
        except ImportError:
            raise RecordingError(
                f'{self._origin} are protobuf, and the package that reads it is not installed: '
                f'pip install mcap-protobuf-support'
            ) from None
        decode = DecoderFactory().decoder_for('protobuf', self._schema)
        if decode is None:
            raise RecordingError(f'{self._origin}: expected a protobuf schema, got none')

        def decode_checked(data: bytes) -> Any:
            try:
                return decode(data)
            except DecodeError as error:
                raise UnsupportedMessage(str(error)) from None

        return decode_checked


def _from_json(data: bytes, schema_name: str) -> Any:
    """Return a JSON object with attributes; UnsupportedMessage if it does not fit the schema."""
    try:
        message = json.loads(data, object_hook=lambda fields: SimpleNamespace(**fields))
    # ValueError: JSONDecodeError and UnicodeDecodeError, also integers of too many digits.
    except (ValueError, RecursionError) as error:
        raise UnsupportedMessage(f'not JSON: {error}') from None
    _check_types(message, JSON_FIELDS.get(schema_name, {}), schema_name)
    return message


def _check_types(value: Any, expected: Any, name: str) -> None:
    """
    Check the types of JSON fields, which no decoder has checked, unlike those of protobuf.

    Fields that are missing or not in `expected` are left to those who read them.

    """
    if isinstance(expected, dict):
        if not isinstance(value, SimpleNamespace):
            raise UnsupportedMessage(f'{name}: expected an object, got {value!r:.40}')
        for key, inner in expected.items():
            field = key.removesuffix('?')
            item = getattr(value, field, None)
            may_be_absent = key.endswith('?') or not hasattr(value, field)
            if item is not None or not may_be_absent:
                _check_types(item, inner, f'{name}.{field}')
    elif isinstance(expected, list):
        if not isinstance(value, list):
            raise UnsupportedMessage(f'{name}: expected a list, got {value!r:.40}')
        for i, item in enumerate(value):
            _check_types(item, expected[0], f'{name}[{i}]')
    elif isinstance(value, int) and abs(value) > MAX_INTEGER:
        raise UnsupportedMessage(f'{name}: expected a number of 64 bits, got a larger one')
    elif isinstance(value, bool) or not isinstance(value, expected):
        kinds = expected if isinstance(expected, tuple) else (expected,)
        wanted = ' or '.join(kind.__name__ for kind in kinds)
        raise UnsupportedMessage(f'{name}: expected {wanted}, got {value!r:.40}')


def encoded(message: Any) -> bytes:
    """Return the bytes of a message that is protobuf, or else JSON."""
    if hasattr(message, 'SerializeToString'):
        return bytes(message.SerializeToString())
    return json.dumps(message, default=vars).encode()


def time_of(time: Any) -> SimpleNamespace:
    """Return a time of protobuf or JSON as ROS has it."""
    if hasattr(time, 'nanos'):
        return SimpleNamespace(sec=time.seconds, nanosec=time.nanos)
    return SimpleNamespace(sec=time.sec, nanosec=time.nsec)


def _cloud(message: Any) -> Any:
    """Return a foxglove PointCloud as a PointCloud2."""
    data = _cloud_data(message)
    fields = [_field(field) for field in message.fields]
    stride = message.point_stride
    if stride < 0:
        raise UnsupportedMessage(f'PointCloud.point_stride: expected 0 or more, got {stride}')
    return SimpleNamespace(
        header=_header(message), height=1, width=len(data) // stride if stride else 0,
        fields=fields, is_bigendian=False, point_step=stride, row_step=len(data), data=data,
        is_dense=False,
    )  # fmt: skip


def _compressed_cloud(message: Any) -> Any:
    """Return a foxglove CompressedPointCloud as the ROS message of that name."""
    return SimpleNamespace(
        timestamp=time_of(message.timestamp), frame_id=message.frame_id, format=message.format,
        data=_cloud_data(message),
    )  # fmt: skip


def _cloud_data(message: Any) -> bytes:
    """Return the bytes of a cloud, whose pose is that of its frame."""
    pose = getattr(message, 'pose', None)
    if pose is not None:
        p, q = pose.position, pose.orientation
        if any((p.x, p.y, p.z, q.x, q.y, q.z)):
            raise UnsupportedMessage(
                'PointCloud: expected its pose to be that of its frame, got another; publish the '
                'pose as a transform'
            )
    return _bytes_of(message)


def _bytes_of(message: Any) -> bytes:
    """Return the data of a message, which are base64 in JSON."""
    if not isinstance(message.data, str):
        return bytes(message.data)
    try:
        return b64decode(message.data)
    except ValueError as error:
        raise UnsupportedMessage(f'data: expected base64: {error}') from None


def _compressed_image(message: Any) -> Any:
    """Return a foxglove CompressedImage as the ROS message of that name."""
    return SimpleNamespace(header=_header(message), format=message.format, data=_bytes_of(message))


def _raw_image(message: Any) -> Any:
    """Return a foxglove RawImage as an Image."""
    return SimpleNamespace(
        header=_header(message), height=message.height, width=message.width,
        encoding=message.encoding, is_bigendian=False, step=message.step,
        data=_bytes_of(message),
    )  # fmt: skip


def _header(message: Any) -> Any:
    return SimpleNamespace(stamp=time_of(message.timestamp), frame_id=message.frame_id)


def _calibration(message: Any) -> Any:
    """Return a foxglove CameraCalibration as a CameraInfo."""
    names = ('width', 'height', 'distortion_model')
    own = {name: getattr(message, name) for name in names}
    matrices = {name.lower(): getattr(message, name, ()) for name in 'DKRP'}
    return SimpleNamespace(header=_header(message), **own, **matrices)


def _field(field: Any) -> Any:
    """Return a PackedElementField as a PointField."""
    if not 0 <= field.type < len(DATATYPES) or field.offset < 0:
        raise UnsupportedMessage(
            f'PointCloud: field {field.name!r}: expected a type from 1 to 8 at an offset from 0, '
            f'got type {field.type} at {field.offset}'
        )
    return SimpleNamespace(
        name=field.name, offset=field.offset, datatype=DATATYPES[field.type], count=1
    )


def _transforms(message: Any) -> Any:
    """Return foxglove's FrameTransform, or FrameTransforms, as a TFMessage."""
    return SimpleNamespace(
        transforms=[
            SimpleNamespace(
                header=SimpleNamespace(stamp=time_of(t.timestamp), frame_id=t.parent_frame_id),
                child_frame_id=t.child_frame_id,
                transform=SimpleNamespace(translation=t.translation, rotation=t.rotation),
            )
            for t in getattr(message, 'transforms', [message])
        ]
    )


def _odometry(message: Any) -> Any:
    """Return a foxglove Odometry as that of ROS, without the velocities, which are not read."""
    return SimpleNamespace(
        header=_header(message), child_frame_id=message.body_frame_id,
        pose=SimpleNamespace(pose=message.pose),
    )  # fmt: skip


SCHEMAS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    'foxglove.SceneUpdate': ('foxglove_msgs/msg/SceneUpdate', lambda message: message),
    'foxglove.PointCloud': ('sensor_msgs/msg/PointCloud2', _cloud),
    'foxglove.CompressedPointCloud': (
        'foxglove_msgs/msg/CompressedPointCloud',
        _compressed_cloud,
    ),
    'foxglove.FrameTransform': ('tf2_msgs/msg/TFMessage', _transforms),
    'foxglove.FrameTransforms': ('tf2_msgs/msg/TFMessage', _transforms),
    'foxglove.Odometry': ('nav_msgs/msg/Odometry', _odometry),
    'foxglove.CompressedImage': ('sensor_msgs/msg/CompressedImage', _compressed_image),
    'foxglove.RawImage': ('sensor_msgs/msg/Image', _raw_image),
    'foxglove.CameraCalibration': ('sensor_msgs/msg/CameraInfo', _calibration),
}
"""ROS types that messages are read as, and what converts them."""
