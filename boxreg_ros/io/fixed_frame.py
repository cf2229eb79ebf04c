"""
The clouds and boxes of a recording in the fixed frame: the one way to read a recording.

`FixedFrameItems` confirms time jumps, moves every item and merges the clouds of several LiDARs.
`boxreg relabel` hands the items to the registrar; `calibrate`, `convert`, `evaluate` and
`measure real` read the same ones.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import cast, NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.io.items import Item, ItemSource, not_measured, Stage, Wanted
from boxreg_ros.io.lidars import CLOUD_LATE, CLOUD_MISSING, MergedSweep
from boxreg_ros.io.session import is_placeholder, Session
from boxreg_ros.io.time_jumps import Confirmed, JumpConfirmation
from boxreg_ros.io.transforms import inverse, sweep_to_frame
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import BoxArray, Floats, Sweep
from msg_adapters.convention import Convention, STANDARD
import numpy as np


class StoredCloud(NamedTuple):
    """A cloud for label files: its sweep, the pose of its frame, and intensities; see `Spool`."""

    sweep: Sweep
    T_fixed_sweep: Floats | None
    intensities: Floats | None


class FixedFrameItems:
    """
    Bring the items of an open recording into the fixed frame.

    It is the one that `source` chooses unless `fixed_frame` names another. Of `config`, `max_gap`
    and `merge_span` are used; `convention` also says whether ids are assigned; `stage` measures
    ``read``, ``decode`` and ``transform``; `ticket` makes that of each box array. `counts` has
    sweeps, box arrays, time jumps, clouds without a transform or whose LiDARs are not all known,
    and what has no stamp or one ahead; `missing_transforms` both clouds and box arrays.
    `first_missing_transform` and `first_unplaced` are the errors of the first ones.

    Raises RecordingError if no motion of the sensor is known, or no transforms lead to
    `fixed_frame`.

    """

    def __init__(
        self,
        source: ItemSource,
        config: Config,
        convention: Convention = STANDARD,
        fixed_frame: str | None = None,
        stage: Stage = not_measured,
        ticket: Callable[[], object] = lambda: None,
    ) -> None:
        self._source = source
        self._stage = stage
        self._ticket = ticket
        self._is_merging = len(source.placement.lidars.topics) > 1
        self._jumps = JumpConfirmation[Item]()
        self._restarts = False
        self.session = Session(convention, config, placement=source.placement)
        self.tree = self.session.tree
        with stage('read'):
            self.fixed_frame = source.choose_fixed_frame(self.tree, fixed_frame)
        self.session.fixed_frame = self.fixed_frame
        self.session.sensor_frame = source.sensor_frame()
        self.counts: Counter[str] = Counter()
        self.missing_transforms = 0
        self.first_missing_transform = ''
        self.first_unplaced = ''
        self.first_ahead = ''

    def read(self, *, with_clouds: bool = True, with_intensities: bool = False) -> Iterator[Item]:
        """
        Yield clouds and boxes in the order they were received; see `Recording.items`.

        Parameters
        ----------
        with_clouds : bool
            False leaves the clouds out, and saves decoding them.
        with_intensities : bool
            Whether items of clouds have the intensities of their points.

        Yields
        ------
        item : Item
            `moved` is its sweep or its boxes in the fixed frame; None, with a `reason`, without a
            transform or with a stamp ahead of all others, and None for an array without boxes that
            has no stamp or frame. The clouds of several LiDARs are one item with `parts`;
            `restarts` where time went back before it.

        """
        wanted = Wanted(with_clouds, with_intensities, self._stage)
        for item in self._source.items(self.tree, wanted):
            confirmed = Confirmed([item])
            if not is_placeholder(item.content):
                confirmed = self._jumps.add(item, item.content, item.received_ns)
            for ahead in confirmed.ahead:
                self._count_ahead(ahead)
                yield self._restarting(ahead._replace(reason=Reason.STAMP_AHEAD))
            if confirmed.has_jumped:
                yield from map(self._merged, self.session.unmerged())
                # The tree, which is ahead of the items, has detected the jump itself.
                self.tree.forget_before()
                self.session.restart()
                self.counts[Reason.TIME_JUMP] += 1
                self._restarts = True
            for ready in confirmed.items:
                yield from self._moved(ready)
        for late in self._jumps.release():
            yield from self._moved(late)
        yield from map(self._merged, self.session.unmerged())

    def pose_of(self, frame_id: str, stamp_ns: int) -> Floats | None:
        """Return the pose (4, 4) of a frame in the fixed frame at a stamp; None if unknown."""
        return self.tree.find(self.fixed_frame, frame_id, stamp_ns)

    def stored_cloud(self, item: Item, frame_id: str) -> StoredCloud:
        """
        Return a cloud for label files, with its times as moved.

        Parameters
        ----------
        item : Item
            Of a cloud, or of several that were merged, as of `read`.
        frame_id : str
            Frame of a merged cloud; a single one is in that of its message.

        Returns
        -------
        StoredCloud
            Its pose in the fixed frame is None where it is unknown: a merged cloud is then in the
            fixed frame. Intensities are None unless all of its parts have them.

        """
        moved = item.moved
        given = item.content
        assert isinstance(given, Sweep)
        if not isinstance(moved, Sweep):
            return StoredCloud(given, None, item.intensities)
        if len(item.parts) < 2:
            given = replace(given, times=moved.times)
            return StoredCloud(given, item.T_fixed_item, item.intensities)
        T_fixed_frame = self.pose_of(frame_id, moved.stamp_ns)
        if T_fixed_frame is not None:
            moved = sweep_to_frame(moved, inverse(T_fixed_frame), frame_id).in_frame()
        intensities = [part.intensities for part in item.parts]
        known = [values for values in intensities if values is not None]
        whole = np.concatenate(known) if len(known) == len(item.parts) else None
        return StoredCloud(moved, T_fixed_frame, whole)

    def left_out(self) -> str:
        """Return how many messages are not used so far, and why, in one line; empty if all are."""
        parts = []
        unreadable = self._source.unreadable.total()
        if unreadable:
            first = next(iter(self._source.first_errors.values()))
            parts.append(f'{unreadable} messages could not be read, first: {first}')
        if self.missing_transforms:
            parts.append(
                f'{self.missing_transforms} messages had no transform, first: '
                f'{self.first_missing_transform}'
            )
        for topic, counts in self.session.lidar_counts.items():
            if counts[CLOUD_LATE] or counts[CLOUD_MISSING]:
                parts.append(
                    f'LiDAR {topic}: {counts[CLOUD_LATE]} clouds late, '
                    f'{counts[CLOUD_MISSING]} missing'
                )
        if self.ahead:
            parts.append(self.ahead)
        if self.first_unplaced:
            parts.append(f'the LiDARs of some clouds are not known, first: {self.first_unplaced}')
        return '; '.join(parts)

    @property
    def ahead(self) -> str:
        """Return which stamps are in the future of the others, in one line; '' for none."""
        transforms = +self.tree.stamps_ahead
        number = self.counts[Reason.STAMP_AHEAD] + transforms.total()
        first = self.first_ahead or next(iter(transforms), '')
        reason = Reason.STAMP_AHEAD
        return (
            f'{reason} ({number:,} messages, first: {first}): {reason.meaning}' if number else ''
        )

    def _count_ahead(self, item: Item) -> None:
        """Count a cloud or boxes whose stamp is in the future of those before and after."""
        self.counts[Reason.STAMP_AHEAD] += 1
        name = 'clouds' if isinstance(item.content, Sweep) else 'boxes'
        self.first_ahead = self.first_ahead or f'{name} at {item.content.stamp_ns} ns'

    def _moved(self, item: Item) -> Iterator[Item]:
        """Yield an item in the fixed frame, or the sweeps that are complete with its cloud."""
        with self._stage('transform'):
            item = self.session.admit(item, self._ticket())
        self._count(item)
        if not self._is_merging or not isinstance(item.content, Sweep):
            yield self._restarting(item)
        elif isinstance(item.moved, Sweep):  # otherwise the other LiDARs go on
            with self._stage('transform'):
                complete = self.session.merged(item.moved, item)
            yield from map(self._merged, complete)

    def _merged(self, merged: MergedSweep) -> Item:
        """Return a sweep of several LiDARs."""
        self.counts['sweeps'] += 1
        parts = cast(tuple[Item, ...], merged.extras)
        whole = parts[0]._replace(
            received_ns=parts[-1].received_ns, moved=merged.sweep, parts=parts
        )
        if len(parts) > 1:
            whole = whole._replace(T_fixed_item=None)
        return self._restarting(whole)

    def _restarting(self, item: Item) -> Item:
        """Return the next item, with whether time went back before it."""
        restarts = self._restarts
        self._restarts = False
        return item._replace(restarts=restarts)

    def _count(self, item: Item) -> None:
        given = item.content
        kind = 'sweeps' if isinstance(given, Sweep) else 'box_arrays'
        # The time of a simulation begins at 0: its first message has a transform, and is used.
        is_unset = item.reason or self.counts[kind]
        if given.stamp_ns <= 0 and is_unset and not is_placeholder(given):
            self.counts[f'{kind}_without_stamp'] += 1
        if not (self._is_merging and isinstance(given, Sweep)):  # those are counted merged
            self.counts[kind] += 1
        if not item.reason:
            return
        if isinstance(given, Sweep):
            self.counts[item.reason] += 1
        if item.moved is None:
            self.missing_transforms += 1
            self.first_missing_transform = self.first_missing_transform or item.detail
        else:
            self.first_unplaced = self.first_unplaced or item.detail


def input_boxes(
    source: AbstractContextManager[ItemSource], fixed_frame: str | None = None
) -> tuple[list[BoxArray], str]:
    """
    Return the input boxes of a recording in the frame that `relabel` would choose.

    Parameters
    ----------
    source : context manager of ItemSource
        The recording, not open yet; it is closed at the end.
    fixed_frame : str, optional
        Frame to bring the boxes to, instead of the one that is chosen.

    Returns
    -------
    boxes : list of BoxArray
        In the order they were received, in the fixed frame [m, rad].
    left_out : str
        How many could not be decoded or transformed, and why; empty if there are none.

    Raises
    ------
    RecordingError
        If no motion of the sensor is known, or no transforms lead to `fixed_frame`.

    """
    with source as recording:
        items = FixedFrameItems(recording, Config(), fixed_frame=fixed_frame)
        moved = [item.moved for item in items.read(with_clouds=False)]
        others = items.left_out()
    return [boxes for boxes in moved if isinstance(boxes, BoxArray)], others
