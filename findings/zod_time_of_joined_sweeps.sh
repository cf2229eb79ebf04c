#!/usr/bin/env bash
# guess: LidarData.extend gives joined sweeps the mean of their times, weighted by their points, as it states.
# happens: it counts the points of the first sweep after the others have been added to them: two equal sweeps 0.1 s apart get
#          the time of a third of the way in place of the middle, and motion compensation starts from there.
# versions: zod 0.8.0, dataclass-wizard 0.35.0, numpy 2.4.6
# date: 2026-12-02
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check zod==0.8.0 dataclass-wizard==0.35.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from zod.data_classes import LidarData

print('zod', version('zod'), 'numpy', version('numpy'))


def sweep(time, count=1000):
    return LidarData(
        points=np.ones((count, 3), np.float32), timestamps=np.full(count, time), intensity=np.ones(count, np.uint8),
        diode_idx=np.ones(count, np.uint8), core_timestamp=time)


joined = sweep(100.0)
joined.extend(sweep(100.1))
print('mean of the times of all points:', joined.timestamps.mean().round(6), 'core_timestamp:', round(joined.core_timestamp, 6))
assert np.isclose(joined.timestamps.mean(), 100.05)
assert np.isclose(joined.core_timestamp, 100 + 0.1 / 3)
PYTHON
