"""What sweeps and boxes pass on their way to the registrar, live and offline alike."""

from __future__ import annotations

from typing import cast, TypeVar

from boxreg_ros.config import Config
from boxreg_ros.io.id_assignment import Tracker
from boxreg_ros.io.pose_check import PoseCheck
from boxreg_ros.io.transforms import Rewind
from boxreg_ros.structures import BoxArray, Floats, KEPT, RefinedBoxes, Sweep
from msg_adapters.convention import Convention
import numpy as np

_T = TypeVar('_T', bound=Sweep | BoxArray)


class Intake:
    """
    Tell where stamps start again, give boxes ids where wanted, and look whether they fit.

    Boxes fit that stand where their points are.

    """

    def __init__(self, convention: Convention, config: Config) -> None:
        self._convention = convention
        self._tracker = Tracker(config.max_gap) if convention.associate else None
        self.begin(config)

    def begin(self, config: Config) -> None:
        """Forget what has been taken; ids that were given do not come again."""
        self._check = PoseCheck(self._convention, config.tolerance)
        self.change(config)
        self._forget()

    def change(self, config: Config) -> None:
        """Take over the setting that may change: how long a track may be unseen."""
        if self._tracker is not None:
            self._tracker.max_gap = config.max_gap

    def begins_anew(self, item: Sweep | BoxArray) -> bool:
        """Tell whether stamps start again with the next sweep or boxes; then ids do, too."""
        if says_nothing(item):
            return False
        if not self._rewinds[isinstance(item, BoxArray)].happened(item.stamp_ns):
            return False
        self._forget()
        return True

    def take(self, item: _T) -> _T:
        """Return a sweep or boxes, in the fixed frame, as the registrar is to have them."""
        self._check.add(item)
        if self._tracker is None or not isinstance(item, BoxArray):
            return item
        return cast(_T, self._tracker.identify(item))

    @property
    def finding(self) -> str:
        """Return what is wrong with the poses and sizes; empty while nothing is known to be."""
        return self._check.finding

    @property
    def facts(self) -> dict[str, object]:
        """Return what a report says about the ids."""
        if self._tracker is None:
            return {'ids': 'of the input'}
        return {'ids': 'by association', 'associated_tracks': self._tracker.count}

    def _forget(self) -> None:
        self._rewinds = Rewind(), Rewind()
        if self._tracker is not None:
            self._tracker.forget()


def says_nothing(item: Sweep | BoxArray) -> bool:
    """Tell whether this is an array without boxes, and without a stamp or a frame to wait for."""
    is_empty = isinstance(item, BoxArray) and not item.track_ids
    return is_empty and not (item.frame_id and item.stamp_ns)


def covariances_to_write(refined: RefinedBoxes) -> Floats:
    """
    Return covariances (n, 6, 6) for messages, NaN where the box is kept.

    About a box that stays as it was, the detector knows more than we do.

    """
    is_kept = np.array([status == KEPT for status in refined.status], dtype=bool)
    return np.where(is_kept[:, None, None], np.nan, refined.covariances)
