"""What the node does between its topics: waiting, moving, passing through, starting afresh."""

from boxreg_ros.config import Config
from boxreg_ros.io.transforms import matrix
from boxreg_ros.live.driver import LiveRegistrar, ReceivedMessage, refined_to_frame
from boxreg_ros.structures import BoxArray, KEPT, REFINED, RefinedBoxes
from msg_adapters import adapter_for, pointcloud, vision
from msg_adapters.convention import Convention, STANDARD
import numpy as np
import pytest
from ros_messages import DETECTIONS, Drive, SECOND, START, TRACKED


class Live(LiveRegistrar):
    """Fed from a Drive."""

    def __init__(
        self, fixed_frame='', output_frame='', timeout=1.0, convention=STANDARD, **settings
    ):
        self.told = []
        config = Config(estimate='final').updated({'window': 5, 'lag': 2} | settings)
        super().__init__(
            config, fixed_frame, output_frame, timeout,
            lambda *words: self.told.append(words), convention,
        )  # fmt: skip
        self.adapter = adapter_for(DETECTIONS, convention)
        self.cloud_frame = 'lidar'

    def feed(self, drive, now=0.0):
        """Process all of a drive, as soon as it is ready; return what comes out."""
        out = []
        for topic, _, message in drive.items:
            if topic in ('/tf', '/tf_static'):
                self.tree.add_transforms(message.transforms, topic == '/tf_static')
            elif topic == '/odom':
                self.tree.add_odometry(message)
            else:
                item = arrival(topic, message, now, self.adapter)
                confirmed, ready = self.confirm(item)
                out += ready
                for each in confirmed:
                    assert self.is_ready(each, now + 0.5) or not self.fixed_frame
                    out += self.process(each)
        return out


def arrival(topic, message, now=0.0, adapter=vision):
    reader = pointcloud if topic == '/points' else adapter
    return ReceivedMessage(message, reader.from_msg(message), now)


def items_of(drive, topic):
    return [message for name, _, message in drive.items if name == topic]


def test_every_message_comes_back_early_and_final_in_its_own_frame():
    drive = Drive(sweeps=6)
    live = Live()
    out = live.feed(drive) + live.flush()
    assert live.fixed_frame == 'odom'
    for is_final in (False, True):
        messages = [item.message for item in out if item.is_final == is_final]
        arrays = [vision.from_msg(message) for message in messages]
        assert [array.stamp_ns for array in arrays] == drive.stamps
        for array, message in zip(arrays, items_of(drive, '/boxes'), strict=True):
            given = vision.from_msg(message)
            assert array.frame_id == 'lidar'
            assert array.track_ids == given.track_ids
            assert np.abs(array.boxes - given.boxes).max() < 0.5
    refined = [item for item in out if item.is_final]
    assert all(REFINED in item.refined.status for item in refined)
    assert not live.told


def test_output_frame_is_the_one_asked_for():
    drive = Drive(sweeps=5)
    out = Live(output_frame='odom').feed(drive)
    assert out
    for item in out:
        array = vision.from_msg(item.message)
        assert array.frame_id == item.given.frame_id == item.refined.boxes.frame_id == 'odom'
        assert np.abs(array.boxes[:, :3] - drive.truth[array.stamp_ns][:, :3]).max() < 0.5


def test_kept_boxes_keep_their_covariance_and_refined_ones_get_ours():
    drive = Drive(sweeps=5)
    for message in items_of(drive, '/boxes'):
        for detection in message.detections:
            detection.results[0].pose.covariance = np.diag([9.0, 4, 1, 0, 0, 0]).reshape(36)
        message.detections[1].bbox.center.position.y += 300  # no points there
    out = Live(output_frame='turned').feed(Turned(drive))
    for item in out:
        assert item.refined.status[1] == KEPT
        spread = [d.results[0].pose.covariance.reshape(6, 6) for d in item.message.detections]
        # The output frame is a quarter turn away: the detector's 9 along x is 9 along y.
        np.testing.assert_allclose(np.diag(spread[1]), [4, 9, 1, 0, 0, 0], atol=1e-9)
        if item.refined.status[0] == REFINED:
            np.testing.assert_allclose(spread[0], item.refined.covariances[0])
    assert any(item.refined.status[0] == REFINED for item in out)


class Turned:
    """A drive with a frame that is a quarter turn away from odom."""

    def __init__(self, drive):
        m = drive.messages
        half = np.sqrt(0.5)
        static = m.transform(START, 'turned', 'odom', (0, 0, 0), (0, 0, half, half))
        self.items = [('/tf_static', START, m.tf(static)), *drive.items]


def test_poses_that_do_not_fit_are_told_with_every_array():
    drive = Drive(sweeps=10)
    live = Live(convention=Convention('bottom'))
    live.feed(drive)
    reasons = [reason for reason, *_ in live.told]
    assert reasons == ['pose_reference'] * 5  # known after 12 boxes, six arrays
    assert 'pose_reference:=center' in live.told[0][1]


def test_ids_by_association_are_those_of_the_markers_and_of_the_messages():
    drive = Drive(sweeps=4)
    for message in items_of(drive, '/boxes'):
        for detection in message.detections:
            detection.id = ''
    live = Live(convention=Convention(associate=True))
    out = live.feed(drive) + live.flush()
    for item in out:
        assert item.given.track_ids == item.refined.boxes.track_ids == ('1', '2')
        assert [d.id for d in item.message.detections] == ['1', '2']
    assert live.facts == {'ids': 'by association', 'associated_tracks': 2}


def test_headings_of_unknown_sign_become_those_of_their_track_and_stay_unknown():
    """Of five headings of each object one points backwards, and its twist with it."""
    drive = Drive(sweeps=5, boxes=TRACKED)
    for item in items_of(drive, '/boxes')[1].objects:
        turn = item.kinematics.pose_with_covariance.pose.orientation
        turn.z, turn.w = turn.w, -turn.z
    for message in items_of(drive, '/boxes'):
        for item in message.objects:
            item.kinematics.orientation_availability = 1
    live = Live(window=5)
    live.adapter = adapter_for(TRACKED)
    finals = [item for item in live.feed(drive) + live.flush() if item.is_final]
    assert len(finals) == 5
    for k, item in enumerate(finals):
        assert np.abs(item.refined.boxes.boxes[:, 8]).max() < 0.4
        for given, written in zip(
            items_of(drive, '/boxes')[k].objects, item.message.objects, strict=True
        ):
            assert written.kinematics.orientation_availability == 1
            sign = -1 if k == 1 else 1
            speed = given.kinematics.twist_with_covariance.twist.linear.x
            assert written.kinematics.twist_with_covariance.twist.linear.x == sign * speed


def test_arrivals_wait_until_transforms_cover_them_but_not_for_ever():
    drive = Drive(sweeps=3)
    live = Live(timeout=1.0)
    static, *moving = [m for t, _, m in drive.items if t.startswith('/tf')]
    clouds = [arrival('/points', m, 10.0) for m in items_of(drive, '/points')]
    live.tree.add_transforms(static.transforms, is_static=True)
    assert not live.is_ready(clouds[0], 10.0)
    live.tree.add_transforms(moving[0].transforms)
    live.tree.add_transforms(moving[1].transforms)
    assert not live.is_ready(clouds[1], 10.1)  # a fixed frame is not chosen in a hurry
    assert live.is_ready(clouds[1], 10.5)
    assert live.fixed_frame == 'odom'
    assert not live.is_ready(clouds[2], 10.5)
    assert live.is_ready(clouds[2], 11.0)  # 0.1 s further on a transform can be extrapolated
    assert live.process(clouds[2]) == []
    assert not live.told


def test_final_boxes_come_in_the_order_of_the_input_where_some_pass_through():
    drive = Drive(sweeps=12)
    boxes = items_of(drive, '/boxes')
    for k in (5, 6, 11):
        for item in (boxes[k], *boxes[k].detections):
            item.header.frame_id = 'nowhere'
    live = Live(timeout=0.4)
    out = live.feed(drive)
    (unread,) = live.passed_through('unread')
    out += [unread, *live.flush()]
    for is_final in (False, True):
        messages = [item.message for item in out if item.is_final == is_final]
        assert messages.pop() == 'unread'
        assert [vision.from_msg(message).stamp_ns for message in messages] == drive.stamps
    assert [item.message for item in live.passed_through('free')] == ['free', 'free']


def test_boxes_without_transform_pass_through_with_the_remedy():
    drive = Drive(sweeps=2, motion='none')
    live = Live()
    cloud, boxes = items_of(drive, '/points')[0], items_of(drive, '/boxes')[0]
    assert not live.is_ready(arrival('/points', cloud), 0.9)
    assert live.is_ready(arrival('/points', cloud), 1.0)
    assert live.process(arrival('/points', cloud)) == []
    out = live.process(arrival('/boxes', boxes))
    assert [item.is_final for item in out] == [False, True]
    assert all(item.message is boxes for item in out)
    assert [(reason, number) for reason, _, number in live.told] == [
        ('sweep_without_transform', 1), ('no_transform', 2),
    ]  # fmt: skip
    assert all('fixed_frame:=lidar' in text for _, text, _ in live.told)


def test_a_sensor_that_does_not_move_needs_no_transform():
    live = Live(fixed_frame='lidar')
    out = live.feed(Drive(sweeps=4, motion='none'))
    assert sum(not item.is_final for item in out) == 4
    assert not live.told


def test_arrays_without_boxes_and_stamp_neither_wait_nor_warn():
    drive = Drive(sweeps=2)
    empty, stamped = items_of(drive, '/boxes')
    empty.detections, stamped.detections = [], []
    empty.header.stamp.sec = empty.header.stamp.nanosec = 0
    live = Live()
    assert live.is_ready(arrival('/boxes', empty), 0.0)
    assert not live.is_ready(arrival('/boxes', stamped), 0.0)
    for message in (empty, stamped):
        out = live.process(arrival('/boxes', message))
        assert [item.message for item in out] == [message, message]
    assert not live.told


def test_boxes_before_any_cloud_say_what_is_missing():
    drive = Drive(sweeps=1)
    live = Live()
    live.cloud_frame = ''
    out = live.process(arrival('/boxes', items_of(drive, '/boxes')[0]))
    assert len(out) == 2
    assert 'no point cloud' in live.told[0][1]


def test_after_a_fault_all_that_is_held_passes_through_once():
    drive = Drive(sweeps=6)
    faulty = arrival(*drive.items.pop()[::2])
    live = Live()
    before = live.feed(drive)
    after = live.abandon(faulty)
    for is_final in (False, True):
        stamps = [
            vision.from_msg(item.message).stamp_ns
            for item in before + after
            if item.is_final == is_final
        ]
        assert stamps == drive.stamps
    again = Drive(sweeps=6)
    for _, _, message in again.items:
        for item in getattr(message, 'transforms', [message]):
            item.header.stamp.sec += 5
    assert len(live.feed(again) + live.flush()) == 12


def test_what_was_made_before_a_fault_is_not_lost():
    drive = Drive(sweeps=6)
    live = Live()
    made = [0]

    class Faulty:
        from_msg = staticmethod(vision.from_msg)

        @staticmethod
        def to_msg(message, *given):
            made[0] += 1
            if made[0] == 2:
                raise ZeroDivisionError
            return vision.to_msg(message, *given)

    live.adapter = Faulty
    made[0] = -100
    out = live.feed(drive)
    made[0] = 0  # the second of those that become final at the end fails
    with pytest.raises(ZeroDivisionError):
        live.flush()
    out += live.abandon(None)
    for is_final in (False, True):
        stamps = [
            vision.from_msg(item.message).stamp_ns for item in out if item.is_final == is_final
        ]
        assert stamps == drive.stamps


def moved(drive, seconds, south=0.0):
    """Return a drive, its stamps later, all poses and boxes to the south."""
    for _, _, message in drive.items:
        for item in getattr(message, 'transforms', [message]):
            item.header.stamp.sec += seconds
    for message in items_of(drive, '/tf'):
        message.transforms[0].transform.translation.y -= south
    return drive


@pytest.mark.parametrize('back', [1, 30])
def test_a_recording_that_loops_starts_afresh(back):
    # The same street again, 30 m to the south by its transforms: what was known of these stamps
    # before must not count.
    live = Live(timeout=0.4)
    before = live.feed(moved(Drive(sweeps=20), 60 + back))
    drive = moved(Drive(sweeps=20), 60, south=30.0)
    after = live.feed(drive) + live.flush()
    finals = [item for item in before + after if item.is_final]
    assert len(finals) == 40
    told = [reason for reason, _, _ in live.told]
    assert told == ['time_jump']
    for item in finals[-20:]:
        array = vision.from_msg(item.message)
        stamp_ns = array.stamp_ns - 60 * SECOND
        sensor = np.array([0.5 * drive.stamps.index(stamp_ns), 0, 2.0])
        assert item.refined.status == (REFINED,) * 2
        assert np.abs(array.boxes[:, :3] + sensor - drive.truth[stamp_ns][:, :3]).max() < 0.3


def test_after_a_gap_tracks_begin_anew():
    live = Live()
    live.feed(Drive(sweeps=6))
    out = live.feed(moved(Drive(sweeps=6), 20)) + live.flush()
    assert sum(item.is_final for item in out) == 8  # two were held back by the lag
    assert not live.told
    assert live.counts['short_track'] == 0


def test_a_pause_of_playback_changes_nothing_after_it():
    finals = []
    for is_paused in (False, True):
        live = Live()
        drive = Drive(sweeps=16)
        first, second = Drive(sweeps=16), Drive(sweeps=16)
        limit = drive.stamps[8]
        first.items = [item for item in drive.items if item[1] < limit]
        second.items = [item for item in drive.items if item[1] >= limit]
        out = live.feed(first)
        out += live.flush() if is_paused else []
        out += live.feed(second) + live.flush()
        finals.append([item.refined.boxes.boxes for item in out if item.is_final][8:])
    assert len(finals[0]) == 8
    np.testing.assert_array_equal(*finals)


def test_silence_ends_what_is_held():
    live = Live()
    out = live.feed(Drive(sweeps=6), now=10.0)
    assert not live.is_silent(12.9)
    assert live.is_silent(13.1)
    out += live.flush()
    assert not live.is_silent(99.0) and live.has_ceased(99.0)
    assert sum(item.is_final for item in out) == 6
    assert sum(item.is_final for item in live.feed(moved(Drive(sweeps=6), 1)) + live.flush()) == 6


def test_boxes_of_a_cloud_that_was_dropped_do_not_wait_for_it():
    drive = Drive(sweeps=6)
    drive.items = [i for i in drive.items if (i[0], i[1]) != ('/points', drive.stamps[3])]
    live = Live()
    out = live.lose(drive.stamps[3]) + live.feed(drive) + live.flush()
    kept = [item.refined.reasons for item in out if item.is_final]
    assert kept[3] == ('no_sweep',) * 2
    assert kept[4:] == [('', '')] * 2
    early = [vision.from_msg(item.message).stamp_ns for item in out if not item.is_final]
    assert early == drive.stamps
    # Nothing of it is refined: it comes out as it is, which under load costs nothing.
    given, *others = items_of(drive, '/boxes')[3:]
    assert sum(item.message is given for item in out) == 2
    assert not any(item.message is other for item in out for other in others)


def test_when_the_lidar_stops_boxes_do_not_wait_for_it():
    drive = Drive(sweeps=6)
    late = drive.stamps[3]
    drive.items = [i for i in drive.items if i[0] != '/points' or i[1] <= late]
    live = Live()
    out = live.feed(drive, now=10.0)
    assert not live.lose_overdue(10.6, cloud_received=10.2)
    assert not live.lose_overdue(10.4, cloud_received=0.0)
    out += live.lose_overdue(10.6, cloud_received=10.0)
    assert not live.lose_overdue(10.6, cloud_received=10.0)
    early = [item for item in out if not item.is_final]
    assert [vision.from_msg(item.message).stamp_ns for item in early] == drive.stamps
    assert all(item.received == 10.0 for item in early)
    assert [set(item.refined.reasons) for item in early][4:] == [{'no_sweep'}] * 2


def test_reset_returns_what_is_held_and_keeps_the_transforms():
    drive = Drive(sweeps=6)
    live = Live()
    out = live.feed(drive) + live.reset()
    assert sum(item.is_final for item in out) == 6
    again = [item for item in drive.items if item[0] in ('/points', '/boxes')]
    drive.items = again
    out = live.feed(drive) + live.reset()
    assert sum(item.is_final for item in out) == 6
    assert not live.told


@pytest.mark.parametrize('delay, shuffle', [(0.05, 0), (0.5, 0), (0.5, 3)])
def test_boxes_may_come_late_and_out_of_order(delay, shuffle):
    # 50 to 500 ms behind their clouds; out of order by up to `shuffle` stamps: as long as their
    # clouds are kept, only those that come after younger ones pass unrefined, and are counted.
    drive = Drive(sweeps=20)
    order = np.random.default_rng(0).permutation
    boxes = [i for i in drive.items if i[0] == '/boxes']
    if shuffle:
        boxes = [boxes[k] for a in range(0, 20, 4) for k in a + order(4)]
    rank = {id(i[2]): START + round((0.1 * k + delay) * SECOND) for k, i in enumerate(boxes)}
    drive.items.sort(key=lambda i: rank.get(id(i[2]), i[1]))
    live = Live()
    out = live.feed(drive) + live.flush()
    finals = [item for item in out if item.is_final]
    assert sorted(vision.from_msg(item.message).stamp_ns for item in finals) == drive.stamps
    late = live.counts['late']
    assert (late > 0) == bool(shuffle)
    assert live.counts['refined'] + live.counts['kept'] == 40
    assert live.counts['kept'] == late + live.counts['short_track']
    assert live.counts['no_sweep'] == 0


def test_boxes_of_one_stamp_come_back_each_in_its_own_message():
    drive = Drive(sweeps=4)
    boxes = items_of(drive, '/boxes')
    boxes[2].header.stamp = boxes[1].header.stamp
    live = Live()
    out = live.feed(drive) + live.flush()
    for is_final in (False, True):
        assert sum(item.is_final == is_final for item in out) == 4
    assert live.counts['duplicate_stamp'] == 2


@pytest.mark.parametrize('yaw', [0.0, 0.7, 2.5])
def test_covariances_turn_with_the_frame(yaw):
    stamp = START + SECOND
    spread = np.diag([4.0, 1.0, 0.25, 0.1, 0.2, 0.3])  # along x
    boxes = BoxArray(
        stamp, 'a', ('1',), ('car',), np.ones(1), np.array([[1.0, 2, 3, 4, 2, 1, 0, 0, 0]])
    )
    refined = RefinedBoxes(boxes, (KEPT,), ('',), np.zeros(1, int), spread[None])
    T = matrix(np.array([5.0, 0, 0, 0, 0, np.sin(yaw / 2), np.cos(yaw / 2)]))
    moved = refined_to_frame(refined, T, 'b')
    assert moved.boxes.frame_id == 'b'
    (covariance,) = moved.covariances
    along = np.array([np.cos(yaw), np.sin(yaw), 0])
    across = np.array([-np.sin(yaw), np.cos(yaw), 0])
    assert along @ covariance[:3, :3] @ along == pytest.approx(4.0)
    assert across @ covariance[:3, :3] @ across == pytest.approx(1.0)
    assert covariance[3:, 3:] == pytest.approx(spread[3:, 3:])
