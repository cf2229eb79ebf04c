"""The protocol of the rules, and the labels that they read."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, TYPE_CHECKING

from boxreg_ros.config import Config
from boxreg_ros.structures import BOX_CENTER, Floats, Ints, is_valid_box
import numpy as np

if TYPE_CHECKING:
    from boxreg_ros.review.rules.pairs import Labels

ERROR = 'error'
WARNING = 'warning'
VEHICLE, CYCLIST, PEDESTRIAN = 'vehicle', 'cyclist', 'pedestrian'
MAX_STEP = 1.0
"""Rates of change are not computed across longer gaps [s]."""


@dataclass(frozen=True, slots=True)
class LabelTrack:
    """
    The valid labels of one track, by stamp.

    Attributes
    ----------
    track_id, class_name : str
        Identity and category.
    kind : str
        Group of settings of the class: vehicle, cyclist or pedestrian.
    stamps_ns : array, shape (n,)
        Stamps [ns]; one may occur twice.
    boxes : array, shape (n, 9)
        In one fixed frame [m, rad].
    num_points : array, shape (n,)
        Points in each box; -1 where unknown.

    """

    track_id: str
    class_name: str
    kind: str
    stamps_ns: Ints
    boxes: Floats
    num_points: Ints

    @classmethod
    def of(
        cls,
        track_id: str,
        class_name: str,
        config: Config,
        stamps_ns: Ints,
        boxes: Floats,
        num_points: Ints,
    ) -> LabelTrack:
        """Return the track of labels in any order, without invalid boxes."""
        group = config.class_config(class_name)
        kind = VEHICLE
        if group is config.cyclist:
            kind = CYCLIST
        elif group is config.pedestrian:
            kind = PEDESTRIAN
        rows = np.flatnonzero(is_valid_box(boxes))
        rows = rows[np.argsort(stamps_ns[rows], kind='stable')]
        columns = stamps_ns[rows], boxes[rows], num_points[rows]
        return cls(track_id, class_name, kind, *columns)

    def steps(self) -> Steps:
        """Return the steps between consecutive boxes, without those across gaps."""
        seconds = np.diff(self.stamps_ns) * 1e-9
        rows = np.flatnonzero((seconds > 0) & (seconds <= MAX_STEP))
        velocity = np.diff(self.boxes[:, BOX_CENTER], axis=0)[rows] / seconds[rows, None]
        return Steps(rows, seconds[rows], velocity)


class Steps(NamedTuple):
    """
    Steps between consecutive boxes of a track.

    Attributes
    ----------
    rows : array, shape (k,)
        Row of the box before each step.
    seconds : array, shape (k,)
        Duration [s].
    velocity : array, shape (k, 3)
        Of the centre in the fixed frame [m/s].

    """

    rows: Ints
    seconds: Floats
    velocity: Floats


class Violation(NamedTuple):
    """
    A place where labels violate a rule.

    Attributes
    ----------
    track_id : str
        The track.
    stamp_ns : int
        The stamp [ns].
    text : str
        What was found, with its figures.

    """

    track_id: str
    stamp_ns: int
    text: str


class Rule(NamedTuple):
    """
    A rule that labels should keep.

    Attributes
    ----------
    rule_id, severity : str
        Name, and `ERROR` or `WARNING`.
    meaning, remedy : str
        What is wrong, and what to do.
    find : callable
        Yields the violations of tracks; at most one per track and kind of finding.

    """

    rule_id: str
    severity: str
    meaning: str
    remedy: str
    find: Callable[[Labels], Iterator[Violation]]
