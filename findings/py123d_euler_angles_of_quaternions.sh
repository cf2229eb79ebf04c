#!/usr/bin/env bash
# guess: Quaternion.euler_angles of py123d undoes EulerAngles.quaternion: both are of R = Rz Ry Rx, as the library states of its Euler angles.
# happens: it gives the angles of R = Rx Ry Rz. Of a car on a slope of 5 degrees that heads to +y, pitch comes back as roll of the other sign; of one that
#          heads to 45 degrees 3.5 degrees of either, and a yaw that is 0.11 degrees off. As Euler angles again they are another rotation. Level boxes are right,
#          and so is the way by rotation matrices. PoseSE3.yaw, and with it the boxes seen from above, have this yaw.
# versions: py123d 0.7.0, numpy 2.4.6, scipy 1.17.1, shapely 2.2.0, pyquaternion 0.9.9, typing_extensions 4.15.0
# date: 2026-12-03
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check numpy==2.4.6 scipy==1.17.1 shapely==2.2.0 pyquaternion==0.9.9 typing_extensions==4.15.0
"$folder/venv/bin/pip" install -q --disable-pip-version-check --no-deps py123d==0.7.0 # of its dependencies, those that its geometry imports
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from py123d.geometry import BoundingBoxSE3, EulerAngles, PoseSE3
from scipy.spatial.transform import Rotation

print(*(f'{name} {version(name)}' for name in ('py123d', 'numpy', 'scipy', 'shapely', 'pyquaternion')))


def back(roll, pitch, yaw):
    """Return the angles [degrees] of a quaternion that has been made of these."""
    quaternion = EulerAngles(*np.radians([roll, pitch, yaw])).quaternion
    expected = Rotation.from_euler('ZYX', [yaw, pitch, roll], degrees=True).as_matrix()
    assert np.allclose(quaternion.rotation_matrix, expected)  # the way there is right
    found = quaternion.euler_angles
    angles = np.degrees([found.roll, found.pitch, found.yaw])
    print(f'roll {roll}, pitch {pitch}, yaw {yaw}: back {np.round(angles, 2).tolist()}')
    turned = Rotation.from_euler('XYZ', angles, degrees=True).as_matrix()
    assert np.allclose(turned, expected)  # those of the other order
    return angles


assert np.allclose(back(0, 0, 60), [0, 0, 60])
assert np.allclose(back(0, 5, 90), [-5, 0, 90])
angles = back(0, 5, 45)
assert np.allclose(angles, [-3.53, 3.53, 45.11], atol=0.01)

pose = PoseSE3.from_R_t(EulerAngles(*np.radians([0, 5, 45])), np.zeros(3))
box = BoundingBoxSE3(pose, 10.0, 2.5, 3.0)
heading = np.degrees(np.arctan2(*(box.corners_array[0] - box.corners_array[3])[[1, 0]]))
print(f'corners head to {heading:.2f} degrees, the box seen from above to {np.degrees(box.center_se2.yaw):.2f}')
assert np.isclose(heading, 45) and np.isclose(np.degrees(box.center_se2.yaw), 45.11, atol=0.01)
PYTHON
