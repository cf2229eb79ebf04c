"""What is found to be wrong with an input, in words and with its reason."""

from __future__ import annotations

from collections.abc import Sequence
import re
from typing import NamedTuple

from boxreg_ros.reasons import Reason


class Finding(NamedTuple):
    """A fault of the input, or a guess about it."""

    reason: Reason
    """By which the node counts it."""
    text: str
    """What was found and what to do, for people."""


ADVISED = re.compile(
    r'; (?:set [^;]*?\(boxreg relabel[a-z ]*: |correct [a-z ]+ with )(--[^();]+?)(?:\)| \(node)'
)
"""The options in a text that advises them without a condition, as `advice` states them."""


def advice(name: str, value: object) -> str:
    """Return how an option is set, for the node and for commands."""
    return f'set {name}:={value} (boxreg relabel: --{name.replace("_", "-")} {value})'


def advice_for_some(correction: str) -> str:
    """Return how boxes of some classes are corrected."""
    return (
        f'an option is for all classes: {correction} where they are made, or in the boxes.csv '
        f'that boxreg convert RECORDING#TOPIC --from recording --to csv writes and boxreg relabel '
        f'--labels csv:FOLDER reads'
    )


def listed(names: Sequence[str]) -> str:
    """Return class names as part of a sentence."""
    return ', '.join(map(repr, names))
