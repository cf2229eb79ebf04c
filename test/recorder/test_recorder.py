"""Segments of label files: whole, indexed, and recovered after any end."""

from dataclasses import replace
from io import BytesIO
import json
import os
from pathlib import Path
import pickle
import resource
import shutil
import signal
import subprocess
import sys
import time

from boxreg_ros.cli import main
from boxreg_ros.config import Config
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.journal import Journal
from boxreg_ros.io.label_feed import (
    FinalBoxes,
    LabelCloud,
    PROGRAM,
    RecorderSettings,
    RecorderStatus,
    segment_limit,
    Split,
)
from boxreg_ros.labels import frames_of, LabelFrame
from boxreg_ros.labels.segments import read_index
from boxreg_ros.recorder.main import Recorder, serve
from boxreg_ros.recorder.segment import journal_settings, lock_of, Segment
from boxreg_ros.structures import BoxArray, RefinedBoxes, Sweep
import numpy as np
from paths import ROOT
import pytest

SECOND = 10**9
START = 1_700_000_000 * SECOND
T_FIXED_SENSOR = np.array([[0.0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]])


def settings_of(folder, **changes):
    given = RecorderSettings(str(folder), ('csv', 'openlabel'), False, '1 h', '', Config())
    return given._replace(**changes)


def final_boxes(k, tracks=2):
    """Return final boxes of the sweep number `k` at 10 Hz."""
    boxes = np.zeros((tracks, 9))
    boxes[:, :6] = [1.0 * k, 2, 3, 4, 2, 1.5]
    boxes[:, 1] += 10 * np.arange(tracks)
    names = tuple(str(track) for track in range(tracks))
    refined = RefinedBoxes(
        BoxArray(
            START + k * SECOND // 10, 'odom', names, ('car',) * tracks, np.full(tracks, 0.5), boxes
        ),
        ('refined', 'kept')[:tracks], ('', 'no_points')[:tracks], np.arange(tracks) + k,
        np.tile(np.diag(np.arange(1.0, 7.0)), (tracks, 1, 1)),
    )  # fmt: skip
    return FinalBoxes(refined, 'odom', 'lidar', T_FIXED_SENSOR, T_FIXED_SENSOR)


def cloud(k, points=50):
    sweep = Sweep(START + k * SECOND // 10, 'lidar', np.full((points, 3), k, np.float32))
    return LabelCloud(sweep, T_FIXED_SENSOR, np.arange(points, dtype=float), sweep.stamp_ns)


def record(settings, items):
    """Let a recorder in this process record items, and return its last status."""
    source = BytesIO(b''.join(pickle.dumps(item) for item in (settings, *items)))
    states = []
    serve(source, states.append)
    return states[-1]


def stamps_in(folder, name='csv'):
    """Return the numbers of the sweeps whose boxes are in a folder, read as labels."""
    return [
        (frame.refined.boxes.stamp_ns - START) * 10 // SECOND for frame in frames_of(name, folder)
    ]


def start_recorder(settings, **options):
    """Start a recorder as the node does."""
    return subprocess.Popen(
        [sys.executable, '-m', PROGRAM], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        **options,
    )  # fmt: skip


def last_status(output):
    return RecorderStatus(**json.loads(output.decode().splitlines()[-1]))


def test_a_frame_in_the_journal_is_what_was_written(tmp_path):
    final = final_boxes(3)
    sweep = Sweep(START, 'lidar', np.arange(12, dtype=np.float32).reshape(4, 3))
    with_cloud = LabelFrame(
        final.refined, 'odom', 'lidar', T_FIXED_SENSOR, sweep, np.arange(4.0), np.eye(4)
    )
    without = LabelFrame(final_boxes(4, tracks=0).refined, 'odom', 'lidar')
    journal = Journal(tmp_path / 'journal')
    for frame in (with_cloud, without):
        journal.append(frame)
    for back, frame in zip(journal.records(), (with_cloud, without), strict=True):
        assert pickle.dumps(back) == pickle.dumps(frame)
    journal.delete()


def cut_off_segment(folder, frames):
    """Leave the files of a recorder that was killed; return its journal and write-ahead log."""
    folder.mkdir(exist_ok=True)
    pid = os.fork()
    if pid == 0:
        segment = Segment(folder, 1, journal_settings(settings_of(folder)))
        for k in range(frames):
            segment.write(LabelFrame(final_boxes(k).refined, 'odom', 'lidar', T_FIXED_SENSOR))
        os._exit(0)
    os.waitpid(pid, 0)
    opened = folder / '.segment_000001.open'
    return opened / 'journal.sqlite', opened / 'journal.sqlite-wal'


def test_a_power_cut_leaves_the_whole_frames(tmp_path):
    """A log that is cut off, or ends with pages of zeros, is recovered up to there."""
    _, log = cut_off_segment(tmp_path / 'source', 12)
    size = log.stat().st_size
    found = []
    for i, (part, pages) in enumerate([(1.0, 20), (0.9, 0), (0.7, 1), (0.5, 7)]):
        folder = tmp_path / str(i)
        shutil.copytree(tmp_path / 'source', folder)
        log = folder / '.segment_000001.open' / 'journal.sqlite-wal'
        log.write_bytes(log.read_bytes()[: int(part * size)] + bytes(4096 * pages))
        assert main(['recover', str(folder)]) == 0
        found.append(stamps_in(folder))
        assert found[-1] == list(range(len(found[-1])))
    assert len(found[0]) == 12
    assert sorted(found, key=len, reverse=True) == found
    assert 0 < len(found[-1]) < 12


@pytest.mark.parametrize('damage', ['zeros', 'a frame that no writer takes'])
def test_a_journal_that_cannot_be_read_is_kept_and_stops_nothing(tmp_path, capsys, damage):
    folder = tmp_path / 'labels'
    journal, log = cut_off_segment(folder, 2)
    if damage == 'zeros':
        journal.write_bytes(bytes(4096))
        log.unlink()
    else:
        refined = final_boxes(2, 1).refined
        boxes = replace(refined.boxes, track_ids=('\ud800',))  # half a character
        opened = Journal(journal)
        assert opened.cut(3) == 3
        opened.append(LabelFrame(replace(refined, boxes=boxes), 'odom', 'lidar', T_FIXED_SENSOR))
        opened.close()
    status = record(settings_of(folder), [final_boxes(7)])
    assert (status.damaged, status.recovered, status.segments, status.error) == (1, 0, 1, '')
    assert stamps_in(folder) == [7]
    assert (folder / '.segment_000001.damaged' / 'journal.sqlite').exists()
    assert read_index(folder)[0].segment == 'segment_000002'
    (folder / '.segment_000001.damaged').rename(folder / '.segment_000001.open')
    assert main(['recover', str(folder)]) == 1
    assert 'its journal cannot be read; delete it' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('segment', 'expected'),
    [('1 s', [10, 10, 5]), ('1min', [25]), ('0.5 h', [25])],
)
def test_segments_end_after_their_time(tmp_path, segment, expected):
    status = record(settings_of(tmp_path, segment=segment), map(final_boxes, range(25)))
    rows = read_index(tmp_path)
    assert [row.frames for row in rows] == expected
    assert (status.frames, status.boxes, status.segments) == (25, 50, len(expected))
    assert status.size == sum(row.size for row in rows)
    for row, part in zip(rows, np.split(np.arange(25), np.cumsum(expected))[:-1], strict=True):
        assert row.first_stamp_ns == START + part[0] * SECOND // 10
        assert row.last_stamp_ns == START + part[-1] * SECOND // 10
        files = {path for path in (tmp_path / row.segment).rglob('*') if path.is_file()}
        assert row.size == sum(path.stat().st_size for path in files)
    for name in ('csv', 'openlabel'):
        assert stamps_in(tmp_path, name) == list(range(25))


def test_a_segment_ends_by_service_and_where_the_clock_changes(tmp_path):
    numbers = 104, 105, 0, 1, 10**9  # back to another clock, and on to a third
    items = [*map(final_boxes, range(100, 104)), Split(), *map(final_boxes, numbers)]
    record(settings_of(tmp_path), items)
    assert [row.frames for row in read_index(tmp_path)] == [4, 2, 2, 1]
    record(settings_of(tmp_path), [final_boxes(7)])  # continues
    assert [row.segment[-1] for row in read_index(tmp_path)] == ['1', '2', '3', '4', '5']
    assert stamps_in(tmp_path) == [100, 101, 102, 103, 104, 105, 0, 1, 10**9, 7]


def test_segments_end_at_their_size(tmp_path):
    recorder = start_recorder(tmp_path)
    settings = settings_of(
        tmp_path, formats=('sustechpoints',), with_points=True, segment='0.2 MB'
    )
    pickle.dump(settings, recorder.stdin)
    for k in range(28):
        for item in (cloud(k, 2000), final_boxes(k)):
            pickle.dump(item, recorder.stdin)
        recorder.stdin.flush()
        time.sleep(0.1)
    output, _ = recorder.communicate(timeout=30)
    rows = read_index(tmp_path)
    assert len(rows) > 1
    assert all(row.size >= 0.2e6 for row in rows[:-1])
    status = last_status(output)
    assert (status.clouds, status.without_cloud, status.error) == (28, 0, '')
    assert status.free > 0
    assert sum(row.clouds for row in rows) == 28


def test_clouds_that_no_boxes_need_are_deleted(tmp_path):
    """Without boxes, the disk would fill with clouds; those that boxes may need are kept."""
    settings = settings_of(tmp_path, formats=('sustechpoints',), with_points=True)
    recorder = Recorder(settings)
    for k in range(20):
        needed_from_ns = START + max(k - 3, 0) * SECOND // 10
        recorder.take(cloud(k)._replace(needed_from_ns=needed_from_ns))
        assert len(list((tmp_path / '.clouds').iterdir())) <= 5
    recorder.take(final_boxes(17))
    recorder.finish()
    (row,) = read_index(tmp_path)
    assert row.clouds == 1
    assert not (tmp_path / '.clouds').exists()


def test_killed_recorder_loses_nothing_that_it_has_taken(tmp_path):
    """SIGKILL at random moments; recovery gives whole files with all frames but the last few."""
    rng = np.random.default_rng(35)
    # On a busy machine each round may be killed before its first frame.
    record(settings_of(tmp_path), [final_boxes(0)])
    taken = 1
    for round_number in range(1, 5):
        recorder = start_recorder(tmp_path)
        pickle.dump(settings_of(tmp_path, segment='1 s'), recorder.stdin)
        recorder.stdin.flush()
        recorder.stdout.readline()  # it has recovered or is about to
        count = int(rng.integers(3, 30))
        for k in range(count):
            pickle.dump(final_boxes(100 * round_number + k), recorder.stdin)
        recorder.stdin.flush()
        time.sleep(rng.uniform(0, 0.3))
        recorder.send_signal(signal.SIGKILL)
        recorder.communicate()
        taken += count
    assert main(['recover', str(tmp_path)]) == 0
    names = [path.name for path in tmp_path.iterdir() if path.name.startswith('.')]
    assert names == []
    stamps = stamps_in(tmp_path)
    assert stamps == sorted(set(stamps))
    assert stamps == stamps_in(tmp_path, 'openlabel')
    assert stamps[0] == 0
    for round_number in range(1, 5):  # no gaps: only the end of a round may be missing
        part = [stamp % 100 for stamp in stamps if stamp // 100 == round_number]
        assert part == list(range(len(part)))
    assert len(stamps) <= taken


def test_recovery_deletes_what_a_killed_recorder_was_writing(tmp_path):
    record(settings_of(tmp_path), [final_boxes(0)])
    partial = tmp_path / '.index.csv.1a2b3c4d.partial'
    partial.write_text('segment,first_st')
    (tmp_path / '.clouds').mkdir()
    (tmp_path / '.clouds' / '0.npy').write_bytes(b'')
    assert main(['recover', str(tmp_path)]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ['index.csv', 'segment_000001']
    partial.write_text('')
    record(settings_of(tmp_path), [final_boxes(1)])
    assert not partial.exists()


def test_every_step_of_completion_may_be_the_last(tmp_path):
    """A segment that has its name but is not in the index is made again from its journal."""
    cut_off_segment(tmp_path, 3)
    opened = tmp_path / '.segment_000001.open'
    (opened / 'labels').rename(tmp_path / 'segment_000001')  # incomplete files, not in the index
    assert main(['recover', str(tmp_path)]) == 0
    assert stamps_in(tmp_path) == [0, 1, 2]
    (row,) = read_index(tmp_path)
    assert (row.frames, row.recovered) == (3, 1)
    # In the index, and only the deletion of the journal is missing.
    (tmp_path / '.segment_000001.open').mkdir()
    (tmp_path / '.segment_000001.open' / 'journal.sqlite').write_bytes(b'')
    assert main(['recover', str(tmp_path)]) == 0
    assert read_index(tmp_path) == [row]
    assert not opened.exists()


def test_recovery_says_what_it_did_and_what_it_expected(tmp_path, capsys):
    assert main(['recover', str(tmp_path)]) == 1
    assert 'expected the folder of a recording of labels' in capsys.readouterr().err
    cut_off_segment(tmp_path, 0)
    assert main(['recover', str(tmp_path)]) == 0  # nothing was written before it was cut off
    record(settings_of(tmp_path), map(final_boxes, range(3)))
    assert main(['recover', str(tmp_path)]) == 0
    assert '0 segments recovered; 6 boxes in 1 segments' in capsys.readouterr().out
    with lock_of(tmp_path):
        assert main(['recover', str(tmp_path)]) == 1
    assert f'in use by process {os.getpid()}' in capsys.readouterr().err


def test_two_recorders_do_not_share_a_folder(tmp_path):
    with (
        lock_of(tmp_path),
        pytest.raises(RecordingError, match=r'record_to .* no other process writes to'),
    ):
        record(settings_of(tmp_path), [final_boxes(0)])
    record(settings_of(tmp_path), [final_boxes(0)])


def test_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(RecordingError, match=r"record_to .*/file': expected a folder, got a file"):
        record(settings_of(tmp_path / 'file'), [final_boxes(0)])
    with pytest.raises(
        RecordingError, match=r"file/labels': .*be made, got: Not a directory; cho"
    ):
        record(settings_of(tmp_path / 'file' / 'labels'), [final_boxes(0)])
    with pytest.raises(RecordingError, match=r'or can be made, got: File name too long; choose'):
        record(settings_of(tmp_path / ('x' * 300)), [final_boxes(0)])


def test_full_disk_ends_the_recording_and_keeps_the_journal(tmp_path):
    """The limit on the size of files stands for a full disk; both are one error of `write`."""
    limit = 150_000
    recorder = start_recorder(
        tmp_path,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )
    items = [settings_of(tmp_path), *map(final_boxes, range(100))]
    output, _ = recorder.communicate(b''.join(map(pickle.dumps, items)), timeout=30)
    assert recorder.returncode == 1
    assert 'expected room for labels, got: File too large' in last_status(output).error
    assert sorted(path.name for path in tmp_path.iterdir()) == ['.segment_000001.open']
    assert main(['recover', str(tmp_path)]) == 0  # there is room now
    stamps = stamps_in(tmp_path)
    assert 5 < len(stamps) < 100
    assert stamps == list(range(len(stamps)))


@pytest.mark.parametrize('changes', [{}, {'formats': ('sustechpoints',), 'with_points': True}])
def test_deleted_folder_ends_the_recording(tmp_path, changes):
    folder = tmp_path / 'labels'
    recorder = start_recorder(folder)
    pickle.dump(settings_of(folder, **changes), recorder.stdin)
    pickle.dump(final_boxes(0), recorder.stdin)
    recorder.stdin.flush()
    while not (folder / '.segment_000001.open' / 'journal.sqlite').exists():
        time.sleep(0.01)
    while folder.exists():  # the recorder may make a file while the others are deleted
        subprocess.run(['rm', '-rf', str(folder)], check=False)
    time.sleep(1.1)  # a status is due
    items = b''.join(map(pickle.dumps, (cloud(1), final_boxes(1))))
    output, _ = recorder.communicate(items, timeout=30)
    assert recorder.returncode == 1
    error = last_status(output).error
    assert 'expected a folder until the recording ends, got one that was deleted' in error
    assert not folder.exists()


@pytest.mark.parametrize('text', ['', '60', 's', '-1 s', '0 s', '1 week', '1 mb'])
def test_length_of_segments_is_a_number_with_a_unit(text):
    with pytest.raises(ConfigError, match='record_segment: expected a positive number'):
        segment_limit(text)


def test_lengths_of_segments():
    assert segment_limit('90 s') == (90.0, False)
    assert segment_limit('1.5min') == (90.0, False)
    assert segment_limit('2 GB') == (2e9, True)


@pytest.mark.parametrize(
    ('changes', 'error'),
    [
        ({'formats': ('csv', 'mcap')}, 'record_formats: .* xtreme1, got .* ros2 bag record'),
        ({'formats': ('lidarseg',)}, "xtreme1, got 'lidarseg'; labels of points"),
        ({'formats': ('kity',)}, r"xtreme1, got 'kity'; did you mean kitti\?"),
        ({'formats': ('csv',), 'with_points': True}, 'expected a format with clouds'),
        ({'formats': ('kitti',)}, 'record_camera'),
        ({'segment': '5'}, 'record_segment'),
    ],
)
def test_settings_that_cannot_work_are_named(tmp_path, changes, error):
    with pytest.raises(ConfigError, match=error):
        record(settings_of(tmp_path, **changes), [final_boxes(0)])
    assert not list(tmp_path.iterdir())


def test_checking_formats_imports_no_large_library():
    """A recorder starts beside the node, and checks its parameters while it waits."""
    code = (
        'import sys\n'
        'from boxreg_ros.recorder.main import check_each\n'
        "check_each(('csv',), '')\n"
        "print(*{'numba', 'rosbags', 'scipy', 'torch'} & set(sys.modules))\n"
    )
    done = subprocess.run([sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ('\n', '')


def test_index_that_was_edited_is_named(tmp_path):
    record(settings_of(tmp_path), [final_boxes(0)])
    (tmp_path / 'index.csv').write_text('segment,frames\nsegment_000001,many\n')
    with pytest.raises(RecordingError, match=r'index\.csv: expected the columns segment, first'):
        list(frames_of('csv', Path(tmp_path)))
