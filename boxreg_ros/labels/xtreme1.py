"""
Xtreme1: ``scene_1/lidar_point_cloud_0/FRAME.pcd`` with ``scene_1/result/FRAME.json``.

The folder is uploaded as a zip, with the option that it contains annotation results. Xtreme1
knows classes by numbers of its own data base: the class names here show as those of a model.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

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
    name='xtreme1',
    title='Xtreme1',
    frame='sensor',
    reference='centre',
    sizes='length width height (x y z)',
    rotation='angles x y z, R = Rx Ry Rz',
    files='scene_1/result/STAMP.json, scene_1/lidar_point_cloud_0/STAMP.pcd',
    options=('with_points',),
)
SCENE, CLOUDS, RESULT = 'scene_1', 'lidar_point_cloud_0', 'result'
BOX = '3D_BOX'


class Writer:
    """
    Write one file of labels per frame, and one of points if asked for.

    Xtreme1 takes no file without objects: frames without boxes have none.

    """

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._with_points, self._origin = options.with_points, asdict(provenance)
        self._names, self._timeline = FrameNames(), Timeline(folder, provenance)
        self._scene = folder / SCENE
        for name in (RESULT, CLOUDS):
            (self._scene / name).mkdir(parents=True)

    def write(self, frame: LabelFrame) -> None:
        """Add a frame."""
        name = self._names.of(frame.refined.boxes.stamp_ns)
        objects = [
            {
                'type': BOX,
                'trackId': c.track_id or f'{name}-{c.row}',
                'trackName': c.track_id,
                'className': c.class_name,
                'modelClass': c.class_name,
                'modelConfidence': c.evidence['score'],
                'contour': {
                    'center3D': c.position,
                    'rotation3D': c.angles,
                    'size3D': c.extent,
                    'pointN': c.evidence['num_points'],
                    'points': [],
                },
                OURS: c.evidence,
            }
            for c in cuboids_of(frame, self.dropped)
        ]
        if objects:
            path = self._scene / RESULT / f'{name}.json'
            content = {'objects': objects, OURS: self._origin}
            path.write_text(to_json(content) + '\n', encoding='utf-8')
        if self._with_points:
            write_points(frame, self._scene / CLOUDS / f'{name}.pcd')
        self._timeline.add(frame)

    def close(self) -> None:
        """Complete the timeline."""
        self._timeline.close()


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the frames of a scene, or of a folder with one scene.

    ``timestamps.txt`` in either has a stamp [ns] per frame. Boxes that Xtreme1 exports are read as
    well, in one file per frame of the scene's ``result``.

    Raises
    ------
    RecordingError
        If a file is missing or is not what Xtreme1 takes, or there are several scenes.

    """
    scene, folder = part_of(path, 'scene', [RESULT, CLOUDS])

    def items_of(name: str) -> list[tuple[str, str, Floats, Mapping[str, Any]]]:
        file = scene / RESULT / f'{name}.json'
        if not file.exists():
            return []
        content = from_json(file)
        try:
            parts = content if isinstance(content, list) else [content]
            return [
                _item(o) for part in parts for o in part['objects'] if o.get('type', BOX) == BOX
            ]
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise RecordingError(
                f'{file}: expected objects as Xtreme1 has them: {error!r}'
            ) from None

    names = {f.stem for f in (*scene.glob(f'{RESULT}/*.json'), *scene.glob(f'{CLOUDS}/*.pcd'))}
    yield from frames_in(folder, sorted(names), items_of)


def _item(item: dict[str, Any]) -> tuple[str, str, Floats, Mapping[str, Any]]:
    contour = item['contour']
    keys = ('center3D', 'rotation3D', 'size3D')
    evidence = {'score': item.get('modelConfidence'), 'num_points': contour.get('pointN') or 0}
    name = item.get('trackName') if OURS in item else item.get('trackName') or item['trackId']
    return (
        str(name or ''),
        str(item.get('className') or item.get('modelClass') or ''),
        box_of(*(numbers(contour[key]) for key in keys)),
        evidence | item.get(OURS, {}),
    )
