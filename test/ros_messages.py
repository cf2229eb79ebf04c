"""Messages and recordings for tests, made with rosbags only."""

from functools import cache
from pathlib import Path

from boxreg_ros.io.definitions import INTERFACES
import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

RELEASES = ('jazzy', 'humble')

POINTS = 'sensor_msgs/msg/PointCloud2'
DETECTIONS = 'vision_msgs/msg/Detection3DArray'
MARKERS = 'visualization_msgs/msg/MarkerArray'
TF = 'tf2_msgs/msg/TFMessage'
ODOMETRY = 'nav_msgs/msg/Odometry'
TRACKED = 'autoware_perception_msgs/msg/TrackedObjects'
DETECTED = 'autoware_perception_msgs/msg/DetectedObjects'
PREDICTED = 'autoware_perception_msgs/msg/PredictedObjects'
AUTO_TRACKED, AUTO_DETECTED, AUTO_PREDICTED = (
    name.replace('autoware_', 'autoware_auto_') for name in (TRACKED, DETECTED, PREDICTED)
)
OBJECTS = 'derived_object_msgs/msg/ObjectArray'
OBJECTS_WITH_COVARIANCE = 'derived_object_msgs/msg/ObjectWithCovarianceArray'
SCENE = 'foxglove_msgs/msg/SceneUpdate'
JSK = 'jsk_recognition_msgs/msg/BoundingBoxArray'
BOXES = 'vision_msgs/msg/BoundingBox3DArray'
ZEROS = {'string': '', 'bool': False, 'float32': 0.0, 'float64': 0.0}
NUMBERS = {'i1': 1, 'u1': 2, 'i2': 3, 'u2': 4, 'i4': 5, 'u4': 6, 'f4': 7, 'f8': 8}


@cache
def typestore(stock=Stores.ROS2_JAZZY):
    """Return a typestore with the stock types and the packages in ``msg_adapters/interfaces``."""
    return with_interfaces(get_typestore(stock), RELEASES)


def with_interfaces(store, releases):
    """Register the packages of releases, the first before the others, in a typestore."""
    extra = {}
    for release in releases:
        for file in (INTERFACES / release).glob('*/msg/*.msg'):
            name = f'{file.parts[-3]}/msg/{file.stem}'
            if name not in store.types and name not in extra:
                extra.update(get_types_from_msg(file.read_text(), name))
    store.register(extra)
    return store


class Messages:
    """Makes messages of one typestore (ROS 2 Jazzy, or ROS 1 Noetic)."""

    def __init__(self, ros1=False):
        self.ros1 = ros1
        self.store = typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)

    def make(self, type_name, /, **fields):
        return self.store.types[type_name](**fields)

    def build(self, type_name, /, **values):
        """Return a message of these values, nested messages as dicts; other fields are zero."""
        fields = {
            name: self._value(node, values.pop(name, None))
            for name, node in self.store.fielddefs[type_name][1]
        }
        assert not values, f'{type_name} has no {", ".join(values)}'
        return self.make(type_name, **fields)

    def _value(self, node, given):
        kind, args = node
        if kind == Nodetype.NAME:
            if given is not None and not isinstance(given, dict):
                return given
            return self.build(args, **(given or {}))
        if kind == Nodetype.BASE:
            zero = ZEROS.get(args[0], 0)
            return zero if given is None else given
        element, count = args
        if given is None:
            given = [None] * (count if kind == Nodetype.ARRAY else 0)
        if element[0] == Nodetype.BASE and element[1][0] != 'string':
            return np.array([item or 0 for item in given], element[1][0])
        return [self._value(element, item) for item in given]

    def boxes(self, type_name, stamp_ns, frame_id, found):
        """
        Return an array of any type that the adapters read, with its other fields filled.

        `found` are tuples (track number, (position, quaternion), size).

        """
        header = self.header(stamp_ns, frame_id)
        numbers = [number for number, _, _ in found]
        poses = [self.pose(*pose) for _, pose, _ in found]
        sizes = [self.vector(*size) for _, _, size in found]
        if type_name == DETECTIONS:
            items = [(str(n), 'car', 0.9, *pose, size) for n, pose, size in found]
            return self.detections(stamp_ns, frame_id, items)
        if type_name == MARKERS:
            items = [self.marker(stamp_ns, frame_id, n, 'car', p, s) for n, p, s in found]
            return self.markers(items)
        make, kind = ITEMS[type_name]
        items = [make(header, *item) for item in zip(numbers, poses, sizes, strict=True)]
        return self.build(
            type_name, **({} if type_name == SCENE else {'header': header}), **{kind: items}
        )

    def header(self, stamp_ns, frame_id):
        sec, nanosec = divmod(stamp_ns, 10**9)
        stamp = {'sec': sec, 'nanosec': nanosec}
        return self.build('std_msgs/msg/Header', stamp=stamp, frame_id=frame_id)

    def vector(self, x, y, z):
        return self.make('geometry_msgs/msg/Vector3', x=float(x), y=float(y), z=float(z))

    def pose(self, position=(0, 0, 0), quaternion_xyzw=(0, 0, 0, 1)):
        return self.build(
            'geometry_msgs/msg/Pose',
            position=dict(zip('xyz', map(float, position), strict=True)),
            orientation=dict(zip('xyzw', map(float, quaternion_xyzw), strict=True)),
        )

    def cloud(self, stamp_ns, frame_id, columns, order='<', height=1, padding=0, row_padding=0):
        """Return a PointCloud2; `columns` is a list of (name, type like 'f4', values)."""
        width = len(columns[0][2]) // height
        names, kinds, values = zip(*columns, strict=True)
        layout = np.dtype(
            {
                'names': names,
                'formats': [order + kind for kind in kinds],
                'offsets': np.cumsum([0, *(int(k[1]) for k in kinds)])[:-1].tolist(),
                'itemsize': sum(int(k[1]) for k in kinds) + padding,
            }
        )
        table = np.zeros((height, width), layout)
        for name, value in zip(names, values, strict=True):
            table[name] = np.reshape(value, (height, width))
        rows = [row.tobytes() + b'\xff' * row_padding for row in table]
        fields = [
            self.make(
                'sensor_msgs/msg/PointField',
                name=name, offset=layout.fields[name][1], datatype=NUMBERS[kind], count=1,
            )
            for name, kind in zip(names, kinds, strict=True)
        ]  # fmt: skip
        return self.make(
            POINTS,
            header=self.header(stamp_ns, frame_id), height=height, width=width, fields=fields,
            is_bigendian=order == '>', point_step=layout.itemsize,
            row_step=layout.itemsize * width + row_padding,
            data=np.frombuffer(b''.join(rows), np.uint8), is_dense=False,
        )  # fmt: skip

    def points(self, stamp_ns, frame_id, xyz):
        xyz = np.asarray(xyz, np.float32).reshape(-1, 3)
        columns = [(name, 'f4', xyz[:, i]) for i, name in enumerate('xyz')]
        return self.cloud(stamp_ns, frame_id, columns)

    def detections(self, stamp_ns, frame_id, boxes):
        """Return a Detection3DArray; `boxes` are (id, class, score, position, quat, size)."""
        items = []
        for track, class_name, score, position, quaternion_xyzw, size in boxes:
            pose = self.pose(position, quaternion_xyzw)
            results = [
                {'hypothesis': {'class_id': name, 'score': value}, 'pose': {'pose': pose}}
                for name, value in (('unlikely', 0.01), (class_name, score))
            ]
            header = self.header(stamp_ns, frame_id)
            bbox = {'center': pose, 'size': self.vector(*size)}
            items.append({'header': header, 'results': results, 'bbox': bbox, 'id': track})
        return self.build(DETECTIONS, header=self.header(stamp_ns, frame_id), detections=items)

    def marker(self, stamp_ns, frame_id, track, class_name, pose, size, kind=1, action=0):
        return self.build(
            'visualization_msgs/msg/Marker',
            header=self.header(stamp_ns, frame_id), ns=class_name, id=track, type=kind,
            action=action, pose=self.pose(*pose), scale=self.vector(*size),
            color={'g': 1.0, 'a': 0.5},
        )  # fmt: skip

    def markers(self, markers):
        return self.make(MARKERS, markers=markers)

    def transform(self, stamp_ns, parent, child, position=(0, 0, 0), quaternion_xyzw=(0, 0, 0, 1)):
        rotation = self.pose(position, quaternion_xyzw).orientation
        return self.build(
            'geometry_msgs/msg/TransformStamped',
            header=self.header(stamp_ns, parent), child_frame_id=child,
            transform={'translation': self.vector(*position), 'rotation': rotation},
        )  # fmt: skip

    def tf(self, *transforms):
        return self.make(TF, transforms=list(transforms))

    def odometry(self, stamp_ns, parent, child, position=(0, 0, 0), quaternion_xyzw=(0, 0, 0, 1)):
        return self.build(
            ODOMETRY, header=self.header(stamp_ns, parent), child_frame_id=child,
            pose={'pose': self.pose(position, quaternion_xyzw)},
        )  # fmt: skip


def _autoware(header, number, pose, size):
    motion = {'linear': {'x': 3.0, 'y': 0.5}, 'angular': {'z': 0.1}}
    corners = [{'x': 0.5 * size.x, 'y': 0.5 * size.y}, {'x': -0.5 * size.x, 'y': 0.5 * size.y}]
    return {
        'existence_probability': 0.75,
        'classification': [{'label': 7, 'probability': 0.25}, {'label': 1, 'probability': 0.75}],
        'kinematics': {
            'pose_with_covariance': {'pose': pose, 'covariance': 0.5 * np.eye(6).reshape(36)},
            'twist_with_covariance': {'twist': motion},
            'orientation_availability': 2,
        },
        'shape': {'dimensions': size, 'footprint': {'points': corners}},
    }


def _tracked(header, number, pose, size):
    item = _autoware(header, number, pose, size)
    accel = {'accel': {'linear': {'x': 0.25}}}
    item['kinematics'] |= {'acceleration_with_covariance': accel, 'is_stationary': True}
    return item | {'object_id': {'uuid': [0] * 15 + [number]}}


def _predicted(header, number, pose, size):
    item = _tracked(header, number, pose, size)
    names = ('pose_with_covariance', 'twist_with_covariance', 'acceleration_with_covariance')
    initial = {f'initial_{name}': item['kinematics'][name] for name in names}
    path = {'path': [pose], 'confidence': 0.5}
    return item | {'kinematics': initial | {'predicted_paths': [path]}}


def _object(header, number, pose, size):
    return {
        'header': header, 'id': number, 'detection_level': 1, 'object_classified': True,
        'pose': pose, 'twist': {'linear': {'x': 3.0}}, 'accel': {'linear': {'y': 0.25}},
        'polygon': {'points': [{'x': 1.0}]},
        'shape': {'type': 1, 'dimensions': [size.x, size.y, size.z]},
        'classification': 6, 'classification_certainty': 204, 'classification_age': 9,
    }  # fmt: skip


def _object_with_covariance(header, number, pose, size):
    item = _object(header, number, pose, size)
    item['pose'] = {'pose': pose, 'covariance': 0.5 * np.eye(6).reshape(36)}
    item['twist'], item['accel'] = {'twist': item['twist']}, {'accel': item['accel']}
    item['shape']['covariance'] = [0.25] * 9
    return item


def _entity(header, number, pose, size):
    notes = {'class': 'car', 'score': '0.75', 'user': 'kept'}
    return {
        'timestamp': header.stamp, 'frame_id': header.frame_id, 'id': str(number),
        'metadata': [{'key': key, 'value': value} for key, value in notes.items()],
        'cubes': [{'pose': pose, 'size': size, 'color': {'g': 1.0, 'a': 0.5}}],
        'texts': [{'pose': pose, 'text': 'a car'}],
    }  # fmt: skip


def _jsk(header, number, pose, size):
    return {'header': header, 'pose': pose, 'dimensions': size, 'value': 0.75, 'label': 3}


def _bare(header, number, pose, size):
    return {'center': pose, 'size': size}


ITEMS = {
    TRACKED: (_tracked, 'objects'),
    DETECTED: (_autoware, 'objects'),
    PREDICTED: (_predicted, 'objects'),
    AUTO_TRACKED: (_tracked, 'objects'),
    AUTO_DETECTED: (_autoware, 'objects'),
    AUTO_PREDICTED: (_predicted, 'objects'),
    OBJECTS: (_object, 'objects'),
    OBJECTS_WITH_COVARIANCE: (_object_with_covariance, 'objects'),
    SCENE: (_entity, 'entities'),
    JSK: (_jsk, 'boxes'),
    BOXES: (_bare, 'boxes'),
}


def write_recording(
    path, items, storage='mcap', messages=None, compression=None, chunk_bytes=None
):
    """
    Write (topic, received_ns, message) as a recording and return its path.

    `storage` is ``mcap`` (one file), ``mcap-folder``, ``sqlite3`` (a folder) or ``rosbag1``.
    rosbag2 folders may have a `compression` by zstd, ROS 1 bags chunks of another size.

    """
    path = Path(path)
    store = (messages or Messages(ros1=storage == 'rosbag1')).store
    if storage == 'rosbag1':
        path = path.with_suffix('.bag')
        writer = Writer1(path)
        writer.chunk_threshold = chunk_bytes or writer.chunk_threshold
    else:
        plugin = StoragePlugin.SQLITE3 if storage == 'sqlite3' else StoragePlugin.MCAP
        writer = Writer(path, version=9, storage_plugin=plugin)
        if compression is not None:
            writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, received_ns, message in items:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            to_bytes = store.serialize_ros1 if storage == 'rosbag1' else store.serialize_cdr
            writer.write(connections[topic], received_ns, to_bytes(message, kind))
    if storage == 'mcap':
        (inner,) = path.glob('*.mcap')
        return inner
    return path


SECOND = 10**9
START = 1_700_000_000 * SECOND


class Drive:
    """
    A car with a LiDAR 2 m above its base drives along x past a parked and a moving car.

    `items` are (topic, received_ns, message) in order; `truth` has, per stamp, the true boxes
    (2, 9) in frame odom: of track 1, parked, and of track 2, moving.

    """

    def __init__(self, sweeps=8, boxes='vision', motion='tf', ros1=False, seed=5, start=START):
        self.messages = m = Messages(ros1)
        self.items, self.truth, self.stamps = [], {}, []
        rng = np.random.default_rng(seed)
        self.items.append(
            ('/tf_static', start, m.tf(m.transform(start, 'base', 'lidar', (0, 0, 2))))
        )
        for k in range(sweeps):
            stamp = start + k * SECOND // 10
            self.stamps.append(stamp)
            ego = np.array([0.5 * k, 0.0, 0.0])
            sensor = ego + np.array([0.0, 0.0, 2.0])
            true = np.array(
                [
                    [10.0, 4.0, 0.8, 4.2, 1.8, 1.6, 0, 0, 0.1],
                    [15.0 + 0.8 * k, -3.0, 0.9, 4.6, 1.9, 1.8, 0, 0, 0.0],
                ]
            )
            self.truth[stamp] = true
            if motion == 'tf':
                message = m.tf(m.transform(stamp, 'odom', 'base', ego))
                self.items.append(('/tf', stamp, message))
            elif motion == 'odometry':
                self.items.append(('/odom', stamp, m.odometry(stamp, 'odom', 'base', ego)))
            surface = np.concatenate([_surface(box, rng) for box in true]) - sensor
            self.items.append(('/points', stamp, m.points(stamp, 'lidar', surface)))
            noisy = true + rng.normal(0, 0.05, true.shape) * [1, 1, 1, 0, 0, 0, 0, 0, 0.3]
            self.items.append(('/boxes', stamp, self._boxes(boxes, stamp, noisy, sensor)))

    def _boxes(self, kind, stamp, boxes, sensor):
        found = []
        for track, box in enumerate(boxes, start=1):
            half = box[8] / 2
            pose = (box[:3] - sensor, (0, 0, np.sin(half), np.cos(half)))
            found.append((track, pose, box[3:6]))
        type_name = {'vision': DETECTIONS, 'markers': MARKERS}.get(kind, kind)
        return self.messages.boxes(type_name, stamp, 'lidar', found)

    def replace(self, topic, index, change):
        """Apply `change` to the message number `index` on a topic."""
        at = [i for i, item in enumerate(self.items) if item[0] == topic][index]
        change(self.items[at][2])

    def add_ghost(self, index):
        """Add a box of track 9, far from all points, to message number `index` of boxes."""

        def add(message):
            (ghost,) = self.messages.boxes(
                DETECTIONS, 0, 'lidar', [(9, ((30, 30, 0), (0, 0, 0, 1)), (4, 2, 1.5))]
            ).detections
            ghost.header = message.detections[0].header
            message.detections.append(ghost)

        self.replace('/boxes', index, add)

    def write(self, path, storage='mcap'):
        """Write the recording as it is received and return its path."""
        received = sorted(self.items, key=lambda item: item[1])
        return write_recording(path, received, storage, self.messages)


def _surface(box, rng):
    """Return points on the sides of a box with yaw only."""
    unit = rng.uniform(-0.5, 0.5, (120, 3))
    side = np.arange(120) % 2
    unit[np.arange(120), side] = -0.5 * np.sign([box[0], box[1]])[side]
    cos, sin = np.cos(box[8]), np.sin(box[8])
    local = unit * box[3:6]
    turned = np.stack(
        [cos * local[:, 0] - sin * local[:, 1], sin * local[:, 0] + cos * local[:, 1]]
    )
    return np.column_stack([*turned, local[:, 2]]) + box[:3]
