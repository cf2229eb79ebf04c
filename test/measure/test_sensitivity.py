"""The sensitivity measurement: numbers are found, changed for one run, and restored."""

from boxreg_ros.config import Config
from boxreg_ros.core.method import constants
from boxreg_ros.simulation.simulate import simulate
from measure.drives import Drive
from measure.sensitivity import (
    changed_constant,
    kinds_of,
    losses,
    measure,
    Measurement,
    Variation,
    variations_of_constants,
    variations_of_settings,
)
import pytest

TRACK = Measurement(Config(estimate='track'), 'track', 50, ['car', 'van', 'truck'])


@pytest.fixture(scope='module')
def drive():
    return Drive.from_scene(simulate('street', seed=3, sweeps=14))


def test_constants_are_those_that_are_no_settings():
    found = variations_of_constants()
    values = {(item.name, item.factor): item.value for item in found}
    assert values['max_depth', 2.0] == 2 * constants.CONSTANTS.max_depth
    assert values['cells[0]', 0.5] == constants.CONSTANTS.cells[0] // 2
    names = {item.name for item in found}
    assert len(names) > 30
    assert {'outermost', 'face_outlier', 'face_deviations[5]'} < names
    assert names.isdisjoint({'face_deviations[0]', 'is_robust'})


def test_settings_stay_within_their_bounds():
    found = variations_of_settings(Config(), ['vehicle'])
    names = {item.name for item in found}
    assert {'vehicle.position', 'faces.ends', 'window'} <= names
    assert not [name for name in names if name.startswith(('paper.', 'cyclist.'))]
    assert 'faces.learn' not in names  # a switch
    assert 'vehicle.gap_bottom' not in names  # 0 times anything is 0
    for item in found:
        assert item.value != item.default
        assert type(item.value) is type(item.default)
        Config().updated({item.name: item.value})  # raises if out of bounds


def test_kinds_are_those_of_the_boxes(drive):
    assert kinds_of(drive.boxes, Config())[0] == 'vehicle'
    assert set(kinds_of(drive.boxes, Config())) == {'vehicle', 'cyclist'}


def test_a_changed_constant_holds_within_the_context_only(drive):
    before, baseline = constants.CONSTANTS, measure(drive, TRACK, None)
    assert 0.6 < baseline.iou_3d < 1
    with changed_constant(('cells', 1), 7), pytest.raises(RuntimeError):
        assert constants.CONSTANTS.cells == (before.cells[0], 7, before.cells[2])
        raise RuntimeError
    assert constants.CONSTANTS is before
    depth = next(item for item in variations_of_constants() if item.name == 'max_depth')
    outcome = measure(drive, TRACK, depth)
    assert not outcome.failure
    assert abs(outcome.iou_3d - baseline.iou_3d) > 1e-4
    assert measure(drive, TRACK, None) == baseline


def test_losses_are_sorted_and_exact(drive):
    baseline = measure(drive, TRACK, None)
    unread = Variation('queue', 2.0, 20, 40)  # no box waits for its sweep in this scene
    harmful = Variation('vehicle.position', 0.02, 0.14, 0.003)  # input taken for almost exact
    failing = Variation('vehicle.position', 1e-9, 0.14, 1e-10)  # out of bounds
    variations = [unread, harmful, failing]
    outcomes = [[measure(drive, TRACK, item)] for item in variations]
    found = losses(variations, {'street': baseline}, outcomes)
    assert [loss.value for loss in found] == [1e-10, 0.003, 40]
    assert found[0].failure.startswith('ConfigError: vehicle.position')
    assert found[1].volume > 0.005
    assert found[1].volume == pytest.approx(baseline.iou_3d - outcomes[1][0].iou_3d)
    assert found[2].volume == found[2].bev == 0
