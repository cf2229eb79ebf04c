"""The process of the live node: start, the threads of executor and worker, and the end."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
import os
import signal
from threading import Event, Thread
import time

from boxreg_ros.io.warm_up import SecondProcess
from boxreg_ros.live.lifecycle import BoxregLifecycleNode
from boxreg_ros.live.node import BoxregNode
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

ENDING_TIME = 0.9
"""Time the threads have to end after a signal: 0.5 s to solve, 0.4 s for acknowledgements [s]."""


def make_node(
    program: str, arguments: list[str], second: SecondProcess | None, is_managed: bool = False
) -> BoxregNode:
    """
    Initialise ROS and return the node.

    Parameters
    ----------
    program : str
        Name for help texts.
    arguments : list of str
        Of the command line, those of ROS too.
    second : SecondProcess or None
        Helps to compile.
    is_managed : bool
        Whether it is a lifecycle node.

    Returns
    -------
    node : BoxregNode
        With its topics open, or unconfigured if it is managed.

    Raises
    ------
    ConfigError
        If a parameter is wrong.
    SystemExit
        If an argument is unknown, or help was asked for.

    """
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    parser = argparse.ArgumentParser(
        program, description='Refine boxes live. Parameters: --ros-args -p NAME:=VALUE ...'
    )
    parser.parse_args(remove_ros_args(arguments))
    if is_managed:
        return BoxregLifecycleNode(second)
    node = BoxregNode(second)
    node.prepare()
    node.warm_up_beside()
    node.open_topics()
    return node


def run(node: BoxregNode) -> list[Exception]:
    """Run the node until a signal arrives or a thread fails; return the failures."""
    # A signal handler may interrupt any code of the main thread, another handler included, so it
    # must take no lock. Python itself writes a byte into this pipe, whichever thread the signal
    # arrives in.
    end_asked, ask_end = os.pipe()
    os.set_blocking(ask_end, False)
    signal.set_wakeup_fd(ask_end, warn_on_full_buffer=False)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    stop = Event()
    failures: list[Exception] = []
    tasks: list[Callable[[], None]] = [partial(_spin, executor, stop), node.run_worker]
    threads = [
        Thread(target=_run_task, args=(task, failures, ask_end), daemon=True) for task in tasks
    ]
    for thread in threads:
        thread.start()
    os.read(end_asked, 1)
    # `Executor.shutdown` would destroy entities that its thread may be about to wait for.
    executor.create_task(stop.set)
    node.stop_worker()
    end = time.monotonic() + ENDING_TIME
    for thread in threads:
        thread.join(max(0.0, end - time.monotonic()))
    if any(thread.is_alive() for thread in threads):
        node.get_logger().warning('ended while the solver was busy: the last boxes are missing')
    else:
        node.destroy_node()
        shut_down()
    return failures


def shut_down() -> None:
    """End the use of ROS in this process, if it has begun."""
    rclpy.try_shutdown()


def _spin(executor: SingleThreadedExecutor, stop: Event) -> None:
    """Run callbacks until `stop` is set."""
    while rclpy.ok() and not stop.is_set():
        executor.spin_once()


def _run_task(task: Callable[[], None], failures: list[Exception], ask_end: int) -> None:
    """Run a task, record its failure, and ask the main thread to end."""
    try:
        task()
    except Exception as error:
        failures.append(error)
    os.write(ask_end, b'x')
