"""`boxreg review`: the page in a real browser, decisions.csv, and what a run makes of it."""

from contextlib import contextmanager
import csv
from dataclasses import replace
from datetime import datetime
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
import json
import resource
import shutil
import signal
import socket
import subprocess
from threading import Thread
from time import sleep

from boxreg_ros.cli import main
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.labels import LabelFrame, Options, Provenance
from boxreg_ros.labels.csv import Writer as csv_writer
from boxreg_ros.review.corrections import Corrections
from boxreg_ros.review.decisions import (
    contradictions,
    Decision,
    DecisionLog,
    DECISIONS,
    joined_files,
    read_decisions,
)
from boxreg_ros.review.server import review_server
from boxreg_ros.structures import BoxArray, kept, RefinedBoxes
from browser import NEEDS_BROWSER, opened_page, press, serving, show_charts
import numpy as np
import pytest
from ros_messages import Drive

pytest.importorskip('plotly')
SCRIPT = '<script>alert(1)</script>'
BOX = np.array([10.0, -2.0, 0.5, 4.2, 1.8, 1.5, 0.01, -0.02, 0.3])
QUICK = ['--set', 'solver.rounds=2', '--set', 'sampling.points=64']


def boxreg(*words):
    return main([str(word) for word in words])


@pytest.fixture(scope='module')
def result(tmp_path_factory):
    """Return a recording with a class named like a tag, and the result of relabelling it."""
    folder = tmp_path_factory.mktemp('review')
    drive = Drive(sweeps=14)
    for topic, _, message in drive.items:
        for detection in message.detections[1:] if topic == '/boxes' else ():
            for hypothesis in detection.results:
                hypothesis.hypothesis.class_id = SCRIPT
    recording = drive.write(folder / 'drive')
    assert boxreg('relabel', recording, '-o', folder / 'out', '--report', *QUICK) == 0
    return recording, folder / 'out'


# The file ----------------------------------------------------------------------------------------


def test_decisions_are_read_as_written(tmp_path):
    made = [
        Decision('a,"b"', None, 'reject', 'two\nlines, "quoted"'),
        Decision('7', 1_700_000_000_123_456_789, 'pin', '', 'odom', BOX),
    ]
    log = DecisionLog(tmp_path / DECISIONS)
    for decision in made:
        log.append([decision])
    first, second = read_decisions(tmp_path / DECISIONS)
    assert (first.track_id, first.kind, first.comment) == (
        'a,"b"',
        'reject',
        'two lines, "quoted"',
    )
    assert second.stamp_ns == made[1].stamp_ns
    np.testing.assert_allclose(second.box, BOX, atol=1e-8)


def test_a_crash_loses_no_earlier_row(tmp_path):
    path = tmp_path / DECISIONS
    log = DecisionLog(path)
    log.append([Decision('1', None, 'accept')])
    with open(path, 'ab') as file:
        file.write(b'2,,rej')  # the machine stopped while a row was written
    assert [one.track_id for one in read_decisions(path)] == ['1']
    DecisionLog(path).append([Decision('3', None, 'unsure')])
    assert [one.track_id for one in read_decisions(path)] == ['1', '3']


@pytest.mark.parametrize('first', ['# boxreg decisions 2\n', '\ufeff# boxreg decisions 2,,\n', ''])
def test_a_last_row_without_an_end_is_read_and_kept(tmp_path, first):
    """Spreadsheets in the browser, and some editors, end no last line."""
    path = tmp_path / DECISIONS
    log = DecisionLog(path)
    log.append([Decision('1', None, 'accept'), Decision('2', None, 'delete')])
    lines = path.read_text().splitlines()[1:]
    rows = [line if first else ','.join(line.split(',')[:15]) for line in lines]
    path.write_text(first + '\n'.join(rows))
    assert [one.track_id for one in read_decisions(path)] == ['1', '2']
    DecisionLog(path).append([Decision('3', None, 'unsure')])
    assert [one.track_id for one in read_decisions(path)] == ['1', '2', '3']


def test_texts_of_any_kind_come_back(tmp_path):
    names = ['=1+1', '-7', '@a', "'q'", 'a\rb', 'c\r\nd', 'x' * 10**6, '\tz', '']
    path = tmp_path / DECISIONS
    for name in names:
        DecisionLog(path).append(
            [Decision(name, 3, 'rename', name, '', None, 9, name, 'me', 'now')]
        )
    made = read_decisions(path)
    assert [one.track_id for one in made] == names
    assert [one.value for one in made] == names
    assert {(one.stamp_ns, one.end_ns, one.who, one.when) for one in made} == {(3, 9, 'me', 'now')}
    cells = [row[0] for row in csv.reader(path.open(newline='', encoding='utf-8'))][2:]
    runs = ('=', '+', '-', '@', '\t', '\r')
    assert [cell for cell in cells if cell.startswith(runs)] == ['-7']  # a number runs nothing
    with pytest.raises(RecordingError, match='half a character'):
        DecisionLog(path).append([Decision('1', None, 'accept', '\ud800')])
    assert len(read_decisions(path)) == len(names)
    table = BoxTable.from_arrays([
        BoxArray(5, 'odom', tuple(names), ('a\rb',) * 9, np.ones(9), np.tile(BOX, (9, 1)))
    ])  # fmt: skip
    table.write(tmp_path / 'boxes.csv')
    assert BoxTable.read(tmp_path / 'boxes.csv').track_ids == tuple(names)
    writer = csv_writer(tmp_path, Provenance(), Options())
    boxes = BoxArray(6, 'odom', ('a\rb',), ('c\rd',), np.ones(1), BOX[None])
    writer.write(LabelFrame(kept(boxes, 'no_gain'), 'odom', 'lidar'))
    writer.write(LabelFrame(kept(replace(boxes, stamp_ns=5), 'no_gain'), 'odom', 'lidar'))
    writer.close()
    assert BoxTable.read(tmp_path / 'boxes.csv').track_ids == ('a\rb', 'a\rb')


def test_a_full_disk_loses_no_earlier_row(tmp_path):
    path = tmp_path / DECISIONS
    log = DecisionLog(path)
    log.append([Decision('1', None, 'accept')])
    before = path.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) + 20, limits[1]))
    try:
        with pytest.raises(OSError, match='File too large'):
            log.append([Decision('2', None, 'reject', 'a comment longer than the room left')])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == before
    log.append([Decision('3', None, 'accept')])
    assert [one.track_id for one in read_decisions(path)] == ['1', '3']
    assert [one.track_id for one in log.decisions] == ['1', '3']


def test_decisions_of_earlier_versions_are_read_and_continued(tmp_path):
    path = tmp_path / DECISIONS
    path.write_text(
        'track_id,stamp_ns,decision,comment,frame_id,x,y,z,qx,qy,qz,qw,length,width,height\n'
        "'1,,reject,why,,,,,,,,,,,\n"
        '2,12,pin,,odom,1,2,3,0,0,0,1,4,2,1.5\n'
    )
    assert [one.track_id for one in read_decisions(path)] == ["'1", '2']
    DecisionLog(path).append([Decision('3', None, 'delete')])
    assert path.read_text().startswith('# boxreg decisions 2\n')
    made = read_decisions(path)
    assert [(one.track_id, one.kind) for one in made] == [
        ("'1", 'reject'), ('2', 'pin'), ('3', 'delete'),
    ]  # fmt: skip
    assert made[1].box[3:6].tolist() == [4, 2, 1.5]
    path.write_text('# boxreg decisions 9\n')
    with pytest.raises(RecordingError, match='expected decisions of version 1 or 2'):
        read_decisions(path)
    path.write_text('')  # made by an earlier version, without a header
    DecisionLog(path).append([Decision('3', None, 'delete')])
    assert len(read_decisions(path)) == 1


def test_decisions_of_two_people_are_joined_by_cat(tmp_path):
    first, second = [Decision('1', None, 'delete')], [Decision('1', 5, 'accept', who='b')]
    parts = []
    for name, rows in (('a', first), ('b', second)):
        DecisionLog(tmp_path / name).append(rows)
        parts.append((tmp_path / name).read_bytes())
    both = tmp_path / 'both'
    both.write_bytes(b''.join(parts))
    assert read_decisions(both) == [*first, *second]
    common = Decision('1', None, 'reject', who='c', when='2026-01-01')
    rows = {
        'b': [common, Decision('2', None, 'accept', who='b'), Decision('1', None, 'accept')],
        'a': [common, Decision('2', None, 'unsure', who='a')],
    }
    for name, own in rows.items():
        DecisionLog(tmp_path / f'copy_{name}').append(own)
    copies = [(tmp_path / f'copy_{name}').read_bytes() for name in rows]
    (tmp_path / 'copies').write_bytes(b''.join(copies))
    files = joined_files(tmp_path / 'copies')
    # What both copies have begun with is no later word of the second.
    assert files == [rows['b'], rows['a'][1:]]
    assert contradictions(files) == ["'2' (accept, then unsure)"]
    other = tmp_path / 'other'
    other.write_bytes(parts[0] + b'# boxreg decisions 9\n')
    with pytest.raises(RecordingError, match='line 4: expected a file of version 2'):
        read_decisions(other)
    with both.open('a', encoding='utf-8') as file:
        file.write('7,,maybe,,,,,,,,,,,,,,,,\n')
    with pytest.raises(RecordingError, match=r'line 7: .*maybe'):
        read_decisions(both)


def test_objects_that_two_people_have_added_under_one_id_stay_apart(tmp_path):
    """Both pages count on from the last track of the result that they have a copy of."""

    def added(name, x, stamp_ns=5, **of):
        box = np.array([x, 0, 1, 4, 2, 1.5, 0, 0, 0.0])
        return Decision(name, stamp_ns, 'add', frame_id='odom', box=box, value='car', **of)

    common = added('20', 0)
    first = [common, added('21', 10, who='a'), added('22', 40, who='a')]
    about = [Decision('21', 7, 'delete'), Decision('3', None, 'rename', value='21')]
    second = [common, added('21', 30, who='b'), *about, added('22', 40.5, who='b')]
    both = tmp_path / DECISIONS
    for name, rows in (('a', first), ('b', second)):
        DecisionLog(tmp_path / name).append(rows)
        both.write_bytes(
            (both.read_bytes() if name == 'b' else b'') + (tmp_path / name).read_bytes()
        )
    log = DecisionLog(both)
    expected = ['20', '21', '22', '20', '21.2', '21.2', '3', '22']
    assert [one.track_id for one in log.decisions] == expected
    assert log.decisions[6].value == '21.2'
    # The review goes on with either object.
    log.append([added('21', 11, 6), added('21.2', 31, 6)])
    assert [one.track_id for one in read_decisions(both)] == [*expected, '21', '21.2']
    seeds = Corrections(read_decisions(both)).seeds('odom')
    at = sorted((seed.track_ids[0], round(seed.boxes[0, 0])) for seed in seeds)
    assert at == [('20', 0), ('21', 10), ('21', 11), ('21.2', 30), ('21.2', 31), ('22', 40)]


@pytest.mark.parametrize(
    ('row', 'word'),
    [
        ('7,12,pin,,odom,nan,0,0,0,0,0,1,4,2,1.5,,,,', 'finite numbers'),
        ('7,12,pin,,odom,1,0,0,0,0,0,1,4,-2,1.5,,,,', 'positive extents'),
        ('7,12,pin,,odom,,,,,,,,,,,,,,', 'got none'),
        ('7,,pin,,odom,1,0,0,0,0,0,1,4,2,1.5,,,,', 'stamp'),
        ('7,noon,accept,,,,,,,,,,,,,,,,', 'noon'),
        ('7,,maybe,,,,,,,,,,,,,,,,', 'maybe'),
    ],
)
def test_bad_rows_are_refused_by_line(tmp_path, row, word):
    path = tmp_path / DECISIONS
    DecisionLog(path).append([Decision('1', None, 'accept')])
    with open(path, 'a', encoding='utf-8') as file:
        file.write(row + '\n')
    with pytest.raises(RecordingError, match=r'line 4: .*') as caught:
        read_decisions(path)
    assert word in str(caught.value)


def test_last_decision_holds_and_box_goes_before_track():
    given = BoxArray(5, 'odom', ('1', '2', '3'), ('car',) * 3, np.ones(3), np.tile(BOX, (3, 1)))
    moved = given.boxes + 0.1
    result = BoxArray(5, 'odom', given.track_ids, given.class_names, np.ones(3), moved)
    covariances = np.tile(0.01 * np.eye(6), (3, 1, 1))
    refined = RefinedBoxes(result, ('refined',) * 3, ('',) * 3, np.ones(3, int), covariances)
    pin = BOX + 0.5
    corrections = Corrections([
        Decision('1', None, 'reject'),
        Decision('1', 5, 'pin', '', 'odom', pin),
        Decision('2', None, 'reject'),
        Decision('3', None, 'reject'),
        Decision('3', None, 'none'),
        Decision('4', None, 'reject'),
        Decision('5', None, 'accept'),
        Decision('3', 4, 'unsure'),
        Decision('2', 6, 'reject'),
    ])  # fmt: skip
    pinned = corrections.to_register(given)
    assert pinned.pinned.tolist() == [True, False, False]
    np.testing.assert_array_equal(pinned.boxes[0], pin)
    found = corrections.apply(given, refined)
    assert found.status == ('human', 'kept', 'refined')
    assert found.reasons == ('', 'rejected', '')
    np.testing.assert_array_equal(found.boxes.boxes, [pin, BOX, moved[2]])
    for stamp_ns in (5, 9):
        at = replace(given, stamp_ns=stamp_ns)
        corrections.with_attributes(at, corrections.apply(at, replace(refined, boxes=at)))
    assert corrections.unused() == ["'2' at 6", "'3' at 4", "'4'", "'5'"]
    later = Corrections(earlier=corrections.applied())  # on the result: gaps are rejected as well
    assert [later.is_left_out(name, 7) for name in '123'] == [True, True, False]
    assert not later.is_left_out('1', 5)


def test_deleted_renamed_and_reclassed_boxes_of_a_range():
    names = ('1', '2', '3', '4')
    given = BoxArray(5, 'odom', names, ('car',) * 4, np.ones(4), np.tile(BOX, (4, 1)))
    corrections = Corrections([
        Decision('1', 5, 'delete'),
        Decision('2', 3, 'rename', end_ns=9, value='7'),
        Decision('2', 4, 'rename', end_ns=6, value='8'),  # the later one
        Decision('3', None, 'rename', value='9'),
        Decision('3', None, 'rename'),  # undone
        Decision('3', None, 'reclass', value='van'),
        Decision('3', None, 'delete'),  # before the pin
        Decision('3', 5, 'pin', '', 'odom', BOX + 0.5),
        Decision('4', 6, 'delete', end_ns=9),
        Decision('4', None, 'delete'),
        Decision('4', None, 'restore'),
    ])  # fmt: skip
    registered = corrections.to_register(given)
    assert registered.track_ids == ('8', '3', '4')
    assert registered.class_names == ('car', 'van', 'car')
    assert registered.pinned.tolist() == [False, True, False]
    added = replace(registered, track_ids=(*registered.track_ids, 'new'), class_names=('car',) * 4,
                    scores=np.ones(4), boxes=np.tile(BOX, (4, 1)), pinned=None)  # fmt: skip
    status = 'refined', 'refined', 'kept', 'interpolated'
    refined = RefinedBoxes(added, status, ('',) * 4, np.arange(4), np.tile(np.eye(6), (4, 1, 1)))
    found = corrections.apply(given, refined)
    assert found.boxes.track_ids == ('1', '8', '3', '4', 'new')
    assert found.status == ('rejected', 'refined', 'human', 'kept', 'interpolated')
    assert found.reasons == ('deleted', '', '', '', '')
    assert found.num_points.tolist() == [0, 0, 1, 2, 3]
    assert corrections.unused() == ["'4' at 6 to 9"]
    assert corrections.doubts() == ["delete of '4' at 6 to 9 leaves out the box 1 ns beside it"]


def test_a_pin_holds_its_extents_along_the_whole_track():
    pin = BOX + 0.5
    corrections = Corrections([Decision('1', 5, 'pin', '', 'odom', pin)])
    later = BoxArray(10**12, 'odom', ('1', '2'), ('car',) * 2, np.ones(2), np.tile(BOX, (2, 1)))
    found = corrections.to_register(later)
    assert not found.pinned.any()
    np.testing.assert_array_equal(found.boxes[0, 3:6], pin[3:6])
    np.testing.assert_array_equal(found.boxes[0, :3], BOX[:3])
    np.testing.assert_array_equal(found.boxes[1], BOX)
    # A box that is kept is returned as in the input.
    kept = RefinedBoxes(
        found, ('kept',) * 2, ('no_gain',) * 2, np.ones(2, int), np.ones((2, 6, 6))
    )
    np.testing.assert_array_equal(corrections.apply(later, kept).boxes.boxes, later.boxes)


def test_pin_in_another_frame_is_refused():
    given = BoxArray(5, 'odom', ('1',), ('car',), np.ones(1), BOX[None])
    with pytest.raises(RecordingError, match="expected frame 'odom', got 'map'"):
        Corrections([Decision('1', 5, 'pin', '', 'map', BOX)]).to_register(given)


# The run -----------------------------------------------------------------------------------------


def test_decisions_on_another_part_of_the_recording_are_kept_for_it(result, tmp_path, capsys):
    recording, out = result
    table = BoxTable.read(out / 'boxes.csv')
    log = DecisionLog(tmp_path / DECISIONS)
    for stamp_ns in (int(table.stamps_ns.min()), int(table.stamps_ns.max())):
        log.append([Decision('1', stamp_ns, 'reject')])
    options = ['--decisions', tmp_path / DECISIONS, '--end', 0.35, *QUICK]
    assert boxreg('relabel', recording, '-o', tmp_path / 'part', *options) == 0
    (line,) = [line for line in capsys.readouterr().err.splitlines() if 'decisions' in line]
    for word in ('1 are about tracks and boxes that this part', "'1' at ", 'without --start'):
        assert word in line


def test_rejected_tracks_stay_and_pinned_boxes_are_held(result, tmp_path, capsys):
    recording, out = result
    table = BoxTable.read(out / 'boxes.csv')
    rows = [i for i, name in enumerate(table.track_ids) if name == '1']
    row = rows[7]
    pin = table.boxes[row] + np.array([0.2, 0.1, 0, 0.3, 0, 0, 0, 0, 0])
    log = DecisionLog(tmp_path / DECISIONS)
    log.append([Decision('2', None, 'reject')])
    log.append([Decision('1', int(table.stamps_ns[row]), 'pin', '', table.frame_id, pin)])
    log.append([Decision('nobody', None, 'reject')])
    again = tmp_path / 'again'
    decisions = ['--decisions', tmp_path / DECISIONS]
    formats = ['--formats', 'openlabel,nuscenes']
    assert boxreg('relabel', recording, '-o', again, *formats, *decisions, *QUICK) == 1
    (line,) = [line for line in capsys.readouterr().err.splitlines() if 'decisions' in line]
    for word in ("'nobody'", 'expected', 'got 1 that could not be used', 'are kept'):
        assert word in line
    corrected = BoxTable.read(again / 'boxes.csv')
    is_second = np.array(corrected.track_ids) == '2'
    assert {corrected.status[i] for i in np.flatnonzero(is_second)} == {'kept'}
    assert corrected.status[row] == 'human'
    np.testing.assert_allclose(corrected.boxes[row], pin, atol=1e-6)
    # The rest of the track has the extents of the pinned box.
    lengths = corrected.boxes[rows, 3]
    np.testing.assert_allclose(lengths, pin[3], atol=0.05)
    assert abs(table.boxes[rows[0], 3] - pin[3]) > 0.25
    for name in ('openlabel', 'nuscenes'):
        texts = [file.read_text('utf-8') for file in (again / name).rglob('*.json')]
        assert any('"human"' in text for text in texts), name
    assert (again / DECISIONS).read_bytes() == (tmp_path / DECISIONS).read_bytes()


def test_unreadable_decisions_stop_the_run_before_it_replaces_a_result(result, tmp_path, capsys):
    recording, _ = result
    path = tmp_path / DECISIONS
    path.write_text('a,b\n1,2\n')
    assert boxreg('relabel', recording, '-o', tmp_path / 'out', '--decisions', path) == 1
    assert 'got a file without the columns' in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


# The server --------------------------------------------------------------------------------------


def test_unfinished_result_is_refused(tmp_path, capsys):
    assert boxreg('review', tmp_path) == 1
    (line,) = capsys.readouterr().err.splitlines()
    for word in ('expected', 'got', 'report.html', '--report'):
        assert word in line


def test_report_of_another_version_is_refused(result, tmp_path, capsys):
    out = shutil.copytree(result[1], tmp_path / 'out')
    summary = json.loads((out / 'summary.json').read_text())
    other = summary | {'command': [*summary['command'], '--gone=1']}
    (out / 'summary.json').write_text(json.dumps(other))
    assert boxreg('review', out) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert 'unrecognized arguments: --gone=1' in line and 'boxreg relabel' in line
    (out / 'summary.json').write_text(json.dumps(summary))
    page = (out / 'report.html').read_text(encoding='utf-8')
    (out / 'report.html').write_text(page.replace(' data-page="2"', ''), encoding='utf-8')
    with pytest.raises(RecordingError, match='expected a report of this version, got one of'):
        review_server([(out, None)], 0)


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_ended_server_names_the_command_that_applies_its_decisions(
    result, tmp_path, preloaded_python, number
):
    out = shutil.copytree(result[1], tmp_path / 'out')
    DecisionLog(out / DECISIONS).append([Decision('1', None, 'reject')])
    command = [preloaded_python, '-m', 'boxreg_ros.cli', 'review', str(out), '--port', '0']
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        try:
            lines = [process.stdout.readline().decode() for _ in range(2)]
            process.send_signal(number)
            rest, errors = process.communicate(timeout=60)
        finally:
            process.kill()
    assert 'http://127.0.0.1:' in lines[0]
    assert f'--decisions {out / DECISIONS}' in rest.decode()
    assert (process.returncode, errors) == (0, b'')


def test_busy_port_is_refused(result):
    with (
        serving(review_server([(result[1], None)], 0)) as server,
        pytest.raises(ConfigError, match=r'expected a free one, got .* --port'),
    ):
        review_server([(result[1], None)], server.server_port)


def opened(server, **headers):
    """Return a connection to a server, and the headers of a request with its token."""
    cookie = f'boxreg_{server.server_port}={server.address.partition("token=")[2]}'
    connection = HTTPConnection('127.0.0.1', server.server_port, timeout=60)
    return connection, {'Content-Type': 'application/json', 'Cookie': cookie, **headers}


def posted(server, content, path='/decisions', **headers):
    """Return status and text of an answer; `content` is JSON, or text as it is."""
    connection, sent = opened(server, **headers)
    body = content if isinstance(content, str | bytes) else json.dumps(content)
    connection.request('POST', path, body, sent)
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, text


def row(track_id='1', decision='accept', **more):
    return {'track_id': track_id, 'decision': decision, **more}


@pytest.fixture
def server(result, tmp_path):
    """Return a running server for a copy of a result."""
    out = shutil.copytree(result[1], tmp_path / 'out')
    with serving(review_server([(out, None)], 0)) as found:
        yield found


PIN = {'decision': 'pin', 'stamp_ns': '5'}


@pytest.mark.parametrize(
    ('headers', 'content', 'status'),
    [
        ({'Host': 'example.org'}, {'rows': [row()]}, 403),
        ({'Origin': 'http://example.org'}, {'rows': [row()]}, 403),
        ({'Cookie': ''}, {'rows': [row()]}, 403),
        ({'Cookie': 'boxreg_1=guess'}, {'rows': [row()]}, 403),
        ({'Content-Type': 'text/plain'}, {'rows': [row()]}, 415),
        ({}, '[1]', 400),
        ({}, '{"rows": ' + '[' * 100_000, 400),
        ({}, b'\xff\xfe{', 400),
        ({}, '', 400),
        ({}, {'rows': []}, 400),
        ({}, {'rows': [5]}, 400),
        ({}, {'rows': [row(7)]}, 400),
        ({}, '{"rows": [{"track_id": "\\ud800", "decision": "accept"}]}', 400),
        ({}, {'rows': [row(), row(decision='maybe')]}, 400),
        ({}, {'rows': [row(stamp_ns=str(2**70))]}, 400),
        ({}, {'rows': [row(stamp_ns=12)]}, 400),
        ({}, {'rows': [row(stamp_ns='9', end_ns='5')]}, 400),
        ({}, {'rows': [row(end_ns='5')]}, 400),
        (
            {},
            '{"rows": [{"track_id": "1", "stamp_ns": "5", "decision": "pin", "box": [NaN]}]}',
            400,
        ),
        ({}, {'rows': [row(box=[1] * 8, **PIN) | PIN]}, 400),
        ({}, {'rows': [row(box=[1e999] * 9) | PIN]}, 400),
        ({}, {'rows': [row(box=[1, 2, 3, 0, 1, 1, 0, 0, 0]) | PIN]}, 400),
        ({}, {'rows': [row(box={'x': 1}) | PIN]}, 400),
        ({}, ' ' * 10**7, 413),
    ],
)
def test_foreign_and_broken_requests_write_nothing(server, capfd, headers, content, status):
    found, text = posted(server, content, **headers)
    assert (found, bool(text)) == (status, True)
    assert not server.log_paths[0].exists()
    assert capfd.readouterr().err == ''  # no traceback
    # What is decided next has a header, and is read.
    assert posted(server, {'seen': 0, 'rows': [row('2')]})[0] == 200
    assert [one.track_id for one in read_decisions(server.log_paths[0])] == ['2']


def test_pins_and_numbers_of_the_wrong_size_are_refused(server):
    for box in ([1], [[1] * 9] * 9):
        track = {'class': 'car', 'pieces': [{'index': 0}], 'pins': {'5': box}}
        status, text = posted(server, track, '/solve')
        assert (status, text.partition(',')[0]) == (400, 'solve: expected a track of the report')
    connection, headers = opened(server)
    connection.request('GET', f'/events?seen={"9" * 5000}', headers=headers)
    assert connection.getresponse().status == 400


def test_page_and_its_address_are_for_this_browser_alone(server):
    connection, headers = opened(server)
    connection.request('GET', server.address.partition(str(server.server_port))[2])
    answer = connection.getresponse()
    policy = answer.getheader('Content-Security-Policy')
    assert b'data-review' in answer.read()
    for word in ("default-src 'none'", "frame-ancestors 'none'", "script-src 'nonce-"):
        assert word in policy
    assert answer.getheader('X-Frame-Options') == 'DENY'
    cookie = answer.getheader('Set-Cookie')
    assert cookie.startswith(headers['Cookie'])
    assert 'HttpOnly; SameSite=Strict' in cookie
    connection.request('GET', '/')
    assert connection.getresponse().status == 403


def test_request_whose_body_does_not_come_ends(server, monkeypatch):
    monkeypatch.setattr('boxreg_ros.review.requests.BODY_SECONDS', 0.3)
    _, headers = opened(server)
    headers |= {'Host': f'127.0.0.1:{server.server_port}'}
    lines = ''.join(f'{name}: {value}\r\n' for name, value in headers.items())
    begin = f'POST /decisions HTTP/1.1\r\n{lines}Content-Length: 99\r\n\r\n{{'
    with socket.create_connection(('127.0.0.1', server.server_port), timeout=30) as client:
        client.sendall(begin.encode())
        assert client.recv(1000).startswith(b'HTTP/1.1 408 ')


def test_what_others_have_decided_is_not_overwritten_unseen(server):
    """Another tab, another server on the same folder, and decisions about other tracks."""
    assert posted(server, {'seen': 0, 'rows': [row('1', who='anna')]})[0] == 200
    with serving(review_server([(server.log_paths[0].parent, None)], 0)) as second:
        status, text = posted(second, {'seen': 0, 'rows': [row('1', 'reject')]})
        assert status == 409
        assert "anna has decided about track '1' meanwhile (accept)" in json.loads(text)['message']
        assert len(json.loads(text)['rows']) == 1
        assert posted(second, {'seen': 0, 'rows': [row('2', 'reject', who='ben')]})[0] == 200
        assert posted(second, {'seen': 2, 'rows': [row('1', 'reject', who='ben')]})[0] == 200
    connection, headers = opened(server)
    connection.request('GET', '/events?seen=1', headers=headers)
    answer = connection.getresponse()
    data = next(line for line in answer if line.startswith(b'data: '))
    connection.close()
    found = [
        (one['track_id'], one['decision'], one['who']) for one in json.loads(data[6:])['rows']
    ]
    assert found == [('2', 'reject', 'ben'), ('1', 'reject', 'ben')]
    made = read_decisions(server.log_paths[0])
    assert [one.who for one in made] == ['anna', 'ben', 'ben']
    assert all(datetime.fromisoformat(one.when).tzinfo for one in made)


# The page ----------------------------------------------------------------------------------------


@contextmanager
def slowly_served(page, place):
    """Serve a page on loopback that pauses at a place; yield its address."""

    class Handler(BaseHTTPRequestHandler):
        """Sends the page in two parts."""

        def do_GET(self):
            self.send_response(200 if self.path == '/' else 404)
            self.send_header('Content-Type', 'text/html; charset=utf-8')
            self.end_headers()
            if self.path == '/':
                self.wfile.write(page[:place])
                sleep(1.5)
                self.wfile.write(page[place:])

        def log_message(self, *_):
            """Print nothing."""

    server = ThreadingHTTPServer(('127.0.0.1', 0), Handler)
    Thread(target=server.serve_forever).start()
    yield f'http://127.0.0.1:{server.server_port}/'
    server.shutdown()
    server.server_close()


@NEEDS_BROWSER
@pytest.mark.parametrize('half_read', ['part-0', 'plotly'])
def test_page_waits_for_the_rest_of_what_is_half_read(result, half_read):
    source = (result[1] / 'report.html').read_bytes()
    place = source.index(b'</script>', source.index(f'id="{half_read}"'.encode())) - 100
    with slowly_served(source, place) as url, opened_page(f'{url}#tracks', '404') as page:
        page.evaluate('openTrack(0)')
        page.wait_for_function('view.part')
        show_charts(page)


@NEEDS_BROWSER
def test_list_sorts_and_filters_and_shows_tags_as_text(result):
    with opened_page((result[1] / 'report.html').as_uri() + '#tracks') as page:
        tracks = page.locator('#rows tr[data-track]')
        assert tracks.count() == 2
        page.click('[data-sort=id]')
        assert [tracks.nth(i).locator('td').nth(1).inner_text() for i in range(2)] == ['1', '2']
        page.click('[data-sort=id]')
        assert tracks.first.locator('td').nth(1).inner_text() == '2'
        assert tracks.first.locator('td').nth(2).inner_text() == SCRIPT
        page.select_option('#f-class', '=' + SCRIPT)
        assert tracks.count() == 1
        page.click('#f-clear')
        assert tracks.count() == 2
        for column in page.locator('#rows th button').all():
            assert column.get_attribute('title')
        why = page.evaluate('causesOf(DATA.tracks[0])[0]')
        page.select_option('#f-reason', why)
        assert page.evaluate('view.shown.length') >= 1
        page.click('#f-clear')
        page.fill('#f-text', 'nothing')
        assert tracks.count() == 0
        assert page.inner_text('#f-count') == '0 of 2 tracks'


@NEEDS_BROWSER
def test_slider_keys_and_links_step_through_a_track(result):
    url = (result[1] / 'report.html').as_uri()
    table = BoxTable.read(result[1] / 'boxes.csv')
    stamp = [s for s, name in zip(table.stamps_ns, table.track_ids, strict=True) if name == '2'][5]
    with opened_page(f'{url}#track=2&stamp={stamp}') as page:
        row = lambda: page.evaluate('view.row')  # noqa: E731
        assert row() == 5
        page.keyboard.press('ArrowRight')
        assert row() == 6
        page.keyboard.press('End')
        assert row() == 13
        page.fill('#time', '3')
        assert row() == 3
        before = page.evaluate("document.getElementById('top').toDataURL()")
        page.keyboard.press('Shift+ArrowRight')
        assert row() == 13
        assert page.evaluate("document.getElementById('top').toDataURL()") != before
        page.wait_for_function("location.hash.includes('stamp=') && view.part")
        show_charts(page)
        page.keyboard.press('ArrowDown')
        press(page, 'ArrowUp', 'view.part !== null')
        for mode in ('after', 'before', 'sweep'):
            page.keyboard.press('m')
            assert page.input_value('#mode') == mode
        page.click('#tab-tracks')
        page.keyboard.press(' ')
        assert page.evaluate('view.isPlaying')
        page.keyboard.press(' ')
        page.keyboard.press('+')
        assert page.evaluate('view.zoom') == 1.25
        page.keyboard.press('-')
        page.evaluate('view.part.usable[4] = null; step(4, true)')
        assert page.inner_text('#legend') == 'no valid box at this stamp'
        assert page.locator('#space canvas').count() > 0


CHART = "$('charts').data?.[0].x.length && [view.charts, $('charts').data[0].y]"
"""Whether the charts are of the open track, and the risk of each box of theirs."""


@NEEDS_BROWSER
def test_charts_are_those_of_the_open_track_once_they_are_seen(result):
    with opened_page((result[1] / 'report.html').as_uri() + '#track=2') as page:

        def open_next(key):
            before = page.evaluate('view.open.id')
            press(page, key, f'view.open.id !== {before!r} && view.part')
            page.evaluate('painted().then(painted)')  # what is in view is known by then
            return page.evaluate('view.part.risk')

        open_next('ArrowDown')
        first = open_next('ArrowUp')
        assert page.evaluate('plotly === undefined')  # a second of the start of each page
        page.locator('#charts').scroll_into_view_if_needed()
        page.wait_for_selector('#charts svg.main-svg')
        assert page.evaluate(CHART) == [True, first]
        page.wait_for_function("!$('cursor').hidden")
        second = open_next('ArrowDown')
        assert second != first
        page.wait_for_function('view.charts')
        assert page.evaluate(CHART) == [True, second]
        page.locator('#title').scroll_into_view_if_needed()
        open_next('ArrowUp')
        assert page.evaluate(CHART) == [False, second]
        show_charts(page)
        assert page.evaluate(CHART) == [True, first]


@NEEDS_BROWSER
def test_what_is_printed_has_its_charts_though_nobody_has_seen_them(result):
    url = (result[1] / 'report.html').as_uri() + '#track=1'
    small = {'viewport': {'width': 390, 'height': 400}, 'color_scheme': 'dark'}
    with opened_page(url, **small) as page:
        page.evaluate('painted().then(painted)')
        assert page.evaluate('plotly === undefined')
        for tab, plot in (('tracks', 'charts'), ('overview', 'map')):
            page.click(f'#tab-{tab}')
            page.evaluate(
                f"window.print = () => {{ onPaper = '{plot}:' + $('{plot}').childElementCount; }}"
            )
            page.keyboard.press('Control+p')
            page.wait_for_function(f"window.onPaper === '{plot}:1'")
        text = "$('map')._fullLayout.font.color"
        dark = page.evaluate(text)
        page.emulate_media(media='print')
        page.wait_for_function(f'{text} !== {dark!r}')


@NEEDS_BROWSER
@pytest.mark.parametrize('scheme', ['light', 'dark'])
def test_narrow_page_does_not_overflow(result, scheme):
    narrow = {'viewport': {'width': 390, 'height': 844}, 'color_scheme': scheme}
    with opened_page((result[1] / 'report.html').as_uri(), **narrow) as page:
        page.locator('#map').scroll_into_view_if_needed()
        page.wait_for_selector('#map .main-svg')
        for tab in ('tracks', 'run', 'overview'):
            page.click(f'#tab-{tab}')
            overflow = 'document.documentElement.scrollWidth - innerWidth'
            assert page.evaluate(overflow) <= 0
        background = 'getComputedStyle(document.body).backgroundColor'
        assert (page.evaluate(background) == 'rgb(255, 255, 255)') == (scheme == 'light')
        page.emulate_media(media='print')
        assert page.evaluate(overflow) <= 0
        assert page.locator('.tabs').is_hidden()
        assert page.locator('#quality').is_visible()
        assert page.evaluate(background) == 'rgb(255, 255, 255)'  # as the paper


@NEEDS_BROWSER
def test_decisions_and_a_pin_are_made_by_keys_and_the_mouse(server):
    with opened_page(server.address + '#track=1') as page:
        press(page, '?', "$('help').open")
        sizes = "[$('help').scrollTop, $('help').scrollHeight > $('help').clientHeight]"
        assert page.evaluate(sizes) == [0, True]  # the first keys are in view
        page.keyboard.press('Escape')
        page.keyboard.press('a')
        page.wait_for_selector('[data-do=accept][aria-pressed=true]')
        page.keyboard.press('r')
        page.wait_for_selector('[data-do=reject][aria-pressed=true]')
        page.keyboard.press('z')
        page.wait_for_selector('[data-do=accept][aria-pressed=true]')
        page.fill('#comment', SCRIPT)
        press(page, 'Enter', 'judgementOf(current())?.comment')
        page.evaluate('step(6)')
        page.keyboard.press('e')
        before = page.evaluate('view.edit.slice()')
        for _ in range(10):
            page.keyboard.press('l')  # 0.2 m longer
        bounds = page.locator('#side').bounding_box()
        middle = bounds['x'] + bounds['width'] / 2, bounds['y'] + bounds['height'] / 2
        page.mouse.move(*middle)
        page.mouse.down()
        page.mouse.move(middle[0], middle[1] - 10, steps=4)  # up
        page.mouse.up()
        # A correction that is not saved is not left by mistake.
        page.fill('#time', '2')
        page.evaluate('openTrack(1 - view.track)')
        assert page.evaluate('[view.row, view.edit !== null]') == [6, True]
        assert 'not saved' in page.inner_text('#failure')
        page.locator('#top').focus()
        page.keyboard.press('Enter')
        page.wait_for_selector('[data-do=unpin]')
    out = server.log_paths[0].parent
    with open(out / DECISIONS, newline='', encoding='utf-8') as file:
        assert file.readline() == '# boxreg decisions 2\n'
        rows = list(csv.DictReader(file))
    assert [row['decision'] for row in rows] == ['accept', 'reject', 'accept', 'accept', 'pin']
    assert rows[3]['comment'] == SCRIPT
    (pin,) = [one for one in read_decisions(out / DECISIONS) if one.kind == 'pin']
    assert pin.box[3] == pytest.approx(before[3] + 0.2)
    table = BoxTable.read(out / 'boxes.csv')
    row = [i for i, name in enumerate(table.track_ids) if name == '1'][6]
    assert pin.stamp_ns == table.stamps_ns[row]
    assert 0.02 < pin.box[2] - table.boxes[row, 2] < 0.5


@NEEDS_BROWSER
def test_a_box_is_decided_about_and_commented_on_beside_its_track(server):
    with opened_page(server.address + '#track=1') as page:
        page.keyboard.press('a')
        page.wait_for_selector('[data-do=accept][aria-pressed=true]')
        page.keyboard.press('Shift+U')
        page.wait_for_selector('[data-do=unsure-box][aria-pressed=true]')
        page.keyboard.press('Shift+C')
        page.keyboard.type('hidden')
        press(page, 'Enter', 'judgementOfBox()?.comment')
        assert page.locator('[data-do=accept][aria-pressed=true]').count() == 1
        selected = page.locator('#rows tr[aria-selected=true] .decision')
        assert selected.inner_text() == 'accept, 1 box'
        stamp = int(page.evaluate('view.part.stamps[view.row]'))
        press(page, 'Shift+R', "judgementOfBox().decision === 'reject'")
        press(page, 'u', "judgementOf(current()).decision === 'unsure'")
        press(page, 'a', "$('notice').textContent.includes('of their own: 1 rejected')")
    made = read_decisions(server.log_paths[0])
    assert [(one.stamp_ns, one.kind, one.comment) for one in made] == [
        (None, 'accept', ''),
        (stamp, 'unsure', ''),
        (stamp, 'unsure', 'hidden'),
        (stamp, 'reject', 'hidden'),
        (None, 'unsure', ''),
        (None, 'accept', ''),
    ]


@NEEDS_BROWSER
def test_decisions_can_be_listed_and_undone_from_another_track(server):
    with opened_page(server.address + '#tracks') as page:
        first, second = page.evaluate('DATA.tracks.map(track => track.id)')
        page.keyboard.press('c')
        page.keyboard.type('look')
        press(page, 'Enter', 'log.held.size === 1')
        cells = page.locator('#rows .decision')
        assert cells.all_inner_texts() == ['comment', '']
        page.select_option('#f-decision', 'open')
        assert page.inner_text('#f-count') == '1 of 2 tracks, 1 decided'
        # The list has lost the open track: the next one is that which took its place.
        page.locator('#top').focus()
        press(page, 'ArrowDown', f"current().id === '{second}'")
        press(page, 'z', f"current().id === '{first}'")
        assert page.evaluate('log.held.size') == 0
        # The event of the first decision may come after the answer to the second.
        page.evaluate('receive({ first: 0, rows: log.rows.slice(0, 1) })')
        assert page.evaluate('[log.count, log.held.size]') == [2, 0]
        page.click('#f-clear')


@NEEDS_BROWSER
def test_lost_server_is_said_and_nothing_counts_as_saved(server):
    with opened_page(server.address + '#track=1', expected='500') as page:
        page.route('**/decisions', lambda route: route.fulfill(status=500, body='disk full'))
        page.evaluate("judge('accept', false)")
        page.wait_for_selector('#failure:not([hidden])')
        assert 'disk full' in page.inner_text('#failure')
        assert page.evaluate('log.held.size') == 0
        page.unroute('**/decisions')
