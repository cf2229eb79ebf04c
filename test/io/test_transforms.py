"""Transforms: lookup, interpolation, odometry, forgetting, time jumps, sweeps and boxes."""

from boxreg_ros.errors import TransformUnavailable
from boxreg_ros.io.transform_edge import Edge
from boxreg_ros.io.transform_tree import FRAMES_BEFORE_CLEANUP, TransformTree
from boxreg_ros.io.transforms import boxes_to_frame, inverse, sweep_to_frame
from boxreg_ros.structures import BoxArray, Sweep
import numpy as np
import pytest
from ros_messages import Messages
from scipy.spatial.transform import Rotation, Slerp

S = 10**9
M = Messages()
LEFT = Rotation.from_euler('z', 90, degrees=True).as_quat()


def rigid(position, quaternion_xyzw=(0, 0, 0, 1)):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(quaternion_xyzw).as_matrix()
    T[:3, 3] = position
    return T


def tree_of(*transforms, static=(), odometry=()):
    tree = TransformTree()
    tree.add_transforms(M.tf(*(M.transform(*t) for t in static)).transforms, is_static=True)
    tree.add_transforms(M.tf(*(M.transform(*t) for t in transforms)).transforms)
    for item in odometry:
        tree.add_odometry(M.odometry(*item))
    return tree


def test_chains_of_transforms_and_their_inverses():
    tree = tree_of(
        (S, 'map', 'odom', (100, 0, 0)),
        (S, 'odom', 'base', (0, 10, 0), LEFT),
        static=[(0, 'base', 'lidar', (1, 0, 2)), (0, 'base', 'camera', (0, 0, 1), LEFT)],
    )
    # The LiDAR is 1 m ahead of a base whose x axis points along +y.
    np.testing.assert_allclose(tree.lookup('map', 'lidar', S)[:3, 3], [100, 11, 2], atol=1e-12)
    T_camera_lidar = inverse(rigid((0, 0, 1), LEFT)) @ rigid((1, 0, 2))
    np.testing.assert_allclose(tree.lookup('camera', 'lidar', S), T_camera_lidar, atol=1e-12)
    product = tree.lookup('lidar', 'map', S) @ tree.lookup('map', 'lidar', S)
    np.testing.assert_allclose(product, np.eye(4), atol=1e-12)


def test_lookup_of_a_frame_in_itself_is_the_identity():
    np.testing.assert_array_equal(TransformTree().lookup('lidar', 'lidar', S), np.eye(4))


def test_interpolation_is_linear_and_slerp():
    first, second = Rotation.random(2, np.random.default_rng(7))
    tree = tree_of(
        (0, 'odom', 'base', (0, 0, 0), first.as_quat()),
        (S, 'odom', 'base', (10, 4, -2), second.as_quat()),
    )
    for fraction in (0.0, 0.25, 0.7, 1.0):
        T = tree.lookup('odom', 'base', round(fraction * S))
        expected = Slerp([0, 1], Rotation.concatenate([first, second]))(fraction).as_matrix()
        np.testing.assert_allclose(T[:3, :3], expected, atol=1e-12)
        np.testing.assert_allclose(T[:3, 3], np.multiply([10, 4, -2], fraction), atol=1e-12)


def test_interpolation_takes_the_shortest_path_for_opposite_quaternions():
    turned = Rotation.from_euler('z', 10, degrees=True)
    tree = tree_of(
        (0, 'odom', 'base', (0, 0, 0), (0, 0, 0, 1)),
        (S, 'odom', 'base', (0, 0, 0), -turned.as_quat()),
    )
    yaw = Rotation.from_matrix(tree.lookup('odom', 'base', S // 2)[:3, :3]).as_euler('ZYX')[0]
    assert yaw == pytest.approx(np.radians(5))


def test_samples_may_be_added_in_any_order():
    stamps = [3, 1, 2, 5, 4]
    tree = tree_of(*((s * S // 10, 'odom', 'base', (s * s, 0, 0)) for s in stamps))
    assert tree.lookup('odom', 'base', 3 * S // 20)[0, 3] == pytest.approx(2.5)
    assert tree.lookup('odom', 'base', 9 * S // 20)[0, 3] == pytest.approx(20.5)


def cubic_motion(seconds):
    """Return the pose of a vehicle that turns evenly, at a position of third degree in time."""
    position = (2 * seconds + 1.5 * seconds**2 - 0.3 * seconds**3, 0.5 * seconds**2, 1.0)
    return position, Rotation.from_euler('z', 20 * seconds, degrees=True).as_quat()


@pytest.mark.parametrize('period, error', [(1.0, 0.0), (0.5, 0.0), (0.2, 0.01)])
def test_sparse_samples_are_interpolated_by_a_polynomial(period, error):
    """Linear interpolation would be off by 0.4 m over a second, and is by 1 cm over 0.2 s."""
    stamps = [round(k * period * S) for k in range(round(6 / period))]
    tree = tree_of(*((s, 'odom', 'base', *cubic_motion(s * 1e-9)) for s in stamps))
    errors = []
    for stamp in (stamps[2] + S // 10, stamps[2] + round(0.6 * period * S), stamps[-2] + S // 20):
        T = tree.lookup('odom', 'base', stamp)
        true = rigid(*cubic_motion(stamp * 1e-9))
        np.testing.assert_allclose(T[:3, :3], true[:3, :3], atol=1e-9)
        errors.append(np.abs(T - true).max())
    assert errors[0] == pytest.approx(error, abs=0.2 * error + 1e-9)
    assert errors[1] == pytest.approx(error, abs=0.2 * error + 1e-9)
    assert max(errors) < 0.05  # in the last gap there are two samples before it, none behind


def test_a_gap_is_interpolated_by_samples_as_far_apart_as_it_is():
    """Nearer ones, 5 cm off in turns, would be off by 0.5 m in the middle of the gap."""
    stamps = [*range(0, S + 1, S // 20), *range(2 * S, 3 * S + 1, S // 20)]
    noise = {stamp: 0.05 * (-1) ** k for k, stamp in enumerate(stamps)}
    tree = tree_of(
        *((s, 'odom', 'base', (cubic_motion(s * 1e-9)[0][0] + noise[s], 0, 0)) for s in stamps)
    )
    found = tree.lookup('odom', 'base', 3 * S // 2)[0, 3]
    assert found == pytest.approx(cubic_motion(1.5)[0][0], abs=0.07)


def test_a_long_stop_of_the_publisher_is_no_part_of_the_motion_behind_it():
    at = {0: 100.0, 20: 0.0, 21: 1.0, 22: 2.0}
    tree = tree_of(*((k * S, 'odom', 'base', (x, 0, 0)) for k, x in at.items()))
    assert tree.lookup('odom', 'base', 20 * S + S // 2)[0, 3] == pytest.approx(0.5)


def test_motion_is_extrapolated_up_to_a_limit():
    tree = tree_of((0, 'odom', 'base', (0, 0, 0)), (S, 'odom', 'base', (10, 0, 0)))
    assert tree.lookup('odom', 'base', S + S // 10)[0, 3] == pytest.approx(11.0)
    assert tree.lookup('odom', 'base', -S // 10)[0, 3] == pytest.approx(-1.0)
    for stamp in (S + S // 4, -S // 4):
        with pytest.raises(TransformUnavailable, match='odom -> base is known from 0 to'):
            tree.lookup('odom', 'base', stamp)
    single = TransformTree()
    single.add_transforms([M.transform(0, 'odom', 'base', (3, 0, 0))])
    assert single.lookup('odom', 'base', 0)[0, 3] == 3.0
    with pytest.raises(TransformUnavailable, match='odom -> base is known from 0 to 0'):
        single.lookup('odom', 'base', 1)  # one sample gives no velocity


def test_covers_excludes_extrapolation():
    tree = tree_of(
        (S, 'odom', 'base'), (2 * S, 'odom', 'base'), static=[(0, 'base', 'lidar', (1, 0, 0))]
    )
    assert tree.covers('odom', 'lidar', S)
    assert tree.covers('odom', 'lidar', 2 * S)
    assert not tree.covers('odom', 'lidar', 2 * S + 1)
    assert not tree.covers('odom', 'lidar', S - 1)
    assert not tree.covers('map', 'lidar', S)
    assert tree.covers('base', 'lidar', 99 * S), 'static transforms are valid at all times'


def test_the_motion_up_to_a_stamp_does_not_depend_on_later_transforms():
    first = (S, 'odom', 'base', (0, 0, 0))
    later = (S + S // 10, 'odom', 'base', (1, 0, 0))
    for known in ([first], [first, later]):
        motion = tree_of(*known).motion('odom', 'base', S)
        assert motion.stamps_ns.tolist() == [S]
    motion = tree_of(first, later).motion('odom', 'base', S + S // 10)
    assert motion.stamps_ns.tolist() == [S, S + S // 10]


def test_a_static_transform_on_both_topics_stays_static():
    tree = tree_of((5 * S, 'base', 'lidar', (1, 0, 0)), static=[(0, 'base', 'lidar', (1, 0, 0))])
    assert tree.lookup('base', 'lidar', 0)[0, 3] == 1.0
    tree.add_transforms([M.transform(9 * S, 'base', 'lidar', (2, 0, 0))])
    assert tree.lookup('base', 'lidar', 0)[0, 3] == 2.0


def test_tf_has_priority_over_odometry():
    odometry = [(S, 'odom', 'base', (7, 0, 0))]
    tree = tree_of((S, 'odom', 'base', (5, 0, 0)), odometry=odometry)
    assert tree.lookup('odom', 'base', S)[0, 3] == 5.0
    # In TF the parent of the base is another frame: only odometry connects it to 'odom'.
    tree = tree_of(
        (S, 'map', 'base', (5, 0, 0)), static=[(0, 'base', 'lidar', (0, 0, 2))], odometry=odometry
    )
    np.testing.assert_array_equal(tree.lookup('odom', 'lidar', S)[:3, 3], [7, 0, 2])
    np.testing.assert_array_equal(tree.lookup('map', 'lidar', S)[:3, 3], [5, 0, 2])


def test_a_frame_has_other_parents_where_one_source_states_several():
    static = [(0, 'base', 'lidar', (0, 0, 2))]
    transforms = [(S, 'map', 'base', (5, 0, 0))]
    tree = tree_of(*transforms, static=static, odometry=[(S, 'odom', 'base', (7, 0, 0))])
    tree.prefers_odometry = True
    assert [tree.other_parents(edge) for edge in tree.route('odom', 'lidar')] == [[], []]
    for k in range(4):
        parent = 'world' if k % 2 else 'odom'
        tree.add_odometry(M.odometry((k + 2) * S, parent, 'base', (7, 0, 0)))
    for parent, other in (('odom', 'world'), ('world', 'odom')):
        assert tree.lookup(parent, 'base', 4 * S)[0, 3] == 7
        assert tree.other_parents(tree.route(parent, 'base')[0]) == [other]


def test_odometry_that_is_preferred_takes_the_place_of_the_transform_of_its_frame():
    tree = TransformTree()
    tree.prefers_odometry = True
    tree.add_transforms([M.transform(S, 'map', 'odom', (1, 0, 0))])
    tree.add_transforms([M.transform(S, 'odom', 'base', (5, 0, 0))])
    tree.add_transforms([M.transform(0, 'base', 'lidar', (0, 0, 2))], is_static=True)
    tree.add_odometry(M.odometry(S, 'odom', 'base', (7, 0, 0)))
    np.testing.assert_array_equal(tree.lookup('map', 'lidar', S)[:3, 3], [8, 0, 2])
    assert [edge.parent for edge in tree.path('lidar')] == ['base', 'odom', 'map']


def test_errors_name_the_frames_and_the_remedy():
    tree = tree_of((S, 'odom', 'base'), static=[(0, 'vehicle', 'lidar')])
    with pytest.raises(TransformUnavailable) as caught:
        tree.lookup('odom', 'lidar', S)
    text = str(caught.value)
    assert "from 'lidar' to 'odom'" in text
    assert 'vehicle -> lidar, odom -> base' in text
    assert '/tf' in text
    with pytest.raises(TransformUnavailable, match='known: none'):
        TransformTree().lookup('odom', 'lidar', S)


def test_invalid_transforms_are_skipped():
    tree = tree_of(
        (S, 'odom', 'base', (1, 0, 0)),
        (2 * S, 'odom', 'base', (np.nan, 0, 0)),
        (2 * S, '', 'base'),
        (2 * S, 'odom', ''),
        (2 * S, 'odom', 'base', (2, 0, 0), (0, 0, 0, 0)),
    )
    assert tree.frames() == ['base', 'odom']
    assert not tree.covers('odom', 'base', 2 * S)
    broken = tree_of((S, 'odom', 'base', (np.nan, 0, 0)))
    with pytest.raises(TransformUnavailable, match='NaN'):
        broken.lookup('odom', 'base', S)


@pytest.mark.parametrize(
    ('period', 'stamp', 'remedy'),
    [
        (1.0, 3.6, 'comes every 1 s.*--odometry'),
        (1.0, 9.0, 'clock'),
        (0.1, 0.6, 'where the recording begins or ends'),
        (0.1, 3.0, 'clock.*--start'),
    ],
)
def test_motion_is_not_carried_on_beyond_sparse_samples(period, stamp, remedy):
    """At 1 m/s^2 it would be off by 0.5 m after 1 s."""
    tree = tree_of(*((round(k * period * S), 'odom', 'base', (k, 0, 0)) for k in range(4)))
    with pytest.raises(TransformUnavailable, match=remedy):
        tree.lookup('odom', 'base', round(stamp * S))


def test_frames_that_differ_by_a_prefix_are_one_where_nothing_else_connects_them():
    static = [(0, 'base', 'lidar', (1, 0, 2))]
    tree = tree_of((S, 'r1/odom', 'r1/base', (5, 0, 0)), static=static)
    np.testing.assert_array_equal(tree.lookup('r1/odom', 'lidar', S)[:3, 3], [6, 0, 2])
    assert tree.same_frames == {'r1/base': 'base'}
    assert (tree.fixed_frame('r1/base'), tree.alike('odom')) == ('r1/odom', ['r1/odom'])
    np.testing.assert_array_equal(tree.lookup('odom', 'r1/lidar', S)[:3, 3], [6, 0, 2])
    tree.add_transforms(M.tf(M.transform(S, 'odom', 'base', (7, 0, 0))).transforms)
    np.testing.assert_array_equal(tree.lookup('odom', 'lidar', S)[:3, 3], [8, 0, 2])
    assert tree.same_frames == {}


def test_a_frame_that_two_prefixes_fit_is_none_of_them():
    tree = tree_of(*((S, f'{robot}/odom', f'{robot}/lidar', (5, 0, 0)) for robot in ('a', 'b')))
    assert tree.fixed_frame('lidar') is None
    assert tree.alike('lidar') == ['a/lidar', 'b/lidar']
    with pytest.raises(TransformUnavailable, match="'lidar' to 'odom'"):
        tree.lookup('odom', 'lidar', S)
    # The fixed frame chooses one.
    np.testing.assert_array_equal(tree.lookup('b/odom', 'lidar', S)[:3, 3], [5, 0, 0])
    assert tree.same_frames == {'b/lidar': 'lidar'}


def test_the_leading_slash_of_ros1_frames_is_ignored():
    tree = tree_of((S, '/odom', '/base', (1, 0, 0)))
    assert tree.lookup('odom', '/base', S)[0, 3] == 1.0


def test_old_samples_are_removed():
    tree = tree_of(*((k * S, 'odom', 'base', (k, 0, 0)) for k in range(100)))
    assert tree.lookup('odom', 'base', 69 * S + S // 2)[0, 3] == pytest.approx(69.5)
    with pytest.raises(TransformUnavailable, match='is known from 69000000000 to 99000000000'):
        tree.lookup('odom', 'base', 40 * S)
    tree.add_transforms([M.transform(10_000 * S, 'odom', 'base', (10_000, 0, 0))])
    assert tree.lookup('odom', 'base', 99 * S + S)[0, 3] == pytest.approx(100)


def test_unused_frames_of_objects_are_removed():
    """Some trackers publish a frame per object: thousands in an hour."""
    tree = tree_of(static=[(0, 'base', 'lidar', (0, 0, 2))])
    for k in range(3 * FRAMES_BEFORE_CLEANUP):
        tree.add_transforms([M.transform(k * S, 'odom', 'base', (k, 0, 0))])
        tree.add_transforms([M.transform(k * S, 'odom', f'object {k}')])
        assert tree.lookup('odom', 'lidar', k * S)[0, 3] == k
    assert len(tree.frames()) < 2 * FRAMES_BEFORE_CLEANUP
    assert tree.connects('odom', f'object {k}')


def test_clear_removes_all_frames():
    tree = tree_of((S, 'odom', 'base'))
    assert tree.covers('odom', 'base', S)
    tree.clear()
    assert tree.frames() == []
    assert not tree.covers('odom', 'base', S)


def test_the_fixed_frame_is_the_root_of_the_moving_frames():
    static = [(0, 'base', 'lidar')]
    assert TransformTree().fixed_frame('lidar') is None
    assert tree_of(static=static).fixed_frame('lidar') is None, (
        'TF contains static transforms only'
    )
    assert tree_of((S, 'odom', 'base'), static=static).fixed_frame('lidar') == 'odom'
    moving = [(S, 'map', 'odom'), (S, 'odom', 'base')]
    assert tree_of(*moving, static=static).fixed_frame('lidar') == 'map'
    odometry = [(S, 'odom', 'base')]
    assert tree_of(static=static, odometry=odometry).fixed_frame('lidar') == 'odom'
    assert tree_of(*moving, static=static, odometry=odometry).fixed_frame('lidar') == 'map'
    unconnected = [(S, 'odom', 'other')]
    assert tree_of(static=static, odometry=unconnected).fixed_frame('lidar') is None
    footprint = [(S, 'footprint', 'base')]  # moves, but below the child frame of the odometry
    tree = tree_of(*footprint, static=static, odometry=[(S, 'odom', 'footprint')])
    assert tree.fixed_frame('lidar') == 'odom'
    circle = [(S, 'a', 'b'), (S, 'b', 'a')]
    assert tree_of(*circle).fixed_frame('a') in ('a', 'b')


def test_points_and_sensor_origin_of_a_sweep_are_transformed():
    points = np.array([[1, 0, 0], [0, 2, 0]], np.float32)
    sweep = Sweep(S, 'lidar', points, times=np.array([0.0, 0.1]))
    moved = sweep_to_frame(sweep, rigid((10, 20, 1), LEFT), 'odom').in_frame()
    assert (moved.stamp_ns, moved.frame_id, moved.points.dtype) == (S, 'odom', np.float32)
    np.testing.assert_allclose(moved.points, [[10, 21, 1], [8, 20, 1]], atol=1e-5)
    np.testing.assert_allclose(moved.origin, [10, 20, 1])
    np.testing.assert_array_equal(moved.times, sweep.times)
    np.testing.assert_array_equal(sweep.points, points)


def test_points_of_a_sweep_stay_where_they_are_until_they_are_asked_for():
    # A quarter turn to the left twice maps (1, 2, 3) to (-1, -2, 3); the shifts (1, 0, 0), turned
    # to (0, 1, 0), and (0, 0, 5) are added.
    sweep = Sweep(S, 'lidar', np.array([[1.0, 2.0, 3.0]], np.float32))
    once = sweep_to_frame(sweep, rigid((1, 0, 0), LEFT), 'base')
    twice = sweep_to_frame(once, rigid((0, 0, 5), LEFT), 'odom')
    assert twice.points is sweep.points
    np.testing.assert_allclose(twice.in_frame().points, [[-1, -1, 8]], atol=1e-6)
    assert twice.in_frame().T_frame_points is None
    assert sweep.in_frame() is sweep


def test_sweep_far_from_the_origin_keeps_its_resolution():
    sweep = Sweep(S, 'lidar', np.array([[0.001, 0.002, 0.003]], np.float32))
    moved = sweep_to_frame(sweep, rigid((500_000, 5_400_000, 0)), 'map').in_frame()
    np.testing.assert_allclose(moved.points, [[500_000.001, 5_400_000.002, 0.003]], atol=1e-8)


def test_boxes_are_rotated_about_all_axes():
    rng = np.random.default_rng(3)
    angles = rng.uniform([-3, -1.5, -3], [3, 1.5, 3], (20, 3))
    boxes = np.hstack([rng.uniform(-50, 50, (20, 3)), rng.uniform(1, 5, (20, 3)), angles])
    boxes[4, 1], boxes[5, 8] = np.nan, np.nan
    array = BoxArray(S, 'lidar', ('a',) * 20, ('car',) * 20, np.ones(20), boxes)
    T = rigid((5, -3, 1), Rotation.from_euler('ZYX', [2.0, 0.2, -0.1]).as_quat())
    moved = boxes_to_frame(array, T, 'odom')
    assert (moved.frame_id, moved.stamp_ns) == ('odom', S)
    good = np.isfinite(boxes).all(axis=1)
    corner = boxes[:, 3:6] / 2
    for i in np.flatnonzero(good):
        R_before = Rotation.from_euler('ZYX', boxes[i, :5:-1]).as_matrix()
        R_after = Rotation.from_euler('ZYX', moved.boxes[i, :5:-1]).as_matrix()
        before = T[:3, :3] @ (boxes[i, :3] + R_before @ corner[i]) + T[:3, 3]
        np.testing.assert_allclose(moved.boxes[i, :3] + R_after @ corner[i], before, atol=1e-9)
    np.testing.assert_array_equal(moved.boxes[:, 3:6], boxes[:, 3:6])
    assert np.isnan(moved.boxes[4, :3]).any()
    assert np.isnan(moved.boxes[5, 6:]).any()
    assert np.isfinite(moved.boxes[good]).all()


def test_samples_after_a_time_jump_replace_the_old_ones():
    static = [(0, 'base', 'lidar', (0, 0, 2))]
    moves = [(100 * S + k * S // 10, 'odom', 'base', (k, 0, 0)) for k in range(50)]
    tree = tree_of(*moves, static=static)
    one = (90 * S, 'odom', 'base', (-1, 0, 0))  # a single old sample: 14.9 s
    tree.add_transforms(M.tf(M.transform(*one)).transforms)
    np.testing.assert_allclose(tree.lookup('odom', 'lidar', 102 * S)[0, 3], 20)
    assert tree.newest_ns() == 104_900_000_000
    again = [(100 * S + k * S // 10, 'odom', 'base', (0, k, 0)) for k in range(4)]
    for item in again:
        tree.add_transforms(M.tf(M.transform(*item)).transforms)
    T = tree.lookup('odom', 'lidar', 100 * S + 250_000_000)
    np.testing.assert_allclose(
        T[:3, 3], [0, 2.5, 2]
    )  # of the second pass; the static transform is kept
    # Clouds and boxes of the first pass may come behind; by a second at most, none is awaited.
    np.testing.assert_allclose(tree.lookup('odom', 'lidar', 102 * S)[0, 3], 20)
    stamps = [95, 101, 102, 104.9, 105.5, 106]
    final = [tree.is_final('odom', 'lidar', round(stamp * S)) for stamp in stamps]
    assert final == [True, False, True, True, True, False]
    tree.forget_before()
    assert not tree.covers('odom', 'lidar', 102 * S)
    assert not tree.covers('odom', 'lidar', 95 * S)
    tree.rewind(98 * S)
    with pytest.raises(TransformUnavailable, match='since time went back'):
        tree.lookup('odom', 'lidar', 100 * S)
    assert tree.connects('odom', 'lidar')
    # The last sample, up to a second after the stamp that time goes back to, is a new one.
    for stamp, is_new in ((91 * S, True), (91 * S + 1, False)):
        tree = tree_of(*moves, static=static)
        tree.add_transforms(M.tf(M.transform(stamp, 'odom', 'base', (0, 0, 0))).transforms)
        tree.rewind(90 * S)
        assert tree.covers('odom', 'lidar', stamp) == is_new
    tree = tree_of(*moves, static=static)
    tree.rewind(0)  # the recording is read again
    with pytest.raises(TransformUnavailable, match='its poses begin later'):
        tree.lookup('odom', 'lidar', 90 * S)


@pytest.mark.parametrize('is_odometry', [False, True])
def test_a_single_stamp_ahead_is_not_used(is_odometry):
    tree = TransformTree()

    def add(seconds, x, received=None):
        sample = round(seconds * S), 'odom', 'base', (x, 0, 0)
        received_ns = round((seconds if received is None else received) * S)
        if is_odometry:
            tree.add_odometry(M.odometry(*sample), received_ns)
        else:
            tree.add_transforms(M.tf(M.transform(*sample)).transforms, False, received_ns)

    for k in range(20):
        add(100 + 0.05 * k, k)
    add(3701, 0, received=101)
    assert tree.newest_ns() == round(100.95 * S)
    add(101, 20)
    add(101.05, 21)
    assert dict(tree.stamps_ahead) == {'odom -> base': 1}
    assert tree.lookup('odom', 'base', 101 * S + S // 40)[0, 3] == pytest.approx(20.5)
    for seconds in (8000, 8000.05):  # two are a clock that was set
        add(seconds, 30, received=101.1)
    assert tree.covers('odom', 'base', 8000 * S)
    add(9000, 31)  # a pause
    assert tree.covers('odom', 'base', 9000 * S)
    assert tree.stamps_ahead.total() == 1


def test_a_cloud_of_its_time_confirms_a_sample_ahead():
    tree = TransformTree()
    for seconds, received in ((100.0, 100.0), (100.1, 100.1), (102.3, 100.2)):
        sample = M.transform(round(seconds * S), 'odom', 'base', (seconds, 0, 0))
        tree.add_transforms(M.tf(sample).transforms, False, round(received * S))
    assert not tree.covers('odom', 'base', 101 * S)  # of no cloud of its time
    assert tree.covers('odom', 'base', round(102.3 * S))
    assert tree.stamps_ahead.total() == 0


def test_two_consecutive_old_stamps_are_a_time_jump():
    edge = Edge('odom', 'base', 100 * S)
    edge.add(9 * S, (0, 0, 0, 0, 0, 0, 1))
    edge.arrivals.add(9 * S, 9 * S)
    jumps = []
    for t in (100, 110, 105, 101, 99, 111, 99, 98, 99, 85, 112):
        will_jump, count = edge.jumps_to(t * S // 10), len(edge.stamps)
        edge.add(t * S // 10, (0, 0, 0, 0, 0, 0, 1))
        jumps.append(len(edge.stamps) < count)  # all but the last two are forgotten
        assert jumps[-1] == will_jump
    # Stamps in units of 0.1 s are old if they are more than 1 s (10 units) before the newest. 99
    # after 110 is a single old stamp. 99 and 98 after 111 are two: a time jump. Both are of the
    # time behind it, and 85 is a single old stamp again.
    assert jumps == [False] * 7 + [True] + [False] * 3
    assert [stamp * 10 // S for stamp in edge.stamps] == [85, 98, 99, 112]
    assert not edge.arrivals.received_ns  # the clocks of before and after are not compared
