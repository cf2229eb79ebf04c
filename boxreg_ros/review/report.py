"""
`boxreg relabel --report`: one page that shows what became of the boxes, and where to look closer.

The page needs nothing but itself: pictures are in it, and nothing is fetched.

"""

from __future__ import annotations

from base64 import b64encode
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from io import BytesIO
from math import isfinite
import os
from pathlib import Path
import re
from string import ascii_uppercase
from typing import Any, NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.matching import Pair, StampMatcher
from boxreg_ros.core.metrics import EXTENT
from boxreg_ros.core.observation import crop, GROUND_CLEARANCE
from boxreg_ros.errors import ConfigError
from boxreg_ros.reasons import Reason, REASONS
from boxreg_ros.review.changes import known, mean, median, TrackChanges
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import (
    BoxArray,
    Floats,
    INTERPOLATED,
    KEPT,
    LENGTH,
    REFINED,
    ROLL,
    Sweep,
    WIDTH,
    X,
    Y,
    YAW,
    Z,
)
import numpy as np
from numpy.typing import NDArray

REPORT = 'report.html'
PACKAGES = 'jinja2', 'matplotlib'
TEMPLATE = Path(__file__).parents[1] / 'share' / 'report.html.j2'
SHOWN, SHORTEST = 12, 10  # tracks with pictures, and boxes that one of them has at least
SWEEPS, POINTS = 60, 150  # most of a track, and most of a box, that its pictures show
ROWS = 300  # tracks in the table
MARGIN = 0.6  # points so far outside of a box are shown [m]
CELL = 0.1  # the fewer cubes of this edge the points of all sweeps fill, the sharper they are [m]
STYLE: Any = {'font.size': 8, 'axes.spines.top': False, 'axes.spines.right': False}
COLOURS = {REFINED: '#1769aa', KEPT: '#e07b00', INTERPOLATED: '#8e44ad'}
GREY = '#9a9a9a'
AXES = 'along [m]', 'across [m]', 'up [m]', 'yaw [deg]'


def check_packages() -> None:
    """
    Look whether the packages of a report are there.

    Raises
    ------
    ConfigError
        If one is not installed.

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
        Where to.
    line : str
        What was done, in one line.
    summary : mapping
        What ``summary.json`` holds.
    config : Config
        Settings of the run.
    tracks : sequence of TrackChanges
        All tracks, in the order of the table.
    items : iterable of Sweep and BoxArray
        Those of the recording once more, in the fixed frame and in the order they came. Of their
        points few are kept, however many there are.

    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    import matplotlib

    reasons = chosen(tracks)
    letters = dict(zip(reasons, ascii_uppercase, strict=False))
    shown = [track for name in letters for track in tracks if track.track_id == name]
    seen, origins = _gathered(shown, items, config)
    begin_ns = min((int(track.stamps_ns[0]) for track in tracks), default=0)
    with matplotlib.rc_context(STYLE):
        placed = [track for track in tracks if np.isfinite(track.boxes[:, X]).any()]
        overview = _overview(placed, letters, origins) if placed else ''
        sections = [
            _facts(track)
            | {'letter': letters[track.track_id], 'why': reasons[track.track_id]}
            | _pictured(track, seen[track.track_id], begin_ns)
            for track in shown
        ]
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
        rows=[_facts(track) for track in tracks[:ROWS]],
        count=len(tracks),
        shortest=SHORTEST,
    )
    # Names of files need not be UTF-8.
    path.write_text(page, encoding='utf-8', errors='backslashreplace')


def chosen(tracks: Sequence[TrackChanges]) -> dict[str, str]:
    """Return the ids of the tracks to be shown, and why each of them is."""
    able = [t for t in tracks if t.track_id and np.isfinite(t.boxes[:, X]).sum() >= SHORTEST]
    kept = [int(((t.status == KEPT) & (t.num_points > 0)).sum()) for t in able]
    points = [median(t.num_points) for t in able]
    orders: list[list[tuple[float, str, TrackChanges]]] = [
        [(t.shift, f'moved most: {t.shift:.2f} m on average', t) for t in able],
        [(t.deviation, f'least certain: {t.deviation:.2f} m (1 sigma)', t) for t in able],
        [
            (k, f'kept in spite of points: {k} of {len(t.status)} boxes', t)
            for k, t in zip(kept, able, strict=True)
        ],
        [(p, f'most points: {p:,.0f} a box', t) for p, t in zip(points, able, strict=True)],
    ]
    orders = [[item for item in order if item[0] > 0] for order in orders]
    for order in orders:
        order.sort(key=lambda item: -item[0])
    found: dict[str, str] = {}
    for rank in range(len(able)):
        for order in orders:
            if rank < len(order) and len(found) < SHOWN:
                _, why, track = order[rank]
                found.setdefault(track.track_id, why)
    return found


class _Seen(NamedTuple):
    """Points (M, 3) of a sweep near the box in one row of a track, in the fixed frame."""

    row: int
    points: Floats


def _gathered(
    shown: Sequence[TrackChanges], items: Iterable[Sweep | BoxArray], config: Config
) -> tuple[dict[str, list[_Seen]], Floats]:
    """Return some points of the tracks shown, and where the sensor was (n, 3)."""
    wanted = {
        (int(track.stamps_ns[row]), track.track_id): (track, row)
        for track in shown
        for row in reversed(_spread(track))  # of two boxes of one stamp the first counts
    }
    seen: dict[str, list[_Seen]] = {track.track_id: [] for track in shown}
    origins: list[Floats] = []
    for boxes, sweep in _pairs(items, config, origins):
        for name in boxes.track_ids if sweep is not None else ():
            track, row = wanted.pop((boxes.stamp_ns, name), (None, 0))
            if track is not None and sweep is not None:
                seen[name].append(_Seen(row, _near(track, row, sweep, config)))
    return seen, np.reshape(origins, (-1, 3))


def _pairs(
    items: Iterable[Sweep | BoxArray], config: Config, origins: list[Floats]
) -> Iterator[Pair]:
    """Yield boxes and sweeps that belong together; add where the sensor was to `origins`."""
    matcher = StampMatcher(config, Counter())
    for item in items:
        if isinstance(item, Sweep):
            origins.append(item.origin)
            yield from matcher.add_sweep(item)
        else:
            yield from matcher.add_boxes(item)
    yield from matcher.flush()


def _spread(track: TrackChanges) -> list[int]:
    """Return rows of boxes with points in or near them, all over the track."""
    has_points = track.is_refined | (track.num_points > 0)
    rows = np.flatnonzero(np.isfinite(track.change).all(axis=1) & has_points)
    picks = np.linspace(0, len(rows) - 1, min(SWEEPS, len(rows))).astype(int)
    return [int(row) for row in rows[picks]]


def _near(track: TrackChanges, row: int, sweep: Sweep, config: Config) -> Floats:
    """Return points (M, 3) near a box before and after, carried along its way to its stamp."""
    has_place = np.isfinite(track.boxes[:, X])
    times = (track.stamps_ns[has_place] - track.stamps_ns[row]) * 1e-9
    centers = track.boxes[has_place, : Z + 1]

    def way(seconds: Floats) -> Floats:
        there = [np.interp(seconds, times, center) for center in centers.T]
        return np.asarray(track.boxes[row, : Z + 1] - np.column_stack(there))

    late = np.array([(sweep.stamp_ns - track.stamps_ns[row]) * 1e-9])
    both = np.array([track.given[row], track.boxes[row]])
    both[:, : Z + 1] -= way(late)
    index, _, _, outside = crop(sweep.points, both, MARGIN)
    index = np.unique(index[outside.max(0) < MARGIN])
    index = index[:: max(1, -(-len(index) // POINTS))]
    if config.sampling.deskew and sweep.times is not None:
        late = late + sweep.times[index]
    return np.asarray(sweep.points[index] + way(late))


def _pictured(track: TrackChanges, seen: Sequence[_Seen], begin_ns: int) -> dict[str, Any]:
    """Return the picture of a track, and how many cells its points fill before and after."""
    from matplotlib.figure import Figure

    before = _carried(seen, track.given, track.is_flipped)
    after = _carried(seen, track.boxes, np.zeros_like(track.is_flipped))
    given, boxes = (np.nanmedian(b[:, EXTENT], axis=0) for b in (track.given, track.boxes))
    above = after[:, 2] > GROUND_CLEARANCE - boxes[2] / 2  # what is lower may be road
    length, *reaches = np.maximum(given, boxes) / 2 + MARGIN
    figure = Figure((13, 4.2))
    grid = figure.add_gridspec(
        2, 2, left=0.04, right=0.6, top=0.93, bottom=0.09, hspace=0.1, wspace=0.04,
        height_ratios=reaches,
    )  # fmt: skip
    panels: Any = grid.subplots(sharex=True, sharey='row')
    looks = (before, given, GREY), (after, boxes, COLOURS[REFINED])
    for k, (points, extent, colour) in enumerate(looks):
        for panel, axis, reach in zip(panels[:, k], (Y, Z), reaches, strict=True):
            dots = points[above] if axis == Y else points
            fade = float(np.clip(800 / (1 + len(dots)), 0.2, 0.8))
            panel.scatter(dots[:, X], dots[:, axis], s=4 * fade**0.5, c='k', alpha=fade, lw=0)
            panel.plot(*_outline(extent[0], extent[axis]).T, color=colour, lw=1.2)
            panel.set(xlim=(-length, length), ylim=(-reach, reach), aspect='equal')
    for panel, title in zip(panels[0], ('before, by the input boxes', 'after'), strict=True):
        panel.set_title(title, fontweight='bold')
    for panel, title in zip(panels[:, 0], ('from above [m]', 'from the side [m]'), strict=True):
        panel.set_ylabel(title)
    _draw_series(track, figure, begin_ns)
    cells = [len(np.unique(np.floor(p[above] / CELL), axis=0)) for p in (before, after)]
    return {'picture': _png(figure), 'sweeps': len(seen), 'cells': cells, 'cell': CELL}


def _draw_series(track: TrackChanges, figure: Any, begin_ns: int) -> None:
    """Draw what was changed over time, and around zero how certain the refined box is."""
    grid = figure.add_gridspec(4, 1, left=0.66, right=0.99, top=0.93, bottom=0.09, hspace=0.15)
    panels = grid.subplots(sharex=True)
    scale = np.array([1, 1, 1, np.degrees(1)])
    change, band = track.change * scale, 2 * track.deviations * scale
    seconds = (track.stamps_ns - begin_ns) * 1e-9
    for panel, name, values, reach in zip(panels, AXES, change.T, band.T, strict=True):
        panel.axhline(0, color=GREY, lw=0.6)
        panel.fill_between(seconds, -reach, reach, color=COLOURS[REFINED], alpha=0.15, lw=0)
        for status in (REFINED, KEPT):
            of_kind = track.status == status
            panel.plot(seconds[of_kind], values[of_kind], '.', ms=3, color=COLOURS[status])
        most = max([0.02, *np.abs(values[np.isfinite(values)]), *known([median(reach)])])
        panel.set(ylabel=name, ylim=(-1.15 * most, 1.15 * most))
    figure.align_ylabels(panels)
    panels[0].set_title('refined minus input; band: ±2 sigma', fontweight='bold')
    panels[-1].set_xlabel('time [s]')


def _overview(tracks: Sequence[TrackChanges], letters: Mapping[str, str], sensor: Floats) -> str:
    """Return a picture from above of tracks that have a box in the fixed frame each."""
    from matplotlib.figure import Figure

    gap = np.full((1, 9), np.nan)  # a line ends where its track does
    given = np.concatenate([part for track in tracks for part in (track.given, gap)])
    boxes = np.concatenate([track.boxes for track in tracks])
    status = np.concatenate([track.status for track in tracks])
    width, depth = (np.ptp(known(column)) + 20.0 for column in boxes[:, :2].T)
    figure = Figure((13, float(np.clip(13 * depth / width, 4, 8))))
    axes = figure.add_axes((0.05, 0.08, 0.94, 0.9))
    axes.plot(given[:, X], given[:, Y], color=GREY, lw=0.7, label='input')
    for name, colour in COLOURS.items():
        of_kind = boxes[status == name]
        if len(of_kind):
            axes.plot(of_kind[:, X], of_kind[:, Y], '.', ms=2, color=colour, label=name)
    axes.plot(*sensor[:, :2].T, color='k', lw=1, ls=':', label='sensor')
    for track in tracks:
        placed = track.boxes[np.isfinite(track.boxes[:, X])]
        box = placed[len(placed) // 2]
        cos, sin = np.cos(box[YAW]), np.sin(box[YAW])
        turned = _outline(box[LENGTH], box[WIDTH]) @ np.array([[cos, sin], [-sin, cos]])
        axes.plot(*(turned + box[[X, Y]]).T, color='k', lw=0.6)
        if letter := letters.get(track.track_id):
            axes.annotate(
                letter, box[[X, Y]], (5, 5), textcoords='offset points', fontweight='bold',
                bbox={'boxstyle': 'round,pad=0.2', 'fc': 'w', 'ec': GREY, 'lw': 0.5},
            )  # fmt: skip
    axes.set_aspect('equal', adjustable='datalim')
    axes.set(xlabel='x [m]', ylabel='y [m]')
    axes.legend(markerscale=4, frameon=False, loc='best')
    return _png(figure)


def _carried(seen: Sequence[_Seen], boxes: Floats, is_flipped: NDArray[np.bool_]) -> Floats:
    """Return the points (M, 3) of all sweeps as each lies in its box, half turns undone."""
    local = [np.zeros((0, 3))]
    for row, points in seen:
        R = matrix_from_rpy(boxes[row, ROLL:])
        sign = np.array([-1, -1, 1]) if is_flipped[row] else 1
        local.append((points - boxes[row, : Z + 1]) @ R * sign)
    return np.concatenate(local)


def _outline(length: float, width: float) -> Floats:
    """Return the outline (7, 2) of a box that heads along x, with a stroke forward."""
    corners = np.array([[1, 0], [1, 1], [-1, 1], [-1, -1], [1, -1], [1, 0], [1.2, 0]])
    return np.asarray(corners * [length, width] / 2)


def _png(figure: Any) -> str:
    """Return a figure as the base64 of a PNG file."""
    buffer = BytesIO()
    figure.savefig(buffer, format='png', dpi=100)
    return b64encode(buffer.getvalue()).decode('ascii')


def _facts(track: TrackChanges) -> dict[str, Any]:
    """Return what the page says about a track in numbers."""
    counts = Counter(track.status.tolist())
    n = len(track.status) - counts[INTERPOLATED]
    extents = [[median(v) for v in b[:, EXTENT].T] for b in (track.given, track.boxes)]
    return {
        'track_id': track.track_id,
        'class_name': track.class_name,
        'boxes': n,
        'interpolated': counts[INTERPOLATED],
        'seconds': (track.stamps_ns[-1] - track.stamps_ns[0]) * 1e-9,
        'points': median(track.num_points[track.status != INTERPOLATED]),
        'refined': counts[REFINED] / n if n else np.nan,
        'kept': ', '.join(f'{name} {k:,}' for name, k in track.reasons.most_common()),
        'shift': track.shift,
        'turn': track.turn,
        'deviation': track.deviation,
        'extents': extents,
        'flips': int(track.is_flipped.sum()),
    }


def _warnings(summary: Mapping[str, Any]) -> list[str]:
    """Return what a user should not overlook."""
    found = [summary['warning']]
    if summary['boxes_in'] and not summary['status'].get(REFINED):
        found.append('No box was refined; the reasons are below.')
    for name, text in (
        ('first_missing_transform', 'First transform that is missing'),
        ('first_unreadable', 'First that cannot be read'),
    ):
        found.append(f'{text}: {summary[name]}' if summary[name] else '')
    for name, dropped in summary['left_out_of_labels'].items():
        counts = ', '.join(f'{reason} {count:,}' for reason, count in dropped.items())
        found.append(f'Boxes that {name} has no place for: {counts}')
    return [text for text in found if text]


def _explained(counts: Mapping[str, int]) -> list[tuple[str, int, Reason]]:
    """Return reasons with what they mean, the most frequent first."""
    found = [(name, n, REASONS.get(name, Reason('', ''))) for name, n in counts.items()]
    return sorted(found, key=lambda item: -item[1])


def _number(value: float, digits: int = 2) -> str:
    """Return a number as people read it; a dash where it is unknown."""
    return f'{value:,.{digits}f}' if isfinite(value) else '\N{EN DASH}'


def _code(text: str) -> Any:
    """Return text for the page, what stands between backticks as code."""
    from markupsafe import escape, Markup

    return Markup(re.sub(r'`([^`]+)`', r'<code>\1</code>', str(escape(text))))
