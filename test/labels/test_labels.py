"""``boxes.csv`` and OpenLABEL: values, order and omitted boxes."""

import csv
from decimal import Decimal
from importlib import import_module
import json

from boxreg_ros.errors import ConfigError
from boxreg_ros.io.box_table import number_cells, single_precision
from boxreg_ros.io.covariance_table import read_covariances
from boxreg_ros.labels import FORMATS, LabelFrame, Provenance, writer_for
from boxreg_ros.labels.files import to_json
from boxreg_ros.structures import BoxArray, RefinedBoxes
import numpy as np
import pytest

TILTED = [1.5, -2.25, 0.1, 4.5, 1.8, 1.6, 0.1, -0.2, 2.5]
# The product of the half-angle quaternions about z (2.5), y (-0.2) and x (0.1).
TILTED_XYZW = (0.110302793714, 0.015752145824, 0.944636920052, 0.308619916523)
COLUMNS = (
    'stamp_ns,frame_id,track_id,class_name,score,x,y,z,qx,qy,qz,qw,length,width,height,status,'
    'num_points'
)


def refined(stamp_ns, tracks, boxes=None, frame_id='odom', status=None):
    n = len(tracks)
    boxes = np.array([TILTED] * n if boxes is None else boxes, dtype=float).reshape(n, 9)
    return RefinedBoxes(
        BoxArray(stamp_ns, frame_id, tuple(tracks), ('car',) * n, np.full(n, 0.75), boxes),
        status or ('refined',) * n,
        tuple('' if s == 'refined' else 'no_points' for s in status or ('refined',) * n),
        np.arange(n) + 7,
        np.zeros((n, 6, 6)),
    )


def write(name, folder, results):
    writer = writer_for(name, folder, Provenance(('drive.mcap',), 'cafe'))
    for result in results:
        writer.write(LabelFrame(result, 'odom', 'lidar'))
    writer.close()
    return writer


def rows_of(folder):
    with (folder / 'boxes.csv').open(newline='') as file:
        return list(csv.DictReader(file))


def openlabel_of(folder):
    """Return the content, checked against the schema and the rules of the standard."""
    path = folder / 'openlabel' / 'labels.json'
    checker = pytest.importorskip('openlabel_checker', reason='openlabel-checker not installed')
    report = checker.check_file(str(path))
    assert [issue for outcome in report.outcomes for issue in outcome.issues] == []
    return json.loads(path.read_text())['openlabel']


# boxes.csv -------------------------------------------------------------------------------------


def test_columns_and_golden_values(tmp_path):
    write('csv', tmp_path, [refined(1_700_000_000_123_456_789, ['a,"b'], status=('kept',))])
    assert (tmp_path / 'boxes.csv').read_text().splitlines()[0] == COLUMNS
    (row,) = rows_of(tmp_path)
    assert row['stamp_ns'] == '1700000000123456789'
    assert (row['frame_id'], row['track_id'], row['class_name']) == ('odom', 'a,"b', 'car')
    assert (row['score'], row['status'], row['num_points']) == ('0.75', 'kept', '7')
    numbers = [float(row[name]) for name in ('x', 'y', 'z', 'length', 'width', 'height')]
    assert numbers == TILTED[:6]
    quaternion = [float(row[name]) for name in ('qx', 'qy', 'qz', 'qw')]
    np.testing.assert_allclose(quaternion, TILTED_XYZW, atol=1e-9)


def test_cells_in_single_precision_are_short_and_exact():
    numbers = np.array([[0.1, 1 / 3, -2e-9], [np.nan, 1e300, 0.0]])
    first, second = number_cells(single_precision(numbers), 'nan')
    assert first.startswith('0.1,0.33333334,')
    read = [float(text) for text in first.split(',')]
    np.testing.assert_array_equal(np.float32(read), np.float32(numbers[0]))
    assert second == 'nan,nan,0.0'
    assert number_cells(numbers[:0], '') == []


def test_names_of_any_characters_are_read_again(tmp_path):
    names = ['', 'a,"b', 'two\nlines', ' blanks ', '"']
    write('csv', tmp_path, [refined(1, names)])
    assert [row['track_id'] for row in rows_of(tmp_path)] == names
    assert list(read_covariances(tmp_path / 'covariances.csv')) == [(1, name) for name in names]


def test_numbers_keep_their_full_precision(tmp_path):
    box = np.array(TILTED)
    box[0] = 1 / 3 + 5e5
    write('csv', tmp_path, [refined(1, ['a'], [box])])
    assert float(rows_of(tmp_path)[0]['x']) == box[0]


def test_numbers_are_written_with_as_few_digits_as_python_writes(tmp_path):
    rng = np.random.default_rng(0)
    edges = [1e-4, np.nextafter(1e-4, 0), 1e-5, 1e15, 1e16, np.nextafter(1e16, 0), 0.0, -0.0, 3.0]
    magnitudes = 10.0 ** rng.uniform(-25, 25, 600)
    numbers = [*edges, *magnitudes * rng.choice([-1, 1], len(magnitudes))]
    places = np.reshape(numbers, (-1, 3))
    boxes = np.array([TILTED] * len(places))
    boxes[:, :3] = places
    write('csv', tmp_path, [refined(1, [*map(str, range(len(boxes)))], boxes)])
    written = [row[name] for row in rows_of(tmp_path) for name in 'xyz']
    assert [repr(float(text)) for text in written] == [repr(x) for x in places.ravel().tolist()]
    digits = [Decimal(text).normalize().as_tuple().digits for text in written]
    assert digits == [
        Decimal(repr(x)).normalize().as_tuple().digits for x in places.ravel().tolist()
    ]


def test_values_that_are_not_finite_are_empty_cells(tmp_path):
    boxes = np.array([TILTED, TILTED])
    boxes[0, 1], boxes[1, 8] = np.nan, np.inf
    write('csv', tmp_path, [refined(1, ['a', 'b'], boxes)])
    first, second = rows_of(tmp_path)
    assert (first['x'], first['y'], first['qw'] != '') == ('1.5', '', True)
    assert (second['x'], second['qx'], second['qy'], second['qz'], second['qw']) == (
        '1.5', '', '', '', '',
    )  # fmt: skip


def test_rows_are_sorted_by_stamp_if_boxes_arrive_late(tmp_path):
    results = [refined(10, ['a', 'b']), refined(30, ['c']), refined(20, ['e', 'd'])]
    write('csv', tmp_path, [*results, refined(10, ['f'])])
    assert [row['track_id'] for row in rows_of(tmp_path)] == ['a', 'b', 'f', 'e', 'd', 'c']


def test_file_without_boxes_has_a_header(tmp_path):
    write('csv', tmp_path, [refined(1, [])])
    assert (tmp_path / 'boxes.csv').read_text() == COLUMNS + '\n'


# OpenLABEL -------------------------------------------------------------------------------------


def test_openlabel_golden_values(tmp_path):
    write('openlabel', tmp_path, [refined(1_500_000_000, ['x7'], status=('kept',))])
    label = openlabel_of(tmp_path)
    assert label['metadata']['schema_version'] == '1.0.0'
    frame = label['frames']['0']
    assert frame['frame_properties'] == {'timestamp': 1.5, 'stamp_ns': 1_500_000_000}
    (cuboid,) = frame['objects']['0']['object_data']['cuboid']
    assert cuboid['coordinate_system'] == 'odom'
    np.testing.assert_allclose(cuboid['val'], [*TILTED[:3], *TILTED_XYZW, *TILTED[3:6]], atol=1e-9)
    texts = {item['name']: item['val'] for item in cuboid['attributes']['text']}
    numbers = {item['name']: item['val'] for item in cuboid['attributes']['num']}
    assert texts == {'status': 'kept', 'reason': 'no_points'}
    assert numbers == {'num_points': 7, 'score': 0.75}
    assert (label['objects']['0']['name'], label['objects']['0']['type']) == ('x7', 'car')
    assert list(label['coordinate_systems']) == ['odom']


def test_openlabel_intervals_are_those_of_the_tracks(tmp_path):
    tracks = [['a', 'b'], ['a'], ['b', 'a'], [], ['b']]
    write('openlabel', tmp_path, [refined(k, names) for k, names in enumerate(tracks)])
    label = openlabel_of(tmp_path)
    assert label['frame_intervals'] == [{'frame_start': 0, 'frame_end': 4}]
    assert list(label['frames']) == ['0', '1', '2', '3', '4']
    intervals = {
        item['name']: [(i['frame_start'], i['frame_end']) for i in item['frame_intervals']]
        for item in label['objects'].values()
    }
    assert intervals == {'a': [(0, 2)], 'b': [(0, 0), (2, 2), (4, 4)]}
    for item in label['objects'].values():
        pointer = item['object_data_pointers']['box']
        assert (pointer['type'], pointer['frame_intervals']) == ('cuboid', item['frame_intervals'])


def test_openlabel_boxes_without_track_id_are_separate_objects(tmp_path):
    write('openlabel', tmp_path, [refined(1, ['', 'a', '', 'a']), refined(2, ['', 'a'])])
    label = openlabel_of(tmp_path)
    assert [item['name'] for item in label['objects'].values()] == ['', 'a', '', 'a', '']
    assert sorted(label['frames']['1']['objects']) == ['1', '4']


def test_openlabel_omits_invalid_boxes(tmp_path):
    boxes = np.array([TILTED, TILTED, TILTED, TILTED])
    boxes[0, 0], boxes[1, 8], boxes[2, 4] = np.nan, np.inf, 0.0
    write('openlabel', tmp_path, [refined(1, ['a', 'b', 'c', 'd'], boxes)])
    assert [item['name'] for item in openlabel_of(tmp_path)['objects'].values()] == ['d']


def test_openlabel_without_frames(tmp_path):
    write('openlabel', tmp_path, [])
    label = openlabel_of(tmp_path)
    assert (label['frames'], label['objects']) == ({}, {})


def test_openlabel_lists_all_coordinate_systems(tmp_path):
    results = [refined(1, ['a']), refined(2, ['a'], frame_id='lidar')]
    write('openlabel', tmp_path, results)
    assert sorted(openlabel_of(tmp_path)['coordinate_systems']) == ['lidar', 'odom']


def test_formats_state_all_conventions():
    with pytest.raises(ConfigError, match=r"'kiti': expected one of csv, .*did you mean kitti\?"):
        writer_for('kiti', None, Provenance())
    for name in FORMATS:
        conventions = import_module(FORMATS[name]).FORMAT
        assert conventions.name == name
        optional = {'packages', 'options', 'has_points', 'reads', 'leaves_out', 'read_back'}
        required = set(conventions.__slots__) - optional
        assert all(getattr(conventions, field) for field in required)


def test_json_is_standard_json():
    value = {1: [np.nan, np.float64('inf'), 1e-9, np.float64(0.1)], 'é': None}
    text = to_json(value)
    assert 'é' in text  # not escaped

    def refuse_constant(constant):
        raise AssertionError(f'{constant} is not JSON')

    assert json.loads(text, parse_constant=refuse_constant) == {
        '1': [None, None, 1e-9, 0.1],
        'é': None,
    }
