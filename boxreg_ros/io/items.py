"""The stream of decoded clouds and boxes that every source of a drive yields."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import NamedTuple, Protocol, runtime_checkable

from boxreg_ros.errors import TransformUnavailable, UnsupportedMessage
from boxreg_ros.io.lidars import SensorPlacement
from boxreg_ros.io.storage.record import Damage
from boxreg_ros.io.transforms import to_fixed_frame, TransformTree
from boxreg_ros.structures import BoxArray, Floats, RefinedBoxes, Sweep

LOOKAHEAD_NS = 2 * 10**9
"""Transforms are read this far ahead of clouds and boxes [ns]: publishers of TF are late."""


class Item(NamedTuple):
    """
    A decoded cloud or box array of a recording.

    Attributes
    ----------
    received_ns : int
        When it was received [ns].
    content : Sweep or BoxArray
        In the frame of its message.
    intensities : array, shape (M,), or None
        Of the points of a cloud; None unless asked for and recorded.
    refined : RefinedBoxes or None
        Status and covariances of boxes that come from label files; else None.

    """

    received_ns: int
    content: Sweep | BoxArray
    intensities: Floats | None = None
    refined: RefinedBoxes | None = None


Stage = Callable[[str], AbstractContextManager[object]]
"""Measures the time of a ``with`` block under the name of a stage."""


def not_measured(stage: str) -> AbstractContextManager[object]:
    """Measure nothing."""
    return nullcontext()


@runtime_checkable
class ItemSource(Protocol):
    """
    A source of clouds and boxes: bags, MCAP files of Foxglove, clouds with label files.

    Attributes
    ----------
    points_topic, boxes_topic
        Topics; `points_topic` is the first of several, `boxes_topic` is empty if the boxes are
        not from a topic.
    placement
        Topics of several LiDARs and the frames of their sensors; knows the info messages of
        concatenated clouds once these have been read.
    start_ns, end_ns
        Part that is read, in receive time [ns].
    unreadable, first_errors
        Number of messages of each topic that could not be decoded, and the first error.
    outside
        Boxes that do not belong to the part that is read.

    """

    points_topic: str
    boxes_topic: str
    placement: SensorPlacement
    start_ns: int
    end_ns: int
    unreadable: Counter[str]
    first_errors: dict[str, UnsupportedMessage]
    outside: int

    @property
    def odometry_topic(self) -> str | None:
        """Return the topic of the odometry in use."""

    @property
    def apart(self) -> dict[str, float]:
        """Return the topics that were recorded apart from the clouds, and by how much [s]."""

    @property
    def damages(self) -> list[Damage]:
        """Return the parts of the files that could not be read so far."""

    def sensor_frame(self) -> str:
        """Return the frame of the first cloud."""

    def choose_fixed_frame(self, tree: TransformTree, fixed_frame: str | None = None) -> str:
        """Return the frame to refine in; see `Recording.choose_fixed_frame`."""

    def items(
        self,
        tree: TransformTree,
        *,
        with_clouds: bool = True,
        with_intensities: bool = False,
        stage: Stage = not_measured,
    ) -> Iterator[Item]:
        """Yield clouds and boxes in order while `tree` follows; see `Recording.items`."""

    def check_readable(self) -> None:
        """Raise UnsupportedMessage if none of the clouds, or of the boxes, was readable."""


def left_out(source: ItemSource, missing_transforms: Sequence[str]) -> str:
    """
    Return how many messages of a source are not used, and why, in one line; empty if all are.

    Parameters
    ----------
    source : ItemSource
        After its last item.
    missing_transforms : sequence of str
        Errors of the messages without a transform.

    """
    parts = []
    if source.unreadable.total():
        first = next(iter(source.first_errors.values()))
        parts.append(f'{source.unreadable.total()} messages could not be read, first: {first}')
    if missing_transforms:
        parts.append(
            f'{len(missing_transforms)} messages had no transform, first: {missing_transforms[0]}'
        )
    return '; '.join(parts)


def input_boxes(
    source: AbstractContextManager[ItemSource], fixed_frame: str | None = None
) -> tuple[list[BoxArray], str]:
    """
    Return the input boxes of a recording in the fixed frame that `relabel` would choose.

    Parameters
    ----------
    source : context manager of ItemSource
        Recording that is not open yet.
    fixed_frame : str, optional
        Fixed frame to use instead.

    Returns
    -------
    arrays : list of BoxArray
        All that could be decoded and transformed.
    others : str
        Number of the others, and why; empty if there are none.

    """
    tree = TransformTree()
    arrays: list[BoxArray] = []
    missing_transforms: list[str] = []
    with source as recording:
        fixed_frame = recording.choose_fixed_frame(tree, fixed_frame)
        for item in recording.items(tree, with_clouds=False):
            try:
                moved = to_fixed_frame(item.content, tree, fixed_frame)
            except TransformUnavailable as error:
                missing_transforms.append(str(error))
                continue
            if isinstance(moved, BoxArray):
                arrays.append(moved)
        others = left_out(recording, missing_transforms)
    return arrays, others
