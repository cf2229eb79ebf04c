"""Sorting of few numbers: numba's own sort takes seconds to compile."""

from boxreg_ros.core.kernels.compile import kernel


@kernel
def sort(values):
    """Sort values (n,) in place, ascending, by Shell's method; NaN ends anywhere."""
    gap = len(values) // 2
    while gap > 0:
        for i in range(gap, len(values)):
            value = values[i]
            place = i
            while place >= gap and values[place - gap] > value:
                values[place] = values[place - gap]
                place -= gap
            values[place] = value
        gap //= 2


@kernel
def lower_median(values):
    """
    Return the median of values (n,), the lower one of two; any value if one is NaN.

    By Hoare's selection, which sorts the values in part.

    """
    wanted = (len(values) - 1) // 2
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
        if wanted <= high:
            last = high
        elif wanted >= low:
            first = low
        else:
            break
    return values[wanted]
