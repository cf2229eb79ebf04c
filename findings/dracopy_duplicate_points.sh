#!/usr/bin/env bash
# guess: DracoPy.encode keeps the number of points: it rounds coordinates, and may sort the points
# happens: by default it also drops points of equal coordinates; with preserve_order=True it keeps all
# versions: DracoPy 2.2.0, numpy 2.4.6
# date: 2026-11-28
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q DracoPy==2.2.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import DracoPy
import numpy as np

points = np.random.default_rng(0).uniform(-50, 50, (1000, 3)).astype(np.float32)
points[500] = points[499]
for keep, expected in ((False, 999), (True, 1000)):
    count = len(DracoPy.decode(DracoPy.encode(points, preserve_order=keep)).points)
    print('preserve_order', keep, count, 'of 1000 points')
    assert count == expected
PYTHON
