"""
Refine the boxes of a recording and write them as label files.

Every box of the recording is written exactly once: refined, or unchanged with the reason. With a
step of `Config.complete`, the recording is read twice and its tracks are completed.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, ExitStack, suppress
from dataclasses import asdict
from datetime import datetime, UTC
from importlib.metadata import version
import json
from pathlib import Path
import platform
from shutil import copyfile
from typing import Any, TYPE_CHECKING

from boxreg_ros import __version__
from boxreg_ros.config import Config
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.lidars import CLOUD_LATE, CLOUD_MERGED, CLOUD_MISSING
from boxreg_ros.io.session import hand_to_registrar
from boxreg_ros.io.storage.record import Damage
from boxreg_ros.offline.output import Sink
from boxreg_ros.offline.progress import Progress
from boxreg_ros.offline.reader import Findings, ReadAhead, reader, ReadItem
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.result_folder import CONFIG, delete_remains, SUMMARY, whole_folder, writing
from boxreg_ros.offline.sources import true_boxes
from boxreg_ros.offline.stopwatch import Stopwatch
from boxreg_ros.offline.tracks_table import step_cells, STEP_COLUMNS
from boxreg_ros.reasons import REASONS
from boxreg_ros.review.corrections import Corrections
from boxreg_ros.review.decisions import DECISIONS, read_decisions
from boxreg_ros.structures import (
    BoxArray,
    COASTED,
    EXTENDED,
    HUMAN,
    INTERPOLATED,
    KEPT,
    REFINED,
    RefinedBoxes,
    REJECTED,
)
import numpy as np
import yaml

if TYPE_CHECKING:
    from boxreg_ros.core.registrar import BoxRegistrar, Submit
    from boxreg_ros.offline.completion import Completion, Moved
    from boxreg_ros.offline.journal import EstimateJournal
    from boxreg_ros.review.changes import TrackChanges
    from boxreg_ros.review.rules.protocol import Violation
    from boxreg_ros.review.tables import TrackRow
    from boxreg_ros.review.track_points import PointCollector
    from boxreg_ros.tracks.complete import CompletionPlan

MAX_NAMED = 5
"""Most tracks that a warning names; chosen."""
UNUSED_PREFIXES = ('sweep_', 'boxes_')
"""Counters of the registrar with these prefixes count unused messages and not kept boxes."""
NO_BOXES = 'no boxes in this part of the recording: nothing was refined; see --start and --end'

FEW_REFINED = 0.5
"""Refined part of the boxes below which a run prints its most frequent reason. Chosen."""


def relabel(
    request: Request, out: Path, progress: Progress | None = None, resume: bool = False
) -> dict[str, Any]:
    """
    Refine all boxes of a recording and write ``boxes.csv``, ``summary.json`` and other files.

    Parameters
    ----------
    request : Request
        Inputs and options.
    out : Path
        Result folder. It appears complete or not at all; an earlier result is replaced.
    progress : Progress, optional
        Shows the duration of the recording that has been read and its whole duration [s]. Both
        count once for each time that the recording is read: with completed tracks once more.
    resume : bool
        Keep a journal of the run, and go on with that of an interrupted one, see
        `EstimateJournal`.

    Returns
    -------
    summary : dict
        The content of ``summary.json``.

    Raises
    ------
    RecordingError
        If the recording lacks something, `out` is not an earlier result, or cannot be written.
    UnsupportedMessage
        If none of its clouds, or none of its messages of boxes, can be read.

    """
    clock = Stopwatch()
    progress = progress or Progress()
    fingerprint = request.fingerprint()  # before reading: the files may change meanwhile
    shown = _Passes(progress, 1 + bool(request.config.complete.steps))
    with writing(out), ExitStack() as workers:
        journal = workers.enter_context(_journal(out, fingerprint)) if resume else None
        corrections = _corrections(request)
        plan, completion = _survey(request, clock, shown, journal, corrections)
        receive = workers.enter_context(reader(request))
        # The recording is opened while this process imports numba, which takes half a second.
        from boxreg_ros.core.registrar import BoxRegistrar
        from boxreg_ros.offline.registration_worker import registration_worker

        recording = ReadAhead(receive)
        if plan is None:
            clock.begun('start')
        submit = workers.enter_context(
            registration_worker(request.config, clock, progress.announce)
        )
        registrar = BoxRegistrar(request.config, _journaled(submit, journal))
        with whole_folder(out, request.inputs()) as folder:
            with Sink(folder, request, recording.source, clock, corrections) as sink:
                _register(recording, registrar, completion, sink, clock, shown)
            summary = _summary(request, recording, registrar, sink)
            summary['unused_decisions'] = corrections.unused()
            summary['complete'] = _completed(plan)
            for stage, seconds in recording.findings.seconds.items():
                clock.add(stage, seconds)
            summary |= {'fingerprint': fingerprint, 'seconds': clock.seconds()}
            tracks = sink.changes.tracks()
            with clock('write'):
                rows = _write_tables(folder, tracks, plan)
                summary['rules'], violated = _checked(tracks, request.config)
            if sink.points is not None:
                sink.points.settle(registrar.box_time.resolved(request.config))
                _report(folder, out, request, summary, rows, violated, sink.points, clock)
            if request.decisions is not None:
                copyfile(request.decisions, folder / DECISIONS)  # a review goes on from there
            settings = yaml.safe_dump(asdict(request.config), sort_keys=False)
            (folder / CONFIG).write_text(settings, encoding='utf-8')
            (folder / SUMMARY).write_text(json.dumps(summary, indent=2) + '\n', encoding='utf-8')
    return summary


@contextmanager
def _journal(out: Path, fingerprint: str) -> Iterator[EstimateJournal]:
    """Yield the journal of a run; while it is locked, other partial results are remains."""
    from boxreg_ros.offline.journal import EstimateJournal, journal_path

    with EstimateJournal(journal_path(out), fingerprint) as journal:
        delete_remains(out)
        yield journal


def _journaled(submit: Submit | None, journal: EstimateJournal | None) -> Submit | None:
    """Return `submit` with the estimates that a journal has."""
    from boxreg_ros.core.registrar import submit_locally

    return submit if journal is None else journal.journaled(submit or submit_locally)


class _Passes:
    """Progress over several passes through a recording."""

    def __init__(self, progress: Progress, passes: int) -> None:
        self.progress = progress
        self._passes = passes
        self._done = 0

    def each(self, recording: ReadAhead) -> Iterator[ReadItem]:
        """Yield the items of one pass, and show the time that has been read [s]."""
        seconds = recording.source.seconds
        for item in recording:
            self.progress.show(self._done * seconds + item.seconds, self._passes * seconds)
            yield item
        self._done += 1


def _corrections(request: Request) -> Corrections:
    """Return the decisions of a person; none without a file of them."""
    return Corrections(() if request.decisions is None else read_decisions(request.decisions))


def _survey(
    request: Request,
    clock: Stopwatch,
    progress: _Passes,
    journal: EstimateJournal | None,
    corrections: Corrections,
) -> tuple[CompletionPlan | None, Completion | None]:
    """Register the recording a first time and plan its whole tracks; None without steps."""
    if not request.config.complete.steps:
        return None, None
    with ExitStack() as workers:
        receive = workers.enter_context(reader(request))
        from boxreg_ros.offline.completion import Completion, first_pass
        from boxreg_ros.offline.registration_worker import registration_worker

        recording = ReadAhead(receive)
        clock.begun('start')
        submit = workers.enter_context(
            registration_worker(request.config, clock, progress.progress.announce)
        )
        items = (
            (_corrected(item.moved, corrections), item.restarts)
            for item in progress.each(recording)
        )
        submit = _journaled(submit, journal)
        first = first_pass(items, request.config, submit)
        plan = first.plan(recording.source.fixed_frame, request.config)
        return plan, Completion(plan, request.config)


def _corrected(item: Moved, corrections: Corrections) -> Moved:
    """Return boxes as they are to be registered; sweeps as they are."""
    return corrections.to_register(item) if isinstance(item, BoxArray) else item


def _register(
    recording: ReadAhead,
    registrar: BoxRegistrar,
    completion: Completion | None,
    sink: Sink,
    clock: Stopwatch,
    progress: _Passes,
) -> None:
    """Read the recording, register its boxes, with those of `completion`, and write them."""
    for item in progress.each(recording):
        with_ticket = sink.expect(item)
        moved = with_ticket.moved
        with clock('registrar'):
            if completion is not None:
                given, moved = moved, completion.to_register(moved, item.restarts)
                if sink.points is not None and isinstance(given, BoxArray):
                    sink.points.add(completion.added_boxes(given))
            ready = hand_to_registrar(registrar, moved, item.restarts)
        _take(ready, completion, sink)
    with clock('registrar'):
        ready = registrar.flush()
    _take(ready, completion, sink)
    if completion is not None:
        sink.take(completion.finished())


def _take(ready: list[RefinedBoxes], completion: Completion | None, sink: Sink) -> None:
    """Hand results on; those of completed tracks wait for the end of the recording."""
    if completion is None:
        sink.take(ready)
    else:
        completion.add(ready)


def _completed(plan: CompletionPlan | None) -> dict[str, int]:
    """Return the numbers of tracks and boxes that each step changed; empty without steps."""
    if plan is None:
        return {}
    tracks = plan.tracks
    return {
        'tracks': len(tracks),
        'joined': sum(track.fragments - 1 for track in tracks),
        'ambiguous': sum(bool(track.ambiguous) for track in tracks),
        'rejected': sum(track.rejected for track in tracks),
        'filled': sum(track.filled for track in tracks),
        'extended': sum(track.extended for track in tracks),
        'reclassified': sum(track.reclassified for track in tracks),
    }


def _write_tables(
    folder: Path, tracks: Sequence[TrackChanges], plan: CompletionPlan | None
) -> list[TrackRow]:
    """Write the tables of tracks; return their rows, largest risk first."""
    from boxreg_ros.review.tables import assessed, write_tables

    rows = assessed(tracks)
    if plan is None:
        write_tables(folder, rows)
    else:
        write_tables(folder, rows, STEP_COLUMNS, step_cells(plan.tracks))
    return rows


def _checked(
    tracks: Sequence[TrackChanges], config: Config
) -> tuple[dict[str, dict[str, int]], dict[str, list[Violation]]]:
    """Return the number of violations of each rule, ``before`` and ``after``, and those after."""
    from boxreg_ros.review.rules import counts, violations
    from boxreg_ros.review.rules.protocol import LabelTrack

    before = []
    after = []
    for track in tracks:
        names = track.track_id, track.class_name, config, track.stamps_ns
        before.append(LabelTrack.of(*names, track.given, track.num_points))
        after.append(LabelTrack.of(*names, track.boxes, track.num_points))
    found = violations(after)
    return {'before': counts(violations(before)), 'after': counts(found)}, found


def _report(
    folder: Path,
    out: Path,
    request: Request,
    summary: dict[str, Any],
    rows: Sequence[TrackRow],
    violated: Mapping[str, Sequence[Violation]],
    points: PointCollector,
    clock: Stopwatch,
) -> None:
    """Write the report and add its time to the summary."""
    from boxreg_ros.review.report import write_report

    with clock('report'):
        truth = _truth(request, [row.track for row in rows], summary)
        line = closing_line(summary, out)
        write_report(folder, line, summary, request.config, rows, violated, points, truth)
    summary['seconds'] = clock.seconds()


def _truth(
    request: Request, tracks: Sequence[TrackChanges], summary: dict[str, Any]
) -> BoxTable | None:
    """Return the true boxes for the report; None, with a warning, where they do not fit."""
    if request.truth is None:
        return None
    from boxreg_ros.offline.evaluate import time_range

    truth = true_boxes(request.truth)
    stamps = np.concatenate([np.zeros(0, np.int64), *(track.stamps_ns for track in tracks)])
    names = {track.track_id for track in tracks}
    problem = ''
    if truth.frame_id != summary['fixed_frame']:
        problem = f'frame {summary["fixed_frame"]!r}, got {truth.frame_id!r}'
    elif len(stamps) and not np.isin(stamps, truth.stamps_ns).any():
        problem = f'boxes of {time_range(stamps)}, got {time_range(truth.stamps_ns)}'
    elif names.isdisjoint(truth.track_ids):
        problem = f'tracks {sorted(names)[:MAX_NAMED]}, got {truth.track_ids[:MAX_NAMED]}'
    if not problem:
        return truth
    line = (
        f'truth {str(request.truth)!r}: expected {problem}; the report is written without it: '
        f'give the true boxes of this drive to --truth'
    )
    summary['warning'] = '; '.join(filter(None, (summary['warning'], line)))
    return None


def _summary(
    request: Request, recording: ReadAhead, registrar: BoxRegistrar, sink: Sink
) -> dict[str, Any]:
    """Return the content of summary.json, without the fingerprint and the times."""
    if sink.missing():
        raise RuntimeError(
            f'boxes: expected all {sink.boxes_in} back from the registrar, {sink.missing()} are '
            f'missing; this is a fault of boxreg_ros: please report it'
        )
    source = recording.source
    findings = recording.findings
    return {
        'recordings': [str(path) for path in request.recordings],
        'command': list(request.command),
        'folder': str(Path.cwd()),
        'topics': source.topics,
        'labels': _labels(request, findings.outside),
        'fixed_frame': source.fixed_frame,
        'estimate': request.config.estimate,
        'sweeps': findings.counts['sweeps'],
        'box_arrays': findings.counts['box_arrays'],
        'boxes_in': sink.boxes_in,
        'boxes_out': sink.boxes_out,
        'status': dict(sink.status),
        'reasons': dict(sink.reasons.most_common()),
        'time_jumps': findings.counts['time_jump'],
        'recorded_apart': {t: round(late, 3) for t, late in findings.apart.items()},
        'heading_flips': sink.heading_flips,
        'box_time': registrar.box_time.summary(request.config),
        'time_ranges': {name: list(ends) for name, ends in sink.time_ranges.items()},
        'unknown_classes': dict(sink.unknown_classes.most_common()),
        'dropped': _dropped(registrar.counts, findings),
        'without_stamp': _without_stamp(findings),
        'damage': [damage._asdict() for damage in findings.damages],
        'lidars': {topic: dict(counts) for topic, counts in findings.lidars.items()},
        'point_layouts': findings.point_layouts,
        'first_missing_transform': findings.first_missing_transform,
        'first_unplaced': findings.first_unplaced,
        'first_unreadable': findings.first_unreadable,
        'warning': findings.warning or ('' if sink.boxes_in else NO_BOXES),
        **findings.facts,
        'left_out_of_labels': sink.left_out(),
        'frames_without_cloud': sink.without_cloud,
        'versions': _versions(),
    }


def _labels(request: Request, outside: int) -> dict[str, Any] | None:
    """Return the label files that the boxes come from; None for boxes of the recording."""
    if request.labels is None:
        return None
    name, path = request.labels
    return {'format': name, 'path': str(path), 'boxes_outside_part': outside}


def _dropped(registered: Counter[str], findings: Findings) -> dict[str, int]:
    """Return the number of messages that were not used, by reason."""
    counts = {
        name: count for name, count in registered.items() if name.startswith(UNUSED_PREFIXES)
    }
    for name in ('sweep_without_transform', 'sensor_without_transform', 'cloud_without_info'):
        counts[name] = findings.counts[name]
    for lidar in findings.lidars.values():
        for name in (CLOUD_LATE, CLOUD_MISSING):
            counts[name] = counts.get(name, 0) + lidar[name]
    counts['unreadable'] = findings.unreadable
    return {name: count for name, count in sorted(counts.items()) if count}


def _without_stamp(findings: Findings) -> dict[str, int]:
    """Return the number of clouds and box arrays whose header has no stamp."""
    counts = {name: findings.counts[f'{name}_without_stamp'] for name in ('sweeps', 'box_arrays')}
    return {name: count for name, count in counts.items() if count}


def _versions() -> dict[str, str]:
    """Return the versions of everything that can change the results."""
    versions = {'boxreg_ros': __version__, 'python': platform.python_version()}
    for name in ('torch', 'numpy', 'scipy', 'rosbags'):
        versions[name] = version(name)
    return versions


def closing_line(summary: dict[str, Any], out: Path) -> str:
    """Return the result of a run in one line."""
    status = summary['status']
    parts = [
        f'{summary["boxes_in"]:,} boxes in',
        f'{status.get(REFINED, 0):,} refined',
        f'{status.get(KEPT, 0):,} kept',
    ]
    if summary['reasons']:
        parts[-1] += f' ({_counts(summary["reasons"])})'
    if summary['heading_flips']:
        parts.append(f'{summary["heading_flips"]:,} heading flips corrected')
    for word in (HUMAN, REJECTED, INTERPOLATED, EXTENDED, COASTED):
        if word in status:
            parts.append(f'{status[word]:,} {word}')
    line = (
        f'{out}: {", ".join(parts)} from {summary["sweeps"]:,} sweeps in '
        f'{summary["seconds"]["total"]:.1f} s, fixed frame {summary["fixed_frame"]}'
    )
    if summary['recorded_apart']:
        apart = [f'{topic} ({late:+,.1f} s)' for topic, late in summary['recorded_apart'].items()]
        line += f'; merged by stamp: {", ".join(apart)}'
    if 'unreadable' in summary['dropped']:
        line += f'; {summary["dropped"]["unreadable"]:,} messages could not be read'
    return line


def notes(summary: dict[str, Any]) -> Iterator[str]:
    """Yield warnings about the input and the results, one line each."""
    yield from _input_notes(summary)
    yield from _lidar_notes(summary)
    yield from _label_notes(summary)
    if summary['unknown_classes']:
        names = ', '.join(repr(name) for name in summary['unknown_classes'])
        boxes = sum(summary['unknown_classes'].values())
        yield (
            f'unknown class names are treated as vehicles: {names} ({boxes:,} boxes); name '
            f'them in vehicle.names, cyclist.names or pedestrian.names'
        )
    if part_refined(summary) < FEW_REFINED:
        yield _why_few_were_refined(summary)


def _lidar_notes(summary: dict[str, Any]) -> Iterator[str]:
    """Yield the clouds that were not used as those of their LiDARs, one line each."""
    for topic, counts in summary['lidars'].items():
        if counts.get(CLOUD_LATE) or counts.get(CLOUD_MISSING):
            yield (
                f'LiDAR {topic}: {counts.get(CLOUD_MERGED, 0):,} clouds merged, '
                f'{counts.get(CLOUD_LATE, 0):,} late, {counts.get(CLOUD_MISSING, 0):,} missing; '
                f'the others were used'
            )
    if summary['first_unplaced']:
        clouds = sum(
            summary['dropped'].get(name, 0)
            for name in ('sensor_without_transform', 'cloud_without_info')
        )
        yield (
            f'the LiDARs of {clouds:,} clouds are not all known, the origin of their frame is '
            f'used; first: {summary["first_unplaced"]}'
        )


def _label_notes(summary: dict[str, Any]) -> Iterator[str]:
    """Yield the boxes, decisions and clouds that label files lack, one line each."""
    for name, found in summary['left_out_of_labels'].items():
        reasons = ', '.join(f'{count:,} ({reason})' for reason, count in found.items())
        yield f'format {name} cannot represent some boxes, they are left out: {reasons}'
    if summary['unused_decisions']:
        unused = summary['unused_decisions']
        named = [*unused[:MAX_NAMED], '...'] if len(unused) > MAX_NAMED else unused
        names = ', '.join(named)
        yield (
            f'decisions: expected those on tracks and boxes of this recording, got '
            f'{len(unused):,} on others, not used: {names}; give the decisions of this recording '
            f'to --decisions'
        )
    if summary['frames_without_cloud']:
        yield (
            f'{summary["frames_without_cloud"]:,} of {summary["box_arrays"]:,} box arrays have no '
            f'cloud to write beside them'
        )


def is_complete(summary: dict[str, Any]) -> bool:
    """Return whether all messages of the recording were read, with usable stamps."""
    return not (
        summary['damage'] or summary['without_stamp'] or 'unreadable' in summary['dropped']
    )


def _input_notes(summary: dict[str, Any]) -> Iterator[str]:
    """Yield the parts of the recording that cannot be used, one line each."""
    if summary['damage']:
        yield _damage_line(summary['damage'])
    if summary['without_stamp']:
        counts = ' and '.join(f'{n:,} {kind}' for kind, n in summary['without_stamp'].items())
        yield (
            f'{counts} have the stamp 0 in their header and cannot be used: receive times do not '
            f'replace stamps; let the publishers set them'
        ).replace('box_arrays', 'box arrays')
    if summary['warning']:
        yield summary['warning']
    if summary['first_unreadable']:
        yield (
            f'{summary["dropped"]["unreadable"]:,} messages or sweeps could not be read; the rest '
            f'was used; first: {summary["first_unreadable"]}'
        )
    if summary['first_missing_transform']:
        boxes = summary['reasons'].get('no_transform', 0)
        sweeps = summary['dropped'].get('sweep_without_transform', 0)
        yield (
            f'{boxes:,} boxes and {sweeps:,} clouds have no transform; first: '
            f'{summary["first_missing_transform"]}'
        )


def _damage_line(damages: list[dict[str, Any]]) -> str:
    """Return all damages of a recording in one line."""
    count = len(damages)
    parts = f'{count:,} parts' if count > 1 else 'a part'
    return (
        f'{parts} of the recording cannot be read; the rest was used; first: '
        f'{Damage(**damages[0])}; {SUMMARY} lists {"all" if count > 1 else "it"} under "damage"'
    )


def has_failed(summary: dict[str, Any]) -> bool:
    """Return whether a run had boxes and refined none of them."""
    return bool(summary['boxes_in']) and not num_refined(summary)


def part_refined(summary: dict[str, Any]) -> float:
    """Return the part of the input boxes that were refined; 1 without boxes."""
    boxes = int(summary['boxes_in'])
    return num_refined(summary) / boxes if boxes else 1.0


def num_refined(summary: dict[str, Any]) -> int:
    """Return the number of input boxes that were refined, by the points or by a person."""
    return int(sum(summary['status'].get(word, 0) for word in (REFINED, HUMAN)))


def _why_few_were_refined(summary: dict[str, Any]) -> str:
    """Return the most frequent reason why boxes were kept, its remedy, and both time ranges."""
    name, count = next(iter(summary['reasons'].items()))  # sorted by count
    reason = REASONS[name]
    refined = num_refined(summary)
    part = f'only {refined:,} of {summary["boxes_in"]:,} boxes were refined'
    if not refined:
        part = f'none of {summary["boxes_in"]:,} boxes was refined'
    line = f'{part}; most frequent reason: {name} ({count:,} boxes): {reason.meaning}'
    if reason.remedy:
        line += f'; remedy: {reason.remedy}'
    ranges = [f'{name} {_time_range(*r)}' for name, r in sorted(summary['time_ranges'].items())]
    return f'{line}; time ranges: {", ".join(ranges)}'


def _time_range(first_ns: int, last_ns: int) -> str:
    """Return two stamps as seconds with the date of the first."""
    with suppress(OverflowError, ValueError, OSError):
        date = datetime.fromtimestamp(first_ns * 1e-9, UTC).strftime('%Y-%m-%d')
        return f'{first_ns * 1e-9:.3f} to {last_ns * 1e-9:.3f} s ({date})'
    return f'{first_ns * 1e-9:.3f} to {last_ns * 1e-9:.3f} s'


def _counts(counts: dict[str, int]) -> str:
    return ', '.join(f'{name} {count:,}' for name, count in counts.items())
