"""
Serialised messages: read and written as those of the adapters of objects.

``PYTHONPATH=test python test/msg_adapters/test_serialized.py`` prints the times of messages of
1,000 boxes.

"""

from dataclasses import replace
import sys
import time

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.live.topics import import_message
from boxreg_ros.structures import KINEMATICS
from msg_adapters import adapter_for, ADAPTERS
from msg_adapters.cdr import installed_definition, Layout
from msg_adapters.convention import Convention, STANDARD
from msg_adapters.serialized import BOX_FIELDS, serialized_adapter_for
import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from ros_messages import BOXES, DETECTIONS, JSK, MARKERS, Messages, OBJECTS, SCENE, TRACKED

STAMP = 1_700_000_000_123_456_789
ASSOCIATE = replace(STANDARD, associate=True)
M = Messages()


def class_of(type_name):
    """Return a message class of rclpy; skip the test where its package is not installed."""
    try:
        return import_message(type_name)
    except UnsupportedMessage as error:
        pytest.skip(str(error))


def message_of(type_name, n=5):
    """Return a message of n boxes, of rclpy."""
    rng = np.random.default_rng(1)
    quaternions = rng.normal(0, 1, (n, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    found = [
        (1 + k % 250, (rng.normal(0, 30, 3), quaternions[k]), rng.uniform(1, 5, 3))
        for k in range(n)
    ]
    message = M.boxes(type_name, STAMP, 'lidar', found)
    data = bytes(M.store.serialize_cdr(message, type_name))
    return deserialize_message(data, class_of(type_name))


def items_of(message):
    return next(
        getattr(message, name)
        for name in ('detections', 'objects', 'markers', 'entities', 'boxes')
        if hasattr(message, name)
    )


def kinematics_of(n):
    """Return velocities and accelerations of n boxes, every third one unknown."""
    rng = np.random.default_rng(2)
    found = np.zeros(n, KINEMATICS)
    for name in ('velocity', 'acceleration', 'velocity_covariance', 'acceleration_covariance'):
        found[name] = rng.normal(0, 1, found[name].shape)
    found['has_velocity'] = np.arange(n) % 3 > 0
    found['has_acceleration'] = np.arange(n) % 3 > 1
    return found


class Adapters:
    """The adapter of serialised messages of a type, and that of objects."""

    def __init__(self, type_name, convention=ASSOCIATE):
        self.kind = class_of(type_name)
        self.deserialized = []
        self.fast = serialized_adapter_for(type_name, convention, self.kind, self._deserialize)
        self.slow = adapter_for(type_name, convention)

    def _deserialize(self, data, kind):
        self.deserialized.append(data)
        return deserialize_message(data, kind)

    def check(self, message, T_out_in=None, frame_id='lidar'):
        """Check that both read and write the same; return whether without objects."""
        data = serialize_message(message)
        found = self.fast.from_msg(data)
        expected = self.slow.from_msg(message)
        assert found.track_ids == expected.track_ids
        assert found.class_names == expected.class_names
        assert (found.stamp_ns, found.frame_id) == (expected.stamp_ns, expected.frame_id)
        np.testing.assert_array_equal(found.scores, expected.scores)
        np.testing.assert_array_equal(found.boxes, expected.boxes)
        n = len(expected.boxes)
        boxes = expected.boxes + np.linspace(0.1, 0.2, 9)
        boxes[: n // 2, 8] += np.pi  # the heading flips
        boxes[-1:, 0] = np.nan
        covariances = np.tile(np.eye(6), (n, 1, 1)) * np.arange(1, n + 1)[:, None, None]
        covariances[:1] = np.nan
        new = replace(
            expected, boxes=boxes, frame_id=frame_id, track_ids=tuple(map(str, range(n)))
        )
        moving = replace(new, kinematics=kinematics_of(n))
        for wanted, given in ((moving, covariances), (new, None)):
            written = self.fast.to_msg(data, wanted, given, T_out_in)
            if not isinstance(written, bytes):
                written = serialize_message(written)
            by_objects = serialize_message(self.slow.to_msg(message, wanted, given, T_out_in))
            written, by_objects = (
                deserialize_message(data, self.kind) for data in (written, by_objects)
            )
            assert written == by_objects
        assert message == deserialize_message(data, self.kind)  # it is not modified
        return not self.deserialized


@pytest.mark.parametrize('type_name', BOX_FIELDS)
def test_boxes_are_read_and_written_without_objects(type_name):
    assert type_name in ADAPTERS
    assert Adapters(type_name).check(message_of(type_name))
    assert not Adapters(type_name).check(message_of(type_name, n=0))  # no stamp, no frame


def test_a_message_is_walked_through_once(monkeypatch):
    """For reading, and for writing early and final boxes, which do not change each other."""
    walked = []
    fields_of = Layout.fields_of

    def noted(layout, data):
        walked.append(data)
        return fields_of(layout, data)

    monkeypatch.setattr(Layout, 'fields_of', noted)
    adapter = Adapters(MARKERS).fast
    data = serialize_message(message_of(MARKERS))
    given = adapter.from_msg(data)
    early, final = (replace(given, boxes=given.boxes + shift) for shift in (0.1, 0.2))
    written = [adapter.to_msg(data, boxes) for boxes in (early, final, given)]
    assert walked == [data]
    for message, boxes in zip(written, (early, final, given), strict=True):
        np.testing.assert_allclose(adapter.from_msg(message).boxes, boxes.boxes, atol=1e-9)


@pytest.mark.parametrize('type_name', BOX_FIELDS)
def test_boxes_of_earlier_messages_are_added_by_the_objects(type_name):
    adapters = Adapters(type_name)
    message = message_of(type_name)
    data = serialize_message(message)
    added = adapters.fast.with_added(data, [(data, 1)])
    assert added == adapters.slow.with_added(message, [(message, 1)])
    boxes = adapters.slow.from_msg(added)
    assert len(boxes.boxes) == 6
    written = adapters.fast.to_msg(added, boxes)
    assert written == adapters.slow.to_msg(added, boxes)


@pytest.mark.parametrize('type_name', BOX_FIELDS)
def test_another_output_frame_is_left_to_the_objects(type_name):
    T = np.eye(4)
    T[:2, :3] = [[0, -1, 0], [1, 0, 0]]
    assert not Adapters(type_name).check(message_of(type_name), T, 'base')


def test_poses_of_another_convention():
    convention = Convention(pose_reference='bottom', size_order='wlh', forward_axis='y+')
    assert Adapters(MARKERS, convention).check(message_of(MARKERS))


def test_markers_that_are_no_boxes_are_copied():
    message = message_of(MARKERS)
    message.markers[1].type = 9
    message.markers[1].header.frame_id = 'lidar'
    message.markers[3].action = 2
    assert Adapters(MARKERS).check(message)


def without_id(message):
    message.detections[2].id = ''


def in_one_frame(message):
    message.detections[2].header.frame_id = ''


def with_cylinder(message):
    message.objects[1].shape.type = 1


def with_sphere(message):
    message.objects[1].shape.type = 2


def with_two_cubes(message):
    message.entities[1].cubes *= 2


@pytest.mark.parametrize(
    ('type_name', 'change'),
    [
        (DETECTIONS, without_id), (DETECTIONS, in_one_frame), (TRACKED, with_cylinder),
        (OBJECTS, with_sphere), (SCENE, with_two_cubes),
    ],
)  # fmt: skip
def test_what_is_out_of_the_ordinary_is_left_to_the_objects(type_name, change):
    message = message_of(type_name)
    change(message)
    assert not Adapters(type_name).check(message)


def test_objects_without_class_are_ordinary():
    message = message_of(TRACKED)
    message.objects[1].classification = []
    message.objects[2].classification[0].label = 99
    message.objects[2].classification[0].probability = 1.0
    message.objects[3].shape.footprint.points = []
    assert Adapters(TRACKED).check(message)
    message = message_of(DETECTIONS)
    message.detections[1].results = []
    message.detections[2].bbox.center.orientation.w = 9.0  # not of unit length
    assert Adapters(DETECTIONS).check(message)


def test_messages_of_one_length_with_longer_and_shorter_ids_are_read_each_by_its_own():
    adapters = Adapters(DETECTIONS)
    sizes = set()
    for ids in (('1', '23456789', '5'), ('23456789', '1', '5'), ('98765432', '2', '5')):
        message = message_of(DETECTIONS, n=3)
        for detection, name in zip(message.detections, ids, strict=True):
            detection.id = name
        sizes.add(len(serialize_message(message)))
        assert adapters.check(message)
    assert len(sizes) == 1


@pytest.mark.parametrize('type_name', [DETECTIONS, MARKERS])
def test_bytes_that_were_cut_off_or_changed_are_no_fields(type_name):
    class_of(type_name)
    at = BOX_FIELDS[type_name]
    layout = Layout(type_name, installed_definition, [at.pose, *at.frames])
    data = serialize_message(message_of(type_name))
    assert layout.fields_of(data) is not None
    for length in range(0, len(data) - 8, 7):
        assert layout.fields_of(data[:length]) is None
    rng = np.random.default_rng(2)
    for _ in range(200):  # lengths of strings and sequences among them: no crash, no hang
        changed = bytearray(data)
        changed[rng.integers(4, len(data))] = 255
        layout.fields_of(bytes(changed))
    big_endian = b'\0\0' + data[2:]
    assert layout.fields_of(big_endian) is None


def test_a_definition_without_a_field_is_refused_by_name():
    class_of(JSK)
    with pytest.raises(UnsupportedMessage, match=r'BoundingBoxArray.*boxes\.colour'):
        Layout(JSK, installed_definition, ['boxes.colour', 'boxes.value'])
    with pytest.raises(UnsupportedMessage, match='have no ids'):
        serialized_adapter_for(BOXES, STANDARD, class_of(BOXES), deserialize_message)


def milliseconds(task, repetitions=9):
    """Return the median CPU time of a task, and what it returns."""
    times = []
    for _ in range(repetitions):
        begin = time.process_time()
        result = task()
        times.append(time.process_time() - begin)
    return 1e3 * sorted(times)[repetitions // 2], result


def print_times(n):
    """Print the times of n boxes of each type, serialised and by objects [ms]."""
    print(f'{"":52}{"read":>8}{"write":>8}{"sum":>8}{"by objects":>12}')
    for type_name in BOX_FIELDS:
        adapters = Adapters(type_name)
        kind, slow = adapters.kind, adapters.slow
        data = serialize_message(message_of(type_name, n))
        covariances = np.tile(np.eye(6), (n, 1, 1))
        milliseconds(lambda a=adapters, d=data: a.fast.from_msg(d))
        reading, boxes = milliseconds(lambda a=adapters, d=data: a.fast.from_msg(d))
        writing, _ = milliseconds(
            lambda a=adapters, d=data, b=boxes, c=covariances: a.fast.to_msg(d, b, c)
        )

        def by_objects(kind=kind, slow=slow, data=data, covariances=covariances):
            message = deserialize_message(data, kind)
            serialize_message(slow.to_msg(message, slow.from_msg(message), covariances))

        objects, _ = milliseconds(by_objects)
        total = reading + writing
        print(f'{type_name:52}{reading:8.1f}{writing:8.1f}{total:8.1f}{objects:12.1f}')


if __name__ == '__main__':
    print_times(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
