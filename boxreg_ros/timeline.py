"""Messages of a recording in one order, also where some were recorded apart from the others."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator
from heapq import merge
from itertools import chain, islice

from boxreg_ros.foxglove_mcap import Item, Reader
from rosbags.interfaces import Connection

APART_NS = 10**9
"""Received so much earlier or later than clouds of their stamp, messages were recorded apart."""

StampOf = Callable[[Connection, bytes], int | None]


class Timeline:
    """
    Messages by time of receipt, and by stamp those that were recorded apart from the clouds.

    A detector slower than the data, or boxes and odometry of another day in a file of their own,
    are received long after the clouds they belong to, or before. They take part as if they had
    come with the clouds of their stamp.

    Parameters
    ----------
    reader : Reader
        Open.
    points_topic : str
        Topic of the clouds, which the others are compared with.
    stamp_of : callable
        Returns the stamp of a message [ns], of any connection that is asked for; None if there is
        none.

    Attributes
    ----------
    apart : dict of str and float
        Topics found to be recorded apart, with how much later than the clouds [s].

    """

    def __init__(self, reader: Reader, points_topic: str, stamp_of: StampOf) -> None:
        self._reader, self._stamp_of = reader, stamp_of
        self._clouds = [c for c in reader.connections if c.topic == points_topic]
        self._known: dict[tuple[int, int], bool] = {}
        self._delays_ns: list[int] | None = None
        self.apart: dict[str, float] = {}

    def span_ns(self, topics: Collection[str]) -> tuple[int, int]:
        """Return begin and end [ns], without files in which `topics` were recorded apart."""
        files = {id(c.owner): self._reader.span_ns(c) for c in self._reader.connections}
        for connection in self._reader.connections:
            if connection.topic in topics and self._is_apart(connection):
                files.pop(id(connection.owner), None)
        files |= {id(c.owner): self._reader.span_ns(c) for c in self._clouds}
        begins, ends = zip(*files.values(), strict=True)
        return min(begins), max(ends)

    def messages(
        self, connections: Collection[Connection], start_ns: int | None, end_ns: int | None
    ) -> Iterator[Item]:
        """Yield connection, time of receipt [ns] and bytes, in the order of these times."""
        apart = [c for c in connections if self._is_apart(c)]
        together = [c for c in connections if c not in apart]
        streams = [self._reader.messages(together, start_ns, end_ns)]
        streams += [self._by_stamp(c, start_ns, end_ns) for c in apart]
        return merge(*streams, key=lambda item: item[1])

    def received_ns(self, topic: str, received_ns: int, stamp_ns: int) -> int:
        """Return when a message of this stamp counts as received [ns]."""
        due_ns = self._due_ns(stamp_ns) if topic in self.apart else None
        return received_ns if due_ns is None else due_ns

    def _by_stamp(
        self, connection: Connection, start_ns: int | None, end_ns: int | None
    ) -> Iterator[Item]:
        last_ns = self._span_of_clouds()[0]
        for _, _, data in self._reader.messages([connection], None, None):
            due_ns = self._due_ns(self._stamp_of(connection, data))
            # What has no place among the clouds keeps its place behind the message before.
            last_ns = last_ns if due_ns is None else due_ns
            if (start_ns is None or start_ns <= last_ns) and (end_ns is None or last_ns < end_ns):
                yield connection, last_ns, data

    def _is_apart(self, connection: Connection) -> bool:
        """Tell whether the first or the last message was received far from its clouds."""
        if connection in self._clouds:
            return False
        key = id(connection.owner), connection.id
        if key not in self._known:
            due = [(t, self._due_ns(stamp_ns)) for t, stamp_ns in self._ends(connection)]
            late_ns = max([0, *(t - due_ns for t, due_ns in due if due_ns is not None)], key=abs)
            self._known[key] = abs(late_ns) > APART_NS
            if self._known[key]:
                self.apart.setdefault(connection.topic, late_ns * 1e-9)
        return self._known[key]

    def _ends(self, connection: Connection) -> list[tuple[int, int]]:
        """Return time of receipt and stamp of the first and the last message, if known [ns]."""
        newest_ns = self._reader.span_ns(connection)[1] - APART_NS
        first = islice(self._reader.messages([connection], None, None), 1)
        last = deque(self._reader.messages([connection], newest_ns, None), maxlen=1)
        ends = [(t, self._stamp_of(connection, data)) for _, t, data in chain(first, last)]
        return [(t, stamp_ns) for t, stamp_ns in ends if stamp_ns is not None]

    def _due_ns(self, stamp_ns: int | None) -> int | None:
        """Return when a cloud of this stamp was received; None if there cannot be any [ns]."""
        if self._delays_ns is None:
            ends = [end for connection in self._clouds for end in self._ends(connection)]
            self._delays_ns = [received_ns - cloud_ns for received_ns, cloud_ns in ends]
        delays_ns = self._delays_ns
        # Where the clouds' own clock changes, as in a loop of playback, stamps give no order.
        if stamp_ns is None or not delays_ns or max(delays_ns) - min(delays_ns) > APART_NS:
            return None
        begin_ns, end_ns = self._span_of_clouds()
        due_ns = stamp_ns + delays_ns[0]
        return due_ns if begin_ns - APART_NS <= due_ns < end_ns + APART_NS else None

    def _span_of_clouds(self) -> tuple[int, int]:
        begins, ends = zip(*map(self._reader.span_ns, self._clouds), strict=True)
        return min(begins), max(ends)
