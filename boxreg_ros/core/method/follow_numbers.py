"""Every number of following one object: value, unit, origin."""

from types import ModuleType
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
    line: float = 0.02
    """A neighbourhood with less spread in its second direction is a line [m]."""
    normal_growth: float = 1.1
    """The normal of a cell is found again after it got so many times its points."""

    # Points of a sweep
    around: float = 0.5
    """Points so far around a start are registered from it [m]."""
    crop: float = 0.7
    """Points so far beside a box belong to its sweep [m]."""
    margin: float = 0.4
    """Points up to this far outside of the box are used [m]."""
    tolerance: float = 0.1
    """Points less far outside are of the object [m]."""
    max_sweep_points: int = 400
    """A sweep with more points around a box is thinned. Swept: the poses are as good."""

    # Registration of a sweep
    deviation: float = 0.05
    """Of a point from the surface [m]."""
    outlier: float = 0.12
    """Distance at which the weight of a point is 1/4 [m]; nearer points fit the surface."""
    effective_points: float = 30.0
    """Evidence of one sweep: more points of one surface are not independent."""
    max_steps: int = 12
    """Most Gauss-Newton steps from one start."""
    settled: float = 1e-3
    """A step ends the search where it moves the pose less [m]. Derived: far below `deviation`."""
    settled_yaw: float = 5e-4
    """And turns it less [rad]. Derived: 1 mm at 2 m."""
    road_deviation: float = 0.07
    """Of the height of the road beside a box [m]. Swept: 0.05 and 0.1 are as good, 0.2 drifts."""

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
    """Deviation of the yaw [rad]."""
    max_jump: float = 16.0
    """Squared Mahalanobis distance from the prediction."""
    min_score_again: float = 0.5
    """Part of the running mean of its score, to find an object again after a loss."""
    min_sure_fit: float = 0.7
    """Part of the points that fit, to find an object again after a loss, and to add points to the
    surface."""

    # Search along the heading
    jump_cost: float = 0.02
    """Of a unit of squared Mahalanobis distance, in score, up to `max_jump` of these."""
    search_below: float = 0.85
    """An object with a smaller part of its usual score is searched along the heading."""
    max_search: float = 4.0
    """It is searched so far in each direction after a loss, at most [m]."""

    # Motion
    overhang: float = 3.0
    """The rear axle of a vehicle is no farther from its end [m]. Chosen: buses and trams."""
    steered_length: float = 4.5
    """The angular acceleration of a longer vehicle is smaller by the square of its length [m].
    Derived: the turn rate is the speed by the radius, which the wheelbase gives; of a car."""
    parked_noise: float = 0.1
    """Factor on the noise of the motion of a parked object."""
    hold: float = 2.0
    """An object that is not found for so long is lost [s]."""
    hold_parked: float = 5.0
    """The same for a parked object [s]."""
    young: float = 1.0
    """A way of this duration does not yet know its speed well [s]."""
    young_speed: float = 2.0
    """Deviation of the speed of a young way after a loss [m/s]."""
    near_seeds: float = 1.5
    """Seeds nearer in time give the speed [s]: acceleration changes it by less than 3 m/s."""
    search_sweeps: int = 5
    """Sweeps in each direction that a start speed is tested with."""
    speeds_tested: int = 4
    """Most likely speeds by the first sweeps that are tested with `search_sweeps`."""
    search_deviations: float = 2.5
    """Deviations of the predicted place that a lost object is searched in: 99 % of them."""
    seed_error: float = 1.0
    """Seeds farther apart than an object moves, by less than this, are of one object [m]."""
    max_speed_step: float = 3.0
    """Largest step between the start speeds that are compared [m/s]."""
    start_shift: float = 0.35
    """Start speeds are so close that their places in the next sweep differ by no more [m]: less
    than `margin`, from which the registration of a sweep finds the object."""
    forward_over_reverse: int = 3
    """Largest start speed forward over that in reverse."""
    start_iterations: int = 6
    """Iterations of the registration at each start speed."""
    test_iterations: int = 8
    """The same at the speeds that are tested: they are compared by their ends."""
    same_speed: float = 0.7
    """Start speeds that differ by less from the mean one are the same [m/s]."""
    speed_cost: float = 0.03
    """Score that another speed than the mean one has to gain."""
    reverse_cost: float = 0.1
    """The same of reversing, beside `speed_cost`."""
    difference_cost: float = 0.002
    """The same of each m/s of difference from the mean speed."""

    # Boxes between seeds, and extents
    max_gap_yaw: float = 0.15
    """A way has arrived at a seed if its heading differs by less [rad]."""
    curved_travel: float = 1.0
    """Boxes nearer to each other are joined by a line: their headings are no tangents [m]."""

    # Extents of a box that was drawn too small or too large
    max_extent_sweeps: int = 60
    """Sweeps of a track whose points show the extents."""
    max_growth: float = 1.0
    """A face moves outwards by no more than this [m]: half the difference of a hatchback and a
    van."""
    max_change: float = 0.5
    """And no face by more than this part of half the extent: farther points are of what stands
    beside."""
    person_error: float = 0.3
    """Faces nearer to the edge of the points stay [m]: the error of a person, the labelling
    margin, and the error of the edge, one bin. Of boxes with the size of a class the last alone:
    they are known by another object of the same size, or by one face that is farther off."""
    face_margin: float = 0.05
    """Labelling margin of a face that moves [m]; as the settings of the classes."""
    min_sweeps: int = 5
    """Fewer are no evidence for a face."""
    bin_length: float = 0.1
    """Points are counted by their distance from the centre in bins of this length [m]."""
    edge_bins: int = 3
    """Bins on each side of an edge that are compared: 0.3 m."""
    dense: int = 30
    """Points in a bin on the inner side of an edge, of all sweeps: fewer end before the object
    does, since the sensor hardly sees so far along it. Swept: 15 lose PandaSet .01."""
    dense_outside: int = 20
    """The same for an edge outside of the box, where points are evidence by themselves. Swept: 50
    lose re-simulated drives .01."""
    empty: float = 0.1
    """Points on the outer side of an edge, as part of those on its inner side."""
    stray: float = 0.02
    """Points of the box beyond an edge, as part of all: with more it is a gap. The face has the
    same part of the points beside the edge outside of it."""
    min_distance: float = 2.0
    """Nearer points do not show how far up the sensor sees [m]: they may be of its vehicle."""

    # Keyframes, and streams
    sample: int = 200
    """Keyframes that show a larger deviation, before all are solved: 5 % of error."""
    min_keyframes: int = 20
    """Fewer show no deviation: a fifth of the deviation is its own error."""
    min_seeds: int = 3
    """Tracks with fewer seeds follow them, and show no deviation of theirs."""
    evidence: float = 2.0
    """Deviations that differ by less than this factor count as the usual ones: estimates from
    keyframes of the usual error, on five recordings, are 0.5 to 1.6 of it."""
    history: float = 2.0
    """A box may be so much older than the newest sweep [s]: who sends it is slow."""


FOLLOW = FollowNumbers()

IN_KERNELS = ModuleType('follow')
"""The same for kernels. Attributes of a module are constants; of a tuple, numba makes all fields,
and counts their references, wherever one of them is used."""
vars(IN_KERNELS).update(FOLLOW._asdict())
