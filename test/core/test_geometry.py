"""Box geometry against SciPy, finite differences and values calculated by hand."""

from boxreg_ros.core.geometry import (
    FACE_AXIS,
    face_distances,
    FACE_SIGN,
    rotation_derivatives,
    rotation_from_rpy,
)
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
import torch

# At (1, 2, 3), 4 x 2 x 1.5 m, heading along +y: its left is -x.
TURNED = torch.tensor([1.0, 2.0, 3.0, 4.0, 2.0, 1.5, 0.0, 0.0, np.pi / 2], dtype=torch.float64)


def angles(*shape):
    rpy = np.random.default_rng(1).uniform(-4, 4, (*shape, 3))
    rpy.reshape(-1, 3)[:3] = [[0, 0, 0], [0.3, np.pi / 2, -0.2], [np.pi, -np.pi / 2, np.pi]]
    return torch.from_numpy(rpy)


def test_rotation_equals_scipy():
    rpy = angles(200)
    known = Rotation.from_euler('ZYX', rpy.numpy()[:, ::-1]).as_matrix()
    np.testing.assert_allclose(rotation_from_rpy(rpy), known, atol=1e-14)


def test_derivatives_equal_finite_differences():
    # Central differences of sines: error step^2 / 6 + 1e-16 / step, 1e-10 at this step.
    rpy, step = angles(50), 1e-5
    R, dR = rotation_derivatives(rpy)
    np.testing.assert_array_equal(R, rotation_from_rpy(rpy))
    for k in range(3):
        move = step * torch.eye(3, dtype=torch.float64)[k]
        known = (rotation_from_rpy(rpy + move) - rotation_from_rpy(rpy - move)) / (2 * step)
        np.testing.assert_allclose(dR[:, k], known, atol=1e-9)


@pytest.mark.parametrize('function', [rotation_from_rpy, lambda rpy: rotation_derivatives(rpy)[1]])
def test_any_leading_dimensions(function):
    rpy = angles(2, 4, 3)
    many = function(rpy)
    for index in np.ndindex(2, 4, 3):
        np.testing.assert_array_equal(many[index], function(rpy[index]))
    assert function(rpy[:0]).shape == (0, *many.shape[1:])


def test_face_distances_equal_scipy():
    rng = np.random.default_rng(2)
    local, boxes = rng.normal(size=(20, 30, 3)), rng.normal(size=(20, 9))
    turned = Rotation.from_euler('ZYX', boxes[:, [8, 7, 6]]).as_matrix()
    points = local @ turned.swapaxes(1, 2) + boxes[:, None, :3]
    found = face_distances(torch.from_numpy(points), torch.from_numpy(boxes))
    known = local[..., FACE_AXIS] * FACE_SIGN.numpy() - boxes[:, None, 3:6][..., FACE_AXIS] / 2
    np.testing.assert_allclose(found, known, atol=1e-13)


def test_face_distances_by_hand():
    # Local (3, 0, 1) in 4 x 2 x 1.5 m. Front: 3 - 2; back: -3 - 2; left and right: 0 - 1;
    # top: 1 - 0.75; bottom: -1 - 0.75.
    point = torch.tensor([[1.0, 5.0, 4.0]], dtype=torch.float64)
    known = [[1.0, -5.0, -1.0, -1.0, 0.25, -1.75]]
    np.testing.assert_allclose(face_distances(point, TURNED), known, atol=1e-14)


def test_face_distances_of_corners():
    # A corner lies on three faces; its distance from the opposite ones is minus the extent.
    rng = np.random.default_rng(3)
    box = rng.normal(size=9)
    box[3:6] = 4.5, 1.9, 1.6
    signs = np.array(list(np.ndindex(2, 2, 2))) * 2 - 1
    R = Rotation.from_euler('ZYX', box[[8, 7, 6]]).as_matrix()
    corners = torch.from_numpy(signs * box[3:6] / 2 @ R.T + box[:3])
    on_positive = np.repeat(signs > 0, 2, axis=1)
    is_on_face = on_positive == (FACE_SIGN.numpy() > 0)
    known = np.where(is_on_face, 0.0, -box[3:6][FACE_AXIS])
    np.testing.assert_allclose(face_distances(corners, torch.from_numpy(box)), known, atol=1e-13)


def test_face_distances_do_not_depend_on_the_frame():
    # A rotation about z and a shift of boxes and points change nothing.
    rng = np.random.default_rng(4)
    points, boxes = rng.normal(size=(5, 10, 3)), rng.normal(size=(5, 9))
    angle, shift = 0.7, np.array([5.0, -3.0, 2.0])
    R = Rotation.from_euler('z', angle).as_matrix()
    moved = boxes.copy()
    moved[:, :3] = boxes[:, :3] @ R.T + shift
    moved[:, 8] += angle
    before = face_distances(torch.from_numpy(points), torch.from_numpy(boxes))
    after = face_distances(torch.from_numpy(points @ R.T + shift), torch.from_numpy(moved))
    np.testing.assert_allclose(after, before, atol=1e-13)
