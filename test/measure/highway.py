"""
`measure highway`: the same highway at two speeds, with boxes of either time.

At 30 m/s every vehicle moves by 3 m while the sensor turns. The boxes of a detector are where a
vehicle was at the stamp of the sweep, or where it was when the sensor saw it; the method has to
find out which (`sampling.box_time`).

"""

from boxreg_ros.offline.box_scores import match
from boxreg_ros.simulation.scenarios import highway
from measure.drives import Drive
from measure.methods import run_methods
import numpy as np

SPEEDS = (5.0, 30.0)
"""Of the vehicle with the sensor [m/s]; the others drive 0.83 to 1.33 times as fast."""
CONVENTIONS = ('stamp', 'sight')
"""Times that the boxes are of."""
COMPARED = ('smoothing', 'ours')
MIN_SEEN_POINTS = 10
"""True boxes with fewer points are left out; chosen: there is little to register to."""
ARGUMENTS = {
    '--seeds': (3, 'number of drives'),
    '--sweeps': (60, 'sweeps of a drive'),
}


def run(args):
    """Return the mean 3D IoU of each method by speed and time of the boxes."""
    results = {}
    for convention in CONVENTIONS:
        table = results.setdefault(convention, {})
        for speed in SPEEDS:
            for name, iou in _mean_ious(args, convention, speed).items():
                table.setdefault(name, {})[f'{speed:g} m/s'] = iou
    return results


def _mean_ious(args, convention, speed):
    """Return the mean 3D IoU of each method over all seeds."""
    ious = {}
    for seed in range(args.seeds):
        for name, iou in measured(seed, args.sweeps, convention, speed):
            ious.setdefault(name, []).append(iou)
    return {name: float(np.mean(values)) for name, values in ious.items()}


def measured(seed, sweeps, convention, speed):
    """Yield the name of each method and its mean 3D IoU on one drive."""
    rng = np.random.default_rng(seed)
    drive = Drive.from_scene(highway(rng, sweeps, convention == 'sight', speed))
    for name, boxes in run_methods(drive, wanted=COMPARED).items():
        if not isinstance(boxes, str):
            matches = match(boxes, drive.truth, MIN_SEEN_POINTS)
            yield name, float(matches.iou_3d[matches.is_matched].mean())
