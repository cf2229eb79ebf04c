"""
Every number of the objective and of its weights: value, unit, origin.

*Derived* numbers follow from a formula, those of the *literature* from a citation, *measured* ones
from data; all others are *chosen*, and `make results` halves and doubles each of them.

"""

from functools import lru_cache
from math import inf
from typing import Any, NamedTuple

from boxreg_ros.core.method.arrays import BOTTOM
from boxreg_ros.core.method.residuals import RESIDUALS
import numpy as np
from numpy.typing import NDArray

RESIDUAL_NAMES = tuple(row.name for row in RESIDUALS)


class Constants(NamedTuple):
    """
    The numbers of the method; `with_settings` fills in those of the settings, once a batch.

    Deviations are standard deviations. Lengths are in metres, angles in radians, times in seconds.

    """

    # Face observations (M10) to (M12)
    outside_margin: float = 0.35
    """Points up to this far outside of a face count as points of the object [m]. Chosen."""
    edge_margin: float = 0.2
    """The same beside the edges of the face [m]. Chosen."""
    deepest: float = 0.7
    """Points further inside of a face are on none of its surfaces [m]. Chosen."""
    max_depth: float = 0.2
    """Points further behind the outermost one are on another surface, such as a wheel [m].
    Chosen: without it .01 to .02 of 3D IoU are lost."""
    min_face_points: int = 3
    """Fewest points of a face observation, and of a strip. Derived: three span a plane."""
    strips: int = 3
    """Strips side by side on each face. Chosen: yaw stays observable where one is empty."""
    visibility_softness: float = 0.25
    """Square of the tangent over which a face turns from visible to occluded (M11). Chosen."""
    edge_lead: tuple[float, ...] = (0.0, 0.0, 0.2, 0.2, 0.0, 0.0)
    """Added to the tangent of each face. Chosen: vehicles are rounder at the ends."""
    near_range: float = 20.0
    """Up to this range points reach the outermost parts of a surface [m]. Chosen."""
    range_span: float = 50.0
    """The range inset is that of an object this much further away [m]. Chosen: at 70 m."""
    occluded_weight: float = 0.25
    """Weight of a face that is turned away from the sensor. Chosen."""
    face_outlier: float = 0.15
    """Distance of a face from its points at which it has weight 1/4 [m]. Chosen."""
    outermost: float = 0.05
    """Part of the points of a box that makes a face observation. Chosen."""
    face_deviations: tuple[float, ...] = (0.12, 0.12, 0.08, 0.08, 0.08, 0.05)
    """Deviation of one observation of each face [m]: settings, but for the road. Chosen."""

    # Motion (M7), (M23)
    vertical: float = 1.0
    """Deviation of the vertical acceleration [m/s^2]. Chosen: roads are smooth."""
    tilting: float = 0.2
    """Deviation of the roll and pitch acceleration [rad/s^2]. Chosen: as `vertical`."""
    climb: float = 0.25
    """Deviation of the velocity along the z axis of a box [m/s]. Chosen: as `vertical`."""
    sideslip: float = 0.01
    """Deviation of the angle from the heading of a track to its path [rad]. Measured: between that
    of the labels of Argoverse 2 and of PandaSet."""

    # Weights (M21) to (M25)
    outlier: float = 3.0
    """Deviation at which an input pose has weight 1/2, a motion residual 1/4, in standard
    deviations. Literature: the usual gate of three standard deviations."""
    gate: float = 3.0
    """Turn of a parked object, in errors of the input yaw, and bound of the gaps of tracks, in
    their deviations. Literature: as `outlier`."""
    gap_outlier: float = 2.0
    """Deviation at which the prior of a labelling margin has weight 1/2, in standard deviations.
    Chosen."""
    is_robust: bool = True
    """Whether motion residuals are robust: not from a start that is as noisy as the input."""
    pin_deviations: tuple[float, ...] = (0.02, 0.02, 0.02, 0.005, 0.005, 0.005, 0.01)
    """Deviations of a pinned pose x y z [m] and roll pitch yaw [rad], and of pinned extents [m].
    Chosen: how well a person corrects a box; extents are practically held."""
    parked_speed: float = 0.3
    """Largest mean speed of a parked object [m/s]. Chosen."""
    parked_distance: float = 0.7
    """Largest distance that a parked object moves [m]. Chosen."""
    driving_speed: float = 1.0
    """An object drives where the medians of boxes before and after a step move faster [m/s].
    Chosen."""
    driving_span: int = 5
    """Boxes in these medians; steps before such a one, and after it, that have no zero-motion
    prior either. Chosen."""
    drift: tuple[float, ...] = (0.02, 0.02, 0.01, 0.003, 0.003, 0.003)
    """Deviation of the steps of a parked box x y z [m] and roll pitch yaw [rad], by the drift of
    the fixed frame. Chosen."""

    # Rigid shape (M4)
    cells: tuple[int, ...] = (8, 3, 3)
    """Cells into which a box is cut along x, y and z, each with one piece of surface. Chosen."""
    min_cell_points: int = 8
    """Fewest points of a piece of surface. Chosen."""
    min_flatness: float = 3.0
    """Smallest ratio of the second variance of a piece of surface to that across it. Chosen."""
    effective_points: float = 20.0
    """Points of one observation with independent errors; more add no information. Chosen."""

    # Solver
    settled_step: float = 0.1
    """A window is settled when its boxes move less in a round [errors of the input]. Chosen."""
    shape_points: int = 64
    """Points of each box that make the rigid shape of its track. Chosen."""
    prior_decay: float = 0.97
    """Factor on the information of the marginalisation prior, per observation. Chosen: half of it
    is left after 23 observations, since errors that the model takes for constant drift."""
    max_lost_part: float = 0.5
    """A refined box may hold fewer points than its input box, by this part and 3. Chosen."""

    # Model of the input (M16) to (M18)
    typical_correlation: float = 0.385
    """Correlation of the errors of consecutive observations before any was estimated. Chosen:
    `(1 + c) / (1 - c)` is 1.5 squared."""
    correlation_interval: float = 0.1
    """Time over which errors that persist are correlated [s]. Chosen."""
    yaw_bias: float = 0.5
    """Bias of the input yaw over that of the other variables. Measured of PointRCNN on KITTI: 1.1
    over 2.1 degrees."""
    population_radius: float = 0.5
    """Distance in logarithms of extents at which objects have weight 1/2 for each other.
    Chosen."""
    slope_deviation: float = 240.0
    """Prior deviation of the slope of extent corrections, per squared error. Derived: 0.6 for
    input whose extents err by 5 %, 0.6 / 0.05^2."""
    pivot: float = 0.25
    """Distance of the pivot, such as a rear axle, behind the centre, and its deviation, as part of
    the length. Chosen: between the centre and the rear."""
    min_extent_gain: float = 0.2
    """Least part of the information about an extent that points provide as evidence. Chosen."""

    # Errors that change (M16)
    min_observations: int = 5
    """Fewest observations of a track that noise is estimated from. Chosen."""
    half_weight: float = 14.0
    """Observations, or tracks, that settings count for where errors or margins are estimated.
    Chosen."""
    max_correlation: float = 0.9
    """Largest correlation of consecutive errors. Chosen."""
    min_left: float = 0.3
    """Least part of a variance that the mean of a track is taken to leave. Chosen."""
    low_noise: float = 0.5
    """Input whose centres err by less than this part of the settings is low-noise input, such as
    human labels: fits follow it more closely. Chosen."""

    # Labelling margins
    road_spread: float = 0.03
    """Deviation between objects of the height of the bottom above the road [m], in place of
    `gap_spread`. Measured: 0.001 of exact truth, 0.03 and 0.04 of labels of people."""
    max_gap: float = 0.5
    """No margin is estimated from points further from where they are expected [m]. Chosen."""
    min_box_points: int = 30
    """No margin is estimated from near boxes with fewer points. Chosen."""
    min_share: float = 0.5
    """A face with a larger share of an inset counts as occluded or distant, with less than half of
    that as visible. Chosen."""
    max_tracks: int = 200
    """Tracks of each kind that the input model keeps, those seen last. Chosen."""
    max_fits: int = 100
    """Fits of each track that it keeps. Chosen."""

    # Covariance (M28)
    residual_correlation: float = 0.55
    """Correlation of the distances of a face from its points, from one observation to the next.
    Measured about the mean of each track on five recordings: 0.4 to 0.65."""
    time_deviation: float = 0.01
    """Deviation of the time of a label from that of its points [s]. Measured: moving objects of
    PandaSet err by 12 ms more than parked ones, along the heading."""
    heading_deviation: float = 0.01
    """Angle from the heading of a label to its surface [rad]. Measured, see `sideslip`."""

    # Switches of a round
    uses_shape: bool = True
    """Whether the observations of a window are tied by the rigid shape of their track."""
    residuals: tuple[bool, ...] = (True,) * len(RESIDUALS)
    """Which of `RESIDUALS` are used; `measure ablation` leaves some out."""

    @lru_cache(maxsize=8)  # noqa: B019
    def with_settings(self, config: Any) -> 'Constants':
        """Return these numbers with the settings of a `Config`."""
        faces, parts = config.faces, config.ingredients
        road = self.face_deviations[BOTTOM]
        return self._replace(
            face_deviations=(*[faces.ends] * 2, *[faces.sides] * 3, road),
            face_outlier=self.face_outlier if parts.robust_weights else inf,
            strips=self.strips if parts.strips else 1,
            occluded_weight=self.occluded_weight if parts.occluded_faces else 0.0,
            near_range=self.near_range if parts.range_inset else inf,
            outlier=self.outlier if parts.robust_weights else inf,
            gap_outlier=self.gap_outlier if parts.robust_weights else inf,
            is_robust=parts.robust_motion,
            residuals=tuple(name not in parts.without for name in RESIDUAL_NAMES),
        )

    @lru_cache(maxsize=8)  # noqa: B019
    def in_round(self, uses_shape: bool, is_smooth: bool) -> 'Constants':
        """Return these numbers for a round; the start of a smooth one is not the noisy input."""
        residuals = tuple(
            is_used and (uses_shape or name != 'rigid shape')
            for is_used, name in zip(self.residuals, RESIDUAL_NAMES, strict=True)
        )
        is_robust = self.is_robust and is_smooth
        return self._replace(uses_shape=uses_shape, residuals=residuals, is_robust=is_robust)

    @lru_cache(maxsize=8)  # noqa: B019
    def record(self) -> NDArray[np.void]:
        """
        Return these numbers in an array (1,) of records, which kernels only read.

        A record by itself takes numba 4 us at each call, one in an array 0.3.

        """
        return np.array([tuple(self)], RECORD)


def _field(name: str, value: Any) -> tuple[Any, ...]:
    if isinstance(value, tuple):  # numba has no arrays of bool in records
        return name, float if isinstance(value[0], float) else int, len(value)
    return name, type(value)


RECORD = np.dtype([_field(*item) for item in Constants._field_defaults.items()], align=True)
CONSTANTS = Constants()
