"""The first registration of a process, ahead of time: imports, and kernels loaded or compiled."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, suppress
from copy import deepcopy
from dataclasses import replace
from multiprocessing import get_context
from multiprocessing.connection import Connection
import os
from typing import TYPE_CHECKING

from boxreg_ros.config import Config, KINDS, PaperConfig, SolverConfig
from boxreg_ros.core.input_model import InputModel, Inputs
from boxreg_ros.core.method.arrays import INPUTS
from boxreg_ros.core.method.constants import Constants
from boxreg_ros.core.method.residuals import TERMS
from boxreg_ros.core.method.round import empty_sums, Sums
from boxreg_ros.core.observation import Observation, Observations, observe
from boxreg_ros.core.point_labels import ObjectTrack, PointLabeller
from boxreg_ros.core.problem import stack_windows
from boxreg_ros.core.registrar import BoxRegistrar, Submit
from boxreg_ros.core.window import Window
from boxreg_ros.structures import BoxArray, Ints, Sweep
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from boxreg_ros.core.solver import Batch  # torch


def warm_up(config: Config, submit: Submit | None = None) -> None:
    """
    Register a synthetic stream, so that the first real one does not wait.

    Libraries are imported and kernels loaded, or compiled at the very first start, for the
    objective, estimate and mode of the stream to come. Six stamps of a window of four cover cold,
    warm and full windows, or two rounds of a whole track; a few iterations of the solver are
    enough. The points of the last sweep have times. The stream is long enough for sweeps to be
    compared with boxes of each latency.

    """
    registrar = BoxRegistrar(_quick(config), submit)
    sweeps, arrays = _passing_car()
    sweeps[-1] = replace(sweeps[-1], times=np.full(len(sweeps[-1].points), 0.1))
    for sweep, boxes in zip(sweeps, arrays, strict=True):
        registrar.add_sweep(sweep)
        registrar.add_boxes(boxes)
    registrar.flush()


def warm_up_solver(config: Config) -> None:
    """Observe faces without points, and search a minimum: half of what a node needs."""
    from boxreg_ros.core import solver  # torch

    _, arrays = _passing_car()
    boxes = np.concatenate([array.boxes for array in arrays])
    stamps_ns = np.array([array.stamp_ns for array in arrays])
    table = Observations.without_points(stamps_ns, boxes, -boxes[:, None, :3])
    ingredients = replace(config.ingredients, heading_sign=False)  # the second process has it
    quick, model = replace(_quick(config), ingredients=ingredients), InputModel(config.faces)
    rows = [Observation(table, row) for row in range(quick.window)]
    window = Window('1', 'car', rows, quick.window, np.zeros((0, 9)))
    problem, _ = stack_windows([window], quick, model.constants.prior_decay)
    # Deviations of 0 and correlations of 1 would end the search before it begins.
    inputs, plan = np.full(len(KINDS), 0.5, INPUTS), solver.SolverPlan.choose(quick, is_warm=False)
    # Without the variables of a rigid shape there must be none of its residuals.
    constants = model.constants.with_settings(quick).in_round(
        plan.uses_rigid_shape, is_smooth=True
    )
    batch = solver.start(problem, quick, plan, inputs)
    batch.solution.poses[0, -1, 0] += 0.1  # off its input, so that there is something to search
    first = np.zeros(1, int)
    faces = constants.in_round(uses_shape=False, is_smooth=True)
    sums = solver.observe(batch, inputs, first, faces)
    sums.terms['root'] = sums.terms['wanted'] = 0.0
    solver.search(solver.Objective(batch, sums, inputs, constants.record(), first))


class SecondProcess:
    """
    A process that compiles, once it is asked, what a node needs but `warm_up_solver`.

    It is forked before ROS has threads and sockets, and has all that is imported by then: to
    import that again takes two seconds. It ends with `end`; where nothing is asked, also with this
    process.

    """

    def __init__(self) -> None:
        from boxreg_ros.core import solver  # noqa: F401  torch, which both then have

        context = get_context('fork')
        self._connection, other = context.Pipe()
        arguments = (other, self._connection)
        self._process = context.Process(target=_compile_if_asked, args=arguments, daemon=True)
        self._process.start()
        other.close()  # otherwise the end of the process does not close the connection

    @classmethod
    def forked(cls) -> SecondProcess | None:
        """Return a new one; None without memory or room for one."""
        with suppress(OSError):
            return cls()
        return None

    def ask(self, config: Config, has_labels: bool) -> None:
        """Let it compile what a node with these settings needs."""
        with suppress(OSError):  # it has ended: this process compiles all
            self._connection.send((config.objective, config.mode, has_labels))

    def wait(self) -> None:
        """Wait until all is on disk that the first box needs; what follows objects comes later."""
        with suppress(EOFError, OSError):  # it has ended
            self._connection.recv()

    def end(self, is_finished: bool) -> None:
        """End it, after all that it was asked for `is_finished`, or at once."""
        if not is_finished:
            self._process.kill()  # kernels are written as a whole
        self._connection.close()
        self._process.join()


def _compile_if_asked(connection: Connection, of_parent: Connection) -> None:
    """Wait for settings, and compile what they need; end where the other process has ended."""
    of_parent.close()  # otherwise its end does not close the connection
    with (
        open(os.devnull, 'w') as nowhere,
        redirect_stderr(nowhere),  # the other process has the same warnings
        suppress(EOFError, OSError),
    ):
        objective, mode, has_labels = connection.recv()
        warm_up_others(objective, mode, has_labels, lambda: connection.send(None))


@contextmanager
def compiled_beside(
    second: SecondProcess | None, config: Config, has_labels: bool
) -> Iterator[Callable[[], None]]:
    """
    Let a second process, where there is one, compile its part, if the block compiles.

    A function is yielded that waits until that is on disk. At the end of the block the process has
    ended, and what follows objects is there. Where nothing can be written, this process has to
    compile all of it as well.

    """
    from numba.core import event  # it takes half a second

    asked: list[SecondProcess] = []

    class Ask(event.Listener):
        """Asks the process; kernels that are loaded from files cause no event."""

        def on_start(self, event: object) -> None:
            if second and not asked:
                asked.append(second)
                second.ask(config, has_labels)

        def on_end(self, event: object) -> None:
            """Do nothing."""

    def wait() -> None:
        for process in asked:
            process.wait()

    is_finished = False
    try:
        with event.install_listener('numba:compile', Ask()):
            yield wait
        is_finished = True
    finally:
        if second:
            second.end(is_finished)


def warm_up_others(
    objective: str, mode: str, has_labels: bool, announce: Callable[[], None]
) -> None:
    """Do what `warm_up_solver` leaves out; announce that, then follow."""
    from boxreg_ros.core import solver

    solver.observe = lambda *arguments: _observe_nothing(*arguments)
    solver.fit = lambda *arguments: _fit_without_search(*arguments)
    config = Config.from_dict({'objective': objective, 'mode': mode, 'estimate': 'final'})
    warm_up(config)
    if has_labels:
        warm_up_labels(config)
    announce()
    warm_up_followed(config)


def _observe_nothing(batch: Batch, _: Inputs, rows: Ints, __: Constants) -> Sums:
    """Return faces that are seen where they are expected."""
    sums = empty_sums(rows, batch.problem.length, batch.free.shape[1])
    sums.terms[:] = np.zeros((), TERMS)
    sums.terms['visibility'] = 1.0
    sums.terms['num_points'] = 64.0
    return sums


def _fit_without_search(
    batch: Batch, sums: Sums, inputs: Inputs, constants: Constants, *_: bool
) -> NDArray[np.bool_]:
    """End a round where it begins: all but the kernels of the search are loaded or compiled."""
    from boxreg_ros.core import solver

    # The sums have not been written, so that nothing may be read of what follows from them.
    aside = batch._replace(solution=deepcopy(batch.solution))
    rows = np.arange(len(sums.windows))
    x = np.zeros((len(rows), batch.free.shape[1]))
    objective = solver.Objective(aside, sums, inputs, constants.record(), rows)
    return solver.end(objective, x, is_last=True, may_settle=True)


def warm_up_follower(config: Config) -> None:
    """Follow a synthetic box through sweeps, there and back: its kernels are loaded."""
    from boxreg_ros.core.follow import follow  # splines of SciPy: few runs need them

    sweeps, seeds = _passing_car()
    stamps_ns = np.array([sweep.stamp_ns for sweep in sweeps])
    follow(stamps_ns, [sweep.points for sweep in sweeps], [seeds[1], seeds[4]], config)


def warm_up_followed(config: Config) -> None:
    """Follow a synthetic box as the node does: its kernels are loaded."""
    from boxreg_ros.core.following.stream import FollowedObjects

    sweeps, seeds = _passing_car()
    followed = FollowedObjects(config)
    followed.add(seeds[1])
    for sweep in sweeps:
        followed.add_sweep(sweep)
        followed.boxes_at(sweep.stamp_ns, sweep.stamp_ns, np.zeros((0, 9)))


def warm_up_labels(config: Config) -> None:
    """Label the points of a synthetic sweep: its kernels are loaded."""
    sweeps, arrays = _passing_car()
    stamps_ns = np.array([sweep.stamp_ns for sweep in sweeps])
    boxes = np.concatenate([array.boxes for array in arrays])
    track = ObjectTrack('1', 'car', stamps_ns, boxes, np.ones(len(boxes), bool))
    sweep = replace(sweeps[0], times=np.zeros(len(sweeps[0].points)))
    PointLabeller([track], stamps_ns, config, np.zeros((1, 6))).label(sweep)


def _quick(config: Config) -> Config:
    """Return settings of short windows, solved by few iterations."""
    return Config(
        objective=config.objective, mode=config.mode, estimate=config.estimate,
        window=4, lag=3, solver=SolverConfig(rounds=2),
        paper=PaperConfig(iterations=2),
    )  # fmt: skip


def _passing_car() -> tuple[list[Sweep], list[BoxArray]]:
    """Return six sweeps of a car, with points as recordings have them, and its boxes."""
    rng = np.random.default_rng(0)
    sweeps, boxes = [], []
    for k in range(6):
        stamp_ns = k * 3 * 10**8
        box = np.array([[10.0 + 1.0 * k, 0, 0, 4, 2, 1.5, 0, 0, 0]])
        points = rng.uniform(-1, 1, (64, 3)) * [2, 1, 0.7] + box[0, :3]
        sweeps.append(Sweep(stamp_ns, 'map', points.astype(np.float32)))
        boxes.append(BoxArray(stamp_ns, 'map', ('1',), ('car',), np.ones(1), box))
    return sweeps, boxes


def warm_up_crop(config: Config) -> None:
    """Crop a synthetic sweep: what numba sets up for its first kernel takes half a second."""
    box = np.array([[0.0, 0, 0, 4, 2, 1.5, 0, 0, 0]])
    observe(Sweep(0, 'map', np.zeros((1, 3), np.float32)), box, 0, config)
