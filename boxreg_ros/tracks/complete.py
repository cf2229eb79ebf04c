"""
From tracks to whole tracks: stitch, join parked ones, prune, fill and extend.

All steps work on tables of boxes, so a recording is read twice and its points are never held: the
first pass registers the input, `complete` makes a plan from the results, and the second pass
registers the completed tracks. Only then does the last step, the end of each extension, follow
from the points.

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.core.id_switches import by_id, id_switches
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import (
    BoxArray,
    EXTENDED,
    Floats,
    HUMAN,
    INTERPOLATED,
    Ints,
    is_valid_box,
    KEPT,
    KINEMATICS,
    RefinedBoxes,
    REJECTED,
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
from numpy.typing import NDArray


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
        rows = [row for row in range(len(given.track_ids)) if row not in self.rejected]
        boxes = np.array([self.moved.get(row, given.boxes[row]) for row in rows])
        of_person = np.array([added.status == HUMAN for added in self.added], bool)
        pinned = None
        if given.pinned is not None or of_person.any():
            own = np.zeros(len(rows), bool) if given.pinned is None else given.pinned[rows]
            pinned = np.append(own, of_person)
        return replace(
            given,
            track_ids=(*(self.track_ids[i] for i in rows), *(a.track_id for a in self.added)),
            class_names=(
                *(self.class_names[i] for i in rows),
                *(a.class_name for a in self.added),
            ),
            scores=np.append(given.scores[rows], [a.score for a in self.added]),
            boxes=np.concatenate(
                [boxes.reshape(-1, 9), np.array([a.box for a in self.added]).reshape(-1, 9)]
            ),
            pinned=pinned,
        )

    def added_boxes(self, given: BoxArray) -> BoxArray:
        """Return the boxes that are added to an array."""
        registered = self.to_register(given)
        count = len(registered.track_ids)
        return registered.take(range(count - len(self.added), count))


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

        `registered` are the results of `PlannedArray.to_register` of the arrays `given`,
        `num_points` the points above the road in each box that was registered.

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

    What a person has `decided` binds each step.

    `results` are the registration of the boxes `given`, `num_points` (n,) the points above the
    road in each; arrays outside of the fixed frame stay as they are.

    """
    steps = config.complete
    if steps.stitch:
        results = _exchanged(given, results, fixed_frame, decided)
    tracks = tracklets_of(results, num_points, fixed_frame, config, decided.names)
    plan = unchanged_plan(given)
    if steps.prune:  # first: a duplicate could be stitched to its object
        found = _doubted(tracks, duplicates(tracks, config), given, decided)
        tracks = _rejected(tracks, found, Reason.DUPLICATE, plan)
    ambiguous: list[tuple[str, str]] = []
    if steps.stitch:
        tracks, left = join_turns(tracks, config, decided)
        found = _doubted(left, {one.track_id for one in left}, given, decided)
        _rejected(left, found, Reason.DUPLICATE, plan)
        tracks, ambiguous = stitch(tracks, config, decided)
    if steps.static:
        tracks = join_static(tracks, config, decided)
    if steps.prune:  # last: a fragment of an object may look like a ghost
        found = _doubted(tracks, ghosts(tracks), given, decided)
        tracks = _rejected(tracks, found, Reason.GHOST, plan)
    of_track = {one.track_id: DecidedTrack.of(one, given, decided) for one in tracks}
    for track in tracks:
        _place(track, '', plan, of_track[track.track_id])
    array_of = _array_of_stamp(given, fixed_frame)
    stamps_ns = np.array(sorted(array_of), np.int64)
    if steps.fill:
        detected = [one for one in given if one.frame_id == fixed_frame and len(one.boxes)]
        detected_ns = np.unique(np.array([one.stamp_ns for one in detected], np.int64))
        rare = _doubted(tracks, rarely_detected(tracks, detected_ns, config), given, decided)
        _fill(tracks, rare, stamps_ns, plan, array_of, config, of_track)
    if steps.extend:
        _extend(tracks, stamps_ns, plan, array_of, config, of_track)
    _note_ambiguous(plan, ambiguous)
    return plan


def _exchanged(
    given: Sequence[BoxArray],
    results: Sequence[RefinedBoxes],
    fixed_frame: str,
    decided: Decided,
) -> list[RefinedBoxes]:
    """Return results in which tracks that changed places have their ids back, but named ones."""
    arrays = [array for array in given if array.frame_id == fixed_frame]
    if not arrays:
        return [*results]
    boxes = np.concatenate([array.boxes for array in arrays])
    names = [name for array in arrays for name in array.track_ids]
    is_free = np.array([name not in decided.names for name in names], bool)
    valid = np.flatnonzero(is_valid_box(boxes) & is_free)
    stamps_ns = np.repeat([a.stamp_ns for a in arrays], [len(a.track_ids) for a in arrays])
    tracks = by_id([names[row] for row in valid], stamps_ns[valid], boxes[valid, : Y + 1])
    found = id_switches(tracks)
    exchanged = []
    for result in results:
        ids = result.boxes.track_ids
        for switch in reversed(found):
            ids = tuple(switch.exchanged(name, result.boxes.stamp_ns) for name in ids)
        exchanged.append(replace(result, boxes=replace(result.boxes, track_ids=ids)))
    return exchanged


def _doubted(
    tracks: Sequence[Tracklet], names: set[str], given: Sequence[BoxArray], decided: Decided
) -> set[str]:
    """Return those of `names` whose track no person has accepted, or given a box in the input."""
    return {
        track.track_id
        for track in tracks
        if track.track_id in names
        and not DecidedTrack.of(track, given, decided).is_accepted()
        and not _is_pinned(track, given)
    }


def _is_pinned(track: Tracklet, given: Sequence[BoxArray]) -> bool:
    """Return whether a box of a track is held as it is in the input."""
    pinned = [(given[index].pinned, row) for index, row in track.places]
    return any(held is not None and bool(held[row]) for held, row in pinned)


def _rejected(
    tracks: list[Tracklet], names: set[str], reason: str, plan: CompletionPlan
) -> list[Tracklet]:
    """Reject the boxes of some tracks in the plan; return the other tracks."""
    for track in tracks:
        if track.track_id in names:
            _place(track, reason, plan)
    return [track for track in tracks if track.track_id not in names]


def _place(
    track: Tracklet, reason: str, plan: CompletionPlan, decided: DecidedTrack | None = None
) -> None:
    """
    Write id and class of a track to its input boxes; reject them where there is a reason.

    Boxes whose class a person has `decided` keep it.

    """
    steps = TrackSteps(track.track_id, track.class_name, track.fragments)
    for (index, row), stamp_ns in zip(track.places, track.stamps_ns.tolist(), strict=True):
        array = plan.arrays[index]
        class_name = track.class_name
        if decided is not None:
            class_name = decided.class_name(stamp_ns) or class_name
        steps.reclassified += array.class_names[row] != class_name
        array.track_ids[row] = track.track_id
        array.class_names[row] = class_name
        if reason:
            array.rejected[row] = reason
            steps.rejected += 1
    plan.tracks.append(steps)


def _array_of_stamp(given: Sequence[BoxArray], fixed_frame: str) -> dict[int, int]:
    """Return the index of the array that boxes of each stamp are added to: none that is late."""
    array_of: dict[int, int] = {}
    newest_ns = -1
    for index, array in enumerate(given):
        if array.frame_id == fixed_frame and array.stamp_ns > newest_ns:
            array_of[array.stamp_ns] = index
            newest_ns = array.stamp_ns
    return array_of


def _add(
    boxes: AddedBoxes,
    track: Tracklet,
    plan: CompletionPlan,
    array_of: dict[int, int],
    decided: DecidedTrack,
    extension: int = -1,
) -> None:
    """Add boxes of a track to the arrays of their stamps; those that a person has set as such."""
    for i, stamp_ns in enumerate(boxes.stamps_ns.tolist()):
        pin = decided.pin(stamp_ns)
        plan.arrays[array_of[stamp_ns]].added.append(
            AddedBox(
                track.track_id,
                decided.class_name(stamp_ns) or track.class_name,
                boxes.status if pin is None else HUMAN,
                boxes.boxes[i] if pin is None else pin,
                boxes.covariances[i],
                float(boxes.scores[i]),
                extension if pin is None else -1,
            )
        )


def _fill(
    tracks: Sequence[Tracklet],
    rare: set[str],
    stamps_ns: Ints,
    plan: CompletionPlan,
    array_of: dict[int, int],
    config: Config,
    of_track: Mapping[str, DecidedTrack],
) -> None:
    """Add the missing boxes of tracks, but of `rare` ones only where a person has set one."""
    steps = {one.track_id: one for one in plan.tracks}
    for track in tracks:
        own = of_track[track.track_id]
        gaps = [own.left(gap, is_extension=False) for gap in fill(track, stamps_ns, config)]
        missing_ns = [stamp_ns for gap in gaps for stamp_ns in gap.stamps_ns.tolist()]
        if track.track_id in rare and not own.is_accepted(missing_ns):
            steps[track.track_id].unfilled = len(missing_ns)
            continue
        for gap in gaps:
            _add(gap, track, plan, array_of, own)


def _extend(
    tracks: Sequence[Tracklet],
    stamps_ns: Ints,
    plan: CompletionPlan,
    array_of: dict[int, int],
    config: Config,
    of_track: Mapping[str, DecidedTrack],
) -> None:
    """Add the candidates of all extensions, as far as no other track owns their place."""
    owned: dict[int, list[Floats]] = {}
    for track in tracks:
        for stamp_ns, box in zip(track.stamps_ns.tolist(), track.boxes, strict=True):
            owned.setdefault(stamp_ns, []).append(box)
    for stamp_ns, index in array_of.items():
        owned.setdefault(stamp_ns, []).extend(added.box for added in plan.arrays[index].added)
    for track in tracks:
        for candidates in extend(track, stamps_ns, config):
            own = of_track[track.track_id]
            free = own.left(candidates.first(num_free(candidates, owned)), is_extension=True)
            if not len(free.boxes):
                continue
            is_last = int(free.stamps_ns[0]) > track.last_ns
            is_open = [own.pin(stamp_ns) is None for stamp_ns in free.stamps_ns.tolist()]
            at_end = points_at_end(track, is_last)
            plan.extensions.append(_Extension(track.track_id, free.stamps_ns[is_open], at_end))
            _add(free, track, plan, array_of, own, len(plan.extensions) - 1)


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
    n = len(given.track_ids)
    taken = [row for row in range(n) if row not in array.rejected]
    kept = [i for i, is_kept in enumerate(keep) if is_kept]
    rows = [len(taken) + i for i in kept]  # of the added boxes, among the registered ones

    def completed(values: NDArray[Any], of_rejected: NDArray[Any]) -> NDArray[Any]:
        column = np.broadcast_to(of_rejected, (n, *values.shape[1:])).astype(values.dtype)
        column[taken] = values[: len(taken)]
        return np.concatenate([column, values[rows]])

    covariances = completed(registered.covariances, np.eye(6))
    boxes = completed(registered.boxes.boxes, given.boxes)
    for i, row in enumerate(rows):
        added = array.added[kept[i]]
        if added.status == HUMAN:
            boxes[n + i] = added.box
        if not num_points[row] or registered.status[row] == KEPT:
            covariances[n + i] = added.covariance  # of the motion model
    status = [REJECTED] * n
    reasons = [array.rejected.get(row, '') for row in range(n)]
    for i, row in enumerate(taken):
        status[row] = registered.status[i]
        reasons[row] = registered.reasons[i]
    return RefinedBoxes(
        replace(
            given,
            track_ids=(*array.track_ids, *(array.added[i].track_id for i in kept)),
            class_names=(*array.class_names, *(array.added[i].class_name for i in kept)),
            scores=np.append(given.scores, [array.added[i].score for i in kept]),
            boxes=boxes,
            pinned=None,
            kinematics=completed(registered.boxes.known_kinematics, np.zeros((), KINEMATICS)),
        ),
        (*status, *(array.added[i].status for i in kept)),
        (*reasons, *('',) * len(kept)),
        completed(registered.num_points, np.zeros(n)),
        covariances,
        registered.is_final,
        completed(registered.extent_covariances, np.eye(3)),
        completed(registered.face_distances, np.zeros(6)),
        completed(registered.near_points, np.zeros(2, np.int64)),
    )
