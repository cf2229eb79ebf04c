"""
Refine the boxes of a recording and write them as label files.

Every box of the recording is written exactly once: refined, or unchanged with the reason. With a
step of `Config.complete`, the recording is read twice and its tracks are completed.

"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, ExitStack
from dataclasses import asdict
import json
from pathlib import Path
from shutil import copyfile
from typing import TYPE_CHECKING

from boxreg_ros.io.session import hand_to_registrar
from boxreg_ros.offline.output import Sink
from boxreg_ros.offline.products import (
    checked,
    completed_counts,
    write_run_report,
    write_track_tables,
)
from boxreg_ros.offline.progress import Progress
from boxreg_ros.offline.reader import ReadAhead, reader, ReadItem
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.result_folder import CONFIG, delete_remains, SUMMARY, whole_folder, writing
from boxreg_ros.offline.stopwatch import Stopwatch
from boxreg_ros.offline.summary import Summary
from boxreg_ros.review.decisions import DECISIONS
from boxreg_ros.structures import BoxArray, RefinedBoxes
import yaml

if TYPE_CHECKING:
    from boxreg_ros.core.registrar import BoxRegistrar, Submit
    from boxreg_ros.offline.completion import Completion
    from boxreg_ros.offline.journal import EstimateJournal
    from boxreg_ros.tracks.complete import CompletionPlan


def relabel(
    request: Request, out: Path, progress: Progress | None = None, resume: bool = False
) -> Summary:
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
    summary : Summary
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
        plan, completion = _survey(request, clock, shown, journal)
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
            with Sink(folder, request, recording.source, clock) as sink:
                _register(recording, registrar, completion, sink, clock, shown)
            summary = Summary.of(request, recording, registrar, sink)
            summary.complete = completed_counts(plan)
            for stage, seconds in recording.findings.seconds.items():
                clock.add(stage, seconds)
            summary.fingerprint = fingerprint
            summary.seconds = clock.seconds()
            tracks = sink.changes.tracks()
            with clock('write'):
                rows = write_track_tables(folder, tracks, plan)
                summary.rules, violated = checked(tracks, request.config)
            if request.needs_point_labels:
                from boxreg_ros.offline.point_products import write_point_products

                with clock('points'):
                    stamps_ns = sink.array_stamps_ns
                    summary.points = write_point_products(
                        folder, request, tracks, stamps_ns, registrar
                    )
                summary.seconds = clock.seconds()
            if sink.points is not None:
                sink.points.settle(registrar.box_time.resolved(request.config))
                write_run_report(folder, out, request, summary, rows, violated, sink.points, clock)
            if request.decisions is not None:
                copyfile(request.decisions, folder / DECISIONS)  # a review goes on from there
            settings = yaml.safe_dump(asdict(request.config), sort_keys=False)
            (folder / CONFIG).write_text(settings, encoding='utf-8')
            (folder / SUMMARY).write_text(
                json.dumps(summary.as_json(), indent=2) + '\n', encoding='utf-8'
            )
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


def _survey(
    request: Request, clock: Stopwatch, progress: _Passes, journal: EstimateJournal | None
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
        items = ((item.moved, item.restarts) for item in progress.each(recording))
        submit = _journaled(submit, journal)
        first = first_pass(items, request.config, submit)
        plan = first.plan(recording.source.fixed_frame, request.config)
        return plan, Completion(plan, request.config)


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
