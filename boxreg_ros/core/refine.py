"""Whole tracks in, refined tracks out: the core without topics and files."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from boxreg_ros.config import Config
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.errors import ConfigError, ShapeError
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import (
    BoxArray,
    checked,
    Floats,
    INTERPOLATED,
    Ints,
    RefinedBoxes,
    Sweep,
)
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Track:
    """
    One object over time, as arrays in the fixed frame.

    Attributes
    ----------
    track_id, class_name : str
        Identity and category.
    stamps_ns : array, shape (N,)
        Strictly increasing [ns]; datetime64 of any unit as well.
    boxes : array, shape (N, 9)
        Input boxes.
    points : sequence of N arrays, shape (M_i, 3)
        Returns on and around the object [m]; M_i may be 0. Those of all tracks of a stamp make one
        sweep: what several have counts as often.
    sensor_origins : array, shape (N, 3), or None
        Where the sensor was [m]; without it visible faces are told by the points' centre of mass.
    scores : array, shape (N,), or None
        Detector confidence.

    """

    track_id: str
    class_name: str
    stamps_ns: Ints
    boxes: Floats
    points: Sequence[NDArray[np.floating]]
    sensor_origins: Floats | None = None
    scores: Floats | None = None

    def __post_init__(self) -> None:
        """Check shapes and order; convert lists to arrays."""
        given = np.asarray(self.stamps_ns)
        if given.dtype.kind == 'M':  # whatever its unit
            given = given.astype('datetime64[ns]')
        if given.size and given.dtype.kind not in 'iuM':
            raise ShapeError(
                f'stamps_ns of track {self.track_id!r}: expected whole numbers [ns], got '
                f'{given.dtype}; of seconds: (seconds * 1e9).round().astype(int)'
            )
        stamps = given.astype(np.int64)
        if stamps.ndim != 1 or (np.diff(stamps) <= 0).any():
            raise ShapeError(
                f'stamps_ns of track {self.track_id!r}: expected (N,) strictly increasing [ns], '
                f'got shape {stamps.shape}; sort them, and leave repeated ones out'
            )
        if not isinstance(self.class_name, str):
            raise ShapeError(
                f"class_name of track {self.track_id!r}: expected text such as 'car', got "
                f'{self.class_name!r}'
            )
        n = len(stamps)
        object.__setattr__(self, 'stamps_ns', stamps)
        object.__setattr__(self, 'boxes', checked('boxes', self.boxes, (n, 9)))
        if len(self.points) != n:
            raise ShapeError(
                f'points of track {self.track_id!r}: expected {n}, got {len(self.points)}'
            )
        rows = [p if len(p) else np.zeros((0, 3)) for p in self.points]
        points = tuple(checked(f'points[{i}]', p, (None, 3)) for i, p in enumerate(rows))
        object.__setattr__(self, 'points', points)
        for name, shape in (('sensor_origins', (n, 3)), ('scores', (n,))):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, checked(name, value, shape))


@dataclass(frozen=True, slots=True)
class RefinedTrack:
    """
    What `refine` returns for one track, row by row with its input.

    Attributes
    ----------
    track_id : str
        That of the input.
    boxes : array, shape (N, 9)
        Refined boxes, fixed frame.
    status : tuple of N str
        ``refined``, ``kept`` or ``interpolated``.
    reasons : tuple of N str
        Why a box was kept, or had to be put in; empty for those refined.
    covariances : array, shape (N, 6, 6)
        Of x y z roll pitch yaw [m, rad].

    """

    track_id: str
    boxes: Floats
    status: tuple[str, ...]
    reasons: tuple[str, ...]
    covariances: Floats


def refine(tracks: Iterable[Track], config: Config | None = None) -> list[RefinedTrack]:
    """
    Refine whole tracks; the same core, and the same boxes, as node and recordings get.

    Parameters
    ----------
    tracks : iterable of Track
        Objects over time in one fixed frame. Tracks that share a stamp share its sweep and its
        sensor: they are fitted knowing each other's boxes.
    config : Config, optional
        Settings; `estimate` says which of the estimates of a box is returned.

    Returns
    -------
    refined : list of RefinedTrack
        In the order of `tracks`, rows as in the input. Never NaN: a box given with NaN or without
        volume comes back interpolated between its neighbours.

    Raises
    ------
    ShapeError
        If a track has no valid box at all, or two tracks the same id.
    ConfigError
        If `config` is no Config.

    """
    tracks, config = list(tracks), Config() if config is None else config
    if not isinstance(config, Config):
        raise ConfigError(f'config: expected a Config, got {config!r}; see Config.from_dict')
    names = [track.track_id for track in tracks]
    if len(set(names)) < len(names):
        raise ShapeError(f'tracks: expected different track ids, got {sorted(map(str, names))}')
    at: dict[int, list[tuple[int, int]]] = {}
    for index, track in enumerate(tracks):
        for row, stamp_ns in enumerate(track.stamps_ns):
            at.setdefault(int(stamp_ns), []).append((index, row))
    registrar = BoxRegistrar(replace(config, tolerance=0.0))
    results: list[RefinedBoxes] = []
    for stamp_ns, places in sorted(at.items()):
        members = [tracks[index] for index, _ in places]
        origins = [
            track.sensor_origins[row]
            for track, (_, row) in zip(members, places, strict=True)
            if track.sensor_origins is not None and np.isfinite(track.sensor_origins[row]).all()
        ]
        origin = origins[0] if origins else np.full(3, np.nan)
        boxes = np.array([tracks[index].boxes[row] for index, row in places])
        points = np.concatenate([tracks[index].points[row] for index, row in places])
        points = points[np.isfinite(points).all(1)]
        results += registrar.add_sweep(Sweep(stamp_ns, '', points, None, origin))
        ids, classes = [str(index) for index, _ in places], [t.class_name for t in members]
        results += registrar.add_boxes(
            BoxArray(stamp_ns, '', tuple(ids), tuple(classes), np.ones(len(ids)), boxes)
        )
    results += registrar.flush()
    wanted = config.estimate != 'early'
    by_stamp = {r.boxes.stamp_ns: r for r in results if r.is_final == wanted}
    rows: list[list[tuple[RefinedBoxes, int]]] = [[] for _ in tracks]
    for stamp_ns, places in sorted(at.items()):
        for column, (index, _) in enumerate(places):
            rows[index].append((by_stamp[stamp_ns], column))
    return [_refined_track(track, row) for track, row in zip(tracks, rows, strict=True)]


def _refined_track(track: Track, rows: list[tuple[RefinedBoxes, int]]) -> RefinedTrack:
    boxes = np.array([r.boxes.boxes[i] for r, i in rows]).reshape(-1, 9)
    status = [r.status[i] for r, i in rows]
    valid = np.array([r.reasons[i] != 'invalid_box' for r, i in rows], dtype=bool)
    if len(rows) and not valid.any():
        raise ShapeError(f'boxes of track {track.track_id!r}: expected one finite box at least')
    if not valid.all():
        known = boxes[valid]
        known[:, 6:9] = np.unwrap(known[:, 6:9], axis=0)
        when, stamps = track.stamps_ns[~valid], track.stamps_ns[valid]
        between = np.stack([np.interp(when, stamps, column) for column in known.T], 1)
        between[:, 6:9] = wrap_angle(between[:, 6:9])
        boxes[~valid] = between
        status = [s if v else INTERPOLATED for s, v in zip(status, valid, strict=True)]
    return RefinedTrack(
        track.track_id,
        boxes,
        tuple(status),
        tuple(r.reasons[i] for r, i in rows),
        np.array([r.covariances[i] for r, i in rows]).reshape(-1, 6, 6),
    )
