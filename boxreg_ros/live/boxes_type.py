"""Choice of the message type of the boxes among those published on their topic."""

from __future__ import annotations

import time

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.live.topics import (
    import_message,
    nodes_of,
    NodeTopics,
    PATIENCE,
    TopicProblem,
)
from diagnostic_msgs.msg import DiagnosticStatus
from msg_adapters import adapter_for, ADAPTERS
from msg_adapters.convention import Convention
from rclpy.topic_endpoint_info import TopicEndpointInfo


class BoxesTypeSearch:
    """
    Takes the first type, by name, that has an adapter and whose package is installed.

    `name` is that of the topic, resolved. The convention of the boxes decides whether types
    without track ids are accepted.

    """

    def __init__(self, topics: NodeTopics, name: str, convention: Convention) -> None:
        self._topics = topics
        self._name = name
        self._convention = convention
        self._types: set[str] = set()
        self._chosen = ''
        self._since = time.monotonic()

    def step(self) -> str:
        """
        Return the chosen type, or an empty text.

        The choice waits until two calls in a row see the same types: discovery reports
        publishers one by one.

        """
        types = _types_of(self._topics.box_publishers()[False])
        is_stable = types == self._types
        self._types = types
        readable, _ = self._sorted_out(types)
        if is_stable and readable:
            self._chosen = readable[0]
        return self._chosen

    def problems(self) -> list[TopicProblem]:
        """Return why no type could be chosen, or which other types the topic has beside it."""
        publishers = self._topics.box_publishers()
        types = _types_of(publishers[False])
        readable, errors = self._sorted_out(types)
        if self._chosen:
            others = [name for name in readable if name != self._chosen]
            if not others or self._chosen not in types:
                return []
            text = f'also has boxes of type {", ".join(others)}: set boxes_type if these are meant'
            return [TopicProblem(f'{self._name}: {text}')]
        if errors and not readable:
            return [TopicProblem(f'{self._name}: {errors[0]}', DiagnosticStatus.ERROR)]
        if types or not (publishers[True] or time.monotonic() >= self._since + PATIENCE):
            return []
        if not (publishers[True] or publishers[None]):
            return [self._topics.unpublished('boxes', set(ADAPTERS))]
        text = 'its publishers belong to no known node; set boxes_type if they send boxes'
        if publishers[True]:
            text = (
                f'has nothing but the refined boxes of {nodes_of(publishers[True])}; remap boxes '
                f'to their input, or set boxes_type if they are meant'
            )
        return [TopicProblem(f'{self._name}: {text}')]

    def _sorted_out(self, types: set[str]) -> tuple[list[str], list[str]]:
        """Return the types that can be read, sorted, and an error text for each of the others."""
        readable = []
        errors = []
        for name in sorted(types):
            try:
                adapter_for(name, self._convention)
                import_message(name)
            except UnsupportedMessage as error:
                errors.append(str(error))
            else:
                readable.append(name)
        return readable, errors


def _types_of(publishers: list[TopicEndpointInfo]) -> set[str]:
    """Return the message types of some publishers."""
    return {publisher.topic_type for publisher in publishers}
