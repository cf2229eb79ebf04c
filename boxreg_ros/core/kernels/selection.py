"""Selection of few numbers by rank: numba's own sort takes seconds to compile."""

from boxreg_ros.core.kernels.compile import kernel


@kernel
def nth(values, rank):
    """
    Return the value of a rank among values (n,), 0 for the smallest; any value if one is NaN.

    By Hoare's selection, which sorts the values in part.

    """
    first, last = 0, len(values) - 1
    while first < last:
        pivot = values[(first + last) // 2]
        low, high = first, last
        while low <= high:
            while values[low] < pivot:
                low += 1
            while values[high] > pivot:
                high -= 1
            if low <= high:
                values[low], values[high] = values[high], values[low]
                low += 1
                high -= 1
        if rank <= high:
            last = high
        elif rank >= low:
            first = low
        else:
            break
    return values[rank]


@kernel
def lower_median(values):
    """Return the median of values (n,), the lower one of two; any value if one is NaN."""
    return nth(values, (len(values) - 1) // 2)
