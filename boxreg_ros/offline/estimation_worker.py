"""
Estimation of windows in a worker process while this one takes the recording on.

Only the worker imports torch, which takes a second and 150 MB.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
import gc
import time
from typing import Any, cast

from boxreg_ros.config import Config
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.core.observation import Observation, Observations
from boxreg_ros.core.registrar import GetEstimates, Submit, submit_locally
from boxreg_ros.core.window import Estimate, Window
from boxreg_ros.io.compilation import announced_compilation
from boxreg_ros.io.warm_up import warm_up, warm_up_crop
from boxreg_ros.offline.progress import Stopwatch
from boxreg_ros.offline.reader import uses_one_core
from boxreg_ros.offline.workers import Receive, run_in_worker, Send, WorkerProcess
import numpy as np


@contextmanager
def estimation_worker(
    config: Config, clock: Stopwatch, announce: Callable[[str], None]
) -> Iterator[Submit | None]:
    """
    Yield a function that starts `estimate_windows` in a worker process, for `BoxRegistrar`.

    Yield None where a worker is no gain or cannot work: a sliding window is awaited before the
    next sweep is taken, a run on one core is one process, and only the CPU can be used after a
    fork. The time in `estimate_windows` is added to the stage ``solve`` of the clock; `announce`
    is called with what is waited for where that takes long.

    """
    if config.estimate != 'track' or uses_one_core(config):
        with announced_compilation(announce):
            yield None
        return
    with announced_compilation(announce):
        warm_up_crop(config)  # the worker then shares what numba sets up
    with (
        run_in_worker(partial(_serve, config), 'estimates windows') as process,
        announced_compilation(announce),
    ):
        yield _Dispatcher(process, clock, announce)


class _Dispatcher:
    """Send windows to the worker and receive their estimates, and announce what it compiles."""

    def __init__(
        self, process: WorkerProcess, clock: Stopwatch, announce: Callable[[str], None]
    ) -> None:
        self._process = process
        self._clock = clock
        self._announce = announce

    def __call__(self, windows: list[Window], config: Config, model: InputModel) -> GetEstimates:
        """Send windows; return a function that waits for their estimates."""
        if not windows:
            return list
        self._process.send((_packed(windows), config, model))

        def awaited() -> list[Estimate | None]:
            received = self._process.receive()
            while isinstance(received, str):
                self._announce(received)
                received = self._process.receive()
            estimates, state, seconds = received
            vars(model).update(state)  # `estimate_windows` has updated the copy in the worker
            self._clock.add('solve', seconds)
            return cast(list[Estimate | None], estimates)

        return awaited


def _serve(config: Config, receive: Receive, send: Send) -> None:
    """Estimate windows in the worker until the connection is closed."""
    with announced_compilation(send), ThreadPoolExecutor(1) as pool:
        warmed_up = pool.submit(_warm_up, config)  # while the first windows fill and are received
        while True:
            received = receive()
            warmed_up.result()
            send(_estimated(*received))
            del received  # before the next windows are received


def _warm_up(config: Config) -> None:
    """Import and load what estimates; its objects stay, and are never looked at for garbage."""
    gc.disable()
    warm_up(config)
    gc.freeze()
    gc.enable()


def _estimated(packed: Any, config: Config, model: InputModel) -> tuple[Any, ...]:
    """Return the estimates of windows, the state of the input model, and the time taken [s]."""
    begun = time.perf_counter()
    estimates = submit_locally(_unpacked(*packed), config, model)()
    return estimates, model.__getstate__(), time.perf_counter() - begun


def _packed(windows: Sequence[Window]) -> tuple[Any, ...]:
    """Return windows with the rows of their observations, and the table of all of these."""
    table, rows = Observations.gathered([one for window in windows for one in window.observations])
    ends = np.cumsum([len(window.observations) for window in windows])[:-1]
    parts = np.split(rows, ends)
    return table, [
        window._replace(observations=cast(Any, part))
        for window, part in zip(windows, parts, strict=True)
    ]


def _unpacked(table: Observations, heads: list[Any]) -> list[Window]:
    """Return the windows that `_packed` was given."""
    return [
        head._replace(observations=[Observation(table, row) for row in head.observations.tolist()])
        for head in heads
    ]
