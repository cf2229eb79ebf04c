"""
The input model: labelling margins, noise and population of the input of a stream.

docs/method.md, section Input model, has the formulas.

"""

from collections.abc import Sequence
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
FIRST_FACES = np.array([faces[0] for faces in FACE_GROUPS])
"""The first face of each group."""
GROUP_OF_FACE = np.repeat(np.arange(len(FACE_GROUPS)), [len(faces) for faces in FACE_GROUPS])
"""The group of each face."""
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
    Quantities that differ from track to track: normal-inverse-chi-squared distributions (M15).

    Attributes
    ----------
    mean, variance : array, shape (m,)
        Of the means over all tracks [m], and the variances of these estimates [m^2].
    between : array, shape (m,)
        Variances between tracks [m^2].

    """

    mean: Floats
    variance: Floats
    between: Floats

    def given(self, values: Floats, prior_tracks: float) -> 'Pooled':
        """
        Return the posterior, by the values (n, m) of n tracks, robustly; NaN is left out.

        The variance of the prior counts as that of `prior_tracks`.

        """
        values = np.sort(values, axis=0)  # NaN comes last
        n = np.isfinite(values).sum(0)
        quarter, rank, face = n // 4, np.arange(len(values))[:, None], np.arange(len(n))
        first, last = values[quarter, face], values[n - 1 - quarter, face]
        between = prior_tracks * self.between + n * (QUARTILES_TO_DEVIATION * (last - first)) ** 2
        between /= prior_tracks + n
        information = n / (MIDMEAN_FACTOR * between)
        variance = 1 / (1 / self.variance + information)
        is_middle = (quarter <= rank) & (rank < n - quarter)
        middle = np.where(is_middle, values, 0.0).sum(0) / (n - 2 * quarter).clip(1)
        mean = variance * (self.mean / self.variance + information * middle)
        is_known = n >= MIN_HITS
        return Pooled(*np.where(is_known, (mean, variance, between), self))


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
    latest : array of `INPUTS`, shape (K,), or None
        What the batch before was solved with: new boxes are observed with it. None before the
        first one.

    """

    def __init__(
        self,
        config: FaceConfig,
        drives: Drives | None = None,
        numbers: constants.Constants | None = None,
    ) -> None:
        self.constants = numbers or constants.CONSTANTS
        self.latest: Inputs | None = None
        self._estimates_margins = config.learn
        self._occlusion_insets = np.array([config.inset_ends, config.inset_sides, 0.0, 0.0])
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
        self,
        track_ids: Sequence[str],
        problem: Problem,
        poses: Floats,
        config: Config,
        is_input: bool = False,
    ) -> None:
        """
        Add the face observations of some windows at their input boxes.

        Those at the angles of the input are replaced by the next ones of their tracks.

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
        is_input : bool
            Whether the angles of `poses` are those of the input.

        """
        inputs = self.latest
        if inputs is None:
            inputs = self.inputs(config, with_noise=False)
        terms = np.zeros(problem.counts.shape, TERMS)
        run(
            observe_faces, len(poses), problem, np.ascontiguousarray(poses),
            problem.expected_shared(inputs), inputs,
            self.constants.with_settings(config).record(), terms,
        )  # fmt: skip
        self._add(track_ids, problem, terms, inputs, is_input)

    def _add(
        self,
        track_ids: Sequence[str],
        problem: Problem,
        terms: NDArray[np.void],
        inputs: Inputs,
        is_input: bool = False,
    ) -> None:
        """Add face observations, of records `TERMS` (B, N), that were made with `inputs`."""
        kinds = problem.kind
        numbers = self.constants
        distance, weight = terms['distance'], terms['visibility']
        occluded, distant = np.moveaxis(terms['inset_shares'], 2, 0)
        margin, occlusion_inset, range_inset = (
            inputs[name][kinds][:, None] for name in ('margin', 'occlusion_inset', 'range_inset')
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
            known = self._tracks[k].arrays
            known['at_input'][kept] = sums[rows] if is_input else 0.0
            known['sums'][kept] += 0.0 if is_input else sums[rows]
            known['evidence'][kept, 0] = logarithms[rows]

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
        inputs['occlusion_inset'] = self._occlusion_insets[GROUP_OF_FACE]
        settings = settings_of_kinds(config)
        of_faces = self.constants.with_settings(config).face_deviations
        for k in range(len(KINDS)):
            tracks = self._tracks_of(k)
            if len(tracks):
                deviations = GAP_DEVIATIONS[KINDS[k]]
                self._set_margins(inputs[k], tracks, settings[k], deviations, of_faces)
        self.set_population(inputs, config, more, of_fits)
        return inputs

    def set_population(
        self, inputs: Inputs, config: Config, evidence: Floats, kinds: Ints
    ) -> None:
        """
        Set the population of extents in records `INPUTS` (K,) (M18).

        By the tracks of the model and further `evidence` (B, 3, 3) of tracks of `kinds` (B,).

        """
        if not config.ingredients.population_extents:
            return
        for k in range(len(KINDS)):
            known = np.concatenate([self._tracks_of(k)['evidence'], evidence[kinds == k]])
            if len(known):
                found = population_slopes(known, self.constants)
                inputs['median'][k], inputs['slopes'][k] = found

    def _tracks_of(self, k: int) -> NDArray[np.void]:
        """Return the tracks of one kind, with those of other drives, records `TRACK` (n,)."""
        return np.concatenate([self._past[k], _shown(self._tracks[k])])

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
        along_axes = bias**2 + half_extent**2
        spread = np.array([*[settings['gap_spread']] * 3, self.constants.road_spread])
        of_face = np.maximum(face_deviations, settings['roughness'])[FIRST_FACES]
        between = spread**2 + along_axes[FIRST_FACES // 2] + of_face**2
        prior = Pooled(np.zeros(len(between)), np.square(deviations), between)
        # Of each track, quantity and group of faces: the sums of value, count and share.
        sums = np.add.reduceat(tracks['sums'], FIRST_FACES, axis=-1)
        strength = self.constants.half_weight
        gaps = prior.given(_means(sums[:, 0]), strength)
        sums[:, 2, 0] -= gaps.mean * sums[:, 2, 1]
        inputs['range_inset'] = prior.given(_means(sums[:, 2]), strength).mean[GROUP_OF_FACE]
        if self._estimates_margins:
            inputs['margin'] = gaps.mean[GROUP_OF_FACE]
            inputs['margin_variance'] = gaps.variance[GROUP_OF_FACE]
            inputs['spread'] = np.sqrt(gaps.between / between)[GROUP_OF_FACE]
            of_insets = prior._replace(mean=self._occlusion_insets)
            insets = of_insets.given(_means(sums[:, 1]), strength).mean
            inputs['occlusion_inset'] = insets[GROUP_OF_FACE]

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
            kinds.append(KindStatistics(_shown(self._tracks[k]), noise))
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
            for total, count, share in _shown(tracks)['sums'][:, quantity][..., faces]:
                is_known = count >= MIN_HITS
                if is_known.any():
                    means.append(total[is_known] / share[is_known])
        return means


def _shown(tracks: TrackRows) -> NDArray[np.void]:
    """Return what tracks show, with the face observations at the angles of their input."""
    found = tracks.in_order
    found['sums'] += found['at_input']
    found['at_input'] = 0.0
    return found


def _means(sums: Floats) -> Floats:
    """Return the mean of a quantity, of each track and group of faces; NaN where it is unknown."""
    total, count, share = np.moveaxis(sums, 1, 0)
    means = np.full(count.shape, np.nan)
    np.divide(total, share, out=means, where=count >= MIN_HITS)
    return means


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
