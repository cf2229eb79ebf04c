"""Stamps of label files and of file names as whole nanoseconds, without rounding."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, UTC
from decimal import Decimal, InvalidOperation
from itertools import pairwise
import re
from typing import NamedTuple

STAMP_UNITS = ((11, 9), (14, 6), (17, 3), (19, 0))
"""
Most digits of a stamp before its point, and the power of ten from its unit to nanoseconds.

Of a file with one stamp that is in no unit between 2001 and 2100. Derived: eleven digits of
seconds are the year 5138, twelve of milliseconds begin in 1973; so no stamp has two units.

"""
FIRST_SECOND, LAST_SECOND = 10**9, 4_102_444_800
"""Stamps of clocks that are set lie between them [s since 1970]: 2001 to 2100; chosen."""
LONGEST_PAUSE = 1000
"""Labels of one drive are closer than this [s]; chosen: 15 minutes."""
STEP_UNITS = ((10**7, 0, 'nanoseconds'), (10**4, 3, 'microseconds'), (10, 6, 'milliseconds'))
"""
Shortest time between two frames in a unit, its power of ten, and its name; the rest are seconds.

Derived: labels have rates from 0.1 to 100 Hz, so each step has one unit.

"""
NAME_DIGITS = {10: 9, 13: 6, 16: 3, 19: 0}
"""
Powers of ten by the digits of a file name. Derived: stamps from 2001 to 2286 have exactly so
many, and numbers of frames have fewer or, as those of KITTI raw, begin with zeros; names of
`folder.frame_name` are filled up to 19.

"""
STAMP_NAME = re.compile(r'(?:.*?[^\d.])??(\d+)(?:\.(\d{1,9})|[_-](\d{9})|(_\d{1,3})?)')
"""
A stamp at the end of a file name, as those of nuScenes have it: a number with decimals, seconds
and nine digits of nanoseconds, or a number with the count that `frame_name` gives to equal stamps.

"""
ISO_FRACTION = re.compile(r'[.,](\d+)')
"""Decimals of the second in ISO 8601."""
LAST_NS = 2**63 - 1
"""Largest stamp of 64 bits [ns]; it is of the year 2262."""


class Stamps(NamedTuple):
    """The stamps of one label file."""

    stamps_ns: list[int]
    note: str
    """That their unit was guessed; empty where they state it."""


def stamps_ns(values: Sequence[object], *, are_nanoseconds: bool = False) -> list[int]:
    """Return the stamps of one label file [ns]; see `read_stamp_values`."""
    return read_stamp_values(values, are_nanoseconds=are_nanoseconds).stamps_ns


def read_stamp_values(values: Sequence[object], *, are_nanoseconds: bool = False) -> Stamps:
    """
    Return the stamps of one label file [ns].

    Parameters
    ----------
    values : sequence of n numbers or str
        Times in one unit: numbers or decimals as text, which are exact, floats as their shortest
        decimals; or moments as in ISO 8601, in UTC where they state no zone. Numbers are of the
        unit in which they lie between 2001 and 2100. Those of a clock that began later, such as at
        the first frame, are of the unit in which labels have a usual rate, see `STEP_UNITS`.
    are_nanoseconds : bool
        Whether whole numbers that do not lie between 2001 and 2100 are nanoseconds.

    Returns
    -------
    stamps : Stamps
        Decimals below a nanosecond are cut off.

    Raises
    ------
    ValueError
        If a value is no stamp, or one of them is negative or too large for 64 bits.

    """
    moments = [_moment_ns(value) for value in values]
    numbers = [
        _decimal(value) for value, moment in zip(values, moments, strict=True) if moment is None
    ]
    is_whole = all(number == number.to_integral_value() for number in numbers)
    exponent, note = _exponent(numbers, are_nanoseconds and is_whole)
    scaled = iter([int(number.scaleb(exponent)) for number in numbers])
    found = [next(scaled) if moment is None else moment for moment in moments]
    for value, stamp_ns in zip(values, found, strict=True):
        if not 0 <= stamp_ns <= LAST_NS:
            raise ValueError(f'expected a time since 1970, got {value}')
    return Stamps(found, note)


def stamps_of_names(names: Sequence[str]) -> list[int] | None:
    """
    Return the stamps that the names of files state [ns].

    Parameters
    ----------
    names : sequence of n str
        Without their suffixes: seconds, milliseconds, microseconds or nanoseconds since 1970, all
        in one unit, which the number of digits states, see `NAME_DIGITS`.

    Returns
    -------
    stamps_ns : list of n int, or None
        None if a name is no stamp, or two units fit.

    """
    found = [STAMP_NAME.fullmatch(name) for name in names]
    units = {None if one is None else _exponent_of_digits(one[1]) for one in found}
    if len(units) != 1 or None in units:
        return None
    (exponent,) = units
    stamps = []
    for one in found:
        assert one is not None and exponent is not None
        decimals = one[2] or one[3] or ''
        if decimals and len(decimals) > exponent:
            return None
        stamps.append(int(one[1] + decimals.ljust(exponent, '0')))
    return stamps


def _exponent_of_digits(digits: str) -> int | None:
    """Return the power of ten from the unit of a name to nanoseconds; None for other numbers."""
    exponent = NAME_DIGITS.get(len(digits))
    return None if exponent and digits.startswith('0') else exponent


def _decimal(value: object) -> Decimal:
    """Return a number, or the text of one, without rounding; ValueError for others."""
    if isinstance(value, bool) or not isinstance(value, int | float | str | Decimal):
        raise ValueError(f'expected a stamp, got {value!r}')
    try:
        number = Decimal(str(value).strip())
    except InvalidOperation:
        raise ValueError(
            f'expected a stamp as a number or as in ISO 8601, got {value!r}'
        ) from None
    if not number.is_finite():
        raise ValueError(f'expected a stamp, got {value!r}')
    return number


def _exponent(numbers: Sequence[Decimal], are_nanoseconds: bool) -> tuple[int, str]:
    """Return the power of ten from the unit of stamps to nanoseconds, and a note on a guess."""
    largest = max(numbers, default=Decimal(0))
    ordered = sorted(set(numbers))
    steps = sorted(after - before for before, after in pairwise(ordered))
    step = steps[len(steps) // 2] if steps else None
    for exponent in (9, 6, 3, 0):
        is_of_drive = step is None or step.scaleb(exponent - 9) < LONGEST_PAUSE
        if FIRST_SECOND <= largest.scaleb(exponent - 9) < LAST_SECOND and is_of_drive:
            return (0 if are_nanoseconds and step is None else exponent), ''
    if are_nanoseconds:
        return 0, ''
    if step is not None:
        return _exponent_of_step(step)
    digits = max(largest.adjusted() + 1, 1)
    for most, exponent in STAMP_UNITS:
        if digits <= most:
            return exponent, ''
    raise ValueError(f'expected at most 19 digits of nanoseconds since 1970, got {largest}')


def _exponent_of_step(step: Decimal) -> tuple[int, str]:
    """Return the exponent of stamps by the time between two frames, and a note if not seconds."""
    for shortest, exponent, unit in STEP_UNITS:
        if step >= shortest:
            return exponent, f'stamps: {step:f} from frame to frame are read as {unit}'
    return 9, ''


def _moment_ns(value: object) -> int | None:
    """Return a moment in ISO 8601 [ns]; None for other values."""
    if not isinstance(value, str) or not re.match(r'\s*\d{4}-?\d\d-?\d\d[T ]', value):
        return None
    text = value.strip()
    fraction = ISO_FRACTION.search(text)
    moment = datetime.fromisoformat(ISO_FRACTION.sub('', text))
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    digits = fraction[1] if fraction else ''
    # Whole seconds: a difference of dates is exact, a float of seconds would not be.
    elapsed = moment - datetime(1970, 1, 1, tzinfo=UTC)
    seconds = elapsed.days * 86400 + elapsed.seconds
    return seconds * 10**9 + int(digits.ljust(9, '0')[:9])
