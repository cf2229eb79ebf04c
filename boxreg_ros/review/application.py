"""The web application of `boxreg review`: pages, decisions, solving again, label files."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, UTC
import os
from pathlib import Path
import secrets
import sys
from tempfile import NamedTemporaryFile
from threading import Lock, Thread
from time import monotonic
from typing import Any
from zipfile import ZipFile

import anyio
from boxreg_ros.errors import BoxregError, RecordingError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.steps import PROGRESS
from boxreg_ros.review.decisions import Decision, DecisionLog, DECISIONS, WITH_BOX
from boxreg_ros.review.differences import differences
from boxreg_ros.review.folders import next_folder, SUMMARY
from boxreg_ros.review.progress import agreement_text, PAUSE, progress_of, total, UNREAD
from boxreg_ros.review.report import page_environment, PAGE_VERSION, REPORT, style
from boxreg_ros.review.requests import box_of, json_of, posted, STAMP, stamp_of, text_of
from boxreg_ros.review.scene import DriveSource
from boxreg_ros.review.scene_routes import SceneRoutes
from boxreg_ros.review.solve import ReportParts
import orjson
from starlette import responses
from starlette.applications import Starlette
from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route
from starlette.types import ASGIApp, Receive, Scope, Send

PROPOSALS = 'proposals.csv'
BOXES = 'boxes.csv'
MAX_ROWS = 10_000
"""Most decisions of a request: a track that is made of as many parts; chosen."""
OPEN_SECONDS = 600.0
"""A track is open to one person for so long; chosen: then the person has left."""
POLL_SECONDS = 0.25
"""Another program may append to the file: the time until its decisions are seen; chosen."""
MARK = f'<html lang="en" data-page="{PAGE_VERSION}"'.encode()
"""Begins a page of this version, which offers decisions where ``data-review`` follows."""
MARK_WITHIN = 1000
"""Bytes of the page that have it."""
HEADERS = {
    'Cache-Control': 'no-store',
    'X-Content-Type-Options': 'nosniff',
    'X-Frame-Options': 'DENY',
    'Referrer-Policy': 'no-referrer',
}
POLICY = (
    "default-src 'none'; script-src 'nonce-{nonce}'; style-src 'unsafe-inline'; "
    "img-src data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
DRIVES_TEMPLATE = 'drives.html.j2'
DRIVES_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'"


def review_application(reviews: Sequence[Review], port: int, token: str) -> ASGIApp:
    """
    Return the application for some reviews, which refuses requests without a token.

    Several reviews are behind a page of their progress. The port is one on loopback: requests
    under another name are refused. The token is in the address of the first request or in the
    cookie that this one sets.

    """
    applications = [review.application() for review in reviews]
    if len(reviews) == 1:
        return _Guard(applications[0], port, token)

    async def page(_: Request) -> Response:
        text = await run_in_threadpool(_page_of_drives, reviews)
        headers = {'Content-Security-Policy': DRIVES_POLICY}
        return responses.HTMLResponse(text, headers=headers)

    mounts = [Mount(f'/{number}', app=one) for number, one in enumerate(applications)]
    return _Guard(Starlette(routes=[Route('/', page), *mounts]), port, token)


class _Guard:
    """
    Refuse requests under another name, of other pages, or without the token.

    A page of the network may know the port, and a name that leads to this machine.

    """

    def __init__(self, application: ASGIApp, port: int, token: str) -> None:
        self._application = application
        self._hosts = [f'{name}:{port}' for name in ('127.0.0.1', 'localhost')]
        self._token = token
        self._cookie = f'boxreg_{port}'

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        request = Request(scope)
        answer: ASGIApp = self._application
        known = request.query_params.get('token') or request.cookies.get(self._cookie, '')
        origin = request.headers.get('origin')
        if request.headers.get('host') not in self._hosts or (
            origin is not None and origin.removeprefix('http://') not in self._hosts
        ):
            answer = PlainTextResponse(f'expected the address http://{self._hosts[0]}/', 403)
        elif not secrets.compare_digest(known.encode(), self._token.encode()):
            answer = PlainTextResponse('expected the address that boxreg review has printed', 403)

        async def send_with_headers(message: Any) -> None:
            if message['type'] == 'http.response.start':
                cookie = f'{self._cookie}={self._token}; HttpOnly; SameSite=Strict; Path=/'
                found = dict(HEADERS)
                if 'token' in request.query_params and message['status'] == 200:
                    found['Set-Cookie'] = cookie
                message['headers'] += [(k.lower().encode(), v.encode()) for k, v in found.items()]
            await send(message)

        await answer(scope, receive, send_with_headers)


@dataclass(eq=False, repr=False)
class Review:
    """
    The state of a review, and the answers to its requests. It goes on in what it writes.

    A recording, the `source`, gives whole clouds and added objects. `who` is the person where the
    page sends none; `classes` are to choose from, none for those of the result. Streams of events
    end when the server `is_ending`. Raises RecordingError if decisions or summary cannot be read.

    """

    out: Path
    source: DriveSource | None
    who: str
    classes: Sequence[str]
    token: str
    is_ending: Callable[[], bool]

    def __post_init__(self) -> None:
        """Read the result."""
        self.listeners = 0
        self._open: dict[str, tuple[str, float]] = {}  # tracks by page, and since when
        self._log_lock = Lock()
        self._save_lock = asyncio.Lock()
        self._progress = ''  # of the run that writes labels, as JSON
        self._written = 0  # how often labels were written
        self._load(self.out)

    def _load(self, out: Path) -> None:
        """Take over a result."""
        self._page = (out / REPORT).read_bytes()
        if MARK not in self._page[:MARK_WITHIN]:
            raise RecordingError(
                f'{out / REPORT}: expected a report of this version, got one of another; run '
                f'boxreg relabel RECORDING -o NEW --report with the same options'
            )
        self._parts = ReportParts(out, self._page)
        self._summary = orjson.loads((out / SUMMARY).read_bytes())
        self._frame_id: str = self._summary['fixed_frame']
        self.out = out
        self._proposals = _proposals_of(out)
        self._changes = _changes_of(out, self._summary)
        self._log = DecisionLog(out / DECISIONS)
        Thread(target=self._parts.warm_up, daemon=True).start()

    def application(self) -> Starlette:
        """Return the application of this result."""
        routes = [
            Route('/', self.page),
            Route('/decisions', self.decisions, methods=['GET']),
            Route('/decisions', self.decide, methods=['POST']),
            Route('/events', self.events),
            Route('/open', self.note_open, methods=['POST']),
            Route('/solve', posted(lambda sent: self._parts.solved(sent)), methods=['POST']),
            Route('/risk', posted(lambda sent: self._parts.risks(sent)), methods=['POST']),
            Route('/save', self.save, methods=['POST']),
            Route('/files', self.files),
            Route('/download', self.download),
        ]
        if self.source is not None:
            routes += SceneRoutes(self.source, self._frame_id).routes()
        handlers: Any = {BoxregError: _refused, OSError: _failed}
        return Starlette(routes=routes, exception_handlers=handlers)

    async def page(self, _: Request) -> Response:
        """Return the page; its scripts alone may run."""
        nonce = secrets.token_urlsafe(16)
        page = self._page.replace(MARK, MARK + b' data-review', 1)
        page = page.replace(b'\n<script>', f'\n<script nonce="{nonce}">'.encode())
        policy = {'Content-Security-Policy': POLICY.format(nonce=nonce)}
        return Response(page, media_type='text/html', headers=policy)

    async def decisions(self, _: Request) -> Response:
        """Return all decisions."""
        await run_in_threadpool(self._refresh)
        has_scene = self.source is not None
        more = {
            'who': self.who,
            'token': self.token,
            'has_scene': has_scene,
            'proposals': self._proposals,
            'changes': self._changes,
            'classes': list(self.classes),
        }
        return JSONResponse({**self._since(0), **more})

    async def decide(self, request: Request) -> Response:
        """Append decisions, unless others have decided about these tracks since."""
        sent = await json_of(request)
        rows = sent.get('rows')
        if not isinstance(rows, list) or not 0 < len(rows) <= MAX_ROWS:
            raise RecordingError(f'rows: expected 1 to {MAX_ROWS} decisions in a list')
        when = datetime.now(UTC).isoformat(timespec='milliseconds')  # one for all: undone at once
        new = [self._decision(row, when) for row in rows]
        return await run_in_threadpool(self._append, new, sent.get('seen'))

    async def events(self, request: Request) -> Response:
        """Stream decisions as they are made, by whomever."""
        seen = request.headers.get('last-event-id') or request.query_params.get('seen', '')
        if not (seen.isdecimal() and STAMP.fullmatch(seen)):
            raise RecordingError('seen: expected the number of known decisions')
        return responses.StreamingResponse(self._stream(int(seen)), media_type='text/event-stream')

    async def note_open(self, request: Request) -> Response:
        """Note the track that a page has open, and return those that others have."""
        sent = await json_of(request)
        page, track = text_of(sent, 'page'), text_of(sent, 'track')
        now = monotonic()
        self._open = {
            one: known for one, known in self._open.items() if now - known[1] < OPEN_SECONDS
        }
        if track:
            self._open[page] = track, now
        return JSONResponse([known for one, (known, _) in self._open.items() if one != page])

    async def save(self, request: Request) -> Response:
        """Run the command of the result again with the decisions, into a folder beside it."""
        formats = await run_in_threadpool(self._formats_of, await json_of(request))
        if self._save_lock.locked():
            raise HTTPException(409, 'label files are being written already: wait for them')
        async with self._save_lock:
            try:
                return await self._relabel(formats)
            finally:
                self._progress = ''

    async def files(self, _: Request) -> Response:
        """Return the files of the result, and the formats that can be written."""
        listed = self._summary.get('files', {}).items()
        formats = {} if self.source is None else await run_in_threadpool(self.source.formats)
        chosen = () if self.source is None else self.source.chosen
        return JSONResponse({
            'folder': str(self.out.resolve()),
            'files': [{'name': name, 'size': about['size']} for name, about in listed],
            'formats': [
                {'name': name, 'title': title, 'is_chosen': name in chosen}
                for name, title in formats.items()
            ],
        })  # fmt: skip

    async def download(self, request: Request) -> Response:
        """Return a file of the result, or a folder of it as one archive."""
        name = request.query_params.get('name', '')
        names = [SUMMARY, *self._summary.get('files', {})]
        if name in names:
            return responses.FileResponse(self.out / name, filename=Path(name).name)
        inside = [one for one in names if one.startswith(f'{name}/')]
        if not inside:
            raise RecordingError(f'name: expected a file of the result, got {name!r:.80}')
        path = await run_in_threadpool(_archive, self.out, inside)
        task = BackgroundTask(path.unlink)
        return responses.FileResponse(path, filename=f'{Path(name).name}.zip', background=task)

    def _formats_of(self, sent: Mapping[str, Any]) -> list[str]:
        """Return the formats that a request asks for; none for those of the result."""
        names = sent.get('formats', [])
        known = {} if self.source is None or not names else self.source.formats()
        if not isinstance(names, list) or not all(name in known for name in names):
            raise RecordingError(
                f'formats: expected some of {", ".join(known)}, got {names!r:.80}'
            )
        return names

    def _refresh(self) -> None:
        with self._log_lock:
            self._log.refresh()

    def _append(self, new: list[Decision], seen: object) -> Response:
        with self._log_lock, self._log.locked():
            count = len(self._log.decisions)
            known = seen if isinstance(seen, int) and seen >= 0 else 0
            first = known if known <= count else 0
            tracks = {one.track_id for one in new}
            missed = [one for one in self._log.decisions[first:] if one.track_id in tracks]
            if missed:
                last = missed[-1]
                text = (
                    f'{last.who or "another person"} has decided about track '
                    f'{last.track_id!r:.80} meanwhile ({last.kind}): look, then decide again'
                )
                return JSONResponse({**self._since(first, known), 'message': text}, 409)
            self._log.append_locked(new)
        return JSONResponse(self._since(first, known))

    def _since(self, first: int, known: int = 0) -> dict[str, Any]:
        """Return the decisions from `first` on to a page that had `known` ones of the file."""
        rows = [one.as_json() for one in self._log.decisions[first:]]
        return {'first': first, 'rows': rows, 'is_replaced': known > first}

    async def _stream(self, seen: int) -> AsyncIterator[bytes]:
        yield b'retry: 1000\n\n'
        self.listeners += 1
        progress, written = '', self._written
        try:
            while not self.is_ending():
                if self._progress != progress:
                    progress = self._progress
                    yield f'event: progress\ndata: {progress or "{}"}\n\n'.encode()
                if self._written != written:
                    written = self._written
                    yield f'event: written\ndata: {written}\n\n'.encode()
                await run_in_threadpool(self._refresh)
                if len(self._log.decisions) != seen:
                    first = seen if seen < len(self._log.decisions) else 0
                    data = orjson.dumps(self._since(first, seen)).decode()
                    seen = len(self._log.decisions)
                    yield f'id: {seen}\ndata: {data}\n\n'.encode()
                await anyio.sleep(POLL_SECONDS)
        finally:
            self.listeners -= 1

    def _decision(self, sent: object, when: str) -> Decision:
        """Return the decision that the page has sent."""
        if not isinstance(sent, dict):
            raise RecordingError('decision: expected an object')
        box = box_of(sent.get('box')) if sent.get('decision') in WITH_BOX else None
        return Decision(
            track_id=text_of(sent, 'track_id'),
            stamp_ns=stamp_of(sent, 'stamp_ns'),
            kind=text_of(sent, 'decision'),
            comment=text_of(sent, 'comment'),
            frame_id=self._frame_id if box is not None else '',
            box=box,
            end_ns=stamp_of(sent, 'end_ns'),
            value=text_of(sent, 'value'),
            who=text_of(sent, 'who') or self.who,
            when=when,
        )

    async def _relabel(self, formats: Sequence[str]) -> Response:
        command = self._summary['command']
        folder = Path(self._summary['folder'])
        decisions = (self.out / DECISIONS).resolve()
        if command[:1] != ['relabel'] or not folder.is_dir():
            raise RecordingError(
                f'expected a result of boxreg relabel in {str(folder)!r}, got one of '
                f'{command[:1]}, or the folder is gone; run boxreg relabel RECORDING -o NEW '
                f'--decisions {decisions}'
            )
        new = next_folder(self.out.resolve())
        more = ['-o', str(new), '--report']
        if formats:
            more += ['--formats', ','.join(formats)]
        if decisions.exists():
            more += ['--decisions', str(decisions)]
        with NamedTemporaryFile() as steps:
            process = await asyncio.create_subprocess_exec(
                sys.executable, '-m', 'boxreg_ros.cli', *command, *more,
                cwd=folder, env={**os.environ, PROGRESS: steps.name},
                stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
            )  # fmt: skip
            watching = asyncio.create_task(self._watch(Path(steps.name)))
            try:
                output, errors = await process.communicate()
            finally:
                watching.cancel()
                if process.returncode is None:
                    process.terminate()  # it removes what it has begun
        lines = [part.decode(errors='replace').splitlines() for part in (output, errors)]
        if not lines[0]:  # nothing was written
            raise RecordingError(lines[1][-1] if lines[1] else 'boxreg relabel failed')
        error = lines[1].pop() if process.returncode and lines[1] else ''
        await run_in_threadpool(self._go_on_in, new)
        found = {'line': lines[0][-1], 'notes': lines[1], 'error': error}
        return JSONResponse({'out': str(new), 'written': self._written, **found})

    async def _watch(self, steps: Path) -> None:
        """Note the progress of a run, which has what is done, and the total, in a file [s]."""
        while True:
            await anyio.sleep(POLL_SECONDS)
            words = steps.read_text(encoding='utf-8').split()
            if len(words) == 2:  # else it is being written
                done, total_seconds = map(float, words)
                self._progress = orjson.dumps({'done': done, 'total': total_seconds}).decode()

    def _go_on_in(self, new: Path) -> None:
        """Go on in the result that was written, with what was decided meanwhile."""
        with self._log_lock, self._log.locked():
            before = list(self._log.decisions)
            self._load(new)
            late = before[len(self._log.decisions) :]
            if late:
                self._log.append(late)
        self._written += 1
        print(f'written: {new}; to go on another time: boxreg review {new}', flush=True)


async def _refused(_: Request, error: Exception) -> Response:
    return PlainTextResponse(str(error), 400)


async def _failed(_: Request, error: Exception) -> Response:
    return PlainTextResponse(f'expected a file that can be written, got: {error}', 500)


def _changes_of(out: Path, summary: Mapping[str, Any]) -> list[dict[str, Any]] | None:
    """Return what changed since the result whose decisions this one has; None without one."""
    command = summary['command'][::-1]  # of several, the last one holds
    if '--decisions' not in command:
        return None
    path = command[command.index('--decisions') - 1]
    earlier = Path(summary['folder'], path).parent
    if not (earlier / BOXES).is_file() or earlier.resolve() == out.resolve():
        return None
    return differences(BoxTable.read(earlier / BOXES), BoxTable.read(out / BOXES))


def _archive(out: Path, names: Sequence[str]) -> Path:
    """Return a temporary archive of some files of a result."""
    with NamedTemporaryFile(suffix='.zip', delete=False) as file, ZipFile(file, 'w') as archive:
        for name in names:
            archive.write(out / name, name)
    return Path(file.name)


def _page_of_drives(reviews: Sequence[Review]) -> str:
    """Return the page of the progress of all drives, the most risk left first."""
    found = []
    problems = []
    for number, review in enumerate(reviews):
        try:
            found.append((progress_of(review.out), number, review.listeners))
        except BoxregError as error:
            problems.append(str(error))
    found.sort(key=lambda row: -row[0].risk_left)
    drives = [one for one, *_ in found]
    text: str = page_environment().get_template(DRIVES_TEMPLATE).render(
        css=style(), drives=[*found, (total(drives), None, 0)], problems=problems,
        unread=UNREAD, pause=PAUSE, agreement=agreement_text([one.out for one in drives]),
    )  # fmt: skip
    return text


def _proposals_of(out: Path) -> list[dict[str, Any]]:
    """Return stamp, class, box and points of the objects that a result proposes, if any."""
    path = out / PROPOSALS
    if not path.is_file():
        return []
    table = BoxTable.read(path)
    columns = table.stamps_ns, table.class_names, table.boxes, table.num_points
    return [
        {'stamp': str(stamp), 'class': name, 'box': box.tolist(), 'points': int(points)}
        for stamp, name, box, points in zip(*columns, strict=True)
    ]
