"""Observations of boxes in a sweep, against values calculated by hand and plain loops."""

from boxreg_ros.config import Config
from boxreg_ros.core.observation import farthest_point_sample, observe
from boxreg_ros.structures import Sweep
import numpy as np
import pytest
from scenes import Seen
from scipy.spatial.transform import Rotation

STAMP_NS = 5 * 10**8
CAR = np.array([10.0, 20.0, 1.0, 4.0, 2.0, 2.0, 0.0, 0.0, 0.0])  # stands on z = 0


def sweep(points, **more):
    return Sweep(STAMP_NS, 'odom', np.asarray(points, dtype=np.float32).reshape(-1, 3), **more)


def observed(points, *boxes, changes=None, **more):
    config = Config().updated(changes or {})
    table = observe(sweep(points, **more), np.array(boxes), STAMP_NS, config)
    return [Seen(table, row) for row in range(len(boxes))]


def near(*offsets):
    return CAR[:3] + np.array(offsets)


def rows(array):
    return sorted(map(tuple, np.round(np.asarray(array, dtype=float), 4).tolist()))


def road(height, inside=0.5, count=40):
    """Return points `inside` m left of the car, along its side."""
    x = CAR[0] + np.linspace(-2, 2, count)
    return np.c_[x, np.full(count, CAR[1] + CAR[4] / 2 + inside), np.broadcast_to(height, count)]


# --- crop ---------------------------------------------------------------------------------------


@pytest.mark.parametrize('axis, sign', [(0, 1), (0, -1), (1, 1), (1, -1), (2, 1)])
def test_points_within_the_margin_are_kept(axis, sign):
    # The margin is 0.6 m: of two points 0.59 m and 0.61 m out of a face one is kept.
    offsets = np.zeros((2, 3))
    offsets[:, axis] = sign * (CAR[3 + axis] / 2 + np.array([0.59, 0.61]))
    (seen,) = observed(CAR[:3] + offsets, CAR)
    np.testing.assert_allclose(seen.points, offsets[:1], atol=1e-5)
    assert seen.points.dtype == np.float32
    assert seen.num_points == 0  # both are outside the box itself


def test_observation_is_relative_to_the_center():
    times = np.array([0.05, -0.02])
    origin = np.array([1.0, 2.0, 3.0])
    changes = {'sampling.deskew': True}
    points = near([1.0, 0, 0], [-1.0, 0, 0])
    (seen,) = observed(points, CAR, changes=changes, times=times, origin=origin)
    assert seen.stamp_ns == STAMP_NS
    np.testing.assert_array_equal(seen.box, CAR)
    np.testing.assert_array_equal(seen.origins, [origin - CAR[:3]])
    assert seen.num_points == 2
    by_x = np.argsort(seen.points[:, 0])
    np.testing.assert_allclose(seen.points[by_x], [[-1, 0, 0], [1, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(seen.delays[by_x], [-0.02, 0.05], atol=1e-8)


@pytest.mark.parametrize(
    'changes, more', [({'sampling.deskew': False}, {'times': np.ones(1)}), ({}, {})]
)
def test_delays_are_zero_without_deskew_or_times(changes, more):
    (seen,) = observed(near([1.0, 0, 0]), CAR, changes=changes, **more)
    np.testing.assert_array_equal(seen.delays, [0.0])


@pytest.mark.parametrize('points', [np.empty((0, 3)), [[1e4, -1e4, 0.0]]])
def test_observation_without_points(points):
    (seen,) = observed(points, CAR)
    assert seen.points.shape == (0, 3)
    assert seen.delays.shape == (0,)
    assert seen.num_points == 0
    assert np.isnan(seen.ground)


@pytest.mark.parametrize('kind', [np.float32, np.float64])
@pytest.mark.parametrize(
    'x, y',
    [
        (0.0, 0.0),  # around the cells that lie on both sides of zero
        (-0.4, -300.7),
        (255.5, 256.0),  # cell 255 * 256 + 255 is the last of the raster, the next is its first
        (-256.0, 0.3),
        (4000.2, -7000.9),
    ],
)
def test_the_crop_is_the_same_at_any_position(x, y, kind):
    # Offsets in eighths of a metre are exact; the box reaches 0.6 m beyond 2 m and 1 m, and above
    # its bottom by 0.2 m. Turned by a right angle, length and width change places.
    offsets = np.array(np.meshgrid(*[np.arange(-4, 4.1, 0.125)] * 2, [0.25])).reshape(3, -1).T
    center = np.array([np.float32(x), np.float32(y), 1.0], dtype=float)
    for yaw, (a, b) in ((0.0, (2.6, 1.6)), (np.pi / 2, (1.6, 2.6))):
        box = np.r_[center, CAR[3:6], 0, 0, yaw]
        scan = Sweep(STAMP_NS, 'odom', (center + offsets).astype(kind))
        config = Config().updated({'sampling.points': 10000})
        seen = Seen(observe(scan, box[None], STAMP_NS, config), 0)
        known = offsets[(np.abs(offsets[:, 0]) < a) & (np.abs(offsets[:, 1]) < b)]
        # At (4000, -7000) numbers of 32 bits are 0.0005 m apart.
        np.testing.assert_allclose(rows(seen.points), rows(known), atol=5e-4)


def test_boxes_that_share_cell_numbers_do_not_share_points():
    # At these offsets the 16-bit numbers of the raster cells are the same.
    apart = [[256, 0], [0, 65536], [-256, 0], [1, -256], [0, 0], [512, 0]]
    boxes = CAR + np.pad(apart, [(0, 0), (0, 7)])
    heights = np.linspace(0.0, 0.5, 6)  # of the one point in each box, all different
    seen = observed(boxes[:, :3] + np.c_[np.zeros((6, 2)), heights], *boxes)
    assert [observation.points[:, 2].tolist() for observation in seen] == [
        [pytest.approx(height, abs=1e-6)] for height in heights
    ]


@pytest.mark.parametrize('length, width', [(2000.0, 3.0), (3.0, 2000.0), (600.0, 600.0)])
def test_a_box_larger_than_the_raster_gets_each_point_once(length, width):
    rng = np.random.default_rng(11)
    box = np.array([40.5, -80.5, 1.0, length, width, 2.0, 0, 0, 0])
    points = box[:3] + rng.uniform(-0.5, 0.5, (5000, 3)) * [length, width, 0.5]
    changes = {'sampling.points': 100000, 'sampling.deskew': True}
    seen, other = observed(points, box, CAR + 5000.0, changes=changes, times=np.arange(5000.0))
    assert seen.num_points == 5000
    assert sorted(seen.delays) == list(range(5000))
    assert len(other.points) == 0


def test_points_are_sorted_by_x_then_by_row():
    # Every third point of each box is kept; points of equal x are in the order of the sweep.
    rng = np.random.default_rng(12)
    x = 10.0 + rng.integers(-4, 5, 600) * 0.25
    points = np.c_[x, 20 + rng.uniform(-0.9, 0.9, 600), np.full(600, 1.0)]
    changes = {'sampling.points': 200, 'sampling.deskew': True}
    far = CAR + np.eye(9)[1] * 100
    more = points + np.array([0, 100, 0])
    first, second = observed(
        np.r_[more[:5], points, more[5:]], CAR, far, changes=changes, times=np.arange(1200.0)
    )
    order = np.argsort(x, kind='stable')[::3]
    assert first.delays.tolist() == (5 + order).tolist()
    assert second.delays.tolist() == np.where(order < 5, order, 600 + order).tolist()


def test_points_with_huge_coordinates_are_ignored():
    with np.errstate(all='raise'):
        (seen,) = observed([[3e38, -3e38, 0.0], [3e9, 20.0, 1.0], [10.0, 20.0, 1.0]], CAR)
    np.testing.assert_array_equal(seen.points, [[0.0, 0.0, 0.0]])


# --- ownership ----------------------------------------------------------------------------------


def test_a_point_belongs_to_the_box_it_is_deeper_inside_of():
    # A trailer with its front over the tractor overlaps it by more than boxes err.
    trailer = CAR + np.eye(9)[0] * 3
    points = [[x, 20.0, 1.0] for x in (11.0, 11.3, 11.45, 11.55, 11.7, 12.0)]
    seen = observed(points, CAR, trailer)
    owners = [[0], [0], [0, 1], [0, 1], [1], [1]]
    assert [len(o.points) for o in seen] == [sum(k in of for of in owners) for k in (0, 1)]


def test_two_boxes_of_one_object_share_its_points():
    # A second box 0.1 m ahead: points on the sides and ends of the car belong to both.
    points = near([2.0, 0, 0], [-2.0, 0, 0], [0, 0.9, 0], [1.0, -0.9, 0.3])
    seen = observed(points, CAR, CAR + np.eye(9)[0] * 0.1)
    assert [len(observation.points) for observation in seen] == [4, 4]


def test_many_boxes_equal_brute_force():
    # The raster and the sorting are for speed: the result must equal that of a plain loop.
    rng = np.random.default_rng(5)
    n = 25
    boxes = np.c_[
        rng.uniform(-20, 20, (n, 2)), rng.uniform(-1, 1, n), rng.uniform(0.5, 9, (n, 3)),
        rng.uniform(-0.1, 0.1, (n, 2)), rng.uniform(-4, 4, n),
    ]  # fmt: skip
    points = rng.uniform(-25, 25, (3000, 3)) * [1, 1, 0.2]
    points = points.astype(np.float32).astype(np.float64)
    axes = Rotation.from_euler('ZYX', boxes[:, [8, 7, 6]]).as_matrix()
    local = [(points - box[:3]) @ R for box, R in zip(boxes, axes, strict=True)]
    outside = np.array(
        [(np.abs(p) - b[3:6] / 2).max(1) for p, b in zip(local, boxes, strict=True)]
    )
    seen = observed(points, *boxes, changes={'sampling.points': 100000})
    possible = []
    for i, (box, observation) in enumerate(zip(boxes, seen, strict=True)):
        # The road is parallel to the bottom; `ground` is measured along z of the frame.
        known = not np.isnan(observation.ground)
        ground = observation.ground * axes[i, 2, 2] if known else -box[5] / 2
        possible.append((outside[i] < 0.6) & (local[i][:, 2] > ground + 0.2))
    assert sum(len(observation.points) for observation in seen) > 500
    for i, (box, observation) in enumerate(zip(boxes, seen, strict=True)):
        own = possible[i].copy()
        for j in np.flatnonzero(np.arange(n) != i):
            own &= (outside[j] >= 1.0) | (outside[i] <= outside[j] + 0.2)
        assert rows(observation.points) == rows((points[own] - box[:3]).astype(np.float32))
        assert observation.num_points == (outside[i] <= 0).sum()


# --- road ---------------------------------------------------------------------------------------


def test_points_of_the_road_beside_the_box_are_left_out():
    # The road is 0.1 m above the bottom of the box, so 0.9 m below its centre. A point 0.1 m
    # above the road is within the clearance of 0.2 m; a point 0.3 m above it is of the car.
    on_car = near([1.9, 0.9, -0.8], [1.9, 0.9, -0.6])
    (seen,) = observed(np.r_[road(0.1), on_car], CAR)
    assert seen.ground == pytest.approx(-0.9, abs=1e-6)
    np.testing.assert_allclose(seen.points, [[1.9, 0.9, -0.6]], atol=1e-5)


def test_without_road_the_bottom_of_the_box_replaces_it():
    # The bottom is 1 m below the centre: points more than 0.8 m below the centre are left out.
    (seen,) = observed(near([1.0, 0, -0.9], [1.0, 0, -0.7]), CAR)
    assert np.isnan(seen.ground)
    np.testing.assert_allclose(seen.points, [[1.0, 0, -0.7]], atol=1e-5)


@pytest.mark.parametrize(
    'points',
    [
        road(np.linspace(0, 0.55, 40)),  # a wall: heights from 0 to 0.55 m
        road(0.0, count=4),  # too few points
        road(0.0, inside=-0.5),  # below the box, not beside it
        road(0.0, inside=1.2),  # too far from the box
        road(0.8),  # as high as the middle of the car
    ],
    ids=['wall', 'few', 'under', 'far', 'high'],
)
def test_other_surfaces_are_no_road(points):
    (seen,) = observed(points, CAR)
    assert np.isnan(seen.ground)


def test_the_height_of_a_sloping_road_is_its_third_tenth():
    # Heights spread evenly over 0 to 0.1 m: 0.05 m from the first to the sixth tenth, flat
    # enough; the third tenth is at 0.03 m.
    (seen,) = observed(road(np.linspace(0, 0.1, 101), count=101), CAR)
    assert seen.ground == pytest.approx(-1 + 0.03, abs=1e-6)


def test_the_road_is_found_per_box():
    # The roads of 40 points lie 0.1 m above the bottom, 0.2 m below it, and 0.3 m above it;
    # the first, third and last box have no road points or too few.
    shifts = 50.0 * np.arange(6)[:, None] * [1.0, 0, 0]
    heights = [None, 0.1, None, -0.2, 0.3, None]
    scene = [road(h) + s for h, s in zip(heights, shifts, strict=True) if h is not None]
    scene.append(road(0.0, count=4) + shifts[5])
    seen = observed(np.concatenate(scene), *(CAR + np.pad(shifts, [(0, 0), (0, 6)])))
    known = [np.nan if height is None else -1 + height for height in heights]
    np.testing.assert_allclose([observation.ground for observation in seen], known, atol=1e-6)


@pytest.mark.parametrize('roll', [0.0, 0.3])
def test_the_road_is_searched_up_to_a_metre_beside_the_box(roll):
    # 20 points lie 0.95 m beside the left face on the road, 80 points 0.05 m higher 1.05 m beside
    # it: only the first count. On a slope as well: the road is 1 m below the centre then, square
    # to the bottom, and 1 m / cos(roll) straight down.
    slope = Rotation.from_euler('x', roll)
    box = np.r_[slope.apply([10.0, 20.3, 1.0]), CAR[3:6], roll, 0, 0]
    near, far = road(0.0, count=20), road(0.05, count=80)
    near[:, 1], far[:, 1] = 21.3 + 0.95, 21.3 + 1.05
    (seen,) = observed(slope.apply(np.r_[near, far]), box)
    assert seen.ground == pytest.approx(-1 / np.cos(roll), abs=1e-5)


@pytest.mark.parametrize('distance, is_seen', [(3.2, True), (3.27, False)])
def test_the_road_is_searched_within_an_upright_square(distance, is_seen):
    # Half the diagonal is 5 ** 0.5 = 2.236 m, so the square reaches 3.236 m. The box is turned so
    # that a corner of the ring, (3, 2) in its own axes and 3.6 m from its centre, lies ahead.
    box = CAR - np.eye(9)[8] * np.arctan2(2, 3)
    spot = [distance, 0, -1.0] + np.linspace(-0.01, 0.01, 20)[:, None] * [0, 1, 0]
    (seen,) = observed(CAR[:3] + spot, box)
    assert seen.ground == pytest.approx(-1.0 if is_seen else np.nan, abs=1e-6, nan_ok=True)


# --- thinning -----------------------------------------------------------------------------------


@pytest.mark.parametrize('objective', ['robust', 'paper'])
@pytest.mark.parametrize('count', [40, 41, 79, 80, 81, 500])
def test_no_more_points_than_configured_are_kept(objective, count):
    rng = np.random.default_rng(6)
    points = CAR[:3] + rng.uniform(-0.7, 0.7, (count, 3))
    changes = {'sampling.points': 40, 'sampling.deskew': True, 'objective': objective}
    (seen,) = observed(points, CAR, changes=changes, times=np.arange(count) * 1e-3)
    assert min(count, 40) // 2 <= len(seen.points) <= 40
    assert seen.num_points == count
    # Each delay is that of its point.
    given = {tuple(p): t for p, t in zip((points - CAR[:3]).round(3), range(count), strict=True)}
    for point, time in zip(seen.points.round(3).astype(float), seen.delays, strict=True):
        nearest = min(given, key=lambda p: np.abs(np.array(p) - point).sum())
        assert given[nearest] == pytest.approx(1e3 * time, abs=1e-3)


def test_the_paper_objective_keeps_the_farthest_points():
    rng = np.random.default_rng(7)
    points = (CAR[:3] + rng.uniform(-0.7, 0.7, (60, 3))).astype(np.float32).astype(float)
    (seen,) = observed(points, CAR, changes={'sampling.points': 20, 'objective': 'paper'})
    known = brute_force(points - CAR[:3], 20)
    assert rows(seen.points) == rows((points - CAR[:3])[known])


def brute_force(points, count):
    """Return the rows a plain loop of farthest point sampling picks."""
    picks = [int(np.linalg.norm(points - points.mean(0), axis=1).argmax())]
    while len(picks) < count:
        gaps = [min(np.linalg.norm(p - points[i]) for i in picks) for p in points]
        picks.append(int(np.argmax(gaps)))
    return picks


def test_farthest_points_equal_brute_force():
    points = np.random.default_rng(8).normal(size=(50, 3))
    assert farthest_point_sample(points, 20).tolist() == brute_force(points, 20)


def test_farthest_points_by_hand():
    # Mean 2.875: farthest from it is 10, from that 0, then 1 is 1 m from 0 where 0.5 is 0.5 m
    # from it.
    points = np.array([0.0, 0.5, 1.0, 10.0])[:, None] * [1.0, 0, 0]
    assert farthest_point_sample(points, 4).tolist() == [3, 0, 2, 1]


def test_equal_points_are_each_picked_once():
    assert sorted(farthest_point_sample(np.ones((12, 3)), 12)) == list(range(12))


def test_a_box_is_seen_at_the_median_time_of_its_points():
    behind, ahead = CAR.copy(), CAR.copy()
    behind[0], ahead[0] = CAR[0] - 20, CAR[0] + 20
    points = near(*([x, 0, 0.1 * k] for x, count in ((0, 4), (20, 3)) for k in range(count)))
    times = np.array([0.04, 0.01, 0.02, 0.07, 0.09, 0.05, 0.06])
    seen = observed(points, CAR, behind, ahead, times=times)
    assert [o.sights for o in seen] == pytest.approx([0.03, 0.0, 0.06])


def test_an_observation_of_another_box_keeps_its_points_in_place():
    (seen,) = observed([near([1, 0, 0])], CAR, origin=np.array([0.0, 0, 2]))
    shift = np.array([0.5, 0, 0])
    other = (CAR - [*shift, 0, 0, 0, 0, 0, 0])[None]
    moved = seen.table.relative_to(other, shift[None])
    assert moved.points.tolist() == [[1.5, 0, 0]]
    assert moved.origins[0].tolist() == (seen.origins + shift).tolist()
    same = seen.table.relative_to(other, np.zeros((1, 3)))
    assert same.points is seen.table.points
    assert same.boxes is other
