"""A file whose reads are whole: a short read is no end, no damage and no shorter message."""

from __future__ import annotations

from io import SEEK_END, SEEK_SET
import os
from pathlib import Path
from typing import Any

from boxreg_ros.errors import TransferError, unreadable
from boxreg_ros.io.storage.urls import url_of
from mcap.exceptions import EndOfFile


class ByteFile:
    """
    An open file of this machine, or behind a URL, as the mcap package reads it.

    Its `size` [bytes] is that at the start: of a file that is being recorded, no more is read.

    Parameters
    ----------
    path
        A file of this machine, or behind a URL.

    Raises
    ------
    EndOfFile
        If more bytes are asked for than the file has; the package would take those that are left.
    TransferError
        If bytes of it cannot be read from their disk or server.

    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: Any
        if url_of(path) is None:
            self._file = path.open('rb')
            self.size = os.fstat(self._file.fileno()).st_size
        else:
            from boxreg_ros.io.storage.remote_file import RemoteFile  # fsspec takes 0.5 s

            self._file = RemoteFile(path)
            self.size = self._file.size
        self._position = 0

    def read(self, size: int) -> bytes:
        """Return the next `size` bytes."""
        if not 0 <= size <= self.size - self._position:
            raise EndOfFile
        try:
            content = bytes(self._file.read(size))
        except OSError as error:
            raise TransferError(unreadable(self._path, error)) from None
        if len(content) != size:
            raise TransferError(
                f'{self._path}: expected {size} bytes from {self._position} on, got '
                f'{len(content)}; the file has become shorter: copy it again'
            )
        self._position += size
        return content

    def seek(self, offset: int, whence: int = SEEK_SET) -> int:
        """Go to a place, counted from the begin or from the end; return it."""
        self._position = offset + (self.size if whence == SEEK_END else 0)
        if self._position < 0:
            raise EndOfFile
        self._file.seek(self._position)
        return self._position

    def tell(self) -> int:
        """Return the place of the next byte."""
        return self._position

    def seekable(self) -> bool:
        """Return that any place can be read."""
        return True

    def check_unchanged(self) -> None:
        """Raise TransferError if a file behind a URL is another one than at the start."""
        if url_of(self._path) is not None:
            self._file.check_unchanged()

    def close(self) -> None:
        """Close the file."""
        self._file.close()
