"""
SUSTechPOINTS: a scene folder with ``label/FRAME.json`` and ``lidar/FRAME.pcd``.

Copy or link the folder into the ``data`` folder of the tool. Boxes have an ``annotator``: the tool
distinguishes them from boxes that a person drew or edited, and does not learn from them.

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
    name='sustechpoints',
    title='SUSTechPOINTS',
    files='label/STAMP.json, lidar/STAMP.pcd, desc.json',
)


class Writer(cuboids.CuboidWriter):
    """Write one file of labels per frame, and one of points if they are requested."""

    folders = ('label', 'lidar')
    cloud_file = 'lidar/{name}.pcd'

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        super().__init__(folder, provenance, options)
        write_json(folder / 'desc.json', self.about)

    def add(self, frame: LabelFrame) -> None:
        """Write the file of a frame."""
        items = [_item(cuboid) for cuboid in self.cuboids(frame)]
        write_json(self.folder / 'label' / f'{self.name}.json', items)


def read(path: Path) -> Iterator[LabelFrame]:
    """Yield the frames of a scene with one stamp [ns] per label file in its ``timestamps.txt``."""
    names = {file.stem for file in path.glob('label/*.json')}
    yield from cuboids.read_files(path, path / 'label', names, 'boxes of SUSTechPOINTS', _cuboids)


def _item(cuboid: cuboids.Cuboid) -> dict[str, Any]:
    return {
        'psr': {
            'position': cuboid.position,
            'scale': cuboid.extent,
            'rotation': cuboid.angles,
        },
        'obj_type': cuboid.class_name,
        'obj_id': cuboid.track_id,
        'obj_attr': '',
        'annotator': cuboids.EVIDENCE_KEY,
        cuboids.EVIDENCE_KEY: cuboid.evidence,
    }


def _cuboids(content: Any) -> list[ReadBox]:
    return [_cuboid(item) for item in (content['objs'] if isinstance(content, dict) else content)]


def _cuboid(item: dict[str, Any]) -> ReadBox:
    psr = item['psr']
    box = cuboids.box_from_xyz(psr['position'], psr['rotation'], psr['scale'])
    evidence = item.get(cuboids.EVIDENCE_KEY, {})
    return ReadBox(str(item['obj_id']), str(item['obj_type']), box, evidence)
