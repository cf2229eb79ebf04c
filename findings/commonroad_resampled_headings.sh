#!/usr/bin/env bash
# guess: Trajectory.resample_continuous_time_state_list of commonroad-io, linear between states, turns headings the short way.
# happens: it interpolates their numbers. Of a vehicle that drives towards -x, whose headings go from 3.12 to -3.12 rad, the state between heads
#          to +x, backwards along its own way. Every other heading is right; positions are.
# versions: commonroad-io 2026.1, numpy 2.4.6
# date: 2026-12-03
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check commonroad-io==2026.1 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

from commonroad.scenario.state import ExtendedPMState
from commonroad.scenario.trajectory import Trajectory
import numpy as np

print('commonroad-io', version('commonroad-io'), 'numpy', version('numpy'))


def resampled(headings):
    """Return the states every 0.5 s of a vehicle that drives 10 m along each of two headings, 1 s each."""
    ways = 10 * np.transpose([np.cos(headings), np.sin(headings)])
    places = np.vstack([np.zeros(2), np.cumsum(ways, axis=0)])[:3]
    states = [
        ExtendedPMState(time_step=step, position=place, orientation=heading, velocity=10.0, acceleration=0.0)
        for step, (place, heading) in enumerate(zip(places, headings.tolist()))
    ]
    return Trajectory.resample_continuous_time_state_list(states, np.array([0.0, 1.0, 2.0]), 0.5, 3).state_list


for middle, expected in ((0.0, 0.0), (np.pi, 0.0)):
    headings = np.array([middle - 0.02, middle + 0.02, middle + 0.04])
    headings = (headings + np.pi) % (2 * np.pi) - np.pi
    states = resampled(headings)
    between = states[1]
    print(f'headings {headings[0]:.2f} and {headings[1]:.2f}: between {between.orientation:.2f} at {np.round(between.position, 1).tolist()}')
    assert np.isclose(between.orientation, expected)
    assert np.allclose(between.position, 5 * np.array([np.cos(headings[0]), np.sin(headings[0])]))
PYTHON
