#!/usr/bin/env bash
# guess: cuboid_to_segmentation marks the same points in a cuboid, whether its heading is given as `yaw` or as `rotation`.
# happens: it hands x, y, z, w to a function of Open3D that takes w, x, y, z. A cuboid whose `rotation` is a quarter turn about z
#          stays along x, with width and height exchanged: half of its points get no instance, without a word.
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
from segments.typing import PointcloudCuboidLabelAttributes
from segments.utils import cuboid_to_segmentation

print('segments-ai', version('segments-ai'), 'open3d', version('open3d'), 'numpy', version('numpy'))


def label(**heading):
    """A car of 4 x 2 x 1.5 m at the origin whose front is towards +y."""
    return PointcloudCuboidLabelAttributes.model_validate({'annotations': [
        {'id': 7, 'category_id': 1, 'type': 'cuboid', 'position': {'x': 0.0, 'y': 0.0, 'z': 0.0},
         'dimensions': {'x': 4.0, 'y': 2.0, 'z': 1.5}, **heading}]})


# Points along the axis of the car, from its rear to its front.
points = np.array([[0.0, y, 0.0] for y in (-1.8, -1.3, -0.7, -0.3, 0.3, 0.7, 1.3, 1.8)])
half = float(np.sqrt(0.5))
by_yaw = cuboid_to_segmentation(points, label(yaw=np.pi / 2))
by_rotation = cuboid_to_segmentation(
    points, label(yaw=np.pi / 2, rotation={'qx': 0.0, 'qy': 0.0, 'qz': half, 'qw': half}))
print('by yaw:     ', by_yaw)
print('by rotation:', by_rotation)
assert by_yaw.tolist() == [7] * 8
assert by_rotation.tolist() == [0, 0, 7, 7, 7, 7, 0, 0]
PYTHON
