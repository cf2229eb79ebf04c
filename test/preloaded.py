"""
Processes that begin with the modules of the node imported and the kernels loaded.

Each is forked from one process that has them, which saves seconds of every start.

"""

from contextlib import chdir, suppress
from functools import cache
from importlib import import_module
import json
from multiprocessing import connection, forkserver, get_context
import os
import resource
import signal
import socket
import sys
from threading import Thread

from paths import ROOT, TEST

BOXREG = 'boxreg_ros.cli:command'
NODE = 'boxreg_ros.live.main:main'
LIFECYCLE_NODE = 'boxreg_ros.live.main:lifecycle'
IMPATIENT_NODE = 'preloaded:impatient_node'
PATIENT_NODE = 'preloaded:patient_node'
CODE = 'preloaded:run_code'
"""Runs its first argument, which may change the modules before it calls an entry point."""
MODULES = (
    'boxreg_ros.live.process', 'boxreg_ros.offline.relabel', 'boxreg_ros.review.report', 'warmed',
)  # fmt: skip

context = get_context('forkserver')
context.set_forkserver_preload([*MODULES, __name__])


@cache
def start_server():
    """
    Start the process that the others are forked from.

    Python 3.11 does not give it the paths of modules, and skips the modules that it does not
    find: it finds those of the tests in its folder.

    """
    with chdir(TEST):
        forkserver.ensure_running()


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
        start_server()
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
        if self.poll() is None:  # as of `subprocess.Popen`
            os.kill(self.pid, number)

    def kill(self):
        self._process.kill()

    def wait(self, timeout=None):
        self._process.join(timeout)
        return self._process.exitcode


LAUNCHER = """#!{python} -IS
import json, os, signal, socket, sys
server = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
server.connect({address!r})
server.send(json.dumps([os.getpid(), sys.argv, dict(os.environ), os.getcwd()]).encode())
process = int(server.recv(16))
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, lambda number, _: os.kill(process, number))
status = int(server.recv(16))
if status < 0:
    os.kill(os.getpid(), -status)
sys.exit(status)
"""
"""Signals to it reach its process; its status and output are those of its process."""


class PreloadedPython:
    """
    An executable that runs ``-m boxreg_ros.cli`` and ``-c CODE`` in preloaded processes.

    A process ends with its launcher, which states how large its files may be, and starts its own
    processes in the same way. Where the number or the memory of a process are tested, use Python
    itself.

    Parameters
    ----------
    path : Path
        The executable to write.

    """

    def __init__(self, path):
        start_server()
        address = f'\0boxreg-{os.getpid()}-{id(self)}'
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(address)
        self._listener.listen()
        path.write_text(LAUNCHER.format(python=sys.executable, address=address))
        path.chmod(0o755)
        Thread(target=self._serve, daemon=True).start()

    def close(self):
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _serve(self):
        with suppress(OSError):  # it is closed
            while True:
                launcher, _ = self._listener.accept()
                Thread(target=self._run, args=[launcher], daemon=True).start()

    def _run(self, launcher):
        process = context.Process(target=_run_for, args=json.loads(launcher.recv(2**20)))
        process.start()
        with suppress(OSError):  # its launcher was killed
            launcher.send(str(process.pid).encode())
        if process.sentinel not in connection.wait([process.sentinel, launcher]):
            process.kill()
        process.join()
        with launcher, suppress(OSError):
            launcher.send(str(process.exitcode).encode())


def _run_for(launcher, arguments, environment, folder):
    """Run a launcher's command in the process just forked."""
    for stream in (1, 2):
        os.dup2(os.open(f'/proc/{launcher}/fd/{stream}', os.O_WRONLY | os.O_APPEND), stream)
    # Those there were may be of files, and these of pipes.
    sys.stdout, sys.stderr = os.fdopen(1, 'w'), os.fdopen(2, 'w', 1)
    limit = resource.RLIMIT_FSIZE
    resource.setrlimit(limit, resource.prlimit(launcher, limit))
    os.environ.clear()
    os.environ.update(environment)
    sys.executable, *arguments = arguments
    os.chdir(folder)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup it is ignored
    if arguments[0] == '-c':
        _run_entry_point(CODE, arguments[1:])
    assert arguments[:2] == ['-m', 'boxreg_ros.cli'], arguments
    _run_entry_point(BOXREG, arguments[2:])


def impatient_node():
    """Run a node that reports inputs without messages after 1 s in place of 10."""
    from boxreg_ros.live import boxes_type, main, topics

    boxes_type.PATIENCE = topics.PATIENCE = 1.0
    return main.main()


def patient_node():
    """Run a node that waits for clouds and boxes from a process that is not scheduled."""
    from boxreg_ros.live import main, pipeline

    pipeline.BOXES_SILENCE = pipeline.CLOUD_SILENCE = 60.0
    return main.main()


def run_code():
    exec(sys.argv.pop(1), {'__name__': '__main__'})


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
    _run_entry_point(entry_point, arguments)


def _run_entry_point(entry_point, arguments):
    sys.argv[1:] = arguments
    module, function = entry_point.split(':')
    sys.exit(getattr(import_module(module), function)())
