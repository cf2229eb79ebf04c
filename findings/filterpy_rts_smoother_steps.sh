#!/usr/bin/env bash
# guess: the function filterpy.kalman.rts_smoother and the method KalmanFilter.rts_smoother smooth a track alike, given what
#        batch_filter was given.
# happens: where steps differ, as where a sweep of a LiDAR is missing, they do not. The method takes Fs[k + 1] from k to k + 1, as
#          batch_filter did, and is right; the function takes Fs[k]: here it is 7 m off beside the gap, without a word.
# versions: filterpy 1.4.5, numpy 2.4.6, scipy 1.17.1
# date: 2026-12-02
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check filterpy==1.4.5 numpy==2.4.6 scipy==1.17.1
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from filterpy.kalman import KalmanFilter, rts_smoother

print('filterpy', version('filterpy'), 'numpy', version('numpy'), 'scipy', version('scipy'))

# A car at 10 m/s, seen each 0.1 s, and not at all between 0.4 and 1.4 s: exact positions, a constant velocity.
times = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 1.4, 1.5, 1.6, 1.7, 1.8])
steps = np.diff(times, prepend=-0.1)
noise = 1e-3
kalman = KalmanFilter(dim_x=2, dim_z=1)
kalman.x = np.zeros((2, 1))
kalman.P = np.diag([100.0, 100.0])
kalman.H = np.array([[1.0, 0.0]])
kalman.R = np.array([[0.01]])
Fs = [np.array([[1.0, dt], [0.0, 1.0]]) for dt in steps]
Qs = [noise * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]) for dt in steps]
start, spread = kalman.x.copy(), kalman.P.copy()
means, covariances, _, _ = kalman.batch_filter(list(10 * times), Fs=Fs, Qs=Qs)

by_method = kalman.rts_smoother(means, covariances, Fs, Qs)[0]
by_function = rts_smoother(means, covariances, Fs, Qs)[0]

# What both should give: the most probable states of the same model, all at once by least squares.
count = len(times)
information, right = np.zeros((2 * count, 2 * count)), np.zeros(2 * count)


def add(rows, value, covariance):
    weight = np.linalg.inv(covariance)
    information[:] += rows.T @ weight @ rows
    right[:] += rows.T @ weight @ value


for k, time in enumerate(times):
    state = np.zeros((2, 2 * count))
    state[:, 2 * k : 2 * k + 2] = np.eye(2)
    add(kalman.H @ state, np.array([10 * time]), kalman.R)
    if k == 0:
        add(state, Fs[0] @ start[:, 0], Fs[0] @ spread @ Fs[0].T + Qs[0])
    else:
        before = np.zeros((2, 2 * count))
        before[:, 2 * k - 2 : 2 * k] = np.eye(2)
        add(state - Fs[k] @ before, np.zeros(2), Qs[k])
exact = np.linalg.solve(information, right).reshape(count, 2)

off_method = np.abs(by_method[..., 0] - exact)
off_function = np.abs(by_function[..., 0] - exact)
print('largest error of the position by the method [m]:', off_method[:, 0].max().round(6))
print('by the function, per time [m]:', off_function[:, 0].round(2))
assert off_method.max() < 1e-6
assert off_function[:, 0].max() > 7
# With equal steps both are the same.
equal = [Fs[1]] * count, [Qs[1]] * count
kalman.x, kalman.P = start.copy(), spread.copy()
means, covariances, _, _ = kalman.batch_filter(list(times), Fs=equal[0], Qs=equal[1])
assert np.allclose(kalman.rts_smoother(means, covariances, *equal)[0], rts_smoother(means, covariances, *equal)[0])
PYTHON
