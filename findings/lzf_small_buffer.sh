#!/usr/bin/env bash
# guess: unpacking into fewer bytes than the data have raises, as zlib and zstandard do
# happens: `lzf.decompress` returns None
# versions: python-neo-lzf 0.3.5
# date: 2026-11-28
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet python-neo-lzf==0.3.5
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version
import sys

import lzf

points = bytes(range(64)) * 16
packed = lzf.compress(points)
enough = lzf.decompress(packed, len(points))
short = lzf.decompress(packed, len(points) - 1)
print('python-neo-lzf', version('python-neo-lzf'), 'enough', enough == points, 'short', short)
sys.exit(not (enough == points and short is None))
PYTHON
