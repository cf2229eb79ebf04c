"""The time that input boxes are of, from fast objects whose convention is known."""

from dataclasses import replace

from boxreg_ros.config import Config
from boxreg_ros.core.box_time import BoxTimeEvidence, MIN_VOTES, motion_to_sight, swept
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.simulation.scenarios import highway
from boxreg_ros.structures import Sweep
from measure.drives import Drive
import numpy as np
import pytest
from scenes import observation

BOX = np.array([20.0, 0, 0, 4, 2, 1.5, 0, 0, 0])


def surface(n=MIN_VOTES):
    """Return points on the rear face of `BOX`, relative to its centre."""
    return np.stack([np.full(n, -2.0), np.linspace(-0.9, 0.9, n), np.zeros(n)], 1)


def test_motion_to_sight_is_that_of_the_points_of_the_box():
    # A box at 30 m/s whose points are 40 ms old, one at rest, and one without points.
    boxes = np.array([BOX, BOX, BOX])
    boxes[1, 1] = 50.0
    boxes[2, 1] = 100.0
    points = np.concatenate([surface() + boxes[0, :3], surface() + boxes[1, :3]])
    times = np.full(len(points), -0.04)
    velocities = np.array([[30.0, 0, 0], [0, 0, 0], [30.0, 0, 0]])
    sweep = Sweep(0, 'odom', points, times)
    motion = motion_to_sight(sweep, boxes, velocities)
    np.testing.assert_allclose(motion, [[-1.2, 0, 0], [0, 0, 0], [0, 0, 0]])
    assert not motion_to_sight(replace(sweep, times=None), boxes, velocities).any()
    whole = swept(boxes, motion)
    np.testing.assert_allclose(whole[0, [0, 3]], [20 - 0.6, 4 + 1.2])
    np.testing.assert_array_equal(whole[1:], boxes[1:])


def seen(known, velocity, delays):
    """Return an observation of `surface`, with delays [s], of a box of the `known` time."""
    delays = np.broadcast_to(delays, MIN_VOTES).astype(np.float32)
    sight = float(np.median(delays))
    points = surface() + np.outer(delays - sight * (known == 'sight'), velocity)
    return observation(boxes=BOX, points=points, delays=delays, sights=sight)


@pytest.mark.parametrize('known', ['stamp', 'sight'])
def test_points_on_the_faces_decide(known):
    evidence = BoxTimeEvidence()
    assert evidence.decided() == 'unknown'
    assert evidence.resolved(Config()).sampling.box_time == 'sight'
    velocity = np.array([30.0, 0, 0])
    found = seen(known, velocity, -0.04)
    few = observation(
        boxes=BOX, points=found.points[1:], delays=found.delays[1:], sights=found.sights
    )
    for _ in range(MIN_VOTES):
        evidence.add([found], 0.1 * velocity[None])  # slow
        evidence.add([few], velocity[None])
    assert not evidence.votes
    for _ in range(MIN_VOTES):
        evidence.add([found], velocity[None])
    assert evidence.votes == {known: MIN_VOTES}
    assert evidence.resolved(Config()).sampling.box_time == known
    other = 'sight' if known == 'stamp' else 'stamp'
    config = Config().updated({'sampling.box_time': other})
    assert evidence.resolved(config) == config
    for _ in range(MIN_VOTES):  # as many for the other: undecided
        evidence.add([seen(other, velocity, -0.04)], velocity[None])
    assert evidence.decided() == 'unknown'


@pytest.mark.parametrize('known', ['stamp', 'sight'])
def test_points_of_two_lidars_are_compared_at_their_own_times(known):
    # The second LiDAR sees the object 50 ms after the first.
    evidence = BoxTimeEvidence()
    velocity = np.array([10.0, 0, 0])
    delays = np.repeat([0.0, 0.05], MIN_VOTES // 2)
    evidence.add([seen(known, velocity, delays)], velocity[None])
    assert evidence.votes == {known: 1}


def mean_ious(speed, at_sight, seed):
    """Return the mean 3D IoU of each estimate on a highway at some speed [m/s]."""
    drive = Drive.from_scene(highway(np.random.default_rng(seed), 12, at_sight, speed))
    keys = list(zip(drive.truth.stamps_ns, drive.truth.track_ids, strict=True))
    tables = [drive.registered(Config(estimate=estimate)) for estimate in ('final', 'track')]
    means = {}
    for name, boxes in {**tables[0], **tables[1]}.items():
        names = zip(boxes.stamps_ns, boxes.track_ids, strict=True)
        row_of = dict(zip(names, boxes.boxes, strict=True))
        rows = [i for i, key in enumerate(keys) if key in row_of]
        found = np.array([row_of[keys[i]] for i in rows])
        means[name] = iou_3d(found, drive.truth.boxes[rows]).mean()
    return means


@pytest.mark.parametrize('at_sight', [False, True], ids=['stamp', 'sight'])
def test_fast_vehicles_are_as_accurate_as_slow_ones(at_sight):
    # The same scenes at 5 and at 30 m/s, with boxes of either time: the mean of two draws, which
    # differ by 0.02.
    draws = [[mean_ious(speed, at_sight, seed) for seed in (0, 1)] for speed in (5.0, 30.0)]
    for estimate in ('early', 'final', 'track'):
        slow, fast = ([means[estimate] for means in of_speed] for of_speed in draws)
        assert np.mean(fast) > np.mean(slow) - 0.01, estimate
