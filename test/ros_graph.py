"""A ROS graph for tests: a node of the test, and processes of the node and of a player."""

from contextlib import contextmanager
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import NamedTuple

from boxreg_ros.live.topics import import_message
from msg_adapters import vision
import numpy as np
from paths import ROOT
from preloaded import NODE, PreloadedProcess
import pytest
from rcl_interfaces.srv import GetParameters
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from ros_domain import next_domain
from ros_messages import DETECTIONS
from rosbags.highlevel import AnyReader

DIAGNOSTICS = 'diagnostic_msgs/msg/DiagnosticArray'
PATIENCE = 90.0  # [s]; nodes start slowly on a busy machine
UNKNOWN_NODE = '_NODE_NAME_UNKNOWN_'
"""Name of the node of an endpoint that is discovered before its node."""
PLAYER = 'ros_graph:play_recording'
LAUNCH_PATIENCE = 5.0  # [s]; after SIGINT, ros2 launch then sends SIGTERM
RELIABLE = [
    part
    for topic in ('/points', '/odom')
    for part in ('-p', f'qos_overrides.{topic}.subscription.reliability:=reliable')
]
RELIABLE += ['-p', 'deadline:=3600.0']
"""Arguments with which no message is lost and all windows are solved on a busy machine."""
QUICK = ('-p', 'window:=4', '-p', 'lag:=2', '-p', 'backlog:=60.0')
"""Arguments for short windows; no box is dropped on a busy machine."""


class Graph:
    """A node of the test and the processes it has started, in a separate ROS domain."""

    def __init__(self, folder, domain=None):
        self.folder = folder
        self.domain = domain or next_domain()
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=self.domain)
        self.node = rclpy.create_node('neighbour', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.processes = []
        self.publishers = {}

    def start(self, *ros_args, command=(NODE,)):
        """Start a node with arguments after --ros-args."""
        process = NodeProcess(self, [*command, '--ros-args', *ros_args])
        self.processes.append(process)
        return process

    def run(
        self, records, *ros_args, kind=DETECTIONS, command=(NODE,), base=RELIABLE, connects=True
    ):
        """
        Start a node beside publishers of a recording; if it `connects`, wait until it has.

        Its lists ``early``, ``final`` and ``diagnostics`` fill with its messages.

        """
        publishers_for(self, records)
        collected = [
            self.collect(kind, '/refined_boxes'),
            self.collect(kind, '/refined_boxes_final'),
            self.collect(DIAGNOSTICS, '/diagnostics'),
        ]
        node = self.start(*base, *ros_args, command=command)
        node.early, node.final, node.diagnostics = collected
        if connects:
            self.wait_until_connected()
        return node

    def start_player(self, path, boxes_topic='/boxes'):
        """Start a process that plays a recording once its topics are connected, and stays."""
        process = NodeProcess(self, [PLAYER, str(path), boxes_topic, str(self.domain)])
        self.processes.append(process)
        return process

    def publisher(self, type_name, topic, is_latched=False, is_reliable=True):
        """Return a publisher."""
        qos = QoSProfile(depth=100)
        if is_latched:
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        if not is_reliable:
            qos.reliability = ReliabilityPolicy.BEST_EFFORT
        publisher = self.node.create_publisher(installed(type_name), topic, qos)
        self.publishers[topic] = publisher
        return publisher

    def collect(self, type_name, topic):
        """Return a list that fills with the messages on a topic."""
        received = []
        kind = installed(type_name)
        self.node.create_subscription(kind, topic, received.append, QoSProfile(depth=100))
        return received

    def call(self, kind, service, request):
        """
        Call a service of a node and return its response.

        A server drops its response to a client that it has not discovered.

        """
        client = self.node.create_client(kind, service)
        self.wait_until_discovered_by(service.rpartition('/')[0])
        self.wait(client.service_is_ready, f'the service {service}')
        future = client.call_async(request)
        self.wait(future.done, f'the response of {service}')
        self.node.destroy_client(client)
        return future.result()

    def wait_until_discovered_by(self, node):
        """
        Wait until a node has discovered all publishers and subscriptions made here.

        A publisher sends nothing to a subscription that it has not discovered, and a subscription
        drops the messages of a publisher that it has not discovered. Neither is seen from the
        other side. So the node is asked for its parameters until it answers: it has then
        discovered the client, which was made last, and endpoints are discovered in the order in
        which they were made.

        """
        client = self.node.create_client(GetParameters, f'{node}/get_parameters')
        futures = []

        def is_answered():
            futures.append(client.call_async(GetParameters.Request()))
            self.executor.spin_until_future_complete(futures[-1], timeout_sec=0.3)
            return any(future.done() for future in futures)

        self.wait(client.service_is_ready, f'the services of {node}')
        self.wait(is_answered, f'an answer of {node}')
        self.node.destroy_client(client)

    def wait(self, condition, awaited, seconds=PATIENCE):
        """Spin until `condition` holds; an error names `awaited`."""
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, (
                f'waited {seconds} s for {awaited}; {self.outputs()}'
            )
            for process in self.processes:
                assert process.popen.poll() is None or process.is_ending, self.outputs()
            self.executor.spin_once(timeout_sec=0.02)

    def spin_until_quiet(self):
        """Handle all messages that have arrived: until none is handled for 0.2 s."""
        last_handled = time.monotonic()
        while time.monotonic() < last_handled + 0.2:
            begun = time.monotonic()
            self.executor.spin_once(timeout_sec=0.02)
            if time.monotonic() < begun + 0.015:  # it did not wait to the end: there was work
                last_handled = time.monotonic()

    def endpoints(self):
        """Return the names of the nodes at the other ends of the topics used here, by endpoint."""
        node = self.node
        found = {topic: node.get_subscriptions_info_by_topic(topic) for topic in self.publishers}
        for subscription in node.subscriptions:
            topic = subscription.topic_name
            found[topic] = node.get_publishers_info_by_topic(topic)
        return {
            (topic, *item.endpoint_gid): f'{item.node_namespace.rstrip("/")}/{item.node_name}'
            for topic, items in found.items()
            for item in items
            if item.node_name != node.get_name()
        }

    def wait_until_connected(self, left=()):
        """
        Wait until each topic used here has an endpoint of another node, which has discovered ours.

        Endpoints that have `left` do not count: those of a node that has ended may still be known.

        """

        def others():
            return {key: name for key, name in self.endpoints().items() if key not in left}

        def is_connected(topic):
            publisher = self.publishers.get(topic)
            is_matched = publisher is None or publisher.get_subscription_count() > 0
            names = [name for key, name in others().items() if key[0] == topic]
            return is_matched and names and UNKNOWN_NODE not in ''.join(names)

        for topic in {*self.publishers, *(item.topic_name for item in self.node.subscriptions)}:
            self.wait(lambda t=topic: is_connected(t), f'the other end of {topic}')
        for name in set(others().values()):
            self.wait_until_discovered_by(name)

    def outputs(self):
        return [process.output() for process in self.processes]

    def close(self):
        for process in self.processes:
            process.kill()
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


class NodeProcess:
    """An entry point, or Python, with some arguments; the output is written to a file."""

    def __init__(self, graph, command):
        self._graph = graph
        self._log = graph.folder / f'node{len(graph.processes)}.log'
        self.is_ending = False
        environment = {'ROS_DOMAIN_ID': str(graph.domain), 'ROS_LOG_DIR': str(graph.folder)}
        program, *arguments = command
        if ':' in program:
            self.popen = PreloadedProcess(program, arguments, environment, self._log)
            return
        with self._log.open('w') as log:
            self.popen = subprocess.Popen(
                [sys.executable, *command], cwd=ROOT, env={**os.environ, **environment},
                stdin=subprocess.PIPE, stdout=log, stderr=subprocess.STDOUT,
            )  # fmt: skip

    def play(self, records):
        """Publish records, and wait after each box message until it is refined."""
        play(self._graph, records, self.early)

    def values(self):
        """Return the newest values of the status as a dict of texts."""
        return values_of(self.diagnostics)

    def output(self):
        return self._log.read_text() if self._log.exists() else ''

    def stop(self, number=signal.SIGINT):
        """Send a signal, spin until the process has ended, and return the time it took [s]."""
        self.is_ending = True
        begun = time.monotonic()
        self.popen.send_signal(number)
        self._graph.wait(lambda: self.popen.poll() is not None, 'the node to end', 10.0)
        took = time.monotonic() - begun
        self._graph.spin_until_quiet()
        return took

    def kill(self):
        self.is_ending = True
        if self.popen.poll() is None:
            self.popen.kill()
        self.popen.wait()


def installed(type_name):
    """Return the class of a message type; the test skips where its package is not installed."""
    package = type_name.partition('/')[0]
    pytest.importorskip(f'{package}.msg', reason=f'{package} is not installed')
    return import_message(type_name)


@contextmanager
def graph_in(folder):
    """Yield a Graph and end its processes afterwards."""
    graph = Graph(folder)
    try:
        yield graph
    finally:
        graph.close()


def ended_cleanly(node, number=signal.SIGINT):
    """Stop the node and check exit status, output and duration."""
    took = node.stop(number)
    assert node.popen.returncode == 0, node.output()
    assert 'Traceback' not in node.output()
    assert took < LAUNCH_PATIENCE
    return True


def values_of(diagnostics):
    """Return the newest values of the node's status as a dict of texts."""
    newest = diagnostics[-1].status[0].values if diagnostics else []
    return {item.key: item.value for item in newest}


def stamp_of(message):
    """Return the stamp of a box message [ns]."""
    if hasattr(message, 'header'):
        stamp = message.header.stamp
    elif hasattr(message, 'entities'):
        stamp = message.entities[0].timestamp
    else:
        stamp = message.markers[0].header.stamp
    return stamp.sec * 10**9 + stamp.nanosec


class Record(NamedTuple):
    """A recorded message as bytes; of a box message also the stamp."""

    topic: str
    type_name: str
    data: bytes
    received_ns: int
    boxes_stamp_ns: int | None


def records_of(path, boxes_topic='/boxes'):
    """Return all records of a recording in the order they were received."""
    records = []
    with AnyReader([path]) as reader:
        for connection, received_ns, data in reader.messages():
            topic, type_name, stamp_ns = connection.topic, connection.msgtype, None
            if topic == boxes_topic:
                stamp_ns = stamp_of(reader.deserialize(data, type_name))
            records.append(Record(topic, type_name, bytes(data), received_ns, stamp_ns))
    return records


def first_sweeps(records, number):
    """Return the records up to the box message of a number."""
    ends = [i for i, record in enumerate(records) if record.boxes_stamp_ns is not None]
    return records[: ends[number - 1] + 1]


def publishers_for(graph, records):
    """Make a publisher for every topic of a recording."""
    for topic, type_name in {record.topic: record.type_name for record in records}.items():
        graph.publisher(type_name, topic, is_latched=topic == '/tf_static')


def play(graph, records, early=None):
    """
    Publish records as recorded bytes.

    With `early`, a list that fills with the early boxes of the node, each record after a box
    message waits until that message has been published by the node.

    """
    for record in records:
        graph.publishers[record.topic].publish(record.data)
        stamp_ns = record.boxes_stamp_ns
        if early is not None and stamp_ns is not None:
            graph.wait(
                lambda s=stamp_ns: any(stamp_of(m) == s for m in early), f'boxes of {stamp_ns} ns'
            )


def play_in_time(graph, records, rate):
    """Publish records at a rate of their times, and /clock, as ``ros2 bag play --clock 100``."""
    kind = import_message('rosgraph_msgs/msg/Clock')
    first_ns = records[0].received_ns
    begun = time.monotonic()
    for record in records:
        due = begun + (record.received_ns - first_ns) * 1e-9 / rate
        while True:
            now = time.monotonic()
            message = kind()
            now_ns = first_ns + round((min(now, due) - begun) * rate * 1e9)
            message.clock.sec, message.clock.nanosec = divmod(now_ns, 10**9)
            graph.publishers['/clock'].publish(message)
            if now >= due:
                break
            graph.executor.spin_once(timeout_sec=min(0.01, due - now))
        graph.publishers[record.topic].publish(record.data)


def numbers_changed(messages, records):
    """Return how many boxes of each message differ from those of the record with its number."""
    kind = import_message(DETECTIONS)
    given = [deserialize_message(r.data, kind) for r in records if r.type_name == DETECTIONS]
    pairs = zip(messages, given, strict=True)
    changes = [vision.from_msg(a).boxes - vision.from_msg(b).boxes for a, b in pairs]
    return [int((np.abs(change).max(1) > 1e-6).sum()) for change in changes]


def play_recording():
    """Play a recording in a process of its own, see `Graph.start_player`."""
    recording, topic, domain = sys.argv[1:]
    records = records_of(Path(recording), topic)
    player = Graph(Path(recording).parent, int(domain))
    publishers_for(player, records)
    player.wait_until_connected()
    for record in records:
        play(player, [record])
        time.sleep(0.02)
    # Messages that were lost are sent again while their publishers exist.
    signal.pause()
