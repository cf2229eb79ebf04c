"""Camera images of a drive under review, and where the cameras were."""

from __future__ import annotations

from contextlib import ExitStack
from threading import Lock
from typing import Any

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.images import Image, ImageCamera, RecordedImages
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.transforms import inverse
from boxreg_ros.review.scene import DriveScene, DriveSource
from boxreg_ros.structures import Floats


class DriveImages:
    """The images of a recording; it is opened when they are first asked for, and stays open."""

    def __init__(self, source: DriveSource, scene: DriveScene) -> None:
        self._source = source
        self._scene = scene
        self._lock = Lock()
        self._opened = ExitStack()
        self._images: RecordedImages | None = None
        self._is_open = False

    def cameras(self, stamp_ns: int) -> list[dict[str, Any]]:
        """Return the cameras with their poses at a stamp; none for data sets."""
        return [
            {
                'topic': camera.topic,
                'size': camera.size,
                'matrix': camera.matrix,
                'distortion': camera.distortion,
                'model': camera.model,
                'pose': self._T_camera_fixed(camera, stamp_ns),
            }
            for camera in self._known()
        ]

    def image(self, index: int, stamp_ns: int) -> tuple[Image, Floats | None]:
        """
        Return the image of a camera nearest to a stamp, and T_camera_fixed (4, 4) at its stamp.

        Raises RecordingError if there is no such camera, or no image nearby.

        """
        cameras = self._known()
        if not 0 <= index < len(cameras):
            raise RecordingError(f'camera: expected one of {len(cameras)}, got {index}')
        with self._lock:
            assert self._images is not None
            found = self._images.nearest(cameras[index], stamp_ns)
        return found, self._T_camera_fixed(cameras[index], found.stamp_ns)

    def _known(self) -> list[ImageCamera]:
        with self._lock:
            if not self._is_open:
                recording = self._opened.enter_context(self._source.recording())
                if isinstance(recording, Recording):
                    self._images = recording.images()
                self._is_open = True
            return [] if self._images is None else self._images.cameras

    def _T_camera_fixed(self, camera: ImageCamera, stamp_ns: int) -> Floats | None:
        pose = self._scene.pose_of(camera.frame_id, stamp_ns)
        return None if pose is None else inverse(pose)
