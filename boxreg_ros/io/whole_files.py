"""Files that appear complete or not at all, and the errors of a disk without room."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
import errno
import os
from pathlib import Path
from typing import TextIO
from uuid import uuid4

DISK_ERRORS = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)
"""Disk full, file larger than the limit of the process, quota used up."""


@contextmanager
def written_whole(path: Path) -> Iterator[TextIO]:
    """Yield a file that replaces `path` on success and is deleted on failure."""
    partial = path.with_name(f'.{path.name}.{uuid4().hex[:8]}.partial')
    try:
        with partial.open('w', encoding='utf-8', newline='') as file:
            yield file
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def store(paths: Iterable[Path]) -> None:
    """Wait until files, and the entries of folders, are on the disk itself."""
    for path in paths:
        opened = os.open(path, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)
