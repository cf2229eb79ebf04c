"""
Symmetric matrices of a chain of links that share a border, B at once; knows no boxes.

Every link has six variables and is coupled to two links on either side and to the border: what
is not zero looks like an arrow. All that is done here costs in proportion to the links.

"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.linalg import cholesky_ex, solve_triangular
from torch.nn.functional import pad

LINK = 6
NEXT = 2 * LINK  # variables ahead of a link that it is coupled to
SPAN = NEXT + LINK + NEXT
BLOCK = 5  # most links eliminated at once: fewer cost calls, more cost multiplications


class Chain(NamedTuple):
    """
    B matrices of N links and a border of S variables.

    Attributes
    ----------
    links : Tensor, shape (B, N', 6, 30 + S)
        Rows of each link: columns of two links before, itself, two links after, and the border.
        After the N links come empty ones that fill the last block.
    corner : Tensor, shape (B, S, S)
        The border with itself.

    """

    links: Tensor
    corner: Tensor

    @classmethod
    def zeros(cls, like: Tensor, length: int) -> 'Chain':
        """Return zeros for `length` links and vectors as `like` (B, 6 N + S)."""
        B, S, count = len(like), like.shape[1] - LINK * length, -(-length // BLOCK)
        filled = count * -(-length // count)  # so that all blocks are of one size
        return cls(like.new_zeros(B, filled, LINK, SPAN + S), like.new_zeros(B, S, S))

    def add(self, own: Tensor, across: Tensor, corner: Tensor) -> None:
        """
        Add n stretches of k links each, that begin one link after another.

        `own` (B, n, 6 k, 6 k) of the links, `across` (B, n, 6 k, s) of these and the first s
        variables of the border, `corner` (B, s, s) of these alone.

        """
        n, span, s = *own.shape[1:3], across.shape[3]
        for k, first in enumerate(range(NEXT, NEXT - span, -LINK)):
            rows = self.links[:, k : k + n]
            rows[..., first : first + span] += own[:, :, LINK * k : LINK * (k + 1)]
            rows[..., SPAN : SPAN + s] += across[:, :, LINK * k : LINK * (k + 1)]
        self.corner[:, :s, :s] += corner

    def factorised(self, free: Tensor) -> 'Factor':
        """
        Return the factors of the matrices in the variables where `free` (B, 6 N + S) is 1.

        Where 0 the rows and columns are those of the identity. Factors of a matrix that is not
        positive definite are not finite.

        """
        S, N = self.corner.shape[1], self.links.shape[1]
        inner, border = pad(free[:, :-S], (0, LINK * N + S - free.shape[1])), free[:, -S:]
        near = pad(inner, (NEXT, NEXT)).unfold(1, SPAN, LINK)
        around = torch.cat([near, border[:, None].expand(-1, N, -1)], -1)
        chain = inner.unflatten(1, (-1, LINK))
        links = (self.links * chain[..., None]).mul_(around[:, :, None])
        links[..., NEXT : NEXT + LINK].diagonal(dim1=2, dim2=3).add_(1.0 - chain + 1e-9)
        corner = self.corner * border[..., None] * border[:, None]
        corner.diagonal(dim1=1, dim2=2).add_(1.0 - border + 1e-9)
        size = N // (count := -(-N // BLOCK))  # links of a block
        wide = links.new_zeros(len(links), count, size, LINK, LINK * size + 2 * NEXT + S)
        wide[..., -S:] = links[..., SPAN:].unflatten(1, (count, size))
        for j in range(size):
            wide[:, :, j, :, LINK * j : LINK * j + SPAN] = links[:, j::size, :, :SPAN]
        blocks, carry = [], links.new_zeros(1, NEXT + S, NEXT + S)
        # Columns: own, the next two links, the border.
        for block in wide[..., NEXT:].flatten(2, 3).unbind(1):
            block[:, :NEXT, :NEXT] -= carry[:, :NEXT, :NEXT]
            block[:, :NEXT, -S:] -= carry[:, :NEXT, NEXT:]
            L = cholesky(block[..., : LINK * size])
            V = solve_triangular(L, block[..., LINK * size :], upper=False)
            carry = V.mT @ V
            corner = corner - carry[:, NEXT:, NEXT:]
            blocks.append((L, V))
        return Factor(blocks, cholesky(corner))


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
        """Return the solutions (B, 6 N + S) for right sides `b`."""
        S, size, D = self.corner.shape[1], self.blocks[0][0].shape[1], b.shape[1]
        chain, border = pad(b[:, :-S], (0, len(self.blocks) * size - D + S)), b[:, -S:, None]
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

    def inverse_of_links(self, length: int) -> Tensor:
        """Return the blocks of the first `length` links in the inverse, (B, N, 6, 6)."""
        # What has been found of the inverse: the two links after the present ones, the border.
        ahead = pad(torch.cholesky_inverse(self.corner), (NEXT, 0, NEXT, 0))
        found: list[Tensor] = []
        for L, V in reversed(self.blocks):
            root = solve_triangular(L, torch.eye(L.shape[1]).to(L).expand_as(L), upper=False)
            across = -((K := root.mT @ V) @ ahead)
            own = root.mT @ root - across @ K.mT
            blocks = own.unflatten(1, (-1, LINK)).unflatten(3, (-1, LINK)).diagonal(dim1=1, dim2=3)
            found.insert(0, blocks.permute(0, 3, 1, 2))
            ahead[:, :NEXT, :NEXT] = own[:, :NEXT, :NEXT]
            ahead[:, :NEXT, NEXT:] = across[:, :NEXT, NEXT:]
            ahead[:, NEXT:, :NEXT] = across[:, :NEXT, NEXT:].mT
        return torch.cat(found, 1)[:, :length]


def product(a: Tensor, b: Tensor) -> Tensor:
    """
    Return a @ b, of many small matrices (..., n, k) and (..., k, m).

    On a CPU numpy takes a fifth of the time; it knows no gradient, so in inference mode alone.

    """
    is_numpys = torch.is_inference_mode_enabled() and a.is_cpu
    return torch.from_numpy(np.matmul(a.numpy(), b.numpy())) if is_numpys else a @ b


def cholesky(matrix: Tensor) -> Tensor:
    """Return the lower factors of `matrix` (B, b, b); not finite where there is none."""
    L, failed = cholesky_ex(matrix)
    return torch.div(L, (failed == 0)[:, None, None])
