"""
Draw every picture of the README and of the documentation: ``make figures``.

Each picture comes from a run of ``boxreg`` on this machine. Those of the page are screenshots and
need Chromium; where there is none, these stay as they are.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
import csv
from dataclasses import replace
from io import BytesIO
from pathlib import Path
import shutil
import subprocess
import sys
from tempfile import TemporaryDirectory
from typing import Any

from boxreg_ros import __version__
from boxreg_ros.config import Config
from boxreg_ros.core.matching import StampMatcher
from boxreg_ros.core.observation import GROUND_CLEARANCE
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.recording import Recording
from boxreg_ros.offline.drive import Drive
from boxreg_ros.offline.review_command import drive_of
from boxreg_ros.review.changes import Changes, TrackChanges
from boxreg_ros.review.report import REPORT
from boxreg_ros.review.server import review_server
from boxreg_ros.review.track_points import PointCollector, SHOWN_MARGIN
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import BOX_EXTENT, BoxArray, Floats, RefinedBoxes, ROLL, Sweep, X, Y, Z
from browser import BROWSER_OPTIONS, BROWSERS, end_shared_browser, opened_page, serving
from measure import MEASURE
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

ROOT = Path(__file__).resolve().parents[1]
STREET = ROOT / 'bags' / 'street.mcap'
STYLE: Any = {'font.size': 8, 'axes.spines.top': False, 'axes.spines.right': False}
INPUT_COLOUR = '#d55e00'
REFINED_COLOUR = '#0072b2'
MIN_BOXES = 10
"""Least boxes of the car that is shown."""
POINT_STEP = 3
"""Every n-th point is drawn."""
RESULT = 'street'
"""Result folder of `STREET`, inside of the folder of the runs."""
DRIVE = 'drive'
"""Result folder of the same recording without its boxes."""
FILM = {'viewport': {'width': 1280, 'height': 720}, 'device_scale_factor': 0.8}
"""Size of the moving picture [CSS pixels], and pixels per CSS pixel."""
FILMED = 3
"""Objects that are added in it."""
SETTLE = 1200
"""Time for a page to draw all it shows [ms]."""
QUALITY = 60
"""Of the moving picture, from 0 to 100: text stays sharp in under 300 kB."""
SCREENSHOT_OPTIONS = (
    '--headless', *BROWSER_OPTIONS, '--virtual-time-budget=20000', '--disable-quic',
    '--no-first-run', '--disable-background-networking', '--disable-component-update',
    '--disable-sync', '--hide-scrollbars',
)  # fmt: skip
"""The budget lets the page finish its drawing. Most others keep it off the network."""
PAGE_SIZE = (1366, 900)
"""Width and height of the screenshot [CSS pixels]: a small laptop."""
SCALE = 1.2
"""Pixels of the screenshot per CSS pixel, so that small text is sharp on dense screens."""
TIMEOUT = 600
"""Longest time that a browser may take [s]."""


def boxreg(*arguments: object, folder: Path) -> None:
    """Run ``boxreg`` in a folder; relative paths, which the report shows, are short there."""
    command = [sys.executable, '-m', 'boxreg_ros.cli', *map(str, arguments)]
    subprocess.run(command, cwd=folder, check=True)


def draw_car(runs: Path, target: Path) -> None:
    """Draw the points of one car in its input boxes and in its refined boxes."""
    target.write_bytes(car_picture(STREET, runs / RESULT))


def draw_report(runs: Path, target: Path) -> None:
    """Take a screenshot of one track of the report, if there is a browser."""
    browser = browser_for(target)
    if browser is None:
        return
    screenshot = runs / target.name
    width, height = PAGE_SIZE
    command = [
        browser, *SCREENSHOT_OPTIONS, f'--user-data-dir={runs / "profile"}',
        f'--window-size={width},{height}', f'--force-device-scale-factor={SCALE}',
        f'--screenshot={screenshot}',
        f'{(runs / RESULT / REPORT).as_uri()}#track={densest_vehicle(runs / RESULT)}',
    ]  # fmt: skip
    subprocess.run(command, check=True, capture_output=True, timeout=TIMEOUT)
    with Image.open(screenshot) as picture:  # a palette holds the colours in a third of the size
        about = PngInfo()
        about.add_text('Software', f'boxreg_ros {__version__}')
        picture.convert('RGB').quantize(256).save(target, optimize=True, pnginfo=about)


def browser_for(target: Path) -> str | None:
    """Return the browser; None, said on stderr, if there is none: a picture stays as it is."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        print(
            f'{target.name}: not drawn again: expected one of {", ".join(BROWSERS)} on PATH, '
            f'found none; install it (apt install chromium) and run this again',
            file=sys.stderr,
        )
    return browser


def draw_review(runs: Path, target: Path) -> None:
    """Film a review, if there is a browser: tracks from proposals, then before and after."""
    if browser_for(target) is None:
        return
    boxreg(
        'relabel', STREET, '-o', DRIVE, '--report', '--boxes', 'none', '--proposals', folder=runs
    )
    frames = [*proposals_frames(runs / DRIVE), *before_and_after_frames(runs / RESULT)]
    pictures = [Image.open(BytesIO(png)).convert('RGB') for png, _ in frames]
    pictures[0].save(
        target, save_all=True, append_images=pictures[1:], duration=[ms for _, ms in frames],
        loop=0, quality=QUALITY, method=6,
    )  # fmt: skip


def proposals_frames(out: Path) -> Iterator[tuple[bytes, int]]:
    """Yield screenshots of adding objects by two keys each, and how long each is shown [ms]."""
    with (
        serving(review_server([(out, drive_of(out))], 0, 'you')) as server,
        opened_page(server.address + '#drive', **FILM) as page,
    ):
        page.wait_for_function('scene.sweep')
        yield page.screenshot(), 900
        for count in range(1, FILMED + 1):
            page.keyboard.press('p')
            page.wait_for_function("scene.fit && !$('drive').hidden")
            page.wait_for_timeout(SETTLE)
            yield page.screenshot(), 700
            page.keyboard.press('Enter')
            page.wait_for_function(
                f"TRACKS.length === {count} && !$('tracks').hidden && view.part"
            )
            page.wait_for_timeout(SETTLE)
            yield page.screenshot(), 700


def before_and_after_frames(out: Path) -> Iterator[tuple[bytes, int]]:
    """Yield screenshots of a track: its points in the input boxes and in the refined ones."""
    url = f'{(out / REPORT).as_uri()}#track={densest_vehicle(out)}'
    with opened_page(url, **FILM) as page:
        page.wait_for_function('view.part')
        for mode in ('before', 'after') * 2:
            page.select_option('#mode', mode)
            page.wait_for_timeout(SETTLE)
            yield page.screenshot(), 1200


def densest_vehicle(result: Path) -> str:
    """Return the id of the vehicle with the most points, of those with `MIN_BOXES` or more."""
    names = Config().vehicle.names
    with (result / 'tracks.csv').open(encoding='utf-8', newline='') as file:
        rows = list(csv.DictReader(file))
    vehicles = [
        row for row in rows if row['class_name'] in names and int(row['boxes']) >= MIN_BOXES
    ]
    return max(vehicles, key=lambda row: float(row['median_points']))['track_id']


def draw_paper(runs: Path, target: Path) -> None:
    """Draw the boxes of the paper's experiment: true, input and refined."""
    words = ['paper', '--seeds', '20', '--methods', 'smoothing', 'paper', 'ours']
    subprocess.run([*MEASURE, *words, '--output', str(runs)], check=True)
    shutil.copyfile(runs / 'paper_3d_trajectory.png', target)


PICTURES = {
    'docs/images/car_before_after.png': draw_car,
    'docs/images/report.png': draw_report,
    'docs/images/review.webp': draw_review,
    'bags/paper.png': draw_paper,
}
"""The function that draws each picture; it gets the folder of the runs and the file to write."""


def car_picture(recording: Path, result: Path) -> bytes:
    """Return a PNG file with the points of one vehicle before and after ``boxreg relabel``."""
    refined = BoxTable.read(result / 'boxes.csv')
    drive = Drive.of(Recording([recording]), refined)
    track = most_shifted_vehicle(changes_of(drive.boxes, refined))
    items: list[Sweep | BoxArray] = [*drive.sweeps, *drive.boxes]
    items.sort(key=lambda item: item.stamp_ns)
    collector = PointCollector(Config())
    matcher = StampMatcher(Config(), Counter())
    for item in items:
        collector.note(item)
        is_sweep = isinstance(item, Sweep)
        for pair in matcher.add_sweep(item) if is_sweep else matcher.add_boxes(item):
            collector.gather(pair.boxes, pair.sweep)
    for pair in matcher.flush():
        collector.gather(pair.boxes, pair.sweep)
    from matplotlib import rc_context  # late: most that import this module draw nothing

    with rc_context(STYLE):
        return points_picture(track, collector.points_of(track))


def points_picture(track: TrackChanges, points: Sequence[Floats]) -> bytes:
    """Return a PNG file of the points (M_i, 3) of all sweeps [m] in both boxes of a track."""
    from matplotlib.figure import Figure

    before = in_boxes(track.given, points, track.is_flipped)
    after = in_boxes(track.boxes, points, np.zeros_like(track.is_flipped))
    extents = [np.nanmedian(boxes[:, BOX_EXTENT], axis=0) for boxes in (track.given, track.boxes)]
    is_object = after[:, Z] > GROUND_CLEARANCE - extents[1][2] / 2
    reach_x, *reaches = np.maximum(*extents) / 2 + SHOWN_MARGIN
    figure = Figure((8, 4.5))
    grid = figure.add_gridspec(
        2, 2, left=0.07, right=0.99, top=0.93, bottom=0.09, hspace=0.1, wspace=0.04,
        height_ratios=reaches,
    )  # fmt: skip
    panels: Any = grid.subplots(sharex=True, sharey='row')  # (view, before or after)
    columns = ((before, extents[0], INPUT_COLOUR), (after, extents[1], REFINED_COLOUR))
    for k, (local, extent, colour) in enumerate(columns):
        for panel, axis, reach in zip(panels[:, k], (Y, Z), reaches, strict=True):
            shown = local[is_object] if axis == Y else local
            opacity = float(np.clip(800 / (1 + len(shown)), 0.2, 0.8))
            panel.scatter(
                shown[:, X], shown[:, axis], s=4 * opacity**0.5, c='k', alpha=opacity, lw=0
            )
            corners = np.array([[1, 0], [1, 1], [-1, 1], [-1, -1], [1, -1], [1, 0], [1.2, 0]])
            panel.plot(*(corners * [extent[X], extent[axis]] / 2).T, color=colour, lw=1.2)
            panel.set(xlim=(-reach_x, reach_x), ylim=(-reach, reach), aspect='equal')
    panels[0, 0].set_title('points in the input boxes', fontweight='bold')
    panels[0, 1].set_title('points in the refined boxes', fontweight='bold')
    panels[0, 0].set_ylabel('top view [m]')
    panels[1, 0].set_ylabel('side view [m]')
    for panel in panels[1]:
        panel.set_xlabel('along the box [m]')
    buffer = BytesIO()
    figure.savefig(buffer, format='png', dpi=150)
    return buffer.getvalue()


def in_boxes(boxes: Floats, points: Sequence[Floats], is_flipped: NDArray[np.bool_]) -> Floats:
    """Return the points of all sweeps in the frames of their boxes, those flipped turned first."""
    local = [np.zeros((0, 3))]
    for row, fixed in enumerate(points):
        if len(fixed):
            sign = np.array([-1, -1, 1]) if is_flipped[row] else 1
            R = matrix_from_rpy(boxes[row, ROLL:])
            local.append((fixed[::POINT_STEP] - boxes[row, : Z + 1]) @ R * sign)
    return np.concatenate(local)


def changes_of(given: Sequence[BoxArray], refined: BoxTable) -> list[TrackChanges]:
    """
    Return the tracks of a run before and after registration, by descending mean shift.

    The input is in the fixed frame, one array per stamp; the result has the boxes of each stamp in
    the same order.

    """
    changes = Changes(refined.frame_id)
    for array in given:
        rows = np.flatnonzero(refined.stamps_ns == array.stamp_ns)
        boxes = replace(array, boxes=refined.boxes[rows])
        status = tuple(refined.status[row] for row in rows)
        unknown = np.full((len(rows), 6, 6), np.nan)  # the table has no covariances
        result = RefinedBoxes(boxes, status, ('',) * len(rows), refined.num_points[rows], unknown)
        changes.add(array, result)
    return changes.tracks()


def most_shifted_vehicle(tracks: Sequence[TrackChanges]) -> TrackChanges:
    """Return the vehicle with the largest mean shift, of those with `MIN_BOXES` boxes or more."""
    names = Config().vehicle.names
    vehicles = [
        track for track in tracks
        if track.class_name in names and len(track.status) >= MIN_BOXES
    ]  # fmt: skip
    return max(vehicles, key=lambda track: np.nan_to_num(track.shift))


def main() -> None:
    """Draw all pictures; this takes some minutes."""
    with TemporaryDirectory() as folder:
        runs = Path(folder)
        truth = STREET.with_name('street_truth.csv')
        boxreg('relabel', STREET, '-o', RESULT, '--report', '--truth', truth, folder=runs)
        for name, draw in PICTURES.items():
            draw(runs, ROOT / name)
        end_shared_browser()


if __name__ == '__main__':
    main()
