"""dev"""
from dataclasses import dataclass, field
import numpy as np
from boxreg_ros.config import Config
from boxreg_ros.rotations import matrix_from_rpy, wrap_angle
from boxreg_ros.core.following import motion, surface, registration as reg
from boxreg_ros.core.following.surface import CELL

NOISE = {  # acceleration, angular acceleration, slip, turning
    'vehicle': (1.0, 0.1, 0.004, 1e-4),
    'cyclist': (1.0, 0.4, 0.01, 1e-3),
    'pedestrian': (0.6, 0.4, 0.02, 5e-3),
}
CLEAR = {'vehicle': 0.25, 'cyclist': 0.2, 'pedestrian': 0.2}
Z_NOISE = 0.1  # m/sqrt(s)
MAX_SPEED = {'vehicle': 40.0, 'cyclist': 12.0, 'pedestrian': 3.0}
P = dict(min_points=5, share=0.5, sig_lon=0.35, sig_yaw=0.12, rms=0.07, seen=0.3, jump=16.0, road=0.05, hold=1.5, refind_cov=0.25)


class Obj:
    def __init__(self, sweeps, stamps, seeds, kind):
        """sweeps: list of x-sorted (n,3); stamps [s]; seeds: list of (frame, box)."""
        self.sweeps, self.t, self.kind = sweeps, stamps, kind
        self.noise = np.array(NOISE[kind])
        box = seeds[0][1]
        self.half = np.mean([b[3:6] for _, b in seeds], 0) / 2
        self.tilt = matrix_from_rpy(np.array([box[6], box[7], 0.0]))
        self.pivot = 0.25 * 2 * self.half[0] if kind == 'vehicle' else 0.0
        self.clear = CLEAR[kind]
        dims = (2 * np.ceil((self.half + 0.6) / CELL) + 2).astype(int)
        self.map = (np.zeros(dims, np.int32), np.zeros((20000, 10)), np.zeros((20000, 3)), np.zeros(1, np.int64))
        self.seeds = seeds
        heights = [reg.road_below(self.near(f, self.pose_of(b), 0.4), self.pose_of(b), self.tilt, self.half) for f, b in seeds]
        heights = [h for h in heights if np.isfinite(h)]
        self.road = np.clip(np.mean(heights), -0.15, 0.15) if heights else 0.0
        for f, b in seeds:
            self.add(f, self.pose_of(b))

    @staticmethod
    def pose_of(b):
        return np.array([b[0], b[1], b[2], b[8]])

    def near(self, f, pose, extra=0.0):
        r = np.hypot(self.half[0], self.half[1]) + 0.7 + extra
        return reg.near(self.sweeps[f], pose[:3], np.array([r, r, self.half[2] + 0.6]))

    def add(self, f, pose, pts=None):
        pts = self.near(f, pose) if pts is None else pts
        q = reg.in_box(pts, pose, self.tilt, self.half, self.clear, 0.1)
        surface.insert(q, self.half, *self.map)
        return len(q)

    def register(self, pts, start, prior, info, its=12):
        return reg.register(pts, start, prior, info, self.tilt, self.half, self.clear, self.map, its)

    def start_speed(self, f, box):
        """Search along the heading in the sweeps around."""
        pose = self.pose_of(box)
        c, s = np.cos(pose[3]), np.sin(pose[3])
        vmax = MAX_SPEED[self.kind]
        step = 3.0
        around = [g for g in (f - 1, f + 1) if 0 <= g < len(self.t)]
        if not around:
            return 0.0, 1.0
        dt = max(abs(self.t[g] - self.t[f]) for g in around)
        step = min(step, 0.35 / dt)
        n = int(vmax / step)
        speeds = np.arange(-n // 3, n + 1) * step
        info = np.diag([1 / 0.5**2, 1 / 0.5**2, 1 / 0.1**2, 1 / 0.05**2])
        scores = []
        for v in speeds:
            total = 0.0
            for g in around:
                d = v * (self.t[g] - self.t[f])
                start = pose + [d * c, d * s, 0, 0]
                pts = self.near(g, start)
                if len(pts) < 3:
                    continue
                p, H, st = self.register(pts, start, start, info, 6)
                total += self.score(st)
            scores.append(total / len(around) - self.speed_cost(v))
        order = np.argsort(scores)[::-1][:8]
        best, chosen = -np.inf, 0.0
        for k in order:
            total, weight = 0.0, 1e-9
            v_out = []
            for sign in (1, -1):
                state, cov = self.initial(pose, speeds[k])
                z = pose[2]
                for m in range(1, 6):
                    g = f + sign * m
                    if not 0 <= g < len(self.t):
                        break
                    state, cov = motion.predict(state, cov, self.t[g] - self.t[g - sign], self.noise, self.pivot)
                    prior, info4 = self.prior(state, cov, z, 0.02)
                    pts = self.near(g, prior)
                    p, H, st = self.register(pts, prior, prior, info4, 8)
                    d = p - prior
                    total += (self.score(st) - 0.02 * min(d @ info4 @ d, 10.0)) / m
                    weight += 1 / m
                    state, cov = motion.update(state, cov, p[[0, 1, 3]], np.linalg.inv(H + info4)[np.ix_([0, 1, 3], [0, 1, 3])])
                v_out.append(state[3])
            total = total / weight - self.speed_cost(speeds[k])
            if total > best:
                best, chosen = total, np.mean(v_out)
        return chosen, best

    def speed_cost(self, v):
        return 0.03 * (abs(v) > 0.7) + 0.1 * (v < -0.7) + 0.002 * abs(v)

    def score(self, st):
        inside, fitting, rms, cover, beside, matched = st
        share = fitting / max(inside + beside, 1)
        return 2 * share * cover / max(share + cover, 1e-9) if inside >= 3 else 0.0

    def initial(self, pose, speed, sigma=1.0):
        state = np.array([pose[0], pose[1], pose[3], speed, 0.0])
        return state, np.diag([0.03**2, 0.03**2, 0.02**2, sigma**2, 0.1**2])

    def prior(self, state, cov, z, zvar):
        pose = np.array([state[0], state[1], z, state[2]])
        C = np.zeros((4, 4))
        C[np.ix_([0, 1, 3], [0, 1, 3])] = cov[:3, :3]
        C[2, 2] = zvar
        return pose, np.linalg.inv(C)

    def run(self, f, box, sign, speed, log):
        pose = self.pose_of(box)
        state, cov = self.initial(pose, speed)
        z, zvar = pose[2], 0.03**2
        out = {f: (pose, 'seed')}
        pending = []
        g = f
        last_good = self.t[f]
        reason = 'end'
        while True:
            g += sign
            if not 0 <= g < len(self.t):
                break
            dt = self.t[g] - self.t[g - sign]
            state, cov = motion.predict(state, cov, dt, self.noise, self.pivot)
            zvar += Z_NOISE**2 * abs(dt)
            lost_for = abs(self.t[g] - last_good)
            if lost_for > P['hold']:
                reason = 'lost'
                break
            prior, info = self.prior(state, cov, z, zvar)
            pts = self.near(g, prior, 0.5)
            h = reg.road_below(pts, prior, self.tilt, self.half)
            if np.isfinite(h):
                w = 1 / P['road'] ** 2
                prior[2] += (h - self.road) * w / (info[2, 2] + w)
                info[2, 2] += w
            best = self.register(pts, prior, prior, info)
            if pending:  # search along the heading
                sig = np.sqrt(cov[0, 0] + cov[1, 1])
                for d in np.arange(-2, 3) * 0.4:
                    if d and abs(d) < 2.5 * sig:
                        st_ = prior + [d * np.cos(prior[3]), d * np.sin(prior[3]), 0, 0]
                        r = self.register(pts, st_, prior, info)
                        if self.score(r[2]) > self.score(best[2]) + 0.02:
                            best = r
            p, H, st = best
            post = np.linalg.inv(H + info)
            c, s = np.cos(p[3]), np.sin(p[3])
            sl = np.sqrt(post[0, 0] * c * c + 2 * post[0, 1] * c * s + post[1, 1] * s * s)
            sy = np.sqrt(post[3, 3])
            d = p - prior
            jump = d @ info @ d
            share = st[1] / max(st[5], 1)
            seen = st[5] / max(st[0], 1)
            ok = st[1] >= P['min_points'] and seen > P['seen'] and share >= P['share'] and sl < P['sig_lon'] and sy < P['sig_yaw'] and jump < P['jump'] and st[2] < P['rms']
            if pending and ok:
                ok = st[3] > P['refind_cov'] * 0.2 and share > 0.6
            log.append((g, st[0], share, st[2], st[3], st[4], sl, sy, jump, len(pending), *p))
            if not ok:
                pending.append(g)
                out[g] = (prior, 'coast')
                continue
            state, cov = motion.update(state, cov, p[[0, 1, 3]], post[np.ix_([0, 1, 3], [0, 1, 3])])
            z, zvar = p[2], post[2, 2]
            out[g] = (p, 'ok')
            if share > 0.7:
                self.add(g, p, pts)
            pending = []
            last_good = self.t[g]
        return out, reason

    def box(self, pose, like):
        b = like.copy()
        b[[0, 1, 2, 8]] = pose
        b[3:6] = 2 * self.half
        return b
