"""The page of a review: what a person does is not lost; its views, and the drive."""

import gc
import shutil

from boxreg_ros.cli import main
from boxreg_ros.offline.review_command import drive_of
from boxreg_ros.review.decisions import Decision, DecisionLog, DECISIONS, read_decisions
from boxreg_ros.review.server import review_server
from browser import answer, NEEDS_BROWSER, opened_page, press, serving
import numpy as np
import pytest
from ros_messages import Drive

pytest.importorskip('plotly')
QUICK = ['--set', 'solver.rounds=2', '--set', 'sampling.points=64', '--formats', 'csv']
NUM_SWEEPS = 10

pytestmark = NEEDS_BROWSER


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    """Return a result of two tracks."""
    folder = tmp_path_factory.mktemp('kept_work')
    recording = Drive(sweeps=NUM_SWEEPS).write(folder / 'drive')
    assert main(['relabel', str(recording), '-o', str(folder / 'out'), '--report', *QUICK]) == 0
    return folder / 'out'


@pytest.fixture
def out(made, tmp_path):
    return shutil.copytree(made, tmp_path / 'out')


@pytest.fixture
def serve(out):
    """Return a function that returns a context with a server of the result."""
    return lambda port=0: serving(review_server([(out, drive_of(out))], port, 'anna'), joins=True)


def test_a_drawn_box_and_the_link_outlast_the_server(out, serve):
    with serve() as first:
        address = first.address
        page_of_first = opened_page(address + '#track=1', expected='Failed to load resource')
        page = page_of_first.__enter__()
        assert page.url.startswith(address)  # a link that is copied opens the page elsewhere
        page.keyboard.press('e')
        press(page, 'Shift+ArrowUp', 'view.isMoved')
        drawn = page.evaluate('moved(view.edit, view.part.origin, 1)')
    page.wait_for_selector('#lost:not([hidden])')
    gc.collect()  # closes connections that it had just accepted, as the end of a process does
    assert 'nothing is saved until it runs again' in page.inner_text('#lost')
    page.keyboard.press('Enter')
    page.wait_for_selector('#failure:not([hidden])')
    assert 'Check that boxreg review still runs' in page.inner_text('#failure')
    assert page.evaluate('[view.isMoved, moved(view.edit, view.part.origin, 1)]') == [True, drawn]
    assert page.evaluate('isCorrecting()')  # it is not left by mistake either
    with serve(first.server_port) as second:
        assert second.address == address
        page.wait_for_selector('#lost', state='hidden')
        press(page, 'Enter', 'pinOf(view.row) && !view.edit')
        with opened_page(page.url) as other:
            assert other.evaluate('log.count') == 1
        page_of_first.__exit__(None, None, None)
    (pin,) = read_decisions(out / DECISIONS)
    np.testing.assert_allclose(pin.box, drawn, atol=1e-6)


def test_undo_and_redo_outlast_a_reload_and_leave_what_others_decided(out, serve):
    judged = "judgementOf(TRACKS.find(t => t.id === '1'))?.decision"
    with serve() as server, opened_page(server.address + '#track=1') as page:

        def reload():
            page.reload()
            page.wait_for_selector('html[data-ready]')

        press(page, 'a', f"{judged} === 'accept'")
        page.evaluate('step(3)')
        page.keyboard.press('e')
        page.keyboard.press('ArrowUp')
        press(page, 'Enter', 'pinOf(3)')
        reload()
        press(page, 'z', "$('notice').textContent.startsWith('Undone: pin')")
        assert page.evaluate('log.held.size') == 1
        reload()
        press(page, 'z', 'log.held.size === 0')
        press(page, 'y', f"{judged} === 'accept'")
        reload()
        press(page, 'Shift+Z', 'log.held.size === 2 && pinOf(3)')
        page.click('[data-do=undo]')
        page.wait_for_function('log.held.size === 1')
        # Another person decides about the same track, and about the other one.
        DecisionLog(out / DECISIONS).append([
            Decision('2', None, 'delete', who='ben', when='2026-01-01T00:00:00+00:00'),
            Decision('1', None, 'unsure', who='ben', when='2026-01-01T00:00:01+00:00'),
        ])  # fmt: skip
        page.wait_for_function(f"{judged} === 'unsure'")
        page.keyboard.press('z')
        page.wait_for_selector('#failure:not([hidden])')
        assert 'ben has decided about track 1 since' in page.inner_text('#failure')
        assert page.evaluate(f'[{judged}, log.held.size]') == ['unsure', 2]
        # As ben, it is undone.
        page.fill('#who', 'ben')
        page.keyboard.press('Tab')
        assert page.evaluate('log.who') == 'ben'
        page.locator('#top').focus()
        press(page, 'z', f"{judged} === 'accept'")
        press(page, 'z', 'log.held.size === 1')
        page.keyboard.press('z')
        page.wait_for_function("$('notice').textContent.includes('Nothing of yours to undo')")
    assert [one.kind for one in read_decisions(out / DECISIONS)][-2:] == ['accept', 'restore']


def test_undo_of_a_restored_track_leaves_the_pin_of_another_person(out, serve):
    gone = "isGone(TRACKS.find(t => t.id === '1'))"
    with serve() as server, opened_page(server.address + '#track=1') as page:
        DecisionLog(out / DECISIONS).append([Decision('1', None, 'delete', who='ben', when='1')])
        page.wait_for_function(gone)
        press(page, 'd', f'!{gone}')
        press(page, 'z', gone)
        press(page, 'y', f'!{gone}')
        stamp_ns, box = page.evaluate(
            '[stampOf(...boxAt(3)), moved(view.part.usable[3], view.part.origin, 1)]'
        )
        pin = Decision('1', int(stamp_ns), 'pin', '', 'odom', np.array(box), who='ben', when='2')
        DecisionLog(out / DECISIONS).append([pin])
        page.wait_for_function('pinOf(3)')
        page.keyboard.press('z')
        page.wait_for_selector('#failure:not([hidden])')
        assert 'ben has decided about track 1 since (pin)' in page.inner_text('#failure')
        assert not page.evaluate(gone)
    assert read_decisions(out / DECISIONS)[-1].kind == 'pin'


def test_enter_after_a_click_or_on_a_tab_accepts(serve):
    with serve() as server, opened_page(server.address + '#tracks') as page:
        second = page.evaluate('TRACKS[1].id')
        decided = 'judgementOf(TRACKS[{}])?.decision === "accept"'
        page.click('[data-do=accept]')
        page.wait_for_function(decided.format(0))
        press(page, 'Enter', f"current().id === '{second}'")
        assert page.evaluate(decided.format(0))
        page.locator('#tab-tracks').focus()
        page.keyboard.press('Enter')
        page.wait_for_function(decided.format(1))
        # A button that the keyboard has reached is pressed by it.
        page.locator('[data-do=unsure]').focus()
        press(page, 'Enter', 'judgementOf(TRACKS[1])?.decision === "unsure"')


SIZES = [(1280, 720), (2560, 1440)]


@pytest.mark.parametrize('size', SIZES, ids=['small', 'large'])
def test_views_fill_the_window_below_one_row_of_tools(serve, size):
    width, height = size
    context = {'viewport': {'width': width, 'height': height}}
    with serve() as server, opened_page(server.address + '#track=1', **context) as page:
        boxes = {
            name: page.locator(f'#{name}').bounding_box() for name in ('top', 'side', 'space')
        }
        assert boxes['top']['y'] < 0.3 * height
        assert boxes['top']['height'] > 0.36 * height
        end = boxes['side']['y'] + boxes['side']['height']
        assert 0.96 * height < end <= height
        shown = "[...document.querySelectorAll('#decide button, #decide input')]"
        shown += '.map(e => e.getBoundingClientRect()).filter(b => b.width)'
        places = page.evaluate(f'{shown}.map(b => [b.top + b.height / 2, b.right])')
        middles, ends = np.transpose(places)
        assert np.ptp(middles) < 3
        assert ends.max() <= width
        page.keyboard.press('e')
        page.evaluate("""(() => {
          view.part.origin[0] = -654321.12; view.part.origin[1] = 5321234.12;
          view.edit[8] = -Math.PI; redrawEdit(); })()""")
        page.wait_for_function("$('n-y').value.length > 9")
        for name in ('x', 'y', 'z', 'length', 'yaw'):
            cut = f"$('n-{name}').scrollWidth - $('n-{name}').clientWidth"
            assert page.evaluate(cut) <= 0, name
        assert page.evaluate(f'Math.max(...{shown}.map(b => b.right))') <= width
        page.evaluate('view.isMoved = false')


def test_views_zoom_by_the_length_of_a_turn_by_two_fingers_and_by_buttons(serve):
    with serve() as server, opened_page(server.address + '#track=1', has_touch=True) as page:
        bounds = page.locator('#top').bounding_box()
        x, y = bounds['x'] + bounds['width'] / 2, bounds['y'] + bounds['height'] / 2
        page.mouse.move(x, y)
        found = []
        for by in (-100, -25, 125):
            before = page.evaluate('view.zoom')
            page.mouse.wheel(0, by)
            page.wait_for_function(f'view.zoom !== {before}')
            found.append(page.evaluate('view.zoom') / before)
        assert found == pytest.approx([1.25, 1.25**0.25, 1.25**-1.25])
        touch = page.context.new_cdp_session(page)

        def fingers(kind, *places):
            points = [{'x': px, 'y': y, 'id': k} for k, px in enumerate(places)]
            touch.send('Input.dispatchTouchEvent', {'type': kind, 'touchPoints': points})

        center = page.evaluate('[...view.center]')
        fingers('touchStart', x - 20)
        fingers('touchStart', x - 20, x + 20)
        fingers('touchMove', x - 40, x + 40)
        fingers('touchEnd')
        page.wait_for_function('Math.abs(view.zoom - 2) < 0.1')
        assert page.evaluate('view.center') == pytest.approx(center, abs=0.4)
        page.click('[data-zoom="0"] >> visible=true')
        assert page.evaluate('view.zoom') == 1
        page.click('[data-zoom="1"] >> visible=true')
        assert page.evaluate('view.zoom') > 1.2
        page.click('#tab-drive')
        page.wait_for_function('scene.sweep')
        zoom = page.evaluate('scene.zoom')
        page.click('[data-zoom="-1"] >> visible=true')
        assert page.evaluate('scene.zoom') < zoom


def test_boxes_are_drawn_copied_and_corrected_in_the_drive(out, serve):
    """By hand from rear to front, from the sweep before, and that below the pointer."""
    with serve() as server, opened_page(server.address + '#track=2') as page:
        page.wait_for_function('view.part')
        page.click('#tab-drive')
        page.evaluate('showScene(4)')
        page.wait_for_function('scene.at === 4 && scene.sweep.stamp === DATA.stamps[4]')
        page.locator('#scene-view').focus()

        def at(x, y):
            return page.evaluate(f"""(() => {{
              const bounds = $('scene-view').getBoundingClientRect();
              const [x, y] = sceneAxes().to([{x}, {y}]);
              return [bounds.left + x, bounds.top + y]; }})()""")

        def drag(first, last):
            page.mouse.move(*at(*first))
            page.mouse.down()
            page.mouse.move(*at(*last), steps=3)
            page.mouse.up()

        sensor = np.array(page.evaluate('scene.sweep.sensor'))
        rear, front = sensor[:2] + np.array([[-6, 8], [-2, 11]])
        page.keyboard.press('i')
        drag(rear, front)
        x, y, _, length, *_, yaw = page.evaluate('scene.fit.box')
        assert [x, y] == pytest.approx(((rear + front) / 2).tolist(), abs=0.15)
        assert [length, yaw] == pytest.approx([5, np.arctan2(3, 4)], abs=0.15)
        page.keyboard.press('Escape')
        # Its own box, moved to the left of where it heads, and turned round.
        page.keyboard.press('e')
        given = page.evaluate('scene.fit.box.slice()')
        left = np.array([-np.sin(given[8]), np.cos(given[8])])
        drag(given[:2], np.array(given[:2]) + 2 * left)
        page.keyboard.press('f')
        moved = page.evaluate('scene.fit.box.slice()')
        np.testing.assert_allclose(np.subtract(moved[:2], given[:2]), 2 * left, atol=0.15)
        assert np.cos(moved[8] - given[8]) == pytest.approx(-1)
        page.locator('#scene-view').focus()
        press(page, 'Enter', 'log.count === 1 && !scene.fit')
        # A copy of its box at the next sweep.
        page.evaluate('showScene(5)')
        page.wait_for_function('scene.at === 5 && scene.sweep.stamp === DATA.stamps[5]')
        page.keyboard.press('c')
        assert page.evaluate('[scene.fit.class, scene.fit.of]') == ['car', '2']
        press(page, 'Enter', 'log.count === 2')
        page.click('#tab-tracks')
        page.wait_for_function('pinOf(4) && pinOf(5)')
    first, second = read_decisions(out / DECISIONS)
    assert [(one.track_id, one.kind) for one in (first, second)] == [('2', 'pin')] * 2
    np.testing.assert_allclose(first.box[:6], moved[:6], atol=1e-6)
    assert np.cos(first.box[8] - moved[8]) == pytest.approx(1)


LIT = """((name, draw, moves = false) => {
  const { gl } = gpuOf($(name)), [w, h] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
  if (!moves) gpuOf($(name)).last = undefined;  // a view that rests has all points
  draw();
  const pixels = new Uint8Array(4 * w * h), found = new Map();
  gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  for (let i = 0; i < pixels.length; i += 4) {
    if (!pixels[i + 3]) continue;
    const key = pixels.slice(i, i + 3).join();
    found.set(key, (found.get(key) ?? 0) + 1);
  }
  return [...found].sort((a, b) => b[1] - a[1]); })"""
"""The colours of the pixels with points, and how many have each."""


def test_points_of_the_drive_have_colours_and_add_up(serve):
    with serve() as server, opened_page(server.address + '#drive') as page:
        page.wait_for_function('scene.sweep')
        if not page.evaluate("Boolean(gpuOf($('scene-points')).gl)"):
            pytest.skip('this Chromium has no WebGL 2')
        plain = page.evaluate(f"{LIT}('scene-points', drawScene)")
        assert sum(count for _, count in plain) > 100
        for mode, least in (('height', 5), ('track', 2), ('status', 1)):
            page.select_option('#scene-colour', mode)
            found = page.evaluate(f"{LIT}('scene-points', drawScene)")
            assert len(found) >= least, mode
            assert found != plain, mode
        style = 'rgbOfStyle(boxColour(scene.boxes[0])).slice(0, 3).join()'
        assert page.evaluate(style) in dict(found)
        page.select_option('#scene-sweeps', '5')
        page.wait_for_function('scene.clouds.length === 5')
        assert sum(n for _, n in page.evaluate(f"{LIT}('scene-points', drawScene)")) > 1.2 * sum(
            n for _, n in found
        )


def test_a_track_is_shown_in_3d_by_the_same_program_and_turned(serve):
    lit = f"{LIT}('space-points', drawSpace)"
    with serve() as server, opened_page(server.address + '#track=2') as page:
        page.wait_for_function('view.cloud')  # with all points of the sweep
        if not page.evaluate("Boolean(gpuOf($('space-points')).gl)"):
            pytest.skip('no WebGL 2')
        before = page.evaluate(lit)
        assert {tuple(map(int, colour.split(','))) for colour, _ in before[:1]} & {
            tuple(page.evaluate("rgbOf('points')"))
        }
        turn, tilt = page.evaluate('[space.turn, space.tilt]')
        bounds = page.locator('#space-lines').bounding_box()
        page.mouse.move(bounds['x'] + 40, bounds['y'] + 60)
        page.mouse.down()
        page.mouse.move(bounds['x'] + 140, bounds['y'] + 80, steps=4)
        page.mouse.up()
        turned = page.evaluate('[space.turn, space.tilt]')
        assert turned == pytest.approx([turn - 0.6, tilt - 0.12])
        assert sum(n for _, n in page.evaluate(lit)) > 0
        # A point and a line at one place are at one pixel.
        page.evaluate('view.local = [[1, 0.4, 0.3]], view.far = [], view.lines = []')
        ((_, count),) = page.evaluate(lit)
        x, y = page.evaluate('spaceAxes().to([1, 0.4, 0.3])')
        places = np.array(
            page.evaluate("""() => {
          const { gl } = gpuOf($('space-points'));
          const [w, h] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
          drawSpace();
          const pixels = new Uint8Array(4 * w * h), at = [];
          gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
          for (let i = 0; i < w * h; i++)
            if (pixels[4 * i + 3]) at.push([i % w, h - 1 - (i / w | 0)]);
          return at; }""")
        )
        assert len(places) == count < 16
        np.testing.assert_allclose(places.mean(0) + 0.5, [x, y], atol=1.5)


def test_fewer_points_are_drawn_while_a_slow_view_moves_and_all_when_it_rests(serve):
    lit = f"{LIT}('scene-points', drawScene).reduce((sum, [, n]) => sum + n, 0)"
    slow = lit.replace('drawScene)', 'drawScene, true)')
    moving = f'(() => {{ gpu.last = performance.now() - 600; return {slow}; }})()'
    with serve() as server, opened_page(server.address + '#drive') as page:
        page.wait_for_function('scene.sweep')
        if not page.evaluate("Boolean(gpuOf($('scene-points')).gl)"):
            pytest.skip('no WebGL 2')
        page.evaluate("window.gpu = gpuOf($('scene-points'))")
        resting = page.evaluate(lit)
        assert page.evaluate(moving) < resting / 2
        # It draws itself again once it rests.
        page.evaluate(
            'window.drawn = 0, window.draw = drawScene, drawScene = () => { drawn++; draw(); }'
        )
        page.wait_for_function('drawn > 0')
        assert page.evaluate(lit) == resting


def test_the_track_follows_a_box_while_it_is_dragged(serve):
    with serve() as server, opened_page(server.address + '#track=2') as page:
        page.evaluate('step(5)')
        page.keyboard.press('e')
        before = page.evaluate('moved(view.edit, view.part.origin, 1)')
        for _ in range(4):
            page.keyboard.press('Shift+ArrowUp')  # 0.4 m to the left
        page.wait_for_function('view.followed && !view.isAsking')
        stamps = page.evaluate('view.part.stamps')
        followed = dict(page.evaluate('[...view.followed]'))
        dragged = page.evaluate('moved(view.edit, view.part.origin, 1)')
        np.testing.assert_allclose(followed[stamps[5]], dragged, atol=1e-6)
        shown = page.evaluate('moved(view.part.usable[6], view.part.origin, 1)')
        left = np.array([-np.sin(before[8]), np.cos(before[8])])
        across = np.subtract(followed[stamps[6]], shown)[:2] @ left
        assert across > 0.02  # the next box is drawn along
        assert 'before and after' in page.inner_text('#legend')
        page.keyboard.press('Escape')
        assert 'before and after' not in page.inner_text('#legend')


def test_a_whole_track_is_turned_round_in_one_step(out, serve):
    with serve() as server, opened_page(server.address + '#track=2') as page:
        shown = 'view.part.usable.map(box => moved(box, view.part.origin, 1))'
        given = np.array(page.evaluate(shown))
        press(page, 't', f'log.count === {NUM_SWEEPS}')
        made = np.array([one.box for one in read_decisions(out / DECISIONS)])
        np.testing.assert_allclose(made[:, :6], given[:, :6], atol=1e-6)
        np.testing.assert_allclose(np.cos(made[:, 8] - given[:, 8]), -1, atol=1e-9)
        press(page, 'z', 'log.held.size === 0')


def test_a_box_set_in_a_deleted_track_stays_when_another_is_restored(serve):
    deleted = f'current().deleted === {NUM_SWEEPS}'
    with serve() as server, opened_page(server.address + '#track=2') as page:
        press(page, 'd', deleted)
        page.evaluate('step(5)')
        page.keyboard.press('e')
        page.keyboard.press('ArrowUp')
        press(page, 'Enter', f'{deleted} - 1')
        page.evaluate('step(3)')
        press(page, 'Shift+D', f'{deleted} - 2')
        assert page.evaluate('[3, 4, 5].map(row => isDeleted(...boxAt(row)))') == [
            False,
            True,
            False,
        ]


def test_classes_have_keys_and_tracks_below_a_risk_are_accepted_at_once(out):
    server = review_server([(out, drive_of(out))], 0, 'anna', ['van', 'cargo bike'])
    with serving(server), opened_page(server.address + '#track=2') as page:
        press(page, '2', "current().class === 'cargo bike'")
        page.keyboard.press('9')  # there is none
        page.keyboard.press('k')
        answer(page, 'vna')
        page.wait_for_function("$('failure').textContent.startsWith('No class vna in the list')")
        page.keyboard.press('k')
        shown = page.locator('#ask-proposals button').all_inner_texts()
        assert shown == ['1 van', '2 cargo bike']
        page.keyboard.press('Escape')
        page.wait_for_selector('#ask[open]', state='detached')
        given = page.evaluate("DATA.tracks.find(track => track.id === '2').class")
        press(page, 'z', f'current().class === {given!r}')
        page.click('#accept-below')
        answer(page, '9')
        page.wait_for_function('TRACKS.every(track => decidedOf(track) === "accept")')
        assert page.inner_text('#notice').startswith('2 tracks accepted')
        press(page, 'z', 'TRACKS.every(track => !decidedOf(track))')
