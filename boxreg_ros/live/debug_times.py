"""The times that Autoware looks for below ``~/debug``: of processing, and of the pipeline."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.live.topics import import_message, NodeTopics
from rclpy.time import Time

AUTOWARE_TYPE = 'autoware_internal_debug_msgs/msg/Float64Stamped'
PLAIN_TYPE = 'std_msgs/msg/Float64'
"""Used where the messages of Autoware are not installed."""
PROCESSING_TOPIC = '~/debug/processing_time_ms'
"""From complete data to published early boxes."""
LATENCY_TOPIC = '~/debug/pipeline_latency_ms'
"""From the stamp of the early boxes to the time when they are published."""
DEPTH = 10


class DebugTimes:
    """Publish the times of early boxes, while somebody subscribes; `now` returns the time."""

    def __init__(self, topics: NodeTopics, now: Callable[[], Time]) -> None:
        type_name = AUTOWARE_TYPE
        try:
            import_message(type_name)
        except UnsupportedMessage:
            type_name = PLAIN_TYPE
        self._kind: Any = import_message(type_name)
        self._now = now
        self._processing = topics.publish(type_name, PROCESSING_TOPIC, DEPTH)
        self._latency = topics.publish(type_name, LATENCY_TOPIC, DEPTH)

    def add(self, stamp_ns: int, seconds: float) -> None:
        """Publish the times of boxes with a stamp, which took a time from complete data [s]."""
        publishers = [self._processing, self._latency]
        if not any(publisher.get_subscription_count() for publisher in publishers):
            return
        now = self._now()
        times = (1e3 * seconds, 1e-6 * (now.nanoseconds - stamp_ns))  # [ms]
        for publisher, milliseconds in zip(publishers, times, strict=True):
            if publisher is self._latency and not now.nanoseconds:
                continue  # /clock has not come
            message = self._kind(data=milliseconds)
            if hasattr(message, 'stamp'):
                message.stamp = now.to_msg()
            publisher.publish(message)
