#!/usr/bin/env bash
# guess: the detection task refuses true boxes of a category that the data set does not have
# happens: the category has no detection class, None, and the loader of the truth leaves such boxes
#     out without a word; so `car` counts for nothing beside `vehicle.car`
# versions: truckscenes-devkit 1.2.0
# date: 2026-11-28
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet truckscenes-devkit==1.2.0
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
from importlib.metadata import version
import sys

from truckscenes.eval.detection.utils import category_to_detection_name

found = {name: category_to_detection_name(name) for name in ('vehicle.car', 'car', 'Car')}
print('truckscenes-devkit', version('truckscenes-devkit'), found)
sys.exit(found != {'vehicle.car': 'car', 'car': None, 'Car': None})
PYTHON
