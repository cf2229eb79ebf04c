"""The lifecycle node as a process, over DDS."""

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from preloaded import LIFECYCLE_NODE
import pytest
from ros_graph import ended_cleanly, QUICK, records_of, stamp_of
from ros_messages import Drive

COMMAND = (LIFECYCLE_NODE,)
NODE = '/boxreg_node'


class Manager:
    """Calls the services of a lifecycle node, as `ros2 lifecycle` does."""

    def __init__(self, graph):
        self._graph = graph

    def change(self, transition):
        """Request a transition; return whether it succeeded, and the state after it."""
        request = ChangeState.Request(transition=Transition(id=transition))
        changed = self._graph.call(ChangeState, f'{NODE}/change_state', request)
        state = self._graph.call(GetState, f'{NODE}/get_state', GetState.Request())
        return changed.success, state.current_state.label


def wait_until_unsubscribed(graph):
    """Wait until DDS has reported the end of all subscriptions of the node."""
    graph.wait(
        lambda: not any(p.get_subscription_count() for p in graph.publishers.values()),
        'the end of the subscriptions',
    )


def test_boxes_are_refined_while_the_node_is_active(graph, tmp_path):
    drive = Drive(sweeps=10)
    records = records_of(drive.write(tmp_path / 'drive'))
    node = graph.run(records, *QUICK, command=COMMAND, connects=False)
    manager = Manager(graph)
    assert manager.change(Transition.TRANSITION_CONFIGURE) == (True, 'inactive')
    graph.wait(
        lambda: any(message.status[0].message == 'inactive' for message in node.diagnostics),
        'the status of the inactive node',
    )
    assert not any(p.get_subscription_count() for p in graph.publishers.values())
    for _ in range(2):  # the second time all is forgotten: the same stamps are no time jump
        assert manager.change(Transition.TRANSITION_ACTIVATE) == (True, 'active')
        graph.wait_until_connected()
        node.play(records)
        assert manager.change(Transition.TRANSITION_DEACTIVATE) == (True, 'inactive')
        graph.wait(lambda: len(node.final) == 10, 'the final boxes that the node held')
        assert (
            [stamp_of(m) for m in node.early] == [stamp_of(m) for m in node.final] == drive.stamps
        )
        wait_until_unsubscribed(graph)
        assert manager.change(Transition.TRANSITION_CLEANUP) == (True, 'unconfigured')
        assert manager.change(Transition.TRANSITION_CONFIGURE) == (True, 'inactive')
        node.early.clear()
        node.final.clear()
    assert manager.change(Transition.TRANSITION_INACTIVE_SHUTDOWN) == (True, 'finalized')
    assert 'time_jump' not in node.output()
    assert ended_cleanly(node)


def test_a_transition_that_the_state_does_not_have_is_refused(graph):
    node = graph.start(command=COMMAND)
    manager = Manager(graph)
    assert manager.change(Transition.TRANSITION_ACTIVATE) == (False, 'unconfigured')
    assert manager.change(Transition.TRANSITION_CONFIGURE) == (True, 'inactive')
    assert manager.change(Transition.TRANSITION_CONFIGURE) == (False, 'inactive')
    assert manager.change(200) == (False, 'inactive')
    assert manager.change(Transition.TRANSITION_INACTIVE_SHUTDOWN) == (True, 'finalized')
    assert manager.change(Transition.TRANSITION_CONFIGURE) == (False, 'finalized')
    refused = [line for line in node.output().splitlines() if 'has no transition' in line]
    assert len(refused) == 4
    assert ended_cleanly(node)


def test_an_active_node_keeps_its_end_of_a_bond(graph):
    """As bondcpp of a Nav2 lifecycle manager reads it: an id, a heartbeat, and the end."""
    heartbeats = graph.collect('bond/msg/Status', '/bond')
    node = graph.start(command=COMMAND)
    manager = Manager(graph)
    assert manager.change(Transition.TRANSITION_CONFIGURE) == (True, 'inactive')
    assert not heartbeats
    for _ in range(2):
        assert manager.change(Transition.TRANSITION_ACTIVATE) == (True, 'active')
        graph.wait(lambda: len(heartbeats) > 5, 'heartbeats')
        assert manager.change(Transition.TRANSITION_DEACTIVATE) == (True, 'inactive')
        graph.wait(lambda: not heartbeats[-1].active, 'the end of the bond')
        assert all(status.active for status in heartbeats[:-1])
        (instance,) = {(status.id, status.instance_id) for status in heartbeats}
        assert instance[0] == 'boxreg_node'
        begun, ended = (heartbeats[row].header.stamp for row in (0, -1))
        seconds = ended.sec - begun.sec + 1e-9 * (ended.nanosec - begun.nanosec)
        assert (len(heartbeats) - 2) * 0.1 < seconds + 0.1  # no more often than promised
        assert heartbeats[0].heartbeat_period == pytest.approx(0.1)
        heartbeats.clear()
    assert ended_cleanly(node)


def test_an_activation_that_fails_leaves_the_node_inactive(graph):
    node = graph.start('-p', 'boxes_type:=std_msgs/msg/String', command=COMMAND)
    manager = Manager(graph)
    assert manager.change(Transition.TRANSITION_CONFIGURE) == (True, 'inactive')
    assert manager.change(Transition.TRANSITION_ACTIVATE) == (False, 'inactive')
    assert 'std_msgs/msg/String' in node.output()
    assert 'Traceback' not in node.output()
    assert ended_cleanly(node)
