"""Drives of a batch: one after another, or on workers of Dask, here or in a cluster."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, ExitStack
from importlib.util import find_spec
from itertools import islice
import logging
import os
from pathlib import Path
import sys
import time
from typing import Any
from uuid import uuid4

from boxreg_ros.allocation import collect_rarely, keep_freed_memory
from boxreg_ros.errors import ConfigError, description_of, one_line, RecordingError
from boxreg_ros.offline.arguments import request_from, values_of
from boxreg_ros.offline.batch_results import DRIVE_DONE, Result, UP_TO_DATE
from boxreg_ros.offline.relabel_command import arguments_of, Demands, unmet
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.result_folder import earlier_summary, spare, SUMMARY, whole_summary

INSTALL = "pip install 'boxreg_ros[batch]'"
CONNECTION_SECONDS = 10
"""Longest time for a scheduler to answer [s]; within a site it takes milliseconds. Chosen."""


def relabelled_drives(
    commands: Mapping[str, Sequence[str]], workers: int | None, address: str | None
) -> Iterator[Result]:
    """
    Relabel drives and yield the result of each when it has ended.

    Parameters
    ----------
    commands : mapping of str to sequence of str
        Arguments of `boxreg relabel` by the name of the drive.
    workers : int, optional
        Processes of this machine. One, or without Dask, is this process; by default there are as
        many as cores.
    address : str, optional
        Scheduler of a cluster whose workers see the same files, in place of processes.

    Raises
    ------
    ConfigError
        If Dask is asked for and not installed.
    RecordingError
        If the scheduler does not answer.

    """
    if workers is None and address is None and find_spec('distributed') is None:
        print(f'boxreg: one drive after another; for several: {INSTALL}', file=sys.stderr)
        workers = 1
    count = min(workers or len(os.sched_getaffinity(0)), len(commands))
    if address is None and count <= 1:
        for name, words in commands.items():
            yield relabelled(name, words)
        return
    with _client(count, address) as client:
        yield from _on_workers(client, commands)


def relabelled(name: str, words: Sequence[str]) -> Result:
    """Relabel a drive if it is not done; any error becomes the last line of the result."""
    result = Result(name)
    begun = time.monotonic()
    try:
        _relabel(result, words)
    except Exception as error:
        result.last_line = description_of(error)
    result.seconds = round(time.monotonic() - begun, 1)
    return result


def _relabel(result: Result, words: Sequence[str]) -> None:
    """Relabel a drive if it is not done, and fill its result."""
    from boxreg_ros.offline.notes import closing_line, notes
    from boxreg_ros.offline.relabel import relabel
    from boxreg_ros.offline.summary import Summary

    args = arguments_of(words)
    request = request_from(args)
    _refuse_other_drive(args.out, request)
    spare(args.out, [args.config])
    earlier = whole_summary(args.out, request.fingerprint())
    if earlier is None:
        summary, status = relabel(request, args.out), DRIVE_DONE
    else:
        summary, status = Summary.from_json(earlier), UP_TO_DATE
    result.count(summary)
    result.notes = '; '.join(notes(summary))
    problem = unmet(summary, Demands(**values_of(args, Demands)))
    if summary.has_failed:
        problem = f'none of {summary.boxes_in:,} boxes was refined; see "reasons" in {SUMMARY}'
    result.last_line = problem or closing_line(summary, args.out)
    if not problem:
        result.status = status


def _refuse_other_drive(out: Path, request: Request) -> None:
    """Raise RecordingError if a result would replace that of another drive."""
    recordings = [str(path) for path in request.recordings]
    earlier = (earlier_summary(out) or {}).get('recordings', recordings)
    if earlier != recordings:
        raise RecordingError(
            f'expected a name of its own, got that of {", ".join(earlier)}, whose result is in '
            f'{out}: choose another output with -o, or delete that one'
        )


@contextmanager
def _client(workers: int, address: str | None) -> Iterator[Any]:
    """Yield the client of a cluster: that at an address, or one of processes on this machine."""
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise ConfigError(f'--workers and --address need Dask: {INSTALL} ({error})') from None
    with ExitStack() as stack:
        cluster: Any = address
        if address is None:
            cluster = stack.enter_context(
                LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    memory_limit=1.0 / workers,  # of that of this machine
                    dashboard_address='127.0.0.1:0',
                    silence_logs=logging.CRITICAL,
                )
            )
        try:
            client = stack.enter_context(Client(cluster, timeout=CONNECTION_SECONDS))
        except (OSError, ValueError) as error:
            reason = one_line(error)[:200]
            raise RecordingError(
                f'--address {address}: expected a Dask scheduler that answers, got: {reason}; '
                f'start one with `dask scheduler`, or leave --address out to run on this machine'
            ) from None
        print(f'boxreg: progress in the browser: {client.dashboard_link}', file=sys.stderr)
        yield client


def _on_workers(client: Any, commands: Mapping[str, Sequence[str]]) -> Iterator[Result]:
    """
    Relabel drives on the workers of a cluster.

    No more than the workers have threads are submitted at a time: Dask takes a drive that waits at
    a worker for killed with that (distributed 2026.8.0).

    """
    from distributed import as_completed, KilledWorker

    batch = uuid4().hex  # other batches may have drives of the same names
    waiting = iter(commands.items())
    running = as_completed()
    names: dict[Any, str] = {}

    def submit() -> None:
        threads = max(sum(client.nthreads().values()), 1)
        for name, words in islice(waiting, max(threads - len(names), 0)):
            key = f'{name!a}-{batch}'
            future = client.submit(_alone, name, list(words), key=key, pure=False)
            names[future] = name
            running.add(future)

    submit()
    for future in running:
        name = names.pop(future)
        try:
            yield future.result()
        except KilledWorker as error:
            yield Result(
                name,
                last_line=f'its worker was killed {error.allowed_failures + 1} times; the most '
                f'frequent cause is too little memory: use fewer --workers, or larger ones',
            )
        except (Exception, CancelledError) as error:
            yield Result(name, last_line=f'lost by the cluster: {one_line(error)}')
        submit()


def _alone(name: str, words: Sequence[str]) -> Result:
    """Relabel a drive on a worker, which must have one thread."""
    from distributed import get_worker

    threads = get_worker().state.nthreads
    if threads != 1:
        return Result(
            name,
            last_line=f'expected workers of Dask with one thread each, got one with {threads}; '
            f'start them with --nthreads 1',
        )
    keep_freed_memory()
    collect_rarely()
    return relabelled(name, words)
