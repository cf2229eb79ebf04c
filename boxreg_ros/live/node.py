"""The node: topics in, topics out, around the same core that relabels recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
import gc
from importlib import import_module
import os
from pathlib import Path
from threading import Event
import time
from typing import Any

from boxreg_ros.errors import ConfigError, UnsupportedMessage
from boxreg_ros.io.markers import MarkerBoard
from boxreg_ros.io.session import is_placeholder
from boxreg_ros.live.diagnostics import Health
from boxreg_ros.live.driver import LiveRegistrar, Outgoing, ReceivedMessage, warm_up
from boxreg_ros.live.inbox import Inbox, Message
from boxreg_ros.live.params import changed, declare, parameters_yaml
from boxreg_ros.reasons import REASONS
from diagnostic_msgs.msg import DiagnosticArray
from msg_adapters import adapter_for, canonical, pointcloud
from msg_adapters.poses import stamp_ns
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import (
    DurabilityPolicy,
    qos_policy_name_from_kind,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

NAME = 'boxreg_node'
POLL = 0.02
"""The worker looks this often whether an arrival has waited long enough [s]."""
HELD_PERIOD = 0.1
"""And so often whether boxes have, if nothing else is to be done [s]."""
GRAPH_PERIOD = 0.2
STATUS_PERIOD = 1.0
BOXES_PATIENCE = 10.0
"""Boxes that wait this many times as long as clouds may pass through, not even decoded."""
LAST_WORK, LAST_ACKNOWLEDGEMENT = 0.5, 0.4
"""So long may, on shutdown, the worker be busy, and subscribers take what it published [s]."""


class BoxregNode(Node):
    """
    Subscribes to clouds, boxes, TF and odometry; publishes refined boxes.

    Callbacks run in the executor's thread and only put messages and wishes into the inbox, so
    the executor is never kept waiting. One other thread, in `work` until `stop`, owns the
    transforms, the registrar and the markers, and publishes boxes. Counters (`Health`) are
    shared by both.

    Raises
    ------
    BoxregError
        If a parameter has a bad value, or a message type is not there.

    """

    def __init__(self) -> None:
        try:
            super().__init__(NAME, automatically_declare_parameters_from_overrides=True)
        except ValueError as error:
            if 'PARAMETER_NOT_SET' not in str(error):
                raise
            given = getattr(self, '_parameter_overrides', {}).values()
            names = ', '.join(sorted(p.name for p in given if p.value is None))
            raise ConfigError(
                f'{names}: expected a value, got an empty list or none; ROS has no empty lists: '
                f"write ['']"
            ) from None
        config, options = self._settings = declare(self)
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._take_parameters)
        warm_up(config)
        gc.collect()
        gc.freeze()  # what stays for good: to look it over for garbage costs a tick 50 ms
        self._convention = options.convention
        self._health = Health()
        self._inbox = Inbox(config.queue)
        self._backlog, self._idle_at, self._waited = options.backlog, 0.0, 0.0
        self._live = LiveRegistrar(
            config, options.fixed_frame, options.output_frame, options.transform_timeout,
            self._trouble, options.convention,
        )  # fmt: skip
        self._board = MarkerBoard()
        self._cloud_frame = self._fixed_frame = ''
        self._tracks = 0
        self._cloud_received = 0.0
        self._newest_motion_ns: int | None = None
        self._stopping = Event()
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # goes on when /clock does not
        self._markers = self.create_publisher(MarkerArray, 'refined_markers', 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self.create_timer(STATUS_PERIOD, self._publish_status, clock=steady)
        best_effort = partial(QoSProfile, reliability=ReliabilityPolicy.BEST_EFFORT)
        # When this process is held up, what comes waits with DDS, which drops without a word: it
        # must hold more than the inbox, which counts.
        depth = 2 * self._inbox.capacity['points']
        self._subscribe(PointCloud2, 'points', self._on_points, best_effort(depth=depth))
        self._subscribe(Odometry, 'odom', self._on_odometry, best_effort(depth=50))
        self._subscribe_to_tf()
        self.create_service(Trigger, '~/reset', self._on_reset)
        self.create_service(Trigger, '~/save_config', self._on_save_config)
        self._depth = 10 + config.lag + self._inbox.capacity['boxes']  # may leave at the end
        self._boxes_type = ''
        self._types: set[str] = set()  # of boxes, that have been seen
        self._early: Publisher | None = None
        self._final: Publisher | None = None
        if options.boxes_type:
            self._open_boxes(canonical(options.boxes_type))
        else:
            self._search = self.create_timer(GRAPH_PERIOD, self._find_boxes, clock=steady)

    def stop(self) -> None:
        """Have `work` come to an end."""
        self._stopping.set()
        self._inbox.news.set()

    # ------------------------------------------------------------ executor thread: callbacks

    def _subscribe(
        self, kind: type, topic: str, callback: Any, qos: QoSProfile, is_open: bool = True
    ) -> Subscription:
        """Subscribe; what DDS loses or does not connect is counted. `is_open`: to overrides."""
        name = self.resolve_topic_name(topic)
        overrides = QoSOverridingOptions.with_default_policies() if is_open else None
        events = SubscriptionEventCallbacks(
            incompatible_qos=partial(self._on_incompatible, name, 'publisher'),
            message_lost=partial(self._on_lost, topic),
        )
        with _told_overrides(f'{name}.subscription'):
            return self.create_subscription(
                kind, topic, callback, qos, event_callbacks=events,
                qos_overriding_options=overrides,
            )  # fmt: skip

    def _publisher(self, kind: type, topic: str, depth: int) -> Publisher:
        name = self.resolve_topic_name(topic)
        events = PublisherEventCallbacks(
            incompatible_qos=partial(self._on_incompatible, name, 'subscriber')
        )
        overrides = QoSOverridingOptions.with_default_policies()
        with _told_overrides(f'{name}.publisher'):
            return self.create_publisher(
                kind, topic, depth, event_callbacks=events, qos_overriding_options=overrides
            )

    def _on_lost(self, topic: str, event: Any) -> None:
        self._health.count(f'{topic}_lost', event.total_count_change)

    def _on_incompatible(self, topic: str, who: str, event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        override = self.get_parameter_or(f'qos_overrides.{topic}.subscription.reliability')
        is_open = override.value in (None, 'best_available')
        is_ours = (topic, who) == (self.resolve_topic_name('boxes'), 'publisher')
        if is_ours and is_open and policy == 'RELIABILITY' and self.executor is not None:
            self.executor.create_task(self._listen_again)
            return
        text = f'{topic}: a {who} whose {policy} QoS policy does not go with that of this node'
        self._trouble('qos_incompatible', f'{text}: {REASONS["qos_incompatible"].remedy}')

    def _subscribe_to_tf(self) -> None:
        """Have `tf2_ros` listen where it is installed, else listen the way it does."""
        try:
            from tf2_ros import TransformListener
        except ImportError:
            self._subscribe_without_tf2_ros()
        else:
            self._listener = TransformListener(_TransformsToInbox(self._inbox), self)
            self.get_logger().debug('transforms come by tf2_ros')

    def _subscribe_without_tf2_ros(self) -> None:
        try:
            kind = import_message('tf2_msgs/msg/TFMessage')
        except UnsupportedMessage as error:
            self.get_logger().warning(f'going on with odometry alone: {error}')
            return
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for topic, qos in (('/tf', QoSProfile(depth=100)), ('/tf_static', latched)):
            callback = partial(self._on_transforms, topic)
            self._subscribe(kind, topic, callback, qos, is_open=False)

    def _find_boxes(self) -> None:
        """Look for publishers of boxes; of types that stay, the first to be read is taken."""
        before, self._types = self._types, self._types_of_boxes()
        if self._types != before:
            return  # publishers are found one by one
        readable, complaints = self._told_apart(self._types)
        if readable:
            self._search.cancel()
            self._types = {readable[0]}  # the others are told of by `_watch_types`
            self._open_boxes(readable[0])
        elif complaints and self._health.is_time_to_warn('boxes_type'):
            self.get_logger().warning(f'{self.resolve_topic_name("boxes")}: {complaints[0]}')

    def _told_apart(self, types: set[str]) -> tuple[list[str], list[str]]:
        """Return the types of boxes that can be read, sorted, and why the others cannot."""
        readable, complaints = [], []
        for name in sorted(types):
            try:
                adapter_for(name, self._convention)
                import_message(name)
            except UnsupportedMessage as error:
                complaints.append(str(error))
            else:
                readable.append(name)
        return readable, complaints

    def _watch_types(self) -> None:
        """Tell of boxes whose type is not that subscribed to."""
        topic, taken = self.resolve_topic_name('boxes'), self._boxes_type
        types = self._types_of_boxes()
        if taken in types:
            others, _ = self._told_apart(types - self._types)
            self._types |= types
            if others and not self._settings[1].boxes_type:
                self.get_logger().warning(
                    f'{topic} also has boxes of type {", ".join(others)}: '
                    'set boxes_type if these are meant'
                )
        elif taken and types and self._health.is_time_to_warn('boxes_type'):
            self.get_logger().warning(
                f'{topic}: expected boxes of type {taken}, got {", ".join(sorted(types))}; '
                'start the node anew or set boxes_type'
            )

    def _types_of_boxes(self) -> set[str]:
        return {info.topic_type for info in self.get_publishers_info_by_topic('boxes')}

    def _open_boxes(self, type_name: str) -> None:
        adapter, kind = adapter_for(type_name, self._convention), import_message(type_name)
        self._boxes_type = type_name
        self._live.adapter = adapter
        self._early = self._publisher(kind, 'refined_boxes', self._depth)
        self._final = self._publisher(kind, 'refined_boxes_final', self._depth)
        self._boxes = self._subscribe_to_boxes()
        self.get_logger().info(f'boxes are {type_name}')

    def _subscribe_to_boxes(self) -> Subscription:
        # What is best is settled now, by the publishers there are.
        depth = 2 * self._inbox.capacity['boxes']  # as for clouds
        qos = QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_AVAILABLE)
        return self._subscribe(import_message(self._boxes_type), 'boxes', self._on_boxes, qos)

    def _listen_again(self) -> None:
        """Subscribe to boxes anew, as a publisher has come that offers less than the others."""
        self.destroy_subscription(self._boxes)
        self._boxes = self._subscribe_to_boxes()

    def _on_transforms(self, topic: str, msg: Any) -> None:
        self._inbox.put_news(topic, msg.transforms)

    def _on_odometry(self, msg: Odometry) -> None:
        self._inbox.put_news('odom', msg)

    def _on_points(self, msg: PointCloud2) -> None:
        self._cloud_frame = msg.header.frame_id
        self._cloud_received = time.monotonic()
        self._receive('points', msg)

    def _on_boxes(self, msg: Any) -> None:
        self._receive('boxes', msg)

    def _receive(self, topic: str, msg: Any) -> None:
        self._health.count(f'{topic}_received')
        dropped = self._inbox.put(topic, msg)
        if dropped is not None:
            self._drop(dropped)

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._inbox.put_news('reset', None)
        response.success = True
        response.message = 'tracks and what was learnt are forgotten, transforms are kept'
        return response

    def _on_save_config(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        config, options = self._settings
        path = Path(options.config_file).absolute()
        partial_path = path.parent / f'.{path.name}.partial'
        try:
            text = parameters_yaml(config, options, self.get_fully_qualified_name())
            try:
                partial_path.write_text(text, encoding='utf-8')
                os.replace(partial_path, path)
            finally:
                partial_path.unlink(missing_ok=True)
        except (OSError, ValueError) as error:  # ValueError: a name with a NUL
            response.message = f'{error}; choose another config_file'
        else:
            response.success, response.message = True, str(path)
        return response

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            changed(*self._settings, parameters)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _take_parameters(self, parameters: list[Parameter]) -> None:
        self._settings = changed(*self._settings, parameters)
        self._inbox.put_news('settings', self._settings)

    def _publish_status(self) -> None:
        for complaint in self._health.complaints():
            self.get_logger().warning(complaint)
        self._watch_types()
        now, age = self.get_clock().now(), 'none'
        if self._newest_motion_ns is not None:
            age = f'{1e-9 * (now.nanoseconds - self._newest_motion_ns):.3f}'
        facts = {
            'fixed_frame': self._fixed_frame or 'not known yet',
            'newest transform, age [s]': age,
            'tracks': self._tracks,
            **self._live.facts,
            **self._inbox.sizes(),
        }
        status = self._health.status(f'{self.get_fully_qualified_name()}: registration', facts)
        message = DiagnosticArray(status=[status])
        message.header.stamp = now.to_msg()
        self._diagnostics.publish(message)

    # ------------------------------------------------------------ worker thread

    def work(self) -> None:
        """Take arrivals until `stop`, each as soon as its transforms are there."""
        item: ReceivedMessage | None = None
        while True:
            self._inbox.news.clear()  # before the look at `_stopping`: `stop` sets both
            if self._stopping.is_set():
                break
            self._take_news()
            self._miss_clouds(item)
            item = item or self._decoded(self._take())
            self._live.cloud_frame = self._cloud_frame  # boxes may wait for the first cloud
            if item is not None and self._live.is_ready(item, time.monotonic()):
                self._process(item)
                item = None
            elif item is not None:
                self._inbox.news.wait(POLL)
                self._idle_at = time.monotonic()
                self._waited = self._idle_at - item.received
            elif not any(self._inbox.sizes().values()):
                if self._live.is_silent(time.monotonic()):
                    self._publish(self._guarded(self._live.flush))
                if self._board.is_showing and self._live.has_ceased(time.monotonic()):
                    self._markers.publish(self._board.clear())
                self._inbox.news.wait(HELD_PERIOD if self._live.is_holding else STATUS_PERIOD)
                self._idle_at, self._waited = time.monotonic(), 0.0
        self._finish_work(item)

    def _miss_clouds(self, item: ReceivedMessage | None) -> None:
        """Let boxes go that wait for a cloud, if none is on its way."""
        is_cloud = item is not None and isinstance(item.message, PointCloud2)
        if not is_cloud and not self._inbox.sizes()['points_waiting']:
            now, newest = time.monotonic(), self._cloud_received
            self._publish(self._guarded(partial(self._live.lose_overdue, now, newest)))

    def _take(self) -> Message | None:
        """Return what has waited longest, but for what has waited for the solver too long."""
        message = self._inbox.take()
        if message is None:
            return None
        if message.topic == 'passing':
            self._publish(self._live.last(message.content))
            return None
        patience = self._backlog * (1.0 if message.topic == 'points' else BOXES_PATIENCE)
        # What has come while a transform was waited for may take as long again to be solved.
        since = max(message.received, self._idle_at + self._waited)
        if time.monotonic() <= since + patience:
            return message
        self._drop(message)
        return None

    def _finish_work(self, item: ReceivedMessage | None) -> None:
        """Publish what is held, and pass what still waits through: nobody waits for the solver."""
        self._take_news()
        self._publish(self._guarded(self._live.flush))
        if item is not None and not isinstance(item.message, PointCloud2):
            self._publish(self._live.passed_through(item.message))
        while message := self._inbox.take():
            if message.topic == 'boxes':
                self._publish(self._live.passed_through(message.content))
            elif message.topic == 'passing':
                self._publish(self._live.last(message.content))
        self._markers.publish(self._board.clear())
        for publisher in (self._early, self._final, self._markers):
            if publisher is not None:
                publisher.wait_for_all_acked(Duration(seconds=LAST_ACKNOWLEDGEMENT / 3))

    def _take_news(self) -> None:
        for topic, news in self._inbox.take_news():
            if topic == 'odom':
                self._live.tree.add_odometry(news)
            elif topic == 'lost':
                self._publish(self._guarded(partial(self._live.lose, news)))
            elif topic == 'reset':
                self._publish(self._guarded(self._live.reset))
            elif topic == 'settings':
                self._live.config, options = news
                self._live.output_frame = options.output_frame.lstrip('/')
                self._live.transform_timeout = options.transform_timeout
            else:
                self._live.tree.add_transforms(news, is_static=topic == '/tf_static')
        self._newest_motion_ns = self._live.tree.newest_ns()

    def _decoded(self, message: Message | None) -> ReceivedMessage | None:
        if message is None:
            return None
        reader: Any = pointcloud if message.topic == 'points' else self._live.adapter
        try:
            content = reader.from_msg(message.content)
        except Exception as error:  # whatever a malformed message leads to
            self._trouble('unreadable', f'{message.topic}: {error}')
            if message.topic == 'boxes':
                self._publish(self._live.passed_through(message.content))
            return None
        return ReceivedMessage(message.content, content, message.received)

    def _process(self, item: ReceivedMessage) -> None:
        ready = self._guarded(partial(self._live.process, item), item)
        if self._fixed_frame != self._live.fixed_frame:
            self._fixed_frame = self._live.fixed_frame
            self.get_logger().info(f'fixed frame is {self._fixed_frame!r}')
        self._publish(ready)
        if is_placeholder(item.content) and self._board.is_showing:
            self._markers.publish(self._board.clear())

    def _guarded(
        self, task: Callable[[], list[Outgoing]], item: ReceivedMessage | None = None
    ) -> list[Outgoing]:
        """Return what a task returns; one bad tick must not end weeks of running."""
        try:
            return task()
        except Exception as error:
            self._trouble('failed', f'{type(error).__name__}: {error}')
            return self._live.abandon(item)
        finally:
            self._health.set_counts(self._live.counts)

    def _publish(self, ready: list[Outgoing]) -> None:
        for out in ready:
            publisher = self._final if out.is_final else self._early
            assert publisher is not None  # it was made before boxes were subscribed to
            publisher.publish(out.message)
            self._health.count('final_published' if out.is_final else 'early_published')
            if not out.is_final and out.received is not None:
                self._health.add_latency(time.monotonic() - out.received)
            if not out.is_final and out.given is not None:
                self._tracks = len(set(out.given.track_ids) - {''})
        if not self._markers.get_subscription_count():
            return  # they take longer than the boxes
        for out in ready:
            if not out.is_final and out.given is not None and out.refined is not None:
                self._markers.publish(self._board.update(out.given, out.refined))

    # ------------------------------------------------------------ both

    def _drop(self, message: Message) -> None:
        """Leave out what the solver has no time for; boxes pass through."""
        reason = f'{message.topic}_queue_full'
        self._trouble(reason, REASONS[reason].remedy)
        if message.topic == 'boxes':
            self._publish([Outgoing(message.content, False)])
            self._inbox.let_pass(message)  # its final copy, in the order of all
        else:
            self._inbox.put_news('lost', stamp_ns(message.content.header))

    def _trouble(self, reason: str, text: str, number: int = 1) -> None:
        """Count what went wrong, and tell it at a limited rate."""
        self._health.count(reason, number)
        if self._health.is_time_to_warn(reason):
            self.get_logger().warning(f'{reason}: {" ".join(text.split())}')


@contextmanager
def _told_overrides(name: str) -> Iterator[None]:
    """Say which QoS is meant: rclpy asserts the types of overrides without a word."""
    try:
        yield
    except (AssertionError, AttributeError, TypeError):
        raise ConfigError(
            f'qos_overrides.{name}: expected a whole number for depth, names such as reliable for '
            f'the other policies, got something else'
        ) from None


class _TransformsToInbox:
    """What a `TransformListener` of `tf2_ros` needs of a buffer: `TransformTree` is the buffer."""

    def __init__(self, inbox: Inbox) -> None:
        self._inbox = inbox

    def set_transform(self, transform: Any, authority: str) -> None:
        self._inbox.put_news('/tf', [transform])

    def set_transform_static(self, transform: Any, authority: str) -> None:
        self._inbox.put_news('/tf_static', [transform])


def import_message(type_name: str) -> type:
    """
    Return the class of a message type.

    Raises
    ------
    UnsupportedMessage
        If its package is not installed; the message names it.

    """
    package, _, name = canonical(type_name).split('/')
    try:
        kind: type = getattr(import_module(f'{package}.msg'), name)
    except (ImportError, AttributeError):
        raise UnsupportedMessage(
            f'message type {type_name} is not installed: install the ROS package {package} '
            f'(apt: ros-jazzy-{package.replace("_", "-")}) or source the workspace that has it'
        ) from None
    return kind
