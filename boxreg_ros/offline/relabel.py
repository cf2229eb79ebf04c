"""
Refine the boxes of a recording and write them as label files.

Every box of the recording is written exactly once: refined, or unchanged with the reason. With a
step of `Config.complete`, the recording is read twice and its tracks are completed.

"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from shutil import copyfile
from typing import Any, NamedTuple, TYPE_CHECKING

from boxreg_ros.io.session import hand_to_registrar
from boxreg_ros.io.storage.urls import url_of
from boxreg_ros.offline.output import Sink
from boxreg_ros.offline.products import (
    checked,
    completed_counts,
    write_proposals,
    write_run_report,
    write_track_tables,
)
from boxreg_ros.offline.progress import Progress, Stopwatch
from boxreg_ros.offline.reader import ReadAhead, reader, ReadItem
from boxreg_ros.offline.request import NO_TOPIC, Request
from boxreg_ros.offline.result_folder import (
    claimed,
    CONFIG,
    INPUT_MODEL,
    whole_folder,
    write_summary,
)
from boxreg_ros.offline.sources import true_boxes
from boxreg_ros.offline.summary import Summary
from boxreg_ros.review.corrections import Corrections
from boxreg_ros.review.decisions import DECISIONS, read_decisions
from boxreg_ros.structures import BoxArray
import yaml

if TYPE_CHECKING:
    from boxreg_ros.core.follow import FollowedTrack
    from boxreg_ros.core.input_statistics import Drives
    from boxreg_ros.core.latency import Latency
    from boxreg_ros.core.method.constants import Constants
    from boxreg_ros.core.registrar import BoxRegistrar
    from boxreg_ros.io.sweep_store import SweepStore
    from boxreg_ros.offline.completion import Arrivals, Completion, Moved
    from boxreg_ros.offline.stored_sweeps import StoredSweeps
    from boxreg_ros.tracks.complete import CompletionPlan


def relabel(request: Request, out: Path, progress: Progress | None = None) -> Summary:
    """
    Refine all boxes of a recording and write ``boxes.csv``, ``summary.json`` and other files.

    The folder `out` appears complete or not at all; an earlier result is replaced. `progress`
    shows the duration of the recording that has been read and its whole duration [s]; both count
    once for each time that it is read: with completed tracks once more. Returned is
    the content of ``summary.json``.

    Raises RecordingError if the recording lacks something, or `out` is not an earlier result or
    cannot be written, and UnsupportedMessage if none of its clouds, or none of its messages of
    boxes, can be read.

    """
    clock = Stopwatch()
    progress = progress or Progress()
    fingerprint = request.fingerprint()  # before reading: the files may change meanwhile
    corrections = Corrections(read_decisions(request.decisions) if request.decisions else ())
    # What cannot be read is refused before the work.
    truth = true_boxes(request.truth) if request.report and request.truth is not None else None
    drives = _other_drives(request)
    shown = _Passes(progress, 1 + (request.completes or corrections.adds))
    with claimed(out), ExitStack() as workers:
        if request.cloud_copies:
            with request.recording():  # both processes need the types of its messages
                pass
        survey = _survey(request, clock, shown, corrections, drives)
        sweeps = _stored_sweeps(request, out)
        receive = workers.enter_context(
            reader(request, None if survey is None else survey.latency, sweeps)
        )
        # The recording is opened while this process imports numba, which takes half a second.
        from boxreg_ros.core.input_statistics import to_text
        from boxreg_ros.core.registrar import BoxRegistrar
        from boxreg_ros.io.input_models import disagreements
        from boxreg_ros.offline.registration_worker import registration_worker

        recording = ReadAhead(receive)
        if survey is None:
            clock.begun('start')
        submit = workers.enter_context(
            registration_worker(request.config, clock, progress.announce)
        )
        registrar = BoxRegistrar(
            request.config,
            submit,
            drives=drives,
            constants=None if survey is None else survey.constants,
        )
        with whole_folder(out, request.inputs()) as folder:
            with Sink(folder, request, recording.source, clock, corrections) as sink:
                _register(recording, registrar, survey, sink, clock, shown)
            plan = None if survey is None else survey.plan
            summary = Summary.of(request, recording, registrar, sink)
            summary.complete = completed_counts(plan)
            summary.seeds = [] if survey is None else survey.ends
            for stage, seconds in recording.findings.seconds.items():
                clock.add(stage, seconds)
            summary.fingerprint = fingerprint
            tracks = sink.changes.tracks()
            if sweeps is not None:
                sweeps.places = recording.findings.places
                _write_points(folder, request, sweeps, sink, registrar, summary, clock)
            with clock('write'):
                rows = write_track_tables(folder, tracks, plan, summary.proposals)
                summary.rules, violated = checked(tracks, request.config)
            summary.seconds = clock.seconds()
            if sink.points is not None:
                sink.points.settle(registrar.box_time.resolved(request.config))
                write_run_report(
                    folder, out, request, summary, rows, violated, sink.points, truth, clock
                )
            if request.decisions is not None:
                copyfile(request.decisions, folder / DECISIONS)  # a review goes on from there
            taught = registrar.statistics(request.drive_name())
            (folder / INPUT_MODEL).write_text(to_text(taught), encoding='utf-8')
            summary.input_model = {
                'drives': len(drives),
                'warning': '; '.join(disagreements({**drives, **taught})),
            }
            settings = yaml.safe_dump(asdict(request.config), sort_keys=False)
            (folder / CONFIG).write_text(settings, encoding='utf-8')
            write_summary(folder, summary.as_json())
    return summary


def _stored_sweeps(request: Request, out: Path) -> StoredSweeps | None:
    """Return where the sweeps of a run are stored, on the disk of its results; None if nowhere."""
    if not request.needs_sweeps:
        return None
    from boxreg_ros.offline.stored_sweeps import StoredSweeps

    parent = out.resolve().parent if url_of(out) is None else None
    return StoredSweeps(parent, with_clouds=bool(request.point_formats))


def _write_points(
    folder: Path,
    request: Request,
    sweeps: StoredSweeps,
    sink: Sink,
    registrar: BoxRegistrar,
    summary: Summary,
    clock: Stopwatch,
) -> None:
    """Look for objects without a box, and label the points, by the boxes of all tracks."""
    from boxreg_ros.offline.point_products import labeller_of, PointProducts

    frame = summary.fixed_frame
    tracks = sink.changes.tracks()
    with clock('points'):
        labeller = labeller_of(tracks, sink.array_stamps_ns, registrar, request.config)
    if request.proposals:
        with clock('proposals'):
            summary.proposals = write_proposals(folder, sweeps, labeller, frame)
    if request.needs_point_labels:
        if request.boxes == NO_TOPIC and not tracks:  # nothing states what is there
            labeller = labeller_of(tracks, (), registrar, request.config)
        with clock('points'):
            summary.points = PointProducts(folder, request, sweeps, labeller, frame).write()


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


class _Survey(NamedTuple):
    """The first pass over a recording: what completes its tracks, and where keyframes end."""

    plan: CompletionPlan
    completion: Completion
    parts: list[Arrivals]
    ends: list[dict[str, Any]]
    latency: Latency
    constants: Constants | None


def _survey(
    request: Request,
    clock: Stopwatch,
    progress: _Passes,
    corrections: Corrections,
    drives: Drives,
) -> _Survey | None:
    """Read the recording a first time and plan its whole tracks; None where none is completed."""
    if not (request.completes or corrections.adds):
        return None
    with ExitStack() as workers:
        receive = workers.enter_context(reader(request))
        from boxreg_ros.core.following.person import numbers
        from boxreg_ros.offline.completion import Completion, first_pass
        from boxreg_ros.offline.keyframes import add_objects, arrivals, ends_of, keyframes, stored
        from boxreg_ros.tracks.complete import unchanged_plan

        recording = ReadAhead(receive)
        clock.begun('start')
        fixed_frame = recording.source.fixed_frame
        moved = (
            (_corrected(item.moved, corrections), item.restarts)
            for item in progress.each(recording)
        )
        stores: list[SweepStore] = []
        items = stored(moved, stores) if corrections.adds else moved
        tracks: list[FollowedTrack] = []
        deviations = None
        if request.keyframes:
            with clock('follow'):
                plan, parts, tracks, deviations = keyframes(
                    items, fixed_frame, request.config, corrections
                )
        elif request.completes:
            from boxreg_ros.offline.registration_worker import registration_worker

            submit = workers.enter_context(
                registration_worker(request.config, clock, progress.progress.announce)
            )
            first = first_pass(items, request.config, submit, fixed_frame, drives)
            plan = first.plan(fixed_frame, request.config, corrections)
            parts = first.parts
        else:
            parts = arrivals(items)
            plan = unchanged_plan([a for part in parts for a in part.completed(fixed_frame)])
        if corrections.adds:
            with clock('follow'):
                tracks += add_objects(
                    plan, parts, stores, corrections, fixed_frame, request.config
                )
        completion = Completion(plan, request.config, deviations)
        constants = None if deviations is None else numbers(deviations)
        latency = recording.source.latency
        return _Survey(plan, completion, parts, ends_of(tracks), latency, constants)


def _other_drives(request: Request) -> Drives:
    """Return what other drives have shown; this one, made before, would count twice."""
    if not request.input_model:
        return {}  # numba is imported while the recording is opened
    from boxreg_ros.io.input_models import read_models

    drives = read_models(request.input_model)
    drives.pop(request.drive_name(), None)
    return drives


def _corrected(item: Moved, corrections: Corrections) -> Moved:
    """Return boxes as they are to be registered; sweeps as they are."""
    return corrections.to_register(item) if isinstance(item, BoxArray) else item


def _register(
    recording: ReadAhead,
    registrar: BoxRegistrar,
    survey: _Survey | None,
    sink: Sink,
    clock: Stopwatch,
    progress: _Passes,
) -> None:
    """Read the recording, register its boxes, with those of the survey, and write them."""
    items = progress.each(recording)
    completion, take = None, sink.take
    if survey is not None:
        from boxreg_ros.offline.completion import with_empty_arrays

        completion = survey.completion
        take = completion.add  # completed tracks wait for the end of the recording
        items = with_empty_arrays(items, survey.parts, recording.source.fixed_frame)
    for item in items:
        with_ticket = sink.expect(item)
        moved = with_ticket.moved
        with clock('registrar'):
            if completion is not None:
                given, moved = moved, completion.to_register(moved, item.restarts)
                if sink.points is not None and isinstance(given, BoxArray):
                    sink.points.add(completion.added_boxes(given))
            ready = hand_to_registrar(registrar, moved, item.restarts)
        take(ready)
    with clock('registrar'):
        ready = registrar.flush()
    take(ready)
    if completion is not None:
        sink.take(completion.finished())
