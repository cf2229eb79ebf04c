"""What the benchmark commands share: which true boxes count, and lines of tables."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import math
from pathlib import Path

from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.evaluate import match, Matches


def add_scope_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what to measure on, and which of its true boxes count."""
    parser.add_argument(
        'data', type=Path, nargs='+', metavar='DATA', help='folder: one recording and truth.csv'
    )
    parser.add_argument(
        '--min-points', type=int, default=100, metavar='N',
        help='leave out true boxes with fewer points (default: 100)',
    )  # fmt: skip
    parser.add_argument(
        '--classes', nargs='+', default=['car', 'van', 'truck'], metavar='WORD',
        help='only true boxes whose class name holds one of these words (default: car van truck)',
    )  # fmt: skip


def in_scope(boxes: BoxTable, truth: BoxTable, args: argparse.Namespace) -> Matches:
    """Compare boxes with those true boxes that `add_scope_arguments` leaves in."""
    classes = [word for part in args.classes for word in part.split(',') if word]
    return match(boxes, truth, args.min_points, classes)


def line(name: str, row: Sequence[float | str] | str) -> str:
    """Return one line of a table."""
    if isinstance(row, str):
        return f'{name:22} {row}'
    cells = (
        value if isinstance(value, str) else '-' if math.isnan(value) else f'{value:.3f}'
        for value in row
    )
    return f'{name:22}' + ''.join(f'{cell:>9}' for cell in cells)
