"""
What the formats with a text file of boxes per frame share: one line for each box.

They have no place for the track and the evidence of a box. ``boxreg/NAME.json`` has these, by the
text of the line; a line of another program has neither.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

from boxreg_ros.labels.cuboids import read_frames
from boxreg_ros.labels.files import at, following, from_json, write_json
from boxreg_ros.labels.folder import FolderWriter
from boxreg_ros.labels.protocol import LabelFrame
from boxreg_ros.labels.records import evidence_of, FrameBoxes, NO_FRAME_BOXES, ReadBox
from boxreg_ros.labels.sidecar import named_frames
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import BoxArray, Floats, Ints

EVIDENCE_FOLDER = 'boxreg'


class PerFrameWriter(FolderWriter):
    """
    Write a text file per frame, and the evidence of its lines.

    A format derives from it, states `label_folder` and implements `lines`.

    """

    label_folder: ClassVar[str] = ''
    """Folder of the text files, one of `folders`."""
    needs_clouds: ClassVar[bool] = True
    has_sidecar: ClassVar[bool] = True

    def add(self, frame: LabelFrame) -> None:
        """Write the files of a frame."""
        array = frame.refined.boxes
        rows, boxes = frame.boxes_in('sensor', self.dropped)
        lines = list(self.lines(array, rows, boxes))
        text = ''.join(f'{line}\n' for line in lines)
        path = self.folder / self.label_folder / f'{self.name}.txt'
        path.write_text(text, encoding='utf-8')
        evidence = [
            {
                'line': line,
                'track_id': array.track_ids[row],
                'class_name': array.class_names[row],
                'num_points': int(frame.refined.num_points[row]),
                'attributes': dict(array.attributes_of(row)),
                **evidence_of(frame.refined, row),
            }
            for line, row in zip(lines, rows.tolist(), strict=True)
        ]
        write_json(self.folder / EVIDENCE_FOLDER / f'{self.name}.json', evidence)

    def lines(self, array: BoxArray, rows: Ints, boxes: Floats) -> Iterator[str]:
        """
        Yield the line of each box.

        Parameters
        ----------
        array : BoxArray
            All boxes of the frame.
        rows : array, shape (k,)
            Into `array`, of the boxes that are written.
        boxes : array, shape (k, 9)
            In the frame of the sensor [m, rad].

        """
        raise NotImplementedError


def read_lines(
    folder: Path,
    labels: Path,
    names: Iterable[str],
    what: str,
    boxes_of: Callable[[str, list[list[str]]], Sequence[ReadBox | None]],
) -> Iterator[LabelFrame]:
    """
    Yield the frames of a folder with a text file of boxes each.

    Parameters
    ----------
    folder : Path
        Of the sidecar files and of the evidence.
    labels : Path
        Folder of the text files; frames without boxes may lack theirs.
    names : iterable of str
        Of all frames that have labels or points.
    what : str
        Content of a line, for errors.
    boxes_of : callable
        Returns the boxes of the words of the lines of a frame, None for a region without a box.

    Yields
    ------
    frame : LabelFrame
        One per name, in the order of the stamps.

    Raises
    ------
    RecordingError
        If a file is missing or does not follow the format.

    """

    def boxes_by_name(name: str) -> FrameBoxes:
        file = labels / f'{name}.txt'
        if not file.exists():
            return NO_FRAME_BOXES
        with following(file, what):
            lines = [line.strip() for line in file.read_text(encoding='utf-8').splitlines()]
            lines = [line for line in lines if line]
            found = boxes_of(name, [line.split() for line in lines])
        evidence = _read_evidence(folder / EVIDENCE_FOLDER / f'{name}.json')
        boxes = [
            _with_evidence(box, evidence.get(line))
            for line, box in zip(lines, found, strict=True)
            if box is not None
        ]
        left_out = Counter({Reason.NO_BOX.value: len(lines) - len(boxes)})
        return boxes, +left_out

    yield from read_frames(folder, named_frames(folder, names), boxes_by_name)


def numbers_of(words: Sequence[Sequence[str]], columns: slice, counts: Sequence[int]) -> list[Any]:
    """
    Return some columns of lines of text as numbers.

    Parameters
    ----------
    words : sequence of sequences of str
        The words of each line.
    columns : slice
        Columns that are numbers.
    counts : sequence of int
        Numbers of words that a line may have.

    Returns
    -------
    rows : list of list of float
        One per line.

    Raises
    ------
    ValueError
        If a line has another number of words, or a word is no number; with the line, from 1.

    """
    rows = []
    for number, line in enumerate(words, 1):
        with at(f'box {number}'):
            if len(line) not in counts:
                raise ValueError(f'got {len(line)} columns')
            rows.append([float(word) for word in line[columns]])
    return rows


def _read_evidence(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Return the evidence by the text of the line, in their order; empty without a file."""
    found: dict[str, list[dict[str, Any]]] = {}
    if path.exists():
        content = from_json(path)
        with following(path, 'a list of lines with their evidence'):
            for item in content:
                found.setdefault(item['line'], []).append(item)
    return found


def _with_evidence(box: ReadBox, evidence: list[dict[str, Any]] | None) -> ReadBox:
    """Return a box with the first of the evidence of its line, which is used up."""
    if not evidence:
        return box
    own = evidence.pop(0)
    return box._replace(
        track_id=str(own.get('track_id', '')),
        class_name=str(own.get('class_name', box.class_name)),
        evidence=own,
    )
