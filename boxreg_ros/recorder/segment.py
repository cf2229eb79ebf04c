"""Segments: label files and a journal in a hidden folder until they are whole or recovered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, replace
import os
from pathlib import Path
import re
import shutil
from typing import NamedTuple

from boxreg_ros.errors import ConfigError
from boxreg_ros.io.journal import Journal
from boxreg_ros.io.label_feed import RecorderSettings
from boxreg_ros.io.lock import locked
from boxreg_ros.io.whole_files import delete_partial_files, store, store_folder
from boxreg_ros.labels import LabelFrame, LabelOutput, Options, Provenance
from boxreg_ros.labels.cloud_spool import FOLDER as CLOUDS
from boxreg_ros.labels.output import with_csv
from boxreg_ros.labels.protocol import absolute
from boxreg_ros.labels.segments import INDEX, IndexRow, read_index, write_index
import yaml

JOURNAL = 'journal.sqlite'
"""In the folder of an open segment: its settings, then every frame before it is written."""
LABEL_FILES = 'labels'
"""Folder of the label files inside that of an open segment."""
CONFIG = 'config.yaml'
LOCK = '.lock'
DAMAGED = '.damaged'
"""Suffix of the folder of a segment whose journal cannot be read."""
OPEN_NAME = re.compile(r'\.(segment_\d{6,})\.open')
SEGMENT_NAME = re.compile(r'\.?segment_(\d{6,})(\.open|\.damaged)?')


class SegmentFiles:
    """
    The label files of a segment, in the folder `opened` until they are completed in `target`.

    `settings` are as of `journal_settings`. `size` is that of the completed files [bytes].

    """

    def __init__(self, opened: Path, target: Path, settings: Mapping[str, str]) -> None:
        folder = opened / LABEL_FILES
        folder.mkdir()
        self.folder = folder
        self._target = target
        self.frames = 0
        self.boxes = 0
        self.clouds = 0
        self.size = 0
        self._stamps: list[int] = []  # smallest and largest
        camera = Path(settings['camera']) if settings['camera'] else None
        options = Options(with_points=settings['with_points'] == 'true', camera=camera)
        # Data sets of several drives need a name for each.
        drive = absolute(target)
        provenance = Provenance.of((drive.with_name(f'{drive.parent.name}_{drive.name}'),))
        provenance = replace(provenance, config_hash=settings['config_hash'])
        self._output = LabelOutput(folder, settings['formats'].split(','), provenance, options)
        (folder / CONFIG).write_text(settings['config'], encoding='utf-8')

    def write(self, frame: LabelFrame) -> None:
        """Write a frame in all formats."""
        self._output.write(frame)
        stamp_ns = frame.refined.boxes.stamp_ns
        self._stamps = [min([stamp_ns, *self._stamps]), max([stamp_ns, *self._stamps])]
        self.frames += 1
        self.boxes += len(frame.refined.status)
        self.clouds += frame.sweep is not None

    @property
    def seconds(self) -> float:
        """Return the time between the smallest and the largest stamp [s]."""
        return (self._stamps[-1] - self._stamps[0]) * 1e-9 if self._stamps else 0.0

    @property
    def newest_ns(self) -> int:
        """Return the largest stamp [ns]; 0 without frames."""
        return self._stamps[-1] if self._stamps else 0

    @property
    def left_out(self) -> int:
        """Return the number of boxes that a format cannot represent, summed over formats."""
        return sum(sum(reasons.values()) for reasons in self._output.left_out().values())

    def measured_size(self) -> int:
        """Return the size of the files [bytes]."""
        return sum(path.stat().st_size for path in self.folder.rglob('*') if path.is_file())

    def complete(self, recovered: bool) -> None:
        """
        Complete the files and give them their name, then add the segment to the index.

        After each step the disk holds the segment whole, or its journal.

        """
        target = self._target
        self._output.close()
        self.size = self.measured_size()
        first_ns, last_ns = self._stamps
        row = IndexRow(
            target.name, first_ns, last_ns, self.frames, self.boxes, self.clouds, self.left_out,
            self.size, int(recovered),
        )  # fmt: skip
        store_folder(self.folder)
        os.rename(self.folder, target)
        write_index(target.parent, [*read_index(target.parent), row])
        store([target.parent / INDEX, target.parent])


class Segment:
    """A segment that is being recorded."""

    def __init__(self, folder: Path, number: int, settings: Mapping[str, str]) -> None:
        self.name = f'segment_{number:06d}'
        target = folder / self.name
        self._open = folder / f'.{self.name}.open'
        self._open.mkdir()
        self.files = SegmentFiles(self._open, target, settings)
        # Last: a folder without a journal was never in use.
        self._journal = Journal(self._open / JOURNAL)
        self._journal.append(dict(settings))

    def write(self, frame: LabelFrame) -> None:
        """Write a frame to the journal, then to the label files."""
        self._journal.append(frame)
        self.files.write(frame)

    def sync(self) -> None:
        """Wait until the journal is on the disk itself, where it survives a power cut."""
        self._journal.sync()

    @property
    def is_deleted(self) -> bool:
        """Return whether the folder of the segment was deleted by someone."""
        return self._journal.is_deleted

    def complete(self) -> None:
        """Complete the label files and delete the journal."""
        self.files.complete(recovered=False)
        self._journal.delete()
        shutil.rmtree(self._open)

    def abandon(self) -> None:
        """Delete the incomplete label files; the journal stays, so `recover` can write them."""
        self._journal.close()
        shutil.rmtree(self.files.folder, ignore_errors=True)


def journal_settings(settings: RecorderSettings) -> dict[str, str]:
    """Return the first object of a journal: what the label writers need beside the frames."""
    return {
        'formats': ','.join(with_csv(settings.formats)),
        'with_points': str(settings.with_points).lower(),
        'camera': settings.camera,
        'config_hash': Provenance.of((), settings.config).config_hash,
        'config': yaml.safe_dump(asdict(settings.config), sort_keys=False),
    }


def open_segments(folder: Path) -> list[Path]:
    """Return the folders of segments that were cut off, in the order of recording."""
    return sorted(path for path in folder.iterdir() if OPEN_NAME.fullmatch(path.name))


def next_number(folder: Path) -> int:
    """Return the smallest number that no segment of a folder has, nor any before it."""
    names = [path.name for path in folder.iterdir()]
    names += [row.segment for row in read_index(folder)]
    numbers = [int(found[1]) for name in names if (found := SEGMENT_NAME.fullmatch(name))]
    return 1 + max(numbers, default=0)


def recover(opened: Path) -> int:
    """
    Make a whole segment from the journal of one that was cut off, and delete that folder.

    Return the frames of the segment; 0 if the journal has none, and no segment was made. Raises
    RecordingError if the journal cannot be read; nothing is deleted then.

    """
    found = OPEN_NAME.fullmatch(opened.name)
    assert found is not None  # `open_segments` yields no others
    target = opened.parent / found[1]
    indexed = {row.segment for row in read_index(opened.parent)}
    frames = 0
    if target.name not in indexed and (opened / JOURNAL).exists():
        frames = _rebuild(opened, target)
    shutil.rmtree(opened)
    return frames


def _rebuild(opened: Path, target: Path) -> int:
    """Write the frames of a journal as a segment; return their number."""
    journal = Journal(opened / JOURNAL)
    try:
        records = journal.records()
        settings = next(records, None)
        if settings is None:  # cut off before its first frame
            return 0
        # `target` exists where the end came between its name and the index.
        for incomplete in (opened / LABEL_FILES, target):
            shutil.rmtree(incomplete, ignore_errors=True)
        files = SegmentFiles(opened, target, settings)
        for frame in records:
            files.write(frame)
        if files.frames:
            files.complete(recovered=True)
        return files.frames
    finally:
        journal.close()


class Recovery(NamedTuple):
    """Segments made from journals, and the folders of those that cannot be read."""

    recovered: int
    damaged: tuple[Path, ...]


def lock_of(folder: Path) -> AbstractContextManager[None]:
    """Return a context that keeps other recordings out of a folder; see `locked`."""
    return locked(folder / LOCK, f'record_to {str(folder)!r}')


def delete_remains(folder: Path) -> None:
    """Delete the clouds and partial files of a locked folder; no segment is made from them."""
    shutil.rmtree(folder / CLOUDS, ignore_errors=True)
    delete_partial_files(folder)


def recover_all(opened: Sequence[Path]) -> Recovery:
    """
    Complete the segments of a locked folder that were cut off.

    They are from `open_segments`, before a further one was opened. One that cannot be read gets
    another name, so that it neither is lost nor stops a recording.

    """
    recovered = 0
    damaged = []
    for path in opened:
        try:
            recovered += recover(path) > 0
        except (ConfigError, OSError):  # a package that is missing, a full disk: no fault of it
            raise
        except Exception:  # label writers, also of other packages, may fail with any
            damaged.append(path.rename(path.with_suffix(DAMAGED)))
    return Recovery(recovered, tuple(damaged))
