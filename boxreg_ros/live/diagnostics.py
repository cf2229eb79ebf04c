"""Counters and latencies of the node, their report on /diagnostics and in the log."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping
from math import inf
from statistics import median
from threading import Lock
import time
import traceback

from boxreg_ros.reasons import FAULTS, Reason, REDUCE_LOAD
from boxreg_ros.structures import COASTED, REFINED, RefinedBoxes
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.impl.rcutils_logger import RcutilsLogger

LOG_PERIOD = 10.0
"""The same reason is logged at most once in this time [s]."""
WAITING = 'waiting'
"""Name of the log entry with the inputs that the node waits for."""
REASONS_WITHOUT_CLOUDS = (Reason.NO_TRANSFORM, Reason.NO_SWEEP)
"""Reasons that boxes get when no cloud arrives at all."""
RATES = ('points_received', 'boxes_received', 'early_published', 'final_published')
"""Counters that are also reported as a rate."""
LEAST_SHARE = 0.01
"""Part of the final boxes without time that is worth a warning; chosen: fewer are a hiccup."""
LEAST_EARLY_SHARE = 0.05
"""The same of the early boxes; chosen: one of 20 is an interruption of the process."""
EARLY_REFINED = 'early_refined'
EARLY_BUDGET = 'early_budget'
EARLY_KEPT = 'early_kept'
"""Counters of early boxes, those of the core are of final ones."""
LATENCY, TICK = 'latency', 'tick'
"""Times until early boxes are published, from the arrival of the boxes, and of all they need."""
STATIC_LATENCY, STATIC_CPU = 'static_points latency', 'static_points CPU'
"""Of a cloud without moving objects."""
LATENCY_QUANTILES = (('median', 0.5), ('p99', 0.99), ('most', 1.0))


class Health:
    """
    Counters, latencies and the time of the last log entry per reason. Thread-safe.

    Counters only grow. Rates and levels refer to the time since the last `status`.

    """

    def __init__(self, logger: RcutilsLogger) -> None:
        self._logger = logger
        self._lock = Lock()
        self._counts: Counter[str] = Counter()
        self._core_counts: Counter[str] = Counter()
        self._reported: Counter[str] = Counter()
        self._logged: Counter[str] = Counter()
        self._logged_at = {WAITING: time.monotonic()}
        self._times = defaultdict[str, list[float]](list)  # by what took them [s]
        self._since = time.monotonic()

    def count(self, name: str, number: int = 1) -> None:
        """Add to a counter."""
        with self._lock:
            self._counts[name] += number

    def set_core_counts(self, counts: Mapping[str, int]) -> None:
        """Replace the counters of the core; `status` reports their sum with the others."""
        with self._lock:
            self._core_counts = Counter(counts)

    def add_times(self, times: Mapping[str, float | None]) -> None:
        """Record times by what took them [s]; None where it was nothing."""
        with self._lock:
            for what, seconds in times.items():
                if seconds is not None:
                    self._times[what].append(seconds)

    def add_early(self, refined: RefinedBoxes) -> None:
        """Count early boxes: refined, without time to solve them, and kept for other reasons."""
        number = sum(status in (REFINED, COASTED) for status in refined.status)
        late = sum(reason == Reason.BUDGET for reason in refined.reasons)
        with self._lock:
            self._counts[EARLY_REFINED] += number
            self._counts[EARLY_BUDGET] += late
            self._counts[EARLY_KEPT] += len(refined.status) - number - late

    def report(self, reason: Reason, text: str, number: int = 1) -> None:
        """Count a reason and log the text, at most once per `LOG_PERIOD` and reason."""
        self.count(reason, number)
        if self.is_due(reason):
            self.log(f'{reason}: {" ".join(text.split())}', reason in FAULTS)

    def report_failure(self, error: Exception) -> None:
        """Count an internal error as ``failed``; its traceback goes to the debug log."""
        self.report(Reason.FAILED, f'{type(error).__name__}: {error}')
        self._logger.debug(''.join(traceback.format_exception(error)))

    def is_due(self, reason: str) -> bool:
        """Return whether a reason may be logged now, and if so record that it is."""
        now = time.monotonic()
        with self._lock:
            if now - self._logged_at.get(reason, -LOG_PERIOD) < LOG_PERIOD:
                return False
            self._logged_at[reason] = now
            self._logged[reason] = self._counts[reason] + self._core_counts[reason]
        return True

    def log_counts(self) -> None:
        """Log every reason that has a remedy and was counted since its last log entry."""
        with self._lock:
            counts = self._counts + self._core_counts
            unlogged = counts - self._logged
        for reason in Reason:
            if unlogged[reason] and reason.remedy and self.is_due(reason):
                text = f'{reason} ({unlogged[reason]} more): {reason.meaning}; {reason.remedy}'
                self.log(text, reason in FAULTS)

    def log_waiting(self, fixed_frame: str) -> None:
        """Log what the node waits for, every `LOG_PERIOD` until its first refined box."""
        with self._lock:
            counts = self._counts + self._core_counts
        if not (counts[REFINED] or counts[COASTED]) and self.is_due(WAITING):
            self._logger.info(f'waiting for {_awaited(counts, fixed_frame)}; no box refined yet')

    def status(
        self, name: str, facts: Mapping[str, object], deadline: float = inf
    ) -> DiagnosticStatus:
        """
        Return the state since the last call; `facts` come between latencies and counters.

        Early boxes that take longer than `deadline` [s] are a warning.

        """
        now = time.monotonic()
        with self._lock:
            counts = self._counts + self._core_counts
            recent = counts - self._reported
            self._reported = counts
            times, self._times = self._times, defaultdict(list)
            period = max(now - self._since, 1e-3)
            self._since = now
        values: dict[str, object] = {
            f'{rate} [Hz]': f'{recent[rate] / period:.1f}' for rate in RATES
        }
        for what in (LATENCY, STATIC_LATENCY, STATIC_CPU):
            values |= _latency_values(what, sorted(times[what]))
        values |= facts
        values |= dict(sorted(counts.items()))
        late = _late_text(recent, times[TICK], deadline)
        if late and self.is_due(Reason.BUDGET):
            self._logger.warning(late)
        return diagnosis(name, *_level_and_message(recent, late), values)

    def log(self, text: str, is_error: bool) -> None:
        """Log a text as an error or a warning."""
        if is_error:  # rclpy takes one level of each line of a source
            self._logger.error(text)
        else:
            self._logger.warning(text)


def diagnosis(
    name: str, level: bytes, message: str, values: Mapping[str, object]
) -> DiagnosticStatus:
    """Return a status for /diagnostics."""
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return DiagnosticStatus(name=name, level=level, message=message, values=pairs)


def _awaited(counts: Mapping[str, int], fixed_frame: str) -> str:
    """Return the inputs that the first refined box still needs, the most basic one first."""
    missing = [name for name in ('points', 'boxes') if not counts.get(f'{name}_received')]
    if missing:
        return f'messages on {" and ".join(missing)}'
    if not fixed_frame:
        return 'transforms from the frame of the clouds to a fixed frame'
    reasons = [one for one in Reason if one.unit == 'box' or one is Reason.UNREADABLE]
    why = max(reasons, key=lambda name: counts.get(name, 0))
    if not counts.get(why):
        return 'enough observations of a track'
    return f'boxes that can be refined; so far most often {why}: {why.meaning}'


def _latency_values(what: str, latencies: list[float]) -> dict[str, str]:
    """Return quantiles of sorted times [s]; nothing if there are none."""
    values = {}
    for name, share in LATENCY_QUANTILES:
        if latencies:
            row = min(int(share * len(latencies)), len(latencies) - 1)
            values[f'{what} {name} [ms]'] = f'{1e3 * latencies[row]:.1f}'
    return values


def _level_and_message(recent: Counter[str], late: str) -> tuple[bytes, str]:
    """Return level and message of the counters of one status period, which `late` is part of."""
    worst = next((one for one in Reason if recent[one] and one.remedy), None)
    if worst is not None:
        return _level_and_message_of(worst, recent)
    missing = [name for name in ('points', 'boxes') if not recent[f'{name}_received']]
    if missing:
        return DiagnosticStatus.WARN, f'nothing received on {" and ".join(missing)}'
    if late:
        return DiagnosticStatus.WARN, late
    if recent['kept'] and not (recent[REFINED] or recent[COASTED]):
        box_reasons = [reason for reason in Reason if reason.unit == 'box']
        why = max(box_reasons, key=lambda name: recent[name])
        text = f'no box was refined; most often {why}: {why.meaning}'
        return DiagnosticStatus.WARN, text
    return DiagnosticStatus.OK, 'refining'


def _late_text(recent: Counter[str], ticks: list[float], deadline: float) -> str:
    """Return the warning of boxes without time, and of late ones; '' for few or none."""
    shares = {
        'final': recent[Reason.BUDGET] / max(1, recent['refined'] + recent['kept']),
        'early': recent[EARLY_BUDGET]
        / max(1, recent[EARLY_REFINED] + recent[EARLY_BUDGET] + recent[EARLY_KEPT]),
    }
    least = {'final': LEAST_SHARE, 'early': LEAST_EARLY_SHARE}
    found = [
        f'{shares[kind]:.0%} of the {kind} boxes' for kind in least if shares[kind] >= least[kind]
    ]
    texts = []
    if found:
        texts.append(f'no time to refine {" and ".join(found)}')
    took = median(ticks) if ticks else 0.0
    if took > deadline:
        texts.append(
            f'early boxes are published {1e3 * took:.0f} ms after the last of their data, later '
            f'than the deadline of {1e3 * deadline:.0f} ms'
        )
    return f'{Reason.BUDGET}: {"; ".join(texts)}; {REDUCE_LOAD}' if texts else ''


def _level_and_message_of(worst: Reason, recent: Counter[str]) -> tuple[bytes, str]:
    """Return level and message where `worst` is the gravest reason of the period."""
    is_idle = bool(recent['boxes_received']) and not (recent[REFINED] or recent[COASTED])
    level = DiagnosticStatus.ERROR if is_idle or worst in FAULTS else DiagnosticStatus.WARN
    text = f'{worst}: {worst.meaning}; {worst.remedy}'
    if worst in REASONS_WITHOUT_CLOUDS and not recent['points_received']:
        text = 'nothing received on points'
    if is_idle:
        text = f'no box was refined; {text}'
    return level, text
