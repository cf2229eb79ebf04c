#!/usr/bin/env bash
# guess: BoundingBox.contains of CARLA, by its documentation whether a point is inside of the box, agrees with the corners that
#        get_world_vertices returns.
# happens: the corners turn with `rotation` of the box, contains() leaves it out. Of a car of 4 x 2 m that its own rotation puts across,
#          half of the points are outside, and as many points beside it are inside.
# versions: carla 0.9.16, numpy 2.4.6
# date: 2026-12-03
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check carla==0.9.16 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

import carla
import numpy as np

print('carla', version('carla'), 'numpy', version('numpy'))

# One heading, stated by the box itself or by the transform of its actor.
box = carla.BoundingBox(carla.Location(0, 0, 0), carla.Vector3D(2, 1, 0.8))
turned = carla.BoundingBox(carla.Location(0, 0, 0), carla.Vector3D(2, 1, 0.8))
turned.rotation = carla.Rotation(yaw=90)
stands, across = carla.Transform(), carla.Transform(carla.Location(0, 0, 0), carla.Rotation(yaw=90))


def corners(box, transform):
    return np.array([(v.x, v.y, v.z) for v in box.get_world_vertices(transform)])


assert np.allclose(corners(turned, stands), corners(box, across), atol=1e-5)
low, high = corners(turned, stands).min(0), corners(turned, stands).max(0)
assert np.allclose(high, (1, 2, 0.8), atol=1e-5)

grid = np.stack(np.meshgrid(np.linspace(-2.95, 2.95, 60), np.linspace(-2.95, 2.95, 60), [0.0]), axis=-1).reshape(-1, 3)
between = ((grid > low) & (grid < high)).all(axis=1)
by_actor = np.array([box.contains(carla.Location(*point), across) for point in grid.tolist()])
by_box = np.array([turned.contains(carla.Location(*point), stands) for point in grid.tolist()])
print(between.sum(), 'points between the corners')
print('turned by the actor:', (by_actor & between).sum(), 'of them inside,', (by_actor & ~between).sum(), 'others')
print('turned by the box:  ', (by_box & between).sum(), 'of them inside,', (by_box & ~between).sum(), 'others')
assert np.array_equal(by_actor, between)
assert (by_box & between).sum() == (by_box & ~between).sum() == between.sum() // 2
PYTHON
