"""
Xtreme1: ``scene_1/lidar_point_cloud_0/FRAME.pcd`` with ``scene_1/result/FRAME.json``.

Upload the folder as a zip, with the option that it contains annotation results. Xtreme1 numbers
classes in its own data base, so the class names here are shown as those of a model.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.images import Image
from boxreg_ros.labels import cuboids
from boxreg_ros.labels.attributes import attributes_from
from boxreg_ros.labels.cameras import LabelCamera
from boxreg_ros.labels.files import at, following, from_json, visible, write_json
from boxreg_ros.labels.protocol import (
    AUTOMATIC_STATUS,
    INPUT_STATUS,
    LabelFrame,
)
from boxreg_ros.labels.records import FrameBoxes, ReadBox
from boxreg_ros.labels.sidecar import named_frames
from boxreg_ros.reasons import Reason

FORMAT = replace(
    cuboids.CUBOID_FORMAT,
    name='xtreme1',
    title='Xtreme1',
    files='scene_1/result/STAMP.json, scene_1/lidar_point_cloud_0/STAMP.pcd',
    reads='one source of a scene (`PATH#SOURCE`), results of versions 0.5 to 0.7',
    leaves_out='other sources and objects without contour (counted), objects in images',
)
LIDAR_FOLDER = 'lidar_point_cloud_0'
RESULT_FOLDER = 'result'
BOX_TYPE = '3D_BOX'
BOX_TYPES = (BOX_TYPE, '3D')
"""Types of objects that are boxes; versions up to 0.5 call them 3d."""
GROUND_TRUTH = 'Ground Truth'
"""Name of the source of boxes that people have drawn."""


class Writer(cuboids.CuboidWriter):
    """
    Write one file of labels per frame, and one of points if they are requested.

    Frames without boxes get no file, because Xtreme1 refuses files without objects.

    """

    folders = (f'scene_1/{RESULT_FOLDER}', f'scene_1/{LIDAR_FOLDER}')
    cloud_file = f'scene_1/{LIDAR_FOLDER}/{{name}}.pcd'
    image_file = 'scene_1/camera_image_{index}/{name}.{suffix}'

    def begin(self) -> None:
        """Open the files."""
        self._origin = dict(self.about)

    def add(self, frame: LabelFrame) -> None:
        """Write the file of a frame."""
        objects = [_object(cuboid, self.name) for cuboid in self.cuboids(frame)]
        if objects:
            path = self.folder / 'scene_1' / RESULT_FOLDER / f'{self.name}.json'
            write_json(path, {'objects': objects, cuboids.EVIDENCE_KEY: self._origin})

    def add_images(self, images: Sequence[tuple[LabelCamera, Image, str]]) -> None:
        """Write the calibration of the cameras of a frame, in the order of their folders."""
        path = self.folder / 'scene_1' / 'camera_config' / f'{self.name}.json'
        path.parent.mkdir(exist_ok=True)
        write_json(path, [_camera_config(camera) for camera, _, _ in images])


def _camera_config(camera: LabelCamera) -> dict[str, Any]:
    K = camera.intrinsics
    width, height = camera.image.size
    return {
        'camera_internal': {'fx': K[0, 0], 'fy': K[1, 1], 'cx': K[0, 2], 'cy': K[1, 2]},
        'width': width,
        'height': height,
        'camera_external': camera.T_camera_sensor.ravel().tolist(),
        'rowMajor': True,
    }


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the frames of a scene, or of a folder with one scene.

    Their stamps [ns] are those of ``timestamps.txt`` in either, one per frame, or the names of the
    files. The track id is ``trackId``: names of tracks start again in each frame that is no part
    of a scene.

    Parameters
    ----------
    path : Path
        Folder of the scene, or of one scene; exports have its ``result`` folder. After ``#`` may
        be the name of the source to read, by default the only one, or the ground truth.

    Yields
    ------
    frame : LabelFrame
        One per file, in the order of the stamps; boxes of other sources are counted.

    Raises
    ------
    RecordingError
        If a file is missing or does not follow the format, or no source is to be preferred.

    """
    path, part = _parts(path)
    scene, folder = cuboids.single_part(path, 'scene', [RESULT_FOLDER, LIDAR_FOLDER])
    names = {file.stem for file in visible(scene, f'{LIDAR_FOLDER}/*.pcd')}
    results: dict[str, list[tuple[str, FrameBoxes]]] = {}  # of each source
    for file in visible(scene, f'{RESULT_FOLDER}/*.json'):
        content = from_json(file)
        with following(file, 'objects of Xtreme1'):
            results[file.stem] = _results(content)
    sources = [one for found in results.values() for one, (boxes, _) in found if boxes]
    source = _source(path, Counter(sources), part)

    def boxes_of(name: str) -> FrameBoxes:
        boxes: list[ReadBox] = []
        left_out: Counter[str] = Counter()
        for one, (found, absent) in results.get(name, ()):
            left_out.update(absent)
            if one == source:
                boxes += found
            else:
                left_out[Reason.OTHER_SOURCE] += len(found)
        return boxes, +left_out

    frames = named_frames(folder, names | results.keys())
    yield from cuboids.read_frames(folder, frames, boxes_of)


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


def files_of(path: Path) -> Path:
    """Return the path of the files, without the source."""
    return _parts(path)[0]


def _parts(path: Path) -> tuple[Path, str]:
    """Return the path of the files, and the source that was asked for; empty for none."""
    before, mark, part = str(path).rpartition('#')
    return (path, '') if path.exists() or not mark else (Path(before), part)


def _results(content: Any) -> list[tuple[str, FrameBoxes]]:
    """Return source and boxes of each result in a file: one, or a list for several sources."""
    parts = content if isinstance(content, list) else [content]
    found: list[tuple[str, FrameBoxes]] = []
    for part in parts:
        result = part.get('result') or part  # versions up to 0.5 have another level
        source = str(part.get('sourceName') or '')
        boxes = []
        without_box = 0
        for number, item in enumerate(result['objects'] or ()):
            with at(f'object {number}'):
                kind = item.get('type') or item.get('objType') or BOX_TYPE
                if str(kind).upper() not in BOX_TYPES:
                    continue
                if 'contour' in item and item['contour'] is None:
                    without_box += 1
                    continue
                boxes.append(_cuboid(item, source))
        found.append((source, (boxes, {Reason.NO_BOX: without_box})))
    return found


def _source(path: Path, sources: Counter[str], part: str) -> str:
    """Return the source to read, of several with their numbers of frames."""
    names = ', '.join(f'{name!r} ({count} frames)' for name, count in sources.items())
    if part:
        if part in sources:
            return part
        raise RecordingError(f'{path}: expected a source {part!r}, got {names}; name one of these')
    if len(sources) > 1 and GROUND_TRUTH not in sources:
        raise RecordingError(
            f'{path}: expected boxes of one source, or of the ground truth, got {names}; '
            f'name the one to read after the path: {path}#SOURCE'
        )
    return GROUND_TRUTH if GROUND_TRUTH in sources else next(iter(sources), '')


def _attributes(item: dict[str, Any]) -> dict[str, str]:
    """Return the attributes of an object: those of its class, one value or several each."""
    values: dict[str, object] = {}
    for one in item.get('classValues') or ():
        value = one.get('value')
        values[str(one.get('name'))] = ', '.join(value) if isinstance(value, list) else value
    return attributes_from(values)


def _cuboid(item: dict[str, Any], source: str) -> ReadBox:
    """Return the box of an object; of a model run, unless a person took it for ground truth."""
    contour = item.get('contour', item)
    own = item.get(cuboids.EVIDENCE_KEY)  # of our files, where boxes may lack a track id
    track_id = item.get('trackId') if own is None else item.get('trackName')
    box = cuboids.box_from_xyz(contour['center3D'], contour['rotation3D'], contour['size3D'])
    score = item.get('modelConfidence', item.get('confidence'))
    is_of_model = score is not None and source != GROUND_TRUTH
    evidence = {
        'status': AUTOMATIC_STATUS if is_of_model else INPUT_STATUS,
        'score': score,
        'num_points': contour.get('pointN'),
        'attributes': _attributes(item),
        **(own or {}),
    }
    class_name = item.get('className') or item.get('classType') or item.get('modelClass') or ''
    return ReadBox('' if track_id is None else str(track_id), str(class_name), box, evidence)
