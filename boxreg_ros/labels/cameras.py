"""The cameras of a recording for label files: their calibration, and the image of each frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from contextlib import ExitStack
from io import BytesIO
import struct
from typing import NamedTuple
import zlib

from boxreg_ros.errors import (
    ConfigError,
    RecordingError,
    TransformUnavailable,
    UnsupportedMessage,
)
from boxreg_ros.io.images import Image, ImageCamera
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.labels.camera import Camera
from boxreg_ros.structures import Floats
import numpy as np

LOOKS_UP = 0.9
"""Cosine between the optical axis of a camera and up, from which on nobody mounts one; chosen."""
SUFFIXES_OF_IMAGES = {'image/jpeg': 'jpg', 'image/png': 'png', 'image/webp': 'webp'}


class LabelCamera(NamedTuple):
    """A camera with a model, fixed to the LiDAR."""

    name: str
    """For names of files: its topic, with ``_`` for slashes."""
    image: ImageCamera
    T_camera_sensor: Floats
    """Pose (4, 4) of the label frame in that of the images of the camera."""

    @property
    def topics(self) -> tuple[str, str]:
        """Return the topics of the images and of the model."""
        return self.image.topic, self.image.info_topic

    @property
    def intrinsics(self) -> Floats:
        """Return the matrix (3, 3) from camera coordinates to homogeneous pixels."""
        assert self.image.matrix is not None
        return self.image.matrix[:, :3]

    def calibration(self) -> Camera:
        """Return the camera as the formats with image coordinates use it."""
        assert self.image.matrix is not None
        return Camera(self.image.matrix, np.eye(3), self.T_camera_sensor, self.image.size)


class LabelCameras:
    """
    The cameras of a recording, which stays open until `close`.

    Parameters
    ----------
    recording : Recording
        Of the labels, not open.

    Raises
    ------
    RecordingError
        If it cannot be read.

    """

    def __init__(self, recording: Recording) -> None:
        self._opened = ExitStack()
        self._recording = self._opened.enter_context(recording)
        self._images = recording.images()
        self._tree = TransformTree()
        recording.choose_fixed_frame(self._tree)
        self._of_frame: dict[str, list[LabelCamera]] = {}
        self.counts: Counter[str] = Counter()
        """Images written, and those that are missing or cannot be read, by topic."""
        self._first_errors: dict[str, str] = {}

    def close(self) -> None:
        """Close the recording."""
        self._opened.close()

    def only(self, sensor_frame: str, topic: str, needed_by: str) -> LabelCamera | None:
        """
        Return the only camera, or that of a topic.

        Cameras without images count where no camera has any.

        Parameters
        ----------
        sensor_frame : str
            Frame of the labels.
        topic : str
            Of the images, or of their CameraInfo; empty for the only camera.
        needed_by : str
            What needs the camera, for the error.

        Returns
        -------
        camera : LabelCamera or None
            None if there is no camera and no topic.

        Raises
        ------
        ConfigError
            If there are several cameras and no topic, or none of the topic.

        """
        start_ns = self._recording.start_ns
        known = self.known(sensor_frame, start_ns)
        others = self._with_pose(self._images.without_images(), sensor_frame, start_ns)
        found = known or others
        if topic:
            found = [one for one in (*known, *others) if topic in one.topics]
        if len(found) == 1:
            return found[0]
        if not found and not topic:
            return None
        topics = ', '.join(one.image.topic for one in (*known, *others)) or 'none'
        raise ConfigError(
            f'{needed_by}: expected the calibration of one camera, got '
            f'{"none of " + topic if topic else len(found)} in {self._recording}; cameras '
            f'with a CameraInfo and a transform: {topics}; give --camera TOPIC, or --camera FILE'
        )

    def known(self, sensor_frame: str, stamp_ns: int) -> list[LabelCamera]:
        """Return the cameras with a model whose pose in the frame of the labels is known."""
        if sensor_frame not in self._of_frame:
            cameras = self._images.cameras
            self._of_frame[sensor_frame] = self._with_pose(cameras, sensor_frame, stamp_ns)
        return self._of_frame[sensor_frame]

    def _with_pose(
        self, cameras: Iterable[ImageCamera], sensor_frame: str, stamp_ns: int
    ) -> list[LabelCamera]:
        """Return those of some cameras that have a model and a pose."""
        found = []
        for image in cameras:
            if image.matrix is None:
                continue
            try:
                T = self._tree.lookup(image.frame_id, sensor_frame, stamp_ns)
            except TransformUnavailable:
                continue  # it moves on the vehicle, or nobody says where it is
            name = image.topic.strip('/').replace('/', '_')
            found.append(LabelCamera(name, image, image.T_image_camera @ T))
        return found

    def images(
        self, cameras: Iterable[LabelCamera], stamp_ns: int, needs_png: bool = False
    ) -> list[tuple[LabelCamera, Image]]:
        """
        Return the image of each camera nearest to a stamp.

        Parameters
        ----------
        cameras : iterable of LabelCamera
            Some of `known`.
        stamp_ns : int
            Of the labels [ns].
        needs_png : bool
            Whether the format takes no images but PNG; others are converted.

        Returns
        -------
        images : list of (LabelCamera, Image)
            Without cameras that have no image nearby, or one that cannot be read; `counts` has
            their number, by topic.

        Raises
        ------
        ConfigError
            If an image has to be converted, and Pillow is not installed.

        """
        found = []
        for camera in cameras:
            topic = camera.image.topic
            try:
                image = self._images.nearest(camera.image, stamp_ns)
                found.append((camera, as_png(topic, image) if needs_png else image))
            except (RecordingError, UnsupportedMessage) as error:
                self.counts[f'{topic} missing'] += 1
                self._first_errors.setdefault(topic, str(error))
            else:
                self.counts[topic] += 1
        return found

    @property
    def notes(self) -> list[str]:
        """Return which images are missing, and why, in words."""
        used = {one.image.topic: one for known in self._of_frame.values() for one in known}
        others = [one.topic for one in self._images.cameras if one.topic not in used]
        notes = [
            f'{self.counts[f"{topic} missing"]:,} images are missing or cannot be read; first: '
            f'{error}'
            for topic, error in self._first_errors.items()
        ]
        notes += [
            f'images of {topic}: by its transform the camera looks up: {one.image.frame_id!r} is '
            f'no optical frame (x right, y down, z forward), which their header is to name'
            for topic, one in used.items()
            if one.T_camera_sensor[2, 2] > LOOKS_UP
        ]
        if others:
            notes.append(
                f'images of {", ".join(others)} are left out: expected a CameraInfo of their '
                f'frame, or beside them, and a transform to the clouds that stands still, got '
                f'none; record both'
            )
        elif not used:
            notes.append(
                'no image is written: expected a topic of images with a CameraInfo, got none'
            )
        return notes


def cameras_of(recording: Recording | None) -> LabelCameras:
    """Return the cameras of a recording; ConfigError where the labels have none."""
    if recording is None:
        raise ConfigError(
            '--with-images: expected a recording with camera images and a CameraInfo, got none'
        )
    return LabelCameras(recording)


def as_png(topic: str, image: Image) -> Image:
    """Return an image as PNG, for formats that take no other."""
    if image.media_type == 'image/png':
        return image
    try:
        from PIL import Image as Picture
    except ImportError as error:
        raise ConfigError(f'images as PNG need Pillow: pip install pillow ({error})') from None
    file = BytesIO()
    try:
        Picture.open(BytesIO(image.content)).save(file, 'PNG')
    except OSError as error:
        raise UnsupportedMessage(f'{topic}: expected a whole image, got: {error}') from None
    return image._replace(media_type='image/png', content=file.getvalue())


def black_png(width: int, height: int) -> bytes:
    """Return a PNG of black pixels."""
    rows = bytes(1 + (width + 7) // 8) * height  # of one bit a pixel, after the kind of filter
    chunks = [
        (b'IHDR', struct.pack('>IIBBBBB', width, height, 1, 0, 0, 0, 0)),
        (b'IDAT', zlib.compress(rows)),
        (b'IEND', b''),
    ]
    png = b'\x89PNG\r\n\x1a\n'
    for kind, data in chunks:
        checksum = zlib.crc32(kind + data)
        png += struct.pack('>I', len(data)) + kind + data + struct.pack('>I', checksum)
    return png
