"""Columns of `tracks.csv` about the completing steps."""

from __future__ import annotations

from collections.abc import Sequence

from boxreg_ros.tracks.track_steps import TrackSteps

STEP_COLUMNS = ('fragments', 'filled', 'extended', 'rejected', 'reclassified', 'ambiguous')


def step_cells(tracks: Sequence[TrackSteps]) -> dict[str, list[int | str]]:
    """Return the cells of `STEP_COLUMNS` by track id."""
    return {
        track.track_id: [
            track.fragments,
            track.filled,
            track.extended,
            track.rejected,
            track.reclassified,
            ' '.join(track.ambiguous),
        ]
        for track in tracks
    }
