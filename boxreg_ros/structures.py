"""
Data that the packages exchange: frozen dataclasses, checked on construction.

They are equal only if they are the same object: their arrays have no truth value.

Shape letters of the whole package: ``B`` windows in a batch, ``N`` observations in a window,
``M`` points in an observation, ``K`` nearest points of Eq. 4, ``D`` optimised variables.

A box is nine numbers ``x y z length width height roll pitch yaw``: geometric centre [m], full
extents along its own axes [m], and R = Rz(yaw) Ry(pitch) Rx(roll) [rad], which maps box axes
(x forward, y left, z up) to the frame of the box. Stamps are integer nanoseconds from the message
header.

"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any, ClassVar, Self, TypeVar

from boxreg_ros.errors import ShapeError
import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

X, Y, Z, LENGTH, WIDTH, HEIGHT, ROLL, PITCH, YAW = range(9)
POSE = [X, Y, Z, ROLL, PITCH, YAW]
BOX_CENTER, BOX_EXTENT = slice(X, Z + 1), slice(LENGTH, HEIGHT + 1)
"""Columns of the centre and of the extents of a box."""
LARGEST_EXTENT = 1e3
"""Objects are smaller [m]; chosen: twice the longest ship."""
LARGEST_COORDINATE = 3e7
"""Centres are nearer to the origin [m]; maps have up to 20,037,509 m (Web Mercator)."""
LARGEST_BOX = np.array([LARGEST_COORDINATE] * 3 + [LARGEST_EXTENT] * 3 + [np.inf] * 3)
BOX_AXES = 'x y z length width height roll pitch yaw'
SHORTEST_PERIOD_NS, STAMPS_OF_UNIT = 10**6, 5
"""Sweeps are further apart on average [ns], and the stamps that show it; chosen: LiDARs run at up
to 100 Hz, and four of them on one vehicle may have stamps of almost the same time."""

REFINED, KEPT = 'refined', 'kept'
INTERPOLATED, EXTENDED, REJECTED = 'interpolated', 'extended', 'rejected'
COASTED = 'coasted'
ADDED = (INTERPOLATED, EXTENDED, COASTED)
"""Status of boxes that the input does not have."""
PROPOSED = 'proposed'
"""Status of a box that may be of an object, until a person accepts it; it is no label."""
HUMAN = 'human'
"""Status of a box that a person has corrected and pinned."""

KINEMATICS = np.dtype(
    [
        ('velocity', float, 4),
        ('velocity_covariance', float, (4, 4)),
        ('acceleration', float, 3),
        ('acceleration_covariance', float, (3, 3)),
        ('has_velocity', bool),
        ('has_acceleration', bool),
    ],
    align=True,
)
"""
Motion of one box over ground, in the axes of its frame, a record; finite always, 0 where unknown.

velocity, velocity_covariance
    Of x y z [m/s] and of yaw [rad/s], (4,) and (4, 4).
acceleration, acceleration_covariance
    Of x y z [m/s^2], (3,) and (3, 3).
has_velocity, has_acceleration
    Whether they are known.
"""

FLOAT32_RANGE = 4096.0
"""Nearer to the origin, float32 coordinates are 0.25 mm apart or less [m]: 2**(12 - 24) m."""
BLOCK_POINTS = 2**15
"""
Points that are moved at a time.

Swept: in blocks of 2^12, 2^15 and 2^20 a sweep of 130,000 points takes 1.2, 0.6 and 0.8 ms.

"""


def checked(
    name: str, value: ArrayLike, shape: tuple[int | None, ...], columns: str = ''
) -> Floats:
    """
    Return an array argument as float64, contiguous.

    Parameters
    ----------
    name : str
        Of the argument, for the error message.
    value : array_like
        The argument. An empty list has any `shape` of length 0.
    shape : tuple of int or None
        Expected shape; None for any length.
    columns : str
        Of the last axis, for the error message.

    Returns
    -------
    array : array of `shape`
        A copy only where needed.

    Raises
    ------
    ShapeError
        If `value` has another shape or is not numeric.

    """
    if value is None:  # of which numpy would make NaN
        raise ShapeError(f'{name}: expected {_expected(shape, columns)}, got None')
    try:
        array = np.ascontiguousarray(value, dtype=np.float64)
    except (RuntimeError, TypeError, ValueError) as error:  # torch raises RuntimeError
        expected = _expected(shape, columns)
        raise ShapeError(f'{name}: expected numbers of {expected}: {error}') from None
    if array.shape == (0,) and shape[0] in (None, 0):
        array = array.reshape(0, *(length or 0 for length in shape[1:]))
    _check_shape(name, array.shape, shape, columns)
    return array


def _check_shape(
    name: str, found: tuple[int, ...], shape: tuple[int | None, ...], columns: str = ''
) -> None:
    """Raise ShapeError if an array `found` has another shape than expected."""
    if found == shape:
        return
    lengths = zip(shape, found, strict=False)
    if len(found) != len(shape) or any(want not in (None, got) for want, got in lengths):
        raise ShapeError(f'{name}: expected {_expected(shape, columns)}, got {found}')


def checked_stamps(name: str, value: ArrayLike) -> Ints:
    """
    Return an argument of stamps as int64, shape (N,) [ns].

    Parameters
    ----------
    name : str
        Of the argument, for the error message.
    value : array_like
        Whole numbers [ns], or datetime64 of any unit.

    Raises
    ------
    ShapeError
        If the numbers are not whole, do not increase or have another unit.

    """
    given = np.asarray(value)
    if given.dtype.kind == 'M':
        given = given.astype('datetime64[ns]')
    if given.size and given.dtype.kind not in 'iuM':
        raise ShapeError(
            f'{name}: expected whole numbers [ns], got {given.dtype}; convert seconds by '
            f'(seconds * 1e9).round().astype(int)'
        )
    stamps_ns = given.astype(np.int64)
    if stamps_ns.ndim != 1 or (np.diff(stamps_ns) <= 0).any():
        raise ShapeError(
            f'{name}: expected (N,) strictly increasing [ns], got shape {stamps_ns.shape}; sort '
            f'them and remove repeated stamps'
        )
    n = len(stamps_ns)
    if n >= STAMPS_OF_UNIT:
        period_ns = int(stamps_ns[-1] - stamps_ns[0]) / (n - 1)
        if period_ns < SHORTEST_PERIOD_NS:
            raise ShapeError(
                f'{name}: expected nanoseconds, got stamps that are {period_ns:.4g} ns apart on '
                f'average, as of seconds, milliseconds or microseconds: multiply them'
            )
    return stamps_ns


def _expected(shape: tuple[int | None, ...], columns: str) -> str:
    """Return a shape for an error message."""
    text = 'shape ' + str(shape).replace('None', 'N')
    return f'{text} with the columns {columns}' if columns else text


def _check_stamp(stamp_ns: object) -> None:
    """Raise ShapeError for a stamp that is no integer, as one in seconds."""
    if not isinstance(stamp_ns, int | np.integer):
        raise ShapeError(
            f'stamp_ns: expected whole nanoseconds, got {stamp_ns!r}; '
            f'convert seconds by round(seconds * 1e9)'
        )


def is_valid_box(boxes: Floats) -> NDArray[np.bool_]:
    """
    Return which `boxes` (..., 9) can be of an object, shape (...).

    They are finite, their extents are positive and below `LARGEST_EXTENT`, and their centre lies
    within `LARGEST_COORDINATE`.

    """
    is_within = (np.abs(boxes) < LARGEST_BOX).all(axis=-1)
    is_sized = (boxes[..., BOX_EXTENT] > 0).all(axis=-1)
    return np.asarray(is_within & is_sized)


def finite_points(points: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the finite ones of points (M, 3); where all are, the same array."""
    is_finite = np.isfinite(points)
    # Row by row takes forty times as long.
    return points if is_finite.all() else points[is_finite.all(axis=1)]


def on_lines(at: NDArray[Any], values: Floats, wanted: NDArray[Any]) -> Floats:
    """
    Return rows interpolated linearly between those at ascending places.

    Parameters
    ----------
    at : array, shape (m,)
        Ascending places, as times [s] or stamps [ns].
    values : array, shape (m, k)
        Rows there. Angles are to be unwrapped before.
    wanted : array, shape (n,)
        Places to return rows at.

    Returns
    -------
    array, shape (n, k)
        Before the first place the first row, behind the last one the last row.

    """
    return np.stack([np.interp(wanted, at, column) for column in values.T], axis=1)


def _is_float_array(value: object) -> bool:
    """Return whether `value` is an array of single or double precision."""
    return isinstance(value, np.ndarray) and value.dtype in (np.float32, np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """
    A point cloud under one stamp: one revolution of a LiDAR, or several merged.

    Attributes
    ----------
    stamp_ns : int
        Header stamp [ns].
    frame_id : str
        Frame of the sweep: of `origin` and `origins`, and of `points` without `T_frame_points`.
    points : array, shape (M, 3)
        Finite points [m]; they are held, not copied: write the next cloud to another array.
    times : array, shape (M,), or None
        Time of measurement of each point relative to the stamp [s].
    origin : array, shape (3,)
        Position of the sensor at the stamp [m]; zero in the frame of the sensor; NaN where
        unknown. The mean of `origins` for several sensors.
    is_dropped : bool
        True for a sweep whose points were lost: boxes of its stamp do not wait for another.
    topic : str
        Topic that it was received on; empty if there is only one topic of point clouds.
    origins : array, shape (K, 3), or None
        Positions of several sensors [m]; None if all points are of the one at `origin`.
    sensors : array, shape (M,), or None
        Row of `origins` of the sensor that measured each point; None without `origins`.
    rows : array, shape (M,), or None
        Row of each point in its message; None where no point was left out.
    T_frame_points : array, shape (4, 4), or None
        Maps `points` to `frame_id`; None where they are in it. Boxes are brought to the points,
        which are a thousand times as many.

    """

    stamp_ns: int
    frame_id: str
    points: NDArray[np.floating]
    times: Floats | None = None
    origin: Floats = field(default_factory=lambda: np.zeros(3))
    is_dropped: bool = False
    topic: str = ''
    origins: Floats | None = None
    sensors: NDArray[np.uint8] | None = None
    rows: Ints | None = None
    T_frame_points: Floats | None = None

    def __post_init__(self) -> None:
        """Check the shapes; convert lists to arrays."""
        _check_stamp(self.stamp_ns)
        if not _is_float_array(self.points):  # clouds of either precision are not copied
            self._set('points', checked('points', self.points, (None, 3), 'x y z'))
        _check_shape('points', self.points.shape, (None, 3), 'x y z')
        self._set('origin', checked('origin', self.origin, (3,), 'x y z'))
        M = len(self.points)
        if self.times is not None:
            if not _is_float_array(self.times):
                self._set('times', checked('times', self.times, (M,)))
            _check_shape('times', self.times.shape, (M,))
        if (self.origins is None) != (self.sensors is None):
            raise ShapeError('origins and sensors: expected both or neither, got one of them')
        if self.sensors is not None:
            _check_shape('sensors', np.shape(self.sensors), (M,))
        if self.T_frame_points is not None:
            self._set('T_frame_points', checked('T_frame_points', self.T_frame_points, (4, 4)))

    def in_columns(self) -> 'Sweep':
        """Return the sweep with each of x, y and z together in memory, as kernels read them."""
        columns = self.points.T
        if columns.flags.c_contiguous:
            return self
        return replace(self, points=np.ascontiguousarray(columns).T)

    def in_frame(self) -> 'Sweep':
        """
        Return the sweep with its points in `frame_id`.

        float32 points stay float32 while the origin of their frame is within `FLOAT32_RANGE` of
        that of `frame_id`; farther away (a map in UTM) they become float64.

        """
        if self.T_frame_points is None:
            return self
        R, t = self.T_frame_points[:3, :3], self.T_frame_points[:3, 3]
        is_near = np.abs(t).max() < FLOAT32_RANGE
        kind = self.points.dtype if is_near else np.dtype(np.float64)
        columns = self.points.T
        moved = np.empty(columns.shape, kind)
        # Not R @: BLAS starts threads of its own. A block stays in the cache for all its sums.
        for first in range(0, columns.shape[1], BLOCK_POINTS):
            block = slice(first, first + BLOCK_POINTS)
            x, y, z = columns[:, block].astype(kind, copy=False)
            for (a, b, c), offset, row in zip(R.astype(kind), t.astype(kind), moved, strict=True):
                np.add(a * x + b * y + c * z, offset, out=row[block])
        return replace(self, points=moved.T, T_frame_points=None)

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)  # the class is frozen


def _texts(name: str, values: Sequence[str]) -> tuple[str, ...]:
    """Return texts as a tuple; raise ShapeError for numbers, of which 0 is taken for no id."""
    # The first stands for all: arrays of a thousand boxes are made several times per sweep.
    if isinstance(values, str) or not all(isinstance(value, str) for value in values[:1]):
        raise ShapeError(f'{name}: expected a tuple with a text for each box, got {values!r:.60}')
    return tuple(values)


@dataclass(frozen=True, slots=True, eq=False)
class FrameMotion:
    """
    Motion of the frame that boxes were measured in, up to their stamp.

    Attributes
    ----------
    stamps_ns : array, shape (K,)
        Ascending; the last is the stamp of the boxes [ns].
    T_fixed_frame : array, shape (K, 4, 4)
        Poses of the frame in that of the boxes.

    """

    stamps_ns: Ints
    T_fixed_frame: Floats

    def __post_init__(self) -> None:
        """Check the shapes."""
        K = len(self.stamps_ns)
        T = checked('T_fixed_frame', self.T_fixed_frame, (K, 4, 4))
        object.__setattr__(self, 'T_fixed_frame', T)  # the class is frozen


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """
    A record some of whose fields have a row for each of n items.

    Attributes
    ----------
    COLUMNS : tuple of str
        Names of these fields. Each is an array of n rows, a tuple of n, a record with columns of
        its own, or None or an empty tuple where no item has a value.

    """

    COLUMNS: ClassVar[tuple[str, ...]] = ()

    def take(self, rows: Sequence[int] | Ints) -> Self:
        """
        Return some of the items.

        Parameters
        ----------
        rows : sequence of int, or array of int, shape (k,)
            Which ones, in any order; no mask.

        Returns
        -------
        record
            Of the same class, with a row for each of `rows`, in their order; the other fields are
            shared.

        """
        return replace(
            self, **{name: _rows_of(getattr(self, name), rows) for name in self.COLUMNS}
        )


def _rows_of(column: Any, rows: Sequence[int] | Ints) -> Any:
    if isinstance(column, tuple):
        return tuple(map(column.__getitem__, rows)) if column else ()
    if isinstance(column, Columns):
        return column.take(rows)
    return None if column is None else column[rows]


_Columns = TypeVar('_Columns', bound=Columns)


def concatenated(records: Sequence[_Columns]) -> _Columns:
    """
    Return the items of several records as one record.

    Parameters
    ----------
    records : sequence of records with `Columns`
        At least one, of one class. A column that the first of them does not have (None) is left
        out.

    Returns
    -------
    record
        The fields that are no columns are those of the first, as stamp and frame.

    Raises
    ------
    ShapeError
        If some of several `BoxArray` have attributes and others with boxes have none.
    ValueError
        If the first of them has an array and another has None in its place.

    """
    first = records[0]
    parts = {name: [getattr(one, name) for one in records] for name in first.COLUMNS}
    return replace(first, **{name: _joined(columns) for name, columns in parts.items()})


def _joined(columns: Sequence[Any]) -> Any:
    if isinstance(columns[0], tuple):
        return tuple(chain.from_iterable(columns))
    if isinstance(columns[0], Columns):
        return concatenated(columns)
    return None if columns[0] is None else np.concatenate(columns)


@dataclass(frozen=True, slots=True, eq=False)
class BoxArray(Columns):
    """
    All boxes of one stamp; boxes without an identity have the track id ``''``.

    Attributes
    ----------
    stamp_ns : int
        Header stamp [ns].
    frame_id : str
        Frame of `boxes`.
    track_ids, class_names : tuple of n str
        Identity over time, and category.
    scores : array, shape (n,)
        Detector confidence.
    boxes : array, shape (n, 9)
        As defined in the docstring of the module; invalid boxes are allowed and returned as kept.
    ticket : object
        Any object of the caller; returned unchanged with the refined boxes, in their ``boxes``.
    pinned : array, shape (n,), or None
        True for boxes that a person has corrected: they are held, and the rest of their track
        follows them. None for none.
    motion : FrameMotion or None
        Of the frame that the boxes were measured in, before they were brought to `frame_id`: late
        boxes were measured at an earlier pose. None if that frame does not move in `frame_id`.
    attributes : tuple of n mappings of str to str, or empty
        Attributes of each object by name, as label files have them; empty where no box has any.
    kinematics : array, shape (n,), or None
        Velocities and accelerations, records `KINEMATICS`. None for an input.

    """

    COLUMNS: ClassVar[tuple[str, ...]] = (
        *('track_ids', 'class_names', 'scores', 'boxes', 'pinned', 'attributes', 'kinematics'),
    )

    stamp_ns: int
    frame_id: str
    track_ids: tuple[str, ...]
    class_names: tuple[str, ...]
    scores: Floats
    boxes: Floats
    ticket: object = field(default=None, repr=False)
    pinned: NDArray[np.bool_] | None = None
    motion: FrameMotion | None = None
    attributes: tuple[Mapping[str, str], ...] = ()
    kinematics: NDArray[np.void] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        """Check that all columns have one length; convert lists to arrays and tuples."""
        _check_stamp(self.stamp_ns)
        n = len(self.track_ids)
        self._set('track_ids', _texts('track_ids', self.track_ids))
        self._set('class_names', _texts('class_names', self.class_names))
        self._set('boxes', checked('boxes', self.boxes, (n, 9), BOX_AXES))
        self._set('scores', checked('scores', self.scores, (n,)))
        if len(self.class_names) != n:
            raise ShapeError(f'class_names: expected {n}, got {len(self.class_names)}')
        if self.pinned is not None:
            self._set('pinned', np.asarray(self.pinned, bool))
            _check_shape('pinned', self.pinned.shape, (n,))
        if self.kinematics is not None:
            _check_shape('kinematics', self.kinematics.shape, (n,))
        if self.attributes:  # those of another box are a fault that no number shows
            _check_shape('attributes', (len(self.attributes),), (n,))

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)  # the class is frozen

    @classmethod
    def empty(cls, stamp_ns: int, frame_id: str) -> Self:
        """Return an array without boxes."""
        return cls(stamp_ns, frame_id, (), (), np.zeros(0), np.zeros((0, 9)))

    def plain(self) -> Self:
        """Return them without attributes and `kinematics`, of which a result has its own."""
        return replace(self, attributes=(), kinematics=None)

    def attributes_of(self, row: int) -> Mapping[str, str]:
        """Return the attributes of a box by name."""
        return self.attributes[row] if self.attributes else {}

    @property
    def is_pinned(self) -> NDArray[np.bool_]:
        """Return which boxes are `pinned`, shape (n,)."""
        return np.zeros(len(self.track_ids), bool) if self.pinned is None else self.pinned

    @property
    def known_kinematics(self) -> NDArray[np.void]:
        """Return `kinematics`, those of an input as unknown."""
        if self.kinematics is None:
            return np.zeros(len(self.track_ids), KINEMATICS)
        return self.kinematics


@dataclass(frozen=True, slots=True, eq=False)
class RefinedBoxes(Columns):
    """
    The refined boxes of one box array, in the order of the input.

    Attributes
    ----------
    boxes : BoxArray
        Refined boxes, otherwise as in the input: stamp, frame, ids, scores and ticket.
    status : tuple of n str
        ``refined``, ``kept`` (the input box is returned unchanged), ``rejected`` (likewise, and
        no object), ``interpolated``, ``extended`` or ``coasted`` (the input has no such box), or
        ``human`` (a pinned box).
    reasons : tuple of n str
        Why a box was kept or rejected; empty for the others.
    num_points : array, shape (n,)
        Sweep points inside the input box.
    covariances : array, shape (n, 6, 6)
        Covariance of x y z roll pitch yaw [m, rad]; always finite, identity for kept boxes.
    is_final : bool
        False for an early estimate (the newest box of its window), True for the last estimate.
    extent_covariances : array, shape (n, 3, 3)
        Covariance of length, width and height [m]; always finite, identity for kept boxes.
    face_distances : array, shape (n, 6)
        Signed distance of the outermost points of each face (front, rear, left, right, top,
        bottom) from where they are expected, by the extents of the box and the labelling margins
        of other tracks, positive outside [m]; 0 without points.
    near_points : array, shape (n, 2)
        Numbers of sampled points inside the box, and near it but outside; points of the road do
        not count.

    """

    COLUMNS: ClassVar[tuple[str, ...]] = (
        *('boxes', 'status', 'reasons', 'num_points', 'covariances', 'extent_covariances'),
        *('face_distances', 'near_points'),
    )

    boxes: BoxArray
    status: tuple[str, ...]
    reasons: tuple[str, ...]
    num_points: Ints
    covariances: Floats
    is_final: bool = True
    extent_covariances: Floats = field(default_factory=lambda: np.zeros((0, 3, 3)))
    face_distances: Floats = field(default_factory=lambda: np.zeros((0, 6)))
    near_points: Ints = field(default_factory=lambda: np.zeros((0, 2), np.int64))

    def __post_init__(self) -> None:
        """Complete the columns that label files and messages do not have."""
        n = len(self.status)
        if len(self.extent_covariances) != n:
            object.__setattr__(self, 'extent_covariances', np.tile(np.eye(3), (n, 1, 1)))
        if len(self.face_distances) != n:
            object.__setattr__(self, 'face_distances', np.zeros((n, 6)))
        if len(self.near_points) != n:
            object.__setattr__(self, 'near_points', np.zeros((n, 2), np.int64))

    def without(self, *words: str) -> 'RefinedBoxes':
        """
        Return the boxes whose status is none of some words.

        Parameters
        ----------
        *words : str
            Statuses to leave out, as ``coasted``.

        Returns
        -------
        refined : RefinedBoxes
            The others in their order; itself if these are all.

        """
        rows = [row for row, word in enumerate(self.status) if word not in words]
        return self if len(rows) == len(self.status) else self.take(rows)


def kept(boxes: BoxArray, reason: str) -> RefinedBoxes:
    """
    Return boxes as a result in which each is kept for the same reason.

    Parameters
    ----------
    boxes : BoxArray
        n boxes, in any frame; invalid ones too.
    reason : str
        Why, as one of `Reason`.

    Returns
    -------
    refined : RefinedBoxes
        Final, with the boxes as they are, no points, and unit covariances.

    """
    n = len(boxes.track_ids)
    unknown = np.broadcast_to(np.eye(6), (n, 6, 6))
    return RefinedBoxes(boxes, (KEPT,) * n, (str(reason),) * n, np.zeros(n, np.int64), unknown)


def with_rejected(
    refined: RefinedBoxes, gone: BoxArray, rows: Sequence[int], reasons: Sequence[str]
) -> RefinedBoxes:
    """
    Return a result with boxes that were not registered as rejected ones.

    Parameters
    ----------
    refined : RefinedBoxes
        Of the other boxes of the input, and of added ones behind them.
    gone : BoxArray
        The k boxes that were not registered.
    rows : sequence of k int
        Their rows in the input, ascending.
    reasons : sequence of k str
        Why each was rejected.

    """
    rejected = replace(kept(gone, ''), status=(REJECTED,) * len(rows), reasons=tuple(reasons))
    parts = [
        replace(
            one,
            boxes=replace(one.boxes, pinned=None, kinematics=one.boxes.known_kinematics),
        )
        for one in (refined, rejected)
    ]
    first = len(refined.status)
    places = np.array(rows, np.int64) - np.arange(len(rows))
    order = np.insert(np.arange(first), places, first + np.arange(len(rows)))
    return concatenated(parts).take(order)
