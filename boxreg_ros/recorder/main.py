"""The recorder: writes the label files of the live node, in a process of its own."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from difflib import get_close_matches
import os
from pathlib import Path
import pickle
import shutil
import signal
import sys
import time
from typing import Any, IO

from boxreg_ros.errors import BoxregError, ConfigError, RecordingError
from boxreg_ros.io import label_feed
from boxreg_ros.io.transforms import TIME_JUMP
from boxreg_ros.io.whole_files import DISK_ERRORS
from boxreg_ros.labels import FORMATS, import_format, LabelFrame, module_of
from boxreg_ros.labels.camera import Camera
from boxreg_ros.labels.cloud_spool import Spool
from boxreg_ros.recorder.segment import (
    delete_remains,
    journal_settings,
    lock_of,
    next_number,
    open_segments,
    recover_all,
    Recovery,
    Segment,
    SegmentFiles,
)

STATUS_PERIOD = 1.0
"""Time between two lines of status [s]; that of /diagnostics."""
RATE_PERIODS = 10
"""Lines of status over which the rate is averaged: as long as a log period; chosen."""
SIZING_PART = 0.1
"""Largest part of the time that may be spent on measuring the size of the files; chosen."""
NICENESS = 10
"""Lower priority than the node: where cores are few, labels wait and boxes do not; chosen."""
COPY = 'mcap'
"""Format that copies a recording, which does not exist while driving."""


class Recorder:
    """
    Write final boxes and clouds as segments of label files.

    The last steps of a segment, until it is on the disk itself, run in a thread beside the next
    segment. The folder of the settings exists and is locked. Raises ConfigError for formats that
    cannot be written, or a length of segments that is none.

    """

    def __init__(self, settings: label_feed.RecorderSettings) -> None:
        self._folder = Path(settings.folder)
        self._limit, self._limits_bytes = label_feed.segment_limit(settings.segment)
        check_formats(settings)
        self._settings = journal_settings(settings)
        cut_off = open_segments(self._folder)  # before one is opened here
        self._number = next_number(self._folder)
        self._segment: Segment | None = None
        self._spool: Spool | None = None
        delete_remains(self._folder)
        if settings.with_points:
            self._spool = Spool(self._folder, settings.config)
        self._thread = ThreadPoolExecutor(1)
        self._recovery: Future[Recovery] | None = self._thread.submit(recover_all, cut_off)
        self._completions: deque[tuple[Segment, Future[None]]] = deque()
        self._written: Counter[str] = Counter()  # by field of `RecorderStatus`
        self._growth = Growth()

    def take(self, item: Any) -> None:
        """Write an item that the node has sent."""
        if isinstance(item, label_feed.LabelCloud):
            self._add_cloud(item)
        elif isinstance(item, label_feed.FinalBoxes):
            self._write(item)
        elif isinstance(item, label_feed.Split):
            self._end_segment()

    def finish(self) -> None:
        """Complete the open segment and wait until all are on the disk."""
        self._end_segment()
        self._thread.shutdown(wait=True)
        self._collect()
        if self._spool is not None:
            self._spool.remove()

    def abandon(self) -> None:
        """Stop writing; the journal of the open segment stays."""
        self._thread.shutdown(wait=True)
        for segment, completion in self._completions:
            if completion.exception() is not None:
                segment.abandon()
        if self._segment is not None:
            self._segment.abandon()
        delete_remains(self._folder)

    def status(self) -> label_feed.RecorderStatus:
        """Return the present state; store the open segment, and end one that is long enough."""
        self._collect()
        segment = self._segment
        if segment is not None:
            if segment.is_deleted:
                raise _deleted(self._folder)
            segment.sync()
        open_bytes = 0 if segment is None else self._growth.measure(segment.files)
        size = self._written['size'] + open_bytes
        if segment is not None and self._limits_bytes and open_bytes >= self._limit:
            self._end_segment()
        left_out = 0 if segment is None else segment.files.left_out
        counts: dict[str, Any] = dict(self._written)
        counts |= {'size': size, 'left_out': self._written['left_out'] + left_out}
        return label_feed.RecorderStatus(
            **counts,
            segment='' if segment is None else segment.name,
            rate=self._growth.rate(size),
            free=shutil.disk_usage(self._folder).free,
        )

    def _add_cloud(self, cloud: label_feed.LabelCloud) -> None:
        if self._spool is not None:
            self._spool.delete_before(cloud.needed_from_ns)
            self._spool.add(cloud.sweep, cloud.T_fixed_sweep, cloud.intensities)

    def _write(self, final: label_feed.FinalBoxes) -> None:
        """Write final boxes to the open segment, or to a new one where that is at its end."""
        frame = LabelFrame(
            final.refined, final.fixed_frame, final.sensor_frame, final.T_fixed_sensor,
            T_fixed_given=final.T_fixed_given,
        )  # fmt: skip
        if self._spool is not None:
            frame = self._spool.with_cloud(frame)
            self._written['without_cloud'] += frame.sweep is None
        if self._segment is not None and self._is_beyond(self._segment, frame):
            self._end_segment()
        if self._segment is None:
            self._segment = Segment(self._folder, self._number, self._settings)
            self._number += 1
        self._segment.write(frame)
        self._written['frames'] += 1
        self._written['boxes'] += len(frame.refined.status)
        self._written['clouds'] += frame.sweep is not None

    def _is_beyond(self, segment: Segment, frame: LabelFrame) -> bool:
        """Return whether a frame is too late for a segment, or time went back before it."""
        after_ns = frame.refined.boxes.stamp_ns - segment.files.newest_ns
        if after_ns < -TIME_JUMP * 1e9:
            return True
        seconds = segment.files.seconds + after_ns * 1e-9
        return not self._limits_bytes and seconds >= self._limit

    def _end_segment(self) -> None:
        segment = self._segment
        if segment is not None:
            self._segment = None
            self._completions.append((segment, self._thread.submit(segment.complete)))

    def _collect(self) -> None:
        """Count completed segments; raise the error of one that could not be completed."""
        if self._recovery is not None and self._recovery.done():
            recovery = self._recovery.result()
            self._written['recovered'] = recovery.recovered
            self._written['damaged'] = len(recovery.damaged)
            self._recovery = None
        while self._completions and self._completions[0][1].done():
            segment, completion = self._completions[0]
            completion.result()
            self._completions.popleft()
            self._written['segments'] += 1
            self._written['size'] += segment.files.size
            self._written['left_out'] += segment.files.left_out


class Growth:
    """Size of the open segment and growth of all files, measured at a bounded cost."""

    def __init__(self) -> None:
        self._size = 0
        self._files: SegmentFiles | None = None
        self._due = 0.0
        self._samples: deque[tuple[float, int]] = deque(maxlen=RATE_PERIODS)

    def measure(self, files: SegmentFiles) -> int:
        """Return the size of the files [bytes]; measured again when that is due."""
        begun = time.monotonic()
        if files is not self._files or begun >= self._due:
            self._files = files
            self._size = files.measured_size()
            ended = time.monotonic()
            self._due = ended + (ended - begun) / SIZING_PART
        return self._size

    def rate(self, written: int) -> float:
        """Return the growth over the last calls [bytes/s], with the size of now."""
        self._samples.append((time.monotonic(), written))
        (since, before), (now, after) = self._samples[0], self._samples[-1]
        return max(after - before, 0) / (now - since) if now > since else 0.0


def check_formats(settings: label_feed.RecorderSettings) -> None:
    """Raise ConfigError for formats that lack a package, an option or a recording."""
    check_each(settings.formats, settings.camera)
    for name in settings.formats:
        if 'camera' in options_of(name) and not settings.camera:
            raise ConfigError(
                f'record_camera: expected a calibration file for the format {name!r}, got none; '
                f'set it, or leave the format out'
            )
    if settings.with_points:
        able = {name for name in settings.formats if 'with_points' in options_of(name)}
        if not able:
            raise ConfigError(
                f'record_points: expected a format with clouds in record_formats, got '
                f'{", ".join(settings.formats)}; add one, see boxreg formats'
            )


def check_each(formats: Sequence[str], camera: str) -> None:
    """Raise ConfigError for what is wrong by itself: a format, or a calibration file."""
    live = [name for name in FORMATS if is_live(name)]
    for name in formats:
        if name not in live:
            similar = get_close_matches(name, live, 1)
            meant = f'did you mean {similar[0]}? ' if similar else ''
            raise ConfigError(
                f'record_formats: expected some of {", ".join(live)}, got {name!r}; {meant}labels '
                f'of points and copies of a recording are made later, by boxreg relabel of a '
                f'recording made by ros2 bag record'
            )
        module_of(name)
    if camera:
        try:
            Camera.read(Path(camera).expanduser())
        except ConfigError as error:
            raise ConfigError(f'record_camera: {error}') from None


def is_live(name: str) -> bool:
    """Return whether a format needs no recording; one that cannot be imported may be such."""
    with suppress(ConfigError):
        return not (name == COPY or import_format(name).FORMAT.has_points)
    return True


def options_of(name: str) -> tuple[str, ...]:
    """Return the options that the writer of a format uses."""
    return module_of(name).FORMAT.options


def serve(source: IO[bytes], report: Callable[[label_feed.RecorderStatus], None]) -> None:
    """Record what arrives on `source`, until its end or the first error."""
    settings: label_feed.RecorderSettings = pickle.load(source)
    folder = Path(settings.folder)
    recorder: Recorder | None = None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with lock_of(folder):
            recorder = Recorder(settings)
            report(recorder.status())
            _record(recorder, source, report)
            recorder.finish()
            report(recorder.status())
    except (BoxregError, OSError) as error:
        if recorder is not None:
            recorder.abandon()
        if isinstance(error, OSError):
            raise _explained(error, folder, recorder is not None) from None
        raise


def _record(
    recorder: Recorder, source: IO[bytes], report: Callable[[label_feed.RecorderStatus], None]
) -> None:
    """Hand items on until the end of the input; report once per `STATUS_PERIOD`."""
    due = time.monotonic() + STATUS_PERIOD
    while True:
        try:
            item = pickle.load(source)
        except EOFError:  # the node has ended the recording, or has been killed
            return
        except pickle.UnpicklingError:  # killed while it was sending
            return
        recorder.take(item)
        if time.monotonic() >= due:
            report(recorder.status())
            due = time.monotonic() + STATUS_PERIOD


def _explained(error: OSError, folder: Path, has_begun: bool) -> RecordingError:
    """Return the error of a recording for one of the disk, with its remedy."""
    place = f'record_to {str(folder)!r}'
    if error.errno in DISK_ERRORS:
        return RecordingError(
            f'{place}: expected room for labels, got: {error.strerror}; free some space and call '
            f'~/start_recording, which completes the segment that was open'
        )
    if os.path.isfile(folder):
        return RecordingError(f'{place}: expected a folder, got a file; choose another')
    is_lost = has_begun and error.filename and not os.path.exists(error.filename)
    if os.path.exists(folder) and not is_lost:  # False for a name that is too long
        return RecordingError(
            f'{place}: expected a folder that can be written to, got: {error.strerror} '
            f'({error.filename}); choose another, or change its owner or mode'
        )
    if has_begun:
        return _deleted(folder)
    return RecordingError(
        f'{place}: expected a folder that exists or can be made, got: {error.strerror}; choose '
        f'another'
    )


def _deleted(folder: Path) -> RecordingError:
    return RecordingError(
        f'record_to {str(folder)!r}: expected a folder until the recording ends, got one that was '
        f'deleted or moved; call ~/start_recording, and boxreg recover for the labels in one that '
        f'was moved'
    )


def main() -> int:
    """
    Record from standard input; exit with 1 after an error, which the last status has.

    With arguments, a calibration file or '' and formats, check these instead.

    """
    if sys.argv[1:]:
        return _check(*sys.argv[1:])
    for number in (signal.SIGINT, signal.SIGTERM):  # the end of the input is the signal to end
        signal.signal(number, signal.SIG_IGN)
    os.nice(NICENESS)
    try:
        serve(sys.stdin.buffer, _print)
    except BoxregError as error:
        _print(label_feed.RecorderStatus(error=' '.join(str(error).split())))
        os._exit(1)  # the files that cannot be written would raise again when they are closed
    return 0


def _check(camera: str, *formats: str) -> int:
    """Print what is wrong with parameters in one line; return 1 if something is."""
    try:
        check_each(formats, camera)
    except BoxregError as error:
        print(' '.join(str(error).split()))
        return 1
    return 0


def _print(status: label_feed.RecorderStatus) -> None:
    """Write a line of status; the node may have been killed."""
    with suppress(BrokenPipeError):
        sys.stdout.write(status.line())
        sys.stdout.flush()


if __name__ == '__main__':
    sys.exit(main())
