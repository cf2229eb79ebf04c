"""
`boxreg relabel`: recordings in, refined boxes as label files out.

Every box of the recording is written exactly once: refined, or as it was with the reason. Boxes
that are missing are put in where that is asked for.

"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict
from importlib.metadata import version
import json
from pathlib import Path
import platform
import sys
from typing import Any

from boxreg_ros import __version__
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.io.session import register
from boxreg_ros.labels import is_written, Options
from boxreg_ros.offline.arguments import add_recording_arguments, config_from, convention_from
from boxreg_ros.offline.labelled_recording import add_label_arguments
from boxreg_ros.offline.output import Sink
from boxreg_ros.offline.reader import ReadAhead, reader
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.result_folder import CONFIG, earlier_summary, spare, SUMMARY, whole_folder
from boxreg_ros.offline.stopwatch import Stopwatch
from boxreg_ros.offline.workers import solver
from boxreg_ros.review.report import REPORT, write_report
from boxreg_ros.structures import BoxArray, INTERPOLATED, KEPT, REFINED, Sweep
import yaml

UNUSED = 'sweep_', 'boxes_'  # reasons of what was not used begin so
BAR = '{percentage:3.0f}% {bar} {n:.0f}/{total:.0f} s of the recording, {remaining} left'

NO_BOXES = 'no boxes in this part of the recording: nothing was refined; see --start and --end'

Progress = Callable[[float, float], None]


def relabel(request: Request, out: Path, progress: Progress | None = None) -> dict[str, Any]:
    """
    Refine all boxes of a recording and write ``boxes.csv``, ``summary.json`` and the rest.

    Parameters
    ----------
    request : Request
        What to read, and how.
    out : Path
        Folder of results. It appears whole or not at all; results of an earlier run are
        replaced.
    progress : callable, optional
        Called with the part of the recording that is done and all of it [s]; for a report both
        count the recording twice.

    Returns
    -------
    summary : dict
        What ``summary.json`` holds.

    Raises
    ------
    RecordingError
        If the recording lacks something, or `out` is not ours to replace.
    UnsupportedMessage
        If none of its clouds, or none of its messages of boxes, can be read.

    """
    clock = Stopwatch()
    fingerprint = request.fingerprint()  # of what is read from here on
    with solver(request.config, clock) as begin, reader(request) as peer:
        registrar = BoxRegistrar(request.config, begin)
        coming = ReadAhead(peer)
        seconds, passes = coming.source.seconds, 2 if request.report else 1
        with whole_folder(out, request.inputs()) as folder:
            with Sink(folder, request, coming.source, clock) as sink:
                for arrival in coming:
                    if progress is not None:
                        progress(arrival.seconds, passes * seconds)
                    sink.expect(arrival)
                    with clock('registrar'):
                        ready = register(registrar, arrival.moved, arrival.restarts)
                    sink.take(ready)
                with clock('registrar'):
                    ready = registrar.flush()
                sink.take(ready)
            summary = _summary(request, coming, registrar.counts, sink)
            for stage, spent in coming.findings.seconds.items():
                clock.add(stage, spent)
            summary |= {'fingerprint': fingerprint, 'seconds': clock.seconds()}
            if sink.changes is not None:
                with clock('report'):
                    line = closing_line(summary, out)
                    items, tracks = _again(request, progress), sink.changes.tracks()
                    write_report(folder / REPORT, line, summary, request.config, tracks, items)
                summary['seconds'] = clock.seconds()
            settings = yaml.safe_dump(asdict(request.config), sort_keys=False)
            (folder / CONFIG).write_text(settings, encoding='utf-8')
            (folder / SUMMARY).write_text(json.dumps(summary, indent=2) + '\n', encoding='utf-8')
    return summary


def _again(request: Request, progress: Progress | None) -> Iterator[Sweep | BoxArray]:
    """Yield the clouds and boxes of the recording once more, in the fixed frame."""
    with reader(request) as peer:
        coming = ReadAhead(peer)
        seconds = coming.source.seconds
        for arrival in coming:
            if progress is not None:
                progress(seconds + arrival.seconds, 2 * seconds)
            if arrival.moved is not None:
                yield arrival.moved


def _summary(
    request: Request, coming: ReadAhead, registered: Counter[str], sink: Sink
) -> dict[str, Any]:
    """Return all of summary.json but the timings and the fingerprint."""
    if sink.missing():
        raise RuntimeError(f'{sink.missing()} of {sink.boxes_in} boxes did not come back')
    source, found = coming.source, coming.findings
    counts = found.counts
    unused = {name: n for name, n in registered.items() if name.startswith(UNUSED)}
    unused['sweep_without_transform'] = counts['sweep_without_transform']
    unused['unreadable'] = found.unreadable
    return {
        'recordings': [str(path) for path in request.recordings],
        'topics': source.topics,
        'labels': _labels(request, found.outside),
        'fixed_frame': source.fixed_frame,
        'estimate': request.config.estimate,
        'sweeps': counts['sweeps'],
        'box_arrays': counts['box_arrays'],
        'boxes_in': sink.boxes_in,
        'boxes_out': sink.boxes_out,
        'status': dict(sink.status),
        'reasons': dict(sink.reasons.most_common()),
        'time_jumps': counts['time_jump'],
        'recorded_apart': {t: round(late, 3) for t, late in found.apart.items()},
        'heading_flips': sink.heading_flips,
        'dropped': {name: n for name, n in sorted(unused.items()) if n},
        'first_missing_transform': found.first_missing_transform,
        'first_unreadable': found.first_unreadable,
        'warning': found.warning or ('' if sink.boxes_in else NO_BOXES),
        **found.facts,
        'left_out_of_labels': sink.left_out(),
        'frames_without_cloud': sink.without_cloud,
        'versions': {'boxreg_ros': __version__, 'python': platform.python_version()}
        | {name: version(name) for name in ('torch', 'numpy', 'scipy', 'rosbags')},
    }


def _labels(request: Request, outside: int) -> dict[str, Any] | None:
    """Return where the boxes come from, if not from the recording."""
    if request.labels is None:
        return None
    name, path = request.labels
    return {'format': name, 'path': str(path), 'boxes_outside_part': outside}


def closing_line(summary: dict[str, Any], out: Path) -> str:
    """Return what was done, in one line."""
    reasons = ', '.join(f'{name} {count:,}' for name, count in summary['reasons'].items())
    status = summary['status']
    kept = f'{status.get(KEPT, 0):,} kept' + (f' ({reasons})' if reasons else '')
    if flips := summary['heading_flips']:
        kept += f', {flips:,} headings turned around'
    if put_in := status.get(INTERPOLATED):
        kept += f', {put_in:,} interpolated'
    unreadable = summary['dropped'].get('unreadable')
    apart = ', '.join(f'{t} ({late:+,.1f} s)' for t, late in summary['recorded_apart'].items())
    return (
        f'{out}: {summary["boxes_in"]:,} boxes in, {status.get(REFINED, 0):,} refined, {kept} '
        f'from {summary["sweeps"]:,} sweeps in {summary["seconds"]["total"]:.1f} s, '
        f'fixed frame {summary["fixed_frame"]}'
        + (f'; merged by stamp: {apart}' if apart else '')
        + (f'; {unreadable:,} messages could not be read' if unreadable else '')
    )


def notes(summary: dict[str, Any]) -> Iterator[str]:
    """Yield what a user should know beside what was done, a line each."""
    if warning := summary['warning']:
        yield warning
    if why := summary['first_missing_transform']:
        boxes = summary['reasons'].get('no_transform', 0)
        sweeps = summary['dropped'].get('sweep_without_transform', 0)
        yield f'{boxes:,} boxes and {sweeps:,} clouds have no transform; first: {why}'
    for name, found in summary['left_out_of_labels'].items():
        reasons = ', '.join(f'{count:,} ({reason})' for reason, count in found.items())
        yield f'format {name} has no place for boxes: {reasons}'
    if count := summary['frames_without_cloud']:
        yield f'{count:,} of {summary["box_arrays"]:,} box arrays have no cloud beside them'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `boxreg relabel`."""
    add_recording_arguments(parser)
    parser.add_argument(
        '-o', '--out', type=Path, required=True, help='folder of results; appears whole or not'
    )
    parser.add_argument(
        '--associate', action='store_true',
        help='give boxes ids by association, whatever ids they have',
    )  # fmt: skip
    parser.add_argument(
        '--fixed-frame', metavar='FRAME',
        help='frame to refine in (default: the topmost the frame of the clouds moves in)',
    )  # fmt: skip
    parser.add_argument(
        '--formats', default='csv,openlabel', metavar='NAME,...',
        type=lambda text: tuple(name.strip() for name in text.split(',')),
        help='label formats, see `boxreg formats`; csv is always there (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--labels', type=_labels_argument, metavar='FORMAT:PATH',
        help='take the boxes from label files instead of a topic',
    )  # fmt: skip
    add_label_arguments(parser)
    parser.add_argument('--start', type=float, metavar='S', help='from here [s]')
    parser.add_argument('--end', type=float, metavar='S', help='to here [s]')
    parser.add_argument(
        '--bridge', type=float, default=0.0, metavar='S',
        help='put boxes in where a track is missing between two that are no further apart [s]',
    )  # fmt: skip
    parser.add_argument(
        '--report', action='store_true',
        help='write report.html, a page to look at: what was changed, and where to look closer',
    )  # fmt: skip
    parser.add_argument(
        '--resume', action='store_true',
        help='do nothing if OUT holds the results of the same request, files and settings',
    )  # fmt: skip
    parser.add_argument(
        '--workers', type=int, metavar='N', help='cores of the solver (solver.threads)'
    )


def _labels_argument(text: str) -> tuple[str, Path]:
    """Return format and path of ``FORMAT:PATH``."""
    name, colon, path = text.partition(':')
    if not name or not colon or not path:
        raise argparse.ArgumentTypeError(f'expected FORMAT:PATH, got {text!r}')
    return name, Path(path)


def run(args: argparse.Namespace) -> int:
    """Relabel as the command line says; print one closing line."""
    config = config_from(args)
    if args.workers is not None:
        config = config.updated({'solver.threads': args.workers})
    request = Request(
        tuple(args.recordings), args.points, args.boxes, args.odometry, args.fixed_frame,
        args.formats, args.start, args.end, config,
        Options(args.with_points, args.camera, args.swap_axes), args.labels, args.label_frame,
        convention_from(args, args.associate), args.bridge, args.report,
    )  # fmt: skip
    earlier = earlier_summary(args.out)
    if (
        args.resume
        and earlier
        and earlier['fingerprint'] == request.fingerprint()
        and all(is_written(name, args.out) for name in request.all_formats)
        and (not request.report or (args.out / REPORT).exists())
    ):
        print(f'{args.out}: already there, made from the same recording and settings')
        return 0
    if args.config != args.out / CONFIG:  # which will be there again
        spare(args.out, [args.config])
    from tqdm import tqdm

    with tqdm(
        total=1.0, unit='s', disable=not sys.stderr.isatty(), leave=False, bar_format=BAR
    ) as bar:

        def progress(done: float, total: float) -> None:
            bar.total = total
            bar.update(max(0.0, done - bar.n))

        summary = relabel(request, args.out, progress)
    for note in notes(summary):
        print(f'boxreg: {note}', file=sys.stderr)
    print(closing_line(summary, args.out))
    return 0
