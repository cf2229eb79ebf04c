"""The session that the live node and `boxreg relabel` share: transforms, ids, time jumps."""

from dataclasses import replace

from boxreg_ros.config import Config
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.errors import TransformUnavailable
from boxreg_ros.io.items import Item
from boxreg_ros.io.session import hand_to_registrar, is_placeholder, Session
from boxreg_ros.io.time_jumps import Confirmed, JumpConfirmation
from boxreg_ros.offline.progress import Stopwatch
from boxreg_ros.offline.reader import RecordingReader
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.sources import source_of
from boxreg_ros.structures import BoxArray, Sweep
from msg_adapters import adapter_for, pointcloud
from msg_adapters.convention import Convention, STANDARD
import numpy as np
import pytest
from ros_messages import DETECTIONS, Drive, SECOND, START, write_recording

ASSOCIATE = Convention(associate=True)


def array_of(stamp_ns, x=5.0, frame_id='map'):
    """Return one box of a car."""
    box = np.array([[x, 0, 0.8, 4.5, 1.9, 1.6, 0, 0, 0]])
    return BoxArray(stamp_ns, frame_id, ('?',), ('car',), np.ones(1), box)


def contents(drive, convention=STANDARD):
    """Return all clouds and boxes of a drive, and its transforms."""
    adapter = adapter_for(DETECTIONS, convention)
    readers = {'/points': pointcloud, '/boxes': adapter}
    items = [
        readers[topic].from_msg(message) for topic, _, message in drive.items if topic in readers
    ]
    transforms = [
        (message.transforms, topic == '/tf_static')
        for topic, _, message in drive.items
        if topic.startswith('/tf')
    ]
    return items, transforms


def test_items_are_moved_into_the_fixed_frame_with_their_transform():
    drive = Drive(sweeps=3)
    items, transforms = contents(drive)
    session = Session(STANDARD, Config(), '/odom')
    for transform in transforms:
        session.tree.add_transforms(*transform)
    for item in items:
        admitted = session.admit(Item(0, item))
        T = session.tree.lookup('odom', 'lidar', item.stamp_ns)
        np.testing.assert_array_equal(admitted.T_fixed_item, T)
        assert admitted.moved.frame_id == 'odom'
        assert (admitted.reason, admitted.detail) == (None, '')
        if isinstance(item, Sweep):
            np.testing.assert_allclose(admitted.moved.origin, T[:3, 3])
        else:
            expected = item.boxes[:, :3] @ T[:3, :3].T + T[:3, 3]
            np.testing.assert_allclose(admitted.moved.boxes[:, :3], expected)


@pytest.mark.parametrize('fixed_frame', ['', 'odom'])
def test_odometry_without_a_child_frame_is_that_of_the_vehicle_from_the_next_one_on(fixed_frame):
    drive = Drive(sweeps=4, motion='odometry')
    session = Session(STANDARD, Config(), fixed_frame)
    session.sensor_frame = 'lidar'
    reasons = []
    for topic, _, message in drive.items:
        if topic == '/odom':
            message.child_frame_id = ''
            session.tree.add_odometry(message)
        elif topic == '/tf_static':
            session.tree.add_transforms(message.transforms, is_static=True)
        elif topic == '/points':
            reasons.append(session.admit(Item(0, pointcloud.from_msg(message))).reason)
    assert reasons == ['sweep_without_transform', None, None, None]
    assert session.tree.odometry_child == 'base'
    assert 'odometry: expected the frame of the vehicle in child_frame_id' in session.finding


def test_odometry_without_a_child_frame_is_that_of_the_vehicle_where_static_transforms_are_late():
    drive = Drive(sweeps=6, motion='odometry')
    session = Session(STANDARD, Config())
    session.sensor_frame = 'lidar'
    (static,) = [message for topic, _, message in drive.items if topic == '/tf_static']
    heights = []
    for topic, _, message in drive.items:
        if topic == '/odom':
            message.child_frame_id = ''
            session.tree.add_odometry(message)
        elif topic == '/points':
            item = session.admit(Item(0, pointcloud.from_msg(message)))
            heights.append(None if item.reason else item.T_fixed_item[2, 3])
            if len(heights) == 2:
                session.tree.add_transforms(static.transforms, is_static=True)
    assert heights[0] is None
    assert heights[-1] == heights[3] == static.transforms[0].transform.translation.z
    assert "taken for 'base'" in session.finding


def test_boxes_in_the_fixed_frame_keep_their_numbers_and_get_the_ticket():
    boxes = array_of(START)
    boxes.boxes[0, 6:] = 0.1, -0.2, 2.9
    session = Session(STANDARD, Config(), 'map')
    ticket = object()
    moved = session.admit(Item(0, boxes), ticket).moved
    np.testing.assert_array_equal(moved.boxes, boxes.boxes)
    assert moved.ticket is ticket


def test_items_without_transform_have_a_reason():
    drive = Drive(sweeps=1, motion='none')
    items, _ = contents(drive)
    session = Session(STANDARD, Config(), 'odom')
    admitted = [session.admit(Item(0, item)) for item in items]
    assert [a.reason for a in admitted] == ['sweep_without_transform', 'no_transform']
    assert all(a.moved is None and "'odom'" in a.detail for a in admitted)


def test_fixed_frame_is_chosen_when_the_motion_of_the_clouds_is_known():
    drive = Drive(sweeps=2)
    items, transforms = contents(drive)
    session = Session(STANDARD, Config())
    with pytest.raises(TransformUnavailable, match='no point cloud has arrived'):
        session.require_fixed_frame(items[1])
    session.sensor_frame = 'lidar'
    with pytest.raises(TransformUnavailable, match='fixed_frame:=lidar'):
        session.require_fixed_frame(items[1])
    for transform in transforms:
        session.tree.add_transforms(*transform)
    assert session.require_fixed_frame(items[1]) == session.fixed_frame == 'odom'


def test_ids_are_assigned_only_if_asked_for():
    boxes = array_of(START)
    session = Session(STANDARD, Config(), 'map')
    assert session.admit(Item(0, boxes)).moved.track_ids == ('?',)
    assert session.facts == {'ids': 'of the input'}
    session = Session(ASSOCIATE, Config(), 'map')
    assert session.admit(Item(0, boxes)).moved.track_ids == ('1',)
    assert session.facts == {'ids': 'by association', 'associated_tracks': 1}


def test_a_restart_assigns_new_ids_and_max_gap_may_change():
    session = Session(ASSOCIATE, Config(max_gap=0.5), 'map')
    first, later = array_of(START), array_of(START + 8 * SECOND // 10)
    assert session.admit(Item(0, first)).moved.track_ids == ('1',)
    session.config = Config(max_gap=1.0)
    assert session.admit(Item(0, later)).moved.track_ids == ('1',)
    session.config = Config(max_gap=0.5)
    session.restart()
    assert session.admit(Item(0, first)).moved.track_ids == ('2',)
    assert session.admit(Item(0, later)).moved.track_ids == ('3',)


def sweep_at(seconds):
    return Sweep(round(seconds * SECOND), 'lidar', np.zeros((0, 3)))


def boxes_at(seconds):
    return array_of(round(seconds * SECOND))


@pytest.fixture
def jumps():
    """Return a confirmation that has seen sweeps and boxes of 10 Hz up to 100 s."""
    jumps = JumpConfirmation()
    for seconds in (99.9, 100):
        for content in (sweep_at(seconds), boxes_at(seconds)):
            assert jumps.add('item', content) == Confirmed(['item'])
    return jumps


@pytest.mark.parametrize(
    'kinds', [(sweep_at, boxes_at), (boxes_at, sweep_at), (sweep_at, sweep_at)]
)
def test_two_old_stamps_in_a_row_are_a_time_jump(jumps, kinds):
    first, second = (make(5 + 0.1 * k) for k, make in enumerate(kinds))
    assert jumps.add('first', first) == Confirmed()
    assert jumps.add('second', second) == Confirmed(['first', 'second'], has_jumped=True)
    for content in (sweep_at(5.2), boxes_at(5.2)):
        assert jumps.add('next', content) == Confirmed(['next'])


def test_a_single_old_stamp_is_late_and_keeps_its_order(jumps):
    assert jumps.add('late', boxes_at(5)) == Confirmed()
    assert [held.item for held in jumps.held] == ['late']
    assert jumps.add('cloud', sweep_at(100.1)) == Confirmed(['cloud'])
    assert jumps.add('following', boxes_at(100.1)) == Confirmed(['late', 'following'])
    assert jumps.held == []


def test_clouds_in_time_do_not_keep_old_boxes_from_being_a_time_jump(jumps):
    """One stream alone went back: two of its stamps in a row."""
    assert jumps.add('first', boxes_at(5)) == Confirmed()
    assert jumps.add('cloud', sweep_at(100.1)) == Confirmed(['cloud'])
    assert jumps.add('second', boxes_at(5.1)) == Confirmed(['first', 'second'], has_jumped=True)


def test_a_late_item_can_be_released_without_another(jumps):
    jumps.add('late', boxes_at(5))
    assert jumps.release() == ['late']
    assert jumps.release() == []


def test_stamps_more_than_a_second_old_are_held(jumps):
    assert jumps.add('item', boxes_at(99.1)) == Confirmed(['item'])
    assert jumps.add('item', boxes_at(98.9)) == Confirmed()


@pytest.mark.parametrize('ahead', [2.2, 60, 3600])
@pytest.mark.parametrize('make', [sweep_at, boxes_at])
def test_a_single_stamp_ahead_is_not_used_and_holds_no_other(jumps, make, ahead):
    assert jumps.add('wrong', make(100 + ahead)) == Confirmed()
    others = [one for one in (sweep_at, boxes_at) if one is not make]
    assert jumps.add('other', others[0](100.1)) == Confirmed(['other'])
    assert jumps.add('next', make(100.1)) == Confirmed(['next'], ahead=['wrong'])
    for seconds in (100.2, 100.3):
        for content in (sweep_at(seconds), boxes_at(seconds)):
            assert jumps.add('later', content) == Confirmed(['later'])


@pytest.mark.parametrize('kinds', [(sweep_at, boxes_at), (boxes_at, boxes_at)])
def test_two_stamps_ahead_are_a_gap(jumps, kinds):
    first, second = (make(3700 + 0.1 * k) for k, make in enumerate(kinds))
    assert jumps.add('first', first) == Confirmed()
    assert jumps.add('second', second) == Confirmed(['first', 'second'])
    for content in (sweep_at(3700.2), boxes_at(3700.2)):
        assert jumps.add('next', content) == Confirmed(['next'])


def test_a_pause_and_a_long_period_are_not_ahead():
    jumps = JumpConfirmation()
    for seconds in (0, 0.1, 60):  # received as late as it is stamped
        item = Confirmed(['item'])
        assert jumps.add('item', boxes_at(seconds), round(seconds * SECOND)) == item
    jumps = JumpConfirmation()
    for seconds in (0, 2, 4, 10):  # of keyframes, received at once
        assert jumps.add('item', boxes_at(seconds), 0) == Confirmed(['item'])


def test_a_restart_forgets_stamps_and_what_is_held(jumps):
    jumps.add('wrong', boxes_at(3700))
    jumps.restart()
    assert jumps.held == []
    assert jumps.add('item', boxes_at(5)) == Confirmed(['item'])


def test_an_array_without_boxes_stamp_and_frame_is_a_placeholder():
    session = Session(ASSOCIATE, Config(), 'map')
    empty = np.zeros((0, 9))
    placeholder = BoxArray(0, '', (), (), np.zeros(0), empty)
    assert is_placeholder(placeholder)
    for _ in range(3):
        item = Item(0, placeholder)
        assert session.admit(item) is item
    assert not is_placeholder(replace(placeholder, stamp_ns=START, frame_id='map'))


@pytest.mark.parametrize('later', [86_400.0, 101.3])
def test_the_pose_check_is_renewed_after_a_time_jump(tmp_path, later):
    """
    A finding about the boxes before the jump does not apply to those after it.

    Also where the transforms after it are read ahead, and those before it are forgotten.
    """
    wrong, right = Drive(sweeps=12, start=START + 100 * SECOND), Drive(sweeps=12)
    for _, _, message in wrong.items:
        for detection in getattr(message, 'detections', []):
            detection.bbox.center.position.z -= detection.bbox.size.z / 2
    later_ns = round(later * SECOND)
    again = [(topic, at + later_ns, message) for topic, at, message in right.items]
    path = write_recording(tmp_path / 'drive', [*wrong.items, *again])
    findings = list(findings_of(path))
    jumps = [k for k, (restarts, _) in enumerate(findings) if restarts]
    assert len(jumps) == 1
    assert 'pose_reference' in findings[jumps[0] - 1][1]
    assert not any(finding for _, finding in findings[jumps[0] :])


def test_a_class_that_is_turned_is_named_rather_than_the_axes_of_all():
    """Only trucks move, along y of their boxes; parked cars show that the others are right."""
    session = Session(STANDARD, Config(), 'map')
    rng = np.random.default_rng(4)
    unit = rng.uniform(-0.5, 0.5, (8, 80, 3))
    true = np.tile([0, 0, 1, 6.0, 2, 2, 0, 0, 0], (8, 1))
    true[:, 1] = 8 * np.arange(8)
    for k in range(20):
        true[4:, 0] = k
        points = (true[:, None, :3] + unit * true[:, None, 3:6]).reshape(-1, 3)
        stamp = START + k * SECOND // 10
        boxes = true.copy()
        boxes[4:, 8] = np.pi / 2
        classes = ('car',) * 4 + ('truck',) * 4
        ids = tuple('12345678')
        session.admit(Item(0, Sweep(stamp, 'map', points)))
        session.admit(Item(0, BoxArray(stamp, 'map', ids, classes, np.ones(8), boxes)))
    assert "boxes of 'truck' do not fit their points" in session.finding
    assert 'or turn them by 90 degrees' in session.finding
    assert 'forward_axis' not in session.finding


@pytest.mark.parametrize('trusts_ids', [False, True])
def test_ways_from_object_to_object_say_nothing_about_yaw(trusts_ids):
    """Cars and vans are counted by a tracker each, and are the first of a message by turns."""
    session = Session(STANDARD, Config(), 'map')
    session.trusts_ids = trusts_ids
    true = np.tile([0, 0, 1, 4.5, 2, 2, 0, 0, 0], (20, 1))
    true[:, 1] = np.tile(9 * np.arange(10), 2)
    true[10:, 1] += 3
    classes = np.repeat(['car', 'van'], 10)
    ids = np.tile(np.arange(1, 11).astype(str), 2)
    for k in range(40):
        true[:, 0] = 0.1 * k
        true[10:, 0] += 3  # vans are ahead, in the lane beside
        rows = np.roll(np.arange(20), 10 * (k % 2))
        boxes = BoxArray(
            START + k * SECOND // 10, 'map', tuple(ids[rows]), tuple(classes[rows]), np.ones(20),
            true[rows],
        )  # fmt: skip
        session.admit(Item(0, boxes))
    assert ('track id of another box' in session.finding) != trusts_ids
    assert ('yaw of the boxes' in session.finding) == trusts_ids


def test_boxes_of_a_recording_stamped_in_the_future_are_kept_and_said(tmp_path):
    drive = Drive(sweeps=12)
    arrays = [message for topic, _, message in drive.items if topic == '/boxes']
    arrays[5].header.stamp.sec += 3600
    path = write_recording(tmp_path / 'drive', drive.items)
    request = Request((path,))
    with source_of(request) as recording:
        reading = RecordingReader(recording, request, Stopwatch())
        items = list(reading)
        warning = reading.findings().warning
    unused = [item for item in items if item.reason]
    assert [(item.moved, item.reason) for item in unused] == [(None, 'stamp_ahead')]
    assert unused[0].content.stamp_ns == drive.stamps[5] + 3600 * SECOND
    assert sum(isinstance(item.moved, BoxArray) for item in items) == 11
    assert 'stamp_ahead (1 messages, first: boxes at' in warning


def findings_of(path):
    request = Request((path,))
    with source_of(request) as recording:
        reading = RecordingReader(recording, request, Stopwatch())
        for item in reading:
            yield item.restarts, reading.findings().warning


def test_register_flushes_and_resets_at_a_time_jump():
    registrar = BoxRegistrar(Config(estimate='final'))
    sweep = Sweep(START, 'map', np.zeros((0, 3)))
    assert hand_to_registrar(registrar, sweep, restarts=False) == []
    assert len(hand_to_registrar(registrar, array_of(START), restarts=False)) == 1  # early
    earlier = START - 60 * SECOND
    ready = hand_to_registrar(registrar, array_of(earlier), restarts=True)
    assert [(r.boxes.stamp_ns, r.is_final) for r in ready] == [(START, True)]
    ready = hand_to_registrar(registrar, replace(sweep, stamp_ns=earlier), restarts=False)
    assert [r.reasons for r in ready] != [('late',)]
    assert hand_to_registrar(registrar, None, restarts=True)[-1].boxes.stamp_ns == earlier


def objects_of(kind, count, apart, second=None, seed=0):
    """Return boxes of objects in a row, and of a second detector with ids of its own."""
    size = {'car': (4.5, 1.9, 1.6), 'pedestrian': (0.7, 0.6, 1.7), 'bicycle': (1.8, 0.6, 1.6)}
    rng = np.random.default_rng(seed)
    found = []
    for name, prefix in ((kind, 'a'), *([(second, 'b')] if second else ())):
        boxes = np.zeros((count, 9))
        boxes[:, 0] = apart * np.arange(count)
        boxes[:, 3:6] = size[name]
        boxes[:, :2] += rng.normal(0, 0.06, (count, 2))
        found += [(f'{prefix}{k}', name, box) for k, box in enumerate(boxes)]
    return found


@pytest.mark.parametrize(
    ('kind', 'apart', 'second', 'is_named'),
    [
        ('car', 6.0, 'car', True),
        ('pedestrian', 2.0, 'pedestrian', True),
        ('car', 4.7, None, False),  # parked bumper to bumper
        ('pedestrian', 0.6, None, False),  # a group
        ('bicycle', 3.0, 'pedestrian', False),  # riders
    ],
)
@pytest.mark.parametrize('messages', [1, 2])
def test_objects_with_two_boxes_are_named(kind, apart, second, is_named, messages):
    session = Session(STANDARD, Config(), 'map')
    for k in range(12):
        rows = objects_of(kind, 6, apart, second, seed=k)
        for part in range(messages):
            ids, names, boxes = zip(*rows[part::messages], strict=True)
            array = BoxArray(START + k * SECOND // 10, 'map', ids, names, np.ones(len(ids)), boxes)
            session.admit(Item(0, array))
    assert ('boxes: expected one for each object' in session.finding) == is_named
    assert [one.reason for one in session.findings] == ['objects_twice'] * is_named


@pytest.mark.parametrize(
    ('changes', 'is_named'),
    [
        ([k % 2 == 0 for k in range(30)], True),  # 5 Hz, published at 10 Hz
        ([True] * 30, False),
        ([k % 30 < 8 for k in range(90)], False),  # all objects of a drive stop, three times
    ],
)
@pytest.mark.parametrize('has_parked', [False, True])
def test_boxes_that_are_published_again_later_are_named(changes, is_named, has_parked):
    session = Session(STANDARD, Config(), 'map')
    for k, number in enumerate(np.cumsum(changes)):
        ids, names, boxes = zip(*objects_of('car', 6, 20.0, seed=number), strict=True)
        if has_parked:  # a car whose box is always the same, as if it were rounded
            boxes[0][:] = objects_of('car', 1, 20.0)[0][2]
        array = BoxArray(START + k * SECOND // 10, 'map', ids, names, np.ones(len(ids)), boxes)
        session.admit(Item(0, array))
    is_found = is_named and not has_parked
    assert ('those of the one before' in session.finding) == is_found
    assert [one.reason for one in session.findings] == ['boxes_repeated'] * is_found
