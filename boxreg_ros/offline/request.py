"""Inputs and options of one `boxreg relabel` run, checked before any work is done."""

from __future__ import annotations

from argparse import ArgumentTypeError
from dataclasses import dataclass, field
import hashlib
from math import isfinite
from pathlib import Path

from boxreg_ros import __version__
from boxreg_ros.config import Config
from boxreg_ros.errors import ConfigError, require_packages
from boxreg_ros.io.lidars import Lidars, SINGLE_LIDAR
from boxreg_ros.io.storage.urls import entries_of, url_of
from boxreg_ros.labels import check_options, files_of, labels_points, module_of, Options
from boxreg_ros.offline.result_folder import earlier_summary, has_changed
from boxreg_ros.options import option
from boxreg_ros.review.decisions import (
    APPLIED,
    contradictions,
    DECISIONS,
    joined_files,
    read_decisions,
)
from msg_adapters.convention import Convention, STANDARD

NO_TOPIC = 'none'
"""In place of a topic of boxes: the drive has no boxes."""
REPORT_PACKAGES = ('jinja2', 'plotly')
"""Of ``--report``; a plain installation lacks them."""
POINT_FORMATS = ('semantickitti', 'lidarseg')
"""Formats that ``--label-points`` writes."""


def _labels(text: str) -> tuple[str, Path]:
    """Return format and path of ``FORMAT:PATH``."""
    name, colon, path = text.partition(':')
    if not name or not colon or not path:
        raise ArgumentTypeError(f'expected FORMAT:PATH, got {text!r}')
    return name, Path(path)


def _names(text: str) -> tuple[str, ...]:
    """Return the names of a list with commas."""
    return tuple(name.strip() for name in text.split(','))


@dataclass(frozen=True, slots=True)
class Request:
    """Inputs and options of one run, stated by the fields; ConfigError if they cannot work."""

    recordings: tuple[Path, ...]  # one drive, merged by time, or a scene of a data set
    lidars: Lidars = SINGLE_LIDAR
    boxes: str | None = option(
        None,
        'topic of the boxes, or none for a drive without boxes, whose objects a person adds '
        '(default: found by type)',
        metavar='TOPIC',
    )
    odometry: str | None = option(
        None,
        'odometry topic, used in place of TF (default: found by type, and used where TF does not '
        'connect the clouds with a fixed frame)',
        metavar='TOPIC',
    )
    tf: tuple[str, ...] = option(
        (),
        'topic of transforms, with the static ones of its namespace, where several robots state '
        'the same frames (default: all, or those of the namespace of the clouds); can be repeated',
        metavar='TOPIC',
        is_repeated=True,
    )
    clock_offset: float = option(
        0.0,
        'added to the stamps of TF and odometry, where their clock is behind that of the clouds '
        '[s]; boxreg inspect estimates it',
        metavar='S',
        parse=float,
    )
    convention: Convention = STANDARD
    keep_ids: bool = option(
        False,
        'take the track ids of a topic as they are, even where they do not identify objects; '
        'by default boxes are then associated, as with --associate',
    )
    labels: tuple[str, Path] | None = option(
        None,
        'read the boxes from label files instead of a topic',
        metavar='FORMAT:PATH',
        parse=_labels,
        text=lambda labels: ':'.join(map(str, labels)),
    )
    keyframes: bool = option(
        False,
        "the boxes are a person's, at some sweeps only: none is rejected or renamed, and each "
        'object gets a box at every sweep, beyond its first and last keyframe as long as points '
        'support it',
    )
    fixed_frame: str | None = option(
        None,
        'frame to refine in (default: topmost frame that the frame of the clouds moves in)',
        metavar='FRAME',
    )
    start: float | None = option(
        None,
        'start of the part to refine, from the beginning of the recording [s]',
        metavar='S',
        parse=float,
    )
    end: float | None = option(
        None,
        'end of the part to refine, from the beginning of the recording [s]',
        metavar='S',
        parse=float,
    )
    config: Config = field(default_factory=Config)
    decisions: Path | None = option(
        None,
        'decisions.csv of boxreg review: split, join, rename and delete tracks, keep rejected '
        'ones as input, hold pinned boxes',
        metavar='FILE',
        parse=Path,
    )
    input_model: tuple[Path, ...] = option(
        (),
        'input_model.json of another drive of the same detector, to begin with what it has shown '
        'of its errors; can be repeated',
        metavar='FILE',
        parse=Path,
        text=str,
        is_repeated=True,
    )
    formats: tuple[str, ...] = option(
        ('csv', 'openlabel'),
        'label formats to write, see `boxreg formats`; csv is always written',
        metavar='NAME,...',
        parse=_names,
        text=','.join,
    )
    options: Options = field(default_factory=Options)
    label_frame: str | None = option(
        None, 'sensor frame of the label files (default: frame of the clouds)', metavar='FRAME'
    )
    report: bool = option(
        False, 'also write report.html: every track before and after, to look at in a browser'
    )
    label_points: bool = option(
        False,
        'also label the points of every sweep: formats semantickitti and lidarseg, and fields of '
        'the clouds of the format mcap',
    )
    clouds: tuple[str, ...] = option(
        (),
        'also write clouds to OUT/clouds: static (MCAP and map without moving objects), '
        'background (without any) or object (each track accumulated in its box); can be repeated',
        choices=('static', 'background', 'object'),
        is_repeated=True,
    )
    undistort: bool = option(
        False,
        'also write OUT/clouds/undistorted.mcap: points of moving objects moved to the stamp by '
        'the motion of their boxes',
    )
    proposals: bool = option(
        False,
        'also look for objects that no box covers; they are listed in review.csv and the report, '
        'and written to OUT/proposals.csv for boxreg follow',
    )
    truth: Path | None = option(
        None,
        'with --report, true boxes that it shows: CSV with the columns of boxes.csv, or a scene '
        'of a data set',
        metavar='FILE',
        parse=Path,
    )

    # Why boxes are associated that nobody has asked to be; found by reading them
    jumping_ids: str = field(default='', repr=False, compare=False)
    # arguments of `boxreg`, if these made it
    command: tuple[str, ...] = field(default=(), repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the options."""
        self._check_recordings()
        self._check_boxes()
        self._check_part()
        if self.keyframes and self.config.complete.steps:
            raise ConfigError(
                f'keyframes: expected without steps of --complete, got '
                f'{", ".join(self.config.complete.steps)}; leave them out: keyframes are neither '
                f'joined nor rejected, and missing boxes are followed through the points'
            )
        check_options(self.box_formats, self.options)
        if self.report:
            require_packages('--report', REPORT_PACKAGES)

    def _check_recordings(self) -> None:
        """Refuse a recording that is named twice: its boxes would be refined twice."""
        known: dict[Path, Path] = {}
        for path in self.recordings:
            other = known.setdefault(path.resolve(), path)
            if other is not path:
                raise ConfigError(
                    f'recordings: expected each recording once, got {str(other)!r} and '
                    f'{str(path)!r}, which are the same; leave one out'
                )

    def _check_boxes(self) -> None:
        """Check where the boxes come from."""
        if self.labels is None:
            return
        if self.boxes is not None:
            raise ConfigError(
                'boxes: expected either a topic (--boxes) or label files (--labels), got both; '
                'leave one out'
            )
        module_of(self.labels[0])  # refuses an unknown format

    def _check_part(self) -> None:
        """Check `start` and `end` as far as that is possible without the recording."""
        for name, seconds in (('start', self.start), ('end', self.end)):
            if seconds is not None and not (isfinite(seconds) and seconds >= 0):
                raise ConfigError(
                    f'{name}: expected seconds from the beginning of the recording, 0 or more, '
                    f'got {seconds:g}; leave --{name} out to read to that end of the recording'
                )
        start = self.start or 0.0
        if self.end is not None and self.end <= start:
            raise ConfigError(
                f'end: expected more than start ({start:g} s), got {self.end:g}; choose a larger '
                f'--end or a smaller --start'
            )

    @property
    def box_formats(self) -> tuple[str, ...]:
        """Return the formats that are written while boxes are refined."""
        return tuple(name for name in self.formats if not labels_points(name))

    @property
    def point_formats(self) -> tuple[str, ...]:
        """Return the formats of labelled points, each once."""
        asked = POINT_FORMATS if self.label_points else ()
        named = (name for name in self.formats if labels_points(name))
        return tuple(dict.fromkeys((*asked, *named)))

    @property
    def maps(self) -> tuple[str, ...]:
        """Return the kinds of clouds without objects, each once."""
        return tuple(dict.fromkeys(name for name in self.clouds if name != 'object'))

    @property
    def cloud_copies(self) -> tuple[str, ...]:
        """Return the kinds of copies of the recording whose clouds are edited."""
        is_labelled = self.label_points and 'mcap' in self.formats
        return (*('overlay',) * is_labelled, *self.maps, *('undistorted',) * self.undistort)

    @property
    def needs_point_labels(self) -> bool:
        """Return whether the points are labelled."""
        return bool(self.point_formats or self.clouds or self.undistort)

    @property
    def needs_sweeps(self) -> bool:
        """Return whether all sweeps are stored until the boxes of all tracks are known."""
        return self.proposals or self.needs_point_labels

    @property
    def completes(self) -> bool:
        """Return whether boxes are added: the recording is read twice."""
        return self.keyframes or bool(self.config.complete.steps)

    def inputs(self) -> tuple[Path, ...]:
        """Return the input files and folders."""
        paths = [part for path in self.recordings for part in _parts_of(path)]
        of_formats = (self.options.camera, self.options.class_map)  # the camera may be a topic
        paths += [path for path in of_formats if path is not None and path.is_file()]
        if self.labels is not None:
            paths.append(files_of(*self.labels))
            applied = self.applied_decisions()
            paths += [] if applied is None else [applied]
        if self.truth is not None:
            paths += _parts_of(self.truth)
        if self.decisions is not None:
            paths.append(self.decisions)
        return (*paths, *self.input_model)

    def applied_decisions(self) -> Path | None:
        """Return the file of decisions that the labels have already; None without one."""
        if self.labels is None or self.labels[0] != 'csv':
            return None
        path = self.labels[1]
        path = (path if path.is_dir() else path.parent) / APPLIED
        return path if path.is_file() else None

    def doubts_on_decisions(self) -> list[str]:
        """Return why decisions may not be what a person wants here, in words."""
        if self.decisions is None:
            return []
        found = []
        reviewed = (earlier_summary(self.decisions.parent) or {}).get('recordings', ())
        others = [Path(path).name for path in reviewed]
        own = [path.name for path in self.recordings]
        if others and not {*others} & {*own}:
            found.append(
                f'they were made on {", ".join(others)}, whose ids may be of other objects than '
                f'those of {", ".join(own)}'
            )
        differences = contradictions(joined_files(self.decisions))
        return found + [
            f'joined files differ about {each}: the last holds' for each in differences
        ]

    def unbound_text(self, refines: bool = True) -> str:
        """
        Return that decisions of a person beside the labels do not bind; '' for none.

        Parameters
        ----------
        refines : bool
            Whether the run refines boxes.

        """
        if self.labels is None or self.decisions is not None:
            return ''
        name, path = self.labels
        folders = path.absolute().parents[:2]
        if name == 'csv':
            folders = (path if path.is_dir() else path.parent,)
        for folder in folders:
            if has_changed(folder / DECISIONS):
                return (
                    f'labels {str(path)!r}: they do not have all decisions of '
                    f'{folder / DECISIONS}, which is newer: write the labels first (boxreg review '
                    f'{folder}, Ctrl-S) and use these, or relabel the recording with '
                    f'--decisions {folder / DECISIONS}'
                )
        files = [folder / each for folder in folders for each in (APPLIED, DECISIONS)]
        found = next((file for file in files if file.is_file()), None)
        if found is None or name == 'csv':
            return ''
        if not self.completes and not (refines and _has_rejected(found)):
            return ''
        return (
            f'labels {str(path)!r}: {found.name} beside them is about boxes.csv alone: boxes '
            f'that a person rejected are refined again, classes and ids that a person gave may '
            f'change, and deleted boxes be added again; use --labels csv:{found.parent}, or '
            f'relabel the recording with --decisions'
        )

    def drive_name(self) -> str:
        """Return a name of the drive: a hash of the names and sizes of its recordings."""
        names = [path.name for path in self.recordings]
        parts = [part for recording in self.recordings for part in _parts_of(recording)]
        files = [(one.path.name, one.size) for part in parts for one in entries_of(part)]
        return hashlib.sha256(repr((names, files, self.start, self.end)).encode()).hexdigest()[:16]

    def fingerprint(self) -> str:
        """Return a hash of the request and of its input files, by size and modification time."""
        files = []
        for path in self.inputs():
            # Subfolders of a recording are not part of it; one may hold the results.
            for one in entries_of(path, is_deep=path not in self.recordings):
                place = one.path if url_of(path) is not None else one.path.resolve()
                files.append((str(place), one.size, one.version))
        return hashlib.sha256(repr((__version__, self, files)).encode()).hexdigest()


def _has_rejected(decisions: Path) -> bool:
    """Return whether decisions about a result reject refined boxes, which its labels have not."""
    if decisions.name != APPLIED:
        return False
    return any(one.kind == 'reject' for one in read_decisions(decisions))


def _parts_of(path: Path) -> tuple[Path, ...]:
    """Return the files and folders of a path: those of a scene, or the path itself."""
    from boxreg_ros.datasets.registry import address_of, scene_inputs  # imports rosbags

    address = address_of(path)
    return (path,) if address is None else scene_inputs(address)
