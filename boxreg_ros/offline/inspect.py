"""
`boxreg inspect`: what is in a recording, and the relabel command to run.

The index gives topics, counts and times; of the messages only the first seconds are read, so that
a recording of any size takes about a second. Without an index the file is scanned.

"""

from __future__ import annotations

import argparse
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from itertools import pairwise
import json
from pathlib import Path
import shlex
from typing import Any, TYPE_CHECKING

from boxreg_ros.config import Config
from boxreg_ros.errors import BoxregError
from boxreg_ros.offline.arguments import (
    add_topic_arguments,
    convention_from,
    lidar_options,
    lidars_from,
)

if TYPE_CHECKING:
    from boxreg_ros.io.recording import Item, Recording

DONE = 0
FAILED = 1
SAMPLE_SECONDS = 5.0
"""Part of the recording whose messages are read [s]: 50 sweeps at 10 Hz."""
SAMPLE_ITEMS = 100
"""Clouds and box arrays that are read at most; the pose check needs some 30 of each."""
GAP_PERIODS = 3.0
"""A pause longer than this many median periods is a gap."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `boxreg inspect`."""
    parser.add_argument(
        'recordings', nargs='+', type=Path, metavar='RECORDING',
        help='MCAP file, rosbag2 folder, .db3 file or ROS 1 bag; several are merged by time',
    )  # fmt: skip
    add_topic_arguments(parser)
    parser.add_argument('--json', action='store_true', help='print JSON')


def run(args: argparse.Namespace) -> int:
    """Print what is in the recording; return 1 if it cannot be relabelled."""
    facts = inspect(args)
    if args.json:
        print(json.dumps(facts, indent=2))
    else:
        print('\n'.join(_lines(facts)))
    return DONE if facts['command'] else FAILED


def inspect(args: argparse.Namespace) -> dict[str, Any]:
    """
    Return what is in a recording, as `boxreg inspect --json` prints it.

    Parameters
    ----------
    args : Namespace
        Arguments of the command line.

    Raises
    ------
    RecordingError
        If nothing in it can be read.

    """
    from boxreg_ros.io.recording import Recording

    facts = _contents(args.recordings)
    convention = convention_from(args)
    options = {'boxes': args.boxes, 'odometry': args.odometry, 'convention': convention}
    try:
        with Recording(args.recordings, lidars_from(args), **options) as recording:
            facts |= _sampled(recording, convention)
            facts['damage'] = [damage._asdict() for damage in recording.damages]
    except BoxregError as error:
        facts['problems'].append(str(error))
    facts['command'] = '' if facts['problems'] else _command(args, facts)
    return facts


def _contents(paths: list[Path]) -> dict[str, Any]:
    """Return files, times, topics and damages: what the index has."""
    from boxreg_ros.io.storage.files import part_of
    from boxreg_ros.io.storage.reader import Reader

    parts = [part_of(path) for path in paths]
    with closing(Reader(parts)) as reader:
        spans = [reader.span_ns(c) for c in reader.connections if c.msgcount]
        begin_ns = min((begin for begin, _ in spans), default=0)
        end_ns = max((end for _, end in spans), default=0)
        seconds = (end_ns - begin_ns) * 1e-9
        counts: Counter[tuple[str, str]] = Counter()
        for connection in reader.connections:
            counts[connection.topic, connection.msgtype] += connection.msgcount
        damages = [damage._asdict() for damage in reader.damages]
    return {
        'files': [str(file) for part in parts for file in part.files],
        'bytes': sum(file.stat().st_size for part in parts for file in part.files),
        'begin_ns': begin_ns,
        'seconds': seconds,
        'topics': [
            {'topic': topic, 'type': kind, 'messages': count, 'rate': _rate(count, seconds)}
            for (topic, kind), count in sorted(counts.items())
        ],
        'damage': damages,
        'problems': [],
        'warnings': [],
    }


def _rate(count: int, seconds: float) -> float:
    """Return the mean rate of messages [Hz]; 0 for a single one."""
    return (count - 1) / seconds if count > 1 and seconds > 0 else 0.0


@dataclass
class _Sample:
    """What the first messages of clouds and boxes show."""

    sweeps: list[int] = field(default_factory=list)
    arrays: list[int] = field(default_factory=list)
    points: list[int] = field(default_factory=list)
    durations: list[float] = field(default_factory=list)
    classes: Counter[str] = field(default_factory=Counter)
    without_id: int = 0
    without_transform: list[str] = field(default_factory=list)
    tracks: dict[str, list[int]] = field(default_factory=lambda: defaultdict(list))

    def add(self, item: Item) -> None:
        """Add a cloud or a box array."""
        from boxreg_ros.structures import Sweep

        content = item.content
        if isinstance(content, Sweep):
            self.sweeps.append(content.stamp_ns)
            self.points.append(len(content.points))
            if content.times is not None and len(content.times):
                self.durations.append(float(content.times.max() - content.times.min()))
            return
        self.arrays.append(content.stamp_ns)
        self.classes.update(content.class_names)
        for name in content.track_ids:
            self.without_id += not name
            self.tracks[name].append(content.stamp_ns)


def _sampled(recording: Recording, convention: Any) -> dict[str, Any]:
    """Return what the first seconds of a recording show."""
    from boxreg_ros.io.session import Session

    session = Session(convention, Config(), placement=recording.placement)
    session.fixed_frame = recording.choose_fixed_frame(session.tree)
    sample = _Sample()
    begin_ns = recording.start_ns
    for count, item in enumerate(recording.items(session.tree)):
        if count >= SAMPLE_ITEMS or item.received_ns > begin_ns + SAMPLE_SECONDS * 1e9:
            break
        sample.add(item)
        admitted = session.admit(item.content)
        if admitted.detail:
            sample.without_transform.append(admitted.detail)
    recording.check_readable()
    return {
        'points_topic': recording.points_topic,
        'boxes_topic': recording.boxes_topic,
        'odometry_topic': recording.odometry_topic,
        'recorded_apart': recording.apart,
        'fixed_frame': session.fixed_frame,
        'sensor_frame': recording.sensor_frame(),
        'transforms': str(session.tree).split(', '),
        'sample': _summary(sample),
        'warnings': list(_warnings(sample, session.finding, recording)),
    }


def _summary(sample: _Sample) -> dict[str, Any]:
    """Return the figures of a sample."""
    import numpy as np

    sweeps = np.array(sorted(sample.sweeps))
    offsets = [int(np.abs(sweeps - stamp).min()) for stamp in sample.arrays if len(sweeps)]
    lengths = sorted(len(stamps) for stamps in sample.tracks.values())
    return {
        'sweeps': len(sample.sweeps),
        'box_arrays': len(sample.arrays),
        'points_per_sweep': int(np.median(sample.points)) if sample.points else 0,
        'point_times_s': max(sample.durations, default=None),
        'sweep_period_s': _period(sample.sweeps),
        'boxes_period_s': _period(sample.arrays),
        'gaps': {'sweeps': _gaps(sample.sweeps), 'box_arrays': _gaps(sample.arrays)},
        'stamp_offset_s': max(offsets) * 1e-9 if offsets else None,
        'classes': {name: _kind(name) for name, _ in sample.classes.most_common()},
        'tracks': len(lengths),
        'boxes_per_track': lengths[len(lengths) // 2] if lengths else 0,
        'boxes_without_id': sample.without_id,
    }


def _warnings(sample: _Sample, finding: str, recording: Recording) -> Iterator[str]:
    """Yield what makes results worse, one line each."""
    if finding:
        yield finding
    if sample.without_id:
        yield f'{sample.without_id} boxes have no track id; --associate assigns them'
    for name, stamps in (('clouds', sample.sweeps), ('box arrays', sample.arrays)):
        unusable = sum(stamp <= 0 for stamp in stamps)
        if unusable:
            yield f'{unusable} {name} have the stamp 0 in their header and cannot be used'
    if sample.without_transform:
        yield (
            f'{len(sample.without_transform)} messages have no transform; first: '
            f'{sample.without_transform[0]}'
        )
    if recording.unreadable:
        first = next(iter(recording.first_errors.values()))
        yield f'{recording.unreadable.total()} messages cannot be read; first: {first}'
    offset = _summary(sample)['stamp_offset_s']
    config = Config()
    if offset is not None and offset > config.reach:
        yield (
            f'boxes are up to {offset:.3f} s away from the nearest cloud; those beyond reach '
            f'({config.reach:g} s) are not refined'
        )


def _period(stamps: list[int]) -> float | None:
    """Return the median distance of stamps [s]; None for fewer than two."""
    import numpy as np

    steps = np.diff(sorted(stamps))
    return float(np.median(steps)) * 1e-9 if len(steps) else None


def _gaps(stamps: list[int]) -> list[list[float]]:
    """Return begin and end of the gaps between stamps [s]."""
    period = _period(stamps)
    if not period:
        return []
    ordered = sorted(stamps)
    return [
        [first * 1e-9, second * 1e-9]
        for first, second in pairwise(ordered)
        if (second - first) * 1e-9 > GAP_PERIODS * period
    ]


def _kind(class_name: str) -> str:
    """Return the group of settings that a class is treated by."""
    config = Config()
    found = config.class_config(class_name)
    names = ('vehicle', 'cyclist', 'pedestrian')
    return next(name for name in names if getattr(config, name) is found)


def _command(args: argparse.Namespace, facts: dict[str, Any]) -> str:
    """Return the relabel command with the same recordings and topics."""
    out = f'out/{args.recordings[0].stem}'
    words = ['boxreg', 'relabel', *map(str, args.recordings), '-o', out]
    words += lidar_options(args)
    for name in ('boxes', 'odometry'):
        if getattr(args, name):
            words += [f'--{name}', getattr(args, name)]
    convention = convention_from(args)
    if not convention.is_standard:
        for name in ('pose_reference', 'size_order', 'forward_axis'):
            words += [f'--{name.replace("_", "-")}', getattr(convention, name)]
    if facts['sample']['boxes_without_id']:
        words.append('--associate')
    return shlex.join(words)


def _lines(facts: dict[str, Any]) -> Iterator[str]:
    """Yield the facts as text."""
    size = facts['bytes'] / 1e6
    yield f'{len(facts["files"])} files, {size:,.1f} MB, {facts["seconds"]:,.1f} s'
    width = max((len(entry['topic']) for entry in facts['topics']), default=0)
    for entry in facts['topics']:
        yield (
            f'  {entry["topic"]:{width}}  {entry["messages"]:8,}  {entry["rate"]:7.1f} Hz  '
            f'{entry["type"]}'
        )
    if 'sample' in facts:
        yield from _sample_lines(facts)
    from boxreg_ros.io.storage.record import Damage

    for damage in facts['damage']:
        yield f'damage: {Damage(**damage)}'
    for warning in facts['warnings']:
        yield f'warning: {warning}'
    for problem in facts['problems']:
        yield f'cannot be relabelled: {problem}'
    if facts['command']:
        yield f'next: {facts["command"]}'


def _sample_lines(facts: dict[str, Any]) -> Iterator[str]:
    sample = facts['sample']
    yield f'fixed frame {facts["fixed_frame"]}, clouds in {facts["sensor_frame"]}'
    yield f'transforms {", ".join(facts["transforms"])}'
    if facts['odometry_topic']:
        yield f'odometry {facts["odometry_topic"]}'
    yield f'of the first {SAMPLE_SECONDS:g} s:'
    times = sample['point_times_s']
    shown = 'no times' if times is None else f'times over {times:.3f} s'
    yield (
        f'  clouds {facts["points_topic"]}: {sample["points_per_sweep"]:,} points, {shown}, '
        f'{_seconds(sample["sweep_period_s"])} apart, {len(sample["gaps"]["sweeps"])} gaps'
    )
    yield (
        f'  boxes {facts["boxes_topic"]}: {_seconds(sample["boxes_period_s"])} apart, '
        f'{len(sample["gaps"]["box_arrays"])} gaps, at most '
        f'{_seconds(sample["stamp_offset_s"])} from a cloud'
    )
    yield f'  {sample["tracks"]} tracks, {sample["boxes_per_track"]} boxes each (median)'
    classes = ', '.join(f'{name} ({kind})' for name, kind in sample['classes'].items())
    yield f'  classes (treated as): {classes or "none"}'
    for topic, late in facts['recorded_apart'].items():
        yield f'  {topic} was recorded apart from the clouds, {late:+.1f} s'


def _seconds(value: float | None) -> str:
    return 'unknown' if value is None else f'{value:.3f} s'
