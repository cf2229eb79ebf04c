#!/usr/bin/env bash
# guess: the hierarchical AP of Argoverse 2 is 1 if each car is detected once where it is, as the plain AP is, and less if one is missed.
# happens: accumulate_hierarchy notes the last label of the sweep as taken, not the one that was matched. Of two cars that are both
#          detected exactly the AP is 0.5, or 1 if their scores are exchanged; if one of them is detected twice and the other is missed,
#          it is 1.
# versions: av2 0.3.6, numpy 2.4.6
# date: 2026-12-03
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check numpy==2.4.6 scipy==1.17.1 universal_pathlib==0.3.10 pandas joblib tqdm pyproj \
    opencv-python-headless pyarrow matplotlib numba
# Of its other requirements, which hold torch, the evaluation needs none.
"$folder/venv/bin/pip" install -q --disable-pip-version-check --no-deps av2==0.3.6
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from av2.evaluation.detection.utils import accumulate, accumulate_hierarchy, DetectionCfg

print('av2', version('av2'), 'numpy', version('numpy'))
CAR = 'REGULAR_VEHICLE'
config = DetectionCfg(eval_only_roi_instances=False, categories=(CAR,))


def cars(*rows):
    """Return cars of one sweep at x [m], with their scores or numbers of points."""
    boxes = np.array([(x, 0, 0, 4.5, 1.8, 1.5, 1, 0, 0, 0, last) for x, last in rows], dtype=float)
    return boxes, np.full((len(rows), 1), CAR, dtype=object), np.array([('log', 1)] * len(rows))


def evaluate(*rows):
    """Return the hierarchical AP, and which detections the plain evaluation takes for true at 0.5 m."""
    found, true = cars(*rows), cars((10, 100), (30, 100))
    both = [each for pair in zip(found, true) for each in pair]
    score = accumulate_hierarchy(*both, CAR, (CAR,), 'FINEGRAIN', config)[0]
    return score, accumulate(found[0], true[0], config)[0][:, 0].astype(int).tolist()


exact = evaluate((10, 0.9), (30, 0.8))
exchanged = evaluate((10, 0.8), (30, 0.9))
twice = evaluate((10, 0.9), (10.1, 0.8))
for name, (score, plain) in (('exact', exact), ('scores exchanged', exchanged), ('one twice, one missed', twice)):
    print(f'{name}: AP {score}; by the plain evaluation true: {plain}')
assert exact == (0.5, [1, 1])
assert exchanged == (1.0, [1, 1])
assert twice == (1.0, [1, 0])
PYTHON
