#!/usr/bin/env bash
# guess: CuboidIOU assigns cuboids one to one, by a linear sum assignment, as its function states.
# happens: each true cuboid takes the prediction that overlaps it most, whoever has it already: one prediction between two cars
#          counts for both, and its mean IoU is twice that of an assignment.
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
from nucleus.metrics import CuboidIOU
from nucleus.prediction import PredictionList

print('scale-nucleus', version('scale-nucleus'), 'shapely', version('shapely'), 'numpy', version('numpy'))


def car(kind, x, y=0.0, **more):
    """A car of 4 x 2 x 1.5 m that heads to +x."""
    return kind('car', Point3D(x, y, 0.0), Point3D(4.0, 2.0, 1.5), 0.0, 'frame', **more)


def value(metric, truth, predictions):
    return metric.call_metric(AnnotationList(cuboid_annotations=truth), PredictionList(cuboid_predictions=predictions)).value


# Two cars bumper to bumper, and one prediction that lies half on each: IoU of 1/3 with both.
truth, found = [car(CuboidAnnotation, 0.0), car(CuboidAnnotation, 4.0)], [car(CuboidPrediction, 2.0, confidence=0.9)]
both = value(CuboidIOU(iou_threshold=0.3), truth, found)
print('mean IoU of two true cuboids:', round(both, 4), '- by an assignment:', round(1 / 3 / 2, 4))
assert abs(both - 1 / 3) < 1e-6
PYTHON
