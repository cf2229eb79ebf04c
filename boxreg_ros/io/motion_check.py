"""
Check of the motion of the sensors: frames that jump, clocks, and mistakes of publishers of TF.

The same for the live node and for recordings. `JumpSearch` finds the corrections of a localisation
in the transforms above the frame that moves smoothly; `MotionCheck` watches the transforms that
clouds and boxes are moved by.

"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from statistics import fmean, median

from boxreg_ros.errors import TransformUnavailable
from boxreg_ros.io.clocks import (
    CAPACITY,
    clock_offset,
    COPY_NS,
    likely_offset,
    MIN_CLOCK_OFFSET,
    MIN_PAIRS,
    ReceiveTimes,
    seconds_text,
)
from boxreg_ros.io.findings import Finding
from boxreg_ros.io.transform_edge import Edge, MAX_LINEAR_GAP
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.io.transforms import inverse, matrix
from boxreg_ros.reasons import Reason
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import BoxArray, Floats, Sweep
import numpy as np

MIN_STEP = 0.15
"""
Smallest step between two samples of a transform that is a correction [m].

Chosen: the error of a detected centre is of this size, that of a localisation between corrections
a third of it.

"""
STEP_RADIUS = 20.0
"""Distance from the sensor at which a rotation counts as a step [m]; chosen: that of objects."""
MIN_STEP_ANGLE = MIN_STEP / STEP_RADIUS
"""Smallest turn between two samples that is one [rad]."""
MAX_EGO_SPEED = 100.0
"""Speed that no vehicle has [m/s]; derived: 360 km/h."""
MAX_EGO_ACCELERATION = 20.0
"""Acceleration that no vehicle has [m/s^2]; derived: tyres transmit that of gravity, and twice."""
MAX_EGO_YAW_ACCELERATION = 5.0
"""
Yaw acceleration that no vehicle has [rad/s^2].

Chosen: an evasive manoeuvre has 3, a robot that begins to turn on the spot 4.

"""
MIN_ALTERNATIONS = 3
"""Samples at impossible speed that mean two publishers; chosen: one or two are a restart."""
MIN_REVERSALS = 3
"""Steps in a row, each back along the one before it, that no vehicle makes; chosen."""
MAX_BOXES_DELAY = 1.0
"""Delay of boxes after their clouds that is reported [s]; a live detector takes 0.1 to 0.5 s."""
MIN_COPIED = 0.5
"""Part of the stamps that are those of clouds by which one clock has set both; chosen."""
LATE_ODOMETRY = ', unless it is computed from these clouds, whose stamps it has, and comes late'
LOOK_PERIOD = 10
"""Clouds between two looks at what changes slowly; chosen: 1 s at 10 Hz."""
SETTLED_CLOUDS = 15
"""Clouds by which an offset of clocks that was found at the first look is confirmed; chosen."""
SHORT_PERIOD = 0.9
"""Period of clouds that do not all come at the begin of a second [s]; chosen: some may at 1 Hz."""
FIRST_LOOK = 5
"""Cloud of the first look, for short recordings."""
MIN_JITTER = 0.03
"""
Standard deviation of the position of the sensor that is reported [m].

Chosen: boxes lose .02 of 3D IoU by it, and all of their gain by twice as much; drives have 0.001.

"""
MIN_YAW_JITTER = 0.01
"""That of its yaw [rad]; chosen: boxes lose .02 of 3D IoU by it, and all of their gain by 0.02."""
YAW_JITTER_SCALE = 2.33
"""Standard deviation of yaw over the mean of `PoseJitter`; derived by simulation."""
MIDDLE_STEPS = 0.9
"""Part of the steps of yaw, the smallest ones, in this mean; chosen: the others may be jumps."""
JITTER_CLOUDS = 50
"""Newest clouds by which it is measured, and the most that are needed; chosen: 5 s."""
MIN_JITTER_CLOUDS = 30
"""Clouds by which it is reported; chosen."""
MIN_GAP = 1.0
"""Longest gap of the motion that is not reported [s]; derived: poses err by 1 to 4 cm at 1 Hz."""
MIN_CARRIED_WAY = 1.0
"""Way of the fixed frame, with the sensor, that is reported [m]; chosen: a drift is less."""
MIN_RISE = 5.0
"""Rise, more than the path in the plane, that is reported [m]; chosen: roads are not so."""
LIDAR_WORDS = (
    *('lidar', 'laser', 'velodyne', 'hesai', 'pandar', 'ouster', 'os_sensor', 'livox', 'mid360'),
    *('rslidar', 'robosense', 'innovusion', 'aeva', 'luminar', 'scan'),
)
"""Parts of the names of frames of LiDARs, by their drivers."""


@dataclass(slots=True)
class FrameSteps:
    """FrameSteps of the transform between two frames."""

    parent: str
    child: str
    unit: str = 'm'
    count: int = 0
    largest: float = 0.0
    """In metres, a rotation as the way at `STEP_RADIUS`; or rotations alone, in degrees."""
    first_ns: int = 0

    def add(self, step: float, stamp_ns: int) -> None:
        """Add a step [m] at a stamp [ns]."""
        self.first_ns = self.first_ns or stamp_ns
        self.count += 1
        self.largest = max(self.largest, step)

    def __str__(self) -> str:
        """Return number and size of the steps."""
        steps = f'{self.count} steps of up to' if self.count > 1 else 'a step of'
        return (
            f'{self.parent} -> {self.child} has {steps} {self.largest:.2f} {self.unit}, the '
            f'first at {self.first_ns} ns, as localisation makes them'
        )


@dataclass
class JumpSearch:
    """
    Search of corrections between a fixed frame and the frame that a sensor moves smoothly in.

    By REP 105 a localisation corrects ``map -> odom`` in steps, while ``odom`` is smooth. The
    lowest moving transform is the motion itself; those above it should not step.

    """

    steps: dict[tuple[str, str], FrameSteps] = field(default_factory=dict)
    """By parent and child, of the transforms that stepped."""
    alternations: dict[tuple[str, str], FrameSteps] = field(default_factory=dict)
    """FrameSteps of the motion itself that no vehicle makes: too fast, or back and forth."""
    jumps: list[tuple[tuple[str, str, str], int, int, float]] = field(default_factory=list)
    """Steps of the motion itself after which it goes on as before, displaced, until `MotionCheck`
    takes them: of parent, child and unit, the stamps before and after them, and their size."""
    _seen_ns: dict[tuple[str, str], int] = field(default_factory=dict)
    _reversals: Counter[tuple[str, str]] = field(default_factory=Counter)
    """Steps back and forth up to the last sample."""

    def look(self, tree: TransformTree, fixed_frame: str, sensor_frame: str) -> None:
        """Add the samples that are new in `tree`, between both frames."""
        route = tree.route(fixed_frame, sensor_frame)
        moving = [edge for edge in route if not tree.is_constant(edge) and _moves(edge)]
        for number, edge in enumerate(moving):
            for row in self._new_rows(edge):
                if number:
                    self._add_step(tree, edge, row, sensor_frame)
                else:
                    self._add_speed(edge, row)
                    self._add_jump(edge, row)

    def smooth_frame(self, tree: TransformTree, fixed_frame: str, sensor_frame: str) -> str:
        """Return the topmost frame on the way to the sensor that no transform below it steps."""
        for edge in tree.route(fixed_frame, sensor_frame):
            if (edge.parent, edge.child) in self.steps:
                return edge.child
        return fixed_frame

    def _new_rows(self, edge: Edge) -> range:
        """Return the rows of samples after one before them, which were not looked at."""
        key = edge.parent, edge.child
        seen_ns = self._seen_ns.get(key, -1)
        rows = range(1 + int(np.searchsorted(edge.stamps[1:], seen_ns, 'right')), len(edge.stamps))
        if edge.stamps:
            self._seen_ns[key] = edge.stamps[-1]
        return rows

    def _add_step(self, tree: TransformTree, edge: Edge, row: int, sensor_frame: str) -> None:
        """Compare a sample with the one before it, at the place of the sensor."""
        stamp_ns = edge.stamps[row]
        try:
            T_child_sensor = tree.lookup(edge.child, sensor_frame, stamp_ns)
        except TransformUnavailable:
            return
        before, after = (matrix(pose) @ T_child_sensor for pose in edge.poses[row - 1 : row + 1])
        change = inverse(before) @ after
        cosine = np.clip((np.trace(change[:3, :3]) - 1) / 2, -1, 1)
        step = float(np.linalg.norm(change[:3, 3]) + np.arccos(cosine) * STEP_RADIUS)
        if step >= MIN_STEP:
            key = edge.parent, edge.child
            self.steps.setdefault(key, FrameSteps(*key)).add(step, stamp_ns)

    def _add_speed(self, edge: Edge, row: int) -> None:
        """Note two samples of the motion that lie too far apart, or go back and forth."""
        key = edge.parent, edge.child
        step = edge.poses[row][:3] - edge.poses[row - 1][:3]
        way = float(np.linalg.norm(step))
        seconds = (edge.stamps[row] - edge.stamps[row - 1]) * 1e-9
        before = edge.poses[row - 1][:3] - edge.poses[max(row - 2, 0)][:3]
        goes_back = min(way, float(np.linalg.norm(before))) >= MIN_STEP and step @ before < 0
        self._reversals[key] = self._reversals[key] + 1 if goes_back else 0
        is_too_fast = way > MIN_STEP and way > MAX_EGO_SPEED * seconds
        if is_too_fast or self._reversals[key] >= MIN_REVERSALS:
            self.alternations.setdefault(key, FrameSteps(*key)).add(way, edge.stamps[row])

    def _add_jump(self, edge: Edge, row: int) -> None:
        """
        Note a step of the motion that no acceleration explains, two samples before the newest one.

        With acceleration a, the velocity in the middle of five steps differs from their median by
        at most a times half of their time. A single wrong sample is a step there and one back.

        """
        if row < 5 or not _is_step(*edge.poses[row - 3 : row - 1]):
            return
        stamps_ns = edge.stamps[row - 5 : row + 1]
        poses = np.array(edge.poses[row - 5 : row + 1])
        seconds = np.asarray(np.diff(stamps_ns) * 1e-9, float)
        jump = _jump_of(np.diff(poses[:, :3], axis=0), seconds, MIN_STEP, MAX_EGO_ACCELERATION)
        unit = 'm'
        if not jump:
            turns = _turns_between(poses[:, 3:])
            jump = np.degrees(_jump_of(turns, seconds, MIN_STEP_ANGLE, MAX_EGO_YAW_ACCELERATION))
            unit = 'degrees'
        if jump:
            key = edge.parent, edge.child, unit
            self.jumps.append((key, stamps_ns[2], stamps_ns[3], float(jump)))


def _is_step(one: Floats, other: Floats) -> bool:
    """Return whether two poses (7,) are as far apart as the smallest jump."""
    if np.linalg.norm(other[:3] - one[:3]) > MIN_STEP:
        return True
    first, second = one[3:], other[3:]
    cosine_squared = (first @ second) ** 2 / ((first @ first) * (second @ second))
    return bool(cosine_squared < np.cos(MIN_STEP_ANGLE / 2) ** 2)


def _jump_of(steps: Floats, seconds: Floats, least: float, acceleration: float) -> float:
    """Return how far the third of steps (5, 3) exceeds the motion around it; 0 if it may."""
    if np.linalg.norm(steps[2]) <= least:
        return 0.0
    rate = np.median(steps / seconds[:, None], axis=0)
    steps = steps - rate * seconds[:, None]
    jump = steps[2]
    limit = max(least, acceleration * seconds[2] * seconds.sum() / 2)
    pairs = jump, jump + steps[1], jump + steps[3]
    is_jump = min(map(np.linalg.norm, pairs)) > limit
    return float(np.linalg.norm(jump)) if is_jump else 0.0


def _turns_between(quaternions_xyzw: Floats) -> Floats:
    """Return the rotations (n - 1, 3) [rad] from each of n quaternions to the next one."""
    unit = quaternions_xyzw / np.linalg.norm(quaternions_xyzw, axis=1, keepdims=True)
    (v, w), (v2, w2) = ((q[:, :3], q[:, 3:]) for q in (unit[:-1], unit[1:]))
    axes = w * v2 - w2 * v - np.cross(v, v2)
    cosines = (unit[:-1] * unit[1:]).sum(axis=1, keepdims=True)
    sines = np.linalg.norm(axes, axis=1, keepdims=True)
    angles = 2 * np.arctan2(sines, np.abs(cosines)) * np.sign(cosines)
    turns: Floats = axes / np.maximum(sines, np.finfo(float).tiny) * angles
    return turns


def _moves(edge: Edge) -> bool:
    """Return whether poses differ: publishers of ROS 1 repeat static ones on /tf."""
    poses = edge.poses  # empty where all samples were unset
    return len(poses) > 0 and not np.array_equal(poses[0], poses[-1])


class PoseJitter:
    """
    Standard deviation of independent errors of the horizontal position of a sensor, per axis [m].

    Or of its yaw [rad]. With independent errors a position is off the line through those before
    and after it, and the next one is off to the other side. The smaller one of both distances has
    the standard deviation as its median; motions of vehicles go on to one side. That of a yaw,
    which goes on to the same side more often, is taken by its mean, whose variance is smaller.

    """

    def __init__(self, of_yaw: bool = False) -> None:
        self._of_yaw = of_yaw
        self._poses = deque[tuple[int, Floats]](maxlen=3)
        self._away: Floats | None = None
        self._steps = deque[float](maxlen=JITTER_CLOUDS)

    @property
    def deviation(self) -> float:
        """Return the standard deviation; 0 while it is not known."""
        count = len(self._steps)
        if count < MIN_JITTER_CLOUDS:
            return 0.0
        if not self._of_yaw:
            return median(self._steps)
        return YAW_JITTER_SCALE * fmean(sorted(self._steps)[: round(MIDDLE_STEPS * count)])

    def add(self, stamp_ns: int, position: Floats) -> None:
        """Add the next position (2,), or yaw (1,), at a stamp."""
        if self._poses and not 0 < stamp_ns - self._poses[-1][0] <= MAX_LINEAR_GAP * 1e9:
            self._poses.clear()
            self._away = None
        self._poses.append((stamp_ns, position))
        if len(self._poses) < 3:
            return
        (first_ns, first), (middle_ns, middle), (last_ns, last) = self._poses
        part = (middle_ns - first_ns) / (last_ns - first_ns)
        before, self._away = self._away, middle - first - part * (last - first)
        if before is not None:
            goes_back = self._away @ before < 0
            smaller = min(np.linalg.norm(before), np.linalg.norm(self._away))
            self._steps.append(float(goes_back * smaller))


class MotionCheck:
    """
    Watch the transforms of a stream of clouds and boxes for what makes their motion wrong.

    `findings` has what was found so far, in words, by its kind.

    """

    def __init__(self, tree: TransformTree, named_sensors: bool) -> None:
        self._tree = tree
        self._named_sensors = named_sensors
        self._jumps = JumpSearch()
        self.findings: dict[str, Finding] = {}
        self._clouds_ns = inf, -inf  # first and last stamp
        self._displaced: dict[tuple[str, str, str], FrameSteps] = {}  # that jump between clouds
        self.forget()

    def forget(self) -> None:
        """Forget when messages were received: time has jumped. What was found stays."""
        self._clouds: dict[str, ReceiveTimes] = {}  # by topic: each LiDAR may have its own clock
        self._boxes = ReceiveTimes()
        self._cloud_stamps = deque[int](maxlen=CAPACITY)
        self._copied: list[bool] = []
        self._count = 0
        self._first_milliseconds = 0
        self._jitters: dict[str, PoseJitter] = {}  # by the frame of the clouds
        self._yaw_jitters: dict[str, tuple[PoseJitter, Floats]] = {}  # with the last yaw, likewise
        # First and last position (3,), and length of the path in the plane [m], likewise.
        self._paths: dict[str, tuple[Floats, Floats, float]] = {}

    def add(self, item: Sweep | BoxArray, fixed_frame: str, received_ns: int | None) -> None:
        """
        Add a cloud or boxes, in the frame of their message.

        Parameters
        ----------
        item : Sweep or BoxArray
            As its adapter reads it.
        fixed_frame : str
            The frame that it is moved to.
        received_ns : int or None
            When it was received [ns], by the clock of the transforms; None if that is not known.

        """
        arrivals = self._boxes
        if isinstance(item, Sweep):
            arrivals = self._clouds.setdefault(item.topic, ReceiveTimes())
        if received_ns is not None:
            arrivals.add(received_ns, item.stamp_ns)
        if not isinstance(item, Sweep):
            stamps_ns = self._cloud_stamps
            if len(self._copied) < CAPACITY and stamps_ns and item.stamp_ns >= stamps_ns[0]:
                nearest = min(abs(item.stamp_ns - stamp_ns) for stamp_ns in stamps_ns)
                self._copied.append(nearest <= COPY_NS)
            return
        first_ns, last_ns = self._clouds_ns
        self._clouds_ns = min(first_ns, item.stamp_ns), max(last_ns, item.stamp_ns)
        self._cloud_stamps.append(item.stamp_ns)
        self._first_milliseconds += item.stamp_ns % 10**9 < 10**6
        self._count += 1
        if self._count == FIRST_LOOK or self._count % LOOK_PERIOD == 0:
            self._look(fixed_frame, item.frame_id)

    def add_pose(self, cloud: Sweep, fixed_frame: str, T_fixed_cloud: Floats) -> None:
        """
        Add the pose of the frame of a cloud.

        Parameters
        ----------
        cloud : Sweep
            In the frame of its message; frame and stamp are used.
        fixed_frame : str
            For the text of a finding.
        T_fixed_cloud : array, shape (4, 4)
            Pose of its frame in the fixed frame at its stamp [m].

        """
        jitter = self._jitters.setdefault(cloud.frame_id, PoseJitter())
        jitter.add(cloud.stamp_ns, T_fixed_cloud[:2, 3])
        if jitter.deviation >= MIN_JITTER and 'publishers' not in self.findings:
            text = (
                f'the position of {cloud.frame_id!r} in {fixed_frame!r} errs by '
                f'{jitter.deviation:.2f} m from cloud to cloud, back and forth: points and boxes '
                f'are displaced as much, and more where its yaw errs too; use a smoother source '
                f'of motion, with --fixed-frame or --odometry, or smooth this one'
            )
            self.findings['jitter'] = Finding(Reason.TRANSFORM_FAULT, text)
        self._add_yaw(cloud, fixed_frame, T_fixed_cloud)
        position = T_fixed_cloud[:3, 3]
        begin, last, length = self._paths.get(cloud.frame_id, (position, position, 0.0))
        length += float(np.linalg.norm(position[:2] - last[:2]))
        self._paths[cloud.frame_id] = begin, position, length
        rise = abs(position[2] - begin[2])
        if rise > max(MIN_RISE, length):
            text = (
                f'{cloud.frame_id!r} has moved by {rise:.0f} m in '
                f'{fixed_frame!r}, mostly along z: expected z up, got poses of a camera with z '
                f'ahead, as of KITTI odometry or visual SLAM, or axes of another convention: '
                f'convert them to poses of the LiDAR (with its calibration Tr of KITTI: inverse '
                f'of Tr, pose, Tr), or choose another motion with --fixed-frame or --odometry'
            )
            self.findings.setdefault('axes', Finding(Reason.TRANSFORM_FAULT, text))

    def _add_yaw(self, cloud: Sweep, fixed_frame: str, T_fixed_cloud: Floats) -> None:
        """Add the yaw of the frame of a cloud."""
        yaw = np.arctan2(T_fixed_cloud[1:2, 0], T_fixed_cloud[:1, 0])
        new = PoseJitter(of_yaw=True), yaw
        jitter, last = self._yaw_jitters.get(cloud.frame_id, new)
        yaw = last + wrap_angle(yaw - last)
        jitter.add(cloud.stamp_ns, yaw)
        self._yaw_jitters[cloud.frame_id] = jitter, yaw
        if jitter.deviation >= MIN_YAW_JITTER and 'publishers' not in self.findings:
            text = (
                f'the yaw of {cloud.frame_id!r} in {fixed_frame!r} errs by '
                f'{np.degrees(jitter.deviation):.1f} degrees from cloud to cloud, back and forth: '
                f'points and boxes are displaced by it, at {STEP_RADIUS:.0f} m by '
                f'{STEP_RADIUS * jitter.deviation:.1f} m; use a smoother source of motion, with '
                f'--fixed-frame or --odometry, or smooth this one'
            )
            self.findings.setdefault('jitter', Finding(Reason.TRANSFORM_FAULT, text))

    def _look(self, fixed_frame: str, frame: str) -> None:
        """Look at the transforms as they are now."""
        tree = self._tree
        route = tree.route(fixed_frame, frame)
        moving = [edge for edge in route if not tree.is_constant(edge)]
        self._jumps.look(tree, fixed_frame, frame)
        sensor = '' if self._named_sensors else registered_text(tree, fixed_frame, frame)
        fault, clock = Reason.TRANSFORM_FAULT, Reason.CLOCK_OFFSET
        found = {
            'jumps': Finding(Reason.FIXED_FRAME_JUMPS, self._jump_text(fixed_frame, frame)),
            'publishers': Finding(fault, self._publisher_text() or _contradiction_text(route)),
            'displaced': Finding(fault, self._displaced_text()),
            'clock': Finding(clock, self._clock_text(moving)),
            'boxes_clock': Finding(clock, self._boxes_clock_text()),
            'microseconds': Finding(clock, self._microseconds_text()),
            'sensor': Finding(Reason.SENSOR_POSITION, sensor),
            'carried': Finding(fault, _carried_text(tree, fixed_frame, frame)),
            'sparse': Finding(fault, _sparse_text(moving)),
            'gap': Finding(fault, _gap_text(moving, self._cloud_stamps)),
            'parents': Finding(fault, _parents_text(tree, route)),
            'loop': Finding(fault, _loop_text(tree, frame)),
            'once': Finding(fault, _once_text([edge for edge in route if edge not in moving])),
        }
        self.findings |= {kind: one for kind, one in found.items() if one.text}
        if 'publishers' in self.findings:
            self.findings.pop('displaced', None)
        for kind in ('clock', 'boxes_clock'):
            if not found[kind].text and len(self._received_ns) >= SETTLED_CLOUDS:
                self.findings.pop(kind, None)  # an offset of the first ones that is not constant

    def _jump_text(self, fixed_frame: str, frame: str) -> str:
        smooth = self._jumps.smooth_frame(self._tree, fixed_frame, frame)
        if smooth == fixed_frame:
            return ''
        return (
            f'the fixed frame {fixed_frame!r} jumps: {_worst(self._jumps.steps.values())}; '
            f'{smooth!r} moves smoothly: choose it with --fixed-frame {smooth} (node: '
            f'fixed_frame:={smooth})'
        )

    def _publisher_text(self) -> str:
        for steps in self._jumps.alternations.values():
            if steps.count >= MIN_ALTERNATIONS:
                return (
                    f'transform {steps.parent} -> {steps.child}: expected one motion, got '
                    f'{steps.count} jumps of up to {steps.largest:.1f} m between samples, the '
                    f'first at {steps.first_ns} ns, back and forth or faster than any vehicle: '
                    f'two publishers state it; choose another source of motion, with '
                    f'--fixed-frame or --odometry'
                )
        return ''

    def _displaced_text(self) -> str:
        """Return that the motion jumps between clouds, but for what other faults explain."""
        first_ns, last_ns = self._clouds_ns
        found, ahead = self._displaced, []
        for jump in self._jumps.jumps:
            key, before_ns, after_ns, way = jump
            if before_ns >= last_ns:  # transforms of a recording are known before its clouds
                ahead.append(jump)
            elif first_ns < after_ns:
                found.setdefault(key, FrameSteps(*key)).add(way, after_ns)
        self._jumps.jumps = ahead
        if not found or not self.findings.keys().isdisjoint(('jitter', 'publishers')):
            return ''
        turning = all(steps.unit == 'degrees' for steps in found.values())
        steps = _worst(one for one in found.values() if turning or one.unit == 'm')
        return (
            f'the motion itself jumps: {steps}: boxes of what stands still jump with it, and '
            f'their tracks are wrong there; use a source of motion without corrections, with '
            f'--odometry or --fixed-frame, or relabel the parts before and after it by '
            f'themselves, with --end and --start'
        )

    def _clock_text(self, moving: Sequence[Edge]) -> str:
        """Return how far the clock of the fastest motion is off from that of the clouds."""
        edge = max(moving, key=Edge.way, default=None)
        offsets = {} if edge is None else self._offsets_from(edge.arrivals)
        off = {topic: one for topic, one in offsets.items() if abs(one) >= MIN_CLOCK_OFFSET}
        if edge is None or not off:
            return ''
        if len(off) < len(offsets):
            return _lidars_text(off)
        measured = min(off.values(), key=abs)
        offset, names = likely_offset(measured)
        total = seconds_text(offset + self._tree.clock_offset)
        of_whom = f', as {names} are' if names else ''
        # That of a LiDAR odometry is received when it has been computed.
        may_be_late = offset > 0 and _has_copies(edge.stamps, self._cloud_stamps)
        return (
            f'clocks: expected one for clouds and motion, got stamps of the clouds '
            f'{seconds_text(abs(offset))} s {"ahead of" if offset > 0 else "behind"} those of '
            f'{edge.parent} -> {edge.child} received at the same time{of_whom}: each cloud is '
            f'placed by the pose of another moment; correct the motion with '
            f'--clock-offset={total} (node: clock_offset:={total})'
            f'{LATE_ODOMETRY if may_be_late else ""}'
        )

    @property
    def _received_ns(self) -> list[int]:
        """Return when clouds were received, of the LiDAR that most are known of."""
        return max((one.received_ns for one in self._clouds.values()), key=len, default=[])

    def _offsets_from(self, others: ReceiveTimes) -> dict[str, float]:
        """Return the offset of the clock of each LiDAR, where it is constant; `clock_offset`."""
        measured = {topic: clock_offset(clouds, others) for topic, clouds in self._clouds.items()}
        return {topic: offset for topic, offset in measured.items() if offset is not None}

    def _microseconds_text(self) -> str:
        """Return that all stamps of the clouds lie at the begins of seconds."""
        if self._first_milliseconds < max(MIN_PAIRS, self._count):
            return ''
        received = self._received_ns
        if len(received) < MIN_PAIRS or np.median(np.diff(received)) > SHORT_PERIOD * 1e9:
            return ''
        return (
            f'stamps: expected those of clouds {np.median(np.diff(received)) * 1e-9:.2g} s apart, '
            f'got all of {self._count} in the first millisecond of a second: the driver writes '
            f'microseconds into nanosec; multiply nanosec by 1000 in the headers of clouds and '
            f'boxes'
        )

    def _boxes_clock_text(self) -> str:
        """Return how far the clock of the boxes is off from that of the clouds."""
        measured = min(self._offsets_from(self._boxes).values(), key=abs, default=None)
        if measured is None or -MIN_CLOCK_OFFSET < measured < MAX_BOXES_DELAY:
            return ''
        if measured > 0 and sum(self._copied) >= MIN_COPIED * max(1, len(self._copied)):
            return ''  # a slow detector copies the stamps of its clouds
        offset, names = likely_offset(measured)
        of_whom = f', as {names} are' if names else ''
        if offset > 0:
            of_whom += ', and of no other cloud'
        shown = seconds_text(offset)
        return (
            f'clocks: expected one for clouds and boxes, got stamps of the boxes '
            f'{shown.lstrip("-")} s {"behind" if offset > 0 else "ahead of"} those of the clouds '
            f'received at the same time{of_whom}; correct them with --boxes-offset={shown} '
            f'(node: boxes_offset:={shown})'
        )


def _lidars_text(offsets: Mapping[str, float]) -> str:
    """Return which of several LiDARs have another clock, or are late, by offsets [s]."""
    parts = [
        f'{topic} is {seconds_text(abs(offset))} s {"ahead" if offset > 0 else "behind"}'
        for topic, offset in sorted(offsets.items())
    ]
    return (
        f'clocks: expected one for all LiDARs, got one that differs from those of the others and '
        f'of the motion, by messages received at the same time: {", ".join(parts)}: its clouds '
        f'are not merged with the others; synchronise the clock of this LiDAR (PTP or NTP), or '
        f'correct its driver where its clouds only arrive late'
    )


def registered_text(tree: TransformTree, fixed_frame: str, frame: str) -> str:
    """
    Return what to do about clouds that are registered into a frame that does not move.

    Parameters
    ----------
    tree : TransformTree
        The transforms so far.
    fixed_frame, frame : str
        The frame to refine in, and that of the clouds.

    Returns
    -------
    str
        Empty where the frame of the clouds moves, or none moves in it.

    """
    if not all(map(tree.is_constant, tree.route(fixed_frame, frame))):
        return ''
    below = tree.moving_below(frame)
    if not below:
        return ''
    likely = [name for name in below if any(part in name.lower() for part in LIDAR_WORDS)]
    names = likely or below
    more = f' (or one of {", ".join(names[1:])})' if names[1:] else ''
    return (
        f'clouds are in {frame!r}, which does not move, while {", ".join(names)} moves in it: '
        f'they are registered already, and the origin of {frame!r} is taken for the position of '
        f'the LiDAR; name its frame: --sensor-frame {names[0]}{more} (node: '
        f"sensor_frames:=['{names[0]}'])"
    )


def _carried_text(tree: TransformTree, fixed_frame: str, frame: str) -> str:
    """Return that the fixed frame is one of the vehicle, which moves with the sensor."""
    top = tree.fixed_frame(fixed_frame) or fixed_frame
    is_carried = all(edge.is_static for edge in tree.route(fixed_frame, frame))
    way = max((edge.way() for edge in tree.route(top, fixed_frame)), default=0.0)
    if not is_carried or way < MIN_CARRIED_WAY or registered_text(tree, fixed_frame, frame):
        return ''
    return (
        f'the fixed frame {fixed_frame!r} moves by {way:.1f} m in {top!r}, and the sensor with '
        f'it: parked objects move in it, and get headings of moving ones; leave it out, or set '
        f'--fixed-frame {top} (node: fixed_frame:={top})'
    )


def _contradiction_text(route: Sequence[Edge]) -> str:
    """Return which transform has several poses at one stamp, or at all times."""
    for edge in route:
        if edge.is_static and edge.contradictions:
            return (
                f'transform {edge.parent} -> {edge.child}: expected one static pose, got others: '
                f'two publishers state it, or a calibration was changed; the last one is used; '
                f'leave the others out'
            )
        if not edge.is_static and edge.contradictions >= MIN_ALTERNATIONS:
            return (
                f'transform {edge.parent} -> {edge.child}: expected one position at each stamp, '
                f'got {edge.contradictions} other ones at stamps that were known, up to '
                f'{edge.stamps[-1]} ns: two publishers state it, or one that sets no stamps; '
                f'choose another source of motion, with --fixed-frame or --odometry'
            )
    return ''


def _sparse_text(moving: Sequence[Edge]) -> str:
    """Return that the motion itself, the lowest of moving transforms, has few samples."""
    for edge in moving[:1]:
        if len(edge.stamps) < 3:
            continue
        period = float(np.median(np.diff(edge.stamps))) * 1e-9
        if period > MAX_LINEAR_GAP:
            return (
                f'transform {edge.parent} -> {edge.child} comes every {period:.2g} s: expected '
                f'every {MAX_LINEAR_GAP:g} s or more often; in between the motion is interpolated '
                f'by a polynomial, which is off by a few centimetres, and by more where the '
                f'vehicle begins to turn or to brake; use a faster source of motion, if there is '
                f'one: --odometry TOPIC comes before TF (node: publish the transform more often)'
            )
    return ''


def _gap_text(moving: Sequence[Edge], cloud_stamps_ns: Sequence[int]) -> str:
    """Return where the motion itself has no samples, but clouds."""
    for edge in moving[:1]:
        if len(edge.stamps) < 3:
            continue
        gaps_ns = np.diff(edge.stamps)
        is_long = gaps_ns > max(MIN_GAP * 1e9, 3 * float(np.median(gaps_ns)))
        for index in np.flatnonzero(is_long).tolist():
            begin, end = edge.stamps[index : index + 2]
            if any(begin < stamp < end for stamp in cloud_stamps_ns):
                return (
                    f'transform {edge.parent} -> {edge.child} is missing for '
                    f'{(end - begin) * 1e-9:.1f} s, from {begin} ns on, while clouds come: the '
                    f'motion in between is interpolated, which is off by decimetres where the '
                    f'vehicle turns or brakes; record all of it, or use another source of motion: '
                    f'--odometry TOPIC comes before TF'
                )
    return ''


def _parents_text(tree: TransformTree, route: Sequence[Edge]) -> str:
    """Return which frame has two parents."""
    for edge in route:
        others = tree.other_parents(edge)
        if others:
            return (
                f'frame {edge.child!r}: expected one parent, got {edge.parent!r}, which is used, '
                f'and {", ".join(map(repr, others))}; to use another, name it: --fixed-frame '
                f'{others[0]} (node: fixed_frame:={others[0]})'
            )
    return ''


def _loop_text(tree: TransformTree, frame: str) -> str:
    """Return that the root above the frame of the clouds is attached to a frame below it."""
    closing = tree.loop(frame)
    if closing is None:
        return ''
    return (
        f'transforms: expected a tree, got a loop by {closing.parent} -> {closing.child}, while '
        f'{closing.child} is above {closing.parent}: one is inverse, or of a publisher too many; '
        f'{tree.root(frame)!r} is taken for the root; leave the wrong one out'
    )


def _once_text(constant: Sequence[Edge]) -> str:
    """Return which transform was published once, but not as a static one."""
    for edge in constant:
        if not edge.is_static and edge.stamps:
            return (
                f'transform {edge.parent} -> {edge.child} was published once on a topic of moving '
                f'transforms, at {edge.stamps[0]} ns; it is used as a static one, at all times'
            )
    return ''


def _has_copies(stamps_ns: Sequence[int], of_ns: Sequence[int]) -> bool:
    """Return whether most stamps are copies of others [ns]."""
    away = np.abs(np.subtract.outer(stamps_ns, of_ns)).min(axis=1)
    return bool(np.mean(away <= COPY_NS) >= MIN_COPIED)


def _worst(steps: Iterable[FrameSteps]) -> FrameSteps:
    return max(steps, key=lambda one: one.largest)
