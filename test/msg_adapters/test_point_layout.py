"""Layouts of clouds by LiDAR drivers, and the units of their times."""

from boxreg_ros.errors import UnsupportedMessage
from msg_adapters import cloud_edits, pointcloud
import numpy as np
import pytest
from ros_messages import Messages, START

MESSAGES = Messages()
SWEEP = 0.1
"""Duration of a cloud [s]."""
XYZ = [('x', 'f4'), ('y', 'f4'), ('z', 'f4')]
DRIVERS = {
    'Velodyne': [('intensity', 'f4'), ('ring', 'u2'), ('time', 'f4')],
    'Ouster': [
        *(('intensity', 'f4'), ('t', 'u4'), ('reflectivity', 'u2'), ('ring', 'u2')),
        *(('ambient', 'u2'), ('range', 'u4')),
    ],
    'Hesai or RoboSense': [('intensity', 'f4'), ('ring', 'u2'), ('timestamp', 'f8')],
    'Livox PointCloud2': [
        ('intensity', 'f4'), ('tag', 'u1'), ('line', 'u1'), ('timestamp', 'f8')
    ],
    'Autoware PointXYZIRC': [('intensity', 'u1'), ('return_type', 'u1'), ('channel', 'u2')],
    'Autoware PointXYZIRCAEDT': [
        *(('intensity', 'u1'), ('return_type', 'u1'), ('channel', 'u2'), ('azimuth', 'f4')),
        *(('elevation', 'f4'), ('distance', 'f4'), ('time_stamp', 'u4')),
    ],
    'Autoware PointXYZIRADT': [
        *(('intensity', 'f4'), ('ring', 'u2'), ('azimuth', 'f4'), ('distance', 'f4')),
        *(('return_type', 'u1'), ('time_stamp', 'f8')),
    ],
}  # fmt: skip
"""Fields as the drivers document them."""
TIMES = {
    'Velodyne': ('time', 1.0, 0.0),
    'Ouster': ('t', 1e9, 0.0),
    'Hesai or RoboSense': ('timestamp', 1.0, START * 1e-9),
    'Livox PointCloud2': ('timestamp', 1e9, float(START)),
    'Autoware PointXYZIRCAEDT': ('time_stamp', 1e9, 0.0),
    'Autoware PointXYZIRADT': ('time_stamp', 1.0, START * 1e-9),
}
"""Field of the times, values per second, and value at the stamp."""


def cloud(driver, factor=1.0, count=6000):
    """Return a cloud of a driver; its relative times are `factor` too large."""
    times = np.linspace(0, SWEEP, count)
    columns = []
    for name, kind in [*XYZ, *DRIVERS[driver]]:
        values = np.ones(count)
        if driver in TIMES and name == TIMES[driver][0]:
            _, scale, start = TIMES[driver]
            values = (start + times * scale) * factor
        columns.append((name, kind, values.astype(kind)))
    return MESSAGES.cloud(START, 'lidar', columns), times


def test_points_that_are_all_at_the_stamp_have_no_times():
    times = np.zeros(100, np.float32)
    columns = [*((name, kind, np.ones(100, kind)) for name, kind in XYZ), ('t', 'f4', times)]
    assert pointcloud.from_msg(MESSAGES.cloud(START, 'lidar', columns)).times is None
    times[50:] = 0.05
    found = pointcloud.from_msg(MESSAGES.cloud(START, 'lidar', columns)).times
    np.testing.assert_array_equal(found, times.astype(float))


@pytest.mark.parametrize('driver', DRIVERS)
def test_drivers_are_told_apart_and_their_times_are_read(driver):
    message, times = cloud(driver)
    sweep = pointcloud.from_msg(message)
    text = pointcloud.described(message)
    assert text.startswith(f'{driver}: ')
    if driver not in TIMES:
        assert sweep.times is None
        assert 'no times' in text
        return
    np.testing.assert_allclose(sweep.times, times, atol=1e-6)  # of absolute seconds in float64
    assert 'over 0.100 s' in text
    assert TIMES[driver][0] in text


@pytest.mark.parametrize(
    'driver, factor, unit',
    [
        ('Velodyne', 1e3, 'ms'),
        ('Velodyne', 1e6, 'us'),
        ('Ouster', 1e-3, 'us'),
        ('Autoware PointXYZIRCAEDT', 1e-3, 'us'),
        ('Hesai or RoboSense', 1e6, 'us'),
        ('Livox PointCloud2', 1e-3, 'us'),
    ],
)
def test_a_wrong_unit_is_refused_with_the_setting_that_mends_it(driver, factor, unit):
    message, times = cloud(driver, factor)
    with pytest.raises(UnsupportedMessage, match=f'--time-unit {unit}') as caught:
        pointcloud.from_msg(message)
    assert driver in str(caught.value)
    np.testing.assert_allclose(pointcloud.from_msg(message, unit).times, times, atol=1e-6)


def test_a_small_part_of_a_cloud_is_read_in_the_unit_of_its_driver():
    message, _ = cloud('Ouster', factor=1e-3, count=20)  # the first 0.1 ms
    np.testing.assert_allclose(pointcloud.from_msg(message).times.max(), 1e-4)


def test_times_without_a_unit_are_not_used_and_said_so():
    columns = [(name, kind, np.ones(4)) for name, kind in XYZ]
    message = MESSAGES.cloud(START, 'lidar', [*columns, ('time', 'f4', np.full(4, 1e12))])
    assert pointcloud.from_msg(message).times is None
    assert 'times in time are not used' in pointcloud.described(message)
    message = MESSAGES.cloud(START, 'lidar', columns)
    assert pointcloud.described(message) == 'unknown layout (x, y, z): no times of the points'


@pytest.mark.parametrize('driver', TIMES)
def test_points_with_wild_times_alone_lose_them(driver):
    message, times = cloud(driver)
    kinds = dict([*XYZ, *DRIVERS[driver]])
    field, scale, start = TIMES[driver]
    columns = [(name, kind, np.ones(6000, kind)) for name, kind in kinds.items()]
    values = (start + times * scale).astype(kinds[field])
    wild = [7, 3000, 5990]
    values[wild] = np.array([0, 3e9, 5e8]).astype(values.dtype)
    values[wild[0]] = values[0] + 0.9 * scale
    columns = [(n, k, values if n == field else v) for n, k, v in columns]
    message = MESSAGES.cloud(START, 'lidar', columns)
    expected = times.copy()
    expected[wild] = 0
    np.testing.assert_allclose(pointcloud.from_msg(message).times, expected, atol=1e-5)
    assert '3 points have times of no sweep' in pointcloud.described(message)


@pytest.mark.parametrize('order', '<>')
def test_a_wrong_byte_order_is_corrected_and_said(order):
    xyz = np.random.default_rng(2).uniform(-60, 60, (300, 3))
    columns = [(name, 'f4', xyz[:, i]) for i, name in enumerate('xyz')]
    message = MESSAGES.cloud(START, 'lidar', columns, order=order)
    for stated in (message.is_bigendian, not message.is_bigendian):
        message.is_bigendian = stated
        np.testing.assert_allclose(pointcloud.from_msg(message).points, xyz, rtol=1e-6)
        is_wrong = stated != (order == '>')
        assert ('in the other byte order' in pointcloud.described(message)) == is_wrong


@pytest.mark.parametrize('order', '<>')
@pytest.mark.parametrize('is_wrong', [False, True])
def test_edited_copies_have_the_byte_order_of_the_points(order, is_wrong):
    xyz = np.random.default_rng(2).uniform(-60, 60, (300, 3)).astype('f4')
    times = np.linspace(0, 0.1, 300, dtype='f4')
    columns = [(name, 'f4', xyz[:, i]) for i, name in enumerate('xyz')] + [('t', 'f4', times)]
    message = MESSAGES.cloud(START, 'lidar', columns, order=order)
    message.is_bigendian ^= is_wrong
    more = cloud_edits.with_fields(message, {'intensity': np.full(300, 7.0, 'f4')})
    np.testing.assert_array_equal(pointcloud.intensities(more), 7)
    moved = cloud_edits.with_positions(more, xyz + np.float32(1))
    kept = cloud_edits.with_points(moved, np.arange(300) < 250)
    found = pointcloud.from_msg(kept)
    np.testing.assert_allclose(found.points, xyz[:250] + 1, rtol=1e-6)
    np.testing.assert_allclose(found.times, times[:250], atol=1e-6)
    np.testing.assert_array_equal(pointcloud.intensities(kept), 7)
