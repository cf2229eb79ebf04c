"""
``visualization_msgs/MarkerArray``: the `id` of a CUBE is the track id, its `ns` the class.

Markers of other types and deletions are skipped when reading, and copied when writing.

"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from boxreg_ros.structures import BoxArray, Floats
from msg_adapters import poses
from msg_adapters.box_fields import BoxFields, BoxLabels
from msg_adapters.cdr import Fields
import numpy as np
from numpy.typing import NDArray

CUBE = 1
ADD = 0
REQUIRED_FIELDS = ('header', 'ns', 'id', 'type', 'action', 'pose', 'scale')


def from_msg(msg: Any) -> BoxArray:
    """
    Return the boxes of a MarkerArray, all with the score 1.

    Stamp and frame are those of the markers. An array without markers has the stamp 0 and the
    frame ``''``. Raises UnsupportedMessage if the boxes have different frames or stamps, or a
    field is missing.

    """
    poses.require_fields('MarkerArray', msg.markers[:1], REQUIRED_FIELDS)
    cubes = [marker for marker in msg.markers if _is_box(marker)]
    headers = [marker.header for marker in cubes or msg.markers[:1]]
    stamp_ns, frame_id = poses.common_stamp_and_frame(
        'MarkerArray', ((poses.stamp_ns(header), header.frame_id) for header in headers)
    )
    return BoxArray(
        stamp_ns,
        frame_id,
        tuple(str(cube.id) for cube in cubes),
        tuple(str(cube.ns) for cube in cubes),
        np.ones(len(cubes)),
        poses.boxes_of([cube.pose for cube in cubes], [cube.scale for cube in cubes]),
    )


def to_msg(
    msg: Any, boxes: BoxArray, covariances: Floats | None = None, T_out_in: Floats | None = None
) -> Any:
    """Return a copy with the boxes replaced; covariances are not written."""
    own = poses.placed(boxes)
    markers = []
    for marker in msg.markers:
        if _is_box(marker):
            pose, scale = poses.with_box(marker.pose, marker.scale, *next(own))
            header = poses.with_frame(marker.header, boxes.frame_id)
            marker = poses.replaced(marker, header=header, pose=pose, scale=scale)
        markers.append(marker)
    return poses.replaced(msg, markers=markers)


def with_added(msg: Any, sources: Sequence[tuple[Any, int]]) -> Any:
    """
    Return a copy with cubes of earlier messages added, which have the text ``coasted``.

    A marker has no score, and the text of a cube is not displayed. See `Adapter.with_added`.

    """
    header = msg.markers[0].header
    added = []
    for source, row in sources:
        cube = [*filter(_is_box, source.markers)][row]
        added.append(poses.replaced(cube, header=header, text='coasted'))
    return poses.replaced(msg, markers=[*msg.markers, *added])


def _is_box(marker: Any) -> bool:
    return bool(marker.type == CUBE and marker.action == ADD)


def _cubes(fields: Fields) -> NDArray[np.bool_]:
    """Return which markers are boxes."""
    _, kinds, actions = fields.numbers('markers.id', '<i4', 3).T
    is_box: NDArray[np.bool_] = (kinds == CUBE) & (actions == ADD)
    return is_box


def _labels(fields: Fields) -> BoxLabels:
    """Return ids and namespaces of the boxes."""
    rows = _cubes(fields)
    ids = [str(number) for number in fields.numbers('markers.id', '<i4')[rows, 0].tolist()]
    names = np.array(fields.texts('markers.ns'), object)[rows].tolist()
    return ids, names, np.ones(len(ids))


BOX_FIELDS = {
    'visualization_msgs/msg/MarkerArray': BoxFields(
        ('markers.header.frame_id',),
        'markers.pose.position.x',
        'markers.scale.x',
        _labels,
        others=('markers.id', 'markers.ns'),
        stamp='markers.header.stamp.sec',
        rows=_cubes,
    )
}
