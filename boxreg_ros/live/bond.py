"""The node's end of a bond: heartbeats by which a lifecycle manager sees that the node lives."""

from __future__ import annotations

from typing import Any
from uuid import uuid4

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.live.topics import import_message
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node

TOPIC = 'bond'
STATUS_TYPE = 'bond/msg/Status'
PERIOD = 0.1
"""Time between two heartbeats [s]; that of the nodes of Nav2."""
HEARTBEAT_TIMEOUT = 4.0
"""Silence after which the other end takes the bond for broken [s]; that of Nav2 by default."""
DEPTH = 10
"""Queue size: a second of heartbeats."""
END_HEARD_TIME = 1.0
"""Longest wait for the other end to take the last message [s]; ten of its heartbeats."""


class Bond:
    """
    Publish heartbeats on `TOPIC` until `end`, which announces the end.

    The manager has the other end and acts when heartbeats fail to come; the node does not depend
    on the manager. Both ends name the bond by the name of the node.

    Parameters
    ----------
    node : Node
        The node that lives.
    kind : type
        Class of the messages.

    """

    def __init__(self, node: Node, kind: Any) -> None:
        self._node = node
        self._status = kind(
            id=node.get_name(), instance_id=str(uuid4()), active=True,
            heartbeat_timeout=HEARTBEAT_TIMEOUT, heartbeat_period=PERIOD,
        )  # fmt: skip
        self._publisher = node.create_publisher(kind, TOPIC, DEPTH)
        # A steady clock: the manager's timeout runs on while /clock stands still.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(PERIOD, self._publish, clock=steady)

    @classmethod
    def offered_by(cls, node: Node) -> Bond | None:
        """Return a new bond; None, with a log entry, where its message type is not installed."""
        try:
            kind = import_message(STATUS_TYPE)
        except UnsupportedMessage as error:
            node.get_logger().info(f'no bond, set bond_timeout of a manager to 0.0: {error}')
            return None
        return cls(node, kind)

    def end(self) -> None:
        """Announce the end of the bond, and publish no more."""
        self._node.destroy_timer(self._timer)
        self._status.active = False
        self._publish()
        # A publisher that is destroyed takes along what was not acknowledged.
        self._publisher.wait_for_all_acked(Duration(seconds=END_HEARD_TIME))
        self._node.destroy_publisher(self._publisher)

    def _publish(self) -> None:
        self._status.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(self._status)
