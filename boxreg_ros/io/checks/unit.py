"""Check of the unit of boxes: their extents, and their distances beside those of the points."""

from __future__ import annotations

from boxreg_ros.io.checks.finding import advice
from boxreg_ros.io.checks.place import ENOUGH_BOXES, MAX_COMPARED
from boxreg_ros.structures import BOX_CENTER, BOX_EXTENT, BoxArray, finite_points, Floats, Sweep
import numpy as np

REACH_POINTS = 1000
"""Points of a cloud that its reach is taken of; chosen."""
MAX_LENGTH = 50.0
"""Median of the longest extents that no objects have [m]; chosen: trams 40, people in cm 170."""
USUAL_LENGTH = 4.0
"""Longest extent of a usual object [m]; derived: people have 1.7, trucks 10 m."""
MAX_DISTANCES = 10.0
"""Times the reach of the points that boxes may be away, in the median; chosen: a power of ten."""
UNITS = {2: 'centimetres', 3: 'millimetres'}
"""Names of units by the power of ten that a metre has of them."""


class UnitCheck:
    """Compare the first boxes, in the frame of their message or another, with what metres give."""

    def __init__(self) -> None:
        self._origin: Floats | None = None
        self._reach = 0.0
        self._lengths: list[float] = []
        self._distances: list[float] = []

    def add(self, item: Sweep | BoxArray, T_fixed_item: Floats) -> None:
        """
        Add the next sweep or boxes.

        Parameters
        ----------
        item : Sweep or BoxArray
            In the fixed frame; numbers that are not finite are left out.
        T_fixed_item : array, shape (4, 4)
            Pose of the frame of its message in the fixed frame: that of a sweep is the place that
            distances are counted from.

        """
        if len(self._lengths) >= MAX_COMPARED:
            return
        if isinstance(item, Sweep):
            step = max(1, len(item.points) // REACH_POINTS)
            few = Sweep(0, '', item.points[::step], T_frame_points=item.T_frame_points)
            points = finite_points(few.in_frame().points)
            if len(points):
                self._origin = T_fixed_item[:3, 3]
                ranges = np.linalg.norm(points - self._origin, axis=1)
                self._reach = max(self._reach, float(np.quantile(ranges, 0.99)))
            return
        boxes = item.boxes[np.isfinite(item.boxes).all(axis=1)]
        self._lengths += boxes[:, BOX_EXTENT].max(axis=1).tolist()
        if self._origin is not None:
            away = np.linalg.norm(boxes[:, BOX_CENTER] - self._origin, axis=1)
            self._distances += away.tolist()

    @property
    def finding(self) -> str:
        """Return that the boxes are not in metres, and what to do; '' if they may be."""
        if len(self._lengths) < ENOUGH_BOXES:
            return ''
        length = float(np.median(self._lengths))
        enough = self._reach and len(self._distances) >= ENOUGH_BOXES
        away = float(np.median(self._distances)) if enough else 0.0
        is_far = enough and away > MAX_DISTANCES * self._reach
        if length > MAX_LENGTH:
            power = max(2, round(np.log10(length / USUAL_LENGTH)))
            remedy = (
                f'divide their extents and positions by {10**power}, where they are made or in a '
                f'copy of the recording'
                if is_far
                else advice('size_scale', f'{10.0**-power:g}')
            )
            return (
                f'boxes: expected extents in metres, got a longest one of {length:.4g} in the '
                f'median: they are in {UNITS.get(power, "another unit")}; {remedy}'
            )
        if not is_far:
            return ''
        return (
            f'boxes: expected positions in metres, in the frame of their messages, got boxes '
            f'{away:.0f} m from the LiDAR in the median, and points up to {self._reach:.2g} m '
            f'from it: the positions are in centimetres or millimetres, or of another frame, or '
            f'the points are not in metres; scale them where they are made, or name the frame of '
            f'the boxes by boxes_frame (boxreg relabel: --boxes-frame)'
        )
