"""What the input tells about itself: its annotation rule, and how it errs."""

from collections.abc import Sequence
from typing import NamedTuple

from boxreg_ros.config import FaceConfig
from boxreg_ros.core.arrowhead import Factor
from boxreg_ros.core.face_support import Rule, Support
from boxreg_ros.core.geometry import rotation_from_rpy
from boxreg_ros.core.objective import ERRORS, EXTENT, Problem, State
from boxreg_ros.structures import Floats
import numpy as np
import torch
from torch import Tensor

KINDS = ([0, 1], [2, 3], [4], [5])  # ends, sides, top, bottom
RULE_ERROR = (0.05, 0.05, 0.05, 0.15)  # how far a rule may be from the expected one [m]
TRACKS, SCATTERS = 200, 100  # remembered: tracks, and observations of each
LEAST = 14  # observations of a track, that it tells how its input errs
USUAL = 0.385  # correlation of the errors of an input from one observation to the next
TENTH = 0.1  # of a second, over which errors that are biased are correlated
APART = 0.5, 0.7  # tracks so far off are biased, and by no more than that [usual errors]
CAREFUL = 0.4  # part of the usual error: boxes that scatter less were drawn with care
UNLIKE = 0.5  # objects that differ by so much in logarithms of extents say half of each other
# Corrections of extents over sizes, by squared errors: 0.6 where extents err by 5 % is usual, and
# half of that over the sizes of the other two.
SLOPES = 240.0
HELD = 1e-3  # step of a box that only repeats the one before [m, rad]


class InputNoise(NamedTuple):
    """
    How input poses and extents scatter about their fits.

    Attributes
    ----------
    deviation, correlation, offset : Tensor, shape (9,)
        Robust standard deviation along the box axes (lon lat z roll pitch yaw [m, rad], extents
        as part of each) about the mean of a track, correlation from one observation to the next,
        0 to 0.9, and robust standard deviation of the means of the tracks about zero.
    trust : float
        0 where nothing is known, a half after `LEAST` observations, near 1 after many.
    told : Tensor, shape (n, 3, 3)
        What the points of n tracks tell of their extents. Rows of length, width and height:
        logarithms of those of the input, corrections to these in proportion to the square of
        their expected error, and the weights of these; 0 where points tell too little.

    """

    deviation: Tensor = torch.zeros(9, dtype=torch.float64)
    correlation: Tensor = torch.zeros(9, dtype=torch.float64)
    offset: Tensor = torch.zeros(9, dtype=torch.float64)
    trust: float = 0.0
    told: Tensor = torch.zeros(1, 3, 3, dtype=torch.float64)

    @classmethod
    def measure(cls, scatter: Tensor) -> 'InputNoise':
        """Pool the tracks (B, N, 9) that are long enough to tell; NaN tells nothing."""
        valid, scatter = scatter.isfinite().all(2), scatter.nan_to_num()
        valid &= valid.sum(1, keepdim=True) >= LEAST
        if not (total := int(valid.sum())):
            return cls()
        count = valid.sum(1)[:, None, None].clamp(min=1)
        mean = (scatter * valid[..., None]).sum(1, keepdim=True) / count
        offset, scatter = 1.48 * mean[valid.any(1), 0].abs().median(0).values, scatter - mean
        deviation = 1.48 * scatter[valid].abs().median(0).values
        bounded = scatter.clamp(-3 * deviation, 3 * deviation)
        both = valid[:, 1:] & valid[:, :-1]
        first, second = bounded[:, :-1][both], bounded[:, 1:][both]
        power = (first.square() + second.square()).sum(0) / 2
        # What never changes, such as an extent that a tracker holds, errs by the same all along;
        # one or two tracks cannot tell it from the gap of their faces.
        held = 1 - 2 / valid.any(1).sum()
        slow = torch.where(power > 1e-12, (first * second).sum(0) / power, held).clamp(0.0, 0.9)
        # The mean of a track takes part of what changes slowly along.
        lost = (1 + slow) / (1 - slow) * valid.any(1).sum() / total
        deviation = deviation / (1 - lost).clamp(min=0.3).sqrt()
        return cls(deviation, slow, offset, total / (total + LEAST))


NOTHING = InputNoise()


def scatter(problem: Problem, state: State) -> Tensor:
    """
    Return input minus fit along the box axes, as `InputNoise` counts them, (B, N, 9).

    NaN for boxes that repeat the one before, since what a tracker holds does not tell how it errs,
    and for those without points: their fit follows the input.

    """
    difference = problem.pose - state.pose
    along = (rotation_from_rpy(state.pose[..., 3:]).mT @ difference[..., :3, None])[..., 0]
    extent = problem.boxes[..., 3:6] / state.shared[:, None, EXTENT] - 1
    found = torch.cat([along, difference[..., 3:], extent], -1)
    # Before the first comes the last: of an object that is held all along it is the same box.
    held = (problem.boxes - problem.boxes.roll(1, 1)).abs().amax(-1) < HELD
    return torch.where((problem.mask.any(-1) & ~held)[..., None], found, torch.nan)


class Expected(NamedTuple):
    """
    What is expected of a batch before its points are looked at.

    Attributes
    ----------
    shared : Tensor, shape (B, 22)
        What all observations of a window share, see `State`.
    spread : Tensor, shape (B, 22)
        Deviations of that; for gaps, parts of what is expected of them.
    error, widened : Tensor, shape (B, 6)
        Deviation of the input poses along the axes of their boxes, their bias apart, and what
        counts for it where errors of neighbours are correlated [m, rad].

    """

    shared: Tensor
    spread: Tensor
    error: Tensor
    widened: Tensor


def expect(problem: Problem, rule: Rule, noise: InputNoise = NOTHING) -> Expected:
    """
    Return what is expected of a batch, by what is known of how its input is drawn and errs.

    Notes
    -----
    The error of an input is a part that is constant over its track, the bias, and one that
    changes slowly: the correlation measured widens its deviation, and without correlation over a
    tenth of a second there is no bias either. Input that scatters by less than `CAREFUL` of its
    usual error errs by less than its scatter tells, and where that is below half of the usual its
    extents are held more, too: it was drawn with care. But what a filter has smoothed scatters as
    little, and errs by the same all along a track. Then the means of tracks are far off their
    fits, and bias and extents stay free. Gaps differ between objects by twice as much where boxes
    were drawn with care: these tell of their own.

    """
    of, valid, error = problem.of, problem.valid, problem.of(*ERRORS)
    correlation = USUAL + noise.trust * (noise.correlation.to(error) - USUAL)
    ratio = noise.deviation[:6].to(error) / error
    ratio = (ratio * (ratio / CAREFUL).square().clamp(max=1.0)).clamp(0.02, 4.0)
    ratio = (1 + noise.trust * (ratio**2 - 1)).sqrt()
    interval = ((problem.times * valid).amax(1) / (valid.sum(1) - 1).clamp(1))[:, None]
    slow = ((correlation ** (TENTH / interval) - 0.15) / 0.3).clamp(0.1, 1.0)
    means = noise.offset[[0, 1, 6]].to(error) / torch.cat([error[:, :2], of('extent')], 1)
    apart = noise.trust * (means.mean(1, keepdim=True) / APART[0]).square().clamp(max=APART[1])
    lasting = torch.cat([ratio[:, :3].maximum(apart), ratio[:, 3:]], 1).clamp(0.1, 2.0)
    bias = error * error.new_tensor([1, 1, 1, 1, 1, 0.5]) * slow[:, :6] * lasting
    error, part = error * ratio, of('extent') * slow[:, 6:] * (2 * lasting[:, :3]).clamp(max=1)
    widened = error * ((1 + correlation[:6]) / (1 - correlation[:6])).sqrt()
    total = (problem.boxes[..., 3:6] * valid[..., None]).sum(1) + problem.seen[:, :3]
    mean, one = total / (valid.sum(1)[:, None] + problem.seen[:, 3:]), torch.ones_like(error)
    extent, loose = mean * extent_factor(noise.told, mean, part), (2 - 2 * lasting[:, :1]).clamp(1)
    gaps = of('gap_ends', 'gap_ends', 'gap_sides', 'gap_sides', 'gap_top', 'gap_bottom')
    shared = [extent, 0 * one, gaps + rule.gaps.to(error), mean[:, :1] * of('pivot'), 0 * one]
    spread = [extent * part, bias, one * loose, mean[:, :1] / 4, one]
    return Expected(torch.cat(shared, 1), torch.cat(spread, 1), error, widened)


def extent_factor(told: Tensor, given: Tensor, error: Tensor) -> Tensor:
    """
    Return what true extents are expected to be, as parts of those of the input, (B, 3).

    Parameters
    ----------
    told : Tensor, shape (n, 3, 3)
        What points tell of the extents of n tracks, see `InputNoise`.
    given, error : Tensor, shape (B, 3)
        Mean extents of the input [m], and how much they err, as parts of them.

    Notes
    -----
    Detectors that learn shrink extents toward those of most objects, noise spreads them: tracks
    whose points tell their extents show which, and by how much. A regression of these corrections
    on how far all three extents are from the medians, in logarithms and in proportion to the
    square of the error: what was drawn with care is left as it is. Of objects unlike most, trucks
    among cars, it says little, and of the medians nothing: these are the annotation rule's.

    """
    log, found, weight = told.to(given).unbind(1)
    off, own = (x - log.median(0).values for x in (log, given.log()))
    near, here = (1 / (1 + (x / UNLIKE).square().sum(1, keepdim=True)) for x in (off, own))
    A = near * off
    weighted = weight.mT[..., None] * A
    curvature = weighted.mT @ A + torch.diag_embed(4 - 3 * torch.eye(3).to(A)) / SLOPES**2
    slopes = torch.linalg.solve(curvature, ((near * found).mT[:, None] @ weighted)[:, 0])
    return torch.exp(error**2 * (here * own @ slopes.mT))


def extents_told(given: Tensor, expected: Expected, state: State, factor: Factor) -> Tensor:
    """
    Return what the points alone tell of extents, corrections and their weights, (B, 2, 3).

    Parameters
    ----------
    given : Tensor, shape (B, 3)
        Logarithms of the mean extents of the input.
    expected : Expected
        Of the fit: its part in that is taken off.
    state, factor : State, Factor
        The fit, and its curvature.

    """
    wanted, error = expected.shared[:, EXTENT], expected.spread[:, EXTENT]
    variance = torch.cholesky_inverse(factor.corner).diagonal(dim1=1, dim2=2)[:, EXTENT]
    gain, power = 1 - variance / error**2, (error / wanted) ** 2
    alone = (state.shared[:, EXTENT] / wanted).log() / gain + wanted.log()
    tells = (gain > 0.2) & alone.isfinite()  # less says more of the prior
    return torch.where(tells[:, None], torch.stack([(alone - given) / power, gain * power], 1), 0)


class InputModel:
    """
    The annotation rule and the noise of the input, learnt as it comes.

    The rule is the gap between a label's faces and the outermost points on them. Each track
    gives one sight per face, the mean over its observations of the gap less the one expected of
    its class, and the mean of the middle half of all tracks is weighed against no difference:
    boxes that err by more than the gap still tell it if their error has no preferred direction.
    Faces beyond 45 m tell how much further in points stand there; where the rule is stated, too,
    since what all boxes err by does not matter for the difference.

    """

    def __init__(self, config: FaceConfig) -> None:
        self._learn, self._depths = config.learn, (config.depth_ends, config.depth_sides, 0.0, 0.0)
        self._sights, self._scatter, self._extents = (dict[str, Floats]() for _ in range(3))

    def learn_rule(self, names: Sequence[str], support: Support, new: Tensor, rule: Rule) -> None:
        """
        Take the observations `new` (B, N) of tracks `names`, sighted at their input boxes.

        `rule` is what `support` was made with.

        """
        out, (hidden, distant) = support.outwardness, support.shares
        rule = Rule(*(part.to(out) for part in rule))
        hidden = hidden * (rule.depths > 0)  # the bottom is known by the road
        is_open, is_far, many = hidden < 0.25, distant > 0.5, (support.points >= 30)[..., None]
        tells = torch.stack([many & is_open & ~is_far, many & (hidden > 0.5), is_open & is_far])
        tells &= (support.trust > 0) & (out.abs() < 0.5) & new[..., None]
        levels = torch.stack([0 * hidden, hidden * rule.depths, distant * rule.distant]) - out
        levels[::2] += rule.gaps  # a depth is counted from the gap of the moment
        shares = torch.stack([torch.ones_like(out), hidden, distant])
        sums = torch.stack([levels * tells, tells, shares * tells], 1).sum(3).movedim(2, 0)
        for name, row in zip(names, sums.cpu().numpy(), strict=True):
            _of(self._sights, name, np.zeros((3, 3, 6)))[:] += row

    def learn_fits(self, names: Sequence[str], scatters: Floats, told: Floats) -> None:
        """Take what one more observation of tracks `names` scatters, (B, 9), and (B, 3, 3)."""
        for name, row, extents in zip(names, scatters, told, strict=True):
            known = _of(self._scatter, name, np.full((SCATTERS, 9), np.nan))
            known[:-1], known[-1] = known[1:].copy(), row
            _of(self._extents, name, extents)[:] = extents

    def rule(self) -> Rule:
        """Return the annotation rule to expect."""
        known = np.array(list(self._sights.values())).reshape(-1, 3, 3, 6)
        gaps = self._middle(known[:, 0], (0.0,) * 4)
        depths = self._middle(self._learn * known[:, 1], self._depths)
        known[:, 2, 0] -= gaps.numpy() * known[:, 2, 1]
        return Rule(self._learn * gaps, depths, self._middle(known[:, 2], (0.0,) * 4))

    def _middle(self, known: Floats, expected: Sequence[float]) -> Tensor:
        """Weigh what is `expected` of each kind of face against the middle of the tracks."""
        values = torch.zeros(6, dtype=torch.float64)
        for faces, value, deviation in zip(KINDS, expected, RULE_ERROR, strict=True):
            level, count, share = known[..., faces].swapaxes(0, 1).reshape(3, -1)
            sights = np.sort(level[count >= 3] / share[count >= 3])
            if (n := len(sights)) >= 3:
                # The mean of the middle half errs by an eighth less than the median.
                middle = sights[n // 4 : n - n // 4].mean()
                error = 1.1 * (0.74 * (sights[n - 1 - n // 4] - sights[n // 4]) + 0.02)
                trust = deviation**2 / (deviation**2 + error**2 / n)
                value = value + trust * (middle - value)
            values[faces] = float(value)
        return values

    def noise(self) -> InputNoise:
        """Return the noise of what `learn_fits` took."""
        known = np.array(list(self._scatter.values())).reshape(-1, SCATTERS, 9)
        told = np.array([*self._extents.values()] or [np.zeros((3, 3))])
        return InputNoise.measure(torch.from_numpy(known))._replace(told=torch.from_numpy(told))


def _of(known: dict[str, Floats], name: str, fresh: Floats) -> Floats:
    """Return the array of a track, `fresh` for a new one; forget the one seen longest ago."""
    known[name] = found = known.pop(name, fresh)
    if len(known) > TRACKS:
        del known[next(iter(known))]
    return found
