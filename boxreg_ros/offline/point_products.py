"""
Labels of points, and clouds without what moves: the second reading of a recording.

The boxes of all tracks are known by then. Each sweep is labelled once; formats of points, the
accumulated map and the objects are written while it is in memory. Recordings are copied
afterwards, with the labels of each cloud from files beside the results.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
import shutil
from typing import Any, TYPE_CHECKING

from boxreg_ros.config import KINDS
from boxreg_ros.core.point_labels import (
    BACKGROUND,
    MOVING,
    ObjectTrack,
    PointLabeller,
    PointLabels,
    STOOD,
    UNKNOWN,
)
from boxreg_ros.errors import ConfigError, UnsupportedMessage
from boxreg_ros.io.fixed_frame import FixedFrameItems, MovedItem
from boxreg_ros.io.recording import Recording
from boxreg_ros.labels import LabelFrame, LabelWriter, Options, Provenance, writer_for
from boxreg_ros.labels.clouds import write_cloud
from boxreg_ros.labels.mcap import OVERLAY
from boxreg_ros.labels.recording_copy import RawMessage, RecordingCopy
from boxreg_ros.labels.semantickitti import Numbers
from boxreg_ros.offline.labelled_recording import label_frame_of
from boxreg_ros.offline.request import Request
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
from msg_adapters.clouds import POINTS_TYPE
from msg_adapters.poses import stamp_ns as stamp_ns_of
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from boxreg_ros.core.registrar import BoxRegistrar

CLOUDS_FOLDER = 'clouds'
SPOOL_FOLDER = '.points'
MAP_VOXEL, OBJECT_VOXEL = 0.1, 0.02
"""Edges of the voxels of the map and of objects, one point each [m]; chosen."""
MOVING_CODE, STOOD_CODE, UNKNOWN_CODE = 1, 2, 255
"""Values of the field ``moving``; 0 is background or parked."""

Edit = Callable[[Any, 'Ints | None', Any], Any]
"""Returns a cloud of a message, the rows of its finite points, and the labels of these."""


def write_point_products(
    folder: Path,
    request: Request,
    tracks: Sequence[TrackChanges],
    array_stamps_ns: Sequence[int],
    registrar: BoxRegistrar,
) -> dict[str, Any]:
    """
    Write the formats and clouds that a request asks for.

    Parameters
    ----------
    folder : Path
        Of the results.
    request : Request
        Of the run.
    tracks : sequence of TrackChanges
        Results of the run.
    array_stamps_ns : sequence of int
        Stamps of all box arrays [ns].
    registrar : BoxRegistrar
        That of the run: its labelling margins and the time of its boxes are used.

    Returns
    -------
    counts : dict
        Sweeps and points by their label, for ``summary.json``.

    Raises
    ------
    ConfigError
        If a recording is to be copied that is none, or whose clouds are no PointCloud2.

    """
    config = registrar.box_time.resolved(request.config)
    objects = object_tracks(tracks)
    kinds = [KINDS.index(config.kind(one.class_name)) for one in objects]
    margins = registrar.margins()[kinds].reshape(-1, 6)
    labeller = PointLabeller(objects, np.array(array_stamps_ns, np.int64), config, margins)
    products = _Products(folder, request)
    source = request.recording()
    source.has_boxes = False  # they are known
    with source as recording:
        items = FixedFrameItems(recording, request.config, request.convention, request.fixed_frame)
        sensor_frame = label_frame_of(
            recording, items.tree, items.fixed_frame, request.label_frame
        )
        for item in items.read(with_intensities=True):
            if isinstance(item.given, Sweep):
                products.add(item, items, sensor_frame, labeller)
    products.close()
    return products.summary()


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


class _Products:
    """The files that are written while sweeps are labelled, and the copies after them."""

    def __init__(self, folder: Path, request: Request) -> None:
        self._folder = folder
        self._request = request
        self._provenance = Provenance.of(request.recordings, request.config)
        self._writers: dict[str, LabelWriter] = {
            name: writer_for(name, folder, self._provenance, Options(with_points=True))
            for name in request.point_formats
        }
        self._maps = {name: VoxelCloud(MAP_VOXEL) for name in request.maps}
        self._objects: dict[int, VoxelCloud] = {}
        self._copies = self._planned_copies()
        self._spool = folder / SPOOL_FOLDER
        if self._copies:
            self._check_copies()
            self._spool.mkdir()
        self._clouds = folder / CLOUDS_FOLDER
        if self._maps or 'object' in request.clouds or request.undistort:
            self._clouds.mkdir()
        self._tracks: Sequence[ObjectTrack] = ()
        self._origin: Floats | None = None
        self._counts: Counter[str] = Counter()
        self._numbers: Numbers | None = None

    def add(
        self, item: MovedItem, items: FixedFrameItems, sensor_frame: str, labeller: PointLabeller
    ) -> None:
        """Label a sweep and write what depends on it alone."""
        self._tracks = labeller.tracks
        self._counts['sweeps'] += 1
        sweep = item.moved
        if not isinstance(sweep, Sweep):
            self._counts['sweeps_without_transform'] += 1
            return
        labels = labeller.label(sweep)
        is_known = labeller.knows(sweep.stamp_ns)
        self._count(labels, is_known)
        self._write_formats(item, items, sensor_frame, labels)
        if self._maps:
            self._accumulate(sweep, labels, is_known)
        if 'object' in self._request.clouds:
            self._collect_objects(labels)
        if self._copies:
            self._store(item, items, sweep, labels, is_known)

    def close(self) -> None:
        """Complete the files, and copy the recording."""
        for writer in self._writers.values():
            writer.close()
        origin = np.zeros(3) if self._origin is None else self._origin
        for name, cloud in self._maps.items():
            write_cloud(self._clouds / f'{name}.ply', cloud.points() - origin)
        if 'object' in self._request.clouds:
            (self._clouds / 'objects').mkdir()
            for row, cloud in self._objects.items():
                name = _file_name(self._tracks[row].track_id, row)
                write_cloud(self._clouds / 'objects' / f'{name}.ply', cloud.points())
        for path, edit in self._copies:
            self._copy(path, edit)
        if self._copies:
            shutil.rmtree(self._spool)

    def summary(self) -> dict[str, Any]:
        """Return the numbers of sweeps and points, and the origin of the maps."""
        facts: dict[str, Any] = dict(self._counts)
        if self._maps and self._origin is not None:
            facts['map_origin'] = self._origin.tolist()
        return facts

    def _count(self, labels: PointLabels, is_known: bool) -> None:
        self._counts['sweeps_without_boxes'] += not is_known
        self._counts['points'] += len(labels.track)
        self._counts['points_on_objects'] += len(labels.rows)
        self._counts['points_on_moving'] += int((labels.motion[labels.rows] == MOVING).sum())
        self._counts['points_dynamic'] += int(labels.is_dynamic.sum())
        self._counts['points_unknown'] += int((labels.track == UNKNOWN).sum())

    def _write_formats(
        self,
        item: MovedItem,
        items: FixedFrameItems,
        sensor_frame: str,
        labels: PointLabels,
    ) -> None:
        if not self._writers:
            return
        cloud = items.stored_cloud(item, sensor_frame)
        objects = labels.objects
        rows = np.flatnonzero(~objects.is_lost)
        tracks = [labels.tracks[row] for row in objects.track[rows]]
        n = len(rows)
        refined = RefinedBoxes(
            BoxArray(
                cloud.sweep.stamp_ns,
                items.fixed_frame,
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
            items.fixed_frame,
            cloud.sweep.frame_id,
            cloud.T_fixed_sweep,
            cloud.sweep,
            cloud.intensities,
            points=labels,
        )
        for writer in self._writers.values():
            writer.write(frame)

    def _accumulate(self, sweep: Sweep, labels: PointLabels, is_known: bool) -> None:
        """Add the points of a sweep to the maps; those of a sweep without boxes are left out."""
        if not is_known:
            return
        points = sweep.in_frame().points
        if self._origin is None:
            far = bool(len(points)) and np.abs(points[0]).max() > FLOAT32_RANGE
            self._origin = np.round(points[0]).astype(float) if far else np.zeros(3)
        for name, cloud in self._maps.items():
            cloud.add(points[_is_kept(labels, name)])

    def _collect_objects(self, labels: PointLabels) -> None:
        of_points = labels.track[labels.rows]
        for row in np.unique(of_points).tolist():
            cloud = self._objects.setdefault(row, VoxelCloud(OBJECT_VOXEL))
            cloud.add(labels.local[of_points == row])

    def _store(
        self,
        item: MovedItem,
        items: FixedFrameItems,
        sweep: Sweep,
        labels: PointLabels,
        is_known: bool,
    ) -> None:
        """
        Store the labels of each cloud of a sweep until its message is copied.

        Clouds of a sweep without boxes are copied whole: what moves in them is not known.

        """
        if self._numbers is None:
            self._numbers = Numbers(labels)
        classes, instances = self._numbers.of(labels)
        codes = np.zeros(len(labels.track), np.uint8)
        codes[labels.motion == MOVING] = MOVING_CODE
        codes[labels.motion == STOOD] = STOOD_CODE
        codes[labels.track == UNKNOWN] = UNKNOWN_CODE
        columns: dict[str, NDArray[Any]] = {
            'label': classes,
            'instance': instances,
            'moving': codes,
            **{name: _is_kept(labels, name) | (not is_known) for name in self._request.maps},
        }
        if self._request.undistort:
            moves = labels.motion[labels.rows] == MOVING
            shift = np.zeros((len(codes), 3))
            moved = labels.rows[moves]
            shift[moved] = labels.at_stamp()[moves] - sweep.in_frame().points[moved]
            columns['shift'] = shift
        first = 0
        for part in item.items:
            cloud = part.content
            assert isinstance(cloud, Sweep)
            own = slice(first, first + len(cloud.points))
            first = own.stop
            values = {name: column[own] for name, column in columns.items()}
            if 'shift' in values:
                T = items.pose_of(cloud.frame_id, cloud.stamp_ns)
                values['shift'] = values['shift'] @ (np.eye(3) if T is None else T[:3, :3])
            np.savez(self._file(cloud.topic, cloud.stamp_ns), allow_pickle=False, **values)

    def _file(self, topic: str, stamp_ns: int) -> Path:
        name = topic.strip('/').replace('/', '__')
        return self._spool / f'{name}-{stamp_ns}.npz'

    def _planned_copies(self) -> list[tuple[Path, Edit]]:
        """Return the recordings to write, and how their clouds are edited."""
        request = self._request
        clouds = self._folder / CLOUDS_FOLDER
        planned: list[tuple[Path, Edit]] = []
        if request.label_points and 'mcap' in request.formats:
            planned.append((self._folder / OVERLAY, _labelled))
        planned += [(clouds / f'{name}.mcap', _keeping(name)) for name in request.maps]
        if request.undistort:
            planned.append((clouds / 'undistorted.mcap', _undistorted))
        return planned

    def _check_copies(self) -> None:
        recording = self._request.recording()
        if not isinstance(recording, Recording):
            raise ConfigError(
                f'clouds: expected a recording, which is copied with edited clouds, got '
                f'{recording}; ask for --label-points or --clouds object alone'
            )
        with recording:
            kinds = {recording.topics[topic] for topic in recording.points_topics}
        if kinds != {POINTS_TYPE}:
            raise ConfigError(
                f'clouds: expected {POINTS_TYPE} to edit, got {", ".join(sorted(kinds))}; ask for '
                f'--label-points or --clouds object alone'
            )

    def _copy(self, path: Path, edit: Edit) -> None:
        """Copy the recording, or the overlay in its place, with its clouds edited."""
        recording = self._request.recording()
        assert isinstance(recording, Recording)
        is_overlay = path.exists()
        target = path.with_name(f'.{path.name}') if is_overlay else path
        with ExitStack() as stack:
            if is_overlay:
                stack.enter_context(recording)
                lidars = recording.placement.lidars
                recording = Recording((path,), lidars, recording.boxes_topic or None)
            copied = RecordingCopy(target, recording, None if is_overlay else self._provenance)
            stack.callback(copied.close)
            topics = copied.recording.points_topics
            for raw in copied.messages():
                copied.add(
                    self._edited(raw, copied.recording, edit) if raw.topic in topics else raw
                )
        if is_overlay:
            target.replace(path)

    def _edited(self, raw: RawMessage, recording: Recording, edit: Edit) -> RawMessage:
        """Return the message of a cloud edited; as it is where it has no labels."""
        try:
            message = recording.cloud_message(raw.topic, raw.data)
            stamp_ns = stamp_ns_of(message.header)
            rows = pointcloud.finite_rows(message)
        except UnsupportedMessage:
            return raw  # counted by the run itself
        several = len(recording.points_topics) > 1
        file = self._file(raw.topic if several else '', stamp_ns)
        if not file.exists() or not message.width * message.height:
            self._counts['clouds_copied_unchanged'] += 1
            return raw
        with np.load(file) as columns:
            edited = edit(message, rows, columns)
        return raw._replace(data=recording.encoded_cloud(edited))


def _labelled(message: Any, rows: Ints | None, labels: Any) -> Any:
    """Return a cloud with the fields ``label``, ``instance`` and ``moving``."""
    n = message.width * message.height
    defaults = {'label': 0, 'instance': 0, 'moving': UNKNOWN_CODE}
    columns = {}
    for name, default in defaults.items():
        values = labels[name]
        columns[name] = np.full(n, default, values.dtype)
        columns[name][slice(None) if rows is None else rows] = values
    return with_fields(message, columns)


def _keeping(name: str) -> Edit:
    """Return the edit that leaves out the points that are not in the map `name`."""

    def edit(message: Any, rows: Ints | None, labels: Any) -> Any:
        is_kept = np.ones(message.width * message.height, bool)
        is_kept[slice(None) if rows is None else rows] = labels[name]
        return with_points(message, is_kept)

    return edit


def _undistorted(message: Any, rows: Ints | None, labels: Any) -> Any:
    """Return a cloud with the points of moving objects at the stamp."""
    place = slice(None) if rows is None else rows
    positions = pointcloud.positions(message)
    positions[place] += labels['shift']
    return with_positions(message, positions)


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
