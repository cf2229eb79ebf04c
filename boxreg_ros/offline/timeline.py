"""The picture of `boxreg inspect --html`: when each topic has messages, gaps and damages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from boxreg_ros.errors import ConfigError
from boxreg_ros.io.whole_files import written_whole

MAX_PARTS = 500
"""Parts of a line that a picture of 1,000 pixels can show."""
ROW_PIXELS = 26
MESSAGE_COLOUR = '#2a6fbb'
GAP_COLOUR = '#e0912f'
DAMAGE_COLOUR = '#c0392b'
"""Distinct for people with any colour vision."""


def check_plotly() -> None:
    """Raise ConfigError if Plotly is not installed."""
    try:
        import plotly  # noqa: F401
    except ImportError as error:
        raise ConfigError(f'--html needs plotly: pip install plotly ({error})') from None


def write_timeline(path: Path, facts: Mapping[str, Any], lines: Sequence[str]) -> None:
    """Write one whole HTML page with the timeline of facts, and the text of `boxreg inspect`."""
    import plotly.graph_objects as go

    rows = {entry['topic']: entry for entry in facts['topics']}
    figure = go.Figure(layout=_layout(len(rows)))
    present = [(topic, part) for topic in rows for part in rows[topic]['presence_s']]
    _add_lines(figure, 'messages', MESSAGE_COLOUR, 12, present)
    gaps = [(topic, part) for topic in rows for part in rows[topic]['gaps_s']]
    _add_lines(figure, 'gap', GAP_COLOUR, 4, gaps)
    damaged = [(rows_name, part) for part in _damaged(facts) for rows_name in rows]
    _add_lines(figure, 'damage', DAMAGE_COLOUR, 3, damaged)
    text = '\n'.join(escape(line) for line in lines)
    drawing = figure.to_html(full_html=False, include_plotlyjs=True)
    with written_whole(path) as file:
        file.write(
            f'<!doctype html><meta charset="utf-8"><title>{escape(lines[0])}</title>'
            f'<body style="font-family:sans-serif">{drawing}<pre>{text}</pre>'
        )


def merged_spans(
    spans: Sequence[tuple[int, int]], begin_ns: int, seconds: float
) -> list[list[float]]:
    """Return ascending spans [ns] as [s] from the begin; those too close to be seen are joined."""
    nearest = seconds / MAX_PARTS
    merged: list[list[float]] = []
    for first_ns, last_ns in spans:
        first = (first_ns - begin_ns) * 1e-9
        last = (last_ns - begin_ns) * 1e-9
        if merged and first - merged[-1][1] <= nearest:
            merged[-1][1] = max(merged[-1][1], last)
        else:
            merged.append([first, last])
    return merged


def _damaged(facts: Mapping[str, Any]) -> Iterator[list[float]]:
    """Yield begin and end of the damages of known time [s]."""
    for damage in facts['damage']:
        if damage['start_ns'] is not None and damage['end_ns'] is not None:
            yield [(damage[name] - facts['begin_ns']) * 1e-9 for name in ('start_ns', 'end_ns')]


def _add_lines(
    figure: Any, name: str, colour: str, width: int, parts: Sequence[tuple[str, Sequence[float]]]
) -> None:
    """Add horizontal lines, each of a topic from begin to end; a break is between them."""
    if not parts:
        return
    times: list[float | None] = []
    topics: list[str | None] = []
    for topic, (begin, end) in parts:
        times += [begin, end, None]
        topics += [topic, topic, None]
    figure.add_scatter(
        x=times, y=topics, name=name, mode='lines+markers',
        line={'color': colour, 'width': width}, marker={'color': colour, 'size': width / 2},
        hovertemplate='%{y}: %{x:.3f} s',
    )  # fmt: skip


def _layout(count: int) -> dict[str, Any]:
    return {
        'height': 160 + ROW_PIXELS * count,
        'xaxis': {'title': {'text': 'receive time from the beginning [s]'}},
        'yaxis': {'autorange': 'reversed', 'type': 'category', 'automargin': True},
        'legend': {'orientation': 'h', 'y': 1.02, 'yanchor': 'bottom'},
        'template': 'plotly_white',
        'margin': {'t': 60},
    }
