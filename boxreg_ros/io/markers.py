"""Markers of input and refined boxes, for RViz and Foxglove."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import count
from types import SimpleNamespace
from typing import Any, NamedTuple

from boxreg_ros.reasons import Reason
from boxreg_ros.structures import (
    BOX_CENTER,
    BOX_EXTENT,
    BoxArray,
    COASTED,
    Floats,
    HEIGHT,
    is_valid_box,
    LENGTH,
    REFINED,
    RefinedBoxes,
)
from msg_adapters.poses import quaternions_of
import numpy as np

Colour = tuple[float, float, float, float]
TRANSLUCENT_GREY: Colour = (0.7, 0.7, 0.7, 0.25)
GREEN = (0.1, 0.8, 0.3, 0.45)
ORANGE = (1.0, 0.6, 0.1, 0.45)
YELLOW = (1.0, 0.95, 0.2, 0.45)
CYAN = (0.1, 0.8, 1.0, 1.0)
BLUE = (0.2, 0.5, 1.0, 0.6)
VIOLET = (0.6, 0.3, 0.9, 0.45)
WHITE = (1.0, 1.0, 1.0, 1.0)
COLOURS = {REFINED: GREEN, COASTED: VIOLET}
"""By status; kept boxes are orange, or yellow where there was no time for them."""
BOX_NAMESPACES = ('input', 'refined', 'heading', 'id', 'covariance')
FINAL = 'final'
NAMESPACES = (*BOX_NAMESPACES, FINAL)
ELLIPSE_DEVIATIONS = 2.0  # that the ellipse of a covariance reaches out to
ARROW, CUBE, SPHERE, LINE_STRIP, TEXT = 0, 1, 2, 4, 9
OUTLINE = ((1, 1), (1, -1), (-1, -1), (-1, 1), (1, 1))
"""Signs of x and y along the outline of a face."""
ADD, DELETE, DELETEALL = 0, 2, 3
UPRIGHT = (0.0, 0.0, 0.0, 1.0)


class _Shown:
    """
    Tracks that are shown in some namespaces, each with the number of its markers.

    `gone` are the numbers of the tracks that the last call of `replace` has removed.

    """

    def __init__(self, numbers: Iterator[int]) -> None:
        self.gone: list[int] = []
        self._new_numbers = numbers
        self._numbers: dict[str, int] = {}

    def __bool__(self) -> bool:
        return bool(self._numbers)

    def replace(self, track_ids: Sequence[str], rows: Sequence[int]) -> list[tuple[int, int]]:
        """Show `rows` of boxes with track ids instead; return each row with its number."""
        before, self._numbers = self._numbers, {}
        numbered = []
        for row in rows:
            key = track_ids[row]
            if not key or key in self._numbers:
                key = f'{key}#{row}'
            number = before[key] if key in before else next(self._new_numbers) % 2**31
            self._numbers[key] = number
            numbered.append((row, number))
        self.gone = [number for key, number in before.items() if key not in self._numbers]
        return numbered

    def clear(self) -> None:
        """Show nothing."""
        self._numbers = {}


class MarkerBoard:
    """
    Turns boxes into markers, knowing which ones are shown.

    A track keeps its marker number while it is seen, so that it moves instead of flickering;
    markers of tracks that are gone are deleted, and at first those that an earlier node may have
    left. `messages` has the classes of the messages, by default those of ROS. Not thread-safe.

    """

    def __init__(self, messages: Any = None) -> None:
        self._messages = messages or ros_messages()
        self._is_new = True
        numbers = count()
        self._shown = _Shown(numbers)
        self._shown_finals = _Shown(numbers)

    @property
    def is_showing(self) -> bool:
        """Return whether boxes are shown."""
        return bool(self._shown) or bool(self._shown_finals)

    def update(self, given: BoxArray, refined: RefinedBoxes) -> Any:
        """
        Return the markers that bring what is shown of early boxes up to date.

        Green is refined, violet coasted, orange is kept, yellow is kept because there was no time;
        grey is the input. The blue ellipse is the covariance of x and y of a refined box, 2
        standard deviations.

        Parameters
        ----------
        given : BoxArray
            The input.
        refined : RefinedBoxes
            Its result, in the same frame; coasted boxes stand behind those of the input. Boxes
            that are not finite, or have no volume, are not shown.

        Returns
        -------
        visualization_msgs/MarkerArray
            In the frame and with the stamp of `given`, with the deletion of those that are gone.

        """
        m = self._messages
        header = self._header_of(given)
        before = quaternions_of(given.boxes)
        after = quaternions_of(refined.boxes.boxes)
        markers: list[Any] = list(self.clear().markers) if self._is_new else []
        self._is_new = False
        is_shown = is_valid_box(refined.boxes.boxes)
        is_shown[: len(before)] &= is_valid_box(given.boxes)
        rows = np.flatnonzero(is_shown).tolist()
        for i, number in self._shown.replace(refined.boxes.track_ids, rows):
            box = refined.boxes.boxes[i]
            is_given = i < len(before)
            is_refined = refined.status[i] in COLOURS
            colour = COLOURS.get(refined.status[i], ORANGE)
            if refined.reasons[i] == Reason.BUDGET:
                colour = YELLOW
            spread = refined.covariances[i, :2, :2] if is_refined else np.zeros((2, 2))
            shapes = {
                'input': _cube(given.boxes[i], before[i], TRANSLUCENT_GREY) if is_given else None,
                'refined': _cube(box, after[i], colour),
                'heading': _arrow(box, after[i]),
                'id': _text(box, refined.boxes.track_ids[i]),
                'covariance': _ellipse(box, spread),
            }
            markers += [_marker(m, header, ns, number, shape) for ns, shape in shapes.items()]
        markers += [
            _marker(m, header, ns, number, None)
            for number in self._shown.gone
            for ns in BOX_NAMESPACES
        ]
        return m.MarkerArray(markers=markers)

    def update_finals(self, refined: RefinedBoxes) -> Any:
        """Return the markers that bring the outlines of final boxes up to date."""
        m = self._messages
        boxes = refined.boxes
        header = self._header_of(boxes)
        quaternions_xyzw = quaternions_of(boxes.boxes)
        rows = np.flatnonzero(is_valid_box(boxes.boxes)).tolist()
        markers = [
            _marker(m, header, FINAL, number, _outline(boxes.boxes[i], quaternions_xyzw[i]))
            for i, number in self._shown_finals.replace(boxes.track_ids, rows)
        ]
        markers += [_marker(m, header, FINAL, number, None) for number in self._shown_finals.gone]
        return m.MarkerArray(markers=markers)

    def clear(self) -> Any:
        """Return the markers that remove all others."""
        self._shown.clear()
        self._shown_finals.clear()
        m = self._messages
        return m.MarkerArray(markers=[m.Marker(action=DELETEALL)])

    def _header_of(self, boxes: BoxArray) -> Any:
        sec, nanosec = divmod(boxes.stamp_ns, 10**9)
        m = self._messages
        return m.Header(stamp=m.Time(sec=sec, nanosec=nanosec), frame_id=boxes.frame_id)


class Shape(NamedTuple):
    """What a marker shows."""

    kind: int
    position: Floats
    quaternion_xyzw: Iterable[float]
    scale: Iterable[float]
    colour: Colour
    points: Sequence[tuple[float, float, float]] = ()
    text: str = ''


def _cube(box: Floats, quaternion_xyzw: Floats, colour: Colour) -> Shape:
    return Shape(CUBE, box[BOX_CENTER], quaternion_xyzw, box[BOX_EXTENT], colour)


def _outline(box: Floats, quaternion_xyzw: Floats) -> Shape:
    """Return the outline of the bottom face: it hides no colour of the box above it."""
    length, width, height = map(float, box[BOX_EXTENT])
    points = [(x * length / 2, y * width / 2, -height / 2) for x, y in OUTLINE]
    return Shape(LINE_STRIP, box[BOX_CENTER], quaternion_xyzw, (0.1, 0, 0), CYAN, points)


def _arrow(box: Floats, quaternion_xyzw: Floats) -> Shape:
    """Return an arrow from the centre along the heading, beyond the front."""
    scale = (0.8 * box[LENGTH], 0.15, 0.15)
    return Shape(ARROW, box[BOX_CENTER], quaternion_xyzw, scale, WHITE)


def _ellipse(box: Floats, spread: Floats) -> Shape:
    """Return the covariance (2, 2) of x and y as a disc on the roof; a dot where it is zero."""
    variances, axes = np.linalg.eigh(spread)
    across, along = 2 * ELLIPSE_DEVIATIONS * np.sqrt(variances.clip(0)) + 1e-3
    half = 0.5 * np.arctan2(axes[1, 1], axes[0, 1])  # eigenvalues ascend
    above = box[BOX_CENTER] + [0, 0, 0.5 * box[HEIGHT]]
    return Shape(SPHERE, above, (0, 0, np.sin(half), np.cos(half)), (along, across, 0.02), BLUE)


def _text(box: Floats, text: str) -> Shape:
    above = box[BOX_CENTER] + [0, 0, 0.5 * box[HEIGHT] + 0.5]
    return Shape(TEXT, above, UPRIGHT, (0, 0, 0.8), WHITE, text=text)


def _marker(m: Any, header: Any, ns: str, number: int, shape: Shape | None) -> Any:
    """Return the marker of a shape, or the one that deletes it; messages take plain floats."""
    if shape is None:
        return m.Marker(header=header, ns=ns, id=number, action=DELETE)
    turn = dict(zip('xyzw', map(float, shape.quaternion_xyzw), strict=True))
    pose = m.Pose(position=m.Point(**_xyz(shape.position)), orientation=m.Quaternion(**turn))
    return m.Marker(
        header=header, ns=ns, id=number, type=shape.kind, action=ADD, pose=pose,
        scale=m.Vector3(**_xyz(shape.scale)),
        color=m.ColorRGBA(**dict(zip('rgba', shape.colour, strict=True))),
        points=[m.Point(**_xyz(point)) for point in shape.points], text=shape.text,
    )  # fmt: skip


def _xyz(values: Iterable[float]) -> dict[str, float]:
    return dict(zip('xyz', map(float, values), strict=True))


def ros_messages() -> SimpleNamespace:
    """Return the classes that markers are made of, as ROS has them."""
    from builtin_interfaces.msg import Time
    from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
    from std_msgs.msg import ColorRGBA, Header
    from visualization_msgs.msg import Marker, MarkerArray

    return SimpleNamespace(
        ColorRGBA=ColorRGBA, Header=Header, Marker=Marker, MarkerArray=MarkerArray, Point=Point,
        Pose=Pose, Quaternion=Quaternion, Time=Time, Vector3=Vector3,
    )  # fmt: skip
