"""Attributes of objects: through every format that has them, and as other programs read them."""

from dataclasses import replace
import json
import shutil

from boxreg_ros.errors import RecordingError
from boxreg_ros.labels import frames_of, Options, Provenance, writer_for
from boxreg_ros.labels.attributes import is_set, of_nuscenes, to_nuscenes
from boxreg_ros.labels.kitti import attributes_of, occlusion_of, truncation_of
from boxreg_ros.labels.protocol import LabelFrame
from boxreg_ros.structures import BoxArray, RefinedBoxes, Sweep
from consumers import consumer
import numpy as np
import pytest

STAMP = 1_700_000_000_000_000_000
GIVEN = (
    {'occluded': 'true', 'parked': 'true', 'colour': 'red'},
    {'occluded': 'false', 'truncated': 'true'},
    {},
)
CALIBRATION = """P2: 200 0 600 0 0 200 180 0 0 0 1 0
R_rect 1 0 0 0 1 0 0 0 1
Tr_velo_cam 0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.5
"""
AS_READ = {
    'csv': GIVEN,
    'openlabel': GIVEN,
    'supervisely': GIVEN,
    'sly_pointcloud': GIVEN,
    'xtreme1': GIVEN,
    'sustechpoints': GIVEN,
    'nuscenes': GIVEN,
    't4': GIVEN,
    'datumaro': (GIVEN[0], {'truncated': 'true'}, {}),  # CVAT: every box is occluded, or not
    'kitti': ({'occluded': 'true'}, GIVEN[1], {}),
    'kitti_object': GIVEN,
    'openpcdet': GIVEN,
    'tracklets': ({'occluded': 'true'}, GIVEN[1], {}),
}  # fmt: skip


def frames():
    """Return two frames of three boxes in the image, with attributes in the first alone."""
    boxes = np.array([[10, y, 1, 4, 2, 1.6, 0, 0, 0] for y in (-2, 0, 2)], float)
    array = BoxArray(
        STAMP, 'odom', ('a', 'b', 'c'), ('car',) * 3, np.ones(3), boxes, attributes=GIVEN
    )
    columns = ('refined',) * 3, ('',) * 3, np.full(3, 9), np.tile(np.eye(6), (3, 1, 1))
    sweep = Sweep(STAMP, 'lidar', np.zeros((4, 3), np.float32))
    first = LabelFrame(RefinedBoxes(array, *columns), 'odom', 'lidar', np.eye(4), sweep=sweep)
    later = replace(array, stamp_ns=STAMP + 10**8, attributes=())
    return [first, replace(first, refined=RefinedBoxes(later, *columns))]


def written(name, folder):
    (folder / 'camera.txt').write_text(CALIBRATION)
    options = Options(camera=folder / 'camera.txt', with_points=True)
    writer = writer_for(name, folder, Provenance(('drive.mcap',), ''), options)
    for one in frames():
        writer.write(one)
    writer.close()
    return folder if name == 'csv' else folder / name


def by_track(frame):
    boxes = frame.refined.boxes
    return [dict(boxes.attributes_of(boxes.track_ids.index(name))) for name in 'abc']


@pytest.mark.parametrize('name', AS_READ)
def test_attributes_are_read_as_they_were_written(tmp_path, name):
    found, later = frames_of(name, written(name, tmp_path))
    assert by_track(found) == list(AS_READ[name])
    assert not any('occluded' in one for one in by_track(later))


def test_a_file_without_attributes_has_no_table_of_them(tmp_path):
    writer = writer_for('csv', tmp_path, Provenance(), Options())
    writer.write(frames()[1])
    writer.close()
    assert not (tmp_path / 'attributes.csv').exists()


def test_a_row_of_attributes_that_is_cut_is_named(tmp_path):
    path = written('csv', tmp_path) / 'attributes.csv'
    path.write_text(path.read_text().rpartition(',')[0])
    with pytest.raises(RecordingError, match=r'attributes\.csv: expected the columns'):
        list(frames_of('csv', tmp_path))


def test_nuscenes_devkit_reads_attributes(tmp_path):
    """Its evaluation allows one of each box."""
    assert consumer('nuscenes_attributes', written('nuscenes', tmp_path), 'v1.0-boxreg') == {
        'a': ['vehicle.parked'], 'b': [], 'c': [],
    }  # fmt: skip
    assert consumer('nuscenes_attributes', written('t4', tmp_path), 'annotation') == {
        'a': ['colour.red', 'occlusion_state.most', 'vehicle_state.parked'],
        'b': ['occlusion_state.none', 'truncation_state.truncated'],
        'c': [],
    }


def test_datumaro_reads_attributes(tmp_path):
    items = consumer('datumaro', written('datumaro', tmp_path))['cuboids'][:3]
    found = [item['attributes'] for item in items]
    assert [one['occluded'] for one in found] == [True, False, False]
    assert (found[0]['parked'], found[0]['colour']) == (True, 'red')
    assert found[1]['truncated'] is True
    assert 'parked' not in found[2]


def test_supervisely_reads_attributes_as_tags(tmp_path):
    found = consumer('supervisely_tags', written('supervisely', tmp_path))
    assert found['a'] == {'occluded': ['true', [0, 0]], 'parked': ['true', [0, 0]],
                          'colour': ['red', [0, 0]]}  # fmt: skip
    assert found['c'] == {}


def test_vcd_reads_attributes(tmp_path):
    path = written('openlabel', tmp_path) / 'labels.json'
    assert consumer('vcd_attributes', path) == {
        'a': {'occluded': True, 'parked': True, 'colour': 'red'},
        'b': {'occluded': False, 'truncated': True},
        'c': {},
    }


def test_attributes_of_other_programs(tmp_path):
    """Files of tools that state them by their own words."""
    for name, key in (('xtreme1', 'classValues'), ('sustechpoints', 'obj_attr')):
        folder = written(name, tmp_path)
        for path in folder.rglob(f'*{STAMP // 10**9}*.json'):
            content = json.loads(path.read_text())
            for item in content['objects'] if name == 'xtreme1' else content:
                if 'boxreg' not in item:
                    continue
                del item['boxreg']
                values = [{'name': 'occluded', 'value': 'partly'}, {'name': 'x', 'value': []}]
                item[key] = values if name == 'xtreme1' else 'parked, night'
            path.write_text(json.dumps(content))
        found = next(frames_of(name, folder)).refined.boxes.attributes[0]
        expected = {'parked': 'true', 'night': 'true'}
        assert found == ({'occluded': 'partly'} if name == 'xtreme1' else expected)


def test_kitti_object_of_others_has_its_two_columns(tmp_path):
    folder = written('kitti_object', tmp_path)
    shutil.rmtree(folder / 'boxreg')
    boxes = next(frames_of('kitti_object', folder)).refined.boxes
    assert [dict(boxes.attributes_of(row)) for row in range(3)] == [
        {'occluded': 'true', 'truncated': 'false'},
        {'occluded': 'false'},  # cut by the image, how much is not known
        {'truncated': 'false'},
    ]


def test_words_of_nuscenes_and_kitti():
    assert of_nuscenes(['vehicle.moving', 'occlusion_state.partial']) == {
        'vehicle': 'moving', 'occluded': 'partly',
    }  # fmt: skip
    assert to_nuscenes({'vehicle': 'moving', 'parked': 'true'}, 'vehicle.parked') == [
        'vehicle.parked'
    ]
    assert to_nuscenes({'parked': 'false'}, 'vehicle.parked') == []
    words = 'false', 'partly', 'true', '0', 'yes'
    assert [occlusion_of({'occluded': word}) for word in words] == [
        0, 1, 2, 0, 2,
    ]  # fmt: skip
    assert occlusion_of({}) == 3
    assert truncation_of({'truncated': '0.3'}, 0) == 1
    assert truncation_of({'truncated': 'false'}, 2) == 2  # no part of it is in the image
    assert attributes_of('0.31', '1') == {'occluded': 'partly', 'truncated': '0.31'}
    assert attributes_of('-1', '-1') == {}
    assert not is_set('0.0')
