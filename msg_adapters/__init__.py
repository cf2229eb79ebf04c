"""
Messages to structures and back; one module per family of messages.

Messages are read by attribute, so the same reader takes what rclpy, rosbags and mcap hand over,
and nothing of ROS need be installed.

"""

from __future__ import annotations

from importlib import import_module
from typing import Any, cast, Protocol

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.structures import BoxArray, Floats

POINTS_TYPE = 'sensor_msgs/msg/PointCloud2'

ADAPTERS = {
    'vision_msgs/msg/Detection3DArray': 'msg_adapters.vision',
    'visualization_msgs/msg/MarkerArray': 'msg_adapters.markers',
}


class Adapter(Protocol):
    """What every module named in `ADAPTERS` offers."""

    def from_msg(self, msg: Any) -> BoxArray:
        """Return the boxes of a message, in the message's frame."""

    def to_msg(self, msg: Any, boxes: BoxArray, covariances: Floats | None = None) -> Any:
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
            Of x y z roll pitch yaw [m, rad]; written where the type has a place for it.

        """


def canonical(type_name: str) -> str:
    """Return ``package/msg/Type`` for ``package/Type``; other spellings stay as they are."""
    package, *middle, name = type_name.split('/')
    return type_name if middle or not package else f'{package}/msg/{name}'


def adapter_for(type_name: str) -> Adapter:
    """
    Return the module that reads and writes box arrays of this type.

    Raises
    ------
    UnsupportedMessage
        If no adapter reads the type.

    """
    module = ADAPTERS.get(canonical(type_name))
    if module is None:
        raise UnsupportedMessage(
            f'message type {type_name!r} holds no boxes that can be read; expected one of '
            f'{", ".join(ADAPTERS)}'
        )
    return cast(Adapter, import_module(module))
