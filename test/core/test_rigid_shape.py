"""One rigid shape per track: steps known by hand, and its effect on relative poses."""

from boxreg_ros import Config, refine
from boxreg_ros.core.method.arrays import BOX_POSE
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.method.residuals import TERMS
from boxreg_ros.core.method.rigid_shape import agree, empty_shape_work
from measure.drives import tracks_of
import numpy as np
import pytest
from scenes import problem_of, simulated

BOX = [0.0, 0, 0, 4.0, 2.0, 2.0, 0, 0, 0]


def corner(rng, count=600):
    """Return points (count, 3) on the front, the left side and the roof of `BOX`."""
    points = rng.uniform(-0.95, 0.95, (count, 3)) * [2.0, 1.0, 1.0]
    points[np.arange(count), np.arange(count) % 3] = np.array([2.0, 1.0, 1.0])[
        np.arange(count) % 3
    ]
    return points


def problem(poses, seed=0):
    """Return a window whose boxes are given at `poses` (N, 6), all seeing one corner at rest."""
    rng = np.random.default_rng(seed)
    boxes = np.tile(BOX, (len(poses), 1))
    boxes[:, :3], boxes[:, 6:] = np.array(poses)[:, :3], np.array(poses)[:, 3:]
    points = [corner(rng) - box[:3] for box in boxes]
    return problem_of(boxes[None], points=np.array([points]), of_class={'roughness': 0.03})


def agreement(seen, poses=None, b=0):
    """Return information (N, 6, 6) and wanted steps (N, 6) of window `b`."""
    poses = seen.boxes[b][:, BOX_POSE] if poses is None else poses
    terms, record = np.zeros(len(poses), TERMS), CONSTANTS.record()[0]
    work = empty_shape_work(seen, len(poses), record['cells'])
    agree(b, seen, poses, np.array(BOX[3:6]), record, work, terms)
    return terms['root'] @ terms['root'].swapaxes(1, 2), terms['wanted']


def with_points(seen, is_kept):
    """Return a window with some points (P,) of its observations alone."""
    owner = np.repeat(np.arange(seen.counts.size), seen.counts.ravel())
    counts = np.bincount(owner[is_kept], minlength=seen.counts.size).reshape(seen.counts.shape)
    return seen._replace(
        points=seen.points[is_kept], delays=seen.delays[is_kept], counts=counts,
        first=counts.ravel().cumsum().reshape(counts.shape) - counts,
    )  # fmt: skip


def look(poses):
    return agreement(problem(poses))


def test_an_outlying_pose_is_moved_back():
    # Nine boxes agree, the tenth is 0.05 m ahead, 0.04 m to the left and 0.01 rad turned. The
    # wanted step is minus that, less a tenth, since a tenth of the shape is its own, and less
    # another tenth (measured), since it smears the shape.
    poses = np.zeros((10, 6))
    poses[4] = [0.05, 0.04, 0, 0, 0, 0.01]
    information, wanted = look(poses)
    assert information.shape == (10, 6, 6)
    np.testing.assert_allclose(wanted[4], -0.8 * poses[4], atol=0.006)
    others = np.delete(wanted, 4, axis=0)
    np.testing.assert_allclose(others, np.tile(0.1 * poses[4], (9, 1)), atol=0.006)


def test_a_common_step_is_not_observable():
    _, alike = look(np.zeros((6, 6)))
    _, moved = look(np.tile([0.2, -0.1, 0.05, 0, 0, 0], (6, 1)))
    np.testing.assert_allclose(alike, 0, atol=2e-3)
    np.testing.assert_allclose(moved, 0, atol=2e-3)


def test_too_few_points_give_no_information():
    seen = problem(np.zeros((3, 6)))
    is_first = np.tile(np.arange(600) < 2, 3)
    information, wanted = agreement(with_points(seen, is_first))
    np.testing.assert_array_equal(information, 0)
    np.testing.assert_array_equal(wanted, 0)


def test_a_plane_gives_no_information_along_it():
    # Only the front is visible: steps to the left or up, and a roll about x, do not change it.
    seen = problem(np.zeros((5, 6)))
    information, _ = agreement(with_points(seen, seen.points[:, 0] >= 1.99))
    pinned = information.diagonal(axis1=1, axis2=2)
    assert (pinned[:, [0, 4, 5]] > 100).all()
    np.testing.assert_allclose(pinned[:, [1, 2, 3]], 0, atol=1e-6 * pinned.max())


@pytest.mark.parametrize('seed', range(2))
def test_rigid_shape_improves_relative_poses(seed):
    # A body of which each sweep shows a part: errors that are not common to all boxes fall by a
    # quarter at least, against faces alone.
    scene = simulated('paper', seed)
    (track,) = tracks_of(scene)

    def spread(config):
        (refined,) = refine([track], config)
        return (refined.boxes - scene.truth.boxes)[:, :3].std(0).max()

    config = Config()
    without = config.updated({'ingredients.without': ('rigid shape',)})
    assert spread(config) < 0.75 * spread(without)


def test_non_finite_values_do_not_affect_other_windows():
    poses = np.zeros((2, 6, 6))
    poses[0, 3, 0] = 0.05
    seen = problem_of(
        np.tile(BOX, (2, 6, 1)) + np.pad(poses[..., :3], ((0, 0), (0, 0), (0, 6))),
        points=np.tile(corner(np.random.default_rng(0)), (2, 6, 1, 1)) - poses[..., None, :3],
        of_class={'roughness': 0.03},
    )
    known = agreement(seen)
    seen.points[seen.first[1, 0]] = np.inf
    _, wanted = agreement(seen, np.full((6, 6), np.nan), b=1)
    np.testing.assert_array_equal(wanted, 0)
    for part, whole in zip(agreement(seen), known, strict=True):
        assert np.abs(whole).max() > 0.01
        np.testing.assert_array_equal(part, whole)
