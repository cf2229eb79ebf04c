"""
Labels of a recording of the node's final boxes equal those of `boxreg relabel`, byte for byte.

The recordings are made over DDS and have the layout of rosbag2, written by rosbags.

"""

from functools import partial
from importlib.util import find_spec
import json
from pathlib import Path

from boxreg_ros.cli import main
from boxreg_ros.io.label_messages import LABELS_TYPE
from boxreg_ros.labels import FORMATS
from boxreg_ros.live.topics import import_message
from lidar_drives import LidarDrive
import pytest
from rclpy.qos import QoSProfile
from relabel_results import rows_in
from ros_graph import graph_in, Record, records_of
from ros_messages import DETECTIONS, Drive, typestore
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
import yaml

SETTINGS = {'window': 5, 'lag': 3}
UNHURRIED = {'transform_timeout': 20.0, 'backlog': 60.0}
NOT_COMPARED = {'mcap', 'semantickitti', 'lidarseg', 'recording'}  # no labels of boxes
if find_spec('pyarrow') is None:
    NOT_COMPARED |= {'parquet', 'argoverse2', 'waymo'}  # those of the extra `formats`
ALL_FORMATS = [name for name in FORMATS if name not in NOT_COMPARED]
CALIBRATION = """\
P2: 700 0 600 0 0 700 180 0 0 0 1 0
R_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_cam: 0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.5
"""
OWN_FILES = ('summary.json', 'config.yaml', 'tracks.csv', 'review.csv', 'input_model.json')
"""Files about a run; no labels."""
OUTPUTS = {'/refined_boxes_final': DETECTIONS, '/refined_labels': LABELS_TYPE}


def recorded(folder, drive, **parameters):
    """Return what `ros2 bag record` would receive of a drive, and of the node that refines it."""
    records = records_of(drive.write(folder / 'played', 'mcap-folder'))
    inputs = {record.topic: record.type_name for record in records}
    taken = []
    given = SETTINGS | UNHURRIED | parameters
    arguments = [part for name, value in given.items() for part in ('-p', f'{name}:={value}')]
    with graph_in(folder) as graph:
        subscribe(graph, OUTPUTS, taken.append)
        node = graph.run(records, *arguments)
        # Until now, the subscribers of its topics were those of the node.
        subscribe(graph, inputs, taken.append)
        node.play(records)
        node.stop()
        assert node.popen.returncode == 0, node.output()
        stamps = {r.boxes_stamp_ns for r in records} - {None}
        graph.wait(
            lambda: sum(r.topic == '/refined_labels' for r in taken) >= len(stamps), 'all labels'
        )
    return sorted(taken, key=lambda record: record.received_ns)


def subscribe(graph, kinds, take):
    """Subscribe to topics of some types; `take` gets a record of each of their messages."""

    def record(topic, data):
        received_ns = graph.node.get_clock().now().nanoseconds
        take(Record(topic, kinds[topic], data, received_ns, None))

    for topic, kind in kinds.items():
        graph.node.create_subscription(
            import_message(kind), topic, partial(record, topic), QoSProfile(depth=1000), raw=True
        )


def write_bag(path, records, plugin=StoragePlugin.MCAP, mode=None):
    """Write records in the layout of rosbag2, and return its folder."""
    store = typestore()
    writer = Writer(path, version=9, storage_plugin=plugin)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {
            record.topic: writer.add_connection(record.topic, record.type_name, typestore=store)
            for record in {record.topic: record for record in records}.values()
        }
        for record in records:
            writer.write(connections[record.topic], record.received_ns, record.data)
    return path


def write_split(path, records):
    """Write records as a bag of two files, as rosbag2 does with --max-bag-duration."""
    half = len(records) // 2
    parts = [records[:half], records[half:]]
    path.mkdir()
    metadata = []
    for number, part in enumerate(parts):
        whole = write_bag(path / f'part{number}', part)
        (file,) = whole.glob('*.mcap')
        file.rename(path / f'drive_{number}.mcap')
        metadata.append(yaml.safe_load((whole / 'metadata.yaml').read_text()))
        (whole / 'metadata.yaml').unlink()
        whole.rmdir()
    first, second = (one['rosbag2_bagfile_information'] for one in metadata)
    first['relative_file_paths'] = ['drive_0.mcap', 'drive_1.mcap']
    first['files'] = [
        {**one['files'][0], 'path': name}
        for one, name in zip((first, second), first['relative_file_paths'], strict=True)
    ]
    begun, ended = first['starting_time'], second['starting_time']
    ended_ns = ended['nanoseconds_since_epoch'] + second['duration']['nanoseconds']
    first['duration']['nanoseconds'] = ended_ns - begun['nanoseconds_since_epoch']
    first['message_count'] += second['message_count']
    (path / 'metadata.yaml').write_text(yaml.safe_dump(metadata[0]))
    return path


def files_of(folder):
    """Return the label files of a folder, by their relative path."""
    files = [path for path in folder.rglob('*') if path.is_file()]
    return {path.relative_to(folder): path for path in files if path.name not in OWN_FILES}


def assert_equal_files(converted, relabelled):
    found, expected = files_of(converted), files_of(relabelled)
    assert found.keys() == expected.keys()
    differ = [name for name in found if found[name].read_bytes() != expected[name].read_bytes()]
    assert differ == []


def relabel(bag, out, formats, *options):
    settings = [f'--set={key}={value}' for key, value in SETTINGS.items()]
    command = ['relabel', str(bag), '-o', str(out), '--set=estimate=final', '--boxes=/boxes']
    assert main([*command, *settings, f'--formats={",".join(formats)}', *options]) == 0


def convert(source, out, formats, *options):
    command = ['convert', str(source), '--from', 'recording', '-o', str(out)]
    return main([*command, f'--to={",".join(formats)}', *options])


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    """Return the records of a run, and the label files of `relabel`, in every format."""
    folder = tmp_path_factory.mktemp('run')
    records = recorded(folder, Drive(sweeps=10))
    bag = write_bag(folder / 'drive', records)
    (folder / 'camera.txt').write_text(CALIBRATION)
    options = ['--with-points', f'--camera={folder / "camera.txt"}']
    relabel(bag, folder / 'out', ALL_FORMATS, *options)
    return records, folder / 'out', options


@pytest.mark.parametrize('layout', ['mcap', 'sqlite3, compressed messages', 'split'])
def test_labels_of_a_recording_equal_those_of_relabel(run, tmp_path, layout):
    records, relabelled, options = run
    path = tmp_path / 'drive'
    if layout == 'split':
        bag = write_split(path, records)
    elif layout == 'mcap':
        bag = write_bag(path, records)
    else:
        bag = write_bag(path, records, StoragePlugin.SQLITE3, CompressionMode.MESSAGE)
    assert convert(bag, tmp_path / 'out', ALL_FORMATS, *options) == 0
    assert_equal_files(tmp_path / 'out', relabelled)
    rows = rows_in(tmp_path / 'out' / 'boxes.csv')
    assert len(rows) == 20
    assert {row['status'] for row in rows} >= {'refined'}


def test_labels_with_the_merged_clouds_of_two_lidars(tmp_path):
    """They are one file for each LiDAR in the recording, and one for both in the labels."""
    drive = LidarDrive(sweeps=6)
    bag = write_bag(tmp_path / 'drive', recorded(tmp_path, drive, points='[/front, /rear]'))
    formats = ['csv', 'sustechpoints']
    options = ['--points=/front', '--points=/rear', '--with-points']
    relabel(bag, tmp_path / 'relabelled', formats, *options)
    assert convert(bag, tmp_path / 'converted', formats, *options) == 0
    assert_equal_files(tmp_path / 'converted', tmp_path / 'relabelled')


def test_boxes_alone_are_labels_without_status(run, tmp_path):
    records, relabelled, _ = run
    without = [record for record in records if record.topic != '/refined_labels']
    bag = write_bag(tmp_path / 'drive', without)
    assert convert(bag, tmp_path / 'out', ['csv', 'openlabel']) == 0
    rows, expected = (rows_in(folder / 'boxes.csv') for folder in (tmp_path / 'out', relabelled))
    assert {row['status'] for row in rows} == {'input'}
    for name in ('stamp_ns', 'frame_id', 'track_id', 'class_name', 'score'):
        assert [row[name] for row in rows] == [row[name] for row in expected]
    for name in ('x', 'y', 'z', 'length'):
        pairs = zip(rows, expected, strict=True)
        assert max(abs(float(a[name]) - float(b[name])) for a, b in pairs) < 1e-9


def test_labels_of_the_node_are_refined_again_and_completed(run, tmp_path):
    records, _, _ = run
    bag = write_bag(tmp_path / 'drive', records)
    command = ['relabel', str(bag), '-o', str(tmp_path / 'out'), '--complete', '--formats=csv']
    assert main([*command, f'--labels=recording:{bag}']) == 0
    rows = rows_in(tmp_path / 'out' / 'boxes.csv')
    assert {row['status'] for row in rows} >= {'refined'}


def test_recordings_without_labels_and_other_texts_are_refused(run, tmp_path, capsys):
    records, _, _ = run
    inputs = [record for record in records if 'refined' not in record.topic]
    bag = write_bag(tmp_path / 'inputs', inputs)
    assert convert(bag, tmp_path / 'out', ['csv']) == 1
    error = capsys.readouterr().err
    assert 'expected one topic refined_labels or refined_boxes_final, got none' in error
    assert f'name one of these as {bag}#TOPIC' in error and '/boxes' in error
    assert convert(Path(f'{bag}#/boxes'), tmp_path / 'out', ['csv']) == 0
    assert len(rows_in(tmp_path / 'out' / 'boxes.csv')) == 20
    text = json.dumps({'stamp_ns': 1}).encode()
    cdr = b'\0\1\0\0' + (len(text) + 1).to_bytes(4, 'little') + text + b'\0'
    other = Record('/refined_labels', LABELS_TYPE, cdr, records[-1].received_ns, None)
    bag = write_bag(tmp_path / 'other', [*inputs, other])
    assert convert(bag, tmp_path / 'none', ['csv']) == 1
    assert "topic '/refined_labels': expected the JSON that the node" in capsys.readouterr().err
    assert main(['relabel', str(bag), '-o', str(tmp_path / 'none'), '--formats=recording']) == 2
    assert "'recording' can only be read; to write: csv" in capsys.readouterr().err
