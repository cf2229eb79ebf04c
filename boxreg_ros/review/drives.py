"""Several results under one server: a page of their progress, and each under its number."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from boxreg_ros.errors import BoxregError
from boxreg_ros.review.progress import (
    agreement_text,
    by_risk_left,
    DriveProgress,
    PAUSE,
    progress_of,
    total,
    UNREAD,
)
from boxreg_ros.review.report import PAGE, STYLE
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import Mount, Route
from starlette.types import ASGIApp

DRIVES_TEMPLATE = 'drives.html.j2'
DRIVES_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'"


class Reviewed(Protocol):
    """A result under review."""

    out: Path
    listeners: int
    """Pages that are open."""


def drives_application(reviews: Sequence[tuple[Reviewed, ASGIApp]]) -> Starlette:
    """Return the page of all drives at ``/``, and the application of each under its number."""

    async def page(_: Request) -> Response:
        text = await run_in_threadpool(_page, [review for review, _ in reviews])
        return HTMLResponse(text, headers={'Content-Security-Policy': DRIVES_POLICY})

    mounts = [Mount(f'/{number}', app=one) for number, (_, one) in enumerate(reviews)]
    return Starlette(routes=[Route('/', page), *mounts])


def _page(reviews: Sequence[Reviewed]) -> str:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    found: list[DriveProgress] = []
    problems = []
    for one in reviews:
        try:
            found.append(progress_of(one.out))
        except BoxregError as error:
            problems.append(str(error))
    number_of = {one.out: number for number, one in enumerate(reviews)}
    rows: list[tuple[DriveProgress, int | None, int]] = [
        (one, number_of[one.out], reviews[number_of[one.out]].listeners)
        for one in by_risk_left(found)
    ]
    rows.append((total(found), None, 0))
    environment = Environment(
        loader=FileSystemLoader(PAGE), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    css = Markup((PAGE / STYLE).read_text(encoding='utf-8'))
    return environment.get_template(DRIVES_TEMPLATE).render(
        css=css, drives=rows, problems=problems, unread=UNREAD, pause=PAUSE,
        agreement=agreement_text([one.out for one in found]),
    )  # fmt: skip
