"""
`measure node`: latency and memory of the live node under load, over DDS.

Publisher, node and observer each run in a process of their own. The publisher simulates cars that
drive in circles around a sensor; track ids are renewed as in traffic. Latency is the time from
publishing the later of cloud and boxes until the refined boxes arrive at the observer.

"""

import argparse
from contextlib import contextmanager, ExitStack
from functools import partial
import os
from pathlib import Path
import signal
import struct
import subprocess
from tempfile import TemporaryDirectory
from threading import Event, Thread
import time

from boxreg_ros.errors import BoxregError
from boxreg_ros.structures import LENGTH, ROLL, YAW
from measure import MEASURE
from measure.common import BOXREG
import numpy as np
from paths import SHARE
from ros_messages import Messages, POINTS

PROFILE = SHARE / 'fastdds.xml'
CIRCLE_PERIOD = 5.0  # time until a car is back where it began [s]
TRACK_LIFETIME = 200  # sweeps until a track gets a new id
STARTUP_TIME = 5.0  # not measured at the beginning [s]
CAR_EXTENT = (4.5, 1.9, 1.6)  # length, width and height of every car [m]
CAR_SPACING = 14.0  # of the centres of the circles [m]
CIRCLE_RADIUS = 4.0  # [m]
POINTS_PER_CAR = 300
ROAD_SIZE = 160.0  # side of the square with the other points [m]
BOX_ERRORS = (0.1, 0.1, 0.05, 0.1, 0.1, 0.1, 0.0, 0.0, 0.03)  # standard deviations [m, rad]
CDR_HEADER = 4  # bytes before the first member of a serialised message
FIRST_MARKER = 8  # bytes before the first marker: the header and the length of the list
SETTLED_AFTER = 60.0  # queues, pools of memory and the heap have their size by then [s]
LAST_TIME = 30.0  # wait for the last messages, on a busy machine [s]
SAMPLE_PERIOD = 1.0  # of memory, handles, threads and CPU time of the node [s]
ARGUMENTS = {
    '--tracks': (64, ''),
    '--points': (130000, 'per sweep'),
    '--rate': (10.0, 'rate of the sensor [Hz]'),
    '--seconds': (60.0, 'seconds of data'),
    '--delay': (0.05, 'delay of the boxes after their cloud'),
    '--motion': (0.0, 'rate of further odometry, and of TF of another robot [Hz]'),
    '--clock': (0.0, 'rate of /clock, with use_sim_time [Hz]'),
    '--transport': (
        'large',
        'shared memory of share/fastdds.xml',
        {'choices': ('large', 'default')},
    ),
    '--set': ([], 'parameter of the node', {'metavar': 'KEY:=VALUE', 'action': 'append'}),
    '--role': (str, argparse.SUPPRESS, {'choices': ('publish',)}),
    '--log': (Path, argparse.SUPPRESS),
}


def run(args):
    """Return what was measured; a process with a role returns nothing."""
    try:
        import rclpy  # noqa: F401
    except ImportError as error:
        raise BoxregError(f'{error}: source a ROS 2 installation') from None
    if args.role:
        return publish(args)
    return measure(args)


# ---------------------------------------------------------------- process of the publisher


def true_boxes(args, turn):
    """Return the true boxes (n, 9) of a sweep, in the sensor frame."""
    side = int(np.ceil(np.sqrt(args.tracks)))
    index = np.arange(args.tracks)
    phase = 2 * np.pi * (turn / (CIRCLE_PERIOD * args.rate) + index / args.tracks)
    boxes = np.zeros((args.tracks, 9))
    boxes[:, 0] = CAR_SPACING * (index % side - side / 2) + CIRCLE_RADIUS * np.sin(phase) + 5.0
    boxes[:, 1] = CAR_SPACING * (index // side - side / 2) - CIRCLE_RADIUS * np.cos(phase) + 5.0
    boxes[:, LENGTH:ROLL] = CAR_EXTENT
    boxes[:, YAW] = phase
    return boxes


def scene(args, turn, rng):
    """Return the points (M, 3) and noisy boxes (n, 9) of a sweep, in the sensor frame."""
    boxes = true_boxes(args, turn)
    phase = boxes[:, YAW]
    # Cars make at most half of the points, as in `measure speed`.
    points_per_car = min(POINTS_PER_CAR, args.points // (2 * args.tracks))
    local = rng.uniform(-0.5, 0.5, (args.tracks, points_per_car, 3))  # (n, points, xyz)
    near = -np.sign(boxes[:, :2])  # the end and the side that roughly face the sensor
    half = points_per_car // 2
    local[:, :half, 0] = 0.49 * near[:, :1]
    local[:, half:, 1] = 0.49 * near[:, 1:]
    local *= np.array(CAR_EXTENT)
    cos = np.cos(phase)[:, None]
    sin = np.sin(phase)[:, None]
    x = cos * local[..., 0] - sin * local[..., 1]
    y = sin * local[..., 0] + cos * local[..., 1]
    points = np.stack([x, y, local[..., 2]], axis=-1) + boxes[:, None, :3]
    rest = max(0, args.points - points[..., 0].size)
    road = rng.uniform(-ROAD_SIZE / 2, ROAD_SIZE / 2, (rest, 3))
    road[:, 2] = -CAR_EXTENT[2] / 2
    noisy = boxes + np.array(BOX_ERRORS) * rng.normal(0, 1, boxes.shape)
    return np.concatenate([points.reshape(-1, 3), road]), noisy


def publish(args):
    """Publish in real time; log stamp and time of publishing of every box array [ns]."""
    from nav_msgs.msg import Odometry
    import rclpy
    from rclpy.duration import Duration
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import PointCloud2
    from visualization_msgs.msg import MarkerArray

    rng = np.random.default_rng(0)
    scenes = [scene(args, turn, rng) for turn in range(round(CIRCLE_PERIOD * args.rate))]
    clouds = [_cloud_bytes(points) for points, _ in scenes]
    arrays = [_marker_array(boxes) for _, boxes in scenes]
    rclpy.init(args=[])
    node = rclpy.create_node('measure_publisher')
    best_effort = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    to_points = node.create_publisher(PointCloud2, 'points', best_effort)
    turns = round(args.seconds * args.rate)
    # All are kept until they are received: a busy node is late, and misses none.
    to_boxes = node.create_publisher(MarkerArray, 'boxes', turns)
    to_odom = node.create_publisher(Odometry, 'odom', 50)
    while not all(p.get_subscription_count() for p in (to_points, to_boxes, to_odom)):
        time.sleep(0.1)
    odometry = Odometry(child_frame_id='lidar')
    odometry.header.frame_id = 'odom'
    ended = Event()
    _start_streams(args, node, to_odom, ended)
    period_ns = 1e9 / args.rate
    begin_ns = time.time_ns()
    with args.log.open('w') as log:
        for turn in range(turns):
            stamp_ns = begin_ns + round(turn * period_ns)
            _sleep_until(stamp_ns)
            stamp = divmod(stamp_ns, 10**9)
            odometry.header.stamp.sec, odometry.header.stamp.nanosec = stamp
            to_odom.publish(odometry)
            cloud = clouds[turn % len(clouds)]
            struct.pack_into('<iI', cloud, CDR_HEADER, *stamp)
            to_points.publish(bytes(cloud))
            array = arrays[turn % len(arrays)]
            _set_ids_and_stamp(array, turn, stamp)
            message = serialize_message(array)  # 12 ms for 1,024 boxes, which a tracker spends
            _sleep_until(stamp_ns + round(args.delay * 1e9))
            moment_ns = time.monotonic_ns()
            to_boxes.publish(message)
            log.write(f'{stamp_ns} {moment_ns}\n')
    ended.set()
    to_boxes.wait_for_all_acked(Duration(seconds=LAST_TIME))
    node.destroy_node()
    rclpy.shutdown()


def _start_streams(args, node, to_odom, ended):
    """Publish odometry, TF and /clock at their rates in threads, until an event is set."""
    from geometry_msgs.msg import TransformStamped
    from nav_msgs.msg import Odometry
    from rosgraph_msgs.msg import Clock
    from tf2_msgs.msg import TFMessage

    def repeat(rate, messages):
        due = time.monotonic()
        while not ended.is_set():
            for publisher, message, stamp in messages:
                stamp.sec, stamp.nanosec = divmod(time.time_ns(), 10**9)
                publisher.publish(message)
            due += 1 / rate
            time.sleep(max(0.0, due - time.monotonic()))

    transform = TransformStamped(child_frame_id='lidar_of_another')
    transform.header.frame_id = 'another'
    odometry = Odometry(child_frame_id='lidar')
    odometry.header.frame_id = 'odom'
    clock = Clock()
    to_tf = node.create_publisher(TFMessage, '/tf', 100)
    to_clock = node.create_publisher(Clock, '/clock', 1)
    motion = [
        (to_tf, TFMessage(transforms=[transform]), transform.header.stamp),
        (to_odom, odometry, odometry.header.stamp),
    ]
    for rate, messages in (
        (args.motion, motion),
        (args.clock, [(to_clock, clock, clock.clock)]),
    ):
        if rate:
            Thread(target=repeat, args=(rate, messages), daemon=True).start()


def _set_ids_and_stamp(array, turn, stamp):
    """Set the stamp of all markers of a sweep, and their ids, each new after `TRACK_LIFETIME`."""
    tracks = len(array.markers)
    for i, marker in enumerate(array.markers):
        renewals = (turn + i * TRACK_LIFETIME // tracks) // TRACK_LIFETIME
        marker.id = i + tracks * renewals
        marker.header.stamp.sec, marker.header.stamp.nanosec = stamp


def _sleep_until(moment_ns):
    time.sleep(max(0.0, (moment_ns - time.time_ns()) * 1e-9))


def _cloud_bytes(points):
    """Return points (M, 3) as a serialised PointCloud2 with x, y, z and intensity."""
    messages = Messages()
    columns = [
        *zip('xyz', ['f4'] * 3, points.T, strict=True),
        ('intensity', 'f4', np.zeros(len(points))),
    ]
    return bytearray(messages.store.serialize_cdr(messages.cloud(0, 'lidar', columns), POINTS))


def _marker_array(boxes):
    """Return boxes (n, 9) as a MarkerArray of CUBE markers."""
    from msg_adapters.poses import quaternions_of
    from visualization_msgs.msg import Marker, MarkerArray

    markers = []
    for box, quaternion_xyzw in zip(boxes.tolist(), quaternions_of(boxes).tolist(), strict=True):
        marker = Marker(type=Marker.CUBE, ns='car')
        marker.header.frame_id = 'lidar'
        position = marker.pose.position
        orientation = marker.pose.orientation
        position.x, position.y, position.z = box[:3]
        orientation.x, orientation.y, orientation.z, orientation.w = quaternion_xyzw
        marker.scale.x, marker.scale.y, marker.scale.z = box[LENGTH:ROLL]
        markers.append(marker)
    return MarkerArray(markers=markers)


# ----------------------------------------------------------------- process of the observer


def measure(args, keeps_messages=False):
    """Run node and publisher, and return the report of the observer."""
    set_environment(args.transport)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        arrivals = stack.enter_context(observer(keeps_messages))
        node = stack.enter_context(process(node_command(args.set), folder / 'node.log'))
        load = os.getloadavg()[0]
        publisher = stack.enter_context(
            process(publisher_command(args, folder / 'sent'), folder / 'sent.log')
        )
        samples = []
        while publisher.poll() is None:
            if node.poll() is not None:
                raise BoxregError(f'the node ended: {(folder / "node.log").read_text()}')
            if arrivals['early']:
                samples.append(vitals(node.pid))
            time.sleep(SAMPLE_PERIOD)
        if publisher.returncode:
            raise BoxregError(f'the publisher failed: {(folder / "sent.log").read_text()}')
        samples = samples or [vitals(node.pid)]
        sent = np.loadtxt(folder / 'sent', dtype=np.int64, ndmin=2)
        _await_last(sent, arrivals)
        shutdown_time = _ended(node)
        log = (folder / 'node.log').read_text()
    return {
        'load before, during': f'{load:.2f}, {os.getloadavg()[0]:.2f}',
        **results(sent, arrivals, args.rate),
        **growth(samples),
        'shutdown [s]': shutdown_time,
        'exit status': node.returncode,
        'log lines': len(log.splitlines()),
        'counters': arrivals['counters'],
        **({'messages': _by_sweep(sent, arrivals, args.rate)} if keeps_messages else {}),
    }


def _await_last(sent, arrivals):
    """Wait until the last box array has arrived and is counted, but no longer than `LAST_TIME`."""
    deadline = time.monotonic() + LAST_TIME
    last_ns = int(sent[-1, 0])
    while time.monotonic() < deadline and not (
        last_ns in arrivals['early'] and arrivals['counters'].get('boxes_received') == len(sent)
    ):
        time.sleep(0.1)


def _ended(node):
    """End a node and wait for its last messages; return the time that it took to end [s]."""
    begin = time.monotonic()
    node.send_signal(signal.SIGINT)
    node.wait(timeout=30.0)
    seconds = time.monotonic() - begin
    time.sleep(0.5)
    return seconds


def set_environment(transport):
    """Set the transport of DDS, and a domain apart from other nodes of this machine."""
    if transport == 'large':
        os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(PROFILE)
    else:
        os.environ.pop('FASTRTPS_DEFAULT_PROFILES_FILE', None)
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    os.environ.setdefault('ROS_DOMAIN_ID', '231')


def node_command(parameters):
    """Return the command of a node with parameters as ``KEY:=VALUE``."""
    options = [part for text in parameters for part in ('-p', text)]
    return [*BOXREG, 'node', '--ros-args', *options]


def publisher_command(args, log):
    """Return the command of the publisher, which logs the box arrays sent."""
    names = ('tracks', 'points', 'rate', 'seconds', 'delay', 'motion', 'clock')
    options = [f'--{name}={getattr(args, name)}' for name in names]
    return [*MEASURE, 'node', '--role=publish', f'--log={log}', *options]


def _by_sweep(sent, arrivals, rate):
    """Return the serialised messages by the number of their sweep, after `STARTUP_TIME`."""
    turns = {stamp_ns: turn for turn, stamp_ns in enumerate(sent[:, 0].tolist())}
    begin = round(STARTUP_TIME * rate)
    return {
        name: {turns[s]: data for s, data in kept.items() if turns.get(s, -1) >= begin}
        for name, kept in arrivals['messages'].items()
    }


def results(sent, arrivals, rate):
    """Return the published shares and the latencies after `STARTUP_TIME`."""
    measured = sent[round(STARTUP_TIME * rate) :]
    latencies = []
    for stamp_ns, sent_ns in measured.tolist():
        arrival_ns = arrivals['early'].get(stamp_ns)
        if arrival_ns is not None:
            latencies.append((arrival_ns - sent_ns) * 1e-6)
    finals = sum(stamp_ns in arrivals['final'] for stamp_ns in measured[:, 0].tolist())
    total = max(1, len(measured))
    report = {
        'box arrays sent': float(len(measured)),
        'early published [%]': 100.0 * len(latencies) / total,
        'final published [%]': 100.0 * finals / total,
    }
    if latencies:
        half = len(latencies) // 2
        report |= {
            f'latency {name} [ms]': float(np.percentile(part, percentile))
            for name, part, percentile in (
                ('p50', latencies, 50),
                ('p99', latencies, 99),
                ('max', latencies, 100),
                ('p50 of 1st half', latencies[: half + 1], 50),
                ('p50 of 2nd half', latencies[half:], 50),
            )
        }
    return report


def growth(samples):
    """
    Return memory, handles, threads and cores used by the node.

    A value that grows from the start, after `SETTLED_AFTER` or a third of the run, to the middle
    and on to the end is a leak.

    """
    end = len(samples) - 1
    begin = min(round(SETTLED_AFTER / SAMPLE_PERIOD), end // 3)
    rows = {'at the start': begin, 'in the middle': (begin + end) // 2, 'at the end': end}
    cpu_time = samples[end][3] - samples[begin][3]
    return {
        **{f'memory {when} [MB]': samples[row][0] for when, row in rows.items()},
        **{f'handles {when}': float(samples[row][1]) for when, row in rows.items()},
        'threads': float(samples[end][2]),
        'cores used': cpu_time / SAMPLE_PERIOD / max(1, end - begin),
    }


def vitals(pid):
    """Return resident memory [MB], open files, threads and CPU time [s] of a process."""
    root = Path(f'/proc/{pid}')
    status = dict(line.split(':', 1) for line in (root / 'status').read_text().splitlines())
    times = (root / 'stat').read_text().rsplit(')', 1)[1].split()[11:13]
    return (
        int(status['VmRSS'].split()[0]) / 1024,
        len(list((root / 'fd').iterdir())),
        int(status['Threads']),
        sum(map(int, times)) / os.sysconf('SC_CLK_TCK'),
    )


@contextmanager
def process(command, log):
    """Start a process, which is killed at the end of the context if it still runs."""
    with log.open('wb') as file:
        popen = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)
    try:
        yield popen
    finally:
        if popen.poll() is None:
            popen.kill()
        popen.wait()


@contextmanager
def observer(keeps_messages=False):
    """
    Subscribe to the outputs of the node while the context lasts.

    Yields
    ------
    arrivals : dict
        ``early`` and ``final``: time of arrival by stamp [ns]. ``counters``: the counters of the
        diagnostics. ``messages``: of ``early`` and ``final``, serialised, by stamp.

    """
    from diagnostic_msgs.msg import DiagnosticArray
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import QoSProfile
    from rclpy.signals import SignalHandlerOptions
    from visualization_msgs.msg import MarkerArray

    arrivals = {'early': {}, 'final': {}, 'counters': {}}
    arrivals['messages'] = {'early': {}, 'final': {}}

    def add_arrival(name, data):
        sec, nanosec = struct.unpack_from('<iI', data, FIRST_MARKER)
        stamp_ns = sec * 10**9 + nanosec
        arrivals[name].setdefault(stamp_ns, time.monotonic_ns())
        if keeps_messages:
            arrivals['messages'][name].setdefault(stamp_ns, data)

    def add_counters(message):
        for item in message.status[0].values:
            if item.value.isdigit():
                arrivals['counters'][item.key] = int(item.value)

    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)  # Ctrl-C ends the run
    node = rclpy.create_node('measure_observer')
    for name, topic in (('early', 'refined_boxes'), ('final', 'refined_boxes_final')):
        node.create_subscription(
            MarkerArray, topic, partial(add_arrival, name), QoSProfile(depth=1000), raw=True
        )
    node.create_subscription(DiagnosticArray, '/diagnostics', add_counters, 10)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    thread = Thread(target=executor.spin, daemon=True)
    thread.start()
    try:
        yield arrivals
    finally:
        executor.shutdown()
        thread.join(2.0)
        node.destroy_node()
        rclpy.shutdown()
