"""The floors of CONTRIBUTING.md: imports point downward, and the core knows nothing of ROS."""

import ast
import configparser
from pathlib import Path
import subprocess
import sys

import pytest

ROOT = Path(__file__).resolve().parents[1]
FLOORS = (
    ('structures', 'config', 'errors'),
    ('geometry', 'metrics'),
    ('chain', 'sampling', 'objective', 'shape', 'correspondence', 'lbfgs'),
    ('calibration', 'window', 'registration'),
    ('association', 'registrar'),
    (
        'boxtable',
        'foxglove_mcap',
        'intake',
        'labels',
        'pose_check',
        'recording',
        'timeline',
        'tracker',
        'transforms',
        'visual',
    ),
)
CORE = tuple(module for floor in FLOORS[:5] for module in floor)
EDGE = len(FLOORS)
FRONT_DOOR = ROOT / 'boxreg_ros' / '__init__.py'  # offers what lies behind it, on any floor
FILES = sorted(
    {*ROOT.glob('boxreg_ros/**/*.py'), *ROOT.glob('msg_adapters/**/*.py')} - {FRONT_DOOR}
)
KEPT_OUT = {
    *('ament_index_python', 'mcap', 'msg_adapters', 'rclpy', 'rosbags'),
    *('builtin_interfaces', 'diagnostic_msgs', 'geometry_msgs', 'nav_msgs', 'rcl_interfaces'),
    *('sensor_msgs', 'std_msgs', 'tf2_msgs', 'vision_msgs', 'visualization_msgs'),
}


def floor_of(module):
    """Return the floor of 'boxreg_ros.name...'; what is not listed is an edge, the top floor."""
    name = module.split('.')[1]
    return next((i for i, floor in enumerate(FLOORS) if name in floor), EDGE)


def module_of(path):
    parts = path.relative_to(ROOT).with_suffix('').parts
    return '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)


def imports_of(path):
    """Yield every module a file imports, anywhere in it, as a full name with its line."""
    module = module_of(path)
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ''
            if node.level:
                package = (
                    module.split('.') if path.name == '__init__.py' else module.split('.')[:-1]
                )
                base = '.'.join([*package[: len(package) - node.level + 1], *base.split('.')])
            if base == 'boxreg_ros':  # from boxreg_ros import objective
                names = [a.name for a in node.names if not a.name.startswith('__')]
                yield from ((f'{base}.{name}', node.lineno) for name in names)
            else:
                yield base, node.lineno


def upward(path, lines):
    """Yield what in `lines`, pairs of imported module and line, a file must not import."""
    module = module_of(path)
    adapter = module.startswith('msg_adapters')
    own = 0 if adapter else floor_of(module)
    for name, line in lines:
        if name.startswith('boxreg_ros.') and floor_of(name) > own:
            yield f'{path.relative_to(ROOT)}:{line} imports {name} from a floor above its own'
        if name.split('.')[0] == 'msg_adapters' and not adapter and own < 5:
            yield f'{path.relative_to(ROOT)}:{line} imports {name}: the core reads no messages'


def core_files():
    return [path for path in FILES if path.parent.name == 'boxreg_ros' and path.stem in CORE]


@pytest.mark.parametrize('path', FILES, ids=module_of)
def test_imports_point_downward_only(path):
    assert not list(upward(path, imports_of(path)))


def test_the_rule_can_fail():
    core = ROOT / 'boxreg_ros' / 'geometry.py'
    for name in ('boxreg_ros.registrar', 'boxreg_ros.node', 'msg_adapters.vision'):
        assert list(upward(core, [(name, 1)]))
    assert list(upward(ROOT / 'msg_adapters' / 'vision.py', [('boxreg_ros.geometry', 1)]))
    assert not list(upward(core, [('boxreg_ros.metrics', 1), ('numpy', 1)]))


def test_core_imports_numbers_only():
    allowed = {'boxreg_ros', 'numpy', 'scipy', 'torch', 'yaml'}
    clocks = {'time', 'datetime', 'os', 'subprocess', 'threading'}
    for path in core_files():
        tops = {name.split('.')[0] for name, _ in imports_of(path)}
        assert tops - sys.stdlib_module_names <= allowed, path
        assert not tops & clocks, path


def code_lines(path):
    """Count lines that are not blank, comment or docstring: explaining more costs nothing."""
    text = path.read_text(encoding='utf-8')
    docstrings = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(
            node
        ):
            docstrings.update(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    return sum(
        bool(line.strip()) and not line.lstrip().startswith('#') and number not in docstrings
        for number, line in enumerate(text.splitlines(), 1)
    )


def test_core_stays_small():
    lines = {path.name: code_lines(path) for path in core_files()}
    assert set(lines) >= {'structures.py', 'registration.py', 'registrar.py'}
    assert sum(lines.values()) <= 1700, lines


def test_mypy_is_strict_on_the_whole_core():
    parser = configparser.ConfigParser()
    parser.read(ROOT / '.mypy.ini')
    (strict,) = (name for name in parser.sections() if parser.has_option(name, 'strict_equality'))
    modules = strict.removeprefix('mypy-').split(',')
    assert sorted(modules) == sorted(module_of(path) for path in core_files())


WITHOUT_ROS = f"""
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in {KEPT_OUT}:
            raise ModuleNotFoundError(f'{{name}} is kept out of this test')

sys.meta_path.insert(0, Absent())
import numpy as np
from boxreg_ros import Config, Track, refine
import boxreg_ros.registrar

stamps = np.arange(6) * 100_000_000
across, up = np.meshgrid(np.linspace(-0.8, 0.8, 9), np.linspace(-0.6, 0.6, 7))
rear = np.stack([np.full(63, -2.0), across.ravel(), up.ravel()], axis=1)
boxes = np.array([[10.0 + i, 0, 0, 4, 1.8, 1.5, 0, 0, 0] for i in range(6)])
points = [box[:3] + rear for box in boxes]
boxes[2, 0] += 0.3
track = Track('7', 'car', stamps, boxes, points, sensor_origins=np.zeros((6, 3)))
(refined,) = refine([track], Config())
assert refined.track_id == '7' and refined.boxes.shape == (6, 9)
assert np.isfinite(refined.boxes).all()
assert set(refined.status) <= {{'refined', 'kept', 'interpolated'}}, refined.status
print('ran', abs(refined.boxes[2, 0] - 12.0))
"""


def test_refine_needs_no_ros():
    done = subprocess.run(
        [sys.executable, '-c', WITHOUT_ROS], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    word, error = done.stdout.split()
    assert word == 'ran'
    assert float(error) < 0.3  # no further from the truth than the input
