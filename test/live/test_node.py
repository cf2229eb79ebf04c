"""The node as a process, over DDS."""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
import re
import signal
import subprocess
import sys
from threading import Event, Thread
import time

from boxreg_ros.config import Config, settings
from boxreg_ros.io.label_messages import from_text, LABELS_TYPE
from boxreg_ros.io.markers import BOX_NAMESPACES, MarkerBoard
from boxreg_ros.live.topics import import_message
from boxreg_ros.offline.calibrate import calibrated, GAPS, Measured, write_settings
from boxreg_ros.structures import BoxArray, COASTED, KEPT, REFINED, RefinedBoxes
from diagnostic_msgs.msg import DiagnosticStatus
from msg_adapters import markers, vision
import numpy as np
from preloaded import CODE, NODE, PreloadedProcess
import pytest
from rcl_interfaces.srv import GetParameters
from rclpy.parameter import parameter_value_to_python
from ros_graph import (
    ended_cleanly,
    first_sweeps,
    Graph,
    numbers_changed,
    play,
    publishers_for,
    QUICK,
    records_of,
    RELIABLE,
    ROOT,
    stamp_of,
)
from ros_messages import DETECTIONS, Drive, MARKERS, START

WITHOUT_TF2_MSGS = (
    'import sys; sys.modules["tf2_msgs"] = None\n'
    'from boxreg_ros.live.main import main\n'
    'sys.exit(main())'
)


def test_odometry_replaces_tf(graph, tmp_path):
    """Without tf2_msgs; the type of the boxes is found in the graph. Markers, diagnostics."""
    drive = Drive(sweeps=6, boxes='markers', motion='odometry')
    leaving = [item[2] for item in drive.items if item[0] == '/boxes'][4:]
    for message in leaving:
        del message.markers[1]
    drive.items = [item for item in drive.items if item[0] != '/tf_static']
    for _, _, message in drive.items:
        if hasattr(message, 'child_frame_id'):
            message.child_frame_id = 'lidar'
            message.pose.pose.position.z = 2.0
    records = records_of(drive.write(tmp_path / 'drive'))
    graph.publisher(MARKERS, '/boxes', is_reliable=False)
    shown = graph.collect(MARKERS, '/refined_markers')
    node = graph.run(
        [record for record in records if record.topic != '/boxes'],
        *QUICK,
        command=(CODE, WITHOUT_TF2_MSGS),
        kind=MARKERS,
    )
    node.play(records)
    graph.wait(lambda: len(shown) == 6 + 4, 'markers of early and final boxes')
    graph.wait(lambda: node.values().get('early_published') == '6', 'diagnostics')
    assert node.values()['fixed_frame'] == 'odom'
    assert int(node.values()['refined']) > 0
    levels = {message.status[0].message: message.status[0].level for message in node.diagnostics}
    assert levels.pop('refining') == DiagnosticStatus.OK
    assert all(text.startswith('nothing received') for text in levels), levels
    assert ended_cleanly(node)
    assert "fixed frame is 'odom'" in node.output()
    assert node.output().count('tf2_msgs') >= 1
    assert node.output().count('WARN') == 1, node.output()

    array = markers.from_msg(node.early[-1])
    assert array.frame_id == 'lidar' and array.track_ids == ('1',)
    assert shown[-1].markers[0].action == 3  # all are deleted when the node ends
    added = [{m.ns for m in message.markers if m.action == 0} for message in shown[:10]]
    assert added.count({'final'}) == 4
    shown = [message for message, ns in zip(shown, added, strict=False) if ns != {'final'}]
    assert [ns for ns in added if ns != {'final'}] == [set(BOX_NAMESPACES)] * 6
    colours = {(m.ns, m.color.g) for m in shown[3].markers if m.ns in ('input', 'refined')}
    assert len({green for _, green in colours}) == 2
    numbers = {m.text: m.id for m in shown[3].markers if m.ns == 'id'}
    assert numbers.keys() == {'1', '2'}
    deleted = [{m.id for m in message.markers if m.action == 2} for message in shown]
    assert deleted == [set(), set(), set(), set(), {numbers['2']}, set()]


def test_late_transforms_are_awaited_and_invalid_boxes_are_unchanged(graph, tmp_path):
    drive = Drive(sweeps=8)
    drive.replace(
        '/boxes', 3, lambda m: setattr(m.detections[0].bbox.center.position, 'x', np.nan)
    )
    drive.replace('/points', 4, lambda m: setattr(m, 'width', 10**6))
    records = records_of(drive.write(tmp_path / 'drive'))
    node = graph.run(records, *QUICK, '-p', 'transform_timeout:=20')
    moving = [record for record in records if record.topic == '/tf']
    play(graph, [record for record in records if record.topic != '/tf'])
    for _ in range(20):
        graph.executor.spin_once(timeout_sec=0.02)
    assert not node.early  # they wait for their transforms
    play(graph, moving)
    graph.wait(lambda: len(node.early) == 8, 'early boxes')
    graph.wait(lambda: node.values().get('unreadable') == '1', 'the unreadable cloud')
    assert ended_cleanly(node, signal.SIGTERM)
    assert 'unreadable' in node.output() and 'width' in node.output()
    assert [stamp_of(m) for m in node.early] == [stamp_of(m) for m in node.final] == drive.stamps
    # The invalid box is returned unchanged in its place.
    assert [d.id for d in node.final[3].detections] == ['1', '2']
    assert np.isnan(node.final[3].detections[0].bbox.center.position.x)
    for message in node.final:
        array = vision.from_msg(message)
        assert array.frame_id == 'lidar'
        ego = np.array([0.5 * drive.stamps.index(array.stamp_ns), 0, 2.0])
        error = array.boxes[:, :3] + ego - drive.truth[array.stamp_ns][:, :3]
        assert np.nanmax(np.abs(error)) < 0.4


def test_boxes_without_a_fixed_frame_are_published_unchanged(graph, tmp_path):
    drive = Drive(sweeps=4, boxes='vision', motion='none')
    path = drive.write(tmp_path / 'drive')
    records = records_of(path)
    node = graph.run(records, *QUICK, '-p', 'transform_timeout:=0.1')
    node.play(records)
    graph.wait(lambda: len(node.final) == 4, 'final boxes')
    given = [message for topic, _, message in drive.items if topic == '/boxes']
    for before, after in zip(given, node.final, strict=True):
        assert np.array_equal(vision.from_msg(before).boxes, vision.from_msg(after).boxes)
    assert ended_cleanly(node)
    assert 'fixed_frame:=base' in node.output()

    node.early.clear()
    node.final.clear()
    options = ('fixed_frame:=base', 'transform_timeout:=20.0', f'boxes_type:={DETECTIONS}')
    settings = [part for option in options for part in ('-p', option)]
    left = graph.endpoints()
    second = graph.start(*RELIABLE, *QUICK, *settings)
    graph.wait_until_connected(left)
    node.play(records)
    assert ended_cleanly(second)
    assert len(node.final) == 4
    assert 'WARN' not in second.output()
    refined = np.array([vision.from_msg(message).boxes for message in node.final])
    assert np.abs(refined - [vision.from_msg(message).boxes for message in given]).max() > 1e-4


SLOW_EVENTS = """
import sys, threading, time
notify = threading.Condition.notify_all
def slowly(self):
    if threading.get_ident() == threading.main_thread().ident:
        time.sleep(0.1)
    notify(self)
threading.Condition.notify_all = slowly
from boxreg_ros.live.main import main
sys.exit(main())
"""


def test_two_signals_end_the_node_cleanly_under_load(graph, tmp_path):
    records = records_of(Drive(sweeps=30).write(tmp_path / 'drive'))
    node = graph.run(records, *QUICK, command=(CODE, SLOW_EVENTS))
    is_over = Event()

    def flow():
        while not is_over.is_set():
            play(graph, records)
            time.sleep(0.01)

    player = Thread(target=flow)
    player.start()
    time.sleep(0.5)
    node.popen.send_signal(signal.SIGTERM)
    time.sleep(0.05)
    try:
        assert ended_cleanly(node)
    finally:
        is_over.set()
        player.join()


def test_first_readable_type_of_several_is_chosen(graph, tmp_path):
    """BoundingBox3DArray, first by name, has no ids; a second readable type is reported."""
    with ExitStack() as stack:  # one participant cannot publish a topic with several types

        def publish(type_name):
            other = Graph(tmp_path, graph.domain)
            stack.callback(other.close)
            other.publisher(type_name, '/boxes')

        publish('vision_msgs/msg/BoundingBox3DArray')
        publish(DETECTIONS)
        node = graph.start(*RELIABLE, *QUICK)
        graph.wait(lambda: f'boxes are {DETECTIONS}' in node.output(), 'a choice')
        assert 'set boxes_type' not in node.output()
        publish(MARKERS)
        graph.wait(lambda: f'{MARKERS}: set boxes_type' in node.output(), 'a warning')
        assert ended_cleanly(node)
    assert node.output().count('set boxes_type') == 1


def test_boxes_of_another_type_are_reported(graph):
    graph.publisher(MARKERS, '/boxes')
    node = graph.start('-p', f'boxes_type:={DETECTIONS}')
    graph.wait(lambda: 'restart the node' in node.output(), 'an error')
    assert f'expected messages of type {DETECTIONS}, got {MARKERS}' in node.output()
    assert ended_cleanly(node)


def test_best_effort_publisher_of_boxes_may_start_after_the_node(graph, tmp_path):
    """With BEST_AVAILABLE the QoS is chosen on subscription, when nobody publishes yet."""
    records = records_of(Drive(sweeps=4).write(tmp_path / 'drive'))
    publishers_for(graph, [record for record in records if record.topic != '/boxes'])
    early = graph.collect(DETECTIONS, '/refined_boxes')
    node = graph.start(*RELIABLE, *QUICK, '-p', f'boxes_type:={DETECTIONS}')
    graph.wait(lambda: graph.node.count_subscribers('/boxes') > 0, 'a subscription')
    graph.publisher(DETECTIONS, '/boxes', is_reliable=False)
    graph.wait_until_connected()
    play(graph, records, early)
    assert len(early) == 4
    assert ended_cleanly(node)
    assert 'qos_incompatible' not in node.output()


def test_wait_for_transforms_does_not_count_as_backlog(graph, tmp_path):
    # All clouds get their transforms at once, after more than `backlog`. Boxes arrive before the
    # first cloud, which determines the fixed frame.
    drive, records = thirty_stamps(tmp_path)
    options = ['transform_timeout:=60.0', 'queue:=100', 'backlog:=4.0', 'window:=4', 'lag:=2']
    options += ['solver.rounds:=1']  # on a busy machine, too, less than the wait for transforms
    node = graph.run(records, *[part for text in options for part in ('-p', text)])
    moving = [record for record in records if record.topic == '/tf']
    others = [record for record in records if record.topic != '/tf']
    others.sort(key=lambda record: record.topic)  # boxes before points
    play(graph, others)
    waited_from = time.monotonic() + 5.0

    def is_waiting():
        values = node.values()
        received = values.get('points_received'), values.get('boxes_received')
        return received == ('30', '30') and time.monotonic() > waited_from

    graph.wait(is_waiting, 'all messages but the transforms')
    assert not node.early
    play(graph, moving)
    values = wait_for_thirty_early_boxes(graph, node)
    assert int(values['refined']) > 50  # boxes held for `lag` = 2 stamps are not counted yet
    assert not {'points_queue_full', 'boxes_queue_full', 'no_transform'} & values.keys()
    assert ended_cleanly(node)
    assert [stamp_of(m) for m in node.early] == [stamp_of(m) for m in node.final] == drive.stamps


def test_empty_box_array_deletes_the_markers(graph, tmp_path):
    """An empty MarkerArray has no stamp: stamps are in its markers."""
    records = records_of(Drive(sweeps=4, boxes='markers').write(tmp_path / 'drive'))
    publishers_for(graph, records)
    early = graph.collect(MARKERS, '/refined_boxes')
    shown = graph.collect(MARKERS, '/refined_markers')
    node = graph.start(*RELIABLE, *QUICK, '-p', 'max_gap:=1000.0')  # else silence deletes them
    graph.wait_until_connected()
    play(graph, records, early)
    graph.wait(lambda: len(shown) == 4 + 2, 'markers of early and final boxes')
    graph.publishers['/boxes'].publish(import_message(MARKERS)())
    graph.wait(lambda: len(shown) == 7, 'no markers')
    assert [m.action for m in shown[-1].markers] == [3]
    assert ended_cleanly(node)


def thirty_stamps(tmp_path):
    """Return a drive of 30 stamps, and its records."""
    drive = Drive(sweeps=30)
    return drive, records_of(drive.write(tmp_path / 'drive'))


def wait_for_thirty_early_boxes(graph, node):
    """Wait until all 30 early boxes have arrived and are counted; return the counters."""
    graph.wait(lambda: len(node.early) == 30, 'early boxes')
    graph.wait(lambda: int(node.values().get('early_published', 0)) == 30, 'counters')
    return node.values()


SLOW_SOLVER = """
import sys, time
from boxreg_ros.core.registrar import BoxRegistrar
add_sweep = BoxRegistrar.add_sweep
def slowly(self, sweep):
    time.sleep(0.1)
    return add_sweep(self, sweep)
BoxRegistrar.add_sweep = slowly
from boxreg_ros.live.main import main
sys.exit(main())
"""


def test_each_early_box_has_a_status_and_each_array_its_times(graph, tmp_path):
    records = records_of(Drive(sweeps=6).write(tmp_path / 'drive'))
    status = graph.collect(LABELS_TYPE, '/refined_boxes_status')
    times = {
        name: graph.collect('std_msgs/msg/Float64', f'/boxreg_node/debug/{name}')
        for name in ('processing_time_ms', 'pipeline_latency_ms')
    }
    node = graph.run(records, *QUICK, '-p', f'boxes_type:={DETECTIONS}')
    node.play(records)
    graph.wait(lambda: len(status) == 6, 'the status of all boxes')
    content = [from_text(message.data).refined for message in status]
    assert [refined.boxes.stamp_ns for refined in content] == [stamp_of(m) for m in node.early]
    assert all(refined.status == ('refined', 'refined') for refined in content[3:])
    assert content[0].reasons == ('short_track', 'short_track')
    graph.wait(lambda: all(len(values) >= 5 for values in times.values()), 'the times')
    assert all(0 < message.data < 90e3 for message in times['processing_time_ms'])
    # The stamps of the drive are long ago.
    assert all(message.data > 90e3 for message in times['pipeline_latency_ms'])
    values = node.values()
    graph.wait(lambda: int(node.values().get('early_refined', 0)) >= 6, 'counters')
    assert 'early_budget' not in values
    assert ended_cleanly(node)


FIRST_START = """
import os, sys, time
from boxreg_ros.live import node
import numba
warm_up = node.warm_up
def compile_first(config, *others):
    if not others:
        numba.njit(lambda x: x + 1)(1)
        while not os.path.exists({compiled!r}):
            time.sleep(0.05)
    warm_up(config, *others)
node.warm_up = compile_first
from boxreg_ros.live.main import main
sys.exit(main())
"""


def test_boxes_pass_unchanged_while_the_solver_is_compiled(graph, tmp_path):
    records = records_of(Drive(sweeps=8).write(tmp_path / 'drive'))
    compiled = tmp_path / 'compiled'
    code = FIRST_START.format(compiled=str(compiled))
    follow = graph.publisher(DETECTIONS, '/boxreg_node/follow')
    node = graph.run(records, *QUICK, command=(CODE, code))
    passing = first_sweeps(records, 2)
    node.play(passing)
    follow.publish(passing[-1].data)
    graph.wait(lambda: 'still compiling: publish' in node.output(), 'an answer')
    assert 'once after an installation' in node.output()
    assert numbers_changed(node.early, passing) == [0, 0]
    graph.wait(lambda: node.values().get('compiling') == '2', 'the counter')
    compiled.touch()
    graph.wait(lambda: '2 messages of boxes passed unchanged' in node.output(), 'the solver')
    assert ' functions in ' in node.output()
    node.play(records[len(passing) :])
    assert sum(numbers_changed(node.early, records)[2:]) > 0
    assert ended_cleanly(node)


BUSY_SECOND = """
from boxreg_ros.io import warm_up as second
second.warm_up_others = lambda *_: time.sleep(60)
"""


def test_a_signal_ends_both_processes_that_compile(graph, tmp_path):
    code = 'import time' + BUSY_SECOND + FIRST_START.format(compiled=str(tmp_path / 'never'))
    node = graph.start(command=(CODE, code))
    graph.wait_until_discovered_by('/boxreg_node')
    assert 'once after an installation' in node.output()
    pid = node.popen.pid
    children = Path(f'/proc/{pid}/task/{pid}/children').read_text().split()
    assert children
    assert ended_cleanly(node)
    assert not [child for child in children if Path('/proc', child).exists()]


def test_boxes_that_wait_too_long_are_published_unchanged(graph, tmp_path):
    # Boxes wait ten times the backlog, 0.3 s. Each stamp takes a tenth of a second to solve,
    # while the boxes after it wait.
    drive, records = thirty_stamps(tmp_path)
    node = graph.run(records, '-p', 'backlog:=0.03', command=(CODE, SLOW_SOLVER))
    first = 1 + [record.boxes_stamp_ns for record in records].index(drive.stamps[3])
    node.play(records[:first])
    play(graph, records[first:])
    passed = int(wait_for_thirty_early_boxes(graph, node)['boxes_queue_full'])
    assert 0 < passed < 30
    assert 'boxes_queue_full' in node.output()
    assert ended_cleanly(node)
    assert sorted(map(stamp_of, node.early)) == sorted(map(stamp_of, node.final)) == drive.stamps


def test_overload_drops_clouds_but_no_boxes(graph, tmp_path):
    drive, records = thirty_stamps(tmp_path)
    slow = ('-p', 'solver.rounds:=40')
    node = graph.run(records, *slow, '-p', 'backlog:=0.2')
    play(graph, records)
    assert int(wait_for_thirty_early_boxes(graph, node)['points_queue_full']) > 5
    assert 'points_queue_full' in node.output()
    assert ended_cleanly(node)
    assert [stamp_of(m) for m in node.early] == [stamp_of(m) for m in node.final] == drive.stamps


def test_boxes_beyond_the_deadline_are_kept_and_no_cloud_is_dropped(graph, tmp_path):
    # Within a deadline of 1 ms one window a stamp is solved; the drive has two tracks.
    _, records = thirty_stamps(tmp_path)
    node = graph.run(records, *QUICK, '-p', 'deadline:=0.001')
    node.play(records)
    counts = wait_for_thirty_early_boxes(graph, node)
    assert not {'points_queue_full', 'boxes_queue_full'} & counts.keys()
    assert ended_cleanly(node)
    assert numbers_changed(node.early, records)[2:] == [1] * 28
    assert numbers_changed(node.final, records)[1:29] == [2] * 28  # by a window of the next stamp


WITHOUT_SPARE_TIME = """
import sys
from boxreg_ros.live.budget import TickBudget
TickBudget.spare_windows = lambda self: 0  # as on a slow machine
from boxreg_ros.live.main import main
sys.exit(main())
"""


def test_tracks_that_wait_are_solved_when_the_boxes_end(graph, tmp_path):
    drive, records = thirty_stamps(tmp_path)
    options = (*QUICK, '-p', 'deadline:=0.001')
    node = graph.run(records, *options, command=(CODE, WITHOUT_SPARE_TIME))
    node.play(records)
    graph.wait(lambda: len(node.final) == 30, 'final boxes after a silence')
    assert ended_cleanly(node)
    assert [stamp_of(m) for m in node.final] == drive.stamps
    assert numbers_changed(node.final, records)[1:] == [2] * 29


def test_a_node_without_any_parameter_refines_a_track_at_every_stamp(graph, tmp_path):
    """The default deadline leaves at least one window a stamp, on the slowest machine."""
    drive, records = thirty_stamps(tmp_path)
    node = graph.run(records, base=())
    node.play(records)
    counts = wait_for_thirty_early_boxes(graph, node)
    assert 0.0 < float(counts['deadline [ms]']) <= 1000.0
    assert not {'points_queue_full', 'boxes_queue_full'} & counts.keys()
    assert ended_cleanly(node)
    assert [stamp_of(m) for m in node.early] == [stamp_of(m) for m in node.final] == drive.stamps
    assert set(numbers_changed(node.early, records)[2:]) <= {1, 2}
    assert numbers_changed(node.final, records)[1:29] == [2] * 28


def test_messages_are_queued_while_the_process_is_suspended(graph, tmp_path):
    """The queue in DDS holds more clouds than the usual depth of sensor data."""
    drive, records = thirty_stamps(tmp_path)
    first = 1 + [record.boxes_stamp_ns for record in records].index(drive.stamps[14])
    node = graph.run(records, '-p', 'transform_timeout:=20', '-p', 'backlog:=60.0')
    node.popen.send_signal(signal.SIGSTOP)
    play(graph, records[:first])
    node.popen.send_signal(signal.SIGCONT)
    graph.wait(lambda: len(node.early) == 15, 'boxes of the first half')
    node.play(records[first:])
    counts = wait_for_thirty_early_boxes(graph, node)
    assert counts['points_received'] == counts['boxes_received'] == '30'
    assert counts.get('boxes_without_sweep', '0') == '0'
    assert ended_cleanly(node)
    assert [stamp_of(m) for m in node.early] == [stamp_of(m) for m in node.final] == drive.stamps


def test_waiting_boxes_are_published_at_shutdown(graph, tmp_path):
    drive, records = thirty_stamps(tmp_path)
    slow = ('-p', 'solver.rounds:=20', '-p', 'backlog:=60.0')
    node = graph.run(records, *slow, '-p', 'queue:=100')
    play(graph, records)
    graph.wait(lambda: len(node.early) >= 4, 'some boxes')
    assert len(node.early) < 20
    assert ended_cleanly(node)
    assert [stamp_of(m) for m in node.early] == [stamp_of(m) for m in node.final] == drive.stamps


def test_busy_solver_delays_neither_diagnostics_nor_shutdown(graph, tmp_path):
    records = records_of(Drive(sweeps=30).write(tmp_path / 'drive'))
    # The paper's objective is minimised by torch: some tenths of a second for each box array.
    slow = ['objective:=paper', 'paper.iterations:=100', 'window:=30']
    options = [part for text in (*slow, 'backlog:=60.0', 'queue:=100') for part in ('-p', text)]
    node = graph.run(records, *options)
    play(graph, records)
    graph.wait(lambda: len(node.early) >= 4, 'some boxes')
    graph.wait(lambda: len(node.diagnostics) >= 2, 'diagnostics while the solver runs')
    assert len(node.early) < 25
    assert ended_cleanly(node)


def test_calibrated_settings_are_read_as_parameters(graph, tmp_path):
    """Settings of every type that `boxreg calibrate` writes reach the running node."""
    changes = {
        'max_gap': 2, 'window': 8, 'paper.closeness': 1e-5, 'sampling.deskew': True,
        'mode': 'bev', 'vehicle.names': ['ute'], 'lag': 7,
    }  # fmt: skip
    gap = Measured(value=0.25, spread=0.01, tracks=9)
    measured = {f'cyclist.{name}': gap for name in GAPS} | {'cyclist.position': gap}
    values = calibrated(Config().updated(changes), measured)
    margins = tmp_path / 'margins.yaml'
    write_settings(margins, values, 'a test')
    node = graph.start('--params-file', str(margins))
    names = [item.name for item in settings()]
    request = GetParameters.Request(names=names)
    response = graph.call(GetParameters, '/boxreg_node/get_parameters', request)
    answer = map(parameter_value_to_python, response.values)
    defaults = {item.name: value for item, value in Config().items()}
    expected = {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in (defaults | values | {'estimate': 'final'}).items()
    }
    assert expected['cyclist.gap_ends'] == 0.25 and not expected['faces.learn']
    assert dict(zip(names, answer, strict=True)) == expected
    assert ended_cleanly(node)
    assert 'WARN' not in node.output()


@pytest.fixture(scope='module')
def refused(tmp_path_factory):
    """Start nodes with invalid arguments in parallel; return output and status of each."""
    cases = {
        'range': ['--ros-args', '-p', 'window:=2'],
        'boxes': ['--ros-args', '-p', 'boxes_type:=std_msgs/msg/String'],
        'type': ['--ros-args', '-p', 'boxes_type:=Detection3DArray'],
        'file': ['--ros-args', '--params-file', 'missing.yaml'],
        'qos': ['--ros-args', '-p', 'qos_overrides./points.subscription.depth:=deep'],
        'depth': ['--ros-args', '-p', 'qos_overrides./refined_markers.publisher.depth:=0'],
        'policy': ['--ros-args', '-p', 'qos_overrides./odom.subscription.reliability:=yes'],
        'deadline': ['--ros-args', '-p', 'deadline:=0'],
        'list': ['--ros-args', '-p', 'vehicle.names:=[]'],
        'loop': ['--ros-args', '-r', 'boxes:=refined_boxes'],
        'markers': ['--ros-args', '-r', 'boxes:=refined_markers'],
        'types': ['--ros-args', '-p', f'boxes_type:={DETECTIONS}', '-r', 'boxes:=points'],
        'model': ['--ros-args', '-p', 'input_model:=/nowhere/model.json'],
    }
    folder = tmp_path_factory.mktemp('refused')
    started = {
        name: PreloadedProcess(NODE, arguments, {}, folder / name)
        for name, arguments in cases.items()
    }
    statuses = {name: process.wait(60) for name, process in started.items()}
    return {name: ((folder / name).read_text(), status) for name, status in statuses.items()}


@pytest.mark.parametrize(
    'case, status, words',
    [
        ('range', 2, ('window', '3', 'got 2')),
        ('boxes', 1, ('std_msgs/msg/String', 'Detection3DArray')),
        ('type', 1, ("'Detection3DArray'", 'vision_msgs/msg/Detection3DArray')),
        ('file', 2, ('missing.yaml',)),
        ('qos', 2, ('./points.subscription.depth: expected a whole number', "got 'deep'")),
        ('depth', 2, ('qos_overrides./refined_markers.publisher.depth', 'from 1 to', 'got 0')),
        ('policy', 2, ('qos_overrides./odom.subscription.reliability', 'best_effort', 'got True')),
        ('deadline', 2, ('deadline', 'more than 0 s', 'got 0')),
        ('list', 2, ('vehicle.names', "['']")),
        ('loop', 2, ('boxes', "'/refined_boxes'", 'correct the remap')),
        ('markers', 2, ('boxes', "'/refined_markers'", 'correct the remap')),
        ('types', 2, ('boxes', "'/points'", 'which this node uses as points')),
        ('model', 2, ('input_model', "'/nowhere/model.json'", 'make the folder')),
    ],
)
def test_invalid_arguments_are_reported_in_one_line(refused, case, status, words):
    output, returned = refused[case]
    assert returned == status, output
    ours = [line for line in output.splitlines() if '[rcl]' not in line]  # rcl logs too
    assert len(ours) == 1, output
    for word in words:
        assert word in ours[0]


def boxes_of(*track_ids, x=0.0):
    n = len(track_ids)
    boxes = np.tile([x, 0, 0, 4, 2, 1.5, 0, 0, 0], (n, 1))
    return BoxArray(START, 'odom', track_ids, ('car',) * n, np.ones(n), boxes)


def refined_of(boxes, *status):
    n = len(boxes.track_ids)
    return RefinedBoxes(boxes, status, ('',) * n, np.zeros(n, int), np.tile(np.eye(6), (n, 1, 1)))


def test_markers_keep_one_id_per_track():
    board = MarkerBoard()
    given = boxes_of('a', 'b', '', '')
    assert not board.is_showing
    first = board.update(given, refined_of(given, REFINED, KEPT, KEPT, KEPT)).markers
    assert first.pop(0).action == 3  # deletes markers of an earlier node
    assert len({(m.ns, m.id) for m in first}) == len(first) == 20
    cubes = {m.id: m.color.r for m in first if m.ns == 'refined'}
    assert cubes[0] != cubes[1]
    given = boxes_of('c', 'b')
    given.boxes[0, 0] = np.nan  # NaN: viewers reject it
    second = board.update(given, refined_of(given, KEPT, KEPT)).markers
    assert {m.id for m in second if m.action == 0} == {1}
    assert {(m.ns, m.id) for m in second if m.action == 2} == {
        (ns, number) for ns in BOX_NAMESPACES for number in (0, 2, 3)
    }
    assert len(board.update(given, refined_of(given, KEPT, KEPT)).markers) == 5
    assert board.is_showing and board.clear() and not board.is_showing
    given.boxes[1, 4] = 0.0  # no width: viewers reject it
    assert not board.update(given, refined_of(given, KEPT, KEPT)).markers


def test_markers_of_final_boxes_and_of_boxes_without_time_have_their_own_colours():
    board = MarkerBoard()
    given = boxes_of('a', 'b', 'c')
    refined = refined_of(given, REFINED, KEPT, KEPT)
    refined = replace(refined, reasons=('', 'budget', 'no_points'))
    early = board.update(given, refined).markers
    colours = [(m.color.r, m.color.g, m.color.b) for m in early if m.ns == 'refined']
    assert len(set(colours)) == 3
    numbers = [m.id for m in board.update_finals(refined).markers]
    assert len(set(numbers)) == 3
    left = boxes_of('c')
    finals = board.update_finals(refined_of(left, REFINED)).markers
    assert [(m.ns, m.id, m.action) for m in finals] == [
        ('final', numbers[2], 0), ('final', numbers[0], 2), ('final', numbers[1], 2)
    ]  # fmt: skip
    assert not set(colours) & {(m.color.r, m.color.g, m.color.b) for m in finals}
    assert board.clear() and not board.is_showing


def test_a_coasted_box_has_a_colour_of_its_own_and_no_box_of_the_input():
    board = MarkerBoard()
    given = boxes_of('a', 'b')
    board.update(given, refined_of(given, REFINED, KEPT))
    refined = refined_of(boxes_of('b', 'a'), KEPT, COASTED)
    found = {(m.ns, m.id): m for m in board.update(boxes_of('b'), refined).markers}
    assert found['input', 1].action == 0
    assert found['input', 0].action == 2, 'deleted'
    assert found['refined', 0].action == 0
    assert found['refined', 0].color != found['refined', 1].color


def test_missing_ros_is_reported_with_a_remedy():
    code = 'import sys; sys.modules["rclpy"] = None; from boxreg_ros.cli import main; '
    process = subprocess.run(
        [sys.executable, '-c', f'{code}sys.exit(main(["node"]))'], cwd=ROOT, capture_output=True,
        text=True, timeout=60,
    )  # fmt: skip
    assert process.returncode == 1
    (line,) = process.stderr.splitlines()
    assert 'rclpy' in line and 'boxreg_ros[ros]' in line


SIGNAL_IN_DESTRUCTOR = """
import os, signal, sys
class Last:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == 'rclpy.executors':
            sys.meta_path.remove(self)
            Last()
sys.meta_path.insert(0, Finder())
from boxreg_ros.live.main import main
sys.exit(main())
"""


def test_signal_within_a_destructor_ends_the_process():
    """Imports run destructors, and an exception raised in one is lost."""
    process = subprocess.run(
        [sys.executable, '-c', SIGNAL_IN_DESTRUCTOR], cwd=ROOT, capture_output=True, timeout=60,
        text=True,
    )  # fmt: skip
    assert (process.returncode, process.stdout + process.stderr) == (0, '')


def wait_until_importing(process):
    """Wait until a process handles SIGTERM and has begun to load numba."""
    pid = process.pid
    while True:
        assert process.poll() is None
        status = Path(f'/proc/{pid}/status').read_text()
        caught = int(re.search(r'^SigCgt:\s*(\w+)', status, re.MULTILINE)[1], 16)
        is_loading = 'llvmlite' in Path(f'/proc/{pid}/maps').read_text()
        if caught >> (signal.SIGTERM - 1) & 1 and is_loading:
            return
        time.sleep(0.01)


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signal_during_start_up_ends_the_process_quietly(number):
    process = subprocess.Popen(
        [sys.executable, '-m', 'boxreg_ros.live.main'], cwd=ROOT, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    wait_until_importing(process)
    process.send_signal(number)
    output, _ = process.communicate(timeout=60)
    assert (process.returncode, output) == (0, '')
