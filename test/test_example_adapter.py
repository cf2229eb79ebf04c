"""The adapter of docs/tasks/write-an-adapter.md reads, writes and runs in `boxreg relabel`."""

from copy import copy
from dataclasses import replace
from importlib import import_module
from types import SimpleNamespace

from boxreg_ros.config import Config
from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.offline.relabel import relabel, Request
from msg_adapters import adapter_for, ADAPTERS
import numpy as np
from paths import ROOT
import pytest
from ros_messages import Drive, typestore
from rosbags.typesys import get_types_from_msg

TYPE = 'example_msgs/msg/ObstacleArray'
OBSTACLE = 'example_msgs/msg/Obstacle'
PAGE = ROOT / 'docs' / 'tasks' / 'write-an-adapter.md'
EXAMPLES = ROOT / 'docs' / 'examples'


def definition_of(name):
    """Return the message definition of a type, as the page shows it."""
    text = PAGE.read_text(encoding='utf-8').split(f'```text\n# {name}\n')[1]
    return text.split('```')[0]


@pytest.fixture
def adapter(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    monkeypatch.setitem(ADAPTERS, TYPE, 'adapter_example')
    return import_module('adapter_example')


@pytest.fixture
def drive(adapter):
    """Return a drive whose boxes are obstacles."""
    made = Drive(sweeps=7)
    types = get_types_from_msg(definition_of(OBSTACLE), OBSTACLE)
    made.messages.store = typestore.__wrapped__()
    made.messages.store.register(types | get_types_from_msg(definition_of(TYPE), TYPE))
    made.items = [
        (topic, time, obstacles_of(made.messages, message) if topic == '/boxes' else message)
        for topic, time, message in made.items
    ]
    return made


def obstacles_of(messages, detections):
    obstacles = [
        {
            'id': int(item.id),
            'category': 'car',
            'confidence': 0.75,
            'pose': item.bbox.center,
            'size': item.bbox.size,
            'velocity': {'x': 1.0},
        }
        for item in detections.detections
    ]
    return messages.build(TYPE, header=detections.header, obstacles=obstacles)


def first_array(drive):
    return next(message for topic, _, message in drive.items if topic == '/boxes')


def test_page_shows_the_example():
    source = (EXAMPLES / 'adapter_example.py').read_text(encoding='utf-8')
    assert f'```python\n{source}```\n' in PAGE.read_text(encoding='utf-8')


def test_boxes_are_read_and_written(adapter, drive):
    message = first_array(drive)
    boxes = adapter_for(TYPE).from_msg(message)
    assert (boxes.track_ids, boxes.class_names) == (('1', '2'), ('car', 'car'))
    assert boxes.scores.tolist() == [0.75, 0.75]
    moved = replace(boxes, frame_id='map', boxes=boxes.boxes + 0.01)
    written = adapter.to_msg(message, moved)
    found = adapter.from_msg(written)
    assert (found.frame_id, found.track_ids, boxes.frame_id) == ('map', ('1', '2'), 'lidar')
    np.testing.assert_allclose(found.boxes, moved.boxes, atol=1e-9)
    assert written.obstacles[0].velocity.x == 1.0
    np.testing.assert_array_equal(adapter.from_msg(message).boxes, boxes.boxes)  # not modified
    T = np.eye(4)
    T[:2, :2] = [[0, -1], [1, 0]]  # yaw of 90 degrees: x becomes y
    rotated = adapter.to_msg(message, boxes, None, T).obstacles[0].velocity
    assert (rotated.x, rotated.y) == (0.0, 1.0)


def test_boxes_of_an_earlier_message_are_added(adapter, drive):
    message = first_array(drive)
    added = adapter.with_added(replaced_obstacles(message, message.obstacles[:1]), [(message, 1)])
    boxes = adapter.from_msg(added)
    assert boxes.track_ids == ('1', '2')
    assert boxes.scores.tolist() == [0.75, 0.0]


def replaced_obstacles(message, obstacles):
    changed = copy(message)
    changed.obstacles = obstacles
    return changed


def test_definition_without_a_field_is_refused(adapter, drive):
    message = first_array(drive)
    message.obstacles[0] = SimpleNamespace(id=1)
    with pytest.raises(UnsupportedMessage, match='field category'):
        adapter.from_msg(message)


def test_relabel_refines_the_boxes(tmp_path, drive):
    recording = drive.write(tmp_path / 'drive')
    config = Config().updated({'solver.rounds': 1})
    summary = relabel(
        Request((recording,), config=config, formats=('csv', 'mcap')), tmp_path / 'out'
    )
    assert summary.topics['boxes'] == '/boxes'
    assert (summary.boxes_in, summary.boxes_out) == (14, 14)
    assert summary.status['refined'] == 14
