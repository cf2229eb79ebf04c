"""The sensitivity measurement: numbers are found, changed for one run, and restored."""

from importlib import import_module
import sys

from boxreg_ros.config import Config
from boxreg_ros.core import arrowhead
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.offline.drive import Drive
from boxreg_ros.simulation.simulate import simulate
from measure.sensitivity import (
    changed_constant,
    kinds_of,
    losses,
    measure,
    Measurement,
    Variation,
    variations_of_constants,
    variations_of_settings,
)
import pytest

TRACK = Measurement(Config(estimate='track'), 'track', 50, ['car', 'van', 'truck'])
SOURCE = """
WEIGHT = 0.5  # read by the method
UNUSED = 4.0
SIGNED: float = -2.0
PAIR = 3.0, 0
FEW, MANY = 2, 8
SAME = ALIAS = 7.0
COLUMN = 5
STRIDE = 6
DOUBLE = 2 * STRIDE
TABLE = [1.0, 2.0]
lower = 1.0

def f(a):
    LOCAL = 9.0
    return a[..., COLUMN] * WEIGHT + a[min(FEW, 3) :].sum() + LOCAL
"""


@pytest.fixture(scope='module')
def drive():
    return Drive.from_scene(simulate('street', seed=3, sweeps=14))


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Write `SOURCE` as a module of a package of its own, and return the package's name."""
    folder = tmp_path / 'sensitivity_example'
    folder.mkdir()
    (folder / '__init__.py').write_text('')
    (folder / 'method.py').write_text(SOURCE)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield folder.name
    sys.modules.pop(folder.name, None)


def test_constants_are_found_by_their_form(package):
    found = variations_of_constants(package)
    values = {(item.name, item.factor): item.value for item in found}
    assert values == {
        ('method.WEIGHT', 0.5): 0.25,
        ('method.WEIGHT', 2): 1.0,
        ('method.UNUSED', 0.5): 2.0,
        ('method.UNUSED', 2): 8.0,
        ('method.SIGNED', 0.5): 1.0,  # of the number; the sign before it stays
        ('method.SIGNED', 2): 4.0,
        ('method.PAIR[0]', 0.5): 1.5,
        ('method.PAIR[0]', 2): 6.0,
        ('method.FEW', 0.5): 1,
        ('method.FEW', 2): 4,
        ('method.MANY', 0.5): 4,
        ('method.MANY', 2): 16,
        ('method.SAME = ALIAS', 0.5): 3.5,
        ('method.SAME = ALIAS', 2): 14.0,
    }
    for item in found:
        module, line, column = item.place
        assert module == f'{package}.method'
        text = SOURCE.splitlines()[line - 1][column:]
        assert text.startswith(str(item.default))


def test_constants_of_the_core_exclude_array_layout():
    names = {item.name for item in variations_of_constants()}
    assert len(names) > 30
    assert arrowhead.LINK == 6  # variables of a pose: the number of columns of many arrays
    assert 'arrowhead.LINK' not in names


def test_settings_stay_within_their_bounds():
    found = variations_of_settings(Config(), ['vehicle'])
    names = {item.name for item in found}
    assert {'vehicle.position', 'solver.tolerance', 'faces.ends', 'window'} <= names
    assert not [name for name in names if name.startswith(('paper.', 'cyclist.'))]
    assert 'faces.learn' not in names  # a switch
    assert 'vehicle.gap_bottom' not in names  # 0 times anything is 0
    for item in found:
        assert item.value != item.default
        assert type(item.value) is type(item.default)
        Config().updated({item.name: item.value})  # raises if out of bounds


def test_kinds_are_those_of_the_boxes(drive):
    assert kinds_of(drive.boxes, Config())[0] == 'vehicle'
    assert set(kinds_of(drive.boxes, Config())) == {'vehicle', 'cyclist'}


def scalar_constants():
    """Return the variations of constants with one name and one value."""
    return [item for item in variations_of_constants() if item.name.rpartition('.')[2].isupper()]


def test_changed_constant_holds_within_the_context_only():
    for item in scalar_constants()[::8]:
        module, name = item.place[0], item.name.rpartition('.')[2]
        if name not in vars(import_module(module)):
            continue  # the label of several elements
        if vars(import_module(module))[name] != item.default:
            continue  # a sign stands before the number
        before = dict(sys.modules)
        with changed_constant(item.place, item.value):
            changed = import_module(module)
            assert vars(changed)[name] == item.value
            assert import_module('boxreg_ros.config').Config is Config
            assert import_module('boxreg_ros.core.registrar').BoxRegistrar is not BoxRegistrar
        assert sys.modules == before
        assert vars(import_module(module))[name] == item.default
        assert import_module('boxreg_ros.core.registrar').BoxRegistrar is BoxRegistrar


def test_modules_are_restored_after_an_error():
    place = scalar_constants()[0].place
    before = dict(sys.modules)
    with pytest.raises(RuntimeError, match='in between'), changed_constant(place, 1.0):
        import_module('boxreg_ros.core.registrar')
        raise RuntimeError('in between')
    assert sys.modules == before
    assert not [finder for finder in sys.meta_path if type(finder).__name__ == '_Finder']


def test_constants_of_the_method_change_the_result(drive):
    baseline = measure(drive, TRACK, None)
    assert 0.6 < baseline.iou_3d < 1
    of_faces = [item for item in variations_of_constants() if item.name.startswith('face_support')]
    halved = [item for item in of_faces if item.factor == 0.5][:3]
    outcomes = [measure(drive, TRACK, item) for item in halved]
    assert not [outcome.failure for outcome in outcomes if outcome.failure]
    assert max(abs(outcome.iou_3d - baseline.iou_3d) for outcome in outcomes) > 1e-4
    # Constants of the evaluation are not read by the method: exactly the same boxes.
    unread = next(item for item in variations_of_constants() if item.name.startswith('metrics.'))
    assert measure(drive, TRACK, unread) == baseline


def test_losses_are_sorted_and_exact(drive):
    baseline = measure(drive, TRACK, None)
    unread = Variation('queue', 2.0, 20, 40)  # no box waits for its sweep in this scene
    harmful = Variation('vehicle.position', 0.02, 0.14, 0.003)  # input taken for almost exact
    failing = Variation('vehicle.position', 1e-9, 0.14, 1e-10)  # out of bounds
    variations = [unread, harmful, failing]
    outcomes = [[measure(drive, TRACK, item)] for item in variations]
    found = losses(variations, {'street': baseline}, outcomes)
    assert [loss.value for loss in found] == [1e-10, 0.003, 40]
    assert found[0].failure.startswith('ConfigError: vehicle.position')
    assert found[1].volume > 0.005
    assert found[1].volume == pytest.approx(baseline.iou_3d - outcomes[1][0].iou_3d)
    assert found[2].volume == found[2].bev == 0
