"""The data of each track in ``report.html``: one row for the list, and one compressed part."""

from __future__ import annotations

from base64 import b64encode
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple
import zlib

from boxreg_ros.core.observation import GROUND_CLEARANCE
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.review.changes import ious, median, TrackChanges
from boxreg_ros.review.quality import quality
from boxreg_ros.review.risk import UNKNOWN_USUAL, Usual
from boxreg_ros.review.tables import TrackRow
from boxreg_ros.review.track_points import to_millimetres
from boxreg_ros.structures import (
    ADDED,
    BOX_EXTENT,
    COASTED,
    EXTENDED,
    Floats,
    HEIGHT,
    HUMAN,
    INTERPOLATED,
    Ints,
    KEPT,
    REFINED,
    REJECTED,
    X,
    Y,
    Z,
)
import numpy as np
import orjson

MAX_POINTS = 2_000_000
"""Points in a report; chosen: about 10 MB of the file."""
MIN_SHOWN_POINTS = 40
"""Points of a box that are shown in spite of `MAX_POINTS`, if there are; chosen."""
PATH_POINTS = 40
"""Points of the line of a track on the map; chosen."""
DECIMALS = 4
"""Decimals of metres and radians: a tenth of a millimetre."""
RISK_DECIMALS = 3
"""Decimals of risks [m], as in ``review.csv``."""
STATES = (REFINED, KEPT, HUMAN, INTERPOLATED, EXTENDED, COASTED, REJECTED)
"""Status of boxes by their letter in a row of the list, from a on."""
COMPRESSION = 3
"""Level of zlib; measured: level 6 saves 9 % of the file and takes twice as long."""


def compressed(data: bytes) -> str:
    """Return `data` as zlib in base64, which browsers decompress as ``deflate``."""
    return b64encode(zlib.compress(data, COMPRESSION)).decode('ascii')


def as_json(value: Any) -> bytes:
    """Return JSON with null for NaN; numpy arrays are lists."""
    return orjson.dumps(value, np.ndarray.tolist, orjson.OPT_SERIALIZE_NUMPY)


def points_per_box(boxes: int) -> int:
    """Return how many points of a box are shown in a report of `boxes` boxes."""
    return max(MIN_SHOWN_POINTS, MAX_POINTS // max(1, boxes))


class TrackTruth(NamedTuple):
    """True boxes of a track (n, 9), and 3D IoU (n,) of input and refined boxes; NaN without."""

    boxes: Floats
    iou_before: Floats
    iou_after: Floats


def true_boxes(tracks: Sequence[TrackChanges], truth: BoxTable | None) -> list[TrackTruth]:
    """
    Return the true boxes of each track, by stamp and track id of the input.

    Parameters
    ----------
    tracks : sequence of TrackChanges
        In the fixed frame.
    truth : BoxTable or None
        In the same frame, with the stamps and track ids of the input; None for no truth.

    Returns
    -------
    truth : list of TrackTruth
        One per track; NaN for boxes without a true one.

    """
    if not tracks:
        return []
    row_of: dict[tuple[int, str], int] = {}
    known = np.zeros((0, 9))
    if truth is not None:
        keys = zip(truth.stamps_ns.tolist(), truth.track_ids, strict=True)
        row_of = {key: row for row, key in enumerate(keys)}
        known = truth.boxes
    known = np.append(known, np.full((1, 9), np.nan), axis=0)  # the last one is unknown
    rows = [
        row_of.get((stamp, name), -1)
        for track in tracks
        for stamp, name in zip(track.stamps_ns.tolist(), track.input_ids, strict=True)
    ]
    boxes = known[rows]
    nothing = np.zeros((0, 9))
    before = ious(np.concatenate([nothing, *(track.given for track in tracks)]), boxes)
    after = ious(np.concatenate([nothing, *(track.boxes for track in tracks)]), boxes)
    ends = np.cumsum([len(track.stamps_ns) for track in tracks])[:-1]
    parts = (np.split(values, ends) for values in (boxes, before, after))
    return [TrackTruth(*found) for found in zip(*parts, strict=True)]


@dataclass(eq=False, repr=False)
class TrackPart:
    """
    The points and figures of one track, as the report shows them: `before` and `after`.

    `points` has those near each of its n boxes (M_i, 3), `sensor` where it was then (n, 3) [m].

    """

    source: TrackRow
    points: list[Floats]
    sensor: Floats
    truth: TrackTruth
    usual: Usual = UNKNOWN_USUAL

    def __post_init__(self) -> None:
        """Measure the boxes before and after."""
        self._track = track = self.source.track
        of_labels = np.where(track.is_label, 0.0, np.nan)  # NaN for rejected boxes
        given, truth = track.given + of_labels[:, None], self.truth
        self.before = quality(track, given, self.points, truth.iou_before + of_labels)
        self.after = quality(track, track.labels, self.points, truth.iou_after + of_labels)

    def row(self, stamps_ns: Ints) -> dict[str, Any]:
        """Return the row of the list; `stamps_ns` are those of the drive, sorted."""
        track = self._track
        inputs, owners = _inputs_of(track)
        status = Counter(track.status.tolist())
        is_input = ~np.isin(track.status, ADDED)
        boxes = int(is_input.sum())
        extents = [_median_extents(track.given), _median_extents(track.boxes)]
        known = np.flatnonzero(np.isfinite(track.boxes[:, X]))
        picks = known[np.linspace(0, len(known) - 1, min(PATH_POINTS, len(known))).astype(int)]
        return {
            'id': track.track_id,
            'class': track.class_name,
            'boxes': boxes,
            'interpolated': sum(status[word] for word in ADDED),
            'at': np.searchsorted(stamps_ns, track.stamps_ns),
            'states': ''.join(chr(ord('a') + STATES.index(word)) for word in track.status),
            'inputs': inputs,
            'owners': owners,
            'begin': int(track.stamps_ns[0] - stamps_ns[0]) * 1e-9,
            'seconds': float(track.stamps_ns[-1] - track.stamps_ns[0]) * 1e-9,
            'points': median(track.num_points),
            'near': self._near(),
            'refined': float(track.is_refined.sum() / boxes) if boxes else None,
            'status': dict(status),
            'reasons': dict(Counter(filter(None, track.reasons.tolist())).most_common()),
            'shift': track.shift,
            'turn': track.turn,
            'deviation': track.deviation,
            'flips': int(track.is_flipped.sum()),
            'extents': extents,
            'resized': float(np.abs(np.subtract(extents[0], extents[1])).max()),
            'before': asdict(self.before),
            'after': asdict(self.after),
            'path': np.round(track.boxes[picks][:, [X, Y]], 2),
            'rows': picks,
            'risk': round(self.source.risk.track, RISK_DECIMALS),
            'riskiest': str(track.stamps_ns[int(np.argmax(self.source.risk.boxes))]),
            'why': self.source.reasons,
            'added': _is_added(track),
        }

    def _near(self) -> float:
        """Return the median number of points near a box that are above its lower face."""
        known = np.where(np.isfinite(self._track.boxes), self._track.boxes, self._track.given)
        floor = known[:, Z] - known[:, HEIGHT] / 2 + GROUND_CLEARANCE
        pairs = zip(self.points, floor, strict=True)
        return median([float((points[:, Z] > lowest).sum()) for points, lowest in pairs])

    def part(self, begin_ns: int, max_points: int) -> dict[str, Any]:
        """Return all boxes of the track, with at most `max_points` points each."""
        track = self._track
        center = np.where(np.isfinite(track.boxes), track.boxes, track.given)[:, : Z + 1]
        origin = np.nan_to_num(np.append(center[np.isfinite(center[:, X])], [[0, 0, 0]], 0)[0])
        shown = []
        for middle, points in zip(center, self.points, strict=True):
            step = max(1, -(-len(points) // max_points))
            shown.append(to_millimetres(points[::step] - middle))
        every = np.concatenate([np.zeros((0, 3), np.int16), *shown])
        return {
            'origin': origin,
            'stamps': [str(stamp) for stamp in track.stamps_ns.tolist()],
            'times': np.round((track.stamps_ns - begin_ns) * 1e-9, DECIMALS),
            'given': _moved(track.given, origin),
            'boxes': _moved(track.boxes, origin),
            'truth': _moved(self.truth.boxes, origin),
            'iou': np.round([self.truth.iou_before, self.truth.iou_after], 3),
            'sensor': np.round(self.sensor - origin, 2),
            'status': track.status.tolist(),
            'reasons': track.reasons.tolist(),
            'flipped': track.is_flipped.tolist(),
            'change': np.round(track.change, DECIMALS),
            'deviations': np.round(track.deviations, DECIMALS),
            'extent_deviations': np.round(track.extent_deviations, DECIMALS),
            'risk': np.round(self.source.risk.boxes, RISK_DECIMALS),
            'disagreement': np.round(track.disagreement, 3),
            'faces': np.round(track.face_distances, 3),
            'near': track.near_points,
            'usual': [self.usual.outside, self.usual.sizes.get(track.class_name)],
            'num_points': track.num_points,
            'attributes': track.attributes,
            'counts': [len(points) for points in shown],
            'points': b64encode(every.astype('<i2').tobytes()).decode('ascii'),
        }


def _inputs_of(track: TrackChanges) -> tuple[list[str], list[int] | None]:
    """
    Return the ids that a track has in the input, and the index of that of each box.

    None where there is one id. Added boxes have that of the box before them.

    """
    ids = list(track.input_ids)
    known = next(filter(None, ids), track.track_id)
    for row, name in enumerate(ids):
        known = name or known
        ids[row] = known
    inputs = list(dict.fromkeys(ids))
    return inputs, [inputs.index(name) for name in ids] if len(inputs) > 1 else None


def _is_added(track: TrackChanges) -> bool:
    """Return whether a person has added the object: the input has none of its boxes."""
    return bool(np.isin(track.status, (*ADDED, HUMAN)).all() and np.isnan(track.given).all())


def _moved(boxes: Floats, origin: Floats) -> Floats:
    moved = boxes.copy()
    moved[:, : Z + 1] -= origin
    return np.round(moved, DECIMALS)


def _median_extents(boxes: Floats) -> list[float]:
    return [median(values) for values in boxes[:, BOX_EXTENT].T]
