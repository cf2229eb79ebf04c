"""
Labels of points, and clouds without what moves.

The boxes of all tracks are known by then. Each stored sweep is labelled, in the order of reading;
formats of points, the accumulated map and the objects are written from it. Copies of the recording
take the labels of the sweep that their cloud is a part of.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import closing, ExitStack
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, TYPE_CHECKING

from boxreg_ros.config import Config, KINDS
from boxreg_ros.core.method.labelling import MOVING, STOOD
from boxreg_ros.core.point_labels import (
    BACKGROUND,
    ObjectTrack,
    PointLabeller,
    PointLabels,
    UNKNOWN,
)
from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.io.fixed_frame import StoredCloud
from boxreg_ros.io.recording import Recording
from boxreg_ros.labels import LabelFrame, LabelWriter, Options, Provenance, writer_for
from boxreg_ros.labels.clouds import write_cloud
from boxreg_ros.labels.mcap import OVERLAY
from boxreg_ros.labels.recording_copy import RawMessage, RecordingCopy
from boxreg_ros.labels.semantickitti import Numbers
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.stored_sweeps import MergedCloud, StoredSweeps
from boxreg_ros.review.changes import TrackChanges
from boxreg_ros.structures import (
    BoxArray,
    FLOAT32_RANGE,
    Floats,
    HUMAN,
    Ints,
    KEPT,
    REFINED,
    RefinedBoxes,
    REJECTED,
    Sweep,
)
from msg_adapters import pointcloud
from msg_adapters.cloud_edits import with_fields, with_points, with_positions
from msg_adapters.poses import stamp_ns as stamp_ns_of
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from boxreg_ros.core.registrar import BoxRegistrar

CLOUDS_FOLDER = 'clouds'
MAP_VOXEL, OBJECT_VOXEL = 0.1, 0.02
"""Edges of the voxels of the map and of objects, one point each [m]; chosen."""
MOVING_CODE, STOOD_CODE, UNKNOWN_CODE = 1, 2, 255
"""Values of the field ``moving``; 0 is background or parked."""
FIELDS = {'label': (np.uint16, 0), 'instance': (np.uint16, 0), 'moving': (np.uint8, UNKNOWN_CODE)}
"""Fields of labelled clouds: types, and values of unknown points."""
RECENT_SWEEPS = 4
"""Sweeps whose labels are kept: the clouds of several LiDARs are not in the order of sweeps."""


def labeller_of(
    tracks: Sequence[TrackChanges],
    array_stamps_ns: Sequence[int],
    registrar: BoxRegistrar,
    config: Config,
) -> PointLabeller:
    """
    Return the labeller of a run.

    Parameters
    ----------
    tracks : sequence of TrackChanges
        Results of the run.
    array_stamps_ns : sequence of int
        Stamps of all box arrays [ns].
    registrar : BoxRegistrar
        That of the run: its labelling margins and the time of its boxes are used.
    config : Config
        Of the run.

    """
    objects = object_tracks(tracks)
    kinds = [KINDS.index(config.kind(one.class_name)) for one in objects]
    margins = registrar.margins()[kinds].reshape(-1, 6)
    config = registrar.box_time.resolved(config)
    return PointLabeller(objects, np.array(array_stamps_ns, np.int64), config, margins)


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


def write_point_products(
    folder: Path,
    request: Request,
    sweeps: StoredSweeps,
    labeller: PointLabeller,
    fixed_frame: str,
) -> dict[str, Any]:
    """
    Write the formats and clouds that a request asks for.

    Returns
    -------
    counts : dict
        Sweeps and points by their label, for ``summary.json``.

    """
    products = _Products(folder, request, sweeps, labeller, fixed_frame)
    products.write()
    return products.summary()


class _Labelled(NamedTuple):
    """A sweep in the fixed frame, its labels, and whether boxes state what is there."""

    sweep: Sweep
    cloud: StoredCloud | None
    labels: PointLabels
    is_known: bool


class _Products:
    """The files that are written while sweeps are labelled."""

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
        self._numbers: Numbers | None = None
        self._labelled = lru_cache(RECENT_SWEEPS)(self._label)
        self._done = 0

    def write(self) -> None:
        """Label all sweeps and write all files."""
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
                name = _file_name(self._labeller.tracks[row].track_id, row)
                write_cloud(self._clouds / 'objects' / f'{name}.ply', cloud.points())

    def summary(self) -> dict[str, Any]:
        """Return the numbers of sweeps and points, and the origin of the maps."""
        facts: dict[str, Any] = dict(self._counts)
        if self._maps and self._origin is not None:
            facts['map_origin'] = self._origin.tolist()
        return facts

    def _label(self, number: int) -> _Labelled | None:
        """Return a sweep with its labels; None where it has no transform."""
        sweep, cloud = self._sweeps[number]
        if sweep is None:
            return None
        is_known = self._labeller.knows(sweep.stamp_ns)
        return _Labelled(sweep, cloud, self._labeller.label(sweep), is_known)

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

    def _count(self, labelled: _Labelled) -> None:
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
        rows = np.flatnonzero(~objects.is_lost)
        tracks = [labels.tracks[row] for row in objects.track[rows]]
        n = len(rows)
        refined = RefinedBoxes(
            BoxArray(
                cloud.sweep.stamp_ns,
                self._fixed_frame,
                tuple(track.track_id for track in tracks),
                tuple(track.class_name for track in tracks),
                np.full(n, np.nan),
                objects.boxes[rows],
            ),
            tuple(np.where(objects.is_certain[rows], REFINED, KEPT).tolist()),
            ('',) * n,
            np.bincount(labels.owner, minlength=len(objects.track))[rows],
            np.tile(np.eye(6), (n, 1, 1)),
        )
        frame = LabelFrame(
            refined,
            self._fixed_frame,
            cloud.sweep.frame_id,
            cloud.T_fixed_sweep,
            cloud.sweep,
            cloud.intensities,
            points=labels,
        )
        for writer in self._writers.values():
            writer.write(frame)

    def _accumulate(self, labelled: _Labelled) -> None:
        """Add the points of a sweep to the maps."""
        points = labelled.sweep.in_frame().points
        if self._origin is None:
            far = bool(len(points)) and np.abs(points[0]).max() > FLOAT32_RANGE
            self._origin = np.round(points[0]).astype(float) if far else np.zeros(3)
        for name, cloud in self._maps.items():
            cloud.add(points[_is_kept(labelled.labels, name)])

    def _collect_objects(self, labels: PointLabels) -> None:
        of_points = labels.track[labels.rows]
        for row in np.unique(of_points).tolist():
            cloud = self._objects.setdefault(row, VoxelCloud(OBJECT_VOXEL))
            cloud.add(labels.local[of_points == row])

    def _write_copies(self) -> None:
        """Copy the recording, and the overlay in its place, with their clouds edited."""
        request = self._request
        paths = {name: self._clouds / f'{name}.mcap' for name in request.cloud_copies}
        overlay = self._folder / OVERLAY
        if paths.pop('overlay', None):
            whole = overlay.replace(overlay.with_name(f'.{OVERLAY}'))
            source = Recording((whole,), request.lidars, odometry=request.odometry)
            source.has_boxes = False
            self._copy(source, {'overlay': overlay}, None)
            whole.unlink()
        if paths:
            recording = request.recording()
            assert isinstance(recording, Recording)  # checked on reading
            self._copy(recording, paths, self._provenance)

    def _copy(
        self, source: Recording, paths: Mapping[str, Path], provenance: Provenance | None
    ) -> None:
        """Write copies of a recording, by their kind."""
        clouds: dict[tuple[str, int], tuple[int, MergedCloud]] = {}
        for number, place in enumerate(self._sweeps.places):
            clouds |= {(part.topic, part.stamp_ns): (number, part) for part in place.parts}
        with ExitStack() as stack:
            stack.enter_context(source)
            copies = {
                kind: stack.enter_context(closing(RecordingCopy(path, source, provenance)))
                for kind, path in paths.items()
            }
            several = len(source.points_topics) > 1
            for raw in next(iter(copies.values())).messages():
                edited: Mapping[str, RawMessage] = {}
                if raw.topic in source.points_topics:
                    topic = raw.topic if several else ''
                    edited = self._edited(raw, topic, source, clouds, copies)
                for kind, copied in copies.items():
                    copied.add(edited.get(kind, raw))

    def _edited(
        self,
        raw: RawMessage,
        topic: str,
        source: Recording,
        clouds: Mapping[tuple[str, int], tuple[int, MergedCloud]],
        kinds: Collection[str],
    ) -> Mapping[str, RawMessage]:
        """Return the message of a cloud for each kind of copy; none where it has no labels."""
        try:
            message = source.cloud_message(raw.topic, raw.data)
            stamp_ns = stamp_ns_of(message.header)
            rows = pointcloud.finite_rows(message)
        except UnsupportedMessage:
            return {}  # counted by the run itself
        count = message.width * message.height
        finite = np.arange(count) if rows is None else rows
        number, part = clouds.get((topic, stamp_ns), (-1, None))
        labelled = None if part is None else self._labelled(number)
        is_same = part is not None and len(finite) == part.rows.stop - part.rows.start
        if not count:
            return {}
        if part is None or labelled is None or not is_same:
            self._counts['clouds_copied_unchanged'] += len(kinds) - ('overlay' in kinds)
            edited = {'overlay': with_fields(message, _columns(count))}
        else:
            self._add_until(number + 1)
            edited = {k: self._edit(k, message, finite, part, labelled) for k in kinds}
        return {k: raw._replace(data=source.encoded_cloud(cloud)) for k, cloud in edited.items()}

    def _edit(
        self, kind: str, message: Any, finite: Ints, part: MergedCloud, labelled: _Labelled
    ) -> Any:
        """
        Return the cloud of a message as a kind of copy has it.

        `finite` has the rows of its finite points, which the labels are of. A cloud of a sweep
        without boxes is copied whole: what moves in it is not known.

        """
        n = message.width * message.height
        if kind == 'overlay':
            columns = _columns(n)
            for name, values in self._fields(labelled.labels).items():
                columns[name][finite] = values[part.rows]
            return with_fields(message, columns)
        if kind == 'undistorted':
            positions = pointcloud.positions(message)
            positions[finite] += _shift(labelled)[part.rows] @ part.R_fixed_cloud
            return with_positions(message, positions)
        is_kept = np.ones(n, bool)
        is_kept[finite] = _is_kept(labelled.labels, kind)[part.rows] | (not labelled.is_known)
        return with_points(message, is_kept)

    def _fields(self, labels: PointLabels) -> dict[str, NDArray[Any]]:
        """Return the values of `FIELDS` of the points of a sweep, (M,) each."""
        if self._numbers is None:
            self._numbers = Numbers(labels)
        classes, instances = self._numbers.of(labels)
        codes = np.zeros(len(labels.track), np.uint8)
        codes[labels.motion == MOVING] = MOVING_CODE
        codes[labels.motion == STOOD] = STOOD_CODE
        codes[labels.track == UNKNOWN] = UNKNOWN_CODE
        return dict(zip(FIELDS, (classes, instances, codes), strict=True))


def _columns(n: int) -> dict[str, NDArray[Any]]:
    """Return the values of `FIELDS` of n unknown points."""
    return {name: np.full(n, unknown, kind) for name, (kind, unknown) in FIELDS.items()}


def _shift(labelled: _Labelled) -> Floats:
    """Return how far each point of a moving object goes until the stamp, (M, 3), fixed frame."""
    labels = labelled.labels
    moves = labels.motion[labels.rows] == MOVING
    moved = labels.rows[moves]
    shift = np.zeros((len(labels.track), 3))
    shift[moved] = labels.at_stamp()[moves] - labelled.sweep.in_frame().points[moved]
    return shift


def _is_kept(labels: PointLabels, name: str) -> NDArray[np.bool_]:
    """Return which points the map ``static`` or ``background`` keeps, (M,)."""
    if name == 'static':
        return ~labels.is_dynamic
    is_background: NDArray[np.bool_] = labels.track == BACKGROUND
    return is_background


def _file_name(track_id: str, row: int) -> str:
    """Return a file name of a track; its row where the id has other characters."""
    is_plain = track_id.replace('-', '').replace('_', '').isalnum() and track_id.isascii()
    return track_id if is_plain else f'track_{row}'


class VoxelCloud:
    """
    Points with one per voxel, the first.

    Parameters
    ----------
    edge : float
        Of the voxels [m].

    """

    def __init__(self, edge: float) -> None:
        self._edge = edge
        self._parts: list[Floats] = []
        self._waiting = 0
        self._settled = 0

    def add(self, points: NDArray[np.floating]) -> None:
        """Add points (M, 3) [m]; memory grows with the voxels."""
        self._parts.append(np.asarray(points, np.float64))
        self._waiting += len(points)
        if self._waiting > max(self._settled, 10**6):
            self.points()

    def points(self) -> Floats:
        """Return their positions, shape (n, 3) [m]."""
        every = np.concatenate([np.zeros((0, 3)), *self._parts])
        cells = np.floor(every / self._edge).astype(np.int64)
        cells -= cells.min(axis=0, initial=0)
        span = cells.max(axis=0, initial=0) + 1
        keys = (cells[:, 0] * span[1] + cells[:, 1]) * span[2] + cells[:, 2]
        _, first = np.unique(keys, return_index=True)
        kept = every[np.sort(first)]
        self._parts = [kept]
        self._settled = len(kept)
        self._waiting = 0
        return kept
