#!/usr/bin/env bash
# guess: VCD refuses an argument of add_object that it does not know
# happens: it writes the argument into the file as a member of the object; the schema that the library itself has then refuses the file
# versions: vcd 6.0.3
# date: 2026-11-28
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --no-deps vcd==6.0.3 jsonschema==4.26.0 attrs==26.1.0 \
    referencing==0.37.0 rpds-py==2026.9.1 jsonschema-specifications==2025.9.1 typing-extensions==4.16.0 \
    numpy==2.4.6 opencv-python-headless==4.11.0.86
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version
import json

from jsonschema.exceptions import ValidationError
from vcd import core

print('vcd', version('vcd'))
label = core.OpenLABEL()
label.add_object('car', 'car', coord_system='lidar')  # the argument is coordinate_system
(item,) = json.loads(label.stringify(False, False))['openlabel']['objects'].values()
print('written:', item)
assert item['coord_system'] == 'lidar'
try:
    label.stringify(False, True)
except ValidationError as error:
    print('validated:', error.message)
else:
    raise SystemExit('the file is valid now')
PYTHON
