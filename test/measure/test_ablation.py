"""`measure ablation`: every ingredient that is switched off changes the boxes."""

from dataclasses import fields
import json

from boxreg_ros.config import Ingredients, settings
from boxreg_ros.simulation.simulate import simulate
from measure import main
from measure.ablation import INGREDIENTS, merged, WHOLE, without
from measure.drives import Drive
import numpy as np
import pytest
from scenes import write_scene

NAMES = list(INGREDIENTS)[1:]


@pytest.fixture(scope='module')
def scene():
    # Long enough that noise is estimated (14 boxes of a track), with many neighbours.
    return simulate('street', seed=3, sweeps=24)


@pytest.fixture(scope='module')
def drive(scene):
    return Drive.from_scene(scene)


@pytest.fixture(scope='module')
def whole(drive):
    return without({}, drive)


@pytest.mark.parametrize('name', NAMES)
def test_switching_off_an_ingredient_changes_boxes(drive, whole, name):
    if name == 'marginalisation':  # nothing leaves the window of a whole track
        whole, found = (
            without(INGREDIENTS[key].settings, drive, 'early') for key in (WHOLE, name)
        )
    else:
        found = without(INGREDIENTS[name].settings, drive)
    assert found.track_ids == whole.track_ids
    assert np.isfinite(found.boxes).all()
    assert np.abs(found.boxes - whole.boxes).max() > 1e-3


def test_ingredients_are_switched_by_their_run_alone(drive, whole):
    # The core is unchanged: a run with all of them after a run without one is as before.
    without(INGREDIENTS['point ownership'].settings, drive)
    again = without({}, drive)
    np.testing.assert_array_equal(again.boxes, whole.boxes)


def test_every_switch_is_used():
    names = {name for item in INGREDIENTS.values() for name in item.settings}
    switches = {f'ingredients.{item.name}' for item in fields(Ingredients)}
    assert {name for name in names if name.startswith('ingredients.')} == switches
    assert not switches & {item.name for item in settings()}  # they are not settings


def test_losses_are_printed(tmp_path, scene, capsys):
    write_scene(tmp_path / 'recording.mcap', scene)
    scene.truth.write(tmp_path / 'truth.csv')
    options = ['ablation', str(tmp_path), '--without', 'one extent', '--min-points', '50']
    assert main(options) == 0
    text = capsys.readouterr().out
    assert text.startswith('| without | final: 3D | final: loss ')
    assert text.count('\n| one extent | 0.') == 1
    assert main([*options, '--json']) == 0
    (found,) = json.loads(capsys.readouterr().out)['results'].values()
    assert set(found) == {'final', 'track'}
    for rows in found.values():
        assert set(rows) == {WHOLE, 'one extent'}
        assert 0.5 < rows[WHOLE]['iou_3d'] < 1


def test_ingredients_are_left_out_one_after_the_other():
    settings = [INGREDIENTS[name].settings for name in ('rigid shape', 'road', 'slip')]
    known = {'ingredients.without': ('rigid shape', 'slip'), 'ingredients.road': False}
    assert merged(settings) == known


def test_estimates_differ(drive, whole):
    newest, final = (without({}, drive, name) for name in ('early', 'final'))
    for one, other in ((newest, final), (final, whole), (newest, whole)):
        assert len(one.boxes) == len(other.boxes)
        assert np.abs(one.boxes - other.boxes).max() > 1e-3
