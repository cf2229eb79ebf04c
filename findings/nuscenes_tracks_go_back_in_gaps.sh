#!/usr/bin/env bash
# guess: the tracking evaluation of nuScenes fills gaps of a track, also of the truth, by the straight line between the boxes around it.
# happens: interpolate_tracks gives the weight of the left box to the right one, which interpolate_tracking_boxes documents as the weight
#          of the right box. One missing sample at equal steps is right. Of two, the boxes change places: a car at 10 m/s stands 5 m
#          off its line, where the evaluation allows 2 m.
# versions: nuscenes-devkit 1.2.0, numpy 1.26.4, pyquaternion 0.9.9
# date: 2026-12-03
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check numpy==1.26.4 pyquaternion==0.9.9 shapely==2.0.7 matplotlib==3.10.9 \
    opencv-python-headless==4.11.0.86 scikit-learn scipy tqdm pillow cachetools
# Of its other requirements, those of maps and images, the evaluation needs none.
"$folder/venv/bin/pip" install -q --disable-pip-version-check --no-deps nuscenes-devkit==1.2.0
"$folder/venv/bin/python" - <<'PYTHON'
from collections import defaultdict
from importlib.metadata import version

from nuscenes.eval.common.config import config_factory
from nuscenes.eval.tracking.data_classes import TrackingBox
from nuscenes.eval.tracking.loaders import interpolate_tracking_boxes, interpolate_tracks
import numpy as np

print('nuscenes-devkit', version('nuscenes-devkit'), 'numpy', version('numpy'))
allowed = config_factory('tracking_nips_2019').dist_th_tp
SPEED = 10.0  # m/s


def car(time):
    """Return a car that drives ahead, at a time [us]."""
    return TrackingBox(
        sample_token=str(time), translation=(SPEED * time / 1e6, 0, 0), size=(1.8, 4.5, 1.6), rotation=(1, 0, 0, 0),
        velocity=(SPEED, 0), tracking_id='a', tracking_name='car',
    )


def filled(times, missing):
    """Return where the car is at each time after the gap was filled [m]."""
    tracks = defaultdict(list, {time: [] if k in missing else [car(time)] for k, time in enumerate(times)})
    return [interpolate_tracks(tracks)[time][0].translation[0] for time in times]


# The function that mixes two boxes does so by its documentation.
assert np.isclose(interpolate_tracking_boxes(car(0), car(1_000_000), 0.25).translation[0], 2.5)

samples = [0, 500_000, 1_000_000, 1_500_000]
one = filled(samples, {1})
two = filled(samples, {1, 2})
uneven = filled([0, 500_000, 1_100_000], {1})
print('a car at 0, 5, 10 and 15 m; one sample missing:', np.round(one, 2).tolist(), 'two:', np.round(two, 2).tolist())
print('a car at 0, 5 and 11 m, one sample missing:', np.round(uneven, 2).tolist())
assert np.allclose(one, (0, 5, 10, 15))
assert np.allclose(two, (0, 10, 5, 15))
assert np.allclose(uneven, (0, 6, 11))
assert abs(two[1] - 5) > allowed == 2.0
PYTHON
