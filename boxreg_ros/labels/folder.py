"""What the writers of folders share, so that each format is its mapping and little else."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing, ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar, TextIO

from boxreg_ros.io.images import Image
from boxreg_ros.labels.arrow import Table
from boxreg_ros.labels.cameras import cameras_of, LabelCamera, LabelCameras, SUFFIXES_OF_IMAGES
from boxreg_ros.labels.class_names import ClassNames
from boxreg_ros.labels.clouds import write_cloud
from boxreg_ros.labels.files import write_provenance
from boxreg_ros.labels.kitti_camera import KittiCamera
from boxreg_ros.labels.protocol import LabelFrame, Options, Provenance
from boxreg_ros.labels.sidecar import POSES_FILE, STAMPS_FILE
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import ADDED, HUMAN
import numpy as np

NO_POINTS = np.zeros((0, 3))
NOTED_STATUS = (HUMAN, *ADDED)
"""Status that later steps act on, noted in ``boxreg.json`` by formats without a place for it."""


class FolderWriter:
    """
    Write a scene frame by frame: labels by `add`, clouds, and ``boxreg.json``.

    A format derives from it, states the class attributes and implements `add`; one with files of
    the whole scene also `begin` and `finish`. Of the current frame, `number` counts from 0, and
    `name` sorts by time. `files` are open until the writer is closed; `about` is the content of
    ``boxreg.json``: the provenance, then the names of frames.

    """

    folders: ClassVar[tuple[str, ...]] = ()
    """To create."""
    cloud_file: ClassVar[str] = ''
    """Of the cloud of a frame, with the fields ``name`` and ``number``; empty for none."""
    image_file: ClassVar[str] = ''
    """
    Of the image of a frame, with the fields ``camera``, ``channel`` (in capitals), ``index`` (from
    0), ``name``, ``number`` and ``suffix``; empty for none. One that ends in ``.png`` takes no
    other format.
    """
    needs_clouds: ClassVar[bool] = False
    """Whether a frame without a cloud gets an empty file, because the tool needs one."""
    needs_pose: ClassVar[bool] = False
    """Whether frames without a pose of the sensor are dropped."""
    form: ClassVar[str] = ''
    """Name of the format, by which class names are translated; empty if they stay as given."""
    has_sidecar: ClassVar[bool] = False
    """Whether stamps and poses are written beside the labels, as in `sidecar`."""
    has_kitti_camera: ClassVar[bool] = False
    """Whether boxes refer to one camera, `kitti_camera`, and images are of this one alone."""

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self.folder = folder
        self.options = options
        self.provenance = provenance
        self.number = 0
        self.name = ''
        self.about: dict[str, Any] = asdict(provenance)
        self._used_stamps: Counter[int] = Counter()
        self.files = ExitStack()
        if self.has_kitti_camera:
            self.kitti_camera = KittiCamera(options, self.form)
        self.class_names = ClassNames(self.form, options.class_map if self.form else None)
        self.cameras: LabelCameras | None = None
        if options.with_images and self.image_file:
            self.cameras = cameras_of(options.recording)
            self.files.callback(self.cameras.close)
        self._with_points = options.with_points and self.cloud_file != ''
        for name in self.folders:
            (folder / name).mkdir(parents=True)
        if self._with_points:
            (folder / self.cloud_file).parent.mkdir(parents=True, exist_ok=True)
        if self.has_sidecar:
            self._stamps_file = self.text_file(STAMPS_FILE)
            self._poses_file = self.text_file(POSES_FILE)
        self.begin()

    def begin(self) -> None:
        """Open the files of the labels, before the first frame."""

    @property
    def notes(self) -> list[str]:
        """Return what was assumed, and what programs that read the files leave out."""
        assumed = self.kitti_camera.notes if self.has_kitti_camera else []
        images = self.cameras.notes if self.cameras is not None else []
        return assumed + images + self.class_names.notes()

    def write(self, frame: LabelFrame) -> None:
        """Add a frame."""
        T = frame.T_fixed_sensor
        if self.needs_pose and T is None:
            rows, _ = frame.boxes_in('fixed', self.dropped)
            self.dropped[Reason.NO_TRANSFORM] += len(rows)
            return
        stamp_ns = frame.refined.boxes.stamp_ns
        self.name = frame_name(stamp_ns, self._used_stamps)
        self.about['fixed_frame'] = frame.fixed_frame
        self.about['sensor_frame'] = frame.sensor_frame
        if self.cameras is not None:
            self._add_images(self.cameras, frame)
        self.add(frame)
        if self._with_points and (self.needs_clouds or frame.sweep is not None):
            path = self.cloud_file.format(name=self.name, number=self.number)
            self.add_cloud(self.folder / path, frame)
        if self.has_sidecar:
            values = np.full((3, 4), np.nan) if T is None else T[:3]
            self._stamps_file.write(f'{stamp_ns}\n')
            self._poses_file.write(' '.join(map(repr, values.ravel().tolist())) + '\n')
        self.number += 1

    def _add_images(self, cameras: LabelCameras, frame: LabelFrame) -> None:
        """Write the image of each camera that is nearest to a frame."""
        stamp_ns = frame.refined.boxes.stamp_ns
        used = cameras.known(frame.sensor_frame, stamp_ns)
        if self.has_kitti_camera:
            used = self.kitti_camera.used(used)
        if self.number == 0:
            for camera in used:
                self.add_camera(camera)
        images = []
        needs_png = self.image_file.endswith('.png')
        for camera, image in cameras.images(used, stamp_ns, needs_png):
            path = self.image_file.format(
                camera=camera.name,
                channel=f'CAM_{camera.name.upper()}',
                index=used.index(camera),
                name=self.name,
                number=self.number,
                suffix=SUFFIXES_OF_IMAGES[image.media_type],
            )
            (self.folder / path).parent.mkdir(parents=True, exist_ok=True)
            (self.folder / path).write_bytes(image.content)
            images.append((camera, image, path))
        self.add_images(images)
        self.about['images'] = dict(cameras.counts)

    def add_camera(self, camera: LabelCamera) -> None:
        """Write the calibration of a camera, where it is the same for all frames."""

    def add_images(self, images: Sequence[tuple[LabelCamera, Image, str]]) -> None:
        """Write, or hold for `add`, what belongs to the images of a frame at their paths."""

    def text_file(self, name: str) -> TextIO:
        """Open a text file of the folder, which is closed at the end."""
        return self.files.enter_context((self.folder / name).open('w', encoding='utf-8'))

    def table(self, name: str, columns: Mapping[str, str], origin: str = '') -> Table:
        """Open a table of the folder, as `Table`, which is closed at the end."""
        return self.files.enter_context(closing(Table(self.folder / name, columns, origin)))

    def add(self, frame: LabelFrame) -> None:
        """Write the labels of a frame; `number` and `name` are its own."""
        raise NotImplementedError

    def add_cloud(self, path: Path, frame: LabelFrame) -> None:
        """Write the cloud of a frame."""
        points = NO_POINTS if frame.sweep is None else frame.sweep.points
        write_cloud(path, points, frame.intensities)

    def note_status(self, track: str, status: str) -> None:
        """Note a status of `NOTED_STATUS` of a track in this frame, see `noted`."""
        if status in NOTED_STATUS:
            self.note('status', status, track)

    def note(self, what: str, value: str, track: str) -> None:
        """Note a value of a track in this frame under a key of ``boxreg.json``, see `noted`."""
        of_value = self.about.setdefault(what, {}).setdefault(value, {})
        of_value.setdefault(track, []).append(self.number)

    def finish(self) -> None:
        """Complete the labels, before their files are closed."""

    def close(self) -> None:
        """Complete the files."""
        self.finish()
        self.files.close()
        if self.class_names.translated:
            self.about['class_names'] = self.class_names.translated
        if self.class_names.uncounted:
            self.about['uncounted'] = dict(self.class_names.uncounted)
        write_provenance(self.folder, self.about)


def noted(about: Mapping[str, Any], what: str) -> dict[tuple[str, int], str]:
    """Return the values by track and frame that `FolderWriter.note` has noted."""
    return {
        (track, number): value
        for value, frames in about.get(what, {}).items()
        for track, numbers in frames.items()
        for number in numbers
    }


def frame_name(stamp_ns: int, used: Counter[int]) -> str:
    """Return a name that sorts by time: the stamp [ns]; one that is `used` before gets ``_1``."""
    number = used[stamp_ns]
    used[stamp_ns] += 1
    name = f'{stamp_ns:019d}'
    return f'{name}_{number}' if number else name
