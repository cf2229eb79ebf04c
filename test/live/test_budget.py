"""The budget of a tick follows the deadline, the period of the boxes and the time of a window."""

import time

from boxreg_ros.config import Config
from boxreg_ros.io.warm_up import warm_up
from boxreg_ros.live.budget import TickBudget
import pytest


def solved(deadline):
    """Return a budget that has timed some batches."""
    budget = TickBudget(deadline)
    warm_up(Config(estimate='final'), budget.submit)
    return budget


def test_one_window_is_solved_while_no_time_is_known():
    budget = TickBudget(3600.0)
    budget.begin(time.monotonic())
    assert budget.windows() == 1


def test_the_number_of_windows_follows_the_time_left():
    budget = solved(3600.0)
    budget.begin(time.monotonic())
    many = budget.windows()
    assert many > 1000
    budget.begin(time.monotonic() - 1800.0)
    assert budget.windows() == pytest.approx(many / 2, rel=0.05)
    budget.begin(time.monotonic() - 3600.0)
    assert budget.windows() == 1


def test_time_for_publishing_is_left():
    budget = solved(3600.0)
    budget.begin(time.monotonic())
    many = budget.windows()
    warm_up(Config(estimate='final'), budget.submit)
    time.sleep(0.1)
    budget.end()
    budget.begin(time.monotonic() - 3599.9)
    assert budget.windows() == 1
    assert many > 1


@pytest.mark.parametrize(
    ('arrivals', 'seconds'),
    [
        ((), 0.08),
        ((5.0,), 0.08),
        ((5.0, 5.05, 5.1), 0.04),
        ((5.0, 5.0, 5.2, 5.2, 5.4), 0.08),  # two at once: the mean counts
        ((5.0, 5.1, 15.0, 15.2), 0.16),  # a pause is no period
    ],
)
def test_the_default_deadline_is_most_of_the_measured_period(arrivals, seconds):
    budget = TickBudget(-1.0)
    for received in arrivals:
        budget.add_arrival(received)
    assert budget.seconds == pytest.approx(seconds)
    budget.deadline = 0.5
    assert budget.seconds == 0.5
