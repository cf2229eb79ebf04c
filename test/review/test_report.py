"""`boxreg relabel --report`: one self-contained page with the numbers of the run."""

import base64
from dataclasses import replace
from html.parser import HTMLParser
import io
from pathlib import Path
import re
import shutil
import subprocess
import sys

from boxreg_ros.cli import main
from boxreg_ros.config import Config
from boxreg_ros.errors import ConfigError
from boxreg_ros.offline.progress import Progress
from boxreg_ros.offline.relabel import closing_line, relabel, Request
from boxreg_ros.review.changes import Changes
from boxreg_ros.review.report import MAX_SHOWN, select_tracks, write_report
from boxreg_ros.structures import BoxArray, RefinedBoxes, Sweep
from msg_adapters.convention import Convention
import numpy as np
from paths import BAGS
import pytest
from ros_messages import Drive, JSK
from scenes import drive, jittered, PERIOD_NS, START_NS, track_of

Image = pytest.importorskip('PIL.Image')
STREET = BAGS / 'street.mcap'
QUICK = Config().updated({'solver.rounds': 1, 'solver.iterations': 3, 'sampling.points': 64})
SCRIPT = '<script>alert(1)</script>'
BROWSER = shutil.which('chromium') or shutil.which('chromium-browser') or ''


class Page(HTMLParser):
    """The text of a page, its pictures, the cells of its tables, its links and tags."""

    def __init__(self, path):
        super().__init__()
        self.words, self.pictures, self.links, self.tables, self.tags = [], [], [], [], set()
        self.is_in_cell = False
        self.source = path.read_text(encoding='utf-8')
        self.feed(self.source)
        self.text = ' '.join(' '.join(self.words).split())

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        attrs = dict(attrs)
        if tag == 'img':
            kind, _, data = attrs['src'].partition(',')
            assert kind == 'data:image/png;base64'
            self.pictures.append(Image.open(io.BytesIO(base64.b64decode(data))))
        self.links += [attrs[name] for name in ('href', 'src') if name in attrs]
        if tag == 'table':
            self.tables.append([])
        if tag == 'tr':
            self.tables[-1].append([])
        if tag in ('td', 'th'):
            self.tables[-1][-1].append('')
            self.is_in_cell = True

    def handle_endtag(self, tag):
        self.is_in_cell &= tag not in ('td', 'th')

    def handle_data(self, data):
        self.words.append(data)
        if self.is_in_cell:
            self.tables[-1][-1][-1] = f'{self.tables[-1][-1][-1]} {data}'.strip()

    def table(self, *head):
        """Return the rows of the table whose first titles are these, as dicts."""
        (found,) = (t for t in self.tables if tuple(t[0][: len(head)]) == head)
        return [dict(zip(found[0], row, strict=True)) for row in found[1:]]


def run(path, out, **options):
    """Relabel quickly with a report; return the summary and the page."""
    config = options.pop('config', QUICK)
    request = Request((Path(path),), formats=('csv',), config=config, report=True, **options)
    summary = relabel(request, Path(out))
    return summary, Page(Path(out) / 'report.html')


@pytest.fixture(scope='module')
def street(tmp_path_factory):
    out = tmp_path_factory.mktemp('street') / 'out'
    return out, *run(STREET, out, config=Config().updated({'window': 9, 'lag': 8}))


def test_page_needs_no_other_file(street):
    out, _, page = street
    assert sorted(item.name for item in out.iterdir()) == [
        'boxes.csv', 'config.yaml', 'covariances.csv', 'report.html', 'review.csv',
        'summary.json', 'tracks.csv',
    ]  # fmt: skip
    assert all(link.startswith(('#', 'data:')) for link in page.links)
    assert not page.tags & {'script', 'iframe', 'object'}
    assert '://' not in re.sub(r'base64,[^"]*', '', page.source)
    assert (out / 'report.html').stat().st_size < 5e6


def test_pictures_are_not_blank(street):
    pictures = street[2].pictures
    assert len(pictures) == 1 + MAX_SHOWN
    for picture in pictures:
        assert picture.width >= 1200
        tones = np.asarray(picture.convert('L'), float)
        assert tones.std() > 5
        assert np.mean(tones < 250) > 0.005


def test_numbers_agree_with_the_summary(street):
    out, summary, page = street
    before = {**summary, 'seconds': {'total': 0.0}}
    assert closing_line(before, out).split(' in 0.0 s')[0] in page.text
    tracks = page.table('track', 'class', 'boxes')
    assert sum(int(row['boxes']) for row in tracks) == summary['boxes_in']
    flips = sum(int(row['flips'] or 0) for row in tracks)
    assert flips == summary['heading_flips'] > 0
    shifts = [float(row['shift [m]']) for row in tracks]
    assert shifts == sorted(shifts, reverse=True)
    reasons = page.table('reason', 'count')
    assert {row['reason']: int(row['count']) for row in reasons} == summary['reasons']
    assert all(row['meaning'] for row in reasons)
    shown = page.table('track', 'class', 'why')
    assert len(shown) == MAX_SHOWN
    # On simulated surfaces the refined boxes of all tracks with many points follow them better.
    changes = [float(row['cells'].rstrip(' %')) for row in shown if 'most points' in row['why']]
    assert changes
    assert max(changes) < -10
    for name in ('window: 9', 'lag: 8'):
        assert name in page.text
    assert 'solver.rounds' not in page.text
    assert 'report' in summary['seconds']


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
    assert summary['status']['interpolated'] == 2
    assert set(summary['reasons']) >= {
        'no_transform', 'invalid_box', 'no_track_id', 'no_points',
    }  # fmt: skip
    assert 'script' not in page.tags
    rows = {row['track']: row for row in page.table('track', 'class', 'boxes')}
    assert set(rows) == {
        f'A {SCRIPT}', 'B 1', '1_2', 'empty', 'once', 'flat', 'nowhere', 'no id',
    }  # fmt: skip
    assert rows[f'A {SCRIPT}']['class'] == '<b>$car$</b>'
    assert rows['B 1']['boxes'] == '16 + 2'
    assert rows['flat']['shift [m]'] == '\N{EN DASH}'
    assert sum(int(row['boxes'].split()[0]) for row in rows.values()) == summary['boxes_in']
    assert page.text.count('First missing transform') == 1
    assert len(page.pictures) == 3


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
    assert 'refined' not in summary['status']
    assert ('No box was refined' in page.text) == (kind != 'no boxes')
    assert 'No track has 10 boxes' in page.text
    assert len(page.pictures) == (kind == 'no points')


def test_points_are_found_for_label_files_and_associated_ids(tmp_path):
    recording = Drive(sweeps=12).write(tmp_path / 'drive', 'sqlite3')
    nameless = Drive(sweeps=12, boxes=JSK).write(tmp_path / 'nameless', 'rosbag1')
    run(recording, tmp_path / 'out')
    labels = 'csv', tmp_path / 'out' / 'boxes.csv'
    for path, options in (
        (recording, {'labels': labels}), (nameless, {'convention': Convention(associate=True)}),
    ):  # fmt: skip
        _, page = run(path, tmp_path / 'more', **options)
        assert page.text.count('The points of 12 sweeps fill') == 2


def test_report_is_off_by_default_and_part_of_the_fingerprint(tmp_path):
    recording = Drive(sweeps=4).write(tmp_path / 'drive')
    plain = Request((recording,), config=QUICK)
    summary = relabel(plain, tmp_path / 'out')
    assert not (tmp_path / 'out' / 'report.html').exists()
    assert 'report' not in summary['seconds']
    assert Request((recording,), config=QUICK, report=True).fingerprint() != plain.fingerprint()


@pytest.mark.parametrize('package', ['jinja2', 'matplotlib'])
def test_missing_package_is_refused_before_reading(tmp_path, monkeypatch, capsys, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ConfigError, match=f'pip install {package}'):
        Request((Path('nothing'),), report=True)
    assert main(['relabel', 'nothing', '-o', str(tmp_path / 'out'), '--report']) == 2
    assert f'--report needs {package}: pip install {package}' in capsys.readouterr().err


def test_progress_counts_both_passes(tmp_path):
    shown = []
    request = Request((Drive(sweeps=4).write(tmp_path / 'drive'),), config=QUICK, report=True)
    progress = Progress()
    progress.show = lambda done, total: shown.append(done / total)
    relabel(request, tmp_path / 'out', progress)
    assert shown == sorted(shown)
    assert 0.4 < shown[len(shown) // 2 - 1] <= 0.5
    assert shown[-1] == pytest.approx(1.0)


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
    assert list(select_tracks([track])) == ['7']
    (kept,) = changes_of(boxes, boxes, status='kept')
    assert np.isnan(kept.shift)
    assert select_tracks([kept]) == {'7': 'boxes kept although they have points: 12 of 12'}


SUMMARY = {
    'recordings': ['drive.mcap'], 'topics': {}, 'labels': None, 'fixed_frame': 'odom',
    'sweeps': 30, 'box_arrays': 30, 'boxes_in': 30, 'status': {'refined': 30}, 'reasons': {},
    'heading_flips': 0, 'dropped': {}, 'first_missing_transform': '', 'first_unreadable': '',
    'warning': '', 'ids': 'of the input', 'left_out_of_labels': {}, 'versions': {}, 'seconds': {},
}  # fmt: skip


def cells_of(tmp_path, tracks, items, config=None):
    """Return the number of cells that the points of the track fill before and after."""
    path = tmp_path / 'report.html'
    write_report(path, 'done', SUMMARY, config or Config(), tracks, items)
    found = re.search(
        r'sweeps fill ([\d,]+) cells of 0.1 m in the input boxes, ([\d,]+)', Page(path).text
    )
    return [int(number.replace(',', '')) for number in found.groups()]


def streamed(track, late_ns=()):
    """Yield sweeps and boxes of a `Track`, each box `late_ns` after its sweep."""
    for k, stamp in enumerate(track.stamps_ns.tolist()):
        yield Sweep(stamp, 'odom', track.points[k].astype(np.float32), None, np.zeros(3))
        boxes = track.boxes[k : k + 1]
        late = int(late_ns[k]) if len(late_ns) else 0
        yield BoxArray(stamp + late, 'odom', ('7',), ('car',), np.ones(1), boxes)


def test_points_fill_fewer_cells_in_better_boxes(tmp_path):
    rng = np.random.default_rng(3)
    truth = drive(30)
    track = track_of(truth, rng, '7')
    before, after = cells_of(tmp_path, changes_of(track.boxes, truth), streamed(track))
    assert after < 0.7 * before
    turned = truth.copy()
    turned[::2, 8] += np.pi
    same = cells_of(tmp_path, changes_of(turned, truth), streamed(track))
    assert same[0] == pytest.approx(same[1], rel=0.05)
    assert same[1] == after


def test_points_are_motion_compensated_to_the_box_stamp(tmp_path):
    rng = np.random.default_rng(3)
    truth = drive(30, speed=15.0, turn=0.0)
    late_ns = 20_000_000 * (np.arange(30) % 3)
    track = track_of(truth, rng, '7')
    there = truth.copy()
    distance = 15.0 * late_ns[:, None] * 1e-9
    there[:, :2] += distance * np.c_[np.cos(truth[:, 8]), np.sin(truth[:, 8])]
    tracks = changes_of(jittered(there, rng), there, stamps_ns=track.stamps_ns + late_ns)
    between = cells_of(tmp_path, tracks, streamed(track, late_ns))[1]
    exact = cells_of(tmp_path, changes_of(truth, truth), streamed(track))[1]
    assert between < 1.1 * exact


def test_points_are_motion_compensated_by_their_times(tmp_path):
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
    blurred, _ = cells_of(tmp_path, tracks, late)
    sharp, _ = cells_of(tmp_path, tracks, late, deskewing)
    exact, _ = cells_of(tmp_path, tracks, items)
    assert sharp < 1.2 * exact < 0.8 * blurred


# In a browser ----------------------------------------------------------------------------------

MEASURE = """
<script>document.title = [document.documentElement.scrollHeight,
  document.documentElement.scrollWidth - innerWidth,
  [...document.images].every(i => i.complete && i.naturalWidth > 1000)].join()</script>
"""


@pytest.mark.skipif(not BROWSER, reason='no chromium on PATH to open the page with')
def test_browser_renders_the_page(street, tmp_path):
    page = tmp_path / 'page.html'
    page.write_text(street[2].source + MEASURE, encoding='utf-8')
    done = subprocess.run(
        [
            BROWSER, '--headless', '--no-sandbox', '--disable-gpu', '--enable-logging=stderr',
            '--hide-scrollbars', '--window-size=1366,768', '--virtual-time-budget=10000',
            f'--user-data-dir={tmp_path / "profile"}', '--dump-dom', page.as_uri(),
        ],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert 'CONSOLE' not in done.stderr
    found = re.search(r'<title>(\d+),(-?\d+),(\w+)</title>', done.stdout)
    assert found, done.stderr
    height, overflow, has_pictures = found.groups()
    assert int(height) > 4000
    assert int(overflow) <= 0
    assert has_pictures == 'true'
