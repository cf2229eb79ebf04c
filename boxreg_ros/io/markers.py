"""Markers of input and refined boxes, for RViz and Foxglove."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from types import SimpleNamespace
from typing import Any

from boxreg_ros.structures import (
    BoxArray,
    COASTED,
    Floats,
    HEIGHT,
    is_valid_box,
    LENGTH,
    REFINED,
    RefinedBoxes,
    X,
    Z,
)
from msg_adapters.poses import quaternions_of
import numpy as np

Colour = tuple[float, float, float, float]
TRANSLUCENT_GREY: Colour = (0.7, 0.7, 0.7, 0.25)
GREEN = (0.1, 0.8, 0.3, 0.45)
ORANGE = (1.0, 0.6, 0.1, 0.45)
BLUE = (0.2, 0.5, 1.0, 0.6)
VIOLET = (0.6, 0.3, 0.9, 0.45)
WHITE = (1.0, 1.0, 1.0, 1.0)
RED = (0.9, 0.1, 0.1, 1.0)
COLOURS = {REFINED: GREEN, COASTED: VIOLET}
"""By status; kept boxes are orange."""
BOX_NAMESPACES = ('input', 'refined', 'heading', 'id', 'covariance')
RECORDING = 'recording'
NAMESPACES = (*BOX_NAMESPACES, RECORDING)
DEVIATIONS = 2.0  # that the ellipse of a covariance reaches out to
TEXT_HEIGHT = 3.0
"""Height of the state of the recording above the sensor [m]; chosen."""
ARROW, CUBE, SPHERE, TEXT = 0, 1, 2, 9
ADD, DELETE, DELETEALL = 0, 2, 3


class MarkerBoard:
    """
    Turns boxes into markers, knowing which ones are shown.

    A track keeps its marker number while it is seen, so that it moves instead of flickering;
    markers of tracks that are gone are deleted, and at first those that an earlier node may have
    left. Not thread-safe.

    Parameters
    ----------
    messages : object, optional
        Has the classes of the messages as attributes; without it those of ROS are imported.

    """

    def __init__(self, messages: Any = None) -> None:
        self._messages = messages or ros_messages()
        self._is_new = True
        self._shown: dict[str, int] = {}
        self._numbers = count()

    @property
    def is_showing(self) -> bool:
        """Return whether boxes are shown."""
        return bool(self._shown)

    def update(self, given: BoxArray, refined: RefinedBoxes) -> Any:
        """
        Return the markers that bring what is shown up to date.

        Parameters
        ----------
        given, refined : BoxArray, RefinedBoxes
            The same boxes before and after, in one frame; coasted boxes stand behind those of
            the input. Boxes that are not finite, or have no volume, are not shown. Green is
            refined, violet coasted, orange is kept; grey is the input. The blue ellipse is the
            covariance of x and y of a refined box, 2 standard deviations.

        """
        m = self._messages
        sec, nanosec = divmod(given.stamp_ns, 10**9)
        header = m.Header(stamp=m.Time(sec=sec, nanosec=nanosec), frame_id=given.frame_id)
        before = quaternions_of(given.boxes)
        after = quaternions_of(refined.boxes.boxes)
        markers: list[Any] = list(self.clear().markers) if self._is_new else []
        self._is_new = False
        was_shown, self._shown = self._shown, {}
        for i, track_id in enumerate(refined.boxes.track_ids):
            key = track_id if track_id and track_id not in self._shown else f'{track_id}#{i}'
            box = refined.boxes.boxes[i]
            is_given = i < len(given.track_ids)
            if not (is_valid_box(box) and (not is_given or is_valid_box(given.boxes[i]))):
                continue
            self._shown[key] = number = was_shown[key] if key in was_shown else self._number()
            colour = COLOURS.get(refined.status[i], ORANGE)
            is_refined = colour is not ORANGE
            spread = refined.covariances[i, :2, :2] if is_refined else np.zeros((2, 2))
            grey = m.Marker(header=header, ns='input', id=number, action=DELETE)
            if is_given:
                grey = _cube(
                    m, header, 'input', number, given.boxes[i], before[i], TRANSLUCENT_GREY
                )
            markers += [
                grey,
                _cube(m, header, 'refined', number, box, after[i], colour),
                _arrow(m, header, number, box, after[i]),
                _text(m, header, number, box, track_id),
                _ellipse(m, header, number, box, spread),
            ]
        gone = [number for key, number in was_shown.items() if key not in self._shown]
        markers += [
            m.Marker(header=header, ns=ns, id=number, action=DELETE)
            for number in gone
            for ns in BOX_NAMESPACES
        ]
        return m.MarkerArray(markers=markers)

    def clear(self) -> Any:
        """Return the markers that remove all others."""
        self._shown = {}
        m = self._messages
        return m.MarkerArray(markers=[m.Marker(action=DELETEALL)])

    def _number(self) -> int:
        return next(self._numbers) % 2**31


def _cube(
    m: Any, header: Any, ns: str, number: int, box: Floats, quaternion_xyzw: Floats, colour: Colour
) -> Any:
    length, width, height = _plain(box[LENGTH : HEIGHT + 1])
    return m.Marker(
        header=header, ns=ns, id=number, type=CUBE, action=ADD,
        pose=_pose(m, box[X : Z + 1], quaternion_xyzw),
        scale=m.Vector3(x=length, y=width, z=height), color=_colour(m, colour),
    )  # fmt: skip


def _arrow(m: Any, header: Any, number: int, box: Floats, quaternion_xyzw: Floats) -> Any:
    """Return an arrow from the centre along the heading, beyond the front."""
    return m.Marker(
        header=header, ns='heading', id=number, type=ARROW, action=ADD,
        pose=_pose(m, box[X : Z + 1], quaternion_xyzw),
        scale=m.Vector3(x=0.8 * float(box[LENGTH]), y=0.15, z=0.15), color=_colour(m, WHITE),
    )  # fmt: skip


def _ellipse(m: Any, header: Any, number: int, box: Floats, spread: Floats) -> Any:
    """Return the covariance (2, 2) of x and y as a disc on the roof; a dot where it is zero."""
    variances, axes = np.linalg.eigh(spread)
    across, along = _plain(2 * DEVIATIONS * np.sqrt(variances.clip(0)) + 1e-3)
    half = 0.5 * np.arctan2(axes[1, 1], axes[0, 1])  # eigenvalues ascend
    above = box[X : Z + 1].copy()
    above[Z] += 0.5 * box[HEIGHT]
    return m.Marker(
        header=header, ns='covariance', id=number, type=SPHERE, action=ADD,
        pose=_pose(m, above, np.array([0.0, 0.0, np.sin(half), np.cos(half)])),
        scale=m.Vector3(x=along, y=across, z=0.02), color=_colour(m, BLUE),
    )  # fmt: skip


def _text(m: Any, header: Any, number: int, box: Floats, text: str) -> Any:
    above = box[X : Z + 1].copy()
    above[Z] += 0.5 * box[HEIGHT] + 0.5
    return m.Marker(
        header=header, ns='id', id=number, type=TEXT, action=ADD,
        pose=_pose(m, above, np.array([0.0, 0.0, 0.0, 1.0])), scale=m.Vector3(z=0.8),
        color=_colour(m, WHITE), text=text,
    )  # fmt: skip


def _pose(m: Any, position: Floats, quaternion_xyzw: Floats) -> Any:
    x, y, z = _plain(position)
    qx, qy, qz, qw = _plain(quaternion_xyzw)
    return m.Pose(
        position=m.Point(x=x, y=y, z=z), orientation=m.Quaternion(x=qx, y=qy, z=qz, w=qw)
    )


def text_marker(frame_id: str, text: str, is_error: bool) -> Any:
    """Return the state of the recording as text above the sensor; an empty text deletes it."""
    m = ros_messages()
    above = np.array([0.0, 0.0, TEXT_HEIGHT])
    marker = m.Marker(
        header=m.Header(frame_id=frame_id),
        ns=RECORDING, type=TEXT, action=ADD if text else DELETE,
        pose=_pose(m, above, np.array([0.0, 0.0, 0.0, 1.0])), scale=m.Vector3(z=0.8),
        color=_colour(m, RED if is_error else WHITE), text=text, frame_locked=True,
    )  # fmt: skip
    return m.MarkerArray(markers=[marker])


def _plain(values: Floats) -> Iterator[float]:
    """Yield plain floats: messages take no others."""
    return map(float, values)


def _colour(m: Any, rgba: Colour) -> Any:
    return m.ColorRGBA(**dict(zip('rgba', rgba, strict=True)))


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
