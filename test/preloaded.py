"""
Processes of the node that begin with its modules imported.

Each is forked from one process that has imported them, which saves two seconds of every start.

"""

from multiprocessing import get_context
import os
import runpy
import signal
import sys

from paths import ROOT

NODE = 'boxreg_ros.live.main'
MODULES = ('boxreg_ros.live.process', 'boxreg_ros.io.warm_up', 'boxreg_ros.core.registration')

context = get_context('forkserver')
context.set_forkserver_preload([*MODULES, __name__])


class PreloadedProcess:
    """
    A process that runs a module as ``python -m`` does; with the methods of `subprocess.Popen`.

    Parameters
    ----------
    module : str
        Name of the module.
    arguments : list of str
        Its arguments.
    environment : dict of str and str
        Variables that differ from those of the tests.
    log : Path
        File for its output.

    """

    def __init__(self, module, arguments, environment, log):
        given = (module, arguments, environment, log)
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


def _run(module, arguments, environment, log):
    """Run a module in the process just forked."""
    os.environ.update(environment)
    os.chdir(ROOT)
    with log.open('w') as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
    with open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.argv[1:] = arguments
    runpy.run_module(module, run_name='__main__', alter_sys=True)
