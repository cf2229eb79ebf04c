"""
The input model: labelling margins (M18), noise and population of the input of a stream.

docs/method.md, section Input model, has the formulas.

"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TYPE_CHECKING

from boxreg_ros.config import FaceConfig, KINDS
from boxreg_ros.core.track_rows import TrackRows
from boxreg_ros.structures import Floats, Ints
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # a process that only keeps the model between two batches needs no torch
    from boxreg_ros.core.face_support import FaceObservations, FaceOffsets
    from boxreg_ros.core.input_noise import InputNoise
    from boxreg_ros.core.margin_spread import GapScatter
    from boxreg_ros.core.population import Population
    from torch import Tensor

# Constants whose origin is not stated are chosen; `boxreg bench sensitivity` halves and doubles
# each of them.
QUARTILES_TO_DEVIATION = 0.74
"""Standard deviation over interquartile range. Derived: 1 / 1.349 for a Gaussian."""
FACE_GROUPS = ([0, 1], [2, 3], [4], [5])
"""Faces with one labelling margin: ends, sides, top, bottom."""
GAP_DEVIATIONS = {
    'vehicle': (0.05, 0.05, 0.05, 0.15),
    'cyclist': (0.15, 0.15, 0.15, 0.15),
    'pedestrian': (0.15, 0.15, 0.15, 0.15),
}
"""Prior deviation of each margin from the one of the settings of its kind [m]."""
MIN_TRACK_OBSERVATIONS = 3
"""Fewest face observations of a track, and tracks, that a margin is estimated from."""
MIN_GAP_DEVIATION = 0.02
"""Added to the interquartile range of margins: few tracks may agree by chance [m]."""
MIDMEAN_FACTOR = 1.1
"""Error of the mean of the middle half over that of the mean. Derived: sqrt(1.2), the efficiency
of the midmean of a Gaussian."""
MAX_SCATTER = 3.0
"""Gaps of tracks are clipped at this many robust deviations before their variance is taken, as
residuals before their correlation."""
MAX_FACE_DISTANCE = 0.5
"""No margin is estimated from points further than this from where they are expected [m]."""
MIN_BOX_POINTS = 30
"""No margin is estimated from near boxes with fewer points."""
MAX_VISIBLE_SHARE = 0.25
"""A face with a smaller share of the occlusion inset counts as visible."""
MIN_OCCLUDED_SHARE = 0.5
"""A face with a larger share of the occlusion inset counts as occluded."""
MIN_DISTANT_SHARE = 0.5
"""A face with a larger share of the range inset counts as distant: beyond 45 m."""
MAX_TRACKS = 200
"""Tracks of each kind that the model keeps, those seen last."""
MAX_FITS_PER_TRACK = 100
"""Fits of each track that the model keeps, the last ones."""


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

    """

    def __init__(self, config: FaceConfig) -> None:
        self._estimates_margins = config.learn
        self._occlusion_insets = (config.inset_ends, config.inset_sides, 0.0, 0.0)
        # Of each track of each kind: sums over its face observations, see
        # `add_face_observations`; its last input residuals; its extent evidence.
        unknown = np.full((MAX_FITS_PER_TRACK, 9), np.nan)
        self._faces = [TrackRows(np.zeros((3, 3, 6)), MAX_TRACKS) for _ in KINDS]
        # Columns of `FaceOffsets` and of `GapScatter` that follow from the present sums.
        self._margins_of_kinds: list[tuple[Floats, ...] | None] = [None] * len(KINDS)
        self._known_margins: tuple[FaceOffsets, GapScatter] | None = None
        self._residuals = [TrackRows(unknown, MAX_TRACKS) for _ in KINDS]
        self._evidence = [TrackRows(np.zeros((3, 3)), MAX_TRACKS) for _ in KINDS]

    def __getstate__(self) -> dict[str, Any]:
        """Return what was observed; margins that follow from it are computed again."""
        nothing: list[None] = [None] * len(KINDS)
        return {**vars(self), '_known_margins': None, '_margins_of_kinds': nothing}

    def add_face_observations(
        self,
        track_ids: Sequence[str],
        kind: Tensor,
        observations: FaceObservations,
        new: Tensor,
        offsets: FaceOffsets,
    ) -> None:
        """
        Add face observations at input boxes.

        Parameters
        ----------
        track_ids : sequence of B str
            The tracks.
        kind : Tensor, shape (B,)
            Indices of their kinds among `KINDS`.
        observations : FaceObservations
            Of their windows.
        new : Tensor, shape (B, N)
            Which of them count.
        offsets : FaceOffsets
            What `observations` were made with.

        """
        distance, weight, inset_shares, num_points = (
            part.cpu().numpy() for part in observations[1:3] + observations[4:]
        )
        occluded, distant = np.moveaxis(inset_shares, 2, 0)
        kinds = kind.cpu().numpy()
        gap_correction, occlusion_inset, range_inset = (
            np.broadcast_to(part.cpu().numpy(), (len(KINDS), 6))[kinds][:, None]
            for part in offsets
        )
        occluded = occluded * (occlusion_inset > 0)  # the bottom is observed by the road
        is_visible = occluded < MAX_VISIBLE_SHARE
        is_distant = distant > MIN_DISTANT_SHARE
        has_points = (num_points >= MIN_BOX_POINTS)[..., None]
        # Three quantities: gap, occlusion inset, range inset; all (3, B, N, 6).
        counts = np.stack([
            has_points & is_visible & ~is_distant,
            has_points & (occluded > MIN_OCCLUDED_SHARE),
            is_visible & is_distant,
        ])  # fmt: skip
        counts &= (weight > 0) & (np.abs(distance) < MAX_FACE_DISTANCE)
        counts &= new.cpu().numpy()[..., None]
        values = np.stack([
            0 * occluded, occluded * occlusion_inset, distant * range_inset
        ]) - distance  # fmt: skip
        values[::2] += gap_correction  # an occlusion inset is counted from the present gap
        shares = np.stack([np.ones_like(distance), occluded, distant])
        # (B, 3 quantities, 3 sums: value, count, share; 6 faces)
        sums = np.moveaxis(np.stack([values * counts, counts, shares * counts], 1).sum(3), 2, 0)
        self._known_margins = None
        for k in set(kinds.tolist()):
            self._margins_of_kinds[k] = None
            rows, kept = _kept(self._faces[k], track_ids, kinds == k)
            self._faces[k].arrays[kept] += sums[rows]

    def add_fits(
        self, track_ids: Sequence[str], kind: Tensor, residuals: Floats, evidence: Floats
    ) -> None:
        """
        Add one fit of each track.

        Parameters
        ----------
        track_ids : sequence of B str
            The tracks.
        kind : Tensor, shape (B,)
            Indices of their kinds among `KINDS`.
        residuals : array, shape (B, 9)
            `input_residuals`, over their expected deviations.
        evidence : array, shape (B, 3, 3)
            Evidence of the extents, see `Population`.

        """
        kinds = kind.cpu().numpy()
        for k in set(kinds.tolist()):
            rows, kept = _kept(self._residuals[k], track_ids, kinds == k)
            known = self._residuals[k].arrays
            known[kept, :-1] = known[kept, 1:]
            known[kept, -1] = residuals[rows]
            rows, kept = _kept(self._evidence[k], track_ids, kinds == k)
            self._evidence[k].arrays[kept] = evidence[rows]

    def gap_corrections(self) -> Floats:
        """Return the labelling margins less those of the settings, (K, 6) [m]; without torch."""
        return np.stack([self._margins_of(kind)[0] for kind in range(len(KINDS))])

    def offsets(self) -> FaceOffsets:
        """Return the labelling margins and insets to expect of each kind."""
        return self._margins()[0]

    def gap_scatter(self) -> GapScatter:
        """Return how the gaps of the tracks of each kind scatter."""
        return self._margins()[1]

    def _margins(self) -> tuple[FaceOffsets, GapScatter]:
        from boxreg_ros.core.face_support import FaceOffsets
        from boxreg_ros.core.margin_spread import GapScatter
        import torch

        if self._known_margins is None:
            for k, known in enumerate(self._margins_of_kinds):
                self._margins_of_kinds[k] = known or self._margins_of(k)
            columns = zip(*self._margins_of_kinds, strict=True)
            parts = [torch.from_numpy(np.stack(column)) for column in columns]
            self._known_margins = FaceOffsets(*parts[:3]), GapScatter(*parts[3:])
        return self._known_margins

    def _margins_of(self, kind: int) -> tuple[Floats, ...]:
        """Return the columns of `FaceOffsets` and of `GapScatter` for one kind, (6,) each."""
        known = self._faces[kind].in_order
        none = (0.0,) * len(FACE_GROUPS)
        deviations = GAP_DEVIATIONS[KINDS[kind]]
        of_gaps = _means_of_groups(known[:, 0])
        gaps = _pooled(of_gaps, none, deviations)
        known[:, 2, 0] -= gaps * known[:, 2, 1]
        range_insets = _pooled(_means_of_groups(known[:, 2]), none, deviations)
        used = known if self._estimates_margins else known[:0]
        of_insets = _means_of_groups(used[:, 1])
        occlusion_insets = _pooled(of_insets, self._occlusion_insets, deviations)
        scatter = _scatter(of_gaps) * self._estimates_margins
        return self._estimates_margins * gaps, occlusion_insets, range_insets, *scatter

    def gaps_of_tracks(self, faces: Sequence[int]) -> list[Floats]:
        """Return gap corrections of some `faces` [m], one array per track that has any."""
        return self._means_of_tracks(0, faces)

    def occlusion_insets_of_tracks(self, faces: Sequence[int]) -> list[Floats]:
        """Return occlusion insets of some `faces` [m], one array per track that has any."""
        return self._means_of_tracks(1, faces)

    def noise(self) -> InputNoise:
        """Return the noise of all fits that were added."""
        from boxreg_ros.core.input_noise import InputNoise
        import torch

        residuals, kind = _of_all_kinds(self._residuals)
        return InputNoise.estimate_by_kind(torch.from_numpy(residuals), torch.from_numpy(kind))

    def population(self) -> Population:
        """Return the evidence of extents of the last fits that were added."""
        from boxreg_ros.core.population import Population
        import torch

        evidence, kind = _of_all_kinds(self._evidence)
        return Population(torch.from_numpy(evidence), torch.from_numpy(kind))

    def _means_of_tracks(self, quantity: int, faces: Sequence[int]) -> list[Floats]:
        means = []
        for sums in _of_all_kinds(self._faces)[0]:
            total, count, share = sums[quantity][:, faces]
            is_known = count >= MIN_TRACK_OBSERVATIONS
            if is_known.any():
                means.append(total[is_known] / share[is_known])
        return means


Means = list[tuple[Floats, Floats]]
"""Of each of `FACE_GROUPS`: the means of all tracks, sorted, and their numbers of observations."""


def _means_of_groups(known: Floats) -> Means:
    """Return the means of a quantity by the tracks' sums (n, 3, 6)."""
    found = []
    for faces in FACE_GROUPS:
        total, count, share = known[..., faces].swapaxes(0, 1).reshape(3, -1)
        is_known = count >= MIN_TRACK_OBSERVATIONS
        means = total[is_known] / share[is_known]
        order = np.argsort(means)
        found.append((means[order], count[is_known][order]))
    return found


def _pooled(means: Means, expected: Sequence[float], deviations: Sequence[float]) -> Floats:
    """Weigh the means of a quantity against its prior (M18), (6,)."""
    values = np.zeros(6)
    parts = zip(FACE_GROUPS, means, expected, deviations, strict=True)
    for faces, (of_tracks, _), prior, deviation in parts:
        values[faces] = _posterior_mean(of_tracks, prior, deviation)
    return values


def _scatter(means: Means) -> Floats:
    """Return the columns of `GapScatter` for the means of one kind, (3, 6)."""
    columns = np.zeros((3, 6))
    for faces, (of_tracks, counts) in zip(FACE_GROUPS, means, strict=True):
        if len(of_tracks):
            columns[0, faces] = _clipped_variance(of_tracks)
            columns[1, faces] = len(of_tracks)
            columns[2, faces] = (1 / counts).mean()
    return columns


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


def _clipped_variance(means: Floats) -> float:
    """Return the variance of sorted `means` about their midmean, without tails."""
    middle, deviation = _midmean(means)
    off = (means - middle).clip(-MAX_SCATTER * deviation, MAX_SCATTER * deviation)
    return float((off**2).sum() / max(len(means) - 1, 1))


def _posterior_mean(means: Floats, prior: float, deviation: float) -> float:
    """Weigh the midmean of sorted `means` against a prior with its deviation (M18)."""
    n = len(means)
    if n < MIN_TRACK_OBSERVATIONS:
        return prior
    middle, spread = _midmean(means)
    error = MIDMEAN_FACTOR * (spread + MIN_GAP_DEVIATION)
    weight = deviation**2 / (deviation**2 + error**2 / n)
    return float(prior + weight * (middle - prior))
