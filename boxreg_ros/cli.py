"""`boxreg`: one command, its subcommands imported only when used."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from io import TextIOWrapper
import os
import signal
import sys
from threading import current_thread, main_thread
from types import ModuleType
from typing import Any, NamedTuple

from boxreg_ros import __version__
from boxreg_ros.allocation import keep_freed_memory
from boxreg_ros.errors import BoxregError, ConfigError


class Command(NamedTuple):
    """Where a subcommand is implemented, and what it does."""

    module: str
    summary: str


COMMANDS = {
    'relabel': Command('offline.relabel', 'refine the boxes of recordings and write label files'),
    'convert': Command('offline.convert', 'write labels of one format in others'),
    'formats': Command('offline.formats', 'list the label formats and their conventions'),
    'evaluate': Command('offline.evaluate', 'compare boxes with true boxes'),
    'calibrate': Command('offline.calibrate', 'learn the annotation rule from labelled tracks'),
    'simulate': Command('simulation.simulate', 'make a recording with known truth'),
    'bench': Command('bench.main', 'measure accuracy and speed'),
    'node': Command('live.main', 'run the live node (where there is no ros2 run)'),
}
DONE, FAILED, WRONG_USAGE, SIGNALLED = 0, 1, 2, 128
ENDING = signal.SIGTERM, signal.SIGHUP


class _Ended(BaseException):
    """One of `ENDING` came."""


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run a subcommand and return the exit status.

    0 done, 1 the data or the run failed, 2 wrong usage, 128 and the number of the signal that
    ended it; failures are told in one line on stderr.

    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    is_debug = '--debug' in arguments
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # names of files may be more than it can show
            stream.reconfigure(errors='backslashreplace')
    try:
        with _signals(arguments):
            status = _run(arguments)
        sys.stdout.flush()
        return status
    except BrokenPipeError:
        # Whoever read the output has seen enough; python must not complain when it flushes.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except KeyboardInterrupt:
        return _fail('interrupted; nothing was written', SIGNALLED + signal.SIGINT)
    except _Ended as end:
        name = signal.Signals(end.args[0]).name
        return _fail(f'ended by {name}; nothing was written', SIGNALLED + end.args[0])
    except (BoxregError, OSError) as error:
        if is_debug:
            raise
        return _fail(str(error), WRONG_USAGE if isinstance(error, ConfigError) else FAILED)
    except Exception as error:
        if is_debug:
            raise
        text = f'{type(error).__name__}: {error}'
        return _fail(f'unexpected {text} (--debug shows where)', FAILED)


@contextmanager
def _signals(arguments: list[str]) -> Iterator[None]:
    """Let the signals of `ENDING` end a run as Ctrl-C does; those of a node are its own matter."""

    def end(number: int, _: Any) -> None:
        for one in ours:  # what is cleaned up after the first is not left to a second
            signal.signal(one, signal.SIG_IGN)
        raise _Ended(number)

    before = {one: signal.getsignal(one) for one in ENDING}
    ours = [one for one, handler in before.items() if handler == signal.SIG_DFL]  # no nohup
    if arguments[:1] == ['node'] or current_thread() is not main_thread():
        ours = []
    try:
        for one in ours:
            signal.signal(one, end)
        yield
    finally:
        for one in ours:
            signal.signal(one, before[one])


def _run(arguments: list[str]) -> int:
    """Parse and hand over to the module of the subcommand."""
    command = next((item for item in arguments if not item.startswith('-')), None)
    if command == 'node' and arguments[0] == 'node':  # its arguments are those of any ROS node
        return int(_module('node').main(arguments[1:]) or DONE)
    args = parser(command).parse_args(arguments)
    keep_freed_memory()
    return int(_module(args.command).run(args))


def _module(command: str) -> ModuleType:
    return import_module(f'boxreg_ros.{COMMANDS[command].module}')


def parser(command: str | None) -> argparse.ArgumentParser:
    """Return the parser of `boxreg`, with the options of one `command` alone."""
    whole = argparse.ArgumentParser(
        'boxreg', description='Register tracked 3D boxes to point clouds.'
    )
    whole.add_argument('--debug', action='store_true', help=argparse.SUPPRESS)
    whole.add_argument('--version', action='version', version=f'boxreg {__version__}')
    subparsers = whole.add_subparsers(dest='command', required=True, metavar='COMMAND')
    for name, (_, summary) in COMMANDS.items():
        subparser = subparsers.add_parser(name, help=summary, description=f'{summary}.')
        subparser.add_argument('--debug', action='store_true', help=argparse.SUPPRESS)
        if name == command and name != 'node':
            _module(name).add_arguments(subparser)
    return whole


def _fail(message: str, status: int) -> int:
    with suppress(OSError):  # a terminal that is gone
        print(f'boxreg: {" ".join(message.split())}', file=sys.stderr)
    return status


if __name__ == '__main__':
    sys.exit(main())
