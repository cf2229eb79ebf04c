"""Messages of boxes of one stamp, joined for the registrar and divided again for publishing."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from math import inf
from typing import Any, NamedTuple

from boxreg_ros.io.items import Item
from boxreg_ros.io.joining import are_parts, JOIN_NS, joined
from boxreg_ros.structures import BoxArray, Floats
from msg_adapters import Adapter

JOIN_TIME = JOIN_NS * 1e-9
"""The first of several messages of one stamp waits so long for the others [s]."""


class Parts(NamedTuple):
    """The messages of one stamp, in place of a single one, and the number of boxes of each."""

    messages: tuple[Any, ...]
    counts: tuple[int, ...]


class Bursts:
    """
    Join the messages of boxes of one stamp.

    The first message of a stream waits for others of its stamp. If there are none, later ones do
    not wait, until two of one stamp arrive: only publishers of several messages cost time. Not
    thread-safe.

    """

    def __init__(self) -> None:
        self.held: Item | None = None
        """The message, or those joined so far, that wait for others of their stamp."""
        self._is_known = True
        self._last: BoxArray | None = None

    def add(self, item: Item) -> list[Item]:
        """Add a message of boxes; return those that are whole, in their order."""
        content = item.content
        assert isinstance(content, BoxArray)
        held = self.held
        if held is not None:
            assert isinstance(held.content, BoxArray)
            if are_parts(held.content, content):
                self.held = _joined(held, item)
                return []
        ready = self.release()
        if self._last is not None and are_parts(self._last, content):
            self._is_known = True
        if self._is_known:
            self.held = item
            return ready
        self._last = content
        return [*ready, item]

    def release(self, now: float = inf) -> list[Item]:
        """Return what has waited long enough at a time [s]; by default whatever waits."""
        held = self.held
        if held is None or now < held.received + JOIN_TIME:
            return []
        self.held = None
        assert isinstance(held.content, BoxArray)
        is_first = self._last is None
        self._last = held.content
        if is_first and not isinstance(held.message, Parts):
            self._is_known = False
        return [held]


class JoiningAdapter:
    """An adapter that also takes `Parts` as a message: they are read as one, and written again."""

    def __init__(self, adapter: Adapter) -> None:
        self._adapter = adapter

    def from_msg(self, msg: Any) -> BoxArray:
        """Return the boxes of all messages, see `Adapter.from_msg`."""
        if not isinstance(msg, Parts):
            return self._adapter.from_msg(msg)
        return reduce(joined, map(self._adapter.from_msg, msg.messages))

    def to_msg(
        self,
        msg: Any,
        boxes: BoxArray,
        covariances: Floats | None = None,
        T_out_in: Floats | None = None,
    ) -> Any:
        """Return copies with the boxes replaced, each with its own, see `Adapter.to_msg`."""
        if not isinstance(msg, Parts):
            return self._adapter.to_msg(msg, boxes, covariances, T_out_in)
        replaced = []
        begin = 0
        for message, count in zip(*msg, strict=True):
            rows = slice(begin, begin + count)
            own = None if covariances is None else covariances[rows]
            replaced.append(self._adapter.to_msg(message, _rows(boxes, rows), own, T_out_in))
            begin += count
        return msg._replace(messages=tuple(replaced))

    def with_added(self, msg: Any, sources: Sequence[tuple[Any, int]]) -> Any:
        """Return a copy with boxes of earlier messages behind the last ones of its own."""
        of_parts = [_source(*source) for source in sources]
        if not isinstance(msg, Parts):
            return self._adapter.with_added(msg, of_parts)
        last = self._adapter.with_added(msg.messages[-1], of_parts)
        return Parts((*msg.messages[:-1], last), (*msg.counts[:-1], msg.counts[-1] + len(sources)))


def messages_of(message: Any) -> tuple[Any, ...]:
    """Return the messages to publish for one, or for `Parts`."""
    return message.messages if isinstance(message, Parts) else (message,)


def _joined(held: Item, item: Item) -> Item:
    """Return the message, or messages, of a stamp with another one."""
    first, more = held.content, item.content
    assert isinstance(first, BoxArray) and isinstance(more, BoxArray)
    parts = held.message
    if not isinstance(parts, Parts):
        parts = Parts((parts,), (len(first.track_ids),))
    parts = Parts((*parts.messages, item.message), (*parts.counts, len(more.track_ids)))
    return held._replace(content=joined(first, more), message=parts)


def _rows(boxes: BoxArray, rows: slice) -> BoxArray:
    return boxes.take(range(len(boxes.track_ids))[rows])


def _source(message: Any, row: int) -> tuple[Any, int]:
    """Return the message among `Parts` that a row of all is in, and its row there."""
    if not isinstance(message, Parts):
        return message, row
    for part, count in zip(*message, strict=True):
        if row < count:
            return part, row
        row -= count
    raise IndexError('row: expected one of the messages, got one behind them')
