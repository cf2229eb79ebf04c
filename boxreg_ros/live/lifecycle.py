"""The live node as a lifecycle node, for launch files and managers that start nodes in order."""

from __future__ import annotations

from collections.abc import Callable
from queue import Queue
from threading import Event

from boxreg_ros.errors import BoxregError
from boxreg_ros.live.node import BoxregNode
from boxreg_ros.live.recording import RECORDING_TIME
from boxreg_ros.live.worker import Worker
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn


class BoxregLifecycleNode(LifecycleNodeMixin, BoxregNode):
    """
    `BoxregNode` with the states of a managed node.

    ``configure`` takes the values of the parameters and warms up, ``activate`` creates topics and
    services, ``deactivate`` publishes the boxes held and destroys them, ``cleanup`` forgets tracks
    and transforms. A transition that an error prevents is refused and logged in one line.

    """

    def __init__(self) -> None:
        BoxregNode.__init__(self)
        LifecycleNodeMixin.__init__(self)
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
        else:
            self.close_topics()
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Publish the boxes held, then end topics and services."""
        self._is_active = False
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

    def _tried(self, step: Callable[[], None]) -> TransitionCallbackReturn:
        """Return whether a step succeeds; log its error."""
        try:
            step()
        except Exception as error:  # rclpy would discard it without a log entry
            kind = '' if isinstance(error, BoxregError) else f'{type(error).__name__}: '
            self.get_logger().error(f'{kind}{" ".join(str(error).split())}')
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS
