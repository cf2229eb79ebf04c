"""Refinement of whole tracks given as arrays: the API without topics and files."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.latency import Latency
from boxreg_ros.core.method.constants import Constants
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.errors import ConfigError, ShapeError
from boxreg_ros.reasons import Reason
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import (
    BOX_AXES,
    BoxArray,
    checked,
    checked_stamps,
    finite_points,
    Floats,
    HUMAN,
    INTERPOLATED,
    Ints,
    is_valid_box,
    KINEMATICS,
    on_lines,
    RefinedBoxes,
    ROLL,
    Sweep,
)
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """
    One object over time, as arrays in the fixed frame.

    Attributes
    ----------
    track_id, class_name : str
        Identity and category.
    stamps_ns : array, shape (N,)
        Strictly increasing [ns], or datetime64 of any unit.
    boxes : array, shape (N, 9)
        Input boxes in the fixed frame, as `boxreg_ros.structures` defines them [m, rad].
    points : sequence of N arrays, shape (M_i, 3)
        Points on and around the object in the fixed frame [m]; M_i may be 0. The points of all
        tracks at one stamp form one sweep: a point given with two tracks counts twice.
    sensor_origins : array, shape (N, 3), or None
        Positions of the sensor [m]. Where unknown, the visible faces follow from the centre of
        mass of the points.
    scores : array, shape (N,), or None
        Detector confidence.
    pinned : array, shape (N,), or None
        True for boxes that are right as given: they are returned unchanged, and the rest of the
        track follows them. None for none.

    Raises
    ------
    ShapeError
        For an array of the wrong shape or type, or stamps that do not increase or have another
        unit.

    Notes
    -----
    Lists are converted to arrays. Tracks are equal only if they are the same object.

    """

    track_id: str
    class_name: str
    stamps_ns: Ints
    boxes: Floats
    points: Sequence[NDArray[np.floating]]
    sensor_origins: Floats | None = None
    scores: Floats | None = None
    pinned: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        """Check shapes and order; convert lists to arrays."""
        if not isinstance(self.class_name, str):
            raise ShapeError(
                f"class_name of track {self.track_id!r}: expected text such as 'car', got "
                f'{self.class_name!r}'
            )
        of_track = f'of track {self.track_id!r}'
        stamps_ns = checked_stamps(f'stamps_ns {of_track}', self.stamps_ns)
        n = len(stamps_ns)
        self._set('stamps_ns', stamps_ns)
        self._set('boxes', checked(f'boxes {of_track}', self.boxes, (n, 9), BOX_AXES))
        points = tuple(self.points) if isinstance(self.points, Iterable) else ()
        if len(points) != n:
            got = len(points) if isinstance(self.points, Iterable) else repr(self.points)
            raise ShapeError(
                f'points {of_track}: expected {n} arrays, one per stamp, got {got}; the array of '
                f'a stamp without points is empty'
            )
        points = tuple(
            checked(f'points[{i}] {of_track}', array, (None, 3), 'x y z')
            for i, array in enumerate(points)
        )
        self._set('points', points)
        if self.sensor_origins is not None:
            name = f'sensor_origins {of_track}'
            self._set('sensor_origins', checked(name, self.sensor_origins, (n, 3), 'x y z'))
        if self.scores is not None:
            self._set('scores', checked(f'scores {of_track}', self.scores, (n,)))
        if self.pinned is not None:
            self._set('pinned', self._checked_pins(np.asarray(self.pinned), n))

    def _checked_pins(self, pinned: NDArray[np.bool_], n: int) -> NDArray[np.bool_]:
        if pinned.dtype != bool or pinned.shape != (n,):
            raise ShapeError(
                f'pinned of track {self.track_id!r}: expected booleans of shape ({n},), got '
                f'{pinned.dtype} of shape {pinned.shape}'
            )
        rows = np.flatnonzero(pinned & ~is_valid_box(self.boxes))
        if len(rows):
            raise ShapeError(
                f'pinned boxes of track {self.track_id!r}: expected finite numbers and positive '
                f'extents, got {self.boxes[rows[0]].tolist()} in row {rows[0]}; correct it or '
                f'remove its pin'
            )
        return pinned

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)  # the class is frozen


@dataclass(frozen=True, slots=True, eq=False)
class RefinedTrack:
    """
    The refined boxes of one track, row by row with its input.

    Attributes
    ----------
    track_id : str
        As in the input.
    boxes : array, shape (N, 9)
        Refined boxes in the fixed frame [m, rad].
    status : tuple of N str
        ``refined``, ``kept`` (the input box, unchanged), ``interpolated`` (invalid input box) or
        ``human`` (a pinned box, unchanged).
    reasons : tuple of N str
        Why a box was kept or interpolated; empty for refined boxes.
    covariances : array, shape (N, 6, 6)
        Of x y z roll pitch yaw [m, rad].
    extent_covariances : array, shape (N, 3, 3)
        Of length, width and height [m].
    kinematics : array, shape (N,)
        Velocities and accelerations with covariances, records `structures.KINEMATICS`.

    """

    track_id: str
    boxes: Floats
    status: tuple[str, ...]
    reasons: tuple[str, ...]
    covariances: Floats
    extent_covariances: Floats
    kinematics: NDArray[np.void]


class _Place(NamedTuple):
    """An observation: index of its track, and its row in the track."""

    track: int
    row: int


def refine(tracks: Iterable[Track], config: Config | None = None) -> list[RefinedTrack]:
    """
    Refine whole tracks by the core that the node and `boxreg relabel` use.

    Parameters
    ----------
    tracks : iterable of Track
        Objects over time in one fixed frame. Tracks that share a stamp share its sweep and its
        sensor position: a point belongs to the box it is deepest inside of.
    config : Config, optional
        Settings; `estimate` selects which estimate of a box is returned.

    Returns
    -------
    refined : list of RefinedTrack
        In the order of `tracks`, rows as in the input. Never NaN: an invalid input box is
        replaced by one interpolated between its neighbours.

    Raises
    ------
    ShapeError
        If `tracks` are no `Track`, one has no valid box, or two have the same id.
    ConfigError
        If `config` is no Config.

    """
    tracks = list(tracks)
    for track in tracks:
        if not isinstance(track, Track):
            raise ShapeError(f'tracks: expected objects of class Track, got {type(track)}')
    if config is None:
        config = Config()
    if not isinstance(config, Config):
        raise ConfigError(f'config: expected a Config, got {config!r}; see Config.from_dict')
    return [
        _with_pins(track, refined)
        for track, refined in zip(tracks, refined_tracks(tracks, config), strict=True)
    ]


def refined_tracks(
    tracks: Sequence[Track], config: Config, constants: Constants | None = None
) -> list[RefinedTrack]:
    """
    Refine tracks as `refine`, but pinned boxes as well.

    Parameters
    ----------
    tracks : sequence of Track
        As of `refine`, all of class Track.
    config : Config
        Settings.
    constants : Constants, optional
        As of `BoxRegistrar`.

    Returns
    -------
    refined : list of RefinedTrack
        In the order of `tracks`, rows as in the input.

    Raises
    ------
    ShapeError
        If one has no valid box, or two have the same id.

    """
    names = [track.track_id for track in tracks]
    if len(set(names)) < len(names):
        raise ShapeError(f'tracks: expected different track ids, got {sorted(map(str, names))}')
    places: dict[int, list[_Place]] = {}  # by stamp
    for index, track in enumerate(tracks):
        for row, stamp_ns in enumerate(track.stamps_ns.tolist()):
            places.setdefault(stamp_ns, []).append(_Place(index, row))

    registrar = BoxRegistrar(
        replace(config, reach=0.0),
        has_whole_sweeps=False,
        constants=constants,
        latency=Latency(),  # points are given per box, of its own time
    )
    results: list[RefinedBoxes] = []
    for stamp_ns in sorted(places):
        results += registrar.add_sweep(_sweep(stamp_ns, tracks, places[stamp_ns]))
        results += registrar.add_boxes(_box_array(stamp_ns, tracks, places[stamp_ns]))
    results += registrar.flush()

    is_final = config.estimate != 'early'
    by_stamp = {r.boxes.stamp_ns: r for r in results if r.is_final == is_final}
    rows: list[list[tuple[RefinedBoxes, int]]] = [[] for _ in tracks]
    for stamp_ns in sorted(places):
        for column, place in enumerate(places[stamp_ns]):
            rows[place.track].append((by_stamp[stamp_ns], column))
    return [_refined_track(track, row) for track, row in zip(tracks, rows, strict=True)]


def _sweep(stamp_ns: int, tracks: Sequence[Track], places: Sequence[_Place]) -> Sweep:
    """Return the points of all tracks of a stamp as one sweep; its origin is the first known."""
    origin = np.full(3, np.nan)
    for index, row in reversed(places):
        origins = tracks[index].sensor_origins
        if origins is not None and np.isfinite(origins[row]).all():
            origin = origins[row]
    points = np.concatenate([tracks[index].points[row] for index, row in places])
    return Sweep(stamp_ns, '', finite_points(points), None, origin)


def _box_array(stamp_ns: int, tracks: Sequence[Track], places: Sequence[_Place]) -> BoxArray:
    """Return the boxes of all tracks of a stamp; their ids are the indices of the tracks."""
    return BoxArray(
        stamp_ns,
        '',
        tuple(str(place.track) for place in places),
        tuple(tracks[place.track].class_name for place in places),
        np.ones(len(places)),
        np.array([tracks[index].boxes[row] for index, row in places]),
        pinned=np.array([_is_pinned(tracks[index], row) for index, row in places]),
    )


def _is_pinned(track: Track, row: int) -> bool:
    return track.pinned is not None and bool(track.pinned[row])


def _refined_track(track: Track, rows: list[tuple[RefinedBoxes, int]]) -> RefinedTrack:
    """Collect the rows of a track; interpolate boxes whose input was invalid."""
    boxes = np.array([result.boxes.boxes[i] for result, i in rows]).reshape(-1, 9)
    status = [result.status[i] for result, i in rows]
    reasons = [result.reasons[i] for result, i in rows]
    covariances = np.array([result.covariances[i] for result, i in rows]).reshape(-1, 6, 6)
    extents = np.array([result.extent_covariances[i] for result, i in rows]).reshape(-1, 3, 3)
    kinematics = np.zeros(len(rows), KINEMATICS)
    for place, (result, i) in enumerate(rows):
        kinematics[place] = result.boxes.known_kinematics[i]
    is_valid = np.array([reason != Reason.INVALID_BOX for reason in reasons], dtype=bool)
    if rows and not is_valid.any():
        raise ShapeError(
            f'boxes of track {track.track_id!r}: expected one finite box with positive extents at '
            'least, got none; remove the track'
        )
    if not is_valid.all():
        stamps_ns = track.stamps_ns
        boxes[~is_valid] = _interpolated(
            stamps_ns[is_valid], boxes[is_valid], stamps_ns[~is_valid]
        )
        for row in np.flatnonzero(~is_valid):
            status[row] = INTERPOLATED
    columns = tuple(status), tuple(reasons), covariances, extents, kinematics
    return RefinedTrack(track.track_id, boxes, *columns)


def _with_pins(track: Track, refined: RefinedTrack) -> RefinedTrack:
    """Return a refined track with the pinned boxes as they were given."""
    if track.pinned is None:
        return refined
    status = np.where(track.pinned, HUMAN, refined.status).tolist()
    reasons = np.where(track.pinned, '', refined.reasons).tolist()
    boxes = np.where(track.pinned[:, None], track.boxes, refined.boxes)
    return replace(refined, boxes=boxes, status=tuple(status), reasons=tuple(reasons))


def _interpolated(stamps_ns: Ints, boxes: Floats, wanted_ns: Ints) -> Floats:
    """Return `boxes` (N, 9) of `stamps_ns` (N,) interpolated linearly at `wanted_ns`."""
    unwrapped = boxes.copy()
    unwrapped[:, ROLL:] = np.unwrap(boxes[:, ROLL:], axis=0)
    found = on_lines(stamps_ns, unwrapped, wanted_ns)
    found[:, ROLL:] = wrap_angle(found[:, ROLL:])
    return found
