"""
Box messages to structures and back; one module per family of messages.

Messages are read by attribute, so that one adapter serves the classes of rclpy, rosbags, mcap and
protobuf, and no ROS installation is needed. `protocol.Adapter` states what a module offers;
`registry.MESSAGE_TYPES` is the literal table of all types.

"""

from msg_adapters.clouds import CLOUD_TYPES, POINTS_TYPE
from msg_adapters.protocol import Adapter
from msg_adapters.registry import (
    adapter_for,
    ADAPTERS,
    canonical,
    MESSAGE_TYPES,
    WITHOUT_IDS,
)

__all__ = [
    'Adapter',
    'adapter_for',
    'ADAPTERS',
    'canonical',
    'CLOUD_TYPES',
    'MESSAGE_TYPES',
    'POINTS_TYPE',
    'WITHOUT_IDS',
]
