"""`boxreg relabel`: its command line. Slow modules are imported when it runs."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
import os
from pathlib import Path
import sys
from typing import Self, TYPE_CHECKING

from boxreg_ros.io.compilation import COMPILING
from boxreg_ros.io.steps import advanced, PROGRESS
from boxreg_ros.offline.arguments import (
    add_options,
    add_recordings,
    request_from,
    Settings,
    values_of,
)
from boxreg_ros.offline.progress import Progress
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.result_folder import CONFIG, spare, SUMMARY
from boxreg_ros.options import option

if TYPE_CHECKING:
    from boxreg_ros.offline.summary import Summary

DONE = 0
FAILED = 1
BAR = '{percentage:3.0f}% {bar} {n:.0f}/{total:.0f} s of the recording, {remaining} left {desc}'


def _part(text: str) -> float:
    """Return a number from 0 to 1."""
    try:
        part = float(text)
    except ValueError:
        part = -1.0
    if not 0 <= part <= 1:
        raise argparse.ArgumentTypeError(f'expected a part from 0 to 1, got {text!r}')
    return part


@dataclass(frozen=True, slots=True)
class Demands:
    """The options that decide on the exit status of a run that has written its results."""

    strict: bool = option(
        False, 'exit with status 1 if a part of the recording could not be read, or has no stamps'
    )
    fail_under: float = option(
        0.0,
        'exit with 1, the results kept, if a smaller part of the boxes is refined, as in 0.9',
        metavar='PART',
        parse=_part,
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `boxreg relabel`."""
    add_recordings(parser)
    add_run_arguments(parser)


def add_run_arguments(parser: argparse.ArgumentParser, out: Path | None = None) -> None:
    """Add the options of a run; `out` is the default of its result folder."""
    add_options(parser, Request)
    add_options(parser, Settings)
    shown = '' if out is None else ' (default: %(default)s)'
    parser.add_argument(
        '-o', '--out', type=Path, required=out is None, default=out,
        help=f'result folder; it is written completely or not at all{shown}',
    )  # fmt: skip
    add_options(parser, Demands)


def arguments_of(words: Sequence[str]) -> argparse.Namespace:
    """Return the parsed arguments of `boxreg relabel`."""
    parser = argparse.ArgumentParser('boxreg relabel')
    add_arguments(parser)
    args = parser.parse_args(words)
    args.arguments = ['relabel', *words]
    return args


def run(args: argparse.Namespace) -> int:
    """
    Relabel, print one closing line, and return the exit status.

    Status 1 also if the recording has boxes and none was refined, or a decision could not be used;
    the result is kept.

    """
    from boxreg_ros.offline.notes import closing_line, next_line, notes
    from boxreg_ros.offline.relabel import relabel

    request = request_from(args)
    demands = Demands(**values_of(args, Demands))
    if args.config != args.out / CONFIG:  # this one is written again with the same content
        spare(args.out, [args.config])
    with ProgressBar() as bar:
        summary = relabel(request, args.out, bar)
    if args.truth and not args.report:
        print(f'boxreg: --truth {args.truth}: not used without --report', file=sys.stderr)
    for note in notes(summary):
        print(f'boxreg: {note}', file=sys.stderr)
    print(closing_line(summary, args.out))
    if PROGRESS not in os.environ:  # a person has started it
        print(next_line(args.out, request.report))
    problem = unmet(summary, demands)
    if problem:
        print(f'boxreg: {problem}', file=sys.stderr)
    return FAILED if problem or summary.has_failed else DONE


def unmet(summary: Summary, demands: Demands) -> str:
    """Return which demand the results of a run do not meet; empty if they meet all."""
    if summary.unused_decisions and not summary.is_part:
        from boxreg_ros.offline.notes import unused_line

        return unused_line(summary.unused_decisions)
    if summary.part_refined < demands.fail_under:
        return (
            f'--fail-under: expected at least {demands.fail_under:.1%} of the boxes refined, got '
            f'{summary.num_refined:,} of {summary.boxes_in:,}; the results are kept, see '
            f'"reasons" in {SUMMARY}'
        )
    if demands.strict and not summary.is_complete:
        return (
            '--strict: expected a recording that is read whole, got one with parts left out; the '
            f'results are kept, see "damage" and "dropped" in {SUMMARY}'
        )
    return ''


class ProgressBar(Progress):
    """
    A bar on stderr, where that is a terminal; use as a context manager.

    Elsewhere only that the solver is compiled is said, once: it takes longer than most runs.

    """

    def __enter__(self) -> Self:
        """Show the bar."""
        from tqdm import tqdm

        tqdm.monitor_interval = 0  # no thread beside this one, which forks
        is_hidden = not sys.stderr.isatty()
        self._done = 0.0
        self._is_silent = is_hidden
        self._bar = tqdm(total=1.0, unit='s', disable=is_hidden, leave=False, bar_format=BAR)
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the bar."""
        self._bar.close()

    def show(self, done: float, total: float) -> None:
        """Show the progress of a run [s of the recording]."""
        self._bar.set_description_str('', refresh=False)
        self._bar.total = total
        if done > self._done:
            self._bar.update(done - self._done)
            self._done = done
            advanced(done, total)

    def announce(self, activity: str) -> None:
        """Show the activity that the run waits for beside the bar."""
        if self._is_silent and activity == COMPILING:
            self._is_silent = False
            print(f'boxreg: {activity}', file=sys.stderr)
        self._bar.set_description_str(f'({activity})')
