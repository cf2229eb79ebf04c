"""Every number of following one object: value, unit, origin."""

from typing import NamedTuple


class FollowNumbers(NamedTuple):
    """
    The numbers of following one object.

    All are chosen but for those with another origin. Lengths are in metres, angles in radians,
    times in seconds.

    """

    # Surface of an object
    cell: float = 0.15
    """Side of a cell [m]."""
    max_cell_points: int = 60
    """A cell takes no more points than this."""
    rim: float = 0.6
    """The map of a surface reaches this far outside of the box [m]."""
    line: float = 0.02
    """A neighbourhood with less spread in its second direction is a line [m]."""
    growth: float = 1.1
    """The normal of a cell is found again after it got so many times its points."""
    max_cells: int = 20_000
    """Derived: those of a bus of 12 m."""

    # Points of a sweep
    around: float = 0.5
    """Points so far around a start are registered from it [m]."""
    crop: float = 0.7
    """Points so far beside a box belong to its sweep [m]."""
    crop_above: float = 0.6
    """And so far above and below it [m]."""
    beside: float = 0.3
    """And so much further away are the boxes of others whose points are left out [m]."""
    margin: float = 0.4
    """Points up to this far outside of the box are used [m]."""
    tolerance: float = 0.1
    """Points less far outside are of the object [m]."""
    max_sweep_points: int = 400
    """A sweep with more points around a box is thinned. Swept: the poses are as good."""

    # Registration of a sweep
    reach: float = 0.3
    """Largest distance of a point to its part of the surface [m]."""
    deviation: float = 0.05
    """Of a point from the surface [m]."""
    outlier: float = 0.12
    """Distance at which the weight of a point is 1/4 [m]; nearer points fit the surface."""
    outside_deviation: float = 0.15
    """Of points outside of the box [m]."""
    effective_points: float = 30.0
    """Evidence of one sweep: more points of one surface are not independent."""
    road_deviation: float = 0.07
    """Of the height of the road beside a box [m]. Swept: 0.05 and 0.1 are as good, 0.2 drifts."""
    max_step: float = 0.3
    """Of one iteration [m]."""

    # A pose is accepted if all of these hold
    min_points: int = 5
    """Points that fit the surface."""
    min_fit: float = 0.5
    """Part of the points near the surface that fit it."""
    min_seen: float = 0.3
    """Part of the points in the box that are near the surface."""
    max_deviation: float = 0.35
    """Deviation along the heading [m]."""
    max_yaw_deviation: float = 0.12
    """[rad]."""
    max_jump: float = 16.0
    """Squared Mahalanobis distance from the prediction."""
    min_fit_again: float = 0.6
    """Part of the points that fit, to find an object again after a loss."""
    min_score_again: float = 0.5
    """And of their score before the loss, as a running mean."""
    min_fit_to_learn: float = 0.7
    """Points of a sweep with a smaller part that fits are not added to the surface."""

    # Search along the heading
    jump_cost: float = 0.02
    """Of a unit of squared Mahalanobis distance, in score, up to `max_jump_cost` of these: a pose
    at the limit of a jump has to fit a fifth better than one at the prediction."""
    max_jump_cost: float = 10.0
    search_below: float = 0.85
    """An object with a smaller part of its usual score is searched along the heading."""
    search_step: float = 0.4
    """Distance of the starts after a loss [m]."""
    max_search: int = 10
    """Starts in each direction after a loss, at most."""
    slip_step: float = 0.15
    """Distance of the starts while it is seen [m]: points further from the surface have hardly
    any weight."""
    slips: int = 2
    """Starts in each direction while it is seen: half the reach of a registration."""


FOLLOW = FollowNumbers()
