"""The format of docs/tasks/write-a-label-format.md is written, read back and converted."""

from importlib import import_module
import json
import os
import shutil
import subprocess
import sys

from boxreg_ros import cli
from boxreg_ros.errors import RecordingError
from boxreg_ros.io.box_table import BoxTable, COLUMNS
from boxreg_ros.io.fixed_frame import input_boxes
from boxreg_ros.labels import can_read, FORMATS, frames_of, LabelFrame, Provenance, writer_for
from boxreg_ros.labels.records import refined_boxes
from boxreg_ros.offline.request import Request
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
    evidence = [{'score': 0.5, 'status': 'kept'}, {'score': 1.0}]
    refined = refined_boxes(7, 'odom', ['a', 'b'], ['car', ''], boxes, evidence)
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


def test_convert_to_the_format_and_back(tmp_path):
    table = tmp_path / 'boxes.csv'
    BoxTable.from_arrays(
        input_boxes(source_of(Request((Drive(sweeps=5).write(tmp_path / 'drive'),))))[0]
    ).write(table)
    there, back = (str(tmp_path / name) for name in ('there', 'back'))
    assert cli.main(['convert', str(table), '-o', there, '--from', 'csv', '--to', 'jsonl']) == 0
    source = f'{there}/jsonl'
    assert cli.main(['convert', source, '-o', back, '--from', 'jsonl', '--to', 'csv']) == 0
    before = BoxTable.read(table)
    after = BoxTable.read(tmp_path / 'back' / 'boxes.csv')
    assert list(after.track_ids) == list(before.track_ids)
    np.testing.assert_allclose(after.boxes, before.boxes, atol=1e-9)


# In a package of its own -------------------------------------------------------------------------

PROJECT = """
[build-system]
requires = ['setuptools']
build-backend = 'setuptools.build_meta'
[project]
name = 'boxreg-jsonl'
version = '1.0'
[project.entry-points.'boxreg_ros.labels']
jsonl = 'label_format_example'
kitti = 'label_format_example'
[tool.setuptools]
py-modules = ['label_format_example']
"""


def boxreg(packages, *arguments):
    environment = os.environ | {'PYTHONPATH': f'{packages}:{ROOT}'}
    command = [sys.executable, '-m', 'boxreg_ros.cli', *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)


def test_an_installed_package_adds_the_format(tmp_path):
    project, packages = tmp_path / 'project', tmp_path / 'packages'
    project.mkdir()
    (project / 'pyproject.toml').write_text(PROJECT)
    shutil.copy(EXAMPLES / 'label_format_example.py', project)
    pip = [sys.executable, '-m', 'pip', '--disable-pip-version-check', 'install', '--quiet']
    options = ['--no-deps', '--no-build-isolation', '--no-index', '--target', str(packages)]
    subprocess.run([*pip, *options, str(project)], check=True)

    listed = boxreg(packages, 'formats').stdout
    assert 'jsonl: JSON lines\n' in listed
    assert 'kitti: KITTI tracking\n' in listed  # its own formats keep their names
    table, out = tmp_path / 'boxes.csv', tmp_path / 'out'
    table.write_text(f'{",".join(COLUMNS)}\n5,odom,a,car,.5,1,2,3,0,0,0,1,4,2,1.5,kept,9\n')
    run = boxreg(packages, 'convert', table, '-o', out, '--from', 'csv', '--to', 'jsonl')
    assert run.returncode == 0, run.stderr
    assert json.loads((out / 'jsonl' / 'boxes.jsonl').read_text())['track_ids'] == ['a']

    (packages / 'label_format_example.py').write_text('import no_such_module\n')
    run = boxreg(packages, 'convert', table, '-o', f'{out}2', '--from', 'csv', '--to', 'jsonl')
    assert run.returncode == 2
    assert "format 'jsonl' of another package" in run.stderr
    assert 'no_such_module' in run.stderr
    listed = boxreg(packages, 'formats').stdout
    assert 'kitti: KITTI tracking\n' in listed
    assert "jsonl: format 'jsonl' of another package" in listed
