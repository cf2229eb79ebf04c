"""The jobs of `boxreg batch`: one per drive, with a key of its content, options and version."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from glob import glob
import hashlib
import os
from pathlib import Path
import re
import shlex
from typing import Any

from boxreg_ros import __version__
from boxreg_ros.datasets import address_of, all_scenes, resolved, scene_files
from boxreg_ros.errors import BoxregError, RecordingError
from boxreg_ros.io.storage.urls import entries_of, Entry, url_of

MANIFESTS = ('.txt', '.lst')
COMMENT = re.compile(r'(^|\s)#.*')
"""A comment of a manifest; within a word, ``#`` begins the name of a scene."""
JOB_FAILED = 'failed'
JOB_DONE = 'done'
UP_TO_DATE = 'up to date'


@dataclass
class Job:
    """
    One drive.

    Attributes
    ----------
    name : str
        Name of its result folder.
    recordings : tuple of Path
        Files or folders, merged by time.
    size : int
        Size of all files [bytes]; 0 where it is unknown.
    key : str
        Hash of the content of its files, the options and the version.
    status : str
        ``waiting``, ``done``, ``up to date`` or ``failed``.
    exit_status : int or None
        Of its last process; negative for the signal that ended it.
    attempts : int
        Processes that were started.
    seconds : float
        Time of all attempts [s].
    peak_bytes : int
        Largest memory of a process and its workers, shared pages divided among them.
    last_line : str
        Last line that its process printed, or why it failed.
    summary : dict
        Content of its ``summary.json``.

    """

    name: str
    recordings: tuple[Path, ...]
    size: int = 0
    key: str = ''
    status: str = 'waiting'
    exit_status: int | None = None
    attempts: int = 0
    seconds: float = 0.0
    peak_bytes: int = 0
    last_line: str = ''
    summary: dict[str, Any] = field(default_factory=dict)

    def files(self) -> Iterator[Path]:
        """Yield all files of the recordings on this machine."""
        for path in self.recordings:
            address = address_of(path)
            if address is not None:  # before `url_of`: it looks like a URL
                yield from scene_files(address)
                continue
            if url_of(path) is not None:
                continue
            inner = sorted(path.iterdir()) if path.is_dir() else [path]
            yield from (file for file in inner if file.is_file())

    def measure(self) -> None:
        """Set `size`; a job whose files cannot be found reports it when it runs."""
        with suppress(OSError, RecordingError):
            local = sum(file.stat().st_size for file in self.files())
            self.size = local + sum(entry.size for entry in self.entries())

    def entries(self) -> Iterator[Entry]:
        """Yield all files of the recordings behind URLs."""
        for path in self.recordings:
            if url_of(path) is not None and address_of(path) is None:
                yield from entries_of(path)

    def fail(self, reason: str) -> None:
        """Note why the job cannot be done."""
        self.status = JOB_FAILED
        self.last_line = reason

    def hashes(self, earlier: Sequence[Sequence[Any]]) -> list[list[Any]]:
        """
        Return path, size, time and hash of each file; of a URL the tag or time of its server.

        Parameters
        ----------
        earlier : sequence
            Return value of an earlier run: unchanged files are not read again.

        """
        known = {tuple(found[:3]): found[3] for found in earlier}
        hashes = []
        for file in self.files():
            about = file.stat()
            place = str(file.resolve()), about.st_size, about.st_mtime_ns
            hashes.append([*place, known.get(place) or _hash(file)])
        hashes += [[str(one.path), one.size, 0, one.version] for one in self.entries()]
        return hashes

    def set_key(self, hashes: Sequence[Sequence[Any]], settings: Sequence[str]) -> None:
        """Set the key from the hashes of the files and the settings."""
        content = repr((__version__, list(settings), [found[-1] for found in hashes]))
        self.key = hashlib.sha256(content.encode()).hexdigest()


def jobs_of(arguments: Sequence[Path]) -> list[Job]:
    """
    Return one job per drive of recordings, patterns, manifests and data sets.

    A manifest is a text file with one drive per line: its recordings, merged by time. Relative
    paths begin at the manifest; ``#`` begins a comment. A data set without the name of a scene
    is one drive per scene. A drive that does not exist, or is named a second time, has failed
    already.

    """
    drives: list[tuple[Path, ...]] = []
    for argument in arguments:
        if argument.suffix in MANIFESTS and argument.is_file():
            drives += _manifest(argument)
        elif (address := address_of(argument)) is not None:
            drives += [(Path(str(scene)),) for scene in all_scenes(address)]
        elif url_of(argument) is None and not argument.exists() and glob(str(argument)):
            drives += [(Path(path),) for path in sorted(glob(str(argument)))]
        else:
            drives.append((argument,))
    seen: set[Path] = set()
    problems = [_problem(drive, seen) for drive in drives]
    names = iter(_names([d for d, problem in zip(drives, problems, strict=True) if not problem]))
    jobs = []
    for drive, problem in zip(drives, problems, strict=True):
        job = Job(str(drive[0]) if problem else next(names), drive)
        if problem:
            job.fail(problem)
        jobs.append(job)
    return jobs


def _manifest(path: Path) -> Iterator[tuple[Path, ...]]:
    for line in path.read_text(encoding='utf-8').splitlines():
        words = shlex.split(COMMENT.sub('', line))
        if words:
            yield tuple(_listed(path.parent, word) for word in words)


def _listed(folder: Path, word: str) -> Path:
    """Return a path of a manifest in `folder`; a URL or the address of a scene unchanged."""
    path = Path(word)
    is_address = url_of(path) is not None or address_of(path) is not None
    return path if is_address else folder / word


def _problem(drive: tuple[Path, ...], seen: set[Path]) -> str:
    """Return why a drive cannot be done; empty if it can. Its recordings become `seen`."""
    for path in drive:
        address = address_of(path)
        if address is not None:
            try:
                resolved(address)
            except BoxregError as error:
                return str(error)
        elif url_of(path) is None and not path.exists():
            return 'expected a recording, got no such file; correct its path, or leave it out'
        if path.resolve() in seen:
            return 'expected each recording once, got it a second time; leave one out'
        seen.add(path.resolve())
    return ''


def _names(drives: Sequence[tuple[Path, ...]]) -> list[str]:
    """Return a name for each drive: the stem of its first path, with its folders if needed."""
    stems = [_stem(drive[0]) for drive in drives]
    if len(set(stems)) == len(stems):
        return stems
    paths = [str(drive[0].resolve().with_suffix('')) for drive in drives]
    common = os.path.commonpath(paths)
    return [os.path.relpath(path, common).replace(os.sep, '_') for path in paths]


def _stem(path: Path) -> str:
    """Return the name of a recording without its suffix, or that of a scene."""
    address = address_of(path)
    return path.stem if address is None else resolved(address).scene


def _hash(path: Path) -> str:
    with path.open('rb') as file:
        return hashlib.file_digest(file, 'sha256').hexdigest()
