"""The output of the live registration for label files: final boxes in order, and clouds."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

from boxreg_ros.errors import TransformUnavailable
from boxreg_ros.io.items import Item
from boxreg_ros.io.label_feed import FinalBoxes
from boxreg_ros.io.session import Session
from boxreg_ros.io.stamp_order import kept, Slot, StampOrder
from boxreg_ros.io.transforms import boxes_to_frame
from boxreg_ros.live.recorder_process import RawCloud, RecorderProcess
from boxreg_ros.structures import BoxArray, Floats, RefinedBoxes, Sweep
import numpy as np


class LabelTap:
    """
    Hand every box array to the recorder once, in the order of stamps, when it is final.

    Without a recorder nothing is held. Box arrays that were with the registrar before `start`
    are not recorded. Used by the thread of the worker only.

    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._recorder: RecorderProcess | None = None
        self._order = StampOrder()
        self._cloud_stamps: deque[int] = deque()
        self._is_finishing = False
        self._label_frame = ''

    def start(self, recorder: RecorderProcess) -> None:
        """Record from now on."""
        self._recorder = recorder
        self._order = StampOrder()
        # Boxes find their cloud among as many; see `StampMatcher`.
        self._cloud_stamps = deque(maxlen=recorder.settings.config.queue)
        self._is_finishing = False

    def add_cloud(self, whole: Sweep, parts: Sequence[Item]) -> None:
        """Hand on a cloud in the fixed frame that was merged from parts, if it is recorded."""
        if not parts:  # lost
            return
        self._label_frame = self._label_frame or parts[0].content.frame_id  # as in `relabel`
        recorder = self._recorder
        if recorder is None or not recorder.settings.with_points:
            return
        sweep, T_fixed_sweep = whole, np.eye(4)
        if len(parts) == 1:  # not moved, files get the numbers of the message
            given, T_fixed_given = parts[0].content, parts[0].T_fixed_item
            assert isinstance(given, Sweep) and T_fixed_given is not None
            sweep, T_fixed_sweep = replace(given, times=whole.times), T_fixed_given
        self._cloud_stamps.append(sweep.stamp_ns)
        needed_from_ns = min(self._cloud_stamps)
        if self._order.first_ns is not None:
            needed_from_ns = min(needed_from_ns, self._order.first_ns)
        messages = [part.message for part in parts]
        recorder.put(RawCloud(sweep, T_fixed_sweep, needed_from_ns, messages))

    def expect(self, ticket: object, boxes: BoxArray, T_fixed_given: Floats) -> None:
        """Add boxes in the fixed frame, on their way to the registrar with a ticket."""
        if self._is_recording:
            self._order.expect(Slot(boxes, None, T_fixed_given), ticket)

    def add_kept(self, boxes: BoxArray, reason: str) -> None:
        """Add boxes in the frame of their message that the registrar does not get."""
        if not self._is_recording or not boxes.track_ids:
            return
        T_fixed_boxes = self._pose_of(boxes.frame_id, boxes.stamp_ns)
        if T_fixed_boxes is not None:
            boxes = boxes_to_frame(boxes, T_fixed_boxes, self._session.fixed_frame)
        self._order.expect(Slot(boxes, None, T_fixed_boxes, kept(boxes, reason)))
        self._release()

    def take(self, refined: RefinedBoxes) -> None:
        """Take a result of the registrar."""
        if refined.is_final:
            self._order.take(refined.boxes.ticket, refined)
            self._release()

    def keep_all(self, reason: str) -> None:
        """Release the boxes that the registrar will not return."""
        self._order.keep_all(reason)
        self._release()

    def finish(self) -> None:
        """Record no further boxes; the recording ends with those that are not final yet."""
        self._is_finishing = True
        self._release()

    @property
    def _is_recording(self) -> bool:
        return self._recorder is not None and not self._is_finishing

    def _release(self) -> None:
        """Hand on the boxes that are final; end the recording after the last."""
        if self._recorder is None:
            return
        sensor_frame = self._label_frame or self._session.sensor_frame
        for slot, refined in self._order.ready():
            final = FinalBoxes(
                replace(refined, boxes=replace(refined.boxes, ticket=None)),  # it has the message
                self._session.fixed_frame,
                sensor_frame,
                self._pose_of(sensor_frame, slot.stamp_ns),
                slot.T_fixed_boxes,
            )
            self._recorder.put(final)
        if self._is_finishing and not self._order:
            self._recorder.finish()
            self._recorder = None

    def _pose_of(self, frame: str, stamp_ns: int) -> Floats | None:
        """Return the pose of a frame in the fixed frame at a stamp; None if unknown."""
        try:
            return self._session.tree.lookup(self._session.fixed_frame, frame, stamp_ns)
        except TransformUnavailable:
            return None
