"""The decisions of a person as a run applies them, before and after the registration."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TYPE_CHECKING

from boxreg_ros.errors import RecordingError
from boxreg_ros.reasons import Reason
from boxreg_ros.review.decisions import Decision, held, Scope
from boxreg_ros.structures import (
    BOX_EXTENT,
    BoxArray,
    Floats,
    HUMAN,
    KEPT,
    kept,
    RefinedBoxes,
    REJECTED,
)
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from boxreg_ros.core.follow import FollowedTrack

SAME_SWEEP_NS = 50_000_000
"""Boxes are of a sweep if its stamp is nearer than this [ns]; chosen: half a revolution."""
WITHOUT_EFFECT = ('accept', 'unsure', 'none')


class Corrections:
    """
    The decisions of a person, in the order they were made, as a run applies them.

    Deleted boxes are not registered; ids, classes and pinned boxes are those of the decisions
    before any step of the run; rejected boxes are as in the input again after it. Boxes can be
    pinned already. The steps that complete tracks ask for the decisions as
    `tracks.decided.Decided`, after the boxes of the input have passed `to_register`.

    """

    def __init__(self, decisions: Iterable[Decision] = ()) -> None:
        self._of_track: dict[str, list[Decision]] = {}
        for one in held(decisions):
            self._of_track.setdefault(one.track_id, []).append(one)
        self._unused = {
            one.scope
            for one in held(decisions)
            if one.kind not in WITHOUT_EFFECT and not one.is_taken_back
        }
        self._extents = self._extents_of_pins()
        self._input_ids: dict[tuple[str, int], str] = {}  # by new id and stamp, where renamed
        self._own_ids: set[str] = set()  # of input boxes that are not renamed
        self._boxes: set[tuple[str, int]] = set()  # of tracks with a pin: id and stamp, as given
        self._before: dict[str, tuple[str, Mapping[str, str]]] = {}  # id, attributes; by new id
        self._origins: dict[str, list[tuple[int, str]]] = {}  # stamps and first ids of added boxes

    def unused(self) -> list[str]:
        """Return the tracks and boxes with a decision that the recording does not have."""
        return [_text_of(scope) for scope in sorted(self._unused, key=str)]

    def seeds(self, frame_id: str) -> list[BoxArray]:
        """Return boxes of added objects, an array each; RecordingError for another frame."""
        found = []
        for one in self._additions():
            if one.frame_id != frame_id:
                raise RecordingError(
                    f'added box of track {one.track_id!r} at {one.stamp_ns}: expected frame '
                    f'{frame_id!r}, got {one.frame_id!r}; relabel with --fixed-frame '
                    f'{one.frame_id}'
                )
            assert one.stamp_ns is not None and one.box is not None
            columns = (one.track_id,), (one.value,), np.ones(1), one.box[None]
            found.append(BoxArray(one.stamp_ns, frame_id, *columns))
        return found

    @property
    def adds(self) -> bool:
        """Return whether objects were added."""
        return bool(self._additions())

    def added(self, tracks: Iterable[FollowedTrack]) -> list[FollowedTrack]:
        """Return followed objects without deleted boxes, with the ids and classes decided."""
        found: list[FollowedTrack] = []
        for track in tracks:
            rows_of: dict[tuple[str, str], list[int]] = {}
            for row, stamp_ns in enumerate(track.stamps_ns.tolist()):
                if self._last('deletion', track.track_id, stamp_ns) is not None:
                    continue
                names = []
                for topic, name in (('id', track.track_id), ('class', track.class_name)):
                    changed = self._last(topic, track.track_id, stamp_ns)
                    names.append(changed.value if changed else name)
                rows_of.setdefault((names[0], names[1]), []).append(row)
                self._origins.setdefault(names[0], []).append((stamp_ns, track.track_id))
            own = {one.scope for one in self._additions() if one.track_id == track.track_id}
            if len(track.rows):
                self._unused -= own
            for (track_id, class_name), rows in rows_of.items():
                found.append(
                    replace(
                        track,
                        track_id=track_id,
                        class_name=class_name,
                        rows=track.rows[rows],
                        stamps_ns=track.stamps_ns[rows],
                        boxes=track.boxes[rows],
                        status=tuple(track.status[row] for row in rows),
                    )
                )
        return found

    def origin_of(self, stamp_ns: int, track_id: str) -> str:
        """Return the id under which the object of an added box was added; empty for others."""
        known = self._origins.get(track_id)
        if known is None:
            return ''
        near_ns, origin = min(known, key=lambda one: abs(one[0] - stamp_ns))
        return origin if abs(near_ns - stamp_ns) < SAME_SWEEP_NS else ''

    @property
    def names(self) -> set[str]:
        """Return the ids that were given."""
        return {
            one.value
            for decisions in self._of_track.values()
            for one in decisions
            if one.kind == 'rename' and not one.is_taken_back
        }

    @property
    def apart(self) -> set[str]:
        """Return the ids that were given, and that the input does not have."""
        return self.names - self._own_ids

    def input_id(self, track_id: str, stamp_ns: int) -> str:
        """Return the id in the input of a box that is registered as one of `track_id`."""
        return self._input_ids.get((track_id, stamp_ns), track_id)

    def track_id(self, input_id: str, stamp_ns: int) -> str:
        """Return the id that was given to a box; empty for none."""
        found = self._last('id', input_id, stamp_ns)
        return found.value if found else ''

    def class_name(self, input_id: str, stamp_ns: int) -> str:
        """Return the class that was given to a box; empty for none."""
        found = self._last('class', input_id, stamp_ns)
        return found.value if found else ''

    def is_left_out(self, input_id: str, stamp_ns: int) -> bool:
        """
        Return whether a box that the input does not have is deleted or rejected.

        In the place of a rejected box that of the input is written: here there is none.

        """
        found = self._judgement(input_id, stamp_ns)
        is_rejected = found is not None and found.kind == 'reject'
        return is_rejected or self._last('deletion', input_id, stamp_ns) is not None

    def is_accepted(self, input_id: str, stamp_ns: int) -> bool:
        """Return whether a box is accepted or pinned."""
        found = self._judgement(input_id, stamp_ns)
        return found is not None and found.kind in ('accept', 'pin')

    def pin(self, input_id: str, stamp_ns: int) -> Floats | None:
        """Return the box (9,) of a pin where the input has none; None for no pin."""
        if (input_id, stamp_ns) in self._boxes:
            return None
        found = self._judgement(input_id, stamp_ns)
        return found.box if found is not None and found.kind == 'pin' else None

    def keyframes(self, arrays: Sequence[BoxArray], frame_id: str) -> list[BoxArray]:
        """
        Return the pins where the input has no box, an array each: further keyframes.

        `arrays` are the boxes of the input as they are to be registered.

        """
        class_of = {
            name: class_name
            for array in arrays
            for name, class_name in zip(array.track_ids, array.class_names, strict=True)
        }
        found = []
        for one in self._pins():
            assert one.stamp_ns is not None and one.box is not None
            track_id = self.track_id(one.track_id, one.stamp_ns) or one.track_id
            is_extra = self.pin(one.track_id, one.stamp_ns) is not None and track_id in class_of
            if not is_extra or one.frame_id != frame_id:
                continue
            class_name = self.class_name(one.track_id, one.stamp_ns) or class_of[track_id]
            columns = (track_id,), (class_name,), np.ones(1), one.box[None]
            found.append(BoxArray(one.stamp_ns, frame_id, *columns))
            self._input_ids[track_id, one.stamp_ns] = one.track_id
        return found

    def _pins(self) -> list[Decision]:
        return [one for rows in self._of_track.values() for one in rows if one.kind == 'pin']

    def _additions(self) -> list[Decision]:
        return [one for rows in self._of_track.values() for one in rows if one.kind == 'add']

    def to_register(self, given: BoxArray, with_pins: bool = True) -> BoxArray:
        """
        Return input boxes as they are to be registered.

        Without deleted boxes, with new ids and classes, and with pinned boxes in the place of
        theirs. A pin shows the extents of the object: the other boxes of its track have them too,
        in windows without a pin as well. Raises RecordingError if a box is pinned in another
        frame.

        """
        given = replace(given, attributes=())  # `with_attributes` gives the result its own
        if not self._of_track:
            return given
        rows = self._left(given)
        renamed = self._renamed(given).take(rows)
        if not with_pins:
            return renamed
        boxes = renamed.boxes.copy()
        pinned = _is_pinned(given)[rows]
        for i, row in enumerate(rows):
            if not pinned[i]:
                boxes[i, BOX_EXTENT] = self._extents.get(
                    renamed.track_ids[i], boxes[i, BOX_EXTENT]
                )
            found = self._judgement(given.track_ids[row], given.stamp_ns)
            if found is None:
                continue
            if found.kind != 'pin' or found.box is None:
                pinned[i] = pinned[i] and found.kind != 'reject'
                continue
            if found.frame_id != given.frame_id:
                raise RecordingError(
                    f'pinned box of track {found.track_id!r} at {given.stamp_ns}: expected frame '
                    f'{given.frame_id!r}, got {found.frame_id!r}; relabel with --fixed-frame '
                    f'{found.frame_id}'
                )
            boxes[i] = found.box
            pinned[i] = True
        return replace(renamed, boxes=boxes, pinned=pinned)

    def apply(self, given: BoxArray, refined: RefinedBoxes) -> RefinedBoxes:
        """
        Return the result for all input boxes, in their order, and then for the added ones.

        `refined` is that for the boxes of `to_register`, in their order, and for added ones.

        """
        is_pinned = _is_pinned(given)
        if not (self._of_track or is_pinned.any()):
            return refined
        refined = self._with_deleted(given, refined)
        boxes = refined.boxes.boxes.copy()
        status = list(refined.status)
        reasons = list(refined.reasons)
        covariances = refined.covariances.copy()
        for row, track_id in enumerate(given.track_ids):
            if status[row] == KEPT:
                boxes[row] = given.boxes[row]  # without the extents of a pin
            found = self._judgement(track_id, given.stamp_ns)
            kind = found.kind if found is not None else 'none'
            if reasons[row] == Reason.DELETED:
                continue
            if found is not None and kind == 'pin' and found.frame_id == given.frame_id:
                boxes[row] = found.box
                status[row], reasons[row] = HUMAN, ''
            elif kind == 'reject':
                boxes[row] = given.boxes[row]
                status[row], reasons[row] = KEPT, str(Reason.REJECTED)
                covariances[row] = np.eye(6)
            elif is_pinned[row]:
                boxes[row] = given.boxes[row]
                status[row], reasons[row] = HUMAN, ''
        for row in range(len(given.track_ids), len(status)):
            name = self._input_ids.get((refined.boxes.track_ids[row], given.stamp_ns), '')
            pin = self.pin(name, given.stamp_ns)
            if pin is not None:
                boxes[row] = pin
                status[row] = HUMAN
        return replace(
            refined,
            boxes=replace(refined.boxes, boxes=boxes, pinned=None),
            status=tuple(status),
            reasons=tuple(reasons),
            covariances=covariances,
        )

    def with_attributes(self, given: BoxArray, refined: RefinedBoxes) -> RefinedBoxes:
        """
        Return a result of `apply` with the attributes of its boxes, as decided or as in the input.

        A box that the input does not have has those of the box before it in its track. Results
        are given in the order of stamps.

        """
        found: list[Mapping[str, str]] = []
        for row, track_id in enumerate(refined.boxes.track_ids):
            if row < len(given.track_ids):
                own, input_id = given.attributes_of(row), given.track_ids[row]
                self._before[track_id] = input_id, own
            else:
                input_id, own = self._before.get(track_id) or (self._first_id(track_id), {})
                input_id = self.origin_of(given.stamp_ns, track_id) or input_id
            found.append({**own, **self._decided_attributes(input_id, given.stamp_ns)})
        attributes = tuple(found) if any(found) else ()
        return replace(refined, boxes=replace(refined.boxes, attributes=attributes))

    def _first_id(self, track_id: str) -> str:
        """Return an id in the input of a track whose boxes there are later."""
        return next(
            (
                one.track_id
                for decisions in self._of_track.values()
                for one in decisions
                if one.kind == 'rename' and one.value == track_id
            ),
            track_id,
        )

    def _decided_attributes(self, input_id: str, stamp_ns: int) -> dict[str, str]:
        topics = dict.fromkeys(
            one.topic for one in self._of_track.get(input_id, ()) if one.kind == 'attribute'
        )
        found = (self._last(topic, input_id, stamp_ns) for topic in topics)
        return dict(one.attribute for one in found if one is not None)

    def _left(self, given: BoxArray) -> list[int]:
        """Return the rows of the boxes that are not deleted."""
        return [
            row
            for row, track_id in enumerate(given.track_ids)
            if self._last('deletion', track_id, given.stamp_ns) is None
        ]

    def _renamed(self, given: BoxArray) -> BoxArray:
        """Return input boxes with the ids and classes that were decided."""
        track_ids = list(given.track_ids)
        class_names = list(given.class_names)
        for row, track_id in enumerate(given.track_ids):
            renamed = self._last('id', track_id, given.stamp_ns)
            track_ids[row] = renamed.value if renamed else track_id
            if renamed:
                self._input_ids[renamed.value, given.stamp_ns] = track_id
            else:
                self._own_ids.add(track_id)
            if track_id in self._of_track:
                self._boxes.add((track_id, given.stamp_ns))
            reclassed = self._last('class', track_id, given.stamp_ns)
            class_names[row] = reclassed.value if reclassed else class_names[row]
        return replace(given, track_ids=tuple(track_ids), class_names=tuple(class_names))

    def _with_deleted(self, given: BoxArray, refined: RefinedBoxes) -> RefinedBoxes:
        """Return a result with the deleted boxes at their place, as rejected."""
        n = len(given.track_ids)
        left = self._left(given)
        deleted = sorted(set(range(n)) - set(left))
        if not deleted:
            return refined
        gone = kept(self._renamed(given).take(deleted), Reason.DELETED)
        gone = replace(gone, status=(REJECTED,) * len(deleted))
        order = np.empty(len(refined.status) + len(deleted), np.int64)
        order[left] = np.arange(len(left))
        order[deleted] = len(refined.status) + np.arange(len(deleted))
        order[n:] = np.arange(len(left), len(refined.status))
        return _joined(refined, gone).take(order.tolist())

    def _judgement(self, track_id: str, stamp_ns: int) -> Decision | None:
        """Return the judgement of a box: its own, else that of a range, else of its track."""
        found = None
        for one in self._covering('judgement', track_id, stamp_ns):
            if found is None or _closeness(one) >= _closeness(found):
                found = one
        return found

    def _last(self, topic: str, track_id: str, stamp_ns: int) -> Decision | None:
        """Return the last decision of a topic about a box."""
        return next(reversed(self._covering(topic, track_id, stamp_ns)), None)

    def _covering(self, topic: str, track_id: str, stamp_ns: int) -> list[Decision]:
        """Return the decisions of a topic about a box, in their order."""
        found = [
            one
            for one in self._of_track.get(track_id, ())
            if one.topic == topic and not one.is_taken_back and one.covers(stamp_ns)
        ]
        self._unused -= {one.scope for one in found}
        return found

    def _extents_of_pins(self) -> dict[str, Floats]:
        """Return the mean extents (3,) of the pinned boxes of each track that has any, by id."""
        by_track: dict[str, list[Floats]] = {}
        for track_id, decisions in self._of_track.items():
            for one in decisions:
                if one.kind != 'pin' or one.box is None or one.stamp_ns is None:
                    continue
                renames = [d for d in decisions if d.kind == 'rename' and d.covers(one.stamp_ns)]
                new_id = renames[-1].value if renames else track_id
                by_track.setdefault(new_id, []).append(one.box[BOX_EXTENT])
        return {track_id: np.mean(extents, axis=0) for track_id, extents in by_track.items()}


def _is_pinned(boxes: BoxArray) -> NDArray[np.bool_]:
    """Return which boxes of an array (n,) are pinned already, as those of label files."""
    if boxes.pinned is None:
        return np.zeros(len(boxes.track_ids), bool)
    return boxes.pinned


def _closeness(decision: Decision) -> int:
    """Return how few boxes a decision is about: 2 for one, 1 for a range, 0 for a track."""
    if decision.stamp_ns is None:
        return 0
    return 2 if decision.end_ns is None else 1


def _text_of(scope: Scope) -> str:
    track_id, stamp_ns, end_ns = scope
    if stamp_ns is None:
        return f'{track_id!r}'
    return f'{track_id!r} at {stamp_ns}' + (f' to {end_ns}' if end_ns is not None else '')


def _joined(first: RefinedBoxes, second: RefinedBoxes) -> RefinedBoxes:
    """Return the boxes of two results of one stamp as one."""

    def both(name: str, of: Sequence[Any] = (first, second)) -> Any:
        return np.concatenate([getattr(one, name) for one in of])

    boxes = first.boxes, second.boxes
    return replace(
        first,
        boxes=replace(
            first.boxes,
            track_ids=(*boxes[0].track_ids, *boxes[1].track_ids),
            class_names=(*boxes[0].class_names, *boxes[1].class_names),
            scores=both('scores', boxes),
            boxes=both('boxes', boxes),
            pinned=None,
            kinematics=both('known_kinematics', boxes),
        ),
        status=(*first.status, *second.status),
        reasons=(*first.reasons, *second.reasons),
        num_points=both('num_points'),
        covariances=both('covariances'),
        extent_covariances=both('extent_covariances'),
        face_distances=both('face_distances'),
        near_points=both('near_points'),
    )
