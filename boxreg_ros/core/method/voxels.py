"""Which points of a growing cloud are the first in their voxel."""

from boxreg_ros.core.method.compile import kernel
import numpy as np

FREE = -1
"""Entry of a hash table without a voxel."""
SPREAD = -0x61C8864680B583EB
"""Factor of the hash: 2^64 divided by the golden ratio, modulo 2^64 (Knuth)."""


@kernel
def add_new(voxels, table):
    """
    Add voxels to a hash table and return which of them were not in it.

    Parameters
    ----------
    voxels : array, shape (M,)
        Their numbers, not negative.
    table : array, shape (S,)
        Numbers that are known, at places that follow from them, and `FREE`; S is a power of two,
        and entries stay free.

    Returns
    -------
    is_new : array, shape (M,)
        Whether it is the first of its number.

    """
    is_new = np.zeros(len(voxels), np.bool_)
    last = len(table) - 1
    for i in range(len(voxels)):
        place = ((voxels[i] * SPREAD) >> 32) & last
        while table[place] != FREE and table[place] != voxels[i]:
            place = (place + 1) & last
        is_new[i] = table[place] == FREE
        table[place] = voxels[i]
    return is_new
