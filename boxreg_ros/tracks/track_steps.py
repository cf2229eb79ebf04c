"""The effects of the completing steps on one track."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class TrackSteps:
    """
    Effects of the completing steps on one track.

    Attributes
    ----------
    track_id, class_name : str
        Id, and the class of all its boxes: the most frequent one of the input.
    fragments : int
        Parts that were joined; 1 if none.
    filled, extended, rejected, reclassified : int
        Number of boxes added in gaps and at the ends, rejected, and of another class before.
    ambiguous : tuple of str
        Tracks that may be the same object, but were left alone.

    """

    track_id: str
    class_name: str
    fragments: int = 1
    filled: int = 0
    extended: int = 0
    rejected: int = 0
    reclassified: int = 0
    ambiguous: tuple[str, ...] = ()
