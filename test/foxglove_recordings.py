"""MCAP files of Foxglove's schemas; tests that import this skip if its packages are absent."""

from base64 import b64encode
import json

from mcap.writer import Writer
import pytest

SCHEMAS = 'foxglove_schemas_protobuf'
CameraCalibration = pytest.importorskip(f'{SCHEMAS}.CameraCalibration_pb2').CameraCalibration
CompressedImage = pytest.importorskip(f'{SCHEMAS}.CompressedImage_pb2').CompressedImage
FrameTransforms = pytest.importorskip(f'{SCHEMAS}.FrameTransforms_pb2').FrameTransforms
PointCloud = pytest.importorskip(f'{SCHEMAS}.PointCloud_pb2').PointCloud
RawImage = pytest.importorskip(f'{SCHEMAS}.RawImage_pb2').RawImage
SceneUpdate = pytest.importorskip(f'{SCHEMAS}.SceneUpdate_pb2').SceneUpdate
describe = pytest.importorskip('mcap_protobuf.schema').build_file_descriptor_set

FLOAT32 = 7


def time_of(stamp, encoding):
    """Return a time as the fields of an encoding."""
    if encoding == 'json':
        return {'sec': stamp.sec, 'nsec': stamp.nanosec}
    return {'seconds': stamp.sec, 'nanos': stamp.nanosec}


def plain(message):
    """Return a message as nested dicts."""
    if hasattr(message, '__dict__'):
        return {k: plain(v) for k, v in vars(message).items() if not k.startswith('__')}
    return message


def scene(message, encoding):
    """Return the fields of a SceneUpdate."""
    return {
        'deletions': [],
        'entities': [
            {
                'timestamp': time_of(e.timestamp, encoding), 'frame_id': e.frame_id, 'id': e.id,
                'metadata': [{'key': m.key, 'value': m.value} for m in e.metadata],
                'cubes': [plain(cube) for cube in e.cubes],
            }
            for e in message.entities
        ],
    }  # fmt: skip


def cloud(message, encoding):
    """Return the fields of a PointCloud."""
    data = bytes(message.data)
    return {
        'timestamp': time_of(message.header.stamp, encoding),
        'frame_id': message.header.frame_id,
        'point_stride': message.point_step,
        'fields': [{'name': f.name, 'offset': f.offset, 'type': FLOAT32} for f in message.fields],
        'data': b64encode(data).decode() if encoding == 'json' else data,
    }


def transforms(message, encoding):
    """Return the fields of FrameTransforms."""
    return {
        'transforms': [
            {
                'timestamp': time_of(t.header.stamp, encoding),
                'parent_frame_id': t.header.frame_id, 'child_frame_id': t.child_frame_id,
                'translation': plain(t.transform.translation),
                'rotation': plain(t.transform.rotation),
            }
            for t in message.transforms
        ]
    }  # fmt: skip


def image(message, encoding):
    """Return the fields of a CompressedImage or a RawImage."""
    data = bytes(message.data)
    names = ('format', 'encoding', 'height', 'width', 'step')
    return {
        'timestamp': time_of(message.header.stamp, encoding),
        'frame_id': message.header.frame_id,
        'data': b64encode(data).decode() if encoding == 'json' else data,
        **{name: getattr(message, name) for name in names if hasattr(message, name)},
    }


def calibration(message, encoding):
    """Return the fields of a CameraCalibration."""
    return {
        'timestamp': time_of(message.header.stamp, encoding),
        'frame_id': message.header.frame_id,
        'width': message.width, 'height': message.height,
        'distortion_model': message.distortion_model,
        **{name.upper(): getattr(message, name).tolist() for name in 'dkrp'},
    }  # fmt: skip


KINDS = {
    'foxglove_msgs/msg/SceneUpdate': (SceneUpdate, scene),
    'sensor_msgs/msg/PointCloud2': (PointCloud, cloud),
    'sensor_msgs/msg/CompressedImage': (CompressedImage, image),
    'sensor_msgs/msg/Image': (RawImage, image),
    'sensor_msgs/msg/CameraInfo': (CameraCalibration, calibration),
    'tf2_msgs/msg/TFMessage': (FrameTransforms, transforms),
}


def write_foxglove_mcap(path, drive, encodings):
    """Write a drive; `encodings` maps topics to protobuf, json or cdr; others are as /tf."""
    store = drive.messages.store
    with path.open('wb') as file:
        writer = Writer(file)
        writer.start()
        channels = {}
        for topic, received_ns, message in drive.items:
            kind, convert = KINDS[message.__msgtype__]
            encoding = encodings.get(topic, encodings['/tf'])
            if topic not in channels:
                name, form, text = kind.DESCRIPTOR.full_name, encoding, b'{}'
                if encoding == 'protobuf':
                    text = describe(kind).SerializeToString()
                elif encoding == 'json':
                    form = 'jsonschema'
                else:
                    name, form = message.__msgtype__, 'ros2msg'
                    text = store.generate_msgdef(name, ros_version=2)[0].encode()
                schema = writer.register_schema(name, form, text)
                channels[topic] = writer.register_channel(topic, encoding, schema)
            if encoding == 'cdr':
                data = bytes(store.serialize_cdr(message, message.__msgtype__))
            elif encoding == 'json':
                data = json.dumps(convert(message, encoding)).encode()
            else:
                data = kind(**convert(message, encoding)).SerializeToString()
            writer.add_message(channels[topic], received_ns, data, received_ns)
        writer.finish()
    return path
