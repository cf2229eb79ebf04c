"""
`boxreg bench node`: the live node under load, publisher, node and observer each a process.

Cars drive in circles around a sensor, ids are renewed as in traffic. Latency is from the moment
the later of cloud and boxes was published to the arrival of the refined boxes, over DDS.

"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager, ExitStack
from functools import partial
import json
import os
from pathlib import Path
import signal
import struct
import subprocess
import sys
from tempfile import TemporaryDirectory
from threading import Thread
import time
from typing import Any

from boxreg_ros.errors import BoxregError
import numpy as np

PROFILE = Path(__file__).parents[1] / 'share' / 'fastdds.xml'
CIRCLE = 5.0
"""Until the cars are where they began [s]."""
LIFE = 200
"""Sweeps until a track gets a new id."""
SETTLING = 5.0
"""Not measured at the beginning [s]."""
EXTENT = (4.5, 1.9, 1.6)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `boxreg bench node`."""
    parser.add_argument('--tracks', type=int, default=64, metavar='N')
    parser.add_argument('--points', type=int, default=130_000, metavar='N', help='per sweep')
    parser.add_argument('--rate', type=float, default=10.0, metavar='HZ', help='of the sensor')
    parser.add_argument('--seconds', type=float, default=60.0, metavar='S')
    parser.add_argument(
        '--delay', type=float, default=0.05, metavar='S', help='boxes come after their cloud'
    )
    parser.add_argument(
        '--transport', choices=('large', 'default'), default='large',
        help='shared memory made for large clouds (share/fastdds.xml), or as it comes',
    )  # fmt: skip
    parser.add_argument('--set', action='append', default=[], metavar='KEY:=VALUE', help='for it')
    parser.add_argument('--json', action='store_true', help='print one JSON object')
    parser.add_argument('--role', choices=('publish',), help=argparse.SUPPRESS)
    parser.add_argument('--log', type=Path, help=argparse.SUPPRESS)


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    try:
        import rclpy  # noqa: F401
    except ImportError as error:
        raise BoxregError(f'{error}: source a ROS 2 installation') from None
    if args.role:
        publish(args)
        return 0
    report = measure(args)
    if args.json:
        print(json.dumps(report))
    else:
        for name, value in report.items():
            print(f'{name:28} {value if isinstance(value, (str, dict)) else f"{value:g}"}')
    return 0


# ---------------------------------------------------------------- the publisher's process


def scene(args: argparse.Namespace, turn: int, rng: np.random.Generator) -> tuple[Any, Any]:
    """Return the points (M, 3) and boxes (n, 9) of a sweep, in the frame of the sensor."""
    side = int(np.ceil(np.sqrt(args.tracks)))
    index = np.arange(args.tracks)
    phase = 2 * np.pi * (turn / (CIRCLE * args.rate) + index / args.tracks)
    boxes = np.zeros((args.tracks, 9))
    boxes[:, 0] = 14.0 * (index % side - side / 2) + 4.0 * np.sin(phase) + 5.0
    boxes[:, 1] = 14.0 * (index // side - side / 2) - 4.0 * np.cos(phase) + 5.0
    boxes[:, 3:6] = EXTENT
    boxes[:, 8] = phase
    local = rng.uniform(-0.5, 0.5, (args.tracks, 300, 3))
    near = -np.sign(boxes[:, :2])  # two sides each, roughly those that face the sensor
    local[:, :150, 0] = 0.49 * near[:, :1]
    local[:, 150:, 1] = 0.49 * near[:, 1:]
    local *= np.array(EXTENT)
    cos, sin = np.cos(phase)[:, None], np.sin(phase)[:, None]
    points = np.stack(
        [cos * local[..., 0] - sin * local[..., 1], sin * local[..., 0] + cos * local[..., 1],
         local[..., 2]], -1,
    ) + boxes[:, None, :3]  # fmt: skip
    rest = max(0, args.points - points[..., 0].size)
    road = rng.uniform(-80, 80, (rest, 3)) * [1, 1, 0.0] - [0, 0, EXTENT[2] / 2]
    errors = np.array([0.1, 0.1, 0.05, 0.1, 0.1, 0.1, 0.0, 0.0, 0.03])
    noisy = boxes + errors * rng.normal(0, 1, boxes.shape)
    return np.concatenate([points.reshape(-1, 3), road]), noisy


def publish(args: argparse.Namespace) -> None:
    """Publish in real time; write stamp and moment of every box array to the log [ns]."""
    from msg_adapters.poses import quaternions_of
    from nav_msgs.msg import Odometry
    import rclpy
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import PointCloud2, PointField
    from visualization_msgs.msg import Marker, MarkerArray

    rng = np.random.default_rng(0)
    clouds, arrays = [], []
    for turn in range(round(CIRCLE * args.rate)):
        points, boxes = scene(args, turn, rng)
        table = np.zeros((len(points), 4), np.float32)
        table[:, :3] = points
        cloud = PointCloud2(height=1, width=len(table), point_step=16, row_step=16 * len(table))
        cloud.header.frame_id = 'lidar'
        cloud.fields = [
            PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
            for i, name in enumerate(('x', 'y', 'z', 'intensity'))
        ]
        cloud.data.frombytes(table.tobytes())
        clouds.append(bytearray(serialize_message(cloud)))
        markers = []
        for box, turned in zip(boxes.tolist(), quaternions_of(boxes).tolist(), strict=True):
            marker = Marker(type=Marker.CUBE, ns='car')
            marker.header.frame_id = 'lidar'
            position, quaternion = marker.pose.position, marker.pose.orientation
            position.x, position.y, position.z = box[:3]
            quaternion.x, quaternion.y, quaternion.z, quaternion.w = turned
            marker.scale.x, marker.scale.y, marker.scale.z = box[3:6]
            markers.append(marker)
        arrays.append(MarkerArray(markers=markers))
    rclpy.init(args=[])
    node = rclpy.create_node('bench_publisher')
    best_effort = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    to_points = node.create_publisher(PointCloud2, 'points', best_effort)
    to_boxes = node.create_publisher(MarkerArray, 'boxes', 10)
    to_odom = node.create_publisher(Odometry, 'odom', 50)
    while not all(p.get_subscription_count() for p in (to_points, to_boxes, to_odom)):
        time.sleep(0.1)
    odometry = Odometry(child_frame_id='lidar')
    odometry.header.frame_id = 'odom'
    period, begin = 1e9 / args.rate, time.time_ns()
    with args.log.open('w') as log:
        for turn in range(round(args.seconds * args.rate)):
            stamp_ns = begin + round(turn * period)
            time.sleep(max(0.0, (stamp_ns - time.time_ns()) * 1e-9))
            stamp = divmod(stamp_ns, 10**9)
            odometry.header.stamp.sec, odometry.header.stamp.nanosec = stamp
            to_odom.publish(odometry)
            cloud_bytes = clouds[turn % len(clouds)]
            struct.pack_into('<iI', cloud_bytes, 4, *stamp)  # behind the encapsulation of CDR
            to_points.publish(bytes(cloud_bytes))
            array = arrays[turn % len(arrays)]
            for i, marker in enumerate(array.markers):
                marker.id = i + args.tracks * ((turn + i * LIFE // args.tracks) // LIFE)
                marker.header.stamp.sec, marker.header.stamp.nanosec = stamp
            time.sleep(max(0.0, (stamp_ns - time.time_ns()) * 1e-9 + args.delay))
            moment = time.monotonic_ns()
            to_boxes.publish(array)
            log.write(f'{stamp_ns} {moment}\n')
    time.sleep(1.0)  # for what is on its way
    node.destroy_node()
    rclpy.shutdown()


# ---------------------------------------------------------------- the observer's process


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """Run node and publisher, and return what was seen of them."""
    if args.transport == 'large':
        os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(PROFILE)
    else:
        os.environ.pop('FASTRTPS_DEFAULT_PROFILES_FILE', None)
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    os.environ.setdefault('ROS_DOMAIN_ID', '231')  # what others say is not to be measured
    command = [sys.executable, '-m', 'boxreg_ros.cli']
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        seen = stack.enter_context(observer())
        parameters = [part for text in args.set for part in ('-p', text)]
        node = stack.enter_context(
            process([*command, 'node', '--ros-args', *parameters], folder / 'node.log')
        )
        options = [
            f'--{name}={getattr(args, name)}'
            for name in ('tracks', 'points', 'rate', 'seconds', 'delay')
        ]
        role = ['bench', 'node', '--role=publish', f'--log={folder / "sent"}']
        load = os.getloadavg()[0]
        publisher = stack.enter_context(process([*command, *role, *options], folder / 'sent.log'))
        samples = []
        while publisher.poll() is None:
            if node.poll() is not None:
                raise BoxregError(f'the node ended: {(folder / "node.log").read_text()}')
            if seen['early']:
                samples.append(vitals(node.pid))
            time.sleep(1.0)
        if publisher.returncode:
            raise BoxregError(f'the publisher failed: {(folder / "sent.log").read_text()}')
        samples = samples or [vitals(node.pid)]
        sent = np.loadtxt(folder / 'sent', dtype=np.int64, ndmin=2)
        begun = time.monotonic()
        node.send_signal(signal.SIGINT)
        node.wait(timeout=10.0)
        ending = time.monotonic() - begun
        time.sleep(0.5)
        log = (folder / 'node.log').read_text()
    return {
        'load before, meanwhile': f'{load:.2f}, {os.getloadavg()[0]:.2f}',
        **results(sent, seen, args.rate),
        **growth(samples),
        'ending [s]': ending,
        'exit status': node.returncode,
        'log lines': len(log.splitlines()),
        'counters': seen['counters'],
    }


def results(sent: Any, seen: dict[str, Any], rate: float) -> dict[str, float]:
    """Return shares and latencies of what was sent after the settling."""
    measured = sent[round(SETTLING * rate) :]
    early = [(seen['early'].get(stamp), moment) for stamp, moment in measured.tolist()]
    latency = np.array([(got - moment) * 1e-6 for got, moment in early if got is not None])
    finals = sum(stamp in seen['final'] for stamp in measured[:, 0].tolist())
    half = len(latency) // 2
    report = {
        'box arrays sent': float(len(measured)),
        'early published [%]': 100.0 * len(latency) / max(1, len(measured)),
        'final published [%]': 100.0 * finals / max(1, len(measured)),
    }
    if len(latency):
        report |= {
            f'latency {name} [ms]': float(np.percentile(part, share))
            for name, part, share in (
                ('p50', latency, 50),
                ('p99', latency, 99),
                ('most', latency, 100),
                ('p50 of 1st half', latency[: half + 1], 50),
                ('p50 of 2nd half', latency[half:], 50),
            )
        }
    return report


def growth(samples: list[tuple[float, int, int, float]]) -> dict[str, float]:
    """
    Return memory, handles, threads and cores used by the node, from one sample a second.

    The first is of when boxes came back. What grows from the start to the middle and on to the
    end is a leak, what stays is a plateau.

    """
    end = len(samples) - 1
    begin = min(round(SETTLING), end // 3)
    rows = {'at the start': begin, 'in the middle': (begin + end) // 2, 'at the end': end}
    return {
        **{f'memory {when} [MB]': samples[row][0] for when, row in rows.items()},
        **{f'handles {when}': float(samples[row][1]) for when, row in rows.items()},
        'threads': float(samples[end][2]),
        'cores used': (samples[end][3] - samples[begin][3]) / max(1, end - begin),
    }


def vitals(pid: int) -> tuple[float, int, int, float]:
    """Return memory [MB], open files, threads and CPU time [s] of a process."""
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
def process(command: list[str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start a process that does not outlive the block."""
    with log.open('wb') as file:
        popen = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)
    try:
        yield popen
    finally:
        if popen.poll() is None:
            popen.kill()
        popen.wait()


@contextmanager
def observer() -> Iterator[dict[str, Any]]:
    """Yield what fills with the moments [ns] at which stamps [ns] arrive, and the counters."""
    from diagnostic_msgs.msg import DiagnosticArray
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import QoSProfile
    from visualization_msgs.msg import MarkerArray

    seen: dict[str, Any] = {'early': {}, 'final': {}, 'counters': {}}

    def note(name: str, data: bytes) -> None:
        sec, nanosec = struct.unpack_from('<iI', data, 8)  # of the first marker
        seen[name].setdefault(sec * 10**9 + nanosec, time.monotonic_ns())

    def count(message: DiagnosticArray) -> None:
        for item in message.status[0].values:
            if item.value.isdigit():
                seen['counters'][item.key] = int(item.value)

    rclpy.init(args=[])
    node = rclpy.create_node('bench_observer')
    for name, topic in (('early', 'refined_boxes'), ('final', 'refined_boxes_final')):
        node.create_subscription(
            MarkerArray, topic, partial(note, name), QoSProfile(depth=100), raw=True
        )
    node.create_subscription(DiagnosticArray, '/diagnostics', count, 10)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    thread = Thread(target=executor.spin, daemon=True)
    thread.start()
    try:
        yield seen
    finally:
        executor.shutdown()
        thread.join(2.0)
        node.destroy_node()
        rclpy.shutdown()
