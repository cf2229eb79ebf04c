"""Solve one track of a report again, with the boxes that a person has pinned."""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
import re
from threading import Lock
from typing import Any
import zlib

from boxreg_ros.config import Config
from boxreg_ros.errors import RecordingError
from boxreg_ros.review.payload import as_json
from boxreg_ros.review.track_points import MILLIMETRES
from boxreg_ros.structures import BOX_EXTENT, Floats, is_valid_box, Z
import numpy as np
import orjson

PART = re.compile(rb'id="part-(\d+)">([^<]*)<')


class ReportParts:
    """
    The tracks of a report, and their registration.

    The points are those of the report, near the boxes of the track only. A run knows all of them
    and all other tracks: it is what decides.

    Parameters
    ----------
    out : Path
        Result folder: its settings hold.
    page : bytes
        The report.

    """

    def __init__(self, out: Path, page: bytes) -> None:
        self._config_path = out / 'config.yaml'
        self._texts = {int(number): text for number, text in PART.findall(page)}
        self._lock = Lock()

    def warm_up(self) -> None:
        """Solve a track, so that the next one need not wait for the compiled methods."""
        with suppress(Exception):
            self.solved({'class': 'car', 'pieces': [{'index': 0}], 'pins': {}})

    def solved(self, sent: Mapping[str, Any]) -> bytes:
        """
        Return the boxes of a track, solved again, as JSON.

        Parameters
        ----------
        sent : mapping
            ``class`` of the track; its ``pieces``: the ``index`` of a track in the report,
            ``begin`` and ``end`` stamp; ``pins``: boxes (9,) in the fixed frame by stamp.

        Returns
        -------
        found : bytes
            ``stamps``, ``boxes`` (n, 9) in the fixed frame, and ``status``, of the input boxes.

        Raises
        ------
        RecordingError
            If the request is none, or the track has no usable box.

        """
        from boxreg_ros.core.refine import refine, Track

        try:
            given = sent['pins'].items()
            pins = {int(stamp): np.array(box, np.float64).reshape(9) for stamp, box in given}
            rows = [row for piece in sent['pieces'] for row in self._rows(piece)]
            class_name = str(sent['class'])
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise RecordingError(f'solve: expected a track of the report, got: {error}') from None
        rows = _with_pins(sorted(rows, key=lambda row: row[0]), pins)
        if not rows:
            raise RecordingError('solve: expected a track with input boxes, got none')
        stamps, boxes, points, origins = zip(*rows, strict=True)
        track = Track(
            '1', class_name, np.array(stamps), np.array(boxes), points, np.array(origins),
            pinned=np.isin(stamps, list(pins)),
        )  # fmt: skip
        with self._lock:
            (found,) = refine([track], self._config())
        names = [str(stamp) for stamp in stamps]
        return as_json({'stamps': names, 'boxes': found.boxes, 'status': found.status})

    def _config(self) -> Config:
        return replace(Config.from_yaml(self._config_path), estimate='track')

    def _rows(self, piece: Mapping[str, Any]) -> list[tuple[int, Floats, Floats, Floats]]:
        """Return the stamps, input boxes, points and sensor positions of a part of a track."""
        part = orjson.loads(zlib.decompress(b64decode(self._texts[int(piece['index'])])))
        first = int(piece.get('begin') or part['stamps'][0])
        last = int(piece.get('end') or part['stamps'][-1])
        origin = np.array(part['origin'], np.float64)
        offsets = np.frombuffer(b64decode(part['points']), '<i2').reshape(-1, 3) / MILLIMETRES
        ends = np.cumsum([0, *part['counts']])
        given, shown = (_boxes_of(part[name], origin) for name in ('given', 'boxes'))
        sensor = np.array(part['sensor'], np.float64) + origin
        rows = []
        for k, stamp in enumerate(map(int, part['stamps'])):
            if first <= stamp <= last and is_valid_box(given[k]):
                center = np.where(np.isfinite(shown[k]), shown[k], given[k])[: Z + 1]
                points = offsets[ends[k] : ends[k + 1]] + center
                rows.append((stamp, given[k], points, sensor[k]))
        return rows


def _boxes_of(values: Sequence[Any], origin: Floats) -> Floats:
    """Return boxes (n, 9) of a report in the fixed frame; NaN where unknown."""
    boxes = np.array(values, np.float64).reshape(-1, 9)
    boxes[:, : Z + 1] += origin
    return boxes


def _with_pins(
    rows: list[tuple[int, Floats, Floats, Floats]], pins: Mapping[int, Floats]
) -> list[tuple[int, Floats, Floats, Floats]]:
    """Return rows, one for each stamp, with pinned boxes and with their extents in all boxes."""
    extent = np.mean([box[BOX_EXTENT] for box in pins.values()], axis=0) if pins else None
    found: dict[int, tuple[int, Floats, Floats, Floats]] = {}
    for stamp, given, points, sensor in rows:
        box = pins.get(stamp, given).copy()
        if extent is not None and stamp not in pins:
            box[BOX_EXTENT] = extent
        found.setdefault(stamp, (stamp, box, points, sensor))
    return list(found.values())
