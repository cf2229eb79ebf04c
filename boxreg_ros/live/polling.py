"""Subscriptions that are read when their messages are needed, not whenever one arrives."""

from __future__ import annotations

from collections.abc import Iterator
import time
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.time_source import CLOCK_TOPIC

NO_EVENTS = SubscriptionEventCallbacks(use_default_callbacks=False)
"""
Of polled subscriptions. An executor that waits for events of a subscription, and not for its
messages, wakes again and again while messages wait: with rclpy 7 and Fast DDS 2.14 for 0.8 cores.

"""


class PolledGroup(CallbackGroup):
    """
    A group whose subscriptions no executor waits for; `taken` returns their messages.

    An executor of rclpy takes a millisecond of CPU for each message. TF, odometry and /clock come
    hundreds of times a second, and are needed once for each cloud.

    """

    def can_execute(self, entity: Any) -> bool:
        """Return False: no executor waits for an entity."""
        return False

    def beginning_execution(self, entity: Any) -> bool:
        """Return False: no executor may handle an entity."""
        return False

    def ending_execution(self, entity: Any) -> None:
        """Do nothing: none has begun."""


def taken(subscription: Any) -> Iterator[tuple[Any, int]]:
    """Yield the messages that wait, oldest first, and when each was received (monotonic) [ns]."""
    now_ns = time.monotonic_ns()
    offset_ns = now_ns - time.time_ns()
    while True:
        with subscription.handle:
            found = subscription.handle.take_message(subscription.msg_type, subscription.raw)
        if found is None:
            return
        message, info = found
        # On the system clock, which can be set; 0 if the middleware does not report it.
        received_ns = info['received_timestamp']
        yield message, min(now_ns, received_ns + offset_ns) if received_ns else now_ns


class PolledClockNode(Node):
    """A node that reads /clock when it is asked for the time, with `use_sim_time`."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self._clock_group = PolledGroup()
        self._clock_subscription: Any = None
        super().__init__(*args, **options)

    def create_subscription(self, msg_type: Any, topic: str, *args: Any, **options: Any) -> Any:
        """Create a subscription, see `Node`; no executor waits for that of rclpy to /clock."""
        if topic != CLOCK_TOPIC:
            return super().create_subscription(msg_type, topic, *args, **options)
        options |= {'callback_group': self._clock_group, 'event_callbacks': NO_EVENTS}
        made = super().create_subscription(msg_type, topic, *args, **options)
        self._clock_subscription = made
        return made

    def destroy_subscription(self, subscription: Subscription) -> bool:
        """Destroy a subscription, see `Node`."""
        if subscription is self._clock_subscription:
            self._clock_subscription = None
        return super().destroy_subscription(subscription)

    def get_clock(self) -> Clock:
        """Return the clock of the node, at the newest time of /clock."""
        if self._clock_subscription is not None:
            for message, _ in taken(self._clock_subscription):
                self._clock_subscription.callback(message)
        return super().get_clock()
