#!/usr/bin/env bash
# guess: the model of OpenLABEL of Kognic reads a timestamp of a frame that is a number, as the schema of OpenLABEL 1.0 allows.
# happens: whole numbers and text only; a file with 1700000000.1, as VCD writes it, is refused as a whole. VCD in turn takes floats and text
#          only (`vcd_integer_stamps`): text is what both read.
# versions: kognic-openlabel 2.2.0, pydantic 2.14.3, vcd 6.0.3
# date: 2026-12-02
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check kognic-openlabel==2.2.0 pydantic==2.14.3 vcd==6.0.3
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version
import json

from kognic.openlabel.models import OpenLabelAnnotation
from pydantic import ValidationError
from vcd import core, types

print('kognic-openlabel', version('kognic-openlabel'), 'vcd', version('vcd'))


def labels(timestamp):
    """The text of a car in one frame, as VCD writes it."""
    scene = core.OpenLABEL()
    car = scene.add_object('7', 'car')
    scene.add_object_data(car, types.cuboid('box', [10, 2, 1, 0, 0, 0, 1, 4.5, 1.8, 1.5]), 0)
    scene.add_frame_properties(0, timestamp=timestamp)
    return scene.stringify(False)


def is_read(text):
    try:
        OpenLabelAnnotation.model_validate_json(text)
    except ValidationError as error:
        print('refused:', error.errors()[0]['msg'])
        return False
    return True


read = {}
for timestamp in (1700000000.1, '1700000000.1'):
    text = labels(timestamp)
    assert json.loads(text)['openlabel']['frames']['0']['frame_properties']['timestamp'] == timestamp
    read[timestamp] = is_read(text)
whole = json.loads(labels('1700000000.1'))
whole['openlabel']['frames']['0']['frame_properties']['timestamp'] = 1700000000
read[1700000000] = is_read(json.dumps(whole))
print(read)
assert read == {1700000000.1: False, '1700000000.1': True, 1700000000: True}
PYTHON
