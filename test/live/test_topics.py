"""Topics of the real node over DDS: QoS, types, silence and remaps in log and /diagnostics."""

from functools import partial
from threading import Event, Thread
import time
from types import SimpleNamespace

from boxreg_ros.live.boxes_type import BoxesTypeSearch
from boxreg_ros.live.diagnostics import Health
from boxreg_ros.live.polling import PolledClockNode
from boxreg_ros.live.topics import (
    Endpoint,
    import_message,
    mismatches,
    NodeTopics,
    qos_problems,
)
from diagnostic_msgs.msg import DiagnosticStatus
from msg_adapters.clouds import COMPRESSED_TYPE
from msg_adapters.convention import Convention
from preloaded import CODE, IMPATIENT_NODE
import pytest
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from ros_graph import (
    DIAGNOSTICS,
    ended_cleanly,
    play,
    publishers_for,
    QUICK,
    records_of,
    RELIABLE,
    UNKNOWN_NODE,
    values_of,
)
from ros_messages import DETECTIONS, Drive, MARKERS, ODOMETRY, POINTS, TF

CLOCK = 'rosgraph_msgs/msg/Clock'
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def topics_status(diagnostics):
    """Return the newest status of the topics."""
    if not diagnostics:
        return DiagnosticStatus()
    return diagnostics[-1].status[1]


def reported(graph, node, diagnostics, *parts):
    """Wait until log and /diagnostics hold a line with all parts; return that of the log."""

    def line_of(text):
        lines = text.splitlines()
        return next((line for line in lines if all(part in line for part in parts)), '')

    def is_reported():
        values = topics_status(diagnostics).values
        return line_of(node.output()) and line_of('\n'.join(item.value for item in values))

    graph.wait(is_reported, f'a report of {parts}')
    return line_of(node.output())


def subscribe(graph, type_name, topic, qos):
    """Subscribe and discard the messages."""
    graph.node.create_subscription(import_message(type_name), topic, lambda _: None, qos)


def test_no_executor_wakes_for_transforms_odometry_and_clock(graph):
    """They are taken when they are needed, all and in their order."""
    kinds = {'/tf': TF, '/odom': ODOMETRY, '/clock': CLOCK}
    for topic, kind in kinds.items():
        graph.publisher(kind, topic)
    node = PolledClockNode(
        'ours', context=graph.context, cli_args=['--ros-args', '-p', 'use_sim_time:=true']
    )
    topics = NodeTopics(node, Health(node.get_logger()))
    taken = []
    for topic in ('/tf', '/odom'):
        take = partial(lambda name, message, at_ns: taken.append((name, at_ns)), topic)
        qos = QoSProfile(depth=1000)
        topics.subscribe(Endpoint(kinds[topic], topic, qos, take, is_polled=True))
    executor = SingleThreadedExecutor(context=graph.context)
    executor.add_node(node)
    publishers = graph.publishers
    graph.wait(lambda: all(p.get_subscription_count() for p in publishers.values()), 'discovery')
    tf, odometry, clock = (import_message(kind)() for kind in kinds.values())
    seconds = []  # of CPU
    ended = Event()

    def spin():
        begun = time.thread_time()
        while not ended.is_set():
            executor.spin_once(timeout_sec=0.2)
        seconds.append(time.thread_time() - begun)

    thread = Thread(target=spin)
    thread.start()
    for k in range(300):
        publishers['/tf'].publish(tf)
        publishers['/odom'].publish(odometry)
        clock.clock.sec = k + 1
        publishers['/clock'].publish(clock)
        time.sleep(0.003)
    ended.set()
    thread.join()
    assert taken == []
    assert seconds[0] < 0.15  # a wait for one of them, or its events, takes all there is

    def is_complete():
        topics.poll()
        return len(taken) == 600 and node.get_clock().now().nanoseconds == 300 * 10**9

    graph.wait(is_complete, 'all messages')
    assert all(abs(time.monotonic_ns() - at_ns) < 60e9 for _, at_ns in taken)
    assert [name for name, _ in taken].count('/tf') == 300
    topics.close()
    node.destroy_node()
    executor.shutdown()


def test_each_qos_mismatch_is_reported_with_topic_policy_and_side(graph):
    graph.publisher(POINTS, '/points', is_reliable=False)
    subscribe(graph, DETECTIONS, '/refined_boxes_final', LATCHED)
    subscribe(graph, MARKERS, '/refined_markers', LATCHED)
    diagnostics = graph.collect(DIAGNOSTICS, '/diagnostics')
    node = graph.start(*RELIABLE, '-p', f'boxes_type:={DETECTIONS}')
    for parts in (
        ('/points: the publisher of /neighbour offers reliability best_effort',
         'requests reliable', 'qos_overrides./points.subscription.reliability to best_effort'),
        ('/refined_boxes_final: the subscription of /neighbour requests durability',
         'transient_local', 'offers volatile',
         'qos_overrides./refined_boxes_final.publisher.durability'),
        ('/refined_markers: the subscription of /neighbour requests durability transient_local',
         'qos_overrides./refined_markers.publisher.durability to transient_local'),
    ):  # fmt: skip
        assert '[ERROR]' in reported(graph, node, diagnostics, *parts)
    assert topics_status(diagnostics).level == DiagnosticStatus.ERROR
    graph.wait(lambda: values_of(diagnostics).get('qos_incompatible') == '3', 'three counts')
    assert ended_cleanly(node)


def test_qos_overrides_apply_to_markers_and_durability(graph):
    subscribe(graph, MARKERS, '/refined_markers', LATCHED)
    diagnostics = graph.collect(DIAGNOSTICS, '/diagnostics')
    overrides = {
        'refined_markers.publisher.durability': 'transient_local',
        'refined_markers.publisher.depth': 3,
        'points.subscription.durability': 'transient_local',
        'points.subscription.reliabilty': 'reliable',
    }
    options = [f'qos_overrides./{name}:={value}' for name, value in overrides.items()]
    options += [f'boxes_type:={DETECTIONS}', 'qos_overrides.points.subscription.depth:=1']
    node = graph.start(*[part for text in options for part in ('-p', text)])
    graph.wait(lambda: topics_status(diagnostics).values, 'diagnostics')
    values = {item.key: item.value for item in topics_status(diagnostics).values}
    assert values['publisher refined_markers'] == (
        f'/refined_markers [{MARKERS}] reliable transient_local keep_last 3'
    )
    assert 'best_effort transient_local' in values['subscription points']
    (info,) = graph.node.get_subscriptions_info_by_topic('/points')
    assert info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert ended_cleanly(node)
    (warning,) = [line for line in node.output().splitlines() if 'ignored' in line]
    assert 'qos_overrides./points.subscription.reliabilty, qos_overrides.points.' in warning
    assert 'markers' not in warning
    assert 'ERROR' not in node.output()


def test_wrong_message_type_is_reported(graph):
    graph.publisher(DETECTIONS, '/points')
    graph.publisher('std_msgs/msg/String', '/boxes')
    diagnostics = graph.collect(DIAGNOSTICS, '/diagnostics')
    node = graph.start()
    parts = (f'/points: expected messages of type {POINTS}', f'got {DETECTIONS} from /neighbour')
    assert '[ERROR]' in reported(graph, node, diagnostics, *parts)
    assert '[ERROR]' in reported(graph, node, diagnostics, '/boxes', 'std_msgs/msg/String')
    graph.node.destroy_publisher(graph.publishers.pop('/points'))
    graph.publisher(COMPRESSED_TYPE, '/points')
    remedy = f'set points_type:={COMPRESSED_TYPE}'
    assert '[ERROR]' in reported(graph, node, diagnostics, '/points', remedy)
    assert ended_cleanly(node)


def test_boxes_to_follow_of_another_type_or_on_another_topic_are_reported(graph):
    graph.publisher('std_msgs/msg/String', '/boxreg_node/follow')
    diagnostics = graph.collect(DIAGNOSTICS, '/diagnostics')
    node = graph.start('-p', f'boxes_type:={DETECTIONS}')
    text = f'/boxreg_node/follow: expected messages of type {DETECTIONS}, got std_msgs/msg/String'
    remedy = 'publish boxes to follow as the type of boxes'
    assert '[ERROR]' in reported(graph, node, diagnostics, text, remedy)
    graph.node.destroy_publisher(graph.publishers.pop('/boxreg_node/follow'))
    graph.publisher(DETECTIONS, '/boxreg/follow')
    parts = ('/boxreg/follow: nobody subscribes to it', 'follow on /boxreg_node/follow')
    assert '[WARN]' in reported(graph, node, diagnostics, *parts)
    assert ended_cleanly(node)


def test_mistyped_remaps_are_reported_with_the_existing_topics(graph):
    graph.publisher(POINTS, '/lidar/points')
    graph.publisher(DETECTIONS, '/tracker/boxes')
    diagnostics = graph.collect(DIAGNOSTICS, '/diagnostics')
    remaps = ('points:=/lidar/pionts', 'boxes:=/tracker/boxs', 'odom:=/odometry')
    arguments = [part for text in remaps for part in ('-r', text)]
    node = graph.start(*arguments, command=(IMPATIENT_NODE,))
    for name, candidate in (
        ('/lidar/pionts', '/lidar/points'),
        ('/tracker/boxs', '/tracker/boxes'),
        ('/odometry', 'none'),
    ):
        parts = (f'{name}: nobody publishes it', f'fitting type: {candidate}; check the remap')
        assert '[WARN]' in reported(graph, node, diagnostics, *parts)
    assert topics_status(diagnostics).level == DiagnosticStatus.WARN
    assert ended_cleanly(node)


def test_another_publisher_of_the_refined_boxes_is_reported(graph):
    diagnostics = graph.collect(DIAGNOSTICS, '/diagnostics')
    node = graph.start('-p', f'boxes_type:={DETECTIONS}')
    graph.wait(lambda: topics_status(diagnostics), 'the state of the topics')
    assert 'alone' not in topics_status(diagnostics).message
    graph.publisher(DETECTIONS, '/refined_boxes_final')  # as a player of a recording does
    parts = ('/refined_boxes_final: expected this node alone', '/boxreg_node, /neighbour')
    assert '[WARN]' in reported(graph, node, diagnostics, *parts)
    assert '/refined_boxes: ' not in topics_status(diagnostics).message
    assert ended_cleanly(node)


def test_outputs_of_another_node_are_not_taken_for_inputs(graph):
    graph.publisher(DETECTIONS, '/tracks')
    diagnostics = graph.collect(DIAGNOSTICS, '/third/diagnostics')
    first = graph.start('-p', f'boxes_type:={DETECTIONS}')
    graph.wait(lambda: graph.node.count_publishers('/refined_boxes') == 1, 'the first node')
    mistyped = ('-r', '__ns:=/second', '-r', 'boxes:=/track', '-p', f'boxes_type:={DETECTIONS}')
    second = graph.start(*mistyped, command=(IMPATIENT_NODE,))
    chained = ('-r', '__ns:=/third', '-r', 'boxes:=/refined_boxes')
    third = graph.start(*chained, '-r', '/diagnostics:=/third/diagnostics')
    parts = ('/refined_boxes', 'refined boxes of /boxreg_node', 'set boxes_type')
    assert '[WARN]' in reported(graph, third, diagnostics, *parts)
    proposal = '/track: nobody publishes it; published topics of a fitting type: /tracks;'
    graph.wait(lambda: proposal in second.output(), 'a proposal')
    assert 'boxes are' not in third.output()
    assert all(ended_cleanly(node) for node in (first, second, third))


class DiscoveredPart:
    """A node that has discovered a publisher of boxes, and of its node not all."""

    def __init__(self):
        self.name = UNKNOWN_NODE
        self.services = []
        self.writers = []

    def get_publishers_info_by_topic(self, topic):
        return [SimpleNamespace(topic_type=DETECTIONS, node_name=self.name, node_namespace='/')]

    def get_service_names_and_types_by_node(self, name, namespace):
        if name == UNKNOWN_NODE:
            raise RuntimeError(name)
        return [(service, []) for service in self.services]

    def get_publisher_names_and_types_by_node(self, name, namespace, no_demangle):
        assert no_demangle
        return [(writer, []) for writer in self.writers]


@pytest.fixture
def discovered():
    """Return what is discovered, and a search for the type of boxes that was made long ago."""
    discovered = DiscoveredPart()
    search = BoxesTypeSearch(NodeTopics(discovered, Health(None)), '/boxes', Convention())
    search._since -= 60.0
    return discovered, search


def test_boxes_of_a_node_not_yet_discovered_are_awaited(discovered):
    part, search = discovered
    assert [search.step() for _ in range(3)] == [''] * 3
    (problem,) = search.problems()
    assert problem.text.startswith('/boxes: its publishers belong to no known node; set boxes_t')
    part.name, part.services = 'tracker', ['/tracker/get_parameters']
    assert [search.step() for _ in range(2)] == ['', DETECTIONS]


@pytest.mark.parametrize('known', ['requests', 'responses', 'one of each'])
def test_refined_boxes_are_known_by_either_half_of_the_services(discovered, known):
    part, search = discovered
    names = ['/boxreg_node/reset', '/boxreg_node/save_config']
    part.name = 'boxreg_node'
    part.services = {'requests': names, 'responses': [], 'one of each': names[:1]}[known]
    part.writers = [f'rr{name}Reply' for name in names if name not in part.services]
    assert [search.step() for _ in range(3)] == [''] * 3
    (problem,) = search.problems()
    assert 'nothing but the refined boxes of /boxreg_node' in problem.text


def test_silent_publishers_are_reported_until_they_publish(graph):
    publisher = graph.publisher(POINTS, '/points')
    diagnostics = graph.collect(DIAGNOSTICS, '/diagnostics')
    node = graph.start(command=(IMPATIENT_NODE,))
    parts = ('/points: nothing received yet from /neighbour',)
    assert '[WARN]' in reported(graph, node, diagnostics, *parts)
    cloud = import_message(POINTS)()
    cloud.header.frame_id = 'lidar'
    publisher.publish(cloud)

    def is_forgotten():
        return '/points: nothing' not in topics_status(diagnostics).message

    graph.wait(is_forgotten, 'a status without it')
    assert node.output().count(parts[0]) == 1
    assert ended_cleanly(node)


WITH_TF2_ROS = """
import sys
from types import SimpleNamespace
listener = SimpleNamespace(unregister=lambda: None)
sys.modules['tf2_ros'] = SimpleNamespace(TransformListener=lambda buffer, node: listener)
from boxreg_ros.live.main import main
sys.exit(main())
"""
"""The node beside another package that could subscribe to /tf in its place."""


def test_start_up_line_names_resolved_topics_with_type_and_qos(graph):
    remaps = ('-r', '__ns:=/front', '-r', 'points:=/lidar/points', '-r', '__node:=refiner')
    node = graph.start(*remaps, '-p', f'boxes_type:={DETECTIONS}', command=(CODE, WITH_TF2_ROS))
    graph.wait(lambda: 'boxes are' in node.output(), 'the start-up line')
    # The outputs exist before anything is published.
    for topic in ('refined_boxes', 'refined_boxes_final', 'refined_markers'):
        graph.wait(lambda t=topic: graph.node.count_publishers(f'/front/{t}') == 1, topic)
    assert ended_cleanly(node)
    (line,) = (line for line in node.output().splitlines() if 'boxes are' in line)
    for part in (
        'front.refiner',
        f'/lidar/points [{POINTS}] best_effort volatile keep_last 40',
        f'/front/boxes [{DETECTIONS}] best_available volatile keep_last',
        '/front/odom [nav_msgs/msg/Odometry] best_effort',
        '/tf [tf2_msgs/msg/TFMessage] reliable volatile',
        '/tf_static [tf2_msgs/msg/TFMessage] reliable transient_local',
        f'/front/refined_boxes [{DETECTIONS}] reliable volatile',
        f'/front/refined_boxes_final [{DETECTIONS}] reliable volatile',
        f'/front/refined_markers [{MARKERS}] reliable volatile keep_last 10',
    ):
        assert part in line


ADAPTER_WITH_A_BUG = """
import sys
from msg_adapters.serialized import SerializedAdapter
def from_msg(self, message):
    return {}['a bug']
SerializedAdapter.from_msg = from_msg
from boxreg_ros.live.main import main
sys.exit(main())
"""


def test_internal_errors_while_decoding_count_as_failed(graph, tmp_path):
    records = records_of(Drive(sweeps=4).write(tmp_path / 'drive'))
    publishers_for(graph, records)
    early = graph.collect(DETECTIONS, '/refined_boxes')
    diagnostics = graph.collect(DIAGNOSTICS, '/diagnostics')
    options = ('--log-level', 'boxreg_node:=debug')
    node = graph.start(*RELIABLE, *QUICK, *options, command=(CODE, ADAPTER_WITH_A_BUG))
    graph.wait_until_connected()
    play(graph, records, early)  # boxes are published unchanged
    graph.wait(lambda: values_of(diagnostics).get('failed') == '4', 'counters')
    assert 'unreadable' not in values_of(diagnostics)
    node.stop()
    lines = node.output().splitlines()
    (error,) = (line for line in lines if '[ERROR]' in line)
    assert "failed: KeyError: 'a bug'" in error
    (traceback, *_) = (i for i, line in enumerate(lines) if 'Traceback' in line)
    assert '[DEBUG]' in lines[traceback]
    assert 'in from_msg' in '\n'.join(lines[traceback : traceback + 10])


@pytest.mark.parametrize(
    ('policy', 'offered', 'requested'),
    [
        ('reliability', ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE),
        ('durability', DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL),
        ('liveliness', LivelinessPolicy.AUTOMATIC, LivelinessPolicy.MANUAL_BY_TOPIC),
        ('deadline', Duration(seconds=2), Duration(seconds=1)),
        ('deadline', Duration(), Duration(seconds=1)),
        ('liveliness_lease_duration', Duration(seconds=2), Duration(seconds=1)),
    ],
)
def test_a_policy_mismatches_in_one_direction_only(policy, offered, requested):
    weak = QoSProfile(depth=1, **{policy: offered})
    strong = QoSProfile(depth=1, **{policy: requested})
    assert [name for name, *_ in mismatches(weak, strong)] == [policy]
    assert not mismatches(strong, weak)
    assert not mismatches(weak, weak)
    peer = SimpleNamespace(qos_profile=weak, node_name='lidar', node_namespace='/')
    (problem,) = qos_problems(Endpoint(POINTS, 'points', strong, print), [peer])
    assert ('qos_overrides' in problem.text) == (policy in ('reliability', 'durability'))


def test_transforms_of_a_robot_in_a_namespace_are_named(graph):
    graph.publisher(TF, '/r1/tf')
    diagnostics = graph.collect(DIAGNOSTICS, '/diagnostics')
    node = graph.start(*RELIABLE, '-p', f'boxes_type:={DETECTIONS}')
    parts = '/tf: nobody publishes it', '/r1/tf', '-r /tf:=/r1/tf -r /tf_static:=/r1/tf_static'
    reported(graph, node, diagnostics, *parts)
