"""Each box is returned once, in order, with its status; the same calls return the same boxes."""

from dataclasses import replace
import gc

from boxreg_ros import Config, refine
from boxreg_ros.config import Ingredients
from boxreg_ros.core import estimation
from boxreg_ros.core.estimation import estimate_windows, solve
from boxreg_ros.core.geometry import face_distances
from boxreg_ros.core.latency import Latency
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.core.pending import PendingArray
from boxreg_ros.core.problem import stack_windows
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.structures import BoxArray, Sweep
import numpy as np
import pytest
from scenes import cut, drive, fed, PERIOD_NS, stamps, stream_of, track_of
import torch

ESTIMATES = ['early', 'final', 'track']
each_estimate = pytest.mark.parametrize('estimate', ESTIMATES)


@pytest.fixture(scope='module')
def tracks():
    """Return two cars far apart; the second is observed at the third to tenth stamp only."""
    rng = np.random.default_rng(0)
    first = track_of(drive(14), rng, 'a')
    return [first, cut(track_of(drive(14, start=(-12.0, -6.0, 3.0)), rng, 'b'), slice(2, 10))]


@pytest.fixture(scope='module')
def stream(tracks):
    return stream_of(tracks)


def config_with(estimate='final', **changes):
    # Few points, for speed.
    base = {'estimate': estimate, 'window': 6, 'lag': 3, 'sampling.points': 64}
    return Config().updated({**base, **changes})


def run(stream, config):
    registrar = BoxRegistrar(config)
    return fed(registrar, stream) + registrar.flush(), registrar.counts


def finals(results):
    return [result for result in results if result.is_final]


def assert_equal(results, known, atol=0.0):
    assert len(results) == len(known)
    for a, b in zip(results, known, strict=True):
        assert (a.boxes.stamp_ns, a.boxes.track_ids, a.is_final) == (
            b.boxes.stamp_ns, b.boxes.track_ids, b.is_final,
        )  # fmt: skip
        np.testing.assert_allclose(a.boxes.boxes, b.boxes.boxes, rtol=0, atol=atol)
        assert (a.status, a.reasons) == (b.status, b.reasons)


# --- returned arrays -----------------------------------------------------------------------------


@each_estimate
def test_every_box_is_returned_once_in_order(stream, estimate):
    results, counts = run(stream, config_with(estimate))
    assert [r.boxes.stamp_ns for r in finals(results)] == [b.stamp_ns for _, b in stream]
    for result, (sweep, given) in zip(finals(results), stream, strict=True):
        n = len(given.track_ids)
        boxes = result.boxes
        assert (boxes.track_ids, boxes.class_names) == (given.track_ids, given.class_names)
        assert boxes.frame_id == 'odom'
        np.testing.assert_array_equal(boxes.scores, given.scores)
        assert len(result.status) == len(result.reasons) == len(result.num_points) == n
        assert result.covariances.shape == (n, 6, 6)
        assert set(result.status) == {'refined'}
        assert set(result.reasons) <= {''}
        assert np.abs(boxes.boxes - given.boxes).max() > 1e-3
        out = face_distances(torch.from_numpy(sweep.points), torch.from_numpy(given.boxes))
        np.testing.assert_array_equal(result.num_points, (out <= 0).all(-1).sum(-1))
    assert counts == {'sweeps': 14, 'boxes': 22, 'refined': 22}


@each_estimate
def test_early_estimates_are_returned_at_once(stream, estimate):
    registrar = BoxRegistrar(config_with(estimate))
    for sweep, boxes in stream:
        assert registrar.add_sweep(sweep) == []
        early = [r for r in registrar.add_boxes(boxes) if not r.is_final]
        assert [r.boxes.stamp_ns for r in early] == [boxes.stamp_ns][: estimate != 'track']
    assert all(r.is_final for r in registrar.flush())


@pytest.mark.parametrize('lag', [0, 1, 3, 5])
@pytest.mark.parametrize('estimate', ['early', 'final'])
def test_final_boxes_are_returned_lag_arrays_later(stream, estimate, lag):
    registrar = BoxRegistrar(config_with(estimate, lag=lag))
    order = [boxes.stamp_ns for _, boxes in stream]
    for tick, (sweep, boxes) in enumerate(stream):
        ready = finals(registrar.add_sweep(sweep) + registrar.add_boxes(boxes))
        known = order[tick - lag : tick - lag + 1] if tick >= lag else []
        assert [r.boxes.stamp_ns for r in ready] == known
    assert [r.boxes.stamp_ns for r in registrar.flush()] == order[len(order) - lag :]
    assert registrar.flush() == []


def test_final_boxes_are_more_accurate_than_early_boxes():
    # Later observations are evidence too.
    errors = []
    for seed in range(4):
        truth = drive(14)
        track = track_of(truth, np.random.default_rng(seed))
        results, _ = run(stream_of([track]), config_with('final'))
        boxes = [
            np.array([r.boxes.boxes[0] for r in results if r.is_final == is_final])
            for is_final in (False, True)
        ]
        errors.append([np.linalg.norm((b - truth)[:, :2], axis=1).mean() for b in boxes])
    early, final = np.mean(errors, axis=0)
    assert final < 0.9 * early


def test_boxes_of_long_tracks_are_returned_in_parts():
    # With windows of 12, a track is solved when it has 12; the newest is solved again later.
    stream = stream_of([track_of(drive(40), np.random.default_rng(0))])
    registrar = BoxRegistrar(config_with('track', track_window=12), latency=Latency())
    held = []
    results = []
    for i, pair in enumerate(stream):
        results += fed(registrar, [pair])
        held.append(i + 1 - len(results))
    assert max(held) <= 12
    results += registrar.flush()
    assert [r.boxes.stamp_ns for r in results] == [b.stamp_ns for _, b in stream]
    assert {s for r in results for s in r.status} == {'refined'}


@each_estimate
def test_boxes_may_be_added_before_their_sweeps(stream, estimate):
    known, counts = run(stream, config_with(estimate))
    registrar = BoxRegistrar(config_with(estimate))
    results = []
    for _, boxes in stream[:5]:
        results += registrar.add_boxes(boxes)
    assert results == []
    for sweep, _ in stream[:5]:
        results += registrar.add_sweep(sweep)
    for sweep, boxes in stream[5:]:
        results += registrar.add_boxes(boxes) + registrar.add_sweep(sweep)
    assert_equal(results + registrar.flush(), known)
    assert registrar.counts == counts


@each_estimate
def test_sweeps_may_be_added_long_before_their_boxes(stream, estimate):
    known, counts = run(stream, config_with(estimate))
    registrar = BoxRegistrar(config_with(estimate))
    for sweep, _ in stream:
        assert registrar.add_sweep(sweep) == []
    results = [result for _, boxes in stream for result in registrar.add_boxes(boxes)]
    assert_equal(results + registrar.flush(), known)
    assert registrar.counts == counts


@each_estimate
def test_deskew_compensates_points_measured_before_the_stamp(estimate):
    # A car at 10 m/s whose points are all 20 ms old: 0.2 m behind its boxes, which are of the
    # stamp. `deskew` moves the points there.
    truth = drive(14, speed=10.0, turn=0.0, start=(-8.0, 6.0, 0.0))
    errors = []
    for seed in range(6):
        late = [
            (replace(s, points=s.points - [0.2, 0, 0], times=np.full(len(s.points), -0.02)), b)
            for s, b in stream_of([track_of(truth, np.random.default_rng(seed))])
        ]
        for deskew in (False, True):
            changed = config_with(
                estimate, **{'sampling.deskew': deskew, 'sampling.box_time': 'stamp'}
            )
            results, _ = run(late, changed)
            boxes = np.array([r.boxes.boxes[0] for r in finals(results)])
            errors.append(np.abs((boxes - truth)[2:, 0]).mean())
    assert np.mean(errors[1::2]) < 0.5 * np.mean(errors[::2])


@each_estimate
@pytest.mark.parametrize('offset_ns', [-45_000_000, 45_000_000])
def test_points_are_motion_compensated_to_boxes_between_sweeps(estimate, offset_ns):
    # A car at 15 m/s moves 0.68 m in 45 ms. Its velocity is estimated from noisy boxes: errors
    # may grow by a twenty-fifth of that against equal stamps.
    truth = drive(16, speed=15.0, turn=0.2, start=(-10.0, 6.0, 0.0))
    there = np.array([[np.interp(t + offset_ns, stamps(16), x) for x in truth.T]
                      for t in stamps(16)])  # fmt: skip
    errors = []
    for seed in (2, 1, 0):
        exact = stream_of([track_of(truth, np.random.default_rng(seed))])
        moved = [
            (replace(s, stamp_ns=s.stamp_ns + offset_ns, points=s.points + here[:3] - box[:3]), b)
            for (s, b), here, box in zip(exact, there, truth, strict=True)
        ]
        for stream in (exact, moved):
            results, counts = run(stream[1:-1], config_with(estimate))
            boxes = np.array([r.boxes.boxes[0] for r in finals(results)])
            errors.append(np.linalg.norm((boxes - truth[1:-1])[3:, :2], axis=1).mean())
            assert counts['refined'] >= 13, counts
    # The order of sweep and boxes makes no difference.
    registrar = BoxRegistrar(config_with(estimate))
    swapped = [r for s, b in stream[1:-1] for r in registrar.add_boxes(b) + registrar.add_sweep(s)]
    assert_equal(swapped + registrar.flush(), results)
    exact, moved = np.mean(errors[::2]), np.mean(errors[1::2])
    assert moved < exact + 0.68 / 25, (exact, moved)


# --- determinism ---------------------------------------------------------------------------------


@each_estimate
def test_reset_discards_all_but_the_counts(stream, estimate):
    known, counts = run(stream, config_with(estimate))
    registrar = BoxRegistrar(config_with(estimate))
    fed(registrar, stream[:7])
    registrar.reset()
    assert registrar.counts['sweeps'] == 7
    registrar.counts.clear()
    assert_equal(fed(registrar, stream) + registrar.flush(), known)
    assert registrar.counts == counts


def test_final_boxes_leave_no_garbage(tracks, stream):
    # The commands and the node search for garbage rarely: what refers to itself would stay.
    config = config_with(window=4, lag=1)
    registrar = BoxRegistrar(config)
    gc.collect()
    gc.disable()
    try:
        fed(registrar, stream)
        pending = [one for one in gc.get_objects() if isinstance(one, PendingArray)]
    finally:
        gc.enable()
    assert len(pending) <= len(tracks) * config.window < len(stream)


@each_estimate
def test_input_is_not_written_to(stream, estimate):
    copies = [(sweep.points.copy(), boxes.boxes.copy()) for sweep, boxes in stream]
    results, _ = run(stream, config_with(estimate))
    for result in results:
        result.boxes.boxes[:] = np.nan  # returned arrays share no memory with the input
    for (sweep, boxes), (points, values) in zip(stream, copies, strict=True):
        np.testing.assert_array_equal(sweep.points, points)
        np.testing.assert_array_equal(boxes.boxes, values)


@pytest.mark.parametrize('estimate', ESTIMATES)
def test_refine_returns_the_same_boxes(tracks, stream, estimate):
    config = config_with(estimate)
    results, _ = run(stream, config)
    wanted = [r for r in results if r.is_final == (estimate != 'early')]
    for track, refined in zip(tracks, refine(tracks, config), strict=True):
        known = [
            r.boxes.boxes[r.boxes.track_ids.index(track.track_id)]
            for r in wanted
            if track.track_id in r.boxes.track_ids
        ]
        np.testing.assert_allclose(refined.boxes, known, rtol=0, atol=1e-9)


# --- reasons -------------------------------------------------------------------------------------


def named(*track_ids):
    return lambda boxes: replace(boxes, track_ids=track_ids)


def valued(column, value):
    """Return a function that sets one value of the first box."""

    def spoil(boxes):
        values = boxes.boxes.copy()
        values[0, column] = value
        return replace(boxes, boxes=values)

    return spoil


@each_estimate
@pytest.mark.parametrize(
    'spoil, reasons',
    [
        (named('', 'b'), ('no_track_id', '')),
        (named('a', 'a'), ('', 'duplicate_track_id')),
        (valued(1, np.nan), ('invalid_box', '')),
        (valued(8, np.inf), ('invalid_box', '')),
        (valued(4, 0.0), ('invalid_box', '')),
        (valued(3, -4.4), ('invalid_box', '')),
        (valued(3, 1e6), ('invalid_box', '')),
        (valued(1, 1e9), ('invalid_box', '')),
    ],
    ids=['no id', 'same id', 'nan', 'infinite', 'flat', 'negative', 'huge', 'far'],
)
def test_boxes_that_cannot_be_refined_are_returned_unchanged(stream, estimate, spoil, reasons):
    spoilt = list(stream)
    spoilt[5] = (stream[5][0], spoil(stream[5][1]))
    results, counts = run(spoilt, config_with(estimate))
    for result in (r for r in results if r.boxes.stamp_ns == spoilt[5][1].stamp_ns):
        assert tuple(r if r != 'short_track' else '' for r in result.reasons) == reasons
        row = next(i for i, reason in enumerate(reasons) if reason)
        assert result.status[row] == 'kept'
        np.testing.assert_array_equal(result.boxes.boxes[row], spoilt[5][1].boxes[row])
        assert np.isfinite(result.covariances).all()
    assert counts[next(filter(None, reasons))] == 1
    assert counts['kept'] == 1
    assert counts['kept'] + counts['refined'] == counts['boxes'] == 22
    # The other boxes of the track are refined.
    others = [r for r in finals(results) if r.boxes.stamp_ns != spoilt[5][1].stamp_ns]
    assert {s for r in others for s in r.status} == {'refined'}


@each_estimate
def test_boxes_without_a_sweep_are_returned_unchanged(stream, estimate):
    registrar = BoxRegistrar(config_with(estimate))
    results = []
    for i, (sweep, boxes) in enumerate(stream):
        if i != 5:
            results += registrar.add_sweep(sweep)
        results += registrar.add_boxes(boxes)
    results += registrar.flush()
    assert [r.boxes.stamp_ns for r in finals(results)] == [b.stamp_ns for _, b in stream]
    alone = finals(results)[5]
    assert alone.reasons == ('no_sweep', 'no_sweep')
    assert alone.status == ('kept', 'kept')
    np.testing.assert_array_equal(alone.boxes.boxes, stream[5][1].boxes)
    assert registrar.counts['boxes_without_sweep'] == 1
    assert registrar.counts['no_sweep'] == 2


def test_a_sweep_without_boxes_is_counted(stream):
    registrar = BoxRegistrar(config_with())
    for i, (sweep, boxes) in enumerate(stream):
        registrar.add_sweep(sweep)
        if i != 5:
            registrar.add_boxes(boxes)
    registrar.flush()
    assert registrar.counts['sweep_without_boxes'] == 1
    assert registrar.counts['sweeps'] == 14


@each_estimate
def test_an_empty_box_array_is_returned(stream, estimate):
    sweep, boxes = stream[5]
    empty = BoxArray(boxes.stamp_ns, 'odom', (), (), np.zeros(0), np.zeros((0, 9)))
    results, counts = run([*stream[:5], (sweep, empty), *stream[6:]], config_with(estimate))
    assert [r.boxes.stamp_ns for r in finals(results)] == [b.stamp_ns for _, b in stream]
    assert finals(results)[5].boxes.boxes.shape == (0, 9)
    assert counts['refined'] == 20


@each_estimate
def test_late_boxes_are_returned_unchanged(stream, estimate):
    # A box array that is added again after younger ones have been paired.
    results, counts = run([*stream[:6], stream[3], *stream[6:]], config_with(estimate))
    assert counts['late'] == 2
    late = [r for r in finals(results) if 'late' in r.reasons]
    assert len(late) == 1
    assert late[0].status == ('kept', 'kept')
    np.testing.assert_array_equal(late[0].boxes.boxes, stream[3][1].boxes)
    others = [r for r in finals(results) if r is not late[0]]
    assert [r.boxes.stamp_ns for r in others] == [b.stamp_ns for _, b in stream]
    assert {s for r in others for s in r.status} == {'refined'}


@each_estimate
def test_short_tracks_are_kept_and_boxes_without_points_refined(stream, estimate):
    # The second car is observed twice only; the first has no points at one stamp.
    sweep, _ = stream[7]
    nothing = Sweep(sweep.stamp_ns, 'odom', sweep.points[:0], None, sweep.origin)
    part = [(s, b if i < 4 else b.take([0])) for i, (s, b) in enumerate(stream)]
    part[7] = (nothing, part[7][1])
    results, counts = run(part, config_with(estimate))
    assert counts['short_track'] == 2
    assert [r.reasons for r in finals(results)][2:4] == [('', 'short_track')] * 2
    blind = finals(results)[7]
    assert blind.status == ('refined',)
    assert blind.num_points.tolist() == [0]
    assert counts['kept'] == 2
    assert counts['refined'] == 14


# --- end of tracks -------------------------------------------------------------------------------


@pytest.fixture
def no_extent_law(set_constants):
    """Turn off the population prior on extents, which is estimated from all tracks."""
    set_constants(slope_deviation=1e-9)


@each_estimate
def test_a_gap_longer_than_max_gap_starts_a_new_track(estimate, no_extent_law):
    # The same id after a gap of 0.9 s or 1.1 s. After the longer one the following boxes are
    # refined as those of a new track; the input model keeps its estimates.
    config = config_with(estimate, max_gap=1.0, **{'faces.learn': False})
    config = replace(config, ingredients=Ingredients(noise_estimation=False))
    track = track_of(drive(28), np.random.default_rng(0))
    whole = stream_of([track])
    for gap, is_new in ((8, False), (9, False), (10, True)):
        start = 8 + gap  # the array after the gap is gap + 1 periods after the last one before
        results, _ = run(whole[:8] + whole[start : start + 8], config)
        alone, _ = run(whole[start : start + 8], config)
        found, known = (
            next(r for r in rs if r.boxes.stamp_ns == whole[start][1].stamp_ns)
            for rs in (results, alone)
        )
        difference = np.abs(found.boxes.boxes - known.boxes.boxes).max()
        assert (difference < 1e-6) == is_new


@pytest.mark.parametrize('estimate', ['early', 'final'])
def test_boxes_that_a_pause_releases_are_those_that_later_arrays_release(estimate):
    # Live boxes are released while no others arrive; a recording goes on at once.
    whole = stream_of([track_of(drive(36), np.random.default_rng(0), 'a')])
    config = config_with(estimate, max_gap=1.0)
    known, _ = run(whole[:8] + whole[28:], config)
    registrar = BoxRegistrar(config)
    released = fed(registrar, whole[:8]) + registrar.flush()
    goes_on = fed(registrar, whole[28:]) + registrar.flush()
    assert_equal(finals(released + goes_on), finals(known))


@pytest.mark.parametrize('estimate', ['early', 'final'])
def test_a_new_track_of_a_known_id_has_no_prior(estimate, no_extent_law):
    # Eight boxes, a gap, then eight with the same id, in windows of six, without
    # the noise of the input. The boxes after the gap equal those of the second part alone.
    config = config_with(estimate, max_gap=1.0, **{'faces.learn': False})
    config = replace(config, ingredients=Ingredients(noise_estimation=False))
    whole = stream_of([track_of(drive(30), np.random.default_rng(0), 'a')])
    registrar = BoxRegistrar(config)
    fed(registrar, whole[:8])
    table, row = registrar._tracks['a'].prior
    assert table.marginalised_extents[row, 3] == 3  # of 8, five are still in the window
    results = fed(registrar, whole[22:23])
    assert registrar._tracks['a'].prior is None
    results += fed(registrar, whole[23:]) + registrar.flush()
    first = whole[22][1].stamp_ns
    known, _ = run(whole[22:], config)
    assert_equal([r for r in results if r.boxes.stamp_ns >= first], known)


@pytest.mark.parametrize('estimate', ['early', 'final'])
def test_a_window_that_fails_leaves_no_prior(estimate):
    # Stamps a nanosecond apart make the Hessian singular: boxes of these windows are kept. The
    # track goes on without a prior and is refined again.
    whole = stream_of([track_of(drive(24), np.random.default_rng(0), 'a')])
    with_tiny_steps = []
    for i, (sweep, boxes) in enumerate(whole):
        now_ns = boxes.stamp_ns if i < 8 else whole[8][1].stamp_ns + i
        now_ns = boxes.stamp_ns if i >= 16 else now_ns
        with_tiny_steps.append((replace(sweep, stamp_ns=now_ns), replace(boxes, stamp_ns=now_ns)))
    registrar = BoxRegistrar(config_with(estimate, reach=0.0))
    has_prior, status = [], []
    for pair in with_tiny_steps:
        early = [r for r in fed(registrar, [pair]) if not r.is_final]
        has_prior.append(registrar._tracks['a'].prior is not None)
        status += [(r.status[0], r.reasons[0]) for r in early]
    registrar.flush()
    failed = [i for i, (_, reason) in enumerate(status) if reason == 'not_finite']
    assert failed
    assert not any(has_prior[i] for i in failed)
    assert status[-1][0] == 'refined'
    assert has_prior[-1]


def test_tracks_are_solved_together_when_a_window_is_full(monkeypatch):
    # At stamp 12: the track whose window of 12 is full, the one that has ended, and the one with
    # 7 observations, more than half a window. An eighth of a window (one observation) is solved
    # again with the next one, and a settled one is kept as context: with these 2, both tracks
    # are full again 10 stamps later. The other 8 stamps and the same 2 are solved at the end.
    rng = np.random.default_rng(0)
    long, short, late = (
        cut(track_of(drive(30, start=(5.0, y, 0.2)), rng, name), part)
        for y, name, part in (
            (6.0, 'long', slice(30)), (-6.0, 'short', slice(4)), (20.0, 'late', slice(5, 30))
        )
    )  # fmt: skip
    calls = []

    def noted(windows, config, model):
        calls.append({w.track_id: len(w.observations) for w in windows})
        return estimate_windows(windows, config, model)

    monkeypatch.setattr('boxreg_ros.core.estimation.estimate_windows', noted)
    registrar = BoxRegistrar(config_with('track', track_window=12, max_gap=0.3))
    results = fed(registrar, stream_of([long, short, late])) + registrar.flush()
    assert calls == [
        {'short': 4, 'long': 12, 'late': 7},
        {'long': 12, 'late': 12},
        {'long': 10, 'late': 10},
    ]
    assert len(results) == 30


def test_live_windows_are_warm_after_the_first_one(monkeypatch):
    """Three observations make the first window; later ones start from its estimates."""
    asked = []

    def note(problem, config, model, inputs, is_warm, observe_margins):
        asked.append((problem.boxes.shape[1], is_warm))
        return solve(problem, config, model, inputs, is_warm, observe_margins)

    monkeypatch.setattr(estimation, 'solve', note)
    config = config_with()
    fed(BoxRegistrar(config), stream_of([track_of(drive(8), np.random.default_rng(0), 'a')]))
    assert asked == [(3, False), (4, True), (5, True), (6, True), (6, True), (6, True)]


# --- budget --------------------------------------------------------------------------------------


def fed_within(budget, tracks, **changes):
    """Return results and registrar of tracks that are solved within a budget of windows."""
    registrar = BoxRegistrar(config_with(**changes), budget=budget)
    results = fed(registrar, stream_of(tracks))
    return results + registrar.flush(), registrar


def test_an_ample_budget_changes_nothing(stream):
    known, _ = run(stream, config_with())
    registrar = BoxRegistrar(config_with(), budget=lambda _: 100)
    assert_equal(fed(registrar, stream) + registrar.flush(), known)


def test_tracks_beyond_the_budget_are_kept_and_solved_in_turn():
    rng = np.random.default_rng(0)
    cars = [track_of(drive(12, start=(5.0, 8.0 * i, 0.0)), rng, str(i)) for i in range(4)]
    results, _ = fed_within(lambda _: 2, cars)
    early = [result for result in results if not result.is_final]
    solved = [{i for i, word in enumerate(r.status) if word == 'refined'} for r in early[2:]]
    assert {len(one) for one in solved} == {2}  # one in turn, and the nearest of the others
    for i in range(len(solved) - 2):
        assert set.union(*solved[i : i + 3]) == {0, 1, 2, 3}
    for result in early[2:]:
        for i, word in enumerate(result.status):
            if word == 'kept':
                assert result.reasons[i] == 'budget'
                at = np.flatnonzero(cars[i].stamps_ns == result.boxes.stamp_ns)[0]
                np.testing.assert_array_equal(result.boxes.boxes[i], cars[i].boxes[at])


def test_final_boxes_are_refined_in_the_windows_of_later_ticks():
    rng = np.random.default_rng(0)
    truths = [drive(16, start=(5.0, 8.0 * i, 0.0)) for i in range(3)]
    cars = [track_of(truth, rng, str(i)) for i, truth in enumerate(truths)]
    overlap = {}
    for budget in (0, 1, 3):
        results, registrar = fed_within(lambda _, budget=budget: budget, cars)
        within = finals(results)[:-3]
        boxes = np.concatenate([result.boxes.boxes for result in within])
        truth = np.stack(truths, 1)[: len(within)].reshape(-1, 9)
        overlap[budget] = iou_3d(boxes, truth).mean()
    assert registrar.counts['budget'] == 0
    assert set(np.ravel([result.reasons for result in within[2:]])) == {''}
    gain = overlap[3] - overlap[0]
    assert gain > 0.02
    assert overlap[1] > overlap[0] + 0.7 * gain


def test_the_least_windows_refine_every_final_box():
    # A window of 10 has 8 new observations, behind the two of its prior. Where a car ends while it
    # waits, its last boxes are final before its end is known.
    rng = np.random.default_rng(0)
    cars = [track_of(drive(40, start=(5.0, 8.0 * i, 0.0)), rng, str(i)) for i in range(10)]
    cars[2:] = [cut(car, slice(20 + i)) for i, car in enumerate(cars[2:])]
    asked = []

    def least(needed):
        asked.append(needed)
        return needed

    results, _ = fed_within(least, cars, window=10, lag=9, max_gap=1.0)
    assert max(asked[10:]) <= 2 + 1  # of 10 windows, and that of the car that has ended
    within = finals(results)[2:-10]
    reasons = [reason for result in within for reason in result.reasons]
    assert len(reasons) > 200
    assert set(reasons) == {''}


def test_waiting_tracks_catch_up_before_their_boxes_are_final():
    rng = np.random.default_rng(0)
    cars = [track_of(drive(14, start=(5.0, 8.0 * i, 0.0)), rng, str(i)) for i in range(3)]
    registrar = BoxRegistrar(config_with(), budget=lambda _: 0)
    results = []
    for item in stream_of(cars):
        results += fed(registrar, [item])
        assert registrar.catch_up(2) == []
        assert registrar.num_waiting <= 1
        assert registrar.catch_up(2) == []
        assert registrar.num_waiting == 0
    early = [result for result in results if not result.is_final]
    assert {word for result in early for word in result.status} == {'kept'}
    assert {word for result in finals(results)[2:] for word in result.status} == {'refined'}
    assert registrar.counts['budget'] == 0


def test_early_boxes_of_the_nearest_and_of_those_that_approach_are_refined():
    # Six cars 8 m apart ahead of the sensor; a seventh, farther than half of them, comes nearer.
    rng = np.random.default_rng(0)
    cars = [track_of(drive(30, start=(10.0, 8.0 * i, 0.0)), rng, str(i)) for i in range(6)]
    truth = drive(30, start=(10.0, 0.0, 0.0))
    truth[:, 0] += 40.0 - 10.0 * 0.1 * np.arange(30)
    cars.append(track_of(truth, rng, 'oncoming'))
    asked = []

    def half(needed):
        asked.append(needed)
        return 4

    results, _ = fed_within(half, cars, window=10, lag=9)
    early = [result for result in results if not result.is_final][15:]
    share = np.mean([[word == 'refined' for word in r.status] for r in early], axis=0)
    assert max(asked) == 1  # of each tick, for the final boxes
    assert share[[0, 1]].min() > 0.9
    assert share[6] > 0.5
    assert share[[3, 4, 5]].max() < 0.5
    assert {word for r in finals(results)[2:-10] for word in r.status} == {'refined'}


def test_tracks_that_catch_up_do_not_take_the_windows_of_the_nearest():
    # Final boxes need 2 windows of 6 in each array, as many as it has; 4 are solved after it.
    rng = np.random.default_rng(0)
    cars = [track_of(drive(20, start=(5.0, 8.0 * i, 0.0)), rng, str(i)) for i in range(6)]
    asked = []

    def two(needed):
        asked.append(needed)
        return 2

    registrar = BoxRegistrar(config_with(window=10, lag=2), budget=two)
    results = []
    for item in stream_of(cars):
        ready = fed(registrar, [item])
        results += ready
        if ready:
            registrar.catch_up(4)
    early = [result for result in results if not result.is_final][5:]
    assert set(asked[5:]) == {0}
    assert {r.status for r in early} == {('refined',) * 2 + ('kept',) * 4}
    assert registrar.counts['budget'] == 0


def test_a_near_object_that_moves_away_keeps_its_early_boxes():
    rng = np.random.default_rng(0)
    cars = [track_of(drive(30, start=(20.0, 8.0 * i, 0.0)), rng, str(i)) for i in range(6)]
    truth = drive(30, start=(5.0, -3.0, 0.0))
    truth[:, 0] += 12.0 * 0.1 * np.arange(30)  # 24 m in two seconds
    cars.append(track_of(truth[:14], rng, 'leaving'))
    results, _ = fed_within(lambda _: 2, cars, window=10, lag=9)
    early = [result for result in results if not result.is_final][4:9]
    assert {r.status[6] for r in early} == {'refined'}


def test_ended_tracks_beyond_the_budget_release_their_boxes():
    # Without boxes of the second car the arrays that hold its last boxes must not wait for it.
    rng = np.random.default_rng(0)
    cars = [track_of(drive(20, start=(5.0, 8.0 * i, 0.0)), rng, str(i)) for i in range(2)]
    results, registrar = fed_within(lambda _: 1, [cars[0], cut(cars[1], slice(5))], max_gap=0.3)
    assert len(finals(results)) == 20
    assert not registrar._ended_tracks


def test_a_track_that_ends_does_not_hold_back_others():
    # With estimate 'track' a short track that has ended must not delay the boxes of others.
    rng = np.random.default_rng(0)
    short, long = track_of(drive(5), rng, 'short'), track_of(drive(60, speed=0, turn=0), rng, 'l')
    registrar = BoxRegistrar(config_with('track', track_window=12), latency=Latency())
    assert len(fed(registrar, stream_of([short, long]))) >= 60 - 12


@each_estimate
def test_memory_is_bounded(estimate):
    # A parked car, another one with a new id at every third stamp, and sweeps without boxes.
    rng = np.random.default_rng(0)
    parked = track_of(drive(20, speed=0, turn=0), rng)
    config = config_with(estimate, track_window=10, max_gap=0.3, **{'sampling.points': 16})
    registrar = BoxRegistrar(config, latency=Latency())
    returned, held = 0, []
    for i in range(60):
        now_ns = int(stamps(1)[0]) + i * PERIOD_NS
        points = parked.points[i % 20]
        boxes = np.array([parked.boxes[i % 20], parked.boxes[0] + np.eye(9)[1] * 10])
        array = BoxArray(now_ns, 'odom', ('p', f'v{i // 3}'), ('car',) * 2, np.ones(2), boxes)
        registrar.add_sweep(Sweep(now_ns - PERIOD_NS // 2, 'odom', points))
        results = registrar.add_sweep(Sweep(now_ns, 'odom', points)) + registrar.add_boxes(array)
        returned += len(finals(results))
        held.append(i + 1 - returned)
        entries = sum(len(t.entries) for t in registrar._tracks.values())
        entries += sum(len(t.entries) for t in registrar._ended_tracks)
        assert entries <= 2 * 10 + 3 * 5
        assert len(registrar._tracks) <= 4
    # Arrays are held for the lag, or for the window of 10.
    assert max(held) <= 15
    assert max(held[40:]) <= max(held[:40])


@each_estimate
def test_an_id_switch_starts_a_new_track(estimate):
    # Two cars 5 m apart swap their ids half-way. The boxes are on average as accurate as with new
    # ids.
    rng, early, late = np.random.default_rng(0), slice(12), slice(12, 24)
    truths = [drive(24, turn=0, start=(5.0, y, 0.0)) for y in (6.0, 11.0)]
    a, b = (track_of(truth, rng, name) for truth, name in zip(truths, 'ab', strict=True))

    def overlap(of_b, of_a):
        parts = [cut(a, early), cut(b, early)]
        parts += [replace(cut(b, late), track_id=of_b), replace(cut(a, late), track_id=of_a)]
        # The number of ids affects the input model.
        config = config_with(estimate, **{'faces.learn': False})
        results, counts = run(stream_of(parts), config)
        order = [('a', 'b'), (of_b, of_a)], [(0, 1), (1, 0)]
        found = []
        for i, result in enumerate(finals(results)):
            assert result.boxes.track_ids == order[0][i // 12]
            where = [truths[k][i] for k in order[1][i // 12]]
            found.append(iou_3d(result.boxes.boxes, where))
        assert counts['boxes'] == 48
        return np.array(found)

    new, swapped = overlap('c', 'd'), overlap('a', 'b')
    assert swapped.mean() > new.mean() - 0.01


@pytest.mark.parametrize(('kind', 'y', 'size'), [('car', 13, 1), ('pedestrian', 7, 0.4)])
def test_an_id_that_is_given_to_another_object_after_a_pause_starts_a_new_track(kind, y, size):
    # A car, and after 1 s a car 7 m beside it, or a pedestrian 1 m beside it: the boxes are on
    # average as accurate as with an id of its own.
    rng = np.random.default_rng(0)
    first, second = (drive(34, turn=0, start=(5.0, place, 0.0)) for place in (6.0, y))
    second[:, 3:6] *= size
    a = cut(track_of(first, rng, 'a'), slice(12))
    b = replace(cut(track_of(second, rng, 'b'), slice(22, 34)), class_name=kind)
    truth = np.concatenate([first[:12], second[22:]])

    def overlap(name):
        stream = stream_of([a, replace(b, track_id=name)])
        results = finals(run(stream, config_with('final', **{'faces.learn': False}))[0])
        return iou_3d(np.concatenate([result.boxes.boxes for result in results]), truth)

    assert overlap('a').mean() > overlap('b').mean() - 0.01


def test_torch_uses_one_thread_while_registering(stream, monkeypatch):
    threads, before = [], torch.get_num_threads()

    def noted(*args):
        threads.append(torch.get_num_threads())
        return stack_windows(*args)

    monkeypatch.setattr('boxreg_ros.core.estimation.stack_windows', noted)
    torch.set_num_threads(2)
    try:
        run(stream, config_with())
        assert ({*threads}, torch.get_num_threads()) == ({1}, 2)
    finally:
        torch.set_num_threads(before)
