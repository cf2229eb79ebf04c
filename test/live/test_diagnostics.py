"""Counters, levels and log entries of the node."""

from boxreg_ros.live.diagnostics import Health
from diagnostic_msgs.msg import DiagnosticStatus


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
    health.add_latency(0.05)
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
