"""
Serialised messages: the places of their fields, read and written as arrays.

A message of 1,000 boxes becomes 10,000 Python objects, which takes ROS 50 to 100 ms, and Python
more. Here one loop walks through the strings and sequences of a message, with all numbers between
two of them in one step; numbers are then copied to and from arrays.

"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
import re
from struct import error as ShortError
from struct import Struct
from typing import Any, NamedTuple

from boxreg_ros.errors import UnsupportedMessage
import numpy as np
from numpy.typing import NDArray

HEADER = 4
"""Bytes before the first field; alignment counts from there."""
LITTLE_ENDIAN = b'\0\1'
"""First bytes of the header, of the only encoding that is walked."""
MOST_PADDING = 3
"""Bytes behind the last field, which fill a message up to whole numbers of 4 bytes."""
PREFIX = Struct('<I')
"""Of strings and sequences, before their first element."""
SIZES = {
    **dict.fromkeys(('boolean', 'bool', 'octet', 'byte', 'char', 'int8', 'uint8'), 1),
    **dict.fromkeys(('int16', 'uint16'), 2),
    **dict.fromkeys(('int32', 'uint32', 'float', 'float32'), 4),
    **dict.fromkeys(('int64', 'uint64', 'double', 'float64'), 8),
}
"""Size of each type of numbers, which is its alignment as well [bytes]."""
FIELD_TYPE = re.compile(
    r'(?:sequence<(?P<of>[^,>]+).*>|(?P<one>[^\[<]+)(?:<=\d+)?(\[(?P<n>\d+)\])?)'
)
"""A field type: ``double``, ``double[36]``, ``sequence<std_msgs/Header>``, ..."""

Definitions = Callable[[str], Mapping[str, str]]
"""Name of a message type -> its fields and their types, in order."""


def installed_definition(name: str) -> Mapping[str, str]:
    """Return the fields of a message type of rclpy, see `Definitions`."""
    package, _, kind = name.partition('/')
    message = getattr(import_module(f'{package}.msg'), kind.removeprefix('msg/'))
    fields: Mapping[str, str] = message.get_fields_and_field_types()
    return fields


class Layout:
    """
    Steps through the fields of a message type, and where some of them are found.

    Fields to find are paths, as ``items.pose.position.x``. Raises UnsupportedMessage if the type
    lacks one of the fields, or has one of a type that is not walked. `kinds` has their types and
    counts.

    """

    def __init__(self, type_name: str, definitions: Definitions, paths: Sequence[str]) -> None:
        self._definitions = definitions
        self._fields: dict[str, _Field] = {}
        self.kinds: dict[str, tuple[str, int]] = {}
        self._columns = 0
        self._steps = self._steps_of(self._parts_of(type_name, ''))
        self._last: _Places | None = None
        missing = set(paths) - self._fields.keys()
        if missing:
            raise UnsupportedMessage(
                f'{type_name}: expected the fields {", ".join(sorted(missing))}, got a '
                f'definition without; install the current definition'
            )
        self._fields = {path: self._fields[path] for path in paths}
        self.kinds = {path: self.kinds[path] for path in paths}

    def fields_of(self, data: bytes) -> Fields | None:
        """Return the fields of a message; None if it is not a whole one of this type."""
        if data[: len(LITTLE_ENDIAN)] != LITTLE_ENDIAN:
            return None
        if self._last is None or not self._last.fit(data):
            self._last = self._places_of(data)
        if self._last is None:
            return None
        size = len(data) - HEADER
        body = np.zeros(-(-size // 8) * 8, np.uint8)  # whole numbers of 8 bytes
        body[:size] = np.frombuffer(data, np.uint8, size, HEADER)
        return Fields(data, body, self._last.of)

    def _places_of(self, data: bytes) -> _Places | None:
        """Return where the fields of a message are; None if it is not a whole one."""
        columns: list[list[Any]] = [[] for _ in range(self._columns + 1)]
        try:
            end = HEADER + _walk(data, 0, self._steps, columns)
        except ShortError:
            return None
        if not end <= len(data) <= end + MOST_PADDING:
            return None
        places = {path: field.places(columns) for path, field in self._fields.items()}
        prefixes = np.array(columns[-1], np.int64) // PREFIX.size
        return _Places(places, len(data), prefixes, _words(data)[prefixes])

    def _parts_of(self, type_name: str, prefix: str) -> Iterator[tuple[str, str, int]]:
        """Yield path, type and count of all fields of a type and of messages in it; -1: any."""
        for name, text in self._definitions(type_name).items():
            match = FIELD_TYPE.fullmatch(text)
            if match is None:
                raise UnsupportedMessage(f'{prefix}{name}: expected a type of ROS, got {text}')
            element = match['of'] or match['one']
            count = -1 if match['of'] else int(match['n'] or 1)
            if '/' in element and count == 1:
                yield from self._parts_of(element, f'{prefix}{name}.')
            else:
                yield prefix + name, element, count

    def _steps_of(self, parts: Iterable[tuple[str, str, int]]) -> tuple[_Step, ...]:
        """Return the steps through fields, whose places are noted in columns of their own."""
        steps: list[_Step] = []
        for path, element, count in parts:
            self.kinds[path] = element, count
            size = SIZES.get(element, 0)
            if not size or count < 0:
                steps.append(self._step_of(path, element, count))
                self._fields[path] = _Field(steps[-1].column)
                continue
            if not steps or not steps[-1].is_block or steps[-1].alignment < size:
                steps.append(_Step(True, size, 0, None, self._new_column()))
            block = steps[-1]
            offset = -(-block.size // size) * size
            self._fields[path] = _Field(block.column, offset, count)
            steps[-1] = block._replace(size=offset + size * count)
        return tuple(steps)

    def _step_of(self, path: str, element: str, count: int) -> _Step:
        """Return the step through what begins with its length."""
        if element in SIZES:
            return _Step(False, SIZES[element], SIZES[element], None, self._new_column())
        if element == 'string' and count == 1:
            return _Step(False, 1, 1, None, self._new_column())
        if count < 0 and '/' in element:
            items = self._steps_of(self._parts_of(element, f'{path}.'))
        elif count < 0 and element == 'string':
            items = (_Step(False, 1, 1, None, self._new_column()),)
        else:
            raise UnsupportedMessage(
                f'{path}: expected numbers, strings, messages, or sequences of them, got {element}'
            )
        return _Step(False, 1, 0, items, self._new_column())

    def _new_column(self) -> int:
        self._columns += 1
        return self._columns - 1


class _Step(NamedTuple):
    """A step of a walk: numbers that follow each other, or what begins with its length."""

    is_block: bool
    """Whether it is the former."""
    alignment: int
    size: int
    """Of all numbers of a block; of a letter, or of a number of a sequence [bytes]."""
    items: tuple[_Step, ...] | None
    """Steps through each message of a sequence; None if it has letters or numbers."""
    column: int
    """In which its places are noted."""


class _Field(NamedTuple):
    """Where a field is noted: numbers of a block have an offset in it."""

    column: int
    offset: int = 0
    numbers: int | None = None

    def places(self, columns: Sequence[Sequence[Any]]) -> NDArray[np.int64]:
        """Return offset and count of each, see `Fields`."""
        if self.numbers is None:
            return np.array(columns[self.column], np.int64).reshape(-1, 2)
        begins = np.array(columns[self.column], np.int64) + self.offset
        return np.column_stack([begins, np.full_like(begins, self.numbers)])


class _Places(NamedTuple):
    """Where the fields of a message are, and of all others of its length that `fit`."""

    of: dict[str, NDArray[np.int64]]
    """By path, see `Fields`."""
    size: int
    """Of the message [bytes]."""
    prefixes: NDArray[np.int64]
    """Where it states a length, among its numbers of 4 bytes."""
    lengths: NDArray[np.uint32]

    def fit(self, data: bytes) -> bool:
        """Return whether all lengths are those of a message, so that a walk finds the same."""
        is_as_long = len(data) == self.size
        return is_as_long and np.array_equal(_words(data)[self.prefixes], self.lengths)


def _words(data: bytes) -> NDArray[np.uint32]:
    """Return the whole numbers of 4 bytes behind the header of a message."""
    return np.frombuffer(data, '<u4', len(data) // PREFIX.size - 1, HEADER)


def _walk(data: bytes, position: int, steps: Sequence[_Step], columns: list[list[Any]]) -> int:
    """
    Walk through fields that begin at `position` behind the header; return where the last ends.

    Notes where blocks begin, and begin and count of all else; in the last column, where lengths
    are. Raises ShortError if a length is behind the end of the message, or states more items than
    it has bytes.

    """
    for is_block, alignment, size, items, column in steps:
        if is_block:
            position = -(-position // alignment) * alignment
            columns[column].append(position)
            position += size
            continue
        position = -(-position // PREFIX.size) * PREFIX.size
        columns[-1].append(position)
        (count,) = PREFIX.unpack_from(data, HEADER + position)
        position += PREFIX.size
        if count > len(data) - HEADER - position:
            raise ShortError
        if count:
            position = -(-position // alignment) * alignment
        columns[column].append((position, count))
        if items is None:
            position += size * count
            continue
        for _ in range(count):
            position = _walk(data, position, items, columns)
    return position


@dataclass(eq=False, repr=False)
class Fields:
    """
    The fields that a `Layout` has found in a message.

    `data` is the message, `body` its bytes after the header, filled up to a multiple of 8 with
    zeros. `places` has offset in `body` and count (numbers, letters, items) of each field by path,
    (k, 2).

    """

    data: bytes
    body: NDArray[np.uint8]
    places: dict[str, NDArray[np.int64]]

    def __post_init__(self) -> None:
        """Begin with no string decoded."""
        self._strings: dict[str, list[bytes]] = {}  # by path, once they are asked for

    def copied(self) -> Fields:
        """Return fields to put other numbers into, which do not change these."""
        return Fields(self.data, self.body.copy(), self.places)

    def counts(self, path: str) -> NDArray[np.int64]:
        """Return how many elements (k,) a sequence or array has, for each item that it is in."""
        return self.places[path][:, 1]

    def numbers(self, path: str, dtype: str, width: int = 1) -> NDArray[Any]:
        """
        Return a field and the numbers that follow it without a gap.

        Parameters
        ----------
        path : str
            Of the first of them, one of those that the `Layout` was asked to find.
        dtype : str
            Of each number, as in ``'<f8'``; all of them have this one.
        width : int
            How many numbers there are for each of the k items that have the field.

        Returns
        -------
        values : array, shape (k, width)
            A copy; `put` writes it back.

        Raises
        ------
        KeyError
            If the `Layout` was not asked to find `path`.

        """
        values: NDArray[Any] = self.body.view(dtype)[self._index(path, dtype, width)]
        return values

    def put(self, path: str, values: NDArray[Any]) -> None:
        """
        Replace the numbers that `numbers` returns.

        Parameters
        ----------
        path : str
            As of `numbers`.
        values : array, shape (k, width)
            Of the dtype of the field: they are not converted.

        """
        dtype = values.dtype.str
        self.body.view(dtype)[self._index(path, dtype, values.shape[1])] = values

    def texts(self, path: str) -> list[str]:
        """Return strings; bytes that are no UTF-8 are replaced."""
        encoded = self._encoded(path)
        decoded = {text: text.decode(errors='replace') for text in set(encoded)}
        return [decoded[text] for text in encoded]

    def distinct(self, path: str) -> set[str]:
        """Return the different strings among those of `texts`."""
        return {text.decode(errors='replace') for text in set(self._encoded(path))}

    def message(self) -> bytes:
        """Return the message with the numbers that were put."""
        return self.data[:HEADER] + self.body[: len(self.data) - HEADER].tobytes()

    def _encoded(self, path: str) -> list[bytes]:
        """Return strings without the zero that ends each."""
        if path not in self._strings:
            offset, length = self.places[path].T
            begin = HEADER + offset
            ends = (begin + np.maximum(length - 1, 0)).tolist()
            data = self.data
            self._strings[path] = [
                data[first:end] for first, end in zip(begin.tolist(), ends, strict=True)
            ]
        return self._strings[path]

    def _index(self, path: str, dtype: str, width: int) -> NDArray[np.int64]:
        first = self.places[path][:, :1] // np.dtype(dtype).itemsize
        index: NDArray[np.int64] = first + np.arange(width)
        return index
