"""Folder of a recording of labels: its lock, and recovery of segments that were cut off."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
import shutil
from typing import NamedTuple

from boxreg_ros.errors import ConfigError
from boxreg_ros.io.lock import locked
from boxreg_ros.io.whole_files import delete_partial_files
from boxreg_ros.labels.cloud_spool import FOLDER as CLOUDS
from boxreg_ros.recorder.segment import recover

LOCK = '.lock'
DAMAGED = '.damaged'
"""Suffix of the folder of a segment whose journal cannot be read."""


class Recovery(NamedTuple):
    """Segments made from journals, and the folders of those that cannot be read."""

    recovered: int
    damaged: tuple[Path, ...]


def lock_of(folder: Path) -> AbstractContextManager[None]:
    """Return a context that keeps other recordings out of a folder; see `locked`."""
    return locked(folder / LOCK, f'record_to {str(folder)!r}')


def delete_remains(folder: Path) -> None:
    """Delete the clouds and partial files of a locked folder; no segment is made from them."""
    shutil.rmtree(folder / CLOUDS, ignore_errors=True)
    delete_partial_files(folder)


def recover_all(opened: Sequence[Path]) -> Recovery:
    """
    Complete the segments of a locked folder that were cut off.

    One that cannot be read gets another name, so that it neither is lost nor stops a recording.

    Parameters
    ----------
    opened : sequence of Path
        From `open_segments`, before a further segment was opened.

    """
    recovered = 0
    damaged = []
    for path in opened:
        try:
            recovered += recover(path) > 0
        except (ConfigError, OSError):  # a package that is missing, a full disk: no fault of it
            raise
        except Exception:  # label writers, also of other packages, may fail with any
            damaged.append(path.rename(path.with_suffix(DAMAGED)))
    return Recovery(recovered, tuple(damaged))
