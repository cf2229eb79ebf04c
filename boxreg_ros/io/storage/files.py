"""Which files a recording consists of, and how each is opened."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing, ExitStack
import errno
from heapq import merge
from itertools import starmap
from operator import itemgetter
import os
from pathlib import Path, PurePath
import re
from typing import Any, NamedTuple

from boxreg_ros.config import YAML_ERRORS
from boxreg_ros.errors import one_line, RecordingError, TransferError, unreadable
from boxreg_ros.io.foxglove import FOXGLOVE_ENCODINGS, ros_type, schema_as_definition
from boxreg_ros.io.storage.mcap import McapFile
from boxreg_ros.io.storage.record import Damage, Record, span_ns, StorageFile
from boxreg_ros.io.storage.rosbag1 import Rosbag1File
from boxreg_ros.io.storage.sqlite import SqliteFile
from boxreg_ros.io.storage.urls import entries_of, entry_of, url_of
from boxreg_ros.io.whole_files import temporary_folder
from rosbags.interfaces import Connection
import yaml
import zstandard

Opener = Callable[[Path, Path | None], StorageFile]
OPENERS: dict[str, Opener] = {
    '.mcap': McapFile,
    '.db3': SqliteFile,
    '.bag': Rosbag1File,
    '.active': Rosbag1File,  # of a recorder that has not ended
}
COMPRESSED = ('.zstd', '.zst')
METADATA = 'metadata.yaml'
BLOCK_BYTES = 2**12
"""Bytes that are decompressed at a time; damage in one costs all of it."""
MAX_RATIO = 1000
"""Largest ratio of a file to its compressed one; point clouds are compressed to a third."""
SPARE_BYTES = 2**16
"""Bytes that the compressed file may lack for this ratio, at its begin."""


class Part(NamedTuple):
    """The files of one path of a recording."""

    path: Path
    files: tuple[Path, ...]
    missing: tuple[Path, ...] = ()
    """Those in its metadata that do not exist."""
    unlisted: tuple[Path, ...] = ()
    """Those beside them that its metadata does not have."""


def part_of(path: Path) -> Part:
    """
    Return the files of a recording: of a folder those in its metadata, or all without metadata.

    Raises RecordingError if it does not exist, or is a folder without files of recordings.

    """
    if url_of(path) is not None:
        found = [entry.path for entry in entries_of(path) if _kind(entry.path) in OPENERS]
        return Part(path, tuple(_some(path, sorted(found, key=in_order))))
    if not path.exists():
        raise RecordingError(f'no such recording: {str(path)!r}; correct its path')
    if not path.is_dir():
        return Part(path, (path,))
    listed = _listed(path)
    found = [file for file in path.iterdir() if file.is_file() and _kind(file) in OPENERS]
    there = sorted(found, key=in_order)
    files = [file for file in listed if file.is_file()] or there
    missing = tuple(file for file in listed if not file.is_file())
    read = {_unpacked(file) for file in files}
    unlisted = tuple(file for file in there if _unpacked(file) not in read)
    return Part(path, tuple(_some(path, files)), missing, unlisted)


def in_order(path: Path) -> list[tuple[int, str]]:
    """Return the key that sorts the parts of a recording: ``drive_10`` behind ``drive_9``."""
    parts = re.findall('([0-9]+)|([^0-9]+)', path.name)
    return [(int(number or -1), text) for number, text in parts]


def _some(path: Path, files: list[Path]) -> list[Path]:
    """Return the files of a folder; RecordingError if there are none."""
    if not files:
        raise RecordingError(
            f'{str(path)!r} is no recording: expected {METADATA}, .mcap, .db3 or .bag files in '
            f'it, got none; give the folder that has them'
        )
    return files


def size_of(path: Path) -> int:
    """Return the size of a file of this machine or behind a URL [bytes]."""
    return path.stat().st_size if url_of(path) is None else entry_of(path).size


def opened(path: Path) -> StorageFile:
    """Open a file, unpacked first if compressed; RecordingError if nothing can be read."""
    opener = OPENERS.get(_kind(path))
    if opener is None:
        raise RecordingError(
            f'{str(path)!r}: expected an .mcap, .db3 or .bag file, or a rosbag2 folder, got '
            f'another; give a recording, or correct the suffix of its name'
        )
    is_remote, is_compressed = url_of(path) is not None, path.suffix in COMPRESSED
    if not is_remote:
        if not os.access(path, os.R_OK):
            denied = PermissionError(errno.EACCES, os.strerror(errno.EACCES))
            raise TransferError(unreadable(path, denied))
        if not size_of(path):
            raise RecordingError(
                f'{path}: expected a recording, got an empty file; copy it again, or leave it out'
            )
    if not is_compressed and (not is_remote or opener is McapFile):  # MCAP is read by blocks
        try:
            return opener(path, None)
        except OSError as error:  # as by the limit of open files: nothing is known of the file
            raise TransferError(unreadable(path, error)) from None
    with temporary_folder() as folder:
        file, damage = path, None
        if is_remote:
            from boxreg_ros.io.storage.remote_file import download  # fsspec takes 0.5 s

            file = folder / path.name
            download(path, file)
        if is_compressed:
            packed, file = file, folder / path.stem
            damage = _unpack(packed, file, path)
        found = opener(file, path)
        if damage is not None:
            found.damages = {damage: None, **found.damages}
        return found


class Files:
    """Several open files of one path as one `StorageFile`; one that does not open is a damage."""

    def __init__(self, part: Part) -> None:
        self._files: list[StorageFile] = []
        self._damages = [
            Damage(str(file), f'file is missing; {METADATA} lists it') for file in part.missing
        ]
        self._damages += [
            Damage(str(file), f'{METADATA} does not list this file, which is left out: to read '
                   f'it, run ros2 bag reindex, or delete {METADATA}')
            for file in part.unlisted
        ]  # fmt: skip
        first_error: RecordingError | None = None
        with ExitStack() as stack:
            for path in part.files:
                try:
                    self._files.append(stack.enter_context(closing(opened(path))))
                except TransferError:
                    raise
                except RecordingError as error:
                    first_error = first_error or error
                    size = size_of(path)
                    self._damages.append(Damage(str(path), str(error), 0, size))
            if first_error is not None and not self._files:
                raise first_error
            self._opened = stack.pop_all()
        self.start_time, self.end_time = span_ns([(f.start_time, f.end_time) for f in self._files])
        self._own: list[list[Connection]] = []
        for file in self._files:
            for connection in file.connections:
                self._add(as_ros(connection))
        self.connections = [
            own[0]._replace(id=number, owner=self, msgcount=sum(c.msgcount for c in own))
            for number, own in enumerate(self._own)
        ]

    def _add(self, connection: Connection) -> None:
        """Add a connection to those of its topic, type and definition; one without fits each."""
        for own in self._own:
            if _channel(own[0]) == _channel(connection):
                definitions = {own[0].msgdef.data, connection.msgdef.data} - {''}
                if len(definitions) < 2:
                    is_first = bool(connection.msgdef.data) and not own[0].msgdef.data
                    own.insert(0 if is_first else len(own), connection)
                    return
        self._own.append([connection])

    @property
    def damages(self) -> list[Damage]:
        """Return the damages of all files."""
        return [*self._damages, *(damage for file in self._files for damage in file.damages)]

    def close(self) -> None:
        """Close all files."""
        self._opened.close()

    def messages(
        self, connections: Collection[Connection], start: int | None, stop: int | None
    ) -> Iterator[Record]:
        """Yield the messages of all files, each opened when the stream reaches it."""
        shared = self._shared(connections)
        streams = []
        for file in self._files:
            wanted = [c for c in file.connections if (id(c.owner), c.id) in shared]
            if wanted:
                streams.append((file.start_time, file.messages(wanted, start, stop)))
        for record in merged_streams(streams):
            connection = record.connection
            yield record._replace(connection=shared[id(connection.owner), connection.id])

    def spans(self) -> Iterator[tuple[int, int, int]]:
        """Yield connection id, first and last receive time [ns] of the parts of all files."""
        shared = self._shared(self.connections)
        for file in self._files:
            for number, first_ns, last_ns in file.spans():
                if (id(file), number) in shared:
                    yield shared[id(file), number].id, first_ns, last_ns

    def _shared(self, connections: Collection[Connection]) -> dict[tuple[int, int], Connection]:
        """Return those of `connections` by file and id of the files' own connections."""
        return {
            (id(own.owner), own.id): connection
            for connection, group in zip(self.connections, self._own, strict=True)
            if connection in connections
            for own in group
        }


def encoding_of(connection: Connection) -> str:
    """Return the encoding of messages: ``cdr``, ``ros1``, ``json``, ``protobuf``."""
    return getattr(connection.ext, 'serialization_format', 'ros1')


def as_ros(connection: Connection) -> Connection:
    """Return a connection; one with a schema of Foxglove gets the ROS type it is read as."""
    owner: Any = connection.owner
    if encoding_of(connection) not in FOXGLOVE_ENCODINGS:
        return connection
    schema = owner.schema_of(connection)
    if schema is None:
        return connection
    return connection._replace(msgtype=ros_type(schema.name), msgdef=schema_as_definition(schema))


def _channel(connection: Connection) -> tuple[str, ...]:
    """Return topic, type and encoding of a connection."""
    return connection.topic, connection.msgtype, encoding_of(connection)


def merged_streams(streams: Sequence[tuple[int, Iterator[Record]]]) -> Iterator[Record]:
    """Merge streams by receive time; a stream is begun when its start time [ns] is reached."""

    def timed(start_ns: int, stream: Iterator[Record]) -> Iterator[tuple[int, Record | None]]:
        yield start_ns, None  # `merge` asks each stream for its first item at once
        for record in stream:
            yield record.received_ns, record

    for _, record in merge(*starmap(timed, streams), key=itemgetter(0)):
        if record is not None:
            yield record


def _kind(path: Path) -> str:
    """Return the suffix of a file without that of its compression."""
    return _unpacked(path).suffix


def _listed(folder: Path) -> list[Path]:
    """Return the files in the metadata of a rosbag2 folder; none without valid metadata."""
    try:
        metadata = yaml.safe_load((folder / METADATA).read_text(encoding='utf-8'))
        names = metadata['rosbag2_bagfile_information']['relative_file_paths']
        # The name alone: a recording must not refer to files elsewhere.
        listed = [folder / PurePath(name).name for name in names]
    except (OSError, KeyError, TypeError, *YAML_ERRORS):
        return []
    return [file if file.is_file() else _unpacked_beside(file) for file in listed]


def _unpacked(file: Path) -> Path:
    """Return a file without the suffix of its compression."""
    return file.with_suffix('') if file.suffix in COMPRESSED else file


def _unpacked_beside(file: Path) -> Path:
    """Return the file that a player has unpacked in place of a compressed one, if it is there."""
    return _unpacked(file) if _unpacked(file).is_file() else file


def _unpack(path: Path, plain: Path, origin: Path) -> Damage | None:
    """Decompress a file as far as it is readable; return the damage, if any."""
    unpacker = zstandard.ZstdDecompressor().decompressobj(read_across_frames=True)
    with path.open('rb') as source, plain.open('wb') as target:
        while block := source.read(BLOCK_BYTES):
            try:
                target.write(unpacker.decompress(block))
                if target.tell() > MAX_RATIO * (source.tell() + SPARE_BYTES):
                    raise RecordingError(f'more than {MAX_RATIO} times the bytes of the file')
            except (zstandard.ZstdError, RecordingError) as error:
                reason = f'damaged compression ({one_line(error)})'
                first_byte = source.tell() - len(block)
                return Damage(str(origin), reason, first_byte, path.stat().st_size)
    return None
