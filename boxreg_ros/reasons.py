"""Reasons why messages, sweeps and boxes are not used: meaning and remedy of every counter."""

from enum import auto, StrEnum
from typing import Self

REDUCE_LOAD = (
    'compare the latencies in `/diagnostics`; lower `window` or `sampling.points`, publish fewer '
    'boxes, use more CPU cores (`solver.threads`), or give the node cores of its own, see '
    '"Priority and cores"'
)
ENLARGE_TRANSPORT = 'see "Large clouds"'
CHECK_TRANSFORMS = 'see "Requirements of your TF tree and stamps"'


def _reason(unit: str, meaning: str, remedy: str = '') -> tuple[auto, str, str, str]:
    """Return the facts of a member of `Reason`, whose name in lower case is its text."""
    return auto(), unit, meaning, remedy


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

    def __new__(cls, name: str, unit: str, meaning: str, remedy: str) -> Self:
        """Return a reason with its explanation."""
        reason = str.__new__(cls, name)
        reason._value_ = name
        reason.unit = unit
        reason.meaning = meaning
        reason.remedy = remedy
        return reason

    FAILED = _reason(
        'message',
        'an internal error of boxreg_ros; boxes held were published unchanged and all tracks '
        'were restarted',
        'report it with the traceback in the log',
    )
    QOS_INCOMPATIBLE = _reason(
        'publisher or subscriber',
        'its QoS is incompatible with that of the node, so no message is delivered; the log names '
        'topic and policy',
        'set the node parameter `qos_overrides.TOPIC.subscription.POLICY`, or change the QoS of '
        'the other side',
    )
    UNREADABLE = _reason(
        'message',
        'the cloud or box array is inconsistent or its layout is not supported; boxes are '
        'published unchanged (offline: in `overlay.mcap` only)',
        'find the error in the log or in `summary.json`, and correct the publisher',
    )
    POINTS_QUEUE_FULL = _reason(
        'cloud',
        'dropped because the solver is slower than the data: it waited longer than `backlog`, or '
        'longer than `deadline` while the waits grew',
        REDUCE_LOAD,
    )
    BOXES_QUEUE_FULL = _reason(
        'message',
        'published unchanged because the solver is slower than the data',
        REDUCE_LOAD,
    )
    STATIC_UNCHANGED = _reason(
        'cloud',
        'published on `static_points` unchanged, because its boxes were late or missing',
        'enlarge `static_points_wait`, or see the reasons of late boxes',
    )
    POINTS_LOST = _reason(
        'cloud',
        'lost by DDS between publisher and node',
        f'{ENLARGE_TRANSPORT}; if the node was killed before, restart the driver, too',
    )
    BOXES_LOST = _reason(
        'message',
        'lost by DDS between publisher and node',
        ENLARGE_TRANSPORT,
    )
    SWEEP_WITHOUT_TRANSFORM = _reason(
        'cloud',
        'no transform to the fixed frame at its stamp; the log names the frames',
        CHECK_TRANSFORMS,
    )
    NO_TRANSFORM = _reason(
        'box',
        'no transform to the fixed frame at its stamp; the log names the frames. Offline, the box '
        'is written in its own frame',
        CHECK_TRANSFORMS,
    )
    SENSOR_WITHOUT_TRANSFORM = _reason(
        'cloud',
        'no transform to the frame of a LiDAR; the origin of the frame of the cloud is used '
        'as its position',
        'publish the frames of the LiDARs on `/tf_static`, or correct `sensor_frames`',
    )
    CLOUD_WITHOUT_INFO = _reason(
        'cloud',
        'concatenated, and no info message with its stamp and size arrived; the origin of its '
        'frame is used as the position of the LiDARs',
        'record or publish the info message with the cloud; raise `transform_timeout` if it is '
        'late',
    )
    CLOUD_LATE = _reason(
        'cloud',
        'of one of several LiDARs, arrived after the others of its time were merged',
        'synchronise the clocks of the LiDARs; raise `merge_span` if their stamps are further '
        'apart than that',
    )
    CLOUD_MISSING = _reason(
        'cloud',
        'one of several LiDARs has no cloud for a sweep; the others were used',
        'check the LiDAR and its driver; leave its topic out of `points` if it is off',
    )
    TIME_JUMP = _reason(
        'jump',
        'stamps went back by more than a second; tracks and transforms were reset',
        'nothing, if a recording is played in a loop; otherwise let one clock set all stamps of '
        'a topic',
    )
    STAMP_AHEAD = _reason(
        'message',
        'its stamp is in the future of those before and after it; a cloud, transform or odometry '
        'is not used, boxes are returned unchanged',
        'correct the clock, or the driver, that sets the stamps of the topic that the log names',
    )
    REJECTED = _reason(
        'box',
        'a person rejected the refined box or its track in `boxreg review`',
    )
    DELETED = _reason(
        'box',
        'rejected: a person deleted the box or its track in `boxreg review`',
    )
    NO_SWEEP = _reason(
        'box',
        'no cloud within `reach` of its stamp',
        'copy the stamp of the cloud to its boxes; where there are more boxes than clouds, raise '
        '`reach` to half the period of the clouds; check the counters of clouds; raise `queue` if '
        'boxes arrive more than `queue` clouds late',
    )
    COMPILING = _reason(
        'message',
        'published unchanged, because the solver was compiled meanwhile, once after an '
        'installation',
        'run `boxreg compile` before the robot drives, and when an image is built',
    )
    CLOUD_DROPPED = _reason(
        'box',
        'its cloud was dropped by the node, as `points_queue_full` counts',
        REDUCE_LOAD,
    )
    SWEEP_LATE = _reason(
        'cloud',
        'arrived after younger boxes had been processed',
        'publish clouds in the order of their stamps and before their boxes',
    )
    SWEEP_DUPLICATE = _reason(
        'cloud',
        'a second cloud with the same stamp',
        'publish one cloud per stamp: merge the clouds of several sensors',
    )
    BOXES_WITHOUT_SWEEP = _reason(
        'message',
        'no cloud was found for it; its boxes are counted as `no_sweep`',
    )
    POSE_REFERENCE = _reason(
        'message',
        'its boxes are displaced from their points; the log has the figures',
        'set `pose_reference`, `size_order`, `forward_axis`, `orientation`, `size_scale` or '
        '`boxes_frame` as the log suggests; these are for all classes: correct boxes of classes '
        'that the log names beside right ones where they are made, or in a `boxes.csv`',
    )
    TRACK_IDS_JUMP = _reason(
        'message',
        'its track ids do not identify objects over time: they go from object to object, such as '
        'ids that are the row in the message, are new in each message, or are missing; the log '
        'has the figures',
        'set `associate`, or run a tracker before this node; where a tracker would not err so '
        'often, boxes are associated without it, unless `keep_ids` (`--keep-ids`) is set',
    )
    OBJECTS_TWICE = _reason(
        'message',
        'most of its objects have two boxes with an id each, as of two detectors or trackers on '
        'one topic; each is refined by itself',
        'publish the boxes of one of them on this topic, or join them before this node',
    )
    BOXES_REPEATED = _reason(
        'message',
        'many of its messages repeat the boxes before them at a later stamp, as a timer publishes '
        'them: they are where their objects were before',
        'publish boxes once, with the stamp of their cloud',
    )
    CLOCK_OFFSET = _reason(
        'message',
        'the clock of its stamps is off from that of the motion, or of the clouds, or each stamp '
        'of a cloud is off by itself; the log has the figure',
        'synchronise the clocks (PTP or NTP), or set `clock_offset` or `boxes_offset` as the log '
        'suggests; let the driver of the LiDAR stamp clouds by the time of the sensor',
    )
    FIXED_FRAME_JUMPS = _reason(
        'message',
        'a localisation corrects the fixed frame in steps, and all boxes step with it',
        'set `fixed_frame` to the smooth frame that the log names, `odom` by REP 105; a node that '
        'has chosen the other one goes on in it',
    )
    SENSOR_POSITION = _reason(
        'message',
        'the clouds are registered into a frame that does not move, whose origin is taken for the '
        'LiDAR',
        'set `sensor_frames` as the log suggests',
    )
    CLOUD_FAULT = _reason(
        'message',
        'its clouds are parts of sweeps, of several LiDARs on one topic, in millimetres, or too '
        'far from their origin for float32; the log says which',
        'mend them in the driver of the LiDAR, or in a node before this one, as the log says',
    )
    TRANSFORM_FAULT = _reason(
        'message',
        'a publisher of TF makes a mistake that moves clouds and boxes; the log names the frames',
        CHECK_TRANSFORMS,
    )
    POINT_TIMES = _reason(
        'message',
        'the times of the points of its clouds are parts of a revolution, and are read as such, '
        'or are of no known unit, and are not used; the log says which',
        'correct the driver of the LiDAR, which would give exact times',
    )
    LATENCY = _reason(
        'message',
        'its boxes are late, or early, and were moved to where their objects are at their stamp',
        'correct their stamps where they are made, or set `sampling.box_time`',
    )
    VISIBLE_BOXES = _reason(
        'message',
        'its boxes hold what is seen of their objects, as those of clusters, and were lengthened '
        'away from the sensor to the extents that their tracks have shown',
        'publish boxes of whole objects; if they are, set `sampling.box_extents` to `whole`',
    )
    LATE = _reason(
        'box',
        'arrived after boxes with a younger stamp',
        'publish boxes in the order of their stamps',
    )
    DUPLICATE_STAMP = _reason(
        'box',
        'a second message with the same stamp, and some of the same objects',
        'publish one message per stamp: merge the outputs of several detectors',
    )
    NO_TRACK_ID = _reason(
        'box',
        'has no track id',
        'set `associate` (`--associate`), or run a tracker before this node',
    )
    DUPLICATE_TRACK_ID = _reason(
        'box',
        'its track id occurs twice in one message',
        'give each object an id of its own',
    )
    INVALID_BOX = _reason(
        'box',
        'contains NaN or infinity, an extent that is not positive or above 1 km, a position '
        'beyond 30,000 km, or a quaternion that is not of unit length, such as one of zeros',
        'check the detector, and its units; without rotation a quaternion is x=0 y=0 z=0 w=1; '
        'polygons of Autoware, and shapes of derived_object_msgs that are no BOX, have no length '
        'and width, and stay as they are',
    )
    NOT_FINITE = _reason(
        'box',
        'the solution of its window is not finite, or an extent of it is not positive',
        'check stamps, coordinates and ids of the boxes',
    )
    BUDGET = _reason(
        'box',
        'not solved before `deadline`: other tracks came first; its track is solved at a later '
        'stamp, which refines the final box too if that is within `lag`. 1 % of the final boxes '
        'are a WARN; early boxes have the counter `early_budget`, and 5 % of them are one',
    )
    COAST_UNCONFIRMED = _reason(
        'predicted box',
        'a track has no box in a message, and with `coast` none was added: too few points in the '
        'predicted box, or another box has its place',
    )
    NOT_FOLLOWED = _reason(
        'box on ~/follow',
        'its object is not followed: it has no id or no points, no transform is known, or none of '
        'the clouds of the last 2 s has its stamp; `not_followed ID` in `/diagnostics` says which',
        'correct the box, its frame or its stamp',
    )
    LOST = _reason(
        'followed object',
        'its points do not fit any more; `lost ID` in `/diagnostics` says since when, where and '
        'why',
        'publish another box of it on `~/follow`',
    )
    SWEEP_WITHOUT_BOXES = _reason('cloud', 'no boxes arrived for it, or too late')
    NO_POINTS = _reason(
        'box',
        'no points near any box of its window: occluded or too far away',
    )
    NO_GAIN = _reason(
        'box',
        'the refined box contains far fewer of the points than the input box does',
    )
    NOT_RIGID = _reason(
        'box',
        'the input boxes of its track are wider in curves: a body that does not keep its shape',
        'give tractor and trailer a box each',
    )
    GHOST = _reason('box', 'rejected: its track is short, without consistent points or motion')
    DUPLICATE = _reason('box', 'rejected: overlaps the boxes of a track with more evidence')
    RARELY_DETECTED = _reason(
        'missing box',
        'not added in a track with several gaps that has a box less than half as often as usual '
        'in the drive: it may be no object',
        'accept the track in `boxreg review`, and it is filled',
    )
    REJECTED_LABEL = _reason(
        'box of label files',
        'its status is `rejected`: the run that wrote the file, or a person, has rejected it',
        'give it another status to have it used',
    )
    NOT_A_KEYFRAME = _reason(
        'box of label files',
        'with `--keyframes`: the labelling tool interpolated it, or a tracker or a model made it; '
        'no person placed it',
        'place a box there by hand to have it used as one, or leave `--keyframes` out',
    )
    OTHER_SOURCE = _reason(
        'box of label files',
        'of another source than the one that was read, such as a model run beside the ground '
        'truth',
        'name the source to read after the path: `PATH#SOURCE`',
    )
    NO_BOX = _reason(
        'entry of label files',
        'the file states that the object has no box there: a contour or a value that is null, a '
        'region without labels, a frame where the object is outside',
    )
    SHORT_TRACK = _reason(
        'box',
        'its window has fewer than `min_observations` observations',
    )


FAULTS = (Reason.FAILED, Reason.QOS_INCOMPATIBLE)
"""Reasons that are an ERROR in `/diagnostics`, even when they occur once."""
REASONS = {reason.value: reason for reason in Reason}
"""The reasons by name."""
