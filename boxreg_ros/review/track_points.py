"""Points of a recording near the boxes of its tracks, for the report."""

from __future__ import annotations

from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.observation import crop
from boxreg_ros.io.stamp_join import nearest_rows
from boxreg_ros.review.changes import TrackChanges
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import BoxArray, Floats, is_valid_box, on_lines, ROLL, Sweep, X, Z
import numpy as np
from numpy.typing import NDArray

SHOWN_MARGIN = 0.6
"""Points up to this far outside a box are shown [m]; chosen."""
GATHERED_MARGIN = 1.6
"""Points up to this far outside a box are gathered [m]: a refined box may be 1 m off it."""
GATHERED_POINTS = 400
"""Most points gathered of one box; derived: 100,000 boxes take 240 MB."""
MILLIMETRES = 1000.0
"""Points are stored as 16-bit integers in this unit [1/m]: up to 32 m from the centre."""


class _Gathered(NamedTuple):
    """Points around a centre (3,) in its frame, and when they were measured."""

    center: Floats
    offsets: NDArray[np.int16]
    """(M, 3), from the centre [mm]."""
    sweep_delay: float
    """Stamp of the sweep relative to that of the box [s]."""
    times: NDArray[np.float32] | None
    """(M,), relative to the stamp of the sweep, None where unknown [s]."""


class PointCollector:
    """
    Gather the points around the input boxes, and around added ones, while a recording is read.

    The recording is read once: points are gathered before the boxes are refined. `stamps_ns` are
    those of the box arrays, those without boxes included.

    """

    def __init__(self, config: Config) -> None:
        self.stamps_ns: set[int] = set()
        self.settle(config)
        self._gathered: dict[tuple[int, str], _Gathered] = {}
        self._origins: dict[int, Floats] = {}

    def settle(self, config: Config) -> None:
        """Take over settings that a run has resolved: whether boxes hold at their stamp."""
        sampling = config.sampling
        self._is_at_stamp = sampling.deskew and sampling.box_time == 'stamp'

    def note(self, item: Sweep | BoxArray) -> None:
        """Note the stamp of a box array, or where the sensor was at that of a sweep."""
        if isinstance(item, Sweep):
            self._origins[item.stamp_ns] = item.origin
        else:
            self.stamps_ns.add(item.stamp_ns)

    @property
    def origins(self) -> Floats:
        """Return the positions of the sensor in the fixed frame by stamp, shape (n, 3) [m]."""
        return np.array([self._origins[stamp] for stamp in sorted(self._origins)]).reshape(-1, 3)

    def points_of(self, track: TrackChanges) -> list[Floats]:
        """Return points near each box of a track, moved to its stamp, n arrays (M_i, 3) [m]."""
        is_known = np.asarray(np.isfinite(track.boxes).all(axis=1))
        given = np.where(np.isfinite(track.given), track.given, track.boxes)  # of added boxes
        both = np.stack([given, track.boxes])
        R = matrix_from_rpy(np.where(is_known[:, None], both[..., ROLL:], 0.0))
        points = []
        for row, stamp_ns in enumerate(track.stamps_ns.tolist()):
            found = self._gathered.get((stamp_ns, track.input_ids[row] or track.track_id))
            if found is None or not is_known[row]:
                points.append(np.zeros((0, 3)))
                continue
            delays = np.array([found.sweep_delay])
            if self._is_at_stamp and found.times is not None:
                delays = delays + found.times
            motion = _motion_to_stamp(track, row, delays)
            near = found.offsets / MILLIMETRES + found.center + motion
            local = (near - both[:, row, None, : Z + 1]) @ R[:, row]
            limit = both[:, row, None, Z + 1 : ROLL] / 2 + SHOWN_MARGIN
            is_shown = (np.abs(local) < limit).all(axis=2).any(axis=0)
            points.append(near[is_shown])
        return points

    def sensor_at(self, stamps_ns: NDArray[np.int64]) -> Floats:
        """Return the position of the sensor (n, 3) nearest in time to each stamp, or NaN [m]."""
        if not self._origins:
            return np.full((len(stamps_ns), 3), np.nan)
        known = np.array(sorted(self._origins))
        return self.origins[nearest_rows(stamps_ns, known)]

    def gather(self, boxes: BoxArray, sweep: Sweep | None) -> None:
        """
        Gather the points of a sweep around its boxes; of two boxes with one id the first counts.

        Parameters
        ----------
        boxes : BoxArray
            In the fixed frame; invalid ones have no points.
        sweep : Sweep or None
            In the same frame; None where the boxes have none.

        """
        rows = np.flatnonzero(is_valid_box(boxes.boxes))
        if sweep is None or not len(rows):
            return
        near = crop(sweep, boxes.boxes[rows], GATHERED_MARGIN)
        is_near = near.outside.max(0) < GATHERED_MARGIN
        owners = near.owner[is_near]
        offsets = to_millimetres(near.offset[:, is_near].T)
        delay = (sweep.stamp_ns - boxes.stamp_ns) * 1e-9
        times = None
        if sweep.times is not None:
            times = sweep.times[near.row[is_near]].astype(np.float32)
        ends = np.searchsorted(owners, np.arange(len(rows) + 1))
        for row, begin, end in zip(rows.tolist(), ends[:-1], ends[1:], strict=True):
            step = max(1, -(-(end - begin) // GATHERED_POINTS))
            part = slice(begin, end, step)
            key = boxes.stamp_ns, boxes.track_ids[row]
            center = boxes.boxes[row, : Z + 1].copy()
            own_times = None if times is None else times[part].copy()
            found = _Gathered(center, offsets[part].copy(), delay, own_times)
            self._gathered.setdefault(key, found)  # of two boxes of one id the first counts


def to_millimetres(offsets: Floats) -> NDArray[np.int16]:
    """Return `offsets` [m] as 16-bit integers [mm]; those beyond 32 m are clipped."""
    limit = np.iinfo(np.int16).max
    return np.rint(offsets * MILLIMETRES).clip(-limit, limit).astype(np.int16)


def _motion_to_stamp(track: TrackChanges, row: int, delays: NDArray[np.floating]) -> Floats:
    """Return how far the box moves from `delays` (n,) after its stamp back to it, (n or 1, 3)."""
    if not delays.any():
        return np.zeros((1, 3))
    is_known = np.isfinite(track.boxes[:, X])
    times = (track.stamps_ns[is_known] - track.stamps_ns[row]) * 1e-9
    centers = track.boxes[is_known, : Z + 1]
    return np.asarray(track.boxes[row, : Z + 1] - on_lines(times, centers, delays))
