"""``autoware_sensing_msgs/ConcatenatedPointCloudInfo``: which LiDAR measured which points."""

from __future__ import annotations

from typing import Any, NamedTuple

from msg_adapters.poses import stamp_ns

INFO_TYPE = 'autoware_sensing_msgs/msg/ConcatenatedPointCloudInfo'


class CloudSource(NamedTuple):
    """The part of a concatenated cloud that one LiDAR measured."""

    stamp_ns: int
    """Of the cloud of the LiDAR [ns]."""
    frame_id: str
    """Of the LiDAR."""
    begin: int
    """First point of the part in the concatenated cloud."""
    length: int


class ConcatenationInfo(NamedTuple):
    """The stamp of a concatenated cloud [ns], and its parts that have points."""

    stamp_ns: int
    sources: tuple[CloudSource, ...]


def from_msg(msg: Any) -> ConcatenationInfo:
    """Return the content of a message; parts without points are left out."""
    sources = [
        CloudSource(
            stamp_ns(source.header), source.header.frame_id, source.idx_begin, source.length
        )
        for source in msg.source_info
        if source.length
    ]
    return ConcatenationInfo(stamp_ns(msg.header), tuple(sources))
