"""Serve the report of a result on this machine, and write down decisions."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from getpass import getuser
from pathlib import Path
import signal
import socket
from typing import TYPE_CHECKING

from boxreg_ros.errors import ConfigError, RecordingError

if TYPE_CHECKING:
    from boxreg_ros.review.scene import DriveSource

    Results = Sequence[tuple[Path, DriveSource | None]]

HOST = '127.0.0.1'
PORT = 8765
SUMMARY = 'summary.json'
SERVER_PACKAGES = ('starlette', 'uvicorn')
SHUTDOWN_SECONDS = 1
"""Pages that listen for decisions are left after this time; chosen."""


def add_server_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the server."""
    parser.add_argument(
        '--port', type=int, default=PORT, metavar='N',
        help='port on this machine, 0 for any free one (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--who', default=_user(), metavar='NAME',
        help='name beside the decisions; the page can change it (default: %(default)s)',
    )  # fmt: skip


def serve(results: Results, port: int, who: str) -> int:
    """Serve until interrupted, or ended by a signal: each decision is saved already."""
    server = review_server(results, port, who)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:  # nohup ignores SIGHUP
            signal.signal(number, lambda *_: server.shutdown())
    print(server.address, flush=True)
    for path in server.log_paths:
        print(f'decisions: {path}; Ctrl-C ends', flush=True)
    server.serve_forever()
    for path in filter(Path.exists, server.log_paths):
        print(f'to apply them: boxreg relabel RECORDING -o NEW --decisions {path}')
    return 0


class ReviewServer:
    """A server for result folders on loopback; its `address` has the token that opens the page."""

    def __init__(self, results: Results, bound: socket.socket, who: str) -> None:
        from boxreg_ros.review.application import review_application, TimedProtocol
        from boxreg_ros.review.decisions import DECISIONS
        from uvicorn import Config, Server

        self._socket = bound
        self.server_port = int(bound.getsockname()[1])
        application, token = review_application(results, self.server_port, who, self._is_ending)
        self.log_paths = [out / DECISIONS for out, _ in results]
        self.address = f'http://{HOST}:{self.server_port}/?token={token}'
        config = Config(
            application, http=TimedProtocol, ws='none', lifespan='off', log_config=None,
            log_level='critical', server_header=False, date_header=False,
            timeout_graceful_shutdown=SHUTDOWN_SECONDS,
        )  # fmt: skip
        self._server = Server(config)

    def serve_forever(self) -> None:
        """Serve until `shutdown`."""
        self._server.run(sockets=[self._socket])

    def shutdown(self) -> None:
        """End `serve_forever`."""
        self._server.should_exit = True

    def _is_ending(self) -> bool:
        return self._server.should_exit


def review_server(results: Results, port: int, who: str = '') -> ReviewServer:
    """
    Return a server, bound to loopback, for result folders and their recordings.

    Raises RecordingError if a folder has no finished report, or its decisions cannot be read, and
    ConfigError if the port is in use, or a package is missing.

    """
    from boxreg_ros.review.report import check_packages, REPORT

    check_packages('boxreg review', SERVER_PACKAGES)
    for out, _ in results:
        missing = [name for name in (SUMMARY, REPORT) if not (out / name).is_file()]
        if missing:
            raise RecordingError(
                f'{out}: expected a finished result with {SUMMARY} and {REPORT}, got one without '
                f'{" and ".join(missing)}; run boxreg relabel RECORDING -o {out} --report'
            )
    bound = socket.socket()
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind((HOST, port))
        bound.listen()  # a second server on this port fails here
    except (OSError, OverflowError) as error:
        bound.close()
        raise ConfigError(
            f'port: expected a free one, got {port} ({error}); choose another with --port, or 0 '
            f'for any'
        ) from None
    return ReviewServer(results, bound, who or _user())


def _user() -> str:
    """Return the name of the user; empty where the system has none."""
    try:
        return getuser()
    except (KeyError, OSError):
        return ''
