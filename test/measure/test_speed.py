"""`measure speed` on small cases: its results are complete and consistent."""

import json

from boxreg_ros.config import Config
from measure import shown
from measure.speed import WANTED
from measure.speed.reference import compare
from measure.speed.scaling import crop, held_tracks, tick
from paths import ROOT
import pytest

STAGES = ('decode', 'transform', 'crop and sample', 'solve', 'encode')


@pytest.fixture(scope='module')
def report():
    config = Config(estimate='final').updated({'window': 5, 'lag': 4, 'solver.rounds': 1})
    stored = json.loads((ROOT / 'docs' / 'results' / 'speed.json').read_text(encoding='utf-8'))
    return stored['results'] | {
        'tick': tick(config, 3, 3_000, 4),
        'held tracks': held_tracks(config, 3_000, 2),
        'crop': crop(config, 3, 3_000),
        'solver': compare(Config(estimate='final'), 2, 2),
    }


def test_the_reference_is_a_fit(report):
    solver = report['solver']
    assert solver['value, reference'] < solver['value, input']
    assert solver['IoU, input'] < solver['IoU, reference'] < 1
    assert solver['IoU, input'] < solver['IoU, ours'] < 1
    assert all(solver[case] > 0 for case in ('refine', 'warm', 'cold', 'reference'))


def test_stages_of_a_tick_add_up(report):
    ticked = report['tick']
    assert all(ticked[stage] > 0 for stage in STAGES)
    assert ticked['total'] == pytest.approx(sum(ticked[stage] for stage in STAGES))
    assert 0 < report['held tracks'] <= 2


def test_results_are_shown_in_a_table_and_have_the_numbers_with_aims(report):
    rows = dict(line.strip('| ').split(' | ') for line in shown('speed', report).splitlines()[2:])
    assert float(rows['tick: total']) == pytest.approx(report['tick']['total'], rel=0.1)
    assert rows.keys() >= WANTED.keys()
