"""What the node tells about itself on /diagnostics, and how often it says it in the log."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from threading import Lock
import time

from boxreg_ros.reasons import FAULTS, REASONS
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

LOG_PERIOD = 10.0
"""The same trouble is logged this often at most [s]."""
WITHOUT_CLOUDS = ('no_transform', 'no_sweep')
"""What becomes of boxes if no clouds come."""
RATES = ('points_received', 'boxes_received', 'early_published', 'final_published')


class Health:
    """
    Counters, latencies and who has been warned of what. Thread-safe.

    Counters only grow; rates and levels are those of the time since the last `status`.

    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._counts: Counter[str] = Counter()
        self._elsewhere: Counter[str] = Counter()
        self._reported: Counter[str] = Counter()
        self._logged: Counter[str] = Counter()
        self._latencies: list[float] = []
        self._warned: dict[str, float] = {}
        self._since = time.monotonic()

    def count(self, name: str, number: int = 1) -> None:
        """Add to a counter."""
        with self._lock:
            self._counts[name] += number

    def set_counts(self, counts: Mapping[str, int]) -> None:
        """Take over counters that are kept elsewhere, to be added to those counted here."""
        with self._lock:
            self._elsewhere = Counter(counts)

    def add_latency(self, seconds: float) -> None:
        """Note how long after its boxes had come an early estimate was published."""
        with self._lock:
            self._latencies.append(seconds)

    def is_time_to_warn(self, reason: str) -> bool:
        """Tell whether the log has not heard of this reason for a while; it is told now."""
        now = time.monotonic()
        with self._lock:
            is_time = now - self._warned.get(reason, -LOG_PERIOD) >= LOG_PERIOD
            if is_time:
                self._warned[reason] = now
                self._logged[reason] = self._counts[reason] + self._elsewhere[reason]
        return is_time

    def complaints(self) -> Iterator[str]:
        """Yield a line with the remedy for every reason that has one and is due in the log."""
        with self._lock:
            counts = self._counts + self._elsewhere
        for name, reason in REASONS.items():
            number = counts[name] - self._logged[name]
            if number and reason.remedy and self.is_time_to_warn(name):
                yield f'{name} ({number} more): {reason.meaning}; {reason.remedy}'

    def status(self, name: str, facts: Mapping[str, object]) -> DiagnosticStatus:
        """Return the state since the last call; `facts` are added to the values."""
        now = time.monotonic()
        with self._lock:
            counts = self._counts + self._elsewhere
            fresh = counts - self._reported
            self._reported = counts
            latencies, self._latencies = sorted(self._latencies), []
            period, self._since = max(now - self._since, 1e-3), now
        values = {f'{what} [Hz]': f'{fresh[what] / period:.1f}' for what in RATES}
        for what, share in (('median', 0.5), ('p99', 0.99), ('most', 1.0)):
            if latencies:
                row = min(int(share * len(latencies)), len(latencies) - 1)
                values[f'latency {what} [ms]'] = f'{1e3 * latencies[row]:.1f}'
        values |= {key: str(value) for key, value in facts.items()}
        values |= {key: str(number) for key, number in sorted(counts.items())}
        level, message = _verdict(fresh)
        return DiagnosticStatus(
            level=level, name=name, message=message,
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )  # fmt: skip


def _verdict(fresh: Counter[str]) -> tuple[bytes, str]:
    """Return level and message for what happened since the last time."""
    trouble = next((name for name, why in REASONS.items() if fresh[name] and why.remedy), None)
    if trouble is not None:
        reason = REASONS[trouble]
        is_idle = bool(fresh['boxes_received']) and not fresh['refined']
        level = DiagnosticStatus.ERROR if is_idle or trouble in FAULTS else DiagnosticStatus.WARN
        text = f'{trouble}: {reason.meaning}; {reason.remedy}'
        if trouble in WITHOUT_CLOUDS and not fresh['points_received']:
            text = 'nothing received on points'
        return level, f'no box was refined; {text}' if is_idle else text
    missing = [name for name in ('points', 'boxes') if not fresh[f'{name}_received']]
    if missing:
        return DiagnosticStatus.WARN, f'nothing received on {" and ".join(missing)}'
    if fresh['kept'] and not fresh['refined']:
        why = max((n for n in REASONS if REASONS[n].unit == 'box'), key=lambda name: fresh[name])
        text = f'no box was refined; most often {why}: {REASONS[why].meaning}'
        return DiagnosticStatus.WARN, text
    return DiagnosticStatus.OK, 'refining'
