"""Messages as they were recorded, and the parts of a file that cannot be read."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import NamedTuple, Protocol

from boxreg_ros.errors import BoxregError, one_line, RecordingError, TransferError, unreadable
from rosbags.interfaces import Connection

NO_MESSAGES_NS = (2**63 - 1, 0)
"""Begin and end of a file without messages, as in rosbags [ns]."""


class Record(NamedTuple):
    """One message as it was recorded, still encoded."""

    connection: Connection
    """Topic and type; its `owner` is the file."""
    received_ns: int
    data: bytes
    published_ns: int = 0
    """Of MCAP files [ns]; else equal to `received_ns`."""
    sequence: int = 0


class Damage(NamedTuple):
    """Part of a file that cannot be read."""

    file: str
    reason: str
    """Kind of the damage."""
    first_byte: int | None = None
    end_byte: int | None = None
    """End of its byte range; None where the format has none (rows of a database)."""
    start_ns: int | None = None
    end_ns: int | None = None
    """End of the receive times that are affected [ns]; None where unknown."""

    def __str__(self) -> str:
        """Return the damage in one line."""
        parts = [self.reason]
        if self.first_byte is not None and self.end_byte is not None:
            parts.append(f'bytes {self.first_byte} to {self.end_byte}')
        if self.start_ns is not None and self.end_ns is not None:
            parts.append(f'received {self.start_ns * 1e-9:.3f} to {self.end_ns * 1e-9:.3f} s')
        return f'{self.file}: {", ".join(parts)}'


Damages = dict[Damage, None]
"""In the order in which they were found; each once, however often the part was read."""


class StorageFile(Protocol):
    """One open file of a recording, or several that belong together."""

    connections: list[Connection]
    """Topics with types and numbers of messages."""
    start_time: int
    end_time: int
    """Behind the last message, as `start_time` is that of the first [ns, received]."""
    damages: Damages
    """Known so far: some are found while messages are read."""

    def messages(
        self, connections: Collection[Connection], start: int | None, stop: int | None
    ) -> Iterator[Record]:
        """
        Yield the messages on some connections, ordered by receive time.

        Parameters
        ----------
        connections : collection of Connection
            Some of those of the file; none yield nothing.
        start, stop : int or None
            Receive times of the part to read [ns]: from `start` on, before `stop`; None for no
            limit.

        Yields
        ------
        record : Record
            Still encoded. A part that cannot be read is left out and added to `damages`.

        Raises
        ------
        RecordingError
            If the rest of the file cannot be read since its content is damaged.
        TransferError
            If its bytes cannot be read from their disk or server.

        """

    def spans(self) -> Iterator[tuple[int, int, int]]:
        """Yield connection id, first and last receive time [ns] of each part with messages."""

    def close(self) -> None:
        """Close the file."""


class Definition(NamedTuple):
    """Channel of an MCAP file as it was written: schema, encoding and metadata."""

    schema: tuple[str, str, bytes] | None
    encoding: str
    metadata: tuple[tuple[str, str], ...]


def span_ns(spans: Collection[tuple[int, int]]) -> tuple[int, int]:
    """Return the earliest begin and the latest end of `spans` [ns]."""
    begins, ends = zip(NO_MESSAGES_NS, *spans, strict=True)
    return min(begins), max(ends)


@contextmanager
def readable(
    name: str, expected: str, remedy: str, transfer_errors: tuple[type[Exception], ...] = ()
) -> Iterator[None]:
    """
    Turn errors of the libraries that read a file in a block into errors with a remedy.

    Damaged files make these libraries raise errors of any class, so only calls of them may stand
    in the block.

    Parameters
    ----------
    name
        The file, or several.
    expected
        What it should be.
    remedy
        What helps where its content is damaged.
    transfer_errors
        Errors of the library that are not about the content: no room for a sort, say.

    Raises
    ------
    RecordingError
        If the content is damaged.
    TransferError
        If its bytes cannot be read.

    """
    try:
        yield
    except BoxregError:
        raise
    except Exception as error:
        cause = error.__cause__ or error
        if isinstance(cause, OSError) and cause.errno is not None:
            raise TransferError(unreadable(name, cause)) from None
        if isinstance(cause, transfer_errors):
            raise TransferError(
                f'{name}: cannot be read: {one_line(error)}; check its disk, and the room in the '
                f'folder of temporary files (TMPDIR)'
            ) from None
        raise RecordingError(
            f'{name}: expected {expected}, got: {one_line(error)}; {remedy}'
        ) from None
