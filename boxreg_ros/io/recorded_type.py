"""Message types as a recording defines them, with the field types that rclpy would state."""

from __future__ import annotations

from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

NAMES = {'bool': 'boolean', 'byte': 'octet', 'float32': 'float', 'float64': 'double'}
"""Names of rclpy where those of definitions differ."""


class RecordedType:
    """
    Stand-in for the class of a message type, ``package/msg/Type`` or ``package/Type``.

    Raises KeyError if the recording has no definition of it.

    """

    def __init__(self, store: Typestore, name: str) -> None:
        package, _, kind = name.replace('/msg/', '/').partition('/')
        self.__name__ = name
        self._fields = store.fielddefs[f'{package}/msg/{kind}'][1]

    def get_fields_and_field_types(self) -> dict[str, str]:
        """Return the type of each field, as ``double[36]``."""
        return {name: _text(kind) for name, kind in self._fields}


def _text(kind: Any) -> str:
    """Return the type of a field."""
    node, value = kind
    if node == Nodetype.BASE:
        return NAMES.get(value[0], str(value[0]))
    if node == Nodetype.NAME:
        return str(value).replace('/msg/', '/')
    element, count = value
    return (
        f'{_text(element)}[{count}]' if node == Nodetype.ARRAY else f'sequence<{_text(element)}>'
    )
