"""
`measure report`: how soon `report.html` is painted, and how smoothly it steps.

Each report is opened in a headless Chromium and draws without a GPU in two ways: by the processor,
as Chromium does by itself on a machine without a GPU, and by an emulated GPU, which is an upper
limit of the frame times. Beside them are those of a page with one changing number.

"""

import json
import os
from pathlib import Path
import subprocess
from tempfile import TemporaryDirectory

from boxreg_ros.errors import RecordingError
from boxreg_ros.review.report import REPORT
from browser import launched, show_charts
from measure.common import BOXREG
from measure.speed.recordings import write_traffic
import numpy as np

COMPOSITORS = {'processor': ('--disable-gpu-compositing',), 'emulated GPU': ()}
"""
Compositor that puts the parts of the page together, and the options for it.

Chromium leaves that to the processor where it finds no GPU. The emulated GPU is SwiftShader, which
the options for WebGL make it use for all of the page.

"""
VIEWPORT = {'width': 1366, 'height': 800}
"""Size of the window [CSS pixels]: a small laptop."""
QUICK = ('--set=solver.rounds=1', '--formats=csv')
"""The boxes of the synthetic stream need not be good."""
STEPS = 120
"""Steps of the time slider that are measured, one per frame: two seconds at 60 Hz."""
WARM_UP_STEPS = 10
"""Steps before those: the first ones compile scripts and shaders."""
FRAME = 1000 / 60
"""Time of a frame at 60 Hz [ms]."""
LATE = 1.5
"""A frame that takes this many times as long is late: another one was skipped."""
STEPPING = """
count => new Promise(done => {
  const starts = [], scripts = [];
  const next = now => {
    starts.push(now);
    if (starts.length > count) return done([starts, scripts]);
    const begin = performance.now();
    step((view.row + 1) % view.part.stamps.length);
    scripts.push(performance.now() - begin);
    requestAnimationFrame(next);
  };
  requestAnimationFrame(next);
})
"""
"""Script that steps once per frame; it returns when frames began and what steps took [ms]."""
CHANGING_TEXT = """
count => new Promise(done => {
  const starts = [];
  const next = now => {
    starts.push(now);
    if (starts.length > count) return done(starts);
    document.body.textContent = starts.length;
    requestAnimationFrame(next);
  };
  requestAnimationFrame(next);
})
"""
"""Script that changes one line of text per frame, as a reference; it returns when frames began."""
FIRST_PAINT = "performance.getEntriesByName('first-contentful-paint')[0]?.startTime"
ARGUMENTS = {
    'recordings': (Path, 'recordings whose reports are measured', {'nargs': '*'}),
    '--tracks': (1000, 'tracks of a synthetic stream whose report is measured too; 0 for none'),
    '--boxes': (80, 'boxes of each of its tracks'),
    '--points': (130000, 'points of each of its sweeps'),
}


def run(args):
    """Return first paint and frame times of reports."""
    report = {
        'load before': os.getloadavg()[0],
        'page of one number': {
            name: {'frame [ms]': _reference_frame(options)}
            for name, options in COMPOSITORS.items()
        },
    }
    with TemporaryDirectory(prefix='boxreg-') as name:
        folder = Path(name)
        for recording in args.recordings:
            report[recording.name] = measure(recording, folder / 'out')
        if args.tracks:
            drive = folder / 'drive.mcap'
            write_traffic(drive, args.tracks, args.points, args.boxes)
            title = f'{args.tracks:,} tracks of {args.boxes} boxes'
            report[title] = measure(drive, folder / 'out', *QUICK)
    return report


def measure(recording, out, *options):
    """
    Relabel a recording, and open its report.

    Returns
    -------
    found : dict
        ``drawing [s]`` and ``size [MB]`` of the report. By `COMPOSITORS`: ``first paint [ms]``
        from the start of the page; ``script of a step``, ``longest script of a step`` and
        ``frame`` while stepping [ms], ``frames per second``, and the ``part of late frames``.

    """
    command = [*BOXREG, 'relabel', str(recording), '-o', str(out), '--report', *options]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise RecordingError(f'{recording}: {done.stderr.strip()}')
    summary = json.loads((out / 'summary.json').read_text(encoding='utf-8'))
    page = out / REPORT
    return {
        'drawing [s]': summary['seconds']['report'],
        'size [MB]': page.stat().st_size / 1e6,
        **{name: _stepped(page, options) for name, options in COMPOSITORS.items()},
    }


def _stepped(report, options):
    """Return the time of the first paint of a page, and the times of its steps."""
    with launched(*options) as browser:
        page = browser.new_page(viewport=VIEWPORT)
        page.goto(report.as_uri())
        page.wait_for_selector('html[data-ready]', timeout=120_000)
        paint = page.wait_for_function(FIRST_PAINT, polling=100).json_value()
        page.evaluate('openTrack(DATA.tracks.findIndex(track => track.boxes > 1))')
        page.wait_for_function('view.part', timeout=120_000)
        show_charts(page)
        page.evaluate(STEPPING, WARM_UP_STEPS)
        starts, scripts = page.evaluate(STEPPING, STEPS)
    frames = np.diff(starts)
    return {
        'first paint [ms]': paint,
        'script of a step [ms]': float(np.median(scripts)),
        'longest script of a step [ms]': float(np.max(scripts)),
        'frame [ms]': float(np.median(frames)),
        'frames per second': float(1000 / frames.mean()),
        'part of late frames': float((frames > LATE * FRAME).mean()),
    }


def _reference_frame(options):
    """Return the median time of a frame of a page with one changing number [ms]."""
    with launched(*options) as browser:
        page = browser.new_page(viewport=VIEWPORT)
        page.set_content('<body></body>')
        starts = page.evaluate(CHANGING_TEXT, STEPS)
    return float(np.median(np.diff(starts)))
