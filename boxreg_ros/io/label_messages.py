"""
Messages with all that label files hold of the boxes of the node: JSON in `LABELS_TYPE`.

No message type of boxes has status, reason and number of points, and some have neither ids nor
covariances, or extents of 32 bits. A number is written such that it is read back to the last bit,
and null stands for one that is not finite.

"""

from __future__ import annotations

from typing import Any, NamedTuple

from boxreg_ros.errors import ShapeError, UnsupportedMessage
from boxreg_ros.structures import BoxArray, KINEMATICS, RefinedBoxes
import numpy as np
import orjson

LABELS_TOPIC = 'refined_labels'
EARLY_TOPIC = 'refined_boxes_status'
"""The same of the early boxes: the status of each."""
LABELS_TYPE = 'std_msgs/msg/String'
NAMES_OF_BOX = ('track_ids', 'class_names', 'status', 'reasons')
SHAPES = {
    'scores': (),
    'boxes': (9,),
    'num_points': (),
    'covariances': (6, 6),
    'extent_covariances': (3, 3),
}
"""Shape of the numbers of one box."""
OF_KINEMATICS = tuple(KINEMATICS.names or ())
"""Names of the numbers of `KINEMATICS`."""


class LabelMessage(NamedTuple):
    """The content of one message."""

    refined: RefinedBoxes
    """In the fixed frame; in that of their input where no transform to it is known."""
    fixed_frame: str
    config_hash: str
    """Of the settings of the node, see `Config.digest`."""


def to_text(content: LabelMessage) -> str:
    """Return the text of a message."""
    refined = content.refined
    boxes = refined.boxes
    columns = {
        name: getattr(boxes if hasattr(boxes, name) else refined, name)
        for name in (*NAMES_OF_BOX, *SHAPES)
    }
    arrays = {name: np.ascontiguousarray(columns[name]) for name in SHAPES}
    kinematics = boxes.known_kinematics
    arrays |= {name: np.ascontiguousarray(kinematics[name]) for name in OF_KINEMATICS}
    table = {
        'stamp_ns': boxes.stamp_ns,
        'frame_id': boxes.frame_id,
        'fixed_frame': content.fixed_frame,
        'config_hash': content.config_hash,
    }
    return orjson.dumps(table | columns | arrays, option=orjson.OPT_SERIALIZE_NUMPY).decode()


def from_text(text: str) -> LabelMessage:
    """Return the content of the text of a message; UnsupportedMessage for any other text."""
    try:
        table: dict[str, Any] = orjson.loads(text)
        n = len(table['track_ids'])
        texts = {name: tuple(map(str, table[name])) for name in NAMES_OF_BOX}
        numbers = {
            name: np.array(table[name], np.float64).reshape(n, *shape)
            for name, shape in SHAPES.items()
        }
        kinematics = np.zeros(n, KINEMATICS)
        for name in OF_KINEMATICS:
            if n:
                kinematics[name] = table[name]
        boxes = BoxArray(
            table['stamp_ns'], table['frame_id'], texts['track_ids'], texts['class_names'],
            numbers['scores'], numbers['boxes'], kinematics=kinematics,
        )  # fmt: skip
        refined = RefinedBoxes(
            boxes, texts['status'], texts['reasons'], numbers['num_points'].astype(np.int64),
            numbers['covariances'], extent_covariances=numbers['extent_covariances'],
        )  # fmt: skip
        return LabelMessage(refined, str(table['fixed_frame']), str(table['config_hash']))
    except (KeyError, TypeError, ValueError, ShapeError) as error:
        raise UnsupportedMessage(
            f'expected the JSON that the node publishes on {LABELS_TOPIC}, got '
            f'{text[:40]!r}: {type(error).__name__}: {error}'
        ) from None
