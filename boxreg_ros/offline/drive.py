"""Sweeps, noisy boxes and true boxes of one drive, in memory and in one frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

from boxreg_ros.config import Config
from boxreg_ros.datasets.scene_recording import SceneRecording
from boxreg_ros.errors import RecordingError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.fixed_frame import FixedFrameItems
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.stamp_join import joined_stamps, nearest_rows
from boxreg_ros.structures import BoxArray, Ints, Sweep
import numpy as np

DEFAULTS = Config()
"""Settings by which clouds of several LiDARs are merged unless others are given."""


@dataclass(frozen=True, slots=True)
class Drive:
    """Sweeps and noisy boxes of one drive, in time order, in the frame of its true boxes."""

    sweeps: tuple[Sweep, ...]
    boxes: tuple[BoxArray, ...]  # noisy ones
    truth: BoxTable
    # messages that are not used, and why, and stamps of the truth that are not equal; else empty
    left_out: str = ''

    @classmethod
    def of(
        cls,
        recording: Recording | SceneRecording,
        truth: BoxTable,
        within: float | None = None,
        config: Config = DEFAULTS,
    ) -> Self:
        """
        Read a recording that is not open yet, in the frame of its true boxes.

        Messages that cannot be decoded or have no transform are left out.

        Parameters
        ----------
        recording : Recording or SceneRecording
            Is opened, read and closed.
        truth : BoxTable
            True boxes.
        within : float, optional
            Only sweeps so near to the stamp of a true box are held in memory [s]; by default all.
        config : Config
            Settings by which clouds of several LiDARs are merged.

        Returns
        -------
        drive : Drive
            The stamps of its truth are those of the boxes or clouds that they are meant for.

        Raises
        ------
        RecordingError
            If the recording has no sweeps, cannot be read, or no transforms connect it with the
            frame of `truth`.

        """
        sweeps: list[Sweep] = []
        boxes: list[BoxArray] = []
        has_sweeps = False
        with recording:
            items = FixedFrameItems(recording, config, fixed_frame=truth.frame_id)
            for item in items.read():
                moved = item.moved
                if isinstance(moved, BoxArray):
                    boxes.append(moved)
                if not isinstance(moved, Sweep):
                    continue
                has_sweeps = True
                away_ns = np.abs(truth.stamps_ns - moved.stamp_ns)
                if within is None or (away_ns <= within * 1e9).any():
                    sweeps.append(moved)
            others = items.left_out()
        if not has_sweeps:
            reason = f': {others}' if others else ''
            raise RecordingError(f'{recording}: expected sweeps, got none{reason}')
        joined = joined_stamps(
            truth.stamps_ns, np.array([item.stamp_ns for item in boxes or sweeps], np.int64)
        )
        finding = joined.finding('the true boxes', 'the boxes' if boxes else 'the clouds')
        return cls(
            tuple(sorted(sweeps, key=lambda sweep: sweep.stamp_ns)),
            tuple(sorted(boxes, key=lambda array: array.stamp_ns)),
            replace(truth, stamps_ns=joined.stamps_ns),
            '; '.join(filter(None, (others, finding))),
        )

    def sweeps_at(self, stamps_ns: Ints) -> list[Sweep]:
        """Return the sweep nearest in time to each stamp."""
        own = np.array([sweep.stamp_ns for sweep in self.sweeps])
        return [self.sweeps[row] for row in nearest_rows(stamps_ns, own)]
