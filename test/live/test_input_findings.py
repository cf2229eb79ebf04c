"""What is wrong with the input is said by the node too, over DDS: counters and log."""

import time

import pytest
from ros_graph import ended_cleanly, QUICK, records_of
from ros_messages import Drive, SECOND

SWEEPS = 22  # 2 s: two looks at what changes slowly


def rows_as_ids(drive):
    """Give each box the row in its message, in an order that changes."""
    boxes = [message for topic, _, message in drive.items if topic == '/boxes']
    for k, message in enumerate(boxes):
        if k % 2:
            message.detections.reverse()
        for row, detection in enumerate(message.detections):
            detection.id = str(row)


def jumping_map(drive):
    m = drive.messages
    for k, stamp in enumerate(drive.stamps):
        position = (0.5 * (k // 6 % 2), 0, 0)
        drive.items.append(('/tf', stamp, m.tf(m.transform(stamp, 'map', 'odom', position))))


def other_clock(drive):
    """Let the clock of clouds and boxes be 0.7 s ahead of that of the transforms."""
    for topic, _, message in drive.items:
        for one in (message, *getattr(message, 'detections', [])):
            if topic in ('/points', '/boxes'):
                stamp = one.header.stamp
                total = stamp.sec * SECOND + stamp.nanosec + 7 * SECOND // 10
                stamp.sec, stamp.nanosec = divmod(total, SECOND)


def second_robot(drive):
    """Add the transforms of a robot that is 20 m ahead to those of the first."""
    m = drive.messages
    for k, stamp in enumerate(drive.stamps):
        at = stamp + 30_000_000
        message = m.tf(m.transform(at, 'odom', 'base', (20 + 0.5 * k, 0, 0)))
        drive.items.append(('/tf', at, message))


def registered(drive):
    for topic, _, message in drive.items:
        if topic in ('/points', '/boxes'):
            for one in (message, *getattr(message, 'detections', [])):
                one.header.frame_id = 'odom'


@pytest.mark.parametrize(
    'changes, frame, expected',
    [
        (
            (rows_as_ids, jumping_map),
            'map',
            {'track_ids_jump': 'keep_ids:=true', 'fixed_frame_jumps': 'fixed_frame:=odom'},
        ),
        (
            (other_clock, second_robot),
            'odom',
            {'clock_offset': 'clock_offset:=', 'transform_fault': 'two publishers state it'},
        ),
        ((registered,), 'odom', {'sensor_position': "sensor_frames:=['lidar']"}),
    ],
    ids=['ids_and_map', 'clock_and_robots', 'registered'],
)
def test_what_is_wrong_with_the_input_is_counted_and_logged(
    graph, tmp_path, changes, frame, expected
):
    drive = Drive(sweeps=SWEEPS)
    for change in changes:
        change(drive)
    records = records_of(drive.write(tmp_path / 'drive'))
    # Which frame is chosen by default depends on the transforms that arrive first.
    arguments = ('-p', f'fixed_frame:={frame}', '-p', 'transform_timeout:=0.2')
    node = graph.run(records, *QUICK, *arguments)
    begun = time.monotonic()
    for record in records:
        due = begun + (record.received_ns - records[0].received_ns) * 1e-9
        while time.monotonic() < due:
            graph.executor.spin_once(timeout_sec=max(0.0, due - time.monotonic()))
        graph.publishers[record.topic].publish(record.data)
    graph.wait(lambda: expected.keys() <= node.values().keys(), 'the counters')
    assert ended_cleanly(node)
    for reason, words in expected.items():
        lines = [line for line in node.output().splitlines() if f'{reason}: ' in line]
        assert any(words in line for line in lines), node.output()
