"""What drives show of their detector: files of it, and models that begin with them."""

from itertools import permutations
import json

from boxreg_ros.config import Config, KINDS
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.core.input_statistics import from_text, joined, to_text
from boxreg_ros.core.method.residuals import TERMS
from boxreg_ros.errors import ConfigError
from boxreg_ros.io.input_models import disagreements, read_models
import numpy as np
import pytest
from scenes import problem_of


def taught(seed, margin=0.02, tracks=20, drives=None, name=''):
    """Return a model of vehicles whose margins are `margin` larger than expected."""
    rng = np.random.default_rng(seed)
    model = InputModel(Config().faces, drives)
    names = [str(i) for i in range(tracks)]
    shown = np.zeros((tracks, 5), TERMS)
    gaps = margin + 0.06 * rng.normal(size=(tracks, 6))
    shown['distance'] = model.inputs(Config())['margin'][0] - gaps[:, None]
    shown['visibility'], shown['num_points'] = 1.0, 100
    boxes = np.zeros((tracks, 5, 9))
    boxes[..., 3:6] = rng.normal([4.4, 1.8, 1.5], 0.1, (tracks, 1, 3))
    model._add(names, problem_of(boxes), shown, model.inputs(Config()))
    return model


def first_margins(seed, drives):
    """Return the margins of a drive of three tracks that begins with `drives`."""
    return taught(seed, tracks=3, drives=drives).inputs(Config())['margin'][0]


def test_a_file_has_the_same_bytes_in_any_order_of_joining():
    drives = [taught(seed).statistics(f'drive {seed}') for seed in range(3)]
    texts = {to_text(joined(some)) for some in permutations([*drives, drives[0]])}
    (text,) = texts
    assert to_text(from_text(text, 'model')) == text
    assert list(from_text(text, 'model')) == ['drive 0', 'drive 1', 'drive 2']
    assert json.loads(text)['units'] == 'm, rad'


def test_a_model_begins_with_what_other_drives_have_shown():
    # Their 60 tracks give the margin before the first box, and it stays with few own tracks.
    together = joined(taught(seed).statistics(f'drive {seed}') for seed in range(3))
    fresh = InputModel(Config().faces, together).inputs(Config())[0]
    np.testing.assert_allclose(fresh['margin'][:4], 0.02, atol=0.012)
    errors = [
        np.abs(taught(seed, tracks=3, drives=known).inputs(Config())['margin'][0] - 0.02).max()
        for known in (None, together)
        for seed in (7, 8, 9)
    ]
    assert max(errors[3:]) < min(0.015, max(errors[:3]))


def test_another_detector_is_noticed():
    same = joined(taught(seed).statistics(f'drive {seed}') for seed in range(4))
    assert not list(disagreements(same))
    other = joined([same, taught(5, margin=0.15).statistics('other')])
    found = list(disagreements(other))
    assert any('vehicle' in text and 'drive other' in text for text in found)
    assert not any('drive 1' in text and '+' in text for text in found)


@pytest.mark.parametrize(
    ('change', 'expected'),
    [
        (lambda text: text[: len(text) // 2], 'JSON'),
        (lambda text: text.replace('"version": 1', '"version": 2'), 'version 1, got 2'),
        (lambda text: text.replace('"m, rad"', '"cm"'), "'m, rad'"),
        (lambda text: text.replace('boxreg input model', 'boxes'), 'format'),
        (lambda text: text.replace('"pedestrian"', '"dog"'), 'pedestrian'),
        (lambda text: text.replace('"boxes": 0.0', '"boxes": NaN', 1), 'NaN'),
        (lambda text: text.replace('"boxes": 0.0', '"boxes": 3.0', 1), 'changed'),
        (lambda text: text.replace('"boxes": 0.0', '"boxes": -3.0', 1), 'numbers in m, rad'),
        (lambda text: text.replace('"evidence"', '"sizes"'), 'evidence'),
        (lambda text: '[]', 'format'),
    ],
)
def test_wrong_files_are_refused_in_clear_words(tmp_path, change, expected):
    text = to_text(taught(0).statistics('drive'))
    path = tmp_path / 'input_model.json'
    path.write_text(change(text))
    assert change(text) != text
    with pytest.raises(ConfigError) as error:
        read_models([path])
    assert expected in str(error.value)
    assert str(path) in str(error.value)


def test_an_empty_fleet_is_refused(tmp_path):
    (tmp_path / 'a.json').write_text(to_text(InputModel(Config().faces).statistics()))
    with pytest.raises(ConfigError, match='at least one drive'):
        read_models([tmp_path / 'a.json'])
    with pytest.raises(ConfigError, match='cannot be read'):
        read_models([tmp_path / 'b.json'])
    assert read_models([]) == {}
    assert len(KINDS) == 3
