"""
rosbag2 databases: read by time, with the write-ahead log, and row by row where they are damaged.

The reader of rosbags ignores the write-ahead log, refuses a database with one topic without a
definition, and stops at the first damaged page, so the three tables are read here.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing, suppress
from pathlib import Path
import shutil
import sqlite3
from typing import Any
from urllib.parse import quote

from boxreg_ros.errors import RecordingError, TransferError
from boxreg_ros.io.storage.record import Damage, Damages, NO_MESSAGES_NS, one_line, Record, shown
from boxreg_ros.io.whole_files import temporary_folder
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag2.metadata import parse_qos

WAL_SUFFIX = '-wal'
DEFINITION_FORMATS = {
    'ros2msg': MessageDefinitionFormat.MSG,
    'ros2idl': MessageDefinitionFormat.IDL,
}
TABLES = ('topics', 'messages', 'message_definitions')
TRANSFER_ERRORS = ('SQLITE_CANTOPEN', 'SQLITE_FULL', 'SQLITE_IOERR', 'SQLITE_NOMEM')
"""Errors of sqlite that are not about the content of a file: no room for a sort, say."""
MAX_ID = 2**62
QUERY_STEPS = 10**6
STEPS_PER_BYTE = 2
"""
Steps of sqlite's machine that a query over a whole table may take, and more for each byte.

A row takes some ten steps and has 40 bytes at least, most have thousands.

"""
PAGE_SIZE = slice(16, 18)
PAGE_COUNT = slice(28, 32)
"""Bytes of the file header of sqlite that have these numbers."""


class SqliteFile:
    """
    An open ``.db3`` file, unpacked from `origin` where that is given; see `StorageFile`.

    The database and its folder are never changed: with a write-ahead log beside it, a copy in the
    folder of temporary files is read. Raises RecordingError if it is no database of rosbag2.

    """

    def __init__(self, path: Path, origin: Path | None = None) -> None:
        self.name = shown(path, origin)
        self.damages: Damages = {}
        self.connections: list[Connection] = []
        self._surviving: list[tuple[int, int, int]] | None = None
        self._size = path.stat().st_size
        self._database = _opened(path, self.name)
        try:
            self._note_truncation(path)
            self._check_tables()
            self._read_topics()
        except sqlite3.Error as error:
            self.close()
            self._raise_transfer_error(error)
            raise RecordingError(
                f'{self.name}: expected a database of rosbag2, got: {one_line(error)}; copy or '
                f'record it again'
            ) from None
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the database."""
        self._database.close()

    def messages(
        self, connections: Collection[Connection], start: int | None, stop: int | None
    ) -> Iterator[Record]:
        """Yield the messages on `connections`, ordered by receive time; see `StorageFile`."""
        wanted = {connection.id: connection for connection in connections}
        begin = -MAX_ID if start is None else start
        end = MAX_ID if stop is None else stop
        for number, topic, received_ns in self._ordered(sorted(wanted), begin, end):
            try:
                query = 'SELECT data FROM messages WHERE rowid = ?'
                ((data,),) = self._database.execute(query, (number,))
            except (sqlite3.Error, ValueError) as error:
                self._raise_transfer_error(error)
                self._note(f'damaged message ({one_line(error)})', received_ns, received_ns)
                continue
            if not isinstance(data, bytes):
                self._note('damaged message (no bytes)', received_ns, received_ns)
                continue
            yield Record(wanted[topic], received_ns, data, received_ns)

    def spans(self) -> Iterator[tuple[int, int, int]]:
        """Yield connection id and, twice, the receive time [ns] of each message."""
        topics = [connection.id for connection in self.connections]
        for _, topic, received_ns in self._ordered(topics, -MAX_ID, MAX_ID):
            yield topic, received_ns, received_ns

    def _ordered(self, topics: list[int], begin: int, end: int) -> Iterator[tuple[int, int, int]]:
        """Yield id, topic and receive time of messages, in the order of these times."""
        if self._surviving is None:
            marks = ','.join('?' * len(topics))
            yield from self._database.execute(
                f'SELECT rowid, topic_id, timestamp FROM messages WHERE topic_id IN ({marks}) '
                f"AND timestamp >= ? AND timestamp < ? AND typeof(timestamp) = 'integer' "
                f'ORDER BY timestamp, rowid',
                (*topics, begin, end),
            )
            return
        for row in self._surviving:
            if row[1] in topics and begin <= row[2] < end:
                yield row

    def _check_tables(self) -> None:
        """Refuse what computes its rows or values: these may be without end, or of any size."""
        for table in TABLES:
            kinds = [row[2] for row in self._database.execute(f'PRAGMA table_list({table})')]
            columns = list(self._database.execute(f'PRAGMA table_xinfo({table})'))
            computed = [str(column[1]) for column in columns if column[-1]]
            if any(kind != 'table' for kind in kinds) or computed:
                found = ', '.join(computed) or kinds[0]
                raise RecordingError(
                    f'{self.name}: expected a plain table {table!r} of rosbag2, got a computed '
                    f'one ({found}); this is no recording: do not use it'
                )

    def _read_topics(self) -> None:
        definitions = self._definitions()
        columns = [row[1] for row in self._database.execute('PRAGMA table_info(topics)')]
        qos = 'offered_qos_profiles' if 'offered_qos_profiles' in columns else "''"
        digest = 'type_description_hash' if 'type_description_hash' in columns else "''"
        counts = self._counts()
        self.start_time, self.end_time = NO_MESSAGES_NS
        if self._span is not None:
            self.start_time, self.end_time = self._span
        query = f'SELECT id, name, type, serialization_format, {qos}, {digest} FROM topics'
        for number, *texts in self._limited(query):
            if not all(isinstance(text, str) for text in texts):
                self._note(f'damaged topic {number}')
                continue
            topic, kind, encoding, profiles, hashed = texts
            definition = definitions.get(kind, MessageDefinition(MessageDefinitionFormat.NONE, ''))
            extra = ConnectionExtRosbag2(encoding, _qos(profiles))
            count = counts.get(number, 0)
            self.connections.append(
                Connection(number, topic, kind, definition, hashed, count, extra, self)
            )

    def _definitions(self) -> dict[str, MessageDefinition]:
        """Return the message definitions by type; older recordings have none."""
        try:
            rows = list(
                self._limited(
                    'SELECT topic_type, encoding, encoded_message_definition '
                    'FROM message_definitions ORDER BY id'
                )
            )
        except sqlite3.OperationalError:  # no such table
            return {}
        return {
            kind: MessageDefinition(DEFINITION_FORMATS[encoding], text)
            for kind, encoding, text in rows
            if encoding in DEFINITION_FORMATS and isinstance(text, str)
        }

    def _counts(self) -> dict[int, int]:
        """Return the number of messages by topic, and set the times of all."""
        self._span: tuple[int, int] | None = None
        try:
            # The whole table and the index by time: both must be readable.
            query = 'SELECT topic_id, count(*) FROM messages NOT INDEXED GROUP BY topic_id'
            counts = dict(self._limited(query))
            query = (
                "SELECT timestamp FROM messages WHERE typeof(timestamp) = 'integer' "
                'ORDER BY timestamp'
            )
            times = [row[0] for row in _ends(self._limited(query))]
        except sqlite3.DatabaseError as error:
            self._raise_transfer_error(error)
            rows = [row for row in self._rows() if all(isinstance(value, int) for value in row)]
            self._surviving = sorted(rows, key=lambda row: (row[2], row[0]))
            self._note(f'damaged database ({one_line(error)}), read row by row')
            times = [row[2] for row in _ends(iter(self._surviving))]
            counts = Counter(row[1] for row in self._surviving)
        if times:
            self._span = times[0], times[-1] + 1
        return counts

    def _limited(self, query: str) -> Iterator[Any]:
        """
        Yield the rows of a query over a whole table; OperationalError if that would never end.

        Pages that refer to each other in a circle have no end.

        """
        calls = iter(range(1 + STEPS_PER_BYTE * self._size // QUERY_STEPS))

        def has_ended() -> bool:
            return next(calls, None) is None

        self._database.set_progress_handler(has_ended, QUERY_STEPS)
        try:
            yield from self._database.execute(query)
        finally:
            self._database.set_progress_handler(None, 0)

    def _rows(self) -> Iterator[tuple[int, int, int]]:
        """Yield id, topic and receive time of the messages on pages that are readable."""
        last_id: int | None = -1
        while last_id is not None:
            query = (
                'SELECT rowid, topic_id, timestamp FROM messages NOT INDEXED '
                'WHERE rowid > ? ORDER BY rowid'
            )
            with suppress(sqlite3.DatabaseError):
                for row in self._database.execute(query, (last_id,)):
                    if row[0] <= last_id:
                        break  # on a damaged page, which may refer back to another one
                    yield row
                    last_id = row[0]
                else:
                    return
            last_id = self._next_readable(last_id)

    def _next_readable(self, last_id: int) -> int | None:
        """Return an id just before a row that may be readable; None without such a row."""
        step = 1
        query = 'SELECT rowid FROM messages NOT INDEXED WHERE rowid > ? ORDER BY rowid LIMIT 1'
        while last_id + step < MAX_ID:
            with suppress(sqlite3.DatabaseError):
                found = self._database.execute(query, (last_id + step,)).fetchone()
                if found is None:
                    return None
                if found[0] > last_id + step:
                    return int(found[0]) - 1
            step *= 2
        return None

    def _note(self, reason: str, start_ns: int | None = None, end_ns: int | None = None) -> None:
        self.damages[Damage(self.name, reason, None, None, start_ns, end_ns)] = None

    def _raise_transfer_error(self, error: Exception) -> None:
        """Raise TransferError for an error that is not about the content of the file."""
        if getattr(error, 'sqlite_errorname', '').startswith(TRANSFER_ERRORS):
            raise TransferError(
                f'{self.name}: cannot be read: {one_line(error)}; check its disk, and the room '
                f'in the folder of temporary files (TMPDIR)'
            ) from None

    def _note_truncation(self, path: Path) -> None:
        if (path.parent / (path.name + WAL_SUFFIX)).exists():
            return
        with path.open('rb') as file:
            head = file.read(100)
        page_size = int.from_bytes(head[PAGE_SIZE], 'big')
        expected = (2**16 if page_size == 1 else page_size) * int.from_bytes(head[PAGE_COUNT])
        size = path.stat().st_size
        if size < expected:
            reason = 'the end of the database is missing'
            self.damages[Damage(self.name, reason, size, expected)] = None


def _opened(path: Path, name: str) -> sqlite3.Connection:
    """Open a database that is not changed; one with a write-ahead log as a merged copy."""
    log = path.with_name(path.name + WAL_SUFFIX)
    if log.exists() and log.stat().st_size:
        with temporary_folder() as folder:
            copy = folder / path.name
            shutil.copyfile(path, copy)
            shutil.copyfile(log, copy.with_name(log.name))
            with closing(sqlite3.connect(copy)) as database:
                database.execute('PRAGMA wal_checkpoint(TRUNCATE)')
            return _connected(copy)
    return _connected(path)


def _connected(path: Path) -> sqlite3.Connection:
    uri = f'file:{quote(str(path))}?immutable=1'
    # An overlay is opened by one thread and read by another, never by both at once.
    database = sqlite3.connect(uri, uri=True, check_same_thread=False)
    database.execute('PRAGMA writable_schema = ON')  # opens files whose end is missing, too
    database.text_factory = lambda text: text.decode(errors='replace')
    return database


def _qos(text: str) -> list[Any]:
    """Return QoS profiles; none if they are malformed: only copies of the recording have them."""
    try:
        return parse_qos(text)
    except Exception:  # of the YAML parser and of rosbags
        return []


def _ends(rows: Iterator[tuple[int, ...]]) -> list[tuple[int, ...]]:
    """Return the first and the last row."""
    first = next(rows, None)
    if first is None:
        return []
    last = first
    for row in rows:
        last = row
    return [first, last]
