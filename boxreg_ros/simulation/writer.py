"""Write sweeps, boxes and the motion of the sensor as an MCAP recording."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
import tempfile
from typing import Any

from boxreg_ros.errors import RecordingError, remedy_of
from boxreg_ros.io.definitions import known_store
from boxreg_ros.rotations import matrix_from_rpy, quaternion_from_matrix
from boxreg_ros.structures import BoxArray, Floats, LENGTH, ROLL, Sweep
from msg_adapters.concatenation import INFO_TYPE
import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

RECORDED_TYPES = (
    'nav_msgs/msg/Odometry',
    'sensor_msgs/msg/PointCloud2',
    'tf2_msgs/msg/TFMessage',
    'vision_msgs/msg/Detection3DArray',
    INFO_TYPE,
)
"""Types of the messages of a recording."""


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
        Of the recording; its name ends in ``.mcap``.
    sweeps : iterable of n Sweep
        In the sensor frame. Their stamps are those of all messages.
    intensities : iterable of n arrays, shape (M,)
        Of the points of each sweep.
    detections : iterable of n BoxArray
        With the stamp and in the frame of each sweep.
    T_fixed_sensor : iterable of n arrays, shape (4, 4)
        Poses of the sensor, written as transform and odometry.
    fixed_frame : str
        Parent of the sensor frame.
    is_compressed : bool
        Whether by zstd, which `ros2 bag record` does only on request.

    Raises
    ------
    RecordingError
        As of `write_messages`.
    ValueError
        If the iterables have different lengths.

    """
    make = LidarMessages()

    def messages() -> Iterator[tuple[str, Any, int]]:
        for sweep, intensity, boxes, T in zip(
            sweeps, intensities, detections, T_fixed_sensor, strict=True
        ):
            stamp_ns = sweep.stamp_ns
            frames = (fixed_frame, sweep.frame_id)
            yield '/tf', make.transform(stamp_ns, *frames, T), stamp_ns
            yield '/odom', make.odometry(stamp_ns, *frames, T), stamp_ns
            yield '/points', make.cloud(sweep, intensity), stamp_ns
            yield '/detections', make.detections(boxes), stamp_ns

    write_messages(path, messages(), is_compressed)


def write_messages(
    path: Path, messages: Iterable[tuple[str, Any, int]], is_compressed: bool = False
) -> None:
    """
    Write messages as an MCAP recording, at the end in one step.

    Parameters
    ----------
    path : Path
        Its name ends in ``.mcap``, its folder exists; an old file is replaced.
    messages : iterable of (str, object, int)
        Topic, message of `LidarMessages`, and time of reception [ns].
    is_compressed : bool
        Whether by zstd.

    Raises
    ------
    RecordingError
        If `path` has another name or cannot be written.

    """
    if path.suffix != '.mcap':
        raise RecordingError(f'{path}: expected a name that ends in .mcap')
    store = LidarMessages().store
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f'.{path.stem}-') as folder:
            bag = Path(folder) / path.stem
            writer = Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP)
            if is_compressed:
                writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            with writer:
                topics: dict[str, Any] = {}
                for topic, message, received_ns in messages:
                    name = message.__msgtype__
                    if topic not in topics:
                        topics[topic] = writer.add_connection(topic, name, typestore=store)
                    writer.write(topics[topic], received_ns, store.serialize_cdr(message, name))
            (bag / path.name).replace(path)
    except OSError as error:
        raise RecordingError(
            f'{path}: cannot be written: {error.strerror}; {remedy_of(error)}'
        ) from None


class LidarMessages:
    """Makes the messages of a recording."""

    def __init__(self) -> None:
        self.store = known_store(RECORDED_TYPES)

    def make(self, kind: str, /, **fields: Any) -> Any:
        """Return a message of a type ``package/Name``."""
        package, name = kind.split('/')
        return self.store.types[f'{package}/msg/{name}'](**fields)

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        """Return a header."""
        seconds, rest = divmod(stamp_ns, 10**9)
        stamp = self.make('builtin_interfaces/Time', sec=seconds, nanosec=rest)
        return self.make('std_msgs/Header', stamp=stamp, frame_id=frame_id)

    def numbers(self, kind: str, names: str, values: Floats) -> Any:
        """Return a message of numbers whose names are the letters of `names`."""
        return self.make(kind, **dict(zip(names, map(float, values), strict=True)))

    def pose(self, position: Floats, R: Floats) -> Any:
        """Return a PoseWithCovariance of a position (3,) and a rotation (3, 3)."""
        quaternion_xyzw = quaternion_from_matrix(R)
        pose = self.make(
            'geometry_msgs/Pose',
            position=self.numbers('geometry_msgs/Point', 'xyz', position),
            orientation=self.numbers('geometry_msgs/Quaternion', 'xyzw', quaternion_xyzw),
        )
        return self.make('geometry_msgs/PoseWithCovariance', pose=pose, covariance=np.zeros(36))

    def transform(self, stamp_ns: int, parent: str, child: str, T: Floats) -> Any:
        """
        Return a transform as ``/tf`` has it.

        Parameters
        ----------
        stamp_ns : int
            Of the transform [ns].
        parent, child : str
            Names of the frames.
        T : array, shape (4, 4)
            T_parent_child: pose of the child in the parent [m].

        Returns
        -------
        message : tf2_msgs/TFMessage
            With this one transform.

        """
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
        """Return an Odometry of T_parent_child (4, 4)."""
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
        """
        Return a cloud with the fields x y z intensity t, as float32.

        Parameters
        ----------
        sweep : Sweep
            Its points are written as they are, in its frame [m]; times relative to its stamp [s],
            zeros without any.
        intensity : array, shape (M,)
            Of its points.

        Returns
        -------
        message : sensor_msgs/PointCloud2
            Unorganised, little-endian.

        """
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
        """Return a Detection3DArray."""
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
