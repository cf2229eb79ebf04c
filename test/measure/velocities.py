"""
`measure velocities`: errors of velocities of the input and of each estimate.

A DATA is a folder with one recording and truth.csv, or a scenario of `boxreg simulate`.

"""

from pathlib import Path

from boxreg_ros.config import Config
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.box_scores import by_overlap, match
from boxreg_ros.offline.velocity_scores import velocity_scores
from boxreg_ros.simulation.scenarios import SCENARIOS
from boxreg_ros.structures import REFINED
from measure import RECORDINGS
from measure.drives import Drive
import numpy as np

ARGUMENTS = {'data': RECORDINGS}


def run(args):
    """Return the scores by recording, source of the boxes and way."""
    return {str(data): _scores(drive_of(data)) for data in args.data}


def drive_of(data):
    """Return a simulated drive, or the one in a folder."""
    if str(data) in SCENARIOS:
        return Drive.from_scene(SCENARIOS[str(data)](np.random.default_rng(0), None))
    return Drive.read(Path(data))


def _scores(drive):
    found = {'input': _scored(BoxTable.from_arrays(drive.boxes), drive, None)}
    for estimate in ('final', 'track'):
        for name, results in drive.refined(Config(estimate=estimate)).items():
            boxes = BoxTable.from_arrays([result.boxes for result in results])
            found[name] = _scored(boxes, drive, _known(results))
    return found


def _scored(boxes, drive, known):
    matches = match(boxes, drive.truth, pair=by_overlap)
    scores = velocity_scores(matches, boxes, drive.truth, known)
    return {way: of_way._asdict() for way, of_way in scores.items()}


def _known(results):
    """Return the records of refined boxes by stamp and track id."""
    return {
        (result.boxes.stamp_ns, track_id): record
        for result in results
        for track_id, status, record in zip(
            result.boxes.track_ids, result.status, result.boxes.kinematics, strict=True
        )
        if status == REFINED
    }
