"""
The latency of input boxes: how long before their stamp they were measured (M12a).

A tracker that stamps its boxes when it is done, or holds them back, is late by one time for a
whole recording. A box in the frame of a sensor that moves was then brought to the fixed frame by
the wrong pose, and a moving object has gone on. Both are mended where the box was measured.

"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations, pairwise
from math import inf
from typing import Any, NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.matching import Pair
from boxreg_ros.core.measured_tracks import MeasuredTracks
from boxreg_ros.core.method.path_costs import fill_costs, PATH_REACH
from boxreg_ros.core.observation import crop
from boxreg_ros.structures import BOX_EXTENT, BoxArray, Floats, Ints, LENGTH, Sweep, X, Y, YAW, Z
import numpy as np

# All of these are chosen, except where an origin stands beside them.
NOTABLE = 0.05
"""
Less is neither corrected nor a warning [s], except for an offset of stamps, see `_as_stamped`.

Measured: without latency, estimates err by up to 0.04 s.

"""
CANDIDATES = np.arange(-0.4, 0.801, 0.05)
"""Latencies that are compared [s]; negative ones are of boxes that are predicted too far."""
ENDS = np.array([0, len(CANDIDATES) - 1])
"""Rows of the two candidates that show whether an object moves."""
SAMPLE_PERIOD = 0.3
"""Least time between sweeps whose points are compared with boxes [s]."""
MIN_SPEED = 2.0
"""Objects that move slower in the frame they are measured in provide no evidence [m/s]."""
FEWEST_POINTS, POINTS_COMPARED = 10, 128
"""Points of an object that provide evidence, and those that are used of more."""
CONSTANT_ERROR = 0.2
"""Deviation of the mean error of a track along its path [m]; measured: 0.07 to 0.16 m."""
USABLE_DEVIATION, USABLE_PART = 0.03, 0.2
"""An estimate with a larger deviation [s], and a larger one for its size, is not used."""
GAIN = 2.0
"""Deviations by which tracks must fit better at a latency than in time, for it to be corrected."""
SIGNIFICANCE = 3.0
"""Deviations by which a latency, or a drift of it, is more than an error of the estimate."""
SECOND_MINIMUM = 0.15
"""Least depth of a minimum in time, below the rise to the least cost, as part of their range;
measured: between 0.15 and 0.33 by rows of parked cars, up to 0.12 where boxes are late."""
PREFERENCE = 1.2
"""
Deviations by which late boxes fit better at the stamp, or where points were seen, to be of that
time; otherwise the smaller latency is taken. Measured: 1.2 to 2.6 on simulated highways with boxes
of the stamp, up to 1.4 for a while where human labels are of neither.
"""
ROAD_CLEARANCE = 0.3
"""Points less than this above the bottom of a box may be of the road [m]."""
FULL_WEIGHT = 5
"""Comparisons by which a track has its whole weight."""
OBJECTS_COMPARED = 16
"""Objects of a sweep that are compared, of more those that were compared least often."""
STEADY_SPREAD = 0.005
"""
Largest spread of the middle four fifths of the offsets between stamps of boxes and sweeps [s].

Chosen: a tenth of `NOTABLE`. A larger one is no constant offset.

"""
MAX_SAMPLES = 600
"""Comparisons that are kept: the newest, so that the estimate follows a latency that changes."""
MIN_OF_LIDAR = 3
"""Moving objects that show the latency of a LiDAR of several; measured: one was off by 0.26 s."""
TRACK_SECONDS = 3.0
"""Boxes of a track are held this long [s]."""
SWEEPS_HELD = 16
"""Sweeps that wait for the boxes they are compared with: 5 s, if boxes are missing for long."""
STEP = 0.02
"""The latency that is corrected changes by this or more [s]: each step is a jump of the boxes."""
FIRST_SECONDS = 10.0
"""With `estimate` 'track' boxes wait for the latency that the first seconds show [s]."""
FIRST_POINTS = 2**23
"""Points of the sweeps that wait with them, at most: 100 MB."""


NOTHING_MOVES = 'nothing moves that boxes and points could be compared by'


class Latency(NamedTuple):
    """Latency of the boxes of a recording."""

    seconds: float = 0.0
    """By which the boxes are corrected; 0 where the evidence is too weak, or it is below
    `NOTABLE` and not the offset of the boxes from their sweeps."""
    finding: str = ''
    """Why it could not be estimated; empty where it could."""
    estimated: float | None = None
    """What the points say [s]; None without evidence."""
    deviation: float | None = None
    """Standard deviation of that [s]."""
    tracks: int = 0
    """Moving objects that provide evidence."""
    drifts: bool = False
    """Whether it is not one time: older evidence was forgotten."""
    is_beyond: bool = False
    """Whether it is as large as what is compared, or larger: nothing is corrected."""
    lidars: str = ''
    """Which LiDARs show another one than others: nothing is corrected; empty if all agree."""

    @property
    def warning(self) -> str:
        """Return what a user should know; empty for boxes that are in time, or may be."""
        if self.lidars:
            return (
                f'clocks: expected one for all LiDARs, got stamps of {self.lidars}, by boxes that '
                f'move: synchronise their clocks (PTP), and let all drivers stamp the same moment '
                f'of a sweep'
            )
        if self.estimated is None:
            return ''
        word = 'late' if self.estimated > 0 else 'early'
        if self.is_beyond:
            return (
                f'boxes are {abs(self.estimated):.1f} s {word} or more, which is not corrected: '
                f'correct the stamps where they are made, or set sampling.box_time'
            )
        if not (self.drifts or self.seconds):
            return ''
        changes = ', at the end of a latency that drifts' if self.drifts else ''
        return (
            f'boxes are {abs(self.seconds):.2f} s {word} by the points{changes}, and moved to '
            f'where their objects are at their stamps: correct the stamps, of boxes or clouds, '
            f'where they are made; if both are right, set sampling.box_time=stamp'
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
    sensor: int = 0
    """The LiDAR of most of the points."""


class _Comparisons(NamedTuple):
    """Samples (n) as columns."""

    tracks: Ints
    """(n,), a number for each track."""
    speeds: Floats
    costs: Floats
    """(n, 2, C)."""

    @classmethod
    def of(cls, samples: Collection[_Sample]) -> _Comparisons:
        """Return the columns of some samples."""
        number_of: dict[str, int] = {}
        tracks = [number_of.setdefault(one.track_id, len(number_of)) for one in samples]
        speeds = np.array([one.speed for one in samples])
        return cls(np.array(tracks, int), speeds, np.array([one.costs for one in samples]))

    def part(self, first: int, end: int) -> _Comparisons:
        """Return the columns of the samples between two rows."""
        rows = slice(first, end)
        return _Comparisons(self.tracks[rows], self.speeds[rows], self.costs[rows])


class _Path(NamedTuple):
    """Where the boxes of a track were in a sweep, by latency."""

    track_id: str
    boxes: Floats
    """(C, 9), for each of `CANDIDATES`."""
    velocities: Floats
    """(C, 3), of the object [m/s]."""

    @property
    def shift(self) -> Floats:
        """Return how the box moves for each second of latency, (3,) [m/s]."""
        return _shift(self.boxes[:, : Z + 1])

    @property
    def speed(self) -> float:
        """Return the length of `shift` [m/s]."""
        return float(np.linalg.norm(self.shift))


def _shift(centers: Floats) -> Floats:
    """Return how centres (..., C, 3), one for each candidate, move by latency, (..., 3) [m/s]."""
    shift: Floats = (centers[..., -1, :] - centers[..., 0, :]) / (CANDIDATES[-1] - CANDIDATES[0])
    return shift


class LatencyEvidence:
    """Comparisons of boxes with points, and the latency that they show. Not thread-safe."""

    def __init__(self) -> None:
        self._samples = deque[_Sample](maxlen=MAX_SAMPLES)
        # Stamps [ns] of boxes, and of their sweeps.
        self._stamps = deque[tuple[int, int]](maxlen=MAX_SAMPLES)
        self._has_new_samples = False
        self._latency = Latency(finding=NOTHING_MOVES)
        self.restart()

    def restart(self) -> None:
        """Forget the sweeps that wait, but not the latency: time has gone back."""
        self._sweeps = deque[Sweep](maxlen=SWEEPS_HELD)
        self._sampled_ns = -inf

    def add_sweep(self, sweep: Sweep) -> None:
        """Keep a sweep until the boxes are known that its points are compared with."""
        if not sweep.is_dropped and sweep.stamp_ns >= self._sampled_ns + SAMPLE_PERIOD * 1e9:
            self._sampled_ns = sweep.stamp_ns
            self._sweeps.append(sweep)

    def add_stamps(self, boxes_ns: int, sweep_ns: int) -> None:
        """Add the stamps of boxes and of their sweep [ns]."""
        self._stamps.append((boxes_ns, sweep_ns))

    def compare(self, tracks: MeasuredTracks) -> None:
        """Compare the sweeps whose later boxes are among the tracks."""
        while self._sweeps and self._sweeps[0].stamp_ns < tracks.newest_ns - CANDIDATES[-1] * 1e9:
            self._compare(self._sweeps.popleft(), tracks)

    @property
    def latency(self) -> Latency:
        """Return the latency by the newest evidence; it changes in steps of `STEP` or more."""
        if self._has_new_samples:
            self._has_new_samples = False
            known = _Comparisons.of(self._samples)
            drifts = self._latency.drifts
            half = len(self._samples) // 2
            older, newer = known.part(0, half), known.part(half, MAX_SAMPLES)
            is_new = not drifts and _differ(older, newer)
            if is_new:
                known = newer
                for _ in range(half):
                    self._samples.popleft()
            found = _estimated(known)
            lidars = _lidars_apart(self._samples)
            # Where nothing was or is corrected, a few objects erred for a while.
            drifts |= is_new and bool(self._latency.seconds or found.seconds)
            found = _as_stamped(found, self._steady_offsets())._replace(drifts=drifts)
            if abs(found.seconds - self._latency.seconds) < STEP:
                found = found._replace(seconds=self._latency.seconds)
            if lidars:
                found = found._replace(seconds=0.0, lidars=lidars)
            self._latency = found
        return self._latency

    def _steady_offsets(self) -> Floats:
        """
        Return the constant offsets that boxes may have from their sweep, (n,) [s].

        They are positive where boxes are stamped later. There is one, that from the nearest sweep;
        two where it is half a period; none where it is not constant.

        """
        boxes_ns, sweeps_ns = np.array(self._stamps, np.int64).reshape(-1, 2).T
        steps = np.diff(np.unique(sweeps_ns))
        if not len(steps):
            return np.empty(0)
        period = float(np.quantile(steps, 0.1)) * 1e-9  # sweeps without boxes make others longer
        offsets = (boxes_ns - sweeps_ns) * 1e-9
        # At half a period, the nearest sweep is the one before or the one after by chance.
        offsets = offsets[0] + np.remainder(offsets - offsets[0] + period / 2, period) - period / 2
        low, middle, high = np.quantile(offsets, (0.1, 0.5, 0.9))
        if high - low > STEADY_SPREAD:
            return np.empty(0)
        found: Floats = middle + period * np.arange(-1, 2)
        return found[np.abs(found) <= period / 2 + STEADY_SPREAD]

    def _compare(self, sweep: Sweep, tracks: MeasuredTracks) -> None:
        """Compare the points of a sweep with the boxes of objects that move in their frame."""
        times_ns = sweep.stamp_ns + np.round(CANDIDATES * 1e9).astype(np.int64)
        compared = Counter(sample.track_id for sample in self._samples)
        names = tracks.covering(times_ns)
        if not names:
            return
        centers = tracks.nearest_centers(names, times_ns[ENDS], ENDS)
        speeds = np.linalg.norm(_shift(centers), axis=-1).tolist()
        moving = [name for name, speed in zip(names, speeds, strict=True) if speed > MIN_SPEED]
        moving.sort(key=compared.__getitem__)
        found = 0
        for first in range(0, len(moving), OBJECTS_COMPARED):
            some = moving[first : first + OBJECTS_COMPARED]
            smoothed = tracks.smoothed(some, times_ns)
            paths = [_Path(*path) for path in zip(some, *smoothed, strict=True)]
            paths = [path for path in paths if path.speed > MIN_SPEED]
            for path, near in zip(paths, _points_near(sweep, paths), strict=True):
                costs = _costs(path, near.points, near.times)
                if costs is None or found == OBJECTS_COMPARED:
                    continue
                self._has_new_samples = True
                self._samples.append(
                    _Sample(sweep.stamp_ns, path.track_id, path.speed, costs, near.sensor)
                )
                found += 1
            if found == OBJECTS_COMPARED:
                break


class LatencyCorrection:
    """
    Bring the boxes of a stream to where their objects are at their stamp.

    It stands between matching and observation. The latency is the one that the settings state, or
    that sweeps and boxes so far have shown: what is returned depends on the order of box arrays
    and on the order of sweeps alone, not on how both are interleaved. Not thread-safe.

    Parameters
    ----------
    waits : bool
        Whether boxes wait: all for `FIRST_SECONDS`, to know the latency from the first on, and
        each for the later boxes of its track that show its object. Otherwise they are predicted.
    known : Latency, optional
        The latency, if it is known otherwise.

    """

    def __init__(self, waits: bool, known: Latency | None = None) -> None:
        self._waits = waits
        self._known = known
        self._evidence = LatencyEvidence()
        self._set: Latency | None = None
        self.restart()

    def restart(self) -> None:
        """Forget tracks, sweeps and boxes, but not the latency: time has gone back."""
        self._tracks = MeasuredTracks(CANDIDATES)
        self._evidence.restart()
        self._waiting = deque[Pair]()
        self._first_ns: int | None = None
        self._is_begun = False

    @property
    def latency(self) -> Latency:
        """Return the latency that boxes are corrected by now."""
        return self._set or self._evidence.latency

    def add_sweep(self, sweep: Sweep) -> None:
        """Add a sweep, before the pairs that it completes."""
        if self._is_estimated:
            self._evidence.add_sweep(sweep)

    @property
    def waiting(self) -> list[BoxArray]:
        """Return the box arrays that wait, in their order."""
        return [pair.boxes for pair in self._waiting]

    def add(self, pairs: Iterable[Pair], config: Config) -> Iterator[Pair]:
        """Add pairs with ascending stamps; yield those that are in time, in their order."""
        self._set = self._known or set_latency(config)
        for pair in pairs:
            self._waiting.append(pair)
            if not pair.reason:
                self._note(pair)
            if self._waits:
                self._compare()
            yield from self._ready()
            if not self._waits:  # after its early boxes, which this would delay
                self._compare()

    def flush(self) -> Iterator[Pair]:
        """Yield the pairs that wait, without waiting on."""
        while self._waiting:
            yield self._pop_corrected()

    def _note(self, pair: Pair) -> None:
        """Add boxes to their tracks, and how they are stamped."""
        boxes = pair.boxes
        if pair.sweep is not None:
            self._evidence.add_stamps(boxes.stamp_ns, pair.sweep.stamp_ns)
        if self._first_ns is None:
            self._first_ns = boxes.stamp_ns
        if self._is_estimated or self.latency.seconds:
            oldest_ns = min(boxes.stamp_ns, self._waiting[0].boxes.stamp_ns)
            self._tracks.add(boxes, oldest_ns - TRACK_SECONDS * 1e9)

    def _compare(self) -> None:
        """Compare earlier sweeps with the boxes that are known now."""
        if self._is_estimated:
            self._evidence.compare(self._tracks)

    @property
    def _is_estimated(self) -> bool:
        return self._set is None

    def _ready(self) -> Iterator[Pair]:
        """Yield the pairs that wait for nothing."""
        if self._waits and self._is_estimated and not self._knows_first_seconds():
            return
        until_ns = inf
        if self._waits and self.latency.seconds > 0:
            until_ns = self._tracks.newest_ns - self.latency.seconds * 1e9
        while self._waiting:
            first = self._waiting[0]
            if first.boxes.stamp_ns > until_ns and not first.reason:
                return
            yield self._pop_corrected()

    def _knows_first_seconds(self) -> bool:
        """Return whether boxes have waited long enough for the latency to be known."""
        if not self._is_begun and self._first_ns is not None:
            seconds = (self._tracks.newest_ns - self._first_ns) * 1e-9
            sweeps = {id(pair.sweep): pair.sweep for pair in self._waiting}.values()
            points = sum(len(sweep.points) for sweep in sweeps if sweep is not None)
            self._is_begun = seconds >= FIRST_SECONDS or points >= FIRST_POINTS
        return self._is_begun

    def _pop_corrected(self) -> Pair:
        """Return the first pair that waits, in time."""
        pair = self._waiting[0]
        latency = self.latency.seconds
        if latency and not pair.reason:
            moved = self._tracks.at_stamp(pair.boxes, latency)
            pair = pair._replace(boxes=replace(pair.boxes, boxes=moved))
        self._waiting.popleft()  # only now: an error loses no boxes
        return pair


def _costs(path: _Path, points: Floats, times: Floats) -> Floats | None:
    """Return the costs (2, C) of the boxes of a path; None with too few points."""
    costs = np.empty((2, len(path.boxes)))
    velocity = path.velocities.mean(0)
    is_known = fill_costs(points, times, velocity, path.boxes, FEWEST_POINTS, costs)
    return costs if is_known else None


class _Near(NamedTuple):
    """Points (3, M) around the boxes of a path, above the road, their times (M,), and LiDAR."""

    points: Floats
    times: Floats
    sensor: int


def _points_near(sweep: Sweep, paths: Sequence[_Path]) -> list[_Near]:
    """Return the points around the boxes of each path."""
    if not paths:
        return []
    around = _boxes_around(np.array([path.boxes for path in paths]))
    near = crop(sweep, around, 0.0)
    ends = np.searchsorted(near.owner, np.arange(len(paths) + 1)).tolist()
    found = []
    for path, (first, last) in enumerate(pairwise(ends)):
        stride = max(1, -(-(last - first) // POINTS_COMPARED))
        kept = slice(first, last, stride)
        rows = near.row[kept]
        points = np.ascontiguousarray(near.offset[:, kept] + around[path, : Z + 1, None])
        times = np.zeros(len(rows))
        if sweep.times is not None:
            times[:] = sweep.times[rows]
        sensor = 0
        if sweep.sensors is not None and len(rows):
            sensor = int(np.bincount(sweep.sensors[rows]).argmax())
        found.append(_Near(points, times, sensor))
    return found


def _boxes_around(boxes: Floats) -> Floats:
    """Return boxes (K, 9) that each hold the boxes (K, C, 9) of a path, less the road below."""
    centers = boxes[..., : Z + 1]
    found = np.zeros((len(boxes), boxes.shape[2]))
    found[:, : Z + 1] = centers.mean(1)
    shift = _shift(centers)
    heading = np.arctan2(shift[:, Y], shift[:, X])
    x, y, _ = (centers - found[:, None, : Z + 1]).transpose(2, 1, 0)  # (C, K) each
    cos, sin = np.cos(heading), np.sin(heading)
    along, across = np.abs(cos * x + sin * y).max(0), np.abs(cos * y - sin * x).max(0)
    found[:, BOX_EXTENT] = boxes[:, 0, BOX_EXTENT]
    found[:, LENGTH] += 2 * (along + PATH_REACH)
    found[:, LENGTH + 1] += 2 * (across + PATH_REACH)
    found[:, Z] += ROAD_CLEARANCE
    found[:, YAW] = heading
    return found


def _differ(older: _Comparisons, newer: _Comparisons) -> bool:
    """Return whether the newer comparisons show another latency than the older ones."""
    before, after = _estimated(older), _estimated(newer)
    if before.finding or after.finding:
        return False
    assert before.estimated is not None and after.estimated is not None
    assert before.deviation is not None and after.deviation is not None
    drift = abs(after.estimated - before.estimated)
    return drift >= NOTABLE + SIGNIFICANCE * float(np.hypot(before.deviation, after.deviation))


def _lidars_apart(samples: Collection[_Sample]) -> str:
    """Return which LiDAR shows another latency than one before it, and by how much; or ''."""
    of_sensor: dict[int, list[_Sample]] = {}
    for sample in samples:
        of_sensor.setdefault(sample.sensor, []).append(sample)
    if len(of_sensor) < 2:
        return ''
    known = {sensor: _Comparisons.of(some) for sensor, some in sorted(of_sensor.items())}
    for one, other in combinations(known, 2):
        before, after = _estimated(known[one]), _estimated(known[other])
        is_known = min(before.tracks, after.tracks) >= MIN_OF_LIDAR
        is_late = before.seconds or after.seconds  # by itself, it would be corrected
        if is_known and is_late and _differ(known[one], known[other]):
            assert before.estimated is not None and after.estimated is not None
            apart = after.estimated - before.estimated
            return (
                f'LiDAR {other + 1} (in the order of points) that are {abs(apart):.2f} s '
                f'{"behind" if apart > 0 else "ahead of"} those of LiDAR {one + 1}'
            )
    return ''


def _estimated(known: _Comparisons) -> Latency:
    """Return the latency of least cost by some comparisons; each track has one weight."""
    if not len(known.tracks):
        return Latency(finding=NOTHING_MOVES)
    order = np.argsort(known.tracks, kind='stable')
    _, first, counts = np.unique(known.tracks[order], return_index=True, return_counts=True)
    costs = np.add.reduceat(known.costs[order], first)  # (n, 2, C), the sums of n tracks
    # The mean of each track, less for one that was compared a few times only.
    costs /= np.maximum(counts, FULL_WEIGHT)[:, None, None]
    n = len(costs)
    constant = CONSTANT_ERROR / known.speeds.mean() / np.sqrt(n)
    ways = _minima_and_jackknife(costs)
    ways[:, 1] = np.hypot(ways[:, 1], constant)
    way = _way(costs, ways)
    estimated, deviation = ways[way].tolist()
    found = Latency(0.0, '', estimated, deviation, n)
    is_significant = abs(estimated) >= max(NOTABLE, SIGNIFICANCE * deviation)
    is_inside = CANDIDATES[0] < estimated < CANDIDATES[-1]  # at the ends it is no minimum
    is_usable = deviation <= max(USABLE_DEVIATION, USABLE_PART * abs(estimated))
    if is_significant and is_usable and _fits_better(costs[:, way]):
        if is_inside:
            return found._replace(seconds=estimated)
        return found._replace(is_beyond=True, finding='it is beyond what is compared')
    if deviation > USABLE_DEVIATION or is_significant:
        found = found._replace(
            finding=f'the latency of the boxes is not known: {estimated:.2f} s with a deviation '
            f'of {deviation:.2f} s, by {n} moving objects'
        )
    return found


def _as_stamped(found: Latency, offsets: Floats) -> Latency:
    """
    Return a latency with the nearest of some `offsets` (n,) [s], if the estimate agrees with it.

    Boxes whose stamps have a constant offset from their sweep are late by exactly that. Within
    `SIGNIFICANCE` deviations of the estimate it is more precise. If the estimate is below
    `NOTABLE`, the offset is used where it fits better than no latency by `GAIN` deviations.

    """
    if found.estimated is None or found.deviation is None or not len(offsets):
        return found
    offset = float(offsets[np.abs(offsets - found.estimated).argmin()])
    errors = np.array([found.estimated, found.estimated - offset]) / found.deviation
    in_time, as_stamped = np.square(errors).tolist()
    is_known = bool(found.seconds) or (
        abs(found.estimated) < NOTABLE
        and found.deviation <= USABLE_DEVIATION
        and in_time - as_stamped >= GAIN**2
    )
    if is_known and abs(offset) >= STEP and as_stamped <= SIGNIFICANCE**2:
        return found._replace(seconds=offset)
    return found


def _way(costs: Floats, ways: Floats) -> int:
    """
    Return whether boxes are of the stamp (1), or of the times when points were seen (0).

    By costs (n, 2, C) of tracks, and the latency and its deviation of each way, (2, 2). Boxes in
    time in one way have a latency in the other: the smaller one is taken, unless it is one, too,
    and the boxes fit better in the other way.

    """
    smaller = int(np.abs(ways[:, 0]).argmin())
    seen, at_stamp = costs.sum(0).argmin(1)
    better = costs[:, 0, seen] - costs[:, 1, at_stamp]  # at the stamp, for each track
    is_late = abs(ways[smaller, 0]) >= SIGNIFICANCE * ways[smaller, 1]
    if is_late and abs(better.sum()) > PREFERENCE * np.sqrt(np.square(better).sum()):
        return int(better.sum() > 0)
    return smaller


def _fits_better(costs: Floats) -> bool:
    """
    Return whether the tracks of costs (n, C) fit better at the minimum than in time.

    They do not if they have another minimum in time: those in a row, as parked cars, fit again
    where their vehicle has passed one more.

    """
    total = costs.sum(0)
    in_time, least = int(np.abs(CANDIDATES).argmin()), int(total.argmin())
    second = in_time - 1 + int(total[in_time - 1 : in_time + 2].argmin())
    first, last = sorted((second, least))
    if total[first : last + 1].max() - total[second] > SECOND_MINIMUM * np.ptp(total):
        return False
    gain = costs[:, in_time] - costs[:, least]  # of each track
    # The mean is `GAIN` times its deviation s / sqrt(n) where the sum is so many root sums of
    # squares. A single track has no spread, and a ratio of 1.
    n = len(costs)
    ratio = GAIN * np.sqrt(n / (n - 1 + GAIN**2)) - 1e-9
    return bool(gain.sum() > ratio * np.sqrt(np.square(gain).sum()))


def _minima_and_jackknife(costs: Floats) -> Floats:
    """Return the candidates of least cost of all tracks, (n, 2, C), and deviations [s]: (2, 2)."""
    n = len(costs)
    total = costs.sum(0)
    others = _minima((total - costs).reshape(2 * n, -1)).reshape(n, 2)
    spread = (n - 1) / n * np.square(others - others.mean(0)).sum(0)
    return np.stack([_minima(total), np.sqrt(spread)], axis=1)


def _minima(costs: Floats) -> Floats:
    """Return the minima (n,) [s] of costs (n, C), by parabolas through the least and the next."""
    least = costs.argmin(1)
    middle = least.clip(1, costs.shape[1] - 2)
    rows = np.arange(len(costs))
    before, at, after = (costs[rows, middle + k] for k in (-1, 0, 1))
    curvature = before - 2 * at + after
    is_minimum = (least == middle) & (curvature > 0)
    shift = np.where(is_minimum, before - after, 0.0) / np.where(is_minimum, 2 * curvature, 1.0)
    step = CANDIDATES[1] - CANDIDATES[0]
    found: Floats = CANDIDATES[least] + step * shift
    return found
