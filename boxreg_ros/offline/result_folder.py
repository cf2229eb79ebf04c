"""Result folders that appear complete or not at all."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
import errno
import hashlib
import json
import os
from pathlib import Path
import shutil
from typing import Any

from boxreg_ros.datasets.files import MISSING_SWEEP
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.storage.urls import read_text, sizes_of, UPLOAD, upload, url_of
from boxreg_ros.io.whole_files import DISK_ERRORS, store, store_folder, temporary_folder
from filelock import FileLock, Timeout

REFUSED_ERRORS = (
    errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EEXIST, errno.ENOENT,
)  # fmt: skip
"""No permission, read-only file system, a file in place of a folder, no folders as in /proc."""
WITHOUT_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP)
"""Answers of file systems that have no locks, as of some clusters: everyone is let in."""
SUMMARY = 'summary.json'
CONFIG = 'config.yaml'
INPUT_MODEL = 'input_model.json'
FILES = 'files'
"""Field of the summary: size and SHA-256 of each other file, by name."""


def earlier_summary(out: Path) -> dict[str, Any] | None:
    """Return the summary of an earlier run in `out`; None if there is none."""
    try:
        summary = json.loads(read_text(out / SUMMARY))
    except (OSError, ValueError):
        return None
    return summary if isinstance(summary, dict) and 'fingerprint' in summary else None


def whole_summary(out: Path, fingerprint: str) -> dict[str, Any] | None:
    """
    Return the summary of an earlier run of the same request and files.

    None if there is none, if a file of the result is missing or empty, or if the first cloud that
    was missing is there: the fingerprint of nuScenes is that of its tables alone.

    """
    summary = earlier_summary(out)
    if summary is None or summary['fingerprint'] != fingerprint:
        return None
    found = _sizes(out) if url_of(out) is None else sizes_of(out)
    listed = summary.get(FILES, {}).items()
    lost = any(about['size'] and not found.get(name) for name, about in listed)
    missed = str(summary.get('first_unreadable', '')).partition(MISSING_SWEEP)
    has_arrived = bool(missed[1]) and Path(missed[0]).exists()
    return None if lost or has_arrived else summary


def has_changed(path: Path) -> bool:
    """Return whether a file in a result was added or changed after its run."""
    summary = earlier_summary(path.parent)
    if summary is None or not path.is_file():
        return False
    known = summary.get(FILES, {}).get(path.name, {})
    return bool(known.get('sha256') != _digest(path))


def write_summary(folder: Path, summary: dict[str, Any]) -> None:
    """Add all files of a result to its summary, and write this last file."""
    summary[FILES] = {
        name: {'size': size, 'sha256': _digest(folder / name)}
        for name, size in sorted(_sizes(folder).items())
    }
    (folder / SUMMARY).write_text(json.dumps(summary, indent=2) + '\n', encoding='utf-8')


def spare(out: Path, inputs: Iterable[Path | None]) -> None:
    """Raise ConfigError for a result folder that contains an input, symbolic links followed."""
    folder = out.resolve()
    for path in filter(None, inputs):
        if path.resolve().is_relative_to(folder):
            raise ConfigError(
                f'output {str(out)!r}: expected a folder that contains no input, got one with '
                f'{str(path)!r}, which the results would replace; choose another with -o'
            )


def spare_file(out: Path, inputs: Iterable[Path]) -> None:
    """Raise ConfigError for a file that is an input or in a folder of one, links followed."""
    file = out.resolve()
    for path in inputs:
        if file.is_relative_to(path.resolve()):
            raise ConfigError(
                f'output {str(out)!r}: expected a file that is no input and lies in none, got one '
                f'that would change {str(path)!r}; choose another with -o'
            )


@contextmanager
def claimed(out: Path) -> Iterator[None]:
    """
    Keep other runs from an output, and settle what a run that was killed has left of it.

    Object stores have no locks: of a URL, a second run is not noticed. Raises RecordingError if
    another run writes to it, or it cannot be written.

    """
    with writing(out):
        if url_of(out) is not None:
            yield
            return
        whole = out.resolve()
        whole.parent.mkdir(parents=True, exist_ok=True)
        with _locked(_beside(whole, 'lock'), out):
            partial, earlier = _beside(whole, 'partial'), _beside(whole, 'earlier')
            if earlier.exists() and not whole.exists():  # killed between the two renames
                os.replace(earlier, whole)
            for remains in (partial, earlier):
                shutil.rmtree(remains, ignore_errors=True)
            yield


@contextmanager
def _locked(lock: Path, out: Path) -> Iterator[None]:
    """Hold a lock until the end of the block or of this process."""
    held = FileLock(lock)
    try:
        held.acquire(blocking=False)
    except Timeout:
        if not lock.exists():  # nothing can be made there, which FileLock takes for contention
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(lock)) from None
        raise RecordingError(
            f'output {str(out)!r}: expected one that no other process writes to, got one in use; '
            f'wait until that has ended, or choose another with -o'
        ) from None
    except OSError as error:
        if error.errno not in WITHOUT_LOCKS:
            raise
        yield
        return
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)  # while it is held: a lock without a name is not taken
        held.release()


@contextmanager
def whole_folder(out: Path, inputs: Iterable[Path | None] = ()) -> Iterator[Path]:
    """
    Yield a temporary folder that replaces a result folder on success, and is deleted on failure.

    On success all of it is on the disk itself.

    Parameters
    ----------
    out : Path
        The result folder; the caller has `claimed` it.
    inputs : iterable of Path or None
        Files and folders that the results may not replace.

    Yields
    ------
    folder : Path
        The temporary folder, empty.

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
    partial, earlier = _beside(out, 'partial'), _beside(out, 'earlier')
    try:
        with writing(out):
            partial.mkdir(parents=True)
            yield partial
            store_folder(partial)
            if out.exists():
                os.replace(out, earlier)
            os.replace(partial, out)
            store([out.parent])
    finally:
        if earlier.exists() and not out.exists():
            os.replace(earlier, out)
        shutil.rmtree(partial, ignore_errors=True)
        shutil.rmtree(earlier, ignore_errors=True)


@contextmanager
def _uploaded_folder(out: Path) -> Iterator[Path]:
    """Yield a folder of this machine that is uploaded to the URL `out` on success."""
    if earlier_summary(out) is not None:
        _check_unchanged(out)
    else:
        names = sizes_of(out)
        if names and UPLOAD not in names:
            raise _other_files(out)
    with temporary_folder() as folder:
        yield folder
        upload(folder, out, SUMMARY)


@contextmanager
def writing(out: Path) -> Iterator[None]:
    """Raise errors of the file system, as of a full disk, as RecordingError with the output."""
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


def _check_replaceable(out: Path) -> None:
    """Refuse a folder that is not the unchanged result of an earlier run."""
    if out.exists() and Path.cwd().is_relative_to(out.resolve()):
        raise ConfigError(
            f'output {str(out)!r}: expected a folder that is not the current one nor contains '
            f'it, which a result replaces; choose another with -o, or change the folder'
        )
    is_empty = out.is_dir() and not any(out.iterdir())
    if out.exists() and earlier_summary(out) is None and not is_empty:
        raise _other_files(out)
    _check_unchanged(out)


def _check_unchanged(out: Path) -> None:
    """Refuse an earlier result with files that were changed or added since."""
    changed = _changed_since(out)
    if changed is not None:
        raise RecordingError(
            f'output {str(out)!r}: expected an unchanged earlier result, got one with '
            f'{changed!r} changed or added since, which would be lost; choose another with '
            f'-o, or delete this one'
        )


def _other_files(out: Path) -> RecordingError:
    return RecordingError(
        f'output {str(out)!r}: expected a new folder or an earlier result, got other files; '
        f'choose another with -o'
    )


def _changed_since(out: Path) -> str | None:
    """
    Return the name of a file in a result whose content is not what the summary states.

    Behind a URL, whose size is not.

    """
    listed = (earlier_summary(out) or {}).get(FILES, {})
    is_remote = url_of(out) is not None
    for name, size in (sizes_of(out) if is_remote else _sizes(out)).items():
        known = listed.get(name, {})
        is_same = known.get('size') == size
        if is_same and not is_remote:
            is_same = known['sha256'] == _digest(out / name)
        if size and not is_same and name != SUMMARY:
            return name
    return None


def _sizes(folder: Path) -> dict[str, int]:
    """Return names and sizes [bytes] of all files of a result but its summary."""
    sizes = {}
    for parent, _, names in os.walk(folder):
        prefix = os.path.relpath(parent, folder)
        for name in names:
            path = os.path.normpath(os.path.join(prefix, name))
            sizes[path] = os.stat(os.path.join(parent, name)).st_size
    sizes.pop(SUMMARY, None)
    return sizes


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open('rb', buffering=0) as file:
        return hashlib.file_digest(file, 'sha256').hexdigest()


def _beside(out: Path, suffix: str) -> Path:
    """Return the hidden path beside an output for its lock or its parts."""
    return out.parent / f'.{out.name}.{suffix}'


def _is_near(path: Path, out: Path) -> bool:
    """Return whether a path is `out`, a folder above it, or a temporary one beside it."""
    whole = out.resolve()
    if whole.is_relative_to(path.resolve()):
        return True
    hidden = str(_beside(whole, ''))
    return str(path.resolve()).startswith(hidden)
