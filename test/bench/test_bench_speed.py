"""`boxreg bench speed` on small cases: its results are there and consistent."""

from boxreg_ros.bench import speed as bench_speed
from boxreg_ros.config import Config
import pytest

STAGES = ('decode', 'transform', 'crop and sample', 'solve', 'encode')


@pytest.fixture(scope='module')
def report():
    config = Config(estimate='final').updated({'window': 5, 'lag': 4, 'solver.rounds': 1})
    return {
        'device': 'cpu',
        'load': 0.0,
        'tick': bench_speed.tick(config, 3, 3_000),
        'crop': bench_speed.crop(config, 3, 3_000),
        'solver': bench_speed.solver(config, 2, 1),
        'scaling': {'windows': [(1, 2.0), (8, 0.5)]},
        'relabel': bench_speed.relabel(2, 4_000, 1.0),
    }


def test_the_solver_is_compared_at_an_equal_objective(report):
    solver = report['solver']
    assert solver['excess, worst'] < 0.01
    assert all(0.3 < solver[f'IoU, {who}'] < 1 for who in ('input', 'reference', 'ours'))
    assert all(solver[case] > 0 for case in ('warm', 'cold', 'reference'))


def test_stages_of_a_tick_add_up(report):
    tick = report['tick']
    assert all(tick[stage] > 0 for stage in STAGES)
    assert tick['total'] == pytest.approx(sum(tick[stage] for stage in STAGES))


def test_relabel_is_measured_in_its_own_processes(report):
    relabel = report['relabel']
    assert 0 < relabel['solve'] < relabel['total'] == pytest.approx(1.0 / relabel['faster'])
    assert relabel['rest'] == pytest.approx(1 - relabel['solve'] / relabel['total'])
    assert 0 < relabel['rest, long'] < 1 and relabel['few'] in (800, 4_000)
    # Three processes, each with torch: less would be one that is not counted.
    assert min(relabel[case] for case in ('memory', 'short', 'long')) > 300


def test_the_text_holds_all_results(report):
    text = bench_speed._text(report)
    assert 'windows per second        1: 500   8: 2,000' in text
    assert f'one tick: {report["tick"]["total"]:.1f} ms' in text
    assert f'relabel: {report["relabel"]["faster"]:.1f} times faster' in text
    assert f'ten times as long {report["relabel"]["long"]:.0f} MB' in text
