"""Solve one track of a report again, with the boxes that a person has pinned."""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
import re
from threading import Lock
from typing import Any
import zlib

from boxreg_ros.config import Config
from boxreg_ros.errors import RecordingError
from boxreg_ros.review.payload import as_json
from boxreg_ros.review.requests import box_of
from boxreg_ros.review.risk import risks_of_box
from boxreg_ros.review.track_points import MILLIMETRES
from boxreg_ros.structures import BOX_EXTENT, Floats, is_valid_box, LENGTH, Z
import numpy as np
import orjson

MAX_READ = 8
"""Tracks that stay read: a box is dragged step by step; chosen."""
PART = re.compile(rb'id="part-(\d+)">([^<]*)<')


class ReportParts:
    """
    The tracks of a report, and their registration.

    The points are those of the report, near the boxes of the track only. A run knows all of them
    and all other tracks: it is what decides.

    """

    def __init__(self, out: Path, page: bytes) -> None:
        self._config_path = out / 'config.yaml'
        self._texts = {int(number): text for number, text in PART.findall(page)}
        self._part = lru_cache(MAX_READ)(self._read_part)
        self._lock = Lock()

    def warm_up(self) -> None:
        """Solve a track, so that the next one need not wait for the compiled methods."""
        with suppress(Exception):
            self.solved({'class': 'car', 'pieces': [{'index': 0}], 'pins': {}})

    def solved(self, sent: Mapping[str, Any]) -> bytes:
        """
        Return the boxes of a track, solved again, as JSON; RecordingError without a usable box.

        It is sent as its ``class``; ``pieces``, with the ``index`` of a track in the report,
        ``begin`` and ``end`` stamp; and ``pins``: boxes (9,) in the fixed frame by stamp. With a
        stamp as ``near``, that of a box that is dragged, only the windows that have it are solved.
        The answer has ``stamps``, ``boxes`` (n, 9) in the fixed frame, and ``status``, of the
        input boxes.

        """
        from boxreg_ros.core.refine import refine, Track

        try:
            given = sent['pins'].items()
            pins = {int(stamp): np.array(box, np.float64).reshape(9) for stamp, box in given}
            rows = [row for piece in sent['pieces'] for row in self._rows(piece)]
            class_name = str(sent['class'])
            near = int(sent['near']) if 'near' in sent else None
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise RecordingError(f'solve: expected a track of the report, got: {error}') from None
        config = replace(Config.from_yaml(self._config_path), estimate='track')
        rows = _with_pins(sorted(rows, key=lambda row: row[0]), pins)
        if near is not None:
            middle = sum(row[0] < near for row in rows)
            rows = rows[max(0, middle - config.window + 1) : middle + config.window]
        if not rows:
            raise RecordingError('solve: expected a track with input boxes, got none')
        stamps, boxes, points, origins = zip(*rows, strict=True)
        track = Track(
            '1', class_name, np.array(stamps), np.array(boxes), points, np.array(origins),
            pinned=np.isin(stamps, list(pins)),
        )  # fmt: skip
        with self._lock:
            (found,) = refine([track], config)
        names = [str(stamp) for stamp in stamps]
        return as_json({'stamps': names, 'boxes': found.boxes, 'status': found.status})

    def risks(self, sent: Mapping[str, Any]) -> bytes:
        """
        Return the risk of a box as it is and as a person drags it [m], as JSON.

        It is sent as ``index`` of the track in the report, ``row`` of the box, ``class``, and the
        ``box`` (9) in the fixed frame. Raises RecordingError if the request is none.

        """
        box = box_of(sent.get('box'))
        if not is_valid_box(box):
            raise RecordingError('box: expected finite numbers and positive extents')
        try:
            part = self._part(int(sent['index']))
            row = range(len(part['stamps']))[int(sent['row'])]
            class_name = str(sent['class'])
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise RecordingError(f'risk: expected a box of the report, got: {error}') from None
        origin = np.array(part['origin'], np.float64)
        box[: Z + 1] -= origin
        _, points = self._points_of(part)[row]
        return as_json(risks_of_box(part, row, box, class_name, points))

    def _read_part(self, index: int) -> dict[str, Any]:
        found: dict[str, Any] = orjson.loads(zlib.decompress(b64decode(self._texts[index])))
        return found

    def _points_of(self, part: Mapping[str, Any]) -> list[tuple[Floats, Floats]]:
        """Return the input boxes (9,) and points (M, 3) of a part, relative to its origin."""
        offsets = np.frombuffer(b64decode(part['points']), '<i2').reshape(-1, 3) / MILLIMETRES
        ends = np.cumsum([0, *part['counts']])
        given, shown = (
            np.array(part[name], np.float64).reshape(-1, 9) for name in ('given', 'boxes')
        )
        centers = np.where(np.isfinite(shown), shown, given)[:, : Z + 1]
        return [
            (given[k], offsets[ends[k] : ends[k + 1]] + center) for k, center in enumerate(centers)
        ]

    def _rows(self, piece: Mapping[str, Any]) -> list[tuple[int, Floats, Floats, Floats]]:
        """Return the stamps, input boxes, points and sensor positions of a part of a track."""
        part = self._part(int(piece['index']))
        first = int(piece.get('begin') or part['stamps'][0])
        last = int(piece.get('end') or part['stamps'][-1])
        origin = np.array(part['origin'], np.float64)
        found = self._points_of(part)
        sensor = np.array(part['sensor'], np.float64) + origin
        rows = []
        for k, stamp in enumerate(map(int, part['stamps'])):
            box, points = found[k]
            if first <= stamp <= last and is_valid_box(box):
                box = np.append(box[: Z + 1] + origin, box[LENGTH:])
                rows.append((stamp, box, points + origin, sensor[k]))
        return rows


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
