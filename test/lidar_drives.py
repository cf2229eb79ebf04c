"""A drive with two LiDARs, as clouds of two topics or concatenated."""

import zlib

from msg_adapters.clouds import COMPRESSED_TYPE
import numpy as np
import pytest
from ros_messages import Drive, SECOND
import zstandard

INFO = 'autoware_sensing_msgs/msg/ConcatenatedPointCloudInfo'
LIDARS = {'front': (2.0, 0.0, 1.0), 'rear': (-2.0, 0.0, 1.5)}
"""Frame -> position in the frame base [m]."""
COMPRESSION = {'/front': 'draco', '/rear': 'zstd'}
DELAY_NS = 30_000_000
"""The rear LiDAR is this much later [ns]."""
SPEED, CAR_SPEED = 5.0, 8.0
"""Of the vehicle, and of the moving car of `Drive` [m/s]."""


class LidarDrive(Drive):
    """
    The drive of `Drive`, every second point of each cloud measured by the rear LiDAR.

    `clouds` is ``topics`` (``/front`` and ``/rear``), ``compressed`` (the same), ``info``
    (``/points`` in frame base with ``/points_info``), or ``alone`` (without the info). Boxes
    follow the clouds of their stamp.

    """

    def __init__(self, sweeps=8, clouds='topics', start=None):
        super().__init__(sweeps, **({} if start is None else {'start': start}))
        m = self.messages
        mounts = [m.transform(self.stamps[0], 'base', name, at) for name, at in LIDARS.items()]
        by_topic = {topic: iter(self._of(topic)) for topic in ('/points', '/boxes')}
        self.items = [('/tf_static', self.stamps[0], m.tf(*mounts, *self._lidar_mount()))]
        for k, stamp in enumerate(self.stamps):
            late = stamp + DELAY_NS
            for time in (stamp, late):
                ego = (SPEED * (time - self.stamps[0]) / SECOND, 0.0, 0.0)
                self.items.append(('/tf', time, m.tf(m.transform(time, 'odom', 'base', ego))))
            cloud = next(by_topic['/points'])
            for topic, message in self._clouds(clouds, cloud, k):
                if clouds == 'compressed':
                    message = compressed(m, message, COMPRESSION[topic])
                self.items.append((topic, late, message))
            self.items.append(('/boxes', late, next(by_topic['/boxes'])))

    def _of(self, topic):
        return [message for name, _, message in self.items if name == topic]

    def _lidar_mount(self):
        (message,) = self._of('/tf_static')
        return message.transforms

    def _clouds(self, kind, cloud, k):
        """Yield topic and message of the clouds of sweep `k`."""
        stamp, m = self.stamps[k], self.messages
        rows = cloud.data.view(np.float32).reshape(-1, 3) + np.array([0, 0, 2])  # in base
        parts = {'front': rows[::2], 'rear': rows[1::2].copy()}
        is_moving = np.arange(len(rows))[1::2] >= len(rows) // 2  # of the second car
        parts['rear'][is_moving, 0] += CAR_SPEED * DELAY_NS / SECOND
        stamps = {'front': stamp, 'rear': stamp + DELAY_NS}
        if kind in ('topics', 'compressed'):
            for name, part in parts.items():
                ego = [SPEED * (stamps[name] - stamp) / SECOND, 0, 0]
                yield f'/{name}', m.points(stamps[name], name, part - ego - LIDARS[name])
            return
        yield '/points', m.points(stamp, 'base', np.concatenate(list(parts.values())))
        if kind == 'info':
            yield '/points_info', self.info(stamp, stamps, [len(p) for p in parts.values()])

    def info(self, stamp, stamps, lengths):
        """Return the info on a concatenated cloud."""
        begins = np.cumsum([0, *lengths])
        sources = [
            {
                'header': self.messages.header(at, name), 'topic': f'/{name}',
                'idx_begin': int(begin), 'length': length,
            }
            for (name, at), begin, length in zip(stamps.items(), begins, lengths, strict=False)
        ]  # fmt: skip
        header = self.messages.header(stamp, 'base')
        return self.messages.build(INFO, header=header, source_info=sources)


def compressed(messages, cloud, kind):
    """Return the CompressedPointCloud2 of a cloud with the fields x, y, z."""
    if kind == 'draco':
        encode = pytest.importorskip('DracoPy').encode
        points = cloud.data.view(np.float32).reshape(-1, 3)
        data = encode(points, quantization_bits=20, preserve_order=True)
    else:
        pack = {'zlib': zlib.compress, 'zstd': zstandard.ZstdCompressor().compress}[kind]
        data = pack(cloud.data.tobytes())
    copied = ('height', 'width', 'fields', 'is_bigendian', 'point_step', 'row_step', 'is_dense')
    fields = {name: getattr(cloud, name) for name in copied}
    return messages.make(
        COMPRESSED_TYPE, header=cloud.header, format=kind,
        compressed_data=np.frombuffer(data, np.uint8), **fields,
    )  # fmt: skip
