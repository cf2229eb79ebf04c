"""ROS domains for the tests of this process; workers of pytest-xdist have none in common."""

import itertools
import os

_count = int(os.environ.get('PYTEST_XDIST_WORKER_COUNT', '1'))
_worker = int(os.environ.get('PYTEST_XDIST_WORKER', 'gw0').removeprefix('gw'))
# All workers are children of the process that started the run.
_run = os.getppid() if 'PYTEST_XDIST_WORKER' in os.environ else os.getpid()
# Fast DDS derives its ports from the domain: above 100 they are those of outgoing connections.
_limit = 100 - 100 % _count
_numbers = itertools.count(_run * _count + _worker, _count)


def next_domain():
    """Return a domain, from 1 to 100, that this process has not used of late."""
    return 1 + next(_numbers) % _limit
