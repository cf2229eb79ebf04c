"""The pictures of the README and the documentation: where they come from, and their drawing."""

import base64
from dataclasses import replace
from importlib.util import find_spec
import io
import json
import re
import shutil
import zlib

from boxreg_ros import __version__
from boxreg_ros.cli import main
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.recording import Recording
from measure.drives import Drive
import numpy as np
from paths import BAGS, ROOT
import pytest

Image = pytest.importorskip('PIL.Image')
figures = pytest.importorskip('figures')
# Not imported: each process that shares the tests would, also where others run these.
pytestmark = pytest.mark.skipif(find_spec('matplotlib') is None, reason='no matplotlib')
PAGES = [ROOT / 'README.md', BAGS / 'README.md', *sorted((ROOT / 'docs').rglob('*.md'))]
MAX_BYTES = 300_000
"""Largest size of a picture, so that pages load fast."""


def shown_pictures(page):
    """Yield the pictures that a page shows, as paths from the root of the project."""
    text = page.read_text(encoding='utf-8')
    for name in re.findall(r'!\[[^]]*\]\(([^)\s]+)|<img[^>]*\bsrc="([^"]+)', text):
        path = (page.parent / ''.join(name)).resolve()
        yield str(path.relative_to(ROOT))


def pixels(picture):
    return np.asarray(picture.convert('L'), float)


@pytest.fixture(scope='module')
def tiny(tmp_path_factory):
    """Return a folder with a recording of a few sweeps and the result of relabelling it."""
    folder = tmp_path_factory.mktemp('tiny')
    recording = folder / 'tiny.mcap'
    truth = folder / 'truth.csv'
    simulate = ['simulate', '-o', recording, '--truth', truth, '--sweeps', '12']
    assert main([str(word) for word in simulate]) == 0
    options = ['--report', '--set', 'solver.rounds=1', '--set', 'sampling.points=64']
    relabel = ['relabel', recording, '-o', folder / figures.RESULT, *options]
    assert main([str(word) for word in relabel]) == 0
    return folder


@pytest.fixture(scope='module')
def tracks(tiny):
    """Return the tracks of the tiny run before and after registration."""
    refined = BoxTable.read(tiny / figures.RESULT / 'boxes.csv')
    drive = Drive.of(Recording([tiny / 'tiny.mcap']), refined)
    return figures.changes_of(drive.boxes, refined)


def test_every_shown_picture_is_drawn():
    shown = {name for page in PAGES for name in shown_pictures(page)}
    assert shown
    assert sorted(shown - set(figures.PICTURES)) == [], 'add it to docs/figures.py'


def test_every_stored_picture_is_drawn():
    stored = {
        str(path.relative_to(ROOT))
        for folder in (ROOT / 'docs', BAGS)
        for ending in ('png', 'jpg', 'jpeg', 'gif', 'svg', 'webp')
        for path in folder.rglob(f'*.{ending}')
    }
    assert stored == set(figures.PICTURES)


@pytest.mark.parametrize('name', figures.PICTURES)
def test_stored_pictures_are_sharp_and_small(name):
    path = ROOT / name
    assert path.stat().st_size < MAX_BYTES
    with Image.open(path) as picture:
        assert max(picture.size) >= 1000
        assert pixels(picture).std() > 5


def test_the_report_is_shown_as_this_version_draws_it():
    with Image.open(ROOT / 'docs/images/report.png') as picture:
        assert picture.text['Software'] == f'boxreg_ros {__version__}', 'run make figures'


def test_the_first_page_of_the_docs_moves():
    (name,) = [name for name in shown_pictures(ROOT / 'docs/index.md') if name.endswith('webp')]
    with Image.open(ROOT / name) as film:
        seconds = 0.0
        for frame in range(film.n_frames):
            film.seek(frame)
            film.load()
            seconds += film.info['duration'] / 1000
    assert 8 < seconds < 15


def test_make_figures_draws_the_pictures():
    makefile = (ROOT / 'Makefile').read_text(encoding='utf-8')
    recipe = re.search(r'^figures:.*\n((?:\t.*\n)+)', makefile, re.MULTILINE)[1]
    assert 'docs/figures.py' in recipe


def test_car_picture_needs_no_browser(tiny, monkeypatch):
    monkeypatch.setenv('PATH', '')
    png = figures.car_picture(tiny / 'tiny.mcap', tiny / figures.RESULT)
    picture = Image.open(io.BytesIO(png))
    assert picture.width >= 1000
    half = pixels(picture)[:, : picture.width // 2]
    other = pixels(picture)[:, -half.shape[1] :]
    assert half.std() > 5
    assert other.std() > 5
    assert np.mean(half != other) > 0.01


def test_car_picture_is_reproducible(tiny):
    pictures = {figures.car_picture(tiny / 'tiny.mcap', tiny / figures.RESULT) for _ in range(2)}
    assert len(pictures) == 1


def test_changes_agree_with_the_report(tiny, tracks):
    page = (tiny / figures.RESULT / 'report.html').read_text(encoding='utf-8')
    data = re.search(r'id="data">([^<]*)<', page)[1]
    rows = json.loads(zlib.decompress(base64.b64decode(data)))['tracks']
    shifts = {track.track_id: track.shift for track in tracks}
    assert {row['id'] for row in rows} == set(shifts)
    for row in rows:
        if row['shift'] is not None:
            assert row['shift'] == pytest.approx(shifts[row['id']], abs=1e-6)


def test_most_shifted_vehicle_is_shown(tracks):
    is_vehicle = [track.class_name in ('car', 'van', 'truck') for track in tracks]
    assert not all(is_vehicle)
    vehicles = [track for track, is_one in zip(tracks, is_vehicle, strict=True) if is_one]
    vehicles = [track for track in vehicles if len(track.status) >= figures.MIN_BOXES]
    shown = figures.most_shifted_vehicle(tracks)
    assert shown.shift == max(track.shift for track in vehicles)
    others = [
        replace(track, class_name='pedestrian') if track is shown else track for track in tracks
    ]
    second = figures.most_shifted_vehicle(others)
    assert second.track_id != shown.track_id
    assert second.shift <= shown.shift


def test_missing_browser_leaves_the_report_picture(tiny, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv('PATH', str(tmp_path))
    target = tmp_path / 'report.png'
    target.write_bytes(b'as before')
    figures.draw_report(tiny, target)
    assert target.read_bytes() == b'as before'
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith('report.png: not drawn again: ')
    assert 'apt install chromium' in line


@pytest.mark.skipif(
    not any(map(shutil.which, figures.BROWSERS)), reason='no Chromium on PATH for a screenshot'
)
def test_report_picture_is_a_screenshot(tiny, tmp_path):
    target = tmp_path / 'report.png'
    figures.draw_report(tiny, target)
    with Image.open(target) as picture:
        assert picture.size == tuple(round(side * figures.SCALE) for side in figures.PAGE_SIZE)
        assert pixels(picture).std() > 5
