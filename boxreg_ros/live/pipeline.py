"""The way of a message through the node, without its topics and threads."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from math import inf
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.core.input_statistics import Drives
from boxreg_ros.core.matching import Pair
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.io.items import Item
from boxreg_ros.io.lidars import MergedSweep
from boxreg_ros.io.session import is_placeholder, Session
from boxreg_ros.io.time_jumps import Confirmed
from boxreg_ros.live.budget import TickBudget
from boxreg_ros.live.following import Following
from boxreg_ros.live.incoming import Incoming
from boxreg_ros.live.outgoing import Outgoing, OutgoingQueue
from boxreg_ros.live.static_points import StaticPoints
from boxreg_ros.live.tickets import passing, Ticket, ticket_of, Tickets
from boxreg_ros.live.transform_wait import TransformWait
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import BoxArray, RefinedBoxes, Sweep
from msg_adapters import Adapter
import numpy as np

BOXES_SILENCE = 3.0
"""After this time without boxes, final boxes are published without further observations [s]."""
CLOUD_SILENCE = 0.5
"""After this time without clouds, boxes that have waited as long are published unrefined [s]. Five
periods of a LiDAR of 10 Hz."""
PASSED = 'passed'
"""Reason of messages that pass through; they have no boxes that it could be counted for."""


class MessagePipeline:
    """
    Take messages as they arrive, and return the messages to publish.

        message --> incoming --> session --+-- cloud --> merged --+--> registrar --> messages
                                           +-- boxes --> ticket --+

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
    incoming, registrar, following, static_points
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
        self.registrar = BoxRegistrar(config, submit, windows, drives, prepare=self._note_faults)
        # That of the newest boxes, for reports of another thread: the registrar estimates it anew
        # when it is read.
        self._latency = self.registrar.latency
        self.following = Following(self.registrar, session, wait, report)
        self.static_points: StaticPoints | None = None
        if static_patience is not None:
            self.static_points = StaticPoints(static_patience, self.registrar)
        self._boxes_received = 0.0  # when boxes arrived last [s]
        self.incoming = Incoming()
        self._tickets = Tickets(session, wait)
        self._queue = OutgoingQueue(self.following, self.static_points)

    @property
    def facts(self) -> dict[str, object]:
        """Return origin of the ids, latency of the boxes and followed objects, for reports."""
        facts = {**self.session.facts, 'box latency': self._latency.text}
        return facts | self.following.facts

    @property
    def is_holding(self) -> bool:
        """Return whether messages wait for a cloud, further observations or confirmation."""
        return self.registrar.num_held > 0 or self.incoming.is_holding

    def publish_early_by(self, publish: Callable[[list[Outgoing]], None]) -> None:
        """
        Set a function that is called with early boxes as soon as they are known.

        Without it they are returned, with the final boxes that are made after them.

        """
        self.registrar.publish = lambda refined: publish(self._messages([refined]))

    # ------------------------------------------------------------ one message

    def confirm(self, item: Item) -> tuple[list[Item], list[Outgoing]]:
        """
        Return the messages to process next, in the order of stamps: none while this one is held.

        Also return all that was held where time went back: tracks and transforms start anew.

        """
        return self._confirmed(self.incoming.add(item))

    def release(
        self, now: float = inf, more_boxes: bool = False, more: bool = False
    ) -> tuple[list[Item], list[Outgoing]]:
        """Return what no other message has confirmed in time, see `Incoming`."""
        return self._confirmed(self.incoming.release(now, more_boxes, more))

    def process(self, item: Item) -> list[Outgoing]:
        """Take a message to the registrar; return the messages that are ready to be published."""
        if is_placeholder(item.content):
            return self.pass_through(item.message)
        self.following.start(item.received)
        ready = self._leave_frame() if self.session.fixed_frame_jumps else []
        replaced_ids = self.session.replaces_ids
        item = self.session.admit(item, Ticket(item.message, received=item.received))
        if isinstance(item.content, Sweep):
            return ready + self._process_cloud(item)
        ready += self._process_boxes(item)
        if self.session.replaces_ids and not replaced_ids:
            ready += self._forget_tracks()
        return ready

    def pass_through(
        self, message: Any, stamp_ns: int = 0, is_early_out: bool = False
    ) -> list[Outgoing]:
        """
        Return an input message as early boxes and, once those before it are, as final.

        Parameters
        ----------
        message : message
            Of the boxes; published as it is.
        stamp_ns : int
            Its stamp [ns]; 0 if unknown: it then stands behind the newest boxes.
        is_early_out : bool
            Whether it has been published as early boxes.

        Returns
        -------
        list of Outgoing
            Ready to be published, those of boxes before it too.

        """
        early = [] if is_early_out else [Outgoing(message, False)]
        return early + self._messages(self.registrar.add_kept(passing(message, stamp_ns), PASSED))

    # ------------------------------------------------------------ messages that do not arrive

    def lose(self, stamp_ns: int, lidar: str = '') -> list[Outgoing]:
        """
        Release the boxes that wait for a cloud that was dropped.

        Parameters
        ----------
        stamp_ns : int
            Its stamp [ns].
        lidar : str
            Its topic, where the clouds of several LiDARs are merged.

        Returns
        -------
        list of Outgoing
            Ready to be published.

        """
        nothing = np.zeros((0, 3))
        sweep = Sweep(stamp_ns, self.session.fixed_frame, nothing, is_dropped=True, topic=lidar)
        if lidar:
            return self._add_sweeps(self.session.merged(sweep))
        return self._messages(self.registrar.add_sweep(sweep))

    def lose_overdue(self, now: float, cloud_received: float) -> list[Outgoing]:
        """Release boxes that wait for clouds if none has come for long since `cloud_received`."""
        if now < cloud_received + CLOUD_SILENCE:
            return []
        overdue = [
            boxes.stamp_ns
            for boxes in self.registrar.unpaired
            if now >= ticket_of(boxes).received + CLOUD_SILENCE
        ]
        if not overdue:
            return []
        unmerged = self._add_sweeps(self.session.unmerged())
        return unmerged + self._messages(self.registrar.release(max(overdue)))

    def has_no_boxes(self, now: float) -> bool:
        """Return whether no boxes have arrived for long."""
        return now >= self._boxes_received + max(BOXES_SILENCE, self.registrar.config.max_gap)

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
        for item in self.incoming.reset():
            if not isinstance(item.content, Sweep):
                ready += self.pass_through(item.message)
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

    def _leave_frame(self) -> list[Outgoing]:
        """Go on in a fixed frame that does not jump; return everything that is held."""
        followed = self.registrar.followed.track_ids
        ready = self._start_anew()
        self.session.change_fixed_frame()
        why = f'the fixed frame is another one: {self.session.fixed_frame!r}; follow it again'
        self.registrar.followed.refused += [(name, why) for name in followed]
        return ready

    def _forget_tracks(self) -> list[Outgoing]:
        """Forget the tracks of ids that identify no objects; return all that is held, kept."""
        followed = self.registrar.followed  # a person's boxes, by their own ids
        ready = self._messages(self.registrar.abandon(Reason.TRACK_IDS_JUMP))
        self.registrar.followed = followed
        return ready

    def _confirmed(
        self, confirmed: Iterable[Confirmed[Item]]
    ) -> tuple[list[Item], list[Outgoing]]:
        """Return the messages to process next, and what to publish before."""
        items: list[Item] = []
        ready: list[Outgoing] = []
        for one in confirmed:
            for ahead in one.ahead:
                ready += self._not_used(ahead)
            if one.has_jumped:
                ready += self._gone_back(one.items[0].content.stamp_ns)
            items += one.items
        return items, ready

    def _gone_back(self, stamp_ns: int) -> list[Outgoing]:
        """Start anew where time went back; return everything that was held."""
        self._report(
            Reason.TIME_JUMP,
            f'expected stamps of one clock, got some that went back to {stamp_ns} ns; tracks '
            f'start anew: unless a recording is played in a loop, let one clock set all stamps',
            1,
        )
        ready = self._start_anew()
        self.session.tree.rewind(stamp_ns)
        return ready

    def _not_used(self, item: Item) -> list[Outgoing]:
        """Report a message that is ahead of all others; return boxes, which pass through."""
        is_cloud = isinstance(item.content, Sweep)
        self._report(
            Reason.STAMP_AHEAD,
            f'{"points" if is_cloud else "boxes"}: the stamp {item.content.stamp_ns} ns is in '
            f'the future of those before and after it; {Reason.STAMP_AHEAD.remedy}',
            1,
        )
        return [] if is_cloud else self.pass_through(item.message)

    def _process_cloud(self, item: Item) -> list[Outgoing]:
        """Add a cloud to the registrar, with those of the other LiDARs."""
        assert isinstance(item.content, Sweep)
        if item.reason:
            self._report(item.reason, item.detail, 1)
        if item.moved is None:
            self.wait.give_up(item.content)
            return []
        assert isinstance(item.moved, Sweep)
        return self._add_sweeps(self.session.merged(item.moved, item))

    def _process_boxes(self, item: Item) -> list[Outgoing]:
        """Add boxes to the registrar; pass them through without transforms."""
        for found in self.session.findings:
            self._report(found.reason, found.text, 1)
        if isinstance(item.moved, BoxArray):
            item = self._tickets.completed(item, self.registrar.config)
        if not isinstance(item.moved, BoxArray):
            assert isinstance(item.content, BoxArray) and item.reason is not None
            if item.content.track_ids:
                self._report(item.reason, item.detail, len(item.content.track_ids))
            return self.pass_through(item.message, item.content.stamp_ns)
        self._boxes_received = item.received
        return self._messages(self.registrar.add_boxes(item.moved))

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

    def _note_faults(self, pair: Pair) -> BoxArray:
        """Report boxes that were late, or are lengthened, and return them."""
        latency = self._latency = self.registrar.latency
        ticket_of(pair.boxes).is_late = latency.seconds != 0
        if latency.warning:
            reason = Reason.CLOCK_OFFSET if latency.lidars else Reason.LATENCY
            self._report(reason, latency.warning, 1)
        if self.registrar.visible_boxes.warning:
            self._report(Reason.VISIBLE_BOXES, self.registrar.visible_boxes.warning, 1)
        return pair.boxes
