"""Between the threads of the node: what has been received and waits for the worker."""

from __future__ import annotations

from collections import deque
from threading import Event, Lock
import time
from typing import Any, NamedTuple


class Message(NamedTuple):
    """A message as received, in the order and at the time of its arrival."""

    number: int
    topic: str
    content: Any
    received: float


class Inbox:
    """
    What waits for the worker: transforms, and a bounded number of clouds and of box arrays.

    Many more box arrays than clouds: those whose cloud was dropped cost the solver nothing, and
    come out in order with the others.

    Thread-safe: the executor puts, the worker takes; neither waits for the other.

    Parameters
    ----------
    capacity : int
        Clouds that may wait.

    Attributes
    ----------
    capacity : dict
        How many messages of each topic may wait.

    """

    def __init__(self, capacity: int) -> None:
        self.capacity = {'points': capacity, 'boxes': 20 * capacity}
        self._lock = Lock()
        self._number = 0
        self._news: deque[tuple[str, Any]] = deque()
        self._waiting: dict[str, deque[Message]] = {
            topic: deque() for topic in ('points', 'boxes', 'passing')
        }
        self.news = Event()

    def put_news(self, topic: str, content: Any) -> None:
        """Take transforms or a wish; none is dropped, the worker is quick with them."""
        self._news.append((topic, content))
        self.news.set()

    def put(self, topic: str, content: Any) -> Message | None:
        """Take a cloud or boxes; return the oldest of its kind if there are too many."""
        with self._lock:
            self._number += 1
            queue = self._waiting[topic]
            queue.append(Message(self._number, topic, content, time.monotonic()))
            dropped = queue.popleft() if len(queue) > self.capacity[topic] else None
        self.news.set()
        return dropped

    def let_pass(self, message: Message) -> None:
        """Have `take` return boxes that were dropped, in their turn, as of topic ``passing``."""
        with self._lock:
            self._waiting['passing'].append(message._replace(topic='passing'))
        self.news.set()

    def take_news(self) -> list[tuple[str, Any]]:
        """Return what has come by `put_news` since the last call."""
        return [self._news.popleft() for _ in range(len(self._news))]

    def take(self) -> Message | None:
        """Return the cloud or boxes that have waited longest."""
        with self._lock:
            filled = [queue for queue in self._waiting.values() if queue]
            return min(filled, key=lambda queue: queue[0].number).popleft() if filled else None

    def sizes(self) -> dict[str, int]:
        """Return how many wait."""
        return {f'{topic}_waiting': len(queue) for topic, queue in self._waiting.items()}
