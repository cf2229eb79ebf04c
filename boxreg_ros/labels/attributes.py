"""
Attributes of objects as label formats have them: names and values, both text.

Three names are in several formats, in other words, and are translated: ``occluded`` with the
values ``false``, ``partly`` and ``true``, ``truncated`` and
``parked`` with ``false`` and ``true``. Every other attribute keeps its name and value.

"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from decimal import Decimal

OCCLUDED, TRUNCATED, PARKED = 'occluded', 'truncated', 'parked'
FALSE, PARTLY, TRUE = 'false', 'partly', 'true'
UNSET = ('', '0', FALSE, 'no', 'none')
"""Values that are not set, in lower case; so is a number that is zero."""
NUSCENES_NAMES = {
    f'occlusion_state.{value}': (OCCLUDED, ours)
    for value, ours in (('none', FALSE), ('partial', PARTLY), ('most', TRUE))
} | {
    'truncation_state.non-truncated': (TRUNCATED, FALSE),
    'truncation_state.truncated': (TRUNCATED, TRUE),
    'vehicle.parked': (PARKED, TRUE),
    'vehicle_state.parked': (PARKED, TRUE),
}
"""Attributes of nuScenes and T4 that are translated."""


def is_set(value: str) -> bool:
    """Return whether an attribute is set: to anything but no, none and zero."""
    try:
        return float(value) > 0
    except ValueError:
        return value.lower() not in UNSET


def plain(value: str) -> bool | str:
    """Return a value as JSON has it: true and false are no text."""
    return value == TRUE if value in (TRUE, FALSE) else value


def attributes_from(
    values: Mapping[str, object], left_out: Collection[str] = ()
) -> dict[str, str]:
    """Return the attributes among values of JSON: texts, numbers, true and false."""
    found = {}
    for name, value in values.items():
        if name in left_out or not isinstance(value, str | int | float | Decimal) or value == '':
            continue
        found[name] = str(value).lower() if isinstance(value, bool) else str(value)
        if found[name] in ('True', 'False'):  # some versions of tools write them as text
            found[name] = found[name].lower()
    return found


def of_nuscenes(names: Collection[str]) -> dict[str, str]:
    """Return attributes of their names in nuScenes or T4: GROUP.VALUE."""
    parts = {name: name.partition('.') for name in names}
    return dict(
        NUSCENES_NAMES.get(name, (group, value or TRUE))
        for name, (group, _, value) in parts.items()
    )


def to_nuscenes(attributes: Mapping[str, str], parked: str) -> list[str]:
    """Return the names of attributes in nuScenes or T4; `parked` is that of a parked vehicle."""
    words = {pair: name for name, pair in NUSCENES_NAMES.items()} | {(PARKED, TRUE): parked}
    is_parked = is_set(attributes.get(PARKED, FALSE))
    found = []
    for name, value in attributes.items():
        if name == PARKED and not is_parked:
            continue  # it may be moving, or stopped
        if is_parked and name == parked.partition('.')[0]:
            continue  # of one group an object has one
        if name in (TRUNCATED, PARKED):
            value = TRUE if is_set(value) else FALSE
        found.append(words.get((name, value), f'{name}.{value}'))
    return found
