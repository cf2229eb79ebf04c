"""
Xtreme1: ``scene_1/lidar_point_cloud_0/FRAME.pcd`` with ``scene_1/result/FRAME.json``.

Upload the folder as a zip, with the option that it contains annotation results. Xtreme1 numbers
classes in its own data base, so the class names here are shown as those of a model.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

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
    name='xtreme1',
    title='Xtreme1',
    files='scene_1/result/STAMP.json, scene_1/lidar_point_cloud_0/STAMP.pcd',
)
SCENE_FOLDER = 'scene_1'
CLOUDS_FOLDER = 'lidar_point_cloud_0'
RESULT_FOLDER = 'result'
BOX_TYPE = '3D_BOX'


class Writer:
    """
    Write one file of labels per frame, and one of points if they are requested.

    Frames without boxes get no file, because Xtreme1 refuses files without objects.

    """

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._with_points = options.with_points
        self._provenance = asdict(provenance)
        self._names = FrameNames()
        self._sidecar = SidecarWriter(folder, provenance)
        self._scene = folder / SCENE_FOLDER
        for name in (RESULT_FOLDER, CLOUDS_FOLDER):
            (self._scene / name).mkdir(parents=True)

    def write(self, frame: LabelFrame) -> None:
        """Add a frame."""
        name = self._names.of(frame.refined.boxes.stamp_ns)
        objects = [_object(cuboid, name) for cuboid in cuboids_of(frame, self.dropped)]
        if objects:
            path = self._scene / RESULT_FOLDER / f'{name}.json'
            content = {'objects': objects, EVIDENCE_KEY: self._provenance}
            path.write_text(to_json(content) + '\n', encoding='utf-8')
        if self._with_points:
            write_points(frame, self._scene / CLOUDS_FOLDER / f'{name}.pcd')
        self._sidecar.add(frame)

    def close(self) -> None:
        """Complete the sidecar files."""
        self._sidecar.close()


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the frames of a scene, or of a folder with one scene.

    ``timestamps.txt`` in either has one stamp [ns] per frame. Exports of Xtreme1 are read too if
    the ``result`` folder of the scene has one file per frame.

    Raises
    ------
    RecordingError
        If a file is missing or does not follow the format, or there are several scenes.

    """
    scene, folder = single_part(path, 'scene', [RESULT_FOLDER, CLOUDS_FOLDER])

    def cuboids_by_name(name: str) -> list[ReadCuboid]:
        return _read_cuboids(scene / RESULT_FOLDER / f'{name}.json')

    files = [*scene.glob(f'{RESULT_FOLDER}/*.json'), *scene.glob(f'{CLOUDS_FOLDER}/*.pcd')]
    names = {file.stem for file in files}
    yield from read_frames(folder, sorted(names), cuboids_by_name)


def _object(cuboid: Cuboid, frame_name: str) -> dict[str, Any]:
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
        EVIDENCE_KEY: cuboid.evidence,
    }


def _read_cuboids(file: Path) -> list[ReadCuboid]:
    """Return the boxes of a result file; none if there is no such file."""
    if not file.exists():
        return []
    content = from_json(file)
    try:
        parts = content if isinstance(content, list) else [content]
        objects = [item for part in parts for item in part['objects']]
        return [_cuboid(item) for item in objects if item.get('type', BOX_TYPE) == BOX_TYPE]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise RecordingError(f'{file}: expected objects of Xtreme1: {error!r}') from None


def _cuboid(item: dict[str, Any]) -> ReadCuboid:
    contour = item['contour']
    name = item.get('trackName')
    if EVIDENCE_KEY not in item:  # an export of Xtreme1: every object has a trackId
        name = name or item['trackId']
    box = box_from_cuboid(
        from_xyz(contour['center3D']), from_xyz(contour['rotation3D']), from_xyz(contour['size3D'])
    )
    evidence = {
        'score': item.get('modelConfidence'),
        'num_points': contour.get('pointN') or 0,
        **item.get(EVIDENCE_KEY, {}),
    }
    class_name = item.get('className') or item.get('modelClass') or ''
    return ReadCuboid(str(name or ''), str(class_name), box, evidence)
