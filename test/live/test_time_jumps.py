"""Which arrivals follow a time jump, decided before they are processed."""

from boxreg_ros.live.driver import ReceivedMessage
from boxreg_ros.live.time_jumps import CONFIRMATION_TIME, JumpConfirmation
from boxreg_ros.structures import BoxArray, Sweep
import numpy as np
import pytest
from ros_messages import SECOND


def sweep(seconds):
    return ReceivedMessage(None, Sweep(round(seconds * SECOND), 'lidar', np.zeros((0, 3))), 10.0)


def boxes(seconds):
    content = BoxArray(
        round(seconds * SECOND), 'lidar', ('1',), ('car',), np.ones(1), np.ones((1, 9))
    )
    return ReceivedMessage(None, content, 10.0)


@pytest.fixture
def jumps():
    """Return a confirmation that has seen a sweep and boxes at 100 s."""
    jumps = JumpConfirmation()
    for item in (sweep(100), boxes(100)):
        assert jumps.add(item) == ([item], False)
    return jumps


@pytest.mark.parametrize('kinds', [(sweep, boxes), (boxes, sweep), (sweep, sweep)])
def test_two_old_stamps_in_a_row_are_a_jump(jumps, kinds):
    first, second = (make(5 + 0.1 * k) for k, make in enumerate(kinds))
    assert jumps.add(first) == ([], False)
    assert jumps.add(second) == ([first, second], True)
    for item in (sweep(5.2), boxes(5.2)):
        assert jumps.add(item) == ([item], False)


def test_a_single_old_stamp_is_late_and_keeps_its_order(jumps):
    late, following = boxes(5), sweep(100.1)
    assert jumps.add(late) == ([], False)
    assert jumps.add(following) == ([late, following], False)
    assert not jumps.is_holding


def test_an_old_stamp_is_released_after_the_confirmation_time(jumps):
    late = boxes(5)
    jumps.add(late)
    assert not jumps.is_overdue(10.0 + 0.9 * CONFIRMATION_TIME)
    assert jumps.is_overdue(10.0 + CONFIRMATION_TIME)
    assert jumps.release() is late
    assert jumps.release() is None


def test_stamps_less_than_a_second_old_are_not_held(jumps):
    item = boxes(99.1)
    assert jumps.add(item) == ([item], False)
