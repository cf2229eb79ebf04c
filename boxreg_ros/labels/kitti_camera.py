"""The one camera that the formats of KITTI refer to: of a file, of the recording, or assumed."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from boxreg_ros.errors import ConfigError
from boxreg_ros.labels.camera import Camera
from boxreg_ros.labels.cameras import LabelCamera, LabelCameras
from boxreg_ros.labels.protocol import Options
import numpy as np

ASSUMED_SIZE = 1242
"""Width and height of the assumed camera [px]; chosen: the width of KITTI's."""
HALF_SIZE = ASSUMED_SIZE / 2
ASSUMED = Camera(
    np.array([[HALF_SIZE, 0, HALF_SIZE, 0], [0, HALF_SIZE, HALF_SIZE, 0], [0, 0, 1, 0]]),
    np.eye(3),
    np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]),
    (ASSUMED_SIZE, ASSUMED_SIZE),
)
"""At the origin of the LiDAR, along its x axis, with 90 degrees in both directions; chosen: boxes
of the front half, and the points around them, are in the image, so that trainers keep them."""


class KittiCamera:
    """
    The camera of a KITTI export.

    Parameters
    ----------
    options : Options
        `Options.camera` is a file, or a topic of the recording; by default it is the camera of the
        scene of a data set, or the only one of the recording. Without any it is assumed.
    form : str
        Name of the format, for messages.

    Attributes
    ----------
    camera : Camera
        For boxes in the frame of the clouds, or that of the last call of `in_frame`.

    Raises
    ------
    ConfigError
        If the file cannot be read, the recording has several cameras and none is chosen, or images
        are to be written beside the camera of a file.

    """

    def __init__(self, options: Options, form: str) -> None:
        self._options = options
        self._needed_by = f'format {form}'
        self._frame = ''
        self._label_camera: LabelCamera | None = None
        self.camera = self._choose()

    @property
    def is_assumed(self) -> bool:
        """Return whether the camera is made up."""
        return self.camera is ASSUMED

    @property
    def notes(self) -> list[str]:
        """Return that the camera is assumed, in words."""
        if not self.is_assumed:
            return []
        return [
            'no camera is known: one at the LiDAR that looks along its x axis is assumed, and the '
            'images of kitti_object are black; give the real one by --camera FILE, or a recording '
            'with a CameraInfo and its transform'
        ]

    def in_frame(self, sensor_frame: str) -> Camera:
        """Return the camera for boxes of a frame of the recording."""
        recording = self._options.recording
        if self._label_camera is not None and recording and sensor_frame != self._frame:
            topic = self._label_camera.image.topic
            with closing(LabelCameras(recording)) as cameras:
                self._take(cameras.only(sensor_frame, topic, self._needed_by), sensor_frame)
        return self.camera

    def used(self, cameras: Sequence[LabelCamera]) -> list[LabelCamera]:
        """Return the camera among those of the recording."""
        if self._label_camera is None:
            return []
        return [one for one in cameras if one.image.topic == self._label_camera.image.topic]

    def _choose(self) -> Camera:
        path, recording = self._options.camera, self._options.recording
        if path is not None and (recording is None or path.is_file()):
            return self._of_file(path)
        if recording is not None:
            with closing(LabelCameras(recording)) as cameras:
                frame = recording.sensor_frame()
                topic = '' if path is None else str(path)
                return self._take(cameras.only(frame, topic, self._needed_by), frame)
        return self._options.scene_camera or ASSUMED

    def _of_file(self, path: Path) -> Camera:
        if self._options.with_images:
            raise ConfigError(
                f'{self._needed_by}: expected --camera TOPIC, whose images --with-images writes, '
                f'got the file {str(path)!r}; leave one of them out'
            )
        return Camera.read(path)

    def _take(self, found: LabelCamera | None, sensor_frame: str) -> Camera:
        """Use a camera of the recording, and return its calibration."""
        self._frame = sensor_frame
        self._label_camera = found
        self.camera = ASSUMED if found is None else found.calibration()
        return self.camera
