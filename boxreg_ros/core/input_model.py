"""
The input model: labelling margins (M18), noise and population of the input of a stream.

docs/method.md, section Input model, has the formulas.

"""

from collections.abc import Sequence
from typing import Any

from boxreg_ros.config import Config, FaceConfig, KINDS
from boxreg_ros.core.input_noise import noise_of, set_noise
from boxreg_ros.core.input_statistics import (
    drive_of,
    Drives,
    KindStatistics,
    NOISE,
    pooled_noise,
    TRACK,
)
from boxreg_ros.core.method import constants
from boxreg_ros.core.method.arrays import INPUTS
from boxreg_ros.core.method.faces import observe_faces
from boxreg_ros.core.method.residuals import TERMS
from boxreg_ros.core.population import set_population
from boxreg_ros.core.problem import Problem
from boxreg_ros.core.support import MIN_HITS
from boxreg_ros.core.threads import run
from boxreg_ros.core.track_rows import TrackRows
from boxreg_ros.structures import Floats, Ints
import numpy as np
from numpy.typing import NDArray

QUARTILES_TO_DEVIATION = 0.74
"""Standard deviation over interquartile range. Derived: 1 / 1.349 for a Gaussian."""
MIDMEAN_FACTOR = 1.1
"""Error of the mean of the middle half over that of the mean. Derived: sqrt(1.2), the efficiency
of the midmean of a Gaussian."""
Inputs = NDArray[np.void]
MARGIN_FIELDS = (
    'gap_correction', 'occlusion_inset', 'range_inset', 'gap_variance', 'gap_tracks', 'gap_noise',
)  # fmt: skip
"""Fields of `INPUTS` that follow from face observations."""
FACE_GROUPS = ([0, 1], [2, 3], [4], [5])
"""Faces with one labelling margin: ends, sides, top, bottom."""
GAP_DEVIATIONS = {
    'vehicle': (0.05, 0.05, 0.05, 0.15),
    'cyclist': (0.15, 0.15, 0.15, 0.15),
    'pedestrian': (0.15, 0.15, 0.15, 0.15),
}
"""Prior deviation of each margin from the one of the settings of its kind [m]. Chosen."""


class InputModel:
    """
    Labelling margins, noise and population of extents, estimated from the input of a stream.

    Each of `KINDS` has its own: labels of pedestrians have other margins than those of cars. Noise
    is pooled for kinds that were seen in few boxes.

    A labelling margin is the gap between a face of the label and its outermost points. Each track
    gives one value per face: the mean over its observations of the gap, less the one expected of
    its class. The mean of the middle half of all tracks is weighed against a correction of zero
    (M18). Errors of the boxes that exceed the margin do not matter if they have no preferred
    direction. Faces beyond 45 m give the range inset; it is estimated even where the margins are
    set, since a common error of all boxes cancels in the difference.

    Parameters
    ----------
    config : FaceConfig
        Expected insets, and whether margins are estimated.
    drives : Drives, optional
        Of the same detector and labelling rule: their tracks count as those of this stream.
    numbers : Constants, optional
        Of the method, if others than the usual ones.

    Attributes
    ----------
    constants : Constants
        The numbers of the method, for all that use the model.

    """

    def __init__(
        self,
        config: FaceConfig,
        drives: Drives | None = None,
        numbers: constants.Constants | None = None,
    ) -> None:
        self.constants = numbers or constants.CONSTANTS
        self._estimates_margins = config.learn
        self._occlusion_insets = (config.inset_ends, config.inset_sides, 0.0, 0.0)
        # Of each track of each kind: what it shows, and its last input residuals.
        unknown = np.full((self.constants.max_fits, 9), np.nan)
        self._tracks = [TrackRows(np.zeros((), TRACK), self.constants.max_tracks) for _ in KINDS]
        # What follows from the present sums, see `_margins_of`.
        self._margins: list[tuple[Floats, ...] | None] = [None] * len(KINDS)
        self._residuals = [TrackRows(unknown, self.constants.max_tracks) for _ in KINDS]
        self._noise = np.zeros(len(KINDS), NOISE)  # of whole tracks, whose residuals are not kept
        known = list((drives or {}).values())
        self._past = [
            np.concatenate([np.zeros(0, TRACK), *(drive[k].tracks for drive in known)])
            for k in range(len(KINDS))
        ]
        self._past_noise = np.array(
            [pooled_noise([drive[k].noise for drive in known]) for k in range(len(KINDS))], NOISE
        )

    def __getstate__(self) -> dict[str, Any]:
        """Return what was observed; margins that follow from it are computed again."""
        return {**vars(self), '_margins': [None] * len(KINDS)}

    def observe_margins(
        self, track_ids: Sequence[str], problem: Problem, poses: Floats, config: Config
    ) -> None:
        """
        Add the face observations of some windows at their input boxes.

        Parameters
        ----------
        track_ids : sequence of B str
            The tracks of the windows, all different.
        problem : Problem
            The windows; all their observations count.
        poses : array, shape (B, N, 6)
            Boxes at which faces are observed [m, rad].
        config : Config
            Settings.

        """
        inputs = self.inputs(config, with_noise=False)
        terms = np.zeros(problem.counts.shape, TERMS)
        run(
            observe_faces, len(poses), problem, np.ascontiguousarray(poses),
            problem.expected_shared(inputs), inputs,
            self.constants.with_settings(config).record(), terms,
        )  # fmt: skip
        self._add(track_ids, problem, terms, inputs)

    def _add(
        self, track_ids: Sequence[str], problem: Problem, terms: NDArray[np.void], inputs: Inputs
    ) -> None:
        """Add face observations, of records `TERMS` (B, N), that were made with `inputs`."""
        kinds = problem.kind
        numbers = self.constants
        distance, weight = terms['distance'], terms['visibility']
        occluded, distant = np.moveaxis(terms['inset_shares'], 2, 0)
        gap_correction, occlusion_inset, range_inset = (
            inputs[name][kinds][:, None] for name in MARGIN_FIELDS[:3]
        )
        occluded = occluded * (occlusion_inset > 0)  # the bottom is observed by the road
        is_visible = occluded < numbers.min_share / 2
        is_distant = distant > numbers.min_share
        has_points = (terms['num_points'] >= numbers.min_box_points)[..., None]
        # Three quantities: gap, occlusion inset, range inset; all (3, B, N, 6).
        counts = np.stack([
            has_points & is_visible & ~is_distant,
            has_points & (occluded > numbers.min_share),
            is_visible & is_distant,
        ])  # fmt: skip
        counts &= (weight > 0) & (np.abs(distance) < numbers.max_gap)
        counts &= problem.valid[..., None]
        values = np.stack([
            0 * occluded, occluded * occlusion_inset, distant * range_inset
        ]) - distance  # fmt: skip
        values[::2] += gap_correction  # an occlusion inset is counted from the present gap
        shares = np.stack([np.ones_like(distance), occluded, distant])
        # (B, 3 quantities, 3 sums: value, count, share; 6 faces)
        sums = np.moveaxis(np.stack([values * counts, counts, shares * counts], 1).sum(3), 2, 0)
        for k in set(kinds.tolist()):
            self._margins[k] = None
            rows, kept = _kept(self._tracks[k], track_ids, kinds == k)
            self._tracks[k].arrays['sums'][kept] += sums[rows]

    def add_fits(
        self, track_ids: Sequence[str], kinds: Ints, residuals: Floats, evidence: Floats
    ) -> None:
        """
        Add one fit of each track.

        Parameters
        ----------
        track_ids : sequence of B str
            The tracks.
        kinds : array, shape (B,)
            Indices of their kinds among `KINDS`.
        residuals : array, shape (B, 9)
            As `normalised_residuals`.
        evidence : array, shape (B, 3, 3)
            Of the extents, see `population_slopes`.

        """
        for k in set(kinds.tolist()):
            rows, kept = _kept(self._residuals[k], track_ids, kinds == k)
            known = self._residuals[k].arrays
            known[kept, :-1] = known[kept, 1:]
            known[kept, -1] = residuals[rows]
            rows, kept = _kept(self._tracks[k], track_ids, kinds == k)
            self._tracks[k].arrays['evidence'][kept] = evidence[rows]

    def inputs(self, config: Config, with_noise: bool = True) -> Inputs:
        """
        Return what is known of the errors of the input, records `INPUTS` (K,).

        As far as the method of `config` uses it; without noise, that of the settings.

        """
        inputs = np.zeros(len(KINDS), INPUTS)
        for k in range(len(KINDS)):
            margins = self._margins[k] or self._margins_of(k)
            self._margins[k] = margins
            for name, column in zip(MARGIN_FIELDS, margins, strict=True):
                inputs[name][k] = column
        if with_noise and config.ingredients.noise_estimation:
            self.set_noise(inputs, *_of_all_kinds(self._residuals))
        if config.ingredients.population_extents:
            set_population(inputs, *self.extent_evidence(), self.constants)
        return inputs

    def extent_evidence(self) -> tuple[Floats, Ints]:
        """Return the evidence of the extents of the last fit of each track, and their kinds."""
        parts = [self._known(k)['evidence'] for k in range(len(KINDS))]
        parts = [part[part[:, 0].any(1)] for part in parts]  # without tracks that have no fit yet
        return np.concatenate(parts), np.repeat(np.arange(len(KINDS)), list(map(len, parts)))

    def _known(self, kind: int) -> NDArray[np.void]:
        """Return what the tracks of a kind show, those of other drives first, records `TRACK`."""
        return np.concatenate([self._past[kind], self._tracks[kind].in_order])

    def set_noise(self, inputs: Inputs, residuals: Floats, kind: Ints) -> None:
        """Set the noise of tracks (B, N, 9) of a kind (B,), with that of other drives (M14)."""
        set_noise(inputs, residuals, kind, self._past_noise, self.constants)

    def add_noise(self, residuals: Floats, kind: Ints) -> None:
        """Add the noise of whole tracks, by their residuals (B, N, 9), to the statistics."""
        for k in set(kind.tolist()):
            found = noise_of(residuals[kind == k], self.constants)
            self._noise[k] = pooled_noise([self._noise[k], found])

    def statistics(self, name: str = '') -> Drives:
        """Return what this drive has shown, for others to begin with, by a `name`."""
        kinds = []
        for k in range(len(KINDS)):
            noise = self._noise[k]
            if not noise['boxes']:
                noise = noise_of(self._residuals[k].in_order, self.constants)
            kinds.append(KindStatistics(self._tracks[k].in_order, noise))
        return drive_of(kinds, name)

    def _margins_of(self, kind: int) -> tuple[Floats, ...]:
        """Return margin corrections, insets and scatter of gaps for one kind, (6,) each."""
        known = self._known(kind)['sums']
        none = (0.0,) * len(FACE_GROUPS)
        deviations = GAP_DEVIATIONS[KINDS[kind]]
        of_gaps = _means_of_groups(known[:, 0])
        gaps = self._pooled(of_gaps, none, deviations)
        known[:, 2, 0] -= gaps * known[:, 2, 1]
        range_insets = self._pooled(_means_of_groups(known[:, 2]), none, deviations)
        used = known if self._estimates_margins else known[:0]
        of_insets = _means_of_groups(used[:, 1])
        occlusion_insets = self._pooled(of_insets, self._occlusion_insets, deviations)
        scatter = self._scatter(of_gaps) * self._estimates_margins
        return self._estimates_margins * gaps, occlusion_insets, range_insets, *scatter

    def gaps_of_tracks(self, faces: Sequence[int]) -> list[Floats]:
        """Return gap corrections of some `faces` [m], one array per track that has any."""
        return self._means_of_tracks(0, faces)

    def occlusion_insets_of_tracks(self, faces: Sequence[int]) -> list[Floats]:
        """Return occlusion insets of some `faces` [m], one array per track that has any."""
        return self._means_of_tracks(1, faces)

    def _means_of_tracks(self, quantity: int, faces: Sequence[int]) -> list[Floats]:
        means = []
        for tracks in self._tracks:
            for total, count, share in tracks.in_order['sums'][:, quantity][..., faces]:
                is_known = count >= MIN_HITS
                if is_known.any():
                    means.append(total[is_known] / share[is_known])
        return means

    def _pooled(
        self, means: 'Means', expected: Sequence[float], deviations: Sequence[float]
    ) -> Floats:
        """Weigh the means of a quantity against its prior (M18), (6,)."""
        values = np.zeros(6)
        parts = zip(FACE_GROUPS, means, expected, deviations, strict=True)
        for faces, (of_tracks, _), prior, deviation in parts:
            values[faces] = self._posterior_mean(of_tracks, prior, deviation)
        return values

    def _posterior_mean(self, means: Floats, prior: float, deviation: float) -> float:
        """Weigh the midmean of sorted `means` against a prior with its deviation (M18)."""
        n = len(means)
        if n < MIN_HITS:
            return prior
        middle, spread = _midmean(means)
        error = MIDMEAN_FACTOR * (spread + self.constants.min_gap_deviation)
        weight = deviation**2 / (deviation**2 + error**2 / n)
        return float(prior + weight * (middle - prior))

    def _scatter(self, means: 'Means') -> Floats:
        """Return variance, number and noise of the gaps of one kind, see `Inputs`, (3, 6)."""
        columns = np.zeros((3, 6))
        for faces, (of_tracks, counts) in zip(FACE_GROUPS, means, strict=True):
            if len(of_tracks):
                columns[0, faces] = _clipped_variance(of_tracks, self.constants.gate)
                columns[1, faces] = len(of_tracks)
                columns[2, faces] = (1 / counts).mean()
        return columns


Means = list[tuple[Floats, Floats]]
"""Of each of `FACE_GROUPS`: the means of all tracks, sorted, and their numbers of observations."""


def _means_of_groups(known: Floats) -> Means:
    """Return the means of a quantity by the tracks' sums (n, 3, 6)."""
    found = []
    for faces in FACE_GROUPS:
        total, count, share = known[..., faces].swapaxes(0, 1).reshape(3, -1)
        is_known = count >= MIN_HITS
        means = total[is_known] / share[is_known]
        order = np.argsort(means)
        found.append((means[order], count[is_known][order]))
    return found


def _of_all_kinds(known: Sequence[TrackRows]) -> tuple[Floats, Ints]:
    """Return the arrays of the tracks of all kinds, (n, ...), and their kinds (n,)."""
    parts = [tracks.in_order for tracks in known]
    return np.concatenate(parts), np.repeat(np.arange(len(known)), list(map(len, parts)))


def _kept(
    known: TrackRows, track_ids: Sequence[str], is_of_kind: NDArray[np.bool_]
) -> tuple[Ints, Ints]:
    """Return which tracks `is_of_kind` (B,) are kept, and their rows in the arrays of `known`."""
    of_kind = np.flatnonzero(is_of_kind)
    places, rows = known.seen([track_ids[i] for i in of_kind.tolist()])
    return of_kind[places], rows


def _midmean(means: Floats) -> tuple[float, float]:
    """Return the mean of the middle half of sorted `means`, and their robust deviation."""
    n = len(means)
    spread = means[n - 1 - n // 4] - means[n // 4]
    return float(means[n // 4 : n - n // 4].mean()), QUARTILES_TO_DEVIATION * float(spread)


def _clipped_variance(means: Floats, gate: float) -> float:
    """Return the variance of sorted `means` about their midmean, within `gate` deviations."""
    middle, deviation = _midmean(means)
    off = (means - middle).clip(-gate * deviation, gate * deviation)
    return float((off**2).sum() / max(len(means) - 1, 1))
