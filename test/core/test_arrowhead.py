"""Arrowhead matrices against the same as dense ones."""

from boxreg_ros.core.arrowhead import Chain, LINK
import numpy as np
import pytest
from scenes import dense
import torch

B, S = 3, 4
LENGTHS = [2, 3, 10, 11, 27]  # one block, and several that are not all full


def chain(length, seed=0):
    """Return matrices summed over all spans, with some of the border, and the same dense."""
    rng = np.random.default_rng(seed)
    D = LINK * length + S
    found = Chain.zeros(torch.zeros(B, D, dtype=torch.float64), length)
    known = np.zeros((B, D, D))
    for span, border in ((1, S), (1, 2), (2, 3), (3, 0)):
        n, d = length - span + 1, LINK * span + border
        if n < 1:
            continue
        root = rng.normal(size=(B, n, d, d))
        part = root @ root.swapaxes(-1, -2)
        whole, own = torch.from_numpy(part), LINK * span
        corner = whole[:, :, own:, own:].sum(1)
        found.add(whole[:, :, :own, :own], whole[:, :, :own, own:], corner)
        for i in range(n):
            index = np.r_[LINK * i : LINK * (i + span), D - S : D - S + border]
            known[:, index[:, None], index] += part[:, i]
    return found, known


def vectors(length):
    return torch.from_numpy(np.random.default_rng(1).normal(size=(B, LINK * length + S)))


@pytest.mark.parametrize('length', LENGTHS)
def test_blocks_are_added_up(length):
    found, known = chain(length)
    np.testing.assert_allclose(dense(found, length), known, atol=1e-12)


@pytest.mark.parametrize('length', LENGTHS)
def test_solution_and_inverse(length):
    # Rows and columns that are not free become those of the identity.
    found, known = chain(length)
    x = vectors(length)
    free = (torch.from_numpy(np.random.default_rng(2).random(x.shape)) < 0.8).to(x)
    known = known * free.numpy()[:, :, None] * free.numpy()[:, None]
    known += (1 - free.numpy())[:, :, None] * np.eye(x.shape[1])
    inverse = np.linalg.inv(known)
    factor = found.factorised(free)
    solution = np.einsum('bde,be->bd', inverse, x)
    np.testing.assert_allclose(factor.solve(x), solution, atol=1e-6 * np.abs(solution).max())
    blocks, columns, _ = factor.inverse_blocks(length)
    known_columns = inverse[:, : LINK * length, LINK * length :]
    np.testing.assert_allclose(
        columns.flatten(1, 2), known_columns, atol=1e-6 * np.abs(inverse).max()
    )
    for i in range(length):
        own = slice(LINK * i, LINK * (i + 1))
        block = inverse[:, own, own]
        np.testing.assert_allclose(blocks[:, i], block, atol=1e-6 * np.abs(inverse).max())


@pytest.mark.parametrize('spoil', [-1.0, float('nan')])
@pytest.mark.parametrize('place', [1, 25])
def test_an_indefinite_matrix_does_not_affect_others(spoil, place):
    found, _ = chain(27)
    x, ones = vectors(27), torch.ones(B, 27 * LINK + S, dtype=torch.float64)
    known = found.factorised(ones)
    found.links[1, place, 2, 12 + 2] = spoil  # on the diagonal of a link
    factor = found.factorised(ones)
    for solved, right in (
        (factor.solve(x), known.solve(x)),
        *zip(factor.inverse_blocks(27), known.inverse_blocks(27), strict=True),
    ):
        np.testing.assert_array_equal(solved[[0, 2]], right[[0, 2]])
        assert not solved[1].isfinite().all()
