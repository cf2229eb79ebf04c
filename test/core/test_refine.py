"""Refined tracks against the truth, for good, poor, wrong and random input."""

from dataclasses import replace

from boxreg_ros import Config, refine, Track
from boxreg_ros.core.metrics import iou_3d, iou_bev, pose_errors
from boxreg_ros.errors import ConfigError, ShapeError
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.simulation.noise import detector_noise
from boxreg_ros.structures import is_valid_box
from measure.drives import Drive, tracks_of
import numpy as np
import pytest
from scenes import cut, drive, simulated, stamps, track_of
from scipy.spatial.transform import Rotation
import torch

ESTIMATES = ['early', 'final', 'track']
each_estimate = pytest.mark.parametrize('estimate', ESTIMATES)
each_objective = pytest.mark.parametrize(
    ('objective', 'estimate'), [('paper', 'track'), *(('robust', name) for name in ESTIMATES)]
)


def a_track(seed=0, n=12, truth=None, **noise):
    truth = drive(n) if truth is None else truth
    return track_of(truth, np.random.default_rng(seed), **noise), truth


def only(track, config=None):
    (refined,) = refine([track], config)
    n = len(track.stamps_ns)
    assert refined.track_id == track.track_id
    assert refined.boxes.shape == (n, 9)
    assert refined.covariances.shape == (n, 6, 6)
    assert len(refined.status) == len(refined.reasons) == n
    assert np.isfinite(refined.boxes).all()
    assert np.isfinite(refined.covariances).all()
    assert set(refined.status) <= {'refined', 'kept', 'interpolated'}
    for row, (status, reason) in enumerate(zip(refined.status, refined.reasons, strict=True)):
        assert bool(reason) == (status != 'refined')
        if status == 'kept':
            np.testing.assert_array_equal(refined.boxes[row], track.boxes[row])
    return refined


def num_kept_at_start(estimate):
    """Return how many boxes are kept before a track is long enough."""
    return 2 if estimate == 'early' else 0


# --- accuracy ------------------------------------------------------------------------------------


def test_refine_beats_the_paper_in_its_experiment():
    # An SUV on the path of Eq. 10 with the initial errors of Table I: the input has a mean IoU
    # of about 0.6. The robust objective must exceed 0.8, and the paper's objective.
    scene = simulated('paper', 1, 20)
    (track,), truth = tracks_of(scene), scene.truth.boxes
    few = {'sampling.points': 100}
    ours = iou_3d(only(track, Config().updated(few)).boxes, truth).mean()
    paper = only(track, Config(objective='paper').updated(few))
    theirs, given = iou_3d(paper.boxes, truth).mean(), iou_3d(track.boxes, truth).mean()
    assert given < 0.7
    assert ours > 0.8
    assert ours > theirs + 0.03
    assert theirs > given


@each_estimate
@pytest.mark.parametrize(
    'motion',
    [{}, {'speed': 0.0, 'turn': 0.0}, {'speed': -3.0, 'turn': 0.0}, {'speed': 10.0, 'turn': 0.6}],
    ids=['turning', 'parked', 'reversing', 'fast'],
)
def test_refined_boxes_are_more_accurate_than_the_input(estimate, motion):
    # Errors of 0.15 m and 0.05 rad give an IoU of 0.8. Early estimates, which use no later
    # observations, must reduce 1 - IoU by a third, the others by half.
    missing = []
    for seed in range(4):
        track, truth = a_track(seed, truth=drive(14, **motion))
        refined = only(track, Config(estimate=estimate))
        missing.append([1 - iou_3d(boxes, truth).mean() for boxes in (track.boxes, refined.boxes)])
        assert set(refined.status[num_kept_at_start(estimate) :]) == {'refined'}
        covariances = refined.covariances
        np.testing.assert_allclose(covariances, covariances.swapaxes(1, 2), atol=1e-9)
        assert (np.linalg.eigvalsh(covariances) > 0).all()
    before, after = np.mean(missing, axis=0)
    assert after < (2 / 3 if estimate == 'early' else 1 / 2) * before


def braking(n=40, speed=14.0, brake=8.0, start=1.5):
    """Return true boxes of a car that brakes to a stop at 8 m/s^2."""
    truth, t = drive(n, speed=0.0, turn=0.0, start=(-18.0, 5.0, 0.0)), 0.1 * np.arange(n)
    late = (t - start).clip(0, speed / brake)
    truth[:, 0] += speed * (np.minimum(t, start) + late) - brake * late**2 / 2
    return truth


@pytest.mark.parametrize('estimate, most', [('final', 1.05), ('track', 0.5)])
def test_hard_braking_is_followed(estimate, most):
    # The motion model expects 1.5 m/s^2: over a window of 0.9 s it is wrong by
    # 6.5 * 0.9^2 / 2 = 2.6 m. The points must outweigh it. Live, accurate input is not improved
    # here: over twelve seeds 1 - IoU is 1.02 times that of the input, 0.28 times for whole
    # tracks.
    missing = []
    for seed in range(3):
        track, truth = a_track(seed, truth=braking(), position=0.05, heading=0.01)
        refined = only(track, Config(estimate=estimate))
        assert np.abs(refined.boxes - truth)[:, 0].max() < 0.5
        missing.append([1 - iou_3d(boxes, truth).mean() for boxes in (track.boxes, refined.boxes)])
    before, after = np.mean(missing, axis=0)
    assert after < most * before


@each_estimate
def test_true_boxes_among_those_of_a_detector_are_not_lost(estimate):
    # Eight cars around the sensor: the boxes of the first are true, those of the others have the
    # errors of a detector. The noise is that of all of them. Means of three draws: from one to the
    # next the first car varies by .01.
    draws = [exact_and_noisy(estimate, seed) for seed in (1, 2, 3)]
    exact_bev, exact_3d, before, after = np.mean(draws, axis=0)
    assert exact_bev > 0.96
    assert exact_3d > 0.94
    assert 1 - after < 0.75 * (1 - before)


def exact_and_noisy(estimate, seed):
    """Return BEV and 3D IoU of the true boxes, and 3D IoU of the others before and after."""
    rng = np.random.default_rng(seed)
    angles = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    truths = [drive(30, turn=0.1, start=(12 * np.cos(a), 12 * np.sin(a), a + 1.2)) for a in angles]
    tracks = [track_of(truth, rng, str(i)) for i, truth in enumerate(truths)]
    given = [truths[0], *(detector_noise(t, np.zeros((30, 3)), rng) for t in truths[1:])]
    tracks = [replace(t, boxes=boxes) for t, boxes in zip(tracks, given, strict=True)]
    exact, *others = refine(tracks, Config(estimate=estimate))
    before = np.mean([iou_3d(b, t).mean() for b, t in zip(given[1:], truths[1:], strict=True)])
    after = np.mean([iou_3d(o.boxes, t).mean() for o, t in zip(others, truths[1:], strict=True)])
    bev, volume = (iou(exact.boxes, truths[0]).mean() for iou in (iou_bev, iou_3d))
    return bev, volume, before, after


def test_a_parked_object_does_not_move():
    # At most 2 cm per step; the input moves by 0.15 m.
    track, truth = a_track(truth=drive(20, speed=0.0, turn=0.0))
    refined = only(track)
    assert np.linalg.norm(np.diff(refined.boxes[:, :2], axis=0), axis=1).max() < 0.02
    assert np.ptp(refined.boxes[:, 8]) < 0.01
    assert np.abs(refined.boxes - truth)[:, :3].max() < 0.1


def test_the_extents_of_a_track_are_estimated():
    # Input extents with errors of 5 % (0.2 m of length), independent at every stamp.
    track, truth = a_track(n=20, extent=0.05)
    refined = only(track)
    assert np.ptp(refined.boxes[:, 3:6], axis=0).max() == 0
    assert np.abs(refined.boxes - truth)[0, 3:6].max() < 0.1
    paper = only(track, Config(objective='paper'))
    assert np.ptp(paper.boxes[:, 3:6], axis=0).max() == 0


def test_the_order_of_tracks_does_not_matter():
    tracks = [
        replace(a_track(i, truth=drive(12, start=start))[0], track_id=str(i))
        for i, start in enumerate([(5.0, 6.0, 0.2), (-20.0, 9.0, 2.0), (15.0, -15.0, -1.0)])
    ]
    known = refine(tracks)
    found = refine(tracks[::-1])[::-1]
    for a, b, track in zip(found, known, tracks, strict=True):
        assert a.track_id == b.track_id == track.track_id
        np.testing.assert_allclose(a.boxes, b.boxes, atol=1e-6)


def test_ids_may_be_empty_and_origins_unknown():
    """Any id is allowed, and one known sensor origin per stamp is sufficient."""
    (known, _), (other, _) = a_track(0), a_track(1, truth=drive(12, start=(-20.0, 9.0, 2.0)))
    blind = replace(other, sensor_origins=np.full((12, 3), np.nan))
    for ids in (('', '?'), ('0', '')):
        named = [replace(t, track_id=name) for t, name in zip((blind, known), ids, strict=True)]
        expected = refine([replace(other, track_id='a'), replace(known, track_id='b')])
        for found, one in zip(refine(named), expected, strict=True):
            assert set(found.status) == {'refined'}
            np.testing.assert_array_equal(found.boxes, one.boxes)


@each_estimate
def test_whole_turns_of_input_angles_do_not_matter(estimate):
    track, _ = a_track(0)
    turns = np.random.default_rng(0).integers(-1, 2, (12, 3))
    boxes = track.boxes + np.pad(2 * np.pi * turns, ((0, 0), (6, 0)))
    config = Config(estimate=estimate)
    found, known = only(replace(track, boxes=boxes), config), only(track, config)
    assert found.status == known.status
    np.testing.assert_allclose(wrap_angle(found.boxes - known.boxes), 0, atol=1e-6)


# --- weak evidence -------------------------------------------------------------------------------


@each_estimate
def test_three_points_per_box_do_no_harm(estimate):
    # They provide little evidence: boxes are smoothed, and not worse than the input.
    track, truth = a_track()
    poor = replace(track, points=[points[::60][:3] for points in track.points])
    refined = only(poor, Config(estimate=estimate))
    assert iou_3d(refined.boxes, truth).mean() > iou_3d(track.boxes, truth).mean() - 0.02


@each_estimate
def test_observations_without_points_are_estimated_from_the_others(estimate):
    track, truth = a_track()
    hidden = np.isin(np.arange(12), (6, 7))
    points = [p[:0] if h else p for p, h in zip(track.points, hidden, strict=True)]
    refined = only(replace(track, points=points), Config(estimate=estimate))
    first = num_kept_at_start(estimate)
    assert refined.reasons == ('short_track',) * first + ('',) * (12 - first)
    before, after = iou_3d(track.boxes, truth), iou_3d(refined.boxes, truth)
    for part in (hidden, ~hidden & (np.arange(12) >= first)):
        assert 1 - after[part].mean() < 2 / 3 * (1 - before[part].mean())
    deviations = np.sqrt(np.linalg.det(refined.covariances[:, :2, :2]))
    assert deviations[hidden].min() > deviations[5]


@each_estimate
def test_a_track_without_any_points_is_kept(estimate):
    track, _ = a_track()
    refined = only(replace(track, points=[[]] * 12), Config(estimate=estimate))
    assert set(refined.status) == {'kept'}
    assert set(refined.reasons[num_kept_at_start(estimate) :]) == {'no_points'}


@each_estimate
@pytest.mark.parametrize('n', [1, 2])
def test_a_track_too_short_is_kept(estimate, n):
    track, _ = a_track(n=n)
    refined = only(track, Config(estimate=estimate))
    assert refined.status == ('kept',) * n
    assert refined.reasons == ('short_track',) * n


@each_estimate
def test_min_observations_may_be_two(estimate):
    """Second differences need three observations: their terms are empty here."""
    track, _ = a_track(n=2)
    refined = only(track, Config(estimate=estimate).updated({'min_observations': 2}))
    assert refined.status[-1] == 'refined'
    assert np.isfinite(refined.boxes).all()


def test_empty_input_gives_empty_output():
    track = Track('1', 'car', [], np.zeros((0, 9)), [])
    assert only(track).status == ()
    assert refine([]) == []


# --- invalid input -------------------------------------------------------------------------------


@each_estimate
@pytest.mark.parametrize(
    'column, value', [(0, np.nan), (8, np.inf), (3, 0.0), (4, -1.8)],
    ids=['nan', 'infinite', 'flat', 'negative'],
)  # fmt: skip
def test_an_invalid_box_is_interpolated(estimate, column, value):
    # The car moves by 0.5 m a step: interpolation is as accurate as the neighbours.
    track, truth = a_track()
    boxes = track.boxes.copy()
    boxes[5, column] = value
    refined = only(replace(track, boxes=boxes), Config(estimate=estimate))
    assert refined.status[5] == 'interpolated'
    others = refined.status[num_kept_at_start(estimate) : 5] + refined.status[6:]
    assert set(others) == {'refined'}
    between = refined.boxes[[4, 6]].mean(0)
    np.testing.assert_allclose(refined.boxes[5], between, atol=1e-9)
    assert iou_3d(refined.boxes[5:6], truth[5:6])[0] > 0.7


def test_invalid_boxes_at_the_ends_equal_the_nearest_box():
    track, _ = a_track()
    boxes = track.boxes.copy()
    boxes[[0, 11]] = np.nan
    refined = only(replace(track, boxes=boxes))
    assert refined.status[0] == refined.status[11] == 'interpolated'
    np.testing.assert_allclose(refined.boxes[[0, 11]], refined.boxes[[1, 10]])


def test_interpolation_takes_the_shortest_path_across_pi():
    # Headings 3.1 and -3.1 are 0.08 rad apart.
    truth = drive(12, speed=5.0, turn=0.4, start=(5.0, 6.0, 2.9))
    track, _ = a_track(truth=truth)
    boxes = track.boxes.copy()
    row = int(np.abs(truth[:, 8] - np.pi).argmin())
    boxes[row] = np.nan
    refined = only(replace(track, boxes=boxes))
    error = pose_errors(refined.boxes, truth).rotation[:, 2]
    assert np.abs(error).max() < 0.1
    assert np.abs(refined.boxes[:, 8]).max() <= np.pi


def test_points_that_are_not_finite_are_ignored():
    track, _ = a_track()
    points = [np.r_[p, [[np.nan, 0, 0], [0, np.inf, 0], [-np.inf] * 3]] for p in track.points]
    known = only(track)
    np.testing.assert_array_equal(only(replace(track, points=points)).boxes, known.boxes)


def test_a_few_stamps_may_be_of_several_lidars_at_almost_the_same_time():
    track, _ = a_track()
    close = track.stamps_ns[0] + 300_000 * np.arange(4)
    few = replace(
        track,
        stamps_ns=close,
        boxes=track.boxes[:4],
        points=track.points[:4],
        sensor_origins=None,
        scores=None,
    )
    np.testing.assert_array_equal(few.stamps_ns, close)


@pytest.mark.parametrize('unit', ['us', 'ns'])
def test_stamps_may_be_datetime64_of_any_unit(unit):
    track, _ = a_track()
    times = track.stamps_ns.astype('datetime64[ns]').astype(f'datetime64[{unit}]')
    np.testing.assert_array_equal(replace(track, stamps_ns=times).stamps_ns, track.stamps_ns)


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'stamps_ns': np.arange(12) * 0.1}, ['stamps_ns', 'float64', '1e9']),
        ({'stamps_ns': [None] * 12}, ['stamps_ns', 'object']),
        ({'stamps_ns': np.arange(12)}, ["stamps_ns of track '1'", '1 ns apart', 'seconds']),
        ({'stamps_ns': np.arange(12) * 100_000}, ['1e+05 ns apart', 'microseconds']),
        ({'class_name': None}, ['class_name', 'None']),
        ({'boxes': torch.zeros(12, 9, requires_grad=True)}, ['boxes', 'grad']),
        ({'boxes': np.zeros((12, 7))}, ["track '1'", '(12, 7)', 'height roll pitch yaw']),
        ({'points': None}, ["track '1'", '12 arrays', 'None']),
        ({'points': [np.zeros((5, 4))] * 12}, ['points[0]', '(5, 4)', 'columns x y z']),
        ({'points': [None] * 12}, ['points[0]', 'columns x y z']),
    ],
)
def test_invalid_arguments_of_a_track_are_refused(changes, words):
    with pytest.raises(ShapeError) as error:
        replace(a_track()[0], **changes)
    assert all(word in str(error.value) for word in words)


def test_config_is_checked_and_tracks_may_be_a_generator():
    track, _ = a_track()
    with pytest.raises(ConfigError, match=r'^config: .*from_dict$'):
        refine([track], {'window': 5})
    (found,), (known,) = refine(t for t in [track]), refine([track])
    np.testing.assert_array_equal(found.boxes, known.boxes)
    empty = replace(track, points=[torch.zeros(0)] * 12)
    assert [len(points) for points in empty.points] == [0] * 12


def test_lists_and_single_precision_give_the_boxes_of_arrays():
    track, _ = a_track()
    lists = Track(
        track.track_id,
        track.class_name,
        track.stamps_ns.tolist(),
        track.boxes.tolist(),
        (points.tolist() for points in track.points),
        track.sensor_origins.tolist(),
    )
    np.testing.assert_array_equal(only(lists).boxes, only(track).boxes)
    single = replace(track, boxes=track.boxes.astype(np.float32))
    np.testing.assert_allclose(only(single).boxes, only(track).boxes, atol=1e-3)


def test_tracks_are_equal_to_themselves_only():
    track, _ = a_track()
    twin = replace(track)
    assert track != twin
    assert len({track, twin}) == 2


def test_other_objects_than_tracks_are_refused():
    with pytest.raises(ShapeError, match=r"class Track, got <class 'dict'>"):
        refine([{'track_id': '1'}])


def test_tracks_without_valid_boxes_and_repeated_ids_are_refused():
    track, _ = a_track()
    with pytest.raises(ShapeError, match=r"track '1': expected one finite box"):
        refine([replace(track, boxes=track.boxes * np.nan)])
    with pytest.raises(ShapeError, match=r"different track ids, got \['1', '1'\]"):
        refine([track, track])


@each_estimate
def test_reversing_is_not_a_flip(estimate):
    track, truth = a_track(truth=drive(14, speed=-4.0, turn=0.2))
    refined = only(track, Config(estimate=estimate))
    assert np.abs(pose_errors(refined.boxes, truth).rotation[:, 2]).max() < 0.2


@each_estimate
def test_motion_corrects_headings_that_are_all_flipped(estimate):
    track, truth = a_track(truth=drive(14, speed=9.0, turn=0.2))
    boxes = track.boxes.copy()
    boxes[:, 8] += np.pi
    refined = only(replace(track, boxes=boxes), Config(estimate=estimate))
    corrected = slice(3 if estimate == 'early' else 0, None)  # two steps are too few
    assert np.abs(pose_errors(refined.boxes, truth).rotation[corrected, 2]).max() < 0.2


# An input box far off, as after an id switch. It contains no points and is kept.
@pytest.mark.parametrize('far', [3.0, 10.0, 100.0, 10_000.0])
def test_an_outlier_box_does_not_affect_the_others(far):
    others = np.arange(20) != 9
    for seed in range(2):
        track, truth = a_track(seed, truth=drive(20))
        boxes = track.boxes.copy()
        boxes[9, 1] += far
        refined = only(replace(track, boxes=boxes))
        before, after = (iou_3d(b, truth)[others] for b in (boxes, refined.boxes))
        assert after.mean() > before.mean()


# --- marginalisation prior -----------------------------------------------------------------------


def test_the_marginalisation_prior_improves_boxes(set_constants):
    # 50 sweeps of a street, windows of 10: the constant error of the input of a track is
    # estimated from all its observations, also marginalised ones. Over eight seeds of 60 sweeps
    # the gain was 0.002 to 0.006 of IoU (early) and 0.003 to 0.008 (final); half of the least is
    # required.
    scene = simulated('street', 0)
    known = mean_overlaps(scene)
    set_constants(prior_decay=0.0)
    forgetful = mean_overlaps(scene)
    assert known['early'] > forgetful['early'] + 0.001
    assert known['final'] > forgetful['final'] + 0.001


def mean_overlaps(scene):
    """Return the mean IoU of early and of final boxes of a scene with their true boxes."""
    truth, means = truth_of(scene), {}
    for estimate, results in Drive.from_scene(scene).refined(Config(estimate='final')).items():
        arrays = [result.boxes for result in results]
        found = np.concatenate([array.boxes for array in arrays])
        true = [truth[array.stamp_ns, name] for array in arrays for name in array.track_ids]
        means[estimate] = iou_3d(found, np.array(true)).mean()
    return means


@pytest.mark.parametrize('estimate', ['early', 'final'])
def test_accuracy_does_not_degrade_on_a_long_track(estimate):
    # 36 s on circles: nothing diverges; the last boxes are as accurate as the first.
    track, truth = a_track(truth=drive(360))
    config = Config(estimate=estimate, window=6, lag=3).updated({'sampling.points': 64})
    refined = only(track, config)
    assert set(refined.status[num_kept_at_start(estimate) :]) == {'refined'}
    before, after = (1 - iou_3d(boxes, truth) for boxes in (track.boxes, refined.boxes))
    assert after[-100:].mean() < 2 / 3 * before[-100:].mean()
    assert after[-100:].mean() < 1.2 * after[20:120].mean()


# --- settings ------------------------------------------------------------------------------------


@each_objective
def test_bev_does_not_change_z_roll_and_pitch(objective, estimate):
    track, truth = a_track()
    config = Config(estimate=estimate, mode='bev', extent='fixed', objective=objective)
    refined = only(track, config)
    np.testing.assert_allclose(refined.boxes[:, 2:8], track.boxes[:, 2:8], rtol=0, atol=1e-9)
    assert iou_3d(refined.boxes, truth).mean() > iou_3d(track.boxes, truth).mean()


def test_bev_keeps_the_mean_height_of_the_input():
    track, _ = a_track(extent=0.05)
    refined = only(track, Config(mode='bev'))
    np.testing.assert_allclose(refined.boxes[:, 5], track.boxes[:, 5].mean(), rtol=1e-9)
    assert np.ptp(refined.boxes[:, 3:6], axis=0).max() == 0


@each_objective
def test_fixed_extents_are_those_of_the_input(objective, estimate):
    track, _ = a_track(extent=0.05)
    refined = only(track, Config(estimate=estimate, extent='fixed', objective=objective))
    np.testing.assert_array_equal(refined.boxes[:, 3:6], track.boxes[:, 3:6])


# --- frames --------------------------------------------------------------------------------------


def moved(track, R, shift):
    """Return `track` in a frame rotated about z by R (3, 3), then shifted."""
    boxes = track.boxes.copy()
    boxes[:, :3] = boxes[:, :3] @ R.T + shift
    boxes[:, 8] += np.arctan2(R[1, 0], R[0, 0])
    return replace(
        track,
        boxes=boxes,
        points=[points @ R.T + shift for points in track.points],
        sensor_origins=track.sensor_origins @ R.T + shift,
    )


@each_estimate
def test_the_result_is_shifted_with_the_fixed_frame(estimate):
    # 1000 km away float64 resolves 1e-10 m, and points are relative to their boxes.
    track, _ = a_track()
    shift = np.array([1e6, -1e6, 1e3])
    config = Config(estimate=estimate)
    known, found = only(track, config), only(moved(track, np.eye(3), shift), config)
    np.testing.assert_allclose(found.boxes[:, :3] - shift, known.boxes[:, :3], rtol=0, atol=1e-4)
    np.testing.assert_allclose(found.boxes[:, 3:], known.boxes[:, 3:], rtol=0, atol=1e-4)
    assert found.status == known.status


@each_estimate
@pytest.mark.parametrize('angle', [0.7, 3.0, -1.7])
def test_the_result_is_rotated_with_the_fixed_frame(set_constants, estimate, angle):
    # At most 300 points, so that none is left out by its order along x. Two rounds, because
    # rounding may decide whether there is another one.
    set_constants(shape_points=300)
    track, _ = a_track()
    R = Rotation.from_euler('z', angle).as_matrix()
    config = Config(estimate=estimate).updated({'sampling.points': 300, 'solver.rounds': 2})
    known, found = only(track, config), only(moved(track, R, np.zeros(3)), config)
    turned = moved(replace(track, boxes=known.boxes), R, np.zeros(3)).boxes
    errors = pose_errors(found.boxes, turned)
    for error in (errors.translation, errors.extent, errors.rotation):
        np.testing.assert_allclose(error, 0, atol=1e-3)


def test_stamps_may_start_anywhere():
    track, _ = a_track()
    known = only(track)
    for start in (0, 1, -(10**12), 4 * 10**18):
        shifted = replace(track, stamps_ns=track.stamps_ns - track.stamps_ns[0] + start)
        np.testing.assert_allclose(only(shifted).boxes, known.boxes, atol=1e-9)


# --- random input --------------------------------------------------------------------------------


def test_input_is_not_written_to():
    track, _ = a_track()
    boxes, points = track.boxes.copy(), [p.copy() for p in track.points]
    origins, when = track.sensor_origins.copy(), track.stamps_ns.copy()
    for estimate in ESTIMATES:
        refined = only(track, Config(estimate=estimate))
        refined.boxes[:] = np.nan
    np.testing.assert_array_equal(track.boxes, boxes)
    np.testing.assert_array_equal(track.sensor_origins, origins)
    np.testing.assert_array_equal(track.stamps_ns, when)
    for a, b in zip(track.points, points, strict=True):
        np.testing.assert_array_equal(a, b)


def random_track(rng):
    """Return a track of random values, some of them invalid."""
    n = int(rng.integers(1, 16))
    scale = 10.0 ** rng.uniform(-3, 5)
    boxes = rng.normal(size=(n, 9)) * 10.0 ** rng.uniform(-3, 1, 9)
    boxes[:, :3] *= scale
    boxes[:, 3:6] = 10.0 ** rng.uniform(-4, 3, (n, 3))
    for value in (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e30):
        if rng.random() < 0.2:
            boxes[rng.integers(n), rng.integers(9)] = value
    points = [rng.normal(size=(rng.integers(0, 60), 3)) * scale + boxes[i, :3] for i in range(n)]
    points = [np.where(rng.random(p.shape) < 0.01, np.nan, p) for p in points]
    origins = rng.normal(size=(n, 3)) * scale
    if rng.random() < 0.3:
        origins[rng.integers(n)] = rng.choice([np.nan, np.inf])
    steps = (10.0 ** rng.uniform(0, 10, n)).astype(np.int64)
    steps[-1] += 10**9  # all stamps close together are of another unit
    boxes[0] = np.where(np.isfinite(boxes[0]), boxes[0], 1.0)
    boxes[0, :3] = boxes[0, :3].clip(-1e5, 1e5)
    boxes[0, 3:6] = np.abs(boxes[0, 3:6]).clip(1e-3, 50.0)
    return Track(
        '1', str(rng.choice(['car', 'pedestrian', 'cyclist', ''])), np.cumsum(steps), boxes,
        points, None if rng.random() < 0.2 else origins,
    )  # fmt: skip


@pytest.mark.filterwarnings('ignore::RuntimeWarning')  # overflow of huge values
@pytest.mark.parametrize('seed', range(40))
def test_random_input_gives_finite_boxes(seed):
    rng = np.random.default_rng(seed)
    config = Config().updated(
        {
            'estimate': str(rng.choice(ESTIMATES)),
            'objective': 'paper' if seed % 8 == 0 else 'robust',
            'mode': str(rng.choice(['3d', 'bev'])),
            'extent': str(rng.choice(['track', 'fixed'])),
            'paper.iterations': 5,
        }
    )
    track = random_track(rng)
    refined = only(track, config)
    valid = is_valid_box(track.boxes)
    assert [s == 'interpolated' for s in refined.status] == (~valid).tolist()
    assert (refined.boxes[:, 3:6] > 0).all()


def test_random_tracks_do_not_affect_other_tracks():
    # A good track together with bad ones far away, all solved in one batch.
    good, truth = a_track(n=15)
    known, far = only(good, Config(estimate='final')), 1e5 * np.eye(9)[0]
    for seed in range(5):
        bad = random_track(np.random.default_rng(100 + seed))
        bad = replace(
            bad, track_id='bad', stamps_ns=stamps(len(bad.stamps_ns)),
            boxes=bad.boxes + far, points=[p + far[:3] for p in bad.points],
        )  # fmt: skip
        found, _ = refine([good, bad], Config(estimate='final'))
        assert found.status == known.status
        # All tracks share the input model: small changes are expected.
        assert np.abs(found.boxes - known.boxes)[:, :3].max() < 0.1
        assert iou_3d(found.boxes, truth).mean() > iou_3d(good.boxes, truth).mean()


def truth_of(scene):
    """Return the true boxes (9,) of a scene by stamp [ns] and track."""
    table = scene.truth
    keys = zip(table.stamps_ns.tolist(), table.track_ids, strict=True)
    return dict(zip(keys, table.boxes, strict=True))


def normalised_errors(scenario, seeds, variables):
    """
    Return the mean of e' C^-1 e / n over refined boxes, of n `variables` of a pose.

    e is the error and C its covariance.

    """
    values = []
    for seed in seeds:
        scene = simulated(scenario, seed)
        truth = truth_of(scene)
        tracks = tracks_of(scene)
        for track, refined in zip(tracks, refine(tracks), strict=True):
            for i, stamp_ns in enumerate(track.stamps_ns.tolist()):
                true = truth[stamp_ns, track.track_id]
                error = (refined.boxes[i] - true)[[0, 1, 2, 6, 7, 8]]
                error[3:] = wrap_angle(error[3:])
                if refined.status[i] == 'refined' and abs(error[5]) < np.pi / 2:
                    covariance = refined.covariances[i][np.ix_(variables, variables)]
                    error = error[variables]
                    values.append(error @ np.linalg.solve(covariance, error) / len(error))
    return np.mean(values)


@pytest.mark.parametrize(
    ('scenario', 'seeds', 'variables', 'least'),
    [('street', range(2), range(6), 0.65), ('paper', range(5), [3, 4], 0.55)],
)
def test_covariances_are_consistent_with_the_errors(
    scenario, seeds, variables, least, set_constants
):
    # 1 for a consistent covariance. Simulated labels have no errors of time and heading. Here it
    # is still too large: some 20 tracks do not exclude that margins vary by 3 cm. The one track of
    # the paper's experiment shows neither that nor the constant errors of its extents, which have
    # none, so that its roll and pitch alone can be consistent.
    set_constants(time_deviation=0.0, heading_deviation=0.0)
    assert least <= normalised_errors(scenario, seeds, [*variables]) <= 1.5


def test_track_estimates_beat_final_ones_at_half_the_rate():
    # At 5 Hz few tracks are long enough to estimate the errors of the input, and their temporal
    # correlation is half as strong between stamps.
    overlaps = []
    for seed in range(2):
        scene = simulated('street', seed)
        truth = truth_of(scene)
        tracks = [cut(track, slice(None, None, 2)) for track in tracks_of(scene)]
        lagged, whole = (refine(tracks, Config(estimate=e)) for e in ('final', 'track'))
        for track, *found in zip(tracks, lagged, whole, strict=True):
            true = [truth[stamp_ns, track.track_id] for stamp_ns in track.stamps_ns.tolist()]
            is_seen = [len(points) >= 100 for points in track.points]
            overlaps += list(zip(*(iou_3d(r.boxes, true)[is_seen] for r in found), strict=True))
    lagged, whole = np.mean(overlaps, axis=0)
    assert whole > lagged


# --- pinned boxes --------------------------------------------------------------------------------


def short_by(truth, missing):
    """Return a track whose boxes lack `missing` [m] at the end that the sensor does not see."""
    track, _ = a_track(truth=truth, position=0.05, heading=0.01)
    boxes = track.boxes.copy()
    boxes[:, 3] -= missing
    heading = np.c_[np.cos(truth[:, 8]), np.sin(truth[:, 8])]
    boxes[:, :2] -= missing / 2 * heading
    return replace(track, boxes=boxes)


@each_estimate
def test_track_follows_a_pinned_box(estimate):
    truth = drive(14)
    track = short_by(truth, 0.8)
    config = Config(estimate=estimate)
    pinned = np.arange(14) == 8
    boxes = np.where(pinned[:, None], truth, track.boxes)
    (corrected,) = refine([replace(track, boxes=boxes, pinned=pinned)], config)
    assert corrected.status[8] == 'human'
    assert corrected.reasons[8] == ''
    np.testing.assert_array_equal(corrected.boxes[8], truth[8])
    after = np.arange(14) > 8
    before = iou_3d(only(track, config).boxes[after], truth[after]).mean()
    assert (1 - iou_3d(corrected.boxes[after], truth[after]).mean()) < 0.5 * (1 - before)


def test_pinned_box_decides_on_the_heading():
    truth = drive(12, speed=1.0, turn=0.0)  # too slow for motion to decide
    track, _ = a_track(truth=truth, position=0.02, heading=0.01)
    turned = track.boxes + np.pi * np.eye(9)[8]
    pinned = np.arange(12) == 4
    boxes = np.where(pinned[:, None], truth, turned)
    (refined,) = refine([replace(track, boxes=boxes, pinned=pinned)], Config(estimate='track'))
    assert (np.cos(refined.boxes[:, 8] - truth[:, 8]) > 0.9).all()


def test_a_pinned_box_that_is_turned_does_not_turn_those_of_the_others():
    truth = drive(12, speed=1.0, turn=0.0)
    track, _ = a_track(truth=truth, position=0.02, heading=0.01)
    pinned = np.arange(12) % 3 == 1
    boxes = np.where(pinned[:, None], truth, track.boxes)
    boxes[4, 8] += np.pi
    (refined,) = refine([replace(track, boxes=boxes, pinned=pinned)], Config(estimate='track'))
    is_turned = np.cos(refined.boxes[:, 8] - truth[:, 8]) < 0
    np.testing.assert_array_equal(is_turned, np.arange(12) == 4)


def test_pins_change_nothing_of_other_tracks_without_any():
    track, _ = a_track()
    (plain,) = refine([track])
    (same,) = refine([replace(track, pinned=np.zeros(12, bool))])
    np.testing.assert_array_equal(same.boxes, plain.boxes)


@pytest.mark.parametrize(
    ('pinned', 'word'),
    [([True], 'shape'), (np.ones(12), 'booleans'), (np.arange(12) == 3, 'positive extents')],
)
def test_bad_pins_are_refused(pinned, word):
    track, _ = a_track()
    boxes = track.boxes.copy()
    boxes[3, 0] = np.nan
    with pytest.raises(ShapeError, match=word):
        replace(track, boxes=boxes, pinned=pinned)
