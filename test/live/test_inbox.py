"""The queues between the threads of the node: capacity, order, and clouds that give way."""

from boxreg_ros.live.inbox import BOXES_PER_CLOUD, CloudPatience, Inbox, Message
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


def run_queue(backlog, took, patience=None):
    """Return for each cloud of 10 Hz its wait, or None if dropped; each takes a time [s]."""
    patience = patience or CloudPatience(backlog)
    now = 0.0
    waits = []
    for number, duration in enumerate(took):
        arrived = 0.1 * number
        now = max(now, arrived)
        cloud = Message(number, 'points', None, round(arrived * 1e9))
        if patience.is_overdue(cloud, arrived, now, 0.08, now >= arrived + 0.1):
            waits.append(None)
        else:
            waits.append(round(now - arrived, 3))
            now += duration
    return waits


@pytest.mark.parametrize(('took', 'share'), [(0.15, 0.65), (0.25, 0.38), (0.4, 0.24)])
def test_under_lasting_overload_the_newest_cloud_goes_first(took, share):
    waits = run_queue(0.5, [took] * 100)
    kept = [wait for wait in waits[30:] if wait is not None]
    assert max(kept) <= 0.1
    assert len(kept) / 70 == pytest.approx(share, abs=0.05)


def test_after_one_delay_the_node_catches_up_without_drops():
    waits = run_queue(0.5, [0.03, 0.03, 0.35, *[0.03] * 10])
    assert waits[2:8] == pytest.approx([0.0, 0.25, 0.18, 0.11, 0.04, 0.0])


def test_clouds_beyond_the_backlog_are_dropped():
    assert run_queue(0.2, [0.03, 0.5, 0.03, 0.03, 0.03, 0.03]) == [
        *(0.0, 0.0, None, None), *(pytest.approx(0.2), pytest.approx(0.13)),
    ]  # fmt: skip


@pytest.mark.parametrize('seconds', [0.12, 0.15, 0.3])
def test_the_newest_first_drops_as_many_clouds_as_waiting_in_order(seconds):
    """A solver that takes longer than the period of 0.1 s, by up to a quarter more or less."""
    took = seconds * np.random.default_rng(0).uniform(0.75, 1.25, 1000)
    newest, in_order = run_queue(0.5, took), run_queue(0.5, took, InOrder(0.5))
    assert newest.count(None) <= in_order.count(None) + 20
    of_newest, of_order = (
        np.median([wait for wait in waits if wait is not None]) for waits in (newest, in_order)
    )
    assert of_newest < 0.6 * of_order


def test_delays_that_end_drop_no_more_clouds_than_waiting_in_order():
    """One cloud in eight takes a quarter of a second longer."""
    is_delayed = np.random.default_rng(0).random(1000) < 1 / 8
    took = np.where(is_delayed, 0.28, 0.03)
    newest, in_order = run_queue(0.5, took), run_queue(0.5, took, InOrder(0.5))
    assert newest.count(None) <= in_order.count(None) + 2 < 20


class InOrder(CloudPatience):
    """Clouds are taken in their order, as long as they may wait."""

    def is_overdue(self, cloud, since, now, deadline, has_newer):
        return now - since > self.backlog
