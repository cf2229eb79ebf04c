"""
Supervisely: a project of point cloud episodes.

``episode/annotation.json`` holds frames and objects, ``episode/pointcloud`` the clouds.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, uuid5

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.images import Image
from boxreg_ros.labels import cuboids
from boxreg_ros.labels.attributes import attributes_from, TRUE
from boxreg_ros.labels.cameras import LabelCamera
from boxreg_ros.labels.files import (
    at,
    following,
    from_json,
    JsonList,
    to_json,
    visible,
    write_json,
)
from boxreg_ros.labels.protocol import (
    AUTOMATIC_STATUS,
    INPUT_STATUS,
    LabelFrame,
)
from boxreg_ros.labels.records import ReadBox
from boxreg_ros.structures import INTERPOLATED

FORMAT = replace(
    cuboids.CUBOID_FORMAT,
    name='supervisely',
    title='Supervisely episodes',
    files='meta.json, episode/annotation.json, episode/pointcloud/STAMP.pcd',
    reads='cuboids of an episode; those of a model or a tracker are marked',
    leaves_out='figures that are no cuboids',
    read_back='supervisely 6.74.51',
)
ANNOTATION_FILE = 'annotation.json'
CUBOID = 'cuboid_3d'
TAGS = ('track_id', 'status')
FIGURE_FIELDS = (*TAGS, 'keyframe')


class Writer(cuboids.CuboidWriter):
    """
    Write one record per frame, and the objects with their tags when closed.

    An object has its track id as a tag, and its status as tags over ranges of frames. A track
    that occurs twice in a frame has two figures there. A box without a track id is an object of
    one frame.

    """

    folders = ('episode/pointcloud',)
    cloud_file = 'episode/pointcloud/{name}.pcd'
    image_file = 'episode/related_images/{name}_pcd/{camera}.{suffix}'

    def begin(self) -> None:
        """Open the files."""
        self._episode = self.folder / 'episode'
        head = {'description': to_json(self.about), 'key': key_of('episode'), 'tags': []}
        self._records = JsonList(self._episode / ANNOTATION_FILE, head, 'frames')
        self._clouds: list[str] = []
        self._objects: dict[str, dict[str, Any]] = {}
        self._tags: dict[str, None] = dict.fromkeys(TAGS)

    def add(self, frame: LabelFrame) -> None:
        """Add the record of a frame."""
        figures = []
        for cuboid in self.cuboids(frame):
            object_key = self._add_to_object(cuboid, self.number)
            figures.append(figure_of(cuboid, self.number, object_key))
        self._records.append({'index': self.number, 'figures': figures})
        self._clouds.append(f'{self.name}.pcd')

    def finish(self) -> None:
        """Write the objects and the files of the project."""
        objects = list(self._objects.values())
        self._records.close({'objects': objects, 'framesCount': len(self._clouds)})
        classes = dict.fromkeys(item['classTitle'] for item in objects)
        write_json(self.folder / 'meta.json', meta_of(classes, 'point_cloud_episodes', self._tags))
        ids: dict[str, Any] = {kind: {} for kind in ('tags', 'objects', 'figures', 'videos')}
        write_json(self.folder / 'key_id_map.json', ids)
        write_json(self._episode / 'frame_pointcloud_map.json', dict(enumerate(self._clouds)))

    def _add_to_object(self, cuboid: cuboids.Cuboid, number: int) -> str:
        """Return the key of the object of a cuboid; add its tags in frame `number`."""
        suffix = '' if cuboid.track_id else f'{number}/{cuboid.row}'
        key = key_of(f'object/{cuboid.class_name}/{cuboid.track_id}/{suffix}')
        if key not in self._objects:
            tag = {'key': key_of(f'{key}/track'), 'name': 'track_id', 'value': cuboid.track_id}
            self._objects[key] = {'key': key, 'classTitle': cuboid.class_name, 'tags': [tag]}
        tags = self._objects[key]['tags']
        values = {'status': cuboid.evidence['status'], **cuboid.evidence.get('attributes', {})}
        for name, value in values.items():
            self._tags.setdefault(name)
            _tag(tags, name, value, number)
        return key

    def add_images(self, images: Sequence[tuple[LabelCamera, Image, str]]) -> None:
        """Write the calibration beside each image of a frame."""
        write_calibrations(self.folder, images)


def _tag(tags: list[dict[str, Any]], name: str, value: str, number: int) -> None:
    """Add a tag in frame `number`, or prolong its last one if that is of the frame before."""
    last = next((tag for tag in reversed(tags[1:]) if tag['name'] == name), None)
    if last and last['value'] == value and last['frameRange'][1] >= number - 1:
        last['frameRange'][1] = number
        return
    object_key = tags[0]['key']
    tags.append(
        {
            'key': key_of(f'{object_key}/{number}/{name}/{value}'),
            'name': name,
            'value': value,
            'frameRange': [number, number],
        }
    )


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the frames of an episode, or of the only episode of a project.

    Their stamps [ns] are those of ``timestamps.txt`` in the episode or in the project, one per
    frame, or the names of the clouds.

    Parameters
    ----------
    path : Path
        Folder of the project or of the episode.

    Yields
    ------
    frame : LabelFrame
        One per cloud, in the order of the stamps.

    Raises
    ------
    RecordingError
        If a file is missing or does not follow the format.

    """
    episodes = [*path.glob(ANNOTATION_FILE), *visible(path, f'*/{ANNOTATION_FILE}')]
    if not episodes and [*path.glob('ann/*.json'), *path.glob('*/ann/*.json')]:
        raise RecordingError(
            f'{path}: expected an episode with {ANNOTATION_FILE}, got a project of single clouds; '
            f'read it as sly_pointcloud'
        )
    episode, folder = cuboids.single_part(path, 'episode', [ANNOTATION_FILE])
    file = episode / ANNOTATION_FILE
    content = from_json(file)
    clouds = from_json(file.with_name('frame_pointcloud_map.json'))
    with following(file, 'cuboids of Supervisely'):
        figures = {str(frame['index']): frame['figures'] for frame in content['frames']}
        objects = objects_by_key(content)
        boxes = {}
        for index, cloud in sorted(clouds.items(), key=lambda item: int(item[0])):
            with at(f'frame {index}'):
                found = boxes_of(figures.get(index) or (), objects, int(index))
                boxes[Path(cloud).stem] = found
    yield from cuboids.read_frames(folder, list(boxes), lambda name: (boxes[name], {}))


def write_calibrations(folder: Path, images: Iterable[tuple[LabelCamera, Image, str]]) -> None:
    """Write the calibration beside images, which are at paths in a folder."""
    for camera, _, path in images:
        sensors = {
            'extrinsicMatrix': camera.T_camera_sensor[:3].ravel().tolist(),
            'intrinsicMatrix': camera.intrinsics.ravel().tolist(),
        }
        meta = {'deviceId': camera.name, 'sensorsData': sensors}
        write_json(folder / f'{path}.json', {'name': Path(path).name, 'meta': meta})


def objects_by_key(content: dict[str, Any]) -> dict[Any, dict[str, Any]]:
    """Return the objects of an annotation by their keys, and by the numbers of the server."""
    return {
        item[name]: item for item in content['objects'] for name in ('id', 'key') if name in item
    }


def boxes_of(
    figures: Iterable[dict[str, Any]], objects: dict[Any, dict[str, Any]], index: int = 0
) -> list[ReadBox]:
    """
    Return the cuboids of the figures of a frame; figures of other shapes are left out.

    Parameters
    ----------
    figures : iterable of dict
        As in the annotation.
    objects : dict of dict
        The objects of the figures, by key or id.
    index : int
        Of the frame, for tags that hold in a range of frames.

    Returns
    -------
    boxes : list of ReadBox
        In the frame of the cloud [m, rad].

    Raises
    ------
    ValueError
        If a figure has another layout; with its number.

    """
    boxes = []
    for number, figure in enumerate(figures):
        with at(f'figure {number}'):
            if figure['geometryType'] == CUBOID:
                key = figure['objectKey'] if 'objectKey' in figure else figure['objectId']
                boxes.append(_cuboid(figure, objects[key], key, index))
    return boxes


def _cuboid(figure: dict[str, Any], parent: dict[str, Any], key: Any, index: int) -> ReadBox:
    """Return the cuboid of a figure in the frame `index`; `parent` is its object."""
    tags = {tag['name']: tag.get('value') for tag in parent.get('tags') or ()}
    # Tags without a value are set by being there; those of objects may be for some frames.
    given = [
        (tag['name'], TRUE if tag.get('value') is None else tag['value'])
        for tag in (*(parent.get('tags') or ()), *(figure.get('tags') or ()))
        if _is_in(tag.get('frameRange'), index)
    ]
    geometry = figure['geometry']
    box = cuboids.box_from_xyz(geometry['position'], geometry['rotation'], geometry['dimensions'])
    attributes = attributes_from(dict(given), FIGURE_FIELDS)
    evidence = {'status': _status(figure, tags), 'attributes': attributes}
    evidence |= figure.get(cuboids.EVIDENCE_KEY, {})
    track_id = evidence.get('track_id', tags.get('track_id', key))
    return ReadBox(str(track_id), str(parent['classTitle'] or ''), box, evidence)


def _is_in(frames: Sequence[int] | None, index: int) -> bool:
    return not frames or frames[0] <= index <= frames[-1]


def _status(figure: dict[str, Any], tags: dict[str, Any]) -> str:
    """
    Return the status of a figure.

    Supervisely marks those that a model made and nobody changed by two flags, and those of a
    tracker by its number; exports of CVAT have its keyframes as a tag.

    """
    if str(tags.get('keyframe')).lower() == 'false':
        return INTERPOLATED
    is_of_model = figure.get('nnCreated') and figure.get('nnUpdated')
    is_of_tracker = figure.get('trackId') not in (None, '')
    return AUTOMATIC_STATUS if is_of_model or is_of_tracker else INPUT_STATUS


def figure_of(cuboid: cuboids.Cuboid, number: int, object_key: str) -> dict[str, Any]:
    """Return the figure of a cuboid in the frame `number`."""
    return {
        'key': key_of(f'figure/{number}/{cuboid.row}'),
        'objectKey': object_key,
        'geometryType': CUBOID,
        'geometry': {
            'position': cuboid.position,
            'rotation': cuboid.angles,
            'dimensions': cuboid.extent,
        },
        cuboids.EVIDENCE_KEY: cuboid.evidence,
    }


def meta_of(classes: Iterable[str], kind: str, tags: Iterable[str] = TAGS) -> dict[str, Any]:
    """Return the content of ``meta.json``: classes and tags of a project of a kind."""
    return {
        'classes': [
            {'title': title, 'shape': CUBOID, 'color': _colour(title), 'geometry_config': {}}
            for title in classes
        ],
        'tags': [
            {'name': name, 'value_type': 'any_string', 'color': _colour(name)} for name in tags
        ],
        'projectType': kind,
    }


def key_of(text: str) -> str:
    """Return a key that is the same in every run."""
    return uuid5(NAMESPACE_URL, text).hex


def _colour(text: str) -> str:
    """Return a colour that is the same in every run, as hexadecimal RGB."""
    return '#' + key_of(text)[:6].upper()
