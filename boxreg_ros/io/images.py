"""Camera images of a recording: the one nearest in time to a stamp, and its camera model."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import suppress
from io import BytesIO
import re
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
PATTERNS = ('bayer_rggb8', 'bayer_bggr8', 'bayer_gbrg8', 'bayer_grbg8')
RAW_MODES = {
    **{'rgb8': 'RGB', 'bgr8': 'BGR', 'rgba8': 'RGBX', 'bgra8': 'BGRX', '8UC3': 'BGR'},
    **dict.fromkeys(('mono8', '8UC1', *PATTERNS), 'L'),
}
"""Raw encodings by the mode that Pillow reads them in; colour patterns are shown as grey."""
WIDE_GREY = ('mono16', '16UC1')
LUMINANCE = {'yuv422': 1, 'uyvy': 1, 'yuv422_yuy2': 0, 'yuyv': 0}
"""Encodings that are shown as grey, by the first byte of it."""
QUALITY = 90
RECTIFIED = {'rect', 'rectified'}
"""Words of the topics of images whose distortion is undone."""


class ImageCamera(NamedTuple):
    """A topic of images, and the model of its camera."""

    topic: str
    frame_id: str
    """Of the camera: x right, y down, z forward."""
    size: tuple[int, int]
    """Width and height of the images [px]; 0 where neither they nor a model state it."""
    matrix: Floats | None
    """(3, 4), projects points in `T_image_camera` [px]; None where no model was recorded."""
    distortion: Floats
    """(k,), coefficients of the model; empty for rectified images."""
    model: str
    """``plumb_bob``, ``rational_polynomial``, ``equidistant`` and the like."""
    info_topic: str = ''
    """Of the info that states the model; empty without one."""
    T_image_camera: Floats = np.eye(4)
    """Pose (4, 4) of the camera's frame in that of its images: rectified ones are turned."""


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
        self._infos = {
            name: first[2]
            for name in topics.filled(INFO_TYPES)
            if (first := next(self._messages({name}), None)) is not None
        }
        self.cameras: list[ImageCamera] = []
        for topic in topics.filled(IMAGE_TYPES):
            first = next(self._messages({topic}), None)
            if first is not None:
                received_ns, stamp_ns, message = first
                self._delays[topic] = received_ns - stamp_ns
                frame_id = _frame_of(message)
                self.cameras.append(self._camera(topic, frame_id, message))

    def without_images(self) -> list[ImageCamera]:
        """Return the cameras that have a model and no images."""
        known = {camera.info_topic for camera in self.cameras}
        frames = {camera.frame_id for camera in self.cameras}
        found = []
        for name, info in self._infos.items():
            frame_id = _frame_of(info)
            if name not in known and frame_id not in frames:
                bare = ImageCamera(name, frame_id, (0, 0), None, np.zeros(0), '')
                found.append(_with_model(bare, name, info, has_own_frame=True))
        return found

    def nearest(self, camera: ImageCamera, stamp_ns: int) -> Image:
        """
        Return the image of a camera nearest to a stamp.

        Parameters
        ----------
        camera : ImageCamera
            One of `cameras`.
        stamp_ns : int
            In the clock of the stamps of the images [ns].

        Returns
        -------
        image : Image
            With its own stamp; raw images are converted to JPEG.

        Raises
        ------
        RecordingError
            If there is none within the larger of `NEAR`.
        UnsupportedMessage
            If it has an encoding that is not known, or is damaged.
        ConfigError
            If a raw image needs a package that is not installed.

        """
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
        camera = ImageCamera(topic, frame_id, _size_of(message), None, np.zeros(0), '')
        infos = self._infos
        of_frame = [name for name, info in infos.items() if _frame_of(info) == frame_id]
        for own in (
            [name for name in infos if _parent(name) == _parent(topic)],
            [name for name in infos if _parent(name) == _parent(_parent(topic))],
            of_frame,
        ):
            if own:
                return _with_model(camera, own[0], infos[own[0]], len(of_frame) < 2)
        return camera


def _parent(topic: str) -> str:
    return topic.rpartition('/')[0]


def _frame_of(message: Any) -> str:
    return str(clouds.header_of(message).frame_id).lstrip('/')


def _size_of(message: Any) -> tuple[int, int]:
    """Return width and height of an image [px]; 0 for a file that Pillow is needed to read."""
    if hasattr(message, 'width'):
        return int(message.width), int(message.height)
    with suppress(ImportError, OSError):
        from PIL import Image as Picture

        with Picture.open(BytesIO(pointcloud.bytes_of(message.data))) as picture:
            return picture.size
    return 0, 0


def _stamp_of(record: Record, message: Any) -> int:
    with malformed(f'topic {record.connection.topic!r}'):
        return poses.stamp_ns(clouds.header_of(message))


def _with_model(
    camera: ImageCamera, info_topic: str, info: Any, has_own_frame: bool
) -> ImageCamera:
    """
    Return a camera with the model of a CameraInfo; ROS 1 and Foxglove write capitals.

    The fourth column of P counts where cameras share a frame, that of the first; the frame of a
    camera of its own is where it is.

    """

    def values(name: str) -> Floats:
        found = getattr(info, name, None)
        return np.asarray(getattr(info, name.upper()) if found is None else found, np.float64)

    is_rectified = not RECTIFIED.isdisjoint(re.split('[/_]', camera.topic))
    matrix, T_image_camera = np.zeros((3, 4)), np.eye(4)
    name, columns = ('p', 4) if is_rectified else ('k', 3)
    if values(name).size == 3 * columns:  # lists of Foxglove may be empty
        matrix[:, :columns] = values(name).reshape(3, columns)
    is_calibrated = np.isfinite(matrix).all() and np.linalg.matrix_rank(matrix[:, :3]) == 3
    if is_calibrated and not has_own_frame:
        T_image_camera[:3, 3] = np.linalg.solve(matrix[:, :3], matrix[:, 3])
    rotation = values('r')
    if is_rectified and rotation.size == 9 and rotation.any():
        T_image_camera[:3, :3] = rotation.reshape(3, 3)
    matrix[:, 3] = 0
    size, to_pixels = _pixels_of(camera.size, info)
    return camera._replace(
        size=size,
        matrix=to_pixels @ matrix if is_calibrated else None,
        distortion=np.zeros(0) if is_rectified else values('d').ravel(),
        model=str(info.distortion_model),
        info_topic=info_topic,
        T_image_camera=T_image_camera,
    )


def _pixels_of(size: tuple[int, int], info: Any) -> tuple[tuple[int, int], Floats]:
    """
    Return the size of images, and the matrix (3, 3) to their pixels from those of a CameraInfo.

    Its matrices are of the whole sensor: images may be of a region, binned, or made smaller. Where
    their own size, `size`, is 0, region and binning state it.

    """
    whole = int(info.width), int(info.height)
    region = getattr(info, 'roi', None)
    first, part = (0, 0), whole
    if region is not None and region.width and region.height:
        first, part = (region.x_offset, region.y_offset), (region.width, region.height)
    if not all(size):
        by_x, by_y = (getattr(info, f'binning_{axis}', 0) or 1 for axis in 'xy')
        size = part[0] // by_x, part[1] // by_y
    if size == whole or not all(part):
        return size, np.eye(3)
    scale = size[0] / part[0], size[1] / part[1]
    to_pixels = np.diag([*scale, 1.0])
    to_pixels[:2, 2] = -np.multiply(scale, first)
    return size, to_pixels


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
    mode = RAW_MODES.get(str(message.encoding))
    try:
        if mode is None:
            rows = data[: height * step].reshape(height, step)
            picture = Picture.fromarray(_grey(topic, message, rows, width))
        else:
            shown, size = 'L' if mode == 'L' else 'RGB', (width, height)
            picture = Picture.frombytes(shown, size, data, 'raw', mode, step)
    except ValueError as error:
        raise UnsupportedMessage(
            f'{topic}: expected {width} pixels in {step} bytes, got: {error}'
        ) from None
    file = BytesIO()
    picture.save(file, 'JPEG', quality=QUALITY)
    return file.getvalue()


def _grey(topic: str, message: Any, rows: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    """Return the pixels (h, w) of rows of bytes that Pillow does not read."""
    encoding = str(message.encoding)
    if encoding in WIDE_GREY:
        kind = '>u2' if getattr(message, 'is_bigendian', False) else '<u2'
        values = np.ascontiguousarray(rows[:, : 2 * width]).view(kind)
        return np.asarray(values / max(1, values.max()) * 255).astype(np.uint8)
    if encoding in LUMINANCE:
        return np.ascontiguousarray(rows[:, LUMINANCE[encoding] : 2 * width : 2])
    known = ', '.join((*RAW_MODES, *WIDE_GREY, *LUMINANCE))
    raise UnsupportedMessage(f'{topic}: expected an encoding of {known}, got {encoding!r}')
