"""Clouds that are not a PointCloud2: compressed ones, and Livox's own message."""

import base64
import struct
import sys
import tracemalloc
from types import SimpleNamespace
import zlib

from boxreg_ros.errors import UnsupportedMessage
from msg_adapters import clouds, pointcloud
import numpy as np
import pytest
from ros_messages import Messages, START
import zstandard

MESSAGES = Messages()
ROWS = 50


def cloud():
    """Return a PointCloud2 with coordinates, intensity and times."""
    rng = np.random.default_rng(3)
    columns = [(name, 'f4', rng.uniform(-20, 20, ROWS)) for name in 'xyz']
    columns.append(('intensity', 'f4', rng.uniform(0, 255, ROWS)))
    columns.append(('t', 'u4', np.linspace(0, 1e8, ROWS)))
    return MESSAGES.cloud(START, 'lidar', columns)


def compressed(message, kind, data):
    """Return a CompressedPointCloud2 of a cloud."""
    copied = ('height', 'width', 'fields', 'is_bigendian', 'point_step', 'row_step', 'is_dense')
    fields = {name: getattr(message, name) for name in copied}
    return MESSAGES.make(
        clouds.COMPRESSED_TYPE, header=message.header, format=kind,
        compressed_data=np.frombuffer(data, np.uint8), **fields,
    )  # fmt: skip


def gzipped(data):
    """Return data as zlib_point_cloud_transport writes them, with a header of gzip."""
    packer = zlib.compressobj(wbits=16 + zlib.MAX_WBITS)
    return packer.compress(data) + packer.flush()


PACKERS = {
    'zlib': [zlib.compress, gzipped],
    'zstd': [zstandard.ZstdCompressor().compress],
}
PAIRS = [(kind, pack) for kind, packers in PACKERS.items() for pack in packers]


@pytest.mark.parametrize('kind, pack', PAIRS)
def test_lossless_clouds_are_equal_to_the_original(kind, pack):
    message = cloud()
    found = clouds.plain(compressed(message, kind, pack(message.data.tobytes())))
    sweep, known = pointcloud.from_msg(found), pointcloud.from_msg(message)
    np.testing.assert_array_equal(sweep.points, known.points)
    np.testing.assert_array_equal(sweep.times, known.times)
    np.testing.assert_array_equal(pointcloud.intensities(found), pointcloud.intensities(message))


@pytest.mark.parametrize('kind, pack', PAIRS)
def test_not_more_than_the_cloud_is_unpacked(kind, pack):
    message = cloud()
    known = pointcloud.from_msg(message)
    bomb = compressed(message, kind, pack(message.data.tobytes() + bytes(2**26)))
    tracemalloc.start()
    sweep = pointcloud.from_msg(clouds.plain(bomb))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**20
    np.testing.assert_array_equal(sweep.points, known.points)
    bomb.height = 2**31
    with pytest.raises(UnsupportedMessage, match='a cloud of'):
        clouds.plain(bomb)


class DeviceBytes:
    """Bytes in the memory of a device, as messages of ROS 2 Lyrical have them: no buffer."""

    def __init__(self, data):
        self._data = data

    def __len__(self):
        return len(self._data)

    def to_bytes(self):
        return self._data.tobytes()


def test_bytes_of_a_device_are_read():
    message = cloud()
    expected = pointcloud.from_msg(message)
    packed = compressed(message, 'zlib', zlib.compress(message.data.tobytes()))
    packed.compressed_data = DeviceBytes(packed.compressed_data)
    message.data = DeviceBytes(message.data)
    for given in (message, clouds.plain(packed)):
        sweep = pointcloud.from_msg(given)
        np.testing.assert_array_equal(sweep.points, expected.points)
        np.testing.assert_array_equal(sweep.times, expected.times)
    assert not clouds.is_reordered(packed)


def draco(points, **attributes):
    """Return a stream of Draco that keeps the order of the points."""
    encode = pytest.importorskip('DracoPy').encode
    return encode(
        points, quantization_bits=20, preserve_order=True, generic_attributes=attributes or None
    )


def test_draco_clouds_are_equal_to_the_original_within_their_quantisation():
    message = cloud()
    known = pointcloud.from_msg(message)
    intensities = pointcloud.intensities(message).astype(np.float32)[:, None]
    times = np.linspace(0, 1e8, ROWS).astype(np.uint32)[:, None]
    data = draco(known.points, intensity=intensities, t=times)
    found = clouds.plain(compressed(message, 'draco', data))
    sweep = pointcloud.from_msg(found)
    np.testing.assert_allclose(sweep.points, known.points, atol=1e-4)
    np.testing.assert_allclose(sweep.times, known.times, atol=1e-9)
    np.testing.assert_array_equal(pointcloud.intensities(found), intensities[:, 0])


@pytest.mark.parametrize('name', ['intensity', 'i'])
def test_clouds_of_foxglove_have_the_names_of_the_stream(name):
    points = np.random.default_rng(4).uniform(-5, 5, (ROWS, 3)).astype(np.float32)
    values = np.arange(ROWS, dtype=np.uint8)[:, None]
    time = MESSAGES.header(START, '').stamp
    message = MESSAGES.build(
        clouds.FOXGLOVE_TYPE, timestamp=time, frame_id='lidar', format='draco',
        data=list(draco(points, **{name: values})),
    )  # fmt: skip
    found = clouds.plain(message)
    sweep = pointcloud.from_msg(found)
    assert (sweep.stamp_ns, sweep.frame_id) == (START, 'lidar')
    assert clouds.header_of(message).frame_id == 'lidar'
    np.testing.assert_allclose(sweep.points, points, atol=1e-4)
    np.testing.assert_array_equal(pointcloud.intensities(found), values[:, 0])


@pytest.mark.parametrize('kind', ['zlib', 'zstd', 'draco'])
@pytest.mark.parametrize('left', [0, 7, 300])
def test_a_stream_that_is_cut_short_gives_one_clear_line(kind, left):
    message = cloud()
    data = message.data.tobytes()
    points = pointcloud.from_msg(message).points
    packed = draco(points) if kind == 'draco' else PACKERS[kind][0](data)
    assert len(packed) > left
    with pytest.raises(UnsupportedMessage, match=f'by {kind}: expected a whole stream') as caught:
        clouds.plain(compressed(message, kind, packed[:left]))
    assert f'got {left} bytes' in str(caught.value)
    assert 'cut short' in str(caught.value)
    assert '\n' not in str(caught.value)


# Five points of x, y, z, intensity (float32), t (uint32), ring (uint16) and rgb (float32), as
# draco_point_cloud_transport writes them: an attribute per field, of types POSITION, GENERIC and,
# as four uint8, COLOR. Encoded by the draco3d of npm, in the order of the points and by k-d tree.
PLUGIN_STREAMS = {
    'sequential': (
        'RFJBQ08CAwAAAAAFAAAAAQcACQEAAAAJAQABAAkBAAIECQEAAwQGAQAEBAQBAAUCAgQABgAAAAABAQEAAAAAAADA'
        'PwAAQEAAAJBAAADAQAAAyEIAAMtCAADOQgAA0UIAANRCAABIQwCASUMAAEtDAIBMQwAATkMAAOBAAAAAQQAAEEEA'
        'ACBBAAAwQQABAQAWA80MSzUzAwTgggAJPSChByT0gIQeAAAAAAAJPQAAAQEBAQPNDAM1MwME4IIAAAAAAwAAAAAB'
        'AQEBCTUDAzUDAzUDAzUDAzEzBUDdf1CWAAAAABMAAAA='
    ),
    'k-d tree': (
        'RFJBQ08CAwABAAAFAAAAAQcACQEAAAAJAQABAAkBAAIECQEAAwQGAQAEBAQBAAUCAgQABgMWAAAABQAAAFUEcclq'
        'R4QAAAAADAAAAwDAAAAOAED/CzwAgv9f8P8X/P8AwMbtAQAAAEAEAAAAABIA8P8PTP+D/3/9/x/8AAAACQACABAA'
        'ABIAggUAoAAgAAAgAAACABI6AAAAAAAIAAAAAIAAAAAAAAYAAAAAAAAAAAAAAAAAEACABgCgABA4AAAAAAEAAAEA'
        'EACQ0AMEAAAAAAAAAAQAAAAAAAAAAAAAAAAAwEAQAADIQgAAwEAQAABIQwAAwEAQAADgQAAAgEAQ'
    ),
}


def plugin_cloud(method):
    """Return a cloud of `PLUGIN_STREAMS`, with gaps between its fields."""
    columns = [(name, 'f4', np.zeros(5)) for name in ('x', 'y', 'z', 'intensity')]
    columns += [('t', 'u4', np.zeros(5)), ('ring', 'u2', np.zeros(5)), ('rgb', 'f4', np.zeros(5))]
    message = MESSAGES.cloud(START, 'lidar', columns, padding=3)
    return compressed(message, 'draco', base64.b64decode(PLUGIN_STREAMS[method]))


@pytest.mark.parametrize('method', PLUGIN_STREAMS)
def test_draco_streams_of_the_transport_plugin_have_its_fields(method):
    pytest.importorskip('DracoPy')
    message = plugin_cloud(method)
    found = clouds.plain(message)
    sweep = pointcloud.from_msg(found)
    order = np.argsort(sweep.points[:, 0])
    k = np.arange(5)
    expected = np.stack([1.5 * k, 100 + 1.5 * k, 200 + 1.5 * k], axis=1)
    tolerance = 1e-2  # 16 bits per field
    np.testing.assert_allclose(sweep.points[order], expected, atol=tolerance)
    np.testing.assert_allclose(sweep.times[order], 1e-3 * k, atol=1e-9)
    np.testing.assert_allclose(pointcloud.intensities(found)[order], 7 + k, atol=tolerance)
    assert pointcloud.described(found).startswith('unknown layout (x, y, z, intensity, t, ring')
    kinds = {field.name: field.datatype for field in found.fields}
    assert kinds == {'x': 7, 'y': 7, 'z': 7, 'intensity': 7, 't': 6, 'ring': 4, 'rgb': 7}
    rows = np.asarray(found.data).reshape(5, -1)
    assert rows[order[0], 22:26].tolist() == [0, 1, 2, 3]
    assert clouds.is_reordered(message) == (method == 'k-d tree')


DRACO_NUMBERS = {'i1': 1, 'u1': 2, 'i4': 5, 'u4': 6, 'i8': 7, 'u8': 8, 'f4': 9, 'f8': 10}


def draco_stream(columns):
    """
    Return a stream of Draco 2.2, an attribute per column.

    Doubles and integers of 64 bits are stored as they are: Draco does so, but DracoPy does not
    encode them. Integers of 32 bits are symbols, with the sign as the last bit.

    """
    kinds = [column.dtype.str[1:] for column in columns]
    count = len(columns[0])
    head = b'DRACO' + bytes([2, 2, 0, 0]) + struct.pack('<HiB', 0, count, 1)
    attributes = [
        bytes([4 if number else 0, DRACO_NUMBERS[kind], 1, 0, number])
        for number, kind in enumerate(kinds)
    ]
    decoders = bytes(kind == 'i4' for kind in kinds)
    values = [
        b'\xfe\0\4' + (column << 1 ^ column >> 31).tobytes() if kind == 'i4' else column.tobytes()
        for kind, column in zip(kinds, columns, strict=True)
    ]
    return b''.join([head, bytes([len(columns)]), *attributes, decoders, *values])


@pytest.mark.parametrize('origin', [0.0, 250_000.0], ids=['near', 'of UTM'])
def test_doubles_of_draco_keep_all_digits(origin):
    """Times of today as float32 are multiples of 128 s, coordinates of UTM of 0.016 to 0.5 m."""
    pytest.importorskip('DracoPy')
    rng = np.random.default_rng(6)
    xyz = origin + rng.uniform(-20, 20, (ROWS, 3))
    xyz[0, 2] = np.nan
    times = START * 1e-9 + np.linspace(0, 0.1, ROWS)
    columns = [(name, 'f8', xyz[:, k]) for k, name in enumerate('xyz')]
    columns += [('ring', 'u1', np.arange(ROWS)), ('timestamp', 'f8', times)]
    message = MESSAGES.cloud(START, 'lidar', columns)
    stream = draco_stream([np.asarray(values, kind) for _, kind, values in columns])
    sweep = pointcloud.from_msg(clouds.plain(compressed(message, 'draco', stream)))
    known = pointcloud.from_msg(message)
    assert known.points.dtype == np.float64 and len(known.points) == ROWS - 1
    np.testing.assert_array_equal(sweep.points, known.points)
    np.testing.assert_array_equal(sweep.times, known.times)
    np.testing.assert_allclose(sweep.times, np.linspace(0, 0.1, ROWS)[1:], atol=1e-6)


def test_long_integers_of_draco_keep_all_digits():
    pytest.importorskip('DracoPy')
    xyz = np.random.default_rng(7).uniform(-20, 20, (3, ROWS)).astype('f4')
    offsets = np.linspace(0, 1e8, ROWS).astype('u8')
    stream = draco_stream([*xyz, START + offsets])
    data = [(name, values) for name, values in zip('xyzt', [*xyz, START + offsets], strict=True)]
    found = dict(clouds._draco_columns(stream))
    assert len(found) == len(data)
    np.testing.assert_allclose(list(found.values())[3] - START, offsets, atol=256)


def test_integers_that_draco_rounds_are_refused():
    """50 times 2^21 is 10^8: the times of a sweep in ns. DracoPy gives them as float32."""
    pytest.importorskip('DracoPy')
    for step in (1, 2**21):
        columns = [(name, 'f4', np.arange(ROWS)) for name in 'xyz']
        columns += [
            ('flags', 'i4', np.arange(ROWS) * 2**21 + 1),
            ('t', 'i4', np.arange(ROWS) * step),
        ]
        message = MESSAGES.cloud(START, 'lidar', columns)
        stream = draco_stream([np.asarray(values, kind) for _, kind, values in columns])
        packed = compressed(message, 'draco', stream)
        if step == 1:
            rows = np.asarray(clouds.plain(packed).data).reshape(ROWS, 20)
            np.testing.assert_array_equal(rows[:, 16:].copy().view('<i4')[:, 0], np.arange(ROWS))
            continue
        with pytest.raises(UnsupportedMessage, match=r'expected t as .* below 2\^24'):
            clouds.plain(packed)


def cloudini_stream(message, **settings):
    """Return a cloud as Cloudini compresses it, coordinates to 1 mm."""
    pureini = pytest.importorskip('pureini')
    fields = [
        pureini.PointField(
            field.name, field.offset, pureini.FieldType(field.datatype),
            0.001 if field.datatype == 7 else None,
        )
        for field in message.fields
    ]  # fmt: skip
    info = pureini.EncodingInfo(
        fields, message.width, message.height, message.point_step, **settings
    )
    return pureini.PointcloudEncoder(info).encode(message.data.tobytes())


@pytest.mark.parametrize('version', [2, 3, 4, 5])
@pytest.mark.parametrize('form', ['', 'cloudini'])
def test_clouds_of_cloudini_are_read_whatever_their_format_says(version, form):
    message = cloud()
    stream = cloudini_stream(message, version=version)
    packed = compressed(message, form, stream)
    sweep, known = pointcloud.from_msg(clouds.plain(packed)), pointcloud.from_msg(message)
    np.testing.assert_allclose(sweep.points, known.points, atol=0.000501)
    np.testing.assert_array_equal(sweep.times, known.times)
    assert not clouds.is_reordered(packed)


def test_cloudini_in_a_message_of_foxglove():
    message = cloud()
    time = MESSAGES.header(START, '').stamp
    packed = MESSAGES.build(
        clouds.FOXGLOVE_TYPE, timestamp=time, frame_id='lidar', format='cloudini',
        data=list(cloudini_stream(message)),
    )  # fmt: skip
    sweep = pointcloud.from_msg(clouds.plain(packed))
    assert (sweep.stamp_ns, sweep.frame_id, len(sweep.points)) == (START, 'lidar', ROWS)


def test_cloudini_without_its_package_damaged_or_too_large(monkeypatch):
    message = cloud()
    stream = cloudini_stream(message)
    with pytest.raises(UnsupportedMessage, match='by cloudini: expected a whole stream'):
        clouds.plain(compressed(message, '', stream[:-9]))
    bomb = stream.replace(b'width: 50\n', b'width: 2000000000\n')
    with pytest.raises(UnsupportedMessage, match='a cloud of 40000000000 bytes'):
        clouds.plain(compressed(message, '', bomb))
    monkeypatch.setitem(sys.modules, 'pureini', None)
    with pytest.raises(UnsupportedMessage, match=r'pip install pureini, or .*rosbag_conv'):
        clouds.plain(compressed(message, '', stream))


def test_fields_of_draco_beyond_the_point_are_refused():
    pytest.importorskip('DracoPy')
    message = plugin_cloud('sequential')
    message.point_step = 8
    with pytest.raises(UnsupportedMessage, match='within a point_step of 8 bytes'):
        clouds.plain(message)


def test_attributes_that_do_not_fit_the_fields_are_refused():
    message = cloud()
    data = draco(pointcloud.from_msg(message).points)
    with pytest.raises(UnsupportedMessage, match='x, y, z, intensity, t, got 3'):
        clouds.plain(compressed(message, 'draco', data))


def test_unknown_formats_are_named():
    with pytest.raises(
        UnsupportedMessage, match="'lz4': expected draco or zlib or zstd or cloudini"
    ):
        clouds.plain(compressed(cloud(), 'lz4', b''))
    message = SimpleNamespace(timestamp=None, frame_id='', format='ply', data=b'')
    with pytest.raises(UnsupportedMessage, match="'ply': expected draco"):
        clouds.plain(message)


def test_without_its_package_draco_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, 'DracoPy', None)
    with pytest.raises(UnsupportedMessage, match='pip install DracoPy'):
        clouds.plain(compressed(cloud(), 'draco', b''))


def test_livox_messages_are_read():
    points = [
        {'x': 1.0 + k, 'y': 2.0, 'z': 3.0, 'reflectivity': 7 + k, 'offset_time': k * 10**6}
        for k in range(4)
    ]
    message = MESSAGES.build(
        clouds.LIVOX_TYPES[0], header=MESSAGES.header(START, 'livox'), timebase=START,
        point_num=4, points=points,
    )  # fmt: skip
    found = clouds.plain(message)
    sweep = pointcloud.from_msg(found)
    np.testing.assert_array_equal(sweep.points[:, 0], [1, 2, 3, 4])
    np.testing.assert_allclose(sweep.times, [0, 1e-3, 2e-3, 3e-3], atol=1e-12)
    np.testing.assert_array_equal(pointcloud.intensities(found), [7, 8, 9, 10])
