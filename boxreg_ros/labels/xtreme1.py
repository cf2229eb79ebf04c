"""
Xtreme1: ``scene_1/lidar_point_cloud_0/FRAME.pcd`` with ``scene_1/result/FRAME.json``.

Upload the folder as a zip, with the option that it contains annotation results. Xtreme1 numbers
classes in its own data base, so the class names here are shown as those of a model.

"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from boxreg_ros.labels import cuboids
from boxreg_ros.labels.files import write_json
from boxreg_ros.labels.protocol import LabelFrame, Options, Provenance
from boxreg_ros.labels.records import ReadBox

FORMAT = cuboids.cuboid_format(
    name='xtreme1',
    title='Xtreme1',
    files='scene_1/result/STAMP.json, scene_1/lidar_point_cloud_0/STAMP.pcd',
)
LIDAR_FOLDER = 'lidar_point_cloud_0'
RESULT_FOLDER = 'result'
BOX_TYPE = '3D_BOX'


class Writer(cuboids.CuboidWriter):
    """
    Write one file of labels per frame, and one of points if they are requested.

    Frames without boxes get no file, because Xtreme1 refuses files without objects.

    """

    folders = (f'scene_1/{RESULT_FOLDER}', f'scene_1/{LIDAR_FOLDER}')
    cloud_file = f'scene_1/{LIDAR_FOLDER}/{{name}}.pcd'

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        super().__init__(folder, provenance, options)
        self._origin = dict(self.about)

    def add(self, frame: LabelFrame) -> None:
        """Write the file of a frame."""
        objects = [_object(cuboid, self.name) for cuboid in self.cuboids(frame)]
        if objects:
            path = self.folder / 'scene_1' / RESULT_FOLDER / f'{self.name}.json'
            write_json(path, {'objects': objects, cuboids.EVIDENCE_KEY: self._origin})


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the frames of a scene, or of a folder with one scene.

    ``timestamps.txt`` in either has one stamp [ns] per frame. Exports of Xtreme1 are read too if
    the ``result`` folder of the scene has one file per frame.

    """
    scene, folder = cuboids.single_part(path, 'scene', [RESULT_FOLDER, LIDAR_FOLDER])
    files = [*scene.glob(f'{RESULT_FOLDER}/*.json'), *scene.glob(f'{LIDAR_FOLDER}/*.pcd')]
    names = {file.stem for file in files}
    labels = scene / RESULT_FOLDER
    yield from cuboids.read_files(
        folder, labels, names, 'objects of Xtreme1', _cuboids, has_all=False
    )


def _object(cuboid: cuboids.Cuboid, frame_name: str) -> dict[str, Any]:
    return {
        'type': BOX_TYPE,
        'trackId': cuboid.track_id or f'{frame_name}-{cuboid.row}',
        'trackName': cuboid.track_id,
        'className': cuboid.class_name,
        'modelClass': cuboid.class_name,
        'modelConfidence': cuboid.evidence['score'],
        'contour': {
            'center3D': cuboid.position,
            'rotation3D': cuboid.angles,
            'size3D': cuboid.extent,
            'pointN': cuboid.evidence['num_points'],
            'points': [],
        },
        cuboids.EVIDENCE_KEY: cuboid.evidence,
    }


def _cuboids(content: Any) -> list[ReadBox]:
    parts = content if isinstance(content, list) else [content]
    objects = [item for part in parts for item in part['objects']]
    return [_cuboid(item) for item in objects if item.get('type', BOX_TYPE) == BOX_TYPE]


def _cuboid(item: dict[str, Any]) -> ReadBox:
    contour = item['contour']
    name = item.get('trackName')
    if cuboids.EVIDENCE_KEY not in item:  # an export of Xtreme1: every object has a trackId
        name = name or item['trackId']
    box = cuboids.box_from_xyz(contour['center3D'], contour['rotation3D'], contour['size3D'])
    evidence = {
        'score': item.get('modelConfidence'),
        'num_points': contour.get('pointN'),
        **item.get(cuboids.EVIDENCE_KEY, {}),
    }
    class_name = item.get('className') or item.get('modelClass') or ''
    return ReadBox(str(name or ''), str(class_name), box, evidence)
