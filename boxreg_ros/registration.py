"""Windows in, refined boxes out: the method in one readable function."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from boxreg_ros import objective
from boxreg_ros.config import Config
from boxreg_ros.geometry import FACE_AXIS, FACE_SIGN, rotation_from_rpy
from boxreg_ros.lbfgs import minimize
from boxreg_ros.objective import Problem, State, Term
from boxreg_ros.sampling import Observation
from boxreg_ros.structures import KEPT, POSE, REFINED, Floats, RefinedTrack, Track

P = dict(
    end=0.12,
    side=0.08,
    top=0.08,
    bottom=0.05,
    robust=0.15,
    gap=0.05,
    gap_sd=0.05,
    bias=1.0,
    inflate=2.0,
    prior_robust=3.0,
    quantile=0.05,
    lateral=0.2,
    rest=0.01,
    near=1.0,
    vslip=0.5,
    margins=(0.6, 0.5, 0.4, 0.3),
    ground_gap=0.0,
    ground_gap_sd=0.05,
    minpts=5.0,
    adaptive=1,
    top_always=1,
    learn=1,
    gap0=(0.05, 0.05, 0.03, 0.03, 0.05, 0.0),
    rule_sd=(0.05, 0.05, 0.05, 0.15),
    verbose=0,
)


class Window(NamedTuple):
    class_name: str
    observations: Sequence[Observation]


class Estimate(NamedTuple):
    boxes: Floats
    status: tuple[str, ...]
    reasons: tuple[str, ...]
    covariances: Floats


def register(windows, config):
    out = [None] * len(windows)
    long_enough = [
        i for i, w in enumerate(windows) if len(w.observations) >= config.min_observations
    ]
    for i in set(range(len(windows))) - set(long_enough):
        out[i] = _kept(windows[i], 'short_track')
    rule = estimate_rule([windows[i] for i in long_enough], config) if P['learn'] else None
    order = sorted(long_enough, key=lambda i: len(windows[i].observations))
    for chunk in [order[i : i + 32] for i in range(0, len(order), 32)]:
        for i, e in zip(chunk, _register_batch([windows[i] for i in chunk], config, rule)):
            out[i] = e
    return out


def _kept(window, reason):
    n = len(window.observations)
    return Estimate(
        np.array([o.box for o in window.observations]),
        (KEPT,) * n,
        (reason,) * n,
        np.broadcast_to(np.eye(6), (n, 6, 6)),
    )


def fix_heading(yaw):
    """(N,) -> unwrapped, half turns undone by majority; returns yaw, flips"""
    chain = np.unwrap(yaw, period=np.pi)
    opposite = np.cos(yaw - chain) < 0
    if opposite.mean() > 0.5:
        chain = chain + np.pi
        opposite = ~opposite
    # keep as near as possible to input
    return chain - 2 * np.pi * np.round((chain[0] - yaw[0]) / (2 * np.pi)), opposite


def stack(windows, config):
    B, N = len(windows), max(len(w.observations) for w in windows)
    M = max(1, max(len(o.points) for w in windows for o in w.observations))
    boxes = np.zeros((B, N, 9))
    valid = np.zeros((B, N), bool)
    times = np.zeros((B, N))
    points = np.zeros((B, N, M, 3))
    mask = np.zeros((B, N, M), bool)
    origins = np.full((B, N, 3), np.nan)
    ground = np.full((B, N), np.nan)
    offset = np.zeros((B, 3))
    for b, w in enumerate(windows):
        obs = w.observations
        n = len(obs)
        bx = np.array([o.box for o in obs])
        offset[b] = bx[0, :3]
        bx[:, :3] -= offset[b]
        bx[:, 8], _ = fix_heading(bx[:, 8])
        boxes[b, :n] = bx
        boxes[b, n:] = bx[-1]
        valid[b, :n] = True
        t = np.array([(o.stamp_ns - obs[0].stamp_ns) * 1e-9 for o in obs])
        times[b, :n] = t
        times[b, n:] = t[-1] + 0.1 * np.arange(1, N - n + 1)
        for i, o in enumerate(obs):
            m = len(o.points)
            points[b, i, :m] = o.points
            mask[b, i, :m] = True
            if o.origin is not None:
                origins[b, i] = o.origin
            ground[b, i] = o.ground
    kinds = [config.class_config(w.class_name) for w in windows]
    T = torch.from_numpy
    dev = {
        k: torch.tensor([getattr(c, k) for c in kinds], dtype=torch.float64)
        for k in (
            'acceleration',
            'vertical',
            'turning',
            'tilting',
            'slip',
            'axle',
            'position',
            'lateral',
            'height',
            'heading',
            'tilt',
            'extent',
        )
    }
    return Problem(
        T(boxes), T(valid), T(times), T(points), T(mask), T(origins), T(ground), dev
    ), offset


def support(problem, state, visible, margin):
    """Outermost points per face: normalised moments (B,N,6,4,4), count (B,N,6), mean outwardness (B,N,6)."""
    R = rotation_from_rpy(state.pose[..., 3:])
    shift = state.pose[..., :3] - problem.boxes[..., :3]
    q = (problem.points - shift[..., None, :]) @ R  # box frame
    half = (state.shared[:, :3] / 2)[:, None, None]
    gap = state.shared[:, 9:15]
    sign = FACE_SIGN.to(q)
    out = q[..., FACE_AXIS] * sign  # B N M 6
    beyond = q.abs() - half  # B N M 3
    inlat = torch.stack(
        [
            (beyond[..., [1, 2]] < P['lateral']).all(-1),
            (beyond[..., [0, 2]] < P['lateral']).all(-1),
            (beyond[..., [0, 1]] < P['lateral']).all(-1),
        ],
        -1,
    )[..., FACE_AXIS]
    d = out - half[..., FACE_AXIS] + gap[:, None, None]
    cand = problem.mask[..., None] & inlat & (d < margin) & (d > -margin - 0.3)
    n_own = (problem.mask & (beyond < margin).all(-1)).sum(-1)  # B N
    K = (P['quantile'] * n_own).clamp(min=3)
    Kmax = min(q.shape[2], int(K.max().ceil()))
    val, idx = torch.where(cand, d, -torch.inf).topk(Kmax, dim=2)
    use = val.isfinite() & (torch.arange(Kmax)[:, None] < K[..., None, None])
    w = use.to(q)
    cnt = w.sum(2)
    pts = (
        problem.points[..., None, :]
        .expand(*d.shape, 3)
        .gather(2, idx[..., None].expand(*idx.shape, 3))
    )
    hom = torch.cat([pts, torch.ones_like(pts[..., :1])], -1)
    Mo = torch.einsum('bnkf,bnkfi,bnkfj->bnfij', w, hom, hom) / cnt.clamp(min=1)[..., None, None]
    mean = torch.where(use, val, 0.0).sum(2) / cnt.clamp(min=1)
    return Mo, cnt, mean, n_own


def build_terms(problem, state, visible, margin, config, rnd, expected, scale):
    dev = problem.deviations
    valid = problem.valid.to(state.pose)
    Mo, cnt, mean, n_own = support(problem, state, visible, margin)
    sig = torch.tensor([P['end'], P['end'], P['side'], P['side'], P['top'], P['bottom']])
    if P['top_always']:
        visible = visible.clone()
        visible[..., 4] = True
    w = visible * (cnt >= 3) * valid[..., None] / sig**2
    w = w * (n_own / (n_own + P['minpts']))[..., None]
    w = w / (1 + (mean / P['robust']) ** 2) ** 2
    # bottom from ground
    g = problem.ground
    has = g.isfinite() & problem.valid
    gz = torch.nan_to_num(g)
    shift = state.pose[..., :3] - problem.boxes[..., :3]
    gp = torch.cat([shift[..., :2], gz[..., None], torch.ones_like(gz[..., None])], -1)
    rg = (
        (state.pose[..., 2] - problem.boxes[..., 2] - gz)
        - state.shared[:, None, 2] / 2
        + state.shared[:, None, 14]
    )
    wb = has / P['bottom'] ** 2 / (1 + (rg / P['robust']) ** 2) ** 2
    Mo[..., 5, :, :] = gp[..., :, None] * gp[..., None, :]
    w = w.clone()
    w[..., 5] = wb
    terms = [Term(objective.faces, problem, Mo * w[..., None, None])]
    # prior
    vis = visible.to(valid)
    anchor = (
        torch.stack(
            [vis[..., 0] - vis[..., 1], vis[..., 2] - vis[..., 3], torch.zeros_like(valid)], -1
        )
        * P['near']
    )
    lin = objective.prior(problem, state, anchor)
    s = torch.stack(
        [dev['position'], dev['lateral'], dev['height'], dev['tilt'], dev['tilt'], dev['heading']],
        -1,
    )  # B 6
    s = s[:, None] * scale
    r = lin.residual[:, :, 0] / s
    wp = valid[..., None] / (s * P['inflate']) ** 2 / (1 + (r / P['prior_robust']) ** 2)
    terms.append(Term(objective.prior, problem, torch.diag_embed(wp)[:, :, None], anchor))
    # acceleration
    a = torch.stack(
        [
            dev['acceleration'],
            dev['acceleration'],
            dev['vertical'],
            dev['tilting'],
            dev['tilting'],
            dev['turning'],
        ],
        -1,
    )
    wa = valid[:, 2:, None] / a[:, None] ** 2
    terms.append(Term(objective.acceleration, problem, torch.diag_embed(wa)[:, :, None]))
    ws = torch.stack([1 / dev['slip'] ** 2, torch.full_like(dev['slip'], 1 / P['vslip'] ** 2)], -1)
    ws = valid[:, 1:, None] * ws[:, None]
    terms.append(Term(objective.slip, problem, torch.diag_embed(ws)[:, :, None]))
    # parked
    parked = is_parked(problem)
    wr = (
        parked[:, None, None]
        * valid[:, 1:, None]
        / (P['rest'] * torch.tensor([1, 1, 1, 0.3, 0.3, 0.3])) ** 2
    )
    terms.append(Term(objective.rest, problem, torch.diag_embed(wr)[:, :, None]))
    # shared
    e0 = expected[:, :3]
    b = (
        torch.stack(
            [
                dev['position'],
                dev['lateral'],
                dev['height'],
                dev['tilt'],
                dev['tilt'],
                dev['heading'] * 0.5,
            ],
            -1,
        )
        * P['bias']
    )
    sd = torch.cat(
        [
            e0 * dev['extent'][:, None],
            b,
            torch.full_like(e0, P['gap_sd']),
            torch.full_like(e0[:, :2], P['gap_sd']),
            torch.full_like(e0[:, :1], P['ground_gap_sd']),
        ],
        -1,
    )
    terms.append(
        Term(objective.shared_prior, problem, torch.diag_embed(1 / sd**2)[:, None, None], expected)
    )
    return terms


def estimate_rule(windows, config):
    """gap per face from the input itself"""
    samples = {0: [], 2: [], 4: [], 5: []}
    for i in range(0, len(windows), 32):
        chunk = windows[i : i + 32]
        problem, _ = stack(chunk, config)
        visible = objective.visible_faces(problem)
        visible[..., 4] = True
        B = len(chunk)
        for b in range(B):
            pb = problem.select(torch.tensor([b]))
            ext = pb.boxes[:, pb.valid[0], 3:6].median(1).values
            st = State(
                pb.boxes[..., POSE], torch.cat([ext, torch.zeros(1, 12, dtype=torch.float64)], 1)
            )
            _, cnt, mean, n_own = support(pb, st, visible[b : b + 1], P['margins'][0])
            ok = visible[b : b + 1] & (cnt >= 3) & (n_own >= 30)[..., None] & pb.valid[..., None]
            for f in range(5):
                k = ok[0, :, f]
                if k.sum() >= 3:
                    samples[f // 2 * 2].append(-float(mean[0, k, f].median()))
            g = pb.ground[0] + ext[0, 2] / 2
            g = g[g.isfinite()]
            if len(g) >= 3:
                samples[5].append(float(g.median()))
    rule = []
    for f, sd in zip((0, 2, 4, 5), P['rule_sd']):
        v = np.array(samples[f])
        g0 = P['gap0'][f]
        if len(v) >= 3:
            med = np.median(v)
            spread = 1.48 * np.median(abs(v - med)) + 0.02
            se2 = (1.25 * spread) ** 2 / len(v)
            g0 = (g0 / sd**2 + med / se2) / (1 / sd**2 + 1 / se2)
            if P['verbose']:
                print('rule', f, len(v), med, spread, g0)
        rule.append(g0)
    return [rule[0], rule[0], rule[1], rule[1], rule[2], rule[3]]


def is_parked(problem):
    c = problem.boxes[..., :2]
    n = problem.valid.sum(1)
    idx = torch.arange(c.shape[1])
    third = (n / 3).ceil()
    first = problem.valid & (idx < third[:, None])
    last = problem.valid & (idx >= (n - third)[:, None])
    m = lambda k: (c * k[..., None]).sum(1) / k.sum(1, keepdim=True)
    T = (problem.times * last).sum(1) / last.sum(1) - (problem.times * first).sum(1) / first.sum(1)
    d = (m(last) - m(first)).norm(dim=1)
    return (d / T.clamp(min=1e-3) < 0.3) & (d < 0.7)


def _register_batch(windows, config, rule):
    problem, offset = stack(windows, config)
    N = problem.boxes.shape[1]
    visible = objective.visible_faces(problem)
    e0 = torch.stack(
        [problem.boxes[b, problem.valid[b], 3:6].median(0).values for b in range(len(windows))]
    )
    expected = torch.zeros((len(windows), 15), dtype=torch.float64)
    expected[:, :3] = e0
    expected[:, 9:15] = torch.tensor(P['gap0'] if rule is None else rule)
    state = State(problem.boxes[..., POSE].clone(), expected.clone())
    scale = torch.ones(len(windows), 1, 6, dtype=torch.float64)
    for rnd in range(config.solver.rounds):
        terms = build_terms(
            problem,
            state,
            visible,
            P['margins'][min(rnd, len(P['margins']) - 1)],
            config,
            rnd,
            expected,
            scale,
        )
        x = state.pack()
        H = objective.curvature(terms, x, N)
        pad = (~problem.valid).repeat_interleave(6, 1)
        diag = torch.cat([pad, torch.zeros(len(windows), 15, dtype=bool)], 1).to(H) + 1e-9
        H = H + torch.diag_embed(diag)
        L = torch.linalg.cholesky(H)
        m = minimize(
            lambda x, rows: objective.value_and_gradient(
                terms if len(rows) == len(L) else [t.select(rows) for t in terms], x, N
            ),
            x,
            config.solver.iterations,
            config.solver.history,
            1e-9,
            lambda g, rows: torch.cholesky_solve(g[..., None], L[rows] if len(g) < len(L) else L)[
                ..., 0
            ],
        )
        state = State.unpack(m.x, N)
    cov = torch.cholesky_inverse(L)
    out = []
    for b, w in enumerate(windows):
        n = len(w.observations)
        bx = np.zeros((n, 9))
        bx[:, POSE] = state.pose[b, :n].numpy()
        bx[:, :3] += offset[b]
        bx[:, 3:6] = state.shared[b, :3].numpy()
        bx[:, 8] = np.arctan2(np.sin(bx[:, 8]), np.cos(bx[:, 8]))
        cv = torch.stack([cov[b, 6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(n)]).numpy()
        out.append(Estimate(bx, (REFINED,) * n, ('',) * n, cv))
    return out
