"""
Drift of KISS-ICP with all points, and with the clouds that boxreg_ros has cleaned.

    pip install kiss-icp
    boxreg relabel DRIVE.mcap -o OUT --clouds static
    python slam_without_moving.py DRIVE.mcap OUT/clouds/static.mcap

The second recording may also be that of the topic ``static_points`` of the live node. Without
arguments a street is simulated and cleaned first. The odometry of the drive is the reference.

"""

from pathlib import Path
import sys
from tempfile import TemporaryDirectory
from typing import Any

from boxreg_ros import cli
from boxreg_ros.rotations import matrix_from_quaternion
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP
from msg_adapters import pointcloud
import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

CLOUD, ODOMETRY = 'sensor_msgs/msg/PointCloud2', 'nav_msgs/msg/Odometry'


def positions_of(recording: Path) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return stamps (n,) [ns], and positions (n, 3) of KISS-ICP in the first sensor frame [m]."""
    config = KISSConfig()
    config.data.deskew = False
    config.data.min_range = 1.0
    config.mapping.voxel_size = 0.5
    slam = KissICP(config)
    stamps, positions = [], []
    with AnyReader([recording]) as reader:
        clouds = [item for item in reader.connections if item.msgtype == CLOUD]
        for connection, _, data in reader.messages(clouds):
            sweep = pointcloud.from_msg(reader.deserialize(data, connection.msgtype))
            slam.register_frame(sweep.points.astype(np.float64), np.zeros(0))
            stamps.append(sweep.stamp_ns)
            positions.append(slam.last_pose[:3, 3].copy())
    return np.array(stamps), np.array(positions)


def reference_of(recording: Path) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return stamps (n,) [ns], and the same positions by the odometry of the sensor [m]."""
    stamps, positions, turns = [], [], []
    with AnyReader([recording]) as reader:
        sources = [item for item in reader.connections if item.msgtype == ODOMETRY]
        for connection, _, data in reader.messages(sources):
            message: Any = reader.deserialize(data, connection.msgtype)
            place, turn = message.pose.pose.position, message.pose.pose.orientation
            stamps.append(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)
            positions.append([place.x, place.y, place.z])
            turns.append([turn.x, turn.y, turn.z, turn.w])
    R = matrix_from_quaternion(np.array(turns[0]))
    return np.array(stamps), (np.array(positions) - positions[0]) @ R


def main(drive: Path, cleaned: Path) -> None:
    """Print the drift of both recordings."""
    known, reference = reference_of(drive)
    for name, recording in (('all points', drive), ('without moving objects', cleaned)):
        stamps, positions = positions_of(recording)
        true = np.column_stack([np.interp(stamps, known, axis) for axis in reference.T])
        errors = np.linalg.norm(positions - true, axis=1)
        path = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
        rms = np.sqrt(np.mean(errors**2))
        print(f'{name}: drift {errors[-1]:.3f} m, rms {rms:.3f} m, of {path:.1f} m')


if __name__ == '__main__':
    if len(sys.argv) == 3:
        main(Path(sys.argv[1]), Path(sys.argv[2]))
    else:
        with TemporaryDirectory() as folder:
            drive, out = Path(folder, 'street.mcap'), Path(folder, 'out')
            cli.main(['simulate', '-o', str(drive)])
            cli.main(['relabel', str(drive), '-o', str(out), '--clouds', 'static'])
            main(drive, out / 'clouds' / 'static.mcap')
