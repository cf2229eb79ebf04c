"""
``vision_msgs``: Detection3DArray, and BoundingBox3DArray, which has no ids and no classes.

The track id is the `id` of a detection; class and score are those of the hypothesis with the
highest score. ``center`` is the pose of the box, ``size`` its extents along x, y and z of the box.
The definition of vision_msgs 2 (ROS 2 Foxy) is read as well: its track id is `tracking_id`, where
`is_tracking` is set. That of vision_msgs 1 (ROS 1) has no track ids.

"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.structures import BOX_CENTER, BoxArray, Floats
from msg_adapters import poses
from msg_adapters.box_fields import (
    BoxFields,
    BoxLabels,
    COVARIANCE_WIDTH,
    finite_or,
    parts,
    Rewrite,
)
from msg_adapters.cdr import Fields
import numpy as np

RESULT_POSE = 'detections.results.pose.pose.position.x'
RESULT_COVARIANCE = 'detections.results.pose.covariance'


def from_msg(msg: Any) -> BoxArray:
    """
    Return the boxes; a detection without hypotheses has the class ``''`` and the score 1.

    Raises UnsupportedMessage if a detection is in another frame than the array, or lacks a field.

    """
    if hasattr(msg, 'detections'):
        return _from_detections(msg)
    n = len(msg.boxes)
    return BoxArray(
        poses.stamp_ns(msg.header),
        msg.header.frame_id,
        ('',) * n,
        ('',) * n,
        np.ones(n),
        poses.boxes_of([box.center for box in msg.boxes], [box.size for box in msg.boxes]),
    )


def to_msg(
    msg: Any, boxes: BoxArray, covariances: Floats | None = None, T_out_in: Floats | None = None
) -> Any:
    """
    Return a copy with the boxes replaced; see `Adapter.to_msg`.

    The pose of every hypothesis becomes the centre of the box, because the covariance beside it
    is that of the box. A detection without an id gets that of `boxes`.

    """
    header = poses.with_frame(msg.header, boxes.frame_id)
    own = poses.placed(boxes)
    if not hasattr(msg, 'detections'):
        new = [_with_box(bbox, *box) for bbox, box in zip(msg.boxes, own, strict=True)]
        return poses.replaced(msg, header=header, boxes=new)
    detections = []
    for i, (detection, box) in enumerate(zip(msg.detections, own, strict=True)):
        bbox = _with_box(detection.bbox, *box)
        covariance = None if covariances is None else covariances[i]
        results = []
        for result in detection.results:
            pose = bbox.center
            if hasattr(result.pose, 'covariance'):
                pose = poses.with_covariance(result.pose, pose, covariance, T_out_in)
            results.append(poses.replaced(result, pose=pose))
        detections.append(
            poses.replaced(
                detection,
                header=poses.with_frame(detection.header, boxes.frame_id),
                results=results,
                bbox=bbox,
                **_id_fields(detection, boxes.track_ids[i]),
            )
        )
    return poses.replaced(msg, header=header, detections=detections)


def with_added(msg: Any, sources: Sequence[tuple[Any, int]]) -> Any:
    """Return a copy with boxes of earlier messages added, score 0; see `Adapter.with_added`."""
    if not hasattr(msg, 'detections'):
        return poses.replaced(msg, boxes=[*msg.boxes, *(m.boxes[row] for m, row in sources)])
    header = poses.common_header('Detection3DArray', msg.header, msg.detections)
    added = [_unseen(source.detections[row], header) for source, row in sources]
    return poses.replaced(msg, detections=[*msg.detections, *added])


def _unseen(detection: Any, header: Any) -> Any:
    """Return a detection with its best hypothesis only, at the score 0, under another header."""
    best = sorted(detection.results, key=lambda result: -_hypothesis_of(result).score)[:1]
    unseen = []
    for result in best:
        if hasattr(result, 'hypothesis'):
            scored = poses.replaced(result.hypothesis, score=0.0)
            unseen.append(poses.replaced(result, hypothesis=scored))
        else:
            unseen.append(poses.replaced(result, score=0.0))
    return poses.replaced(detection, header=header, results=unseen)


def _from_detections(msg: Any) -> BoxArray:
    header = poses.common_header('Detection3DArray', msg.header, msg.detections)
    try:
        best = [_best_hypothesis(detection) for detection in msg.detections]
        track_ids = tuple(_track_id(detection) for detection in msg.detections)
    except AttributeError as error:
        raise UnsupportedMessage(
            f'Detection3DArray: expected the fields of vision_msgs 1 to 4, got a message where '
            f'{error}; convert the messages to vision_msgs 4'
        ) from None
    boxes = [detection.bbox for detection in msg.detections]
    values = poses.boxes_of([box.center for box in boxes], [box.size for box in boxes])
    if not values[:, BOX_CENTER].any() and any(map(_has_pose, msg.detections)):
        raise UnsupportedMessage(
            'Detection3DArray: expected the poses of the boxes in bbox.center, got all of them at '
            'the origin, and poses in results[].pose: copy these to bbox.center, and the sizes to '
            'bbox.size, where the message is published'
        )
    return BoxArray(
        poses.stamp_ns(header),
        header.frame_id,
        track_ids,
        tuple(class_name for class_name, _ in best),
        np.array([score for _, score in best], dtype=np.float64),
        values,
    )


def _has_pose(detection: Any) -> bool:
    """Return whether a hypothesis of a detection has a pose that is not the origin."""
    found = [getattr(result.pose, 'pose', result.pose).position for result in detection.results]
    return any(p.x or p.y or p.z for p in found)


def _with_box(bbox: Any, box: Floats, quaternion_xyzw: Floats) -> Any:
    center, size = poses.with_box(bbox.center, bbox.size, box, quaternion_xyzw)
    return poses.replaced(bbox, center=center, size=size)


def _track_id(detection: Any) -> str:
    """Return the track id of a detection; '' if it has none."""
    if hasattr(detection, 'is_tracking'):  # vision_msgs 2
        return str(detection.tracking_id) if detection.is_tracking else ''
    if hasattr(detection, 'source_cloud'):  # vision_msgs 1
        return ''
    return str(detection.id)


def _id_fields(detection: Any, track_id: str) -> dict[str, Any]:
    """Return the fields of the track id of a detection: its own, or else `track_id`."""
    known = _track_id(detection) or track_id
    if hasattr(detection, 'is_tracking'):
        return {'is_tracking': bool(known), 'tracking_id': known}
    return {'id': known} if hasattr(detection, 'id') else {}


def _hypothesis_of(result: Any) -> Any:
    """Return the part of a result with class and score: itself before vision_msgs 3."""
    return result.hypothesis if hasattr(result, 'hypothesis') else result


def _best_hypothesis(detection: Any) -> tuple[str, float]:
    """Return class and score of the hypothesis with the highest score."""
    found = []
    for result in detection.results:
        hypothesis = _hypothesis_of(result)
        name = hypothesis.class_id if hasattr(hypothesis, 'class_id') else hypothesis.id
        found.append((str(name), float(hypothesis.score)))
    return _best(found)


def _best(hypotheses: Iterable[tuple[str, float]]) -> tuple[str, float]:
    """Return that of several classes and scores which has the highest score."""
    return max(hypotheses, key=lambda item: item[1], default=('', 1.0))


def _detection_labels(fields: Fields) -> BoxLabels:
    """Return ids, and classes and scores of the hypotheses with the highest score."""
    classes = fields.texts('detections.results.hypothesis.class_id')
    scores = fields.numbers('detections.results.hypothesis.score', '<f8')[:, 0]
    counts = fields.counts('detections.results')
    if (counts == 1).all():
        return fields.texts('detections.id'), classes, scores
    hypotheses = [*zip(classes, scores.tolist(), strict=True)]
    best = [_best(hypotheses[part]) for part in parts(counts)]
    found_scores = np.array([score for _, score in best])
    return fields.texts('detections.id'), [name for name, _ in best], found_scores


def _write_hypotheses(fields: Fields, rewrite: Rewrite) -> None:
    """Write pose and covariance of each box into its hypotheses."""
    counts = fields.counts('detections.results')
    fields.put(RESULT_POSE, np.repeat(rewrite.new_pose, counts, axis=0))
    own = fields.numbers(RESULT_COVARIANCE, '<f8', COVARIANCE_WIDTH)
    fields.put(RESULT_COVARIANCE, finite_or(np.repeat(rewrite.covariance, counts, axis=0), own))


def _without_labels(fields: Fields) -> BoxLabels:
    """Return empty ids and classes, and the score 1."""
    n = len(fields.counts('boxes.center.position.x'))
    return [''] * n, [''] * n, np.ones(n)


BOX_FIELDS = {
    'vision_msgs/msg/Detection3DArray': BoxFields(
        ('header.frame_id', 'detections.header.frame_id'),
        'detections.bbox.center.position.x',
        'detections.bbox.size.x',
        _detection_labels,
        others=(
            'detections.id', 'detections.results', 'detections.results.hypothesis.class_id',
            'detections.results.hypothesis.score', RESULT_POSE, RESULT_COVARIANCE,
        ),
        is_ordinary=lambda fields: bool((fields.counts('detections.id') > 1).all()),
        write=_write_hypotheses,
    ),
    'vision_msgs/msg/BoundingBox3DArray': BoxFields(
        ('header.frame_id',), 'boxes.center.position.x', 'boxes.size.x', _without_labels
    ),
}  # fmt: skip
"""Of the definition of vision_msgs 4."""
