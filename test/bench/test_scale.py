"""`boxreg bench scale`: the schedule of a fleet, and a recording made larger by repetition."""

from boxreg_ros.bench import scale
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.transforms import TransformTree
from boxreg_ros.structures import Sweep
import numpy as np
import pytest
from ros_messages import Drive, SECOND


def test_a_fleet_takes_little_longer_than_cores_that_are_never_idle():
    fleet = scale.simulated(600.0, np.random.default_rng(1))
    assert fleet.least_hours <= fleet.hours < 1.5 * fleet.least_hours
    # A loss costs a fiftieth of its job, and one attempt of twenty is lost.
    assert fleet.lost == pytest.approx(scale.UNIT_PART * 0.05 / 0.95, rel=0.3)
    assert 0.6 < fleet.used <= 1


def test_equal_jobs_without_losses_fill_the_cores(monkeypatch):
    monkeypatch.setattr(scale, 'LENGTH_SPREAD', 0.0)
    monkeypatch.setattr(scale, 'STRAGGLER_PART', 0.0)
    monkeypatch.setattr(scale, 'LOSS_PART', 0.0)
    fleet = scale.simulated(3600.0, np.random.default_rng(1), count=20, cores=4)
    assert fleet == scale.Fleet(5.0, 5.0, 1.0, 0.0)


def test_a_recording_is_repeated_with_later_stamps(tmp_path):
    drive = Drive(sweeps=4)
    path = tmp_path / 'large.mcap'
    scale.repeated(drive.write(tmp_path / 'drive'), path, 1e-4, copies=2)
    tree = TransformTree()
    with Recording([path]) as recording:
        recording.choose_fixed_frame(tree)
        items = [item.content for item in recording.items(tree)]
    sweeps = [item for item in items if isinstance(item, Sweep)]
    assert len(sweeps) % 4 == 0 and len(sweeps) > 4
    steps = np.diff([sweep.stamp_ns for sweep in sweeps])
    assert (steps == SECOND // 10).all()
    assert all(len(sweep.points) == 2 * 240 for sweep in sweeps)
    assert path.stat().st_size >= 1e5
