"""Register windows in a process beside this one, which reads on meanwhile."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from multiprocessing import get_context
from multiprocessing.connection import Connection
import pickle
import signal
import time
from traceback import format_exc
from typing import Any, cast

from boxreg_ros.calibration import InputModel
from boxreg_ros.config import Config
from boxreg_ros.errors import BoxregError
from boxreg_ros.registrar import Awaited, Begin
from boxreg_ros.registration import Estimate, register
from boxreg_ros.sampling import Observation
from boxreg_ros.stopwatch import Stopwatch
from boxreg_ros.window import Window
import numpy as np
import torch

GONE = (
    'the process that registers windows has ended before it was done; most often there is not '
    'enough memory: choose a smaller track_window or sampling.points'
)


@contextmanager
def solver(config: Config, clock: Stopwatch) -> Iterator[Begin | None]:
    """
    Yield what begins `register` in a process of its own, for `BoxRegistrar`; or None.

    That pays for whole tracks alone, as live windows are waited for, and no device but the CPU
    outlives a fork. A thread would gain nothing: the interpreter lets one at a time work.

    Parameters
    ----------
    config : Config
        Settings.
    clock : Stopwatch
        Counts what is spent in `register`.

    Raises
    ------
    BoxregError
        When estimates are waited for, if the process has ended.

    """
    if config.estimate != 'track' or config.device != 'cpu':
        yield None
        return
    context = get_context('fork')  # to import torch anew would cost what this saves
    here, there = context.Pipe()
    process = context.Process(target=_serve, args=(there, here), daemon=True)
    process.start()
    there.close()  # else nobody would notice when the process ends

    def begin(windows: list[Window], config: Config, model: InputModel) -> Awaited:
        if not windows:
            return list
        with _watched():
            _send(here, (_packed(windows), config, model))

        def awaited() -> list[Estimate | None]:
            with _watched():
                answer = _receive(here)
            if isinstance(answer, Exception):
                raise answer
            estimates, learnt, seconds = answer
            vars(model).update(learnt)
            clock.add('solve', seconds)
            return cast(list[Estimate | None], estimates)

        return awaited

    try:
        yield begin
    finally:
        process.kill()  # it has nothing to clean up
        process.join()
        here.close()


@contextmanager
def _watched() -> Iterator[None]:
    try:
        yield
    except (EOFError, OSError):
        raise BoxregError(GONE) from None


def _serve(here: Connection, there: Connection) -> None:
    """Answer until the other side is gone."""
    there.close()
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # what ends the other side ends this one
    torch.set_num_threads(1)
    while True:
        try:
            packed, config, model = _receive(here)
        except EOFError:
            return
        begun = time.perf_counter()
        try:
            estimates = register(_unpacked(*packed), config, model)
            answer: Any = estimates, vars(model), time.perf_counter() - begun
        except Exception as error:
            error.add_note(format_exc())  # a traceback does not travel
            answer = error
        _send(here, answer)


def _send(there: Connection, item: Any) -> None:
    # A connection would have tensors shared, by files that both sides keep open.
    there.send_bytes(pickle.dumps(item, pickle.HIGHEST_PROTOCOL))


def _receive(there: Connection) -> Any:
    return pickle.loads(there.recv_bytes())


def _packed(windows: Sequence[Window]) -> tuple[Any, ...]:
    """Return windows with their observations by columns: few large arrays travel fast."""
    counts = ([len(o.points) for o in window.observations] for window in windows)
    heads = [w._replace(observations=cast(Any, n)) for w, n in zip(windows, counts, strict=True)]
    every = zip(*(o for window in windows for o in window.observations), strict=True)
    stamps, boxes, points, delays, origins, *others = every
    large = np.array(boxes), np.concatenate(points), np.concatenate(delays), np.array(origins)
    return heads, stamps, *large, *others


def _unpacked(heads: list[Any], *columns: Any) -> list[Window]:
    """Return what `_packed` was given."""
    stamps, boxes, points, delays, *others = columns
    ends = np.cumsum([count for head in heads for count in head.observations])[:-1]
    cut = np.split(points, ends), np.split(delays, ends)
    rows = map(Observation, stamps, boxes, *cut, *others)
    return [w._replace(observations=list(islice(rows, len(w.observations)))) for w in heads]
