"""The latency of input boxes: found by points, and corrected along the tracks."""

from collections import Counter
from dataclasses import replace

from boxreg_ros.config import Config
from boxreg_ros.core import latency
from boxreg_ros.core.latency import Latency, LatencyCorrection, NOTABLE, OBJECTS_COMPARED, STEP
from boxreg_ros.core.matching import Pair
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.transforms import inverse, moved_boxes
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.simulation.scenarios import highway
from boxreg_ros.structures import BoxArray, FrameMotion
from measure.drives import Drive
import numpy as np
from paths import BAGS
import pytest
from scenes import drive, START_NS


def late(boxes, seconds):
    """Return boxes of the fixed frame with later stamps, each by a number or by its own."""
    times = np.broadcast_to(seconds, len(boxes))
    return [
        replace(array, stamp_ns=array.stamp_ns + round(time * 1e9), motion=None)
        for array, time in zip(boxes, times, strict=True)
    ]


def shown(sweeps, boxes):
    """Yield the latency that a stream shows with each box array."""
    correction = LatencyCorrection(waits=False)
    stamps_ns = np.array([sweep.stamp_ns for sweep in sweeps])
    for item in sorted([*sweeps, *boxes], key=lambda item: item.stamp_ns):
        if isinstance(item, BoxArray):
            nearest = sweeps[int(np.abs(stamps_ns - item.stamp_ns).argmin())]
            list(correction.add([Pair(item, nearest)], Config()))
            yield correction.latency
        else:
            correction.add_sweep(item)


def estimated(sweeps, boxes):
    """Return the latency that a whole stream shows."""
    return [*shown(sweeps, boxes)][-1]


@pytest.fixture(scope='module')
def sample_drive():
    truth = BoxTable.read(BAGS / 'street_truth.csv')
    return Drive.of(Recording([BAGS / 'street.mcap']), truth)


def test_one_latency_is_found_and_none_where_there_is_none(sample_drive):
    for seconds in (0.3, 0.1, 0.0, -0.1, -0.3):
        found = estimated(sample_drive.sweeps, late(sample_drive.boxes, seconds))
        assert found.tracks >= 5
        assert found.estimated == pytest.approx(seconds, abs=0.02)
        assert found.deviation < 0.03
        corrected = 0.0 if abs(seconds) < NOTABLE else found.estimated
        assert found.seconds == pytest.approx(corrected, abs=STEP)
        assert bool(found.warning) == (abs(seconds) > NOTABLE)


@pytest.mark.parametrize('seconds', [0.03, 0.05, -0.04, -0.05])
def test_boxes_stamped_steadily_off_their_sweeps_are_late_by_exactly_that(sample_drive, seconds):
    found = estimated(sample_drive.sweeps, late(sample_drive.boxes, seconds))
    assert found.seconds == pytest.approx(seconds, abs=0.002)
    assert f'boxes are {abs(seconds):.2f} s {"late" if seconds > 0 else "early"}' in found.warning


@pytest.mark.parametrize('seconds', [0.03, -0.03, 0.05])
def test_boxes_of_their_stamps_are_in_time_wherever_the_sweeps_are(sample_drive, seconds):
    sweeps, boxes = sample_drive.sweeps, sample_drive.boxes
    tracks = latency.MeasuredTracks(latency.CANDIDATES)
    for array in boxes:
        tracks.add(array, 0)
    moved = [replace(array, boxes=tracks.at_stamp(array, -seconds)) for array in boxes]
    assert estimated(sweeps, late(moved, -seconds)).seconds == 0


@pytest.mark.parametrize('seconds, words', [(-0.6, '0.4 s early'), (1.0, '0.8 s late')])
def test_more_than_is_compared_is_not_corrected_but_said(sample_drive, seconds, words):
    found = estimated(sample_drive.sweeps, late(sample_drive.boxes, seconds))
    assert found.seconds == 0
    assert f'boxes are {words} or more, which is not corrected' in found.warning


@pytest.mark.parametrize('behind, text', [(0, ''), (2, 'behind'), (-2, 'ahead of')])
def test_lidars_that_show_another_latency_each_have_another_clock(sample_drive, behind, text):
    given, sweeps = sample_drive.sweeps[2:-2], []
    for sweep, other in zip(given, sample_drive.sweeps[2 - behind :], strict=False):
        points = sweep.in_frame().points.copy()
        sensors = (points[:, 1] < sweep.origin[1]).astype(np.uint8)
        points[sensors == 1] += (other.origin - sweep.origin).astype(np.float32)
        times = sweep.times - 0.1 * behind * sensors
        origins = np.array([sweep.origin, other.origin])
        sweeps.append(
            replace(
                sweep, points=points, times=times, sensors=sensors, origins=origins,
                T_frame_points=None,
            )
        )  # fmt: skip
    found = estimated(sweeps, sample_drive.boxes)
    assert found.seconds == 0
    assert ('got stamps of LiDAR 2 (in the order' in found.warning) == bool(text)
    assert f's {text} those of LiDAR 1' in found.warning or not text


def test_of_many_objects_every_one_is_evidence(sample_drive, monkeypatch):
    # Of a sweep 16 are compared at most: they take turns.
    compared, sample = Counter(), latency._Sample

    def counted(stamp_ns, *rest):
        compared[stamp_ns] += 1
        return sample(stamp_ns, *rest)

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
        patch.setattr(latency, '_Sample', counted)
        found = estimated(sample_drive.sweeps, late(crowd, 0.3))
    assert max(compared.values()) == OBJECTS_COMPARED
    assert found.tracks == 10 * one.tracks > 2 * OBJECTS_COMPARED
    assert found.estimated == pytest.approx(0.3, abs=0.02)


def test_a_stream_is_corrected_from_its_first_seconds_on(sample_drive):
    found = [one.seconds for one in shown(sample_drive.sweeps, late(sample_drive.boxes, 0.3))]
    # Known once the tracks fit better by two deviations: at the 27th of 50 arrays, after 2.6 s.
    assert found[0] == 0
    np.testing.assert_allclose(found[28:], 0.3, atol=0.05)


@pytest.mark.parametrize('at_sight', [False, True], ids=['stamp', 'sight'])
def test_boxes_of_either_time_of_a_sweep_are_not_late(at_sight):
    scene = Drive.from_scene(highway(np.random.default_rng(0), 16, at_sight, 30.0))
    assert estimated(scene.sweeps, scene.boxes).seconds == 0
    found = estimated(scene.sweeps, late(scene.boxes, 0.2))
    assert found.seconds == pytest.approx(0.2, abs=0.02)


def parabolas(minima, depths=(1.0, 1.0), tracks=16):
    """Return samples of tracks whose costs are least at `minima` [s], as seen and at the stamp."""
    samples = []
    for track in range(tracks):
        shift = 0.004 * (-1) ** track
        costs = [
            np.minimum(np.square(latency.CANDIDATES - least - shift) / 0.04, 1) * depth - depth
            for least, depth in zip(minima, depths, strict=True)
        ]
        samples += [latency._Sample(START_NS, str(track), 10.0, np.array(costs))] * 5
    return samples


def latency_by(samples):
    return latency._estimated(latency._Comparisons.of(samples))


def test_boxes_that_are_in_time_in_one_way_are_in_time():
    # They fit better at the stamp, by 4 deviations: by chance, if they were made where points are.
    found = latency_by(parabolas([-0.01, 0.06], [1.0, 1.1]))
    assert found.seconds == 0
    assert found.estimated == pytest.approx(-0.01, abs=0.005)
    found = latency_by(parabolas([0.07, 0.12], [1.0, 1.1]))
    assert found.seconds == pytest.approx(0.12, abs=0.005)
    found = latency_by(parabolas([0.07, 0.12], [1.1, 1.0]))
    assert found.seconds == pytest.approx(0.07, abs=0.005)


@pytest.mark.parametrize('depth, corrected', [(0.3, 0.0), (0.03, 0.6)])
def test_a_row_of_parked_cars_that_fits_again_further_on_is_in_time(depth, corrected):
    in_time = depth * np.minimum(np.square(latency.CANDIDATES) / 0.01, 1) - depth
    samples = [sample._replace(costs=sample.costs + in_time) for sample in parabolas([0.6, 0.6])]
    assert latency_by(samples).seconds == pytest.approx(corrected, abs=0.005)


def test_tracks_that_do_not_agree_correct_nothing():
    samples = [
        sample._replace(track_id=name)
        for name, least in zip('abcde', [0.65, 0.65, 0.65, 0.4, 0.4], strict=True)
        for sample in parabolas([least, least], tracks=1)
    ]
    found = latency_by(samples)
    assert abs(found.estimated) > latency.SIGNIFICANCE * found.deviation
    assert found.deviation > latency.USABLE_PART * found.estimated
    assert found.seconds == 0
    assert 'not known' in found.finding


def test_weak_evidence_corrects_nothing(sample_drive):
    first = replace(sample_drive.boxes[0], motion=None)
    parked = [replace(first, stamp_ns=array.stamp_ns) for array in sample_drive.boxes]
    found = estimated(sample_drive.sweeps, parked)
    assert (found.seconds, found.estimated) == (0.0, None)
    assert 'nothing moves' in found.finding
    assert not found.warning


def test_a_latency_that_drifts_is_followed_and_said(sample_drive):
    n = len(sample_drive.boxes)
    drifting = late(sample_drive.boxes, np.where(np.arange(n) < n / 2, 0.0, 0.4))
    found = estimated(sample_drive.sweeps, drifting)
    assert found.seconds == pytest.approx(0.4, abs=0.05)
    assert 'drifts' in found.warning


def test_a_change_of_errors_that_corrects_nothing_is_no_drift(sample_drive, monkeypatch):
    monkeypatch.setattr('boxreg_ros.core.latency._differ', lambda older, newer: True)
    found = estimated(sample_drive.sweeps, sample_drive.boxes)
    assert (found.seconds, found.drifts, found.warning) == (0.0, False, '')


def boxes_of(truth, stamps_ns, **more):
    """Return an array per box of an object."""
    return [
        BoxArray(int(stamp), 'odom', ('1',), ('car',), np.ones(1), box[None].copy(), **more)
        for stamp, box in zip(stamps_ns, truth, strict=True)
    ]


def corrected(arrays, waits, latency):
    """Return the arrays in time."""
    correction = LatencyCorrection(waits, Latency(latency))
    found = [p.boxes for a in arrays for p in correction.add([Pair(a, None)], Config())]
    return found + [pair.boxes for pair in correction.flush()]


def test_boxes_are_moved_to_where_their_objects_are():
    truth = drive(20, speed=8.0)
    stamps = START_NS + 10**8 * np.arange(20)
    arrays = boxes_of(truth, stamps + 250_000_000)
    arrays[4].boxes[0, 8] += np.pi  # the heading of the given box is that of the result
    whole, predicted = (corrected(arrays, waits, 0.25) for waits in (True, False))
    assert [a.stamp_ns for a in whole] == [a.stamp_ns for a in arrays]
    for k in range(17):
        row = k + 2.5  # of the truth at the stamp of the array
        expected = (truth[int(row)] + truth[int(row) + 1]) / 2
        np.testing.assert_allclose(whole[k].boxes[0, :3], expected[:3], atol=0.02)
        turn = np.pi if k == 4 else 0.0
        assert np.cos(whole[k].boxes[0, 8] - expected[8] - turn) > 0.9999
        if k > 4:
            np.testing.assert_allclose(predicted[k].boxes[0, :3], expected[:3], atol=0.15)
    assert corrected(arrays, False, 0.0)[0] is arrays[0]


def test_late_boxes_in_a_frame_that_turns_and_drives_are_put_where_they_were_measured():
    """A parked car, seen from a vehicle at 8 m/s that turns by 0.6 rad/s, 0.27 s late."""
    latency = 0.27
    parked = np.array([30.0, 12.0, 0.5, 4.4, 1.8, 1.5, 0, 0, 0.4])

    def pose(seconds):
        yaw = 0.6 * seconds
        T = np.eye(4)
        T[:3, :3] = matrix_from_rpy([0.0, 0.0, yaw])
        T[:2, 3] = 8.0 / 0.6 * np.array([np.sin(yaw), 1 - np.cos(yaw)])
        return T

    arrays = []
    for k in range(12):
        at = 0.1 * k + latency
        stamp_ns = START_NS + round(at * 1e9)
        (given,) = boxes_of([parked], [stamp_ns])
        T_late = pose(at) @ inverse(pose(at - latency))
        given = replace(given, boxes=moved_boxes(given.boxes, T_late))
        times = at - 0.1 * np.arange(10, -1, -1)
        motion = FrameMotion(
            START_NS + np.round(times * 1e9).astype(np.int64), np.array([*map(pose, times)])
        )
        arrays.append(replace(given, motion=motion))
    assert np.linalg.norm(arrays[-1].boxes[0, :2] - parked[:2]) > 3
    for waits in (False, True):
        for array in corrected(arrays, waits, latency):
            np.testing.assert_allclose(array.boxes[0], parked, atol=0.02)
