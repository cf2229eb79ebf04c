"""
Static: parked tracks that are one object with pauses become one.

A parked object stands at its place however long it is hidden. Two parked tracks at the same place
are one object, unless another object stood there in between.

"""

from __future__ import annotations

from boxreg_ros.config import Config
from boxreg_ros.core.metrics import iou_3d, iou_bev
from boxreg_ros.structures import Floats
from boxreg_ros.tracks.decided import Decided, NOTHING
from boxreg_ros.tracks.stitch import join_links
from boxreg_ros.tracks.tracklet import is_parked, Tracklet
import numpy as np

SAME_PLACE = 0.5
"""Least IoU of the median boxes; chosen: another car in the same space rarely reaches it."""
OCCUPIED = 0.2
"""3D IoU beyond which another object stands at the place; chosen: cars in a row have none."""


def join_static(
    tracklets: list[Tracklet], config: Config, decided: Decided = NOTHING
) -> list[Tracklet]:
    """
    Join parked tracklets at one place.

    Parameters
    ----------
    tracklets : list of Tracklet
        In the order of their start, in the fixed frame.
    config : Config
        Assigns class names to kinds of objects: only tracklets of one kind are joined.
    decided : Decided
        The decisions of a person, by default none.

    Returns
    -------
    tracklets : list of Tracklet
        In the order of their start.

    """
    parked = [i for i, tracklet in enumerate(tracklets) if is_parked(tracklet.boxes)]
    places = {i: np.median(tracklets[i].boxes, axis=0) for i in parked}
    pairs: list[tuple[int, int]] = []
    used: set[int] = set()  # have a successor
    for j in parked:
        earlier = [
            i
            for i in parked
            if tracklets[i].last_ns < tracklets[j].first_ns
            and i not in used
            and tracklets[i].model(config) is tracklets[j].model(config)
            # A wrong height is no other place, but a pedestrian is no car.
            and iou_bev(places[i][None], places[j][None])[0] >= SAME_PLACE
        ]
        if not earlier:
            continue
        i = max(earlier, key=lambda index: tracklets[index].last_ns)
        if not _is_occupied(places[j], tracklets[i].last_ns, tracklets[j].first_ns, tracklets):
            pairs.append((i, j))
            used.add(i)
    return join_links(tracklets, pairs, decided)


def _is_occupied(place: Floats, after_ns: int, before_ns: int, tracklets: list[Tracklet]) -> bool:
    """Return whether a box of any object overlaps a place between two stamps."""
    for tracklet in tracklets:
        is_between = (tracklet.stamps_ns > after_ns) & (tracklet.stamps_ns < before_ns)
        boxes = tracklet.boxes[is_between]
        if len(boxes) and (iou_3d(boxes, np.tile(place, (len(boxes), 1))) > OCCUPIED).any():
            return True
    return False
