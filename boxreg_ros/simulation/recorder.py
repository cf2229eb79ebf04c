"""Write sweeps, boxes and the motion of the sensor as an MCAP recording."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
import tempfile
from typing import Any

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.recording import VISION_DEFINITIONS
from boxreg_ros.rotations import matrix_from_rpy, quaternion_from_matrix
from boxreg_ros.structures import BoxArray, Floats, LENGTH, ROLL, Sweep
import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

TF_DEFINITION = {'tf2_msgs/msg/TFMessage': 'geometry_msgs/TransformStamped[] transforms'}


def write_recording(
    path: Path,
    sweeps: Iterable[Sweep],
    intensities: Iterable[NDArray[Any]],
    detections: Iterable[BoxArray],
    T_fixed_sensor: Iterable[Floats],
    fixed_frame: str,
    is_compressed: bool = False,
) -> None:
    """
    Write ``/points``, ``/detections``, ``/odom`` and ``/tf``; an old file is replaced at the end.

    Parameters
    ----------
    path : Path
        Ends in ``.mcap``.
    sweeps, intensities, detections
        One each per stamp, all in the sensor frame.
    T_fixed_sensor : n arrays, shape (4, 4)
        Pose of the sensor in `fixed_frame` at each stamp.
    fixed_frame : str
        Parent frame of the odometry.
    is_compressed : bool
        Compress by zstd, which `ros2 bag record` does only on request.

    Raises
    ------
    RecordingError
        If `path` does not end in ``.mcap`` or cannot be written.

    """
    if path.suffix != '.mcap':
        raise RecordingError(f'{path}: expected a name that ends in .mcap')
    messages = _Messages()
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f'.{path.stem}-') as folder:
            bag = Path(folder) / path.stem
            writer = Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP)
            if is_compressed:
                writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            with writer:
                topics: dict[str, Any] = {}

                def put(topic: str, message: Any, stamp_ns: int) -> None:
                    name = message.__msgtype__
                    if topic not in topics:
                        topics[topic] = writer.add_connection(
                            topic, name, typestore=messages.store
                        )
                    data = messages.store.serialize_cdr(message, name)
                    writer.write(topics[topic], stamp_ns, data)

                for sweep, intensity, boxes, T in zip(
                    sweeps, intensities, detections, T_fixed_sensor, strict=True
                ):
                    stamp_ns = sweep.stamp_ns
                    frames = (fixed_frame, sweep.frame_id)
                    put('/tf', messages.transform(stamp_ns, *frames, T), stamp_ns)
                    put('/odom', messages.odometry(stamp_ns, *frames, T), stamp_ns)
                    put('/points', messages.cloud(sweep, intensity), stamp_ns)
                    put('/detections', messages.detections(boxes), stamp_ns)
            (bag / path.name).replace(path)
    except OSError as error:
        raise RecordingError(f'{path}: cannot be written: {error}') from None


class _Messages:
    """Makes the messages of the recording."""

    def __init__(self) -> None:
        self.store = get_typestore(Stores.ROS2_JAZZY)
        types: dict[str, Any] = {}
        for name, text in (VISION_DEFINITIONS | TF_DEFINITION).items():
            if name not in self.store.types:
                types.update(get_types_from_msg(text, name))
        self.store.register(types)

    def make(self, kind: str, /, **fields: Any) -> Any:
        package, name = kind.split('/')
        return self.store.types[f'{package}/msg/{name}'](**fields)

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        seconds, rest = divmod(stamp_ns, 10**9)
        stamp = self.make('builtin_interfaces/Time', sec=seconds, nanosec=rest)
        return self.make('std_msgs/Header', stamp=stamp, frame_id=frame_id)

    def numbers(self, kind: str, names: str, values: Floats) -> Any:
        return self.make(kind, **dict(zip(names, map(float, values), strict=True)))

    def pose(self, position: Floats, R: Floats) -> Any:
        quaternion_xyzw = quaternion_from_matrix(R)
        pose = self.make(
            'geometry_msgs/Pose',
            position=self.numbers('geometry_msgs/Point', 'xyz', position),
            orientation=self.numbers('geometry_msgs/Quaternion', 'xyzw', quaternion_xyzw),
        )
        return self.make('geometry_msgs/PoseWithCovariance', pose=pose, covariance=np.zeros(36))

    def transform(self, stamp_ns: int, parent: str, child: str, T: Floats) -> Any:
        pose = self.pose(T[:3, 3], T[:3, :3]).pose
        transform = self.make(
            'geometry_msgs/Transform',
            translation=self.numbers('geometry_msgs/Vector3', 'xyz', T[:3, 3]),
            rotation=pose.orientation,
        )
        stamped = self.make(
            'geometry_msgs/TransformStamped',
            header=self.header(stamp_ns, parent),
            child_frame_id=child,
            transform=transform,
        )
        return self.make('tf2_msgs/TFMessage', transforms=[stamped])

    def odometry(self, stamp_ns: int, parent: str, child: str, T: Floats) -> Any:
        zero = self.numbers('geometry_msgs/Vector3', 'xyz', np.zeros(3))
        twist = self.make('geometry_msgs/Twist', linear=zero, angular=zero)
        return self.make(
            'nav_msgs/Odometry',
            header=self.header(stamp_ns, parent),
            child_frame_id=child,
            pose=self.pose(T[:3, 3], T[:3, :3]),
            twist=self.make(
                'geometry_msgs/TwistWithCovariance', twist=twist, covariance=np.zeros(36)
            ),
        )

    def cloud(self, sweep: Sweep, intensity: NDArray[Any]) -> Any:
        names = ('x', 'y', 'z', 'intensity', 't')
        times = np.zeros(len(intensity)) if sweep.times is None else sweep.times
        table = np.column_stack([sweep.points, intensity, times]).astype('<f4')
        return self.make(
            'sensor_msgs/PointCloud2',
            header=self.header(sweep.stamp_ns, sweep.frame_id),
            height=1,
            width=len(table),
            fields=[
                self.make('sensor_msgs/PointField', name=name, offset=4 * i, datatype=7, count=1)
                for i, name in enumerate(names)
            ],
            is_bigendian=False,
            point_step=4 * len(names),
            row_step=table.nbytes,
            data=np.frombuffer(table.tobytes(), np.uint8),
            is_dense=True,
        )

    def detections(self, boxes: BoxArray) -> Any:
        items = []
        for track_id, class_name, score, box in zip(
            boxes.track_ids, boxes.class_names, boxes.scores, boxes.boxes, strict=True
        ):
            pose = self.pose(box[:3], matrix_from_rpy(box[ROLL:]))
            hypothesis = self.make(
                'vision_msgs/ObjectHypothesis', class_id=class_name, score=float(score)
            )
            result = self.make(
                'vision_msgs/ObjectHypothesisWithPose', hypothesis=hypothesis, pose=pose
            )
            size = self.numbers('geometry_msgs/Vector3', 'xyz', box[LENGTH:ROLL])
            items.append(
                self.make(
                    'vision_msgs/Detection3D',
                    header=self.header(boxes.stamp_ns, boxes.frame_id),
                    results=[result],
                    bbox=self.make('vision_msgs/BoundingBox3D', center=pose.pose, size=size),
                    id=track_id,
                )
            )
        return self.make(
            'vision_msgs/Detection3DArray',
            header=self.header(boxes.stamp_ns, boxes.frame_id),
            detections=items,
        )
