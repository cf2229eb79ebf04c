"""Objects that all move alike, by transforms that stand still, are inverse, scaled or turned."""

from functools import partial

from boxreg_ros.config import Config
from boxreg_ros.datasets.files import pose_rows
from boxreg_ros.io.checks.common_motion import CommonMotionCheck
from boxreg_ros.io.id_assignment import IdCheck
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.io.transforms import inverse
from boxreg_ros.structures import BoxArray
import numpy as np
import pytest

S = 10**9


def pose_of(heading, way):
    """Return the pose (4, 4) of a sensor that has driven straight on."""
    T = np.eye(4)
    T[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
    T[:2, 3] = way * T[:2, 0]
    return T


def known(tree, stamp_ns):
    return tree.lookup('odom', 'lidar', stamp_ns) if stamp_ns >= S else None


def finding(
    velocities, ego=0.0, stands_from=np.inf, noise=0.2, seconds=5.0, heading=0.0, is_inverse=False,
    scale=1.0, turn=0.0, sides=(-8.0, 8.0),
):  # fmt: skip
    """
    Return what is found of objects with some velocities (K, 2) over ground [m/s].

    The sensor drives along x with the speed `ego`, in a frame with the yaw `heading`; its
    transform repeats the pose of the time `stands_from` [s] after it, or is the inverse one, or
    that of `scale` times the way, or with the yaw off by `turn` [rad], and the boxes are where the
    transform places them.

    """
    rng = np.random.default_rng(0)
    tree, check, ids = TransformTree(), CommonMotionCheck(), IdCheck(Config().max_gap)
    count = len(velocities)
    names = tuple(map(str, range(count)))
    begin = np.c_[np.linspace(-60, 60, count), np.tile(sides, count)[:count]]
    for k in range(round(10 * seconds)):
        t = k / 10
        true, stated = ego * t, scale * ego * min(t, stands_from)
        stamp_ns = S + k * S // 10
        boxes = np.tile([0, 0, 0.8, 4.5, 1.9, 1.6, 0, 0, 0.0], (count, 1))
        boxes[:, :2] = begin + t * np.array(velocities, float) + rng.normal(0, noise, (count, 2))
        T_stated = pose_of(heading, stated)
        T_stated[:3, :3] = T_stated[:3, :3] @ pose_of(turn, 0.0)[:3, :3]
        if is_inverse:
            T_stated = inverse(T_stated)
        placed = np.c_[boxes[:, :3], np.ones(count)] - [true, 0, 0, 0]  # in the sensor
        boxes[:, :3] = (placed @ T_stated.T)[:, :3]
        tree.add_pose('odom', 'lidar', stamp_ns, pose_rows([T_stated])[0])
        ids.add(BoxArray(stamp_ns, 'odom', names, ('car',) * count, np.ones(count), boxes))
        check.add(stamp_ns, ids.tracker, tree.route('odom', 'lidar'), partial(known, tree))
    return check.finding


PARKED = [(0, 0)] * 6
STREET = [*PARKED, (9, 0), (-11, 0), (3, 0)]


@pytest.mark.parametrize('stands_from', [0.0, 2.0])
def test_a_transform_that_stands_still_while_the_vehicle_drives_is_named(stands_from):
    found = finding(STREET, ego=8.0, stands_from=stands_from, seconds=5.0 + stands_from)
    assert '6 of 9 objects move alike, at ' in found
    assert 'while odom -> lidar stands still' in found
    assert '--odometry TOPIC' in found


@pytest.mark.parametrize('heading', [0.0, 1.5, -2.0])
def test_inverse_poses_are_named(heading):
    found = finding(STREET, ego=8.0, heading=heading, is_inverse=True)
    assert '6 of 9 objects move alike, at ' in found
    assert 'as parked objects do by inverse poses, and hardly any stands still' in found


@pytest.mark.parametrize('heading', [0.0, 2.5])
@pytest.mark.parametrize('scale', [0.278, 0.5, 1.609, 2.237, 3.6])
def test_a_motion_at_another_scale_is_named(scale, heading):
    found = finding(STREET, ego=8.0, heading=heading, scale=scale)
    assert '6 of 9 objects move alike, at ' in found
    assert 'on both sides, as parked objects do by a motion at ' in found
    named = float(found.split('by a motion at ')[1].split(' ')[0])
    assert named == pytest.approx(scale, rel=0.1)


@pytest.mark.parametrize('turn', [0.6, np.pi / 2, -2.2])
@pytest.mark.parametrize('heading', [0.0, 1.9])
def test_poses_of_other_axes_than_those_of_the_lidar_are_named(heading, turn):
    found = finding(STREET, ego=8.0, heading=heading, turn=turn)
    assert '6 of 9 objects move alike, at ' in found
    assert 'on both sides, as parked objects do by poses with a yaw that is off by ' in found
    named = float(found.split('that is off by ')[1].split(' ')[0])
    assert named == pytest.approx(np.degrees(abs(turn)), abs=8)


@pytest.mark.parametrize('velocity', [(-9, 0), (5, 0)])
def test_traffic_on_one_side_shows_no_fault(velocity):
    assert finding([velocity] * 5, 9.0, sides=(6.0, 9.0)) == ''


@pytest.mark.parametrize(
    ('velocities', 'ego'),
    [
        (STREET, 8.0),
        ([*PARKED[:3], *[(9, 0)] * 5], 9.0),  # a queue that the sensor drives in
        ([(2.1, 0)] * 5, 1.5),  # a jam
        ([*PARKED[:3], *[(-9, 0)] * 5], 9.0),
        ([*PARKED[:3], *[(18, 0)] * 5], 9.0),
        (STREET, 0.0),
        ([*PARKED, *[(9, 0)] * 5], 0.0),  # a queue past a sensor that stands
        ([(27, 0), (29, 0), (31, 0), (33, 0), (-28, 0), (-30, 0)], 0.0),
        ([(9, 0)] * 3, 0.0),
    ],
    ids=[
        *('driving', 'within', 'jam', 'oncoming', 'faster', 'standing', 'queue', 'highway', 'few')
    ],
)
def test_transforms_of_the_true_motion_are_no_finding(velocities, ego):
    assert finding(velocities, ego) == ''
