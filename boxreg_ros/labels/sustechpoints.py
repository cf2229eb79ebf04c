"""
SUSTechPOINTS: a scene folder with ``label/FRAME.json`` and ``lidar/FRAME.pcd``.

Copy or link the folder into the ``data`` folder of the tool. Boxes have an ``annotator``: the tool
distinguishes them from boxes that a person drew or edited, and does not learn from them.

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
    write_points,
)
from boxreg_ros.labels.files import from_json, to_json
from boxreg_ros.labels.protocol import LabelFrame, Options, Provenance
from boxreg_ros.labels.sidecar import SidecarWriter

FORMAT = cuboid_format(
    name='sustechpoints',
    title='SUSTechPOINTS',
    files='label/STAMP.json, lidar/STAMP.pcd, desc.json',
)


class Writer:
    """Write one file of labels per frame, and one of points if they are requested."""

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._folder = folder
        self._with_points = options.with_points
        self._names = FrameNames()
        self._sidecar = SidecarWriter(folder, provenance)
        (folder / 'label').mkdir()
        (folder / 'lidar').mkdir()
        (folder / 'desc.json').write_text(to_json(asdict(provenance)) + '\n', encoding='utf-8')

    def write(self, frame: LabelFrame) -> None:
        """Add a frame."""
        name = self._names.of(frame.refined.boxes.stamp_ns)
        items = [_item(cuboid) for cuboid in cuboids_of(frame, self.dropped)]
        path = self._folder / 'label' / f'{name}.json'
        path.write_text(to_json(items) + '\n', encoding='utf-8')
        if self._with_points:
            write_points(frame, self._folder / 'lidar' / f'{name}.pcd')
        self._sidecar.add(frame)

    def close(self) -> None:
        """Complete the sidecar files."""
        self._sidecar.close()


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the frames of a scene with one stamp [ns] per label file in its ``timestamps.txt``.

    Raises
    ------
    RecordingError
        If a file is missing or does not follow the format of the tool.

    """

    def cuboids_by_name(name: str) -> list[ReadCuboid]:
        return _read_cuboids(path / 'label' / f'{name}.json')

    names = sorted(file.stem for file in path.glob('label/*.json'))
    yield from read_frames(path, names, cuboids_by_name)


def _item(cuboid: Cuboid) -> dict[str, Any]:
    return {
        'psr': {
            'position': cuboid.position,
            'scale': cuboid.extent,
            'rotation': cuboid.angles,
        },
        'obj_type': cuboid.class_name,
        'obj_id': cuboid.track_id,
        'obj_attr': '',
        'annotator': EVIDENCE_KEY,
        EVIDENCE_KEY: cuboid.evidence,
    }


def _read_cuboids(file: Path) -> list[ReadCuboid]:
    content = from_json(file)
    try:
        items = content['objs'] if isinstance(content, dict) else content
        return [_cuboid(item) for item in items]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise RecordingError(f'{file}: expected boxes of SUSTechPOINTS: {error!r}') from None


def _cuboid(item: dict[str, Any]) -> ReadCuboid:
    psr = item['psr']
    box = box_from_cuboid(
        from_xyz(psr['position']), from_xyz(psr['rotation']), from_xyz(psr['scale'])
    )
    evidence = item.get(EVIDENCE_KEY, {})
    return ReadCuboid(str(item['obj_id']), str(item['obj_type']), box, evidence)
