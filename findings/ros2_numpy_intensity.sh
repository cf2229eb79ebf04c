#!/usr/bin/env bash
# guess: numpify of ros2_numpy returns as 'intensity' of a PointCloud2 what its field of this name has.
# happens: it takes the number of the field for its place in bytes, and two of them for a whole number: of x, y, z, intensity, the layout
#          of most LiDARs, it returns the last byte of x with the first one of y.
# versions: ros2-numpy 0.0.5, ros-jazzy-common-interfaces 5.3.6, numpy 1.24.2
# date: 2026-12-02
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check 'ros-jazzy-rclpy[fastrtps]==7.1.6' ros-jazzy-common-interfaces==5.3.6 \
    ros2-numpy==0.0.5 numpy==1.24.2
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

import numpy as np
import ros2_numpy
from sensor_msgs.msg import PointCloud2, PointField

print('ros2-numpy', version('ros2-numpy'), 'numpy', version('numpy'))
names = 'x', 'y', 'z', 'intensity'
points = np.array([(10, 2, 0.5, 7), (20, 3, 0.5, 80), (40, 5, 0.5, 255)], [(name, '<f4') for name in names])
fields = [PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1) for k, name in enumerate(names)]
cloud = PointCloud2(height=1, width=3, fields=fields, point_step=16, row_step=48, data=points.tobytes(), is_dense=True)

read = ros2_numpy.numpify(cloud)
print('coordinates:', read['xyz'].tolist())
print('intensities:', points['intensity'].tolist(), 'read as', read['intensity'].ravel().tolist())
assert np.array_equal(read['xyz'], np.stack([points[name] for name in 'xyz'], axis=1))
of_bytes = np.frombuffer(points.tobytes(), np.uint8).reshape(3, 16)
assert np.array_equal(read['intensity'].ravel(), of_bytes[:, 3] + 256 * of_bytes[:, 4].astype(int))
assert not np.any(read['intensity'].ravel() == points['intensity'])
PYTHON
