"""
Refine the boxes of a recording and write them as label files.

Every box of the recording is written exactly once: refined, or unchanged with the reason. With a
step of `Config.complete`, the recording is read twice and its tracks are completed.

"""

from __future__ import annotations

from contextlib import ExitStack, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from boxreg_ros.io.storage.urls import url_of
from boxreg_ros.offline.output import Sink
from boxreg_ros.offline.progress import Progress, Stopwatch
from boxreg_ros.offline.reader import JumpingIds, ReadAhead, reader
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.result_folder import claimed, whole_folder, write_summary
from boxreg_ros.offline.sources import true_boxes
from boxreg_ros.offline.summary import Summary
from boxreg_ros.offline.survey import Passes, survey
from boxreg_ros.review.corrections import Corrections
from boxreg_ros.review.decisions import read_decisions

if TYPE_CHECKING:
    from boxreg_ros.core.input_statistics import Drives
    from boxreg_ros.offline.stored_sweeps import StoredSweeps


def relabel(request: Request, out: Path, progress: Progress | None = None) -> Summary:
    """
    Refine all boxes of a recording and write ``boxes.csv``, ``summary.json`` and other files.

    The folder `out` appears complete or not at all; an earlier result is replaced. `progress`
    shows the duration of the recording that has been read and its whole duration [s]; both count
    once for each time that it is read: with completed tracks once more. Returned is the
    content of ``summary.json``. A run begins again, with boxes that are associated, where the ids
    of their topic turn out not to identify objects over time.

    Raises RecordingError if the recording lacks something, or `out` is not an earlier result or
    cannot be written, and UnsupportedMessage if none of its clouds, or none of its messages of
    boxes, can be read.

    """
    progress = progress or Progress()
    fingerprint = request.fingerprint()  # before reading: the files may change meanwhile
    try:
        return _relabel(request, out, progress, fingerprint)
    except JumpingIds as found:
        associated = replace(request, jumping_ids=str(found))
        return _relabel(associated, out, progress, fingerprint)


def _relabel(request: Request, out: Path, progress: Progress, fingerprint: str) -> Summary:
    """
    Refine all boxes of a recording, whose ids are as the request says.

        recording --> survey: plan of completed tracks --+   (first pass, where any are)
            |                                            v
            +--------> reader: items in time --> main process --> labels, tables, report
                                                     |  ^
                                             windows v  | estimates
                                                   worker

    """
    clock = Stopwatch()
    corrections = Corrections(read_decisions(request.decisions) if request.decisions else ())
    # What cannot be read is refused before the work.
    truth = true_boxes(request.truth) if request.report and request.truth is not None else None
    drives = _other_drives(request)
    shown = Passes(progress, 1 + (request.completes or corrections.adds))
    with claimed(out), ExitStack() as workers:
        with request.recording() if request.cloud_copies else nullcontext():
            pass  # both processes need the types of its messages
        first = survey(request, clock, shown, corrections, drives)
        sweeps = _stored_sweeps(request, out)
        receive = workers.enter_context(reader(request, sweeps))
        from boxreg_ros.offline.estimation_worker import estimation_worker
        from boxreg_ros.offline.main_process import MainProcess

        recording = ReadAhead(receive)
        if first is None:
            clock.begun('start')
        submit = workers.enter_context(estimation_worker(request.config, clock, progress.announce))
        run = MainProcess(request, recording, drives, first, sweeps, truth, clock)
        with whole_folder(out, request.inputs()) as folder:
            with Sink(folder, request, recording.source, clock, corrections) as sink:
                registrar = run.register(sink, submit, shown)
            summary = run.write(folder, out, registrar, sink, fingerprint)
            write_summary(folder, summary.as_json())
    return summary


def _stored_sweeps(request: Request, out: Path) -> StoredSweeps | None:
    """Return where the sweeps of a run are stored, on the disk of its results; None if nowhere."""
    if not request.needs_sweeps:
        return None
    from boxreg_ros.offline.stored_sweeps import StoredSweeps

    parent = out.resolve().parent if url_of(out) is None else None
    return StoredSweeps(parent, with_clouds=bool(request.point_formats))


def _other_drives(request: Request) -> Drives:
    """Return what other drives have shown; this one, made before, would count twice."""
    if not request.input_model:
        return {}  # numba is imported while the recording is opened
    from boxreg_ros.io.input_models import read_models

    drives = read_models(request.input_model)
    drives.pop(request.drive_name(), None)
    return drives
