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
from pathlib import Path
import pickle
import sqlite3
from typing import Any, Protocol
import zlib

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.storage.urls import delete_files, names_of, read_bytes, url_of, write_bytes
from boxreg_ros.io.whole_files import store

TRUSTED_PACKAGES = ('boxreg_ros', 'numpy')
TRUSTED_NAMES = (
    *('Estimate', 'Estimates', 'MarginalisationPrior', 'TrackRows'),
    *('LabelFrame', 'RefinedBoxes', 'BoxArray', 'Sweep'),
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
LOG_SUFFIX = '-wal'
"""Of the file that SQLite writes beside the journal."""


class Journal(Protocol):
    """Objects in the order in which they were added; the caller keeps other processes out."""

    def records(self) -> Iterator[Any]:
        """Yield all objects, up to the first that is missing or damaged."""

    def cut(self, kept: int) -> int:
        """Delete all but the first `kept` objects; return how many are left."""

    def append(self, item: Any) -> None:
        """Add an object behind all others."""

    def delete(self) -> None:
        """Delete the journal and close it."""

    def close(self) -> None:
        """Close the journal."""


class FileJournal:
    """
    A journal in a file of this machine; see `Journal`.

    Parameters
    ----------
    path : Path
        The file; its folder exists.

    Raises
    ------
    RecordingError
        If the file is no journal.
    OSError
        If it cannot be written.

    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._log = path.with_name(path.name + LOG_SUFFIX)
        self._open()

    def _open(self) -> None:
        # Autocommit; the recorder closes its segments in a second thread.
        self._database = sqlite3.connect(self.path, isolation_level=None, check_same_thread=False)
        try:
            for statement in SETUP:
                self._database.execute(statement)
            (self._count,) = self._database.execute('SELECT count(*) FROM record').fetchone()
        except sqlite3.OperationalError as error:
            self.close()
            raise self._system_error(error, b'') from None
        except sqlite3.DatabaseError as error:
            self.close()
            raise RecordingError(
                f'{self.path}: expected a journal of boxreg, got another file: {error}; delete it '
                f'to begin again'
            ) from None

    def records(self) -> Iterator[Any]:
        """Yield all objects, up to the first that is missing or damaged."""
        for number in count():
            try:
                crc, content = self._database.execute(
                    'SELECT crc, content FROM record WHERE number = ?', (number,)
                ).fetchone() or (0, None)
            except sqlite3.DatabaseError:
                return
            if not isinstance(content, bytes) or zlib.crc32(content) != crc:
                return
            yield _loaded(content, self.path)

    def cut(self, kept: int) -> int:
        """Delete all but the first `kept` objects; return how many are left."""
        try:
            self._database.execute('DELETE FROM record WHERE number >= ?', (kept,))
            (answer,) = self._database.execute('PRAGMA quick_check(1)').fetchone()
        except sqlite3.DatabaseError as error:
            answer = str(error)
        if answer != 'ok':  # nothing can be added to a damaged file
            self.delete()
            self._open()
            return 0
        self._count = kept
        return kept

    def append(self, item: Any) -> None:
        """Add an object behind all others; it survives the end of this process."""
        content = pickle.dumps(item, pickle.HIGHEST_PROTOCOL)
        try:
            self._database.execute(
                'INSERT INTO record VALUES (?, ?, ?)', (self._count, zlib.crc32(content), content)
            )
        except sqlite3.OperationalError as error:
            raise self._system_error(error, content) from None
        self._count += 1

    def sync(self) -> None:
        """Wait until all objects are on the disk itself, where they survive a power cut."""
        store([self._log, self.path, self.path.parent])

    @property
    def is_deleted(self) -> bool:
        """Return whether someone has deleted or moved the file; writing would still succeed."""
        return not self.path.exists()

    def delete(self) -> None:
        """Delete the journal and close it."""
        self.path.unlink(missing_ok=True)  # first: SQLite then does not tidy up the file
        self._log.unlink(missing_ok=True)
        self.close()

    def close(self) -> None:
        """Close the journal."""
        self._database.close()

    def _system_error(self, error: sqlite3.Error, content: bytes) -> OSError:
        """Return the error of the system behind one of SQLite: the same write has it again."""
        try:
            if self._log.exists():
                with self._log.open('ab') as file:  # ignored there: it has no checksum
                    file.write(content)
            else:
                self.path.open('r+b').close()
        except OSError as reason:
            return reason
        return OSError(errno.EIO, str(error), str(self.path))


class ObjectJournal:
    """
    A journal in a folder behind a URL, one file per object; see `Journal`.

    Object stores have no locks: a second run with the same output is not noticed. It adds the
    same objects, because the registrar is deterministic.

    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._count = len(names_of(path))

    def records(self) -> Iterator[Any]:
        """Yield all objects."""
        for number in range(self._count):
            yield _loaded(read_bytes(self.path / _name(number)), self.path)

    def cut(self, kept: int) -> int:
        """Delete all but the first `kept` objects; return how many are left."""
        if kept < self._count:
            delete_files(self.path, [_name(number) for number in range(kept, self._count)])
        self._count = kept
        return kept

    def append(self, item: Any) -> None:
        """Write the file of an object; it appears whole."""
        write_bytes(self.path / _name(self._count), pickle.dumps(item, pickle.HIGHEST_PROTOCOL))
        self._count += 1

    def delete(self) -> None:
        """Delete all files of the folder, which is gone then."""
        self.cut(0)

    def close(self) -> None:
        """Do nothing: nothing is open."""


def opened_journal(path: Path) -> Journal:
    """Return the journal at a path or URL; one that cannot be read is begun again."""
    if url_of(path) is not None:
        return ObjectJournal(path)
    try:
        return FileJournal(path)
    except RecordingError:
        delete_journal(path)
        return FileJournal(path)


def delete_journal(path: Path) -> None:
    """Delete the files of a journal of this machine."""
    for file in (path, path.with_name(path.name + LOG_SUFFIX)):
        file.unlink(missing_ok=True)


class _TrustedUnpickler(pickle.Unpickler):
    """Unpickle arrays and the classes that journals have, nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        """Return the object of a trusted name."""
        if module.split('.')[0] in TRUSTED_PACKAGES and name in TRUSTED_NAMES:
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f'{module}.{name}')


def _loaded(content: bytes, path: Path) -> Any:
    """Return the object of a whole record."""
    try:
        return _TrustedUnpickler(BytesIO(content)).load()
    except Exception as error:  # of another version, or no journal of ours: of any class
        raise RecordingError(
            f'{path}: expected arrays and estimates of this version, got {error}; delete it to '
            f'begin again'
        ) from None


def _name(number: int) -> str:
    return f'{number:06d}'
