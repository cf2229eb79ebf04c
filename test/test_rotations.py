"""Angles, matrices and quaternions against SciPy and each other."""

from boxreg_ros.rotations import (
    GIMBAL_LOCK,
    interpolate_rotation,
    matrix_from_quaternion,
    matrix_from_rpy,
    quaternion_from_matrix,
    quaternion_from_rpy,
    rpy_from_matrix,
    rpy_from_quaternion,
    wrap_angle,
)
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp
import torch


def random_rpy(*shape):
    """Return angles of any number of turns, pitch away from the poles."""
    rpy = np.random.default_rng(0).uniform(-7, 7, (*shape, 3))
    rpy[..., 1] = np.random.default_rng(1).uniform(-1.5, 1.5, shape)
    return rpy


# --- wrap_angle ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'angle, wrapped',
    [
        (0.0, 0.0),
        (3.5, 3.5 - 2 * np.pi),
        (-3.5, 2 * np.pi - 3.5),
        (7 * np.pi / 2, -np.pi / 2),
        (np.pi, -np.pi),
        (-np.pi, -np.pi),
    ],
)
@pytest.mark.parametrize('kind', [float, np.float64, torch.tensor])
def test_wrap_angle_of_known_angles(angle, wrapped, kind):
    kwargs = {'dtype': torch.float64} if kind is torch.tensor else {}
    assert float(wrap_angle(kind(angle, **kwargs))) == pytest.approx(wrapped, abs=1e-14)


def test_wrap_angle_equals_the_angle_of_its_sine_and_cosine():
    angle = np.random.default_rng(2).uniform(-20, 20, (50, 3))
    np.testing.assert_allclose(
        wrap_angle(angle), np.arctan2(np.sin(angle), np.cos(angle)), atol=1e-14
    )


def test_wrap_angle_keeps_type_shape_and_gradient_of_a_tensor():
    angle = torch.linspace(-9, 9, 12, dtype=torch.float64).reshape(3, 4).requires_grad_()
    wrapped = wrap_angle(angle)
    (gradient,) = torch.autograd.grad(wrapped.sum(), angle)
    assert wrapped.shape == (3, 4)
    np.testing.assert_array_equal(gradient, 1.0)
    assert wrap_angle(angle.detach().float()).dtype == torch.float32


def test_wrap_angle_of_integers_nan_and_nothing():
    np.testing.assert_allclose(wrap_angle(np.array([0, 4])), [0, 4 - 2 * np.pi])
    np.testing.assert_array_equal(wrap_angle([np.nan, 1.0]), [np.nan, 1.0])
    assert wrap_angle([]).shape == (0,)
    assert wrap_angle(np.zeros((2, 0, 3))).shape == (2, 0, 3)


# --- known answers ------------------------------------------------------------------------------


def test_matrix_equals_scipy():
    rpy = random_rpy(100)
    scipy = Rotation.from_euler('ZYX', rpy[:, ::-1]).as_matrix()
    np.testing.assert_allclose(matrix_from_rpy(rpy), scipy, atol=1e-14)


@pytest.mark.parametrize('norm', [1e-200, 1e-3, -7.0, 1e200])
def test_matrix_of_a_quaternion_of_any_norm_equals_scipy(norm):
    quaternion_xyzw = np.random.default_rng(4).normal(size=(50, 4))
    scipy = Rotation.from_quat(quaternion_xyzw).as_matrix()
    np.testing.assert_allclose(matrix_from_quaternion(norm * quaternion_xyzw), scipy, atol=1e-14)


def test_quaternion_of_norm_zero_is_refused():
    with pytest.raises(ValueError, match='zero norm'):
        matrix_from_quaternion([0.0, 0.0, 0.0, 0.0])


# --- round trips --------------------------------------------------------------------------------


def test_matrix_and_angles_round_trip():
    rpy = random_rpy(200)
    found = rpy_from_matrix(matrix_from_rpy(rpy))
    np.testing.assert_allclose(found, wrap_angle(rpy), atol=1e-12)


def test_quaternion_and_angles_round_trip():
    rpy = random_rpy(200)
    quaternion_xyzw = quaternion_from_rpy(rpy)
    np.testing.assert_allclose(rpy_from_quaternion(quaternion_xyzw), wrap_angle(rpy), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(quaternion_xyzw, axis=1), 1, atol=1e-15)


def test_w_of_a_quaternion_is_not_negative():
    quaternion_xyzw = quaternion_from_rpy(random_rpy(500))
    assert quaternion_xyzw[:, 3].min() >= 0
    single = quaternion_from_rpy([0.0, 0.0, 1.9 * np.pi])
    np.testing.assert_allclose(
        single, [0, 0, -np.sin(0.05 * np.pi), np.cos(0.05 * np.pi)], atol=1e-15
    )


# --- gimbal lock --------------------------------------------------------------------------------


@pytest.mark.parametrize('pitch', [np.pi / 2, -np.pi / 2])
@pytest.mark.parametrize('roll, yaw', [(0.0, 0.0), (0.0, 0.7), (0.3, -0.2), (-2.0, 2.5)])
def test_gimbal_lock_puts_the_rotation_into_yaw(pitch, roll, yaw):
    # At pitch +-90 degrees R depends on yaw - roll or yaw + roll alone.
    R = matrix_from_rpy([roll, pitch, yaw])
    found = rpy_from_matrix(R)
    sign = np.sign(pitch)
    known = [0.0, pitch, wrap_angle(yaw - sign * roll)]
    np.testing.assert_allclose(found, known, atol=1e-8)
    np.testing.assert_allclose(matrix_from_rpy(found), R, atol=1e-8)


@pytest.mark.parametrize('distance', [0.0, 1e-12, 1e-10, 1e-8, 1e-4])
def test_matrix_is_recovered_near_gimbal_lock(distance):
    rpy = np.array([0.4, np.pi / 2 - distance, -1.1])
    R = matrix_from_rpy(rpy)
    found = rpy_from_matrix(R)
    np.testing.assert_allclose(matrix_from_rpy(found), R, atol=2 * GIMBAL_LOCK)
    assert (found[0] == 0) == (distance < GIMBAL_LOCK)


# --- NaN, dimensions ----------------------------------------------------------------------------

CONVERSIONS = [
    (matrix_from_rpy, (3,), (3, 3)),
    (rpy_from_matrix, (3, 3), (3,)),
    (matrix_from_quaternion, (4,), (3, 3)),
    (quaternion_from_matrix, (3, 3), (4,)),
    (rpy_from_quaternion, (4,), (3,)),
    (quaternion_from_rpy, (3,), (4,)),
]
each_conversion = pytest.mark.parametrize('function, given, returned', CONVERSIONS)


def valid_input(given, *leading):
    rpy = random_rpy(*leading)
    if given == (3, 3):
        return matrix_from_rpy(rpy)
    return quaternion_from_rpy(rpy) if given == (4,) else rpy


@each_conversion
@pytest.mark.parametrize('leading', [(), (1,), (4,), (2, 3)])
def test_any_leading_dimensions(function, given, returned, leading):
    values = valid_input(given, *leading)
    found = function(values)
    assert found.shape == (*leading, *returned)
    for index in np.ndindex(leading):
        np.testing.assert_allclose(found[index], function(values[index]), atol=1e-15)


@each_conversion
@pytest.mark.parametrize('leading', [(0,), (3, 0), (0, 2)])
def test_empty_arrays(function, given, returned, leading):
    assert function(np.zeros((*leading, *given))).shape == (*leading, *returned)


@each_conversion
def test_nan_gives_nan_in_its_row_only(function, given, returned):
    values = valid_input(given, 3)
    known = function(values)
    values[1] = np.nan
    found = function(values)
    assert found.shape == (3, *returned)
    assert np.isnan(found[1]).all()
    np.testing.assert_allclose(found[[0, 2]], known[[0, 2]], atol=1e-15)
    assert np.isnan(function(np.full(given, np.nan))).all()


# --- interpolation ------------------------------------------------------------------------------


@pytest.mark.parametrize('distance', [0.0, 1e-12, 1e-4, 1.0])
def test_interpolation_equals_scipy(distance):
    first, step = np.random.default_rng(5).normal(size=(2, 4))
    second = first + distance * step
    slerp = Slerp([0, 1], Rotation.from_quat([first, second]))
    for share in (0.0, 0.3, 1.0):
        for end in (second, -second):
            found = interpolate_rotation(first, end, share)
            np.testing.assert_allclose(found, slerp(share).as_matrix(), atol=1e-14)
