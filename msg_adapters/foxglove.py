"""
``foxglove_msgs/SceneUpdate`` of ROS, protobuf and JSON: an entity's cube is a box.

The entity's `id` is the track; its metadata give class and score. Entities without cubes and
deletions are carried along; whatever else an entity draws stays where it was.

"""

from __future__ import annotations

from typing import Any

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.structures import BoxArray, Floats
from msg_adapters import poses
import numpy as np

CLASS_KEYS = ('class', 'class_name', 'category', 'label', 'type', 'classification')
SCORE_KEYS = ('score', 'confidence', 'probability')
OTHERS = ('arrows', 'spheres', 'cylinders', 'lines', 'triangles', 'texts', 'models')


def from_msg(msg: Any) -> BoxArray:
    """
    Return the cubes of a SceneUpdate; several of one entity are told apart as ``id/0``, ...

    The stamp and the frame are those of the entities. An update without any has neither: it
    comes back with the stamp 0 and the frame ``''``.

    Raises
    ------
    UnsupportedMessage
        If the entities with cubes disagree about frame or stamp.

    """
    entities = [entity for entity in msg.entities if _cubes(entity)]
    origins = ((_time_ns(e.timestamp), e.frame_id) for e in entities or msg.entities[:1])
    origin = poses.one_origin('SceneUpdate', origins)
    track_ids, names, scores, cubes = [], [], [], []
    for entity in entities:
        for k, cube in enumerate(_cubes(entity)):
            track_ids.append(entity.id if len(_cubes(entity)) == 1 else f'{entity.id}/{k}')
            names.append(_noted(entity, CLASS_KEYS, ''))
            scores.append(_number(_noted(entity, SCORE_KEYS, '1')))
            cubes.append(cube)
    boxes = poses.boxes_of([cube.pose for cube in cubes], [cube.size for cube in cubes])
    return BoxArray(*origin, tuple(track_ids), tuple(names), np.array(scores), boxes)


def to_msg(
    msg: Any, boxes: BoxArray, covariances: Floats | None = None, T_out_in: Floats | None = None
) -> Any:
    """Return a copy with the cubes replaced; it has no place for covariances."""
    quaternions_xyzw = poses.quaternions_of(boxes.boxes)
    entities, i = [], 0
    for entity in msg.entities:
        cubes = []
        for cube in _cubes(entity):
            pose, size = poses.with_box(cube.pose, cube.size, boxes.boxes[i], quaternions_xyzw[i])
            cubes.append(poses.replaced(cube, pose=pose, size=size))
            i += 1
        if cubes:
            fields: dict[str, Any] = {'cubes': cubes, 'frame_id': boxes.frame_id}
            for name in OTHERS if T_out_in is not None else ():
                drawn = getattr(entity, name, ())
                fields[name] = [
                    poses.replaced(item, pose=poses.moved(item.pose, T_out_in)) for item in drawn
                ]
            entity = poses.replaced(entity, **fields)
        entities.append(entity)
    return poses.replaced(msg, entities=entities)


def _cubes(entity: Any) -> Any:
    return getattr(entity, 'cubes', ())  # JSON may leave out what is empty


def _time_ns(time: Any) -> int:
    """Return a time as ROS, JSON or protobuf spell it [ns]."""
    for seconds, rest in (('sec', 'nanosec'), ('sec', 'nsec'), ('seconds', 'nanos')):
        if hasattr(time, rest):
            return int(getattr(time, seconds)) * 10**9 + int(getattr(time, rest))
    raise UnsupportedMessage(
        f'SceneUpdate: expected a timestamp of sec and nanosec, sec and nsec, or seconds and '
        f'nanos, got {time}'
    )


def _noted(entity: Any, keys: tuple[str, ...], default: str) -> str:
    noted = {item.key.lower(): str(item.value) for item in getattr(entity, 'metadata', ())}
    return next((noted[key] for key in keys if key in noted), default)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 1.0
