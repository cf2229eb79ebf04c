"""
Where the sensor is: transforms over time, for the live node and for recordings alike.

``T_target_source`` is a (4, 4) matrix that maps coordinates of `source` to `target`. TF is asked
first; odometry fills in where TF does not connect two frames.

"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from boxreg_ros.errors import TransformUnavailable
from boxreg_ros.rotations import (
    interpolate_rotation,
    matrix_from_quaternion,
    matrix_from_rpy,
    rpy_from_matrix,
)
from boxreg_ros.structures import BoxArray, Floats, ROLL, Sweep, X, Z
import numpy as np

MAX_EXTRAPOLATION = 0.2
"""How far beyond the first and the last transform a motion is carried on [s]."""
MEMORY = 30.0
"""How long transforms are remembered [s]."""
BACK = 1.0
"""Stamps that go back further than this mean that time starts again [s]."""
FRAMES = 500
"""So many frames are kept, and more if they move: some trackers give every object a frame."""
FLOAT32_RANGE = 4096.0
"""Nearer than this to its origin [m], a frame is resolved to 0.5 mm by float32."""


class Rewind:
    """
    Tells when the stamps of a stream start again: a recording that loops, a simulation reset.

    One message that is much older than the newest is a stray, two in a row are a new beginning.

    """

    def __init__(self) -> None:
        self._newest_ns: int | None = None
        self._was_back = False

    def happened(self, stamp_ns: int) -> bool:
        """Take the next stamp [ns] and tell whether time has started again before it."""
        newest_ns = stamp_ns if self._newest_ns is None else self._newest_ns
        is_back = stamp_ns < newest_ns - round(BACK * 1e9)
        happened, self._was_back = is_back and self._was_back, is_back and not self._was_back
        self._newest_ns = stamp_ns if happened else max(newest_ns, stamp_ns)
        return happened


class TransformTree:
    """
    Frames and the transforms between them, looked up by integer stamp.

    State: per pair of parent and child the samples of the last `memory` seconds, or one static
    transform. Samples of a pair whose stamps start again replace the old ones. Not thread-safe.

    Parameters
    ----------
    max_extrapolation : float
        How far outside of the known samples a stamp may lie [s]; there, the last known motion is
        carried on. Between samples, however far apart, positions are interpolated linearly and
        orientations along the shortest turn, as tf2 does.
    memory : float
        How long a sample is kept after the newest of its pair [s].

    """

    def __init__(
        self, max_extrapolation: float = MAX_EXTRAPOLATION, memory: float = MEMORY
    ) -> None:
        self._max_extrapolation_ns = round(max_extrapolation * 1e9)
        self._memory_ns = round(memory * 1e9)
        self.clear()

    def clear(self) -> None:
        """Forget all frames and transforms."""
        self._tf: dict[str, _Edge] = {}
        self._odometry: dict[str, _Edge] = {}
        self._routes: dict[tuple[str, str], list[tuple[_Edge, bool]]] = {}
        self._most = FRAMES

    def add_transforms(self, transforms: Iterable[Any], is_static: bool = False) -> None:
        """Add the ``geometry_msgs/TransformStamped`` of one TFMessage."""
        for item in transforms:
            position, turn = item.transform.translation, item.transform.rotation
            self._add(self._tf, item, position, turn, is_static)

    def add_odometry(self, msg: Any) -> None:
        """Add a ``nav_msgs/Odometry``: the pose of its child frame in its header's frame."""
        pose = msg.pose.pose
        self._add(self._odometry, msg, pose.position, pose.orientation, False)

    def rewind(self, stamp_ns: int) -> None:
        """Forget motions that are known beyond a stamp at which time has started again."""
        for edge in self._edges():
            edge.rewind(stamp_ns)

    def newest_ns(self) -> int | None:
        """Return the newest stamp of all motions; None if nothing moves [ns]."""
        return max(
            (e.stamps[-1] for e in self._edges() if e.stamps and not e.is_static), default=None
        )

    def lookup(self, target: str, source: str, stamp_ns: int) -> Floats:
        """
        Return ``T_target_source`` (4, 4) at a stamp.

        Raises
        ------
        TransformUnavailable
            If nothing connects the frames, or something that does is not known at the stamp.

        """
        T_target_source = np.eye(4)
        for edge, is_upward in self._route(target, source):
            T = edge.at(stamp_ns, self._max_extrapolation_ns)
            T_target_source = (T if is_upward else inverse(T)) @ T_target_source
        return T_target_source

    def connects(self, target: str, source: str) -> bool:
        """Tell whether transforms lead from `source` to `target`, at whatever stamp."""
        try:
            self._route(target, source)
        except TransformUnavailable:
            return False
        return True

    def covers(self, target: str, source: str, stamp_ns: int) -> bool:
        """Tell whether `lookup` would neither fail nor extrapolate."""
        return self.connects(target, source) and all(
            edge.covers(stamp_ns) for edge, _ in self._route(target, source)
        )

    def fixed_frame(self, source: str) -> str | None:
        """
        Return the frame that `source` moves in: the topmost it hangs from.

        That is the root of TF where TF knows a motion, or the header frame of the odometry that
        moves this root or is connected to `source` otherwise; None if nothing moves.

        """
        source = _name(source)
        top, path = source, []
        while top in self._tf and self._tf[top] not in path:
            path.append(self._tf[top])
            top = path[-1].parent
        if top in self._odometry:
            return self._odometry[top].parent
        if any(not edge.is_static for edge in path):
            return top
        for edge in self._odometry.values():
            if self.connects(edge.parent, source):
                return edge.parent
        return None

    def __str__(self) -> str:
        """Return all pairs of parent and child."""
        pairs = dict.fromkeys(f'{edge.parent} -> {edge.child}' for edge in self._edges())
        return ', '.join(pairs) or 'none'

    def frames(self) -> list[str]:
        """Return the names of all frames, sorted."""
        return sorted({name for edge in self._edges() for name in (edge.parent, edge.child)})

    def _add(
        self, edges: dict[str, _Edge], item: Any, position: Any, turn: Any, is_static: bool
    ) -> None:
        parent, child = _name(item.header.frame_id), _name(item.child_frame_id)
        if not parent or not child:
            return  # connects nothing, as tf2 has it; a failing lookup lists what is connected
        edge = edges.get(child)
        if edge is None or edge.parent != parent:
            edge = edges[child] = _Edge(parent, child, self._memory_ns)
            self._routes.clear()
        edge.is_static |= is_static
        stamp_ns = item.header.stamp.sec * 10**9 + item.header.stamp.nanosec
        edge.add(stamp_ns, (position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w))
        if len(edges) > self._most:
            oldest_ns = stamp_ns - self._memory_ns
            for name in [name for name, edge in edges.items() if edge.is_older(oldest_ns)]:
                del edges[name]
            self._most = max(FRAMES, 2 * len(edges))

    def _edges(self) -> list[_Edge]:
        return [*self._tf.values(), *self._odometry.values()]

    def _route(self, target: str, source: str) -> list[tuple[_Edge, bool]]:
        """Return the edges from `source` to `target`, each with True where it leads upward."""
        key = (_name(target), _name(source))
        if key not in self._routes:
            route = _connect(*key, self._tf.values())
            if route is None:
                route = _connect(*key, self._edges())
            if route is None:
                raise TransformUnavailable(
                    f'no transform from {source!r} to {target!r}; known: {self}; publish what '
                    f'is missing on /tf or as odometry, or choose another fixed frame'
                )
            self._routes[key] = route
        return self._routes[key]


class _Edge:
    """One parent and child: a static pose, or poses over time."""

    def __init__(self, parent: str, child: str, memory_ns: int) -> None:
        self.parent = parent
        self.child = child
        self._memory_ns = memory_ns
        self.is_static = False
        self.stamps: list[int] = []
        self._poses: list[Floats] = []
        self._rewind = Rewind()
        self._was_forgotten = False

    def add(self, stamp_ns: int, pose: tuple[float, ...]) -> None:
        """Add x y z qx qy qz qw; a second one of the same stamp replaces the first."""
        values = np.array(pose, dtype=np.float64)
        if not np.isfinite(values).all() or not np.any(values[3:]):
            return  # says nothing; a lookup reports the stamps that remain
        if self._rewind.happened(stamp_ns):
            self._forget()
            self._was_forgotten = True
        if self.is_static:
            first, end = 0, len(self.stamps)
        else:
            first, end = bisect_left(self.stamps, stamp_ns), bisect_right(self.stamps, stamp_ns)
        self.stamps[first:end], self._poses[first:end] = [stamp_ns], [values]
        old = bisect_left(self.stamps, self.stamps[-1] - self._memory_ns)
        # Two samples stay, whatever their age: a motion is carried on from two.
        old = max(min(old, len(self.stamps) - 2), 0)
        del self.stamps[:old], self._poses[:old]

    def rewind(self, stamp_ns: int) -> None:
        if not self.is_static and self.stamps and self.stamps[-1] > stamp_ns + BACK * 1e9:
            self._forget()
            self._was_forgotten = stamp_ns > 0  # what is read once more has not gone back
            self._rewind = Rewind()

    def _forget(self) -> None:
        self.stamps.clear()
        self._poses.clear()

    def is_older(self, stamp_ns: int) -> bool:
        return not self.is_static and bool(self.stamps) and self.stamps[-1] < stamp_ns

    def covers(self, stamp_ns: int) -> bool:
        if self.is_static:
            return bool(self.stamps)
        return bool(self.stamps) and self.stamps[0] <= stamp_ns <= self.stamps[-1]

    def at(self, stamp_ns: int, max_extrapolation_ns: int) -> Floats:
        """Return ``T_parent_child`` at a stamp."""
        stamps = self.stamps
        if not stamps:
            cause = 'none has come but what is NaN or has no orientation; look at its publisher'
            if self._was_forgotten:
                cause = 'no pose has come since time went back; look whether its publisher goes on'
            raise TransformUnavailable(f'transform {self.parent} -> {self.child}: {cause}')
        outside = max(stamps[0] - stamp_ns, stamp_ns - stamps[-1])
        # A motion is carried on from two samples: a single one tells no speed.
        if not self.is_static and outside > max_extrapolation_ns * (len(stamps) > 1):
            raise TransformUnavailable(
                f'transform {self.parent} -> {self.child} is known from {stamps[0]} to '
                f'{stamps[-1]} ns: expected to cover {stamp_ns} ns within '
                f'{max_extrapolation_ns * 1e-9:g} s; check that its stamps use the clock of the '
                f'point cloud'
            )
        if self.is_static or len(stamps) == 1:
            return matrix(self._poses[0])
        after = min(max(bisect_left(stamps, stamp_ns), 1), len(stamps) - 1)
        if stamps[after] == stamp_ns:
            return matrix(self._poses[after])
        before = after - 1
        share = (stamp_ns - stamps[before]) / (stamps[after] - stamps[before])
        return interpolated(self._poses[before], self._poses[after], share)


def matrix(pose: Floats) -> Floats:
    """Return T (4, 4) of x y z qx qy qz qw."""
    T = np.eye(4)
    T[:3, :3] = matrix_from_quaternion(pose[3:])
    T[:3, 3] = pose[:3]
    return T


def inverse(T: Floats) -> Floats:
    """Return the inverse of a rigid T (4, 4)."""
    inverted = np.eye(4)
    inverted[:3, :3] = T[:3, :3].T
    inverted[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return inverted


def interpolated(first: Floats, second: Floats, share: float) -> Floats:
    """Return T (4, 4) on the way between two poses: 0 the first, 1 the second, or beyond."""
    T = np.eye(4)
    T[:3, :3] = interpolate_rotation(first[3:], second[3:], share)
    T[:3, 3] = first[:3] + share * (second[:3] - first[:3])
    return T


def sweep_to_frame(sweep: Sweep, T_frame_sweep: Floats, frame_id: str) -> Sweep:
    """
    Return the sweep, points and origin, in another frame.

    float32 points stay float32 while the sensor is near enough to the frame's origin for their
    resolution; far from it (a map in UTM) they become float64.

    """
    points = sweep.points
    is_near = np.abs(T_frame_sweep[:3, 3]).max() < FLOAT32_RANGE
    kind = points.dtype if is_near else np.dtype(np.float64)
    R, t = T_frame_sweep[:3, :3], T_frame_sweep[:3, 3]
    moved, (x, y, z) = np.empty(points.T.shape, kind), points.astype(kind, copy=False).T
    for i, (a, b, c) in enumerate(R.astype(kind)):  # BLAS would start threads beside the solver's
        moved[i] = a * x + b * y + c * z + t[i].astype(kind)
    return replace(sweep, frame_id=frame_id, points=moved.T, origin=R @ sweep.origin + t)


def to_fixed_frame(
    item: Sweep | BoxArray, tree: TransformTree, fixed_frame: str
) -> Sweep | BoxArray:
    """
    Return a sweep or boxes in the fixed frame.

    Raises
    ------
    TransformUnavailable
        If none is known at its stamp.

    """
    T_fixed_item = tree.lookup(fixed_frame, item.frame_id, item.stamp_ns)
    if isinstance(item, Sweep):
        return sweep_to_frame(item, T_fixed_item, fixed_frame)
    return boxes_to_frame(item, T_fixed_item, fixed_frame)


def boxes_to_frame(boxes: BoxArray, T_frame_boxes: Floats, frame_id: str) -> BoxArray:
    """Return the boxes in another frame; what is NaN stays NaN."""
    moved = boxes.boxes.copy()
    R = T_frame_boxes[:3, :3]
    moved[:, X : Z + 1] = boxes.boxes[:, X : Z + 1] @ R.T + T_frame_boxes[:3, 3]
    moved[:, ROLL:] = rpy_from_matrix(R @ matrix_from_rpy(moved[:, ROLL:]))
    return replace(boxes, frame_id=frame_id, boxes=moved)


def _name(frame_id: str) -> str:
    """Return a frame's name as tf2 spells it: ROS 1 put a slash before it."""
    return frame_id.lstrip('/')


def _connect(target: str, source: str, edges: Iterable[_Edge]) -> list[tuple[_Edge, bool]] | None:
    """Return the shortest way from `source` to `target` over `edges`, or None."""
    neighbours: dict[str, list[tuple[_Edge, bool]]] = {}
    for edge in edges:
        neighbours.setdefault(edge.child, []).append((edge, True))
        neighbours.setdefault(edge.parent, []).append((edge, False))
    routes: dict[str, list[tuple[_Edge, bool]]] = {source: []}
    queue = [source]
    for frame in queue:
        for edge, is_upward in neighbours.get(frame, ()):
            following = edge.parent if is_upward else edge.child
            if following not in routes:
                routes[following] = [*routes[frame], (edge, is_upward)]
                queue.append(following)
    return routes.get(target)
