"""The marginalisation prior: exact for linear terms, first order for the others."""

from boxreg_ros.core.arrowhead import Chain
from boxreg_ros.core.batch import PRIOR_SIZE, SHARED, State
from boxreg_ros.core.geometry import rotation_from_rpy
from boxreg_ros.core.prior import marginalise
from boxreg_ros.core.terms import (
    acceleration,
    input_pose,
    marginalisation_prior,
    shared_prior,
    Term,
    value_and_gradient,
    zero_motion,
)
import numpy as np
import pytest
from scenes import (
    boxes_at,
    dense,
    problem_of,
    random_problem,
    random_variables,
    random_weights,
    shared_of,
    terms_of,
)
import torch

D = torch.float64


def tensor(values):
    return torch.tensor(values, dtype=D)


def linear_terms(problem, seed=1):
    """Return terms that are linear, of the usual size: 0.1 m and rad, 1 m/s^2."""
    rng = np.random.default_rng(seed)
    B, N = problem.valid.shape
    axes = rotation_from_rpy(problem.pose[..., 3:])
    expected = torch.from_numpy(rng.normal(size=(B, SHARED)))
    mean = State(problem.pose[:, :2] + 0.1, expected + 0.1).pack()

    def weight(n, size):
        return random_weights(rng, B, n, 1, size) + torch.eye(size, dtype=D)

    return [
        Term(input_pose, 100 * weight(N, 6), (problem.pose, axes)),
        Term(acceleration, weight(N - 2, 6), (problem.times,)),
        Term(zero_motion, 100 * weight(N - 1, 6)),
        Term(shared_prior, 100 * weight(1, SHARED), (expected,)),
        Term(marginalisation_prior, 100 * weight(1, PRIOR_SIZE), (mean[:, None],)),
    ]


def without_oldest(terms, state):
    """Return the terms of the window after its oldest observation has been marginalised."""
    where, step, information = marginalise(terms, state)
    kept = [
        term
        if term.function is shared_prior
        else Term(term.function, term.weight[:, 1:], tuple(part[:, 1:] for part in term.data))
        for term in terms
        if term.function is not marginalisation_prior
    ]
    left = Term(marginalisation_prior, information[:, None, None], ((where + step)[:, None],))
    return [*kept, left]


def least(terms, N):
    """Return where the sum of linear terms is least, (B, D)."""
    x = torch.zeros(len(terms[0].weight), 6 * N + SHARED, dtype=D)
    form = Chain.zeros(x, N)
    _, gradient = value_and_gradient(terms, x, N, form)
    return torch.linalg.solve(dense(form, N), -gradient)


@pytest.mark.parametrize('N', [4, 7])
@pytest.mark.parametrize('is_first', [True, False], ids=['without prior', 'with prior'])
def test_prior_is_exact_for_linear_terms(N, is_first):
    # For linear terms marginalisation loses nothing: after one observation has left, and then
    # another, the minimum of the window is that of all observations, for any linearisation point.
    # The ridge for unobserved directions, 1e-6 of curvatures of 100, changes 1e-8 of the step.
    problem = random_problem(N=N)
    terms = linear_terms(problem)[: 4 if is_first else 5]
    known = least(terms, N)
    rng = np.random.default_rng(9)
    for n in (N - 1, N - 2):
        whole = State.unpack(known[:, -6 * (n + 1) - SHARED :], n + 1)
        away = State(
            *(part + 0.1 * torch.from_numpy(rng.normal(size=part.shape)) for part in whole)
        )
        terms = without_oldest(terms, away)
        np.testing.assert_allclose(least(terms, n), known[:, -6 * n - SHARED :], atol=1e-8)


def test_prior_is_the_schur_complement_of_the_oldest_terms():
    # To first order of the residuals: the dense Schur complement of all terms that the oldest
    # observation has a part in, but for the prior on shared variables, which stays.
    problem, N = random_problem(), 6
    terms, x = terms_of(problem), random_variables(problem)
    state = State.unpack(x, N)
    where, step, information = marginalise(list(terms.values()), state)
    np.testing.assert_array_equal(where, State(state.pose[:, 1:3], state.shared).pack())
    form, gradient = Chain.zeros(x, N), torch.zeros_like(x)
    for name, term in terms.items():
        if name != 'shared_prior':
            weight = torch.zeros_like(term.weight)
            weight[:, 0] = term.weight[:, 0]
            gradient += value_and_gradient([term._replace(weight=weight)], x, N, form)[1]
    H = dense(form, N)
    first, others = slice(0, 6), [*range(6, 18), *range(6 * N, 6 * N + SHARED)]
    across = torch.linalg.solve(H[:, first, first], H[:, first])
    known = (H - H[:, :, first] @ across)[:, others][:, :, others]
    scale = float(known.abs().max())
    np.testing.assert_allclose(information, known, atol=1e-8 * scale)
    pull = gradient - (across.mT @ gradient[:, first, None])[..., 0]
    found = -(information @ step[..., None])[..., 0]
    np.testing.assert_allclose(found, pull[:, others], atol=1e-4 * float(pull.abs().max()))


def test_a_failed_window_does_not_affect_the_priors_of_others():
    problem = random_problem()
    terms, state = list(terms_of(problem).values()), State.unpack(random_variables(problem), 6)
    known = marginalise(terms, state)
    state.pose[1, 0] = torch.nan
    for found, right in zip(marginalise(terms, state), known, strict=True):
        np.testing.assert_allclose(found[[0, 2]], right[[0, 2]], rtol=1e-9)
    assert not marginalise(terms, state)[1][1].isfinite().all()


def test_prior_residual_by_hand():
    # Two poses, 0.1 m and 0.2 rad off the mean of the prior, and shared variables 0.3 off; the
    # prior does not depend on the third pose.
    problem = problem_of(boxes_at([0.1], [1, 0, 0, 0, 0, 0.2], [9, 9, 9]))
    mean = torch.zeros(1, 1, PRIOR_SIZE, dtype=D)
    mean[..., 6], mean[..., 12:15] = 1.0, tensor([4.0, 2.0, 1.7])
    found = marginalisation_prior(State(problem.pose, shared_of()), mean).residual
    known = np.zeros((1, 1, 1, PRIOR_SIZE))
    known[..., 0], known[..., 11], known[..., 14] = 0.1, 0.2, 0.3
    np.testing.assert_allclose(found, known, atol=1e-15)
