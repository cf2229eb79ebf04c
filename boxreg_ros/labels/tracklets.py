"""
KITTI raw: ``tracklet_labels.xml``, one tracklet per gapless sequence of a track in one class.

A tracklet has one extent, the median over its boxes, and one pose per frame: the centre of the
bottom face in the LiDAR frame. ``l`` is the extent along x of the box. Datumaro and CVAT differ:
they read the extents along x, y and z from ``h``, ``w`` and ``l`` and the position as the centre;
``--swap-axes`` writes files for them.

"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
import re
import shutil
from tempfile import TemporaryFile
from typing import cast
from xml.etree import ElementTree
from xml.sax.saxutils import escape, unescape

from boxreg_ros.labels.files import following, to_json
from boxreg_ros.labels.folder import FolderWriter
from boxreg_ros.labels.protocol import Format, LabelFrame, Options, Provenance, SceneFrames
from boxreg_ros.labels.records import ReadBox
from boxreg_ros.labels.sidecar import numbered_frames, numbered_scene
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import ADDED, BOX_CENTER, BOX_EXTENT, Floats, ROLL, YAW
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
POSE_TAGS = ('tx', 'ty', 'tz', 'rx', 'ry', 'rz')
EXTENT_TAGS = {False: ('l', 'w', 'h'), True: ('h', 'w', 'l')}
"""Tags of length, width and height by `Options.swap_axes`."""
SWAPPED_COMMENT = 'axes swapped'
TRACK_COMMENT = 'track '
ESCAPED_HYPHEN = '&#45;'
"""Replaces a hyphen in a comment where XML forbids it: beside another, or at the end."""
INVALID_CHARACTERS = re.compile('[^\t\n -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]')
"""Characters that XML forbids, or changes (carriage returns)."""
XML_HEAD = """\
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
"""Attributes that boost requires at the first tracklet, poses and pose."""
TAIL = '</tracklets>\n</boost_serialization>\n'
INTERPOLATED_STATE = 1
LABELLED_STATE = 2
UNKNOWN_TRUNCATION = {False: '99', True: '-1'}
"""Unknown truncation by `Options.swap_axes`: of KITTI and of Datumaro."""
FLAGS = """\
<occlusion>-1</occlusion><occlusion_kf>0</occlusion_kf><truncation>{unknown}</truncation>\
<amt_occlusion>-1</amt_occlusion><amt_occlusion_kf>-1</amt_occlusion_kf>\
<amt_border_l>-1</amt_border_l><amt_border_r>-1</amt_border_r><amt_border_kf>-1</amt_border_kf>"""


@dataclass(slots=True)
class _Tracklet:
    """A gapless sequence of boxes (9,) of a track, from frame `first_frame` on."""

    track_id: str
    class_name: str
    first_frame: int
    boxes: list[Floats] = field(default_factory=list)
    states: list[int] = field(default_factory=list)


class Writer(FolderWriter):
    """Hold the tracklets of the current frame, and write each when its track is interrupted."""

    cloud_file = 'velodyne_points/data/{number:010d}.bin'
    has_sidecar = True

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        super().__init__(folder, provenance, options)
        self._is_swapped = options.swap_axes
        origin = self.about | ({'axes': SWAPPED_COMMENT} if self._is_swapped else {})
        self._origin = _comment(to_json(origin))
        # The file begins with the number of tracklets: they are collected in another file first.
        self._body = TemporaryFile('w+', encoding='utf-8', dir=folder)  # noqa: SIM115
        self._open: dict[tuple[str, str], _Tracklet] = {}
        self._count = 0

    def add(self, frame: LabelFrame) -> None:
        """Add a pose to the tracklets of this frame, and write those that have ended."""
        rows, boxes = frame.boxes_in('sensor', self.dropped)
        array = frame.refined.boxes
        continued: dict[tuple[str, str], _Tracklet] = {}
        for row, box in zip(rows, boxes, strict=True):
            track_id = array.track_ids[row]
            class_name = array.class_names[row]
            tracklet = _Tracklet(track_id, class_name, self.number)
            key = (track_id, class_name)
            if not track_id or key in continued:  # no identity: a tracklet of one frame
                key = (f'\0{row}', '')
            else:
                tracklet = self._open.pop(key, tracklet)
            continued[key] = tracklet
            is_interpolated = frame.refined.status[row] in ADDED
            tracklet.boxes.append(box)
            tracklet.states.append(INTERPOLATED_STATE if is_interpolated else LABELLED_STATE)
        for tracklet in self._open.values():
            self._write(tracklet)
        self._open = continued

    def finish(self) -> None:
        """Write the open tracklets, and assemble the file."""
        for tracklet in self._open.values():
            self._write(tracklet)
        self._body.seek(0)
        with (self.folder / FILE).open('w', encoding='utf-8') as file:
            file.write(XML_HEAD.format(origin=self._origin, count=self._count))
            shutil.copyfileobj(self._body, file)
            file.write(TAIL)
        self._body.close()

    def _write(self, tracklet: _Tracklet) -> None:
        boxes = np.array(tracklet.boxes)
        extent = np.median(boxes[:, BOX_EXTENT], axis=0)
        sizes = dict(zip(EXTENT_TAGS[self._is_swapped], extent.tolist(), strict=True))
        shift = 0.0 if self._is_swapped else -extent[2] / 2
        poses = np.hstack([_shifted_centres(boxes, shift), boxes[:, ROLL : YAW + 1]])
        class_name = ' '.join(tracklet.class_name.split())
        class_name = INVALID_CHARACTERS.sub('\N{REPLACEMENT CHARACTER}', class_name) or 'Misc'
        flags = FLAGS.format(unknown=UNKNOWN_TRUNCATION[self._is_swapped])
        item_id, poses_id, pose_id = CLASS_IDS if self._count == 0 else ('', '', '')
        lines = [
            f'<item{item_id}>',
            f'<!--{_comment(TRACK_COMMENT + tracklet.track_id)}-->',
            f'<objectType>{escape(class_name)}</objectType>',
            ''.join(f'<{tag}>{sizes[tag]!r}</{tag}>' for tag in 'hwl'),
            f'<first_frame>{tracklet.first_frame}</first_frame>',
            f'<poses{poses_id}>',
            f'<count>{len(poses)}</count>\n<item_version>2</item_version>',
        ]
        for pose, state in zip(poses.tolist(), tracklet.states, strict=True):
            tagged = zip(POSE_TAGS, pose, strict=True)
            values = ''.join(f'<{tag}>{value!r}</{tag}>' for tag, value in tagged)
            lines.append(f'<item{pose_id}>{values}<state>{state}</state>{flags}</item>')
            pose_id = ''
        lines.append('</poses>\n<finished>1</finished>\n</item>\n')
        self._body.write('\n'.join(lines))
        self._count += 1


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the frames of a tracklet file; its stamps are those of `sidecar` or of KITTI raw.

    The track id is in a comment of files written by `Writer`, else it is the number of the
    tracklet.

    """
    if path.is_dir():
        path = path / FILE
    boxes_by_frame = _read_boxes(path)
    raw_stamps = path.parent / 'velodyne_points' / 'timestamps.txt'
    stamps = raw_stamps if raw_stamps.exists() else None
    yield from numbered_frames(path.parent, boxes_by_frame, stamps)


def read_scene(path: Path, scene: SceneFrames) -> Iterator[LabelFrame]:
    """Yield the frames of a drive, by the stamps of the data set."""
    if path.is_dir():
        path = path / FILE
    yield from numbered_scene(path, _read_boxes(path), scene)


def _read_boxes(path: Path) -> dict[int, list[ReadBox]]:
    """Return the boxes of a tracklet file by the index of their frame."""
    with following(path, 'tracklets of KITTI'):
        text = path.read_text(encoding='utf-8')
        builder = ElementTree.TreeBuilder(insert_comments=True)
        try:
            tree = ElementTree.parse(path, ElementTree.XMLParser(target=builder))
        except ElementTree.ParseError as error:
            raise ValueError(str(error)) from None
        is_swapped = SWAPPED_COMMENT in text[: text.find('<boost_serialization')]
        return _boxes_by_frame(tree.getroot(), is_swapped)


def _boxes_by_frame(root: ElementTree.Element, is_swapped: bool) -> dict[int, list[ReadBox]]:
    """Return the boxes of all tracklets by the index of their frame."""
    boxes_by_frame: dict[int, list[ReadBox]] = {}
    for number, item in enumerate(root.findall('tracklets/item')):
        track_id = _track_id(item, str(number))
        class_name = (item.findtext('objectType') or '').strip()
        extent = [_number(item, tag) for tag in EXTENT_TAGS[is_swapped]]
        first_frame = int(_number(item, 'first_frame'))
        for index, pose in enumerate(item.findall('poses/item'), first_frame):
            values = [_number(pose, tag) for tag in POSE_TAGS]
            box = np.array([*values[:3], *extent, *values[3:]])
            if not is_swapped:
                box[BOX_CENTER] = _shifted_centres(box[None], extent[2] / 2)[0]
            boxes_by_frame.setdefault(index, []).append(ReadBox(track_id, class_name, box))
    return boxes_by_frame


def _track_id(item: ElementTree.Element, default: str) -> str:
    """Return the track id in the comment of a tracklet, or the default."""
    for element in item:
        text = str(element.text)
        if _is_comment(element) and text.startswith(TRACK_COMMENT):
            return _uncomment(text.removeprefix(TRACK_COMMENT))
    return default


def _is_comment(element: ElementTree.Element) -> bool:
    # The tag of a comment is the function `Comment`, though it is annotated as text.
    return cast(object, element.tag) is ElementTree.Comment


def _shifted_centres(boxes: Floats, shift: float) -> Floats:
    """Return the centres (n, 3) of boxes (n, 9), moved along z of the box by `shift` [m]."""
    R = matrix_from_rpy(boxes[:, ROLL:])
    return boxes[:, BOX_CENTER] + shift * R[:, :, 2]


def _number(item: ElementTree.Element, tag: str) -> float:
    text = item.findtext(tag)
    if text is None:
        raise ValueError(f'<{item.tag}> lacks <{tag}>')
    return float(text)


def _comment(text: str) -> str:
    """Return text escaped for a comment of XML; `_uncomment` is the inverse."""
    text = INVALID_CHARACTERS.sub(lambda found: f'&#{ord(found[0])};', escape(text))
    text = text.replace('--', f'-{ESCAPED_HYPHEN}')
    if text.endswith('-'):
        text = text.removesuffix('-') + ESCAPED_HYPHEN
    return text


def _uncomment(text: str) -> str:
    """Return the text that `_comment` has escaped."""
    return unescape(re.sub('&#([0-9]{1,7});', lambda found: chr(int(found[1])), text))
