"""Tracks that changed places: found where they did, and only there."""

from boxreg_ros.config import Config
from boxreg_ros.core.id_switches import by_id, id_switches, Switch
from boxreg_ros.structures import BoxArray, kept
from boxreg_ros.tracks.complete import complete
import numpy as np
from scenes import drive, jittered, START_NS


def arrays_of(switch=None):
    """Return arrays of two cars that meet, noisy, and their ids exchanged at a switch."""
    rng = np.random.default_rng(0)
    first = jittered(drive(30, speed=8.0, turn=0.0, start=(-12.0, 0.0, 0.0)), rng)
    second = jittered(drive(30, speed=8.0, turn=0.0, start=(12.0, 3.2, np.pi)), rng)
    arrays = []
    for row, boxes in enumerate(zip(first, second, strict=True)):
        stamp = START_NS + row * 10**8
        names = ('a', 'b')
        if switch is not None:
            names = tuple(switch.exchanged(name, stamp) for name in names)
        arrays.append(BoxArray(stamp, 'odom', names, ('car', 'car'), np.ones(2), np.array(boxes)))
    return arrays


def found_in(arrays):
    names = [name for array in arrays for name in array.track_ids]
    stamps = np.repeat([array.stamp_ns for array in arrays], 2)
    centers = np.concatenate([array.boxes[:, :2] for array in arrays])
    return id_switches(by_id(names, stamps, centers))


def test_tracks_that_change_places_are_found_and_changed_back():
    assert found_in(arrays_of()) == []
    switch = Switch(START_NS + 15 * 10**8, 'a', 'b')
    arrays = arrays_of(switch)
    (found,) = found_in(arrays)
    assert abs(found.stamp_ns - switch.stamp_ns) <= 10**8
    config = Config().updated({'complete.stitch': True})
    results = [kept(array, '') for array in arrays]
    plan = complete(arrays, results, [np.full(2, 50)] * 30, 'odom', config)
    right = [array.track_ids for array in plan.arrays]
    own = [list(array.track_ids) for array in arrays_of()]
    assert sum(names == should for names, should in zip(right, own, strict=True)) >= 29
    alone = config.updated({'complete.stitch': False, 'complete.fill': True})
    plan = complete(arrays, results, [np.full(2, 50)] * 30, 'odom', alone)
    assert plan.arrays[-1].track_ids != ['a', 'b']
