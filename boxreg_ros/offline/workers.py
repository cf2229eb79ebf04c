"""Windows of whole tracks, registered in a process beside the one that reads on."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
import time
from typing import Any, cast

from boxreg_ros.config import Config
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.core.observation import Observation
from boxreg_ros.core.registrar import GetEstimates, Submit
from boxreg_ros.core.registration import Estimate, register
from boxreg_ros.core.window import Window
from boxreg_ros.offline.peer import beside
from boxreg_ros.offline.stopwatch import Stopwatch
import numpy as np


@contextmanager
def solver(config: Config, clock: Stopwatch) -> Iterator[Submit | None]:
    """
    Yield what begins `register` in a process of its own, for `BoxRegistrar`; or None.

    That pays for whole tracks alone, as live windows are waited for, and no device but the CPU
    outlives a fork.

    Parameters
    ----------
    config : Config
        Settings.
    clock : Stopwatch
        Counts what is spent in `register`.

    """
    if config.estimate != 'track' or config.device != 'cpu':
        yield None
        return
    with beside(_serve, 'registers windows') as peer:

        def begin(windows: list[Window], config: Config, model: InputModel) -> GetEstimates:
            if not windows:
                return list
            peer.send((_packed(windows), config, model))

            def awaited() -> list[Estimate | None]:
                estimates, learnt, seconds = peer.receive()
                vars(model).update(learnt)
                clock.add('solve', seconds)
                return cast(list[Estimate | None], estimates)

            return awaited

        yield begin


def _serve(receive: Callable[[], Any], send: Callable[[Any], None]) -> None:
    while True:
        packed, config, model = receive()
        begun = time.perf_counter()
        estimates = register(_unpacked(*packed), config, model)
        send((estimates, vars(model), time.perf_counter() - begun))


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
