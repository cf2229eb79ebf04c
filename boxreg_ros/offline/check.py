"""`boxreg check`: rules that labels should keep, on label files or the boxes of a recording."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterable
import json
from pathlib import Path
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.reasons import Reason
from boxreg_ros.review.label_tracks import LabelTrack
from boxreg_ros.review.rules import ERROR, RULES, Violation, violations, WARNING
from boxreg_ros.structures import BoxArray, Floats, Ints, REJECTED
import numpy as np

RECORDING_SUFFIXES = ('.mcap', '.db3', '.bag')
NOT_CHECKED = {
    'boxes_without_id': 'no track id; run a tracker first, or boxreg relabel --associate',
    'invalid_boxes': Reason.INVALID_BOX.meaning,
}
"""Boxes that are in no rule, and why."""
LABEL_SUFFIXES = {'.csv': 'csv', '.parquet': 'parquet'}
"""Label files whose format follows from their suffix."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `boxreg check`."""
    parser.add_argument(
        'source', metavar='LABELS|RECORDING',
        help='result folder, boxes.csv, boxes.parquet, FORMAT:PATH of other label files, or a '
        'recording',
    )  # fmt: skip
    parser.add_argument('--config', type=Path, metavar='FILE', help='settings as a YAML file')
    parser.add_argument('--json', action='store_true', help='print one JSON object')
    parser.add_argument(
        '--strict',
        action='store_true',
        help='exit with 1 if a rule is violated, or a box is invalid',
    )


def run(args: argparse.Namespace) -> int:
    """Print the violations of all rules; return 1 with ``--strict`` if there are any."""
    config = Config() if args.config is None else Config.from_yaml(args.config)
    unread: Counter[str] = Counter()
    tracks, left_out = _tracks(args.source, config, unread)
    reasons = [
        f'{count:,} boxes are not checked: {NOT_CHECKED[name]}'
        for name, count in unread.items()
        if count
    ]
    reasons += filter(None, [left_out])
    if not any(len(track.boxes) for track in tracks):
        because = '; '.join(reasons) or 'there are none'
        raise RecordingError(
            f'{args.source}: expected valid boxes with a track id, got none: {because}'
        )
    found = violations(tracks)
    if args.json:
        print(json.dumps(_report(tracks, found, unread, left_out)))
    else:
        _print(tracks, found, reasons)
    return int(args.strict and bool(found or unread['invalid_boxes']))


def _report(
    tracks: list[LabelTrack],
    found: dict[str, list[Violation]],
    unread: Counter[str],
    left_out: str,
) -> dict[str, Any]:
    """Return tracks, boxes and all violations as plain values."""
    return {
        'tracks': len(tracks),
        'boxes': sum(len(track.boxes) for track in tracks),
        **{name: unread[name] for name in NOT_CHECKED},
        'left_out': left_out,
        'rules': {
            name: {
                'severity': rule.severity,
                'meaning': rule.meaning,
                'remedy': rule.remedy,
                'violations': [item._asdict() for item in found.get(name, ())],
            }
            for name, rule in RULES.items()
        },
    }


def _print(
    tracks: list[LabelTrack], found: dict[str, list[Violation]], reasons: list[str]
) -> None:
    """Print the violations by rule, and one closing line, after `reasons` of boxes left out."""
    for name, items in found.items():
        rule = RULES[name]
        print(f'{rule.severity}: {name}: {rule.meaning}; {rule.remedy}')
        for item in items:
            print(f'  track {item.track_id} at {item.stamp_ns}: {item.text}')
    for reason in reasons:
        print(reason)
    boxes = sum(len(track.boxes) for track in tracks)
    kinds = 'no rule violated'
    if found:
        total: Counter[str] = Counter()
        for name, items in found.items():
            total[RULES[name].severity] += len(items)
        counts = ', '.join(f'{word}s: {total[word]:,}' for word in (ERROR, WARNING))
        kinds = f'{len(found)} of {len(RULES)} rules violated; {counts}'
    print(f'{len(tracks):,} tracks, {boxes:,} boxes: {kinds}')


def _tracks(source: str, config: Config, unread: Counter[str]) -> tuple[list[LabelTrack], str]:
    """
    Read the tracks of label files, whose rejected boxes are no labels, or of a recording.

    Also what a recording has left out; boxes that are no labels are counted in `unread`.

    """
    path = Path(source)
    if _is_recording(path):
        from boxreg_ros.io.fixed_frame import input_boxes  # slow to import: it reads bags
        from boxreg_ros.offline.request import Request
        from boxreg_ros.offline.sources import source_of

        arrays, left_out = input_boxes(source_of(Request((path,))))
        return _grouped(((array, None) for array in arrays), config, unread), left_out
    from boxreg_ros.labels import frames_of

    name, path = _format_of(source)
    frames = (frame.moved('fixed').refined for frame in frames_of(name, path))
    labels = (refined.without(REJECTED) for refined in frames)
    pairs = ((refined.boxes, refined.num_points) for refined in labels)
    return _grouped(pairs, config, unread), ''


def _is_recording(path: Path) -> bool:
    """Return whether a path names a recording or a scene of a data set, not label files."""
    from boxreg_ros.datasets.registry import address_of

    address = address_of(path)
    if address is not None:
        # Label formats of the same name are files, or folders without a scene.
        return bool(address.scene)
    return path.suffix in RECORDING_SUFFIXES or (path / 'metadata.yaml').is_file()


def _format_of(source: str) -> tuple[str, Path]:
    """Return format and path of label files."""
    path = Path(source)
    if (path / 'boxes.csv').is_file():
        return 'csv', path
    name, colon, rest = source.partition(':')
    if colon and rest and not path.exists():
        return name, Path(rest)
    if path.suffix in LABEL_SUFFIXES:
        return LABEL_SUFFIXES[path.suffix], path
    raise ConfigError(
        f'{source}: expected a result folder, boxes.csv, boxes.parquet, a recording or '
        f'FORMAT:PATH, as in kitti:{source}; see boxreg formats'
    )


def _grouped(
    arrays: Iterable[tuple[BoxArray, Ints | None]], config: Config, unread: Counter[str]
) -> list[LabelTrack]:
    """Return the tracks of box arrays with their numbers of points; boxes without id are none."""
    rows: dict[str, list[tuple[int, str, Floats, int]]] = {}
    for array, num_points in arrays:
        numbers = np.full(len(array.boxes), -1) if num_points is None else num_points
        unread['boxes_without_id'] += array.track_ids.count('')
        for i, track_id in enumerate(array.track_ids):
            if track_id:
                row = array.stamp_ns, array.class_names[i], array.boxes[i], int(numbers[i])
                rows.setdefault(track_id, []).append(row)
    # Files without the number of points give 0 for all boxes.
    is_known = any(row[3] > 0 for items in rows.values() for row in items)
    tracks = []
    for track_id, items in rows.items():
        stamps_ns, classes, boxes, given = zip(*items, strict=True)
        points = np.array(given) if is_known else np.full(len(items), -1)
        name = Counter(classes).most_common(1)[0][0]
        stamps = np.array(stamps_ns, np.int64)
        track = LabelTrack.of(track_id, name, config, stamps, np.array(boxes), points)
        unread['invalid_boxes'] += len(items) - len(track.boxes)
        tracks.append(track)
    return tracks
