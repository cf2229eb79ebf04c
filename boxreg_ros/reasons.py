"""Reasons why messages, sweeps and boxes are not used: meaning and remedy of every counter."""

from typing import NamedTuple


class Reason(NamedTuple):
    """
    The documentation of a counter.

    Attributes
    ----------
    unit : str
        The thing counted: a box, a cloud, a message ...
    meaning : str
        The event that the counter counts.
    remedy : str
        What the user can do; empty where the data allow no better.

    """

    unit: str
    meaning: str
    remedy: str = ''


REDUCE_LOAD = (
    'compare the latencies in `/diagnostics`; lower `window`, `solver.rounds` or '
    '`sampling.points`, publish fewer boxes, or use more CPU cores (`solver.threads`)'
)
REDUCE_RECORDING = (
    'record to a faster disk, fewer `record_formats`, or without clouds (`record_points:=false`)'
)
ENLARGE_TRANSPORT = 'see "Large clouds"'
CHECK_TRANSFORMS = 'see "Requirements of your TF tree and stamps"'
FAULTS = ('failed', 'qos_incompatible')
"""Reasons that are an ERROR in `/diagnostics`, even when they occur once."""
REASONS = {
    'failed': Reason(
        'message',
        'an internal error of boxreg_ros; boxes held were published unchanged and all tracks '
        'were restarted',
        'report it with the traceback in the log',
    ),
    'qos_incompatible': Reason(
        'publisher or subscriber',
        'its QoS is incompatible with that of the node, so no message is delivered; the log names '
        'topic and policy',
        'set the node parameter `qos_overrides.TOPIC.subscription.POLICY`, or change the QoS of '
        'the other side',
    ),
    'unreadable': Reason(
        'message',
        'the cloud or box array is inconsistent or its layout is not supported; boxes are '
        'published unchanged (offline: in `overlay.mcap` only)',
        'find the error in the log or in `summary.json`, and correct the publisher',
    ),
    'points_queue_full': Reason(
        'cloud', 'dropped because the solver is slower than the data', REDUCE_LOAD
    ),
    'boxes_queue_full': Reason(
        'message', 'published unchanged because the solver is slower than the data', REDUCE_LOAD
    ),
    'boxes_unrecorded': Reason(
        'message',
        'not written to the label files: the recorder, or its disk, is slower than the data; the '
        'boxes are published as always',
        REDUCE_RECORDING,
    ),
    'clouds_unrecorded': Reason(
        'cloud',
        'not written beside the labels: the recorder, or its disk, is slower than the data',
        REDUCE_RECORDING,
    ),
    'static_unchanged': Reason(
        'cloud',
        'published on `static_points` unchanged, because its boxes were late or missing',
        'enlarge `static_points_wait`, or see the reasons of late boxes',
    ),
    'points_lost': Reason('cloud', 'lost by DDS between publisher and node', ENLARGE_TRANSPORT),
    'boxes_lost': Reason('message', 'lost by DDS between publisher and node', ENLARGE_TRANSPORT),
    'sweep_without_transform': Reason(
        'cloud',
        'no transform to the fixed frame at its stamp; the log names the frames',
        CHECK_TRANSFORMS,
    ),
    'no_transform': Reason(
        'box',
        'no transform to the fixed frame at its stamp; the log names the frames. Offline, the box '
        'is written in its own frame',
        CHECK_TRANSFORMS,
    ),
    'sensor_without_transform': Reason(
        'cloud',
        'no transform to the frame of a LiDAR; the origin of the frame of the cloud is used '
        'as its position',
        'publish the frames of the LiDARs on `/tf_static`, or correct `sensor_frames`',
    ),
    'cloud_without_info': Reason(
        'cloud',
        'concatenated, and no info message with its stamp and size arrived; the origin of its '
        'frame is used as the position of the LiDARs',
        'record or publish the info message with the cloud; raise `transform_timeout` if it is '
        'late',
    ),
    'cloud_late': Reason(
        'cloud',
        'of one of several LiDARs, arrived after the others of its time were merged',
        'synchronise the clocks of the LiDARs; raise `merge_span` if their stamps are further '
        'apart than that',
    ),
    'cloud_missing': Reason(
        'cloud',
        'one of several LiDARs has no cloud for a sweep; the others were used',
        'check the LiDAR and its driver; leave its topic out of `points` if it is off',
    ),
    'time_jump': Reason(
        'jump',
        'stamps went back by more than a second; tracks and transforms were reset',
        'nothing, if a recording is played in a loop; otherwise let one clock set all stamps of '
        'a topic',
    ),
    'rejected': Reason(
        'box', 'a person rejected the refined box or its track in `boxreg review`', ''
    ),
    'no_sweep': Reason(
        'box',
        'no cloud within `tolerance` or `reach` of its stamp',
        'copy the stamp of the cloud to its boxes; check the counters of clouds; raise `queue` if '
        'boxes arrive more than `queue` clouds late',
    ),
    'sweep_late': Reason(
        'cloud',
        'arrived after younger boxes had been processed',
        'publish clouds in the order of their stamps and before their boxes',
    ),
    'sweep_duplicate': Reason(
        'cloud',
        'a second cloud with the same stamp',
        'publish one cloud per stamp: merge the clouds of several sensors',
    ),
    'boxes_without_sweep': Reason(
        'message', 'no cloud was found for it; its boxes are counted as `no_sweep`'
    ),
    'pose_reference': Reason(
        'message',
        'its boxes are displaced from their points; the log has the figures',
        'set `pose_reference`, `size_order` or `forward_axis` as the log suggests',
    ),
    'late': Reason(
        'box',
        'arrived after boxes with a younger stamp',
        'publish boxes in the order of their stamps',
    ),
    'duplicate_stamp': Reason(
        'box',
        'a second message with the same stamp',
        'publish one message per stamp: merge the outputs of several detectors',
    ),
    'no_track_id': Reason(
        'box', 'has no track id', 'set `associate`, or run a tracker before this node'
    ),
    'duplicate_track_id': Reason(
        'box',
        'its track id occurs twice in one message',
        'give each object an id of its own',
    ),
    'invalid_box': Reason(
        'box',
        'contains NaN or infinity, an extent that is not positive or above 1 km, or a position '
        'beyond 30,000 km',
        'check the detector, and its units',
    ),
    'not_finite': Reason(
        'box',
        'the solution of its window is not finite',
        'check stamps and coordinates of the boxes',
    ),
    'budget': Reason(
        'box',
        'not solved before `deadline`: other tracks came first; its track is solved at a later '
        'stamp, which refines the final box too if that is within `lag`',
    ),
    'coast_unconfirmed': Reason(
        'predicted box',
        'a track has no box in a message, and with `coast` none was added: too few points in the '
        'predicted box, or another box has its place',
    ),
    'sweep_without_boxes': Reason('cloud', 'no boxes arrived for it, or too late'),
    'no_points': Reason('box', 'no points near any box of its window: occluded or too far away'),
    'no_gain': Reason(
        'box', 'the refined box contains far fewer of the points than the input box does'
    ),
    'ghost': Reason('box', 'rejected: its track is short, without consistent points or motion'),
    'duplicate': Reason('box', 'rejected: overlaps the boxes of a track with more evidence'),
    'short_track': Reason('box', 'its window has fewer than `min_observations` observations'),
}
"""By counter, most important first. Each `kept` box and each unused cloud has one reason."""
