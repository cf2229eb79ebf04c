"""
A batch of windows as padded arrays: what the method solves at once.

The estimated variables of a window of N observations are x = (p_1, ..., p_N, s): poses p_i of six
numbers each and the shared variables s of `method.arrays`, the same for all observations.

"""

from collections.abc import Sequence
from functools import lru_cache
from itertools import chain, groupby
from typing import Any, NamedTuple

from boxreg_ros.config import Config, KINDS
from boxreg_ros.core.method.arrays import BIAS, EXTENT, GAP, PIVOT, POSE, PRIOR, SHARED
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.method.headings import align, correct_flips
from boxreg_ros.core.observation import Observations
from boxreg_ros.core.tables import rows_of
from boxreg_ros.core.window import MarginalisationPrior, Window
from boxreg_ros.structures import Floats, Ints, YAW
import numpy as np
from numpy.typing import NDArray

PADDING_PERIOD = 0.1
"""Time step of padding observations [s]. Derived: any positive number keeps times increasing."""
MAX_BATCH_VALUES = 3e7
"""Most point coordinates, or entries of the Hessian, in a batch; derived: 240 MB as float64."""
VALUES_PER_POINT = 18
"""Values held per point while a batch is solved; estimated from the temporary arrays."""
NO_RANGE = np.array([[np.inf] * 3, [-np.inf] * 3])
"""Range of the extents of a track before its first window is full."""

SETTINGS_OF = {
    'motion': ('acceleration', 'cornering', 'turning'),
    'slip': ('slip',),
    'pose': ('position', 'lateral', 'height', 'tilt', 'tilt', 'heading'),
    'extent': ('extent',),
    'gap_spread': ('gap_spread',),
    'roughness': ('shape',),
    'gaps': ('gap_ends', 'gap_ends', 'gap_sides', 'gap_sides', 'gap_top', 'gap_bottom'),
}
"""
Fields of `CLASS_SETTINGS`, and the settings of `ClassConfig` that make each.

motion
    Deviations of the accelerations forward, sideways and of yaw, (3,) [m/s^2, rad/s^2].
slip
    Of the sideways velocity of the pivot [m/s].
pose, extent
    Of the input poses, (6,) [m, rad], and of the input extents, as part of each.
gap_spread
    Of labelling margins [m].
roughness
    How far the surface is from rigid [m].
gaps
    Expected labelling margins, (6,) [m].
"""
CLASS_SETTINGS = np.dtype(
    [
        (field, float, len(names)) if len(names) > 1 else (field, float)
        for field, names in SETTINGS_OF.items()
    ],
    align=True,
)
"""Settings of the class of one window, a record."""


OF_OBSERVATIONS = (
    *('boxes', 'start', 'times', 'origins', 'ground', 'ring_heights', 'first', 'counts', 'pinned'),
)
"""Fields of `Problem` with a row for each observation of each window."""


class Problem(NamedTuple):
    """A batch of padded windows; centres are relative to one point per window."""

    boxes: Floats
    """(B, N, 9), input boxes, yaw unwrapped along the window and 180° flips corrected [m, rad]."""
    start: Floats
    """(B, N, 9), start of the search: the input, or the estimate of the window before."""
    lengths: Ints
    """(B,), observations of each window; the others are padding."""
    times: Floats
    """(B, N), since the first observation, increasing over the padding too [s]."""
    origins: Floats
    """(B, N, K, 3), each sensor that sees the object minus the centre of the input box [m]; NaN
    if unknown."""
    ground: Floats
    """(B, N), height of the road minus that of the input centre [m]; NaN if unknown."""
    ring_heights: Floats
    """(B, N), height between two rings of the LiDAR at the object [m]; 0 if unknown."""
    points: NDArray[np.float32]
    """(P, 3), returns of all observations minus the centre of their input box [m]."""
    delays: NDArray[np.float32]
    """(P,), their measurement times relative to the stamp of the box [s]."""
    first: Ints
    """(B, N), first of the returns of each observation."""
    counts: Ints
    """(B, N), number of these."""
    stride: int
    """Every n-th return of an observation is used."""
    is_moving: bool
    """Whether any delay is not zero."""
    pinned: NDArray[np.bool_]
    """(B, N), whether a person has corrected a box."""
    prior_mean: Floats
    """(B, 29), minimum of the marginalisation prior (M9), on the two oldest poses and the
    shared variables."""
    prior_information: Floats
    """(B, 29, 29), of that prior; 0 without one."""
    marginalised_extents: Floats
    """(B, 4), sum of the input extents of marginalised observations [m], and the number of
    these."""
    kind: Ints
    """(B,), kind of each window's object, an index of `KINDS`."""
    of_class: NDArray[np.void]
    """(B,), records `CLASS_SETTINGS`."""

    @property
    def errors(self) -> Floats:
        """Deviations of input poses and, as part of each, of extents, (B, 9)."""
        extent = np.repeat(self.of_class['extent'][:, None], 3, axis=1)
        return np.concatenate([self.of_class['pose'], extent], axis=1)

    @property
    def length(self) -> int:
        """Observations per window, padding included: N."""
        return int(self.boxes.shape[1])

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Rows that are observations and not padding, (B, N)."""
        valid: NDArray[np.bool_] = np.arange(self.length) < self.lengths[:, None]
        return valid

    @property
    def width(self) -> int:
        """Most returns of an observation, at least 1: M."""
        return max(1, int(self.counts.max()))

    def part(self, rows: Ints, first: Ints, step: Ints, lengths: Ints) -> 'Problem':
        """
        Return the windows `rows` (b,) with some of their observations, padded to the most of one.

        Of each these are so many (b,), at least one, from the `first` on, every `step`-th.
        Marginalised observations are left out: there are no priors, and no extents of theirs.

        """
        row, last = rows[:, None], lengths[:, None] - 1
        place = np.arange(lengths.max())
        column = first[:, None] + step[:, None] * np.minimum(place, last)
        of_each = {name: getattr(self, name)[row, column] for name in OF_OBSERVATIONS}
        of_each['times'] += PADDING_PERIOD * np.maximum(place - last, 0)
        return self._replace(
            **of_each,
            lengths=lengths,
            prior_mean=self.prior_mean[:0],
            prior_information=self.prior_information[:0],
            marginalised_extents=np.zeros((len(rows), 4)),
            kind=self.kind[rows],
            of_class=self.of_class[rows],
        )

    def thinned(self, points: float) -> 'Problem':
        """Return the problem with every n-th point: at least `points` per box, if there are."""
        stride = max(1, int(self.width // points))
        counts = -(-self.counts // stride)
        return self._replace(counts=counts, stride=stride * self.stride)

    def mean_extents(self) -> Floats:
        """
        Return the mean extents of the input, marginalised observations included, (B, 3) [m].

        Of windows with pinned boxes the mean extents of these.

        """
        has_pin = self.pinned.any(1, keepdims=True)
        counts = np.where(has_pin, self.pinned, self.valid)
        before = self.marginalised_extents * ~has_pin
        sums = (self.boxes[..., 3:6] * counts[..., None]).sum(1) + before[:, :3]
        means: Floats = sums / (counts.sum(1) + before[:, 3])[:, None]
        return means

    def expected_shared(self, inputs: NDArray[np.void], number: int = SHARED) -> Floats:
        """
        Return the means of a `number` S of shared variables without a population, (B, S).

        `inputs` (K,) are records `INPUTS`.

        """
        shared = np.zeros((len(self.boxes), number))
        shared[:, EXTENT:BIAS] = self.mean_extents()
        shared[:, GAP:PIVOT] = self.of_class['gaps'] + inputs['margin'][self.kind]
        shared[:, PIVOT] = shared[:, EXTENT] * CONSTANTS.pivot
        return shared

    def free_variables(self, config: Config, number: int = SHARED) -> Floats:
        """
        Return which variables are estimated.

        Parameters
        ----------
        config : Config
            With `mode` 'bev' z, roll, pitch and height are held, with `extent` 'fixed' all
            extents, without the ingredient `input_bias` the bias of the input.
        number : int
            S, number of the shared variables.

        Returns
        -------
        free : array, shape (B, 6 N + S)
            1 for variables that are estimated, 0 for those held fixed, and for the poses of
            padding.

        """
        B, N = self.counts.shape
        free = np.ones((B, POSE * N + number))
        pose, shared = free[:, :-number].reshape(B, N, POSE), free[:, -number:]
        pose[:] = self.valid[..., None]
        if config.mode == 'bev':
            pose[..., [2, 3, 4]] = 0.0
            shared[:, 2] = 0.0
        if config.extent == 'fixed':
            shared[:, EXTENT:BIAS] = 0.0
        if not config.ingredients.input_bias:
            shared[:, BIAS:GAP] = 0.0
        return free


def group_windows(windows: Sequence[Window], config: Config) -> list[list[int]]:
    """
    Return groups of windows to solve together.

    Parameters
    ----------
    windows : sequence of Window
        Of any length.
    config : Config
        `min_observations` and ``sampling.points`` are used.

    Returns
    -------
    groups : list of list of int
        Rows of `windows`. A group is either all warm or all cold, of similar lengths, and within
        `MAX_BATCH_VALUES`. Windows shorter than `min_observations` are in none.

    """
    kinds = [(window.is_warm, len(window.observations)) for window in windows]
    rows = [row for row, (_, length) in enumerate(kinds) if length >= config.min_observations]
    rows.sort(key=kinds.__getitem__)
    groups: list[list[int]] = []
    for (is_warm, length), alike in groupby(rows, kinds.__getitem__):
        hessian = (6 * length + SHARED) ** 2
        points = length * config.sampling.points * VALUES_PER_POINT
        most = MAX_BATCH_VALUES // max(hessian, points)
        for row in alike:
            if not groups or len(groups[-1]) >= most or kinds[groups[-1][0]][0] != is_warm:
                groups.append([])
            groups[-1].append(row)
    return groups


def stack_windows(
    windows: Sequence[Window], config: Config, decay: float
) -> tuple[Problem, MarginalisationPrior]:
    """
    Stack windows to padded arrays.

    Parameters
    ----------
    windows : sequence of B Window
        Each with at least one observation, in the fixed frame.
    config : Config
        `ingredients`, `sampling` and the groups of object classes are used.
    decay : float
        Factor on the information of marginalisation priors.

    Returns
    -------
    problem : Problem
        Positions are relative to the `base` of each window [m].
    priors : MarginalisationPrior
        As they are used, with `base` (B, 3) in the fixed frame [m].

    """
    lengths = np.array([len(window.observations) for window in windows])
    seen, rows = Observations.gathered([*chain(*(w.observations for w in windows))])
    column, last = np.arange(lengths.max()), lengths[:, None] - 1
    valid = column <= last  # (B, N)
    first = (np.cumsum(lengths) - lengths)[:, None]
    rows = rows[first + np.minimum(column, last)]  # padding repeats the last of a window
    boxes, pinned = seen.boxes.take(rows, 0), seen.is_pinned.take(rows) & valid
    stamps_ns = seen.stamps_ns.take(rows)
    elapsed = (stamps_ns - stamps_ns[:, :1]) * 1e-9
    times = elapsed + PADDING_PERIOD * np.maximum(column - last, 0)
    priors = _priors(windows, boxes[:, 0, :3])
    base, state, step, information, extents, _ = priors
    if config.ingredients.heading_sign:
        correct_flips(boxes, times, lengths, pinned, np.ascontiguousarray(state[:, 5]))
    else:
        boxes[..., YAW] = np.unwrap(boxes[..., YAW])
    start = _starting_boxes(windows, boxes)
    minimum = state + step
    align(boxes, start, state, minimum, information)
    boxes[..., :3] -= base[:, None]
    start[..., :3] -= base[:, None]
    information *= decay if config.ingredients.marginalisation else 0.0
    kind, of_class = _of_classes(windows, config)
    delays = _delays(seen, config)
    problem = Problem(
        boxes=boxes,
        start=start,
        lengths=lengths,
        times=times,
        origins=seen.origins.take(rows, 0),
        ground=seen.ground.take(rows),
        ring_heights=seen.ring_heights.take(rows) * config.ingredients.ring_inset,
        points=seen.points,
        delays=delays,
        first=seen.first.take(rows),
        counts=seen.counts.take(rows) * valid,
        stride=1,
        is_moving=bool(delays.any()),
        pinned=pinned,
        prior_mean=minimum,
        prior_information=information,
        marginalised_extents=extents,
        kind=kind,
        of_class=of_class,
    )
    return problem, priors


def _priors(windows: Sequence[Window], first: Floats) -> MarginalisationPrior:
    """Return copies of the priors; those of others have no information, and the base `first`."""
    given: list[Any] = [window.prior for window in windows]
    if None in given:
        B = len(given)
        unknown = MarginalisationPrior(
            first,
            np.full((B, PRIOR), np.nan),
            np.zeros((B, PRIOR)),
            np.zeros((B, PRIOR, PRIOR)),
            np.zeros((B, 4)),
            np.repeat(NO_RANGE[None], B, axis=0),
        )
        given = [prior or (unknown, row) for row, prior in enumerate(given)]
    priors: MarginalisationPrior = rows_of(given)
    return priors


def _delays(seen: Observations, config: Config) -> NDArray[np.float32]:
    """Return the delays of all returns relative to the time of their box [s]."""
    if config.sampling.box_time == 'sight' and seen.sights.any():
        return seen.delays - np.repeat(seen.sights.astype(np.float32), seen.counts)
    return seen.delays


def _starting_boxes(windows: Sequence[Window], boxes: Floats) -> Floats:
    """Return where the search starts (B, N, 9): earlier estimates, else the input `boxes`."""
    start = boxes.copy()
    lengths = np.array([len(window.start) for window in windows])
    is_known = np.arange(boxes.shape[1]) < lengths[:, None]
    start[is_known] = np.concatenate([window.start for window in windows])
    return start


@lru_cache(maxsize=4)
def settings_of_kinds(config: Config) -> NDArray[np.void]:
    """Return the settings of each of `KINDS`, records `CLASS_SETTINGS` (K,)."""
    kinds = [getattr(config, name) for name in KINDS]
    found = np.zeros(len(KINDS), CLASS_SETTINGS)
    for field, names in SETTINGS_OF.items():
        numbers = np.array([[getattr(kind, name) for name in names] for kind in kinds])
        found[field] = numbers.reshape(found[field].shape)
    return found


def _of_classes(windows: Sequence[Window], config: Config) -> tuple[Ints, NDArray[np.void]]:
    """Return kind (B,) and settings of the class of each window."""
    names = [window.class_name for window in windows]
    kind_of = {name: KINDS.index(config.kind(name)) for name in set(names)}
    kind = np.array([kind_of[name] for name in names])
    return kind, settings_of_kinds(config).take(kind)
