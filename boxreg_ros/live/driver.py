"""Messages in, messages with refined boxes out: the node without its topics and threads."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from boxreg_ros import refine, Track
from boxreg_ros.config import Config, PaperConfig, SolverConfig
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.errors import TransformUnavailable
from boxreg_ros.io.session import covariances_to_write, Intake, says_nothing
from boxreg_ros.io.transforms import boxes_to_frame, inverse, sweep_to_frame, TransformTree
from boxreg_ros.structures import BoxArray, Floats, REFINED, RefinedBoxes, Sweep
from msg_adapters import Adapter
from msg_adapters.convention import Convention, STANDARD
from msg_adapters.poses import turned_covariances
import numpy as np

SETTLE = 0.3
"""Transforms are collected this long before a fixed frame is chosen among them [s]."""
SILENCE = 3.0
"""After so long without boxes, final ones are not held back any more [s]."""
CLOUD_SILENCE = 0.5
"""After so long without clouds, boxes that have waited as long do not wait for theirs [s]."""


class Arrival(NamedTuple):
    """A decoded message, and when it was received by a clock that never jumps [s]."""

    message: Any
    content: Sweep | BoxArray
    received: float


class Outgoing(NamedTuple):
    """
    A message to publish.

    `given` and `refined` are in the frame of `message`; both are None where the input message
    is passed through as it came; `received` is when the boxes were, None for those.

    """

    message: Any
    is_final: bool
    given: BoxArray | None = None
    refined: RefinedBoxes | None = None
    received: float | None = None


@dataclass(eq=False, slots=True)
class _Pending:
    """A box array the registrar has: its message waits for the boxes that replace its own."""

    message: Any
    given: BoxArray
    received: float
    T_output_fixed: Floats
    T_output_item: Floats | None
    is_named_anew: bool
    is_early_out: bool = False


class _Passing(NamedTuple):
    """A message that passes through, its final copy behind those that came before it."""

    message: Any


class LiveRegistrar:
    """
    Bring messages into the fixed frame, register them, and make the messages to publish.

    Holds the transforms, the registrar and, until their final boxes come, the input messages.
    Belongs to one thread.

    Parameters
    ----------
    config : Config
        Settings of the core; `estimate` must be ``final``.
    fixed_frame, output_frame : str
        Frames to refine and to publish in. Empty: the topmost frame the clouds' frame moves in,
        chosen once; and the frame of each input message.
    transform_timeout : float
        How long an arrival waits for transforms that cover its stamp [s]. After that it takes
        what a short extrapolation gives.
    trouble : callable
        Told the reason, as counted, the text and the number of everything that is not refined
        here.
    convention : Convention
        How the boxes are to be read.

    Attributes
    ----------
    tree : TransformTree
        To be fed with what comes.
    fixed_frame, cloud_frame : str
        The frame chosen, and the frame of the clouds, to be set; empty while not known.
    adapter : Adapter
        Reads and writes the boxes; to be set before the first.
    output_frame, transform_timeout
        As above; may change.

    """

    def __init__(
        self,
        config: Config,
        fixed_frame: str,
        output_frame: str,
        transform_timeout: float,
        trouble: Callable[[str, str, int], None],
        convention: Convention = STANDARD,
    ) -> None:
        self.tree = TransformTree()
        self.fixed_frame = fixed_frame.lstrip('/')
        self.output_frame = output_frame.lstrip('/')
        self.transform_timeout = transform_timeout
        self._trouble = trouble
        self._intake = Intake(convention, config)
        self._registrar = BoxRegistrar(config)
        self._held: deque[_Pending | _Passing] = deque()  # as they came; the first is pending
        self._made: list[Outgoing] = []  # from what has become ready, up to a fault
        self.cloud_frame = ''
        self._choose_at: float | None = None
        self.adapter: Adapter | None = None
        self._last_boxes = 0.0

    @property
    def config(self) -> Config:
        """Return the settings of the core; see `BoxRegistrar` for what may change."""
        return self._registrar.config

    @config.setter
    def config(self, config: Config) -> None:
        self._registrar.config = config
        self._intake.change(config)

    @property
    def counts(self) -> Counter[str]:
        """Sweeps, boxes by status, and reasons of the registrar; see `BoxRegistrar`."""
        return self._registrar.counts

    def is_ready(self, item: Arrival, now: float) -> bool:
        """Tell whether the transforms of an arrival have come, or are no longer waited for."""
        content = item.content
        if now >= item.received + self.transform_timeout or says_nothing(content):
            return True
        if self._choose_at is None:
            self._choose_at = now + SETTLE
        if not self.fixed_frame and now < self._choose_at:
            return False
        try:
            return all(self.tree.covers(*frames, content.stamp_ns) for frames in self._hops(item))
        except TransformUnavailable:
            return False

    def process(self, item: Arrival) -> list[Outgoing]:
        """Register an arrival; return what has become ready."""
        content = item.content
        if says_nothing(content):
            return self.passed_through(item.message)
        ready: list[Outgoing] = []
        if self._intake.begins_anew(content):
            self._trouble('time_jump', f'stamps went back to {content.stamp_ns} ns', 1)
            ready = self.reset()
            self.tree.rewind(content.stamp_ns)
        return ready + self._register(item)

    def _register(self, item: Arrival) -> list[Outgoing]:
        content = item.content
        stamp_ns = content.stamp_ns
        try:
            T_fixed_item, *others = [
                self.tree.lookup(*frames, stamp_ns) for frames in self._hops(item)
            ]
        except TransformUnavailable as error:
            if isinstance(content, Sweep):
                self._trouble('sweep_without_transform', str(error), 1)
                return []
            if content.track_ids:
                self._trouble('no_transform', str(error), len(content.track_ids))
            return self.passed_through(item.message)
        if isinstance(content, Sweep):
            sweep = sweep_to_frame(content, T_fixed_item, self.fixed_frame)
            return self._outgoing(self._registrar.add_sweep(self._intake.take(sweep)))
        self._last_boxes = item.received
        boxes = self._intake.take(boxes_to_frame(content, T_fixed_item, self.fixed_frame))
        if self._intake.finding:
            self._trouble('pose_reference', self._intake.finding, 1)
        T_output_fixed = others[0] if others else inverse(T_fixed_item)
        T_output_item = T_output_fixed @ T_fixed_item if others else np.eye(4)
        given = boxes_to_frame(content, T_output_item, self._output_of(content))
        given = replace(given, track_ids=boxes.track_ids)
        pending = _Pending(
            item.message, given, item.received, T_output_fixed, T_output_item if others else None,
            boxes.track_ids != content.track_ids,
        )  # fmt: skip
        self._held.append(pending)
        return self._outgoing(self._registrar.add_boxes(boxes))

    def lose(self, stamp_ns: int) -> list[Outgoing]:
        """Have the boxes of a cloud that was dropped not wait for it."""
        sweep = Sweep(stamp_ns, self.fixed_frame, np.zeros((0, 3)), is_dropped=True)
        return self._outgoing(self._registrar.add_sweep(sweep))

    def lose_overdue(self, now: float, cloud_received: float) -> list[Outgoing]:
        """Have boxes not wait for clouds that do not come any more."""
        if now < cloud_received + CLOUD_SILENCE:
            return []
        overdue = [
            p.given.stamp_ns
            for p in self._held
            if isinstance(p, _Pending) and not p.is_early_out and now >= p.received + CLOUD_SILENCE
        ]
        if not overdue:
            return []
        # Out of reach of the boxes: a cloud that came before them is still theirs.
        reach = max(self.config.reach, self.config.tolerance)
        return self.lose(max(overdue) + round(reach * 1e9) + 1)

    @property
    def is_holding(self) -> bool:
        """Tell whether boxes are held back, for a cloud or for what comes later."""
        return bool(self._held)

    def is_silent(self, now: float) -> bool:
        """Tell whether boxes are held, but no others have come for long."""
        return self.is_holding and self.has_ceased(now)

    def has_ceased(self, now: float) -> bool:
        """Tell whether no boxes have come for long."""
        return now >= self._last_boxes + max(SILENCE, self.config.max_gap)

    def flush(self) -> list[Outgoing]:
        """Return everything still held; tracks go on, should more boxes come."""
        return self._outgoing(self._registrar.flush())

    def reset(self) -> list[Outgoing]:
        """Start afresh but for the transforms; return everything still held."""
        ready = self.flush()
        self._registrar.reset()
        self._intake.begin(self.config)
        return ready

    def abandon(self, item: Arrival | None) -> list[Outgoing]:
        """Start afresh after a fault; pass what is held, and the arrival at fault, through."""
        self._registrar.reset()
        self._intake.begin(self.config)
        held = list(self._held)
        self._held.clear()
        passed, self._made = self._made, []
        for p in held:
            is_early_out = isinstance(p, _Passing) or p.is_early_out
            passed += ([] if is_early_out else [Outgoing(p.message, False)]) + self.last(p.message)
        is_held = item is None or any(p.message is item.message for p in held)
        if item is not None and isinstance(item.content, BoxArray) and not is_held:
            passed += self.passed_through(item.message)
        return passed

    @property
    def facts(self) -> dict[str, object]:
        """Return what there is to tell about the boxes beside the counts."""
        return self._intake.facts

    def passed_through(self, message: Any) -> list[Outgoing]:
        """Return a message as it came, as early and, if nothing before it is held, as final."""
        return [Outgoing(message, False), *self.last(message)]

    def last(self, message: Any) -> list[Outgoing]:
        """Return a message as it came, as final, or hold it behind what came before it."""
        if not self._held:
            return [Outgoing(message, True)]
        self._held.append(_Passing(message))
        return []

    def _output_of(self, boxes: BoxArray) -> str:
        return self.output_frame or boxes.frame_id

    def _hops(self, item: Arrival) -> list[tuple[str, str]]:
        """
        Return the pairs (target, source) of frames an arrival needs.

        First from its frame to the fixed one, then, for boxes to be published elsewhere than in
        their own frame, from there to the output frame.

        """
        content = item.content
        if not self.fixed_frame:
            self._choose_fixed_frame(content)
        hops = [(self.fixed_frame, content.frame_id)]
        if isinstance(content, BoxArray) and self._output_of(content) != content.frame_id:
            hops.append((self.output_frame, self.fixed_frame))
        return hops

    def _choose_fixed_frame(self, content: Sweep | BoxArray) -> None:
        frame = self.cloud_frame
        if not frame:
            raise TransformUnavailable(
                f'no point cloud has come, so there is no telling how the boxes in '
                f'{content.frame_id!r} move; check the topic of the clouds and its QoS'
            )
        found = self.tree.fixed_frame(frame)
        if found is None:
            raise TransformUnavailable(
                f'neither /tf nor odometry tells how the frame of the clouds {frame!r} moves; '
                f'known: {self.tree}; if it does not move, say so with fixed_frame:={frame}'
            )
        self.fixed_frame = found

    def _outgoing(self, ready: list[RefinedBoxes]) -> list[Outgoing]:
        for refined in ready:
            stamp_ns = refined.boxes.stamp_ns
            pending = next(
                p
                for p in self._held
                if isinstance(p, _Pending)
                and p.given.stamp_ns == stamp_ns
                and (refined.is_final or not p.is_early_out)
            )
            moved = refined_to_frame(refined, pending.T_output_fixed, pending.given.frame_id)
            assert self.adapter is not None  # it has read the message
            message, T = pending.message, pending.T_output_item
            # What is kept is the input: in haste, and then most is, nothing is to be made of it.
            if REFINED in refined.status or T is not None or pending.is_named_anew:
                covariances = covariances_to_write(moved)
                message = self.adapter.to_msg(message, moved.boxes, covariances, T)
            self._made.append(
                Outgoing(message, refined.is_final, pending.given, moved, pending.received)
            )
            pending.is_early_out = True
            if refined.is_final:
                self._held.remove(pending)
                while self._held and isinstance(self._held[0], _Passing):
                    self._made.append(Outgoing(self._held.popleft().message, True))
        made, self._made = self._made, []
        return made


def refined_to_frame(refined: RefinedBoxes, T_frame_boxes: Floats, frame_id: str) -> RefinedBoxes:
    """Return refined boxes, and their covariances, in another frame."""
    return replace(
        refined,
        boxes=boxes_to_frame(refined.boxes, T_frame_boxes, frame_id),
        covariances=turned_covariances(refined.covariances, T_frame_boxes),
    )


def warm_up(config: Config) -> None:
    """
    Solve a made-up track: the first real one must not wait for what is loaded lazily.

    A few steps of the solver are enough for that.

    Raises
    ------
    ConfigError
        If the device is none that can be used here.

    """
    rng = np.random.default_rng(0)
    boxes = np.array([[10.0 + 0.5 * k, 0, 0, 4, 2, 1.5, 0, 0, 0] for k in range(4)])
    points = [rng.uniform(-1, 1, (64, 3)) * [2, 1, 0.7] + box[:3] for box in boxes]
    track = Track('1', 'car', np.arange(4) * 10**8, boxes, points, np.zeros((4, 3)))
    quick = Config(
        objective=config.objective, mode=config.mode, device=config.device,
        solver=SolverConfig(rounds=1, iterations=2),
        paper=PaperConfig(multiplier_rounds=1, iterations=2),
    )  # fmt: skip
    refine([track], quick)
