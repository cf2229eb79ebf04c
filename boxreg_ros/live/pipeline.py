"""The way of a message through the node, without its topics and threads."""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.core.input_statistics import Drives
from boxreg_ros.core.matching import Pair
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.errors import TransformUnavailable
from boxreg_ros.io.items import Item
from boxreg_ros.io.lidars import MergedSweep
from boxreg_ros.io.session import Admitted, is_placeholder, Session
from boxreg_ros.io.time_jumps import Held, JumpConfirmation
from boxreg_ros.io.transforms import boxes_to_frame, inverse
from boxreg_ros.live.budget import TickBudget
from boxreg_ros.live.bursts import Bursts
from boxreg_ros.live.following import Following
from boxreg_ros.live.outgoing import Outgoing, OutgoingQueue
from boxreg_ros.live.silence import Silence
from boxreg_ros.live.static_points import StaticPoints
from boxreg_ros.live.tickets import OutputFrame, passing, ticket_of, Tickets
from boxreg_ros.live.transform_wait import TransformWait
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import BoxArray, RefinedBoxes, Sweep
from msg_adapters import Adapter
import numpy as np

CONFIRMATION_TIME = 0.5
"""A message waits this long for the one that confirms a time jump [s]: five sweeps at 10 Hz."""
AHEAD_TIME = 3.0
"""The same of one that is ahead of all others [s]; chosen: boxes of the slowest detectors, 1 Hz,
have come three times."""
PASSED = 'passed'
"""Reason of messages that pass through; they have no boxes that it could be counted for."""


class MessagePipeline:
    """
    Take messages as they arrive, and return the messages to publish.

        message --> confirm --> session --+-- cloud --> merged --+--> registrar --> messages
                                          +-- boxes --> ticket --+

    Messages of boxes of one stamp are joined before `confirm` takes them.

    The registrar has the order of the boxes; what is published for them is in their ticket. Not
    thread-safe.

    Parameters
    ----------
    config : Config
        Settings of the core.
    session : Session
        Brings messages into the fixed frame.
    wait : TransformWait
        Says how long a message waits for its transforms, and in which frame boxes are published.
    report : callable
        Called with reason, text and count for everything that is not refined here.
    budget : TickBudget, optional
        Limits the windows that are solved; default: all are.
    static_patience : float, optional
        How long clouds wait for their boxes [s]; default: no clouds without moving objects.
    drives : Drives, optional
        What other drives have shown of the detector.

    Attributes
    ----------
    adapter : Adapter or None
        Of the boxes; to be set before the first ones.
    registrar, following, static_points, silence
        The parts that the worker asks.

    """

    def __init__(
        self,
        config: Config,
        session: Session,
        wait: TransformWait,
        report: Callable[[Reason, str, int], None],
        budget: TickBudget | None = None,
        static_patience: float | None = None,
        drives: Drives | None = None,
    ) -> None:
        self.adapter: Adapter | None = None
        self.session = session
        self.wait = wait
        self._report = report
        submit, windows = (None, None) if budget is None else (budget.submit, budget.windows)
        self.registrar = BoxRegistrar(config, submit, windows, drives, prepare=self._note_latency)
        self.following = Following(self.registrar, session, wait, report)
        self.static_points: StaticPoints | None = None
        if static_patience is not None:
            self.static_points = StaticPoints(static_patience, self.registrar)
        self.silence = Silence(self.registrar)
        self._jumps = JumpConfirmation[Item]()
        self._bursts = Bursts()
        self._tickets = Tickets()
        self._queue = OutgoingQueue(self.following, self.static_points)

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

    @property
    def is_holding(self) -> bool:
        """Return whether messages wait for a cloud, further observations or confirmation."""
        return self.registrar.num_held > 0 or bool(self._jumps.held) or self.is_joining

    @property
    def is_joining(self) -> bool:
        """Return whether a message of boxes waits for others of its stamp."""
        return self._bursts.held is not None

    # ------------------------------------------------------------ one message

    def confirm(self, item: Item) -> tuple[list[Item], list[Outgoing]]:
        """
        Return the messages to process next, in the order of stamps: none while this one is held.

        Also return all that was held where time went back: tracks and transforms start anew.

        """
        if is_placeholder(item.content):
            return [item], []
        if isinstance(item.content, Sweep):
            return self._confirmed(item)
        return self._all_confirmed(self._bursts.add(item))

    def _all_confirmed(self, whole: list[Item]) -> tuple[list[Item], list[Outgoing]]:
        """Return the messages to process next, and what to publish before, of several ones."""
        items: list[Item] = []
        ready: list[Outgoing] = []
        for item in whole:
            confirmed, released = self._confirmed(item)
            items += confirmed
            ready += released
        return items, ready

    def _confirmed(self, item: Item) -> tuple[list[Item], list[Outgoing]]:
        """Return as `confirm`, for a cloud or for all boxes of a stamp."""
        confirmed = self._jumps.add(item, item.content, item.received_ns)
        ready = self._not_used(confirmed.ahead)
        if not confirmed.has_jumped:
            return confirmed.items, ready
        stamp_ns = confirmed.items[0].content.stamp_ns
        self._report(
            Reason.TIME_JUMP,
            f'expected stamps of one clock, got some that went back to {stamp_ns} ns; tracks '
            f'start anew: unless a recording is played in a loop, let one clock set all stamps',
            1,
        )
        ready += self._start_anew()
        self.session.tree.rewind(stamp_ns)
        return confirmed.items, ready

    def release(
        self, now: float = inf, more_boxes: bool = False
    ) -> tuple[list[Item], list[Outgoing]]:
        """
        Return what no other message has confirmed in time: late ones, and those not used.

        While there are `more_boxes`, those that wait for others of their stamp wait on.

        """
        whole = [] if more_boxes else self._bursts.release(now)
        late, ready = self._all_confirmed(whole)
        ahead: list[Item] = []
        for held in self._jumps.held:
            if now >= held.item.received + _patience(held):
                (ahead if held.is_ahead else late).extend(self._jumps.release(held))
        return late, ready + self._not_used(ahead)

    def process(self, item: Item) -> list[Outgoing]:
        """Take a message to the registrar; return the messages that are ready to be published."""
        if is_placeholder(item.content):
            return self.pass_through(item.message)
        self.following.start(item.received)
        admitted = self.session.admit(item.content, item.received_ns)
        if admitted.reason:
            self._report_missing_transform(item, admitted.reason, admitted.detail)
        if isinstance(item.content, Sweep):
            return self._process_cloud(item, item.content, admitted)
        return self._process_boxes(item, item.content, admitted)

    def pass_through(self, message: Any) -> list[Outgoing]:
        """Return an input message as early boxes and, once those before it are, as final."""
        return [Outgoing(message, False), *self.pass_through_as_final(message)]

    def pass_through_as_final(self, message: Any) -> list[Outgoing]:
        """Return an input message as final boxes once those before it are."""
        return self._messages(self.registrar.add_kept(passing(message), PASSED))

    # ------------------------------------------------------------ messages that do not arrive

    def lose(self, stamp_ns: int, lidar: str = '') -> list[Outgoing]:
        """Release the boxes that wait for a cloud that was dropped, of one of several LiDARs."""
        nothing = np.zeros((0, 3))
        sweep = Sweep(stamp_ns, self.session.fixed_frame, nothing, is_dropped=True, topic=lidar)
        if lidar:
            return self._add_sweeps(self.session.merged(sweep))
        return self._messages(self.registrar.add_sweep(sweep))

    def lose_overdue(self, now: float, cloud_received: float) -> list[Outgoing]:
        """Release boxes that wait for clouds if no clouds have arrived for long."""
        overdue_ns = self.silence.overdue_ns(now, cloud_received)
        if overdue_ns is None:
            return []
        return self._add_sweeps(self.session.unmerged()) + self.lose(overdue_ns)

    # ------------------------------------------------------------ all that is held

    def flush(self) -> list[Outgoing]:
        """Return everything that is held; tracks continue if further boxes arrive."""
        ready = self._add_sweeps(self.session.unmerged())
        return ready + self._messages(self.registrar.flush())

    def catch_up(self, limit: int) -> list[Outgoing]:
        """Solve up to `limit` tracks that wait, for their final boxes."""
        return self._messages(self.registrar.catch_up(limit))

    def reset(self) -> list[Outgoing]:
        """Forget everything but the transforms; return everything that is held."""
        ready = self._start_anew()
        for item in (*self._jumps.release(), *self._bursts.release()):
            if not isinstance(item.content, Sweep):
                ready += self.pass_through(item.message)
        self._jumps.restart()
        return ready

    def abandon(self, item: Item | None) -> list[Outgoing]:
        """
        Start again after an internal error while a message was being processed.

        Return the messages made before the error, and all that are held, passed through.

        """
        ready, returned = self._queue.abandoned(self.registrar.abandon(Reason.FAILED))
        self._restart()
        if item is None or not isinstance(item.content, BoxArray):
            return ready
        if not any(message is item.message for message in returned):
            ready += self.pass_through(item.message)
        return ready

    # ------------------------------------------------------------ steps

    def _start_anew(self) -> list[Outgoing]:
        """Forget tracks and estimated errors; return everything that the registrar holds."""
        ready = self.flush()
        self.registrar.reset()
        self._restart()
        return ready

    def _not_used(self, ahead: list[Item]) -> list[Outgoing]:
        """Report messages that are ahead of all others; return boxes, which pass through."""
        ready: list[Outgoing] = []
        for item in ahead:
            is_cloud = isinstance(item.content, Sweep)
            self._report(
                Reason.STAMP_AHEAD,
                f'{"points" if is_cloud else "boxes"}: the stamp {item.content.stamp_ns} ns is in '
                f'the future of those before and after it; {Reason.STAMP_AHEAD.remedy}',
                1,
            )
            if not is_cloud:
                ready += self.pass_through(item.message)
        return ready

    def _process_cloud(self, item: Item, cloud: Sweep, admitted: Admitted) -> list[Outgoing]:
        """Add a cloud to the registrar, with those of the other LiDARs."""
        if admitted.moved is None:
            self.wait.give_up(cloud)
            return []
        assert isinstance(admitted.moved, Sweep)
        return self._add_sweeps(self.session.merged(admitted.moved, item))

    def _process_boxes(self, item: Item, given: BoxArray, admitted: Admitted) -> list[Outgoing]:
        """Add boxes to the registrar, with their ticket; pass them through without transforms."""
        for found in self.session.findings:
            self._report(found.reason, found.text, 1)
        placed = self._in_output_frame(item, given, admitted)
        if placed is None:
            return self.pass_through(item.message)
        shown, frame = placed
        assert isinstance(admitted.moved, BoxArray)
        self.silence.boxes_received = item.received
        boxes = self._tickets.issue(item, shown, admitted.moved, frame, self.config)
        return self._messages(self.registrar.add_boxes(boxes))

    def _in_output_frame(
        self, item: Item, given: BoxArray, admitted: Admitted
    ) -> tuple[BoxArray, OutputFrame] | None:
        """Return boxes in the output frame, and that frame; None if it is not reached."""
        T_fixed_item = admitted.T_fixed_item
        if T_fixed_item is None:
            return None
        if not self.wait.changes_frame(given):
            return given, OutputFrame(inverse(T_fixed_item), None)
        output_frame = self.wait.output_frame
        try:
            T_output_fixed = self.session.tree.lookup(
                output_frame, self.session.fixed_frame, given.stamp_ns
            )
        except TransformUnavailable as error:
            self._report_missing_transform(item, Reason.NO_TRANSFORM, str(error))
            return None
        T_output_item = T_output_fixed @ T_fixed_item
        shown = boxes_to_frame(given, T_output_item, output_frame)
        return shown, OutputFrame(T_output_fixed, T_output_item)

    def _add_sweeps(self, complete: list[MergedSweep]) -> list[Outgoing]:
        """Add sweeps to the registrar; return the messages that are ready to be published."""
        ready: list[Outgoing] = []
        for sweep, parts in complete:
            if self.static_points is not None:
                clouds = [part for part in parts if part is not None]
                self.static_points.add_cloud(sweep, clouds)
            ready += self._messages(self.registrar.add_sweep(sweep))
        return ready

    def _messages(self, results: list[RefinedBoxes]) -> list[Outgoing]:
        """Return the messages to publish for results of the registrar."""
        return self._queue.messages(results, self.adapter)

    def _restart(self) -> None:
        """Forget all but the transforms."""
        if self.static_points is not None:
            self.static_points.reset()
        self.session.restart()
        self._tickets.restart()
        self.following.restart()

    def _report_missing_transform(self, item: Item, reason: Reason, detail: str) -> None:
        """Report a sweep, or the boxes of an array, that no transform is known for."""
        content = item.content
        count = 1 if isinstance(content, Sweep) else len(content.track_ids)
        if count:
            self._report(reason, detail, count)

    def _note_latency(self, pair: Pair) -> BoxArray:
        """Report boxes that were late, and return them."""
        latency = self.registrar.latency
        ticket_of(pair.boxes).is_late = latency.seconds != 0
        if latency.warning:
            self._report(Reason.LATENCY, latency.warning, 1)
        return pair.boxes


def _patience(held: Held[Item]) -> float:
    """Return how long a message waits for the next of its stream [s]."""
    return AHEAD_TIME if held.is_ahead else CONFIRMATION_TIME
