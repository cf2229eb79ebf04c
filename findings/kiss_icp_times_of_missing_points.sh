#!/usr/bin/env bash
# guess: the times that KISS-ICP reads with the points of a PointCloud2 are those of the points.
# happens: points that are NaN, as drivers write for beams without an echo, are left out, their times are not: each point after them is
#          compensated by the time of an earlier one, without a word. Of a cloud whose first half is missing, at 10 m/s, the last point,
#          which should stay, is moved by 0.57 m.
# versions: kiss-icp 1.3.0, rosbags 0.11.9, numpy 2.4.6
# date: 2026-12-02
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check kiss-icp==1.3.0 rosbags==0.11.9 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.preprocess import get_preprocessor
from kiss_icp.tools.point_cloud2 import read_point_cloud
from rosbags.typesys import get_typestore, Stores

print('kiss-icp', version('kiss-icp'), 'rosbags', version('rosbags'))
store = get_typestore(Stores.ROS2_JAZZY)
PointCloud2, PointField, Header, Time = (
    store.types[name]
    for name in (
        'sensor_msgs/msg/PointCloud2', 'sensor_msgs/msg/PointField', 'std_msgs/msg/Header', 'builtin_interfaces/msg/Time'
    )
)

# Eight beams of one turn of 0.1 s, of which the first four have no echo.
beams = np.zeros(8, [(name, '<f4') for name in ('x', 'y', 'z', 't')])
angles = np.arange(8) * np.pi / 4
beams['x'], beams['y'], beams['t'] = 10 * np.cos(angles), 10 * np.sin(angles), np.arange(8) / 80
for name in ('x', 'y', 'z'):
    beams[name][:4] = np.nan
fields = [PointField(name, 4 * k, PointField.FLOAT32, 1) for k, name in enumerate(beams.dtype.names)]
header = Header(Time(0, 0), 'lidar')
cloud = PointCloud2(header, 1, 8, fields, False, 16, 128, np.frombuffer(beams.tobytes(), np.uint8), False)
cloud = store.deserialize_cdr(store.serialize_cdr(cloud, cloud.__msgtype__), cloud.__msgtype__)

points, times = read_point_cloud(cloud)
print(len(points), 'points,', len(times), 'times')
assert len(points) == 4 and len(times) == 8

config = KISSConfig()
config.mapping.voxel_size = 1.0
motion = np.eye(4)
motion[0, 3] = 1.0  # 1 m in the turn
preprocessor = get_preprocessor(config)
moved = [preprocessor.preprocess(points, each, motion)[:, 0] - points[:, 0] for each in (times, times[4:])]
print('moved along x with these times:', moved[0].round(2), 'with those of the points:', moved[1].round(2))
assert np.allclose(moved[0], [-1, -6 / 7, -5 / 7, -4 / 7], atol=1e-5)
PYTHON
