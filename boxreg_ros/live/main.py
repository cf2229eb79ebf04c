"""Entry points of the live node, plain and managed; arguments, errors and exit status."""

from __future__ import annotations

from collections.abc import Sequence
import os
import signal
import sys

from boxreg_ros.allocation import collect_rarely, keep_freed_memory
from boxreg_ros.errors import BoxregError, ConfigError, one_line
from boxreg_ros.io.warm_up import SecondProcess

NAME = 'boxreg_node'
WITHOUT_ROS = "source a ROS 2 Jazzy installation, or pip install 'boxreg_ros[ros]'"


def main(args: Sequence[str] | None = None, is_managed: bool = False) -> int:
    """
    Run the node until SIGINT or SIGTERM, then end the process.

    Once started the process ends here, with status 0 after a signal and 1 after a failure.
    Failures are printed in one line on stderr.

    Parameters
    ----------
    args : sequence of str, optional
        Arguments, those of ROS too; default: those of the process.
    is_managed : bool
        Whether the node has the states of a lifecycle node.

    Returns
    -------
    status : int
        If the node could not start: 2 if an argument or a parameter is wrong, else 1.

    """
    for number in (signal.SIGINT, signal.SIGTERM):
        # Until the node runs, a signal ends the process at once. An exception would be lost if
        # the signal came within a destructor.
        signal.signal(number, lambda *_: os._exit(0))
    second = SecondProcess.forked()
    try:
        from boxreg_ros.live.process import make_node, run, shut_down
    except ImportError as error:
        return _fail(BoxregError(f'{error}: {WITHOUT_ROS}'), 1)

    keep_freed_memory()
    collect_rarely()
    try:
        arguments = list(sys.argv[1:] if args is None else args)
        node = make_node(NAME, arguments, second, is_managed)
    except Exception as error:
        shut_down()
        is_usage = isinstance(error, ConfigError) or not isinstance(error, BoxregError)
        return _fail(error, 2 if is_usage else 1)
    failures = run(node)
    if second is not None:
        second.end(is_finished=False)  # `os._exit` would leave it compiling
    status = _fail(failures[0], 1) if failures else 0
    # Torch cannot be interrupted, and destroying millions of waiting objects would take seconds.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def lifecycle(args: Sequence[str] | None = None) -> int:
    """Run the lifecycle node, see `main`."""
    return main(args, is_managed=True)


def _fail(error: Exception, status: int) -> int:
    """Print an error in one line on stderr and return the status."""
    kind = '' if isinstance(error, BoxregError) else f'{type(error).__name__}: '
    print(f'{NAME}: {kind}{one_line(error)}', file=sys.stderr)
    return status


if __name__ == '__main__':
    sys.exit(main())
