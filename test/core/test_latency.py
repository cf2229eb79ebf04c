"""The latency of input boxes: found by points, and corrected along the tracks."""

from collections import Counter
from dataclasses import replace

from boxreg_ros.core import latency
from boxreg_ros.core.latency import LateBoxes, NOTABLE, OBJECTS_COMPARED
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.recording import Recording
from boxreg_ros.simulation.scenarios import highway
from boxreg_ros.structures import BoxArray
from measure.drives import Drive
import numpy as np
from paths import BAGS
import pytest
from scenes import drive, START_NS


def late(boxes, seconds):
    """Return box arrays whose stamps are later, each by a number or by its own."""
    times = np.broadcast_to(seconds, len(boxes))
    return [
        replace(array, stamp_ns=array.stamp_ns + round(time * 1e9))
        for array, time in zip(boxes, times, strict=True)
    ]


def estimated(sweeps, boxes):
    """Return the latency that a stream shows."""
    found = LateBoxes()
    for item in sorted([*sweeps, *boxes], key=lambda item: item.stamp_ns):
        if isinstance(item, BoxArray):
            found.add_boxes(item)
        else:
            found.add_sweep(item)
    return found.estimate()


@pytest.fixture(scope='module')
def sample_drive():
    truth = BoxTable.read(BAGS / 'street_truth.csv')
    return Drive.of(Recording([BAGS / 'street.mcap']), truth)


def test_one_latency_is_found_and_none_where_there_is_none(sample_drive):
    for seconds in (0.3, 0.1, 0.0):
        found = estimated(sample_drive.sweeps, late(sample_drive.boxes, seconds))
        assert found.tracks >= 5
        assert found.estimated == pytest.approx(seconds, abs=0.02)
        assert found.deviation < 0.03
        assert found.seconds == (0.0 if seconds < NOTABLE else found.estimated)
        assert bool(found.warning) == (seconds > NOTABLE)


def test_of_many_objects_every_one_is_evidence(sample_drive, monkeypatch):
    # Of a sweep 16 are compared at most: they take turns.
    compared, of_sweep = Counter(), latency._costs

    def counted(sweep, *rest):
        costs = of_sweep(sweep, *rest)
        compared[sweep.stamp_ns] += costs is not None
        return costs

    one = estimated(sample_drive.sweeps, late(sample_drive.boxes, 0.3))
    crowd = [
        replace(
            array, track_ids=tuple(f'{k} {name}' for k in range(10) for name in array.track_ids),
            class_names=10 * array.class_names, scores=np.tile(array.scores, 10),
            boxes=np.tile(array.boxes, (10, 1)),
        )
        for array in sample_drive.boxes
    ]  # fmt: skip
    with monkeypatch.context() as patch:
        patch.setattr(latency, '_costs', counted)
        found = estimated(sample_drive.sweeps, late(crowd, 0.3))
    assert max(compared.values()) == OBJECTS_COMPARED
    assert found.tracks == 10 * one.tracks > 2 * OBJECTS_COMPARED
    assert found.estimated == pytest.approx(0.3, abs=0.02)


def test_a_stream_is_corrected_from_its_first_seconds_on(sample_drive):
    items = [*sample_drive.sweeps, *late(sample_drive.boxes, 0.3)]
    known = LateBoxes()
    shown = []
    for item in sorted(items, key=lambda item: item.stamp_ns):
        if isinstance(item, BoxArray):
            known.add_boxes(item)
            shown.append(known.kept_up().seconds)
        else:
            known.add_sweep(item)
    assert shown[0] == 0
    np.testing.assert_allclose(shown[len(shown) // 2 :], 0.3, atol=0.05)


@pytest.mark.parametrize('at_sight', [False, True], ids=['stamp', 'sight'])
def test_boxes_of_either_time_of_a_sweep_are_not_late(at_sight):
    scene = Drive.from_scene(highway(np.random.default_rng(0), 16, at_sight, 30.0))
    assert estimated(scene.sweeps, scene.boxes).seconds == 0
    shown = estimated(scene.sweeps, late(scene.boxes, 0.2))
    assert shown.seconds == pytest.approx(0.2, abs=0.02)


def test_weak_evidence_corrects_nothing(sample_drive):
    parked = [replace(sample_drive.boxes[0], stamp_ns=a.stamp_ns) for a in sample_drive.boxes]
    found = estimated(sample_drive.sweeps, parked)
    assert (found.seconds, found.estimated) == (0.0, None)
    assert 'nothing moves' in found.finding
    n = len(sample_drive.boxes)
    drifting = late(sample_drive.boxes, np.where(np.arange(n) < n / 2, 0.0, 0.4))
    found = estimated(sample_drive.sweeps, drifting)
    assert found.seconds == 0
    assert 'drifts' in found.warning


def test_boxes_are_moved_to_where_their_objects_are():
    truth = drive(20, speed=8.0)
    stamps = START_NS + 10**8 * np.arange(20)
    arrays = [
        BoxArray(int(s) + 250_000_000, 'odom', ('1',), ('car',), np.ones(1), box[None].copy())
        for s, box in zip(stamps, truth, strict=True)
    ]
    arrays[4].boxes[0, 8] += np.pi  # the heading of the given box is that of the result
    known = LateBoxes()
    for array in arrays:
        known.add_boxes(array)
    whole = [known.corrected(array, 0.25) for array in arrays]
    online = LateBoxes()
    for k, array in enumerate(arrays[:17]):
        online.add_boxes(array)
        predicted = online.corrected(array, 0.25).boxes[0]
        row = k + 2.5  # of the truth at the stamp of the array
        expected = (truth[int(row)] + truth[int(row) + 1]) / 2
        np.testing.assert_allclose(whole[k].boxes[0, :3], expected[:3], atol=0.02)
        turn = np.pi if k == 4 else 0.0
        assert np.cos(whole[k].boxes[0, 8] - expected[8] - turn) > 0.9999
        if k > 4:
            np.testing.assert_allclose(predicted[:3], expected[:3], atol=0.15)
    assert known.corrected(arrays[0], 0.0) is arrays[0]
