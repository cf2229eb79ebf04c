"""One job of `boxreg batch`: `boxreg relabel` in a process of its own, with retries."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import ctypes
from dataclasses import dataclass, field
from functools import partial
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
from tempfile import TemporaryFile
import time
from typing import Any, BinaryIO

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.storage.urls import names_of, read_text, url_of, write_text
from boxreg_ros.io.whole_files import written_whole
from boxreg_ros.offline.job import Job, JOB_DONE, JOB_FAILED, UP_TO_DATE
from boxreg_ros.offline.result_folder import delete_remains, earlier_summary
from boxreg_ros.offline.time_limit import within

JOBS = 'jobs'
"""Folder with the key and the log of each job."""
END_SECONDS = 10.0
"""Time that a job has to remove its files after SIGTERM [s]; then it is killed."""
MEMORY_PERIOD = 0.5
"""Time between two measurements of the memory [s]; a run of a drive takes some seconds."""
PR_SET_PDEATHSIG = 1
"""Of Linux: option of prctl for the signal at the end of the parent."""

Process = subprocess.Popen[bytes]


@dataclass(frozen=True)
class JobRunner:
    """
    Run jobs one by one; can be sent to another machine that has the same files.

    Attributes
    ----------
    out : Path
        Folder with one result folder per drive.
    options : tuple of str
        Options of `boxreg relabel`.
    config : str
        The effective settings, for the key.
    retries : int
        How often a job whose process was killed is tried again.
    timeout : float or None
        Longest time to read the files for the key, and of one attempt [s].
    running : set
        Processes that run now, to end them.

    """

    out: Path
    options: tuple[str, ...]
    config: str
    retries: int = 1
    timeout: float | None = None
    running: set[Process] = field(default_factory=set)

    def __call__(self, job: Job) -> Job:
        """Relabel a drive if it is not done; return the job with its status."""
        if job.status == JOB_FAILED:
            return job
        folder = self.out / JOBS
        state = folder / f'{job.name}.json'
        earlier = _read_state(state)
        try:
            hashes = within(self.timeout, partial(job.hashes, earlier.get('files', [])))
            if url_of(folder) is None:
                folder.mkdir(parents=True, exist_ok=True)
            job.set_key(hashes, [*self.options, self.config])
            self._relabel(job, earlier)
            job.summary = earlier_summary(self.out / job.name) or {}
            if job.status != JOB_FAILED:
                with written_whole(state) as file:
                    known = {'key': job.key, 'files': hashes, 'peak_bytes': job.peak_bytes}
                    file.write(json.dumps(known, indent=2))
        except RecordingError as error:
            job.fail(str(error))
        except TimeoutError:
            job.fail(
                f'its files were not read after {self.timeout:g} s: check their disk or network '
                f'mount, or raise --timeout'
            )
        except OSError as error:
            job.fail(f'{error}; free some space, or make the file accessible, and run it again')
        return job

    def end(self) -> None:
        """End all processes that run."""
        for process in list(self.running):
            process.terminate()

    def measured_bytes(self) -> int:
        """Return the largest memory of the jobs that are done; 0 before the first."""
        folder = self.out / JOBS
        names: list[str] = []
        if url_of(folder) is not None:
            names = names_of(folder)
        elif folder.is_dir():
            names = os.listdir(folder)
        states = [_read_state(folder / name) for name in names if name.endswith('.json')]
        return max((int(state.get('peak_bytes', 0)) for state in states), default=0)

    def _relabel(self, job: Job, earlier: dict[str, Any]) -> None:
        if earlier.get('key') == job.key and earlier_summary(self.out / job.name) is not None:
            job.status, job.exit_status = UP_TO_DATE, 0
            job.peak_bytes = int(earlier.get('peak_bytes', 0))
            return
        begun = time.monotonic()
        while job.attempts <= self.retries and not self._attempt(job):
            pass
        job.seconds = time.monotonic() - begun
        job.status = JOB_DONE if job.exit_status == 0 else JOB_FAILED

    def _attempt(self, job: Job) -> bool:
        """Run the process of a job once; return whether another attempt would end the same."""
        command = [sys.executable, '-m', 'boxreg_ros.cli', 'relabel', *map(str, job.recordings)]
        command += ['-o', str(self.out / job.name), '--resume', *self.options]
        delete_remains(self.out / job.name)
        job.attempts += 1
        log = self.out / JOBS / f'{job.name}.log'
        with _log_file(log) as file:
            process = subprocess.Popen(
                command, stdout=file, stderr=subprocess.STDOUT, preexec_fn=_end_with_parent()
            )
            self.running.add(process)
            is_late = self._wait(process, job)
            self.running.discard(process)
            file.seek(0)
            last_line = _last_line(file.read())
        job.exit_status = process.returncode
        job.last_line = last_line or f'ended with status {process.returncode}'
        if is_late:
            job.last_line = f'not done after {self.timeout:g} s: raise --timeout'
        elif process.returncode < 0:
            job.last_line = (
                f'its process was killed by signal {-process.returncode}; the most frequent cause '
                f'is too little memory (it took {job.peak_bytes / 1e6:,.0f} MB): use fewer '
                f'--workers'
            )
        return is_late or process.returncode >= 0

    def _wait(self, process: Process, job: Job) -> bool:
        """Wait for a process and measure its memory; end a late one, and return whether it was."""
        deadline = time.monotonic() + (self.timeout or float('inf'))
        while process.poll() is None and time.monotonic() < deadline:
            job.peak_bytes = max(job.peak_bytes, memory_bytes(process.pid))
            left = deadline - time.monotonic()
            _wait_for(process, max(min(MEMORY_PERIOD, left), 0.0))
        if process.poll() is not None:
            return False
        process.terminate()
        _wait_for(process, END_SECONDS)
        process.kill()
        _wait_for(process, END_SECONDS)  # one that reads from a dead mount does not end
        return True


def memory_bytes(pid: int) -> int:
    """Return the memory of a process and its children; pages they share count in parts."""
    try:
        rollup = Path(f'/proc/{pid}/smaps_rollup').read_text(encoding='ascii')
        children = Path(f'/proc/{pid}/task/{pid}/children').read_text(encoding='ascii').split()
    except OSError:  # it has ended
        return 0
    sizes = [line.split()[1] for line in rollup.splitlines() if line.startswith('Pss:')]
    return sum(int(size) * 1024 for size in sizes) + sum(
        memory_bytes(int(one)) for one in children
    )


def _wait_for(process: Process, seconds: float) -> None:
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        return


def _end_with_parent() -> Callable[[], None]:
    """Return a function for a new process: it ends with this one, even if this one is killed."""
    prctl = ctypes.CDLL(None).prctl  # loaded here: between fork and exec little is allowed
    return partial(prctl, PR_SET_PDEATHSIG, signal.SIGKILL)


@contextmanager
def _log_file(path: Path) -> Iterator[BinaryIO]:
    """Yield the file of a log; one behind a URL is written at the end."""
    if url_of(path) is None:
        with path.open('w+b') as file:
            yield file
        return
    with TemporaryFile() as temporary:
        yield temporary
        temporary.seek(0)
        write_text(path, temporary.read().decode(errors='replace'))


def _last_line(log: bytes) -> str:
    lines = log.decode(errors='replace').strip().splitlines()
    return lines[-1].removeprefix('boxreg: ') if lines else ''


def _read_state(path: Path) -> dict[str, Any]:
    try:
        state = json.loads(read_text(path))
    except (OSError, ValueError):
        return {}
    return state if isinstance(state, dict) else {}
