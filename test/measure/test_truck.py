"""The truck of `measure lidars`."""

from boxreg_ros.config import Config
from boxreg_ros.io.lidars import Lidars
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.session import Session
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.structures import Sweep
from measure.truck import CORNER_LIDARS, truck_scene, TRUCK_SENSORS, write_truck
from msg_adapters.convention import STANDARD
import numpy as np
import pytest

TOPICS = tuple(f'/points/{name}' for name in CORNER_LIDARS)


@pytest.fixture(scope='module')
def scene():
    return truck_scene(0, 2)


def merged_sweeps(path, lidars):
    """Return the sweeps of a recording in the fixed frame, merged."""
    with Recording([path], lidars) as recording:
        session = Session(STANDARD, Config(), placement=recording.placement)
        session.fixed_frame = recording.choose_fixed_frame(TransformTree())
        found = []
        for item in recording.items(session.tree):
            if isinstance(item.content, Sweep):
                found += session.merged(session.admit(item).moved)
    return [part.sweep.in_frame() for part in found]


def test_topics_and_concatenated_clouds_with_info_are_the_same_sweep(scene, tmp_path):
    path = tmp_path / 'drive.mcap'
    write_truck(path, scene, 'corners')
    topics = merged_sweeps(path, Lidars(TOPICS))
    write_truck(path, scene, 'concatenated')
    whole = merged_sweeps(path, Lidars())
    assert len(topics) == len(whole) == 2
    for one, other in zip(topics, whole, strict=True):
        assert one.stamp_ns == other.stamp_ns
        np.testing.assert_allclose(one.points, other.points, atol=1e-4)
        np.testing.assert_allclose(one.times, other.times, atol=1e-6)
        np.testing.assert_array_equal(one.sensors, other.sensors)
        # The concatenation takes the mounts as they are at the stamp of the first LiDAR: the
        # truck moves on by 0.45 m until the last one.
        np.testing.assert_allclose(one.origins, other.origins, atol=0.46)


def test_each_lidar_sees_its_side_only(scene):
    for name, at in CORNER_LIDARS.items():
        points = np.concatenate([sweep.points for sweep in scene.clouds[name]]) + at
        is_below_top = points[:, 2] < 1.2  # of the body, which blocks them
        behind = np.sign(at[1]) * points[:, 1] < -1.5
        blocked = is_below_top & behind & (np.abs(points[:, 0]) < 3)
        assert not blocked.any()


@pytest.mark.parametrize('layout', TRUCK_SENSORS)
def test_recording_has_the_topics_of_its_layout(scene, layout, tmp_path):
    path = tmp_path / 'truck.mcap'
    write_truck(path, scene, layout)
    with Recording([path], Lidars(TOPICS if layout == 'corners' else ())) as recording:
        assert ('/points_info' in recording.topics) == (layout == 'concatenated')
