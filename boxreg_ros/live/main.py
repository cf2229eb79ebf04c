"""`boxreg_node`: the process around the live node; arguments, signals, threads, exit status."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
import os
import signal
import sys
from threading import Event, Thread
import time

from boxreg_ros.allocation import keep_freed_memory
from boxreg_ros.errors import BoxregError, ConfigError

NAME = 'boxreg_node'
WITHOUT_ROS = "source a ROS 2 Jazzy installation, or pip install 'boxreg_ros[ros]'"
SIGNALS = (signal.SIGINT, signal.SIGTERM)


def main(args: Sequence[str] | None = None) -> int:
    """
    Run the node until SIGINT or SIGTERM, then end the process.

    Its exit status is 0 when ended by a signal, 1 if the node failed while it ran. What is
    returned is that of a node that could not begin: 1, or 2 if an argument or a parameter is
    wrong. Failures are told in one line on stderr.

    """
    for number in SIGNALS:
        # Nothing has begun. Raised within a destructor, SystemExit would be lost.
        signal.signal(number, lambda *_: os._exit(0))
    try:  # what takes seconds to import, or is not there without ROS
        from boxreg_ros.live.node import BoxregNode, LAST_ACKNOWLEDGEMENT, LAST_WORK
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions
        from rclpy.utilities import remove_ros_args
    except ImportError as error:
        return _fail(BoxregError(f'{error}: {WITHOUT_ROS}'), 1)

    keep_freed_memory()
    arguments = list(sys.argv[1:] if args is None else args)
    failures: list[Exception] = []
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        parser = argparse.ArgumentParser(
            NAME, description='Refine boxes live. Parameters: --ros-args -p NAME:=VALUE ...'
        )
        parser.parse_args(remove_ros_args(arguments))
        node = BoxregNode()
    except Exception as error:
        rclpy.try_shutdown()
        is_usage = isinstance(error, ConfigError) or not isinstance(error, BoxregError)
        return _fail(error, 2 if is_usage else 1)
    # A handler runs within whatever the main thread is at, be it another handler: it must take no
    # lock. Python itself writes to the pipe, whichever thread the signal comes to.
    end_asked, ask_end = os.pipe()
    os.set_blocking(ask_end, False)
    signal.set_wakeup_fd(ask_end, warn_on_full_buffer=False)
    for number in SIGNALS:
        signal.signal(number, lambda *_: None)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    stop = Event()

    def guarded(task: Callable[[], None]) -> None:
        try:
            task()
        except Exception as error:
            failures.append(error)
        os.write(ask_end, b'x')

    def spin() -> None:
        while rclpy.ok() and not stop.is_set():
            executor.spin_once()

    threads = [Thread(target=guarded, args=(task,), daemon=True) for task in (spin, node.work)]
    for thread in threads:
        thread.start()
    os.read(end_asked, 1)
    # `Executor.shutdown` would destroy what its thread is about to wait for.
    executor.create_task(stop.set)
    node.stop()
    end = time.monotonic() + LAST_WORK + LAST_ACKNOWLEDGEMENT
    for thread in threads:
        thread.join(max(0.0, end - time.monotonic()))
    status = _fail(failures[0], 1) if failures else 0
    if any(thread.is_alive() for thread in threads):
        node.get_logger().warning('ended while the solver was busy: the last boxes are missing')
    else:
        node.destroy_node()
        rclpy.try_shutdown()
    # Torch cannot be interrupted, and python would free what still waits, millions of objects, one
    # by one: seconds.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _fail(error: Exception, status: int) -> int:
    kind = '' if isinstance(error, BoxregError) else f'{type(error).__name__}: '
    print(f'{NAME}: {kind}{" ".join(str(error).split())}', file=sys.stderr)
    return status


if __name__ == '__main__':
    sys.exit(main())
