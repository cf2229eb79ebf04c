"""The compiled searches against their torch twins, fallbacks, and independence of windows."""

from dataclasses import fields, replace
import os
import shutil
import subprocess
import sys

from boxreg_ros.config import Config
from boxreg_ros.core import batch, prior, registration, rigid_shape
from boxreg_ros.core.batch import (
    EXTENT,
    free_variables,
    MarginalPrior,
    Posterior,
    SHARED,
    Solution,
    State,
)
from boxreg_ros.core.expectation import expect, expectation_numbers, InputEstimates
from boxreg_ros.core.face_support import (
    FaceOffsets,
    FAR,
    observe_faces_compiled,
    observe_faces_torch,
)
from boxreg_ros.core.geometry import rotation_from_rpy
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.core.input_noise import estimate_noise_compiled, estimate_noise_torch, InputNoise
from boxreg_ros.core.kernels import contiguous
from boxreg_ros.core.kernels.arrays import ExpectedArrays, FaceArrays, PriorArrays
from boxreg_ros.core.margin_spread import GapScatter
from boxreg_ros.core.observation import own_points, own_points_numpy
from boxreg_ros.core.population import Population
from boxreg_ros.core.registration import register
from boxreg_ros.core.rounds import (
    MOTION_TERMS,
    Round,
    run_round_compiled,
    run_round_torch,
    SolverPlan,
)
from boxreg_ros.core.weights import robustify_motion, weigh, weight_numbers
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import Sweep
import numpy as np
from paths import ROOT
import pytest
from scenes import (
    drive,
    problem_of,
    returns_of,
    track_of,
    window_of,
)
from test_kernels import term_arrays
import torch

D = torch.float64
arrowhead = pytest.importorskip('boxreg_ros.core.kernels.arrowhead')
expectation = pytest.importorskip('boxreg_ros.core.kernels.expectation')
face_support = pytest.importorskip('boxreg_ros.core.kernels.face_support')
normal_equations = pytest.importorskip('boxreg_ros.core.kernels.normal_equations')
rounds = pytest.importorskip('boxreg_ros.core.kernels.rounds')
weights = pytest.importorskip('boxreg_ros.core.kernels.weights')


def assert_equal(found, known, tolerance=1e-9):
    """Check that arrays are equal up to a part of the largest entry of `known`."""
    found, known = np.asarray(found), np.asarray(known)
    scale = np.abs(known[np.isfinite(known)]).max(initial=1e-300)
    np.testing.assert_allclose(found, known, rtol=0, atol=tolerance * scale)


def surfaces(seed, B=3, N=5, M=90):
    """Return points (B, N, M, 3) on and near the faces of boxes of 4 x 2 x 1.6 m."""
    rng = np.random.default_rng(seed)
    half = np.array([2.0, 1.0, 0.8])
    points = rng.uniform(-1, 1, (B, N, M, 3))
    axis, sign = rng.integers(0, 3, (B, N, M, 1)), rng.choice([-1.0, 1.0], (B, N, M, 1))
    np.put_along_axis(points, axis, sign, 3)
    return points * half + 0.15 * rng.normal(size=points.shape)


def cases():
    """Yield the name of each case, its points and mask, and changes of the problem."""
    rng = np.random.default_rng(1)
    points = surfaces(0)
    shape = points.shape[:3]
    every = np.ones(shape, bool)
    yield 'usual', points, rng.random(shape) < 0.8, {}
    yield 'no points', points, ~every, {}
    yield 'one point', points, np.arange(shape[2]) < np.ones((*shape[:2], 1)), {}
    yield 'all points equal', np.broadcast_to(points[:, :, :1], points.shape), every, {}
    yield 'all far away', points + 100.0, every, {}
    yield 'a road', points, every, {'ground': np.full(shape[:2], -0.85)}
    broken = points.copy()
    broken[1] = np.nan
    yield 'one window not finite', broken, every, {}


CASES = {name: rest for name, *rest in cases()}


def searched(case):
    """Return the problem of a case, and boxes near those of the input."""
    points, mask, changes = CASES[case]
    B, N = mask.shape[:2]
    rng = np.random.default_rng(2)
    boxes = np.zeros((B, N, 9))
    boxes[..., 3:6] = [4.0, 2.0, 1.6]
    boxes[..., 8] = rng.uniform(-3, 3, (B, N))
    problem = problem_of(boxes, points=points, mask=mask, class_numbers={'shape': 0.03}, **changes)
    pose = problem.pose + 0.1 * torch.from_numpy(rng.normal(size=(B, N, 6)))
    shared = torch.zeros(B, SHARED, dtype=D)
    shared[:, EXTENT] = torch.tensor([4.1, 1.9, 1.7], dtype=D)
    return problem, State(pose, shared)


# Spreads of margins as the settings have them, narrower and wider ones.
SCATTER = GapScatter(
    torch.tensor([0.0, 0.0, 1e-3, 1e-3, 0.02, 0.1], dtype=D) ** 2 + 3e-3,
    torch.tensor([0.0, 0.0, 40.0, 40.0, 9.0, 200.0], dtype=D),
    torch.full((6,), 0.05, dtype=D),
)
OFFSETS = FaceOffsets(
    torch.zeros(6, dtype=D),
    torch.tensor([0.3, 0.3, 0.2, 0.2, 0.0, 0.0], dtype=D),
    torch.tensor([0.1, 0.1, 0.05, 0.05, 0.0, 0.0], dtype=D),
)


def assert_same_faces(problem, state, config):
    """Check the face observations by the kernel; return which faces have a weight."""
    found = observe_faces_compiled(problem, state, OFFSETS, config)
    known = observe_faces_torch(problem, state, OFFSETS, config)
    is_seen = (known.weight > 0) & problem.valid[..., None]
    for name in ('moments', 'distance', 'inset'):
        pair = (getattr(side, name)[is_seen] for side in (found, known))
        assert_equal(*pair)
    assert_equal(found.weight[problem.valid], known.weight[problem.valid].nan_to_num())
    assert_equal(found.inset_shares[problem.valid], known.inset_shares[problem.valid])
    assert_equal(found.num_points[problem.valid], known.num_points[problem.valid])
    return is_seen


@pytest.mark.parametrize('strips', [False, True])
@pytest.mark.parametrize('share', [0.02, 0.9])
@pytest.mark.parametrize('case', CASES)
def test_face_observations_equal_those_of_torch(case, share, strips):
    problem, state = searched(case)
    config = Config().updated({'faces.outermost': share, 'ingredients.strips': strips})
    is_seen = assert_same_faces(problem, state, config)
    if case == 'usual':
        assert is_seen.sum() > 30


@pytest.mark.parametrize('far, sensors', [(10.0, 1), (60.0, 1), (30.0, 3)])
def test_observed_faces_from_known_sensors_equal_those_of_torch(far, sensors):
    problem, state = searched('a road')
    rng = np.random.default_rng(6)
    origins = far * torch.from_numpy(rng.normal(size=(*problem.valid.shape, sensors, 3)))
    origins[0, 0] = torch.nan
    valid = problem.valid.clone()
    valid[1, 3:] = False
    points, mask, _ = problem.padded()
    mask = mask & valid[..., None]
    delays = 0.05 * torch.from_numpy(rng.normal(size=mask.shape))
    problem = problem._replace(origins=origins, valid=valid, **returns_of(points, mask, delays))
    assert_same_faces(problem, state, Config())
    assert_same_faces(problem, state, Config().updated({'ingredients.range_inset': False}))


def weighed(problem, state, config):
    """Return the terms of each window by torch, and by the kernel, with robust motion."""
    observations = observe_faces_torch(problem, state, OFFSETS, config)
    expected = expect(problem, InputEstimates(OFFSETS))
    known = [
        robustify_motion(term, state) if term.function in MOTION_TERMS else term
        for term in weigh(problem, state, observations, expected, config)
    ]
    B, N = problem.valid.shape
    prior = PriorArrays(problem.prior_mean.numpy(), problem.prior_information.numpy())
    poses, shared = (part.numpy() for part in state)
    faces = FaceArrays(*map(contiguous, observations))
    windows, of_class, numbers = (
        problem.arrays(), problem.class_arrays(), weight_numbers(config, True)
    )  # fmt: skip
    pairs = []
    for b in range(B):
        terms = normal_equations.unweighted_terms(N, 0, prior, b)
        weights.weigh(
            b, windows, poses[b], shared[b], b, faces,
            ExpectedArrays(*(part[b].numpy() for part in expected)), of_class, numbers, terms,
        )  # fmt: skip
        pairs.append((term_arrays(known, problem, b), terms))
    return pairs


def drives(kind, N=12):
    """Return a problem of three cars, one with two boxes less, and boxes near the input."""
    rng = np.random.default_rng(4)
    boxes = np.array([drive(N, speed=speed, turn=0.1) for speed in (3, 5, 9)])
    if kind in ('still', 'drives off'):
        boxes[:2] = boxes[:2, :1]
    if kind == 'drives off':
        boxes[0, -5:, 0] += 0.2 * np.arange(1, 6)
    if kind == 'one outlier':
        boxes[0, 5, :2] += 8.0
        boxes[0, 5, 8] += 1.6
    boxes += 0.02 * rng.normal(size=boxes.shape)
    valid = np.ones((3, N), bool)
    valid[1, N - 2 :] = False
    points = surfaces(7, 3, N)
    mask = np.broadcast_to(valid[..., None], points.shape[:3])
    problem = problem_of(
        boxes, points=points, mask=mask, valid=valid, ground=np.full((3, N), -0.8),
        class_numbers={
            field.name: getattr(Config().vehicle, field.name)
            for field in fields(Config().vehicle)[1:]
        },
    )  # fmt: skip
    pose = problem.pose + 0.05 * torch.from_numpy(rng.normal(size=(3, N, 6)))
    shared = expect(problem, InputEstimates(OFFSETS)).shared
    return problem, State(pose, shared + 0.02 * torch.from_numpy(rng.normal(size=shared.shape)))


@pytest.mark.parametrize('kind', ['usual', 'still', 'drives off', 'one outlier', 'two boxes'])
@pytest.mark.parametrize('robust', [True, False])
def test_weights_equal_those_of_torch(kind, robust):
    problem, state = drives(kind, {'two boxes': 4, 'drives off': 24}.get(kind, 12))
    if kind == 'still':  # but for a drift of one of two, at uneven times
        problem.times[:, 6:] += 2.0
        problem.boxes[0, :, 0] += 0.2 * problem.times[0]
    config = Config().updated({'ingredients.robust_weights': robust})
    pairs = weighed(problem, state, config)
    for known, found in pairs:
        for name in set(found._fields) - {'start', 'wanted', 'W_shape'}:
            assert_equal(getattr(found, name), getattr(known, name))
    is_held = pairs[0][1].W_zero_motion[:-1, 0] > 0
    if kind == 'still':
        assert is_held.all()
    if kind == 'drives off':
        assert is_held[0]
        assert not is_held[-5:].any()


PLANS = {
    'warm': (SolverPlan(1, np.inf, starts_from_fit=True, marginalises=True), 0),
    'cold': (SolverPlan(3, np.inf, marginalises=True), 0),
    'cold, second round': (SolverPlan(3, np.inf, marginalises=True), 1),
    'whole track': (SolverPlan(3, np.inf, uses_rigid_shape=True), 1),
}


def batch_of(problem, state, config):
    """Return what a round of a problem begins with."""
    known = InputEstimates(OFFSETS, scatter=SCATTER)
    free = free_variables(problem, config)
    state = State(*(part.clone() for part in state))
    prior = MarginalPrior(
        *(torch.full_like(part, torch.nan) for part in (
            problem.prior_mean, problem.prior_mean, problem.prior_information
        ))
    )  # fmt: skip
    evidence = torch.zeros(len(free), 3, 3, dtype=D)
    evidence[:, 0] = expect(problem, known).shared[:, EXTENT].log()
    solution = Solution(state, Posterior.zeros(state.pose), prior, None, evidence)
    return Round(problem, solution, known, free)


def both_rounds(problem, state, config, plan):
    """Return the solution and which windows are done after a round by the kernel, and by torch."""
    results = []
    for take in (run_round_compiled, run_round_torch):
        batch = batch_of(problem, state, config)
        is_done = take(batch, *PLANS[plan], config, torch.arange(len(problem.boxes)))
        results.append((batch.solution, is_done))
    return results


@pytest.mark.parametrize('iterations', [1, 8])
@pytest.mark.parametrize('kind', ['usual', 'still', 'one outlier'])
@pytest.mark.parametrize('plan', PLANS)
def test_a_round_equals_that_of_torch(plan, kind, iterations):
    problem, state = drives(kind)
    pinned = torch.zeros_like(problem.valid)
    pinned[2, 4] = True
    problem = problem._replace(pinned=pinned)
    config = Config().updated({'window': 12, 'solver.iterations': iterations})
    (found, found_done), (known, done) = both_rounds(problem, state, config, plan)
    assert torch.equal(found_done, done)
    # Steps of the search after the first one amplify the order of sums; so does the inverse of the
    # curvature of the window with a pin, whose weights differ by a factor of 1e6.
    tolerance = 1e-9 if iterations == 1 else 1e-5
    assert_equal(found.state.pose[problem.valid], known.state.pose[problem.valid], tolerance)
    assert_equal(found.state.shared, known.state.shared, tolerance)
    assert_equal(found.extent_evidence, known.extent_evidence, 1e-6)
    is_valid = problem.valid & done[:, None]
    for name in ('poses', 'face_distances'):
        part, twin = (getattr(side.posterior, name)[is_valid] for side in (found, known))
        assert_equal(part, twin, 1e-7)
    assert_equal(found.posterior.extents[done], known.posterior.extents[done], 1e-7)
    is_full = done & problem.valid.all(1) & (plan != 'whole track')
    for part, twin in zip(found.prior, known.prior, strict=True):
        assert_equal(part[is_full], twin[is_full], max(tolerance, 1e-7))
    assert not found.prior.step[~is_full].isfinite().any()


@pytest.mark.parametrize('case', CASES)
def test_a_round_of_degenerate_points_equals_that_of_torch(case):
    problem, state = searched(case)
    names = [field.name for field in fields(Config().vehicle)[1:]]
    numbers = torch.tensor([[getattr(Config().vehicle, name) for name in names]] * 3, dtype=D)
    problem = problem._replace(class_numbers=numbers)
    config = Config().updated({'window': 5})
    (found, _), (known, _) = both_rounds(problem, state, config, 'warm')
    rows = [0, 2] if case == 'one window not finite' else [0, 1, 2]
    assert_equal(found.state.pose[rows], known.state.pose[rows])
    assert_equal(found.state.shared[rows], known.state.shared[rows])
    for part, twin in zip(found.posterior, known.posterior, strict=True):
        assert_equal(part[rows], twin[rows])


@pytest.mark.parametrize('seed', [0, 1])
@pytest.mark.parametrize('kind', ['usual', 'pinned', 'low noise', 'few boxes'])
def test_expectations_equal_those_of_torch(kind, seed):
    rng = np.random.default_rng(seed)
    problem, _ = drives('usual', 3 if kind == 'few boxes' else 12)
    pinned = torch.zeros_like(problem.valid)
    pinned[0, :1] = kind == 'pinned'
    marginalised = torch.from_numpy(rng.uniform(1, 4, (3, 4)))
    problem = problem._replace(
        pinned=pinned, marginalised_extents=marginalised, kind=torch.tensor([0, 1, 2])
    )
    deviation = 0.1 if kind == 'low noise' else 1.0
    parts = deviation * rng.random((3, 9)), rng.uniform(0, 0.9, (3, 9)), rng.random((3, 9))
    noise = InputNoise(*map(torch.from_numpy, (*parts, rng.random((3, 1)))))
    extents = np.log([4.0, 2.0, 1.6]) + 0.2 * rng.normal(size=(20, 3))
    evidence = np.stack([extents, 50 * rng.normal(size=(20, 3)), rng.random((20, 3))], 1)
    population = Population(torch.from_numpy(evidence), torch.arange(20) % 2)
    offsets = FaceOffsets(*torch.from_numpy(0.1 * rng.normal(size=(3, 3, 6))))
    known = InputEstimates(offsets, noise, population, SCATTER)
    twins = expect(problem, known)
    found = ExpectedArrays(*(np.empty(part.shape[1:]) for part in twins))
    work = expectation.empty_expectation_work()
    for b in range(3):
        expectation.expect(
            b, problem.arrays(), problem.class_arrays(), known.arrays(), expectation_numbers(),
            work, found,
        )  # fmt: skip
        for part, twin in zip(found, twins, strict=True):
            assert_equal(part, twin[b], 1e-12)


@pytest.mark.parametrize('kind', ['usual', 'held', 'short tracks', 'one track', 'nothing'])
def test_noise_equals_that_of_torch(kind):
    rng = np.random.default_rng(5)
    residuals = rng.normal(size=(1 if kind == 'one track' else 7, 30, 9)).cumsum(1)
    residuals[:, ::4, 2] = np.nan
    residuals[:, 7:9] = np.inf
    if kind == 'held':
        residuals[..., 6:] = residuals[:, :1, 6:]
    if kind == 'short tracks':
        residuals[::2, 5:] = np.nan
    if kind == 'nothing':
        residuals[:] = np.nan
    values = torch.from_numpy(residuals)
    found, known = estimate_noise_compiled(values), estimate_noise_torch(values)
    for part, twin in zip(found, known, strict=True):
        assert_equal(part, twin, 1e-12)
    assert (known.weight > 0).all() == (kind != 'nothing')


@pytest.mark.parametrize('road', [True, False])
@pytest.mark.parametrize('ownership', [True, False])
@pytest.mark.parametrize('has_pose', [True, False])
def test_points_of_boxes_equal_those_of_numpy(road, ownership, has_pose):
    # Boxes that overlap, lie apart, and share cells of the raster; a road under some of them.
    rng = np.random.default_rng(8)
    boxes = np.zeros((12, 9))
    boxes[:, :2] = rng.uniform(-12, 12, (12, 2)) + 256 * rng.integers(-1, 2, (12, 2))
    boxes[:, 3:6] = [4.5, 1.9, 1.6]
    boxes[:, 6:] = rng.normal(size=(12, 3)) * [0.05, 0.05, 2.0]
    points = rng.uniform(-6, 6, (20_000, 3)) + boxes[rng.integers(0, 12, 20_000), :3]
    points[::2, 2] = -0.8 + 0.02 * rng.normal(size=10_000)
    sweep = Sweep(0, 'odom', points.astype(np.float32))
    if has_pose:  # points in the frame of a tilted sensor
        T = np.eye(4)
        T[:3, :3] = matrix_from_rpy([0.05, -0.1, 2.5])
        T[:3, 3] = [3.0, -2.0, 1.5]
        points = (points - T[:3, 3]) @ T[:3, :3]
        sweep = replace(sweep, points=points.astype(np.float32), T_frame_points=T)
    config = Config().updated({'ingredients.road': road, 'ingredients.point_ownership': ownership})
    found, known = own_points(sweep, boxes, config), own_points_numpy(sweep, boxes, config)
    np.testing.assert_array_equal(found.row, known.row)
    np.testing.assert_array_equal(found.owner, known.owner)
    assert_equal(found.road, known.road)
    np.testing.assert_array_equal(found.num_inside, known.num_inside)
    assert np.isfinite(known.road).any() == road


def test_held_points_are_counted_as_by_torch():
    problem, state = searched('usual')
    extent = state.shared[:, None, EXTENT].expand(*problem.valid.shape, 3)
    found = registration._held(problem, state.pose, extent)
    np.testing.assert_array_equal(found, registration._held_torch(problem, state.pose, extent))


@pytest.mark.parametrize('case', CASES)
def test_rigid_shape_equals_that_of_torch(case):
    problem, state = searched(case)
    found = rigid_shape.agreement_compiled(problem, state)
    known = rigid_shape.agreement_torch(problem, state)
    for a, b in zip(found, known, strict=True):
        assert_equal(a, b, 1e-8)
    if case == 'usual':
        assert np.abs(known[0]).max() > 10


def test_constants_of_the_kernels_are_those_of_their_twins():
    equations = normal_equations
    found = equations.EXTENT, equations.BIAS, equations.GAP, equations.PIVOT, equations.ANCHOR
    known = EXTENT.start, batch.BIAS.start, batch.GAP.start, batch.PIVOT, batch.ANCHOR.start
    assert (*found, equations.SHARED, arrowhead.BORDER) == (*known, SHARED, SHARED)
    assert equations.UNKNOWN_RIDGE == prior.PRIOR_RIDGE
    assert arrowhead.RIDGE == prior.POSE_RIDGE
    assert face_support.NOWHERE == FAR


def test_curvature_that_is_not_positive_definite_has_no_factor():
    problem, state = drives('usual')
    ((terms, _), *_) = weighed(problem, state, Config())
    N = problem.length
    for weight in (terms.W_faces, terms.W_input, terms.W_acceleration):
        weight *= -1.0
    x, gradient = state.pack()[0].numpy(), np.empty(6 * N + SHARED)
    A, scratch = arrowhead.empty_arrowhead(N), normal_equations.empty_scratch(N)
    rounds.linearise(x, terms, np.ones_like(x), scratch, gradient, A)
    assert np.isnan(A.links[:N]).all()
    assert np.isnan(A.corner).all()


def test_non_finite_values_leave_other_windows_bitwise_unchanged():
    problem, state = drives('usual')
    config, others = Config().updated({'window': 12}), [0, 2]
    broken = State(state.pose.clone(), state.shared)
    broken.pose[1, 3, 0] = torch.nan
    known, found = (both_rounds(problem, start, config, 'warm')[0][0] for start in (state, broken))
    assert torch.equal(found.state.pose[others], known.state.pose[others])
    for part, right in zip(found.posterior, known.posterior, strict=True):
        assert torch.equal(part[others], right[others])
    assert not found.state.pose[1].isfinite().all()


def test_results_do_not_depend_on_the_number_of_threads():
    rng = np.random.default_rng(3)
    config = Config(estimate='final')
    windows = [window_of(track_of(drive(10), rng, str(i)), config) for i in range(300)]
    known, found = (
        register(windows, changed, InputModel(changed.faces))
        for changed in (config.updated({'solver.threads': n}) for n in (1, 2))
    )
    for a, b in zip(known, found, strict=True):
        np.testing.assert_array_equal(a.boxes, b.boxes)
        np.testing.assert_array_equal(a.covariances, b.covariances)


REFINE = """
import sys, warnings
import numpy as np
PREPARE
warnings.simplefilter('always')
with warnings.catch_warnings(record=True) as caught:
    from boxreg_ros import Config, Track, refine
    rng = np.random.default_rng(0)
    boxes = np.array([[10.0 + i, 0, 0, 4, 1.8, 1.5, 0, 0, 0] for i in range(6)])
    surface = rng.uniform(-1, 1, (200, 3)) * [2, 0.9, 0.75]
    surface[:100, 0], surface[100:, 1] = -2.0, 0.9
    points = [box[:3] + surface for box in boxes]
    boxes += 0.1 * rng.normal(size=boxes.shape)
    track = Track('7', 'car', np.arange(6) * 10**8, boxes, points, np.zeros((6, 3)))
    (refined,) = refine([track], Config())
texts = [str(w.message) for w in caught if 'numba' in str(w.message)]
print(len(texts), *texts, sep='\\n')
print(*refined.boxes.ravel().tolist())
"""
WITHOUT_NUMBA = """
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] == 'numba':
            raise ModuleNotFoundError('No module named numba')
sys.meta_path.insert(0, Absent())
"""
UNSUPPORTED_PROCESSOR = """
class Unsupported:
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] == 'llvmlite':
            raise OSError('libllvmlite.so: cannot open shared object file')
sys.meta_path.insert(0, Unsupported())
"""


def refined(prepare='', folder=ROOT, **environment):
    """Return the warnings about numba, and the boxes, of a small refinement in a process."""
    done = subprocess.run(
        [sys.executable, '-c', REFINE.replace('PREPARE', prepare)],
        cwd=folder, env={**os.environ, **environment}, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    count, *texts, boxes = done.stdout.splitlines()
    assert len(texts) == int(count)
    return texts, np.array(boxes.split(), float)


@pytest.fixture(scope='module')
def known_boxes():
    """Return the boxes of the small refinement, by the kernels."""
    texts, boxes = refined()
    assert texts == []
    return boxes


@pytest.fixture
def copy(tmp_path):
    """Return a folder with a copy of the package and its compiled kernels."""
    shutil.copytree(ROOT / 'boxreg_ros', tmp_path / 'boxreg_ros')
    return tmp_path


@pytest.mark.parametrize('prepare', [WITHOUT_NUMBA, UNSUPPORTED_PROCESSOR])
def test_without_numba_results_are_the_same_with_one_warning(prepare, known_boxes):
    (text,), found = refined(prepare)
    assert 'pip install' in text
    np.testing.assert_allclose(found, known_boxes, atol=1e-6)


ROTATE = """
import resource
import warnings
import numpy as np
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter('always')
    from boxreg_ros.core.kernels import load
    from boxreg_ros.core.kernels.rotation import fill_rotation
    assert load() is not None
    R = np.empty((3, 3))
    PREPARE
    fill_rotation(0.1, 0.2, 0.3, R)
(text,) = [str(w.message) for w in caught]
print(text)
print(*R.ravel().tolist())
"""
KNOWN_ROTATION = rotation_from_rpy(torch.tensor([0.1, 0.2, 0.3], dtype=D)).ravel().numpy()


def rotated(folder, places, prepare='pass'):
    """Return the warning and the numbers of a rotation by a kernel, compiled in a process."""
    # One kernel stands for all, which take a minute.
    done = subprocess.run(
        [sys.executable, '-c', ROTATE.replace('PREPARE', prepare)],
        cwd=folder, env={**os.environ, **places}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    text, values = done.stdout.splitlines()
    return text, np.array(values.split(), float)


def test_a_read_only_home_gives_one_warning(copy):
    # Neither the package, nor NUMBA_CACHE_DIR, nor the home folder can be written: files are in
    # the place of folders, which holds for the superuser as well.
    cache = copy / 'boxreg_ros' / 'core' / 'kernels' / '__pycache__'
    shutil.rmtree(cache)
    cache.touch()
    places = {'HOME': str(cache), 'XDG_CACHE_HOME': str(cache), 'NUMBA_CACHE_DIR': str(cache)}
    text, values = rotated(copy, places)
    assert 'set NUMBA_CACHE_DIR' in text
    np.testing.assert_allclose(values, KNOWN_ROTATION, atol=1e-15)


def test_a_full_disk_gives_one_warning(copy):
    # A limit of the size of files stands for the full disk: it holds for the superuser as well.
    places = {'NUMBA_CACHE_DIR': str(copy / 'cache')}
    limit = 'resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))'
    text, values = rotated(copy, places, limit)
    assert 'make room' in text and str(copy / 'cache') in text
    np.testing.assert_allclose(values, KNOWN_ROTATION, atol=1e-15)


def test_a_damaged_cache_is_written_again_with_one_warning(copy, known_boxes):
    cache = copy / 'boxreg_ros' / 'core' / 'kernels' / '__pycache__'
    for file in cache.glob('face_support.count_held*.nbi'):
        file.write_bytes(b'damaged')
    (text,), found = refined(folder=copy)
    assert 'delete the folder' in text
    np.testing.assert_array_equal(found, known_boxes)
    texts, _ = refined(folder=copy)
    assert texts == []
