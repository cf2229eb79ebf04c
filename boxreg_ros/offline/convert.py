"""`boxreg convert`: label files, a recording of the node, or a scene, written in other formats."""

from __future__ import annotations

import argparse
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from shutil import copyfile
from typing import Any

from boxreg_ros import __version__
from boxreg_ros.config import Config
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.checks.axis import AxisCheck
from boxreg_ros.io.checks.place import MIN_TILTED, MIN_UPRIGHT, other_order, uprightness
from boxreg_ros.io.fixed_frame import FixedFrameItems, StoredCloud
from boxreg_ros.io.lidars import SINGLE_LIDAR
from boxreg_ros.labels import (
    check_options,
    frames_of,
    LabelFrame,
    LabelOutput,
    Provenance,
)
from boxreg_ros.labels.cloud_spool import Spool
from boxreg_ros.labels.output import WITH_REJECTED
from boxreg_ros.labels.recording import config_hash, files_of
from boxreg_ros.offline.arguments import add_options, TOPICS, values_of
from boxreg_ros.offline.notes import left_out_line
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.result_folder import claimed, whole_folder, write_summary
from boxreg_ros.offline.sources import label_frame_of, scene_address, source_of, writer_options
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import BoxArray, is_valid_box, REJECTED, Sweep
from msg_adapters.convention import Convention

FORMAT_OF_NODE = 'recording'
"""Format of labels that are messages of a recording, which also has the clouds and poses."""
COUNTED = (
    *('frames', 'boxes', 'frames_without_boxes', 'invalid_boxes', 'rejected_boxes'),
    *('boxes_without_id', 'boxes_with_repeated_id', 'tilted_boxes'),
)
"""Numbers of the summary, in their order."""
DOUBTS = {
    'invalid_boxes': f'are invalid: {Reason.INVALID_BOX.meaning}',
    'boxes_without_id': 'have no track id, and each is an object of its own: boxreg relabel '
    '--associate assigns ids',
    'boxes_with_repeated_id': 'have the track id of another one of their frame: boxreg relabel '
    '--associate assigns others',
}
"""Words of some of them."""
ROW_FORMATS = ('csv', 'parquet')
"""Tables with a row per box alone, and no place for a frame without boxes."""


def convert(request: Request, out: Path) -> dict[str, Any]:
    """
    Write the labels of a request in its formats.

    Boxes are written in the fixed frame if the labels or the recording have the sensor poses.
    Recordings, for these poses and the clouds, are needed only where the label files lack them.

    Parameters
    ----------
    request : Request
        Labels to read, and formats to write.
    out : Path
        The folder of results; it appears complete or not at all.

    Returns
    -------
    summary : dict
        The content of ``summary.json``.

    Raises
    ------
    ConfigError
        If a format does not exist, cannot be read, or lacks an option.
    RecordingError
        If the labels cannot be read, or a format can represent none of them.

    """
    _check(request)
    source_format, source = _labels(request)
    is_of_node = source_format == FORMAT_OF_NODE and request.labels is not None
    provenance = replace(
        Provenance.of(request.recordings or (source,)),
        config_hash=config_hash(source) if is_of_node else '',
    )
    counts = Counter(dict.fromkeys(COUNTED, 0))
    not_read: Counter[str] = Counter()
    assumed: list[str] = []
    options = writer_options(request)
    axes = AxisCheck(request.convention, Config().drives)
    unused: dict[str, Any] = {'unreadable': 0, 'unused': '', 'damage': []}  # of the recording
    with claimed(out), whole_folder(out, request.inputs()) as folder:
        output = LabelOutput(folder, request.formats, provenance, options)
        for frame in _read_frames(request, folder, unused):
            counts['frames'] += 1
            counts['boxes'] += len(frame.refined.status)
            counts['frames_without_boxes'] += not frame.refined.status
            counts['invalid_boxes'] += int((~is_valid_box(frame.refined.boxes.boxes)).sum())
            not_read.update(frame.left_out)
            if frame.note:
                assumed.append(frame.note)
            boxes = frame.moved('fixed').refined.boxes
            named = list(filter(None, boxes.track_ids))
            counts['boxes_without_id'] += len(boxes.track_ids) - len(named)
            counts['boxes_with_repeated_id'] += len(named) - len(set(named))
            upright = uprightness(boxes.boxes[is_valid_box(boxes.boxes)])
            counts['tilted_boxes'] += int((upright < MIN_UPRIGHT).sum())
            if not counts['boxes_with_repeated_id']:  # whose way is that of several objects
                axes.add(boxes)
            counts['rejected_boxes'] += frame.refined.status.count(REJECTED)
            output.write(frame)
        output.close()
        warnings = [request.unbound_text(False)]
        applied = request.applied_decisions()
        if applied is not None and 'csv' in request.formats:
            copyfile(applied, folder / applied.name)
        elif applied is not None:
            warnings.append(
                f'{applied.name}, the decisions of a person, goes with csv alone and binds no run '
                f'on other labels: use --labels csv:{applied.parent} for these'
            )
        left_out = output.left_out()
        _require_valid_boxes(source, counts)
        _require_boxes(request, left_out, counts['boxes'] - counts['rejected_boxes'])
        summary = {
            'source': str(source),
            'recordings': [str(path) for path in request.recordings],
            'from': source_format,
            'to': list(request.formats),
            **counts,
            'left_out_of_source': dict(+not_read),
            'assumed': assumed,
            **unused,
            'warning': '; '.join(filter(None, (axes.finding, *warnings))),
            'left_out_of_labels': left_out,
            'label_notes': output.notes(),
            'versions': {'boxreg_ros': __version__},
            'fingerprint': request.fingerprint(),
        }
        write_summary(folder, summary)
    return summary


def _labels(request: Request) -> tuple[str, Path]:
    """Return format and path of the labels to convert; annotations are those of a scene."""
    if request.labels is None and scene_address(request.recordings) is not None:
        return FORMAT_OF_NODE, request.recordings[0]
    if request.labels is None:
        raise ConfigError('labels: expected label files to convert, got none; name them')
    return request.labels


def _check(request: Request) -> None:
    """Raise `ConfigError` for options of a recording without one, and for formats of points."""
    of_recording = (
        request.options.with_points,
        request.lidars != SINGLE_LIDAR,
        request.odometry,
        request.fixed_frame,
        request.label_frame,
    )
    if not request.recordings and any(of_recording):
        raise ConfigError(
            '--with-points, --points, --sensor-frame, --points-info, --time-unit, --odometry, '
            '--fixed-frame, --label-frame: expected a recording to apply them to, got none; give '
            'it with --recording'
        )
    check_options(request.formats, request.options)


def _require_valid_boxes(source: Path, counts: Counter[str]) -> None:
    """Raise `RecordingError` if no box of the labels can be of an object."""
    if counts['boxes'] and counts['invalid_boxes'] == counts['boxes']:
        raise RecordingError(
            f'{source}: expected boxes of objects, got none among {counts["boxes"]:,}: '
            f'{Reason.INVALID_BOX.meaning}; labels of images alone have extents of -1: give those '
            f'with 3D boxes'
        )


def _require_boxes(request: Request, left_out: dict[str, dict[str, int]], num_boxes: int) -> None:
    """Raise `RecordingError` if a format has left out all boxes."""
    for name, counts in left_out.items():
        if num_boxes and sum(counts.values()) == num_boxes:
            reasons = ', '.join(f'{reason} {count}' for reason, count in counts.items())
            raise RecordingError(
                f'labels: format {name!r} can represent none of {num_boxes} boxes: '
                f'{reasons}; if the sensor poses are missing, give --recording'
            )


def _read_frames(request: Request, folder: Path, unused: dict[str, Any]) -> Iterator[LabelFrame]:
    """Yield the labels, in the fixed frame where the transform is known."""
    if request.recordings:
        yield from _read_with_recording(request, folder, unused)
        return
    for frame in frames_of(*_labels(request), convention=request.convention):
        yield frame.moved('fixed')


def _read_with_recording(
    request: Request, folder: Path, unused: dict[str, Any]
) -> Iterator[LabelFrame]:
    """Yield the labels with poses and clouds of the recording; note what could not be used."""
    config = Config()
    waiting = deque[LabelFrame]()  # merged clouds are complete later than the boxes of their time
    spool = Spool(folder, config) if request.options.with_points else None
    with source_of(request, with_rejected=True) as recording:
        items = FixedFrameItems(recording, config, fixed_frame=request.fixed_frame)
        fixed_frame = items.fixed_frame
        sensor_frame = label_frame_of(recording, items.tree, fixed_frame, request.label_frame)
        for item in items.read(with_clouds=spool is not None, with_intensities=True):
            if isinstance(item.content, Sweep):
                if spool is not None:
                    yield from _with_clouds(waiting, items.stored_cloud(item, sensor_frame), spool)
                continue
            refined = item.refined
            assert refined is not None  # boxes of label files have it
            if isinstance(item.moved, BoxArray):
                refined = replace(refined, boxes=item.moved)
            T_fixed_sensor = items.pose_of(sensor_frame, item.content.stamp_ns)
            frame = LabelFrame(refined, fixed_frame, sensor_frame, T_fixed_sensor)
            if spool is None:
                yield frame
            else:
                waiting.append(frame)
        unused.update(
            unreadable=recording.unreadable.total(), unused=items.left_out(),
            damage=[str(damage) for damage in recording.damages],
            left_out_of_source=dict(+recording.left_out),
        )  # fmt: skip
    if spool is not None:
        yield from map(spool.with_cloud, waiting)
        spool.remove()


def _doubts(summary: dict[str, Any], convention: Convention) -> Iterator[str]:
    """Yield what boxes have that their formats need, or that labels do not."""
    for name, text in DOUBTS.items():
        if summary[name]:
            yield f'{summary[name]:,} boxes {text}'
    if summary['tilted_boxes'] >= MIN_TILTED * max(1, summary['boxes']):
        other = other_order(convention)
        yield (
            f'{summary["tilted_boxes"]:,} boxes lie on their sides or backs: if w of their '
            f'quaternions comes {"last" if other == "xyzw" else "first"}, set --orientation '
            f'{other}'
        )


def _with_clouds(
    waiting: deque[LabelFrame], cloud: StoredCloud, spool: Spool
) -> Iterator[LabelFrame]:
    """Store a cloud, and yield the frames up to its stamp with theirs."""
    if cloud.T_fixed_sweep is not None:
        spool.add(cloud.sweep, cloud.T_fixed_sweep, cloud.intensities)
    while waiting and waiting[0].refined.boxes.stamp_ns <= cloud.sweep.stamp_ns:
        yield spool.with_cloud(waiting.popleft())


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `run`."""
    parser.add_argument(
        'source',
        type=Path,
        metavar='SOURCE',
        help='labels, or a recording of the node, or a scene of a data set: its annotations',
    )
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
    of_recording = [name for name in TOPICS if name != 'boxes']
    add_options(parser, Request, 'options', 'label_frame', 'fixed_frame', *of_recording)


def run(args: argparse.Namespace) -> int:
    """Convert, and print one line with the counts."""
    recordings = tuple(args.recording)
    labels: tuple[str, Path] | None = (args.source_format, args.source)
    if scene_address([args.source]) is not None:
        if args.source_format != FORMAT_OF_NODE or recordings:
            raise ConfigError(
                f'{args.source}: expected --from {FORMAT_OF_NODE} alone for the annotations of a '
                f'scene, got --from {args.source_format}; the scene has poses and clouds, too'
            )
        recordings, labels = (args.source,), None
    elif args.source_format == FORMAT_OF_NODE and not recordings:
        recordings = (files_of(args.source),)
    request = Request(
        recordings,
        labels=labels,
        formats=args.target_formats,
        **values_of(args, Request),
    )
    summary = convert(request, args.out)
    parts = [
        f'{args.out}: {summary["boxes"]:,} boxes of {summary["frames"]:,} frames from '
        f'{args.source_format} to {", ".join(args.target_formats)}'
    ]
    for name, counts in summary['left_out_of_labels'].items():
        reasons = ', '.join(f'{count:,} ({reason})' for reason, count in counts.items())
        parts.append(f'{name} leaves out {reasons}')
    parts += summary['label_notes']
    rows_alone = ' and '.join(name for name in ROW_FORMATS if name in args.target_formats)
    if summary['frames_without_boxes'] and rows_alone:
        parts.append(
            f'{summary["frames_without_boxes"]:,} frames without boxes are not in {rows_alone}, '
            f'which has a row per box'
        )
    parts += _doubts(summary, request.convention)
    if summary['rejected_boxes']:
        parts.append(
            f'{summary["rejected_boxes"]:,} boxes are rejected, which are no labels: they are in '
            f'{" and ".join(WITH_REJECTED)} alone'
        )
    parts += [left_out_line(*item) for item in summary['left_out_of_source'].items()]
    parts += summary['assumed']
    parts += filter(None, (summary['unused'], summary['warning']))
    if summary['damage']:
        parts.append(f'damaged, and read as far as possible: {"; ".join(summary["damage"])}')
    print('; '.join(parts))
    return 0
