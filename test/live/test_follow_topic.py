"""A box on `~/follow` starts a track in the node, over DDS."""

from dataclasses import replace

from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.io.transforms import boxes_to_frame, inverse
from boxreg_ros.live.topics import import_message
from boxreg_ros.simulation.scene import FIXED_FRAME
from boxreg_ros.simulation.simulate import simulate
from msg_adapters import vision
import numpy as np
from rclpy.serialization import deserialize_message
from ros_graph import ended_cleanly, Graph, QUICK, records_of
from ros_messages import DETECTIONS
from scenes import write_scene

ACTOR = 3
"""A car that drives past with 170 points and more."""
SWEEPS, BOX_AT, GONE = 31, 2, 8


def without(sweep, owner):
    """Return a sweep without the points of the actor."""
    rows = owner != ACTOR
    return replace(sweep, points=sweep.points[rows], times=sweep.times[rows])


def test_one_box_is_followed_until_its_points_are_gone(graph: Graph, tmp_path):
    scene = simulate('street', 0, SWEEPS)
    name = str(ACTOR + 1)
    sweeps = [
        sweep if step < GONE else without(sweep, owner)
        for step, (sweep, owner) in enumerate(zip(scene.sweeps, scene.owners, strict=True))
    ]
    detections = [
        array.take([row for row, other in enumerate(array.track_ids) if other != name])
        for array in scene.detections
    ]
    path = write_scene(tmp_path / 'street.mcap', scene, sweeps=sweeps, detections=detections)
    records = records_of(path, '/detections')
    follow = graph.publisher(DETECTIONS, '/boxreg_node/follow')
    node = graph.run(records, *QUICK, '-r', 'boxes:=/detections')

    ends = [i + 1 for i, record in enumerate(records) if record.boxes_stamp_ns is not None]
    node.play(records[: ends[BOX_AT]])
    box_record = records[ends[BOX_AT] - 1]
    message = deserialize_message(box_record.data, import_message(DETECTIONS))
    truth = scene.truth.rows(np.array(scene.truth.track_ids) == name)
    given = truth.boxes[truth.stamps_ns == scene.sweeps[BOX_AT].stamp_ns]
    del message.detections[1:]
    box = replace(vision.from_msg(message), boxes=given, frame_id='odom')
    at = boxes_to_frame(box, inverse(scene.T_fixed_sensor[BOX_AT]), 'lidar')
    message = vision.to_msg(message, at)
    message.detections[0].id = name
    follow.publish(message)
    message.detections[0].id = ''
    follow.publish(message)
    message.detections[0].id = 'road'
    message.detections[0].bbox.center.position.z += 30.0
    follow.publish(message)
    node.play(records[ends[BOX_AT] :])
    graph.wait(lambda: f'lost {name}' in node.values(), 'the place where the object was lost')
    values = node.values()
    assert values['following'] == 'none'
    last = f'{scene.sweeps[GONE - 1].stamp_ns} ns'
    assert values[f'lost {name}'].startswith(f'few_points at {last}, x ')
    assert values['not_followed'] == '2'
    assert 'expected a track id' in values['not_followed ']
    assert 'expected 5 points in it, got 0' in values['not_followed road']
    assert ended_cleanly(node)
    assert (
        'not_followed: : box at' in node.output() and f'lost: {name}: few_points' in node.output()
    )

    for messages in (node.early, node.final):
        found = {}
        for step, array in enumerate(map(vision.from_msg, messages)):
            if name in array.track_ids:
                row = array.track_ids.index(name)
                assert array.scores[row] == 0.0
                odom = boxes_to_frame(array, scene.T_fixed_sensor[step], FIXED_FRAME)
                found[scene.sweeps[step].stamp_ns] = odom.boxes[row]
        stamps = [scene.sweeps[step].stamp_ns for step in range(BOX_AT + 1, GONE)]
        assert len(found) >= len(stamps) - 1  # the next boxes may arrive before the one to follow
        assert list(found) == stamps[-len(found) :]
        rows = np.isin(truth.stamps_ns, list(found))
        assert iou_3d(np.array(list(found.values())), truth.boxes[rows]).min() > 0.7
