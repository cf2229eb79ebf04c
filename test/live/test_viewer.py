"""A live run, recorded to MCAP as `ros2 bag record` does, and opened by a viewer's library."""

from collections import Counter
import json
from typing import NamedTuple

from boxreg_ros.io.markers import CYAN, GREEN, NAMESPACES, TRANSLUCENT_GREY, YELLOW
from boxreg_ros.live.topics import import_message
from consumers import consumer
import numpy as np
from paths import BAGS, SHARE
import pytest
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from ros_graph import DIAGNOSTICS, first_sweeps, graph_in, QUICK, Record, records_of
from ros_messages import DETECTIONS, MARKERS, POINTS, TF, typestore
from rosbags.rosbag2 import StoragePlugin, Writer
import yaml

INPUTS = {'/points': POINTS, '/tf': TF, '/detections': DETECTIONS}
OUTPUTS = {
    '/refined_boxes': DETECTIONS, '/refined_boxes_final': DETECTIONS,
    '/refined_markers': MARKERS, '/diagnostics': DIAGNOSTICS,
}  # fmt: skip
TOPICS = {**INPUTS, **OUTPUTS}
SWEEPS = 6
LAG = 2
SHORT = 'deadline:=0.001'
"""A deadline with which no machine solves all tracks at each stamp."""
ADD, DELETE, DELETEALL = 0, 2, 3


class Run(NamedTuple):
    """The file of a run, its records, and the topics that other nodes saw published."""

    path: str
    records: list
    published: set


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp('run')
    records = first_sweeps(records_of(BAGS / 'street.mcap', '/detections'), SWEEPS)
    taken = []
    with graph_in(folder) as graph:
        for topic in OUTPUTS:
            record_topic(graph, topic, taken)
        node = graph.run(
            records, *QUICK, '-p', SHORT, '-p', 'transform_timeout:=20.0', '-r',
            'boxes:=detections',
            '-p', 'qos_overrides./points.subscription.reliability:=reliable', base=(),
        )  # fmt: skip
        for topic in INPUTS:  # until now, the subscribers of its topics were those of the node
            record_topic(graph, topic, taken)
        node.play(records)
        graph.wait(lambda: is_complete(taken), 'markers of all boxes')
        published = {topic for topic, _ in graph.node.get_topic_names_and_types()}
    return Run(write(folder / 'bag', taken), taken, published)


def record_topic(graph, topic, taken):
    """Subscribe to a topic; its messages are appended to `taken`, as bytes."""

    def take(data):
        received_ns = graph.node.get_clock().now().nanoseconds
        taken.append(Record(topic, TOPICS[topic], data, received_ns, None))

    kind = import_message(TOPICS[topic])
    graph.node.create_subscription(kind, topic, take, QoSProfile(depth=1000), raw=True)


def messages(records, topic):
    """Return the messages on a topic."""
    kind = import_message(TOPICS[topic])
    return [deserialize_message(record.data, kind) for record in records if record.topic == topic]


def is_complete(records):
    """Return whether all boxes are shown."""
    markers = [m for array in messages(records, '/refined_markers') for m in array.markers]
    stamps = {(m.ns, m.header.stamp.sec, m.header.stamp.nanosec) for m in markers if m.ns}
    number = Counter(ns for ns, *_ in stamps)
    diagnostics = messages(records, '/diagnostics')
    # The last LAG follow once the boxes have been silent.
    enough = number['refined'] == SWEEPS and number['final'] >= SWEEPS - LAG
    finals = messages(records, '/refined_boxes_final')
    return enough and len(finals) == number['final'] and bool(diagnostics)


def write(folder, records):
    """Write records as a recording of MCAP and return its file."""
    store = typestore()
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {
            topic: writer.add_connection(topic, name, typestore=store)
            for topic, name in TOPICS.items()
        }
        for record in records:
            writer.write(connections[record.topic], record.received_ns, record.data)
    (path,) = folder.glob('*.mcap')
    return path


def values_of(marker):
    """Return what `consumers.live_run` returns of a marker."""
    position, scale, colour = marker.pose.position, marker.scale, marker.color
    return {
        'ns': marker.ns, 'id': marker.id, 'action': marker.action, 'text': marker.text,
        'frame': marker.header.frame_id,
        'position': [position.x, position.y, position.z],
        'scale': [scale.x, scale.y, scale.z],
        'colour': [colour.r, colour.g, colour.b, colour.a],
    }  # fmt: skip


def shown_at_the_end(arrays):
    """
    Return the markers that a viewer shows after all arrays, by namespace and number.

    The recording may begin so late that the boxes have been silent for seconds, and the node has
    removed theirs: they are what it showed until then.

    """
    shown, before = {}, {}
    for marker in (marker for array in arrays for marker in array):
        key = marker['ns'], marker['id']
        if marker['action'] == DELETEALL:
            shown, before = {}, shown
        elif marker['action'] == DELETE:
            shown.pop(key, None)
        else:
            shown[key] = marker
    return {**before, **shown}


@pytest.fixture(scope='module')
def opened(run):
    return consumer('live_run', run.path)


def test_viewer_decodes_every_message_of_a_live_run(run, opened):
    assert opened['messages'] == Counter(record.topic for record in run.records)
    published = [
        [values_of(marker) for marker in array.markers]
        for array in messages(run.records, '/refined_markers')
    ]
    assert opened['markers'] == published
    sizes = [cloud.width * cloud.height for cloud in messages(run.records, '/points')]
    assert [cloud['number'] for cloud in opened['clouds']] == sizes


def test_viewer_shows_the_boxes_among_their_points(run, opened):
    shown = shown_at_the_end(opened['markers'])
    boxes = messages(run.records, '/refined_boxes')[-1].detections
    number = Counter(ns for ns, _ in shown)
    finals = len(messages(run.records, '/refined_boxes_final')[-1].detections)
    assert number == {**dict.fromkeys(NAMESPACES, len(boxes)), 'final': finals}
    low = np.min([cloud['low'] for cloud in opened['clouds']], axis=0)
    high = np.max([cloud['high'] for cloud in opened['clouds']], axis=0)
    centres = np.array([m['position'] for (ns, _), m in shown.items() if ns in ('input', 'final')])
    assert ((low < centres) & (centres < high)).all()
    assert {m['frame'] for m in shown.values()} == {'lidar'}


def test_colours_show_what_was_done(opened):
    shown = shown_at_the_end(opened['markers'])
    colours = {ns: Counter() for ns, _ in shown}
    for (ns, _), marker in shown.items():
        colours[ns][tuple(round(value, 3) for value in marker['colour'])] += 1
    number = sum(colours['refined'].values())
    assert colours['input'] == {TRANSLUCENT_GREY: number}
    solved = colours['refined'][GREEN]
    assert 0 < solved < number
    assert colours['refined'] == {GREEN: solved, YELLOW: number - solved}
    assert colours['final'].keys() == {CYAN}
    discs = [m['scale'][0] for (ns, _), m in shown.items() if ns == 'covariance']
    assert np.count_nonzero(np.array(discs) > 0.01) == solved  # only of refined boxes


def test_views_show_published_topics(run):
    foxglove = json.loads((SHARE / 'foxglove.json').read_text(encoding='utf-8'))
    panels = foxglove['configById']
    topics = {*panels['3D!boxes']['topics'], '/rosout'}
    topics |= {panel['topicToRender'] for panel in panels.values() if 'topicToRender' in panel}
    rviz = yaml.safe_load((SHARE / 'boxreg.rviz').read_text(encoding='utf-8'))
    displays = rviz['Visualization Manager']['Displays']
    topics |= {'/' + item['Topic']['Value'] for item in displays if 'Topic' in item}
    assert topics == {'/points', '/refined_markers', '/diagnostics', '/rosout'}
    assert topics <= run.published
