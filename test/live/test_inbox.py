"""The queues between the threads of the node: capacity, order, and clouds that give way."""

from boxreg_ros.live.inbox import BOXES_PER_CLOUD, CloudPatience, Inbox
import numpy as np
import pytest


def test_the_oldest_message_is_dropped_beyond_the_capacity_of_its_kind():
    inbox = Inbox(2, lidars=3)
    for topic, capacity in (('points', 2 * 3), ('boxes', 2 * BOXES_PER_CLOUD)):
        assert [inbox.put(topic, k) for k in range(capacity)] == [None] * capacity
        dropped = inbox.put(topic, capacity)
        assert (dropped.topic, dropped.content) == (topic, 0)
        assert inbox.sizes()[f'{topic}_waiting'] == capacity
    inbox.put_passing(dropped)  # the oldest box array, to its place in the order
    taken = []
    while (message := inbox.take()) is not None:
        taken.append((message.topic, message.content))
    clouds = [('points', k) for k in range(1, 7)]
    arrays = [('passing', 0)] + [('boxes', k) for k in range(1, 2 * BOXES_PER_CLOUD + 1)]
    assert taken == clouds + arrays


def test_a_newer_cloud_is_one_of_the_same_lidar():
    inbox = Inbox(2, lidars=2)
    inbox.put('points', 0, 'front')
    inbox.put('points', 1, 'rear')
    inbox.put('boxes', 2)
    front = inbox.take()
    assert not inbox.has_newer(front)
    inbox.put('points', 3, 'front')
    assert inbox.has_newer(front)


def run_queue(backlog, took):
    """Return for each cloud of 10 Hz its wait, or None if dropped; each takes a time [s]."""
    patience = CloudPatience(backlog)
    now = 0.0
    waits = []
    for number, duration in enumerate(took):
        arrived = 0.1 * number
        now = max(now, arrived)
        has_newer = now >= arrived + 0.1
        if patience.is_overdue(now - arrived, 0.08, has_newer):
            waits.append(None)
        else:
            waits.append(round(now - arrived, 3))
            now += duration
    return waits


@pytest.mark.parametrize(('took', 'share'), [(0.15, 0.65), (0.25, 0.38), (0.4, 0.24)])
def test_under_lasting_overload_the_newest_cloud_goes_first(took, share):
    waits = run_queue(0.5, [took] * 100)
    kept = [wait for wait in waits[10:] if wait is not None]
    assert max(kept) <= 0.1
    assert len(kept) / 90 == pytest.approx(share, abs=0.05)


def test_after_one_delay_the_node_catches_up_without_drops():
    waits = run_queue(0.5, [0.03, 0.03, 0.35, *[0.03] * 10])
    assert waits[2:8] == pytest.approx([0.0, 0.25, 0.18, 0.11, 0.04, 0.0])


def test_clouds_beyond_the_backlog_are_dropped():
    assert run_queue(0.2, [0.03, 0.5, 0.03, 0.03, 0.03, 0.03]) == [
        *(0.0, 0.0, None, None), *(pytest.approx(0.2), pytest.approx(0.13)),
    ]  # fmt: skip


@pytest.mark.parametrize('seconds', [0.11, 0.15, 0.3])
def test_the_newest_first_drops_no_more_clouds_than_waiting_in_order(seconds):
    """A solver that takes longer than the period of 0.1 s, and a quarter more at random."""

    class InOrder(CloudPatience):
        def is_overdue(self, waited, deadline, has_newer):
            return waited > self.backlog

    of_newest, of_order = (overloaded(policy(0.5), seconds) for policy in (CloudPatience, InOrder))
    assert of_newest[0] <= of_order[0] + 0.05
    assert of_newest[1] < 0.6 * of_order[1]


def overloaded(patience, seconds, clouds=1000):
    """Return the share of dropped clouds, and the median of the waits of the others [s]."""
    factors = np.random.default_rng(0).uniform(0.75, 1.25, clouds)
    now, waits = 0.0, []
    for turn in range(clouds):
        arrived = 0.1 * turn
        now = max(now, arrived)
        if not patience.is_overdue(now - arrived, 0.08, now >= arrived + 0.1):
            waits.append(now - arrived)
            now += seconds * factors[turn]
    return 1 - len(waits) / clouds, np.median(waits)
