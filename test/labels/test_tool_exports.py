"""Label files as other tools export them, made here with their layouts, and by their libraries."""

from collections import Counter
import json
import shutil

from boxreg_ros.cli import main
from boxreg_ros.errors import RecordingError
from boxreg_ros.labels import frames_of, LabelFrame
from boxreg_ros.labels.merging import keyframes_of
from boxreg_ros.labels.sidecar import filled_stamps, read_poses, read_stamps, whole_stamps
from boxreg_ros.labels.stamps import stamps_ns, stamps_of_names
from boxreg_ros.structures import BoxArray, RefinedBoxes
from consumers import consumer
import numpy as np
import pytest
from relabel_results import rows_of
from ros_messages import Drive
from test_labels_tools import CENTER, CLOUD, EXTENT, frame, NAME, STAMP, vector, write

S = 10**9
AT = 1_700_000_000 * S


def read(name, path):
    return list(frames_of(name, path))


def ids(frames):
    return [frame.refined.boxes.track_ids for frame in frames]


def stamps(frames):
    return [frame.refined.boxes.stamp_ns for frame in frames]


def put(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def put_stamps(folder, count, step=S // 10):
    put(folder / 'timestamps.txt', ''.join(f'{AT + i * step}\n' for i in range(count)))


# Stamps ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ('values', 'expected'),
    [
        (['1700000000.123456789'], [AT + 123_456_789]),  # a float would round it
        ([1700000000.1], [AT + S // 10]),
        ([1700000000123, 1700000000223], [AT + 123_000_000, AT + 223_000_000]),
        ([1700000000123456], [AT + 123_456_000]),
        ([str(AT + 1)], [AT + 1]),
        ([0, '0.1'], [0, S // 10]),
        (['2023-11-14T22:13:20.123456789Z'], [AT + 123_456_789]),
        (['2023-11-14T23:13:20,5+01:00', '2023-11-14 22:13:20'], [AT + S // 2, AT]),
        # Since the first frame, as Kognic states them: the rate of labels shows the unit.
        ([0, 100, 200], [0, S // 10, S // 5]),
        ([0, 50_000, 150_000], [0, S // 20, S * 15 // 100]),
        ([5, 5.5, 6], [5 * S, 5 * S + S // 2, 6 * S]),
        ([10**8, 2 * 10**8], [10**8, 2 * 10**8]),
        ([1_600_000_000, 1_700_000_000], [1_600_000_000, 1_700_000_000]),  # 1.6 s in ns
    ],
)
def test_stamps_are_exact_in_any_unit(values, expected):
    assert stamps_ns(values) == expected


@pytest.mark.parametrize('value', ['soon', None, True, -1, '1e400', 'nan', [1], 10**30])
def test_values_that_are_no_stamps_are_refused(value):
    with pytest.raises(ValueError, match='expected'):
        stamps_ns([value])


@pytest.mark.parametrize(
    ('lines', 'expected'),
    [
        (['100', '200'], [100, 200]),  # whole nanoseconds, as we write them
        (['1600000000', '', '1700000000'], [1_600_000_000, 1_650_000_000, 1_700_000_000]),
        (['1700000000'], [1_700_000_000]),
        (['1700000000000000', '1700000000100000'], [AT, AT + S // 10]),
        (['1700000000.25', '1700000000.5'], [AT + S // 4, AT + S // 2]),
        (['0.0', '0.1'], [0, S // 10]),
    ],
)
def test_stamps_beside_labels_in_any_unit(tmp_path, lines, expected):
    path = put(tmp_path / 'timestamps.txt', ''.join(f'{line}\n' for line in lines))
    assert whole_stamps(path) == expected


def test_a_single_stamp_is_not_that_of_another_frame():
    assert filled_stamps([]) == filled_stamps([None]) == []
    assert filled_stamps([5]) == filled_stamps([5, None]) == [5]
    assert filled_stamps([None, 5, 7]) == [3, 5, 7]
    with pytest.raises(RecordingError, match='got one, in line 2; write the stamp of each frame'):
        filled_stamps([None, 5])


@pytest.mark.parametrize('read', [read_stamps, lambda path: read_poses(path, 3)])
def test_a_folder_in_place_of_stamps_or_poses_is_named(tmp_path, read):
    with pytest.raises(RecordingError, match='cannot be read: Is a directory'):
        read(tmp_path)


@pytest.mark.parametrize(
    ('names', 'expected'),
    [
        (['1700000000.5', '1700000000.123456'], [AT + S // 2, AT + 123_456_000]),
        (['1700000000_000000007'], [AT + 7]),
        (['frame_1700000000123456'], [AT + 123_456_000]),
        (['0000000012300000000', '0000000012300000000_1'], [12_300_000_000] * 2),
        (['n015-2018-07-18-11-07-57+0800__LIDAR_TOP__1531883530449377'], [1531883530449377000]),
        (['frame_000001_1700000000123'], [AT + 123_000_000]),
        (['0000000000', '0000000001'], None),  # of KITTI raw: numbers of frames
        (['0000000000001'], None),
        (['000950', '000965'], None),
        (['1700000000', '1700000000123'], None),  # two units
        ([], None),
    ],
)
def test_names_of_files_state_stamps(names, expected):
    assert stamps_of_names(names) == expected


@pytest.mark.parametrize(
    'name', ['sustechpoints', 'datumaro', 'supervisely', 'sly_pointcloud', 'xtreme1', 'openpcdet']
)
def test_files_named_by_stamps_need_no_other_file(tmp_path, name):
    write(name, tmp_path, [frame(STAMP + i, ['a']) for i in (0, 1, 1)], with_points=True)
    (tmp_path / name / 'timestamps.txt').unlink()
    (tmp_path / name / 'poses.txt').unlink()
    assert stamps(read(name, tmp_path / name)) == [STAMP, STAMP + 1, STAMP + 1]


def test_tracklets_take_the_stamps_of_the_list_of_frames(tmp_path):
    write('tracklets', tmp_path, [frame(STAMP + i, ['a']) for i in range(2)])
    folder = tmp_path / 'tracklets'
    (folder / 'timestamps.txt').unlink()
    (folder / 'poses.txt').unlink()
    with pytest.raises(RecordingError, match='not found, and these labels have no stamps'):
        read('tracklets', folder)
    put(folder / 'frame_list.txt', f'0 {STAMP}\n1 {STAMP + 5}\n')
    assert stamps(read('tracklets', folder)) == [STAMP, STAMP + 5]


# Keyframes ---------------------------------------------------------------------------------------


def cuboid(x, **attributes):
    return {
        'type': 'cuboid_3d', 'label_id': 0, 'position': [x, 3, -1], 'rotation': [0, 0, 0.3],
        'scale': [4.5, 1.9, 1.6], 'attributes': {'track_id': 0, **attributes},
    }  # fmt: skip


def datumaro(folder, items):
    labels = {'label': {'labels': [{'name': 'car'}]}}
    put(folder / 'annotations/default.json', {'categories': labels, 'items': items})
    return folder


def test_datumaro_marks_what_cvat_interpolated(tmp_path):
    boxes = [cuboid(1, keyframe=True), cuboid(2, keyframe=False), cuboid(3, status='parked')]
    boxes[2]['attributes']['track'] = 'left'  # an attribute of a user
    folder = datumaro(tmp_path, [{'id': f'{AT}', 'annotations': boxes}])
    (found,) = read('datumaro', folder)
    assert ids([found]) == [('0', '0', '0')]
    assert found.refined.status == ('input', 'interpolated', 'input')
    assert len(found.keyframes().refined.status) == 2
    assert found.keyframes().left_out == {'not_a_keyframe': 1}


def test_datumaro_marks_objects_that_have_left_and_writes_flags_as_text(tmp_path):
    boxes = [cuboid(1, outside=True), cuboid(2, keyframe='false'), cuboid(3, keyframe='true')]
    (found,) = read('datumaro', datumaro(tmp_path, [{'id': f'{AT}', 'annotations': boxes}]))
    assert found.refined.status == ('interpolated', 'input')
    assert found.left_out == {'no_box': 1}
    wrong = [{'id': f'{AT}', 'annotations': [cuboid(1) | {'label_id': 1}]}]
    with pytest.raises(RecordingError, match='expected a label_id of 1 labels, got 1'):
        read('datumaro', datumaro(tmp_path, wrong))


def test_cvat_finds_the_tracks_of_our_export(tmp_path):
    """It makes tracks of shapes with a keyframe, and single shapes of those without."""
    write('datumaro', tmp_path, [frame(STAMP, ['a'], status=('interpolated',))])
    (item,) = consumer('datumaro', tmp_path / 'datumaro')['cuboids']
    assert item['attributes']['keyframe'] is True
    (found,) = read('datumaro', tmp_path / 'datumaro')
    assert found.refined.status == ('interpolated',)


def psr(x, **more):
    axes = {'position': [x, 2, 3], 'scale': [4, 2, 1.5], 'rotation': [0, 0, 0.5]}
    values = {name: dict(zip('xyz', three, strict=True)) for name, three in axes.items()}
    return {'psr': values, 'obj_type': 'Car', 'obj_id': '3', **more}


def test_sustechpoints_names_the_algorithm_of_a_box(tmp_path):
    items = [psr(i, annotator=word) for i, word in enumerate(['i', 'I', 'S', 'a', ''])]
    put(tmp_path / 'label' / f'{AT}.json', [*items, psr(9)])
    (found,) = read('sustechpoints', tmp_path)
    assert found.refined.status == (
        'interpolated', 'interpolated', 'automatic', 'automatic', 'input', 'input',
    )  # fmt: skip


def figure(key, **more):
    axes = {'position': [1, 2, 3], 'rotation': [0, 0, 0.5], 'dimensions': [4, 2, 1.5]}
    geometry = {name: dict(zip('xyz', three, strict=True)) for name, three in axes.items()}
    return {'objectKey': key, 'geometryType': 'cuboid_3d', 'geometry': geometry, **more}


def test_supervisely_marks_what_a_model_or_a_tracker_made(tmp_path):
    figures = [
        figure('a'),
        figure('a', nnCreated=True, nnUpdated=True),
        figure('a', nnCreated=True, nnUpdated=False),  # a person has corrected it
        figure('a', trackId='7'),
        {'objectId': 5, 'geometryType': 'point_cloud', 'geometry': {}},
    ]
    objects = [{'key': 'a', 'id': 5, 'classTitle': 'car'}]
    frames = [{'index': 0, 'figures': figures}]
    put(tmp_path / 'ep/annotation.json', {'objects': objects, 'frames': frames})
    put(tmp_path / 'ep/frame_pointcloud_map.json', {'0': f'{AT}.pcd'})
    (found,) = read('supervisely', tmp_path)
    assert found.refined.status == ('input', 'automatic', 'input', 'automatic')


TRACKLET = """<item><objectType>{name}</objectType><h>{h}</h><w>{w}</w><l>{l}</l>
<first_frame>0</first_frame><poses><count>2</count>{poses}</poses></item>"""
POSE = """<item><tx>{x}</tx><ty>2</ty><tz>-1</tz><rx>0</rx><ry>0</ry><rz>0</rz>{flags}</item>"""


def tracklets(folder, items, count=2):
    texts = [
        TRACKLET.format(
            name=name, h=sizes[0], w=sizes[1], l=sizes[2],
            poses=''.join(POSE.format(x=i, flags=one) for i, one in enumerate(flags)),
        )
        for name, sizes, flags in items
    ]  # fmt: skip
    text = f'<boost_serialization><tracklets>{"".join(texts)}</tracklets></boost_serialization>'
    put(folder / 'tracklet_labels.xml', text)
    put_stamps(folder, count)
    return folder


def test_kitti_states_how_a_pose_was_made(tmp_path):
    """The development kit of KITTI raw: 0 is unset, 1 interpolated, 2 labelled."""
    flags = [f'<state>{state}</state>' for state in (2, 1, 0)]
    folder = tracklets(tmp_path, [('Car', (1.5, 1.8, 4), flags)], 3)
    status = [one.refined.status for one in read('tracklets', folder)]
    assert status == [('input',), ('interpolated',), ('input',)]


def test_only_the_keyframes_of_a_person_are_followed(tmp_path, capsys):
    """Between them are boxes 2 m off, as a tool may have interpolated them."""
    drive = Drive(sweeps=7)
    arrays, between = [], 0
    for k, (stamp, boxes) in enumerate(drive.truth.items()):
        status = ('interpolated' if k % 3 else 'input',) * 2
        given = boxes + np.eye(9)[1] * (2.0 if k % 3 else 0.0)
        array = BoxArray(stamp, 'odom', ('1', '2'), ('car', 'car'), np.ones(2), given)
        refined = RefinedBoxes(array, status, ('', ''), np.zeros(2, int), np.zeros((2, 6, 6)))
        arrays.append(LabelFrame(refined, 'odom', 'lidar'))
        between += status.count('interpolated')
    write('csv', tmp_path, arrays)
    words = ['relabel', str(drive.write(tmp_path / 'drive')), '-o', str(tmp_path / 'out')]
    words += ['--labels', f'csv:{tmp_path}/boxes.csv', '--keyframes', '--set=solver.rounds=2']
    assert main(words) == 0
    assert f'labels: {between} boxes are left out (not_a_key' in capsys.readouterr().err
    summary = json.loads((tmp_path / 'out' / 'summary.json').read_text())
    assert summary['labels']['left_out'] == {'not_a_keyframe': between}
    rows = rows_of(tmp_path / 'out')
    assert len(rows) == 14
    for row in rows:
        true = drive.truth[int(row['stamp_ns'])][int(row['track_id']) - 1]
        assert abs(float(row['y']) - true[1]) < 0.3


def test_labels_without_a_keyframe_of_a_person_are_refused():
    given = frame(STAMP, ['a', 'b'], status=('interpolated', 'automatic'))
    with pytest.raises(RecordingError, match='that a person placed, got 1 interpolated, 1 autom'):
        list(keyframes_of(iter([given])))


# Tracklets of Datumaro and CVAT ------------------------------------------------------------------

CAR = (4.5, 1.9, 1.6)
PERSON = (0.8, 0.6, 1.75)


@pytest.mark.parametrize(
    ('tags', 'is_centre', 'program'),
    [('lwh', False, ''), ('hwl', True, 'Datumaro'), ('whl', True, 'CVAT')],
)
@pytest.mark.parametrize('size', [CAR, PERSON])
def test_extents_of_tracklets_are_read_as_their_program_writes_them(
    tmp_path, tags, is_centre, program, size
):
    """`tags` are those of the extents along x, y and z."""
    values = dict(zip(tags, size, strict=True))
    name = 'Car' if size is CAR else 'Pedestrian'
    item = (name, tuple(values[tag] for tag in 'hwl'), ['', ''])
    first, _ = read('tracklets', tracklets(tmp_path, [item]))
    box = first.refined.boxes.boxes[0]
    assert box[2] == pytest.approx(-1 if is_centre else -1 + size[2] / 2)
    assert box[5] == size[2]
    assert bool(first.note) is is_centre
    if size is CAR:  # along x and y a person may be of any size
        assert tuple(box[3:6]) == size
        assert program in first.note


def test_datumaro_itself_writes_tracklets_that_are_read_right(tmp_path):
    box = [8, 1, 0, *CAR, 0, 0, 0.2]
    # In the second frame the car is not seen; Datumaro repeats the first pose there.
    frames = [
        frame(STAMP + i, ['3'] * (i != 1), boxes=[box] * (i != 1), sweep=CLOUD) for i in range(3)
    ]
    write('datumaro', tmp_path, frames)
    consumer('datumaro_tracklets', tmp_path / 'datumaro', tmp_path / 'kitti')
    found = read('tracklets', tmp_path / 'kitti')
    given = read('datumaro', tmp_path / 'datumaro')
    assert stamps(found) == [STAMP, STAMP + 1, STAMP + 2]
    assert ids(found) == [('0',), (), ('0',)]
    assert found[1].left_out == {'no_box': 1}
    for one, two in zip(given, found, strict=True):
        sensor = one.moved('sensor').refined.boxes.boxes
        np.testing.assert_allclose(two.refined.boxes.boxes, sensor, atol=0.0051)  # two digits


def test_poses_with_which_datumaro_fills_a_gap_are_no_boxes(tmp_path):
    shown = '<occlusion>0</occlusion><truncation>0</truncation>'
    gone = '<occlusion>-1</occlusion><truncation>2</truncation>'
    item = ('Car', (4.5, 1.9, 1.6), [shown, gone, shown])
    first, second, _ = read('tracklets', tracklets(tmp_path, [item], 3))
    assert ids([first, second]) == [('0',), ()]
    assert second.left_out == {'no_box': 1}
    item = ('Car', (1.6, 1.9, 4.5), [shown, gone, shown])  # KITTI labels what is out of the image
    assert ids(read('tracklets', tracklets(tmp_path, [item], 3))) == [('0',)] * 3


def test_rejected_boxes_of_a_result_are_no_input(tmp_path, capsys):
    """A box that a person has deleted does not come back, nor is it followed as a keyframe."""
    drive = Drive(sweeps=7)
    arrays = []
    for stamp, boxes in drive.truth.items():
        array = BoxArray(stamp, 'odom', ('1', '2'), ('car', 'car'), np.ones(2), boxes)
        status = ('refined', 'rejected')
        refined = RefinedBoxes(array, status, ('', ''), np.zeros(2, int), np.zeros((2, 6, 6)))
        arrays.append(LabelFrame(refined, 'odom', 'lidar'))
    write('csv', tmp_path, arrays)
    recording = str(drive.write(tmp_path / 'drive'))
    for options in ([], ['--keyframes']):
        out = tmp_path / f'out{len(options)}'
        words = ['relabel', recording, '-o', str(out), '--labels', f'csv:{tmp_path}/boxes.csv']
        assert main([*words, '--set=solver.rounds=2', *options]) == 0
        assert 'labels: 7 boxes are left out (rejected_label)' in capsys.readouterr().err
        assert {row['track_id'] for row in rows_of(out)} == {'1'}


@pytest.mark.parametrize('options', ['--complete', '--keyframes'])
def test_no_box_is_added_where_a_result_has_a_rejected_one(tmp_path, options):
    drive = Drive(sweeps=9)
    arrays = []
    for k, (stamp, boxes) in enumerate(drive.truth.items()):
        array = BoxArray(stamp, 'odom', ('1', '2'), ('car', 'car'), np.ones(2), boxes)
        status = ('rejected' if k == 4 else 'refined', 'refined')
        refined = RefinedBoxes(array, status, ('', ''), np.zeros(2, int), np.zeros((2, 6, 6)))
        arrays.append(LabelFrame(refined, 'odom', 'lidar'))
    write('csv', tmp_path, arrays)
    words = f'relabel {drive.write(tmp_path / "drive")} --labels csv:{tmp_path}/boxes.csv'
    assert main([*words.split(), '-o', f'{tmp_path}/out', options]) == 0
    stamps_of = Counter(row['stamp_ns'] for row in rows_of(tmp_path / 'out'))
    assert list(stamps_of.values()) == [2] * 4 + [1] + [2] * 4


def test_keyframes_of_cvat_in_tracklets(tmp_path):
    flags = [f'<state>2</state><occlusion_kf>{kf}</occlusion_kf>' for kf in (1, 0)]
    item = ('Car', (4.5, 1.9, 1.6), flags)
    status = [one.refined.status for one in read('tracklets', tracklets(tmp_path, [item]))]
    assert status == [('input',), ('interpolated',)]


# OpenLABEL ---------------------------------------------------------------------------------------


def test_openlabel_of_vcd(tmp_path):
    """A static object, quaternions and angles as poses, a chain of them, stamps of ISO 8601."""
    path = tmp_path / 'labels.json'
    parked, moving = consumer('vcd_write', path)
    found = read('openlabel', path)
    assert stamps(found) == [AT + i * S + 123_456_789 for i in range(3)]
    for i, one in enumerate(found):
        boxes = one.refined.boxes
        assert set(boxes.track_ids) == {parked, moving}
        assert (one.fixed_frame, one.sensor_frame, boxes.frame_id) == ('odom', 'lidar', 'lidar')
        T = consumer('vcd_transform', path, 'lidar', 'odom', i)
        np.testing.assert_allclose(one.T_fixed_sensor, T, atol=1e-12)
        fixed = one.moved('fixed').refined.boxes
        row = fixed.track_ids.index(parked)
        np.testing.assert_allclose(
            fixed.boxes[row], [20, 3, 0.5, 4.5, 1.9, 1.6, 0, 0, 0], atol=1e-9
        )


def test_vcd_reads_and_validates_our_openlabel(tmp_path):
    write('openlabel', tmp_path, [frame(STAMP, ['a', 'b']), frame(STAMP + 1, ['b'])])
    labels = consumer('vcd_labels', tmp_path / 'openlabel/labels.json')
    assert {number: sorted(found) for number, found in labels.items()} == {
        '0': ['0', '1'], '1': ['1'],
    }  # fmt: skip
    T = consumer('vcd_transform', tmp_path / 'openlabel/labels.json', 'lidar', 'odom', 0)
    (one, _) = read('openlabel', tmp_path / 'openlabel')
    np.testing.assert_allclose(T, one.T_fixed_sensor, atol=1e-12)


def openlabel(path, frames, objects, **more):
    return put(path, {'openlabel': {'objects': objects, 'frames': frames, **more}})


def val(x, **more):
    return {'name': 'box', 'val': [x, 3, -1, 0, 0, 0, 1, 4.5, 1.9, 1.6], **more}


def objects_of(*cuboids):
    return {'0': {'object_data': {'cuboid': list(cuboids)}}}


CLASSES = {'0': {'name': 'car1', 'type': 'car'}}


def test_openlabel_cuboids_of_an_object_are_in_the_frames_of_its_intervals(tmp_path):
    static = {
        '1': {
            'name': 'p', 'type': 'car', 'object_data': {'cuboid': [val(20)]},
            'frame_intervals': [{'frame_start': 1, 'frame_end': 1}],
        }
    }  # fmt: skip
    frames = {str(i): {'frame_properties': {'timestamp': i}} for i in range(3)}
    path = openlabel(tmp_path / 'a.json', frames, CLASSES | static)
    assert ids(read('openlabel', path)) == [(), ('1',), ()]


def test_openlabel_several_cuboids_of_an_object_and_null(tmp_path):
    others = [val(5) | {'name': 'trailer'}, val(1.5) | {'name': 'open doors'}]
    cuboids = [val(1), *others, {'name': 'gone', 'val': None}]
    frames = {'0': {'frame_properties': {'timestamp': 1}, 'objects': objects_of(*cuboids)}}
    (found,) = read('openlabel', openlabel(tmp_path / 'a.json', frames, CLASSES))
    assert ids([found]) == [('0', '0/trailer')]
    assert found.left_out == {'no_box': 1, 'duplicate_track_id': 1}
    assert 'got several, 1 times: those after the first are tracks of their own' in found.note


def test_openlabel_interpolated_by_its_tool(tmp_path):
    flags = [
        {'boolean': [{'name': 'interpolated', 'val': True}], 'text': [{'name': 'status'}]},
        {'boolean': [{'name': 'keyframe', 'val': False}]},
        {'text': [{'name': 'interpolated', 'val': 'false'}, {'name': 'keyframe', 'val': 'True'}]},
    ]
    cuboids = [val(9 * i, attributes=flag) | {'name': f'{i}'} for i, flag in enumerate(flags)]
    frames = {'0': {'frame_properties': {'timestamp': 1}, 'objects': objects_of(*cuboids)}}
    (found,) = read('openlabel', openlabel(tmp_path / 'a.json', frames, CLASSES))
    assert found.refined.status == ('interpolated', 'interpolated', 'input')


def test_openlabel_with_stamps_since_the_first_frame_says_their_unit(tmp_path):
    """Kognic: whole milliseconds. Frames in another order than their stamps are sorted."""
    frames = {
        str(i): {'frame_properties': {'timestamp': at}, 'objects': objects_of(val(i))}
        for i, at in enumerate([100, 0, 200])
    }
    found = read('openlabel', openlabel(tmp_path / 'a.json', frames, CLASSES))
    assert stamps(found) == [0, S // 10, S // 5]
    assert [one.refined.boxes.boxes[0, 0] for one in found] == [1, 0, 2]
    assert found[0].note == 'stamps: 100 from frame to frame are read as milliseconds'


def test_openlabel_of_programs_that_state_classes_in_frames(tmp_path):
    objects = objects_of(val(1, attributes={'num': [{'name': 'confidence', 'val': 0.5}]}))
    objects['0']['type'] = 'truck'
    frames = {'0': {'frame_properties': {'timestamp': 1}, 'objects': objects}}
    (found,) = read('openlabel', openlabel(tmp_path / 'a.json', frames, {}))
    assert found.refined.boxes.class_names == ('truck',)
    assert found.refined.boxes.scores == [0.5]


def test_openlabel_without_stamps_names_the_frame_and_the_file(tmp_path):
    frames = {'4': {'objects': objects_of(val(1))}}
    path = openlabel(tmp_path / 'a.json', frames, CLASSES)
    with pytest.raises(RecordingError, match=r"frame 4: lacks 'timestamp'.*timestamps.txt"):
        read('openlabel', path)
    put_stamps(tmp_path, 1)
    assert stamps(read('openlabel', path)) == [AT]


# Xtreme1 -----------------------------------------------------------------------------------------


def object_of(x, track_id='A', track_name='1', **more):
    axes = {'center3D': [x, 3, -1], 'rotation3D': [0, 0, 0.1], 'size3D': [4.5, 1.9, 1.6]}
    contour = {name: dict(zip('xyz', three, strict=True)) for name, three in axes.items()}
    ids = {'trackId': track_id, 'trackName': track_name}
    return {'type': '3D_BOX', 'className': 'car', **ids, 'contour': contour, **more}


def result(source, *objects):
    return {'version': 'Xtreme1 v0.6', 'sourceName': source, 'objects': list(objects)}


def xtreme1(folder, *contents):
    for i, content in enumerate(contents):
        put(folder / f'result/{AT + i}.json', content)
    return folder


def test_xtreme1_of_several_sources(tmp_path):
    truth, model = result('Ground Truth', object_of(1)), result('model', object_of(1.3, 'm'))
    folder = xtreme1(tmp_path / 'a', [truth, model], [truth, model])
    found = read('xtreme1', folder)
    assert ids(found) == [('A',)] * 2
    assert found[0].left_out == {'other_source': 1}
    assert ids(frames_of('xtreme1', folder.with_name('a#model'))) == [('m',)] * 2
    with pytest.raises(RecordingError, match=r"a source 'none', got 'Ground Truth' \(2 frames\)"):
        read('xtreme1', folder.with_name('a#none'))
    other = result('model 2', object_of(1.5))
    folder = xtreme1(tmp_path / 'b', [model, other])
    with pytest.raises(RecordingError, match=r"'model 2' \(1 frames\); name the .*b#SOURCE"):
        read('xtreme1', folder)


def test_xtreme1_marks_what_a_model_made(tmp_path):
    """A person who takes a box of a model for ground truth leaves its confidence as it is."""
    truth = result('Ground Truth', object_of(1, modelConfidence=0.9))
    model = result('model', object_of(1.3, 'm', modelConfidence=0.8))
    folder = xtreme1(tmp_path, [truth, model])
    assert [one.refined.status for one in read('xtreme1', folder)] == [('input',)]
    (found,) = frames_of('xtreme1', folder.with_name(f'{folder.name}#model'))
    assert (found.refined.status, found.refined.boxes.scores[0]) == (('automatic',), 0.8)


def test_xtreme1_names_of_tracks_start_again_in_each_frame(tmp_path):
    contents = [[result('x', object_of(1, f'id{i}', '1'))] for i in range(2)]
    assert ids(read('xtreme1', xtreme1(tmp_path, *contents))) == [('id0',), ('id1',)]


def test_xtreme1_objects_without_contour_and_of_older_versions(tmp_path):
    null = object_of(1, contour=None)
    bare = {key: value for key, value in object_of(2).items() if not key.startswith('track')}
    bare['type'] = None
    old = {'objType': '3d', 'classType': 'car', **object_of(3)['contour']}
    folder = xtreme1(
        tmp_path, [result('s', null)], [result('s', bare)], {'result': {'objects': [old]}},
        [{'sourceName': 's', 'objects': None}],
    )  # fmt: skip
    put(folder / f'result/{AT + 2}.json', [{'sourceName': 's', 'result': {'objects': [old]}}])
    found = read('xtreme1', folder)
    assert ids(found) == [(), ('',), ('',), ()]
    assert found[0].left_out == {'no_box': 1}
    assert found[2].refined.boxes.class_names == ('car',)


# Partial and wrong files -------------------------------------------------------------------------


def test_a_partial_export_of_datumaro(tmp_path):
    """A part of the frames, by name or by number, of a file with the stamps of all."""
    put_stamps(tmp_path, 4)
    items = [{'id': f'{AT + S // 10:019d}', 'annotations': [cuboid(1)]}]
    found = read('datumaro', datumaro(tmp_path, items))
    assert ids(found) == [(), ('0',), (), ()]
    items = [
        {'id': f'frame_{i}', 'attr': {'frame': i}, 'annotations': [cuboid(i)]} for i in (1, 3)
    ]
    assert ids(read('datumaro', datumaro(tmp_path, items))) == [(), ('0',), (), ('0',)]
    items = [{'id': 'a', 'annotations': []}, {'id': 'b', 'annotations': []}]
    with pytest.raises(RecordingError, match='one stamp for each of 2 frames, got 4'):
        read('datumaro', datumaro(tmp_path, items))


LAYOUTS = {
    'datumaro': lambda path: datumaro(path, [{'id': f'{AT}', 'annotations': [cuboid(1)]}]),
    'sustechpoints': lambda path: put(path / 'label' / f'{AT}.json', [psr(1)]).parents[1],
    'sly_pointcloud': lambda path: sly_pointcloud(path),
    'xtreme1': lambda path: xtreme1(path, [result('s', object_of(1))]),
    'openlabel': lambda path: openlabel(
        path / 'labels.json',
        {'0': {'frame_properties': {'timestamp': 1}, 'objects': objects_of(val(1))}},
        CLASSES,
    ),
}


def sly_pointcloud(path):
    content = {'objects': [{'key': 'a', 'classTitle': 'car'}], 'figures': [figure('a')]}
    return put(path / f'ds0/ann/{AT}.pcd.json', content).parents[2]


def without_each(value, path=()):
    """Yield a JSON value without each of its parts, with each as null, and the place."""
    parts = value.items() if isinstance(value, dict) else enumerate(value)
    for key, part in parts:
        for change in ('removed', 'null', 'text'):
            changed = json.loads(json.dumps(value))
            if change == 'removed':
                del changed[key]
            else:
                changed[key] = None if change == 'null' else 'x'
            yield (*path, key, change), changed
        if isinstance(part, dict | list):
            for place, inner in without_each(part, (*path, key)):
                changed = json.loads(json.dumps(value))
                changed[key] = inner
                yield place, changed


@pytest.mark.parametrize('name', LAYOUTS)
def test_a_part_that_is_missing_is_no_fault_of_ours(tmp_path, name):
    """Each key of the file of a tool removed, null and of another type: boxes, or one error."""
    folder = LAYOUTS[name](tmp_path)
    (file,) = tmp_path.rglob('*.json')
    outcomes = Counter()
    for place, content in without_each(json.loads(file.read_text())):
        file.write_text(json.dumps(content))
        try:
            read(name, folder)
        except RecordingError as error:
            assert str(tmp_path) in str(error), place
            assert 'Error' not in str(error), (place, error)
            outcomes['refused'] += 1
        else:
            outcomes['read'] += 1
    assert outcomes['read'] and outcomes['refused']


def test_labels_without_a_valid_box_are_refused(tmp_path, capsys):
    """Labels of images alone have extents of -1."""
    line = 'Car 0 0 -1.6 0 0 50 50 -1 -1 -1 -1000 -1000 -1000 -10\n'
    calibration = 'P2: 1 0 0 0 0 1 0 0 0 0 1 0\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n'
    put(tmp_path / 'in' / 'label_2' / f'{AT}.txt', line)
    put(tmp_path / 'in' / 'calib' / f'{AT}.txt', calibration)
    words = ['convert', str(tmp_path / 'in'), '-o', str(tmp_path / 'out'), '--to', 'csv']
    words += ['--from', 'kitti_object']
    assert main(words) == 1
    assert 'expected boxes of objects, got none among 1' in capsys.readouterr().err
    good = (
        'Car 0 0 -1.6 0 0 50 50 1.5 1.8 4 1 2 10 0\nDontCare -1 -1 -10 0 0 9 9 -1 -1 -1 0 0 0 0\n'
    )
    put(tmp_path / 'in' / 'label_2' / f'{AT}.txt', line + good)
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert '1 boxes are invalid' in printed and '1 boxes are left out (no_box)' in printed


KITTI_CALIBRATION = (
    'P2: 1 0 0 0 0 1 0 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\n'
    'Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n'
)

# One file per cloud ------------------------------------------------------------------------------


def test_openpcdet_golden_values(tmp_path):
    box = [8, 1, 0.5, 4, 2, 1.6, 0, 0, 0.3]
    write('openpcdet', tmp_path, [frame(STAMP, ['x7'], boxes=[box], frame_id='lidar')])
    folder = tmp_path / 'openpcdet'
    line = (folder / 'labels' / f'{NAME}.txt').read_text()
    assert line == '8.000000 1.000000 0.500000 4.000000 2.000000 1.600000 0.300000 car\n'
    assert (folder / 'ImageSets/train.txt').read_text() == f'{NAME}\n'


def test_openpcdet_labels_and_results_of_others(tmp_path):
    """The template of the project, a score as a ninth column, and frames without a file."""
    line = '1.50 1.46 0.10 5.12 1.85 4.13 1.56 Vehicle\n'
    put(tmp_path / 'labels' / f'{AT}.txt', line + line.replace('\n', ' 0.75\n'))
    (tmp_path / 'points').mkdir()
    np.save(tmp_path / 'points' / f'{AT + 1}.npy', np.zeros((2, 4), np.float32))
    np.zeros((2, 4), np.float32).tofile(tmp_path / 'points' / f'{AT + 2}.bin')
    found = read('openpcdet', tmp_path)
    assert stamps(found) == [AT, AT + 1, AT + 2]
    boxes = found[0].refined.boxes
    np.testing.assert_allclose(boxes.boxes[0], [1.5, 1.46, 0.1, 5.12, 1.85, 4.13, 0, 0, 1.56])
    assert (boxes.track_ids, boxes.class_names) == (('', ''), ('Vehicle', 'Vehicle'))
    np.testing.assert_array_equal(boxes.scores, [np.nan, 0.75])
    put(tmp_path / 'labels' / f'{AT}.txt', line + '1 2 3\n')
    with pytest.raises(RecordingError, match=rf'{AT}.txt: expected .* box 2: got 3 columns'):
        read('openpcdet', tmp_path)


def test_lines_that_a_person_has_edited_lose_no_other_evidence(tmp_path):
    boxes = [[8, 1, 0.5, 4, 2, 1.6, 0, 0, 0.3], [9, 5, 0.5, 4, 2, 1.6, 0, 0, 0.3]]
    write('openpcdet', tmp_path, [frame(STAMP, ['a', 'b'], boxes=boxes, frame_id='lidar')])
    path = tmp_path / 'openpcdet' / 'labels' / f'{NAME}.txt'
    path.write_text('1 2 3 4 2 1.6 0 van\n' + path.read_text().splitlines()[1] + '\n')
    (found,) = read('openpcdet', tmp_path / 'openpcdet')
    assert found.refined.boxes.track_ids == ('', 'b')
    assert found.refined.status == ('input', 'refined')


def test_kitti_object_of_a_detector(tmp_path):
    """Results have 16 columns, and the calibration is that of the data set above them."""
    put(tmp_path / 'calib' / '000003.txt', KITTI_CALIBRATION)
    put(tmp_path / 'results/data/000003.txt', 'Car -1 -1 0 0 0 9 9 1.5 1.8 4 1 2 10 -1.57 0.9\n')
    put_stamps(tmp_path, 1)
    (found,) = read('kitti_object', tmp_path / 'results')
    boxes = found.refined.boxes
    # x right, y down, z forward: the centre is half a height above the location.
    np.testing.assert_allclose(boxes.boxes[0, :6], [10, -1, -2 + 0.75, 4, 1.8, 1.5])
    assert boxes.boxes[0, 8] == pytest.approx(1.57 - np.pi / 2)
    assert (boxes.scores[0], stamps([found])) == (0.9, [AT])
    put(tmp_path / 'results/data/000004.txt', 'Car -1 -1 0 0 0 9 9 1.5 1.8 4 1 2 10 -1.57 0.9\n')
    put_stamps(tmp_path, 2)
    with pytest.raises(RecordingError, match=r'calib/000004.txt: cannot be read'):
        read('kitti_object', tmp_path / 'results')
    shutil.rmtree(tmp_path / 'calib')
    with pytest.raises(RecordingError, match=r'expected calib/NAME.txt for each frame'):
        read('kitti_object', tmp_path / 'results')


def test_the_root_of_kitti_object_is_enough(tmp_path):
    put(tmp_path / 'training/calib' / f'{AT}.txt', KITTI_CALIBRATION)
    line = 'Car 0 0 0 0 0 9 9 1.5 1.8 4 1 2 10 -1.57\n'
    put(tmp_path / 'training/label_2' / f'{AT}.txt', line)
    assert stamps(read('kitti_object', tmp_path)) == [AT]


def test_track_ids_of_zero_are_ids_and_of_minus_one_none(tmp_path):
    put(tmp_path / 'label' / f'{AT}.json', [psr(1, obj_id=0), psr(2, obj_id=None)])
    assert ids(read('sustechpoints', tmp_path)) == [('0', '')]
    put(tmp_path / 'calib/0000.txt', KITTI_CALIBRATION)
    lines = [f'0 {track} Car 0 0 0 0 0 9 9 1.5 1.8 4 1 2 10 0\n' for track in (0, -1, -1)]
    put(tmp_path / 'label_02/0000.txt', ''.join(lines))
    put_stamps(tmp_path, 1)
    assert ids(read('kitti', tmp_path)) == [('0', '', '')]


@pytest.mark.parametrize('angle', ['90', '-180'])
def test_angles_in_degrees_are_refused(tmp_path, angle):
    put(tmp_path / 'labels' / f'{AT}.txt', f'1 2 3 4 2 1.5 {angle} Car\n')
    put(tmp_path / 'calib' / f'{AT}.txt', KITTI_CALIBRATION)
    put(tmp_path / 'label_2' / f'{AT}.txt', f'Car 0 0 0 0 0 9 9 1.5 1.8 4 1 2 10 {angle}\n')
    put(tmp_path / 'calib/0000.txt', KITTI_CALIBRATION)
    put(tmp_path / 'label_02/0000.txt', f'0 1 Car 0 0 0 0 0 9 9 1.5 1.8 4 1 2 10 {angle}\n')
    put_stamps(tmp_path, 1)
    for name in ('openpcdet', 'kitti_object', 'kitti'):
        with pytest.raises(RecordingError, match=r'expected angles in radians, got (90|180), '):
            read(name, tmp_path)
    cuboid_of_angles = {'name': 'box', 'val': [1, 2, 3, 0, 0, float(angle), 4, 2, 1.5]}
    frames = {'0': {'frame_properties': {'timestamp': 1}, 'objects': objects_of(cuboid_of_angles)}}
    with pytest.raises(RecordingError, match='frame 0: object 0: expected angles in radians'):
        read('openlabel', openlabel(tmp_path / 'a.json', frames, CLASSES))


def test_datumaro_reads_kitti_object(tmp_path):
    camera = put(tmp_path / 'camera.txt', 'P2: 200 0 600 0 0 200 180 0 0 0 1 0\n'
                 'Tr_velo_cam 0 -1 0 0 0 0 -1 0 1 0 0 0\n')  # fmt: skip
    box = [8, 1, 0.5, *CAR, 0, 0, 0.3]
    frames = [frame(STAMP, ['a'], boxes=[box], frame_id='lidar')]
    write('kitti_object', tmp_path, frames, camera=camera)
    (item,) = consumer('datumaro_kitti', tmp_path / 'kitti_object')
    assert (item['id'], item['label'], item['dimensions']) == (NAME, 'Car', [1.6, 1.9, 4.5])
    assert item['location'] == pytest.approx([-1, -0.5 + 0.8, 8], abs=1e-6)
    assert item['rotation_y'] == pytest.approx(-0.3 - np.pi / 2, abs=1e-6)


def test_supervisely_and_datumaro_read_single_clouds(tmp_path):
    frames = [frame(STAMP, ['x7', 'y']), frame(STAMP + 1, ['x7'], status=('kept',))]
    write('sly_pointcloud', tmp_path, frames, with_points=True)
    folder = tmp_path / 'sly_pointcloud'
    project = consumer('supervisely_clouds', folder)
    assert (project['type'], len(project['items'])) == ('point_clouds', 2)
    first, _, last = project['figures']
    assert (first['cloud'], first['class']) == (f'{NAME}.pcd', 'car')
    assert first['object'] == last['object'] and last['tags']['status'] == 'kept'
    cuboids = consumer('datumaro', folder, 'sly_pointcloud')['cuboids']
    cuboids.sort(key=lambda one: one['item'])
    assert [one['item'] for one in cuboids] == [NAME, NAME, f'{STAMP + 1}']
    tracks = [one['attributes']['track_id'] for one in cuboids]
    assert tracks[0] == tracks[2] != tracks[1]
    assert first['geometry']['position'] == vector(CENTER)
    np.testing.assert_allclose(cuboids[0]['position'], CENTER, atol=0.0051)  # two digits
    assert cuboids[0]['scale'] == EXTENT


def test_supervisely_reads_single_clouds_with_a_track_of_two_classes(tmp_path):
    frames = [frame(STAMP, ['7', '8']), frame(STAMP + 1, ['7'], classes=('truck',))]
    write('sly_pointcloud', tmp_path, frames, with_points=True)
    folder = tmp_path / 'sly_pointcloud'
    found = consumer('supervisely_clouds', folder)['figures']
    assert [one['class'] for one in found] == ['car', 'car', 'truck']
    assert ids(read('sly_pointcloud', folder)) == [('7', '8'), ('7',)]


def test_single_clouds_of_cvat(tmp_path):
    """An object has one key in all clouds; those of the tool itself have one in each."""
    for i, keys in enumerate([('a', 'b'), ('a', 'c')]):
        tags = [{'name': 'keyframe', 'value': 'false' if i else 'true'}]
        objects = [{'key': key, 'classTitle': 'car', 'tags': tags} for key in keys]
        figures = [figure(key) for key in keys]
        put(tmp_path / f'ds0/ann/{AT + i}.pcd.json', {'objects': objects, 'figures': figures})
    found = read('sly_pointcloud', tmp_path)
    assert ids(found) == [('a', 'b'), ('a', 'c')]
    assert [one.refined.status[0] for one in found] == ['input', 'interpolated']
    text = (tmp_path / f'ds0/ann/{AT + 1}.pcd.json').read_text().replace('"a"', '"d"')
    put(tmp_path / f'ds0/ann/{AT + 1}.pcd.json', text)
    assert ids(read('sly_pointcloud', tmp_path)) == [('', '')] * 2
    with pytest.raises(RecordingError, match='read it as sly_pointcloud'):
        read('supervisely', tmp_path)
