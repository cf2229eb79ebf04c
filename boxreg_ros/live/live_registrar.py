"""Registration of messages as they arrive: the node without its topics and threads."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from math import inf
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.core.matching import Pair
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.errors import TransformUnavailable, UnsupportedMessage
from boxreg_ros.io.items import Item
from boxreg_ros.io.lidars import Lidars, MergedSweep, SensorPlacement, SINGLE_LIDAR
from boxreg_ros.io.session import hand_to_registrar, is_placeholder, JumpConfirmation, Session
from boxreg_ros.io.transforms import boxes_to_frame, inverse
from boxreg_ros.live.budget import TickBudget
from boxreg_ros.live.following import Following
from boxreg_ros.live.model_file import ModelFile
from boxreg_ros.live.outgoing import Detections, Given, Outgoing, outgoing, OutputFrame, passed_on
from boxreg_ros.live.static_points import StaticPoints
from boxreg_ros.live.transform_wait import TransformWait
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import BoxArray, Floats, kept, RefinedBoxes, Sweep
from msg_adapters import Adapter
from msg_adapters.convention import Convention, STANDARD
import numpy as np

CONFIRMATION_TIME = 0.5
"""A message waits this long for the one that confirms a time jump [s]: five sweeps at 10 Hz."""
BOXES_SILENCE = 3.0
"""After this time without boxes, final boxes are published without further observations [s]."""
CLOUD_SILENCE = 0.5
"""After this time without clouds, boxes that have waited as long are published unrefined [s]. Five
periods of a LiDAR of 10 Hz."""
PASSING = BoxArray(0, '', (), (), np.zeros(0), np.zeros((0, 9)))
"""In the place of a message that passes through: it stands behind the newest boxes."""
PASSED = 'passed'
"""Their reason; they have no boxes that it could be counted for."""


class LiveRegistrar:
    """
    Register messages as they arrive, and make the messages to publish.

    The registrar has the order of the messages; what is published of each is in its ticket, a
    `Given`. Not thread-safe. `wait` says how long a message waits for its transforms, `following`
    which objects are followed. An empty `fixed_frame` is the topmost frame that the frame of the
    clouds moves in, chosen once; an empty `output_frame` is that of each message.

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
        self.adapter: Adapter | None = None
        self._trouble = trouble
        self.placement = SensorPlacement(lidars)
        self.session = Session(convention, config, fixed_frame, self.placement, trouble)
        self.wait = TransformWait(self.session, transform_timeout, output_frame)
        self._model = ModelFile(input_model)
        submit, windows = (None, None) if budget is None else (budget.submit, budget.windows)
        self.registrar = BoxRegistrar(
            config, submit, windows, self._model.drives, prepare=self._note_latency
        )
        self.following = Following(self.registrar, self.session, self.wait, trouble)
        self.static_points: StaticPoints | None = None
        if static_patience is not None:
            self.static_points = StaticPoints(static_patience, self.registrar)
        self._jumps = JumpConfirmation[Item]()
        self._detections = Detections()
        # Both survive an error while messages are made.
        self._results = deque[RefinedBoxes]()
        self._made: list[Outgoing] = []
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
        facts = {**self.session.facts, 'box latency': self.registrar.latency.text}
        return facts | self.following.facts

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

    def process(self, item: Item) -> list[Outgoing]:
        """Register a message; return the messages that are ready to be published."""
        content = item.content
        if is_placeholder(content):
            return self.passed_through(item.message)
        self.following.start(item.received)
        admitted = self.session.admit(content, item.received_ns)
        if admitted.reason:
            self._report_missing_transform(content, admitted.reason, admitted.detail)
        moved = admitted.moved
        item = item._replace(T_fixed_item=admitted.T_fixed_item)
        if isinstance(content, Sweep):
            if moved is None:
                self.wait.give_up(content)
                return []
            assert isinstance(moved, Sweep)
            return self._register(self.session.merged(moved, item))
        if moved is not None:
            assert isinstance(moved, BoxArray) and admitted.T_fixed_item is not None
            moved = self._with_ticket(item, content, moved, admitted.T_fixed_item)
        if moved is None:
            return self.passed_through(item.message)
        return self._outgoing(hand_to_registrar(self.registrar, moved, restarts=False))

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
            boxes.stamp_ns
            for boxes in self.registrar.unpaired
            if now >= _given(boxes).received + CLOUD_SILENCE
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
        return self.registrar.num_held > 0 or self._jumps.held is not None

    def is_silent(self, now: float) -> bool:
        """Return whether boxes are held and no further ones have arrived for long."""
        return self.registrar.num_held > 0 and self.has_ceased(now)

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
        self.registrar.reset()
        self._forget()
        return ready

    def save_model(self) -> str:
        """Add this drive to the file of the input model; return where drives in it differ."""
        return self._model.save(self.registrar.statistics())

    def abandon(self, item: Item | None) -> list[Outgoing]:
        """
        Start again after an internal error while a message was being processed.

        Return the messages made before the error, and all that are held, passed through.

        """
        results = [*self._results, *self.registrar.abandon(Reason.FAILED)]
        self._results.clear()
        self._forget()
        ready = self._made
        self._made = []
        is_returned = item is None or not isinstance(item.content, BoxArray)
        for refined in results:
            given = _given(refined.boxes)
            is_returned |= item is not None and given.message is item.message
            if not given.is_early_out:
                ready.append(passed_on(given, False))
                given.is_early_out = True
            if refined.is_final:
                ready.append(passed_on(given, True))
        if item is not None and not is_returned:
            ready += self.passed_through(item.message)
        return ready

    def passed_through(self, message: Any) -> list[Outgoing]:
        """Return an input message as early boxes and, once those before it are, as final."""
        return [Outgoing(message, False), *self.last(message)]

    def last(self, message: Any) -> list[Outgoing]:
        """Return an input message as final boxes once those before it are."""
        ticket = Given(message, received=inf, is_early_out=True)
        return self._outgoing(self.registrar.add_kept(replace(PASSING, ticket=ticket), PASSED))

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

    def _register(self, complete: list[MergedSweep]) -> list[Outgoing]:
        """Register sweeps; return the messages that are ready to be published."""
        ready: list[Outgoing] = []
        for sweep, parts in complete:
            if self.static_points is not None:
                clouds = [part for part in parts if part is not None]
                self.static_points.add_cloud(sweep, clouds)
            ready += self._outgoing(hand_to_registrar(self.registrar, sweep, restarts=False))
        return ready

    def _forget(self) -> None:
        """Forget all but the transforms."""
        if self.static_points is not None:
            self.static_points.reset()
        self.session.restart()
        self._detections.clear()
        self.following.restart()

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
        """Return boxes with their ticket; None if the output frame is not reached."""
        frame = OutputFrame(inverse(T_fixed_item), None)
        shown = content
        if self.wait.changes_frame(content):
            try:
                T_output_fixed = self.session.tree.lookup(
                    self.wait.output_frame, self.session.fixed_frame, content.stamp_ns
                )
            except TransformUnavailable as error:
                self._report_missing_transform(content, Reason.NO_TRANSFORM, str(error))
                return None
            T_output_item = T_output_fixed @ T_fixed_item
            frame = OutputFrame(T_output_fixed, T_output_item)
            shown = boxes_to_frame(content, T_output_item, self.wait.output_frame)
        self._last_boxes = item.received
        for found in self.session.findings:
            self._trouble(found.reason, found.text, 1)
        given = Given(
            item.message,
            replace(shown, track_ids=moved.track_ids),
            item.received,
            frame,
            moved.track_ids != content.track_ids,
            self._detections.earlier(item.message, moved, self.config),
        )
        return replace(moved, ticket=given)

    def _note_latency(self, pair: Pair) -> BoxArray:
        """Report boxes that were late, and return them."""
        latency = self.registrar.latency
        _given(pair.boxes).is_late = latency.seconds != 0
        if latency.warning:
            self._trouble(Reason.LATENCY, latency.warning, 1)
        return pair.boxes

    def _outgoing(self, results: list[RefinedBoxes]) -> list[Outgoing]:
        """Return the messages to publish for results of the registrar."""
        self._results += results
        self.following.report()
        while self._results:
            refined = self._results[0]
            given = _given(refined.boxes)
            if refined.is_final or not given.is_early_out:
                self._made.append(self._message_of(refined, given))
            if self.static_points is not None and not given.is_early_out:
                self.static_points.add_boxes(refined)
            given.is_early_out = True
            self._results.popleft()
        made = self._made
        self._made = []
        return made

    def _message_of(self, refined: RefinedBoxes, given: Given) -> Outgoing:
        """Return the message to publish for a result."""
        if given.boxes is None:
            return Outgoing(given.message, refined.is_final)
        assert self.adapter is not None  # it has read the message
        return outgoing(refined, given, self.adapter, self.following.sources)


def _given(boxes: BoxArray) -> Given:
    """Return the ticket of boxes."""
    assert isinstance(boxes.ticket, Given)
    return boxes.ticket
