"""`boxreg convert`: label files of one format written in others."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
import hashlib
import json
from pathlib import Path
from typing import Any

from boxreg_ros import __version__
from boxreg_ros.config import Config
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.lidars import Lidars
from boxreg_ros.io.transforms import boxes_to_frame, TransformTree
from boxreg_ros.labels import (
    check_options,
    frames_of,
    LabelFrame,
    module_of,
    Options,
    Provenance,
    writer_for,
)
from boxreg_ros.labels.cloud_spool import Spool
from boxreg_ros.offline.arguments import add_label_arguments
from boxreg_ros.offline.labelled_recording import label_frame_of, pose_of
from boxreg_ros.offline.result_folder import SUMMARY, whole_folder
from boxreg_ros.offline.sources import source_of
from boxreg_ros.structures import Sweep


@dataclass(frozen=True, slots=True)
class Conversion:
    """
    Settings of a conversion.

    Attributes
    ----------
    source : Path
        Label file or folder to read.
    source_format : str
        Its format.
    target_formats : tuple of str
        Formats to write.
    options : Options
        Settings of the formats to write.
    recordings : tuple of Path
        Recordings of the labels, from which sensor poses and clouds are read. Not needed if the
        label files contain the poses.
    points, fixed_frame, label_frame, odometry : str or None
        As for `boxreg relabel`.

    """

    source: Path
    source_format: str
    target_formats: tuple[str, ...]
    options: Options = field(default_factory=Options)
    recordings: tuple[Path, ...] = ()
    points: str | None = None
    fixed_frame: str | None = None
    label_frame: str | None = None
    odometry: str | None = None


def convert(request: Conversion, out: Path) -> dict[str, Any]:
    """
    Write labels in other formats.

    Boxes are written in the fixed frame if the labels or the recording have the sensor poses.

    Parameters
    ----------
    request : Conversion
        Settings.
    out : Path
        Folder of results. As that of `relabel`, it appears complete or not at all.

    Returns
    -------
    summary : dict
        Content of ``summary.json``: number of boxes read, and of boxes that a format cannot
        represent, by reason.

    Raises
    ------
    ConfigError
        For formats that do not exist, cannot be read, or lack an option.
    RecordingError
        If the labels cannot be read, or a format can represent none of them.

    """
    _check(request)
    provenance = Provenance.of(request.recordings or (request.source,))
    counts: Counter[str] = Counter()
    inputs = (request.source, *request.recordings, request.options.camera)
    with whole_folder(out, inputs) as folder:
        writers = {
            name: writer_for(name, folder, provenance, request.options)
            for name in request.target_formats
        }
        for frame in _read_frames(request, folder, counts):
            counts['frames'] += 1
            counts['boxes'] += len(frame.refined.status)
            for writer in writers.values():
                writer.write(frame)
        for writer in writers.values():
            writer.close()
        left_out = {name: dict(+writer.dropped) for name, writer in writers.items()}
        _require_boxes(request, left_out, counts['boxes'])
        summary = {
            'source': str(request.source),
            'recordings': [str(path) for path in request.recordings],
            'from': request.source_format,
            'to': list(request.target_formats),
            'frames': counts['frames'],
            'boxes': counts['boxes'],
            'unreadable': counts['unreadable'],
            'left_out_of_labels': {name: found for name, found in left_out.items() if found},
            'versions': {'boxreg_ros': __version__},
            'fingerprint': hashlib.sha256(repr((__version__, request)).encode()).hexdigest(),
        }
        (folder / SUMMARY).write_text(json.dumps(summary, indent=2) + '\n', encoding='utf-8')
    return summary


def _check(request: Conversion) -> None:
    """Raise `ConfigError` for settings that contradict each other."""
    module_of(request.source_format)
    recording_settings = (
        request.options.with_points,
        request.points,
        request.odometry,
        request.fixed_frame,
        request.label_frame,
    )
    if not request.recordings and any(recording_settings):
        raise ConfigError(
            '--with-points, --points, --odometry, --fixed-frame, --label-frame: expected a '
            'recording to apply them to, got none; give it with --recording'
        )
    check_options(request.target_formats, request.options)


def _require_boxes(
    request: Conversion, left_out: dict[str, dict[str, int]], num_boxes: int
) -> None:
    """Raise `RecordingError` if a format has left out all boxes."""
    for name, counts in left_out.items():
        if num_boxes and sum(counts.values()) == num_boxes:
            reasons = ', '.join(f'{reason} {count}' for reason, count in counts.items())
            raise RecordingError(
                f'{request.source}: format {name!r} can represent none of {num_boxes} boxes: '
                f'{reasons}; if the sensor poses are missing, give --recording'
            )


def _read_frames(request: Conversion, folder: Path, counts: Counter[str]) -> Iterator[LabelFrame]:
    """Yield the labels, in the fixed frame where the transform is known."""
    if request.recordings:
        yield from _read_with_recording(request, folder, counts)
        return
    for frame in frames_of(request.source_format, request.source):
        yield frame.moved('fixed')


def _read_with_recording(
    request: Conversion, folder: Path, counts: Counter[str]
) -> Iterator[LabelFrame]:
    """Yield the labels with poses and clouds of the recording; count unreadable messages."""
    tree = TransformTree()
    labels = (request.source_format, request.source)
    spool = Spool(folder, Config()) if request.options.with_points else None
    lidars = Lidars((request.points,) if request.points else ())
    source = source_of(request.recordings, lidars, odometry=request.odometry, labels=labels)
    with source as recording:
        fixed_frame = recording.choose_fixed_frame(tree, request.fixed_frame)
        sensor_frame = label_frame_of(recording, tree, fixed_frame, request.label_frame)
        for read in recording.items(tree, with_intensities=spool is not None):
            item = read.content
            if isinstance(item, Sweep):
                T_fixed_sweep = pose_of(tree, fixed_frame, item.frame_id, item.stamp_ns)
                if spool is not None and T_fixed_sweep is not None:
                    spool.add(item, T_fixed_sweep, read.intensities)
                continue
            T_fixed_boxes = pose_of(tree, fixed_frame, item.frame_id, item.stamp_ns)
            boxes = item
            if T_fixed_boxes is not None:
                boxes = boxes_to_frame(item, T_fixed_boxes, fixed_frame)
            T_fixed_sensor = pose_of(tree, fixed_frame, sensor_frame, item.stamp_ns)
            sweep = intensities = None
            if spool is not None and T_fixed_sensor is not None:
                sweep, intensities = spool.take(item.stamp_ns, sensor_frame, T_fixed_sensor)
            assert read.refined is not None  # boxes of label files have it
            refined = replace(read.refined, boxes=boxes)
            yield LabelFrame(
                refined, fixed_frame, sensor_frame, T_fixed_sensor, sweep, intensities
            )
        counts['unreadable'] = recording.unreadable.total()
    if spool is not None:
        spool.remove()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `run`."""
    parser.add_argument('source', type=Path, metavar='SOURCE', help='label file or folder')
    parser.add_argument(
        '-o',
        '--out',
        type=Path,
        required=True,
        help='folder of results; appears complete or not at all',
    )
    parser.add_argument(
        '--from',
        dest='source_format',
        required=True,
        metavar='FORMAT',
        help='see `boxreg formats`',
    )
    parser.add_argument(
        '--to', dest='target_formats', required=True, metavar='FORMAT,...',
        type=lambda text: tuple(dict.fromkeys(name.strip() for name in text.split(','))),
        help='formats to write',
    )  # fmt: skip
    parser.add_argument(
        '--recording', type=Path, action='append', default=[], metavar='RECORDING',
        help='recording of the labels, if the label files lack the sensor poses; repeatable',
    )  # fmt: skip
    add_label_arguments(parser)
    parser.add_argument('--points', metavar='TOPIC', help='point clouds of the recording')
    parser.add_argument(
        '--odometry', metavar='TOPIC', help='odometry of the recording, if TF has no fixed frame'
    )
    parser.add_argument('--fixed-frame', metavar='FRAME', help='fixed frame of the recording')


def run(args: argparse.Namespace) -> int:
    """Convert, and print one line with the counts."""
    request = Conversion(
        args.source, args.source_format, args.target_formats,
        Options(args.with_points, args.camera, args.swap_axes), tuple(args.recording),
        args.points, args.fixed_frame, args.label_frame, args.odometry,
    )  # fmt: skip
    summary = convert(request, args.out)
    parts = [
        f'{args.out}: {summary["boxes"]:,} boxes of {summary["frames"]:,} frames from '
        f'{args.source_format} to {", ".join(args.target_formats)}'
    ]
    for name, counts in summary['left_out_of_labels'].items():
        reasons = ', '.join(f'{count:,} ({reason})' for reason, count in counts.items())
        parts.append(f'{name} leaves out {reasons}')
    if summary['unreadable']:
        parts.append(f'{summary["unreadable"]:,} messages could not be read')
    print('; '.join(parts))
    return 0
