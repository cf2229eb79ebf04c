"""
``vision_msgs/Detection3DArray``: `id` is the track, the best hypothesis gives class and score.

``bbox.center`` is the box's pose, ``bbox.size`` its extents along its own x, y and z.

"""

from __future__ import annotations

from typing import Any

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.structures import BoxArray, Floats
from msg_adapters.poses import boxes_of, quaternions_of, replaced, stamp_ns, with_box, with_frame
import numpy as np


def from_msg(msg: Any) -> BoxArray:
    """
    Return the boxes of a Detection3DArray.

    A detection without hypotheses has the class ``''`` and the score 1.

    Raises
    ------
    UnsupportedMessage
        If a detection is in another frame than the array, or the message is laid out as before
        vision_msgs 4.

    """
    detections = list(msg.detections)
    header = msg.header if msg.header.frame_id or not detections else detections[0].header
    for detection in detections:
        frame = detection.header.frame_id
        if frame and frame != header.frame_id:
            raise UnsupportedMessage(
                f'Detection3DArray: expected all detections in the frame of the array '
                f'{header.frame_id!r}, got one in {frame!r}; publish one array per frame'
            )
    try:
        best = [_best_hypothesis(detection) for detection in detections]
        track_ids = tuple(str(detection.id) for detection in detections)
    except AttributeError as error:
        raise UnsupportedMessage(
            f'Detection3DArray: expected the fields of vision_msgs 4 (ROS 2 Galactic and later), '
            f'got a message where {error}; convert the recording'
        ) from None
    return BoxArray(
        stamp_ns(header),
        header.frame_id,
        track_ids,
        tuple(class_name for class_name, _ in best),
        np.array([score for _, score in best], dtype=np.float64),
        boxes_of([d.bbox.center for d in detections], [d.bbox.size for d in detections]),
    )


def to_msg(msg: Any, boxes: BoxArray, covariances: Floats | None = None) -> Any:
    """
    Return a copy of a Detection3DArray with its boxes replaced; see `Adapter.to_msg`.

    The pose of every hypothesis becomes the box's centre, which is what the covariance
    beside it speaks of.

    """
    quaternions_xyzw = quaternions_of(boxes.boxes)
    detections = []
    for i, detection in enumerate(msg.detections):
        center, size = with_box(
            detection.bbox.center, detection.bbox.size, boxes.boxes[i], quaternions_xyzw[i]
        )
        results = list(detection.results)
        if covariances is not None:
            spread = np.array(covariances[i], dtype=np.float64).reshape(36)
            results = [
                replaced(r, pose=replaced(r.pose, pose=center, covariance=spread)) for r in results
            ]
        else:
            results = [replaced(r, pose=replaced(r.pose, pose=center)) for r in results]
        detections.append(
            replaced(
                detection,
                header=with_frame(detection.header, boxes.frame_id),
                results=results,
                bbox=replaced(detection.bbox, center=center, size=size),
            )
        )
    return replaced(msg, header=with_frame(msg.header, boxes.frame_id), detections=detections)


def _best_hypothesis(detection: Any) -> tuple[str, float]:
    """Return class and score of the hypothesis with the highest score."""
    known = [(str(r.hypothesis.class_id), float(r.hypothesis.score)) for r in detection.results]
    return max(known, key=lambda item: item[1], default=('', 1.0))
