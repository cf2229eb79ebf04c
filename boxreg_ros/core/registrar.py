"""The stateful object of the core: sweeps and box arrays in, refined boxes out."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import chain, takewhile
from math import ceil, inf
from typing import TYPE_CHECKING

from boxreg_ros.config import Config, KINDS
from boxreg_ros.core.box_time import BoxTimeEvidence, motion_to_sight, swept
from boxreg_ros.core.field_of_view import FieldOfView
from boxreg_ros.core.following.stream import FollowedObjects
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.core.input_statistics import Drives
from boxreg_ros.core.latency import Latency, LatencyCorrection
from boxreg_ros.core.matching import Pair, StampMatcher
from boxreg_ros.core.method.constants import Constants
from boxreg_ros.core.observation import Observation, observe
from boxreg_ros.core.pending import ObservedTrack, PendingArray, PendingBox, results
from boxreg_ros.core.problem import settings_of_kinds
from boxreg_ros.core.support import is_owned, points_inside
from boxreg_ros.core.tables import by_table
from boxreg_ros.core.visible_boxes import VisibleBoxes
from boxreg_ros.core.window import Estimate, PRIOR_POSES, Window
from boxreg_ros.errors import ConfigError
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import BoxArray, Floats, is_valid_box, RefinedBoxes, Sweep, X, Z
import numpy as np

if TYPE_CHECKING:
    from boxreg_ros.core.point_labels import ObjectTrack, PointLabeller

GetEstimates = Callable[[], list[Estimate | None]]
"""Waits for the estimates of submitted windows, None for windows that are too short."""
Submit = Callable[[list[Window], Config, InputModel], GetEstimates]
"""Starts `estimate_windows` with the same arguments, perhaps in another process."""
Publish = Callable[[RefinedBoxes], None]
"""Takes early boxes before the final ones of older arrays are made."""
Prepare = Callable[[Pair], BoxArray]
"""Returns the boxes to register in place of those of a pair, which are in time."""
Budget = Callable[[int], int]
"""
Returns how many windows may be solved for the box array at hand.

Its argument is the number that refines every final box: one of each track in `lag` + 1 arrays.

"""

VELOCITY_OBSERVATIONS = 4
"""Observations that the input velocity is estimated from; chosen: 0.3 s at 10 Hz."""
REACTION_TIME = 2.0
"""Of tracks that cannot all be solved, those that come nearest within this time come first [s].
Literature: the time headway that drivers are told to keep."""
_OfTrack = tuple[ObservedTrack, PendingBox]
"""A box and its track; boxes do not refer to tracks: cycles would wait for garbage collection."""
_Submitted = tuple[ObservedTrack, list[PendingBox], bool]
"""A track with the observations of its submitted window, and whether it has ended."""


class BoxRegistrar:
    """
    Register the boxes of a stream to its sweeps.

    The order of calls is the only input: a registrar reads no clock, no topic and no file, and
    the same calls return the same boxes. All sweeps and boxes are in one fixed frame. Not
    thread-safe.

    Each box array added is returned exactly once with ``is_final=True``, with all its boxes in
    the order of the input; `coasted` boxes follow. Stamps of returned arrays ascend; a late array
    stands before the younger ones that have not been returned. With `estimate` 'early' or 'final'
    an array is returned once more before that, with ``is_final=False``, as soon as its sweep is
    known.

    Parameters
    ----------
    config : Config
        Settings.
    submit : callable, optional
        Starts `estimate_windows` elsewhere, with its arguments, and returns a callable that waits
        for the estimates. With `estimate` 'track' the registrar goes on meanwhile: the boxes
        returned are the same, but one submission later. Default: it runs at once, here.
    budget : callable, optional
        Called once for each box array with `estimate` 'early' or 'final'; limits the windows that
        are solved for it. Default: all are.
    drives : Drives, optional
        What other drives of the same detector have shown of its errors, to begin with.
    has_whole_sweeps : bool
        Whether sweeps have all points of the LiDAR. Points near objects alone are no evidence of
        its field of view.
    constants : Constants, optional
        Numbers of the method, if others than the usual ones, as for the boxes of a person.
    latency : Latency, optional
        Of the boxes, where it is known; default: as set, or estimated, see `LatencyCorrection`.
    prepare : callable, optional
        Called with each pair whose boxes are in time; returns those to register in their place,
        with the same stamp and ticket. Default: the same.

    Attributes
    ----------
    config : Config
        May be replaced between calls. `sampling`, `solver`, `paper`, `max_gap`, `coast`,
        `min_observations` and the groups of object classes take effect at once, other settings
        after `reset`.
    counts : Counter
        Sweeps and boxes added, boxes by status, and everything dropped or kept, by reason.
    box_time : BoxTimeEvidence
        Evidence of the time that the input boxes are of.
    visible_boxes : VisibleBoxes
        Evidence that the input boxes hold what is seen of their objects.
    followed : FollowedObjects
        Objects that are followed from one box each, see `follow`.
    publish : callable or None
        Called with early boxes as soon as they are known; by default they are returned.

    Notes
    -----
    A **box array** passes through these states, in this order:

    1. *Unpaired*: held by `StampMatcher` until its sweep is known, or known not to come. Then its
       late boxes are brought to their stamp by `LatencyCorrection`, where arrays wait with
       'track'.
    2. *Pending*: each valid box is an observation of the track with its id. A box that cannot be
       refined has a reason and is not waited for, nor are the boxes of `add_kept`. Estimates
       overwrite each other until they are settled.
    3. *Settled*: no estimate changes any more. With 'early' and 'final' an array is settled when
       `lag` younger arrays are paired. With 'track' it is settled when all its observations have
       been estimated in a window where they are not among the newest eighth.
    4. *Returned*: arrays are returned in the order of their stamps, so a settled array waits for
       the arrays before it.

    A **track** starts with the first observation of its id. With 'early' and 'final' its window
    (its last `window` observations) is estimated at each of its observations. With 'track' it is
    estimated when some track has `track_window` observations, together with all tracks of more
    than half as many. A track ends after `max_gap` without an observation, when its id is given
    to another object, or, with 'track', at `flush`. It is then estimated a last time with the next
    windows, which settles all its observations; with 'early' and 'final' only if something is new
    since its last window.

    With `coast`, a track that misses a detection gets an observation at its predicted box where
    the points confirm it. Such a box is in the results while it is refined, with the status
    ``coasted`` and the score 0.

    An object that is **followed** has such a box wherever a box array has none of its id and its
    points support it, refined or not.

    With a **budget**, waiting tracks that have no box here are solved first, since their boxes
    become final before they end; then as many of those that have waited longest as let every
    track be solved before its boxes are final, less those that `catch_up` has solved since the
    last box array; then those that come nearest to a sensor within `REACTION_TIME`. The boxes of
    the others are kept for now, with the reason ``budget``; their observations join the next
    window that is solved. While there is time, `catch_up` solves tracks that wait, for their
    final boxes.

    """

    def __init__(
        self,
        config: Config,
        submit: Submit | None = None,
        budget: Budget | None = None,
        drives: Drives | None = None,
        has_whole_sweeps: bool = True,
        constants: Constants | None = None,
        latency: Latency | None = None,
        prepare: Prepare | None = None,
    ) -> None:
        self.config = config
        self.counts: Counter[str] = Counter()
        self.publish: Publish | None = None
        self._submit = submit
        self._budget = budget
        self._drives = drives
        self._has_whole_sweeps = has_whole_sweeps
        self._constants = constants
        self._prepare = prepare
        self._correction = LatencyCorrection(config.estimate == 'track', latency)
        self.visible_boxes = VisibleBoxes(config)
        self.reset()

    def reset(self) -> None:
        """Discard tracks and box arrays that are held; keep the counts, and what boxes are."""
        config = self.config
        self._correction.restart()
        self._matcher = StampMatcher(config, self.counts)
        self._input_model = InputModel(config.faces, self._drives, self._constants)
        self.box_time = BoxTimeEvidence()
        self._view = FieldOfView() if self._has_whole_sweeps else None
        self.followed = FollowedObjects(config)
        self._pending = deque[PendingArray]()
        self._ready: list[RefinedBoxes] = []  # survives an error while further ones are made
        self._newest_ns = -inf
        self._tracks: dict[str, ObservedTrack] = {}
        self._ended_tracks: list[ObservedTrack] = []
        self._arrays_since_solve = 0
        self._num_caught_up = 0  # windows, since the last box array
        self._submitted: list[_Submitted] = []
        self._get_estimates: GetEstimates = list
        if config.estimate == 'track':
            # The ends of a window are its weakest part. The newest eighth of its observations is
            # estimated again in the next window, after another eighth that is settled.
            eighth = config.track_window // 8
            self._num_overlapping = 2 * eighth
            self._num_unsettled = eighth
        else:
            self._num_overlapping = config.window - 1
            self._num_unsettled = config.window

    def add_sweep(self, sweep: Sweep) -> list[RefinedBoxes]:
        """
        Add a sweep; return the box arrays that are completed by it.

        Parameters
        ----------
        sweep : Sweep
            In the fixed frame; its points may be in their own, see `Sweep.T_frame_points` [m]. One
            that was dropped has no points, and boxes of its stamp do not wait for another.

        Returns
        -------
        list of RefinedBoxes
            In the fixed frame, by their stamps.

        Raises
        ------
        ShapeError
            If boxes of its stamp are in another frame.

        """
        self.counts['sweeps'] += not sweep.is_dropped
        if self.config.estimate != 'track':  # otherwise nothing is followed
            self.followed.add_sweep(sweep)  # of some seconds: a copy of each would take memory
        sweep = sweep.in_columns()
        self._correction.add_sweep(sweep)
        return self._process(self._matcher.add_sweep(sweep))

    def release(self, stamp_ns: int) -> list[RefinedBoxes]:
        """Return the box arrays that are completed as those up to a stamp wait for no sweep."""
        return self._process(self._matcher.release(stamp_ns))

    def add_boxes(self, boxes: BoxArray) -> list[RefinedBoxes]:
        """
        Add a box array; return the box arrays that are completed by it.

        Parameters
        ----------
        boxes : BoxArray
            In the fixed frame [m, rad]. An id is that of one object over time. Invalid boxes,
            those without an id, and further ones of an id in the array are kept.

        Returns
        -------
        list of RefinedBoxes
            In the fixed frame, by their stamps.

        Raises
        ------
        ShapeError
            If their sweep is in another frame.

        """
        self.counts['boxes'] += len(boxes.track_ids)
        return self._process(self._matcher.add_boxes(boxes))

    def add_kept(self, boxes: BoxArray, reason: str) -> list[RefinedBoxes]:
        """
        Add a box array that cannot be refined; return the box arrays that are completed by it.

        Parameters
        ----------
        boxes : BoxArray
            In any frame. One without a stamp stands behind the newest array.
        reason : str
            Why its boxes are returned as they are.

        """
        self.counts['boxes'] += len(boxes.track_ids)
        return self._process(self._matcher.add_boxes(boxes, reason))

    def follow(self, boxes: BoxArray) -> None:
        """
        Follow the object of each box, with `estimate` 'early' or 'final', see the notes.

        Parameters
        ----------
        boxes : BoxArray
            Boxes of a person in the fixed frame [m, rad]. The object of an id that is followed
            starts anew; a box without an id, or an invalid one, is listed in ``followed.refused``.

        Raises
        ------
        ConfigError
            With `estimate` 'track': whole tracks follow objects by `boxreg_ros.follow`.

        """
        if self.config.estimate == 'track':
            raise ConfigError(
                "estimate: expected 'early' or 'final' to follow objects live, got 'track'; "
                'set another one, or follow them through all sweeps by boxreg_ros.follow'
            )
        self.followed.add(boxes)

    def flush(self) -> list[RefinedBoxes]:
        """Return all box arrays held. Tracks end with `estimate` 'track', else they go on."""
        self._register(chain(self._in_time(self._matcher.flush()), self._correction.flush()))
        if self.config.estimate == 'track':
            self._end(list(self._tracks))
            self._solve([])
        for array in self._pending:
            array.num_unsettled = 0
        return self._returned()

    def abandon(self, reason: str) -> list[RefinedBoxes]:
        """
        Return all box arrays held, kept for a reason, after an error; reset everything else.

        Parameters
        ----------
        reason : str
            Why their boxes are kept, as one of `Reason`.

        Returns
        -------
        list of RefinedBoxes
            Final ones, by their stamps.

        """
        unpaired = [*self._correction.waiting, *self._matcher.unpaired]
        self._pending.extend(PendingArray(boxes) for boxes in unpaired)
        for array in self._pending:
            array.keep_all(reason)
            array.num_unsettled = 0
        ready = self._returned()
        self.reset()
        return ready

    def catch_up(self, limit: int) -> list[RefinedBoxes]:
        """
        Solve tracks that the budget made wait, which refines boxes that are not final yet.

        Parameters
        ----------
        limit : int
            Most windows to solve; the tracks that have waited longest come first.

        """
        waiting = [track for track in self._tracks.values() if track.num_carried]
        if waiting:
            chosen = _by_urgency(waiting, limit)[:limit]
            self._num_caught_up += len(chosen)
            self._solve(chosen)
        return self._returned()

    @property
    def num_waiting(self) -> int:
        """Return the number of tracks whose newest observation is in no window yet."""
        return sum(track.num_carried > 0 for track in self._tracks.values())

    def margins(self) -> Floats:
        """Return the labelling margin of each face, of each of `KINDS`, (K, 6) [m]."""
        inputs = self._input_model.inputs(self.config, with_noise=False)
        margins: Floats = settings_of_kinds(self.config)['gaps'] + inputs['margin']
        return margins

    def labeller(
        self, objects: Sequence[ObjectTrack], array_stamps_ns: Iterable[int]
    ) -> PointLabeller:
        """
        Return what labels points by boxes, with the margins and the time of boxes known so far.

        Parameters
        ----------
        objects : sequence of ObjectTrack
            All that have boxes.
        array_stamps_ns : iterable of int
            At which the input has boxes, or states that there are none [ns].

        """
        from boxreg_ros.core.point_labels import PointLabeller  # few need it

        config = self.box_time.resolved(self.config)
        margins = self.margins()[[KINDS.index(config.kind(one.class_name)) for one in objects]]
        stamps_ns = np.array([*array_stamps_ns], np.int64)
        return PointLabeller(objects, stamps_ns, config, margins.reshape(-1, 6))

    def statistics(self, name: str = '') -> Drives:
        """Return what the boxes so far have shown of their detector, by a `name`."""
        return self._input_model.statistics(name)

    @property
    def latency(self) -> Latency:
        """Return the latency of the boxes, by which they are corrected."""
        return self._correction.latency

    @property
    def unpaired(self) -> list[BoxArray]:
        """Return the box arrays whose sweep is not known, in their order."""
        return self._matcher.unpaired

    @property
    def num_held(self) -> int:
        """Return the number of box arrays that have not been returned as final."""
        paired = len(self._correction.waiting) + len(self._pending)
        return len(self._matcher.unpaired) + paired

    def _process(self, pairs: Iterator[Pair]) -> list[RefinedBoxes]:
        self._register(self._in_time(pairs))
        return self._returned()

    def _in_time(self, pairs: Iterator[Pair]) -> Iterator[Pair]:
        """Yield pairs with their late boxes corrected, as soon as the latency is known."""
        return self._correction.add(pairs, self.config)

    def _register(self, pairs: Iterator[Pair]) -> None:
        """Observe pairs, and solve the windows that they complete."""
        for pair in pairs:
            array = self._open(pair)
            is_track = self.config.estimate == 'track'
            if not pair.reason:
                if is_track:
                    self._solve_full_windows()
                else:
                    self._solve(self._within_budget(array))
            if not is_track:
                self._ready += self._published(results([array], is_final=False))
                self._settle_after_lag()
            self._pop_settled()

    def _published(self, early: Iterator[RefinedBoxes]) -> list[RefinedBoxes]:
        """Publish early boxes; return those that are to be returned."""
        if self.publish is None:
            return [*early]
        for refined in early:
            self.publish(refined)
        return []

    def _open(self, pair: Pair) -> PendingArray:
        """Make a box array pending: its valid boxes become observations of their tracks."""
        array = PendingArray(pair.boxes)
        self._queue(array)
        if pair.reason:
            array.keep_all(pair.reason)
            return array
        if self._prepare is not None:
            array.set_input(self._prepare(pair))
        boxes, sweep = array.input, pair.sweep
        reason = ''
        if boxes.stamp_ns < self._newest_ns:
            reason = Reason.LATE
        elif boxes.stamp_ns == self._newest_ns:
            reason = Reason.DUPLICATE_STAMP
        self._newest_ns = max(boxes.stamp_ns, self._newest_ns)
        array.is_observed = sweep is not None and not reason
        if sweep is None:
            self.counts[Reason.BOXES_WITHOUT_SWEEP] += 1
            reason = reason or (Reason.CLOUD_DROPPED if pair.is_dropped else Reason.NO_SWEEP)
        array.set_reasons(reason)
        self._end_silent_tracks(boxes.stamp_ns)
        if sweep is not None:
            self._observe(array, sweep)
        return array

    def _queue(self, array: PendingArray) -> None:
        """Append an array to those that are returned in their order; a late one to its place."""
        stamp_ns = array.input.stamp_ns
        place = len(self._pending)
        if 0 < stamp_ns < self._newest_ns:
            while place and self._pending[place - 1].input.stamp_ns > stamp_ns:
                place -= 1
        self._pending.insert(place, array)

    def _observe(self, array: PendingArray, sweep: Sweep) -> None:
        """Add an observation to the track of each box that has no reason not to be refined."""
        boxes = array.input
        given = self._given(array)
        coasting = [*self._followed(array, sweep), *self._coasting(array)]
        if not (given or coasting):
            return
        seen, velocities = self._seen([*given, *coasting], boxes, sweep)
        confirmed = _confirmed(coasting, seen[len(given) :])
        if len(confirmed) < len(coasting):
            # A box that is not confirmed owns no points.
            self.counts[Reason.COAST_UNCONFIRMED] += len(coasting) - len(confirmed)
            if not (given or confirmed):
                return
            seen, velocities = self._seen([*given, *confirmed], boxes, sweep)
        self.box_time.add(seen[: len(given)], velocities[: len(given)])
        for track, one in confirmed:
            array.add_predicted(track, one)
        array.observe([one for _, one in (*given, *confirmed)], seen)
        track_ids = [track.track_id for track, _ in given]
        for (track, one), observation in zip(given, seen, strict=False):
            track.add(one, observation)
            track.detected_ns = boxes.stamp_ns
            if self.visible_boxes.are_found:
                track.lengthen()
            successor = track.split_at_id_switch()
            if successor is not None:
                self._end([track.track_id])
                self._tracks[track.track_id] = successor
        for (track, one), observation in zip(confirmed, seen[len(given) :], strict=True):
            track.add(one, observation)
        if self.visible_boxes.add(track_ids, seen[0].table):
            for track in (*self._ended_tracks, *self._tracks.values()):
                track.lengthen()

    def _given(self, array: PendingArray) -> list[_OfTrack]:
        """Return the boxes that have no reason not to be refined."""
        boxes = array.input
        given = []
        for row, track_id in enumerate(boxes.track_ids):
            if not array.reasons[row]:
                if track_id not in self._tracks:
                    self._tracks[track_id] = ObservedTrack(track_id, boxes.class_names[row])
                one = PendingBox(boxes.stamp_ns, boxes.boxes[row], row)
                given.append((self._tracks[track_id], one))
        return given

    def _followed(self, array: PendingArray, sweep: Sweep) -> list[_OfTrack]:
        """Return the boxes of followed objects that have none in `array`."""
        if not (array.is_observed and self.followed.has_objects):
            return []
        boxes = array.input
        others = boxes.boxes[is_valid_box(boxes.boxes)]
        found = []
        for one in self.followed.boxes_at(boxes.stamp_ns, sweep.stamp_ns, others):
            if one.track_id in boxes.track_ids:
                continue
            if is_owned(one.box, others):
                self.counts[Reason.COAST_UNCONFIRMED] += 1
                continue
            others = np.vstack([others, one.box])
            track = self._tracks.setdefault(
                one.track_id, ObservedTrack(one.track_id, one.class_name)
            )
            box = PendingBox(boxes.stamp_ns, one.box, is_predicted=True, is_followed=True)
            found.append((track, box))
        return found

    def _coasting(self, array: PendingArray) -> list[_OfTrack]:
        """Return the predicted boxes of the tracks that have no box in `array`."""
        if not (self.config.coasts and array.is_observed):
            return []
        boxes = array.input
        present = {*boxes.track_ids, *self.followed.track_ids}
        others = boxes.boxes[is_valid_box(boxes.boxes)]
        found = []
        for track in self._tracks.values():
            if track.track_id in present or not track.coasts(boxes.stamp_ns, self.config):
                continue
            box = track.predicted(boxes.stamp_ns, self.config)
            if is_owned(box, others):
                self.counts[Reason.COAST_UNCONFIRMED] += 1
                continue
            others = np.vstack([others, box])
            found.append((track, PendingBox(boxes.stamp_ns, box, is_predicted=True)))
        return found

    def _seen(
        self, to_observe: list[_OfTrack], given: BoxArray, sweep: Sweep
    ) -> tuple[list[Observation], Floats]:
        """Return the observation of each box at the stamp of `given`, and their velocities."""
        stamp_ns = given.stamp_ns
        boxes = np.array([one.box for _, one in to_observe])
        at_sweep = boxes.copy()
        offset = (sweep.stamp_ns - stamp_ns) * 1e-9  # [s]
        velocities = motion = np.zeros((len(boxes), 3))
        is_compensated = offset != 0 or sweep.times is not None
        if is_compensated:
            velocities = _input_velocities(to_observe, boxes, stamp_ns)
            # The points are relative to the box: motion-compensated to the stamp of the box.
            at_sweep[:, X : Z + 1] += offset * velocities
            if self.config.sampling.deskew:
                motion = motion_to_sight(sweep, at_sweep, velocities)
                at_sweep = swept(at_sweep, motion)
        table = observe(sweep, at_sweep, stamp_ns, self.config, self._view)
        if is_compensated:
            table = table.relative_to(boxes, motion / 2)
        if given.pinned is not None:
            pinned = [one.row >= 0 and given.pinned[one.row] for _, one in to_observe]
            table = table._replace(is_pinned=np.array(pinned))
        return [Observation(table, row) for row in range(len(boxes))], velocities

    def _end_silent_tracks(self, now_ns: int) -> None:
        """End the tracks without a box for `max_gap`."""
        oldest_ns = now_ns - round(self.config.max_gap * 1e9)
        silent = [name for name, track in self._tracks.items() if track.newest_ns < oldest_ns]
        for name in silent:
            # Estimated again, boxes would differ from those that `flush` returns in a pause.
            if self.config.estimate != 'track' and self._tracks[name].is_estimated:
                self._tracks.pop(name).settle()
            else:
                self._end([name])

    def _end(self, track_ids: list[str]) -> None:
        """End tracks; they are estimated a last time with the next windows."""
        self._ended_tracks += [self._tracks.pop(track_id) for track_id in track_ids]

    def _settle_after_lag(self) -> None:
        """Settle the arrays that have `lag` younger ones, which are in their windows."""
        observed = [array for array in self._pending if array.is_observed]
        for array in observed[: max(0, len(observed) - self._lag)]:
            array.num_unsettled = 0

    @property
    def _lag(self) -> int:
        """Return the number of later arrays that a final box waits for."""
        return min(self.config.lag, self.config.window - 1)

    def _solve_full_windows(self) -> None:
        """Solve when a window is full, together with tracks that fill more than half of one."""
        self._arrays_since_solve += 1
        full = self.config.track_window
        lengths = [len(track.entries) for track in self._tracks.values()]
        if self._arrays_since_solve >= full or any(length >= full for length in lengths):
            # More tracks at once give a better estimate of the errors of the input.
            tracks = self._tracks.values()
            self._solve([track for track in tracks if len(track.entries) > full // 2])

    def _within_budget(self, array: PendingArray) -> list[ObservedTrack]:
        """Return the tracks to solve now; the others are carried to the next box array."""
        tracks = [track for track in self._tracks.values() if track.is_in(array)]
        if self._budget is None:
            return tracks
        ready = [t for t in tracks if len(t.entries) >= self.config.min_observations]
        # Nothing is gained by a longer wait of those that have no box here.
        silent = [t for t in self._tracks.values() if t.num_carried and not t.is_in(array)]
        # An ended track that waits has its last chance; the others have an estimate.
        self._ended_tracks.sort(key=lambda track: -track.num_carried)
        num_ended = sum(track.num_carried > 0 for track in self._ended_tracks)
        # A track that has waited keeps two observations of its prior beside the new ones.
        longest_wait = min(self._lag + 1, self.config.window - PRIOR_POSES)
        num_last = num_ended + len(silent)
        arrays_left = longest_wait - np.array([track.num_carried for track in ready])
        # As many may be caught up until the next array as since the last. If not, tracks that have
        # waited for half of their time are solved in equal shares while it lasts.
        num_due = max(
            ceil(np.count_nonzero(arrays_left <= number) / number)
            for number in range(1, (longest_wait + 1) // 2 + 1)
        )
        num_rotating = max(num_due, ceil(len(ready) / longest_wait) - self._num_caught_up)
        self._num_caught_up = 0
        limit = self._budget(num_last + num_rotating)
        self._settle_ended_tracks_beyond(max(limit - len(ready), min(limit, num_ended)))
        limit = max(0, limit - len(self._ended_tracks))
        silent = silent[:limit]
        limit -= len(silent)
        if len(ready) <= limit:
            return silent + tracks
        ready = _by_urgency(ready, num_rotating)
        for track in ready[limit:]:
            track.carry(self._num_overlapping)
        return silent + ready[:limit]

    def _settle_ended_tracks_beyond(self, limit: int) -> None:
        """Settle ended tracks but the first ones: none can wait."""
        for track in self._ended_tracks[limit:]:
            track.settle()
        del self._ended_tracks[limit:]

    def _solve(self, tracks: list[ObservedTrack]) -> None:
        """Submit the windows of `tracks` and of ended tracks, after collecting those before."""
        self._collect()
        ended = self._ended_tracks
        self._submitted = [(track, track.entries, True) for track in ended]
        self._submitted += [(track, track.entries, False) for track in tracks]
        windows = _windows(ended + tracks)
        submit = self._submit or submit_locally
        config = self.box_time.resolved(self.config)
        self._get_estimates = submit(windows, config, self._input_model)
        for track in tracks:
            track.forget(self._num_overlapping)
        self._ended_tracks = []
        self._arrays_since_solve = 0
        goes_on = self.config.estimate == 'track' and self._submit is not None
        if not goes_on or not self._tracks:
            self._collect()

    def _collect(self) -> None:
        """Wait for the estimates of submitted windows; write them to the box arrays."""
        estimates = self._get_estimates()
        for (track, entries, is_ended), estimate in zip(self._submitted, estimates, strict=True):
            if estimate is not None:
                track.write(estimate, entries, self._num_overlapping)
            settled = entries if is_ended else entries[: -self._num_unsettled]
            for entry in settled:
                entry.settle()
        self._submitted = []
        self._get_estimates = list

    def _pop_settled(self) -> None:
        """Make the results of settled box arrays, up to the first one that is not."""
        settled = [*takewhile(lambda array: array.num_unsettled <= 0, self._pending)]
        for refined in results(settled, is_final=True):
            self._pending.popleft()
            self.counts.update(refined.status)
            self.counts.update(reason for reason in refined.reasons if reason)
            self._ready.append(refined)

    def _returned(self) -> list[RefinedBoxes]:
        """Return the results that are ready, once."""
        self._pop_settled()
        ready = self._ready
        self._ready = []
        return ready


def _windows(tracks: Sequence[ObservedTrack]) -> list[Window]:
    """Return for each track the window of all observations that it holds."""
    windows = []
    for track in tracks:
        num_new = len(track.seen) - len(track.starts)
        windows.append(
            Window(
                track.track_id,
                track.class_name,
                track.seen,
                num_new,
                np.reshape(track.starts, (-1, 9)),
                track.prior,
            )
        )
    return windows


def _by_urgency(tracks: list[ObservedTrack], num_rotating: int) -> list[ObservedTrack]:
    """
    Return tracks in the order in which they are solved.

    First `num_rotating` of those that have waited longest, then those that come nearest to a
    sensor within `REACTION_TIME`, if they approach it as they did.

    """
    carried = np.array([track.num_carried for track in tracks])
    before = [track.seen[-VELOCITY_OBSERVATIONS:][0] for track in tracks]
    newest = [track.seen[-1] for track in tracks]
    elapsed = 1e-9 * np.array(
        [b.stamp_ns - a.stamp_ns for a, b in zip(before, newest, strict=True)]
    )
    ranges = _ranges(newest)
    approached = _ranges(before) - ranges
    speed = np.divide(approached, elapsed, out=np.zeros(len(tracks)), where=elapsed > 0)
    nearest = ranges - REACTION_TIME * np.maximum(speed, 0.0)  # (n,) [m]; NaN, last, if unknown
    order = np.lexsort((nearest, -carried))
    rest = order[num_rotating:]
    order[num_rotating:] = rest[np.argsort(nearest[rest], kind='stable')]
    return [tracks[i] for i in order.tolist()]


def _ranges(seen: Sequence[Observation]) -> Floats:
    """Return the distance of each box from the nearest sensor that sees it, (n,) [m]."""
    ranges = np.empty(len(seen))
    for table, places, rows in by_table(seen):
        ranges[places] = np.linalg.norm(table.origins[rows], axis=2).min(1)
    return ranges


def _input_velocities(to_observe: list[_OfTrack], boxes: Floats, stamp_ns: int) -> Floats:
    """Return the mean velocities (n, 3) of the input centres up to the new `boxes` [m/s]."""
    velocities = np.zeros((len(boxes), 3))
    known = [row for row, (track, _) in enumerate(to_observe) if track.entries]
    if known:
        before = [to_observe[row][0].entries[-VELOCITY_OBSERVATIONS:][0] for row in known]
        elapsed = stamp_ns - np.array([one.stamp_ns for one in before])
        centers = np.array([one.place[:3] for one in before])
        velocities[known] = (boxes[known, X : Z + 1] - centers) / elapsed[:, None] * 1e9
    return velocities


def _confirmed(coasting: list[_OfTrack], seen: list[Observation]) -> list[_OfTrack]:
    """Return those of the predicted boxes that have enough points."""
    inside = points_inside(seen)
    return [
        (track, one)
        for (track, one), count in zip(coasting, inside.tolist(), strict=True)
        if one.is_followed or count >= track.least_points
    ]


def submit_locally(windows: list[Window], config: Config, model: InputModel) -> GetEstimates:
    """
    Return a function that runs `estimate_windows` in this process, which imports torch.

    Parameters
    ----------
    windows : list of Window
        Of one track each.
    config : Config
        Settings.
    model : InputModel
        Updated when the function is called.

    Returns
    -------
    callable
        Without arguments; returns the estimates as `estimate_windows` does.

    """
    from boxreg_ros.core.estimation import estimate_windows

    return partial(estimate_windows, windows, config, model)
