"""
`measure lidars`: accuracy on a truck with LiDARs at its corners.

The same drives are recorded in four ways: a topic per LiDAR, a concatenated cloud with its info
message, the concatenated cloud alone, and a single LiDAR on the roof. The concatenated cloud alone
is read with and without the names of its LiDARs. The input boxes and the truth are the same.

"""

from pathlib import Path
import tempfile

from boxreg_ros.config import Config
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.fixed_frame import input_boxes
from boxreg_ros.io.lidars import Lidars, SINGLE_LIDAR
from boxreg_ros.io.recording import Recording
from boxreg_ros.offline.box_scores import match
from boxreg_ros.offline.relabel import relabel
from boxreg_ros.offline.request import Request
from measure.truck import CORNER_LIDARS, truck_scene, write_truck
import numpy as np

CLASSES = ('car', 'van', 'truck')
WAYS = {
    'corners': ('corners', Lidars(tuple(f'/points/{name}' for name in CORNER_LIDARS))),
    'concatenated': ('concatenated', SINGLE_LIDAR),
    'concatenated-alone': ('concatenated-alone', SINGLE_LIDAR),
    'concatenated-named': ('concatenated-alone', Lidars(frames=tuple(CORNER_LIDARS))),
    'roof': ('roof', SINGLE_LIDAR),
}
"""Name -> layout of `TRUCK_SENSORS`, and how it is read."""
MIN_POINTS = 100
"""True boxes with fewer points of all corners are left out, as in `measure real`."""
ARGUMENTS = {
    '--seeds': (3, 'number of drives'),
    '--sweeps': (int, 'sweeps of a drive'),
    '--keep': (Path, 'folder that keeps the recordings and the true boxes of each seed'),
}


def run(args):
    """Return the mean IoU of the input and of each way to record the LiDARs."""
    rows = {name: [] for name in ('input', *WAYS)}
    for seed in range(args.seeds):
        for name, ious in measured(seed, args.sweeps, args.keep).items():
            rows[name].append(ious)
    return {
        name: dict(zip(('bev', '3d'), np.mean(ious, axis=0).tolist(), strict=True))
        for name, ious in rows.items()
    }


def measured(seed, sweeps, keep=None):
    """Return mean BEV and 3D IoU of the input and of each way for one drive."""
    scene = truck_scene(seed, sweeps)
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        recordings = Path(folder if keep is None else keep) / str(seed)
        recordings.mkdir(parents=True, exist_ok=True)
        scene.truth.write(recordings / 'truth.csv')
        for name, (layout, lidars) in WAYS.items():
            path = recordings / f'{layout}.mcap'
            out = Path(folder) / name
            write_truck(path, scene, layout)
            if not found:
                arrays, _ = input_boxes(Recording([path], lidars))
                found['input'] = _ious(BoxTable.from_arrays(arrays, 'input'), scene.truth)
            request = Request((path,), lidars=lidars, formats=('csv',), config=Config())
            relabel(request, out)
            found[name] = _ious(BoxTable.read(out / 'boxes.csv'), scene.truth)
    return found


def _ious(boxes, truth):
    """Return the mean BEV and 3D IoU of the boxes that there are."""
    matches = match(boxes, truth, MIN_POINTS, CLASSES)
    is_there = matches.is_matched
    return float(matches.iou_bev[is_there].mean()), float(matches.iou_3d[is_there].mean())
