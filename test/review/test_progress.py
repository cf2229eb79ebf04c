"""The progress of a review over drives, and the agreement of people."""

from dataclasses import replace
import shutil

from boxreg_ros.cli import main
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.review.decisions import Decision, DecisionLog, DECISIONS
from boxreg_ros.review.progress import agreement, progress_of
from boxreg_ros.review.server import review_server
from browser import NEEDS_BROWSER, opened_page, other_page, press, serving
import numpy as np
import pytest
from ros_messages import Drive

pytest.importorskip('plotly')
QUICK = ['--set', 'solver.rounds=2', '--set', 'sampling.points=64']


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp('drives')
    recording = Drive().write(folder / 'drive')
    assert main(['relabel', str(recording), '-o', str(folder / 'a'), '--report', *QUICK]) == 0
    return folder / 'a'


@pytest.fixture
def outs(made, tmp_path):
    """Return two copies of one result."""
    return [shutil.copytree(made, tmp_path / name) for name in 'ab']


def at(second):
    return f'2026-01-02T03:{second // 60:02d}:{second % 60:02d}+00:00'


def decide(out, *decisions):
    DecisionLog(out / DECISIONS).append(decisions)


def pin_of(out, who, when, off):
    """Return a pin of the first box of track 1, `off` metres along from the refined one."""
    table = BoxTable.read(out / 'boxes.csv')
    row = table.track_ids.index('1')
    box = table.boxes[row] + np.eye(9)[0] * off
    stamp = int(table.stamps_ns[row])
    return Decision('1', stamp, 'pin', '', table.frame_id, box, who=who, when=when)


def test_progress_counts_decisions_and_the_time_between_them(outs, capsys):
    first, second = outs
    decide(
        first,
        Decision('1', None, 'unsure', who='anna', when=at(0)),
        Decision('1', None, 'accept', who='anna', when=at(90)),
        Decision('2', None, 'accept', who='anna', when=at(91)),
        Decision('2', None, 'accept', who='ben', when=at(30)),
        Decision('gone', None, 'accept', who='ben', when=at(60)),
        Decision('2', None, 'accept', who='anna', when=at(92)),
    )
    one, other = map(progress_of, outs)
    assert (one.tracks, one.decided, one.accepted, one.unread) == (2, 2, 2, 1)
    assert one.seconds == 92 + 30
    assert one.minutes_a_track == pytest.approx(122 / 60 / 2)
    assert (one.risk_left, one.people) == (0, ('anna', 'ben'))
    assert (other.decided, other.risk_left) == (0, pytest.approx(other.risk))
    decide(second, pin_of(second, 'carl', at(0), 0.4), Decision('2', None, 'none', 'why?'))
    decide(first, pin_of(first, 'anna', at(600), 0.2))
    # Two copies of one result, reviewed by two people: their boxes are compared, and ours.
    assert main(['review', *map(str, outs), '--progress']) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:4]] == ['drive', str(second), str(first), 'all']
    assert lines[1].split()[1:6] == [
        '2',
        '1',
        '0',
        '0',
        f'{progress_of(second).risk_left / one.risk:.0%}',
    ]
    assert lines[3].split()[1:4] == ['4', '3', '2']
    table = BoxTable.read(first / 'boxes.csv')
    ours = table.boxes[table.track_ids.index('1')]
    boxes = [ours + np.eye(9)[0] * off for off in (0, 0.2, 0.4)]
    both, mine = (iou_3d(np.array(a), np.array(b)).mean() for a, b in (
        (boxes[1:2], boxes[2:]), ([boxes[0]] * 2, boxes[1:]),
    ))  # fmt: skip
    expected = f'3D IoU of two people {both:.3f} (1 boxes), ours with theirs {mine:.3f} (2 boxes)'
    assert lines[4] == expected
    (first / 'review.csv').unlink()
    assert main(['review', str(first), '--progress']) == 1
    assert 'review.csv: cannot be read' in capsys.readouterr().err


def test_boxes_of_people_with_rounded_stamps_are_compared(outs):
    """One reviews a result whose recording has whole microseconds, and decides on that."""
    first, second = outs
    table = BoxTable.read(second / 'boxes.csv')
    decide(first, pin_of(first, 'anna', at(0), 0.2))
    pin = pin_of(second, 'ben', at(0), 0.4)
    decide(second, replace(pin, stamp_ns=pin.stamp_ns + 789))
    both, ours = agreement(outs)
    row = table.track_ids.index('1')
    boxes = table.boxes[row] + np.eye(9)[0] * [[0.2], [0.4]]
    assert both == pytest.approx(iou_3d(boxes[:1], boxes[1:]))
    assert len(ours) == 2


@NEEDS_BROWSER
def test_several_drives_are_reviewed_under_one_address(outs):
    decide(outs[0], Decision('1', None, 'accept', who='anna', when=at(0)))
    with (
        serving(review_server([(out, None) for out in outs], 0, 'anna')) as server,
        opened_page(server.address, ready='#drives') as page,
    ):
        rows = page.locator('#drives tr').all_inner_texts()
        assert [row.split()[0] for row in rows[1:]] == [str(outs[1]), str(outs[0]), 'all']
        found = pytest.importorskip('axe_playwright_python.sync_playwright').Axe().run(page)
        assert found.violations_count == 0, found.generate_report()
        page.click('#drives a')
        page.wait_for_selector('html[data-ready]')
        page.click('#tab-tracks')
        page.wait_for_function('view.part')
        # Another page gets another track by "Accept, next": the queue is shared out.
        taken = page.evaluate('current().id')
        other = other_page(page, server.address, '#drives a')
        other.click('#drives a')
        other.wait_for_selector('html[data-ready]')
        assert other.evaluate("notePage('')") == [taken]
        press(page, 'a', 'log.count === 1')
        page.wait_for_function('location.pathname === "/1/"')
        page.click('#all-drives')
        page.wait_for_selector('#drives')
        texts = page.locator('#drives tr').all_inner_texts()
        assert 'anna' in texts[1] and texts[1].split()[1:3] == ['2', '1']
