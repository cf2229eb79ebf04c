"""
From tracks to whole tracks: stitch, join parked ones, prune, fill and extend.

All steps work on tables of boxes, so a recording is read twice and its points are never held: the
first pass registers the input, `complete` makes a plan from the results, and the second pass
registers the completed tracks. Only then does the last step, the end of each extension, follow
from the points.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from boxreg_ros.config import Config
from boxreg_ros.core.id_switches import by_id, id_switches
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import (
    BoxArray,
    concatenated,
    EXTENDED,
    Floats,
    HUMAN,
    INTERPOLATED,
    Ints,
    is_valid_box,
    KEPT,
    RefinedBoxes,
    with_rejected,
    Y,
)
from boxreg_ros.tracks.decided import Decided, DecidedTrack, NOTHING
from boxreg_ros.tracks.extend import extend, num_free, num_supported, points_at_end
from boxreg_ros.tracks.fill import fill, rarely_detected
from boxreg_ros.tracks.prune import duplicates, ghosts
from boxreg_ros.tracks.static import join_static
from boxreg_ros.tracks.stitch import join_turns, stitch
from boxreg_ros.tracks.tracklet import AddedBoxes, Tracklet, tracklets_of
import numpy as np


@dataclass(slots=True)
class TrackSteps:
    """Effects of the completing steps on one track: numbers of boxes, but for `fragments`."""

    track_id: str
    class_name: str  # of all its boxes: the most frequent one of the input
    fragments: int = 1  # parts that were joined
    filled: int = 0  # added in gaps
    unfilled: int = 0  # not added there: the track is `rarely_detected`
    extended: int = 0  # added at the ends
    rejected: int = 0
    reclassified: int = 0  # of another class before
    ambiguous: tuple[str, ...] = ()  # tracks that may be the same object, but were left alone


@dataclass(frozen=True, slots=True)
class AddedBox:
    """A box to add to an array; `extension` is the index of its extension in the plan, or -1."""

    track_id: str
    class_name: str
    status: str
    box: Floats
    covariance: Floats
    score: float
    extension: int = -1


@dataclass(slots=True)
class PlannedArray:
    """The boxes of one array after completion."""

    track_ids: list[str]  # n, of the input boxes
    class_names: list[str]  # n
    rejected: dict[int, str] = field(default_factory=dict)  # reason by row
    added: list[AddedBox] = field(default_factory=list)
    # to register in place of those of the input, by row
    moved: dict[int, Floats] = field(default_factory=dict)

    def to_register(self, given: BoxArray) -> BoxArray:
        """Return the boxes of an array without rejected ones, and with the added ones."""
        added = self.added_boxes(given)
        boxes = given.boxes.copy()
        for row, box in self.moved.items():
            boxes[row] = box
        has_pins = any(one.status == HUMAN for one in self.added)
        pinned = given.is_pinned if has_pins else given.pinned
        own = replace(self.renamed(given), boxes=boxes, pinned=pinned, attributes=())
        rows = [row for row in range(len(boxes)) if row not in self.rejected]
        return concatenated([own.take(rows), added])

    def added_boxes(self, given: BoxArray) -> BoxArray:
        """Return the boxes that are added to an array."""
        return replace(
            given,
            track_ids=tuple(one.track_id for one in self.added),
            class_names=tuple(one.class_name for one in self.added),
            scores=np.array([one.score for one in self.added]),
            boxes=np.array([one.box for one in self.added]).reshape(-1, 9),
            pinned=np.array([one.status == HUMAN for one in self.added], bool),
            attributes=(),
            kinematics=None,
        )

    def renamed(self, given: BoxArray) -> BoxArray:
        """Return the boxes of an array with their new ids and classes."""
        names = tuple(self.track_ids), tuple(self.class_names)
        return replace(given, track_ids=names[0], class_names=names[1])


@dataclass(frozen=True, slots=True)
class _Extension:
    """Candidates of one end of a track: stamps from the track outwards, and points at the end."""

    track_id: str
    stamps_ns: Ints
    at_end: Ints


@dataclass(slots=True)
class CompletionPlan:
    """The completed tracks of a recording."""

    arrays: list[PlannedArray]  # one per box array of the input
    tracks: list[TrackSteps]  # `extended` is known after `finished`
    extensions: list[_Extension] = field(default_factory=list)

    def finished(
        self,
        given: Sequence[BoxArray],
        registered: Sequence[RefinedBoxes],
        num_points: Sequence[Ints],
    ) -> list[RefinedBoxes]:
        """
        Return the results with rejected boxes, and without extensions that no points support.

        Parameters
        ----------
        given : sequence of BoxArray
            Those that the plan was made for, in its order.
        registered : sequence of RefinedBoxes
            The results of `PlannedArray.to_register` of each.
        num_points : sequence of array, shape (m,)
            Points above the road in each of the m boxes of an array that were registered.

        Returns
        -------
        results : list of RefinedBoxes
            One per array: the boxes of the input in their order, rejected ones with the status
            ``rejected``, then the added ones.

        """
        supported = self._supported(given, num_points)
        steps = {track.track_id: track for track in self.tracks}
        finished = []
        for index, array in enumerate(self.arrays):
            keep = [
                added.extension < 0 or given[index].stamp_ns in supported[added.extension]
                for added in array.added
            ]
            for added, is_kept in zip(array.added, keep, strict=True):
                steps[added.track_id].extended += is_kept and added.status == EXTENDED
                steps[added.track_id].filled += added.status == INTERPOLATED
            finished.append(
                _finished(array, given[index], registered[index], num_points[index], keep)
            )
        return finished

    def append(self, other: CompletionPlan) -> None:
        """Append the plan of a later part of the recording."""
        offset = len(self.extensions)
        for array in other.arrays:
            array.added = [
                replace(added, extension=added.extension + offset)
                if added.extension >= 0
                else added
                for added in array.added
            ]
        self.arrays += other.arrays
        self.tracks += other.tracks
        self.extensions += other.extensions

    def add(self, other: CompletionPlan, first: int) -> None:
        """Add the boxes of a plan for the same arrays, from the one with the index `first` on."""
        for array, more in zip(self.arrays[first:], other.arrays, strict=False):
            array.added += more.added
        self.tracks += other.tracks

    def _supported(self, given: Sequence[BoxArray], num_points: Sequence[Ints]) -> list[set[int]]:
        """Return the stamps of the boxes of each extension that points support."""
        points: list[dict[int, int]] = [{} for _ in self.extensions]  # by stamp
        for array, boxes, counts in zip(self.arrays, given, num_points, strict=True):
            of_added = counts[len(counts) - len(array.added) :].tolist()
            for added, count in zip(array.added, of_added, strict=True):
                if added.extension >= 0:
                    points[added.extension][boxes.stamp_ns] = count
        found = []
        for extension, count_at in zip(self.extensions, points, strict=True):
            outwards = [count_at[stamp_ns] for stamp_ns in extension.stamps_ns.tolist()]
            count = num_supported(np.array(outwards), extension.at_end)
            found.append(set(extension.stamps_ns[:count].tolist()))
        return found


def unchanged_plan(given: Sequence[BoxArray]) -> CompletionPlan:
    """Return the plan that changes nothing in some arrays."""
    return CompletionPlan([PlannedArray([*a.track_ids], [*a.class_names]) for a in given], [])


def complete(
    given: Sequence[BoxArray],
    results: Sequence[RefinedBoxes],
    num_points: Sequence[Ints],
    fixed_frame: str,
    config: Config,
    decided: Decided = NOTHING,
) -> CompletionPlan:
    """
    Plan the completed tracks of a recording: the boxes to register in the second pass.

    What a person has decided binds each step.

    Parameters
    ----------
    given : sequence of BoxArray
        All arrays of the input, one per stamp. Those outside of the fixed frame stay as they are.
    results : sequence of RefinedBoxes
        The registration of each of them.
    num_points : sequence of array, shape (n,)
        Points above the road in each of the n boxes of an array.
    fixed_frame : str
        Frame of the tracks.
    config : Config
        Its group `complete` says which steps are taken.
    decided : Decided
        The decisions of a person, by default none.

    Returns
    -------
    plan : CompletionPlan
        For the arrays `given`, in their order.

    """
    return _Completer(given, fixed_frame, config, decided).completed(results, num_points)


@dataclass(eq=False, repr=False)
class _Completer:
    """The steps, with the input, the decisions and the plan that all of them share."""

    given: Sequence[BoxArray]
    fixed_frame: str
    config: Config
    decided: Decided

    def __post_init__(self) -> None:
        """Begin with a plan that changes nothing."""
        self._plan = unchanged_plan(self.given)
        self._of_track: dict[str, DecidedTrack] = {}
        self._array_of = _array_of_stamp(self.given, self.fixed_frame)
        self._stamps_ns = np.array(sorted(self._array_of), np.int64)

    def completed(
        self, results: Sequence[RefinedBoxes], num_points: Sequence[Ints]
    ) -> CompletionPlan:
        """Return the plan, from the results of the input."""
        config, decided = self.config, self.decided
        steps = config.complete
        if steps.stitch:
            results = self._exchanged(results)
        tracks = tracklets_of(
            results, num_points, self.fixed_frame, config, decided.names, decided.pause
        )
        if steps.prune:  # first: a duplicate could be stitched to its object
            tracks = self._rejected(tracks, duplicates(tracks, config), Reason.DUPLICATE)
        ambiguous: list[tuple[str, str]] = []
        if steps.stitch:
            tracks, left = join_turns(tracks, config, decided)
            self._rejected(left, {one.track_id for one in left}, Reason.DUPLICATE)
            tracks, ambiguous = stitch(tracks, config, decided)
        if steps.static:
            tracks = join_static(tracks, config, decided)
        if steps.prune:  # last: a fragment of an object may look like a ghost
            tracks = self._rejected(tracks, ghosts(tracks), Reason.GHOST)
        for track in tracks:
            self._of_track[track.track_id] = DecidedTrack.of(track, self.given, decided)
            self._place(track)
        if steps.fill:
            self._fill(tracks)
        if steps.extend:
            self._extend(tracks)
        _note_ambiguous(self._plan, ambiguous)
        return self._plan

    def _exchanged(self, results: Sequence[RefinedBoxes]) -> Sequence[RefinedBoxes]:
        """Return results with the ids back that tracks have exchanged, but for named tracks."""
        every = BoxTable.from_arrays(self._arrays())
        is_free = np.array([name not in self.decided.names for name in every.track_ids], bool)
        table = every.rows(is_valid_box(every.boxes) & is_free)
        found = id_switches(by_id(table.track_ids, table.stamps_ns, table.boxes[:, : Y + 1]))
        exchanged = []
        for result in results:
            ids = result.boxes.track_ids
            for switch in reversed(found):
                ids = tuple(switch.exchanged(name, result.boxes.stamp_ns) for name in ids)
            exchanged.append(replace(result, boxes=replace(result.boxes, track_ids=ids)))
        return exchanged

    def _arrays(self) -> list[BoxArray]:
        """Return the arrays of the input in the fixed frame."""
        return [array for array in self.given if array.frame_id == self.fixed_frame]

    def _is_held(self, track: Tracklet) -> bool:
        """Return whether a person has accepted a track, or given it a box in the input."""
        pinned = (self.given[index].is_pinned[row] for index, row in track.places)
        return DecidedTrack.of(track, self.given, self.decided).is_accepted() or any(pinned)

    def _rejected(
        self, tracks: Sequence[Tracklet], names: set[str], reason: str
    ) -> list[Tracklet]:
        """Reject those of `names` that no person holds; return the other tracks."""
        left = []
        for track in tracks:
            if track.track_id in names and not self._is_held(track):
                self._place(track, reason)
            else:
                left.append(track)
        return left

    def _place(self, track: Tracklet, reason: str = '') -> None:
        """
        Write id and class of a track to its input boxes; reject them where there is a reason.

        Boxes whose class a person has decided keep it, unless they are rejected.

        """
        steps = TrackSteps(track.track_id, track.class_name, track.fragments)
        own = self._of_track.get(track.track_id)
        for (index, row), stamp_ns in zip(track.places, track.stamps_ns.tolist(), strict=True):
            array = self._plan.arrays[index]
            class_name = track.class_name if own is None else own.class_name(stamp_ns)
            steps.reclassified += array.class_names[row] != class_name
            array.track_ids[row] = track.track_id
            array.class_names[row] = class_name
            if reason:
                array.rejected[row] = reason
                steps.rejected += 1
        self._plan.tracks.append(steps)

    def _add(self, boxes: AddedBoxes, track: Tracklet, extension: int = -1) -> None:
        """Add boxes of a track to the arrays of their stamps, as a person has set them."""
        own = self._of_track[track.track_id]
        for i, stamp_ns in enumerate(boxes.stamps_ns.tolist()):
            pin = own.pin(stamp_ns)
            self._plan.arrays[self._array_of[stamp_ns]].added.append(
                AddedBox(
                    track.track_id,
                    own.class_name(stamp_ns),
                    boxes.status if pin is None else HUMAN,
                    boxes.boxes[i] if pin is None else pin,
                    boxes.covariances[i],
                    float(boxes.scores[i]),
                    extension if pin is None else -1,
                )
            )

    def _fill(self, tracks: Sequence[Tracklet]) -> None:
        """Add the missing boxes of tracks; of rarely detected ones those of a person alone."""
        detected = [one.stamp_ns for one in self._arrays() if len(one.boxes)]
        rare = rarely_detected(tracks, np.unique(np.array(detected, np.int64)), self.config)
        steps = {one.track_id: one for one in self._plan.tracks}
        for track in tracks:
            own = self._of_track[track.track_id]
            gaps = [
                own.left(gap, is_extension=False)
                for gap in fill(track, self._stamps_ns, self.config)
            ]
            missing_ns = [stamp_ns for gap in gaps for stamp_ns in gap.stamps_ns.tolist()]
            is_rare = track.track_id in rare and not self._is_held(track)
            if is_rare and not own.is_accepted(missing_ns):
                steps[track.track_id].unfilled = len(missing_ns)
                continue
            for gap in gaps:
                self._add(gap, track)

    def _extend(self, tracks: Sequence[Tracklet]) -> None:
        """Add the candidates of all extensions, as far as no other track owns their place."""
        owned: dict[int, list[Floats]] = {}
        for track in tracks:
            for stamp_ns, box in zip(track.stamps_ns.tolist(), track.boxes, strict=True):
                owned.setdefault(stamp_ns, []).append(box)
        for stamp_ns, index in self._array_of.items():
            added = self._plan.arrays[index].added
            owned.setdefault(stamp_ns, []).extend(one.box for one in added)
        extensions = self._plan.extensions
        for track in tracks:
            own = self._of_track[track.track_id]
            for candidates in extend(track, self._stamps_ns, self.config):
                first = candidates.take(range(num_free(candidates, owned)))
                free = own.left(first, is_extension=True)
                if not len(free.boxes):
                    continue
                is_last = int(free.stamps_ns[0]) > track.last_ns
                is_open = [own.pin(stamp_ns) is None for stamp_ns in free.stamps_ns.tolist()]
                at_end = points_at_end(track, is_last)
                extensions.append(_Extension(track.track_id, free.stamps_ns[is_open], at_end))
                self._add(free, track, len(extensions) - 1)


def _array_of_stamp(given: Sequence[BoxArray], fixed_frame: str) -> dict[int, int]:
    """Return the index of the array that boxes of each stamp are added to: none that is late."""
    array_of: dict[int, int] = {}
    newest_ns = -1
    for index, array in enumerate(given):
        if array.frame_id == fixed_frame and array.stamp_ns > newest_ns:
            array_of[array.stamp_ns] = index
            newest_ns = array.stamp_ns
    return array_of


def _note_ambiguous(plan: CompletionPlan, ambiguous: Sequence[tuple[str, str]]) -> None:
    """List pairs that were left alone at both of their tracks."""
    others: dict[str, list[str]] = {}
    for first, second in ambiguous:
        others.setdefault(first, []).append(second)
        others.setdefault(second, []).append(first)
    for track in plan.tracks:
        track.ambiguous = tuple(others.get(track.track_id, ()))


def _finished(
    array: PlannedArray,
    given: BoxArray,
    registered: RefinedBoxes,
    num_points: Ints,
    keep: Sequence[bool],
) -> RefinedBoxes:
    """Return the result of one array: the input boxes in their order, then the added ones."""
    first = len(given.track_ids) - len(array.rejected)  # of the added ones that were registered
    rows = [first + i for i, is_kept in enumerate(keep) if is_kept]
    found = registered.take([*range(first), *rows])
    boxes, covariances = found.boxes.boxes.copy(), found.covariances.copy()
    status, reasons = list(found.status), list(found.reasons)
    for i, row in enumerate(rows, first):
        added = array.added[row - first]
        if added.status == HUMAN:
            boxes[i] = added.box
        if not num_points[row] or status[i] == KEPT:
            covariances[i] = added.covariance  # of the motion model
        status[i], reasons[i] = added.status, ''
    found = replace(
        found,
        boxes=replace(found.boxes, boxes=boxes),
        status=tuple(status),
        reasons=tuple(reasons),
        covariances=covariances,
    )
    gone = sorted(array.rejected)
    words = tuple(array.rejected[row] for row in gone)
    return with_rejected(found, array.renamed(given).take(gone), gone, words)
