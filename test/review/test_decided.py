"""What a person has decided binds the steps that complete tracks, and those that follow them."""

import csv
from dataclasses import replace
import json
from pathlib import Path
import shutil

from boxreg_ros.cli import main
from boxreg_ros.config import Config
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.covariance_table import COVARIANCES, read_covariances
from boxreg_ros.io.velocity_table import read_velocities, VELOCITIES
from boxreg_ros.labels import frames_of
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.review_command import drive_of
from boxreg_ros.review.changes import Changes
from boxreg_ros.review.decisions import APPLIED, Decision, DecisionLog, DECISIONS, read_decisions
from boxreg_ros.review.server import review_server
from boxreg_ros.structures import BoxArray, kept
from browser import answer, NEEDS_BROWSER, open_box, opened_page, press, serving, show_charts
import numpy as np
import pytest
from relabel_results import rows_in
from ros_messages import Drive

SWEEPS = 16
SETTINGS = ('solver.rounds=2', 'sampling.points=64', 'window=6', 'max_gap=0.5')
QUICK = ['--formats=csv', *(f'--set={setting}' for setting in SETTINGS)]
GAP = (4, 5, 6)  # sweeps without a box of the moving car


def spoiled():
    """Return a drive with a gap in track 2, no end of track 1, and a ghost of three boxes."""
    drive = Drive(sweeps=SWEEPS)
    for k in GAP:
        drive.replace('/boxes', k, lambda message: message.detections.pop(1))
    for k in range(SWEEPS - 3, SWEEPS):
        drive.replace('/boxes', k, lambda message: message.detections.pop(0))
    for k in (8, 9):
        drive.add_ghost(k)
    return drive


class Run:
    """A recording, and the result of relabelling it with some decisions."""

    def __init__(self, recording, *options):
        self._recording = recording
        self._options = options

    def __call__(self, out, decisions=()):
        command = ['relabel', str(self._recording), '-o', str(out), *self._options, *QUICK]
        if decisions:
            path = out.with_name(f'{out.name}_{DECISIONS}')
            DecisionLog(path).append(decisions)
            command += ['--decisions', str(path)]
        self.status = main(command)
        rows = rows_in(out / 'boxes.csv')
        return {(row['track_id'], int(row['stamp_ns'])): row for row in rows}


def words_of(rows, track_id, stamps):
    """Return the status of a track at each sweep, '' where it has no box."""
    return [rows.get((track_id, stamp), {'status': ''})['status'] for stamp in stamps]


def known_of(out):
    """Return id and stamp of the boxes with a covariance, and of those with a velocity."""
    tables = read_covariances(out / COVARIANCES), read_velocities(out / VELOCITIES)
    return tuple({(name, stamp) for stamp, name in table} for table in tables)


@pytest.fixture(scope='module')
def completed(tmp_path_factory):
    """Return a run with --complete, its stamps, and its result without decisions."""
    folder = tmp_path_factory.mktemp('completed')
    drive = spoiled()
    recording = drive.write(folder / 'drive')
    before = Run(recording, '--complete', '--report')(folder / 'out')
    return Run(recording, '--complete'), drive.stamps, before, folder / 'out'


def test_without_decisions_the_steps_do_all_of_this(completed):
    _, stamps, rows, out = completed
    assert [words_of(rows, '2', stamps)[k] for k in GAP] == ['interpolated'] * 3
    assert words_of(rows, '1', stamps)[-3:] == ['extended'] * 3
    assert words_of(rows, '9', stamps)[8:10] == ['rejected'] * 2
    with_estimate = {key for key, row in rows.items() if row['status'] != 'rejected'}
    assert known_of(out) == (with_estimate, with_estimate)


def test_rejected_boxes_are_no_labels(completed, capsys):
    """Neither rules nor the figures of all tracks see them."""
    _, stamps, rows, out = completed
    capsys.readouterr()
    main(['check', str(out), '--json'])
    found = json.loads(capsys.readouterr().out)
    assert (found['tracks'], found['boxes']) == (2, len(rows) - 2)
    summary = json.loads((out / 'summary.json').read_text())
    flash = {name: of_run['after'] for name, of_run in rules_of(summary).items()}
    violations = {name: len(rule['violations']) for name, rule in found['rules'].items()}
    assert flash == {name: violations[name] for name in flash}
    changes = Changes('odom')
    given = BoxArray(stamps[0], 'odom', ('1', '9'), ('car',) * 2, np.ones(2), np.ones((2, 9)))
    result = kept(given, '')
    changes.add(given, replace(result, status=('kept', 'rejected')))
    labels = {track.track_id: track.labels for track in changes.tracks()}
    assert np.isfinite(labels['1']).all()
    assert np.isnan(labels['9']).all()


def rules_of(summary):
    """Return the number of violations of each rule, before and after."""
    names = summary['rules']['before'].keys() | summary['rules']['after'].keys()
    return {
        name: {when: summary['rules'][when].get(name, 0) for when in ('before', 'after')}
        for name in names
    }


def test_decisions_bind_the_steps_of_complete(completed, tmp_path, capsys):
    run, stamps, before, out = completed
    table = BoxTable.read(out / 'boxes.csv')
    keys = zip(table.track_ids, table.stamps_ns.tolist(), strict=True)
    pin = table.boxes[list(keys).index(('2', stamps[5]))] + [0.3, 0.2, 0, 0, 0, 0, 0, 0, 0]
    decisions = [
        Decision('2', stamps[10], 'rename', end_ns=stamps[-1], value='2_2'),
        Decision('2', stamps[1], 'reclass', end_ns=stamps[2], value='truck'),
        Decision('2', stamps[4], 'delete', end_ns=stamps[5]),  # added in the gap
        Decision('2', stamps[5], 'pin', '', table.frame_id, pin),  # likewise
        Decision('1', stamps[3], 'delete', end_ns=stamps[5]),  # inside of the track
        Decision('1', stamps[14], 'delete', end_ns=stamps[15]),  # added at its end
        Decision('9', None, 'accept'),
    ]
    rows = run(tmp_path / 'out', decisions)
    assert run.status == 0, capsys.readouterr().err
    words = words_of(rows, '2', stamps)
    assert words[4:7] == ['', 'human', 'interpolated']
    assert words[10:] == [''] * 6
    assert '' not in words_of(rows, '2_2', stamps)[10:]
    assert words_of(rows, '2_2', stamps)[:10] == [''] * 10
    corrected = rows['2', stamps[5]]
    found = [float(corrected[name]) for name in ('x', 'y', 'z', 'length', 'width', 'height')]
    np.testing.assert_allclose(found, pin[:6], atol=1e-6)
    classes = [rows['2', stamp]['class_name'] for stamp in stamps[:4]]
    assert classes == ['car', 'truck', 'truck', 'car']
    assert words_of(rows, '1', stamps)[3:6] == ['rejected'] * 3  # the boxes of the input
    assert words_of(rows, '1', stamps)[13:] == ['extended', '', '']
    assert set(words_of(rows, '9', stamps)[8:10]) <= {'refined', 'kept'}
    others = {key for key in rows if rows[key]['status'] != 'rejected'}
    assert len(others) == len([k for k in before if before[k]['status'] != 'rejected']) - 1 - 3


def test_a_deleted_end_is_not_extended_again(completed, tmp_path):
    run, stamps, _, _ = completed
    rows = run(tmp_path / 'out', [Decision('2', stamps[13], 'delete', end_ns=stamps[15])])
    assert words_of(rows, '2', stamps)[13:] == ['rejected'] * 3
    assert sum(name == '2' for name, _ in rows) == SWEEPS
    # A stretch that is deleted, longer than `max_gap`, leaves one track.
    rows = run(tmp_path / 'middle', [Decision('2', stamps[7], 'delete', end_ns=stamps[12])])
    assert {name for name, _ in rows} == {'1', '2', '9'}
    assert 'rejected' not in words_of(rows, '2', stamps)[13:]


def test_rejected_boxes_that_the_run_added_are_left_out(completed, tmp_path):
    run, stamps, before, _ = completed
    decisions = [Decision('2', stamps[GAP[1]], 'reject'), Decision('1', None, 'reject')]
    rows = run(tmp_path / 'out', decisions)
    assert [words_of(rows, '2', stamps)[k] for k in GAP] == ['interpolated', '', 'interpolated']
    words = words_of(rows, '1', stamps)
    of_input = {'refined': 'kept', 'kept': 'kept'}
    assert words == [of_input.get(word, '') for word in words_of(before, '1', stamps)]
    with_covariance, with_velocity = known_of(tmp_path / 'out')
    assert {name for name, _ in with_covariance} == {name for name, _ in with_velocity} == {'2'}


def test_joined_tracks_stay_one_however_long_the_pause(completed, tmp_path, capsys):
    run, stamps, _, _ = completed
    decisions = [
        Decision('2', stamps[3], 'delete', end_ns=stamps[11]),
        Decision('2', stamps[12], 'rename', end_ns=stamps[15], value='new'),
        Decision('2', stamps[0], 'rename', end_ns=stamps[2], value='new'),
        Decision('nobody', None, 'delete'),
    ]
    rows = run(tmp_path / 'out', decisions)
    assert run.status == 1
    (line,) = [row for row in capsys.readouterr().err.splitlines() if 'decisions' in row]
    assert "got 1 that could not be used: 'nobody'; the results are kept" in line
    words = words_of(rows, 'new', stamps)
    assert '' not in [*words[:3], *words[12:]]
    assert words[3:12] == [''] * 9
    assert {name for name, _ in rows} == {'1', '2', 'new', '9'}
    assert set(words_of(rows, '2', stamps)) == {'', 'rejected'}


@pytest.fixture(scope='module')
def followed(tmp_path_factory):
    """Return a run with --keyframes, its stamps, and its result without decisions."""
    folder = tmp_path_factory.mktemp('followed')
    drive = Drive(sweeps=13)
    for k in range(13):
        if k % 4:
            drive.replace('/boxes', k, lambda message: message.detections.clear())
    recording = drive.write(folder / 'drive')
    before = Run(recording, '--keyframes', '--report')(folder / 'out')
    assert '' not in words_of(before, '2', drive.stamps)
    return Run(recording, '--keyframes'), drive.stamps, folder / 'out'


def corrected_by_file(followed, folder):
    """Split, delete and correct by a file; return the rows that are written and the pinned box."""
    run, stamps, out = followed
    table = BoxTable.read(out / 'boxes.csv')
    keys = zip(table.track_ids, table.stamps_ns.tolist(), strict=True)
    pin = table.boxes[list(keys).index(('1', stamps[6]))] + [0.2, 0, 0, 0, 0, 0, 0, 0, 0]
    decisions = [
        Decision('2', stamps[6], 'rename', end_ns=stamps[-1], value='2_2'),
        Decision('1', stamps[2], 'pin', '', table.frame_id, pin),
        Decision('1', stamps[2], 'delete'),
        Decision('1', stamps[6], 'pin', '', table.frame_id, pin),
        Decision('1', stamps[0], 'reclass', value='truck'),
        Decision('1', stamps[9], 'rename', end_ns=stamps[10], value='x'),  # added by the run
    ]
    rows = run(folder / 'after', decisions)
    assert run.status == 0
    classes = [row['class_name'] for (track_id, _), row in rows.items() if track_id == '1']
    assert classes == ['truck'] + ['car'] * 9
    warning = json.loads((folder / 'after' / 'summary.json').read_text())['warning']
    assert "was given to 'x', which has no box there" in warning
    return rows, pin


def corrected_by_page(followed, folder):
    """Do the same in the page."""
    out = shutil.copytree(followed[2], folder / 'out')
    with (
        serving(review_server([(out, drive_of(out))], 0, 'anna')) as server,
        opened_page(server.address + '#track=2') as page,
    ):
        open_box(page, '2', 6)
        press(page, 's', "current().id === '2_2'")
        open_box(page, '1', 2)
        press(page, 'Shift+D', 'current().deleted === 1')
        open_box(page, '1', 6)
        page.keyboard.press('e')
        page.keyboard.press('Shift+ArrowRight')
        page.keyboard.press('Shift+ArrowRight')
        pin = page.evaluate('moved(view.edit, view.part.origin, 1)')
        press(page, 'Enter', 'pinOf(view.row) !== null')
        press(page, 'Control+s', "$('notice').textContent.includes('boxes in')")
        assert page.locator('#failure').is_hidden()
    rows = rows_in(folder / 'out.corrected' / 'boxes.csv')
    return {(row['track_id'], int(row['stamp_ns'])): row for row in rows}, pin


@pytest.mark.parametrize(
    'corrected', [corrected_by_file, pytest.param(corrected_by_page, marks=NEEDS_BROWSER)]
)
def test_halves_of_a_split_are_not_followed_into_each_other(
    followed, tmp_path, quick_python, corrected
):
    """Boxes between keyframes that are deleted stay away; a corrected one is a new keyframe."""
    stamps = followed[1]
    rows, pin = corrected(followed, tmp_path)
    first = words_of(rows, '2', stamps)
    assert '' not in first[:5]
    assert first[6:] == [''] * 7
    second = words_of(rows, '2_2', stamps)
    assert second[:6] == [''] * 6
    assert '' not in second[8:]
    words = words_of(rows, '1', stamps)
    assert (words[2], words[6]) == ('', 'human')
    found = [float(rows['1', stamps[6]][name]) for name in ('x', 'y', 'z')]
    np.testing.assert_allclose(found, pin[:3], atol=1e-6)


def accept_a_mistake(page):
    """Accept a track that the run has rejected: it is no label until then."""
    page.select_option('#f-status', 'rejected: look for mistakes')
    assert page.evaluate('view.shown.map(track => track.id)') == ['9']
    assert page.evaluate('view.sort') == 'near'
    page.evaluate('openTrack(view.shown[0].index)')
    page.wait_for_function("view.part && current().id === '9'")
    pale = "scene.boxes.find(one => one.track.id === '9').isGone"
    page.evaluate('showScene(8, true)')
    page.wait_for_function('scene.sweep && scene.at === 8')
    assert page.evaluate(pale)
    press(page, 'a', "judgementOf(current())?.decision === 'accept'")
    page.evaluate('showScene(8, true)')
    page.wait_for_function(f'!{pale}')
    page.click('#f-clear')


def delete_and_join(page):
    """Delete a stretch of a track, split it, and join its halves again."""
    open_box(page, '1', 3)
    page.keyboard.press('b')
    page.evaluate('step(5)')
    press(page, 'Shift+D', 'current().deleted === 3')
    open_box(page, '1', 8)
    press(page, 's', "current().id === '1_2'")
    open_box(page, '1', 0)
    page.keyboard.press('j')
    answer(page, '1_2')
    page.wait_for_function("!TRACKS.some(track => track.id === '1_2')")


@NEEDS_BROWSER
def test_decisions_of_the_page_are_all_in_the_labels_that_it_writes(
    completed, tmp_path, quick_python
):
    """Also about boxes that the run has added; what cannot be used is an error in the page."""
    _, stamps, _, made = completed
    out = shutil.copytree(made, tmp_path / 'out')
    with (
        serving(review_server([(out, drive_of(out))], 0, 'anna')) as server,
        opened_page(server.address + '#track=2') as page,
    ):
        accept_a_mistake(page)
        delete_and_join(page)
        open_box(page, '1', 15)  # added at the end
        press(page, 'Shift+D', 'current().deleted === 4')
        open_box(page, '2', 4)  # added in the gap
        press(page, 'Shift+D', 'current().deleted === 1')
        open_box(page, '2', 5)
        press(page, 'Shift+D', 'current().deleted === 2')
        page.keyboard.press('e')  # set by hand, it is there again
        page.keyboard.press('ArrowUp')
        corrected = page.evaluate('moved(view.edit, view.part.origin, 1)')
        press(page, 'Enter', 'pinOf(view.row) !== null && current().deleted === 1')
        open_box(page, '2', 1)
        page.keyboard.press('b')
        page.evaluate('step(2)')
        page.keyboard.press('k')
        answer(page, 'truck')
        page.wait_for_function('log.made.length === 9')
        open_box(page, '2', 10)
        press(page, 's', "current().id === '2_2'")
        open_box(page, '2_2', 4)
        page.keyboard.press('b')
        page.evaluate('step(5)')
        press(page, 'Shift+D', 'current().deleted === 2')  # the end of its input
        show_charts(page)
        DecisionLog(out / DECISIONS).append([Decision('nobody', None, 'delete')])
        page.keyboard.press('Control+s')
        page.wait_for_selector('#failure:not([hidden])')
        assert "could not be used: 'nobody'" in page.inner_text('#failure')
        assert 'boxes in' in page.inner_text('#notice')
    rows = rows_in(tmp_path / 'out.corrected' / 'boxes.csv')
    rows = {(row['track_id'], int(row['stamp_ns'])): row for row in rows}
    words = words_of(rows, '2', stamps)
    assert words[4:7] == ['', 'human', 'interpolated']
    found = [float(rows['2', stamps[5]][name]) for name in ('x', 'y', 'z')]
    np.testing.assert_allclose(found, corrected[:3], atol=1e-6)
    assert words[10:] == [''] * 6
    second = words_of(rows, '2_2', stamps)[10:]
    assert '' not in second[:4]
    assert second[4:] == ['rejected'] * 2
    words = words_of(rows, '1', stamps)
    assert words[3:6] == ['rejected'] * 3
    assert words[13:] == ['extended', 'extended', '']
    assert {name for name, _ in rows} == {'1', '2', '2_2', '9'}
    assert set(words_of(rows, '9', stamps)[8:10]) <= {'refined', 'kept'}
    classes = [rows['2', stamp]['class_name'] for stamp in stamps[:4]]
    assert classes == ['car', 'truck', 'truck', 'car']


def attributes_in(out):
    """Return the attributes of each box of a result, by track and stamp."""
    found = {}
    for row in rows_in(out / 'attributes.csv'):
        key = row['track_id'], int(row['stamp_ns'])
        found.setdefault(key, {})[row['name']] = row['value']
    return found


def test_attributes_bind_every_box_and_reach_the_formats(completed, tmp_path):
    run, stamps, _, _ = completed
    decisions = [
        Decision('1', None, 'attribute', value='parked=true'),
        Decision('2', stamps[3], 'attribute', end_ns=stamps[9], value='occluded=partly'),
        Decision('2', stamps[5], 'attribute', value='occluded=true'),
        Decision('2', None, 'attribute', value='night=true'),
        Decision('2', None, 'attribute', value='night='),  # taken back
        Decision('2', stamps[10], 'rename', end_ns=stamps[-1], value='2_2'),
    ]
    out = tmp_path / 'out'
    rows = run(out, decisions)
    found = attributes_in(out)
    of_one = [found[key]['parked'] for key in rows if key[0] == '1']
    assert of_one == ['true'] * SWEEPS  # the last three are extended
    of_two = [found.get(('2', stamp), {}) for stamp in stamps[:10]]
    assert of_two == [{}] * 3 + [
        {'occluded': 'true' if k == 5 else 'partly'} for k in range(3, 10)
    ]  # three of them are interpolated
    assert not any(key[0] == '2_2' for key in found)
    convert = ['convert', str(out), '--from', 'csv', '--to', 'openlabel', '-o']
    assert main([*convert, str(tmp_path / 'labels')]) == 0
    frames = frames_of('openlabel', tmp_path / 'labels' / 'openlabel')
    assert {
        (name, frame.refined.boxes.stamp_ns): dict(own)
        for frame in frames
        for name, own in zip(*of_boxes(frame.refined.boxes), strict=True)
        if own
    } == found  # fmt: skip


def of_boxes(boxes):
    return boxes.track_ids, boxes.attributes or ({},) * len(boxes.track_ids)


def test_attributes_of_label_files_pass_a_run(completed, tmp_path):
    """An added box has those of the box before it; a deleted one keeps its own."""
    _, stamps, _, out = completed
    labels = tmp_path / 'labels'
    shutil.copytree(out, labels)
    table = rows_in(labels / 'boxes.csv')
    keyframes = [row for row in table if row['track_id'] == '2' and row['status'] == 'refined']
    with (labels / 'boxes.csv').open('w', newline='') as file:
        writer = csv.DictWriter(file, table[0].keys())
        writer.writeheader()
        writer.writerows(keyframes)
    lines = [f'{row["stamp_ns"]},2,colour,red' for row in keyframes[:4]]
    (labels / 'attributes.csv').write_text('\n'.join(['stamp_ns,track_id,name,value', *lines]))
    recording = out.parent / 'drive'
    decisions = [
        Decision('2', stamps[1], 'delete'), Decision('2', stamps[2], 'remove', value='colour'),
    ]  # fmt: skip
    again = Run(recording, '--complete', f'--labels=csv:{labels}')(tmp_path / 'out', decisions)
    assert words_of(again, '2', stamps)[1] == 'rejected'
    found = attributes_in(tmp_path / 'out')
    assert [words_of(again, '2', stamps)[k] for k in GAP] == ['interpolated'] * 3
    assert [found.get(('2', stamp), {}).get('colour', '') for stamp in stamps] == [
        'red' if k < 7 and k != 2 else '' for k in range(SWEEPS)
    ]


@NEEDS_BROWSER
def test_attributes_are_set_in_the_page(completed, tmp_path):
    _, stamps, _, out = completed
    out = shutil.copytree(out, tmp_path / 'out')
    with (
        serving(review_server([(out, drive_of(out))], 0, 'anna')) as server,
        opened_page(server.address) as page,
    ):
        open_box(page, '1', 2)
        page.keyboard.press('x')
        page.wait_for_selector('#ask[open]')
        assert '4 parked' in page.inner_text('#ask-proposals')
        press(page, '4', "attributesAt(15).parked === 'true'")
        page.wait_for_function("$('clock').textContent.includes('parked')")
        press(page, 'b', 'view.mark === 2')
        page.evaluate('step(4)')
        page.keyboard.press('x')
        answer(page, 'weather=rain')
        page.wait_for_function("attributesAt(3).weather === 'rain' && view.mark === null")
        assert page.evaluate('[attributesAt(1), attributesAt(5)]') == [{'parked': 'true'}] * 2
        page.keyboard.press('x')
        page.wait_for_selector('#ask[open]')
        assert '4 not parked' in page.inner_text('#ask-proposals')
        page.keyboard.press('Escape')
        press(page, 'z', 'attributesAt(3).weather === undefined')
        press(page, 'y', "attributesAt(3).weather === 'rain'")
        page.keyboard.press('x')
        answer(page, 'parked=')
        page.wait_for_function('attributesAt(3).parked === undefined')
        press(page, 'z', "attributesAt(3).parked === 'true'")
    found = [(one.stamp_ns, one.end_ns, one.value) for one in read_decisions(out / DECISIONS)]
    assert found[:2] == [(None, None, 'parked=true'), (stamps[2], stamps[4], 'weather=rain')]


@pytest.mark.parametrize(
    ('options', 'last'), [((), '--complete'), (('--complete',), '--keyframes')]
)
def test_decisions_bind_later_runs_on_the_result(completed, tmp_path, capsys, options, last):
    """
    A split stays one, classes are not outvoted, accepted tracks not rejected, however often.

    Boxes that were deleted, also those that a run has added, are not added again; nor are those
    that a run has added and a person has rejected.

    """
    _, stamps, _, out = completed
    recording = out.with_name('drive')
    decisions = [
        Decision('2', stamps[10], 'rename', end_ns=stamps[-1], value='2_2'),
        Decision('2', stamps[1], 'reclass', end_ns=stamps[2], value='truck'),
        Decision('9', None, 'accept'),
        Decision('1', stamps[3], 'reject'),
        Decision('2', stamps[GAP[1]], 'delete'),
        Decision('2', stamps[GAP[2]], 'reject'),
        Decision('2', stamps[12], 'delete'),
        Decision('1', stamps[SWEEPS - 3], 'delete'),
    ]
    rows = Run(recording, *options)(tmp_path / '0', decisions)
    as_rejected = rows['1', stamps[3]]
    for k in (1, 2):
        labels = f'csv:{tmp_path / str(k - 1)}'
        run = Run(recording, '--labels', labels, *(options if k == 1 else [last]))
        rows = run(tmp_path / str(k))
        assert run.status == 0, capsys.readouterr().err
        is_known = {(name, row['status'] != 'rejected') for (name, _), row in rows.items()}
        assert is_known == {('1', True), ('2', True), ('2_2', True), ('9', True)}
        keys = [('2_2' if k >= 10 else '2', stamps[k]) for k in range(SWEEPS)]
        found = {key: row['class_name'] for key, row in rows.items() if key[0] in ('2', '2_2')}
        classes = dict(zip(keys, ['car', 'truck', 'truck'] + ['car'] * 13, strict=True))
        gone = {keys[12], *(keys[j] for j in (GAP if k == 1 and not options else GAP[1:]))}
        assert found == {key: classes[key] for key in keys if key not in gone}
        assert words_of(rows, '1', stamps)[-3] == ''
        words = [str(cell)[:9] for cell in rows['1', stamps[3]].values()]
        assert words == [str(cell)[:9] for cell in as_rejected.values()]
    table = BoxTable.read(tmp_path / '2' / 'boxes.csv')
    names = tuple('bus' if name == 'truck' else name for name in table.class_names)
    replace(table, class_names=names).write(tmp_path / '2' / 'boxes.csv')  # by hand, afterwards
    rows = Run(recording, '--labels', f'csv:{tmp_path / "2"}', '--complete')(tmp_path / 'edited')
    assert [rows['2', stamps[k]]['class_name'] for k in range(3)] == ['car', 'bus', 'bus']
    command = ['relabel', str(recording), '-o', str(tmp_path / 'x'), '--labels', labels]
    for option in ('--associate', '--boxes-offset=0.1'):
        assert main([*command, option, *QUICK]) == 2
        assert 'without --associate and --boxes-offset' in capsys.readouterr().err
    main(['convert', str(tmp_path / '2'), '-o', str(tmp_path / '3'), '--from=csv', '--to=csv'])
    assert read_decisions(tmp_path / '3' / APPLIED) == read_decisions(tmp_path / '2' / APPLIED)
    other = tmp_path / '3' / 'openlabel'
    main(['convert', str(other.parent), '-o', f'{other}x', '--from=csv', '--to=openlabel'])
    assert f'use --labels csv:{other.parent} for these' in capsys.readouterr().out
    Path(f'{other}x', 'openlabel').rename(other)
    capsys.readouterr()
    Run(recording, '--labels', f'openlabel:{other}', '--complete')(tmp_path / '4')
    assert f'--labels csv:{tmp_path / "3"}, or' in capsys.readouterr().err
    request = Request((recording,), labels=('openlabel', other))
    assert 'a person rejected are refined again' in request.unbound_text()
    assert not request.unbound_text(refines=False)
    decided = tmp_path / '0'
    (decided / APPLIED).unlink()  # as of a run that has deleted boxes alone
    requests = [
        Request(
            (recording,), labels=labels, config=Config.from_dict({'complete': {'fill': fills}})
        )
        for labels in (('csv', decided), ('openlabel', decided / 'openlabel'))
        for fills in (False, True)
    ]
    texts = [request.unbound_text() for request in requests]
    assert not any(texts[:3]) and 'deleted boxes be added again' in texts[3]
    DecisionLog(decided / DECISIONS).append([Decision('2', stamps[4], 'delete')])
    newer = f'do not have all decisions of {decided / DECISIONS}'
    assert all(newer in request.unbound_text() for request in requests)


def test_ranges_end_in_later_runs_where_a_person_ended_them(completed, tmp_path):
    """A class reaches the box that is added within its range, an attribute none beyond."""
    _, stamps, _, out = completed
    recording = out.with_name('drive')
    decisions = [
        Decision('2', stamps[1], 'reclass', end_ns=stamps[GAP[0]], value='truck'),
        Decision('2', stamps[1], 'attribute', end_ns=stamps[GAP[0] - 1], value='occluded=partly'),
    ]
    Run(recording)(tmp_path / '0', decisions)
    for k in (1, 2):
        labels = f'--labels=csv:{tmp_path / str(k - 1)}'
        rows = Run(recording, '--complete', labels)(tmp_path / str(k))
        is_truck = [rows['2', stamp]['class_name'] == 'truck' for stamp in stamps]
        assert is_truck == [1 <= j <= GAP[0] for j in range(SWEEPS)]
        found = attributes_in(tmp_path / str(k))
        assert found == {('2', stamp): {'occluded': 'partly'} for stamp in stamps[1 : GAP[0]]}


@pytest.mark.parametrize('first', [2, 8])
def test_tracks_that_swap_their_ends_are_completed_alike_by_later_runs(completed, tmp_path, first):
    """A part joined to another track is not followed back into where it was cut off."""
    _, stamps, _, out = completed
    swap = [
        Decision('1', stamps[0], 'delete', end_ns=stamps[first - 1]),
        Decision('1', stamps[first], 'rename', end_ns=stamps[-1], value='2'),
        Decision('2', stamps[first], 'rename', end_ns=stamps[-1], value='1'),
    ]
    recording = out.with_name('drive')
    rows = Run(recording, '--keyframes')(tmp_path / '0', swap)
    Run(recording)(tmp_path / '1', swap)
    later = Run(recording, '--keyframes', '--labels', f'csv:{tmp_path / "1"}')(tmp_path / '2')
    before, after = words_of(rows, '1', stamps), words_of(rows, '2', stamps)
    assert before[:first] == ['rejected'] * first
    cut = (before if first < GAP[0] else after)[GAP[0] : GAP[-1] + 1]
    assert cut == ['interpolated'] * len(GAP)
    is_there = [[bool(word) for word in words_of(later, name, stamps)] for name in '12']
    assert is_there == [[False] * first + [True] * (SWEEPS - first), [bool(one) for one in after]]


def test_a_split_track_that_is_joined_again_is_filled(completed, tmp_path, capsys):
    _, stamps, _, out = completed
    recording = out.with_name('drive')
    split = [Decision('2', stamps[10], 'rename', end_ns=stamps[-1], value='2_2')]
    Run(recording)(tmp_path / '0', split)
    again = Run(recording, f'--labels=csv:{tmp_path / "0"}')
    again(tmp_path / '1', [Decision('2_2', None, 'rename', value='2')])
    rows = Run(recording, '--complete', f'--labels=csv:{tmp_path / "1"}')(tmp_path / '2')
    assert '' not in words_of(rows, '2', stamps)
    table = (tmp_path / '0' / 'boxes.csv').read_text()
    (tmp_path / '0' / 'boxes.csv').write_text(table.replace(',2_2,', ',77,'))  # by hand
    capsys.readouterr()
    Run(recording, f'--labels=csv:{tmp_path / "0"}')(tmp_path / 'by_hand')
    missing = "the labels have decisions on tracks that they do not have: '2_2'"
    assert missing in capsys.readouterr().err
    command = ['relabel', str(recording), '-o', str(tmp_path / '3'), *QUICK]
    again = ['--labels', f'csv:{tmp_path / "0"}', '--decisions', str(tmp_path / '0' / DECISIONS)]
    assert main([*command, *again]) == 2
    assert 'which would be applied twice' in capsys.readouterr().err


def in_two_parts():
    """Return a drive whose track 2 goes on as 5."""
    drive = Drive(sweeps=SWEEPS)
    for k in range(8, SWEEPS):
        drive.replace('/boxes', k, lambda message: setattr(message.detections[1], 'id', '5'))
    return drive


def test_a_rejected_part_of_a_track_gets_no_boxes_by_later_runs(tmp_path):
    """Though a run has stitched it to a part that is not rejected."""
    drive = in_two_parts()
    for k in range(3):
        drive.replace('/boxes', k, lambda message: message.detections.pop(1))
    recording = drive.write(tmp_path / 'drive')
    decisions = [Decision('2', None, 'reject'), Decision('2', drive.stamps[4], 'accept')]
    labels = None
    for name in ('0', '1', '2'):
        run = Run(recording, '--complete', *([f'--labels=csv:{labels}'] if labels else []))
        rows = run(tmp_path / name, () if labels else decisions)
        labels = tmp_path / name
        words = words_of(rows, '5', drive.stamps)  # the longer part
        assert words == [''] * 3 + ['kept', 'refined'] + ['kept'] * 3 + ['refined'] * 8


def test_a_part_given_to_a_track_that_is_there_keeps_both_apart(tmp_path):
    """Neither stitching nor following joins what is left to the track that has the part."""
    drive = in_two_parts()
    recording = drive.write(tmp_path / 'drive')
    part = [Decision('2', drive.stamps[5], 'rename', end_ns=drive.stamps[7], value='5')]
    runs = {
        'plain': Run(recording),
        'whole': Run(recording, '--complete'),
        'stitched': Run(recording, '--complete', f'--labels=csv:{tmp_path / "plain"}'),
        'followed': Run(recording, '--keyframes', f'--labels=csv:{tmp_path / "plain"}'),
        'again': Run(recording, '--keyframes', f'--labels=csv:{tmp_path / "stitched"}'),
    }
    for name, run in runs.items():
        rows = run(tmp_path / name, part if name in ('plain', 'whole') else ())
        is_there = [[bool(word) for word in words_of(rows, one, drive.stamps)] for one in '25']
        assert is_there == [[True] * 5 + [False] * 11, [False] * 5 + [True] * 11], name


def test_tracks_with_boxes_at_the_same_stamps_are_joined(completed, tmp_path, capsys):
    _, stamps, _, out = completed
    decisions = [
        Decision('1', None, 'rename', value='2'),
        Decision('1', stamps[2], 'reclass', end_ns=stamps[4], value='trukc'),
    ]
    run = Run(out.with_name('drive'))
    run(tmp_path / 'out', decisions)
    assert run.status == 0
    lines = capsys.readouterr().err
    assert "of two boxes of '2' at one stamp one is decided about" in lines
    assert "unknown class names are treated as vehicles: 'trukc' (3 boxes)" in lines
    classes = [one for one in read_decisions(tmp_path / 'out' / APPLIED) if one.kind == 'reclass']
    spans = [(one.stamp_ns, one.end_ns) for one in classes]
    assert all(any(a <= stamps[k] <= b for a, b in spans) for k in (2, 3, 4))
    # Complete tracks have them, too: both boxes keep the id that a person gave.
    rows = Run(out.with_name('drive'), '--complete')(tmp_path / 'whole', decisions[:1])
    assert {name for name, _ in rows} == {'2', '9'}
    written = rows_in(tmp_path / 'whole' / 'boxes.csv')
    count = sum((row['track_id'], row['stamp_ns']) == ('2', str(stamps[0])) for row in written)
    assert count == 2


def test_a_class_given_to_most_boxes_of_a_track_is_of_these_alone(completed, tmp_path):
    run, stamps, _, _ = completed
    boxes = Decision('2', stamps[2], 'reclass', end_ns=stamps[-1], value='truck')
    rows = run(tmp_path / 'out', [boxes])
    classes = [rows['2', stamp]['class_name'] for stamp in stamps]
    assert classes == ['car'] * 2 + ['truck'] * (SWEEPS - 2)


def test_a_box_of_a_person_keeps_its_class(completed, tmp_path):
    _, stamps, _, out = completed
    table = BoxTable.read(out / 'boxes.csv').without_rejected()
    is_own = [
        key == ('2', stamps[1]) for key in zip(table.track_ids, table.stamps_ns, strict=True)
    ]
    status = tuple('human' if own else 'refined' for own in is_own)
    names = tuple('truck' if own else 'car' for own in is_own)
    replace(table, status=status, class_names=names).write(tmp_path / 'boxes.csv')
    labels = f'csv:{tmp_path / "boxes.csv"}'
    rows = Run(out.with_name('drive'), '--labels', labels, '--complete')(tmp_path / 'out')
    found = {key: row['class_name'] for key, row in rows.items() if row['class_name'] != 'car'}
    assert found == {('2', stamps[1]): 'truck'}
