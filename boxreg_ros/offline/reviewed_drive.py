"""The recording of a result under review, from the command that made the result."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import NoReturn

from boxreg_ros.config import Config
from boxreg_ros.datasets import SceneRecording
from boxreg_ros.errors import RecordingError
from boxreg_ros.io.recording import Recording
from boxreg_ros.offline import relabel_command
from boxreg_ros.offline.arguments import values_of
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.result_folder import CONFIG, SUMMARY
from boxreg_ros.offline.sources import source_of
from boxreg_ros.review.scene import DriveSource


def drive_of(out: Path) -> DriveSource | None:
    """
    Return the recording of a result; None for a result that no command has made.

    Raises
    ------
    RecordingError
        If another version has made it, with options that this one does not have.

    """
    summary = json.loads((out / SUMMARY).read_bytes())
    command, folder = summary.get('command', []), Path(summary.get('folder', '.'))
    if command[:1] != ['relabel']:
        return None
    parser = _Parser()
    relabel_command.add_arguments(parser)
    args = parser.parse_args([*command[1:], '-o', str(out)])
    values = values_of(args, Request)
    paths = [_within(folder, path) for path in args.recordings]
    labels = values['labels']
    if labels is not None:
        labels = labels[0], _within(folder, labels[1])

    def source() -> Recording | SceneRecording:
        return source_of(
            paths,
            values['lidars'],
            values['boxes'],
            values['odometry'],
            values['start'],
            values['end'],
            values['convention'],
            labels,
        )

    config = Config.from_yaml(out / CONFIG)
    return DriveSource(source, values['convention'], summary['fixed_frame'], config)


class _Parser(argparse.ArgumentParser):
    """Refuse the command of a result that another version has made."""

    def error(self, message: str) -> NoReturn:
        """Raise RecordingError."""
        raise RecordingError(
            f'{SUMMARY}: expected a command of this version, got another one ({message}); make '
            f'the result again with boxreg relabel RECORDING -o NEW --report'
        )


def _within(folder: Path, path: Path) -> Path:
    """Return a path relative to the folder of the command; addresses of data sets as they are."""
    return folder / path if (folder / path).exists() else path
