"""
Messages from the live node to the recorder, a process of its own that writes the label files.

The node starts ``python -m boxreg_ros.recorder.main`` and writes pickled objects of these classes
to its standard input: `RecorderSettings` first, the end of the input last. The recorder writes
`RecorderStatus` to its standard output, one JSON object per line.

"""

from __future__ import annotations

from dataclasses import asdict, dataclass
import json
import re
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.errors import ConfigError
from boxreg_ros.structures import Floats, RefinedBoxes, Sweep

PROGRAM = 'boxreg_ros.recorder.main'
"""Module that the node runs; it is named here because the node does not import it."""
UNITS = {'s': 1.0, 'min': 60.0, 'h': 3600.0, 'MB': 1e6, 'GB': 1e9}
SIZE_UNITS = ('MB', 'GB')


class RecorderSettings(NamedTuple):
    """Settings of one recording of labels."""

    folder: str
    """Absolute path of the folder of the segments."""
    formats: tuple[str, ...]
    """Label formats; ``csv`` is always written."""
    with_points: bool
    """Also write the clouds."""
    segment: str
    """Length of a segment: a number with the unit s, min, h, MB or GB."""
    camera: str
    """Path of a calibration file, for formats in a camera frame; empty for none."""
    config: Config


class LabelCloud(NamedTuple):
    """A cloud that label files may need."""

    sweep: Sweep
    """In the frame of the sensor."""
    T_fixed_sweep: Floats
    """Pose (4, 4) of that frame at the stamp."""
    intensities: Floats | None
    """(M,), None if the cloud has none."""
    needed_from_ns: int
    """No further boxes have a smaller stamp [ns], except those that are late."""


class FinalBoxes(NamedTuple):
    """Final boxes of one array, in the order of stamps; attributes as of `labels.LabelFrame`."""

    refined: RefinedBoxes
    fixed_frame: str
    sensor_frame: str
    T_fixed_sensor: Floats | None
    T_fixed_given: Floats | None


class Split(NamedTuple):
    """End the open segment; the next boxes start another."""


class Tick(NamedTuple):
    """Nothing to write; sent once a second, so that the status stays up to date."""


@dataclass(frozen=True, slots=True)
class RecorderStatus:
    """State of the recorder; counts are since its start."""

    segment: str = ''
    """The open one; empty while there is none."""
    segments: int = 0
    """Completed."""
    frames: int = 0
    boxes: int = 0
    clouds: int = 0
    size: int = 0
    """Of the label files written [bytes]."""
    rate: float = 0.0
    """Growth of these files over the last seconds [bytes/s]."""
    free: int = 0
    """Room on the disk [bytes]."""
    recovered: int = 0
    """Segments recovered from the journals of earlier recordings."""
    damaged: int = 0
    """Segments of earlier recordings whose journal cannot be read; their folder is kept."""
    without_cloud: int = 0
    """Frames without a cloud, where clouds are written."""
    left_out: int = 0
    """Boxes that a format cannot represent, summed over formats."""
    error: str = ''
    """Why the recording ended."""

    def line(self) -> str:
        """Return the status as a line of JSON."""
        return json.dumps(asdict(self)) + '\n'

    @property
    def seconds_left(self) -> float | None:
        """Return for how long the disk has room at this rate [s]; None while it is unknown."""
        return self.free / self.rate if self.rate > 0 else None


def segment_limit(text: str) -> tuple[float, bool]:
    """Return the length of a segment [s or bytes], and whether it is in bytes, or ConfigError."""
    found = re.fullmatch(r'\s*(\d+(?:\.\d+)?)\s*([a-zA-Z]+)\s*', text)
    if found is None or found[2] not in UNITS or float(found[1]) <= 0:
        raise ConfigError(
            f'record_segment: expected a positive number with one of the units '
            f'{", ".join(UNITS)}, got {text!r}; write for example 60 s or 2 GB'
        )
    return float(found[1]) * UNITS[found[2]], found[2] in SIZE_UNITS
