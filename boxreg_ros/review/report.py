"""
`boxreg relabel --report`: one HTML page that shows the changes and which tracks to check.

The page needs no other file and no network: its pictures are embedded.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from math import isfinite
import os
from pathlib import Path
import re
from string import ascii_uppercase
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.errors import ConfigError
from boxreg_ros.reasons import Reason, REASONS
from boxreg_ros.review.changes import mean, median, TrackChanges
from boxreg_ros.review.pictures import STYLE, top_view, track_picture
from boxreg_ros.review.track_points import BoxPoints, gather_points, points_before_and_after
from boxreg_ros.structures import (
    BOX_EXTENT,
    BoxArray,
    Floats,
    INTERPOLATED,
    KEPT,
    REFINED,
    Sweep,
    X,
)
import numpy as np

REPORT = 'report.html'
PACKAGES = ('jinja2', 'matplotlib')
TEMPLATE = Path(__file__).parents[1] / 'share' / 'report.html.j2'
MAX_SHOWN = 12
"""Tracks with a picture."""
MIN_BOXES = 10
"""Boxes in the fixed frame that a track with a picture has at least."""
MAX_ROWS = 300
"""Tracks in the table of all tracks."""
CELL = 0.1
"""Edge of the cubes that measure how sharp the points of all sweeps are in their boxes [m]."""


def check_packages() -> None:
    """
    Check that the packages of the report are installed.

    Raises
    ------
    ConfigError
        If one is not.

    """
    for package in PACKAGES:
        try:
            import_module(package)
        except ImportError as error:
            raise ConfigError(
                f'--report needs {package}: pip install {package} ({error})'
            ) from None


def write_report(
    path: Path,
    line: str,
    summary: Mapping[str, Any],
    config: Config,
    tracks: Sequence[TrackChanges],
    items: Iterable[Sweep | BoxArray],
) -> None:
    """
    Write the report of a run as one HTML file.

    Parameters
    ----------
    path : Path
        The file.
    line : str
        The closing line of the run.
    summary : mapping
        Content of ``summary.json``.
    config : Config
        Settings of the run.
    tracks : sequence of TrackChanges
        All tracks, in the order of the table.
    items : iterable of Sweep and BoxArray
        The recording once more, in the fixed frame. One item is held at a time.

    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    import matplotlib

    selected = select_tracks(tracks)
    letters = dict(zip(selected, ascii_uppercase, strict=False))
    shown = [track for track_id in selected for track in tracks if track.track_id == track_id]
    points, origins = gather_points(shown, items, config)
    begin_ns = min((int(track.stamps_ns[0]) for track in tracks), default=0)
    in_fixed_frame = [track for track in tracks if np.isfinite(track.boxes[:, X]).any()]
    sections = []
    with matplotlib.rc_context(STYLE):
        overview = top_view(in_fixed_frame, letters, origins) if in_fixed_frame else ''
        for track in shown:
            section = _numbers(track)
            section['letter'] = letters[track.track_id]
            section['why'] = selected[track.track_id]
            section |= _picture(track, points[track.track_id], begin_ns)
            sections.append(section)
    environment = Environment(
        loader=FileSystemLoader(TEMPLATE.parent), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {'number': _number, 'code': _code}
    changes = np.concatenate([np.zeros((0, 4)), *(t.change[t.is_refined] for t in tracks)])
    page = environment.get_template(TEMPLATE.name).render(
        line=line,
        summary=summary,
        names=[Path(os.path.abspath(name)).name for name in summary['recordings']],
        warnings=_warnings(summary),
        shift=mean(np.linalg.norm(changes[:, :3], axis=1)),
        turn=np.degrees(mean(np.abs(changes[:, 3]))),
        reasons=_explained(summary['reasons']),
        dropped=_explained(summary['dropped']),
        settings=[(item, value) for item, value in config.items() if value != item.default],
        overview=overview,
        sections=sections,
        letters=letters,
        rows=[_numbers(track) for track in tracks[:MAX_ROWS]],
        count=len(tracks),
        min_boxes=MIN_BOXES,
        cell=CELL,
    )
    # File names need not be valid UTF-8.
    path.write_text(page, encoding='utf-8', errors='backslashreplace')


def select_tracks(tracks: Sequence[TrackChanges]) -> dict[str, str]:
    """
    Select the tracks to show with a picture.

    By turns the next track of four orders is taken: largest shift, largest standard deviation,
    most boxes kept although they have points, and, for comparison, most points.

    Returns
    -------
    selected : dict
        Why each track is shown, by track id, in the order of the page.

    """
    candidates = []
    for track in tracks:
        if track.track_id and np.isfinite(track.boxes[:, X]).sum() >= MIN_BOXES:
            candidates.append(track)
    orders: list[list[tuple[float, str, str]]] = [[], [], [], []]  # (value, why, track id)
    for track in candidates:
        shift = track.shift
        deviation = track.deviation
        points = median(track.num_points)
        kept = int(((track.status == KEPT) & (track.num_points > 0)).sum())
        texts = (
            f'largest shift: mean {shift:.2f} m',
            f'largest uncertainty: {deviation:.2f} m (1 sigma)',
            f'boxes kept although they have points: {kept} of {len(track.status)}',
            f'most points: {points:,.0f} per box',
        )
        values = (shift, deviation, kept, points)
        for order, value, text in zip(orders, values, texts, strict=True):
            if value > 0:  # NaN is not
                order.append((value, text, track.track_id))
    for order in orders:
        order.sort(key=lambda item: -item[0])
    selected: dict[str, str] = {}
    for rank in range(len(candidates)):
        for order in orders:
            if rank < len(order) and len(selected) < MAX_SHOWN:
                _, why, track_id = order[rank]
                selected.setdefault(track_id, why)
    return selected


def _picture(track: TrackChanges, points: Sequence[BoxPoints], begin_ns: int) -> dict[str, Any]:
    """Return the picture of a track, and the cells that its points fill before and after."""
    before, after, is_object = points_before_and_after(track, points)
    return {
        'picture': track_picture(track, before, after, is_object, begin_ns),
        'sweeps': len(points),
        'cells': [_filled_cells(before[is_object]), _filled_cells(after[is_object])],
    }


def _filled_cells(points: Floats) -> int:
    """Return the number of cubes of edge `CELL` that hold points (M, 3)."""
    return len(np.unique(np.floor(points / CELL), axis=0))


def _numbers(track: TrackChanges) -> dict[str, Any]:
    """Return the numbers of a track on the page."""
    counts = Counter(track.status.tolist())
    boxes = len(track.status) - counts[INTERPOLATED]
    is_input = track.status != INTERPOLATED
    return {
        'track_id': track.track_id,
        'class_name': track.class_name,
        'boxes': boxes,
        'interpolated': counts[INTERPOLATED],
        'seconds': (track.stamps_ns[-1] - track.stamps_ns[0]) * 1e-9,
        'points': median(track.num_points[is_input]),
        'refined': counts[REFINED] / boxes if boxes else np.nan,
        'kept': ', '.join(f'{name} {count:,}' for name, count in track.reasons.most_common()),
        'shift': track.shift,
        'turn': track.turn,
        'deviation': track.deviation,
        'extents': [_median_extents(track.given), _median_extents(track.boxes)],
        'flips': int(track.is_flipped.sum()),
    }


def _median_extents(boxes: Floats) -> list[float]:
    return [median(values) for values in boxes[:, BOX_EXTENT].T]


def _warnings(summary: Mapping[str, Any]) -> list[str]:
    """Return the warnings at the top of the page."""
    found = [summary['warning']] if summary['warning'] else []
    if summary['boxes_in'] and not summary['status'].get(REFINED):
        found.append('No box was refined; see "Why boxes were kept" below.')
    if summary['first_missing_transform']:
        found.append(f'First missing transform: {summary["first_missing_transform"]}')
    if summary['first_unreadable']:
        found.append(f'First unreadable message: {summary["first_unreadable"]}')
    for name, dropped in summary['left_out_of_labels'].items():
        counts = ', '.join(f'{reason} {count:,}' for reason, count in dropped.items())
        found.append(f'Boxes that format {name} cannot represent: {counts}')
    return found


def _explained(counts: Mapping[str, int]) -> list[tuple[str, int, Reason]]:
    """Return reasons with their count and explanation, the most frequent first."""
    found = [(name, count, REASONS.get(name, Reason('', ''))) for name, count in counts.items()]
    return sorted(found, key=lambda item: -item[1])


def _number(value: float, digits: int = 2) -> str:
    """Return a number with separators; a dash for NaN."""
    return f'{value:,.{digits}f}' if isfinite(value) else '\N{EN DASH}'


def _code(text: str) -> Any:
    """Return text as HTML; words between backticks become code."""
    from markupsafe import escape, Markup

    return Markup(re.sub(r'`([^`]+)`', r'<code>\1</code>', str(escape(text))))
