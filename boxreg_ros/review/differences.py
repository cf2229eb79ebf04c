"""What changed between two results of one drive: those of a run before and after decisions."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.structures import REJECTED, Z
import numpy as np

SAME = 1e-3
"""Boxes that differ by less are the same [m, rad]; chosen: label formats round to millimetres."""


def differences(before: BoxTable, after: BoxTable) -> list[dict[str, Any]]:
    """
    Return what changed between two results.

    Parameters
    ----------
    before, after : BoxTable
        In one frame; rejected boxes are none.

    Returns
    -------
    rows : list of dict
        One for each track that changed, the most boxes first: ``id``; number of ``added``,
        ``removed`` and ``changed`` boxes; the largest ``shift`` of a centre [m]; ``class`` where
        that is another one, else empty.

    """
    old, new = _labels(before), _labels(after)
    found: dict[str, dict[str, Any]] = defaultdict(
        lambda: {'added': 0, 'removed': 0, 'changed': 0, 'shift': 0.0, 'class': ''}
    )
    for key in old.keys() - new.keys():
        found[key[0]]['removed'] += 1
    for key in new.keys() - old.keys():
        found[key[0]]['added'] += 1
    for key in old.keys() & new.keys():
        first, second = before.boxes[old[key]], after.boxes[new[key]]
        class_name = after.class_names[new[key]]
        if class_name != before.class_names[old[key]]:
            found[key[0]]['class'] = class_name
        if not np.allclose(first, second, rtol=0, atol=SAME, equal_nan=True):
            row = found[key[0]]
            row['changed'] += 1
            shift = float(np.linalg.norm(second[: Z + 1] - first[: Z + 1]))
            row['shift'] = max(row['shift'], round(shift, 3))
    rows = [{'id': name, **row} for name, row in found.items()]
    return sorted(
        rows, key=lambda row: (-row['added'] - row['removed'] - row['changed'], row['id'])
    )


def _labels(table: BoxTable) -> dict[tuple[str, int], int]:
    """Return the row of each label by track and stamp."""
    columns = table.track_ids, table.stamps_ns.tolist(), table.status
    rows = enumerate(zip(*columns, strict=True))
    return {(name, stamp): row for row, (name, stamp, status) in rows if status != REJECTED}
