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
    """Return the median of values (n,), the lower one of two; the values are sorted."""
    sort(values)
    return values[(len(values) - 1) // 2]
