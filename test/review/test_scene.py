"""The scene of `boxreg review`: whole clouds, and objects that a person adds."""

from contextlib import ExitStack
from dataclasses import replace
import math
import shutil
import signal
import subprocess

from boxreg_ros.cli import main
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.errors import RecordingError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.labels import frames_of
from boxreg_ros.offline.review_command import drive_of
from boxreg_ros.review.decisions import APPLIED, Decision, DecisionLog, DECISIONS, read_decisions
from boxreg_ros.review.fit import drawn, fitted, USUAL_EXTENTS
from boxreg_ros.review.server import review_server
from boxreg_ros.structures import BoxArray
from browser import answer, NEEDS_BROWSER, opened_page, press, serving, show_charts
import numpy as np
import pytest
from ros_messages import Drive

pytest.importorskip('plotly')
QUICK = ['--set', 'solver.rounds=2', '--set', 'sampling.points=64']
FORMATS = ['--formats', 'openlabel,sustechpoints']
NUM_SWEEPS = 14


@pytest.fixture(scope='module')
def drive():
    """Return a drive whose moving car, track 2, the detector has missed."""
    found = Drive(sweeps=NUM_SWEEPS)
    for topic, _, message in found.items:
        if topic == '/boxes':
            message.detections = message.detections[:1]
    return found


@pytest.fixture(scope='module')
def made(drive, tmp_path_factory):
    folder = tmp_path_factory.mktemp('scene')
    recording = drive.write(folder / 'drive')
    command = ['relabel', str(recording), '-o', str(folder / 'out'), '--report', *FORMATS, *QUICK]
    assert main(command) == 0
    return folder / 'out'


@pytest.fixture
def out(made, tmp_path):
    return shutil.copytree(made, tmp_path / 'out')


@pytest.fixture
def serve():
    """Return a function that serves a result with its recording, and returns the server."""
    with ExitStack() as running:
        yield lambda folder: running.enter_context(
            serving(review_server([(folder, drive_of(folder))], 0, 'anna'))
        )


def open_scene(page, at):
    page.click('#tab-drive')
    page.evaluate(f'showScene({at})')
    page.wait_for_function(f'scene.sweep?.stamp === DATA.stamps[{at}]')


def click_at(page, x, y):
    left, top = page.evaluate(f"""(() => {{
      const [x, y] = sceneAxes().to([{x}, {y}]), bounds = $('scene-view').getBoundingClientRect();
      return [bounds.left + x, bounds.top + y]; }})()""")
    page.mouse.click(left, top)


def add_car(page, drive):
    """Add the missed car by a key, a click on its rear, and a key."""
    open_scene(page, 7)
    (x, y, *_), length = drive.truth[drive.stamps[7]][1], drive.truth[drive.stamps[7]][1][3]
    page.keyboard.press('i')
    click_at(page, x - length / 2, y)
    page.wait_for_function('scene.fit')
    page.select_option('#scene-class', 'car')
    page.wait_for_function("scene.fit.class === 'car'")
    page.locator('#scene-view').focus()
    press(page, 'Enter', "!$('tracks').hidden && current()?.id === '2'")


def stamps_of(table, track_id):
    rows = zip(table.stamps_ns, table.track_ids, strict=True)
    return [int(stamp) for stamp, name in rows if name == track_id]


def ious_with_truth(table, drive, track_id):
    truth, boxes = [], []
    for name, stamp, box in zip(table.track_ids, table.stamps_ns, table.boxes, strict=True):
        if name == track_id:
            truth.append(drive.truth[int(stamp)][1])
            boxes.append(box)
    return iou_3d(np.array(boxes), np.array(truth))


@NEEDS_BROWSER
def test_a_missing_object_is_added_corrected_and_in_every_label(drive, out, serve, quick_python):
    server = serve(out)
    with opened_page(server.address) as page:
        add_car(page, drive)
        assert page.evaluate('view.part.stamps.length') == NUM_SWEEPS
        assert 'end of the recording' in page.inner_text('#title')
        (seed,) = read_decisions(out / DECISIONS)
        assert (seed.kind, seed.track_id, seed.value, seed.who) == ('add', '2', 'car', 'anna')
        assert seed.stamp_ns == drive.stamps[7]
        # Undone, and added again.
        press(page, 'z', 'TRACKS.length === 1')
        assert read_decisions(out / DECISIONS)[-1].kind == 'withdraw'
        add_car(page, drive)
        # A correction is a second box that it is followed from.
        page.keyboard.press('Home')
        page.keyboard.press('e')
        page.keyboard.press('Shift+ArrowRight')
        # The object follows the box before it is kept.
        page.wait_for_function('view.followed && !view.isAsking')
        moved = page.evaluate("""[0, 1].map(row =>
          moved(view.part.usable[row], view.part.origin, 1).map((v, k) =>
            view.followed.get(view.part.stamps[row])[k] - v).slice(0, 2))""")
        assert (np.linalg.norm(moved, axis=1) > 0.01).all()
        press(page, 'Enter', "view.part.status.filter(one => one === 'human').length === 2")
        assert page.evaluate('view.row') == 0
        assert 'human' in page.inner_text('#clock')
        show_charts(page)
        page.evaluate('step(5)')
        press(page, 'Shift+D', 'current().deleted === 1')
        page.keyboard.press('k')
        answer(page, 'van')
        page.wait_for_function("current().class === 'van'")
        page.keyboard.press('r')
        assert 'no input to keep' in page.inner_text('#failure')
        # The page opened again follows it again.
        page.reload()
        page.wait_for_selector('html[data-ready]')
        assert page.evaluate('TRACKS.map(track => [track.id, track.class])') == [
            ['1', 'car'],
            ['2', 'van'],
        ]
        press(page, 'Control+s', "$('notice').textContent.includes('boxes in')")
    again = out.with_name('out.corrected')
    table = BoxTable.read(again / 'boxes.csv')
    rows = [row for row, name in enumerate(table.track_ids) if name == '2']
    stamps = stamps_of(table, '2')
    assert stamps == [stamp for stamp in drive.stamps if stamp != drive.stamps[5]]
    kinds = [table.status[row] for row in rows]
    assert [stamps[k] for k, kind in enumerate(kinds) if kind == 'human'] == [
        drive.stamps[0],
        drive.stamps[7],
    ]
    assert set(kinds) == {'human', 'interpolated', 'extended'}
    assert {table.class_names[row] for row in rows} == {'van'}
    assert np.median(ious_with_truth(table, drive, '2')) > 0.7
    frames = [frame.refined.boxes for frame in frames_of('openlabel', again / 'openlabel')]
    assert [boxes.stamp_ns for boxes in frames if '2' in boxes.track_ids] == stamps
    texts = [path.read_text() for path in sorted((again / 'sustechpoints').rglob('label/*.json'))]
    assert [text.count('"van"') for text in texts] == [int(row != 5) for row in range(NUM_SWEEPS)]
    # The review goes on in the new folder: the object is there once, and can be corrected.
    with opened_page(serve(again).address + '#track=2') as page:
        assert sorted(page.evaluate('TRACKS.map(track => track.id)')) == ['1', '2']
        page.evaluate('step(11)')
        page.keyboard.press('e')
        page.keyboard.press('PageUp')
        press(page, 'Enter', "view.part.status.filter(one => one === 'human').length === 3")
    assert read_decisions(again / DECISIONS)[-1].kind == 'add'


def click_on_points(page, box):
    """Click a point of an object where the view shows it, and wait for its box."""
    x, y = page.evaluate(
        """box => {
          const { points, origin } = scene.sweep, { to, depth } = sceneAxes(), own = [];
          for (let i = 0; i < points.length; i += 3) {
            const point = [0, 1, 2].map(k => points[i + k] + origin[k]);
            const at = toFrame(point, box, rotation(box));
            if (Math.abs(at[0]) < box[3] / 2 + 0.1 && Math.abs(at[1]) < box[4] / 2 + 0.1
                && at[2] > 0) own.push(point);
          }
          own.sort((a, b) => depth(a) - depth(b));
          const [x, y] = to(own[0]), bounds = $('scene-view').getBoundingClientRect();
          return [bounds.left + x, bounds.top + y]; }""",
        box.tolist(),
    )
    page.mouse.click(x, y)
    page.wait_for_function('scene.fit')


@NEEDS_BROWSER
def test_a_drive_without_boxes_is_labelled_from_its_recording_alone(tmp_path, preloaded_python):
    drive = Drive(sweeps=NUM_SWEEPS)
    drive.items = [item for item in drive.items if item[0] != '/boxes']
    drive.write(tmp_path / 'drive')
    command = [preloaded_python, '-m', 'boxreg_ros.cli', 'review', 'drive', '--port', '0']
    command += [*FORMATS, *QUICK, '--who', 'anna']
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=tmp_path) as process,
        ExitStack() as ending,
    ):
        ending.callback(process.kill)  # also where an assertion fails
        lines = [process.stdout.readline().strip() for _ in range(2)]
        assert lines[0].startswith('drive.labels: 0 boxes in')
        with opened_page(lines[1]) as page:
            # There is nothing but the drive to look at.
            page.wait_for_function(f'scene.sweep && DATA.stamps.length === {NUM_SWEEPS}')
            page.click('#tab-tracks')
            assert 'Objects are added in Drive' in page.inner_text('#rows-hint')
            open_scene(page, 4)
            page.locator('#scene-view').focus()
            # In 3D, turned by dragging: the point that is clicked has a place on the road.
            page.keyboard.press('v')
            assert page.get_attribute('#scene-space', 'aria-pressed') == 'true'
            bounds = page.locator('#scene-view').bounding_box()
            turn, tilt = page.evaluate('[scene.turn, scene.tilt]')
            page.keyboard.down('Shift')
            page.mouse.move(bounds['x'] + 30, bounds['y'] + 30)
            page.mouse.down()
            page.mouse.move(bounds['x'] + 130, bounds['y'] + 10, steps=4)
            page.mouse.up()
            page.keyboard.up('Shift')
            assert page.evaluate('[scene.turn, scene.tilt]') == pytest.approx(
                [turn - 0.6, tilt + 0.12]
            )
            parked, moving = drive.truth[drive.stamps[4]]
            page.keyboard.press('i')
            click_on_points(page, parked)
            offered = np.array(page.evaluate('scene.fit.box'))
            assert np.linalg.norm(offered[:2] - parked[:2]) < 1.5
            press(page, 'Enter', "!$('tracks').hidden && current()?.id === '1'")
            # From a track, at its sweep.
            page.wait_for_function('view.row === 4')
            press(page, 'i', 'scene.isAdding && scene.sweep.stamp === DATA.stamps[4]')
            click_on_points(page, moving)
            page.select_option('#scene-class', 'car')
            page.wait_for_function("scene.fit?.class === 'car'")
            page.click('#scene-follow')
            page.wait_for_function("!$('tracks').hidden && current()?.id === '2'")
            assert 'end of the recording' in page.inner_text('#title')
            page.keyboard.press('Control+s')
            page.wait_for_function("$('notice').textContent.includes('boxes in')")
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    assert process.returncode == 0
    table = BoxTable.read(tmp_path / 'drive.labels.corrected' / 'boxes.csv')
    assert {name: len(stamps_of(table, name)) for name in '12'} == dict.fromkeys('12', NUM_SWEEPS)
    assert np.median(ious_with_truth(table, drive, '2')) > 0.6
    assert len(list((tmp_path / 'drive.labels.corrected' / 'sustechpoints').rglob('*.json'))) > 0


@NEEDS_BROWSER
def test_whole_clouds_are_shown_in_the_scene_and_in_a_track(drive, made, out, serve):
    with opened_page(serve(out).address) as page:
        open_scene(page, 3)
        # All points of the sweep: those of both cars, one of which has no box.
        assert page.evaluate('[scene.sweep.points.length, scene.boxes.length]') == [720, 1]
        press(page, ' ', f'scene.at === {NUM_SWEEPS - 1} && !scene.isPlaying')
        press(page, 'Home', 'scene.at === 0 && scene.sweep.stamp === DATA.stamps[0]')
        box = drive.truth[drive.stamps[0]][0]
        click_at(page, box[0], box[1])
        page.wait_for_function("!$('tracks').hidden && view.cloud")
        assert page.evaluate('[current().id, view.row, view.far.length]') == ['1', 0, 240]
        # All sweeps of the parked car, from whole clouds, on its sides.
        page.select_option('#mode', 'after')
        page.wait_for_function('view.accumulated?.points')
        points = np.array(page.evaluate('view.local'))
        assert len(points) > 0.5 * 120 * NUM_SWEEPS
        half = np.array(page.evaluate('view.frame.slice(3, 6)')) / 2
        assert np.median(np.abs(np.abs(points) - half)[:, :2].min(1)) < 0.1
    # The run proposes the car that has no box: two keys add it.
    stamp = drive.stamps[6]
    columns = ('2',), ('van',), np.ones(1), drive.truth[stamp][1][None]
    BoxTable.from_arrays([BoxArray(stamp, 'odom', *columns)]).write(out / 'proposals.csv')
    with opened_page(serve(out).address) as page:
        open_scene(page, 0)
        assert page.inner_text('#scene-proposals option') == '1 proposed'
        page.locator('#scene-view').focus()
        press(page, 'p', 'scene.fit')
        press(page, 'Enter', "!$('tracks').hidden && current()?.class === 'van'")
        assert page.evaluate('[view.row, openProposals().length]') == [6, 0]
    (out / DECISIONS).unlink()
    narrow = {'viewport': {'width': 390, 'height': 844}, 'color_scheme': 'dark'}
    with opened_page(serve(out).address, **narrow) as page:
        open_scene(page, 2)
        assert page.evaluate('document.documentElement.scrollWidth - innerWidth') <= 0
        assert page.locator('#scene-view').bounding_box()['height'] > 300
    recording = made.with_name('drive')
    recording.rename(out.with_name('moved'))
    with opened_page(serve(out).address, expected='400') as page:
        page.click('#tab-drive')
        page.wait_for_selector('#failure:not([hidden])')
        text = page.inner_text('#failure')
        assert str(recording) in text and 'Put the recording back' in text
        page.click('#tab-tracks')
        press(page, 'a', 'log.count === 1')
    out.with_name('moved').rename(recording)


def test_a_run_follows_added_objects_beside_its_other_steps(drive, tmp_path, capsys):
    recording = drive.write(tmp_path / 'drive')
    stamp, box = drive.stamps[4], drive.truth[drive.stamps[4]][1]
    added = Decision('new', stamp, 'add', frame_id='odom', box=box, value='car', who='anna')
    late = Decision('late', stamp + 10**12, 'add', frame_id='odom', box=box, value='car')
    gone = Decision('new', drive.stamps[9], 'delete', end_ns=drive.stamps[10])
    wrong = Decision('new', drive.stamps[11], 'reject')
    joined = Decision('new', drive.stamps[12], 'rename', end_ns=drive.stamps[13], value='end')
    path = tmp_path / DECISIONS
    DecisionLog(path).append([added, late, gone, wrong, joined])
    command = ['relabel', str(recording), *QUICK, '--decisions', str(path), '-o']
    for name, more in (('plain', []), ('complete', ['--complete'])):
        out = tmp_path / name
        assert main([*command, str(out), *more]) == 1  # one decision is not used, and named
        assert "'late' at " in capsys.readouterr().err.splitlines()[-1]
        table = BoxTable.read(out / 'boxes.csv')
        assert stamps_of(table, '1') == drive.stamps
        assert stamps_of(table, 'new') == drive.stamps[:9]
        assert stamps_of(table, 'end') == drive.stamps[12:]
        (row,) = np.flatnonzero((table.stamps_ns == stamp) & (np.array(table.track_ids) == 'new'))
        assert table.status[row] == 'human'
        np.testing.assert_allclose(table.boxes[row], box, atol=1e-6)
        assert np.median(ious_with_truth(table, drive, 'new')) > 0.8
    applied = read_decisions(tmp_path / 'plain' / APPLIED)  # its class, to later runs
    classes = {one.track_id: one.value for one in applied if one.kind == 'reclass'}
    assert classes == {'new': 'car', 'end': 'car'}
    again = tmp_path / 'again'  # its labels have what was added: it is not added twice
    assert main([*command, str(again), '--labels', f'csv:{tmp_path}/plain']) == 1
    assert "'new' at " in capsys.readouterr().err.splitlines()[-1]
    table = BoxTable.read(again / 'boxes.csv')
    assert len(set(zip(table.track_ids, table.stamps_ns, strict=True))) == len(table.stamps_ns)
    other = tmp_path / 'other.csv'
    DecisionLog(other).append([replace(added, frame_id='map')])
    assert main([*command[:-3], '--decisions', str(other), '-o', str(tmp_path / 'other')]) == 1
    assert "expected frame 'odom', got 'map'" in capsys.readouterr().err


def road_and_vehicle(rng, yaw, center, size):
    """Return points of a road, and of the side and the rear of a vehicle on it."""
    road = np.column_stack([rng.uniform(-15, 25, (4000, 2)), rng.normal(0, 0.02, 4000)])
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    local = rng.uniform(-0.5, 0.5, (600, 2)) * size[:2]
    local[:400, 1] = -size[1] / 2
    local[400:, 0] = -size[0] / 2
    return road, np.column_stack([local @ turn.T + center, rng.uniform(0.2, size[2], 600)])


def test_a_box_is_fitted_to_the_points_at_a_place():
    rng = np.random.default_rng(3)
    yaw, center, size = math.radians(20), np.array([12.0, 4.0]), np.array([4.4, 1.8, 1.5])
    road, car = road_and_vehicle(rng, yaw, center, size)
    post = np.column_stack([rng.normal([12, 8], 0.05, (50, 2)), rng.uniform(0.3, 2, 50)])
    points = np.concatenate([road, car, post])
    sizes = {'car': size, 'bus': np.array([12.0, 2.6, 3.2])}
    sensor = np.zeros(2)
    found = fitted(points, car[0, :2], sensor, 0.0, sizes)
    assert found.class_name == 'car'
    assert found.num_points > 550  # not the road below it, nor the post
    truth = np.array([*center, 0.75, *size, 0, 0, yaw])
    assert iou_3d(found.box[None], truth[None])[0] > 0.85
    # Close to the sensor neither the road around it nor its lower half is seen.
    upper = np.concatenate([road[np.abs(road[:, :2] - center).max(1) > 5], car[car[:, 2] > 0.8]])
    beside = fitted(upper, car[0, :2], sensor, 0.0, {'car': size}).box
    assert beside[2] - beside[5] / 2 == pytest.approx(0, abs=0.1)
    # By the heading of the sensor it is the other way round.
    turned = fitted(points, car[0, :2], sensor, math.pi, sizes).box[8]
    assert abs(math.cos(turned - yaw) + 1) < 0.01
    with pytest.raises(RecordingError, match='expected points of an object'):
        fitted(points, np.array([20.0, -10.0]), sensor, 0.0, sizes)


def test_a_box_is_drawn_with_the_class_the_width_and_the_height_of_its_points():
    """A van half as high again as a car, whose roof is not seen, and an object of no points."""
    yaw, center, size = math.radians(30), np.array([12.0, 4.0]), np.array([5.2, 2.0, 2.4])
    road, van = road_and_vehicle(np.random.default_rng(5), yaw, center, size)
    points = np.concatenate([road, van])
    half = size[0] / 2 * np.array([np.cos(yaw), np.sin(yaw)])
    found = drawn(points, center - half, center + half, USUAL_EXTENTS)
    truth = np.array([*center, size[2] / 2, *size, 0, 0, yaw])
    assert iou_3d(found.box[None], truth[None])[0] > 0.9
    assert found.class_name == 'car'
    empty = drawn(road, np.array([-8.0, 0]), np.array([-8.0, 1.8]), USUAL_EXTENTS)
    assert empty.class_name == 'cyclist'
    np.testing.assert_allclose(empty.box[3:6], [1.8, 0.7, 1.7])
    assert empty.box[2] - 0.85 == pytest.approx(0, abs=0.1)
