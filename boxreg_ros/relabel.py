"""
`boxreg relabel`: recordings in, refined boxes as label files out.

Every box of the recording is written exactly once: refined, or as it was with the reason. Boxes
that are missing are put in where that is asked for.

"""

from __future__ import annotations

import argparse
from bisect import insort
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
import hashlib
from importlib.metadata import version
import json
from math import isfinite
from pathlib import Path
import platform
import sys
import time
from typing import Any, NamedTuple, TypeVar

from boxreg_ros import __version__
from boxreg_ros.ahead import ahead
from boxreg_ros.arguments import add_recording_arguments, config_from, convention_from
from boxreg_ros.bridge import Bridge
from boxreg_ros.changes import Changes
from boxreg_ros.config import Config
from boxreg_ros.errors import ConfigError, TransformUnavailable, UnsupportedMessage
from boxreg_ros.intake import Intake
from boxreg_ros.labelled import (
    add_label_arguments,
    label_frame_of,
    LabelledRecording,
    pose_of,
)
from boxreg_ros.labels import (
    is_written,
    LabelFrame,
    LabelWriter,
    module_of,
    Options,
    Provenance,
    writer_for,
)
from boxreg_ros.recording import Recording
from boxreg_ros.registrar import BoxRegistrar
from boxreg_ros.report import check_packages, REPORT, write_report
from boxreg_ros.results import earlier_summary, spare, SUMMARY, whole_folder
from boxreg_ros.spool import Spool
from boxreg_ros.structures import (
    BoxArray,
    Floats,
    INTERPOLATED,
    KEPT,
    REFINED,
    RefinedBoxes,
    Sweep,
    YAW,
)
from boxreg_ros.transforms import boxes_to_frame, Rewind, sweep_to_frame, TransformTree
from msg_adapters.convention import Convention, STANDARD
import numpy as np
import yaml

UNUSED = 'sweep_', 'boxes_'  # reasons of what was not used begin so
BAR = '{percentage:3.0f}% {bar} {n:.0f}/{total:.0f} s of the recording, {remaining} left'

NO_BOXES = 'no boxes in this part of the recording: nothing was refined; see --start and --end'

AHEAD = 20
"""So many clouds and box arrays, mostly half of each, are made ready while the registrar works."""
Progress = Callable[[float, float], None]
_T = TypeVar('_T')


@dataclass(frozen=True, slots=True)
class Request:
    """
    What to relabel, and how.

    Attributes
    ----------
    recordings : tuple of Path
        Files or folders of one drive, merged by time.
    points, boxes, odometry : str or None
        Topics; None where the type tells.
    fixed_frame : str or None
        Frame to refine in; None for the topmost the cloud's frame moves in.
    formats : tuple of str
        Label formats beside ``csv``, which is always written.
    start, end : float or None
        Part of the recording, from its beginning [s].
    config : Config
        Settings of the core.
    options : Options
        Settings of the label formats.
    labels : tuple of str and Path, or None
        Format and files that the boxes come from instead of a topic.
    label_frame : str or None
        Frame that stands for the sensor's in label formats; None for that of the clouds.
    convention : Convention
        How the boxes are to be read.
    bridge : float
        Where a track is missing between two of its boxes that are no further apart than this,
        a box is put in [s]; 0 for nowhere.
    report : bool
        Write ``report.html`` too, for which the recording is read a second time.

    """

    recordings: tuple[Path, ...]
    points: str | None = None
    boxes: str | None = None
    odometry: str | None = None
    fixed_frame: str | None = None
    formats: tuple[str, ...] = ('csv', 'openlabel')
    start: float | None = None
    end: float | None = None
    config: Config = field(default_factory=Config)
    options: Options = field(default_factory=Options)
    labels: tuple[str, Path] | None = None
    label_frame: str | None = None
    convention: Convention = STANDARD
    bridge: float = 0.0
    report: bool = False

    def __post_init__(self) -> None:
        """Refuse what cannot work before any work is done."""
        if self.labels is not None and self.boxes is not None:
            raise ConfigError('boxes: expected a topic or label files, got both; leave one out')
        if self.labels is not None and not self.convention.is_standard:
            raise ConfigError(
                f'{self.convention}: expected for boxes of a topic, got label files; each format '
                f'has its own convention, see boxreg formats'
            )
        for name, seconds in (('start', self.start), ('end', self.end)):
            if seconds is not None and not isfinite(seconds):
                raise ConfigError(
                    f'{name}: expected seconds from the beginning, got {seconds}; leave it out '
                    f'for all of the recording'
                )
        if not 0 <= self.bridge <= self.config.max_gap:
            raise ConfigError(
                f'bridge: expected 0 to max_gap ({self.config.max_gap:g} s), after which an id is '
                f'that of another track, got {self.bridge:g}'
            )
        for name in (*self.formats, *(self.labels or ())[:1]):
            module_of(str(name))
        if self.report:
            check_packages()

    def recording(self) -> Recording:
        """Return the recording, not yet open."""
        options: dict[str, Any] = {
            'points': self.points,
            'odometry': self.odometry,
            'start': self.start,
            'end': self.end,
        }
        if self.labels is not None:
            return LabelledRecording(self.labels, self.recordings, **options)
        return Recording(self.recordings, boxes=self.boxes, convention=self.convention, **options)

    def inputs(self) -> tuple[Path, ...]:
        """Return the files and folders it reads."""
        label_files = (self.labels or ())[1:]
        return (*self.recordings, *filter(None, (self.options.camera, *label_files)))

    def fingerprint(self) -> str:
        """Return a digest of the request and of the files it reads, by size and time."""
        files = [
            (str(file.resolve()), file.stat().st_size, file.stat().st_mtime_ns)
            for path in self.inputs()
            # Folders in that of a recording are no part of it; one may be that of the results.
            for deep in ['*' if path in self.recordings else '**/*']
            for file in sorted([path] if path.is_file() else path.glob(deep))
            if file.is_file()
        ]
        return hashlib.sha256(repr((__version__, self, files)).encode()).hexdigest()


def relabel(request: Request, out: Path, progress: Progress | None = None) -> dict[str, Any]:
    """
    Refine all boxes of a recording and write ``boxes.csv``, ``summary.json`` and the rest.

    Parameters
    ----------
    request : Request
        What to read, and how.
    out : Path
        Folder of results. It appears whole or not at all; results of an earlier run are
        replaced.
    progress : callable, optional
        Called with the part of the recording that is done and all of it [s]; for a report both
        count the recording twice.

    Returns
    -------
    summary : dict
        What ``summary.json`` holds.

    Raises
    ------
    RecordingError
        If the recording lacks something, or `out` is not ours to replace.
    UnsupportedMessage
        If none of its clouds, or none of its messages of boxes, can be read.

    """
    clock = _Clock()
    registrar = BoxRegistrar(request.config)
    feed = _Feed(registrar)
    names = dict.fromkeys(('csv', *request.formats))
    recording = request.recording()
    with recording, whole_folder(out, request.inputs()) as folder:
        with clock('read'):
            arrivals = _Arrivals(recording, request, clock)
        fixed_frame, sensor_frame = arrivals.fixed_frame, arrivals.sensor_frame
        spool = None
        if request.options.with_points:
            spool = Spool(folder, round(request.config.tolerance * 1e9))
        provenance = Provenance.of(request.recordings, request.config)
        options = replace(request.options, recording=recording)
        writers = {name: writer_for(name, folder, provenance, options) for name in names}
        is_early = request.config.estimate == 'early'
        bridge: Bridge[_Slot] = Bridge(request.bridge, fixed_frame, request.config)
        changes = Changes(fixed_frame) if request.report else None
        passes = 2 if request.report else 1
        with (
            _Sink(
                writers, spool, bridge, fixed_frame, sensor_frame, is_early, clock, changes
            ) as sink,
            ahead(iter(arrivals), AHEAD) as coming,
        ):
            for arrival in coming:
                if progress is not None:
                    progress(arrival.seconds, passes * arrivals.seconds)
                sink.expect(arrival)
                with clock('registrar'):
                    ready = feed.add(arrival.moved)
                sink.take(ready)
            with clock('registrar'):
                ready = registrar.flush()
            sink.take(ready)
        if spool is not None:
            spool.remove()
        summary = _summary(request, recording, arrivals, registrar.counts, sink)
        summary['seconds'] = clock.seconds()
        if changes is not None:
            with clock('report'):
                items = _again(request, progress)
                line = closing_line(summary, out)
                write_report(
                    folder / REPORT, line, summary, request.config, changes.tracks(), items
                )
            summary['seconds'] = clock.seconds()
        (folder / 'config.yaml').write_text(
            yaml.safe_dump(request.config.to_dict(), sort_keys=False), encoding='utf-8'
        )
        (folder / SUMMARY).write_text(json.dumps(summary, indent=2) + '\n', encoding='utf-8')
    return summary


def input_boxes(path: Path, fixed_frame: str | None = None, **topics: Any) -> list[BoxArray]:
    """
    Return the boxes of a recording as they are, in the fixed frame `relabel` would choose.

    Box arrays without a transform to that frame are left out, and what cannot be read. `topics`
    are those that `Recording` wants to be told where several fit.

    """
    tree = TransformTree()
    with Recording([path], **topics) as recording:
        fixed_frame = recording.choose_fixed_frame(tree, fixed_frame)
        arrays = []
        for record in recording.records(tree):
            if record.connection.topic == recording.boxes_topic:
                with suppress(TransformUnavailable, UnsupportedMessage):
                    arrays.append(to_fixed_frame(recording.decode(record), tree, fixed_frame))
    return [array for array in arrays if isinstance(array, BoxArray)]


def to_fixed_frame(
    item: Sweep | BoxArray, tree: TransformTree, fixed_frame: str
) -> Sweep | BoxArray:
    """
    Return a sweep or boxes in the fixed frame.

    Raises
    ------
    TransformUnavailable
        If none is known at its stamp.

    """
    T_fixed_item = tree.lookup(fixed_frame, item.frame_id, item.stamp_ns)
    if isinstance(item, Sweep):
        return sweep_to_frame(item, T_fixed_item, fixed_frame)
    return boxes_to_frame(item, T_fixed_item, fixed_frame)


class _Clock:
    """
    Adds up what each stage takes [s].

    Two threads use it, for different stages; as their work overlaps, stages may add up to more
    than the total.

    """

    def __init__(self) -> None:
        self._begun = time.perf_counter()
        self._seconds: Counter[str] = Counter()

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        begun = time.perf_counter()
        yield
        self._seconds[stage] += time.perf_counter() - begun  # type: ignore[assignment]

    def each(self, stage: str, items: Iterator[_T]) -> Iterator[_T]:
        """Yield `items`, adding up what it takes to get them."""
        end = object()
        while True:
            with self(stage):
                item = next(items, end)
            if item is end:
                return
            yield item  # type: ignore[misc]

    def seconds(self) -> dict[str, float]:
        total = time.perf_counter() - self._begun
        return {**{k: round(v, 4) for k, v in self._seconds.items()}, 'total': round(total, 4)}


@dataclass(eq=False, slots=True)
class _Slot:
    """The place of one box array in the order of the output."""

    boxes: BoxArray
    T_fixed_sensor: Floats | None
    T_fixed_given: Floats | None
    result: RefinedBoxes | None = None

    @property
    def stamp_ns(self) -> int:
        return self.boxes.stamp_ns

    def flips(self, refined: RefinedBoxes) -> int:
        """Return how many headings are off the given ones by more than a right angle."""
        n = len(self.boxes.track_ids)  # what is put in comes behind
        turn = refined.boxes.boxes[:n, YAW] - self.boxes.boxes[:, YAW]
        is_refined = np.array([status == REFINED for status in refined.status[:n]], bool)
        return int((is_refined & (np.cos(turn) < 0)).sum())


class _Arrival(NamedTuple):
    """
    A cloud or boxes on the way to the registrar, and what files need to know with them.

    Attributes
    ----------
    seconds : float
        Part of the recording that lies behind [s].
    given, moved : Sweep or BoxArray, or None
        In its own and in the fixed frame: `given` is None for a cloud that is not written,
        `moved` where nothing connects the frames.
    T_fixed_given, T_fixed_sensor : array, shape (4, 4), or None
        Poses of its own frame, and of that which stands for the sensor's in label files; None
        where unknown, and for a cloud that is not written.
    intensities : array, shape (M,), or None
        Those of a cloud, if they are written.

    """

    seconds: float
    given: Sweep | BoxArray | None
    moved: Sweep | BoxArray | None
    T_fixed_given: Floats | None
    T_fixed_sensor: Floats | None
    intensities: Floats | None


class _Arrivals:
    """
    All that happens to messages before the registrar: reading, decoding, the fixed frame.

    Iterating may happen in another thread: nothing here is used by others until that is over,
    but for the frames and `seconds`, which stay what they are.

    Attributes
    ----------
    counts : Counter
        Sweeps and box arrays, and what was not used by reason.
    first_missing_transform : str
        What is not known of the first item without a transform; else empty.

    """

    def __init__(self, recording: Recording, request: Request, clock: _Clock) -> None:
        self._recording = recording
        self._clock = clock
        self._tree = TransformTree()
        self._with_points = request.options.with_points
        self.fixed_frame = recording.choose_fixed_frame(self._tree, request.fixed_frame)
        self.sensor_frame = label_frame_of(
            recording, self._tree, self.fixed_frame, request.label_frame
        )
        self.seconds = (recording.end_ns - recording.start_ns) * 1e-9
        self.intake = Intake(request.convention, request.config)
        self.counts: Counter[str] = Counter()
        self.first_missing_transform = ''

    def __iter__(self) -> Iterator[_Arrival]:
        """
        Yield clouds and boxes in the order they were received, but for those unreadable.

        Raises
        ------
        UnsupportedMessage
            At the end, if no cloud, or no message of boxes, was readable.

        """
        read: set[str] = set()
        for record in self._clock.each('read', self._recording.records(self._tree)):
            topic = record.connection.topic
            with self._clock('decode'):
                try:
                    given = self._recording.decode(record)
                except UnsupportedMessage as error:
                    self._recording.pass_over(record, error)
                    continue
                is_cloud = isinstance(given, Sweep)
                is_written = is_cloud and self._with_points
                intensities = self._recording.intensities(record) if is_written else None
            read.add(topic)
            self.counts['sweeps' if is_cloud else 'box_arrays'] += 1
            is_kept = is_written or not is_cloud
            with self._clock('transform'):
                arrival = _Arrival(
                    (record.received_ns - self._recording.start_ns) * 1e-9,
                    given if is_kept else None,
                    self._moved(given),
                    self._pose_of(given.frame_id, given.stamp_ns) if is_kept else None,
                    self._pose_of(self.sensor_frame, given.stamp_ns) if is_kept else None,
                    intensities,
                )
            yield arrival
        for topic, first in self._recording.first_errors.items():
            if topic not in read and topic in self._recording.data_topics:
                raise UnsupportedMessage(f'no message on {topic!r} can be read; first: {first}')

    def _moved(self, given: Sweep | BoxArray) -> Sweep | BoxArray | None:
        """Return a cloud or boxes in the fixed frame; None, and counted, where it is unknown."""
        try:
            return self.intake.take(to_fixed_frame(given, self._tree, self.fixed_frame))
        except TransformUnavailable as error:
            self.counts['sweep_without_transform'] += isinstance(given, Sweep)
            self.first_missing_transform = self.first_missing_transform or str(error)
            return None

    def _pose_of(self, frame: str, stamp_ns: int) -> Floats | None:
        return pose_of(self._tree, self.fixed_frame, frame, stamp_ns)


class _Feed:
    """Feeds the registrar, afresh where stamps start again, as the node does."""

    def __init__(self, registrar: BoxRegistrar) -> None:
        self._registrar = registrar
        self._rewinds = Rewind(), Rewind()

    def add(self, item: Sweep | BoxArray | None) -> list[RefinedBoxes]:
        """Add what has a transform; return what has become ready."""
        if item is None:
            return []
        ready: list[RefinedBoxes] = []
        if self._rewinds[isinstance(item, BoxArray)].happened(item.stamp_ns):
            self._registrar.counts['time_jump'] += 1
            self._rewinds = Rewind(), Rewind()
            ready = self._registrar.flush()
            self._registrar.reset()
        if isinstance(item, Sweep):
            return ready + self._registrar.add_sweep(item)
        return ready + self._registrar.add_boxes(item)


class _Sink:
    """Brings results into the order of stamps, each box array once, and has them written."""

    def __init__(
        self,
        writers: dict[str, LabelWriter],
        spool: Spool | None,
        bridge: Bridge[_Slot],
        fixed_frame: str,
        sensor_frame: str,
        is_early: bool,
        clock: _Clock,
        changes: Changes | None,
    ) -> None:
        self._writers = writers
        self._spool = spool
        self._bridge = bridge
        self._fixed_frame, self._sensor_frame = fixed_frame, sensor_frame
        self._is_early = is_early
        self._clock = clock
        self._changes = changes
        self._slots: list[_Slot] = []
        self._unsettled: dict[int, deque[_Slot]] = {}
        self.boxes_in = 0
        self.boxes_out = 0
        self.status: Counter[str] = Counter()
        self.reasons: Counter[str] = Counter()
        self.heading_flips = 0

    def expect(self, arrival: _Arrival) -> None:
        """Keep a cloud that files need, or a place for boxes: those not moved stay as they are."""
        given = arrival.given
        if not isinstance(given, BoxArray):
            if self._spool and given is not None and arrival.T_fixed_given is not None:
                with self._clock('write'):
                    self._spool.add(given, arrival.T_fixed_given, arrival.intensities)
            return
        boxes = arrival.moved if isinstance(arrival.moved, BoxArray) else given
        n = len(boxes.track_ids)
        slot = _Slot(boxes, arrival.T_fixed_sensor, arrival.T_fixed_given)
        self.boxes_in += n
        if arrival.moved is not None:
            self._unsettled.setdefault(boxes.stamp_ns, deque()).append(slot)
        elif not n:
            return
        else:
            reasons, unknown = ('no_transform',) * n, np.broadcast_to(np.eye(6), (n, 6, 6))
            slot.result = RefinedBoxes(boxes, (KEPT,) * n, reasons, np.zeros(n, np.int64), unknown)
        insort(self._slots, slot, key=lambda slot: slot.stamp_ns)

    def take(self, ready: Sequence[RefinedBoxes]) -> None:
        """Take what the registrar returns: per box array one final result, or an early one."""
        for refined in ready:
            slots = self._unsettled[refined.boxes.stamp_ns]
            if refined.is_final:
                slot = slots.popleft()
                if not slots:
                    del self._unsettled[refined.boxes.stamp_ns]
            elif self._is_early:
                slot = next(slot for slot in slots if slot.result is None)
            else:
                continue
            slot.result = slot.result or refined
        self._write()

    def __enter__(self) -> _Sink:
        """Return the sink."""
        return self

    def __exit__(self, failure: object, *_: object) -> None:
        """Complete the files, but not after a failure: then nothing of them will be kept."""
        if failure is None:
            for refined, slot in self._bridge.flush():
                self._put(refined, slot)
            with self._clock('write'):
                for writer in self._writers.values():
                    writer.close()

    def left_out(self) -> dict[str, dict[str, int]]:
        """Return the boxes that a format has no place for, by format and reason."""
        return {
            name: dict(+writer.dropped)
            for name, writer in self._writers.items()
            if +writer.dropped
        }

    def missing(self) -> int:
        """Return how many boxes have gone in and not come out."""
        return self.boxes_in - sum(
            self.status[name] for name in self.status if name != INTERPOLATED
        )

    def _write(self) -> None:
        """Write what nothing earlier is missing for."""
        while self._slots and (result := self._slots[0].result) is not None:
            for refined, slot in self._bridge.add(result, self._slots.pop(0)):
                self._put(refined, slot)

    def _put(self, refined: RefinedBoxes, slot: _Slot) -> None:
        """Count the boxes of a slot, and have them written."""
        self.boxes_out += len(refined.status)
        self.status.update(refined.status)
        self.reasons.update(filter(None, refined.reasons))
        self.heading_flips += slot.flips(refined)
        if self._changes is not None:
            self._changes.add(slot.boxes, refined)
        with self._clock('write'):
            sweep = intensities = None
            if self._spool and slot.T_fixed_sensor is not None:
                sweep, intensities = self._spool.take(
                    slot.stamp_ns, self._sensor_frame, slot.T_fixed_sensor
                )
            frame = LabelFrame(
                refined, self._fixed_frame, self._sensor_frame, slot.T_fixed_sensor, sweep,
                intensities, slot.T_fixed_given,
            )  # fmt: skip
            for writer in self._writers.values():
                writer.write(frame)


def _again(request: Request, progress: Progress | None) -> Iterator[Sweep | BoxArray]:
    """Yield the clouds and boxes of the recording once more, in the fixed frame."""
    with request.recording() as recording:
        arrivals = _Arrivals(recording, request, _Clock())
        for arrival in arrivals:
            if progress is not None:
                progress(arrivals.seconds + arrival.seconds, 2 * arrivals.seconds)
            if arrival.moved is not None:
                yield arrival.moved


def _summary(
    request: Request,
    recording: Recording,
    arrivals: _Arrivals,
    registered: Counter[str],
    sink: _Sink,
) -> dict[str, Any]:
    """Return all of summary.json but the timings."""
    if sink.missing():
        raise RuntimeError(f'{sink.missing()} of {sink.boxes_in} boxes did not come back')
    counts = arrivals.counts
    unused = {name: n for name, n in registered.items() if name.startswith(UNUSED)}
    unused['sweep_without_transform'] = counts['sweep_without_transform']
    unused['unreadable'] = recording.unreadable.total()
    return {
        'recordings': [str(path) for path in request.recordings],
        'topics': {
            'points': recording.points_topic,
            'boxes': recording.boxes_topic or None,
            'odometry': recording.odometry_topic,
        },
        'labels': _labels(request, recording),
        'fixed_frame': arrivals.fixed_frame,
        'estimate': request.config.estimate,
        'sweeps': counts['sweeps'],
        'box_arrays': counts['box_arrays'],
        'boxes_in': sink.boxes_in,
        'boxes_out': sink.boxes_out,
        'status': dict(sink.status),
        'reasons': dict(sink.reasons.most_common()),
        'time_jumps': registered['time_jump'],
        'recorded_apart': {t: round(late, 3) for t, late in recording.apart.items()},
        'heading_flips': sink.heading_flips,
        'dropped': {name: n for name, n in sorted(unused.items()) if n},
        'first_missing_transform': arrivals.first_missing_transform,
        'first_unreadable': '; '.join(map(str, recording.first_errors.values())),
        'warning': arrivals.intake.finding or ('' if sink.boxes_in else NO_BOXES),
        **arrivals.intake.facts,
        'left_out_of_labels': sink.left_out(),
        'versions': {'boxreg_ros': __version__, 'python': platform.python_version()}
        | {name: version(name) for name in ('torch', 'numpy', 'scipy', 'rosbags')},
        'fingerprint': request.fingerprint(),
    }


def _labels(request: Request, recording: Recording) -> dict[str, Any] | None:
    """Return where the boxes come from, if not from the recording."""
    if request.labels is None or not isinstance(recording, LabelledRecording):
        return None
    name, path = request.labels
    return {'format': name, 'path': str(path), 'boxes_outside_part': recording.left_out}


def closing_line(summary: dict[str, Any], out: Path) -> str:
    """Return what was done, in one line."""
    reasons = ', '.join(f'{name} {count:,}' for name, count in summary['reasons'].items())
    status = summary['status']
    kept = f'{status.get(KEPT, 0):,} kept' + (f' ({reasons})' if reasons else '')
    if flips := summary['heading_flips']:
        kept += f', {flips:,} headings turned around'
    if put_in := status.get(INTERPOLATED):
        kept += f', {put_in:,} interpolated'
    unreadable = summary['dropped'].get('unreadable')
    apart = ', '.join(f'{t} ({late:+,.1f} s)' for t, late in summary['recorded_apart'].items())
    return (
        f'{out}: {summary["boxes_in"]:,} boxes in, {status.get(REFINED, 0):,} refined, {kept} '
        f'from {summary["sweeps"]:,} sweeps in {summary["seconds"]["total"]:.1f} s, '
        f'fixed frame {summary["fixed_frame"]}'
        + (f'; merged by stamp: {apart}' if apart else '')
        + (f'; {unreadable:,} messages could not be read' if unreadable else '')
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `boxreg relabel`."""
    add_recording_arguments(parser)
    parser.add_argument(
        '-o', '--out', type=Path, required=True, help='folder of results; appears whole or not'
    )
    parser.add_argument(
        '--fixed-frame', metavar='FRAME',
        help='frame to refine in (default: the topmost the frame of the clouds moves in)',
    )  # fmt: skip
    parser.add_argument(
        '--formats', default='csv,openlabel', metavar='NAME,...',
        type=lambda text: tuple(text.split(',')),
        help='label formats, see `boxreg formats`; csv is always there (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--labels', type=_labels_argument, metavar='FORMAT:PATH',
        help='take the boxes from label files instead of a topic',
    )  # fmt: skip
    add_label_arguments(parser)
    parser.add_argument('--start', type=float, metavar='S', help='from here [s]')
    parser.add_argument('--end', type=float, metavar='S', help='to here [s]')
    parser.add_argument(
        '--bridge', type=float, default=0.0, metavar='S',
        help='put boxes in where a track is missing between two that are no further apart [s]',
    )  # fmt: skip
    parser.add_argument(
        '--report', action='store_true',
        help='write report.html, a page to look at: what was changed, and where to look closer',
    )  # fmt: skip
    parser.add_argument(
        '--resume', action='store_true',
        help='do nothing if OUT holds the results of the same request, files and settings',
    )  # fmt: skip
    parser.add_argument(
        '--workers', type=int, metavar='N', help='cores of the solver (solver.threads)'
    )


def _labels_argument(text: str) -> tuple[str, Path]:
    """Return format and path of ``FORMAT:PATH``."""
    name, colon, path = text.partition(':')
    if not name or not colon or not path:
        raise argparse.ArgumentTypeError(f'expected FORMAT:PATH, got {text!r}')
    return name, Path(path)


def run(args: argparse.Namespace) -> int:
    """Relabel as the command line says; print one closing line."""
    config = config_from(args)
    if args.workers is not None:
        config = config.updated({'solver.threads': args.workers})
    request = Request(
        tuple(args.recordings), args.points, args.boxes, args.odometry, args.fixed_frame,
        args.formats, args.start, args.end, config,
        Options(args.with_points, args.camera, args.swap_axes), args.labels, args.label_frame,
        convention_from(args), args.bridge, args.report,
    )  # fmt: skip
    earlier = earlier_summary(args.out)
    if (
        args.resume
        and earlier
        and earlier['fingerprint'] == request.fingerprint()
        and all(is_written(name, args.out) for name in ('csv', *request.formats))
        and (not request.report or (args.out / REPORT).exists())
    ):
        print(f'{args.out}: already there, made from the same recording and settings')
        return 0
    if args.config != args.out / 'config.yaml':  # which will be there again
        spare(args.out, [args.config])
    from tqdm import tqdm

    with tqdm(
        total=1.0, unit='s', disable=not sys.stderr.isatty(), leave=False, bar_format=BAR
    ) as bar:

        def progress(done: float, total: float) -> None:
            bar.total = total
            bar.update(max(0.0, done - bar.n))

        summary = relabel(request, args.out, progress)
    if summary['warning']:
        print(f'boxreg: {summary["warning"]}', file=sys.stderr)
    print(closing_line(summary, args.out))
    return 0
