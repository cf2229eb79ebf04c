"""Files that several formats share: JSON, and the names of frames in ``boxreg.json``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
import json
from pathlib import Path
from typing import Any, BinaryIO

from boxreg_ros.errors import one_line, RecordingError, unreadable
import orjson

PROVENANCE_FILE = 'boxreg.json'
CONTENT_ERRORS = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)
"""Errors of reading content that does not follow a format."""
JSON_OPTIONS = orjson.OPT_NON_STR_KEYS | orjson.OPT_SERIALIZE_NUMPY


def visible(folder: Path, pattern: str) -> list[Path]:
    """
    Return the sorted paths of a pattern in a folder, without hidden ones.

    Other systems leave files such as ``._NAME.txt`` beside those that they copy or pack.

    """
    paths = sorted(folder.glob(pattern))
    return [
        path
        for path in paths
        if not any(part.startswith('.') for part in path.relative_to(folder).parts)
    ]


def require_single(found: Sequence[Path], path: Path, what: str) -> Path:
    """Return the only entry of `found` in `path`; RecordingError, naming `what`, for others."""
    if len(found) != 1:
        names = ', '.join(item.name for item in found) or 'none'
        raise RecordingError(f'{path}: expected one {what}, got {names}; name the path of one')
    return found[0]


def to_json(value: Any) -> str:
    """Return `value` as standard JSON: NaN and infinity become null, text is not escaped."""
    return _json_bytes(value).decode()


def _json_bytes(value: Any) -> bytes:
    return orjson.dumps(value, option=JSON_OPTIONS)


def write_json(path: Path, value: Any) -> None:
    """Write `value` as a JSON file of one line."""
    path.write_text(to_json(value) + '\n', encoding='utf-8')


def from_json(path: Path, parse_float: Callable[[str], Any] = float) -> Any:
    """
    Return the content of a JSON file.

    Parameters
    ----------
    path : Path
        In UTF-8, with or without a byte order mark.
    parse_float : callable
        Makes numbers with a decimal point of their text: a float has too few digits for a stamp.

    Returns
    -------
    content : object
        Of the types that `json` has for it.

    Raises
    ------
    RecordingError
        If the file cannot be read or is not JSON.

    """
    try:
        return json.loads(path.read_text(encoding='utf-8-sig'), parse_float=parse_float)
    except OSError as error:
        raise RecordingError(unreadable(path, error)) from None
    except (ValueError, RecursionError) as error:
        raise RecordingError(f'{path}: not JSON: {error}; write it again') from None


def json_items(path: Path) -> Iterator[Any]:
    """
    Yield the items of a list in a JSON file one by one, without holding the list.

    Raises RecordingError if the file cannot be read or is not JSON.

    """
    import ijson

    yield from _streamed(path, lambda file: ijson.items(file, 'item', use_float=True))


def json_members(path: Path, prefix: str) -> Iterator[tuple[str, Any]]:
    """Yield the names and values of an object at a place in a JSON file; as `json_items`."""
    import ijson

    yield from _streamed(path, lambda file: ijson.kvitems(file, prefix, use_float=True))


def _streamed(path: Path, parse: Callable[[BinaryIO], Iterator[Any]]) -> Iterator[Any]:
    import ijson

    try:
        with path.open('rb') as file:
            yield from parse(file)
    except OSError as error:
        raise RecordingError(unreadable(path, error)) from None
    except ijson.JSONError as error:
        raise RecordingError(f'{path}: not JSON: {one_line(error)}; write it again') from None


class JsonList:
    """
    A JSON file that holds one list, written item by item.

    `head` has members of an object around the list, in which it is called `name`.

    """

    def __init__(self, path: Path, head: Mapping[str, Any] | None = None, name: str = '') -> None:
        self._file = path.open('wb')
        begin = '' if head is None else f'{to_json(head)[:-1]},\n"{name}": '
        self._separator = f'{begin}[\n'.encode()

    def append(self, item: Any) -> None:
        """Add an item on a line of its own."""
        self._file.write(self._separator + _json_bytes(item))
        self._separator = b',\n'

    def close(self, tail: Mapping[str, Any] | None = None) -> None:
        """Close the list and the file; `tail` are members of the object after the list."""
        is_empty = self._separator != b',\n'
        end = f'{self._separator[:-1].decode()}]' if is_empty else '\n]'
        if tail is not None:
            end += ''.join(f',\n"{name}": {to_json(item)}' for name, item in tail.items()) + '}'
        self._file.write(f'{end}\n'.encode())
        self._file.close()


@contextmanager
def following(path: Path, what: str) -> Iterator[None]:
    """Raise errors of the content of `path` as RecordingError; `what` is what was expected."""
    try:
        yield
    except OSError as error:
        raise RecordingError(unreadable(path, error)) from None
    except CONTENT_ERRORS as error:
        raise RecordingError(f'{path}: expected {what}: {_words(error)}; correct it') from None


@contextmanager
def at(place: str) -> Iterator[None]:
    """Name a place in errors of its content, for `following`; places may be nested."""
    try:
        yield
    except CONTENT_ERRORS as error:
        raise ValueError(f'{place}: {_words(error)}') from None


def _words(error: Exception) -> str:
    """Return what is wrong with content in words."""
    if isinstance(error, KeyError):
        return f'lacks {error.args[0]!r}'
    if isinstance(error, AttributeError | TypeError):
        return f'got a value of another type ({error})'
    return (
        f'got a number out of range ({error})'
        if isinstance(error, ArithmeticError)
        else str(error)
    )


def write_provenance(folder: Path, content: Mapping[str, Any]) -> None:
    """Write ``boxreg.json``: the fields of `Provenance`, names of frames and of tracks."""
    write_json(folder / PROVENANCE_FILE, content)


def read_provenance(folder: Path) -> dict[str, Any]:
    """Return the content of ``boxreg.json``; empty if there is no such file."""
    path = folder / PROVENANCE_FILE
    content: dict[str, Any] = from_json(path) if path.exists() else {}
    return content


def frame_names(folder: Path, fixed: str = 'map', sensor: str = 'lidar') -> tuple[str, str]:
    """Return the names of the fixed and the sensor frame in ``boxreg.json``, or the defaults."""
    content = read_provenance(folder)
    return str(content.get('fixed_frame', fixed)), str(content.get('sensor_frame', sensor))
