"""Topics of a recording, found by the type of their messages or by name."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from boxreg_ros.errors import RecordingError, UnsupportedMessage
from boxreg_ros.io.lidars import Lidars
from msg_adapters import ADAPTERS, CLOUD_TYPES, WITHOUT_IDS
from msg_adapters.clouds import PACKETS
from msg_adapters.concatenation import INFO_TYPE
from rosbags.interfaces import Connection

TF_TYPES = ('tf2_msgs/msg/TFMessage', 'tf/msg/tfMessage')
ODOMETRY_TYPE = 'nav_msgs/msg/Odometry'
INFO_SUFFIX = '_info'
"""Autoware publishes the info on a topic of clouds under its name with this suffix."""
SEVERAL_LIDARS = ', or merge several LiDARs: repeat --points'
WITHOUT_BOXES = ', or boxreg relabel --labels FORMAT:PATH or --boxes none'


def namespace_of(topic: str) -> str:
    """Return the namespace of a topic, without a slash at its end: empty for ``/tf``."""
    return topic.rpartition('/')[0]


def nearest_namespace(topics: Collection[str], spaces: Collection[str]) -> str | None:
    """
    Return the longest of some namespaces that all topics are in; None if there is none.

    Parameters
    ----------
    topics : collection of str
        Names with their namespaces, as ``/r1/lidar/points``.
    spaces : collection of str
        Namespaces as of `namespace_of`; the empty one has all topics in it.

    """
    fitting = [space for space in spaces if all(topic.startswith(f'{space}/') for topic in topics)]
    return max(fitting, key=len, default=None)


class Topics:
    """
    Topics of a recording.

    `kinds` has all of them, sorted, with the types of their messages; `transforms` are those of
    TF, `static_transforms` those of its static part.

    """

    def __init__(self, connections: Sequence[Connection], origin: str) -> None:
        self._origin = origin
        self._connections = connections
        ordered = sorted(connections, key=lambda connection: connection.topic)
        self.kinds = {connection.topic: connection.msgtype for connection in ordered}
        self.transforms = self.of(TF_TYPES)
        self.static_transforms = {t for t in self.transforms if t.endswith('tf_static')}
        self._filled = {connection.topic for connection in connections if connection.msgcount}

    def connections(self, topics: Collection[str]) -> list[Connection]:
        """Return the connections of some topics."""
        return [connection for connection in self._connections if connection.topic in topics]

    def of(self, types: Collection[str]) -> set[str]:
        """Return the topics of these types."""
        return {topic for topic, kind in self.kinds.items() if kind in types}

    def filled(self, types: Collection[str]) -> list[str]:
        """Return the topics of these types that have messages."""
        return [topic for topic in self.kinds if topic in self.of(types) & self._filled]

    def find(self, role: str, content: str, types: Sequence[str], asked: str | None) -> str:
        """
        Return the topic that was asked for, or the only one of some types with messages.

        Parameters
        ----------
        role : str
            Option that chooses the topic, for errors.
        content : str
            Name of what it has, for errors.
        types : sequence of str
            As ``package/msg/Type``.
        asked : str or None
            The topic that was asked for.

        Returns
        -------
        topic : str
            One of the recording.

        Raises
        ------
        RecordingError
            If there is no such topic, or, with none asked for, more than one has messages.
        UnsupportedMessage
            If the topic that was asked for has another type.

        """
        candidates = self.filled(types)
        if asked is not None:
            return self._checked(asked, role, content, types)
        if len(candidates) == 1:
            return candidates[0]
        if candidates:
            raise RecordingError(
                f'{self._origin}: several topics have {content}: {", ".join(candidates)}; choose '
                f'one with --{role}{SEVERAL_LIDARS if role == "points" else ""}'
            )
        if empty := sorted(self.of(types)):
            raise RecordingError(
                f'{self._origin}: no {content}: no messages on {", ".join(empty)}; record the '
                f'topic while its publisher runs'
            )
        packets = self.filled(PACKETS) if role == 'points' else []
        if packets:
            raise RecordingError(
                f'{self._origin}: no point clouds, but packets of a LiDAR: '
                f'{", ".join(f"{topic} ({self.kinds[topic]})" for topic in packets)}; convert '
                f'them to points first: play the recording to '
                f'{" and ".join({PACKETS[self.kinds[topic]]: None for topic in packets})}, and '
                f'record the points it publishes'
            )
        there = ', '.join(f'{topic} ({kind})' for topic, kind in self.kinds.items())
        raise RecordingError(
            f'{self._origin}: no {content}, expected a topic of type {" or ".join(types)}; '
            f'there: {there or "no topics"}; give a recording that has one'
            f'{WITHOUT_BOXES if role == "boxes" else ""}'
        )

    def _checked(self, asked: str, role: str, content: str, types: Sequence[str]) -> str:
        """Return the topic asked for if it is there, and of one of the types."""
        if asked not in self.kinds:
            fitting = ', '.join(self.filled(types)) or 'none'
            raise RecordingError(
                f'{self._origin}: no topic {asked!r}; topics with {content}: {fitting}; choose '
                f'one with --{role}'
            )
        if self.kinds[asked] not in types:
            raise UnsupportedMessage(
                f'topic {asked!r}: {content} expected as one of {", ".join(types)}, got '
                f'{self.kinds[asked]}; choose another topic with --{role}'
            )
        return asked

    def find_boxes(self, asked: str | None, may_lack_ids: bool) -> str:
        """Return the topic of boxes; one without ids only if asked for, or without others."""
        with_ids = tuple(name for name in ADAPTERS if name not in WITHOUT_IDS)
        is_free = may_lack_ids or asked is not None or not self.filled(with_ids)
        return self.find('boxes', 'boxes', tuple(ADAPTERS) if is_free else with_ids, asked)

    def find_lidars(self, lidars: Lidars) -> tuple[Lidars, str]:
        """
        Return the LiDARs with the topics of their clouds, and the first topic with clouds.

        The topic of info messages on concatenated clouds is found by its name.

        """
        asked: Sequence[str | None] = lidars.topics or (None,)
        topics = [self.find('points', 'point clouds', CLOUD_TYPES, topic) for topic in asked]
        info = lidars.info
        if info:
            info = self.find('points-info', 'info on concatenated clouds', (INFO_TYPE,), info)
        elif len(topics) == 1 and self.kinds.get(topics[0] + INFO_SUFFIX) == INFO_TYPE:
            info = topics[0] + INFO_SUFFIX
        with_clouds = [topic for topic in topics if topic in self._filled]
        return replace(lidars, topics=tuple(topics), info=info), (with_clouds or topics)[0]
