"""
Command line options, stated once: in the dataclass whose field has the value.

`boxreg_ros.offline.arguments` adds them to the parser of each command that takes them.

"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field
from typing import Any, NamedTuple


class Option(NamedTuple):
    """
    An option as users see it.

    Attributes
    ----------
    meaning : str
        For help texts, to which the unit is added, and a default that is not empty unless it is
        stated here.
    flag : str
        Empty for the name of the field, with ``--`` before it.
    metavar : str or None
        Placeholder of the value in help texts.
    parse : callable
        Returns the value of a text, or raises `argparse.ArgumentTypeError` with what is expected.
    text : callable
        Returns the text of a value: the inverse of `parse`.
    choices : tuple of str
        Allowed values; empty for any.
    is_repeated : bool
        True if the field is a tuple, with one parsed value for each time the option is given.
    unit : str
        Of a number; empty for none.
    low, high : float or None
        Bounds of a number where it is a parameter of the node.

    """

    meaning: str
    flag: str = ''
    metavar: str | None = None
    parse: Callable[[str], Any] = str
    text: Callable[[Any], str] = str
    choices: tuple[str, ...] = ()
    is_repeated: bool = False
    unit: str = ''
    low: float | None = None
    high: float | None = None


def option(default: Any, meaning: str, **facts: Any) -> Any:
    """Return a dataclass field with the facts of an `Option` as metadata."""
    return field(default=default, metadata={'option': Option(meaning, **facts)})
