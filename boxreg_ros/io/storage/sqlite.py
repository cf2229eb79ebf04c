"""
rosbag2 databases, read by rosbags.

The lines around its reader are for valid databases that it refuses: with a write-ahead log, with a
topic whose definition was not found, or on a path with characters that have a meaning in a URI.

"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from pathlib import Path
import shutil
from urllib.parse import quote

import apsw
from boxreg_ros.io.storage.record import Damage, Damages, readable, Record
from boxreg_ros.io.whole_files import temporary_folder
from rosbags.interfaces import Connection
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

WAL_SUFFIX = '-wal'
KNOWN_DEFINITIONS = (
    'CREATE TEMP VIEW message_definitions AS SELECT * FROM main.message_definitions '
    "WHERE encoding IN ('ros2msg', 'ros2idl')"
)
"""Hides the definitions that rosbag2 has not found: it writes them with another encoding."""
TRANSFER_ERRORS = (apsw.CantOpenError, apsw.FullError, apsw.IOError, apsw.NoMemError)
"""Errors of sqlite that are not about the content of a file: no room for a sort, say."""
QUERY_STEPS = 10**6
STEPS_PER_BYTE = 4
"""
Steps of sqlite's machine that a query over a whole table may take, and more for each byte.

A row takes some fifty steps and has 40 bytes at least, most have thousands.

"""
VIEW_BYTES = 2**20
"""What a value may have more than its file: the text of the views above."""


class SqliteFile:
    """
    An open ``.db3`` file; see `StorageFile`.

    The database and its folder are never changed: with a write-ahead log beside it, a copy in the
    folder of temporary files is read.

    Parameters
    ----------
    path
        A file of this machine.
    origin
        The file that `path` was unpacked or copied from, to name in messages.

    Raises
    ------
    RecordingError
        If it is no whole database of rosbag2; while messages are read, too.
    TransferError
        If there is no room for a copy or a sort, or the disk fails.

    """

    def __init__(self, path: Path, origin: Path | None = None) -> None:
        self.name = str(origin or path)
        self.damages: Damages = {}
        with self._readable(), _without_log(path) as whole, _prepared(whole):
            self._reader = Sqlite3Reader(Path(quote(str(whole))))  # its name is part of a URI
            self._reader.open()
        about = self._reader.metadata
        self.start_time, self.end_time = about.start_time, about.end_time
        self.connections = [c._replace(owner=self) for c in self._reader.connections]
        lost = about.message_count - sum(c.msgcount for c in self.connections)
        if lost:
            self._note(f'{abs(lost)} messages whose topic or place is unknown')
        self._database.set_progress_handler(None)

    @property
    def _database(self) -> apsw.Connection:
        assert self._reader.dbconn is not None  # it is open
        return self._reader.dbconn

    def close(self) -> None:
        """Close the database."""
        self._reader.close()

    def messages(
        self, connections: Collection[Connection], start: int | None, stop: int | None
    ) -> Iterator[Record]:
        """Yield the messages on `connections`, ordered by receive time; see `StorageFile`."""
        wanted = {connection.id: connection for connection in connections}
        with self._readable():
            for own, received_ns, data in self._reader.messages(connections, start, stop):
                if isinstance(data, bytes):
                    yield Record(wanted[own.id], received_ns, data, received_ns)
                else:
                    self._note('damaged message (no bytes)', received_ns)

    def spans(self) -> Iterator[tuple[int, int, int]]:
        """Yield connection id and, twice, the receive time [ns] of each message."""
        query = 'SELECT topic_id, timestamp, timestamp FROM messages ORDER BY timestamp'
        with self._readable():
            yield from self._database.execute(query)

    def _note(self, reason: str, time_ns: int | None = None) -> None:
        self.damages[Damage(self.name, reason, None, None, time_ns, time_ns)] = None

    def _readable(self) -> AbstractContextManager[None]:
        """Return a block in which errors of rosbags and sqlite become errors with a remedy."""
        return readable(
            self.name,
            'a whole database of rosbag2',
            f'copy it again, or read what is left of it: sqlite3 {self.name} .recover | sqlite3 '
            f'recovered.db3',
            TRANSFER_ERRORS,
        )


@contextmanager
def _without_log(path: Path) -> Iterator[Path]:
    """Yield a database without a write-ahead log: the file, or a copy with it merged."""
    log = path.with_name(path.name + WAL_SUFFIX)
    has_log = log.exists() and log.stat().st_size
    with temporary_folder() if has_log else nullcontext(path.parent) as folder:
        whole = folder / path.name
        if has_log:
            shutil.copyfile(path, whole)
            shutil.copyfile(log, folder / log.name)
            with closing(apsw.Connection(str(whole))) as database:
                database.execute('PRAGMA wal_checkpoint(TRUNCATE)')
        yield whole


@contextmanager
def _prepared(path: Path) -> Iterator[None]:
    """Prepare the databases that are opened in a block; queries and values without end fail."""
    size = path.stat().st_size

    def prepare(database: apsw.Connection) -> None:
        # Pages that refer to each other in a circle have no end.
        calls = iter(range(1 + STEPS_PER_BYTE * size // QUERY_STEPS))
        database.set_progress_handler(lambda: next(calls, None) is None, QUERY_STEPS)
        database.limit(apsw.SQLITE_LIMIT_LENGTH, min(size + VIEW_BYTES, 2**31 - 1))
        database.execute(KNOWN_DEFINITIONS)

    apsw.connection_hooks.append(prepare)
    try:
        yield
    finally:
        apsw.connection_hooks.remove(prepare)
