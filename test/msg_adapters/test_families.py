"""All types of box messages: values, copied fields, and the same bytes in all libraries."""

from collections import deque
from dataclasses import replace
import sys
from types import SimpleNamespace

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.io.transforms import boxes_to_frame
from boxreg_ros.structures import is_valid_box, KINEMATICS
from msg_adapters import adapter_for, ADAPTERS, WITHOUT_IDS
from msg_adapters.convention import Convention, STANDARD
import numpy as np
import pytest
from ros_messages import (
    AUTO_DETECTED,
    AUTO_PREDICTED,
    AUTO_TRACKED,
    BOXES,
    DETECTED,
    DETECTIONS,
    JSK,
    MARKERS,
    Messages,
    OBJECTS,
    OBJECTS_WITH_COVARIANCE,
    PREDICTED,
    SCENE,
    TRACKED,
    typestore,
    write_recording,
)
from rosbags.typesys import get_types_from_msg, Stores
from scipy.spatial.transform import Rotation

STAMP = 1_700_000_000_123_456_789
M = Messages()
RPY = np.array([[0.0, 0.0, 0.0], [0.1, -0.2, 2.5]])
POSITIONS = np.array([[10.0, -2.0, 0.5], [-20.0, 3.0, 1.5]])
SIZES = np.array([[4.5, 1.8, 1.6], [8.0, 2.5, 3.0]])
INPUT_BOXES = np.hstack([POSITIONS, SIZES, RPY])
INPUT_COVARIANCE = 0.5 * np.eye(6)
"""Covariance in the input messages."""
WITH_UUID = (TRACKED, PREDICTED, AUTO_TRACKED, AUTO_PREDICTED)
WITHOUT_UUID = (DETECTED, AUTO_DETECTED)
WITH_COVARIANCE = (DETECTIONS, *WITH_UUID, *WITHOUT_UUID, OBJECTS_WITH_COVARIANCE)


def boxes_at(*rows, rpy=RPY):
    """Return some of the two boxes, for `Messages.boxes`."""
    quaternions = Rotation.from_euler('ZYX', rpy[:, ::-1]).as_quat()
    return [(n + 1, (POSITIONS[n], quaternions[n]), SIZES[n]) for n in rows]


def message_of(type_name, rpy=RPY):
    return M.boxes(type_name, STAMP, 'lidar', boxes_at(0, 1, rpy=rpy))


def bytes_of(message, type_name):
    return bytes(M.store.serialize_cdr(message, type_name))


def moved_boxes(given, frame_id='lidar', boxes=None):
    """Return longer boxes further to the left instead of the given ones."""
    step = np.array([0, 1.0, 0, 0.9, 0.36, 0, 0, 0, 0.01])
    return replace(given, frame_id=frame_id, boxes=given.boxes + step if boxes is None else boxes)


def posed_of(message, type_name):
    """Return the ``PoseWithCovariance`` of each box of a message."""
    if type_name == DETECTIONS:
        return [detection.results[0].pose for detection in message.detections]
    if type_name == OBJECTS_WITH_COVARIANCE:
        return [item.pose for item in message.objects]
    name = 'pose_with_covariance'
    found = [item.kinematics for item in message.objects]
    return [getattr(item, name if hasattr(item, name) else f'initial_{name}') for item in found]


def covariances_of(message, type_name):
    """Return the covariances (n, 6, 6) of a message."""
    found = [posed.covariance for posed in posed_of(message, type_name)]
    return np.array(found).reshape(-1, 6, 6)


@pytest.mark.parametrize('type_name', ADAPTERS)
def test_boxes_are_read(type_name):
    boxes = adapter_for(type_name).from_msg(message_of(type_name))
    assert (boxes.stamp_ns, boxes.frame_id) == (STAMP, 'lidar')
    np.testing.assert_allclose(boxes.boxes, INPUT_BOXES, atol=1e-12)
    uuids = ('0' * 31 + '1', '0' * 31 + '2')
    ids = dict.fromkeys(WITH_UUID, uuids) | dict.fromkeys(WITHOUT_IDS, ('', ''))
    assert boxes.track_ids == ids.get(type_name, ('1', '2'))
    classes = {BOXES: '', JSK: '3'}
    assert boxes.class_names == (classes.get(type_name, 'car'),) * 2
    # 204 of 255 is 0.8
    scores = {OBJECTS: 0.8, OBJECTS_WITH_COVARIANCE: 0.8, DETECTIONS: 0.9, MARKERS: 1, BOXES: 1}
    np.testing.assert_allclose(boxes.scores, scores.get(type_name, 0.75))


@pytest.mark.parametrize('type_name', ADAPTERS)
def test_other_fields_are_copied(type_name):
    """Writing the same boxes changes no byte; writing other boxes and these again neither."""
    message = message_of(type_name, np.zeros((2, 3)))
    before = bytes_of(message, type_name)
    adapter = adapter_for(type_name)
    boxes = adapter.from_msg(message)
    unknown = np.full((2, 6, 6), np.nan)
    assert bytes_of(adapter.to_msg(message, boxes, unknown), type_name) == before
    out = adapter.to_msg(message, moved_boxes(boxes), np.stack([np.eye(6)] * 2))
    assert bytes_of(message, type_name) == before, 'the input message is not modified'
    back = adapter.from_msg(out)
    np.testing.assert_allclose(back.boxes, moved_boxes(boxes).boxes, atol=1e-6)
    again = adapter.to_msg(
        out, boxes, np.stack([INPUT_COVARIANCE] * 2) if type_name != DETECTIONS else None
    )
    if type_name == DETECTIONS:
        again = adapter.to_msg(out, boxes, np.zeros((2, 6, 6)))
    if type_name in WITHOUT_UUID:  # set because a covariance was written
        for item in again.objects:
            assert item.kinematics.has_position_covariance
            item.kinematics.has_position_covariance = False
    assert bytes_of(again, type_name) == before


@pytest.mark.parametrize('type_name', ADAPTERS)
def test_boxes_of_earlier_messages_are_added(type_name):
    """They get the stamp of the message and the score 0; `to_msg` sets all boxes."""
    adapter = adapter_for(type_name)
    earlier = M.boxes(type_name, STAMP - 10**8, 'lidar', boxes_at(0, 1))
    message = M.boxes(type_name, STAMP, 'lidar', boxes_at(0))
    before = bytes_of(message, type_name), bytes_of(earlier, type_name)
    given = adapter.from_msg(earlier)
    moved = replace(moved_boxes(given), stamp_ns=STAMP)
    out = adapter.to_msg(adapter.with_added(message, [(earlier, 1)]), moved)
    assert (bytes_of(message, type_name), bytes_of(earlier, type_name)) == before
    M.store.serialize_cdr(out, type_name)
    found = adapter.from_msg(out)
    assert (found.stamp_ns, found.frame_id) == (STAMP, 'lidar')
    assert (found.track_ids, found.class_names) == (given.track_ids, given.class_names)
    np.testing.assert_allclose(found.boxes, moved.boxes, atol=1e-6)
    has_score = type_name not in (MARKERS, BOXES)
    assert found.scores.tolist() == [given.scores[0], 0.0 if has_score else 1.0]
    if type_name == MARKERS:
        assert [marker.text for marker in out.markers] == ['', 'coasted']


@pytest.mark.parametrize('type_name', WITH_COVARIANCE)
def test_kept_boxes_keep_the_covariance_of_the_detector(type_name):
    message, adapter = message_of(type_name), adapter_for(type_name)
    boxes = adapter.from_msg(message)
    own = covariances_of(message, type_name)
    ours = np.diag(np.arange(1.0, 7.0))
    out = adapter.to_msg(message, boxes, np.stack([np.full((6, 6), np.nan), ours]))
    np.testing.assert_array_equal(covariances_of(out, type_name), [own[0], ours])
    if type_name in WITHOUT_UUID:
        assert [o.kinematics.has_position_covariance for o in out.objects] == [False, True]


@pytest.mark.parametrize('type_name', WITH_COVARIANCE)
def test_covariances_are_rotated_to_the_output_frame(type_name):
    message, adapter = message_of(type_name), adapter_for(type_name)
    for posed in posed_of(message, type_name):
        posed.covariance = np.diag([4.0, 1.0, 0, 0, 0, 0]).reshape(36)
    T = np.eye(4)
    T[:2, :2] = [[0, -1], [1, 0]]  # yaw of 90 degrees: x becomes y
    boxes = moved_boxes(adapter.from_msg(message), 'map')
    out = adapter.to_msg(message, boxes, None, T)
    for covariance in covariances_of(out, type_name):
        np.testing.assert_allclose(np.diag(covariance)[:3], [1.0, 4.0, 0.0], atol=1e-12)


def test_footprint_is_scaled_with_the_box():
    adapter = adapter_for(TRACKED)
    message = message_of(TRACKED)
    out = adapter.to_msg(message, moved_boxes(adapter.from_msg(message)))
    # 4.5 m and 1.8 m become 5.4 m and 2.16 m: a factor of 1.2 for both coordinates.
    corner, other = out.objects[0].shape.footprint.points
    np.testing.assert_allclose([corner.x, corner.y, other.x, other.y], [2.7, 1.08, -2.7, 1.08])


@pytest.mark.parametrize('type_name', [*WITH_UUID, *WITHOUT_UUID])
def test_twist_is_rotated_where_the_heading_flips(type_name):
    adapter = adapter_for(type_name)
    message = message_of(type_name)
    boxes = adapter.from_msg(message)
    flipped = boxes.boxes + np.array([[0, 0, 0, 0, 0, 0, 0, 0, np.pi], np.zeros(9)])
    out = adapter.to_msg(message, moved_boxes(boxes, boxes=flipped))
    prefix = 'initial_' if hasattr(out.objects[0].kinematics, 'predicted_paths') else ''
    first, second = (
        getattr(o.kinematics, f'{prefix}twist_with_covariance').twist for o in out.objects
    )
    assert (first.linear.x, first.linear.y, first.angular.z) == (-3.0, -0.5, 0.1)
    assert (second.linear.x, second.linear.y) == (3.0, 0.5)
    if type_name in WITH_UUID:
        moving = getattr(out.objects[0].kinematics, f'{prefix}acceleration_with_covariance')
        assert moving.accel.linear.x == -0.25


def turning_boxes(given, yaw, speed, frame_id='lidar'):
    """Return `given` at a yaw, each driving forward, in a left turn of 0.2 rad/s."""
    boxes = given.boxes.copy()
    boxes[:, 6:] = 0.0, 0.0, yaw
    kinematics = np.zeros(len(boxes), KINEMATICS)
    kinematics['velocity'] = speed * np.cos(yaw), speed * np.sin(yaw), 0.0, 0.2
    kinematics['velocity_covariance'] = np.diag([1.0, 4.0, 9.0, 0.01])
    kinematics['acceleration'] = 0.0, 0.5, 0.0
    kinematics['acceleration_covariance'] = np.diag([1.0, 4.0, 9.0])
    kinematics['has_velocity'] = kinematics['has_acceleration'] = np.arange(len(boxes)) == 0
    return replace(given, frame_id=frame_id, boxes=boxes, kinematics=kinematics)


@pytest.mark.parametrize('type_name', [*WITH_UUID, *WITHOUT_UUID])
def test_twist_and_acceleration_are_in_the_axes_of_the_object(type_name):
    """Of a box with a known velocity; the other one keeps those of the message."""
    adapter = adapter_for(type_name)
    message = message_of(type_name, rpy=np.zeros((2, 3)))
    boxes = turning_boxes(adapter.from_msg(message), np.pi / 2, 5.0)
    first, second = (o.kinematics for o in adapter.to_msg(message, boxes).objects)
    prefix = 'initial_' if hasattr(first, 'predicted_paths') else ''
    moving = getattr(first, f'{prefix}twist_with_covariance')
    twist = moving.twist
    np.testing.assert_allclose(
        [twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.z],
        [5, 0, 0, 0.2],
        atol=1e-9,
    )
    own = np.reshape(
        getattr(message.objects[0].kinematics, f'{prefix}twist_with_covariance').covariance, (6, 6)
    )
    covariance = np.reshape(moving.covariance, (6, 6))
    np.testing.assert_allclose(np.diag(covariance)[[0, 1, 2, 5]], [4, 1, 9, 0.01], atol=1e-9)
    assert covariance[3, 3] == own[3, 3] and covariance[4, 4] == own[4, 4]
    kept = getattr(second, f'{prefix}twist_with_covariance').twist
    assert (kept.linear.x, kept.linear.y) == (3.0, 0.5)
    flipped = turning_boxes(boxes, -np.pi / 2, -5.0)
    out = adapter.to_msg(message, flipped).objects[0].kinematics
    assert getattr(out, f'{prefix}twist_with_covariance').twist.linear.x == pytest.approx(-5)
    if type_name in WITH_UUID:
        accel = getattr(first, f'{prefix}acceleration_with_covariance').accel.linear
        np.testing.assert_allclose([accel.x, accel.y], [0.5, 0.0], atol=1e-9)
    if hasattr(first, 'has_twist'):
        assert first.has_twist and first.has_twist_covariance


@pytest.mark.parametrize('type_name', [OBJECTS, OBJECTS_WITH_COVARIANCE])
def test_twist_of_an_object_array_is_in_the_axes_of_its_frame(type_name):
    adapter = adapter_for(type_name)
    message = message_of(type_name)
    boxes = turning_boxes(adapter.from_msg(message), np.pi / 2, 5.0)
    first, second = adapter.to_msg(message, boxes).objects
    before = message.objects[1].twist
    if type_name == OBJECTS_WITH_COVARIANCE:
        assert np.diag(np.reshape(first.twist.covariance, (6, 6)))[1] == 4.0
        found, kept, before = first.twist.twist, second.twist.twist, before.twist
        assert first.accel.accel.linear.y == 0.5
    else:
        found, kept = first.twist, second.twist
    assert (found.linear.x, found.linear.y) == (pytest.approx(0.0), pytest.approx(5.0))
    assert kept == before


def test_twist_follows_pose_reference_and_forward_axis():
    """The rear axle of a car that turns left moves to the right of its centre."""
    axle = Convention(pose_reference='-0.5,0,0', forward_axis='y+')
    adapter = adapter_for(TRACKED, axle)
    message = message_of(TRACKED, rpy=np.zeros((2, 3)))
    boxes = turning_boxes(adapter.from_msg(message), 0.0, 5.0)
    twist = adapter.to_msg(message, boxes).objects[0].kinematics.twist_with_covariance.twist
    length = boxes.boxes[0, 3]
    # y of the pose is forward, so its x points to the right.
    np.testing.assert_allclose(
        [twist.linear.x, twist.linear.y], [0.2 * length / 2, 5.0], atol=1e-9
    )


def test_kinematics_turn_with_the_frame_of_the_boxes():
    T = np.eye(4)
    T[:2, :2], T[:3, 3] = [[0, -1], [1, 0]], [100.0, 200.0, 0.0]
    boxes = turning_boxes(adapter_for(TRACKED).from_msg(message_of(TRACKED)), 0.0, 5.0)
    moved = boxes_to_frame(boxes, T, 'map')
    np.testing.assert_allclose(moved.kinematics['velocity'][0], [0, 5, 0, 0.2], atol=1e-12)
    covariance = moved.kinematics['velocity_covariance'][0]
    np.testing.assert_allclose(np.diag(covariance), [4, 1, 9, 0.01], atol=1e-12)
    np.testing.assert_allclose(moved.kinematics['acceleration'][0], [-0.5, 0, 0], atol=1e-12)


def test_predicted_paths_are_moved_to_the_output_frame():
    message = message_of(PREDICTED)
    T = np.eye(4)
    T[:2, :2], T[:3, 3] = [[0, -1], [1, 0]], [100.0, 200.0, 0.0]
    adapter = adapter_for(PREDICTED)
    boxes = moved_boxes(adapter.from_msg(message), 'map')
    first = adapter.to_msg(message, boxes, None, T).objects[0]
    (step,) = first.kinematics.predicted_paths[0].path
    # (10, -2) rotated by 90 degrees is (2, 10).
    np.testing.assert_allclose([step.position.x, step.position.y], [102.0, 210.0], atol=1e-9)


@pytest.mark.parametrize('availability', [0, 1, 2])
def test_the_orientation_is_read_whatever_its_availability(availability):
    message = message_of(TRACKED)
    message.objects[0].kinematics.orientation_availability = availability
    boxes = adapter_for(TRACKED).from_msg(message)
    np.testing.assert_allclose(boxes.boxes, INPUT_BOXES, atol=1e-12)
    out = adapter_for(TRACKED).to_msg(message, boxes)
    assert out.objects[0].kinematics.orientation_availability == availability


def test_cylinder_gets_the_mean_of_length_and_width():
    message = message_of(TRACKED)
    message.objects[0].shape.type = 1
    adapter = adapter_for(TRACKED)
    out = adapter.to_msg(message, moved_boxes(adapter.from_msg(message)))
    # 4.5 m and 1.8 m become 5.4 m and 2.16 m, on average 3.78 m.
    first, second = (o.shape.dimensions for o in out.objects)
    np.testing.assert_allclose([first.x, first.y, first.z], [3.78, 3.78, 1.6])
    assert second.x != second.y


def test_copied_fields_are_transformed_to_the_output_frame():
    message = message_of(OBJECTS_WITH_COVARIANCE)
    message.objects[0].twist.covariance = np.diag([9.0, 1, 1, 4, 1, 1]).ravel()
    corner = M.make('geometry_msgs/msg/Point32', x=4.0, y=-1.0, z=0.5)
    message.objects[0].polygon.points = [corner]
    adapter = adapter_for(OBJECTS_WITH_COVARIANCE)
    T = np.eye(4)
    T[:2, :2], T[:3, 3] = [[0, -1], [1, 0]], [100.0, 200.0, 0.0]
    out = adapter.to_msg(message, moved_boxes(adapter.from_msg(message), 'map'), None, T).objects[
        0
    ]
    covariance = np.reshape(out.twist.covariance, (6, 6))
    np.testing.assert_allclose(np.diag(covariance), [1, 9, 1, 1, 4, 1], atol=1e-12)
    # (4, -1) rotated by 90 degrees is (1, 4).
    (point,) = out.polygon.points
    np.testing.assert_allclose([point.x, point.y, point.z], [101.0, 204.0, 0.5])


def test_unknown_labels_and_zero_uuids():
    message = message_of(TRACKED)
    message.objects[0].classification[0].probability = 1.0
    message.objects[0].classification[0].label = 8
    message.objects[1].classification[1].label = 40
    message.objects[1].object_id.uuid[:] = 0
    boxes = adapter_for(TRACKED).from_msg(message)
    assert boxes.class_names == ('animal', 'label_40')
    assert boxes.track_ids == ('0' * 31 + '1', '')


def test_objects_that_are_not_boxes_are_invalid_boxes_and_transformed():
    message = message_of(OBJECTS)
    message.objects[0].shape.type = 2
    message.objects[0].shape.dimensions = np.array([0.5])
    adapter = adapter_for(OBJECTS)
    boxes = adapter.from_msg(message)
    assert boxes.track_ids == ('1', '2')
    assert is_valid_box(boxes.boxes).tolist() == [False, True]
    T = np.eye(4)
    T[:2, :2], T[:3, 3] = [[0, -1], [1, 0]], [100.0, 0.0, 0.0]
    out = adapter.to_msg(message, moved_boxes(boxes, 'map'), None, T)
    position = out.objects[0].pose.position
    twist = out.objects[0].twist.linear
    # (10, -2) rotated by 90 degrees is (2, 10); 3 m/s along x become 3 m/s along y.
    np.testing.assert_allclose(
        [position.x, position.y, twist.x, twist.y], [102.0, 10.0, 0.0, 3.0], atol=1e-9
    )
    assert {o.header.frame_id for o in out.objects} == {'map'}
    np.testing.assert_allclose(
        adapter.from_msg(out).boxes[1:], moved_boxes(boxes).boxes[1:], atol=1e-9
    )


def test_scene_entities_with_several_cubes_or_none():
    message = message_of(SCENE)
    message.entities[0].cubes.append(message.entities[1].cubes[0])
    message.entities[1].cubes = []
    adapter = adapter_for(SCENE)
    boxes = adapter.from_msg(message)
    assert boxes.track_ids == ('1/0', '1/1')
    T = np.eye(4)
    T[0, 3] = 100.0
    out = adapter.to_msg(message, moved_boxes(boxes, 'map'), None, T)
    np.testing.assert_allclose(adapter.from_msg(out).boxes, moved_boxes(boxes).boxes, atol=1e-9)
    assert out.entities[0].texts[0].pose.position.x == 110.0
    assert [entity.frame_id for entity in out.entities] == ['map', 'lidar']
    empty = adapter.from_msg(M.build(SCENE))
    assert (empty.stamp_ns, empty.frame_id, empty.boxes.shape) == (0, '', (0, 9))
    message.entities[0].metadata[1].value = 'high'
    assert adapter.from_msg(message).scores.tolist() == [1.0, 1.0]


def test_empty_ids_of_detections_are_filled_in():
    message = message_of(DETECTIONS)
    message.detections[0].id = ''
    adapter = adapter_for(DETECTIONS)
    boxes = adapter.from_msg(message)
    known = replace(boxes, track_ids=('a', 'b'))
    out = adapter.to_msg(message, known)
    assert [d.id for d in out.detections] == ['a', '2']


FORK = """std_msgs/Header header
geometry_msgs/Pose pose
geometry_msgs/Vector3 dimensions
float32 value
uint32 label
int32[] histogram
"""


def test_forks_of_jsk_boxes_are_read_by_the_definition_in_the_recording(tmp_path):
    messages = Messages(ros1=True)
    messages.store = typestore.__wrapped__(Stores.ROS1_NOETIC)
    box = 'jsk_recognition_msgs/msg/BoundingBox'
    for name in (box, JSK):
        del messages.store.fielddefs[name], messages.store.types[name]
    array = 'std_msgs/Header header\njsk_recognition_msgs/BoundingBox[] boxes'
    messages.store.register(get_types_from_msg(FORK, box) | get_types_from_msg(array, JSK))
    found = [(1, (POSITIONS[0], (0, 0, 0, 1)), SIZES[0])]
    message = messages.boxes(JSK, STAMP, 'lidar', found)
    message.boxes[0].histogram = np.array([1, 2, 3], np.int32)
    cloud = messages.points(STAMP, 'lidar', np.ones((4, 3)))
    items = [('/points', STAMP, cloud), ('/boxes', STAMP + 1, message)]
    path = write_recording(tmp_path / 'fork', items, 'rosbag1', messages)
    with pytest.raises(UnsupportedMessage, match='--associate'), Recording([path]):
        pass
    with Recording([path], convention=Convention(associate=True)) as recording:
        (record,) = recording._records(TransformTree(), {'/boxes'}, deque())
        raw, boxes = recording.box_message(record.connection, record.data)
    np.testing.assert_allclose(boxes.boxes, INPUT_BOXES[:1], atol=1e-12)
    out = adapter_for(JSK).to_msg(raw, moved_boxes(boxes))
    assert out.boxes[0].histogram.tolist() == [1, 2, 3]


@pytest.mark.parametrize('type_name', WITHOUT_IDS)
def test_types_without_ids_are_refused_with_a_hint(type_name):
    with pytest.raises(UnsupportedMessage, match=r'no ids.*associate:=true.*--associate'):
        adapter_for(type_name, STANDARD)


# The same bytes in all libraries -----------------------------------------------------------------


def from_rclpy(type_name, data):
    pytest.importorskip('rclpy', reason='rclpy is not installed')
    from rclpy.serialization import deserialize_message

    package, _, name = type_name.split('/')
    module = pytest.importorskip(f'{package}.msg', reason=f'{package} is not installed')
    if not hasattr(module, name):
        pytest.skip(f'{name} is newer than the {package} installed: test/build_interfaces.py')
    return deserialize_message(data, getattr(module, name))


def from_mcap(type_name, data):
    dynamic = pytest.importorskip('mcap_ros2._dynamic', reason='mcap-ros2-support is missing')
    text, _ = M.store.generate_msgdef(type_name, ros_version=2)
    return dynamic.generate_dynamic(type_name, text)[type_name](data)


@pytest.mark.parametrize('type_name', ADAPTERS)
def test_rclpy_rosbags_and_mcap_read_and_write_the_same(type_name):
    data, adapter = bytes_of(message_of(type_name), type_name), adapter_for(type_name)
    message = M.store.deserialize_cdr(data, type_name)
    ours = adapter.from_msg(message)
    covariances = np.stack([np.full((6, 6), np.nan), 2 * np.eye(6)])
    T = np.eye(4)
    T[:2, :2] = [[0, -1], [1, 0]]
    written = adapter.to_msg(message, moved_boxes(ours, 'map'), covariances, T)
    for reader in (from_mcap, from_rclpy):
        theirs = reader(type_name, data)
        boxes = adapter.from_msg(theirs)
        assert (boxes.stamp_ns, boxes.frame_id) == (ours.stamp_ns, ours.frame_id)
        assert (boxes.track_ids, boxes.class_names) == (ours.track_ids, ours.class_names)
        np.testing.assert_array_equal(boxes.scores, ours.scores)
        np.testing.assert_array_equal(boxes.boxes, ours.boxes)
        out = adapter.to_msg(theirs, moved_boxes(boxes, 'map'), covariances, T)
        np.testing.assert_array_equal(adapter.from_msg(out).boxes, adapter.from_msg(written).boxes)
        if reader is from_rclpy:
            from rclpy.serialization import serialize_message

            again = M.store.deserialize_cdr(serialize_message(out), type_name)
            assert bytes_of(again, type_name) == bytes_of(written, type_name)


def test_missing_message_package_is_named(monkeypatch):
    pytest.importorskip('rclpy', reason='rclpy is not installed')
    from boxreg_ros.live.topics import import_message

    for type_name in ADAPTERS:
        package = type_name.split('/')[0]
        monkeypatch.setitem(sys.modules, f'{package}.msg', None)
        with pytest.raises(UnsupportedMessage, match=f'ros-jazzy-{package.replace("_", "-")}'):
            import_message(type_name)


def test_timestamps_of_all_encodings():
    for stamp in (
        SimpleNamespace(sec=7, nanosec=9),
        SimpleNamespace(sec=7, nsec=9),
        SimpleNamespace(seconds=7, nanos=9),
    ):
        message = message_of(SCENE)
        for entity in message.entities:
            entity.timestamp = stamp
        assert adapter_for(SCENE).from_msg(message).stamp_ns == 7 * 10**9 + 9


# Malformed messages -----------------------------------------------------------------------------


def as_namespace(message):
    """Return a message as `json` decodes it: lists and namespaces of plain values."""
    if isinstance(message, list):
        return [as_namespace(item) for item in message]
    if hasattr(message, '__dataclass_fields__'):
        names = [name for name in message.__dataclass_fields__ if name != '__msgtype__']
        return SimpleNamespace(**{name: as_namespace(getattr(message, name)) for name in names})
    return message


@pytest.mark.parametrize(
    ('path', 'value', 'expected'),
    [
        ('entities', 5, 'expected a list as entities, got 5'),
        ('entities.0.cubes', 'many', "expected a list as cubes, got 'many'"),
        ('entities.0.cubes.0.pose', None, 'field pose.position.x'),
        ('entities.0.cubes.0.size', SimpleNamespace(x=1.0), 'field size.y'),
        (
            'entities.0.cubes.0.size.x',
            'wide',
            'expected numbers as position, orientation and size',
        ),
        ('entities.0.cubes.0.size.x', 10**400, 'expected numbers as position'),
        ('entities.0.cubes.0.pose.position.x', [1.0], 'expected numbers as position'),
        ('entities.0.timestamp', None, 'expected a timestamp of whole seconds'),
        ('entities.0.timestamp.sec', 'noon', 'expected a timestamp of whole seconds'),
        ('entities.0.timestamp.sec', 10**12, 'expected a timestamp of whole seconds'),
        ('entities.0.metadata', [1], 'field key'),
        ('entities.0.frame_id', 5, 'expected one frame and one stamp for all boxes'),
    ],
)
def test_malformed_json_scene_is_refused(path, value, expected):
    message = as_namespace(message_of(SCENE))
    *parents, name = path.split('.')
    owner = message
    for parent in parents:
        owner = owner[int(parent)] if parent.isdigit() else getattr(owner, parent)
    setattr(owner, name, value)
    with pytest.raises(UnsupportedMessage, match=expected):
        adapter_for(SCENE).from_msg(message)


def test_json_scene_with_null_lists_is_read():
    message = as_namespace(message_of(SCENE))
    message.entities[0].cubes = None
    message.entities[1].metadata = None
    boxes = adapter_for(SCENE).from_msg(message)
    assert (boxes.track_ids, boxes.class_names, boxes.scores.tolist()) == (('2',), ('',), [1.0])


@pytest.mark.parametrize(
    ('type_name', 'items', 'field'),
    [
        (TRACKED, 'objects', 'existence_probability'),
        (DETECTED, 'objects', 'kinematics'),
        (OBJECTS, 'objects', 'classification'),
        (JSK, 'boxes', 'value'),
        (MARKERS, 'markers', 'scale'),
        (DETECTIONS, 'detections', 'id'),
    ],
)
def test_definition_without_a_field_is_refused(type_name, items, field):
    message = as_namespace(message_of(type_name))
    for item in getattr(message, items):
        delattr(item, field)
    with pytest.raises(UnsupportedMessage, match=field):
        adapter_for(type_name).from_msg(message)


@pytest.mark.parametrize('type_name', ADAPTERS)
@pytest.mark.parametrize('size', [(-4.5, 1.8, 1.6), (0.0, 1.8, 1.6), (np.nan, 1.8, 1.6)])
def test_boxes_with_invalid_sizes_remain_in_the_array(type_name, size):
    boxes = [(n + 1, (POSITIONS[n], (0, 0, 0, 1)), size if n else SIZES[0]) for n in range(2)]
    message = M.boxes(type_name, STAMP, 'lidar', boxes)
    found = adapter_for(type_name).from_msg(message)
    assert is_valid_box(found.boxes).tolist() == [True, False]


def test_types_without_ids():
    assert set(WITHOUT_IDS) == {BOXES, DETECTED, AUTO_DETECTED, JSK}
