"""The live node as a lifecycle node, for launch files and managers that start nodes in order."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from queue import Queue
from threading import Event

from boxreg_ros.errors import BoxregError
from boxreg_ros.live.bond import Bond
from boxreg_ros.live.label_recording import RECORDING_TIME
from boxreg_ros.live.node import BoxregNode
from boxreg_ros.live.worker import Worker
from lifecycle_msgs.srv import ChangeState
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn

AnswerChange = Callable[[ChangeState.Request, ChangeState.Response], ChangeState.Response]


class BoxregLifecycleNode(LifecycleNodeMixin, BoxregNode):
    """
    `BoxregNode` with the states of a managed node.

    ``configure`` takes the values of the parameters and warms up, ``activate`` creates topics and
    services, ``deactivate`` publishes the boxes held and destroys them, ``cleanup`` forgets tracks
    and transforms. A transition that an error prevents, or that the present state does not have,
    is refused and logged in one line. While the node is active it keeps its end of a bond.

    """

    def __init__(self) -> None:
        BoxregNode.__init__(self)
        LifecycleNodeMixin.__init__(self)
        service = self._service_change_state
        service.callback = partial(self._answer_change, service.callback)
        self._bond: Bond | None = None
        self._activated = Queue[Worker | None]()
        self._drained = Event()
        self._is_active = False

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
        self.recording.wait(RECORDING_TIME)
        self.close_topics()
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
            self.get_logger().error(f'{kind}{" ".join(str(error).split())}')
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS
