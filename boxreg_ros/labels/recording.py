"""
Recordings of the live node: the final boxes that it published, read as labels.

The messages on ``refined_labels`` hold all that label files do. Where that topic was not recorded,
the boxes are those of ``refined_boxes_final``, as its message type has them: without status,
reason, number of points and covariance. A topic of another name is given behind a ``#``, as in
``drive#/front/refined_labels``.

"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from boxreg_ros.errors import RecordingError, UnsupportedMessage
from boxreg_ros.io.label_messages import from_text, LabelMessage, LABELS_TOPIC, LABELS_TYPE
from boxreg_ros.io.message_decoder import malformed, MessageDecoder
from boxreg_ros.io.storage.files import part_of
from boxreg_ros.io.storage.reader import Reader
from boxreg_ros.io.topics import Topics
from boxreg_ros.labels.protocol import Format, LabelFrame
from boxreg_ros.labels.records import refined_boxes
from msg_adapters import adapter_for, ADAPTERS

FORMAT = Format(
    name='recording',
    title='Recording of the live node (refined_labels, else refined_boxes_final)',
    frame='fixed; of the message without refined_labels',
    rotation='roll pitch yaw; of the message type without refined_labels',
    files='none: `ros2 bag record` writes it',
)
BOXES_TOPIC = 'refined_boxes_final'


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the boxes of each message, in the order in which they were received.

    Parts of damaged files are left out, as of `Recording.damages`. Raises RecordingError if the
    recording has no topic of labels, or several, or one of its messages is no label.

    """
    for _, frame in _messages(path):
        yield frame


def config_hash(path: Path) -> str:
    """Return the hash of the settings of the node; empty where its messages have none."""
    return next((found for found, _ in _messages(path)), '')


def files_of(path: Path) -> Path:
    """Return the path of the recording, without the topic."""
    return Path(_parts(path)[0])


def _parts(path: Path) -> tuple[str, str]:
    """Return the path of the recording, and the topic that was asked for; empty for none."""
    drive, _, asked = str(path).partition('#')
    return drive, asked


def _messages(path: Path) -> Iterator[tuple[str, LabelFrame]]:
    """Yield hash of the settings and labels of each message."""
    drive, asked = _parts(path)
    with closing(Reader([part_of(Path(drive))])) as reader:
        topics = Topics(reader.connections, drive)
        topic = _topic_of(topics, drive, asked)
        decoder = MessageDecoder(drive)
        for record in reader.messages(topics.connections({topic}), None, None):
            try:
                message = decoder.message(record)
                with malformed(f'topic {topic!r}'):
                    found = _content(message, topics.kinds[topic])
            except UnsupportedMessage as error:
                raise RecordingError(
                    f'labels {drive!r}: {error}; give the labels by boxreg relabel --set '
                    f'estimate=final of this recording instead'
                ) from None
            yield found


def _topic_of(topics: Topics, drive: str, asked: str) -> str:
    """Return the topic asked for, that of labels, or that of final boxes."""
    kinds = topics.kinds
    able = [topic for topic, kind in kinds.items() if kind == LABELS_TYPE or kind in ADAPTERS]
    if asked:
        found = [topic for topic in able if topic == asked]
    else:
        labels = [t for t in able if kinds[t] == LABELS_TYPE and _last(t) == LABELS_TOPIC]
        found = labels or [t for t in able if kinds[t] in ADAPTERS and _last(t) == BOXES_TOPIC]
    if len(found) == 1:
        return found[0]
    wanted = asked or f'{LABELS_TOPIC} or {BOXES_TOPIC}'
    got = ', '.join(found) or 'none'
    raise RecordingError(
        f'labels {drive!r}: expected one topic {wanted}, got {got}; topics of boxes and texts: '
        f'{", ".join(able) or "none"}; name one of these as {drive}#TOPIC'
    )


def _last(topic: str) -> str:
    return topic.rsplit('/', 1)[-1]


def _content(message: object, kind: str) -> tuple[str, LabelFrame]:
    """Return hash of the settings and labels of a message."""
    if kind == LABELS_TYPE:
        found: LabelMessage = from_text(message.data)  # type: ignore[attr-defined]
        return found.config_hash, LabelFrame(found.refined, found.fixed_frame, '')
    boxes = adapter_for(kind).from_msg(message)
    evidence = [{'score': score} for score in boxes.scores.tolist()]
    refined = refined_boxes(
        boxes.stamp_ns, boxes.frame_id, boxes.track_ids, boxes.class_names, boxes.boxes, evidence
    )
    return '', LabelFrame(refined, '', boxes.frame_id)
