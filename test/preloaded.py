"""
Processes that begin with the modules of the node imported and the kernels loaded.

Each is forked from one process that has them, which saves seconds of every start.

"""

from importlib import import_module
from multiprocessing import get_context
import os
import signal
import sys

from paths import ROOT

BOXREG = 'boxreg_ros.cli:command'
NODE = 'boxreg_ros.live.main:main'
LIFECYCLE_NODE = 'boxreg_ros.live.main:lifecycle'
IMPATIENT_NODE = 'preloaded:impatient_node'
MODULES = ('boxreg_ros.live.process', 'warmed')

context = get_context('forkserver')
context.set_forkserver_preload([*MODULES, __name__])


class PreloadedProcess:
    """
    A process that runs an entry point of setup.py; with the methods of `subprocess.Popen`.

    Parameters
    ----------
    entry_point : str
        Module and function.
    arguments : list of str
        Its arguments.
    environment : dict of str and str
        Variables that differ from those of the tests.
    log : Path
        File for its output.

    """

    def __init__(self, entry_point, arguments, environment, log):
        given = (entry_point, arguments, environment, log)
        self._process = context.Process(target=_run, args=given)
        self._process.start()
        self.pid = self._process.pid

    @property
    def returncode(self):
        return self._process.exitcode

    def poll(self):
        return self._process.exitcode

    def send_signal(self, number):
        os.kill(self.pid, number)

    def kill(self):
        self._process.kill()

    def wait(self, timeout=None):
        self._process.join(timeout)
        return self._process.exitcode


def impatient_node():
    """Run a node that reports inputs without messages after 1 s in place of 10."""
    from boxreg_ros.live import boxes_type, main, topics

    boxes_type.PATIENCE = topics.PATIENCE = 1.0
    return main.main()


def _run(entry_point, arguments, environment, log):
    """Run an entry point in the process just forked."""
    os.environ.update(environment)
    os.chdir(ROOT)
    with log.open('w') as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
    with open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.argv[1:] = arguments
    module, function = entry_point.split(':')
    sys.exit(getattr(import_module(module), function)())
