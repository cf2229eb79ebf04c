"""
The part of a run in the main process, beside those that read and estimate.

It is imported once the reader is forked: numba takes half a second, while the recording is opened.

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from shutil import copyfile

from boxreg_ros.core.input_statistics import Drives, to_text
from boxreg_ros.core.latency import Latency
from boxreg_ros.core.matching import Pair
from boxreg_ros.core.registrar import BoxRegistrar, Submit
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.input_models import disagreements
from boxreg_ros.io.session import hand_to_registrar
from boxreg_ros.offline.notes import closing_line, doubts_line
from boxreg_ros.offline.output import Sink
from boxreg_ros.offline.products import (
    checked,
    completed_counts,
    fitting_truth,
    write_proposals,
    write_track_tables,
)
from boxreg_ros.offline.progress import Stopwatch
from boxreg_ros.offline.reader import ReadAhead
from boxreg_ros.offline.request import NO_TOPIC, Request
from boxreg_ros.offline.result_folder import CONFIG, INPUT_MODEL
from boxreg_ros.offline.stored_sweeps import StoredSweeps
from boxreg_ros.offline.summary import Summary
from boxreg_ros.offline.survey import Passes, Survey
from boxreg_ros.review.decisions import APPLIED, DecisionLog, DECISIONS
from boxreg_ros.review.rules import Violation
from boxreg_ros.review.tables import TrackRow
from boxreg_ros.structures import BoxArray
import yaml


@dataclass(frozen=True, slots=True)
class MainProcess:
    """
    Take the items of a recording to the registrar, and its boxes to a folder of results.

    `first` is what a first pass has found, None without; `sweeps` stores all sweeps, where points
    are labelled; `truth` are true boxes that the report shows.

    """

    request: Request
    recording: ReadAhead
    drives: Drives
    first: Survey | None
    sweeps: StoredSweeps | None
    truth: BoxTable | None
    clock: Stopwatch

    def register(self, sink: Sink, submit: Submit | None, progress: Passes) -> BoxRegistrar:
        """
        Register the boxes of the recording, with those of the first pass, and write them.

            item --> sink: ticket --> registrar --> (completion) --> sink: label files

        """
        first = self.first
        registrar = BoxRegistrar(
            self.request.config,
            submit,
            drives=self.drives,
            constants=None if first is None else first.constants,
            latency=self._known_latency(),
            prepare=partial(self._to_register, sink),
        )
        items = progress.each(self.recording)
        take = sink.take
        if first is not None:
            items = first.completed(items, self.recording.source.fixed_frame)
            take = first.completion.add  # completed tracks wait for the end of the recording
        for item in items:
            moved, reason = sink.expect(item)
            if first is not None and isinstance(moved, BoxArray) and not reason:
                first.completion.expect(moved.ticket)
            with self.clock('registrar'):
                ready = hand_to_registrar(registrar, moved, item.restarts, reason)
            take(ready)
        with self.clock('registrar'):
            ready = registrar.flush()
        take(ready)
        if first is not None:
            sink.take(first.completion.finished())
        return registrar

    def write(
        self, folder: Path, out: Path, registrar: BoxRegistrar, sink: Sink, fingerprint: str
    ) -> Summary:
        """Write everything beside the labels into `folder`, which becomes `out`."""
        summary = self._summary(registrar, sink)
        summary.fingerprint = fingerprint
        corrections = sink.corrections
        applied = corrections.applied()
        doubts = [*self.request.doubts_on_decisions(), *corrections.doubts(summary.is_part)]
        warnings = summary.warning, self.request.unbound_text(), doubts_line(doubts)
        summary.warning = '; '.join(filter(None, warnings))
        if self.sweeps is not None:
            self.sweeps.places = self.recording.findings.places
            self._write_points(folder, sink, registrar, self.sweeps, summary)
        rows, violated = self._write_tables(folder, sink, summary)
        if sink.points is not None:
            from boxreg_ros.review.report import write_report

            sink.points.settle(registrar.box_time.resolved(self.request.config))
            with self.clock('report'):
                tracks = [row.track for row in rows]
                truth = fitting_truth(self.truth, self.request.truth, tracks, summary)
                write_report(
                    folder, closing_line(summary, out), summary.as_json(), self.request.config,
                    rows, violated, sink.points, truth,
                )  # fmt: skip
            summary.seconds = self.clock.seconds()
        self._write_input_model(folder, registrar, summary)
        if self.request.decisions is not None:
            copyfile(self.request.decisions, folder / DECISIONS)  # a review goes on from there
        if applied:
            DecisionLog(folder / APPLIED).append(applied)
        settings = yaml.safe_dump(asdict(self.request.config), sort_keys=False)
        (folder / CONFIG).write_text(settings, encoding='utf-8')
        return summary

    def _known_latency(self) -> Latency | None:
        """Return the latency of the boxes that are read: none once they have been corrected."""
        is_in_time = self.first is not None and self.first.in_time is not None
        return Latency() if self.request.keyframes or is_in_time else None

    def _to_register(self, sink: Sink, pair: Pair) -> BoxArray:
        """Return boxes for the registrar: as decided, with those that the plan adds."""
        given = sink.to_register(pair.boxes, pair.sweep)
        if self.first is None:
            return given
        completion = self.first.completion
        boxes = completion.to_register(given, pair.sweep)
        if sink.points is not None:
            sink.points.gather(completion.added_boxes(given), pair.sweep)
        return boxes

    def _summary(self, registrar: BoxRegistrar, sink: Sink) -> Summary:
        """Return the summary of the labels."""
        latency = registrar.latency
        if self.first is not None and self.first.latency is not None:
            latency = self.first.latency
        summary = Summary.of(self.request, self.recording, registrar, latency, sink)
        if self.first is not None:
            summary.complete = completed_counts(self.first.plan)
            summary.seeds = self.first.ends
        for stage, seconds in self.recording.findings.seconds.items():
            self.clock.add(stage, seconds)
        return summary

    def _write_points(
        self,
        folder: Path,
        sink: Sink,
        registrar: BoxRegistrar,
        sweeps: StoredSweeps,
        summary: Summary,
    ) -> None:
        """Look for objects without a box, and label the points, by the boxes of all tracks."""
        from boxreg_ros.offline.point_products import object_tracks, PointProducts  # few need it

        request, clock, frame = self.request, self.clock, summary.fixed_frame
        tracks = sink.changes.tracks()
        with clock('points'):
            labeller = registrar.labeller(object_tracks(tracks), sink.array_stamps_ns)
        if request.proposals:
            with clock('proposals'):
                summary.proposals = write_proposals(folder, sweeps, labeller, frame)
        if request.needs_point_labels:
            if request.boxes == NO_TOPIC and not tracks:  # nothing states what is there
                labeller = registrar.labeller((), ())
            with clock('points'):
                summary.points = PointProducts(folder, request, sweeps, labeller, frame).write()

    def _write_tables(
        self, folder: Path, sink: Sink, summary: Summary
    ) -> tuple[list[TrackRow], Mapping[str, Sequence[Violation]]]:
        """Write the tables of tracks; return their rows, and the rules that labels violate."""
        tracks = sink.changes.tracks()
        plan = None if self.first is None else self.first.plan
        with self.clock('write'):
            rows = write_track_tables(folder, tracks, plan, summary.proposals)
            summary.rules, violated = checked(tracks, self.request.config)
        summary.seconds = self.clock.seconds()
        return rows, violated

    def _write_input_model(self, folder: Path, registrar: BoxRegistrar, summary: Summary) -> None:
        """Write what the drive has shown of its detector, and note where drives differ."""
        taught = registrar.statistics(self.request.drive_name())
        (folder / INPUT_MODEL).write_text(to_text(taught), encoding='utf-8')
        summary.input_model = {
            'drives': len(self.drives),
            'warning': '; '.join(disagreements({**self.drives, **taught})),
        }
