"""`boxreg calibrate`: labelling margins and errors that are known are found again."""

from dataclasses import replace

from boxreg_ros import cli
from boxreg_ros.config import Config
from boxreg_ros.core.matching import AT_ONCE
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.recording import Recording
from boxreg_ros.offline.calibrate import (
    calibrated,
    GAPS,
    input_errors,
    labelling_margins,
    Measured,
)
from boxreg_ros.simulation.simulate import simulate
from boxreg_ros.structures import BoxArray
from measure.drives import Drive
import numpy as np
import pytest
from ros_messages import Drive as Recorded
from scenes import write_scene
from scipy.spatial.transform import Rotation
import yaml

MARGINS = {'gap_ends': 0.12, 'gap_sides': 0.07, 'gap_top': 0.09, 'gap_bottom': 0.05}
"""Labelling margins around the boxes of the bodies [m]."""


def drawn(truth, margins=MARGINS):
    """Return true boxes with labelling margins."""
    boxes = truth.boxes.copy()
    up, down = margins['gap_top'], margins['gap_bottom']
    boxes[:, 3:6] += 2 * margins['gap_ends'], 2 * margins['gap_sides'], up + down
    axes = Rotation.from_euler('ZYX', boxes[:, [8, 7, 6]]).as_matrix()
    boxes[:, :3] += axes[:, :, 2] * (up - down) / 2
    return replace(truth, boxes=boxes)


@pytest.fixture(scope='module')
def scene():
    return simulate('street', seed=6, sweeps=24)


@pytest.fixture(scope='module')
def plain(scene):
    return labelling_margins(Drive.from_scene(scene), Config())


def test_labelling_margins_of_a_simulated_recording_are_found(scene, plain):
    # The bodies are on the road, which is the bottom of their boxes. Elsewhere they touch these
    # faces at a few points, and of the noise of 0.02 m the outermost twentieth is 2 deviations
    # out.
    assert plain['vehicle.gap_bottom'].value == pytest.approx(0.0, abs=0.01)
    assert all(-0.05 < plain[f'vehicle.{name}'].value < 0.15 for name in GAPS)
    drive = Drive.from_scene(scene)
    found = labelling_margins(replace(drive, truth=drawn(drive.truth)), Config())
    for gap_name, gap in MARGINS.items():
        name = f'vehicle.{gap_name}'
        assert found[name].value - plain[name].value == pytest.approx(gap, abs=0.012), name
        assert (
            10 <= found[name].tracks <= 19
        )  # vehicles of 22 tracks: half at least show each face
        assert found[name].spread < 0.1
    # The inset of occluded faces does not depend on the labelling margins.
    for name in ('faces.inset_ends', 'faces.inset_sides'):
        assert found[name].value == pytest.approx(plain[name].value, abs=0.06)


def test_each_kind_has_its_own_margins(scene):
    # Every other track is labelled motorcycle, with the margins of `MARGINS`.
    drive = Drive.from_scene(scene)
    rides = np.array([int(name) % 2 == 1 for name in drive.truth.track_ids])
    names = tuple('motorcycle' if ride else 'car' for ride in rides)
    plain = replace(drive.truth, class_names=names)
    boxes = np.where(rides[:, None], drawn(plain).boxes, plain.boxes)
    before, found = (
        labelling_margins(replace(drive, truth=truth), Config())
        for truth in (plain, replace(plain, boxes=boxes))
    )
    assert not any(name.startswith('pedestrian') for name in found)
    for name, gap in MARGINS.items():
        change = {k: found[f'{k}.{name}'].value - before[f'{k}.{name}'].value
                  for k in ('vehicle', 'cyclist')}  # fmt: skip
        assert change['cyclist'] == pytest.approx(gap, abs=0.012), name
        assert change['vehicle'] == pytest.approx(0, abs=0.005), name
        assert found[f'cyclist.{name}'].tracks + found[f'vehicle.{name}'].tracks <= 22


def test_spread_of_margins_between_objects(scene, plain):
    # Each track has margins of its own, with a deviation of 0.1 m beside that of the bodies s. The
    # setting of 0.05 m counts as 14 of 14 + n tracks.
    drive = Drive.from_scene(scene)
    rng = np.random.default_rng(3)
    boxes = drive.truth.boxes.copy()
    for name in sorted(set(drive.truth.track_ids)):
        rows = np.array(drive.truth.track_ids) == name
        own = dict(zip(GAPS, rng.normal(0.3, 0.1, 4), strict=True))
        boxes[rows] = drawn(drive.truth.rows(rows), own).boxes
    found = labelling_margins(replace(drive, truth=replace(drive.truth, boxes=boxes)), Config())
    assert 'vehicle.gap_spread' in calibrated(Config(), found)
    before, after = plain['vehicle.gap_spread'], found['vehicle.gap_spread']
    n = after.tracks
    assert n >= 10
    bodies = np.mean([plain[f'vehicle.{name}'].spread ** 2 for name in GAPS[:3]])
    expected = np.sqrt((14 * 0.05**2 + n * (bodies + 0.1**2)) / (14 + n))
    assert after.value == pytest.approx(expected, rel=0.25)
    assert before.value < 0.06 < after.value


def test_margins_do_not_depend_on_the_start(scene, plain):
    begin = Config().updated(
        {'vehicle.gap_ends': 0.3, 'vehicle.gap_top': -0.1, 'faces.learn': False}
    )
    found = labelling_margins(Drive.from_scene(scene), begin)
    for name in (f'vehicle.{name}' for name in GAPS):
        assert found[name].value == pytest.approx(plain[name].value, abs=0.01), name


def test_margins_of_few_tracks(scene, plain):
    drive = Drive.from_scene(scene)
    few = drive.truth.rows(np.isin(drive.truth.track_ids, ('9', '10', '11', '12')))
    found = labelling_margins(replace(drive, truth=few), Config())
    assert {found[f'vehicle.{name}'].tracks for name in GAPS} <= {3, 4}
    known = plain['vehicle.gap_bottom'].value
    assert found['vehicle.gap_bottom'].value == pytest.approx(known, abs=0.02)


def noisy_drive(deviation, count=25, n=40, bias=0.0, class_name='car', turned=0.0):
    """Return tracks with known errors: lon lat z [m], roll pitch yaw [rad], part of extents."""
    rng = np.random.default_rng(7)
    arrays, true = [], []
    scale = rng.normal(0, deviation[6], (count, 3)) + 1  # of a whole track
    for k in range(n):
        boxes = np.zeros((count, 9))
        boxes[:, :2] = np.arange(count)[:, None] * [9.0, 4.0] + 0.5 * k
        boxes[:, 3:6] = 4.4, 1.8, 1.5
        boxes[:, 8] = np.linspace(-3, 3, count) + 0.05 * k
        axes = Rotation.from_euler('ZYX', boxes[:, [8, 7, 6]]).as_matrix()
        noisy = boxes.copy()
        shift = rng.normal(0, deviation[:3], (count, 3)) + bias
        noisy[:, :3] += (axes @ shift[..., None])[..., 0]
        noisy[:, 6:] += rng.normal(0, deviation[3:6], (count, 3))
        noisy[:, 8] += np.pi * (rng.random(count) < turned)
        noisy[:, 3:6] *= scale
        ids, names = tuple(map(str, range(count))), (class_name,) * count
        for rows, out in ((noisy, arrays), (boxes, true)):
            out.append(BoxArray(k * 10**8, 'odom', ids, names, np.ones(count), rows))
    return Drive((), tuple(arrays), BoxTable.from_arrays(true, 'truth'))


DEVIATION = np.array([0.2, 0.1, 0.05, 0.03, 0.03, 0.06, 0.08])


@pytest.mark.parametrize(('bias', 'turned'), [(0.0, 0.0), (0.3, 0.0), (0.0, 0.1), (0.0, 1.0)])
def test_errors_of_the_input_are_found(bias, turned):
    found = input_errors(noisy_drive(DEVIATION, bias=bias, turned=turned), Config())
    expected = {
        'position': 0.2, 'lateral': 0.1, 'height': 0.05, 'heading': 0.06, 'extent': 0.08,
    }  # fmt: skip
    assert set(found) == {f'vehicle.{name}' for name in expected}
    for name, value in expected.items():
        measured = found[f'vehicle.{name}']
        # 1000 errors give a deviation to 4 %; 75 extents to 15 %.
        assert measured.value == pytest.approx(value, rel=0.25 if name == 'extent' else 0.1), name
        assert measured.tracks == 25
        assert 0 < measured.spread < value


@pytest.mark.parametrize('held', [10, 25])
def test_repeated_boxes_give_errors_of_extents_only(held):
    # Of 25 tracks some have the same box at all stamps.
    drive = noisy_drive(DEVIATION)
    first = drive.boxes[0].boxes[:held]
    boxes = tuple(replace(a, boxes=np.r_[first, a.boxes[held:]]) for a in drive.boxes)
    found = input_errors(replace(drive, boxes=boxes), Config())
    assert found['vehicle.extent'].tracks == 25
    assert found['vehicle.position'].tracks == 25 - held
    if held < 25:
        assert found['vehicle.position'].value == pytest.approx(0.2, rel=0.1)
    else:
        assert set(calibrated(Config(), found)) == {'vehicle.extent'}


def test_each_kind_has_its_own_errors():
    drives = [noisy_drive(DEVIATION * k, class_name=c) for k, c in ((1, 'bus'), (2, 'person'))]
    walkers = [replace(a, track_ids=tuple(f'p{n}' for n in a.track_ids)) for a in drives[1].boxes]
    truth = [d.truth for d in drives]
    both = Drive((), (*drives[0].boxes, *walkers), BoxTable(
        np.concatenate([t.stamps_ns for t in truth]), 'odom',
        truth[0].track_ids + tuple(f'p{n}' for n in truth[1].track_ids),
        truth[0].class_names + truth[1].class_names, np.concatenate([t.scores for t in truth]),
        np.concatenate([t.boxes for t in truth]), truth[0].status + truth[1].status,
        np.concatenate([t.num_points for t in truth]),
    ))  # fmt: skip
    found = input_errors(both, Config())
    assert found['vehicle.position'].value == pytest.approx(0.2, rel=0.1)
    assert found['pedestrian.position'].value == pytest.approx(0.4, rel=0.1)
    assert not any(name.startswith('cyclist') for name in found)


def test_short_tracks_give_no_errors():
    found = input_errors(noisy_drive(DEVIATION, n=4), Config())
    assert found['vehicle.position'].tracks == 0
    assert calibrated(Config(), found) == {}


def test_written_settings():
    margins = {f'vehicle.{name}': Measured(gap, 0.01, 3) for name, gap in MARGINS.items()}
    # Two tracks of a kind are too few for margins; those of other kinds are fixed all the same.
    margins |= {f'cyclist.{name}': Measured(0.4, 0.01, 2) for name in MARGINS}
    found = calibrated(Config(lag=4), margins)
    known = {f'vehicle.{name}': gap for name, gap in MARGINS.items()}
    assert found == known | {'lag': 4, 'faces.learn': False}
    # One unknown gap of a kind keeps the estimation on, for gaps of this or of another kind.
    margins['cyclist.gap_top'] = Measured(0.4, 0.01, 3)
    assert calibrated(Config(), margins) == known | {'cyclist.gap_top': 0.4}
    margins['cyclist.gap_top'] = margins['vehicle.gap_top'] = Measured(0.4, 0.01, 2)
    assert calibrated(Config(), margins) == {k: v for k, v in known.items() if k[-4:] != '_top'}
    # Values beyond what a setting may have.
    edges = {
        'faces.inset_ends': Measured(-0.1, 0.01, 9),
        'vehicle.heading': Measured(0.0, 0.0, 9),
    }  # fmt: skip
    assert calibrated(Config(), edges) == {'faces.inset_ends': 0.0, 'vehicle.heading': 0.001}


@pytest.fixture(scope='module')
def street(tmp_path_factory, scene):
    folder = tmp_path_factory.mktemp('street')
    drawn(scene.truth).write(folder / 'truth.csv')
    return write_scene(folder / 'street.mcap', scene)


def test_relabel_reads_the_written_settings(street, scene, tmp_path, capsys):
    margins, out = tmp_path / 'margins.yaml', tmp_path / 'out'
    truth = street.with_name('truth.csv')
    arguments = ['calibrate', street, '--truth', truth, '-o', margins, '--set', 'solver.rounds=2']
    assert cli.main([str(a) for a in arguments]) == 0
    text = capsys.readouterr().out
    assert 'vehicle.gap_bottom' in text
    assert 'vehicle.position' in text
    assert 'the labelling margins are fixed' in text
    assert f'{len(set(scene.truth.track_ids))} labelled tracks' in text
    config = Config.from_yaml(margins)
    assert config.vehicle.gap_bottom == pytest.approx(MARGINS['gap_bottom'], abs=0.01)
    assert config.pedestrian.gap_bottom == Config().pedestrian.gap_bottom  # only two walk
    assert not config.faces.learn
    assert config.solver.rounds == 2
    # The form of ROS, which the node's --params-file needs: numbers are floats, but for counts.
    group = yaml.safe_load(margins.read_text())['/**']['ros__parameters']
    assert all(isinstance(v, float) for k, v in group['vehicle'].items())
    assert cli.main(['relabel', str(street), '-o', str(out), '--config', str(margins)]) == 0
    assert Config.from_yaml(out / 'config.yaml') == config


def test_margins_of_a_recording_without_boxes(street, scene, tmp_path, capsys):
    nobody = [array.take([]) for array in scene.detections]
    path = write_scene(tmp_path / 'clouds.mcap', scene, detections=nobody)
    truth = str(street.with_name('truth.csv'))
    assert cli.main(['calibrate', str(path), '--truth', truth, '--no-boxes']) == 0
    text = capsys.readouterr().out
    assert 'vehicle.gap_ends' in text
    assert 'vehicle.position' not in text


def test_sweeps_without_labels_are_not_kept(street, scene):
    few = scene.truth.stamps_ns[[0, -1]]
    truth = replace(scene.truth, stamps_ns=np.where(scene.truth.stamps_ns < few[1], *few))
    drive = Drive.of(Recording([street]), truth, AT_ONCE)
    assert [sweep.stamp_ns for sweep in drive.sweeps] == few.tolist()
    assert len(drive.boxes) == len(scene.detections)


def test_unusable_messages_are_skipped_and_reported(tmp_path, capsys):
    made = Recorded(sweeps=8)
    made.replace('/points', 3, lambda message: setattr(message, 'point_step', 2))
    made.replace('/boxes', 4, lambda m: setattr(m.detections[0].header, 'frame_id', 'camera'))
    # TF begins at the fifth stamp; two before it are too far from that.
    made.items = [i for i in made.items if i[0] != '/tf' or i[1] >= made.stamps[4]]
    true = [
        BoxArray(stamp, 'odom', ('1', '2'), ('car', 'car'), np.ones(2), boxes)
        for stamp, boxes in made.truth.items()
    ]
    truth, path = BoxTable.from_arrays(true, 'truth'), made.write(tmp_path / 'drive')
    drive = Drive.of(Recording([path]), truth)
    assert [sweep.stamp_ns for sweep in drive.sweeps] == [*made.stamps[2:3], *made.stamps[4:]]
    assert [array.stamp_ns for array in drive.boxes] == [*made.stamps[2:4], *made.stamps[5:]]
    assert '2 messages could not be read, first: ' in drive.left_out
    assert '4 messages had no transform, first: transform odom -> base is known' in drive.left_out
    truth.write(tmp_path / 'truth.csv')
    words = ['calibrate', str(path), '--truth', str(tmp_path / 'truth.csv')]
    assert cli.main(words) == 0
    assert '2 messages could not be read' in capsys.readouterr().err


def test_true_boxes_with_rounded_stamps_are_joined(tmp_path, capsys):
    """In microseconds, by which most programs write stamps."""
    made = Recorded(sweeps=8, start=1_700_000_000_000_000_789)
    true = [
        BoxArray(stamp // 1000 * 1000, 'odom', ('1', '2'), ('car', 'car'), np.ones(2), boxes)
        for stamp, boxes in made.truth.items()
    ]
    truth, path = BoxTable.from_arrays(true, 'truth'), made.write(tmp_path / 'drive')
    drive = Drive.of(Recording([path]), truth)
    assert sorted(set(drive.truth.stamps_ns.tolist())) == made.stamps
    truth.write(tmp_path / 'truth.csv')
    assert cli.main(['calibrate', str(path), '--truth', str(tmp_path / 'truth.csv')]) == 0
    expected = '8 of 8 stamps of the true boxes are up to 0.789 us from those of the boxes: joined'
    assert expected in capsys.readouterr().err


def test_truth_of_another_time_is_refused(street, scene, tmp_path, capsys):
    truth = replace(scene.truth, stamps_ns=scene.truth.stamps_ns + 10**12)
    truth.write(tmp_path / 'truth.csv')
    arguments = ['calibrate', str(street), '--truth', str(tmp_path / 'truth.csv')]
    assert cli.main(arguments) == 1
    assert 'are stamps and frame those of the recording?' in capsys.readouterr().err
    truth.rows(truth.stamps_ns < 0).write(tmp_path / 'none.csv')
    assert cli.main([*arguments[:-1], str(tmp_path / 'none.csv')]) == 1
    assert 'expected true boxes, got none' in capsys.readouterr().err
    assert cli.main([*arguments, '-o', str(tmp_path / 'nowhere' / 'margins.yaml')]) == 2
    assert 'in a folder that is there' in capsys.readouterr().err, 'before any work'
    assert cli.main([*arguments, '-o', str(tmp_path)]) == 2
    assert 'expected a file' in capsys.readouterr().err


@pytest.mark.parametrize('given', ['{bag}', '{link}', '{truth}', '{folder}/margins.yaml'])
def test_the_output_never_overwrites_an_input(tmp_path, capsys, given):
    folder = Recorded(sweeps=2).write(tmp_path / 'drive', 'sqlite3')
    bag, truth, link = next(folder.glob('*.db3')), tmp_path / 'truth.csv', tmp_path / 'link'
    BoxTable.from_arrays([]).write(truth)
    link.symlink_to(bag)
    before = {path: path.read_bytes() for path in (bag, truth)}
    out = given.format(bag=bag, link=link, truth=truth, folder=folder)
    for recording in (folder, bag):
        if recording == folder or given != '{folder}/margins.yaml':
            words = ['calibrate', str(recording), '--truth', str(truth), '-o', out]
            assert cli.main(words) == 2
            assert 'expected a file that is no input' in capsys.readouterr().err
    assert {path: path.read_bytes() for path in (bag, truth)} == before
    assert not (folder / 'margins.yaml').exists()
