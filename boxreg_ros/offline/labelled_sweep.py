"""A sweep with the labels of its points."""

from typing import NamedTuple

from boxreg_ros.core.point_labels import BACKGROUND, PointLabels
from boxreg_ros.io.fixed_frame import StoredCloud
from boxreg_ros.structures import Sweep
import numpy as np
from numpy.typing import NDArray


class LabelledSweep(NamedTuple):
    """A sweep in the fixed frame, its labels, and whether boxes state what is there."""

    sweep: Sweep
    cloud: StoredCloud | None
    labels: PointLabels
    is_known: bool


def is_kept(labels: PointLabels, name: str) -> NDArray[np.bool_]:
    """Return which points the map ``static`` or ``background`` keeps, (M,)."""
    if name == 'static':
        return ~labels.is_dynamic
    is_background: NDArray[np.bool_] = labels.track == BACKGROUND
    return is_background
