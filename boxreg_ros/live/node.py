"""The live node: parameters, topics and services around the registration of boxes."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
import gc
from pathlib import Path
from threading import Event, Thread
import time
from typing import Any

from boxreg_ros.errors import ConfigError, UnsupportedMessage
from boxreg_ros.io.compilation import announced_compilation
from boxreg_ros.io.label_messages import EARLY_TOPIC, LABELS_TOPIC, LABELS_TYPE
from boxreg_ros.io.lidars import Lidars, SensorPlacement
from boxreg_ros.io.session import Session
from boxreg_ros.io.warm_up import (
    compiled_beside,
    SecondProcess,
    warm_up,
    warm_up_followed,
    warm_up_labels,
    warm_up_solver,
)
from boxreg_ros.io.whole_files import written_whole
from boxreg_ros.live.boxes_type import BoxesTypeSearch
from boxreg_ros.live.budget import TickBudget
from boxreg_ros.live.debug_times import DebugTimes
from boxreg_ros.live.diagnostics import Health
from boxreg_ros.live.inbox import Inbox
from boxreg_ros.live.model_file import ModelFile
from boxreg_ros.live.params import changed, declare, numbers_as_declared, parameters_yaml
from boxreg_ros.live.pipeline import MessagePipeline
from boxreg_ros.live.polling import PolledClockNode
from boxreg_ros.live.topics import (
    BOXES_TOPICS,
    Endpoint,
    FOLLOW_TOPIC,
    import_message,
    NodeTopics,
    TopicProblem,
)
from boxreg_ros.live.transform_wait import TransformWait
from boxreg_ros.live.worker import Worker
from boxreg_ros.reasons import Reason
from diagnostic_msgs.msg import DiagnosticArray
from msg_adapters import adapter_for, canonical
from msg_adapters.clouds import POINTS_TYPE
from msg_adapters.concatenation import INFO_TYPE
from msg_adapters.serialized import serialized_adapter_for
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from std_srvs.srv import Trigger

NAME = 'boxreg_node'
LABELS_TOPICS = {False: EARLY_TOPIC, True: LABELS_TOPIC}
"""Topics of what label files hold of early (False) and final (True) boxes."""
GRAPH_PERIOD = 0.2
"""Time between two looks for the type of the boxes [s]."""
STATUS_PERIOD = 1.0
"""Time between two messages on /diagnostics [s]."""
MOTION_DEPTH = 1000
"""Queue size of `odom` and /tf: a second of five publishers of 200 Hz."""
FOLLOW_DEPTH = 10
"""Queue size of `~/follow`, where a person publishes."""
WITHOUT_CLOCK = TopicProblem(
    '/clock: use_sim_time is set, and nothing has been received from it: /diagnostics has stamps '
    'of 0 and no ages; play the recording with --clock, or set use_sim_time to false'
)
"""Clouds without a time; boxes are refined as always, by their stamps."""
FINALS_MARGIN = 10
"""Queue size of the boxes beyond what may be published at once at the end."""


class BoxregNode(PolledClockNode):
    """
    Subscribes to clouds, boxes, TF and odometry; publishes refined boxes.

    Its life has three steps: the constructor declares the parameters, `configure` warms up,
    `open_topics` creates topics and services. `close_topics` destroys these again.

    Callbacks run in the thread of the executor. They put messages and events into the inbox and
    return at once. `worker`, made by `open_topics`, runs in the thread of `run_worker` and does
    the rest. Raises ConfigError if a parameter has a wrong value.

    """

    def __init__(self, second: SecondProcess | None = None) -> None:
        try:
            super().__init__(NAME, automatically_declare_parameters_from_overrides=True)
        except ValueError as error:
            if 'PARAMETER_NOT_SET' not in str(error):
                raise
            raise self._error_of_empty_lists() from None
        self._settings = declare(self)
        self.add_pre_set_parameters_callback(partial(numbers_as_declared, self))
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._take_parameters)
        self._second = second
        self._health = Health(self.get_logger())
        config, options = self._settings
        self._inbox = Inbox(config.queue, max(1, len(options.lidars.topics)))
        self._opened = ExitStack()
        self._is_warm = Event()  # until then, boxes pass unchanged
        self._can_follow = Event()  # until then, boxes to follow are refused
        self._failures: list[Exception] = []

    def configure(self) -> None:
        """Load or compile kernels, time a window, and make a registrar without any track."""
        self.prepare()
        self.warm_up(self.get_logger().info)

    def prepare(self) -> None:
        """Make a registrar without any track, and all that reading and passing boxes needs."""
        config, options = self._settings
        self._budget = TickBudget(options.deadline)
        report = self._health.report
        placement = SensorPlacement(options.lidars)
        session = Session(options.convention, config, options.fixed_frame, placement, report)
        session.tree.clock_offset = options.clock_offset
        session.assigns_ids = not options.keep_ids  # `boxreg relabel` begins again
        session.leaves_frames_that_jump = True  # it has searched the recording
        wait = TransformWait(session, options.transform_timeout, options.output_frame)
        patience = options.static_points_wait if options.static_points else None
        self._model = ModelFile(options.input_model)
        if self._model.text:
            self.get_logger().info(self._model.text)
        self._live = MessagePipeline(
            config, session, wait, report, self._budget, patience, self._model.drives
        )

    def warm_up(self, announce: Callable[[str], None]) -> None:
        """
        Load or compile kernels, with announcements, and time a window; boxes may pass.

        From the time that `_is_warm` is set, boxes may be refined; what follows objects is loaded
        afterwards.

        """
        config, options = self._settings
        begun = time.monotonic()
        with announced_compilation(announce) as done:
            with compiled_beside(self._second, config, options.static_points) as wait:
                if config.objective != 'paper':
                    warm_up_solver(config)
                wait()
                warm_up(config)
                if options.static_points:
                    warm_up_labels(config)
                if done.functions:
                    seconds = time.monotonic() - begun
                    text = f'compiled {done.functions} functions in {seconds:.0f} s'
                    self.get_logger().info(text)
                # Once more, timed without imports and compilation.
                warm_up(config, self._budget.submit)
                gc.collect()
                gc.freeze()  # a collection of imported objects takes 50 ms, several times a minute
                self._is_warm.set()
            warm_up_followed(config)
        self._second = None  # it has ended
        self._can_follow.set()

    def warm_up_beside(self) -> None:
        """Warm up; where that is to compile, return at once and go on in a thread."""
        goes_on = Event()

        def announce(text: str) -> None:
            until = '' if goes_on.is_set() else '; boxes pass unchanged until then'
            self.get_logger().info(f'{text}{until}')
            goes_on.set()

        def run() -> None:
            try:
                self.warm_up(announce)
            except Exception as error:
                self._failures.append(error)
            self._is_warm.set()
            goes_on.set()

        Thread(target=run, daemon=True).start()
        goes_on.wait()
        if self._failures:
            raise self._failures[0]

    def open_topics(self) -> None:
        """
        Create topics, services and timers.

        Raises ConfigError for a wrong QoS override, and UnsupportedMessage if `boxes_type`
        cannot be read or its package is not installed.

        """
        _, options = self._settings
        self._refuse_loop(options.static_points)
        self._topics = NodeTopics(self, self._health)
        self._opened.callback(self._topics.close)
        self._markers = self._topics.publish(
            'visualization_msgs/msg/MarkerArray', 'refined_markers', 10
        )
        self._diagnostics = self._topics.publish(
            'diagnostic_msgs/msg/DiagnosticArray', '/diagnostics', 10
        )
        self.worker = Worker(
            self._live, self._inbox, self._health, self.get_logger(), self._budget,
            options.backlog, self._markers, self._model, self._topics.poll,
        )  # fmt: skip
        self.worker.times = DebugTimes(self._topics, lambda: self.get_clock().now())
        if options.static_points:
            self._open_static_points(options.points_type)
        self._subscribe_to_points(options.points_type, options.lidars)
        self._subscribe_to_motion()
        for name, callback in (
            ('~/reset', self._on_reset),
            ('~/save_config', self._on_save_config),
        ):
            service = self.create_service(Trigger, name, callback)
            self._opened.callback(self.destroy_service, service)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # runs on while /clock stands still
        status_timer = self.create_timer(STATUS_PERIOD, self._publish_status, clock=steady)
        self._opened.callback(self.destroy_timer, status_timer)
        self._search: BoxesTypeSearch | None = None
        if options.boxes_type:
            self._open_boxes(canonical(options.boxes_type))
        else:
            name = self.resolve_topic_name('boxes')
            self._search = BoxesTypeSearch(self._topics, name, options.convention)
            self._search_timer = self.create_timer(GRAPH_PERIOD, self._find_boxes, clock=steady)
            self._opened.callback(self.destroy_timer, self._search_timer)
            self.get_logger().info(f'waiting for the type of {name}; {self._topics.description()}')

    def close_topics(self) -> None:
        """Destroy topics, services and timers; the worker has ended before."""
        self._opened.close()

    def run_worker(self) -> None:
        """Process messages until `stop_worker`; raise the error of a compilation beside it."""
        self.worker.pass_until(self._is_warm)
        if self._failures:
            raise self._failures[0]
        self.worker.run()

    def stop_worker(self) -> None:
        """Make `run_worker` publish the boxes held, and return."""
        self.worker.stop()

    # ------------------------------------------------------------ topics

    def _refuse_loop(self, has_static_points: bool) -> None:
        """Raise ConfigError if the node would take its own output for its input."""
        outputs = ('refined_boxes', 'refined_boxes_final', 'refined_markers')
        pairs = [('boxes', output) for output in outputs]
        if has_static_points:
            pairs.append(('points', 'static_points'))
        for given, output in pairs:
            name = self.resolve_topic_name(given)
            if self.resolve_topic_name(output) == name:
                raise ConfigError(
                    f'{given}: expected the topic of another node, got {name!r}, where this node '
                    f'publishes {output}; correct the remap'
                )

    def _open_static_points(self, points_type: str) -> None:
        """Publish clouds without moving objects."""
        if canonical(points_type) != POINTS_TYPE:
            raise ConfigError(
                f'static_points: expected clouds of type {POINTS_TYPE}, whose layout is kept, got '
                f'{points_type}; decompress them first, or leave static_points out'
            )
        depth = 2 * self._inbox.capacity['points']
        self.worker.static = self._topics.publish(POINTS_TYPE, 'static_points', depth)

    def _subscribe_to_points(self, points_type: str, lidars: Lidars) -> None:
        """Subscribe to the clouds of all LiDARs, and to the info on concatenated ones."""
        # While the process is suspended, messages wait in DDS, which drops without a count. Its
        # queue must be longer than the inbox, which counts.
        qos = partial(
            QoSProfile,
            depth=2 * self._inbox.capacity['points'],
            reliability=ReliabilityPolicy.BEST_EFFORT,
        )
        subscribe = self._topics.subscribe
        for topic in lidars.topics or ('points',):
            lidar = topic if len(lidars.topics) > 1 else ''
            callback = partial(self._on_points, lidar)
            subscribe(Endpoint(points_type, topic, qos(), callback, is_required=True))
        if lidars.info:
            put = partial(self._inbox.put_event, self.worker.add_info)
            subscribe(Endpoint(INFO_TYPE, lidars.info, qos(), put, is_required=True))

    def _subscribe_to_motion(self) -> None:
        """Subscribe to odometry and transforms, which the worker polls."""
        polled, subscribe = partial(Endpoint, is_polled=True), self._topics.subscribe
        qos = QoSProfile(depth=MOTION_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        tree = self._live.session.tree
        subscribe(polled('nav_msgs/msg/Odometry', 'odom', qos, tree.add_odometry))
        reliable = QoSProfile(depth=MOTION_DEPTH)
        # That of tf2_ros.
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        try:
            for topic, qos in (('/tf', reliable), ('/tf_static', latched)):
                callback = partial(self._on_transforms, topic == '/tf_static')
                subscribe(polled('tf2_msgs/msg/TFMessage', topic, qos, callback))
        except UnsupportedMessage as error:
            self.get_logger().warning(f'transforms are not received, odometry is: {error}')

    def _find_boxes(self) -> None:
        assert self._search is not None  # the timer exists with it only
        type_name = self._search.step()
        if type_name:
            self._search_timer.cancel()
            self._open_boxes(type_name)

    def _open_boxes(self, type_name: str) -> None:
        """Publish refined boxes and subscribe to boxes of a type."""
        config, options = self._settings
        adapter = adapter_for(type_name, options.convention)
        serialized = serialized_adapter_for(
            type_name, options.convention, import_message(type_name), deserialize_message
        )
        capacity = self._inbox.capacity['boxes']
        at_end = FINALS_MARGIN + config.lag + capacity  # published at once at the end
        publish = partial(self._topics.publish, depth=at_end)
        boxes = {is_final: publish(type_name, topic) for is_final, topic in BOXES_TOPICS.items()}
        labels = {
            is_final: publish(LABELS_TYPE, topic) for is_final, topic in LABELS_TOPICS.items()
        }
        self.worker.open_boxes(serialized or adapter, boxes, labels)
        qos = QoSProfile(depth=2 * capacity, reliability=ReliabilityPolicy.BEST_AVAILABLE)
        boxed = partial(Endpoint, type_name, is_raw=serialized is not None)
        receive = partial(self._receive, 'boxes')
        self._topics.subscribe(boxed('boxes', qos, receive, is_required=True))
        few = QoSProfile(depth=FOLLOW_DEPTH, reliability=ReliabilityPolicy.BEST_AVAILABLE)
        self._topics.subscribe(boxed(FOLLOW_TOPIC, few, self._follow))
        self.get_logger().info(f'boxes are {type_name}; {self._topics.description()}')
        self._topics.warn_of_unused_overrides()

    def _follow(self, msg: Any) -> None:
        if self._can_follow.is_set():
            self._inbox.put_event(self.worker.follow, msg)
        else:
            self._health.report(
                Reason.NOT_FOLLOWED, 'still compiling: publish the box again later'
            )

    def _on_transforms(self, is_static: bool, msg: Any, received_ns: int) -> None:
        self._live.session.tree.add_transforms(msg.transforms, is_static, received_ns)

    def _on_points(self, lidar: str, msg: Any) -> None:
        self.worker.note_cloud(msg, lidar)
        self._receive('points', msg, lidar)

    def _receive(self, topic: str, msg: Any, lidar: str = '') -> None:
        self._health.count(f'{topic}_received')
        dropped = self._inbox.put(topic, msg, lidar)
        if dropped is not None:
            self.worker.drop(dropped)

    # ------------------------------------------------------------ services and parameters

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._inbox.put_event(self.worker.reset)
        response.success = True
        response.message = 'tracks and estimated input errors are deleted, transforms are kept'
        return response

    def _on_save_config(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        config, options = self._settings
        path = Path(options.config_file).absolute()
        try:
            with written_whole(path) as file:
                file.write(parameters_yaml(config, options))
        except (OSError, ValueError) as error:  # ValueError: a file name with a NUL character
            response.message = f'{error}; choose another config_file'
        else:
            response.success = True
            response.message = str(path)
        return response

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            changed(*self._settings, parameters)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _take_parameters(self, parameters: list[Parameter]) -> None:
        self._settings = changed(*self._settings, parameters)
        self._inbox.put_event(self._change_worker)

    def _change_worker(self) -> None:
        self.worker.change(*self._settings)  # that of the time, of a lifecycle node

    def _error_of_empty_lists(self) -> ConfigError:
        """Return the error for parameters that are empty lists, which rclpy refuses."""
        given = getattr(self, '_parameter_overrides', {}).values()
        names = ', '.join(sorted(p.name for p in given if p.value is None))
        return ConfigError(
            f'{names}: expected a value, got an empty list or none; an empty list has no type in '
            f"ROS: write ['']"
        )

    # ------------------------------------------------------------ diagnostics

    def _publish_status(self) -> None:
        name = self.get_fully_qualified_name()
        further = [] if self._search is None else self._search.problems()
        now = self.get_clock().now()
        if not now.nanoseconds and self.worker.cloud_received:
            further.append(WITHOUT_CLOCK)
        topics = self._topics.report(f'{name}: topics', further)
        self._health.log_counts()
        self._health.log_waiting(self.worker.fixed_frame or '')
        newest_ns = self.worker.newest_transform_ns
        age = 'none'
        if newest_ns is not None and now.nanoseconds:
            age = f'{1e-9 * (now.nanoseconds - newest_ns):.3f}'
        facts = {
            'fixed_frame': self.worker.fixed_frame or 'not known yet',
            'newest transform, age [s]': age,
            'tracks': self.worker.tracks,
            **self.worker.facts(),
            **self._inbox.sizes(),
        }
        registration = self._health.status(f'{name}: registration', facts, self._budget.seconds)
        message = DiagnosticArray(status=[registration, topics])
        message.header.stamp = now.to_msg()
        self._diagnostics.publish(message)
