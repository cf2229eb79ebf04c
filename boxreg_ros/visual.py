"""Markers of input and refined boxes, for RViz and Foxglove."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count

from boxreg_ros.structures import BoxArray, Floats, HEIGHT, LENGTH, REFINED, RefinedBoxes, X, Z
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
from msg_adapters.poses import quaternions_of
import numpy as np
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

GREY = ColorRGBA(r=0.7, g=0.7, b=0.7, a=0.25)
GREEN = ColorRGBA(r=0.1, g=0.8, b=0.3, a=0.45)
ORANGE = ColorRGBA(r=1.0, g=0.6, b=0.1, a=0.45)
BLUE = ColorRGBA(r=0.2, g=0.5, b=1.0, a=0.6)
WHITE = ColorRGBA(r=1.0, g=1.0, b=1.0, a=1.0)
NAMESPACES = ('input', 'refined', 'heading', 'id', 'covariance')
DEVIATIONS = 2.0  # that the ellipse of a covariance reaches out to


class MarkerBoard:
    """
    Turns boxes into markers, knowing which ones are shown.

    A track keeps its marker number while it is seen, so that it moves instead of flickering;
    markers of tracks that are gone are deleted, and at first those that an earlier node may have
    left. Not thread-safe.

    """

    def __init__(self) -> None:
        self._is_new = True
        self._shown: dict[str, int] = {}
        self._numbers = count()

    def update(self, given: BoxArray, refined: RefinedBoxes) -> MarkerArray:
        """
        Return the markers that bring what is shown up to date.

        Parameters
        ----------
        given, refined : BoxArray, RefinedBoxes
            The same boxes before and after, in one frame. Boxes that are not finite are not
            shown. Green is refined, orange kept as it was; grey is the input. The blue ellipse
            is the covariance of x and y of a refined box, 2 standard deviations.

        """
        sec, nanosec = divmod(given.stamp_ns, 10**9)
        header = Header(stamp=Time(sec=sec, nanosec=nanosec), frame_id=given.frame_id)
        before = quaternions_of(given.boxes)
        after = quaternions_of(refined.boxes.boxes)
        markers = self.clear().markers if self._is_new else []
        self._is_new = False
        was_shown, self._shown = self._shown, {}
        for i, track_id in enumerate(given.track_ids):
            key = track_id if track_id and track_id not in self._shown else f'{track_id}#{i}'
            box = refined.boxes.boxes[i]
            if not np.isfinite([*box, *given.boxes[i]]).all():
                continue
            self._shown[key] = number = was_shown[key] if key in was_shown else self._number()
            is_refined = refined.status[i] == REFINED
            colour = GREEN if is_refined else ORANGE
            spread = refined.covariances[i, :2, :2] if is_refined else np.zeros((2, 2))
            markers += [
                _cube(header, 'input', number, given.boxes[i], before[i], GREY),
                _cube(header, 'refined', number, box, after[i], colour),
                _arrow(header, number, box, after[i]),
                _text(header, number, box, track_id),
                _ellipse(header, number, box, spread),
            ]
        gone = [number for key, number in was_shown.items() if key not in self._shown]
        markers += [
            Marker(header=header, ns=ns, id=number, action=Marker.DELETE)
            for number in gone
            for ns in NAMESPACES
        ]
        return MarkerArray(markers=markers)

    def clear(self) -> MarkerArray:
        """Return what removes all markers."""
        self._shown = {}
        return MarkerArray(markers=[Marker(action=Marker.DELETEALL)])

    def _number(self) -> int:
        return next(self._numbers) % 2**31


def _cube(
    header: Header, ns: str, number: int, box: Floats, quaternion_xyzw: Floats, colour: ColorRGBA
) -> Marker:
    length, width, height = _plain(box[LENGTH : HEIGHT + 1])
    return Marker(
        header=header, ns=ns, id=number, type=Marker.CUBE, action=Marker.ADD,
        pose=_pose(box[X : Z + 1], quaternion_xyzw),
        scale=Vector3(x=length, y=width, z=height), color=colour,
    )  # fmt: skip


def _arrow(header: Header, number: int, box: Floats, quaternion_xyzw: Floats) -> Marker:
    """Return an arrow from the centre along the heading, beyond the front."""
    return Marker(
        header=header, ns='heading', id=number, type=Marker.ARROW, action=Marker.ADD,
        pose=_pose(box[X : Z + 1], quaternion_xyzw),
        scale=Vector3(x=0.8 * float(box[LENGTH]), y=0.15, z=0.15), color=WHITE,
    )  # fmt: skip


def _ellipse(header: Header, number: int, box: Floats, spread: Floats) -> Marker:
    """Return the covariance (2, 2) of x and y as a disc on the roof; a dot where it is zero."""
    variances, axes = np.linalg.eigh(spread)
    across, along = _plain(2 * DEVIATIONS * np.sqrt(variances.clip(0)) + 1e-3)
    half = 0.5 * np.arctan2(axes[1, 1], axes[0, 1])  # eigenvalues ascend
    above = box[X : Z + 1].copy()
    above[Z] += 0.5 * box[HEIGHT]
    return Marker(
        header=header, ns='covariance', id=number, type=Marker.SPHERE, action=Marker.ADD,
        pose=_pose(above, np.array([0.0, 0.0, np.sin(half), np.cos(half)])),
        scale=Vector3(x=along, y=across, z=0.02), color=BLUE,
    )  # fmt: skip


def _text(header: Header, number: int, box: Floats, text: str) -> Marker:
    above = box[X : Z + 1].copy()
    above[Z] += 0.5 * box[HEIGHT] + 0.5
    return Marker(
        header=header, ns='id', id=number, type=Marker.TEXT_VIEW_FACING, action=Marker.ADD,
        pose=_pose(above, np.array([0.0, 0.0, 0.0, 1.0])), scale=Vector3(z=0.8), color=WHITE,
        text=text,
    )  # fmt: skip


def _pose(position: Floats, quaternion_xyzw: Floats) -> Pose:
    x, y, z = _plain(position)
    qx, qy, qz, qw = _plain(quaternion_xyzw)
    return Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))


def _plain(values: Floats) -> Iterator[float]:
    """Yield plain floats: messages take no others."""
    return map(float, values)
