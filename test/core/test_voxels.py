"""The first points of voxels."""

from boxreg_ros.core.method.voxels import add_new, FREE
import numpy as np


def test_the_first_of_each_number_is_new_and_known_from_then_on():
    numbers = np.random.default_rng(0).integers(0, 500, 2000) * 2**42
    table = np.full(2**10, FREE)
    is_new = add_new(numbers, table)
    _, first = np.unique(numbers, return_index=True)
    assert np.flatnonzero(is_new).tolist() == sorted(first)
    assert not add_new(numbers, table).any()
    assert add_new(np.array([1, 2, 1]), table).tolist() == [True, True, False]
