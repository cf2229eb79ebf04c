#!/usr/bin/env bash
# guess: a BBox3D of bbox can be moved by its `center` as well as by `cx`, `cy` and `cz`, which are documented as the coordinates of its
#        center, and iou_3d compares the boxes where they are.
# happens: there are two centers. The corners follow `center` alone, the heights of iou_3d `cz` alone, as if it were the top: a box that was
#          moved by 10 m has an IoU of 1 with the one it was copied from, and a low box that touches a tall one from below one of 0.33.
# versions: bbox 0.9.4, numpy 1.26.4, pyquaternion 0.9.9
# date: 2026-12-03
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check bbox==0.9.4 numpy==1.26.4 pyquaternion==0.9.9
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
from importlib.metadata import version

from bbox import BBox3D
from bbox.metrics import iou_3d
import numpy as np

print('bbox', version('bbox'), 'numpy', version('numpy'))


def car(x=0.0, z=0.0, height=2.0):
    return BBox3D(x, 0.0, z, length=4.0, width=2.0, height=height)


assert iou_3d(car(), car()) == 1
assert np.isclose(iou_3d(car(), car(x=1.0)), 3 / 5)
assert iou_3d(car(), car(x=10.0)) == iou_3d(car(), car(z=10.0)) == 0

by_coordinate, by_center = car(), car()
by_coordinate.cx = 10.0
by_center.center = np.array([0.0, 0.0, 10.0])
for name, box in (('cx = 10', by_coordinate), ('center = (0, 0, 10)', by_center)):
    overlap = iou_3d(car(), box)
    coordinates, corners = (box.cx, box.cy, box.cz), box.p.mean(axis=0)
    print(f'{name}: cx, cy, cz {coordinates}, center {box.center}, middle of the corners {corners}, IoU {overlap}')
    assert np.allclose(box.center, corners)
    assert not np.allclose(box.center, coordinates)
    assert overlap == 1

# From the ground to 1 m, and from there to 4 m: they share a face.
low, tall = car(z=0.5, height=1.0), car(z=2.5, height=3.0)
assert low.p[:, 2].max() == tall.p[:, 2].min() == 1
print('IoU of boxes that touch:', iou_3d(low, tall))
assert iou_3d(low, tall) == 0.33333
PYTHON
