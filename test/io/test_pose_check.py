"""Conventions of pose and size: conversion by hand, round trips, and the check by points."""

from dataclasses import replace
from itertools import product

from boxreg_ros.errors import ConfigError
from boxreg_ros.io.checks.finding import ADVISED
from boxreg_ros.io.checks.place import PlaceCheck
from boxreg_ros.io.checks.pose import DECISIVE_BOXES, MANY_BOXES, PoseCheck
from boxreg_ros.io.transforms import boxes_to_frame, inverse
from boxreg_ros.structures import BoxArray, KINEMATICS, Sweep
from msg_adapters import adapter_for
from msg_adapters.convention import (
    Convention,
    FORWARD,
    ORIENTATIONS,
    REFERENCES,
    SIZE_ORDERS,
    STANDARD,
)
from msg_adapters.poses import quaternions_of
import numpy as np
import pytest
from ros_messages import DETECTIONS, Messages
from scipy.spatial.transform import Rotation

STAMP = 1_700_000_000_000_000_000
QUARTER = np.pi / 2


def array_of(*boxes, stamp_ns=STAMP):
    n = len(boxes)
    ids = tuple(str(row + 1) for row in range(n))
    return BoxArray(stamp_ns, 'map', ids, ('car',) * n, np.ones(n), np.array(boxes, float))


def rpy_of(*xyzw):
    return Rotation.from_quat(xyzw).as_euler('ZYX')[::-1]


@pytest.mark.parametrize(
    ('settings', 'raw', 'center'),
    [
        # The bottom of an upright box of height 2: its centre is 1 m above.
        ({'pose_reference': 'bottom'}, [5, 6, 0, 4, 2, 2, 0, 0, 0.3],
         [5, 6, 1, 4, 2, 2, 0, 0, 0.3]),
        # Heading along y, pose at the rear of a length of 4: the centre is 2 m further along y.
        ({'pose_reference': 'rear'}, [5, 6, 1, 4, 2, 2, 0, 0, QUARTER],
         [5, 8, 1, 4, 2, 2, 0, 0, QUARTER]),
        # Rear axle on the ground: 0.3 of 4 m and half of 2 m.
        ({'pose_reference': 'rear_axle_bottom'}, [5, 6, 0, 4, 2, 2, 0, 0, 0],
         [6.2, 6, 1, 4, 2, 2, 0, 0, 0]),
        # Custom fractions: a quarter of the length ahead of the centre, half of the width right.
        ({'pose_reference': '0.25,-0.5,0'}, [5, 6, 0, 4, 2, 2, 0, 0, 0],
         [4, 7, 0, 4, 2, 2, 0, 0, 0]),
        # A pitch of a quarter turn takes the box's z to x: half of the height 2.
        ({'pose_reference': 'bottom'}, [5, 6, 0, 4, 2, 2, 0, QUARTER, 0],
         [6, 6, 0, 4, 2, 2, 0, QUARTER, 0]),
        ({'size_order': 'wlh'}, [5, 6, 1, 2, 4, 1.5, 0, 0, 0.3], [5, 6, 1, 4, 2, 1.5, 0, 0, 0.3]),
        ({'size_order': 'hwl'}, [5, 6, 1, 1.5, 2, 4, 0, 0, 0], [5, 6, 1, 4, 2, 1.5, 0, 0, 0]),
        # y points forward: the heading is a quarter turn further than the yaw of the pose.
        ({'forward_axis': 'y+', 'size_order': 'wlh'}, [5, 6, 1, 2, 4, 1.5, 0, 0, 0.3],
         [5, 6, 1, 4, 2, 1.5, 0, 0, 0.3 + QUARTER]),
        ({'size_scale': 2.0}, [5, 6, 1, 2, 1, 0.75, 0, 0, 0.3], [5, 6, 1, 4, 2, 1.5, 0, 0, 0.3]),
        ({'orientation': 'clockwise'}, [5, 6, 1, 4, 2, 1.5, 0.1, 0.2, 0.3],
         [5, 6, 1, 4, 2, 1.5, -0.1, 0.2, -0.3]),
        ({'orientation': 'left_handed'}, [5, 6, 1, 4, 2, 1.5, 0.1, 0.2, 0.3],
         [5, -6, 1, 4, 2, 1.5, -0.1, 0.2, -0.3]),
        # (0, 0, sin, cos) of a yaw, filled in as w x y z, says a half turn about x and a yaw of 0.
        ({'orientation': 'wxyz'}, [5, 6, 1, 4, 2, 1.5, *rpy_of(np.cos(0.15), 0, 0, np.sin(0.15))],
         [5, 6, 1, 4, 2, 1.5, 0, 0, 0.3]),
        ({'forward_axis': 'x-'}, [5, 6, 1, 4, 2, 1.5, 0, 0, -3],
         [5, 6, 1, 4, 2, 1.5, 0, 0, np.pi - 3]),
    ],
)  # fmt: skip
def test_conversion_by_hand(settings, raw, center):
    convention = Convention(**settings)
    np.testing.assert_allclose(convention.to_centers(array_of(raw)).boxes[0], center, atol=1e-12)
    np.testing.assert_allclose(convention.from_centers(array_of(center)).boxes[0], raw, atol=1e-12)


@pytest.mark.parametrize('pose_reference', REFERENCES)
@pytest.mark.parametrize('forward_axis', FORWARD)
def test_conversion_round_trips(pose_reference, forward_axis):
    boxes = array_of([5, 6, 1, 4, 2, 1.5, 0.1, -0.2, 0.3], [5, 6, 1, 4, 2, 1.5, 0, 0, np.nan])
    for order, orientation in product(SIZE_ORDERS, ORIENTATIONS):
        convention = Convention(pose_reference, order, forward_axis, orientation, 2.0)
        converted = convention.from_centers(convention.to_centers(boxes)).boxes
        np.testing.assert_allclose(converted[0], boxes.boxes[0], atol=1e-12)
        np.testing.assert_allclose(converted[1, 3:6], boxes.boxes[1, 3:6])
        assert np.isnan(converted[1, 8])


@pytest.mark.parametrize('orientation', ['xyzw', 'left_handed', 'clockwise'])
@pytest.mark.parametrize('forward_axis', ['x+', 'x-', 'y+', 'y-'])
def test_covariance_is_transformed_to_the_reference_point(forward_axis, orientation):
    """The expected covariance is that of 40,000 random boxes after conversion."""
    convention = Convention('rear_bottom', forward_axis=forward_axis, orientation=orientation)
    box = np.array([5, 6, 1, 4, 2, 1.5, 0.05, -0.1, 2.0])
    given = np.diag([0.1, 0.2, 0.1, 0.02, 0.03, 0.05]) ** 2
    drawn = np.tile(box, (40000, 1))
    pose = [0, 1, 2, 6, 7, 8]
    drawn[:, pose] += np.random.default_rng(0).multivariate_normal(np.zeros(6), given, len(drawn))
    seen = np.cov(convention.from_centers(array_of(*drawn)).boxes[:, pose].T)
    (ours,) = convention.covariances_from_centers(array_of(box), given[None])
    scale = np.sqrt(np.outer(np.diag(seen), np.diag(seen)))
    assert np.abs((ours - seen) / scale).max() < 0.03
    assert np.abs((given - seen) / scale).max() > 0.2  # the conversion changes the covariance


@pytest.mark.parametrize(('orientation', 'side'), [('left_handed', -1), ('clockwise', 1)])
def test_velocities_are_mirrored_with_their_boxes(orientation, side):
    kinematics = np.zeros(1, KINEMATICS)
    kinematics['velocity'] = 3, 2, 1, 0.5
    kinematics['velocity_covariance'][:] = 1.0
    boxes = replace(array_of([5, 6, 1, 4, 2, 2, 0, 0, 0.3]), kinematics=kinematics)
    found = Convention(orientation=orientation).from_centers(boxes).kinematics
    np.testing.assert_array_equal(found['velocity'][0], [3, 2 * side, 1, -0.5])
    np.testing.assert_array_equal(found['velocity_covariance'][0, 0], [1, side, 1, -1])


@pytest.mark.parametrize(
    ('settings', 'expected'),
    [
        ({'pose_reference': 'floor'}, 'pose_reference.*bottom.*floor'),
        ({'pose_reference': '0,1'}, 'pose_reference.*three numbers'),
        ({'pose_reference': '0,1,nan'}, 'pose_reference'),
        ({'size_order': 'lw'}, 'size_order.*wlh'),
        ({'forward_axis': 'z'}, 'forward_axis.*x-'),
        ({'orientation': 'zyxw'}, 'orientation.*wxyz'),
        ({'size_scale': 0.0}, 'size_scale.*positive'),
    ],
)
def test_invalid_conventions_are_refused(settings, expected):
    with pytest.raises(ConfigError, match=expected):
        Convention(**settings)


def test_adapter_of_a_topic_reads_and_writes_its_convention():
    m = Messages()
    found = [('7', 'car', 0.9, (5, 6, 0), (0, 0, 0, 1), (2, 4, 1.5))]
    message = m.detections(STAMP, 'map', found)
    adapter = adapter_for(DETECTIONS, Convention('bottom', 'wlh'))
    boxes = adapter.from_msg(message)
    np.testing.assert_allclose(boxes.boxes, [[5, 6, 0.75, 4, 2, 1.5, 0, 0, 0]])
    out = adapter.to_msg(message, boxes, np.eye(6)[None])
    bbox = out.detections[0].bbox
    assert (bbox.center.position.z, bbox.size.x, bbox.size.y) == (0, 2, 4)
    # The bottom is half of 1.5 m below the centre: a roll of 1 rad moves it by 0.75 m sideways.
    spread = out.detections[0].results[0].pose.covariance.reshape(6, 6)
    assert spread[1, 1] == pytest.approx(1 + 0.75**2)
    assert spread[1, 3] == pytest.approx(0.75)


# Check by points -------------------------------------------------------------------------------


def scene(seed=3, count=16):
    """Return boxes about the origin, and points on their two sides and their top."""
    rng = np.random.default_rng(seed)
    boxes = np.zeros((count, 9))
    boxes[:, 0] = np.repeat([10, 20, 30, 40], count // 4)
    boxes[:, 1] = np.tile([-12, -4, 4, 12], count // 4)
    boxes[:, 2] = 0.8
    boxes[:, 3:6] = rng.uniform([4, 1.7, 1.5], [5, 2.1, 1.7], (count, 3))
    boxes[:, 8] = rng.uniform(-0.3, 0.3, count)
    points = []
    for box in boxes:
        unit = rng.uniform(-0.5, 0.5, (90, 3))
        for axis in range(3):
            side = 0.5 if axis == 2 else -0.5
            unit[axis * 30 : axis * 30 + 30, axis] = side
        points.append(Rotation.from_euler('z', box[8]).apply(unit * box[3:6]) + box[:3])
    ground = np.column_stack([rng.uniform([0, -20], [50, 20], (4000, 2)), np.zeros(4000)])
    return boxes, np.concatenate([*points, ground])


def checked(true, points, taken, meant):
    """Return the finding about boxes written with `meant` and read with `taken`."""
    raw = meant.from_centers(array_of(*true))
    check = PoseCheck(taken)
    for k in range(4):
        sweep = Sweep(STAMP + k * 10**8, 'map', points)
        boxes = taken.to_centers(array_of(*raw.boxes, stamp_ns=sweep.stamp_ns))
        for item in (sweep, boxes) if k % 2 else (boxes, sweep):
            assert not check.finding or k
            check.add(item)
    return check.finding


@pytest.mark.parametrize(
    ('taken', 'meant', 'words'),
    [
        ({}, {}, ()),
        ({'pose_reference': 'bottom'}, {'pose_reference': 'bottom'}, ()),
        ({'size_order': 'wlh'}, {'size_order': 'wlh'}, ()),
        # Centres read as bottoms are half a height too high, and vice versa.
        ({'pose_reference': 'bottom'}, {}, ('hover 0.5 heights above', 'pose_reference:=center')),
        ({}, {'pose_reference': 'bottom'}, ('0.5 heights below', 'pose_reference:=bottom')),
        ({}, {'pose_reference': 'rear'}, ('0.5 lengths behind', '--pose-reference rear')),
        ({}, {'size_order': 'wlh'}, ('size_order:=wlh', '--size-order wlh')),
        # Points give no evidence of the forward direction: both settings that fit are named.
        ({}, {'forward_axis': 'y+'}, ('size_order:=wlh', 'or forward_axis:=y+ or y-')),
        ({'forward_axis': 'y-'}, {}, ('size_order:=wlh', 'or forward_axis:=x+ or x-')),
    ],
)
def test_conventions_that_contradict_the_points_are_reported(taken, meant, words):
    finding = checked(*scene(), Convention(**taken), Convention(**meant))
    assert bool(finding) == bool(words), finding
    for word in words:
        assert word in finding


def checked_classes(meant, names=('car', 'truck')):
    """Return the check of boxes of classes in turn; those of the last are written with `meant`."""
    boxes, points = scene()
    raw = meant.from_centers(array_of(*boxes))
    rows = np.arange(len(boxes)) % len(names)
    given = np.where((rows == len(names) - 1)[:, None], raw.boxes, boxes)
    classes = tuple(names[row] for row in rows)
    check = PoseCheck(STANDARD)
    for k in range(4):
        check.add(Sweep(STAMP + k * 10**8, 'map', points))
        check.add(replace(array_of(*given, stamp_ns=STAMP + k * 10**8), class_names=classes))
    return check


@pytest.mark.parametrize(
    ('meant', 'words'),
    [
        ({}, ()),
        (
            {'pose_reference': 'bottom'},
            (
                "boxes of 'truck' stand 0.5 heights below their points",
                "those of 'car' fit theirs: expected pose_reference 'center' of all classes, got "
                "'bottom' of these",
                'move them by 0.5 heights',
            ),
        ),
        ({'pose_reference': 'top'}, ("boxes of 'truck' hover", 'move them by -0.5 heights')),
        ({'pose_reference': 'rear_bottom'}, ('move them by 0.5 lengths and 0.5 heights',)),
        (
            {'size_order': 'wlh'},
            ("'wlh' of these", 'in the order lwh (or turn them by 90 degrees'),
        ),
        ({'forward_axis': 'y+'}, ("'wlh' of these", 'in the order lwh (or turn them')),
    ],
)
def test_classes_of_another_convention_than_the_others_are_named(meant, words):
    check = checked_classes(Convention(**meant))
    assert check.finding == ''
    assert bool(check.class_finding) == bool(words), check.class_finding
    for word in words:
        assert word in check.class_finding


def test_classes_without_evidence_against_a_convention_take_it():
    """Boxes as long as wide do not show which size is which: the option is right for all."""
    boxes, _ = scene()
    boxes[:, 8] = 0
    boxes[::2, 3:5] = 0.7
    unit = np.random.default_rng(2).uniform(-0.5, 0.5, (16, 60, 3))
    points = (boxes[:, None, :3] + unit * boxes[:, None, 3:6]).reshape(-1, 3)
    names = ('pedestrian', 'truck') * 8
    raw = Convention(size_order='wlh').from_centers(array_of(*boxes))
    check = PoseCheck(STANDARD)
    for k in range(4):
        check.add(Sweep(STAMP + k * 10**8, 'map', points))
        check.add(replace(array_of(*raw.boxes, stamp_ns=STAMP + k * 10**8), class_names=names))
    assert check.class_finding == ''
    assert check.finding.startswith("boxes of 'truck' do not fit their points")
    assert 'set size_order:=wlh' in check.finding


def test_all_classes_of_one_convention_are_not_told_apart():
    boxes, points = scene()
    raw = Convention('bottom').from_centers(array_of(*boxes))
    check = PoseCheck(STANDARD)
    for k in range(4):
        check.add(Sweep(STAMP + k * 10**8, 'map', points))
        names = ('car', 'truck') * 8
        check.add(replace(array_of(*raw.boxes, stamp_ns=STAMP + k * 10**8), class_names=names))
    assert check.class_finding == ''
    assert check.finding.startswith('boxes stand 0.5 heights below their points')


def test_a_class_that_arrives_later_is_checked_and_one_that_is_decided_is_not():
    boxes, points = scene()
    wrong = Convention('bottom').from_centers(array_of(*boxes))
    check = PoseCheck(STANDARD)
    many = -(-MANY_BOXES // len(boxes))
    arrays = [*[array_of(*boxes)] * many, wrong, replace(wrong, class_names=('van',) * 16)]
    findings = []
    for k, array in enumerate(arrays):
        check.add(Sweep(STAMP + k * 10**8, 'map', points))
        check.add(replace(array, stamp_ns=STAMP + k * 10**8))
        findings.append((check.finding, check.class_finding.partition(' stand')[0]))
    assert findings == [*[('', '')] * (many + 1), ('', "boxes of 'van'")]


@pytest.mark.parametrize(('still', 'is_advised'), [(0, None), (4, False), (16, True)])
def test_late_boxes_of_objects_that_move_are_no_poses_at_their_rears(still, is_advised):
    """Of 16 boxes those of moving objects are late, or all at their rears where none moves."""
    boxes, points = scene()
    moves = np.arange(16) >= still
    late = Convention('rear').from_centers(array_of(*boxes)).boxes
    if moves.any():
        late[:still] = boxes[:still]
    nearest = np.linalg.norm(points[:, None, :2] - boxes[:, :2], axis=2).argmin(axis=1)
    check = PoseCheck(STANDARD)
    for k in range(MANY_BOXES // 16 + 2):
        step = [2.0 * k, 0, 0]
        check.add(Sweep(STAMP + k * 10**8, 'map', points + moves[nearest, None] * step))
        check.add(array_of(*late, stamp_ns=STAMP + k * 10**8))
        late[moves, 0] += 2
    assert bool(check.finding) == (is_advised is not False)
    assert bool(ADVISED.search(check.finding)) == bool(is_advised)


def test_noisy_boxes_give_no_finding():
    boxes, points = scene()
    rng = np.random.default_rng(8)
    boxes[:, [0, 1, 2]] += rng.normal(0, 0.3, (len(boxes), 3))
    boxes[:, 8] += rng.normal(0, 0.1, len(boxes))
    assert not checked(boxes, points, STANDARD, STANDARD)


@pytest.mark.parametrize(('place', 'is_found'), [('rear', False), ('bottom', True)])
def test_boxes_of_one_object_show_no_place_along_it(place, is_found):
    boxes, points = scene()
    check = PoseCheck(STANDARD)
    raw = Convention(place).from_centers(array_of(*boxes))
    for k in range(DECISIVE_BOXES):
        check.add(Sweep(STAMP + k * 10**8, 'map', points))
        check.add(array_of(*raw.boxes[:1], stamp_ns=STAMP + k * 10**8))
    assert (f'pose_reference:={place}' in check.finding) == is_found
    assert bool(check.finding) == is_found


@pytest.mark.parametrize('ahead', [-np.inf, 0.1])
def test_one_object_before_its_boxes_gives_no_finding_of_another_kind(ahead):
    boxes, points = scene()
    points = points[points[:, 0] > boxes[0, 0] + ahead]
    front = Convention('front')
    check = PoseCheck(front)
    read = front.to_centers(array_of(boxes[0]))
    for k in range(DECISIVE_BOXES):
        check.add(Sweep(STAMP + k * 10**8, 'map', points))
        check.add(replace(read, stamp_ns=STAMP + k * 10**8))
    assert not check.finding


@pytest.mark.parametrize(('off', 'is_found'), [(6, False), (9, True)])
def test_most_boxes_must_fit_another_convention_better(off, is_found):
    """Of 12 boxes some have their points above them, the others in their upper half."""
    boxes, _ = scene(count=12)
    heights = np.where(np.arange(12) < off, 0.8, 0.25)[:, None, None] * [0, 0, 1]
    unit = np.random.default_rng(1).uniform(-0.15, 0.15, (12, 30, 3)) + heights
    points = boxes[:, None, :3] + unit * boxes[:, None, 3:6]
    check = PoseCheck(STANDARD)
    check.add(Sweep(STAMP, 'map', points.reshape(-1, 3)))
    check.add(array_of(*boxes))
    assert ('pose_reference:=bottom' in check.finding) == is_found


def test_the_check_pairs_equal_stamps_and_ends_after_enough_boxes():
    boxes, points = scene()
    check = PoseCheck(Convention('bottom'))
    wrong = Convention('bottom').to_centers(array_of(*boxes))
    check.add(Sweep(STAMP + 10**8, 'map', points))
    check.add(wrong)
    assert not check.finding  # 0.1 s apart
    check.add(Sweep(STAMP, 'map', points[:0]))
    assert not check.finding  # no points, no evidence
    for k in range(3):
        few = BoxArray(
            STAMP + k, 'map', ('',) * 4, ('',) * 4, np.ones(4), wrong.boxes[4 * k :][:4]
        )
        assert not check.finding
        check.add(few)
        check.add(Sweep(STAMP + k, 'map', points))
    assert DECISIVE_BOXES == 12 and check.finding
    empty = np.full((2, 9), np.nan)
    check = PoseCheck(STANDARD)
    for _ in range(5):
        check.add(array_of(*empty))
        check.add(Sweep(STAMP, 'map', points))
    assert not check.finding
    assert np.isnan(quaternions_of(empty)).all()


# Check of the place ------------------------------------------------------------------------------


def placed(meant=STANDARD, frame='lidar', taken=STANDARD):
    """Return the finding about boxes that are written with `meant`, in a frame of a LiDAR."""
    true, points = scene()
    T_fixed_lidar = np.eye(4)
    T_fixed_lidar[:3, :3] = Rotation.from_euler('z', 0.4).as_matrix()
    T_fixed_lidar[:3, 3] = 3, -5, 0
    check = PlaceCheck(taken)
    for k in range(2):
        given = array_of(*true, stamp_ns=STAMP + k * 10**8)
        if frame == 'lidar':
            given = boxes_to_frame(given, inverse(T_fixed_lidar), 'lidar')
        given = replace(given, frame_id='lidar')  # as the message says, even where it is wrong
        boxes = taken.to_centers(meant.from_centers(given))
        check.add(Sweep(STAMP + k * 10**8, 'map', points), T_fixed_lidar)
        moved = boxes_to_frame(boxes, T_fixed_lidar, 'map')
        check.add(moved, T_fixed_lidar, {'map': np.eye(4)})
    return check.finding


@pytest.mark.parametrize(
    ('option', 'value'),
    [('orientation', 'wxyz'), ('orientation', 'left_handed')],
)
def test_boxes_that_are_tilted_or_mirrored_are_named(option, value):
    meant = Convention(**{option: value})
    text = placed(meant)
    assert f'set {option}:={value}' in text
    assert f'--{option.replace("_", "-")}' in text
    assert ('it is the clouds whose y' in text) == (value == 'left_handed')
    assert placed(meant, taken=meant) == ''


@pytest.mark.parametrize(('turn', 'how'), [(0, 'tilted by'), (np.pi, 'of the boxes lie on')])
def test_w_that_is_taken_to_come_first_by_mistake_is_named(turn, how):
    """On a straight road, in and against the direction of the vehicle."""
    boxes, points = scene()
    boxes[:, 8] = turn + np.linspace(-0.1, 0.1, len(boxes))
    for meant in ('xyzw', 'wxyz'):
        check = PlaceCheck(Convention(orientation='wxyz'))
        raw = Convention(orientation=meant).from_centers(array_of(*boxes))
        for k in range(2):
            check.add(Sweep(STAMP + k * 10**8, 'map', points), np.eye(4))
            read = Convention(orientation='wxyz').to_centers(
                replace(raw, stamp_ns=STAMP + k * 10**8)
            )
            check.add(read, np.eye(4))
        found = check.finding
        assert (how in found and 'set orientation:=xyzw' in found) == (meant == 'xyzw'), found


@pytest.mark.parametrize(('scale', 'how'), [(0.5, 'twice'), (2.0, 'half')])
def test_boxes_half_or_twice_as_large_as_their_objects_are_named(scale, how):
    boxes, points = scene()
    meant = Convention(size_scale=scale)
    text = checked(boxes, points, STANDARD, meant)
    assert f'are about {how} as large as their objects' in text
    assert f'set size_scale:={scale:g} (boxreg relabel: --size-scale {scale:g})' in text
    assert placed(meant) == placed(meant, taken=meant) == ''
    assert checked(boxes, points, meant, meant) == ''


@pytest.mark.parametrize(
    ('factor', 'how'),
    [(0.5, 'half'), (2.0, 'twice'), (0.7, ''), (0.8, ''), (1.0, ''), (1.2, ''), (1.4, '')],
)
@pytest.mark.parametrize('classes', ['truck', 'car truck'])
def test_one_class_of_another_size_is_named_and_the_others_are_not(factor, how, classes):
    boxes, points = scene()
    names = ('car', 'truck') * 8
    boxes[[name in classes for name in names], 3:6] *= factor
    check = PoseCheck(STANDARD)
    for k in range(6):
        check.add(Sweep(STAMP + k * 10**8, 'map', points))
        check.add(replace(array_of(*boxes, stamp_ns=STAMP + k * 10**8), class_names=names))
    text = check.class_finding or check.finding
    assert (f'are about {how} as large as their objects' in text) if how else not text
    if how:
        is_alone = "boxes of 'truck' are" in text and "those of 'car' fit theirs" in text
        assert is_alone == (classes == 'truck')


def test_boxes_without_heights_are_named():
    boxes = np.tile([5.0, 0, 0, 4, 2, 1.5, 0, 0, 0], (100, 1))
    T_map_lidar = np.eye(4)
    T_map_lidar[:3, :3] = Rotation.from_euler('z', 0.4).as_matrix()
    for z, last, is_named in ((0, 0, True), (0, 0.1, False), (-1.2, -1.2, True)):
        boxes[:, 2] = z
        boxes[-1, 2] = last
        check = PlaceCheck(STANDARD)
        check.add(Sweep(STAMP, 'map', np.zeros((3, 3))), T_map_lidar)
        check.add(boxes_to_frame(array_of(*boxes), T_map_lidar, 'map'), T_map_lidar)
        assert (f'all of 100 boxes have z of {z}:' in check.flat) == is_named


def test_boxes_along_the_axes_of_their_frame_are_named():
    boxes = np.tile([5.0, 0, 0, 4, 2, 1.5, 0, 0, 0], (100, 1))
    T_map_lidar = np.eye(4)
    T_map_lidar[:3, :3] = Rotation.from_euler('z', 0.4).as_matrix()
    cases = (0, 0, True), (0, np.pi / 2, True), (0, 0.01, False), (1, 1, False)
    for yaw, last, is_named in cases:
        boxes[:, 8] = yaw
        boxes[-1, 8] = last
        check = PlaceCheck(STANDARD)
        check.add(Sweep(STAMP, 'map', np.zeros((3, 3))), T_map_lidar)
        array = replace(array_of(*boxes), frame_id='lidar')
        check.add(boxes_to_frame(array, T_map_lidar, 'map'), T_map_lidar)
        assert ('all of 100 boxes are along the axes' in check.unturned) == is_named


def test_boxes_of_another_frame_than_their_messages_name_are_named():
    text = placed(frame='map')
    assert 'set boxes_frame:=map (boxreg relabel: --boxes-frame map)' in text
    assert Convention(boxes_frame='map').to_centers(array_of([1] * 9)).frame_id == 'map'


def test_arrays_without_valid_boxes_have_no_place():
    check = PlaceCheck(STANDARD)
    for boxes in ([], [[np.nan] * 9]):
        check.add(Sweep(STAMP, 'map', np.zeros((3, 3))), np.eye(4))
        given = np.reshape(boxes, (-1, 9))
        ids = ('1',) * len(given)
        check.add(BoxArray(STAMP, 'map', ids, ids, np.ones(len(given)), given), np.eye(4))
        assert (check.finding, check.is_open) == ('', True)


@pytest.mark.parametrize('reference', ['center', 'bottom', 'top', 'front', 'rear_axle_bottom'])
def test_boxes_that_another_check_is_for_have_no_other_place(reference):
    assert placed(Convention(reference)) == ''
    assert placed(Convention(size_order='wlh')) == ''
