"""
The journal of a run: the estimates of each batch of windows, to go on after an interruption.

A run that is resumed reads the recording again, takes the estimates that the journal has, and
solves only the batches behind them. The registrar is deterministic, so the results are the same
bytes as those of a run without interruption.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import fcntl
from io import BytesIO
from pathlib import Path
import pickle
import struct
from types import TracebackType
from typing import Any, BinaryIO, cast, Protocol, Self, TYPE_CHECKING
import zlib

from boxreg_ros.core.tables import column, joined
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.storage.urls import delete_files, names_of, read_bytes, url_of, write_bytes

if TYPE_CHECKING:
    from boxreg_ros.config import Config
    from boxreg_ros.core.input_model import InputModel
    from boxreg_ros.core.registrar import GetEstimates, Submit
    from boxreg_ros.core.track_window import Estimate, Window

HEAD = struct.Struct('<QI')
"""Size [bytes] and CRC-32 of the record that follows."""
TRUSTED_PACKAGES = ('boxreg_ros', 'numpy')
TRUSTED_NAMES = (
    'Estimate', 'Estimates', 'MarginalisationPrior', 'TrackRows', 'ndarray', 'dtype', 'scalar',
    '_reconstruct', '_frombuffer',
)  # fmt: skip
"""Names that a record may refer to: a pickle of others could run any code."""


class Records(Protocol):
    """The records of a journal, in their order."""

    def next_record(self) -> bytes | None:
        """Return the next record of an earlier run; None behind the last whole one."""

    def append(self, content: bytes) -> None:
        """Store a record behind all others."""

    def clear(self) -> None:
        """Delete all records; others may follow."""

    def delete(self) -> None:
        """Delete the journal itself."""

    def close(self) -> None:
        """Let another run use the journal."""


class FileRecords:
    """
    Records in one locked file of this machine; see `Records`.

    Raises
    ------
    RecordingError
        If another run uses the file, or its folder cannot be written.

    """

    def __init__(self, path: Path) -> None:
        self._path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = cast(BinaryIO, path.open('a+b'))
        try:
            # Not flock: forked workers would hold that lock after this process is killed.
            fcntl.lockf(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):  # POSIX allows both
            self._file.close()
            raise RecordingError(
                f'{path}: expected no other run with the same output, got one that goes on; '
                f'wait until it has ended, or choose another output with -o'
            ) from None
        self._file.seek(0)

    def next_record(self) -> bytes | None:
        """Return the next record; None behind the last whole one, where the file is cut off."""
        record_start = self._file.tell()
        head = self._file.read(HEAD.size)
        if len(head) == HEAD.size:
            size, crc = HEAD.unpack(head)
            content = self._file.read(size)
            if len(content) == size and zlib.crc32(content) == crc:
                return content
        self._file.truncate(record_start)
        return None

    def append(self, content: bytes) -> None:
        """Write a record at the end of the file."""
        self._file.write(HEAD.pack(len(content), zlib.crc32(content)) + content)
        self._file.flush()

    def clear(self) -> None:
        """Empty the file, which stays locked."""
        self._file.truncate(0)

    def delete(self) -> None:
        """Delete the file."""
        self._path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file, which unlocks it."""
        self._file.close()


class ObjectRecords:
    """
    Records in a folder behind a URL, one file each; see `Records`.

    Object stores cannot append to a file, and have no locks: a second run with the same output is
    not noticed. It writes the same records, because the registrar is deterministic.

    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._stored = set(names_of(folder))
        self._count = 0

    def next_record(self) -> bytes | None:
        """Return the next record; None behind the last one."""
        name = self._name()
        if name not in self._stored:
            return None
        self._count += 1
        return read_bytes(self._folder / name)

    def append(self, content: bytes) -> None:
        """Write the file of a record; it appears whole."""
        write_bytes(self._folder / self._name(), content)
        self._count += 1

    def clear(self) -> None:
        """Delete all files of the folder."""
        self.delete()
        self._stored.clear()
        self._count = 0

    def delete(self) -> None:
        """Delete all files of the folder, which is gone then."""
        delete_files(self._folder)

    def close(self) -> None:
        """Do nothing: nothing is open."""

    def _name(self) -> str:
        return f'{self._count:06d}'


class EstimateJournal:
    """
    Store estimates in the order their windows are submitted; use as a context manager.

    Parameters
    ----------
    path : Path
        File of the journal, or its folder behind a URL. It is deleted after success, and where it
        has no record.
    fingerprint : str
        Of the request. A journal of another request is begun again.

    Raises
    ------
    RecordingError
        On entering, if another run uses the journal, or its folder cannot be written.

    """

    def __init__(self, path: Path, fingerprint: str) -> None:
        self._path = path
        self._fingerprint = fingerprint.encode()
        self._earlier: Iterator[Any] = iter(())

    def __enter__(self) -> Self:
        """Open the journal and find the records of an earlier run."""
        kind = FileRecords if url_of(self._path) is None else ObjectRecords
        self._records: Records = kind(self._path)
        if self._records.next_record() == self._fingerprint:
            self._earlier = iter(self._records.next_record, None)
        else:
            self._records.clear()
            self._append(self._fingerprint)
        self._num_records = 0
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        _error: BaseException | None,
        _traceback: TracebackType | None,
    ) -> None:
        """Close the journal; delete it if nothing is left to go on with."""
        if kind is None or not self._num_records:
            self._records.delete()
        self._records.close()

    def journaled(self, submit: Submit) -> Submit:
        """Return a function like `submit` that takes estimates from the journal where it can."""

        def submit_or_recall(
            windows: list[Window], config: Config, model: InputModel
        ) -> GetEstimates:
            checksum = _checksum(windows)
            recalled = self._recalled(checksum)
            if recalled is not None:
                estimates, state = recalled

                def recall() -> list[Estimate | None]:
                    vars(model).update(state)
                    return estimates

                return recall
            get_estimates = submit(windows, config, model)

            def await_and_store() -> list[Estimate | None]:
                found = get_estimates()
                self._append(
                    pickle.dumps((checksum, found, model.__getstate__()), pickle.HIGHEST_PROTOCOL)
                )
                self._num_records += 1
                return found

            return await_and_store

        return submit_or_recall

    def _recalled(self, checksum: int) -> tuple[list[Estimate | None], dict[str, Any]] | None:
        """Return the estimates and the state of the next record; None behind the last one."""
        content = next(self._earlier, None)
        if content is None:
            return None
        stored_checksum, estimates, state = _TrustedUnpickler(BytesIO(content)).load()
        if stored_checksum != checksum:
            raise RecordingError(
                f'{self._path}: expected the journal of the same run, got one of other windows; '
                f'delete it to begin again'
            )
        self._num_records += 1
        return estimates, state

    def _append(self, content: bytes) -> None:
        self._records.append(content)


class _TrustedUnpickler(pickle.Unpickler):
    """Unpickle arrays and the classes of the core, nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        """Return the object of a trusted name."""
        if module.split('.')[0] in TRUSTED_PACKAGES and name in TRUSTED_NAMES:
            return super().find_class(module, name)
        raise RecordingError(
            f'journal: expected arrays and estimates, got {module}.{name}; delete the journal'
        )


def journal_path(out: Path) -> Path:
    """
    Return the journal of a result folder: beside it, hidden; of a URL, too.

    Raises
    ------
    ConfigError
        If nothing can be beside it.

    """
    if url_of(out) is None:
        out = out.resolve()
    elif len(out.parts) < 3:  # scheme and bucket
        raise ConfigError(
            f'--resume: expected an output in a bucket, got the bucket {url_of(out)} itself; add '
            f'a folder to -o'
        )
    return out.with_name(f'.{out.name}.journal')


def _checksum(windows: Sequence[Window]) -> int:
    """Return a checksum of the ids, stamps and boxes of windows."""
    checksum = 0
    for window in windows:
        checksum = zlib.crc32(window.track_id.encode(errors='surrogateescape'), checksum)
        tables, rows = joined(window.observations)
        stamps, boxes = (column(tables, name)[rows] for name in ('stamps_ns', 'boxes'))
        checksum = zlib.crc32(boxes.tobytes(), zlib.crc32(stamps.tobytes(), checksum))
    return checksum
