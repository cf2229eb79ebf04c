"""Objects that the registrar follows from one box each, which no detector has."""

from boxreg_ros import Config
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.errors import ConfigError
from boxreg_ros.structures import BoxArray, COASTED, Sweep
import numpy as np
import pytest
from scenes import drive, returns, stamps, START_NS

STEPS = 30
PERIOD_NS = 10**8
CONFIG = Config().updated({'estimate': 'final', 'window': 6, 'lag': 3, 'sampling.points': 64})


def array(step, boxes):
    ids = tuple(boxes)
    rows = np.array(list(boxes.values())).reshape(-1, 9)
    stamp_ns = START_NS + step * PERIOD_NS
    return BoxArray(stamp_ns, 'odom', ids, ('car',) * len(ids), np.ones(len(ids)), rows)


def run(truth, seeds, detected=lambda step: {}, gone=(), parked=None):
    """
    Return the final boxes (id, step) -> box that the registrar adds, and the registrar.

    Parameters
    ----------
    truth : array, shape (n, 9)
        True boxes of an object.
    seeds : dict
        Arrays to follow, by the step before which they arrive.
    detected : callable
        Boxes of the detector at a step, by id.
    gone : sequence of int
        Steps without points of the object.
    parked : array, shape (9,), optional
        Box of another object, with points at every step.

    """
    rng = np.random.default_rng(0)
    registrar = BoxRegistrar(CONFIG)
    results = []
    for step, stamp_ns in enumerate(stamps(STEPS).tolist()):
        road = np.column_stack([rng.uniform(-20, 40, (3000, 2)), rng.normal(0, 0.01, 3000)])
        clouds = [road] if step in gone else [road, returns(truth[step], rng)]
        if parked is not None:
            clouds.append(returns(parked, rng))
        origin = np.array([0.0, 0.0, 1.5])
        if step in seeds:
            registrar.follow(seeds[step])
        sweep = Sweep(stamp_ns, 'odom', np.concatenate(clouds), None, origin)
        results += registrar.add_sweep(sweep)
        results += registrar.add_boxes(array(step, detected(step)))
    results += registrar.flush()
    return {
        (result.boxes.track_ids[i], (result.boxes.stamp_ns - START_NS) // PERIOD_NS): box
        for result in results
        if result.is_final
        for i, box in enumerate(result.boxes.boxes)
        if result.status[i] == COASTED
    }, registrar


def test_one_box_starts_a_track_at_every_later_stamp():
    truth = drive(STEPS, speed=8.0, turn=0.3)
    late = {8: array(4, {'a': truth[4]})}  # 0.4 s on the way
    found, registrar = run(truth, late)
    assert list(found) == [('a', step) for step in range(8, STEPS)]
    boxes = np.array(list(found.values()))
    assert iou_3d(boxes, truth[8:]).min() > 0.75
    assert registrar.followed.track_ids == ('a',)
    assert not registrar.followed.lost and not registrar.followed.refused


def test_an_object_that_is_lost_gets_no_box_and_is_named():
    truth = drive(STEPS, speed=6.0, turn=0.0)
    hidden = range(8, 12)
    found, registrar = run(truth, {2: array(2, {'a': truth[2]})}, gone=hidden)
    assert [step for _, step in found] == [*range(2, 8), *range(12, STEPS)]
    _, registrar = run(truth, {2: array(2, {'a': truth[2]})}, gone=range(7, STEPS))
    [lost] = registrar.followed.lost
    assert (lost.track_id, lost.reason) == ('a', 'few_points')
    assert lost.stamp_ns == stamps(STEPS)[6]
    assert np.abs(lost.box - truth[6]).max() < 0.2
    assert not registrar.followed.track_ids


def test_a_detector_that_has_the_object_goes_before():
    truth = drive(STEPS, speed=4.0, turn=0.0)
    seeds = {2: array(2, {'a': truth[2]})}

    def detected(step):
        if 10 <= step < 15:
            return {'a': truth[step]}
        return {'other': truth[step]} if 20 <= step < 25 else {}

    found, _ = run(truth, seeds, detected)
    assert [step for _, step in found] == [*range(2, 10), *range(15, 20), *range(25, STEPS)]


def test_boxes_that_cannot_be_followed_are_named_and_the_rest_is_done():
    truth = drive(STEPS)
    bad = {
        4: array(4, {'': truth[4], 'road': truth[4] + np.array([0, 15.0, *[0] * 7])}),
        6: array(6, {'nan': np.full(9, np.nan)}),
        8: array(-50, {'old': truth[0]}),
        9: array(9, {'a': truth[9]}),
        10: array(900, {'ahead': truth[0]}),
    }
    found, registrar = run(truth, bad)
    assert [step for _, step in found] == list(range(9, STEPS))
    lines = dict(registrar.followed.refused)
    assert len(registrar.followed.refused) == 5
    assert 'expected a track id' in lines['']
    assert 'expected 5 points in it, got 0' in lines['road']
    assert 'finite' in lines['nan']
    assert 'the nearest is 5.00 s away' in lines['old']
    assert 'the nearest is' in lines['ahead']


def test_of_two_ids_of_one_object_the_second_is_named():
    truth = drive(STEPS)
    seeds = {2: array(2, {'a': truth[2]}), 5: array(5, {'b': truth[5] + [0.1, *[0.0] * 8]})}
    found, registrar = run(truth, seeds)
    assert list(found) == [('a', step) for step in range(2, STEPS)]
    assert registrar.followed.track_ids == ('a',)
    assert registrar.followed.refused == [('b', "its object is followed as 'a'")]


def test_an_object_that_drifts_does_not_end_one_that_is_seen_all_the_time():
    truth = drive(STEPS, speed=8.0, turn=0.0)
    parked = truth[16]
    seeds = {2: array(2, {'drifting': truth[2], 'parked': parked})}
    found, registrar = run(truth, seeds, gone=range(9, STEPS), parked=parked)
    assert [step for name, step in found if name == 'parked'] == list(range(2, STEPS))
    assert registrar.followed.track_ids == ('parked',)


def test_whole_tracks_refuse_objects_to_follow_in_a_stream():
    registrar = BoxRegistrar(CONFIG.updated({'estimate': 'track'}))
    with pytest.raises(ConfigError, match="expected 'early' or 'final'"):
        registrar.follow(array(0, {'1': np.array([0.0, 0, 0, 4, 2, 1.5, 0, 0, 0])}))
