"""A track that misses a detection goes on with its predicted box while its points confirm it."""

from dataclasses import replace

from boxreg_ros import Config
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.structures import BoxArray, COASTED, Sweep
import numpy as np
import pytest
from scenes import drive, jittered, returns, stamps

STEPS = 24
MISSED = range(12, 16)
CLUTTER = np.array([30.0, 0.0, 0.75])
each_estimate = pytest.mark.parametrize('estimate', ['early', 'final'])


def config_with(estimate='final', coast=1.0, **changes):
    # Few points, for speed.
    base = {'estimate': estimate, 'coast': coast, 'window': 6, 'lag': 3, 'sampling.points': 64}
    return Config().updated({**base, **changes})


@pytest.fixture(scope='module')
def truth():
    """Return a car that turns, and one that is parked, by id."""
    return {
        'a': drive(STEPS, speed=8.0),
        'b': drive(STEPS, speed=0.0, turn=0.0, start=(-12.0, -6.0, 3.0)),
    }


def run(truth, config, missed, gone=lambda track_id, step: False, extra=None):
    """
    Return the results of a drive, and the counts.

    Parameters
    ----------
    truth : dict
        Boxes (n, 9) by id.
    config : Config
        Settings.
    missed : callable
        Whether the detector misses a track at a step.
    gone : callable
        Whether an object returns no points at a step.
    extra : callable, optional
        Further (id, box) at a step.

    """
    rng = np.random.default_rng(0)
    noisy = {name: jittered(boxes, rng) for name, boxes in truth.items()}
    registrar = BoxRegistrar(config)
    results = []
    for step, stamp_ns in enumerate(stamps(STEPS).tolist()):
        clouds = [returns(boxes[step], rng) for name, boxes in truth.items()
                  if not gone(name, step)]  # fmt: skip
        sweep = Sweep(stamp_ns, 'odom', np.concatenate([np.zeros((1, 3)), *clouds]), None,
                      np.array([0.0, 0.0, 1.5]))  # fmt: skip
        here = [(name, noisy[name][step]) for name in truth if not missed(name, step)]
        here += extra(step) if extra else []
        ids = tuple(name for name, _ in here)
        boxes = np.array([box for _, box in here]).reshape(-1, 9)
        results += registrar.add_sweep(sweep)
        given = BoxArray(stamp_ns, 'odom', ids, ('car',) * len(ids), np.ones(len(ids)), boxes)
        words = tuple({'name': name} for name in ids)
        results += registrar.add_boxes(replace(given, attributes=words))
    return results + registrar.flush(), registrar.counts


def coasted(results, is_final):
    """Return (id, step) -> box of the coasted boxes, the early or the final ones."""
    first_ns = stamps(1)[0]
    return {
        (result.boxes.track_ids[i], int(result.boxes.stamp_ns - first_ns) // 10**8): box
        for result in results
        if result.is_final == is_final
        for i, box in enumerate(result.boxes.boxes)
        if result.status[i] == COASTED
    }


def misses_a(name, step):
    return name == 'a' and step in MISSED


@each_estimate
def test_missed_boxes_are_added_at_once_and_lie_on_the_object(truth, estimate):
    results, counts = run(truth, config_with(estimate), misses_a)
    for is_final in (False, True):
        found = coasted(results, is_final)
        assert set(found) == {('a', step) for step in MISSED}
        iou = iou_3d(
            np.array(list(found.values())), np.array([truth['a'][step] for _, step in found])
        )
        assert iou.min() > 0.8
    assert counts['coasted'] == len(MISSED)
    assert counts['coast_unconfirmed'] == 0
    for result in results:
        n = result.status.count(COASTED)
        assert result.status[len(result.status) - n :] == (COASTED,) * n, 'behind the given boxes'
        assert result.boxes.scores.tolist() == [1.0] * (len(result.status) - n) + [0.0] * n
        words = [result.boxes.attributes_of(row).get('name') for row in range(len(result.status))]
        assert words == [*result.boxes.track_ids[: len(words) - n], *[None] * n]


def test_without_the_setting_no_box_is_added_and_others_do_not_change(truth):
    without, _ = run(truth, config_with(coast=0.0), misses_a)
    assert not coasted(without, True)
    parked_only, _ = run({'b': truth['b']}, config_with(), lambda name, step: False)
    off, _ = run({'b': truth['b']}, config_with(coast=0.0), lambda name, step: False)
    for a, b in zip(parked_only, off, strict=True):
        np.testing.assert_array_equal(a.boxes.boxes, b.boxes.boxes)


@pytest.mark.parametrize('names', ['a', 'ab'])
def test_a_box_without_confirming_points_is_not_added(truth, names):
    def is_missed(name, step):
        return name in names and step in MISSED

    results, counts = run(truth, config_with(), is_missed, gone=is_missed)
    assert not coasted(results, True)
    assert not coasted(results, False)
    assert counts['coast_unconfirmed'] == len(names) * len(MISSED)


def test_a_track_coasts_no_longer_than_the_setting(truth):
    results, _ = run(truth, config_with(coast=0.5), lambda name, step: name == 'b' and step >= 10)
    assert set(coasted(results, True)) == {('b', step) for step in range(10, 15)}


def test_a_detection_restarts_the_time(truth):
    missed = [*range(10, 13), *range(14, 17)]
    results, _ = run(truth, config_with(coast=0.3), lambda name, step: step in missed)
    assert set(coasted(results, True)) == {(name, step) for name in 'ab' for step in missed}


@pytest.mark.parametrize('steps', [range(8, 10), range(8, 13)], ids=['short', 'without points'])
def test_a_ghost_does_not_coast(truth, steps):
    box = np.array([*CLUTTER, 4.4, 1.8, 1.5, 0, 0, 0])
    results, _ = run(
        truth,
        config_with(),
        lambda name, step: False,
        extra=lambda step: [('ghost', box)] if step in steps else [],
    )
    assert not coasted(results, True)


def test_a_track_does_not_coast_where_its_object_has_another_id(truth):
    rng = np.random.default_rng(1)
    results, _ = run(
        truth,
        config_with(),
        lambda name, step: name == 'a' and step >= 12,
        extra=lambda step: [('new', jittered(truth['a'][[step]], rng)[0])] if step >= 12 else [],
    )
    assert not coasted(results, True)


def test_the_whole_track_is_left_to_the_steps_of_complete(truth):
    for changes in ({'estimate': 'track'}, {'complete.fill': True}):
        results, _ = run(truth, config_with(**changes), misses_a)
        assert not coasted(results, True)
