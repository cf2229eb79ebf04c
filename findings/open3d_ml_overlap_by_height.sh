#!/usr/bin/env bash
# guess: precision_3d of Open3D-ML, of which its mAP on KITTI is made, takes length and width of a car for the overlap seen from above.
# happens: to_dicts has h, w, l of boxes with a calibration, and the overlap takes the 4th and 6th number: height and length, with the
#          length across. A car of 3.9 x 1.6 x 1.5 m found 0.9 m too far ahead (IoU 0.62) is false, one 0.9 m beside (0.28) is true.
# versions: open3d 0.19.0, numpy 1.26.4, shapely 2.1.2
# date: 2026-12-03
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check open3d==0.19.0 numpy==1.26.4 shapely==2.1.2
FOLDER=$folder "$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version
import math
import os
from pathlib import Path

import numpy as np
from open3d._ml3d.datasets.utils import BEVBox3D
from open3d._ml3d.metrics import iou_bev, precision_3d
from open3d.ml.datasets import KITTI
from shapely import Polygon

print('open3d', version('open3d'), 'numpy', version('numpy'))
folder = Path(os.environ['FOLDER'])
camera = '721.5377 0 609.5593 44.85728 0 721.5377 172.854 0.2163791 0 0 1 0.002745884'
(folder / 'calib.txt').write_text(
    ''.join(f'P{k}: {camera}\n' for k in range(4))
    + 'R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27\nTr_imu_to_velo: 1 0 0 0 0 1 0 0 0 0 1 0\n'
)
calibration = KITTI.read_calib(folder / 'calib.txt')
HEIGHT, WIDTH, LENGTH = 1.5, 1.6, 3.9


def car(x, z):
    """Return a car that drives ahead at x to the right and z ahead [m], as Open3D-ML reads it, and its footprint."""
    line = f'Car 0.00 0 -1.73 600 150 700 250 {HEIGHT} {WIDTH} {LENGTH} {x} 1.65 {z} {-math.pi / 2} 0.9\n'
    (folder / 'label.txt').write_text(line)
    boxes = BEVBox3D.to_dicts(KITTI.read_label(folder / 'label.txt', calibration))
    right, ahead = WIDTH / 2, LENGTH / 2
    corners = [(x - right, z - ahead), (x + right, z - ahead), (x + right, z + ahead), (x - right, z + ahead)]
    return boxes, Polygon(corners)


true, true_footprint = car(2.0, 12.0)
assert np.allclose(true['bbox'][0, 3:6], (HEIGHT, WIDTH, LENGTH))
assert (true['difficulty'] == 0).all()
results = {}
for name, (x, z) in {'ahead': (2.0, 12.9), 'beside': (2.9, 12.0)}.items():
    found, footprint = car(x, z)
    by_hand = footprint.intersection(true_footprint).area / footprint.union(true_footprint).area
    # The columns of precision_3d, and for comparison length and width, with which iou_bev is right.
    overlap, right_columns = (
        iou_bev(*(each['bbox'][:, columns].astype(np.float32) for each in (found, true)))[0, 0]
        for columns in ([0, 2, 3, 5, 6], [0, 2, 5, 4, 6])
    )
    assert np.isclose(right_columns, by_hand, atol=1e-3)
    detection, _ = precision_3d(found, true, classes=['Car'], difficulties=[0], min_overlap=[0.5], bev=True)
    results[name] = by_hand, overlap, bool(detection[0, 0].reshape(-1)[1])
    print(f'0.9 m {name}: IoU {by_hand:.3f}; in Open3D-ML {overlap:.3f}, true at 0.5: {results[name][2]}')
assert np.allclose(results['ahead'], (3.0 / 4.8, 0.6 / 2.4, False), atol=1e-3)
assert np.allclose(results['beside'], (0.7 / 2.5, 3.0 / 4.8, True), atol=1e-3)
PYTHON
