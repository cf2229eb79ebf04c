"""`boxreg`: the command line. The module of a subcommand is imported when that is used."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from contextlib import suppress
from difflib import get_close_matches
from importlib import import_module
from io import TextIOWrapper
import os
import re
import signal
import sys
from types import FrameType, ModuleType
from typing import Any, NamedTuple, NoReturn

from boxreg_ros import __version__
from boxreg_ros.allocation import collect_rarely, keep_freed_memory, start_no_threads
from boxreg_ros.errors import ConfigError, description_of


class Command(NamedTuple):
    """A subcommand: the module with its `add_arguments` and `run`, and its help text."""

    module: str
    summary: str


COMMANDS = {
    'relabel': Command(
        'offline.relabel_command', 'refine the boxes of recordings and write label files'
    ),
    'follow': Command(
        'offline.follow_command', 'follow objects from one box or a few of each to whole tracks'
    ),
    'inspect': Command(
        'offline.inspect', 'show what is in a recording, and the relabel command to run'
    ),
    'batch': Command('offline.batch', 'relabel many recordings with several workers'),
    'convert': Command('offline.convert', 'convert label files to other formats'),
    'formats': Command('offline.formats', 'list the label formats and their conventions'),
    'review': Command(
        'offline.review_command', 'look at a result in the browser, decide and correct'
    ),
    'evaluate': Command('offline.evaluate', 'compare boxes with true boxes'),
    'check': Command('offline.check', 'check labels against rules'),
    'calibrate': Command(
        'offline.calibrate', 'estimate the labelling margins from labelled tracks'
    ),
    'simulate': Command('simulation.simulate', 'make a recording with known true boxes'),
    'compile': Command('offline.compile_command', 'compile the method now, for images and robots'),
    'node': Command('live.main', 'run the live node (where there is no ros2 run)'),
}
DONE = 0
FAILED = 1
WRONG_USAGE = 2
SIGNALLED = 128
"""Added to the number of the signal that ended a run, as shells do."""
ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
SOON = 0.01
"""Longer than a destructor or a callback from C, and nothing to wait for at a terminal [s]."""


class _Ended(KeyboardInterrupt):
    """A signal ends the run, as an error does, so that files are removed."""

    def __init__(self, number: int) -> None:
        self.number = number


def command() -> NoReturn:
    """Run a subcommand and end the process with its exit status."""
    if sys.argv[1:2] != ['node']:  # the node handles signals itself
        for number in ENDING_SIGNALS:
            if signal.getsignal(number) != signal.SIG_IGN:  # nohup ignores SIGHUP
                signal.signal(number, _end)
        sys.unraisablehook = _end_again
    sys.exit(main())


def _end(number: int, frame: FrameType | None) -> None:
    """
    End the run. A second signal does not stop that, but for one from the keyboard.

    An import goes on: extension modules may abort the process by what is raised within.

    """
    for one in ENDING_SIGNALS[1:]:
        signal.signal(one, signal.SIG_IGN)
    while frame is not None:
        if frame.f_code.co_filename == '<frozen importlib._bootstrap>':
            return _end_soon(number)
        frame = frame.f_back
    raise _Ended(number)


def _end_soon(number: int) -> None:
    """End the run from what is executed a moment later."""
    signal.signal(signal.SIGALRM, lambda _, frame: _end(number, frame))
    signal.setitimer(signal.ITIMER_REAL, SOON)


def _end_again(lost: sys.UnraisableHookArgs) -> None:
    """End the run once more if that came within a destructor or a callback from C: it is lost."""
    if isinstance(lost.exc_value, _Ended):
        _end_soon(lost.exc_value.number)
    else:
        sys.__unraisablehook__(lost)


def _signal_in(error: BaseException | None) -> int | None:
    """Return the signal that ended the run, of which a call from C may have made another error."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return None if error is None else getattr(error, 'number', signal.SIGINT)


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, and propose the choice that may have been meant."""

    def error(self, message: str) -> NoReturn:
        """Print the error and exit."""
        self.exit(WRONG_USAGE, f'{self.prog}: {message}; {self.prog} --help lists all options\n')

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse a value that is none of the choices."""
        choices = [*action.choices] if action.choices is not None else [value]
        if value not in choices:
            names = ', '.join(map(str, choices))
            proposal = _proposal([str(value)], map(str, choices))
            raise argparse.ArgumentError(
                action, f'expected one of {names}, got {value!r}{proposal}'
            )


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run a subcommand and return the exit status.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments; those of the process by default.

    Returns
    -------
    status : int
        0 done, 1 the data or the run failed, 2 wrong usage, 128 plus the number of the signal
        that ended the run. A failure is reported in one line on stderr.

    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    is_debug = '--debug' in arguments
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # file names may have characters it cannot encode
            stream.reconfigure(errors='backslashreplace')
    try:
        status = _run(arguments)
        sys.stdout.flush()
        return status
    except BrokenPipeError:
        # The reader of the output has closed it. Python would fail again when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except (Exception, KeyboardInterrupt) as error:
        number = _signal_in(error)
        if number is not None:
            return _fail(_ended_by(number, arguments), SIGNALLED + number)
        if is_debug:
            raise
        status = WRONG_USAGE if isinstance(error, ConfigError) else FAILED
        return _fail(description_of(error), status)


def _ended_by(number: int, arguments: list[str]) -> str:
    """Return the message of a run that a signal has ended."""
    cause = 'interrupted' if number == signal.SIGINT else f'ended by {signal.Signals(number).name}'
    if arguments[:1] == ['batch']:
        return f'{cause}; the drives that are done are kept, the same command goes on'
    return f'{cause}; nothing was written'


def _run(arguments: list[str]) -> int:
    """Parse the arguments and run the subcommand."""
    start_no_threads()
    command = next((item for item in arguments if not item.startswith('-')), None)
    if command == 'node' and arguments[0] == 'node':  # takes the arguments of a ROS node
        return int(_module('node').main(arguments[1:]) or DONE)
    whole = parser(command)
    if not arguments:
        whole.print_help()
        return DONE
    if command is not None and command not in COMMANDS:
        names = ', '.join(COMMANDS)
        proposal = _proposal([command], COMMANDS)
        whole.error(f'COMMAND: expected one of {names}, got {command!r}{proposal}')
    args, unknown = whole.parse_known_args(arguments)
    if unknown:
        options = re.findall(r'--[a-z-]+', args.subparser.format_usage())
        key = unknown[0].removeprefix('--').partition('=')[0]
        if '--set' in options and key in _setting_names():
            proposal = f'; did you mean --set {key}=VALUE?'
        else:
            proposal = _proposal(unknown, options)
        args.subparser.error(f'unrecognized arguments: {" ".join(unknown)}{proposal}')
    args.arguments = arguments
    keep_freed_memory()
    collect_rarely()
    return int(_module(args.command).run(args))


def _proposal(unknown: Iterable[str], known: Iterable[str]) -> str:
    """Return '; did you mean ...?' with the known word most similar to an unknown one."""
    names = list(known)
    for word in unknown:
        similar = get_close_matches(word.partition('=')[0], names, 1, cutoff=0.7)
        if similar:
            return f'; did you mean {similar[0]}?'
    return ''


def _setting_names() -> set[str]:
    """Return the names of all settings; only an error needs them."""
    from boxreg_ros.config import settings

    return {setting.name for setting in settings()}


def _module(command: str) -> ModuleType:
    """Return the module of a subcommand."""
    return import_module(f'boxreg_ros.{COMMANDS[command].module}')


def parser(command: str | None) -> argparse.ArgumentParser:
    """Return the parser of `boxreg`; only the subparser of `command` has its options."""
    whole = _Parser('boxreg', description='Register tracked 3D boxes to point clouds.')
    whole.add_argument('--debug', action='store_true', help=argparse.SUPPRESS)
    whole.add_argument('--version', action='version', version=f'boxreg {__version__}')
    subparsers = whole.add_subparsers(dest='command', required=True, metavar='COMMAND')
    for name, (_, summary) in COMMANDS.items():
        subparser = subparsers.add_parser(name, help=summary, description=f'{summary}.')
        subparser.set_defaults(subparser=subparser)
        subparser.add_argument('--debug', action='store_true', help=argparse.SUPPRESS)
        if name == command and name != 'node':
            _module(name).add_arguments(subparser)
    return whole


def _fail(message: str, status: int) -> int:
    """Print a message in one line on stderr and return the exit status."""
    with suppress(OSError):  # the terminal is closed
        print(f'boxreg: {" ".join(message.split())}', file=sys.stderr)
    return status


if __name__ == '__main__':
    command()
