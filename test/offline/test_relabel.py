from collections import Counter
from copy import deepcopy
from dataclasses import replace
import json
import os
from pathlib import Path
import shutil
import subprocess
import sys

from boxreg_ros.cli import main
from boxreg_ros.config import Config
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.errors import ConfigError, RecordingError, UnsupportedMessage
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.fixed_frame import input_boxes
from boxreg_ros.io.lidars import Lidars
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.labels import LabelFrame, Options
from boxreg_ros.labels.cloud_spool import Spool
from boxreg_ros.labels.records import refined_of
from boxreg_ros.offline import reader as reading
from boxreg_ros.offline.convert import convert
from boxreg_ros.offline.notes import closing_line, notes
from boxreg_ros.offline.relabel import relabel, Request
from boxreg_ros.offline.sources import source_of
from boxreg_ros.offline.summary import Summary
from boxreg_ros.reasons import Reason
from boxreg_ros.review import tables
from boxreg_ros.structures import Sweep
from msg_adapters.convention import Convention
import numpy as np
from paths import BAGS, SHARED
import pytest
from relabel_results import QUICK, rows_of
from ros_messages import Drive, JSK, SECOND, START, write_recording
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer


def run(recording, out, **options):
    """Relabel quickly; return the summary and the rows of boxes.csv."""
    config = QUICK.updated(options.pop('settings', {}))
    summary = relabel(Request((Path(recording),), config=config, **options), Path(out))
    return summary, rows_of(out)


def keys(rows):
    return [(int(row['stamp_ns']), row['track_id']) for row in rows]


@pytest.mark.parametrize('checked_after, threads', [(0.5, 1), (20.0, 2)])
def test_boxes_whose_ids_jump_are_associated(tmp_path, monkeypatch, checked_after, threads):
    """The rows of a message as ids: the run begins again, once it has seen enough of them."""
    monkeypatch.setattr(reading, 'IDS_SECONDS', checked_after)
    drive = Drive(sweeps=12)
    for number in range(0, 12, 2):
        drive.replace('/boxes', number, lambda message: message.detections.reverse())
        drive.replace('/boxes', number, lambda message: rename(message, '1', '2'))
    path = drive.write(tmp_path / 'drive')
    settings = {'solver.threads': threads}
    summary, rows = run(path, tmp_path / 'out', settings=settings)
    assert (summary.ids, summary.associated_tracks) == ('by association', 2)
    assert 'track ids jump' in summary.warning and '--keep-ids' in summary.warning
    own = {}
    for row in rows:
        own.setdefault(row['track_id'], []).append(float(row['y']))
    assert [round(np.median(own[name])) for name in sorted(own)] in ([4, -3], [-3, 4])
    assert all(np.ptp(y) < 1 for y in own.values())
    summary, _ = run(path, tmp_path / 'out', settings=settings, keep_ids=True)
    assert summary.ids == 'of the input'
    assert 'track ids jump' in summary.warning


@pytest.mark.parametrize('kind', ['none', 'new'])
def test_boxes_whose_ids_identify_nothing_are_associated(tmp_path, kind):
    """A message for each class, without ids; and ids that count all boxes."""
    drive = Drive(sweeps=8)
    items = []
    for topic, received_ns, message in drive.items:
        if topic != '/boxes':
            items.append((topic, received_ns, message))
            continue
        count = len(items)
        rename(message, *(('', '') if kind == 'none' else (f'{count}', f'{count + 1}')))
        for result in message.detections[1].results:
            result.hypothesis.class_id = 'van'
        parts = message.detections if kind == 'none' else [message.detections]
        for part in parts:
            own = deepcopy(message)
            own.detections = part if kind == 'new' else [part]
            items.append((topic, received_ns + len(items), own))
    drive.items = items
    path = drive.write(tmp_path / 'drive')
    summary, rows = run(path, tmp_path / 'out')
    assert (summary.ids, summary.associated_tracks, len(rows)) == ('by association', 2, 16)
    assert 'duplicate_stamp' not in summary.reasons
    said = {'none': '16 of 16 boxes have no track id', 'new': 'track ids are new at 14 of 14'}
    assert said[kind] in summary.warning
    assert ('read as one message per stamp' in summary.warning) == (kind == 'none')
    kept, _ = run(path, tmp_path / 'out', keep_ids=True)
    assert kept.status['kept'] == 16


@pytest.mark.parametrize('estimate', ['track', 'final', 'early'])
def test_boxes_do_not_depend_on_the_order_of_messages_received_at_once(tmp_path, estimate):
    drive = Drive(sweeps=20)
    rng = np.random.default_rng(0)
    static, *items = drive.items
    at_once = {received_ns: [] for _, received_ns, _ in items}
    for item in items:
        at_once[item[1]].append(item)
    shuffled = [static]
    for group in at_once.values():
        shuffled += [group[i] for i in rng.permutation(len(group))]
    assert [item[0] for item in shuffled] != [item[0] for item in drive.items]
    (tmp_path / 'out').mkdir()
    for name, ordered in (('a', drive.items), ('b', shuffled)):
        path = write_recording(tmp_path / name, ordered, messages=drive.messages)
        run(path, tmp_path / 'out' / name, settings={'estimate': estimate})
    boxes = [(tmp_path / 'out' / name / 'boxes.csv').read_bytes() for name in 'ab']
    assert boxes[0] == boxes[1]


def rename(message, *names):
    """Set the ids of detections."""
    for detection, name in zip(message.detections, names, strict=True):
        detection.id = name


@pytest.mark.parametrize('completes, passes', [(False, 1), (True, 2)])
def test_a_recording_is_opened_once_for_each_pass(tmp_path, monkeypatch, completes, passes):
    path = Drive(sweeps=4).write(tmp_path / 'drive')
    opened = []
    enter = Recording.__enter__

    def noted(recording):
        opened.append(recording)
        return enter(recording)

    monkeypatch.setattr(Recording, '__enter__', noted)
    run(path, tmp_path / 'out', settings={'solver.threads': 1, 'complete.fill': completes})
    assert len(opened) == passes


@pytest.mark.parametrize('storage', ['mcap', 'rosbag1'])
def test_a_file_is_opened_once(tmp_path, storage):
    path = Drive(sweeps=4, ros1=storage == 'rosbag1').write(tmp_path / 'drive', storage)
    opened = []
    is_listening = True

    def note(event, arguments):
        if is_listening and event == 'open' and str(arguments[0]) == str(path):
            opened.append(arguments)

    sys.addaudithook(note)
    with Recording([path]) as recording:
        tree = TransformTree()
        recording.choose_fixed_frame(tree)
        assert len(list(recording.items(tree))) == 8
    is_listening = False
    assert len(opened) == 1


@pytest.mark.parametrize(
    'scenario, known, setting',
    [('highway', 'stamp', 'auto'), ('highway-sight', 'sight', 'stamp')],
)
def test_the_summary_states_the_time_of_the_boxes(tmp_path, scenario, known, setting):
    assert (
        main(['simulate', '-o', f'{tmp_path}/way.mcap', '--scenario', scenario, '--sweeps=4']) == 0
    )
    settings = {'sampling.box_time': setting}
    summary, _ = run(tmp_path / 'way.mcap', tmp_path / 'out', settings=settings, formats=('csv',))
    assert summary.box_time['setting'] == setting
    assert summary.box_time['estimated'] == known
    other = {'stamp': 'sight', 'sight': 'stamp'}[known]
    votes = summary.box_time['votes']
    assert votes[known] > 2 * votes[other]


def test_late_boxes_are_mended_and_said(tmp_path):
    """Boxes of the sample 0.3 s late are nearly as good as those in time; a warning names that."""
    truth = BoxTable.read(BAGS / 'street_truth.csv')
    boxes, _ = input_boxes(Recording([BAGS / 'street.mcap']))
    late = [replace(array, stamp_ns=array.stamp_ns + 300_000_000) for array in boxes[:-3]]
    found = {}
    for name, given in (('in time', boxes), ('late', late)):
        path = tmp_path / f'{name}.csv'
        BoxTable.from_arrays(given).write(path)
        summary, _ = run(
            BAGS / 'street.mcap', tmp_path / name, labels=('csv', path), formats=('csv',)
        )
        assert ('boxes are 0.3' in summary.warning) == (name == 'late')
        latency = summary.box_time['latency']['seconds']
        assert latency == pytest.approx(0.3 if name == 'late' else 0.0, abs=0.02)
        found[name] = moving_iou(BoxTable.read(tmp_path / name / 'boxes.csv'), truth)
    assert found['late'] > found['in time'] - 0.02
    assert moving_iou(BoxTable.from_arrays(late), truth) < 0.4


def moving_iou(boxes, truth):
    """Return the mean 3D IoU of the boxes of objects that move by more than 2 m/s."""
    row_of = {
        key: row for row, key in enumerate(zip(truth.stamps_ns, truth.track_ids, strict=True))
    }
    pairs = []
    for row, (stamp, name) in enumerate(zip(boxes.stamps_ns, boxes.track_ids, strict=True)):
        own, before = row_of.get((stamp, name)), row_of.get((stamp - 10**8, name))
        if own is None or before is None:
            continue
        if np.linalg.norm(truth.boxes[own, :2] - truth.boxes[before, :2]) > 0.2:
            pairs.append((row, own))
    rows, own = np.array(pairs).T
    return iou_3d(boxes.boxes[rows], truth.boxes[own]).mean()


@pytest.mark.parametrize('estimate', ['track', 'final', 'early'])
@pytest.mark.parametrize('boxes', ['vision', 'markers'])
def test_every_box_is_written_once_in_order(tmp_path, estimate, boxes):
    drive = Drive(sweeps=7, boxes=boxes)
    summary, rows = run(
        drive.write(tmp_path / 'drive'),
        tmp_path / 'out',
        settings={'estimate': estimate, 'window': 4, 'lag': 2},
    )
    assert keys(rows) == [(stamp, track) for stamp in drive.stamps for track in ('1', '2')]
    assert {row['frame_id'] for row in rows} == {'odom'}
    assert (summary.sweeps, summary.box_arrays) == (7, 7)
    assert (summary.boxes_in, summary.boxes_out) == (14, 14)
    assert sum(summary.status.values()) == 14
    assert sum(summary.reasons.values()) == summary.status.get('kept', 0)
    assert summary.status.get('refined', 0) > 0


def test_refined_boxes_match_the_truth_in_the_fixed_frame(tmp_path):
    drive = Drive(sweeps=7)
    _, rows = run(drive.write(tmp_path / 'drive'), tmp_path / 'out')
    for row in rows:
        true = drive.truth[int(row['stamp_ns'])][int(row['track_id']) - 1]
        found = [float(row[name]) for name in ('x', 'y', 'z')]
        np.testing.assert_allclose(found, true[:3], atol=0.35)
    assert sum(int(row['num_points']) for row in rows) > 500


def test_boxes_and_clouds_in_different_frames(tmp_path):
    drive = Drive(sweeps=6)
    plain = run(drive.write(tmp_path / 'plain'), tmp_path / 'plain_out')[1]
    items = []
    for topic, stamp, message in drive.items:
        if topic == '/boxes':  # the same boxes, given in the frame of the base
            message.header.frame_id = 'base'
            for detection in message.detections:
                detection.header.frame_id = 'base'
                detection.bbox.center.position.z += 2.0
        items.append((topic, stamp, message))
    moved = run(write_recording(tmp_path / 'moved', items), tmp_path / 'moved_out')[1]
    for before, after in zip(plain, moved, strict=True):
        for name in ('x', 'y', 'z', 'qz', 'length'):
            assert float(after[name]) == pytest.approx(float(before[name]), abs=1e-6)


def test_output_folder_contents(tmp_path):
    path = Drive(sweeps=4).write(tmp_path / 'drive')
    summary, _ = run(path, tmp_path / 'out', settings={'solver.rounds': 2})
    out = tmp_path / 'out'
    assert sorted(item.name for item in out.iterdir()) == [
        'boxes.csv', 'config.yaml', 'covariances.csv', 'input_model.json', 'openlabel',
        'review.csv', 'summary.json', 'tracks.csv', 'velocities.csv',
    ]  # fmt: skip
    assert Config.from_yaml(out / 'config.yaml') == QUICK.updated({'solver.rounds': 2})
    content = json.loads((out / 'summary.json').read_text())
    assert content.pop('files').keys() == {
        'boxes.csv', 'config.yaml', 'covariances.csv', 'input_model.json', 'openlabel/labels.json',
        'review.csv', 'tracks.csv', 'velocities.csv',
    }  # fmt: skip
    assert content == summary.as_json()
    assert Summary.from_json(content) == summary
    assert summary.topics == {'points': '/points', 'boxes': '/boxes', 'odometry': None}
    assert summary.fixed_frame == 'odom'
    assert set(summary.versions) >= {'boxreg_ros', 'torch', 'numpy', 'rosbags'}
    assert set(summary.seconds) == {
        'start', 'read', 'decode', 'transform', 'registrar', 'solve', 'write', 'total',
    }  # fmt: skip
    label = json.loads((out / 'openlabel' / 'labels.json').read_text())['openlabel']
    assert len(label['frames']) == 4


# Faulty input and failures ----------------------------------------------------------------------


def test_invalid_boxes_are_written_unchanged(tmp_path):
    drive = Drive(sweeps=5)

    def spoil(message):
        good = message.detections[0]
        m = drive.messages
        stamp = good.header.stamp.sec * SECOND + good.header.stamp.nanosec
        pose = ((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))
        message.detections += m.detections(
            stamp,
            'lidar',
            [
                ('flat', 'car', 0.5, *pose, (4.0, 0.0, 1.5)),
                ('inside out', 'car', 0.5, *pose, (4.0, -2.0, 1.5)),
                ('nowhere', 'car', 0.5, (np.nan, 0.0, 0.0), pose[1], (4.0, 2.0, 1.5)),
                ('unturned', 'car', 0.5, pose[0], (0.0, 0.0, 0.0, 0.0), (4.0, 2.0, 1.5)),
                ('', 'car', 0.5, *pose, (4.0, 2.0, 1.5)),
                ('1', 'car', 0.5, *pose, (4.0, 2.0, 1.5)),
                ('once', 'car', 0.5, *pose, (4.0, 2.0, 1.5)),
            ],
        ).detections

    drive.replace('/boxes', 2, spoil)
    summary, rows = run(drive.write(tmp_path / 'drive'), tmp_path / 'out')
    bad = {row['track_id']: row for row in rows if int(row['stamp_ns']) == drive.stamps[2]}
    assert len(rows) == 17
    assert [row['track_id'] for row in rows[4:13]] == [
        '1', '2', 'flat', 'inside out', 'nowhere', 'unturned', '', '1', 'once',
    ]  # fmt: skip
    for name in ('flat', 'inside out', 'nowhere', 'unturned', '', 'once'):
        assert bad[name]['status'] == 'kept', name
    assert bad['nowhere']['x'] == ''
    assert bad['unturned']['qw'] == ''
    table = BoxTable.read(tmp_path / 'out' / 'boxes.csv')
    assert np.isnan(table.boxes[8, 0])
    assert np.isnan(table.boxes[9, 6:]).all()
    assert np.isfinite(np.delete(table.boxes, [8, 9], axis=0)).all()
    assert float(bad['inside out']['width']) == -2.0
    reasons = summary.reasons
    assert reasons['invalid_box'] == 4
    assert reasons['no_track_id'] == 1
    assert reasons['duplicate_track_id'] == 1
    assert summary.status['kept'] == sum(reasons.values())
    label = json.loads((tmp_path / 'out' / 'openlabel' / 'labels.json').read_text())
    assert len(label['openlabel']['frames']['2']['objects']) == 5


def test_boxes_without_transform_stay_in_their_frame(tmp_path):
    drive = Drive(sweeps=10)
    gone = drive.stamps[:4]
    drive.items = [item for item in drive.items if item[0] != '/tf' or item[1] not in gone]
    summary, rows = run(drive.write(tmp_path / 'drive'), tmp_path / 'out')
    # Motion is extrapolated by at most 0.2 s: this covers the stamps 0.2 and 0.3 s.
    early = [row for row in rows if int(row['stamp_ns']) in drive.stamps[:2]]
    assert {(row['frame_id'], row['status']) for row in early} == {('lidar', 'kept')}
    assert {row['frame_id'] for row in rows[4:]} == {'odom'}
    assert keys(rows) == [(stamp, track) for stamp in drive.stamps for track in ('1', '2')]
    assert summary.reasons['no_transform'] == 4
    assert summary.dropped['sweep_without_transform'] == 2
    assert 'odom -> base is known from' in summary.first_missing_transform
    (note,) = notes(summary)
    assert note.startswith('4 boxes and 2 clouds have no transform; first: transform odom -> base')
    arrays, left_out = input_boxes(source_of(Request((tmp_path / 'drive',))))
    assert len(arrays) == 8
    assert left_out.startswith('2 messages had no transform, first: transform odom -> base')


def test_boxes_in_an_unconnected_frame(tmp_path):
    drive = Drive(sweeps=3)
    for topic, _, message in drive.items:
        if topic == '/boxes':
            message.header.frame_id = 'radar'
            for detection in message.detections:
                detection.header.frame_id = 'radar'
    summary, rows = run(drive.write(tmp_path / 'drive'), tmp_path / 'out')
    assert summary.reasons == {'no_transform': 6}
    assert {row['frame_id'] for row in rows} == {'radar'}
    assert "'radar'" in summary.first_missing_transform


def test_unpaired_sweeps_and_boxes(tmp_path):
    drive = Drive(sweeps=6)
    drive.items = [
        item
        for item in drive.items
        if (item[0], item[1]) not in {('/points', drive.stamps[1]), ('/boxes', drive.stamps[4])}
    ]
    summary, rows = run(drive.write(tmp_path / 'drive'), tmp_path / 'out')
    assert len(rows) == 10
    assert {row['status'] for row in rows[2:4]} == {'kept'}
    assert summary.reasons['no_sweep'] == 2
    assert summary.dropped['sweep_without_boxes'] == 1


@pytest.mark.parametrize(
    ('storage', 'topic', 'late'),
    [
        ('mcap', '/boxes', 3600),
        ('rosbag1', '/boxes', 2),
        ('sqlite3', '/tf', -3600),
        ('mcap', '/odom', 3600),
    ],
)
def test_topic_recorded_at_another_time_is_merged_by_stamp(tmp_path, storage, topic, late):
    motion = 'odometry' if topic == '/odom' else 'tf'
    drive = Drive(sweeps=12, motion=motion, ros1=storage == 'rosbag1')
    whole = drive.write(tmp_path / 'whole', storage)
    together, expected = run(whole, tmp_path / 'expected')
    parts = (
        [item for item in drive.items if item[0] != topic],
        [(name, t + late * SECOND, m) for name, t, m in drive.items if name == topic],
    )
    paths = tuple(
        write_recording(tmp_path / name, part, storage, drive.messages)
        for name, part in zip('ab', parts, strict=True)
    )
    summary = relabel(Request(paths, config=QUICK), tmp_path / 'out')
    assert rows_of(tmp_path / 'out') == expected
    assert summary.status == {'refined': 24}
    assert summary.recorded_apart == {topic: pytest.approx(late)}
    assert together.recorded_apart == {}
    # Start and end count from the first cloud, whenever the rest was recorded.
    options = {'start': 0.35, 'end': 0.75, 'config': QUICK}
    relabel(Request(paths, **options), tmp_path / 'part')
    relabel(Request((whole,), **options), tmp_path / 'part_expected')
    assert rows_of(tmp_path / 'part') == rows_of(tmp_path / 'part_expected')


def test_boxes_of_a_slow_detector_are_merged_by_stamp(tmp_path):
    """The last boxes are 5.5 s late: more clouds than `queue` holds."""
    drive = Drive(sweeps=56)
    expected = run(drive.write(tmp_path / 'punctual'), tmp_path / 'expected')[1]
    slow = [
        (topic, t + (t - drive.stamps[0]) * (topic == '/boxes'), m) for topic, t, m in drive.items
    ]
    path = write_recording(tmp_path / 'slow', sorted(slow, key=lambda item: item[1]))
    summary, rows = run(path, tmp_path / 'out')
    assert rows == expected
    assert summary.recorded_apart == {'/boxes': pytest.approx(5.5)}
    assert closing_line(summary, tmp_path).endswith('; merged by stamp: /boxes (+5.5 s)')


def test_topic_longer_than_the_clouds_is_merged_by_stamp(tmp_path):
    """Poses of the whole drive, computed later, and clouds of a part in its middle."""
    whole = Drive(sweeps=60)
    stamps = whole.stamps[20:40]
    part = [item for item in whole.items if stamps[0] <= item[1] <= stamps[-1]]
    part.insert(0, whole.items[0])  # /tf_static
    expected = run(write_recording(tmp_path / 'part', part), tmp_path / 'expected')[1]
    poses = [(topic, t + 3600 * SECOND, m) for topic, t, m in whole.items if topic == '/tf']
    paths = (
        write_recording(tmp_path / 'clouds', [item for item in part if item[0] != '/tf']),
        write_recording(tmp_path / 'poses', poses),
    )
    summary = relabel(Request(paths, config=QUICK), tmp_path / 'out')
    assert summary.recorded_apart == {'/tf': pytest.approx(3600)}
    assert rows_of(tmp_path / 'out') == expected


def test_empty_arrays_at_the_ends_do_not_prevent_the_merge_by_stamp(tmp_path):
    """Some trackers begin and end with empty arrays; in a MarkerArray these have no stamp."""
    drive = Drive(sweeps=30, boxes='markers')
    for topic, _, message in drive.items:
        if topic == '/boxes' and message.markers[0].header.stamp.nanosec % 10**9 in (0, 10**8):
            message.markers = []
    drive.replace('/points', 0, lambda cloud: setattr(cloud.header.stamp, 'sec', 0))
    drive.replace('/points', 0, lambda cloud: setattr(cloud.header.stamp, 'nanosec', 0))
    drive.replace('/boxes', -1, lambda message: setattr(message, 'markers', []))
    expected = run(drive.write(tmp_path / 'whole'), tmp_path / 'expected')[1]
    paths = tuple(
        write_recording(tmp_path / name, part)
        for name, part in (
            ('a', [item for item in drive.items if item[0] != '/boxes']),
            ('b', [(n, t + 3600 * SECOND, m) for n, t, m in drive.items if n == '/boxes']),
        )
    )
    summary = relabel(Request(paths, config=QUICK), tmp_path / 'out')
    assert rows_of(tmp_path / 'out') == expected
    assert summary.status['refined'] > 40


def test_part_without_boxes_is_a_warning(tmp_path, capsys):
    drive = Drive(sweeps=10)
    drive.items = [i for i in drive.items if i[0] != '/boxes' or i[1] < drive.stamps[5]]
    path = drive.write(tmp_path / 'drive')
    assert main(['relabel', str(path), '-o', str(tmp_path / 'out'), '--start', '0.55']) == 0
    assert 'no boxes in the input, or in its part' in capsys.readouterr().err


def test_start_counts_from_the_first_cloud(tmp_path):
    drive = Drive(sweeps=10)
    day = 86_400 * SECOND
    expected = run(drive.write(tmp_path / 'drive'), tmp_path / 'expected', start=0.25, end=0.75)[1]
    static = [(topic, t - day, m) for topic, t, m in drive.items if topic == '/tf_static']
    other = [('/points2', t - day, m) for topic, t, m in drive.items if topic == '/points']
    paths = (
        write_recording(tmp_path / 'rest', [*static, *other]),
        write_recording(tmp_path / 'main', [i for i in drive.items if i[0] != '/tf_static']),
    )
    request = Request(paths, lidars=Lidars(('/points',)), start=0.25, end=0.75, config=QUICK)
    relabel(request, tmp_path / 'out')
    assert rows_of(tmp_path / 'out') == expected


def test_stamps_of_another_clock_do_not_change_the_order(tmp_path):
    """Boxes stamped by another clock stay in the order in which they were received."""
    drive = Drive(sweeps=12)
    for topic, _, message in drive.items:
        if topic == '/boxes':
            for item in (message, *message.detections):
                item.header.stamp.sec -= 10_000
    summary, rows = run(drive.write(tmp_path / 'drive'), tmp_path / 'out')
    assert summary.recorded_apart == {}
    assert len(rows) == summary.boxes_in == 24
    assert {row['status'] for row in rows} == {'kept'}


def test_boxes_of_one_stamp_in_two_messages(tmp_path):
    drive = Drive(sweeps=5)
    first = [item for item in drive.items if item[0] == '/boxes'][1]
    other = deepcopy(first[2])
    for detection in other.detections:
        detection.bbox.center.position.x += 0.1
    drive.items.insert(drive.items.index(first) + 1, (*first[:2], other))
    for estimate in ('track', 'early', 'final'):
        rows = run(
            drive.write(tmp_path / estimate),
            tmp_path / f'{estimate}_out',
            settings={'estimate': estimate, 'window': 4, 'lag': 2},
        )[1]
        stamps = [stamp for stamp, _ in keys(rows)]
        assert stamps == sorted(2 * [*drive.stamps, drive.stamps[1]])


def test_results_are_written_to_their_array_by_ticket(tmp_path, monkeypatch):
    """Two arrays of one stamp with different tracks; the results return in reverse order."""
    drive = Drive(sweeps=5)
    first = [item for item in drive.items if item[0] == '/boxes'][1]
    other = drive.messages.detections(
        first[1], 'lidar', [('9', 'car', 0.5, (9.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), (4, 2, 1.5))]
    )
    drive.items.insert(drive.items.index(first) + 1, (*first[:2], other))
    path = drive.write(tmp_path / 'drive')
    expected = run(path, tmp_path / 'expected')[1]
    assert [row['track_id'] for row in expected[2:5]] == ['1', '2', '9']

    class ReversingRegistrar(BoxRegistrar):
        """Return all results at the end, the last one first."""

        def add_sweep(self, sweep):
            held.extend(super().add_sweep(sweep))
            return []

        def add_boxes(self, boxes):
            held.extend(super().add_boxes(boxes))
            return []

        def flush(self):
            return [*held, *super().flush()][::-1]

    held = []
    monkeypatch.setattr('boxreg_ros.core.registrar.BoxRegistrar', ReversingRegistrar)
    assert run(path, tmp_path / 'out')[1] == expected


def test_early_and_final_estimates_are_compared(tmp_path, monkeypatch):
    compared = {}
    for estimate in ('early', 'final', 'track'):

        def assessed(tracks, name=estimate):
            compared[name] = np.concatenate([track.disagreement for track in tracks])
            return []

        monkeypatch.setattr(tables, 'assessed', assessed)
        recording = Drive(sweeps=8).write(tmp_path / estimate)
        relabel(Request((recording,), config=Config(estimate=estimate)), tmp_path / 'out')
    assert np.median(compared['final']) > 0
    assert not compared['early'].any()
    assert not compared['track'].any()


@pytest.mark.parametrize('pause', [0, 5])
def test_recording_of_a_loop_starts_again_after_the_time_jump(tmp_path, pause):
    """Recorded while a drive was played twice: the second round is refined like the first."""
    drive = Drive(sweeps=50)
    length = 5 * SECOND + pause * SECOND
    drive.items += [(topic, t + length, m) for topic, t, m in drive.items if topic != '/tf_static']
    summary, rows = run(drive.write(tmp_path / 'drive'), tmp_path / 'out')
    assert summary.time_jumps == 1
    assert any(note.startswith('time_jump (1): ') for note in notes(summary))
    assert summary.boxes_out == len(rows) == 200
    rounds = {}
    for row in rows:
        rounds.setdefault((row['stamp_ns'], row['track_id']), []).append(row)
        if row['frame_id'] == 'odom':
            true = drive.truth[int(row['stamp_ns'])][int(row['track_id']) - 1]
            found = [float(row[name]) for name in ('x', 'y', 'z')]
            np.testing.assert_allclose(found, true[:3], atol=0.35)
    assert {len(both) for both in rounds.values()} == {2}
    # One array and one cloud are needed to detect the time jump. Without a pause, transforms are
    # read up to two seconds ahead and jump before the boxes do.
    kept = sum(row['status'] == 'kept' for row in rows)
    assert kept <= (4 if pause else 44)


def test_empty_clouds_and_empty_arrays(tmp_path):
    drive = Drive(sweeps=5, boxes='markers')
    m = drive.messages
    drive.items += [
        ('/points', drive.stamps[-1] + 1, m.points(drive.stamps[-1] + 10**8, 'lidar', [])),
        ('/boxes', drive.stamps[-1] + 2, m.markers([])),
    ]
    summary, rows = run(drive.write(tmp_path / 'drive'), tmp_path / 'out')
    assert len(rows) == 10
    assert (summary.sweeps, summary.box_arrays) == (6, 6)


def truncated(path, out, sizes):
    """Copy a recording; `sizes` maps (topic, k) to the bytes left of message k on the topic."""
    count = Counter()
    with (
        AnyReader([path]) as reader,
        Writer(out, version=9, storage_plugin=StoragePlugin.MCAP) as writer,
    ):
        types = reader.typestore
        known = {
            c.topic: writer.add_connection(c.topic, c.msgtype, typestore=types)
            for c in reader.connections
        }
        for connection, received_ns, data in reader.messages():
            key = connection.topic, count[connection.topic]
            count[connection.topic] += 1
            writer.write(known[connection.topic], received_ns, data[: sizes.get(key, len(data))])
    return next(out.glob('*.mcap'))


def test_unreadable_messages_are_skipped_and_counted(tmp_path):
    drive = Drive(sweeps=8)
    drive.replace('/points', 3, lambda message: setattr(message, 'point_step', 2))
    path = drive.write(tmp_path / 'whole')
    # The first cloud keeps its stamp only (and loses the frame), another one half of its bytes,
    # an array ends within its first box, and one transform between two others is cut.
    sizes = {('/points', 0): 12, ('/points', 6): 1500, ('/boxes', 5): 60, ('/tf', 4): 30}
    path = truncated(path, tmp_path / 'drive', sizes)
    summary, rows = run(path, tmp_path / 'out', formats=('csv', 'mcap'))
    dropped = {'boxes_without_sweep': 3, 'sweep_without_boxes': 1, 'unreadable': 5}
    assert summary.dropped == dropped
    assert (summary.sweeps, summary.box_arrays, summary.boxes_in) == (5, 7, 14)
    left = [stamp for k, stamp in enumerate(drive.stamps) if k != 5]
    assert keys(rows) == [(stamp, track) for stamp in left for track in ('1', '2')]
    lost = [drive.stamps[k] for k in (0, 3, 6)]
    status = {int(row['stamp_ns']): row['status'] for row in rows}
    assert status == {stamp: 'kept' if stamp in lost else 'refined' for stamp in left}
    assert summary.reasons == {'no_sweep': 6}
    assert "'/points' is not a sensor_msgs/msg/PointCloud2" in summary.first_unreadable
    assert "'/boxes' is not a vision_msgs/msg/Detection3DArray" in summary.first_unreadable
    assert "'/tf' is not a tf2_msgs/msg/TFMessage" in summary.first_unreadable
    assert '5 messages could not be read' in closing_line(summary, tmp_path / 'out')
    # The overlay holds the unreadable messages unchanged; the refined topic has the other arrays.
    with AnyReader([tmp_path / 'out' / 'overlay.mcap']) as reader:
        copied = Counter(c.topic for c, _, _ in reader.messages())
    assert (copied['/points'], copied['/boxes'], copied['/boxes_refined']) == (8, 8, 7)


@pytest.mark.parametrize('topic', ['/points', '/boxes'])
def test_recording_without_a_readable_message_is_an_error(tmp_path, topic):
    path = Drive(sweeps=3).write(tmp_path / 'whole')
    path = truncated(path, tmp_path / 'drive', {(topic, k): 12 for k in range(3)})
    with pytest.raises(UnsupportedMessage, match=f"on '{topic}' is not a "):
        run(path, tmp_path / 'results' / 'out')
    assert not (tmp_path / 'results').exists() or not list((tmp_path / 'results').iterdir())


def test_failed_run_leaves_no_files(tmp_path):
    drive = Drive(sweeps=6)
    for k in range(6):
        drive.replace('/points', k, lambda message: setattr(message, 'point_step', 2))
    with pytest.raises(UnsupportedMessage, match=r"no message on '/points' can be read.*got 2"):
        run(drive.write(tmp_path / 'drive'), tmp_path / 'results' / 'out')
    assert list((tmp_path / 'results').iterdir()) == []


def test_earlier_result_is_replaced_only_by_success(tmp_path):
    good = Drive(sweeps=3).write(tmp_path / 'good')
    run(good, tmp_path / 'out')
    before = (tmp_path / 'out' / 'boxes.csv').read_bytes()
    broken = Drive(sweeps=1)
    broken.replace('/points', 0, lambda message: setattr(message, 'point_step', 2))
    with pytest.raises(UnsupportedMessage):
        run(broken.write(tmp_path / 'broken'), tmp_path / 'out')
    assert (tmp_path / 'out' / 'boxes.csv').read_bytes() == before
    (tmp_path / 'out' / 'old').touch()
    os.utime(tmp_path / 'out' / 'old', (1, 1))  # older than the results
    assert len(run(Drive(sweeps=5).write(tmp_path / 'more'), tmp_path / 'out')[1]) == 10
    assert not (tmp_path / 'out' / 'old').exists()
    assert not [item for item in tmp_path.iterdir() if item.name.startswith('.')]


def test_spool_returns_clouds_within_the_maximum_time_offset(tmp_path):
    spool = Spool(tmp_path, Config(reach=0.06))
    spool.add(Sweep(START, 'lidar', np.ones((1, 3))), np.eye(4))
    for milliseconds, has_cloud in ((70, False), (50, True)):
        refined = refined_of(START - SECOND * milliseconds // 1000, 'lidar', ())
        frame = spool.with_cloud(LabelFrame(refined, 'map', 'lidar', np.eye(4)))
        assert (frame.sweep is not None) == has_cloud


def test_label_frames_without_cloud_are_a_note(tmp_path):
    drive = Drive(sweeps=6)
    gone = drive.stamps[2:4]
    drive.items = [item for item in drive.items if item[0] != '/points' or item[1] not in gone]
    path = drive.write(tmp_path / 'drive')
    options = {'formats': ('sustechpoints',), 'options': Options(with_points=True)}
    summary, _ = run(path, tmp_path / 'out', **options)
    assert summary.frames_without_cloud == 2
    lacking, unpaired = notes(summary)
    assert lacking == '2 of 6 box arrays have no cloud to write beside them'
    assert unpaired.startswith('4 of 12 boxes were not used (no_sweep): no cloud within `reach`')
    assert list(notes(run(path, tmp_path / 'plain')[0])) == [unpaired]


def test_many_late_clouds_and_boxes_that_come_twice_are_notes(tmp_path):
    late = Drive(sweeps=12)
    for stamp in late.stamps[2:11:3]:  # the cloud is recorded after the next one and its boxes
        cloud = next(item for item in late.items if item[:2] == ('/points', stamp))
        late.items.remove(cloud)
        late.items.append(('/points', stamp + 110_000_000, cloud[2]))
    summary, _ = run(late.write(tmp_path / 'late'), tmp_path / 'out_late')
    (note,) = notes(summary)  # the first is lost, and shows that clouds come so
    assert note == (
        f'1 of 12 clouds were not used (sweep_late): {Reason.SWEEP_LATE.meaning}; '
        f'remedy: {Reason.SWEEP_LATE.remedy}'
    )
    twice = Drive(sweeps=12)
    again = [item for item in deepcopy(twice.items) if item[0] == '/boxes'][:3]
    for _, _, message in again:
        message.detections[0].bbox.center.position.x += 0.1  # equal ones are read once
    again = [(topic, ns + 40_000_000, m) for topic, ns, m in again]
    twice.items += again
    summary, _ = run(twice.write(tmp_path / 'twice'), tmp_path / 'out_twice')
    (note,) = notes(summary)
    assert note.startswith('6 of 30 boxes were not used (duplicate_stamp): ')


def test_unreadable_intensities_drop_no_cloud(tmp_path):
    drive = Drive(sweeps=4)
    field = drive.messages.build(
        'sensor_msgs/msg/PointField', name='intensity', offset=0, datatype=7, count=2
    )
    for k in range(4):
        drive.replace('/points', k, lambda message: message.fields.append(field))
    options = {'formats': ('sustechpoints',), 'options': Options(with_points=True)}
    summary, rows = run(drive.write(tmp_path / 'drive'), tmp_path / 'out', **options)
    assert {row['status'] for row in rows} == {'refined'}
    assert summary.frames_without_cloud == 0
    assert 'intensity' in summary.first_unreadable


def test_result_changed_by_hand_is_not_replaced(tmp_path):
    drive = Drive(sweeps=3).write(tmp_path / 'drive')
    run(drive, tmp_path / 'out')
    for name in ('mine/notes.txt', 'boxes.csv'):
        file = tmp_path / 'out' / name
        before = file.read_bytes() if file.exists() else None
        file.parent.mkdir(exist_ok=True)
        file.write_text('by hand')
        with pytest.raises(RecordingError, match=rf"'{name}' changed or added since.*another"):
            run(drive, tmp_path / 'out')
        assert file.read_text() == 'by hand'
        file.unlink() if before is None else file.write_bytes(before)


@pytest.mark.parametrize('content', ['notes.txt', 'summary.json'])
def test_folder_with_other_files_is_not_replaced(tmp_path, content):
    out = tmp_path / 'out'
    out.mkdir()
    (out / content).write_text('{"mine": true}')
    with pytest.raises(RecordingError, match='choose another'):
        run(Drive(sweeps=3).write(tmp_path / 'drive'), out)
    assert [item.name for item in out.iterdir()] == [content]
    (tmp_path / 'file').write_text('mine')
    with pytest.raises(RecordingError, match='choose another'):
        run(tmp_path / 'drive' / 'drive.mcap', tmp_path / 'file')


def test_output_that_contains_an_input_is_refused(tmp_path, capsys):
    out = tmp_path / 'out'
    link = tmp_path / 'link.mcap'
    bag = Drive(sweeps=3).write(tmp_path / 'drive')
    run(bag, out)
    shutil.copy(bag, out / 'drive.mcap')
    link.symlink_to(out / 'drive.mcap')
    margins = out / 'margins.yaml'
    margins.write_text('')
    before = sorted(out.rglob('*'))
    for words in ([out / 'drive.mcap'], [out], [link], [bag, '--config', margins]):
        assert main(['relabel', *map(str, words), '-o', str(out)]) == 2, words
        assert 'choose another with -o' in capsys.readouterr().err, words
    labels = 'csv', out / 'boxes.csv'
    with pytest.raises(ConfigError, match=r"contains no input, got one with .*boxes\.csv'"):
        run(bag, out, labels=labels)
    conversion = Request((), labels=('csv', out), formats=('openlabel',))
    with pytest.raises(ConfigError, match='choose another'):
        convert(conversion, out)
    assert sorted(out.rglob('*')) == before


def test_fingerprint_differs_between_requests(tmp_path):
    path = Drive(sweeps=3).write(tmp_path / 'drive')
    first = Request((path,)).fingerprint()
    assert Request((path,)).fingerprint() == first
    assert Request((path,), end=1.0).fingerprint() != first
    assert Request((path,), config=QUICK).fingerprint() != first
    names = tmp_path / 'names.yaml'
    found = set()
    for name in ('Van', 'Truck'):
        names.write_text(f'car: {name}\n')
        named = Request((path,), formats=('kitti',), options=Options(class_map=names))
        found.add(named.fingerprint())
    assert len(found) == 2
    path.write_bytes(path.read_bytes() + b'x')
    assert Request((path,)).fingerprint() != first


def test_convention_of_the_input_boxes(tmp_path, capsys):
    """Messages with the bottom as pose and w, l, h as size: same results with these options."""
    drive = Drive(sweeps=8)
    command = ['relabel', '--formats=csv', '-o']
    path = str(drive.write(tmp_path / 'drive'))
    assert main([*command, str(tmp_path / 'expected'), path]) == 0
    for topic, _, message in drive.items:
        for detection in message.detections if topic == '/boxes' else ():
            size = detection.bbox.size
            size.x, size.y = size.y, size.x
            detection.bbox.center.position.z -= size.z / 2
    path = str(drive.write(tmp_path / 'bottoms'))
    meant = ['--pose-reference', 'bottom', '--size-order', 'wlh']
    assert not capsys.readouterr().err
    assert main([*command, str(tmp_path / 'half'), path, *meant[2:]]) == 0
    assert 'pose_reference:=bottom' in capsys.readouterr().err
    assert main([*command, str(tmp_path / 'meant'), path, *meant]) == 0
    assert not capsys.readouterr().err
    expected = rows_of(tmp_path / 'expected')
    for row, other in zip(rows_of(tmp_path / 'meant'), expected, strict=True):
        assert float(row['z']) == pytest.approx(float(other['z']), abs=1e-6)
        assert float(row['length']) == pytest.approx(float(other['length']), abs=1e-6)
    assert main([*command, str(tmp_path / 'x'), path, '--pose-reference', 'floor']) == 2
    assert 'pose_reference' in capsys.readouterr().err
    # `evaluate` applies the convention to a recording; a table has a fixed one.
    truth = str(tmp_path / 'expected' / 'boxes.csv')
    scores = []
    for options in ([], meant):
        assert main(['evaluate', path, truth, '--json', *options]) == 0
        scores.append(json.loads(capsys.readouterr().out)['iou_3d'])
    assert scores[0] < 0.5 < 0.75 < scores[1]
    assert main(['evaluate', truth, truth, *meant]) == 2
    assert 'expected with a recording only' in capsys.readouterr().err


def test_box_topic_with_ids_is_preferred(tmp_path):
    drive = Drive(sweeps=4)
    other = Drive(sweeps=4, boxes=JSK)
    more = [('/clusters', *item[1:]) for item in other.items if item[0] == '/boxes']
    drive.items += more
    path = drive.write(tmp_path / 'drive')
    summary, _ = run(path, tmp_path / 'out')
    assert summary.topics['boxes'] == '/boxes'
    with pytest.raises(RecordingError, match='/boxes, /clusters'):
        run(path, tmp_path / 'out', convention=Convention(associate=True))


# Input boxes ----------------------------------------------------------------------------


def test_input_boxes_in_the_fixed_frame(tmp_path):
    drive = Drive(sweeps=4)
    arrays, left_out = input_boxes(source_of(Request((drive.write(tmp_path / 'drive'),))))
    assert not left_out
    assert [array.stamp_ns for array in arrays] == drive.stamps
    for array in arrays:
        assert (array.frame_id, array.track_ids) == ('odom', ('1', '2'))
        np.testing.assert_allclose(array.boxes, drive.truth[array.stamp_ns], atol=0.25)


def test_evaluate_and_convert_accept_the_options_they_propose(tmp_path, capsys):
    drive = Drive(sweeps=4, motion='odometry')
    for topic in ('/boxes', '/odom'):
        drive.items += [(f'{topic}2', *item[1:]) for item in drive.items if item[0] == topic]
    path = str(drive.write(tmp_path / 'drive'))
    table = str(tmp_path / 'input.csv')
    topics = {'boxes': '/boxes2', 'odometry': '/odom2'}
    BoxTable.from_arrays(input_boxes(source_of(Request((Path(path),), **topics)))[0]).write(table)
    assert main(['evaluate', path, table]) == 1
    assert 'choose one with --boxes' in capsys.readouterr().err
    words = ['--boxes', '/boxes2', '--odometry', '/odom2', '--fixed-frame', 'odom']
    assert main(['evaluate', path, table, *words]) == 0
    assert '8 true boxes, 0 missing' in capsys.readouterr().out
    assert main(['evaluate', table, table, *words[:2]]) == 2
    assert 'leave them out' in capsys.readouterr().err
    words = ['--from', 'csv', '--to', 'nuscenes', '--recording', path, '-o', str(tmp_path / 'out')]
    assert main(['convert', table, *words]) == 1
    assert 'choose one with --odometry' in capsys.readouterr().err
    assert main(['convert', table, *words, '--odometry', '/odom']) == 0


# Real data -------------------------------------------------------------------------------------

KITTI = SHARED / 'data' / 'kitti_raw_0001.npz'
MAKER = SHARED / 'tools' / 'make_recording.py'


@pytest.mark.skipif(not (KITTI.exists() and MAKER.exists()), reason='real data is not here')
@pytest.mark.parametrize(('storage', 'boxes'), [('mcap', 'vision'), ('sqlite3', 'markers')])
def test_every_real_box_is_written_once(tmp_path, storage, boxes):
    command = [sys.executable, MAKER, KITTI, tmp_path, '--noise', 'real', '--seed', '7']
    options = ['--storage', storage, '--boxes', boxes, '--max-sweeps', '15']
    subprocess.run([*command, *options], check=True, stdout=subprocess.DEVNULL)
    recording = tmp_path / ('recording' if storage == 'sqlite3' else 'recording.mcap')
    given = [
        (array.stamp_ns, track)
        for array in input_boxes(source_of(Request((recording,))))[0]
        for track in array.track_ids
    ]
    summary, rows = run(recording, tmp_path / 'out')
    assert len(given) > 50
    assert keys(rows) == given
    assert summary.fixed_frame == 'odom'
