"""Environment of all tests: ROS on this machine only, in its own domain, with type checks."""

import fcntl
import gc
import os
from pathlib import Path
import signal
import sys
import tempfile

from boxreg_ros.core.method import constants
from browser import end_shared_browser
from preloaded import PreloadedPython
import pytest
from ros_domain import next_domain
import torch

os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ['ROS_DOMAIN_ID'] = str(next_domain())
os.environ['ROS_LOG_DIR'] = str(Path(tempfile.gettempdir(), f'boxreg_ros_test_log_{os.getpid()}'))
# Read when a message class is imported; without it misspelt fields and wrong types pass.
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
# The wheels of ROS need it where ROS itself is not installed.
os.environ.setdefault('AMENT_PREFIX_PATH', sys.prefix)

# The secret of the tests' reviews, not that of the user.
os.environ['XDG_STATE_HOME'] = str(Path(tempfile.gettempdir(), f'boxreg_ros_state_{os.getpid()}'))

# A shell without job control starts background processes with SIGINT ignored, and their children
# inherit this. `boxreg` then ignores SIGINT as well, but some tests send it.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The problems of the tests are small: several threads are slower than one.
torch.set_num_threads(1)


def pytest_sessionstart(session):
    """Load the kernels where many tests run; compile them before workers start nodes."""
    is_worker = 'PYTEST_XDIST_WORKER' in os.environ
    if is_worker or session.config.getoption('numprocesses', None) is not None:
        # Imported here: messages are imported after their checks are switched on.
        import warmed  # noqa: F401


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Let one worker rewrite the assertions of all modules for the others, which wait for it."""
    folder = os.open(sys.prefix, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        fcntl.flock(folder, fcntl.LOCK_SH)
    gc.disable()  # what is imported and collected stays
    try:
        return (yield)
    finally:
        gc.enable()
        os.close(folder)


@pytest.fixture(scope='module', autouse=True)
def browser_of_pages(request):
    """End the browser that tests share before a module without pages: it has an event loop."""
    if 'opened_page' not in vars(request.module):
        end_shared_browser()


def pytest_sessionfinish():
    end_shared_browser()


@pytest.fixture(scope='session')
def preloaded_python(tmp_path_factory):
    """Return an executable that starts `boxreg` in a process with all modules."""
    path = tmp_path_factory.mktemp('bin') / 'python'
    python = PreloadedPython(path)
    yield str(path)
    python.close()


@pytest.fixture
def quick_python(preloaded_python, monkeypatch):
    """Let the page of a review write labels in processes with all modules."""
    monkeypatch.setattr(sys, 'executable', preloaded_python)


@pytest.fixture
def set_constants(monkeypatch):
    """Return a function that changes numbers of the method, until the end of the test."""

    def set_to(**changes):
        monkeypatch.setattr(constants, 'CONSTANTS', constants.CONSTANTS._replace(**changes))

    return set_to
