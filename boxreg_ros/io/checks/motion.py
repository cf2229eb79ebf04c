"""
Check of the motion of the sensors: frames that jump, clocks, and mistakes of publishers of TF.

The same for the live node and for recordings.

"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence, Set
from math import inf

from boxreg_ros.io.checks.finding import Finding
from boxreg_ros.io.checks.jump_search import FrameSteps, JumpSearch, STEP_RADIUS
from boxreg_ros.io.checks.pose_jitter import PoseJitter
from boxreg_ros.io.clocks import (
    CAPACITY,
    clock_offset,
    copied_offset,
    COPY_NS,
    likely_offset,
    MIN_CLOCK_OFFSET,
    MIN_PAIRS,
    ReceiveTimes,
    seconds_text,
)
from boxreg_ros.io.transform_edge import Edge, MAX_LINEAR_GAP
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import BoxArray, Floats, Sweep
import numpy as np

MIN_ALTERNATIONS = 3
"""Samples at impossible speed that mean two publishers; chosen: one or two are a restart."""
MAX_BOXES_DELAY = 1.0
"""Delay of boxes after their clouds that is reported [s]; a live detector takes 0.1 to 0.5 s."""
MIN_COPIED = 0.5
"""Part of the stamps that are those of clouds by which one clock has set both; chosen."""
LATE_ODOMETRY = (
    ', unless it is computed from these clouds, whose stamps it has, and comes late: then raise '
    'transform_timeout of the node'
)
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


class MotionCheck:
    """
    Watch the transforms of a stream of clouds and boxes for what makes their motion wrong.

    `findings` has what was found so far, in words, by its kind. The stamps of boxes have
    `boxes_offset` [s] in them.

    """

    def __init__(
        self, tree: TransformTree, named_sensors: bool, boxes_offset: float = 0.0
    ) -> None:
        self._tree = tree
        self._named_sensors = named_sensors
        self._boxes_offset = boxes_offset
        self._jumps = JumpSearch()
        self.findings: dict[str, Finding] = {}
        self._clouds_ns = inf, -inf  # first and last stamp
        self._displaced: dict[tuple[str, str, str], FrameSteps] = {}  # that jump between clouds
        self.other_clocks: Set[str] = frozenset()
        self.smooth_frame = ''  # that a fixed frame which jumps could give way to
        self.forget()

    def forget(self) -> None:
        """Forget when messages were received: time has jumped. What was found stays."""
        self._clouds: dict[str, ReceiveTimes] = {}  # by topic: each LiDAR may have its own clock
        self._boxes = ReceiveTimes()
        self._cloud_stamps = deque[int](maxlen=CAPACITY)
        self._copied: list[bool] = []
        self._count = 0
        self._first_milliseconds = 0
        # Of position and yaw, by the frame of the clouds.
        self._jitters: dict[str, tuple[PoseJitter, PoseJitter]] = {}
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
        new = PoseJitter(), PoseJitter(of_yaw=True)
        of_position, of_yaw = self._jitters.setdefault(cloud.frame_id, new)
        of_position.add(cloud.stamp_ns, T_fixed_cloud[:2, 3])
        of_yaw.add(cloud.stamp_ns, np.arctan2(T_fixed_cloud[1:2, 0], T_fixed_cloud[:1, 0]))
        jitter = _jitter_text(of_position.deviation, of_yaw.deviation)
        if jitter and 'publishers' not in self.findings:
            text = jitter.format(f'{cloud.frame_id!r} in {fixed_frame!r}')
            self.findings['jitter'] = Finding(Reason.TRANSFORM_FAULT, text)
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

    def give_way(self, fixed_frame: str) -> str:
        """Return the smooth frame, which is used from here on in place of one that jumps."""
        smooth = self.smooth_frame
        text = (
            f'fixed frame is {smooth!r} from here on, not {fixed_frame!r}, which jumps: '
            f'{_worst(self._jumps.steps.values())}; set fixed_frame:={fixed_frame} to refine in '
            f'it all the same'
        )
        self.findings['jumps'] = Finding(Reason.FIXED_FRAME_JUMPS, text)
        self.smooth_frame = ''
        return smooth

    def _jump_text(self, fixed_frame: str, frame: str) -> str:
        smooth = self._jumps.smooth_frame(self._tree, fixed_frame, frame)
        if smooth == fixed_frame:
            return ''
        self.smooth_frame = smooth
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
        self.other_clocks = off.keys() if len(off) < len(offsets) else frozenset()
        if edge is None or not off:
            return ''
        if self.other_clocks:
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
        known = self.findings.get('boxes_clock')
        if known and self._count > CAPACITY:
            return known.text  # of the first messages, which are compared; later stamps are known
        measured = min(self._offsets_from(self._boxes).values(), key=abs, default=None)
        if measured is None or -MIN_CLOCK_OFFSET < measured < MAX_BOXES_DELAY:
            return ''
        if measured > 0 and sum(self._copied) >= MIN_COPIED * max(1, len(self._copied)):
            return ''  # a slow detector copies the stamps of its clouds
        offset, names = likely_offset(measured)
        if not names:
            offset = copied_offset(measured, self._boxes.stamps_ns, self._cloud_stamps)
        of_whom = f', as {names} are' if names else ''
        if offset > 0:
            of_whom += ', and of no other cloud'
        total = seconds_text(offset + self._boxes_offset)
        return (
            f'clocks: expected one for clouds and boxes, got stamps of the boxes '
            f'{seconds_text(abs(offset))} s {"behind" if offset > 0 else "ahead of"} those of the '
            f'clouds received at the same time{of_whom}; correct them with --boxes-offset={total} '
            f'(node: boxes_offset:={total})'
        )


def _jitter_text(position: float, yaw: float) -> str:
    """Return that a pose errs by these deviations, {} for its frames; '' if it hardly does."""
    if position >= MIN_JITTER:
        errs = f'the position of {{}} errs by {position:.2f} m'
        displaced = 'as much, and more where its yaw errs too'
    elif yaw >= MIN_YAW_JITTER:
        errs = f'the yaw of {{}} errs by {np.degrees(yaw):.1f} degrees'
        displaced = f'by it, at {STEP_RADIUS:.0f} m by {STEP_RADIUS * yaw:.1f} m'
    else:
        return ''
    return (
        f'{errs} from cloud to cloud, back and forth: points and boxes are displaced {displaced}; '
        f'use a smoother source of motion, with --fixed-frame or --odometry, or smooth this one'
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
