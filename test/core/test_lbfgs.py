"""Batched L-BFGS: known minima, comparison with torch's own, and independence of rows."""

from boxreg_ros.core.lbfgs import minimize, Status
import numpy as np
import pytest
import torch

D = torch.float64


def quadratics(B, n, seed=0):
    """Return matrices (B, n, n) with eigenvalues 1 to 100, and minima (B, n)."""
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.normal(size=(B, n, n)))[0]
    values = np.exp(rng.uniform(0, np.log(100), (B, n)))
    A = (basis * values[:, None]) @ basis.swapaxes(1, 2)
    return torch.from_numpy(A), torch.from_numpy(rng.normal(size=(B, n)))


def quadratic(A, known):
    def function(x, rows):
        off = x - known[rows]
        pull = (A[rows] @ off[..., None])[..., 0]
        return 3 + 0.5 * (off * pull).sum(1), pull

    return function


def rosenbrock(x, rows=None):
    """Return the sum of 100 (x_i+1 - x_i^2)^2 + (1 - x_i)^2, minimal 0 at all ones."""
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        value = (100 * (x[:, 1:] - x[:, :-1] ** 2) ** 2 + (1 - x[:, :-1]) ** 2).sum(1)
        (gradient,) = torch.autograd.grad(value.sum(), x)
    return value.detach(), gradient


def starts(B, n, seed=1):
    return torch.from_numpy(np.random.default_rng(seed).normal(size=(B, n)))


def test_minima_of_quadratics():
    A, known = quadratics(5, 8)
    found = minimize(quadratic(A, known), starts(5, 8), 200, 8, 1e-16)
    # The tolerance bounds the remaining decrease, x' A x / 2 with A of 1 at least.
    np.testing.assert_allclose(found.x, known, atol=1e-6)
    np.testing.assert_allclose(found.value, 3, atol=1e-12)
    assert (found.status == Status.CONVERGED).all()
    assert (found.iterations < 200).all()


def test_minima_of_rosenbrock():
    start = torch.tensor([[-1.2, 1.0], [0.0, 0.0], [2.0, -1.0]], dtype=D)
    found = minimize(rosenbrock, start, 200, 6, 1e-16)
    np.testing.assert_allclose(found.x, 1, atol=1e-5)
    assert (found.status == Status.CONVERGED).all()


@pytest.mark.parametrize('iterations', [1, 5, 300])
def test_a_batch_equals_single_rows(iterations):
    # Rows end at different times: those that have ended are not evaluated any more.
    start = torch.cat([starts(7, 4), torch.ones(1, 4, dtype=D)])
    many = minimize(rosenbrock, start, iterations, 5, 1e-12)
    alone = [minimize(rosenbrock, start[i : i + 1], iterations, 5, 1e-12) for i in range(8)]
    for name in ('x', 'value', 'status', 'iterations'):
        known = np.concatenate([getattr(minimum, name) for minimum in alone])
        np.testing.assert_allclose(getattr(many, name), known, rtol=1e-9, atol=1e-12)
    if iterations == 300:
        assert len(set(many.iterations.tolist())) > 2


def test_the_function_gets_the_numbers_of_its_rows():
    # A function that depends on the row must be asked with the row's own number, even when only
    # some rows are left: here every row has its own minimum.
    A, known = quadratics(6, 3, seed=3)
    start = known.clone()
    start[4] += 5.0  # all others are there already
    asked = []

    def function(x, rows):
        asked.append(rows.tolist())
        return quadratic(A, known)(x, rows)

    found = minimize(function, start, 100, 5, 1e-16)
    np.testing.assert_allclose(found.x, known, atol=1e-6)
    assert asked[0] == [0, 1, 2, 3, 4, 5]
    assert asked[-1] == [4]
    assert found.iterations.tolist() == [0, 0, 0, 0, found.iterations[4], 0]


@pytest.mark.parametrize('broken', ['value', 'gradient', 'later'])
def test_a_failing_row_does_not_affect_others(broken):
    A, known = quadratics(3, 4, seed=4)
    start = starts(3, 4)

    def function(x, rows):
        value, gradient = quadratic(A, known)(x, rows)
        ill = rows == 1
        if broken == 'later':
            ill &= (x - start[rows]).abs().sum(1) > 0
        if broken == 'gradient':
            return value, torch.where(ill[:, None], torch.nan, gradient)
        return torch.where(ill, torch.nan, value), gradient

    found = minimize(function, start, 100, 4, 1e-16)
    whole = minimize(quadratic(A, known), start, 100, 4, 1e-16)
    for name in ('x', 'value', 'status', 'iterations'):
        part = getattr(found, name)[[0, 2]]
        np.testing.assert_allclose(part, getattr(whole, name)[[0, 2]], rtol=1e-12)
    np.testing.assert_array_equal(found.x[1], start[1])
    assert found.status[1] == (Status.STUCK if broken == 'later' else Status.FAILED)


@pytest.mark.parametrize('function', [rosenbrock, 'rough'])
@pytest.mark.parametrize('iterations', [0, 1, 2, 3, 5, 10, 30])
def test_the_value_never_exceeds_that_of_the_start(function, iterations):
    if function == 'rough':
        # Its gradient is wrong by far: the predicted decrease is not reached.
        def function(x, rows):
            value, gradient = rosenbrock(x)
            return value, gradient * torch.tensor([1.0, -30.0, 0.1, 7.0], dtype=D)

    start = starts(20, 4)
    found = minimize(function, start, iterations, 5, 0.0)
    assert (found.value <= rosenbrock(start)[0]).all()
    np.testing.assert_allclose(found.value, rosenbrock(found.x)[0], rtol=1e-9)
    assert (found.iterations <= iterations).all()
    if iterations == 0:
        np.testing.assert_array_equal(found.x, start)


def test_the_inverse_hessian_as_metric_solves_a_quadratic_in_one_step():
    # With the inverse of its Hessian the first step is Newton's, and ends at the minimum.
    A, known = quadratics(4, 5, seed=5)
    inverse = torch.linalg.inv(A)

    def function(x, rows):
        value, gradient = quadratic(A, known)(x, rows)
        return value, gradient, (inverse[rows] @ gradient[..., None])[..., 0]

    found = minimize(function, starts(4, 5), 20, 5, 1e-14)
    np.testing.assert_allclose(found.x, known, atol=1e-9)
    assert (found.iterations <= 2).all()
    assert (found.status == Status.CONVERGED).all()


@pytest.mark.filterwarnings('error')
def test_numbers_that_are_not_finite_are_no_warnings():
    weight, start = torch.tensor([1.0, 1.0, 1.0, 50.0], dtype=D), torch.ones(4, 2, dtype=D)
    start[1] = torch.inf

    def function(x, rows):  # the first two rows are linear, the third one has a wall
        value = weight[rows] * torch.where(rows < 2, x.sum(1), 0.5 * x.square().sum(1))
        gradient = weight[rows, None] * torch.where(rows[:, None] < 2, 1.0, x)
        return torch.where((rows == 2) & (x.sum(1) < 1.5), torch.inf, value), gradient

    found = minimize(function, start, 3, 3, 1e-9)
    assert found.status.tolist() == [
        Status.RUNNING,
        Status.FAILED,
        Status.RUNNING,
        Status.CONVERGED,
    ]


def test_every_status():
    # Of x^2: at its minimum; far from it with one iteration; with a gradient that points the
    # wrong way, so that no step is ever better; not a number.
    start = torch.tensor([[0.0], [50.0], [1.0], [torch.nan]], dtype=D)

    def function(x, rows):
        value, gradient = x[:, 0] ** 2, 2 * x
        return value, torch.where((rows == 2)[:, None], -gradient, gradient)

    found = minimize(function, start, 1, 3, 1e-9)
    assert [Status(s) for s in found.status.tolist()] == [
        Status.CONVERGED, Status.RUNNING, Status.STUCK, Status.FAILED,
    ]  # fmt: skip
    assert found.iterations.tolist() == [0, 1, 1, 0]
    np.testing.assert_array_equal(found.x[[0, 2, 3]], start[[0, 2, 3]])


def test_the_start_is_not_modified():
    start = starts(3, 4)
    copy = start.clone()
    minimize(rosenbrock, start, 20, 5, 1e-9)
    np.testing.assert_array_equal(start, copy)


def test_no_rows():
    found = minimize(rosenbrock, torch.empty(0, 3, dtype=D), 5, 3, 1e-6)
    assert found.x.shape == (0, 3)
    assert found.value.shape == (0,)
