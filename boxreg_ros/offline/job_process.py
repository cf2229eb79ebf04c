"""One job of `boxreg batch`: `boxreg relabel` in a process of its own, with retries."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
import ctypes
from dataclasses import dataclass, field
from functools import partial
import hashlib
import json
from math import inf
import os
from pathlib import Path
import signal
import subprocess
import sys
from tempfile import TemporaryFile
from threading import Thread, TIMEOUT_MAX
import time
from typing import Any, BinaryIO, TypeVar

from boxreg_ros import __version__
from boxreg_ros.errors import RecordingError
from boxreg_ros.io.storage.urls import entries_of, names_of, read_text, url_of, write_text
from boxreg_ros.io.whole_files import written_whole
from boxreg_ros.offline.batch_results import DRIVE_DONE, Result, UP_TO_DATE
from boxreg_ros.offline.job import Job, JOBS
from boxreg_ros.offline.progress import PIPE
from boxreg_ros.offline.result_folder import alone, claimed, earlier_summary, whole_summary

_T = TypeVar('_T')


DRIVE = '{drive}'
"""Stands for the name of the drive in the options of a batch."""
JOB_STATE = {'key': str, 'recordings': list, 'files': list, 'peak_mb': int}
"""Fields of the state of a job that is done; one without them, of another version, is none."""
END_SECONDS = 10.0
"""Time that a job has to remove its files after SIGTERM [s]; then it is killed."""
MEMORY_PERIOD = 0.5
"""Time between two measurements of the memory [s]; a run of a drive takes some seconds."""
PIPE_BYTES = 2**16
"""Capacity of a pipe in Linux [bytes]."""
PR_SET_PDEATHSIG = 1
"""Of Linux: option of prctl for the signal at the end of the parent."""

Process = subprocess.Popen[bytes]


@dataclass(frozen=True)
class JobRunner:
    """Run jobs one by one; can be sent to another machine that has the same files."""

    out: Path  # folder with one result folder per drive; absolute
    # of `boxreg relabel`; `DRIVE` in them and in `inputs` is the name of the job
    options: tuple[str, ...]
    config: str  # the effective settings, for the key
    inputs: tuple[Path, ...] = ()  # files and folders that the options name, for the key
    retries: int = 1  # how often a job whose process was killed is tried again
    timeout: float = inf  # longest time without progress [s]
    memory: float = inf  # largest of one job [bytes]
    running: set[Process] = field(default_factory=set)  # processes that run now, to end them

    def __call__(self, job: Job) -> Result:
        """Relabel a drive if it is not done."""
        result = Result(job.name, last_line=job.problem)
        if job.problem:
            return result
        try:
            # The process of a run that was killed takes a moment to end.
            lock = self.out / JOBS / f'{job.name}.lock'
            with alone(lock, f'drive {job.name}', END_SECONDS):
                self._settle(job, result)
        except RecordingError as error:
            result.last_line = str(error)
        except TimeoutError:
            result.last_line = (
                f'its files were not read for {self.timeout:g} s: check their disk or network '
                f'mount, or raise --timeout'
            )
        except OSError as error:
            result.last_line = (
                f'{error}; free some space, or make the file accessible, and run it again'
            )
        return result

    def end(self) -> None:
        """End all processes that run."""
        for process in list(self.running):
            process.terminate()

    def _settle(self, job: Job, result: Result) -> None:
        """Relabel a drive if it is not done, and store that it is."""
        path = self.out / JOBS / f'{job.name}.json'
        state = _read_state(path)
        watch = Watch(self.timeout)
        files = watched(watch, partial(job.hashes, state.get('files', []), watch.advanced))
        result.key = self._key(job, files)
        self._refuse_other_drive(job, state, files)
        summary = whole_summary(self.out / job.name) if state.get('key') == result.key else None
        if summary is None:
            self._relabel(job, result)
            summary = earlier_summary(self.out / job.name)
        else:
            result.status, result.exit_status, result.peak_mb = UP_TO_DATE, 0, state['peak_mb']
        result.count(summary or {})
        if result.is_done:
            state = {'key': result.key, 'recordings': [str(path) for path in job.recordings]}
            state |= {'files': files, 'peak_mb': result.peak_mb}
            with written_whole(path) as file:
                file.write(json.dumps(state, indent=2))

    def _key(self, job: Job, files: Sequence[Sequence[Any]]) -> str:
        """Return the hash of the content of files, the options and the version."""
        inputs = (Path(str(path).replace(DRIVE, job.name)) for path in self.inputs)
        settings = [
            *self.options,
            self.config,
            *(digest for p in inputs for digest in _digests(p)),
        ]
        content = repr((__version__, settings, _contents(files)))
        return hashlib.sha256(content.encode()).hexdigest()

    def _refuse_other_drive(
        self, job: Job, state: dict[str, Any], files: Sequence[Sequence[Any]]
    ) -> None:
        """Raise RecordingError if the result of a drive would replace that of another one."""
        earlier = state.get('recordings', [str(path) for path in job.recordings])
        is_other = earlier != [str(path) for path in job.recordings]
        if is_other and _contents(state['files']) != _contents(files):
            raise RecordingError(
                f'expected a name of its own, got that of {", ".join(earlier)}, whose result is '
                f'in {self.out / job.name}: choose another output with -o, or delete that one and '
                f'{JOBS}/{job.name}.json'
            )

    def _relabel(self, job: Job, result: Result) -> None:
        """Run the process of a job, again if it was killed."""
        begun = time.monotonic()
        while result.attempts <= self.retries and not self._attempt(job, result):
            pass
        result.seconds = round(time.monotonic() - begun, 1)
        if result.exit_status == 0:
            result.status = DRIVE_DONE
            return
        with suppress(RecordingError), claimed(self.out / job.name):
            pass  # deletes what a process that was killed has left

    def _attempt(self, job: Job, result: Result) -> bool:
        """Run the process of a job once; return whether another attempt would end the same."""
        command = [sys.executable, '-m', 'boxreg_ros.cli', 'relabel', *map(str, job.recordings)]
        command += ['-o', str(self.out / job.name), '--resume']
        command += [word.replace(DRIVE, job.name) for word in self.options]
        result.attempts += 1
        with _log_file(self.out / JOBS / f'{job.name}.log') as log, _pipe() as (steps, step):
            process = subprocess.Popen(
                command, stdout=log, stderr=subprocess.STDOUT, preexec_fn=_end_with_parent(),
                pass_fds=[step], env={**os.environ, PIPE: str(step)},
            )  # fmt: skip
            self.running.add(process)
            problem = self._wait(process, steps, result)
            self.running.discard(process)
            log.seek(0)
            last_line = _last_line(log.read())
        result.exit_status = process.returncode
        if not problem and (process.returncode or 0) < 0:
            result.last_line = (
                f'its process was killed by signal {-process.returncode}; the most frequent cause '
                f'is too little memory (it took {result.peak_mb:,} MB): use fewer --workers'
            )
            return False
        result.last_line = problem or last_line or f'ended with status {process.returncode}'
        return True

    def _wait(self, process: Process, steps: int, result: Result) -> str:
        """Wait for a process; end one that stands still or takes too much, and return why."""
        watch = Watch(self.timeout)
        while True:
            _wait_for(process, min(MEMORY_PERIOD, watch.left))
            if process.poll() is not None:
                return ''
            memory = memory_bytes(process.pid)
            result.peak_mb = max(result.peak_mb, round(memory / 1e6))
            with suppress(BlockingIOError):
                os.read(steps, PIPE_BYTES)
                watch.advanced()
            if memory > self.memory:
                problem = f'it took more than {self.memory / 1e9:g} GB of memory: raise --memory'
            elif not watch.left:
                problem = f'no progress for {self.timeout:g} s: raise --timeout'
            else:
                continue
            process.terminate()
            _wait_for(process, END_SECONDS)
            process.kill()
            _wait_for(process, END_SECONDS)  # one that reads from a dead mount does not end
            return problem


class Watch:
    """Time without progress, and its limit [s]."""

    def __init__(self, limit: float) -> None:
        self.limit = limit
        self._since = time.monotonic()

    def advanced(self) -> None:
        """Note that there was progress."""
        self._since = time.monotonic()

    @property
    def left(self) -> float:
        """Return the time until the limit is reached [s], at least 0."""
        return max(self._since + self.limit - time.monotonic(), 0.0)


def watched(watch: Watch, call: Callable[[], _T]) -> _T:
    """
    Call a function, but wait for it no longer than a time without progress, noted in `watch`.

    It runs in a thread of its own, which is left behind if it is late: a read from a dead mount
    cannot be interrupted. The thread does not keep the process from its end. Raises TimeoutError
    if the call makes no progress in time.

    """
    result: Future[_T] = Future()

    def run() -> None:
        try:
            result.set_result(call())
        except BaseException as error:
            result.set_exception(error)

    Thread(target=run, daemon=True).start()
    while True:
        try:
            return result.result(min(watch.left, TIMEOUT_MAX))
        except TimeoutError:
            if result.done() or not watch.left:
                raise


def read_states(out: Path) -> dict[str, dict[str, Any]]:
    """Return what is stored of the jobs that are done, by name."""
    folder = out / JOBS
    names: list[str] = []
    if url_of(folder) is not None:
        names = names_of(folder)
    elif folder.is_dir():
        names = os.listdir(folder)
    states = {name[:-5]: _read_state(folder / name) for name in names if name.endswith('.json')}
    return {name: state for name, state in states.items() if state}


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
    with suppress(subprocess.TimeoutExpired):
        process.wait(seconds)


def _end_with_parent() -> Callable[[], None]:
    """Return a function for a new process: it ends with this one, even if this one is killed."""
    prctl = ctypes.CDLL(None).prctl  # loaded here: between fork and exec little is allowed
    return partial(prctl, PR_SET_PDEATHSIG, signal.SIGKILL)


@contextmanager
def _pipe() -> Iterator[tuple[int, int]]:
    """Yield both ends of a pipe that nobody waits for."""
    ends = os.pipe()
    try:
        for end in ends:
            os.set_blocking(end, False)
        yield ends
    finally:
        for end in ends:
            os.close(end)


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


def _digests(path: Path) -> Iterator[str]:
    """Yield the hashes of a file or of all files of a folder; none if there is none."""
    if url_of(path) is not None:
        yield from (f'{one.path} {one.version}' for one in entries_of(path))
        return
    for file in [path] if path.is_file() else sorted(path.rglob('*')):
        if file.is_file():
            with file.open('rb') as opened:
                yield hashlib.file_digest(opened, 'sha256').hexdigest()


def _contents(files: Sequence[Sequence[Any]]) -> list[Any]:
    """Return the hashes of files, as of `Job.hashes`."""
    return [found[-1] for found in files]


def _read_state(path: Path) -> dict[str, Any]:
    """Return the state of a job; empty if it was never done."""
    try:
        state = json.loads(read_text(path))
    except (OSError, ValueError):
        return {}
    is_state = isinstance(state, dict) and all(
        isinstance(state.get(name), kind) for name, kind in JOB_STATE.items()
    )
    return state if is_state else {}
