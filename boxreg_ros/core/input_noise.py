"""
The errors of the input poses and extents, estimated from their residuals (M16).

docs/method.md, section Input model, has the formulas.

"""

from collections.abc import Sequence

from boxreg_ros.core.input_statistics import NOISE
from boxreg_ros.core.method.constants import Constants
from boxreg_ros.core.method.noise import estimate, fill_errors, fill_residuals
from boxreg_ros.core.problem import Problem
from boxreg_ros.structures import Floats
import numpy as np
from numpy.typing import NDArray


def set_noise(
    inputs: NDArray[np.void],
    residuals: Sequence[Floats],
    past: NDArray[np.void],
    constants: Constants,
) -> None:
    """
    Set the errors of the input in records (M16), (M17).

    The settings are the prior of all kinds together, and these of each: a kind that was seen in
    few boxes errs as the others do, in proportion to its settings.

    Parameters
    ----------
    inputs : array, shape (K,)
        Records `INPUTS` of each of `KINDS`; changed in place.
    residuals : sequence of K arrays, shape (B, N, 9)
        `normalised_residuals` of the tracks of each kind; NaN is left out.
    past : array, shape (K,)
        Records `NOISE` of other drives.
    constants : Constants
        Of the method.

    """
    found = np.zeros(len(inputs), NOISE)
    for k, of_kind in enumerate(residuals):
        found[k] = noise_of(of_kind, constants)
    fill_errors(past, found, constants.record(), inputs)


def noise_of(residuals: Floats, constants: Constants) -> NDArray[np.void]:
    """Estimate the noise of tracks (B, N, 9) of one kind (M16), a record `NOISE`."""
    found = np.zeros((), NOISE)
    if len(residuals):
        found['boxes'] = estimate(
            np.ascontiguousarray(residuals), constants.record(), found['deviation'],
            found['correlation'],
        )  # fmt: skip
    return found


def normalised_residuals(problem: Problem, poses: Floats, extents: Floats) -> Floats:
    """Return the residuals (B, N, 9) of `noise.fill_residuals`, in the order of `NOISE`."""
    residuals = np.empty((*problem.counts.shape, 9))
    fill_residuals(problem, np.ascontiguousarray(poses), np.ascontiguousarray(extents), residuals)
    return residuals
