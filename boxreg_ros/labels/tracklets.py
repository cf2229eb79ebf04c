"""
KITTI raw: ``tracklet_labels.xml``, one tracklet per gapless sequence of a track in one class.

A tracklet has one extent, the median over its boxes, or over those of a person if it has any, and
one pose per frame: the centre of the bottom face in the LiDAR frame. ``l`` is the extent along x
of the box. Datumaro and CVAT differ, see `_convention_of`; ``--swap-axes`` writes files for them.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
import re
import shutil
from tempfile import TemporaryFile
from typing import cast, NamedTuple
from xml.etree import ElementTree
from xml.sax.saxutils import escape, unescape

from boxreg_ros.config import Config
from boxreg_ros.labels.attributes import attributes_from, OCCLUDED
from boxreg_ros.labels.files import at, following, read_provenance, to_json
from boxreg_ros.labels.folder import FolderWriter, noted
from boxreg_ros.labels.kitti import attributes_of, occlusion_of, truncation_of
from boxreg_ros.labels.protocol import (
    Format,
    INPUT_STATUS,
    LabelFrame,
    NOT_OF_A_PERSON,
    SceneFrames,
)
from boxreg_ros.labels.records import ReadBox
from boxreg_ros.labels.sidecar import numbered_frames, numbered_scene
from boxreg_ros.reasons import Reason
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import BOX_CENTER, BOX_EXTENT, Floats, HUMAN, INTERPOLATED, ROLL, YAW
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
    leaves_out='poses with which Datumaro fills gaps (counted)',
    read_back='datumaro 1.13.12',
    reads='those of KITTI, and of Datumaro and CVAT by their extents; keyframes',
)
FILE = 'tracklet_labels.xml'
NAMES_FILE = 'frame_list.txt'
"""Of Datumaro: lines with the number of a frame and its name."""
POSE_TAGS = ('tx', 'ty', 'tz', 'rx', 'ry', 'rz')
EXTENT_TAGS = {False: ('l', 'w', 'h'), True: ('h', 'w', 'l')}
"""Tags of length, width and height by `Options.swap_axes`."""
SWAPPED_COMMENT = 'axes swapped'
OWN_COMMENT = '"tool":"boxreg_ros"'
"""In the comment with the origin of files written by `Writer`."""
SAME_EXTENT = 1e-3
"""Extents that differ by less are the same [m]; chosen: far below what a person draws."""
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
OUTSIDE_TRUNCATIONS = ('2', 'TruncationStates.OUT_IMAGE')
NAMED_FLAGS = {
    'VISIBLE': 0, 'PARTLY': 1, 'FULLY': 2, 'OCCLUSION_UNSET': -1,
    'IN_IMAGE': 0, 'TRUNCATED': 1, 'OUT_IMAGE': 2, 'BEHIND_IMAGE': 99, 'TRUNCATION_UNSET': -1,
}  # fmt: skip
"""Values of occlusion and truncation by their names in Datumaro, after a full stop."""
UNSET_OCCLUSION = -1
UNSET_OCCLUSIONS = ('-1', 'OcclusionStates.OCCLUSION_UNSET')
"""Of poses with which Datumaro fills a gap; version 1.13 writes the names of its constants."""
UNKNOWN_TRUNCATION = {False: 99, True: -1}
"""Unknown truncation by `Options.swap_axes`: of KITTI and of Datumaro."""
FLAGS = """\
<occlusion>{occlusion}</occlusion><occlusion_kf>0</occlusion_kf><truncation>{truncation}</truncation>\
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
    are_human: list[bool] = field(default_factory=list)
    attributes: list[Mapping[str, str]] = field(default_factory=list)


class Writer(FolderWriter):
    """Hold the tracklets of the current frame, and write each when its track is interrupted."""

    cloud_file = 'velodyne_points/data/{number:010d}.bin'
    has_sidecar = True

    def begin(self) -> None:
        """Open the files."""
        self._is_swapped = self.options.swap_axes
        origin = self.about | ({'axes': SWAPPED_COMMENT} if self._is_swapped else {})
        self._origin = _comment(to_json(origin))
        # The file begins with the number of tracklets: they are collected in another file first.
        self._body = TemporaryFile('w+', encoding='utf-8', dir=self.folder)  # noqa: SIM115
        self._open: dict[tuple[str, str], _Tracklet] = {}
        self._count = 0
        self._changed = 0  # boxes of a person
        self._largest_change = 0.0  # of their extents [m]

    @property
    def notes(self) -> list[str]:
        """Return what could not be written as it is."""
        if not self._changed:
            return super().notes
        return [
            *super().notes,
            f'{self._changed:,} boxes of the status human have other extents than they had, by up '
            f'to {self._largest_change:.2f} m: a tracklet has one size; another format keeps them',
        ]

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
            status = frame.refined.status[row]
            is_interpolated = status in NOT_OF_A_PERSON
            tracklet.boxes.append(box)
            tracklet.attributes.append(array.attributes_of(row))
            tracklet.states.append(INTERPOLATED_STATE if is_interpolated else LABELLED_STATE)
            tracklet.are_human.append(status == HUMAN)
            if track_id:
                self.note_status(track_id, status)
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
        extents = boxes[:, BOX_EXTENT]
        of_person = extents[tracklet.are_human]
        extent = np.median(of_person if len(of_person) else extents, axis=0)
        change = np.abs(of_person - extent).max(axis=1, initial=0.0)
        self._changed += int((change > SAME_EXTENT).sum())
        self._largest_change = max(self._largest_change, change.max(initial=0.0))
        sizes = dict(zip(EXTENT_TAGS[self._is_swapped], extent.tolist(), strict=True))
        shift = 0.0 if self._is_swapped else -extent[2] / 2
        poses = np.hstack([_shifted_centres(boxes, shift), boxes[:, ROLL : YAW + 1]])
        class_name = ' '.join(tracklet.class_name.split())
        class_name = INVALID_CHARACTERS.sub('\N{REPLACEMENT CHARACTER}', class_name) or 'Misc'
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
        columns = poses.tolist(), tracklet.states, tracklet.attributes
        for pose, state, attributes in zip(*columns, strict=True):
            flags = FLAGS.format(
                occlusion=occlusion_of(attributes, UNSET_OCCLUSION),
                truncation=truncation_of(attributes, UNKNOWN_TRUNCATION[self._is_swapped]),
            )
            tagged = zip(POSE_TAGS, pose, strict=True)
            values = ''.join(f'<{tag}>{value!r}</{tag}>' for tag, value in tagged)
            lines.append(f'<item{pose_id}>{values}<state>{state}</state>{flags}</item>')
            pose_id = ''
        lines.append('</poses>\n<finished>1</finished>\n</item>\n')
        self._body.write('\n'.join(lines))
        self._count += 1


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the frames of a tracklet file.

    The track id is in a comment of files written by `Writer`, else it is the number of the
    tracklet. Files of Datumaro and CVAT are recognised by their extents, see `_convention_of`.

    Parameters
    ----------
    path : Path
        File, or the folder with it. Stamps are those of `sidecar`, of ``velodyne_points`` as in
        KITTI raw, or the names in ``frame_list.txt``, which Datumaro writes.

    Yields
    ------
    frame : LabelFrame
        One per stamp, in the frame of the LiDAR.

    Raises
    ------
    RecordingError
        If a file is missing or does not follow the format.

    """
    path = _file_of(path)
    content = _read_file(path)
    raw_stamps = path.parent / 'velodyne_points' / 'timestamps.txt'
    stamps = raw_stamps if raw_stamps.exists() else None
    names = _frame_names(path.parent / NAMES_FILE)
    yield from content.noted(numbered_frames(path.parent, content.frames, stamps, names))


def read_scene(path: Path, scene: SceneFrames) -> Iterator[LabelFrame]:
    """Yield the frames of a drive, by the stamps of the data set."""
    path = _file_of(path)
    content = _read_file(path)
    yield from content.noted(numbered_scene(path, content.frames, scene))


def _file_of(path: Path) -> Path:
    return path / FILE if path.is_dir() else path


class _Convention(NamedTuple):
    """How a program uses the tags of extents, and where the position is."""

    tags: tuple[str, str, str]
    """Of length, width and height, that is along x, y and z."""
    is_centre: bool
    """Whether the position is the centre of the box, and not of its bottom face."""
    program: str


KITTI_CONVENTION = _Convention(('l', 'w', 'h'), False, 'KITTI')
DATUMARO = _Convention(('h', 'w', 'l'), True, 'Datumaro')
CVAT = _Convention(('w', 'h', 'l'), True, 'CVAT')


class _Content(NamedTuple):
    """The boxes of a file by index of the frame, and what was assumed of it."""

    frames: dict[int, tuple[list[ReadBox], Counter[str]]]
    note: str

    def with_status(self, status: Mapping[tuple[str, int], str]) -> _Content:
        """Return it with the status of some boxes, by track and index of the frame."""
        for index, (found, _) in self.frames.items():
            for row, one in enumerate(found):
                known = status.get((one.track_id, index))
                if known is not None:
                    found[row] = one._replace(evidence={**one.evidence, 'status': known})
        return self

    def noted(self, frames: Iterator[LabelFrame]) -> Iterator[LabelFrame]:
        """Yield frames, the first with the note."""
        for index, frame in enumerate(frames):
            yield frame if index else replace(frame, note=self.note)


def _read_file(path: Path) -> _Content:
    """Return the content of a tracklet file."""
    with following(path, 'tracklets of KITTI'):
        text = path.read_text(encoding='utf-8')
        builder = ElementTree.TreeBuilder(insert_comments=True)
        try:
            tree = ElementTree.parse(path, ElementTree.XMLParser(target=builder))
        except ElementTree.ParseError as error:
            raise ValueError(str(error)) from None
        origin = text[: text.find('<boost_serialization')]
        root = tree.getroot()
        is_swapped = SWAPPED_COMMENT in origin
        if not is_swapped and OWN_COMMENT not in origin:
            return _content(root, _convention_of(root))
        content = _content(root, DATUMARO if is_swapped else KITTI_CONVENTION, is_own=True)
    return content.with_status(noted(read_provenance(path.parent), 'status'))


def _frame_names(path: Path) -> list[str]:
    """Return the names of the frames of a file with lines of number and name; empty without it."""
    if not path.exists():
        return []
    with following(path, 'lines with the number of a frame and its name'):
        lines = [line.split(maxsplit=1) for line in path.read_text(encoding='utf-8').splitlines()]
        by_number = {int(words[0]): Path(words[1].strip()).name for words in lines if words}
        return [by_number[number] for number in range(len(by_number))]


def _convention_of(root: ElementTree.Element) -> _Convention:
    """
    Return the convention of a file: that in which most vehicles are longest along x.

    The last versions of Datumaro write the extents along x, y and z as ``h``, ``w`` and ``l``, the
    earlier ones, and CVAT, as ``w``, ``h`` and ``l``; KITTI defines ``l``, ``w`` and ``h``.
    Without vehicles, pedestrians are highest along z.

    """
    config = Config()
    longest: dict[str, Counter[str]] = {'vehicle': Counter(), 'pedestrian': Counter()}
    for item in root.findall('tracklets/item'):
        class_name = item.findtext('objectType') or ''
        kind = config.kind(class_name)
        if kind in longest and config.knows_class(class_name):
            sizes = {tag: _number(item, tag) for tag in 'hwl'}
            longest[kind][max(sizes, key=sizes.__getitem__)] += 1
    by_tag = {'l': KITTI_CONVENTION, 'h': DATUMARO, 'w': CVAT}
    votes = longest['vehicle']
    if not votes:
        by_tag = {'h': KITTI_CONVENTION, 'l': DATUMARO}
        votes = longest['pedestrian']
    for tag, count in votes.most_common(1):
        if 2 * count > votes.total():
            return by_tag.get(tag, KITTI_CONVENTION)
    return KITTI_CONVENTION


def _content(root: ElementTree.Element, convention: _Convention, is_own: bool = False) -> _Content:
    """Return the boxes of all tracklets by the index of their frame."""
    items = root.findall('tracklets/item')
    note = ''
    if not is_own and convention.is_centre:
        x, y, z = convention.tags
        note = (
            f'tracklets: read as those of {convention.program}: {x}, {y} and {z} are the extents '
            f'along x, y and z, and the position is the centre; as KITTI defines them, most '
            f'objects would be longest upwards or sideways'
        )
    content = _Content({}, note)
    status_of = _kitti_status
    if not is_own and convention.is_centre:
        poses = [pose for item in items for pose in item.findall('poses/item')]
        status_of = partial(_datumaro_status, any(map(_keyframe, poses)))
    for number, item in enumerate(items):
        with at(f'tracklet {number}'):
            _add(content, item, str(number), convention, status_of)
    return content


def _add(
    content: _Content,
    item: ElementTree.Element,
    name: str,
    convention: _Convention,
    status_of: Callable[[ElementTree.Element], str | None],
) -> None:
    """Add the boxes of a tracklet; `name` is its track id where it states none."""
    track_id = _track_id(item, name)
    class_name = _text(item, 'objectType')
    extent = [_number(item, tag) for tag in convention.tags]
    first_frame = int(_number(item, 'first_frame'))
    for index, pose in enumerate(item.findall('poses/item'), first_frame):
        boxes, left_out = content.frames.setdefault(index, ([], Counter()))
        status = status_of(pose)
        if status is None:
            left_out[Reason.NO_BOX] += 1
            continue
        values = [_number(pose, tag) for tag in POSE_TAGS]
        box = np.array([*values[:3], *extent, *values[3:]])
        if not convention.is_centre:
            box[BOX_CENTER] = _shifted_centres(box[None], extent[2] / 2)[0]
        evidence = {'status': status, 'attributes': _attributes(pose)}
        boxes.append(ReadBox(track_id, class_name, box, evidence))


def _kitti_status(pose: ElementTree.Element) -> str | None:
    """Return the status by ``state``: 0 is not set, 1 interpolated, 2 drawn by a person."""
    is_interpolated = _text(pose, 'state') == str(INTERPOLATED_STATE)
    return INTERPOLATED if is_interpolated else INPUT_STATUS


def _datumaro_status(has_keyframes: bool, pose: ElementTree.Element) -> str | None:
    """
    Return the status by ``occlusion_kf``, or an attribute; None for a pose that fills a gap.

    Datumaro writes the state 2 for all poses. Where a track is interrupted it repeats the last
    pose, marked as outside of the image and without an occlusion.

    """
    is_outside = _text(pose, 'truncation') in OUTSIDE_TRUNCATIONS
    if is_outside and _text(pose, 'occlusion') in UNSET_OCCLUSIONS:
        return None
    is_interpolated = has_keyframes and not _keyframe(pose)
    return INTERPOLATED if is_interpolated else INPUT_STATUS


def _attributes(pose: ElementTree.Element) -> dict[str, str]:
    """Return the attributes of a pose: its flags, and those that Datumaro adds."""
    flags = [_text(pose, tag) for tag in ('truncation', 'occlusion')]
    numbers = [str(NAMED_FLAGS.get(flag.rpartition('.')[2], flag or '-1')) for flag in flags]
    others = attributes_from(_own_attributes(pose), ('keyframe', OCCLUDED, 'track_id', 'outside'))
    return attributes_of(*numbers) | others


def _keyframe(pose: ElementTree.Element) -> bool:
    """Return whether a pose of Datumaro is marked as a keyframe."""
    stated = _own_attributes(pose).get('keyframe')
    return (
        _text(pose, 'occlusion_kf') == '1' if stated is None else stated.strip().lower() == 'true'
    )


def _own_attributes(pose: ElementTree.Element) -> dict[str, str]:
    """Return the attributes that Datumaro adds to a pose, by name."""
    found = pose.findall('attributes/attribute')
    return {one.findtext('name') or '': one.findtext('value') or '' for one in found}


def _track_id(item: ElementTree.Element, default: str) -> str:
    """Return the track id in the comment of a tracklet, or the default."""
    for element in item:
        # The tag of a comment is the function `Comment`, though it is annotated as text.
        is_comment = cast(object, element.tag) is ElementTree.Comment
        text = str(element.text)
        if is_comment and text.startswith(TRACK_COMMENT):
            return _uncomment(text.removeprefix(TRACK_COMMENT))
    return default


def _shifted_centres(boxes: Floats, shift: float) -> Floats:
    """Return the centres (n, 3) of boxes (n, 9), moved along z of the box by `shift` [m]."""
    R = matrix_from_rpy(boxes[:, ROLL:])
    return boxes[:, BOX_CENTER] + shift * R[:, :, 2]


def _text(item: ElementTree.Element, tag: str) -> str:
    """Return the text of a tag; empty without it."""
    return (item.findtext(tag) or '').strip()


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
