"""`boxreg compile`, and the Dockerfile that runs it, as far as that goes without docker."""

import json
import multiprocessing
import os
from pathlib import Path
import re
import shlex
import subprocess
import sys
import time

from compiled import fill_cache
from paths import BAGS, ROOT
import pytest
from ros_graph import ended_cleanly, graph_in

numba = pytest.importorskip('numba')
pytest.importorskip('rclpy')

COMPILED = r'compiled (\d+) functions in \d+ s; kept in '


def instructions():
    """Return the instructions of the Dockerfile as pairs of keyword and arguments."""
    text = (ROOT / 'Dockerfile').read_text(encoding='utf-8')
    lines = [line for line in text.splitlines() if not line.startswith('#')]
    whole = re.sub(r'\\\n\s*', '', '\n'.join(lines))
    return [tuple(line.split(maxsplit=1)) for line in whole.splitlines() if line]


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """Return a folder for compiled functions that lacks a single one."""
    folder = tmp_path / 'kernels'
    folder.mkdir()
    fill_cache(folder)
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(folder))
    return folder


def test_the_image_compiles_once_for_every_user_and_cpu(cache, tmp_path):
    found = instructions()
    assert [word for word, _ in found][:2] == ['FROM', 'SHELL']
    assert json.loads(dict(found)['SHELL']) == ['/bin/bash', '-c']
    assert json.loads(dict(found)['ENTRYPOINT'])[-2].endswith('exec "$@"')
    values = dict(
        word.split('=', 1) for kind, text in found if kind == 'ENV' for word in shlex.split(text)
    )
    assert values['NUMBA_CPU_FEATURES'] == ''
    assert values['NUMBA_CPU_NAME'] == '${CPU}'
    assert 'CPU=generic' in [text for kind, text in found if kind == 'ARG']
    (line,) = (text for kind, text in found if kind == 'RUN' and 'boxreg compile' in text)
    assert '"${NUMBA_CACHE_DIR}"' in line and values['NUMBA_CACHE_DIR']
    (tmp_path / 'install').mkdir()
    (tmp_path / 'install' / 'setup.bash').touch()  # that of colcon; `boxreg` is on the path here
    environment = {**os.environ, 'PATH': f'{Path(sys.executable).parent}:{os.environ["PATH"]}'}

    def run_line():
        done = subprocess.run(
            ['bash', '-c', line], cwd=tmp_path, env=environment, capture_output=True, text=True,
            timeout=300,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done

    first = run_line()
    assert re.match(COMPILED + re.escape(str(cache)), first.stdout), first.stdout
    assert 'compiling the solver' in first.stderr
    second = run_line()
    assert second.stdout == f'nothing to compile; kept in {cache}\n'
    assert second.stderr == ''
    assert all(path.stat().st_mode & 0o006 == 0o006 for path in cache.rglob('*'))


def test_the_first_start_of_a_node_says_that_it_compiles(cache, tmp_path):
    with graph_in(tmp_path) as graph:
        node = graph.start(command=('-m', 'boxreg_ros.live.main'))
        graph.wait(lambda: 'compiling the solver' in node.output(), 'the announcement')
        assert ended_cleanly(node)
    lines = [line for line in node.output().splitlines() if 'compiling the solver' in line]
    assert lines and '[INFO]' in lines[0]


KERNELS = """\
import sys
from numba.core.dispatcher import Dispatcher

def kernels():
    modules = [m for name, m in sys.modules.items() if name.startswith('boxreg_ros.core.method')]
    found = [(k, f) for m in modules for k, f in vars(m).items() if isinstance(f, Dispatcher)]
    return {(name, str(one)) for name, function in found for one in function.signatures}

"""

FIRST_DRIVE = (
    KERNELS
    + """\
from msg_adapters import vision
from boxreg_ros.config import Config
from boxreg_ros.io.items import Item
from boxreg_ros.io.warm_up import warm_up, warm_up_followed
from boxreg_ros.io.session import Session
from boxreg_ros.live.pipeline import MessagePipeline
from boxreg_ros.live.transform_wait import TransformWait
from msg_adapters.convention import STANDARD
from pathlib import Path
from rosbags.highlevel import AnyReader

config = Config(estimate='final')
warm_up(config)
warm_up_followed(config)
before = kernels()
session = Session(STANDARD, config, 'odom', report=print)
live = MessagePipeline(config, session, TransformWait(session, 0.0, ''), print)
live.adapter = vision
with AnyReader([Path(sys.argv[1])]) as reader:
    for connection, at, data in reader.messages():
        message = reader.deserialize(data, connection.msgtype)
        if connection.topic == '/tf':
            session.tree.add_transforms(message.transforms)
        elif connection.topic == '/points':
            live.process(Item(at, session.placement.sweep_of(message, ''), message=message))
        elif connection.topic == '/detections':
            live.process(Item(at, vision.from_msg(message), message=message))
        if at > 1_700_000_000_800_000_000:
            break
assert live.registrar.counts['boxes'] > 100
print(sorted(kernels() - before))
"""
)

TWO_PROCESSES = (
    KERNELS
    + """\
from boxreg_ros.config import Config
from boxreg_ros.core import solver
from boxreg_ros.io.warm_up import *
config = Config(estimate='final')
warm_up_solver(config)
before, fit = kernels(), solver.fit
warm_up_others(config.objective, config.mode, True, lambda: None)
assert before and kernels() - before
before, solver.fit = kernels(), fit
warm_up(config)
warm_up_labels(config)
warm_up_followed(config)
print(sorted(kernels() - before))
"""
)


def test_the_two_processes_of_a_first_start_compile_what_a_node_needs():
    command = [sys.executable, '-c', TWO_PROCESSES]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.split('\n')[-2] == '[]'


@pytest.mark.parametrize('estimate', ['early', 'final', 'track'])
def test_the_first_fit_has_no_residual_of_variables_that_it_lacks(estimate, monkeypatch):
    from boxreg_ros.config import Config
    from boxreg_ros.core import solver
    from boxreg_ros.core.method.arrays import SHARED
    from boxreg_ros.core.method.constants import RESIDUAL_NAMES
    from boxreg_ros.io.warm_up import warm_up_solver

    sought, search = [], solver.search
    monkeypatch.setattr(solver, 'search', lambda fit: sought.append(fit) or search(fit))
    warm_up_solver(Config.from_dict({'estimate': estimate}))
    ((batch, _, _, constants, _),) = sought
    has_shape = constants['residuals'][0, RESIDUAL_NAMES.index('rigid shape')]
    assert has_shape == (batch.solution.shared.shape[1] == SHARED)


def test_one_process_compiles_all_where_there_cannot_be_two(monkeypatch):
    from boxreg_ros.config import Config
    from boxreg_ros.io.warm_up import compiled_beside, SecondProcess

    def refuse():
        raise BlockingIOError('Resource temporarily unavailable')

    with monkeypatch.context() as patch:
        patch.setattr(os, 'fork', refuse)
        second = SecondProcess.forked()
    assert second is None
    with compiled_beside(second, Config(), has_labels=False) as wait:
        assert numba.njit(lambda: 8)() == 8
        wait()


def test_the_second_process_is_not_waited_for_where_it_fails(monkeypatch):
    from boxreg_ros.config import Config
    from boxreg_ros.io import warm_up

    def fail(*args):
        raise MemoryError

    monkeypatch.setattr(warm_up, 'warm_up_others', fail)
    second = warm_up.SecondProcess()
    with warm_up.compiled_beside(second, Config(), has_labels=False) as wait:
        numba.njit(lambda: 8)()
        wait()
    assert multiprocessing.active_children() == []


def test_the_second_process_ends_with_an_interrupted_one(monkeypatch):
    from boxreg_ros.config import Config
    from boxreg_ros.io import warm_up

    monkeypatch.setattr(warm_up, 'warm_up_others', lambda *_: time.sleep(300))
    second = warm_up.SecondProcess()
    with (
        pytest.raises(KeyboardInterrupt),
        warm_up.compiled_beside(second, Config(), has_labels=False),
    ):
        numba.njit(lambda: 8)()
        raise KeyboardInterrupt
    assert multiprocessing.active_children() == []


def test_the_second_process_ends_where_nothing_is_compiled():
    from boxreg_ros.config import Config
    from boxreg_ros.io import warm_up

    second = warm_up.SecondProcess()
    with warm_up.compiled_beside(second, Config(), has_labels=False) as wait:
        wait()
    assert multiprocessing.active_children() == []


def test_the_first_drive_needs_no_kernel_beyond_those_of_the_start():
    done = subprocess.run(
        [sys.executable, '-c', FIRST_DRIVE, str(BAGS / 'street.mcap')], cwd=ROOT,
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.stdout == '[]\n', done.stdout + done.stderr


def test_compile_fails_where_nothing_can_be_kept(tmp_path):
    (tmp_path / 'file').touch()
    code = (
        'import sys; sys.modules["numba"] = None\n'
        'from boxreg_ros.cli import main\n'
        'sys.exit(main(["compile"]))'
    )
    done = subprocess.run(
        [sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 1
    assert 'numba' in done.stderr and 'Traceback' not in done.stderr
