"""``summary.json``: what a run has read, refined and left out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from importlib.metadata import version
from pathlib import Path
import platform
from typing import Any, Self, TYPE_CHECKING

from boxreg_ros import __version__
from boxreg_ros.io.lidars import CLOUD_LATE, CLOUD_MISSING
from boxreg_ros.offline.request import NO_TOPIC
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import HUMAN, REFINED

if TYPE_CHECKING:
    from boxreg_ros.core.latency import Latency
    from boxreg_ros.core.registrar import BoxRegistrar
    from boxreg_ros.offline.output import Sink
    from boxreg_ros.offline.reader import Findings, ReadAhead
    from boxreg_ros.offline.request import Request

UNUSED_PREFIXES = ('sweep_', 'boxes_')
"""Counters of the registrar with these prefixes count unused messages and not kept boxes."""
NO_BOXES = 'no boxes in {}, or in its part by --start and --end: nothing was refined'


@dataclass(slots=True)
class Summary:
    """The content of ``summary.json``."""

    recordings: list[str]
    command: list[str]  # arguments of `boxreg`; none for a run from Python
    folder: str  # that the arguments were given in
    topics: dict[str, str | None]  # of points, boxes and odometry; None where there is none
    # format and path of label files, and their boxes outside of the part
    labels: dict[str, Any] | None
    fixed_frame: str
    estimate: str
    sweeps: int  # here and below: messages that were read
    box_arrays: int
    boxes_in: int
    boxes_out: int  # added ones included
    status: dict[str, int]
    reasons: dict[str, int]  # of kept and rejected boxes, the most frequent first
    time_jumps: int
    # topics recorded apart from the clouds, and by how much [s]
    recorded_apart: dict[str, float]
    heading_flips: int
    box_time: dict[str, Any]  # estimated time and latency of the boxes
    time_ranges: dict[str, list[int]]  # first and last stamp [ns] of boxes and clouds
    unknown_classes: dict[str, int]  # boxes by class name that no group of settings has
    dropped: dict[str, int]  # messages that were not used, by reason
    without_stamp: dict[str, int]  # clouds and box arrays with the stamp 0
    damage: list[dict[str, Any]]  # parts of the files that could not be read
    lidars: dict[str, dict[str, int]]  # clouds of each of several LiDARs
    point_layouts: dict[str, str]  # of the clouds of each topic
    first_missing_transform: str  # here and below: the first error of its kind, or empty
    first_unplaced: str
    first_unreadable: str
    warning: str  # findings about the input as a whole
    ids: str  # origin of the track ids
    # boxes that a format cannot represent, by reason
    left_out_of_labels: dict[str, dict[str, int]]
    label_notes: list[str]  # what their writers assumed, and what an evaluation does not count
    unused_decisions: list[str]  # on tracks and boxes that the recording does not have
    frames_without_cloud: int
    versions: dict[str, str]  # of everything that can change the results
    associated_tracks: int | None = None  # that the association has made; None without it
    start: float | None = None  # of the part, as asked for [s]; here and below
    end: float | None = None
    # tracks and boxes that each step changed
    complete: dict[str, int] = field(default_factory=dict)
    # ends of tracks of keyframes, and why
    seeds: list[dict[str, Any]] = field(default_factory=list)
    # objects that no box covers, longest first
    proposals: list[dict[str, Any]] = field(default_factory=list)
    sweeps_with_boxes: dict[str, int] = field(default_factory=dict)  # ``before`` and ``after``
    fingerprint: str = ''  # of the request and its files
    seconds: dict[str, float] = field(default_factory=dict)  # of each stage
    # violations before and after the run
    rules: dict[str, dict[str, int]] = field(default_factory=dict)
    points: dict[str, Any] = field(default_factory=dict)  # sweeps and points by their label
    # drives it began with, and differences
    input_model: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        request: Request,
        recording: ReadAhead,
        registrar: BoxRegistrar,
        latency: Latency,
        sink: Sink,
    ) -> Self:
        """Return the summary of a written run; RuntimeError if the registrar has lost boxes."""
        if sink.missing():
            raise RuntimeError(
                f'boxes: expected all {sink.boxes_in} back from the registrar, {sink.missing()} '
                f'are missing; this is a fault of boxreg_ros: please report it'
            )
        source = recording.source
        findings = recording.findings
        lengthened = registrar.visible_boxes.warning
        return cls(
            recordings=[str(path) for path in request.recordings],
            command=list(request.command),
            folder=str(Path.cwd()),
            start=request.start,
            end=request.end,
            topics=source.topics,
            labels=_labels(request, findings),
            fixed_frame=source.fixed_frame,
            estimate=request.config.estimate,
            sweeps=findings.counts['sweeps'],
            box_arrays=findings.counts['box_arrays'],
            boxes_in=sink.boxes_in,
            boxes_out=sink.boxes_out,
            sweeps_with_boxes={'before': sink.arrays_in, 'after': sink.arrays_out},
            status=dict(sink.status),
            reasons=dict(sink.reasons.most_common()),
            time_jumps=findings.counts[Reason.TIME_JUMP],
            heading_flips=sink.heading_flips,
            box_time=registrar.box_time.summary(request.config) | {'latency': latency.summary()},
            time_ranges={name: list(ends) for name, ends in sink.time_ranges.items()},
            unknown_classes=dict(sink.unknown_classes.most_common()),
            dropped=_dropped(registrar.counts, findings),
            without_stamp=_without_stamp(findings),
            lidars={topic: dict(counts) for topic, counts in findings.lidars.items()},
            warning='; '.join(filter(None, (findings.warning, latency.warning, lengthened)))
            or ('' if sink.boxes_in or request.boxes == NO_TOPIC else _no_boxes(request)),
            **findings.facts,
            left_out_of_labels=sink.output.left_out(),
            label_notes=sink.output.notes(),
            unused_decisions=sink.corrections.unused(),
            frames_without_cloud=sink.without_cloud,
            versions=_versions(),
        )

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Self:
        """Return the summary of the same version of boxreg that a file holds."""
        return cls(**{one.name: content[one.name] for one in fields(cls) if one.name in content})

    def as_json(self) -> dict[str, Any]:
        """Return the content of the file."""
        content = asdict(self)
        if self.associated_tracks is None:
            del content['associated_tracks']
        return content

    @property
    def is_complete(self) -> bool:
        """Return whether all messages of the recording were read, with usable stamps."""
        return not (self.damage or self.without_stamp or Reason.UNREADABLE in self.dropped)

    @property
    def is_part(self) -> bool:
        """Return whether a part of the recording was asked for."""
        return (self.start, self.end) != (None, None)

    @property
    def has_failed(self) -> bool:
        """Return whether the run had boxes and refined none of them."""
        return bool(self.boxes_in) and not self.num_refined

    @property
    def num_refined(self) -> int:
        """Return the number of input boxes that were refined, by the points or by a person."""
        return sum(self.status.get(word, 0) for word in (REFINED, HUMAN))

    @property
    def part_refined(self) -> float:
        """Return the part of the input boxes that were refined; 1 without boxes."""
        return self.num_refined / self.boxes_in if self.boxes_in else 1.0


def _no_boxes(request: Request) -> str:
    """Return that the input has no boxes."""
    if request.labels is not None:
        return NO_BOXES.format(request.labels[1])
    no_boxes = NO_BOXES.format('the input')
    return f'{no_boxes} (of a MarkerArray, markers of the type CUBE are boxes)'


def _labels(request: Request, findings: Findings) -> dict[str, Any] | None:
    """Return the label files that the boxes come from; None for boxes of the recording."""
    left_out = dict(findings.left_out)
    if request.labels is None:
        return {'left_out': left_out} if left_out else None  # annotations of a data set
    name, path = request.labels
    return {
        'format': name,
        'path': str(path),
        'boxes_outside_part': findings.outside,
        'left_out': left_out,
    }


def _dropped(registered: Counter[str], findings: Findings) -> dict[str, int]:
    """Return the number of messages that were not used, by reason."""
    counts = {
        name: count for name, count in registered.items() if name.startswith(UNUSED_PREFIXES)
    }
    for name in (
        Reason.SWEEP_WITHOUT_TRANSFORM,
        Reason.SENSOR_WITHOUT_TRANSFORM,
        Reason.CLOUD_WITHOUT_INFO,
    ):
        counts[name] = findings.counts[name]
    for lidar in findings.lidars.values():
        for name in (CLOUD_LATE, CLOUD_MISSING):
            counts[name] = counts.get(name, 0) + lidar[name]
    counts[Reason.UNREADABLE] = findings.unreadable
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
