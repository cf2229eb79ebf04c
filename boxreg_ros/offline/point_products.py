"""
Labels of points, and clouds without what moves.

The boxes of all tracks are known by then. Each stored sweep is labelled, in the order of reading;
formats of points, the accumulated map and the objects are written from it.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

from boxreg_ros.core.method.labelling import MOVING
from boxreg_ros.core.method.voxels import add_new, FREE
from boxreg_ros.core.point_labels import (
    ObjectTrack,
    PointLabeller,
    PointLabels,
    UNKNOWN,
)
from boxreg_ros.io.fixed_frame import StoredCloud
from boxreg_ros.labels import LabelFrame, LabelWriter, Options, Provenance, writer_for
from boxreg_ros.labels.clouds import write_cloud
from boxreg_ros.labels.records import ReadBox, refined_of
from boxreg_ros.offline.labelled_sweep import is_kept, LabelledSweep
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.stored_sweeps import StoredSweeps
from boxreg_ros.review.changes import TrackChanges
from boxreg_ros.structures import (
    FLOAT32_RANGE,
    Floats,
    HUMAN,
    Ints,
    KEPT,
    REFINED,
    REJECTED,
)
import numpy as np
from numpy.typing import NDArray

CLOUDS_FOLDER = 'clouds'
MAX_NAME = 200
"""Longest name of a file of an object [bytes]; derived: file systems take 255."""
MAP_VOXEL, OBJECT_VOXEL = 0.1, 0.02
"""Edges of the voxels of the map and of objects, one point each [m]; chosen."""
AXIS_BITS = 21
"""Of the number of a voxel, per axis: 210 km in a map, 42 km in an object."""
FIRST_ENTRIES = 2**10
"""Entries of the first table of known voxels; at most half of them are used."""
RECENT_SWEEPS = 4
"""Sweeps whose labels are kept: the clouds of several LiDARs are not in the order of sweeps."""


def object_tracks(tracks: Sequence[TrackChanges]) -> list[ObjectTrack]:
    """Return tracks as the labeller takes them: without rejected and invalid boxes."""
    found = []
    for track in tracks:
        is_used = np.isfinite(track.boxes).all(axis=1) & (track.status != REJECTED)
        stamps_ns, first = np.unique(track.stamps_ns[is_used], return_index=True)
        if not len(stamps_ns):
            continue
        rows = np.flatnonzero(is_used)[first]
        is_measured = np.isin(track.status, (REFINED, HUMAN))
        is_seen = (track.num_points > 0) & (track.status != KEPT)
        is_certain = (is_measured | is_seen)[rows]
        boxes = track.boxes[rows]
        found.append(ObjectTrack(track.track_id, track.class_name, stamps_ns, boxes, is_certain))
    return found


class PointProducts:
    """The formats and clouds of a request, written while sweeps are labelled."""

    def __init__(
        self,
        folder: Path,
        request: Request,
        sweeps: StoredSweeps,
        labeller: PointLabeller,
        fixed_frame: str,
    ) -> None:
        self._folder = folder
        self._request = request
        self._sweeps = sweeps
        self._labeller = labeller
        self._fixed_frame = fixed_frame
        self._provenance = Provenance.of(request.recordings, request.config)
        self._writers: dict[str, LabelWriter] = {
            name: writer_for(name, folder, self._provenance, Options(with_points=True))
            for name in request.point_formats
        }
        self._maps = {name: VoxelCloud(MAP_VOXEL) for name in request.maps}
        self._objects: dict[int, VoxelCloud] = {}
        self._clouds = folder / CLOUDS_FOLDER
        if request.clouds or request.undistort:
            self._clouds.mkdir()
        self._origin: Floats | None = None
        self._counts: Counter[str] = Counter()
        self._labelled = lru_cache(RECENT_SWEEPS)(self._label)
        self._done = 0

    def write(self) -> dict[str, Any]:
        """Label all sweeps and write all files; return sweeps and points by their label."""
        if self._request.cloud_copies:
            self._write_copies()
        self._add_until(len(self._sweeps.places))
        for writer in self._writers.values():
            writer.close()
        origin = np.zeros(3) if self._origin is None else self._origin
        for name, cloud in self._maps.items():
            write_cloud(self._clouds / f'{name}.ply', cloud.points() - origin)
        if 'object' in self._request.clouds:
            (self._clouds / 'objects').mkdir()
            for row, cloud in self._objects.items():
                name = object_name(self._labeller.tracks[row].track_id, row)
                write_cloud(self._clouds / 'objects' / f'{name}.ply', cloud.points())
        facts: dict[str, Any] = dict(self._counts)
        if self._maps and self._origin is not None:
            facts['map_origin'] = self._origin.tolist()
        return facts

    def _label(self, number: int) -> LabelledSweep | None:
        """Return a sweep with its labels; None where it has no transform."""
        sweep, cloud = self._sweeps[number]
        if sweep is None:
            return None
        is_known = self._labeller.knows(sweep.stamp_ns)
        return LabelledSweep(sweep, cloud, self._labeller.label(sweep), is_known)

    def _add_until(self, number: int) -> None:
        """Write what depends on the sweeps before a number, each once."""
        for row in range(self._done, number):
            labelled = self._labelled(row)
            self._counts['sweeps'] += 1
            if labelled is None:
                self._counts['sweeps_without_transform'] += 1
                continue
            self._count(labelled)
            if labelled.cloud is not None:
                self._write_formats(labelled.cloud, labelled.labels)
            if self._maps and labelled.is_known:
                self._accumulate(labelled)
            if 'object' in self._request.clouds:
                self._collect_objects(labelled.labels)
        self._done = max(self._done, number)

    def _count(self, labelled: LabelledSweep) -> None:
        labels = labelled.labels
        self._counts['sweeps_without_boxes'] += not labelled.is_known
        self._counts['points'] += len(labels.track)
        self._counts['points_on_objects'] += len(labels.rows)
        self._counts['points_on_moving'] += int((labels.motion[labels.rows] == MOVING).sum())
        self._counts['points_dynamic'] += int(labels.is_dynamic.sum())
        self._counts['points_unknown'] += int((labels.track == UNKNOWN).sum())

    def _write_formats(self, cloud: StoredCloud, labels: PointLabels) -> None:
        """Write a sweep in the formats of points."""
        objects = labels.objects
        counts = np.bincount(labels.owner, minlength=len(objects.track))
        found = []
        for row in np.flatnonzero(~objects.is_lost):
            track = labels.tracks[objects.track[row]]
            status = REFINED if objects.is_certain[row] else KEPT
            evidence = {'status': status, 'num_points': counts[row]}
            box = objects.boxes[row]
            found.append(ReadBox(track.track_id, track.class_name, box, evidence))
        frame = LabelFrame(
            refined_of(cloud.sweep.stamp_ns, self._fixed_frame, found),
            self._fixed_frame,
            cloud.sweep.frame_id,
            cloud.T_fixed_sweep,
            cloud.sweep,
            cloud.intensities,
            points=labels,
        )
        for writer in self._writers.values():
            writer.write(frame)

    def _accumulate(self, labelled: LabelledSweep) -> None:
        """Add the points of a sweep to the maps."""
        points = labelled.sweep.in_frame().points
        if self._origin is None:
            far = bool(len(points)) and np.abs(points[0]).max() > FLOAT32_RANGE
            self._origin = np.round(points[0]).astype(float) if far else np.zeros(3)
        for name, cloud in self._maps.items():
            cloud.add(points[is_kept(labelled.labels, name)])

    def _collect_objects(self, labels: PointLabels) -> None:
        of_points = labels.track[labels.rows]
        for row in np.unique(of_points).tolist():
            cloud = self._objects.setdefault(row, VoxelCloud(OBJECT_VOXEL))
            cloud.add(labels.local[of_points == row])

    def _write_copies(self) -> None:
        """Write the copies of the recording; sweeps are added as their clouds are reached."""
        from boxreg_ros.offline.cloud_copies import CloudCopies  # imports the writer of MCAP

        copies = CloudCopies(self._request, self._sweeps.places, self._added)
        copies.write(self._folder, self._clouds, self._provenance)
        if copies.unchanged:
            self._counts['clouds_copied_unchanged'] = copies.unchanged

    def _added(self, number: int) -> LabelledSweep | None:
        self._add_until(number + 1)
        return self._labelled(number)


def object_name(track_id: str, row: int) -> str:
    """Return a file name of a track: its id with other characters as in a URL; a part if long."""
    name = quote(track_id, safe=' ', errors='surrogatepass')
    if name.startswith('.'):
        name = f'%2E{name[1:]}'
    return name if len(name) <= MAX_NAME else f'{name[:MAX_NAME]}~{row}'


class VoxelCloud:
    """Points with one per voxel, the first; `edge` is that of the voxels [m]."""

    def __init__(self, edge: float) -> None:
        self._edge = edge
        self._parts: list[Floats] = []
        self._known = np.full(FIRST_ENTRIES, FREE)
        self._count = 0

    def add(self, points: NDArray[np.floating]) -> None:
        """Add points (M, 3) [m]; memory grows with the voxels."""
        size = len(self._known)
        while size < 2 * (self._count + len(points)):
            size *= 2
        if size > len(self._known):
            known = self._known[self._known != FREE]
            self._known = np.full(size, FREE)
            add_new(known, self._known)
        kept = points[add_new(self._voxels(points), self._known)]
        self._parts.append(kept)
        self._count += len(kept)

    def points(self) -> Floats:
        """Return their positions, shape (n, 3) [m]."""
        return np.concatenate([np.zeros((0, 3)), *self._parts])

    def _voxels(self, points: NDArray[np.floating]) -> Ints:
        """Return the number of the voxel of each point, the same again after 2^21 voxels."""
        places = np.floor(points.T.astype(np.float64) / self._edge).astype(np.int64)
        x, y, z = places & (2**AXIS_BITS - 1)
        number: Ints = x << 2 * AXIS_BITS | y << AXIS_BITS | z
        return number
