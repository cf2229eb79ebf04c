"""Objects that the node follows from one box each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.errors import TransformUnavailable
from boxreg_ros.io.items import Item
from boxreg_ros.io.session import Session
from boxreg_ros.io.transforms import boxes_to_frame
from boxreg_ros.live.tickets import Detection
from boxreg_ros.live.transform_wait import TransformWait
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import BoxArray

LOST_SHOWN = 10
"""Followed objects that were lost or refused last, of which /diagnostics says why; chosen."""


@dataclass(eq=False, repr=False)
class Following:
    """
    Start to follow objects once their transforms are known, and report those that are lost.

    `sources` has the box that each object began with; `facts` are for /diagnostics. Not
    thread-safe.

    """

    _registrar: BoxRegistrar
    _session: Session
    _wait: TransformWait
    _trouble: Callable[[Reason, str, int], None]

    def __post_init__(self) -> None:
        """Begin with no object."""
        self.facts: dict[str, object] = {}
        self.restart()

    def restart(self) -> None:
        """Forget the boxes: time has gone back."""
        self._waiting: list[Item] = []
        self.sources: dict[str, Detection] = {}

    def add(self, item: Item) -> None:
        """Follow the object of each box of a message, as soon as its transform is known."""
        self._waiting.append(item)

    def start(self, now: float) -> None:
        """Begin with the boxes whose transforms are known by now."""
        waiting = self._waiting
        self._waiting = []
        for item in waiting:
            content = item.content
            assert isinstance(content, BoxArray)
            if not self._wait.is_over(item, now):
                self._waiting.append(item)
                continue
            try:
                fixed_frame = self._session.require_fixed_frame(content)
                T_fixed_item = self._session.tree.lookup(
                    fixed_frame, content.frame_id, content.stamp_ns
                )
            except TransformUnavailable as error:
                why = f'box at {content.stamp_ns}: {error}'
                self._registrar.followed.refused += [(name, why) for name in content.track_ids]
                continue
            for row, track_id in enumerate(content.track_ids):
                self.sources[track_id] = Detection(item.message, row, content.stamp_ns)
            self._registrar.follow(boxes_to_frame(content, T_fixed_item, fixed_frame))

    def report(self) -> None:
        """Report which objects are followed, where others were lost, and boxes not followed."""
        followed = self._registrar.followed
        lost = {}
        for track_id, why in followed.refused:
            lost[f'not_followed {track_id}'] = why
            self._trouble(Reason.NOT_FOLLOWED, f'{track_id}: {why}', 1)
        for one in followed.lost:
            x, y, z = one.box[:3]
            frame = self._session.fixed_frame
            place = f'{one.stamp_ns} ns, x {x:.1f} y {y:.1f} z {z:.1f} m in {frame}'
            lost[f'lost {one.track_id}'] = f'{one.reason} at {place}'
            self._trouble(Reason.LOST, f'{one.track_id}: {one.reason} at {place}', 1)
        followed.refused.clear()
        followed.lost.clear()
        known = {name: text for name, text in self.facts.items() if name != 'following'}
        known = dict(list((known | lost).items())[-LOST_SHOWN:])
        for track_id in followed.track_ids:
            known.pop(f'lost {track_id}', None)
            known.pop(f'not_followed {track_id}', None)
        if followed.track_ids or self.facts or known:
            self.facts = {'following': ', '.join(followed.track_ids) or 'none', **known}
