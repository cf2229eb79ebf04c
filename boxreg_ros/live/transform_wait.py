"""Whether a message still waits for its transforms."""

from __future__ import annotations

from boxreg_ros.errors import TransformUnavailable
from boxreg_ros.io.items import Item
from boxreg_ros.io.session import is_placeholder, Session
from boxreg_ros.structures import BoxArray, Sweep

SETTLING_TIME = 0.3
"""Time for collecting transforms before the fixed frame is chosen among them [s]. Publishers of
/tf at 10 Hz and faster have sent three messages by then."""


class TransformWait:
    """
    Decide how long messages wait for transforms that cover their stamp.

    A message waits `timeout` [s] at most; after that transforms may be extrapolated a little. An
    empty `output_frame` is that of each message. Both may change. Not thread-safe.

    """

    def __init__(self, session: Session, timeout: float, output_frame: str) -> None:
        self.timeout = timeout
        self.output_frame = output_frame.lstrip('/')
        self._session = session
        self._unknown_frames: set[str] = set()  # of LiDARs; not waited for
        self._choose_at: float | None = None

    def is_over(self, item: Item, now: float) -> bool:
        """Return whether a message waits for no transforms and no info message any more."""
        content = item.content
        if now >= item.received + self.timeout or is_placeholder(content):
            return True
        if isinstance(content, Sweep):
            if self._is_unknown(content) or not content.frame_id:
                return True
            if self._session.placement.awaits_info(content):
                return False
        return self._has_transforms(content, now)

    def give_up(self, sweep: Sweep) -> None:
        """Let a LiDAR of several whose frame is not known wait no more: the others go on."""
        tree = self._session.tree
        if sweep.topic and not tree.connects(self._session.fixed_frame, sweep.frame_id):
            self._unknown_frames.add(sweep.frame_id)

    def changes_frame(self, content: Sweep | BoxArray) -> bool:
        """Return whether boxes are published in another frame than that of their message."""
        is_boxes = isinstance(content, BoxArray)
        return is_boxes and self.output_frame not in ('', content.frame_id)

    def _has_transforms(self, content: Sweep | BoxArray, now: float) -> bool:
        """Return whether the transforms of a message have arrived."""
        session = self._session
        if self._choose_at is None:
            self._choose_at = now + SETTLING_TIME
        if not session.fixed_frame and now < self._choose_at:
            return False
        try:
            fixed_frame = session.require_fixed_frame(content)
        except TransformUnavailable:
            return False
        stamp_ns = content.stamp_ns
        if isinstance(content, Sweep):
            stamp_ns = session.placement.last_stamp_ns(content)
        is_final = session.tree.is_final(fixed_frame, content.frame_id, stamp_ns)
        if is_final and self.changes_frame(content):
            return session.tree.is_final(self.output_frame, fixed_frame, content.stamp_ns)
        return is_final

    def _is_unknown(self, sweep: Sweep) -> bool:
        """Return whether one of several LiDARs still has no transform after one timeout."""
        frame = sweep.frame_id
        if frame in self._unknown_frames and self._session.tree.connects(
            self._session.fixed_frame, frame
        ):
            self._unknown_frames.remove(frame)
        return frame in self._unknown_frames
