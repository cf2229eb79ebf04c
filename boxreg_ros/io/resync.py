"""Messages of a recording in one order, also where some were recorded apart from the others."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from functools import cached_property
from heapq import merge
from itertools import islice

from boxreg_ros.io.message_files import EncodedMessage, Reader
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
        Returns the stamp of a message [ns]; None where there is none.

    Attributes
    ----------
    apart : dict of str and float
        Topics found to be recorded apart, with how much later than the clouds [s].

    """

    def __init__(self, reader: Reader, points_topic: str, stamp_of: StampOf) -> None:
        self._reader, self._stamp_of = reader, stamp_of
        self._clouds = [c for c in reader.connections if c.topic == points_topic]
        self._begin_ns, self._end_ns = self._span(self._clouds)
        self._known: dict[tuple[int, int], bool] = {}
        self.apart: dict[str, float] = {}

    def span_ns(self, topics: Collection[str]) -> tuple[int, int]:
        """Return begin and end of the files with clouds, or with `topics` not apart [ns]."""
        used = [c for c in self._reader.connections if c.topic in topics and c.msgcount]
        return self._span([*self._clouds, *(c for c in used if not self._is_apart(c))])

    def messages(
        self, connections: Collection[Connection], start_ns: int | None, end_ns: int | None
    ) -> Iterator[EncodedMessage]:
        """Yield connection, time of receipt [ns] and bytes, in the order of these times."""
        apart = [c for c in connections if self._is_apart(c)]
        together = [c for c in connections if c not in apart]
        streams = [self._reader.messages(together, start_ns, end_ns)]
        streams += [self._by_stamp(c, start_ns, end_ns) for c in apart]
        return merge(*streams, key=lambda item: item[1])

    def received_ns(self, connection: Connection, received_ns: int, data: bytes) -> int:
        """Return when a message on one of the topics `apart` counts as received [ns]."""
        due_ns = self._due_ns(self._stamp_of(connection, data))
        return received_ns if due_ns is None or abs(received_ns - due_ns) < APART_NS else due_ns

    def _by_stamp(
        self, connection: Connection, start_ns: int | None, end_ns: int | None
    ) -> Iterator[EncodedMessage]:
        last_ns = self._begin_ns
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
            late_ns = self._late_ns(connection)
            self._known[key] = abs(late_ns) > APART_NS
            if self._known[key]:
                self.apart.setdefault(connection.topic, late_ns * 1e-9)
        return self._known[key]

    def _late_ns(self, connection: Connection) -> int:
        """Return how late the first or the last message was, whichever is more; 0 if unknown."""
        delay_ns = self._delay_ns
        if delay_ns is None:
            return 0
        due = [(t, stamp_ns + delay_ns) for t, stamp_ns in self._ends(connection)]
        among = [(t, due_ns) for t, due_ns in due if self._is_among(due_ns)]
        # Both may be outside: what begins before the first cloud and ends after the last.
        if not among and due and due[0][1] < self._begin_ns < self._end_ns < due[-1][1]:
            among = due
        return max((t - due_ns for t, due_ns in among), key=abs, default=0)

    def _ends(self, connection: Connection) -> list[tuple[int, int]]:
        """Return time of receipt and stamp of the first and the last message with a stamp [ns]."""
        begin_ns, end_ns = self._reader.span_ns(connection)
        ends = list(islice(self._stamped(connection, None), 1))
        window_ns = APART_NS // 10
        while len(ends) == 1:  # from the end backward, further and further
            start_ns = end_ns - window_ns
            found = self._stamped(connection, start_ns if start_ns > begin_ns else None)
            ends += deque(found, maxlen=1)
            window_ns *= 2
        return ends

    def _stamped(self, connection: Connection, start_ns: int | None) -> Iterator[tuple[int, int]]:
        for _, received_ns, data in self._reader.messages([connection], start_ns, None):
            if (stamp_ns := self._stamp_of(connection, data)) is not None:
                yield received_ns, stamp_ns

    @cached_property
    def _delay_ns(self) -> int | None:
        """How long after their stamps clouds were received [ns]; None where that changes."""
        ends = [end for connection in self._clouds for end in self._ends(connection)]
        delays = [received_ns - stamp_ns for received_ns, stamp_ns in ends]
        # It does in a loop of playback, and when playback is paused: stamps give no order then.
        return delays[0] if delays and max(delays) - min(delays) < APART_NS else None

    def _due_ns(self, stamp_ns: int | None) -> int | None:
        """Return when a cloud of this stamp was received [ns]; None if there cannot be any."""
        if stamp_ns is None or self._delay_ns is None:
            return None
        due_ns = stamp_ns + self._delay_ns
        return due_ns if self._is_among(due_ns) else None

    def _is_among(self, due_ns: int) -> bool:
        return self._begin_ns - APART_NS <= due_ns < self._end_ns + APART_NS

    def _span(self, connections: Iterable[Connection]) -> tuple[int, int]:
        begins, ends = zip(*map(self._reader.span_ns, connections), strict=True)
        return min(begins), max(ends)
