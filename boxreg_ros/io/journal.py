"""
Journals: objects in the order in which they were added, for a run to go on after its end.

On this machine a journal is a file of SQLite with a write-ahead log: an object is in it as soon as
it is added, and the checksums of the log end it where a power cut has torn it. Behind a URL it is
a folder with a file per object, because object stores cannot append to a file.

"""

from __future__ import annotations

from collections.abc import Iterator
import errno
from io import BytesIO
from itertools import count
import os
from pathlib import Path
import pickle
import sqlite3
from typing import Any
import zlib

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.storage.urls import delete_files, names_of, read_bytes, url_of, write_bytes

TRUSTED_PACKAGES = ('boxreg_ros', 'numpy')
TRUSTED_NAMES = (
    *('Constants', 'Estimate', 'Estimates', 'MarginalisationPrior', 'TrackRows'),
    *('ndarray', 'dtype', 'scalar', '_reconstruct', '_frombuffer'),
)
"""Names that an object may refer to: a pickle of others could run any code."""
SETUP = (
    'PRAGMA locking_mode = EXCLUSIVE',  # no shared memory, which network file systems lack
    'PRAGMA journal_mode = WAL',
    'PRAGMA synchronous = NORMAL',  # `sync` decides when
    'PRAGMA wal_autocheckpoint = 0',  # it would write large objects twice
    'CREATE TABLE IF NOT EXISTS record '
    '(number INTEGER PRIMARY KEY, crc INTEGER NOT NULL, content BLOB NOT NULL)',
)


class Journal:
    """
    A journal in a file of this machine; the caller keeps other processes out.

    Raises RecordingError if the file is no journal, and OSError if it cannot be written.

    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._log = path.with_name(f'{path.name}-wal')  # the name that SQLite gives it
        self._count = 0
        self._open()

    def records(self) -> Iterator[Any]:
        """Yield all objects, up to the first that is missing or damaged."""
        for number in count():
            content = self._content(number)
            if content is None:
                return
            try:
                yield _TrustedUnpickler(BytesIO(content)).load()
            except Exception as error:  # of another version, or not ours: of any class
                raise RecordingError(
                    f'{self.path}: expected arrays and estimates of this version, got {error}; '
                    f'delete it to begin again'
                ) from None

    def append(self, item: Any) -> None:
        """Add an object behind all others; it survives the end of this process."""
        self._add(pickle.dumps(item, pickle.HIGHEST_PROTOCOL))
        self._count += 1

    def cut(self, kept: int) -> int:
        """Delete all but the first `kept` objects; return how many are left."""
        try:
            self._database.execute('DELETE FROM record WHERE number >= ?', (kept,))
            (answer,) = self._database.execute('PRAGMA quick_check(1)').fetchone()
        except sqlite3.DatabaseError as error:
            answer = str(error)
        if answer != 'ok':  # nothing can be added to a damaged file
            kept = 0
            self.delete()
            self._open()
        self._count = kept
        return kept

    def delete(self) -> None:
        """Delete the journal and close it."""
        self._unlink()  # first: SQLite then does not tidy up the file
        self.close()

    def close(self) -> None:
        """Close the journal."""
        self._database.close()

    def _open(self) -> None:
        try:
            self._database = sqlite3.connect(self.path, isolation_level=None)  # autocommit
            for statement in SETUP:
                self._database.execute(statement)
        except sqlite3.OperationalError as error:
            raise self._system_error(error, b'') from None
        except sqlite3.DatabaseError as error:
            raise RecordingError(
                f'{self.path}: expected a journal of boxreg, got another file: {error}; delete it '
                f'to begin again'
            ) from None

    def _content(self, number: int) -> bytes | None:
        """Return an object as bytes; None if it is missing or damaged."""
        try:
            crc, content = self._database.execute(
                'SELECT crc, content FROM record WHERE number = ?', (number,)
            ).fetchone() or (0, None)
        except sqlite3.DatabaseError:
            return None
        is_whole = isinstance(content, bytes) and zlib.crc32(content) == crc
        return content if is_whole else None

    def _add(self, content: bytes) -> None:
        row = self._count, zlib.crc32(content), content
        try:
            self._database.execute('INSERT INTO record VALUES (?, ?, ?)', row)
        except sqlite3.OperationalError as error:
            raise self._system_error(error, content) from None

    def _system_error(self, error: sqlite3.Error, content: bytes) -> OSError:
        """Return the error of the system behind one of SQLite: the same write has it again."""
        try:
            with (self._log if self._log.exists() else self.path).open('r+b') as file:
                file.seek(0, os.SEEK_END)  # a file that was deleted is not made again
                file.write(content)  # ignored there: it has no checksum
        except OSError as reason:
            return reason
        return OSError(errno.EIO, str(error), str(self.path))

    def _unlink(self) -> None:
        self.path.unlink(missing_ok=True)
        self._log.unlink(missing_ok=True)


class ObjectJournal(Journal):
    """
    A journal in a folder behind a URL, one file per object.

    Object stores have no locks: a second run with the same output is not noticed. It adds the
    same objects, because the registrar is deterministic.

    """

    def cut(self, kept: int) -> int:
        """Delete all but the first `kept` objects; return how many are left."""
        delete_files(self.path, [_name(number) for number in range(kept, self._count)])
        self._count = kept
        return kept

    def delete(self) -> None:
        """Delete all files of the folder, which is gone then."""
        self.cut(0)

    def close(self) -> None:
        """Do nothing: nothing is open."""

    def _open(self) -> None:
        self._count = len(names_of(self.path))

    def _content(self, number: int) -> bytes | None:
        return read_bytes(self.path / _name(number)) if number < self._count else None

    def _add(self, content: bytes) -> None:
        write_bytes(self.path / _name(self._count), content)


def opened_journal(path: Path) -> Journal:
    """Return the journal at a path or URL; one that cannot be read is begun again."""
    if url_of(path) is not None:
        return ObjectJournal(path)
    try:
        return Journal(path)
    except RecordingError:
        path.unlink()
        return Journal(path)  # SQLite deletes the log of another file


class _TrustedUnpickler(pickle.Unpickler):
    """Unpickle arrays and the classes that journals have, nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        """Return the object of a trusted name."""
        if module.split('.')[0] in TRUSTED_PACKAGES and name in TRUSTED_NAMES:
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f'{module}.{name}')


def _name(number: int) -> str:
    return f'{number:06d}'
