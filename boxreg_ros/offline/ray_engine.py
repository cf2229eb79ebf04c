"""The jobs of `boxreg batch` on a Ray cluster whose nodes share the files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
import logging
from pathlib import Path
import signal
import socket
from typing import Any

from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.storage.urls import url_of
from boxreg_ros.offline.job import Job
from boxreg_ros.offline.job_process import JobRunner

DEFAULT_JOB_BYTES = 10**9
"""
Memory that a job declares before one was measured [bytes].

Twice the memory that was measured for a sweep of 150,000 points (docs/results/speed.md#scale).

"""
MEMORY_RESERVE = 1.2
"""Declared by measured memory; chosen: drives of one fleet differ by their number of objects."""
JOBS_AHEAD = 2
"""Jobs that are submitted per core of the cluster: one runs, one waits."""
CLUSTER_SECONDS = 5.0
"""Longest time for the cluster to accept a connection [s]; within a site it takes milliseconds."""
NODE_LOSSES = 10
"""How often Ray starts a job again whose node or worker was lost; spot nodes are lost hourly."""


def run_on_ray(jobs: Sequence[Job], runner: JobRunner, address: str | None) -> Iterator[Job]:
    """
    Run jobs on a Ray cluster; yield each when it has ended, its results in the job given.

    A job whose worker or node is lost is started again and goes on from its journal, as the
    output is on storage that all nodes share. So does a job of a driver that was killed, when the
    same command is run again.

    Parameters
    ----------
    jobs : sequence of Job
        Jobs to run.
    runner : JobRunner
        Runs one job on a node; its paths must exist there.
    address : str or None
        Of the cluster; None for the one of this machine, or a new local one.

    Raises
    ------
    ConfigError
        If Ray is not installed.
    RecordingError
        If the cluster does not answer.

    """
    ray = _connected(address)
    measured = runner.measured_bytes()
    memory = round(measured * MEMORY_RESERVE) or DEFAULT_JOB_BYTES
    options = {'num_cpus': 1, 'memory': memory, 'max_retries': NODE_LOSSES}
    start = ray.remote(**options)(_run_job)
    shared = ray.put(_absolute(runner))
    most = max(JOBS_AHEAD * int(ray.cluster_resources().get('CPU', 1)), 1)
    waiting = list(reversed(jobs))
    pending: dict[Any, Job] = {}
    try:
        while waiting or pending:
            while waiting and len(pending) < most:
                job = waiting.pop()
                pending[start.remote(shared, _absolute_job(job))] = job
            (ended,), _ = ray.wait(list(pending), num_returns=1)
            job = pending.pop(ended)
            _take_result(ray, ended, job)
            yield job
    finally:
        for reference in pending:
            ray.cancel(reference, force=True)
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


def _run_job(runner: JobRunner, job: Job) -> Job:
    """Run a job on a node of the cluster."""
    return runner(job)


def _take_result(ray: Any, reference: Any, job: Job) -> None:
    """Copy the result of a job on the cluster to the job here."""
    try:
        found = ray.get(reference)
    except ray.exceptions.RayError as error:
        reason = ' '.join(str(error).split())[:200]
        job.fail(f'its worker was lost {NODE_LOSSES + 1} times, last: {reason}; check the cluster')
        return
    recordings = job.recordings
    for name, value in vars(found).items():
        setattr(job, name, value)
    job.recordings = recordings


def _absolute(runner: JobRunner) -> JobRunner:
    """Return a runner with paths that do not depend on the current folder."""
    return replace(runner, out=_absolute_path(runner.out), running=set())


def _absolute_job(job: Job) -> Job:
    return replace(job, recordings=tuple(map(_absolute_path, job.recordings)))


def _absolute_path(path: Path) -> Path:
    return path if url_of(path) else path.resolve()
