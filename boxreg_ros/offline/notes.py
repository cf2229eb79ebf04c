"""The sentences of a run: its closing line, and notes about its input and results."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
import shlex
from typing import Any

from boxreg_ros.io.lidars import CLOUD_LATE, CLOUD_MERGED, CLOUD_MISSING
from boxreg_ros.io.storage.record import Damage
from boxreg_ros.io.storage.urls import url_of
from boxreg_ros.io.times import time_range
from boxreg_ros.offline.result_folder import SUMMARY
from boxreg_ros.offline.summary import Summary
from boxreg_ros.reasons import Reason, REASONS
from boxreg_ros.structures import COASTED, EXTENDED, HUMAN, INTERPOLATED, KEPT, REFINED, REJECTED

MAX_NAMED = 5
"""Most tracks that a warning names; chosen."""
FEW_BOXES = 3
"""Boxes at fewer stamps than one in so many sweeps are keyframes; chosen: a detector that drops
every second cloud is none."""
FEW_REFINED = 0.5
"""Refined part of the boxes below which a run prints its most frequent reason. Chosen."""
MAX_UNPAIRED = 0.05
"""Part of the clouds or boxes up to which those without use by their stamps are only counted;
chosen, as the part of the early boxes by which the node warns."""


def closing_line(summary: Summary, out: Path) -> str:
    """Return the result of a run in one line."""
    status = summary.status
    parts = [
        f'{summary.boxes_in:,} boxes in',
        f'{status.get(REFINED, 0):,} refined',
        f'{status.get(KEPT, 0):,} kept',
    ]
    if REJECTED in status:
        parts[-1] += f' and {status[REJECTED]:,} rejected'
    if summary.reasons:
        counts = ', '.join(f'{name} {count:,}' for name, count in summary.reasons.items())
        parts[-1] += f' ({counts})'
    if summary.heading_flips:
        parts.append(f'{summary.heading_flips:,} heading flips corrected')
    for word in (HUMAN, INTERPOLATED, EXTENDED, COASTED):
        if word in status:
            parts.append(f'{status[word]:,} {word}')
    line = (
        f'{url_of(out) or out}: {", ".join(parts)} from {summary.sweeps:,} sweeps in '
        f'{summary.seconds["total"]:.1f} s, fixed frame {summary.fixed_frame}'
    )
    before, after = summary.sweeps_with_boxes.values()
    if after != before:
        line += f'; boxes at {before:,} stamps before, {after:,} after'
    if summary.recorded_apart:
        apart = [f'{topic} ({late:+,.1f} s)' for topic, late in summary.recorded_apart.items()]
        line += f'; merged by stamp: {", ".join(apart)}'
    if Reason.UNREADABLE in summary.dropped:
        line += f'; {summary.dropped["unreadable"]:,} messages could not be read'
    return line


def next_line(out: Path, has_report: bool) -> str:
    """Return the command to look at a result."""
    url = url_of(out)
    if url is not None:
        return f'next: copy {url} to this machine, and open the copy by boxreg review'
    command = f'next: boxreg review {shlex.quote(str(out))}'
    return command if has_report else f'{command} (after the same run with --report)'


def unused_line(unused: Sequence[str]) -> str:
    """Return the error of decisions that could not be used, each named."""
    return (
        f'decisions: expected those on tracks and boxes of this recording, got {len(unused):,} '
        f'that could not be used: {", ".join(unused)}; the results are kept, without these: take '
        f'them back in the review, or decide again on the new result'
    )


def doubts_line(doubts: Sequence[str]) -> str:
    """Return why decisions may not be what a person wants, in one line; empty for no reason."""
    if not doubts:
        return ''
    more = len(doubts) - MAX_NAMED
    return f'decisions: {"; ".join(doubts[:MAX_NAMED])}' + (f'; and {more:,} more' * (more > 0))


def notes(summary: Summary) -> Iterator[str]:
    """Yield warnings about the input and the results, one line each."""
    yield from _input_notes(summary)
    yield from _lidar_notes(summary)
    yield from _label_notes(summary)
    yield from _keyframe_notes(summary)
    if summary.complete.get('unfilled'):
        reason, count = Reason.RARELY_DETECTED, summary.complete['unfilled']
        yield f'{count:,} boxes were {reason.meaning} ({reason}); {reason.remedy}'
    if summary.unused_decisions and summary.is_part:
        yield (
            f'decisions: {len(summary.unused_decisions):,} are about tracks and boxes that this '
            f'part of the recording does not have: {", ".join(summary.unused_decisions)}; without '
            f'--start and --end they are used'
        )
    if summary.input_model.get('warning'):
        yield (
            f'input model: expected drives of one detector and labelling rule, got '
            f'{summary.input_model["warning"]}; give --input-model files of the same one only'
        )
    if summary.unknown_classes:
        names = ', '.join(repr(name) for name in summary.unknown_classes)
        boxes = sum(summary.unknown_classes.values())
        yield (
            f'unknown class names are treated as vehicles: {names} ({boxes:,} boxes); name '
            f'them in vehicle.names, cyclist.names or pedestrian.names'
            + '; give those without a name one'
            * ('' in summary.unknown_classes)
        )
    if summary.part_refined < FEW_REFINED:
        yield _why_few_were_refined(summary)
    else:
        yield from _stamp_notes(summary)


def _lidar_notes(summary: Summary) -> Iterator[str]:
    """Yield the clouds that were not used as those of their LiDARs, one line each."""
    for topic, counts in summary.lidars.items():
        if counts.get(CLOUD_LATE) or counts.get(CLOUD_MISSING):
            yield (
                f'LiDAR {topic}: {counts.get(CLOUD_MERGED, 0):,} clouds merged, '
                f'{counts.get(CLOUD_LATE, 0):,} late, {counts.get(CLOUD_MISSING, 0):,} missing; '
                f'the others were used'
            )
    if summary.first_unplaced:
        clouds = sum(
            summary.dropped.get(name, 0)
            for name in (Reason.SENSOR_WITHOUT_TRANSFORM, Reason.CLOUD_WITHOUT_INFO)
        )
        yield (
            f'the LiDARs of {clouds:,} clouds are not all known, the origin of their frame is '
            f'used; first: {summary.first_unplaced}'
        )


def _label_notes(summary: Summary) -> Iterator[str]:
    """Yield the boxes and clouds that label files lack, one line each."""
    for name, count in (summary.labels or {}).get('left_out', {}).items():
        yield left_out_line(name, count)
    for name, found in summary.left_out_of_labels.items():
        reasons = ', '.join(f'{count:,} ({reason})' for reason, count in found.items())
        yield f'format {name} cannot represent some boxes, they are left out: {reasons}'
    yield from summary.label_notes
    if summary.frames_without_cloud:
        yield (
            f'{summary.frames_without_cloud:,} of {summary.box_arrays:,} box arrays have no '
            f'cloud to write beside them'
        )


def left_out_line(name: str, count: int) -> str:
    """Return the number of boxes of label files that are not used for a reason, and its words."""
    reason = REASONS[name]
    remedy = f'; remedy: {reason.remedy}' if reason.remedy else ''
    return f'labels: {count:,} boxes are left out ({name}): {reason.meaning}{remedy}'


def _keyframe_notes(summary: Summary) -> Iterator[str]:
    """Yield keyframes that could not be used; and that boxes come at few of the sweeps."""
    problems = [problem for seed in summary.seeds for problem in seed['problems']]
    yield from problems[:MAX_NAMED]
    if len(problems) > MAX_NAMED:
        yield f'{len(problems) - MAX_NAMED:,} more keyframes; {SUMMARY} lists all under "seeds"'
    first_ns, last_ns = summary.time_ranges.get('clouds', (0, 0))
    if last_ns > first_ns and not summary.complete:
        rates = [n / (last_ns - first_ns) * 1e9 for n in (summary.box_arrays, summary.sweeps)]
        yield from sparse_boxes(*rates)


def sparse_boxes(boxes: float, clouds: float) -> Iterator[str]:
    """Yield what to do where the rate of boxes is far below that of clouds [Hz]."""
    if 0 < FEW_BOXES * boxes <= clouds:
        yield (
            f'boxes at {boxes:.2g} Hz, clouds at {clouds:.2g} Hz: for a box at every cloud use '
            f'--keyframes, where a person has made them, or --complete'
        )


def _input_notes(summary: Summary) -> Iterator[str]:
    """Yield the parts of the recording that cannot be used, one line each."""
    if summary.damage:
        yield _damage_line(summary.damage)
    if summary.without_stamp:
        counts = ' and '.join(f'{n:,} {kind}' for kind, n in summary.without_stamp.items())
        yield (
            f'{counts} have the stamp 0 in their header and cannot be used: receive times do not '
            f'replace stamps; let the publishers set them'
        ).replace('box_arrays', 'box arrays')
    if summary.warning:
        yield summary.warning
    if summary.time_jumps:
        reason = Reason.TIME_JUMP
        yield (
            f'{reason} ({summary.time_jumps:,}): {reason.meaning}; remedy: {reason.remedy}; files '
            f'of recorders whose clocks differ are mixed up: relabel these one by one'
        )
    if summary.first_unreadable:
        yield (
            f'{summary.dropped["unreadable"]:,} messages or sweeps could not be read; the rest '
            f'was used; first: {summary.first_unreadable}'
        )
    if summary.first_missing_transform:
        boxes = summary.reasons.get(Reason.NO_TRANSFORM, 0)
        sweeps = summary.dropped.get(Reason.SWEEP_WITHOUT_TRANSFORM, 0)
        what = f'{boxes:,} boxes and {sweeps:,} clouds'
        if not boxes + sweeps:  # boxes of a person are written as they are, without a reason
            what = 'boxes of a person'
        yield f'{what} have no transform; first: {summary.first_missing_transform}'


def _damage_line(damages: list[dict[str, Any]]) -> str:
    """Return all damages of a recording in one line."""
    count = len(damages)
    parts = f'{count:,} parts' if count > 1 else 'a part'
    return (
        f'{parts} of the recording cannot be read; the rest was used; first: '
        f'{Damage(**damages[0])}; {SUMMARY} lists {"all" if count > 1 else "it"} under "damage"'
    )


def _stamp_notes(summary: Summary) -> Iterator[str]:
    """Yield the first cause for which many clouds or boxes are of no use by their stamps."""
    for what, name, counts, total in (
        ('clouds', Reason.SWEEP_LATE, summary.dropped, summary.sweeps),
        ('boxes', Reason.DUPLICATE_STAMP, summary.reasons, summary.boxes_in),
        ('boxes', Reason.NO_SWEEP, summary.reasons, summary.boxes_in),
    ):
        count = counts.get(name, 0)
        if count > MAX_UNPAIRED * total:
            reason = REASONS[name]
            yield (
                f'{count:,} of {total:,} {what} were not used ({name}): {reason.meaning}; '
                f'remedy: {reason.remedy}'
            )
            return


def _why_few_were_refined(summary: Summary) -> str:
    """Return the most frequent reason why boxes were kept, its remedy, and both time ranges."""
    name, count = next(iter(summary.reasons.items()))  # sorted by count
    reason = REASONS[name]
    refined = summary.num_refined
    part = f'only {refined:,} of {summary.boxes_in:,} boxes were refined'
    if not refined:
        part = f'none of {summary.boxes_in:,} boxes was refined'
    line = f'{part}; most frequent reason: {name} ({count:,} boxes): {reason.meaning}'
    if reason.remedy:
        line += f'; remedy: {reason.remedy}'
    ranges = [f'{name} {time_range(*r)}' for name, r in sorted(summary.time_ranges.items())]
    return f'{line}; time ranges: {", ".join(ranges)}'
