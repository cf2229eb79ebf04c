"""
The estimates of each batch of windows, to go on after an interruption.

A run that is resumed reads the recording again, takes the estimates that the journal has, and
solves only the batches behind them. The registrar is deterministic, so the results are the same
bytes as those of a run without interruption.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TYPE_CHECKING
import zlib

from boxreg_ros.core.tables import column, joined
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.journal import opened_journal
from boxreg_ros.io.storage.urls import url_of
from boxreg_ros.offline.progress import advanced

if TYPE_CHECKING:
    from boxreg_ros.config import Config
    from boxreg_ros.core.input_model import InputModel
    from boxreg_ros.core.registrar import GetEstimates, Submit
    from boxreg_ros.core.window import Estimate, Window


class EstimateJournal:
    """
    Store estimates in the order their windows are submitted; use as a context manager.

    The file, or folder behind a URL, is deleted after success, and where it has no estimates. A
    journal of a request with another fingerprint is begun again. Entering raises OSError if the
    file cannot be written.

    """

    def __init__(self, path: Path, fingerprint: str) -> None:
        self._path = path
        self._fingerprint = fingerprint
        self._earlier: Iterator[Any] = iter(())

    def __enter__(self) -> Self:
        """Open the journal and find the records of an earlier run."""
        self._journal = opened_journal(self._path)
        found = self._journal.records()
        whole = 0
        if next(found, None) == self._fingerprint:
            whole = 1 + sum(1 for _ in found)
        self._has_estimates = self._journal.cut(whole) > 1
        if not whole:
            self._journal.append(self._fingerprint)
        self._earlier = islice(self._journal.records(), 1, whole)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        _error: BaseException | None,
        _traceback: TracebackType | None,
    ) -> None:
        """Close the journal; delete it if nothing is left to go on with."""
        if kind is None or not self._has_estimates:
            self._journal.delete()
        else:
            self._journal.close()

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
                self._store((checksum, found, model.__getstate__()))
                return found

            return await_and_store

        return submit_or_recall

    def _recalled(self, checksum: int) -> tuple[list[Estimate | None], dict[str, Any]] | None:
        """Return the estimates and the state of the next record; None behind the last one."""
        record = next(self._earlier, None)
        if record is None:
            return None
        stored_checksum, estimates, state = record
        if stored_checksum != checksum:
            raise RecordingError(
                f'{self._path}: expected the journal of the same run, got one of other windows; '
                f'delete it to begin again'
            )
        return estimates, state

    def _store(self, record: tuple[int, list[Estimate | None], Any]) -> None:
        self._journal.append(record)
        self._has_estimates = True
        advanced()


def journal_path(out: Path) -> Path:
    """Return the hidden journal beside a result folder; of a URL, too."""
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
