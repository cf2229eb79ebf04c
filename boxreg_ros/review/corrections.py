"""The decisions of a person as a run applies them, before and after the registration."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import chain, groupby, pairwise
from typing import NamedTuple, TYPE_CHECKING

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.stamp_join import LARGEST_OFFSET_NS
from boxreg_ros.reasons import Reason
from boxreg_ros.review.decisions import Decision, held, MAX_STAMP_NS, text_of, TOPIC_OF, WITH_BOX
from boxreg_ros.structures import (
    BOX_EXTENT,
    BoxArray,
    Floats,
    HUMAN,
    KEPT,
    KINEMATICS,
    RefinedBoxes,
    REJECTED,
    with_rejected,
)
import numpy as np

if TYPE_CHECKING:
    from boxreg_ros.core.follow import FollowedTrack

SAME_SWEEP_NS = 50_000_000
"""Boxes are of a sweep if its stamp is nearer than this [ns]; chosen: half a revolution."""
STATED = ('reclass', 'attribute')
"""Kinds whose values the boxes of a result state, but not whether a person gave them."""

WHOLE_TRACK = 'judgement of the track'
"""Topic of what was decided about whole tracks, not about their boxes."""


class _Applied(NamedTuple):
    """What was decided about one box of the result; empty for nothing."""

    stamp_ns: int
    input_id: str
    track_id: str
    judgement: str
    # By topic: those of `STATED`, with the value of the box; and a rejection of its whole track.
    stated: Mapping[str, Decision]


class Corrections:
    """
    The decisions of a person, in the order they were made, as a run applies them.

    Deleted boxes are not registered; ids, classes and pinned boxes are those of the decisions
    before any step of the run; rejected boxes are as in the input again after it. Boxes can be
    pinned already, and have the class of a person then; none is added where the files of the input
    have one that is `rejected`, named by id and stamp. The steps that complete tracks ask for the
    decisions as `tracks.decided.Decided`, after the boxes of the input have passed `to_register`.
    `earlier` decisions are those that the boxes of the input have already, see `applied`; whatever
    class or attribute such a box has, it is that of a person.

    """

    def __init__(
        self,
        decisions: Iterable[Decision] = (),
        rejected: Collection[tuple[str, int]] = (),
        earlier: Iterable[Decision] = (),
    ) -> None:
        self._rejected = rejected
        decisions, earlier = [*decisions], held(earlier)
        others = (one for one in earlier if one.kind not in STATED)
        self._of_track = _by_track(held([*others, *decisions]))
        self._earlier = _by_track(one for one in earlier if one.kind in STATED)
        self._decided = [one for one in held(decisions) if not one.is_taken_back]
        self._unused = {one.scope for one in self._decided}
        self._unseen = {one.track_id for one in earlier}
        self._ranges = _by_track(one for one in self._decided if one.end_ns is not None)
        self._doubts: set[str] = set()  # see `doubts`
        self._extents = self._extents_of_pins()
        self._input_ids: dict[tuple[str, int], str] = {}  # by new id and stamp, where renamed
        self._own_ids: set[str] = set()  # of input boxes that are not renamed
        self._boxes: set[tuple[str, int]] = set()  # of tracks with a pin: id and stamp, as given
        self._before: dict[str, tuple[str, Mapping[str, str]]] = {}  # id, attributes; by new id
        self._origins: dict[str, list[tuple[int, str]]] = {}  # stamps and first ids of added boxes
        self._human_classes: dict[tuple[str, int], str] = {}  # of the input, by id and stamp
        self._of_result: dict[str, list[_Applied]] = {}  # by id in the result

    def unused(self) -> list[str]:
        """Return the tracks and boxes with a decision that the recording does not have."""
        return [text_of(scope) for scope in sorted(self._unused, key=str)]

    def doubts(self, is_part: bool = False) -> list[str]:
        """
        Return the boxes that decisions may be about, or may not, in words.

        Tracks with `earlier` decisions may be missing in a part of the recording.

        """
        names = ', '.join(map(repr, sorted(self._unseen)))
        missing = f'the labels have decisions on tracks that they do not have: {names}'
        empty = [
            f'{text_of(one.scope)} was given to {one.value!r}, which has no box there: only boxes '
            f'of the input can be given to another track'
            for one in self._decided
            if one.kind == 'rename' and self._is_empty(one)
        ]
        return [missing] * bool(names and not is_part) + empty + sorted(self._doubts)

    def _is_empty(self, rename: Decision) -> bool:
        """Return whether the results have no box of a given id, for no decision of a person."""
        first_ns, last_ns = _span_of(rename)
        others = [
            one
            for one in self._of_track[rename.track_id]
            if one.kind in ('delete', 'reject', 'rename') and one is not rename
        ]
        spans = map(_span_of, others)
        stamps_ns = [row.stamp_ns for row in self._of_result.get(rename.value, ())]
        return rename.scope not in self._unused and not (
            any(first_ns <= stamp_ns <= last_ns for stamp_ns in stamps_ns)
            or any(begin_ns <= last_ns and first_ns <= end_ns for begin_ns, end_ns in spans)
        )

    def seeds(self, frame_id: str) -> list[BoxArray]:
        """
        Return the boxes of added objects.

        Parameters
        ----------
        frame_id : str
            The fixed frame of the run.

        Returns
        -------
        seeds : list of BoxArray
            An array each, in the order of the decisions.

        Raises
        ------
        RecordingError
            If a box was added in another frame.

        """
        found = []
        for one in self._of_kind('add'):
            if one.frame_id != frame_id:
                raise RecordingError(
                    f'added box of track {one.track_id!r} at {one.stamp_ns}: expected frame '
                    f'{frame_id!r}, got {one.frame_id!r}; relabel with --fixed-frame '
                    f'{one.frame_id}'
                )
            found.append(_array_of(one, one.track_id, one.value))
        return found

    @property
    def adds(self) -> bool:
        """Return whether objects were added."""
        return bool(self._of_kind('add'))

    def added(self, tracks: Iterable[FollowedTrack]) -> list[FollowedTrack]:
        """
        Return followed objects without deleted and rejected boxes, with ids and classes decided.

        One whose id the input has is left out: it is there already, as in an earlier result.

        """
        found: list[FollowedTrack] = []
        for track in tracks:
            if track.track_id in self._own_ids:
                continue
            rows_of: dict[tuple[str, str], list[int]] = {}
            for row, stamp_ns in enumerate(track.stamps_ns.tolist()):
                if self.is_left_out(track.track_id, stamp_ns):
                    continue
                track_id = self.track_id(track.track_id, stamp_ns) or track.track_id
                class_name = self.class_name(track.track_id, stamp_ns) or track.class_name
                rows_of.setdefault((track_id, class_name), []).append(row)
                self._origins.setdefault(track_id, []).append((stamp_ns, track.track_id))
            own = {one.scope for one in self._of_kind('add') if one.track_id == track.track_id}
            if len(track.rows):
                self._unused -= own
            for (track_id, class_name), rows in rows_of.items():
                own_boxes = track.take(rows)
                found.append(replace(own_boxes, track_id=track_id, class_name=class_name))
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
        """Return the ids that were given, and those of tracks that others got a part of."""
        renames = self._renames()
        return {one.value for one in renames} | {
            one.track_id for one in renames if one.stamp_ns is not None
        }

    @property
    def apart(self) -> set[str]:
        """Return the ids that were given, and that the input does not have."""
        return {one.value for one in self._renames()} - self._own_ids

    def _renames(self) -> list[Decision]:
        return [one for one in self._of_kind('rename') if not one.is_taken_back]

    def input_id(self, track_id: str, stamp_ns: int) -> str:
        """Return the id in the input of a box that is registered as one of `track_id`."""
        return self._input_ids.get((track_id, stamp_ns), track_id)

    def track_id(self, input_id: str, stamp_ns: int) -> str:
        """Return the id that was given to a box; empty for none."""
        return self._value('id', input_id, stamp_ns)

    def class_name(self, input_id: str, stamp_ns: int) -> str:
        """Return the class that was given to a box, or one of a person has; empty for none."""
        known = self._human_classes.get((input_id, stamp_ns), '')
        earlier = self._stated_earlier(input_id, stamp_ns).get('class')
        decided = self._value('class', input_id, stamp_ns)
        return decided or known or (earlier.value if earlier else '')

    def has_own_class(self, input_id: str, stamp_ns: int) -> bool:
        """Return whether a class was given to the box, and not with its whole track."""
        of_track = self.class_name(input_id, MAX_STAMP_NS + 1)  # of no box
        return self.class_name(input_id, stamp_ns) not in ('', of_track)

    def _stated_earlier(self, track_id: str, stamp_ns: int) -> dict[str, Decision]:
        """Return what an earlier run has given to a box, or would have, by topic."""
        rows = self._earlier.get(track_id, ())
        return {one.topic: one for one in rows if one.covers(stamp_ns)}

    def pause(self, track_id: str) -> float:
        """Return how long the ranges are whose boxes a person has deleted, together [s]."""
        rows = self._of_track.get(track_id, ())
        ranges = [_span_of(one) for one in rows if one.kind == 'delete' and one.end_ns is not None]
        return sum(last_ns - first_ns for first_ns, last_ns in ranges) * 1e-9

    def is_left_out(self, input_id: str, stamp_ns: int) -> bool:
        """
        Return whether a box that the input does not have is deleted or rejected.

        In the place of a rejected box that of the input is written: here there is none.

        """
        found = self._judgement(input_id, stamp_ns)
        is_rejected = found is not None and found.kind == 'reject'
        is_left_out = is_rejected or self._is_deleted(input_id, stamp_ns)
        return is_left_out or (input_id, stamp_ns) in self._rejected

    def is_accepted(self, input_id: str, stamp_ns: int) -> bool:
        """Return whether a box is accepted or pinned."""
        found = self._judgement(input_id, stamp_ns)
        return found is not None and found.kind in ('accept', 'pin')

    def pin(self, input_id: str, stamp_ns: int) -> Floats | None:
        """Return the box (9,) of a pin where the input has none; None for no pin."""
        if (input_id, stamp_ns) in self._boxes or self._is_deleted(input_id, stamp_ns):
            return None
        found = self._judgement(input_id, stamp_ns)
        return found.box if found is not None and found.kind == 'pin' else None

    def keyframes(self, arrays: Sequence[BoxArray], frame_id: str) -> list[BoxArray]:
        """
        Return the pins where the input has no box: further keyframes.

        Parameters
        ----------
        arrays : sequence of BoxArray
            The boxes of the input as they are to be registered.
        frame_id : str
            The fixed frame; pins in others are left out.

        Returns
        -------
        arrays : list of BoxArray
            An array each, of tracks that are in `arrays`.

        """
        class_of = {
            name: class_name
            for array in arrays
            for name, class_name in zip(array.track_ids, array.class_names, strict=True)
        }
        found = []
        for one in self._of_kind('pin'):
            assert one.stamp_ns is not None
            track_id = self.track_id(one.track_id, one.stamp_ns) or one.track_id
            is_extra = self.pin(one.track_id, one.stamp_ns) is not None and track_id in class_of
            if not is_extra or one.frame_id != frame_id:
                continue
            class_name = self.class_name(one.track_id, one.stamp_ns) or class_of[track_id]
            found.append(_array_of(one, track_id, class_name))
            self._input_ids[track_id, one.stamp_ns] = one.track_id
        return found

    def _of_kind(self, kind: str) -> list[Decision]:
        return [one for rows in self._of_track.values() for one in rows if one.kind == kind]

    def to_register(self, given: BoxArray, with_pins: bool = True) -> BoxArray:
        """
        Return input boxes as they are to be registered.

        Without deleted boxes, with new ids and classes, and with pinned boxes in the place of
        theirs. A pin shows the extents of the object: the other boxes of its track have them too,
        in windows without a pin as well.

        Parameters
        ----------
        given : BoxArray
            Of the input, in the fixed frame.
        with_pins : bool
            Whether pins are used; without them only deletions, ids and classes are.

        Returns
        -------
        boxes : BoxArray
            A subset of the rows of `given`, in their order; without attributes.

        Raises
        ------
        RecordingError
            If a box is pinned in another frame.

        """
        given = given.plain()  # `with_attributes` gives the result its own
        self._unseen.difference_update(given.track_ids)
        for row, is_pinned in enumerate(given.is_pinned.tolist()):
            track_id = given.track_ids[row]
            self._note_near(track_id, given.stamp_ns)
            if is_pinned or 'class' in self._stated_earlier(track_id, given.stamp_ns):
                self._human_classes[track_id, given.stamp_ns] = given.class_names[row]
        if not self._of_track:
            return given
        rows = self._left(given)
        renamed = self._renamed(given).take(rows)
        if not with_pins:
            return renamed
        boxes = renamed.boxes.copy()
        pinned = given.is_pinned[rows]
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

    def _note_near(self, track_id: str, stamp_ns: int) -> None:
        """Note the ranges that end beside a box: their stamps may have been rounded."""
        for one in self._ranges.get(track_id, ()):
            away_ns = min(abs(end_ns - stamp_ns) for end_ns in _span_of(one))
            if away_ns <= LARGEST_OFFSET_NS and not one.covers(stamp_ns):
                self._doubts.add(
                    f'{one.kind} of {text_of(one.scope)} leaves out the box {away_ns} ns beside it'
                )

    def apply(self, given: BoxArray, refined: RefinedBoxes) -> RefinedBoxes:
        """
        Return the result for all input boxes.

        Parameters
        ----------
        given : BoxArray
            Of the input, as for `to_register`.
        refined : RefinedBoxes
            For the boxes of `to_register`, in their order, then for added ones.

        Returns
        -------
        result : RefinedBoxes
            The boxes of `given` in their order, then the added ones. Deleted boxes have the status
            ``rejected``; those that a person has rejected are kept as in the input; pinned ones
            have the status ``human``.

        """
        is_pinned = given.is_pinned
        if not (self._of_track or is_pinned.any()):
            return refined
        refined = self._with_deleted(given, refined)
        boxes = refined.boxes.boxes.copy()
        status = list(refined.status)
        reasons = list(refined.reasons)
        covariances = refined.covariances.copy()
        kinematics = refined.boxes.known_kinematics.copy()
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
                kinematics[row] = np.zeros((), KINEMATICS)
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
            boxes=replace(refined.boxes, boxes=boxes, pinned=None, kinematics=kinematics),
            status=tuple(status),
            reasons=tuple(reasons),
            covariances=covariances,
        )

    def with_attributes(self, given: BoxArray, refined: RefinedBoxes) -> RefinedBoxes:
        """
        Return a result of `apply` with the attributes of its boxes, as decided or as in the input.

        A box that the input does not have has those of the box before it in its track, without
        those that a person gave to that one. Results are given in the order of stamps.

        """
        if not (self._of_track or self._earlier or self._before or given.attributes):
            return refined  # no box has had any so far
        found: list[Mapping[str, str]] = []
        for row, track_id in enumerate(refined.boxes.track_ids):
            if row < len(given.track_ids):
                own, input_id = given.attributes_of(row), given.track_ids[row]
                earlier = self._stated_earlier(input_id, given.stamp_ns).values()
                names = {one.attribute[0] for one in earlier if one.kind == 'attribute'}
                left = {name: value for name, value in own.items() if name not in names}
                self._before[track_id] = input_id, left
            else:
                input_id, own = self._before.get(track_id) or (self._first_id(track_id), {})
                input_id = self.origin_of(given.stamp_ns, track_id) or input_id
                earlier = self._stated_earlier(input_id, given.stamp_ns).values()
                own = {**own, **dict(one.attribute for one in earlier if one.kind == 'attribute')}
            decided = self._last_attributes(input_id, given.stamp_ns)
            values = {**own, **dict(one.attribute for one in decided)}
            found.append({name: value for name, value in values.items() if value})
            if refined.status[row] != REJECTED:
                self._note(track_id, input_id, given.stamp_ns, found[-1])
        attributes = tuple(found) if any(found) else ()
        return replace(refined, boxes=replace(refined.boxes, attributes=attributes))

    def applied(self) -> list[Decision]:
        """
        Return the decisions that the boxes of all results have, about the ids of the results.

        A later run on these boxes, as labels, is bound by them: tables of labels do not state
        which classes, ids and attributes are those of a person.

        """
        found: list[Decision] = []
        apart = self.apart
        for track_id, rows in self._of_result.items():
            rows.sort(key=lambda one: one[:3])
            if any(a.stamp_ns == b.stamp_ns and a[3:] != b[3:] for a, b in pairwise(rows)):
                self._doubts.add(
                    f'of two boxes of {track_id!r} at one stamp one is decided about, which later '
                    f'runs cannot distinguish from the other one'
                )
            if track_id in apart:  # also boxes that a step has added
                rows = [one._replace(track_id=track_id) for one in rows]
            for topic in dict.fromkeys(topic for one in rows for topic in one.stated):
                found += _stated(track_id, topic, rows)
            rows = [
                one._replace(judgement='' if one.judgement == 'reject' else 'accept')
                if WHOLE_TRACK in one.stated
                else one
                for one in rows
            ]
            for kind, values in (
                ('rename', [one.track_id for one in rows]),
                ('accept', [one.judgement == 'accept' for one in rows]),
                ('reject', [one.judgement == 'reject' for one in rows]),
            ):
                found += _ranges(track_id, kind, rows, values)
        return held(found + self._left_empty())

    def _left_empty(self) -> list[Decision]:
        """Return where the tracks of the results have no boxes by a decision: none is added."""
        # With kind and value of the decision.
        places: list[tuple[str, int, int, str, str]] = []
        parts: dict[str, list[int]] = {}  # first and last stamps of new tracks
        for one in chain.from_iterable(map(self._of_kind, ('delete', 'reject', 'rename'))):
            if one.stamp_ns is None or one.value == one.track_id:
                continue
            span = _span_of(one)
            places.append((one.track_id, *span, one.kind, one.value))
            if one.kind != 'rename':
                renames = (each for each in self._of_track[one.track_id] if each.kind == 'rename')
                for each in renames:
                    first_ns, last_ns = _span_of(each)
                    part = max(first_ns, span[0]), min(last_ns, span[1])
                    places.append((each.value, *part, one.kind, ''))
            elif one.value in self.apart:
                parts.setdefault(one.value, []).extend(span)
        for name, ends in parts.items():
            places.append((name, -MAX_STAMP_NS, min(ends) - 1, 'delete', ''))
            places.append((name, max(ends) + 1, MAX_STAMP_NS, 'delete', ''))
        for name, rows in self._of_result.items():
            first = self._last('id', rows[0].input_id, rows[0].stamp_ns)
            if first is not None and first.stamp_ns is not None and first.track_id != name:
                # It begins with a part of another track.
                places.append((name, -MAX_STAMP_NS, first.stamp_ns - 1, 'delete', ''))
        found = []
        for name, first_ns, last_ns, kind, value in dict.fromkeys(places):
            rows = self._of_result.get(name, [])
            # Between rejected boxes there is none, either.
            left = (one.stamp_ns for one in rows if one.judgement != kind)
            within = sorted(stamp_ns for stamp_ns in left if first_ns <= stamp_ns <= last_ns)
            if within and kind == 'delete' and MAX_STAMP_NS in (-first_ns, last_ns):
                continue  # beyond an end of a part, which a person has joined to one there
            gaps = [*pairwise([first_ns - 1, *within, last_ns + 1])]
            # From the first box that was joined to the track there, it is not the part given away.
            for before_ns, after_ns in gaps[:1] if kind == 'rename' else gaps:
                if rows and after_ns - before_ns > 1:
                    span = before_ns + 1, after_ns - 1
                    found.append(Decision(name, span[0], kind, end_ns=span[1], value=value))
        return found

    def _note(
        self, track_id: str, input_id: str, stamp_ns: int, attributes: Mapping[str, str]
    ) -> None:
        """Note what was decided about a box of a result, which has these attributes."""
        judgement = self._judgement(input_id, stamp_ns)
        of_track = self._judgement(input_id, MAX_STAMP_NS + 1)  # of no box
        own = self._last('class', input_id, stamp_ns), *self._last_attributes(input_id, stamp_ns)
        added = (one for one in self._of_track.get(input_id, ()) if one.kind == 'add')
        as_class = [replace(one, stamp_ns=None, kind='reclass', box=None) for one in added]
        known = {one.topic: one for one in as_class}
        known |= self._stated_earlier(input_id, stamp_ns)
        known |= {one.topic: one for one in own if one is not None}
        stated = {}
        for topic, one in known.items():
            name, _ = one.attribute
            value = self.class_name(input_id, stamp_ns) or one.value
            if topic != 'class':
                value = f'{name}={attributes[name]}' if name in attributes else ''
            if value:
                stated[topic] = replace(one, track_id=input_id, value=value)
        if of_track is not None and of_track.kind == 'reject':
            stated[WHOLE_TRACK] = of_track
        self._of_result.setdefault(track_id, []).append(
            _Applied(
                stamp_ns,
                input_id,
                self.track_id(input_id, stamp_ns),
                '' if judgement is None else judgement.kind,
                stated,
            )
        )

    def _first_id(self, track_id: str) -> str:
        """Return an id in the input of a track whose boxes there are later."""
        renames = (one for one in self._of_kind('rename') if one.value == track_id)
        return next((one.track_id for one in renames), track_id)

    def _last_attributes(self, input_id: str, stamp_ns: int) -> list[Decision]:
        """Return the last decision about each attribute of a box."""
        rows = self._of_track.get(input_id, ())
        topics = dict.fromkeys(one.topic for one in rows if TOPIC_OF[one.kind] == 'attribute')
        found = (self._last(topic, input_id, stamp_ns) for topic in topics)
        return [one for one in found if one is not None]

    def _left(self, given: BoxArray) -> list[int]:
        """Return the rows of the boxes that are not deleted."""
        return [
            row
            for row, track_id in enumerate(given.track_ids)
            if not self._is_deleted(track_id, given.stamp_ns)
        ]

    def _renamed(self, given: BoxArray) -> BoxArray:
        """Return input boxes with the ids and classes that were decided."""
        track_ids = list(given.track_ids)
        class_names = list(given.class_names)
        for row, track_id in enumerate(given.track_ids):
            new_id = self.track_id(track_id, given.stamp_ns)
            if new_id:
                track_ids[row] = new_id
                self._input_ids[new_id, given.stamp_ns] = track_id
            else:
                self._own_ids.add(track_id)
            if track_id in self._of_track:
                self._boxes.add((track_id, given.stamp_ns))
            class_names[row] = self.class_name(track_id, given.stamp_ns) or class_names[row]
        return replace(given, track_ids=tuple(track_ids), class_names=tuple(class_names))

    def _with_deleted(self, given: BoxArray, refined: RefinedBoxes) -> RefinedBoxes:
        """Return a result with the deleted boxes at their place, as rejected."""
        deleted = sorted(set(range(len(given.track_ids))) - set(self._left(given)))
        if not deleted:
            return refined
        gone = self._renamed(given.plain()).take(deleted)
        return with_rejected(refined, gone, deleted, [Reason.DELETED] * len(deleted))

    def _is_deleted(self, track_id: str, stamp_ns: int) -> bool:
        """Return whether a box is deleted, and a person has set none in its place since."""
        found = self._covering(('deletion', 'judgement', 'addition'), track_id, stamp_ns)
        words = [one.kind for one in found if one.kind in ('delete', *WITH_BOX)]
        return words[-1:] == ['delete']

    def _judgement(self, track_id: str, stamp_ns: int) -> Decision | None:
        """Return the judgement of a box: its own, else that of a range, else of its track."""
        found = None
        for one in self._covering(('judgement',), track_id, stamp_ns):
            if found is None or _closeness(one) >= _closeness(found):
                found = one
        return found

    def _value(self, topic: str, track_id: str, stamp_ns: int) -> str:
        found = self._last(topic, track_id, stamp_ns)
        return found.value if found else ''

    def _last(self, topic: str, track_id: str, stamp_ns: int) -> Decision | None:
        """Return the last decision of a topic about a box."""
        return next(reversed(self._covering((topic,), track_id, stamp_ns)), None)

    def _covering(self, topics: Collection[str], track_id: str, stamp_ns: int) -> list[Decision]:
        """Return the decisions of some topics about a box, in their order."""
        found = [
            one
            for one in self._of_track.get(track_id, ())
            if one.topic in topics and not one.is_taken_back and one.covers(stamp_ns)
        ]
        self._unused -= {one.scope for one in found}
        return found

    def _extents_of_pins(self) -> dict[str, Floats]:
        """Return the mean extents (3,) of the pinned boxes of each track that has any, by id."""
        by_track: dict[str, list[Floats]] = {}
        for one in self._of_kind('pin'):
            assert one.stamp_ns is not None and one.box is not None
            of_track = self._of_track[one.track_id]
            renames = [d for d in of_track if d.kind == 'rename' and d.covers(one.stamp_ns)]
            new_id = renames[-1].value if renames else one.track_id
            by_track.setdefault(new_id, []).append(one.box[BOX_EXTENT])
        return {track_id: np.mean(extents, axis=0) for track_id, extents in by_track.items()}


def _by_track(decisions: Iterable[Decision]) -> dict[str, list[Decision]]:
    """Return decisions by the track that they are about, in their order."""
    found: dict[str, list[Decision]] = {}
    for one in decisions:
        found.setdefault(one.track_id, []).append(one)
    return found


def _array_of(one: Decision, track_id: str, class_name: str) -> BoxArray:
    """Return the box of a decision as an array."""
    assert one.stamp_ns is not None and one.box is not None
    columns = (track_id,), (class_name,), np.ones(1), one.box[None]
    return BoxArray(one.stamp_ns, one.frame_id, *columns)


def _ranges(
    track_id: str, kind: str, rows: Sequence[_Applied], values: Sequence[str | bool]
) -> list[Decision]:
    """Return decisions with the values of a track's boxes: one for each range of equal ones."""
    found = []
    is_rejected = any(WHOLE_TRACK in row.stated for row in rows)  # of which boxes are accepted
    for value, own in groupby(zip(values, rows, strict=True), lambda row: row[0]):
        if value:
            within = [row.stamp_ns for _, row in own]
            is_whole = len(within) == len(rows) and not (is_rejected and kind == 'accept')
            span = (None, None) if is_whole else (within[0], within[-1])
            text = value if isinstance(value, str) else ''
            found.append(Decision(track_id, span[0], kind, end_ns=span[1], value=text))
    return found


def _stated(track_id: str, topic: str, rows: Sequence[_Applied]) -> list[Decision]:
    """
    Return what the boxes of a track were given of a topic of `_Applied.stated`, as ranges.

    They go as far as what was decided, also where there are no boxes yet. A box that a later run
    adds between two others has the input track of the first. Two boxes may have one stamp.

    """
    found = []
    groups = groupby(rows, lambda row: row.stated.get(topic))
    parts = [(one, [*own]) for one, own in groups]
    next_ns = [own[0].stamp_ns for _, own in parts[1:]]
    low_ns, before = -MAX_STAMP_NS, rows[0].input_id  # behind the part before; of its last box
    for (one, own), high_ns in zip(parts, [*next_ns, MAX_STAMP_NS + 1], strict=True):
        first_ns, last_ns = own[0].stamp_ns, own[-1].stamp_ns
        if one is not None:
            span = _span_of(one)
            if before == one.track_id:
                first_ns = min(first_ns, max(span[0], low_ns))
            last_ns = max(last_ns, min(span[1], high_ns - 1))
            found.append(_over(track_id, one, first_ns, last_ns))
        low_ns, before = last_ns + 1, own[-1].input_id
    return found


def _over(track_id: str, one: Decision, first_ns: int, last_ns: int) -> Decision:
    """Return a decision as one about a track from one stamp to another."""
    is_whole = (first_ns, last_ns) == (-MAX_STAMP_NS, MAX_STAMP_NS)
    span = (None, None) if is_whole else (first_ns, last_ns)
    return Decision(track_id, span[0], one.kind, end_ns=span[1], value=one.value)


def _span_of(decision: Decision) -> tuple[int, int]:
    """Return the first and the last stamp that a decision is about."""
    first_ns, last_ns = decision.stamp_ns, decision.end_ns
    if first_ns is None:
        return -MAX_STAMP_NS, MAX_STAMP_NS
    return first_ns, first_ns if last_ns is None else last_ns


def _closeness(decision: Decision) -> int:
    """Return how few boxes a decision is about: 2 for one, 1 for a range, 0 for a track."""
    if decision.stamp_ns is None:
        return 0
    return 2 if decision.end_ns is None else 1
