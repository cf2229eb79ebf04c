"""The first pass over a recording: what completes its tracks, and where keyframes end."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, TYPE_CHECKING

from boxreg_ros.io.items import Item
from boxreg_ros.offline.progress import Progress, Stopwatch
from boxreg_ros.offline.reader import ReadAhead, reader
from boxreg_ros.structures import BoxArray

if TYPE_CHECKING:
    from boxreg_ros.core.follow import FollowedTrack
    from boxreg_ros.core.input_statistics import Drives
    from boxreg_ros.core.latency import Latency
    from boxreg_ros.core.method.constants import Constants
    from boxreg_ros.offline.completion import Arrivals, Completion, Moved
    from boxreg_ros.offline.request import Request
    from boxreg_ros.review.corrections import Corrections
    from boxreg_ros.tracks.complete import CompletionPlan


class Passes:
    """Progress over several passes through a recording."""

    def __init__(self, progress: Progress, passes: int) -> None:
        self.progress = progress
        self._passes = passes
        self._done = 0

    def each(self, recording: ReadAhead) -> Iterator[Item]:
        """Yield the items of one pass, and show the time that has been read [s]."""
        source = recording.source
        for item in recording:
            seconds = (item.received_ns - source.start_ns) * 1e-9
            done = self._done * source.seconds + seconds
            self.progress.show(done, self._passes * source.seconds)
            yield item
        self._done += 1


@dataclass(slots=True)
class Survey:
    """What the first pass has found, for the second one."""

    plan: CompletionPlan
    completion: Completion
    parts: list[Arrivals]
    ends: list[dict[str, Any]]
    """Where each track of keyframes ends, and why."""
    constants: Constants | None
    """Of the boxes of a person."""
    in_time: list[BoxArray] | None = None
    """The boxes as they arrived, where their objects are at their stamp; None: not corrected."""
    latency: Latency | None = None
    """By which they were corrected."""

    def completed(self, items: Iterable[Item], fixed_frame: str) -> Iterator[Item]:
        """Yield the items of the second pass: boxes in time, and an array for each sweep."""
        from boxreg_ros.offline.completion import with_boxes_in_time, with_empty_arrays

        if self.in_time is not None:
            items = with_boxes_in_time(items, self.in_time)
        return with_empty_arrays(items, self.parts, fixed_frame)


def survey(
    request: Request,
    clock: Stopwatch,
    progress: Passes,
    corrections: Corrections,
    drives: Drives,
) -> Survey | None:
    """Read the recording a first time and plan its whole tracks; None where none is completed."""
    if not (request.completes or corrections.adds):
        return None
    with ExitStack() as workers:
        receive = workers.enter_context(reader(request))
        from boxreg_ros.core.following.person import numbers
        from boxreg_ros.offline.completion import Completion, first_pass
        from boxreg_ros.offline.keyframes import add_objects, arrivals, ends_of, keyframes
        from boxreg_ros.tracks.complete import unchanged_plan

        recording = ReadAhead(receive)
        clock.begun('start')
        fixed_frame = recording.source.fixed_frame
        items: Iterable[tuple[Moved, bool]] = (
            (_plain(item.moved), item.restarts) for item in progress.each(recording)
        )
        tracks: list[FollowedTrack] = []
        deviations = in_time = latency = None
        if request.keyframes:
            with clock('follow'):
                plan, parts, tracks, deviations = keyframes(
                    _corrected(items, corrections), fixed_frame, request.config, corrections
                )
        elif request.completes:
            from boxreg_ros.offline.estimation_worker import estimation_worker

            submit = workers.enter_context(
                estimation_worker(request.config, clock, progress.progress.announce)
            )
            first = first_pass(
                items, request.config, submit, fixed_frame, drives, corrections.to_register,
                corrections.adds,
            )  # fmt: skip
            plan = first.plan(fixed_frame, request.config, corrections)
            parts = first.parts
            in_time, latency = first.in_time, first.latency
        else:
            parts = arrivals(_corrected(items, corrections), corrections.adds)
            plan = unchanged_plan([a for part in parts for a in part.completed(fixed_frame)])
        if corrections.adds:
            with clock('follow'):
                tracks += add_objects(plan, parts, corrections, fixed_frame, request.config)
        completion = Completion(plan, request.config, deviations)
        constants = None if deviations is None else numbers(deviations)
        return Survey(plan, completion, parts, ends_of(tracks), constants, in_time, latency)


def _plain(item: Moved) -> Moved:
    """Return boxes without attributes, which the plan does not need."""
    return item.plain() if isinstance(item, BoxArray) else item


def _corrected(
    items: Iterable[tuple[Moved, bool]], corrections: Corrections
) -> Iterator[tuple[Moved, bool]]:
    """Yield items with boxes as a person has decided."""
    for item, restarts in items:
        yield corrections.to_register(item) if isinstance(item, BoxArray) else item, restarts
