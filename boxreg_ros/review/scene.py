"""Sweeps and images of a drive under review, read when its page first asks for them."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from tempfile import gettempdir
from threading import Condition, Lock, Thread
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.core.follow import follow_points, FollowedTrack, solved
from boxreg_ros.errors import BoxregError, RecordingError, remedy_of
from boxreg_ros.io.fixed_frame import FixedFrameItems
from boxreg_ros.io.images import Image, ImageCamera, RecordedImages
from boxreg_ros.io.items import Item, ItemSource
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.sweep_store import SweepStore
from boxreg_ros.io.transforms import inverse
from boxreg_ros.review.track_points import SHOWN_MARGIN
from boxreg_ros.rotations import interpolate_rotation, matrix_from_rpy, quaternion_from_matrix
from boxreg_ros.structures import BOX_EXTENT, BoxArray, Floats, ROLL, Sweep, Z
from msg_adapters.convention import Convention
import numpy as np
from numpy.typing import NDArray

GRAIN = 0.03
"""Of accumulated points one is kept in each cube of this edge [m]; chosen: range noise."""


@dataclass(frozen=True, slots=True)
class DriveSource:
    """The recording of a result."""

    recording: Callable[[], AbstractContextManager[ItemSource]]
    """Returns the recording, not yet entered."""
    convention: Convention
    """Of its boxes."""
    fixed_frame: str
    """Of the result."""
    config: Config
    """Of the result."""
    formats: Callable[[], Mapping[str, str]] = dict
    """Returns the label formats that can be written, each with its title."""
    chosen: Sequence[str] = ()
    """Those of the result."""


class DriveScene:
    """The sweeps of a drive in the fixed frame, read in a thread that callers wait for."""

    def __init__(self, source: DriveSource) -> None:
        self._source = source
        self._store = SweepStore()
        self._origins: list[Floats] = []
        self._headings: list[float] = []
        self._poses: dict[str, list[Floats | None]] = {}  # by frame, of each sweep
        self._changed = Condition()
        self._is_begun = self._is_done = False
        self._error = ''

    def sweep(self, stamp_ns: int) -> tuple[int, Floats, NDArray[np.float32], Floats]:
        """
        Return the sweep nearest to a stamp.

        Parameters
        ----------
        stamp_ns : int
            Of a box array [ns].

        Returns
        -------
        stamp_ns : int
            Of the sweep [ns].
        origin : array, shape (3,)
            In the fixed frame [m]; the points are relative to it.
        points : array of float32, shape (M, 3)
            Along the axes of the fixed frame [m].
        sensor : array, shape (4,)
            Position and heading of the sensor in the fixed frame [m, rad].

        Raises
        ------
        RecordingError
            If the recording cannot be read.

        """
        with self._changed:
            self._wait(stamp_ns)
            row = self._row(stamp_ns)
            assert self._store.origin is not None
            sensor = np.append(self._origins[row], self._headings[row])
            return self._store.stamps_ns[row], self._store.origin, self._store[row], sensor

    def follow(self, seeds: Sequence[BoxArray], grows: bool = False) -> FollowedTrack:
        """
        Follow an object from its boxes, and solve its track.

        Parameters
        ----------
        seeds : sequence of BoxArray
            Boxes of one object in the fixed frame, an array each.
        grows : bool
            Whether a single box may grow to the points of the track.

        Returns
        -------
        track : FollowedTrack
            In the fixed frame.

        Raises
        ------
        RecordingError
            If the recording cannot be read, or no seed can be followed.

        """
        with self._changed:
            self._wait(None)
        origin = self._store.origin
        assert origin is not None
        offset = np.append(origin, np.zeros(6))
        config = self._source.config
        stamps_ns = np.array(self._store.stamps_ns, np.int64)
        moved = [replace(seed, boxes=seed.boxes - offset) for seed in seeds]
        (track,) = follow_points(stamps_ns, self._store, moved, config, grows=grows)
        if not len(track.rows):
            raise RecordingError('; '.join(track.problems))
        origins = np.array(self._origins) - origin
        (found,) = solved([track], self._store, config, origins)
        return replace(found, boxes=found.boxes + offset)

    def near(self, stamps_ns: Sequence[int], boxes: Floats) -> list[Floats]:
        """
        Return the points near each box of a track.

        Parameters
        ----------
        stamps_ns : sequence of n int
            Of the boxes [ns]; at least one.
        boxes : array, shape (n, 9)
            In the fixed frame [m, rad].

        Returns
        -------
        points : list of n arrays, shape (M_i, 3)
            Of the sweep nearest to each stamp, up to `SHOWN_MARGIN` outside of the box, in the
            frame of the box [m].

        Raises
        ------
        RecordingError
            If the recording cannot be read.

        """
        with self._changed:
            self._wait(max(stamps_ns))
            rows = [self._row(stamp_ns) for stamp_ns in stamps_ns]
        assert self._store.origin is not None
        R = matrix_from_rpy(boxes[:, ROLL:])
        centers = boxes[:, : Z + 1] - self._store.origin
        found = []
        for row, center, turn, extent in zip(rows, centers, R, boxes[:, BOX_EXTENT], strict=True):
            half = extent / 2 + SHOWN_MARGIN
            points = self._store[row]
            reach = np.linalg.norm(half)
            first, last = np.searchsorted(points[:, 0], [center[0] - reach, center[0] + reach])
            local = (points[first:last] - center) @ turn
            found.append(local[(np.abs(local) < half).all(1)])
        return found

    def sensors_at(self, stamps_ns: Sequence[int]) -> Floats:
        """Return the positions of the sensor (n, 3) of the sweeps nearest to some stamps [m]."""
        with self._changed:
            self._wait(max(stamps_ns))
            return np.array([self._origins[self._row(stamp_ns)] for stamp_ns in stamps_ns])

    def pose_of(self, frame_id: str, stamp_ns: int) -> Floats | None:
        """
        Return the pose of the frame of a camera in the fixed frame.

        Parameters
        ----------
        frame_id : str
            Of the camera.
        stamp_ns : int
            Between the poses at the two sweeps around it, the pose is interpolated [ns].

        Returns
        -------
        T_fixed_camera : array, shape (4, 4), or None
            None if it is known at neither of them.

        Raises
        ------
        RecordingError
            If the recording cannot be read.

        """
        with self._changed:
            self._wait(stamp_ns)
            poses, stamps_ns = self._poses.get(frame_id), self._store.stamps_ns
            after = bisect_left(stamps_ns, stamp_ns)
            rows = sorted({max(0, after - 1), min(after, len(stamps_ns) - 1)})
            around = [] if poses is None else [poses[row] for row in rows]
        known = [pose for pose in around if pose is not None]
        if len(known) < 2:
            return known[0] if known else None
        begin_ns, end_ns = (stamps_ns[row] for row in rows)
        part = (stamp_ns - begin_ns) / (end_ns - begin_ns)
        pose = np.eye(4)
        pose[:3, 3] = (1 - part) * known[0][:3, 3] + part * known[1][:3, 3]
        first, second = (quaternion_from_matrix(one[:3, :3]) for one in known)
        pose[:3, :3] = interpolate_rotation(first, second, part)
        return pose

    def _row(self, stamp_ns: int) -> int:
        return int(np.abs(np.array(self._store.stamps_ns, np.int64) - stamp_ns).argmin())

    def _wait(self, stamp_ns: int | None) -> None:
        """Wait until sweeps up to a stamp, or all of them, have been read."""
        if not self._is_begun:
            self._is_begun = True
            Thread(target=self._read, daemon=True).start()
        self._changed.wait_for(lambda: self._is_done or self._has_read(stamp_ns))
        if not self._store.stamps_ns:
            raise RecordingError(self._error or 'recording: expected sweeps, got none')
        if self._error and not self._has_read(stamp_ns):
            raise RecordingError(self._error)

    def _has_read(self, stamp_ns: int | None) -> bool:
        stamps_ns = self._store.stamps_ns
        return stamp_ns is not None and bool(stamps_ns) and stamps_ns[-1] > stamp_ns

    def _read(self) -> None:
        source = self._source
        self._error = 'recording: expected sweeps to its end, got an error; see the terminal'
        try:
            with source.recording() as recording:
                items = FixedFrameItems(
                    recording, source.config, source.convention, source.fixed_frame
                )
                if isinstance(recording, Recording):
                    self._poses = {one.frame_id: [] for one in recording.images().cameras}
                for item in items.read():
                    if isinstance(item.moved, Sweep):
                        self._add(item.moved, item, items)
            self._error = ''
        except BoxregError as error:
            self._error = str(error)
        except OSError as error:
            self._error = (
                f'{gettempdir()}: the sweeps cannot be kept there: {error.strerror}; '
                f'{remedy_of(error)}, or set TMPDIR to another folder'
            )
        finally:
            with self._changed:
                self._is_done = True
                self._changed.notify_all()

    def _add(self, sweep: Sweep, item: Item, items: FixedFrameItems) -> None:
        heading = self._headings[-1] if self._headings else 0.0
        if item.T_fixed_item is not None:
            heading = float(np.arctan2(item.T_fixed_item[1, 0], item.T_fixed_item[0, 0]))
        with self._changed:
            count = len(self._store)
            self._store.add(sweep)
            if len(self._store) > count:
                self._origins.append(sweep.origin)
                self._headings.append(heading)
                for frame_id, poses in self._poses.items():
                    poses.append(items.pose_of(frame_id, sweep.stamp_ns))
            self._changed.notify_all()


class DriveImages:
    """The images of a recording; it is opened when they are first asked for, and stays open."""

    def __init__(self, source: DriveSource, scene: DriveScene) -> None:
        self._source = source
        self._scene = scene
        self._lock = Lock()
        self._opened = ExitStack()

    def cameras(self, stamp_ns: int) -> list[dict[str, Any]]:
        """Return the cameras with their poses at a stamp; none for data sets."""
        return [
            {
                'topic': camera.topic,
                'size': camera.size,
                'matrix': camera.matrix,
                'distortion': camera.distortion,
                'model': camera.model,
                'pose': self._T_image_fixed(camera, stamp_ns),
            }
            for camera in self._known()
        ]

    def image(self, index: int, stamp_ns: int) -> tuple[Image, Floats | None]:
        """
        Return the image of a camera nearest to a stamp.

        Parameters
        ----------
        index : int
            Of the camera in the list of the page.
        stamp_ns : int
            Of a sweep or box array [ns].

        Returns
        -------
        image : Image
            With its own stamp.
        T_image_fixed : array, shape (4, 4), or None
            Pose of the fixed frame in that of the camera, at the stamp of the image; None if
            unknown.

        Raises
        ------
        RecordingError
            If there is no such camera, or no image nearby.

        """
        cameras = self._known()
        if not 0 <= index < len(cameras):
            raise RecordingError(f'camera: expected one of {len(cameras)}, got {index}')
        with self._lock:
            assert self._images is not None
            found = self._images.nearest(cameras[index], stamp_ns)
        return found, self._T_image_fixed(cameras[index], found.stamp_ns)

    def _known(self) -> list[ImageCamera]:
        with self._lock:
            return [] if self._images is None else self._images.cameras

    @cached_property
    def _images(self) -> RecordedImages | None:
        recording = self._opened.enter_context(self._source.recording())
        return recording.images() if isinstance(recording, Recording) else None

    def _T_image_fixed(self, camera: ImageCamera, stamp_ns: int) -> Floats | None:
        pose = self._scene.pose_of(camera.frame_id, stamp_ns)
        return None if pose is None else camera.T_image_camera @ inverse(pose)


def thinned(points: Sequence[Floats]) -> Floats:
    """Return points (M, 3) of several sweeps, one in each cube of the edge `GRAIN`."""
    every = np.concatenate([np.zeros((0, 3)), *points])
    _, first = np.unique(np.floor(every / GRAIN).astype(np.int32), axis=0, return_index=True)
    return np.asarray(every[first])
