"""Noise of the input boxes of many tracks (M16)."""

from math import exp, log, sqrt

from boxreg_ros.core.method.compile import kernel, loop, small_array
from boxreg_ros.core.method.expectation import SIZE
from boxreg_ros.core.method.rotation import fill_rotation
from boxreg_ros.core.method.selection import lower_median, sum_of
import numpy as np

REPEATED_BOX_TOLERANCE = 1e-3
"""A box that differs from the one before by less repeats it [m, rad]. Chosen."""
MIN_POWER = 1e-12
"""Errors with a smaller variance do not change along a track [m^2, rad^2]. Derived: rounding."""
MAD_TO_DEVIATION = 1.48
"""Standard deviation over median absolute deviation. Derived: 1 / 0.6745 for a Gaussian."""
CORRELATION_ITERATIONS = 5
"""Alternating evaluations of the correlation and of the variance that track means remove.
Derived: they change by less than 0.1 % then."""

EXTENT_ERRORS = ((0.9, 0.9, 0.9), (0.8, 1.6, 0.65), (2.7, 1.6, 0.65))
"""Error of extents that is constant along a track, over the one of the settings, of vehicles,
cyclists and pedestrians. Measured of PointRCNN on KITTI, widths of the latter two on PandaSet."""
DETECTED = (0, 1, 2, 5)
"""Variables of a pose that detectors estimate, with one correlation: x, y, z, yaw."""
LEAST_RATIO = 0.02
"""Least estimated error over the one of the settings. Chosen."""


@loop
def fill_residuals(problem, poses, extents, residuals):
    """
    Write input minus fit over the deviations of the settings, (B, N, 9).

    Along the axes of the boxes at `poses` (B, N, 6) of `extents` (B, 3). NaN for boxes that repeat
    the one before, since boxes that a tracker holds have no new error, and for those without
    points, since their fit follows the input. The first box is compared with the last one: a track
    that is held throughout is left out.

    """
    R = small_array(3, 3)
    for b in range(len(poses)):
        boxes, of_class = problem.boxes[b], problem.of_class[b]
        for n in range(len(boxes)):
            box, before, pose = boxes[n], boxes[(n or len(boxes)) - 1], poses[b, n]
            own = residuals[b, n]
            change = 0.0
            for k in range(len(box)):
                change = max(change, abs(box[k] - before[k]))
            if problem.counts[b, n] == 0 or change < REPEATED_BOX_TOLERANCE:
                for k in range(len(own)):
                    own[k] = np.nan
                continue
            fill_rotation(pose[3], pose[4], pose[5], R)
            for k in range(SIZE):
                along = 0.0
                for j in range(SIZE):
                    along += R[j, k] * (box[j] - pose[j])
                own[k] = along / of_class.pose[k]
                own[3 + k] = (box[6 + k] - pose[3 + k]) / of_class.pose[3 + k]
                own[6 + k] = (box[3 + k] / extents[b, k] - 1) / of_class.extent


@loop
def are_finite(values):
    """Return whether all values (n,) are finite."""
    total = 0.0
    for value in values:
        total += 0.0 * value  # NaN for infinity and NaN
    return total == 0.0


@loop
def fill_valid(residuals, min_observations, valid):
    """Write which residuals (B, N, 9) count: finite ones of tracks with enough of them."""
    for b in range(len(residuals)):
        count = 0
        for n in range(residuals.shape[1]):
            valid[b, n] = are_finite(residuals[b, n])
            count += valid[b, n]
        if count < min_observations:
            valid[b] = False


@loop
def fill_centred(residuals, valid, j, errors):
    """Write variable `j` less the mean of its track, (B, N)."""
    for b in range(len(residuals)):
        total, count = 0.0, 0
        for n in range(residuals.shape[1]):
            if valid[b, n]:
                total += residuals[b, n, j]
                count += 1
        if count == 0:
            continue
        for n in range(residuals.shape[1]):
            errors[b, n] = residuals[b, n, j] - total / count


@loop
def median_size(errors, valid, sizes):
    """Return the median size of the valid `errors` (B, N)."""
    count = 0
    for b in range(len(errors)):
        for n in range(errors.shape[1]):
            if valid[b, n]:
                sizes[count] = abs(errors[b, n])
                count += 1
    return lower_median(sizes[:count])


@loop
def neighbour_sums(errors, valid, bound):
    """Return power and sum of products of neighbouring errors, each within +-bound."""
    power, products = 0.0, 0.0
    for b in range(len(errors)):
        for n in range(errors.shape[1] - 1):
            if valid[b, n] and valid[b, n + 1]:
                first = min(max(errors[b, n], -bound), bound)
                second = min(max(errors[b, n + 1], -bound), bound)
                power += (first**2 + second**2) / 2
                products += first * second
    return power, products


@loop
def removed_by_means(c, n):
    """
    Return the loss of variance when the mean of `n` autoregressive errors is subtracted.

    The second value is the loss of the mean product of neighbours; both are over the variance of
    an error of the correlation `c`.

    """
    with_mean = (1 - c**n) / (n * (1 - c))  # covariance of the first or last error with the mean
    of_mean = (1 + c) / (1 - c) / n - 2 * c * with_mean / (n * (1 - c))
    inner = (n * of_mean - with_mean) / (n - 1)  # neighbours leave out one end each
    return of_mean, 2 * inner - of_mean


@kernel
def estimate(residuals, constants, deviation, correlation):
    """
    Write deviation and correlation (9,) of residuals (B, N, 9); return how many of them count.

    Nothing is written where no residual counts. A constant error, such as that of an extent that
    a tracker holds, is fully correlated; with one or two tracks it cannot be distinguished from
    the labelling margin.

    """
    constants = constants[0]
    B, N, J = residuals.shape
    valid = np.empty((B, N), np.bool_)
    fill_valid(residuals, constants.min_observations, valid)
    count, tracks = 0, 0
    for b in range(B):
        of_track = sum_of(valid[b])
        count += of_track
        tracks += of_track > 0
    if count == 0:
        return 0
    errors, sizes = np.empty((B, N)), np.empty(count)
    for j in range(J):
        fill_centred(residuals, valid, j, errors)
        scatter = MAD_TO_DEVIATION * median_size(errors, valid, sizes)
        power, products = neighbour_sums(errors, valid, constants.gate * scatter)
        ratio = products / max(power, MIN_POWER)
        variance, removed = 0.0, 0.0
        for _ in range(CORRELATION_ITERATIONS):
            whole = ratio + (1 - ratio) * removed if power > MIN_POWER else 1 - 2 / tracks
            correlation[j] = min(max(whole, 0.0), constants.max_correlation)
            variance, removed = removed_by_means(correlation[j], count / tracks)
        deviation[j] = scatter / sqrt(max(1 - variance, constants.min_left))
    return count


@kernel
def fill_errors(past, found, constants, inputs):
    """
    Write the errors of K kinds (M16), (M17).

    The settings are the prior of all kinds together, and these of each.

    Parameters
    ----------
    past, found : array of `NOISE`, shape (K,)
        Of other drives, and of this one.
    constants : array of one record of `Constants`, shape (1,)
        Of the method.
    inputs : array of `INPUTS`, shape (K,)
        Their errors are written.

    """
    constants, K = constants[0], len(inputs)
    for k in range(K):
        of_kind = inputs[k]
        deviation, correlation = of_kind.deviation, of_kind.correlation
        for j in range(len(deviation)):
            variance, of_next = 1.0, constants.typical_correlation
            for is_own in (False, True):
                boxes, total, product = 0.0, 0.0, 0.0
                for other in range(K):
                    if (other == k) != is_own:
                        continue
                    for known in (past[other], found[other]):
                        boxes += known.boxes
                        total += known.boxes * known.deviation[j] ** 2
                        product += known.boxes * known.correlation[j]
                if boxes > 0:
                    share = boxes / (boxes + constants.half_weight)
                    variance += share * (total / boxes - variance)
                    of_next += share * (product / boxes - of_next)
            deviation[j] = max(sqrt(variance), LEAST_RATIO)
            correlation[j] = of_next
        common = 0.0
        for j in DETECTED:
            common += correlation[j] / len(DETECTED)
        for j in DETECTED:
            correlation[j] = common
        of_centres = exp((log(deviation[0]) + log(deviation[1]) + log(deviation[2])) / SIZE)
        of_kind.low_noise = min(of_centres / constants.low_noise, 1.0)
        # Trackers may hold the extents: no residual shows their errors. Those of the centre do.
        for axis in range(SIZE):
            of_kind.extent_error[axis] = EXTENT_ERRORS[k][axis] * of_kind.low_noise
