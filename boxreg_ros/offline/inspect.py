"""
`boxreg inspect`: what is in a recording, and the relabel command to run.

The index gives topics, counts and times; of the messages only the first seconds are read, so that
a recording of any size takes about a second. Without an index the file is scanned.

"""

from __future__ import annotations

import argparse
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from importlib.util import find_spec
from itertools import pairwise
import json
from pathlib import Path
import shlex
from typing import Any, TYPE_CHECKING

from boxreg_ros.config import Config
from boxreg_ros.errors import BoxregError
from boxreg_ros.offline.arguments import (
    add_options,
    add_recordings,
    request_from,
    TOPICS,
    words_of,
)
from boxreg_ros.offline.notes import sparse_boxes
from boxreg_ros.offline.request import REPORT_PACKAGES, Request
from boxreg_ros.reasons import Reason

if TYPE_CHECKING:
    from boxreg_ros.datasets.registry import Address
    from boxreg_ros.io.items import Item, ItemSource
    from boxreg_ros.io.transform_edge import Edge

DONE = 0
FAILED = 1
SAMPLE_SECONDS = 3.0
"""Part of the recording whose messages are read [s]; chosen: 30 sweeps at 10 Hz take 0.25 s."""
SAMPLE_ITEMS = 60
"""Clouds and box arrays that are read at most: those of this time at 10 Hz."""
DEFAULTS = Config()
"""Settings of the proposed command."""
GAP_PERIODS = 3.0
"""A pause longer than this many median periods is a gap."""
REACHED_PERIODS = 0.55
"""Periods of the clouds by which `reach` takes all boxes between them; derived: half, and 10 %."""
MAX_SPANS = 500
"""Spans of messages closer than 1 / MAX_SPANS of a recording are joined; chosen."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `boxreg inspect`."""
    add_recordings(parser, 'several are merged by time; a data set without a scene is listed')
    add_options(parser, Request, *TOPICS)
    parser.add_argument('--json', action='store_true', help='print JSON')


def run(args: argparse.Namespace) -> int:
    """Print what is in the recording; return 1 if it cannot be relabelled."""
    from boxreg_ros.datasets.registry import all_scenes
    from boxreg_ros.offline.sources import scene_address

    address = scene_address(args.recordings)
    scenes = [] if address is None else [str(scene) for scene in all_scenes(address)]
    if len(scenes) > 1:  # none of several is named
        print(json.dumps(scenes) if args.json else '\n'.join(scenes))
        return DONE
    facts = inspect(args, address)
    print(json.dumps(facts, indent=2) if args.json else '\n'.join(_lines(facts)))
    return DONE if facts['command'] else FAILED


def inspect(args: argparse.Namespace, address: Address | None) -> dict[str, Any]:
    """Return what `boxreg inspect --json` prints; RecordingError if nothing can be read."""
    from boxreg_ros.offline.sources import source_of

    request = request_from(args)
    source = source_of(request)
    facts = _contents(args.recordings) if address is None else _scene_contents(address)
    try:
        with source as recording:
            facts |= _sampled(recording, request.convention)
            facts['damage'] = [damage._asdict() for damage in recording.damages]
    except BoxregError as error:
        facts['problems'].append(str(error))
    facts['command'] = '' if facts['problems'] else _command(args, facts, address)
    return facts


def _contents(paths: list[Path]) -> dict[str, Any]:
    """Return files, times, topics and damages, from the index."""
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
        presence = reader.presence()
        topics = [
            _topic(topic, kind, count, presence[topic], (begin_ns, seconds))
            for (topic, kind), count in sorted(counts.items())
        ]
        damages = [damage._asdict() for damage in reader.damages]
    files = [file for part in parts for file in part.files]
    return _facts(files, begin_ns, seconds, topics, damages)


def _topic(
    topic: str, kind: str, count: int, presence: Sequence[tuple[int, int]], of: tuple[int, float]
) -> dict[str, Any]:
    """Return the figures of a topic, present in ascending spans [ns], `of` a begin and seconds."""
    begin_ns, seconds = of
    rate = (count - 1) / seconds if count > 1 and seconds > 0 else 0.0
    spans = [((first - begin_ns) * 1e-9, (last - begin_ns) * 1e-9) for first, last in presence]
    merged: list[list[float]] = []
    pauses = []
    end = spans[0][1] if spans else 0.0
    for first, last in spans:
        if rate and first - end > GAP_PERIODS / rate:
            pauses.append([end, first])
        if merged and first - end <= seconds / MAX_SPANS:
            merged[-1][1] = max(end, last)
        else:
            merged.append([first, last])
        end = max(end, last)
    return {
        'topic': topic,
        'type': kind,
        'messages': count,
        'rate': rate,  # mean [Hz]
        'presence_s': merged,  # with close spans joined
        'gaps_s': pauses,
    }


def _facts(
    files: Sequence[Path],
    begin_ns: int,
    seconds: float,
    topics: list[dict[str, Any]],
    damages: list[dict[str, Any]],
) -> dict[str, Any]:
    """Return what is known of a recording before a message is read."""
    from boxreg_ros.io.storage.files import size_of

    return {
        'files': [str(file) for file in files],
        'bytes': sum(map(size_of, files)),
        'begin_ns': begin_ns,
        'seconds': seconds,
        'topics': topics,
        'damage': damages,
        'problems': [],
        'warnings': [],
    }


def _scene_contents(address: Address) -> dict[str, Any]:
    """Return files, times and numbers of sweeps and boxes of a scene."""
    from boxreg_ros.datasets.scene_recording import SceneRecording

    recording = SceneRecording(address)
    recording.has_boxes = False
    with recording:
        begin_ns, end_ns = recording.start_ns, recording.end_ns
        seconds = (end_ns - begin_ns) * 1e-9
        # The stamps of a scene are in files that are not opened here.
        topics = [
            _topic(name, 'data set', count, [(begin_ns, end_ns)], (begin_ns, seconds))
            for name, count in recording.topics.items()
        ]
        return _facts(recording.files, begin_ns, seconds, topics, [])


@dataclass
class _Sample:
    """Figures of the first clouds and boxes; `late` is receive time less stamp [ns]."""

    sweeps: list[int] = field(default_factory=list)
    arrays: list[int] = field(default_factory=list)
    late: list[int] = field(default_factory=list)
    points: list[int] = field(default_factory=list)
    durations: list[float] = field(default_factory=list)
    classes: Counter[str] = field(default_factory=Counter)
    without_id: int = 0
    invalid: int = 0
    without_transform: list[str] = field(default_factory=list)
    tracks: dict[str, list[int]] = field(default_factory=lambda: defaultdict(list))

    def add(self, item: Item) -> None:
        """Add a cloud or a box array."""
        from boxreg_ros.structures import is_valid_box, Sweep

        content = item.content
        if content.stamp_ns > 0:
            self.late.append(item.received_ns - content.stamp_ns)
        if isinstance(content, Sweep):
            self.sweeps.append(content.stamp_ns)
            self.points.append(len(content.points))
            if content.times is not None and len(content.times):
                self.durations.append(float(content.times.max() - content.times.min()))
            return
        self.arrays.append(content.stamp_ns)
        self.classes.update(content.class_names)
        self.invalid += int((~is_valid_box(content.boxes)).sum())
        for name in content.track_ids:
            self.without_id += not name
            if name:
                self.tracks[name].append(content.stamp_ns)


def _sampled(recording: ItemSource, convention: Any) -> dict[str, Any]:
    """Return the figures of the first seconds of a recording."""
    from boxreg_ros.io.session import Session

    session = Session(convention, DEFAULTS, placement=recording.placement)
    session.fixed_frame = recording.choose_fixed_frame(session.tree)
    sample = _Sample()
    begin_ns = recording.start_ns
    for count, item in enumerate(recording.items(session.tree)):
        if count >= SAMPLE_ITEMS or item.received_ns > begin_ns + SAMPLE_SECONDS * 1e9:
            break
        sample.add(item)
        detail = session.admit(item).detail
        if detail:
            sample.without_transform.append(detail)
    recording.check_readable()
    return {
        'points_topic': recording.points_topic,
        'boxes_topic': recording.boxes_topic,
        'odometry_topic': recording.odometry_topic,
        'recorded_apart': recording.apart,
        'fixed_frame': session.fixed_frame,
        'sensor_frame': recording.sensor_frame(),
        'transforms': list(map(_transform, session.tree.edges())),
        'connected_frames': session.tree.groups(),
        'point_layouts': recording.placement.layouts,
        'sample': _summary(sample),
        'warnings': list(_warnings(sample, session.finding, recording)),
    }


def _transform(edge: Edge) -> dict[str, Any]:
    """Return rate and gaps of the transform between two frames."""
    stamps = edge.stamps
    return {
        'parent': edge.parent,
        'child': edge.child,
        'is_static': edge.is_static,
        'period_s': None if edge.is_static else _period(stamps),
        'gaps_s': [] if edge.is_static else _gaps(stamps),
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
        'received_after_stamp_s': float(np.median(sample.late)) * 1e-9 if sample.late else None,
        'classes': {name: DEFAULTS.kind(name) for name, _ in sample.classes.most_common()},
        'tracks': len(lengths),
        'boxes_per_track': lengths[len(lengths) // 2] if lengths else 0,
        'boxes_without_id': sample.without_id,
        'invalid_boxes': sample.invalid,
    }


def _warnings(sample: _Sample, finding: str, recording: ItemSource) -> Iterator[str]:
    """Yield the conditions that make results worse, one line each."""
    yield from filter(None, (recording.finding, finding))
    if sample.arrays and not sample.classes:
        yield (
            f'{len(sample.arrays)} box arrays without a box (of a MarkerArray, markers of the '
            f'type CUBE are boxes)'
        )
    if sample.without_id:
        yield f'{sample.without_id} boxes have no track id; --associate assigns them'
    if sample.invalid:
        yield (
            f'{sample.invalid} of {sample.classes.total()} boxes are invalid, and are not '
            f'refined: each {Reason.INVALID_BOX.meaning}; {Reason.INVALID_BOX.remedy}'
        )
    for name, stamps in (('clouds', sample.sweeps), ('box arrays', sample.arrays)):
        unusable = sum(stamp <= 0 for stamp in stamps[1:])  # a simulation begins at 0
        if unusable:
            yield f'{unusable} {name} have the stamp 0 in their header and cannot be used'
        usable = [stamp for stamp in stamps if stamp > 0]
        repeated = len(usable) - len(set(usable))
        if repeated:
            yield f'{repeated} {name} repeat the stamp of another one'
        backward = sum(later < earlier for earlier, later in pairwise(usable))
        if backward:
            yield f'{backward} {name} have a stamp before that of the one received before them'
    if sample.without_transform:
        yield (
            f'{len(sample.without_transform)} messages have no transform; first: '
            f'{sample.without_transform[0]}'
        )
    if recording.unreadable:
        first = next(iter(recording.first_errors.values()))
        yield f'{recording.unreadable.total()} messages cannot be read; first: {first}'
    facts = _summary(sample)
    periods = facts['boxes_period_s'], facts['sweep_period_s']
    if all(periods):
        yield from sparse_boxes(*(1 / period for period in periods))
    offset = facts['stamp_offset_s']
    if offset is not None and offset > DEFAULTS.reach:
        text = (
            f'boxes are up to {offset:.3f} s away from the nearest cloud; those beyond reach '
            f'({DEFAULTS.reach:g} s) are not refined'
        )
        if all(periods) and periods[0] < REACHED_PERIODS * periods[1] > DEFAULTS.reach:
            reach = f'{REACHED_PERIODS * periods[1]:.2g}'
            text += f'; set reach:={reach} (boxreg relabel: --set reach={reach})'
        yield text


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


def _command(args: argparse.Namespace, facts: dict[str, Any], scene: Address | None) -> str:
    """Return the relabel command with the same recordings and topics."""
    from boxreg_ros.io.checks.finding import ADVISED

    first = args.recordings[0]
    out = f'out/{first.stem if scene is None else scene.scene or scene.root.name}'
    words = ['boxreg', 'relabel', *map(str, args.recordings), '-o', out]
    found = ADVISED.findall('; '.join(facts['warnings']))
    advised = shlex.split(' '.join(dict.fromkeys(found)))
    replaced = {word.partition('=')[0] for word in advised}
    given = words_of(args, Request, *TOPICS)
    words += [word for word in given if word.partition('=')[0] not in replaced]
    words += advised
    if facts['sample']['boxes_without_id'] and '--associate' not in words:
        words.append('--associate')
    words.append('--complete')
    if all(map(find_spec, REPORT_PACKAGES)):
        words.append('--report')
    return shlex.join(words)


def _lines(facts: dict[str, Any]) -> Iterator[str]:
    """Yield the facts as text."""
    size = facts['bytes'] / 1e6
    yield f'{len(facts["files"])} files, {size:,.1f} MB, {facts["seconds"]:,.1f} s'
    width = max((len(entry['topic']) for entry in facts['topics']), default=0)
    for entry in facts['topics']:
        yield (
            f'  {entry["topic"]:{width}}  {entry["messages"]:8,}  {entry["rate"]:7.1f} Hz  '
            f'{entry["type"]}{_gap_text(entry["gaps_s"])}'
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


def _gap_text(gaps: list[list[float]]) -> str:
    """Return number and place of the longest of the gaps of a topic; empty without."""
    if not gaps:
        return ''
    begin, end = max(gaps, key=lambda gap: gap[1] - gap[0])
    return f', {len(gaps)} gaps, the longest {begin:,.1f} to {end:,.1f} s'


def _sample_lines(facts: dict[str, Any]) -> Iterator[str]:
    sample = facts['sample']
    yield f'fixed frame {facts["fixed_frame"]}, clouds in {facts["sensor_frame"]}'
    for transform in facts['transforms']:
        yield f'  {_transform_line(transform)}'
    if len(facts['connected_frames']) > 1:
        groups = [' + '.join(group) for group in facts['connected_frames']]
        yield f'no transform connects {"; ".join(groups)}'
    if facts['odometry_topic']:
        yield f'odometry {facts["odometry_topic"]}'
    late = sample['received_after_stamp_s']
    if late is not None:
        yield f'received {late:+,.3f} s after the stamp (median)'
    yield f'of the first {SAMPLE_SECONDS:g} s:'
    times = sample['point_times_s']
    shown = 'no times' if times is None else f'times over {times:.3f} s'
    yield (
        f'  clouds {facts["points_topic"]}: {sample["points_per_sweep"]:,} points, {shown}, '
        f'{_seconds(sample["sweep_period_s"])} apart, {len(sample["gaps"]["sweeps"])} gaps'
    )
    for topic, layout in facts['point_layouts'].items():
        yield f'  layout {topic}: {layout}'
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


def _transform_line(transform: dict[str, Any]) -> str:
    pair = f'{transform["parent"]} -> {transform["child"]}'
    if transform['is_static']:
        return f'{pair}: static'
    gaps = [end - begin for begin, end in transform['gaps_s']]
    longest = f', the longest {max(gaps):.3f} s' if gaps else ''
    return f'{pair}: {_seconds(transform["period_s"])} apart, {len(gaps)} gaps{longest}'


def _seconds(value: float | None) -> str:
    return 'unknown' if value is None else f'{value:.3f} s'
