"""Refine a stream: sweeps and box arrays in, refined boxes out, without ROS."""

from collections.abc import Iterator
from dataclasses import dataclass

from boxreg_ros import BoxArray, BoxRegistrar, Config, RefinedBoxes, Sweep
import numpy as np
from numpy.typing import NDArray

FIXED_FRAME = 'odom'
SIZE = np.array([4.4, 1.8, 1.5])  # [m]


@dataclass
class TrackerMessage:
    """Stands for a message of your own tracker: one car at one stamp."""

    stamp_ns: int
    box: NDArray[np.float64]  # (9,) x y z length width height roll pitch yaw [m, rad]
    true_box: NDArray[np.float64]


def sensor() -> Iterator[tuple[NDArray[np.float64], TrackerMessage]]:
    """Yield points (M, 3) in the fixed frame [m] and the tracker's message, at 10 Hz."""
    rng = np.random.default_rng(0)
    rear = rng.uniform([-0.5, -0.5, -0.5], [-0.5, 0.5, 0.5], (100, 3))
    side = rng.uniform([-0.5, -0.5, -0.5], [0.5, -0.5, 0.5], (100, 3))
    surface = np.concatenate([rear, side]) * (SIZE - [0.1, 0.06, 0.0])
    for i in range(30):
        true_box = np.array([8.0 + 0.5 * i, 4.0, SIZE[2] / 2, *SIZE, 0.0, 0.0, 0.0])
        box = true_box.copy()
        box[:2] += rng.normal(0, 0.15, 2)
        box[8] += rng.normal(0, 0.05)
        yield surface + true_box[:3], TrackerMessage(i * 100_000_000, box, true_box)


def error(box: NDArray[np.float64], message: TrackerMessage) -> float:
    """Return the horizontal distance of a box from the true one [m]."""
    return float(np.linalg.norm((box - message.true_box)[:2]))


registrar = BoxRegistrar(Config(estimate='final', window=10, lag=9))
errors: dict[str, list[float]] = {'input': [], 'early': [], 'final': []}


def store(results: list[RefinedBoxes]) -> None:
    """Note the errors of refined boxes; a real program publishes or saves them here."""
    for refined in results:
        source = refined.boxes.ticket  # the message these boxes came with
        assert isinstance(source, TrackerMessage)
        name = 'final' if refined.is_final else 'early'
        errors[name].append(error(refined.boxes.boxes[0], source))


for points, message in sensor():
    errors['input'].append(error(message.box, message))
    # The origin of a sweep is the sensor's position in the fixed frame: here (0, 0, 0).
    store(registrar.add_sweep(Sweep(message.stamp_ns, FIXED_FRAME, points)))
    boxes = BoxArray(
        stamp_ns=message.stamp_ns,
        frame_id=FIXED_FRAME,
        track_ids=('7',),
        class_names=('car',),
        scores=np.ones(1),
        boxes=message.box[None],
        ticket=message,  # any object; it is returned with the refined boxes
    )
    store(registrar.add_boxes(boxes))
store(registrar.flush())  # the last `lag` arrays

print('counts:', dict(registrar.counts))
for name, values in errors.items():
    print(f'mean position error, {name}: {np.mean(values):.3f} m over {len(values)} boxes')
