"""
The compiled kernels against their torch twins.

Tolerances are relative to the largest entry of a result, in float64: both sides compute the same
sums in a different order.

"""

from boxreg_ros.core.arrowhead import Chain
from boxreg_ros.core.batch import SHARED, State
from boxreg_ros.core.kernels.arrays import TermArrays
from boxreg_ros.core.prior import marginalise, marginalised_terms
from boxreg_ros.core.terms import Objective, value_and_gradient
import numpy as np
import pytest
from scenes import random_problem, random_variables, terms_of
import torch

pytest.importorskip('numba')
TOLERANCE = 1e-9


def assert_close(found, known, tolerance=TOLERANCE):
    """Compare with the largest entry of `known`; non-finite values must be so in both."""
    found, known = torch.as_tensor(found), torch.as_tensor(known)
    assert found.shape == known.shape
    finite = known[known.isfinite()].abs()
    scale = float(finite.max()) if len(finite) else 1.0
    np.testing.assert_allclose(found, known, rtol=0, atol=tolerance * (scale or 1.0))


def both_sides(terms, x, free):
    """Return value, gradient, steps, and blocks of the inverse, by the kernels and by torch."""
    N = (x.shape[1] - SHARED) // 6
    objective = Objective(terms, x, N, free)
    assert isinstance(objective.terms, TermArrays)
    rows = torch.arange(len(x))
    value, gradient = objective(x.clone(), rows)  # a copy: not the result kept for the start
    steps = objective.newton(gradient, rows)
    kernel = value, gradient, steps, *objective.factor.inverse_of_links(N)
    chain = Chain.zeros(x, N)
    value, gradient = value_and_gradient(terms, x, N, chain)
    gradient = gradient * free
    factor = chain.factorised(free)
    twin = value, gradient, factor.solve(gradient), *factor.inverse_of_links(N)
    return kernel, twin


def regular_terms(problem):
    """Return every term, with weights whose sum is well conditioned."""
    return [
        term._replace(weight=term.weight + torch.eye(term.weight.shape[-1]).to(term.weight))
        for term in terms_of(problem).values()
    ]


def every_variable(x):
    return torch.ones_like(x)


def some_variables(x):
    """Return a mask that fixes roll and pitch, an extent, and one whole pose."""
    free = torch.ones_like(x)
    free[:, 3::6] = 0.0
    free[:, 6:12] = 0.0
    free[0, -SHARED] = 0.0
    free[:, -1] = 0.0
    return free


@pytest.mark.parametrize('seed', [0, 1, 2])
@pytest.mark.parametrize('mask', [every_variable, some_variables])
def test_normal_equations_equal_those_of_torch(seed, mask):
    problem = random_problem(seed=seed, N=7)
    x = random_variables(problem, seed)
    for found, known in zip(*both_sides(regular_terms(problem), x, mask(x)), strict=True):
        assert_close(found, known)


@pytest.mark.parametrize('kept', range(8))
def test_each_term_alone_equals_that_of_torch(kept):
    # The other terms have no weight: they are not evaluated and must add nothing.
    problem = random_problem()
    x = random_variables(problem)
    every = regular_terms(problem)
    terms = [
        term if i == kept else term._replace(weight=torch.zeros_like(term.weight))
        for i, term in enumerate(every)
    ]
    for chosen in (terms, [every[kept]]):
        kernel, twin = both_sides(chosen, x, every_variable(x))
        assert_close(kernel[0], twin[0])
        assert_close(kernel[1], twin[1])


@pytest.mark.parametrize('N', [2, 3, 4])
def test_short_windows_equal_those_of_torch(N):
    problem = random_problem(N=N)
    terms = [term for term in regular_terms(problem) if term.weight.shape[1] > 0]
    x = random_variables(problem)
    for found, known in zip(*both_sides(terms, x, every_variable(x)), strict=True):
        assert_close(found, known)


def test_huge_coordinates_equal_those_of_torch():
    # Gradients are differences of coordinates of 1e6 m: as many digits are lost on both sides.
    problem = random_problem()
    moved = problem._replace(boxes=problem.boxes.clone())
    moved.boxes[..., :3] += 1e6
    x = random_variables(moved)
    terms = regular_terms(moved)
    for found, known in zip(*both_sides(terms, x, every_variable(x)), strict=True):
        assert_close(found, known, 1e-6)


def test_marginalisation_prior_equals_that_of_torch():
    problem = random_problem()
    x, terms = random_variables(problem), regular_terms(problem)
    state = State.unpack(x, problem.length)
    objective = Objective(terms, x, problem.length, every_variable(x))
    pairs = zip(marginalise(objective, state), marginalised_terms(terms, state), strict=True)
    for found, known in pairs:
        assert_close(found, known)
