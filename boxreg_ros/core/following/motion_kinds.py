"""How objects of each kind move, and the prediction of their state."""

from __future__ import annotations

from typing import NamedTuple

from boxreg_ros.core.method import turn_rate
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.method.follow_numbers import FOLLOW
from boxreg_ros.core.method.turn_rate import State
from boxreg_ros.core.observation import GROUND_CLEARANCE
from boxreg_ros.structures import Floats
import numpy as np


class KindOfMotion(NamedTuple):
    """
    Motion of a kind of object.

    Attributes
    ----------
    noise : array, shape (5,)
        Spectral densities of acceleration [m^2/s^3], angular acceleration [rad^2/s^3], slip
        sideways and upward [m^2/s] and turning [rad^2/s], see `turn_rate.predict`. Chosen.
    max_speed : float
        Largest speed [m/s]. Chosen.
    is_rigid : bool
        Whether points show the extents; of other objects limbs move.
    clearance : float
        Points nearer to the road may be of it [m].

    """

    noise: Floats
    max_speed: float
    is_rigid: bool = False
    clearance: float = GROUND_CLEARANCE


MOTIONS = {
    'vehicle': KindOfMotion(np.array([1.0, 0.1, 0.004, 0.01, 1e-4]), 40.0, True, 0.25),
    'cyclist': KindOfMotion(np.array([1.0, 0.4, 0.01, 0.01, 1e-3]), 12.0),
    'pedestrian': KindOfMotion(np.array([0.6, 0.4, 0.02, 0.01, 5e-3]), 3.0),
}


class MotionModel(NamedTuple):
    """Noise (5,), see `KindOfMotion`, and distance of the pivot behind the centre [m]."""

    noise: Floats
    pivot: float

    @classmethod
    def of(cls, kind: str, length: float) -> MotionModel:
        """Return the model of an object of a kind of `MOTIONS`."""
        noise = MOTIONS[kind].noise
        return cls(*steering(noise, length)) if kind == 'vehicle' else cls(noise, 0.0)

    def predicted(self, state: State, seconds: float) -> State:
        """Return a state after a time, which may be negative [s]."""
        noise = self.noise * (FOLLOW.parked_noise if is_parked(state) else 1.0)
        found: State = turn_rate.predict(state, seconds, noise, self.pivot)
        return found


def is_parked(state: State) -> bool:
    """Return whether an object is held as a parked one."""
    return abs(state.speed) < CONSTANTS.parked_speed


def steering(noise: Floats, length: float) -> tuple[Floats, float]:
    """Return noise and pivot of a vehicle by its length: long ones turn more slowly."""
    found = noise.copy()
    found[1] *= min(1.0, FOLLOW.steered_length / length) ** 2
    return found, max(CONSTANTS.pivot * length, length / 2 - FOLLOW.overhang)
