"""The queues between the threads of the node: their capacity and the order of arrival."""

from boxreg_ros.live.inbox import BOXES_PER_CLOUD, Inbox


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
