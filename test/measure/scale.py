"""
`measure scale`: core hours and memory per hour of recording, and a fleet of jobs.

The drives are copies of one recording, and run by `boxreg batch` itself. A large recording is its
repetition. The fleet is simulated with the measured time: jobs of random length, stragglers, and
workers that are lost.

"""

from heapq import heapify, heapreplace
import json
import os
from pathlib import Path
import resource
import shutil
import subprocess
from tempfile import TemporaryDirectory
import time
from typing import NamedTuple

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from measure.common import BOXREG
import numpy as np
from rosbags.typesys import get_typestore, Stores

OPTIONS = ('--formats=csv', '--workers=1')
FLEET_JOBS = 10_000
FLEET_CORES = 500
FLEET_HOURS = 10_000
"""Size of the simulated fleet: an hour of recording per job; chosen, as in the issue of a user."""
LENGTH_SPREAD = 0.5
"""Standard deviation of the logarithm of a job's length; chosen: two thirds within 0.6 to 1.6."""
STRAGGLER_PART, STRAGGLER_FACTOR = 0.01, 8.0
"""Jobs that take longer, on slow nodes or with many objects, and how much; chosen."""
LOSS_PART = 0.05
"""Attempts whose node is lost; chosen: spot nodes are lost within hours."""
LOST_PART = 0.5
"""Part of a job that a loss costs on average: it is done again from its beginning. Derived."""
PRICE = 0.04
"""Price of a core for an hour [USD]; of the order of a list price on demand."""


class Fleet(NamedTuple):
    """Results of a simulated fleet."""

    hours: float  # until the last job has ended
    least_hours: float  # the same without losses, on cores that are never idle
    used: float  # part of the time of the cores in which they run jobs
    lost: float  # part of the work that is done twice


ARGUMENTS = {
    'recording': (Path, 'MCAP file of ROS 2', {'metavar': 'RECORDING'}),
    '--drives': (4, 'copies that are relabelled by one and by two workers'),
    '--rounds': (3, 'how often one and two workers take turns'),
    '--large': (float, 'size of a recording made by repetition; the fleet is of such drives [GB]'),
    '--price': (PRICE, 'of a core for an hour', {'metavar': 'USD'}),
}


def run(args):
    """Measure, and simulate a fleet."""
    report = {'recording': args.recording.name, 'load': os.getloadavg()[0]}
    with TemporaryDirectory() as name:
        folder = Path(name)
        report['workers'] = _workers(args.recording, args.drives, args.rounds, folder)
        report['job'] = _measured(args.recording, folder)
        if args.large:
            path = folder / 'large.mcap'
            repeated(args.recording, path, args.large)
            report['large'] = _measured(path, folder)
    basis = 'large' if args.large else 'job'
    core_hours = FLEET_HOURS / report[basis]['hours_per_core_hour']
    fleet = simulated(core_hours * 3600 / FLEET_JOBS, np.random.default_rng(0))
    report['fleet'] = {
        'basis': basis,
        'core_hours': core_hours,
        'usd_per_core_hour': args.price,
        'usd': core_hours * args.price,
        **fleet._asdict(),
    }
    return report


def simulated(seconds, rng, count=FLEET_JOBS, cores=FLEET_CORES):
    """Return the schedule of jobs of a mean length [s], the largest drives first."""
    lengths = seconds * rng.lognormal(-(LENGTH_SPREAD**2) / 2, LENGTH_SPREAD, count)
    lengths = np.sort(lengths)[::-1].copy()  # the sizes are known; stragglers are not
    lengths[rng.random(count) < STRAGGLER_PART] *= STRAGGLER_FACTOR
    losses = rng.geometric(1 - LOSS_PART, count) - 1
    work = lengths * (1 + LOST_PART * losses)
    free = [0.0] * cores
    heapify(free)
    for length in work:
        heapreplace(free, free[0] + float(length))
    end = max(free)
    least = float(max(lengths.sum() / cores, lengths.max()))
    return Fleet(
        end / 3600, least / 3600, float(work.sum() / (end * cores)),
        float(work.sum() / lengths.sum() - 1),
    )  # fmt: skip


def _workers(recording, drives, rounds, folder):
    """
    Return how much faster two workers are than one.

    They take turns, so that other programs slow down both. Where others use the cores, two
    workers get less than two of them, which ``cores_used`` shows.

    Returns
    -------
    found : dict
        Of ``one`` and ``two`` workers ``seconds`` and ``cores_used``, medians over the rounds, and
        ``speedup``, the median of the ratios of each round.

    """
    copies = [folder / f'{i}{recording.suffix}' for i in range(drives)]
    for copy in copies:
        shutil.copyfile(recording, copy)
    _run_batch(copies, 1, folder / 'compiled')
    runs = [
        [_run_batch(copies, workers, folder / f'{turn}-{workers}') for workers in (1, 2)]
        for turn in range(rounds)
    ]
    seconds, used = np.moveaxis(np.array(runs), 2, 0)  # (round, workers) each
    found = {
        name: {
            'seconds': float(np.median(seconds[:, i])),
            'cores_used': float(np.median(used[:, i] / seconds[:, i])),
        }
        for i, name in enumerate(('one', 'two'))
    }
    found['speedup'] = float(np.median(seconds[:, 0] / seconds[:, 1]))
    return found


def _run_batch(drives, workers, out):
    """Run `boxreg batch`; return its duration and its CPU time [s]."""
    command = [*BOXREG, 'batch', *map(str, drives), '-o', str(out), f'--workers={workers}']
    begun = time.perf_counter()
    before = _children_seconds()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - begun, _children_seconds() - before


def _children_seconds():
    """Return the CPU time of all processes that were started here and have ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _measured(recording, folder):
    """Return size, time and memory of one job, and the time to inspect its recording."""
    begun = time.perf_counter()
    shown = subprocess.run(
        [*BOXREG, 'inspect', str(recording), '--json'], check=True, stdout=subprocess.PIPE
    )
    inspect_s = time.perf_counter() - begun
    facts = json.loads(shown.stdout)
    out = folder / 'job'
    begun = time.perf_counter()
    process = subprocess.Popen([*BOXREG, 'relabel', str(recording), '-o', str(out), *OPTIONS])
    _, status, used = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - begun
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, process.args)
    summary = json.loads((out / 'summary.json').read_text(encoding='utf-8'))
    cpu_s = used.ru_utime + used.ru_stime
    return {
        'gb': recording.stat().st_size / 1e9,
        'recording_s': facts['seconds'],
        'sweeps': summary['sweeps'],
        'points_per_sweep': facts['sample']['points_per_sweep'],
        'boxes': summary['boxes_in'],
        'inspect_s': inspect_s,
        'seconds': seconds,
        'cpu_s': cpu_s,
        'hours_per_core_hour': facts['seconds'] / cpu_s,
        'peak_mb': used.ru_maxrss * 1024 / 1e6,
    }


def repeated(recording, target, gigabytes, copies=12):
    """Write the messages of a recording again and again, each time later."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with recording.open('rb') as source, target.open('wb') as file:
        found = list(make_reader(source).iter_messages())
        span_ns = found[-1][2].log_time - found[0][2].log_time + 10**8
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start('ros2')
        channels = {}
        for schema, channel, _ in found:
            if schema is not None and channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, number
                )
        later_ns = 0
        while file.tell() < gigabytes * 1e9:
            for schema, channel, message in found:
                data = _later(message.data, schema.name, later_ns) if schema else message.data
                if schema is not None and schema.name.endswith('/PointCloud2'):
                    data = _enlarged(store, data, schema.name, copies)
                when = message.log_time + later_ns
                writer.add_message(channels[channel.topic], when, data, when)
            later_ns += span_ns
        writer.finish()


def _later(data, kind, later_ns):
    """Return a message with a later stamp: the first 8 bytes of its header in CDR."""
    first = 8 if kind.endswith('/TFMessage') else 4  # behind the length of its sequence
    seconds, rest = np.frombuffer(data, '<u4', 2, first).tolist()
    stamp_ns = seconds * 10**9 + rest + later_ns
    stamp = np.array(divmod(stamp_ns, 10**9), '<u4').tobytes()
    return data[:first] + stamp + data[first + 8 :]


def _enlarged(store, data, kind, copies):
    """Return a cloud that has its points several times."""
    cloud = store.deserialize_cdr(data, kind)
    cloud.data = np.tile(cloud.data, copies)
    cloud.width *= copies
    cloud.row_step *= copies
    return bytes(store.serialize_cdr(cloud, kind))
