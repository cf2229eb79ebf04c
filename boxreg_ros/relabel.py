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
from pathlib import Path
import platform
import sys
import time
from typing import Any, TypeVar

from boxreg_ros import __version__
from boxreg_ros.bridge import Bridge
from boxreg_ros.config import Config
from boxreg_ros.errors import ConfigError, TransformUnavailable
from boxreg_ros.intake import add_convention_arguments, convention_from, Intake
from boxreg_ros.labelled import (
    add_label_arguments,
    label_frame_of,
    LabelledRecording,
    pose_of,
)
from boxreg_ros.labels import (
    LabelFrame,
    LabelWriter,
    module_of,
    Options,
    Provenance,
    writer_for,
)
from boxreg_ros.recording import Recording
from boxreg_ros.registrar import BoxRegistrar
from boxreg_ros.results import earlier_summary, SUMMARY, whole_folder
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
from boxreg_ros.transforms import boxes_to_frame, sweep_to_frame, TransformTree
from msg_adapters.convention import Convention, STANDARD
import numpy as np
import yaml

UNUSED = 'sweep_', 'boxes_'  # reasons of what was not used begin so
BAR = '{percentage:3.0f}% {bar} {n:.0f}/{total:.0f} s of the recording, {remaining} left'

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

    def __post_init__(self) -> None:
        """Refuse what cannot work before any work is done."""
        if self.labels is not None and self.boxes is not None:
            raise ConfigError('boxes: expected a topic or label files, got both; leave one out')
        if self.labels is not None and not self.convention.is_standard:
            raise ConfigError(
                f'{self.convention}: expected for boxes of a topic, got label files; each format '
                f'has its own convention, see boxreg formats'
            )
        if not 0 <= self.bridge <= self.config.max_gap:
            raise ConfigError(
                f'bridge: expected 0 to max_gap ({self.config.max_gap:g} s), after which an id is '
                f'that of another track, got {self.bridge:g}'
            )
        for name in (*self.formats, *(self.labels or ())[:1]):
            module_of(str(name))

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

    def fingerprint(self) -> str:
        """Return a digest of the request and of the files it reads, by size and time."""
        label_files = (self.labels or ())[1:]
        files = [
            (str(file.resolve()), file.stat().st_size, file.stat().st_mtime_ns)
            for path in (*self.recordings, *filter(None, (self.options.camera, *label_files)))
            for file in sorted([path] if path.is_file() else path.rglob('*'))
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
        Called with the part of the recording that is done and all of it [s].

    Returns
    -------
    summary : dict
        What ``summary.json`` holds.

    Raises
    ------
    RecordingError
        If the recording lacks something, or `out` is not ours to replace.

    """
    clock = _Clock()
    tree = TransformTree()
    intake = Intake(request.convention, request.config)
    registrar = BoxRegistrar(request.config)
    counts: Counter[str] = Counter()
    trouble = ''
    names = dict.fromkeys(('csv', *request.formats))
    recording = request.recording()
    with recording, whole_folder(out) as folder:
        with clock('read'):
            fixed_frame = recording.choose_fixed_frame(tree, request.fixed_frame)
        sensor_frame = label_frame_of(recording, tree, fixed_frame, request.label_frame)
        spool = None
        if request.options.with_points:
            spool = Spool(folder, round(request.config.tolerance * 1e9))
        provenance = Provenance.of(request.recordings, request.config)
        options = replace(request.options, recording=recording)
        writers = {name: writer_for(name, folder, provenance, options) for name in names}
        is_early = request.config.estimate == 'early'
        bridge: Bridge[_Slot] = Bridge(request.bridge, fixed_frame, request.config)
        with _Sink(writers, spool, bridge, fixed_frame, sensor_frame, is_early, clock) as sink:
            for record in clock.each('read', recording.records(tree)):
                if progress is not None:
                    done = record.received_ns - recording.start_ns
                    progress(done * 1e-9, (recording.end_ns - recording.start_ns) * 1e-9)
                with clock('decode'):
                    item = recording.decode(record)
                with clock('transform'):
                    try:
                        moved = intake.take(to_fixed_frame(item, tree, fixed_frame))
                    except TransformUnavailable as error:
                        moved, trouble = None, trouble or str(error)
                    T_fixed_sensor = pose_of(tree, fixed_frame, sensor_frame, item.stamp_ns)
                if isinstance(item, Sweep):
                    counts['sweeps'] += 1
                    counts['sweep_without_transform'] += moved is None
                    T_fixed_sweep = pose_of(tree, fixed_frame, item.frame_id, item.stamp_ns)
                    if spool and T_fixed_sweep is not None:
                        with clock('write'):
                            spool.add(item, T_fixed_sweep, recording.intensities(record))
                else:
                    counts['box_arrays'] += 1
                    boxes = item if not isinstance(moved, BoxArray) else moved
                    T_fixed_given = pose_of(tree, fixed_frame, item.frame_id, item.stamp_ns)
                    reason = 'no_transform' if moved is None else ''
                    sink.expect(boxes, T_fixed_sensor, T_fixed_given, reason)
                with clock('registrar'):
                    ready = _add(registrar, moved)
                sink.take(ready)
            with clock('registrar'):
                ready = registrar.flush()
            sink.take(ready)
        if spool is not None:
            spool.remove()
        counts.update({k: n for k, n in registrar.counts.items() if k.startswith(UNUSED)})
        summary = _summary(request, recording, fixed_frame, counts, sink)
        summary['first_missing_transform'] = trouble
        summary['warning'] = intake.finding
        summary |= intake.facts
        summary['seconds'] = clock.seconds()
        (folder / 'config.yaml').write_text(
            yaml.safe_dump(request.config.to_dict(), sort_keys=False), encoding='utf-8'
        )
        (folder / SUMMARY).write_text(json.dumps(summary, indent=2) + '\n', encoding='utf-8')
    return summary


def input_boxes(path: Path) -> list[BoxArray]:
    """
    Return the boxes of a recording as they are, in the fixed frame `relabel` would choose.

    Box arrays without a transform to that frame are left out.

    """
    tree = TransformTree()
    with Recording([path]) as recording:
        fixed_frame = recording.choose_fixed_frame(tree)
        arrays = []
        for record in recording.records(tree):
            if record.connection.topic == recording.boxes_topic:
                with suppress(TransformUnavailable):
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
    """Adds up what each stage takes [s]."""

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
    ) -> None:
        self._writers = writers
        self._spool = spool
        self._bridge = bridge
        self._fixed_frame, self._sensor_frame = fixed_frame, sensor_frame
        self._is_early = is_early
        self._clock = clock
        self._slots: list[_Slot] = []
        self._unsettled: dict[int, deque[_Slot]] = {}
        self.boxes_in = 0
        self.boxes_out = 0
        self.status: Counter[str] = Counter()
        self.reasons: Counter[str] = Counter()
        self.heading_flips = 0

    def expect(
        self,
        boxes: BoxArray,
        T_fixed_sensor: Floats | None = None,
        T_fixed_given: Floats | None = None,
        reason: str = '',
    ) -> None:
        """Keep a place for a box array; with a reason, it is written there as it is."""
        n = len(boxes.track_ids)
        slot = _Slot(boxes, T_fixed_sensor, T_fixed_given)
        self.boxes_in += n
        if not reason:
            self._unsettled.setdefault(boxes.stamp_ns, deque()).append(slot)
        elif not n:
            return
        else:
            unknown = np.broadcast_to(np.eye(6), (n, 6, 6))
            slot.result = RefinedBoxes(
                boxes, (KEPT,) * n, (reason,) * n, np.zeros(n, np.int64), unknown
            )
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


def _add(registrar: BoxRegistrar, item: Sweep | BoxArray | None) -> list[RefinedBoxes]:
    if item is None:
        return []
    return registrar.add_sweep(item) if isinstance(item, Sweep) else registrar.add_boxes(item)


def _summary(
    request: Request, recording: Recording, fixed_frame: str, counts: Counter[str], sink: _Sink
) -> dict[str, Any]:
    """Return all of summary.json but the timings."""
    if sink.missing():
        raise RuntimeError(f'{sink.missing()} of {sink.boxes_in} boxes did not come back')
    dropped = {name: n for name, n in sorted(counts.items()) if n and name.startswith(UNUSED)}
    return {
        'recordings': [str(path) for path in request.recordings],
        'topics': {
            'points': recording.points_topic,
            'boxes': recording.boxes_topic or None,
            'odometry': recording.odometry_topic,
        },
        'labels': _labels(request, recording),
        'fixed_frame': fixed_frame,
        'estimate': request.config.estimate,
        'sweeps': counts['sweeps'],
        'box_arrays': counts['box_arrays'],
        'boxes_in': sink.boxes_in,
        'boxes_out': sink.boxes_out,
        'status': dict(sink.status),
        'reasons': dict(sink.reasons.most_common()),
        'heading_flips': sink.heading_flips,
        'dropped': dropped,
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
    return (
        f'{out}: {summary["boxes_in"]:,} boxes in, {status.get(REFINED, 0):,} refined, {kept} '
        f'from {summary["sweeps"]:,} sweeps in {summary["seconds"]["total"]:.1f} s, '
        f'fixed frame {summary["fixed_frame"]}'
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `boxreg relabel`."""
    parser.add_argument(
        'recordings', nargs='+', type=Path, metavar='RECORDING',
        help='MCAP file, rosbag2 folder, .db3 file or ROS 1 bag; several are merged by time',
    )  # fmt: skip
    parser.add_argument(
        '-o', '--out', type=Path, required=True, help='folder of results; appears whole or not'
    )
    parser.add_argument('--points', metavar='TOPIC', help='point clouds (default: found by type)')
    parser.add_argument('--boxes', metavar='TOPIC', help='boxes (default: found by type)')
    parser.add_argument(
        '--fixed-frame', metavar='FRAME',
        help='frame to refine in (default: the topmost the frame of the clouds moves in)',
    )  # fmt: skip
    parser.add_argument(
        '--odometry', metavar='TOPIC', help='where TF does not lead to a fixed frame'
    )
    add_convention_arguments(parser)
    parser.add_argument('--config', type=Path, metavar='FILE', help='settings as YAML')
    parser.add_argument(
        '--set', action='append', default=[], type=setting, metavar='KEY=VALUE',
        help='one setting, as in solver.rounds=2; wins over --config',
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


def setting(text: str) -> tuple[str, Any]:
    """Return name and value of ``KEY=VALUE``, the value read as YAML."""
    name, equals, value = text.partition('=')
    if not name or not equals:
        raise argparse.ArgumentTypeError(f'expected KEY=VALUE, got {text!r}')
    try:
        return name, yaml.safe_load(value)
    except yaml.YAMLError:
        raise argparse.ArgumentTypeError(f'{name}: not a YAML value: {value!r}') from None


def config_from(args: argparse.Namespace) -> Config:
    """Return the settings of ``--config`` and ``--set``."""
    config = Config() if args.config is None else Config.from_yaml(args.config)
    return config.updated(dict(args.set))


def run(args: argparse.Namespace) -> int:
    """Relabel as the command line says; print one closing line."""
    config = config_from(args)
    if args.workers is not None:
        config = config.updated({'solver.threads': args.workers})
    request = Request(
        tuple(args.recordings), args.points, args.boxes, args.odometry, args.fixed_frame,
        args.formats, args.start, args.end, config,
        Options(args.with_points, args.camera, args.swap_axes), args.labels, args.label_frame,
        convention_from(args), args.bridge,
    )  # fmt: skip
    earlier = earlier_summary(args.out)
    if args.resume and earlier and earlier['fingerprint'] == request.fingerprint():
        print(f'{args.out}: already there, made from the same recording and settings')
        return 0
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
