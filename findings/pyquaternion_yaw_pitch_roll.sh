#!/usr/bin/env bash
# guess: yaw_pitch_roll, "intrinsic Tait-Bryan angles following the z-y'-x'' convention", are those of R = Rz Ry Rx.
# happens: they are those of R = Rx Ry Rz: the yaw of a box that is tilted is not its heading.
# versions: pyquaternion 0.9.9, numpy 2.4.6, scipy 1.17.1
# date: 2026-12-01
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check pyquaternion==0.9.9 numpy==2.4.6 scipy==1.17.1
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from pyquaternion import Quaternion
from scipy.spatial.transform import Rotation

print('pyquaternion', version('pyquaternion'), 'scipy', version('scipy'))

# A truck on a ramp of 10 degrees that leans by 5: heading 20 degrees.
given = np.radians([20, -10, 5])
x, y, z, w = Rotation.from_euler('ZYX', given).as_quat()
truck = Quaternion(w, x, y, z)
angles = np.array(truck.yaw_pitch_roll)
forward = truck.rotate(np.array([1.0, 0.0, 0.0]))
heading = np.degrees(np.arctan2(forward[1], forward[0]))
print('heading', heading.round(2), 'yaw of yaw_pitch_roll', np.degrees(angles[0]).round(2))
assert np.isclose(heading, 20)
assert abs(np.degrees(angles[0]) - heading) > 0.5

rotation = truck.rotation_matrix
assert not np.allclose(Rotation.from_euler('ZYX', angles).as_matrix(), rotation)
assert np.allclose(Rotation.from_euler('XYZ', angles[::-1]).as_matrix(), rotation)
PYTHON
