"""The budget of a tick follows the deadline, the period of the boxes and the time of a window."""

from boxreg_ros.config import Config
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.io.warm_up import warm_up
from boxreg_ros.live.budget import BATCH_OVERHEAD, OVERRUNS, TickBudget
import pytest


class Clock:
    """A clock that moves on by `step` at each look [s]."""

    def __init__(self):
        self.now = 1000.0
        self.step = 0.0

    def __call__(self):
        self.now += self.step
        return self.now


def solved(deadline):
    """Return a budget that has timed windows of 1 ms, and its clock."""
    clock = Clock()
    budget = TickBudget(deadline, clock)
    clock.step = 1e-3 * (1 + BATCH_OVERHEAD)
    warm_up(Config(estimate='final'), budget.submit)
    clock.step = 0.0
    return budget, clock


def windows(budget, since, needed=1):
    """Return the number of windows of a tick, with those that a batch costs in any case."""
    budget.begin(since)
    return budget.windows(needed) + BATCH_OVERHEAD


def tick(budget, clock, solving=0.0, publishing=0.0):
    """Run a tick whose solving and publishing take a time [s]."""
    budget.begin(clock.now)
    budget.windows(1)
    clock.now += solving
    budget.submit([], Config(), InputModel(Config().faces))()
    clock.now += publishing
    budget.end()


def test_one_window_is_solved_while_no_time_is_known():
    budget = TickBudget(3600.0)
    assert budget.windows(1) == 1
    assert budget.spare_windows() == 0


def test_the_number_of_windows_follows_the_time_left():
    budget, clock = solved(0.1)
    assert windows(budget, clock.now) == pytest.approx(100, abs=1)
    assert windows(budget, clock.now - 0.05) == pytest.approx(50, abs=1)
    assert windows(budget, clock.now - 0.1) == 1 + BATCH_OVERHEAD


def test_final_boxes_are_given_up_last():
    budget, clock = solved(0.1)
    overdue = clock.now - 0.1
    assert windows(budget, overdue, needed=7) == 7 + BATCH_OVERHEAD
    assert budget.owed == 0
    # More than a batch costs in any case would make the next tick late, too.
    assert windows(budget, overdue, needed=100) == 2 * BATCH_OVERHEAD
    # A tick that can be in time is, and the rest follows.
    in_time = clock.now - 0.1 + 1e-3 * (BATCH_OVERHEAD + 3.5)
    assert windows(budget, in_time, needed=7) == 3 + BATCH_OVERHEAD
    assert budget.owed == 4
    assert windows(budget, clock.now, needed=7) > 7 + BATCH_OVERHEAD
    assert budget.owed == 0


def test_spare_windows_fit_into_the_rest_of_the_period():
    budget, _ = solved(0.1)
    for received in (5.0, 5.2, 5.4):
        budget.add_arrival(received)
    assert budget.spare_windows() + BATCH_OVERHEAD == pytest.approx(40, abs=1)
    for received in (50.0, 50.1, 50.2):
        budget.add_arrival(received)
    assert budget.spare_windows() < 0


def test_time_for_publishing_is_left():
    budget, clock = solved(0.1)
    tick(budget, clock, publishing=0.03)
    budget.end()  # of a later message in the same tick
    assert windows(budget, clock.now) == pytest.approx(70, abs=1)


def test_the_second_largest_of_recent_overruns_is_a_reserve():
    budget, clock = solved(0.1)
    for solving in (0.12, 0.13, 0.05):
        tick(budget, clock, solving)
    assert windows(budget, clock.now) == pytest.approx(80, abs=1)
    for _ in range(OVERRUNS - 3):
        tick(budget, clock)
    assert windows(budget, clock.now) == pytest.approx(80, abs=1)
    tick(budget, clock)
    assert windows(budget, clock.now) == pytest.approx(100, abs=1)


def test_a_single_interruption_costs_no_windows():
    budget, clock = solved(0.1)
    for solving in (0.0, 5.0):
        tick(budget, clock, solving)
    assert windows(budget, clock.now) == pytest.approx(100, abs=1)


def test_long_interruptions_leave_time_for_windows():
    budget, clock = solved(0.1)
    for _ in range(2):
        tick(budget, clock, solving=5.0)
    assert windows(budget, clock.now) == pytest.approx(50, abs=1)


def test_a_tick_that_cannot_be_in_time_takes_no_reserve():
    budget, clock = solved(0.02)  # less than a batch of one window
    tick(budget, clock, solving=0.05)
    budget.deadline = 0.1
    assert windows(budget, clock.now) == pytest.approx(100, abs=1)


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
