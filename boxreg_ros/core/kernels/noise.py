"""
Noise of the input boxes of many tracks, in plain loops.

The torch twin is `boxreg_ros.core.input_noise.estimate_noise_torch`; the formulas are (M14).

"""

from math import sqrt

from boxreg_ros.core.kernels.compile import kernel
from boxreg_ros.core.kernels.lbfgs import are_finite
from boxreg_ros.core.kernels.selection import lower_median
import numpy as np


@kernel
def fill_valid(residuals, min_observations, valid):
    """Write which residuals (B, N, 9) count: finite ones of tracks with enough of them."""
    for b in range(len(residuals)):
        count = 0
        for n in range(residuals.shape[1]):
            valid[b, n] = are_finite(residuals[b, n])
            count += valid[b, n]
        if count < min_observations:
            valid[b] = False


@kernel
def fill_centred(residuals, valid, j, errors, means):
    """Write variable `j` less the mean of its track, (B, N), and the means (T,) of T tracks."""
    track = 0
    for b in range(len(residuals)):
        total, count = 0.0, 0
        for n in range(residuals.shape[1]):
            if valid[b, n]:
                total += residuals[b, n, j]
                count += 1
        if count == 0:
            continue
        means[track] = total / count
        for n in range(residuals.shape[1]):
            errors[b, n] = residuals[b, n, j] - means[track]
        track += 1


@kernel
def median_size(errors, valid, sizes):
    """Return the median size of the valid `errors` (B, N)."""
    count = 0
    for b in range(len(errors)):
        for n in range(errors.shape[1]):
            if valid[b, n]:
                sizes[count] = abs(errors[b, n])
                count += 1
    return lower_median(sizes[:count])


@kernel
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


@kernel
def removed_by_means(c, n):
    """Return what subtracting the mean of `n` autoregressive errors removes, see the twin."""
    with_mean = (1 - c**n) / (n * (1 - c))
    of_mean = (1 + c) / (1 - c) / n - 2 * c * with_mean / (n * (1 - c))
    inner = (n * of_mean - with_mean) / (n - 1)
    return of_mean, 2 * inner - of_mean


@kernel
def estimate(residuals, numbers, deviation, correlation, offset):
    """
    Write the noise of residuals (B, N, 9), each (9,); return how many of them count.

    `numbers` are `NoiseNumbers`. Nothing is written where no residual counts.

    """
    B, N, J = residuals.shape
    valid = np.empty((B, N), np.bool_)
    fill_valid(residuals, numbers.min_observations, valid)
    total, tracks = 0, 0
    for b in range(B):
        total += valid[b].sum()
        tracks += valid[b].any()
    if total == 0:
        return 0
    errors, sizes, means = np.empty((B, N)), np.empty(total), np.empty(tracks)
    for j in range(J):
        fill_centred(residuals, valid, j, errors, means)
        for track in range(tracks):
            means[track] = abs(means[track])
        offset[j] = numbers.mad_to_deviation * lower_median(means)
        scatter = numbers.mad_to_deviation * median_size(errors, valid, sizes)
        power, products = neighbour_sums(errors, valid, 3 * scatter)
        ratio = products / max(power, numbers.min_power)
        variance, removed = 0.0, 0.0
        for _ in range(numbers.iterations):
            whole = ratio + (1 - ratio) * removed if power > numbers.min_power else 1 - 2 / tracks
            correlation[j] = min(max(whole, 0.0), numbers.max_correlation)
            variance, removed = removed_by_means(correlation[j], total / tracks)
        deviation[j] = scatter / sqrt(max(1 - variance, numbers.min_left))
    return total
