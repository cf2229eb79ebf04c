"""
The compiled kernels against their torch twins.

Tolerances are relative to the largest entry of a result, in float64: both sides compute the same
sums in a different order.

"""

from boxreg_ros.core.arrowhead import Chain
from boxreg_ros.core.batch import SHARED, State
from boxreg_ros.core.geometry import rotation_from_rpy
from boxreg_ros.core.kernels.arrays import TermArrays
from boxreg_ros.core.prior import marginalise
from boxreg_ros.core.terms import value_and_gradient
import numpy as np
import pytest
from scenes import random_problem, random_variables, terms_of
import torch

arrowhead = pytest.importorskip('boxreg_ros.core.kernels.arrowhead')
normal_equations = pytest.importorskip('boxreg_ros.core.kernels.normal_equations')

TOLERANCE = 1e-9


def assert_close(found, known, tolerance=TOLERANCE):
    """Compare with the largest entry of `known`; non-finite values must be so in both."""
    found, known = torch.as_tensor(found), torch.as_tensor(known)
    assert found.shape == known.shape
    finite = known[known.isfinite()].abs()
    scale = float(finite.max()) if len(finite) else 1.0
    np.testing.assert_allclose(found, known, rtol=0, atol=tolerance * (scale or 1.0))


def term_arrays(terms, problem, b):
    """Return the terms of window `b` as the kernels take them; without weight where missing."""
    N = problem.length
    by_name = {term.function.__name__: term for term in terms}

    def data(name, *shapes):
        if name not in by_name:
            return [np.zeros(shape) for shape in shapes]
        return [
            part[b].numpy().reshape(shape)
            for part, shape in zip(by_name[name].data, shapes, strict=True)
        ]

    def weight(name, *shape):
        """Return W of every stencil; those that are missing at the end are zero."""
        W = np.zeros(shape)
        if name in by_name:
            given = by_name[name].weight[b].numpy()
            W[: len(given)] = given.reshape(-1, *shape[1:])
        return W

    def diagonal(name, rows, size):
        return weight(name, rows, size, size).diagonal(axis1=1, axis2=2).copy()

    acceleration = weight('acceleration', N, 6, 6)
    start, wanted = data('rigid_shape', (N, 6), (N, 6))
    _, axes = data('input_pose', (N, 6), (N, 3, 3))
    (prior_mean,) = data('marginalisation_prior', (35,))
    (expected,) = data('shared_prior', (SHARED,))
    return TermArrays(
        given=problem.pose[b].numpy().copy(),
        inset=data('faces', (N, 6), (N, 6))[1],
        W_faces=weight('faces', N, 6, 4, 4),
        axes=rotation_from_rpy(torch.as_tensor(start[:, 3:])).numpy() if start.any() else axes,
        W_input=diagonal('input_pose', N, 6),
        start=start,
        wanted=wanted,
        W_shape=weight('rigid_shape', N if 'rigid_shape' in by_name else 0, 6, 6),
        times=problem.times[b].numpy().copy(),
        W_acceleration=acceleration[:, :3, :3].copy(),
        W_turning=acceleration.diagonal(axis1=1, axis2=2)[:, 3:].copy(),
        W_slip=diagonal('slip', N, 2),
        W_zero_motion=diagonal('zero_motion', N, 6),
        prior_mean=prior_mean,
        W_prior=weight('marginalisation_prior', 1, 35, 35)[0],
        expected=expected,
        W_shared=diagonal('shared_prior', 1, SHARED)[0],
    )


def both_sides(terms, problem, x, free):
    """Return value, gradient, steps and blocks of the inverse, by the kernels and by torch."""
    N = problem.length
    kernel = []
    for b in range(len(x)):
        arrays, own, mask = term_arrays(terms, problem, b), x[b].numpy(), free[b].numpy()
        gradient = np.empty(len(own))
        A = arrowhead.empty_arrowhead(N)
        scratch = normal_equations.empty_scratch(N)
        value = normal_equations.accumulate(own, N, arrays, scratch, gradient, A)
        gradient *= mask
        arrowhead.fix_variables(A, mask)
        assert arrowhead.factorise(A)
        steps = gradient.copy()
        arrowhead.solve(A, steps)
        corner = np.empty((SHARED, SHARED))
        arrowhead.invert_corner(A.corner, corner)
        links, border = np.empty((N, 6, 6)), np.empty((N, 6, SHARED))
        arrowhead.invert_poses(A, corner, links, border)
        kernel.append((value, gradient, steps, links, border, corner))
    chain = Chain.zeros(x, N)
    value, gradient = value_and_gradient(terms, x, N, chain)
    gradient = gradient * free
    factor = chain.factorised(free)
    twin = value, gradient, factor.solve(gradient), *factor.inverse_blocks(N)
    return [np.array(parts) for parts in zip(*kernel, strict=True)], twin


def regular_terms(problem):
    """
    Return every term, with weights whose sum is well conditioned.

    Weights have zeros where those of the method have, and both steps of a pose begin at one
    start: the kernels have no room for others.

    """
    terms = []
    start = 0.9 * problem.pose
    axes = rotation_from_rpy(start[..., 3:])
    block = torch.zeros(6, 6)
    block[:3, :3] = 1.0
    patterns = {'acceleration': block + torch.eye(6) * (1 - block)}
    for name in ('input_pose', 'zero_motion', 'slip', 'shared_prior'):
        patterns[name] = None
    for name, term in terms_of(problem).items():
        weight = term.weight + torch.eye(term.weight.shape[-1]).to(term.weight)
        if name in patterns:
            pattern = patterns[name]
            weight = weight * (torch.eye(weight.shape[-1]) if pattern is None else pattern)
        data = term.data
        if name == 'input_pose':
            data = problem.pose, axes
        if name == 'rigid_shape':
            data = start, data[1]
        terms.append(term._replace(weight=weight, data=data))
    return terms


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
    for found, known in zip(*both_sides(regular_terms(problem), problem, x, mask(x)), strict=True):
        assert_close(found, known)


@pytest.mark.parametrize('kept', list(terms_of(random_problem())))
def test_each_term_alone_equals_that_of_torch(kept):
    # The other terms have no weight: they are not evaluated and must add nothing.
    problem = random_problem()
    x = random_variables(problem)
    every = {term.function.__name__: term for term in regular_terms(problem)}
    terms = [
        term if name == kept else term._replace(weight=torch.zeros_like(term.weight))
        for name, term in every.items()
    ]
    for chosen in (terms, [every[kept]]):
        kernel, twin = both_sides(chosen, problem, x, every_variable(x))
        assert_close(kernel[0], twin[0])
        assert_close(kernel[1], twin[1])


@pytest.mark.parametrize('N', [2, 3, 4])
def test_short_windows_equal_those_of_torch(N):
    problem = random_problem(N=N)
    terms = [term for term in regular_terms(problem) if term.weight.shape[1] > 0]
    x = random_variables(problem)
    for found, known in zip(*both_sides(terms, problem, x, every_variable(x)), strict=True):
        assert_close(found, known)


def test_huge_coordinates_equal_those_of_torch():
    # Gradients are differences of coordinates of 1e6 m: as many digits are lost on both sides.
    problem = random_problem()
    moved = problem._replace(boxes=problem.boxes.clone())
    moved.boxes[..., :3] += 1e6
    x = random_variables(moved)
    terms = regular_terms(moved)
    for found, known in zip(*both_sides(terms, moved, x, every_variable(x)), strict=True):
        assert_close(found, known, 1e-6)


def test_marginalisation_prior_equals_that_of_torch():
    problem = random_problem()
    x, terms = random_variables(problem), regular_terms(problem)
    known = marginalise(terms, State.unpack(x, problem.length))
    for b in range(len(x)):
        mean, step, information = np.empty(35), np.empty(35), np.empty((35, 35))
        A = arrowhead.empty_arrowhead(problem.length)
        scratch = normal_equations.empty_scratch(problem.length)
        gradient, arrays = np.empty(x.shape[1]), term_arrays(terms, problem, b)
        normal_equations.accumulate(x[b].numpy(), 1, arrays, scratch, gradient, A)
        normal_equations.marginalise(x[b].numpy(), gradient, A, mean, step, information)
        for part, twin in zip((mean, step, information), known, strict=True):
            assert_close(part, twin[b])
