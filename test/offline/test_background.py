"""Calls in a thread: their order, how many wait, and their errors."""

from threading import Event
import time

from boxreg_ros.offline.workers import Background
import pytest


def test_calls_keep_their_order_and_are_complete_at_the_end():
    done = []
    background = Background(3)
    for number in range(50):
        background(done.append, number)
    background.complete()
    assert done == list(range(50))


def test_the_caller_goes_on_until_too_many_calls_wait():
    may_go_on = Event()
    done = []
    background = Background(2)
    background(may_go_on.wait)
    background(done.append, 1)
    assert done == []
    may_go_on.set()
    background(done.append, 2)
    background.complete()
    assert done == [1, 2]


def test_none_may_wait():
    done = []
    background = Background(0)
    background(done.append, 1)
    assert done == [1]
    background.complete()


@pytest.mark.parametrize('most_waiting', [0, 5])
def test_the_error_of_a_call_is_raised_in_the_caller(most_waiting):
    def fail():
        raise OSError('no space left')

    background = Background(most_waiting)
    with pytest.raises(OSError, match='no space left'):
        background(fail)
        background.complete()
    background.abandon()


def test_of_an_abandoned_one_no_further_call_begins():
    has_begun = Event()
    done = []

    def go_on_meanwhile():
        has_begun.set()
        time.sleep(0.2)

    background = Background(5)
    background(go_on_meanwhile)
    background(done.append, 1)
    has_begun.wait()
    background.abandon()
    assert done == []
