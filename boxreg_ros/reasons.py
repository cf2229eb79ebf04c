"""Why clouds and boxes are not used: every reason that is counted, and what helps."""

from typing import NamedTuple


class Reason(NamedTuple):
    """
    What a counter counts.

    Attributes
    ----------
    unit : str
        What one count is: a box, a cloud, a message ...
    meaning, remedy : str
        What has happened, and what can be done about it; no remedy where it is in the nature of
        the data.

    """

    unit: str
    meaning: str
    remedy: str = ''


FASTER = (
    'see the latencies; lower `window`, `solver.rounds` or `sampling.points`, fewer boxes, or '
    'more cores and `solver.threads`'
)
CARRIED = 'see "Large clouds"'
FAULTS = ('failed', 'qos_incompatible')
"""What must not be, however rarely."""
REASONS = {
    'failed': Reason(
        'message',
        'a fault of boxreg_ros; what was held has passed through, tracks begin anew',
        'please report it with the log',
    ),
    'qos_incompatible': Reason(
        'publisher or subscriber',
        'it asks for another QoS than the node: nothing arrives. The log names topic and policy',
        "set the node's parameter `qos_overrides.TOPIC.subscription.POLICY` or change the other",
    ),
    'unreadable': Reason(
        'message',
        'cloud or boxes that contradict themselves, or in a layout that is not known; boxes pass '
        'through, offline only in `overlay.mcap`',
        'the log, or `summary.json`, has the reason: mend the publisher',
    ),
    'points_queue_full': Reason('cloud', 'dropped: the solver is slower than the data', FASTER),
    'boxes_queue_full': Reason(
        'message', 'passed through: the solver is slower than the data', FASTER
    ),
    'points_lost': Reason('cloud', 'DDS lost it on the way', CARRIED),
    'boxes_lost': Reason('message', 'DDS lost it on the way', CARRIED),
    'sweep_without_transform': Reason(
        'cloud',
        'no transform at its stamp; the log has the frames',
        'see "Requirements of your TF tree and stamps"',
    ),
    'no_transform': Reason(
        'box',
        'no transform at its stamp; the log has the frames. Offline it is in its own frame',
        'see "Requirements of your TF tree and stamps"',
    ),
    'time_jump': Reason(
        'jump',
        'stamps went back by more than a second: all starts afresh',
        'as it should be where a recording loops; otherwise two clocks are at work on one topic',
    ),
    'no_sweep': Reason(
        'box',
        'no cloud within `tolerance` and `reach` of its stamp',
        'copy the stamp of the cloud to its boxes, and see the counters of clouds; raise `queue` '
        'where boxes come later than so many clouds',
    ),
    'sweep_late': Reason(
        'cloud', 'came after younger boxes had left', 'publish clouds in order and before boxes'
    ),
    'sweep_duplicate': Reason(
        'cloud', 'a second one of the same stamp', 'one cloud per stamp: merge those of sensors'
    ),
    'boxes_without_sweep': Reason('message', 'its boxes are those counted as `no_sweep`'),
    'pose_reference': Reason(
        'message',
        'boxes do not stand where their points are; the log has the figures',
        'set `pose_reference`, `size_order` or `forward_axis` as the log says',
    ),
    'late': Reason(
        'box', 'younger boxes were there before', 'publish boxes in the order of their stamps'
    ),
    'duplicate_stamp': Reason(
        'box', 'a second message of the same stamp', 'one message per stamp: merge the detectors'
    ),
    'no_track_id': Reason('box', 'it has no id', 'set `associate`, or put a tracker before'),
    'duplicate_track_id': Reason(
        'box', 'the id occurs twice in one message', 'ids must name objects'
    ),
    'invalid_box': Reason('box', 'NaN, or an extent that is not positive', 'check the detector'),
    'not_finite': Reason('box', 'its window could not be solved', 'check stamps and coordinates'),
    'sweep_without_boxes': Reason('cloud', 'no boxes came for it, or too late'),
    'no_points': Reason('box', 'no returns near any box of its window: it is hidden or far away'),
    'no_gain': Reason('box', 'the refined box would have lost the points of the input box'),
    'short_track': Reason('box', 'fewer than `min_observations` in its window'),
}
"""The weightiest first; every box that is `kept`, and every cloud not used, has one."""
