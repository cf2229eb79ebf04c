"""
``vision_msgs``: Detection3DArray, and BoundingBox3DArray, which has no ids and no classes.

A detection's `id` is its track, its best hypothesis gives class and score. ``center`` is the
box's pose, ``size`` its extents along its own x, y and z.

"""

from __future__ import annotations

from typing import Any

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.structures import BoxArray, Floats
from msg_adapters import poses
import numpy as np


def from_msg(msg: Any) -> BoxArray:
    """
    Return the boxes; a detection without hypotheses has the class ``''`` and the score 1.

    Raises
    ------
    UnsupportedMessage
        If a detection is in another frame than the array, or the message is laid out as before
        vision_msgs 4.

    """
    if not hasattr(msg, 'detections'):
        n, header, found = len(msg.boxes), msg.header, list(msg.boxes)
        track_ids, best = ('',) * n, [('', 1.0)] * n
    else:
        header = poses.one_header('Detection3DArray', msg.header, msg.detections)
        found = [detection.bbox for detection in msg.detections]
        try:
            best = [_best_hypothesis(detection) for detection in msg.detections]
            track_ids = tuple(str(detection.id) for detection in msg.detections)
        except AttributeError as error:
            raise UnsupportedMessage(
                f'Detection3DArray: expected the fields of vision_msgs 4 (ROS 2 Galactic and '
                f'later), got a message where {error}; convert the recording'
            ) from None
    return BoxArray(
        poses.stamp_ns(header),
        header.frame_id,
        track_ids,
        tuple(class_name for class_name, _ in best),
        np.array([score for _, score in best], dtype=np.float64),
        poses.boxes_of([box.center for box in found], [box.size for box in found]),
    )


def to_msg(
    msg: Any, boxes: BoxArray, covariances: Floats | None = None, T_out_in: Floats | None = None
) -> Any:
    """
    Return a copy with the boxes replaced; see `Adapter.to_msg`.

    The pose of every hypothesis becomes the box's centre, which is what the covariance
    beside it speaks of. A detection without an id gets that of `boxes`.

    """
    header = poses.with_frame(msg.header, boxes.frame_id)
    quaternions_xyzw = poses.quaternions_of(boxes.boxes)
    if not hasattr(msg, 'detections'):
        new = zip(msg.boxes, boxes.boxes, quaternions_xyzw, strict=True)
        found = [_replaced(*item) for item in new]
        return poses.replaced(msg, header=header, boxes=found)
    detections = []
    for i, detection in enumerate(msg.detections):
        bbox = _replaced(detection.bbox, boxes.boxes[i], quaternions_xyzw[i])
        spread = None if covariances is None else covariances[i]
        results = [
            poses.replaced(r, pose=poses.with_covariance(r.pose, bbox.center, spread, T_out_in))
            for r in detection.results
        ]
        own = poses.with_frame(detection.header, boxes.frame_id)
        track_id = detection.id or boxes.track_ids[i]
        detections.append(
            poses.replaced(detection, header=own, results=results, bbox=bbox, id=track_id)
        )
    return poses.replaced(msg, header=header, detections=detections)


def _replaced(bbox: Any, box: Floats, quaternion_xyzw: Floats) -> Any:
    center, size = poses.with_box(bbox.center, bbox.size, box, quaternion_xyzw)
    return poses.replaced(bbox, center=center, size=size)


def _best_hypothesis(detection: Any) -> tuple[str, float]:
    """Return class and score of the hypothesis with the highest score."""
    known = [(str(r.hypothesis.class_id), float(r.hypothesis.score)) for r in detection.results]
    return max(known, key=lambda item: item[1], default=('', 1.0))
