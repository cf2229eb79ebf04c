"""
Files behind URLs: ``s3://``, ``gs://``, ``https://`` and others that fsspec opens.

A URL is carried as a `Path`, which has one slash in place of two behind the scheme. Requests that
fail are repeated, and then raise `TransferError`.

"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
import re
import time
from typing import Any, NamedTuple, TypeVar

from boxreg_ros.errors import one_line, RecordingError, TransferError

URL = re.compile(r'([a-z][a-z0-9+.-]+):/+(.+)')
"""A scheme has two letters or more."""
THIS_MACHINE = 'file'
"""Scheme of the files of this machine: its URLs have no server, and a third slash."""
ANSWER_SECONDS = 60.0
"""Longest time for an answer [s]: 256 kB/s for the largest range, and ten times a slow listing."""
REPEAT_SECONDS = (0.5, 2.0, 8.0)
"""Waiting times before a request is repeated [s]: servers restart, or limit the rate."""
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
    """Name, size [bytes] and version (tag or time) of a file."""

    path: Path
    size: int
    version: str


def url_of(path: Path) -> str | None:
    """Return the URL that a path carries; None for a path of this machine."""
    match = URL.fullmatch(str(path))
    if match is None:
        return None
    server = '' if match[1] != THIS_MACHINE else '/'
    return f'{match[1]}://{server}{match[2]}'


def entry_of(path: Path) -> Entry:
    """Return size and version of a file behind a URL; RecordingError without an answer."""
    return _entry(path, _answer(path, 'info'))


def entries_of(path: Path, is_deep: bool = False) -> list[Entry]:
    """
    Return a file, or the files in the folder that it is, sorted by name; none if there is none.

    Parameters
    ----------
    path
        A path of this machine, or a URL.
    is_deep
        Whether files in folders of it belong to it, too; of this machine only.

    Raises
    ------
    TransferError
        If there is nothing behind a URL, or no answer.

    """
    if url_of(path) is None:
        paths = sorted(path.glob('**/*' if is_deep else '*')) if path.is_dir() else [path]
        found = [(file, file.stat()) for file in paths if file.is_file()]
        return [Entry(file, status.st_size, str(status.st_mtime_ns)) for file, status in found]
    about = _answer(path, 'info')
    if about['type'] != 'directory':
        return [_entry(path, about)]
    listed = _answer(path, 'ls', detail=True)
    inner = sorted(listed, key=lambda one: str(one['name']))
    files = [one for one in inner if one['type'] == 'file']
    return [_entry(path / Path(one['name']).name, one) for one in files]


def read_text(path: Path) -> str:
    """Return the text of a file of this machine or behind a URL; OSError if there is none."""
    if url_of(path) is None:
        return path.read_text(encoding='utf-8')
    content = _answer(path, 'cat_file', missing_is_error=False)
    return bytes(content).decode()


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file behind a URL; it appears whole."""
    system, name = system_of(path)
    answer_of(path, lambda: system.pipe_file(name, content))


def delete_files(path: Path, names: Iterable[str]) -> None:
    """Delete some files of a folder behind a URL."""
    system, name = system_of(path)
    for one in names:
        answer_of(path, partial(system.rm_file, f'{name}/{one}'))


def sizes_of(path: Path) -> dict[str, int]:
    """Return names and sizes [bytes] of all files below a folder behind a URL."""
    _, name = system_of(path)
    found = _answer(path, 'find', detail=True)
    return {
        str(one).removeprefix(name).lstrip('/'): int(about['size']) for one, about in found.items()
    }


def upload(folder: Path, target: Path, last: str) -> None:
    """
    Replace a folder behind a URL by one of this machine.

    Parameters
    ----------
    folder : Path
        On this machine.
    target : Path
        Stands for the URL. `UPLOAD` is in it from before the first change until the end.
    last : str
        Name of the file that marks a whole result: it is deleted first, and written when all
        others are.

    Raises
    ------
    TransferError
        If a file cannot be written or deleted.

    """
    system, name = system_of(target)
    files = {str(file.relative_to(folder)) for file in folder.rglob('*') if file.is_file()}
    write_bytes(target / UPLOAD, b'')
    old = sizes_of(target)
    first_deleted = [last] if last in old else []
    delete_files(target, [*first_deleted, *sorted(set(old) - files - {last, UPLOAD})])
    for file in sorted(files, key=lambda file: (file == last, file)):
        answer_of(target, partial(system.put_file, str(folder / file), f'{name}/{file}'))
    delete_files(target, [UPLOAD])


def _answer(path: Path, request: str, missing_is_error: bool = True, **options: Any) -> Any:
    """Return the answer of fsspec to a request for what is behind a URL; see `answer_of`."""
    system, name = system_of(path)
    ask = partial(getattr(system, request), name, **options, **limit_of(system))
    return answer_of(path, ask, missing_is_error)


def limit_of(system: Any) -> dict[str, float]:
    """Return the argument of fsspec that limits the time of a request, where it has one."""
    return {'timeout': ANSWER_SECONDS} if system.async_impl else {}


def _entry(path: Path, about: dict[str, Any]) -> Entry:
    tags = ('ETag', 'etag', 'LastModified', 'updated', 'mtime', 'last-modified')
    version = next((str(about[tag]) for tag in tags if about.get(tag)), '')
    return Entry(path, int(about.get('size') or 0), version)


def system_of(path: Path) -> tuple[Any, str]:
    """Return the file system of fsspec for a URL, and the name of the file in it."""
    import fsspec

    url = str(url_of(path))
    try:
        is_here = url.startswith(f'{THIS_MACHINE}:')
        system, name = fsspec.core.url_to_fs(url, **({'auto_mkdir': True} if is_here else {}))
    except ImportError as error:
        raise RecordingError(
            f"{url}: needs another package: pip install 'boxreg_ros[remote]' ({error})"
        ) from None
    except ValueError as error:  # an unknown scheme
        raise RecordingError(f'{url}: expected a scheme of fsspec, got: {error}') from None
    return system, str(name)


def answer_of(path: Path, request: Callable[[], _T], missing_is_error: bool = True) -> _T:
    """
    Return the answer to a request for a file behind a URL.

    It is repeated after errors that may pass, once if there was no answer in `ANSWER_SECONDS`.

    Parameters
    ----------
    path : Path
        Stands for the URL, for the error message.
    request : callable
        Asks the file system, which raises errors of any class.
    missing_is_error : bool
        False leaves FileNotFoundError as it is, for a file that may be missing.

    Returns
    -------
    answer
        What `request` returns.

    Raises
    ------
    TransferError
        If there is no answer, or it is an error that does not pass.

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
    return one_line(error.__cause__ or error)
