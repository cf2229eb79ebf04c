"""Work ahead: in order, bounded, and over when the block is."""

import sys
import threading
import time

from boxreg_ros.ahead import ahead, TURN
import pytest


def until(condition):
    """Wait for another thread to get there."""
    deadline = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.001)


def is_over():
    return not [t for t in threading.enumerate() if t.name.startswith('ahead')]


class Maker:
    """Counts what it has been asked for; fails instead of making number `bad`."""

    def __init__(self, bad=None):
        self.made = 0
        self.threads = set()
        self._bad = bad

    def items(self, n):
        for number in range(n):
            self.threads.add(threading.get_ident())
            if number == self._bad:
                raise ValueError(f'no {number}')
            self.made += 1
            yield number


@pytest.mark.parametrize(('n', 'count'), [(0, 3), (1, 3), (20, 1), (20, 3), (20, 50)])
def test_all_items_come_in_order_from_one_other_thread(n, count):
    maker = Maker()
    with ahead(maker.items(n), count) as coming:
        assert list(coming) == list(range(n))
    assert is_over()
    assert len(maker.threads) == min(n, 1)
    assert threading.get_ident() not in maker.threads


def test_no_more_is_made_than_asked_for():
    maker = Maker()
    with ahead(maker.items(100), 3) as coming:
        for used in range(10):
            assert next(coming) == used
            until(lambda n=used: maker.made == n + 4)  # the one in use and three
            time.sleep(0.005)
            assert maker.made == used + 4
    assert maker.made == 13  # and none when the block has ended
    assert is_over()


def test_an_error_comes_in_the_place_of_its_item():
    maker, used = Maker(bad=4), []
    with pytest.raises(ValueError, match='no 4'), ahead(maker.items(9), 3) as coming:
        for number in coming:
            used.append(number)
    assert used == [0, 1, 2, 3]
    assert is_over()


@pytest.mark.parametrize('failure', [ValueError, KeyboardInterrupt])
def test_the_thread_ends_when_the_block_fails(failure):
    maker = Maker()
    with pytest.raises(failure), ahead(maker.items(100), 3) as coming:
        next(coming)
        raise failure
    assert maker.made <= 4
    assert is_over()


def test_threads_take_turns_sooner_for_as_long_as_the_block_lasts():
    before = sys.getswitchinterval()
    assert before > TURN
    with ahead(iter(range(3)), 2) as coming:
        assert sys.getswitchinterval() == pytest.approx(TURN)
        assert list(coming) == [0, 1, 2]
    assert sys.getswitchinterval() == before
    with pytest.raises(ValueError, match='no 1'), ahead(Maker(bad=1).items(3), 2) as coming:
        list(coming)
    assert sys.getswitchinterval() == before
