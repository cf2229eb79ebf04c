#!/usr/bin/env bash
# guess: translate_rotate of commonroad-io, and the translate_rotate of states, obstacles and scenarios that are built on it, turn rigidly about
#        the origin by any angle: distances stay, and a turn and its inverse cancel.
# happens: for angles of at most 0.05 rad the matrix has 1 in place of the cosine and the angle in place of the sine. It is no rotation: lengths
#          grow by 0.125 % at 0.05 rad. 100 m from the origin a vehicle lands 0.125 m from its place; 1 km from it, 1.25 m; just above
#          0.05 rad all is right. Its heading is turned by the whole angle. rotate_translate, beside it, is exact.
# versions: commonroad-io 2026.1, numpy 2.4.6
# date: 2026-12-03
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check commonroad-io==2026.1 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

from commonroad.geometry.transform import rotate_translate, translate_rotate
from commonroad.scenario.state import InitialState
import numpy as np

print('commonroad-io', version('commonroad-io'), 'numpy', version('numpy'))
NOWHERE = np.zeros(2)


def turned(points, angle):
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return points @ rotation.T


errors = {}
for distance in (100.0, 1000.0):
    place = np.array([[distance, 0.0]])
    for angle in (0.01, 0.05, 0.0501, -0.05):
        error = np.linalg.norm(translate_rotate(place, NOWHERE, angle) - turned(place, angle))
        errors[distance, angle] = error
        print(f'{distance:.0f} m from the origin, turned by {angle} rad: {error:.3f} m off')
        assert np.allclose(rotate_translate(place, NOWHERE, angle), turned(place, angle))
assert np.isclose(errors[100.0, 0.05], 0.125, atol=0.001) and np.isclose(errors[1000.0, -0.05], 1.25, atol=0.001)
assert errors[100.0, 0.0501] < 1e-9 and errors[1000.0, 0.0501] < 1e-9

there = translate_rotate(np.array([[1000.0, 0.0], [0.0, 0.0]]), NOWHERE, 0.05)
back = translate_rotate(there, NOWHERE, -0.05)
print(f'two points 1000 m apart: {np.linalg.norm(there[0] - there[1]):.3f} m, turned back {np.linalg.norm(back[0] - back[1]):.3f} m')
assert np.isclose(np.linalg.norm(there[0] - there[1]), 1001.249, atol=0.001)
assert np.isclose(np.linalg.norm(back[0] - back[1]), 1002.5, atol=0.001)

state = InitialState(time_step=0, position=np.array([1000.0, 0.0]), orientation=0.0, velocity=10.0)
moved = state.translate_rotate(NOWHERE, 0.05)
print(f'a state: {np.linalg.norm(moved.position - turned(state.position, 0.05)):.3f} m off, heading {moved.orientation} rad')
assert np.isclose(np.linalg.norm(moved.position), 1001.249, atol=0.001) and np.isclose(moved.orientation, 0.05)
PYTHON
