"""The one stateful object of the core: sweeps and boxes in, refined boxes out, nothing else."""

from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from math import dist, inf

from boxreg_ros.config import Config
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.core.matching import Pair, StampMatcher
from boxreg_ros.core.observation import Observation, observe
from boxreg_ros.core.registration import Estimate, register
from boxreg_ros.core.window import Memory, Window
from boxreg_ros.errors import ConfigError
from boxreg_ros.structures import (
    BoxArray,
    Floats,
    is_valid_box,
    KEPT,
    LENGTH,
    RefinedBoxes,
    Sweep,
    X,
    Z,
)
import numpy as np
import torch

Awaited = Callable[[], list[Estimate | None]]
Begin = Callable[[list[Window], Config, InputModel], Awaited]


class BoxRegistrar:
    """
    Register the boxes of a stream to its sweeps.

    Deterministic: the order of calls is its only input. It knows no clock, no topic, no file and
    one frame, the fixed frame of all that is added. Not thread-safe.

    Every box array added comes back exactly once with ``is_final=True``, all its boxes in the
    order of the input, stamps ascending but for what came late. With `estimate` 'early' or
    'final' it comes back once more before that, with ``is_final=False``, as soon as it is paired.

    Parameters
    ----------
    config : Config
        Settings.
    begin : callable, optional
        Begins `register` elsewhere, with the arguments of that, and returns what waits for its
        estimates. With `estimate` 'track' more is taken meanwhile; what comes back is the same,
        but comes when the next windows are full.

    Attributes
    ----------
    config : Config
        May be replaced between calls; `sampling`, `solver`, `paper`, `max_gap`,
        `min_observations` and how classes move have effect at once, the others after `reset`.
    counts : Counter
        Sweeps and boxes taken, boxes by status, and everything dropped or kept by reason.

    """

    def __init__(self, config: Config, begin: Begin | None = None) -> None:
        try:
            torch.zeros(1, device=config.device)
        except (AssertionError, RuntimeError) as error:  # torch says it in either way
            wanted = "device: expected one that torch can use here, such as 'cpu', got "
            raise ConfigError(f'{wanted}{config.device!r}: {str(error).splitlines()[0]}') from None
        self.config, self._begin = config, begin
        self.counts: Counter[str] = Counter()
        self.reset()

    def reset(self) -> None:
        """Forget everything but the counts."""
        self._matcher, window = StampMatcher(self.config, self.counts), self.config.window
        # The ends of a window are its weakest part: of whole tracks an eighth waits for the next
        # window, which sees another eighth of settled ones before it.
        eighth, is_track = self.config.track_window // 8, self.config.estimate == 'track'
        self._keep, self._wait = (2 * eighth, eighth) if is_track else (window - 1, window)
        self._tracks, self._ticks = dict[str, _TrackBuffer](), deque[_Tick]()
        self._newest_ns, self._model = -inf, InputModel(self.config.faces)
        self._ended, self._count = list[_TrackBuffer](), 0
        self._work = list[tuple[_TrackBuffer, list[_Entry], bool]]()
        self._result: Awaited = list

    def add_sweep(self, sweep: Sweep) -> list[RefinedBoxes]:
        """Take a sweep; return what has become ready."""
        self.counts['sweeps'] += not sweep.is_lost
        return list(self._advance(self._matcher.add_sweep(sweep)))

    def add_boxes(self, boxes: BoxArray) -> list[RefinedBoxes]:
        """Take a box array; return what has become ready."""
        self.counts['boxes'] += len(boxes.track_ids)
        return list(self._advance(self._matcher.add_boxes(boxes)))

    def flush(self) -> list[RefinedBoxes]:
        """Return everything still held; with `estimate` 'track' tracks end, else they go on."""
        ready = list(self._advance(self._matcher.flush()))
        if self.config.estimate == 'track':  # what is live is known already, and may be in haste
            self._end(list(self._tracks))
            self._solve([])
        for tick in self._ticks:
            tick.waiting = 0
        return [*ready, *self._settled()]

    def _advance(self, pairs: list[Pair]) -> Iterator[RefinedBoxes]:
        full = self.config.track_window
        for pair in pairs:
            tick = self._open(pair)
            self._count += 1
            if self.config.estimate != 'track':
                self._solve([t for t in self._tracks.values() if t.entries[-1].tick is tick])
                yield tick.result(is_final=False)
                lag = min(self.config.lag, self.config.window - 1)
                for old in [t for t in self._ticks if t.is_paired][::-1][lag:]:
                    old.waiting = 0
            elif self._count >= full or any(len(t.entries) >= full for t in self._tracks.values()):
                # Tracks that are half full are solved with those that are full, or have ended:
                # the more at once, the better they tell the errors of the input.
                self._solve([t for t in self._tracks.values() if len(t.entries) > full // 2])
            yield from self._settled()

    def _open(self, pair: Pair) -> '_Tick':
        """Start a tick: sort its boxes out and add an observation to the track of each."""
        boxes, sweep, now_ns = *pair, pair.boxes.stamp_ns
        tick = _Tick(boxes)
        self._ticks.append(tick)
        newest_ns, self._newest_ns = self._newest_ns, max(now_ns, self._newest_ns)
        late = '' if now_ns > newest_ns else 'late' if now_ns < newest_ns else 'duplicate_stamp'
        tick.is_paired = sweep is not None and not late
        self.counts.update(['boxes_without_sweep'] if sweep is None else [])
        tick.refuse(late or ('no_sweep' if sweep is None else ''))
        admitted = [i for i, reason in enumerate(tick.reasons) if not reason]
        due = now_ns - round(self.config.max_gap * 1e9)
        self._end([k for k, t in self._tracks.items() if t.entries[-1].observation.stamp_ns < due])
        if sweep is not None and admitted:
            fresh = [_TrackBuffer(boxes.track_ids[i], boxes.class_names[i]) for i in admitted]
            tracks = [self._tracks.setdefault(track.track_id, track) for track in fresh]
            given, there = boxes.boxes[admitted], boxes.boxes[admitted]
            if delay := (sweep.stamp_ns - now_ns) * 1e-9:
                # Seen from the box, points are where they were at the stamp of the box.
                moves = [t.velocity(box, now_ns) for t, box in zip(tracks, given, strict=True)]
                there[:, X : Z + 1] += delay * np.array(moves)
            seen = observe(sweep, there, now_ns, self.config)
            for i, track, box, observation in zip(admitted, tracks, given, seen, strict=True):
                tick.num_points[i], tick.reasons[i] = observation.num_points, 'short_track'
                track.entries.append(_Entry(observation._replace(box=box), tick, i))
                tick.waiting += 1
                if other := track.parted():
                    self._end([track.track_id])
                    self._tracks[track.track_id] = other
        return tick

    def _end(self, names: list[str]) -> None:
        """Close tracks; they are solved once more, with the next ones."""
        self._ended += [self._tracks.pop(name) for name in names]

    def _solve(self, tracks: list['_TrackBuffer']) -> None:
        """Register windows, ended ones too: when it begins elsewhere, go on until it is needed."""
        self._finish()
        tracks = self._ended + tracks
        asked = [track.window() for track in tracks], self.config, self._model
        self._result = self._begin(*asked) if self._begin else lambda: register(*asked)
        self._work = [(track, track.entries, track in self._ended) for track in tracks]
        for track in tracks:
            track.entries = track.entries[-self._keep :]
        self._ended, self._count = [], 0
        if self.config.estimate != 'track' or not (self._begin and self._tracks):
            self._finish()

    def _finish(self) -> None:
        """Write the estimates, when they have come, to the ticks they are of."""
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # tensors are small: threads of torch would wait, not work
        try:
            estimates = self._result()
        finally:
            torch.set_num_threads(threads)
        for (track, entries, is_ended), estimate in zip(self._work, estimates, strict=True):
            if estimate is not None:
                track.write(estimate, entries)
            for entry in entries if is_ended else entries[: -self._wait]:
                entry.tick.waiting -= not entry.is_settled
                entry.is_settled = True
        self._work, self._result = [], list

    def _settled(self) -> Iterator[RefinedBoxes]:
        while self._ticks and self._ticks[0].waiting <= 0:
            tick = self._ticks.popleft()
            self.counts.update([*tick.status, *filter(None, tick.reasons)])
            yield tick.result(is_final=True)


class _Tick:
    """One box array on its way: the best known about each box, and how many still wait."""

    def __init__(self, boxes: BoxArray) -> None:
        n = len(boxes.track_ids)
        self.boxes, self.refined = boxes, boxes.boxes.copy()
        self.status, self.reasons = [KEPT] * n, [''] * n
        self.num_points = np.zeros(n, int)
        self.covariances = np.broadcast_to(np.eye(6), (n, 6, 6)).copy()
        self.waiting, self.is_paired = 0, False

    def refuse(self, reason: str) -> None:
        """Give a reason to each box the core cannot take; `reason` holds for all if not empty."""
        boxes, seen = self.boxes.boxes, set[str]()
        valid = is_valid_box(boxes)
        for i, (name, good) in enumerate(zip(self.boxes.track_ids, valid, strict=True)):
            why = 'no_track_id' if not name else 'duplicate_track_id' if name in seen else reason
            self.reasons[i] = why if good else 'invalid_box'
            seen.update([name] if good else [])

    def result(self, is_final: bool) -> RefinedBoxes:
        boxes = replace(self.boxes, boxes=self.refined.copy())
        outcome = tuple(self.status), tuple(self.reasons), self.num_points.copy()
        return RefinedBoxes(boxes, *outcome, self.covariances.copy(), is_final)


@dataclass(slots=True)
class _Entry:
    """An observation and the place its estimate belongs to."""

    observation: Observation
    tick: _Tick
    index: int
    estimate: Floats | None = None
    is_settled: bool = False


@dataclass(eq=False, slots=True)
class _TrackBuffer:
    """The observations of one track that windows still need."""

    track_id: str
    class_name: str
    entries: list[_Entry] = field(default_factory=list)
    memory: Memory | None = None

    def window(self) -> Window:
        observations = [entry.observation for entry in self.entries]
        solved = [entry.estimate for entry in self.entries if entry.estimate is not None]
        fresh, start = len(observations) - len(solved), np.array(solved).reshape(-1, 9)
        return Window(self.track_id, self.class_name, observations, fresh, start, self.memory)

    def parted(self) -> '_TrackBuffer | None':
        """
        Return the last two entries as a track of their own, if another object has got their id.

        Then neither is where constant velocity leads; a single one may be an outlier.

        """
        if len(self.entries) < 5:
            return None
        first, *_, latest, last, new = (entry.observation for entry in self.entries[-6:])
        velocity = (latest.box - first.box) / (latest.stamp_ns - first.stamp_ns)
        for seen in (last, new):
            late = seen.stamp_ns - latest.stamp_ns
            away = dist(seen.box[:2], (latest.box + late * velocity)[:2])
            if away < latest.box[LENGTH] / 2 + 10.0 * late * 1e-9:  # nothing swerves by 10 m/s
                return None
        moved = [replace(entry, estimate=None) for entry in self.entries[-2:]]
        del self.entries[-2:]
        return _TrackBuffer(self.track_id, self.class_name, moved)

    def velocity(self, box: Floats, stamp_ns: int) -> Floats:
        """Return that of the input centre over the last stamps to `box`, the newest [m/s]."""
        if not self.entries:
            return np.zeros(3)
        first = self.entries[-4:][0].observation
        return (box - first.box)[X : Z + 1] / (stamp_ns - first.stamp_ns) * 1e9

    def write(self, estimate: Estimate, entries: list[_Entry]) -> None:
        self.memory = estimate.memory
        for entry, box, status, reason, spread in zip(entries, *estimate[:4], strict=True):
            entry.estimate, tick, i = box, entry.tick, entry.index
            if not entry.is_settled:
                tick.refined[i], tick.status[i], tick.reasons[i] = box, status, reason
                tick.covariances[i] = spread
