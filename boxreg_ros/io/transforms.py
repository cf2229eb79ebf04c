"""
Transforms between frames over time, from TF and odometry.

``T_target_source`` is a (4, 4) matrix that maps coordinates of `source` to `target`. TF has
precedence; odometry is used where TF does not connect two frames.

"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import chain, pairwise
from operator import attrgetter
from typing import Any, NamedTuple

from boxreg_ros.errors import TransformUnavailable
from boxreg_ros.io.clocks import ReceiveTimes
from boxreg_ros.io.time_jumps import is_near, StreamClock, TIME_JUMP
from boxreg_ros.rotations import (
    interpolate_quaternion,
    matrix_from_quaternion,
    matrix_from_rpy,
    rotated_kinematics,
    rpy_from_matrix,
)
from boxreg_ros.structures import BOX_CENTER, BoxArray, Floats, FrameMotion, ROLL, Sweep
import numpy as np

MAX_EXTRAPOLATION = 0.2
"""
Largest distance of a stamp from the known transforms of a moving frame [s].

Two periods of a TF publisher of 10 Hz: one message may be late or lost. At 1 m/s^2 a motion
carried on for that long is off by 2 cm.

"""
SAME_POSITION = 0.01
"""Positions of one frame at one stamp differ by less [m]; chosen: one centimetre of rounding."""
SAME_ANGLE = 0.01
"""And its orientations by less [rad]; chosen: a centimetre at a metre."""
END_NS = 10**9
"""Time without transforms that is not the fault of a clock [ns]; chosen: detectors are as late."""
MAX_LINEAR_GAP = 0.25
"""
Longest gap between two samples of a moving frame that is interpolated linearly, as tf2 does [s].

Derived: at 3 m/s^2 linear interpolation is off by a t^2 / 8 = 2.3 cm, at 1 s by 0.4 m.

"""
MAX_NODE_DISTANCE = 3.0
"""
Largest distance of a further sample, in parts of the gap that it helps to interpolate.

Chosen: the motion before a long stop, or before the next one, says little of that in the gap.

"""
ODOMETRY_WITHOUT_CHILD = (
    'expected the frame of the vehicle in child_frame_id, got none: it is taken for {!r}, the '
    'topmost frame of the clouds'
)
POSES_SECONDS, POSES_PERIOD = 1.0, 0.1
"""
Duration and steps of the motion of a frame that boxes were measured in [s].

The latencies that are estimated reach to 0.8 s. Within a step, an acceleration of 3 m/s^2 moves a
vehicle 4 mm off the line between two poses.

"""
BUFFER_DURATION = 30.0
"""Transforms this much older than the newest of their pair are forgotten [s]; tf2 keeps 10 s."""
ONCE = 1.0
"""
A single sample of a frame counts as static once others are so much newer [s].

Chosen: ten periods of a publisher of 10 Hz, within what is read ahead of a recording.

"""
CHANGES_OF_PARENT = 3
"""Changes between parents of a moving frame that two publishers make; chosen: a frame that is
attached to another and back again has changed twice."""
FRAMES_BEFORE_CLEANUP = 500
"""
Number of frames that starts the search for those not updated for `BUFFER_DURATION`.

A vehicle has tens of frames; trackers that publish a frame per object add some every second.

"""


Pose = tuple[float, ...]
"""x y z qx qy qz qw [m]."""


class Sample(NamedTuple):
    """A transform or odometry, as it was received."""

    parent: str
    child: str
    stamp_ns: int
    pose: Pose
    """Of the child in the parent."""
    is_static: bool = False
    received_ns: int | None = None


class TransformTree:
    """
    Frames and the transforms between them, looked up by integer stamp.

    State: per pair of parent and child, one static transform or the samples of the last
    `buffer_duration` [s]. After a time jump of a pair, new samples replace the old ones. Between
    samples, positions are interpolated linearly and orientations along the shortest rotation, as
    tf2 does; over gaps longer than `MAX_LINEAR_GAP` by the polynomial through up to two samples
    on each side. Up to `MAX_EXTRAPOLATION` outside of them the motion is extrapolated. A
    moving frame with one sample only counts as static once others are newer. Of a frame that has
    two parents at once, the transforms to both are kept. Where nothing else connects two frames,
    those whose names differ by one and the same prefix, as ``r1/lidar`` and ``lidar``, are taken
    for one; `same_frames` has them. Not thread-safe.

    A sample whose stamp is far ahead of its pair, which its time of receipt does not explain,
    waits for the next one to confirm it. `clock_offset` [s] is added to the stamps of moving
    frames as they arrive. With `prefers_odometry` the odometry of a frame takes the place of its
    transform. Odometry without a child frame is that of `odometry_child`; `lacks_odometry_child`
    where there was some before it is known.

    """

    def __init__(self, buffer_duration: float = BUFFER_DURATION) -> None:
        self._buffer_ns = round(buffer_duration * 1e9)
        self.clock_offset = 0.0
        self.prefers_odometry = False
        self.odometry_child = ''
        self.lacks_odometry_child = False
        self.clear()

    def clear(self) -> None:
        """Forget all frames and transforms."""
        self._tf: dict[str, Attachment] = {}  # by child
        self._odometry: dict[str, Attachment] = {}
        self._routes: dict[tuple[str, str], list[tuple[Edge, bool]]] = {}
        self.same_frames: dict[str, str] = {}
        """Frames that are taken for one, since one name is the other with a prefix."""
        self._frames_limit = FRAMES_BEFORE_CLEANUP

    def add_transforms(
        self, transforms: Iterable[Any], is_static: bool = False, received_ns: int | None = None
    ) -> None:
        """
        Add the transforms of one TFMessage.

        Parameters
        ----------
        transforms : iterable of geometry_msgs/TransformStamped
            As rclpy, rosbags or mcap decode them.
        is_static : bool
            Whether they are of ``/tf_static``: valid at all times.
        received_ns : int or None
            When the message was received [ns], for the comparison of clocks.

        """
        for item in transforms:
            pose = numbers_of(item.transform.translation, item.transform.rotation)
            self._add(self._tf, self._sample(item, pose, received_ns, is_static))

    def add_pose(self, parent: str, child: str, stamp_ns: int, pose: Floats) -> None:
        """
        Add the pose of a moving frame in another at a stamp.

        Parameters
        ----------
        parent, child : str
            Frames; a leading slash is left out. With an empty one nothing is added.
        stamp_ns : int
            In the clock of `lookup` [ns]: `clock_offset` is not added.
        pose : array, shape (7,)
            x y z qx qy qz qw of `child` in `parent` [m]. One that is not finite, or whose
            quaternion is zero, is not used.

        """
        sample = Sample(_name(parent), _name(child), stamp_ns, tuple(pose.tolist()))
        self._add(self._tf, sample)

    def add_odometry(self, msg: Any, received_ns: int | None = None) -> None:
        """
        Add the pose of an odometry message.

        Parameters
        ----------
        msg : nav_msgs/Odometry
            Its pose is that of the child frame in the frame of the header; its twist is not used.
            Without a child frame it counts for `odometry_child`.
        received_ns : int or None
            When it was received [ns], for the comparison of clocks.

        """
        pose = msg.pose.pose
        sample = self._sample(msg, numbers_of(pose.position, pose.orientation), received_ns)
        if not sample.child:
            self._raise_odometry_child()
        child = sample.child or self.odometry_child
        self.lacks_odometry_child |= not child
        self._add(self._odometry, sample._replace(child=child))

    def name_odometry_child(self, frame: str) -> str:
        """Take odometry without a child frame for that of the root of `frame`; return which."""
        self.odometry_child = self.root(frame)
        self.lacks_odometry_child = False
        return self.odometry_note

    @property
    def odometry_note(self) -> str:
        """Return what odometry without a child frame is taken for."""
        return ODOMETRY_WITHOUT_CHILD.format(self.odometry_child)

    def _raise_odometry_child(self) -> None:
        """Go up by one static transform, which has come after the odometry had been named."""
        above = self._tf.get(self.odometry_child)
        if above is not None and above.used.is_static:
            self._odometry.pop(self.odometry_child, None)
            self._forget_routes()
            self.odometry_child = above.used.parent

    def rewind(self, stamp_ns: int) -> None:
        """Forget samples of moving frames that are later than a stamp that time went back to."""
        for edge in self.edges():
            edge.rewind(stamp_ns)

    def newest_ns(self) -> int | None:
        """Return the newest stamp of all moving frames [ns]; None if there are none."""
        return max(
            (e.stamps[-1] for e in self.edges() if e.stamps and not e.is_static), default=None
        )

    @property
    def stamps_ahead(self) -> Counter[str]:
        """Return for each pair of frames how many samples had a stamp ahead of all others."""
        return Counter({f'{e.parent} -> {e.child}': e.num_ahead for e in self.edges()})

    def lookup(self, target: str, source: str, stamp_ns: int) -> Floats:
        """
        Return the transform between two frames at a stamp.

        Parameters
        ----------
        target, source : str
            Frames, with a leading slash or without.
        stamp_ns : int
            [ns].

        Returns
        -------
        T_target_source : array, shape (4, 4)
            Maps points in `source` to `target` [m]; the unit matrix for one and the same frame.

        Raises
        ------
        TransformUnavailable
            If no transforms connect the frames, or one on the way has no valid pose, or none
            within `MAX_EXTRAPOLATION` of the stamp.

        """
        T_target_source: Floats | None = None
        for edge, is_upward in self._route(target, source):
            T = edge.at(stamp_ns, self._is_once(edge, stamp_ns))
            T = T if is_upward else inverse(T)
            T_target_source = T if T_target_source is None else T @ T_target_source
        return np.eye(4) if T_target_source is None else T_target_source + 0.0  # not -0.0

    def motion(self, target: str, source: str, stamp_ns: int) -> FrameMotion | None:
        """
        Return the motion of a frame in another up to a stamp.

        Parameters
        ----------
        target, source : str
            Frames: the motion of `source` in `target` is returned.
        stamp_ns : int
            One that `lookup` can answer [ns].

        Returns
        -------
        motion : FrameMotion or None
            Poses of the last `POSES_SECONDS`, `POSES_PERIOD` apart, as far back as they are known,
            and that at the stamp: a pose before the first one would depend on how many later ones
            have arrived. None if all transforms between both frames are static.

        Raises
        ------
        TransformUnavailable
            As `lookup`.

        """
        route = self._route(target, source)
        if all(edge.is_static for edge, _ in route):
            return None
        period_ns = round(POSES_PERIOD * 1e9)
        stamps_ns = [
            stamp_ns - step * period_ns
            for step in range(round(POSES_SECONDS / POSES_PERIOD), 0, -1)
        ]
        while stamps_ns and not self.covers(target, source, stamps_ns[0]):
            del stamps_ns[0]
        if stamps_ns and not self.covers(target, source, stamps_ns[-1]):
            stamps_ns = []
        T_target_source = np.empty((len(stamps_ns) + 1, 4, 4))
        T_target_source[:-1] = np.eye(4)
        for edge, is_upward in route if stamps_ns else ():
            T = edge.at_each(stamps_ns, self._is_once(edge))
            T_target_source[:-1] = (T if is_upward else inverse(T)) @ T_target_source[:-1]
        T_target_source[-1] = self.lookup(target, source, stamp_ns)
        return FrameMotion(np.array([*stamps_ns, stamp_ns]), T_target_source)

    def connects(self, target: str, source: str) -> bool:
        """Return whether transforms connect `source` with `target`, at any stamp."""
        try:
            self._route(target, source)
        except TransformUnavailable:
            return False
        return True

    def covers(self, target: str, source: str, stamp_ns: int) -> bool:
        """
        Return whether `lookup` would neither fail nor extrapolate.

        Parameters
        ----------
        target, source : str
            As of `lookup`.
        stamp_ns : int
            [ns].

        Returns
        -------
        bool
            False too where no transforms connect the frames.

        """
        return self.connects(target, source) and all(
            self._is_once(edge) or edge.covers(stamp_ns) for edge, _ in self._route(target, source)
        )

    def route(self, target: str, source: str) -> list[Edge]:
        """Return the pairs of frames from `source` to `target`; empty if nothing connects them."""
        if not self.connects(target, source):
            return []
        return [edge for edge, _ in self._route(target, source)]

    def moving_below(self, frame: str) -> list[str]:
        """Return the frames that move in `frame` or below it, and have no others below, sorted."""
        children: dict[str, list[Edge]] = {}
        for edge in self.edges():
            children.setdefault(edge.parent, []).append(edge)
        found = set()
        first = self._known(frame)
        queue = [(first, False)]
        seen = {first}
        for parent, is_moving in queue:
            below = children.get(parent, [])
            if is_moving and not below:
                found.add(parent)
            for edge in below:
                if edge.child not in seen:
                    seen.add(edge.child)
                    queue.append((edge.child, is_moving or not self.is_constant(edge)))
        return sorted(found)

    def is_constant(self, edge: Edge) -> bool:
        """Return whether a pair of frames is static, or has been published once so far."""
        return edge.is_static or self._is_once(edge)

    def other_parents(self, edge: Edge) -> list[str]:
        """Return the other parents of the child of a pair, by the same source, sorted."""
        for frames in (self._tf, self._odometry):
            known = frames.get(edge.child)
            if known is not None and edge in known.valid:
                return sorted(one.parent for one in known.valid if one is not edge)
        return []

    def fixed_frame(self, source: str) -> str | None:
        """
        Return the topmost frame that `source` moves in.

        It is the root of TF if a transform on the way to it moves; else the header frame of the
        odometry that moves this root, or that is connected with `source` in another way; else the
        root if other frames move in `source`, which does not move then. None if no motion is
        known.

        """
        source = self._known(source)
        path = self.path(source)
        top = self.root(source)
        if top in self._odometry:
            return self._odometry[top].used.parent
        if not all(map(self.is_constant, path)):
            return top
        for moved in self._odometry.values():
            if self.connects(moved.used.parent, source):
                return moved.used.parent
        return top if self.moving_below(source) else None

    def root(self, source: str) -> str:
        """
        Return the topmost frame above `source`; itself if there is none.

        Where nothing moves it is the one to refine in: that of a LiDAR may be tilted.

        """
        path = self.path(source)
        return path[-1].parent if path else self._known(source)

    def path(self, source: str) -> list[Edge]:
        """Return the pairs of frames from `source` up to the root of TF."""
        top = self._known(source)
        path: list[Edge] = []
        frames = {top}
        edge = self._above(top)
        while edge is not None and edge.parent not in frames:
            path.append(edge)
            frames.add(edge.parent)
            edge = self._above(edge.parent)
        return path

    def loop(self, source: str) -> Edge | None:
        """Return the pair by which the root of `source` is below itself, too; None for a tree."""
        return self._above(self.root(source))

    def _above(self, child: str) -> Edge | None:
        """Return the edge from a frame up in TF, or in the odometry that takes its place."""
        known = self._tf.get(child)
        if self.prefers_odometry:
            known = self._odometry.get(child, known)
        return None if known is None else known.used

    def __str__(self) -> str:
        """Return all pairs of parent and child."""
        pairs = dict.fromkeys(f'{edge.parent} -> {edge.child}' for edge in self.edges())
        return ', '.join(pairs) or 'none'

    def edges(self) -> list[Edge]:
        """Return all pairs of parent and child."""
        return list(dict.fromkeys((*self._tf_edges(), *_edges_of(self._odometry.values()))))

    def groups(self) -> list[list[str]]:
        """Return the names of frames that transforms connect with each other, sorted."""
        group_of: dict[str, list[str]] = {name: [name] for name in self.frames()}
        for edge in self.edges():
            ours, others = group_of[edge.parent], group_of[edge.child]
            if ours is not others:
                ours += others
                group_of |= dict.fromkeys(others, ours)
        return sorted({id(group): sorted(group) for group in group_of.values()}.values())

    def frames(self) -> list[str]:
        """Return the names of all frames, sorted."""
        return sorted({name for edge in self.edges() for name in (edge.parent, edge.child)})

    def _sample(
        self, item: Any, pose: Pose, received_ns: int | None, is_static: bool = False
    ) -> Sample:
        stamp_ns = item.header.stamp.sec * 10**9 + item.header.stamp.nanosec
        if not is_static:
            stamp_ns += round(self.clock_offset * 1e9)
        names = _name(item.header.frame_id), _name(item.child_frame_id)
        return Sample(*names, stamp_ns, pose, is_static, received_ns)

    def _add(self, frames: dict[str, Attachment], sample: Sample) -> None:
        """Add a sample to the frames of TF, or to those of odometry."""
        if not sample.parent or not sample.child:
            return  # refused by tf2, too; errors of lookups list the known transforms
        parent, child = sample.parent, sample.child
        frame = frames.get(child)
        edge = None if frame is None else frame.edge_to(parent)
        if edge is None:
            edge = Edge(parent, child, self._buffer_ns)
            if frame is None:
                frames[child] = Attachment(edge)
            else:
                edge = frame.attach(edge, sample.is_static)
            self._forget_routes()
        edge.is_static |= sample.is_static
        edge.add(sample.stamp_ns, sample.pose, sample.received_ns)
        if sample.received_ns is not None and not edge.is_static and not edge.is_holding:
            edge.arrivals.add(sample.received_ns, sample.stamp_ns)
        if len(frames) > self._frames_limit:
            oldest_ns = sample.stamp_ns - self._buffer_ns
            for name in [n for n, frame in frames.items() if frame.used.is_older(oldest_ns)]:
                del frames[name]
            self._frames_limit = max(FRAMES_BEFORE_CLEANUP, 2 * len(frames))

    def _is_once(self, edge: Edge, stamp_ns: int = 0) -> bool:
        """Return whether a moving pair has been published once, long before others or a stamp."""
        if not edge.may_be_constant:
            return False
        newest_ns = max(self.newest_ns() or 0, stamp_ns)
        return newest_ns - edge.stamps[0] >= round(ONCE * 1e9)

    def _tf_edges(self) -> list[Edge]:
        """Return the edges of TF; with `prefers_odometry`, odometry in place of those it has."""
        replacing = self._odometry if self.prefers_odometry else {}
        frames = [frame for child, frame in self._tf.items() if child not in replacing]
        return [*_edges_of(replacing.values()), *_edges_of(frames)]

    def alike(self, frame: str) -> list[str]:
        """Return the known frames whose name is that of another with a prefix, or without one."""
        name = _name(frame)
        pairs = chain(*self._same_by_prefix({name, *self.frames()}).values())
        return sorted({other for pair in pairs if name in pair for other in pair} - {name})

    def _known(self, frame: str) -> str:
        """Return the name by which transforms know a frame: its own, or the only one alike."""
        name = _name(frame)
        known = self.frames()
        others = [] if name in known else self.alike(name)
        return others[0] if len(others) == 1 else name

    def _same_by_prefix(self, names: set[str]) -> dict[str, list[tuple[str, str]]]:
        """Return for each prefix the pairs of names that it distinguishes, with and without."""
        found: dict[str, list[tuple[str, str]]] = {}
        for name in names:
            for at in (place for place, letter in enumerate(name) if letter == '/'):
                if name[at + 1 :] in names:
                    found.setdefault(name[:at], []).append((name, name[at + 1 :]))
        return found

    def _prefixed_route(self, target: str, source: str) -> list[tuple[Edge, bool]] | None:
        """Return the route where names that differ by one prefix are one; None if not unique."""
        edges = self.edges()
        routes = []
        for pairs in self._same_by_prefix({target, source, *self.frames()}).values():
            same = [_identity(*pair) for pair in pairs]
            route = _connect(target, source, [*edges, *same])
            if route is not None:
                routes.append((route, same))
        if len(routes) != 1:
            return None
        ((route, same),) = routes
        self.same_frames |= {edge.child: edge.parent for edge, _ in route if edge in same}
        return route

    def _forget_routes(self) -> None:
        """Look for routes anew: a pair of frames has come."""
        self._routes.clear()
        self.same_frames.clear()

    def _route(self, target: str, source: str) -> list[tuple[Edge, bool]]:
        """Return the edges from `source` to `target`, each with True where it leads upward."""
        key = (_name(target), _name(source))
        if key not in self._routes:
            closing = self.loop(source)
            route = _connect(*key, [edge for edge in self._tf_edges() if edge is not closing])
            if route is None:
                route = _connect(*key, self.edges())
            if route is None:
                route = self._prefixed_route(*key)
            if route is None:
                raise TransformUnavailable(
                    f'no transform from {source!r} to {target!r}; known: {self}; publish the '
                    f'missing one on /tf or as odometry, or choose another fixed frame'
                )
            self._routes[key] = route
        return self._routes[key]


class Attachment:
    """
    The edges of one frame: that to its parent, which is `used`, and those to parents before.

    A new parent takes the place of the one before: the frame was attached to another. Where two
    publishers state two parents all the time, both edges stay, and one that moves has precedence,
    else the one that was known first.

    """

    def __init__(self, first: Edge) -> None:
        self.used = first
        self._edges = {first.parent: first}  # in the order in which they came
        self._changes = 0

    @property
    def valid(self) -> list[Edge]:
        """Return the edge in use, and behind it the others where a frame has several at once."""
        if not self._has_two_parents:
            return [self.used]
        return [self.used, *(edge for edge in self._edges.values() if edge is not self.used)]

    def edge_to(self, parent: str) -> Edge | None:
        """Return the edge to a parent; None if the frame is not attached to it."""
        return next((edge for edge in self.valid if edge.parent == parent), None)

    def attach(self, new: Edge, is_static: bool) -> Edge:
        """Attach the frame to a new parent by an edge; return the edge to add samples to."""
        self._changes += 1
        if self.used.is_static or is_static:  # a static frame is attached once
            self._changes = CHANGES_OF_PARENT
        if not self._has_two_parents:
            self._edges[new.parent] = self.used = new  # samples of an earlier time are old
            return new
        new = self._edges.setdefault(new.parent, new)
        new.is_static |= is_static
        known = [edge for edge in self._edges.values() if edge in (self.used, new)]
        self.used = min(known, key=attrgetter('is_static'))
        return new

    @property
    def _has_two_parents(self) -> bool:
        return self._changes >= CHANGES_OF_PARENT


class Edge:
    """
    One pair of parent and child frame: a static pose, or poses over time.

    Attributes
    ----------
    stamps : list of int
        Stamps of the samples, ascending [ns]; one for a static pair.
    poses : list of (7,) float64
        x y z qx qy qz qw of the child in the parent at these stamps [m].
    contradictions : int
        Samples at another position than one of the same stamp; of a static pair, than the last.
    arrivals : ReceiveTimes
        When the first samples were received.
    num_ahead : int
        Samples that were not used, since their stamps were ahead of those before and after them.

    """

    def __init__(self, parent: str, child: str, buffer_ns: int) -> None:
        self.parent = parent
        self.child = child
        self._buffer_ns = buffer_ns
        self.is_static = False
        self.stamps: list[int] = []
        self.poses: list[Floats] = []
        self.arrivals = ReceiveTimes()
        self.contradictions = 0
        self.num_ahead = 0
        self._was_old = False  # whether the last sample was: one far behind the newest
        self._clock = StreamClock()
        self._ahead: tuple[int, Pose, int | None] | None = None
        self._was_forgotten = False
        self._last_added: tuple[int, Floats] | None = None
        # A cloud, its boxes and its label files ask for the same stamp; of a static pair any.
        self._last_found: tuple[int, Floats] | None = None

    @property
    def is_holding(self) -> bool:
        """Return whether the last sample waits for the next one to confirm its stamp."""
        return self._ahead is not None

    def way(self, since_ns: int = 0) -> float:
        """Return the way that the child has moved in the parent since a stamp [m]."""
        if not self.poses:
            return 0.0
        first = bisect_left(self.stamps, since_ns)
        positions = [pose[:3] for pose in self.poses[first:] or self.poses[-1:]]
        return float(np.linalg.norm(np.ptp(positions, axis=0)))

    def add(self, stamp_ns: int, pose: Pose, received_ns: int | None = None) -> None:
        """
        Add the pose of the child in the parent at a stamp.

        Parameters
        ----------
        stamp_ns : int
            [ns]. A second pose of the same stamp replaces the first; any pose of a static pair
            does.
        pose : tuple of 7 float
            x y z qx qy qz qw [m].
        received_ns : int or None
            When it was received [ns]. A sample whose stamp is ahead of all others, which this time
            does not explain, is held until the next sample confirms it, or a cloud of its time
            asks for it. None: it is used at once.

        """
        if received_ns is None or self.is_static:
            self._use(stamp_ns, pose)
            return
        held = self._ahead
        self._ahead = None
        new = stamp_ns, pose, received_ns
        is_ahead = self._clock.is_ahead(stamp_ns, received_ns)
        if held is not None and not (is_ahead and is_near(stamp_ns, held[0])):
            self.num_ahead += 1
            held = None
        if is_ahead and held is None:
            self._ahead = new
            return
        if held is not None:
            self._accept(*held)
        self._accept(*new)

    def _confirm(self, stamp_ns: int) -> None:
        """Use the sample that is held if it is of the time of a stamp of another stream."""
        held = self._ahead
        if held is not None and abs(stamp_ns - held[0]) <= round(TIME_JUMP * 1e9):
            self._ahead = None
            self._accept(*held)

    def _accept(self, stamp_ns: int, pose: Pose, received_ns: int | None) -> None:
        """Use a sample whose stamp fits those before it."""
        self._clock.note(stamp_ns, received_ns)
        self._use(stamp_ns, pose)

    def _use(self, stamp_ns: int, pose: Pose) -> None:
        values = np.array(pose, dtype=np.float64)
        if not np.isfinite(values).all() or not np.any(values[3:]):
            return  # no pose; the error of a lookup has the stamps that are known
        self._last_added = stamp_ns, values
        self._last_found = None
        is_old = bool(self.stamps) and stamp_ns < self.stamps[-1] - round(TIME_JUMP * 1e9)
        has_jumped = is_old and self._was_old  # a single old one is an outlier
        if has_jumped:
            self._forget()
            self._was_forgotten = True
        self._was_old = is_old and not has_jumped
        first, end = bisect_left(self.stamps, stamp_ns), bisect_right(self.stamps, stamp_ns)
        if self.is_static:
            first, end = 0, len(self.stamps)
        if end > first:
            self.contradictions += _differ(self.poses[first], values)
        self.stamps[first:end], self.poses[first:end] = [stamp_ns], [values]
        old = bisect_left(self.stamps, self.stamps[-1] - self._buffer_ns)
        # Two samples stay at any age: extrapolation needs a velocity.
        old = max(min(old, len(self.stamps) - 2), 0)
        del self.stamps[:old], self.poses[:old]

    def rewind(self, stamp_ns: int) -> None:
        """Forget later samples; at 0 the recording is read again."""
        newest_ns = stamp_ns + round(TIME_JUMP * 1e9)
        if stamp_ns <= 0 and self.may_be_constant:
            return  # published once: where the recording is read again, it is known from its begin
        if self.is_static or not self.stamps or self.stamps[-1] <= newest_ns:
            return
        self._forget()
        self._was_forgotten = stamp_ns > 0  # 0: the recording is read again, no time jump
        last_added = self._last_added
        if last_added is not None and last_added[0] <= newest_ns:
            self.add(last_added[0], tuple(last_added[1]))  # it arrived after time went back

    def _forget(self) -> None:
        self.stamps.clear()
        self.poses.clear()
        self._clock = StreamClock()
        self._was_old = False
        self._last_found = None

    @property
    def may_be_constant(self) -> bool:
        """Return whether there was one sample so far, of a pair that is not static."""
        return not self.is_static and len(self.stamps) == 1 and not self._was_forgotten

    def is_older(self, stamp_ns: int) -> bool:
        """Return whether the newest sample of a moving pair is older than a stamp [ns]."""
        return not self.is_static and bool(self.stamps) and self.stamps[-1] < stamp_ns

    def covers(self, stamp_ns: int) -> bool:
        """Return whether a stamp lies between samples, or the pair is static."""
        self._confirm(stamp_ns)
        if self.is_static:
            return bool(self.stamps)
        return bool(self.stamps) and self.stamps[0] <= stamp_ns <= self.stamps[-1]

    def at(self, stamp_ns: int, is_constant: bool = False) -> Floats:
        """
        Return the pose of the child in the parent at a stamp.

        Parameters
        ----------
        stamp_ns : int
            [ns]; of no effect for a static pair.
        is_constant : bool
            Whether the first sample counts at any stamp.

        Returns
        -------
        T_parent_child : array, shape (4, 4)
            Interpolated between samples, or extrapolated by up to `MAX_EXTRAPOLATION` [m].

        Raises
        ------
        TransformUnavailable
            If the stamp is farther from all samples, or there is no valid one.

        """
        self._confirm(stamp_ns)
        if is_constant:
            return matrix(self.poses[0])
        found = self._last_found
        if found is None or not (self.is_static or found[0] == stamp_ns):
            found = self._last_found = stamp_ns, self._at(stamp_ns)
        return found[1]

    def _at(self, stamp_ns: int) -> Floats:
        stamps = self.stamps
        if not stamps:
            cause = 'all poses are NaN or have no orientation; check its publisher'
            if self._was_forgotten:
                cause = 'no pose has arrived since time went back; check that its publisher runs'
            raise TransformUnavailable(f'transform {self.parent} -> {self.child}: {cause}')
        outside = max(stamps[0] - stamp_ns, stamp_ns - stamps[-1])
        # Extrapolation needs two samples; a single one has no velocity.
        if not self.is_static and outside > MAX_EXTRAPOLATION * 1e9 * (len(stamps) > 1):
            raise TransformUnavailable(
                f'transform {self.parent} -> {self.child} is known from {stamps[0]} to '
                f'{stamps[-1]} ns: expected to cover {stamp_ns} ns within '
                f'{MAX_EXTRAPOLATION:g} s; {self._remedy(outside)}'
            )
        if self.is_static or len(stamps) == 1:
            return matrix(self.poses[0])
        after = min(max(bisect_left(stamps, stamp_ns), 1), len(stamps) - 1)
        if stamps[after] == stamp_ns:
            return matrix(self.poses[after])
        nodes = self._nodes(after)
        return interpolated([stamps[i] for i in nodes], [self.poses[i] for i in nodes], stamp_ns)

    def _remedy(self, outside_ns: int) -> str:
        """Return what to do about a stamp so far from all samples [ns]."""
        if len(self.stamps) < 2:
            return 'check that its stamps use the clock of the point cloud'
        period_ns = float(np.median(np.diff(self.stamps)))
        if period_ns > MAX_LINEAR_GAP * 1e9 and outside_ns < 2 * period_ns:
            return (
                f'it comes every {period_ns * 1e-9:.2g} s, too rarely to carry the motion on for '
                f'{outside_ns * 1e-9:.2g} s; use a faster source of motion, if there is one: '
                f'--odometry TOPIC comes before TF'
            )
        if outside_ns < END_NS:
            return (
                'nothing to do where the recording begins or ends; elsewhere transforms are '
                'missing, or the stamp is late'
            )
        return (
            'check that its stamps use the clock of the point cloud; of a recording, a part '
            'without transforms is left out by --start and --end'
        )

    def at_each(self, stamps_ns: Sequence[int], is_constant: bool) -> Floats:
        """
        Return the poses of the child in the parent at some stamps.

        Parameters
        ----------
        stamps_ns : sequence of n int
            Stamps between the first and the last sample, n > 0 [ns].
        is_constant : bool
            Whether the first sample counts at any stamp.

        Returns
        -------
        T_parent_child : array, shape (n, 4, 4) or (4, 4)
            The latter if the pair is static or constant [m].

        """
        if self.is_static or is_constant:
            return self.at(stamps_ns[0], is_constant)
        known = self.stamps
        after = [min(max(bisect_left(known, one), 1), len(known) - 1) for one in stamps_ns]
        gaps_ns = [known[row] - known[row - 1] for row in after]
        if len(known) < 2 or max(gaps_ns) > MAX_LINEAR_GAP * 1e9:
            return np.array([self._at(one) for one in stamps_ns])
        shares = np.array(
            [
                (one - known[row - 1]) / gap
                for one, row, gap in zip(stamps_ns, after, gaps_ns, strict=True)
            ]
        )
        first = np.array([self.poses[row - 1] for row in after])
        return matrix(_between(first, np.array([self.poses[row] for row in after]), shares))

    def _nodes(self, after: int) -> list[int]:
        """
        Return the rows of the samples to interpolate the gap before row `after` by.

        Over a long gap there is a further one on each side, where it is known, about as far apart
        as the gap is long: the noise of a nearer one would be multiplied by the ratio of both.

        """
        before = after - 1
        stamps = self.stamps
        gap_ns = stamps[after] - stamps[before]
        nodes = [before, after]
        if gap_ns <= MAX_LINEAR_GAP * 1e9:
            return nodes
        limit_ns = MAX_NODE_DISTANCE * gap_ns
        earlier = min(bisect_left(stamps, stamps[before] - gap_ns), before - 1)
        if earlier >= 0 and stamps[before] - stamps[earlier] <= limit_ns:
            nodes.insert(0, earlier)
        later = max(bisect_right(stamps, stamps[after] + gap_ns) - 1, after + 1)
        if later < len(stamps) and stamps[later] - stamps[after] <= limit_ns:
            nodes.append(later)
        return nodes


def _differ(one: Floats, other: Floats) -> bool:
    """Return whether two poses (7,) are further apart than rounding explains."""
    cosine = one[3:] @ other[3:] / np.sqrt((one[3:] @ one[3:]) * (other[3:] @ other[3:]))
    apart = np.linalg.norm(one[:3] - other[:3])
    return bool(apart > SAME_POSITION or abs(cosine) < np.cos(SAME_ANGLE / 2))


def numbers_of(position: Any, orientation: Any) -> Pose:
    """Return the numbers of a position and an orientation of ROS."""
    at, turn = position, orientation
    return at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w


def matrix(pose: Floats) -> Floats:
    """Return T (..., 4, 4) of x y z qx qy qz qw (..., 7)."""
    T = np.zeros((*pose.shape[:-1], 4, 4))
    T[..., :3, :3] = matrix_from_quaternion(pose[..., 3:])
    T[..., :3, 3] = pose[..., :3]
    T[..., 3, 3] = 1.0
    return T


def inverse(T: Floats) -> Floats:
    """Return the inverse of rigid transforms T (..., 4, 4)."""
    inverted = np.zeros_like(T)
    R = np.swapaxes(T[..., :3, :3], -1, -2)
    inverted[..., :3, :3] = R
    inverted[..., :3, 3] = -(R @ T[..., :3, 3, None])[..., 0]
    inverted[..., 3, 3] = 1.0
    return inverted


def interpolated(stamps_ns: Sequence[int], poses: Sequence[Floats], stamp_ns: int) -> Floats:
    """
    Return the pose at a stamp, interpolated or extrapolated.

    Positions are those of the polynomial of degree n - 1 through the samples. Neville's scheme
    makes it of interpolations between two poses each, so that it holds for orientations, too.

    Parameters
    ----------
    stamps_ns : sequence of int
        Different stamps of n >= 2 samples [ns], ascending.
    poses : sequence of array, shape (7,)
        x y z qx qy qz qw at these stamps [m].
    stamp_ns : int
        The stamp to return the pose at [ns].

    Returns
    -------
    T : array, shape (4, 4)
        The pose as a transform.

    """
    values = list(poses)
    for step in range(1, len(values)):
        values = [
            _between(
                first,
                second,
                (stamp_ns - stamps_ns[row]) / (stamps_ns[row + step] - stamps_ns[row]),
            )
            for row, (first, second) in enumerate(pairwise(values))
        ]
    return matrix(values[0])


def _between(first: Floats, second: Floats, share: float | Floats) -> Floats:
    """Return the poses (..., 7) between two poses: `share` (...) 0 is the first, 1 the second."""
    part = np.asarray(share)[..., None]
    position = first[..., :3] + part * (second[..., :3] - first[..., :3])
    turn = interpolate_quaternion(first[..., 3:], second[..., 3:], share)
    return np.concatenate([position, turn], axis=-1)


def sweep_to_frame(sweep: Sweep, T_frame_sweep: Floats, frame_id: str) -> Sweep:
    """
    Return a sweep in another frame without moving its points.

    Parameters
    ----------
    sweep : Sweep
        In any frame.
    T_frame_sweep : array, shape (4, 4)
        Maps its `frame_id` to the other frame.
    frame_id : str
        The other frame.

    Returns
    -------
    sweep : Sweep
        With the same arrays `points` and `times`; `origin`, `origins` and `T_frame_points` are of
        the other frame. `in_frame` moves the points.

    """
    R = T_frame_sweep[:3, :3]
    t = T_frame_sweep[:3, 3]
    known = sweep.T_frame_points
    return replace(
        sweep,
        frame_id=frame_id,
        origin=R @ sweep.origin + t,
        origins=None if sweep.origins is None else sweep.origins @ R.T + t,
        T_frame_points=T_frame_sweep if known is None else T_frame_sweep @ known,
    )


def boxes_to_frame(
    boxes: BoxArray,
    T_frame_boxes: Floats,
    frame_id: str,
    motion: FrameMotion | None = None,
    ticket: object = None,
) -> BoxArray:
    """
    Return boxes in another frame.

    Parameters
    ----------
    boxes : BoxArray
        n boxes in any frame; NaN stays NaN.
    T_frame_boxes : array, shape (4, 4)
        Maps their `frame_id` to the other frame, at their stamp.
    frame_id : str
        The other frame. If it is their own, the numbers are the same: to convert angles changes
        their last digits.
    motion : FrameMotion, optional
        That of their own frame in the other one.
    ticket : object, optional
        Of the result; default: theirs.

    Returns
    -------
    boxes : BoxArray
        Their kinematics are in the axes of the other frame, but over ground: a moving frame takes
        nothing off.

    """
    moved, kinematics = boxes.boxes, boxes.kinematics
    if frame_id != boxes.frame_id:
        moved = moved_boxes(moved, T_frame_boxes)
        if kinematics is not None:
            kinematics = rotated_kinematics(kinematics, T_frame_boxes[:3, :3])
    return replace(
        boxes,
        frame_id=frame_id,
        boxes=moved,
        motion=motion,
        ticket=boxes.ticket if ticket is None else ticket,
        kinematics=kinematics,
    )


def moved_boxes(boxes: Floats, T_frame_boxes: Floats) -> Floats:
    """Return boxes (n, 9) in another frame by a transform (4, 4); NaN stays NaN."""
    moved = boxes.copy()
    R = T_frame_boxes[:3, :3]
    moved[:, BOX_CENTER] = boxes[:, BOX_CENTER] @ R.T + T_frame_boxes[:3, 3]
    moved[:, ROLL:] = rpy_from_matrix(R @ matrix_from_rpy(moved[:, ROLL:]))
    return moved


def _name(frame_id: str) -> str:
    """Return the name of a frame without the leading slash of ROS 1, as in tf2."""
    return frame_id.lstrip('/')


def _edges_of(frames: Iterable[Attachment]) -> list[Edge]:
    """Return the edges of some frames: those in use, and behind all of these the others."""
    valid = [frame.valid for frame in frames]
    return [*(edges[0] for edges in valid), *(edge for edges in valid for edge in edges[1:])]


def _identity(child: str, parent: str) -> Edge:
    """Return the edge between two names of one frame."""
    edge = Edge(parent, child, 0)
    edge.is_static = True
    edge.add(0, (0, 0, 0, 0, 0, 0, 1))
    return edge


def _connect(target: str, source: str, edges: Iterable[Edge]) -> list[tuple[Edge, bool]] | None:
    """Return the shortest path from `source` to `target`, or None."""
    neighbours: dict[str, list[tuple[Edge, bool]]] = {}
    for edge in edges:
        neighbours.setdefault(edge.child, []).append((edge, True))
        neighbours.setdefault(edge.parent, []).append((edge, False))
    routes: dict[str, list[tuple[Edge, bool]]] = {source: []}
    queue = [source]
    for frame in queue:
        for edge, is_upward in neighbours.get(frame, ()):
            following = edge.parent if is_upward else edge.child
            if following not in routes:
                routes[following] = [*routes[frame], (edge, is_upward)]
                queue.append(following)
    return routes.get(target)
