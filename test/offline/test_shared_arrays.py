"""Large arrays of a worker in shared memory: unchanged, however many."""

import os

from boxreg_ros.offline import shared_arrays
from boxreg_ros.offline.shared_arrays import (
    Receiver,
    Sender,
    SHARED_BYTES,
    shared_memory,
    SLOTS,
)
from boxreg_ros.offline.workers import run_in_worker
import numpy as np
from processes import children_of
import pytest

SIZE = SHARED_BYTES // 8
"""Numbers of an array that is shared."""


@pytest.fixture
def received():
    """Return a function that runs a worker which sends items, and returns how to receive them."""
    before = children_of(os.getpid())
    running = []

    def start(items):
        memory = shared_memory()

        def serve(receive, send):
            send_shared = Sender(memory, receive, send)
            for item in items:
                send_shared(item)

        running.append(run_in_worker(serve, 'sends arrays'))
        return Receiver(memory, running[-1].__enter__())

    yield start
    for worker in running:
        worker.__exit__(None, None, None)
    assert children_of(os.getpid()) == before


def test_items_survive(received):
    rng = np.random.default_rng(0)
    cloud = rng.normal(size=(3, SIZE)).astype(np.float32).T  # as of a sweep: columns in memory
    items = [
        None,
        {'a': (1, 'b')},
        cloud,
        (cloud[:-1], np.arange(SIZE), 'three of one item', np.zeros(3)),
        rng.normal(size=(SIZE, 6))[:, ::2],
    ]
    receive = received(items)
    for item in items:
        np.testing.assert_equal(receive(), item)


def test_arrays_are_as_numpy_makes_them(received):
    receive = received(
        [(np.ones(SHARED_BYTES + 1, np.uint8), np.ones(SIZE), np.ones((SIZE, 3)).T)]
    )
    _, plain, columns = receive()
    assert plain.flags.aligned and plain.flags.writeable
    assert columns.flags.f_contiguous


def test_arrays_are_not_overwritten_by_later_ones(received):
    items = [np.full(SIZE, float(k)) for k in range(3 * SLOTS)]
    receive = received(items)
    np.testing.assert_equal([receive() for _ in items], items)


def test_memory_of_freed_arrays_is_filled_again_and_that_of_others_is_not(received):
    items = [np.full(SIZE, float(k)) for k in range(3 * SLOTS)]
    receive = received(items)
    held = []
    for number, item in enumerate(items):
        found = receive()
        np.testing.assert_equal(found, item)
        if number % 3 == 0:
            held.append(found)
    np.testing.assert_equal(held, items[::3])


def test_arrays_larger_than_a_slot(received, monkeypatch):
    monkeypatch.setattr(shared_arrays, 'SLOT_BYTES', SHARED_BYTES * 2)
    items = [np.arange(3.0 * SIZE), (np.arange(1.0 * SIZE), np.ones(2 * SIZE))]
    receive = received(items)
    for item in items:
        np.testing.assert_equal(receive(), item)


def test_the_last_item_is_received_when_the_worker_has_ended():
    memory = shared_memory()
    with run_in_worker(lambda *ends: Sender(memory, *ends)(np.ones(SIZE)), 'sends') as process:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOWAIT)
        assert Receiver(memory, process)().sum() == SIZE
