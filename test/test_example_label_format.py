"""The format of docs/tasks/write-a-label-format.md is written, read back and converted."""

from importlib import import_module

from boxreg_ros import cli
from boxreg_ros.errors import RecordingError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.fixed_frame import input_boxes
from boxreg_ros.labels import can_read, FORMATS, frames_of, LabelFrame, Provenance, writer_for
from boxreg_ros.labels.records import refined_boxes
from boxreg_ros.offline.sources import source_of
import numpy as np
from paths import ROOT
import pytest
from ros_messages import Drive

PAGE = ROOT / 'docs' / 'tasks' / 'write-a-label-format.md'
EXAMPLES = ROOT / 'docs' / 'examples'


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    monkeypatch.setitem(FORMATS, 'jsonl', 'label_format_example')
    return import_module('label_format_example')


def test_page_shows_the_example():
    source = (EXAMPLES / 'label_format_example.py').read_text(encoding='utf-8')
    assert f'```python\n{source}```\n' in PAGE.read_text(encoding='utf-8')


def test_round_trip(tmp_path):
    boxes = [[1, 2, 3, 4, 2, 1.5, 0.1, 0.2, 0.3], [np.nan, 2, 3, 4, 2, 1.5, 0, 0, 0]]
    refined = refined_boxes(7, 'odom', ['a', 'b'], ['car', ''], boxes, [0.5, 1.0], ['kept', ''])
    writer = writer_for('jsonl', tmp_path, Provenance())
    writer.write(LabelFrame(refined, 'odom', 'lidar'))
    writer.close()
    assert +writer.dropped == {'invalid_box': 1}
    assert can_read('jsonl')
    (frame,) = frames_of('jsonl', tmp_path / 'jsonl')
    found = frame.refined.boxes
    assert (found.stamp_ns, found.frame_id, found.track_ids) == (7, 'odom', ('a',))
    assert (frame.refined.status, found.scores.tolist()) == (('kept',), [0.5])
    np.testing.assert_array_equal(found.boxes, boxes[:1])


@pytest.mark.parametrize('text', ['no JSON\n', '[]\n', '{"stamp_ns": 1}\n'])
def test_broken_file_is_refused(tmp_path, text):
    path = tmp_path / 'boxes.jsonl'
    path.write_text(text)
    with pytest.raises(RecordingError, match='expected one JSON object per line'):
        list(frames_of('jsonl', path))


def test_convert_to_the_format_and_back(tmp_path, capsys):
    table = tmp_path / 'boxes.csv'
    BoxTable.from_arrays(
        input_boxes(source_of([Drive(sweeps=5).write(tmp_path / 'drive')]))[0]
    ).write(table)
    there, back = (str(tmp_path / name) for name in ('there', 'back'))
    assert cli.main(['convert', str(table), '-o', there, '--from', 'csv', '--to', 'jsonl']) == 0
    source = f'{there}/jsonl'
    assert cli.main(['convert', source, '-o', back, '--from', 'jsonl', '--to', 'csv']) == 0
    before = BoxTable.read(table)
    after = BoxTable.read(tmp_path / 'back' / 'boxes.csv')
    assert list(after.track_ids) == list(before.track_ids)
    np.testing.assert_allclose(after.boxes, before.boxes, atol=1e-9)
    assert cli.main(['formats']) == 0
    assert 'jsonl: JSON lines\n' in capsys.readouterr().out
