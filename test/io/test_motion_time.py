"""Clouds that are placed by poses of another moment, where boxes of the fixed frame show it."""

from boxreg_ros.config import Config
from boxreg_ros.datasets.files import pose_rows
from boxreg_ros.io.items import Item
from boxreg_ros.io.session import Session
from boxreg_ros.io.transforms import boxes_to_frame, inverse, sweep_to_frame
from boxreg_ros.structures import BoxArray, Sweep
from msg_adapters.convention import STANDARD
import numpy as np
import pytest

S = 10**9
SPEED, YAW_RATE = 8.0, 0.1


def true_pose(seconds):
    """Return the pose (4, 4) of a sensor that drives along an arc."""
    yaw = YAW_RATE * seconds
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:2, 3] = SPEED / YAW_RATE * np.array([np.sin(yaw), 1 - np.cos(yaw)])
    return T


def parked(rng, first):
    """Return boxes (K, 9) of cars beside the arc, and points (M, 3) on their sides."""
    poses = [true_pose(seconds) for seconds in np.linspace(first, first + 8, 12)]
    boxes = np.tile([0, 0, 0.8, 4.5, 1.9, 1.6, 0, 0, 0.0], (len(poses), 1))
    points = []
    for k, (box, T) in enumerate(zip(boxes, poses, strict=True)):
        place = T @ [0, 6.0 * (-1) ** k, 0.8, 1]
        box[:3], box[8] = place[:3], np.arctan2(T[1, 0], T[0, 0])
        local = rng.uniform(-1, 1, (60, 3)) * box[3:6] / 2
        local[:30, 1] = -0.95 * (-1) ** k  # the side of the road
        local[30:, 0] = rng.choice([-2.25, 2.25], 30)
        points.append(local @ T[:3, :3].T + box[:3])
    return boxes, np.concatenate(points)


def found(late, frame, size=1.0, too_far=0.0):
    """Return the findings of boxes of another size, or known ahead only and too far [m]."""
    rng = np.random.default_rng(0)
    boxes, points = parked(rng, 4 if too_far else 0)
    session = Session(STANDARD, Config(), 'odom')
    session.sensor_frame = 'lidar'
    names = tuple(map(str, range(len(boxes))))
    for k in range(-10, 50):
        pose = pose_rows([true_pose(k / 10 + 2 - late)])[0]
        session.tree.add_pose('odom', 'lidar', S * 10 + k * S // 10, pose)
    for k in range(40):
        stamp_ns = S * 10 + k * S // 10
        T_lidar_odom = inverse(true_pose(k / 10 + 2))
        sweep = sweep_to_frame(Sweep(stamp_ns, 'odom', points), T_lidar_odom, 'lidar')
        noisy = boxes + rng.normal(0, 1, boxes.shape) * [0.1, 0.1, 0.03, 0, 0, 0, 0, 0, 0.02]
        noisy[:, 3:6] *= size
        array = BoxArray(stamp_ns, 'odom', names, ('car',) * len(names), np.ones(12), noisy)
        if too_far:
            seen = boxes_to_frame(array, T_lidar_odom, 'lidar').boxes[:, 0] > 0
            noisy[:, :2] += too_far * true_pose(k / 10 + 2)[:2, 0]
            array = array.take(np.flatnonzero(seen))
        if frame == 'lidar':
            array = boxes_to_frame(array, T_lidar_odom, 'lidar')
        session.admit(Item(0, sweep))
        session.admit(Item(0, array))
    return [one.text for one in session.findings if one.reason == 'clock_offset']


@pytest.mark.parametrize('late', [0.1, 0.3, -0.2])
def test_motion_that_is_late_is_named_by_boxes_of_the_fixed_frame(late):
    assert not found(late, 'lidar')
    (text,) = found(late, 'odom')
    where = f'lie {abs(late) * SPEED:.1f} m {"ahead of" if late > 0 else "behind"} their points'
    assert f"boxes of 12 objects that stand still in 'odom' {where}" in text
    assert f'--clock-offset={-late:g} (node: clock_offset:={-late:g})' in text


@pytest.mark.parametrize('fault', [{'size': 1.0}, {'size': 0.7}, {'size': 2.0}, {'too_far': 0.8}])
def test_motion_in_time_is_not_named_by_boxes_that_are_off(fault):
    assert not found(0.0, 'odom', **fault)
