"""Tops of objects above the highest ring of the LiDAR are not seen."""

from boxreg_ros.config import Config
from boxreg_ros.core.field_of_view import FieldOfView
from boxreg_ros.core.observation import observe, UNKNOWN_TOP
from boxreg_ros.core.refine import refine, Track
from boxreg_ros.io.transforms import sweep_to_frame
from boxreg_ros.structures import Sweep
import numpy as np

RINGS = np.radians([-4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0])
SENSOR = np.array([0.0, 0.0, 1.8])
TRUCK = np.array([11.0, 0.0, 1.6, 6.0, 2.5, 3.2, 0.0, 0.0, 0.0])  # its rear is 8 m ahead
VAN = np.array([0.0, 12.0, 1.2, 5.0, 2.0, 2.4, 0.0, 0.0, 0.0])


def wall(azimuth, distance, height, rings=RINGS):
    """Return the returns (M, 3) of an upright wall across an azimuth, up to its height."""
    angles = azimuth + np.linspace(-0.08, 0.08, 40)
    elevation, angle = (grid.ravel() for grid in np.meshgrid(rings, angles))
    points = SENSOR + distance * np.stack([np.cos(angle), np.sin(angle), np.tan(elevation)], 1)
    return points[points[:, 2] < height]


def hidden(view, *walls, boxes=(TRUCK, VAN), T=None, **more):
    sweep = Sweep(0, 'odom', np.concatenate(walls).astype(np.float32), None, SENSOR, **more)
    boxes = np.array(boxes)
    if T is not None:
        sweep = sweep_to_frame(sweep, T, 'odom')
        boxes = boxes.copy()
        boxes[:, :3] = boxes[:, :3] @ T[:3, :3].T + T[:3, 3]
    return (observe(sweep, boxes, 0, Config(), view).ring_heights == UNKNOWN_TOP).tolist()


def test_objects_in_the_highest_ring_have_no_top():
    truck, van, house = wall(0.0, 8.0, 3.2), wall(np.pi / 2, 11.0, 2.4), wall(2.5, 30.0, 9.0)
    assert truck[:, 2].max() < 2.3, 'nearly a metre of the truck is above the view'
    assert hidden(FieldOfView(), truck, van, house) == [True, True]
    far = wall(np.pi / 2, 30.0, 2.4)
    there = np.array([TRUCK, VAN + 19 * np.eye(9)[1]])
    assert hidden(FieldOfView(), truck, far, house, boxes=there) == [True, False]
    tilted = np.eye(4)
    tilted[[0, 0, 2, 2], [0, 2, 0, 2]] = np.cos(0.2), np.sin(0.2), -np.sin(0.2), np.cos(0.2)
    assert hidden(FieldOfView(), truck, far, house, boxes=there, T=tilted) == [True, False]


def test_a_ring_that_passes_above_shows_the_top():
    truck, higher = wall(0.0, 8.0, 3.2), wall(2.5, 30.0, 99.0, [*RINGS, *np.radians([4.0, 5.0])])
    assert hidden(FieldOfView(), truck, higher, boxes=[TRUCK]) == [False]
    view = FieldOfView()
    low = wall(2.5, 30.0, 9.0)
    assert hidden(view, truck, low, boxes=[TRUCK]) == [True]
    assert hidden(view, truck, higher, boxes=[TRUCK]) == [False]
    assert hidden(view, truck, low, boxes=[TRUCK]) == [False], 'known from the sweep before'


def test_the_only_high_object_is_no_evidence_of_an_edge():
    truck = wall(0.0, 8.0, 3.2)
    assert hidden(FieldOfView(), truck, wall(2.5, 30.0, 1.0), boxes=[TRUCK]) == [False]
    stray = SENSOR + np.array([[-10.0, 0.0, 10 * np.tan(np.radians(3))]] * 4)
    assert hidden(FieldOfView(), truck, stray, boxes=[TRUCK]) == [False]
    assert hidden(FieldOfView(), np.zeros((0, 3)), boxes=[TRUCK]) == [False]
    huge = np.full((9, 3), 3e38)
    assert hidden(FieldOfView(), truck, huge, wall(2.5, 30.0, 9.0), boxes=[TRUCK]) == [True]


def test_points_near_objects_alone_hide_no_top(monkeypatch):
    """`refine` has no other points: the tops of two vans beside each other are in one ring."""
    seen = []
    monkeypatch.setattr(FieldOfView, 'hidden_tops', lambda *args: seen.append(args))
    points = [wall(np.pi / 2, 11.0, 2.4)] * 3
    stamps = np.arange(3) * 10**8
    refine([Track('1', 'van', stamps, np.array([VAN] * 3), points, np.array([SENSOR] * 3))])
    assert not seen


def test_several_sensors_hide_no_top():
    walls = wall(0.0, 8.0, 3.2), wall(2.5, 30.0, 9.0)
    sensors = np.arange(sum(map(len, walls))) % 2
    more = {'origins': np.array([SENSOR] * 2), 'sensors': sensors}
    assert hidden(FieldOfView(), *walls, boxes=[TRUCK], **more) == [False]
