"""The node writes labels while it drives: equal to those of `relabel`, in whole segments."""

from importlib.util import find_spec
import os
import re
import signal
import time

from boxreg_ros.cli import main
from boxreg_ros.labels import FORMATS
from diagnostic_msgs.msg import DiagnosticStatus
from lidar_drives import LidarDrive
import numpy as np
import orjson
import pytest
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from relabel_results import rows_in
from ros_graph import ended_cleanly, graph_in, records_of
from ros_messages import Drive, MARKERS, SECOND
from std_srvs.srv import Trigger

SETTINGS = {'window': 5, 'lag': 3}
NOT_COMPARED = {'mcap', 'semantickitti', 'lidarseg'}  # the last two label points
if find_spec('pyarrow') is None:
    NOT_COMPARED |= {'parquet', 'argoverse2', 'waymo'}  # those of the extra `formats`
LIVE_FORMATS = [name for name in FORMATS if name not in NOT_COMPARED]
CALIBRATION = """\
P2: 700 0 600 0 0 700 180 0 0 0 1 0
R_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_cam: 0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.5
"""
OWN_FILES = ('summary.json', 'config.yaml', 'tracks.csv', 'review.csv', 'input_model.json')
"""Files of `relabel` about the run, and of the segment about the settings; no labels."""


class Robot:
    """A node that records, and the publishers of a drive."""

    def __init__(self, graph, path, **parameters):
        self.graph = graph
        self.records = records_of(path)
        parameters = {'transform_timeout': 20.0, 'backlog': 60.0, **SETTINGS, **parameters}
        given = [part for item in parameters.items() for part in ('-p', '{}:={}'.format(*item))]
        self.node = graph.run(self.records, *given)
        if 'record_to' in parameters:
            # A drive of a second may end before the recorder has started, and then lacks its end.
            graph.wait(self.node.is_recording, 'the recorder')

    def play(self, records=None):
        """Publish messages, and wait after each box array until it is refined."""
        self.node.play(self.records if records is None else records)

    def call(self, name):
        """Call a service of the node and return its response."""
        return self._request(Trigger, name, Trigger.Request())

    def set_parameter(self, name, value):
        """Set a parameter of the node; return the reason if it is refused."""
        parameters = [Parameter(name, value=value).to_parameter_msg()]
        request = SetParameters.Request(parameters=parameters)
        (result,) = self._request(SetParameters, 'set_parameters', request).results
        return '' if result.successful else result.reason

    def _request(self, kind, name, request):
        return self.graph.call(kind, f'/boxreg_node/{name}', request)

    def stop(self):
        self.node.stop()
        assert self.node.popen.returncode == 0, self.node.output()
        assert 'Traceback' not in self.node.output()


def index_of(folder):
    """Return the index, once the recorder has completed the last segment after its node."""
    deadline = time.monotonic() + 60
    # The recorder removes its spool of clouds and its lock last, which are hidden.
    while not (folder / 'index.csv').is_file() or any(folder.glob('.*')):
        assert time.monotonic() < deadline, 'the recorder did not complete the last segment'
        time.sleep(0.05)
    return rows_in(folder / 'index.csv')


def files_of(folder):
    """Return the label files of a folder, by their relative path."""
    files = [path for path in folder.rglob('*') if path.is_file()]
    return {path.relative_to(folder): path for path in files if path.name not in OWN_FILES}


def assert_equal_files(live, offline):
    """Compare two label files: numbers to 1e-6, all else exactly."""
    if live.suffix == '.json':
        assert_equal(from_json(live), from_json(offline), live)
    elif live.suffix in ('.csv', '.txt', '.xml'):
        words = [path.read_text().replace(',', ' ').split() for path in (live, offline)]
        assert_equal([number(w) for w in words[0]], [number(w) for w in words[1]], live)
    elif live.suffix in ('.parquet', '.feather'):
        assert_equal(table_of(live), table_of(offline), live)
    else:
        assert live.read_bytes() == offline.read_bytes(), live


def from_json(path):
    text = path.read_bytes()
    return orjson.loads(text)


def table_of(path):
    from pyarrow import feather, parquet

    read = parquet.read_table if path.suffix == '.parquet' else feather.read_table
    return read(path).to_pydict()


def number(word):
    try:
        return float(word)
    except ValueError:
        return word


def assert_equal(live, offline, where):
    if isinstance(live, dict):
        assert live.keys() == offline.keys(), where
        for key in live:
            assert_equal(live[key], offline[key], f'{where}: {key}')
    elif isinstance(live, list):
        assert len(live) == len(offline), where
        for one, other in zip(live, offline, strict=True):
            assert_equal(one, other, where)
    elif isinstance(live, float) and isinstance(offline, float):
        assert np.isclose(live, offline, rtol=0, atol=1e-6, equal_nan=True), where
    else:
        assert live == offline, where


@pytest.mark.parametrize('lidars', ['one', 'two'])
def test_labels_equal_those_of_relabel(tmp_path, lidars):
    """In every format; with the merged clouds of two LiDARs in one with a file for each."""
    drive = Drive(sweeps=10) if lidars == 'one' else LidarDrive(sweeps=10)
    # Label files state the name of their recording; a segment has this one.
    path = drive.write(tmp_path / 'live_segment_000001', 'mcap-folder')
    camera = tmp_path / 'calibration.txt'
    camera.write_text(CALIBRATION)
    names = LIVE_FORMATS if lidars == 'one' else ['sustechpoints']
    formats = ','.join(names)
    options = [f'--set={key}={value}' for key, value in SETTINGS.items()]
    options += ['--set=estimate=final', f'--formats={formats}', '--with-points']
    parameters = {'record_formats': f'[{formats}]', 'record_points': True}
    if lidars == 'one':
        options.append(f'--camera={camera}')
        parameters['record_camera'] = camera
    else:
        options += ['--points=/front', '--points=/rear']
        parameters['points'] = '[/front, /rear]'
    out = tmp_path / 'out'
    assert main(['relabel', str(path), '-o', str(out), *options]) == 0
    folder = tmp_path / 'live'
    with graph_in(tmp_path) as graph:
        robot = Robot(graph, path, record_to=folder, record_segment='1 h', **parameters)
        robot.play()
        robot.stop()
    (row,) = index_of(folder)
    assert (row['segment'], row['frames'], row['boxes']) == ('segment_000001', '10', '20')
    assert (row['clouds'], row['recovered']) == ('10', '0')
    assert sorted(p.name for p in folder.iterdir()) == ['index.csv', 'segment_000001']
    live = files_of(folder / 'segment_000001')
    offline = files_of(out)
    assert live.keys() == offline.keys()
    assert {path.parts[0] for path in live} >= {*names} - {'csv'}
    for name, file in live.items():
        assert_equal_files(file, offline[name])


def test_services_start_split_and_stop_a_recording(tmp_path):
    """Labels are read back by `relabel`; what goes wrong is one line, and boxes go on."""
    path = Drive(sweeps=20).write(tmp_path / 'drive')
    folder = tmp_path / 'labels'
    with graph_in(tmp_path) as graph:
        robot = Robot(graph, path)
        markers = graph.collect(MARKERS, '/refined_markers')
        for name, error in (
            ('start_recording', 'record_to: expected a folder, got none'),
            ('stop_recording', 'expected a recording, got none'),
            ('split', 'expected a recording, got none'),
        ):
            answer = robot.call(name)
            assert not answer.success
            assert error in answer.message
        (tmp_path / 'file').write_text('')
        for parameter, value, words in (
            ('record_segment', '1 week', ('record_segment', '1 week', '60 s')),
            ('record_formats', ['kitty'], ('kitty', 'kitti')),
            ('record_formats', ['csv', 'mcap'], ('record_formats', 'mcap', 'ros2 bag record')),
            ('record_formats', ['semantickitti'], ('record_formats', 'semantickitti')),
            ('record_camera', str(tmp_path / 'missing'), ('record_camera', 'missing')),
            ('record_camera', str(tmp_path / 'file'), ('record_camera', 'file')),
        ):
            reason = robot.set_parameter(parameter, value)
            assert [word for word in words if word not in reason] == [], reason
        assert robot.set_parameter('record_formats', ['csv', 'openlabel']) == ''
        robot.set_parameter('record_to', str(tmp_path / 'file'))
        answer = robot.call('start_recording')
        assert not answer.success
        assert 'file' in answer.message
        graph.wait(lambda: robot.node.recording()[0] == DiagnosticStatus.ERROR, 'an ERROR')
        robot.set_parameter('record_to', str(folder))
        answer = robot.call('start_recording')
        assert answer.success, answer.message
        assert 'call ~/stop_recording first' in robot.call('start_recording').message
        per_sweep = 3  # transform, cloud, boxes
        robot.play(robot.records[: 1 + 10 * per_sweep])
        graph.wait(lambda: robot.node.recording()[2].get('frames') == '7', 'final boxes')  # lag 3
        level, text, values = robot.node.recording()
        assert level == DiagnosticStatus.OK
        assert text.startswith('recording segment_000001, ')
        assert (values['folder'], values['boxes'], values['boxes waiting']) == (
            str(folder), '14', '0',
        )  # fmt: skip
        assert float(values['disk free [GB]']) > 0
        assert robot.call('split').success
        graph.wait(lambda: 'segment_000001' in str(markers), 'the marker of the recording')
        robot.play(robot.records[1 + 10 * per_sweep : 1 + 15 * per_sweep])
        answer = robot.call('stop_recording')  # waits until the last boxes are final
        assert answer.success
        assert answer.message == f'{folder}: 30 boxes in 2 segments'
        assert [row['frames'] for row in index_of(folder)] == ['7', '8']
        robot.play(robot.records[1 + 15 * per_sweep :])  # not recorded
        graph.wait(lambda: robot.node.recording()[1] == 'off', 'the end of the recording')
        robot.stop()
    assert len(robot.node.early) == 20
    out = tmp_path / 'out'
    assert main(['relabel', str(path), '--labels', f'openlabel:{folder}', '-o', str(out)]) == 0
    rows = rows_in(out / 'boxes.csv')
    assert len(rows) == 30
    assert {row['track_id'] for row in rows} == {'1', '2'}


def test_a_recorder_that_died_is_started_again(tmp_path):
    """Its segment is completed, the next begins, and stopping answers as ever."""
    path = Drive(sweeps=20).write(tmp_path / 'drive')
    folder = tmp_path / 'labels'
    with graph_in(tmp_path) as graph:
        robot = Robot(graph, path, record_to=folder)
        per_sweep = 3  # transform, cloud, boxes
        robot.play(robot.records[: 1 + 10 * per_sweep])
        graph.wait(lambda: robot.node.recording()[2].get('frames') == '7', 'final boxes')  # lag 3
        os.kill(int((folder / '.lock').read_text().split()[0]), signal.SIGKILL)
        graph.wait(lambda: 'recorder_restarted' in robot.node.output(), 'a warning')
        robot.play(robot.records[1 + 10 * per_sweep :])
        answer = robot.call('stop_recording')
        assert answer.success, answer.message
        assert robot.node.recording()[0] == DiagnosticStatus.OK
        robot.stop()
    assert 'exit status -9' in robot.node.output()
    assert 'ERROR' not in robot.node.output()
    assert len(robot.node.early) == 20
    rows = sorted(index_of(folder), key=lambda row: row['segment'])
    assert [row['recovered'] for row in rows] == ['1', '0']
    # After 3 s of silence the node gives up the boxes that it holds: the kill may meet them.
    (under_way,) = re.findall('up to ([0-9]+) box arrays under way', robot.node.output())
    frames = [int(row['frames']) for row in rows]
    assert frames[0] >= 7 and 20 - int(under_way) <= sum(frames) <= 20


def test_two_nodes_another_clock_and_a_killed_node(tmp_path):
    """The second node does not record; the recorder of a killed node completes the segment."""
    path = Drive(sweeps=12).write(tmp_path / 'drive')
    simulated = Drive(sweeps=8, start=100 * SECOND).write(tmp_path / 'simulated')
    folder = tmp_path / 'labels'
    with graph_in(tmp_path) as graph:
        robot = Robot(graph, path, record_to=folder)
        recorder = int((folder / '.lock').read_text().split()[0])
        assert os.getpgid(recorder) == recorder  # the SIGINT of a terminal does not reach it
        second = graph.start('-p', f'record_to:={folder}', '-r', '__node:=second')
        graph.wait(lambda: 'writes to, got one in use' in second.output(), 'an error')
        assert second.output().count('ERROR') == 1
        robot.play()
        graph.wait(lambda: robot.node.recording()[2].get('frames') == '9', 'final boxes')  # lag 3
        robot.play(records_of(simulated))
        graph.wait(lambda: robot.node.recording()[2].get('frames') == '17', 'final boxes')
        robot.node.kill()
        assert ended_cleanly(second)
    output = robot.node.output()
    assert 'went back to 100000000000 ns' in output and 'let one clock set all stamps' in output
    assert 'ERROR' not in output
    rows = index_of(folder)
    # All of the first clock, and those of the second before the lag.
    assert [(row['frames'], row['recovered']) for row in rows] == [('12', '0'), ('5', '0')]
    assert rows[1]['first_stamp_ns'] == str(100 * SECOND)
