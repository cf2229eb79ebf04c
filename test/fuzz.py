"""
Mutated recordings, messages, label files and settings: each is read, or refused with an error.

Not part of the suite, which has some hundred mutants:

    .venv/bin/python test/fuzz.py --mutants 50000 --out fuzz.json

Hypothesis draws the mutations: one to three edits, so that a failure is small without shrinking,
which takes minutes. A mutant fails if it raises anything but a BoxregError, takes more than
`MAX_SECONDS`, or needs more than `MAX_BYTES`. The first failure of a target ends it.

"""

import argparse
from collections import Counter
from contextlib import contextmanager
from dataclasses import asdict
import json
from pathlib import Path
import resource
import signal
import sys
from tempfile import TemporaryDirectory
import time

from boxreg_ros.config import Config
from boxreg_ros.errors import BoxregError
from boxreg_ros.io.items import Wanted
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.storage.record import Record
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.labels import frames_of
from boxreg_ros.offline.relabel import relabel
from boxreg_ros.offline.request import Request
from hypothesis import given, HealthCheck, Phase, seed, settings, strategies
from mcap.writer import CompressionType
from mcap_files import rewritten
import numpy as np
from ros_messages import Drive
import yaml

MAX_SECONDS = 10.0
"""CPU time; a whole recording of three sweeps takes 0.05 s."""
MAX_WAIT = 120.0
"""Time in which nothing may be waited for [s]; a busy machine gives a process a tenth of it."""
MAX_BYTES = 4 * 2**30
"""Address space of the process; the libraries alone map 2 GB."""
VALUES = (b'\0', b'\x01', b'\x7f', b'\x80', b'\xff', b'\xff' * 4, b'\0' * 8, b'\xff' * 8, b'%n')
EDIT = strategies.tuples(
    strategies.sampled_from(
        ('set', 'set', 'flip', 'flip', 'insert', 'delete', 'cut', 'copy', 'nest')
    ),
    strategies.floats(0, 1),
    strategies.integers(0, 255),
)
EDITS = strategies.lists(EDIT, min_size=1, max_size=3)


def mutated(data, edits):
    """Return bytes with edits applied; places are fractions of the length."""
    changed = bytearray(data)
    for kind, place, number in edits:
        at = int(place * max(len(changed) - 1, 0))
        if kind == 'set':
            value = VALUES[number % len(VALUES)]
            changed[at : at + len(value)] = value
        elif kind == 'flip' and changed:
            changed[at] ^= 1 << number % 8
        elif kind == 'insert':
            changed[at:at] = bytes([number]) * (1 + number)
        elif kind == 'delete':
            del changed[at : at + 1 + number]
        elif kind == 'cut':
            del changed[at:]
        elif kind == 'copy':
            changed[at:at] = changed[: 16 * number]
        elif kind == 'nest':  # deeper than parsers can go
            changed[at:at] = b'[{'[number % 2 :][:1] * 5000
    return bytes(changed)


@contextmanager
def limited():
    """Raise TimeoutError in a block that takes `MAX_SECONDS` of CPU time, or `MAX_WAIT`."""

    def end(*_):
        raise TimeoutError(f'more than {MAX_SECONDS} s of CPU time, or {MAX_WAIT} s')

    timers = {signal.ITIMER_PROF: MAX_SECONDS, signal.ITIMER_REAL: MAX_WAIT}
    for number in (signal.SIGPROF, signal.SIGALRM):
        signal.signal(number, end)
    for timer, seconds in timers.items():
        signal.setitimer(timer, seconds)
    try:
        yield
    finally:
        for timer in timers:
            signal.setitimer(timer, 0)


def read_recording(path):
    """Read all items of a recording."""
    tree = TransformTree()
    with Recording([path]) as recording:
        recording.choose_fixed_frame(tree)
        for _ in recording.items(tree, Wanted(intensities=True)):
            pass
        recording.check_readable()


def recordings(folder):
    """Yield name, bytes and a function that reads a mutant, of each kind of recording."""
    drive = Drive(sweeps=3, boxes='markers')
    plain = drive.write(folder / 'plain')
    files = {'sqlite3': next(drive.write(folder / 'database', 'sqlite3').glob('*.db3'))}
    for kind in (CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD):
        target = folder / f'{kind.name}.mcap'
        files[f'mcap {kind.name}'] = rewritten(plain, target, compression=kind)
    ros1 = Drive(sweeps=3, boxes='markers', ros1=True)
    files['rosbag1'] = ros1.write(folder / 'ros1', 'rosbag1')
    for name, file in files.items():
        mutant = folder / f'mutant{file.suffix}'

        def read(data, mutant=mutant):
            mutant.write_bytes(data)
            read_recording(mutant)

        yield name, file.read_bytes(), read


def messages(folder):
    """Yield topic, bytes and a function that decodes a mutant, of each topic."""
    recording = Recording([Drive(sweeps=1).write(folder / 'messages')])
    recording.__enter__()
    for topic in ('/points', '/boxes', '/tf'):
        record = next(recording._read({topic}))

        def read(data, record=record):
            tampered = Record(record.connection, record.received_ns, data)
            if record.connection.topic == '/tf':
                recording._follow(TransformTree(), tampered)
            else:
                recording._contents.item(tampered, (), with_intensities=True)

        yield f'message {topic}', bytes(record.data), read


def labels(folder):
    """Yield format, bytes and a function that reads a mutant, of formats of one text file."""
    path = Drive(sweeps=6).write(folder / 'labelled')
    formats = ('csv', 'openlabel', 'datumaro', 'supervisely', 'tracklets', 'mcap')
    out = folder / 'labels'
    config = Config(min_observations=3)
    relabel(Request((path,), formats=formats, config=config), out)
    for name in formats:
        place = out / (
            'boxes.csv' if name == 'csv' else 'overlay.mcap' if name == 'mcap' else name
        )
        files = sorted(p for p in [place, *place.glob('**/*')] if p.is_file())
        for file in files[:2]:
            data = file.read_bytes()

            def read(changed, file=file, place=place, name=name, data=data):
                file.write_bytes(changed)
                try:
                    for _ in frames_of(name, place):
                        pass
                finally:
                    file.write_bytes(data)

            yield f'labels {name}/{file.name}', data, read


def configurations(folder):
    """Yield name, bytes and a function that reads a mutant of a settings file."""
    path = folder / 'config.yaml'

    def read(data):
        path.write_bytes(data)
        Config.from_yaml(path)

    yield 'config', yaml.safe_dump(asdict(Config())).encode(), read


def run(name, data, read, count, start):
    """Read `count` mutants; return how many were read, refused, and their times."""
    outcome = Counter()
    slowest = 0.0, []

    @seed(start)
    @settings(
        max_examples=count, deadline=None, database=None,
        suppress_health_check=list(HealthCheck), print_blob=False, phases=[Phase.generate],
        report_multiple_bugs=False,
    )  # fmt: skip
    @given(EDITS)
    def check(edits):
        nonlocal slowest
        begun = time.process_time()
        try:
            with limited():
                read(mutated(data, edits))
            outcome['read'] += 1
        except BoxregError as error:
            assert '\n' not in str(error).strip(), f'several lines: {error}'
            outcome['refused'] += 1
        seconds = time.process_time() - begun
        slowest = max(slowest, (seconds, edits))
        # The error may have been raised where it is only printed, as in a collection of garbage.
        assert seconds < MAX_SECONDS, f'{seconds} s'

    failure = ''
    try:
        check()
    except Exception as error:
        notes = ' '.join(getattr(error, '__notes__', ()))
        failure = f'{type(error).__name__}: {error} {notes}'
    seconds, edits = slowest
    return {
        'name': name, **outcome,
        'slowest_s': round(seconds, 3), 'slowest': edits, 'failure': failure,
    }  # fmt: skip


def main():
    """Run all targets, print one line each, and return 1 if one has failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--mutants', type=int, default=50_000)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--only', default='', help='begin of the names of the targets')
    parser.add_argument('--out', type=Path)
    args = parser.parse_args()
    np.seterr(all='ignore')
    resource.setrlimit(resource.RLIMIT_AS, (MAX_BYTES, MAX_BYTES))
    rows = []
    with TemporaryDirectory() as text:
        folder = Path(text)
        kinds = (recordings, messages, labels, configurations)
        targets = [target for kind in kinds for target in kind(folder)]
        share = -(-args.mutants // len(targets))
        targets = [target for target in targets if target[0].startswith(args.only)]
        for name, data, read in targets:
            rows.append(run(name, data, read, share, args.seed))
            print(rows[-1], flush=True)
    if args.out is not None:
        args.out.write_text(json.dumps(rows, indent=1) + '\n')
    return int(any(row['failure'] for row in rows))


if __name__ == '__main__':
    sys.exit(main())
