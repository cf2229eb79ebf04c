"""Which object each point of a sweep is on, and the motion of objects by their boxes."""

from math import hypot
from typing import Any, NamedTuple

from boxreg_ros.core.method.compile import kernel, loop
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.method.crop import empty_room, gather, measure, offset_of, road_height
from boxreg_ros.core.method.selection import lower_median
import numpy as np

BACKGROUND, UNKNOWN = -1, -2
"""In place of the track of a point: it is on no object, or on one or beside it."""
UNKNOWN_MOTION, PARKED, STOOD, MOVING = range(4)
"""Motion of an object: never seen to move, stands now but moves at another time, moves."""

# All of these are chosen.
SURFACE_TOLERANCE = 0.12
"""Points up to this far outside of the surface that the margins predict are of the object [m]."""
BAND = 0.1
"""Points up to this far outside of that are unknown: of the object or beside it [m]."""
UNCERTAIN_BAND = 0.5
"""The same of boxes that no points confirm: kept ones, and ones between those of a gap [m]."""
CLEARANCE = 0.06
"""
Points in a box this close to the road are of either [m]: above its noise, below a bumper.

They are of neither where the object moves, since they would stay behind in a map, and of the road
where it is parked.

"""
SPEED_SECONDS = 1.0
"""Time that the boxes of a speed span [s]."""
MIN_SECONDS = 0.25
"""Shorter tracks have no known motion [s]."""
LEAST_WAY = 0.35
"""Way of a moving object in `SPEED_SECONDS` at least [m]: 3 deviations of a registered centre."""
SPEED_DEVIATIONS = 5.0
"""Its speed in standard errors: boxes that jump once, as estimates that settle, do not move."""
WAY_BETWEEN_RESTS = 1.0
"""Its way between two rests [m]: farther than an estimate jumps."""
PARKED_SPEED = CONSTANTS.parked_speed


class Objects(NamedTuple):
    """
    The objects of one stamp.

    Attributes
    ----------
    track : array, shape (k,)
        Row of the track of each.
    boxes : array, shape (k, 9)
        At the stamp, in the fixed frame.
    velocities : array, shape (k, 3)
        Of the centres [m/s].
    turn_rates : array, shape (k,)
        Of the headings [rad/s].
    motion : array, shape (k,)
        `PARKED`, `STOOD`, `MOVING` or `UNKNOWN_MOTION`.
    is_certain : array, shape (k,)
        Whether the box is where the points are.
    is_lost : array, shape (k,)
        Whether the box is a guess, and no point known to be on it: in a long gap of a moving
        object, and before and after it.

    """

    track: Any
    boxes: Any
    velocities: Any
    turn_rates: Any
    motion: Any
    is_certain: Any
    is_lost: Any


@loop
def inside_out(shapes, box, x, y, z):
    """Return an offset along the axes of a box, less its half extents; and height in it [m]."""
    R = shapes.rotations[box]
    half = shapes.half[box]
    up = R[0, 2] * x + R[1, 2] * y + R[2, 2] * z
    u = abs(R[0, 0] * x + R[1, 0] * y + R[2, 0] * z) - half[0]
    v = abs(R[0, 1] * x + R[1, 1] * y + R[2, 1] * z) - half[1]
    return u, v, abs(up) - half[2], half[2] + up


@kernel
def surroundings(times, shapes, near, numbers, room):
    """
    Return the height of the road in each box, and when the sweep sees its object, (n,) each.

    The height is above the bottom [m], NaN where unknown; the time is the median of the points
    inside [s], 0 without any.

    """
    n = len(shapes.half)
    road, seen = np.empty(n), np.zeros(n)
    delays = np.empty(near.most if len(times) else 0, np.float32)
    for box in range(n):
        m = measure(box, near, shapes, numbers, room)
        road[box] = road_height(m, numbers, room)
        inside = 0
        for j in range(m if len(times) else 0):
            delays[inside] = times[near.rows[room.places[j]]]
            inside += room.depth[j] <= 0.0
        if inside:
            seen[box] = lower_median(delays[:inside])
    return road, seen


@loop
def moved_back(objects, box, delay, x, y, z):
    """Return an offset from the centre of an object at a delay [s], as it is without [m]."""
    x -= objects.velocities[box, 0] * delay
    y -= objects.velocities[box, 1] * delay
    z -= objects.velocities[box, 2] * delay
    angle = objects.turn_rates[box] * delay
    cos, sin = np.cos(angle), np.sin(angle)
    return cos * x + sin * y, cos * y - sin * x, z


@loop
def outside(shapes, objects, limits, road, box, x, y, z):
    """Return how far a point is outside of a surface [m], inf if too far; whether it is on it."""
    u, v, w, high = inside_out(shapes, box, x, y, z)
    ends, sides, top, bottom = limits[box]
    excess = max(u - ends, v - sides)
    above = high - (road[box] if road[box] == road[box] else 0.0)
    if abs(above) <= CLEARANCE:
        is_either = objects.motion[box] != PARKED and excess < 0.0
        return (excess if is_either else np.inf), False
    excess = max(excess, w - (top if high > shapes.half[box, 2] else bottom))
    if above < 0.0 or excess >= (BAND if objects.is_certain[box] else UNCERTAIN_BAND):
        return np.inf, False
    return excess, excess <= 0.0 and not objects.is_lost[box]


@kernel
def label(near, num_points, times, shapes, objects, limits, is_at_stamp, elsewhere, numbers):
    """
    Find the object that each point is on, at the time of the point.

    Parameters
    ----------
    near : crop.NearPoints
        The points near the boxes.
    num_points : int
        M, that of all points.
    times : array, shape (M,) or (0,)
        Of the points relative to the stamp [s]; empty where unknown.
    shapes : crop.Shapes
        Boxes at the stamp; their bounding boxes include where they go while the sweep takes place.
    objects : Objects
        The same, with their motion in the frame of the boxes.
    limits : array, shape (n, 4)
        How far points are outside of the ends, sides, top and bottom at most [m].
    is_at_stamp : bool
        Whether boxes are at the stamp, not where the sweep sees the object.
    elsewhere : int
        `BACKGROUND`, or `UNKNOWN` where boxes do not state what is there.
    numbers : crop.CropNumbers
        Constants and settings of the road.

    Returns
    -------
    track : array, shape (M,)
        Track of the object that the point is on, of several the one that it is deepest inside of;
        `UNKNOWN` next to one, and `elsewhere` of the others.
    motion : array, shape (M,)
        Motion of the object that the point is on or next to; `UNKNOWN_MOTION` of the others.
    rows, owner : array, shape (L,)
        Points on an object, ascending, and these objects.
    local : array, shape (L, 3)
        These points in the frame of the box at their own time [m].

    """
    room = empty_room(near)
    road, seen = surroundings(times, shapes, near, numbers, room)
    K = len(near.rows)
    best, is_on, least = np.full(K, -1, np.int32), np.zeros(K, np.bool_), np.full(K, np.inf)
    own = np.empty((K, 3))
    for box in range(len(shapes.half)):
        R = shapes.rotations[box]
        for j in range(gather(box, near, room)):
            k = room.places[j]
            x, y, z = offset_of(room.at, j, shapes, box)
            if len(times):
                delay = times[near.rows[k]] - (0.0 if is_at_stamp else seen[box])
                x, y, z = moved_back(objects, box, delay, x, y, z)
            excess, is_sure = outside(shapes, objects, limits, road, box, x, y, z)
            if is_sure < is_on[k] or (is_sure == is_on[k] and excess >= least[k]):
                continue
            best[k], is_on[k], least[k] = box, is_sure, excess
            for axis in range(3):
                own[k, axis] = R[0, axis] * x + R[1, axis] * y + R[2, axis] * z
    track = np.full(num_points, elsewhere, np.int32)
    motion = np.zeros(num_points, np.uint8)
    place = np.full(num_points, -1, np.int32)
    for k in range(K):
        place[near.rows[k]] = k
    rows, owner, local = np.empty(K, np.int64), np.empty(K, np.int32), np.empty((K, 3))
    L = 0
    for i in range(num_points):
        k = place[i]
        if k < 0 or best[k] < 0:
            continue
        track[i] = objects.track[best[k]] if is_on[k] else UNKNOWN
        motion[i] = objects.motion[best[k]]
        rows[L], owner[L] = i, best[k]
        for axis in range(3):
            local[L, axis] = own[k, axis]
        L += is_on[k]
    return track, motion, rows[:L], owner[:L], local[:L]


@loop
def slope(t, values, i, seconds, rate, error):
    """
    Find the slope of values (n, 4) at row `i` of times t (n,): `rate` and its `error`, (4,) each.

    The rows within a time of `seconds` are used, in the middle of which `i` is; at an end all of
    it is on one side. Returns the time that they span [s].

    """
    n = len(t)
    begin = min(max(t[i] - seconds / 2, t[0]), max(t[0], t[len(t) - 1] - seconds)) - 1e-6
    end = begin + seconds + 2e-6
    low, high = max(i - 1, 0), min(i + 2, n)  # both neighbours at least
    while low > 0 and t[low - 1] >= begin:
        low -= 1
    while high < n and t[high] < end:
        high += 1
    m = high - low
    for axis in range(values.shape[1]):
        middle, mean = 0.0, 0.0
        for k in range(low, high):
            middle += t[k] / m
            mean += values[k, axis] / m
        spread, product, square = 0.0, 0.0, 0.0
        for k in range(low, high):
            spread += (t[k] - middle) ** 2
            product += (t[k] - middle) * (values[k, axis] - mean)
            square += (values[k, axis] - mean) ** 2
        rate[axis] = product / spread
        rest = max(square - rate[axis] * product, 0.0)
        error[axis] = np.sqrt(rest / max(m - 2, 1) / spread)
    return t[high - 1] - t[low]


@kernel
def motions(first, t, values):
    """
    Find the motion at each box of T tracks, by the slope of the boxes around it.

    Parameters
    ----------
    first : array, shape (T + 1,)
        First box of each track, and the number of all.
    t : array, shape (N,)
        Times [s].
    values : array, shape (N, 4)
        Centres and headings [m, rad]; half turns of the heading are taken back, in place.

    Returns
    -------
    rates : array, shape (N, 4)
        Of the values where the object moves, else 0.
    moves, is_known : array, shape (N,)
        Whether it moves, and whether the track is long enough to show that.

    """
    N = len(t)
    rates = np.zeros((N, 4))
    moves = np.zeros(N, np.bool_)
    is_known = np.zeros(N, np.bool_)
    rate, error = np.empty(4), np.empty(4)
    for track in range(len(first) - 1):
        a, b = first[track], first[track + 1]
        if t[b - 1] - t[a] < MIN_SECONDS:
            continue
        is_known[a:b] = True
        for i in range(a + 1, b):
            turns = np.floor((values[i, 3] - values[i - 1, 3]) / np.pi + 0.5)
            values[i, 3] -= turns * np.pi
        for i in range(b - a):
            span = slope(t[a:b], values[a:b], i, SPEED_SECONDS, rate, error)
            speed = hypot(rate[0], rate[1])
            noise = SPEED_DEVIATIONS * hypot(error[0], error[1])
            moves[a + i] = speed > max(PARKED_SPEED, LEAST_WAY / span, noise)
        begin = a
        while begin < b:  # motions between two rests that lead nowhere
            end = begin + 1
            while end < b and moves[end] == moves[begin]:
                end += 1
            if moves[begin] and begin > a and end < b:
                x = values[end, 0] - values[begin - 1, 0]
                y = values[end, 1] - values[begin - 1, 1]
                moves[begin:end] = hypot(x, y) >= WAY_BETWEEN_RESTS
            begin = end
        for i in range(b - a):
            if moves[a + i]:  # less smooth, for the place
                slope(t[a:b], values[a:b], i, SPEED_SECONDS / 2, rates[a + i], error)
    return rates, moves, is_known
