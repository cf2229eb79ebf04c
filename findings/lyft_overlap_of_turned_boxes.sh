#!/usr/bin/env bash
# guess: Box3D.get_iou, by which lyft-dataset-sdk matches boxes, is that of the boxes whatever their heading, as for one of 0.
# happens: each footprint is turned the wrong way, by minus its heading about its own centre. At 45 degrees an error ahead of a car counts as
#          one beside it: an IoU of 0.33 in place of 0.64, and the other way round.
# versions: lyft-dataset-sdk 0.0.8, pyquaternion 0.9.9, shapely 2.2.0, numpy 2.4.6
# date: 2026-12-02
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check pyquaternion==0.9.9 shapely==2.2.0 numpy==2.4.6
# Of its requirements, those of images and notebooks, the evaluation needs no other.
"$folder/venv/bin/pip" install -q --disable-pip-version-check --no-deps lyft-dataset-sdk==0.0.8
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from lyft_dataset_sdk.eval.detection.mAP_evaluation import Box3D
from pyquaternion import Quaternion

print('lyft-dataset-sdk', version('lyft-dataset-sdk'), 'pyquaternion', version('pyquaternion'))


def car(heading, ahead=0.0, left=0.0):
    """Return a car whose centre is so far off the origin, seen from itself [rad, m]."""
    turn = Quaternion(axis=[0, 0, 1], radians=heading)
    return Box3D(
        sample_token='a', name='car', size=[2.0, 4.5, 1.6], translation=list(turn.rotate([ahead, left, 0])), rotation=list(turn)
    )


true_ahead, true_left = 3.5 / 5.5, 1 / 3  # 1 m of 4.5, and of 2
for degrees in (0, 45, 90):
    heading = np.radians(degrees)
    found = [car(heading).get_iou(car(heading, **off)) for off in ({'ahead': 1.0}, {'left': 1.0})]
    print(f'heading {degrees}: 1 m ahead {found[0]:.3f} (true {true_ahead:.3f}), 1 m to the left {found[1]:.3f} (true {true_left:.3f})')
    expected = (true_left, true_ahead) if degrees == 45 else (true_ahead, true_left)
    assert np.allclose(found, expected)
PYTHON
