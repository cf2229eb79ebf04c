"""Several LiDARs: which clouds are merged, and which LiDAR measured which point."""

from types import SimpleNamespace

from boxreg_ros.errors import ConfigError, UnsupportedMessage
from boxreg_ros.io.lidars import ignore, Lidars, merged, SensorPlacement, SweepMerger
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.io.transforms import sweep_to_frame
from boxreg_ros.structures import Sweep
from lidar_drives import DELAY_NS, LidarDrive, LIDARS, SPEED
import numpy as np
import pytest
from ros_messages import Messages, SECOND, START

MS = 10**6
PERIOD = 100 * MS
NAMES = ('a', 'b', 'c')


def cloud(topic, stamp_ms, count=2, **fields):
    """Return a cloud whose points have the x of its stamp [ms]."""
    points = np.full((count, 3), stamp_ms, np.float32)
    origin = np.array([NAMES.index(topic), 0.0, 0.0]) if topic else np.zeros(3)
    return Sweep(stamp_ms * MS, 'odom', points, None, origin, topic=topic, **fields)


def groups(clouds, topics=NAMES, span=0.1, reports=None):
    """Return the stamps [ms] of the clouds in each merged sweep, and those left at the end."""
    found = []
    report = ignore if reports is None else lambda *args: reports.append(args[:2])
    merger = SweepMerger(topics, span, report)
    for topic, stamp in clouds:
        found += merger.add(cloud(topic, stamp))
    return [
        [sorted({int(x) for x in part.sweep.points[:, 0]}) for part in parts]
        for parts in (found, merger.flush())
    ]


def periods(count, offsets, skip=()):
    """Return (topic, stamp) of `count` periods in the order of their stamps."""
    every = [
        (name, 1000 + 100 * k + offset)
        for k in range(count)
        for name, offset in offsets.items()
        if (name, k) not in skip
    ]
    return sorted(every, key=lambda item: item[1])


def test_clouds_of_one_period_are_merged():
    offsets = {'a': 0, 'b': 33, 'c': 66}
    complete, rest = groups(periods(3, offsets))
    assert complete == [[1000 + 100 * k + offset for offset in offsets.values()] for k in range(3)]
    assert rest == []


def test_a_cloud_may_arrive_after_one_of_the_next_period():
    order = [('a', 0), ('b', 30), ('a', 100), ('c', 60), ('b', 130), ('c', 160)]
    assert groups(order) == [[[0, 30, 60], [100, 130, 160]], []]


def test_clouds_of_one_lidar_may_arrive_in_another_order():
    order = [('b', 1000), ('a', 1000)]
    for k in range(1, 9, 2):
        order += [('a', 1100 + 100 * k), ('b', 1000 + 100 * k), ('a', 1000 + 100 * k)]
        order += [('b', 1100 + 100 * k)]
    complete, rest = groups(order, topics=('a', 'b'))
    assert complete + rest == [[1000 + 100 * k] for k in range(9)]


def test_a_lidar_that_stamps_the_end_of_a_sweep_loses_no_cloud_of_the_others():
    order = [
        (name, 1000 + 99 * k + offset) for k in range(9) for name, offset in (('a', 0), ('b', 100))
    ]
    complete, rest = groups(order, topics=('a', 'b'))
    assert complete + rest == [[1000 + 99 * k, 1100 + 99 * k] for k in range(9)]


def test_a_silent_lidar_is_waited_for_one_second_only():
    reports = []
    offsets = {'a': 0, 'b': 10, 'c': 20}
    skip = {('c', k) for k in range(1, 30)}
    complete, rest = groups(periods(30, offsets, skip), reports=reports)
    assert len(complete) == 30  # the last ones at once
    assert rest == []
    assert [reason for reason, _ in reports] == ['cloud_missing'] * 29
    assert all(text.startswith('c: ') for _, text in reports)


def test_a_lidar_that_was_never_heard_does_not_hold_back_the_others():
    order = periods(15, {'a': 0, 'b': 10})
    complete, _ = groups(order)
    assert complete[0] == [1000, 1010]
    assert len(complete) == 15
    # It begins, behind the others of its time: the first cloud is late, the next are waited for.
    for k in range(15, 30):
        order += [
            (name, 1000 + 100 * k + offset) for name, offset in (('a', 0), ('b', 10), ('c', 5))
        ]
    complete, _ = groups(order)
    assert [len(stamps) for stamps in complete] == [2] * 16 + [3] * 14


def test_a_lidar_that_is_a_second_late_is_counted_and_left_out():
    reports = []
    order = []
    for k in range(30):
        order += [('a', 2000 + 100 * k), ('b', 2010 + 100 * k), ('c', 1020 + 100 * k)]
    complete, _ = groups(order, reports=reports)
    assert complete == [[2000 + 100 * k, 2010 + 100 * k] for k in range(len(complete))]
    assert len(complete) >= 29
    reasons = [reason for reason, _ in reports]
    assert reasons.count('cloud_late') >= 29


def test_a_second_cloud_of_the_last_stamp_is_late():
    reports = []
    merger = SweepMerger(('a', 'b'), 0.1, lambda *args: reports.append(args[0]))
    (merged_sweep,) = [*merger.add(cloud('a', 1000)), *merger.add(cloud('b', 1000))]
    assert len(merged_sweep.sweep.points) == 4
    assert merger.add(cloud('b', 1000)) == [] == merger.flush()
    assert reports == ['cloud_late']


def test_a_missing_cloud_delays_its_sweep_by_one_period():
    merger = SweepMerger(NAMES, 0.1, ignore)
    for topic, stamp in periods(3, {'a': 0, 'b': 10, 'c': 20}, skip={('b', 1)}):
        found = merger.add(cloud(topic, stamp))
        if (topic, stamp) == ('c', 1120):
            assert found == []
        if (topic, stamp) == ('c', 1220):
            assert [part.sweep.stamp_ns for part in found] == [1100 * MS, 1200 * MS]
    assert merger.counts['b'] == {'merged': 2, 'cloud_missing': 1}
    assert merger.counts['a'] == {'merged': 3}


def test_a_merged_sweep_has_times_and_sensors_of_every_point():
    first = cloud('a', 1000)
    second = cloud('b', 1030, 1)
    third = Sweep(
        1060 * MS, 'odom', np.zeros((2, 3), np.float32), np.array([0.0, -0.01]), np.zeros(3),
        topic='c', origins=np.array([[5.0, 0, 0], [7.0, 0, 0]]),
        sensors=np.array([1, 0], np.uint8),
    )  # fmt: skip
    whole = merged([first, second, third])
    assert (whole.stamp_ns, whole.topic) == (1000 * MS, '')
    np.testing.assert_allclose(whole.times, [0, 0, 0.03, 0.06, 0.05], atol=1e-12)
    assert whole.sensors.tolist() == [0, 0, 1, 3, 2]
    np.testing.assert_array_equal(whole.origins[:, 0], [0, 1, 5, 7])
    assert whole.points.shape == (5, 3)
    assert merged([cloud('a', 1000), cloud('b', 1000)]).times is None


def test_the_stamp_is_that_of_the_first_topic_that_is_there():
    found = SweepMerger(('b', 'a'), 0.1, ignore)
    found.add(cloud('a', 1000))
    (part,) = found.add(cloud('b', 1020))
    assert part.sweep.stamp_ns == 1020 * MS
    np.testing.assert_allclose(part.sweep.times, [0, 0, -0.02, -0.02], atol=1e-12)


@pytest.mark.parametrize('lost', [('a', 2), ('b', 2), ('c', 2)])
def test_a_lost_cloud_does_not_shift_the_pairs_after_it(lost):
    # Without the first cloud of its period, the others are near the first of the next one.
    offsets = {'a': 0, 'b': 40, 'c': 70}
    complete, rest = groups(periods(6, offsets, skip={lost}))
    expected = [
        [1000 + 100 * k + offset for name, offset in offsets.items() if (name, k) != lost]
        for k in range(6)
    ]
    assert complete + rest == expected


def test_lidars_of_different_rates_are_paired_again_after_they_pass_each_other():
    order = [('a', 1000 + 100 * k) for k in range(60)] + [('b', 1051 + 103 * k) for k in range(58)]
    complete, rest = groups(sorted(order, key=lambda item: item[1]), topics=('a', 'b'))
    sweeps = complete + rest
    pairs = [sweep for sweep in sweeps if len(sweep) == 2]
    assert len(pairs) >= 54
    assert all(abs(first - second) <= 100 for first, second in pairs)
    assert sum(len(sweep) for sweep in sweeps) == len(order)


def test_a_lidar_with_a_third_of_the_rate_is_merged_with_the_clouds_of_its_stamps():
    order = [(name, 1000 + 100 * k) for k in range(10) for name in ('a', 'b')[: 1 + (k % 3 == 0)]]
    merger = SweepMerger(('b', 'a'), 0.1, ignore)
    sweeps = [part.sweep for item in order for part in merger.add(cloud(*item))]
    sweeps += [part.sweep for part in merger.flush()]
    assert [sweep.stamp_ns for sweep in sweeps] == [(1000 + 100 * k) * MS for k in range(10)]
    assert [len(sweep.points) for sweep in sweeps] == [2 + 2 * (k % 3 == 0) for k in range(10)]


def test_a_dropped_cloud_is_not_waited_for():
    merger = SweepMerger(('a', 'b'), 0.1, ignore)
    merger.add(cloud('a', 1000, is_dropped=True))
    (part,) = merger.add(cloud('b', 1010))
    assert not part.sweep.is_dropped
    assert part.sweep.points[:, 0].tolist() == [1010, 1010]
    merger.add(cloud('a', 1100, is_dropped=True))
    (part,) = merger.add(cloud('b', 1110, is_dropped=True))
    assert part.sweep.is_dropped


@pytest.mark.parametrize(
    'fields, text',
    [
        ({'topics': ('a', 'a')}, 'each topic once'),
        ({'topics': ('a', 'b'), 'frames': ('x',)}, 'got 1'),
        ({'topics': ('a', 'b'), 'info': 'i'}, 'concatenated topic only'),
    ],
)
def test_settings_that_contradict_each_other_are_refused(fields, text):
    with pytest.raises(ConfigError, match=text):
        Lidars(**fields)


def placement_of(drive, lidars, frame_id='base'):
    """Return the sweep of the first cloud of a drive in a frame, placed, and what is missing."""
    tree = TransformTree()
    placement = SensorPlacement(lidars)
    cloud = None
    for topic, _, message in drive.items:
        if topic.startswith('/tf'):
            tree.add_transforms(message.transforms, topic == '/tf_static')
        elif topic == '/points_info':
            placement.add_info(message)
        elif topic == '/points':
            cloud = cloud or placement.sweep_of(message, topic)
    T_frame_base = tree.lookup(frame_id, 'base', cloud.stamp_ns)
    return placement.placed(sweep_to_frame(cloud, T_frame_base, frame_id), tree)


def test_the_info_names_the_lidar_and_the_time_of_every_point():
    sweep, reason, _ = placement_of(LidarDrive(2, 'info'), Lidars(info='/points_info'))
    assert reason is None
    half = len(sweep.points) // 2
    assert sweep.sensors.tolist() == [0] * half + [1] * half
    np.testing.assert_allclose(sweep.origins, list(LIDARS.values()))
    np.testing.assert_allclose(sweep.times, [0.0] * half + [0.03] * half)


def test_each_lidar_is_where_it_was_at_its_own_stamp():
    sweep, _, _ = placement_of(LidarDrive(2, 'info'), Lidars(info='/points_info'), 'odom')
    front, rear = LIDARS.values()
    moved = SPEED * DELAY_NS / SECOND  # of the vehicle, until the rear LiDAR measures
    np.testing.assert_allclose(sweep.origins, [front, np.add(rear, [moved, 0, 0])])


def test_an_info_of_points_that_draco_has_sorted_is_refused():
    message = SimpleNamespace(format='draco', compressed_data=b'DRACO\2\3\0\1')
    with pytest.raises(UnsupportedMessage, match=r"order that '/i' counts them.*encode_method 2"):
        SensorPlacement(Lidars(info='/i')).sweep_of(message, '/points')


def test_rows_of_the_info_count_points_that_are_not_finite():
    drive = LidarDrive(1, 'info')
    xyz = np.ones((4, 3))
    xyz[1] = np.nan
    points = drive.messages.points(drive.stamps[0], 'base', xyz)
    places = [i for i, item in enumerate(drive.items) if item[0] == '/points']
    drive.items[places[0]] = '/points', 0, points
    stamps = {'front': drive.stamps[0], 'rear': drive.stamps[0]}
    drive.items.append(('/points_info', 0, drive.info(drive.stamps[0], stamps, [2, 2])))
    sweep, _, _ = placement_of(drive, Lidars(info='/points_info'))
    assert sweep.sensors.tolist() == [0, 1, 1]


def test_without_info_points_belong_to_the_nearest_lidar_that_is_named():
    drive = LidarDrive(1, 'alone')
    sweep, reason, _ = placement_of(drive, Lidars(frames=('front', 'rear')))
    assert reason is None
    to_front = np.hypot(*(sweep.points[:, :2] - [2, 0]).T)
    to_rear = np.hypot(*(sweep.points[:, :2] - [-2, 0]).T)
    np.testing.assert_array_equal(sweep.sensors, to_rear < to_front)
    sweep, _, _ = placement_of(drive, Lidars(frames=('rear',)))
    np.testing.assert_allclose(sweep.origin, LIDARS['rear'])


@pytest.mark.parametrize(
    'kind, lidars, reason, text',
    [
        ('alone', Lidars(info='/points_info'), 'cloud_without_info', 'no info of the cloud'),
        ('alone', Lidars(frames=('left',)), 'sensor_without_transform', "from 'left' to 'base'"),
    ],
)
def test_what_is_missing_of_a_lidar_is_named(kind, lidars, reason, text):
    sweep, found, detail = placement_of(LidarDrive(1, kind), lidars)
    assert found == reason
    assert text in detail
    assert sweep.origins is None


@pytest.mark.parametrize('whole', [1.0, 360.0, 300_000.0], ids=['parts', 'degrees', 'ticks'])
def test_times_that_are_parts_of_a_revolution_become_seconds(whole):
    """No sweep is longer than the period of the clouds, whatever the unit."""
    m = Messages()
    placement = SensorPlacement()
    parts = np.linspace(0, 1, 500)
    columns = [(name, 'f4', np.ones(500)) for name in ('x', 'y', 'z')]
    for k in range(4):
        stamp = START + k * SECOND // 10
        message = m.cloud(stamp, 'lidar', [*columns, ('time', 'f4', whole * parts)])
        sweep = placement.sweep_of(message, '')
        if k == 0:
            assert sweep.times is None  # their period is not known yet
        else:
            np.testing.assert_allclose(sweep.times, parts / 10, atol=1e-6)
    assert 'clouds come every 0.100 s: they are parts of a revolution' in placement.normalised['']


@pytest.mark.parametrize('kind', ['u4', 'i4'], ids=['begin', 'end'])
@pytest.mark.parametrize(
    ('tick', 'degrees', 'is_named'), [(1e-5, 360, True), (1e-7, 360, True), (1e-5, 120, False)]
)
def test_ticks_that_are_no_unit_are_parts_of_a_revolution(kind, tick, degrees, is_named):
    """A LiDAR that does not turn may take its points in 10 ms."""
    m = Messages()
    placement = SensorPlacement()
    times = np.linspace(0, 0.099, 5000) - (0.099 if kind == 'i4' else 0)
    azimuth = np.radians(np.linspace(0, degrees, 5000) + np.tile([-4, 0, 3, 1], 1250))
    x, y = 20 * np.cos(azimuth), 20 * np.sin(azimuth)
    x[::7] = y[::7] = 0
    columns = [('x', 'f4', x), ('y', 'f4', y), ('z', 'f4', 0 * x)]
    for k in range(4):
        stamp = START + k * SECOND // 10
        ticks = np.round(times / tick).astype(kind)
        sweep = placement.sweep_of(m.cloud(stamp, 'lidar', [*columns, ('t', kind, ticks)]), '')
    assert ('they are parts of a revolution' in placement.normalised.get('', '')) == is_named
    expected = times if is_named else times / 10
    np.testing.assert_allclose(sweep.times, expected, atol=2e-3)


def test_a_revolution_in_a_second_is_read_as_it_is():
    m = Messages()
    parts = np.linspace(0, 1, 500)
    columns = [(name, 'f4', np.ones(500)) for name in ('x', 'y', 'z')]
    slow = SensorPlacement()
    for k in range(3):
        message = m.cloud(START + k * SECOND, 'lidar', [*columns, ('time', 'f4', parts)])
        sweep = slow.sweep_of(message, '')
    np.testing.assert_allclose(sweep.times, parts, atol=1e-6)
    assert not slow.normalised


@pytest.mark.parametrize(
    'kind, first', [('f8', 79_200.0), ('u4', 800_000_000)], ids=['s_of_day', 'us_of_hour']
)
def test_times_on_another_clock_are_not_used_and_said_so(kind, first):
    """They would be a constant offset of all points from the stamp."""
    m = Messages()
    columns = [(name, 'f4', np.ones(500)) for name in ('x', 'y', 'z')]
    length = {'f8': 0.1, 'u4': 100_000}[kind]
    times = np.linspace(first, first + length, 500)
    message = m.cloud(START, 'lidar', [*columns, ('t', kind, times)])
    placement = SensorPlacement()
    assert placement.sweep_of(message, '').times is None
    assert 'times in t are not used' in placement.normalised['']
