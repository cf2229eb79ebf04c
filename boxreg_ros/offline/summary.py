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
    from boxreg_ros.core.registrar import BoxRegistrar
    from boxreg_ros.offline.output import Sink
    from boxreg_ros.offline.reader import Findings, ReadAhead
    from boxreg_ros.offline.request import Request

UNUSED_PREFIXES = ('sweep_', 'boxes_')
"""Counters of the registrar with these prefixes count unused messages and not kept boxes."""
NO_BOXES = 'no boxes in this part of the recording: nothing was refined; see --start and --end'


@dataclass(slots=True)
class Summary:
    """
    The content of ``summary.json``.

    Attributes
    ----------
    recordings : list of str
        Paths.
    command, folder : list of str, and str
        Arguments of `boxreg` that made the result, and the folder they were given in; no
        arguments for a run from Python.
    topics : dict
        Topics of points, boxes and odometry; None where there is none.
    labels : dict or None
        Format and path of the label files that the boxes come from, and their boxes outside of
        the part that was read; None for boxes of the recording.
    fixed_frame, estimate : str
        Frame of the results, and setting.
    sweeps, box_arrays : int
        Messages that were read.
    boxes_in, boxes_out : int
        Boxes of the input, and boxes written, added ones included.
    status, reasons : dict
        Boxes by status, and kept and rejected ones by reason, the most frequent first.
    time_jumps, heading_flips, frames_without_cloud : int
        Their numbers.
    recorded_apart : dict
        Topics that were recorded apart from the clouds, and by how much [s].
    box_time : dict
        Estimated time and latency of the boxes.
    time_ranges : dict
        First and last stamp [ns] of boxes and clouds.
    unknown_classes : dict
        Boxes by class name that no group of settings has.
    dropped, without_stamp : dict
        Messages that were not used by reason, and clouds and box arrays with the stamp 0.
    damage : list of dict
        Parts of the files that could not be read.
    lidars, point_layouts : dict
        Clouds of each of several LiDARs, and layout of the clouds of each topic.
    first_missing_transform, first_unplaced, first_unreadable : str
        The first error of its kind; empty without one.
    warning : str
        Findings about the input as a whole.
    ids : str
        Origin of the track ids.
    associated_tracks : int or None
        Tracks that the association has made; None without it.
    left_out_of_labels : dict
        Boxes that a format cannot represent, by format and reason.
    unused_decisions : list of str
        Tracks and boxes with a decision that the recording does not have.
    versions : dict
        Of everything that can change the results.
    complete : dict
        Tracks and boxes that each step of completion changed; empty without steps.
    seeds : list of dict
        Where each track of keyframes ends in both directions and why, and keyframes that could
        not be used; empty without keyframes.
    proposals : list of dict
        Objects that no box covers, longest first; empty where they are not looked for.
    sweeps_with_boxes : dict
        Sweeps with a box ``before`` and ``after`` the run.
    fingerprint : str
        Of the request and its files.
    seconds : dict
        Time of each stage [s].
    rules : dict
        Violations of each rule before and after the run.
    points : dict
        Sweeps and points by their label; empty where points are not labelled.
    input_model : dict
        Drives that the input model began with, and where drives of it differ.

    """

    recordings: list[str]
    command: list[str]
    folder: str
    topics: dict[str, str | None]
    labels: dict[str, Any] | None
    fixed_frame: str
    estimate: str
    sweeps: int
    box_arrays: int
    boxes_in: int
    boxes_out: int
    status: dict[str, int]
    reasons: dict[str, int]
    time_jumps: int
    recorded_apart: dict[str, float]
    heading_flips: int
    box_time: dict[str, Any]
    time_ranges: dict[str, list[int]]
    unknown_classes: dict[str, int]
    dropped: dict[str, int]
    without_stamp: dict[str, int]
    damage: list[dict[str, Any]]
    lidars: dict[str, dict[str, int]]
    point_layouts: dict[str, str]
    first_missing_transform: str
    first_unplaced: str
    first_unreadable: str
    warning: str
    ids: str
    left_out_of_labels: dict[str, dict[str, int]]
    unused_decisions: list[str]
    frames_without_cloud: int
    versions: dict[str, str]
    associated_tracks: int | None = None
    complete: dict[str, int] = field(default_factory=dict)
    seeds: list[dict[str, Any]] = field(default_factory=list)
    proposals: list[dict[str, Any]] = field(default_factory=list)
    sweeps_with_boxes: dict[str, int] = field(default_factory=dict)
    fingerprint: str = ''
    seconds: dict[str, float] = field(default_factory=dict)
    rules: dict[str, dict[str, int]] = field(default_factory=dict)
    points: dict[str, Any] = field(default_factory=dict)
    input_model: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(
        cls, request: Request, recording: ReadAhead, registrar: BoxRegistrar, sink: Sink
    ) -> Self:
        """
        Return the summary of a run whose boxes are written.

        Raises
        ------
        RuntimeError
            If the registrar has not returned all boxes.

        """
        if sink.missing():
            raise RuntimeError(
                f'boxes: expected all {sink.boxes_in} back from the registrar, {sink.missing()} '
                f'are missing; this is a fault of boxreg_ros: please report it'
            )
        source = recording.source
        findings = recording.findings
        return cls(
            recordings=[str(path) for path in request.recordings],
            command=list(request.command),
            folder=str(Path.cwd()),
            topics=source.topics,
            labels=_labels(request, findings.outside),
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
            recorded_apart={topic: round(late, 3) for topic, late in findings.apart.items()},
            heading_flips=sink.heading_flips,
            box_time=registrar.box_time.summary(request.config)
            | {'latency': source.latency.summary()},
            time_ranges={name: list(ends) for name, ends in sink.time_ranges.items()},
            unknown_classes=dict(sink.unknown_classes.most_common()),
            dropped=_dropped(registrar.counts, findings),
            without_stamp=_without_stamp(findings),
            damage=[damage._asdict() for damage in findings.damages],
            lidars={topic: dict(counts) for topic, counts in findings.lidars.items()},
            point_layouts=findings.point_layouts,
            first_missing_transform=findings.first_missing_transform,
            first_unplaced=findings.first_unplaced,
            first_unreadable=findings.first_unreadable,
            warning='; '.join(filter(None, (findings.warning, source.latency.warning)))
            or ('' if sink.boxes_in or request.boxes == NO_TOPIC else NO_BOXES),
            **findings.facts,
            left_out_of_labels=sink.left_out(),
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
