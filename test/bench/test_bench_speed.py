"""`boxreg bench speed` on small cases: its results are complete and consistent."""

import json

from boxreg_ros.bench.speed import command
from boxreg_ros.bench.speed.reference import compare
from boxreg_ros.bench.speed.scaling import crop, held_tracks, tick
from boxreg_ros.config import Config
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


def test_results_are_shown_beside_earlier_ones_and_drawn(report, tmp_path):
    earlier = json.loads(json.dumps(report))
    earlier['cores']['2 cores'] = 2 * report['cores']['2 cores']
    lines = command.text(report, earlier).splitlines()
    rows = {line[:44].strip(): line[44:].split() for line in lines}
    assert float(rows['tick: total'][0]) == pytest.approx(report['tick']['total'], rel=1e-3)
    for name, wanted in command.WANTED.items():
        assert rows[name][1] == f'{wanted:g}'
    assert rows['cores: 2 cores'][-1] == '2.00'
    picture = command.draw_scaling(report['scaling'], tmp_path / 'speed.png')
    assert picture.stat().st_size > 1000
