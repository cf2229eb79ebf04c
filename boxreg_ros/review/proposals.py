"""Objects that a run proposes and no box covers, for the page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from boxreg_ros.io.box_table import BoxTable

PROPOSALS = 'proposals.csv'


def proposals_of(out: Path) -> list[dict[str, Any]]:
    """
    Return stamp, class, box and points of the proposals of a result; none without its file.

    Raises RecordingError if the file is no table of boxes.

    """
    path = out / PROPOSALS
    if not path.is_file():
        return []
    table = BoxTable.read(path)
    columns = table.stamps_ns, table.class_names, table.boxes, table.num_points
    return [
        {'stamp': str(stamp), 'class': name, 'box': box.tolist(), 'points': int(points)}
        for stamp, name, box, points in zip(*columns, strict=True)
    ]
