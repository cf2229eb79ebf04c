"""
A truck in the traffic of the street, with four LiDARs at its corners or one on its roof.

The LiDARs turn one after the other, a quarter of a period apart. The body of the truck blocks
their view. All boxes and the truth are the same, whichever LiDARs are recorded; boxes are in the
frame ``base``, at the stamp of the first LiDAR.

"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.lidars import merged
from boxreg_ros.io.transforms import inverse, sweep_to_frame
from boxreg_ros.simulation import raycast, scenarios
from boxreg_ros.simulation.noise import detector_noise
from boxreg_ros.simulation.scene import (
    boxes_of,
    FIXED_FRAME,
    is_near,
    make_scene,
    make_sweep,
    Scan,
    START_NS,
)
from boxreg_ros.simulation.writer import LidarMessages, write_messages
from boxreg_ros.structures import BoxArray, Floats, Ints, Sweep
import numpy as np

BASE_FRAME = 'base'
CORNER_LIDARS = {
    'lidar_front_left': (4.0, 1.35, 1.2), 'lidar_front_right': (4.0, -1.35, 1.2),
    'lidar_rear_left': (-4.0, 1.35, 1.2), 'lidar_rear_right': (-4.0, -1.35, 1.2),
}  # fmt: skip
"""Frame and position of each LiDAR from the middle of the truck, on the ground [m]."""
ROOF_LIDAR = {'lidar_roof': (3.0, 0.0, 3.5)}
ROOF_STREAM = 2
"""Random stream of the LiDAR on the roof, so that the others do not depend on it."""
TRUCK_SENSORS = ('corners', 'concatenated', 'concatenated-alone', 'roof')
"""What is recorded: a topic per corner, one concatenated cloud with or without info, or the
roof."""


class TruckMessages(LidarMessages):
    """Makes the messages of a recording with several LiDARs."""

    def static_transforms(self, stamp_ns: int, parent: str, children: Mapping[str, Floats]) -> Any:
        """Return a TFMessage with T_parent_child (4, 4) of several children."""
        messages = [self.transform(stamp_ns, parent, name, T) for name, T in children.items()]
        every = [message.transforms[0] for message in messages]
        return self.make('tf2_msgs/TFMessage', transforms=every)

    def info(self, whole: Sweep, parts: Sequence[Sweep]) -> Any:
        """Return the info on a cloud that is concatenated from `parts`."""
        begin = 0
        sources = []
        for part in parts:
            source = self.make(
                'autoware_sensing_msgs/SourcePointCloudInfo',
                header=self.header(part.stamp_ns, part.frame_id),
                topic=f'/points/{part.frame_id}',
                status=0,
                idx_begin=begin,
                length=len(part.points),
            )
            sources.append(source)
            begin += len(part.points)
        return self.make(
            'autoware_sensing_msgs/ConcatenatedPointCloudInfo',
            header=self.header(whole.stamp_ns, whole.frame_id),
            concatenation_success=True,
            matching_strategy=0,
            matching_strategy_config=np.zeros(0, np.uint8),
            source_info=sources,
        )


class TruckScene(NamedTuple):
    """A drive of the truck."""

    clouds: dict[str, tuple[Sweep, ...]]  # n of each LiDAR, in its frame and at its stamps
    detections: tuple[BoxArray, ...]  # n noisy ones in frame ``base``
    truth: BoxTable  # in frame ``odom``
    ego: raycast.Motion  # of the frame ``base`` in ``odom``


def truck_scene(seed: int, sweeps: int | None = None) -> TruckScene:
    """Return the drive of a seed, by default of as many sweeps as the street."""
    count = sweeps or scenarios.STREET_SWEEPS
    rng = np.random.default_rng(seed)
    actors = scenarios.street_actors(rng, count)
    ego = scenarios.drive(
        count * raycast.SWEEP_PERIOD, (0, -1.75, 0), scenarios.constant(6), scenarios.zero
    )
    ego.poses[:, 4] = scenarios.PITCH_AMPLITUDE * np.sin(2 * ego.times)
    stamps = np.arange(count) * raycast.SWEEP_PERIOD
    # (actors, sweeps, 9)
    true_boxes = np.stack([boxes_of(actor, actor.motion.at(stamps)) for actor in actors])
    clouds, owners = _scanned(CORNER_LIDARS, actors, ego, true_boxes, rng)
    roof_rng = np.random.default_rng([seed, ROOF_STREAM])
    roof, _ = _scanned(ROOF_LIDAR, actors, ego, true_boxes, roof_rng)
    whole = [merged(_in_base(parts, ego)) for parts in zip(*clouds.values(), strict=True)]
    scan = Scan(whole, owners, raycast.to_matrix(ego.at(stamps)), true_boxes)
    scene = make_scene(actors, scan, detector_noise, scenarios.MISS_PROBABILITY, rng)
    return TruckScene(clouds | roof, scene.detections, scene.truth, ego)


def write_truck(path: Path, scene: TruckScene, layout: str) -> None:
    """Write a recording of some LiDARs of the truck; raise as `write_messages`."""
    write_messages(path, _messages(scene, layout), is_compressed=True)


def _messages(scene: TruckScene, layout: str) -> Iterator[tuple[str, Any, int]]:
    """Yield topic, message and receive time [ns]."""
    make = TruckMessages()
    mounts = ROOF_LIDAR if layout == 'roof' else CORNER_LIDARS
    clouds = {name: scene.clouds[name] for name in mounts}
    first_ns = scene.detections[0].stamp_ns
    T_base_lidar = {name: _translation(at) for name, at in mounts.items()}
    yield '/tf_static', make.static_transforms(first_ns, BASE_FRAME, T_base_lidar), first_ns
    for boxes, *parts in zip(scene.detections, *clouds.values(), strict=True):
        received_ns = max(part.stamp_ns for part in parts)
        for part in parts:
            T = _base_at(scene.ego, part.stamp_ns)
            yield '/tf', make.transform(part.stamp_ns, FIXED_FRAME, BASE_FRAME, T), part.stamp_ns
        if layout in ('corners', 'roof'):
            for part in parts:
                yield f'/points/{part.frame_id}', make.cloud(part, _dark(part)), received_ns
        else:
            whole = _concatenated(parts, scene.ego)
            yield '/points', make.cloud(whole, _dark(whole)), received_ns
        if layout == 'concatenated':
            yield '/points_info', make.info(whole, parts), received_ns
        yield '/detections', make.detections(boxes), received_ns


def _scanned(
    mounts: dict[str, tuple[float, float, float]],
    actors: Sequence[raycast.Actor],
    ego: raycast.Motion,
    true_boxes: Floats,
    rng: np.random.Generator,
) -> tuple[dict[str, tuple[Sweep, ...]], list[Ints]]:
    """Return the clouds of each LiDAR, and the owners of the points of all, per sweep."""
    truck = _truck(ego)
    parts = [raycast.body(actor.shape, actor.extent) for actor in (*actors, truck)]
    sensor = raycast.Sensor(np.radians(np.linspace(-22, 8, 34)), columns=640)
    clouds: dict[str, list[Sweep]] = {name: [] for name in mounts}
    owners = []
    for i in range(true_boxes.shape[1]):
        found = []
        for k, (name, at) in enumerate(mounts.items()):
            stamp = i * raycast.SWEEP_PERIOD + k * raycast.SWEEP_PERIOD / len(CORNER_LIDARS)
            motion = _mounted(ego, at)
            points, times, owner = raycast.revolution(
                [*actors, truck], parts, motion, sensor, stamp, rng
            )
            kept = owner != raycast.ROAD
            for box in true_boxes[:, i]:
                kept |= is_near(points, box, scenarios.ROAD_MARGIN)
            kept &= owner != len(actors)  # the truck itself
            T = raycast.to_matrix(motion.at(np.array([stamp])))[0]
            sweep = make_sweep(stamp, points[kept], times[kept], T)
            clouds[name].append(replace(sweep, frame_id=name))
            found.append(owner[kept])
        owners.append(np.concatenate(found))
    return {name: tuple(sweeps) for name, sweeps in clouds.items()}, owners


def _truck(ego: raycast.Motion) -> raycast.Actor:
    """Return the body of the truck, which blocks the view of its LiDARs."""
    extent = np.array(scenarios.EXTENTS['truck'])
    poses = ego.poses + np.eye(6)[2] * extent[2] / 2
    return raycast.Actor('', 'truck', 'truck', extent, raycast.Motion(ego.times, poses))


def _mounted(ego: raycast.Motion, at: tuple[float, float, float]) -> raycast.Motion:
    """Return the motion of a LiDAR at a place on the truck."""
    T = raycast.to_matrix(ego.poses) @ _translation(at)
    return raycast.Motion(ego.times, np.hstack([T[:, :3, 3], ego.poses[:, 3:]]))


def _translation(at: tuple[float, float, float]) -> Floats:
    T = np.eye(4)
    T[:3, 3] = at
    return T


def _base_at(ego: raycast.Motion, stamp_ns: int) -> Floats:
    """Return T_odom_base (4, 4) at a stamp."""
    T: Floats = raycast.to_matrix(ego.at(np.array([(stamp_ns - START_NS) * 1e-9])))[0]
    return T


def _in_base(clouds: Sequence[Sweep], ego: raycast.Motion) -> list[Sweep]:
    """Return clouds in the frame base at the stamp of the first, each with its own stamp."""
    T_base_fixed = inverse(_base_at(ego, clouds[0].stamp_ns))
    every = CORNER_LIDARS | ROOF_LIDAR
    moved = []
    for cloud in clouds:
        T_fixed_base = _base_at(ego, cloud.stamp_ns)
        T = T_base_fixed @ T_fixed_base @ _translation(every[cloud.frame_id])
        moved.append(sweep_to_frame(cloud, T, BASE_FRAME).in_frame())
    return moved


def _concatenated(clouds: Sequence[Sweep], ego: raycast.Motion) -> Sweep:
    """Return one cloud in the frame base; its times are relative to the stamp of each LiDAR."""
    parts = _in_base(clouds, ego)
    times = [np.zeros(0) if part.times is None else part.times for part in parts]
    return replace(merged(parts), times=np.concatenate(times))


def _dark(sweep: Sweep) -> Ints:
    """Return an intensity of 0 for each point."""
    return np.zeros(len(sweep.points), np.int64)
