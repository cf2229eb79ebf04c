"""Tables of boxes: the content of ``boxes.csv`` and of truth files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
import csv
from dataclasses import dataclass
from functools import lru_cache
from io import StringIO
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from boxreg_ros.errors import RecordingError, unreadable
from boxreg_ros.rotations import boxes_from_quaternions, quaternion_from_rpy
from boxreg_ros.structures import (
    BOX_EXTENT,
    BoxArray,
    Columns,
    concatenated,
    Floats,
    Ints,
    REJECTED,
    ROLL,
)
import numpy as np
from numpy.typing import NDArray
import orjson

COLUMNS = (
    'stamp_ns', 'frame_id', 'track_id', 'class_name', 'score', 'x', 'y', 'z',
    'qx', 'qy', 'qz', 'qw', 'length', 'width', 'height', 'status', 'num_points',
)  # fmt: skip
FORMULA_STARTS = ('=', '+', '-', '@', '\t', '\r', "'")
"""Spreadsheets run cells that begin so as formulas, or hide the first character."""
_T = TypeVar('_T')
csv.field_size_limit(2**31 - 1)  # ids may be as long as messages


@dataclass(frozen=True, slots=True)
class BoxTable(Columns):
    """Boxes of many stamps, one row each, as in ``boxes.csv``."""

    COLUMNS: ClassVar[tuple[str, ...]] = (
        *('stamps_ns', 'track_ids', 'class_names', 'scores', 'boxes', 'status', 'num_points'),
    )

    stamps_ns: Ints
    """(n,), of the headers [ns]."""
    frame_id: str
    """Of all `boxes`; empty when there are none."""
    track_ids: tuple[str, ...]
    class_names: tuple[str, ...]
    scores: Floats
    boxes: Floats
    """(n, 9), as defined in `structures`."""
    status: tuple[str, ...]
    """Where each box comes from."""
    num_points: Ints
    """(n,), returns of the object, or inside the box."""

    @classmethod
    def from_arrays(cls, arrays: Sequence[BoxArray], status: str = 'input') -> BoxTable:
        """
        Return the rows of box arrays in order.

        Parameters
        ----------
        arrays : sequence of BoxArray
            All in one frame; may be empty.
        status : str
            Of all rows.

        Returns
        -------
        table : BoxTable
            One row per box, with no points counted; attributes, pins and kinematics are left out.

        Raises
        ------
        RecordingError
            If the arrays are in several frames.

        """
        frame_ids = {array.frame_id for array in arrays}
        if len(frame_ids) > 1:
            raise RecordingError(
                f'boxes: expected one frame, got {", ".join(sorted(frame_ids))}; relabel first'
            )
        every = concatenated([BoxArray.empty(0, ''), *(array.plain() for array in arrays)])
        count = len(every.track_ids)
        counts = [len(array.track_ids) for array in arrays]
        return cls(
            np.repeat([array.stamp_ns for array in arrays], counts).astype(np.int64),
            frame_ids.pop() if frame_ids else '',
            every.track_ids,
            every.class_names,
            every.scores,
            every.boxes,
            (status,) * count,
            np.zeros(count, np.int64),
        )

    def without_rejected(self) -> BoxTable:
        """Return it without rejected boxes, which are no labels."""
        return self.rows(np.array([status != REJECTED for status in self.status], bool))

    @classmethod
    def read(cls, path: str | Path) -> BoxTable:
        """
        Read a CSV file with the columns of ``boxes.csv``; others beside them are ignored.

        Raises RecordingError if the file cannot be read, a column is missing, a value is not what
        its column needs, or the rows are in several frames.

        """
        tables = cls.read_frames(path)
        if len(tables) > 1:
            raise RecordingError(
                f'{path}: expected one frame, got {", ".join(sorted(tables))}; transform all '
                f'boxes to one of them'
            )
        return next(iter(tables.values()), cls.from_arrays([]))

    @classmethod
    def read_frames(cls, path: str | Path) -> dict[str, BoxTable]:
        """Return a table per frame of a file, and raise as `read` does but for several frames."""
        try:
            with open(path, newline='', encoding='utf-8-sig') as file:  # spreadsheets add a BOM
                reader = csv.DictReader(file)
                names = reader.fieldnames or ()
                missing = [name for name in COLUMNS if name not in names]
                if missing:
                    raise RecordingError(
                        f'{path}: not a table of boxes, columns missing: {", ".join(missing)}; '
                        f'expected those of boxes.csv, in UTF-8 with commas, got '
                        f'{", ".join(names)[:100]!r}; add them, or give another file'
                    )
                rows = [(reader.line_num, row) for row in reader]
        except OSError as error:
            raise RecordingError(unreadable(path, error)) from None
        except (UnicodeDecodeError, csv.Error) as error:
            raise RecordingError(
                f'{path}: cannot be read as CSV in UTF-8: {error}; give a table like boxes.csv'
            ) from None
        of_frame: dict[str, list[tuple[int, dict[str, str]]]] = {}
        for line, row in rows:
            of_frame.setdefault(unprotected(row['frame_id']), []).append((line, row))
        return {name: cls._parsed(path, name, part) for name, part in of_frame.items()}

    @classmethod
    def _parsed(
        cls, path: str | Path, frame_id: str, numbered: list[tuple[int, dict[str, str]]]
    ) -> BoxTable:
        def column(name: str, kind: type[int] | type[float], empty: str = '') -> list[Any]:
            values = []
            for line, row in numbered:
                try:
                    value = kind(row[name] or empty)
                    values.append(np.int64(value) if kind is int else value)
                except (ValueError, OverflowError) as error:
                    what = 'a whole number' if kind is int else 'a number'
                    what += ' of 64 bits' * isinstance(error, OverflowError)
                    what += ' (ns, which spreadsheets round)' * (name == 'stamp_ns')
                    raise RecordingError(
                        f'{path}: line {line}, column {name}: expected {what}, got '
                        f'{row[name] or "nothing"}; correct the line'
                    ) from None
            return values

        rows = [row for _, row in numbered]
        stamps = np.array(column('stamp_ns', int), np.int64)
        num_points = np.array(column('num_points', int), np.int64)
        numbers = np.array([column(name, float, 'nan') for name in COLUMNS[4:15]]).T
        return cls(
            stamps,
            frame_id,
            tuple(unprotected(row['track_id']) for row in rows),
            tuple(unprotected(row['class_name']) for row in rows),
            numbers[:, 0],
            boxes_from_quaternions(numbers[:, 1:4], numbers[:, 8:], numbers[:, 4:8]),
            tuple(row['status'] for row in rows),
            num_points,
        )

    def rows(self, keep: NDArray[np.bool_]) -> BoxTable:
        """Return the rows where `keep` (n,) is True."""
        return self.take(np.flatnonzero(keep))

    def write(self, path: str | Path) -> None:
        """Write all rows as CSV, in the columns of ``boxes.csv``."""
        quaternions = quaternion_from_rpy(self.boxes[:, ROLL:])
        with open(path, 'w', newline='', encoding='utf-8') as file:
            file.write(csv_row(COLUMNS))
            for i, box in enumerate(self.boxes):
                numbers = (self.scores[i], *box[:3], *quaternions[i], *box[BOX_EXTENT])
                file.write(csv_row([
                    self.stamps_ns[i],
                    *map(protected, (self.frame_id, self.track_ids[i], self.class_names[i])),
                    *(f'{number:.9f}' for number in numbers), self.status[i], self.num_points[i],
                ]))  # fmt: skip


def parsed_rows(path: Path, parsed: Callable[[dict[str, str]], _T]) -> Iterator[_T]:
    """
    Yield what is parsed of each row of a table.

    Parameters
    ----------
    path : Path
        A CSV file with a header, in UTF-8.
    parsed : callable
        Returns the value of a row, which is a mapping of columns to texts.

    Yields
    ------
    value
        Of each row, in order.

    Raises
    ------
    RecordingError
        If the file cannot be read, or a row lacks a column or has no number in its place.

    """
    try:
        with path.open(newline='', encoding='utf-8-sig') as file:
            yield from map(parsed, csv.DictReader(file))
    except OSError as error:
        raise RecordingError(unreadable(path, error)) from None
    except (AttributeError, KeyError, TypeError, ValueError, csv.Error) as error:
        raise RecordingError(
            f'{path}: expected the columns of {path.name}, with numbers where they belong, got '
            f'{error}; relabel again, or delete the file'
        ) from None


def box_of(row: dict[str, str]) -> tuple[int, str]:
    """Return stamp [ns] and id of a row of a table beside ``boxes.csv``."""
    return int(row['stamp_ns']), unprotected(row['track_id'])


def read_by_box(path: Path, parsed: Callable[[dict[str, str]], _T]) -> dict[tuple[int, str], _T]:
    """Return what is `parsed` of the first row of each box, as `box_of` and `parsed_rows` do."""
    found: dict[tuple[int, str], _T] = {}
    for box, values in parsed_rows(path, lambda row: (box_of(row), parsed(row))):
        found.setdefault(box, values)
    return found


def csv_row(cells: Iterable[object]) -> str:
    """Return one row of CSV with its end; texts with a carriage return are quoted, too."""
    row = StringIO(newline='')
    csv.writer(row, lineterminator='\r\n').writerow(cells)
    return row.getvalue()[:-2] + '\n'


def number_cells(numbers: NDArray[Any], unknown: str) -> list[str]:
    """
    Return the cells of each row of numbers, with commas between them.

    Parameters
    ----------
    numbers : array, shape (n, k)
        They are written with as few digits as state them in their precision.
    unknown : str
        Stands for all that are not finite.

    Returns
    -------
    list of n str
        Without the ends of the lines.

    """
    if not len(numbers):
        return []
    rows = np.ascontiguousarray(numbers)
    text = orjson.dumps(rows, option=orjson.OPT_SERIALIZE_NUMPY).decode()
    if not np.isfinite(rows).all():
        text = text.replace('null', unknown)
    return [row[2:] for row in text.split(']')[:-2]]  # without '[[' or ',['


def single_precision(numbers: Floats) -> NDArray[np.float32]:
    """Return numbers with nine digits at most; those beyond its range are not finite."""
    with np.errstate(over='ignore'):
        return numbers.astype(np.float32)


@lru_cache(1024)
def cell(text: str) -> str:
    """Return a text as one of several cells of a row of CSV: in quotes where it needs them."""
    return csv_row(('', protected(text)))[1:-1]


def protected(text: str) -> str:
    """Return a text as a cell that no spreadsheet takes for a formula; a signed number is none."""
    if not text.startswith(FORMULA_STARTS):
        return text
    with suppress(ValueError):
        float(text)
        return text
    return f"'{text}"


def unprotected(cell: str) -> str:
    """Return the text of a cell that `protected` has made."""
    return cell[1:] if cell.startswith("'") else cell
