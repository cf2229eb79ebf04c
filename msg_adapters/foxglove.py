"""
``foxglove_msgs/SceneUpdate`` of ROS, protobuf and JSON: the cube of an entity is a box.

The track id is the `id` of the entity; its metadata contain class and score. Entities without
cubes and deletions are copied. Of the other primitives of an entity, only the frame is changed.

"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.structures import BoxArray, Floats
from msg_adapters import poses
from msg_adapters.box_fields import BoxFields, BoxLabels, parts
from msg_adapters.cdr import Fields
import numpy as np

CLASS_KEYS = ('class', 'class_name', 'category', 'label', 'type', 'classification')
SCORE_KEYS = ('score', 'confidence', 'probability')
OTHER_PRIMITIVES = ('arrows', 'spheres', 'cylinders', 'lines', 'triangles', 'texts', 'models')
TIME_FIELD_PAIRS = (('sec', 'nanosec'), ('sec', 'nsec'), ('seconds', 'nanos'))
"""Names of seconds and nanoseconds in ROS, JSON and protobuf."""
MAX_TIME_NS = 2**63
"""Stamps are 64-bit integers."""
ENTITY_FIELDS = ('id', 'frame_id', 'timestamp')
CUBE_FIELDS = (
    *('pose.position.x', 'pose.position.y', 'pose.position.z'),
    *('pose.orientation.x', 'pose.orientation.y', 'pose.orientation.z', 'pose.orientation.w'),
    *('size.x', 'size.y', 'size.z'),
)


def from_msg(msg: Any) -> BoxArray:
    """
    Return the cubes of a SceneUpdate; several cubes of one entity are ``id/0``, ``id/1`` ...

    Stamp and frame are those of the entities. An update without entities has the stamp 0 and the
    frame ``''``. Raises UnsupportedMessage if the entities with cubes have different frames or
    stamps, a field is missing, or a value has the wrong type.

    """
    entities = _items(msg, 'entities')
    with_cubes = [entity for entity in entities if _items(entity, 'cubes')]
    stamped = with_cubes or entities[:1]
    poses.require_fields('SceneUpdate', stamped, ENTITY_FIELDS)
    stamp_ns, frame_id = poses.common_stamp_and_frame(
        'SceneUpdate', ((_time_ns(entity.timestamp), str(entity.frame_id)) for entity in stamped)
    )
    track_ids = []
    class_names = []
    scores = []
    cubes = []
    for entity in with_cubes:
        own_cubes = _items(entity, 'cubes')
        poses.require_fields('SceneUpdate', own_cubes, CUBE_FIELDS)
        metadata = _metadata(entity)
        for k, cube in enumerate(own_cubes):
            track_ids.append(str(entity.id) if len(own_cubes) == 1 else f'{entity.id}/{k}')
            class_name, score = _class_and_score(metadata)
            class_names.append(class_name)
            scores.append(score)
            cubes.append(cube)
    return BoxArray(
        stamp_ns,
        frame_id,
        tuple(track_ids),
        tuple(class_names),
        np.array(scores),
        poses.boxes_of([cube.pose for cube in cubes], [cube.size for cube in cubes]),
    )


def to_msg(
    msg: Any, boxes: BoxArray, covariances: Floats | None = None, T_out_in: Floats | None = None
) -> Any:
    """Return a copy with the cubes replaced; covariances are not written."""
    own = poses.placed(boxes)
    entities = []
    for entity in _items(msg, 'entities'):
        cubes = []
        for cube in _items(entity, 'cubes'):
            pose, size = poses.with_box(cube.pose, cube.size, *next(own))
            cubes.append(poses.replaced(cube, pose=pose, size=size))
        if cubes:
            entity = _with_cubes(entity, cubes, boxes.frame_id, T_out_in)
        entities.append(entity)
    return poses.replaced(msg, entities=entities)


def with_added(msg: Any, sources: Sequence[tuple[Any, int]]) -> Any:
    """Return a copy with an entity per added cube; see `Adapter.with_added`."""
    entities = [*_items(msg, 'entities')]
    timestamp = next((e for e in entities if _items(e, 'cubes')), entities[0]).timestamp
    added = []
    for source, row in sources:
        cubes = [
            (e, k) for e in _items(source, 'entities') for k in range(len(_items(e, 'cubes')))
        ]
        entity, k = cubes[row]
        own_cubes = _items(entity, 'cubes')
        name = str(entity.id) if len(own_cubes) == 1 else f'{entity.id}/{k}'
        added.append(
            poses.replaced(
                entity,
                id=name,
                timestamp=timestamp,
                cubes=[own_cubes[k]],
                metadata=_without_score(_items(entity, 'metadata')),
                **{kind: [] for kind in OTHER_PRIMITIVES},
            )
        )
    return poses.replaced(msg, entities=[*entities, *added])


def _without_score(metadata: Sequence[Any]) -> list[Any]:
    """Return metadata with the score 0."""
    others = [item for item in metadata if str(item.key).lower() not in SCORE_KEYS]
    scores = [poses.replaced(item, key=SCORE_KEYS[0], value='0') for item in metadata[:1]]
    return [*others, *scores]


def _class_and_score(metadata: dict[str, str]) -> tuple[str, float]:
    """Return class and score of an entity by its metadata, with keys in lower case."""
    class_name = _first_value(metadata, CLASS_KEYS, '')
    return class_name, _score(_first_value(metadata, SCORE_KEYS, '1'))


def _with_cubes(entity: Any, cubes: list[Any], frame_id: str, T_out_in: Floats | None) -> Any:
    """Return a copy of an entity with other cubes, in another frame if `T_out_in` is given."""
    fields: dict[str, Any] = {'cubes': cubes, 'frame_id': frame_id}
    if T_out_in is not None:
        for name in OTHER_PRIMITIVES:
            fields[name] = [
                poses.replaced(item, pose=poses.moved(item.pose, T_out_in))
                for item in _items(entity, name)
            ]
    return poses.replaced(entity, **fields)


def _items(owner: Any, name: str) -> Sequence[Any]:
    """Return a list of a message; JSON may omit empty ones or contain null."""
    value = getattr(owner, name, None)
    if value is None:
        return ()
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise UnsupportedMessage(f'SceneUpdate: expected a list as {name}, got {value!r}')
    return value


def _time_ns(time: Any) -> int:
    """Return a time of ROS, JSON or protobuf [ns]."""
    for seconds, nanoseconds in TIME_FIELD_PAIRS:
        if hasattr(time, seconds) and hasattr(time, nanoseconds):
            try:
                time_ns = int(getattr(time, seconds)) * 10**9 + int(getattr(time, nanoseconds))
            except (OverflowError, TypeError, ValueError):
                break
            if abs(time_ns) < MAX_TIME_NS:
                return time_ns
    raise UnsupportedMessage(
        f'SceneUpdate: expected a timestamp of whole seconds and nanoseconds (sec and nsec), got '
        f'{time}'
    )


def _metadata(entity: Any) -> dict[str, str]:
    """Return the metadata of an entity; keys are in lower case."""
    items = _items(entity, 'metadata')
    poses.require_fields('SceneUpdate', items, ('key', 'value'))
    return {str(item.key).lower(): str(item.value) for item in items}


def _first_value(metadata: dict[str, str], keys: tuple[str, ...], default: str) -> str:
    return next((metadata[key] for key in keys if key in metadata), default)


def _score(text: str) -> float:
    """Return a score; 1 for text that is not a number."""
    try:
        return float(text)
    except ValueError:
        return 1.0


def _has_one_cube_each(fields: Fields) -> bool:
    return bool((fields.counts('entities.cubes') == 1).all())


def _labels(fields: Fields) -> BoxLabels:
    """Return ids, and classes and scores by the metadata."""
    keys = fields.texts('entities.metadata.key')
    lower = {key: key.lower() for key in set(keys)}
    items = [
        (lower[key], value)
        for key, value in zip(keys, fields.texts('entities.metadata.value'), strict=True)
    ]
    counts = fields.counts('entities.metadata')
    found = [_class_and_score(dict(items[part])) for part in parts(counts)]
    ids = fields.texts('entities.id')
    return ids, [name for name, _ in found], np.array([score for _, score in found])


BOX_FIELDS = {
    'foxglove_msgs/msg/SceneUpdate': BoxFields(
        ('entities.frame_id',),
        'entities.cubes.pose.position.x',
        'entities.cubes.size.x',
        _labels,
        others=(
            'entities.id', 'entities.cubes', 'entities.metadata', 'entities.metadata.key',
            'entities.metadata.value',
        ),
        stamp='entities.timestamp.sec',
        is_ordinary=_has_one_cube_each,
    )
}  # fmt: skip
