"""
``jsk_recognition_msgs/BoundingBoxArray`` of ROS 1 and its forks; it has no ids.

The score is `value`, the class the number `label`. Additional fields of forks are copied, because
a recording contains its message definitions.

"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from boxreg_ros.structures import BoxArray, Floats
from msg_adapters import poses
from msg_adapters.box_fields import BoxFields, BoxLabels
from msg_adapters.cdr import Fields
import numpy as np

REQUIRED_FIELDS = ('header', 'pose', 'dimensions', 'value', 'label')


def from_msg(msg: Any) -> BoxArray:
    """Return the boxes of a BoundingBoxArray; UnsupportedMessage if they are in several frames."""
    poses.require_fields('BoundingBoxArray', msg.boxes[:1], REQUIRED_FIELDS)
    header = poses.common_header('BoundingBoxArray', msg.header, msg.boxes)
    return BoxArray(
        poses.stamp_ns(header),
        header.frame_id,
        ('',) * len(msg.boxes),
        tuple(str(box.label) for box in msg.boxes),
        np.array([box.value for box in msg.boxes], dtype=np.float64),
        poses.boxes_of([box.pose for box in msg.boxes], [box.dimensions for box in msg.boxes]),
    )


def to_msg(
    msg: Any, boxes: BoxArray, covariances: Floats | None = None, T_out_in: Floats | None = None
) -> Any:
    """Return a copy with the boxes replaced; covariances are not written."""
    replaced = []
    for own, box in zip(msg.boxes, poses.placed(boxes), strict=True):
        pose, size = poses.with_box(own.pose, own.dimensions, *box)
        header = poses.with_frame(own.header, boxes.frame_id)
        replaced.append(poses.replaced(own, header=header, pose=pose, dimensions=size))
    header = poses.with_frame(msg.header, boxes.frame_id)
    return poses.replaced(msg, header=header, boxes=replaced)


def with_added(msg: Any, sources: Sequence[tuple[Any, int]]) -> Any:
    """Return a copy with boxes of earlier messages added, value 0; see `Adapter.with_added`."""
    header = poses.common_header('BoundingBoxArray', msg.header, msg.boxes)
    added = [poses.replaced(m.boxes[row], header=header, value=0.0) for m, row in sources]
    return poses.replaced(msg, boxes=[*msg.boxes, *added])


def _labels(fields: Fields) -> BoxLabels:
    """Return labels as classes, and values as scores; no ids."""
    classes = [str(label) for label in fields.numbers('boxes.label', '<u4')[:, 0].tolist()]
    scores = fields.numbers('boxes.value', '<f4')[:, 0].astype(np.float64)
    return [''] * len(classes), classes, scores


BOX_FIELDS = {
    'jsk_recognition_msgs/msg/BoundingBoxArray': BoxFields(
        ('header.frame_id', 'boxes.header.frame_id'),
        'boxes.pose.position.x',
        'boxes.dimensions.x',
        _labels,
        others=('boxes.value', 'boxes.label'),
    )
}
