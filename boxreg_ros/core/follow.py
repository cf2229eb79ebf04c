"""Follow objects through point clouds from a few boxes of a person: arrays in, arrays out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import hypot
from typing import ClassVar, NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.following import person
from boxreg_ros.core.following.between import between
from boxreg_ros.core.following.exact import between_exact, Keyframes
from boxreg_ros.core.following.object_points import Owned
from boxreg_ros.core.following.start_speed import POSE4, Seeds
from boxreg_ros.core.following.sweeps import ascending, nearest, Points, SightLimits, Sweeps
from boxreg_ros.core.following.tracker import Follower, Way
from boxreg_ros.core.method.follow_numbers import FOLLOW
from boxreg_ros.core.method.sweep_fit import within
from boxreg_ros.core.observation import GOOD_POINTS, NEARBY
from boxreg_ros.core.refine import refined_tracks, RefinedTrack, Track
from boxreg_ros.errors import ShapeError
from boxreg_ros.rotations import matrix_from_rpy, wrap_angle
from boxreg_ros.structures import (
    BOX_EXTENT,
    BoxArray,
    checked,
    checked_stamps,
    Columns,
    EXTENDED,
    Floats,
    HEIGHT,
    HUMAN,
    INTERPOLATED,
    Ints,
    is_valid_box,
    LENGTH,
    REFINED,
    ROLL,
    WIDTH,
    YAW,
)
import numpy as np
from numpy.typing import NDArray

MAX_TURN_RATE = 1.5
"""
No vehicle makes more than a quarter turn faster [rad/s].

Derived: on a circle of 5 m, at 27 km/h.

"""


APART_SEEDS = (
    'boxes of one object, got some too far apart for a {!r}; no boxes are added between them: '
    'give each object an id of its own'
)
TURNED_SEEDS = (
    'headings of one object, got some that differ by more than a {!r} turns; boxes between them '
    'turn: turn one around'
)


class End(NamedTuple):
    """Where a track ends: the last stamp with a box [ns], and why, see `following.tracker`."""

    stamp_ns: int
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class FollowedTrack(Columns):
    """One object over time; N is 0 without a seed that can be used."""

    COLUMNS: ClassVar[tuple[str, ...]] = ('rows', 'stamps_ns', 'boxes', 'status')

    track_id: str
    class_name: str
    rows: Ints
    """Rows (N,) of the sweeps with a box, ascending."""
    stamps_ns: Ints
    """Their stamps (N,) [ns]."""
    boxes: Floats
    """Boxes (N, 9) in the frame of the points [m, rad]."""
    status: tuple[str, ...]
    """``human`` (a seed), ``interpolated`` (between two seeds) or ``extended`` (beyond them)."""
    ends: tuple[End, ...]
    """Before the first seed and after the last."""
    problems: tuple[str, ...]
    """Seeds that could not be used and why, one line each."""


def follow(
    stamps_ns: Ints,
    points: Sequence[NDArray[np.floating]],
    seeds: Sequence[BoxArray],
    config: Config | None = None,
    sensor_origins: Floats | None = None,
) -> list[FollowedTrack]:
    """
    Follow each object of `seeds` through all sweeps, and refine its whole track.

    Parameters
    ----------
    stamps_ns : array, shape (S,)
        Strictly increasing stamps of the sweeps [ns].
    points : sequence of S arrays, shape (M_i, 3)
        Points of each sweep in the fixed frame [m].
    seeds : sequence of BoxArray
        Boxes of a person in the fixed frame, one or more of each track id.
    config : Config, optional
        Settings of the solve.
    sensor_origins : array, shape (S, 3), optional
        Positions of the sensor [m].

    Returns
    -------
    tracks : list of FollowedTrack
        In the order of the first seeds.

    Raises
    ------
    ShapeError
        For arrays of other shapes, stamps that do not increase or have another unit, or boxes
        without a track id.

    Notes
    -----
    An object is followed both ways until the evidence ends: it is lost where too few points fit
    what has been seen of it, where its pose is uncertain along its heading or in yaw, or where it
    would have to jump. A box in doubt is not returned.

    """
    config = config or Config()
    stamps = checked_stamps('stamps_ns', stamps_ns)
    if len(points) != len(stamps):
        raise ShapeError(f'points: expected {len(stamps)} arrays, got {len(points)}')
    if sensor_origins is not None:
        sensor_origins = checked('sensor_origins', sensor_origins, (len(stamps), 3), 'x y z')
    ordered = [ascending(checked(f'points[{i}]', p, (None, 3))) for i, p in enumerate(points)]
    tracks = follow_points(stamps, ordered, seeds, config, sensor_origins)
    return solved(tracks, ordered, config, sensor_origins)


def follow_points(
    stamps_ns: Ints,
    points: Points,
    seeds: Sequence[BoxArray],
    config: Config,
    origins: Floats | None = None,
    grows: bool = True,
) -> list[FollowedTrack]:
    """
    Follow as `follow` does, without the solve.

    Parameters
    ----------
    stamps_ns : array, shape (S,)
        Strictly increasing stamps of the sweeps [ns].
    points : Points
        Those of each sweep (M_i, 3) in one frame, finite, as of `ascending` [m].
    seeds : sequence of BoxArray
        Boxes of a person in this frame, one or more of each track id.
    config : Config
        The groups of object classes are used.
    origins : array, shape (S, 3), optional
        Positions of the sensor, NaN where unknown [m].
    grows : bool
        Whether a single seed that is not pinned takes the size of the points that are seen of its
        object.

    Returns
    -------
    tracks : list of FollowedTrack
        In the order of the first seeds.

    Raises
    ------
    ShapeError
        If a seed has no track id.

    """
    times = (stamps_ns - stamps_ns[:1]).astype(np.float64) * 1e-9
    limits = None if origins is None else SightLimits(points, origins)
    sweeps = Sweeps(times, points, len(times), sight_limits=limits)
    objects = [_placed(name, rows, stamps_ns) for name, rows in _by_track(seeds).items()]
    objects = _of_class(_overlapping(objects))
    owned = Owned()
    followers = [
        Follower(sweeps, one.seeds, config.kind(one.class_name), owned, one.same)
        if len(one.seeds.rows) else None
        for one in objects
    ]  # fmt: skip
    found: dict[int, FollowedTrack] = {}
    counts = [0 if one is None else one.num_points for one in followers]
    for index in np.argsort(-np.array(counts, int), kind='stable').tolist():
        track = _followed(objects[index], followers[index], stamps_ns, times, grows)
        owned.add(track.rows, track.boxes, index)
        found[index] = track
    return [found[index] for index in range(len(objects))]


class _Object(NamedTuple):
    """An object: its seeds in sweeps, and those that could not be placed."""

    track_id: str
    class_name: str
    seeds: Seeds
    problems: tuple[str, ...]
    same: tuple[int, ...] = ()
    """Indices of the objects with a seed that is inside of one of this, or the other way."""
    is_of_class: bool = False
    """Whether another object has the same size: no person draws the same box twice."""
    is_pinned: bool = False
    """Whether a person has decided on a seed, and so on the size."""


class _Seed(NamedTuple):
    stamp_ns: int
    class_name: str
    box: Floats
    is_pinned: bool


def _by_track(arrays: Sequence[BoxArray]) -> dict[str, list[_Seed]]:
    """Return the seeds of each track, ascending by stamp."""
    found: dict[str, list[_Seed]] = {}
    for array in sorted(arrays, key=lambda array: array.stamp_ns):
        for i, name in enumerate(array.track_ids):
            if not name:
                raise ShapeError(
                    'seeds: expected a track id for each box, got an empty one; add it'
                )
            is_pinned = bool(array.is_pinned[i])
            seed = _Seed(array.stamp_ns, array.class_names[i], array.boxes[i], is_pinned)
            found.setdefault(name, []).append(seed)
    return found


def _placed(track_id: str, given: Sequence[_Seed], stamps_ns: Ints) -> _Object:
    """Return an object with each seed in the sweep nearest in time, and name the others."""
    boxes: dict[int, Floats] = {}
    problems = []
    are_valid = is_valid_box(np.array([seed.box for seed in given]))
    for seed, is_valid in zip(given, are_valid.tolist(), strict=True):
        row, away, period = nearest(stamps_ns, seed.stamp_ns)
        name = f'seed of track {track_id!r} at {seed.stamp_ns}'
        if not is_valid:
            problems.append(f'{name}: expected finite numbers and positive extents')
        elif away > period / 2:
            problems.append(
                f'{name}: expected the stamp of a sweep, the nearest is {away * 1e-9:.3f} s away'
            )
        elif row in boxes:
            problems.append(f'{name}: expected one box at a stamp; the first is used')
        else:
            boxes[row] = seed.box
    rows = np.array(list(boxes), np.int64)
    seeds = Seeds(rows, np.array(list(boxes.values())).reshape(-1, 9))
    return _Object(
        track_id,
        Counter(seed.class_name for seed in given).most_common(1)[0][0],
        seeds,
        tuple(problems),
        is_pinned=any(seed.is_pinned for seed in given),
    )


def _followed(
    one: _Object, follower: Follower | None, stamps_ns: Ints, times: Floats, grows: bool
) -> FollowedTrack:
    """Return the track of an object: before its first seed, between all of them, and after."""
    if follower is None:
        nothing = np.zeros(0, np.int64)
        return FollowedTrack(
            one.track_id, one.class_name, nothing, nothing, np.zeros((0, 9)), (), (), one.problems
        )
    problems = one.problems
    seeds = one.seeds
    poses = {int(row): box[POSE4] for row, box in zip(seeds.rows, seeds.boxes, strict=True)}
    status = dict.fromkeys(poses, HUMAN)
    for first in range(len(seeds.rows) - 1):
        at = stamps_ns[seeds.rows[first : first + 2]].tolist()
        pair = f'seeds of track {one.track_id!r} at {at[0]} and {at[1]}: expected'
        if follower.jumps(first):
            problems = (*problems, f'{pair} {APART_SEEDS.format(one.class_name)}')
            continue
        if follower.is_rigid and _turns_around(seeds.boxes[first : first + 2, YAW], at):
            problems = (*problems, f'{pair} {TURNED_SEEDS.format(one.class_name)}')
        rows, found = between(follower, times, seeds, first)
        poses |= dict(zip(rows.tolist(), found, strict=True))
        status |= dict.fromkeys(rows.tolist(), INTERPOLATED)
    ends = []
    if follower.num_points < GOOD_POINTS:
        lack = f'expected {GOOD_POINTS} points in their boxes, got {follower.num_points}'
        line = f'seeds of track {one.track_id!r}: {lack}; it is not followed: correct the boxes'
        problems = (*problems, f'{line}, or their frame')
    for seed, sign, stop in ((0, -1, 0), (len(seeds.rows) - 1, 1, len(times) - 1)):
        last = int(seeds.rows[seed])
        reason = 'few_points'
        if follower.num_points >= GOOD_POINTS:
            way = follower.way(seed, sign, stop)
            reason = way.reason or 'end_of_sweeps'
            for row in _supported(way):
                poses[row] = way.poses[row]
                status[row] = EXTENDED
                last = row
        ends.append(End(int(stamps_ns[last]), reason))
    rows = np.array(sorted(poses), np.int64)
    boxes = _boxes(rows, np.array([poses[row] for row in rows.tolist()]), seeds)
    if grows and not one.is_pinned and len(seeds.rows) == 1:
        boxes = follower.grown(rows, boxes, one.is_of_class)
    words = tuple(status[row] for row in rows.tolist())
    return FollowedTrack(
        one.track_id, one.class_name, rows, stamps_ns[rows], boxes, words, tuple(ends), problems
    )


def _turns_around(yaw: Floats, stamps_ns: list[int]) -> bool:
    """Return whether two headings (2,) differ by more than a quarter turn, too soon for one."""
    turn = abs(float(wrap_angle(yaw[1] - yaw[0])))
    return turn > max(np.pi / 2, MAX_TURN_RATE * (stamps_ns[1] - stamps_ns[0]) * 1e-9)


def _overlapping(objects: Sequence[_Object]) -> list[_Object]:
    """Return the objects; those with a seed whose centre is in that of another are named."""
    by_row: dict[int, list[tuple[int, Floats]]] = {}
    for index, one in enumerate(objects):
        for row, box in zip(one.seeds.rows.tolist(), one.seeds.boxes, strict=True):
            by_row.setdefault(row, []).append((index, box))
    others: dict[int, str] = {}
    same: list[set[int]] = [set() for _ in objects]
    for placed in by_row.values():
        boxes = np.array([box for _, box in placed])
        offsets = (boxes[:, :3] - boxes[:, None, :3]) @ matrix_from_rpy(boxes[:, ROLL:])
        is_inside = (np.abs(offsets) < boxes[:, None, BOX_EXTENT] / 2).all(2)
        np.fill_diagonal(is_inside, False)
        for outer, inner in np.argwhere(is_inside).tolist():
            outer, inner = placed[outer][0], placed[inner][0]
            others[inner] = objects[outer].track_id
            same[outer].add(inner)
            same[inner].add(outer)
    found = [one._replace(same=(*same[index],)) for index, one in enumerate(objects)]
    for index, other in others.items():
        one = found[index]
        line = f'seeds of track {one.track_id!r}: one is inside that of track {other!r}; both are'
        found[index] = one._replace(problems=(*one.problems, f'{line} followed: delete one'))
    return found


def _of_class(objects: Sequence[_Object]) -> list[_Object]:
    """Return the objects; those with the size of another are said to have that of a class."""
    sizes = [
        {(one.class_name, *size) for size in one.seeds.boxes[:, BOX_EXTENT].round(3).tolist()}
        for one in objects
    ]
    counts = Counter(size for own in sizes for size in own)
    return [
        one._replace(is_of_class=any(counts[size] > 1 for size in own))
        for one, own in zip(objects, sizes, strict=True)
    ]


def _supported(way: Way) -> Iterator[int]:
    """Yield the rows of a way, outwards, up to the last that points support."""
    waiting: list[int] = []
    for row in way.poses:  # in the order they were followed
        waiting.append(row)
        if row in way.seen:
            yield from waiting
            waiting = []


def _boxes(rows: Ints, poses: Floats, seeds: Seeds) -> Floats:
    """Return boxes (N, 9) of poses (N, 4), with roll and pitch of the nearest seed."""
    nearest = np.abs(rows[:, None] - seeds.rows).argmin(1)
    boxes: Floats = seeds.boxes[nearest].copy()
    boxes[:, BOX_EXTENT] = seeds.boxes[:, BOX_EXTENT].mean(0)
    boxes[:, POSE4] = poses
    boxes[:, YAW] = wrap_angle(boxes[:, YAW])
    return boxes


def solved(
    tracks: Sequence[FollowedTrack],
    points: Points,
    config: Config,
    origins: Floats | None,
) -> list[FollowedTrack]:
    """
    Return followed tracks with refined boxes.

    Parameters
    ----------
    tracks : sequence of FollowedTrack
        As of `follow_points`. Their seeds are boxes of a person, which evidence may move.
    points : Points
        As there.
    config : Config
        Settings of the solve.
    origins : array, shape (S, 3), or None
        As there.

    Returns
    -------
    tracks : list of FollowedTrack
        In their order, with as many boxes; those without boxes as they are.

    """
    config = config.updated({'sampling.box_extents': 'whole'})  # a person draws whole objects
    given = [with_points(track, points, origins) for track in tracks if len(track.rows)]
    usual = keyframe_deviations(given, config)
    found = refined_tracks(given, config, person.numbers(usual))
    fits = _fits(given, found)
    steps = person.corrections(*fits, usual)
    are_exact = person.are_exact(*fits, usual)
    boxes = {}
    first = 0
    for track, refined in zip(given, found, strict=True):
        is_fit = _is_fit(track, refined)
        at_ns = track.stamps_ns[is_fit]
        own = steps[first : first + len(at_ns)]
        moved = person.moved(track.stamps_ns, refined.boxes, at_ns, own)
        if are_exact:
            residuals = person.residuals(track.boxes, refined.boxes)
            residuals[~is_fit] = np.nan
            keyframes = Keyframes(track.stamps_ns, track.boxes, residuals).take(track.pinned)
            moved = between_exact(track.stamps_ns, moved, keyframes)
        boxes[track.track_id] = moved
        first += len(at_ns)
    return [replace(track, boxes=boxes.get(track.track_id, track.boxes)) for track in tracks]


def keyframe_deviations(tracks: Iterable[Track], config: Config) -> Floats:
    """
    Return the deviations of keyframes: the usual ones, or larger ones that some show.

    Parameters
    ----------
    tracks : iterable of Track
        Their pinned boxes are the keyframes; of the first tracks that have enough of them.
    config : Config
        Settings of the solve that they are compared with.

    Returns
    -------
    deviations : array, shape (9,)
        Of the columns of a box, as `person.DEVIATIONS`; these themselves if there are fewer than
        ``FOLLOW.min_keyframes`` keyframes.

    """
    some, count = [], 0
    for track in tracks:
        seeds = 0 if track.pinned is None else int(track.pinned.sum())
        if seeds >= FOLLOW.min_seeds:
            some.append(track)
            count += seeds
        if count >= FOLLOW.sample:
            break
    usual = person.DEVIATIONS
    if count < FOLLOW.min_keyframes:
        return usual
    found = refined_tracks(some, config, person.numbers(usual))
    larger: Floats = np.maximum(person.shown(*_fits(some, found), usual), usual)
    return larger


def _is_fit(track: Track, refined: RefinedTrack) -> NDArray[np.bool_]:
    """Return which boxes (N,) of a track are seeds that were refined."""
    assert track.pinned is not None
    is_refined = np.array([word == REFINED for word in refined.status], bool)
    return np.asarray(track.pinned & is_refined, bool)


def _fits(
    tracks: Sequence[Track], refined: Sequence[RefinedTrack]
) -> tuple[Floats, Floats, Floats]:
    """Return the seeds (n, 9) of all tracks, their fits, and the variances of these."""
    seeds, fits, variances = [np.zeros((0, 9))], [np.zeros((0, 9))], [np.zeros((0, 9))]
    for track, found in zip(tracks, refined, strict=True):
        rows = _is_fit(track, found)
        seeds.append(track.boxes[rows])
        fits.append(found.boxes[rows])
        variances.append(person.diagonals(found.covariances[rows], found.extent_covariances[rows]))
    return np.concatenate(seeds), np.concatenate(fits), np.concatenate(variances)


def with_points(track: FollowedTrack, points: Points, origins: Floats | None) -> Track:
    """Return a track to be refined, with the points near its boxes."""
    near = [_nearby(points[row], box) for row, box in zip(track.rows, track.boxes, strict=True)]
    return Track(
        track.track_id,
        track.class_name,
        track.stamps_ns,
        track.boxes,
        near,
        None if origins is None else origins[track.rows],
        pinned=np.array([word == HUMAN for word in track.status], bool),
    )


def _nearby(points: NDArray[np.floating], box: Floats) -> Floats:
    """Return the points, which ascend by x, within `NEARBY` of a box."""
    reach = hypot(box[LENGTH], box[WIDTH]) / 2 + NEARBY
    found: Floats = within(points, box, reach, box[HEIGHT] / 2 + NEARBY)
    return found.copy()  # of the room for many more
