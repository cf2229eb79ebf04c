"""Check of the axes of boxes against the way they move: vehicles drive along their length."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import atan2, hypot, pi

from boxreg_ros.io.checks.finding import advice_for_some, listed
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import BoxArray, Floats, is_valid_box, LENGTH, WIDTH, YAW
from msg_adapters.convention import Convention, FORWARD
import numpy as np

MIN_WAY = 2.0
"""Way from which a direction is taken [m]; chosen: noise of 0.3 m makes 9 degrees of it."""
MAX_SECONDS = 2.0
"""Longest time of this way [s]: slower than 1 m/s, boxes of parked objects drift as fast."""
MAX_OBJECT_SPEED = 70.0
"""Faster ones are jumps of ids [m/s]."""
MAX_ANGLE = pi / 6
"""Largest angle between a direction and the axis that it counts for [rad]; chosen."""
MIN_MOVING_TRACKS = 2
"""Tracks that a finding needs."""
MIN_DIRECTIONS = 4
"""Directions of a single track that are enough: 8 m."""
MIN_DIRECTIONS_OF_CLASS = 8
"""Directions of a class that are enough, also of a single track: 16 m."""
MIN_TRACKS_BACKWARD = 3
"""Tracks that must drive backward; chosen: one or two may."""
MAX_DIRECTIONS = 500
"""After so many directions the check ends; chosen."""
MIN_SHARE = 0.8
"""Share of the directions that must agree; chosen: about half of unresolved headings do."""
MAX_SHARE_OF_NOISE = 0.5
"""Share of the directions near x or -x by which yaw is not of the boxes; a third are by chance."""
MIN_TRACKS_OF_NOISE = 3
"""Tracks that show it; chosen: the directions of one that turns or slides depend on each other."""
MIN_DIRECTIONS_OF_NOISE = 20
"""Directions that show it; chosen: by chance, more than half lie along x in 1 of 26 cases."""
MIN_TURNED = pi / 36
"""
Angle by which boxes are turned from their way [rad]; chosen: 5 degrees.

Of right boxes it is up to 1.6 degrees (five drives); boxes turned by 6 cost 0.015 of 3D IoU.

"""
MAX_SPREAD = pi / 12
"""Deviation from this angle of the directions that agree on it [rad]; chosen: 15 degrees."""
MAX_SAME = 1e-4
"""Difference of yaws that count as one [rad]; derived: rounding of quaternions in float32."""
AS_READ, MIRRORED_YAW, OF_FIXED_FRAME = range(3)
"""Columns of the angles from x of a box to its way, by three meanings of its yaw."""
MIRRORED_OF = {'xyzw': 'clockwise', 'clockwise': 'xyzw'}
"""Orientation -> that in which yaw grows the other way."""
MIN_RATIO = 1.15
"""Ratio of length and width of a vehicle from which they can be told apart; chosen."""
SWAPPED = str.maketrans('lw', 'wl')
OPTIONS = ('orientation', 'forward_axis', 'size_order')
"""Of a `Convention`, which the motion can show."""
AXIS_WORDS = {
    'x+': 'x axis',
    'y+': 'y axis, sideways',
    'x-': 'x axis backward',
    'y-': 'y axis, sideways to the right',
}
AXES = tuple(FORWARD)
"""Axes of a pose, each a quarter turn after the one before it."""


@dataclass(slots=True)
class _Way:
    """Where a track was when its last direction was taken, and the axes that it moved along."""

    stamp_ns: int
    box: Floats
    frame_yaw: float
    axes: Counter[str] = field(default_factory=Counter)


class AxisCheck:
    """
    Compare the axes of boxes with their motion; `wanted` is the convention that fits.

    Points cannot show which axis points forward; the way of moving vehicles and cyclists does.
    Once that is known, the larger horizontal extent is the length. `finding` says which options
    would fit; it is empty where nothing moves. `class_finding` says which classes move sideways
    where others move along their length. `is_turned` says that all boxes are turned from their
    way by one angle that is no quarter turn. The check ends after `MAX_DIRECTIONS`.

    """

    def __init__(self, convention: Convention, is_checked: Callable[[str], bool]) -> None:
        self._convention = convention
        self._is_checked = lru_cache(maxsize=100)(is_checked)
        self._ratios = defaultdict[str, list[float]](list)  # length to width, by class
        self._axes: Counter[str] = Counter()
        self._axes_of = defaultdict[str, Counter[str]](Counter)  # the same by class
        self._tracks: Counter[str] = Counter()  # by the axis along which they moved first
        self._mirrored: Counter[bool] = Counter()  # where one sense of yaw fits alone: the other?
        self._angles: list[tuple[float, float, float]] = []  # from x of a box to its way
        self._yaws: list[float] = []  # in the frame of the message
        self.finding = ''
        self.class_finding = ''
        self.is_turned = False
        self.forget()

    def forget(self) -> None:
        """Forget where the tracks are, after a time jump; directions stay."""
        self._ways: dict[str, _Way] = {}

    def add(self, boxes: BoxArray, frame_yaw: float = 0.0) -> None:
        """
        Add the next boxes, and update `finding`.

        Parameters
        ----------
        boxes : BoxArray
            In a fixed frame, with ids; read by the convention that is checked.
        frame_yaw : float
            Yaw of the frame of their message in the fixed frame [rad]: a yaw is mirrored in it.

        """
        known = self._axes.total()
        if known >= MAX_DIRECTIONS:
            return
        oldest_ns = boxes.stamp_ns - round(MAX_SECONDS * 1e9)
        self._ways = {k: way for k, way in self._ways.items() if way.stamp_ns >= oldest_ns}
        is_valid = is_valid_box(boxes.boxes).tolist()
        for row, track_id in enumerate(boxes.track_ids):
            name = boxes.class_names[row]
            if track_id and is_valid[row] and self._is_checked(name):
                self._add(track_id, name, boxes.stamp_ns, boxes.boxes[row], frame_yaw)
        if self._axes.total() > known:
            self.finding = self._text()
            self.class_finding = self._class_text()
            self.is_turned = self._is_enough and self._is_turned(AS_READ)

    def _add(self, track_id: str, name: str, stamp_ns: int, box: Floats, frame_yaw: float) -> None:
        way = self._ways.setdefault(track_id, _Way(stamp_ns, box, frame_yaw))
        step = (box[:2] - way.box[:2]).tolist()
        moved = hypot(*step)
        if moved < MIN_WAY:
            return
        if moved <= MAX_OBJECT_SPEED * (stamp_ns - way.stamp_ns) * 1e-9:
            heading = atan2(step[1], step[0])
            # Headings may be unresolved: a mean of opposite ones is across both.
            turn = pi * round((box[YAW] - way.box[YAW]) / pi)
            yaws = np.array([way.box[YAW] + turn, box[YAW]])
            mirrored = 2 * np.array([way.frame_yaw, frame_yaw]) - yaws
            self._yaws.append(float(wrap_angle(box[YAW] - frame_yaw)))
            own = _mean_angle(yaws - [way.frame_yaw, frame_yaw])
            angles = heading - _mean_angle(yaws), heading - _mean_angle(mirrored), heading - own
            self._angles.append(angles)
            axis = _axis_of(angles[0])
            fits_mirrored = _axis_of(angles[1]) == 'x+'
            if fits_mirrored != (axis == 'x+'):
                self._mirrored[fits_mirrored] += 1
            self._tracks[axis] += not way.axes[axis]
            self._axes[axis] += 1
            self._axes_of[name][axis] += 1
            self._ratios[name].append(float(box[LENGTH] / box[WIDTH]))
            way.axes[axis] += 1
        self._ways[track_id] = _Way(stamp_ns, box, frame_yaw, way.axes)

    @property
    def wanted(self) -> Convention:
        """Return the convention of the motion: the one that is checked, if nothing else fits."""
        if self._is_mirrored:
            return replace(self._convention, orientation=MIRRORED_OF[self._convention.orientation])
        axis = self._axis()
        if axis is None or self._is_turned(AS_READ):
            return self._convention
        turned = AXES[(AXES.index(self._convention.forward_axis) + AXES.index(axis)) % 4]
        wanted = replace(self._convention, forward_axis=turned)
        ratio = self._ratio(self._ratios)
        is_long = ratio > (1 / MIN_RATIO if axis[0] == 'x' else MIN_RATIO)
        # A vehicle is longer than wide: along the axis that points forward.
        if is_long:
            return wanted
        return replace(wanted, size_order=wanted.size_order.translate(SWAPPED))

    def _text(self) -> str:
        """Return which options fit the motion; empty if the convention that is checked does."""
        wanted, own = self.wanted, self._convention
        names = [name for name in OPTIONS if getattr(wanted, name) != getattr(own, name)]
        if not names:
            return self._yaw_text()
        ways = self._axes.total()
        expected = ' and '.join(f'{name} {getattr(wanted, name)!r}' for name in names)
        got = ' and '.join(repr(getattr(own, name)) for name in names)
        node = ' '.join(f'{name}:={getattr(wanted, name)}' for name in names)
        flags = ' '.join(f'--{n.replace("_", "-")} {getattr(wanted, n)}' for n in names)
        how = 'are wider than long along their way'
        if wanted.forward_axis != own.forward_axis:
            how = f'move along their {AXIS_WORDS[self._axis() or "x+"]}'
        if wanted.orientation != own.orientation:
            how = 'turn against their way, as if yaw grew to the other side'
        return (
            f'boxes of vehicles {how} (by {ways} directions of moving ones): expected {expected}, '
            f'got {got}; set {node} (boxreg relabel and convert: {flags})'
        )

    def _class_text(self) -> str:
        """Return that some classes move sideways, others along their length; '' if not so."""
        right, sideways = self._moving_along('x+'), self._moving_along('y+', 'y-')
        if not right or not sideways:
            return ''
        ways = sum(self._axes_of[name].total() for name in sideways)
        correction = 'turn them by 90 degrees'
        if self._ratio(sideways) < 1 / MIN_RATIO:
            correction += ' and exchange their length and width'
        return (
            f'boxes of {listed(sideways)} move along their y axis, sideways (by {ways} '
            f'directions of moving ones), those of {listed(right)} along their x axis: expected '
            f'one forward_axis of all classes; {advice_for_some(correction)}'
        )

    def _moving_along(self, *axes: str) -> list[str]:
        """Return the classes that move along one of some axes of their boxes."""
        return [
            name
            for name, known in self._axes_of.items()
            if known.total() >= MIN_DIRECTIONS_OF_CLASS
            and sum(known[axis] for axis in axes) >= MIN_SHARE * known.total()
        ]

    def _ratio(self, names: Iterable[str]) -> float:
        """Return the median ratio of length and width of boxes that moved, of some classes."""
        return float(np.median([ratio for name in names for ratio in self._ratios[name]]))

    @property
    def _is_mirrored(self) -> bool:
        """Return whether the directions that show the sense of yaw say that it is the other."""
        if self._convention.orientation not in MIRRORED_OF:
            return False
        total = self._mirrored
        if total[True] < max(MIN_DIRECTIONS, MIN_SHARE * total.total()):
            return False
        # A box that is turned by a quarter or a half seems mirrored where its way crosses an axis.
        fitting = self._axes['x+'] + total[True] - total[False]
        if fitting < MIN_SHARE * self._axes.total() or self._is_turned(MIRRORED_YAW):
            return False
        axis = self._axis()
        if axis is None:
            return True
        # Vehicles of one road may fit both: the nearer one is taken.
        angles = np.array(self._angles)[:, : MIRRORED_YAW + 1] - (FORWARD[axis], 0)
        as_read, mirrored = np.median(np.abs(wrap_angle(angles)), axis=0)
        return bool(mirrored < as_read)

    def _turn(self, meaning: int) -> float | None:
        """Return the angle [rad] of the ways from the nearest axes; None if they do not agree."""
        if len(self._angles) < MIN_DIRECTIONS:
            return None
        angles = 4 * np.array(self._angles)[:, meaning]  # axes are a quarter turn apart
        turn = _mean_angle(angles) / 4
        agreeing = np.mean(np.abs(wrap_angle(angles - 4 * turn)) < 4 * MAX_SPREAD)
        return turn if agreeing >= MIN_SHARE else None

    def _is_turned(self, meaning: int) -> bool:
        """Return whether the ways agree on another angle than that of an axis; few on twice it."""
        least = MIN_TURNED if self._is_enough else 2 * MIN_TURNED
        return abs(self._turn(meaning) or 0.0) >= least

    def _is_straight(self, meaning: int) -> bool:
        """Return whether the ways agree on an axis."""
        return self._turn(meaning) is not None and not self._is_turned(meaning)

    @property
    def _is_enough(self) -> bool:
        """Return whether there are enough directions to say that yaw does not follow them."""
        is_of_many = self._tracks.total() >= MIN_TRACKS_OF_NOISE
        return is_of_many and self._axes.total() >= MIN_DIRECTIONS_OF_NOISE

    def _yaw_text(self) -> str:
        """Return that yaw has nothing to do with the way, or is turned from it; else ''."""
        total, along = self._axes.total(), self._axes['x+'] + self._axes['x-']
        is_noise = max(along, self._axes['y+'], self._axes['y-']) <= MAX_SHARE_OF_NOISE * total
        is_turned = self._is_turned(AS_READ)
        is_of_fixed = self._is_straight(OF_FIXED_FRAME) and not self._is_straight(AS_READ)
        if not self._is_enough or not (is_noise or is_turned or is_of_fixed):
            return ''
        way = f'{along}'
        if is_turned:
            angles = np.array(self._angles)[:, AS_READ]
            turn = _mean_angle(2 * angles) / 2  # headings may be unresolved
            way = f'boxes turned by {np.degrees(abs(turn)):.0f} degrees to the '
            way += 'right' if turn > 0 else 'left'
        what = 'degrees written as radians, which no option can undo in a quaternion'
        if np.ptp(self._yaws) < MAX_SAME:
            what = f'one for all boxes, {self._yaws[0]:.2g}, as of a detector without orientation'
        elif is_of_fixed:
            what = 'that of the fixed frame, where positions are of another one'
        elif is_turned:
            what = 'of another frame than the positions, or counted from another axis, as north'
        return (
            f'yaw of the boxes of vehicles does not follow their way: expected nearly all of '
            f'{total} directions along a box, got {way}; it may be {what}: convert yaw to '
            f'radians of the frame of the positions where the boxes are made, or see whether '
            f'another topic has it'
        )

    def _axis(self) -> str | None:
        """Return the axis along which the tracks move; None if too few do, or all ways."""
        if not self._axes:
            return None
        axis, count = self._axes.most_common(1)[0]
        if axis not in AXES or count < MIN_SHARE * self._axes.total():
            return None
        tracks = self._tracks[axis]
        if axis == 'x-' and tracks < MIN_TRACKS_BACKWARD:
            return None
        if tracks < MIN_MOVING_TRACKS and count < MIN_DIRECTIONS:
            return None
        return axis


def _mean_angle(angles: Floats) -> float:
    """Return the direction of the sum of unit vectors at angles [rad]."""
    return float(np.angle(np.exp(1j * angles).sum()))


def _axis_of(angle: float) -> str:
    """Return the axis of a box that a direction at an angle from x is near; '' for none."""
    for axis, forward in FORWARD.items():
        if abs(np.angle(np.exp(1j * (angle - forward)))) <= MAX_ANGLE:
            return axis
    return ''
