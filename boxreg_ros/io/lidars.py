"""
Several LiDARs: the positions of those that measured a cloud, and clouds merged by time.

Both are the same for the live node and for recordings. A cloud that is concatenated from those of
several LiDARs is divided among them by `SensorPlacement`. Clouds of several topics are brought
into the fixed frame, each by the pose of its own stamp, and merged by `SweepMerger`.

"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from boxreg_ros.errors import ConfigError, TransformUnavailable, UnsupportedMessage
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.options import option
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import Floats, Sweep
from msg_adapters import clouds, concatenation, pointcloud
from msg_adapters.concatenation import ConcatenationInfo
from msg_adapters.point_layout import AUTO, TIME_UNIT_CHOICES
import numpy as np
from numpy.typing import NDArray

INFO_CAPACITY = 200
"""Info messages held; derived: 10 s at 20 Hz, and each arrives within 2 s of its cloud."""
LIDAR_SILENCE = 1.0
"""A LiDAR without a cloud in so long is not waited for [s]; chosen: ten periods at 10 Hz."""
MAX_OPEN_GROUPS = 2
"""
Sweeps that wait for clouds at once; chosen.

A cloud may arrive after the first cloud of the next period, but not after two periods.

"""
PERIOD_STAMPS = 6
"""Stamps that the period of the clouds is taken from; chosen."""
WHOLE_REVOLUTION = 0.9
"""Part of its length that times over a whole revolution have; chosen: ends are not measured."""
LONG_SWEEP = 0.25
"""Longer sweeps are not read as such before the period is known [s]; slow LiDARs have 5 Hz."""
SHORTEST_REVOLUTION = 0.02
"""Shorter revolutions no LiDAR has [s]; derived: 50 Hz, the fastest of those with 3D have 30."""
TURNING = 0.95
"""Correlation of azimuth and time of points in their order; chosen: rows are degrees apart."""
TURN_POINTS = 1000
"""Points that it is taken of; chosen."""
MAX_REVOLUTIONS = 1.5
"""Length of times, in periods of clouds, that no sweep has; chosen: clouds overlap a little."""
MAX_PERIOD = 0.5
"""Period from which times over a second may be those of the clouds [s]: they overlap at most."""
CLOUD_MERGED, CLOUD_LATE, CLOUD_MISSING = 'merged', Reason.CLOUD_LATE, Reason.CLOUD_MISSING
"""Counters of a LiDAR; the last two are reasons of `boxreg_ros.reasons`."""

Report = Callable[[Reason, str, int], None]
"""Takes reason, text and count of something that is not used."""


def ignore(reason: Reason, text: str, count: int) -> None:
    """Report nothing."""


@dataclass(frozen=True, slots=True)
class Lidars:
    """
    Topics of the clouds, and frames of the LiDARs that measured them.

    `topics` are merged; empty stands for the only one. `frames` are those of each topic, or of all
    LiDARs of a single topic; empty if each cloud is in the frame of its LiDAR.

    Raises ConfigError if the number of frames is not that of several topics, a topic is named
    twice, or info messages are expected for several topics.

    """

    topics: tuple[str, ...] = option(
        (),
        'topic of the point clouds (default: found by type); repeat it to merge the clouds of '
        'several LiDARs',
        flag='--points',
        metavar='TOPIC',
        is_repeated=True,
    )
    frames: tuple[str, ...] = option(
        (),
        'frame of the LiDAR where clouds are in another one: once per --points, or once per LiDAR '
        'of a single concatenated cloud',
        flag='--sensor-frame',
        metavar='FRAME',
        is_repeated=True,
    )
    info: str = option(
        '',
        'topic of ConcatenatedPointCloudInfo, which divides a concatenated cloud among its LiDARs '
        '(default: that of the clouds with _info behind it, if there is one)',
        flag='--points-info',
        metavar='TOPIC',
    )
    time_unit: str = option(
        AUTO,
        'unit of the times of the points (default: that of the layout, else by magnitude)',
        choices=TIME_UNIT_CHOICES,
    )

    def __post_init__(self) -> None:
        """Check that the parts fit each other."""
        topics, frames = self.topics, self.frames
        if len(set(topics)) < len(topics):
            raise ConfigError(
                f'points: expected each topic once, got {", ".join(topics)}; leave the second '
                f'one out'
            )
        if len(topics) > 1 and frames and len(frames) != len(topics):
            raise ConfigError(
                f'sensor_frames: expected one frame for each of the {len(topics)} topics of '
                f'points, in their order, got {len(frames)} ({", ".join(frames)}); name them '
                f'all, or none'
            )
        if len(topics) > 1 and self.info:
            raise ConfigError(
                f'points_info: expected for one topic of concatenated clouds, got the topics '
                f'{", ".join(topics)}; leave points_info out, or name the concatenated topic only'
            )


SINGLE_LIDAR = Lidars()
"""One topic, whose clouds are in the frame of their LiDAR."""


class SensorPlacement:
    """
    Find the LiDARs that measured the points of a cloud.

    State: the newest info messages of concatenated clouds, and in `layouts` the layout of the
    first cloud of each topic and how the times of its points are read; `normalised` says of which
    topics they are parts of a revolution, or of no unit. Not thread-safe.

    """

    def __init__(self, lidars: Lidars = SINGLE_LIDAR) -> None:
        self.lidars = lidars
        self.layouts: dict[str, str] = {}
        self._frames: Mapping[str, Sequence[str]] = {'': lidars.frames}
        if len(lidars.topics) > 1:
            pairs = zip(lidars.topics, lidars.frames, strict=False)  # all of them, or none
            self._frames = {topic: (frame,) for topic, frame in pairs}
        self._infos: dict[int, ConcatenationInfo] = {}
        self._is_awaited = True
        self._stamps_ns: dict[str, deque[int]] = {}
        self.normalised: dict[str, str] = {}

    def _with_times_of_sweep(self, sweep: Sweep, topic: str) -> Sweep:
        """
        Return a sweep whose times of the points are those within it.

        Some drivers number the points over a revolution, from 0 to 1, in degrees or in ticks. No
        sweep is longer than the period of the clouds: times from about 0 on that are longer are
        such parts, and are scaled to it. So are times in the order of the azimuth over a whole
        revolution that is too long, or shorter than any. As long as the period is not known,
        points with such times have none.

        """
        stamps_ns = self._stamps_ns.setdefault(topic, deque(maxlen=PERIOD_STAMPS))
        stamps_ns.append(sweep.stamp_ns)
        times = sweep.times
        if times is None or not len(times):
            return sweep
        low, high = float(times.min()), float(times.max())
        is_short = high - low < SHORTEST_REVOLUTION
        if not is_short and high - low <= LONG_SWEEP:
            return sweep
        is_from_stamp = not is_short and 0 <= low < (1 - WHOLE_REVOLUTION) * high
        if not is_from_stamp and not _is_one_turn(sweep.points, times):
            return sweep
        if len(stamps_ns) < 2:
            return replace(sweep, times=None)
        periods = np.diff(sorted(stamps_ns)) * 1e-9
        period = float(np.median(periods))
        extent = high if is_from_stamp else high - low
        is_sweep = not is_short and extent < MAX_REVOLUTIONS * periods.max()
        if is_sweep or not 0 < period < MAX_PERIOD:
            return sweep
        whole = 1.0 if is_from_stamp and WHOLE_REVOLUTION < high <= 1 else extent
        self.normalised[topic] = (
            f'times of the points{f" of {topic}" if topic else ""} run over {high - low:.2g} s, '
            f'while clouds come every {period:.3f} s: they are parts of a revolution, and are '
            f'read as such'
        )
        return replace(sweep, times=times * (period / whole))

    def frame_of(self, msg: Any, topic: str) -> str:
        """Return the frame of a cloud; where it is empty, the one that is named for its LiDAR."""
        frame: str = clouds.header_of(msg).frame_id.lstrip('/')
        if frame:
            return frame
        named = self._frames.get(topic if len(self.lidars.topics) > 1 else '', ())
        return named[0] if len(named) == 1 else ''

    def sweep_of(self, msg: Any, topic: str) -> Sweep:
        """
        Return the sweep of a cloud, with its topic if there are several.

        Parameters
        ----------
        msg : message
            Of a type of `CLOUD_TYPES`.
        topic : str
            That it was received on.

        Returns
        -------
        sweep : Sweep
            Finite points in the frame of the message [m], or in that named for the LiDAR where the
            message has none; times relative to the stamp [s]. With info messages `rows` has the
            places of the points in the message.

        Raises
        ------
        UnsupportedMessage
            If it cannot be read, or its points are not in the order of the infos.

        """
        if self.lidars.info and clouds.is_reordered(msg):
            raise UnsupportedMessage(
                f'expected points in the order that {self.lidars.info!r} counts them, got a cloud '
                f'that Draco has sorted; publish it by zstd, or by Draco with encode_method 2 and '
                f'force_quantization false'
            )
        cloud = clouds.plain(msg)
        unit = self.lidars.time_unit
        if topic not in self.layouts:
            self.layouts[topic] = pointcloud.described(cloud, unit)
            if pointcloud.NOT_USED in self.layouts[topic]:
                self.normalised[topic] = (
                    f'clouds{f" of {topic}" if topic else ""}: {self.layouts[topic]}; all points '
                    f'count as measured at the stamp: state the unit with --time-unit (node: '
                    f'time_unit) if it is another'
                )
        sweep = self._with_times_of_sweep(pointcloud.from_msg(cloud, unit), topic)
        if not sweep.frame_id:
            sweep = replace(sweep, frame_id=self.frame_of(msg, topic))
        if self.lidars.info:
            return replace(sweep, rows=pointcloud.finite_rows(cloud))
        return replace(sweep, topic=topic) if len(self.lidars.topics) > 1 else sweep

    def add_info(self, msg: Any) -> None:
        """Add a ``ConcatenatedPointCloudInfo``."""
        info = concatenation.from_msg(msg)
        self._is_awaited = True
        self._infos[info.stamp_ns] = info
        if len(self._infos) > INFO_CAPACITY:
            del self._infos[next(iter(self._infos))]

    def awaits_info(self, sweep: Sweep) -> bool:
        """Return whether the info message of a cloud may still arrive."""
        return self.lidars.info != '' and self._is_awaited and sweep.stamp_ns not in self._infos

    def last_stamp_ns(self, sweep: Sweep) -> int:
        """Return the newest stamp that the transforms of a cloud are needed for [ns]."""
        info = self._infos.get(sweep.stamp_ns)
        stamps_ns = [] if info is None else [part.stamp_ns for part in info.sources]
        return max([sweep.stamp_ns, *stamps_ns])

    def placed(self, sweep: Sweep, tree: TransformTree) -> tuple[Sweep, Reason | None, str]:
        """
        Return a cloud with the positions of its LiDARs, each at the stamp of its own part.

        Points of a concatenated cloud without an info message are attributed to the nearest of the
        LiDARs that are named: the one with the densest points, and rarely blocked by the vehicle.

        Parameters
        ----------
        sweep : Sweep
            In the fixed frame, as of `sweep_of` before.
        tree : TransformTree
            Has the poses of the LiDARs.

        Returns
        -------
        sweep : Sweep
            With `origin`, or with `origins` and `sensors` of several LiDARs [m]; unchanged where
            nothing is known of them.
        reason : Reason or None
            Why nothing is known; None if all is well.
        detail : str
            The info message or the transform that is missing; empty if all is well.

        """
        if self.lidars.info and not sweep.is_dropped:
            info = self._infos.get(sweep.stamp_ns)
            if info is None:
                self._is_awaited = False  # later ones do not wait until there is one again
                return (
                    sweep,
                    Reason.CLOUD_WITHOUT_INFO,
                    f'no info of the cloud at {sweep.stamp_ns} ns',
                )
            return _divided(sweep, info, tree)
        frames = self._frames.get(sweep.topic, ())
        if not frames or sweep.is_dropped:
            return sweep, None, ''
        try:
            origins = _positions([(frame, sweep.stamp_ns) for frame in frames], sweep, tree)
        except TransformUnavailable as error:
            return sweep, Reason.SENSOR_WITHOUT_TRANSFORM, str(error)
        if len(frames) == 1:
            return replace(sweep, origin=origins[0]), None, ''
        return _with_sensors(sweep, origins, _nearest(sweep.in_frame().points, origins)), None, ''


def _positions(sensors: Sequence[tuple[str, int]], sweep: Sweep, tree: TransformTree) -> Floats:
    """Return the origins (K, 3) of frames at stamps [ns], in the frame of a cloud [m]."""
    return np.array(
        [tree.lookup(sweep.frame_id, frame, stamp_ns)[:3, 3] for frame, stamp_ns in sensors]
    )


def _nearest(points: NDArray[np.floating], origins: Floats) -> NDArray[np.uint8]:
    """Return the row of the sensor that is nearest to each point in the ground plane, (M,)."""
    squares = [np.square(points[:, :2] - origin[:2]).sum(axis=1) for origin in origins]
    nearest: NDArray[np.uint8] = np.argmin(squares, axis=0).astype(np.uint8)
    return nearest


def _with_sensors(sweep: Sweep, origins: Floats, sensors: NDArray[np.uint8]) -> Sweep:
    return replace(sweep, origin=origins.mean(axis=0), origins=origins, sensors=sensors)


def _is_one_turn(points: NDArray[np.floating], times: Floats) -> bool:
    """Return whether points (M, 3) by their times (M,) go around the LiDAR once."""
    rows = np.argsort(times)[:: max(1, len(times) // TURN_POINTS)]
    x, y, _ = points[rows].T
    is_away = np.hypot(x, y) > 0  # of no return there are zeros
    azimuth = np.unwrap(np.arctan2(y, x)[is_away])
    if len(azimuth) < 2 or not 0.9 <= abs(azimuth[-1] - azimuth[0]) / (2 * np.pi) <= 1.1:
        return False
    return abs(float(np.corrcoef(azimuth, times[rows][is_away])[0, 1])) >= TURNING


def _divided(
    sweep: Sweep, info: ConcatenationInfo, tree: TransformTree
) -> tuple[Sweep, Reason | None, str]:
    """
    Return a concatenated cloud with the positions and times of its LiDARs; as of `placed`.

    The concatenation has compensated the motion of the vehicle: the points are where the LiDARs
    measured them, each at its own stamp and position. Their times, if any, are relative to the
    stamps of the LiDARs.

    """
    rows = np.arange(len(sweep.points)) if sweep.rows is None else sweep.rows
    parts = info.sources
    ends = [part.begin + part.length for part in parts]
    if len(rows) and (not ends or max(ends) <= rows.max()):
        reason = (
            f'the info at {info.stamp_ns} ns is of {max(ends, default=0)} points, its cloud has'
        )
        return sweep, Reason.CLOUD_WITHOUT_INFO, f'{reason} {rows.max() + 1}'
    if not parts:
        return sweep, None, ''
    try:
        origins = _positions([(part.frame_id, part.stamp_ns) for part in parts], sweep, tree)
    except TransformUnavailable as error:
        return sweep, Reason.SENSOR_WITHOUT_TRANSFORM, str(error)
    owner = np.zeros(max(ends), np.uint8)
    for number, part in enumerate(parts):
        owner[part.begin : part.begin + part.length] = number
    sensors = owner[rows]
    delays = np.array([part.stamp_ns - sweep.stamp_ns for part in parts]) * 1e-9
    times = delays[sensors]
    if sweep.times is not None:
        times = times + sweep.times
    return replace(_with_sensors(sweep, origins, sensors), times=times, rows=None), None, ''


class MergedSweep(NamedTuple):
    """A merged sweep, and the `extra` objects of its clouds, in their order."""

    sweep: Sweep
    extras: tuple[Any, ...]


_Period = dict[str, tuple[Sweep, Any]]
"""Clouds of one period, by topic, with the `extra` object of each."""


class SweepMerger:
    """
    Merge the clouds of several LiDARs into one sweep per period.

    A sweep has at most one cloud of each topic, and their stamps are within `span` [s]. It is
    complete with a cloud of every LiDAR that was heard in the last second, also where that cloud
    was late by less than `span`, as the first of a LiDAR that begins after the others; without
    one of them it is returned once a later sweep is complete, or two later ones have begun. After
    a complete sweep the LiDARs keep their order within a period, so that a lost cloud shifts no
    pairs. The rule reads stamps and the order of arrival only, no clock. A sweep has the stamp of
    the first topic in it, in the order of `topics`; the times of its points are relative to that.

    `report` is called for each cloud that is late, and each that a sweep lacks; `counts` has them
    by topic and reason, beside those ``merged``.

    """

    def __init__(self, topics: Sequence[str], span: float, report: Report) -> None:
        self._topics = topics
        self._span_ns = round(span * 1e9)
        self._report = report
        self.counts = {topic: Counter[str]() for topic in topics}
        self._left_out = set[str]()
        self.forget()

    def forget(self) -> None:
        """Forget all clouds; keep the counts."""
        self._groups: list[_Period] = []  # ascending by stamp
        self._heard_ns: dict[str, int] = {}
        self._offsets_ns: dict[str, int] = {}  # of the LiDARs in the last sweep, if complete
        self._returned_ns: dict[str, int] = {}  # of the clouds in the last sweep, by topic
        self._last_ns = 0  # stamp of the last sweep

    def add(self, sweep: Sweep, extra: Any = None) -> list[MergedSweep]:
        """
        Add a cloud of one LiDAR.

        Parameters
        ----------
        sweep : Sweep
            In the fixed frame, with its topic.
        extra : object
            Returned with the merged sweep.

        Returns
        -------
        list of MergedSweep
            Those that are complete now, by their stamps. A cloud that comes after the others of
            its time were merged is reported and left out.

        """
        group = self._group_for(sweep)
        if group is None:
            self._note(
                sweep.topic,
                CLOUD_LATE,
                f'a cloud of {sweep.stamp_ns} ns arrived after the others of its time were merged',
            )
            heard_ns = self._heard_ns[sweep.topic]
            if sweep.stamp_ns >= max(self._returned_ns.values(), default=0) - self._span_ns:
                self._heard_ns[sweep.topic] = max(heard_ns, sweep.stamp_ns)  # awaited from now on
            return []
        group[sweep.topic] = sweep, extra
        if not self._heard_ns:  # those that have not been heard are waited for at the start
            self._heard_ns = dict.fromkeys(self._topics, sweep.stamp_ns)
        self._heard_ns[sweep.topic] = sweep.stamp_ns
        return self._pop_complete()

    def leave_out(self, sweep: Sweep) -> list[MergedSweep]:
        """Count a cloud of another clock; the first of its LiDAR returns the sweeps without it."""
        self._note(sweep.topic, CLOUD_LATE, f'a cloud of {sweep.stamp_ns} ns is of another clock')
        if sweep.topic in self._left_out:
            return []
        self._left_out.add(sweep.topic)
        others = [self._merged(group) for group in self._groups if sweep.topic not in group]
        self.forget()  # its stamps, beside which those of the others are late
        return others

    def flush(self) -> list[MergedSweep]:
        """Return all sweeps that are held, complete or not."""
        return self._pop(len(self._groups))

    def _group_for(self, sweep: Sweep) -> _Period | None:
        """
        Return the group that takes a cloud, a new one, or None for a late cloud.

        Of several it is the oldest, unless another one is nearer by more than half of the span: a
        slow LiDAR has no cloud in some periods.

        """
        groups = [group for group in self._groups if self._takes(group, sweep)]
        distances_ns = [abs(_first_ns(group) - sweep.stamp_ns) for group in groups]
        for group, distance_ns in zip(groups, distances_ns, strict=True):
            if distance_ns <= min(distances_ns) + self._span_ns // 2:
                return group
        if self._is_late(sweep):
            return None
        place = sum(_first_ns(group) < sweep.stamp_ns for group in self._groups)
        self._groups.insert(place, {})
        return self._groups[place]

    def _is_late(self, sweep: Sweep) -> bool:
        """Return whether sweeps of its time were returned, or all that wait are far later."""
        if self._groups and sweep.stamp_ns < _first_ns(self._groups[0]) - self._span_ns:
            return True
        returned_ns = self._returned_ns
        if not returned_ns:
            return False
        own_ns = returned_ns.get(sweep.topic)
        if own_ns is None:
            return sweep.stamp_ns <= max(returned_ns.values())
        return sweep.stamp_ns <= max(own_ns, self._last_ns)

    def _takes(self, group: _Period, sweep: Sweep) -> bool:
        """
        Return whether a cloud belongs to a group: the first of its topic, within the span.

        Where the offsets of the LiDARs from the begin of a period are known, it also has to be of
        the same period by these: where the cloud before it is lost, one of the next period may be
        within the span, too.

        """
        stamps_ns = [sweep.stamp_ns, *(other.stamp_ns for other, _ in group.values())]
        if sweep.topic in group or max(stamps_ns) - min(stamps_ns) > self._span_ns:
            return False
        offsets_ns = self._offsets_ns
        topic, (other, _) = next(iter(group.items()))
        if topic not in offsets_ns or sweep.topic not in offsets_ns:
            return True
        begin_ns = other.stamp_ns - offsets_ns[topic]
        return abs(sweep.stamp_ns - offsets_ns[sweep.topic] - begin_ns) <= self._span_ns // 2

    def _pop_complete(self) -> list[MergedSweep]:
        complete = [i for i, group in enumerate(self._groups) if not self._awaited(group)]
        count = complete[-1] + 1 if complete else 0
        return self._pop(max(count, len(self._groups) - MAX_OPEN_GROUPS))

    def _awaited(self, group: _Period) -> list[str]:
        """Return the topics without a cloud in a group that are not silent."""
        oldest_ns = _first_ns(group) - round(LIDAR_SILENCE * 1e9)
        lacking = [topic for topic in self._topics if topic not in group]
        return [topic for topic in lacking if self._heard_ns[topic] >= oldest_ns]

    def _pop(self, count: int) -> list[MergedSweep]:
        groups = self._groups[:count]
        del self._groups[:count]
        return [self._merged(group) for group in groups]

    def _merged(self, group: _Period) -> MergedSweep:
        first_ns = _first_ns(group)
        for topic in self._topics:
            if topic in group:
                self.counts[topic][CLOUD_MERGED] += 1
            else:
                self._note(topic, CLOUD_MISSING, f'no cloud at {first_ns} ns')
        self._returned_ns = {topic: sweep.stamp_ns for topic, (sweep, _) in group.items()}
        self._offsets_ns = {}
        if not self._awaited(group):
            self._offsets_ns = {t: sweep.stamp_ns - first_ns for t, (sweep, _) in group.items()}
        clouds = [group[topic] for topic in self._topics if topic in group]
        self._last_ns = clouds[0][0].stamp_ns
        there = [cloud for cloud in clouds if not cloud[0].is_dropped]
        if not there:
            return MergedSweep(clouds[0][0], ())
        sweeps, extras = zip(*there, strict=True)
        return MergedSweep(merged(sweeps), extras)

    def _note(self, topic: str, reason: Reason, text: str) -> None:
        self.counts[topic][reason] += 1
        self._report(reason, f'{topic}: {text}; the other LiDARs are used', 1)


def _first_ns(group: _Period) -> int:
    """Return the oldest stamp of a group [ns]."""
    return min(sweep.stamp_ns for sweep, _ in group.values())


def merged(sweeps: Sequence[Sweep]) -> Sweep:
    """Return one sweep of clouds that are in the same frame, with the stamp of the first."""
    stamp_ns = sweeps[0].stamp_ns
    delays = [(sweep.stamp_ns - stamp_ns) * 1e-9 for sweep in sweeps]
    times = None
    if any(delays) or any(sweep.times is not None for sweep in sweeps):
        times = np.concatenate(
            [_times(sweep, delay) for sweep, delay in zip(sweeps, delays, strict=True)]
        )
    origins = [sweep.origin[None] if sweep.origins is None else sweep.origins for sweep in sweeps]
    first = np.cumsum([0, *map(len, origins)])[:-1]
    sensors = [_sensors(sweep, number) for sweep, number in zip(sweeps, first, strict=True)]
    stacked = np.concatenate(origins)
    return replace(
        sweeps[0],
        points=np.concatenate([sweep.in_frame().points.T for sweep in sweeps], axis=1).T,
        times=times,
        origin=stacked.mean(axis=0),
        origins=stacked,
        sensors=np.concatenate(sensors),
        topic='',
        rows=None,
        T_frame_points=None,
    )


def _times(sweep: Sweep, delay: float) -> Floats:
    """Return the times of the points of a sweep (M,) with a delay added [s]."""
    times = np.zeros(len(sweep.points)) if sweep.times is None else sweep.times
    return times + delay


def _sensors(sweep: Sweep, first: int) -> NDArray[np.uint8]:
    """Return the sensor of each point (M,), counted from `first`."""
    if sweep.sensors is None:
        return np.full(len(sweep.points), first, np.uint8)
    return (sweep.sensors + first).astype(np.uint8)
