"""A drive is finished in the page: labels are written, opened, listed and downloaded there."""

import os
import shutil
import signal
import subprocess
import sys
from time import sleep
from zipfile import ZipFile

from boxreg_ros.cli import main
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.review_command import drive_of
from boxreg_ros.review.application import POLL_SECONDS
from boxreg_ros.review.decisions import Decision, DecisionLog, DECISIONS, read_decisions
from boxreg_ros.review.differences import differences
from boxreg_ros.review.folders import newest_of
from boxreg_ros.review.server import review_server
from boxreg_ros.review.token import review_token
from boxreg_ros.structures import BoxArray
from browser import NEEDS_BROWSER, opened_page, other_page, press, serving
import numpy as np
import pytest
from ros_messages import Drive

pytest.importorskip('plotly')
QUICK = ['--set', 'solver.rounds=2', '--set', 'sampling.points=64', '--formats', 'csv']


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    """Return a result of two tracks."""
    folder = tmp_path_factory.mktemp('written')
    recording = Drive(sweeps=10).write(folder / 'drive')
    assert main(['relabel', str(recording), '-o', str(folder / 'out'), '--report', *QUICK]) == 0
    return folder / 'out'


@pytest.fixture
def held_python(tmp_path, quick_python, monkeypatch):
    """Let the page write labels in processes that end once the file returned exists."""
    end, held = tmp_path / 'end', tmp_path / 'python'
    wait = f'until [ -e {end} ]; do sleep 0.05; done'
    held.write_text(f'#!/bin/sh\n{sys.executable} "$@"\nstatus=$?\n{wait}\nexit $status\n')
    held.chmod(0o755)
    monkeypatch.setattr(sys, 'executable', str(held))
    return end


@NEEDS_BROWSER
def test_the_new_result_opens_with_what_changed_and_its_files(made, tmp_path, held_python):
    out = shutil.copytree(made, tmp_path / 'out')
    with (
        serving(review_server([(out, drive_of(out))], 0, 'anna')) as server,
        opened_page(server.address + '#track=1') as page,
    ):
        colleague = other_page(page, server.address + '#track=2')
        colleague.evaluate(
            '{ const shown = say; window.said = []; '
            'say = text => { window.said.push(text); shown(text); }; }'
        )
        press(page, 'd', 'isGone(current())')
        page.click('#files-button')
        page.wait_for_selector('#files[open]')
        assert not page.is_checked('#files-formats [value=openlabel]')
        page.check('#files-formats [value=openlabel]')
        page.click('#files-write')
        said = "$('notice').textContent.includes('1 of 1 s of the drive')"
        page.wait_for_function(said)
        late = Decision('2', None, 'unsure', who='ben', when='2026-01-01T00:00:00+00:00')
        DecisionLog(out / DECISIONS).append([late])
        new = tmp_path / 'out.corrected'

        def decide_meanwhile(route):
            known = route.fetch()
            DecisionLog(new / DECISIONS).append([late])
            sleep(2 * POLL_SECONDS)  # the page receives it before this answer
            route.fulfill(response=known)

        page.route('**/decisions', decide_meanwhile, times=1)
        held_python.touch()
        # The page goes on in the new result, that of a colleague as well.
        page.wait_for_function("!$('overview').hidden")
        assert server.log_paths == [new / DECISIONS]
        assert page.is_visible('#overview')
        assert 'The decisions changed boxes of' in page.inner_text('#written-text')
        first = page.inner_text('#written-rows tr:first-child').split()
        assert first == ['1', '10', 'removed']
        assert '1' in page.evaluate('[...view.changed]')
        colleague.wait_for_function("window.said.some(text => text?.includes('the new result'))")
        assert colleague.evaluate("view.changed.has('1')")
        colleague.context.close()
        page.wait_for_function('log.count === 3')  # none is lost that was made meanwhile
        # Its files.
        page.click('#files-button')
        page.wait_for_selector('#files[open]')
        assert page.inner_text('#files-folder') == str(new)
        with page.expect_download() as found:
            page.click('#files-rows a >> text=boxes.csv')
        assert found.value.path().read_bytes() == (new / 'boxes.csv').read_bytes()
        with page.expect_download() as found:
            page.click('#files-rows a >> text=openlabel/')
        with ZipFile(found.value.path()) as archive:
            (name,) = archive.namelist()
            assert archive.read(name) == (new / name).read_bytes()
        page.keyboard.press('Escape')
        # What is decided next is in the new folder, and the next labels go beside it.
        page.click('#tab-tracks')
        press(page, 'c', "document.activeElement.id === 'comment'")
        page.keyboard.type('seen')
        press(page, 'Enter', 'log.count === 4')
    assert [one.comment for one in read_decisions(new / DECISIONS)] == ['', '', '', 'seen']
    assert len(read_decisions(out / DECISIONS)) == 2
    rejected = [s == 'rejected' for s in BoxTable.read(new / 'boxes.csv').status]
    assert sum(rejected) == 10


def test_differences_are_those_of_labels():
    box = np.array([1.0, 2, 0, 4, 2, 1.5, 0, 0, 0])

    def table(*rows):
        arrays = []
        for stamp, names, classes, shift in rows:
            boxes = np.tile(box, (len(names), 1))
            boxes[:, 0] += shift
            arrays.append(BoxArray(stamp, 'odom', names, classes, np.ones(len(names)), boxes))
        return BoxTable.from_arrays(arrays)

    before = table((1, ('a', 'b'), ('car', 'car'), 0), (2, ('a', 'b'), ('car', 'car'), 0))
    after = table((1, ('a', 'b'), ('car', 'van'), 0.25), (3, ('a',), ('car',), 0))
    assert differences(before, before) == []
    none = {'added': 0, 'removed': 0, 'changed': 0, 'shift': 0.0, 'class': ''}
    assert differences(before, after) == [
        {'id': 'a', **none, 'added': 1, 'removed': 1, 'changed': 1, 'shift': 0.25},
        {'id': 'b', **none, 'removed': 1, 'changed': 1, 'shift': 0.25, 'class': 'van'},
    ]


def test_the_token_is_that_of_the_user_and_the_results(tmp_path, monkeypatch):
    monkeypatch.setenv('XDG_STATE_HOME', str(tmp_path / 'state'))
    token = review_token([tmp_path / 'out'])
    assert review_token([tmp_path / 'out']) == token
    assert review_token([tmp_path / 'other']) != token
    secret = tmp_path / 'state/boxreg/review_secret'
    assert secret.stat().st_mode & 0o777 == 0o600
    secret.write_bytes(b'')  # damaged: a token of this start
    assert review_token([tmp_path / 'out']) != review_token([tmp_path / 'out'])
    monkeypatch.setenv('XDG_STATE_HOME', '/proc/none')
    assert len(review_token([tmp_path / 'out'])) == len(token)


def test_a_review_goes_on_in_the_newest_result(made, tmp_path, capsys):
    out = tmp_path / 'out'
    folders = [out, tmp_path / 'out.corrected', tmp_path / 'out.corrected-2']
    for number, folder in enumerate(folders):
        shutil.copytree(made, folder)
        DecisionLog(folder / DECISIONS).append([Decision('1', None, 'accept')] * number)
        os.utime(folder / 'summary.json', ns=(number, number))
    assert newest_of(out) == folders[2]
    capsys.readouterr()
    assert main(['review', str(out), '--progress']) == 0
    assert 'out.corrected-2' in capsys.readouterr().out
    DecisionLog(folders[1] / DECISIONS).append([Decision('2', None, 'accept')])
    assert newest_of(out) == folders[1]  # the last one lacks a decision
    assert newest_of(folders[2]) == folders[2]
    os.utime(out / 'summary.json', ns=(9, 9))  # relabelled since
    assert newest_of(out) == out
    assert newest_of(tmp_path / 'absent') == tmp_path / 'absent'


@pytest.mark.parametrize('has_screen', [True, False])
def test_the_browser_opens_where_there_is_a_screen(made, tmp_path, preloaded_python, has_screen):
    opened = tmp_path / 'opened'
    script = tmp_path / 'browser'
    script.write_text(f'#!/bin/sh\necho "$1" > {opened}.part; mv {opened}.part {opened}\n')
    script.chmod(0o755)
    environment = {name: os.environ[name] for name in os.environ if 'SSH' not in name}
    environment |= {'BROWSER': f'{script} %s', 'DISPLAY': ':9' if has_screen else ''}
    environment.pop('WAYLAND_DISPLAY', None)
    command = [preloaded_python, '-m', 'boxreg_ros.cli', 'review', str(made), '--port', '0']
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, text=True) as process:
        try:
            address = process.stdout.readline().strip()
            process.stdout.readline()
            for _ in range(1200 if has_screen else 0):
                if opened.exists():
                    break
                with pytest.raises(subprocess.TimeoutExpired):
                    process.wait(0.05)
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=60)
        finally:
            process.kill()
    assert opened.exists() == has_screen
    if has_screen:
        assert opened.read_text().strip() == address


def test_a_run_ends_with_the_next_command(made, tmp_path, capsys):
    recording = made.with_name('drive')
    out = tmp_path / 'a result'
    assert main(['relabel', str(recording), '-o', str(out), *QUICK]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == f"next: boxreg review '{out}' (after the same run with --report)"


@pytest.mark.parametrize(('option', 'status'), [('--associate', 2), ('--keep-ids', 0)])
def test_ids_of_associated_boxes_count_from_the_same_start(tmp_path, capsys, option, status):
    """In a part that begins elsewhere, the decision would be about another object."""
    recording = Drive(sweeps=10).write(tmp_path / 'drive')
    command = ['relabel', str(recording), option, *QUICK]
    assert main([*command, '-o', str(tmp_path / 'out'), '--end=0.8']) == 0
    DecisionLog(tmp_path / 'out' / DECISIONS).append([Decision('2', None, 'delete')])
    command += ['--decisions', str(tmp_path / 'out' / DECISIONS), '-o', str(tmp_path / 'new')]
    assert main([*command, '--start=0']) == 0
    assert main([*command, '--start=0.3']) == status
    assert ('--start: expected 0 s, as of the result' in capsys.readouterr().err) == bool(status)
    assert main([*command, '--set=max_gap=0.9']) == status
    assert ('max_gap: expected 1.6 s, as of' in capsys.readouterr().err) == bool(status)


@pytest.mark.parametrize(('made_by', 'run_by'), [('--associate', ''), ('', '--associate')])
def test_decisions_on_associated_boxes_are_not_about_other_ids(tmp_path, capsys, made_by, run_by):
    recording = Drive(sweeps=8).write(tmp_path / 'drive')
    command = ['relabel', str(recording), *QUICK]
    out, new = tmp_path / 'out', tmp_path / 'new'
    assert main([*command, *filter(None, [made_by]), '-o', str(out)]) == 0
    DecisionLog(out / DECISIONS).append([Decision('2', None, 'delete')])
    command += ['--decisions', str(out / DECISIONS), '-o', str(new)]
    assert main([*command, *filter(None, [run_by])]) == 2
    remedy = 'with --associate' if made_by else 'without --associate, and with --keep-ids'
    assert f'which name other objects; relabel {remedy}' in capsys.readouterr().err
    assert not new.exists()
    assert main([*command, *filter(None, [made_by])]) == 0


def test_decisions_on_associated_boxes_are_beside_their_result(tmp_path, capsys):
    """Elsewhere, nothing shows that the ids of this run are of the same objects."""
    recording = Drive(sweeps=10).write(tmp_path / 'drive')
    log = tmp_path / 'both.csv'
    DecisionLog(log).append([Decision('2', None, 'delete')])
    command = ['relabel', str(recording), '--associate', *QUICK, '--start=0.3']
    assert main([*command, '--decisions', str(log), '-o', str(tmp_path / 'new')]) == 2
    assert 'expected them in the folder of the result' in capsys.readouterr().err
    out = tmp_path / 'out'
    assert main([*command, '-o', str(out)]) == 0
    log.rename(out / log.name)
    assert main([*command, '--decisions', str(out / log.name), '-o', str(tmp_path / 'new')]) == 0


def test_a_result_with_decisions_is_not_replaced_by_one_without(tmp_path, capsys):
    recording = Drive(sweeps=8).write(tmp_path / 'drive')
    made, out = tmp_path / 'made', tmp_path / 'out'
    command = ['relabel', str(recording), *QUICK, '-o']
    assert main([*command, str(made)]) == 0
    DecisionLog(made / DECISIONS).append([Decision('2', None, 'delete')])
    decisions = ['--decisions', str(made / DECISIONS)]
    assert main([*command, str(out), *decisions]) == 0
    before = (out / 'boxes.csv').read_bytes()
    assert main([*command, str(out)]) == 2
    assert 'those of a person would be lost' in capsys.readouterr().err
    assert (out / 'boxes.csv').read_bytes() == before
    other = Drive(sweeps=8).write(tmp_path / 'other')
    assert main(['relabel', str(other), *QUICK, '-o', str(tmp_path / 'x'), *decisions]) == 0
    assert 'decisions: they were made on drive.mcap, whose ids' in capsys.readouterr().err
    assert main([*command, str(out), *decisions, '--set=lag=2']) == 0
