"""Simulated scenes: properties by construction, and the round trip through files."""

import argparse
from itertools import combinations

from boxreg_ros.core.metrics import iou_bev
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.offline.box_scores import match, summarise
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.simulation import simulate as cli
from boxreg_ros.simulation.noise import detector_noise, TABLE_ONE
from boxreg_ros.simulation.raycast import (
    Actor,
    BODIES,
    body,
    box_planes,
    cast,
    Motion,
    revolution,
    ROAD,
    Sensor,
    to_matrix,
)
from boxreg_ros.simulation.scenarios import EXTENTS
from boxreg_ros.simulation.scene import boxes_of, is_near
from boxreg_ros.simulation.simulate import simulate
from boxreg_ros.structures import BoxArray, Sweep, YAW
from measure.drives import tracks_of
import numpy as np
from paths import BAGS
import pytest
from scenes import simulated
from scipy.optimize import linprog


@pytest.fixture(scope='module')
def street():
    return simulate('street', seed=3, sweeps=12)


@pytest.fixture(scope='module')
def paper():
    return simulated('paper', 1)


def run(*words):
    parser = argparse.ArgumentParser()
    cli.add_arguments(parser)
    return cli.run(parser.parse_args([str(word) for word in words]))


@pytest.mark.parametrize('shape', BODIES)
def test_bodies_fill_their_boxes(shape):
    extent = np.array(EXTENTS[shape])
    parts = body(shape, extent)
    reach = np.zeros((2, 3))
    for planes in parts:
        for axis in range(3):
            for side, sign in enumerate((1, -1)):
                end = linprog(
                    -sign * np.eye(3)[axis], planes[:, :3], planes[:, 3], bounds=[(None, None)] * 3
                )
                assert end.status == 0, 'a part is empty or open'
                reach[side, axis] = max(reach[side, axis], -end.fun)
    np.testing.assert_allclose(reach, np.stack([extent, extent]) / 2, atol=1e-6)


def test_views_are_convex_and_counter_clockwise():
    for views in (views for parts in BODIES.values() for views in parts):
        for view in views:
            edges = np.roll(view, -1, axis=0) - np.array(view)
            after = np.roll(edges, -1, axis=0)
            assert (edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0] > -1e-9).all(), view


def test_cast_by_hand():
    box = [box_planes(np.array([4.0, 2.0, 1.0]))]
    origins = np.array([[10, 0, 0], [10, 0, 0], [0, 5, 0], [10, 1.5, 0], [10, 0, 0]], float)
    directions = np.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [-1, 0, 0], [-1, 1, 0]], float)
    assert cast(box, origins, directions).tolist() == [8, np.inf, 4, np.inf, np.inf]
    nearer = [*box, box_planes(np.array([6.0, 0.5, 1.0]))]
    assert cast(nearer, origins, directions)[0] == 7


def test_points_are_on_their_bodies(street):
    """Own returns lie in the box at the time they were measured, and road returns on z = 0."""
    inside = []
    for i, (sweep, owner) in enumerate(zip(street.sweeps, street.owners, strict=True)):
        T = street.T_fixed_sensor[i]
        points = sweep.points @ T[:3, :3].T + T[:3, 3]
        assert np.abs(points[owner == ROAD, 2]).max() < 0.1
        for a, actor in enumerate(street.actors):
            when = 0.1 * i + sweep.times[owner == a]
            local = in_body_frame(actor.motion.at(when), points[owner == a])
            inside.append((np.abs(local) <= actor.extent / 2 + 0.08).all(axis=1))
    assert np.concatenate(inside).mean() > 0.998
    assert sum(map(len, inside)) > 3000 * len(street.sweeps)


def in_body_frame(poses, points):
    T = np.linalg.inv(to_matrix(poses))
    return np.einsum('mij,mj->mi', T[:, :3, :3], points) + T[:, :3, 3]


def test_moving_objects_are_measured_when_their_ray_leaves():
    """A car passes behind the sensor, where a revolution begins and ends: it is smeared."""
    extent = np.array([4.0, 1.8, 1.5])
    times = np.array([-1.0, 1.0])
    passing = Motion(
        times, np.array([[-8, -20, 0.75, 0, 0, np.pi / 2], [-8, 20, 0.75, 0, 0, np.pi / 2]])
    )
    ego = Motion(times, np.array([[0, 0, 1.5, 0, 0, 0]] * 2, float))
    car = Actor('1', 'car', 'car', extent, passing)
    sensor = Sensor(np.radians(np.linspace(-15, 0, 16)), columns=720, noise=0.0)
    rng = np.random.default_rng(0)
    points, moments, owners = revolution([car], [body('car', extent)], ego, sensor, 0.0, rng)
    points, moments = points[owners == 0], moments[owners == 0]
    then = np.abs(in_body_frame(passing.at(moments), points)) - extent / 2
    now = np.abs(in_body_frame(passing.at(0 * moments), points)) - extent / 2
    assert then.max() < 1e-9
    assert 0.5 < now[:, 0].max() < 1.01
    assert moments.max() - moments.min() > 0.09


def test_each_ray_gives_one_point(street):
    """Azimuth and time of every point belong to one ray, so nothing is seen through a body."""
    for sweep, T in zip(street.sweeps, street.T_fixed_sensor, strict=True):
        ego_speed = 6.0  # [m/s], to undo the motion of the sensor
        moved = sweep.points @ T[:3, :3].T - np.outer(sweep.times, [ego_speed, 0, 0])
        azimuth = np.arctan2(moved[:, 1], moved[:, 0])
        assert np.abs(azimuth / (2 * np.pi) * 0.1 - sweep.times).max() < 1e-3


def test_street_has_parked_turning_and_reversing_cars(street):
    whole = simulated('street', 0).actors
    times = np.arange(50) * 0.1
    boxes = [boxes_of(actor, actor.motion.at(times)) for actor in whole]
    for one, other in combinations(boxes, 2):
        assert iou_bev(one, other).max() == 0
    steps = [np.diff(b[:, :2], axis=0) for b in boxes]
    forward = [
        (s * np.c_[np.cos(b[1:, 8]), np.sin(b[1:, 8])]).sum(1)
        for s, b in zip(steps, boxes, strict=True)
    ]
    assert sum(np.abs(f).max() < 1e-9 for f in forward) >= 10, 'parked'
    assert sum(f.min() < -0.05 for f in forward) == 1, 'reversing'
    assert sum(np.ptp(b[:, 8]) > 1.5 for b in boxes) == 1, 'turning'
    assert {actor.shape for actor in whole} == BODIES.keys() - {'tractor', 'trailer'}
    returns = street.truth.num_points
    assert (returns == 0).sum() < len(returns) / 10
    assert (returns > 500).any()


def test_articulated_trucks_bend_in_curves():
    """A box around both holds the points of both; the axle of a trailer does not slip."""
    joined, parts = (simulate(name, 2, 20) for name in ('articulated', 'articulated-parts'))
    times = np.arange(20) * 0.1
    boxes = {actor.track_id: boxes_of(actor, actor.motion.at(times)) for actor in parts.actors}
    names = [actor.track_id for actor in joined.actors]
    for name in (actor.track_id for actor in joined.actors if actor.class_name == 'truck'):
        tractor, trailer = boxes[name], boxes[f'{name}b']
        bend = np.abs(wrap_angle(tractor[:, 8] - trailer[:, 8]))
        assert bend[:5].max() < 1e-9
        assert 0.15 < bend.max() < 0.7
        axle = trailer[:, :2] - 0.225 * trailer[:, 3:4] * heading_of(trailer)
        steps = np.diff(axle, axis=0)
        left = heading_of(trailer)[1:, ::-1] * [-1, 1]
        across = (left * steps).sum(axis=1)
        assert np.abs(across).max() < 0.02 * 0.7  # of 0.4 m and more
        whole = joined.truth.boxes[np.array(joined.truth.track_ids) == name]
        assert np.ptp(whole[:, 4]) > 0.5
    for sweep, owner, T in zip(joined.sweeps, joined.owners, joined.T_fixed_sensor, strict=True):
        at = np.flatnonzero(joined.truth.stamps_ns == sweep.stamp_ns)
        points = sweep.points @ T[:3, :3].T + T[:3, 3]
        for row in at:
            own = points[owner == names.index(joined.truth.track_ids[row])]
            assert is_near(own, joined.truth.boxes[row], 0.5).all()


def test_parked_cars_stand_bumper_to_bumper():
    scene = simulate('parked', 1, 2)
    boxes = np.array([boxes_of(actor, actor.motion.at(np.zeros(1)))[0] for actor in scene.actors])
    for row in (boxes[:8], boxes[8:]):
        ends = row[:, :1] + row[:, 3:4] / 2 * [-1, 1]
        np.testing.assert_allclose(ends[1:, 0] - ends[:-1, 1], 0.2)


def heading_of(boxes):
    return np.stack([np.cos(boxes[:, 8]), np.sin(boxes[:, 8])], axis=1)


def test_detector_noise_has_the_documented_statistics():
    rng = np.random.default_rng(0)
    truth = np.tile([20.0, 5, 1, 4.4, 1.8, 1.5, 0, 0, 0.5], (60, 1))
    tracks = np.stack([detector_noise(truth, np.zeros((60, 3)), rng) for _ in range(300)])
    errors = tracks - truth
    forward = errors[..., 0] * np.cos(0.5) + errors[..., 1] * np.sin(0.5)
    assert forward.std() == pytest.approx(0.17, abs=0.03)
    assert errors[..., 3].std() == pytest.approx(0.28, abs=0.03)
    assert np.abs(np.mean(errors[..., 3])) < 0.04
    correlation = np.corrcoef(forward.ravel(), errors[..., 3].ravel())[0, 1]
    assert 0.3 < correlation < 0.8  # sensor behind: a longer box reaches forward
    per_track = np.corrcoef(errors[:, 0, 2], errors[:, -1, 2])[0, 1]
    assert 0.2 < per_track < 0.6, 'a constant of the track'
    assert 0.018 < (np.abs(errors[..., 8]) > 2).mean() < 0.03


def test_paper_path_follows_equation_ten(paper):
    poses = paper.truth.boxes[:, [0, 1, 2, 6, 7, 8]]
    poses[:, 5] = np.unwrap(poses[:, 5])
    steps = np.diff(poses, axis=0)
    np.testing.assert_allclose(np.abs(steps[:, 5]).max(), 2 * np.pi / 100)
    np.testing.assert_allclose(np.abs(steps[:, 4]).max(), np.pi / 300)
    np.testing.assert_allclose(np.abs(steps[:, 3]).max(), np.pi / 600)
    assert poses[:, 5].max() == pytest.approx(np.pi, abs=0.1)
    np.testing.assert_allclose(np.linalg.norm(steps[:, :3], axis=1), 0.5)  # no slip, Eq. 7
    heading = to_matrix(poses)[1:, :3, 0]
    np.testing.assert_allclose(heading, steps[:, :3] / 0.5, atol=1e-9)
    flat = simulate('paper-bev', seed=1)
    assert not flat.truth.boxes[:, 6:8].any()


def test_paper_noise_has_the_errors_of_table_one():
    scenes = [simulated('paper', seed) for seed in range(4)]
    scores, errors = [], []
    for scene in scenes:
        boxes = BoxTable.from_arrays(scene.fixed_detections())
        scores.append(summarise(match(boxes, scene.truth)))
        R = to_matrix(scene.truth.boxes[:, [0, 1, 2, 6, 7, 8]])[:, :3, :3]
        moved = boxes.boxes[:, :3] - scene.truth.boxes[:, :3]
        errors.append(np.einsum('nij,ni->nj', R, moved))
    measured = np.abs(np.concatenate(errors)).mean(axis=0)
    np.testing.assert_allclose(measured, TABLE_ONE[:3], rtol=0.15)
    assert np.mean([s.iou_3d for s in scores]) == pytest.approx(0.58, abs=0.03)
    assert np.mean([s.iou_bev for s in scores]) == pytest.approx(0.68, abs=0.03)
    points = [len(sweep.points) for sweep in scenes[0].sweeps]
    assert max(points) > 1.5 * min(points), 'areas are occluded at random'


def test_tracks_hold_all_detections(street):
    tracks = {track.track_id: track for track in tracks_of(street)}
    assert sum(len(t.boxes) for t in tracks.values()) == sum(
        len(a.track_ids) for a in street.detections
    )
    truth = BoxTable.from_arrays(street.fixed_detections())
    track = tracks['10']
    rows = [i for i, name in enumerate(truth.track_ids) if name == '10']
    np.testing.assert_allclose(track.boxes, truth.boxes[rows], atol=1e-9)
    assert track.sensor_origins.shape == (len(rows), 3)
    assert all(len(points) for points in track.points)
    offsets = np.linalg.norm(track.points[0] - track.boxes[0, :3], axis=1)
    assert offsets.max() < np.linalg.norm(track.boxes[0, 3:6] / 2 + 1.5)


def test_recording_round_trip(street, tmp_path):
    path = tmp_path / 'short.mcap'
    assert run('-o', path, '--seed', 3, '--sweeps', 12) == 0
    truth = BoxTable.read(tmp_path / 'short_truth.csv')
    # -pi and pi are the same yaw.
    difference = truth.boxes - street.truth.boxes
    np.testing.assert_allclose(difference[:, :YAW], 0.0, atol=1e-8)
    np.testing.assert_allclose(wrap_angle(difference[:, YAW]), 0.0, atol=1e-8)
    assert truth.num_points.tolist() == street.truth.num_points.tolist()
    tree = TransformTree()
    with Recording([path]) as recording:
        items = [item.content for item in recording.items(tree)]
    sweeps = [item for item in items if isinstance(item, Sweep)]
    arrays = [item for item in items if isinstance(item, BoxArray)]
    assert len(sweeps) == len(arrays) == 12
    for read, made in zip(sweeps, street.sweeps, strict=True):
        assert read.stamp_ns == made.stamp_ns
        np.testing.assert_array_equal(read.points, made.points)
        np.testing.assert_allclose(read.times, made.times, atol=1e-6)
    for read, made in zip(arrays, street.detections, strict=True):
        assert read.track_ids == made.track_ids
        np.testing.assert_allclose(read.boxes, made.boxes, atol=1e-9)
    T = tree.lookup('odom', 'lidar', street.sweeps[5].stamp_ns)
    np.testing.assert_allclose(T, street.T_fixed_sensor[5], atol=1e-9)


def test_same_seed_gives_the_same_bytes(tmp_path):
    for name in ('one', 'two'):
        (tmp_path / name).mkdir()
        run('-o', tmp_path / name / 'a.mcap', '--sweeps', 4, '--truth', tmp_path / name / 't.csv')
    assert (tmp_path / 'one/a.mcap').read_bytes() == (tmp_path / 'two/a.mcap').read_bytes()
    assert (tmp_path / 'one/t.csv').read_bytes() == (tmp_path / 'two/t.csv').read_bytes()
    assert sorted(p.name for p in (tmp_path / 'one').iterdir()) == ['a.mcap', 't.csv']
    other = simulate('street', seed=1, sweeps=1).sweeps[0].points
    assert other.shape != simulate('street', seed=0, sweeps=1).sweeps[0].points.shape


def test_wrong_arguments_are_refused(tmp_path):
    expected = 'scenario: expected one of street, highway, highway-sight, articulated, '
    with pytest.raises(ConfigError, match=expected):
        simulate('moon')
    with pytest.raises(ConfigError, match='sweeps: expected 1 or more, got 0'):
        simulate('street', sweeps=0)
    with pytest.raises(ConfigError, match='seed: expected 0 or more, got -1'):
        simulate('street', seed=-1)
    same = tmp_path / 'same.mcap'
    with pytest.raises(ConfigError, match='got the recording itself'):
        run('-o', same, '--truth', tmp_path / '.' / 'same.mcap')
    assert not same.exists()
    with pytest.raises(RecordingError, match=r'ends in \.mcap'):
        run('-o', tmp_path / 'street.bag', '--sweeps', 1)
    with pytest.raises(RecordingError, match='cannot be written'):
        run('-o', tmp_path / 'absent' / 'street.mcap', '--sweeps', 1)


def test_sample_recording_equals_the_street():
    """The committed recording is seed 0 of the street; compressed bytes may differ by version."""
    path = BAGS / 'street.mcap'
    assert path.stat().st_size < 5e6
    first = simulated('street', 0)
    truth = BoxTable.read(BAGS / 'street_truth.csv')
    errors = truth.boxes - first.truth.boxes
    errors[:, YAW] = wrap_angle(errors[:, YAW])  # pi and -pi are the same heading
    np.testing.assert_allclose(errors, 0, atol=1e-6)
    assert truth.num_points.tolist() == first.truth.num_points.tolist()
    with Recording([path]) as recording:
        tree = TransformTree()
        contents = (item.content for item in recording.items(tree))
        sweep = next(content for content in contents if isinstance(content, Sweep))
    np.testing.assert_array_equal(sweep.points, first.sweeps[0].points)
