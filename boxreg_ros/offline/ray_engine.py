"""The jobs of `boxreg batch` on a Ray cluster whose nodes share the files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import logging
import signal
import socket
from typing import Any

from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.offline.batch_results import Result
from boxreg_ros.offline.job import Job
from boxreg_ros.offline.job_process import JobRunner

JOBS_AHEAD = 2
"""Jobs that are submitted per core of the cluster: one runs, one waits."""
CLUSTER_SECONDS = 5.0
"""Longest time for the cluster to accept a connection [s]; within a site it takes milliseconds."""
NODE_LOSSES = 10
"""How often Ray starts a job again whose node or worker was lost; spot nodes are lost hourly."""


@contextmanager
def ray_engine(
    runner: JobRunner, address: str | None
) -> Iterator[tuple[Callable[[Job], Result], int, Callable[[], None]]]:
    """
    Yield a function that runs a job on a cluster, how many to run at a time, and one to end them.

    A job whose worker or node is lost is started again and goes on from its journal, as the
    output is on storage that all nodes share. So does a job of a driver that was killed, when
    the same command is run again. The paths of `runner` must exist on the nodes; each job asks
    for one core and its memory. Without an address the cluster is that of this machine, or a new
    local one. Raises ConfigError if Ray is not installed, or no node has the memory of a job,
    and RecordingError if the cluster does not answer.

    """
    ray = _connected(address)
    start = ray.remote(num_cpus=1, memory=runner.memory, max_retries=NODE_LOSSES)(_run_job)
    shared = ray.put(runner)
    pending: set[Any] = set()

    def run(job: Job) -> Result:
        reference = start.remote(shared, job)
        pending.add(reference)
        try:
            result: Result = ray.get(reference)
        except ray.exceptions.RayError as error:
            reason = ' '.join(str(error).split())[:200]
            lost = f'its worker was lost {NODE_LOSSES + 1} times, last: {reason}'
            result = Result(job.name, last_line=f'{lost}; check the cluster')
        pending.discard(reference)
        return result

    def end() -> None:
        for reference in list(pending):
            ray.cancel(reference, force=True)

    try:
        _check_memory(ray.nodes(), runner.memory)
        yield run, max(JOBS_AHEAD * int(ray.cluster_resources().get('CPU', 1)), 1), end
    finally:
        ray.shutdown()


def _connected(address: str | None) -> Any:
    """Return the module of Ray, connected to a cluster."""
    try:
        import ray
    except ImportError as error:
        raise ConfigError(f"--engine ray needs Ray: pip install 'ray>=2.9' ({error})") from None
    handler = signal.getsignal(signal.SIGTERM)
    try:
        _check_answers(address)
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, ValueError, RuntimeError, TimeoutError) as error:
        reason = ' '.join(str(error).split())[:200]
        raise RecordingError(
            f'--address {address}: expected a Ray cluster that answers, got: {reason}; check '
            f'`ray status --address {address}`, or leave --address out to run on this machine'
        ) from None
    finally:
        signal.signal(signal.SIGTERM, handler)  # that of Ray exits without the clean-up
    return ray


def _check_answers(address: str | None) -> None:
    """Raise OSError if nothing listens at an address: Ray itself tries for minutes."""
    host, _, port = (address or '').removeprefix('ray://').rpartition(':')
    if host and port.isdecimal():
        socket.create_connection((host, int(port)), CLUSTER_SECONDS).close()


def _check_memory(nodes: list[dict[str, Any]], memory: float) -> None:
    """Refuse jobs that need more memory [bytes] than any node has: Ray would wait for ever."""
    sizes = [node['Resources'].get('memory', 0) for node in nodes if node['Alive']]
    largest = max(sizes, default=0)
    if memory > largest:
        raise ConfigError(
            f'--memory: expected at most {largest / 1e9:.1f} GB, all that the largest node of the '
            f'Ray cluster offers, got {memory / 1e9:g} GB; lower it, or start a larger node'
        )


def _run_job(runner: JobRunner, job: Job) -> Result:
    """Run a job on a node of the cluster."""
    return runner(job)
