"""One core, two drivers: the node's final boxes are those of `boxreg relabel`."""

import csv

from boxreg_ros.cli import main
from msg_adapters import adapter_for
from msg_adapters.poses import quaternions_of
import numpy as np
import pytest
from ros_graph import graph_in, play, publishers_for, records_of, RELIABLE, ROOT, stamp_of
from ros_messages import Drive

SETTINGS = {'window': 5, 'lag': 3}


def relabelled(path, out):
    """Return (stamp, track) -> x y z qx qy qz qw length width height of `boxreg relabel`."""
    options = [f'--set={key}={value}' for key, value in SETTINGS.items()]
    command = ['relabel', str(path), '-o', str(out), '--set=estimate=final', '--formats=csv']
    assert main([*command, *options]) == 0
    columns = ['x', 'y', 'z', 'qx', 'qy', 'qz', 'qw', 'length', 'width', 'height']
    with (out / 'boxes.csv').open() as file:
        rows = list(csv.DictReader(file))
    assert sum(row['status'] == 'refined' for row in rows) > len(rows) / 2
    return {
        (int(row['stamp_ns']), row['track_id']): [float(row[column]) for column in columns]
        for row in rows
    }


def as_published(messages, type_name):
    """Return the same of messages."""
    found = {}
    for message in messages:
        array = adapter_for(type_name).from_msg(message)
        assert array.frame_id == 'odom'
        quaternions_xyzw = quaternions_of(array.boxes)
        for i, track_id in enumerate(array.track_ids):
            box = array.boxes[i]
            assert (array.stamp_ns, track_id) not in found
            found[array.stamp_ns, track_id] = [*box[:3], *quaternions_xyzw[i], *box[3:6]]
    return found


@pytest.mark.parametrize('recording', ['vision-tf', 'markers-odometry', 'street'])
def test_final_boxes_equal_those_of_relabel(tmp_path, recording):
    if recording == 'street':
        path, boxes_topic = ROOT / 'bags' / 'street.mcap', '/detections'
    else:
        boxes, motion = recording.split('-')
        path = Drive(sweeps=10, boxes=boxes, motion=motion).write(tmp_path / 'drive')
        boxes_topic = '/boxes'
    expected = relabelled(path, tmp_path / 'out')
    records = records_of(path, boxes_topic)
    (type_name,) = {record.type_name for record in records if record.topic == boxes_topic}
    with graph_in(tmp_path) as graph:
        # Patient, so that no transform is extrapolated because a machine is busy.
        options = ['output_frame:=odom', 'transform_timeout:=20.0', 'backlog:=60.0']
        options += [f'{key}:={value}' for key, value in SETTINGS.items()]
        publishers_for(graph, records)
        early = graph.collect(type_name, '/refined_boxes')
        final = graph.collect(type_name, '/refined_boxes_final')
        parameters = [part for option in options for part in ('-p', option)]
        node = graph.start(*RELIABLE, *parameters, '-r', f'boxes:={boxes_topic}')
        graph.wait_until_connected()
        play(graph, records, early)
        node.stop()
        assert node.popen.returncode == 0, node.output()
    # All of them, also those that the node still held when it was told to end.
    found = as_published(final, type_name)
    assert found.keys() == expected.keys()
    keys = sorted(expected)
    difference = np.abs(np.array([found[k] for k in keys]) - [expected[k] for k in keys])
    assert difference.max() < 1e-6
    assert [stamp_of(message) for message in final] == sorted({stamp for stamp, _ in expected})
