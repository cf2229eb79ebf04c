"""The budget of a tick follows the deadline, the period of the boxes and the time of a window."""

from boxreg_ros.config import Config
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.live.budget import BATCH_OVERHEAD, RESERVE_MEMORY, TickBudget, TRANSPORT_TIME
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
    """Return a budget that has timed windows of 1 ms, with a deadline of the node; and a clock."""
    clock = Clock()
    total = deadline + TRANSPORT_TIME
    budget = TickBudget(total, clock, lambda windows, *_: [object()] * len(windows))
    clock.step = 1e-3 * (1 + BATCH_OVERHEAD)
    budget.submit([None], Config(), InputModel(Config().faces))()
    clock.step = 0.0
    return budget, clock


def windows(budget, since, needed=1):
    """Return the number of windows of a tick, with those that a batch costs in any case."""
    budget.begin(since)
    return budget.windows(needed) + BATCH_OVERHEAD


def tick(budget, clock, solving=0.0, publishing=0.0):
    """Run a tick whose solving and publishing take a time [s]."""

    def solve(*_):
        clock.now += solving
        return []

    budget.solve = solve
    budget.begin(clock.now)
    budget.windows(1)
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
    # More than a batch costs in any case would make the next tick late, too.
    assert windows(budget, overdue, needed=100) == 2 * BATCH_OVERHEAD
    # A second batch for the other four would take longer than they do.
    in_time = clock.now - 0.1 + 1e-3 * (BATCH_OVERHEAD + 3.5)
    assert windows(budget, in_time, needed=7) == 7 + BATCH_OVERHEAD
    assert windows(budget, clock.now, needed=7) > 7 + BATCH_OVERHEAD


def test_spare_windows_fit_into_the_rest_of_the_period():
    budget, _ = solved(0.1)
    for received in (5.0, 5.2, 5.4):
        budget.add_arrival(received)
    assert budget.spare_windows() + BATCH_OVERHEAD == pytest.approx(40, abs=1)
    for received in (50.0, 50.1, 50.2):
        budget.add_arrival(received)
    assert budget.spare_windows() < 0


def test_spare_windows_are_solved_before_the_next_boxes():
    budget, clock = solved(0.1)
    for received in (-0.4, -0.2, 0.0):
        budget.add_arrival(clock.now + received)
    clock.now += 0.17
    assert budget.spare_windows() + BATCH_OVERHEAD == pytest.approx(30, abs=1)
    clock.now += 0.05  # they are late
    assert budget.spare_windows() + BATCH_OVERHEAD == pytest.approx(40, abs=1)
    tick(budget, clock, publishing=0.03)
    assert budget.spare_windows() + BATCH_OVERHEAD == pytest.approx(10, abs=1)


def test_windows_between_the_ticks_are_timed_apart():
    budget, clock = solved(0.1)
    assert windows(budget, clock.now) == pytest.approx(100, abs=1)  # no others are known
    clock.step = 2e-3 * (1 + BATCH_OVERHEAD)
    budget.submit([None], Config(), InputModel(Config().faces))()
    clock.step = 0.0
    assert windows(budget, clock.now) == pytest.approx(50, abs=1)
    assert budget.spare_windows() + BATCH_OVERHEAD == pytest.approx(20, abs=1)


def test_time_for_publishing_is_left():
    budget, clock = solved(0.1)
    tick(budget, clock, publishing=0.03)
    budget.end()  # of a later message in the same tick
    assert windows(budget, clock.now) == pytest.approx(70, abs=1)


def test_the_second_largest_of_the_last_overruns_is_a_reserve():
    budget, clock = solved(0.1)
    for solving in (0.12, 0.13, 0.05):
        tick(budget, clock, solving)
    assert windows(budget, clock.now) == pytest.approx(80, abs=1)
    clock.now += RESERVE_MEMORY - 0.1
    assert windows(budget, clock.now) == pytest.approx(100, abs=1)


@pytest.mark.parametrize('stalled', [(0.0, 5.0), (5.0, 5.0), (0.2, 0.2, 0.2)])
def test_interruptions_cost_no_windows_of_later_ticks(stalled):
    budget, clock = solved(0.1)
    for solving in stalled:
        tick(budget, clock, solving)
    assert windows(budget, clock.now) == pytest.approx(100, abs=1)


@pytest.mark.parametrize('stalled', [(0, 1), (0, 7, 14), (0, 1, 2, 10)])
def test_all_boxes_are_refined_within_a_second_of_the_last_stall(stalled):
    """17 boxes of 0.8 ms each at 10 Hz; cropping takes 25 ms, the stalls 150 ms."""
    config = Config()
    clock = Clock()

    def solve(windows, *_):
        clock.now += 8e-4 * (len(windows) + BATCH_OVERHEAD)
        return [object()] * len(windows)

    budget = TickBudget(0.08, clock, solve)
    budget.submit([None], config, InputModel(config.faces))()
    shares, latencies = [], []
    begun = clock.now
    for number in range(max(stalled) + 40):
        arrived = begun + 0.1 * number
        clock.now = max(clock.now, arrived) + 0.025
        budget.begin(arrived)
        solvable = min(17, budget.windows(4))
        clock.now += 0.15 * (number in stalled)
        budget.submit([None] * solvable, config, InputModel(config.faces))()
        clock.now += 0.004
        budget.end()
        shares.append(solvable / 17)
        latencies.append(clock.now - arrived)
    assert latencies[max(stalled)] > 0.15
    last = max(stalled) + 1
    assert sum(shares[last : last + 10]) / 10 > 0.5
    assert min(shares[last + 10 :]) == 1
    assert max(latencies[last + 10 :]) < 0.08


def test_a_tick_that_cannot_be_in_time_takes_no_reserve():
    budget, clock = solved(0.02)  # less than a batch of one window
    tick(budget, clock, solving=0.05)
    budget.deadline = 0.1 + TRANSPORT_TIME
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
