"""
`boxreg bench speed`: time per window, its scaling, and the stages of a live tick and of relabel.

Every ratio is of times from one run. The reference solves the same rounds of the same terms with
`torch.optim.LBFGS`, one window at a time, by automatic differentiation.

"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import tee
import json
import os
from pathlib import Path
from shutil import disk_usage
import subprocess
import sys
import tempfile
from time import perf_counter, sleep
from types import SimpleNamespace
from typing import Any, NamedTuple

from boxreg_ros.bench.common import print_json
from boxreg_ros.config import Config
from boxreg_ros.core import observation as sampling
from boxreg_ros.core.batch import EXTENT, free_variables, Problem, Solution, State
from boxreg_ros.core.face_support import observe_faces
from boxreg_ros.core.input_model import expect, InputModel
from boxreg_ros.core.lbfgs import HISTORY, minimize, Minimum, select
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.core.observation import observe
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.core.solver import solve
from boxreg_ros.core.terms import Objective, Term
from boxreg_ros.core.weights import weigh
from boxreg_ros.core.window import stack_windows, Window
from boxreg_ros.io.transforms import boxes_to_frame, inverse, sweep_to_frame
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.simulation.recorder import write_recording
from boxreg_ros.simulation.simulate import simulate
from boxreg_ros.structures import BoxArray, Floats, POSE, ROLL, Sweep
from msg_adapters import pointcloud
import numpy as np
from numpy.typing import NDArray
import torch
from torch import Tensor

SWEEP_PERIOD = 0.1
"""Period of the sensor of a live stream [s]."""
SPEED = 4.0
"""Speed of all traffic, the sensor included [m/s]."""
REFERENCE_ITERATIONS = 100
"""Per round; more iterations change its final value by less than a percent."""
BYTES_PER_POINT = 20
"""Size of a point in a recording."""
FUSED_MS = 0.16 / 64
"""Time of one evaluation of a window of 10 x 128 by a fused kernel on two cores [ms]."""
CLI = 'boxreg_ros.cli'
NO_OPEN3D = 'Open3D is not installed: pip install open3d'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `boxreg bench speed`."""
    parser.add_argument('--json', action='store_true', help='print one JSON object')
    parser.add_argument('-o', '--out', type=Path, help='folder for the plot of the scaling')
    parser.add_argument('--device', default='cpu', help="'cpu' or 'cuda'")
    parser.add_argument('--quick', action='store_true', help='fewer and smaller cases')
    parser.add_argument(
        '--references', type=int, default=24, metavar='N',
        help='windows solved by torch.optim.LBFGS too, a second each (default: %(default)s)',
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    config = replace(Config(estimate='final'), device=args.device)
    count, tracks, points = (8, 8, 20_000) if args.quick else (64, 64, 130_000)
    report: dict[str, Any] = {
        'device': args.device,
        'load': os.getloadavg()[0],
        'tick': tick(config, tracks, points),  # first: its first tick is that of the process
        'crop': crop(config, tracks, points),
        'solver': solver(config, count, 2 if args.quick else args.references),
        'scaling': scaling(config, args.quick),
    }
    seconds = 3.0 if args.quick else 20.0
    report['relabel'] = relabel(tracks, points, seconds)
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
        report['plot'] = str(_plot(report['scaling'], config, args.out / 'speed.png'))
    if args.json:
        print_json(report)
    else:
        print(_text(report))
    return 0


def solver(config: Config, count: int, references: int) -> dict[str, float]:
    """
    Return the time per window [ms], cold, warm and by the reference, with values and IoU.

    The error of the difference of the two IoU is that of its mean over the windows.

    """
    windows, truth = make_windows(count, config.window, 128, config)
    problem, base = stack_windows(windows, config)

    def cold() -> Solution:
        return solve(problem, config, InputModel(config.faces), is_warm=False)

    state = cold().state
    pose, extent = state.pose, state.shared[:, None, EXTENT].expand(-1, config.window, -1)
    solved = torch.cat([pose[..., :3], extent, pose[..., 3:]], -1)
    # As in a stream: all but the newest box start from earlier estimates.
    warm_start = torch.cat([solved[:, :-1], problem.boxes[:, -1:]], 1)
    warm_problem = problem._replace(start=warm_start)

    def warm() -> Solution:
        return solve(warm_problem, config, InputModel(config.faces), is_warm=True)

    result = {'cold': 1e3 * _time(cold, config) / count, 'warm': 1e3 * _time(warm, config) / count}
    part = [stack_windows([window], config)[0] for window in windows[:references]]
    begin = perf_counter()
    ends = [reference(one, config) for one in part]
    result['reference'] = 1e3 * (perf_counter() - begin) / references
    ours = [solve(one, config, InputModel(config.faces), is_warm=False).state for one in part]
    iou = {}
    for name, states in (('input', None), ('reference', ends), ('ours', ours)):
        boxes = [p.boxes[0].cpu().numpy().copy() for p in part]
        for i, box in enumerate(boxes):
            if states is not None:
                box[:, POSE] = states[i].pose[0].cpu().numpy()
                box[:, 3:6] = states[i].shared[0, EXTENT].cpu().numpy()
            box[:, :3] += base[i]
        pairs = zip(boxes, truth[:references], strict=True)
        iou[name] = np.array([iou_3d(b, t).mean() for b, t in pairs])
        result[f'IoU, {name}'] = float(iou[name].mean())
    # A window has several minima; in which of them a solver ends is chance.
    result['IoU, error'] = float((iou['ours'] - iou['reference']).std() / np.sqrt(references))
    return result | fixed(problem, config, references)


def fixed(problem: Problem, config: Config, references: int) -> dict[str, float]:
    """
    Return time [ms] and value of a window for fixed correspondences, those at the input boxes.

    Both solvers start from the input. Ours takes as many iterations as all rounds of a cold
    window.

    """
    length = problem.length
    offsets = InputModel(config.faces).offsets()
    start = State(problem.pose, expect(problem, offsets).shared)
    free = free_variables(problem, config)
    terms = _terms(problem, start, config)
    x = start.pack()

    def ours() -> Minimum:
        objective = Objective(terms, x, length, free)
        settings = config.solver
        iterations = settings.rounds * settings.iterations
        return minimize(objective, x, iterations, HISTORY, 0.0, objective.newton)

    result = {'fixed, ours': 1e3 * _time(ours, config) / len(x)}
    begin = perf_counter()
    rows = [torch.tensor([i], device=x.device) for i in range(references)]
    ends = [_torch_minimum(select(terms, row), x[row], length, free[row], config) for row in rows]
    result['fixed, reference'] = 1e3 * (perf_counter() - begin) / references
    known = torch.cat([
        _total(select(terms, row), State.unpack(end, length))[None]
        for row, end in zip(rows, ends, strict=True)
    ])  # fmt: skip
    found = ours().value[:references]
    result['value, reference'], result['value, ours'] = float(known.mean()), float(found.mean())
    return result | {'excess, worst': float((found / known - 1).max())}


def scaling(config: Config, quick: bool) -> dict[str, list[tuple[int, float]]]:
    """Return the time per window [ms] over number of windows, their length, and points per box."""
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
            problem, _ = stack_windows(windows, config)

            def once(problem: Problem = problem) -> object:
                return solve(problem, config, InputModel(config.faces), is_warm=False)

            table[name].append((x, 1e3 * _time(once, config) / count))
    return table


class Instant(NamedTuple):
    """One revolution among traffic that moves as the sensor does, in the sensor's frame."""

    stamp_ns: int
    T_fixed_sensor: Floats
    points: NDArray[np.float32]
    boxes: BoxArray


def traffic(tracks: int, points: int, count: int) -> Iterator[Instant]:
    """Yield `count` sweeps of `points` returns on `tracks` cars and the road, with noisy boxes."""
    rng = np.random.default_rng(0)
    side = int(np.ceil(np.sqrt(tracks)))
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)[:tracks]
    true = np.zeros((tracks, 9))
    true[:, :2] = (grid - side / 2) * 9.0 + 3.0
    true[:, 2:6] = 0.0, 4.5, 1.9, 1.6
    surface = _surface(300, true[0], rng)
    road = rng.uniform(-60, 60, (points - tracks * len(surface), 3)) * [1, 1, 0.0] - [0, 0, 0.8]
    cloud = np.concatenate([*(surface + box[:3] for box in true), road]).astype(np.float32)
    names = tuple(str(i) for i in range(tracks)), ('car',) * tracks, np.ones(tracks)
    for i in range(count):
        stamp, T = i * round(SWEEP_PERIOD * 1e9), np.eye(4)
        T[0, 3] = SPEED * SWEEP_PERIOD * i
        noise = rng.standard_normal(cloud.shape, dtype=np.float32) * np.float32(0.01)
        boxes = true + rng.normal(0, 1, true.shape) * [0.1, 0.1, 0.05, *[0.1] * 3, 0, 0, 0.03]
        yield Instant(stamp, T, cloud + noise, BoxArray(stamp, 'lidar', *names, boxes))


def tick(config: Config, tracks: int, points: int) -> dict[str, float]:
    """
    Return the time of the stages of one live tick [ms], the median of forty full windows.

    ``first`` is the first tick that solves a window, ``first full`` the first with full windows.

    """
    registrar, times = BoxRegistrar(config), []
    for stamp, T, cloud, boxes in traffic(tracks, points, config.window + 42):
        message = _message(cloud)
        marks = [perf_counter()]
        sweep = replace(pointcloud.from_msg(message), stamp_ns=stamp)
        marks.append(perf_counter())
        sweep, array = sweep_to_frame(sweep, T, 'odom'), boxes_to_frame(boxes, T, 'odom')
        marks.append(perf_counter())
        registrar.add_sweep(sweep)
        ready = registrar.add_boxes(array)
        marks.append(perf_counter())
        [boxes_to_frame(r.boxes, inverse(T), 'lidar') for r in ready]
        marks.append(perf_counter())
        observe(sweep, array.boxes, stamp, config)  # once more by itself, to know its share
        marks.append(perf_counter())
        decode, transform, both, encode, alone = np.diff(marks) * 1e3
        times.append((decode, transform, alone, both - alone, encode))
    middle = np.median(np.array(times)[config.window + 2 :], axis=0)
    stages = ('decode', 'transform', 'crop and sample', 'solve', 'encode')
    result = {k: float(v) for k, v in zip(stages, middle, strict=True)}
    first, full = config.min_observations - 1, config.window - 1
    return {
        **result,
        'total': float(middle.sum()),
        'first': float(sum(times[first])),
        'first full': float(sum(times[full])),
    }


def crop(config: Config, tracks: int, points: int) -> dict[str, Any]:
    """
    Return the time to crop all boxes of a sweep [ms]: ours, and box by box.

    The crop only, for all of them; the rest of `observe` is in a stage of the tick.

    """
    ((_, _, cloud, boxes),) = traffic(tracks, points, 1)
    margin = config.sampling.margin
    rotations = matrix_from_rpy(boxes.boxes[:, ROLL:])

    def one_by_one() -> None:
        for box, R in zip(boxes.boxes, rotations, strict=True):
            local = np.abs((cloud - box[:3].astype(np.float32)) @ R.astype(np.float32))
            cloud[(local < box[3:6] / 2 + margin).all(1)]

    def ours() -> None:
        index, owner, _, outside = sampling.crop(cloud, boxes.boxes, margin)
        is_in = outside.max(0) < margin
        cloud.take(index[is_in], 0), owner[is_in]

    result: dict[str, Any] = {
        'ours': 1e3 * _time(ours, config),
        'numpy, box by box': 1e3 * _time(one_by_one, config),
    }
    try:
        import open3d
    except (ImportError, OSError) as error:
        return {**result, 'Open3D, box by box': None, 'reason': f'{NO_OPEN3D} ({error})'}
    whole = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.astype(np.float64)))
    turned = [
        open3d.geometry.OrientedBoundingBox(box[:3], R, box[3:6] + 2 * margin)
        for box, R in zip(boxes.boxes, rotations, strict=True)
    ]
    result['Open3D, box by box'] = 1e3 * _time(lambda: [whole.crop(box) for box in turned], config)
    return result


def relabel(tracks: int, points: int, seconds: float) -> dict[str, float]:
    """
    Return time and memory of `boxreg relabel` on a recording of `seconds` at 10 Hz.

    It runs in processes of its own. ``total`` is the elapsed time [s]; the times of the stages add
    up to more, since reading and solving overlap. ``faster`` is the length of the recording over
    ``total``, ``compressed`` the same for a recording packed by zstd, ``rest`` the part of the
    total in which nothing is solved. ``memory`` is the peak of all processes [MB], ``short`` and
    ``long`` are those for recordings of this length and of ten times that, with sweeps of ``few``
    points: a fifth of all if the disk has no room for more. ``faster, long`` and ``rest, long``
    are those of the latter.

    """
    result: dict[str, float] = {}
    with tempfile.TemporaryDirectory(prefix='boxreg-') as name:
        path, out = Path(name) / 'drive.mcap', Path(name) / 'out'
        has_room = (
            disk_usage(name).free > 2 * BYTES_PER_POINT * points * 10 * seconds / SWEEP_PERIOD
        )
        few = points if has_room else points // 5
        result['few'] = few
        # The first case is a warm-up, too: first accesses to memory of a virtual machine, and to
        # files, are not to be measured.
        for case, size, length in (
            ('short', few, seconds),
            ('long', few, 10 * seconds),
            ('compressed', points, seconds),
            ('memory', points, seconds),
        ):
            a, b, c, d = tee(traffic(tracks, size, round(length / SWEEP_PERIOD)), 4)
            write_recording(
                path,
                (Sweep(i.stamp_ns, 'lidar', i.points) for i in a),
                (np.zeros(len(i.points)) for i in b),
                (i.boxes for i in c),
                (i.T_fixed_sensor for i in d),
                'odom',
                is_compressed=case == 'compressed',
            )
            with path.open('rb') as file:
                os.fsync(file.fileno())  # else the disk still writes while it is read
            result[case] = _peak([sys.executable, '-m', CLI, 'relabel', str(path), '-o', str(out)])
            spent = json.loads((out / 'summary.json').read_text(encoding='utf-8'))['seconds']
            faster, rest = length / spent['total'], 1 - spent['solve'] / spent['total']
            if case == 'memory':
                result |= {**spent, 'faster': faster, 'rest': rest}
            elif case == 'compressed':
                result[case] = faster
            elif case == 'long':
                result |= {'faster, long': faster, 'rest, long': rest}
    return result


def _peak(command: list[str]) -> float:
    """
    Run a command and return the peak memory of its processes [MB].

    The sum over processes of the peak of each; shared memory, such as libraries, counts for each.

    """
    peaks: dict[str, int] = {}
    with tempfile.TemporaryFile('w+') as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
        while process.poll() is None:
            with suppress(OSError, IndexError):  # a process may have ended
                children = Path(f'/proc/{process.pid}/task/{process.pid}/children').read_text()
                for pid in (str(process.pid), *children.split()):
                    status = Path(f'/proc/{pid}/status').read_text()
                    peaks[pid] = int(status.partition('VmHWM:')[2].split()[0])
            sleep(0.02)
        if process.returncode:
            output.seek(0)
            raise RuntimeError(f'{" ".join(command)} failed: {output.read()}')
    return sum(peaks.values()) / 1024


def reference(problem: Problem, config: Config) -> State:
    """Solve as `solver.solve` does, by `torch.optim.LBFGS` and automatic derivatives."""
    length = problem.length
    offsets = InputModel(config.faces).offsets()
    free = free_variables(problem, config)
    state = State(problem.pose.clone(), expect(problem, offsets).shared)
    for _ in range(config.solver.rounds):
        terms = _terms(problem, state, config)
        x = _torch_minimum(terms, state.pack(), length, free, config)
        state = State.unpack(x, length)
    return state


def _torch_minimum(
    terms: list[Term], start: Tensor, length: int, free: Tensor, config: Config
) -> Tensor:
    x = start.clone().requires_grad_()
    search = torch.optim.LBFGS(
        [x],
        max_iter=REFERENCE_ITERATIONS,
        history_size=HISTORY,
        line_search_fn='strong_wolfe',
    )

    def closure() -> Tensor:
        search.zero_grad()
        value = _total(terms, State.unpack(x, length))
        value.backward()
        x.grad = x.grad * free if x.grad is not None else None
        return value

    search.step(closure)
    return x.detach()


def _terms(problem: Problem, state: State, config: Config) -> list[Term]:
    offsets = InputModel(config.faces).offsets()
    observations = observe_faces(problem, state, offsets, config)
    return weigh(problem, state, observations, expect(problem, offsets), config)


def _total(terms: Sequence[Term], state: State) -> Tensor:
    residuals = [(term.linearise(state).residual, term.weight) for term in terms]
    parts = [(r * (W @ r[..., None])[..., 0]).sum() / 2 for r, W in residuals]
    return torch.stack(parts).sum()


def make_windows(
    count: int, length: int, points: int, config: Config
) -> tuple[list[Window], list[Floats]]:
    """Return windows of the paper's experiment, of different seeds, and their true boxes."""
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
    torch.set_num_threads(1)
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


def _plot(table: dict[str, list[tuple[int, float]]], config: Config, path: Path) -> Path:
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, 3, figsize=(12, 3.6), sharey=True, layout='constrained')
    for panel, (name, rows) in zip(panels, table.items(), strict=True):
        x, y = np.array(rows).T
        panel.loglog(x, y, 'o-', label='measured')
        # A fused kernel reads every point at every evaluation, ours once per round.
        work = {'length': x / config.window, 'points': x / 128}.get(name, np.ones_like(x))
        evaluations = config.solver.rounds * (config.solver.iterations + 1)
        panel.loglog(x, FUSED_MS * evaluations * work, 'k--', label=f'fused, {evaluations} times')
        panel.set_xlabel(
            {'length': 'boxes per window', 'points': 'points per box'}.get(name, name)
        )
        panel.set_xticks(x, [f'{value:g}' for value in x])
        panel.set_xticks([], minor=True)
        panel.grid(which='both', alpha=0.3)
    panels[0].legend()
    panels[0].set_ylabel('ms per window')
    figure.savefig(path, dpi=120)
    return path


def _text(report: dict[str, Any]) -> str:
    s, t, c, r = (report[name] for name in ('solver', 'tick', 'crop', 'relabel'))
    lines = [
        f'on {report["device"]}, load of the machine {report["load"]:.1f} when it began',
        'one window of 10 boxes x 128 points, 3d',
        f'  torch.optim.LBFGS, one by one   {s["reference"]:9.2f} ms   IoU '
        f'{s["IoU, reference"]:.3f}',
        f'  batched, cold                   {s["cold"]:9.2f} ms   IoU {s["IoU, ours"]:.3f} '
        f'({s["IoU, ours"] - s["IoU, reference"]:+.3f} +- {s["IoU, error"]:.3f}; '
        f'input {s["IoU, input"]:.3f})',
        f'  batched, warm                   {s["warm"]:9.2f} ms',
        f'  cold is {s["reference"] / s["cold"]:.0f} times faster than one by one, '
        f'warm {s["cold"] / s["warm"]:.1f} times cheaper than cold',
        f'  one fixed function: {s["fixed, reference"]:.0f} ms to {s["value, reference"]:.2f} one '
        f'by one, {s["fixed, ours"]:.2f} ms to {s["value, ours"]:.2f} batched '
        f'({s["fixed, reference"] / s["fixed, ours"]:.0f} times), worst {s["excess, worst"]:+.2%}',
    ]
    for name, rows in report['scaling'].items():
        cells = '   '.join(f'{x}: {y:.2f}' for x, y in rows)
        lines.append(f'ms per window over {name:8s} {cells}')
    rates = '   '.join(f'{x}: {1e3 / y:,.0f}' for x, y in report['scaling']['windows'])
    lines.append(f'windows per second        {rates}')
    stages = ('decode', 'transform', 'crop and sample', 'solve', 'encode')
    shares = ', '.join(f'{k} {t[k]:.1f} ({t[k] / t["total"]:.0%})' for k in stages)
    lines.append(f'one tick: {t["total"]:.1f} ms of {1e3 * SWEEP_PERIOD:.0f}: {shares}')
    lines.append(
        f'the first tick of the process that solves: {t["first"]:.0f} ms, '
        f'that of the first full window: {t["first full"]:.0f} ms'
    )
    open3d = c['Open3D, box by box']
    lines.append(
        f'crop of all boxes: {c["ours"]:.1f} ms; box by box with numpy '
        f'{c["numpy, box by box"]:.0f} ms ({c["numpy, box by box"] / c["ours"]:.0f} times), '
        + (
            f'with Open3D {open3d:.0f} ms ({open3d / c["ours"]:.0f} times)'
            if open3d
            else c['reason']
        )
    )
    busy = ('read', 'decode', 'transform', 'registrar', 'solve', 'write')
    lines.append(
        f'relabel: {r["faster"]:.1f} times faster than the recording lasts ({r["total"]:.1f} s; '
        f'{r["compressed"]:.1f} times where it is compressed; busy, partly at once: '
        + ', '.join(f'{k} {r[k]:.1f}' for k in busy)
        + f'), all but the solve {r["rest"]:.0%}'
    )
    lines.append(
        f'ten times as long, sweeps of {r["few"]:,} points: {r["faster, long"]:.1f} times faster '
        f'than it lasts, all but the solve {r["rest, long"]:.0%}'
    )
    lines.append(
        f'peak of all its processes: {r["memory"]:.0f} MB; sweeps of {r["few"]:,} points '
        f'{r["short"]:.0f} MB, ten times as long {r["long"]:.0f} MB'
    )
    return '\n'.join(lines)
