#!/usr/bin/env bash
# guess: iou_3d_axis_aligned, of which the scale error of Argoverse 2 is made, divides the intersection of two cuboids about one centre
#        by their union.
# happens: it divides by the cuboid of the larger extents, which holds both. The two agree where one cuboid lies in the other; of a
#          detection that is shorter and wider than the car the scale error is 0.40 in place of 0.37.
# versions: av2 0.3.6, numpy 2.4.6
# date: 2026-12-02
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check numpy==2.4.6 universal_pathlib==0.3.10
# Of its requirements, which hold torch, this function needs no other.
"$folder/venv/bin/pip" install -q --disable-pip-version-check --no-deps av2==0.3.6
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from av2.geometry.iou import iou_3d_axis_aligned

print('av2', version('av2'), 'numpy', version('numpy'))


def of_both(one, other):
    """Return the overlap of two cuboids, by length, width and height [m]: of av2, and by hand."""
    common = np.prod(np.minimum(one, other))
    by_hand = common / (np.prod(one) + np.prod(other) - common)
    return iou_3d_axis_aligned(np.array([one]), np.array([other]))[0], by_hand


car = 4.5, 1.8, 1.5
within = of_both(car, (4.0, 1.6, 1.4))
across = of_both(car, (3.6, 2.4, 1.5))
print('within the car: {:.3f}, by hand {:.3f}'.format(*within))
print('shorter and wider: {:.3f}, by hand {:.3f}'.format(*across))
assert np.isclose(*within)
assert np.allclose(across, (0.6, 9.72 / 15.39))
PYTHON
