"""
Supervisely: a project of point cloud episodes.

In it, ``episode/annotation.json`` has frames and objects, and ``episode/pointcloud`` the clouds.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, uuid5

from boxreg_ros.errors import RecordingError
from boxreg_ros.labels import Format, LabelFrame, Options, Provenance
from boxreg_ros.labels.cuboids import (
    box_of,
    cuboids_of,
    FrameNames,
    frames_in,
    numbers,
    OURS,
    part_of,
    write_points,
)
from boxreg_ros.labels.files import from_json, Timeline, to_json
from boxreg_ros.structures import Floats

FORMAT = Format(
    name='supervisely',
    title='Supervisely episodes',
    frame='sensor',
    reference='centre',
    sizes='length width height (x y z)',
    rotation='angles x y z, R = Rx Ry Rz',
    files='meta.json, episode/annotation.json, episode/pointcloud/STAMP.pcd',
    options=('with_points',),
)
EPISODE, CUBOID = 'episode', 'cuboid_3d'
TAGS = ('track_id', 'status')


class Writer:
    """
    Write frames as they come, and objects with their tags at the end.

    An object has its track id as a tag, and its status as tags over ranges of frames. One whose
    track is in a frame twice has two figures there; one without a track id is in one frame.

    """

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._folder, self._episode = folder, folder / EPISODE
        self._with_points = options.with_points
        self._names, self._timeline = FrameNames(), Timeline(folder, provenance)
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
        for c in cuboids_of(frame, self.dropped):
            alone = '' if c.track_id else f'{number}/{c.row}'
            key = _key(f'object/{c.class_name}/{c.track_id}/{alone}')
            self._note(key, c.track_id, c.class_name, c.evidence['status'], number)
            figures.append(
                {
                    'key': _key(f'figure/{number}/{c.row}'),
                    'objectKey': key,
                    'geometryType': CUBOID,
                    'geometry': {
                        'position': c.position,
                        'rotation': c.angles,
                        'dimensions': c.extent,
                    },
                    OURS: c.evidence,
                }
            )
        content = to_json({'index': number, 'figures': figures})
        self._file.write(f'{"," if number else ""}\n{content}')
        self._frames.append(f'{name}.pcd')
        if self._with_points:
            write_points(frame, self._episode / 'pointcloud' / f'{name}.pcd')
        self._timeline.add(frame)

    def close(self) -> None:
        """Write what is known only at the end."""
        objects = to_json(list(self._objects.values()))
        count = len(self._frames)
        self._file.write(f'\n],\n"objects": {objects},\n"framesCount": {count}}}\n')
        self._file.close()
        classes = dict.fromkeys(item['classTitle'] for item in self._objects.values())
        meta = {
            'classes': [
                {'title': title, 'shape': CUBOID, 'color': _colour(title), 'geometry_config': {}}
                for title in classes
            ],
            'tags': [
                {'name': name, 'value_type': 'any_string', 'color': _colour(name)} for name in TAGS
            ],
            'projectType': 'point_cloud_episodes',
        }
        _dump(self._folder / 'meta.json', meta)
        ids: dict[str, Any] = {kind: {} for kind in ('tags', 'objects', 'figures', 'videos')}
        _dump(self._folder / 'key_id_map.json', ids)
        _dump(self._episode / 'frame_pointcloud_map.json', dict(enumerate(self._frames)))
        self._timeline.close()

    def _note(self, key: str, track_id: str, class_name: str, status: str, number: int) -> None:
        """Remember an object, and its status in this frame."""
        item = self._objects.setdefault(
            key,
            {
                'key': key,
                'classTitle': class_name,
                'tags': [{'key': _key(f'{key}/track'), 'name': 'track_id', 'value': track_id}],
            },
        )
        last = item['tags'][-1]
        if last['name'] == 'status' and last['value'] == status:
            if last['frameRange'][1] == number - 1:
                last['frameRange'][1] = number
            if last['frameRange'][1] == number:
                return
        item['tags'].append(
            {
                'key': _key(f'{key}/{number}/{status}'),
                'name': 'status',
                'value': status,
                'frameRange': [number, number],
            }
        )


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the frames of an episode, or of a project's only one.

    ``timestamps.txt`` in the episode or in the project has a stamp [ns] per frame.

    Raises
    ------
    RecordingError
        If a file is missing or does not hold cuboids of Supervisely, or there are several
        episodes.

    """
    episode, folder = part_of(path, 'episode', ['annotation.json'])
    file = episode / 'annotation.json'
    content = from_json(file)
    clouds = from_json(file.with_name('frame_pointcloud_map.json'))
    try:
        objects = {item['key']: item for item in content['objects']}
        figures = {str(frame['index']): frame['figures'] for frame in content['frames']}
        items = {
            Path(cloud).stem: [
                _item(figure, objects[figure['objectKey']])
                for figure in figures.get(index, ())
                if figure['geometryType'] == CUBOID
            ]
            for index, cloud in sorted(clouds.items(), key=lambda item: int(item[0]))
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise RecordingError(
            f'{file}: expected cuboids as Supervisely has them: {error!r}'
        ) from None
    yield from frames_in(folder, list(items), items.__getitem__)


def _item(
    figure: dict[str, Any], parent: dict[str, Any]
) -> tuple[str, str, Floats, Mapping[str, Any]]:
    tags = {tag['name']: tag.get('value') for tag in parent.get('tags', ())}
    keys = ('position', 'rotation', 'dimensions')
    return (
        str(tags.get('track_id', parent['key'])),
        parent['classTitle'],
        box_of(*(numbers(figure['geometry'][key]) for key in keys)),
        figure.get(OURS, {}),
    )


def _key(text: str) -> str:
    """Return a key that is the same in every run."""
    return uuid5(NAMESPACE_URL, text).hex


def _colour(text: str) -> str:
    return '#' + _key(text)[:6].upper()


def _dump(path: Path, content: Any) -> None:
    path.write_text(to_json(content) + '\n', encoding='utf-8')
