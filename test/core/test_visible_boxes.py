"""Boxes of what is seen of objects, as those of clusters: found by their points, lengthened."""

from dataclasses import replace

from boxreg_ros.config import Config
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.core.visible_boxes import lengthened, MIN_BOXES_COMPARED, whole_extents
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.session import hand_to_registrar
from boxreg_ros.offline.box_scores import match, summarise
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import BOX_CENTER, BOX_EXTENT, BoxArray, ROLL
from measure.drives import Drive
import numpy as np
from paths import BAGS
import pytest

FEWEST = 8  # points of a cluster


def cluster(points, box):
    """Return the box (9,) around the points in a true one and above the road; None of few."""
    R = matrix_from_rpy(box[ROLL:])
    local = (points - box[BOX_CENTER]) @ R
    half = box[BOX_EXTENT] / 2
    local = local[(np.abs(local) <= half + 0.15).all(1) & (local[:, 2] > 0.2 - half[2])]
    if len(local) < FEWEST:
        return None
    low, high = local.min(0), local.max(0)
    low[2] = -half[2]  # on the road
    found = box.copy()
    found[BOX_CENTER] += R @ ((low + high) / 2)
    found[BOX_EXTENT] = (high - low).clip(0.1)
    return found


@pytest.fixture(scope='module')
def whole():
    """Return a drive with boxes of whole objects."""
    return Drive.of(Recording([BAGS / 'street.mcap']), BoxTable.read(BAGS / 'street_truth.csv'))


@pytest.fixture(scope='module')
def clustered(whole):
    """Return the drive with boxes of clusters."""
    truth, arrays = whole.truth, []
    sweeps = {sweep.stamp_ns: sweep.in_frame().points for sweep in whole.sweeps}
    for stamp_ns in np.unique(truth.stamps_ns).tolist():
        rows = np.flatnonzero(truth.stamps_ns == stamp_ns).tolist()
        found = {row: cluster(sweeps[stamp_ns], truth.boxes[row]) for row in rows}
        rows = [row for row in rows if found[row] is not None]
        arrays.append(
            BoxArray(
                stamp_ns, truth.frame_id, tuple(truth.track_ids[row] for row in rows),
                tuple(truth.class_names[row] for row in rows), np.ones(len(rows)),
                np.array([found[row] for row in rows]),
            )
        )  # fmt: skip
    return replace(whole, boxes=tuple(arrays))


def iou(table, truth):
    """Return the mean 3D IoU."""
    return summarise(match(table, truth, 1)).iou_3d


def registered(drive, **settings):
    """Return early and final boxes, or those of whole tracks."""
    return drive.registered(Config().updated(settings))


def test_boxes_of_clusters_become_boxes_of_whole_objects(clustered):
    given = iou(BoxTable.from_arrays(clustered.boxes), clustered.truth)
    assert given < 0.6
    visible, as_given = (
        {'sampling.box_extents': one, 'estimate': 'final'} for one in ('auto', 'whole')
    )
    for estimate, boxes in registered(clustered, **visible).items():
        score = iou(boxes, clustered.truth)
        assert score > given + 0.1
        assert score > iou(registered(clustered, **as_given)[estimate], clustered.truth) + 0.1
    of_tracks = registered(clustered, estimate='track')['track']
    assert iou(of_tracks, clustered.truth) > given + 0.15


def test_boxes_of_whole_objects_are_not_lengthened(whole):
    registrar = BoxRegistrar(Config(estimate='early'))
    for item in whole.items():
        hand_to_registrar(registrar, item, restarts=False)
    assert registrar.visible_boxes._boxes.total() > MIN_BOXES_COMPARED
    assert not registrar.visible_boxes.are_found
    assert not registrar.visible_boxes.warning


def test_what_boxes_hold_is_found_once_and_kept_by_a_reset(clustered):
    registrar = BoxRegistrar(Config(estimate='early'))
    found = []
    for item in clustered.items():
        hand_to_registrar(registrar, item, restarts=False)
        found.append(registrar.visible_boxes.are_found)
    assert found == sorted(found)
    assert 10 < sum(found) < len(found)
    assert 'sampling.box_extents=whole' in registrar.visible_boxes.warning
    registrar.reset()
    assert registrar.visible_boxes.are_found


def test_a_box_of_a_person_is_not_lengthened(clustered):
    row = 0
    arrays = [
        replace(array, pinned=np.arange(len(array.track_ids)) == row) for array in clustered.boxes
    ]
    drive = replace(clustered, boxes=tuple(arrays))
    config = Config().updated({'sampling.box_extents': 'visible', 'estimate': 'final'})
    registrar = BoxRegistrar(config)
    pinned = lengthened_ones = 0
    for item in drive.items():
        hand_to_registrar(registrar, item, restarts=False)
        for track in registrar._tracks.values():
            entry, observation = track.entries[-1], track.seen[-1]
            np.testing.assert_array_equal(observation.box, entry.box)
            if entry.is_pinned:
                pinned += 1
                assert entry.given is None
            else:
                lengthened_ones += (entry.box != entry.given).any()
    assert min(pinned, lengthened_ones) > 30


def test_the_side_toward_the_sensor_stays():
    box = np.array([[10.0, 5.0, 1.0, 2.0, 1.0, 1.0, 0.0, 0.0, 0.0]])
    extents = np.array([[4.0, 2.0, 1.5]])
    # From behind, and from the right: rear, right side and bottom stay.
    found = lengthened(box, extents, np.array([[-10.0, -5.0, 0.0]]))
    np.testing.assert_allclose(found, [[11.0, 5.5, 1.25, 4.0, 2.0, 1.5, 0.0, 0.0, 0.0]])
    # From straight behind both sides are seen.
    found = lengthened(box, extents, np.array([[-10.0, 0.1, 0.0]]))
    np.testing.assert_allclose(found[0, :3], [11.0, 5.0, 1.25])
    # From an unknown place, and where nothing is longer.
    found = lengthened(box, extents, np.full((1, 3), np.nan))
    np.testing.assert_allclose(found[0, :3], [10.0, 5.0, 1.25])
    np.testing.assert_array_equal(lengthened(box, box[:, BOX_EXTENT] / 2, np.ones((1, 3))), box)


def test_extents_of_a_track_follow_what_it_shows():
    shown = [np.array([length, 1.8, 1.5]) for length in (1.0, 2.0, 4.0)]
    first = whole_extents(shown[:1], None)
    np.testing.assert_array_equal(first, shown[0])
    grown = whole_extents(shown, first)
    assert 3.5 < grown[0] <= 4.0
    # A small change is none, and two objects in one cluster are few.
    known = np.array([4.1, 1.8, 1.5])
    same = [*shown, *[np.array([4.0, 1.8, 1.5])] * 40]
    assert whole_extents(same, known) is known
    assert whole_extents(same, 1.2 * known) is not known
    merged = whole_extents([*same, np.array([9.0, 3.0, 1.5])], None)
    np.testing.assert_allclose(merged, [4.0, 1.8, 1.5])
