"""Ranks, sums and order of few numbers: numba's own functions take seconds to compile."""

from boxreg_ros.core.method.compile import loop


@loop
def nth(values, rank):
    """
    Return the value of a rank among values (n,), 0 for the smallest; any value if one is NaN.

    By quickselect, which sorts the values in part. Both passes move values without a branch: half
    of such branches are predicted wrong, and each costs as much as ten moves.

    """
    first, last = 0, len(values) - 1
    while first < last:
        middle = (first + last) // 2
        pivot = values[middle]
        if pivot != pivot:
            return pivot
        values[middle], values[last] = values[last], pivot
        place = first
        for i in range(first, last):
            value = values[i]
            values[i] = values[place]
            values[place] = value
            place += value < pivot
        if rank < place:
            values[last], values[place] = values[place], pivot
            last = place - 1
            continue
        if place == first:  # nothing is less: leave out those that are equal, if there are some
            for i in range(place, last):
                value = values[i]
                values[i] = values[place]
                values[place] = value
                place += value <= pivot
        values[last], values[place] = values[place], pivot
        if rank <= place:
            return pivot
        first = place + 1
    return values[rank]


@loop
def sort_in_place(values):
    """Sort values (n,) without NaN: each half is less than the other, as are its own."""
    size = 1
    while size < len(values):
        size *= 2
    while size > 1:
        for first in range(0, len(values) - size // 2, size):
            nth(values[first : first + size], size // 2)
        size //= 2


@loop
def sum_of(values):
    """Return the sum of values (n,)."""
    found = 0
    for i in range(len(values)):
        found += values[i]
    return found


@loop
def lower_median(values):
    """Return the median of values (n,), the lower one of two; any value if one is NaN."""
    return nth(values, (len(values) - 1) // 2)
