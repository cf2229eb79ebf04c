"""What `boxreg relabel` is asked for, refused where it cannot work."""

from __future__ import annotations

from dataclasses import dataclass, field
import hashlib
from math import isfinite
from pathlib import Path
from typing import Any

from boxreg_ros import __version__
from boxreg_ros.config import Config
from boxreg_ros.errors import ConfigError
from boxreg_ros.io.recording import Recording
from boxreg_ros.labels import check_options, module_of, Options
from boxreg_ros.offline.labelled_recording import LabelledRecording
from boxreg_ros.review.report import check_packages
from msg_adapters.convention import Convention, STANDARD


@dataclass(frozen=True, slots=True)
class Request:
    """
    What to relabel, and how.

    Attributes
    ----------
    recordings : tuple of Path
        Files or folders of one drive, merged by time.
    points, boxes, odometry : str or None
        Topics; None where the type tells.
    fixed_frame : str or None
        Frame to refine in; None for the topmost the cloud's frame moves in.
    formats : tuple of str
        Label formats beside ``csv``, which is always written.
    start, end : float or None
        Part of the recording, from its beginning [s].
    config : Config
        Settings of the core.
    options : Options
        Settings of the label formats.
    labels : tuple of str and Path, or None
        Format and files that the boxes come from instead of a topic.
    label_frame : str or None
        Frame that stands for the sensor's in label formats; None for that of the clouds.
    convention : Convention
        How the boxes are to be read.
    bridge : float
        Where a track is missing between two of its boxes that are no further apart than this,
        a box is put in [s]; 0 for nowhere.
    report : bool
        Write ``report.html`` too, for which the recording is read a second time.

    """

    recordings: tuple[Path, ...]
    points: str | None = None
    boxes: str | None = None
    odometry: str | None = None
    fixed_frame: str | None = None
    formats: tuple[str, ...] = ('csv', 'openlabel')
    start: float | None = None
    end: float | None = None
    config: Config = field(default_factory=Config)
    options: Options = field(default_factory=Options)
    labels: tuple[str, Path] | None = None
    label_frame: str | None = None
    convention: Convention = STANDARD
    bridge: float = 0.0
    report: bool = False

    def __post_init__(self) -> None:
        """Refuse what cannot work before any work is done."""
        if self.labels is not None and self.boxes is not None:
            raise ConfigError('boxes: expected a topic or label files, got both; leave one out')
        if self.labels is not None and not self.convention.is_standard:
            raise ConfigError(
                f'{self.convention}: expected for boxes of a topic, got label files; each format '
                f'has its own convention, see boxreg formats'
            )
        for name, seconds in (('start', self.start), ('end', self.end)):
            if seconds is not None and not isfinite(seconds):
                raise ConfigError(
                    f'{name}: expected seconds from the beginning, got {seconds}; leave it out '
                    f'for all of the recording'
                )
        if not 0 <= self.bridge <= self.config.max_gap:
            raise ConfigError(
                f'bridge: expected 0 to max_gap ({self.config.max_gap:g} s), after which an id is '
                f'that of another track, got {self.bridge:g}'
            )
        check_options(self.formats, self.options)
        if self.labels is not None:
            module_of(self.labels[0])
        if self.report:
            check_packages()

    def recording(self) -> Recording:
        """Return the recording, not yet open."""
        options: dict[str, Any] = {
            'points': self.points,
            'odometry': self.odometry,
            'start': self.start,
            'end': self.end,
        }
        if self.labels is not None:
            return LabelledRecording(self.labels, self.recordings, **options)
        return Recording(self.recordings, boxes=self.boxes, convention=self.convention, **options)

    @property
    def all_formats(self) -> tuple[str, ...]:
        """Return the formats to write, each once, ``csv`` first."""
        return tuple(dict.fromkeys(('csv', *self.formats)))

    def inputs(self) -> tuple[Path, ...]:
        """Return the files and folders it reads."""
        label_files = (self.labels or ())[1:]
        return (*self.recordings, *filter(None, (self.options.camera, *label_files)))

    def fingerprint(self) -> str:
        """Return a digest of the request and of the files it reads, by size and time."""
        files = [
            (str(file.resolve()), file.stat().st_size, file.stat().st_mtime_ns)
            for path in self.inputs()
            # Folders in that of a recording are no part of it; one may be that of the results.
            for deep in ['*' if path in self.recordings else '**/*']
            for file in sorted([path] if path.is_file() else path.glob(deep))
            if file.is_file()
        ]
        return hashlib.sha256(repr((__version__, self, files)).encode()).hexdigest()
