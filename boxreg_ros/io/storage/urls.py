"""
Files behind URLs: ``s3://``, ``gs://``, ``https://`` and others that fsspec opens.

A URL is carried as a `Path`, which has one slash in place of two behind the scheme. Files are read
by ranges: what the index of a recording asks for, and some chunks ahead. Each answer must have the
length that was asked for; requests that fail are repeated, and then raise `TransferError`.

"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from functools import partial
import os
from pathlib import Path
import re
import time
from typing import Any, NamedTuple, TypeVar

from boxreg_ros.errors import RecordingError, TransferError, unreadable

URL = re.compile(r'([a-z][a-z0-9+.-]+):/+(.+)')
"""A scheme has two letters or more."""
CACHE_BYTES = 64 * 2**20
"""Ranges that are kept: the first chunks are read for topics and transforms, then again."""
REQUEST_BYTES = 2**16
"""Smaller reads fetch a block of this size: a request takes as long as 1 MB of data."""
READERS = 4
"""Requests at a time; chosen: object stores send some 50 MB/s each."""
ANSWER_SECONDS = 60.0
"""Longest time for an answer [s]: 256 kB/s for the largest range, and ten times a slow listing."""
REPEAT_SECONDS = (0.5, 2.0, 8.0)
"""Waiting times before a request is repeated [s]: servers restart, or limit the rate."""
DOWNLOAD_BYTES = 2**23
"""Size of the ranges in which a whole file is copied."""
CAUSES = 'check the address, the network and the credentials'
REFUSED_STATUS = (401, 403)
"""Answers of HTTP to wrong or missing credentials."""
PASSING_STATUS = (408, 429)
"""Answers of HTTP below 500 that are worth another request: too slow, too many requests."""
MISSING_STATUS = (None, 404, 410)
"""Status behind a FileNotFoundError of a file that does not exist; HTTP raises it for any."""
UPLOAD = '.upload'
"""File in a folder that is being uploaded, or whose upload was interrupted."""

_T = TypeVar('_T')


class Entry(NamedTuple):
    """Name, size [bytes] and version (tag or time) of a file behind a URL."""

    path: Path
    size: int
    version: str


class LocalFile:
    """A file of this machine that is read by ranges; `size` in bytes."""

    def __init__(self, path: Path) -> None:
        self._file = path.open('rb')
        self.size = os.fstat(self._file.fileno()).st_size

    def read(self, first: int, end: int) -> bytes:
        """Return a part of the file; fewer bytes at its end."""
        end = min(end, self.size)
        if not 0 <= first < end:
            return b''
        try:
            return os.pread(self._file.fileno(), end - first, first)
        except OSError as error:
            raise TransferError(unreadable(self._file.name, error)) from None

    def prefetch(self, ranges: Sequence[tuple[int, int]]) -> None:
        """Leave it to the system, which reads ahead itself."""

    def check_unchanged(self) -> None:
        """Do nothing: a file that is being recorded is read as far as it goes."""

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class RemoteFile:
    """A file behind a URL that is read by ranges, `bytes_read` of its `size` so far."""

    def __init__(self, path: Path) -> None:
        self._system, self._name = _system_of(path)
        self._path = path
        self._entry = entry_of(path)
        self.size = self._entry.size
        self.bytes_read = 0
        self._pool = ThreadPoolExecutor(READERS)
        self._ranges: OrderedDict[tuple[int, int], Future[bytes]] = OrderedDict()

    def read(self, first: int, end: int) -> bytes:
        """Return a part of the file; fewer bytes at its end."""
        end = min(end, self.size)
        if not 0 <= first < end:
            return b''
        for (start, stop), future in self._ranges.items():
            if start <= first and end <= stop:
                self._ranges.move_to_end((start, stop))
                return future.result()[first - start : end - start]
        begin, stop = first, end
        if end - first < REQUEST_BYTES:
            begin = min(first, max(self.size - REQUEST_BYTES, 0))
            stop = min(begin + REQUEST_BYTES, self.size)
        return self._fetch(begin, stop).result()[first - begin : end - begin]

    def prefetch(self, ranges: Sequence[tuple[int, int]]) -> None:
        """Begin to read ranges that are needed next."""
        for first, end in ranges:
            whole = first, min(end, self.size)
            if first < self.size and whole not in self._ranges:
                self._fetch(*whole)

    def check_unchanged(self) -> None:
        """Raise TransferError if the file is another one than at the start."""
        self._system.invalidate_cache()
        if entry_of(self._path) != self._entry:
            raise TransferError(
                f'{url_of(self._path)}: expected the file as it was at the start, got another '
                f'version; run again when it is no longer written'
            )

    def close(self) -> None:
        """Cancel the open requests."""
        self._pool.shutdown(cancel_futures=True)

    def _fetch(self, first: int, end: int) -> Future[bytes]:
        """Request a range; forget the oldest ones beyond `CACHE_BYTES`."""
        future = self._pool.submit(self._request, first, end)
        self._ranges[first, end] = future
        self.bytes_read += end - first
        held = sum(stop - start for start, stop in self._ranges)
        while held > CACHE_BYTES and len(self._ranges) > 1:
            (start, stop), _ = self._ranges.popitem(last=False)
            held -= stop - start
        return future

    def _request(self, first: int, end: int) -> bytes:
        def content() -> bytes:
            answer = self._system.cat_file(
                self._name, start=first, end=end, **_limit(self._system)
            )
            if len(answer) == end - first:
                return bytes(answer)
            if len(answer) == self.size:
                raise _WholeFile(
                    f'{url_of(self._path)}: expected a server that sends ranges, got the whole '
                    f'file; copy it to this machine'
                )
            raise EOFError(f'expected {end - first} bytes from {first} on, got {len(answer)}')

        return _answer_of(self._path, content)


ByteSource = LocalFile | RemoteFile


class _WholeFile(TransferError):
    """A server sends the whole file in place of a range."""


def url_of(path: Path) -> str | None:
    """Return the URL that a path carries; None for a path of this machine."""
    match = URL.fullmatch(str(path))
    return f'{match[1]}://{match[2]}' if match else None


def byte_source_of(path: Path) -> ByteSource:
    """Return an open file."""
    return LocalFile(path) if url_of(path) is None else RemoteFile(path)


def entry_of(path: Path) -> Entry:
    """Return size and version of a file behind a URL; RecordingError without an answer."""
    system, name = _system_of(path)
    about = _answer_of(path, lambda: system.info(name, **_limit(system)))
    return _entry(path, about)


def entries_of(path: Path) -> list[Entry]:
    """Return a file behind a URL, or the files in the folder that it is, sorted by name."""
    system, name = _system_of(path)
    about = _answer_of(path, lambda: system.info(name, **_limit(system)))
    if about['type'] != 'directory':
        return [_entry(path, about)]
    listed = _answer_of(path, lambda: system.ls(name, detail=True, **_limit(system)))
    inner = sorted(listed, key=lambda one: str(one['name']))
    files = [one for one in inner if one['type'] == 'file']
    return [_entry(path / Path(one['name']).name, one) for one in files]


def download(path: Path, target: Path) -> None:
    """Copy a file behind a URL to this machine, by ranges where its server sends them."""
    with closing(RemoteFile(path)) as source:
        try:
            with target.open('wb') as copy:
                for first in range(0, source.size, DOWNLOAD_BYTES):
                    ahead = range(first, first + READERS * DOWNLOAD_BYTES, DOWNLOAD_BYTES)
                    source.prefetch([(begin, begin + DOWNLOAD_BYTES) for begin in ahead])
                    copy.write(source.read(first, first + DOWNLOAD_BYTES))
        except _WholeFile:
            _download_whole(path, target, source.size)


def _download_whole(path: Path, target: Path, size: int) -> None:
    system, name = _system_of(path)

    def download_once() -> None:
        system.get_file(name, str(target))
        if target.stat().st_size != size:
            raise EOFError(f'expected {size} bytes, got {target.stat().st_size}')

    _answer_of(path, download_once)


def read_text(path: Path) -> str:
    """Return the text of a file of this machine or behind a URL; OSError if there is none."""
    if url_of(path) is None:
        return path.read_text(encoding='utf-8')
    return read_bytes(path).decode()


def read_bytes(path: Path) -> bytes:
    """Return the content of a file behind a URL; OSError if there is none."""
    system, name = _system_of(path)
    content = _answer_of(
        path, lambda: system.cat_file(name, **_limit(system)), missing_is_error=False
    )
    return bytes(content)


def write_text(path: Path, text: str) -> None:
    """Write a file behind a URL; it appears whole."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file behind a URL; it appears whole."""
    system, name = _system_of(path)
    _answer_of(path, lambda: system.pipe_file(name, content))


def delete_files(path: Path, names: Iterable[str]) -> None:
    """Delete some files of a folder behind a URL."""
    system, name = _system_of(path)
    for one in names:
        _answer_of(path, partial(system.rm_file, f'{name}/{one}'))


def names_of(path: Path) -> list[str]:
    """Return the names of all files below a folder behind a URL; none if it does not exist."""
    return list(sizes_of(path))


def sizes_of(path: Path) -> dict[str, int]:
    """Return names and sizes [bytes] of all files below a folder behind a URL."""
    system, name = _system_of(path)
    found = _answer_of(path, lambda: system.find(name, detail=True, **_limit(system)))
    return {
        str(one).removeprefix(name).lstrip('/'): int(about['size']) for one, about in found.items()
    }


def upload(folder: Path, target: Path, last: str, advanced: Callable[[], None]) -> None:
    """
    Replace a folder behind a URL by one of this machine; call `advanced` after each file.

    `last` marks a whole result: it is deleted first, and written when all others are. `UPLOAD` is
    there from before the first change until then.

    """
    system, name = _system_of(target)
    files = {str(file.relative_to(folder)) for file in folder.rglob('*') if file.is_file()}
    write_bytes(target / UPLOAD, b'')
    old = names_of(target)
    first_deleted = [last] if last in old else []
    delete_files(target, [*first_deleted, *sorted(set(old) - files - {last, UPLOAD})])
    for file in sorted(files, key=lambda file: (file == last, file)):
        _answer_of(target, partial(system.put_file, str(folder / file), f'{name}/{file}'))
        advanced()
    delete_files(target, [UPLOAD])


def _limit(system: Any) -> dict[str, float]:
    """Return the argument of fsspec that limits the time of a request, where it has one."""
    return {'timeout': ANSWER_SECONDS} if system.async_impl else {}


def _entry(path: Path, about: dict[str, Any]) -> Entry:
    tags = ('ETag', 'etag', 'LastModified', 'updated', 'mtime', 'last-modified')
    version = next((str(about[tag]) for tag in tags if about.get(tag)), '')
    return Entry(path, int(about.get('size') or 0), version)


def _system_of(path: Path) -> tuple[Any, str]:
    """Return the file system of fsspec for a URL, and the name of the file in it."""
    import fsspec

    url = str(url_of(path))
    try:
        system, name = fsspec.core.url_to_fs(url)
    except ImportError as error:
        raise RecordingError(
            f"{url}: needs another package: pip install 'boxreg_ros[remote]' ({error})"
        ) from None
    except ValueError as error:  # an unknown scheme
        raise RecordingError(f'{url}: expected a scheme of fsspec, got: {error}') from None
    return system, str(name)


def _answer_of(path: Path, request: Callable[[], _T], missing_is_error: bool = True) -> _T:
    """
    Return the answer to a request for a file behind a URL, or raise TransferError.

    It is repeated after errors that may pass, once if there was no answer in `ANSWER_SECONDS`.
    File systems raise errors of any class.

    """
    begin = time.monotonic()
    for seconds in (*REPEAT_SECONDS, None):
        try:
            return request()
        except TransferError:
            raise
        except Exception as error:
            is_missing = (
                isinstance(error, FileNotFoundError) and _status_of(error) in MISSING_STATUS
            )
            if is_missing and not missing_is_error:
                raise
            has_time = time.monotonic() - begin < 2 * ANSWER_SECONDS
            if seconds is None or is_missing or not has_time or not _may_pass(error):
                raise _error_of(path, error, is_missing) from None
        time.sleep(seconds)
    raise AssertionError  # the last attempt returns or raises


def _may_pass(error: Exception) -> bool:
    """Return whether another request may be answered."""
    status = _status_of(error)
    if status is not None:
        return status >= 500 or status in PASSING_STATUS
    return not _is_refusal(error)


def _error_of(path: Path, error: Exception, is_missing: bool) -> TransferError:
    """Return the error of a request, with a remedy."""
    url = url_of(path)
    if _is_refusal(error) or _is_refusal(error.__cause__):
        return TransferError(
            f'{url}: expected credentials that give access, got: {_reason(error)}; set those '
            f'of this storage, as AWS_ACCESS_KEY_ID or GOOGLE_APPLICATION_CREDENTIALS'
        )
    if is_missing:
        return TransferError(f'{url}: expected a file, got none; {CAUSES}')
    return TransferError(f'{url}: got no answer: {_reason(error)}; {CAUSES}')


def _status_of(error: BaseException) -> int | None:
    """Return the status that a server has answered with, where an error knows it."""
    cause = error.__cause__ if isinstance(error, FileNotFoundError) else error
    name = 'status' if hasattr(cause, 'status') else 'code'
    status = getattr(cause, name, None)
    return status if isinstance(status, int) else None


def _is_refusal(error: BaseException | None) -> bool:
    """Return whether a server has refused the credentials, or there are none."""
    if isinstance(error, PermissionError) or type(error).__name__ == 'NoCredentialsError':
        return True  # the second one of botocore
    return error is not None and _status_of(error) in REFUSED_STATUS


def _reason(error: Exception) -> str:
    """Return the text of an error in one line, of the one that caused it where there is one."""
    cause = error.__cause__ or error
    return ' '.join(str(cause).split()) or type(cause).__name__
