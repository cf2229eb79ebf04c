"""The live node as a lifecycle node, and its bond with the manager that starts it in order."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from queue import Queue
from threading import Event
from typing import Any
from uuid import uuid4

from boxreg_ros.errors import BoxregError, one_line, UnsupportedMessage
from boxreg_ros.io.warm_up import SecondProcess
from boxreg_ros.live.diagnostics import diagnosis
from boxreg_ros.live.node import BoxregNode, STATUS_PERIOD
from boxreg_ros.live.topics import import_message
from boxreg_ros.live.worker import Worker
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.srv import ChangeState
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node

BOND_TOPIC = 'bond'
BOND_TYPE = 'bond/msg/Status'
HEARTBEAT_PERIOD = 0.1
"""Time between two heartbeats [s]; that of the nodes of Nav2."""
HEARTBEAT_TIMEOUT = 4.0
"""Silence after which the other end takes the bond for broken [s]; that of Nav2 by default."""
DEPTH = 10
"""Queue size: a second of heartbeats, ten of /diagnostics."""
END_HEARD_TIME = 1.0
"""Longest wait for the other end to take the last message [s]; ten of its heartbeats."""


class Heartbeat:
    """Publish what a function returns, every `period` [s] until `end`."""

    def __init__(
        self, node: Node, kind: Any, topic: str, period: float, message: Callable[[], Any]
    ) -> None:
        self._node = node
        self._message = message
        self._publisher = node.create_publisher(kind, topic, DEPTH)
        # A steady clock: the manager's timeout runs on while /clock stands still.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(period, self.publish, clock=steady)

    def publish(self) -> None:
        """Publish now."""
        message = self._message()
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)

    def end(self) -> None:
        """Publish no more."""
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)


class Bond(Heartbeat):
    """
    Publish heartbeats on `BOND_TOPIC` until `end`, which announces the end.

    The manager has the other end and acts when heartbeats fail to come; the node does not depend
    on the manager. Both ends name the bond by the name of the node.

    """

    def __init__(self, node: Node, kind: Any) -> None:
        self._status = kind(
            id=node.get_name(), instance_id=str(uuid4()), active=True,
            heartbeat_timeout=HEARTBEAT_TIMEOUT, heartbeat_period=HEARTBEAT_PERIOD,
        )  # fmt: skip
        super().__init__(node, kind, BOND_TOPIC, HEARTBEAT_PERIOD, lambda: self._status)

    @classmethod
    def offered_by(cls, node: Node) -> Bond | None:
        """Return a new bond; None, with a log entry, where its message type is not installed."""
        try:
            kind = import_message(BOND_TYPE)
        except UnsupportedMessage as error:
            node.get_logger().info(f'no bond, set bond_timeout of a manager to 0.0: {error}')
            return None
        return cls(node, kind)

    def end(self) -> None:
        """Announce the end of the bond, and publish no more."""
        self._status.active = False
        self.publish()
        # A publisher that is destroyed takes along what was not acknowledged.
        self._publisher.wait_for_all_acked(Duration(seconds=END_HEARD_TIME))
        super().end()


AnswerChange = Callable[[ChangeState.Request, ChangeState.Response], ChangeState.Response]


class BoxregLifecycleNode(LifecycleNodeMixin, BoxregNode):
    """
    `BoxregNode` with the states of a managed node.

    ``configure`` takes the values of the parameters and warms up, ``activate`` creates topics and
    services, ``deactivate`` publishes the boxes held and destroys them, ``cleanup`` forgets tracks
    and transforms. A transition that an error prevents, or that the present state does not have,
    is refused and logged in one line. While the node is active it keeps its end of a bond.

    """

    def __init__(self, second: SecondProcess | None = None) -> None:
        BoxregNode.__init__(self, second)
        LifecycleNodeMixin.__init__(self)
        service = self._service_change_state
        service.callback = partial(self._answer_change, service.callback)
        self._bond: Bond | None = None
        self._activated = Queue[Worker | None]()
        self._drained = Event()
        self._is_active = False
        self._status = self._inactive_status()

    def _inactive_status(self) -> Heartbeat:
        """Publish the state on /diagnostics while the node is not active."""
        return Heartbeat(self, DiagnosticArray, '/diagnostics', STATUS_PERIOD, self._state_message)

    def _state_message(self) -> DiagnosticArray:
        name = f'{self.get_fully_qualified_name()}: registration'
        state = str(self._state_machine.current_state[1])
        return DiagnosticArray(status=[diagnosis(name, DiagnosticStatus.OK, state, {})])

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Warm up."""
        return self._tried(self.configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe and publish."""
        result = self._tried(self.open_topics)
        self._is_active = result == TransitionCallbackReturn.SUCCESS
        if self._is_active:
            self._drained.clear()
            self._activated.put(self.worker)
            self._bond = Bond.offered_by(self)
            self._status.end()
        else:
            self.close_topics()
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Publish the boxes held, then end topics and services."""
        self._is_active = False
        if self._bond is not None:
            self._bond.end()
        self.worker.stop()
        self._drained.wait()
        self.close_topics()
        self._status = self._inactive_status()
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget tracks and transforms."""
        del self._live
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Do the same as `on_deactivate` if the node is active."""
        if self._is_active:
            return self.on_deactivate(state)
        return TransitionCallbackReturn.SUCCESS

    def run_worker(self) -> None:
        """Process messages whenever the node is active, until `stop_worker`."""
        while True:
            worker = self._activated.get()
            if worker is None:
                return
            worker.run()
            self._drained.set()

    def stop_worker(self) -> None:
        """Make `run_worker` publish the boxes held, and return."""
        if self._is_active:
            self.worker.stop()
        self._activated.put(None)

    def _answer_change(
        self, change: AnswerChange, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        """Answer a request; rclpy raises for a transition that the present state does not have."""
        try:
            return change(request, response)
        except rclpy_implementation.RCLError:
            _, state = self._state_machine.current_state
            name = request.transition.label or request.transition.id
            self.get_logger().warning(f'the state {state!r} has no transition {name!r}: refused')
            response.success = False
            return response

    def _tried(self, step: Callable[[], None]) -> TransitionCallbackReturn:
        """Return whether a step succeeds; log its error."""
        try:
            step()
        except Exception as error:  # rclpy would discard it without a log entry
            kind = '' if isinstance(error, BoxregError) else f'{type(error).__name__}: '
            self.get_logger().error(f'{kind}{one_line(error)}')
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS
