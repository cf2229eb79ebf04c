"""Boxes of what is seen of objects, as those of clusters: found by their points, lengthened."""

from dataclasses import replace

from boxreg_ros.config import Config
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.core.visible_boxes import lengthened, MIN_BOXES_COMPARED, whole_extents
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.session import hand_to_registrar
from boxreg_ros.structures import BOX_EXTENT
from measure.clusters import scores
from measure.drives import Drive
import numpy as np
from paths import BAGS
import pytest


@pytest.fixture(scope='module')
def whole():
    """Return a drive with boxes of whole objects."""
    return Drive.of(Recording([BAGS / 'street.mcap']), BoxTable.read(BAGS / 'street_truth.csv'))


@pytest.fixture(scope='module')
def clustered(whole):
    """Return the drive with boxes of clusters."""
    return whole.clustered()


def test_boxes_of_clusters_become_boxes_of_whole_objects(clustered):
    found = scores(clustered)
    best = max(score for name, score in found.items() if 'ours,' not in name)  # of both smoothers
    for estimate, gain in (('early', 0.1), ('final', 0.1), ('track', 0.15)):
        given = found[f'ours, as given, {estimate}']
        assert found[f'ours, {estimate}'] > max(best, given) + gain


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
            if observation.table.is_pinned[observation.row]:
                pinned += 1
                assert entry.given is None
            else:
                lengthened_ones += (entry.box != entry.given).any()
    assert min(pinned, lengthened_ones) > 30


def test_the_side_toward_the_sensor_stays():
    box = np.array([10.0, 5.0, 1.0, 2.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    extents = np.array([4.0, 2.0, 1.5])
    # From behind, and from the right: rear, right side and bottom stay.
    found = lengthened(box, extents, np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(found, [11.0, 5.5, 1.25, 4.0, 2.0, 1.5, 0.0, 0.0, 0.0])
    # The same, where it is turned by a quarter: its left side and its rear are seen.
    turned = np.array([*box[:8], np.pi / 2])
    found = lengthened(turned, extents, np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(found[:3], [10.5, 6.0, 1.25])
    # From straight behind both sides are seen.
    found = lengthened(box, extents, np.array([0.0, 5.1, 1.0]))
    np.testing.assert_allclose(found[:3], [11.0, 5.0, 1.25])
    # From an unknown place, and where nothing is longer.
    found = lengthened(box, extents, np.full(3, np.nan))
    np.testing.assert_allclose(found[:3], [10.0, 5.0, 1.25])
    np.testing.assert_array_equal(lengthened(box, box[BOX_EXTENT] / 2, np.zeros(3)), box)


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
