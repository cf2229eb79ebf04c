"""
SUSTechPOINTS: a scene folder with ``label/FRAME.json`` and ``lidar/FRAME.pcd``.

The folder is put, or linked, into the ``data`` folder of the tool. Boxes carry an ``annotator``,
by which the tool tells them from those a human made or touched, and does not learn from them.

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
    write_points,
)
from boxreg_ros.labels.files import from_json, Timeline, to_json
from boxreg_ros.structures import Floats

FORMAT = Format(
    name='sustechpoints',
    title='SUSTechPOINTS',
    frame='sensor',
    reference='centre',
    sizes='length width height (x y z)',
    rotation='angles x y z, R = Rx Ry Rz',
    files='label/STAMP.json, lidar/STAMP.pcd, desc.json',
    options=('with_points',),
)


class Writer:
    """Write one file of labels per frame, and one of points if asked for."""

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._folder, self._with_points = folder, options.with_points
        self._names, self._timeline = FrameNames(), Timeline(folder, provenance)
        (folder / 'label').mkdir()
        (folder / 'lidar').mkdir()
        (folder / 'desc.json').write_text(to_json(asdict(provenance)) + '\n', encoding='utf-8')

    def write(self, frame: LabelFrame) -> None:
        """Add a frame."""
        name = self._names.of(frame.refined.boxes.stamp_ns)
        items = [
            {
                'psr': {'position': c.position, 'scale': c.extent, 'rotation': c.angles},
                'obj_type': c.class_name,
                'obj_id': c.track_id,
                'obj_attr': '',
                'annotator': OURS,
                OURS: c.evidence,
            }
            for c in cuboids_of(frame, self.dropped)
        ]
        path = self._folder / 'label' / f'{name}.json'
        path.write_text(to_json(items) + '\n', encoding='utf-8')
        if self._with_points:
            write_points(frame, self._folder / 'lidar' / f'{name}.pcd')
        self._timeline.add(frame)

    def close(self) -> None:
        """Complete the timeline."""
        self._timeline.close()


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the frames of a scene; ``timestamps.txt`` in it has a stamp [ns] per label file.

    Raises
    ------
    RecordingError
        If a file is missing or is not what the tool writes.

    """

    def items_of(name: str) -> list[tuple[str, str, Floats, Mapping[str, Any]]]:
        file = path / 'label' / f'{name}.json'
        content = from_json(file)
        try:
            items = content['objs'] if isinstance(content, dict) else content
            return [
                (
                    str(item['obj_id']),
                    str(item['obj_type']),
                    box_of(*(numbers(item['psr'][k]) for k in ('position', 'rotation', 'scale'))),
                    item.get(OURS, {}),
                )
                for item in items
            ]
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise RecordingError(
                f'{file}: expected boxes as SUSTechPOINTS writes them: {error!r}'
            ) from None

    yield from frames_in(path, sorted(f.stem for f in path.glob('label/*.json')), items_of)
