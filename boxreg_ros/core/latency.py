"""
The latency of input boxes: how long before their stamp they were right (M12a).

A tracker that stamps its boxes when it is done, or holds them back, is late by one time for a
whole recording. A box of a moving object is then behind its points, and the later boxes of its own
track are where it should be.

"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import replace
from itertools import islice
from typing import Any, NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import (
    BOX_EXTENT,
    BoxArray,
    Floats,
    Ints,
    is_valid_box,
    LENGTH,
    Sweep,
    X,
    Y,
    YAW,
    Z,
)
import numpy as np

# All of these are chosen, except where an origin stands beside them.
NOTABLE = 0.05
"""Less is neither corrected nor a warning [s]: without latency, estimates err by up to 0.04 s."""
CANDIDATES = np.arange(-0.2, 0.801, 0.05)
"""Latencies that are compared [s]; negative ones are of boxes that are predicted too far."""
SAMPLE_PERIOD = 0.3
"""Least time between sweeps whose points are compared with boxes [s]."""
MIN_SPEED = 2.0
"""Slower objects provide no evidence [m/s]."""
FEWEST_POINTS, POINTS_COMPARED = 10, 128
"""Points of an object that provide evidence, and those that are used of more."""
CONSTANT_ERROR = 0.2
"""Deviation of the mean error of a track along its path [m]; measured: 0.07 to 0.16 m."""
USABLE_DEVIATION = 0.03
"""An estimate with a larger deviation is not used [s]."""
SIGNIFICANCE = 3.0
"""Deviations by which a latency, or a drift of it, is more than an error of the estimate."""
PREFERENCE = 1.2
"""
Deviations by which boxes fit better at the stamp, or where points were seen, to be of that time;
otherwise the smaller latency is taken. Measured: 1.5 and more on a simulated highway of known
time, 0.8 and less where human labels are of neither.
"""
SMOOTHING = 0.35
"""Reach of the local lines through the centres of a track [s]: noise must not be motion."""
PATH_REACH = 0.3
"""Points up to this far outside of the predicted boxes are compared with them [m]."""
ROAD_CLEARANCE = 0.3
"""Points less than this above the bottom of a box may be of the road [m]."""
FACE_DEPTH = 0.35
"""Distances from a face beyond this are no worse [m]."""
FULL_WEIGHT = 5
"""Comparisons by which a track has its whole weight."""
OBJECTS_COMPARED = 16
"""Objects of a sweep that are compared, of more those that were compared least often."""
MAX_SAMPLES = 600
"""Comparisons that are kept: the newest, so that the estimate follows a latency that changes."""
TRACK_SECONDS = 3.0
"""Boxes of a track are held this long [s]."""


class Latency(NamedTuple):
    """Latency of the boxes of a recording."""

    seconds: float = 0.0
    """By which the boxes are corrected; 0 where the evidence is too weak, or it is below
    `NOTABLE`."""
    finding: str = ''
    """Why it could not be estimated; empty where it could."""
    estimated: float | None = None
    """What the points say [s]; None without evidence."""
    deviation: float | None = None
    """Standard deviation of that [s]."""
    tracks: int = 0
    """Moving objects that provide evidence."""
    drifts: bool = False
    """Whether it is not one time for the whole recording."""

    @property
    def warning(self) -> str:
        """Return what a user should know; empty for boxes that are in time, or may be."""
        if abs(self.seconds) < NOTABLE or self.estimated is None:
            return self.finding if self.drifts else ''
        word = 'late' if self.seconds > 0 else 'early'
        return (
            f'boxes are {abs(self.seconds):.2f} s {word}, and moved along their tracks before '
            f'registration: correct their stamps where they are made, or set sampling.box_time'
        )

    @property
    def text(self) -> str:
        """Return it in a few words."""
        if self.estimated is None or self.deviation is None:
            return self.finding or f'{self.seconds:.2f} s, as set'
        return f'{self.seconds:.2f} s ({self.estimated:.2f} +- {self.deviation:.2f} s)'

    def summary(self) -> dict[str, Any]:
        """Return it as plain values, rounded to milliseconds."""
        values = self._asdict()
        return {k: round(v, 3) if isinstance(v, float) else v for k, v in values.items()}


def set_latency(config: Config) -> Latency | None:
    """Return the latency that the settings state; None if it is to be estimated."""
    setting = config.sampling.box_time
    if setting == 'auto':
        return None
    return Latency(0.0 if setting in ('stamp', 'sight') else float(setting))


class _Sample(NamedTuple):
    """Costs (2, C) of `CANDIDATES` for an object in a sweep: points as seen, and at the stamp."""

    stamp_ns: int
    track_id: str
    speed: float
    costs: Floats


class LateBoxes:
    """
    Estimate the latency of the boxes of a stream, and correct them.

    Sweeps and boxes are added in the order of their arrival, in the fixed frame. Not thread-safe.

    """

    def __init__(self) -> None:
        self._samples = deque[_Sample](maxlen=MAX_SAMPLES)
        self._has_new_samples = True
        self._latency = Latency()
        self.restart()

    def restart(self) -> None:
        """Forget the tracks and sweeps, but not the latency: time has gone back."""
        self._tracks: dict[str, _Path] = {}
        self._sweeps = deque[Sweep]()
        self._sampled_ns = -(2**62)
        self.newest_ns = -(2**62)

    def add_sweep(self, sweep: Sweep) -> None:
        """Keep a sweep until the boxes are known that its points are compared with."""
        if not sweep.is_dropped and sweep.stamp_ns >= self._sampled_ns + SAMPLE_PERIOD * 1e9:
            self._sampled_ns = sweep.stamp_ns
            self._sweeps.append(sweep)

    def add_boxes(self, boxes: BoxArray) -> None:
        """Note the boxes, as they were given, and compare those of earlier sweeps with points."""
        self.newest_ns = max(self.newest_ns, boxes.stamp_ns)
        for row in np.flatnonzero(is_valid_box(boxes.boxes)).tolist():
            path = self._tracks.setdefault(boxes.track_ids[row], _Path())
            path.add(boxes.stamp_ns, boxes.boxes[row])
        oldest_ns = self.newest_ns - TRACK_SECONDS * 1e9
        self._tracks = {k: path for k, path in self._tracks.items() if path.newest_ns > oldest_ns}
        while self._sweeps and self._sweeps[0].stamp_ns < self.newest_ns - CANDIDATES[-1] * 1e9:
            self._compare(self._sweeps.popleft())

    def corrected(self, boxes: BoxArray, latency: float) -> BoxArray:
        """
        Return boxes moved along their tracks to where their objects are at their stamp.

        Between later boxes of the track that have been added, else on a circle beyond the last.

        """
        if not latency:
            return boxes
        moved = boxes.boxes.copy()
        for row in np.flatnonzero(is_valid_box(boxes.boxes)).tolist():
            path = self._tracks.get(boxes.track_ids[row])
            if path is not None and boxes.track_ids[row]:
                moved[row] = path.at(boxes.stamp_ns + round(latency * 1e9), moved[row])
        return replace(boxes, boxes=moved)

    def kept_up(self) -> Latency:
        """
        Return the latency by the newest evidence, for a stream that goes on.

        It changes in steps of `USABLE_DEVIATION` or more: each step is a jump of the boxes.

        """
        if self._has_new_samples:
            self._has_new_samples = False
            found = _estimated(self._samples)
            if abs(found.seconds - self._latency.seconds) < USABLE_DEVIATION:
                found = found._replace(seconds=self._latency.seconds)
            self._latency = found
        return self._latency

    def estimate(self) -> Latency:
        """Return the latency of a recording, by the evidence from all of it."""
        whole = _estimated(self._samples)
        if whole.finding or len(self._samples) < 2:
            return whole
        half = len(self._samples) // 2
        first = _estimated(islice(self._samples, half))
        last = _estimated(islice(self._samples, half, None))
        if first.finding or last.finding:
            return whole
        assert first.estimated is not None and last.estimated is not None
        assert first.deviation is not None and last.deviation is not None
        drift = abs(last.estimated - first.estimated)
        if drift > NOTABLE + SIGNIFICANCE * np.hypot(first.deviation, last.deviation):
            return whole._replace(
                seconds=0.0,
                drifts=True,
                finding=f'the latency of the boxes drifts from {first.estimated:.2f} to '
                f'{last.estimated:.2f} s: they are not corrected; let one clock stamp boxes and '
                f'clouds',
            )
        return whole

    def _compare(self, sweep: Sweep) -> None:
        """Compare the points of a sweep with the boxes of moving objects."""
        times_ns = sweep.stamp_ns + np.round(CANDIDATES * 1e9).astype(np.int64)
        paths = {k: path for k, path in self._tracks.items() if k and path.covers(times_ns)}
        compared = Counter(sample.track_id for sample in self._samples)
        found = 0
        for track_id in sorted(paths, key=compared.__getitem__):
            boxes = paths[track_id].smoothed(times_ns)
            duration = CANDIDATES[-1] - CANDIDATES[0]
            velocity = (boxes[-1, : Z + 1] - boxes[0, : Z + 1]) / duration
            speed = float(np.linalg.norm(velocity))
            costs = _costs(sweep, boxes, velocity) if speed > MIN_SPEED else None
            if costs is not None:
                self._has_new_samples = True
                self._samples.append(_Sample(sweep.stamp_ns, track_id, speed, costs))
                found += 1
            if found == OBJECTS_COMPARED:
                break


class _Path:
    """The boxes of a track in the last seconds, as they were given."""

    def __init__(self) -> None:
        self._stamps_ns: list[int] = []
        self._boxes: list[Floats] = []

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest box [ns]."""
        return self._stamps_ns[-1]

    def add(self, stamp_ns: int, box: Floats) -> None:
        """Add a box; one that is not newer than the others is left out."""
        if self._stamps_ns and stamp_ns <= self.newest_ns:
            return
        self._stamps_ns.append(stamp_ns)
        self._boxes.append(box)
        while self._stamps_ns[0] < stamp_ns - TRACK_SECONDS * 1e9:
            del self._stamps_ns[0], self._boxes[0]

    def covers(self, times_ns: Ints) -> bool:
        """Return whether all times are within those of the boxes."""
        return bool(self._stamps_ns[0] <= times_ns[0] and times_ns[-1] <= self.newest_ns)

    def at(self, time_ns: int, box: Floats) -> Floats:
        """Return the box (9,) at a time, between those known or beyond; it heads as `box` does."""
        if time_ns > self.newest_ns:
            from boxreg_ros.core.motion import motion_at  # it imports numba

            stamps_ns, boxes = np.array(self._stamps_ns), np.array(self._boxes)
            found = motion_at(stamps_ns, boxes, -1, Config().vehicle).predict(time_ns)
        elif time_ns <= self._stamps_ns[0]:
            found = self._boxes[0].copy()
        else:
            after = int(np.searchsorted(self._stamps_ns, time_ns))
            begin_ns, end_ns = self._stamps_ns[after - 1 : after + 1]
            first, last = self._boxes[after - 1 : after + 1]
            last = last.copy()
            last[YAW] = first[YAW] + (last[YAW] - first[YAW] + np.pi / 2) % np.pi - np.pi / 2
            found = first + (time_ns - begin_ns) / (end_ns - begin_ns) * (last - first)
        if np.cos(found[YAW] - box[YAW]) < 0:
            found[YAW] += np.pi
        found[YAW] = wrap_angle(found[YAW])
        return found

    def smoothed(self, times_ns: Ints) -> Floats:
        """Return boxes (C, 9) at some times, on local lines through the boxes."""
        seconds = (np.array(self._stamps_ns)[:, None] - times_ns) * 1e-9  # (n, C)
        weights = np.clip(SMOOTHING - np.abs(seconds), 1e-6, None)
        weights /= weights.sum(0)
        mean = (weights * seconds).sum(0)
        offsets = seconds - mean
        spread = (weights * offsets**2).sum(0)
        boxes = np.array(self._boxes)
        boxes[:, YAW] = np.unwrap(boxes[:, YAW], period=np.pi)
        middle = weights.T @ boxes
        slope = (weights * offsets).T @ boxes / spread[:, None]
        found: Floats = middle - mean[:, None] * slope
        found[:, BOX_EXTENT] = np.median(boxes[:, BOX_EXTENT], axis=0)
        return found


def _costs(sweep: Sweep, boxes: Floats, velocity: Floats) -> Floats | None:
    """
    Return how badly boxes (C, 9) along a path fit the points, (2, C); None with too few points.

    The part of the points outside of a box, and their mean distance from its faces: the first is
    robust, the second precise. First for the points where they were seen, then for those at the
    stamp.

    """
    points = _points_near(sweep, boxes, velocity)
    costs = np.zeros((2, len(boxes)))
    if points is None:
        return None
    places, times = points
    for row, at_stamp in enumerate((places, places - times[:, None] * velocity)):
        offsets = at_stamp[:, None] - boxes[:, : Z + 1]  # (M, C, 3)
        cos, sin = np.cos(boxes[:, YAW]), np.sin(boxes[:, YAW])
        along = np.abs(cos * offsets[..., X] + sin * offsets[..., Y]) - boxes[:, LENGTH] / 2
        across = np.abs(cos * offsets[..., Y] - sin * offsets[..., X]) - boxes[:, LENGTH + 1] / 2
        outside = np.maximum(along, across)
        is_of_path = (outside < PATH_REACH).any(1)
        if is_of_path.sum() < FEWEST_POINTS:
            return None
        outside = outside[is_of_path]
        inside = (outside < PATH_REACH / 2).sum(0)
        depth = np.abs(outside).clip(max=FACE_DEPTH).mean(0)
        costs[row] = 1.5 * depth / FACE_DEPTH - inside / max(inside.max(), FEWEST_POINTS)
    return costs


def _points_near(sweep: Sweep, boxes: Floats, velocity: Floats) -> tuple[Floats, Floats] | None:
    """Return points (M, 3) around boxes along a path and their times (M,); None with too few."""
    centers = boxes[:, : Z + 1]
    middle = centers.mean(0)
    length, width, height = boxes[0, BOX_EXTENT]
    R, t = np.eye(3), np.zeros(3)
    if sweep.T_frame_points is not None:
        R, t = sweep.T_frame_points[:3, :3], sweep.T_frame_points[:3, 3]
    ahead = velocity / np.linalg.norm(velocity)
    beside = np.array([-ahead[Y], ahead[X], 0.0])
    reach = np.abs((centers - middle) @ np.stack([ahead, beside], 1)).max(0)
    reach += np.array([length, width]) / 2 + PATH_REACH
    there = ((middle - t) @ R).tolist()  # numbers of Python: the points stay single precision
    x, y = sweep.points[:, X], sweep.points[:, Y]
    radius = float(reach.sum())
    near = np.flatnonzero((np.abs(x - there[X]) < radius) & (np.abs(y - there[Y]) < radius))
    offsets = sweep.points[near] @ R.T + (t - middle)
    above = offsets[:, Z] + height / 2
    is_near = (np.abs(offsets @ np.stack([ahead, beside], 1)) < reach).all(1)
    kept = np.flatnonzero(is_near & (above > ROAD_CLEARANCE) & (above < height + ROAD_CLEARANCE))
    if len(kept) < FEWEST_POINTS:
        return None
    kept = kept[:: -(-len(kept) // POINTS_COMPARED)]
    times = np.zeros(len(kept)) if sweep.times is None else sweep.times[near[kept]]
    return offsets[kept] + middle, times


def _estimated(samples: Any) -> Latency:
    """Return the latency of least cost by some comparisons; each track has one weight."""
    of_track: dict[str, list[_Sample]] = {}
    for sample in samples:
        of_track.setdefault(sample.track_id, []).append(sample)
    if not of_track:
        return Latency(finding='nothing moves that boxes and points could be compared by')
    costs = np.array([_weighted([one.costs for one in group]) for group in of_track.values()])
    speed = np.mean([one.speed for group in of_track.values() for one in group])
    n = len(costs)
    ways = [_minimum_and_jackknife(costs[:, way]) for way in (0, 1)]
    seen, at_stamp = costs.sum(0).argmin(1)
    better = costs[:, 0, seen] - costs[:, 1, at_stamp]  # at the stamp, for each track
    if abs(better.sum()) > PREFERENCE * np.sqrt(np.square(better).sum()):
        estimated, jackknife = ways[int(better.sum() > 0)]
    else:
        estimated, jackknife = min(ways, key=lambda way: abs(way[0]))
    deviation = float(np.hypot(jackknife, CONSTANT_ERROR / speed / np.sqrt(n)))
    found = Latency(0.0, '', estimated, deviation, n)
    if abs(estimated) >= max(NOTABLE, SIGNIFICANCE * deviation):
        found = found._replace(seconds=estimated)
    elif deviation > USABLE_DEVIATION:
        found = found._replace(
            finding=f'the latency of the boxes is not known: {estimated:.2f} s with a deviation '
            f'of {deviation:.2f} s, by {n} moving objects'
        )
    return found


def _minimum_and_jackknife(costs: Floats) -> tuple[float, float]:
    """Return the candidate of least cost of all tracks, (n, C), and its deviation [s]."""
    n = len(costs)
    total = costs.sum(0)
    others = np.array([_minimum(total - one) for one in costs]) if n > 1 else np.zeros(1)
    spread = (n - 1) / n * np.square(others - others.mean()).sum()
    return _minimum(total), float(np.sqrt(spread))


def _weighted(costs: list[Floats]) -> Floats:
    """Return the mean cost of a track, less for one that was compared a few times only."""
    return np.asarray(np.mean(costs, 0) * min(1.0, len(costs) / FULL_WEIGHT))


def _minimum(costs: Floats) -> float:
    """Return the candidate of least cost, by a parabola through it and its neighbours [s]."""
    row = int(costs.argmin())
    if row in (0, len(costs) - 1):
        return float(CANDIDATES[row])
    before, least, after = costs[row - 1 : row + 2]
    shift = (before - after) / (before - 2 * least + after) / 2
    return float(CANDIDATES[row] + shift * (CANDIDATES[1] - CANDIDATES[0]))
