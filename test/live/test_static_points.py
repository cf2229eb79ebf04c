"""Clouds without moving objects, published by the node for a SLAM beside it."""

from boxreg_ros.simulation.simulate import simulate
from msg_adapters import pointcloud
import numpy as np
from ros_graph import ended_cleanly, Graph, QUICK, records_of, stamp_of
from scenes import write_scene

POINTS = 'sensor_msgs/msg/PointCloud2'
SWEEPS, WITHOUT_BOXES = 10, 2
STATIC = ('-p', 'static_points:=true', '-p', 'static_points_wait:=3.0')


def test_static_points(graph: Graph, tmp_path):
    """Moving objects are left out, parked ones stay; clouds without boxes pass unchanged."""
    scene = simulate('street', 0, SWEEPS)
    records = records_of(write_scene(tmp_path / 'street.mcap', scene), '/detections')
    last = [boxes.stamp_ns for boxes in scene.detections[-WITHOUT_BOXES:]]
    records = [record for record in records if record.boxes_stamp_ns not in last]
    static = graph.collect(POINTS, '/static_points')
    node = graph.run(records, *QUICK, *STATIC, '-r', 'boxes:=/detections')
    node.play(records)
    graph.wait(lambda: len(static) == SWEEPS, 'a cloud without moving objects for each sweep')
    counted = ('static_published', 'static_unchanged', 'static_points CPU median [ms]')
    graph.wait(lambda: node.values().get('static_unchanged') == str(WITHOUT_BOXES), 'the count')
    assert ended_cleanly(node)
    assert 'static_unchanged' in node.output()
    seen = {status.key for message in node.diagnostics for status in message.status[0].values}
    assert set(counted) <= seen
    assert 'static_points latency median [ms]' in seen

    assert [stamp_of(message) for message in static] == [s.stamp_ns for s in scene.sweeps]
    moving_left, moving, parked_left, parked = 0, 0, 0, 0
    for message, sweep, owners in zip(static, scene.sweeps, scene.owners, strict=True):
        assert message.header.frame_id == 'lidar'
        assert [field.name for field in message.fields] == ['x', 'y', 'z', 'intensity', 't']
        points = pointcloud.from_msg(message).points
        if sweep.stamp_ns in last:
            np.testing.assert_array_equal(points, sweep.points)
            continue
        rows = {tuple(point): row for row, point in enumerate(sweep.points.tolist())}
        own = owners[[rows[tuple(point)] for point in points.tolist()]]
        if sweep.stamp_ns < scene.sweeps[4].stamp_ns:
            continue  # the motion of the objects is not known yet
        seconds = (sweep.stamp_ns - scene.sweeps[0].stamp_ns) * 1e-9
        ends = np.array([seconds - 0.05, seconds + 0.05])
        steps = [np.diff(actor.motion.at(ends)[:, :2], axis=0) for actor in scene.actors]
        paths = [np.ptp(actor.motion.poses[:, :2], axis=0).max() for actor in scene.actors]
        is_moving = np.append([np.linalg.norm(step) > 0.03 for step in steps], False)
        is_parked = np.append(np.array(paths) == 0, False)
        moving_left += is_moving[own].sum()
        moving += is_moving[owners].sum()
        parked_left += is_parked[own].sum()
        parked += is_parked[owners].sum()
    assert moving_left < 0.2 * moving
    assert parked_left > 0.85 * parked
