"""
The marginalisation prior: the oldest observation of a full sliding window is eliminated.

Live windows are of bounded length. The observation that leaves is not dropped but marginalised by
the Schur complement, as in fixed-lag smoothing: docs/method.md (M13).

"""

from collections.abc import Sequence

from boxreg_ros.core.arrowhead import cholesky, LINK
from boxreg_ros.core.batch import MarginalPrior, PRIOR_SIZE, SHARED, State
from boxreg_ros.core.terms import shared_prior, Term
from boxreg_ros.core.track_window import PRIOR_POSES
import torch
from torch.linalg import solve_triangular
from torch.nn.functional import pad

STENCIL = 1 + PRIOR_POSES
"""Poses that residuals of the oldest observation depend on."""
POSE_RIDGE = 1e-9
"""Added to the information of the eliminated pose, so that it is invertible. Chosen: below the
information of a deviation of 1000 m or rad."""
PRIOR_RIDGE = 1e-6
"""Added to the information of the prior where its minimum is computed: directions without any
information stay at the linearisation point. Chosen: the information of a deviation of 1000."""


def marginalise(terms: Sequence[Term], state: State) -> MarginalPrior:
    """
    Return the quadratic form that remains when the oldest observation is eliminated (M13).

    A form in the next two poses and the shared variables. It replaces all terms of the oldest
    observation, the previous marginalisation prior included, but not the prior on the shared
    variables, which the next window has again: nothing is counted twice.

    """
    head = State(state.pose[:, :STENCIL], state.shared)
    jacobians = []
    weighted = []
    for term in terms:
        if term.function is shared_prior:
            continue
        data = tuple(part[:, :STENCIL] for part in term.data)
        r, J, S = Term(term.function, term.weight[:, :1], data).linearise(head)
        J = pad(J, (0, STENCIL * LINK - J.shape[-1]))
        S = pad(S, (0, SHARED - S.shape[-1])).expand(*J.shape[:-1], -1)
        # With the residual as a last column, one product gives information and gradient.
        A = torch.cat([J, S, r[..., None]], -1)[:, 0]  # (B, F, R, 18 + 23 + 1)
        jacobians.append(A.flatten(1, 2))
        weighted.append((term.weight[:, 0] @ A).flatten(1, 2))
    form = torch.cat(jacobians, 1).mT @ torch.cat(weighted, 1)
    # Schur complement of the oldest pose.
    root = cholesky(form[:, :LINK, :LINK] + POSE_RIDGE * torch.eye(LINK).to(form))
    across = solve_triangular(root, form[:, :LINK, LINK:], upper=False)
    form = form[:, LINK:, LINK:] - across.mT @ across
    information = form[:, :-1, :-1]
    gradient = form[:, :-1, -1]
    ridge = PRIOR_RIDGE * torch.eye(PRIOR_SIZE).to(form)
    step = torch.linalg.solve(information + ridge, -gradient)
    return MarginalPrior(head.pack()[:, LINK:], step, information)
