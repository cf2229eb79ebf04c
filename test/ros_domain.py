"""ROS domains for the tests of this process, in which no other process of the machine tests."""

import fcntl
from functools import cache
import itertools
import os
from pathlib import Path
import tempfile
import time

SIZE = 6
"""Domains of a process: the first for all of its time, the others by turns."""
# Fast DDS derives its ports from the domain: above 100 they are those of outgoing connections.
FIRST = range(1, 100 - SIZE, SIZE)


@cache
def _numbers():
    """Return the domains of this process, which it holds by a lock until it ends."""
    while True:
        for first in FIRST:
            path = Path(tempfile.gettempdir(), f'boxreg_ros_domains_{first}')
            lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(lock)
                continue
            return itertools.chain([first], itertools.cycle(range(first + 1, first + SIZE)))
        time.sleep(1.0)


def next_domain():
    """Return a domain, from 1 to 100, that this process has not used of late."""
    return next(_numbers())
