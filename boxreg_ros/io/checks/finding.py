"""What is found to be wrong with an input, in words and with its reason."""

from __future__ import annotations

from typing import NamedTuple

from boxreg_ros.reasons import Reason


class Finding(NamedTuple):
    """A fault of the input, or a guess about it."""

    reason: Reason
    """By which the node counts it."""
    text: str
    """What was found and what to do, for people."""
