"""A file behind a URL, as fsspec reads it: by blocks, of which it keeps those used last."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
import shutil

from boxreg_ros.errors import TransferError
from boxreg_ros.io.storage.urls import answer_of, entry_of, limit_of, system_of, url_of
from fsspec.spec import AbstractBufferedFile

REQUEST_BYTES = 2**22
"""Read at a time; chosen: at 50 MB/s it takes as long as an object store takes to answer."""
CACHE_BLOCKS = 16
"""Blocks that are kept: the first are read for topics and transforms, then again."""


class RemoteFile(AbstractBufferedFile):  # type: ignore[misc]  # fsspec has no types
    """
    An open file behind a URL; blocks of it are asked for again where a server sends less.

    Parameters
    ----------
    path
        The URL.

    Raises
    ------
    TransferError
        If there is no such file, or a block does not arrive.

    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._entry = entry_of(path)
        system, name = system_of(path)
        super().__init__(
            system, name, block_size=REQUEST_BYTES, cache_type='blockcache',
            cache_options={'maxblocks': CACHE_BLOCKS}, size=self._entry.size,
        )  # fmt: skip

    def check_unchanged(self) -> None:
        """Raise TransferError if the file is another one than at the start."""
        self.fs.invalidate_cache()
        if entry_of(self._path) != self._entry:
            raise TransferError(
                f'{url_of(self._path)}: expected the file as it was at the start, got another '
                f'version; run again when it is no longer written'
            )

    def _fetch_range(self, start: int, end: int) -> bytes:
        """Return a part of the file, for the cache of fsspec, which takes short ones as whole."""
        end = min(end, self.size)

        def content() -> bytes:
            answer = bytes(self.fs.cat_file(self.path, start=start, end=end, **limit_of(self.fs)))
            if len(answer) == self.size > end - start:
                raise _WholeFile(
                    f'{url_of(self._path)}: expected a server that sends ranges, got the whole '
                    f'file; copy it to this machine'
                )
            if len(answer) != end - start:
                raise EOFError(f'expected {end - start} bytes from {start} on, got {len(answer)}')
            return answer

        return answer_of(self._path, content)


def download(path: Path, target: Path) -> None:
    """Copy a file behind a URL to this machine: by blocks, or whole where the server has none."""
    with closing(RemoteFile(path)) as source, target.open('wb') as copy:
        try:
            shutil.copyfileobj(source, copy, REQUEST_BYTES)
        except _WholeFile:
            copy.seek(0)
            answer_of(path, lambda: source.fs.get_file(source.path, str(target)))
        size = target.stat().st_size
    if size != source.size:
        raise TransferError(
            f'{url_of(path)}: expected {source.size} bytes, got {size}; run again, or copy it to '
            f'this machine'
        )


class _WholeFile(TransferError):
    """A server sends the whole file in place of a range."""
