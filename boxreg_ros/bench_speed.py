"""
`boxreg bench speed`: what a window costs, how that grows, and what a live tick spends where.

Every ratio is of figures from one run. The reference solves the same rounds of the same terms
with `torch.optim.LBFGS`, one window at a time, by automatic differentiation.

"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
import json
from pathlib import Path
from time import perf_counter
from types import SimpleNamespace
from typing import Any

from boxreg_ros import objective
from boxreg_ros.calibration import InputModel
from boxreg_ros.config import Config
from boxreg_ros.correspondence import support
from boxreg_ros.metrics import iou_3d
from boxreg_ros.objective import EXTENT, State, Term
from boxreg_ros.registrar import BoxRegistrar
from boxreg_ros.registration import expected_shared, free_variables, MARGINS, solve, weigh
from boxreg_ros.sampling import observe
from boxreg_ros.simulate import simulate
from boxreg_ros.structures import BoxArray, Floats, POSE, Sweep
from boxreg_ros.transforms import boxes_to_frame, sweep_to_frame
from boxreg_ros.window import stack, Window
from msg_adapters import pointcloud
import numpy as np
from numpy.typing import NDArray
import torch
from torch import Tensor

PERIOD = 0.1  # of the sensor of a live stream [s]
REFERENCE_ITERATIONS = 100  # per round; more changes its final value by less than a percent


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `boxreg bench speed`."""
    parser.add_argument('--json', action='store_true', help='print one JSON object')
    parser.add_argument('-o', '--out', type=Path, help='folder for the plot of the scaling')
    parser.add_argument('--device', default='cpu', help="'cpu' or 'cuda'")
    parser.add_argument('--quick', action='store_true', help='fewer and smaller cases')


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    config = replace(Config(estimate='final'), device=args.device)
    count = 8 if args.quick else 64
    report: dict[str, Any] = {
        'device': args.device,
        'solver': solver(config, count, 2 if args.quick else 6),
        'scaling': scaling(config, args.quick),
        'tick': tick(config, 8 if args.quick else 64, 20_000 if args.quick else 130_000),
    }
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
        report['plot'] = str(_plot(report['scaling'], args.out / 'speed.png'))
    print(json.dumps(report) if args.json else _text(report))
    return 0


def solver(config: Config, count: int, references: int) -> dict[str, float]:
    """Return the cost of a window [ms], cold, warm and by the reference, with values and IoU."""
    windows, truth = make_windows(count, config.window, 128, config)
    problem, base = stack(windows, config)
    rounds, result = config.solver.rounds, {}

    def cold() -> tuple[State, Tensor]:
        return solve(problem, config, InputModel(config.faces), rounds)

    state, _ = cold()
    pose, extent = state.pose, state.shared[:, None, EXTENT].expand(-1, config.window, -1)
    solved = torch.cat([pose[..., :3], extent, pose[..., 3:]], -1)
    # As in a stream: all but the newest box start from what was found before.
    warm_start = torch.cat([solved[:, :-1], problem.boxes[:, -1:]], 1)
    warm_problem = replace(problem, start=warm_start)
    result['cold'] = 1e3 * _time(cold, config) / count
    result['warm'] = (
        1e3
        * _time(lambda: solve(warm_problem, config, InputModel(config.faces), 1), config)
        / count
    )
    part = [stack([window], config)[0] for window in windows[:references]]
    begin = perf_counter()
    found = [reference(one, config) for one in part]
    result['reference'] = 1e3 * (perf_counter() - begin) / references
    ours = [solve(one, config, InputModel(config.faces), rounds)[0] for one in part]
    result['value, reference'] = float(
        np.mean([_value(p, s, config) for p, s in zip(part, found, strict=True)])
    )
    result['value, ours'] = float(
        np.mean([_value(p, s, config) for p, s in zip(part, ours, strict=True)])
    )
    for name, states in (('input', None), ('reference', found), ('ours', ours)):
        boxes = [p.boxes[0].cpu().numpy().copy() for p in part]
        for i, box in enumerate(boxes):
            if states is not None:
                box[:, POSE] = states[i].pose[0].cpu().numpy()
                box[:, 3:6] = states[i].shared[0, EXTENT].cpu().numpy()
            box[:, :3] += base[i]
        result[f'IoU, {name}'] = float(
            np.mean([iou_3d(b, t).mean() for b, t in zip(boxes, truth[:references], strict=True)])
        )
    return result


def scaling(config: Config, quick: bool) -> dict[str, list[tuple[int, float]]]:
    """Return the cost of a window [ms] over windows, their length, and points per box."""
    counts, lengths, points = [1, 8, 64, 512], [5, 10, 20, 40, 80], [128, 512, 2048, 4096]
    if config.device != 'cpu':
        counts = [64, 1024, 16384]
    if quick:
        counts, lengths, points = [1, 8], [5, 10], [128, 512]
    cases = {
        'windows': [(n, n, config.window, 128) for n in counts],
        'length': [(n, 16, n, 128) for n in lengths],
        'points': [(n, 16, config.window, n) for n in points],
    }
    table: dict[str, list[tuple[int, float]]] = {}
    for name, rows in cases.items():
        table[name] = []
        for x, count, length, most in rows:
            windows, _ = make_windows(min(count, 64), length, most, config)
            windows = (windows * -(-count // len(windows)))[:count]
            problem, _ = stack(windows, config)

            def once(problem: objective.Problem = problem) -> object:
                return solve(problem, config, InputModel(config.faces), config.solver.rounds)

            table[name].append((x, 1e3 * _time(once, config) / count))
    return table


def tick(config: Config, tracks: int, points: int) -> dict[str, float]:
    """Return where one tick of a live stream goes [ms], the median of several full windows."""
    rng = np.random.default_rng(0)
    side = int(np.ceil(np.sqrt(tracks)))
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)[:tracks]
    true = np.zeros((tracks, 9))
    true[:, :2] = (grid - side / 2) * 9.0 + 3.0
    true[:, 2:6] = 0.0, 4.5, 1.9, 1.6
    surface = _surface(300, true[0], rng)
    far = rng.uniform(-60, 60, (points - tracks * len(surface), 3)) * [1, 1, 0.0] - [0, 0, 0.8]
    identity, registrar, times = np.eye(4), BoxRegistrar(config), []
    ids = tuple(str(i) for i in range(tracks))
    for i in range(config.window + 12):
        true[:, 0] += 0.4
        cloud = np.concatenate([*(surface + box[:3] for box in true), far]).astype(np.float32)
        message = _message(cloud + rng.normal(0, 0.01, cloud.shape).astype(np.float32))
        boxes = true + rng.normal(0, 1, true.shape) * [0.1, 0.1, 0.05, *[0.1] * 3, 0, 0, 0.03]
        stamp = i * round(PERIOD * 1e9)
        array = BoxArray(stamp, 'lidar', ids, ('car',) * tracks, np.ones(tracks), boxes)
        marks = [perf_counter()]
        sweep = replace(pointcloud.from_msg(message), stamp_ns=stamp)
        marks.append(perf_counter())
        sweep = sweep_to_frame(sweep, identity, 'odom')
        array = boxes_to_frame(array, identity, 'odom')
        marks.append(perf_counter())
        observe(sweep, array.boxes, stamp, config)  # alone once more, to know its share
        marks.append(perf_counter())
        registrar.add_sweep(sweep)
        ready = registrar.add_boxes(array)
        marks.append(perf_counter())
        [boxes_to_frame(r.boxes, identity, 'lidar') for r in ready]
        marks.append(perf_counter())
        decode, transform, crop, both, encode = np.diff(marks) * 1e3
        times.append((decode, transform, crop, both - crop, encode))
    middle = np.median(np.array(times)[config.window + 2 :], axis=0)
    stages = ('decode', 'transform', 'crop and sample', 'solve', 'encode')
    result = dict(zip(stages, middle, strict=True))
    return {**{k: float(v) for k, v in result.items()}, 'total': float(middle.sum())}


def reference(problem: objective.Problem, config: Config) -> State:
    """Solve as `registration.solve` does, by `torch.optim.LBFGS` and automatic derivatives."""
    length, rule = problem.boxes.shape[1], InputModel(config.faces).rule()
    expected = expected_shared(problem, rule)
    state, free = State(problem.pose.clone(), expected.clone()), free_variables(problem, config)
    for turn in range(config.solver.rounds):
        margin = MARGINS[min(turn, 1)]
        sights = support(problem, state, margin, config.faces.outermost, rule.depths)
        terms = weigh(problem, state, sights, expected, None, config)
        x = state.pack().clone().requires_grad_()
        search = torch.optim.LBFGS(
            [x],
            max_iter=REFERENCE_ITERATIONS,
            history_size=config.solver.history,
            line_search_fn='strong_wolfe',
        )

        def closure(x: Tensor = x, terms: list[Term] = terms, search: Any = search) -> Tensor:
            search.zero_grad()
            value = _total(terms, State.unpack(x, length))
            value.backward()
            x.grad = x.grad * free if x.grad is not None else None
            return value

        search.step(closure)
        state = State.unpack(x.detach(), length)
    return state


def _total(terms: Sequence[Term], state: State) -> Tensor:
    residuals = [(term.linearise(state).residual, term.weight) for term in terms]
    parts = [(r * (W @ r[..., None])[..., 0]).sum() / 2 for r, W in residuals]
    return torch.stack(parts).sum()


def _value(problem: objective.Problem, state: State, config: Config) -> float:
    """Return the objective at a state, with the correspondences and weights it has there."""
    rule = InputModel(config.faces).rule()
    expected = expected_shared(problem, rule)
    sights = support(problem, state, MARGINS[1], config.faces.outermost, rule.depths)
    return float(_total(weigh(problem, state, sights, expected, None, config), state))


def make_windows(
    count: int, length: int, points: int, config: Config
) -> tuple[list[Window], list[Floats]]:
    """Return windows of the paper's experiment, from different seeds, and their true boxes."""
    config = config.updated({'sampling.points': points})
    windows: list[Window] = []
    truth: list[Floats] = []
    for seed in range(count):
        scene = simulate('paper', seed % 8)
        (track,) = scene.tracks()
        first = (seed // 8 * length) % (101 - length)
        rows = range(first, first + length)
        observations = []
        for i in rows:
            assert track.sensor_origins is not None
            repeat = track.points[i][np.arange(max(points, 1)) % len(track.points[i])]
            sweep = Sweep(int(track.stamps_ns[i]), '', repeat, None, track.sensor_origins[i])
            observations += observe(sweep, track.boxes[i : i + 1], sweep.stamp_ns, config)
        windows.append(Window(str(seed), 'car', observations, length, np.zeros((0, 9))))
        truth.append(scene.truth.boxes[first : first + length])
    return windows, truth


def _surface(count: int, box: Floats, rng: np.random.Generator) -> Floats:
    """Return points on the faces of a box at the origin that a sensor behind and left sees."""
    points = rng.uniform(-0.5, 0.5, (count, 3)) * box[3:6]
    face = np.arange(count) % 3
    points[np.arange(count), face] = np.array([-0.5, 0.5, 0.5])[face] * box[3:6][face]
    return points


def _message(points: NDArray[np.floating]) -> SimpleNamespace:
    """Return a PointCloud2 as decoded, with an intensity beside x y z."""
    data = np.zeros((len(points), 4), dtype='<f4')
    data[:, :3] = points
    names = ('x', 'y', 'z', 'intensity')
    fields = [
        SimpleNamespace(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate(names)
    ]
    stamp = SimpleNamespace(sec=0, nanosec=0)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id='lidar'), height=1, width=len(points),
        fields=fields, is_bigendian=False, point_step=16, row_step=16 * len(points),
        data=data.view(np.uint8).reshape(-1), is_dense=True,
    )  # fmt: skip


def _time(function: Callable[[], object], config: Config, repeats: int = 3) -> float:
    """Return the shortest of several times, after one for warming up [s]."""
    before = torch.get_num_threads()
    torch.set_num_threads(config.solver.threads)
    function()
    best = np.inf
    for _ in range(repeats):
        begin = perf_counter()
        function()
        if config.device != 'cpu':
            torch.cuda.synchronize()
        best = min(best, perf_counter() - begin)
    torch.set_num_threads(before)
    return float(best)


def _plot(table: dict[str, list[tuple[int, float]]], path: Path) -> Path:
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, 3, figsize=(12, 3.6), sharey=True, layout='constrained')
    for panel, (name, rows) in zip(panels, table.items(), strict=True):
        x, y = np.array(rows).T
        panel.loglog(x, y, 'o-')
        panel.set_xlabel(
            {'length': 'boxes per window', 'points': 'points per box'}.get(name, name)
        )
        panel.grid(which='both', alpha=0.3)
    panels[0].set_ylabel('ms per window')
    figure.savefig(path, dpi=120)
    return path


def _text(report: dict[str, Any]) -> str:
    s, t = report['solver'], report['tick']
    lines = [
        f'one window of 10 boxes x 128 points, 3d, on {report["device"]}',
        f'  torch.optim.LBFGS, one by one   {s["reference"]:9.2f} ms   value '
        f'{s["value, reference"]:8.2f}   IoU {s["IoU, reference"]:.3f}',
        f'  batched, cold                   {s["cold"]:9.2f} ms   value '
        f'{s["value, ours"]:8.2f}   IoU {s["IoU, ours"]:.3f} (input {s["IoU, input"]:.3f})',
        f'  batched, warm                   {s["warm"]:9.2f} ms',
        f'  cold is {s["reference"] / s["cold"]:.0f} times faster than one by one, '
        f'warm {s["cold"] / s["warm"]:.1f} times cheaper than cold',
    ]
    for name, rows in report['scaling'].items():
        cells = '   '.join(f'{x}: {y:.2f}' for x, y in rows)
        lines.append(f'ms per window over {name:8s} {cells}')
    shares = ', '.join(f'{k} {v:.1f} ({v / t["total"]:.0%})' for k, v in t.items() if k != 'total')
    lines.append(f'one tick: {t["total"]:.1f} ms of {1e3 * PERIOD:.0f}: {shares}')
    return '\n'.join(lines)
