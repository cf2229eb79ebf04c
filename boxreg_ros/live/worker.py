"""Worker of the node: takes messages from the inbox, registers boxes and publishes them."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
import gc
from threading import Event
import time
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.io.items import Item
from boxreg_ros.io.label_messages import LabelMessage, to_text
from boxreg_ros.io.markers import MarkerBoard
from boxreg_ros.io.session import is_placeholder, refined_to_frame
from boxreg_ros.live.budget import TickBudget
from boxreg_ros.live.bursts import JOIN_TIME, JoiningAdapter, messages_of
from boxreg_ros.live.debug_times import DebugTimes
from boxreg_ros.live.diagnostics import Health, LATENCY, STATIC_CPU, STATIC_LATENCY, TICK
from boxreg_ros.live.inbox import CloudPatience, Inbox, Message
from boxreg_ros.live.model_file import ModelFile
from boxreg_ros.live.outgoing import labels_passed_through, Outgoing
from boxreg_ros.live.params import NodeOptions
from boxreg_ros.live.pipeline import MessagePipeline
from boxreg_ros.reasons import Reason, REASONS
from boxreg_ros.structures import BoxArray, Sweep
from msg_adapters import Adapter
from msg_adapters.clouds import header_of
from msg_adapters.poses import stamp_ns
from rclpy.duration import Duration
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.publisher import Publisher
from std_msgs.msg import String

TRANSFORM_PERIOD = 0.005
"""Longest pause between two looks whether the transforms of a message have arrived [s]: the
period of TF at 200 Hz."""
HELD_PERIOD = 0.1
"""Longest pause while boxes are held [s]."""
IDLE_PERIOD = 0.5
"""Longest pause while nothing is held [s]: the queues of transforms have room for a second."""
BOXES_PATIENCE = 10.0
"""Boxes wait for the solver this many times longer than clouds before they pass through."""
FULL_COLLECTION_PERIOD = 60.0
"""Time between two collections of all garbage [s]; chosen. One takes 40 ms with 1,024 tracks,
after the boxes of one tick in 600 at 10 Hz. Few cycles survive the collection of new objects after
each tick, which takes 1 ms."""
ACKNOWLEDGEMENT_TIME = 0.4
"""Wait at shutdown for subscribers to acknowledge the last messages, over all publishers [s]."""


@dataclass(eq=False, repr=False)
class Worker:
    """
    Registers boxes in a thread of its own, from `run` until `stop`.

    The worker alone uses the registrar, its transforms and the markers. It shares the inbox and
    the counters with the executor's thread, which also calls `note_cloud`: `cloud_frame` is that
    of the newest cloud, `cloud_received` when it arrived (monotonic) [s]. A cloud may wait for the
    solver for the backlog [s]; polling adds the transforms and odometry that have arrived to those
    of the pipeline. `fixed_frame` is empty until it is chosen, `tracks` counts those of the newest
    boxes, `newest_transform_ns` is the stamp of the newest transform or odometry.

    """

    _live: MessagePipeline
    _inbox: Inbox
    _health: Health
    _logger: RcutilsLogger
    _budget: TickBudget
    _backlog: float
    _markers: Publisher
    _model: ModelFile
    _poll: Callable[[], None]

    def __post_init__(self) -> None:
        """Begin with no message."""
        self.cloud_frame = ''
        self.cloud_received = 0.0
        self.fixed_frame = ''
        self.tracks = 0
        self.newest_transform_ns: int | None = None
        self._patience = CloudPatience(self._backlog)
        self._complete_at = 0.0  # when a message got its transforms, and how long it had waited
        self._waited = 0.0
        self._fully_collected_at = time.monotonic()
        self._board = MarkerBoard()
        self._early_out: list[Outgoing] = []  # published, without their labels and markers
        self._live.publish_early_by(self._publish_early)
        self.static: Publisher | None = None  # of clouds without moving objects
        self._boxes: dict[bool, Publisher] = {}  # by whether they are final
        self._labels: dict[bool, Publisher] = {}  # of all that label files hold of the same boxes
        self.times: DebugTimes | None = None
        self._stopping = Event()
        self._confirmed: deque[Item] = deque()
        self._logged_layouts: set[str] = set()
        self._stamps_ahead: Counter[str] = Counter()

    def open_boxes(
        self, adapter: Adapter, boxes: dict[bool, Publisher], labels: dict[bool, Publisher]
    ) -> None:
        """
        Set how boxes are read and published; to be called before they are subscribed to.

        Parameters
        ----------
        adapter : Adapter
            Reads and writes their messages.
        boxes, labels : dict
            Publishers of early (False) and final (True) boxes, and of all that label files hold
            of them.

        """
        self._live.adapter = JoiningAdapter(adapter)
        self._boxes, self._labels = boxes, labels

    def facts(self) -> dict[str, object]:
        """Return the facts about the boxes for /diagnostics, beside the counters."""
        return {**self._live.facts, 'deadline [ms]': f'{1e3 * self._budget.seconds:.0f}'}

    def stop(self) -> None:
        """Make `run` return after the message at hand."""
        self._stopping.set()
        self._inbox.wake_up.set()

    def run(self) -> None:
        """Process messages until `stop`, each as soon as its transforms are available."""
        item: Item | None = None
        while True:
            self._inbox.wake_up.clear()  # before `_stopping` is read: `stop` sets both
            if self._stopping.is_set():
                break
            self._take_events()
            self._release_boxes_without_cloud(item)
            self._publish_static()
            if item is None:
                item = self._next()
            self._live.session.sensor_frame = self.cloud_frame  # may arrive while boxes wait
            if item is None:
                self._pause()
            elif self._live.wait.is_over(item, time.monotonic()):
                self._process(item)
                item = None
            else:
                self._inbox.wake_up.wait(TRANSFORM_PERIOD)
                self._complete_at = time.monotonic()
                self._waited = self._complete_at - item.received
        self._finish(item)

    def pass_until(self, is_warm: Event) -> None:
        """Pass boxes through until an event is set: the solver is compiled meanwhile."""
        passed = 0
        while not (is_warm.is_set() or self._stopping.is_set()):
            self._inbox.wake_up.clear()
            self._take_events()
            message = self._inbox.take()
            if message is None:
                self._inbox.wake_up.wait(HELD_PERIOD)
            elif message.topic == 'boxes':
                passed += 1
                self._health.report(Reason.COMPILING, Reason.COMPILING.remedy)
                self._publish(self._live.pass_through(message.content))
        if passed:
            self._logger.info(f'{passed} messages of boxes passed unchanged; the next are refined')

    def note_cloud(self, message: Any, lidar: str) -> None:
        """Note the frame of a cloud, and that it has arrived; in the executor's thread."""
        self.cloud_frame = self._live.session.placement.frame_of(message, lidar)
        self.cloud_received = time.monotonic()

    def drop(self, message: Message) -> None:
        """Count a message that there is no time for, and pass boxes through; in any thread."""
        reason = REASONS[f'{message.topic}_queue_full']
        self._health.report(reason, reason.remedy)
        if message.topic == 'boxes':
            passed = [Outgoing(message.content, False)]
            self._publish_boxes(passed)
            self._inbox.put_event(self._show, passed)  # labels take the transforms of the worker
            self._inbox.put_passing(message)  # the final copy, in the order of all
        else:
            lost_ns = stamp_ns(header_of(message.content))
            self._inbox.put_event(self._lose, lost_ns, message.lidar)

    def add_info(self, message: Any) -> None:
        """Add the info on a concatenated cloud; for events."""
        try:
            self._live.session.placement.add_info(message)
        except UnsupportedMessage as error:
            self._health.report(Reason.UNREADABLE, f'points_info: {error}')

    def follow(self, message: Any) -> None:
        """Follow the objects of boxes; for events."""
        assert self._live.adapter is not None  # set before boxes are subscribed to
        try:
            boxes = self._live.adapter.from_msg(message)
        except UnsupportedMessage as error:
            self._health.report(Reason.NOT_FOLLOWED, str(error))
        except Exception as error:
            self._health.report_failure(error)
        else:
            self._live.following.add(Item(time.monotonic_ns(), boxes, message=message))

    def reset(self) -> None:
        """Forget everything but the transforms; for events."""
        self._publish(self._guarded(self._live.reset))

    def change(self, config: Config, options: NodeOptions) -> None:
        """Use other settings from now on; for events."""
        self._live.registrar.config = self._live.session.config = config
        self._live.wait.output_frame = options.output_frame.lstrip('/')
        self._live.wait.timeout = options.transform_timeout
        self._budget.deadline = options.deadline
        self._patience.backlog = options.backlog

    def _next(self) -> Item | None:
        """Return the next message decoded, or None if there is none to process now."""
        waiting = self._inbox.sizes()
        more_boxes = waiting['boxes_waiting'] > 0
        late, ready = self._live.release(time.monotonic(), more_boxes, any(waiting.values()))
        self._confirmed.extend(late)
        self._publish(ready)
        if not self._confirmed:
            self._take_message()
        return self._confirmed.popleft() if self._confirmed else None

    def _take_message(self) -> None:
        """Take the next message from the inbox and decode it, unless it passes through."""
        message = self._inbox.take()
        if message is None:
            return
        if message.topic == 'passing':
            self._pass_on(message)
        elif self._is_overdue(message):
            self.drop(message)
        else:
            item = self._decoded(message)
            if item is not None:
                self._publish(self._guarded(partial(self._confirm, item)))

    def _pass_on(self, message: Message) -> None:
        """Pass a message of boxes through; a cloud is left out."""
        if message.topic != 'points':
            is_early_out = message.topic == 'passing'
            self._publish(self._live.pass_through(message.content, is_early_out=is_early_out))

    def _confirm(self, item: Item) -> list[Outgoing]:
        """Queue a message for processing; return the messages that a time jump releases."""
        confirmed, ready = self._live.confirm(item)
        self._confirmed.extend(confirmed)
        return ready

    def _is_overdue(self, message: Message) -> bool:
        """Return whether a message has waited too long for the solver."""
        # What arrived while a transform was waited for may take as long again to be solved.
        since = max(message.received_ns / 1e9, self._complete_at + self._waited)
        now = time.monotonic()
        if message.topic == 'boxes':
            return now - since > BOXES_PATIENCE * self._patience.backlog
        has_newer = self._inbox.has_newer(message)
        return self._patience.is_overdue(message, since, now, self._budget.seconds, has_newer)

    def _decoded(self, message: Message) -> Item | None:
        """Return a message decoded; boxes that cannot be decoded pass through."""
        content: Sweep | BoxArray
        try:
            if message.topic == 'points':
                content = self._live.session.placement.sweep_of(message.content, message.lidar)
                self._log_layouts()
            else:
                assert self._live.adapter is not None  # set before boxes are subscribed to
                content = self._live.adapter.from_msg(message.content)
        except UnsupportedMessage as error:
            self._health.report(Reason.UNREADABLE, f'{message.topic}: {error}')
        except Exception as error:
            self._health.report_failure(error)
        else:
            return Item(message.received_ns, content, message=message.content)
        self._pass_on(message)
        return None

    def _log_layouts(self) -> None:
        """Log the layout of the first cloud of each LiDAR."""
        for lidar, layout in self._live.session.placement.layouts.items():
            if lidar not in self._logged_layouts:
                self._logged_layouts.add(lidar)
                self._logger.info(f'clouds {lidar or "points"}: {layout}')

    def _pause(self) -> None:
        """Wait for messages, and release held boxes if none arrive for long."""
        if self._confirmed or any(self._inbox.sizes().values()):
            return
        now = time.monotonic()
        if self._live.registrar.num_held and self._live.has_no_boxes(now):
            self._catch_up(self._live.registrar.num_waiting)
            self._publish(self._guarded(self._live.flush))
        if self._board.is_showing and self._live.has_no_boxes(now):
            self._markers.publish(self._board.clear())
        self._waited = 0.0
        spare = self._budget.spare_windows()
        if spare > 0 and self._live.registrar.num_waiting:
            self._catch_up(spare)
            return
        period = HELD_PERIOD if self._live.is_holding else IDLE_PERIOD
        if self._live.incoming.is_joining:
            period = JOIN_TIME
        if self._live.static_points is not None:
            period = min(period, self._live.static_points.due(now))
        self._inbox.wake_up.wait(period)

    def _release_boxes_without_cloud(self, item: Item | None) -> None:
        """Release boxes that have waited too long for a cloud, unless one is at hand."""
        is_cloud = item is not None and isinstance(item.content, Sweep)
        if is_cloud or self._inbox.sizes()['points_waiting']:
            return
        release = partial(self._live.lose_overdue, time.monotonic(), self.cloud_received)
        self._publish(self._guarded(release))

    def _take_events(self) -> None:
        """Add transforms, and handle all events of the inbox in the order of their arrival."""
        self._poll()
        for handle in self._inbox.take_events():
            handle()
        tree = self._live.session.tree
        self.newest_transform_ns = tree.newest_ns()
        for pair, number in (tree.stamps_ahead - self._stamps_ahead).items():
            text = f'transform {pair}: {Reason.STAMP_AHEAD.meaning}; {Reason.STAMP_AHEAD.remedy}'
            self._health.report(Reason.STAMP_AHEAD, text, number)
        self._stamps_ahead = tree.stamps_ahead

    def _lose(self, lost_ns: int, lidar: str) -> None:
        """Release the boxes that wait for a cloud that was dropped."""
        self._publish(self._guarded(partial(self._live.lose, lost_ns, lidar)))

    def _publish_labels(self, out: Outgoing) -> None:
        """Publish status and all else that label files hold, while somebody subscribes."""
        publisher = self._labels[out.is_final]
        if not publisher.get_subscription_count():
            return
        refined = out.in_fixed
        if refined is None:
            assert self._live.adapter is not None  # it has read the message
            refined = labels_passed_through(out.message, self._live.adapter, self._live.session)
        if refined is not None:
            session = self._live.session
            frame = session.left_frame or session.fixed_frame  # the same for all labels
            if session.left_frame:
                boxes = refined.boxes
                T_frame_boxes = session.tree.find(frame, boxes.frame_id, boxes.stamp_ns)
                if T_frame_boxes is not None:
                    refined = refined_to_frame(refined, T_frame_boxes, frame)
            content = LabelMessage(refined, frame, self._live.registrar.config.digest)
            publisher.publish(String(data=to_text(content)))

    def _process(self, item: Item) -> None:
        if isinstance(item.content, BoxArray):
            self._budget.add_arrival(item.received)
        self._budget.begin(max(item.received, self._complete_at))
        ready = self._guarded(partial(self._live.process, item), item)
        if self.fixed_frame != self._live.session.fixed_frame:
            self.fixed_frame = self._live.session.fixed_frame
            self._logger.info(f'fixed frame is {self.fixed_frame!r}')
        self._publish(ready)
        if is_placeholder(item.content) and self._board.is_showing:
            self._markers.publish(self._board.clear())
        if isinstance(item.content, BoxArray):
            self._collect_garbage()

    def _catch_up(self, limit: int) -> None:
        """Solve up to `limit` tracks that wait."""
        self._publish(self._guarded(partial(self._live.catch_up, limit)))

    def _collect_garbage(self) -> None:
        """Free objects in cycles after a tick, so that no collection interrupts the next one."""
        now = time.monotonic()
        is_full = now >= self._fully_collected_at + FULL_COLLECTION_PERIOD
        if is_full:
            self._fully_collected_at = now
        gc.collect(2 if is_full else 1)

    def _guarded(
        self, task: Callable[[], list[Outgoing]], item: Item | None = None
    ) -> list[Outgoing]:
        """Return the messages of a task; after an error, all that are held, unrefined."""
        try:
            return task()
        except Exception as error:
            self._health.report_failure(error)
            return self._live.abandon(item)
        finally:
            self._health.set_core_counts(self._live.registrar.counts)

    def _publish(self, ready: list[Outgoing]) -> None:
        """Publish boxes, then labels and markers, also of the early boxes before."""
        self._publish_boxes(ready)
        early = self._early_out
        self._early_out = []
        self._show([*early, *ready])

    def _publish_early(self, ready: list[Outgoing]) -> None:
        """Publish early boxes; labels and markers follow with the final boxes."""
        self._publish_boxes(ready)
        self._early_out += ready

    def _show(self, ready: list[Outgoing]) -> None:
        """Publish labels and markers of boxes that are published."""
        for out in ready:
            self._publish_labels(out)
        if not self._markers.get_subscription_count():
            return
        for out in ready:  # after all boxes: making markers takes longer than publishing boxes
            if out.given is None or out.refined is None:
                continue
            if out.is_final:
                self._markers.publish(self._board.update_finals(out.refined))
            else:
                self._markers.publish(self._board.update(out.given, out.refined))

    def _publish_boxes(self, ready: list[Outgoing]) -> None:
        """Publish boxes of one stamp or several, and count them."""
        for out in ready:
            publisher = self._boxes[out.is_final]
            for message in messages_of(out.message):
                publisher.publish(message)
                self._health.count('final_published' if out.is_final else 'early_published')
            if out.is_final:
                continue
            if out.received is not None:
                took = self._budget.end()
                self._health.add_times({LATENCY: time.monotonic() - out.received, TICK: took})
                if self.times is not None and took is not None and out.given is not None:
                    self.times.add(out.given.stamp_ns, took)
            if out.given is not None:
                self.tracks = len(set(out.given.track_ids) - {''})
            if out.refined is not None:
                self._health.add_early(out.refined)

    def _save_model(self) -> None:
        """Write what the drive has shown of its detector, and log where drives differ."""
        try:
            differing = self._model.save(self._live.registrar.statistics())
        except OSError as error:
            self._logger.error(f'input_model: cannot be written: {error}')
            return
        if differing:
            self._logger.warning(
                f'input_model: expected drives of one detector and labelling rule, got {differing}'
            )

    def _publish_static(self) -> None:
        """Publish clouds without moving objects, and those that wait no longer for their boxes."""
        if self._live.static_points is None or self.static is None:
            return
        for cloud in self._live.static_points.take(time.monotonic()):
            self.static.publish(cloud.message)
            self._health.count('static_published')
            latency = time.monotonic() - cloud.received
            self._health.add_times({STATIC_LATENCY: latency, STATIC_CPU: cloud.cpu})
            if cloud.is_late:
                reason = Reason.STATIC_UNCHANGED
                self._health.report(reason, f'{reason.meaning}; {reason.remedy}')

    def _finish(self, item: Item | None) -> None:
        """Publish held boxes, and pass messages that are not decoded yet through unsolved."""
        self._take_events()
        late, ready = self._live.release()
        self._publish(ready)
        for waiting in (item, *self._confirmed, *late):
            if waiting is not None:  # its transforms will not come
                self._process(waiting)
        self._publish(self._guarded(self._live.flush))
        while (message := self._inbox.take()) is not None:
            self._pass_on(message)
        self._save_model()
        self._publish_static()
        self._markers.publish(self._board.clear())
        for publisher in (*self._boxes.values(), self._markers):
            publisher.wait_for_all_acked(Duration(seconds=ACKNOWLEDGEMENT_TIME / 3))
