"""Objects that a run proposes: the heading of what stands is that of its lane."""

from boxreg_ros.structures import YAW
from boxreg_ros.tracks.proposals import Proposer
import numpy as np
import pytest

RNG = np.random.default_rng(5)
ROAD = np.column_stack([RNG.uniform(-25, 35, (20000, 2)), RNG.normal(0, 0.02, 20000)])
PERIOD_NS = 10**8


def car_at(x, y):
    """Return points on the side and the rear of a car that stands along x."""
    side = np.column_stack(
        [RNG.uniform(x, x + 4.4, 300), np.full(300, y), RNG.uniform(0.35, 1.5, 300)]
    )
    rear = np.column_stack(
        [np.full(150, x), RNG.uniform(y, y + 1.8, 150), RNG.uniform(0.35, 1.5, 150)]
    )
    return np.concatenate([side, rear])


def proposed(heading):
    """Return what is proposed for a parked car beside one whose box has a heading."""
    proposer = Proposer()
    known = np.array([[20.0, 5.9, 0.8, 4.4, 1.8, 1.5, 0, 0, heading]])
    for k in range(10):
        points = np.concatenate([ROAD, car_at(8, 5)])
        proposer.add(k * PERIOD_NS, points, np.array([0.0, 0, 1.8]), known)
    (found,) = proposer.proposals()
    return found


@pytest.mark.parametrize('heading', [0.05, np.pi - 0.05])
def test_what_stands_heads_as_the_lane_it_is_in(heading):
    found = proposed(heading)
    assert found.speed == 0
    assert np.cos(found.box[YAW] - heading) > 0.95
    assert found.box[:2] == pytest.approx([10.2, 5.9], abs=0.2)


def test_boxes_across_say_nothing_about_a_heading():
    headings = {round(float(proposed(heading).box[YAW]), 1) for heading in (1.5, -1.5)}
    assert len(headings) == 1
