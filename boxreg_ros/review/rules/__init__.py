"""The table of rules that labels should keep, and their application to tracks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from boxreg_ros.review.rules import (
    backward,
    duplicate,
    ends_in_view,
    few_points,
    floating,
    jump,
    overlap,
    size_changes,
    size_outside_class,
    sliding,
    spin,
)
from boxreg_ros.review.rules.protocol import Labels, LabelTrack, Rule, Violation

RULES: dict[str, Rule] = {
    module.RULE.rule_id: module.RULE
    for module in (
        size_outside_class,
        size_changes,
        jump,
        spin,
        sliding,
        floating,
        overlap,
        duplicate,
        few_points,
        backward,
        ends_in_view,
    )
}
"""By id."""


def violations(tracks: Sequence[LabelTrack]) -> dict[str, list[Violation]]:
    """Return the violations of each rule that is violated, by its id."""
    usable = Labels(track for track in tracks if len(track.stamps_ns))
    found = {name: list(rule.find(usable)) for name, rule in RULES.items()}
    return {name: items for name, items in found.items() if items}


def counts(found: Mapping[str, Sequence[Violation]]) -> dict[str, int]:
    """Return the number of violations of every rule, by its id."""
    return {name: len(found.get(name, ())) for name in RULES}
