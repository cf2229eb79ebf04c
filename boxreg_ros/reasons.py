"""Reasons why messages, sweeps and boxes are not used: meaning and remedy of every counter."""

from enum import StrEnum
from typing import Self

REDUCE_LOAD = (
    'compare the latencies in `/diagnostics`; lower `window` or `sampling.points`, publish fewer '
    'boxes, use more CPU cores (`solver.threads`), or give the node cores of its own, see '
    '"Priority and cores"'
)
ENLARGE_TRANSPORT = 'see "Large clouds"'
CHECK_TRANSFORMS = 'see "Requirements of your TF tree and stamps"'


class Reason(StrEnum):
    """
    A reason, as counters and results name it.

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
    remedy: str

    def __new__(cls, name: str, unit: str, meaning: str, remedy: str = '') -> Self:
        """Return a reason with its explanation."""
        reason = str.__new__(cls, name)
        reason._value_ = name
        reason.unit = unit
        reason.meaning = meaning
        reason.remedy = remedy
        return reason

    FAILED = (
        'failed',
        'message',
        'an internal error of boxreg_ros; boxes held were published unchanged and all tracks '
        'were restarted',
        'report it with the traceback in the log',
    )
    QOS_INCOMPATIBLE = (
        'qos_incompatible',
        'publisher or subscriber',
        'its QoS is incompatible with that of the node, so no message is delivered; the log names '
        'topic and policy',
        'set the node parameter `qos_overrides.TOPIC.subscription.POLICY`, or change the QoS of '
        'the other side',
    )
    UNREADABLE = (
        'unreadable',
        'message',
        'the cloud or box array is inconsistent or its layout is not supported; boxes are '
        'published unchanged (offline: in `overlay.mcap` only)',
        'find the error in the log or in `summary.json`, and correct the publisher',
    )
    POINTS_QUEUE_FULL = (
        'points_queue_full',
        'cloud',
        'dropped because the solver is slower than the data: it waited longer than `backlog`, or '
        'longer than `deadline` while the waits grew',
        REDUCE_LOAD,
    )
    BOXES_QUEUE_FULL = (
        'boxes_queue_full',
        'message',
        'published unchanged because the solver is slower than the data',
        REDUCE_LOAD,
    )
    STATIC_UNCHANGED = (
        'static_unchanged',
        'cloud',
        'published on `static_points` unchanged, because its boxes were late or missing',
        'enlarge `static_points_wait`, or see the reasons of late boxes',
    )
    POINTS_LOST = (
        'points_lost',
        'cloud',
        'lost by DDS between publisher and node',
        f'{ENLARGE_TRANSPORT}; if the node was killed before, restart the driver, too',
    )
    BOXES_LOST = (
        'boxes_lost',
        'message',
        'lost by DDS between publisher and node',
        ENLARGE_TRANSPORT,
    )
    SWEEP_WITHOUT_TRANSFORM = (
        'sweep_without_transform',
        'cloud',
        'no transform to the fixed frame at its stamp; the log names the frames',
        CHECK_TRANSFORMS,
    )
    NO_TRANSFORM = (
        'no_transform',
        'box',
        'no transform to the fixed frame at its stamp; the log names the frames. Offline, the box '
        'is written in its own frame',
        CHECK_TRANSFORMS,
    )
    SENSOR_WITHOUT_TRANSFORM = (
        'sensor_without_transform',
        'cloud',
        'no transform to the frame of a LiDAR; the origin of the frame of the cloud is used '
        'as its position',
        'publish the frames of the LiDARs on `/tf_static`, or correct `sensor_frames`',
    )
    CLOUD_WITHOUT_INFO = (
        'cloud_without_info',
        'cloud',
        'concatenated, and no info message with its stamp and size arrived; the origin of its '
        'frame is used as the position of the LiDARs',
        'record or publish the info message with the cloud; raise `transform_timeout` if it is '
        'late',
    )
    CLOUD_LATE = (
        'cloud_late',
        'cloud',
        'of one of several LiDARs, arrived after the others of its time were merged',
        'synchronise the clocks of the LiDARs; raise `merge_span` if their stamps are further '
        'apart than that',
    )
    CLOUD_MISSING = (
        'cloud_missing',
        'cloud',
        'one of several LiDARs has no cloud for a sweep; the others were used',
        'check the LiDAR and its driver; leave its topic out of `points` if it is off',
    )
    TIME_JUMP = (
        'time_jump',
        'jump',
        'stamps went back by more than a second; tracks and transforms were reset',
        'nothing, if a recording is played in a loop; otherwise let one clock set all stamps of '
        'a topic',
    )
    STAMP_AHEAD = (
        'stamp_ahead',
        'message',
        'its stamp is in the future of those before and after it; a cloud, transform or odometry '
        'is not used, boxes are returned unchanged',
        'correct the clock, or the driver, that sets the stamps of the topic that the log names',
    )
    REJECTED = (
        'rejected',
        'box',
        'a person rejected the refined box or its track in `boxreg review`',
        '',
    )
    DELETED = (
        'deleted',
        'box',
        'rejected: a person deleted the box or its track in `boxreg review`',
    )
    NO_SWEEP = (
        'no_sweep',
        'box',
        'no cloud within `reach` of its stamp',
        'copy the stamp of the cloud to its boxes; where there are more boxes than clouds, raise '
        '`reach` to half the period of the clouds; check the counters of clouds; raise `queue` if '
        'boxes arrive more than `queue` clouds late',
    )
    COMPILING = (
        'compiling',
        'message',
        'published unchanged, because the solver was compiled meanwhile, once after an '
        'installation',
        'run `boxreg compile` before the robot drives, and when an image is built',
    )
    CLOUD_DROPPED = (
        'cloud_dropped',
        'box',
        'its cloud was dropped by the node, as `points_queue_full` counts',
        REDUCE_LOAD,
    )
    SWEEP_LATE = (
        'sweep_late',
        'cloud',
        'arrived after younger boxes had been processed',
        'publish clouds in the order of their stamps and before their boxes',
    )
    SWEEP_DUPLICATE = (
        'sweep_duplicate',
        'cloud',
        'a second cloud with the same stamp',
        'publish one cloud per stamp: merge the clouds of several sensors',
    )
    BOXES_WITHOUT_SWEEP = (
        'boxes_without_sweep',
        'message',
        'no cloud was found for it; its boxes are counted as `no_sweep`',
    )
    POSE_REFERENCE = (
        'pose_reference',
        'message',
        'its boxes are displaced from their points; the log has the figures',
        'set `pose_reference`, `size_order`, `forward_axis`, `orientation`, `size_scale` or '
        '`boxes_frame` as the log suggests; these are for all classes: correct boxes of classes '
        'that the log names beside right ones where they are made, or in a `boxes.csv`',
    )
    TRACK_IDS_JUMP = (
        'track_ids_jump',
        'message',
        'its track ids do not identify objects over time: they go from object to object, such as '
        'ids that are the row in the message, are new in each message, or are missing; the log '
        'has the figures',
        'set `associate`, or run a tracker before this node',
    )
    CLOCK_OFFSET = (
        'clock_offset',
        'message',
        'the clock of its stamps is off from that of the motion, or of the clouds; the log has '
        'the figure',
        'synchronise the clocks (PTP or NTP), or set `clock_offset` or `boxes_offset` as the log '
        'suggests',
    )
    FIXED_FRAME_JUMPS = (
        'fixed_frame_jumps',
        'message',
        'a localisation corrects the fixed frame in steps, and all boxes step with it',
        'set `fixed_frame` to the smooth frame that the log names, `odom` by REP 105',
    )
    SENSOR_POSITION = (
        'sensor_position',
        'message',
        'the clouds are registered into a frame that does not move, whose origin is taken for the '
        'LiDAR',
        'set `sensor_frames` as the log suggests',
    )
    CLOUD_FAULT = (
        'cloud_fault',
        'message',
        'its clouds are parts of sweeps, of several LiDARs on one topic, in millimetres, or too '
        'far from their origin for float32; the log says which',
        'mend them in the driver of the LiDAR, or in a node before this one, as the log says',
    )
    TRANSFORM_FAULT = (
        'transform_fault',
        'message',
        'a publisher of TF makes a mistake that moves clouds and boxes; the log names the frames',
        CHECK_TRANSFORMS,
    )
    POINT_TIMES = (
        'point_times',
        'message',
        'the times of the points of its clouds are parts of a revolution, and are read as such, '
        'or are of no known unit, and are not used; the log says which',
        'correct the driver of the LiDAR, which would give exact times',
    )
    LATENCY = (
        'latency',
        'message',
        'its boxes are late, or early, and were moved to where their objects are at their stamp',
        'correct their stamps where they are made, or set `sampling.box_time`',
    )
    LATE = (
        'late',
        'box',
        'arrived after boxes with a younger stamp',
        'publish boxes in the order of their stamps',
    )
    DUPLICATE_STAMP = (
        'duplicate_stamp',
        'box',
        'a second message with the same stamp, and some of the same objects',
        'publish one message per stamp: merge the outputs of several detectors',
    )
    NO_TRACK_ID = (
        'no_track_id',
        'box',
        'has no track id',
        'set `associate` (`--associate`), or run a tracker before this node',
    )
    DUPLICATE_TRACK_ID = (
        'duplicate_track_id',
        'box',
        'its track id occurs twice in one message',
        'give each object an id of its own',
    )
    INVALID_BOX = (
        'invalid_box',
        'box',
        'contains NaN or infinity, an extent that is not positive or above 1 km, a position '
        'beyond 30,000 km, or a quaternion that is not of unit length, such as one of zeros',
        'check the detector, and its units; without rotation a quaternion is x=0 y=0 z=0 w=1',
    )
    NOT_FINITE = (
        'not_finite',
        'box',
        'the solution of its window is not finite',
        'check stamps and coordinates of the boxes',
    )
    BUDGET = (
        'budget',
        'box',
        'not solved before `deadline`: other tracks came first; its track is solved at a later '
        'stamp, which refines the final box too if that is within `lag`. 1 % of the final boxes '
        'are a WARN; early boxes have the counter `early_budget`, and 5 % of them are one',
    )
    COAST_UNCONFIRMED = (
        'coast_unconfirmed',
        'predicted box',
        'a track has no box in a message, and with `coast` none was added: too few points in the '
        'predicted box, or another box has its place',
    )
    NOT_FOLLOWED = (
        'not_followed',
        'box on ~/follow',
        'its object is not followed: it has no id or no points, no transform is known, or none of '
        'the clouds of the last 2 s has its stamp; `not_followed ID` in `/diagnostics` says which',
        'correct the box, its frame or its stamp',
    )
    LOST = (
        'lost',
        'followed object',
        'its points do not fit any more; `lost ID` in `/diagnostics` says since when, where and '
        'why',
        'publish another box of it on `~/follow`',
    )
    SWEEP_WITHOUT_BOXES = ('sweep_without_boxes', 'cloud', 'no boxes arrived for it, or too late')
    NO_POINTS = (
        'no_points',
        'box',
        'no points near any box of its window: occluded or too far away',
    )
    NO_GAIN = (
        'no_gain',
        'box',
        'the refined box contains far fewer of the points than the input box does',
    )
    NOT_RIGID = (
        'not_rigid',
        'box',
        'the input boxes of its track are wider in curves: a body that does not keep its shape',
        'give tractor and trailer a box each',
    )
    GHOST = ('ghost', 'box', 'rejected: its track is short, without consistent points or motion')
    DUPLICATE = ('duplicate', 'box', 'rejected: overlaps the boxes of a track with more evidence')
    RARELY_DETECTED = (
        'rarely_detected',
        'missing box',
        'not added in a track with several gaps that has a box less than half as often as usual '
        'in the drive: it may be no object',
        'accept the track in `boxreg review`, and it is filled',
    )
    REJECTED_LABEL = (
        'rejected_label',
        'box of label files',
        'its status is `rejected`: the run that wrote the file, or a person, has rejected it',
        'give it another status to have it used',
    )
    NOT_A_KEYFRAME = (
        'not_a_keyframe',
        'box of label files',
        'with `--keyframes`: the labelling tool interpolated it, or a tracker or a model made it; '
        'no person placed it',
        'place a box there by hand to have it used as one, or leave `--keyframes` out',
    )
    OTHER_SOURCE = (
        'other_source',
        'box of label files',
        'of another source than the one that was read, such as a model run beside the ground '
        'truth',
        'name the source to read after the path: `PATH#SOURCE`',
    )
    NO_BOX = (
        'no_box',
        'entry of label files',
        'the file states that the object has no box there: a contour or a value that is null, a '
        'region without labels, a frame where the object is outside',
    )
    SHORT_TRACK = (
        'short_track',
        'box',
        'its window has fewer than `min_observations` observations',
    )


FAULTS = (Reason.FAILED, Reason.QOS_INCOMPATIBLE)
"""Reasons that are an ERROR in `/diagnostics`, even when they occur once."""
REASONS = {reason.value: reason for reason in Reason}
"""The reasons by name."""
