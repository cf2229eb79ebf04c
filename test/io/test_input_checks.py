"""Ids that jump from object to object, and boxes whose axes do not follow their motion."""

from boxreg_ros.cli import main
from boxreg_ros.config import Config
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.checks.axis import AxisCheck
from boxreg_ros.io.id_assignment import IdCheck
from boxreg_ros.structures import BoxArray
from msg_adapters.convention import Convention, FORWARD, STANDARD
import numpy as np
import pytest

S = 10**9
SIZE = (4.5, 1.9, 1.6)


def street(frames=30, moving=2, parked=6, rate=10.0, noise=0.05, seed=3):
    """Yield stamp [ns], ids, classes and boxes (n, 9) of parked and of moving cars."""
    rng = np.random.default_rng(seed)
    headings = np.linspace(-2.0, 2.5, moving)
    for k in range(frames):
        t = k / rate
        rows = [[8.0 * i, 6.0, 0.8, *SIZE, 0, 0, 0.1] for i in range(parked)]
        for i, heading in enumerate(headings):
            way = 8.0 * t * np.array([np.cos(heading), np.sin(heading)])
            rows.append([10.0 * i + way[0], -10.0 + way[1], 0.8, *SIZE, 0, 0, heading])
        boxes = np.array(rows)
        boxes[:, :3] += rng.normal(0, noise, (len(boxes), 3))
        yield round(t * S), [str(i) for i in range(len(boxes))], boxes


def array(stamp_ns, ids, boxes, name='car'):
    n = len(boxes)
    return BoxArray(stamp_ns, 'odom', tuple(ids), (name,) * n, np.ones(n), boxes)


def id_finding(arrays):
    check = IdCheck(Config().max_gap)
    for one in arrays:
        check.add(one)
    return check


def test_ids_that_follow_their_objects_are_no_finding():
    for rate, noise in ((10, 0.05), (10, 0.3), (2, 0.1)):
        check = id_finding(array(*one) for one in street(rate=rate, noise=noise))
        assert (check.finding, check.jumps) == ('', 0)


def by_row(frames, every=1):
    """Yield arrays whose ids are rows, sorted by the distance to a sensor that moves along x."""
    for k, (stamp, ids, boxes) in enumerate(frames):
        if k // every % 2 == 0 or every == 1:
            boxes = boxes[np.argsort(np.hypot(boxes[:, 0] - k, boxes[:, 1]))]
        yield array(stamp, ids, boxes)


@pytest.mark.parametrize('every', [1, 8], ids=['always', 'at_times'])
def test_ids_that_are_the_row_in_the_message_are_found(every):
    check = id_finding(by_row(street(), every))
    assert check.jumps >= 5
    assert f'at {check.jumps} of {check.boxes} boxes' in check.finding
    assert check.is_certain


def test_ids_that_move_up_when_an_object_leaves_are_found():
    def arrays():
        for k, (stamp, _, boxes) in enumerate(street(parked=8)):
            there = boxes[min(k // 8, 4) :]
            yield array(stamp, [str(i) for i in range(len(there))], there)

    assert id_finding(arrays()).finding


def test_ids_of_which_some_are_rows_are_found():
    """A tracker has ids for five cars; three parked ones have the row, by their distance."""

    def arrays():
        for k, (stamp, ids, boxes) in enumerate(street()):
            order = np.argsort(np.abs(boxes[:3, 0] - k))
            rows = [*order, *range(3, len(boxes))]
            yield array(stamp, ['0', '1', '2', *ids[3:]], boxes[rows])

    assert id_finding(arrays()).finding


def test_invalid_boxes_are_no_new_ids():
    """Boxes of an object whose quaternions are never normalised, or extents never known."""
    for value in (np.nan, 0.0):
        arrays = []
        for stamp, ids, boxes in street():
            boxes[:5, 3] = value
            arrays.append(array(stamp, ids, boxes))
        check = id_finding(arrays)
        assert (check.finding, check.new, check.jumps) == ('', 0, 0)


def test_an_id_that_two_boxes_have_in_one_message_is_no_finding():
    """The second box begins a track, which has no part in where the id is afterwards."""

    def arrays():
        for k, (stamp, ids, boxes) in enumerate(street()):
            rows = [*range(len(boxes)), 7] if k == 7 else range(len(boxes))
            yield array(stamp, [ids[row] for row in rows[:8]] + ['0'] * (k == 7), boxes[rows])

    assert id_finding(arrays()).jumps <= 1


def test_ids_of_a_second_message_with_the_same_stamp_are_no_finding():
    def arrays():
        for stamp, ids, boxes in street():
            yield array(stamp, ids[::2], boxes[::2])
            yield array(stamp, ids[1::2], boxes[1::2])

    assert id_finding(arrays()).finding == ''


def test_a_switch_of_a_tracker_is_no_finding():
    def arrays():
        for k, (stamp, ids, boxes) in enumerate(street()):
            names = [*ids]
            if k >= 15:
                names[0], names[1] = names[1], names[0]
            yield array(stamp, names, boxes)

    check = id_finding(arrays())
    assert check.jumps == 2
    assert not check.finding


@pytest.mark.parametrize('begun', [1, 15])
def test_a_tracker_that_begins_its_ids_again_is_no_finding(begun):
    check = IdCheck(Config().max_gap)
    for k, (stamp, ids, boxes) in enumerate(street()):
        check.add(array(stamp, ids[::-1] if k >= begun else ids, boxes))
        assert (check.finding, check.is_certain) == ('', False)
    assert check.jumps == 8


def test_ids_that_are_new_or_missing_are_found_and_others_are_not():
    def arrays(names):
        for k, (stamp, ids, boxes) in enumerate(street()):
            yield array(stamp, [names(k, name) for name in ids], boxes)

    counted = id_finding(arrays(lambda k, name: f'{k} {name}'))
    assert counted.finding.startswith('track ids are new at 232 of 232 boxes')
    assert id_finding(arrays(lambda k, name: '')).finding == '240 of 240 boxes have no track id'
    # A tracker that begins again twice, and gives no ids to two of eight objects.
    again = id_finding(arrays(lambda k, name: f'{k // 10} {name}' if name < '6' else ''))
    assert (again.finding, again.new, again.nameless) == ('', 12, 60)
    # Of boxes further apart than `max_gap` nothing is known.
    counted = list(arrays(lambda k, name: f'{k} {name}'))
    rare = counted[::29]
    assert id_finding(rare).finding == ''


def test_ids_that_each_class_has_are_found():
    def arrays():
        for stamp, ids, boxes in street():
            yield array(stamp, [name if name < '6' else str(int(name) - 6) for name in ids], boxes)

    assert id_finding(arrays()).finding.startswith('60 of 240 boxes have the track id of another')


def axes_of(frames, convention, checked=STANDARD, name='car'):
    """Return the check of boxes that a publisher states in a convention."""
    check = AxisCheck(checked, Config().drives)
    for stamp, ids, boxes in frames:
        given = convention.from_centers(array(stamp, ids, boxes, name))
        check.add(checked.to_centers(given))
    return check


@pytest.mark.parametrize('size_order', ['lwh', 'wlh'])
@pytest.mark.parametrize('forward_axis', FORWARD)
def test_axes_of_moving_vehicles_show_the_convention(forward_axis, size_order):
    convention = Convention(forward_axis=forward_axis, size_order=size_order)
    check = axes_of(street(moving=4), convention)
    assert check.wanted == convention
    assert bool(check.finding) == (convention != STANDARD)
    for name, default in (('forward_axis', 'x+'), ('size_order', 'lwh')):
        value = getattr(convention, name)
        is_named = f'--{name.replace("_", "-")} {value}' in check.finding
        assert is_named == (value != default)
    assert axes_of(street(moving=4), convention, convention).finding == ''


def test_a_wrong_option_is_found_too():
    check = axes_of(street(moving=4), STANDARD, Convention(forward_axis='y+', size_order='wlh'))
    assert check.wanted == STANDARD


def test_one_moving_track_is_enough_sideways_but_not_backward():
    assert axes_of(street(moving=1), Convention(forward_axis='y-', size_order='wlh')).finding
    assert not axes_of(street(moving=1), Convention(forward_axis='x-')).finding


@pytest.mark.parametrize(
    'frames, name',
    [({'moving': 0}, 'car'), ({'moving': 4}, 'pedestrian'), ({'moving': 0, 'noise': 0.5}, 'car')],
)
def test_what_does_not_move_along_its_length_is_no_evidence(frames, name):
    convention = Convention(forward_axis='y+', size_order='wlh')
    assert axes_of(street(**frames), convention, name=name).finding == ''


@pytest.mark.parametrize('is_of_track', [True, False])
def test_unresolved_headings_are_no_finding(is_of_track):
    rng = np.random.default_rng(2)

    def frames():
        for stamp, ids, boxes in street(moving=6):
            boxes[::2, 8] += np.pi
            if not is_of_track:
                boxes[:, 8] += np.pi * rng.integers(0, 2, len(boxes))
            yield stamp, ids, boxes

    assert axes_of(frames(), STANDARD).finding == ''


@pytest.mark.parametrize('exchanged', [True, False])
def test_a_class_that_moves_sideways_beside_another_is_named(exchanged):
    check = AxisCheck(STANDARD, Config().drives)
    for stamp, ids, boxes in street(moving=4):
        names = ['car'] * len(boxes)
        names[-2:] = ['truck'] * 2
        boxes[-2:, 8] += np.pi / 2
        if exchanged:
            boxes[-2:, [3, 4]] = boxes[-2:, [4, 3]]
        check.add(BoxArray(stamp, 'odom', tuple(ids), tuple(names), np.ones(len(ids)), boxes))
    found = check.class_finding
    assert found.startswith("boxes of 'truck' move along their y axis, sideways")
    assert "those of 'car' along their x axis" in found
    assert ('exchange their length and width' in found) == exchanged


def street_of(yaw_of, frame_yaw=0.0):
    """Return the check of a street with other yaws, in a frame of the boxes that is turned."""
    check = AxisCheck(STANDARD, Config().drives)
    for stamp, ids, boxes in street(moving=4):
        boxes[:, 8] = yaw_of(boxes[:, 8])
        check.add(array(stamp, ids, boxes), frame_yaw)
    return check


@pytest.mark.parametrize('frame_yaw', [0.0, 0.7])
def test_a_clockwise_yaw_is_named_with_its_option(frame_yaw):
    check = street_of(lambda yaw: 2 * frame_yaw - yaw, frame_yaw)
    assert check.wanted == Convention(orientation='clockwise')
    assert '--orientation clockwise' in check.finding


@pytest.mark.parametrize('forward_axis', ['y+', 'y-'])
@pytest.mark.parametrize('degrees', [35, 55, 145])
def test_a_sideways_yaw_on_a_road_along_a_diagonal_is_no_clockwise_one(forward_axis, degrees):
    """Mirrored, the yaw of its vehicles is less than 30 degrees off their way."""

    def frames():
        for stamp, ids, boxes in street(moving=4):
            headings = np.radians(degrees) + np.pi * (np.arange(4) % 2)
            along = 0.8 * stamp / S * 10 * np.stack([np.cos(headings), np.sin(headings)], axis=1)
            boxes[6:, :2] = along + np.arange(4)[:, None] * 10
            boxes[6:, 8] = headings
            yield stamp, ids, boxes

    convention = Convention(forward_axis=forward_axis)
    assert axes_of(frames(), convention).wanted == convention


def test_a_yaw_in_degrees_is_named():
    rng = np.random.default_rng(1)
    finding = street_of(lambda yaw: np.degrees(yaw + rng.normal(0, 0.1, len(yaw)))).finding
    assert 'degrees written as radians' in finding


@pytest.mark.parametrize(
    'yaw_of, frame_yaw, words',
    [
        (lambda yaw: yaw + 0.3, 0.0, 'turned by 17 degrees to the left; it may be of another'),
        (lambda yaw: yaw - 0.8, 0.0, 'turned by 46 degrees to the right; it may be of another'),
        (lambda yaw: yaw + 0.5, 0.5, 'left; it may be that of the fixed frame, where positions'),
        (lambda yaw: 0 * yaw - 0.5, 0.0, 'it may be one for all boxes, -0.5, as of a detector'),
        (lambda yaw: yaw + 0.05, 0.0, ''),
    ],
)
def test_a_yaw_that_is_turned_from_the_way_by_one_angle_is_named(yaw_of, frame_yaw, words):
    check = street_of(yaw_of, frame_yaw)
    assert check.wanted == STANDARD
    assert words in check.finding
    assert bool(check.finding) == bool(words)
    assert check.is_turned == ('turned by' in check.finding)


def test_label_files_with_other_axes_are_named_and_read_by_the_options(tmp_path, capsys):
    """The table of a drive along its x axis, written with y forward and width, length, height."""
    convention = Convention(forward_axis='y+', size_order='wlh')
    arrays = [array(*frame) for frame in street(moving=3)]
    for name, boxes in (('own', arrays), ('other', map(convention.from_centers, arrays))):
        BoxTable.from_arrays(list(boxes)).write(tmp_path / f'{name}.csv')
    meant = ['--forward-axis', 'y+', '--size-order', 'wlh']
    tables = []
    for name, options in (('own', []), ('other', []), ('other', meant)):
        out = tmp_path / f'{name}{len(options)}'
        source = str(tmp_path / f'{name}.csv')
        command = ['convert', source, '--from', 'csv', '--to', 'csv', '-o', str(out), *options]
        assert main(command) == 0
        assert ('--forward-axis y+ --size-order wlh' in capsys.readouterr().out) == (
            name == 'other' and not options
        )
        tables.append(BoxTable.read(out / 'boxes.csv').boxes)
    np.testing.assert_allclose(tables[2], tables[0], atol=1e-6)
    assert np.abs(tables[1] - tables[0]).max() > 1
