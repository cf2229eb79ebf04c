"""Following one object through sweeps from a few boxes of a person."""

from dataclasses import replace

from boxreg_ros import follow, ShapeError
from boxreg_ros.core.following import person
from boxreg_ros.core.following.between import closed
from boxreg_ros.core.following.exact import between_exact, Keyframes
from boxreg_ros.core.following.motion_kinds import MOTIONS, steering
from boxreg_ros.core.following.person import corrections, DEVIATIONS
from boxreg_ros.core.following.tracker import Way
from boxreg_ros.core.method.follow_numbers import FOLLOW
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.structures import BoxArray, HUMAN, INTERPOLATED
import numpy as np
import pytest
from scenes import drive, returns, stamps
from scipy.interpolate import CubicSpline

N = 30
ORIGIN = (0.0, 0.0, 1.5)


def road(rng, count=4000):
    flat = rng.uniform(-30, 60, (count, 2))
    return np.column_stack([flat, rng.normal(0.0, 0.01, count)])


def scene(truth, rng, hidden=()):
    """Return the sweeps of an object and the road; without the object in `hidden` ones."""
    sweeps = []
    for row, box in enumerate(truth):
        parts = [road(rng)]
        if row not in hidden:
            parts.append(returns(box, rng, 150, ORIGIN))
        sweeps.append(np.concatenate(parts))
    return sweeps


def seed(truth, row, name='a', **changes):
    box = truth[row] + np.array([0.02, -0.02, 0.01, 0, 0, 0, 0, 0, 0.01])
    return BoxArray(
        int(stamps(len(truth))[row]), '', (name,), ('car',), np.ones(1), box[None], **changes
    )


@pytest.mark.parametrize('start', [0, 15, N - 1])
def test_one_box_is_followed_both_ways_along_a_curve(start):
    rng = np.random.default_rng(1)
    truth = drive(N, speed=8.0, turn=0.3)
    [track] = follow(stamps(N), scene(truth, rng), [seed(truth, start)])
    assert track.rows.tolist() == list(range(N))
    assert [end.reason for end in track.ends] == ['end_of_sweeps'] * 2
    assert track.status[start] == HUMAN
    iou = iou_3d(track.boxes, truth)
    assert iou.min() > 0.75
    assert iou.mean() > 0.85


def test_a_lost_object_gets_no_box_and_an_occluded_one_goes_on():
    rng = np.random.default_rng(2)
    truth = drive(N, speed=6.0, turn=0.0)
    hidden = range(10, 15)
    [track] = follow(stamps(N), scene(truth, rng, hidden), [seed(truth, 2)])
    assert track.rows[-1] == N - 1
    assert iou_3d(track.boxes, truth[track.rows])[15:].min() > 0.7
    [track] = follow(stamps(N), scene(truth, rng, range(20, N)), [seed(truth, 2)])
    assert track.rows[-1] == 19
    assert track.ends[1].reason == 'few_points'
    assert track.ends[1].stamp_ns == stamps(N)[19]


def test_boxes_between_keyframes_are_better_than_a_line():
    rng = np.random.default_rng(3)
    truth = drive(N, speed=8.0, turn=0.6)
    rows = [0, 10, 20, 29]
    [track] = follow(stamps(N), scene(truth, rng), [seed(truth, row) for row in rows])
    assert track.status.count(HUMAN) == 4
    assert track.status.count(INTERPOLATED) == N - 4
    at = stamps(N)
    line = np.stack([np.interp(at, at[rows], column) for column in truth[rows].T], axis=1)
    assert iou_3d(track.boxes, truth).mean() > iou_3d(line, truth).mean() + 0.05


def test_extents_grow_from_the_size_of_a_class_and_those_of_a_person_stay():
    rng = np.random.default_rng(6)
    truth = drive(N, speed=6.0, turn=0.3)
    sweeps = scene(truth, rng)
    small = seed(truth, 10)
    forward = np.array([np.cos(truth[10, 8]), np.sin(truth[10, 8]), 0.0])
    toward = np.sign(forward @ (np.array(ORIGIN) - truth[10, :3]))
    small.boxes[0, 3] -= 0.6
    small.boxes[0, :3] += toward * 0.3 * forward  # the near end stays
    [track] = follow(stamps(N), sweeps, [small])
    assert np.abs(track.boxes[:, 3:6] - truth[:, 3:6]).max() < 0.15
    assert iou_3d(track.boxes, truth[track.rows]).mean() > 0.85
    own = seed(truth, 10)
    [track] = follow(stamps(N), sweeps, [own])
    assert np.abs(track.boxes[:, 3:6] - own.boxes[:, 3:6]).max() < 0.03  # a person's error


def keyframes_of_a_drive(position, extent, yaw, num=6):
    """Return the true boxes of some objects, and `follow` of keyframes with these errors."""
    rng = np.random.default_rng(7)
    truths = [drive(N, speed=5.0, turn=0.1) for _ in range(num)]
    for i, truth in enumerate(truths):
        truth[:, 1] += 9.0 * i - 20
    sweeps = [
        np.concatenate([one, *(returns(truth[row], rng, 150, ORIGIN) for truth in truths)])
        for row, one in enumerate(scene(truths[0], rng, range(N)))
    ]
    deviations = np.repeat([position, extent, 0.0], 3)
    deviations[8] = yaw
    keys = []
    for i, truth in enumerate(truths):
        for row in range(0, N, 5):
            box = truth[row] + rng.normal(0.0, 1.0, 9) * deviations
            columns = (str(i),), ('car',), np.ones(1), box[None]
            keys.append(BoxArray(int(stamps(N)[row]), '', *columns))
    origins = np.tile(ORIGIN, (N, 1))
    return np.array(truths), follow(stamps(N), sweeps, keys, None, origins), keys


def test_keyframes_are_soft_by_the_error_that_they_show():
    truths, exact, _ = keyframes_of_a_drive(0.0, 0.0, 0.0)
    rows = np.arange(0, N, 5)
    iou = [iou_3d(t.boxes[rows], truth[rows]) for t, truth in zip(exact, truths, strict=True)]
    assert np.mean(iou) > 0.995
    truths, soft, keys = keyframes_of_a_drive(0.03, 0.03, np.radians(1))
    given = np.concatenate([key.boxes for key in keys])
    true = truths[:, rows].reshape(-1, 9)
    found = np.concatenate([track.boxes[rows] for track in soft])
    assert all(track.status[row] == HUMAN for track in soft for row in rows)
    assert iou_3d(found, true).mean() > iou_3d(given, true).mean() + 0.01
    assert np.abs(found[:, :3] - given[:, :3]).mean() < 0.03


def test_no_box_between_exact_keyframes_is_below_line_and_spline():
    # The objects turn evenly, so that the spline errs by less than a millimetre.
    truths, tracks, _ = keyframes_of_a_drive(0.0, 0.0, 0.0)
    rows, at = np.arange(0, N, 5), stamps(N) - stamps(N)[0]
    between = np.setdiff1d(np.arange(rows[-1]), rows)
    for track, truth in zip(tracks, truths, strict=True):
        spline = CubicSpline(at[rows], truth[rows])(at[between])
        line = np.stack([np.interp(at[between], at[rows], one) for one in truth[rows].T], axis=1)
        best = np.maximum(*(iou_3d(boxes, truth[between]) for boxes in (line, spline)))
        assert (iou_3d(track.boxes[between], truth[between]) >= best - 1e-9).all()


def curve_of(motion, fits=0.0, at=range(6)):
    """Return what is between exact keyframes `at` times [s] of a motion along x, every 0.1 s."""
    times = np.arange(51) / 10
    boxes, keys = np.zeros((51, 9)), np.zeros((len(at), 9))
    boxes[:, 0], keys[:, 0] = 100.0, motion(np.array(at))
    boxes[:, 3:6] = keys[:, 3:6] = 4, 2, 2
    residuals = np.zeros_like(keys)
    residuals[:, 0] = fits
    stamps_ns = (times * 1e9).astype(np.int64)
    keyframes = Keyframes((np.array(at) * 1e9).astype(np.int64), keys, residuals)
    return times, between_exact(stamps_ns, boxes, keyframes)[:, 0]


def test_a_line_a_spline_or_the_fits_are_between_exact_keyframes():
    wavy = [0.0, 0.1, 0.0, 0.1, 0.0, 0.1]  # fits err by .1 m from one keyframe to the next
    is_between = np.arange(51) % 10 > 0
    times, found = curve_of(lambda t: t**3, wavy)
    np.testing.assert_allclose(found[is_between], (times**3)[is_between])  # a spline
    times, found = curve_of(lambda t: np.abs(t - 2), [0.0, 0.03, 0.0, 0.03, 0.0, 0.03])
    # Splines overshoot; beside the kink, which a line without that keyframe misses, fits stay.
    for rows in (slice(1, 10), slice(31, 40), slice(41, 50)):
        np.testing.assert_allclose(found[rows], np.abs(times - 2)[rows])
    assert (found[11:20] == 100).all() and (found[21:30] == 100).all()
    times, found = curve_of(lambda t: np.abs(t - 2), wavy)  # a spline errs by less than twice that
    assert (found[11:20] == 100).all() and (found[21:30] != 100).all()
    _, found = curve_of(lambda t: 0 * t, 0.0)
    assert (found[is_between] == 0).all()  # at rest: as good as the fits
    _, found = curve_of(lambda t: (-1.0) ** t, wavy)
    assert (found == 100).all()  # the fits
    assert (curve_of(lambda t: t**3, [0.0, 0.1], [0, 5])[1] == 100).all()  # two show nothing


def test_fits_of_unknown_error_are_not_between_exact_keyframes():
    # Without a fit of the keyframe at 1 s, those at 1 and 2 s do not say by how much fits err.
    _, found = curve_of(lambda t: (-1.0) ** t, [0.0, np.nan, 0.0, 0.0, 0.0, 0.0])
    is_between = np.arange(51) % 10 > 0
    assert (found[:30][is_between[:30]] != 100).all()
    assert (found[30:][is_between[30:]] == 100).all()


def test_errors_of_close_keyframes_do_not_bend_a_spline_in_a_long_gap():
    # Three within .2 s are 1 cm off a line: an acceleration of 2 m/s^2, and a gap of 4.8 s.
    at, x = [0.0, 0.1, 0.2, 5.0], np.array([0.0, 0.01, 0.04, 0.0])
    times, found = curve_of(lambda _: x, [0.0, 0.3, 0.0, 0.3], at)
    assert np.abs(CubicSpline(at, x)(times)).max() > 3
    assert (found[3:50] == 100).all()  # the fits


def test_a_long_gap_between_keyframes_is_judged_by_its_length():
    # Without the keyframe at 3.9 s a line errs by .1 m there, for the next one is near, but by
    # 3.9^2 / (4 * 3.9 * .1) times as much in the long gap.
    _, found = curve_of(lambda t: 0.1 * (t == 3.9), [0.0, 0.3, 0.0, 0.3], [0, 3.9, 4, 5])
    assert (found[1:39] == 100).all()


def test_bad_keyframes_are_given_less_weight(monkeypatch):
    ious = []
    for evidence in (FOLLOW.evidence, 1e9):  # without and with the usual deviations in any case
        monkeypatch.setattr(person, 'FOLLOW', FOLLOW._replace(evidence=evidence))
        truths, tracks, _ = keyframes_of_a_drive(0.12, 0.1, np.radians(4))
        found = [iou_3d(t.boxes, truth[t.rows]) for t, truth in zip(tracks, truths, strict=True)]
        ious.append(np.concatenate(found).mean())
    assert ious[0] > ious[1] + 0.01


def test_deviations_of_keyframes_follow_from_their_residuals():
    rng = np.random.default_rng(8)
    others = 0.5 * DEVIATIONS  # errors of all else than the keyframe
    fit_variance = 1 / (others**-2 + DEVIATIONS**-2)
    weight = others**2 / (others**2 + DEVIATIONS**2)
    truth = drive(200)
    usual = truth + rng.normal(0.0, 1.0, truth.shape) * DEVIATIONS
    for keys in (truth, usual):
        fits = truth + rng.normal(0.0, 1.0, truth.shape) * others
        fits += weight * (keys - fits)
        steps = corrections(keys, fits, np.tile(fit_variance, (200, 1)), DEVIATIONS)
        if keys is usual:
            assert not steps.any()
        else:
            np.testing.assert_allclose(fits + steps, keys, atol=0.01)
            assert np.abs(fits - keys).mean() > 2 * np.abs(fits + steps - keys).mean()
        few = keys[:9], fits[:9], np.tile(fit_variance, (9, 1))
        assert not corrections(*few, DEVIATIONS).any()


def test_extents_shrink_to_the_edges_of_the_points():
    rng = np.random.default_rng(9)
    truth = drive(N, speed=6.0, turn=0.3)
    truth[:, 0] -= 13.0  # it passes, and both ends are seen
    sweeps = scene(truth, rng)
    large = seed(truth, 10)
    forward = np.array([np.cos(truth[10, 8]), np.sin(truth[10, 8]), 0.0])
    toward = np.sign(forward @ (np.array(ORIGIN) - truth[10, :3]))
    large.boxes[0, 3] += 0.6
    large.boxes[0, :3] -= toward * 0.3 * forward  # the near end stays
    own = seed(truth, 10)
    for given, error in ((large, 0.15), (own, 0.05)):
        [track] = follow(stamps(N), sweeps, [given])
        assert np.abs(track.boxes[:, 3:6] - truth[:, 3:6]).max() < error
        assert iou_3d(track.boxes, truth[track.rows]).mean() > 0.85
    person = replace(large, class_names=('pedestrian',))
    [track] = follow(stamps(N), sweeps, [person])  # limbs move: points show no extents
    assert np.abs(track.boxes[:, 3:6] - large.boxes[0, 3:6]).max() < 0.05


def test_boxes_of_the_same_size_have_that_of_their_class():
    rng = np.random.default_rng(10)
    truths = [drive(N, speed=6.0, turn=0.0) for _ in range(2)]
    truths[1][:, 1] += 8.0
    sweeps = [
        np.concatenate([one, returns(truths[1][row], rng, 150, ORIGIN)])
        for row, one in enumerate(scene(truths[0], rng))
    ]
    seeds = [seed(truth, 10, name) for truth, name in zip(truths, 'ab', strict=True)]
    for one in seeds:
        one.boxes[0, 5] += 0.2  # as much as a person may err
        one.boxes[0, 2] += 0.1
    tree = np.column_stack([rng.uniform(39, 41, (50, 2)), np.linspace(0.0, 12.0, 50)])
    wooded = [np.concatenate([one, tree]) for one in sweeps]
    origins = np.tile(ORIGIN, (N, 1))

    def heights(points, given, *more):
        return [t.boxes[0, 5] for t in follow(stamps(N), points, given, None, *more)]

    height, given = truths[0][0, 5], seeds[0].boxes[0, 5]
    np.testing.assert_allclose(heights(wooded, seeds[:1], origins), given, atol=0.05)
    np.testing.assert_allclose(heights(wooded, seeds, origins), height, atol=0.1)
    # The points may end at the limit of the field of view.
    np.testing.assert_allclose(heights(sweeps, seeds, origins), given, atol=0.05)
    np.testing.assert_allclose(heights(wooded, seeds), given, atol=0.05)


def test_neighbour_and_road_do_not_pull_a_parked_car():
    rng = np.random.default_rng(4)
    truth = drive(N, speed=0.0, turn=0.0)
    beside = truth + np.array([0.0, 2.3, 0, 0, 0, 0, 0, 0, 0])
    sweeps = [
        np.concatenate([one, returns(box, rng, 150, ORIGIN)])
        for one, box in zip(scene(truth, rng), beside, strict=True)
    ]
    [track] = follow(stamps(N), sweeps, [seed(truth, 0)])
    assert iou_3d(track.boxes, truth[track.rows]).min() > 0.8


def test_the_heading_of_a_long_vehicle_stays_where_its_rear_alone_is_seen():
    rng = np.random.default_rng(11)
    truth = drive(2 * N, speed=9.0, turn=0.0, start=(60.0, 0.0, 0.0))
    truth[:, 2:6] = 1.5, 23.0, 2.4, 3.0
    sweeps = [np.concatenate([road(rng), returns(box, rng, 120, ORIGIN, 0.03)]) for box in truth]
    box = truth[0] - np.array([*[0.0] * 8, 0.02])
    one = BoxArray(int(stamps(1)[0]), '', ('tram',), ('tram',), np.ones(1), box[None])
    [track] = follow(stamps(2 * N), sweeps, [one])
    assert len(track.rows) == 2 * N
    assert np.abs(track.boxes[:, 8]).max() < 0.1
    noise = MOTIONS['vehicle'].noise
    for length, pivot, factor in (
        (4.0, 1.0, 1.0),
        (9.0, 2.25, 0.25),
        (23.0, 8.5, (4.5 / 23) ** 2),
    ):
        found, own = steering(noise, length)
        assert own == pivot
        np.testing.assert_allclose(found / noise, [1.0, factor, 1.0, 1.0, 1.0])


def test_a_way_may_end_farther_from_a_seed_that_is_later():
    poses = {row: np.array([float(row), 0.0, 0.0, 0.0]) for row in range(1, 5)}
    way = Way(4, 1, None, 0.0, 0.4, 1.0, poses)
    rows, part = np.arange(1, 4), np.array([0.25, 0.5, 0.75])
    target = np.array([4.0, 0.5, 0.0, 0.0])
    assert closed(way, rows, part, target, 1.0) is None
    found = closed(way, rows, part, target, 2.0)
    np.testing.assert_allclose(found[:, 1], part * 0.5)
    way.reason = 'few_points'
    assert closed(way, rows, part, target, 2.0) is None


def test_seeds_that_cannot_be_used_are_named_and_the_rest_is_done():
    rng = np.random.default_rng(5)
    truth = drive(N)
    sweeps = scene(truth, rng)
    good = seed(truth, 0)
    empty = seed(truth + np.array([0, 30.0, 0, 0, 0, 0, 0, 0, 0]), 0, 'empty')
    twice = seed(truth, 0)
    late = BoxArray(10**18, '', ('late',), ('car',), np.ones(1), truth[:1])
    jump = [seed(truth, 0, 'jump'), seed(truth + np.array([200.0, *[0] * 8]), 2, 'jump')]
    tracks = follow(stamps(N), sweeps, [good, empty, twice, late, *jump])
    by_name = {track.track_id: track for track in tracks}
    assert len(by_name['a'].rows) == N
    assert 'expected one box at a stamp' in by_name['a'].problems[0]
    assert 'expected 5 points in their boxes, got 0' in by_name['empty'].problems[0]
    assert by_name['empty'].rows.tolist() == [0]
    assert 'the nearest is' in by_name['late'].problems[0]
    assert not len(by_name['late'].rows)
    assert "one is inside that of track 'jump'" in by_name['a'].problems[1]
    assert 'too far apart' in by_name['jump'].problems[-1]
    assert follow(stamps(N), sweeps, []) == []
    with pytest.raises(ShapeError, match='expected 30 arrays, got 29'):
        follow(stamps(N), sweeps[1:], [good])
    with pytest.raises(ShapeError, match='as of seconds, milliseconds or microseconds'):
        follow(stamps(N) // 1000, sweeps, [good])
