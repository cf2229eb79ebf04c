"""Poses between two boxes of a person: lines and splines in time, and ways that have arrived."""

from __future__ import annotations

from collections.abc import Iterator

from boxreg_ros.core.following.start_speed import POSE4, Seeds
from boxreg_ros.core.following.tracker import Follower, Way
from boxreg_ros.core.method.follow_numbers import FOLLOW
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import Floats, Ints, on_lines
import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline


def between(follower: Follower, times: Floats, seeds: Seeds, first: int) -> tuple[Ints, Floats]:
    """
    Return rows (n,) and poses (n, 4) between the seeds `first` and `first + 1`.

    The object is followed from both. A way that arrives is closed onto the seed; both are blended
    by the time to their seeds. Where they do not agree, the line, spline or way that fits the
    points best is taken; among these, both ways up to their losses with a line between.

    """
    start, stop = seeds.rows[first : first + 2].tolist()
    rows = np.arange(start + 1, stop)
    if not len(rows):
        return rows, np.zeros((0, 4))
    part = (times[rows] - times[start]) / (times[stop] - times[start])
    poses = seeds.boxes[:, POSE4]
    way_on = follower.way(first, 1, stop)
    way_back = follower.way(first + 1, -1, start)
    drift = np.sqrt(max(1.0, times[stop] - times[start]))
    forwards = closed(way_on, rows, part, poses[first + 1], drift)
    backwards = closed(way_back, rows[::-1], 1 - part[::-1], poses[first], drift)
    if backwards is not None:
        backwards = backwards[::-1]
    lines = list(_lines(times, seeds, first, rows))
    if forwards is not None and backwards is not None:
        blended = _blended(forwards, backwards, part)
        if (_distances(forwards, backwards) < 2 * FOLLOW.cell).all():
            return rows, blended
        lines.append(blended)
    lines += [way for way in (forwards, backwards) if way is not None]
    lines += _bridged(way_on, way_back, times, seeds.rows[first : first + 2], poses[first:])
    scores = [follower.fit_of(rows, line) for line in lines]
    return rows, lines[int(np.argmax(scores))]


def closed(way: Way, rows: Ints, part: Floats, target: Floats, drift: float) -> Floats | None:
    """
    Return the poses (n, 4) of a way moved so that it ends at `target`; None where it is far.

    The gap may be `drift` times that of a second: errors add up as in a random walk.

    """
    if way.reason or not len(rows):
        return None
    gap = target - list(way.poses.values())[-1]
    gap[3] = wrap_angle(gap[3])
    distance = float(np.linalg.norm(gap[:3]))
    if distance > drift * 2 * FOLLOW.cell or abs(gap[3]) > drift * FOLLOW.max_gap_yaw:
        return None
    poses = np.array([way.poses[row] for row in rows.tolist()])
    return poses + part[:, None] * gap


def _bridged(on: Way, back: Way, times: Floats, ends: Ints, poses: Floats) -> list[Floats]:
    """Return one line (n, 4): both ways up to the last support, and straight between; or none."""
    start, stop = ends.tolist()
    known = {start: poses[0], stop: poses[1]}
    last = max((row for row in on.seen if row < stop), default=start)
    next_ = min((row for row in back.seen if row > start), default=stop)
    if last >= next_:  # both went past each other, and disagree
        return []
    known |= {row: on.poses[row] for row in on.seen if row <= last}
    known |= {row: back.poses[row] for row in back.seen if row >= next_}
    rows = np.array(sorted(known))
    values = np.array([known[row] for row in rows.tolist()])
    values[:, 3] = np.unwrap(values[:, 3])
    return [on_lines(times[rows], values, times[start + 1 : stop])]


def _blended(a: Floats, b: Floats, part: Floats) -> Floats:
    """Return poses (n, 4) from `a` to `b`, at `part` (n,) of the way."""
    step = b - a
    step[:, 3] = wrap_angle(step[:, 3])
    return a + part[:, None] * step


def _distances(a: Floats, b: Floats) -> Floats:
    distances: Floats = np.linalg.norm(a[:, :3] - b[:, :3], axis=1)
    return distances


def _lines(times: Floats, seeds: Seeds, first: int, rows: Ints) -> Iterator[Floats]:
    """Yield candidates (n, 4): a line, a spline by the headings, a spline of all seeds."""
    poses = seeds.boxes[:, POSE4].copy()
    poses[:, 3] = np.unwrap(poses[:, 3])
    ends = poses[first : first + 2]
    at = times[seeds.rows]
    wanted = times[rows]
    part = (wanted - at[first]) / (at[first + 1] - at[first])
    yield ends[0] + part[:, None] * (ends[1] - ends[0])
    travel = ends[1, :2] - ends[0, :2]
    if np.linalg.norm(travel) < FOLLOW.curved_travel:
        return
    if len(at) > 2:
        yield CubicSpline(at, poses)(wanted)
    seconds = at[first + 1] - at[first]
    middle = ends[:, 3].mean()
    speed = travel @ [np.cos(middle), np.sin(middle)] / seconds
    tangents = np.zeros((2, 4))
    tangents[:, :2] = speed * np.column_stack([np.cos(ends[:, 3]), np.sin(ends[:, 3])])
    tangents[:, 2:] = (ends[1, 2:] - ends[0, 2:]) / seconds
    yield CubicHermiteSpline(at[first : first + 2], ends, tangents)(wanted)
