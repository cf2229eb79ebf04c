"""Point clouds, detections and markers: values, units, layouts and contradictions."""

import array
from types import SimpleNamespace

from boxreg_ros.errors import UnsupportedMessage
from msg_adapters import adapter_for, ADAPTERS, markers, pointcloud, vision
from msg_adapters.poses import quaternions_of
import numpy as np
import pytest
from ros_messages import DETECTIONS, MARKERS, Messages, POINTS
from scipy.spatial.transform import Rotation

STAMP = 1_700_000_000_123_456_789
XYZ = np.array([[1.0, 2.0, 3.0], [-4.5, 5.25, -6.125], [7.0, 8.0, 9.0], [0.5, 0.25, 0.125]])
M = Messages()


def columns(kind='f4', names='xyz', xyz=XYZ):
    return [(name, kind, xyz[:, 'xyz'.index(name)]) for name in names]


# Point clouds ------------------------------------------------------------------------------------


@pytest.mark.parametrize('order', ['<', '>'])
@pytest.mark.parametrize('kind', ['f4', 'f8'])
@pytest.mark.parametrize('names', ['xyz', 'zxy'])
@pytest.mark.parametrize('padding', [0, 5])
@pytest.mark.parametrize(('height', 'row_padding'), [(1, 0), (2, 0), (2, 7)])
def test_cloud_of_any_layout(order, kind, names, padding, height, row_padding):
    extra = [('ring', 'u2', np.arange(4)), *columns(kind, names), ('intensity', 'f4', np.ones(4))]
    sweep = pointcloud.from_msg(
        M.cloud(STAMP, 'lidar', extra, order, height, padding, row_padding)
    )
    assert (sweep.stamp_ns, sweep.frame_id, sweep.times) == (STAMP, 'lidar', None)
    assert sweep.points.dtype == np.dtype(kind)
    assert sweep.points.dtype.isnative
    np.testing.assert_array_equal(sweep.points, XYZ)
    np.testing.assert_array_equal(sweep.origin, 0.0)


@pytest.mark.parametrize('kind', ['i1', 'u1', 'i2', 'u2', 'i4', 'u4'])
def test_cloud_of_integers(kind):
    xyz = np.arange(12.0).reshape(4, 3)
    sweep = pointcloud.from_msg(M.cloud(STAMP, 'lidar', columns(kind, xyz=xyz), '>'))
    np.testing.assert_array_equal(sweep.points, xyz)
    assert sweep.points.dtype.kind == 'f'


def test_cloud_keeps_float64_exact_far_from_the_origin():
    xyz = XYZ + np.array([500_000.001, 5_400_000.002, 0.0])
    sweep = pointcloud.from_msg(M.cloud(STAMP, 'map', columns('f8', xyz=xyz)))
    np.testing.assert_array_equal(sweep.points, xyz)


def test_points_that_are_not_finite_are_removed_with_their_times():
    xyz = XYZ.copy()
    xyz[1, 2], xyz[2, 0] = np.nan, -np.inf
    message = M.cloud(STAMP, 'lidar', [*columns(xyz=xyz), ('t', 'u4', np.arange(4) * 20_000_000)])
    sweep = pointcloud.from_msg(message)
    np.testing.assert_array_equal(sweep.points, XYZ[[0, 3]])
    np.testing.assert_allclose(sweep.times, [0.0, 0.06])


SECONDS = np.array([-0.01, 0.0, 0.05, 0.09])


@pytest.mark.parametrize('name', ['t', 'time', 'timestamp', 'offset_time', 'time_offset'])
@pytest.mark.parametrize(
    ('kind', 'values', 'accuracy'),
    [
        ('f4', SECONDS, 1e-8),
        ('f8', SECONDS, 1e-12),
        ('f4', SECONDS * 1e3, 1e-8),
        ('f4', SECONDS * 1e6, 1e-8),
        ('f8', SECONDS * 1e9, 1e-12),
        ('i4', SECONDS * 1e6, 1e-12),
        ('i4', SECONDS * 1e9, 1e-12),
        ('f8', SECONDS + STAMP * 1e-9, 1e-6),
        ('f8', SECONDS * 1e6 + STAMP * 1e-3, 1e-6),
        ('f8', SECONDS * 1e9 + STAMP, 1e-6),
    ],
    ids=[
        's',
        's f8',
        'ms',
        'us f4',
        'ns f8',
        'us',
        'ns',
        'absolute s',
        'absolute us',
        'absolute ns',
    ],
)
def test_point_times_in_any_unit(name, kind, values, accuracy):
    sweep = pointcloud.from_msg(M.cloud(STAMP, 'lidar', [*columns(), (name, kind, values)]))
    np.testing.assert_allclose(sweep.times, SECONDS, rtol=0, atol=accuracy)


@pytest.mark.parametrize(
    ('kind', 'unit'), [('u4', 1e-9), ('u4', 1e-6), ('u2', 1e-3), ('u1', 1e-3)]
)
def test_point_times_relative_to_the_start_of_the_sweep(kind, unit):
    seconds = np.array([0.0, 0.025, 0.05, 0.099])
    column = ('t', kind, np.round(seconds / unit).astype(kind))
    sweep = pointcloud.from_msg(M.cloud(STAMP, 'lidar', [*columns(), column]))
    np.testing.assert_allclose(sweep.times, seconds, rtol=0, atol=1e-12)


def test_absolute_point_times_of_a_simulated_clock():
    values = SECONDS + 500.0
    message = M.cloud(500 * 10**9, 'lidar', [*columns(), ('timestamp', 'f8', values)])
    np.testing.assert_allclose(pointcloud.from_msg(message).times, SECONDS, atol=1e-12)


def test_intensities_belong_to_the_finite_points():
    seconds = np.array([0.0, 0.1, 0.2, 0.3])
    xyz = XYZ.copy()
    xyz[1:3, 2] = [np.inf, np.nan]
    extra = [('t', 'f4', seconds), ('intensity', 'u2', np.array([5, 6, 7, 800]))]
    message = M.cloud(STAMP, 'lidar', [*columns(xyz=xyz), *extra], height=2, row_padding=3)
    np.testing.assert_array_equal(pointcloud.from_msg(message).points, XYZ[[0, 3]])
    np.testing.assert_array_equal(pointcloud.intensities(message), [5, 800])


def test_missing_or_non_finite_intensities():
    assert pointcloud.intensities(M.cloud(STAMP, 'lidar', columns())) is None
    fields = [*columns(), ('i', 'f4', np.array([np.nan, np.inf, 2.0, -np.inf]))]
    message = M.cloud(STAMP, 'lidar', fields)
    np.testing.assert_array_equal(pointcloud.intensities(message), [0, 0, 2, 0])


@pytest.mark.parametrize(('kind', 'origin'), [('f4', 0.0), ('f8', 0.0), ('f8', STAMP * 1e-9)])
def test_points_with_non_finite_time_are_kept(kind, origin):
    for unknown, expected in (([1, 3], [-0.01, 0.0, 0.05, 0.0]), ([0, 1, 2, 3], None)):
        seconds = SECONDS + origin
        seconds[unknown] = np.tile([np.nan, np.inf], 2)[: len(unknown)]
        extra = [('t', kind, seconds), ('i', 'f4', np.arange(4.0))]
        message = M.cloud(STAMP, 'lidar', [*columns(), *extra])
        sweep = pointcloud.from_msg(message)
        np.testing.assert_array_equal(sweep.points, XYZ)
        np.testing.assert_array_equal(pointcloud.intensities(message), np.arange(4))
        if expected is None:
            assert sweep.times is None
        else:
            np.testing.assert_allclose(sweep.times, expected, atol=1e-6)


def test_point_times_in_no_known_unit_are_ignored():
    values = SECONDS - 2e9
    message = M.cloud(STAMP, 'lidar', [*columns(), ('timestamp', 'f8', values)])
    assert pointcloud.from_msg(message).times is None


def test_empty_cloud():
    for height, width in ((1, 0), (0, 0), (0, 4)):
        message = M.points(STAMP, 'lidar', np.zeros((0, 3)))
        message.height, message.width, message.fields = height, width, []
        assert pointcloud.from_msg(message).points.shape == (0, 3)


@pytest.mark.parametrize(
    ('fields', 'expected'),
    [
        ({'width': 5}, 'expected at least 60 bytes, got 48'),
        ({'height': 0}, 'expected a height of 1 for a row of 4 points, got 0 with 48 bytes'),
        ({'height': 2, 'width': 4, 'row_step': 47}, 'expected at least 96 bytes, got 48'),
        ({'width': -1}, 'of at least 0, got -1, 1, 12, 48'),
        ({'data': np.zeros(0, np.uint8)}, 'expected at least 48 bytes, got 0'),
        ({'point_step': 8}, "field 'z' ends at byte 12: expected at most point_step, got 8"),
    ],
)
def test_contradicting_sizes_are_refused(fields, expected):
    message = M.points(STAMP, 'lidar', XYZ)
    for name, value in fields.items():
        setattr(message, name, value)
    with pytest.raises(UnsupportedMessage, match=expected):
        pointcloud.from_msg(message)


def test_unreadable_fields_are_refused():
    message = M.cloud(STAMP, 'lidar', [('x', 'f4', XYZ[:, 0]), ('range', 'f4', XYZ[:, 1])])
    with pytest.raises(UnsupportedMessage, match='expected fields x, y, z, got x, range'):
        pointcloud.from_msg(message)
    message.fields[1].name = 'intensity'
    with pytest.raises(UnsupportedMessage, match='expected fields x, y, z, got x, intensity'):
        pointcloud.intensities(message)
    message = M.points(STAMP, 'lidar', XYZ)
    message.fields[1].datatype = 12
    with pytest.raises(UnsupportedMessage, match=r"field 'y'.*datatype 12"):
        pointcloud.from_msg(message)
    message.fields[1].datatype, message.fields[1].count = 7, 3
    with pytest.raises(UnsupportedMessage, match=r"field 'y'.*got 3 of datatype 7"):
        pointcloud.from_msg(message)


# Boxes -------------------------------------------------------------------------------------------

RPY = np.array([[0.1, -0.2, 2.5], [0.0, 0.0, -3.0]])
QUATERNIONS = Rotation.from_euler('ZYX', RPY[:, ::-1]).as_quat()
POSITIONS = np.array([[10.0, -2.0, 0.5], [-20.0, 3.0, 1.5]])
SIZES = np.array([[4.5, 1.8, 1.6], [8.0, 2.5, 3.0]])
BOXES = np.hstack([POSITIONS, SIZES, RPY])


def vision_msg(quaternions=QUATERNIONS):
    return M.detections(
        STAMP,
        'lidar',
        [
            ('7', 'car', 0.9, POSITIONS[0], quaternions[0], SIZES[0]),
            ('', 'truck', 0.6, POSITIONS[1], quaternions[1], SIZES[1]),
        ],
    )


def markers_msg():
    cube = ((POSITIONS[0], QUATERNIONS[0]), SIZES[0])
    return M.markers(
        [
            M.marker(STAMP, 'lidar', 0, '', *cube, action=3),
            M.marker(STAMP, 'lidar', 7, 'car', *cube),
            M.marker(STAMP, 'lidar', 7, 'text', *cube, kind=9),
            M.marker(STAMP, 'lidar', 9, 'truck', (POSITIONS[1], QUATERNIONS[1]), SIZES[1]),
            M.marker(STAMP, 'lidar', 8, 'car', *cube, action=2),
        ]
    )


def test_marker_boxes():
    boxes = markers.from_msg(markers_msg())
    assert (boxes.stamp_ns, boxes.frame_id) == (STAMP, 'lidar')
    assert boxes.track_ids == ('7', '9')
    assert boxes.class_names == ('car', 'truck')
    np.testing.assert_allclose(boxes.boxes, BOXES, atol=1e-12)


def test_vision_output_has_the_covariance_and_copies_the_rest():
    message = vision_msg()
    given = vision.from_msg(message)
    covariances = np.arange(72.0).reshape(2, 6, 6)
    out = vision.to_msg(message, given, covariances)
    first = out.detections[0].results
    assert [r.hypothesis.class_id for r in first] == ['unlikely', 'car']
    assert [r.hypothesis.score for r in first] == [0.01, 0.9]
    np.testing.assert_array_equal(first[1].pose.covariance, np.arange(36.0))
    np.testing.assert_array_equal(out.detections[1].results[0].pose.covariance, np.arange(36, 72))
    assert M.store.serialize_cdr(out, DETECTIONS)


def test_marker_output_copies_other_markers():
    message = markers_msg()
    out = markers.to_msg(message, markers.from_msg(message))
    assert [(m.type, m.action) for m in out.markers] == [(1, 3), (1, 0), (9, 0), (1, 0), (1, 2)]
    assert out.markers[1].color.a == 0.5
    assert M.store.serialize_cdr(out, MARKERS)


@pytest.mark.parametrize('bad', [(0, 0, 0, 0), (0, 0, 1, 1), (1e200, 0, 0, 1), (np.nan, 0, 0, 1)])
def test_quaternion_that_is_not_unit_makes_the_box_invalid(bad):
    message = vision_msg([bad, QUATERNIONS[1]])
    boxes = vision.from_msg(message)
    assert np.isnan(boxes.boxes[0, 6:]).all()
    np.testing.assert_array_equal(boxes.boxes[0, :6], BOXES[0, :6])
    np.testing.assert_allclose(boxes.boxes[1], BOXES[1], atol=1e-12)
    out = vision.to_msg(message, boxes).detections[0].bbox.center.orientation
    np.testing.assert_array_equal([out.x, out.y, out.z, out.w], bad)


def test_box_with_non_finite_position_remains_in_the_array():
    message = vision_msg()
    message.detections[0].bbox.center.position.x = float('nan')
    boxes = vision.from_msg(message).boxes
    assert np.isnan(boxes[0, 0])
    assert np.isfinite(boxes[1]).all()


def test_quaternion_within_tolerance_is_normalised():
    boxes = vision.from_msg(vision_msg(QUATERNIONS * 1.001)).boxes
    np.testing.assert_allclose(boxes, BOXES, atol=1e-12)


def test_quaternions_of_boxes_have_positive_w():
    boxes = np.vstack([BOXES, BOXES[0]])
    boxes[2, 7] = np.nan
    quaternions = quaternions_of(boxes)
    assert (quaternions[:2, 3] >= 0).all()
    assert np.isnan(quaternions[2]).all()
    sign = np.sign(QUATERNIONS[:, 3:])
    np.testing.assert_allclose(quaternions[:2], QUATERNIONS * sign, atol=1e-12)


def test_empty_arrays():
    boxes = vision.from_msg(M.detections(STAMP, 'lidar', []))
    assert (boxes.stamp_ns, boxes.frame_id, boxes.boxes.shape) == (STAMP, 'lidar', (0, 9))
    boxes = markers.from_msg(M.markers([]))
    assert (boxes.stamp_ns, boxes.frame_id, boxes.boxes.shape) == (0, '', (0, 9))
    only_delete = M.markers(
        [M.marker(STAMP, 'lidar', 0, '', (POSITIONS[0], QUATERNIONS[0]), SIZES[0], action=3)]
    )
    assert markers.from_msg(only_delete).stamp_ns == STAMP


def test_detection_without_hypothesis():
    message = vision_msg()
    message.detections[0].results = []
    boxes = vision.from_msg(message)
    assert (boxes.class_names[0], boxes.scores[0]) == ('', 1.0)


def test_poses_in_the_hypotheses_alone_are_named():
    message = vision_msg()
    for detection in message.detections:
        for result in detection.results:
            result.pose.pose = detection.bbox.center
        detection.bbox.center = M.pose()
    with pytest.raises(UnsupportedMessage, match=r'got all of them at the origin.*to bbox.center'):
        vision.from_msg(message)


def test_array_without_frame_uses_the_header_of_its_detections():
    message = vision_msg()
    message.header = M.header(0, '')
    boxes = vision.from_msg(message)
    assert (boxes.frame_id, boxes.stamp_ns) == ('lidar', STAMP)


def test_contradicting_headers_are_refused():
    message = markers_msg()
    message.markers[3].header = M.header(STAMP, 'map')
    with pytest.raises(UnsupportedMessage, match=r"one frame and one stamp.*'lidar'.*'map'"):
        markers.from_msg(message)
    message = vision_msg()
    message.detections[1].header = M.header(STAMP, 'map')
    with pytest.raises(UnsupportedMessage, match=r"one frame, got 'lidar' and 'map'"):
        vision.from_msg(message)


def test_the_frame_of_all_detections_comes_before_that_of_the_array():
    message = vision_msg()
    message.header = M.header(STAMP, 'map')
    boxes = vision.from_msg(message)
    assert (boxes.frame_id, boxes.stamp_ns) == ('lidar', STAMP)


def test_fields_of_no_release_of_vision_msgs_are_refused():
    unknown = SimpleNamespace(
        header=M.header(STAMP, 'lidar'),
        detections=[
            SimpleNamespace(
                header=M.header(STAMP, 'lidar'),
                results=[SimpleNamespace(id=3, score=0.5)],
                bbox=vision_msg().detections[0].bbox,
            )
        ],
    )
    with pytest.raises(UnsupportedMessage, match=r"msgs 1 to 4, got.*'id'.*to vision_msgs 4"):
        vision.from_msg(unknown)


def test_adapters_are_found_by_both_spellings_of_the_type():
    assert adapter_for('vision_msgs/msg/Detection3DArray') is vision
    assert adapter_for('vision_msgs/Detection3DArray') is vision
    assert adapter_for('visualization_msgs/MarkerArray') is markers
    for name in ADAPTERS:
        assert callable(adapter_for(name).from_msg)
        assert callable(adapter_for(name).to_msg)
    with pytest.raises(UnsupportedMessage, match=r"'std_msgs/msg/String'.*Detection3DArray"):
        adapter_for('std_msgs/msg/String')


# The same bytes through rclpy and rosbags --------------------------------------------------------


def rclpy_message(name, data):
    pytest.importorskip('rclpy', reason='rclpy is not installed')
    from rclpy.serialization import deserialize_message

    package, _, kind = name.split('/')
    module = pytest.importorskip(f'{package}.msg', reason=f'{package} is not installed')
    return deserialize_message(bytes(data), getattr(module, kind))


def test_rclpy_and_rosbags_read_the_same_cloud():
    message = M.cloud(STAMP, 'lidar', [*columns('f8'), ('t', 'u4', np.arange(4) * 1_000_000)])
    native = rclpy_message(POINTS, M.store.serialize_cdr(message, POINTS))
    assert isinstance(native.data, array.array)
    ours, theirs = pointcloud.from_msg(message), pointcloud.from_msg(native)
    assert (ours.stamp_ns, ours.frame_id) == (theirs.stamp_ns, theirs.frame_id)
    np.testing.assert_array_equal(ours.points, theirs.points)
    np.testing.assert_array_equal(ours.times, theirs.times)
