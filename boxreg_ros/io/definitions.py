"""
Message definitions: those of a recording, and those known of types that it does not define.

Recordings before ROS 2 Iron have no definitions in their databases, and nobody can add them later.
The definitions of all types that are read are known here: `rosbags` has the packages of ROS 2
itself, and ``msg_adapters/interfaces`` those of the others, by release of ROS 2.

"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import cache, lru_cache
from pathlib import Path
import re
from typing import Any, NamedTuple

import msg_adapters
from msg_adapters.cdr import Definitions
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.typesys import get_types_from_idl, get_types_from_msg, get_typestore, Stores
from rosbags.typesys.msg import normalize_msgtype
from rosbags.typesys.store import Typestore

RELEASES = {
    'jazzy': Stores.ROS2_JAZZY,
    'humble': Stores.ROS2_HUMBLE,
    'galactic': Stores.ROS2_GALACTIC,
    'foxy': Stores.ROS2_FOXY,
}
"""Releases of ROS 2 whose definitions are known, newest first, and their packages in rosbags."""
INTERFACES = Path(msg_adapters.__file__).parent / 'interfaces'
"""``RELEASE/PACKAGE/msg/TYPE.msg``: the definition in that release and in later ones."""
IDL_SEPARATOR = '=' * 80 + '\n'
MSG_SEPARATOR = re.compile(r'^=+\n(?=MSG: )', re.MULTILINE)
NO_IDL = re.compile(
    r'"(?:\\.|[^"\\])*"|//[^\n]*|/\*.*?\*/|^[ \t]*#[^\n]*', re.DOTALL | re.MULTILINE
)
"""
Strings, comments, and lines for the preprocessor of IDL, as ``#include``.

rosbags (0.11.9) does not parse the last, which rosbag2 leaves in the definitions of packages that
are written in IDL.

"""

Types = Mapping[str, Any]
"""Name of a type -> its constants and fields, as rosbags has them."""


class TypeDefinition(NamedTuple):
    """The definition of a type with all that it refers to."""

    store: Typestore
    release: str
    """Release of ROS 2 that it is known from; empty if the recording has it."""


@lru_cache(maxsize=64)
def definitions_of(
    kind: str, recorded: MessageDefinition, is_ros1: bool
) -> tuple[TypeDefinition, ...]:
    """
    Return the definitions that messages of a type may have, the most probable first.

    It is one, if the recording has it; else that of each release of ROS 2 in which it differs.
    There is none of a type that is not known.

    Parameters
    ----------
    kind : str
        The type, ``package/msg/Type``.
    recorded : MessageDefinition
        The definition in the recording; its format is NONE where it has none.
    is_ros1 : bool
        Whether the messages are of ROS 1, whose recordings have all definitions.

    """
    own = types_of(kind, recorded)
    found: dict[str, TypeDefinition] = {}
    for release in ('',) if is_ros1 else RELEASES:
        complete = _closure(kind, own, _known_types(release))
        if complete is not None:
            is_own = own.keys() >= complete.keys()
            key = repr(sorted((name, fields) for name, (_, fields) in complete.items()))
            if key not in found:
                found[key] = TypeDefinition(_store_of(complete), '' if is_own else release)
    return tuple(found.values())


def known_store(kinds: Iterable[str], is_ros1: bool = False) -> Typestore:
    """Return the newest known definitions of types; KeyError if one of them is not known."""
    types: dict[str, Any] = {}
    for kind in kinds:
        complete = _closure(kind, {}, _known_types('' if is_ros1 else next(iter(RELEASES))))
        if complete is None:
            raise KeyError(kind)
        types.update(complete)
    return _store_of(types)


def fields_of(store: Typestore) -> Definitions:
    """Return the function that gives the fields of each type of a store."""

    def fields(name: str) -> dict[str, str]:
        return {field: _text_of(node) for field, node in store.fielddefs[name][1]}

    return fields


def _text_of(node: Any) -> str:
    """Return the type of a field, which rosbags has as a tree, in the words of rclpy."""
    kind, (first, second) = node if node[0] != Nodetype.NAME else (node[0], (node[1], 0))
    if kind == Nodetype.ARRAY:
        return f'{_text_of(first)}[{second}]'
    return f'sequence<{_text_of(first)}>' if kind == Nodetype.SEQUENCE else str(first)


def types_of(kind: str, recorded: MessageDefinition) -> Types:
    """Return the types that a definition in a recording has, but for those that are malformed."""
    text = recorded.data.lstrip('\ufeff').replace('\r\n', '\n')
    types: dict[str, Any] = {}
    if recorded.format == MessageDefinitionFormat.MSG and text.strip():
        first, *others = MSG_SEPARATOR.split(text)
        sections = [(kind, first), *(_named(section) for section in others)]
        for name, section in sections:
            with suppress(Exception):  # of the parser, for any malformed definition
                types.update(get_types_from_msg(section, name))
    elif recorded.format == MessageDefinitionFormat.IDL:
        for section in text.split(IDL_SEPARATOR):
            body = section.partition('\n')[2] if section.startswith('IDL: ') else section
            body = NO_IDL.sub(_without_directive, body)
            if body.strip():
                with suppress(Exception):
                    types.update(get_types_from_idl(body))
    return types


def _named(section: str) -> tuple[str, str]:
    """Return name and definition of a section that begins with ``MSG: ``."""
    head, _, text = section.partition('\n')
    return normalize_msgtype(head.removeprefix('MSG: ').strip()), text


def _without_directive(found: re.Match[str]) -> str:
    """Return a string or a comment as it is, and nothing for a line of the preprocessor."""
    return '' if found[0].lstrip().startswith('#') else found[0]


def _closure(kind: str, own: Types, known: Callable[[str], Any]) -> dict[str, Any] | None:
    """Return a type and all that it refers to, its own before known ones; None if one is not."""
    found: dict[str, Any] = {}
    waiting = [kind]
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        definition = own.get(name) or known(name)
        if definition is None:
            return None
        found[name] = definition
        for _, field in definition[1]:
            node, value = field
            inner, target = value[0] if node in (Nodetype.ARRAY, Nodetype.SEQUENCE) else field
            if inner == Nodetype.NAME:
                waiting.append(target)
    return found


@cache
def _known_types(release: str) -> Callable[[str], Any]:
    """Return the function that returns a known type of a release, None without; '' is ROS 1."""
    stock: Types = get_typestore(RELEASES.get(release, Stores.ROS1_NOETIC)).fielddefs
    names = list(RELEASES)
    folders = (
        [INTERFACES / name for name in names[: names.index(release) + 1][::-1]] if release else []
    )

    @cache
    def known(name: str) -> Any:
        package, _, kind = name.partition('/msg/')
        for folder in folders:
            file = folder / package / 'msg' / f'{kind}.msg'
            if kind and file.is_file():
                return get_types_from_msg(file.read_text(encoding='utf-8'), name)[name]
        return stock.get(name)

    return known


def _store_of(types: Types) -> Typestore:
    """Return a store of types."""
    store = get_typestore(Stores.EMPTY)
    store.register(dict(types))
    return store
