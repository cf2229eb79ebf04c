"""Refine one track: a car that drives past a sensor, with noisy input boxes."""

from boxreg_ros import Config, refine, Track
import numpy as np

rng = np.random.default_rng(0)
N = 20
LENGTH, WIDTH, HEIGHT = 4.4, 1.8, 1.5  # [m]

# True boxes: x y z length width height roll pitch yaw in the fixed frame [m, rad].
truth = np.zeros((N, 9))
truth[:, 0] = 8.0 + 0.5 * np.arange(N)  # 5 m/s at 10 Hz
truth[:, 1] = 4.0
truth[:, 2] = HEIGHT / 2
truth[:, 3:6] = LENGTH, WIDTH, HEIGHT

# The sensor at the origin measures points on the rear face and on the right side.
rear = rng.uniform([-0.5, -0.5, -0.5], [-0.5, 0.5, 0.5], (100, 3))
side = rng.uniform([-0.5, -0.5, -0.5], [0.5, -0.5, 0.5], (100, 3))
surface = np.concatenate([rear, side]) * [LENGTH - 0.1, WIDTH - 0.06, HEIGHT]

boxes = truth.copy()
boxes[:, :2] += rng.normal(0, 0.15, (N, 2))  # [m]
boxes[:, 8] += rng.normal(0, 0.05, N)  # [rad]

track = Track(
    track_id='7',
    class_name='car',
    stamps_ns=100_000_000 * np.arange(N),  # (N,) int64 [ns]
    boxes=boxes,  # (N, 9)
    points=[surface + box[:3] for box in truth],  # N arrays (M_i, 3) [m], fixed frame
    sensor_origins=np.zeros((N, 3)),  # (N, 3) [m], or None
)
(refined,) = refine([track], Config(estimate='track'))

print('status:', *sorted(set(refined.status)))
for name, found in (('input', boxes), ('refined', refined.boxes)):
    error = np.linalg.norm((found - truth)[:, :2], axis=1).mean()
    print(f'mean position error, {name}: {error:.3f} m')
