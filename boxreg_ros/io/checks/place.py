"""Check of where boxes are: in another frame, mirrored, on their backs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from boxreg_ros.io.checks.finding import advice
from boxreg_ros.io.checks.pose import PairedCheck, points_around
from boxreg_ros.io.checks.size import coverage
from boxreg_ros.io.transforms import boxes_to_frame, inverse, moved_boxes
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import (
    BOX_CENTER,
    BOX_EXTENT,
    BoxArray,
    Floats,
    is_valid_box,
    ROLL,
    Sweep,
    YAW,
)
from msg_adapters.convention import Convention
import numpy as np
from numpy.typing import NDArray

ENOUGH_BOXES = 12
"""Boxes with points around them that a finding needs; chosen."""
MAX_COMPARED = 100
"""Boxes after which the check ends; chosen: a second of 10 boxes at 10 Hz."""
MIN_COVERAGE = 0.5
"""
Part of the points around them that boxes must contain to be in the right place.

Chosen: boxes of a detector contain two thirds, those at another place a fifth.

"""
MIN_RATIO_OF_COVERAGE = 1.5
"""
Factor by which another place must be better, in the sum over the boxes.

Chosen: on the sample the right place has 4 times that of the second.

"""
MAX_FLAT = 1e-5
"""Difference of heights [m] or angles [rad] that count as one; derived: rounding of float32 and
transforms."""
MIN_UPRIGHT = 0.5
"""Cosine of the tilt below which a box is not upright; derived: 60 degrees."""
MIN_TILTED = 0.3
"""Part of the boxes on their sides or backs; chosen: with w first, all but oncoming ones."""
LEAST_TILT = 1e-6
"""Least difference of the cosines of two tilts; derived: 0.1 degrees, beyond rounding."""
MOST_TILTED = 0.9
"""Part of them that shows a fixed frame with another axis up; chosen: all but those that err."""
MAX_TILTED = 0.05
"""Part of them that may be so where w is taken to come first; chosen."""
NO_FRAMES: Mapping[str, Floats] = {}


@dataclass(slots=True)
class _Place:
    """A place that the boxes may have, and the option that gives it."""

    option: str
    value: str
    convention: Convention | None = None
    """By which boxes are there; None for those of another frame, or where they are."""
    coverages: list[float] = field(default_factory=list)

    @property
    def mean(self) -> float:
        """Return the mean part of the points around the boxes that these contain."""
        return self.total / max(1, len(self.coverages))

    @property
    def total(self) -> float:
        """Return the sum of these parts: few boxes in a wrong place have points around them."""
        return float(np.sum(self.coverages))


class PlaceCheck(PairedCheck):
    """
    Compare the first boxes with the points around them, where they are and in other places.

    A box of an object contains most of the points around it, whatever its size: those above the
    ground within twice its extents. `finding` says which setting of the `convention` would put the
    boxes there; it is empty if none does, or they are there. Sweeps and boxes arrive in any order,
    in one frame, at most `AT_ONCE` [s] apart.

    """

    def __init__(self, convention: Convention) -> None:
        super().__init__()
        self._convention = convention
        mirrored = replace(convention, orientation='left_handed')
        self._other_order = other_order(convention)
        self._own = _Place('', '')
        self._others = {'mirrored': _Place('orientation', 'left_handed', mirrored)}
        # As read, and with w at the other end of the quaternion: cosine of the tilt.
        self._tilts: list[tuple[float, float]] = []
        self._heights: list[float] = []  # in the frame of the messages
        self._yaws: list[float] = []  # in the same, less quarter turns
        self._stands: list[float] = []  # cosine of z of each box with that of the fixed frame
        self._fixed_frame = ''
        self._frames: dict[str, Floats] = {}
        self.finding = ''

    @property
    def is_open(self) -> bool:
        """Return whether more boxes are compared."""
        return len(self._tilts) < MAX_COMPARED and not self.finding

    def add(
        self,
        item: Sweep | BoxArray,
        T_fixed_item: Floats,
        frames: Mapping[str, Floats] = NO_FRAMES,
    ) -> None:
        """
        Add the next sweep or boxes, and update `finding`.

        Parameters
        ----------
        item : Sweep or BoxArray
            In the fixed frame.
        T_fixed_item : array, shape (4, 4)
            Pose of the frame of its message.
        frames : mapping of str to array (4, 4)
            Names of other frames, and their poses in the fixed one.

        """
        if not self.is_open:
            return
        if isinstance(item, BoxArray):
            self._fixed_frame = item.frame_id
            item = boxes_to_frame(item, inverse(T_fixed_item), '')
            self._frames = {'': T_fixed_item, **frames}
        pair = self._paired(item)
        if pair is not None:
            self._compare(*pair)
            self.finding = self._tilt_text() or self._place_text()

    def _compare(self, points: NDArray[np.floating], array: BoxArray) -> None:
        """Add what boxes in the frame of their message contain of the points, in each place."""
        boxes = array.boxes[is_valid_box(array.boxes)][: MAX_COMPARED - len(self._tilts)]
        count = len(boxes)
        kept = BoxArray(0, '', ('',) * count, ('',) * count, np.ones(count), boxes)
        raw = self._convention.from_centers(kept)
        other = replace(self._convention, orientation=self._other_order).to_centers(raw).boxes
        self._tilts += np.transpose([uprightness(boxes), uprightness(other)]).tolist()
        T = self._frames.pop('')
        own = moved_boxes(boxes, T)
        self._stands += uprightness(own).tolist()
        _add_coverages(self._own, points, own)
        self._heights += raw.boxes[:, BOX_CENTER][:, 2].tolist()
        self._yaws += np.remainder(raw.boxes[:, YAW] + np.pi / 4, np.pi / 2).tolist()
        for place in self._others.values():
            if place.convention is not None:
                meant = place.convention.to_centers(raw).boxes
                _add_coverages(place, points, moved_boxes(meant, T))
        for name, T_fixed_frame in self._frames.items():
            place = self._others.setdefault(f'frame {name}', _Place('boxes_frame', name))
            _add_coverages(place, points, moved_boxes(boxes, T_fixed_frame))

    def _tilt_text(self) -> str:
        """
        Return that the boxes are tilted, unless w of their quaternions is at the other end.

        With w taken to come first by mistake, those along x of their frame are tilted by their yaw
        alone: all that are on a straight road are upright, and turned around.

        """
        if len(self._tilts) < ENOUGH_BOXES:
            return ''
        own, other = np.mean(np.array(self._tilts) < MIN_UPRIGHT, axis=0)
        own_median, other_median = np.median(self._tilts, axis=0)
        is_less_upright = own_median < other_median - LEAST_TILT
        is_tilted = own >= MIN_TILTED or (self._other_order == 'xyzw' and is_less_upright)
        if not is_tilted or other > MAX_TILTED:
            return ''
        how = f'{own:.0%} of the boxes lie on their sides or backs'
        if own < MIN_TILTED:
            how = 'boxes are tilted by what should be their yaw'
        return (
            f'{how}: expected orientation {self._other_order!r}, got '
            f'{self._convention.orientation!r}; {advice("orientation", self._other_order)}'
        )

    @property
    def fallen(self) -> str:
        """Return that the boxes do not stand upright in the fixed frame; '' if they do."""
        if len(self._stands) < ENOUGH_BOXES:
            return ''
        share = np.mean(np.array(self._stands) < MIN_UPRIGHT)
        if share < MOST_TILTED or self.finding:
            return ''
        side = 'on their roofs' if np.median(self._stands) < -MIN_UPRIGHT else 'on their sides'
        return (
            f'{share:.0%} of the boxes stand {side} in {self._fixed_frame!r}: expected z up in '
            f'the fixed frame and in boxes, got axes such as north, east and down: roads and '
            f'roofs are looked for on the wrong side; choose a frame with z up, --fixed-frame '
            f'FRAME (node: fixed_frame:=FRAME), or correct the orientations of the boxes'
        )

    @property
    def flat(self) -> str:
        """Return that all boxes have one z, as a detector in the plane writes it; else ''."""
        if len(self._heights) < MAX_COMPARED or self._convention.pose_reference != 'center':
            return ''
        if np.ptp(self._heights) > MAX_FLAT:
            return ''
        z = round(self._heights[0], 3) or 0.0  # no -0.0
        return (
            f'all of {len(self._heights)} boxes have z of {z:g}: expected the heights of their '
            f'objects, got those of a detector in the plane; x, y and yaw are refined, z is right '
            f'only where {z:g} is the height of their centres: if the ground is there, '
            f'{advice("pose_reference", "bottom")}; a pose at another height is a fraction of '
            f'that of the box, as in --pose-reference=0,0,0.5'
        )

    @property
    def unturned(self) -> str:
        """Return that all boxes are along the axes of their frame, as simple clusters; else ''."""
        if len(self._yaws) < MAX_COMPARED:
            return ''
        if np.abs(np.array(self._yaws) - np.pi / 4).max() > MAX_FLAT:
            return ''
        return (
            f'all of {len(self._yaws)} boxes are along the axes of the frame of their messages: '
            f'expected the directions of their objects, got those of a detector without yaw: '
            f'extents and yaw are right only where an object stands along these axes; give boxes '
            f'the direction in which their tracks move, or the rectangles with least area around '
            f'their points'
        )

    def _place_text(self) -> str:
        """Return the place that the boxes should have; empty if it is not known, or theirs."""
        fitting = [place for place in self._others.values() if self._is_better(place)]
        if not fitting:
            return ''
        best = max(fitting, key=lambda place: place.total)
        got = {
            'orientation': repr(self._convention.orientation),
            'boxes_frame': 'that of the messages',
        }
        instead = ''
        if best.value == 'left_handed':
            instead = (
                '; if the boxes are right, it is the clouds whose y points to the right, which no '
                'option undoes: negate y of their points, in the driver or in a copy of the '
                'recording'
            )
        return (
            f'boxes do not fit the points: {len(self._own.coverages)} of {len(self._tilts)} have '
            f'points around them, and contain {self._own.mean:.0%} of these; elsewhere '
            f'{len(best.coverages)} and {best.mean:.0%}: expected {best.option} {best.value}, got '
            f'{got[best.option]}; {advice(best.option, best.value)}{instead}'
        )

    def _is_better(self, place: _Place) -> bool:
        """Return whether the boxes belong to another place, and not where they are."""
        if len(place.coverages) < ENOUGH_BOXES or place.mean < MIN_COVERAGE:
            return False
        return place.total >= MIN_RATIO_OF_COVERAGE * self._own.total


def uprightness(boxes: Floats) -> Floats:
    """Return the cosine of the tilt of boxes (n, 9), (n,)."""
    return np.asarray(np.cos(boxes[:, ROLL:YAW]).prod(axis=1))


def other_order(convention: Convention) -> str:
    """Return the orientation that takes w of quaternions from the other end."""
    return 'xyzw' if convention.orientation == 'wxyz' else 'wxyz'


def _add_coverages(place: _Place, points: NDArray[np.floating], boxes: Floats) -> None:
    """Add for each of n boxes (n, 9) with enough points around it the part that it contains."""
    for box in boxes:
        if not np.isfinite(box).all():
            continue
        reach = 1.1 * float(np.linalg.norm(box[BOX_EXTENT]))
        away = points_around(points, box[BOX_CENTER], reach)
        found = coverage(away @ matrix_from_rpy(box[ROLL:]), box[BOX_EXTENT] / 2)
        if found is not None:
            place.coverages.append(found)
