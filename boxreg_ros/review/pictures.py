"""Pictures of the report: a track before and after registration, and all tracks from above."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import Any

from boxreg_ros.review.changes import known, median, TrackChanges
from boxreg_ros.review.track_points import SHOWN_MARGIN
from boxreg_ros.structures import (
    BOX_EXTENT,
    Floats,
    INTERPOLATED,
    KEPT,
    LENGTH,
    REFINED,
    WIDTH,
    X,
    Y,
    YAW,
    Z,
)
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
STYLE: Any = {'font.size': 8, 'axes.spines.top': False, 'axes.spines.right': False}
COLOURS = {REFINED: '#1769aa', KEPT: '#e07b00', INTERPOLATED: '#8e44ad'}
INPUT_COLOUR = '#9a9a9a'
WIDTH_INCHES = 13
MIN_CHANGE = 0.02
"""Smallest half range of an axis of changes [m or deg]."""


def track_picture(
    track: TrackChanges, before: Floats, after: Floats, is_object: Mask, begin_ns: int
) -> str:
    """
    Draw the points of a track in its boxes, and the changes of its boxes over time.

    Parameters
    ----------
    track : TrackChanges
        The track.
    before, after : array, shape (M, 3)
        Points of all sweeps in the frame of the input boxes and of the refined boxes [m].
    is_object : array, shape (M,)
        False for points that may be road; the top view leaves them out.
    begin_ns : int
        Stamp of time 0 [ns].

    Returns
    -------
    picture : str
        A PNG file as base64.

    """
    from matplotlib.figure import Figure

    figure = Figure((WIDTH_INCHES, 4.2))
    _draw_points(track, figure, before, after, is_object, left=0.04, right=0.6)
    _draw_changes(track, figure, begin_ns)
    return _png(figure)


def points_picture(track: TrackChanges, before: Floats, after: Floats, is_object: Mask) -> str:
    """
    Draw the points of a track in its boxes, without the changes over time.

    Parameters
    ----------
    track : TrackChanges
        The track.
    before, after : array, shape (M, 3)
        Points of all sweeps in the frame of the input boxes and of the refined boxes [m].
    is_object : array, shape (M,)
        False for points that may be road; the top view leaves them out.

    Returns
    -------
    picture : str
        A PNG file as base64.

    """
    from matplotlib.figure import Figure

    figure = Figure((8, 4.5))
    _draw_points(track, figure, before, after, is_object, left=0.07, right=0.99)
    return _png(figure, dpi=150)


def _draw_points(
    track: TrackChanges,
    figure: Any,
    before: Floats,
    after: Floats,
    is_object: Mask,
    left: float,
    right: float,
) -> None:
    """Draw points and the median box from above and from the side, before and after."""
    given = np.nanmedian(track.given[:, BOX_EXTENT], axis=0)
    refined = np.nanmedian(track.boxes[:, BOX_EXTENT], axis=0)
    reach_x, *reaches = np.maximum(given, refined) / 2 + SHOWN_MARGIN
    grid = figure.add_gridspec(
        2, 2, left=left, right=right, top=0.93, bottom=0.09, hspace=0.1, wspace=0.04,
        height_ratios=reaches,
    )  # fmt: skip
    panels: Any = grid.subplots(sharex=True, sharey='row')  # (view, before or after)
    columns = ((before, given, INPUT_COLOUR), (after, refined, COLOURS[REFINED]))
    for k, (points, extent, colour) in enumerate(columns):
        for panel, axis, reach in zip(panels[:, k], (Y, Z), reaches, strict=True):
            shown = points[is_object] if axis == Y else points
            opacity = float(np.clip(800 / (1 + len(shown)), 0.2, 0.8))
            panel.scatter(
                shown[:, X], shown[:, axis], s=4 * opacity**0.5, c='k', alpha=opacity, lw=0
            )
            panel.plot(*_outline(extent[0], extent[axis]).T, color=colour, lw=1.2)
            panel.set(xlim=(-reach_x, reach_x), ylim=(-reach, reach), aspect='equal')
    panels[0, 0].set_title('points in the input boxes', fontweight='bold')
    panels[0, 1].set_title('points in the refined boxes', fontweight='bold')
    panels[0, 0].set_ylabel('top view [m]')
    panels[1, 0].set_ylabel('side view [m]')


def _draw_changes(track: TrackChanges, figure: Any, begin_ns: int) -> None:
    """Draw the changes over time, and around zero the uncertainty of the refined box."""
    grid = figure.add_gridspec(4, 1, left=0.66, right=0.99, top=0.93, bottom=0.09, hspace=0.15)
    panels = grid.subplots(sharex=True)
    names = ('along [m]', 'across [m]', 'up [m]', 'yaw [deg]')
    scale = np.array([1, 1, 1, np.degrees(1)])
    changes = track.change * scale
    bands = 2 * track.deviations * scale
    seconds = (track.stamps_ns - begin_ns) * 1e-9
    for panel, name, values, band in zip(panels, names, changes.T, bands.T, strict=True):
        panel.axhline(0, color=INPUT_COLOUR, lw=0.6)
        panel.fill_between(seconds, -band, band, color=COLOURS[REFINED], alpha=0.15, lw=0)
        for status in (REFINED, KEPT):
            is_shown = track.status == status
            panel.plot(seconds[is_shown], values[is_shown], '.', ms=3, color=COLOURS[status])
        limit = max([MIN_CHANGE, *np.abs(known(values)), *known([median(band)])])
        panel.set(ylabel=name, ylim=(-1.15 * limit, 1.15 * limit))
    figure.align_ylabels(panels)
    panels[0].set_title(
        'refined minus input; band: ±2 sigma of the refined box', fontweight='bold'
    )
    panels[-1].set_xlabel('time [s]')


def top_view(tracks: Sequence[TrackChanges], letters: Mapping[str, str], origins: Floats) -> str:
    """
    Draw all tracks from above.

    Parameters
    ----------
    tracks : sequence of TrackChanges
        Tracks with at least one box in the fixed frame.
    letters : mapping
        Letters of the tracks with a picture of their own, by track id.
    origins : array, shape (n, 3)
        Positions of the sensor [m].

    Returns
    -------
    picture : str
        A PNG file as base64.

    """
    from matplotlib.figure import Figure

    separator = np.full((1, 9), np.nan)  # ends the line of a track
    given = np.concatenate([part for track in tracks for part in (track.given, separator)])
    boxes = np.concatenate([track.boxes for track in tracks])
    status = np.concatenate([track.status for track in tracks])
    width, depth = (np.ptp(known(column)) + 20.0 for column in boxes[:, :2].T)
    height_inches = float(np.clip(WIDTH_INCHES * depth / width, 4, 8))
    figure = Figure((WIDTH_INCHES, height_inches))
    axes = figure.add_axes((0.05, 0.08, 0.94, 0.9))
    axes.plot(given[:, X], given[:, Y], color=INPUT_COLOUR, lw=0.7, label='input')
    for name, colour in COLOURS.items():
        shown = boxes[status == name]
        if len(shown):
            axes.plot(shown[:, X], shown[:, Y], '.', ms=2, color=colour, label=name)
    axes.plot(*origins[:, :2].T, color='k', lw=1, ls=':', label='sensor')
    for track in tracks:
        _draw_middle_box(axes, track, letters.get(track.track_id, ''))
    axes.set_aspect('equal', adjustable='datalim')
    axes.set(xlabel='x [m]', ylabel='y [m]')
    axes.legend(markerscale=4, frameon=False, loc='best')
    return _png(figure)


def _draw_middle_box(axes: Any, track: TrackChanges, letter: str) -> None:
    """Draw the box in the middle of a track, and its letter."""
    boxes = track.boxes[np.isfinite(track.boxes[:, X])]
    box = boxes[len(boxes) // 2]
    cos = np.cos(box[YAW])
    sin = np.sin(box[YAW])
    outline = _outline(box[LENGTH], box[WIDTH]) @ np.array([[cos, sin], [-sin, cos]])
    axes.plot(*(outline + box[[X, Y]]).T, color='k', lw=0.6)
    if letter:
        axes.annotate(
            letter, box[[X, Y]], (5, 5), textcoords='offset points', fontweight='bold',
            bbox={'boxstyle': 'round,pad=0.2', 'fc': 'w', 'ec': INPUT_COLOUR, 'lw': 0.5},
        )  # fmt: skip


def _outline(length: float, width: float) -> Floats:
    """Return the outline (7, 2) of a box along x [m], with a stroke at its front."""
    corners = np.array([[1, 0], [1, 1], [-1, 1], [-1, -1], [1, -1], [1, 0], [1.2, 0]])
    return np.asarray(corners * [length, width] / 2)


def _png(figure: Any, dpi: int = 100) -> str:
    """Return a figure as a PNG file in base64."""
    buffer = BytesIO()
    figure.savefig(buffer, format='png', dpi=dpi)
    return b64encode(buffer.getvalue()).decode('ascii')
