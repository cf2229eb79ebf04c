"""The residual of docs/tasks/add-a-residual.md: its Jacobian, and its kernel against torch."""

from importlib import import_module
from types import SimpleNamespace

from boxreg_ros.core.batch import State
from boxreg_ros.core.terms import Term, value_and_gradient
import numpy as np
from paths import ROOT
import pytest
from scenes import boxes_at, problem_of, random_problem, random_variables, shared_of
import torch

arrowhead = pytest.importorskip('boxreg_ros.core.kernels.arrowhead')

PAGE = ROOT / 'docs' / 'tasks' / 'add-a-residual.md'
EXAMPLES = ROOT / 'docs' / 'examples'


@pytest.fixture
def example(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    return import_module('residual_example')


def test_page_shows_the_example():
    source = (EXAMPLES / 'residual_example.py').read_text(encoding='utf-8')
    assert f'```python\n{source}```\n' in PAGE.read_text(encoding='utf-8')


def test_rise_by_hand(example):
    # 0.1 m up in 0.2 s.
    problem = problem_of(boxes_at([0, 0, 0, 0, 0, 0], [1, 2, 0.1, 0, 0, 0]), times=[[0.0, 0.2]])
    found = example.rise(State(problem.pose, shared_of()), problem.times).residual
    np.testing.assert_allclose(found, [[[[0.5]]]], atol=1e-12)


def upper_triangle(A, N):
    """Return the blocks of the poses in a matrix as one upper triangle, (6 N, 6 N)."""
    upper = np.zeros((6 * N, 6 * N + 12))
    for n in range(N):
        upper[6 * n : 6 * n + 6, 6 * n : 6 * n + 18] = A.links[n]
    return upper[:, : 6 * N]


def test_gradient_and_curvature_of_kernel_and_torch(example):
    problem = random_problem()
    x = random_variables(problem)
    B, N = problem.valid.shape
    weight = 1 + torch.rand(B, N - 1, generator=torch.Generator().manual_seed(3)).to(x)
    term = Term(example.rise, weight[..., None, None, None], (problem.times,))

    def residual(x):
        return term.linearise(State.unpack(x, N)).residual[..., 0, 0]

    values, gradients = value_and_gradient([term], x, N)
    jacobians = torch.autograd.functional.jacobian(residual, x)  # (B, N - 1, B, 6 N + 22)
    for b in range(B):
        J = jacobians[b, :, b]
        weighted = weight[b, :, None] * J
        np.testing.assert_allclose(gradients[b], residual(x)[b] @ weighted, atol=1e-9)
        data = SimpleNamespace(W_rise=weight[b].numpy(), times=problem.times[b].numpy())
        poses = x[b, : 6 * N].numpy().reshape(N, 6)
        gradient = np.zeros(x.shape[1])
        A = arrowhead.empty_arrowhead(N)
        arrowhead.clear(A)
        value = sum(example.add_rise(n, poses, data, gradient, A) for n in range(N - 1))
        np.testing.assert_allclose(value, values[b], rtol=1e-12)
        np.testing.assert_allclose(gradient, gradients[b], atol=1e-9)
        known = np.triu(J.mT @ weighted)[: 6 * N, : 6 * N]
        np.testing.assert_allclose(upper_triangle(A, N), known, atol=1e-9)
