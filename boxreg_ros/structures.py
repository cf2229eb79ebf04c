"""
What travels between the floors: plain, frozen, checked once on construction.

Shape letters of the whole package: ``B`` windows in a batch, ``N`` observations in a window,
``M`` points in an observation, ``K`` nearest points of Eq. 4, ``D`` optimised variables.

A box is nine numbers ``x y z length width height roll pitch yaw``: geometric centre [m], full
extents along its own axes [m], and R = Rz(yaw) Ry(pitch) Rx(roll) [rad] turning box axes
(x forward, y left, z up) into the frame it is given in. Stamps are integer nanoseconds from the
message header.

"""

from collections.abc import Sequence
from dataclasses import dataclass, field

from boxreg_ros.errors import ShapeError
import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

X, Y, Z, LENGTH, WIDTH, HEIGHT, ROLL, PITCH, YAW = range(9)
POSE = [X, Y, Z, ROLL, PITCH, YAW]

REFINED, KEPT, INTERPOLATED = 'refined', 'kept', 'interpolated'


def checked(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> Floats:
    """Return `value` as float64 of `shape` (None: any length), or raise ShapeError."""
    wanted = str(shape).replace('None', 'N')
    try:
        array = np.ascontiguousarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ShapeError(f'{name}: expected numbers of shape {wanted}: {error}') from None
    if array.ndim != len(shape) or any(
        want not in (None, got) for want, got in zip(shape, array.shape, strict=True)
    ):
        raise ShapeError(f'{name}: expected shape {wanted}, got {array.shape}')
    return array


@dataclass(frozen=True, slots=True)
class Sweep:
    """
    One LiDAR revolution under one stamp.

    Attributes
    ----------
    stamp_ns : int
        Header stamp [ns].
    frame_id : str
        Frame of `points` and `origin`.
    points : array, shape (M, 3)
        Finite returns [m].
    times : array, shape (M,), or None
        When each point was measured, relative to the stamp [s].
    origin : array, shape (3,)
        Where the sensor was at the stamp [m]; zero in the sensor's own frame.
    is_lost : bool
        True for one that is known to have been, while its points are not: nothing is to be
        waited for.

    """

    stamp_ns: int
    frame_id: str
    points: NDArray[np.floating]
    times: Floats | None = None
    origin: Floats = field(default_factory=lambda: np.zeros(3))
    is_lost: bool = False

    def __post_init__(self) -> None:
        """Check the shapes."""
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise ShapeError(f'points: expected shape (M, 3), got {self.points.shape}')
        if self.times is not None and self.times.shape != self.points.shape[:1]:
            raise ShapeError(f'times: expected {self.points.shape[:1]}, got {self.times.shape}')


@dataclass(frozen=True, slots=True)
class BoxArray:
    """
    All boxes of one stamp; boxes without an identity carry the track id ``''``.

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
        As defined in the module's docstring; may hold invalid boxes, which the core keeps out.

    """

    stamp_ns: int
    frame_id: str
    track_ids: tuple[str, ...]
    class_names: tuple[str, ...]
    scores: Floats
    boxes: Floats

    def __post_init__(self) -> None:
        """Check that all columns have one length."""
        n = len(self.track_ids)
        checked('boxes', self.boxes, (n, 9))
        checked('scores', self.scores, (n,))
        if len(self.class_names) != n:
            raise ShapeError(f'class_names: expected {n}, got {len(self.class_names)}')


@dataclass(frozen=True, slots=True)
class RefinedBoxes:
    """
    What the core made of (some) boxes of one stamp, in the order of the input.

    Attributes
    ----------
    boxes : BoxArray
        Identity and refined boxes in the frame named there.
    status : tuple of n str
        ``refined``, ``kept`` (the input box, evidence too weak) or ``interpolated``.
    reasons : tuple of n str
        Why a box was kept; empty for the others.
    num_points : array, shape (n,)
        Sweep points inside the input box.
    covariances : array, shape (n, 6, 6)
        Of x y z roll pitch yaw; NaN-free, large where nothing is known.
    is_final : bool
        False for an early estimate (newest box of its window), True for a final one.

    """

    boxes: BoxArray
    status: tuple[str, ...]
    reasons: tuple[str, ...]
    num_points: Ints
    covariances: Floats
    is_final: bool = True


@dataclass(frozen=True, slots=True)
class Track:
    """
    One object over time, as arrays in the fixed frame.

    Attributes
    ----------
    track_id, class_name : str
        Identity and category.
    stamps_ns : array, shape (N,)
        Strictly increasing [ns].
    boxes : array, shape (N, 9)
        Input boxes.
    points : sequence of N arrays, shape (M_i, 3)
        Returns on and around the object [m]; M_i may be 0.
    sensor_origins : array, shape (N, 3), or None
        Where the sensor was [m]; without it visible faces are told by the points' centre of mass.
    scores : array, shape (N,), or None
        Detector confidence.

    """

    track_id: str
    class_name: str
    stamps_ns: Ints
    boxes: Floats
    points: Sequence[NDArray[np.floating]]
    sensor_origins: Floats | None = None
    scores: Floats | None = None

    def __post_init__(self) -> None:
        """Check shapes and order; convert lists to arrays."""
        stamps = np.asarray(self.stamps_ns, dtype=np.int64)
        if stamps.ndim != 1 or (np.diff(stamps) <= 0).any():
            raise ShapeError(
                f'stamps_ns of track {self.track_id!r}: expected (N,) strictly increasing [ns]'
            )
        n = len(stamps)
        object.__setattr__(self, 'stamps_ns', stamps)
        object.__setattr__(self, 'boxes', checked('boxes', self.boxes, (n, 9)))
        if len(self.points) != n:
            raise ShapeError(
                f'points of track {self.track_id!r}: expected {n}, got {len(self.points)}'
            )
        rows = [p if np.size(p) else np.zeros((0, 3)) for p in self.points]
        points = tuple(checked(f'points[{i}]', p, (None, 3)) for i, p in enumerate(rows))
        object.__setattr__(self, 'points', points)
        for name, shape in (('sensor_origins', (n, 3)), ('scores', (n,))):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, checked(name, value, shape))


@dataclass(frozen=True, slots=True)
class RefinedTrack:
    """
    What `refine` returns for one track, row by row with its input.

    Attributes
    ----------
    track_id : str
        That of the input.
    boxes : array, shape (N, 9)
        Refined boxes, fixed frame.
    status : tuple of N str
        ``refined``, ``kept`` or ``interpolated``.
    reasons : tuple of N str
        Why a box was kept; empty for the others.
    covariances : array, shape (N, 6, 6)
        Of x y z roll pitch yaw [m, rad].

    """

    track_id: str
    boxes: Floats
    status: tuple[str, ...]
    reasons: tuple[str, ...]
    covariances: Floats
