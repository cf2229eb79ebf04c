#!/usr/bin/env bash
# guess: the memory limit of a worker of Dask holds for all that a task takes, the processes that it starts included
# happens: the nanny looks at the process of the worker alone: a task whose child takes three times the limit is done, one that takes it itself is ended (KilledWorker)
# versions: distributed 2026.8.0
# date: 2026-11-28
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check distributed==2026.8.0
cat > "$folder/memory.py" <<'PYTHON'
import subprocess
import sys
import time

import dask
import distributed
from distributed import Client, LocalCluster

LIMIT = 300_000_000
HOLD = 'import time; held = bytearray(900_000_000); held[::4096] = bytes(len(held[::4096])); time.sleep(3)'


def by_child(_):
    subprocess.run([sys.executable, '-c', HOLD], check=True)
    return 'done'


def by_itself(_):
    held = []
    for _ in range(30):  # step by step, as real work does
        held.append(bytearray(b'x' * 30_000_000))
        time.sleep(0.2)
    return 'done'


def ending(task):
    with (
        LocalCluster(
            n_workers=1, threads_per_worker=1, memory_limit=LIMIT, dashboard_address=None, silence_logs=50
        ) as cluster,
        Client(cluster) as client,
    ):
        error = client.submit(task, 0).exception()
        return 'done' if error is None else type(error).__name__


if __name__ == '__main__':
    dask.config.set({'distributed.scheduler.allowed-failures': 0})
    print('distributed', distributed.__version__)
    found = {'child': ending(by_child), 'itself': ending(by_itself)}
    print('900 MB at a limit of 300 MB:', found)
    assert found == {'child': 'done', 'itself': 'KilledWorker'}, found
PYTHON
"$folder/venv/bin/python" "$folder/memory.py"
