"""
`measure clusters`: boxes of clusters, which hold what is seen of their objects.

A DATA is a folder with one recording and truth.csv, whose boxes are replaced by ones around the
points in true ones. `ours, as given` takes them for boxes of whole objects.

"""

from boxreg_ros.config import Config
from boxreg_ros.offline.box_scores import match, summarise
from measure import RECORDINGS
from measure.drives import Drive
from measure.methods import run_methods

ARGUMENTS = {'data': RECORDINGS, '--seed': (0, 'of the errors of yaw')}
COMPARED = ('smoothing', 'ours')


def run(args):
    """Return the mean 3D IoU of each method by recording."""
    return {data.name: scores(Drive.read(data).clustered(args.seed)) for data in args.data}


def scores(drive):
    """Return the mean 3D IoU of each method on a drive."""
    found = run_methods(drive, wanted=COMPARED)
    for estimate in ('final', 'track'):
        given = Config(estimate=estimate).updated({'sampling.box_extents': 'whole'})
        found |= {f'ours, as given, {k}': boxes for k, boxes in drive.registered(given).items()}
    return {name: summarise(match(boxes, drive.truth)).iou_3d for name, boxes in found.items()}
