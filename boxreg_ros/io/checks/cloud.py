"""Check of clouds as they are given: unit, rounding, and whether each is a whole sweep."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from boxreg_ros.io.checks.motion import LOOK_PERIOD
from boxreg_ros.structures import Sweep
import numpy as np
from numpy.typing import NDArray

MAX_ROUNDING = 0.02
"""Step between coordinates from which they are named as coarse [m]; chosen: the range noise."""
UNIT_POINTS = 100
"""Points of a cloud that its unit is looked up by; chosen."""
MAX_MEDIAN_DISTANCE = 200.0
"""
Median distance of points from their middle that no LiDAR on the ground has [m].

Chosen: clouds of a street have 4 to 60; in centimetres 400 to 6000.

"""
SECTORS = 72
"""Parts of the azimuth that a cloud may cover; chosen: 5 degrees."""
PACKET_CLOUDS = 30
"""Clouds by which it is seen whether each is a whole sweep; chosen: packets are 10 or more."""
MIN_PACKETS = 3
"""Clouds that a revolution is split into, at least; chosen: two LiDARs may share a frame."""
SAME_VIEW = 0.5
"""Part of the sectors of two clouds that both have, from which they see the same; chosen: half."""
PERIOD_QUANTILE = 0.8
"""Quantile of the steps between clouds that is a period; derived: up to four LiDARs on a topic."""
SHORT_STEP, SHORT_SHARE = 0.25, 0.4
"""Steps of so many periods are short, and so large a part of them is no jitter; chosen."""
LONGEST_CLOUD_PERIOD = 0.1
"""Period that is taken for a longer one [s]: of a LiDAR clouds are lost, or left out, then."""
MIN_OF_FRAME = 3
"""Clouds of a frame that make it one of a LiDAR; chosen: a frame may be named late."""
ON_ONE_TOPIC = (
    'several LiDARs publish on one topic, and a box takes the points of one cloud; give each a '
    'topic of its own (Livox: multi_topic 1) and name them by --points (node: points), or join '
    'the clouds of each time in a copy of the recording'
)
"""What is wrong with such clouds, and how it is mended."""


class CloudCheck:
    """
    Collect what is wrong with the clouds of a recording or stream, in the frame of their message.

    With `is_merged` the clouds of several LiDARs are joined, each of which may see a sector only.

    """

    def __init__(self, is_merged: bool) -> None:
        self._is_merged = is_merged
        self._coordinates = ''
        self._count = 0
        self._sectors: list[NDArray[np.bool_]] = []
        self._stamps_ns: list[int] = []
        self._frames: Counter[str] = Counter()

    def add(self, sweep: Sweep) -> None:
        """Add a cloud in its own frame."""
        if not self._is_merged and len(self._sectors) < PACKET_CLOUDS:
            sectors = _sectors(sweep)
            self._frames[sweep.frame_id] += 1
            is_again = self._stamps_ns[-1:] == [sweep.stamp_ns]
            if not (is_again and np.array_equal(sectors, self._sectors[-1])):
                self._sectors.append(sectors)
                self._stamps_ns.append(sweep.stamp_ns)
        if self._count % LOOK_PERIOD == 0:
            self._coordinates = self._coordinates or _unit_text(sweep) or _coarse_text(sweep)
        self._count += 1

    @property
    def findings(self) -> list[str]:
        """Return what was found so far."""
        parts = _frames_text(self._frames)
        if not parts and len(self._sectors) == PACKET_CLOUDS:
            seen = self._sectors
            parts = _lidars_text(self._stamps_ns) or _packets_text(seen) or _turns_text(seen)
        return [text for text in (parts, self._coordinates) if text]


def _coarse_text(sweep: Sweep) -> str:
    """Return that the coordinates of a cloud are rounded to centimetres; empty if they are not."""
    if sweep.points.dtype != np.float32 or not len(sweep.points):
        return ''
    away = np.abs(sweep.points[::100]).max(axis=1)
    # A far origin is that of all, but for some that a driver writes in place of no return.
    largest = np.partition(away, len(away) // 10)[len(away) // 10]
    step = float(np.spacing(largest))
    if not MAX_ROUNDING <= step < np.inf:
        return ''
    return (
        f'clouds in {sweep.frame_id!r} have coordinates of {largest:.7g} m as float32, which '
        f'are {step:.2g} m apart there: points and boxes are as coarse; take the clouds '
        f'before their registration, in the frame of the LiDAR, or of a map with a near origin'
    )


def _unit_text(sweep: Sweep) -> str:
    """Return that the points of a cloud lie too far from each other to be in metres, or ''."""
    points = sweep.points[:: max(1, len(sweep.points) // UNIT_POINTS)]
    if len(points) < UNIT_POINTS or np.ptp(points) < MAX_MEDIAN_DISTANCE / 2:
        return ''  # as most clouds in the frame of their LiDAR: a look at one number
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < UNIT_POINTS or np.linalg.norm(np.ptp(points, axis=0)) < MAX_MEDIAN_DISTANCE:
        return ''  # as most clouds: none is so far from another
    distance = np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1))
    if distance < MAX_MEDIAN_DISTANCE:
        return ''
    return (
        f'clouds in {sweep.frame_id!r}: expected metres, got points of which half are more than '
        f'{distance:.0f} from their middle: they are in millimetres (or centimetres); divide '
        f'x, y and z by 1000 (or 100), in the driver or in a copy of the recording'
    )


def _sectors(sweep: Sweep) -> NDArray[np.bool_]:
    """Return in which of `SECTORS` of azimuth about the LiDAR a cloud in its frame has points."""
    angles = np.arctan2(sweep.points[:, 1], sweep.points[:, 0])
    places = ((angles / (2 * np.pi) + 0.5) * SECTORS)[np.isfinite(angles)].astype(int)
    return np.bincount(places.clip(0, SECTORS - 1), minlength=SECTORS) > 0


def _packets_text(seen: Sequence[NDArray[np.bool_]]) -> str:
    """Return that each of some clouds has a part of a revolution; '' if each covers the same."""
    each = float(np.median([_extent(one) for one in seen]))
    together = _extent(np.any(seen, axis=0))
    if not 0 < each * MIN_PACKETS <= together:
        return ''
    degrees = 360 / SECTORS
    return (
        f'clouds: expected a whole sweep in each, got parts of it: each covers about '
        f'{each * degrees:.0f} degrees of azimuth, and {len(seen)} together '
        f'{together * degrees:.0f}: most boxes have no points in the cloud of their time; join '
        f'the clouds of each revolution, by the setting of the driver, or in a copy of the '
        f'recording, with the times of the points'
    )


def _turns_text(seen: Sequence[NDArray[np.bool_]]) -> str:
    """Return that two views take turns in some clouds; '' if each sees what the one before did."""

    def overlap(steps: int) -> float:
        pairs = zip(seen, seen[steps:], strict=False)
        return float(np.median([(a & b).sum() / max(1, (a | b).sum()) for a, b in pairs]))

    if not overlap(1) < SAME_VIEW <= overlap(2):
        return ''
    degrees = [360 / SECTORS * _extent(one) for one in (seen[0], seen[1], seen[0] | seen[1])]
    return (
        f'clouds: expected all of a view in each, got two by turns, of about {degrees[0]:.0f} and '
        f'{degrees[1]:.0f} degrees of azimuth, {degrees[2]:.0f} together: the boxes in one have '
        f'no points in clouds of the other; {ON_ONE_TOPIC}'
    )


def _frames_text(clouds: Counter[str]) -> str:
    """Return that some clouds, counted by frame, are of several LiDARs; '' if of one."""
    frames = [repr(name) for name, count in clouds.items() if count >= MIN_OF_FRAME]
    if len(frames) < 2:
        return ''
    return f'clouds: expected those of one frame, got {" and ".join(frames)}: {ON_ONE_TOPIC}'


def _lidars_text(stamps_ns: Sequence[int]) -> str:
    """Return that clouds with these stamps [ns] come several at a time; '' if one by one."""
    steps = np.diff(np.sort(np.array(stamps_ns))) * 1e-9
    period = float(np.quantile(steps, PERIOD_QUANTILE))
    share = float((steps < SHORT_STEP * min(period, LONGEST_CLOUD_PERIOD)).mean())
    if share < SHORT_SHARE:
        return ''
    return (
        f'clouds: expected one every {period:.3f} s, got {1 / (1 - share):.0f} at a time: '
        f'{ON_ONE_TOPIC}'
    )


def _extent(occupied: NDArray[np.bool_]) -> int:
    """Return the number of sectors from the first to the last occupied one, around the circle."""
    rows = np.flatnonzero(occupied)
    if not len(rows):
        return 0
    return SECTORS + 1 - int(np.diff(rows, append=rows[0] + SECTORS).max())
