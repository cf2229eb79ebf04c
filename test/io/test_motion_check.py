"""Motion of the sensors that is wrong without a word: clocks, jumps, publishers of TF."""

from copy import deepcopy

from boxreg_ros.config import Config
from boxreg_ros.errors import RecordingError
from boxreg_ros.io.fixed_frame import FixedFrameItems
from boxreg_ros.io.lidars import Lidars
from boxreg_ros.io.recording import Recording
from boxreg_ros.structures import Sweep
from msg_adapters.convention import Convention, STANDARD
import numpy as np
import pytest
from ros_messages import Drive, SECOND, START, write_recording


def read(drive, tmp_path, fixed_frame=None, convention=STANDARD, **options):
    """Return positions of the sensor by stamp, the fixed frame and all findings of a drive."""
    path = drive.write(tmp_path / 'drive')
    with Recording([path], convention=convention, **options) as recording:
        items = FixedFrameItems(recording, Config(), convention, fixed_frame)
        moved = [item.moved for item in items.read()]
        found = '; '.join(filter(None, (recording.finding, items.session.finding)))
    origins = {one.stamp_ns: one.origin for one in moved if isinstance(one, Sweep)}
    return origins, items.fixed_frame, found


def true_origins(sweeps):
    return {START + k * SECOND // 10: [0.5 * k, 0.0, 2.0] for k in range(sweeps)}


def assert_true(origins, sweeps, atol=1e-9):
    true = true_origins(sweeps)
    assert origins.keys() == true.keys()
    for stamp, origin in origins.items():
        np.testing.assert_allclose(origin, true[stamp], atol=atol)


def in_namespace(drive, space, topics=('/tf', '/tf_static', '/points', '/boxes')):
    """Move topics of a drive into a namespace."""
    drive.items = [(space + t if t in topics else t, *rest) for t, *rest in drive.items]


def robots(sweeps, numbers, space='/r{}', shift=20.0):
    """Return a drive of the first robot, and with it the transforms of others, 30 ms later."""
    drive = Drive(sweeps=sweeps)
    in_namespace(drive, space.format(1))
    m = drive.messages
    for number in numbers:
        for k in range(sweeps):
            stamp = START + k * SECOND // 10 + 30_000_000
            message = m.tf(m.transform(stamp, 'odom', 'base', (shift * number + 0.5 * k, 0, 0)))
            drive.items.append((f'{space.format(number)}/tf', stamp, message))
    return drive


@pytest.mark.parametrize('numbers', [[2], [2, 3]])
@pytest.mark.parametrize('space', ['/r{}', '/fleet/r{}'])
def test_transforms_are_those_of_the_namespace_of_the_clouds(tmp_path, numbers, space):
    origins, frame, found = read(robots(8, numbers, space), tmp_path)
    assert_true(origins, 8)
    assert frame == 'odom'
    assert f'those of {space.format(1)}/tf, in the namespace of the clouds' in found
    assert all(f'{space.format(number)}/tf' in found for number in numbers)


def test_robots_that_stand_at_first_are_kept_apart_too(tmp_path):
    drive = robots(8, [2], shift=0.0)
    for topic, _, message in drive.items:
        if topic.endswith('/tf'):
            message.transforms[0].transform.translation.x = 0.0
    _, _, found = read(drive, tmp_path)
    assert 'without /r2/tf' in found


def test_clouds_without_a_namespace_need_a_choice_between_two_robots(tmp_path):
    drive = robots(8, [2])
    drive.items = [(t.replace('/r1/points', '/points'), *rest) for t, *rest in drive.items]
    with pytest.raises(RecordingError, match='--tf /r1/tf or --tf /r2/tf'):
        read(drive, tmp_path)
    origins, _, found = read(drive, tmp_path / 'asked', tf=['/r1/tf'])
    assert_true(origins, 8)
    assert not found
    with pytest.raises(RecordingError, match="no topic '/r3/tf'; topics with transforms"):
        read(drive, tmp_path / 'wrong', tf=['/r3/tf'])


def test_a_copy_of_tf_and_frames_with_prefixes_are_no_second_robot(tmp_path):
    drive = Drive(sweeps=8)
    m = drive.messages
    for topic, received, message in list(drive.items):
        if topic == '/tf':
            drive.items.append(('/relay/tf', received, deepcopy(message)))
            stamp = received + 1
            other = m.tf(m.transform(stamp, '/r2/odom', '/r2/base', (20, 0, 0)))
            drive.items.append(('/r2/tf', stamp, other))
    origins, _, found = read(drive, tmp_path)
    assert_true(origins, 8)
    assert not found


@pytest.mark.parametrize('prefixed', ['clouds', 'boxes', 'transforms', 'odometry'])
def test_frames_that_differ_by_a_prefix_are_taken_for_one_and_named(tmp_path, prefixed):
    drive = Drive(sweeps=8, motion='odometry' if prefixed == 'odometry' else 'tf')
    topics = {
        'clouds': ('/points', '/boxes'), 'boxes': ('/boxes',), 'transforms': ('/tf', '/tf_static'),
        'odometry': ('/odom',),
    }  # fmt: skip
    for topic, _, message in drive.items:
        if topic not in topics[prefixed]:
            continue
        stamped = getattr(message, 'transforms', [message])
        for one in (*stamped, *getattr(message, 'detections', [])):
            one.header.frame_id = f'r1/{one.header.frame_id}'
            if hasattr(one, 'child_frame_id'):
                one.child_frame_id = f'r1/{one.child_frame_id}'
    origins, fixed_frame, found = read(drive, tmp_path)
    assert_true(origins, 8)
    assert fixed_frame == ('r1/odom' if prefixed in ('transforms', 'odometry') else 'odom')
    name = 'base' if prefixed == 'odometry' else 'lidar'
    assert f"'r1/{name}' and '{name}'; each pair is taken for one frame" in found


def test_a_frame_of_one_of_two_prefixes_needs_a_choice(tmp_path):
    drive = Drive(sweeps=8)
    m = drive.messages
    moving = [received for topic, received, _ in drive.items if topic == '/tf']
    drive.items = [item for item in drive.items if item[0] not in ('/tf', '/tf_static')]
    for k, stamp in enumerate(moving):
        poses = [('r1', 0.5 * k), ('r2', 20)]
        stated = [m.transform(stamp, f'{r}/odom', f'{r}/lidar', (x, 0, 2)) for r, x in poses]
        drive.items.insert(0, ('/tf', stamp, m.tf(*stated)))
    with pytest.raises(RecordingError, match='--fixed-frame r1/odom or r2/odom'):
        read(drive, tmp_path)
    origins, _, found = read(drive, tmp_path / 'asked', fixed_frame='r1/odom')
    assert_true(origins, 8)
    assert "'r1/lidar' and 'lidar'" in found


def test_odometry_without_a_child_frame_is_that_of_the_vehicle(tmp_path):
    drive = Drive(sweeps=8, motion='odometry')
    for number in range(8):
        drive.replace('/odom', number, lambda message: setattr(message, 'child_frame_id', ''))
    origins, _, found = read(drive, tmp_path)
    assert_true(origins, 8)
    assert '/odom: expected the frame of the vehicle in child_frame_id, got none' in found
    assert "'base'" in found


def test_microseconds_in_nanosec_are_named(tmp_path):
    drive = Drive(sweeps=12)
    for topic, _, message in drive.items:
        if topic in ('/points', '/boxes'):
            for one in (message, *getattr(message, 'detections', [])):
                one.header.stamp.nanosec //= 1000
    found = read(drive, tmp_path)[2]
    assert 'got all of 10 in the first millisecond of a second' in found
    assert 'multiply nanosec by 1000' in found
    assert 'nanosec' not in read(Drive(sweeps=12), tmp_path / 'right')[2]


def test_odometry_is_that_of_the_namespace_of_the_clouds(tmp_path):
    drive = Drive(sweeps=8, motion='odometry')
    m = drive.messages
    in_namespace(drive, '/r1', ('/odom', '/points', '/boxes'))
    for k in range(8):
        stamp = START + k * SECOND // 10
        drive.items.append(('/r2/odom', stamp, m.odometry(stamp, 'odom', 'base', (20, 0, 0))))
    origins, _, found = read(drive, tmp_path)
    assert_true(origins, 8)
    assert 'odometry is that of /r1/odom' in found
    assert '/r2/odom' in found


def stamps_moved(drive, topics, seconds):
    """Add an offset to the stamps in the headers on some topics."""
    for topic, _, message in drive.items:
        if topic not in topics:
            continue
        stamped = getattr(message, 'transforms', [message])
        for one in (*stamped, *getattr(message, 'detections', [])):
            stamp = one.header.stamp
            total = stamp.sec * SECOND + stamp.nanosec + round(seconds * 1e9)
            stamp.sec, stamp.nanosec = divmod(total, SECOND)


@pytest.mark.parametrize(
    ('motion', 'seconds'),
    [
        *(('tf', s) for s in (0.5, -0.5, 1.5, -1.5, 18.0, -37.0)),
        ('odometry', 0.5),
        ('odometry', -1.5),
    ],
)
def test_the_clock_of_clouds_and_boxes_may_be_off_from_that_of_the_motion(
    tmp_path, motion, seconds
):
    sweeps = 30
    drive = Drive(sweeps=sweeps, motion=motion)
    stamps_moved(drive, ('/points', '/boxes'), seconds)
    _, _, found = read(drive, tmp_path)
    assert f'set of the clouds {abs(seconds):g} s'.replace('set', 'got stamps') in found
    assert f'--clock-offset={seconds:g}' in found
    assert ('GPS time' in found, 'TAI' in found) == (seconds == 18, abs(seconds) == 37)
    origins, _, found = read(drive, tmp_path / 'corrected', clock_offset=seconds)
    assert not found
    assert_true({stamp - round(seconds * 1e9): at for stamp, at in origins.items()}, sweeps)


@pytest.mark.parametrize('seconds, is_late', [(-0.5, False), (0.53, False), (0, True)])
def test_one_of_several_lidars_with_another_clock_is_named(tmp_path, seconds, is_late):
    drive, rear = Drive(sweeps=30), Drive(sweeps=30)
    stamps_moved(rear, ('/points',), seconds)
    drive.items += [
        ('/rear', at + is_late * SECOND // 2, cloud)
        for topic, at, cloud in rear.items
        if topic == '/points'
    ]
    origins, _, found = read(drive, tmp_path, lidars=Lidars(('/points', '/rear')))
    assert 'clocks: expected one for all LiDARs' in found
    assert f'/rear is {"0.53 s ahead" if seconds > 0 else "0.5 s behind"}:' in found
    assert len(origins.keys() & true_origins(30).keys()) >= 25  # of the right clock
    assert '--clock-offset' not in found and '--boxes-offset' not in found


def test_the_clock_of_the_motion_alone_may_be_off(tmp_path):
    drive = Drive(sweeps=30)
    stamps_moved(drive, ('/tf',), -1.2)
    assert '--clock-offset=1.2' in read(drive, tmp_path)[2]
    origins, _, found = read(drive, tmp_path / 'corrected', clock_offset=1.2)
    assert not found
    assert_true(origins, 30)


@pytest.mark.parametrize('is_copied', [True, False])
def test_motion_with_stamps_of_clouds_may_be_late_in_place_of_another_clock(tmp_path, is_copied):
    drive = Drive(sweeps=30)
    if not is_copied:
        stamps_moved(drive, ('/tf',), 0.037)
    late = SECOND // 2
    drive.items = [(name, at + late * (name == '/tf'), one) for name, at, one in drive.items]
    found = read(drive, tmp_path)[2]
    assert '--clock-offset=0.' in found
    assert ('computed from these clouds' in found) == is_copied


@pytest.mark.parametrize('seconds', [0.6, 1.5, 37.0])
def test_boxes_from_the_future_have_another_clock(tmp_path, seconds):
    drive = Drive(sweeps=30)
    stamps_moved(drive, ('/boxes',), seconds)
    found = read(drive, tmp_path)[2]
    assert f'stamps of the boxes {seconds:g} s ahead of those of the clouds' in found
    assert f'--boxes-offset={-seconds:g}' in found
    convention = Convention(boxes_offset=-seconds)
    path = drive.write(tmp_path / 'corrected')
    with Recording([path], convention=convention) as recording:
        items = FixedFrameItems(recording, Config(), convention)
        stamps = [item.content.stamp_ns for item in items.read()]
        assert sorted(stamps) == sorted(2 * list(true_origins(30)))
        assert not items.session.finding
    convention = Convention(boxes_offset=0.5)  # what is advised takes its place
    with Recording([path], convention=convention) as recording:
        items = FixedFrameItems(recording, Config(), convention)
        assert len([*items.read()]) > 0
        assert f'stamps of the boxes {seconds + 0.5:g} s ahead' in items.session.finding
        assert f'--boxes-offset={-seconds:g}' in items.session.finding


@pytest.mark.parametrize('seconds', [1.53, 18.04, 36.98, 3600, 12.345])
def test_boxes_whose_stamps_are_of_no_cloud_have_a_clock_that_is_behind(tmp_path, seconds):
    drive = Drive(sweeps=30)
    stamps_moved(drive, ('/boxes',), -seconds)
    late = 30_000_000  # of the detector
    drive.items = [(name, at + late * (name == '/boxes'), one) for name, at, one in drive.items]
    found = read(drive, tmp_path)[2]
    offset = {18.04: 18, 36.98: 37}.get(seconds, seconds)
    assert f'stamps of the boxes {offset} s behind those of the clouds' in found
    assert 'and of no other cloud' in found
    assert f'--boxes-offset={offset}' in found


def test_an_offset_is_named_with_all_digits_and_only_if_it_is_constant(tmp_path):
    drive = Drive(sweeps=30)
    stamps_moved(drive, ('/points', '/boxes'), 1234567 - START // SECOND)
    assert f'--clock-offset={1234567 - START // SECOND} ' in read(drive, tmp_path)[2]
    drive = Drive(sweeps=30)
    for topic, received_ns, message in drive.items:  # in us, as if they were ns
        if topic in ('/points', '/boxes'):
            for one in (message, *getattr(message, 'detections', [])):
                one.header.stamp.sec, one.header.stamp.nanosec = divmod(
                    received_ns // 1000, SECOND
                )
    assert '--clock-offset' not in read(drive, tmp_path / 'unit')[2]


def test_boxes_with_stamps_of_earlier_clouds_are_those_of_a_slow_detector(tmp_path):
    """It has run before the recording began; a clock 15 periods behind looks the same: said."""
    drive = Drive(sweeps=40)
    slow_ns = 3 * SECOND // 2
    first_ns, last_ns = drive.stamps[15], drive.stamps[-1]
    delayed = [(t, ns + slow_ns * (t == '/boxes'), message) for t, ns, message in drive.items]
    kept = [item for item in delayed if item[0] != '/points' or item[1] >= first_ns]
    drive.items = sorted((i for i in kept if i[1] <= last_ns), key=lambda item: item[1])
    path = drive.write(tmp_path / 'drive')
    with Recording([path]) as recording:
        items = FixedFrameItems(recording, Config())
        given = [item.content for item in items.read()]
        assert not items.session.finding
        assert 'those of a slow detector' in recording.finding
        assert '--boxes-offset=1.50' in recording.finding
        assert recording.apart == {'/boxes': pytest.approx(1.5)}
    # Each array follows the cloud of its stamp.
    stamps = [one.stamp_ns for one in given if one.stamp_ns >= first_ns]
    assert sorted(stamps) == stamps


def test_delays_of_a_common_clock_are_no_finding(tmp_path):
    """Clouds are received 0.2 s after their stamp, boxes 0.5 s, transforms at once."""
    drive = Drive(sweeps=20)
    delays = {'/points': 200_000_000, '/boxes': 500_000_000}
    drive.items = [(t, ns + delays.get(t, 0), message) for t, ns, message in drive.items]
    origins, _, found = read(drive, tmp_path)
    assert_true(origins, 20)
    assert not found


def with_map(drive, position_of, every=1):
    """Add map -> odom at each stamp of the motion, at a position that depends on it."""
    m = drive.messages
    for k, stamp in enumerate(drive.stamps):
        if k % every == 0:
            message = m.tf(m.transform(stamp, 'map', 'odom', position_of(k)))
            drive.items.append(('/tf', stamp, message))
    return drive


def test_a_static_transform_that_is_repeated_on_tf_is_no_motion(tmp_path):
    """As static_transform_publisher of ROS 1 does; the motion above it was taken for steps."""
    drive = Drive(sweeps=20)
    m = drive.messages
    for topic, _, message in list(drive.items):
        if topic == '/tf':
            (one,) = message.transforms
            sensor, one.child_frame_id = one.child_frame_id, 'above'
    for stamp in drive.stamps:
        message = m.tf(m.transform(stamp, 'above', sensor, (0, 0, 0)))
        drive.items.append(('/tf', stamp, message))
    origins, frame, found = read(drive, tmp_path)
    assert frame == 'odom' and not found
    assert_true(origins, 20)


@pytest.mark.parametrize(
    'position_of, count',
    [
        (lambda k: (0.4 * (k // 5 % 2), 0, 0), 3),
        (lambda k: (0, 0.5 * (k >= 13), 0), 1),
    ],
    ids=['often', 'once'],
)
def test_a_frame_that_localisation_corrects_in_steps_is_not_the_fixed_one(
    tmp_path, position_of, count
):
    drive = with_map(Drive(sweeps=20), position_of)
    origins, frame, found = read(drive, tmp_path)
    assert frame == 'odom'
    assert_true(origins, 20)
    assert "fixed frame is 'odom', not 'map', which jumps" in found
    assert ('steps of up to' in found) == (count > 1)
    _, frame, found = read(drive, tmp_path / 'asked', 'map')
    assert frame == 'map'
    assert "the fixed frame 'map' jumps: map -> odom has" in found
    assert '--fixed-frame odom' in found


def test_a_jump_that_rotates_the_map_is_found(tmp_path):
    """The vehicle stands at the origin of odom: only what it sees moves."""
    drive = Drive(sweeps=20)
    m = drive.messages
    half = np.radians(1.0) / 2
    for k, stamp in enumerate(drive.stamps):
        turn = (0, 0, np.sin(half), np.cos(half)) if k >= 10 else (0, 0, 0, 1)
        drive.items.append(
            ('/tf', stamp, m.tf(m.transform(stamp, 'map', 'odom', (0, 0, 0), turn)))
        )
    assert read(drive, tmp_path)[1] == 'odom'


@pytest.mark.parametrize(('jump', 'unit'), [(0.0, ''), (3.0, 'm'), (-8.0, 'degrees')])
def test_a_single_jump_of_the_motion_itself_is_named(tmp_path, jump, unit):
    """Beside a turn of half a radian a second."""
    drive = Drive(sweeps=30)
    for topic, stamp, message in drive.items:
        if topic == '/tf':
            pose = message.transforms[0].transform
            yaw = 0.5e-9 * (stamp - START)
            if stamp >= drive.stamps[12]:
                pose.translation.y += jump * (unit == 'm')
                yaw += np.radians(jump) * (unit == 'degrees')
            pose.rotation.z, pose.rotation.w = np.sin(yaw / 2), np.cos(yaw / 2)
    _, _, found = read(drive, tmp_path)
    assert bool(found) == bool(jump)
    for i, part in enumerate(({'end': 1.2}, {'start': 1.2})):
        assert not read(drive, tmp_path / str(i), **part)[2]  # the remedy
    if jump:
        assert f'odom -> base has a step of {abs(jump):.2f} {unit}, the first at' in found
        assert f'{drive.stamps[12]} ns' in found


@pytest.mark.parametrize('braking', [10.0, 200.0])
def test_a_vehicle_that_brakes_hard_or_a_wrong_sample_is_no_jump(tmp_path, braking):
    """With the second one, it stands within a sample; with both, one position is wrong."""
    drive = Drive(sweeps=40)
    moving = [one for one in drive.items if one[0] == '/tf']
    for k, (_, _, message) in enumerate(moving):
        seconds = 0.1 * max(k - 15, 0)
        stopped = min(seconds, 20 / braking)
        x = 2.0 * min(k, 15) + 20 * stopped - braking / 2 * stopped**2
        message.transforms[0].transform.translation.x = x + 4.0 * (k == 8)
    assert 'jumps' not in read(drive, tmp_path)[2]


def test_a_map_that_drifts_smoothly_stays_the_fixed_frame(tmp_path):
    drive = with_map(Drive(sweeps=20), lambda k: (5 + 0.01 * k, -0.005 * k, 0))
    _, frame, found = read(drive, tmp_path)
    assert (frame, found) == ('map', '')


def test_clouds_registered_into_the_fixed_frame_need_the_frame_of_their_lidar(tmp_path):
    drive = Drive(sweeps=12)
    for topic, _, message in drive.items:
        if topic in ('/points', '/boxes'):
            for one in (message, *getattr(message, 'detections', [])):
                one.header.frame_id = 'odom'
    origins, frame, found = read(drive, tmp_path)
    assert frame == 'odom'
    assert '--sensor-frame lidar' in found
    assert "sensor_frames:=['lidar']" in found
    origins, _, found = read(drive, tmp_path / 'asked', lidars=Lidars(frames=('lidar',)))
    assert not found
    assert_true(origins, 12)


@pytest.mark.parametrize('name', ['base', 'lidar'])
def test_a_fixed_frame_of_the_vehicle_is_named(tmp_path, name):
    found = read(Drive(sweeps=12), tmp_path, fixed_frame=name)[2]
    assert f'the fixed frame {name!r} moves by 5.5 m in ' in found
    assert 'leave it out, or set --fixed-frame odom (node: fixed_frame:=odom)' in found


def test_a_fixed_frame_of_a_sensor_that_stands_is_not(tmp_path):
    drive = Drive(sweeps=12)
    m = drive.messages
    drive.items = [item for item in drive.items if item[0] != '/tf']
    for k, stamp in enumerate(drive.stamps):  # a localisation that corrects the place of `base`
        place = (0.02 * k, 0, 0)
        drive.items.append(('/tf', stamp, m.tf(m.transform(stamp, 'map', 'base', place))))
    assert not read(drive, tmp_path, fixed_frame='base')[2]


@pytest.mark.parametrize(('deviation', 'turn'), [(0, 0), (0.01, 0.2), (0.05, 0), (0, 1.0)])
def test_motion_that_errs_from_cloud_to_cloud_is_named(tmp_path, deviation, turn):
    """The position by metres, or the yaw by degrees."""
    rng = np.random.default_rng(4)
    turns = np.random.default_rng(2).normal(0, turn, 50)
    drive = Drive(sweeps=50)
    for number in range(50):
        drive.replace('/tf', number, lambda message: shifted(message, rng.normal(0, deviation, 2)))
        drive.replace('/tf', number, lambda message, k=number: turned(message, turns[k]))
    found = read(drive, tmp_path)[2]
    assert ('errs by 0.05 m from cloud to cloud' in found) == (deviation > 0.03)
    assert ("yaw of 'lidar' in 'odom' errs by 1.1 degrees" in found) == (turn > 0.5)
    assert bool(found) == (max(deviation / 0.03, turn / 0.5) > 1)


def turned(message, degrees):
    turn = message.transforms[0].transform.rotation
    half = np.radians(degrees) / 2
    turn.z, turn.w = np.sin(half), np.cos(half)
    return message


def shifted(message, offset):
    place = message.transforms[0].transform.translation
    place.x += offset[0]
    place.y += offset[1]


@pytest.mark.parametrize(('slope', 'is_camera'), [(0.0, False), (0.3, False), (0.0, True)])
def test_poses_of_a_camera_are_named(tmp_path, slope, is_camera):
    """KITTI odometry and visual SLAM state them with z ahead and y down."""
    drive = Drive(sweeps=16)

    def change(message):
        place = message.transforms[0].transform.translation
        place.z = slope * place.x
        if is_camera:
            place.x, place.z = 0.0, place.x

    for number in range(16):
        drive.replace('/tf', number, change)
    found = read(drive, tmp_path)[2]
    named = "'lidar' has moved by 6 m in 'odom', mostly along z: expected z up, got poses"
    assert (named in found) == is_camera
    assert bool(found) == is_camera


def test_a_spiral_ramp_has_no_poses_of_a_camera(tmp_path):
    """Ten levels, each of 3 m, around a circle of 7 m: the place in the plane stays the same."""
    drive = Drive(sweeps=150)

    def change(message):
        place = message.transforms[0].transform.translation
        turn = 5 * place.x / 7
        place.x, place.y, place.z = 7 * np.sin(turn), 7 - 7 * np.cos(turn), 3 * turn / (2 * np.pi)

    for number in range(150):
        drive.replace('/tf', number, change)
    assert 'mostly along z' not in read(drive, tmp_path)[2]


@pytest.mark.parametrize('fixed_frame', [None, 'odom'])
def test_a_fixed_frame_with_z_down_is_named(tmp_path, fixed_frame):
    drive = Drive(sweeps=16)
    m = drive.messages
    down = m.tf(m.transform(START, 'ned', 'odom', (0, 0, 0), (1, 0, 0, 0)))
    drive.items.insert(0, ('/tf_static', START, down))
    _, frame, found = read(drive, tmp_path, fixed_frame=fixed_frame)
    assert frame == (fixed_frame or 'ned')
    named = "100% of the boxes stand on their roofs in 'ned': expected z up in the fixed frame"
    assert (named in found) == (fixed_frame is None)
    assert bool(found) == (fixed_frame is None)


def test_two_publishers_of_one_motion_are_named(tmp_path):
    drive = robots(12, [2])
    drive.items = [(t.replace('/r2/', '/r1/'), *rest) for t, *rest in drive.items]
    found = read(drive, tmp_path)[2]
    assert 'transform odom -> base: expected one motion, got' in found
    assert 'two publishers' in found


@pytest.mark.parametrize('delay_ns', [3, 50_000_000])
def test_publishers_that_disagree_by_less_than_a_metre_are_named_too(tmp_path, delay_ns):
    drive = Drive(sweeps=12)
    m = drive.messages
    for k, stamp in enumerate(drive.stamps):
        at = stamp + delay_ns
        drive.items.append(('/tf', at, m.tf(m.transform(at, 'odom', 'base', (0.5 * k, 0.4, 0)))))
    assert 'two publishers state it' in read(drive, tmp_path)[2]


@pytest.mark.parametrize('case', ['second publisher', 'no stamps'])
def test_positions_that_contradict_each_other_at_one_stamp_are_named(tmp_path, case):
    drive = Drive(sweeps=12)
    m = drive.messages
    if case == 'no stamps':
        for topic, _, message in drive.items:
            if topic == '/tf':
                message.transforms[0].header.stamp.sec = 0
                message.transforms[0].header.stamp.nanosec = 0
    else:
        for k, stamp in enumerate(drive.stamps):
            message = m.tf(m.transform(stamp, 'odom', 'base', (0.5 * k, 0.1, 0)))
            drive.items.append(('/tf', stamp, message))
    found = read(drive, tmp_path)[2]
    assert 'transform odom -> base: expected one position at each stamp' in found


def test_steps_of_a_localisation_are_no_second_publisher(tmp_path):
    """They move the vehicle in the map, back and on, twice a second."""
    drive = Drive(sweeps=30)
    for k, (_, _, message) in enumerate(item for item in drive.items if item[0] == '/tf'):
        message.transforms[0].transform.translation.x -= 0.7 * (k // 5 % 2)
    assert 'publishers' not in read(drive, tmp_path)[2]


def test_a_static_transform_published_once_on_tf_is_used_at_all_times(tmp_path):
    drive = Drive(sweeps=20)
    m = drive.messages
    drive.items = [item for item in drive.items if item[0] != '/tf_static']
    late = START + 3 * SECOND // 10
    drive.items.append(('/tf', late, m.tf(m.transform(late, 'base', 'lidar', (0, 0, 2)))))
    origins, _, found = read(drive, tmp_path)
    assert_true(origins, 20)
    assert 'base -> lidar was published once on a topic of moving transforms' in found


def test_motion_whose_poses_are_all_unset_is_no_motion(tmp_path):
    """As of a localisation that publishes before it is initialised."""
    drive = Drive(sweeps=20)
    for index in range(20):
        drive.replace('/tf', index, _unset)
    assert read(drive, tmp_path, 'odom') == ({}, 'odom', '')


def _unset(message):
    message.transforms[0].transform.rotation.w = 0.0


def test_a_frame_with_two_parents_is_named_and_either_may_be_chosen(tmp_path):
    drive = Drive(sweeps=20)
    m = drive.messages
    for k, stamp in enumerate(drive.stamps):
        message = m.tf(m.transform(stamp + 1, 'map', 'base', (100 + 0.5 * k, 0, 0)))
        drive.items.append(('/tf', stamp + 1, message))
    origins, frame, found = read(drive, tmp_path)
    assert frame == 'odom'
    assert_true(origins, 20)
    assert "frame 'base': expected one parent, got 'odom', which is used, and 'map'" in found
    origins, frame, _ = read(drive, tmp_path / 'asked', 'map')
    assert frame == 'map'
    np.testing.assert_allclose(origins[START + SECOND], [105, 0, 2], atol=1e-6)


@pytest.mark.parametrize('child', ['lidar', 'base'])
def test_a_loop_of_transforms_is_named_and_the_frame_that_moves_is_not_the_root(tmp_path, child):
    drive = Drive(sweeps=12)
    m = drive.messages
    for stamp in drive.stamps:
        drive.items.append(('/tf', stamp, m.tf(m.transform(stamp, child, 'odom', (9, 0, 0)))))
    origins, frame, found = read(drive, tmp_path)
    assert frame == 'odom'
    assert_true(origins, 12)
    assert f'got a loop by {child} -> odom, while odom is above {child}' in found


@pytest.mark.parametrize(
    ('below', 'closing', 'root'),
    [('lidar', 'lidar', 'map'), ('base', 'base', 'map'), ('imu', 'base', 'imu')],
)
def test_a_loop_over_frames_above_the_motion_is_named(tmp_path, below, closing, root):
    """It goes over three frames and more; one of them may be beside the way to the LiDAR."""
    drive = Drive(sweeps=12)
    m = drive.messages
    for parent, child in (('map', 'odom'), ('base', 'imu'), (below, 'map')):
        drive.items.insert(
            0, ('/tf_static', START, m.tf(m.transform(0, parent, child, (0, 0, 0))))
        )
    origins, frame, found = read(drive, tmp_path)
    assert frame == root
    assert_true(origins, 12)
    assert f'got a loop by {closing} -> {root}, while {root} is above {closing}' in found


@pytest.mark.parametrize('turn', [0.0, 0.02])
def test_static_transforms_that_contradict_each_other_are_named(tmp_path, turn):
    drive = Drive(sweeps=12)
    m = drive.messages
    late = drive.stamps[5]
    quaternion = (0, 0, np.sin(turn / 2), np.cos(turn / 2))
    again = m.tf(m.transform(late, 'base', 'lidar', (0, 0, 2), quaternion))
    drive.items.append(('/tf_static', late, again))
    text = 'transform base -> lidar: expected one static pose, got others'
    assert (text in read(drive, tmp_path)[2]) == (turn > 0)


def with_sparse_transforms(sweeps):
    """Return a drive with transforms at 1 Hz, and its motion as odometry at 10 Hz."""
    drive = Drive(sweeps=sweeps)
    m = drive.messages
    drive.items = [
        item for item in drive.items if item[0] != '/tf' or (item[1] - START) % SECOND == 0
    ]
    for k, stamp in enumerate(drive.stamps):
        # Not where TF has it, to see which of both is used.
        drive.items.append(('/odom', stamp, m.odometry(stamp, 'odom', 'base', (0.5 * k, 9, 0))))
    return drive


def test_sparse_transforms_are_named_and_odometry_may_take_their_place(tmp_path):
    drive = with_sparse_transforms(41)
    origins, _, found = read(drive, tmp_path)
    assert 'transform odom -> base comes every 1 s' in found
    assert '--odometry TOPIC' in found
    assert_true(origins, 41)
    origins, frame, found = read(drive, tmp_path / 'odometry', odometry='/odom')
    assert (frame, found) == ('odom', '')
    assert_true({stamp: at - [0, 9, 0] for stamp, at in origins.items()}, 41)


@pytest.mark.parametrize('clouds_go_on', [True, False])
def test_a_gap_of_the_motion_is_named_where_clouds_go_on(tmp_path, clouds_go_on):
    drive = Drive(sweeps=41)
    missing = {'/tf'} if clouds_go_on else {'/tf', '/points', '/boxes'}
    begin = START + SECOND
    drive.items = [
        item for item in drive.items
        if item[0] not in missing or not begin < item[1] < begin + 3 * SECOND // 2
    ]  # fmt: skip
    found = read(drive, tmp_path)[2]
    text = f'transform odom -> base is missing for 1.5 s, from {begin} ns on'
    assert (text in found) == clouds_go_on


def test_odometry_of_another_frame_is_refused(tmp_path):
    drive = Drive(sweeps=8)
    m = drive.messages
    drive.items.append(('/odom', START, m.odometry(START, 'odom', 'trailer', (0, 9, 0))))
    with pytest.raises(RecordingError, match=r'got /odom \(odom -> trailer\)'):
        read(drive, tmp_path, odometry='/odom')


def test_boxes_without_a_frame_are_taken_to_be_in_that_of_the_clouds(tmp_path):
    drive = Drive(sweeps=8)
    for topic, _, message in drive.items:
        for one in (message, *message.detections) if topic == '/boxes' else ():
            one.header.frame_id = ''
    path = drive.write(tmp_path / 'drive')
    with Recording([path]) as recording:
        items = FixedFrameItems(recording, Config())
        moved = [item.moved for item in items.read()]
    assert "in that of the clouds, 'lidar'" in items.session.finding
    for boxes in moved:
        if not isinstance(boxes, Sweep):
            np.testing.assert_allclose(
                boxes.boxes[:, :3], drive.truth[boxes.stamp_ns][:, :3], atol=0.3
            )


def test_clouds_without_a_frame_are_in_the_one_that_is_named(tmp_path):
    drive = Drive(sweeps=8)
    for topic, _, message in drive.items:
        if topic == '/points':
            message.header.frame_id = ''
    for wanted in (None, ''):
        with pytest.raises(RecordingError, match=r'empty frame_id; .*FRAME, one of base, l'):
            read(drive, tmp_path / f'wanted{wanted}', wanted)
    origins, frame, found = read(drive, tmp_path / 'named', lidars=Lidars(frames=('lidar',)))
    assert (frame, found) == ('odom', '')
    assert_true(origins, 8)


def test_an_array_stamped_0_has_the_stamp_of_its_boxes(tmp_path):
    drive = Drive(sweeps=8)
    for topic, _, message in drive.items:
        if topic == '/boxes':
            message.header.stamp.sec = message.header.stamp.nanosec = 0
    path = drive.write(tmp_path / 'drive')
    with Recording([path]) as recording:
        items = FixedFrameItems(recording, Config())
        given = [item.content for item in items.read(with_clouds=False)]
    assert [boxes.stamp_ns for boxes in given] == drive.stamps


@pytest.mark.parametrize('storage', ['mcap', 'rosbag1'])
def test_messages_without_receive_times_are_ordered_by_stamp(tmp_path, storage):
    drive = Drive(sweeps=12, ros1=storage == 'rosbag1')
    items = sorted(((topic, 0, message) for topic, _, message in drive.items), key=lambda i: i[0])
    path = write_recording(tmp_path / 'drive', items, storage, drive.messages)
    with Recording([path], start=0.3, end=0.9) as recording:
        moved = FixedFrameItems(recording, Config())
        received = [item.received_ns for item in moved.read()]
        assert recording.finding.startswith('receive times: expected')
    assert received == [stamp for stamp in drive.stamps[3:9] for _ in range(2)]
