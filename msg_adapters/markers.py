"""
``visualization_msgs/MarkerArray``: a CUBE's `id` is the track and its `ns` the class.

Markers of other types, and those that delete, are no boxes: they are passed over when reading
and carried along unchanged when writing.

"""

from __future__ import annotations

from typing import Any

from boxreg_ros.structures import BoxArray, Floats
from msg_adapters import poses
import numpy as np

CUBE = 1
ADD = 0


def from_msg(msg: Any) -> BoxArray:
    """
    Return the boxes of a MarkerArray; the score is 1 throughout.

    The stamp and the frame are those of the markers. An array without boxes and without any
    marker has neither: it comes back with the stamp 0 and the frame ``''``.

    Raises
    ------
    UnsupportedMessage
        If the boxes disagree about frame or stamp.

    """
    cubes = [marker for marker in msg.markers if _is_box(marker)]
    headers = [marker.header for marker in cubes or msg.markers[:1]]
    origin = poses.one_origin('MarkerArray', ((poses.stamp_ns(h), h.frame_id) for h in headers))
    return BoxArray(
        *origin,
        tuple(str(cube.id) for cube in cubes),
        tuple(str(cube.ns) for cube in cubes),
        np.ones(len(cubes)),
        poses.boxes_of([cube.pose for cube in cubes], [cube.scale for cube in cubes]),
    )


def to_msg(
    msg: Any, boxes: BoxArray, covariances: Floats | None = None, T_out_in: Floats | None = None
) -> Any:
    """Return a copy of a MarkerArray with its boxes replaced; it has no place for covariances."""
    quaternions_xyzw = poses.quaternions_of(boxes.boxes)
    markers, i = [], 0
    for marker in msg.markers:
        if _is_box(marker):
            pose, scale = poses.with_box(
                marker.pose, marker.scale, boxes.boxes[i], quaternions_xyzw[i]
            )
            header = poses.with_frame(marker.header, boxes.frame_id)
            marker = poses.replaced(marker, header=header, pose=pose, scale=scale)
            i += 1
        markers.append(marker)
    return poses.replaced(msg, markers=markers)


def _is_box(marker: Any) -> bool:
    return bool(marker.type == CUBE and marker.action == ADD)
