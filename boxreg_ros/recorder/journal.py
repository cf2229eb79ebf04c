"""
Journal of an open segment: every frame, before it is written to the label files.

An MCAP file without chunks, so that each frame is in the file as soon as it is added, and all
complete frames of a file that was cut off can be read. A frame is a NumPy archive (``.npz``),
which has a checksum for each array.

"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from io import BytesIO
import os
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

from boxreg_ros.errors import RecordingError
from boxreg_ros.labels import LabelFrame
from boxreg_ros.structures import BoxArray, RefinedBoxes, Sweep
from mcap.exceptions import McapError
from mcap.records import Message, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import IndexType, Writer
import numpy as np

JOURNAL = 'journal.mcap'
SETTINGS = 'settings'
"""Name of the metadata record with the settings of the label files."""
RESULT_COLUMNS = (
    *('num_points', 'covariances', 'extent_covariances', 'face_distances', 'near_points'),
)
"""Arrays of `RefinedBoxes` that are stored under their own names."""


class FrameJournal:
    """
    Append frames to a journal.

    Parameters
    ----------
    path : Path
        New file.
    settings : mapping of str to str
        Settings that recovery needs beside the frames.

    """

    def __init__(self, path: Path, settings: Mapping[str, str]) -> None:
        self._file = path.open('wb')
        self._writer = Writer(self._file, use_chunking=False, index_types=IndexType.NONE)
        self._writer.start('', 'boxreg_ros')
        self._writer.add_metadata(SETTINGS, dict(settings))
        self._channel = self._writer.register_channel('frames', 'npz', 0)
        self._file.flush()

    def add(self, frame: LabelFrame) -> None:
        """Append a frame; it survives the end of this process, but not that of the system."""
        stamp_ns = frame.refined.boxes.stamp_ns
        self._writer.add_message(self._channel, stamp_ns, to_bytes(frame), stamp_ns)
        self._file.flush()

    @property
    def is_deleted(self) -> bool:
        """Return whether the file was deleted; writing to it would still succeed."""
        return os.fstat(self._file.fileno()).st_nlink == 0

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_journal(path: Path) -> tuple[dict[str, str], Iterator[LabelFrame]]:
    """
    Return the settings and the frames of a journal, up to the first that is incomplete.

    Raises
    ------
    RecordingError
        If the journal does not even have its settings.

    """
    records = _complete_records(path)
    for record in records:
        if isinstance(record, Metadata) and record.name == SETTINGS:
            return dict(record.metadata), _frames(records)
    raise RecordingError(
        f'{path}: expected a journal of boxreg_ros, got a file without settings: it was cut off '
        f'before its first frame; delete {str(path.parent)!r}'
    )


def to_bytes(frame: LabelFrame) -> bytes:
    """Return a frame as a NumPy archive."""
    refined = frame.refined
    boxes = refined.boxes
    columns: dict[str, Any] = {
        'stamp_ns': boxes.stamp_ns,
        'frames': [boxes.frame_id, frame.fixed_frame, frame.sensor_frame],
        'track_ids': np.array(boxes.track_ids, dtype=np.str_),
        'class_names': np.array(boxes.class_names, dtype=np.str_),
        'scores': boxes.scores,
        'boxes': boxes.boxes,
        'status': np.array(refined.status, dtype=np.str_),
        'reasons': np.array(refined.reasons, dtype=np.str_),
    }
    columns |= {name: getattr(refined, name) for name in RESULT_COLUMNS}
    for name in ('T_fixed_sensor', 'T_fixed_given', 'intensities'):
        if getattr(frame, name) is not None:
            columns[name] = getattr(frame, name)
    if frame.sweep is not None:
        columns['points'] = frame.sweep.points
        columns['sweep_stamp_ns'] = frame.sweep.stamp_ns
    buffer = BytesIO()
    np.savez(buffer, **columns)
    return buffer.getvalue()


def from_bytes(data: bytes) -> LabelFrame:
    """Return the frame of a NumPy archive."""
    with np.load(BytesIO(data), allow_pickle=False) as archive:
        columns = dict(archive)
    frame_id, fixed_frame, sensor_frame = columns['frames'].tolist()
    boxes = BoxArray(
        int(columns['stamp_ns']),
        frame_id,
        tuple(columns['track_ids'].tolist()),
        tuple(columns['class_names'].tolist()),
        columns['scores'],
        columns['boxes'],
    )
    refined = RefinedBoxes(
        boxes,
        tuple(columns['status'].tolist()),
        tuple(columns['reasons'].tolist()),
        **{name: columns[name] for name in RESULT_COLUMNS},
    )
    sweep = None
    if 'points' in columns:
        sweep = Sweep(int(columns['sweep_stamp_ns']), sensor_frame, columns['points'])
    return LabelFrame(
        refined, fixed_frame, sensor_frame, columns.get('T_fixed_sensor'), sweep,
        columns.get('intensities'), columns.get('T_fixed_given'),
    )  # fmt: skip


def _complete_records(path: Path) -> Iterator[Any]:
    """Yield the records of an MCAP file up to its end or to the first damage."""
    with path.open('rb') as file:
        try:
            yield from StreamReader(file).records
        except (McapError, EOFError, ValueError):  # cut off
            return


def _frames(records: Iterator[Any]) -> Iterator[LabelFrame]:
    for record in records:
        if isinstance(record, Message):
            try:
                yield from_bytes(record.data)
            except (BadZipFile, EOFError, KeyError, ValueError):
                return  # blocks that never reached the disk
