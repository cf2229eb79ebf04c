"""
Symmetric arrowhead matrices: a banded chain of links with a border, B at once.

Every link has six variables and is coupled to two links on either side and to the border. All
operations cost time in proportion to the number of links. See
docs/decisions/arrowhead-curvature.md.

"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.linalg import cholesky_ex, solve_triangular
from torch.nn.functional import pad

LINK = 6
"""Variables of a link: one pose."""
NEXT = 2 * LINK
"""Variables after a link that it is coupled to: residuals span three poses."""
SPAN = NEXT + LINK + NEXT
"""Columns of a link, the border excepted."""
BLOCK = 5
"""Most links eliminated at once: fewer take more calls, more take more multiplications. Chosen."""
RIDGE = 1e-9
"""Added to the diagonal: unobserved variables keep the matrix positive definite. Chosen."""


class Chain(NamedTuple):
    """
    B symmetric matrices of N links and a border of S variables.

    Attributes
    ----------
    links : Tensor, shape (B, N', 6, 30 + S)
        Rows of each link: columns of two links before, itself, two links after, and the border.
        N' is N, rounded up to a multiple of the block size by empty links.
    corner : Tensor, shape (B, S, S)
        Block of the border.

    """

    links: Tensor
    corner: Tensor

    @classmethod
    def zeros(cls, like: Tensor, length: int) -> 'Chain':
        """Return zeros for `length` links and vectors as `like` (B, 6 N + S)."""
        B = len(like)
        S = like.shape[1] - LINK * length
        blocks = -(-length // BLOCK)
        filled = blocks * -(-length // blocks)  # so that all blocks have one size
        return cls(like.new_zeros(B, filled, LINK, SPAN + S), like.new_zeros(B, S, S))

    def add(self, own: Tensor, across: Tensor, corner: Tensor) -> None:
        """
        Add n dense blocks of k consecutive links each, one from each of the first n links on.

        Parameters
        ----------
        own : Tensor, shape (B, n, 6 k, 6 k)
            Blocks of the links.
        across : Tensor, shape (B, n, 6 k, s)
            Blocks of the links and the first s variables of the border.
        corner : Tensor, shape (B, s, s)
            Sum of the blocks of these variables.

        """
        n, span = own.shape[1:3]
        s = across.shape[3]
        for k, first in enumerate(range(NEXT, NEXT - span, -LINK)):
            rows = self.links[:, k : k + n]
            rows[..., first : first + span] += own[:, :, LINK * k : LINK * (k + 1)]
            rows[..., SPAN : SPAN + s] += across[:, :, LINK * k : LINK * (k + 1)]
        self.corner[:, :s, :s] += corner

    def factorised(self, free: Tensor) -> 'Factor':
        """
        Return the Cholesky factors in the variables where `free` (B, 6 N + S) is 1.

        Rows and columns of the other variables become those of the identity. Factors of a matrix
        that is not positive definite are not finite.

        """
        S = self.corner.shape[1]
        links, corner = self._restricted(free)
        blocks = []
        carry = links.new_zeros(1, NEXT + S, NEXT + S)
        for block in _blocks(links, S):
            block[:, :NEXT, :NEXT] -= carry[:, :NEXT, :NEXT]
            block[:, :NEXT, -S:] -= carry[:, :NEXT, NEXT:]
            own = block.shape[1]  # columns of the block itself
            L = cholesky(block[..., :own])
            V = solve_triangular(L, block[..., own:], upper=False)
            carry = V.mT @ V
            corner = corner - carry[:, NEXT:, NEXT:]
            blocks.append((L, V))
        return Factor(blocks, cholesky(corner))

    def _restricted(self, free: Tensor) -> tuple[Tensor, Tensor]:
        """Return links and corner with identity rows and columns where `free` is 0."""
        S = self.corner.shape[1]
        N = self.links.shape[1]
        inner = pad(free[:, :-S], (0, LINK * N + S - free.shape[1]))
        border = free[:, -S:]
        near = pad(inner, (NEXT, NEXT)).unfold(1, SPAN, LINK)
        columns = torch.cat([near, border[:, None].expand(-1, N, -1)], -1)
        chain = inner.unflatten(1, (-1, LINK))
        links = (self.links * chain[..., None]).mul_(columns[:, :, None])
        links[..., NEXT : NEXT + LINK].diagonal(dim1=2, dim2=3).add_(1.0 - chain + RIDGE)
        corner = self.corner * border[..., None] * border[:, None]
        corner.diagonal(dim1=1, dim2=2).add_(1.0 - border + RIDGE)
        return links, corner


def _blocks(links: Tensor, S: int) -> tuple[Tensor, ...]:
    """Return the rows of consecutive blocks; columns: own, the next two links, the border."""
    N = links.shape[1]
    count = -(-N // BLOCK)
    size = N // count  # links of a block
    # (B, blocks, links of a block, 6, two links before, own, two links after, border)
    wide = links.new_zeros(len(links), count, size, LINK, LINK * size + 2 * NEXT + S)
    wide[..., -S:] = links[..., SPAN:].unflatten(1, (count, size))
    for j in range(size):
        wide[:, :, j, :, LINK * j : LINK * j + SPAN] = links[:, j::size, :, :SPAN]
    return wide[..., NEXT:].flatten(2, 3).unbind(1)


class InverseBlocks(NamedTuple):
    """
    Blocks of the inverse of arrowhead matrices.

    Attributes
    ----------
    links : Tensor, shape (B, N, 6, 6)
        Own block of each link.
    border : Tensor, shape (B, N, 6, S)
        Block of each link with the border.
    corner : Tensor, shape (B, S, S)
        Own block of the border.

    """

    links: Tensor
    border: Tensor
    corner: Tensor


class Factor(NamedTuple):
    """
    Cholesky factors by blocks of links.

    Attributes
    ----------
    blocks : list of pairs of Tensor, shapes (B, b, b) and (B, b, 12 + S)
        Lower factor of each block, and its rows for the next two links and the border.
    corner : Tensor, shape (B, S, S)
        Lower factor of the border.

    """

    blocks: list[tuple[Tensor, Tensor]]
    corner: Tensor

    def solve(self, b: Tensor) -> Tensor:
        """Return the solutions (B, 6 N + S) for right-hand sides `b` (B, 6 N + S)."""
        S = self.corner.shape[1]
        size = self.blocks[0][0].shape[1]
        D = b.shape[1]
        chain = pad(b[:, :-S], (0, len(self.blocks) * size - D + S))
        border = b[:, -S:, None]
        parts = list(chain.unflatten(1, (-1, size, 1)).unbind(1))
        for i, (L, V) in enumerate(self.blocks):
            parts[i] = solve_triangular(L, parts[i], upper=False)
            carry = V.mT @ parts[i]
            border = border - carry[:, NEXT:]
            if i + 1 < len(parts):
                parts[i + 1][:, :NEXT] -= carry[:, :NEXT]
        border = torch.cholesky_solve(border, self.corner)
        ahead = torch.zeros_like(border[:, :1]).expand(-1, NEXT, -1)
        for i, (L, V) in reversed(list(enumerate(self.blocks))):
            rest = parts[i] - V @ torch.cat([ahead, border], 1)
            parts[i] = solve_triangular(L.mT, rest, upper=True)
            ahead = parts[i][:, :NEXT]
        return torch.cat([torch.cat(parts, 1)[:, : D - S], border], 1)[..., 0]

    def inverse_blocks(self, length: int) -> InverseBlocks:
        """Return blocks of the inverse, of the first `length` links (M26)."""
        corner = torch.cholesky_inverse(self.corner)
        # Known of the inverse: the two links after the present block, and the border.
        ahead = pad(corner, (NEXT, 0, NEXT, 0))
        links: list[Tensor] = []
        border: list[Tensor] = []
        for L, V in reversed(self.blocks):
            root = solve_triangular(L, torch.eye(L.shape[1]).to(L).expand_as(L), upper=False)
            K = root.mT @ V
            across = -(K @ ahead)
            own = root.mT @ root - across @ K.mT
            blocks = own.unflatten(1, (-1, LINK)).unflatten(3, (-1, LINK)).diagonal(dim1=1, dim2=3)
            links.insert(0, blocks.permute(0, 3, 1, 2))
            border.insert(0, across[:, :, NEXT:].unflatten(1, (-1, LINK)))
            ahead[:, :NEXT, :NEXT] = own[:, :NEXT, :NEXT]
            ahead[:, :NEXT, NEXT:] = across[:, :NEXT, NEXT:]
            ahead[:, NEXT:, :NEXT] = across[:, :NEXT, NEXT:].mT
        return InverseBlocks(
            torch.cat(links, 1)[:, :length], torch.cat(border, 1)[:, :length], corner
        )


def product(a: Tensor, b: Tensor) -> Tensor:
    """
    Return a @ b of many small matrices (..., n, k) and (..., k, m).

    On a CPU numpy takes a fifth of the time. It has no gradients: only in inference mode.

    """
    if torch.is_inference_mode_enabled() and a.is_cpu:
        return torch.from_numpy(np.matmul(a.numpy(), b.numpy()))
    return a @ b


def cholesky(matrix: Tensor) -> Tensor:
    """Return the lower Cholesky factors of `matrix` (B, b, b); not finite where there is none."""
    L, failed = cholesky_ex(matrix)
    return torch.div(L, (failed == 0)[:, None, None])
