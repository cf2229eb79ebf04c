"""
Re-synchronisation: messages that were recorded apart from the clouds are merged by stamp.

Receive times order a recording only if all topics were recorded together and without delay. A
detector slower than the data, or boxes and odometry of another day in a file of their own, are
received long after the clouds of their stamps, or before.

"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from functools import cached_property
from heapq import merge
from itertools import islice

from boxreg_ros.io.clocks import COPY_NS
from boxreg_ros.io.storage.reader import Reader
from boxreg_ros.io.storage.record import Record
from msg_adapters import ADAPTERS
from rosbags.interfaces import Connection

APART_NS = 10**9
"""
Difference of receive times to the clouds of the same stamp that means recorded apart [ns].

A live detector is slower than its clouds by 0.1 to 0.5 s; that order is the order of the node.

"""

COPIES = 3
"""Messages of boxes whose stamps are compared with those of clouds; chosen."""
NEAR_NS = 2 * 10**8
"""Clouds are looked for so near to when one of a stamp is received [ns]; their delay varies."""

StampOf = Callable[[Connection, bytes], int | None]


class MessageOrder:
    """
    Order messages by receive time, and those recorded apart from the clouds by stamp.

    A message that was recorded apart gets the receive time of a cloud of its stamp. That is
    possible where clouds were received with a constant delay after their stamps; it is not where a
    recording was played in a loop or paused, and receive times are kept there. Where all receive
    times are equal, as 0, all messages are ordered by stamp. `stamp_of` returns
    the stamp of a message [ns], None if it has none; `apart` has the topics that were recorded
    apart, and how much later than the clouds [s]. Of these `as_slow` has boxes that were recorded
    together with the clouds, as those of a slow detector are.

    """

    def __init__(self, reader: Reader, points_topic: str, stamp_of: StampOf) -> None:
        self._reader = reader
        self._stamp_of = stamp_of
        self._clouds = [c for c in reader.connections if c.topic == points_topic]
        self._begin_ns, self._end_ns = self._span(self._clouds)
        count = sum(connection.msgcount for connection in self._clouds)
        self._lacks_times = count > 1 and self._end_ns - self._begin_ns <= 1
        if self._lacks_times:
            ends = [stamp for connection in self._clouds for _, stamp in self._ends(connection)]
            self._lacks_times = bool(ends)
            self._begin_ns = min(ends, default=self._begin_ns)
            self._end_ns = max(ends, default=self._end_ns) + 1
        self._known: dict[tuple[int, int], bool] = {}
        self.apart: dict[str, float] = {}
        self.as_slow: dict[str, float] = {}

    def span_ns(self, topics: Collection[str]) -> tuple[int, int]:
        """Return begin and end of the files with clouds, or with `topics` not apart [ns]."""
        if self._lacks_times:
            return self._begin_ns, self._end_ns
        used = [c for c in self._reader.connections if c.topic in topics and c.msgcount]
        return self._span([*self._clouds, *(c for c in used if not self._is_apart(c))])

    @property
    def finding(self) -> str:
        """Return that the messages have no receive times; empty if they have."""
        if not self._lacks_times:
            return ''
        return (
            'receive times: expected those of the messages, got the same for all of them, as 0 in '
            'log_time; messages are ordered by the stamps of their headers'
        )

    @property
    def parts_ns(self) -> list[tuple[int, int]]:
        """Return begin and end of the clouds [ns]; several where files were recorded apart."""
        first, *others = sorted(map(self._reader.span_ns, self._clouds))
        parts = [first]
        for begin_ns, end_ns in others:
            last_begin_ns, last_end_ns = parts[-1]
            if begin_ns - last_end_ns > APART_NS:
                parts.append((begin_ns, end_ns))
            else:
                parts[-1] = last_begin_ns, max(last_end_ns, end_ns)
        return parts

    def messages(
        self, connections: Collection[Connection], start_ns: int | None, end_ns: int | None
    ) -> Iterator[Record]:
        """Yield the messages in the order of their receive times."""
        apart = [c for c in connections if self._lacks_times or self._is_apart(c)]
        together = [c for c in connections if c not in apart]
        streams = [self._reader.messages(together, start_ns, end_ns)]
        streams += [self._by_stamp(c, start_ns, end_ns) for c in apart]
        return merge(*streams, key=lambda record: record.received_ns)

    def received_ns(self, connection: Connection, received_ns: int, data: bytes) -> int:
        """Return the receive time that a message on one of the topics `apart` gets [ns]."""
        due_ns = self._due_ns(self._stamp_of(connection, data))
        if due_ns is None or abs(received_ns - due_ns) < APART_NS:
            return received_ns
        return due_ns

    def _by_stamp(
        self, connection: Connection, start_ns: int | None, end_ns: int | None
    ) -> Iterator[Record]:
        last_ns = self._begin_ns
        for record in self._reader.messages([connection], None, None):
            due_ns = self._due_ns(self._stamp_of(connection, record.data))
            if due_ns is not None:  # else it stays behind the message before it
                last_ns = due_ns
            if (start_ns is None or start_ns <= last_ns) and (end_ns is None or last_ns < end_ns):
                yield record._replace(received_ns=last_ns)

    def _is_apart(self, connection: Connection) -> bool:
        """Return whether the first or the last message was received far from its clouds."""
        if connection in self._clouds:
            return False
        key = id(connection.owner), connection.id
        if key not in self._known:
            late_ns = self._late_ns(connection)
            is_apart = abs(late_ns) > APART_NS
            self._known[key] = is_apart and not self._has_other_clock(connection, late_ns)
            if self._known[key]:
                self.apart.setdefault(connection.topic, late_ns * 1e-9)
        return self._known[key]

    def _has_other_clock(self, connection: Connection, late_ns: int) -> bool:
        """
        Return whether a topic was recorded with the clouds, but stamped by another clock.

        Its receive times then begin and end with those of the clouds, its stamps do not. Boxes
        that are late may also be those of a slow detector, whose stamps are right: it copies them
        from the clouds.

        """
        ends = self._ends(connection)
        clouds = [received_ns for received_ns, _ in self._cloud_ends]
        first_ns, last_ns = min(clouds), max(clouds)
        due = [stamp_ns + (self._delay_ns or 0) for _, stamp_ns in ends]
        received = abs(ends[0][0] - first_ns) + abs(ends[-1][0] - last_ns)
        stamped = abs(due[0] - first_ns) + abs(due[-1] - last_ns)
        if received >= stamped / 2:
            return False
        if late_ns > 0 and connection.msgtype in ADAPTERS and self._are_copied(connection):
            self.as_slow[connection.topic] = late_ns * 1e-9
            return False
        return True

    def _are_copied(self, connection: Connection) -> bool:
        """Return whether boxes have stamps of clouds; True if no cloud is where they would be."""
        found = []
        for _, stamp_ns in self._stamped(connection, None):
            due_ns = self._due_ns(stamp_ns)
            if due_ns is None or not self._begin_ns <= due_ns <= self._end_ns:
                continue
            near = self._reader.messages(self._clouds, due_ns - NEAR_NS, due_ns + NEAR_NS)
            stamps = (self._stamp_of(record.connection, record.data) for record in near)
            offsets = [abs(stamp_ns - stamp) for stamp in stamps if stamp is not None]
            found.append(min(offsets, default=0) <= COPY_NS)
            if len(found) == COPIES:
                break
        return all(found)

    def _late_ns(self, connection: Connection) -> int:
        """Return the larger delay of the first and the last message [ns]; 0 if unknown."""
        delay_ns = self._delay_ns
        if delay_ns is None:
            return 0
        due = [(t, stamp_ns + delay_ns) for t, stamp_ns in self._ends(connection)]
        among = [(t, due_ns) for t, due_ns in due if self._is_among(due_ns)]
        # Both ends may lie outside: the topic begins before the clouds and ends after them.
        if not among and due and due[0][1] < self._begin_ns < self._end_ns < due[-1][1]:
            among = due
        return max((t - due_ns for t, due_ns in among), key=abs, default=0)

    def _ends(self, connection: Connection) -> list[tuple[int, int]]:
        """Return receive time and stamp of the first and the last message with a stamp [ns]."""
        begin_ns, end_ns = self._reader.span_ns(connection)
        ends = list(islice(self._stamped(connection, None), 1))
        window_ns = APART_NS // 10
        while len(ends) == 1:  # search backwards from the end in windows of doubled size
            start_ns = end_ns - window_ns
            found = self._stamped(connection, start_ns if start_ns > begin_ns else None)
            ends += deque(found, maxlen=1)
            window_ns *= 2
        return ends

    def _stamped(self, connection: Connection, start_ns: int | None) -> Iterator[tuple[int, int]]:
        for record in self._reader.messages([connection], start_ns, None):
            stamp_ns = self._stamp_of(connection, record.data)
            if stamp_ns is not None:
                yield record.received_ns, stamp_ns

    @cached_property
    def _cloud_ends(self) -> list[tuple[int, int]]:
        """Return receive times and stamps of the first and the last clouds [ns]."""
        return [end for connection in self._clouds for end in self._ends(connection)]

    @cached_property
    def _delay_ns(self) -> int | None:
        """Return the delay of the clouds after their stamps [ns]; None if it is not constant."""
        delays = [received_ns - stamp_ns for received_ns, stamp_ns in self._cloud_ends]
        if self._lacks_times:
            return 0
        # It changes when playback loops or pauses: stamps do not order the messages then.
        if not delays or max(delays) - min(delays) >= APART_NS:
            return None
        return delays[0]

    def _due_ns(self, stamp_ns: int | None) -> int | None:
        """Return the receive time of a cloud of this stamp [ns]; None if there can be no such."""
        if stamp_ns is None or self._delay_ns is None:
            return None
        due_ns = stamp_ns + self._delay_ns
        return due_ns if self._is_among(due_ns) else None

    def _is_among(self, due_ns: int) -> bool:
        return self._begin_ns - APART_NS <= due_ns < self._end_ns + APART_NS

    def _span(self, connections: Iterable[Connection]) -> tuple[int, int]:
        begins, ends = zip(*map(self._reader.span_ns, connections), strict=True)
        return min(begins), max(ends)
