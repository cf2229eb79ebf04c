"""Copies of a recording, and of its overlay, whose clouds are edited by the labels of points."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from contextlib import closing, ExitStack
from pathlib import Path
from typing import Any

from boxreg_ros.core.method.labelling import MOVING, STOOD
from boxreg_ros.core.point_labels import PointLabels, UNKNOWN
from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.io.recording import Recording
from boxreg_ros.labels import Provenance
from boxreg_ros.labels.mcap import OVERLAY
from boxreg_ros.labels.recording_copy import RawMessage, RecordingCopy
from boxreg_ros.labels.semantickitti import point_numbers
from boxreg_ros.offline.labelled_sweep import is_kept, LabelledSweep
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.sources import source_of
from boxreg_ros.offline.stored_sweeps import MergedCloud, StoredPlace
from boxreg_ros.structures import Floats, Ints
from msg_adapters import pointcloud
from msg_adapters.cloud_edits import with_fields, with_points, with_positions
from msg_adapters.poses import stamp_ns as stamp_ns_of
import numpy as np
from numpy.typing import NDArray

MOVING_CODE, STOOD_CODE, UNKNOWN_CODE = 1, 2, 255
"""Values of the field ``moving``; 0 is background or parked."""
FIELDS = {'label': (np.uint16, 0), 'instance': (np.uint16, 0), 'moving': (np.uint8, UNKNOWN_CODE)}
"""Fields of labelled clouds: types, and values of unknown points."""


class CloudCopies:
    """
    Copy a recording, once for each kind of clouds.

    `places` are those of all sweeps; `labelled` returns a sweep by its number, with its labels, or
    None where it has no transform. `unchanged` counts the clouds that were copied as they are.

    """

    def __init__(
        self,
        request: Request,
        places: list[StoredPlace],
        labelled: Callable[[int], LabelledSweep | None],
    ) -> None:
        self._request = request
        # By topic and stamp, the number of the sweep that a cloud is a part of.
        self._clouds = {
            (part.topic, part.stamp_ns): (number, part)
            for number, place in enumerate(places)
            for part in place.parts
        }
        self._labelled = labelled
        self._numbers: NDArray[np.uint32] | None = None
        self.unchanged = 0

    def write(self, folder: Path, clouds: Path, provenance: Provenance) -> None:
        """Write the copies to the folder `clouds`, and the overlay of `folder` in its place."""
        request = self._request
        paths = {name: clouds / f'{name}.mcap' for name in request.cloud_copies}
        overlay = folder / OVERLAY
        if paths.pop('overlay', None):
            whole = overlay.replace(overlay.with_name(f'.{OVERLAY}'))
            source = Recording((whole,), request.lidars, odometry=request.odometry)
            source.has_boxes = False
            self._copy(source, {'overlay': overlay}, None)
            whole.unlink()
        if paths:
            recording = source_of(request)
            assert isinstance(recording, Recording)  # checked on reading
            self._copy(recording, paths, provenance)

    def _copy(
        self, source: Recording, paths: Mapping[str, Path], provenance: Provenance | None
    ) -> None:
        """Write copies of a recording, by their kind."""
        with ExitStack() as stack:
            stack.enter_context(source)
            copies = {
                kind: stack.enter_context(closing(RecordingCopy(path, source, provenance)))
                for kind, path in paths.items()
            }
            for raw in next(iter(copies.values())).messages():
                edited: Mapping[str, RawMessage] = {}
                if raw.topic in source.points_topics:
                    edited = self._edited(raw, source, copies)
                for kind, copied in copies.items():
                    copied.add(edited.get(kind, raw))

    def _edited(
        self, raw: RawMessage, source: Recording, kinds: Collection[str]
    ) -> Mapping[str, RawMessage]:
        """Return the message of a cloud for each kind of copy; none where it has no labels."""
        try:
            message = source.decoder.decoded(raw.connection, raw.data)
            stamp_ns = stamp_ns_of(message.header)
            rows = pointcloud.finite_rows(message)
        except UnsupportedMessage:
            return {}  # counted by the run itself
        count = message.width * message.height
        if not count:
            return {}
        finite = np.arange(count) if rows is None else rows
        topic = raw.topic if len(source.points_topics) > 1 else ''
        number, part = self._clouds.get((topic, stamp_ns), (-1, None))
        labelled = None if part is None else self._labelled(number)
        is_same = part is not None and len(finite) == part.rows.stop - part.rows.start
        if part is None or labelled is None or not is_same:
            self.unchanged += len(kinds) - ('overlay' in kinds)
            edited = {'overlay': with_fields(message, _columns(count))}
        else:
            edited = {k: self._edit(k, message, finite, part, labelled) for k in kinds}
        return {k: raw._replace(data=source.encoded_cloud(cloud)) for k, cloud in edited.items()}

    def _edit(
        self, kind: str, message: Any, finite: Ints, part: MergedCloud, labelled: LabelledSweep
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
        if not labelled.is_known:
            return message
        stays = np.ones(n, bool)
        stays[finite] = is_kept(labelled.labels, kind)[part.rows]
        return with_points(message, stays)

    def _fields(self, labels: PointLabels) -> dict[str, NDArray[Any]]:
        """Return the values of `FIELDS` of the points of a sweep, (M,) each."""
        if self._numbers is None:
            self._numbers = point_numbers(labels)
        numbers = self._numbers[labels.track]
        codes = np.zeros(len(labels.track), np.uint8)
        codes[labels.motion == MOVING] = MOVING_CODE
        codes[labels.motion == STOOD] = STOOD_CODE
        codes[labels.track == UNKNOWN] = UNKNOWN_CODE
        columns = numbers.astype(np.uint16), (numbers >> 16).astype(np.uint16), codes
        return dict(zip(FIELDS, columns, strict=True))


def _columns(n: int) -> dict[str, NDArray[Any]]:
    """Return the values of `FIELDS` of n unknown points."""
    return {name: np.full(n, unknown, kind) for name, (kind, unknown) in FIELDS.items()}


def _shift(labelled: LabelledSweep) -> Floats:
    """Return how far each point of a moving object goes until the stamp, (M, 3), fixed frame."""
    labels = labelled.labels
    moves = labels.motion[labels.rows] == MOVING
    moved = labels.rows[moves]
    shift = np.zeros((len(labels.track), 3))
    shift[moved] = labels.at_stamp()[moves] - labelled.sweep.in_frame().points[moved]
    return shift
