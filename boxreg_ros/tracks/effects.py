"""What the completing steps do to a track: the boxes that they add, and their number."""

from __future__ import annotations

from dataclasses import dataclass

from boxreg_ros.structures import Floats, Ints


@dataclass(frozen=True, slots=True)
class AddedBoxes:
    """
    Successive boxes that a step adds to one track.

    Attributes
    ----------
    status : str
        ``interpolated`` or ``extended``.
    stamps_ns : array, shape (n,)
        Stamps [ns]; of an extension from the track outwards.
    boxes : array, shape (n, 9)
        On the motion model, in the fixed frame.
    covariances : array, shape (n, 6, 6)
        Of x y z roll pitch yaw on the motion model.
    scores : array, shape (n,)
        Detector confidence, from the neighbours.

    """

    status: str
    stamps_ns: Ints
    boxes: Floats
    covariances: Floats
    scores: Floats

    def first(self, count: int) -> AddedBoxes:
        """Return the first `count` of the boxes."""
        return AddedBoxes(
            self.status, self.stamps_ns[:count], self.boxes[:count], self.covariances[:count],
            self.scores[:count],
        )  # fmt: skip


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
