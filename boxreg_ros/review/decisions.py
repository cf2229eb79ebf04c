"""
``decisions.csv``: what a person decided about tracks and boxes, one row per decision.

Rows are only added, and the file is replaced whole: a crash loses those that are being written at
most. Of several rows of one topic about the same boxes the last one holds. Several programs may
add to one file.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
import csv
from dataclasses import dataclass, replace
import fcntl
import io
from itertools import chain
from math import dist
import os
from pathlib import Path
from typing import Any

from boxreg_ros.errors import RecordingError, unreadable
from boxreg_ros.io.box_table import csv_row, protected, unprotected
from boxreg_ros.io.whole_files import written_whole
from boxreg_ros.rotations import boxes_from_quaternions, quaternion_from_rpy
from boxreg_ros.structures import BOX_EXTENT, Floats, is_valid_box, LENGTH, ROLL, Z
import numpy as np

DECISIONS = 'decisions.csv'
APPLIED = 'applied_decisions.csv'
"""Beside boxes that have these decisions already, about their ids; as `DECISIONS` otherwise."""
VERSION = 2
VERSION_LINE = '# boxreg decisions '
"""Begins the first line, before the version. Files of version 1 do not have it."""
KINDS_OF_TOPIC: Mapping[str, tuple[str, ...]] = {
    'judgement': ('accept', 'reject', 'unsure', 'pin', 'none'),
    'deletion': ('delete', 'restore'),
    'id': ('rename',),
    'class': ('reclass',),
    'addition': ('add', 'withdraw'),
    'attribute': ('attribute', 'remove'),
}
"""Kinds of decisions by topic: a decision replaces those of its topic about the same boxes."""
WITH_BOX = ('pin', 'add')
"""Kinds that state a box."""
TOPIC_OF = {kind: topic for topic, kinds in KINDS_OF_TOPIC.items() for kind in kinds}
PINNED_BOX_COLUMNS = ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw', 'length', 'width', 'height')
FIRST_COLUMNS = ('track_id', 'stamp_ns', 'decision', 'comment', 'frame_id', *PINNED_BOX_COLUMNS)
"""Those of version 1."""
DECISION_COLUMNS = (*FIRST_COLUMNS, 'end_ns', 'value', 'who', 'when')
MAX_STAMP_NS = 2**63 - 1
MAX_COMMENT = 2000
"""Longest comment [characters]; chosen: a row fits a page of memory, which is written at once."""

Scope = tuple[str, int | None, int | None]


@dataclass(frozen=True, slots=True)
class Decision:
    """
    One decision about a track, or about some of its boxes.

    Raises RecordingError if the kind is unknown, stamps are no range of 64-bit numbers, or a
    pinned or added box has no stamp, is none, or has no class.

    """

    track_id: str
    """The track in the input of the run."""
    stamp_ns: int | None
    """Of the box, or the first one of a range [ns]; None for the whole track."""
    kind: str
    comment: str = ''
    """Free text in one line."""
    frame_id: str = ''
    """Of `box`."""
    box: Floats | None = None
    """(9,), pinned or added [m, rad]."""
    end_ns: int | None = None
    """Last stamp of a range [ns]; None for one box, or the whole track."""
    value: str = ''
    """New id or class, or an attribute: NAME=VALUE, without a value to take it back; NAME of one
    to remove."""
    who: str = ''
    when: str = ''
    """In UTC (ISO 8601)."""

    def __post_init__(self) -> None:
        """Check the decision."""
        if self.kind not in TOPIC_OF:
            raise RecordingError(
                f'decision: expected one of {", ".join(TOPIC_OF)}, got {self.kind!r}; decide '
                f'again, or remove the row'
            )
        self._check_stamps()
        if self.kind in WITH_BOX:
            self._check_box()
        expected = {'attribute': 'NAME=VALUE', 'remove': 'NAME'}.get(self.kind)
        if expected and not (self.attribute[0] and ('=' in self.value) == ('=' in expected)):
            raise RecordingError(
                f'{self.kind} of track {self.track_id!r:.80}: expected {expected}, got '
                f'{self.value!r:.80}; decide again, or remove the row'
            )

    def _check_stamps(self) -> None:
        stamps = [stamp for stamp in (self.stamp_ns, self.end_ns) if stamp is not None]
        is_range = stamps == sorted(stamps) and (self.end_ns is None or self.stamp_ns is not None)
        if not is_range or any(abs(stamp) > MAX_STAMP_NS for stamp in stamps):
            raise RecordingError(
                f'decision on track {self.track_id!r:.80}: expected stamps of 64 bits, the last '
                f'one not before the first, got {self.stamp_ns} and {self.end_ns}; decide again, '
                f'or remove the row'
            )

    def _check_box(self) -> None:
        about = f'{self.kind} of track {self.track_id!r:.80}'
        if self.stamp_ns is None or self.end_ns is not None:
            got = 'none' if self.stamp_ns is None else 'a range'
            raise RecordingError(
                f'{about}: expected the stamp of a box, got {got}; {self.kind} one box'
            )
        if self.kind == 'add' and not (self.track_id and self.value):
            raise RecordingError(f'{about}: expected an id and a class, got none; add it again')
        if self.box is None or not is_valid_box(self.box):
            got = 'none' if self.box is None else np.array2string(self.box, precision=3)
            raise RecordingError(
                f'{about} at {self.stamp_ns}: expected finite numbers and positive extents, got '
                f'{got}; {self.kind} the box again, or remove the row'
            )

    @property
    def topic(self) -> str:
        """Return the topic of the decision: of `KINDS_OF_TOPIC`, an attribute with its name."""
        topic = TOPIC_OF[self.kind]
        return f'{topic} {self.attribute[0]}' if topic == 'attribute' else topic

    @property
    def attribute(self) -> tuple[str, str]:
        """Return name and value of an attribute; the value is empty for one to remove."""
        name, _, value = self.value.partition('=')
        return name, value

    @property
    def scope(self) -> Scope:
        """Return the boxes that the decision is about: track, first and last stamp."""
        return self.track_id, self.stamp_ns, self.end_ns

    @property
    def is_taken_back(self) -> bool:
        """Return whether there is no decision any more."""
        if self.kind in ('rename', 'reclass'):
            return not self.value
        if self.kind == 'attribute':
            return not self.attribute[1]
        return self.kind in ('none', 'restore', 'withdraw')

    def is_of_object(self, other: Decision) -> bool:
        """Return whether the boxes of two people are of one object: nearer than half a length."""
        if self.box is None or other.box is None or self.stamp_ns != other.stamp_ns:
            return False
        half_length = float(other.box[LENGTH]) / 2
        return dist(self.box[:LENGTH], other.box[:LENGTH]) < half_length

    def covers(self, stamp_ns: int) -> bool:
        """Return whether a box of the track at a stamp is one of those decided about."""
        if self.stamp_ns is None:
            return True
        last_ns = self.stamp_ns if self.end_ns is None else self.end_ns
        return self.stamp_ns <= stamp_ns <= last_ns

    def row(self) -> list[str]:
        """Return the columns of the file."""
        numbers = [''] * len(PINNED_BOX_COLUMNS)
        if self.box is not None:
            quaternion = quaternion_from_rpy(self.box[None, ROLL:])[0]
            values = [*self.box[: Z + 1], *quaternion, *self.box[BOX_EXTENT]]
            numbers = [f'{value:.9f}' for value in values]
        stamp, end = ('' if one is None else str(one) for one in (self.stamp_ns, self.end_ns))
        comment = ' '.join(self.comment.split())[:MAX_COMMENT]
        return [
            protected(self.track_id), stamp, self.kind, protected(comment),
            protected(self.frame_id), *numbers, end, protected(self.value), protected(self.who),
            self.when,
        ]  # fmt: skip

    def as_json(self) -> dict[str, Any]:
        """Return the decision as the page sends and receives it."""
        return {
            'track_id': self.track_id,
            'stamp_ns': '' if self.stamp_ns is None else str(self.stamp_ns),
            'end_ns': '' if self.end_ns is None else str(self.end_ns),
            'decision': self.kind,
            'comment': self.comment,
            'value': self.value,
            'box': None if self.box is None else self.box.tolist(),
            'who': self.who,
            'when': self.when,
        }


def held(decisions: Iterable[Decision]) -> list[Decision]:
    """Return the decisions that hold: the last ones of their topic and scope, in their order."""
    last: dict[tuple[str, Scope], Decision] = {}
    for one in decisions:
        last.pop((one.topic, one.scope), None)
        last[one.topic, one.scope] = one
    return [one for one in last.values() if not one.is_taken_back or one.comment]


def read_decisions(path: Path) -> list[Decision]:
    """Return the decisions of a file, or of several that are joined, see `joined_files`."""
    return [*chain.from_iterable(joined_files(path))]


def contradictions(files: Iterable[Sequence[Decision]]) -> list[str]:
    """Return the tracks and boxes about which joined files differ, with both decisions."""
    before: dict[tuple[str, Scope], Decision] = {}
    found = []
    for own in files:
        last = {(one.topic, one.scope): one for one in held(own)}
        for key in last.keys() & before.keys():
            words = [f'{one.kind} {one.value}'.strip() for one in (before[key], last[key])]
            if words[0] != words[1]:
                found.append(f'{text_of(key[1])} ({words[0]}, then {words[1]})')
        before |= last
    return sorted(found)


def text_of(scope: Scope) -> str:
    """Return the boxes of a decision in words."""
    track_id, stamp_ns, end_ns = scope
    if stamp_ns is None:
        return f'{track_id!r}'
    return f'{track_id!r} at {stamp_ns}' + (f' to {end_ns}' if end_ns is not None else '')


def joined_files(path: Path) -> list[list[Decision]]:
    """
    Return the decisions of a file, in its order; a last row that is cut is left out.

    Files of several people may be joined by ``cat``, and are returned as such: their first lines
    are left out, as are rows of an earlier one, from which both have gone on; and what two files
    add under one id are two objects, unless both have a box of it at the same place.

    Raises RecordingError if the file cannot be read, is of a later version, lacks a column, or a
    row is no decision.

    """
    try:
        text = path.read_bytes().decode('utf-8-sig')
    except OSError as error:
        raise RecordingError(unreadable(path, error)) from None
    except UnicodeDecodeError as error:
        raise RecordingError(
            f'{path}: expected decisions of boxreg review, got no text: {error}; give their file'
        ) from None
    whole = _whole_rows(text)
    if not whole:
        return [[]]
    version = _version_of(whole)
    if version not in (1, VERSION):
        raise RecordingError(
            f'{path}: expected decisions of version 1 or {VERSION}, got '
            f'{whole.splitlines()[0]!r}; update boxreg_ros'
        )
    stream = io.StringIO(whole, newline='')
    lines_before = int(version > 1 and bool(stream.readline()))
    reader = csv.DictReader(stream)
    columns = FIRST_COLUMNS if version == 1 else DECISION_COLUMNS
    missing = [name for name in columns if name not in (reader.fieldnames or ())]
    if missing:
        raise RecordingError(
            f'{path}: expected decisions of boxreg review, got a file without the columns '
            f'{", ".join(missing)}; give {DECISIONS} of a reviewed result'
        )
    files: list[list[Decision]] = [[]]
    for row in reader:
        line = reader.line_num + lines_before
        try:
            is_version = row['track_id'].startswith(VERSION_LINE)
            if is_version and _version_of(row['track_id']) != version:
                raise RecordingError(f'expected a file of version {version}, as the first one')
            if row['decision'] == 'decision':  # another file begins
                files.append([])
            elif not is_version:
                files[-1].append(_parsed(row, version))
        except RecordingError as error:
            raise RecordingError(f'{path}: line {line}: {error}') from None
        except (ValueError, TypeError, AttributeError) as error:
            raise RecordingError(
                f'{path}: line {line}: expected numbers, got: {error}; correct the line, or '
                f'remove it'
            ) from None
    for number in range(1, len(files)):
        before = [*chain.from_iterable(files[:number])]
        known = {tuple(one.row()) for one in before if one.when}
        own = _apart(before, files[number], number + 1)
        files[number] = [one for one in own if tuple(one.row()) not in known]
    return files


def _apart(before: Sequence[Decision], own: Sequence[Decision], number: int) -> list[Decision]:
    """
    Return the decisions of a file with new ids for objects that files `before` it do not have.

    Each person's page numbers those that are added from the last track of the result on.

    """
    added: dict[str, list[Decision]] = {}
    for one in before:
        if one.kind == 'add':
            added.setdefault(one.track_id, []).append(one)
    again = [one for one in own if one.kind == 'add' and one.track_id in added]
    same = {one.track_id for one in again if any(map(one.is_of_object, added[one.track_id]))}
    others = {one.track_id for one in again} - same
    new_id = {name: f'{name}.{number}' for name in others}
    return [
        replace(
            one,
            track_id=new_id.get(one.track_id, one.track_id),
            value=new_id.get(one.value, one.value) if one.kind == 'rename' else one.value,
        )
        for one in own
    ]


class DecisionLog:
    """
    Append decisions to a file that other programs may append to; each is on disk at once.

    The file is made with the first decision. `decisions` are all rows as of the last `refresh` or
    `append`. Raises RecordingError if the file exists and holds something else.

    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._state: tuple[int, ...] = ()
        self.decisions: list[Decision] = []
        self.refresh()

    def refresh(self) -> None:
        """Read what others have appended."""
        if self._state != _state_of(self._path):
            with self.locked():
                pass  # it is read

    def append(self, new: Sequence[Decision]) -> None:
        """Write decisions at the end of the file: all of them, or none."""
        with self.locked():
            self.append_locked(new)

    def append_locked(self, new: Sequence[Decision]) -> None:
        """Write decisions behind the last whole row of the file that this log has locked."""
        rows = _encoded(new)
        text = _whole_rows(self._path.read_bytes().decode()) if self._path.exists() else ''
        # Ids of a file that was joined may have been changed.
        is_joined = text.count(','.join(FIRST_COLUMNS[:3])) > 1
        if not text or is_joined or _version_of(text.removeprefix('\ufeff')) < VERSION:
            text = f'{VERSION_LINE}{VERSION}\n' + csv_row(DECISION_COLUMNS)
            text += _encoded(self.decisions)
        with written_whole(self._path) as file:
            file.write(text + rows)
        self.decisions = [*self.decisions, *new]
        self._state = _state_of(self._path)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """
        Read the file as it is now, and hold it: no other program appends to it inside the block.

        The folder is locked: the file may be replaced by one of a newer version.

        """
        folder = os.open(self._path.parent, os.O_RDONLY)
        try:
            fcntl.flock(folder, fcntl.LOCK_EX)
            state = _state_of(self._path)
            if state != self._state:
                self.decisions = read_decisions(self._path) if state else []
                self._state = state
            yield
        finally:
            os.close(folder)


def _encoded(decisions: Iterable[Decision]) -> str:
    """Return the rows of decisions; nothing is written for texts that cannot be."""
    rows = ''.join(csv_row(one.row()) for one in decisions)
    try:
        rows.encode()
    except UnicodeEncodeError as error:
        raise RecordingError(
            f'decision: expected text of Unicode, got half a character: {error}; write it again'
        ) from None
    return rows


def _state_of(path: Path) -> tuple[int, ...]:
    """Return what changes when a file is written; empty if there is none."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return ()
    return found.st_ino, found.st_size, found.st_mtime_ns


def _version_of(text: str) -> int:
    """Return the version of a file; 0 if its line cannot be read."""
    if not text.startswith(VERSION_LINE):
        return 1
    word = text.partition('\n')[0].removeprefix(VERSION_LINE).strip(' ,\r')
    return int(word) if word.isdecimal() else 0


def _whole_rows(text: str) -> str:
    """
    Return a text up to the end of its last whole row: a line feed that is not in quotes.

    A last row with all cells is whole without one, as spreadsheets and editors save it.

    """
    end = text.rfind('\n') + 1
    while text.count('"', 0, end) % 2:
        end = text.rfind('\n', 0, end - 1) + 1
    last = text[end:]
    is_first = _version_of(text.removeprefix('\ufeff')) == 1
    cells = next(csv.reader([last]), []) if last.count('"') % 2 == 0 else []
    is_whole = len(cells) >= len(FIRST_COLUMNS if is_first else DECISION_COLUMNS)
    return text + '\n' if is_whole else text[:end]


def _parsed(row: dict[str, str], version: int) -> Decision:
    """Return the decision of a row; raises ValueError for text that is no number."""
    box = None
    if any(row[name] for name in PINNED_BOX_COLUMNS):
        numbers = np.array([float(row[name] or 'nan') for name in PINNED_BOX_COLUMNS])
        (box,) = boxes_from_quaternions(numbers[:3], numbers[7:], numbers[3:7])
    text = str if version == 1 else unprotected
    stamp, end = (row.get(name, '') for name in ('stamp_ns', 'end_ns'))
    return Decision(
        text(row['track_id']),
        int(stamp) if stamp else None,
        row['decision'],
        text(row['comment']),
        text(row['frame_id']),
        box,
        int(end) if end else None,
        text(row.get('value', '')),
        text(row.get('who', '')),
        row.get('when', ''),
    )
