"""Serve the report of a result on this machine, and write down decisions."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from getpass import getuser
import os
from pathlib import Path
import signal
import socket
import sys
from threading import Thread
from typing import TYPE_CHECKING
import webbrowser

from boxreg_ros.errors import ConfigError, RecordingError, require_packages

if TYPE_CHECKING:
    from boxreg_ros.review.scene import DriveSource

    Results = Sequence[tuple[Path, DriveSource | None]]

HOST = '127.0.0.1'
PORT = 8765
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
    parser.add_argument(
        '--classes', type=Path, metavar='FILE',
        help='classes to choose from, one a line; the first nine have the keys 1 to 9 (default: '
        'those of the result)',
    )  # fmt: skip
    parser.add_argument(
        '--no-browser', dest='opens', action='store_false',
        help='open no browser where there is one',
    )  # fmt: skip


def classes_of(path: Path | None) -> list[str]:
    """Return the classes of a file, one a line; RecordingError if it cannot be read."""
    if path is None:
        return []
    try:
        lines = path.read_text(encoding='utf-8-sig').splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(
            f'{path}: expected a text file with one class a line, got: {error}; give another with '
            f'--classes'
        ) from None
    return list(dict.fromkeys(name.strip() for name in lines if name.strip()))


def serve(
    results: Results, port: int, who: str, opens: bool = True, classes: Sequence[str] = ()
) -> int:
    """Serve until interrupted, or ended by a signal: each decision is saved already."""
    server = review_server(results, port, who, classes)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:  # nohup ignores SIGHUP
            signal.signal(number, lambda *_: server.shutdown())
    print(server.address, flush=True)
    for path in server.log_paths:
        print(f'decisions: {path}; Ctrl-C ends', flush=True)
    if opens and has_screen():
        Thread(target=webbrowser.open, args=[server.address], daemon=True).start()
    server.serve_forever()
    for path in filter(Path.exists, server.log_paths):
        print(f'to apply them: boxreg relabel RECORDING -o NEW --decisions {path}')
    return 0


def has_screen() -> bool:
    """Return whether a browser would open before the person who has started the program."""
    if 'SSH_CONNECTION' in os.environ:
        return False
    if sys.platform.startswith('linux'):
        return bool(os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY'))
    return True


class ReviewServer:
    """A server for result folders on loopback; its `address` has the token that opens the page."""

    def __init__(
        self, results: Results, bound: socket.socket, who: str, classes: Sequence[str]
    ) -> None:
        from boxreg_ros.review.application import Review, review_application
        from boxreg_ros.review.token import review_token
        from uvicorn import Config, Server

        self._socket = bound
        self.server_port = int(bound.getsockname()[1])
        token = review_token([out for out, _ in results])
        self._reviews = [Review(*one, who, classes, token, self._is_ending) for one in results]
        application = review_application(self._reviews, self.server_port, token)
        self.address = f'http://{HOST}:{self.server_port}/?token={token}'
        config = Config(
            application, http='h11', ws='none', lifespan='off', log_config=None,
            log_level='critical', server_header=False, date_header=False,
            timeout_graceful_shutdown=SHUTDOWN_SECONDS,
        )  # fmt: skip
        self._server = Server(config)

    @property
    def log_paths(self) -> list[Path]:
        """Return the files of decisions, of the results that were written meanwhile."""
        from boxreg_ros.review.decisions import DECISIONS

        return [review.out / DECISIONS for review in self._reviews]

    def serve_forever(self) -> None:
        """Serve until `shutdown`."""
        self._server.run(sockets=[self._socket])

    def shutdown(self) -> None:
        """End `serve_forever`."""
        self._server.should_exit = True

    def _is_ending(self) -> bool:
        return self._server.should_exit


def review_server(
    results: Results, port: int, who: str = '', classes: Sequence[str] = ()
) -> ReviewServer:
    """
    Return a server, bound to loopback, for result folders and their recordings.

    Parameters
    ----------
    results : sequence of (Path, DriveSource or None)
        Result folders, each with its recording; without this there are no whole clouds.
    port : int
        To listen on; 0 for any free one.
    who : str
        Person who decides, where the page sends none; by default the user.
    classes : sequence of str
        Class names to choose from on the page; none for those of the result.

    Returns
    -------
    server : ReviewServer
        Serves after `serve_forever` is called.

    Raises
    ------
    RecordingError
        If a folder has no finished report, or its decisions cannot be read.
    ConfigError
        If the port is in use, or a package is missing.

    """
    from boxreg_ros.review.folders import SUMMARY
    from boxreg_ros.review.report import REPORT

    require_packages('boxreg review', SERVER_PACKAGES)
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
    return ReviewServer(results, bound, who or _user(), classes)


def _user() -> str:
    """Return the name of the user; empty where the system has none."""
    try:
        return getuser()
    except (KeyError, OSError):
        return ''
