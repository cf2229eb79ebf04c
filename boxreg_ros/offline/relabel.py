"""
Refine the boxes of a recording and write them as label files.

Every box of the recording is written exactly once: refined, or unchanged with the reason. With a
step of `Config.complete`, the recording is read twice and its tracks are completed.

"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from pathlib import Path
from shutil import copyfile
from typing import TYPE_CHECKING

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
from boxreg_ros.offline.reader import ReadAhead, reader
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
from boxreg_ros.offline.survey import Passes, Survey, survey
from boxreg_ros.review.corrections import Corrections
from boxreg_ros.review.decisions import DECISIONS, read_decisions
from boxreg_ros.structures import BoxArray
import yaml

if TYPE_CHECKING:
    from boxreg_ros.core.input_statistics import Drives
    from boxreg_ros.core.latency import Latency
    from boxreg_ros.core.matching import Pair
    from boxreg_ros.core.registrar import BoxRegistrar
    from boxreg_ros.offline.stored_sweeps import StoredSweeps


def relabel(request: Request, out: Path, progress: Progress | None = None) -> Summary:
    """
    Refine all boxes of a recording and write ``boxes.csv``, ``summary.json`` and other files.

    The folder `out` appears complete or not at all; an earlier result is replaced. `progress`
    shows the duration of the recording that has been read and its whole duration [s]; both count
    once for each time that it is read: with completed tracks once more. Returned is the
    content of ``summary.json``.

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
    shown = Passes(progress, 1 + (request.completes or corrections.adds))
    with claimed(out), ExitStack() as workers:
        if request.cloud_copies:
            with request.recording():  # both processes need the types of its messages
                pass
        first = survey(request, clock, shown, corrections, drives)
        sweeps = _stored_sweeps(request, out)
        receive = workers.enter_context(reader(request, sweeps))
        # The recording is opened while this process imports numba, which takes half a second.
        from boxreg_ros.core.input_statistics import to_text
        from boxreg_ros.core.registrar import BoxRegistrar
        from boxreg_ros.io.input_models import disagreements
        from boxreg_ros.offline.registration_worker import registration_worker

        recording = ReadAhead(receive)
        if first is None:
            clock.begun('start')
        submit = workers.enter_context(
            registration_worker(request.config, clock, progress.announce)
        )
        with whole_folder(out, request.inputs()) as folder:
            with Sink(folder, request, recording.source, clock, corrections) as sink:
                registrar = BoxRegistrar(
                    request.config,
                    submit,
                    drives=drives,
                    constants=None if first is None else first.constants,
                    latency=_known_latency(request, first),
                    prepare=partial(_to_register, sink=sink, survey=first),
                )
                _register(recording, registrar, first, sink, clock, shown)
            plan = None if first is None else first.plan
            latency = registrar.latency
            if first is not None and first.latency is not None:
                latency = first.latency
            summary = Summary.of(request, recording, registrar, latency, sink)
            summary.complete = completed_counts(plan)
            summary.seeds = [] if first is None else first.ends
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


def _other_drives(request: Request) -> Drives:
    """Return what other drives have shown; this one, made before, would count twice."""
    if not request.input_model:
        return {}  # numba is imported while the recording is opened
    from boxreg_ros.io.input_models import read_models

    drives = read_models(request.input_model)
    drives.pop(request.drive_name(), None)
    return drives


def _known_latency(request: Request, survey: Survey | None) -> Latency | None:
    """Return the latency of the boxes that are read: none once the survey has corrected them."""
    from boxreg_ros.core.latency import Latency

    is_in_time = survey is not None and survey.in_time is not None
    return Latency() if request.keyframes or is_in_time else None


def _to_register(pair: Pair, sink: Sink, survey: Survey | None) -> BoxArray:
    """Return boxes as they are to be registered: as decided, with those that the plan adds."""
    given = sink.to_register(pair.boxes, pair.sweep)
    if survey is None:
        return given
    boxes = survey.completion.to_register(given, pair.sweep)
    if sink.points is not None:
        sink.points.gather(survey.completion.added_boxes(given), pair.sweep)
    return boxes


def _register(
    recording: ReadAhead,
    registrar: BoxRegistrar,
    survey: Survey | None,
    sink: Sink,
    clock: Stopwatch,
    progress: Passes,
) -> None:
    """Read the recording, register its boxes, with those of the survey, and write them."""
    items = progress.each(recording)
    take = sink.take
    if survey is not None:
        items = survey.completed(items, recording.source.fixed_frame)
        take = survey.completion.add  # completed tracks wait for the end of the recording
    for item in items:
        moved, reason = sink.expect(item)
        if survey is not None and isinstance(moved, BoxArray) and not reason:
            survey.completion.expect(moved.ticket)
        with clock('registrar'):
            ready = hand_to_registrar(registrar, moved, item.restarts, reason)
        take(ready)
    with clock('registrar'):
        ready = registrar.flush()
    take(ready)
    if survey is not None:
        sink.take(survey.completion.finished())
