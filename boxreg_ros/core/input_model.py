"""
The input model: labelling margins, noise and population of the input of a stream.

docs/method.md, section Input model, has the formulas.

"""

from collections.abc import Sequence
from itertools import pairwise

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
from boxreg_ros.core.method.margins import fill_margins, FIRST_FACE, MIN_HITS, sum_faces
from boxreg_ros.core.method.population import population_slopes
from boxreg_ros.core.method.residuals import TERMS
from boxreg_ros.core.problem import Problem, settings_of_kinds
from boxreg_ros.core.threads import run
from boxreg_ros.core.track_rows import TrackRows
from boxreg_ros.structures import Floats, Ints
import numpy as np
from numpy.typing import NDArray

Inputs = NDArray[np.void]
FACE_GROUPS = [list(range(*ends)) for ends in pairwise(FIRST_FACE)]
"""Faces with one labelling margin: ends, sides, top, bottom."""
GROUP_OF_FACE = np.repeat(np.arange(len(FACE_GROUPS)), [len(faces) for faces in FACE_GROUPS])
"""The group of each face."""
GAP_DEVIATIONS = {
    'vehicle': np.array([0.05, 0.05, 0.05, 0.15]),
    'cyclist': np.full(4, 0.15),
    'pedestrian': np.full(4, 0.15),
}
"""Prior deviation of each margin from the one of the settings of its kind [m]. Chosen."""


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
            observe_faces, 4, len(poses), np.arange(len(poses)), problem,
            np.ascontiguousarray(poses), problem.expected_shared(inputs), inputs,
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
        sums, logarithms = np.zeros((len(kinds), 3, 3, 6)), np.log(problem.mean_extents())
        sum_faces(kinds, problem.lengths, terms, inputs, self.constants.record(), sums)
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
        residuals = [known.arrays for known in self._residuals]
        more, of_fits = np.zeros((0, 3, 3)), np.zeros(0, int)
        if fits:
            of_tracks, more, of_fits = fits
            residuals = [of_tracks[of_fits == k] for k in range(len(KINDS))]
        if not (with_noise and config.ingredients.noise_estimation):
            residuals = [part[:0] for part in residuals]
        set_noise(inputs, residuals, self._past_noise, self.constants)
        inputs['spread'] = 1.0
        inputs['occlusion_inset'] = self._occlusion_insets[GROUP_OF_FACE]
        settings = settings_of_kinds(config)
        record = self.constants.with_settings(config).record()
        for k, kind in enumerate(KINDS):
            tracks = self._tracks_of(k)
            if len(tracks):
                fill_margins(
                    k, tracks, settings, GAP_DEVIATIONS[kind], self._occlusion_insets,
                    self._estimates_margins, record, inputs,
                )  # fmt: skip
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
        record = self.constants.record()
        for k in range(len(KINDS)):
            known = np.ascontiguousarray(self._tracks_of(k)['evidence'])
            if len(evidence):
                known = np.concatenate([known, evidence[kinds == k]])
            if len(known):
                population_slopes(known, record, inputs['median'][k], inputs['slopes'][k])

    def _tracks_of(self, k: int) -> NDArray[np.void]:
        """Return the tracks of one kind, with those of other drives, records `TRACK` (n,)."""
        own = self._tracks[k].arrays
        return np.concatenate([self._past[k], own]) if len(self._past[k]) else own

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


def _kept(
    known: TrackRows, track_ids: Sequence[str], is_of_kind: NDArray[np.bool_]
) -> tuple[Ints, Ints]:
    """Return which tracks `is_of_kind` (B,) are kept, and their rows in the arrays of `known`."""
    of_kind = is_of_kind.nonzero()[0]
    places, rows = known.seen([track_ids[i] for i in of_kind.tolist()])
    return of_kind[places], rows
