"""
KITTI raw: ``tracklet_labels.xml``, a tracklet per unbroken run of a track in one class.

A tracklet has one extent: the median of the track's. Its poses are of the centre of the bottom
face, in the LiDAR's frame, by the number of their frame. What KITTI calls length lies along the
box's x. Datumaro and CVAT differ: they look for the extents along x, y and z under ``w``, ``h``
and ``l``, and take the position for the centre; ``--swap-axes`` writes it so.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
import re
import shutil
from tempfile import TemporaryFile
from typing import cast
from xml.etree import ElementTree
from xml.sax.saxutils import escape, unescape

from boxreg_ros.errors import RecordingError
from boxreg_ros.labels import Format, LabelFrame, Options, Provenance
from boxreg_ros.labels.clouds import write_cloud
from boxreg_ros.labels.files import read_timeline, refined_boxes, Timeline, to_json
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import (
    Floats,
    HEIGHT,
    INTERPOLATED,
    LENGTH,
    ROLL,
    X,
    YAW,
    Z,
)
import numpy as np

FORMAT = Format(
    name='tracklets',
    title='KITTI raw tracklets',
    frame='sensor',
    reference='centre of the bottom face',
    sizes='height width length, one per tracklet',
    rotation='rx ry rz, R = Rz Ry Rx',
    files='tracklet_labels.xml, velodyne_points/',
    options=('with_points', 'swap_axes'),
)
FILE = 'tracklet_labels.xml'
POSE = ('tx', 'ty', 'tz', 'rx', 'ry', 'rz')
EXTENTS = {False: ('l', 'w', 'h'), True: ('h', 'w', 'l')}
"""Where length, width and height are written, as KITTI has it and as Datumaro reads it."""
SWAPPED, TRACK = 'axes swapped', 'track '
HYPHEN = '&#45;'
"""What a hyphen is in a comment where XML does not take it: beside another, or at the end."""
UNFIT = re.compile('[^\t\n -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]')
"""Characters that XML does not take, or not as they are (carriage returns)."""
HEAD = """\
<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>
<!DOCTYPE boost_serialization>
<!--{origin}-->
<boost_serialization signature="serialization::archive" version="9">
<tracklets class_id="0" tracking_level="0" version="0">
<count>{count}</count>
<item_version>1</item_version>
"""
CLASS_IDS = tuple(
    f' class_id="{i}" tracking_level="0" version="{version}"'
    for i, version in ((1, 1), (2, 0), (3, 2))
)
"""What boost wants to read at the first of each kind: tracklet, poses, pose."""
TAIL = '</tracklets>\n</boost_serialization>\n'
INTERPOLATED_STATE, LABELLED_STATE = 1, 2
UNKNOWN_TRUNCATION = {False: '99', True: '-1'}
"""What stands for unknown in files of KITTI, and what Datumaro takes for it."""
FLAGS = """\
<occlusion>-1</occlusion><occlusion_kf>0</occlusion_kf><truncation>{unknown}</truncation>\
<amt_occlusion>-1</amt_occlusion><amt_occlusion_kf>-1</amt_occlusion_kf>\
<amt_border_l>-1</amt_border_l><amt_border_r>-1</amt_border_r><amt_border_kf>-1</amt_border_kf>"""


@dataclass(slots=True)
class _Run:
    """An unbroken run of a track."""

    track_id: str
    class_name: str
    first: int
    boxes: list[Floats] = field(default_factory=list)
    states: list[int] = field(default_factory=list)


class Writer:
    """Hold the tracks that are seen, and write a tracklet as soon as its track is not."""

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._path = folder / FILE
        self._clouds = folder / 'velodyne_points' / 'data'
        if options.with_points:
            self._clouds.mkdir(parents=True)
        self._swap = options.swap_axes
        self._origin = asdict(provenance) | ({'axes': SWAPPED} if self._swap else {})
        # The number of tracklets comes before them: they wait in a file of their own.
        self._body = TemporaryFile('w+', encoding='utf-8', dir=folder)  # noqa: SIM115
        self._timeline = Timeline(folder, provenance)
        self._runs: dict[tuple[str, str], _Run] = {}
        self._count = self._frames = 0

    def write(self, frame: LabelFrame) -> None:
        """Add a pose to each track that is seen, and write those that are not."""
        rows, boxes = frame.placed('sensor', self.dropped)
        given = frame.refined.boxes
        runs: dict[tuple[str, str], _Run] = {}
        for row, box in zip(rows, boxes, strict=True):
            name, class_name = given.track_ids[row], given.class_names[row]
            run = _Run(name, class_name, self._frames)
            key = name, class_name
            if not name or key in runs:  # without an identity: a run of its own
                key = f'\0{row}', ''
            else:
                run = self._runs.pop(key, run)
            runs[key] = run
            is_guess = frame.refined.status[row] == INTERPOLATED
            run.boxes.append(box)
            run.states.append(INTERPOLATED_STATE if is_guess else LABELLED_STATE)
        for run in self._runs.values():
            self._write(run)
        self._runs = runs
        if frame.sweep is not None:
            write_cloud(
                self._clouds / f'{self._frames:010d}.bin', frame.sweep.points, frame.intensities
            )
        self._timeline.add(frame)
        self._frames += 1

    def close(self) -> None:
        """Write the tracks that are left, and put all together."""
        for run in self._runs.values():
            self._write(run)
        self._body.seek(0)
        with self._path.open('w', encoding='utf-8') as file:
            file.write(HEAD.format(origin=_comment(to_json(self._origin)), count=self._count))
            shutil.copyfileobj(self._body, file)
            file.write(TAIL)
        self._body.close()
        self._timeline.close()

    def _write(self, run: _Run) -> None:
        boxes = np.array(run.boxes)
        extent = np.median(boxes[:, LENGTH : HEIGHT + 1], axis=0)
        sizes = dict(zip(EXTENTS[self._swap], extent.tolist(), strict=True))
        down = 0.0 if self._swap else -extent[2] / 2
        poses = np.hstack([_shifted(boxes, down), boxes[:, ROLL : YAW + 1]])
        names = UNFIT.sub('\N{REPLACEMENT CHARACTER}', ' '.join(run.class_name.split())) or 'Misc'
        flags = FLAGS.format(unknown=UNKNOWN_TRUNCATION[self._swap])
        item, poses_item, pose_item = CLASS_IDS if self._count == 0 else ('', '', '')
        lines = [
            f'<item{item}>',
            f'<!--{_comment(TRACK + run.track_id)}-->',
            f'<objectType>{escape(names)}</objectType>',
            ''.join(f'<{name}>{sizes[name]!r}</{name}>' for name in 'hwl'),
            f'<first_frame>{run.first}</first_frame>',
            f'<poses{poses_item}>',
            f'<count>{len(poses)}</count>\n<item_version>2</item_version>',
        ]
        for pose, state in zip(poses.tolist(), run.states, strict=True):
            values = ''.join(f'<{k}>{v!r}</{k}>' for k, v in zip(POSE, pose, strict=True))
            lines.append(f'<item{pose_item}>{values}<state>{state}</state>{flags}</item>')
            pose_item = ''
        self._body.write('\n'.join([*lines, '</poses>\n<finished>1</finished>\n</item>\n']))
        self._count += 1


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the frames of a tracklet file; its stamps as `Timeline` or KITTI's raw drives have them.

    Tracks are named as our own writer left it in comments, else by the number of the tracklet.

    """
    if path.is_dir():
        path = path / FILE
    try:
        builder = ElementTree.TreeBuilder(insert_comments=True)
        tree = ElementTree.parse(path, ElementTree.XMLParser(target=builder))
        text = path.read_text(encoding='utf-8')
        is_swapped = SWAPPED in text[: text.find('<boost_serialization')]
        of_frame: dict[int, list[tuple[str, str, Floats]]] = {}
        for number, item in enumerate(tree.getroot().findall('tracklets/item')):
            comments = [str(e.text) for e in item if _is_comment(e)]
            named = [text for text in comments if text.startswith(TRACK)]
            name = _uncomment(named[0].removeprefix(TRACK)) if named else str(number)
            extent = [_number(item, key) for key in EXTENTS[is_swapped]]
            first = int(_number(item, 'first_frame'))
            for index, pose in enumerate(item.findall('poses/item'), first):
                values = [_number(pose, key) for key in POSE]
                box = np.array([*values[:3], *extent, *values[3:]])
                if not is_swapped:
                    box[X : Z + 1] = _shifted(box[None], extent[2] / 2)[0]
                kind = (item.findtext('objectType') or '').strip()
                of_frame.setdefault(index, []).append((name, kind, box))
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read: {error.strerror}') from None
    except (ElementTree.ParseError, ValueError) as error:
        raise RecordingError(f'{path}: expected tracklets of KITTI: {error}') from None
    raw = path.parent / 'velodyne_points' / 'timestamps.txt'
    count = 1 + max(of_frame, default=-1)
    timeline = read_timeline(path.parent, count, raw if raw.exists() else None)
    for index, stamp_ns in enumerate(timeline.stamps_ns):
        part = of_frame.get(index, [])
        refined = refined_boxes(
            stamp_ns,
            timeline.sensor_frame,
            [name for name, _, _ in part],
            [kind for _, kind, _ in part],
            [box for _, _, box in part],
        )
        yield timeline.frame(index, refined)


def _is_comment(element: ElementTree.Element) -> bool:
    # Its tag is the function that makes comments, though annotated as text.
    return cast(object, element.tag) is ElementTree.Comment


def _shifted(boxes: Floats, shift: float) -> Floats:
    """Return centres (n, 3), moved along the boxes' own z."""
    turned = matrix_from_rpy(boxes[:, ROLL:])
    return boxes[:, X : Z + 1] + shift * turned[:, :, 2]


def _number(item: ElementTree.Element, name: str) -> float:
    text = item.findtext(name)
    if text is None:
        raise ValueError(f'<{item.tag}> lacks <{name}>')
    return float(text)


def _comment(text: str) -> str:
    """Return text as may stand in a comment of XML; `_uncomment` returns it."""
    text = UNFIT.sub(lambda found: f'&#{ord(found[0])};', escape(text))
    text = text.replace('--', f'-{HYPHEN}')
    return text.removesuffix('-') + HYPHEN if text.endswith('-') else text


def _uncomment(text: str) -> str:
    """Return what `_comment` was given."""
    return unescape(re.sub('&#([0-9]{1,7});', lambda found: chr(int(found[1])), text))
