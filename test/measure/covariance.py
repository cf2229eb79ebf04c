"""
`measure covariance`: the sizes of covariances against those of the errors.

Of early, final and track estimates, for every class, along the axes of the true boxes.

"""

from boxreg_ros.config import Config
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.covariance_table import BoxCovariance
from boxreg_ros.offline.box_scores import match
from boxreg_ros.offline.consistency import consistency
from boxreg_ros.structures import REFINED
from measure import RECORDINGS
from measure.drives import Drive
from measure.real import MIN_CLASS_BOXES
import numpy as np

ARGUMENTS = {'data': RECORDINGS}


def run(args):
    """Return coverage and normalised squared errors of each estimate, per recording."""
    return {
        str(folder): {
            estimate: {name: group._asdict() for name, group in groups.items()}
            for estimate, groups in measure(Drive.read(folder)).items()
        }
        for folder in args.data
    }


def measure(drive):
    """Return the consistency of each estimate of a drive, by class; without small classes."""
    found = {}
    for estimate in ('final', 'track'):
        for name, results in drive.refined(Config(estimate=estimate)).items():
            boxes = BoxTable.from_arrays([result.boxes for result in results])
            matches = match(boxes, drive.truth)
            groups = consistency(matches, boxes, drive.truth, _covariances(results))
            found[name] = {
                group: values
                for group, values in groups.items()
                if group == 'all' or values.boxes >= MIN_CLASS_BOXES
            }
    return found


def _covariances(results):
    """Return the covariances of all refined boxes by stamp and track id; ranges are unknown."""
    return {
        (result.boxes.stamp_ns, track_id): BoxCovariance(np.nan, pose, extent)
        for result in results
        for track_id, status, pose, extent in zip(
            result.boxes.track_ids,
            result.status,
            result.covariances,
            result.extent_covariances,
            strict=True,
        )
        if status == REFINED
    }
