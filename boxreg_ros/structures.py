"""
What travels between the floors: plain, frozen, checked once on construction.

Shape letters of the whole package: ``B`` windows in a batch, ``N`` observations in a window,
``M`` points in an observation, ``K`` nearest points of Eq. 4, ``D`` optimised variables.

A box is nine numbers ``x y z length width height roll pitch yaw``: geometric centre [m], full
extents along its own axes [m], and R = Rz(yaw) Ry(pitch) Rx(roll) [rad] turning box axes
(x forward, y left, z up) into the frame it is given in. Stamps are integer nanoseconds from the
message header.

"""

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
    except (RuntimeError, TypeError, ValueError) as error:  # torch says it its way
        raise ShapeError(f'{name}: expected numbers of shape {wanted}: {error}') from None
    fits = [want in (None, got) for want, got in zip(shape, array.shape, strict=False)]
    if array.ndim != len(shape) or not all(fits):
        raise ShapeError(f'{name}: expected shape {wanted}, got {array.shape}')
    return array


def is_valid_box(boxes: Floats) -> NDArray[np.bool_]:
    """Return which of `boxes` (..., 9) are finite with positive extents, shape (...)."""
    is_finite = np.isfinite(boxes).all(axis=-1)
    return np.asarray(is_finite & (boxes[..., LENGTH : HEIGHT + 1] > 0).all(axis=-1))


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
    is_dropped : bool
        True for one that is known to have been, while its points are not: nothing is to be
        waited for.

    """

    stamp_ns: int
    frame_id: str
    points: NDArray[np.floating]
    times: Floats | None = None
    origin: Floats = field(default_factory=lambda: np.zeros(3))
    is_dropped: bool = False

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
    ticket : object
        Whatever the caller wants back with the refined boxes of this array, which carry it
        unchanged; never looked at.

    """

    stamp_ns: int
    frame_id: str
    track_ids: tuple[str, ...]
    class_names: tuple[str, ...]
    scores: Floats
    boxes: Floats
    ticket: object = field(default=None, compare=False, repr=False)

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
