"""Boxes of a track that the input does not have."""

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
            self.status,
            self.stamps_ns[:count],
            self.boxes[:count],
            self.covariances[:count],
            self.scores[:count],
        )
