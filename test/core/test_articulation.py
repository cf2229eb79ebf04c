"""Bodies that do not keep their shape: noticed by their input, and left as they are."""

from dataclasses import replace

from boxreg_ros.config import Config
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.core.method.articulation import changes_shape, extent_ranges
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.core.problem import NO_RANGE
from boxreg_ros.reasons import Reason
from boxreg_ros.simulation.simulate import simulate
from measure.drives import Drive
import numpy as np
import pytest
from scenes import drive, solved, track_of, window_of

LIVE = Config().updated({'estimate': 'final'})
DEVIATION, GATE = 0.05, 3.0


def boxes_with(extents):
    """Return boxes (n, 9) of these extents (n, 3)."""
    extents = np.asarray(extents, float)
    return np.hstack([np.zeros_like(extents), extents, np.zeros_like(extents)])


def ranges_of(extents, past=NO_RANGE, length=None):
    """Return the range of these extents (n, 3), of which the first ones are no padding."""
    ranges = past.copy()
    extent_ranges(boxes_with(extents), length or len(extents), 10, ranges)
    return ranges


def is_flexible(extents):
    return changes_shape(ranges_of(extents), DEVIATION, GATE)


def test_ranges_are_those_of_medians():
    rng = np.random.default_rng(0)
    extents = [12, 2.5, 3.5] * np.exp(rng.normal(0, 0.1, (40, 3)))
    found = ranges_of(extents, length=35)  # the last five are padding
    medians = np.array([np.median(np.log(extents[i : i + 10]), axis=0) for i in range(26)])
    np.testing.assert_allclose(found, [medians.min(0), medians.max(0)])
    longer = ranges_of(extents, np.array([[2.0, 2.0, 2.0], [3.0, 0.0, 3.0]]), length=35)
    np.testing.assert_array_equal(
        longer, [np.minimum(found[0], 2), np.maximum(found[1], [3, 0, 3])]
    )
    short = ranges_of(extents[:9])
    np.testing.assert_array_equal(short, NO_RANGE)
    assert not changes_shape(short, DEVIATION, GATE)


def test_only_a_width_that_changes_alone_is_a_bend():
    rng = np.random.default_rng(1)
    truck = [12, 2.5, 3.5] * np.exp(rng.normal(0, 0.01, (60, 3)))
    turning = truck.copy()
    turning[30:, 1] += 0.9
    assert is_flexible(turning)
    assert not is_flexible(truck)
    assert not is_flexible([12, 2.5, 3.5] * np.exp(rng.normal(0, 0.2, (60, 3)))), 'noise'
    swapped = truck.copy()
    swapped[40:, :2] = swapped[40:, 1::-1]
    assert not is_flexible(swapped), 'quarter turns'
    outliers = truck.copy()
    outliers[30:34, 1] = 6.0
    assert not is_flexible(outliers), 'gross errors'
    nearer = truck.copy()
    nearer[:20, :2] *= 0.5
    assert not is_flexible(nearer), 'clusters that grow'


def test_a_body_once_seen_to_bend_is_kept_by_later_windows():
    """Each window has constant extents; the range of the windows before it shows the change."""
    track = track_of(drive(40), np.random.default_rng(0))
    boxes = track.boxes.copy()
    boxes[15:, 4] += 1.0
    whole = window_of(replace(track, boxes=boxes), LIVE)
    prior, start, reasons = None, np.zeros((0, 9)), []
    for first in range(31):
        one = whole._replace(
            observations=whole.observations[first : first + 10], num_new=10 - len(start),
            start=start, prior=prior,
        )  # fmt: skip
        (found,) = solved([one], LIVE, InputModel(LIVE.faces))
        prior, start = found.prior, found.boxes[1:]
        reasons.append(set(found.reasons))
    assert reasons[:5] == [{''}] * 5
    assert reasons[-10:] == [{Reason.NOT_RIGID}] * 10


@pytest.fixture(scope='module')
def scenes():
    """Return drives with one box around tractor and trailer, and with two."""
    return [simulate(name, seed=0, sweeps=30) for name in ('articulated', 'articulated-parts')]


@pytest.mark.parametrize('estimate', ['track', 'final'])
def test_articulated_trucks_in_one_box_get_no_worse(scenes, estimate):
    joined, parts = scenes
    config = Config(estimate=estimate)
    trucks = {actor.track_id for actor in joined.actors if actor.class_name == 'truck'}
    given, found = gains(Drive.from_scene(joined), config)
    changes = {name: np.mean(found[name]) - np.mean(given[name]) for name in given}
    assert min(changes[name] for name in trucks & changes.keys()) > -0.003
    assert min(changes[name] for name in changes.keys() - trucks) > 0
    for results in Drive.from_scene(parts).refined(config).values():
        assert not any(Reason.NOT_RIGID in result.reasons for result in results)


def gains(drive, config):
    """Return 3D IoU of the input and the refined boxes of each track, at boxes of 100 points."""
    truth = {
        (stamp, name): box
        for stamp, name, box, count in zip(
            drive.truth.stamps_ns, drive.truth.track_ids, drive.truth.boxes,
            drive.truth.num_points, strict=True,
        )
        if count >= 100
    }  # fmt: skip
    results = drive.refined(config)[config.estimate]
    sides = []
    for arrays in (drive.boxes, [result.boxes for result in results]):
        ious = {}
        for array in arrays:
            for name, box in zip(array.track_ids, array.boxes, strict=True):
                if (array.stamp_ns, name) in truth:
                    true = truth[array.stamp_ns, name]
                    ious.setdefault(name, []).append(iou_3d(box[None], true[None])[0])
        sides.append(ious)
    return sides
