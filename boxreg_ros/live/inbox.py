"""Queue between the two threads of the node: the executor puts messages, the worker takes them."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Collection
from functools import partial
from itertools import pairwise
from statistics import median
from threading import Event, Lock
import time
from typing import Any, NamedTuple

BOXES_PER_CLOUD = 20
"""Capacity for box arrays relative to that for clouds. Arrays whose cloud was dropped cost no
solver time and are published in order with the others, so many more of them than of clouds may
wait."""

RECENT_CLOUDS = 10
"""Last clouds that show whether the node keeps up; chosen: a second at 10 Hz."""
SLOWER = 1.05
"""Period of clouds taken, in periods of their arrival, from which on the node does not keep up;
chosen: a solver that is 5 % too slow fills a backlog of 0.5 s in ten seconds."""


class Message(NamedTuple):
    """A received message."""

    number: int  # order of arrival
    topic: str  # ``points``, ``boxes`` or ``passing``
    content: Any
    received_ns: int  # time of arrival (monotonic)
    lidar: str = ''  # topic of a cloud, where those of several are merged


class Inbox:
    """
    Bounded queues of clouds and box arrays, and an unbounded one of events.

    Events are info messages, boxes to follow, lost clouds, parameter changes and service requests.
    The worker handles them before the next message. Thread-safe: neither thread waits for the
    other. `capacity` is the number of clouds of each LiDAR that may wait; the attribute has it by
    topic. `wake_up` is set whenever something was put.

    """

    def __init__(self, capacity: int, lidars: int = 1) -> None:
        self.capacity = {'points': lidars * capacity, 'boxes': BOXES_PER_CLOUD * capacity}
        self.wake_up = Event()
        self._lock = Lock()
        self._number = 0
        self._events: deque[Callable[[], None]] = deque()
        self._waiting: dict[str, deque[Message]] = {
            topic: deque() for topic in ('points', 'boxes', 'passing')
        }

    def put_event(self, handle: Callable[..., None], *content: Any) -> None:
        """Add an event, which the worker handles by calling `handle`; none is ever dropped."""
        self._events.append(partial(handle, *content))
        self.wake_up.set()

    def put(self, topic: str, content: Any, lidar: str = '') -> Message | None:
        """
        Add a cloud or box array to its queue.

        Parameters
        ----------
        topic : str
            ``points`` or ``boxes``.
        content : object
            The message.
        lidar : str
            Topic of a cloud, where those of several are merged.

        Returns
        -------
        dropped : Message or None
            The oldest one of its queue if that has more than its `capacity`.

        """
        dropped = None
        with self._lock:
            self._number += 1
            queue = self._waiting[topic]
            queue.append(Message(self._number, topic, content, time.monotonic_ns(), lidar))
            if len(queue) > self.capacity[topic]:
                dropped = queue.popleft()
        self.wake_up.set()
        return dropped

    def put_passing(self, message: Message) -> None:
        """Return a dropped box array to its place in the order, as topic ``passing``."""
        with self._lock:
            self._waiting['passing'].append(message._replace(topic='passing'))
        self.wake_up.set()

    def take_events(self) -> list[Callable[[], None]]:
        """Remove and return all events, oldest first."""
        return [self._events.popleft() for _ in range(len(self._events))]

    def take(self) -> Message | None:
        """Remove and return the message that arrived first, or None."""
        with self._lock:
            filled = [queue for queue in self._waiting.values() if queue]
            if not filled:
                return None
            return min(filled, key=lambda queue: queue[0].number).popleft()

    def has_newer(self, cloud: Message) -> bool:
        """Return whether a later cloud of the same LiDAR waits."""
        with self._lock:
            return any(other.lidar == cloud.lidar for other in self._waiting['points'])

    def sizes(self) -> dict[str, int]:
        """Return the number of waiting messages per topic."""
        return {f'{topic}_waiting': len(queue) for topic, queue in self._waiting.items()}


class CloudPatience:
    """
    Decide which clouds are dropped, because the solver is slower than the data.

    A cloud may wait `backlog` [s]. Where the clouds of a LiDAR are taken less often than they
    arrive, by the medians of the last ones, the node does not catch up, and would publish all
    boxes late by the backlog: meanwhile each cloud that has waited longer than the deadline gives
    way to a newer one. Delays that end leave the medians as they are: all clouds are taken, in
    order.

    """

    def __init__(self, backlog: float) -> None:
        self.backlog = backlog
        self._arrived = defaultdict[str, deque[float]](partial(deque[float], maxlen=RECENT_CLOUDS))
        self._taken = defaultdict[str, deque[float]](partial(deque[float], maxlen=RECENT_CLOUDS))

    def is_overdue(
        self, cloud: Message, since: float, now: float, deadline: float, has_newer: bool
    ) -> bool:
        """
        Return whether to drop a cloud; each is asked for once.

        Parameters
        ----------
        cloud : Message
            The oldest one that waits.
        since, now : float
            When it could have been taken, and the time (monotonic) [s].
        deadline : float
            For its boxes [s].
        has_newer : bool
            Whether a later cloud of the same LiDAR waits.

        """
        arrived, taken = self._arrived[cloud.lidar], self._taken[cloud.lidar]
        arrived.append(cloud.received_ns * 1e-9)
        waited = now - since
        if waited > self.backlog:
            return True
        if waited > deadline and has_newer and _period(taken) > SLOWER * _period(arrived):
            return True
        taken.append(now)
        return False


def _period(times: Collection[float]) -> float:
    """Return the median time step; 0 while less than half of `RECENT_CLOUDS` are known."""
    steps = [after - before for before, after in pairwise(times)]
    return median(steps) if 2 * len(steps) >= RECENT_CLOUDS else 0.0
