"""`boxreg batch --engine ray` on a local Ray cluster of two nodes."""

import os
from pathlib import Path
import signal
import subprocess
import time

from boxreg_ros.cli import main
from boxreg_ros.offline.relabel import relabel
from boxreg_ros.offline.request import Request
import pytest
from relabel_results import rows_in
from ros_messages import Drive

pytest.importorskip('ray')
MEMORY = 100 * 2**20
"""Smallest object store that Ray accepts [bytes]; no objects are stored in it."""


@pytest.fixture
def address(monkeypatch):
    """Yield the address of a cluster of two nodes with one core each."""
    from ray.cluster_utils import Cluster

    handler = signal.getsignal(signal.SIGTERM)
    node = {'num_cpus': 1, 'object_store_memory': MEMORY, 'include_dashboard': False}
    monkeypatch.setenv('RAY_worker_niceness', '0')  # else other processes starve them
    cluster = Cluster(initialize_head=True, head_node_args=node)
    cluster.add_node(num_cpus=1, object_store_memory=MEMORY)
    signal.signal(signal.SIGTERM, handler)  # that of Ray would end the tests
    yield cluster.address
    cluster.shutdown()


def wait_until(condition, process):
    """Wait as long as a process runs: how long it takes depends on what else the machine does."""
    while not condition():
        assert process.poll() is None
        time.sleep(0.05)


def relabel_processes(out):
    """Return process and parent of each running `boxreg relabel` that writes into `out`."""
    found = []
    for folder in Path('/proc').glob('[0-9]*'):
        try:
            command = (folder / 'cmdline').read_bytes().split(b'\0')
            if b'relabel' in command and any(bytes(out) in word for word in command):
                parent = int((folder / 'stat').read_text().rpartition(')')[2].split()[1])
                found.append((int(folder.name), parent))
        except OSError:  # it has ended
            continue
    processes = {process for process, _ in found}
    return [pair for pair in found if pair[1] not in processes]  # without forked workers


def test_lost_workers_and_drivers_lose_no_drive(tmp_path, address, preloaded_python, capfd):
    paths = [Drive(sweeps=n).write(tmp_path / str(n)) for n in (5, 6, 7)]
    out = tmp_path / 'out'
    arguments = ['batch', *map(str, paths), '-o', str(out), '--engine=ray', f'--address={address}']
    driver = subprocess.Popen([preloaded_python, '-m', 'boxreg_ros.cli', *arguments])
    wait_until(lambda: relabel_processes(out), driver)
    os.kill(relabel_processes(out)[0][1], signal.SIGKILL)  # a worker of Ray; its job is lost
    states = out / 'jobs'
    wait_until(lambda: list(states.glob('*.json')), driver)
    driver.kill()
    driver.wait()
    while relabel_processes(out):  # those that Ray ends with their driver
        time.sleep(0.05)
    done = {path: path.stat().st_mtime_ns for path in states.glob('*.json')}
    results = {path: path.stat().st_mtime_ns for path in out.glob('*/boxes.csv')}
    assert main(arguments) == 0
    assert f'{out}: 3 of 3 drives done, {len(done)} of them earlier' in capfd.readouterr().out
    assert all(path.stat().st_mtime_ns == when for path, when in results.items())
    rows = rows_in(out / 'index.csv')
    assert sum(row['status'] == 'up to date' for row in rows) == len(done)
    assert main([*arguments, '--memory=1e6']) == 2  # else it would wait for such a node for ever
    assert '--memory: expected at most ' in capfd.readouterr().err
    for path in paths:
        relabel(Request((path,), formats=('csv',)), tmp_path / 'alone' / path.stem)
        alone = tmp_path / 'alone' / path.stem / 'boxes.csv'
        assert (out / path.stem / 'boxes.csv').read_bytes() == alone.read_bytes()


def test_a_cluster_that_does_not_answer_is_named(tmp_path, capsys):
    path = Drive(sweeps=3).write(tmp_path / 'one')
    out = tmp_path / 'out'
    command = ['batch', str(path), '-o', str(out), '--engine=ray', '--address=127.0.0.1:1']
    assert main(command) == 1
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith('boxreg')]
    assert '--address 127.0.0.1:1: expected a Ray cluster that answers' in line
