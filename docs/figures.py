"""
Draw every picture of the README and of the documentation: ``python docs/figures.py``.

Each picture comes from a run of ``boxreg`` on this machine. The report's picture is a screenshot
and needs Chromium; where there is none, that picture alone stays as it is.

"""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
import shutil
import subprocess
import sys
from tempfile import TemporaryDirectory

from boxreg_ros.config import Config
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.recording import Recording
from boxreg_ros.offline.drive import Drive
from boxreg_ros.review.changes import Changes, TrackChanges
from boxreg_ros.review.pictures import points_picture, STYLE
from boxreg_ros.review.report import MIN_BOXES, REPORT
from boxreg_ros.review.track_points import gather_points, points_before_and_after
from boxreg_ros.structures import BoxArray, RefinedBoxes, Sweep
import matplotlib
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
STREET = ROOT / 'bags' / 'street.mcap'
RESULT = 'street'
"""Result folder of `STREET`, inside of the folder of the runs."""
BROWSERS = ('chromium', 'chromium-browser', 'google-chrome')
BROWSER_OPTIONS = (
    '--headless', '--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run',
    '--disable-background-networking', '--disable-component-update', '--disable-sync',
    '--hide-scrollbars',
)  # fmt: skip
"""Root needs ``--no-sandbox``; the page is our own. Most others keep it off the network."""
PAGE_SIZE = (1200, 1400)
"""Width and height of the screenshot [CSS pixels]: down to the end of the first table."""
SCALE = 1.2
"""Pixels of the screenshot per CSS pixel, so that small text is sharp on dense screens."""
TIMEOUT = 120
"""Longest time that a browser may take [s]."""


def boxreg(*arguments: object, folder: Path) -> None:
    """Run ``boxreg`` in a folder; relative paths, which the report shows, are short there."""
    command = [sys.executable, '-m', 'boxreg_ros.cli', *map(str, arguments)]
    subprocess.run(command, cwd=folder, check=True)


def draw_car(runs: Path, target: Path) -> None:
    """Draw the points of one car in its input boxes and in its refined boxes."""
    target.write_bytes(car_picture(STREET, runs / RESULT))


def draw_report(runs: Path, target: Path) -> None:
    """Take a screenshot of the top of the report, if there is a browser."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        print(
            f'{target.name}: not drawn again: expected one of {", ".join(BROWSERS)} on PATH, '
            f'found none; install it (apt install chromium) and run this again',
            file=sys.stderr,
        )
        return
    screenshot = runs / target.name
    width, height = PAGE_SIZE
    command = [
        browser, *BROWSER_OPTIONS, f'--user-data-dir={runs / "profile"}',
        f'--window-size={width},{height}', f'--force-device-scale-factor={SCALE}',
        f'--screenshot={screenshot}', (runs / RESULT / REPORT).as_uri(),
    ]  # fmt: skip
    subprocess.run(command, check=True, capture_output=True, timeout=TIMEOUT)
    shutil.copyfile(screenshot, target)


def draw_paper(runs: Path, target: Path) -> None:
    """Draw the boxes of the paper's experiment: true, input and refined."""
    boxreg(
        'bench', 'paper', '--seeds', 20, '--methods', 'smoothing', 'paper', 'ours',
        '-o', 'bench', folder=runs,
    )  # fmt: skip
    shutil.copyfile(runs / 'bench' / 'paper_3d_trajectory.png', target)


PICTURES = {
    'docs/images/car_before_after.png': draw_car,
    'docs/images/report.png': draw_report,
    'bags/paper.png': draw_paper,
}
"""The function that draws each picture; it gets the folder of the runs and the file to write."""


def car_picture(recording: Path, result: Path) -> bytes:
    """
    Return a PNG file with the points of one vehicle before and after registration.

    Parameters
    ----------
    recording : Path
        The recording.
    result : Path
        The folder that ``boxreg relabel`` wrote for it.

    """
    refined = BoxTable.read(result / 'boxes.csv')
    drive = Drive.of(Recording([recording]), refined)
    track = most_shifted_vehicle(changes_of(drive.boxes, refined))
    items: list[Sweep | BoxArray] = [*drive.sweeps, *drive.boxes]
    items.sort(key=lambda item: item.stamp_ns)
    points, _ = gather_points([track], items, Config())
    before, after, is_object = points_before_and_after(track, points[track.track_id])
    with matplotlib.rc_context(STYLE):
        return b64decode(points_picture(track, before, after, is_object))


def changes_of(given: Sequence[BoxArray], refined: BoxTable) -> list[TrackChanges]:
    """
    Return the tracks of a run before and after registration, by descending mean shift.

    Parameters
    ----------
    given : sequence of BoxArray
        The input in the fixed frame, one array per stamp.
    refined : BoxTable
        The result, with the boxes of each stamp in the order of the input.

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
        boxreg('relabel', STREET, '-o', RESULT, '--report', folder=runs)
        for name, draw in PICTURES.items():
            draw(runs, ROOT / name)


if __name__ == '__main__':
    main()
