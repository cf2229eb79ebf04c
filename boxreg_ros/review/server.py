"""`boxreg review`: serve the report of a result on this machine and write down decisions."""

from __future__ import annotations

import argparse
from contextlib import suppress
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
import json
from pathlib import Path
import signal
from threading import Lock
from typing import Any

from boxreg_ros.errors import BoxregError, ConfigError, RecordingError

HOST = '127.0.0.1'
PORT = 8765
MAX_BODY = 65536
"""Longest request [bytes]: a decision takes less than 3 kB."""
SUMMARY = 'summary.json'
MARK = b'<html lang="en"', b'<html lang="en" data-review'
"""The page offers decisions where its root element has this attribute."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `boxreg review`."""
    parser.add_argument('out', type=Path, metavar='OUT', help='result of boxreg relabel --report')
    parser.add_argument(
        '--port', type=int, default=PORT, metavar='N',
        help='port on this machine, 0 for any free one (default: %(default)s)',
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Serve until interrupted, or ended by a signal: each decision is saved already."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:  # nohup ignores SIGHUP
            signal.signal(number, signal.default_int_handler)
    with review_server(args.out, args.port) as server:
        with suppress(KeyboardInterrupt):
            print(f'http://{HOST}:{server.server_port}/', flush=True)
            print(f'decisions: {server.log_path}; Ctrl-C ends', flush=True)
            server.serve_forever()
        if server.log_path.exists():
            print(f'to apply them: boxreg relabel RECORDING -o NEW --decisions {server.log_path}')
    return 0


class ReviewServer(ThreadingHTTPServer):
    """A server for one result folder; `log_path` is the file of its decisions."""

    daemon_threads = True
    allow_reuse_address = True
    log_path: Path


def review_server(out: Path, port: int) -> ReviewServer:
    """
    Return a server, bound to loopback, for the report and the decisions of a result folder.

    Raises
    ------
    RecordingError
        If the folder has no finished report, or its decisions cannot be read.
    ConfigError
        If the port is in use.

    """
    from boxreg_ros.review.decisions import DecisionLog, DECISIONS
    from boxreg_ros.review.report import REPORT

    missing = [name for name in (SUMMARY, REPORT) if not (out / name).is_file()]
    if missing:
        raise RecordingError(
            f'{out}: expected a finished result with {SUMMARY} and {REPORT}, got one without '
            f'{" and ".join(missing)}; run boxreg relabel RECORDING -o {out} --report'
        )
    page = (out / REPORT).read_bytes().replace(*MARK, 1)
    frame_id = json.loads((out / SUMMARY).read_text(encoding='utf-8'))['fixed_frame']
    log = DecisionLog(out / DECISIONS)
    handler = partial(_Handler, page, log, Lock(), frame_id)
    try:
        server = ReviewServer((HOST, port), handler)
    except (OSError, OverflowError) as error:
        raise ConfigError(
            f'port: expected a free one, got {port} ({error}); choose another with --port, or 0 '
            f'for any'
        ) from None
    server.log_path = out / DECISIONS
    return server


class _Handler(BaseHTTPRequestHandler):
    """Answers one request: the page, all decisions, or a new decision."""

    def __init__(self, page: bytes, log: Any, lock: Lock, frame_id: str, *args: Any) -> None:
        self._page = page
        self._log = log
        self._lock = lock
        self._frame_id = frame_id
        super().__init__(*args)

    def do_GET(self) -> None:
        """Send the page or the decisions."""
        if not self._is_local():
            return
        if self.path in ('/', '/report.html'):
            self._send(200, self._page, 'text/html; charset=utf-8')
        elif self.path == '/decisions':
            rows = [decision.as_json() for decision in self._log.decisions]
            self._send(200, json.dumps(rows).encode(), 'application/json')
        else:
            self._send(404, b'expected / or /decisions', 'text/plain')

    def do_POST(self) -> None:
        """Append a decision."""
        if not self._is_local():
            return
        length = self.headers.get('Content-Length', '')
        if self.path != '/decisions' or not length.isdigit() or int(length) > MAX_BODY:
            self._send(400, b'expected a decision for /decisions', 'text/plain')
            return
        if self.headers.get('Content-Type') != 'application/json':  # no form of another page
            self._send(415, b'expected application/json', 'text/plain')
            return
        try:
            decision = self._decision(json.loads(self.rfile.read(int(length))))
            with self._lock:
                self._log.append(decision)
        except (BoxregError, OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            self._send(400, str(error).encode(), 'text/plain; charset=utf-8')
            return
        self._send(200, b'{}', 'application/json')

    def log_message(self, *_: Any) -> None:
        """Print nothing: the terminal is for the address and errors."""

    def _decision(self, sent: dict[str, Any]) -> Any:
        from boxreg_ros.review.decisions import Decision
        import numpy as np

        box = sent.get('box')
        return Decision(
            track_id=str(sent['track_id']),
            stamp_ns=int(sent['stamp_ns']) if sent.get('stamp_ns') else None,
            kind=sent['decision'],
            comment=str(sent.get('comment', '')),
            frame_id=self._frame_id if box else '',
            box=np.array(box, np.float64) if box else None,
        )

    def _is_local(self) -> bool:
        """Refuse requests under another name: a page of the network must not reach this one."""
        port = self.connection.getsockname()[1]
        own = [f'{host}:{port}' for host in (HOST, 'localhost')]
        origin = self.headers.get('Origin')
        if self.headers.get('Host') in own and origin in (None, *(f'http://{o}' for o in own)):
            return True
        self._send(403, f'expected the address http://{own[0]}/'.encode(), 'text/plain')
        return False

    def _send(self, status: int, body: bytes, kind: str) -> None:
        self.send_response(status)
        self.send_header('Content-Type', kind)
        self.send_header('Content-Length', str(len(body)))
        self.send_header('Cache-Control', 'no-store')
        self.end_headers()
        self.wfile.write(body)
