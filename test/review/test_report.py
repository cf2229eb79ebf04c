"""`boxreg relabel --report`: one self-contained page with the numbers of the run."""

import base64
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
import json
from pathlib import Path
import sys
import zlib

from boxreg_ros.cli import main
from boxreg_ros.config import Config
from boxreg_ros.core.matching import StampMatcher
from boxreg_ros.errors import BoxregError, ConfigError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.notes import closing_line
from boxreg_ros.offline.progress import Progress
from boxreg_ros.offline.relabel import relabel, Request
from boxreg_ros.review.changes import Changes
from boxreg_ros.review.quality import quality
from boxreg_ros.review.report import write_report
from boxreg_ros.review.rules import RULES, Violation
from boxreg_ros.review.tables import assessed
from boxreg_ros.review.track_points import PointCollector
from boxreg_ros.rotations import matrix_from_rpy, wrap_angle
from boxreg_ros.structures import BoxArray, RefinedBoxes, Sweep
from browser import NEEDS_BROWSER, opened_page
from msg_adapters.convention import Convention
import numpy as np
from paths import BAGS
import pytest
from relabel_results import rows_in
from ros_messages import Drive, JSK
from scenes import drive, jittered, PERIOD_NS, START_NS, track_of

pytest.importorskip('plotly')
STREET = BAGS / 'street.mcap'
QUICK = Config().updated({'solver.rounds': 1, 'sampling.points': 64})
SCRIPT = '<script>alert(1)</script>'


class Page(HTMLParser):
    """The text of a page, its links and tags, and the data that its script reads."""

    def __init__(self, path):
        super().__init__()
        self.words, self.links, self.tags, self.scripts = [], [], [], {}
        self.script_id = None
        self.source = path.read_text(encoding='utf-8')
        self.feed(self.source)
        self.text = ' '.join(' '.join(self.words).split())
        self.data = self.inflated('data')
        self.rows = {row['id']: row for row in self.data['tracks']}

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        attrs = dict(attrs)
        self.links += [attrs[name] for name in ('href', 'src') if name in attrs]
        self.script_id = attrs.get('id', '') if tag == 'script' else None

    def handle_data(self, data):
        if self.script_id is None:
            self.words.append(data)
        else:
            self.scripts[self.script_id] = self.scripts.get(self.script_id, '') + data

    def inflated(self, name):
        """Return the data of a script element."""
        return json.loads(zlib.decompress(base64.b64decode(self.scripts[name])))

    def part(self, track_id):
        """Return the boxes and points of a track."""
        return self.inflated(f'part-{list(self.rows).index(track_id)}')


def run(path, out, **options):
    """Relabel quickly with a report; return the summary and the page."""
    config = options.pop('config', QUICK)
    request = Request((Path(path),), formats=('csv',), config=config, report=True, **options)
    summary = relabel(request, Path(out))
    return summary, Page(Path(out) / 'report.html')


@pytest.fixture(scope='module')
def street(tmp_path_factory):
    out = tmp_path_factory.mktemp('street') / 'out'
    config = Config().updated({'window': 9, 'lag': 8})
    return out, *run(STREET, out, config=config, truth=BAGS / 'street_truth.csv')


def test_page_needs_no_other_file(street):
    out, _, page = street
    assert sorted(item.name for item in out.iterdir()) == [
        'boxes.csv', 'config.yaml', 'covariances.csv', 'input_model.json', 'report.html',
        'review.csv', 'summary.json', 'tracks.csv', 'velocities.csv',
    ]  # fmt: skip
    assert all(link.startswith(('#', 'data:')) for link in page.links)
    assert not set(page.tags) & {'iframe', 'object', 'img'}
    assert (out / 'report.html').stat().st_size < 5e6
    assert b'plotly.js' in zlib.decompress(base64.b64decode(page.scripts['plotly']))[:200]


def test_numbers_agree_with_the_summary(street):
    out, summary, page = street
    before = replace(summary, seconds={'total': 0.0})
    assert closing_line(before, out).split(' in 0.0 s')[0] in page.text
    rows = page.data['tracks']
    assert sum(row['boxes'] for row in rows) == summary.boxes_in
    assert sum(row['flips'] for row in rows) == summary.heading_flips > 0
    review = rows_in(out / 'review.csv')
    assert [row['id'] for row in rows] == [row['track_id'] for row in review]
    assert [row['risk'] for row in rows] == [float(row['risk_m']) for row in review]
    assert [row['riskiest'] for row in rows] == [row['stamp_ns'] for row in review]
    assert [row['why'] for row in rows] == [row['reasons'] for row in review]
    violated = Counter(rule for row in rows for rule, *_ in row['rules'])
    assert violated == +Counter(summary.rules['after'])
    for name, count in summary.reasons.items():
        assert f'{name} {count}' in page.text
    for name, before in summary.rules['before'].items():
        after = summary.rules['after'][name]
        is_shown = before > 0 or after > 0
        assert (f'{name} warning {before} {after}' in page.text) == (
            is_shown and RULES[name].severity == 'warning'
        )
    assert 'Rules violated' in page.text
    input_total, refined_total = page.data['total']
    assert refined_total['flips'] == 0 < input_total['flips']
    for name in ('jitter', 'yaw_jitter', 'size_spread', 'cells'):
        assert refined_total[name] < 0.9 * input_total[name]
    assert refined_total['iou'] > input_total['iou'] > 0.5
    for name in ('window: 9', 'lag: 8'):
        assert name in page.text
    assert 'solver.rounds' not in page.text
    assert 'report' in summary.seconds


def test_part_holds_the_boxes_and_points_of_its_track(street):
    out, _, page = street
    table = BoxTable.read(out / 'boxes.csv')
    track_id = max(page.rows, key=lambda name: page.rows[name]['points'])
    part = page.part(track_id)
    rows = [i for i, name in enumerate(table.track_ids) if name == track_id]
    assert part['stamps'] == [str(table.stamps_ns[i]) for i in rows]
    boxes = np.array(part['boxes'])
    boxes[:, :3] += part['origin']
    turn = wrap_angle(boxes[:, 6:] - table.boxes[rows, 6:])
    np.testing.assert_allclose(boxes[:, :6], table.boxes[rows, :6], atol=1e-3)
    np.testing.assert_allclose(turn, 0, atol=1e-3)
    offsets = np.frombuffer(base64.b64decode(part['points']), '<i2').reshape(-1, 3) / 1000
    assert len(offsets) == sum(part['counts'])
    # Most points lie near a face of the box they belong to.
    owner = np.repeat(range(len(rows)), part['counts'])
    local = np.einsum('ni,nij->nj', offsets, matrix_from_rpy(boxes[owner, 6:]))
    outside = (np.abs(local) - boxes[owner, 3:6] / 2).max(axis=1)
    assert np.mean(np.abs(outside) < 0.15) > 0.6


def spoiled(drive):
    """Add unusual boxes, ids and classes to the two tracks of a drive."""
    pose = ((-30.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    for topic, stamp, message in drive.items:
        if topic != '/boxes':
            continue
        k = drive.stamps.index(stamp)
        message.detections[1].id = SCRIPT
        for result in message.detections[1].results:
            result.hypothesis.class_id = '<b>$car$</b>'
        more = [('empty', 'car', 0.5, *pose, (4.0, 2.0, 1.5))]
        if k == 7:
            more += [
                ('once', 'car', 0.5, *pose, (4.0, 2.0, 1.5)),
                ('flat', 'car', 0.5, *pose, (4.0, 0.0, 1.5)),
                ('nowhere', 'car', 0.5, (np.nan, 0.0, 0.0), pose[1], (4.0, 2.0, 1.5)),
                ('', 'car', 0.5, *pose, (4.0, 2.0, 1.5)),
                ('1', 'car', 0.5, *pose, (4.0, 2.0, 1.5)),
            ]
        message.detections += drive.messages.detections(stamp, 'lidar', more).detections
        if k in (9, 10):
            del message.detections[0]
    gone = drive.stamps[:4]
    drive.items = [item for item in drive.items if item[0] != '/tf' or item[1] not in gone]
    return drive


@pytest.mark.filterwarnings('error::RuntimeWarning')
def test_unusual_boxes_are_counted_and_escaped(tmp_path):
    recording = spoiled(Drive(sweeps=18)).write(tmp_path / 'drive')
    config = QUICK.updated({'complete.fill': True})
    summary, page = run(recording, tmp_path / 'out', config=config)
    assert summary.status['interpolated'] == 2
    assert set(summary.reasons) >= {
        'no_transform', 'invalid_box', 'no_track_id', 'no_points',
    }  # fmt: skip
    assert SCRIPT not in page.source
    assert set(page.rows) == {SCRIPT, '1', '1_2', 'empty', 'once', 'flat', 'nowhere', ''}
    assert page.rows[SCRIPT]['class'] == '<b>$car$</b>'
    assert page.rows['1']['boxes'] == 16
    assert page.rows['1']['interpolated'] == 2
    part = page.part('1')
    shown = zip(part['status'], part['counts'], strict=True)
    assert [count > 10 for word, count in shown if word == 'interpolated'] == [True, True]
    assert page.rows['flat']['shift'] is None
    assert sum(row['boxes'] for row in page.rows.values()) == summary.boxes_in
    assert page.text.count('First missing transform') == 1
    parts = [page.part(name) for name in page.rows]
    assert [len(part['stamps']) > 0 for part in parts] == [True] * 8


@pytest.mark.filterwarnings('error::RuntimeWarning')
@pytest.mark.parametrize('kind', ['no boxes', 'another frame', 'no points'])
def test_page_of_a_run_that_refined_nothing(tmp_path, kind):
    drive = Drive(sweeps=11)
    for topic, _, message in drive.items:
        for detection in message.detections if topic == '/boxes' else ():
            message.header.frame_id = 'radar' if kind == 'another frame' else 'lidar'
            detection.header.frame_id = message.header.frame_id
            detection.bbox.center.position.x -= 200.0
        if topic == '/boxes' and kind == 'no boxes':
            message.detections = []
    summary, page = run(drive.write(tmp_path / 'drive'), tmp_path / 'out')
    assert 'refined' not in summary.status
    assert ('No box was refined' in page.text) == (kind != 'no boxes')
    assert all(row['shift'] is None for row in page.rows.values())
    assert bool(page.rows) == (kind != 'no boxes')


def test_points_are_found_for_label_files_and_associated_ids(tmp_path):
    recording = Drive(sweeps=12).write(tmp_path / 'drive', 'sqlite3')
    nameless = Drive(sweeps=12, boxes=JSK).write(tmp_path / 'nameless', 'rosbag1')
    run(recording, tmp_path / 'out')
    labels = 'csv', tmp_path / 'out' / 'boxes.csv'
    for path, options in (
        (recording, {'labels': labels}), (nameless, {'convention': Convention(associate=True)}),
    ):  # fmt: skip
        _, page = run(path, tmp_path / 'more', **options)
        assert all(row['after']['cells'] > 100 for row in page.rows.values())


def test_report_is_off_by_default_and_part_of_the_fingerprint(tmp_path):
    recording = Drive(sweeps=4).write(tmp_path / 'drive')
    plain = Request((recording,), config=QUICK)
    summary = relabel(plain, tmp_path / 'out')
    assert not (tmp_path / 'out' / 'report.html').exists()
    assert 'report' not in summary.seconds
    assert Request((recording,), config=QUICK, report=True).fingerprint() != plain.fingerprint()


@pytest.mark.parametrize('package', ['jinja2', 'plotly'])
def test_missing_package_is_refused_before_reading(tmp_path, monkeypatch, capsys, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ConfigError, match=f'pip install {package}'):
        Request((Path('nothing'),), report=True)
    assert main(['relabel', 'nothing', '-o', str(tmp_path / 'out'), '--report']) == 2
    assert f'--report needs {package}: pip install {package}' in capsys.readouterr().err


def test_progress_ends_with_the_recording(tmp_path):
    shown = []
    request = Request((Drive(sweeps=4).write(tmp_path / 'drive'),), config=QUICK, report=True)
    progress = Progress()
    progress.show = lambda done, total: shown.append(done / total)
    relabel(request, tmp_path / 'out', progress)
    assert shown == sorted(shown)
    assert shown[-1] == pytest.approx(1.0)


def test_truth_of_another_drive_is_left_out_with_a_warning(tmp_path, capsys):
    recording = Drive(sweeps=6).write(tmp_path / 'drive')
    table = BoxTable.read(BAGS / 'street_truth.csv')
    truth = tmp_path / 'truth.csv'
    replace(table, stamps_ns=table.stamps_ns - 10**17).write(truth)
    out = tmp_path / 'out'
    options = ['-o', out, '--report', '--truth', truth, '--set', 'solver.rounds=1']
    assert main([str(word) for word in ('relabel', recording, *options)]) == 0
    (line,) = [line for line in capsys.readouterr().err.splitlines() if 'truth' in line]
    for word in (str(truth), 'expected', 'got', '--truth'):
        assert word in line
    assert not Page(out / 'report.html').data['has_truth']


def test_truth_with_rounded_stamps_is_that_of_the_boxes(tmp_path, capsys):
    """Stamps in milliseconds; the boxes of the truth are those of the result."""
    drive = Drive(sweeps=6, start=1_700_000_000_000_456_789)
    recording = drive.write(tmp_path / 'drive')
    true = [
        BoxArray(stamp // 10**6 * 10**6, 'odom', ('1', '2'), ('car', 'car'), np.ones(2), boxes)
        for stamp, boxes in drive.truth.items()
    ]
    BoxTable.from_arrays(true, 'truth').write(tmp_path / 'truth.csv')
    options = ['-o', tmp_path / 'out', '--report', '--truth', tmp_path / 'truth.csv']
    words = ['relabel', recording, *options, '--set', 'solver.rounds=1']
    assert main([str(word) for word in words]) == 0
    expected = '6 of 6 stamps of the true boxes are up to 456.789 us from those of the results'
    assert expected in capsys.readouterr().err
    page = Page(tmp_path / 'out' / 'report.html')
    assert page.data['has_truth']
    assert len(page.part('1')['truth']) == 6


def test_truth_and_input_models_that_cannot_be_read_are_refused_before_the_work(tmp_path):
    recording = Drive(sweeps=6).write(tmp_path / 'drive')
    junk = tmp_path / 'junk'
    junk.write_text('no table')
    shown = Progress()
    shown.show = lambda *_: pytest.fail('the recording was read')
    for options in ({'report': True, 'truth': junk}, {'keyframes': True, 'input_model': (junk,)}):
        with pytest.raises(BoxregError, match='junk'):
            relabel(Request((recording,), **options), tmp_path / 'out', shown)


def test_risks_and_violations_of_each_track_are_shown(tmp_path):
    truth = drive(12)
    (found,) = assessed(changes_of(truth, truth))
    violated = {'jump': [Violation('7', 12, 'centre 3 m off'), Violation('8', 12, 'another')]}
    points = PointCollector(Config())
    write_report(tmp_path, 'done', SUMMARY, Config(), [found], violated, points)
    page = Page(tmp_path / 'report.html')
    assert page.rows['7']['rules'] == [['jump', '12', 'centre 3 m off']]
    assert page.rows['7']['why'] == found.reasons
    assert page.rows['7']['risk'] == pytest.approx(found.risk.track, abs=1e-3)
    part = page.part('7')
    np.testing.assert_allclose(part['risk'], found.risk.boxes, atol=1e-3)
    assert page.rows['7']['riskiest'] == part['stamps'][np.argmax(found.risk.boxes)]


@NEEDS_BROWSER
def test_long_names_do_not_push_columns_out_of_view(tmp_path):
    truth = drive(12)
    (track,) = assessed(changes_of(truth, truth))
    found = [track._replace(track=replace(track.track, class_name='vehicle_' * 30))]
    write_report(tmp_path, 'done', SUMMARY, Config(), found, {}, PointCollector(Config()))
    with opened_page((tmp_path / 'report.html').as_uri()) as page:
        width, room = page.evaluate(
            "[$('first').offsetWidth, $('first').parentElement.clientWidth]"
        )
        named = page.evaluate("['7_2', '0b9c7c1e-5d64-4f0b-9b0e-2f1f5cc6a701'].map(shortId)")
    assert 0 < width <= room
    assert named == ['7_2', '…c6a701']  # on map and timeline


@NEEDS_BROWSER
def test_a_thousand_tracks_are_listed_without_laying_out_all(tmp_path):
    changes = Changes('odom')
    names = tuple(map(str, range(1000)))
    boxes = np.tile([0.0, 0, 0, 4, 2, 1.5, 0, 0, 0], (1000, 1))
    boxes[:, 0] = 10.0 * np.arange(1000)
    for k in range(20):
        moved = boxes.copy()
        moved[:, 0] += 0.1 * k
        array = BoxArray(
            START_NS + k * PERIOD_NS, 'odom', names, ('car',) * 1000, np.ones(1000), moved
        )
        covariances = np.tile(0.01 * np.eye(6), (1000, 1, 1))
        counts = np.full(1000, 9)
        changes.add(
            array, RefinedBoxes(array, ('refined',) * 1000, ('',) * 1000, counts, covariances)
        )
    found = assessed(changes.tracks())
    write_report(tmp_path, 'done', SUMMARY, Config(), found, {}, PointCollector(Config()))
    with opened_page((tmp_path / 'report.html').as_uri() + '#tracks') as page:
        lines = page.locator('#rows tr[data-track]')
        assert page.inner_text('#f-count') == '1000 of 1000 tracks'
        assert 10 < lines.count() < 100
        assert page.evaluate("$('rows').scrollHeight") > 1000 * page.evaluate('LINE')
        widths = page.evaluate(
            "[...document.querySelectorAll('#rows th')].map(t => t.offsetWidth)"
        )
        page.evaluate('openTrack(998)')
        page.wait_for_selector('tr[data-track="998"][aria-selected=true]')
        page.keyboard.press('ArrowDown')
        page.wait_for_selector('tr[data-track="999"][aria-selected=true]')
        assert lines.count() < 100
        again = page.evaluate("[...document.querySelectorAll('#rows th')].map(t => t.offsetWidth)")
        assert again == widths  # the columns do not move
        page.fill('#f-text', '123')
        assert page.inner_text('#f-count') == '1 of 1000 tracks'
        assert lines.count() == 1


# Known values ------------------------------------------------------------------------------------


def changes_of(given, boxes, status='refined', stamps_ns=None, spread=0.01):
    """Return the changes of a track '7' with input and result (n, 9)."""
    changes = Changes('odom')
    n = len(boxes)
    stamps_ns = START_NS + PERIOD_NS * np.arange(n) if stamps_ns is None else stamps_ns
    for k in range(n):
        before, after = (
            BoxArray(int(stamps_ns[k]), 'odom', ('7',), ('car',), np.ones(1), part[k : k + 1])
            for part in (given, boxes)
        )
        covariances = np.diag([4 * spread, spread, spread, 0, 0, spread])[None]
        why = '' if status == 'refined' else 'no_gain'
        changes.add(before, RefinedBoxes(after, (status,), (why,), np.array([9]), covariances))
    return changes.tracks()


def test_changes_are_along_the_box_axes_without_half_turns():
    boxes = drive(12)
    heading = np.c_[np.cos(boxes[:, 8]), np.sin(boxes[:, 8])]
    given = boxes.copy()
    given[:, :2] -= 0.3 * heading + 0.4 * np.c_[-heading[:, 1], heading[:, 0]]
    given[:, 8] -= np.radians(2)
    given[3, 8] += np.pi
    (track,) = changes_of(given, boxes)
    expected = np.tile([0.3, 0.4, 0, np.radians(2)], (12, 1))
    np.testing.assert_allclose(track.change, expected, atol=1e-9)
    assert np.flatnonzero(track.is_flipped).tolist() == [3]
    assert track.shift == pytest.approx(0.5)
    assert track.turn == pytest.approx(2.0)
    assert track.deviation == pytest.approx(np.sqrt(0.05))  # independent of the heading
    cos, sin = heading[5]
    along = np.sqrt(0.04 * cos**2 + 0.01 * sin**2)
    assert track.deviations[5] == pytest.approx([along, np.sqrt(0.05 - along**2), 0.1, 0.1])
    (kept,) = changes_of(boxes, boxes, status='kept')
    assert np.isnan(kept.shift)


SUMMARY = {
    'rules': {'before': dict.fromkeys(RULES, 0), 'after': dict.fromkeys(RULES, 0)},
    'recordings': ['drive.mcap'], 'topics': {}, 'labels': None, 'fixed_frame': 'odom',
    'sweeps': 30, 'box_arrays': 30, 'boxes_in': 30, 'status': {'refined': 30}, 'reasons': {},
    'heading_flips': 0, 'dropped': {}, 'first_missing_transform': '', 'first_unreadable': '',
    'warning': '', 'ids': 'of the input', 'left_out_of_labels': {}, 'versions': {}, 'seconds': {},
}  # fmt: skip


def cells_of(tracks, items, config=None):
    """Return the number of cells that the points of the track fill before and after."""
    collector = PointCollector(config or Config())
    matcher = StampMatcher(Config(), Counter())
    for item in items:
        collector.note(item)
        add = matcher.add_sweep if isinstance(item, Sweep) else matcher.add_boxes
        for pair in add(item):
            collector.gather(pair.boxes, pair.sweep)
    for pair in matcher.flush():
        collector.gather(pair.boxes, pair.sweep)
    (track,) = tracks
    unknown = np.full(len(track.boxes), np.nan)
    points = collector.points_of(track)
    boxes = track.given, track.boxes
    return [quality(track, part, points, unknown).cells for part in boxes]


def streamed(track, late_ns=()):
    """Yield sweeps and boxes of a `Track`, each box `late_ns` after its sweep."""
    for k, stamp in enumerate(track.stamps_ns.tolist()):
        yield Sweep(stamp, 'odom', track.points[k].astype(np.float32), None, np.zeros(3))
        boxes = track.boxes[k : k + 1]
        late = int(late_ns[k]) if len(late_ns) else 0
        yield BoxArray(stamp + late, 'odom', ('7',), ('car',), np.ones(1), boxes)


def test_points_fill_fewer_cells_in_better_boxes():
    rng = np.random.default_rng(3)
    truth = drive(30)
    track = track_of(truth, rng, '7')
    before, after = cells_of(changes_of(track.boxes, truth), streamed(track))
    assert after < 0.7 * before
    turned = truth.copy()
    turned[::2, 8] += np.pi
    same = cells_of(changes_of(turned, truth), streamed(track))
    assert same[0] == pytest.approx(same[1], rel=0.05)
    assert same[1] == after


def test_points_are_motion_compensated_to_the_box_stamp():
    rng = np.random.default_rng(3)
    truth = drive(30, speed=15.0, turn=0.0)
    late_ns = 20_000_000 * (np.arange(30) % 3)
    track = track_of(truth, rng, '7')
    there = truth.copy()
    distance = 15.0 * late_ns[:, None] * 1e-9
    there[:, :2] += distance * np.c_[np.cos(truth[:, 8]), np.sin(truth[:, 8])]
    tracks = changes_of(jittered(there, rng), there, stamps_ns=track.stamps_ns + late_ns)
    between = cells_of(tracks, streamed(track, late_ns))[1]
    exact = cells_of(changes_of(truth, truth), streamed(track))[1]
    assert between < 1.1 * exact


def test_points_are_motion_compensated_by_their_times():
    rng = np.random.default_rng(3)
    truth = drive(30, speed=15.0, turn=0.0)
    items = list(streamed(track_of(truth, rng, '7')))
    heading = np.array([np.cos(truth[0, 8]), np.sin(truth[0, 8]), 0.0])
    late = []
    for item in items:
        if isinstance(item, Sweep):
            times = rng.uniform(-0.05, 0.05, len(item.points))
            item = replace(item, points=item.points + 15.0 * times[:, None] * heading, times=times)
        late.append(item)
    tracks = changes_of(truth, truth)
    deskewing = Config().updated({'sampling.box_time': 'stamp'})
    blurred, _ = cells_of(tracks, late)
    sharp, _ = cells_of(tracks, late, deskewing)
    exact, _ = cells_of(tracks, items)
    assert sharp < 1.2 * exact < 0.8 * blurred
