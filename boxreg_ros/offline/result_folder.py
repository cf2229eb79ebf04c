"""Result folders that appear complete or not at all."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
import errno
from glob import escape
import json
import os
from pathlib import Path
import shutil
from typing import Any
from uuid import uuid4

from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.storage.urls import names_of, read_text, upload, url_of
from boxreg_ros.io.whole_files import DISK_ERRORS, temporary_folder

REFUSED_ERRORS = (
    errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EEXIST, errno.ENOENT,
)  # fmt: skip
"""No permission, read-only file system, a file in place of a folder, no folders as in /proc."""
SUMMARY = 'summary.json'
CONFIG = 'config.yaml'


def earlier_summary(out: Path) -> dict[str, Any] | None:
    """Return the summary of an earlier run in `out`; None if there is none."""
    try:
        summary = json.loads(read_text(out / SUMMARY))
    except (OSError, ValueError):
        return None
    return summary if isinstance(summary, dict) and 'fingerprint' in summary else None


def spare(out: Path, inputs: Iterable[Path | None]) -> None:
    """
    Refuse to replace a result folder that contains an input.

    Raises
    ------
    ConfigError
        If one of `inputs` is `out` or lies in it, symbolic links followed.

    """
    folder = out.resolve()
    for path in filter(None, inputs):
        if path.resolve().is_relative_to(folder):
            raise ConfigError(
                f'output {str(out)!r}: expected a folder that contains no input, got one with '
                f'{str(path)!r}, which the results would replace; choose another with -o'
            )


def spare_file(out: Path, inputs: Iterable[Path]) -> None:
    """
    Refuse to write a file over an input.

    Raises
    ------
    ConfigError
        If `out` is one of `inputs`, or lies in a folder that is one, symbolic links followed.

    """
    file = out.resolve()
    for path in inputs:
        if file.is_relative_to(path.resolve()):
            raise ConfigError(
                f'output {str(out)!r}: expected a file that is no input and lies in none, got one '
                f'that would change {str(path)!r}; choose another with -o'
            )


@contextmanager
def whole_folder(out: Path, inputs: Iterable[Path | None] = ()) -> Iterator[Path]:
    """
    Yield a temporary folder that replaces `out` on success and is deleted on failure.

    Raises
    ------
    ConfigError
        If one of `inputs` is in `out`.
    RecordingError
        If `out` exists and is not the unchanged result of an earlier run, or cannot be written.

    """
    if url_of(out) is not None:
        with _uploaded_folder(out) as folder:
            yield folder
        return
    spare(out, inputs)
    _check_replaceable(out)
    out = out.resolve()
    unique = f'.{out.name}.{uuid4().hex[:8]}'
    partial = out.with_name(f'{unique}.partial')
    earlier = out.with_name(f'{unique}.earlier')
    try:
        with writing(out):
            partial.mkdir(parents=True)
            yield partial
            if out.exists():
                os.replace(out, earlier)
            os.replace(partial, out)
    finally:
        if earlier.exists() and not out.exists():
            os.replace(earlier, out)
        shutil.rmtree(partial, ignore_errors=True)
        shutil.rmtree(earlier, ignore_errors=True)


@contextmanager
def _uploaded_folder(out: Path) -> Iterator[Path]:
    """Yield a folder of this machine that is uploaded to the URL `out` on success."""
    if earlier_summary(out) is None and names_of(out):
        raise _other_files(out)
    with temporary_folder() as folder:
        yield folder
        upload(folder, out, SUMMARY)


@contextmanager
def writing(out: Path) -> Iterator[None]:
    """
    Name the output in errors of the file system.

    Raises
    ------
    RecordingError
        If the disk of `out` is full, or it cannot be written.

    """
    try:
        yield
    except OSError as error:
        # A write has no file name; errors of inputs have that of the input.
        is_own = error.filename is None or _is_near(Path(error.filename), out)
        if is_own and error.errno in DISK_ERRORS:
            raise RecordingError(
                f'output {str(out)!r}: expected room for all files, got: {error.strerror}; '
                f'nothing was written: free some space, or choose another disk with -o'
            ) from None
        if is_own and error.errno in REFUSED_ERRORS:
            raise RecordingError(
                f'output {str(out)!r}: expected a folder that can be written, got: '
                f'{error.strerror} ({error.filename}); nothing was written: choose another with -o'
            ) from None
        raise


def delete_remains(out: Path) -> None:
    """Delete the partial results of runs that were killed; none may be running."""
    if url_of(out) is not None:
        return
    whole = out.resolve()
    for remains in whole.parent.glob(f'.{escape(whole.name)}.*.partial'):
        shutil.rmtree(remains, ignore_errors=True)


def _check_replaceable(out: Path) -> None:
    """Refuse a folder that is not the unchanged result of an earlier run."""
    if out.exists() and earlier_summary(out) is None and not _is_empty(out):
        raise _other_files(out)
    changed = _changed_since(out)
    if changed is not None:
        raise RecordingError(
            f'output {str(out)!r}: expected an unchanged earlier result, got one with '
            f'{str(changed)!r} changed or added since, which would be lost; choose another with '
            f'-o, or delete this one'
        )


def _other_files(out: Path) -> RecordingError:
    return RecordingError(
        f'output {str(out)!r}: expected a new folder or an earlier result, got other files; '
        f'choose another with -o'
    )


def _changed_since(out: Path) -> Path | None:
    """Return a file in a result that is younger than its summary, which is written last."""
    summary = out / SUMMARY
    if not summary.is_file():
        return None
    made_ns = summary.stat().st_mtime_ns
    for file in out.rglob('*'):
        if file.is_file() and file.stat().st_mtime_ns > made_ns:
            return file.relative_to(out)
    return None


def _is_near(path: Path, out: Path) -> bool:
    """Return whether a path is `out`, a folder above it, or a temporary one beside it."""
    whole = out.resolve()
    if whole.is_relative_to(path.resolve()):
        return True
    hidden = str(whole.with_name(f'.{whole.name}.'))
    return str(path.resolve()).startswith(hidden)


def _is_empty(folder: Path) -> bool:
    return folder.is_dir() and not any(folder.iterdir())
