"""Poses of one frame in another over time, and what frames one is attached to."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from operator import attrgetter

from boxreg_ros.errors import TransformUnavailable
from boxreg_ros.io.clocks import ReceiveTimes
from boxreg_ros.io.time_jumps import is_near, StreamClock, TIME_JUMP
from boxreg_ros.io.transforms import between, interpolated, matrix, Pose
from boxreg_ros.structures import Floats
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
IF_LATE = 'where it comes late or rarely, raise transform_timeout of the node'
"""Remedy for transforms that arrive after the messages that need them."""
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
CHANGES_OF_PARENT = 3
"""Changes between parents of a moving frame that two publishers make; chosen: a frame that is
attached to another and back again has changed twice."""


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

    def __init__(self, parent: str, child: str, buffer_ns: int, looks_ahead: bool = True) -> None:
        self.parent = parent
        self.child = child
        self._buffer_ns = buffer_ns
        self._looks_ahead = looks_ahead
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
        self._before: Edge | None = None  # samples before time went back, see `forget_before`
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
        before = self._last_added
        self._last_added = stamp_ns, values
        self._last_found = None
        is_old = self._is_old(stamp_ns)
        has_jumped = self.jumps_to(stamp_ns)
        if has_jumped:
            self._keep_before(stamp_ns)
            self._forget()
            self._was_forgotten = True
            if before is not None and abs(before[0] - stamp_ns) <= round(TIME_JUMP * 1e9):
                self.stamps, self.poses = [before[0]], [before[1]]  # the first one behind it
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

    def _is_old(self, stamp_ns: int) -> bool:
        return bool(self.stamps) and stamp_ns < self.stamps[-1] - round(TIME_JUMP * 1e9)

    def jumps_to(self, stamp_ns: int) -> bool:
        """Return whether a sample of a stamp is a time jump back: a single old one is none."""
        return self._was_old and self._is_old(stamp_ns)

    def _keep_before(self, stamp_ns: int) -> None:
        """Keep the samples behind a stamp that time goes back to, for clouds and boxes of then."""
        first = bisect_right(self.stamps, stamp_ns + round(TIME_JUMP * 1e9))
        self._before = Edge(self.parent, self.child, self._buffer_ns, self._looks_ahead)
        self._before.stamps, self._before.poses = self.stamps[first:], self.poses[first:]

    def forget_before(self) -> None:
        """Forget the samples before time went back: clouds and boxes have gone back, too."""
        self._before = None
        self._last_found = None

    def _known_before(self, stamp_ns: int) -> Edge | None:
        """Return the samples before time went back, if a stamp is of then; else None."""
        jump_ns = round(TIME_JUMP * 1e9)
        before = self._before
        if before is None or (self.stamps and stamp_ns <= self.stamps[-1] + jump_ns):
            return None
        return before if before.stamps[0] <= stamp_ns <= before.stamps[-1] + jump_ns else None

    def rewind(self, stamp_ns: int) -> None:
        """Forget later samples; at 0 the recording is read again."""
        self.forget_before()
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
        self.arrivals = ReceiveTimes()
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
        stamps = (self._known_before(stamp_ns) or self).stamps
        return bool(stamps) and stamps[0] <= stamp_ns <= stamps[-1]

    def is_final(self, stamp_ns: int) -> bool:
        """
        Return whether no later sample changes the pose at a stamp.

        It is between samples, before the first ones, or of the time before a jump.

        """
        is_first = len(self.stamps) > 1 and stamp_ns < self.stamps[0]
        return is_first or self._known_before(stamp_ns) is not None or self.covers(stamp_ns)

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
        before = self._known_before(stamp_ns)
        if before is not None:
            return before._at(stamp_ns)
        stamps = self.stamps
        if not stamps:
            cause = 'all poses are NaN or have no orientation; check its publisher'
            if self._last_added is not None:  # it was read before, and is read again
                cause = 'its poses begin later; a part without them is left out by --start'
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
            return f'check that its stamps use the clock of the point cloud; {IF_LATE}'
        period_ns = float(np.median(np.diff(self.stamps)))
        if period_ns > MAX_LINEAR_GAP * 1e9 and outside_ns < 2 * period_ns:
            return (
                f'it comes every {period_ns * 1e-9:.2g} s, too rarely to carry the motion on for '
                f'{outside_ns * 1e-9:.2g} s; use a faster source of motion, if there is one: '
                f'--odometry TOPIC comes before TF; {IF_LATE}'
            )
        if outside_ns < END_NS:
            return (
                f'nothing to do where the recording begins or ends; elsewhere transforms are '
                f'missing, or the stamp is late; {IF_LATE}'
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
        if self._before is not None:
            return np.array([self._at(one) for one in stamps_ns])
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
        return matrix(between(first, np.array([self.poses[row] for row in after]), shares))

    def _nodes(self, after: int) -> list[int]:
        """
        Return the rows of the samples to interpolate the gap before row `after` by.

        Over a long gap there is a further one on each side, where it is known, about as far apart
        as the gap is long: the noise of a nearer one would be multiplied by the ratio of both.
        That behind the gap is left out where messages are processed as soon as the gap has ended.

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
        if self._looks_ahead and later < len(stamps) and stamps[later] - stamps[after] <= limit_ns:
            nodes.append(later)
        return nodes


def _differ(one: Floats, other: Floats) -> bool:
    """Return whether two poses (7,) are further apart than rounding explains."""
    cosine = one[3:] @ other[3:] / np.sqrt((one[3:] @ one[3:]) * (other[3:] @ other[3:]))
    apart = np.linalg.norm(one[:3] - other[:3])
    return bool(apart > SAME_POSITION or abs(cosine) < np.cos(SAME_ANGLE / 2))
