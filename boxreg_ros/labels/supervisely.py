"""
Supervisely: a project of point cloud episodes.

``episode/annotation.json`` holds frames and objects, ``episode/pointcloud`` the clouds.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, uuid5

from boxreg_ros.labels import cuboids
from boxreg_ros.labels.files import following, from_json, JsonList, to_json, write_json
from boxreg_ros.labels.protocol import LabelFrame, Options, Provenance
from boxreg_ros.labels.records import ReadBox

FORMAT = cuboids.cuboid_format(
    name='supervisely',
    title='Supervisely episodes',
    files='meta.json, episode/annotation.json, episode/pointcloud/STAMP.pcd',
)
CUBOID = 'cuboid_3d'
TAGS = ('track_id', 'status')


class Writer(cuboids.CuboidWriter):
    """
    Write one record per frame, and the objects with their tags when closed.

    An object has its track id as a tag, and its status as tags over ranges of frames. A track
    that occurs twice in a frame has two figures there. A box without a track id is an object of
    one frame.

    """

    folders = ('episode/pointcloud',)
    cloud_file = 'episode/pointcloud/{name}.pcd'

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        super().__init__(folder, provenance, options)
        self._episode = folder / 'episode'
        head = {'description': to_json(self.about), 'key': _key('episode'), 'tags': []}
        self._records = JsonList(self._episode / 'annotation.json', head, 'frames')
        self._clouds: list[str] = []
        self._objects: dict[str, dict[str, Any]] = {}

    def add(self, frame: LabelFrame) -> None:
        """Add the record of a frame."""
        figures = []
        for cuboid in self.cuboids(frame):
            object_key = self._add_to_object(cuboid, self.number)
            figures.append(_figure(cuboid, self.number, object_key))
        self._records.append({'index': self.number, 'figures': figures})
        self._clouds.append(f'{self.name}.pcd')

    def finish(self) -> None:
        """Write the objects and the files of the project."""
        objects = list(self._objects.values())
        self._records.close({'objects': objects, 'framesCount': len(self._clouds)})
        classes = dict.fromkeys(item['classTitle'] for item in objects)
        write_json(self.folder / 'meta.json', _meta(classes))
        ids: dict[str, Any] = {kind: {} for kind in ('tags', 'objects', 'figures', 'videos')}
        write_json(self.folder / 'key_id_map.json', ids)
        write_json(self._episode / 'frame_pointcloud_map.json', dict(enumerate(self._clouds)))

    def _add_to_object(self, cuboid: cuboids.Cuboid, number: int) -> str:
        """Return the key of the object of a cuboid; add its status in frame `number`."""
        suffix = '' if cuboid.track_id else f'{number}/{cuboid.row}'
        key = _key(f'object/{cuboid.class_name}/{cuboid.track_id}/{suffix}')
        if key not in self._objects:
            tag = {'key': _key(f'{key}/track'), 'name': 'track_id', 'value': cuboid.track_id}
            self._objects[key] = {'key': key, 'classTitle': cuboid.class_name, 'tags': [tag]}
        tags = self._objects[key]['tags']
        status = cuboid.evidence['status']
        last = tags[-1]
        if last['name'] == 'status' and last['value'] == status:
            if last['frameRange'][1] == number - 1:
                last['frameRange'][1] = number
            if last['frameRange'][1] == number:
                return key
        tags.append(
            {
                'key': _key(f'{key}/{number}/{status}'),
                'name': 'status',
                'value': status,
                'frameRange': [number, number],
            }
        )
        return key


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the frames of an episode, or of the only episode of a project.

    ``timestamps.txt`` in the episode or in the project has one stamp [ns] per frame.

    """
    episode, folder = cuboids.single_part(path, 'episode', ['annotation.json'])
    file = episode / 'annotation.json'
    content = from_json(file)
    clouds = from_json(file.with_name('frame_pointcloud_map.json'))
    with following(file, 'cuboids of Supervisely'):
        objects = {item['key']: item for item in content['objects']}
        figures = {str(frame['index']): frame['figures'] for frame in content['frames']}
        boxes = {
            Path(cloud).stem: [
                _cuboid(figure, objects[figure['objectKey']])
                for figure in figures.get(index, ())
                if figure['geometryType'] == CUBOID
            ]
            for index, cloud in sorted(clouds.items(), key=lambda item: int(item[0]))
        }
    yield from cuboids.read_frames(folder, list(boxes), boxes.__getitem__)


def _cuboid(figure: dict[str, Any], parent: dict[str, Any]) -> ReadBox:
    """Return the cuboid of a figure; `parent` is its object."""
    tags = {tag['name']: tag.get('value') for tag in parent.get('tags', ())}
    geometry = figure['geometry']
    box = cuboids.box_from_xyz(geometry['position'], geometry['rotation'], geometry['dimensions'])
    track_id = str(tags.get('track_id', parent['key']))
    return ReadBox(track_id, parent['classTitle'], box, figure.get(cuboids.EVIDENCE_KEY, {}))


def _figure(cuboid: cuboids.Cuboid, number: int, object_key: str) -> dict[str, Any]:
    return {
        'key': _key(f'figure/{number}/{cuboid.row}'),
        'objectKey': object_key,
        'geometryType': CUBOID,
        'geometry': {
            'position': cuboid.position,
            'rotation': cuboid.angles,
            'dimensions': cuboid.extent,
        },
        cuboids.EVIDENCE_KEY: cuboid.evidence,
    }


def _meta(classes: Iterable[str]) -> dict[str, Any]:
    """Return the content of ``meta.json``: classes and tags of the project."""
    return {
        'classes': [
            {'title': title, 'shape': CUBOID, 'color': _colour(title), 'geometry_config': {}}
            for title in classes
        ],
        'tags': [
            {'name': name, 'value_type': 'any_string', 'color': _colour(name)} for name in TAGS
        ],
        'projectType': 'point_cloud_episodes',
    }


def _key(text: str) -> str:
    """Return a key that is the same in every run."""
    return uuid5(NAMESPACE_URL, text).hex


def _colour(text: str) -> str:
    """Return a colour that is the same in every run, as hexadecimal RGB."""
    return '#' + _key(text)[:6].upper()
