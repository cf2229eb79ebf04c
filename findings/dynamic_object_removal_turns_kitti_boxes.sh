#!/usr/bin/env bash
# guess: dynamic-object-removal, which by its page takes labels of KITTI, removes the points of a labelled car from the cloud.
# happens: with a calibration, which its command asks for with KITTI, rotation_y is counted from the axis ahead of the camera, by KITTI it
#          is from the axis to the right: each box lies across its car. Half of the points of a car of 4 x 2 m stay, and as many beside
#          it are removed. Without a calibration the headings are right.
# versions: dynamic-object-removal 0.6.0, numpy 2.4.6
# date: 2026-12-03
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check dynamic-object-removal==0.6.0 numpy==2.4.6
FOLDER=$folder "$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version
import math
import os
from pathlib import Path

from dynamic_object_removal import load_boxes, remove_points_in_boxes
import numpy as np

print('dynamic-object-removal', version('dynamic-object-removal'), 'numpy', version('numpy'))
folder = Path(os.environ['FOLDER'])
camera = '700 0 600 0 0 700 180 0 0 0 1 0'
# The axes of the camera point to the right, down and ahead, those of the LiDAR ahead, to the left and up.
to_camera = np.array([(0, -1, 0), (0, 0, -1), (1, 0, 0)], dtype=float)
(folder / 'calib.txt').write_text(
    ''.join(f'P{k}: {camera}\n' for k in range(4))
    + 'R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\nTr_imu_to_velo: 1 0 0 0 0 1 0 0 0 0 1 0\n'
)
LENGTH, WIDTH, HEIGHT, BOTTOM = 4.0, 2.0, 1.5, np.array([1.0, 1.6, 12.0])
# A square about the car, at half its height: along it, down, and across [m].
along, across = np.meshgrid(np.linspace(-2.95, 2.95, 60), np.linspace(-2.95, 2.95, 60))
square = np.stack([along.ravel(), np.full(along.size, -HEIGHT / 2), across.ravel()], axis=1)
of_car = (abs(square[:, 0]) < LENGTH / 2) & (abs(square[:, 2]) < WIDTH / 2)

for rotation_y in (-math.pi / 2, 0.0, 1.0):
    sine, cosine = math.sin(rotation_y), math.cos(rotation_y)
    turn = np.array([(cosine, 0, sine), (0, 1, 0), (-sine, 0, cosine)])  # of the KITTI devkit: about the axis down
    points = (square @ turn.T + BOTTOM) @ to_camera
    x, y, z = BOTTOM
    (folder / 'label.txt').write_text(f'Car 0.00 0 0 600 150 700 250 {HEIGHT} {WIDTH} {LENGTH} {x} {y} {z} {rotation_y}\n')
    for calibration in (None, folder / 'calib.txt'):
        boxes = load_boxes(folder / 'label.txt', fmt='kitti', skip_invalid=False, calib_path=calibration)
        removed = ~remove_points_in_boxes(points, boxes, margin=(0, 0, 0))[1]
        assert np.allclose(boxes[0].center, (12, -1, -0.85))
        share, others = (removed & of_car).sum() / of_car.sum(), (removed & ~of_car).sum() / of_car.sum()
        name = 'with calibration' if calibration else 'without'
        print(f'rotation_y {rotation_y:.2f}, {name}: removed {share:.2f} of the car, and {others:.2f} as many beside it')
        assert (share, others) == ((0.5, 0.5) if calibration else (1.0, 0.0))
PYTHON
