"""Selection of few numbers by rank: numba's own sort takes seconds to compile."""

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
def lower_median(values):
    """Return the median of values (n,), the lower one of two; any value if one is NaN."""
    return nth(values, (len(values) - 1) // 2)
