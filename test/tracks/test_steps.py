"""Each step from tracks to whole tracks, on tables of boxes with a known answer."""

from boxreg_ros.config import Config
from boxreg_ros.core.motion import motion_at
from boxreg_ros.structures import BoxArray, kept
from boxreg_ros.tracks.complete import complete
from boxreg_ros.tracks.extend import extend, MOVING_REACH, num_free, num_supported
from boxreg_ros.tracks.fill import fill, rarely_detected
from boxreg_ros.tracks.prune import duplicates, ghosts
from boxreg_ros.tracks.static import join_static
from boxreg_ros.tracks.stitch import best_links, join_turns, stitch
from boxreg_ros.tracks.tracklet import (
    between,
    is_parked,
    joined_tracklets,
    tracklets_of,
    unused_id,
)
from drives import detections, path, STEP_NS, tracklet
import numpy as np
import pytest

CONFIG = Config()
STAMPS = np.arange(200) * STEP_NS
INF = np.inf


def ids(tracklets):
    return [item.track_id for item in tracklets]


def circle(count, speed=6.0, rate=0.4):
    """Return the boxes of a car on a circle through the origin."""
    angle = rate * np.arange(count) * STEP_NS * 1e-9
    boxes = path((0, 0), (speed, 0), count)
    boxes[:, 0] = speed / rate * np.sin(angle)
    boxes[:, 1] = speed / rate * (1 - np.cos(angle))
    boxes[:, 8] = angle
    return boxes


def test_motion_predicts_a_straight_line_and_a_circle():
    straight = path((3, 4), (5, -2), 20)
    motion = motion_at(STAMPS[:10], straight[:10], -1, CONFIG.vehicle)
    np.testing.assert_allclose(motion.predict(int(STAMPS[19])), straight[19], atol=1e-9)
    motion = motion_at(STAMPS[10:20], straight[10:], 0, CONFIG.vehicle)
    np.testing.assert_allclose(motion.predict(0), straight[0], atol=1e-9)
    curve = circle(25)
    motion = motion_at(STAMPS[:20], curve[:20], -1, CONFIG.vehicle)
    assert motion.turn_rate == pytest.approx(0.4)
    # The slope of a line through an arc is a little less than the speed.
    np.testing.assert_allclose(motion.predict(int(STAMPS[24])), curve[24], atol=0.03)


def test_covariance_grows_with_the_acceleration():
    car = CONFIG.vehicle
    motion = motion_at(STAMPS[:20], path((0, 0), (10, 0), 20), -1, car)
    near, far = (motion.covariance(int(STAMPS[19 + k])) for k in (1, 10))
    # After 1 s: a / 2 along, and half of min(cornering, 10 m/s x 0.5 rad/s) across.
    rest = motion.speed_variance + 0.1**2
    assert far[0, 0] == pytest.approx((car.acceleration / 2) ** 2 + rest)
    assert far[1, 1] == pytest.approx((car.cornering / 2) ** 2 + rest)
    assert near[0, 0] < 0.02


def test_hermite_curve_follows_a_parabola_exactly():
    seconds = np.arange(30) * 0.1
    boxes = path((0, 0), (5, 0), 30)
    boxes[:, 0] = 5 * seconds + 0.7 * seconds**2
    before = motion_at(STAMPS[:2], boxes[:2], -1, CONFIG.vehicle)
    after = motion_at(STAMPS[10:12], boxes[10:12], 0, CONFIG.vehicle)
    found = between(before, after, STAMPS[2:10])
    # The velocities at the ends are those of the middle of a step.
    np.testing.assert_allclose(found[:, 0], boxes[2:10, 0], atol=0.03)
    linear = np.linspace(before.box[0], after.box[0], 10)[1:-1]
    assert np.abs(linear - boxes[2:10, 0]).max() > 0.1


def test_best_links_leaves_ambiguous_fragments_apart():
    clear = np.array([[INF, 1.0, 20.0], [INF, INF, INF], [INF, INF, INF]])
    assert best_links(clear).pairs == [(0, 1)]
    close = np.array([[INF, 1.0, 3.0], [INF, INF, INF], [INF, INF, INF]])
    assert best_links(close) == ([], [(0, 1)])
    # 0, 1, 2 are a chain: 2 could follow 0 as well, which is not ambiguous.
    chain = np.array([[INF, 1.0, 3.0], [INF, INF, 1.0], [INF, INF, INF]])
    assert best_links(chain) == ([(0, 1), (1, 2)], [])
    assert best_links(np.full((2, 2), INF)) == ([], [])


def test_fragments_of_one_car_are_stitched():
    boxes = path((0, 0), (8, 1), 40)
    turned = boxes[26:].copy()
    turned[:, 8] += np.pi  # a flip is no other object
    parts = [
        tracklet('a', boxes[:10]),
        tracklet('b', boxes[16:20], 16),
        tracklet('c', turned, 26),
        tracklet('far', path((0, 30), (8, 1), 20), 12),
    ]
    found, ambiguous = stitch(parts, CONFIG)
    assert ids(found) == ['c', 'far']
    assert ambiguous == []
    assert found[0].fragments == 3
    assert (
        found[0].stamps_ns.tolist()
        == STAMPS[[*range(10), *range(16, 20), *range(26, 40)]].tolist()
    )


@pytest.mark.parametrize(
    'change',
    [
        lambda boxes: boxes[:, :2].__iadd__([0, 6]),
        lambda boxes: boxes[:, 3].__imul__(2),
        lambda boxes: boxes[:, 8].__iadd__(np.pi / 2),
        lambda boxes: boxes[:, 2].__iadd__(2),
    ],
    ids=['position', 'length', 'heading', 'height'],
)
def test_fragments_that_disagree_are_not_stitched(change):
    boxes = path((0, 0), (8, 0), 30)
    later = boxes[15:].copy()
    change(later)
    found, _ = stitch([tracklet('a', boxes[:10]), tracklet('b', later, 15)], CONFIG)
    assert ids(found) == ['a', 'b']


def test_the_motion_of_both_fragments_leads_to_the_other_one():
    slow = tracklet('a', path((0, 0), (8, 0), 10))
    start = path((0, 0), (8, 0), 16)[15, :2]
    for speed, number in ((8, 1), (20, 2)):  # the second car comes from elsewhere
        later = tracklet('b', path(start, (speed, 0), 12), 15)
        assert len(stitch([slow, later], CONFIG)[0]) == number


def test_fragments_of_other_kinds_are_not_stitched():
    boxes = path((0, 0), (8, 0), 30)
    for name, number in (('truck', 1), ('cyclist', 2)):  # a vehicle, and none
        later = tracklet('b', boxes[15:], 15, class_name=name)
        assert len(stitch([tracklet('a', boxes[:10]), later], CONFIG)[0]) == number


def test_a_gap_longer_than_both_fragments_is_left():
    """Two short ghosts would fit each other anywhere."""
    boxes = path((0, 0), (5, 0), 40)
    ghosts = [tracklet('a', boxes[:3]), tracklet('b', boxes[12:15], 12)]
    assert len(stitch(ghosts, CONFIG)[0]) == 2
    longer = [tracklet('a', boxes[:12]), tracklet('b', boxes[21:24], 21)]
    assert len(stitch(longer, CONFIG)[0]) == 1


def test_tracks_that_cross_are_not_exchanged():
    east = path((-10, 0), (10, 0), 40)
    north = path((0, -10), (0, 10), 40)
    parts = [
        tracklet('east', east[:17]),
        tracklet('north', north[:17]),
        tracklet('x', north[23:], 23),
        tracklet('y', east[23:], 23),
    ]
    found, ambiguous = stitch(parts, CONFIG)
    assert ambiguous == []
    for whole, truth in zip(found, (east, north), strict=True):
        np.testing.assert_allclose(whole.boxes[-1], truth[-1])


def test_ambiguous_fragments_are_listed():
    boxes = path((0, 0), (8, 0), 30)
    twin = boxes[15:] + np.eye(9)[1] * 0.3
    parts = [tracklet('a', boxes[:10]), tracklet('b', boxes[15:], 15), tracklet('c', twin, 15)]
    found, ambiguous = stitch(parts, CONFIG)
    assert ids(found) == ['a', 'b', 'c']
    assert ambiguous[0][0] == 'a'


def test_parked_tracks_with_a_pause_are_one():
    place = path((5, 5), (0, 0), 20)
    parts = [
        tracklet('a', place[:10]),
        tracklet('b', place[:8] + np.eye(9)[0] * 0.2, 100),
        tracklet('other', path((12, 5), (0, 0), 8), 100),
    ]
    assert ids(join_static(parts, CONFIG)) == ['a', 'other']
    # Of two tracks that begin there at a time one continues it, and the other one stays.
    twins = [parts[0], parts[1], tracklet('c', place[:6], 100)]
    assert ids(join_static(twins, CONFIG)) == ['a', 'c']
    # Another car stood there meanwhile.
    between_them = tracklet('x', path((7.5, 5), (0, 0), 5), 50)
    assert ids(join_static([parts[0], between_them, parts[1]], CONFIG)) == ['a', 'x', 'b']
    assert not is_parked(path((0, 0), (3, 0), 10))


def test_gap_is_filled_with_growing_covariance():
    boxes = path((0, 0), (8, 1), 30)
    steps = [*range(10), *range(17, 30)]
    (added,) = fill(tracklet('a', boxes[steps], steps=steps), STAMPS, CONFIG)
    np.testing.assert_allclose(added.boxes, boxes[10:17], atol=1e-6)
    assert added.stamps_ns.tolist() == STAMPS[10:17].tolist()
    # With an acceleration a, the object is a s t / 2 off, here at s = t = 0.4 s.
    middle = added.covariances[3, 0, 0]
    expected = 0.01 + (CONFIG.vehicle.cornering * 0.4 * 0.4 / 2) ** 2
    assert middle == pytest.approx(expected)
    assert (np.diff(added.covariances[:4, 0, 0]) > 0).all()


def test_long_gaps_are_filled_for_parked_objects_only():
    steps = [*range(5), *range(60, 65)]
    moving = tracklet('a', path((0, 0), (3, 0), 65)[steps], steps=steps)
    assert fill(moving, STAMPS, CONFIG) == []
    parked = tracklet('b', path((0, 0), (0, 0), 65)[steps], steps=steps)
    (added,) = fill(parked, STAMPS, CONFIG)
    assert len(added.boxes) == 55
    # A gap of exactly `fill_gap`, 2 s, is filled.
    for first, number in ((24, 1), (25, 0)):
        steps = [*range(5), *range(first, first + 5)]
        moving = tracklet('c', path((0, 0), (3, 0), 30)[steps], steps=steps)
        assert len(fill(moving, STAMPS, CONFIG)) == number
    steps = [*range(5), *range(60, 65)]
    # A stamp at which the input has no boxes of any object is no gap.
    assert fill(parked, STAMPS[steps], CONFIG) == []


def test_tracks_are_compared_with_the_usual_rate_of_detection():
    def some(track_id, steps):
        return tracklet(track_id, path((0, 0), (0, 0), len(steps)), steps=steps)

    def rare(tracks, stamps_ns=STAMPS[:80]):
        return rarely_detected(tracks, stamps_ns, CONFIG)

    bush, brief = some('bush', [3, 8, 15, 22, 30]), some('brief', [3, 4, 7, 8])
    often = some('bush for long', range(3, 80, 7))
    always, half = some('always', range(40)), some('half', range(0, 80, 2))
    assert rare([bush, brief, often, always, always]) == {'bush', 'bush for long'}
    assert rare([half, always, always]) == set()  # not less than half as often
    assert rare([bush, brief]) == set()  # how often is usual is not known
    # A detector that misses six of seven boxes of an object does so with each.
    assert rare([bush, often]) == set()
    # One that is slower than the LiDAR misses nothing between its own boxes.
    assert (
        rare([some('of slow', [5, 15, 20]), some('slow', range(0, 40, 5))], STAMPS[:40:5]) == set()
    )
    # One gap may be an object out of sight, as is any longer than `fill_gap`.
    assert rare([some('passed', [3, 4, 15]), always, always]) == set()
    assert rare([some('parked', [0, 1, 2, 70, 72, 73]), always, always]) == set()


def test_extension_follows_the_motion_from_the_track_outwards():
    boxes = path((0, 0), (8, 1), 60)
    before, after = extend(tracklet('a', boxes[20:40], 20), STAMPS[:60], CONFIG)
    reach = round(MOVING_REACH / 0.1)
    assert before.stamps_ns.tolist() == STAMPS[19 : 19 - reach : -1].tolist()
    np.testing.assert_allclose(after.boxes, boxes[40 : 40 + reach], atol=1e-6)
    np.testing.assert_allclose(before.boxes, boxes[19 : 19 - reach : -1], atol=1e-6)
    assert extend(tracklet('a', boxes[:5], 20), STAMPS, CONFIG) == []


def test_extension_ends_with_its_points_and_at_other_tracks():
    at_end = np.array([40, 50, 60])
    assert num_supported(np.array([40, 20, 3, 50]), at_end) == 2
    assert num_supported(np.array([40, 20]), at_end) == 2
    assert num_supported(np.array([14]), at_end) == 0  # 0.3 of 50 is 15
    boxes = path((0, 0), (8, 0), 60)
    (after,) = extend(tracklet('a', boxes[:30]), STAMPS[:60], CONFIG)
    assert num_free(after, {}) == len(after.boxes)
    assert num_free(after, {int(STAMPS[33]): [boxes[33]]}) == 3


def test_ghosts_and_duplicates_are_found():
    car = path((0, 0), (8, 0), 30)
    tracks = [
        tracklet('car', car),
        tracklet('twin', car[5:8] + np.eye(9)[1] * 0.2, 5, points=30),
        tracklet('empty', path((20, 9), (0, 0), 3), 7, points=0),
        tracklet('jumps', path((20, 29), (0, 0), 4) + np.outer([0, 3, 0, 3], np.eye(9)[0]), 7),
        tracklet('short', path((40, 9), (0, 0), 3), 7),
        tracklet('flash', path((80, 9), (0, 0), 2), 7),
        tracklet('enters', path((90, 9), (0, 0), 2), 28),
        tracklet('hidden', path((60, 9), (0, 0), 9), 7, points=0),
        tracklet('rider', car[5:8], 5, class_name='cyclist'),
    ]
    assert duplicates(tracks, CONFIG) == {'twin'}
    assert ghosts(tracks) == {'empty', 'jumps', 'flash'}


def test_confirmed_tracks_are_never_rejected():
    car = path((0, 0), (8, 0), 30)
    tracks = [tracklet('a', car), tracklet('b', car[:6], points=0)]
    assert duplicates(tracks, CONFIG) == ghosts(tracks) == set()
    fewer = tracklet('c', car[:5], points=0)
    assert duplicates([tracks[0], fewer], CONFIG) == ghosts([fewer]) == {'c'}


def test_an_id_is_split_after_a_gap_longer_than_max_gap():
    place = path((5, 5), (0, 0), 1)[0]
    for gap, number in ((16, 1), (17, 2)):  # 1.6 s is `max_gap`
        steps = [0, 1, 2, 2 + gap, 3 + gap]
        results = [kept(detections(step, [('7', place)]), '') for step in steps]
        points = [np.array([20])] * len(steps)
        assert len(tracklets_of(results, points, 'odom', CONFIG)) == number


def test_joined_tracks_have_the_majority_class_and_the_longest_id():
    boxes = path((0, 0), (8, 0), 30)
    parts = [
        tracklet('a', boxes[:4], class_name='van'),
        tracklet('b', boxes[5:12], 5),
        tracklet('c', boxes[13:19], 13, class_name='van'),
    ]
    whole = joined_tracklets(parts)
    assert (whole.track_id, whole.class_name, whole.fragments) == ('b', 'van', 3)
    assert (np.diff(whole.stamps_ns) > 0).all()
    taken = {'7', '7_2'}
    assert (unused_id('7', taken), unused_id('7', taken)) == ('7_3', '7_4')


def test_tracks_that_take_turns_are_one():
    car = path((0, 0), (8, 0), 40)
    steps = np.arange(40)
    of_a, of_b = steps[steps % 10 < 4], steps[(steps % 10 >= 5) & (steps % 10 < 8)]
    first, second = tracklet('a', car[of_a], steps=of_a), tracklet('b', car[of_b], steps=of_b)
    (whole,), left = join_turns([first, second], CONFIG)
    assert whole.track_id == 'a'
    assert whole.stamps_ns.tolist() == STAMPS[np.sort([*of_a, *of_b])].tolist()
    assert left == []
    beside = tracklet('b', car[of_b] + 2.5 * np.eye(9)[1], steps=of_b)
    rider = tracklet('b', car[of_b], steps=of_b, class_name='cyclist')
    ahead = tracklet('b', car[:38] + 5.0 * np.eye(9)[0], steps=steps[:38])
    over = tracklet('b', car[:38] + 1.0 * np.eye(9)[1], steps=steps[:38], points=1)
    for other in (beside, rider, ahead, over):
        assert set(ids(join_turns([first, other], CONFIG)[0])) == {'a', 'b'}


def test_of_two_boxes_at_one_stamp_a_joined_track_has_one():
    car = path((0, 0), (8, 0), 40)
    of_a, of_b = np.array([*range(10), *range(15, 30)]), np.arange(8, 16)
    first, second = tracklet('a', car[of_a], steps=of_a), tracklet('b', car[of_b], steps=of_b)
    (whole,), (left,) = join_turns([first, second], CONFIG)
    assert (whole.track_id, left.track_id) == ('a', 'b')
    assert whole.stamps_ns.tolist() == STAMPS[:30].tolist()
    assert left.stamps_ns.tolist() == STAMPS[[8, 9, 15]].tolist()


def test_tracks_that_take_turns_are_not_filled_over_each_other():
    car = path((0, 0), (8, 0), 39)
    id_at = {step: 'ab'[step // 5 % 2] for step in range(39) if step % 10 != 9}
    given = []
    for step, stamp_ns in enumerate(STAMPS[:39].tolist()):
        rows = [(id_at[step], 'car', car[step])] if step in id_at else []
        names, classes, boxes = zip(*rows, strict=True) if rows else ((), (), np.zeros((0, 9)))
        scores = np.ones(len(names))
        given.append(BoxArray(stamp_ns, 'odom', names, classes, scores, np.array(boxes)))
    config = CONFIG.updated({'complete.stitch': True, 'complete.fill': True})
    points = [np.full(len(array.track_ids), 50) for array in given]
    plan = complete(given, [kept(array, '') for array in given], points, 'odom', config)
    for step, array in enumerate(plan.arrays):
        names = [*array.track_ids, *(box.track_id for box in array.added)]
        assert names == ['a'], f'step {step}'
