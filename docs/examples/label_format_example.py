"""Label format ``jsonl``: one line of JSON per stamp, boxes in the fixed frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
import json
from pathlib import Path

from boxreg_ros.labels import Format, LabelFrame, Options, Provenance
from boxreg_ros.labels.files import following, to_json
from boxreg_ros.labels.records import evidence_of, refined_boxes

FORMAT = Format(
    name='jsonl',
    title='JSON lines',
    frame='fixed',
    reference='centre',
    sizes='length width height',
    rotation='roll pitch yaw, R = Rz Ry Rx',
    files='boxes.jsonl',
)


class Writer:
    """Write one line per stamp; nothing is kept in memory."""

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._file = (folder / 'boxes.jsonl').open('w', encoding='utf-8')

    def write(self, frame: LabelFrame) -> None:
        """Write the valid boxes in the fixed frame; the others are counted in `dropped`."""
        rows, boxes = frame.boxes_in('fixed', self.dropped)
        array = frame.refined.boxes
        line = {
            'stamp_ns': array.stamp_ns,
            'frame_id': frame.fixed_frame,
            'track_ids': [array.track_ids[row] for row in rows],
            'class_names': [array.class_names[row] for row in rows],
            'boxes': boxes.tolist(),
            'evidence': [evidence_of(frame.refined, row) for row in rows],
        }
        self._file.write(to_json(line) + '\n')

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read(path: Path) -> Iterator[LabelFrame]:
    """Yield the frames of a file, or of the file in a folder."""
    if path.is_dir():
        path = path / 'boxes.jsonl'
    with following(path, 'one JSON object per line'):
        for text in path.read_text(encoding='utf-8').splitlines():
            line = json.loads(text)
            refined = refined_boxes(
                line['stamp_ns'],
                line['frame_id'],
                line['track_ids'],
                line['class_names'],
                line['boxes'],
                line['evidence'],
            )
            yield LabelFrame(refined, fixed_frame=line['frame_id'], sensor_frame='')
