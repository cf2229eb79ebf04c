"""Calls in a thread: their order, how many wait, and their errors."""

from threading import Event
import time

from boxreg_ros.offline.background import Background
import pytest


def test_calls_keep_their_order_and_are_complete_at_the_end():
    done = []
    with Background(3) as background:
        for number in range(50):
            background(done.append, number)
    assert done == list(range(50))


def test_the_caller_goes_on_until_too_many_calls_wait():
    may_go_on = Event()
    done = []
    with Background(2) as background:
        background(may_go_on.wait)
        background(done.append, 1)
        assert done == []
        may_go_on.set()
        background(done.append, 2)
    assert done == [1, 2]


def test_none_may_wait():
    done = []
    with Background(0) as background:
        background(done.append, 1)
        assert done == [1]


@pytest.mark.parametrize('most_waiting', [0, 5])
def test_the_error_of_a_call_is_raised_in_the_caller(most_waiting):
    def fail():
        raise OSError('no space left')

    with pytest.raises(OSError, match='no space left'), Background(most_waiting) as background:
        background(fail)


def test_after_an_error_in_the_block_no_further_call_begins():
    has_begun = Event()
    done = []

    def go_on_after_the_block():
        has_begun.set()
        time.sleep(0.2)

    with pytest.raises(KeyError), Background(5) as background:
        background(go_on_after_the_block)
        background(done.append, 1)
        has_begun.wait()
        raise KeyError
    assert done == []
