#!/usr/bin/env bash
# guess: P of norfair's FilterPyKalmanFilterFactory multiplies the initial variances of the positions alone, as its docstring states, so that its
#        filter begins as that of OptimizedKalmanFilterFactory with pos_variance of the same value, whose defaults are the same 10.
# happens: P multiplies the variances of the velocities; those of the positions stay 1. With the defaults the two factories begin with variances
#          (1, 10) and (10, 1): after one step of 1 m the velocities are 0.62 and 0.07 m a step. With pos_variance 1 and vel_variance 10 the second
#          has 0.66 m a step.
# versions: norfair 2.3.0, filterpy 1.4.5, numpy 1.26.4, scipy 1.17.1
# date: 2026-12-03
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check norfair==2.3.0 filterpy==1.4.5 numpy==1.26.4 scipy==1.17.1
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

from norfair.filter import FilterPyKalmanFilterFactory, OptimizedKalmanFilterFactory
import numpy as np

print(*(f'{name} {version(name)}' for name in ('norfair', 'filterpy', 'numpy', 'scipy')))
START = np.zeros((1, 3))  # one point in 3D


def first(factory):
    """Return the way along x and the velocity after the first step of 1 m."""
    kalman = factory.create_filter(START)
    kalman.predict()
    kalman.update(np.array([[1.0], [0.0], [0.0]]))
    return float(kalman.x[0, 0]), float(kalman.x[3, 0])


kalman = FilterPyKalmanFilterFactory(P=10.0).create_filter(START)
variances = np.diag(kalman.P).tolist()
print('variances of the positions', variances[:3], 'of the velocities', variances[3:])
assert variances == [1.0] * 3 + [10.0] * 3
optimized = OptimizedKalmanFilterFactory().create_filter(START)
print('optimized', optimized.pos_variance.ravel().tolist(), optimized.vel_variance.ravel().tolist())
assert (optimized.pos_variance == 10).all() and (optimized.vel_variance == 1).all()

one, other = first(FilterPyKalmanFilterFactory()), first(OptimizedKalmanFilterFactory())
print('after one step of 1 m: filterpy %.2f m, %.2f m a step; optimized %.2f m, %.2f m a step' % (*one, *other))
assert np.isclose(one[1], 0.62, atol=0.01) and np.isclose(other[1], 0.07, atol=0.01)
exchanged = first(OptimizedKalmanFilterFactory(pos_variance=1, vel_variance=10))
print('optimized with pos_variance 1 and vel_variance 10: %.2f m, %.2f m a step' % exchanged)
assert np.isclose(exchanged[1], 0.66, atol=0.01)
PYTHON
