"""
Supervisely projects of single clouds: ``ds0/ann/NAME.pcd.json`` with ``ds0/pointcloud/NAME.pcd``.

CVAT and Datumaro call the format Sly Point Cloud. An object has the same key in all clouds, from
which they take the track.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
import shutil
from tempfile import TemporaryFile
from typing import Any

from boxreg_ros.io.images import Image
from boxreg_ros.labels import cuboids
from boxreg_ros.labels.cameras import LabelCamera
from boxreg_ros.labels.files import at, following, from_json, to_json, visible, write_json
from boxreg_ros.labels.protocol import LabelFrame
from boxreg_ros.labels.records import ReadBox, TrackNumbers
from boxreg_ros.labels.sidecar import named_frames
from boxreg_ros.labels.supervisely import (
    boxes_of,
    figure_of,
    key_of,
    meta_of,
    objects_by_key,
    TAGS,
    write_calibrations,
)

FORMAT = replace(
    cuboids.CUBOID_FORMAT,
    name='sly_pointcloud',
    title='Supervisely clouds, CVAT Sly Point Cloud',
    files='meta.json, key_id_map.json, ds0/ann/STAMP.pcd.json, ds0/pointcloud/STAMP.pcd',
    reads='cuboids of a data set; those of a model or a tracker are marked; keyframes of CVAT',
    leaves_out='figures that are no cuboids',
    read_back='supervisely 6.74.51, datumaro 1.13.12',
)
ANNOTATION_FOLDER = 'ann'
ANNOTATION_SUFFIX = '.pcd.json'


class Writer(cuboids.CuboidWriter):
    """
    Write one file of labels per cloud, and the files of the project when closed.

    ``key_id_map.json`` has a number for each cloud, object and figure, without which Datumaro
    reads none.

    """

    folders = (f'ds0/{ANNOTATION_FOLDER}', 'ds0/pointcloud')
    cloud_file = 'ds0/pointcloud/{name}.pcd'
    image_file = 'ds0/related_images/{name}_pcd/{camera}.{suffix}'

    def begin(self) -> None:
        """Open the files."""
        self._classes: dict[str, None] = {}
        self._tracks = TrackNumbers()
        self._objects: dict[str, int] = {}
        self._first_keys: dict[str, str] = {}  # of the objects of a track, by its id
        self._tags: dict[str, None] = dict.fromkeys(TAGS)
        self._figures = 0
        # Figures are as many as boxes: their numbers wait in a file.
        self._figure_ids = TemporaryFile('w+', encoding='utf-8', dir=self.folder)  # noqa: SIM115
        self._cloud_ids = TemporaryFile('w+', encoding='utf-8', dir=self.folder)  # noqa: SIM115

    def add(self, frame: LabelFrame) -> None:
        """Write the file of a frame."""
        objects: dict[str, dict[str, Any]] = {}
        figures = []
        for cuboid in self.cuboids(frame):
            self._classes.setdefault(cuboid.class_name)
            item = self._object(cuboid, objects)
            objects[item['key']] = item
            figure = figure_of(cuboid, self.number, item['key'])
            # No tag: Datumaro would take its text for the number that it has of the object.
            figure[cuboids.EVIDENCE_KEY] = {'track_id': cuboid.track_id} | cuboid.evidence
            figures.append(figure)
            self._figure_ids.write(
                f'{"," if self._figures else ""}\n"{figure["key"]}": {self._figures}'
            )
            self._figures += 1
        key = key_of(f'cloud/{self.number}')
        self._cloud_ids.write(f'{"," if self.number else ""}\n"{key}": {self.number}')
        path = self.folder / 'ds0' / ANNOTATION_FOLDER / f'{self.name}{ANNOTATION_SUFFIX}'
        about = {'description': '', 'key': key, 'tags': []}
        write_json(path, about | {'objects': list(objects.values()), 'figures': figures})

    def add_images(self, images: Sequence[tuple[LabelCamera, Image, str]]) -> None:
        """Write the calibration beside each image of a frame."""
        write_calibrations(self.folder, images)

    def finish(self) -> None:
        """Write the files of the project."""
        write_json(self.folder / 'meta.json', meta_of(self._classes, 'point_clouds', self._tags))
        with (self.folder / 'key_id_map.json').open('w', encoding='utf-8') as file:
            file.write(f'{{"tags": {{}},\n"objects": {to_json(self._objects)}')
            for name, numbers in (('figures', self._figure_ids), ('videos', self._cloud_ids)):
                numbers.seek(0)
                file.write(f',\n"{name}": {{')
                shutil.copyfileobj(numbers, file)
                numbers.close()
                file.write('}')
            file.write('}\n')

    def _object(self, cuboid: cuboids.Cuboid, others: dict[str, Any]) -> dict[str, Any]:
        """Return the object of a cuboid, with its status and attributes as tags."""
        key = key_of(f'object/{cuboid.class_name}/{cuboid.track_id}')
        name = cuboid.track_id
        if not name or key in others:
            key = key_of(f'object/{self.number}/{cuboid.row}')
            name = ''
        elif self._first_keys.setdefault(name, key) != key:
            name = ''  # of another class before: no number may be of two objects
        if key not in self._objects:
            self._objects[key] = self._tracks.of(name)
        values = {'status': cuboid.evidence['status'], **cuboid.evidence.get('attributes', {})}
        tags = []
        for name, value in values.items():
            self._tags.setdefault(name)
            own_key = key_of(f'{key}/{self.number}/{name}')
            tags.append({'key': own_key, 'name': name, 'value': value})
        return {'key': key, 'classTitle': cuboid.class_name, 'tags': tags}


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the frames of a data set, or of the only one of a project.

    Their stamps [ns] are those of ``timestamps.txt`` in the data set or in the project, one per
    cloud, or the names of the clouds. Boxes have no track ids if no object is in two clouds.

    Parameters
    ----------
    path : Path
        Folder of the project or of the data set.

    Yields
    ------
    frame : LabelFrame
        One per cloud, in the order of the stamps.

    Raises
    ------
    RecordingError
        If a file is missing or does not follow the format.

    """
    dataset, folder = cuboids.single_part(path, 'data set', [ANNOTATION_FOLDER])
    boxes: dict[str, list[ReadBox]] = {}
    clouds_of: Counter[str] = Counter()  # of each object that states no track
    for file in visible(dataset / ANNOTATION_FOLDER, '*.json'):
        content = from_json(file)
        with following(file, 'cuboids of Supervisely'), at('annotation'):
            objects = objects_by_key(content)
            found = boxes_of(content.get('figures') or (), objects)
        boxes[Path(file.stem).stem] = found
        clouds_of.update({box.track_id for box in found} & set(map(str, objects)))
    if len(boxes) > 1 and max(clouds_of.values(), default=2) == 1:
        boxes = {
            name: [
                one._replace(track_id='') if one.track_id in clouds_of else one for one in found
            ]
            for name, found in boxes.items()
        }
    names = named_frames(folder, boxes)
    yield from cuboids.read_frames(folder, names, lambda name: (boxes[name], {}))
