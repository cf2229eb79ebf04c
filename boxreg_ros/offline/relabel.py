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

from boxreg_ros.config import Config
from boxreg_ros.errors import ConfigError
from boxreg_ros.io.storage.urls import url_of
from boxreg_ros.offline.output import Sink
from boxreg_ros.offline.progress import Progress, Stopwatch
from boxreg_ros.offline.reader import JumpingIds, ReadAhead, reader
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.result_folder import (
    claimed,
    CONFIG,
    earlier_summary,
    FILES,
    SUMMARY,
    whole_folder,
    write_summary,
)
from boxreg_ros.offline.sources import source_of, true_boxes
from boxreg_ros.offline.summary import Summary
from boxreg_ros.offline.survey import Passes, survey
from boxreg_ros.review.corrections import Corrections
from boxreg_ros.review.decisions import Decision, DECISIONS, read_decisions
from boxreg_ros.structures import REJECTED

if TYPE_CHECKING:
    from boxreg_ros.core.input_statistics import Drives
    from boxreg_ros.offline.stored_sweeps import StoredSweeps

ASSOCIATED = 'associated_tracks'
"""Field of the summary of a run that has associated its boxes."""


def relabel(request: Request, out: Path, progress: Progress | None = None) -> Summary:
    """
    Refine all boxes of a recording and write ``boxes.csv``, ``summary.json`` and other files.

    A run begins again, with boxes that are associated, where the ids of their topic turn out not
    to identify objects over time.

    Parameters
    ----------
    request : Request
        The recording and all settings.
    out : Path
        The folder of results: it appears complete or not at all; an earlier result is replaced.
    progress : Progress, optional
        Shows the duration of the recording that has been read and its whole duration [s]; both
        count once for each time that it is read: with completed tracks once more.

    Returns
    -------
    summary : Summary
        The content of ``summary.json``.

    Raises
    ------
    RecordingError
        If the recording lacks something, or `out` is not an earlier result or cannot be written.
    UnsupportedMessage
        If none of the clouds, or none of the messages of boxes, can be read.
    ConfigError
        If `out` contains an input, or an option of a format does not fit the recording.

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
    corrections = Corrections(_decisions(request, out), _rejected(request), _applied(request))
    # What cannot be read is refused before the work.
    truth = true_boxes(request.truth) if request.report and request.truth is not None else None
    drives = _other_drives(request)
    shown = Passes(progress, 1 + (request.completes or corrections.adds))
    with claimed(out), ExitStack() as workers:
        with source_of(request) if request.cloud_copies else nullcontext():
            pass  # both processes need the types of its messages
        first = survey(request, clock, shown, corrections, drives)
        sweeps = _stored_sweeps(request, out)
        receive = workers.enter_context(reader(request, sweeps))
        from boxreg_ros.offline.estimation_worker import estimation_worker
        from boxreg_ros.offline.main_process import MainProcess

        recording = ReadAhead(receive)
        del receive  # with the last item, its memory is free
        if first is None:
            clock.begun('start')
        submit = workers.enter_context(estimation_worker(request.config, clock, progress.announce))
        run = MainProcess(request, recording, drives, first, sweeps, truth, clock)
        with whole_folder(out, request.inputs()) as folder:
            with Sink(folder, request, recording.source, clock, corrections) as sink:
                registrar = run.register(sink, submit, shown)
            workers.close()  # their memory is free for the tables of tracks
            summary = run.write(folder, out, registrar, sink, fingerprint)
            _check_ids(request, summary.associated_tracks is not None)
            write_summary(folder, summary.as_json())
    return summary


def _rejected(request: Request) -> set[tuple[str, int]]:
    """Return ids and stamps of the boxes of a result that are rejected, where others are added."""
    if request.labels is None or not request.completes or request.convention.associate:
        return set()  # with `associate`, ids of the result are of no meaning
    from boxreg_ros.labels import frames_of  # slow, and few runs need them
    from boxreg_ros.labels.output import WITH_REJECTED

    if request.labels[0] not in WITH_REJECTED:
        return set()
    offset_ns = round(request.convention.boxes_offset * 1e9)
    return {
        (track_id, frame.refined.boxes.stamp_ns + offset_ns)
        for frame in frames_of(*request.labels)
        for track_id, word in zip(frame.refined.boxes.track_ids, frame.refined.status, strict=True)
        if word == REJECTED
    }


def _applied(request: Request) -> list[Decision]:
    """Return the decisions that the boxes of a result, as labels, have already."""
    path = request.applied_decisions()
    if path is None:
        return []
    if request.convention.associate or request.jumping_ids or request.convention.boxes_offset:
        raise ConfigError(
            f'labels {str(path.parent)!r}: expected their ids and stamps, which {path.name} is '
            f'about, got boxes to associate or to shift: decisions of a person would be lost; '
            f'relabel without --associate and --boxes-offset, and with --keep-ids, or delete '
            f'{path.name}'
        )
    return read_decisions(path)


def _decisions(request: Request, out: Path) -> list[Decision]:
    """
    Return the decisions that a request names.

    Ids of associated boxes count from the first box of a part. Raises ConfigError if the decisions
    are about other objects, or if there are none, but the result in `out` has some.

    """
    path = request.decisions
    if path is None:
        if DECISIONS in (earlier_summary(out) or {}).get(FILES, {}):
            raise ConfigError(
                f'output {str(out)!r}: expected --decisions, which the result there was made '
                f'with, got none: those of a person would be lost; choose another with -o, or '
                f'delete this one'
            )
        return []
    _check_result(request, path)
    if request.convention.associate or request.jumping_ids:
        _check_ids(request, is_associated=True)
    return read_decisions(path)


def _check_result(request: Request, path: Path) -> None:
    """Raise ConfigError for decisions on a result whose ids are of other objects here."""
    reviewed = earlier_summary(path.parent) or {}
    labels = Path() if request.labels is None else request.labels[1].resolve()
    is_beside = request.labels is not None and path.parent.resolve() in (labels, labels.parent)
    if is_beside and DECISIONS in reviewed.get(FILES, {}):
        raise ConfigError(
            f'--decisions {str(path)!r}: expected decisions about the boxes of the labels, got '
            f'those that they were made with, which would be applied twice, as to ids that have '
            f'changed; leave --decisions out, with --labels csv:{path.parent}, or --labels'
        )
    start = reviewed.get('start', request.start) or 0.0
    if ASSOCIATED in reviewed and start != (request.start or 0.0):
        raise ConfigError(
            f'--start: expected {start:g} s, as of the result that {str(path)!r} is about, got '
            f'{request.start or 0.0:g} s: its boxes are associated, and their ids depend on the '
            f'first one; relabel with the same start'
        )
    if ASSOCIATED in reviewed:
        max_gap = Config.from_yaml(path.parent / CONFIG).max_gap
        if max_gap != request.config.max_gap:
            raise ConfigError(
                f'max_gap: expected {max_gap:g} s, as of the result that {str(path)!r} is about, '
                f'got {request.config.max_gap:g} s: its boxes are associated, and their ids '
                f'depend on it; relabel with --set max_gap={max_gap:g}'
            )


def _check_ids(request: Request, is_associated: bool) -> None:
    """Raise ConfigError for decisions on ids of the input where boxes are associated, or back."""
    path = request.decisions
    if path is None:
        return
    reviewed = earlier_summary(path.parent)
    if reviewed is None and is_associated:
        raise ConfigError(
            f'decisions {str(path)!r}: expected them in the folder of the result that they are '
            f'about, got no {SUMMARY} beside them: ids of associated boxes depend on the first '
            f'box and the options of that result, which cannot be compared; put the file there'
        )
    if reviewed is None or (ASSOCIATED in reviewed) == is_associated:
        return
    remedy = 'without --associate, and with --keep-ids' if is_associated else 'with --associate'
    ids = ['those of the input', 'those of associated boxes']
    expected, got = ids if is_associated else ids[::-1]
    raise ConfigError(
        f'decisions {str(path)!r}: expected ids as of the result that they are about, {expected}, '
        f'got {got}, which name other objects; relabel {remedy}'
    )


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
