"""What the input tells about itself: its annotation rule, and how it errs."""

from collections.abc import Sequence
from typing import cast, NamedTuple

from boxreg_ros.config import FaceConfig
from boxreg_ros.correspondence import Rule, Support
from boxreg_ros.geometry import rotation_from_rpy
from boxreg_ros.objective import EXTENT, Problem, State
from boxreg_ros.structures import Floats
import numpy as np
import torch
from torch import Tensor

KINDS = ([0, 1], [2, 3], [4], [5])  # ends, sides, top, bottom
RULE_ERROR = (0.05, 0.05, 0.05, 0.15)  # how far a rule may be from the expected one [m]
TRACKS, SCATTERS = 200, 100  # remembered: tracks, and observations of each
LEAST = 14  # observations of a track, that it tells how its input errs
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

    """

    deviation: Tensor = torch.zeros(9, dtype=torch.float64)
    correlation: Tensor = torch.zeros(9, dtype=torch.float64)
    offset: Tensor = torch.zeros(9, dtype=torch.float64)
    trust: float = 0.0

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
        self._sights, self._scatter = dict[str, Floats](), dict[str, Floats]()
        self._noise, self._rule = InputNoise(), cast(Rule | None, None)
        self._fresh = self._measured = 0

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
        self._rule = None

    def learn_noise(self, names: Sequence[str], scatters: Floats) -> None:
        """Take what one more observation of each track `names` scatters, (B, 9)."""
        for name, row in zip(names, scatters, strict=True):
            known = _of(self._scatter, name, np.full((SCATTERS, 9), np.nan))
            known[:-1], known[-1] = known[1:].copy(), row
        self._fresh += int(np.isfinite(scatters).all(1).sum())

    def rule(self) -> Rule:
        """Return the annotation rule to expect."""
        if self._rule is None:
            known = np.array(list(self._sights.values())).reshape(-1, 3, 3, 6)
            gaps = self._middle(known[:, 0], (0.0,) * 4)
            depths = self._middle(self._learn * known[:, 1], self._depths)
            known[:, 2, 0] -= gaps.numpy() * known[:, 2, 1]
            self._rule = Rule(self._learn * gaps, depths, self._middle(known[:, 2], (0.0,) * 4))
        return self._rule

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
        """
        Return the noise of what `learn_noise` took.

        Measured anew when that has grown by a twentieth: it costs as much as there is.

        """
        if self._fresh > 0.05 * self._measured:
            known = torch.from_numpy(np.array(list(self._scatter.values())))
            self._noise = InputNoise.measure(known)
            self._fresh, self._measured = 0, int(known[..., 0].isfinite().sum())
        return self._noise


def _of(known: dict[str, Floats], name: str, fresh: Floats) -> Floats:
    """Return the array of a track, `fresh` for a new one; forget the one seen longest ago."""
    known[name] = found = known.pop(name, fresh)
    if len(known) > TRACKS:
        del known[next(iter(known))]
    return found
