"""
`measure load`: latency and accuracy of the live node by number of tracks.

Each number of tracks runs three times, as in `measure node`: with the default deadline; with
one window per stamp, which is the work that no deadline can avoid; and with a deadline of an hour,
where the node drops clouds instead. The IoU is that of all published boxes, kept ones included, to
the true boxes of the publisher.

"""

import argparse

from boxreg_ros.core.metrics import iou_3d
from measure.node import BOX_ERRORS, CIRCLE_PERIOD, measure, true_boxes
from msg_adapters import markers
import numpy as np

POLICIES = {
    'deadline': [],
    'one window': ['deadline:=0.0001'],
    'dropping clouds': ['deadline:=3600.0', 'backlog:=0.1'],
}
"""Parameters of the node for each way to treat overload; 0.1 s is a period of the sensor."""
LATENCIES = ('latency p50 [ms]', 'latency p99 [ms]')
ARGUMENTS = {
    '--tracks': ([16, 64, 256, 1024], '', {'nargs': '+'}),
    '--points': (130000, 'per sweep'),
    '--seconds': (15.0, 'seconds of data'),
}


def run(args):
    """Return latency and accuracy by policy and number of tracks."""
    return {
        policy: {str(tracks): _measured(args, tracks, settings) for tracks in args.tracks}
        for policy, settings in POLICIES.items()
    }


def _measured(args, tracks, settings):
    """Return latency, accuracy and losses for a number of tracks and parameters of the node."""
    scope = argparse.Namespace(
        tracks=tracks, points=args.points, rate=10.0, seconds=args.seconds, delay=0.05,
        motion=0.0, clock=0.0,
        transport='large', set=settings, record=None, keep_gigabytes=0.0,
    )  # fmt: skip
    report = measure(scope, keeps_messages=True)
    messages = report.pop('messages')
    overlap = {f'{name} IoU': _mean_iou(scope, messages[name]) for name in ('early', 'final')}
    dropped = float(report['counters'].get('points_queue_full', 0))
    nan = float('nan')  # no message was published
    latencies = {name: report.get(name, nan) for name in LATENCIES}
    return {**latencies, 'input IoU': _input_iou(scope), **overlap, 'clouds dropped': dropped}


def _mean_iou(args, messages):
    """Return the mean 3D IoU of serialised messages, by sweep, to the true boxes."""
    from rclpy.serialization import deserialize_message
    from visualization_msgs.msg import MarkerArray

    overlaps = [
        iou_3d(
            markers.from_msg(deserialize_message(data, MarkerArray)).boxes, true_boxes(args, turn)
        )
        for turn, data in messages.items()
    ]
    return float(np.mean(overlaps)) if overlaps else float('nan')


def _input_iou(args):
    """Return the mean 3D IoU of noisy boxes as the publisher makes them."""
    rng = np.random.default_rng(0)
    truth = np.concatenate(
        [true_boxes(args, turn) for turn in range(round(CIRCLE_PERIOD * args.rate))]
    )
    return float(
        iou_3d(truth + np.array(BOX_ERRORS) * rng.normal(0, 1, truth.shape), truth).mean()
    )
