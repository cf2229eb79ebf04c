"""Several messages of boxes with one stamp: joined for the registrar, published one by one."""

from copy import deepcopy
from dataclasses import replace

from boxreg_ros.io.items import Item
from boxreg_ros.io.joining import are_parts
from boxreg_ros.live.bursts import Bursts, JOIN_TIME, JoiningAdapter, messages_of, Parts
from boxreg_ros.structures import BoxArray
from msg_adapters import vision
import numpy as np
import pytest
from ros_messages import Drive, START
from test_pipeline import Live


def per_object(drive):
    """Return the drive with a message of boxes for each object."""
    parts = []
    for topic, received_ns, message in drive.items:
        numbers = range(2) if topic == '/boxes' else (None,)
        for number in numbers:
            part = deepcopy(message)
            if number is not None:
                part.detections = part.detections[number : number + 1]
            parts.append((topic, received_ns, part))
    drive.items = parts
    return drive


def finals(drive, **settings):
    """Return the final messages of a drive, by stamp and id, and the counts."""
    live = Live(**settings)
    live.adapter = JoiningAdapter(vision)
    live.joins = True
    out = live.feed(drive)
    items, ready = live.release()
    out += ready
    for item in items:
        out += live.process(item)
    out += live.flush()
    arrays = [vision.from_msg(m) for one in out if one.is_final for m in messages_of(one.message)]
    boxes = {
        (array.stamp_ns, track_id): box
        for array in arrays
        for track_id, box in zip(array.track_ids, array.boxes, strict=True)
    }
    return boxes, [len(array.track_ids) for array in arrays], live.registrar.counts


def test_boxes_are_those_of_one_message_and_each_message_has_its_own():
    whole, _, _ = finals(Drive(sweeps=8))
    apart, sizes, counts = finals(per_object(Drive(sweeps=8)))
    assert sizes == [1] * 16
    assert 'duplicate_stamp' not in counts
    assert apart.keys() == whole.keys()
    for key, box in whole.items():
        np.testing.assert_allclose(apart[key], box, atol=1e-9)


@pytest.mark.parametrize('is_apart', [True, False])
def test_arrays_with_ids_of_their_own_are_parts_where_their_places_differ(is_apart):
    """Detectors that look to several sides each number their objects from 0."""
    name = ('0', '1'), ('car', 'car')
    boxes = np.array([[9.0, 0, 0, 4, 2, 1.5, 0, 0, 0], [-9.0, 0, 0, 4, 2, 1.5, 0, 0, 0]])
    front = BoxArray(START, 'base', *name, np.ones(2), boxes)
    rear = replace(front, boxes=boxes + (1.9 + 0.2 * is_apart) * np.eye(9)[0])
    assert are_parts(front, rear) == is_apart


def test_a_missed_box_is_published_behind_the_last_message_of_its_stamp():
    drive = per_object(Drive(sweeps=10))
    rows = [row for row, item in enumerate(drive.items) if item[0] == '/boxes']
    del drive.items[rows[2 * 6]]  # of the parked car
    boxes, sizes, _ = finals(drive, coast=0.5)
    assert sizes == [1] * 12 + [2] + [1] * 6
    true = drive.truth[drive.stamps[6]][0]
    sensor = np.array([0.5 * 6, 0, 2.0])
    assert np.abs(boxes[drive.stamps[6], '1'][:3] + sensor - true[:3]).max() < 0.3


def item_at(stamp_ns, track_id, received=0.0):
    boxes = BoxArray(stamp_ns, 'lidar', (track_id,), ('car',), np.ones(1), np.zeros((1, 9)))
    return Item(round(received * 1e9), boxes, message=f'{stamp_ns} {track_id}')


def messages(items):
    return [messages_of(item.message) for item in items]


def test_a_message_waits_only_where_bursts_are_known():
    bursts = Bursts()
    assert bursts.add(item_at(1, 'a')) == []
    assert messages(bursts.add(item_at(2, 'a'))) == [('1 a',), ('2 a',)]
    assert messages(bursts.add(item_at(3, 'a'))) == [('3 a',)]
    assert bursts.add(item_at(3, 'b')) == []  # the first one is gone: what follows waits
    assert messages(bursts.add(item_at(4, 'a', 1.0))) == [('3 b',)]
    assert bursts.add(item_at(4, 'b', 1.001)) == []
    assert bursts.release(1.0 + JOIN_TIME / 2) == []
    (whole,) = bursts.release(1.0 + JOIN_TIME)
    assert whole.message == Parts(('4 a', '4 b'), (1, 1))
    assert whole.content.track_ids == ('a', 'b')
    assert bursts.held is None


def test_messages_with_the_same_objects_are_not_joined():
    bursts = Bursts()
    bursts.add(item_at(1, 'a'))
    assert messages(bursts.add(item_at(1, 'a'))) == [('1 a',), ('1 a',)]
