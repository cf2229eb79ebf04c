"""`measure ablation`: every ingredient that is switched off changes the boxes."""

from dataclasses import fields
import json

from boxreg_ros.config import Ingredients, settings
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.box_scores import match
from boxreg_ros.simulation.simulate import simulate
from measure import main
from measure.ablation import INGREDIENTS, standard_error, WHOLE, without
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
        assert rows['one extent']['loss'] > 2 * rows['one extent']['loss_error'] > 0
    assert main([*options, '--draws', '0']) == 1
    assert '--draws: expected 1 or more, got 0' in capsys.readouterr().err


def test_standard_errors_are_those_of_tracks_and_of_draws():
    tracks = np.array(['a', 'a', 'b', 'b'])
    of_tracks = np.array([[1.0, 1.0, -1.0, -1.0]])  # two means of 1 and -1
    assert standard_error(of_tracks, tracks) == pytest.approx(1.0)
    assert standard_error(np.repeat(of_tracks, 5, axis=0), tracks) == pytest.approx(1.0)
    of_draws = np.array([[1.0] * 4, [-1.0] * 4])  # tracks agree, draws do not
    assert standard_error(of_draws, tracks) > 0.5
    assert standard_error(0 * of_draws, tracks) == 0


def test_draws_have_the_errors_of_a_detector(drive):
    once, again, other = (drive.redrawn(seed).boxes for seed in (1, 1, 2))
    for draws in zip(once, again, other, drive.boxes, strict=True):
        own, same, new, recorded = draws
        assert own.stamp_ns == recorded.stamp_ns
        assert set(own.track_ids) >= set(recorded.track_ids)
        np.testing.assert_array_equal(own.boxes, same.boxes)
        assert (own.boxes != new.boxes).any(1).all()
    found = match(BoxTable.from_arrays(once), drive.truth)
    assert found.is_matched.all()
    assert 0.6 < found.iou_3d.mean() < 0.9
