"""What the node tells about itself on /diagnostics, and how often it says it in the log."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from threading import Lock
import time

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

TOO_SLOW = 'the solver is slower than the data: lower window, or fewer boxes'
LOG_PERIOD = 10.0
"""The same trouble is logged this often at most [s]."""

REMEDIES = {
    'failed': 'a fault of boxreg_ros: please report it with the log',
    'points_queue_full': TOO_SLOW,
    'boxes_queue_full': TOO_SLOW,
    'unreadable': 'the log has the reason',
    'no_transform': 'the log has the frames',
    'pose_reference': 'boxes do not stand where their points are: the log has the setting',
    'late': 'boxes came after younger ones: publish them in the order of their stamps',
    'no_track_id': 'boxes need an id that stays with the object: put a tracker before this node, '
    'or set associate',
    'duplicate_track_id': 'an id may occur once per message',
    'no_sweep': 'no cloud within tolerance of the stamp of the boxes: copy the stamp of the cloud',
}
"""
Reasons someone can do something about, the weightiest first, and what.

The others, such as boxes without points, are in the nature of the data.

"""


class Health:
    """
    Counters, latencies and who has been warned of what. Thread-safe.

    Counters only grow; rates and levels are those of the time since the last `status`.

    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._counts: Counter[str] = Counter()
        self._reported: Counter[str] = Counter()
        self._latencies: list[float] = []
        self._warned: dict[str, float] = {}
        self._since = time.monotonic()

    def count(self, name: str, number: int = 1) -> None:
        """Add to a counter."""
        with self._lock:
            self._counts[name] += number

    def set_counts(self, counts: Mapping[str, int]) -> None:
        """Take over counters that are kept elsewhere."""
        with self._lock:
            for name, number in counts.items():
                self._counts[name] = number

    def add_latency(self, seconds: float) -> None:
        """Note how long after the later of cloud and boxes an early estimate was published."""
        with self._lock:
            self._latencies.append(seconds)

    def is_time_to_warn(self, reason: str) -> bool:
        """Tell whether the log has not heard of this reason for a while; it is told now."""
        now = time.monotonic()
        with self._lock:
            is_time = now - self._warned.get(reason, -LOG_PERIOD) >= LOG_PERIOD
            if is_time:
                self._warned[reason] = now
        return is_time

    def status(self, name: str, facts: Mapping[str, object]) -> DiagnosticStatus:
        """Return the state since the last call; `facts` are added to the values."""
        now = time.monotonic()
        with self._lock:
            counts, fresh = self._counts.copy(), self._counts - self._reported
            self._reported = counts.copy()
            latencies, self._latencies = sorted(self._latencies), []
            period, self._since = max(now - self._since, 1e-3), now
        values = {
            f'{what} [Hz]': f'{fresh[what] / period:.1f}'
            for what in ('points_received', 'boxes_received', 'early_published', 'final_published')
        }
        if latencies:
            values['latency median [ms]'] = f'{1e3 * latencies[len(latencies) // 2]:.1f}'
            values['latency most [ms]'] = f'{1e3 * latencies[-1]:.1f}'
        values |= {key: str(value) for key, value in facts.items()}
        values |= {key: str(number) for key, number in sorted(counts.items())}
        level, message = _verdict(fresh)
        return DiagnosticStatus(
            level=level, name=name, message=message,
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )  # fmt: skip


def _verdict(fresh: Counter[str]) -> tuple[bytes, str]:
    """Return level and message for what happened since the last time."""
    fault = next((reason for reason in REMEDIES if fresh[reason]), None)
    if fault is not None:
        level = DiagnosticStatus.ERROR if fault == 'failed' else DiagnosticStatus.WARN
        return level, f'{fault}: {REMEDIES[fault]}'
    missing = [name for name in ('points', 'boxes') if not fresh[f'{name}_received']]
    if missing:
        return DiagnosticStatus.WARN, f'nothing received on {" and ".join(missing)}'
    return DiagnosticStatus.OK, 'refining'
