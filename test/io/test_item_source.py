"""Bags, MCAP files of Foxglove and label files are read through one protocol."""

from boxreg_ros.cli import main
from boxreg_ros.io.items import ItemSource, Wanted
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.io.transforms import boxes_to_frame, sweep_to_frame
from boxreg_ros.offline.sources import LabelledRecording
from boxreg_ros.structures import Sweep
from msg_adapters.convention import STANDARD
import numpy as np
import pytest
from ros_messages import Drive, SCENE

SOURCES = ('mcap', 'mcap-folder', 'sqlite3', 'rosbag1', 'protobuf', 'json', 'labels')


def source_of(name, folder):
    """Return a source with the same clouds, motion and boxes in any kind of files."""
    if name in ('protobuf', 'json'):
        from foxglove_recordings import write_foxglove_mcap

        encodings = dict.fromkeys(('/boxes', '/points', '/tf'), name)
        drive = Drive(sweeps=6, boxes=SCENE)
        return Recording([write_foxglove_mcap(folder / 'drive.mcap', drive, encodings)])
    if name == 'labels':
        drive = Drive(sweeps=6).write(folder / 'drive')
        out = folder / 'out'
        # No window has enough observations: the labels are the input boxes, and the exit status
        # is 1 because no box was refined.
        config = ['--set=min_observations=50', '--set=window=50']
        assert main(['relabel', str(drive), '-o', str(out), '--formats=csv', *config]) == 1
        return LabelledRecording(('csv', out / 'boxes.csv'), [drive], STANDARD)
    is_ros1 = name == 'rosbag1'
    boxes = 'vision' if is_ros1 else SCENE
    return Recording([Drive(sweeps=6, boxes=boxes, ros1=is_ros1).write(folder / 'drive', name)])


def read(source):
    """Return the fixed frame, and kinds and stamps, points, boxes and ids of all items."""
    tree = TransformTree()
    kinds, points, boxes, ids = [], [], [], []
    with source:
        fixed_frame = source.choose_fixed_frame(tree)
        for item in source.items(tree):
            content = item.content
            T_fixed_item = tree.lookup(fixed_frame, content.frame_id, content.stamp_ns)
            move = sweep_to_frame if isinstance(content, Sweep) else boxes_to_frame
            moved = move(content, T_fixed_item, fixed_frame)
            kinds.append((type(moved), moved.stamp_ns))
            if isinstance(moved, Sweep):
                points.append(moved.points)
            else:
                boxes.append(moved.boxes)
                ids.append(moved.track_ids)
        source.check_readable()
    assert not source.unreadable and not source.apart
    return fixed_frame, kinds, np.concatenate(points), np.concatenate(boxes), ids


@pytest.mark.parametrize('name', SOURCES)
def test_each_source_yields_the_same_items(tmp_path, name):
    (tmp_path / 'expected').mkdir()
    fixed_frame, kinds, points, boxes, ids = read(source_of('mcap', tmp_path / 'expected'))
    assert len(kinds) == 12
    source = source_of(name, tmp_path)
    assert isinstance(source, Recording)
    found = read(source)
    assert isinstance(source, ItemSource)
    assert found[0] == fixed_frame
    assert found[1] == kinds
    np.testing.assert_array_equal(found[2], points)
    np.testing.assert_allclose(found[3], boxes, atol=1e-6)
    assert found[4] == ids


@pytest.mark.parametrize('name', SOURCES)
def test_each_source_may_leave_out_the_clouds(tmp_path, name):
    source = source_of(name, tmp_path)
    with source:
        kinds = [
            type(item.content) for item in source.items(TransformTree(), Wanted(clouds=False))
        ]
    assert len(kinds) == 6
    assert Sweep not in kinds
