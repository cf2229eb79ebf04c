"""Broken tracks: how much is missing, which ids change, and where ghosts are."""

from collections import Counter

from boxreg_ros import cli
from boxreg_ros.errors import ConfigError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.simulation.breaks import break_tracks
from boxreg_ros.simulation.simulate import broken, simulate
from boxreg_ros.structures import BoxArray
from measure.tracks import FarMisses
import numpy as np
import pytest

SWEEPS = 100
TRACKS = 60


def arrays():
    """Return arrays of tracks far apart, with a box in each sweep."""
    boxes = np.zeros((TRACKS, 9))
    boxes[:, 0] = 100.0 * np.arange(TRACKS)
    boxes[:, 3:6] = (4, 2, 1.5)
    names = tuple(str(number) for number in range(TRACKS))
    return [
        BoxArray(k * 10**8, 'odom', names, ('car',) * TRACKS, np.ones(TRACKS), boxes)
        for k in range(SWEEPS)
    ]


def runs(broken_arrays, name):
    """Return the lengths of the gaps of a track, and its ids in order."""
    present = []
    ids = []
    for array in broken_arrays:
        found = [i for i in array.track_ids if i.split('_')[0] == name]
        present.append(bool(found))
        ids += found
    gaps = ''.join('x' if is_there else '.' for is_there in present).strip('.').split('x')
    return [len(gap) for gap in gaps if gap], list(dict.fromkeys(ids))


def test_part_of_the_boxes_is_missing_and_ids_change():
    found = break_tracks(arrays(), np.random.default_rng(1))
    left = sum(len(array.track_ids) for array in found) / (SWEEPS * TRACKS)
    # 8 % at random, and about 100 / 65 gaps of 5.5 sweeps in 100.
    assert 0.81 < left < 0.88
    gaps, ids = zip(*(runs(found, str(name)) for name in range(TRACKS)), strict=True)
    assert all(len(names) <= 1 + len(lengths) for names, lengths in zip(ids, gaps, strict=True))
    assert 1.4 < sum(map(len, ids)) / TRACKS < 2.1
    long = [length for lengths in gaps for length in lengths if length >= 3]
    assert 60 < len(long) < 120


def test_far_boxes_are_missed_more_often_and_in_runs():
    """The distance of track k is 100 k m: its square is 1 / 1200 k^2 of the mean square."""
    far = FarMisses(arrays(), np.zeros((SWEEPS, 3)))
    found = break_tracks(arrays(), np.random.default_rng(1), misses=far)
    left = np.zeros(TRACKS)
    for array in found:
        for name in array.track_ids:
            left[int(name.split('_')[0])] += 1 / SWEEPS
    gaps = 0.08  # of 3 to 8 sweeps, as without far misses
    assert abs(1 - left[:20].mean() - gaps - 0.08 * 0.11) < 0.04
    assert abs(1 - left[-20:].mean() - gaps - 0.08 * 2.1) < 0.06
    lengths = [length for number in range(40, TRACKS) for length in runs(found, str(number))[0]]
    assert np.mean(lengths) > 2.5


def test_boxes_that_are_left_are_unchanged():
    given = arrays()
    for array in break_tracks(given, np.random.default_rng(2)):
        for name, box in zip(array.track_ids, array.boxes, strict=True):
            np.testing.assert_array_equal(box, given[0].boxes[int(name.split('_')[0])])


def test_ghosts_have_their_rate_and_short_lives():
    origins = np.zeros((SWEEPS, 3))
    found = break_tracks(arrays(), np.random.default_rng(3), 1.5, origins)
    ghosts = Counter(i for array in found for i in array.track_ids if i.startswith('ghost'))
    assert ghosts.total() / SWEEPS == pytest.approx(1.5, abs=0.4)
    assert set(ghosts.values()) <= {1, 2, 3}
    with pytest.raises(ConfigError, match='ghosts: expected 0 or more'):
        break_tracks(arrays(), np.random.default_rng(3), -1.0, origins)
    with pytest.raises(ConfigError, match='origins'):
        break_tracks(arrays(), np.random.default_rng(3), 1.5)


def test_same_seed_breaks_alike_and_keeps_the_truth():
    scene = simulate('street', seed=1, sweeps=12)
    first, second, other = (broken(scene, seed, 1.5) for seed in (5, 5, 6))
    ids = [[array.track_ids for array in found.detections] for found in (first, second, other)]
    assert ids[0] == ids[1] != ids[2]
    assert first.truth is scene.truth
    assert first.sweeps is scene.sweeps


def test_command_breaks_tracks(tmp_path, capsys):
    words = ['simulate', '--sweeps', '8', '--seed', '1', '-o']
    assert cli.main([*words, str(tmp_path / 'whole.mcap')]) == 0
    assert cli.main([*words, str(tmp_path / 'broken.mcap'), '--break', '--ghosts', '2']) == 0
    assert cli.main([*words, str(tmp_path / 'bad.mcap'), '--ghosts', '2']) == 2
    assert '--ghosts 2: expected with --break only' in capsys.readouterr().err
    tables = [BoxTable.read(tmp_path / f'{name}_truth.csv') for name in ('whole', 'broken')]
    np.testing.assert_array_equal(tables[0].boxes, tables[1].boxes)
