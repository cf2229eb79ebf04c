#!/usr/bin/env bash
# guess: given the pose of the own vehicle, cuboid_to_segmentation brings cuboids from the world to the points, which are
#        in the frame of the vehicle.
# happens: it takes away the position and then turns each cuboid about its own centre, not about the vehicle: with any heading but
#          0 cuboids lie elsewhere, and no point gets an instance, without a word.
# versions: segments-ai 1.33.0, open3d 0.19.0, pyquaternion 0.9.9, numpy 2.4.6
# date: 2026-12-02
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check segments-ai==1.33.0 open3d==0.19.0 pyquaternion==0.9.9 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from segments.typing import EgoPose, PointcloudCuboidLabelAttributes
from segments.utils import cuboid_to_segmentation

print('segments-ai', version('segments-ai'), 'open3d', version('open3d'), 'numpy', version('numpy'))

# The vehicle stands at x = 100 m and heads to +y; a car of the same heading is 10 m ahead of it.
label = PointcloudCuboidLabelAttributes.model_validate({'annotations': [
    {'id': 7, 'category_id': 1, 'type': 'cuboid', 'position': {'x': 100.0, 'y': 10.0, 'z': 0.0},
     'dimensions': {'x': 4.0, 'y': 2.0, 'z': 1.5}, 'yaw': np.pi / 2}]})
half = float(np.sqrt(0.5))


def pose(**heading):
    return EgoPose.model_validate({'position': {'x': 100.0, 'y': 0.0, 'z': 0.0}, 'heading': heading})


turned = pose(qx=0.0, qy=0.0, qz=half, qw=half)
points = np.array([[x, 0.0, 0.0] for x in (8.5, 9.5, 10.5, 11.5)])  # on the car, in the frame of the vehicle
marked = cuboid_to_segmentation(points, label, turned)
elsewhere = cuboid_to_segmentation(points[:, [1, 0, 2]], label, turned)
print('points on the car, 10 m ahead:', marked)
print('points 10 m to the left of the vehicle:', elsewhere)
assert marked.tolist() == [0] * 4
assert elsewhere.tolist() == [0, 7, 7, 0]  # there, and turned: 2 m long in this direction
# Of a vehicle that heads to +x it is right.
straight = pose(qx=0.0, qy=0.0, qz=0.0, qw=1.0)
assert cuboid_to_segmentation(points[:, [1, 0, 2]], label, straight).tolist() == [7] * 4
PYTHON
