"""Pairing by stamp in every order of arrival; dropped sweeps are counted."""

from collections import Counter
from itertools import permutations

from boxreg_ros.config import Config
from boxreg_ros.core.matching import LAGS, StampMatcher
from boxreg_ros.core.pending import PendingArray
from boxreg_ros.errors import ShapeError
from boxreg_ros.structures import BoxArray, Sweep
import numpy as np
import pytest

MS = 1_000_000
AT_ONCE, REACH = 20, 60


def sweep(stamp_ns, is_dropped=False):
    return Sweep(stamp_ns, 'odom', np.zeros((0, 3)), is_dropped=is_dropped)


def boxes(stamp_ns):
    return BoxArray(stamp_ns, 'odom', (), (), np.zeros(0), np.zeros((0, 9)))


class Feed:
    """
    A matcher whose input and output are written as stamps in milliseconds.

    ``'s100'`` is a sweep, ``'b105'`` a box array, ``'d100'`` a dropped sweep.

    """

    def __init__(self, capacity=10, reach=AT_ONCE):
        self.counts = Counter()
        self.matcher = StampMatcher(Config(reach=reach * 1e-3, queue=capacity), self.counts)

    def add(self, *items):
        pairs = []
        for item in items:
            stamp_ns = int(item[1:]) * MS
            if item[0] in 'sd':
                pairs += self.matcher.add_sweep(sweep(stamp_ns, is_dropped=item[0] == 'd'))
            else:
                pairs += self.matcher.add_boxes(boxes(stamp_ns))
        return stamps_of(pairs)

    def flush(self):
        return stamps_of(self.matcher.flush())


def stamps_of(pairs):
    return [
        (pair.boxes.stamp_ns // MS, None if pair.sweep is None else pair.sweep.stamp_ns // MS)
        for pair in pairs
    ]


@pytest.mark.parametrize('items', [('s100', 'b100'), ('b100', 's100')])
def test_a_pair_is_returned_when_it_is_complete(items):
    feed = Feed()
    assert feed.add(items[0]) == []
    assert feed.add(items[1]) == [(100, 100)]
    assert feed.flush() == []
    assert feed.counts == {}


@pytest.mark.parametrize('stamp, is_pair', [(80, True), (120, True), (79, False), (121, False)])
@pytest.mark.parametrize('first', ['sweep', 'boxes'])
def test_the_tolerance_is_symmetric(stamp, is_pair, first):
    feed = Feed()
    items = [f's{stamp}', 'b100'][:: 1 if first == 'sweep' else -1]
    pairs = feed.add(*items)
    assert (pairs == [(100, stamp)]) == is_pair  # at once
    assert pairs + feed.flush() == [(100, stamp if is_pair else None)]
    assert feed.counts['sweep_without_boxes'] == (not is_pair)


FLUSH = 'flush'
STEPS = {
    'the nearest sweep is paired': (
        {}, [('s90 s104 s115 b100', [(100, 104)]), (FLUSH, [])], {'sweep_without_boxes': 2},
    ),
    'a sweep is paired with all boxes near it': (
        {}, [('s100 b95 b105', [(95, 100), (105, 100)]), (FLUSH, [])], {},
    ),
    'boxes at twice the rate share sweeps': (
        {'reach': REACH},
        [('s100 b100 b150 s200 b200 b250 s300 b300',
          [(100, 100), (150, 100), (200, 200), (250, 200), (300, 300)])],
        {},
    ),
    'boxes of a dropped sweep are returned at once, without one': (
        {'reach': REACH}, [('s100 d150 b150', [(150, None)]), ('b200 d200', [(200, None)])],
        {'sweep_without_boxes': 1},
    ),
    'duplicate and late sweeps are counted': (
        {}, [('s100 s100 s200 b200 s100 s179', [(200, 200)]), ('s180 b180', [(180, 180)])],
        {'sweep_duplicate': 1, 'sweep_without_boxes': 1, 'sweep_late': 2},
    ),
    'boxes are returned in the order of stamps': (
        {},
        [('b300 b100 b200', []), ('s100 s200 s300', [(100, 100), (200, 200), (300, 300)])],
        {},
    ),
    # A sweep at 340 would be paired with 320; after one at 341 no such sweep is expected.
    'boxes are held until a younger sweep arrives': (
        {}, [('b100 b200', []), ('s120', [(100, 120)]), ('s220', [(200, 220)]), ('b320', []),
             ('s341', [(320, None)])],
        {},
    ),
    'sweeps are held for boxes of a tracker with a latency of a second': (
        {'capacity': 20},
        [('s100 s200 s300 s400 s500 s600 s700 s800 s900 s1000', []),
         ('b100 b200 b300', [(100, 100), (200, 200), (300, 300)])],
        {},
    ),
    'sweeps beyond the capacity are dropped, the oldest first': (
        {'capacity': 3},
        [('s100 s200 s300 s400 s500', []), ('b300', [(300, 300)]), ('b500', [(500, 500)])],
        {'sweep_without_boxes': 3},
    ),
    'boxes beyond the capacity are returned unpaired, the oldest first': (
        {'capacity': 3},
        [('b100 b200 b300', []), ('b400', [(100, None)]), ('s200', [(200, 200)]),
         (FLUSH, [(300, None), (400, None)])],
        {},
    ),
    'a flush returns all boxes and discards sweeps': (
        {}, [('b100 s300 b310 b350 s500', [(100, None), (310, 300), (350, None)]),
             ('b600 b700', []), (FLUSH, [(600, None), (700, None)]), (FLUSH, [])],
        {'sweep_without_boxes': 1},
    ),
}  # fmt: skip


@pytest.mark.parametrize(('options', 'steps', 'counts'), STEPS.values(), ids=STEPS)
def test_items_are_paired(options, steps, counts):
    feed = Feed(**options)
    for items, pairs in steps:
        assert (feed.flush() if items == FLUSH else feed.add(*items.split())) == pairs, items
    assert +feed.counts == counts


@pytest.mark.parametrize('late', range(3))
def test_boxes_between_sweeps_are_paired_when_a_younger_sweep_arrives(late):
    # 150 is 45 from 105, 55 from 205: within reach of both, the tolerance of neither.
    items = ['s105', 's205']
    items.insert(late, 'b150')
    feed = Feed(reach=REACH)
    assert feed.add(*items) == [(150, 105)]
    assert feed.add('b210') == [(210, 205)]
    assert feed.add('b266') == []
    assert feed.add('s305') == [(266, 305)]
    assert feed.add('b366', 's466') == [(366, None)]  # 61 from 305
    assert feed.flush() == []
    assert feed.counts == {'sweep_without_boxes': 1}


def test_boxes_in_the_first_half_of_a_period_do_not_wait_for_the_next_sweep():
    feed = Feed(reach=60)
    assert feed.add('s0', 's100', 's203', 'b240') == []  # the period is not known yet
    assert feed.add('s300') == [(240, 203)]
    assert feed.add('b345') == [(345, 300)]
    assert feed.add('b355') == []  # a sweep at 400 would be nearer
    assert feed.add('s400') == [(355, 400)]
    assert feed.add('s440', 's500', 'b545') == []  # steps of 40 ms, too
    assert feed.add('s600') == [(545, 500)]


def test_boxes_between_sweeps_take_the_same_sweep_whichever_comes_first():
    sweeps = [f's{100 * k}' for k in range(12)]
    for late in (22, 45, 55, 78):
        arrays = [f'b{100 * k + late}' for k in range(5, 10)]
        at_once = Feed(reach=60)
        pairs = at_once.add(*sorted(sweeps + arrays, key=lambda item: int(item[1:])))
        afterwards = Feed(reach=60, capacity=20)
        assert pairs + at_once.flush() == afterwards.add(*sweeps, *arrays) + afterwards.flush()


def test_boxes_wait_for_no_sweep_of_another_clock():
    feed = Feed(capacity=5)
    sweeps = [f's{100 * k}' for k in range(4)]
    assert feed.add(*sweeps, 'b1000000') == [(1000000, None)]
    assert feed.add('s400', 'b1000100', 's500') == [(1000100, None)]
    assert feed.add('b1000') == []  # five sweeps behind: its own may come
    assert feed.add('s600', 's1000') == [(1000, 1000)]


def test_boxes_wait_for_sweeps_that_come_behind_younger_ones():
    feed = Feed()
    first = feed.add('s0', 'b0', 's200', 'b100', 's100', 'b200')  # shows that they do
    assert first == [(0, 0), (100, None), (200, 200)]
    assert feed.add('s400', 'b300', 'b400') == []
    assert feed.add('s300') == [(300, 300), (400, 400)]
    assert feed.add('s500', 'b500') == [(500, 500)]  # at once, as before
    assert feed.add('b600', 's700', 'b700') == []
    assert feed.add('s800') == [(600, None), (700, 700)]
    assert feed.add('s900', 'b900', 'b1000', 's1100') == [(900, 900)]
    assert stamps_of(feed.matcher.release(1000 * MS)) == [(1000, None)]
    feed.add(*(f's{stamp}' for stamp in range(1200, 1200 + 100 * LAGS, 100)))  # in order again
    assert feed.add('b12000', 's12100') == [(12000, None)]


def test_boxes_wait_for_such_sweeps_before_a_younger_one_is_known():
    feed = Feed()
    for stamp in range(0, 1000, 200):
        feed.add(f's{stamp + 100}', f's{stamp}')
    assert feed.add('b999') == []
    assert feed.add('s1101') == []  # a period that is longer than all before
    assert feed.add('s1000') == [(999, 1000)]


def test_one_sweep_far_behind_or_a_dropped_one_changes_nothing():
    for late in ('s100', 'd600'):
        feed = Feed()
        feed.add('s100', 's200', 's300', 's400', 's500', late)
        assert feed.add('s550', 'b600', 's700') == [(600, None)]


def test_no_box_array_is_lost_in_any_order():
    # In every order each box array is returned once, with its own sweep or none, and sweeps
    # without boxes are counted. If each kind arrives in order, all are paired.
    for order in permutations(['s100', 's200', 's300', 'b100', 'b200', 'b300']):
        feed = Feed()
        pairs = feed.add(*order) + feed.flush()
        assert sorted(stamp for stamp, _ in pairs) == [100, 200, 300], order
        assert all(sweep in (stamp, None) for stamp, sweep in pairs), order
        alone = sum(sweep is None for _, sweep in pairs)
        assert feed.counts['sweep_without_boxes'] + feed.counts['sweep_late'] == alone, order
        if [i for i in order if i[0] == 's'] == ['s100', 's200', 's300'] and (
            [i for i in order if i[0] == 'b'] == ['b100', 'b200', 'b300']
        ):
            assert pairs == [(100, 100), (200, 200), (300, 300)], order


def test_memory_is_bounded():
    # Many sweeps without boxes, then many boxes without sweeps.
    feed = Feed(capacity=5)
    pairs = feed.add(*[f's{100 * i}' for i in range(100)], *[f'b{100 * i}' for i in range(200)])
    pairs += feed.flush()
    assert [boxes for boxes, _ in pairs] == [100 * i for i in range(200)]
    assert [b for b, s in pairs if s is not None] == [9500, 9600, 9700, 9800, 9900]
    assert feed.counts == {'sweep_without_boxes': 95}


def test_boxes_of_another_frame_than_their_sweep_are_refused():
    matcher = StampMatcher(Config(), Counter())
    assert not list(matcher.add_sweep(Sweep(100, 'lidar', np.zeros((0, 3)))))
    with pytest.raises(ShapeError, match=r"frame of its boxes, 'odom', got 'lidar'; bring both"):
        next(matcher.add_boxes(boxes(100)))
    assert matcher.unpaired  # an error loses no boxes
    # A sweep without the name of its frame is taken to be in that of the boxes.
    matcher = StampMatcher(Config(), Counter())
    matcher.add_sweep(Sweep(100, '', np.zeros((0, 3))))
    assert len(list(matcher.add_boxes(boxes(100)))) == 1


def test_an_invalid_box_does_not_take_the_id_of_a_valid_one():
    values = np.tile([0, 0, 0, 4, 2, 1.5, 0, 0, 0.0], (4, 1))
    values[0, 3] = np.nan
    ids = ('a', 'a', 'a', '')
    array = PendingArray(BoxArray(0, 'odom', ids, ('car',) * 4, np.ones(4), values))
    array.set_reasons('no_sweep')
    assert array.reasons == ['invalid_box', 'no_sweep', 'duplicate_track_id', 'no_track_id']
