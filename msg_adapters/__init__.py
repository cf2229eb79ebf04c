"""
Messages to structures and back; one module per family of messages.

Messages are read by attribute, so the same reader takes what rclpy, rosbags and mcap hand over,
and nothing of ROS need be installed.

"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any, cast, Protocol

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.structures import BoxArray, Floats
from msg_adapters.convention import Convention

POINTS_TYPE = 'sensor_msgs/msg/PointCloud2'

ADAPTERS = {
    'vision_msgs/msg/Detection3DArray': 'msg_adapters.vision',
    'vision_msgs/msg/BoundingBox3DArray': 'msg_adapters.vision',
    'autoware_perception_msgs/msg/TrackedObjects': 'msg_adapters.autoware',
    'autoware_perception_msgs/msg/DetectedObjects': 'msg_adapters.autoware',
    'derived_object_msgs/msg/ObjectArray': 'msg_adapters.derived',
    'derived_object_msgs/msg/ObjectWithCovarianceArray': 'msg_adapters.derived',
    'foxglove_msgs/msg/SceneUpdate': 'msg_adapters.foxglove',
    'jsk_recognition_msgs/msg/BoundingBoxArray': 'msg_adapters.jsk',
    'visualization_msgs/msg/MarkerArray': 'msg_adapters.markers',
}
WITHOUT_IDS = (
    'vision_msgs/msg/BoundingBox3DArray',
    'autoware_perception_msgs/msg/DetectedObjects',
    'jsk_recognition_msgs/msg/BoundingBoxArray',
)


class Adapter(Protocol):
    """What every module named in `ADAPTERS` offers."""

    def from_msg(self, msg: Any) -> BoxArray:
        """Return the boxes of a message, in the message's frame."""

    def to_msg(
        self,
        msg: Any,
        boxes: BoxArray,
        covariances: Floats | None = None,
        T_out_in: Floats | None = None,
    ) -> Any:
        """
        Return a copy of the input message with its boxes replaced.

        Parameters
        ----------
        msg : message
            The message that `from_msg` read; left as it is. Whatever `boxes` does not hold is
            carried over.
        boxes : BoxArray
            As many boxes, in the same order, in the frame ``boxes.frame_id``.
        covariances : array, shape (n, 6, 6), optional
            Of x y z roll pitch yaw [m, rad]; written where the type has a place for it. Where
            one is NaN, the message's own stays.
        T_out_in : array, shape (4, 4), optional
            Maps the frame of the message to that of `boxes`, where it is another: what is
            carried over is moved with it.

        """


@dataclass(frozen=True, slots=True)
class _Converting:
    """An adapter whose messages follow another convention."""

    inner: Adapter
    convention: Convention

    def from_msg(self, msg: Any) -> BoxArray:
        return self.convention.to_centers(self.inner.from_msg(msg))

    def to_msg(
        self,
        msg: Any,
        boxes: BoxArray,
        covariances: Floats | None = None,
        T_out_in: Floats | None = None,
    ) -> Any:
        if covariances is not None:
            covariances = self.convention.covariances_from_centers(boxes, covariances)
        return self.inner.to_msg(msg, self.convention.from_centers(boxes), covariances, T_out_in)


def canonical(type_name: str) -> str:
    """Return ``package/msg/Type`` for ``package/Type``; other spellings stay as they are."""
    package, slash, name = type_name.partition('/')
    is_short = package and slash and '/' not in name
    return f'{package}/msg/{name}' if is_short else type_name


def adapter_for(type_name: str, convention: Convention | None = None) -> Adapter:
    """
    Return what reads and writes box arrays of this type.

    Parameters
    ----------
    type_name : str
        ``package/msg/Type``.
    convention : Convention, optional
        What the poses and sizes of this topic mean, and whether its boxes are given ids later
        on; if not, types that have none are refused. None: what the type says.

    Raises
    ------
    UnsupportedMessage
        If no adapter reads the type, or it has no ids and they are needed.

    """
    module = ADAPTERS.get(canonical(type_name))
    if module is None:
        raise UnsupportedMessage(
            f'message type {type_name!r} holds no boxes that can be read; expected one of '
            f'{", ".join(ADAPTERS)}'
        )
    if canonical(type_name) in WITHOUT_IDS and convention and not convention.associate:
        raise UnsupportedMessage(
            f'boxes of type {type_name} have no ids to tell objects by over time; put a tracker '
            f'before, or have them associated: associate:=true for the node, --associate for '
            f'boxreg relabel'
        )
    adapter = cast(Adapter, import_module(module))
    if convention is None or convention.is_standard:
        return adapter
    return _Converting(adapter, convention)
