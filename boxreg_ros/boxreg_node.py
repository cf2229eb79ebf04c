"""The node: topics in, topics out, around the same core that relabels recordings."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from threading import Event
import time
from typing import Any

from boxreg_ros.diagnostics import Health
from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.inbox import Inbox, Message
from boxreg_ros.live import Arrival, LiveRegistrar, Outgoing, warm_up
from boxreg_ros.params import declare
from boxreg_ros.visual import MarkerBoard
from diagnostic_msgs.msg import DiagnosticArray
from msg_adapters import adapter_for, ADAPTERS, canonical, pointcloud
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

NAME = 'boxreg_node'
POLL = 0.02
"""The worker looks this often whether an arrival has waited long enough [s]."""
GRAPH_PERIOD = 0.2
STATUS_PERIOD = 1.0
LAST_WORK, LAST_ACKNOWLEDGEMENT = 1.0, 0.4
"""So long may, on shutdown, the worker go on, and subscribers take what it published [s]."""


class BoxregNode(Node):
    """
    Subscribes to clouds, boxes, TF and odometry; publishes refined boxes.

    Callbacks run in the executor's thread and only put messages into the inbox, so the executor
    is never kept waiting. One other thread, in `work` until `stop`, owns the transforms, the
    registrar and the markers, and publishes boxes. Counters (`Health`) are shared by both.

    Raises
    ------
    BoxregError
        If a parameter has a bad value, or a message type is not there.

    """

    def __init__(self) -> None:
        super().__init__(NAME, automatically_declare_parameters_from_overrides=True)
        config, options = declare(self)
        warm_up(config)
        self._convention = options.convention
        self._health = Health()
        self._inbox = Inbox(options.backlog)
        self._live = LiveRegistrar(
            config, options.fixed_frame, options.output_frame, options.transform_timeout,
            self._trouble, options.convention,
        )  # fmt: skip
        self._board = MarkerBoard()
        self._cloud_frame = self._fixed_frame = ''
        self._stopping = Event()
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # goes on when /clock does not
        self._markers = self.create_publisher(MarkerArray, 'refined_markers', 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self.create_timer(STATUS_PERIOD, self._publish_status, clock=steady)
        best_effort = partial(QoSProfile, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._subscribe(PointCloud2, 'points', self._on_points, best_effort(depth=5))
        self._subscribe(Odometry, 'odom', self._on_odometry, best_effort(depth=50))
        self._subscribe_to_tf()
        self._final_depth = 10 + config.lag  # so many may leave at once, at the end
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

    def _subscribe(self, kind: type, topic: str, callback: Any, qos: QoSProfile) -> None:
        overrides = QoSOverridingOptions.with_default_policies()
        self.create_subscription(kind, topic, callback, qos, qos_overriding_options=overrides)

    def _subscribe_to_tf(self) -> None:
        try:
            kind = import_message('tf2_msgs/msg/TFMessage')
        except UnsupportedMessage as error:
            self.get_logger().warning(f'going on with odometry alone: {error}')
            return
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for topic, qos in (('/tf', QoSProfile(depth=100)), ('/tf_static', latched)):
            self.create_subscription(kind, topic, partial(self._inbox.put_motion, topic), qos)

    def _find_boxes(self) -> None:
        """Look for publishers of boxes; the first type that can be read is taken."""
        types = {info.topic_type for info in self.get_publishers_info_by_topic('boxes')}
        readable = sorted(name for name in types if name in ADAPTERS)
        try:
            if readable:
                self._open_boxes(readable[0])
                self._search.cancel()
            elif types:
                adapter_for(types.pop(), self._convention)
        except UnsupportedMessage as error:
            if self._health.is_time_to_warn('boxes_type'):
                self.get_logger().warning(f'{self.resolve_topic_name("boxes")}: {error}')

    def _open_boxes(self, type_name: str) -> None:
        adapter, kind = adapter_for(type_name, self._convention), import_message(type_name)
        self._live.adapter = adapter
        overrides = QoSOverridingOptions.with_default_policies()
        self._early, self._final = (
            self.create_publisher(kind, topic, depth, qos_overriding_options=overrides)
            for topic, depth in (('refined_boxes', 10), ('refined_boxes_final', self._final_depth))
        )
        qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_AVAILABLE)
        self._subscribe(kind, 'boxes', self._on_boxes, qos)
        self.get_logger().info(f'boxes are {type_name}')

    def _on_odometry(self, msg: Odometry) -> None:
        self._inbox.put_motion('odom', msg)

    def _on_points(self, msg: PointCloud2) -> None:
        self._cloud_frame = msg.header.frame_id
        self._receive('points', msg)

    def _on_boxes(self, msg: Any) -> None:
        self._receive('boxes', msg)

    def _receive(self, topic: str, msg: Any) -> None:
        self._health.count(f'{topic}_received')
        dropped = self._inbox.put(topic, msg)
        if dropped is not None:
            self._trouble(f'{topic}_queue_full', 'the solver is slower than the data comes')
            if topic == 'boxes':
                self._publish(LiveRegistrar.passed_through(dropped.content))

    def _publish_status(self) -> None:
        facts = {
            'fixed_frame': self._fixed_frame or 'not known yet',
            **self._live.facts,
            **self._inbox.sizes(),
        }
        status = self._health.status(f'{self.get_fully_qualified_name()}: registration', facts)
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    # ------------------------------------------------------------ worker thread

    def work(self) -> None:
        """Take arrivals until `stop`, each as soon as its transforms are there."""
        item: Arrival | None = None
        while not self._stopping.is_set():
            self._inbox.news.clear()
            self._take_motion()
            item = item or self._decoded(self._inbox.take())
            if item is not None and self._live.is_ready(item, time.monotonic()):
                self._process(item)
                item = None
            elif item is not None or not any(self._inbox.sizes().values()):
                self._inbox.news.wait(POLL if item is not None else None)
        self._finish_work(item)

    def _finish_work(self, item: Arrival | None) -> None:
        """Process what is left as long as there is time, then publish what is held."""
        end = time.monotonic() + LAST_WORK
        self._take_motion()
        while time.monotonic() < end:
            item = item or self._decoded(self._inbox.take())
            if item is None and not any(self._inbox.sizes().values()):
                break
            if item is not None:
                self._process(item)
                item = None
        self._publish(self._live.flush())
        self._markers.publish(self._board.clear())
        for publisher in (self._early, self._final, self._markers):
            if publisher is not None:
                publisher.wait_for_all_acked(Duration(seconds=LAST_ACKNOWLEDGEMENT / 3))

    def _take_motion(self) -> None:
        for topic, msg in self._inbox.take_motion():
            if topic == 'odom':
                self._live.tree.add_odometry(msg)
            else:
                self._live.tree.add_transforms(msg.transforms, is_static=topic == '/tf_static')

    def _decoded(self, message: Message | None) -> Arrival | None:
        if message is None:
            return None
        self._live.cloud_frame = self._cloud_frame
        reader: Any = pointcloud if message.topic == 'points' else self._live.adapter
        try:
            content = reader.from_msg(message.content)
        except Exception as error:  # whatever a malformed message leads to
            self._trouble('unreadable', f'{message.topic}: {error}')
            if message.topic == 'boxes':
                self._publish(LiveRegistrar.passed_through(message.content))
            return None
        return Arrival(message.content, content, message.received)

    def _process(self, item: Arrival) -> None:
        try:
            ready = self._live.process(item)
        except Exception as error:  # one bad tick must not end weeks of running
            self._trouble('failed', f'{type(error).__name__}: {error}')
            ready = self._live.abandon(item)
        if self._fixed_frame != self._live.fixed_frame:
            self._fixed_frame = self._live.fixed_frame
            self.get_logger().info(f'fixed frame is {self._fixed_frame!r}')
        self._publish(ready)
        self._health.set_counts(self._live.counts)
        if any(not out.is_final for out in ready):
            self._health.add_latency(time.monotonic() - item.received)

    def _publish(self, ready: list[Outgoing]) -> None:
        for out in ready:
            publisher = self._final if out.is_final else self._early
            assert publisher is not None  # it was made before boxes were subscribed to
            publisher.publish(out.message)
            self._health.count('final_published' if out.is_final else 'early_published')
        if not self._markers.get_subscription_count():
            return  # they take longer than the boxes
        for out in ready:
            if not out.is_final and out.given is not None and out.refined is not None:
                self._markers.publish(self._board.update(out.given, out.refined))

    # ------------------------------------------------------------ both

    def _trouble(self, reason: str, text: str) -> None:
        """Count what went wrong, and tell it at a limited rate."""
        self._health.count(reason)
        if self._health.is_time_to_warn(reason):
            self.get_logger().warning(f'{reason}: {" ".join(text.split())}')


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
