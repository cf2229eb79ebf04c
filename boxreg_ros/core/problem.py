"""
A batch of windows as padded arrays: what the method solves at once.

The estimated variables of a window of N observations are x = (p_1, ..., p_N, s): poses p_i of six
numbers each and the shared variables s of `method.arrays`, the same for all observations.

"""

from collections.abc import Sequence
from functools import lru_cache
from itertools import chain
from typing import NamedTuple

from boxreg_ros.config import Config, KINDS
from boxreg_ros.core.method.arrays import BIAS, EXTENT, GAP, PIVOT, POSE, PRIOR, SHARED
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.method.headings import resolve_headings
from boxreg_ros.core.observation import Observations
from boxreg_ros.core.window import MarginalisationPrior, Window
from boxreg_ros.structures import Floats, Ints, ROLL, YAW
import numpy as np
from numpy.typing import NDArray

PADDING_PERIOD = 0.1
"""Time step of padding observations [s]. Derived: any positive number keeps times increasing."""
MAX_BATCH_VALUES = 3e7
"""Most point coordinates, or entries of the Hessian, in a batch; derived: 240 MB as float64."""
VALUES_PER_POINT = 18
"""Values held per point while a batch is solved; estimated from the temporary arrays."""
PRIOR_ANGLES = [3, 4, 5, 9, 10, 11]
"""Angles among the variables of the marginalisation prior: of its two poses."""
NO_RANGE = np.array([[np.inf] * 3, [-np.inf] * 3])
"""Range of the extents of a track before its first window is full."""
NO_PRIOR = (
    np.full(PRIOR, np.nan),
    np.zeros(PRIOR),
    np.zeros((PRIOR, PRIOR)),
    np.zeros(4),
    NO_RANGE,
)
"""State, step, information, extents and their range, of a prior without information."""


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
    """(B, 35), minimum of the marginalisation prior (M9), on the two oldest poses and the
    shared variables."""
    prior_information: Floats
    """(B, 35, 35), of that prior; 0 without one."""
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

    def part(self, windows: Sequence[int], columns: Sequence[Sequence[int]]) -> 'Problem':
        """
        Return some windows with some of their observations only, padded to the most that one has.

        `columns` are those of the observations of each of `windows`, ascending, at least one.
        Marginalised observations are left out, with their prior and their extents.

        """
        lengths = np.array(list(map(len, columns)))
        column = np.repeat([[of_window[-1]] for of_window in columns], lengths.max(), axis=1)
        valid = np.indices(column.shape)[1] < lengths[:, None]
        column[valid] = list(chain.from_iterable(columns))
        rows = np.array(windows)
        row = rows[:, None]
        b = len(rows)
        return self._replace(
            boxes=self.boxes[row, column],
            start=self.start[row, column],
            lengths=lengths,
            times=self.times[row, column] + PADDING_PERIOD * (~valid).cumsum(1),
            origins=self.origins[row, column],
            ground=self.ground[row, column],
            ring_heights=self.ring_heights[row, column],
            first=self.first[row, column],
            counts=self.counts[row, column],
            pinned=self.pinned[row, column],
            prior_mean=np.zeros((b, PRIOR)),
            prior_information=np.zeros((b, PRIOR, PRIOR)),
            marginalised_extents=np.zeros((b, 4)),
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
        counted = np.where(has_pin, self.pinned, self.valid)[..., None]
        marginalised = np.where(has_pin, 0.0, self.marginalised_extents)
        total = (self.boxes[..., 3:6] * counted).sum(1) + marginalised[:, :3]
        mean: Floats = total / (counted.sum(1) + marginalised[:, 3:])
        return mean

    def expected_shared(self, inputs: NDArray[np.void]) -> Floats:
        """
        Return the means of the shared variables without a population, (B, 23).

        `inputs` (K,) are records `INPUTS`.

        """
        shared = np.zeros((len(self.boxes), SHARED))
        shared[:, EXTENT:BIAS] = self.mean_extents()
        shared[:, GAP:PIVOT] = self.of_class['gaps'] + inputs['margin'][self.kind]
        shared[:, PIVOT] = shared[:, EXTENT] * CONSTANTS.pivot
        return shared

    def free_variables(self, config: Config) -> Floats:
        """Return 1 for every variable (B, 6 N + 23) that is estimated, 0 for those held fixed."""
        B, N = self.counts.shape
        pose = np.repeat(self.valid[..., None].astype(np.float64), POSE, axis=2)
        shared = np.ones((B, SHARED))
        if config.mode == 'bev':
            pose[..., [2, 3, 4]] = 0.0
            shared[:, 2] = 0.0
        if config.extent == 'fixed':
            shared[:, EXTENT:BIAS] = 0.0
        if not config.ingredients.input_bias:
            shared[:, BIAS:GAP] = 0.0
        return np.concatenate([pose.reshape(B, POSE * N), shared], axis=1)


def group_windows(windows: Sequence[Window], config: Config) -> list[list[int]]:
    """
    Return groups of rows of `windows` to solve together.

    A group is either all warm or all cold, of similar lengths, and within `MAX_BATCH_VALUES`.
    Windows shorter than `min_observations` are in no group.

    """
    lengths = [len(window.observations) for window in windows]
    rows = [row for row, length in enumerate(lengths) if length >= config.min_observations]
    is_warm = [window.is_warm for window in windows]
    rows.sort(key=lambda row: (is_warm[row], lengths[row], row))
    groups: list[list[int]] = []
    for row in rows:
        length = lengths[row]
        hessian = (6 * length + SHARED) ** 2
        points = length * config.sampling.points * VALUES_PER_POINT
        is_full = not groups or (len(groups[-1]) + 1) * max(hessian, points) > MAX_BATCH_VALUES
        if is_full or is_warm[groups[-1][0]] != is_warm[row]:
            groups.append([])
        groups[-1].append(row)
    return groups


def stack_windows(
    windows: Sequence[Window], config: Config, decay: float
) -> tuple[Problem, Floats]:
    """
    Stack windows, each with at least one observation, to padded arrays.

    The information of marginalisation priors is multiplied by `decay`. Positions of the problem
    are relative to the second value, (B, 3): one origin per window in the fixed frame [m].

    """
    lengths = np.array([len(window.observations) for window in windows])
    seen, rows = Observations.gathered([item for w in windows for item in w.observations])
    column, last = np.arange(lengths.max()), lengths[:, None] - 1
    valid = column <= last  # (B, N)
    first = (np.cumsum(lengths) - lengths)[:, None]
    rows = rows[first + np.minimum(column, last)]  # padding repeats the last of a window
    boxes, pinned = seen.boxes[rows], seen.is_pinned[rows] & valid
    elapsed = (seen.stamps_ns[rows] - seen.stamps_ns[rows[:, :1]]) * 1e-9
    times = elapsed + PADDING_PERIOD * np.maximum(column - last, 0)
    priors = [w.prior or _no_prior(w.observations[0].box[:3]) for w in windows]
    base, state, step, information, extents, _ = (
        np.array(part) for part in zip(*priors, strict=True)
    )
    if config.ingredients.heading_sign:
        boxes[..., ROLL:] = _resolved_angles(boxes, times, lengths, pinned, state[:, 5].copy())
    else:
        boxes[..., YAW] = np.unwrap(boxes[..., YAW])
    start = _starting_boxes(windows, boxes)
    boxes[..., :3] -= base[:, None]
    start[..., :3] -= base[:, None]
    minimum, is_usable = _prior_minimum(start, state, step)
    information *= decay * is_usable[:, None, None]
    if not config.ingredients.marginalisation:
        information[:] = 0.0
    kind, of_class = _of_classes(windows, config)
    delays = _delays(seen, config)
    problem = Problem(
        boxes=boxes,
        start=start,
        lengths=lengths,
        times=times,
        origins=seen.origins[rows],
        ground=seen.ground[rows],
        ring_heights=seen.ring_heights[rows] * config.ingredients.ring_inset,
        points=seen.points,
        delays=delays,
        first=seen.first[rows],
        counts=seen.counts[rows] * valid,
        stride=1,
        is_moving=bool(delays.any()),
        pinned=pinned,
        prior_mean=np.nan_to_num(minimum),
        prior_information=information,
        marginalised_extents=extents,
        kind=kind,
        of_class=of_class,
    )
    return problem, base


def _no_prior(base: Floats) -> MarginalisationPrior:
    """Return a prior without information, NaN as its linearisation point."""
    return MarginalisationPrior(base, *NO_PRIOR)


def _delays(seen: Observations, config: Config) -> NDArray[np.float32]:
    """Return the delays of all returns relative to the time of their box [s]."""
    if config.sampling.box_time == 'sight' and seen.sights.any():
        return seen.delays - np.repeat(seen.sights.astype(np.float32), seen.counts)
    return seen.delays


def _resolved_angles(
    boxes: Floats,
    times: Floats,
    lengths: Ints,
    pinned: NDArray[np.bool_],
    known_yaw: Floats,
) -> Floats:
    """
    Return roll, pitch and yaw (B, N, 3) of `boxes` (B, N, 9) with 180° flips corrected.

    A pinned box decides on the heading of its window.

    """
    yaw = np.empty(times.shape)
    resolve_headings(boxes, times, lengths, known_yaw, yaw)
    is_contrary = np.any(pinned & (np.cos(yaw - boxes[..., YAW]) < 0), axis=1, keepdims=True)
    yaw = np.where(is_contrary, yaw + np.pi, yaw)
    # A half turn about the z axis of the box changes the signs of roll and pitch.
    is_same = np.sign(np.cos(yaw - boxes[..., YAW]))
    tilt = boxes[..., ROLL:YAW] * is_same[..., None]
    return np.concatenate([(tilt + np.pi) % (2 * np.pi) - np.pi, yaw[..., None]], axis=-1)


def _starting_boxes(windows: Sequence[Window], boxes: Floats) -> Floats:
    """Return where the search starts (B, N, 9): earlier estimates, else the input `boxes`."""
    start = boxes.copy()
    lengths = np.array([len(window.start) for window in windows])
    is_known = np.arange(boxes.shape[1]) < lengths[:, None]
    start[is_known] = np.concatenate([window.start for window in windows])
    # Whole turns, and half turns of yaw: a kept box is returned with the heading of its input.
    period = np.pi * np.array([2, 2, 1])
    start[..., ROLL:] += period * np.round((boxes[..., ROLL:] - start[..., ROLL:]) / period)
    return start


def _prior_minimum(start: Floats, state: Floats, step: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """
    Return the minimum of each prior (B, 35), and which priors fit the present headings (B,).

    Angles are moved by half turns to those of `start` (B, N, 9). A prior that an odd number of
    them is needed for holds for the other heading sign.

    """
    B, N = start.shape[:2]
    angles = start[:, [0, 1 % N], ROLL:].reshape(B, len(PRIOR_ANGLES))
    half_turns = np.rint((angles - state[:, PRIOR_ANGLES]) / np.pi)
    minimum = state + step
    minimum[:, PRIOR_ANGLES] += np.pi * half_turns
    return minimum, np.asarray((half_turns % 2 == 0).all(1))


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
    kinds = {name: config.kind(name) for name in {window.class_name for window in windows}}
    kind = np.array([KINDS.index(kinds[window.class_name]) for window in windows])
    return kind, settings_of_kinds(config)[kind]
