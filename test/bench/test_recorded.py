"""`boxreg bench node --record`: every segment is counted once, also when it is deleted."""

from boxreg_ros.bench.recorded import RecordedLabels
from boxreg_ros.cli import main
from boxreg_ros.config import Config
from boxreg_ros.io.label_feed import FinalBoxes, LabelCloud, RecorderSettings
from boxreg_ros.recorder.main import Recorder
from boxreg_ros.structures import BoxArray, RefinedBoxes, Sweep
import numpy as np
import pytest

PERIOD_NS = 10**8
POINTS = 50


def record(folder, sweeps, points=POINTS):
    """Record sweeps in segments of ten, with one box and a cloud each, in two formats."""
    recorder = Recorder(
        RecorderSettings(str(folder), ('sustechpoints', 'xtreme1'), True, '1 s', '', Config())
    )
    for k in sweeps:
        stamp_ns = k * PERIOD_NS
        cloud = np.ones((points, 3), np.float32)
        recorder.take(LabelCloud(Sweep(stamp_ns, 'lidar', cloud), np.eye(4), None, stamp_ns))
        box = np.array([[1.0, 2, 3, 4, 2, 1.5, 0, 0, 0]])
        boxes = BoxArray(stamp_ns, 'odom', ('1',), ('car',), np.ones(1), box)
        refined = RefinedBoxes(boxes, ('refined',), ('',), np.ones(1, int), np.eye(6)[None])
        recorder.take(FinalBoxes(refined, 'odom', 'lidar', np.eye(4), np.eye(4)))
    recorder.finish()


@pytest.mark.parametrize('kept', [0.0, 1e9])
def test_all_segments_are_counted_once(tmp_path, kept):
    labels = RecordedLabels(tmp_path, kept, POINTS)
    labels.update()
    assert (labels.rows, labels.has_open_segment) == ([], False)
    for sweeps in (range(20), range(20, 25)):
        record(tmp_path, sweeps)
        labels.update()
        labels.update()
    assert labels.stamps == {k * PERIOD_NS for k in range(25)}
    assert labels.cloud_files == 2 * 25
    assert [row.frames for row in labels.rows] == [10, 10, 5]
    assert len(list(tmp_path.glob('segment_*'))) == (3 if kept else 0)


def test_clouds_that_are_not_whole_are_not_counted(tmp_path):
    record(tmp_path, range(3), POINTS - 1)
    labels = RecordedLabels(tmp_path, 0.0, 10 * POINTS)
    labels.update()
    assert (len(labels.stamps), labels.cloud_files) == (3, 0)


def test_a_comparison_needs_formats(capsys):
    assert main(['bench', 'node', '--compare']) == 2
    assert '--record' in capsys.readouterr().err
