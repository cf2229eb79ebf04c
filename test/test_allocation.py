"""Freed memory is reused for the next arrays; the garbage collector runs rarely."""

import platform
import subprocess
import sys

import pytest

PAGE_FAULTS = """
import resource
import sys
from threading import Thread
from boxreg_ros.allocation import keep_freed_memory
import numpy as np

if sys.argv[1] == 'kept':
    keep_freed_memory()


def step():
    arrays = [np.ones(100_000) for _ in range(12)]  # all at the same time
    return sum(len(array) for array in arrays)


def faults(count):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(count):
        step()
    print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)


def twice():
    step()
    faults(20)


worker = Thread(target=twice)  # as in the node
worker.start()
worker.join()
twice()
"""


@pytest.mark.skipif(platform.libc_ver()[0] != 'glibc', reason='another C library')
def test_arrays_of_one_step_reuse_the_memory_of_the_step_before():
    # 1.2 million float64 are 2,343 pages of 4096 bytes; Python itself uses few.
    faults = {}
    for case in ('returned', 'kept'):
        command = [sys.executable, '-c', PAGE_FAULTS, case]
        found = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        faults[case] = [int(number) for number in found.split()]
    # Glibc may reuse the memory of one thread by itself: its thresholds follow earlier arrays.
    assert max(faults['returned']) > 20 * 2343 / 2
    assert max(faults['kept']) < 2343 / 2


def test_imported_libraries_start_no_collection():
    count = """
import gc
from boxreg_ros.allocation import collect_rarely
collect_rarely()
before = gc.get_stats()[2]['collections']
import torch
print(gc.get_stats()[2]['collections'] - before)
"""
    found = subprocess.run([sys.executable, '-c', count], capture_output=True, text=True)
    assert found.stdout.split() == ['0'], found.stderr
