"""Camera images of a recording: the one nearest in time to a stamp, and its camera model."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import suppress
from io import BytesIO
from typing import Any, NamedTuple

from boxreg_ros.errors import ConfigError, RecordingError, UnsupportedMessage
from boxreg_ros.io.message_decoder import malformed, MessageDecoder
from boxreg_ros.io.storage.reader import Reader
from boxreg_ros.io.storage.record import Record
from boxreg_ros.io.topics import Topics
from boxreg_ros.structures import Floats
from msg_adapters import clouds, pointcloud, poses
import numpy as np
from numpy.typing import NDArray

IMAGE_TYPES = tuple(
    f'{package}/msg/{name}'
    for package, name in (
        ('sensor_msgs', 'Image'), ('sensor_msgs', 'CompressedImage'),
        ('foxglove_msgs', 'RawImage'), ('foxglove_msgs', 'CompressedImage'),
    )
)  # fmt: skip
INFO_TYPES = ('sensor_msgs/msg/CameraInfo', 'foxglove_msgs/msg/CameraCalibration')
NEAR = (0.15, 1.5)
"""Images are looked for so far around a stamp [s]: first nearby, then at a slow camera."""
MAGIC = {b'\xff\xd8\xff': 'image/jpeg', b'\x89PNG': 'image/png', b'RIFF': 'image/webp'}
"""Formats that browsers show, by the first bytes of a file."""
CHANNELS = {'rgb8': 'RGB', 'bgr8': 'BGR', 'rgba8': 'RGBX', 'bgra8': 'BGRX', '8UC3': 'BGR'}
"""Raw encodings of colours by the mode that Pillow reads them in."""
GREY = ('mono8', '8UC1', 'mono16', '16UC1')
PATTERNS = ('bayer_rggb8', 'bayer_bggr8', 'bayer_gbrg8', 'bayer_grbg8')
"""Raw encodings of one channel; colour patterns are shown as grey."""
QUALITY = 90


class ImageCamera(NamedTuple):
    """A topic of images, and the model of its camera."""

    topic: str
    frame_id: str
    """Of the camera: x right, y down, z forward."""
    size: tuple[int, int]
    """Width and height [px]; 0 without a model."""
    matrix: Floats | None
    """(3, 4), projects points in the camera's frame [px]; None where no model was recorded."""
    distortion: Floats
    """(k,), coefficients of the model; empty for rectified images."""
    model: str
    """``plumb_bob``, ``rational_polynomial``, ``equidistant`` and the like."""
    info_topic: str = ''
    """Of the info that states the model; empty without one."""


class Image(NamedTuple):
    """An image as a file that browsers show: stamp [ns], media type, and bytes."""

    stamp_ns: int
    media_type: str
    content: bytes


class RecordedImages:
    """The images of an open recording."""

    def __init__(self, topics: Topics, reader: Reader, decoder: MessageDecoder) -> None:
        self._topics = topics
        self._reader = reader
        self._decoder = decoder
        self._delays: dict[str, int] = {}  # of receive times after the stamps [ns]
        self.cameras: list[ImageCamera] = []
        for topic in topics.filled(IMAGE_TYPES):
            first = next(self._messages({topic}), None)
            if first is not None:
                received_ns, stamp_ns, message = first
                self._delays[topic] = received_ns - stamp_ns
                frame_id = str(clouds.header_of(message).frame_id).lstrip('/')
                self.cameras.append(self._camera(topic, frame_id, message))

    def without_images(self) -> list[ImageCamera]:
        """Return the cameras that have a model and no images."""
        known = {camera.info_topic for camera in self.cameras}
        frames = {camera.frame_id for camera in self.cameras}
        found = []
        for name in self._topics.filled(INFO_TYPES):
            first = next(self._messages({name}), None)
            if first is None or name in known:
                continue
            frame_id = str(clouds.header_of(first[2]).frame_id).lstrip('/')
            if frame_id not in frames:
                bare = ImageCamera(name, frame_id, (0, 0), None, np.zeros(0), '')
                found.append(_with_model(bare, name, first[2]))
        return found

    def nearest(self, camera: ImageCamera, stamp_ns: int) -> Image:
        """Return the image of a camera nearest to a stamp; RecordingError if none is in `NEAR`."""
        middle_ns = stamp_ns + self._delays[camera.topic]
        for seconds in NEAR:
            reach_ns = round(seconds * 1e9)
            part = middle_ns - reach_ns, middle_ns + reach_ns
            found = [(abs(one - stamp_ns), one, message)
                     for _, one, message in self._messages({camera.topic}, *part)]  # fmt: skip
            if found:
                _, own_ns, message = min(found, key=lambda one: one[0])
                return Image(own_ns, *_as_file(camera.topic, message))
        raise RecordingError(
            f'{camera.topic}: expected an image within {NEAR[-1]:g} s of {stamp_ns}, got none'
        )

    def _messages(
        self, topics: Collection[str], begin_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[tuple[int, int, Any]]:
        """Yield receive times, stamps and messages; those that cannot be read are left out."""
        connections = self._topics.connections(topics)
        for record in self._reader.messages(connections, begin_ns, end_ns):
            with suppress(UnsupportedMessage):
                message = self._decoder.message(record)
                yield record.received_ns, _stamp_of(record, message), message

    def _camera(self, topic: str, frame_id: str, message: Any) -> ImageCamera:
        """Return the camera of a topic by the info beside it, or of its frame."""
        size = (int(getattr(message, 'width', 0)), int(getattr(message, 'height', 0)))
        camera = ImageCamera(topic, frame_id, size, None, np.zeros(0), '')
        infos = [
            (name, next(self._messages({name}), None)) for name in self._topics.filled(INFO_TYPES)
        ]
        for is_own in (
            lambda name, _: _parent(name) in (_parent(topic), _parent(_parent(topic))),
            lambda _, info: str(clouds.header_of(info).frame_id).lstrip('/') == frame_id,
        ):
            for name, found in infos:
                if found is not None and is_own(name, found[2]):
                    return _with_model(camera, name, found[2])
        return camera


def _parent(topic: str) -> str:
    return topic.rpartition('/')[0]


def _stamp_of(record: Record, message: Any) -> int:
    with malformed(f'topic {record.connection.topic!r}'):
        return poses.stamp_ns(clouds.header_of(message))


def _with_model(camera: ImageCamera, info_topic: str, info: Any) -> ImageCamera:
    """Return a camera with the model of a CameraInfo; ROS 1 and Foxglove write capitals."""

    def values(name: str) -> Floats:
        found = getattr(info, name, None)
        return np.asarray(getattr(info, name.upper()) if found is None else found, np.float64)

    is_rectified = 'rect' in camera.topic
    matrix = np.zeros((3, 4))
    name, columns = ('p', 4) if is_rectified else ('k', 3)
    if values(name).size == 3 * columns:  # lists of Foxglove may be empty
        matrix[:, :columns] = values(name).reshape(3, columns)
    return camera._replace(
        size=(int(info.width), int(info.height)),
        matrix=matrix if matrix.any() else None,  # zeros: not calibrated
        distortion=np.zeros(0) if is_rectified else values('d').ravel(),
        model=str(info.distortion_model),
        info_topic=info_topic,
    )


def _as_file(topic: str, message: Any) -> tuple[str, bytes]:
    """Return the media type and the bytes of an image."""
    if hasattr(message, 'encoding'):
        return 'image/jpeg', _as_jpeg(topic, message)
    content = bytes(pointcloud.bytes_of(message.data))
    for magic, media_type in MAGIC.items():
        if content.startswith(magic):
            return media_type, content
    raise UnsupportedMessage(
        f'{topic}: expected images as JPEG, PNG or WebP, got {message.format!r}'
    )


def _as_jpeg(topic: str, message: Any) -> bytes:
    """Return a raw image as JPEG."""
    try:
        from PIL import Image as Picture
    except ImportError as error:
        raise ConfigError(f'raw images need Pillow: pip install pillow ({error})') from None
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(pointcloud.bytes_of(message.data), np.uint8)
    if len(data) < height * step or not height * width:
        raise UnsupportedMessage(
            f'{topic}: expected {height} rows of {step} bytes, got {len(data)} bytes'
        )
    rows = data[: height * step].reshape(height, step)
    picture = Picture.fromarray(_pixels(topic, message, rows, width))
    file = BytesIO()
    picture.save(file, 'JPEG', quality=QUALITY)
    return file.getvalue()


def _pixels(topic: str, message: Any, rows: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    """Return the pixels (h, w) or (h, w, 3) of rows of bytes."""
    encoding = str(message.encoding)
    if encoding in CHANNELS:
        mode = CHANNELS[encoding]
        pixels = rows[:, : width * len(mode)].reshape(len(rows), width, len(mode))
        order = [mode.index(channel) for channel in 'RGB']
        return np.ascontiguousarray(pixels[..., order])
    if encoding in (*GREY, *PATTERNS):
        if '16' not in encoding:
            return np.ascontiguousarray(rows[:, :width])
        kind = '>u2' if getattr(message, 'is_bigendian', False) else '<u2'
        values = np.ascontiguousarray(rows[:, : 2 * width]).view(kind)
        return np.asarray(values / max(1, values.max()) * 255).astype(np.uint8)
    if encoding in ('yuv422', 'uyvy', 'yuv422_yuy2', 'yuyv'):  # the luminance
        first = int(encoding in ('yuv422', 'uyvy'))
        return np.ascontiguousarray(rows[:, first : 2 * width : 2])
    known = ', '.join((*CHANNELS, *GREY, *PATTERNS))
    raise UnsupportedMessage(f'{topic}: expected an encoding of {known}, got {encoding!r}')
