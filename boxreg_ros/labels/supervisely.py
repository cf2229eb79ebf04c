"""
Supervisely: a project of point cloud episodes.

``episode/annotation.json`` holds frames and objects, ``episode/pointcloud`` the clouds.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, uuid5

from boxreg_ros.errors import RecordingError
from boxreg_ros.labels.cuboids import (
    box_from_cuboid,
    Cuboid,
    cuboid_format,
    cuboids_of,
    EVIDENCE_KEY,
    FrameNames,
    from_xyz,
    read_frames,
    ReadCuboid,
    single_part,
    write_points,
)
from boxreg_ros.labels.files import from_json, to_json
from boxreg_ros.labels.protocol import LabelFrame, Options, Provenance
from boxreg_ros.labels.sidecar import SidecarWriter

FORMAT = cuboid_format(
    name='supervisely',
    title='Supervisely episodes',
    files='meta.json, episode/annotation.json, episode/pointcloud/STAMP.pcd',
)
EPISODE_FOLDER = 'episode'
CUBOID = 'cuboid_3d'
TAGS = ('track_id', 'status')


class Writer:
    """
    Write one record per frame, and the objects with their tags when closed.

    An object has its track id as a tag, and its status as tags over ranges of frames. A track
    that occurs twice in a frame has two figures there. A box without a track id is an object of
    one frame.

    """

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._folder = folder
        self._episode = folder / EPISODE_FOLDER
        self._with_points = options.with_points
        self._names = FrameNames()
        self._sidecar = SidecarWriter(folder, provenance)
        (self._episode / 'pointcloud').mkdir(parents=True)
        self._file = (self._episode / 'annotation.json').open('w', encoding='utf-8')
        head = {'description': to_json(asdict(provenance)), 'key': _key('episode'), 'tags': []}
        self._file.write(to_json(head)[:-1] + ',\n"frames": [')
        self._frames: list[str] = []
        self._objects: dict[str, dict[str, Any]] = {}

    def write(self, frame: LabelFrame) -> None:
        """Add a frame."""
        number = len(self._frames)
        name = self._names.of(frame.refined.boxes.stamp_ns)
        figures = []
        for cuboid in cuboids_of(frame, self.dropped):
            object_key = self._add_to_object(cuboid, number)
            figures.append(_figure(cuboid, number, object_key))
        content = to_json({'index': number, 'figures': figures})
        separator = ',' if number else ''
        self._file.write(f'{separator}\n{content}')
        self._frames.append(f'{name}.pcd')
        if self._with_points:
            write_points(frame, self._episode / 'pointcloud' / f'{name}.pcd')
        self._sidecar.add(frame)

    def close(self) -> None:
        """Write the objects and the files of the project."""
        objects = to_json(list(self._objects.values()))
        count = len(self._frames)
        self._file.write(f'\n],\n"objects": {objects},\n"framesCount": {count}}}\n')
        self._file.close()
        classes = dict.fromkeys(item['classTitle'] for item in self._objects.values())
        _dump(self._folder / 'meta.json', _meta(classes))
        ids: dict[str, Any] = {kind: {} for kind in ('tags', 'objects', 'figures', 'videos')}
        _dump(self._folder / 'key_id_map.json', ids)
        _dump(self._episode / 'frame_pointcloud_map.json', dict(enumerate(self._frames)))
        self._sidecar.close()

    def _add_to_object(self, cuboid: Cuboid, number: int) -> str:
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

    Raises
    ------
    RecordingError
        If a file is missing or does not contain cuboids of Supervisely, or there are several
        episodes.

    """
    episode, folder = single_part(path, 'episode', ['annotation.json'])
    file = episode / 'annotation.json'
    content = from_json(file)
    clouds = from_json(file.with_name('frame_pointcloud_map.json'))
    try:
        objects = {item['key']: item for item in content['objects']}
        figures = {str(frame['index']): frame['figures'] for frame in content['frames']}
        cuboids = {
            Path(cloud).stem: [
                _cuboid(figure, objects[figure['objectKey']])
                for figure in figures.get(index, ())
                if figure['geometryType'] == CUBOID
            ]
            for index, cloud in sorted(clouds.items(), key=lambda item: int(item[0]))
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise RecordingError(f'{file}: expected cuboids of Supervisely: {error!r}') from None
    yield from read_frames(folder, list(cuboids), cuboids.__getitem__)


def _cuboid(figure: dict[str, Any], parent: dict[str, Any]) -> ReadCuboid:
    """Return the cuboid of a figure; `parent` is its object."""
    tags = {tag['name']: tag.get('value') for tag in parent.get('tags', ())}
    geometry = figure['geometry']
    box = box_from_cuboid(
        from_xyz(geometry['position']),
        from_xyz(geometry['rotation']),
        from_xyz(geometry['dimensions']),
    )
    track_id = str(tags.get('track_id', parent['key']))
    return ReadCuboid(track_id, parent['classTitle'], box, figure.get(EVIDENCE_KEY, {}))


def _figure(cuboid: Cuboid, number: int, object_key: str) -> dict[str, Any]:
    return {
        'key': _key(f'figure/{number}/{cuboid.row}'),
        'objectKey': object_key,
        'geometryType': CUBOID,
        'geometry': {
            'position': cuboid.position,
            'rotation': cuboid.angles,
            'dimensions': cuboid.extent,
        },
        EVIDENCE_KEY: cuboid.evidence,
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


def _dump(path: Path, content: Any) -> None:
    path.write_text(to_json(content) + '\n', encoding='utf-8')
