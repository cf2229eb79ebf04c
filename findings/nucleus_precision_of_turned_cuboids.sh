#!/usr/bin/env bash
# guess: CuboidPrecision and CuboidRecall ask for the same 3D IoU as CuboidIOU gives.
# happens: they turn each cuboid by a quarter about its own centre first, truth and prediction alike. A car that is 1 m ahead of the
#          true one has an IoU of 0.6, and no precision at 0.5; one that is 0.8 m beside it has 0.43, and all of it.
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


truth = [car(CuboidAnnotation, 0.0)]
for name, x, y, iou, share in (('1 m ahead', 1.0, 0.0, 3 / 5, 0.0), ('0.8 m beside', 0.0, 0.8, 1.2 / 2.8, 1.0)):
    found = [car(CuboidPrediction, x, y, confidence=0.9)]
    figures = [value(metric, truth, found) for metric in (CuboidIOU(), CuboidPrecision(iou_threshold=0.5), CuboidRecall(iou_threshold=0.5))]
    print(f'{name}: IoU {figures[0]:.3f}, precision and recall at an IoU of 0.5: {figures[1]}, {figures[2]}')
    assert abs(figures[0] - iou) < 1e-3
    assert figures[1:] == [share, share]
PYTHON
