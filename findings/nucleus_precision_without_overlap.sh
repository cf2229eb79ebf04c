#!/usr/bin/env bash
# guess: at the default threshold CuboidPrecision and CuboidRecall count predictions that overlap a true cuboid.
# happens: the default is an IoU of 0 or more, which two cuboids 50 m apart have, too: they are a match, precision and recall are 1.
# versions: scale-nucleus 0.22.3, shapely 2.2.0, numpy 2.4.6
# date: 2026-12-02
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check 'scale-nucleus[metrics]==0.22.3' shapely==2.2.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

from nucleus import CuboidAnnotation, CuboidPrediction, Point3D
from nucleus.annotation import AnnotationList
from nucleus.metrics import CuboidIOU, CuboidPrecision, CuboidRecall
from nucleus.prediction import PredictionList

print('scale-nucleus', version('scale-nucleus'), 'shapely', version('shapely'), 'numpy', version('numpy'))


def car(kind, x, y=0.0, **more):
    """A car of 4 x 2 x 1.5 m that heads to +x."""
    return kind('car', Point3D(x, y, 0.0), Point3D(4.0, 2.0, 1.5), 0.0, 'frame', **more)


def value(metric, truth, predictions):
    return metric.call_metric(AnnotationList(cuboid_annotations=truth), PredictionList(cuboid_predictions=predictions)).value


truth, found = [car(CuboidAnnotation, 0.0)], [car(CuboidPrediction, 50.0, confidence=0.9)]
figures = {metric.__name__: value(metric(), truth, found) for metric in (CuboidIOU, CuboidPrecision, CuboidRecall)}
print('a prediction 50 m from the only true cuboid:', figures)
assert figures == {'CuboidIOU': 0.0, 'CuboidPrecision': 1.0, 'CuboidRecall': 1.0}
assert value(CuboidPrecision(iou_threshold=0.01), truth, found) == 0.0
PYTHON
