"""
The input model: labelling margins, noise and population of the input of a stream.

docs/method.md, section Input model, has the formulas.

"""

from collections.abc import Sequence
from math import sqrt
from typing import Any, NamedTuple

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
from boxreg_ros.core.method.expectation import constant_part, SIZE
from boxreg_ros.core.method.faces import observe_faces
from boxreg_ros.core.method.residuals import TERMS
from boxreg_ros.core.population import population_slopes
from boxreg_ros.core.problem import Problem, settings_of_kinds
from boxreg_ros.core.support import MIN_HITS
from boxreg_ros.core.threads import run
from boxreg_ros.core.track_rows import TrackRows
from boxreg_ros.structures import Floats, Ints
import numpy as np
from numpy.typing import NDArray

Inputs = NDArray[np.void]
FACE_GROUPS = ([0, 1], [2, 3], [4], [5])
"""Faces with one labelling margin: ends, sides, top, bottom."""
MARGIN_FIELDS = ('margin', 'margin_variance', 'spread', 'occlusion_inset', 'range_inset')
"""Fields of `INPUTS` that follow from face observations."""
QUARTILES_TO_DEVIATION = 0.74
"""Standard deviation over interquartile range. Derived: 1 / 1.349 for a Gaussian."""
MIDMEAN_FACTOR = 1.2
"""Variance of the mean of the middle half over that of the mean. Derived: for a Gaussian."""
GAP_DEVIATIONS = {
    'vehicle': (0.05, 0.05, 0.05, 0.15),
    'cyclist': (0.15, 0.15, 0.15, 0.15),
    'pedestrian': (0.15, 0.15, 0.15, 0.15),
}
"""Prior deviation of each margin from the one of the settings of its kind [m]. Chosen."""


class Pooled(NamedTuple):
    """
    A quantity that differs from track to track: its normal-inverse-chi-squared distribution (M15).

    Attributes
    ----------
    mean, variance : float
        Of the mean over all tracks [m], and the variance of this estimate [m^2].
    between : float
        Variance between tracks [m^2].

    """

    mean: float
    variance: float
    between: float

    def given(self, values: Floats, prior_tracks: float) -> 'Pooled':
        """
        Return the posterior, by one value of each track, robustly.

        The variance of the prior counts as that of `prior_tracks`.

        """
        n = len(values)
        if n < MIN_HITS:
            return self
        values = np.sort(values)
        deviation = QUARTILES_TO_DEVIATION * (values[n - 1 - n // 4] - values[n // 4])
        between = (prior_tracks * self.between + n * deviation**2) / (prior_tracks + n)
        information = n / (MIDMEAN_FACTOR * between)
        variance = 1 / (1 / self.variance + information)
        middle = values[n // 4 : n - n // 4].mean()
        mean = variance * (self.mean / self.variance + information * middle)
        return Pooled(float(mean), float(variance), float(between))


class InputModel:
    """
    Labelling margins, noise and population of extents, estimated from the input of a stream.

    Each of `KINDS` has its own: labels of pedestrians have other margins than those of cars. Noise
    is pooled for kinds that were seen in few boxes.

    A labelling margin is the gap between a face of the label and its outermost points. Each track
    gives one value per face: the mean over its observations of the gap, less the one expected of
    its class (M15). Faces beyond 45 m give the range inset; it is estimated even where the margins
    are set, since a common error of all boxes cancels in the difference.

    Parameters
    ----------
    config : FaceConfig
        Expected insets, and whether margins are estimated.
    drives : Drives, optional
        Of the same detector and labelling rule: what they have shown is the prior of this model.
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
        margin, occlusion_inset, range_inset = (
            inputs[name][kinds][:, None] for name in ('margin', *MARGIN_FIELDS[3:])
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
        values[::2] += margin  # an occlusion inset is counted from the present gap
        shares = np.stack([np.ones_like(distance), occluded, distant])
        # (B, 3 quantities, 3 sums: value, count, share; 6 faces)
        sums = np.moveaxis(np.stack([values * counts, counts, shares * counts], 1).sum(3), 2, 0)
        logarithms = np.log(problem.mean_extents())
        for k in set(kinds.tolist()):
            rows, kept = _kept(self._tracks[k], track_ids, kinds == k)
            self._tracks[k].arrays['sums'][kept] += sums[rows]
            self._tracks[k].arrays['evidence'][kept, 0] = logarithms[rows]

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

    def inputs(
        self,
        config: Config,
        with_noise: bool = True,
        fits: tuple[Floats, Floats, Ints] | None = None,
    ) -> Inputs:
        """
        Return what is known of the errors of the input, records `INPUTS` (K,).

        As far as the method of `config` uses it.

        Parameters
        ----------
        config : Config
            Settings.
        with_noise : bool
            Whether the noise is estimated; else it is that of the settings.
        fits : tuple of arrays, shapes (B, N, 9), (B, 3, 3) and (B,)
            Residuals, extent evidence and kinds of whole tracks: their noise is used in place of
            that of the model, their evidence in addition to it.

        """
        inputs = np.zeros(len(KINDS), INPUTS)
        residuals, kinds = _of_all_kinds(self._residuals)
        more, of_fits = np.zeros((0, 3, 3)), np.zeros(0, int)
        if fits:
            residuals, more, of_fits = fits
            kinds = of_fits
        if not (with_noise and config.ingredients.noise_estimation):
            residuals, kinds = residuals[:0], kinds[:0]
        set_noise(inputs, residuals, kinds, self._past_noise, self.constants)
        inputs['spread'] = 1.0
        for faces, inset in zip(FACE_GROUPS, self._occlusion_insets, strict=True):
            inputs['occlusion_inset'][:, faces] = inset
        settings = settings_of_kinds(config)
        of_faces = self.constants.with_settings(config).face_deviations
        for k in range(len(KINDS)):
            tracks = np.concatenate([self._past[k], self._tracks[k].in_order])
            evidence = np.concatenate([tracks['evidence'], more[of_fits == k]])
            if config.ingredients.population_extents and len(evidence):
                found = population_slopes(evidence, self.constants)
                inputs['median'][k], inputs['slopes'][k] = found
            if len(tracks):
                deviations = GAP_DEVIATIONS[KINDS[k]]
                self._set_margins(inputs[k], tracks, settings[k], deviations, of_faces)
        return inputs

    def _set_margins(
        self,
        inputs: Any,
        tracks: NDArray[np.void],
        settings: Any,
        deviations: Sequence[float],
        face_deviations: Sequence[float],
    ) -> None:
        """Set margins and insets of one kind, by its `tracks`, noise and settings (M15)."""
        extents = np.exp(np.median(tracks['evidence'][:, 0], axis=0))
        parts = np.array([constant_part(c, 1.0) for c in inputs['correlation'].tolist()])
        bias = settings['pose'][:SIZE] * inputs['deviation'][:SIZE] * parts[:SIZE]
        half_extent = settings['extent'] * inputs['extent_error'] * parts[-SIZE:] * extents / 2
        along_axes = settings['gap_spread'] ** 2 + bias**2 + half_extent**2
        sums, strength = tracks['sums'], self.constants.half_weight
        margin, variance, spread, occluded, distant = (inputs[name] for name in MARGIN_FIELDS)
        for faces, deviation, inset in zip(
            FACE_GROUPS, deviations, self._occlusion_insets, strict=True
        ):
            of_face = max(face_deviations[faces[0]], settings['roughness'])
            prior = Pooled(0.0, deviation**2, along_axes[faces[0] // 2] + of_face**2)
            gaps = prior.given(_means(sums[:, 0], faces), strength)
            beyond = sums[:, 2].copy()
            beyond[:, 0] -= gaps.mean * beyond[:, 1]
            distant[faces] = prior.given(_means(beyond, faces), strength).mean
            if self._estimates_margins:
                margin[faces], variance[faces] = gaps.mean, gaps.variance
                spread[faces] = sqrt(gaps.between / prior.between)
                of_insets = prior._replace(mean=inset)
                occluded[faces] = of_insets.given(_means(sums[:, 1], faces), strength).mean

    def add_noise(self, residuals: Floats, kind: Ints) -> None:
        """Add the noise of whole tracks, by their residuals (B, N, 9) (M16)."""
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


def _means(sums: Floats, faces: Sequence[int]) -> Floats:
    """Return the mean of a quantity over some faces, of each track that shows it (n, 3, 6)."""
    total, count, share = sums[..., faces].sum(-1).T
    is_known = count >= MIN_HITS
    return np.asarray(total[is_known] / share[is_known])


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
