"""Objects that all move alike while the transforms stand still."""

from boxreg_ros.config import Config
from boxreg_ros.io.common_motion import CommonMotionCheck
from boxreg_ros.io.id_assignment import IdCheck
from boxreg_ros.io.transforms import TransformTree
from boxreg_ros.structures import BoxArray
import numpy as np
import pytest

S = 10**9


def finding(velocities, ego=0.0, stands_from=np.inf, noise=0.2, seconds=5.0):
    """
    Return what is found of objects with some velocities (K, 2) over ground [m/s].

    The sensor drives along x with the speed `ego`; its transform repeats the pose of the time
    `stands_from` [s] after it, and so do the boxes in the fixed frame.

    """
    rng = np.random.default_rng(0)
    tree, check, ids = TransformTree(), CommonMotionCheck(), IdCheck(Config().max_gap)
    count = len(velocities)
    names = tuple(map(str, range(count)))
    begin = np.c_[np.linspace(-60, 60, count), np.tile([-8.0, 8.0], count)[:count]]
    for k in range(round(10 * seconds)):
        t = k / 10
        true, stated = ego * t, ego * min(t, stands_from)
        stamp_ns = S + k * S // 10
        tree.add_pose('odom', 'lidar', stamp_ns, np.array([stated, 0, 0, 0, 0, 0, 1]))
        boxes = np.tile([0, 0, 0.8, 4.5, 1.9, 1.6, 0, 0, 0.0], (count, 1))
        boxes[:, :2] = begin + t * np.array(velocities, float) + rng.normal(0, noise, (count, 2))
        boxes[:, 0] += stated - true
        ids.add(BoxArray(stamp_ns, 'odom', names, ('car',) * count, np.ones(count), boxes))
        check.add(stamp_ns, ids.tracker, tree.route('odom', 'lidar'))
    return check.finding


PARKED = [(0, 0)] * 6
STREET = [*PARKED, (9, 0), (-11, 0), (3, 0)]


@pytest.mark.parametrize('stands_from', [0.0, 2.0])
def test_a_transform_that_stands_still_while_the_vehicle_drives_is_named(stands_from):
    found = finding(STREET, ego=8.0, stands_from=stands_from, seconds=5.0 + stands_from)
    assert '6 of 9 objects move alike, at ' in found
    assert 'while odom -> lidar stands still' in found
    assert '--odometry TOPIC' in found


@pytest.mark.parametrize(
    ('velocities', 'ego'),
    [
        (STREET, 8.0),
        (STREET, 0.0),
        ([*PARKED, *[(9, 0)] * 5], 0.0),  # a queue past a sensor that stands
        ([(27, 0), (29, 0), (31, 0), (33, 0), (-28, 0), (-30, 0)], 0.0),
        ([(9, 0)] * 3, 0.0),
    ],
    ids=['driving', 'standing', 'queue', 'highway', 'few'],
)
def test_transforms_of_the_true_motion_are_no_finding(velocities, ego):
    assert finding(velocities, ego) == ''
