"""Whole tracks in, refined tracks out: the core without topics and files."""

from collections.abc import Sequence
from dataclasses import replace

from boxreg_ros.config import Config
from boxreg_ros.errors import ShapeError
from boxreg_ros.registrar import BoxRegistrar
from boxreg_ros.structures import (
    BoxArray,
    INTERPOLATED,
    RefinedBoxes,
    RefinedTrack,
    Sweep,
    Track,
)
import numpy as np


def refine(tracks: Sequence[Track], config: Config | None = None) -> list[RefinedTrack]:
    """
    Refine whole tracks; the same core, and the same boxes, as node and recordings get.

    Parameters
    ----------
    tracks : sequence of Track
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

    """
    config = config or Config()
    names = [track.track_id for track in tracks]
    if len(set(names)) < len(names):
        raise ShapeError(f'tracks: expected different track ids, got {sorted(names)}')
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
            if track.sensor_origins is not None
        ]
        origin = origins[0] if origins else np.full(3, np.nan)
        boxes = np.array([tracks[index].boxes[row] for index, row in places])
        points = np.concatenate([tracks[index].points[row] for index, row in places])
        points = points[np.isfinite(points).all(1)]
        results += registrar.add_sweep(Sweep(stamp_ns, '', points, None, origin))
        ids, classes = [t.track_id or '?' for t in members], [t.class_name for t in members]
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
        between[:, 6:9] = np.arctan2(np.sin(between[:, 6:9]), np.cos(between[:, 6:9]))
        boxes[~valid] = between
        status = [s if v else INTERPOLATED for s, v in zip(status, valid, strict=True)]
    return RefinedTrack(
        track.track_id,
        boxes,
        tuple(status),
        tuple(r.reasons[i] for r, i in rows),
        np.array([r.covariances[i] for r, i in rows]).reshape(-1, 6, 6),
    )
