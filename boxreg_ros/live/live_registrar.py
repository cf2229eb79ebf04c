"""Registration of messages as they arrive: the node without its topics and threads."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf
import os
from pathlib import Path
from typing import Any, NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.input_statistics import Drives, joined, to_text
from boxreg_ros.core.latency import LateBoxes, Latency, set_latency
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.errors import ConfigError, TransformUnavailable, UnsupportedMessage
from boxreg_ros.io.input_models import disagreements, read_models
from boxreg_ros.io.items import Item
from boxreg_ros.io.lidars import Lidars, MergedSweep, SensorPlacement, SINGLE_LIDAR
from boxreg_ros.io.session import (
    covariances_to_write,
    hand_to_registrar,
    is_placeholder,
    JumpConfirmation,
    Session,
)
from boxreg_ros.io.stamp_order import kept
from boxreg_ros.io.transforms import boxes_to_frame, inverse
from boxreg_ros.io.whole_files import written_whole
from boxreg_ros.live.budget import TickBudget
from boxreg_ros.live.static_points import StaticPoints
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import BoxArray, COASTED, Floats, REFINED, RefinedBoxes, Sweep
from msg_adapters import Adapter
from msg_adapters.convention import Convention, STANDARD
from msg_adapters.poses import turned_covariances
import numpy as np

CONFIRMATION_TIME = 0.5
"""A message waits this long for the one that confirms a time jump [s]: five sweeps at 10 Hz."""
SETTLING_TIME = 0.3
"""Time for collecting transforms before the fixed frame is chosen among them [s]. Publishers of
/tf at 10 Hz and faster have sent three messages by then."""
BOXES_SILENCE = 3.0
"""After this time without boxes, final boxes are published without further observations [s]."""
LOST_SHOWN = 10
"""Followed objects that were lost or refused last, of which /diagnostics says why; chosen."""
CLOUD_SILENCE = 0.5
"""After this time without clouds, boxes that have waited as long are published unrefined [s]. Five
periods of a LiDAR of 10 Hz."""


class Outgoing(NamedTuple):
    """A message to publish, of the type of the input."""

    message: Any
    is_final: bool  # for the topic of final boxes, not of early ones
    given: BoxArray | None = None  # in the frame of the message; None if it is passed through
    refined: RefinedBoxes | None = None
    received: float | None = None  # when the input arrived [s]
    in_fixed: RefinedBoxes | None = None  # the same as `refined`, as the registrar returns it


class _Detection(NamedTuple):
    """The last message with a box of a track, the row of the box, and its stamp [ns]."""

    message: Any
    row: int
    stamp_ns: int


@dataclass(eq=False, slots=True)
class _Pending:
    """A message whose boxes are with the registrar; the ticket of these boxes."""

    message: Any
    given: BoxArray
    received: float
    T_output_fixed: Floats
    T_output_item: Floats | None  # None: the output frame is that of the message
    has_new_ids: bool
    earlier: dict[str, _Detection]
    """By id, of the tracks that have no box in the message."""
    is_late: bool
    is_early_out: bool = False


class _Passing(NamedTuple):
    """A message that passes through; its final copy waits for the messages before it."""

    message: Any


class LiveRegistrar:
    """
    Register messages as they arrive, and make the messages to publish.

    State: a `Session` with the transforms, the registrar, and the input messages whose final
    boxes have not been published. Not thread-safe. An empty `fixed_frame` is the topmost frame
    that the frame of the clouds moves in, chosen once; an empty `output_frame` is that of each
    message. A message waits `transform_timeout` [s] for transforms that cover its stamp; after
    that they may be extrapolated a little. Both may change.

    `trouble` is called with reason, text and count for everything that is not refined here.
    Without a `budget` all windows are solved; without `static_patience` [s], how long clouds
    wait for their boxes, there are no clouds without moving objects. The file `input_model` of
    what drives have shown of the detector is read now, and written by `save_model`. The caller
    feeds `placement` with info messages, and sets `adapter` before the first boxes.

    """

    def __init__(
        self,
        config: Config,
        fixed_frame: str,
        output_frame: str,
        transform_timeout: float,
        trouble: Callable[[Reason, str, int], None],
        convention: Convention = STANDARD,
        lidars: Lidars = SINGLE_LIDAR,
        budget: TickBudget | None = None,
        static_patience: float | None = None,
        input_model: str = '',
    ) -> None:
        self.output_frame = output_frame.lstrip('/')
        self.transform_timeout = transform_timeout
        self.adapter: Adapter | None = None
        self._trouble = trouble
        self.placement = SensorPlacement(lidars)
        self._unknown_frames: set[str] = set()  # of LiDARs; not waited for
        self.session = Session(convention, config, fixed_frame, self.placement, trouble)
        self._model_file = Path(input_model).expanduser() if input_model else None
        self._drives: Drives = {}
        if self._model_file is not None and not os.access(self._model_file.parent, os.W_OK):
            raise ConfigError(
                f'input_model: expected a file in a folder that can be written to, where it is '
                f'written at the end, got {str(self._model_file)!r}; make the folder, or choose '
                f'another'
            )
        if self._model_file is not None and self._model_file.exists():
            self._drives = read_models([self._model_file])
        submit, windows = (None, None) if budget is None else (budget.submit, budget.windows)
        self.registrar = BoxRegistrar(config, submit, windows, self._drives)
        self.static_points: StaticPoints | None = None
        if static_patience is not None:
            self.static_points = StaticPoints(static_patience, self.registrar)
        self._late = LateBoxes()
        self._latency = Latency()
        self._jumps = JumpConfirmation[Item]()
        self._held: deque[_Pending | _Passing] = deque()  # in order of arrival; first: pending
        self._detections: dict[str, _Detection] = {}  # by track id
        self._seeds: list[Item] = []  # of `follow`, without their transforms yet
        self._sources: dict[str, _Detection] = {}  # the box that each followed object began with
        self._following: dict[str, object] = {}
        self._made: list[Outgoing] = []  # survives an error while further messages are made
        self._choose_at: float | None = None
        self._last_boxes = 0.0

    @property
    def config(self) -> Config:
        """Return the settings of the core; see `BoxRegistrar` for those that may change."""
        return self.registrar.config

    @config.setter
    def config(self, config: Config) -> None:
        self.registrar.config = config
        self.session.config = config

    @property
    def facts(self) -> dict[str, object]:
        """Return origin of the ids, latency of the boxes and followed objects, for reports."""
        facts = {**self.session.facts, 'box latency': self._latency.text}
        return facts | self._following

    def confirm(self, item: Item) -> tuple[list[Item], list[Outgoing]]:
        """
        Return the messages to process next, in the order of stamps: none while this one is held.

        Also return all that was held where time went back: tracks and transforms start anew.

        """
        if is_placeholder(item.content):
            return [item], []
        confirmed, has_jumped = self._jumps.add(item, item.content)
        if not has_jumped:
            return confirmed, []
        stamp_ns = confirmed[0].content.stamp_ns
        self._trouble(
            Reason.TIME_JUMP,
            f'expected stamps of one clock, got some that went back to {stamp_ns} ns; tracks '
            f'start anew: unless a recording is played in a loop, let one clock set all stamps',
            1,
        )
        ready = self.reset()
        self.session.tree.rewind(stamp_ns)
        return confirmed, ready

    def release(self, now: float = inf) -> list[Item]:
        """Return the message that no other has confirmed in time, if any: it is late."""
        held = self._jumps.held
        if held is None or now < held.received + CONFIRMATION_TIME:
            return []
        return self._jumps.release()

    def is_ready(self, item: Item, now: float) -> bool:
        """Return whether a message waits for no transforms and no info message any more."""
        content = item.content
        if now >= item.received + self.transform_timeout or is_placeholder(content):
            return True
        if isinstance(content, Sweep):
            if self._is_unknown(content):
                return True
            if self.placement.awaits_info(content):
                return False
        return self._has_transforms(content, now)

    def _has_transforms(self, content: Sweep | BoxArray, now: float) -> bool:
        """Return whether the transforms of a message have arrived."""
        if self._choose_at is None:
            self._choose_at = now + SETTLING_TIME
        if not self.session.fixed_frame and now < self._choose_at:
            return False
        try:
            fixed_frame = self.session.require_fixed_frame(content)
        except TransformUnavailable:
            return False
        stamp_ns = content.stamp_ns
        if isinstance(content, Sweep):
            stamp_ns = self.placement.last_stamp_ns(content)
        is_covered = self.session.tree.covers(fixed_frame, content.frame_id, stamp_ns)
        if is_covered and self._changes_frame(content):
            return self.session.tree.covers(self.output_frame, fixed_frame, content.stamp_ns)
        return is_covered

    def _is_unknown(self, sweep: Sweep) -> bool:
        """Return whether one of several LiDARs still has no transform after one timeout."""
        frame = sweep.frame_id
        if frame in self._unknown_frames and self.session.tree.connects(
            self.session.fixed_frame, frame
        ):
            self._unknown_frames.remove(frame)
        return frame in self._unknown_frames

    def follow(self, item: Item) -> None:
        """Follow the object of each box of a message, as soon as its transform is known."""
        self._seeds.append(item)

    def _start_following(self, now: float) -> None:
        waiting = self._seeds
        self._seeds = []
        for item in waiting:
            content = item.content
            assert isinstance(content, BoxArray)
            if not self.is_ready(item, now):
                self._seeds.append(item)
                continue
            try:
                fixed_frame = self.session.require_fixed_frame(content)
                T_fixed_item = self.session.tree.lookup(
                    fixed_frame, content.frame_id, content.stamp_ns
                )
            except TransformUnavailable as error:
                why = f'box at {content.stamp_ns}: {error}'
                self.registrar.followed.refused += [(name, why) for name in content.track_ids]
                continue
            for row, track_id in enumerate(content.track_ids):
                self._sources[track_id] = _Detection(item.message, row, content.stamp_ns)
            self.registrar.follow(boxes_to_frame(content, T_fixed_item, fixed_frame))

    def _report_followed(self) -> None:
        """Report which objects are followed, where others were lost, and boxes not followed."""
        followed = self.registrar.followed
        lost = {}
        for track_id, why in followed.refused:
            lost[f'not_followed {track_id}'] = why
            self._trouble(Reason.NOT_FOLLOWED, f'{track_id}: {why}', 1)
        for one in followed.lost:
            x, y, z = one.box[:3]
            place = (
                f'{one.stamp_ns} ns, x {x:.1f} y {y:.1f} z {z:.1f} m in {self.session.fixed_frame}'
            )
            lost[f'lost {one.track_id}'] = f'{one.reason} at {place}'
            self._trouble(Reason.LOST, f'{one.track_id}: {one.reason} at {place}', 1)
        followed.refused.clear()
        followed.lost.clear()
        known = {name: text for name, text in self._following.items() if name != 'following'}
        known = dict(list((known | lost).items())[-LOST_SHOWN:])
        for track_id in followed.track_ids:
            known.pop(f'lost {track_id}', None)
            known.pop(f'not_followed {track_id}', None)
        if followed.track_ids or self._following or known:
            self._following = {'following': ', '.join(followed.track_ids) or 'none', **known}

    def process(self, item: Item) -> list[Outgoing]:
        """Register a message; return the messages that are ready to be published."""
        content = item.content
        if is_placeholder(content):
            return self.passed_through(item.message)
        self._start_following(item.received)
        admitted = self.session.admit(content, item.received_ns)
        if admitted.reason:
            self._report_missing_transform(content, admitted.reason, admitted.detail)
        moved = admitted.moved
        item = item._replace(T_fixed_item=admitted.T_fixed_item)
        if isinstance(content, Sweep):
            if moved is None:
                if content.topic and not self.session.tree.connects(
                    self.session.fixed_frame, content.frame_id
                ):
                    self._unknown_frames.add(content.frame_id)  # the other LiDARs do not wait
                return []
            assert isinstance(moved, Sweep)
            return self._register(self.session.merged(moved, item))
        if moved is not None:
            assert isinstance(moved, BoxArray) and admitted.T_fixed_item is not None
            moved = self._in_time(moved)
            moved = self._with_ticket(item, content, moved, admitted.T_fixed_item)
        ready = self._outgoing(hand_to_registrar(self.registrar, moved, restarts=False))
        if moved is None:
            ready += self.passed_through(item.message)
        return ready

    def _in_time(self, boxes: BoxArray) -> BoxArray:
        """Return late boxes as predicted for their stamp."""
        self._late.add_boxes(boxes)
        known = set_latency(self.config)
        self._latency = self._late.kept_up() if known is None else known
        if self._latency.warning:
            self._trouble(Reason.LATENCY, self._latency.warning, 1)
        return self._late.corrected(boxes, self._latency.seconds)

    def _register(self, complete: list[MergedSweep]) -> list[Outgoing]:
        """Register sweeps; return the messages that are ready to be published."""
        ready: list[Outgoing] = []
        for sweep, parts in complete:
            clouds = [part for part in parts if part is not None]
            self._late.add_sweep(sweep)
            if self.static_points is not None:
                self.static_points.add_cloud(sweep, clouds)
            ready += self._outgoing(hand_to_registrar(self.registrar, sweep, restarts=False))
        return ready

    def lose(self, stamp_ns: int, lidar: str = '') -> list[Outgoing]:
        """Release the boxes that wait for a cloud that was dropped, of one of several LiDARs."""
        nothing = np.zeros((0, 3))
        sweep = Sweep(stamp_ns, self.session.fixed_frame, nothing, is_dropped=True, topic=lidar)
        if lidar:
            return self._register(self.session.merged(sweep))
        return self._outgoing(self.registrar.add_sweep(sweep))

    def lose_overdue(self, now: float, cloud_received: float) -> list[Outgoing]:
        """Release boxes that wait for clouds if no clouds have arrived for long."""
        if now < cloud_received + CLOUD_SILENCE:
            return []
        overdue = [
            pending.given.stamp_ns
            for pending in self._held
            if isinstance(pending, _Pending)
            and not pending.is_early_out
            and now >= pending.received + CLOUD_SILENCE
        ]
        if not overdue:
            return []
        ready = self._register(self.session.unmerged())
        # Beyond the reach of these boxes: a cloud that arrived before them may still be theirs.
        reach = self.config.reach
        return ready + self.lose(max(overdue) + round(reach * 1e9) + 1)

    @property
    def is_holding(self) -> bool:
        """Return whether messages wait for a cloud, further observations or confirmation."""
        return bool(self._held) or self._jumps.held is not None

    def is_silent(self, now: float) -> bool:
        """Return whether boxes are held and no further ones have arrived for long."""
        return bool(self._held) and self.has_ceased(now)

    def has_ceased(self, now: float) -> bool:
        """Return whether no boxes have arrived for long."""
        return now >= self._last_boxes + max(BOXES_SILENCE, self.config.max_gap)

    def flush(self) -> list[Outgoing]:
        """Return everything that is held; tracks continue if further boxes arrive."""
        ready = self._register(self.session.unmerged())
        return ready + self._outgoing(self.registrar.flush())

    def catch_up(self, limit: int) -> list[Outgoing]:
        """Solve up to `limit` tracks that wait, for their final boxes."""
        return self._outgoing(self.registrar.catch_up(limit))

    def reset(self) -> list[Outgoing]:
        """Forget everything but the transforms; return everything that is held."""
        ready = self.flush()
        self._forget()
        return ready

    def save_model(self) -> str:
        """Add this drive to the file of the input model; return where drives in it differ."""
        if self._model_file is None:
            return ''
        drives = joined([self._drives, self.registrar.statistics()])
        with written_whole(self._model_file) as file:
            file.write(to_text(drives))
        return '; '.join(disagreements(drives))

    def abandon(self, item: Item | None) -> list[Outgoing]:
        """
        Start again after an internal error while a message was being processed.

        Return the messages made before the error, and all that are held, passed through.

        """
        self._forget()
        held = list(self._held)
        self._held.clear()
        ready = self._made
        self._made = []
        for waiting in held:
            if isinstance(waiting, _Pending) and not waiting.is_early_out:
                ready.append(Outgoing(waiting.message, False))
            ready += self.last(waiting.message)
        is_held = item is None or any(waiting.message is item.message for waiting in held)
        if item is not None and isinstance(item.content, BoxArray) and not is_held:
            ready += self.passed_through(item.message)
        return ready

    def _forget(self) -> None:
        """Forget all but the transforms and the messages that are held."""
        if self.static_points is not None:
            self.static_points.reset()
        self.registrar.reset()
        self.session.restart()
        self._late.restart()
        self._detections = {}
        self._seeds = []
        self._sources = {}

    def passed_through(self, message: Any) -> list[Outgoing]:
        """Return an input message as early boxes and, once those before it are, as final."""
        return [Outgoing(message, False), *self.last(message)]

    def last(self, message: Any) -> list[Outgoing]:
        """Return an input message as final boxes, or hold it behind those before it."""
        if not self._held:
            return [Outgoing(message, True)]
        self._held.append(_Passing(message))
        return []

    def labels_passed_through(self, message: Any) -> RefinedBoxes | None:
        """Return the boxes of a message that passed through as kept; None for unreadable ones."""
        assert self.adapter is not None  # it has read the message
        try:
            boxes = self.adapter.from_msg(message)
        except UnsupportedMessage:
            return None
        fixed_frame = self.session.fixed_frame
        try:
            T_fixed_boxes = self.session.tree.lookup(fixed_frame, boxes.frame_id, boxes.stamp_ns)
        except TransformUnavailable:
            return kept(boxes, Reason.NO_TRANSFORM)
        return kept(boxes_to_frame(boxes, T_fixed_boxes, fixed_frame), Reason.BOXES_QUEUE_FULL)

    def _report_missing_transform(
        self, content: Sweep | BoxArray, reason: Reason, detail: str
    ) -> None:
        """Report a sweep, or the boxes of an array, that no transform is known for."""
        count = 1 if isinstance(content, Sweep) else len(content.track_ids)
        if count:
            self._trouble(reason, detail, count)

    def _with_ticket(
        self, item: Item, content: BoxArray, moved: BoxArray, T_fixed_item: Floats
    ) -> BoxArray | None:
        """Hold a message until its boxes are ready; None if the output frame is not reached."""
        T_output_fixed = inverse(T_fixed_item)
        T_output_item: Floats | None = None
        given = content
        if self._changes_frame(content):
            try:
                T_output_fixed = self.session.tree.lookup(
                    self.output_frame, self.session.fixed_frame, content.stamp_ns
                )
            except TransformUnavailable as error:
                self._report_missing_transform(content, Reason.NO_TRANSFORM, str(error))
                return None
            T_output_item = T_output_fixed @ T_fixed_item
            given = boxes_to_frame(content, T_output_item, self.output_frame)
        self._last_boxes = item.received
        for found in self.session.findings:
            self._trouble(found.reason, found.text, 1)
        pending = _Pending(
            item.message, replace(given, track_ids=moved.track_ids), item.received,
            T_output_fixed, T_output_item, moved.track_ids != content.track_ids,
            self._earlier_detections(item.message, moved), self._latency.seconds != 0,
        )  # fmt: skip
        self._held.append(pending)
        return replace(moved, ticket=pending)

    def _earlier_detections(self, message: Any, boxes: BoxArray) -> dict[str, _Detection]:
        """Return the last detections of tracks that miss one in `boxes`; note those of `boxes`."""
        # `coast` may become larger while tracks without a detection wait for their end.
        oldest_ns = boxes.stamp_ns - round((self.config.coast + self.config.max_gap) * 1e9)
        own = set(boxes.track_ids)
        earlier = {
            track_id: detection
            for track_id, detection in self._detections.items()
            if detection.stamp_ns >= oldest_ns and track_id not in own
        }
        self._detections = earlier | {
            track_id: _Detection(message, row, boxes.stamp_ns)
            for row, track_id in enumerate(boxes.track_ids)
        }
        return earlier

    def _changes_frame(self, content: Sweep | BoxArray) -> bool:
        """Return whether boxes are published in another frame than that of their message."""
        is_boxes = isinstance(content, BoxArray)
        return is_boxes and self.output_frame not in ('', content.frame_id)

    def _outgoing(self, ready: list[RefinedBoxes]) -> list[Outgoing]:
        """Return the messages to publish for results of the registrar."""
        self._report_followed()
        for refined in ready:
            pending = refined.boxes.ticket
            assert isinstance(pending, _Pending)
            self._made.append(self._message_of(refined, pending))
            if self.static_points is not None and not pending.is_early_out:
                self.static_points.add_boxes(refined)
            pending.is_early_out = True
            if refined.is_final:
                self._held.remove(pending)
                while self._held and isinstance(self._held[0], _Passing):
                    self._made.append(Outgoing(self._held.popleft().message, True))
        made = self._made
        self._made = []
        return made

    def _message_of(self, refined: RefinedBoxes, pending: _Pending) -> Outgoing:
        """Return the message of refined boxes, in the output frame."""
        assert self.adapter is not None  # it has read the message
        moved = refined_to_frame(refined, pending.T_output_fixed, pending.given.frame_id)
        message = pending.message
        coasted = refined.boxes.track_ids[len(pending.given.track_ids) :]
        if coasted:
            # A followed object may have begun after the message arrived.
            sources = [
                (pending.earlier.get(track_id) or self._sources[track_id])[:2]
                for track_id in coasted
            ]
            message = self.adapter.with_added(message, sources)
        T_output_item = pending.T_output_item
        is_changed = REFINED in refined.status or COASTED in refined.status
        # Copying a message takes time; under load most boxes are kept.
        if is_changed or T_output_item is not None or pending.has_new_ids or pending.is_late:
            covariances = covariances_to_write(moved)
            message = self.adapter.to_msg(message, moved.boxes, covariances, T_output_item)
        return Outgoing(message, refined.is_final, pending.given, moved, pending.received, refined)


def refined_to_frame(refined: RefinedBoxes, T_frame_boxes: Floats, frame_id: str) -> RefinedBoxes:
    """Return refined boxes and their covariances in another frame."""
    return replace(
        refined,
        boxes=boxes_to_frame(refined.boxes, T_frame_boxes, frame_id),
        covariances=turned_covariances(refined.covariances, T_frame_boxes),
    )
