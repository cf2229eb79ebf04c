#!/usr/bin/env bash
# guess: Calibration.transform_points brings points of the vehicle's frame into that of the LiDAR, as Box3D.convert_to does boxes.
# happens: it applies the pose of the frame it goes to, not its inverse: right towards the vehicle alone. A point that goes there
#          and back is not where it was, without a word.
# versions: zod 0.8.0, dataclass-wizard 0.35.0, pyquaternion 0.9.9, numpy 2.4.6
# date: 2026-12-02
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check zod==0.8.0 dataclass-wizard==0.35.0 pyquaternion==0.9.9 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from pyquaternion import Quaternion
from zod.constants import EGO, Lidar
from zod.data_classes.calibration import Calibration, LidarCalibration
from zod.data_classes.box import Box3D
from zod.data_classes.geometry import Pose

print('zod', version('zod'), 'pyquaternion', version('pyquaternion'), 'numpy', version('numpy'))

# A LiDAR 2 m above the origin of the vehicle, whose y axis is forward as in the recordings of this data set.
mounting = np.eye(4)
mounting[:3, :3] = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
mounting[:3, 3] = [0, 0, 2]
calibration = Calibration(lidars={Lidar.VELODYNE: LidarCalibration(extrinsics=Pose(mounting))}, cameras={})

seen = np.array([[1.0, 10.0, -2.0]])  # 10 m ahead and 1 m to the right, on the road
in_vehicle = calibration.transform_points(seen, Lidar.VELODYNE, EGO)
back = calibration.transform_points(in_vehicle, EGO, Lidar.VELODYNE)
box = Box3D(in_vehicle[0].copy(), np.array([4.0, 2.0, 1.5]), Quaternion(), EGO)
box.convert_to(Lidar.VELODYNE, calibration)
print('seen:', seen[0], 'in the vehicle:', in_vehicle[0])
print('back in the LiDAR, as a box:', box.center.round(6), 'as a point:', back[0].round(6))
assert np.allclose(in_vehicle, [[10, -1, 0]])
assert np.allclose(box.center, seen[0])
assert np.allclose(back, [[-1, -10, 2]])
PYTHON
