#!/usr/bin/env bash
# guess: VCD takes the nanoseconds of a frame as an integer, since the schema of OpenLABEL allows any number or text
# happens: it takes text and floats only; a float of seconds or of nanoseconds has lost up to 128 ns, text keeps them
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

from vcd import core

print('vcd', version('vcd'))
STAMP = 1_700_000_000_123_456_789


def written(stamp):
    label = core.OpenLABEL()
    label.add_frame_properties(0, timestamp=stamp)
    root = json.loads(label.stringify(False, True))  # valid by the schema
    return root['openlabel']['frames']['0']['frame_properties']['timestamp']


try:
    written(STAMP)
except TypeError as error:
    print('integer:', error)
else:
    raise SystemExit('an integer is taken now')
print('float of ns:', int(written(float(STAMP))) - STAMP, 'ns off')
print('text:', written('1700000000.123456789'))
assert int(written(float(STAMP))) != STAMP
assert written('1700000000.123456789') == '1700000000.123456789'
PYTHON
