"""The paper's objective: its equations by hand, gradients, padding."""

from boxreg_ros.config import PaperConfig
from boxreg_ros.core import paper
from boxreg_ros.core.paper import EPSILON, Observed
from boxreg_ros.structures import POSE
import numpy as np
import pytest
from scenes import boxes_at as numpy_boxes
from scenes import problem_of, random_problem
import torch

D = torch.float64
NIL = EPSILON**0.5  # the norm of a zero vector, with EPSILON inside its root


def tensor(values):
    return torch.tensor(values, dtype=D)


def boxes_at(*poses):
    return torch.from_numpy(numpy_boxes(*poses))


def all_valid(boxes):
    return torch.ones(boxes.shape[:2], dtype=torch.bool)


# --- Eq. 4 --------------------------------------------------------------------------------------

# In a box of 4 x 2 x 2 m; their centre of mass is ahead, left and up, so front, left and top are
# seen. Distances to the front: 0.1 and 1.0; left: 0.5 and 0.1; top: 0.8 and 0.6.
TWO = tensor([[[[1.9, 0.5, 0.2], [1.0, 0.9, 0.4]]]])


def closeness(boxes, points, nearest, mask=None):
    mask = torch.ones(points.shape[:-1], dtype=torch.bool) if mask is None else mask
    return paper.closeness(boxes, points, mask, nearest)


@pytest.mark.parametrize(
    'nearest, known',
    [
        (1, 0.1**2 + 0.1**2 + 0.6**2),
        (2, (0.1**2 + 1.0**2 + 0.5**2 + 0.1**2 + 0.8**2 + 0.6**2) / 2),
        (99, (0.1**2 + 1.0**2 + 0.5**2 + 0.1**2 + 0.8**2 + 0.6**2) / 2),
    ],
)
def test_closeness_by_hand(nearest, known):
    assert closeness(boxes_at((0, 0, 0)), TWO, nearest).item() == pytest.approx(known)


def test_visible_faces_are_on_the_side_of_the_centre_of_mass():
    # Mirrored points see the opposite faces, at the same distances.
    mirrored = closeness(boxes_at((0, 0, 0)), -TWO, 2)
    assert mirrored.item() == pytest.approx(closeness(boxes_at((0, 0, 0)), TWO, 2).item())


def test_closeness_is_zero_for_points_in_the_visible_corner():
    # Front, left, top corner of the box; seen from outside or inside makes no difference.
    box = boxes_at((5, -3, 1, 0, 0, 0.4))
    corner = tensor([5, -3, 1]) + torch.stack(
        [
            2 * torch.cos(tensor(0.4)) - torch.sin(tensor(0.4)),
            2 * torch.sin(tensor(0.4)) + torch.cos(tensor(0.4)),
            tensor(1.0),
        ]
    )
    assert closeness(box, corner.expand(1, 1, 3, 3), 2).item() == pytest.approx(0, abs=1e-25)


def test_closeness_is_the_mean_over_observations_with_points():
    boxes = boxes_at((0, 0, 0), (0, 0, 0), (0, 0, 0))
    points = torch.cat([TWO, TWO, 1e3 + TWO], 1)
    mask = torch.tensor([[[True, True], [True, False], [False, False]]])
    # Of the second box only the first point is real: 0.1^2 + 0.5^2 + 0.8^2 = 0.9.
    both = (0.1**2 + 1.0**2 + 0.5**2 + 0.1**2 + 0.8**2 + 0.6**2) / 2
    assert closeness(boxes, points, 2, mask).item() == pytest.approx((both + 0.9) / 2)


# --- Eq. 5 --------------------------------------------------------------------------------------


def enclosure(boxes, points, mask=None):
    mask = torch.ones(points.shape[:-1], dtype=torch.bool) if mask is None else mask
    return paper.enclosure(boxes, points, mask)


def test_enclosure_is_constant_inside():
    # Two opposite faces are together one extent away: (4 + 2 + 2) / 6, wherever inside.
    for point in ([0.0, 0, 0], [1.9, -0.9, 0.99], [-2.0, 1.0, 1.0]):
        value = enclosure(boxes_at((0, 0, 0)), tensor([[[point]]]))
        assert value.item() == pytest.approx(8 / 6)


def test_enclosure_grows_linearly_outside():
    # 0.5 m out of one face is 0.5 m further from it and from the opposite one: 2 * 0.5 / 6 more.
    # One of two points, so half of that.
    points = tensor([[[[2.5, 0, 0], [0, 0, 0]]]])
    assert enclosure(boxes_at((0, 0, 0)), points).item() == pytest.approx(8 / 6 + 0.5 / 6)


def test_points_inside_have_no_gradient():
    boxes = boxes_at((0.1, 0.2, 0.1, 0.02, 0.01, 0.1)).requires_grad_()
    inside = tensor([[[[0.3, 0.2, 0.1], [-1.0, 0.3, -0.4]]]])
    enclosure(boxes, inside).sum().backward()
    np.testing.assert_allclose(boxes.grad[..., [0, 1, 2, 6, 7, 8]], 0, atol=1e-15)


# --- Eq. 6 --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'poses, known',
    [
        ([(0, 0, 0), (1, 2, 0), (2, 4, 0)], NIL),  # equal steps
        ([(0, 0, 0), (1, 0, 0), (3, 0, 0)], 1.0),  # steps of 1 and 2
        ([(0, 0, 0), (3, 0, 0), (6, 4, 0)], 4.0),  # 4 more in y alone
        ([(0, 0, 0), (1, 0, 0), (0, 0, 0)], NIL),  # the equation compares magnitudes
        ([(0, 0, 0), (0, 0, 0, 0, 0, 0.3), (0, 0, 0, 0, 0.4, 0.6)], 0.4),  # pitch alone
        ([(0, 0, 0), (1, 0, 0), (3, 0, 0), (5, 0, 0)], (1.0 + NIL) / 2),  # mean of two
        ([(0, 0, 0), (5, 0, 0)], 0.0),  # fewer than three
        ([(0, 0, 0)], 0.0),
    ],
)
def test_smoothness_by_hand(poses, known):
    boxes = boxes_at(*poses)
    assert paper.smoothness(boxes, all_valid(boxes)).item() == pytest.approx(known, rel=1e-6)


def test_smoothness_wraps_angles():
    # A constant turn of 0.3 rad across half a turn, yaw given wrapped.
    yaw = np.array([2.8, 3.1, 3.4 - 2 * np.pi, 3.7 - 2 * np.pi])
    boxes = boxes_at(*[(0, 0, 0, 0, 0, y) for y in yaw])
    assert paper.smoothness(boxes, all_valid(boxes)).item() == pytest.approx(NIL, rel=1e-6)


# --- Eq. 7 --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'poses, known',
    [
        ([(0, 0, 0), (1, 0, 0)], NIL),  # where it heads
        ([(0, 0, 0), (-1, 0, 0)], NIL),  # reversing
        ([(0, 0, 0), (0, 1, 0)], 2**0.5),  # sideways: unit vectors at a right angle
        ([(0, 0, 0, 0, 0, np.pi / 3), (1, 0, 0)], 1.0),  # 60 degrees off
        ([(0, 0, 0, 0, 0, np.pi), (-2, 0, 0)], NIL),
        ([(0, 0, 0, 0, -np.pi / 4, 0), (1, 0, 1)], NIL),  # uphill: a negative pitch looks up
        ([(0, 0, 0), (0, 0.05, 0)], 2**0.5 / 2),  # a step of half the full length
        ([(0, 0, 0), (0, 0, 0)], 0.0),  # at rest
        ([(0, 0, 0), (1, 0, 0), (1, 1, 0)], (NIL + 2**0.5) / 2),  # mean of two
        ([(0, 0, 0), (3, 0, 0), (2, 0, 0)], (NIL + 2) / 2),  # forward on the whole, once back
        ([(0, 0, 0), (-3, 0, 0), (-2, 0, 0)], (NIL + 2) / 2),  # backward on the whole
        ([(0, 0, 0)], 0.0),
    ],
)
def test_alignment_by_hand(poses, known):
    boxes = boxes_at(*poses)
    # At rest the root's small number leaves NIL / 0.1 of the full weight: 3e-4.
    assert paper.alignment(boxes, all_valid(boxes)).item() == pytest.approx(known, abs=5e-4)


# --- all terms ----------------------------------------------------------------------------------


def poses_of(boxes):
    return boxes[..., POSE].clone().requires_grad_()


def seen_of(problem):
    """Return boxes and `Observed` of a problem."""
    return torch.from_numpy(problem.boxes), Observed.of(problem)


def with_poses(boxes, pose):
    return torch.cat([pose[..., :3], boxes[..., 3:6], pose[..., 3:]], -1)


PAPER = {
    'closeness': lambda b, p: paper.closeness(b, *p[:2], 5),
    'enclosure': lambda b, p: paper.enclosure(b, *p[:2]),
    'smoothness': lambda b, p: paper.smoothness(b, p.valid),
    'alignment': lambda b, p: paper.alignment(b, p.valid),
    'total': lambda b, p: paper.total(b, p, PaperConfig(), MULTIPLIERS, EPSILON)[0],
}
MULTIPLIERS = tensor([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]])
each_term = pytest.mark.parametrize('term', PAPER.values(), ids=PAPER)


@each_term
def test_gradients_of_the_paper(term):
    boxes, seen = seen_of(random_problem(M=8))
    assert torch.autograd.gradcheck(
        lambda pose: term(with_poses(boxes, pose), seen), poses_of(boxes), eps=1e-7, atol=1e-5
    )


@each_term
@pytest.mark.parametrize('moving', [False, True])
def test_gradients_are_finite_at_kinks(term, moving):
    # At rest all poses coincide; in even motion all steps are equal, along the heading. Points
    # lie on faces, on edges, at the centre and upon each other.
    boxes = boxes_at(*[(0.5 * i * moving, 0, 0) for i in range(6)])
    points = tensor([[2, 1, 1], [2, 0, 0], [0, 0, 0], [0, 0, 0]]).expand(1, 6, 4, 3)
    seen = seen_of(problem_of(boxes, points=points.numpy()))[1]
    pose = poses_of(boxes)
    value = term(with_poses(boxes, pose), seen)
    value.sum().backward()
    assert value.isfinite().all()
    assert pose.grad.isfinite().all()


@each_term
def test_padding_alone_has_value_and_gradient_zero(term):
    problem = random_problem()
    boxes, nothing = seen_of(
        problem._replace(counts=0 * problem.counts, lengths=0 * problem.lengths)
    )
    pose = poses_of(boxes)
    value = term(with_poses(boxes, pose), nothing)
    value.sum().backward()
    np.testing.assert_array_equal(value.detach(), 0)
    np.testing.assert_array_equal(pose.grad, 0)


@each_term
def test_padding_order_and_batch_do_not_matter(term):
    problem = random_problem()
    boxes, seen = seen_of(problem)
    known = term(boxes, seen)
    # Other order of points.
    order = torch.from_numpy(np.random.default_rng(1).permutation(seen.points.shape[2]))
    other = Observed(seen.points[:, :, order], seen.mask[:, :, order], seen.valid)
    np.testing.assert_allclose(term(boxes, other), known, rtol=1e-12)
    padded = torch.where(seen.valid[..., None], boxes, 77.0)
    np.testing.assert_allclose(term(padded, other), known, rtol=1e-12)


@pytest.mark.parametrize('name', ['closeness', 'enclosure'])
def test_duplicates_do_not_matter(name):
    # Every point three times, and three times the K: the same means.
    boxes, seen = seen_of(random_problem())
    term = getattr(paper, name)
    more = [5] if name == 'closeness' else []
    known = term(boxes, *seen[:2], *more)
    points, mask = seen.points.repeat(1, 1, 3, 1), seen.mask.repeat(1, 1, 3)
    found = term(boxes, points, mask, *[3 * k for k in more])
    np.testing.assert_allclose(found, known, rtol=1e-12)


def test_total_is_the_weighted_sum_with_multipliers():
    # Eq. 8 with c the two constraints: closeness and enclosure weighted, m c + w c^2 / 2.
    boxes, seen = seen_of(random_problem())
    weights = PaperConfig(closeness=2.0, enclosure=3.0, smoothness=0.5, alignment=0.7)
    boxes = boxes + 0.1
    loss, violation = paper.total(boxes, seen, weights, MULTIPLIERS, EPSILON)
    c = [paper.smoothness(boxes, seen.valid), paper.alignment(boxes, seen.valid)]
    known = 2 * paper.closeness(boxes, *seen[:2], paper.NEAREST)
    known += 3 * paper.enclosure(boxes, *seen[:2])
    known += MULTIPLIERS[:, 0] * c[0] + 0.5 * c[0] ** 2 / 2
    known += MULTIPLIERS[:, 1] * c[1] + 0.7 * c[1] ** 2 / 2
    np.testing.assert_allclose(loss, known)
    np.testing.assert_allclose(violation, torch.stack(c, -1))
