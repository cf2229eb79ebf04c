"""MCAP files of Foxglove's schemas: protobuf, JSON, and both mixed with ROS messages."""

from dataclasses import replace
import json
import sys

from boxreg_ros.cli import main
from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.foxglove import encoded
from boxreg_ros.io.items import Wanted
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.transforms import TransformTree
from foxglove_recordings import PointCloud, SceneUpdate, write_foxglove_mcap
from mcap.reader import make_reader
from msg_adapters import adapter_for
import numpy as np
import pytest
from relabel_results import rows_in
from ros_messages import Drive, SCENE


def rows_of(path, out):
    """Relabel a recording; return the rows of boxes.csv."""
    assert main(['relabel', str(path), '-o', str(out), '--formats=csv']) == 0
    return rows_in(out / 'boxes.csv')


def test_a_foxglove_file_and_a_ros_recording_are_merged(tmp_path):
    drive = Drive(sweeps=5, boxes=SCENE)
    expected = rows_of(drive.write(tmp_path / 'ros'), tmp_path / 'expected')
    items = drive.items
    drive.items = [item for item in items if item[0] == '/boxes']
    foreign = write_foxglove_mcap(
        tmp_path / 'foreign.mcap', drive, {'/boxes': 'protobuf'} | {'/tf': 'cdr'}
    )
    drive.items = [item for item in items if item[0] != '/boxes']
    rest = drive.write(tmp_path / 'rest')
    command = ['relabel', str(foreign), str(rest), '-o', str(tmp_path / 'out'), '--formats=csv']
    assert main(command) == 0
    assert rows_in(tmp_path / 'out' / 'boxes.csv') == expected


@pytest.mark.parametrize('encoding', ['protobuf', 'json'])
def test_other_fields_are_copied_in_the_encoding_of_the_input(tmp_path, encoding):
    drive = Drive(sweeps=1, boxes=SCENE)
    path = write_foxglove_mcap(
        tmp_path / 'a.mcap', drive, {'/boxes': encoding, '/points': 'cdr', '/tf': 'cdr'}
    )
    with path.open('rb') as file:
        ((_, _, raw),) = make_reader(file).iter_messages('/boxes')
    with Recording([path]) as recording:
        (record,) = recording._records(TransformTree(), {'/boxes'})
        message = recording._decoder.message(record)
        adapter = adapter_for(SCENE)
        boxes = adapter.from_msg(message)
        longer = replace(boxes, boxes=boxes.boxes + np.array([0, 0, 0, 1, 0, 0, 0, 0, 0]))
        written = adapter.to_msg(message, longer)
        np.testing.assert_allclose(adapter.from_msg(written).boxes, longer.boxes, atol=1e-12)
        np.testing.assert_array_equal(adapter.from_msg(message).boxes, boxes.boxes)
        restored = encoded(adapter.to_msg(written, boxes))
        decoded = recording._reader.deserialize(restored, SCENE)
    np.testing.assert_allclose(adapter.from_msg(decoded).boxes, boxes.boxes, atol=1e-12)
    if encoding == 'json':
        old, new = json.loads(raw.data), json.loads(restored)
    else:
        old, new = SceneUpdate.FromString(raw.data), SceneUpdate.FromString(restored)
        assert [e.metadata[2].value for e in new.entities] == ['kept', 'kept']
        for item in (old, new):
            for entity in item.entities:
                entity.ClearField('cubes')
        assert old == new
        return
    for item in (old, new):
        for entity in item['entities']:
            assert entity.pop('cubes')[0]['color'] == {'r': 0, 'g': 1.0, 'b': 0, 'a': 0.5}
    assert old == new


def test_the_error_names_a_missing_package(tmp_path, monkeypatch, capsys):
    drive = Drive(sweeps=2, boxes=SCENE)
    path = write_foxglove_mcap(
        tmp_path / 'a.mcap', drive, {'/boxes': 'protobuf', '/points': 'cdr', '/tf': 'cdr'}
    )
    monkeypatch.setitem(sys.modules, 'mcap_protobuf.decoder', None)
    assert main(['relabel', str(path), '-o', str(tmp_path / 'out')]) == 1
    error = capsys.readouterr().err
    assert 'pip install mcap-protobuf-support' in error and "'/boxes'" in error


def test_clouds_with_a_pose_other_than_identity_are_refused(tmp_path):
    drive = Drive(sweeps=1, boxes=SCENE)
    path = write_foxglove_mcap(
        tmp_path / 'a.mcap', drive, {'/boxes': 'cdr', '/points': 'protobuf', '/tf': 'cdr'}
    )
    with Recording([path]) as recording:
        message = PointCloud(pose={'position': {'x': 1.0}, 'orientation': {'w': 1.0}})
        with pytest.raises(UnsupportedMessage, match='pose'):
            recording._reader.deserialize(
                message.SerializeToString() or b'', 'sensor_msgs/msg/PointCloud2'
            )


def test_the_error_of_invalid_json_names_the_topic(tmp_path):
    drive = Drive(sweeps=1, boxes=SCENE)
    path = write_foxglove_mcap(
        tmp_path / 'a.mcap', drive, {'/boxes': 'json', '/points': 'cdr', '/tf': 'cdr'}
    )
    match = r"'/boxes'.*not JSON"
    with Recording([path]) as recording, pytest.raises(UnsupportedMessage, match=match):
        recording.box_message(b'{"entities": [')


@pytest.mark.parametrize('encoding', ['protobuf', 'json'])
def test_overlay_has_refined_boxes_in_the_same_encoding(tmp_path, encoding):
    drive = Drive(sweeps=4, boxes=SCENE)
    encodings = {'/boxes': encoding, '/points': 'cdr', '/tf': 'cdr'}
    path = write_foxglove_mcap(tmp_path / 'drive.mcap', drive, encodings)
    assert main(['relabel', str(path), '-o', str(tmp_path / 'out'), '--formats=mcap']) == 0
    overlay = tmp_path / 'out' / 'overlay.mcap'
    table = BoxTable.read(tmp_path / 'out' / 'boxes.csv')
    with Recording([overlay], boxes='/boxes_refined') as recording:
        found = [item.content for item in recording.items(TransformTree(), Wanted(clouds=False))]
    assert [boxes.stamp_ns for boxes in found] == drive.stamps
    for k, boxes in enumerate(found):  # the LiDAR moves 0.5 m along x per sweep, at z = 2 m
        expected = table.boxes[table.stamps_ns == boxes.stamp_ns] - [0.5 * k, 0, 2, *[0] * 6]
        np.testing.assert_allclose(boxes.boxes, expected, atol=1e-6)
