"""The plans of the three kinds of windows."""

from boxreg_ros.config import Config
from boxreg_ros.core.solver import SolverPlan
import pytest


def test_cold_sliding_windows():
    plan = SolverPlan.choose(Config(estimate='final').updated({'solver.rounds': 7}), is_warm=False)
    assert plan == SolverPlan(7, marginalises=True)


def test_warm_sliding_windows_take_one_round():
    plan = SolverPlan.choose(Config(estimate='early'), is_warm=True)
    assert plan == SolverPlan(1, starts_from_fit=True, marginalises=True)


@pytest.mark.parametrize('is_warm', [False, True])
def test_whole_tracks_leave_no_prior(is_warm):
    plan = SolverPlan.choose(Config(estimate='track'), is_warm)
    assert plan.uses_rigid_shape
    assert plan.estimates_noise
    assert not plan.marginalises
    assert plan.starts_from_fit == is_warm
