"""The jobs of `boxreg batch`: one per drive, with a name of its own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from glob import glob
import os
from pathlib import Path
import re
import shlex
from urllib.parse import urlsplit

from boxreg_ros.datasets.registry import address_of, all_scenes, resolved, scene_files
from boxreg_ros.errors import BoxregError, ConfigError, RecordingError
from boxreg_ros.io.storage.urls import entries_of, url_of
from boxreg_ros.offline.result_folder import INPUT_MODEL

MANIFESTS = ('.txt', '.lst')
COMMENT = re.compile(r"""(\\.|"[^"]*"|'[^']*')|(?:^|\s)#.*""")
"""
A comment of a manifest, or what may hold a ``#`` that begins none: within a word, ``#`` begins
the name of a scene.

"""
SUFFIX = re.compile(r'(?<=.)\.(mcap|db3|bag|active)(\.zstd?)?$')
"""Suffixes of recordings; other dots belong to the name, as those of dates."""
LEARNING = 'learning'
"""Folder of the first results of `--learn`."""
RESERVED = frozenset({LEARNING, INPUT_MODEL, 'index.csv', 'summary.json', 'report.html'})
"""Names in the output that no drive may have."""


@dataclass(frozen=True)
class Job:
    """One drive."""

    name: str  # of its result folder
    # merged by time; absolute, so that they are the same on each machine
    recordings: tuple[Path, ...]
    problem: str = ''  # why it cannot be done; empty if it can

    def size(self) -> int:
        """Return the size of all files on this machine [bytes]; 0 where they cannot be found."""
        with suppress(OSError, RecordingError):
            local = [path for path in self._paths() if url_of(path) is None]
            return sum(entry.size for path in local for entry in entries_of(path))
        return 0

    def _paths(self) -> Iterator[Path]:
        """Yield the files or folders of the recordings."""
        for path in self.recordings:
            address = address_of(path)
            # Before `url_of`: an address looks like a URL.
            yield from [path] if address is None else scene_files(address)


def jobs_of(arguments: Sequence[Path]) -> list[Job]:
    """
    Return one job per drive of recordings, patterns, manifests and data sets.

    A manifest is a text file with one drive per line: its recordings, merged by time. Relative
    paths begin at the manifest; ``#`` begins a comment. A data set without the name of a scene
    is one drive per scene. A drive that does not exist, or is named a second time, has a problem.
    Raises ConfigError if two drives have the same name.

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
    jobs = [Job(str(drive[0]), _absolute(drive), _problem(drive, seen)) for drive in drives]
    names = names_of([job.recordings for job in jobs if not job.problem])
    return [job if job.problem else Job(names[job.recordings], job.recordings) for job in jobs]


def names_of(drives: Collection[tuple[Path, ...]]) -> dict[tuple[Path, ...], str]:
    """
    Return a name for each drive: that of its first recording, with folders where it needs them.

    The order of the drives does not matter. Raises ConfigError if two drives have the same name
    with all their folders.

    """
    parts = {drive: _parts(drive[0]) for drive in drives}
    plain = Counter((*part[:-1], _plain(part[-1])) for part in parts.values())
    for drive, (*folders, last) in parts.items():
        if plain[*folders, _plain(last)] == 1:  # else the suffix distinguishes it
            parts[drive] = (*folders, _plain(last))
    depths = dict.fromkeys(parts, 1)
    while True:
        found = {drive: '_'.join(parts[drive][-depth:]) for drive, depth in depths.items()}
        uses = Counter(found.values())
        same = [drive for drive, name in found.items() if uses[name] > 1 or name in RESERVED]
        if not same:
            return found
        if all(depths[drive] >= len(parts[drive]) for drive in same):
            raise ConfigError(
                f'drives: expected each to have a name of its own, got {str(same[0][0])!r} and '
                f'another that are both {found[same[0]]!r} in the output; rename one'
            )
        for drive in same:
            depths[drive] += 1


def _parts(path: Path) -> tuple[str, ...]:
    """Return the folders and the name of a recording, or of a data set and its scene."""
    address = address_of(path)
    if address is not None:
        return (*address.root.parts[1:], resolved(address).scene)
    url = url_of(path)
    if url is None:
        return path.parts[1:] or ('root',)
    split = urlsplit(url)
    path_of_url = split.path if split.scheme.startswith('http') else url.partition('//')[2]
    return tuple(part for part in (split.netloc, *path_of_url.split('/')) if part)


def _plain(name: str) -> str:
    """Return the name of a recording without the suffix of its storage."""
    return SUFFIX.sub('', name)


def _absolute(drive: tuple[Path, ...]) -> tuple[Path, ...]:
    """Return the recordings of a drive with paths that do not depend on the current folder."""
    paths = []
    for path in drive:
        address = address_of(path)
        if address is not None:
            path = Path(str(address._replace(root=Path(os.path.abspath(address.root)))))
        elif url_of(path) is None:
            path = Path(os.path.abspath(path))
        paths.append(path)
    return tuple(paths)


def _manifest(path: Path) -> Iterator[tuple[Path, ...]]:
    try:
        text = path.read_text(encoding='utf-8-sig')
        if '\0' in text:
            raise ValueError('a NUL character')
        drives = [shlex.split(COMMENT.sub(r'\1', line)) for line in text.splitlines()]
    except ValueError as error:  # UnicodeDecodeError, too
        raise ConfigError(
            f'{path}: expected a text in UTF-8 with the recordings of one drive per line, got '
            f'{error}; correct it'
        ) from None
    for words in filter(None, drives):
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
