"""Counters, levels and log entries of the node."""

from boxreg_ros.live.diagnostics import Health, LATENCY, TICK
from boxreg_ros.structures import BoxArray, RefinedBoxes
from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
import pytest


class Log:
    """Records log entries as (severity, text)."""

    def __init__(self):
        self.entries = []

    def __getattr__(self, severity):
        return lambda text: self.entries.append((severity, text))

    def take(self):
        """Return severity and first word of the entries since the last call."""
        entries = [(severity, text.split()[0]) for severity, text in self.entries]
        self.entries.clear()
        return entries


def test_level_is_ok_while_boxes_are_refined_and_warn_in_silence():
    health = Health(Log())
    health.count('points_received')
    health.count('boxes_received')
    health.add_times({LATENCY: 0.05})
    status = health.status('node', {'fixed_frame': 'odom'})
    assert status.level == DiagnosticStatus.OK
    values = {item.key: item.value for item in status.values}
    assert values['latency median [ms]'] == '50.0'
    assert values['fixed_frame'] == 'odom'
    assert health.status('node', {}).level == DiagnosticStatus.WARN  # nothing more was received


def test_level_and_message_are_those_of_the_most_severe_reason():
    health = Health(Log())
    health.count('no_sweep', 3)
    health.count('boxes_received')
    status = health.status('node', {})
    assert status.level == DiagnosticStatus.ERROR
    assert status.message == 'no box was refined; nothing received on points'
    health.count('points_received')
    health.set_core_counts({'no_sweep': 3, 'refined': 5})
    status = health.status('node', {})
    assert status.level == DiagnosticStatus.WARN
    assert status.message.startswith('no_sweep') and 'stamp' in status.message
    health.count('failed')
    assert health.status('node', {}).level == DiagnosticStatus.ERROR
    warn, error = DiagnosticStatus.WARN, DiagnosticStatus.ERROR
    for name, level in (('refined', warn), ('coasted', warn), ('kept', error)):
        health.count('boxes_received')
        health.count('late')
        health.count(name)
        assert health.status('node', {}).level == level


def test_message_names_the_most_frequent_reason_if_no_box_was_refined():
    health = Health(Log())
    for name in ('points_received', 'boxes_received', 'no_points', 'no_gain', 'no_gain'):
        health.count(name)
    health.count('kept', 3)
    status = health.status('node', {})
    assert status.level == DiagnosticStatus.WARN
    assert 'no box was refined' in status.message and 'no_gain' in status.message


def test_the_share_of_final_boxes_without_time_is_a_warning():
    log = Log()
    health = Health(log)
    for name in ('points_received', 'boxes_received'):
        health.count(name)
    health.set_core_counts({'budget': 3, 'kept': 4, 'refined': 1})
    status = health.status('node', {})
    assert status.level == DiagnosticStatus.WARN
    assert 'budget: no time to refine 60% of the final boxes' in status.message
    assert [text for _, text in log.entries] == [status.message]
    for name in ('points_received', 'boxes_received'):
        health.count(name)
    health.set_core_counts({'budget': 4, 'kept': 5, 'refined': 200})  # one of 200: a hiccup
    assert health.status('node', {}).level == DiagnosticStatus.OK


def early(refined, late, kept):
    """Return early boxes: numbers refined, without time, and kept for another reason."""
    number = refined + late + kept
    boxes = BoxArray(0, '', ('1',) * number, ('',) * number, np.ones(number), np.ones((number, 9)))
    return RefinedBoxes(
        boxes, ('refined',) * refined + ('kept',) * (late + kept),
        ('',) * refined + ('budget',) * late + ('no_points',) * kept,
        np.zeros(number, int), np.zeros((number, 6, 6)),
    )  # fmt: skip


@pytest.mark.parametrize(
    ('late', 'took', 'expected'),
    [
        (4, 0.07, ''),
        (5, 0.07, 'budget: no time to refine 5% of the early boxes'),
        (0, 0.3, 'budget: early boxes are published 300 ms after the last of their data, later'),
    ],
)
def test_early_boxes_without_time_and_late_ones_are_a_warning(late, took, expected):
    log = Log()
    health = Health(log)
    for name in ('points_received', 'boxes_received'):
        health.count(name)
    health.set_core_counts({'refined': 100})
    health.add_early(early(90 - late, late, 10))
    for one in (took, took, 5.0):  # a single interruption
        health.add_times({LATENCY: 0.2, TICK: one})
    status = health.status('node', {}, deadline=0.08)
    assert status.level == (DiagnosticStatus.WARN if expected else DiagnosticStatus.OK)
    assert status.message.startswith(expected or 'refining')
    assert [text for _, text in log.entries] == ([status.message] if expected else [])
    values = {item.key: item.value for item in status.values}
    names = 'early_refined', 'early_budget', 'early_kept'
    assert [values.get(name, '0') for name in names] == [str(90 - late), str(late), '10']
    for name in ('points_received', 'boxes_received'):
        health.count(name)
    assert health.status('node', {}, deadline=0.08).level == DiagnosticStatus.OK


def test_quaternions_of_zeros_are_named():
    log = Log()
    health = Health(log)
    health.count('invalid_box', 2)
    health.log_counts()
    ((_, text),) = log.entries
    assert 'quaternion' in text and 'zeros' in text and 'w=1' in text


def test_each_reason_is_logged_once_per_period():
    log = Log()
    health = Health(log)
    health.count('failed')
    health.count('late', 2)
    health.set_core_counts({'no_sweep': 3, 'refined': 5})
    health.log_counts()
    assert log.take() == [('error', 'failed'), ('warning', 'no_sweep'), ('warning', 'late')]
    health.count('late')
    health.log_counts()
    assert log.take() == []
    health.report('unreadable', 'points: no field x')
    health.report('unreadable', 'points: no field x')
    assert log.take() == [('warning', 'unreadable:')]
    health._logged_at.clear()  # ends the period
    health.log_counts()
    assert log.take() == [('warning', 'unreadable'), ('warning', 'late')]


def test_internal_errors_are_logged_with_their_traceback_in_the_debug_log():
    log = Log()
    health = Health(log)
    try:
        {}['missing']
    except KeyError as error:
        health.report_failure(error)
    (error_entry, debug_entry) = log.entries
    assert error_entry == ('error', "failed: KeyError: 'missing'")
    assert debug_entry[0] == 'debug' and 'test_diagnostics.py' in debug_entry[1]


def test_node_logs_its_missing_inputs_until_its_first_refined_box(monkeypatch):
    now = [0.0]
    monkeypatch.setattr('boxreg_ros.live.diagnostics.time.monotonic', lambda: now[0])
    log = Log()
    health = Health(log)

    def text_after(seconds, frame='odom'):
        now[0] += seconds
        health.log_waiting(frame)
        found = ' '.join(text for _, text in log.entries)
        log.entries.clear()
        return found

    assert text_after(5) == ''
    assert text_after(5) == 'waiting for messages on points and boxes; no box refined yet'
    assert text_after(5) == ''
    health.count('points_received')
    assert 'messages on boxes' in text_after(5)
    health.count('boxes_received')
    assert 'transforms' in text_after(10, frame='')
    health.count('unreadable', 2)
    assert 'most often unreadable' in text_after(10)
    health.set_core_counts({'short_track': 3})
    assert 'short_track' in text_after(10)
    health.set_core_counts({'refined': 1})
    assert text_after(10) == ''
