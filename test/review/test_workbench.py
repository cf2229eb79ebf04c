"""`boxreg review` as a workbench: tracks are edited, solved and written in a real browser."""

from contextlib import contextmanager
from pathlib import Path
import resource
import shutil
import signal
import subprocess

from boxreg_ros import Config, refine, Track
from boxreg_ros.cli import main
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.labels import frames_of
from boxreg_ros.offline.review_command import drive_of
from boxreg_ros.review.decisions import DECISIONS, read_decisions
from boxreg_ros.review.server import review_server
from browser import (
    answer,
    NEEDS_BROWSER,
    open_box,
    opened_page,
    other_page,
    press,
    serving,
)
import numpy as np
import pytest
from ros_messages import Drive

pytest.importorskip('plotly')
QUICK = ['--set', 'solver.rounds=2', '--set', 'sampling.points=64']
FORMATS = ['--formats', 'openlabel,sustechpoints']
DO = '[data-do={}]'
NUM_SWEEPS = 14
LEAVING = """(() => {
  const event = new Event('beforeunload', { cancelable: true });
  dispatchEvent(event);
  return event.defaultPrevented;
})()"""

pytestmark = NEEDS_BROWSER


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    """Return the folder of a recording and of its result, both as a person would make them."""
    folder = tmp_path_factory.mktemp('workbench')
    recording = Drive(sweeps=NUM_SWEEPS).write(folder / 'drive')
    out = ['-o', str(folder / 'out')]
    assert main(['relabel', str(recording), *out, '--report', *FORMATS, *QUICK]) == 0
    return folder


@pytest.fixture
def server(made, tmp_path, quick_python):
    """Return a running server for a copy of the result."""
    out = shutil.copytree(made / 'out', tmp_path / 'out')
    with serving(review_server([(out, drive_of(out))], 0, 'anna')) as found:
        yield found


def boxes_of(table, track_id, *columns):
    rows = [row for row, name in enumerate(table.track_ids) if name == track_id]
    return [tuple(getattr(table, name)[row] for name in columns) for row in rows]


def ids_of(page):
    return page.evaluate('TRACKS.map(track => track.id)')


def test_tracks_are_split_joined_renamed_and_deleted_and_all_is_undone(server):
    with opened_page(server.address + '#track=1') as page:
        assert sorted(ids_of(page)) == ['1', '2']
        lengths = 'TRACKS.map(track => track.path.length).sort((a, b) => a - b)'
        open_box(page, '1', 8)
        press(page, 's', 'TRACKS.length === 3')
        assert sorted(ids_of(page)) == ['1', '1_2', '2']
        page.wait_for_function("current().id === '1_2'")
        assert page.evaluate(lengths) == [6, 8, 14]
        assert page.evaluate('[view.row, view.part.stamps.length]') == [0, 6]
        page.click(DO.format('rename'))
        answer(page, 'new')
        page.wait_for_function("current().id === 'new'")
        page.keyboard.press('k')
        answer(page, 'van')
        page.wait_for_function("current().class === 'van'")
        assert 'van' in page.inner_text('#title')
        # A range of boxes, then one of it back.
        open_box(page, '1', 2)
        page.keyboard.press('b')
        page.evaluate('step(4)')
        press(page, 'Shift+D', 'current().deleted === 3')
        assert page.evaluate('view.mark') is None
        page.evaluate('step(3)')
        page.click(DO.format('delete-box'))
        page.wait_for_function('current().deleted === 2')
        assert 'deleted' not in page.inner_text('#clock')
        # All is undone, in steps, and done again.
        page.wait_for_function('log.made.length === 5')
        for count, deleted in ((4, 3), (3, 0)):
            press(page, 'z', f'log.made.length === {count}')
            assert page.evaluate('current().deleted') == deleted
        for count in (2, 1, 0):
            press(page, 'z', f'log.made.length === {count}')
        page.wait_for_function('TRACKS.length === 2 && log.held.size === 0')
        open_box(page, '1', 8)
        page.click(DO.format('split'))
        page.wait_for_function('TRACKS.length === 3')
        # A split track is a continuation of its rest, which is proposed.
        open_box(page, '1', 0)
        page.keyboard.press('j')
        page.wait_for_selector('#ask[open]')
        proposed = page.locator('#ask-proposals button').first.inner_text()
        assert proposed == '1_2 car: 0.1 s and 0.0 m apart'
        press(page, 'Enter', 'TRACKS.length === 2')
        press(page, 'z', 'TRACKS.length === 3')
        assert sorted(ids_of(page)) == ['1', '1_2', '2']


def test_labels_are_written_with_all_decisions_without_a_terminal(server):
    out = server.log_paths[0].parent
    before = BoxTable.read(out / 'boxes.csv')
    stamps = [stamp for (stamp,) in boxes_of(before, '1', 'stamps_ns')]
    with opened_page(server.address + '#track=1') as page:
        open_box(page, '1', 8)
        press(page, 's', "current().id === '1_2'")
        page.keyboard.press('k')
        answer(page, 'van')
        page.wait_for_function("current().class === 'van'")
        open_box(page, '1', 3)
        press(page, 'Shift+D', 'current().deleted === 1')
        open_box(page, '2', 0)
        press(page, 'd', 'isGone(current())')
        assert page.locator('#rows tr.gone').count() == 1
        press(page, 'Control+s', "$('notice').textContent.includes('boxes in')")
        assert page.locator('#failure').is_hidden()
    again = out.with_name('out.corrected')
    table = BoxTable.read(again / 'boxes.csv')
    assert len(table.track_ids) == len(before.track_ids)
    kinds = boxes_of(table, '1', 'stamps_ns', 'status')
    assert [stamp for stamp, _ in kinds] == stamps[:8]
    assert [status == 'rejected' for _, status in kinds] == [row == 3 for row in range(8)]
    assert set(boxes_of(table, '1_2', 'class_names')) == {('van',)}
    assert {status for _, status in boxes_of(table, '2', 'stamps_ns', 'status')} == {'rejected'}
    frames = [frame.refined.boxes for frame in frames_of('openlabel', again / 'openlabel')]
    found = {(boxes.stamp_ns, name) for boxes in frames for name in boxes.track_ids}
    assert found == {
        *((stamp, '1') for stamp in stamps[:8] if stamp != stamps[3]),
        *((stamp, '1_2') for stamp in stamps[8:]),
    }
    texts = [path.read_text() for path in sorted((again / 'sustechpoints').rglob('label/*.json'))]
    assert [text.count('"van"') for text in texts] == [0] * 8 + [1] * 6
    # The review goes on in the new folder: the same decisions hold, and are made no second time.
    with (
        serving(review_server([(again, None)], 0)) as second,
        opened_page(second.address + '#tracks') as page,
    ):
        assert sorted(ids_of(page)) == ['1', '1_2', '2']
        assert page.locator('#rows tr.gone').count() == 1
    assert not list(out.parent.glob('.*partial*'))


def test_labels_that_cannot_be_written_leave_all_as_it_was(server, made):
    out = server.log_paths[0].parent
    hidden = made / 'drive.hidden'
    (made / 'drive').rename(hidden)
    try:
        with opened_page(server.address + '#track=1', expected='400') as page:
            press(page, 'd', 'isGone(current())')
            page.click('#save-button')
            page.wait_for_selector('#failure:not([hidden])')
            text = page.inner_text('#failure')
    finally:
        hidden.rename(made / 'drive')
    for word in ('not written', 'drive'):
        assert word in text
    assert not out.with_name('out.corrected').exists()
    assert [one.kind for one in read_decisions(server.log_paths[0])] == ['delete']


@contextmanager
def running(out, python, max_bytes=None):
    """Yield the process of `boxreg review` and its address; no file may have more bytes."""

    def limit():
        if max_bytes is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (max_bytes, max_bytes))

    command = [python, '-m', 'boxreg_ros.cli', 'review', str(out), '--port', '0']
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=limit) as process:
        try:
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()


def test_a_full_disk_and_a_killed_server_lose_nothing(made, tmp_path, preloaded_python):
    out = shutil.copytree(made / 'out', tmp_path / 'out')
    log, again = out / DECISIONS, tmp_path / 'out.corrected'
    with (
        running(out, preloaded_python, max_bytes=200_000) as (process, address),
        opened_page(address + '#track=1', expected='Failed to load resource') as page,
    ):
        press(page, 'd', 'isGone(current())')
        page.keyboard.press('Control+s')  # the report is larger
        page.wait_for_selector('#failure:not([hidden])')
        text = page.inner_text('#failure')
        assert 'the earlier ones are as they were' in text and 'too large' in text
        assert sorted(path.name for path in tmp_path.iterdir()) == ['out']
        # Killed while it decides: the page has what the file has, and says so.
        page.evaluate("void (async () => { while (await judge('unsure', false)) ; })()")
        page.wait_for_function('log.count > 5')
        process.kill()
        page.wait_for_selector('#failure:not([hidden])')
        assert 'Check that boxreg review still runs' in page.inner_text('#failure')
        known = page.evaluate('log.count')
        assert 0 <= len(read_decisions(log)) - known <= 1  # the last one was not answered
    with (
        running(out, preloaded_python) as (process, address),
        opened_page(address + '#track=1') as page,
    ):
        assert page.evaluate('log.count') == len(read_decisions(log))
        assert page.evaluate('isGone(current())')
        press(page, 'Control+s', "$('notice').textContent.includes('Writing')")
        page.wait_for_timeout(1500)
        page.context.close()
        process.kill()
    # Its labels appear whole, or not at all, and can be written again.
    with (
        running(out, preloaded_python) as (process, address),
        opened_page(address, expected='40') as page,
    ):
        for _ in range(120):
            press(page, 'Control+s', '!view.isSaving')
            if 'boxes in' in page.inner_text('#notice'):
                break
            page.wait_for_timeout(1000)  # the command that was left is still at work
    table = BoxTable.read(again / 'boxes.csv')
    assert {status for _, status in boxes_of(table, '1', 'stamps_ns', 'status')} == {'rejected'}
    assert not list(tmp_path.glob('.*'))


def test_views_are_moved_zoomed_and_show_neighbours(server):
    with opened_page(server.address + '#track=1', bypass_csp=False) as page:
        page.wait_for_selector('#space canvas')
        for name in ('top', 'side', 'front'):
            bounds = page.locator(f'#{name}').bounding_box()
            x, y = bounds['x'] + 0.7 * bounds['width'], bounds['y'] + 0.6 * bounds['height']
            # The place under the pointer, in the frame of the box.
            place = f"""(() => {{
              const [r, u] = VIEWS['{name}'], c = $('{name}'), b = c.getBoundingClientRect();
              return [view.center[r] + ({x} - b.left - b.width / 2) / c.zoom,
                      view.center[u] - ({y} - b.top - b.height / 2) / c.zoom]; }})()"""
            page.mouse.move(x, y)
            before = page.evaluate(place)
            zoom = page.evaluate(f"$('{name}').zoom")
            page.mouse.wheel(0, -100)
            page.evaluate('painted()')
            assert page.evaluate(f"$('{name}').zoom") > 1.2 * zoom
            assert page.evaluate(place) == pytest.approx(before, abs=0.01)
            page.mouse.down()
            page.mouse.move(x - 40, y + 20, steps=3)
            page.mouse.up()
            zoom = page.evaluate(f"$('{name}').zoom")
            moved = np.subtract(page.evaluate(place), before)
            assert moved == pytest.approx([40 / zoom, 20 / zoom], abs=0.02)
            page.mouse.dblclick(x, y)
            assert page.evaluate('[view.zoom, ...view.center]') == [1, 0, 0, 0]
        page.evaluate('new Promise(done => setTimeout(done, 300))')
        assert 'neighbours' in page.inner_text('#legend')
        # Space plays, wherever the focus is; Back goes to the track before.
        for selector in (DO.format('accept'), '#mode', '#time', '#f-points', '#top'):
            page.evaluate('step(0)')  # else the end is so near that playing may be over
            page.locator(selector).focus()
            page.keyboard.press(' ')
            assert page.evaluate('[view.isPlaying, log.count]') == [True, 0], selector
            page.keyboard.press(' ')
        page.keyboard.press('ArrowDown' if page.evaluate('view.place') == 0 else 'ArrowUp')
        page.evaluate('new Promise(done => setTimeout(done, 300))')
        assert page.evaluate('current().id') == '2'
        page.go_back()
        page.evaluate('new Promise(done => setTimeout(done, 300))')
        assert page.evaluate('current().id') == '1'


def test_a_correction_shows_its_figures_is_typed_and_undone_in_steps(server):
    with opened_page(server.address + '#track=1') as page:
        page.keyboard.press('e')
        given = page.evaluate('view.edit.slice()')
        assert 'IoU with the refined box 1.00' in page.inner_text('#clock')
        inside = page.evaluate('numInside(pointsAt(view.part, view.row), view.edit)')
        bounds = page.locator('#front').bounding_box()
        x, y = bounds['x'] + bounds['width'] / 2, bounds['y'] + bounds['height'] / 2
        zoom = page.evaluate("$('front').zoom")
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 0.5 * zoom, y, steps=5)
        # While it is dragged: half a metre to the left of the box, as the front view shows it.
        page.wait_for_function("!$('clock').textContent.includes('IoU with the refined box 1.00')")
        shift = 'toFrame(view.edit, view.frame, view.R)'
        assert page.evaluate(shift) == pytest.approx([0, 0.5, 0], abs=0.02)
        width = given[4]
        expected = (width - 0.5) / (width + 0.5)
        shown = float(page.inner_text('#clock').split()[5])
        assert shown == pytest.approx(expected, abs=0.02)
        page.wait_for_function("$('clock').textContent.includes(' → ')")
        page.wait_for_function('!view.isAsking')
        before, after = map(float, page.inner_text('#clock').split('risk ')[1].split(' ')[:3:2])
        assert after > before + 0.1
        page.mouse.up()
        assert page.evaluate('numInside(pointsAt(view.part, view.row), view.edit)') < inside
        assert page.evaluate(LEAVING)  # the browser asks before it is lost
        page.keyboard.press('l')
        page.fill('#n-width', '3')
        press(page, 'Enter', 'view.edit[4] === 3')
        page.locator('#top').focus()
        page.keyboard.press('z')
        assert page.evaluate('view.edit[4]') == pytest.approx(width)
        page.keyboard.press('z')
        page.keyboard.press('z')
        assert page.evaluate('view.edit') == pytest.approx(given)
        # With the size kept, a face moves the whole box.
        page.check('#lock')
        edge = x + 0.5 * width * zoom
        page.mouse.move(edge, y)
        page.mouse.down()
        page.mouse.move(edge + 0.3 * zoom, y, steps=3)
        page.mouse.up()
        assert page.evaluate('view.edit[4]') == pytest.approx(width)
        assert page.evaluate(shift) == pytest.approx([0, 0.3, 0], abs=0.03)
        page.keyboard.press('Escape')
        assert page.evaluate('view.edit') is None
        assert not server.log_paths[0].exists()


def test_a_track_is_solved_again_with_its_pin_within_the_page(server):
    out = server.log_paths[0].parent
    with opened_page(server.address + '#track=1') as page:
        press(page, 'o', "$('notice').textContent.includes('pinned boxes')")
        page.evaluate('step(6)')
        page.keyboard.press('e')
        page.fill('#n-length', str(page.evaluate('view.edit[3] + 0.4')))
        page.keyboard.press('Enter')
        page.locator('#top').focus()
        page.keyboard.press('Enter')
        page.wait_for_selector(DO.format('unpin'))
        press(page, 'o', "$('notice').textContent.includes('1 pinned box')")
        assert 'solved again' in page.inner_text('#legend')
        solved = page.evaluate('[...view.solved]')
        part = page.evaluate('({ ...view.part, points: [...view.part.points] })')
    (pin,) = read_decisions(out / DECISIONS)
    assert pin.who == 'anna'
    boxes = dict(solved)
    assert boxes[str(pin.stamp_ns)] == pytest.approx(pin.box.tolist(), abs=1e-6)
    # As from Python, with the points of the report.
    given = np.array(part['given'])
    given[:, :3] += part['origin']
    given[:, 3:6] = pin.box[3:6]
    given[6] = pin.box
    shown = np.array(part['boxes'])[:, :3] + part['origin']
    offsets = np.split(np.array(part['points']).reshape(-1, 3) / 1000, np.cumsum(part['counts']))
    track = Track(
        '1', 'car', np.array(part['stamps'], np.int64), given,
        [offset + center for offset, center in zip(offsets, shown, strict=False)],
        np.array(part['sensor']) + part['origin'], pinned=np.arange(NUM_SWEEPS) == 6,
    )  # fmt: skip
    (expected,) = refine([track], Config.from_yaml(out / 'config.yaml'))
    found = np.array([boxes[stamp] for stamp in part['stamps']])
    np.testing.assert_allclose(found[:, :6], expected.boxes[:, :6], atol=0.02)
    assert abs(found[0, 3] - part['boxes'][0][3]) > 0.2


def test_people_see_the_decisions_of_each_other(server):
    with opened_page(server.address + '#track=1', expected='409') as first:
        second = other_page(first, server.address + '#track=1')
        second.fill('#who', 'ben')
        second.keyboard.press('Tab')
        first.keyboard.press('r')
        second.wait_for_selector('[data-do=reject][aria-pressed=true]')
        assert 'anna decided about track 1: reject' in second.inner_text('#notice')
        # A decision that was made before the other one was seen is not written.
        second.evaluate('log.count = 0')
        second.evaluate("judge('unsure', false)")
        second.wait_for_selector('#failure:not([hidden])')
        assert 'anna has decided' in second.inner_text('#failure')
        second.evaluate("judge('unsure', false)")
        first.wait_for_selector('[data-do=unsure][aria-pressed=true]')
        assert 'ben' in first.get_attribute('#comment', 'title')
    made = read_decisions(server.log_paths[0])
    assert [(one.who, one.kind) for one in made] == [('anna', 'reject'), ('ben', 'unsure')]


def test_one_key_accepts_and_opens_the_next_open_track(server):
    with opened_page(server.address + '#tracks') as page:
        first = page.evaluate('current().id')
        page.locator('#top').focus()
        press(page, 'Enter', f"current().id !== '{first}'")
        page.click(DO.format('next'))
        page.wait_for_function('log.count === 2')
        assert page.inner_text('#f-count') == '2 of 2 tracks, 2 decided'
        # Each track of the overview has its picture; the timeline opens what is clicked.
        page.click('#tab-overview')
        for number in range(2):
            page.wait_for_function(f"""$('thumbnail-{number}').getContext('2d')
              .getImageData(0, 0, 72, 32).data.some((v, i) => i % 4 === 3 && v > 0)""")
        bounds = page.locator('#timeline').bounding_box()
        page.mouse.click(bounds['x'] + bounds['width'] - 14, bounds['y'] + 4)
        page.wait_for_function(f'view.row === {NUM_SWEEPS - 1}')
        assert page.evaluate('current().id') == page.evaluate('timelineBars().shown[0].id')


@pytest.mark.parametrize(
    'context',
    [{}, {'color_scheme': 'dark', 'viewport': {'width': 390, 'height': 844}}],
    ids=['wide', 'dark-narrow'],
)
def test_axe_finds_nothing(server, context):
    axe = pytest.importorskip('axe_playwright_python.sync_playwright').Axe()

    def check(page):
        found = axe.run(page)
        assert found.violations_count == 0, found.generate_report()

    with opened_page(server.address, **context) as page:
        for tab in ('overview', 'tracks', 'drive', 'run'):
            page.click(f'#tab-{tab}')
            for plot in page.locator(f'#{tab} .plot').all():
                plot.scroll_into_view_if_needed()
                plot.locator('.main-svg').first.wait_for()
            page.wait_for_timeout(500)
            check(page)
        page.click('#tab-tracks')
        page.keyboard.press('e')
        check(page)
        page.keyboard.press('Escape')
        page.keyboard.press('j')
        check(page)
        page.keyboard.press('Escape')
        page.keyboard.press('?')
        check(page)


def test_a_review_begins_with_a_recording(made, tmp_path, preloaded_python, capfd):
    out = tmp_path / 'out'
    assert main(['review', str(tmp_path)]) == 1
    assert 'expected a finished result' in capfd.readouterr().err
    command = [preloaded_python, '-m', 'boxreg_ros.cli', 'review', str(made / 'drive')]
    command += ['-o', str(out), '--port', '0', *FORMATS, *QUICK]
    for word in ('boxes in', 'up to date'):
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            try:
                lines = [process.stdout.readline() for _ in range(2)]
                process.send_signal(signal.SIGINT)
                process.communicate(timeout=60)
            finally:
                process.kill()
        assert process.returncode == 0
        assert word in lines[0]
        assert lines[1].startswith('http://127.0.0.1:')
    assert (out / 'report.html').is_file()
    assert (out / 'sustechpoints').is_dir()


def test_every_part_of_the_script_is_in_the_page():
    from boxreg_ros.review.report import PAGE, SCRIPTS

    assert {path.stem for path in Path(PAGE).glob('*.js')} == set(SCRIPTS)
