"""The stream of decoded clouds and boxes that every source of a drive yields."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple, Protocol, runtime_checkable

from boxreg_ros.errors import RecordingError, UnsupportedMessage
from boxreg_ros.io.lidars import SensorPlacement
from boxreg_ros.io.storage.record import Damage
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import BoxArray, Floats, RefinedBoxes, Sweep

LOOKAHEAD_NS = 2 * 10**9
"""Transforms are read this far ahead of clouds and boxes [ns]: publishers of TF are late."""


class Item(NamedTuple):
    """
    A decoded cloud or box array, on its way from a recording or a topic to the registrar.

    `Session` completes it; that of merged clouds has the content of the first.

    """

    received_ns: int
    """When it was received, or complete [ns]; live by a clock that never jumps."""
    content: Sweep | BoxArray
    """In the frame of its message."""
    intensities: Floats | None = None
    """(M,), of the points of a cloud; None unless asked for and recorded."""
    refined: RefinedBoxes | None = None
    """Status and covariances of boxes that come from label files."""
    message: Any = None
    """As it was received, live."""
    moved: Sweep | BoxArray | None = None
    """In the fixed frame, boxes with their ids; None before, and where no transform is known."""
    T_fixed_item: Floats | None = None
    """Maps the frame of its message to the fixed frame; None likewise, and of merged clouds."""
    reason: Reason | None = None
    """Why `moved` is None, or why not all LiDARs of a cloud are known."""
    detail: str = ''
    """The transform or message that is missing."""
    parts: tuple[Item, ...] = ()
    """Those of the clouds of several LiDARs that were merged."""
    restarts: bool = False
    """Whether time went back before it."""
    T_fixed_sensor: Floats | None = None
    """Pose of the sensor frame of label files; None if unknown, and live."""

    @property
    def received(self) -> float:
        """Return when it was received [s]."""
        return self.received_ns / 1e9


Stage = Callable[[str], AbstractContextManager[object]]
"""Measures the time of a ``with`` block under the name of a stage."""


def not_measured(stage: str) -> AbstractContextManager[object]:
    """Measure nothing."""
    return nullcontext()


class Wanted(NamedTuple):
    """What is read of a source."""

    clouds: bool = True
    """False leaves the clouds out, and saves decoding them."""
    intensities: bool = False
    """Whether the intensities of the points are decoded, too."""
    stage: Stage = not_measured
    """Measures ``read`` and ``decode``."""


EVERYTHING = Wanted()
"""But intensities, which few need."""


def requested_part(
    source: str, begin_ns: int, end_ns: int, start: float | None, end: float | None
) -> tuple[int, int]:
    """
    Return the part of a source that was asked for.

    Parameters
    ----------
    source : str
        Its name, for the error message.
    begin_ns, end_ns : int
        Of the whole source [ns].
    start, end : float or None
        Of the part, from the begin of the source [s]; None for the whole.

    Returns
    -------
    begin_ns, end_ns : int
        Of the part [ns]; its end is no later than that of the source.

    Raises
    ------
    RecordingError
        If the part is empty.

    """
    first_ns = begin_ns + round((start or 0.0) * 1e9)
    behind_ns = end_ns if end is None else min(end_ns, begin_ns + round(end * 1e9))
    if first_ns >= behind_ns:
        raise RecordingError(
            f'start and end: expected a part of the {(end_ns - begin_ns) * 1e-9:.1f} s of '
            f'{source}, got {start or 0:g} to {"the end" if end is None else f"{end:g}"}; choose '
            f'a smaller --start, or leave it out'
        )
    return first_ns, behind_ns


@runtime_checkable
class ItemSource(Protocol):
    """A source of clouds and boxes: bags, MCAP files of Foxglove, clouds with label files."""

    points_topic: str
    """The first of several."""
    boxes_topic: str
    """Empty if the boxes are not from a topic."""
    placement: SensorPlacement
    """Topics of the LiDARs and frames of their sensors; holds the info messages read so far."""
    start_ns: int
    end_ns: int
    """End of the part that is read, in receive time, as `start_ns` [ns]."""
    outside: int
    """Boxes that do not belong to the part that is read."""
    left_out: Counter[str]
    """Boxes of label files that are not used, by reason."""
    label_notes: list[str]
    """What the reader of label files assumed of them."""

    @property
    def unreadable(self) -> Counter[str]:
        """Return the number of messages that could not be decoded, by topic."""

    @property
    def first_errors(self) -> dict[str, UnsupportedMessage]:
        """Return the error of the first of them, by topic."""

    @property
    def odometry_topic(self) -> str | None:
        """Return the topic of the odometry in use."""

    @property
    def apart(self) -> dict[str, float]:
        """Return the topics that were recorded apart from the clouds, and by how much [s]."""

    @property
    def finding(self) -> str:
        """Return what is unusual about the source as a whole; empty if nothing is."""

    @property
    def damages(self) -> list[Damage]:
        """Return the parts of the files that could not be read so far."""

    def sensor_frame(self) -> str:
        """Return the frame of the first cloud."""

    def choose_fixed_frame(self, tree: TransformTree, fixed_frame: str | None = None) -> str:
        """Return the frame to refine in; see `Recording.choose_fixed_frame`."""

    def items(self, tree: TransformTree, wanted: Wanted = EVERYTHING) -> Iterator[Item]:
        """Yield clouds and boxes in order while `tree` follows; see `Recording.items`."""

    def check_readable(self) -> None:
        """Raise UnsupportedMessage if none of the clouds, or of the boxes, was readable."""
