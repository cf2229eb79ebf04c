#!/usr/bin/env bash
# guess: the labels that from_kitti of Scalabel gives for the LiDAR have the heading of the car in the frame of the LiDAR.
# happens: it takes the angle of x and z, as in the frame of the camera, where z of the LiDAR is up. Cars that head to -45, -135 and
#          -107 degrees get -88.5, 91.5 and 91.5 (and 0 for -90): what differs is the tilt of the camera, not the way that they head.
# versions: scalabel 0.3.1, pydantic 1.10.26, numpy 2.4.6, scipy 1.17.1
# date: 2026-12-02
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check pydantic==1.10.26 numpy==2.4.6 scipy==1.17.1 pillow joblib tqdm pyyaml toml \
    matplotlib pycocotools scikit-image tabulate plyfile nanoid requests boto3 psutil pandas python-dateutil
# Of its other requirements the conversion needs none.
"$folder/venv/bin/pip" install -q --disable-pip-version-check --no-deps scalabel==0.3.1
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
from importlib.metadata import version
import math

import numpy as np
from scalabel.label.from_kitti import parse_lidar_labels
from scalabel.label.typing import Box3D, Label
from scalabel.label.utils import get_extrinsics_from_matrix, get_matrix_from_extrinsics
from scipy.spatial.transform import Rotation

print('scalabel', version('scalabel'), 'numpy', version('numpy'))

# LiDAR: x ahead, y left, z up; camera of KITTI: x right, y down, z ahead, here tilted by 1.5 degrees.
camera_from_lidar = np.eye(4)
axes = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
camera_from_lidar[:3, :3] = Rotation.from_euler('x', 1.5, degrees=True).as_matrix() @ axes
camera_from_lidar[:3, 3] = 0.0, -0.08, -0.27
extrinsics = get_extrinsics_from_matrix(camera_from_lidar)
assert np.allclose(get_matrix_from_extrinsics(extrinsics), camera_from_lidar)

found = {}
for rotation_y in (-math.pi / 4, 0.0, 0.3, math.pi / 4):
    ahead = camera_from_lidar[:3, :3].T @ [math.cos(rotation_y), 0.0, -math.sin(rotation_y)]
    box = Box3D(orientation=(0, rotation_y, 0), location=(2, 0.85, 10), dimension=(1.5, 1.8, 4.5), alpha=0)
    (label,) = parse_lidar_labels([Label(id='1', category='car', box3d=box)], extrinsics)
    heading = math.degrees(math.atan2(ahead[1], ahead[0]))
    found[round(heading)] = round(math.degrees(label.box3d.orientation[1]), 1)
    print(f'heading {heading:7.1f} degrees, Scalabel {math.degrees(label.box3d.orientation[1]):7.1f}')
assert found == {-45: -88.5, -90: 0.0, -107: 91.5, -135: 91.5}
PYTHON
