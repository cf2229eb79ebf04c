"""
``decisions.csv``: what a person decided about tracks and boxes, one row per decision.

Rows are only appended, so a crash loses at most the row that is being written. Of several rows
for the same track and stamp the last one holds; ``none`` takes a decision back.

"""

from __future__ import annotations

from collections.abc import Iterable
import csv
from dataclasses import dataclass, replace
import io
import os
from pathlib import Path
from typing import Any

from boxreg_ros.errors import RecordingError, unreadable
from boxreg_ros.reasons import Reason
from boxreg_ros.rotations import quaternion_from_rpy, rpy_from_quaternion
from boxreg_ros.structures import (
    BOX_EXTENT,
    BoxArray,
    Floats,
    HUMAN,
    is_valid_box,
    KEPT,
    RefinedBoxes,
    ROLL,
    Z,
)
import numpy as np
from numpy.typing import NDArray

DECISIONS = 'decisions.csv'
DECISION_KINDS = ('accept', 'reject', 'unsure', 'pin', 'none')
PINNED_BOX_COLUMNS = ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw', 'length', 'width', 'height')
DECISION_COLUMNS = ('track_id', 'stamp_ns', 'decision', 'comment', 'frame_id', *PINNED_BOX_COLUMNS)
MAX_COMMENT = 2000
"""Longest comment [characters]; chosen: a row fits a page of memory, which is written at once."""


@dataclass(frozen=True, slots=True)
class Decision:
    """
    One decision about a track, or about one of its boxes.

    Attributes
    ----------
    track_id : str
        The track.
    stamp_ns : int or None
        Stamp of the box [ns]; None for the whole track.
    kind : str
        ``accept``, ``reject`` (keep the input), ``unsure``, ``pin`` (the box is right as given)
        or ``none`` (no decision any more).
    comment : str
        Free text in one line.
    frame_id : str
        Frame of `box`; empty without one.
    box : array, shape (9,), or None
        The pinned box [m, rad].

    Raises
    ------
    RecordingError
        If the kind is unknown, or a pin has no stamp or no valid box.

    """

    track_id: str
    stamp_ns: int | None
    kind: str
    comment: str = ''
    frame_id: str = ''
    box: Floats | None = None

    def __post_init__(self) -> None:
        """Check the decision."""
        if self.kind not in DECISION_KINDS:
            raise RecordingError(
                f'decision: expected one of {", ".join(DECISION_KINDS)}, got {self.kind!r}; '
                f'decide again, or remove the row'
            )
        if self.kind != 'pin':
            return
        if self.stamp_ns is None:
            raise RecordingError(
                f'pin of track {self.track_id!r}: expected the stamp of a box, got none; pin one '
                f'box'
            )
        if self.box is None or not is_valid_box(self.box):
            got = 'none' if self.box is None else np.array2string(self.box, precision=3)
            raise RecordingError(
                f'pinned box of track {self.track_id!r} at {self.stamp_ns}: expected finite '
                f'numbers and positive extents, got {got}; pin the box again, or remove the row'
            )

    def row(self) -> list[str]:
        """Return the columns of the file."""
        numbers = [''] * len(PINNED_BOX_COLUMNS)
        if self.box is not None:
            quaternion = quaternion_from_rpy(self.box[None, ROLL:])[0]
            values = [*self.box[: Z + 1], *quaternion, *self.box[BOX_EXTENT]]
            numbers = [f'{value:.9f}' for value in values]
        stamp = '' if self.stamp_ns is None else str(self.stamp_ns)
        comment = ' '.join(self.comment.split())[:MAX_COMMENT]
        return [self.track_id, stamp, self.kind, comment, self.frame_id, *numbers]

    def as_json(self) -> dict[str, Any]:
        """Return the decision as the page sends and receives it."""
        return {
            'track_id': self.track_id,
            'stamp_ns': '' if self.stamp_ns is None else str(self.stamp_ns),
            'decision': self.kind,
            'comment': self.comment,
            'box': None if self.box is None else self.box.tolist(),
        }


def read_decisions(path: Path) -> list[Decision]:
    """
    Return the decisions of a file, in its order; a last row without an end is left out.

    Raises
    ------
    RecordingError
        If the file cannot be read, a column is missing, or a row is no decision.

    """
    try:
        text = path.read_text(encoding='utf-8-sig')
    except OSError as error:
        raise RecordingError(unreadable(path, error)) from None
    except UnicodeDecodeError as error:
        raise RecordingError(
            f'{path}: expected decisions of boxreg review, got no text: {error}; give their file'
        ) from None
    whole = text[: text.rfind('\n') + 1]
    reader = csv.DictReader(io.StringIO(whole, newline=''))
    missing = [name for name in DECISION_COLUMNS if name not in (reader.fieldnames or ())]
    if missing:
        raise RecordingError(
            f'{path}: expected decisions of boxreg review, got a file without the columns '
            f'{", ".join(missing)}; give {DECISIONS} of a reviewed result'
        )
    decisions = []
    for row in reader:
        try:
            decisions.append(_parsed(row))
        except RecordingError as error:
            raise RecordingError(f'{path}: line {reader.line_num}: {error}') from None
        except ValueError as error:
            raise RecordingError(
                f'{path}: line {reader.line_num}: expected numbers, got: {error}; correct the '
                f'line, or remove it'
            ) from None
    return decisions


class DecisionLog:
    """
    Append decisions to a file; each is on disk when `append` returns.

    Parameters
    ----------
    path : Path
        The file; it is made with the first decision.

    Raises
    ------
    RecordingError
        If the file exists and holds something else.

    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.decisions = read_decisions(path) if path.exists() else []

    def append(self, decision: Decision) -> None:
        """Write one decision at the end of the file."""
        is_new = not self._path.exists()
        text = io.StringIO(newline='')
        writer = csv.writer(text, lineterminator='\n')
        if is_new:
            writer.writerow(DECISION_COLUMNS)
        writer.writerow(decision.row())
        with open(self._path, 'r+b' if not is_new else 'wb') as file:
            file.seek(0 if is_new else self._end_of_last_row())
            file.truncate()  # the part of a row that a crash has left
            file.write(text.getvalue().encode())
            file.flush()
            os.fsync(file.fileno())
        self.decisions.append(decision)

    def _end_of_last_row(self) -> int:
        return self._path.read_bytes().rfind(b'\n') + 1


class Corrections:
    """
    Rejected tracks and pinned boxes, as a run applies them; boxes can be pinned already.

    Parameters
    ----------
    decisions : iterable of Decision
        In the order they were made.

    """

    def __init__(self, decisions: Iterable[Decision] = ()) -> None:
        last = {(one.track_id, one.stamp_ns): one for one in decisions}
        made = {key: one for key, one in last.items() if one.kind in ('reject', 'pin')}
        self._made = made
        self._unused = set(made)
        self._extents = _extents_of_pins(made.values())

    def unused(self) -> list[str]:
        """Return the tracks and boxes with a decision that the recording does not have."""
        names = []
        for track_id, stamp_ns in sorted(self._unused, key=str):
            names.append(f'{track_id!r}' if stamp_ns is None else f'{track_id!r} at {stamp_ns}')
        return names

    def pinned(self, given: BoxArray) -> BoxArray:
        """
        Return input boxes with pinned boxes in the place of theirs.

        A pin shows the extents of the object: the other boxes of its track have them too, in
        windows without a pin as well.

        Raises
        ------
        RecordingError
            If a box is pinned in another frame.

        """
        if not self._made:
            return given
        is_pinned = _is_pinned(given)
        boxes = given.boxes.copy()
        for row, track_id in enumerate(given.track_ids):
            if not is_pinned[row]:
                boxes[row, BOX_EXTENT] = self._extents.get(track_id, boxes[row, BOX_EXTENT])
            found = self._of(track_id, given.stamp_ns)
            if found is None:
                continue
            if found.kind != 'pin' or found.box is None:
                is_pinned[row] = False
                continue
            if found.frame_id != given.frame_id:
                raise RecordingError(
                    f'pinned box of track {track_id!r} at {given.stamp_ns}: expected frame '
                    f'{given.frame_id!r}, got {found.frame_id!r}; relabel with --fixed-frame '
                    f'{found.frame_id}'
                )
            boxes[row] = found.box
            is_pinned[row] = True
        return replace(given, boxes=boxes, pinned=is_pinned)

    def apply(self, given: BoxArray, refined: RefinedBoxes) -> RefinedBoxes:
        """Return the result with rejected boxes as in the input, and pinned boxes as pinned."""
        is_pinned = _is_pinned(given)
        if not (self._made or is_pinned.any()):
            return refined
        boxes = refined.boxes.boxes.copy()
        status = list(refined.status)
        reasons = list(refined.reasons)
        covariances = refined.covariances.copy()
        for row, track_id in enumerate(given.track_ids):
            if status[row] == KEPT:
                boxes[row] = given.boxes[row]  # without the extents of a pin
            found = self._of(track_id, given.stamp_ns)
            if found is None:
                if is_pinned[row]:
                    boxes[row] = given.boxes[row]
                    status[row], reasons[row] = HUMAN, ''
            elif found.kind == 'pin' and found.box is not None:
                boxes[row] = found.box
                status[row], reasons[row] = HUMAN, ''
            elif found.kind == 'reject':
                boxes[row] = given.boxes[row]
                status[row], reasons[row] = KEPT, str(Reason.REJECTED)
                covariances[row] = np.eye(6)
        return replace(
            refined,
            boxes=replace(refined.boxes, boxes=boxes, pinned=None),
            status=tuple(status),
            reasons=tuple(reasons),
            covariances=covariances,
        )

    def _of(self, track_id: str, stamp_ns: int) -> Decision | None:
        """Return the decision on a box: its own, else that of its track."""
        found = None
        for key in ((track_id, stamp_ns), (track_id, None)):
            if key in self._made:
                self._unused.discard(key)
                found = found or self._made[key]
        return found


def _is_pinned(boxes: BoxArray) -> NDArray[np.bool_]:
    """Return which boxes of an array (n,) are pinned, as a copy."""
    if boxes.pinned is None:
        return np.zeros(len(boxes.track_ids), bool)
    return boxes.pinned.copy()


def _extents_of_pins(decisions: Iterable[Decision]) -> dict[str, Floats]:
    """Return the mean extents (3,) of the pinned boxes of each track that has any."""
    by_track: dict[str, list[Floats]] = {}
    for decision in decisions:
        if decision.kind == 'pin' and decision.box is not None:
            by_track.setdefault(decision.track_id, []).append(decision.box[BOX_EXTENT])
    return {track_id: np.mean(extents, axis=0) for track_id, extents in by_track.items()}


def _parsed(row: dict[str, str]) -> Decision:
    """Return the decision of a row; raises ValueError for text that is no number."""
    box = None
    if any(row[name] for name in PINNED_BOX_COLUMNS):
        numbers = np.array([float(row[name] or 'nan') for name in PINNED_BOX_COLUMNS])
        box = _box_of(numbers)
    stamp_ns = int(row['stamp_ns']) if row['stamp_ns'] else None
    return Decision(
        row['track_id'], stamp_ns, row['decision'], row['comment'], row['frame_id'], box
    )


def _box_of(numbers: NDArray[np.float64]) -> Floats:
    """Return a box (9,) of `PINNED_BOX_COLUMNS` (10,), NaN angles without a valid quaternion."""
    quaternion = numbers[3:7]
    norm = np.linalg.norm(quaternion)
    angles = np.full(3, np.nan)
    if np.isfinite(norm) and norm > 0:
        angles = rpy_from_quaternion(quaternion[None])[0]
    return np.concatenate([numbers[:3], numbers[7:], angles])
