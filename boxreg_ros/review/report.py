"""
`boxreg relabel --report`: one HTML page to look at every track before and after.

The page needs no other file and no network. Its 3D view and charts are drawn by Plotly, whose
script is taken from the installed package and embedded. The boxes and points of each track are
compressed and decompressed when the track is opened. `boxreg review` serves the same page.

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
import os
from pathlib import Path
import re
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.reasons import Reason, REASONS
from boxreg_ros.review.changes import mean, median
from boxreg_ros.review.payload import (
    as_json,
    compressed,
    points_per_box,
    STATES,
    TrackPart,
    true_boxes,
)
from boxreg_ros.review.quality import CELL, Quality
from boxreg_ros.review.risk import Usual
from boxreg_ros.review.rules import Rule, RULES, Violation
from boxreg_ros.review.tables import TrackRow
from boxreg_ros.review.track_points import PointCollector
from boxreg_ros.structures import HUMAN, REFINED
import numpy as np

REPORT = 'report.html'
PAGE_VERSION = 2
"""Of the data and the requests of the page: `boxreg review` serves this one alone."""
PAGE = Path(__file__).parent / 'page'
TEMPLATE = 'report.html.j2'
SCRIPTS = (
    'base', 'geometry', 'log', 'tracks', 'added', 'list', 'overview', 'timeline', 'views',
    'charts', 'edit', 'decide', 'written', 'sweeps', 'camera', 'points', 'scene',
    'keys', 'main',
)  # fmt: skip
"""Parts of the script, in the order that they are joined in."""
MAX_MAP_SENSOR = 2000
"""Positions of the sensor on the map; chosen."""


def write_report(
    folder: Path,
    line: str,
    summary: Mapping[str, Any],
    config: Config,
    found: Sequence[TrackRow],
    violated: Mapping[str, Sequence[Violation]],
    points: PointCollector,
    truth: BoxTable | None = None,
) -> None:
    """
    Write the report of a run as one HTML file into the result folder.

    Parameters
    ----------
    folder : Path
        The result folder.
    line : str
        The closing line of the run.
    summary : mapping
        The content of ``summary.json``.
    config : Config
        Settings of the run; those that are not the defaults are shown.
    found : sequence of TrackRow
        All tracks with their risks, in the order of the list.
    violated : mapping of str to sequence of Violation
        What violates each rule after the run, by the id of the rule.
    points : PointCollector
        Points near the boxes, and positions of the sensor.
    truth : BoxTable, optional
        True boxes in the fixed frame, by the same stamps and track ids.

    Raises
    ------
    OSError
        If the file cannot be written.

    """
    tracks = [row.track for row in found]
    of_arrays = np.array(list(points.stamps_ns), np.int64)
    stamps_ns = np.unique(np.concatenate([of_arrays, *(track.stamps_ns for track in tracks)]))
    begin_ns = int(stamps_ns[0]) if len(stamps_ns) else 0
    max_points = points_per_box(sum(len(track.stamps_ns) for track in tracks))
    violations = _by_track(violated)
    usual = Usual.of(tracks)
    rows = []
    parts = []
    qualities = []
    for row, true in zip(found, true_boxes(tracks, truth), strict=True):
        near, sensor = points.points_of(row.track), points.sensor_at(row.track.stamps_ns)
        part = TrackPart(row, near, sensor, true, usual)
        rows.append(part.row(stamps_ns) | {'rules': violations.get(row.track.track_id, [])})
        parts.append(compressed(as_json(part.part(begin_ns, max_points))))
        qualities.append((part.before, part.after))
    stride = 1 + len(points.origins) // MAX_MAP_SENSOR
    data = {
        'begin_ns': str(begin_ns),
        'frame': summary['fixed_frame'],
        'cell': CELL,
        'stamps': [str(stamp) for stamp in stamps_ns.tolist()],
        'times': np.round((stamps_ns - begin_ns) * 1e-9, 3),
        'states': STATES,
        'has_truth': truth is not None,
        'tracks': rows,
        'sensor': np.round(points.origins[::stride, :2], 2),
        'total': [_total([pair[k] for pair in qualities]) for k in range(2)],
    }
    page = _page(
        line=line,
        settings=[(item, value) for item, value in config.items() if value != item.default],
        data=compressed(as_json(data)),
        parts=parts,
        **_of_summary(summary),
        **_of_tracks(found),
    )
    # File names need not be valid UTF-8.
    (folder / REPORT).write_text(page, encoding='utf-8', errors='backslashreplace')


def page_environment() -> Any:
    """Return the environment of the templates in `PAGE`."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(PAGE), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters['code'] = _code
    return environment


def style() -> Any:
    """Return the styles of all pages, not to be escaped."""
    return _as_markup('report.css')


def _page(**content: Any) -> str:
    """Return the page with its content, styles and scripts."""
    import plotly

    library = Path(plotly.__file__).parent / 'package_data' / 'plotly.min.js'
    return str(
        page_environment()
        .get_template(TEMPLATE)
        .render(
            css=style(),
            script=_as_markup(*(f'{name}.js' for name in SCRIPTS)),
            plotly=compressed(library.read_bytes()),
            version=PAGE_VERSION,
            **content,
        )
    )


def _of_summary(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the page shows of ``summary.json``."""
    return {
        'summary': summary,
        'names': [Path(os.path.abspath(name)).name for name in summary['recordings']],
        'warnings': _warnings(summary),
        'reasons': _explained(summary['reasons']),
        'dropped': _explained(summary['dropped']),
        'rules': _violated(summary['rules']),
    }


def _of_tracks(found: Sequence[TrackRow]) -> dict[str, Any]:
    """Return the number of the tracks, by how much their refined boxes changed, and their risk."""
    tracks = [row.track for row in found]
    changes = np.concatenate([np.zeros((0, 4)), *(t.change[t.is_refined] for t in tracks)])
    return {
        'count': len(tracks),
        'risk': median([row.risk.track for row in found if row.track.is_label.any()]),
        'shift': mean(np.linalg.norm(changes[:, :3], axis=1)),
        'turn': float(np.degrees(mean(np.abs(changes[:, 3])))),
    }


def _total(qualities: Sequence[Quality]) -> dict[str, Any]:
    """Return the figures of all tracks: sums of counts, means of the others."""
    rows = [asdict(one) for one in qualities]
    total: dict[str, Any] = {}
    for name in ('flips', 'cells'):
        total[name] = sum(row[name] for row in rows)
    for name in ('jitter', 'yaw_jitter', 'size_spread', 'iou'):
        total[name] = mean([row[name] for row in rows])
    return total


def _by_track(violated: Mapping[str, Sequence[Violation]]) -> dict[str, list[tuple[str, ...]]]:
    """Return the violations of each track: rule, stamp and text."""
    found: dict[str, list[tuple[str, ...]]] = {}
    for rule_id, violations in violated.items():
        for one in violations:
            found.setdefault(one.track_id, []).append((rule_id, str(one.stamp_ns), one.text))
    return found


def _warnings(summary: Mapping[str, Any]) -> list[str]:
    """Return the warnings at the top of the page."""
    found = [summary['warning']] if summary['warning'] else []
    if summary['boxes_in'] and summary['status'].keys().isdisjoint((REFINED, HUMAN)):
        found.append('No box was refined; see "Why boxes were kept" below.')
    if summary['first_missing_transform']:
        found.append(f'First missing transform: {summary["first_missing_transform"]}')
    if summary['first_unreadable']:
        found.append(f'First unreadable message: {summary["first_unreadable"]}')
    for name, dropped in summary['left_out_of_labels'].items():
        counts = ', '.join(f'{reason} {count:,}' for reason, count in dropped.items())
        found.append(f'Boxes that format {name} cannot represent: {counts}')
    return found


def _explained(counts: Mapping[str, int]) -> list[tuple[str, int, Reason | None]]:
    """Return reasons with their count and explanation, the most frequent first."""
    found = [(name, count, REASONS.get(name)) for name, count in counts.items()]
    return sorted(found, key=lambda item: -item[1])


def _violated(sums: Mapping[str, Mapping[str, int]]) -> list[tuple[Rule, int, int]]:
    """Return rules with their violations before and after the run; those never violated not."""
    found = [(rule, sums['before'][name], sums['after'][name]) for name, rule in RULES.items()]
    return [row for row in found if row[1] or row[2]]


def _code(text: str) -> Any:
    """Return text as HTML; words between backticks become code."""
    from markupsafe import escape, Markup

    return Markup(re.sub(r'`([^`]+)`', r'<code>\1</code>', str(escape(text))))


def _as_markup(*names: str) -> Any:
    """Return files of ours as they are: style and script must not be escaped."""
    from markupsafe import Markup

    return Markup('\n'.join((PAGE / name).read_text(encoding='utf-8') for name in names))
