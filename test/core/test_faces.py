"""Face observations of boxes whose points are placed by hand."""

from boxreg_ros.config import Config
from boxreg_ros.core.method.arrays import BOX_POSE
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.method.faces import fill_insets, fill_visibility, observe_faces
from boxreg_ros.core.method.residuals import TERMS
from boxreg_ros.rotations import matrix_from_rpy
import numpy as np
import pytest
from scenes import no_inputs, problem_of, shared_of

CONFIG = Config()


def visibility(problem):
    """Return the visibility of each face of the first box, (6,)."""
    tangent = np.empty(6)
    fill_visibility(
        problem.boxes[0, 0], problem.origins[0, 0], problem.points, np.empty((3, 3)), np.empty(3),
        tangent,
    )  # fmt: skip
    return tangent


def insets(origins, tangent, ring_height=0.0):
    """Return the multiples of occlusion and range inset (2, 6), insets and weights, (6,) each."""
    shares, inset, weight = np.empty((2, 6)), np.empty(6), np.empty(6)
    record = CONSTANTS.with_settings(CONFIG).record()[0]
    fill_insets(origins, ring_height, tangent, no_inputs()[0], record, shares, inset, weight)
    return shares, inset, weight


def seen_from(origin, points=((0.0, 0, 0),), yaw=0.0, **changes):
    """Return a problem of a box of 4 x 2 x 2 m at the origin, and the sensor at `origin`."""
    box = [0, 0, 0, 4, 2, 2, 0, 0, yaw]
    return problem_of([[box]], points=np.array([[points]]), origins=[[origin]], **changes)


def test_visibility_by_hand():
    # From 12 m ahead and 5 m to the left of a 4 x 2 m box: 10 m before the plane of the front,
    # 4 m to the side of its edge; 4 m before the left plane, 10 m ahead of its edge. It is 14 m
    # on the inner side of the back plane, and 6 m of the right one.
    known = [10 / 4, -14 / 4, 4 / 10, -6 / 10, 9, -9]
    np.testing.assert_allclose(visibility(seen_from([12.0, 5.0, 1.0])), known)


def test_visibility_turns_with_the_box():
    turned = visibility(seen_from([-5.0, 12.0, 1.0], yaw=np.pi / 2))
    np.testing.assert_allclose(turned, visibility(seen_from([12.0, 5.0, 1.0])))


def test_without_a_sensor_faces_toward_the_centre_of_mass_are_visible():
    found = visibility(seen_from([np.nan] * 3, [[-1.5, 0.5, 0.3], [-1.9, 0.8, 0.1]]))
    assert (found[:4] > 0).tolist() == [False, True, True, False]


def test_occlusion_inset_grows_as_a_face_turns_away():
    unknown = np.full((1, 3), np.nan)
    tangents = np.linspace(-50, 50, 201)
    hidden, distant = np.stack([insets(unknown, np.full(6, t))[0] for t in tangents], 1)
    assert (np.diff(hidden, axis=0) <= 0).all()
    np.testing.assert_allclose(hidden[0], 1, atol=1e-4)
    np.testing.assert_allclose(hidden[-1], 0, atol=1e-4)
    assert not distant.any()  # no sensor is known


@pytest.mark.parametrize(
    ('away', 'share'), [(10.0, 0.0), (20.0, 0.0), (45.0, 0.5), (70.0, 1.0), (120.0, 2.0)]
)
def test_range_inset_grows_with_range(away, share):
    # From 20 m on the share grows by 1 in another 50 m; the range is horizontal.
    # Front and roof are visible; back and bottom are occluded and have the occlusion inset only.
    problem = seen_from([0.6 * away, 0.8 * away, 5.0])
    hidden, distant = insets(problem.origins[0, 0], visibility(problem))[0]
    np.testing.assert_allclose(distant, share * (1 - hidden))
    assert (hidden[[0, 2, 4]] < 0.2).all()
    assert (hidden[[1, 3, 5]] > 0.8).all()


def test_range_inset_lowers_the_weight_of_a_face():
    # At 70 m, points 0.15 m inside the roof. With a range inset of 0.08 m, as large as its
    # deviation, the weight is 1/2 and the distance -0.07 m; with 0.16 m the weight is 1/5.
    problem = seen_from([42.0, 56.0, 2.0], on_faces(0.15, faces=(4,)))
    for distant, weight in ((0.0, 1.0), (0.08, 0.5), (0.16, 0.2)):
        found = supported(problem, distant=distant)
        assert found['visibility'][0, 0, 4] == pytest.approx(weight, rel=0.01)
        assert found['distance'][0, 0, 4] == pytest.approx(distant - 0.15, abs=1e-3)
        assert found['inset'][0, 0, 4] == pytest.approx(distant, abs=1e-3)
        assert found['inset'][0, 0, 5] == pytest.approx(0, abs=1e-3)  # the road


def test_a_roof_is_half_a_ring_above_the_highest_ring():
    # The highest of rings h apart is 0 to h below the edge: h / 2 on average, with the variance
    # h^2 / 12. That is as much as the deviation of a roof, 0.08 m, for h = 0.08 sqrt(12).
    h = 0.08 * np.sqrt(12)
    _, inset, weight = insets(np.full((1, 3), np.nan), np.full(6, 9.0), h)
    np.testing.assert_allclose(inset, [0, 0, 0, 0, h / 2, 0], atol=1e-12)
    np.testing.assert_allclose(weight, [1, 1, 1, 1, 0.5, 1], rtol=1e-12)


def test_an_observed_roof_has_the_inset_of_its_rings():
    rings = [[0.2]]
    problem = seen_from([12.0, 16.0, 2.0], on_faces(0.15, faces=(4,)), ring_heights=rings)
    found = supported(problem)
    assert found['distance'][0, 0, 4] == pytest.approx(0.1 - 0.15, abs=1e-6)
    assert found['inset'][0, 0].tolist()[4:] == pytest.approx([0.1, 0], abs=1e-3)


def on_faces(inside, n=40, faces=(0, 2, 4)):
    """Return points on front, left and top of a box of 4 x 2 x 2 m, `inside` m inside."""
    rng = np.random.default_rng(4)
    points = []
    for face in faces:
        axis, sign = face // 2, 1 - 2 * (face % 2)
        p = rng.uniform(-0.9, 0.9, (n, 3)) * [2, 1, 1]
        p[:, axis] = sign * ([2, 1, 1][axis] - inside)
        points.append(p)
    return np.concatenate(points)


def supported(problem, gap=0.0, outermost=0.05, depths=0.0, distant=0.0, poses=None):
    constants = CONSTANTS._replace(outermost=outermost)
    terms = np.zeros(problem.counts.shape, TERMS)
    B = len(problem.boxes)
    observe_faces(
        0, B, np.arange(B), problem,
        np.ascontiguousarray(problem.boxes[..., BOX_POSE]) if poses is None else poses,
        shared_of(B=B, GAP=[gap] * 6), no_inputs(occlusion_inset=depths, range_inset=distant),
        constants.record(), terms,
    )  # fmt: skip
    return terms


@pytest.mark.parametrize('gap', [0.0, 0.04])
def test_distance_of_points_is_counted_from_the_labelling_margin(gap):
    # The points are 0.1 m inside, `gap` of which is expected: the distance is gap - 0.1.
    found = supported(seen_from([30.0, 30.0, 2.0], on_faces(0.1)), gap)
    assert found['visibility'][0, 0].tolist()[:5:2] == [1, 1, 1]
    np.testing.assert_allclose(found['distance'][0, 0, [0, 2, 4]], gap - 0.1, atol=1e-6)
    assert found['num_points'][0, 0] == 120


def test_outermost_points_of_each_strip_by_hand():
    # Twelve of 240 points (0.05) on the front, four in each of the strips between y = -1, -1/3,
    # 1/3 and 1: their moment and their mean.
    rng = np.random.default_rng(5)
    points = np.c_[rng.uniform(1.8, 1.95, 240), rng.uniform(-0.9, 0.9, (240, 2))]
    found = supported(seen_from([30.0, 0.0, 0.0], points))
    strips = [points[(points[:, 1] > y) & (points[:, 1] < y + 2 / 3)] for y in (-1, -1 / 3, 1 / 3)]
    outer = np.concatenate([strip[np.argsort(-strip[:, 0])[:4]] for strip in strips])
    homogeneous = np.c_[outer, np.ones(12)]
    np.testing.assert_allclose(
        found['W_faces'][0, 0, 0], homogeneous.T @ homogeneous / 12, rtol=1e-6
    )
    assert found['distance'][0, 0, 0] == pytest.approx(outer[:, 0].mean() - 2, abs=1e-4)
    assert found['visibility'][0, 0, 0] == 1


def test_the_seen_half_of_a_roof_does_not_roll_the_body():
    # Twelve points of the roof, right of the middle of a box with roll, pitch and yaw, and off the
    # centre of its input: as if each were in the middle, at its height above the box.
    rng = np.random.default_rng(6)
    points = np.c_[rng.uniform(-1.9, 1.9, 60), rng.uniform(-0.9, 0.0, 60), rng.uniform(0.8, 1, 60)]
    shift, angles = np.array([0.1, -0.05, 0.02]), np.array([0.05, -0.1, 0.4])
    R = matrix_from_rpy(angles)
    problem = seen_from([0.0, -30.0, 2.0], points @ R.T + shift)
    found = supported(problem, poses=np.concatenate([shift, angles])[None, None])
    order = np.argsort(-points[:, 2])
    strip = np.floor((points[:, 1] + 1) * 1.5)
    outer = np.concatenate([order[strip[order] == k][:3] for k in range(3)])
    middle = (points[outer] * [1, 0, 1]) @ R.T + shift
    homogeneous = np.c_[middle, np.ones(len(outer))]
    np.testing.assert_allclose(
        found['W_faces'][0, 0, 4], homogeneous.T @ homogeneous / len(outer), atol=1e-6
    )
    assert found['distance'][0, 0, 4] == pytest.approx(points[outer, 2].mean() - 1, abs=1e-6)


@pytest.mark.parametrize(('behind', 'used'), [(0.15, 9), (0.25, 6)])
def test_a_strip_far_behind_the_others_is_left_out(behind, used):
    # The left strip of the front is 0.15 or 0.25 m behind the other two; 0.2 m is the limit.
    # Of 60 points each strip takes the minimum, three.
    y = np.repeat([-0.7, 0.0, 0.7], 20)
    points = np.c_[np.where(y > 0.5, 1.9 - behind, 1.9), y, np.tile(np.linspace(-0.8, 0.8, 20), 3)]
    found = supported(seen_from([30.0, 0.0, 0.0], points))
    mean = 1.9 - (behind / 3 if used == 9 else 0.0)
    assert found['distance'][0, 0, 0] == pytest.approx(mean - 2, abs=1e-4)
    side = found['W_faces'][0, 0, 0][1, 3]  # mean y
    assert side == pytest.approx(0.0 if used == 9 else -0.35, abs=1e-6)


def test_strips_without_points_are_left_out():
    # Two points in one strip, two in the next, none in the last: the mean of four.
    points = np.array([[1.9, -0.7, 0.1], [1.8, -0.6, 0.2], [1.9, 0.0, 0.3], [1.8, 0.1, 0.4]])
    found = supported(seen_from([30.0, 0.0, 0.0], points))
    assert found['distance'][0, 0, 0] == pytest.approx(-0.15, abs=1e-4)
    np.testing.assert_allclose(found['W_faces'][0, 0, 0][3, :3], points.mean(0), atol=1e-6)


def test_occluded_faces_have_less_weight():
    # Points on front and back, seen from the front.
    points = on_faces(0.05, faces=(0, 1, 2))
    found = supported(seen_from([30.0, 0.0, 0.0], points))
    assert found['visibility'][0, 0, 0] == 1
    assert found['visibility'][0, 0, 1] < 1


def test_a_face_without_points_has_no_weight():
    # Two points are fewer than the minimum.
    found = supported(seen_from([30.0, 0.0, 0.0], on_faces(0.05, n=2, faces=(0,))))
    assert found['visibility'][0, 0, 0] == 0
    assert np.isfinite(found['distance']).all()
    assert np.isfinite(found['W_faces']).all()


def test_points_beyond_the_margin_are_left_out():
    # 1 m ahead of the front is beyond the margin of 0.35 m.
    found = supported(seen_from([30.0, 0.0, 0.0], on_faces(-1.0, faces=(0,))))
    assert found['visibility'][0, 0, 0] == 0
    assert found['num_points'][0, 0] == 0


def test_the_road_is_the_observation_of_the_bottom():
    # The road is 1.2 m below the centre of a box whose bottom is 1 m below it: 0.2 m too high.
    problem = seen_from([30.0, 0.0, 0.0], on_faces(0.0), ground=[[-1.2]])
    found = supported(problem)
    assert found['visibility'][0, 0, 5] == 1
    assert found['distance'][0, 0, 5] == pytest.approx(0.2)
    assert supported(seen_from([30.0, 0.0, 0.0], on_faces(0.0)))['visibility'][0, 0, 5] == 0


def test_order_and_padding_of_points_do_not_matter():
    rng = np.random.default_rng(6)
    points = np.array([[on_faces(0.05), on_faces(0.1)]]) + 0.02 * rng.normal(size=(1, 2, 120, 3))
    mask = rng.random((1, 2, 120)) < 0.8
    boxes = [[[0, 0, 0, 4, 2, 2, 0, 0, 0]] * 2]
    order = rng.permutation(120)
    known, found = (
        supported(problem, 0.0, 0.2, 1.0, 1.0)
        for problem in (
            problem_of(boxes, points=points, mask=mask, origins=[[[9.0, 9.0, 9.0]] * 2]),
            problem_of(
                boxes,
                points=np.pad(points[:, :, order], [(0, 0), (0, 0), (0, 7), (0, 0)]),
                mask=np.pad(mask[:, :, order], [(0, 0), (0, 0), (0, 7)]),
                origins=[[[9.0, 9.0, 9.0]] * 2],
            ),
        )
    )
    for name in ('W_faces', 'distance', 'visibility', 'num_points'):
        np.testing.assert_allclose(found[name], known[name], atol=1e-7)


def test_points_are_motion_compensated_to_the_stamp():
    # A car at 10 m/s, points on its front measured 50 ms before each stamp: half a metre back.
    boxes = np.array([[[i * 1.0, 0, 0, 4, 2, 2, 0, 0, 0] for i in range(4)]])
    front = on_faces(0.0, faces=(0,))
    points = np.tile(front - [0.5, 0, 0], (1, 4, 1, 1))
    origins = np.array([[[30.0, 0, 0]] * 4])
    late = problem_of(boxes, points=points, origins=origins, delays=np.full((1, 4, 40), -0.05))
    found = supported(late)
    np.testing.assert_allclose(found['distance'][..., 0], 0, atol=1e-6)
    still = problem_of(boxes, points=points, origins=origins)
    assert (supported(still)['distance'][..., 0] < -0.4).all()


def test_motion_compensation_does_not_depend_on_padding():
    # The same two boxes alone, and padded to three as a window of a batch is.
    boxes = np.array([[[i * 1.0, 0, 0, 4, 2, 2, 0, 0, 0] for i in (0, 1, 1)]])
    points = np.tile(on_faces(0.0, faces=(0,)) - [0.5, 0, 0], (1, 3, 1, 1))
    whole = problem_of(
        boxes, points=points, delays=np.full((1, 3, 40), -0.05), valid=[[True, True, False]],
        origins=np.full((1, 3, 3), 30.0),
    )  # fmt: skip
    alone = problem_of(
        boxes[:, :2], points=points[:, :2], delays=np.full((1, 2, 40), -0.05),
        origins=np.full((1, 2, 3), 30.0),
    )  # fmt: skip
    found, known = supported(whole)['distance'][:, :2], supported(alone)['distance']
    np.testing.assert_allclose(known[..., 0], 0, atol=1e-6)
    np.testing.assert_allclose(found, known)


def test_a_single_observation_has_no_velocity():
    points = on_faces(0.0, faces=(0,))
    once = seen_from([30.0, 0.0, 0.0], points, delays=np.full((1, 1, 40), -0.05))
    assert supported(once)['distance'][0, 0, 0] == pytest.approx(0, abs=1e-6)
