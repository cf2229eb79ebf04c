"""Labels of points by boxes whose place at the time of each point is known."""

from boxreg_ros.config import Config
from boxreg_ros.core.point_labels import (
    BACKGROUND,
    MOVING,
    ObjectTrack,
    PARKED,
    PointLabeller,
    STOOD,
    UNKNOWN,
    UNKNOWN_MOTION,
)
from boxreg_ros.structures import Sweep
import numpy as np
import pytest

SECOND = 10**9
START = 1_700_000_000 * SECOND
AT_STAMP = Config().updated({'sampling.box_time': 'stamp'})
EXTENT = [4.0, 2.0, 1.5]
STAMPS = START + np.arange(11) * SECOND // 10


def track_of(places, name='a', class_name='car', yaw=0.0, certain=True, stamps=STAMPS):
    """Return a track of boxes on a road at z = 0, with their centres at x and y."""
    n = len(stamps)
    places = np.broadcast_to(places, (n, 2))
    boxes = np.column_stack([places, np.full(n, 0.75), np.tile([*EXTENT, 0, 0, yaw], (n, 1))])
    return ObjectTrack(name, class_name, stamps, boxes, np.full(n, certain))


def labelled(tracks, points, stamp_ns=STAMPS[5], times=None, arrays=STAMPS, margin=0.0):
    labeller = PointLabeller(tracks, arrays, AT_STAMP, np.full((len(tracks), 6), margin))
    points = np.array(points, np.float32)
    return labeller.label(Sweep(int(stamp_ns), 'odom', points, times))


def moving(speed, name='a', **options):
    return track_of(np.column_stack([speed * np.arange(11) * 0.1, np.zeros(11)]), name, **options)


def test_points_belong_to_the_box_at_their_own_time():
    # At 20 m/s the front is at 10 + 2 = 12 m at the stamp, and at 11 m 50 ms earlier.
    points = [[11.9, 0, 1], [11.9, 0, 1], [7.5, 0, 1], [7.5, 0, 1]]
    times = np.array([0.0, -0.05, 0.0, -0.05])
    found = labelled([moving(20.0)], points, times=times)
    assert found.track.tolist() == [0, BACKGROUND, BACKGROUND, 0]
    assert found.motion.tolist() == [MOVING, UNKNOWN_MOTION, UNKNOWN_MOTION, MOVING]
    np.testing.assert_allclose(found.local[:, 0], [1.9, -1.5], atol=1e-5)
    np.testing.assert_allclose(found.at_stamp()[:, 0], [11.9, 8.5], atol=1e-5)
    assert found.is_dynamic.tolist() == [True, False, False, True]


def test_points_turn_with_their_object():
    # 0.5 rad/s about the centre, at 4 m/s along x: fast enough to have a turn rate.
    seconds = np.arange(11) * 0.1
    track = track_of(np.column_stack([4 * seconds, 0 * seconds]))
    track.boxes[:, 8] = 0.5 * seconds
    local = np.array([1.8, 0.9])
    time, angle = 0.08, 0.5 * (0.5 + 0.08)
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    place = [4 * (0.5 + time), 0.0] + R @ local
    found = labelled([track], [[*place, 1.0]], times=np.array([time]))
    np.testing.assert_allclose(found.local[0, :2], local, atol=1e-5)


def test_the_deepest_of_overlapping_boxes_has_the_point():
    tracks = [track_of([0.0, 0.0]), track_of([3.0, 0.0], 'b')]
    points = [[1.2, 0, 1], [1.8, 0, 1], [1.5 - 1e-3, 0, 1]]  # both end at x = 1 to 2
    assert labelled(tracks, points).track.tolist() == [0, 1, 0]


def test_margins_move_the_surface_that_points_are_expected_on():
    beside = [[2.2, 0, 1]]
    assert labelled([track_of([0, 0])], beside).track.tolist() == [UNKNOWN]
    assert labelled([track_of([0, 0])], beside, margin=-0.1).track.tolist() == [0]
    assert labelled([track_of([0, 0])], beside, margin=0.3).track.tolist() == [BACKGROUND]


def test_points_of_the_road_are_background_and_those_of_it_or_a_moving_object_unknown():
    ring = [[x, y, 0.02] for x in np.linspace(-2.6, 2.6, 14) for y in (-1.5, 1.5)]
    points = [[0, 0.9, 0.03], [0, 0.9, 0.3], [0, 1.3, 0.03], [0, 0.9, -0.1]]
    for track, low in ((track_of([0.0, 0.0]), BACKGROUND), (moving(20.0), UNKNOWN)):
        x = track.boxes[5, 0]
        found = labelled([track], np.add([*ring, *points], [x, 0, 0])).track.tolist()
        assert found == [BACKGROUND] * len(ring) + [low, 0, BACKGROUND, BACKGROUND]


@pytest.mark.parametrize(
    ('speeds', 'motion'),
    [([0] * 41, PARKED), ([3] * 41, MOVING), ([0] * 20 + [3] * 21, STOOD), ([0], UNKNOWN_MOTION)],
)
def test_motion_of_an_object(speeds, motion):
    stamps = START + np.arange(len(speeds)) * SECOND // 10
    noise = np.random.default_rng(0).normal(0, 0.05, len(speeds))  # of registered centres
    x = np.cumsum(speeds) * 0.1 + noise
    track = track_of(np.column_stack([x, 0 * x]), stamps=stamps)
    first = [[x[0], 0, 1]]
    assert labelled([track], first, stamps[0], arrays=stamps).motion.tolist() == [motion]


def test_an_estimate_that_jumps_does_not_move():
    stamps = START + np.arange(41) * SECOND // 10
    x = np.where(np.arange(41) < 18, 0.0, -0.6) + 0.02 * np.sin(np.arange(41))
    x[18:22] = [-0.12, -0.24, -0.36, -0.48]  # as the boxes of a parked car that is seen anew
    track = track_of(np.column_stack([x, 0 * x]), stamps=stamps)
    found = [labelled([track], [[0, 0, 1]], stamp, arrays=stamps).motion[0] for stamp in stamps]
    assert set(found) == {PARKED}


def test_what_cannot_be_known_is_unknown():
    far, near, inside = [30, 0, 1], [2.4, 0, 1], [0, 0, 1]
    parked = track_of([0.0, 0.0])
    kept = track_of([0.0, 0.0], certain=False)
    assert labelled([parked], [far, near, inside]).track.tolist() == [BACKGROUND, BACKGROUND, 0]
    # A kept box may be off its points by half a metre.
    assert labelled([kept], [far, near, inside]).track.tolist() == [BACKGROUND, UNKNOWN, 0]
    # Sweeps without boxes, but not sweeps in which nothing was detected.
    late = STAMPS[-1] + 2 * SECOND
    assert labelled([parked], [far], late).track.tolist() == [UNKNOWN]
    assert labelled([], [far]).track.tolist() == [BACKGROUND]
    assert labelled([], [far], arrays=STAMPS[:0]).track.tolist() == [UNKNOWN]


def test_between_two_boxes_a_moving_object_is_unknown_and_a_parked_one_is_not():
    stamps = np.append(STAMPS, STAMPS + SECOND + SECOND)  # a gap of one second
    middle = STAMPS[-1] + SECOND // 2
    seconds = (stamps - START) * 1e-9
    moves = track_of(np.column_stack([5 * seconds, 0 * seconds]), stamps=stamps)
    point = [[5 * 1.5, 0, 1], [0.0, 6.0, 1]]
    parked = track_of([0.0, 6.0], 'b', stamps=stamps)
    found = labelled([moves, parked], point, middle, arrays=stamps)
    assert found.track.tolist() == [UNKNOWN, 1]
    assert found.motion.tolist() == [MOVING, PARKED]
    assert found.is_dynamic.tolist() == [True, False]


def test_clouds_without_times_are_labelled_at_their_stamp():
    found = labelled([moving(20.0)], [[11.9, 0, 1], [7.5, 0, 1]])
    assert found.track.tolist() == [0, BACKGROUND]
    assert len(labelled([moving(20.0)], np.zeros((0, 3))).track) == 0


def test_before_and_after_its_boxes_a_moving_object_is_somewhere_near():
    """It has not appeared there: its points are not background, nor known to be its own."""
    times = [STAMPS[0] - 4 * SECOND // 10, STAMPS[-1] + 4 * SECOND // 10]
    arrays = [*STAMPS, *times, STAMPS[-1] + SECOND]
    parked = track_of([0.0, 6.0], 'b')
    for stamp in times:
        x = 20.0 * (stamp - START) / SECOND
        points = [[x + 1.9, 0, 1], [x + 4, 0, 1], [0, 6, 1]]
        found = labelled([moving(20.0), parked], points, stamp, arrays=arrays)
        assert found.track.tolist() == [UNKNOWN, BACKGROUND, BACKGROUND]
        assert found.is_dynamic.tolist() == [True, False, False]
    late = labelled([moving(20.0)], [[40.0, 0, 1]], arrays[-1], arrays=arrays)
    assert late.track.tolist() == [BACKGROUND]


def test_an_object_whose_id_changes_keeps_its_points_and_its_motion():
    whole = moving(20.0)
    parts = [('a', slice(0, 6)), ('b', slice(6, 11))]
    tracks = [ObjectTrack(name, 'car', *(x[part] for x in whole[2:])) for name, part in parts]
    for number, stamp in enumerate(STAMPS):
        found = labelled(tracks, [[2.0 * number + 1.9, 0, 1]], stamp)
        assert (found.track.tolist(), found.motion.tolist()) == ([number > 5], [MOVING])
    between = (STAMPS[5] + STAMPS[6]) // 2
    assert labelled(tracks, [[11.0, 0, 1]], between).is_dynamic.all()
