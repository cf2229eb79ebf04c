#!/usr/bin/env bash
# guess: Quaternion.slerp(q0, q1), the interpolation of two poses, leaves unit quaternions as they are.
# happens: where their dot product is negative it changes the sign of q0 in place: a pose from which was interpolated
#          no longer equals its copy, nor what a file says.
# versions: pyquaternion 0.9.9, numpy 2.4.6
# date: 2026-12-01
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check pyquaternion==0.9.9 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from pyquaternion import Quaternion

print('pyquaternion', version('pyquaternion'), 'numpy', version('numpy'))

# Headings of 170 and 190 degrees, each as a unit quaternion with w >= 0, as many files have them.
first = Quaternion(axis=(0, 0, 1), degrees=170)
second = -Quaternion(axis=(0, 0, 1), degrees=190)
kept = Quaternion(first)
middle = Quaternion.slerp(first, second, 0.5)
print('before:', kept.elements.round(3), 'after:', first.elements.round(3))
assert np.isclose(abs(np.degrees(middle.yaw_pitch_roll[0])), 180)  # the way between them is right
assert np.allclose(first.elements, -kept.elements) and not np.allclose(first.elements, kept.elements)
assert first != kept
PYTHON
