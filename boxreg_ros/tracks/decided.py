"""What a person has decided, as the steps that complete tracks ask for it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

from boxreg_ros.core.follow import FollowedTrack
from boxreg_ros.structures import BoxArray, Floats, HUMAN
from boxreg_ros.tracks.tracklet import AddedBoxes, Tracklet
import numpy as np


class Decided(Protocol):
    """
    Decisions about boxes, named by the id that their track has in the input, and their stamp.

    They also hold for boxes that the input does not have, and that a step would add. What is not
    implemented is not decided.

    """

    @property
    def names(self) -> Collection[str]:
        """Return the ids that a person gave, or left to a part: each names one object."""
        return ()

    @property
    def apart(self) -> Collection[str]:
        """Return ids that were given, and that the input does not have: nothing joins them."""
        return ()

    def input_id(self, track_id: str, stamp_ns: int) -> str:
        """Return the id in the input of a box that is registered as one of `track_id`."""
        return track_id

    def track_id(self, input_id: str, stamp_ns: int) -> str:
        """Return the id that was given; empty for none."""
        return ''

    def class_name(self, input_id: str, stamp_ns: int) -> str:
        """Return the class that was given; empty for none."""
        return ''

    def has_own_class(self, input_id: str, stamp_ns: int) -> bool:
        """Return whether a class was given to the box, and not with its whole track."""
        return False

    def pause(self, track_id: str) -> float:
        """Return how long the ranges are whose boxes a person has deleted, together [s]."""
        return 0.0

    def is_left_out(self, input_id: str, stamp_ns: int) -> bool:
        """Return whether the box, which the input does not have, is deleted or rejected."""
        return False

    def is_accepted(self, input_id: str, stamp_ns: int) -> bool:
        """Return whether the box is accepted or pinned."""
        return False

    def pin(self, input_id: str, stamp_ns: int) -> Floats | None:
        """Return the box (9,) in the fixed frame that a person has set; None for none."""
        return None


class Nothing(Decided):
    """No decisions."""


NOTHING = Nothing()


@dataclass(frozen=True, slots=True)
class DecidedTrack:
    """
    The decisions about one track of the result.

    A box that the input does not have is named by the id of the box before it, in the page and
    here; before the first one, by the id of that.

    """

    track_id: str
    stamps_ns: tuple[int, ...]  # of its boxes of the input, ascending
    input_ids: tuple[str, ...]  # of these
    decided: Decided
    other_class: str  # of the boxes whose class no person has decided

    @classmethod
    def of(cls, tracklet: Tracklet, given: Sequence[BoxArray], decided: Decided) -> DecidedTrack:
        """
        Return the decisions about a tracklet of some arrays, as they were registered.

        A class given to some boxes of a track is of these alone: it has no vote on the others.

        """
        stamps_ns = tuple(tracklet.stamps_ns.tolist())
        arrays = [given[index] for index, _ in tracklet.places]
        rows = [row for _, row in tracklet.places]
        names = [array.track_ids[row] for array, row in zip(arrays, rows, strict=True)]
        input_ids = tuple(map(decided.input_id, names, stamps_ns))
        is_own = [*map(decided.has_own_class, input_ids, stamps_ns)]
        class_name = tracklet.class_name
        if any(is_own) and not all(is_own):
            free = (i for i, own in enumerate(is_own) if not own)
            votes = Counter(arrays[i].class_names[rows[i]] for i in free)
            class_name = votes.most_common(1)[0][0]
        return cls(tracklet.track_id, stamps_ns, input_ids, decided, class_name)

    @classmethod
    def of_followed(cls, track: FollowedTrack, decided: Decided) -> DecidedTrack:
        """Return the decisions about a track that was followed from at least one box."""
        pairs = zip(track.stamps_ns.tolist(), track.status, strict=True)
        stamps_ns = tuple(stamp_ns for stamp_ns, word in pairs if word == HUMAN)
        input_ids = tuple(decided.input_id(track.track_id, stamp) for stamp in stamps_ns)
        return cls(track.track_id, stamps_ns, input_ids, decided, track.class_name)

    def input_id(self, stamp_ns: int) -> str:
        """Return the id that names a box at a stamp."""
        row = int(np.searchsorted(self.stamps_ns, stamp_ns, 'right')) - 1
        return self.input_ids[max(row, 0)]

    def class_name(self, stamp_ns: int) -> str:
        """Return the class of the box at a stamp: that given to it, else that of the others."""
        return self.decided.class_name(self.input_id(stamp_ns), stamp_ns) or self.other_class

    def pin(self, stamp_ns: int) -> Floats | None:
        """Return the box that a person has set at a stamp; None for none."""
        return self.decided.pin(self.input_id(stamp_ns), stamp_ns)

    def is_accepted(self, added_ns: Iterable[int] = ()) -> bool:
        """Return whether a person has accepted, pinned or named a box, of the input or added."""
        return self.track_id in self.decided.names or any(
            self.decided.is_accepted(self.input_id(stamp_ns), stamp_ns)
            for stamp_ns in (*self.stamps_ns, *added_ns)
        )

    def is_left_out(self, stamp_ns: int) -> bool:
        """Return whether the box to add at a stamp is deleted or rejected."""
        return self.decided.is_left_out(self.input_id(stamp_ns), stamp_ns)

    def is_of_another(self, stamp_ns: int) -> bool:
        """Return whether the box at a stamp was given to another track, or left with it."""
        input_id = self.input_id(stamp_ns)
        name = self.decided.track_id(input_id, stamp_ns)
        is_before = stamp_ns < self.stamps_ns[0]  # where a track begins with a part of another
        if not name and (is_before or self.track_id in self.decided.apart):
            name = input_id
        return name not in ('', self.track_id)

    def left(self, boxes: AddedBoxes, is_extension: bool) -> AddedBoxes:
        """
        Return the boxes to add that no decision forbids.

        An extension ends where the boxes are of another track, and is none where its first box is
        deleted or rejected: that end of the track was cut off.

        """
        stamps_ns = boxes.stamps_ns.tolist()
        others = [self.is_of_another(stamp_ns) for stamp_ns in stamps_ns]
        left_out = [self.is_left_out(stamp_ns) for stamp_ns in stamps_ns]
        if is_extension and True in others:
            del left_out[others.index(True) :]
        if is_extension and left_out[:1] == [True]:
            left_out.clear()
        return boxes.take([i for i, gone in enumerate(left_out) if not (gone or others[i])])


def with_decisions(track: FollowedTrack, decided: Decided) -> FollowedTrack:
    """Return a followed track without boxes left out by a person, or given to another."""
    seeds = [i for i, word in enumerate(track.status) if word == HUMAN]
    if not seeds:
        return track
    stamps_ns = track.stamps_ns.tolist()
    of_track = DecidedTrack.of_followed(track, decided)
    is_other = np.array([of_track.is_of_another(stamp) for stamp in stamps_ns])
    is_other[seeds] = False
    rows = np.arange(len(stamps_ns))
    first = rows[is_other & (rows < seeds[0])].max(initial=-1) + 1
    end = rows[is_other & (rows > seeds[-1])].min(initial=len(rows))
    left = [
        i
        for i in range(first, end)
        if i in seeds or not (is_other[i] or of_track.is_left_out(stamps_ns[i]))
    ]
    return track.take(left)
