"""`boxreg recover`: whole segments from a recording of labels that was cut off."""

from __future__ import annotations

import argparse
from pathlib import Path
import sys

from boxreg_ros.errors import RecordingError
from boxreg_ros.labels.segments import INDEX, read_index
from boxreg_ros.recorder.segment import delete_remains, lock_of, open_segments, recover_all


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `run`."""
    parser.add_argument('folder', type=Path, metavar='DIR', help='folder of `record_to`')


def run(args: argparse.Namespace) -> int:
    """Recover, and print one line; return 1 if a journal cannot be read."""
    folder: Path = args.folder
    if not folder.is_dir() or not ((folder / INDEX).exists() or open_segments(folder)):
        raise RecordingError(
            f'{str(folder)!r}: expected the folder of a recording of labels, with {INDEX} or a '
            f'segment that was cut off, got none; give the folder of record_to'
        )
    with lock_of(folder):
        delete_remains(folder)
        recovery = recover_all(open_segments(folder))
    rows = read_index(folder)
    boxes = sum(row.boxes for row in rows)
    recovered = f'{recovery.recovered} segments recovered'
    print(f'{folder}: {recovered}; {boxes:,} boxes in {len(rows)} segments')
    for path in recovery.damaged:
        print(f'boxreg: {path}: its journal cannot be read; delete it', file=sys.stderr)
    return 1 if recovery.damaged else 0
