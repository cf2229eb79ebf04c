"""`boxreg convert`: label files of one format to any other."""

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
from boxreg_ros.offline.cloud_spool import Spool
from boxreg_ros.offline.labelled_recording import (
    add_label_arguments,
    label_frame_of,
    LabelledRecording,
    pose_of,
)
from boxreg_ros.offline.result_folder import SUMMARY, whole_folder
from boxreg_ros.structures import Sweep


@dataclass(frozen=True, slots=True)
class Conversion:
    """
    What to convert, and how.

    Attributes
    ----------
    source : Path
        Label files.
    given : str
        Their format.
    wanted : tuple of str
        Formats to write.
    options : Options
        Settings of the formats to write.
    recordings : tuple of Path
        What the labels are of: where the sensor was, and its clouds. Not needed where the
        labels tell the poses.
    points, fixed_frame, label_frame, odometry : str or None
        As for `boxreg relabel`.

    """

    source: Path
    given: str
    wanted: tuple[str, ...]
    options: Options = field(default_factory=Options)
    recordings: tuple[Path, ...] = ()
    points: str | None = None
    fixed_frame: str | None = None
    label_frame: str | None = None
    odometry: str | None = None


def convert(request: Conversion, out: Path) -> dict[str, Any]:
    """
    Write labels again in other formats.

    Boxes are written in the fixed frame where the labels, or the recording, tell the poses of
    the sensor.

    Parameters
    ----------
    request : Conversion
        What to convert, and how.
    out : Path
        Folder of results, as of `relabel`: it appears whole or not at all.

    Returns
    -------
    summary : dict
        What ``summary.json`` holds: boxes read, and those that a format has no place for.

    Raises
    ------
    ConfigError
        For formats that do not exist, cannot be read, or lack an option.
    RecordingError
        If the labels cannot be read, or a format has no place for any of them.

    """
    module_of(request.given)
    of_recording = (
        request.points, request.odometry, request.fixed_frame, request.label_frame,
    )  # fmt: skip
    if not request.recordings and (request.options.with_points or any(of_recording)):
        raise ConfigError(
            '--with-points, --points, --odometry, --fixed-frame, --label-frame: expected a '
            'recording that they are about, got none; give it with --recording'
        )
    check_options(request.wanted, request.options)
    provenance = Provenance.of(request.recordings or (request.source,))
    counts: Counter[str] = Counter()
    inputs = (request.source, *request.recordings, request.options.camera)
    with whole_folder(out, inputs) as folder:
        writers = {
            name: writer_for(name, folder, provenance, request.options) for name in request.wanted
        }
        for frame in _frames(request, folder, counts):
            counts['frames'] += 1
            counts['boxes'] += len(frame.refined.status)
            for writer in writers.values():
                writer.write(frame)
        for writer in writers.values():
            writer.close()
        left_out = {name: dict(+writer.dropped) for name, writer in writers.items()}
        for name, reasons in left_out.items():
            if counts['boxes'] and sum(reasons.values()) == counts['boxes']:
                raise RecordingError(
                    f'{request.source}: format {name!r} has no place for any of '
                    f'{counts["boxes"]} boxes: '
                    + ', '.join(f'{reason} {count}' for reason, count in reasons.items())
                    + '; where the poses of the sensor are missing, give --recording'
                )
        summary = {
            'source': str(request.source),
            'recordings': [str(path) for path in request.recordings],
            'from': request.given,
            'to': list(request.wanted),
            'frames': counts['frames'],
            'boxes': counts['boxes'],
            'unreadable': counts['unreadable'],
            'left_out_of_labels': {name: found for name, found in left_out.items() if found},
            'versions': {'boxreg_ros': __version__},
            'fingerprint': hashlib.sha256(repr((__version__, request)).encode()).hexdigest(),
        }
        (folder / SUMMARY).write_text(json.dumps(summary, indent=2) + '\n', encoding='utf-8')
    return summary


def _frames(request: Conversion, folder: Path, counts: Counter[str]) -> Iterator[LabelFrame]:
    """Yield the labels, in the fixed frame if the way there is known; count the unreadable."""
    if not request.recordings:
        for frame in frames_of(request.given, request.source):
            yield frame.moved('fixed')
        return
    tree = TransformTree()
    labels = (request.given, request.source)
    spool = Spool(folder, Config()) if request.options.with_points else None
    topics = {'points': request.points, 'odometry': request.odometry}
    with LabelledRecording(labels, request.recordings, **topics) as recording:
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
    """Declare what `run` reads."""
    parser.add_argument('source', type=Path, metavar='SOURCE', help='label file or folder')
    parser.add_argument(
        '-o', '--out', type=Path, required=True, help='folder of results; appears whole or not'
    )
    parser.add_argument(
        '--from', dest='given', required=True, metavar='FORMAT', help='see `boxreg formats`'
    )
    parser.add_argument(
        '--to', dest='wanted', required=True, metavar='FORMAT,...',
        type=lambda text: tuple(dict.fromkeys(name.strip() for name in text.split(','))),
        help='formats to write',
    )  # fmt: skip
    parser.add_argument(
        '--recording', type=Path, action='append', default=[], metavar='RECORDING',
        help='what the labels are of, where they do not tell the poses of the sensor; repeatable',
    )  # fmt: skip
    add_label_arguments(parser)
    parser.add_argument('--points', metavar='TOPIC', help='point clouds of the recording')
    parser.add_argument(
        '--odometry', metavar='TOPIC', help='of the recording, where TF is not enough'
    )
    parser.add_argument('--fixed-frame', metavar='FRAME', help='of the recording')


def run(args: argparse.Namespace) -> int:
    """Convert as the command line says; print one closing line."""
    request = Conversion(
        args.source, args.given, args.wanted,
        Options(args.with_points, args.camera, args.swap_axes), tuple(args.recording),
        args.points, args.fixed_frame, args.label_frame, args.odometry,
    )  # fmt: skip
    summary = convert(request, args.out)
    left_out = '; '.join(
        f'{name} has no place for {", ".join(f"{n:,} ({reason})" for reason, n in found.items())}'
        for name, found in summary['left_out_of_labels'].items()
    )
    print(
        f'{args.out}: {summary["boxes"]:,} boxes of {summary["frames"]:,} frames from '
        f'{args.given} to {", ".join(args.wanted)}'
        + (f'; {left_out}' if left_out else '')
        + (f'; {n:,} messages could not be read' if (n := summary['unreadable']) else '')
    )
    return 0
