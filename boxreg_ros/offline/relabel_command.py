"""`boxreg relabel`: its command line. Slow modules are imported when it runs."""

from __future__ import annotations

import argparse
from pathlib import Path
import sys
from typing import Any, Self, TYPE_CHECKING

from boxreg_ros.config import COMPLETE_STEPS
from boxreg_ros.offline.arguments import (
    add_label_arguments,
    add_recording_arguments,
    config_from,
    convention_from,
    lidars_from,
)
from boxreg_ros.offline.progress import Progress
from boxreg_ros.offline.result_folder import CONFIG, earlier_summary, spare, SUMMARY

if TYPE_CHECKING:
    from boxreg_ros.offline.request import Request

DONE = 0
FAILED = 1
BAR = '{percentage:3.0f}% {bar} {n:.0f}/{total:.0f} s of the recording, {remaining} left {desc}'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `boxreg relabel`."""
    add_recording_arguments(parser)
    _add_input_arguments(parser)
    _add_track_arguments(parser)
    _add_result_arguments(parser)
    _add_run_arguments(parser)


def _add_input_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of inputs beside the recording, and of the part that is read."""
    parser.add_argument(
        '--labels', type=_labels_argument, metavar='FORMAT:PATH',
        help='read the boxes from label files instead of a topic',
    )  # fmt: skip
    add_label_arguments(parser)
    parser.add_argument(
        '--fixed-frame', metavar='FRAME',
        help='frame to refine in (default: topmost frame that the frame of the clouds moves in)',
    )  # fmt: skip
    parser.add_argument(
        '--start', type=float, metavar='S',
        help='start of the part to refine, from the beginning of the recording [s]',
    )  # fmt: skip
    parser.add_argument(
        '--end', type=float, metavar='S',
        help='end of the part to refine, from the beginning of the recording [s]',
    )  # fmt: skip


def _add_track_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the steps on tracks beside their refinement."""
    parser.add_argument(
        '--associate', action='store_true',
        help='replace the track ids of the input: associate boxes over time',
    )  # fmt: skip
    parser.add_argument(
        '--complete', action='store_true',
        help='complete the tracks: join fragments, reject ghosts, add missing boxes (sets '
        'complete.stitch, static, prune, fill and extend)',
    )  # fmt: skip
    parser.add_argument('--bridge', nargs='?', action=_Removed, help=argparse.SUPPRESS)
    parser.add_argument(
        '--decisions', type=Path, metavar='FILE',
        help='decisions.csv of boxreg review: keep rejected tracks as input, hold pinned boxes',
    )  # fmt: skip


def _add_result_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the output."""
    parser.add_argument(
        '-o', '--out', type=Path, required=True,
        help='result folder; it is written completely or not at all',
    )  # fmt: skip
    parser.add_argument(
        '--formats', default='csv,openlabel', metavar='NAME,...', type=_names,
        help='label formats to write, see `boxreg formats`; csv is always written '
        '(default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--report', action='store_true',
        help='also write report.html: every track before and after, to look at in a browser',
    )  # fmt: skip
    parser.add_argument(
        '--truth', type=Path, metavar='FILE',
        help='with --report, true boxes that it shows: CSV with the columns of boxes.csv, or a '
        'scene of a data set',
    )  # fmt: skip


def _add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of resuming, of the exit status and of processes."""
    parser.add_argument(
        '--resume', action='store_true',
        help='go on with an interrupted run of the same request, files and settings; do nothing '
        'if OUT holds its result',
    )  # fmt: skip
    parser.add_argument(
        '--strict', action='store_true',
        help='exit with status 1 if a part of the recording could not be read, or has no stamps',
    )  # fmt: skip
    parser.add_argument(
        '--fail-under', type=_part, default=0.0, metavar='PART',
        help='exit with 1, the results kept, if a smaller part of the boxes is refined, as in 0.9',
    )  # fmt: skip
    parser.add_argument(
        '--workers', type=int, metavar='N',
        help='CPU cores of the solver (sets solver.threads); with 1 the run is one process',
    )  # fmt: skip


class _Removed(argparse.Action):
    """An option of earlier versions: its error names what replaces it."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        _namespace: argparse.Namespace,
        _values: object,
        option_string: str | None = None,
    ) -> None:
        """Refuse the option."""
        parser.error(
            f'{option_string}: was removed; use --complete, or for missing boxes alone '
            f'--set complete.fill=true --set complete.fill_gap=SECONDS'
        )


def _part(text: str) -> float:
    """Return a number from 0 to 1."""
    try:
        part = float(text)
    except ValueError:
        part = -1.0
    if not 0 <= part <= 1:
        raise argparse.ArgumentTypeError(f'expected a part from 0 to 1, got {text!r}')
    return part


def _names(text: str) -> tuple[str, ...]:
    """Return the names of a list with commas."""
    return tuple(name.strip() for name in text.split(','))


def _labels_argument(text: str) -> tuple[str, Path]:
    """Return format and path of ``FORMAT:PATH``."""
    name, colon, path = text.partition(':')
    if not name or not colon or not path:
        raise argparse.ArgumentTypeError(f'expected FORMAT:PATH, got {text!r}')
    return name, Path(path)


def run(args: argparse.Namespace) -> int:
    """
    Relabel, print one closing line, and return the exit status.

    Status 1 also if the recording has boxes and none was refined; the result is kept.

    """
    from boxreg_ros.offline.relabel import closing_line, notes, relabel

    request = _request(args)
    earlier = earlier_summary(args.out)
    if args.resume and earlier and _is_complete(earlier, request, args.out):
        print(f'{args.out}: up to date, made from the same files with the same settings')
        return _status(earlier, args.fail_under, args.strict)
    if args.config != args.out / CONFIG:  # this one is written again with the same content
        spare(args.out, [args.config])
    with ProgressBar() as bar:
        summary = relabel(request, args.out, bar, args.resume)
    if args.truth and not args.report:
        print(f'boxreg: --truth {args.truth}: not used without --report', file=sys.stderr)
    for note in notes(summary):
        print(f'boxreg: {note}', file=sys.stderr)
    print(closing_line(summary, args.out))
    return _status(summary, args.fail_under, args.strict)


def _status(summary: dict[str, Any], fail_under: float, is_strict: bool) -> int:
    """Return the exit status of a run; say on stderr if it misses ``--fail-under``."""
    from boxreg_ros.offline.relabel import has_failed, is_complete, num_refined, part_refined

    if part_refined(summary) < fail_under:
        print(
            f'boxreg: --fail-under: expected at least {fail_under:.1%} of the boxes refined, got '
            f'{num_refined(summary):,} of {summary["boxes_in"]:,}; the results are kept, see '
            f'"reasons" in {SUMMARY}',
            file=sys.stderr,
        )
        return FAILED
    return FAILED if has_failed(summary) or (is_strict and not is_complete(summary)) else DONE


def _request(args: argparse.Namespace) -> Request:
    """Return the request that the arguments describe."""
    from boxreg_ros.labels import Options
    from boxreg_ros.offline.request import Request

    config = config_from(args)
    if args.complete:
        config = config.updated({f'complete.{step}': True for step in COMPLETE_STEPS})
    if args.workers is not None:
        config = config.updated({'solver.threads': args.workers})
    return Request(
        recordings=tuple(args.recordings),
        lidars=lidars_from(args),
        boxes=args.boxes,
        odometry=args.odometry,
        fixed_frame=args.fixed_frame,
        formats=args.formats,
        start=args.start,
        end=args.end,
        config=config,
        options=Options(args.with_points, args.camera, args.swap_axes),
        labels=args.labels,
        label_frame=args.label_frame,
        convention=convention_from(args, args.associate),
        report=args.report,
        truth=args.truth,
        decisions=args.decisions,
        command=tuple(args.arguments),
    )


def _is_complete(earlier: dict[str, Any], request: Request, out: Path) -> bool:
    """Return whether `out` holds the result of the same request, with all its files."""
    from boxreg_ros.io.storage.urls import url_of
    from boxreg_ros.labels import is_written
    from boxreg_ros.review.report import REPORT

    if earlier['fingerprint'] != request.fingerprint():
        return False
    if url_of(out) is not None:
        return True  # its summary is written last
    if request.report and not (out / REPORT).exists():
        return False
    return all(is_written(name, out) for name in request.all_formats)


class ProgressBar(Progress):
    """A bar on stderr, where that is a terminal; use as a context manager."""

    def __enter__(self) -> Self:
        """Show the bar."""
        from tqdm import tqdm

        is_hidden = not sys.stderr.isatty()
        self._bar = tqdm(total=1.0, unit='s', disable=is_hidden, leave=False, bar_format=BAR)
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the bar."""
        self._bar.close()

    def show(self, done: float, total: float) -> None:
        """Show the progress of a run [s of the recording]."""
        self._bar.set_description_str('', refresh=False)
        self._bar.total = total
        self._bar.update(max(0.0, done - self._bar.n))

    def announce(self, activity: str) -> None:
        """Show the activity that the run waits for beside the bar."""
        self._bar.set_description_str(f'({activity})')
