"""
Frames and the transforms between them over time, from TF and odometry.

TF has precedence; odometry is used where TF does not connect two frames.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from itertools import chain
from typing import Any, NamedTuple

from boxreg_ros.errors import TransformUnavailable
from boxreg_ros.io.transform_edge import Attachment, Edge
from boxreg_ros.io.transforms import inverse, numbers_of, Pose
from boxreg_ros.structures import Floats, FrameMotion
import numpy as np

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
FRAMES_BEFORE_CLEANUP = 500
"""
Number of frames that starts the search for those not updated for `BUFFER_DURATION`.

A vehicle has tens of frames; trackers that publish a frame per object add some every second.

"""


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
    `buffer_duration` [s]. After a time jump of a pair, new samples replace the old ones, which are
    kept for stamps more than `TIME_JUMP` ahead of these until `forget_before` or `rewind`. Between
    samples, positions are interpolated linearly and orientations along the shortest rotation, as
    tf2 does; over gaps longer than `MAX_LINEAR_GAP` by the polynomial through up to two samples on
    each side, or one behind the gap unless the tree `looks_ahead`. Up to `MAX_EXTRAPOLATION`
    outside of them the motion is extrapolated. A moving frame with one sample only counts as
    static once others are newer. Of a frame that has two parents at once, the transforms to both
    are kept. Where nothing else connects two frames, those whose names differ by one and the same
    prefix, as ``r1/lidar`` and ``lidar``, are taken for one; `same_frames` has them. Not
    thread-safe.

    A sample whose stamp is far ahead of its pair, which its time of receipt does not explain,
    waits for the next one to confirm it. `clock_offset` [s] is added to the stamps of moving
    frames as they arrive. With `prefers_odometry` the odometry of a frame takes the place of its
    transform. Odometry without a child frame is that of `odometry_child`; `lacks_odometry_child`
    where there was some before it is known.

    """

    def __init__(self, buffer_duration: float = BUFFER_DURATION, looks_ahead: bool = True) -> None:
        self._buffer_ns = round(buffer_duration * 1e9)
        self._looks_ahead = looks_ahead
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

    def jumps_back(self, message: Any) -> bool:
        """Return whether by a TFMessage or odometry time goes back: samples are forgotten then."""
        frames, items = self._odometry, [message]
        if hasattr(message, 'transforms'):
            frames, items = self._tf, message.transforms
        for item in items:
            frame = frames.get(_name(item.child_frame_id) or self.odometry_child)
            edge = frame and frame.edge_to(_name(item.header.frame_id))
            if edge and edge.jumps_to(self._stamp_of(item)):
                return True
        return False

    def rewind(self, stamp_ns: int) -> None:
        """Forget samples of moving frames that are later than a stamp that time went back to."""
        for edge in _edges_of((*self._tf.values(), *self._odometry.values())):
            edge.rewind(stamp_ns)

    def forget_before(self) -> None:
        """Forget samples before time went back: clouds and boxes have gone back, too."""
        for edge in _edges_of((*self._tf.values(), *self._odometry.values())):
            edge.forget_before()

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

    def find(self, target: str, source: str, stamp_ns: int) -> Floats | None:
        """Return the transform (4, 4) that `lookup` does; None where that raises."""
        try:
            return self.lookup(target, source, stamp_ns)
        except TransformUnavailable:
            return None

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

    def is_final(self, target: str, source: str, stamp_ns: int) -> bool:
        """
        Return whether later transforms, which come in order, change nothing of `lookup`.

        Parameters
        ----------
        target, source : str
            As of `lookup`.
        stamp_ns : int
            [ns].

        """
        return self.connects(target, source) and all(
            self._is_once(edge) or edge.is_final(stamp_ns)
            for edge, _ in self._route(target, source)
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
        stamp_ns = self._stamp_of(item, is_static)
        names = _name(item.header.frame_id), _name(item.child_frame_id)
        return Sample(*names, stamp_ns, pose, is_static, received_ns)

    def _stamp_of(self, item: Any, is_static: bool = False) -> int:
        """Return the stamp of a transform or odometry in the clock of `lookup` [ns]."""
        stamp = item.header.stamp
        offset_ns = 0 if is_static else round(self.clock_offset * 1e9)
        return int(stamp.sec * 10**9 + stamp.nanosec + offset_ns)

    def _add(self, frames: dict[str, Attachment], sample: Sample) -> None:
        """Add a sample to the frames of TF, or to those of odometry."""
        if not sample.parent or not sample.child:
            return  # refused by tf2, too; errors of lookups list the known transforms
        parent, child = sample.parent, sample.child
        frame = frames.get(child)
        edge = None if frame is None else frame.edge_to(parent)
        if edge is None:
            edge = Edge(parent, child, self._buffer_ns, self._looks_ahead)
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
                    f'missing one on /tf or as odometry, or choose another frame'
                )
            self._routes[key] = route
        return self._routes[key]


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
