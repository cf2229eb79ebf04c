"""The rules that labels should keep, and their application to tracks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import wraps
from typing import NamedTuple

from boxreg_ros.review.label_tracks import CYCLIST, Labels, LabelTrack, PEDESTRIAN, VEHICLE
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import BOX_EXTENT, Floats, HEIGHT, X, Y, YAW, Z
import numpy as np
from numpy.typing import NDArray

ERROR = 'error'
WARNING = 'warning'


class Violation(NamedTuple):
    """A place where labels violate a rule."""

    track_id: str
    stamp_ns: int
    text: str
    """What was found, with its figures."""


class Rule(NamedTuple):
    """A rule that labels should keep."""

    rule_id: str
    severity: str
    """`ERROR` or `WARNING`."""
    meaning: str
    """What is wrong."""
    remedy: str
    """What to do."""
    find: Callable[[Labels], Iterator[Violation]]
    """Yields the violations of tracks that have boxes; at most one per track and finding."""


RULES: dict[str, Rule] = {}
"""By id."""
Finder = Callable[[Labels], Iterator[Violation]]
Place = Callable[[LabelTrack], tuple[int, str] | None]
"""Finds the row of the box at which a track violates a rule, and the text; None if it does not."""


def violations(tracks: Sequence[LabelTrack]) -> dict[str, list[Violation]]:
    """Return the violations of each rule that is violated, by its id."""
    usable = Labels(track for track in tracks if len(track.stamps_ns))
    found = {name: list(rule.find(usable)) for name, rule in RULES.items()}
    return {name: items for name, items in found.items() if items}


def counts(found: Mapping[str, Sequence[Violation]]) -> dict[str, int]:
    """Return the number of violations of every rule, by its id."""
    return {name: len(found.get(name, ())) for name in RULES}


def _rule(severity: str, meaning: str, remedy: str) -> Callable[[Finder], Finder]:
    """Return a decorator that adds a rule, whose id is the name of its function."""

    def add(find: Finder) -> Finder:
        rule_id = find.__name__.lstrip('_').replace('_', '-')
        RULES[rule_id] = Rule(rule_id, severity, meaning, remedy, find)
        return find

    return add


def _of_each(severity: str, meaning: str, remedy: str) -> Callable[[Place], Finder]:
    """Return a decorator that adds a rule that every track keeps for itself."""

    def add(find: Place) -> Finder:
        @_rule(severity, meaning, remedy)
        @wraps(find)
        def find_in_each(tracks: Labels) -> Iterator[Violation]:
            for track in tracks:
                place = find(track)
                if place is not None:
                    yield Violation(track.track_id, int(track.stamps_ns[place[0]]), place[1])

        return find_in_each

    return add


SIZE_BOUNDS = {
    VEHICLE: ((1.5, 0.8, 0.8), (26.0, 3.6, 5.0)),
    CYCLIST: ((0.8, 0.2, 0.8), (3.0, 1.4, 2.4)),
    PEDESTRIAN: ((0.2, 0.2, 0.7), (1.8, 1.6, 2.4)),
}
"""Least and largest length, width and height [m]. Chosen: from small cars to articulated buses,
from children to large persons with their arms stretched out."""


@_of_each(
    WARNING,
    'the extents are those of no object of this class',
    'correct the size or the class of the track',
)
def _size_outside_class(track: LabelTrack) -> tuple[int, str] | None:
    """Find the first box that is outside the bounds of its class."""
    low, high = np.array(SIZE_BOUNDS[track.kind])
    extents = track.boxes[:, BOX_EXTENT]
    rows = np.flatnonzero(((extents < low) | (extents > high)).any(axis=1))
    if not len(rows):
        return None
    size = ' x '.join(f'{value:.2f}' for value in extents[rows[0]])
    return rows[0], f'{track.class_name} of {size} m in {len(rows)} boxes'


MAX_SIZE_CHANGE = 0.1
"""Largest difference from the median, as part of it. Chosen: twice the error of a detector."""


@_of_each(
    WARNING,
    'the extents of a rigid object change over its track',
    'give all boxes of the track one size',
)
def _size_changes(track: LabelTrack) -> tuple[int, str] | None:
    """Find the box of a vehicle whose extents are furthest from their median."""
    if track.kind != VEHICLE or len(track.boxes) < 2:
        return None
    extents = track.boxes[:, BOX_EXTENT]
    change = np.abs(extents / np.median(extents, axis=0) - 1).max(axis=1)
    row = int(np.argmax(change))
    text = f'extents differ by up to {change[row]:.0%} from their median'
    return (row, text) if change[row] > MAX_SIZE_CHANGE else None


MAX_ACCELERATION = 30.0
"""Largest horizontal acceleration [m/s^2]. Derived: three times that of emergency braking."""
MIN_JUMP = 0.5
"""Smallest deviation from constant velocity that is a jump [m]: more than errors of detectors."""


@_of_each(
    ERROR,
    'the centre jumps: no road user accelerates like this',
    'correct the box, or split the track if its id has switched to another object',
)
def _jump(track: LabelTrack) -> tuple[int, str] | None:
    """Find the largest jump."""
    steps = track.steps
    if len(steps.rows) < 2:
        return None
    change = np.linalg.norm(np.diff(steps.velocity[:, :2], axis=0), axis=1)
    seconds = (steps.seconds[1:] + steps.seconds[:-1]) / 2
    jump = np.where(change / seconds > MAX_ACCELERATION, change * seconds, 0.0)
    row = int(np.argmax(jump))
    text = f'centre {jump[row]:.2f} m off constant velocity'
    return (steps.rows[row + 1], text) if jump[row] > MIN_JUMP else None


MAX_YAW_RATE = 2.0
"""Largest yaw rate of vehicles and cyclists [rad/s]. Chosen: a U-turn in 1.6 s."""
MIN_TURN = 0.1
"""Smallest turn that counts [rad]: more than errors of detectors."""


@_of_each(
    ERROR,
    'the heading turns faster than a vehicle can, or flips',
    'correct the heading; a turn by 180 degrees is a flip',
)
def _spin(track: LabelTrack) -> tuple[int, str] | None:
    """Find the fastest turn of a vehicle or cyclist."""
    steps = track.steps
    if track.kind == PEDESTRIAN or not len(steps.rows):
        return None
    turn = np.abs(wrap_angle(np.diff(track.boxes[:, YAW])[steps.rows]))
    rate = np.where(turn > MIN_TURN, turn / steps.seconds, 0.0)
    row = int(np.argmax(rate))
    text = f'turns by {np.degrees(turn[row]):.0f} degrees in {steps.seconds[row]:.2f} s'
    return (steps.rows[row] + 1, text) if rate[row] > MAX_YAW_RATE else None


MAX_SIDEWAYS = 1.0
"""Largest median sideways speed over a second [m/s]. Chosen: far above the slip of a tyre."""
MAX_SLOPE = 0.2
"""Largest sideways over forward speed. Derived: the centre is half a wheelbase off the axle."""
SLIDING_STEPS = 5
"""Steps of the running median. Chosen: noise of single boxes is no slide."""


@_of_each(
    WARNING,
    'a vehicle moves sideways',
    'correct the heading of the track',
)
def _sliding(track: LabelTrack) -> tuple[int, str] | None:
    """Find the place where a vehicle or cyclist slides fastest."""
    steps = track.steps
    if track.kind == PEDESTRIAN or len(steps.rows) < SLIDING_STEPS:
        return None
    yaw = track.boxes[steps.rows, YAW]
    x, y = steps.velocity[:, :2].T
    forward = np.abs(x * np.cos(yaw) + y * np.sin(yaw))
    sideways = np.abs(y * np.cos(yaw) - x * np.sin(yaw))
    excess = sideways - MAX_SLOPE * forward
    if np.count_nonzero(excess > MAX_SIDEWAYS) <= SLIDING_STEPS // 2:
        return None  # so that no median is, as in most tracks
    windows = np.lib.stride_tricks.sliding_window_view(excess, SLIDING_STEPS)
    medians = np.median(windows, axis=1)
    row = int(np.argmax(medians))
    middle = row + SLIDING_STEPS // 2
    text = f'moves sideways at {sideways[middle]:.1f} m/s'
    return (steps.rows[middle], text) if medians[row] > MAX_SIDEWAYS else None


NEIGHBOURHOOD = 15.0
"""Boxes within this distance share their ground [m]. Chosen: 1 m off at a slope of 7 %."""
MIN_NEIGHBOURS = 3
"""Fewest boxes around. Derived: the median of three is not moved by one that is off."""
MAX_GROUND_OFFSET = 1.0
"""Largest distance of the bottom of a box from the median of its neighbours [m]. Chosen."""


@_rule(
    WARNING,
    'a box floats above, or is sunk below, the ground of the boxes around it',
    'correct its height; ignore it on bridges and slopes',
)
def _floating(tracks: Labels) -> Iterator[Violation]:
    """Yield the first box of each track that is off the bottoms of the boxes around it."""
    stamps_ns, boxes, owner = tracks.rows
    bottom = boxes[:, Z] - boxes[:, HEIGHT] / 2
    reported: set[int] = set()
    order = np.argsort(stamps_ns, kind='stable')
    _, first = np.unique(stamps_ns[order], return_index=True)
    groups = np.split(order, first[1:])
    low, high = (end.reduceat(bottom[order], first) for end in (np.minimum, np.maximum))
    # In others none can be off the median of its neighbours.
    for rows in map(groups.__getitem__, np.flatnonzero(high - low > MAX_GROUND_OFFSET)):
        if len(rows) <= MIN_NEIGHBOURS:
            continue
        x, y = boxes[rows][:, [X, Y]].T
        near = np.hypot(np.subtract.outer(x, x), np.subtract.outer(y, y)) < NEIGHBOURHOOD
        np.fill_diagonal(near, False)
        counts = near.sum(axis=1)
        heights = bottom[rows] - _medians(bottom[rows], near)
        for i in np.flatnonzero(
            (counts >= MIN_NEIGHBOURS) & (np.abs(heights) > MAX_GROUND_OFFSET)
        ):
            index = int(owner[rows[i]])
            if index not in reported:
                reported.add(index)
                text = f'bottom {heights[i]:+.2f} m off those of {counts[i]} boxes around it'
                yield Violation(tracks[index].track_id, int(stamps_ns[rows[i]]), text)


def _medians(values: Floats, is_in: NDArray[np.bool_]) -> Floats:
    """Return for each row of `is_in` (n, n) the median of the values (n,) in it; inf for none."""
    ordered = np.sort(np.where(is_in, values, np.inf), axis=1)
    counts = is_in.sum(axis=1)
    rows = np.arange(len(values))
    medians: Floats = (ordered[rows, (counts - 1) // 2] + ordered[rows, counts // 2]) / 2
    return medians


MAX_IOU = 0.1
"""Largest 3D IoU of two objects. Chosen: neighbours touch by errors of their boxes only."""
DUPLICATE_IOU = 0.7
"""Above, the boxes are of one object, which `duplicate` reports. Chosen: as KITTI matches cars."""


@_rule(
    ERROR,
    'two boxes are in one place',
    'correct position, size or heading of one of them',
)
def _overlap(tracks: Labels) -> Iterator[Violation]:
    """Yield the largest overlap of each pair of tracks."""
    worst: dict[tuple[int, int], tuple[float, int]] = {}
    pairs = tracks.near_pairs
    for row in np.flatnonzero((pairs.iou > MAX_IOU) & (pairs.iou < DUPLICATE_IOU)):
        key = int(pairs.tracks[row, 0]), int(pairs.tracks[row, 1])
        found = float(pairs.iou[row]), int(pairs.stamps_ns[row])
        worst[key] = max(worst.get(key, found), found)
    for (a, b), (value, stamp_ns) in sorted(worst.items()):
        text = f'overlaps with track {tracks[b].track_id}: 3D IoU {value:.2f}'
        yield Violation(tracks[a].track_id, stamp_ns, text)


@_rule(
    ERROR,
    'one object has two labels',
    'remove one of them, or merge the two tracks',
)
def _duplicate(tracks: Labels) -> Iterator[Violation]:
    """Yield ids that occur twice at a stamp, and pairs of tracks with nearly equal boxes."""
    for track in tracks:
        twice = np.flatnonzero(np.diff(track.stamps_ns) == 0)
        if len(twice):
            stamp_ns = int(track.stamps_ns[twice[0]])
            text = f'its id occurs twice at {len(twice)} stamps'
            yield Violation(track.track_id, stamp_ns, text)
    pairs = tracks.near_pairs
    reported: set[tuple[int, int]] = set()
    for row in np.flatnonzero(pairs.iou >= DUPLICATE_IOU):
        a, b = pairs.tracks[row].tolist()
        if (a, b) not in reported:
            reported.add((a, b))
            text = f'has the box of track {tracks[b].track_id}'
            yield Violation(tracks[a].track_id, int(pairs.stamps_ns[row]), text)


MIN_LABEL_POINTS = 5
"""Fewest points of a box. Literature: as Waymo leaves out boxes with fewer at its harder level."""
MAX_PART_OF_FEW = 0.5
"""Part of the boxes of a track that may have fewer. Chosen."""


@_of_each(
    WARNING,
    'most boxes of the track have too few points to check them',
    'look at a camera image, or leave the track out',
)
def _few_points(track: LabelTrack) -> tuple[int, str] | None:
    """Find that most boxes have too few points; unknown numbers are left out."""
    known = track.num_points >= 0
    few = known & (track.num_points < MIN_LABEL_POINTS)
    if not known.any() or few.sum() <= MAX_PART_OF_FEW * known.sum():
        return None
    text = f'{few.sum()} of {known.sum()} boxes have fewer than {MIN_LABEL_POINTS} points'
    return int(np.argmax(few)), text


MIN_SPEED = 2.0
"""Slower motion backward is parking [m/s]. Chosen."""
MIN_PART_BACKWARD = 0.5
"""Part of the steps that are backward at least. Chosen."""
MIN_STEPS = 5
"""Fewest steps of a track. Chosen: half a second at 10 Hz; noise of single boxes is no motion."""


@_of_each(
    WARNING,
    'a vehicle drives backward',
    'turn the heading of the track by 180 degrees',
)
def _backward(track: LabelTrack) -> tuple[int, str] | None:
    """Find that a vehicle or cyclist moves backward most of the time."""
    steps = track.steps
    if track.kind == PEDESTRIAN or len(steps.rows) < MIN_STEPS:
        return None
    yaw = track.boxes[steps.rows, YAW]
    forward = steps.velocity[:, 0] * np.cos(yaw) + steps.velocity[:, 1] * np.sin(yaw)
    is_backward = forward < -MIN_SPEED
    if is_backward.mean() <= MIN_PART_BACKWARD:
        return None
    text = f'moves backward at {-np.median(forward[is_backward]):.1f} m/s'
    return steps.rows[np.argmax(is_backward)], text


MIN_POINTS_IN_VIEW = 50
"""Fewest points of an object in view. Chosen: boxes with fewer may be lost by a detector."""
MIN_TIME_LEFT = 1.0
"""Shortest time from the end of the track to that of the labels [s]. Chosen: gaps are shorter."""


@_rule(
    WARNING,
    'the track ends although its object is in view',
    'extend the track, or merge it with the one that goes on',
)
def _ends_in_view(tracks: Labels) -> Iterator[Violation]:
    """Yield tracks whose last box has many points, well before the end of the labels."""
    end_ns = max((int(t.stamps_ns[-1]) for t in tracks), default=0)
    for track in tracks:
        last_ns = int(track.stamps_ns[-1])
        left = (end_ns - last_ns) * 1e-9
        if left > MIN_TIME_LEFT and track.num_points[-1] >= MIN_POINTS_IN_VIEW:
            text = f'ends {left:.1f} s before the labels with {track.num_points[-1]} points'
            yield Violation(track.track_id, last_ns, text)
