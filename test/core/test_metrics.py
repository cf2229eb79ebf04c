"""Overlap and pose errors against values calculated by hand, shapely, Qhull and Monte Carlo."""

from boxreg_ros.core.metrics import iou_3d, iou_bev, pose_errors
from boxreg_ros.errors import ShapeError
import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection
from scipy.spatial.transform import Rotation
from shapely import affinity, geometry

CAR = np.array([[10.0, -5.0, 1.0, 4.5, 1.9, 1.6, 0.0, 0.0, 0.3]])


def pairs(n, rng, tilt):
    a = np.c_[
        rng.uniform(-1, 1, (n, 3)), rng.uniform(1, 5, (n, 3)),
        rng.uniform(-tilt, tilt, (n, 2)), rng.uniform(-4, 4, n),
    ]  # fmt: skip
    b = a.copy()
    b[:, :3] += rng.normal(0, 0.7, (n, 3))
    b[:, 3:6] *= rng.uniform(0.7, 1.3, (n, 3))
    b[:, 6:8] += rng.uniform(-tilt, tilt, (n, 2))
    b[:, 8] += rng.normal(0, 0.7, n)
    return a, b


def footprint(box):
    x, y, _, length, width, *_, yaw = box
    upright = geometry.box(x - length / 2, y - width / 2, x + length / 2, y + width / 2)
    return affinity.rotate(upright, yaw, use_radians=True)


def shared_volume(a, b):
    """Return the volume of an intersection by Qhull."""
    planes = []
    for box in (a, b):
        axes = Rotation.from_euler('ZYX', box[[8, 7, 6]]).as_matrix().T
        for normal, half in zip([*axes, *-axes], [*box[3:6], *box[3:6]], strict=True):
            planes.append([*normal, -(normal @ box[:3] + half / 2)])
    planes = np.array(planes)
    inside = linprog(
        [0, 0, 0, -1], A_ub=np.c_[planes[:, :3], np.ones(12)], b_ub=-planes[:, 3],
        bounds=[(None, None)] * 3 + [(0, None)],
    )  # fmt: skip
    if inside.status != 0 or inside.x[3] < 1e-6:
        return 0.0
    return ConvexHull(HalfspaceIntersection(planes, inside.x[:3]).intersections).volume


def test_bev_equals_shapely():
    a, b = pairs(300, np.random.default_rng(1), tilt=0.5)
    known = []
    for one, other in zip(map(footprint, a), map(footprint, b), strict=True):
        known.append(one.intersection(other).area / one.union(other).area)
    np.testing.assert_allclose(iou_bev(a, b), known, atol=1e-7)
    assert 0.1 < np.mean(known) < 0.9


@pytest.mark.parametrize('tilt', [0.0, 0.05, 1.5])
def test_3d_equals_qhull(tilt):
    a, b = pairs(60, np.random.default_rng(2), tilt)
    shared = np.array([shared_volume(*pair) for pair in zip(a, b, strict=True)])
    volumes = a[:, 3:6].prod(axis=1) + b[:, 3:6].prod(axis=1)
    np.testing.assert_allclose(iou_3d(a, b), shared / (volumes - shared), atol=1e-6)
    assert shared.max() > 1


@pytest.mark.parametrize('iou', [iou_bev, iou_3d])
def test_iou_of_known_pairs(iou):
    def moved(**change):
        box = CAR.copy()
        for column, value in change.items():
            box[:, int(column[1:])] += value
        return box

    heading = np.array([np.cos(0.3), np.sin(0.3)])
    forward = CAR.copy()
    forward[:, :2] += heading * 1.5  # 3 of 4.5 m shared
    assert iou(CAR, CAR)[0] == pytest.approx(1.0, abs=1e-8)
    assert iou(CAR, moved(c8=np.pi))[0] == pytest.approx(1.0, abs=1e-8)
    assert iou(CAR, moved(c0=100.0))[0] == 0
    assert iou(CAR, forward)[0] == pytest.approx(3 / 6, abs=1e-8)
    touching = CAR.copy()
    touching[:, :2] += heading * 4.5
    assert iou(CAR, touching)[0] == pytest.approx(0.0, abs=1e-8)
    inner = CAR.copy()
    inner[:, 3:6] /= 2
    power = 2 if iou is iou_bev else 3
    assert iou(CAR, inner)[0] == pytest.approx(0.5**power, abs=1e-8)
    assert iou(inner, CAR)[0] == pytest.approx(0.5**power, abs=1e-8)


def test_height_affects_iou_3d_only():
    raised = CAR + np.eye(9)[2] * 0.8  # half of 1.6 m shared
    assert iou_3d(CAR, raised)[0] == pytest.approx(1 / 3, abs=1e-8)
    assert iou_bev(CAR, raised)[0] == pytest.approx(1.0, abs=1e-8)


@pytest.mark.parametrize('size', [1e-13, 1e-10, 1e-8, 1e-6])
def test_almost_equal_boxes_overlap_fully(size):
    rng = np.random.default_rng(4)
    a, _ = pairs(300, rng, tilt=0.1)
    a[::2, 6:8] = 0
    b = a.copy()
    b[:, [0, 1, 2, 6, 7, 8]] += rng.normal(0, size, (300, 6))
    assert iou_3d(a, b).min() > 1 - 1e-4
    assert iou_bev(a, b).min() > 1 - 1e-4


def test_iou_is_accurate_far_from_the_origin():
    a, b = pairs(50, np.random.default_rng(5), tilt=0.1)
    far = np.array([4e5, 5e6, 100, 0, 0, 0, 0, 0, 0])
    np.testing.assert_allclose(iou_3d(a + far, b + far), iou_3d(a, b), atol=1e-6)


def test_many_rows_equal_one_at_a_time():
    a, b = pairs(1203, np.random.default_rng(6), tilt=0.2)
    rows = [0, 999, 1000, 1202]
    single = [iou_3d(a[i : i + 1], b[i : i + 1])[0] for i in rows]
    np.testing.assert_allclose(iou_3d(a, b)[rows], single, rtol=1e-12)


def test_invalid_boxes_overlap_with_nothing():
    broken = np.repeat(CAR, 4, axis=0)
    broken[0, 0], broken[1, 3], broken[2, 3:5], broken[3, 8] = np.nan, 0.0, -1.0, np.inf
    np.testing.assert_array_equal(iou_3d(broken, np.repeat(CAR, 4, axis=0)), 0)
    assert iou_3d(np.zeros((0, 9)), np.zeros((0, 9))).shape == (0,)


def test_pose_errors_by_hand():
    truth = np.repeat(CAR, 2, axis=0)
    boxes = truth.copy()
    boxes[0, :2] += [-np.sin(0.3), np.cos(0.3)]  # 1 m to the left
    boxes[0, 8] += 2 * np.pi + 0.1
    boxes[1, 8] += np.pi - 0.1
    boxes[1, 3:6] += [0.5, -0.1, 0.2]
    errors = pose_errors(boxes, truth)
    np.testing.assert_allclose(errors.translation, [[0, 1, 0], [0, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(errors.rotation[:, 2], [0.1, np.pi - 0.1], atol=1e-12)
    np.testing.assert_allclose(errors.extent[1], [0.5, -0.1, 0.2])
    assert errors.is_flipped.tolist() == [False, True]


def test_wrong_shapes_are_refused():
    with pytest.raises(ShapeError, match=r'truth: expected shape \(1, 9\), got \(2, 9\)'):
        iou_3d(CAR, np.repeat(CAR, 2, axis=0))
    with pytest.raises(ShapeError, match=r'expected shape \(N, 9\)'):
        iou_bev(CAR[:, :7], CAR)
