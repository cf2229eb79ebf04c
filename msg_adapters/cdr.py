"""
Serialised messages: the places of their fields, read and written as arrays.

A message of 1,000 boxes becomes 10,000 Python objects, which takes ROS 50 to 100 ms. Here a
compiled loop walks once through its bytes; numbers are then copied to and from arrays.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
import re
from typing import Any
from warnings import warn

from boxreg_ros.errors import UnsupportedMessage
import numpy as np
from numpy.typing import NDArray

HEADER = 4
"""Bytes before the first field; alignment counts from there."""
LITTLE_ENDIAN = 1
"""Second byte of the header, of the only encoding that is walked."""
STEP_NUMBERS, STEP_TEXT, STEP_SEQUENCE, STEP_ITEMS, STEP_END = range(5)
"""Steps of a walk: numbers, a string, a sequence of numbers; begin and end of repeated steps."""
SIZES = {
    **dict.fromkeys(('boolean', 'octet', 'char', 'int8', 'uint8'), 1),
    **dict.fromkeys(('int16', 'uint16'), 2),
    **dict.fromkeys(('int32', 'uint32', 'float'), 4),
    **dict.fromkeys(('int64', 'uint64', 'double'), 8),
}
"""Size of each type of numbers, which is its alignment as well [bytes]."""
FIELD_TYPE = re.compile(
    r'(?:sequence<(?P<of>[^,>]+).*>|(?P<one>[^\[<]+)(?:<=\d+)?(\[(?P<n>\d+)\])?)'
)
"""A field type of rclpy: ``double``, ``double[36]``, ``sequence<std_msgs/Header>``, ..."""


class Layout:
    """
    Steps through the fields of a message type, and where to note the places of some of them.

    `kind` is the class of the messages, of rclpy. Fields to find are paths, as
    ``items.pose.position.x``. Raises UnsupportedMessage if the type lacks one of the fields, or
    has one of a type that is not walked.

    """

    def __init__(self, kind: Any, paths: Sequence[str]) -> None:
        steps = list(self._steps_of(kind, ''))
        self._paths = tuple(dict.fromkeys(paths))
        missing = set(paths) - {path for *_, path in steps}
        if missing:
            raise UnsupportedMessage(
                f'{kind.__name__}: expected the fields {", ".join(sorted(missing))}, got a '
                f'definition without; install the current definition'
            )
        columns = {path: number for number, path in enumerate(self._paths)}
        rows = [(step, size, count, columns.get(path, -1)) for step, size, count, path in steps]
        self._steps = np.array(rows, np.int64)  # (steps, [step, size, count, column])

    def fields_of(self, data: bytes) -> Fields | None:
        """Return the fields of a message; None if it is not one of this type, or without numba."""
        walk_compiled = walker()
        if walk_compiled is None or len(data) < HEADER or data[1] != LITTLE_ENDIAN:
            return None
        size = len(data) - HEADER
        body = np.zeros(-(-size // 8) * 8, np.uint8)  # whole numbers of 8 bytes
        body[:size] = np.frombuffer(data, np.uint8, size, HEADER)
        counts = np.zeros(len(self._paths), np.int64)
        places = np.zeros((len(self._paths), 0, 2), np.int64)
        end = walk_compiled(body, size, self._steps, counts, places)
        if end < 0:
            return None
        places = np.zeros((len(self._paths), int(counts.max(initial=0)), 2), np.int64)
        counts[:] = 0
        walk_compiled(body, size, self._steps, counts, places)
        found = {path: places[i, : counts[i]] for i, path in enumerate(self._paths)}
        return Fields(data, body, found)

    def _steps_of(self, kind: Any, prefix: str) -> Iterator[tuple[int, int, int, str]]:
        """Yield step, size [bytes], count and path for all fields of a class."""
        for name, text in kind.get_fields_and_field_types().items():
            yield from self._steps_of_field(text, prefix + name)

    def _steps_of_field(self, text: str, path: str) -> Iterator[tuple[int, int, int, str]]:
        match = FIELD_TYPE.fullmatch(text)
        if match is None:
            raise UnsupportedMessage(f'{path}: expected a field type of ROS, got {text}')
        element = match['of'] or match['one']
        count = -1 if match['of'] else int(match['n'] or 1)  # -1: the message has the length
        if element in SIZES:
            yield (STEP_SEQUENCE if count < 0 else STEP_NUMBERS), SIZES[element], count, path
            return
        if element == 'string':
            inner = [(STEP_TEXT, 1, 1, path)]
        elif '/' in element:
            inner = list(self._steps_of(_class_of(element), f'{path}.'))
        else:
            raise UnsupportedMessage(f'{path}: expected numbers, strings or messages, got {text}')
        if count == 1:
            yield from inner
            return
        yield STEP_ITEMS, len(inner), count, path
        yield from inner
        yield STEP_END, 0, 0, ''


def _class_of(name: str) -> Any:
    """Return the class of rclpy of a message type."""
    package, _, kind = name.partition('/')
    return getattr(import_module(f'{package}.msg'), kind)


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
        """Return a field and the numbers that follow it without a gap, as an array (k, width)."""
        values: NDArray[Any] = self.body.view(dtype)[self._index(path, dtype, width)]
        return values

    def put(self, path: str, values: NDArray[Any]) -> None:
        """Replace the numbers that `numbers` returns for `path` by an array (k, width)."""
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


@cache
def walker() -> Callable[..., int] | None:
    """
    Return `walk` compiled, or loaded from disk; None where numba does not work.

    A warning names the reason.

    """
    try:
        import numba

        compiled = _compiled(numba)
        nothing = np.zeros(0, np.int64)
        bytes_, steps = np.zeros(0, np.uint8), np.zeros((0, 4), np.int64)
        compiled(bytes_, 0, steps, nothing, np.zeros((0, 0, 2), np.int64))
    except Exception as error:  # whatever a damaged cache or an unsupported processor raises
        reason = ' '.join(f'{type(error).__name__}: {error}'.split())
        warn(
            f'numba: expected to compile the reader of box messages, got {reason}; they are read '
            f'by rclpy, several times slower: delete __pycache__ beside {__file__}',
            RuntimeWarning,
            stacklevel=2,
        )
        return None
    return compiled


def _compiled(numba: Any) -> Callable[..., int]:
    """Compile `walk` at its first call; kept on disk where a folder can be written."""
    try:
        compiled: Callable[..., int] = numba.njit(walk, cache=True, nogil=True)
    except RuntimeError:
        compiled = numba.njit(walk, nogil=True)
    return compiled


def walk(body: Any, size: int, steps: Any, counts: Any, places: Any) -> int:
    """
    Walk through a message and note the places of fields.

    Of `body`, `size` bytes are the message. A row of `steps` is step, size, count and column.
    `counts` (columns,), zeros at first, is set to the number of fields found, and `places`
    (columns, capacity, 2) to offset and count of each, as far as there is room. Returns where the
    last field ends; -1 if the message lacks fields.

    """
    firsts = np.zeros(len(steps), np.int64)  # first repeated step, by depth
    lefts = np.zeros(len(steps), np.int64)  # repetitions left, by depth
    depth = 0
    position = 0
    i = 0
    while i < len(steps):
        step, width, count, column = steps[i]
        i += 1
        if step == STEP_END:
            lefts[depth] -= 1
            if lefts[depth] > 0:
                i = firsts[depth]
            else:
                depth -= 1
            continue
        if step == STEP_TEXT or count < 0:
            position = (position + 3) // 4 * 4
            if position + 4 > size:
                return -1
            low = np.int64(body[position]) | np.int64(body[position + 1]) << 8
            high = np.int64(body[position + 2]) | np.int64(body[position + 3]) << 8
            count = low | high << 16
            position += 4
        begin = position
        if step == STEP_ITEMS and count > 0:
            depth += 1
            firsts[depth] = i
            lefts[depth] = count
        elif step == STEP_ITEMS:
            i += width + 1
        elif count > 0:
            begin = (position + width - 1) // width * width
            position = begin + width * count
            if position > size:
                return -1
        if column >= 0:
            if counts[column] < places.shape[1]:
                place = places[column, counts[column]]
                place[0], place[1] = begin, count  # a tuple takes numba seconds to compile
            counts[column] += 1
    return position
