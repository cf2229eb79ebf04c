#!/usr/bin/env bash
# guess: a binary PCD file that ends early is refused
# happens: at the end of a point it is read without a word; `points` says three, the array has two
# versions: pypcd4 1.5.1, python-neo-lzf 0.3.5
# date: 2026-11-28
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pypcd4==1.5.1 python-neo-lzf==0.3.5
"$folder/venv/bin/python" - "$folder/cloud.pcd" <<'PYTHON'
from importlib.metadata import version
import sys

import numpy as np
from pypcd4 import Encoding, PointCloud

path = sys.argv[1]
PointCloud.from_xyz_points(np.arange(9, dtype=np.float32).reshape(3, 3)).save(path, Encoding.BINARY)
with open(path, 'rb') as file:
    whole = file.read()
with open(path, 'wb') as file:
    file.write(whole[:-12])
cloud = PointCloud.from_path(path)
print('pypcd4', version('pypcd4'), 'points', cloud.points, 'rows', len(cloud.pc_data))
sys.exit((cloud.points, len(cloud.pc_data)) != (3, 2))
PYTHON
