"""Velocities and accelerations of boxes: against true ones, their covariances, their limits."""

from boxreg_ros.config import Config
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.structures import KEPT, REFINED
import numpy as np
import pytest
from scenes import cut, drive, fed, stream_of, track_of

PERIOD = 0.1


def braking(n=40, speed=10.0, brake=3.0, start=1.0):
    """Return true boxes of a car that brakes."""
    boxes = drive(n, speed=0.0, turn=0.0, start=(-20.0, 6.0, 0.2))
    t = np.arange(n) * PERIOD
    speeds = np.clip(speed - brake * np.clip(t - start, 0, None), 0, None)
    path = np.concatenate([[0.0], np.cumsum((speeds[1:] + speeds[:-1]) / 2) * PERIOD])
    boxes[:, :2] += path[:, None] * [[np.cos(0.2), np.sin(0.2)]]
    return boxes


def turning():
    return drive(30, speed=6.0, turn=0.4)


def parked():
    return drive(30, speed=0.0, turn=0.0)


def rates_of(boxes):
    """Return the rates (n, 3) of x y yaw by central differences."""
    places = boxes[:, [0, 1, 8]].copy()
    places[:, 2] = np.unwrap(places[:, 2])
    return np.gradient(places, PERIOD, axis=0)


def results_of(track, estimate):
    """Return the results of a track by stamp, as early and as last estimates."""
    registrar = BoxRegistrar(Config(estimate=estimate))
    results = [*fed(registrar, stream_of([track])), *registrar.flush()]
    return [
        {r.boxes.stamp_ns: r for r in results if r.is_final is is_final}
        for is_final in (False, True)
    ]


def errors_of(results, truth, track, name='velocity'):
    """Return the errors (m, 2) of x y of refined boxes, and their covariances (m, 2, 2)."""
    rates = rates_of(truth)
    if name == 'acceleration':
        rates = np.gradient(rates, PERIOD, axis=0)
    errors, covariances = [], []
    for row, stamp_ns in enumerate(track.stamps_ns.tolist()):
        found = results.get(stamp_ns)
        if found is None or not found.boxes.kinematics[f'has_{name}'][0]:
            continue
        assert found.status[0] == REFINED
        errors.append(found.boxes.kinematics[name][0, :2] - rates[row, :2])
        covariances.append(found.boxes.kinematics[f'{name}_covariance'][0, :2, :2])
    return np.array(errors), np.array(covariances)


@pytest.mark.parametrize('motion', [turning, braking, parked])
@pytest.mark.parametrize(('estimate', 'part'), [('final', 0.5), ('track', 0.25)])
def test_velocities_err_by_a_part_of_those_of_the_input(motion, estimate, part):
    """Those of early boxes lag behind a car that brakes, by about what the input errs."""
    truth = motion()
    of_input, of_early, of_last = [], [], []
    for seed in range(4):
        track = track_of(truth, np.random.default_rng(seed))
        early, last = results_of(track, estimate)
        rates = (track.boxes[3:, :2] - track.boxes[:-3, :2]) / (3 * PERIOD)
        of_input += np.linalg.norm(rates - rates_of(truth)[3:, :2], axis=1).tolist()
        of_last += np.linalg.norm(errors_of(last, truth, track)[0], axis=1).tolist()
        if estimate == 'final':
            of_early += np.linalg.norm(errors_of(early, truth, track)[0], axis=1).tolist()
    assert np.mean(of_last) < part * np.mean(of_input)
    if of_early:
        assert len(of_early) > 0.8 * len(of_input)
        assert np.mean(of_early) < (1.05 if motion is braking else 0.5) * np.mean(of_input)


@pytest.mark.parametrize('motion', [turning, parked])
def test_errors_of_velocities_are_within_their_covariances(motion):
    truth = motion()
    within = ([], [])
    for seed in range(4):
        track = track_of(truth, np.random.default_rng(seed))
        for results, found in zip(results_of(track, 'final'), within, strict=True):
            errors, covariances = errors_of(results, truth, track)
            squared = np.einsum('ni,nij,nj->n', errors, np.linalg.inv(covariances), errors)
            found += (squared < 6.0).tolist()  # 95 % of chi squared of two
    assert min(map(np.mean, within)) > 0.9


def test_acceleration_of_a_braking_car_is_known_once_later_boxes_are():
    truth = braking()
    track = track_of(truth, np.random.default_rng(0))
    early, last = results_of(track, 'final')
    newest = [r.boxes.kinematics['has_acceleration'].any() for r in early.values()]
    assert not any(newest)
    errors, _ = errors_of(last, truth, track, 'acceleration')
    assert len(errors) > 20
    assert np.sqrt(np.square(errors).mean()) < 1.0  # of 3 m/s^2


def test_velocities_of_early_boxes_do_not_know_what_follows():
    track = track_of(turning(), np.random.default_rng(0))
    early, _ = results_of(track, 'final')
    of_part, _ = results_of(cut(track, slice(0, 15)), 'final')
    assert len(of_part) == 15
    for stamp_ns, found in of_part.items():
        expected = early[stamp_ns].boxes.kinematics
        for name in expected.dtype.names:
            np.testing.assert_array_equal(found.boxes.kinematics[name], expected[name])


@pytest.mark.parametrize(('objective', 'n'), [('default', 12), ('paper', 4)])
def test_velocities_are_finite_and_unknown_for_kept_boxes(objective, n):
    names = {'default': {}, 'paper': {'objective': 'paper'}}[objective]
    track = cut(track_of(turning(), np.random.default_rng(0)), slice(0, n))
    registrar = BoxRegistrar(Config(estimate='final', **names))
    results = [*fed(registrar, stream_of([track])), *registrar.flush()]
    for result in results:
        for name in result.boxes.kinematics.dtype.names:
            assert np.isfinite(result.boxes.kinematics[name]).all()
        is_known = result.boxes.kinematics['has_velocity']
        if objective == 'paper':
            assert not is_known.any()
        else:
            assert is_known.tolist() == [status != KEPT for status in result.status]
