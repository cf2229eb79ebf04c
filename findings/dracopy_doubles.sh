#!/usr/bin/env bash
# guess: DracoPy returns an attribute of doubles (Draco's data type 10) as float64, since it names the type
# happens: it names type 10 and returns float32; a time of today [s] is off by up to 64 s
# versions: DracoPy 2.2.0, numpy 2.4.6
# date: 2026-11-28
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q DracoPy==2.2.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import struct
import DracoPy
import numpy as np

points = np.arange(15, dtype='<f4').reshape(5, 3)
times = 1.7e9 + np.linspace(0.0, 0.1, 5)
# A sequential point cloud of Draco 2.2: two attributes, whose values are stored as they are.
stream = b'DRACO' + bytes([2, 2, 0, 0]) + struct.pack('<HiBB', 0, 5, 1, 2)
stream += bytes([0, 9, 3, 0, 0]) + bytes([4, 10, 1, 0, 1]) + bytes(2)
stream += points.tobytes() + times.astype('<f8').tobytes()
position, found = DracoPy.decode(stream).attributes
assert np.array_equal(position['data'], points)
values = found['data'][:, 0]
print('data type', found['data_type'], 'returned as', values.dtype, 'off by', np.abs(times - values).max(), 's')
assert found['data_type'] == 10 and values.dtype == np.float32
assert len(set(values.tolist())) == 1
PYTHON
