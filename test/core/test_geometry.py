"""Box geometry against SciPy and values calculated by hand."""

from boxreg_ros.core.geometry import FACE_AXIS, face_distances, FACE_SIGN, rotation_from_rpy
import numpy as np
from scipy.spatial.transform import Rotation
import torch


def angles(*shape):
    rpy = np.random.default_rng(1).uniform(-4, 4, (*shape, 3))
    rpy.reshape(-1, 3)[:3] = [[0, 0, 0], [0.3, np.pi / 2, -0.2], [np.pi, -np.pi / 2, np.pi]]
    return torch.from_numpy(rpy)


def test_rotation_equals_scipy():
    rpy = angles(200)
    known = Rotation.from_euler('ZYX', rpy.numpy()[:, ::-1]).as_matrix()
    np.testing.assert_allclose(rotation_from_rpy(rpy), known, atol=1e-14)


def test_any_leading_dimensions():
    rpy = angles(2, 4, 3)
    many = rotation_from_rpy(rpy)
    for index in np.ndindex(2, 4, 3):
        np.testing.assert_array_equal(many[index], rotation_from_rpy(rpy[index]))
    assert rotation_from_rpy(rpy[:0]).shape == (0, *many.shape[1:])


def test_face_distances_equal_scipy():
    rng = np.random.default_rng(2)
    local, boxes = rng.normal(size=(20, 30, 3)), rng.normal(size=(20, 9))
    turned = Rotation.from_euler('ZYX', boxes[:, [8, 7, 6]]).as_matrix()
    points = local @ turned.swapaxes(1, 2) + boxes[:, None, :3]
    found = face_distances(torch.from_numpy(points), torch.from_numpy(boxes))
    known = local[..., FACE_AXIS] * FACE_SIGN.numpy() - boxes[:, None, 3:6][..., FACE_AXIS] / 2
    np.testing.assert_allclose(found, known, atol=1e-13)
